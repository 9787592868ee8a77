from dataclasses import replace

import numpy as np
import pytest
from pydrake.geometry import Box, HalfSpace
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.station import BALL_ROLLING
from makebreak.models import scene_schema
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS
from makebreak.models.scene import (
    InitialSection,
    initial_for,
    load_scene,
    read_scene,
    set_initial_velocities,
)
from makebreak.models.typed_yaml import nearest
from makebreak.scripts.runner.session import Session

G = 9.81
RADIUS, MASS = 0.0315, 0.07

BALL_SCENE = f"""
directives:
  - add_model: {{name: table, file: "{MODELS}/table.sdf"}}
  - add_weld: {{parent: world, child: table::table}}
  - add_model: {{name: ball, file: "{MODELS}/ball.sdf"}}
initial:
  poses: {{ball.ball: [1, 0, 0, 0, 0.1, 0, 0.0315]}}
  body_velocities: {{ball.ball: [0, 0, 0, 0, 0, 0]}}
"""

# A sledge on four small spheres: a box on a box touches at one point only.
SLEDGE = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="sledge"><link name="sledge">
<inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia>
</inertial>%s</link></model></sdf>"""
FOOT = """<collision name="foot_%d"><pose>%g %g -0.01 0 0 0</pose><geometry><sphere>
<radius>0.01</radius></sphere></geometry><drake:proximity_properties>
<drake:mu_dynamic>0.5</drake:mu_dynamic><drake:mu_static>0.5</drake:mu_static>
</drake:proximity_properties></collision>"""
SLEDGE_SCENE = f"""
directives:
  - add_model: {{name: table, file: "{MODELS}/table.sdf"}}
  - add_weld: {{parent: world, child: table::table}}
  - add_model: {{name: sledge, file: sledge.sdf}}
initial:
  poses: {{sledge.sledge: [1, 0, 0, 0, -0.1, 0, 0.02]}}
  body_velocities: {{sledge.sledge: [0, 0, 0, 1.0, 0, 0]}}
"""


def simulate(scene, times):
    """The floating body's x, y, z and velocity at each time, and the plant."""
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    simulator = Simulator(builder.Build())
    context = loaded.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    set_initial_velocities(loaded, context)
    rows = []
    for time in times:
        simulator.AdvanceTo(time)
        q = loaded.plant.GetPositions(context)
        v = loaded.plant.GetVelocities(context)
        rows.append(np.concatenate([q[4:7], v[3:6]]))
    return np.array(rows), loaded.plant


@pytest.fixture
def ball_scene(tmp_path):
    (tmp_path / "ball.yaml").write_text(BALL_SCENE)
    return read_scene(tmp_path / "ball.yaml")


@pytest.fixture
def sledge_scene(tmp_path):
    feet = [(x, y) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    text = SLEDGE % "".join(FOOT % (i, *foot) for i, foot in enumerate(feet))
    (tmp_path / "sledge.sdf").write_text(text)
    (tmp_path / "sledge.yaml").write_text(SLEDGE_SCENE)
    return read_scene(tmp_path / "sledge.yaml")


def with_effect(scene, kind, at, **parameters):
    return replace(scene, effects=[Effect(kind, [at], parameters)])


def rolling(scene, speed):
    """The scene with the ball rolling along x."""
    initial = replace(
        scene.initial,
        body_velocities={"ball.ball": [0.0, speed / RADIUS, 0.0, speed, 0.0, 0.0]},
    )
    return replace(scene, initial=initial)


def test_scene_file_is_the_default_state():
    builder = DiagramBuilder()
    loaded = load_scene(BALL_ROLLING, builder)
    context = loaded.plant.CreateDefaultContext()
    q = loaded.plant.GetPositions(context)
    positions = list(loaded.scene.initial.positions.values())
    np.testing.assert_array_equal(q[:7], positions)
    np.testing.assert_array_equal(q[7:], [1, 0, 0, 0, 0.6, 0, 0.0315])
    assert loaded.plant.time_step() == 0.001
    assert loaded.effects == ()


def test_continuous_scene_and_gravity_of_the_file_hold(ball_scene):
    # Free fall: z = z0 - g t^2/2 with g = 2, integrated to the default accuracy 1e-3.
    plant_section = replace(ball_scene.plant, time_step=0.0, gravity=[0.0, 0.0, -2.0])
    initial = replace(ball_scene.initial, poses={"ball.ball": [1, 0, 0, 0, 0, 0, 1.0]})
    scene = replace(ball_scene, plant=plant_section, initial=initial)
    rows, plant = simulate(scene, [0.5])
    assert plant.time_step() == 0.0
    np.testing.assert_allclose(rows[0, 2], 1.0 - 2.0 * 0.5**2 / 2, atol=1e-3)


@pytest.mark.parametrize("parameters", [{"radius": 0.0365}, {"scale": 0.0365 / RADIUS}])
def test_resized_ball_rests_at_its_radius_and_has_its_inertia(ball_scene, parameters):
    scene = with_effect(ball_scene, "object_size", "ball", **parameters)
    scene.initial.poses["ball.ball"] = [1, 0, 0, 0, 0.1, 0, 0.037]
    rows, plant = simulate(scene, [0.5])
    # The contact gives way by m g / stiffness = 7 um.
    np.testing.assert_allclose(rows[0, 2], 0.0365 - MASS * G / 1e5, atol=1e-6)
    inertia = plant.GetBodyByName("ball").default_rotational_inertia().get_moments()
    np.testing.assert_allclose(inertia, 0.4 * MASS * 0.0365**2, rtol=1e-4)
    np.testing.assert_allclose(plant.GetBodyByName("ball").default_mass(), MASS)


def test_resizing_keeps_the_surface_and_leaves_the_scene_as_it_was(ball_scene, caplog):
    scene = with_effect(ball_scene, "object_size", "ball.ball", scale=1.2)
    uris = [d.add_model.file for d in scene.directives if d.add_model is not None]
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    after = [d.add_model.file for d in scene.directives if d.add_model is not None]
    assert uris == after
    assert not caplog.records
    inspector = loaded.scene_graph.model_inspector()
    (g,) = loaded.plant.GetCollisionGeometriesForBody(
        loaded.plant.GetBodyByName("ball")
    )
    properties = inspector.GetProximityProperties(g)
    assert properties.GetProperty("material", "point_contact_stiffness") == 2e5
    np.testing.assert_allclose(inspector.GetShape(g).radius(), 1.2 * RADIUS)


@pytest.mark.parametrize("mu", [0.1, 0.3, 0.8])
@pytest.mark.parametrize("at", ["sledge~table", "table.table~sledge.sledge"])
def test_sledge_slows_by_mu_g(sledge_scene, mu, at):
    scene = with_effect(sledge_scene, "contact_friction", at, friction=mu)
    # After 20 ms the feet have settled; then v falls evenly.
    rows, _ = simulate(scene, [0.02, 0.1])
    slowing = (rows[0, 3] - rows[1, 3]) / 0.08
    np.testing.assert_allclose(slowing, mu * G, rtol=2e-3)


def test_friction_of_the_ball_with_the_table_leaves_its_other_pairs_alone():
    scene = with_effect(
        read_scene(BALL_ROLLING), "contact_friction", "ball~table", friction=0.8
    )
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    inspector = loaded.scene_graph.model_inspector()

    def surface(name):
        body = loaded.plant.GetBodyByName(name)
        g = loaded.plant.GetCollisionGeometriesForBody(body)[0]
        properties = inspector.GetProximityProperties(g)
        return properties.GetProperty("material", "coulomb_friction").dynamic_friction()

    ball, table, finger = (surface(name) for name in ("ball", "table", "finger"))
    np.testing.assert_allclose(2 * ball * table / (ball + table), 0.8)
    np.testing.assert_allclose(2 * ball * finger / (ball + finger), 0.5)


@pytest.mark.parametrize("coefficient", [0.002, 0.02])
def test_rolling_ball_slows_by_five_sevenths_of_c_g(ball_scene, coefficient):
    # c R m g turns the ball against 7/5 m R^2 about the contact: a = 5/7 c g. The
    # first steps settle; the torque is one step late: 1 ms of 0.4 s.
    scene = with_effect(
        rolling(ball_scene, 0.3),
        "rolling_resistance",
        "ball~table",
        coefficient=coefficient,
    )
    rows, _ = simulate(scene, [0.1, 0.5])
    slowing = (rows[0, 3] - rows[1, 3]) / 0.4
    np.testing.assert_allclose(slowing, 5 / 7 * coefficient * G, rtol=5e-3)


def test_rolling_resistance_stops_the_ball_and_never_turns_it_back(ball_scene):
    # 0.02 m/s is gone after 0.02/(5/7 0.02 g) = 0.14 s. Below the fade rate of
    # 0.05 rad/s, which is 1.6 mm/s, the rest dies away.
    scene = with_effect(
        rolling(ball_scene, 0.02), "rolling_resistance", "table~ball", coefficient=0.02
    )
    rows, _ = simulate(scene, np.arange(0.01, 1.0, 0.01))
    assert rows[:, 3].min() > -1e-5
    assert abs(rows[-1, 3]) < 1e-4


def test_without_resistance_the_ball_rolls_on(ball_scene):
    rows, _ = simulate(rolling(ball_scene, 0.3), [0.1, 1.0])
    np.testing.assert_allclose(rows[1, 3], rows[0, 3], rtol=1e-6)


def test_two_resistances_add_up(ball_scene):
    effects = [
        Effect("rolling_resistance", ["ball~table"], {"coefficient": 0.004}),
        Effect("rolling_resistance", ["ball.ball~table"], {"coefficient": 0.006}),
    ]
    rows, _ = simulate(replace(rolling(ball_scene, 0.3), effects=effects), [0.1, 0.5])
    slowing = (rows[0, 3] - rows[1, 3]) / 0.4
    np.testing.assert_allclose(slowing, 5 / 7 * 0.01 * G, rtol=5e-3)


@pytest.mark.parametrize(
    "kind, at, parameters, words",
    [
        ("rolling_resistence", "ball~table", {}, "did you mean rolling_resistance"),
        ("contact_friction", "ball~table", {"fricton": 1}, "did you mean friction"),
        (
            "contact_friction",
            "ball~table",
            {"friction": -0.1},
            "is -0.1, expected >= 0",
        ),
        ("contact_friction", "ball~table", {"friction": np.nan}, "friction is nan"),
        ("contact_friction", "ball~chair", {"friction": 1}, "no model 'chair'"),
        ("contact_friction", "ball", {"friction": 1}, "expected one contact pair"),
        ("contact_friction", "ball~ball", {"friction": 1}, "names one body twice"),
        ("rolling_resistance", "ball~table", {}, "needs `coefficient`"),
        ("rolling_resistance", "ball~table", {"coefficient": -1}, "expected >= 0"),
        ("object_size", "ball", {}, "needs `scale` or `radius`"),
        ("object_size", "ball", {"scale": 0}, "scale is 0, expected > 0"),
        ("object_size", "ball", {"scale": 2, "radius": 0.05}, "disagree"),
        ("object_size", "table", {"radius": 0.05}, "one collision sphere"),
        ("object_size", "chair", {"scale": 2}, "no model 'chair'"),
        ("object_size", "ball.bell", {"scale": 2}, "expected one link of ball.sdf"),
    ],
)
def test_bad_effects_are_refused_by_name(ball_scene, kind, at, parameters, words):
    scene = with_effect(ball_scene, kind, at, **parameters)
    with pytest.raises(ValueError, match=words) as error:
        load_scene(scene, DiagramBuilder())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, words",
    [
        ("directives: []\neffect: []", "effect"),
        (
            "plant: {time_step: -1}",
            "plant.time_step: got .-1., expected a number",
        ),
        ("plant: {gravity: [0, 0]}", "expected \\[x, y, z\\]"),
        ("actuation: {type: motor}", "actuation.type is 'motor'"),
        ("effects: [{kind: object_size}]", "needs `at`"),
        ("initial: {positions: {panda.joint_1: 0}}", "no joint 'panda.joint_1'"),
        ("initial: {position: {panda.joint_1: 0}}", "position"),
        ("initial: {poses: {ball.ball: [1, 0, 0]}}", "expected 7 numbers|no body"),
        ("directives: [{add_model: {name: a, file: none.sdf}}]", "none.sdf"),
        ("- a\n- b", "scene file"),
    ],
)
def test_bad_scene_files_are_refused_in_one_line(tmp_path, text, words):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        load_scene(tmp_path / "bad.yaml", DiagramBuilder())
    assert "\n" not in str(error.value)


def test_approximation_that_drake_no_longer_has_is_refused(ball_scene, monkeypatch):
    """As with Drake 1.58, whose DiscreteContactApproximation has no kTamsi."""
    section = replace(ball_scene.plant, discrete_contact_approximation="tamsi")
    scene = replace(ball_scene, plant=section)
    monkeypatch.setattr(scene_schema, "DiscreteContactApproximation", object)
    with pytest.raises(ValueError, match="got tamsi, which Drake 1.58 no longer has"):
        load_scene(scene, DiagramBuilder())


def test_each_episode_of_a_recording_may_start_from_its_own_state(tmp_path):
    (tmp_path / "s.yaml").write_text(
        BALL_SCENE[: BALL_SCENE.index("initial:")]
        + """
initial:
  throw_1.csv:
    0: {poses: {ball.ball: [1, 0, 0, 0, 0.1, 0, 0.5]}}
    1: {poses: {ball.ball: [1, 0, 0, 0, 0.2, 0, 0.5]}}
  throw_2: {0: {body_velocities: {ball.ball: [0, 0, 0, 1, 0, 0]}}}
"""
    )
    scene = read_scene(tmp_path / "s.yaml")
    assert initial_for(scene, "a/throw_1.csv", 1).poses["ball.ball"][4] == 0.2
    assert initial_for(scene, "throw_1.csv", None).poses["ball.ball"][4] == 0.1
    assert initial_for(scene, "throw_2.npz", 0).body_velocities["ball.ball"][3] == 1
    assert initial_for(scene, "throw_3.csv", 0) == scene.initial == InitialSection()
    load_scene(scene, DiagramBuilder())


def test_missing_scene_file_is_named(tmp_path):
    with pytest.raises(ValueError, match="none.yaml does not exist"):
        read_scene(tmp_path / "none.yaml")


def test_nearest_name_or_all_names():
    assert nearest("object_sise", KINDS) == ("did you mean object_size or object_mass?")
    assert nearest("zzz", ["b", "a"]) == "expected one of: b, a"
    many = [f"name_{i}" for i in range(20)]
    assert nearest("lane", many).startswith("nearest of 20: name_")
    assert nearest("lane", many).count(",") == 2


def test_model_files_are_found_in_a_folder_with_an_odd_name(tmp_path):
    folder = tmp_path / "a b%20c#d \u00fc"
    folder.mkdir()
    for name in ("table.sdf", "ball.sdf"):
        (folder / name).write_text((MODELS / name).read_text())
    path = folder / "s.yaml"
    path.write_text(BALL_SCENE.replace(f"{MODELS}/", ""))
    scene = read_scene(path)
    edited = with_effect(scene, "object_size", "ball", scale=1.0)  # Writes a copy.
    for each in (scene, edited):
        rows, _ = simulate(each, [0.1])
        # The contact gives way by m g / stiffness = 7 um.
        np.testing.assert_allclose(rows[0, :3], [0.1, 0, RADIUS], atol=2e-5)


def test_initial_velocities_act_in_a_session(ball_scene, tmp_path):
    # 1.5 m/s along x, no spin, 0.3 m above the table: free flight for 0.2 s.
    initial = replace(
        ball_scene.initial,
        poses={"ball.ball": [1, 0, 0, 0, 0, 0, 0.3]},
        body_velocities={"ball.ball": [0, 0, 0, 1.5, 0, 0]},
    )
    builder = DiagramBuilder()
    loaded = load_scene(replace(ball_scene, initial=initial), builder)
    builder.ExportOutput(loaded.plant.get_state_output_port(), "state")
    diagram = builder.Build()
    with Session(tmp_path / "out", None) as session:
        log = session.simulate(diagram, 0.2, {"state": diagram.GetOutputPort("state")})
        session.finish()
    np.testing.assert_allclose(log["state"][:, -3], 1.5, rtol=1e-12)
    np.testing.assert_allclose(log["state"][-1, 4], 1.5 * 0.2, rtol=1e-9)


@pytest.mark.parametrize("legs", [3, 20])
def test_half_spaces_among_many_shapes_are_large_boxes(tmp_path, legs):
    """Of few they stay: Drake's tree of these is never made anew."""
    links = "".join(
        f'<link name="leg{k}"><inertial><mass value="0.1"/><inertia ixx="1e-3" '
        'ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial><collision>'
        '<geometry><sphere radius="0.02"/></geometry></collision></link>'
        f'<joint name="j{k}" type="revolute"><parent link="base"/>'
        f'<child link="leg{k}"/><origin xyz="{k} 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" '
        'effort="9" velocity="9"/></joint>'
        for k in range(legs)
    )
    (tmp_path / "robot.urdf").write_text(
        f'<robot name="robot"><link name="base"/>{links}</robot>'
    )
    (tmp_path / "floor.sdf").write_text(
        '<sdf version="1.9"><model name="floor"><static>1</static><link name="floor">'
        '<pose>0 0 -1 0 0 0</pose><collision name="c"><geometry><plane><normal>0 0 1'
        "</normal></plane></geometry></collision></link></model></sdf>"
    )
    (tmp_path / "scene.yaml").write_text(
        "directives:\n- add_model: {name: robot, file: robot.urdf}\n"
        "- add_weld: {parent: world, child: robot::base}\n"
        "- add_model: {name: floor, file: floor.sdf}\n"
    )
    loaded = load_scene(tmp_path / "scene.yaml", DiagramBuilder())
    inspector = loaded.scene_graph.model_inspector()
    (floor,) = loaded.plant.GetCollisionGeometriesForBody(
        loaded.plant.GetBodyByName("floor")
    )
    shape, X = inspector.GetShape(floor), inspector.GetPoseInFrame(floor)
    assert isinstance(shape, HalfSpace if legs < 14 else Box)
    top = X.translation()[2] + (0.5 * shape.height() if legs > 14 else 0.0)
    assert top == pytest.approx(0.0)
    assert inspector.GetProximityProperties(floor) is not None
