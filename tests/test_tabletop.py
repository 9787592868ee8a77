import numpy as np
import pytest
from pydrake.geometry import Role
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.station import (
    SensorNoise,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.tabletop import (
    SURFACE_SWITCH,
    TABLETOP_WALLS,
    THREE_SURFACES,
    TOOL,
    TOOLS,
    draw_stiffness,
    move,
    objects,
    position,
    set_friction,
    set_stiffness,
    set_tool,
    tool_half_width,
)
from makebreak.models.scene import load_scene, read_scene
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.numerics.impedance_controller import rotation_error
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import chain_state, tip_kinematics
from makebreak.systems.arm.numerics.tip_state import tip_pose, tip_velocity

SCENES = [TABLETOP_WALLS, THREE_SURFACES, SURFACE_SWITCH]
START = np.array([0.42, -0.16, 0.195])
BLOCK = TOOLS["block"][1]


def loaded(scene):
    """The plant and its context, and a function that gives the contacts at q."""
    builder = DiagramBuilder()
    scene = load_scene(scene, builder)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    plant_context = scene.plant.GetMyMutableContextFromRoot(root)
    graph_context = scene.scene_graph.GetMyMutableContextFromRoot(root)

    def contacts(q):
        scene.plant.SetPositions(plant_context, q)
        query = scene.scene_graph.get_query_output_port().Eval(graph_context)
        inspector = query.inspector()

        def name(geometry):
            frame = inspector.GetFrameId(geometry)
            body = scene.plant.GetBodyFromFrameId(frame)
            return scene.plant.GetModelInstanceName(body.model_instance())

        return [
            (name(p.id_A), name(p.id_B), p.depth)
            for p in query.ComputePointPairPenetration()
        ]

    return scene, contacts


def reach(chain, q, p):
    """Joint angles that bring the upright tip to p, from q."""
    for _ in range(200):
        p_now, R, J = tip_kinematics(chain, q)
        error = np.concatenate([p - p_now, rotation_error(np.eye(3), R)])
        q = q + np.clip(np.linalg.pinv(J, 1e-3) @ error, -0.1, 0.1)
    assert np.abs(error).max() < 1e-9
    return q


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("tool", TOOLS)
def test_the_tip_starts_upright_above_the_table(scene, tool):
    scene = read_scene(scene)
    set_tool(scene, tool)
    plant = make_control_plant(scene, TOOL)
    context = plant.CreateDefaultContext()
    X = plant.GetFrameByName("tip").CalcPoseInWorld(context)
    # The scene's angles have six digits.
    np.testing.assert_allclose(X.translation(), START, atol=2e-6)
    np.testing.assert_allclose(RollPitchYaw(X.rotation()).vector(), 0.0, atol=3e-6)
    assert plant.num_actuators() == 7
    tool_mass = plant.GetBodyByName("tool").default_mass()
    np.testing.assert_allclose(tool_mass, 0.3)


@pytest.mark.parametrize(
    "corners",
    [
        # Down 0.18, +y 0.32, +x 0.2 m; with all positions 5 cm away, either way.
        [(0, 0, -0.18), (0, 0.32, -0.18), (0.2, 0.32, -0.18)],
        [(0, 0, -0.23), (0, 0.37, -0.23), (0.25, 0.37, -0.23)],
        [(0, 0, -0.13), (0, 0.27, -0.13), (0.15, 0.27, -0.13)],
        # Figure 15: up the blue wall, over, and down onto the red block.
        [(0.2, 0.32, -0.18), (0.2, 0.32, -0.04), (0.15, 0.46, -0.04)],
        [(0.15, 0.46, -0.04), (0.1, 0.46, -0.12), (0.0, 0.56, -0.12)],
        # All over the plates.
        [(-0.12, -0.14, -0.18), (0.28, -0.14, -0.18), (0.28, 0.46, -0.18)],
        [(0.08, 0.16, -0.18), (-0.12, 0.46, -0.18), (0.2, -0.02, -0.18)],
    ],
)  # fmt: skip
def test_every_joint_keeps_a_margin_over_the_workspace(corners):
    plant = make_control_plant(TABLETOP_WALLS, TOOL)
    chain = serial_chain_of(plant, "tip")
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    q = plant.GetPositions(plant.CreateDefaultContext())
    at = START
    for corner in corners:
        to = START + corner
        for s in np.linspace(0.1, 1.0, 10):
            q = reach(chain, q, at + s * (to - at))
            assert np.minimum(q - lower, upper - q).min() > 0.25  # [rad]
        at = to


def test_nothing_touches_at_the_start_and_the_places_are_as_the_scene_says():
    _, contacts = loaded(read_scene(TABLETOP_WALLS))
    plant = make_control_plant(TABLETOP_WALLS, TOOL)
    chain = serial_chain_of(plant, "tip")
    q = plant.GetPositions(plant.CreateDefaultContext())
    assert contacts(q) == []
    for name, p in (
        ("table", (0.42, -0.16, BLOCK)),
        ("red_block", (0.5, 0.16, 0.04)),
        ("blue_wall", (0.62, 0.0, 0.04)),
    ):
        direction = {"table": (0, 0, -1), "red_block": (0, 1, 0)}.get(name, (1, 0, 0))
        away, into = (
            reach(chain, q, np.array(p) + s * np.array(direction))
            for s in (-1e-4, 1e-4)
        )
        assert contacts(away) == []
        touching = contacts(into)
        # Four corners of one face, each as deep as the tip went too far.
        assert [{a, b} for a, b, _ in touching] == [{TOOL, name}] * 4
        np.testing.assert_allclose([d for _, _, d in touching], 1e-4, atol=1e-8)


def test_surfaces_are_one_flat_body_where_they_meet():
    for scene, seam in ((THREE_SURFACES, (0.5, 0.0)), (SURFACE_SWITCH, (0.6, 0.0))):
        plant = make_control_plant(scene, TOOL)
        chain = serial_chain_of(plant, "tip")
        q = plant.GetPositions(plant.CreateDefaultContext())
        _, contacts = loaded(read_scene(scene))
        # A foot over a seam of two boxes would touch both of them.
        for foot in (0.0, 0.012):
            p = np.array([seam[0] - foot, seam[1] - foot, BLOCK - 1e-4])
            touching = contacts(reach(chain, q, p))
            assert [{a, b} for a, b, _ in touching] == [{TOOL, "surfaces"}] * 4
            np.testing.assert_allclose([d for *_, d in touching], 1e-4, atol=1e-8)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.6, 1.0])
def test_friction_with_the_tool_is_what_was_asked_for(friction):
    scene = read_scene(TABLETOP_WALLS)
    set_friction(scene, {"table": friction, "blue_wall": 0.25})
    inside, _ = loaded(scene)
    inspector = inside.scene_graph.model_inspector()

    def mu(model):
        instance = inside.plant.GetModelInstanceByName(model)
        body = inside.plant.get_body(inside.plant.GetBodyIndices(instance)[0])
        geometry = inside.plant.GetCollisionGeometriesForBody(body)[0]
        properties = inspector.GetProperties(geometry, Role.kProximity)
        return properties.GetProperty("material", "coulomb_friction").dynamic_friction()

    for name, expected in (("table", friction), ("blue_wall", 0.25)):
        combined = 2 * mu(TOOL) * mu(name) / (mu(TOOL) + mu(name))
        np.testing.assert_allclose(combined, expected, atol=1e-12)
    combined = 2 * mu(TOOL) * mu("red_block") / (mu(TOOL) + mu("red_block"))
    np.testing.assert_allclose(combined, 0.3, atol=1e-12)


@pytest.mark.parametrize("tool, points", [("sphere", 1), ("block", 4)])
def test_each_surface_has_the_stiffness_that_was_asked_for(tool, points):
    asked = {"table": 5e3, "red_block": 2e5, "blue_wall": 3.3e4}
    scene = read_scene(TABLETOP_WALLS)
    set_tool(scene, tool)
    set_stiffness(scene, tool, asked)
    inside, _ = loaded(scene)
    inspector = inside.scene_graph.model_inspector()

    def stiffness(model):
        instance = inside.plant.GetModelInstanceByName(model)
        body = inside.plant.get_body(inside.plant.GetBodyIndices(instance)[0])
        values = {
            inspector.GetProperties(g, Role.kProximity).GetProperty(
                "material", "point_contact_stiffness"
            )
            for g in inside.plant.GetCollisionGeometriesForBody(body)
        }
        (value,) = values
        return value

    for name, k in asked.items():  # Springs in a row, as Drake combines them.
        pair = 1.0 / (1.0 / stiffness(TOOL) + 1.0 / stiffness(name))
        np.testing.assert_allclose(points * pair, k, rtol=1e-9)


def test_stiffness_is_drawn_evenly_over_its_logarithm():
    rng = np.random.default_rng(0)
    k = [draw_stiffness(rng, "ab", (5e3, 2e5)) for _ in range(2000)]
    u = np.log(np.array([list(one.values()) for one in k]) / 5e3) / np.log(40.0)
    # Uniform in (0, 1): deciles within four standard deviations of 400 +- 19.
    assert np.all(abs(np.histogram(u, 10, (0.0, 1.0))[0] - 400) < 76)
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.1
    assert draw_stiffness(rng, "a", (2e4, 2e4)) == {"a": pytest.approx(2e4)}
    for span in ((2e5, 5e3), (0.0, 1.0), (1.0,), (1.0, np.inf)):
        with pytest.raises(ValueError, match="stiffness is .* expected two numbers"):
            draw_stiffness(rng, "a", span)


def test_objects_are_moved_in_memory_alone():
    scene = read_scene(TABLETOP_WALLS)
    assert objects(scene) == ["table", "red_block", "blue_wall"]
    move(scene, "red_block", [0.0, -0.03, 0.01])
    np.testing.assert_allclose(position(scene, "red_block"), [0.52, 0.145, 0.01])
    inside, _ = loaded(scene)
    X = inside.plant.GetBodyByName("red_block").EvalPoseInWorld(
        inside.plant.CreateDefaultContext()
    )
    np.testing.assert_allclose(X.translation(), [0.52, 0.145, 0.01])
    again = read_scene(TABLETOP_WALLS)
    np.testing.assert_allclose(position(again, "red_block"), [0.52, 0.175, 0.0])


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda s: set_tool(s, "blok"), "tool is 'blok': did you mean block"),
        (lambda s: tool_half_width("ball"), "tool is 'ball'"),
        (lambda s: move(s, "red_blok", [0, 0, 0]), "did you mean red_block"),
        (lambda s: move(s, "table", [0, np.nan, 0]), "table is to be moved by"),
        (lambda s: set_friction(s, {"wall": 0.3}), "no object 'wall'"),
        (lambda s: set_friction(s, {"table": -0.1}), "friction of table is -0.1"),
        (lambda s: set_friction(s, {"table": np.nan}), "friction of table is nan"),
        (lambda s: set_stiffness(s, "block", {"wall": 1e4}), "no object 'wall'"),
        (lambda s: set_stiffness(s, "bloc", {}), "tool is 'bloc'"),
        (lambda s: set_stiffness(s, "block", {"table": 0.0}), "table is 0.0, expected"),
        (lambda s: move(s, "panda", [0, 0, 0]), "no object 'panda'"),
    ],
)
def test_wrong_names_and_values_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong(read_scene(TABLETOP_WALLS))


def test_station_takes_any_tool_and_any_partners():
    config = StationConfig(
        scene=TABLETOP_WALLS, tool=TOOL, contact=[TOOL, "table", "red_block"]
    )
    station = make_station(config)
    assert station.GetOutputPort("state").size() == 14
    assert station.GetOutputPort("contact_force").size() == 8
    assert station.GetOutputPort("tool.contact_force").size() == 3
    with pytest.raises(ValueError, match="tool names 'finger', which is not in"):
        make_station(StationConfig(scene=TABLETOP_WALLS))


def test_contact_forces_on_the_tool_add_up_and_are_the_wrist_s():
    # The block in the corner of table and red block, with zero velocity.
    scene = read_scene(TABLETOP_WALLS)
    plant = make_control_plant(scene, TOOL)
    chain = serial_chain_of(plant, "tip")
    q = plant.GetPositions(plant.CreateDefaultContext())
    depth = np.array([0.0, 2e-4, -1e-4])
    q = reach(chain, q, np.array([0.5, 0.16, BLOCK]) + depth)
    for i in range(7):
        scene.initial.positions[f"panda.panda_joint{i + 1}"] = float(q[i])
    station = make_station(
        StationConfig(
            tool=TOOL, contact=[TOOL, "table", "red_block"], scene=TABLETOP_WALLS
        ),
        scene=scene,
    )
    context = station.CreateDefaultContext()
    station.GetInputPort("panda.torque_commanded").FixValue(context, np.zeros(7))
    force = station.GetOutputPort("tool.contact_force").Eval(context)
    partners = station.GetOutputPort("contact_force").Eval(context).reshape(2, 4)
    np.testing.assert_allclose(force, -partners[:, 1:].sum(axis=0), atol=1e-9)
    J = tip_kinematics(chain, q)[2]
    torque = station.GetOutputPort("panda.contact_torque").Eval(context)
    # The moment about the tip is not zero: compare along the null space of its rows.
    wrench = np.linalg.lstsq(J.T, torque, rcond=None)[0]
    np.testing.assert_allclose(wrench[:3], force, atol=1e-6)


def test_tip_pose_and_velocity_agree_with_drake():
    plant = make_control_plant(TABLETOP_WALLS, TOOL)
    chain = serial_chain_of(plant, "tip")
    context = plant.CreateDefaultContext()
    tip = plant.GetFrameByName("tip")
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, v = rng.uniform(-1.5, 1.5, 7), rng.normal(size=7)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        X, V = tip.CalcPoseInWorld(context), tip.CalcSpatialVelocityInWorld(context)
        pose = tip_pose(packed(chain), q)
        w_x_y_z = X.rotation().ToQuaternion().wxyz()
        expected = [*X.translation(), *(w_x_y_z * np.sign(w_x_y_z[0]))]
        np.testing.assert_allclose(pose, expected, atol=1e-12)
        expected = [*V.translational(), *V.rotational()]
        np.testing.assert_allclose(
            tip_velocity(packed(chain), q, v), expected, atol=1e-12
        )


def test_sampled_sensors_are_read_once_per_step_and_cost_no_other_contact():
    # The wrench of a step is what the contact of that very step gives: without noise
    # the tool's m a is all that is left, 0.3 kg with (16 N / 5 kg) at most.
    scene = read_scene(TABLETOP_WALLS)
    plant = make_control_plant(scene, TOOL)
    chain = serial_chain_of(plant, "tip")
    q = plant.GetPositions(plant.CreateDefaultContext())
    q = reach(chain, q, np.array([0.42, -0.16, BLOCK - 2e-4]))
    for i in range(7):
        scene.initial.positions[f"panda.panda_joint{i + 1}"] = float(q[i])
    config = dict(scene=TABLETOP_WALLS, tool=TOOL, contact=[TOOL, "table"])
    noise = SensorNoise(1e-5, 1e-3, 0.1, 0.0, 0.0)
    station = make_station(
        StationConfig(**config, sampled=True, noise=noise), scene=scene
    )
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    hold = chain_state(chain, q, np.zeros(7)).bias
    station.GetInputPort("panda.torque_commanded").FixValue(context, hold)
    read = {
        name: station.GetOutputPort(name).Eval
        for name in ("panda.external_wrench", "panda.position_measured")
    }
    np.testing.assert_array_equal(read["panda.external_wrench"](context), 0.0)
    force = station.GetOutputPort("tool.contact_force")
    previous = None
    for step in range(5):
        # Before the step: its contact, from the state and torque it starts with.
        simulator.AdvanceTo(step * 1e-3)
        context.SetTime(step * 1e-3)
        before = force.Eval(context)
        simulator.AdvanceTo(step * 1e-3 + 1e-4)
        wrench = read["panda.external_wrench"](context)
        np.testing.assert_allclose(wrench[:3], before, atol=0.3 * 16.0 / 5.0)
        encoders = read["panda.position_measured"](context)
        simulator.AdvanceTo(step * 1e-3 + 9e-4)
        np.testing.assert_array_equal(wrench, read["panda.external_wrench"](context))
        np.testing.assert_array_equal(
            encoders, read["panda.position_measured"](context)
        )
        restored = station.CreateDefaultContext()
        restored.SetTimeStateAndParametersFrom(context)
        station.GetInputPort("panda.torque_commanded").FixValue(restored, hold)
        np.testing.assert_array_equal(
            encoders, read["panda.position_measured"](restored)
        )
        assert previous is None or np.abs(encoders - previous).min() > 0.0
        previous = encoders
