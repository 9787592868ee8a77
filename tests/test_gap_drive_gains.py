"""Gains of drives that are known to a share only are no gap, and move in figures."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import at_rest_but, double

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.drive_gains import gain_columns, with_moved_gains
from makebreak.gap.residuals.driven import DrivenProblem
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.mechanism_candidates import candidates
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.driven_arm import DrivenArmSimulation
from makebreak.gap.simulation.measure import gap_measure
from makebreak.gap.simulation.windows import seen_in
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import ActuationSection

JOINTS = ["d.j1", "d.j2"]
KP, KD = np.array([80.0, 50.0]), np.array([6.0, 3.0])
NOISE = 3e-4  # [rad] of the encoders.


def scene_and_log(folder, kp=KP, kd=KD, follows="position", hidden=()):
    """A scene with KP and KD, and a log of one with other gains and hidden effects, 100
    rows a second."""
    of_type = {"position": "servo", "velocity": "velocity"}[follows]
    drive = ActuationSection(
        type=of_type, joints=JOINTS, kp=list(KP) if len(kp) else [], kd=list(KD)
    )
    scene = replace(double(folder), actuation=drive)
    truth = replace(scene, actuation=replace(drive, kp=list(kp), kd=list(kd)),
                    effects=list(hidden))  # fmt: skip
    time = np.arange(0.0, 20.0, 0.01)
    told = np.stack([0.5 * np.sin(2.0 * time), 0.6 * np.sin(3.1 * time + 1.0)])
    columns = dict(zip((f"{j}.{follows}_command" for j in JOINTS), told, strict=True))
    names = [f"{j}.position" for j in JOINTS]
    rows = DrivenArmSimulation(truth).run(
        at_rest_but(dict(zip(JOINTS, told[:, 0], strict=True))), time, names,
        Commands(time, columns),
    )  # fmt: skip
    rows = rows + NOISE * np.random.default_rng(0).standard_normal(rows.shape)
    file = folder / "log.csv"
    np.savetxt(
        file, np.column_stack([time, rows, *told]), "%.9g", ",",
        header=",".join(["time", *names, *columns]), comments="",
    )  # fmt: skip
    return scene, read_recordings([file])


def test_gains_within_their_tolerance_are_no_gap(tmp_path):
    kp, kd = KP * [1.03, 0.98], KD * [0.97, 1.02]
    usual, recordings = scene_and_log(tmp_path, kp, kd)
    assert DrivenProblem(usual, recordings).is_explained()  # 2 % if it does not say.
    scene = replace(usual, tolerance={"drive_gains": 0.0})
    assert not DrivenProblem(scene, recordings).is_explained()
    loose = replace(scene, tolerance={"drive_gains": 0.05})
    problem = DrivenProblem(loose, recordings)
    assert problem.is_explained()
    # The nuisances are the gains that there are: the masses may be off as well.
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    b, _ = screen.fit_nuisances(problem.base())
    moved = with_moved_gains(loose, n.names, b).actuation
    np.testing.assert_allclose(moved.kp, kp, rtol=0.02)
    np.testing.assert_allclose(moved.kd, kd, rtol=0.02)
    assert with_moved_gains(scene, ["object_mass of d.upper, mass"], [0.1]) is scene


def test_windows_are_of_the_rows_that_a_slower_sensor_measured(tmp_path):
    """Encoders at half of the log's rate, from its second row on."""
    scene, recordings = scene_and_log(tmp_path)
    whole = DrivenProblem(scene, recordings)

    def without(*rows):
        (log,) = recordings
        channels = dict(log.channels)
        for name in whole.channels:
            values = channels[name].values.copy()
            for of in rows:
                values[of::2] = np.nan
            channels[name] = replace(channels[name], values=values)
        return [replace(log, channels=channels)]

    slow = DrivenProblem(scene, without(0))
    assert len(slow.windows) == len(whole.windows)
    for window in slow.windows:
        assert np.isfinite(seen_in(slow, window)).all()
    held = [True] * len(slow.windows)
    gap = gap_measure(slow, *[slow.simulate(())] * 2, held)
    assert gap.is_measured and 0.5 < gap.before < 1.5
    # Where nothing was measured no error of 0 is told.
    slow.recordings = without(0, 1)
    assert not gap_measure(slow, *[slow.simulate(())] * 2, held).is_measured


def test_gains_beyond_their_tolerance_are_a_gap(tmp_path):
    scene, recordings = scene_and_log(tmp_path, KP * [1.4, 1.0], KD)
    loose = replace(scene, tolerance={"drive_gains": 0.05})
    assert not DrivenProblem(loose, recordings).is_explained()


@pytest.mark.parametrize("i", range(2))
def test_columns_are_what_a_gain_takes_off_the_equations(tmp_path, i):
    scene, recordings = scene_and_log(tmp_path)
    model = InverseModel(replace(scene, tolerance={"drive_gains": 0.05}), recordings)
    columns, prior, names = gain_columns(model)
    assert prior == [0.05] * 4 and len(set(names)) == 4
    share = 1e-3
    stiffer = Effect("servo_gain", [JOINTS[i]], {"kp": KP[i] * (1.0 + share)})
    damped = Effect("joint_viscous_damping", [JOINTS[i]], {"damping": share * KD[i]})
    unmet = {}
    for k, effect in enumerate((stiffer, damped)):
        other = replace(model.scene, effects=[effect])
        if effect is stiffer:
            kp = [KP[j] * (1.0 + share * (j == i)) for j in range(2)]
            other = replace(model.scene, actuation=replace(scene.actuation, kp=kp))
        with_it = InverseModel(other, recordings)
        unmet[k] = with_it.in_units(with_it.base())[:, :2]
    unmet[0][:, i] /= 1.0 + share  # In units of what the drive is told.
    before = model.in_units(model.base())[:, :2]
    for k, column in enumerate(columns[2 * i : 2 * i + 2]):
        expected = (before - unmet[k]) / share
        largest = np.abs(expected).max()
        # To first order in the share.
        off = model.in_units(column)[:, :2]
        np.testing.assert_allclose(off, expected, atol=2.0 * share * largest)
        assert largest > 1.0


@pytest.mark.parametrize("i", range(2))
def test_a_gain_of_a_velocity_drive_is_of_what_follows_its_command(tmp_path, i):
    """Damping of the joint, which the drive does not follow, is no gain of it."""
    scene, recordings = scene_and_log(tmp_path, kp=[], follows="velocity")
    model = InverseModel(scene, recordings)
    columns, _, names = gain_columns(model)
    assert names == [f"drive_gains of {joint}, kd" for joint in JOINTS]
    more, drive = 1e-3, scene.actuation
    gains = [kd * (1.0 + more * (k == i)) for k, kd in enumerate(KD)]
    stiffer = replace(scene, actuation=replace(drive, kd=gains))
    other = InverseModel(stiffer, recordings)
    with_more = other.in_units(other.base())
    with_more[:, i] /= 1.0 + more  # In units of what the drive is told.
    off = model.in_units(model.base()) - with_more
    column = model.in_units(columns[i])
    largest = np.abs(off).max() / more
    np.testing.assert_allclose(column, off / more, atol=2.0 * more * largest)
    damped = Effect("joint_viscous_damping", [JOINTS[i]], {"damping": more * KD[i]})
    off = model.in_units(model.base() - model.residual([damped]))
    assert np.abs(column - off / more).max() > 0.5 * largest


def test_damping_of_a_joint_with_a_velocity_drive_is_no_gain(tmp_path):
    """Nothing sticks: what slow rows lack is not what friction holds."""
    hidden = Effect("joint_viscous_damping", ["d.j2"], {"damping": 0.05 * KD[1]})
    scene, recordings = scene_and_log(
        tmp_path, kp=[], follows="velocity", hidden=[hidden]
    )
    problem = MechanismProblem(scene, recordings)
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    _, without = screen.fit_nuisances(problem.base())
    _, right = screen.fit_nuisances(problem.residual([hidden]))
    assert problem.noise_error(right) < 1.3
    assert problem.noise_error(without) > 2.0


def test_neither_noise_nor_a_gap_makes_gains_and_friction_smaller(tmp_path):
    """With gains, masses and friction all a tenth smaller a tenth less would be left of
    the equations, whatever it is."""
    hidden = Effect("joint_coulomb_friction", ["d.j2"], {"coulomb": 1.0})
    scene, recordings = scene_and_log(tmp_path, hidden=[hidden])
    loose = replace(scene, tolerance={"drive_gains": 0.05})
    problem = MechanismProblem(loose, recordings)
    n = problem.nuisances()
    (friction,) = [
        c for c in candidates(problem, n, problem.base())
        if c.kind == hidden.kind and list(c.at) == hidden.at
    ]  # fmt: skip
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), reach=n.reach)
    fit = screen.fit(friction.columns[0])
    assert fit.c[0] == pytest.approx(1.0, rel=0.01)
    is_gain = [name.startswith("drive_gains") for name in n.names]
    assert np.abs(fit.b[is_gain]).max() < 0.02


def test_a_drive_gives_what_it_asks_for_most_of_the_time(tmp_path):
    """Else light links that are given nothing would need nothing."""
    scene, recordings = scene_and_log(tmp_path)
    model = InverseModel(scene, recordings)
    (motion,) = model.motions()
    asked = np.abs(motion.effort[np.abs(motion.v[:, 1]) > 0.005, 1])
    least = model.least("actuator_saturation", ["d.j2"])
    assert least == {"limit": pytest.approx(np.median(asked))}
    assert "limit" not in model.least("joint_coulomb_friction", ["d.j2"])


def test_friction_that_a_scene_has_may_hold_a_joint_at_rest(tmp_path):
    friction = Effect("joint_coulomb_friction", [JOINTS[0]], {"coulomb": 30.0})
    scene, recordings = scene_and_log(tmp_path, hidden=[friction])
    known = InverseModel(replace(scene, effects=[friction]), recordings)
    (track,) = known.tracks
    rest = known.at_rest(track, 0.0, known._hold)[:, 0]
    assert rest.max() > 0.5  # It sticks where it turns round.
    assert (known._noises[0]["held"][:, 0] >= 30.0 * rest).all()
    unknown = InverseModel(scene, recordings)
    assert unknown._noises[0]["held"][:, 0].max() < 15.0


def test_equations_are_sums_of_effects_beside_measured_efforts(tmp_path):
    scene, _ = scene_and_log(tmp_path)
    file = tmp_path / "log.csv"
    names = file.read_text().split("\n", 1)[0].split(",")
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    more = np.random.default_rng(1).normal(size=(len(rows), 2))
    names += [f"{joint}.effort_measured" for joint in JOINTS]
    np.savetxt(
        file, np.column_stack([rows, more]), "%.9g", ",", header=",".join(names),
        comments="",
    )  # fmt: skip
    model = InverseModel(scene, read_recordings([file]))
    effects = [
        Effect("joint_coulomb_friction", [JOINTS[0]], {"coulomb": 0.4}),
        Effect("rotor_inertia", [JOINTS[1]], {"inertia": 0.02}),
    ]
    late = Effect("input_delay", ["d"], {"delay": 0.004})
    both = [
        of(0, model.dynamics, [*effects, late], *rest, effects, ())
        for of, rest in ((model._unmet, ()), (model._unmet_sum, ((),)))
    ]
    (one, a), (two, b) = both
    np.testing.assert_allclose(one, two, atol=1e-9)
    np.testing.assert_allclose(a.effort, b.effort, atol=1e-12)
    alone = model.residual(effects)
    assert np.abs(model.residual([*effects, late]) - alone).max() > 0.1


@pytest.mark.parametrize("i", range(2))
def test_what_is_fed_back_late_is_damping_and_a_rotor_that_are_not_there(tmp_path, i):
    scene, recordings = scene_and_log(tmp_path)
    model = InverseModel(scene, recordings)
    columns, _, names = model.loop_timing()
    late = 1e-3  # [s]
    for fed_back, effect in (
        ("position", Effect("joint_viscous_damping", [JOINTS[i]],
                            {"damping": late * KP[i]})),
        ("velocity", Effect("rotor_inertia", [JOINTS[i]],
                            {"inertia": late * (KD[i] + model._damping[i])})),
    ):  # fmt: skip
        column = columns[
            names.index(f"input_delay of {JOINTS[i]}, loop of its {fed_back}")
        ]
        off = (model.base() - model.residual([effect])) / late
        np.testing.assert_allclose(column, off, atol=1e-6 * np.abs(off).max())
        assert np.abs(off).max() > 1.0
