"""Logs of a pendulum in closed form: late channels, and recordings that differ."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from makebreak.gap import read_recordings, run_gap, write_report
from makebreak.gap.by_recording import Alone, Together, _apart, with_differences
from makebreak.gap.data import sampled_commands
from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.findings import GUESSED_GAINS, NO_COLUMN, NO_DRIVE, Finding
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.doubts import unless_doubtful
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.mechanism_candidates import nuisances
from makebreak.gap.result import Evidence, GapMeasure, GapResult, NamedEffect
from makebreak.gap.search.choice import Selection
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.groups import _needless_member
from makebreak.gap.search.select import select
from makebreak.gap.workflow import _follows_noise
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

MASS, LENGTH, G = 2.0, 0.5, 9.81
SCENE = """directives:
- add_model: {name: rig, file: "file://%s/robot.urdf"}
- add_weld: {parent: world, child: rig::base}
plant: {time_step: 0}
actuation: {type: effort, joints: [rig.hinge]}
"""
URDF = f"""<robot name="rig"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 {-LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="50" velocity="20"/></joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type>
<joint name="hinge"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>
<actuator name="m"/></transmission></robot>"""


def log(
    folder, name, seed, damping=0.0, late=0.0, effort_late=0.0, seconds=14.0,
    mass=MASS, longer=1.0, inertia=1e-3, position_noise=2e-5, fall=0.0,
    effort_noise=0.02, every=0.005,
):  # fmt: skip
    """Writes a log of a pendulum that follows sums of sines exactly, 200 rows a second;
    velocities and positions late, or the efforts. inertia: about its centre. fall: the
    share of its damping that it loses."""
    rng = np.random.default_rng(seed)
    w, phase = rng.uniform(2.0, 7.0, 4), rng.uniform(0.0, 2 * np.pi, 4)
    size = 0.5 / w

    def state(t):
        x = w * t[:, None] + phase
        return (size * np.sin(x)).sum(1), (size * w * np.cos(x)).sum(1), -(
            size * w**2 * np.sin(x)
        ).sum(1)  # fmt: skip

    def effort(t):
        q, v, a = state(t)
        about = mass * (longer * LENGTH) ** 2 + inertia
        return (
            about * a
            + mass * G * longer * LENGTH * np.sin(q)
            + (damping * (1.0 - fall * t / seconds) * v)
        )

    t = np.arange(0.0, seconds, every)
    q, v, _ = state(t - late)
    rows = np.column_stack(
        [
            t,
            q + position_noise * rng.standard_normal(len(t)),
            v + 1e-3 * rng.standard_normal(len(t)),
            effort(t - effort_late) + effort_noise * rng.standard_normal(len(t)),
        ]
    )
    names = ["time"] + [
        f"rig.hinge.{what}" for what in ("position", "velocity", "effort_measured")
    ]
    path = folder / f"{name}.csv"
    np.savetxt(path, rows, "%.9g", ",", header=",".join(names), comments="")
    return path


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "robot.urdf").write_text(URDF)
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE % tmp_path)
    return path


@pytest.mark.parametrize("late", [0.003, pytest.param(0.02, marks=pytest.mark.slow)])
def test_late_states_are_named_beside_the_efforts(scene, tmp_path, late):
    result = run_gap(scene, [log(tmp_path, "a", 0, late=late)])
    assert result.verdict == "gap_named"
    (found,) = result.effects
    assert (found.kind, list(found.at)) == ("sensor_delay", ["rig"])
    assert "beside its measured efforts" in result.says
    # Half a millisecond is what users were promised; noise alone gives 0.05 ms.
    assert found.parameters["delay"].value == pytest.approx(late, abs=5e-4)


def test_a_clock_is_off_from_the_first_row_on_and_not_since_1970(scene, tmp_path):
    """After 500 s a clock that is off by 2e-5 would be late by 10 ms: a delay."""
    rows = []
    for first in (0.0, 500.0):
        path = log(tmp_path, f"a{first:.0f}", 0)
        header, *lines = path.read_text().splitlines()
        each = [line.partition(",") for line in lines]
        text = [f"{float(t) + first:.9g},{rest}" for t, _, rest in each]
        path.write_text("\n".join([header, *text]))
        model = InverseModel(read_scene(scene), read_recordings([path]))
        skew = Effect("clock_skew", ["rig"], {"skew": 2e-5})
        rows.append(model.residual([skew]) - model.base())
    # To the digits of the stamps.
    np.testing.assert_allclose(rows[0], rows[1], atol=0.05 * np.abs(rows[0]).max())


def log_of_a_fast_loop(folder, **other):
    """Samples of commands that change all the time, 67 rows a second."""
    path = log(folder, "a", 13, effort_noise=0.0, **other)
    header, *lines = path.read_text().splitlines()
    header = header.replace("effort_measured", "effort_command")
    path.write_text("\n".join([header, *lines[::3]]))
    return path


def test_commands_of_a_faster_loop_are_no_gap(scene, tmp_path):
    result = run_gap(scene, [log_of_a_fast_loop(tmp_path)])
    assert (result.verdict, result.effects) == ("no_gap", [])
    assert "sampled_commands" in {c.kind for c in result.checks}


def test_a_command_holds_until_its_loop_gives_the_next(scene, tmp_path):
    """At a kilohertz it acts half a millisecond later than at its row, which was named
    as a delay of the sensors."""
    path = log_of_a_fast_loop(tmp_path, effort_late=-5e-4, position_noise=5e-6)
    result = run_gap(scene, [path])
    assert (result.verdict, result.effects) == ("no_gap", [])


def test_commands_of_a_faster_loop_are_found_among_means_over_many_rows(
    scene, tmp_path
):
    """A log of 500 rows a second is averaged over 10 ms: half a row is 1 ms all the
    same."""
    path = log(tmp_path, "a", 13, effort_noise=0.0, every=0.002)
    path.write_text(path.read_text().replace("effort_measured", "effort_command"))
    averaged, found = condition(read_recordings([path]))
    assert "averaged" in {f.kind for f in found}
    assert MechanismProblem(read_scene(scene), averaged).commands_are_samples()


def test_commands_that_hold_or_damping_are_no_samples(scene, tmp_path):
    """Damping that the scene lacks acts earlier than gravity and inertia, too."""
    recordings = read_recordings([log_of_a_fast_loop(tmp_path)])
    problem = MechanismProblem(read_scene(scene), recordings)
    assert problem.commands_are_samples()
    # Commands that are stamped by another clock, by a fifth of a row.
    late = log_of_a_fast_loop(tmp_path, effort_late=0.003)
    assert MechanismProblem(
        read_scene(scene), read_recordings([late])
    ).commands_are_samples()
    held = sampled_commands.as_samples(recordings)
    assert not MechanismProblem(read_scene(scene), held).commands_are_samples()
    # Whatever else the scene lacks.
    path = log(tmp_path, "c", 14, damping=0.5)
    path.write_text(path.read_text().replace("effort_measured", "effort_command"))
    damped = MechanismProblem(read_scene(scene), read_recordings([path]))
    assert damped.commands_are_samples()
    # What holds for a row is the law's effort of the row's middle.
    path = log(tmp_path, "b", 14, damping=0.5, effort_late=-0.0025)
    path.write_text(path.read_text().replace("effort_measured", "effort_command"))
    damped = MechanismProblem(read_scene(scene), read_recordings([path]))
    assert not damped.commands_are_samples()


def test_another_direction_of_gravity_is_said(tmp_path, scene):
    path = log(tmp_path, "a", 15)
    text = scene.read_text() + "plant: {time_step: 0, gravity: [-9.81, 0, 0]}\n"
    scene.write_text(text.replace("plant: {time_step: 0}\n", ""))
    result = run_gap(scene, [path])
    if result.verdict == "gap_unnamed":
        assert "Gravity of" in result.says
    problem = MechanismProblem(read_scene(scene), read_recordings([path]))
    assert "is the base mounted as the scene says?" in problem.hint(None)
    standing = scene.read_text().replace("gravity: [-9.81, 0, 0]", "")
    scene.write_text(standing.replace("time_step: 0, ", "time_step: 0"))
    problem = MechanismProblem(read_scene(scene), read_recordings([path]))
    assert problem.hint(None) == ""


def test_what_another_direction_of_gravity_explains_better_is_not_named(
    tmp_path, scene
):
    """Two forces, or a load that weighs less than nothing, stood for a wall mount."""
    path = log(tmp_path, "a", 17)
    problem = MechanismProblem(read_scene(scene), read_recordings([path]))
    much, little = (SimpleNamespace(left=np.full(len(problem.base()), x))
                    for x in (50.0, 0.5))  # fmt: skip
    assert problem.other_gravity(much) == ("", False)  # It is as the scene says.
    turned = scene.read_text() + "plant: {time_step: 0, gravity: [-9.81, 0, 0]}\n"
    scene.write_text(turned.replace("plant: {time_step: 0}\n", ""))
    problem = MechanismProblem(read_scene(scene), read_recordings([path]))
    says, is_better = problem.other_gravity(much)
    assert is_better and "Gravity of (" in says
    assert not problem.other_gravity(little)[1]  # What is named does as well.


def test_friction_that_falls_is_said_to_and_constant_friction_is_not(scene, tmp_path):
    said = []
    for fall in (0.0, 0.6):
        path = log(tmp_path, f"a{fall}", 16, damping=1.0, seconds=20.0, fall=fall)
        result = run_gap(scene, [path])
        # What falls fits data from another time less: it is tried, then, not named.
        told = result.tried if fall else result.effects
        assert "joint_viscous_damping" in {e.kind for e in told}
        said.append("goes from" in result.says)
    assert said == [False, True]


def test_what_happens_only_at_the_end_is_no_agreement(scene, tmp_path):
    """The last fifth is for the report only: nothing is fitted there."""
    path = log(tmp_path, "a", 0)
    assert run_gap(scene, [path]).verdict == "no_gap"
    header, *lines = path.read_text().splitlines()
    rows = np.array([[float(x) for x in line.split(",")] for line in lines])
    rows[int(0.9 * len(rows)) :, 3] *= 2.0
    np.savetxt(path, rows, "%.9g", ",", header=header, comments="")
    result = run_gap(scene, [path])
    assert (result.verdict, result.effects) == ("gap_unnamed", [])
    assert "on the data held out for the report the simulation error is" in result.says


def test_late_efforts_are_named_at_the_efforts(scene, tmp_path):
    result = run_gap(scene, [log(tmp_path, "a", 1, effort_late=0.008)])
    assert result.verdict == "gap_named"
    (found,) = result.effects
    assert found.kind == "sensor_delay"
    assert list(found.at) == ["rig.hinge.effort_measured"]
    assert found.parameters["delay"].value == pytest.approx(0.008, abs=5e-4)
    # Simulation is driven by the efforts as they were.
    assert result.gap.after < 1.5


def test_low_passes_of_a_position_are_told_apart_by_their_time_constants(
    scene, tmp_path
):
    model = InverseModel(read_scene(scene), read_recordings([log(tmp_path, "a", 2)]))
    at = ["rig.hinge.position"]

    def off(lag):
        each = [Effect("sensor_lag", at, {"time_constant": lag})]
        return model.residual(each) - model.base()

    # To first order what a low-pass takes is proportional to its time constant.
    ratio = np.linalg.norm(off(2e-3)) / np.linalg.norm(off(1e-3))
    assert ratio == pytest.approx(2.0, rel=0.05)


def test_a_longer_rod_is_a_tie_with_a_rotor(tmp_path, scene):
    """Half of what is longer is hidden in the tolerance of the mass and its centre; the
    other half is as well a rotor as a centre that is farther out."""
    rod = MASS * LENGTH**2 / 3.0  # A thin rod about its centre.
    text = URDF.replace("1e-3", f"{rod:.6g}")
    (tmp_path / "robot.urdf").write_text(text)
    path = log(tmp_path, "a", 11, longer=1.1, inertia=1.21 * rod)
    result = run_gap(scene, [path])
    assert result.verdict == "ambiguous"
    kinds = {e.kind for e in result.effects}
    ties = {t.kind for e in result.effects for t in e.indistinguishable_from}
    assert {"rotor_inertia", "link_com"} <= kinds | ties


def test_rows_have_the_noise_and_the_nuisances_of_the_model_that_is_tried(
    scene, tmp_path
):
    """As if the scene itself had been of that mass and centre: twice the mass, and the
    same noise of a position is twice the effort."""
    path = log(tmp_path, "a", 12, mass=2.0 * MASS, position_noise=1e-3)
    recordings = read_recordings([path])
    effects = [
        Effect("link_mass", ["rig.rod"], {"mass": MASS}),
        Effect("link_com", ["rig.rod"], {"x": 0.1, "y": 0.0, "z": -0.05}),
    ]
    problem = MechanismProblem(read_scene(scene), recordings)
    before = problem.noise_in_units()[:, 0]
    nothing = problem.nuisances()
    r = problem.residual(effects)
    fitted = SimpleNamespace(effects=effects, left=r)
    assert problem.reweigh(fitted) and not problem.reweigh(fitted)
    heavy = replace(read_scene(scene), effects=effects)
    expected = InverseModel(heavy, recordings)
    now = problem.noise_in_units()[:, 0]
    np.testing.assert_allclose(now, expected.noise_in_units()[:, 0], rtol=1e-9)
    assert np.median(now / before) > 1.5
    columns, own = problem.nuisances(), nuisances(expected)
    assert columns.names == nothing.names
    np.testing.assert_array_equal(columns.prior, nothing.prior)
    units = [p.in_units(n.columns[:, 0])[:, 0]
             for p, n in ((problem, columns), (expected, own))]  # fmt: skip
    np.testing.assert_allclose(units[0], units[1], atol=1e-9 * np.abs(units[1]).max())


def test_only_a_recording_that_is_too_short_is_not_searched_alone():
    gap = GapMeasure(9.0, 9.0, 1.0, 0.3)
    result = GapResult("gap_unnamed", "", (), [], gap, (), {}, [])

    def short(name):
        raise DoesNotFit("too short")

    def wrong(name):
        raise ValueError("operands could not be broadcast")

    both = shared(left={"a": 2.0, "b": 1.0})
    assert with_differences(result, both, short) is result
    with pytest.raises(ValueError, match="broadcast"):
        with_differences(result, both, wrong)


def shared(left, own=()):
    """As Together, of recordings that leave so much, some with effects of their own."""
    return SimpleNamespace(
        names=sorted(left), left=lambda: left, values=lambda name: {},
        with_one_of_their_own=lambda: set(own),
    )  # fmt: skip


@pytest.mark.parametrize(
    "unexplained, own, searched",
    [("", (), "cbad"), ("c", (), "c"), ("b", (), "cb"), ("c", ("a", "d"), "cad")],
)
def test_once_a_recording_is_not_explained_only_some_are_searched(
    unexplained, own, searched
):
    gap = GapMeasure(9.0, 9.0, 1.0, 0.3)
    result = GapResult("gap_unnamed", "All.", (), [], gap, (), {}, [])
    asked = []

    def alone(name):
        asked.append(name)
        verdict = "gap_unnamed" if name == unexplained else "no_gap"
        its = GapResult(verdict, "", (), [], gap, (), {}, [])
        return Alone(name, None, None, its)

    four = shared({"a": 2.0, "b": 3.0, "c": 4.0, "d": 1.0}, own)
    out = with_differences(result, four, alone)
    assert "".join(asked) == searched
    rest = ", ".join(sorted(set("abcd") - set(searched)))
    said = f"since {unexplained} is not explained by itself either: {rest}."
    assert out.says == "All." + f" Not searched separately, {said}" * bool(rest)


@pytest.mark.parametrize("cold, own", [(0.0, {"warm"}), (0.5, set())])
def test_a_recording_that_an_effect_of_its_own_would_explain_is_told(
    scene, tmp_path, cold, own
):
    """Not if the same value explains both."""
    paths = [log(tmp_path, "cold", 3, cold), log(tmp_path, "warm", 4, damping=0.5)]
    problem = MechanismProblem(read_scene(scene), read_recordings(paths))
    start = Comparison(problem, print).start
    nothing = Selection((), start, start, problem.nuisances())
    both = Together(problem, nothing)
    assert both.names == ["cold", "warm"]
    left = both.left()
    assert left["warm"] > 3.0 and (left["cold"] < 2.0) == (cold == 0.0)
    assert both.with_one_of_their_own() == own
    there = Together(problem, select(problem, lambda text: None))
    values = there.values("warm")["joint_viscous_damping", ("rig.hinge",)]
    value, std = values["damping"]
    assert value == pytest.approx(0.5, abs=max(5.0 * std, 0.02))


def test_an_effect_in_one_of_two_recordings_is_named_for_that_one(scene, tmp_path):
    paths = [log(tmp_path, "cold", 3), log(tmp_path, "warm", 4, damping=0.5)]
    result = run_gap(scene, paths)
    assert result.verdict == "gap_named"
    (found,) = result.effects
    assert (found.kind, found.recordings) == ("joint_viscous_damping", ("warm",))
    assert found.parameters["damping"].value == pytest.approx(0.5, rel=0.02)
    (differs,) = result.differs
    assert abs(differs.recordings["cold"].value) < 3 * differs.recordings["cold"].std
    assert "it is not the same in all recordings" in result.says
    # The robot's scene has it not; the recording's own has.
    assert result.scene_effects() == []
    files = write_report(result, read_scene(scene), tmp_path / "out")
    assert tmp_path / "out" / "scene_warm.yaml" in files
    assert read_scene(tmp_path / "out" / "scene_warm.yaml").effects
    json.dumps(result.to_json(), allow_nan=False)


def test_an_effect_in_both_recordings_is_named_once(scene, tmp_path):
    paths = [log(tmp_path, name, 5 + k, damping=0.5) for k, name in enumerate("ab")]
    result = run_gap(scene, paths)
    assert [e.kind for e in result.effects] == ["joint_viscous_damping"]
    assert result.differs == () and result.effects[0].recordings == ()


def test_a_recording_that_does_not_show_a_parameter_contradicts_none():
    assert _apart({"a": (1.3, 0.05), "b": (0.0, 0.05)}, 0.0) > 5.0
    assert _apart({"a": (1.3, 0.05), "b": (0.0, 0.5)}, 0.0) == 0.0
    assert _apart({"a": (1.3, 0.05), "b": (0.0, np.inf)}, 0.0) == 0.0
    assert _apart({"a": (1.3, 0.01), "b": (1.1, 0.01)}, 0.0) == 0.0  # 15 % apart.


def test_beside_guessed_gains_only_what_explains_all_is_named():
    guess = Finding(GUESSED_GAINS, "a", "time", 0.0, "", "warning", "They are a guess.")
    found = NamedEffect("link_mass", ("rig.rod",), {}, "", Evidence(9.0, 1.0, "", 1.0))
    gap = GapMeasure(368.0, 79.7, 1.0, 0.3)
    result = GapResult("gap_named", "", (), [found], gap, (), {}, [guess])
    after = unless_doubtful(result)
    assert (after.verdict, after.effects) == ("gap_unnamed", [])
    assert "guess" in after.says
    explained = replace(result, gap=replace(gap, after=1.2))
    assert unless_doubtful(explained) == explained
    known = replace(result, checks=[])
    assert unless_doubtful(known) == known


def test_where_nothing_drives_the_joints_only_what_explains_all_is_named():
    """Named were a rotor's inertia and a link's mass, in the place of the torques."""
    check = Finding(NO_DRIVE, "a", "time", 0.0, "", "warning", "Nothing drives it.")
    found = NamedEffect("link_mass", ("rig.rod",), {}, "", Evidence(9.0, 1.0, "", 1.0))
    gap = GapMeasure(460.0, 198.0, 1.0, 0.3)
    result = GapResult("gap_named", "", (), [found], gap, (), {}, [check])
    after = unless_doubtful(result)
    assert (after.verdict, after.effects) == ("gap_unnamed", [])
    assert after.says.endswith("Nothing drives it.") and after.gap.after == 460.0
    passive = replace(result, gap=replace(gap, after=1.2))  # A pendulum that swings.
    assert unless_doubtful(passive) == passive


@pytest.mark.parametrize("kind", [NO_DRIVE, NO_COLUMN])
def test_a_gap_where_nothing_drives_the_joints_says_so(kind):
    """So does one where the log has joints' columns that nobody took for theirs."""
    check = Finding(kind, "a", "time", 0.0, "", "warning", "Nothing drives it.")
    gap = GapMeasure(460.0, 460.0, 1.0, 0.3)
    result = GapResult("gap_unnamed", "A gap.", (), [], gap, (), {}, [check])
    assert unless_doubtful(result).says == "A gap. Nothing drives it."
    agrees = replace(result, verdict="no_gap")
    assert unless_doubtful(agrees) == agrees


def test_a_gain_within_the_masses_tolerance_is_told_from_a_larger_one(scene, tmp_path):
    recordings = read_recordings([log(tmp_path, "a", 10)])
    rig = ["rig.hinge"]
    for tolerance, gain, within in ((0.03, 0.98, True), (0.03, 1.05, False),
                                    (0.01, 0.98, False)):  # fmt: skip
        known = replace(read_scene(scene), tolerance={"link_mass": tolerance})
        problem = MechanismProblem(known, recordings)
        effect = Effect("actuator_gain", rig, {"gain": gain})
        assert problem.is_within_tolerance(effect) is within
    friction = Effect("joint_coulomb_friction", rig, {"coulomb": 0.01})
    assert not problem.is_within_tolerance(friction)


@pytest.mark.parametrize("within", [False, True])
def test_a_member_of_a_group_within_the_tolerance_must_show_by_itself(within):
    """Both gains are 20 deviations off; the second takes 7 % off its joint, less than
    the 10 % that one effect alone must take."""
    rng = np.random.default_rng(0)
    m, channel = 6000, np.arange(6000) % 2
    train = np.arange(m) // 20 % 3 != 1
    columns = [np.where(channel == k, rng.standard_normal(m), 0.0)[:, None]
               for k in range(2)]  # fmt: skip
    left = rng.standard_normal(m) + columns[0][:, 0] + 0.4 * columns[1][:, 0]
    members = [
        Candidate("actuator_gain", (f"r.j{k}",), 1, (x,),
                  (lambda c: {"gain": 1.0 + 0.04 * c[0]},))
        for k, x in enumerate(columns)
    ]  # fmt: skip

    def is_within(effect):
        return within and abs(effect.parameters["gain"] - 1.0) < 0.03

    search = SimpleNamespace(
        train=train, channel=channel,
        problem=SimpleNamespace(is_within_tolerance=is_within), sizes=None,
    )  # fmt: skip
    screen = Screen(left, np.zeros((m, 0)), np.zeros(0), train)
    assert _needless_member(search, screen, members) == (1 if within else None)


@pytest.mark.parametrize(
    "start, end, follows",
    [
        ((1.0, 2.5), (1.0, 2.4), True),
        ((1.0, 2.5), (1.0, 1.05), False),  # With it, nothing goes together any more.
        ((1.3, 2.5), (1.0, 2.4), False),  # Another channel gains.
        ((1.0, 2.5), (1.0, 2.5), True),
    ],
)
def test_an_effect_that_leaves_the_noise_it_was_found_in_is_none(start, end, follows):
    """Each pair: the error with noise that goes together taken out, and with it in."""
    problem = SimpleNamespace(
        error=lambda fitted: fitted.left[0], noise_error=lambda left: left[1]
    )
    fits = [SimpleNamespace(left=each) for each in (start, end)]
    selection = SimpleNamespace(start=fits[0], end=fits[1])
    assert _follows_noise(problem, selection) is follows
