"""`makebreak design-log`: motions within limits that tell parameters best."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effect_scenes import double, pendulum, with_effects

from makebreak.gap import run_gap
from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.table import write_recording
from makebreak.gap.design import LogDesign, LogPlan
from makebreak.gap.numerics.excitation import (
    DesignProblem,
    Excitation,
    Limits,
    Series,
    design,
    excesses,
    information,
)
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.model_export import to_mjcf
from makebreak.models.scene import ActuationSection, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.models.typed_yaml import read_yaml
from makebreak.scripts.cli import main

ALL = {"": 4.0}
PLAN = LogPlan(6.0, 3.0, 3, 100.0, 0.01, ALL, {"": 20.0}, {"": 15.0})


def driven(scene, joints):
    return replace(scene, actuation=ActuationSection(type="effort", joints=joints))


def test_series_begin_and_end_at_rest_and_are_each_others_derivatives():
    series = Series(period=3.0, harmonics=4)
    some = np.random.default_rng(0).normal(size=(series.free, 2))
    motion = Excitation(series, np.array([0.3, -1.0]), some)
    for rest in motion.at(np.array([0.0, 3.0]))[1:]:
        np.testing.assert_allclose(rest, 0.0, atol=1e-12)
    time, step = np.linspace(0.1, 2.9, 30), 1e-5
    after, before = motion.at(time + step), motion.at(time - step)
    for k in (0, 1):  # Central differences: an error of the order of step^2.
        found = (after[k] - before[k]) / (2.0 * step)
        np.testing.assert_allclose(found, motion.at(time)[k + 1], atol=1e-6)


def test_information_is_that_of_models_whose_parameters_are_changed(tmp_path):
    """Columns by differences of the inverse dynamics of scenes with the effects."""
    scene = driven(double(tmp_path), ["d.j1", "d.j2"])
    named = ["joint_viscous_damping", "rotor_inertia@d.j2", "link_mass@d.lower"]
    wanted = LogDesign(scene, [*named, "link_com@d.upper"], PLAN)
    time = np.linspace(0.0, 3.0, 25)
    rng = np.random.default_rng(0)
    some = rng.normal(size=(wanted.problem.series.free, 2))
    motion = Excitation(wanted.problem.series, np.zeros(2), some).at(time)
    columns, _ = wanted.regressor(*motion)
    k = wanted.problem.named
    found = information(columns[:, :, :k], wanted.problem.weights)
    by_difference = []
    for kind, at, name, _ in wanted.parameters[:k]:
        efforts = []
        # Both sides where the model is not linear, and damping below 0 is refused.
        sizes = (1e-4, -1e-4 if kind == "link_com" else 0.0)
        for size in sizes:
            parameters = dict.fromkeys("xyz", 0.0) if kind == "link_com" else {}
            changed = with_effects(scene, (kind, at, parameters | {name: size}))
            efforts.append(SceneDynamics(changed).inverse_dynamics(*motion))
        by_difference.append((efforts[0] - efforts[1]) / (sizes[0] - sizes[1]))
    W = np.stack(by_difference, axis=2)
    sigma = 0.01 * 15.0  # PLAN's noise of its limit; its samples for ours, evenly.
    share = 600.0 / len(wanted.problem.time)
    expected = share * np.einsum("ija,ijb->ab", W, W) / sigma**2
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # Along an axis, where no column has an entry but rounding.
    scale[scale < 1e-12 * scale.max()] = 1.0
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-6)


def test_the_slope_of_the_search_is_that_of_its_value(tmp_path):
    problem = LogDesign(driven(double(tmp_path), ["d.j1", "d.j2"]), (), PLAN).problem
    rng = np.random.default_rng(0)
    x = 0.5 * rng.normal(size=2 * (1 + problem.series.free))  # Beyond the limits.
    _, slope = problem.value(x, 10.0)
    for i in rng.choice(len(x), 5, replace=False):
        d = 1e-5 * (np.arange(len(x)) == i)
        found = (problem.value(x + d, 10.0)[0] - problem.value(x - d, 10.0)[0]) / 2e-5
        # Dry friction fades within a narrow band of speeds: differences of another
        # step see another slope there.
        assert slope[i] == pytest.approx(found, rel=2e-2, abs=2e-2)


def test_nuisances_cost_what_their_covariance_says():
    """Of named parameters: det of the block of the inverse, as it is marginalised."""
    series, rng = Series(2.0, 2), np.random.default_rng(0)
    columns = rng.normal(size=(20, 1, 4))
    limits = Limits(*(s * np.ones(1) for s in (-1.0, 1.0, 1.0, 1.0, 1.0)))
    prior = np.array([np.inf, 2.0, 0.1, 0.3])
    problem = DesignProblem(
        lambda q, v, vd: (columns, q), series, limits, 0.5 * np.ones(1), prior, 2, 160.0
    )
    M = 160.0 / 16 * columns[:, 0].T @ columns[:, 0] / 0.25 + np.diag(prior**-2.0)
    expected = np.linalg.slogdet(np.linalg.inv(M)[:2, :2])[1]
    # In units of the priors of the two named.
    assert problem.score(columns)[0] == pytest.approx(expected - 2.0 * np.log(2.0))


def test_a_designed_motion_keeps_its_limits_and_beats_random_ones(tmp_path):
    named = ["joint_viscous_damping", "joint_coulomb_friction", "link_com"]
    wanted = LogDesign(driven(pendulum(tmp_path), ["p.j1"]), named, PLAN)
    found = design(wanted.problem, starts=1)
    motion = found.at(np.linspace(0.0, 3.0, 2000))
    over = excesses(motion, wanted.effort(*motion), wanted.limits)
    assert over.max() < 0.0
    assert over.max() > -0.15  # It uses what there is.
    rng = np.random.default_rng(0)

    def volume(excitation):
        return wanted.problem.score(
            wanted.regressor(*excitation.at(wanted.problem.time))[0]
        )[0]

    for _ in range(10):  # As large as the limits allow.
        x = rng.normal(size=1 + wanted.problem.series.free)
        x[:1] *= 0.2
        other = wanted.problem.within(wanted.problem.motion_of(3.0 * x), 0.95)
        assert volume(found) < volume(other)


def test_deviations_are_the_scatter_of_least_squares(tmp_path):
    wanted = LogDesign(
        driven(pendulum(tmp_path), ["p.j1"]),
        ["joint_viscous_damping", "link_mass"],
        PLAN,
    )
    found = design(wanted.problem, starts=1)
    told = {p.name: p.after for p in wanted.predicted(found)}
    n = 600
    time = 3.0 * np.arange(n) / 300
    W = wanted.regressor(*found.at(time))[0][:, 0]
    rng = np.random.default_rng(0)
    prior = wanted.problem.prior
    scale = np.vstack([W / 0.15, np.diag(1.0 / prior)])
    fits = []
    for _ in range(400):
        true = prior * rng.normal(size=len(prior)) * (np.arange(len(prior)) > 1)
        y = W @ true + 0.15 * rng.normal(size=n)
        fit = np.linalg.lstsq(scale, np.append(y / 0.15, np.zeros(len(prior))), None)[0]
        fits.append((fit - true)[:2])
    # 400 draws know a standard deviation to 3.5 %; the prior pulls by less.
    np.testing.assert_allclose(
        np.std(fits, axis=0), [told["damping"], told["mass"]], rtol=0.12
    )


def test_the_command_writes_a_table_to_play(tmp_path, capsys):
    pendulum(tmp_path)
    words = ["design-log", str(next(tmp_path.glob("*.urdf"))), "--seconds", "6"]
    words += ["--period", "3", "--harmonics", "2", "--out", str(tmp_path / "out")]
    words += ["--for", "joint_viscous_damping", "link_com"]
    assert main(words) == 2
    lacks = "no limits of velocity (p.j1) and effort (p.j1): give --velocity and"
    assert lacks in capsys.readouterr().err
    assert main([*words, "--velocity", "4", "--effort", "p.j1=15", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    rows = {
        row["parameter"]: row["standard deviation"] for row in told["tables"][0]["rows"]
    }
    assert 0.0 < rows["joint_viscous_damping damping"] < 0.1
    # Along its axis, which the centre of mass turns about.
    assert rows["link_com y"] == "not told by efforts"
    assert (tmp_path / "out" / "design.png").is_file()
    (model,) = read_yaml(tmp_path / "out" / "scene.yaml")["directives"][:1]
    assert model["add_model"]["file"].startswith("../")  # Both can be moved together.
    log = read_recording(tmp_path / "out" / "design.csv")
    assert len(log.time) == 601
    assert np.abs(log["p.j1.velocity_command"]).max() <= 0.95 * 4.0 + 1e-9


@pytest.mark.parametrize("actuator", [True, False])
def test_limits_are_those_of_the_urdf_with_and_without_a_transmission(
    tmp_path, actuator
):
    limit = '<limit lower="-1" upper="1" effort="9" velocity="4"/>'
    scene = pendulum(tmp_path, joint=limit, actuator=actuator)
    plan = replace(PLAN, velocity={}, effort={})
    limits = LogDesign(scene, ["joint_viscous_damping"], plan).problem.limits
    share = limits.velocity[0] / 4.0  # A margin is kept of each.
    assert 0.9 < share <= 1.0
    assert limits.effort[0] == pytest.approx(9.0 * share)
    with pytest.raises(ValueError, match=r"no limits of effort \(p.j1\)"):
        pendulum(tmp_path, joint=limit.replace('"9"', '"0"'), actuator=False)
        LogDesign(scene, ["joint_viscous_damping"], plan)


def test_a_robot_whose_meshes_are_not_there_has_a_motion_too(tmp_path):
    """As `gap` takes it: without what it would touch."""
    pendulum(tmp_path)
    file = next(tmp_path.glob("*.urdf"))
    mesh = '<geometry><mesh filename="package://far_away/rod.stl"/></geometry>'
    text = file.read_text()
    file.write_text(text.replace("</link>", f"<collision>{mesh}</collision></link>"))
    words = ["design-log", str(file), "--seconds", "6", "--period", "3"]
    words += ["--harmonics", "2", "--for", "joint_viscous_damping", "--velocity", "4"]
    out = tmp_path / "out"
    assert main([*words, "--effort", "15", "--out", str(out)]) == 0
    (model,) = read_yaml(out / "scene.yaml")["directives"][:1]
    copy = out / model["add_model"]["file"]
    assert copy.is_file() and "far_away" not in copy.read_text()


def test_what_cannot_be_designed_is_one_line(tmp_path):
    scene = driven(double(tmp_path), ["d.j1", "d.j2"])
    for words, says in (
        (["joint_viscus_damping"], "did you mean joint_viscous_damping"),
        (["joint_backlash"], "not linear in the efforts"),
        (["link_mass@d.nothing"], "link_mass cannot be at d.nothing"),
    ):
        with pytest.raises(ValueError, match=says):
            LogDesign(scene, words, PLAN)
    weak = LogDesign(scene, (), replace(PLAN, effort={"": 1.0})).problem
    level = np.array([0.5 * np.pi, 0.0])  # The upper link weighs 4.4 N m there.
    still = Excitation(weak.series, level, np.zeros((weak.series.free, 2)))
    with pytest.raises(ValueError, match="joint 1 cannot hold still"):
        weak.within(still, 0.95)
    with pytest.raises(ValueError, match="not driven: d.j2"):
        LogDesign(driven(double(tmp_path), ["d.j1"]), (), PLAN)


HIDDEN = (
    ("joint_coulomb_friction", "d.j2", dict(coulomb=0.25)),
    ("joint_viscous_damping", "d.j2", dict(damping=0.15)),
    ("joint_coulomb_friction", "d.j1", dict(coulomb=0.5)),
)


def played(scene, commands, rng):
    """A log of MuJoCo's: the true arm follows commands of 1 kHz under a stiff law, its
    efforts are measured, 100 a second, with PLAN's noise."""
    model = mujoco.MjModel.from_xml_string(to_mjcf(scene).text)
    data, time = mujoco.MjData(model), commands["time"]
    assert model.opt.timestep == pytest.approx(time[1])
    q, v, effort = (
        np.column_stack([commands[f"d.j{k}.{what}_command"] for k in (1, 2)])
        for what in ("position", "velocity", "effort")
    )
    data.qpos[:] = q[0]
    rows = []
    for k in range(len(time)):
        at, speed = data.qpos.copy(), data.qvel.copy()
        data.ctrl[:] = effort[k] + 200.0 * (q[k] - at) + 10.0 * (v[k] - speed)
        rows.append([time[k], *at, *data.ctrl])
        mujoco.mj_step(model, data)
    rows = np.array(rows[::10])
    assert np.abs(rows[:, 1:3] - q[::10]).max() < 0.05  # It follows.
    rows[:, 1:3] += 1e-4 * rng.normal(size=(len(rows), 2))
    rows[:, 3:] += 0.15 * rng.normal(size=(len(rows), 2))
    whats = ("position", "effort_measured")
    names = ["time", *(f"d.j{k}.{what}" for what in whats for k in (1, 2))]
    return dict(zip(names, rows.T, strict=True))


@pytest.mark.slow
def test_gap_knows_more_from_a_designed_log_than_from_random_ones(tmp_path):
    """Of the same length, within the same limits, from another simulator."""
    scene = driven(double(tmp_path), ["d.j1", "d.j2"])
    write_scene(scene, tmp_path / "scene.yaml")
    truth = with_effects(scene, *HIDDEN)
    plan = replace(PLAN, seconds=12.0)
    wanted = LogDesign(scene, [f"{kind}@{at}" for kind, at, _ in HIDDEN], plan)
    found = wanted.solve()
    rng = np.random.default_rng(0)
    free = wanted.problem.series.free
    motions = [found.excitation]
    for _ in range(3):
        x = np.append(0.3 * rng.uniform(-1, 1, 2), rng.normal(size=2 * free))
        motions.append(wanted.problem.within(wanted.problem.motion_of(x), 0.95))
    deviations = []
    for k, excitation in enumerate(motions):
        fine = replace(found, excitation=excitation, plan=replace(plan, rate_hz=1e3))
        log = played(truth, fine.columns(), rng)
        write_recording(tmp_path / f"log_{k}.csv", log)
        result = run_gap(tmp_path / "scene.yaml", [tmp_path / f"log_{k}.csv"])
        told = {(e.kind, e.at[0]): e.parameters for e in result.effects}
        deviations.append([
            told[kind, at][name].std
            if (kind, at) in told else np.inf
            for kind, at, values in HIDDEN for name in values
        ])  # fmt: skip
        print(k, result.verdict, deviations[-1], [e.says for e in result.effects])
    designed, *random = np.array(deviations)
    assert np.isfinite(designed).all()
    # The product of the deviations is what the design makes small.
    for other in random:
        assert np.prod(designed) < np.prod(other)


def test_a_gripper_whose_fingers_go_together_stands_still(tmp_path, capsys):
    """No robot could play a motion of one finger alone."""
    pendulum(tmp_path)
    file = next(tmp_path.glob("*.urdf"))
    finger = """<link name="{0}"><inertial><mass value="0.1"/><inertia ixx="1e-4"
    iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="{0}" type="prismatic"><parent link="rod"/><child link="{0}"/>
    <axis xyz="0 1 0"/><limit lower="0.01" upper="0.1" effort="5" velocity="1"/>{1}
    </joint>"""
    mimic = '<mimic joint="left" multiplier="2" offset="0.005"/>'
    more = finger.format("right", mimic) + finger.format("left", "")
    file.write_text(file.read_text().replace("</robot>", f"{more}</robot>"))
    words = ["design-log", str(file), "--seconds", "6", "--period", "3"]
    words += ["--harmonics", "2", "--for", "joint_viscous_damping", "--velocity", "4"]
    out = tmp_path / "out"
    assert main([*words, "--effort", "15", "--out", str(out)]) == 0
    assert "still throughout: p.left 0.01, p.right 0.025" in capsys.readouterr().out
    scene = read_scene(out / "scene.yaml")
    assert scene.fixed_joints == {"p.left": 0.01, "p.right": 0.025}
    assert [n for n in read_recording(out / "design.csv").channels] == [
        f"p.j1.{what}_command" for what in ("position", "velocity", "effort")
    ]
    loose = replace(scene, fixed_joints={})
    loose.actuation.joints += ["p.left", "p.right"]
    with pytest.raises(ValueError, match="move alone: p.right follows p.left"):
        LogDesign(loose, ["joint_viscous_damping"], PLAN)
