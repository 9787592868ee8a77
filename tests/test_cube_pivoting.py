import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.cube_pivoting import (
    LEGEND,
    logged_forces,
    make_cube_pivoting,
    make_model,
    start,
    weights_of,
)
from makebreak.diagrams.cube_pivoting_config import (
    FINGERS,
    SCENE,
    Cube,
    CubePivotingConfig,
    PivotModel,
    PivotPlanner,
    PivotStart,
    contact_pairs,
    initial_state,
    model_cube,
    scene_with,
    world_cube,
)
from makebreak.models.model_files import MODELS
from makebreak.models.scene import load_scene
from makebreak.scripts.cli import main
from makebreak.scripts.experiments import cube_pivoting as experiment
from makebreak.scripts.runner import comparison
from makebreak.scripts.runner.session import Log
from makebreak.scripts.runner.settings import apply_settings
from makebreak.scripts.runner.trials import setting_texts
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs
from makebreak.systems.contact_mpc.numerics.lcs import simulate
from makebreak.systems.contact_mpc.numerics.pivot_target import (
    LEFT,
    RIGHT,
    THETA,
    corners,
)

G = 9.81


def standing(side=0.1, theta=0.0):
    """x of a cube that stands on the platform, the fingers beside it."""
    x = np.zeros(14)
    x[:3] = 0.0, 0.5 * side, theta
    x[LEFT], x[RIGHT] = [-side, 0.06], [side, 0.06]
    return x


def simulated(config, duration, x=None):
    """The diagram and its context after `duration` [s]."""
    diagram = make_cube_pivoting(config)
    x = initial_state(config) if x is None else x
    simulator = Simulator(diagram, start(diagram, x))
    simulator.AdvanceTo(duration)
    return diagram, simulator.get_context()


def test_without_a_planner_the_cube_rests_and_the_fingers_hang_where_they_are():
    builder = DiagramBuilder()
    loaded = load_scene(scene_with(SCENE, Cube(0.5, 0.6, 0.08)), builder)
    diagram, plant = builder.Build(), loaded.plant
    simulator = Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    x = standing(side=0.08)
    plant.SetPositionsAndVelocities(context, x)
    efforts = weights_of(plant)
    np.testing.assert_allclose(efforts, [0.0, 0.3 * G, 0.0, 0.3 * G], rtol=1e-5)
    for i, finger in enumerate(FINGERS):
        port = plant.get_actuation_input_port(plant.GetModelInstanceByName(finger))
        port.FixValue(context, efforts[2 * i : 2 * i + 2])
    simulator.AdvanceTo(1.0)
    found = plant.GetPositionsAndVelocities(context)
    # Two corners of 1e4 N/m each give way by m g / 2e4.
    x[1] -= 0.6 * G / 2e4
    np.testing.assert_allclose(found, x, atol=1e-6)
    results = plant.get_contact_results_output_port().Eval(context)
    forces = [
        results.point_pair_contact_info(i).contact_force()
        for i in range(results.num_point_pair_contacts())
    ]
    assert len(forces) == 2
    np.testing.assert_allclose(abs(sum(forces)), [0.0, 0.0, 0.6 * G], atol=1e-3)


@pytest.mark.parametrize("friction, slides", [(0.5, False), (0.3, True)])
def test_the_world_has_the_friction_that_was_asked_for(friction, slides):
    """On a platform under sideways gravity of 0.4 g."""
    scene = scene_with(SCENE, Cube(friction, 0.4, 0.1))
    scene = replace(scene, plant=replace(scene.plant, gravity=[0.4 * G, 0.0, -G]))
    builder = DiagramBuilder()
    plant = load_scene(scene, builder).plant
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    x = standing()
    x[LEFT], x[RIGHT] = [-0.5, 0.3], [0.5, 0.3]  # They fall, far away.
    plant.SetPositionsAndVelocities(context, x)
    for finger in FINGERS:
        port = plant.get_actuation_input_port(plant.GetModelInstanceByName(finger))
        port.FixValue(context, [0.0, 0.0])
    simulator.AdvanceTo(0.2)
    speed = plant.GetVelocities(context)[0]
    expected = (0.4 - friction) * G * 0.2 if slides else 0.0
    assert speed == pytest.approx(expected, abs=0.01)


def test_the_model_is_what_its_cube_says_and_its_fingers_have_no_weight():
    cube = Cube(0.5, 0.6, 0.08)
    model = make_model(scene_with(SCENE, cube))
    lcs = AnitescuLcs(model, contact_pairs(cube.friction), 0.01, eps_c=0.0)
    x = standing(side=0.08)
    x[1] += 0.05  # In the air: everything is free.
    x_next, lam = simulate(lcs.build(x, np.zeros(4)), x, np.zeros(4))
    assert (lam == 0.0).all()
    np.testing.assert_allclose(x_next[7:] / 0.01, [0, -G, *5 * [0.0]], atol=1e-9)
    # A force on a finger that touches nothing: 1 N on 0.3 kg, damped by 2 N s/m.
    x_next, _ = simulate(lcs.build(x, np.zeros(4)), x, np.array([1.0, 0, 0, 0]))
    assert x_next[10] == pytest.approx(0.01 / 0.3, rel=0.07)
    # Standing, its two lower corners carry the weight, and no gap is left.
    x = standing(side=0.08)
    built = lcs.build(x, np.zeros(4))
    x_next, lam = simulate(built, x, np.zeros(4))
    np.testing.assert_allclose(x_next, x, atol=1e-9)
    # Corners and carriages weigh 3 mg more.
    assert lam.sum() == pytest.approx(0.6 * G, rel=1e-5)


def test_a_cube_is_pivoted_gently():
    config = CubePivotingConfig(seed=3, planner=PivotPlanner(rate=1.5))
    x0 = initial_state(config)
    diagram, context = simulated(config, 3.0, x0)
    x = diagram.GetOutputPort("x").Eval(context)
    assert abs(x[THETA] - np.pi / 2) < experiment.ANGLE_BOUND
    place = experiment.standing_place(x0, 0.1) + 0.1
    assert abs(x[0] - place) < experiment.PLACE_BOUND
    assert abs(x[7:10]).max() < 0.01
    time, force = logged_forces(diagram, context)
    assert len(time) == 3001 and force.max() < experiment.FORCE_BOUND
    # Fingers did it, and at the end the platform alone carries the cube.
    assert force[:, 0].max() > 0.5
    np.testing.assert_allclose(force[-1, 2], 0.4 * G, rtol=0.05)
    assert diagram.GetOutputPort("c3_status").Eval(context) == [0.0]


@pytest.mark.parametrize("size_error", [0.9, 1.1])
def test_the_learner_finds_how_much_too_near_or_far_the_faces_are(size_error):
    """Each is wrong by half the error of the side, 5 mm."""
    config = CubePivotingConfig(
        seed=0, model=PivotModel(size_error=size_error), adapt=True
    )
    diagram, context = simulated(config, 1.0)
    gap = config.planner.period_sec * diagram.GetOutputPort("r_comp").Eval(context)
    _, force = logged_forces(diagram, context)
    truth = 0.05 * (size_error - 1.0)
    # The left finger pushes, and is felt to a millimetre: it moves 1 mm in a period.
    assert force[-1, 0] > 0.3
    np.testing.assert_allclose(gap[:2], truth, atol=1e-3)
    # Corners: 5 mm as it stands, and more by and by as it turns to stand on an edge.
    assert np.ptp(gap[4:8]) == 0.0 and 0.9 < gap[4] / truth < np.sqrt(2.0)
    assert (gap[8:] == 0.0).all()  # No finger on the platform.


def test_a_cube_modelled_too_small_is_tipped_sooner_with_the_learner():
    config = CubePivotingConfig(seed=3, model=PivotModel(size_error=0.9))
    angles = []
    for adapt in (False, True):
        diagram, context = simulated(replace(config, adapt=adapt), 3.0)
        angles.append(diagram.GetOutputPort("x").Eval(context)[THETA])
    assert angles[0] < 0.5 and abs(angles[1] - np.pi / 2) < experiment.ANGLE_BOUND


def test_without_adaptation_there_is_no_residual():
    diagram, context = simulated(
        CubePivotingConfig(model=PivotModel(size_error=0.9)), 0.2
    )
    assert (diagram.GetOutputPort("r_comp").Eval(context) == 0.0).all()


def test_a_plan_is_made_of_the_state_and_the_lcs_of_its_own_instant():
    diagram, context = simulated(CubePivotingConfig(seed=3), 0.3005)
    (x, plan, lcs) = (
        port.Eval(system.GetMyContextFromRoot(context))
        for system, port in (
            (system, system.GetOutputPort(name))
            for system, name in (
                (diagram.GetSubsystemByName("plant"), "state"),
                (diagram.GetSubsystemByName("c3"), "plan"),
                (diagram.GetSubsystemByName("lcs"), "lcs"),
            )
        )
    )
    assert plan.time == pytest.approx(0.3 + 2e-4) and abs(x[7:]).max() > 1e-3
    np.testing.assert_array_equal(plan.x[0], x)
    model = diagram.GetSubsystemByName("lcs").model
    np.testing.assert_array_equal(lcs.phi, model.build(x, np.zeros(4)).phi)
    # A polished plan is the rollout of its inputs, so C3 had this LCS.
    x_next, _ = simulate(lcs, x, plan.u[0])
    np.testing.assert_allclose(plan.x[1], x_next, atol=1e-9)


def test_fingers_are_asked_for_no_more_than_force_max():
    config = CubePivotingConfig(seed=3, planner=PivotPlanner(force_max=0.2))
    diagram = make_cube_pivoting(config)
    simulator = Simulator(diagram, start(diagram, initial_state(config)))
    largest = 0.0
    for k in range(1, 26):
        simulator.AdvanceTo(0.02 * k)
        u = diagram.GetOutputPort("u").Eval(simulator.get_context())
        largest = max(largest, abs(u).max())
    assert largest == 0.2


def test_seed_draws_the_start_and_the_friction_within_their_ranges():
    config = CubePivotingConfig(start=PivotStart(friction=[0.3, 0.9]))
    found = []
    for seed in range(20):
        c = replace(config, seed=seed)
        x = initial_state(c)
        np.testing.assert_array_equal(x, initial_state(c))
        found.append([*x[:7], world_cube(c).friction])
        outline = corners(x, 0.1)
        assert outline[:, 1].min() == pytest.approx(1e-3)
        assert 0.01 <= outline[:, 0].min() - x[3] - 0.012 <= 0.06
        assert 0.01 <= x[5] - 0.012 - outline[:, 0].max() <= 0.06
        assert (x[7:] == 0.0).all()
    x, _, theta, _, left, _, right, friction = np.array(found).T
    for values, low, high in (
        (x, -0.15, -0.05),
        (theta, -0.15, 0.15),
        (left, 0.02, 0.12),
        (right, 0.02, 0.12),
        (friction, 0.3, 0.9),
    ):
        assert low <= values.min() < values.max() <= high
        assert np.ptp(values) > 0.6 * (high - low)


def test_world_and_model_differ_by_the_errors_alone():
    config = CubePivotingConfig(mass=0.5, size=0.8)
    assert world_cube(config) == model_cube(config)
    wrong = replace(config, model=PivotModel(0.5, 2.0, 1.1))
    world, model = world_cube(wrong), model_cube(wrong)
    assert world == world_cube(config)
    assert (world.mass, world.side) == (0.5, pytest.approx(0.08))
    assert model.friction == pytest.approx(0.5 * world.friction)
    assert (model.mass, model.side) == (1.0, pytest.approx(0.088))
    diagram = make_cube_pivoting(wrong)
    plant = diagram.GetSubsystemByName("plant")
    assert plant.GetBodyByName("cube").default_mass() == 0.5


@pytest.mark.parametrize(
    "words, message",
    [
        ("mass=-1", "mass is -1.0, expected > 0"),
        ("model.size_error=0", "model.size_error is 0.0, expected > 0"),
        ("start.friction=[0.5]", "start.friction is [0.5], expected [low, high]"),
        ("start.friction=[1,0.5]", "start.friction is [1.0, 0.5], expected"),
        ("start.height=[0.1,0.05]", "start.height is [0.1, 0.05], expected"),
        ("start.height=[-0.05,-0.05]", "expected [low, high] with 0.013 <= low"),
        ("start.distance=[0,0]", "expected [low, high] with 0.001 <= low"),
        ("start.tilt=-0.1", "start.tilt is -0.1, expected >= 0"),
        ("planner.force_max=0", "planner.force_max is 0.0, expected a positive"),
        ("planner.rate=0", "rate is 0.0, expected > 0"),
        ("world=cartpole_walls.scene.yaml", "pivot"),
    ],
)
def test_bad_settings_are_told_in_one_line(words, message, tmp_path, capsys):
    arguments = ["run", "cube_pivoting", "--no-meshcat", "--out", str(tmp_path / "a")]
    if words.startswith("world"):
        words = "world=" + SCENE.replace("cube_pivoting", "cartpole_walls")
    assert main([*arguments, "--set", words]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error.splitlines()[-1]


def log_of(theta, x=0.0, speed=0.0):
    """A log of 2 s in which a cube that stood at -0.1 m ends so."""
    time = np.arange(101) * 0.02
    states = np.zeros((101, 14))
    states[:, 1] = 0.05
    states[0, 0], states[1:, 0] = -0.1, x
    states[50:, THETA], states[:, 7] = theta, speed
    columns = {"x": states, "u": np.zeros((101, 4)), "c3_status": np.zeros((101, 1))}
    return Log(time, columns, False, None, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "log, force, missed",
    [
        (log_of(np.pi / 2), 39.0, set()),
        (log_of(np.pi / 2 + 0.11), 39.0, {"met_angle"}),
        (log_of(np.pi / 2, x=0.021), 39.0, {"met_place"}),
        (log_of(np.pi / 2, x=-0.021), 39.0, {"met_place"}),
        (log_of(np.pi / 2, speed=0.03), 39.0, {"met_rest"}),
        (log_of(np.pi / 2), 41.0, {"met_force"}),
    ],
)
def test_each_criterion_is_judged_by_itself(log, force, missed):
    forces = np.zeros((2001, 6))
    forces[7, 4] = force
    result = experiment.score(log, np.arange(2001) * 1e-3, forces, 0.1)
    assert {key for key in result if key.startswith("met_") and not result[key]} == (
        missed
    )
    assert result["success"] == (not missed)
    assert result["force_max_N"] == force
    if "met_angle" not in missed:
        assert result["time_to_goal_s"] == pytest.approx(1.0)


@pytest.mark.parametrize("theta", [-0.2, 0.0, 0.2])
def test_a_tilted_cube_falls_back_on_the_face_beside_its_lower_edge(theta):
    x = standing(theta=theta)
    edge = {-0.2: 0, 0.2: 1}.get(theta)
    place = experiment.standing_place(x, 0.1)
    if edge is None:
        assert place == 0.0
    else:  # That edge stays where it is.
        flat = standing()
        flat[0] = place
        assert corners(flat, 0.1)[edge, 0] == pytest.approx(corners(x, 0.1)[edge, 0])


def test_reproduce_counts_each_variant_and_its_commands_are_those_that_ran(
    monkeypatch, tmp_path
):
    asked = []

    def run_many(name, runs, jobs, out_dir, reuse):
        asked.extend(runs)
        good = {"success": True, "time_to_goal_s": 2.0, "force_max_N": 30.0}
        return [
            good if settings != {"mass": 0.8} or seed == 0 else {"success": False}
            for settings, seed in runs
        ]

    monkeypatch.setattr(comparison, "run_many", run_many)
    table = experiment.reproduce(SimpleNamespace(out_dir=tmp_path, reuse=False), 3, 1)
    rows = {row[0]: row for row in table.rows}
    assert len(rows) == len(experiment.VARIANTS) and len(asked) == 3 * len(rows)
    assert (
        rows["as it is"][2].startswith("3 of 3")
        and "at most 30 N" in (rows["as it is"][2])
    )
    assert rows["twice as heavy"][2].startswith("1 of 3")
    assert table.met[0] and set(table.met[1:]) == {None}
    for (_, _, _, command), settings in zip(
        table.rows, experiment.VARIANTS.values(), strict=True
    ):
        words = command.partition("--set ")[2].split()
        ours = apply_settings(CubePivotingConfig(), words)
        given = apply_settings(CubePivotingConfig(), setting_texts(settings))
        assert ours == given


def test_meshcat_shows_cube_and_fingers():
    meshcat = Meshcat()
    config = CubePivotingConfig()
    diagram = make_cube_pivoting(config, meshcat)
    Simulator(diagram, start(diagram, initial_state(config))).AdvanceTo(0.01)
    for path in ("pivot/cube", "left/finger", "right/finger", "pivot/platform"):
        assert meshcat.HasPath(f"/drake/visualizer/{path}"), path
    assert meshcat.HasPath("/makebreak/legend/lines")
    for path in ("/Grid", "/Axes"):  # Not seen; as MessagePack writes false.
        assert meshcat._GetPackedProperty(path, "visible").endswith(b"\xc2")
    model = (MODELS / "cube_pivoting.sdf").read_text()
    model += (MODELS / "planar_finger.sdf").read_text()
    for _, color in LEGEND:  # Which are those of the models.
        assert f"<diffuse>{color.r():g} {color.g():g} {color.b():g} 1<" in model


def test_command_line_writes_result_recording_and_model(tmp_path, capsys):
    out = tmp_path / "a"
    words = [
        "--set",
        "planner.rate=1.5",
        "size=0.9",
        "model.mass_error=1.1",
        "adapt=true",
    ]
    arguments = ["run", "cube_pivoting", "--no-meshcat", "--seed", "3", *words]
    assert main([*arguments, "--out", str(out), "--duration", "3"]) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["success"] and result["plans_failed"] == 0
    assert 1.0 < result["time_to_goal_s"] < 2.5
    assert 0.0 < abs(result["residual_corners_m"]) < 1e-3
    for name in ("pivot.png", "motion.png"):
        assert (out / name).stat().st_size > 10_000
    head = (out / "recording.csv").read_text().splitlines()[0]
    for column in ("pivot.angle.position", "right.z.velocity", "left.x.effort_command"):
        assert column in head
    model = (out / "model.yaml").read_text()
    assert "0.44" in model and "scale: 0.9" in model
