"""The parts of push_object beside its planner, and the whole diagram for a moment."""

import re
from copy import deepcopy
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from scipy.spatial.transform import Rotation

from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.push_object import (
    PUSH_OBJECT,
    PushModelConfig,
    PushObjectConfig,
    make_push_object,
)
from makebreak.diagrams.push_object_config import WEIGHT, PushParametersConfig
from makebreak.diagrams.push_object_scenes import (
    model_object,
    model_scene,
    poses_of,
    world_scene,
)
from makebreak.models.effects.kind import Effect
from makebreak.models.pushed_object import PushedObject, object_file
from makebreak.models.scene import read_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.runner.run_timing import leaf_systems
from makebreak.systems.changing_contact.numerics.touch_down import (
    TouchDownConfig,
    TouchSpeedConfig,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, Q_BALL
from makebreak.systems.contact_mpc.numerics.parameter_posterior import Belief
from makebreak.systems.contact_mpc.numerics.push_task import (
    CONTACT,
    TRAVEL,
    errors,
    heading,
)
from makebreak.systems.contact_mpc.push_goals import (
    PushGoals,
    PushGoalsConfig,
    ReachedConfig,
    draw_poses,
    nearest_turn,
)
from makebreak.systems.perception.numerics.pose_filter import (
    corrected,
    first_pose,
    on_the_table,
    predicted,
    turn_between,
    turned,
)
from makebreak.systems.perception.pose_sensor import (
    ObjectMotionConfig,
    PoseSensor,
    PoseSensorConfig,
)
from makebreak.systems.views.contact_probe import ContactLoad

POSE = [1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.02]


def as_scipy(q):
    return Rotation.from_quat(np.roll(q, -1))


# The pose filter.


@pytest.mark.parametrize("seed", range(5))
def test_turns_are_those_of_scipy(seed):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    angle = rng.normal(size=3)
    after = turned(q, angle)
    expected = Rotation.from_rotvec(angle) * as_scipy(q)
    np.testing.assert_allclose(
        as_scipy(after).as_matrix(), expected.as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(turn_between(q, after), angle, atol=1e-9)
    np.testing.assert_allclose(turn_between(q, -after), angle, atol=1e-9)


def test_the_filter_finds_a_steady_motion_through_noise():
    rng = np.random.default_rng(0)
    v, w, std, density = np.array([0.05, -0.03, 0.0]), np.array([0, 0, 0.4]), (
        1e-3, 1e-2,
    ), (1e-4, 1e-2)  # fmt: skip
    pose = None
    for k in range(90):
        t = k / 30.0
        p = v * t + std[0] * rng.normal(size=3)
        q = turned(np.array([1.0, 0, 0, 0]), w * t)
        q = turned(q, std[1] * rng.normal(size=3))
        if pose is None:
            pose = first_pose(t, p, q, std, (0.1, 1.0))
        else:
            pose = corrected(predicted(pose, t, density), p, q, std)
    # The filter's own standard deviations, times four.
    np.testing.assert_allclose(pose.p, v * t, atol=4 * np.sqrt(pose.P_p[0]))
    np.testing.assert_allclose(pose.v, v, atol=4 * np.sqrt(pose.P_p[2]))
    np.testing.assert_allclose(pose.w, w, atol=4 * np.sqrt(pose.P_q[2]))
    assert np.sqrt(pose.P_p[0]) < 0.7e-3  # Less than one reading's.


def test_what_lies_on_a_table_is_upright_at_its_height():
    q = turned(
        turned(np.array([1.0, 0, 0, 0]), np.array([0, 0, 0.8])),
        np.array([0.05, -0.1, 0]),
    )
    p, v, q_flat, w = on_the_table(
        0.1, np.array([0.5, 0.1, 0.03]), np.array([0.2, 0, 0.4]), q,
        np.array([0.3, 0.2, 0.0]), 0.02, np.zeros(3),
    )  # fmt: skip
    np.testing.assert_allclose(p, [0.52, 0.1, 0.02])
    np.testing.assert_allclose(v, [0.2, 0.0, 0.0])
    z = as_scipy(q_flat).as_matrix()[:, 2]
    np.testing.assert_allclose(z, [0, 0, 1], atol=1e-12)
    assert heading(q_flat) == pytest.approx(0.8, abs=0.02)
    np.testing.assert_allclose(w, 0.0)


def test_a_lying_cylinder_keeps_its_roll_and_its_rolling():
    axis, yaw, roll = np.array([1.0, 0.0, 0.0]), 0.8, 2.0
    upright = Rotation.from_euler("z", yaw) * Rotation.from_euler("x", roll)
    q = turned(np.roll(upright.as_quat(), 1), np.array([0.1, -0.05, 0.0]))
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    _, _, flat, w = on_the_table(
        0.0, np.zeros(3), np.zeros(3), q, 3.0 * along + [0, 0, 0.5], 0.02, axis
    )
    R = as_scipy(flat).as_matrix()
    assert R[2, 0] == pytest.approx(0.0, abs=1e-12)  # The axis is level.
    left = (upright.inv() * as_scipy(flat)).magnitude()
    assert left < 0.12  # Only the tilt, of 0.11, has gone.
    np.testing.assert_allclose(w, 3.0 * along + [0, 0, 0.5], atol=0.2)


# The sensor.


def sensor_at(pose, **config):
    builder = DiagramBuilder()
    sensor = builder.AddSystem(PoseSensor(PoseSensorConfig(**config), 1, seed=3))
    poses = builder.AddSystem(ConstantValueSource(Value([RigidTransform(), pose])))
    builder.Connect(poses.get_output_port(), sensor.get_input_port())
    return builder.Build(), sensor


def test_a_pose_is_known_after_its_delay_and_laid_on_the_table():
    pose = RigidTransform(RotationMatrix.MakeZRotation(0.7), [0.5, 0.1, 0.05])
    diagram, sensor = sensor_at(pose, noise=[0.0, 0.0], delay_sec=0.1, height=0.02)
    simulator = Simulator(diagram)
    own = sensor.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(0.09)
    assert sensor.GetOutputPort("seen").Eval(own)[0] == 0.0
    simulator.AdvanceTo(0.15)
    assert sensor.GetOutputPort("seen").Eval(own)[0] == 1.0
    np.testing.assert_allclose(
        sensor.GetOutputPort("p_WB").Eval(own), [0.5, 0.1, 0.02], atol=1e-9
    )
    assert heading(sensor.GetOutputPort("q_WB").Eval(own)) == pytest.approx(0.7)
    assert sensor.GetOutputPort("v_WB").Eval(own)[2] == 0.0


def test_the_last_reading_is_told_as_it_was_measured_and_when():
    pose = RigidTransform(RotationMatrix.MakeXRotation(0.2), [0.5, 0.1, 0.05])
    diagram, sensor = sensor_at(pose, noise=[0.0, 0.0], delay_sec=0.1, height=0.02)
    simulator = Simulator(diagram)
    own = sensor.GetMyContextFromRoot(simulator.get_context())
    port = sensor.GetOutputPort("reading")
    simulator.AdvanceTo(0.09)
    assert port.Eval(own)[0] == -1.0
    for t, at in ((0.12, 0.0), (0.15, 1.0 / 30.0), (0.36, 7.0 / 30.0)):
        simulator.AdvanceTo(t)
        half = [np.cos(0.1), np.sin(0.1), 0.0, 0.0]
        expected = [at, 0.5, 0.1, 0.05, *half]
        np.testing.assert_allclose(port.Eval(own), expected, atol=1e-9)


def test_a_reading_that_is_older_than_what_is_kept_is_still_the_last():
    diagram, sensor = sensor_at(RigidTransform([0.5, 0.0, 0.02]), delay_sec=1.2)
    simulator = Simulator(diagram)
    own = sensor.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(1.45)
    assert sensor.GetOutputPort("reading").Eval(own)[0] == pytest.approx(7.0 / 30.0)


def test_readings_have_the_noise_that_is_asked_for():
    diagram, sensor = sensor_at(
        RigidTransform([0.5, 0.0, 0.02]), motion=ObjectMotionConfig([1e6, 1e6])
    )
    simulator = Simulator(diagram)
    own = sensor.GetMyContextFromRoot(simulator.get_context())
    seen = []
    for k in range(300):  # A filter that trusts each reading alone.
        simulator.AdvanceTo((k + 2.01) / 30.0)
        seen.append(sensor._memory_of(own).pose.p[0] - 0.5)
    # The deviation of 300 samples is known to 4 %; three of that.
    assert np.std(seen) == pytest.approx(1e-3, rel=0.12)


class Moving(LeafSystem):
    """Poses of a body that rests, and from a time on goes at a speed along x."""

    def __init__(self, since, speed):
        super().__init__()

        def calc(context, output):
            x = 0.5 + speed * max(context.get_time() - since, 0.0)
            output.set_value([RigidTransform(), RigidTransform([x, 0.0, 0.02])])

        self.DeclareAbstractOutputPort("poses", lambda: Value([RigidTransform()]), calc)


def test_the_speed_of_what_rolls_on_is_known_well_and_a_push_is_seen_as_soon():
    rest, late = {}, {}
    for axis in ([], [1.0, 0.0, 0.0]):
        builder = DiagramBuilder()
        config = PoseSensorConfig(rolling_axis=axis)
        sensor = builder.AddSystem(PoseSensor(config, 1, seed=3))
        body = builder.AddSystem(Moving(6.0, 0.15))
        builder.Connect(body.get_output_port(), sensor.get_input_port())
        simulator = Simulator(builder.Build())
        own = sensor.GetMyContextFromRoot(simulator.get_context())
        speeds = []
        for t in np.arange(1.0, 8.0, 0.05):
            simulator.AdvanceTo(t)
            speeds.append(sensor.GetOutputPort("v_WB").Eval(own)[0])
        speeds = np.array(speeds)
        rest[len(axis)] = speeds[:100].std()
        late[len(axis)] = np.flatnonzero(speeds > 0.1)[0] * 0.05 + 1.0 - 6.0
        assert speeds[-20:].mean() == pytest.approx(0.15, abs=0.01)
    assert rest[0] > 0.01 and rest[3] < 0.3 * rest[0]
    assert late[3] < late[0] + 0.06 < 0.3


# The estimator's option, and the goals.


def goals_at(x, goals, fold=1, **config):
    builder = DiagramBuilder()
    system = builder.AddSystem(PushGoals(PushGoalsConfig(**config), goals, fold))
    state = builder.AddNamedSystem("x", ConstantVectorSource(x))
    seen = builder.AddSystem(ConstantVectorSource([1.0]))
    builder.Connect(state.get_output_port(), system.GetInputPort("x"))
    builder.Connect(seen.get_output_port(), system.GetInputPort("valid"))
    return builder.Build(), system


def test_a_goal_is_over_when_it_is_reached_for_a_while_or_its_time_is_up():
    x = np.zeros(N_X)
    x[Q_BALL], x[P_BALL] = (
        turned(np.array([1.0, 0, 0, 0]), np.array([0, 0, 3.1])),
        [0.5, 0, 0.02],
    )
    near = [0.51, 0.005, -3.12]  # 11 mm, 0.06 rad the shorter way round.
    far = [0.6, 0.0, 0.0]
    diagram, system = goals_at(
        x, [near, far, near], limit_sec=2.0, reached=ReachedConfig(dwell_sec=0.25)
    )
    simulator = Simulator(diagram)
    own = system.GetMyContextFromRoot(simulator.get_context())

    def now():
        return system.GetOutputPort("log").Eval(own)

    simulator.AdvanceTo(0.2)
    np.testing.assert_array_equal(now(), [0.0, *near, 0.0])
    simulator.AdvanceTo(0.5)
    assert now()[0] == 1.0 and now()[4] == pytest.approx(0.25, abs=0.03)
    np.testing.assert_array_equal(system.GetOutputPort("goal").Eval(own), far)
    simulator.AdvanceTo(2.2)
    assert now()[0] == 1.0
    simulator.AdvanceTo(2.4)
    assert now()[0] == 2.0
    simulator.AdvanceTo(3.0)
    assert now()[0] == 3.0  # Over; the last goal stays.
    np.testing.assert_array_equal(system.GetOutputPort("goal").Eval(own), near)


def test_a_turn_that_leaves_the_object_as_it_is_does_not_count():
    for goal, yaw, fold, turn in (
        (0.2, 3.0, 2, np.pi),
        (0.2, 1.7, 2, 0.0),
        (3.0, -3.0, 1, 0.0),
        (0.0, 2.2, 4, np.pi / 2.0),
        (1.0, 0.3, 0, -0.7),
    ):
        assert nearest_turn(goal, yaw, fold) == pytest.approx(turn)


def test_a_box_is_turned_to_the_nearer_of_the_yaws_that_are_the_same():
    x = np.zeros(N_X)
    x[Q_BALL] = turned(np.array([1.0, 0, 0, 0]), np.array([0, 0, 2.9]))
    x[P_BALL] = [0.5, 0, 0.02]
    first, second = [0.5, 0.0, -0.2], [0.52, 0.0, 0.0]
    for fold, given in ((1, [-0.2, 0.0]), (2, [np.pi - 0.2, np.pi])):
        diagram, system = goals_at(x, [first, second], fold, limit_sec=2.0)
        simulator = Simulator(diagram)
        own = system.GetMyContextFromRoot(simulator.get_context())
        simulator.AdvanceTo(0.1)
        yaw = system.GetOutputPort("goal").Eval(own)[2]
        assert yaw == pytest.approx(given[0])
        yaws = set()
        for t in np.arange(0.1, 2.2, 0.005):  # Finer than it decides.
            simulator.AdvanceTo(t)
            yaws.add(round(system.GetOutputPort("goal").Eval(own)[2], 9))
        assert yaws == {round(yaw, 9) for yaw in given}  # At no instant another.
        # As a box it was there at once; else its time was up.
        number, since = system.GetOutputPort("log").Eval(own)[[0, 4]]
        assert number == 1.0
        assert since == pytest.approx(0.25 if fold == 2 else 2.0, abs=0.03)
        assert system.GetOutputPort("goal").Eval(own)[2] == pytest.approx(given[1])


def test_goals_lie_all_over_the_region():
    config = PushGoalsConfig()
    poses = draw_poses(config, 400, 5)
    half = 0.5 * np.array([*config.size, 2 * np.pi])
    off = poses - [*config.center, 0.0]
    assert (np.abs(off) <= half).all()
    # Evenly: mean zero to 4 standard deviations of a mean of 400.
    assert (np.abs(off.mean(axis=0)) < 4 * half / np.sqrt(3 * 400)).all()
    assert not np.array_equal(poses, draw_poses(config, 400, 6))


def test_a_lying_cylinder_is_followed_and_a_t_is_not():
    """Where it will be touched a place goes along with what rolls."""
    for shape, follows in (("cylinder", True), ("t", False)):
        config = PushObjectConfig(object=PushedObject(shape))
        diagram = make_push_object(config)
        task = diagram.GetSubsystemByName("push_task")
        sampler = diagram.GetSubsystemByName("contact_sampler")
        assert task._config.push.follow is follows
        assert sampler._config.sampling.follow is follows


# The forces.


def load_on(names, other, torque=None):
    """ContactLoad on bodies of a stack of boxes of 1, 2 and 4 kg, at rest. Args:
    torque: of the contacts on the bodies' joints, as the load is told."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    hard = CoulombFriction(1.0, 1.0)
    ground, size = RigidTransform([0.0, 0.0, -0.05]), Box(1.0, 1.0, 0.1)
    plant.RegisterCollisionGeometry(plant.world_body(), ground, size, "g", hard)
    for i, mass in enumerate((1.0, 2.0, 4.0)):
        inertia = SpatialInertia.SolidBoxWithMass(mass, 0.1, 0.1, 0.1)
        body = plant.AddRigidBody(f"box{i}", inertia)
        joint = PrismaticJoint(
            f"slide{i}", plant.world_frame(), body.body_frame(), [0.0, 0.0, 1.0]
        )
        plant.AddJoint(joint)
        plant.RegisterCollisionGeometry(
            body, RigidTransform(), Box(0.1, 0.1, 0.1), f"box{i}", hard
        )
    plant.Finalize()
    bodies = [plant.GetBodyByName(name) for name in names]
    load = builder.AddSystem(ContactLoad(bodies, plant.GetBodyByName(other), 1))
    builder.Connect(
        plant.get_contact_results_output_port(), load.GetInputPort("contact_results")
    )
    if torque is not None:
        told = builder.AddSystem(ConstantVectorSource([torque]))
        builder.Connect(told.get_output_port(), load.GetInputPort("contact_torque"))
    simulator = Simulator(builder.Build())
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(own, [0.05, 0.15, 0.25])
    simulator.AdvanceTo(1.0)
    return load.get_output_port().Eval(
        load.GetMyContextFromRoot(simulator.get_context())
    )


def test_all_contacts_of_some_bodies_count_and_none_among_themselves():
    # The lowest carries 6 kg and stands with 7: forces that cancel are both counted.
    np.testing.assert_allclose(
        load_on(["box0"], "box1"), [6.0 * 9.81, 7.0 * 9.81], rtol=1e-3
    )
    # The two lower ones together: what is between them is their own matter.
    np.testing.assert_allclose(
        load_on(["box0", "box1"], "box2"), [4.0 * 9.81, 7.0 * 9.81], rtol=1e-3
    )
    np.testing.assert_allclose(load_on(["box2"], "box0"), [0.0, 4.0 * 9.81], rtol=1e-3)


def test_contacts_are_read_only_where_their_torque_says_that_there_is_one():
    np.testing.assert_array_equal(load_on(["box2"], "box0", 0.0), [0.0, 0.0])
    touched = load_on(["box2"], "box0", -1e-9)
    np.testing.assert_allclose(touched, [0.0, 4.0 * 9.81], rtol=1e-3)


# The diagram.


def test_errors_change_the_model_and_leave_the_world_alone():
    wrong = PushModelConfig(friction=0.25, scale=1.1, mass=0.9, com_offset=[0.015, 0.0])
    spec, friction = model_object(PushObjectConfig(model=wrong))
    right, _ = model_object(PushObjectConfig())
    assert friction == 0.25 and spec.scale == 1.1 and spec.com_offset == [0.015, 0.0]
    assert spec.mass == pytest.approx(0.9 * right.mass)
    scene = world_scene(PushObjectConfig(model=wrong))
    frictions = [effect.parameters["friction"] for effect in scene.effects]
    assert frictions == [0.5, 0.5]


def test_controllers_know_no_effect_of_the_world(tmp_path):
    scene = read_scene(PUSH_OBJECT)
    joint = "panda.panda_joint2"
    scene.effects.append(Effect("joint_coulomb_friction", [joint], {"coulomb": 3.0}))
    write_scene(scene, tmp_path / "world.scene.yaml")
    config = PushObjectConfig(scene=str(tmp_path / "world.scene.yaml"))
    of_world, modelled = world_scene(config).effects, model_scene(config, "o.sdf", POSE)
    assert [effect.kind for effect in of_world] == [
        "joint_coulomb_friction", "contact_friction", "contact_friction",
    ]  # fmt: skip
    kinds = [effect.kind for effect in modelled.effects]
    assert kinds == ["contact_friction", "contact_friction"]
    # Unless they are told.
    config.model.scene = config.scene
    told = model_scene(config, "o.sdf", POSE).effects
    assert told[0].kind == "joint_coulomb_friction"


def test_a_cylinder_rolls_against_a_resistance_that_no_model_knows(tmp_path):
    def levers(scene):
        return [
            e.parameters["coefficient"]
            for e in scene.effects
            if e.kind == "rolling_resistance"
        ]

    cylinder = PushObjectConfig(object=PushedObject("cylinder"))
    assert levers(world_scene(cylinder)) == [0.005]
    assert levers(world_scene(replace(cylinder, rolling_resistance=0.02))) == [0.02]
    assert levers(world_scene(replace(cylinder, rolling_resistance=0.0))) == []
    assert levers(world_scene(PushObjectConfig())) == []
    pose = [1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.02]
    file = object_file(cylinder.object)
    assert levers(model_scene(cylinder, file, pose)) == []
    for config, words in (
        (replace(cylinder, rolling_resistance=-0.1), "is -0.1, expected >= 0"),
        (PushObjectConfig(rolling_resistance=0.1), "object.shape t does not roll"),
    ):
        with pytest.raises(ValueError, match=words):
            world_scene(config)


def test_the_object_starts_where_the_seed_says_it_does():
    config = PushObjectConfig(seed=4, n_goals=2)
    x, y, yaw = poses_of(config)[0]
    pose = world_scene(config).initial.poses["object.object"]
    assert pose[4:6] == [x, y] and heading(np.array(pose[:4])) == pytest.approx(yaw)
    started = PushObjectConfig(start=[0.4, 0.1, 0.2])
    np.testing.assert_array_equal(poses_of(started)[0], [0.4, 0.1, 0.2])


def test_the_arm_goes_to_the_object_and_moves_it_towards_its_goal():
    config = PushObjectConfig(start=[0.5, 0.0, 0.3], adapt=True)
    config.goals.center, config.goals.size = [0.55, 0.0], [1e-6, 1e-6]
    diagram = make_push_object(config)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(4.0)
    context = simulator.get_context()

    def log(name):
        return diagram.GetSubsystemByName(name).FindLog(context)

    goal = log("goal_log").data()[1:4, -1]
    plant = diagram.GetSubsystemByName("station").GetSubsystemByName("plant")
    at = plant.GetBodyByName("object").floating_positions_start()
    x = np.zeros((2, N_X))
    for i, k in enumerate((0, -1)):
        pose = log("state_log").data()[at : at + 7, k]
        x[i, Q_BALL], x[i, P_BALL] = pose[:4], pose[4:]
    before, after = (0.12 * angle + length for length, angle in
                     (errors(x[0], goal), errors(x[1], goal)))  # fmt: skip
    phases = log("phase_log").data()[0]
    assert {TRAVEL, CONTACT} <= set(phases.tolist())
    assert phases[12] == TRAVEL  # As soon as the pose is known and a place is chosen.
    assert after < before - 0.03
    force = np.linalg.norm(log("touch_log").data(), axis=0)
    assert 0.5 < force.max() < 40.0
    # Nothing but the finger touches anything, and it the object alone.
    load = log("load_log").data()
    np.testing.assert_allclose(load[0], force, atol=0.3)
    assert (load[1] == 0.0).all()
    tau = log("torque_log").data()
    assert np.isfinite(tau).all() and np.abs(np.diff(tau, axis=1)).max() < 87.0
    # Sampler and reference know where the wrist is, and how near it may come.
    reference, sampler = (
        diagram.GetSubsystemByName(name)._config
        for name in ("arm_reference", "contact_sampler")
    )
    assert np.hypot(*reference.wrist) > 0.1
    assert reference.wrist == sampler.sampling.reach.wrist
    assert reference.nearest == pytest.approx(sampler.sampling.reach.range[0] - 0.01)


@pytest.mark.parametrize("gentle", [False, True])
def test_a_gentle_touch_is_wired_and_its_speed_is_checked(gentle):
    diagram = make_push_object(PushObjectConfig(gentle=gentle))
    assert diagram.HasSubsystemNamed("touch_down") == gentle
    reference = diagram.GetSubsystemByName("arm_reference")
    port = reference.GetInputPort("touch_speed")
    context = diagram.CreateDefaultContext()
    assert port.HasValue(reference.GetMyContextFromRoot(context)) == gentle
    if gentle:
        fast = TouchDownConfig(speed=TouchSpeedConfig(most=0.3))
        with pytest.raises(ValueError, match="touch.speed.most is 0.3, expected at"):
            make_push_object(PushObjectConfig(gentle=True, touch=fast))


def test_what_the_learner_of_parameters_knows_is_planned_with():
    """Mass and frictions go to both models and to the sampler, the gap as r_comp."""
    diagram = make_push_object(PushObjectConfig(learner="parameters"))
    for name in ("residual_learner", "lcs_learn"):  # It has its own.
        assert not diagram.HasSubsystemNamed(name)
    context = diagram.CreateDefaultContext()

    def own(name):
        system = diagram.GetSubsystemByName(name)
        return system, system.GetMyContextFromRoot(context)

    learner, its = own("parameter_learner")
    assert [p.kind for p in learner.model.parameters.items] == [
        "mass", "friction", "friction", "gap",
    ]  # fmt: skip
    sure = Belief(np.array([1.0, -1.0, 0.5, 2.0]), 1e14 * np.eye(4))
    its.SetAbstractState(0, replace(learner._memory_of(its), belief=sure))
    on_table = 0.5 * np.exp(0.25) / WEIGHT  # The planner's object is as much heavier.
    expected = [0.4 * np.exp(0.5), 0.5 * np.exp(-0.5), on_table]
    for name in ("lcs_plan", "lcs_command", "contact_sampler"):
        system, its = own(name)
        values = system.GetInputPort("parameters").Eval(its)
        np.testing.assert_allclose(values, expected, rtol=1e-6)
    for name in ("c3_mpc", "contact_sampler"):
        system, its = own(name)
        r_comp = system.GetInputPort("r_comp").Eval(its)
        known = 0.008 - 0.001**2 / 0.008  # To 1 mm at best.
        np.testing.assert_allclose(r_comp[:4], known / 0.05, rtol=1e-6)
        assert not r_comp[4:].any()


@pytest.mark.parametrize(("shape", "heavier"), [("t", WEIGHT), ("cylinder", 1.0)])
def test_the_planner_s_object_is_heavy_on_a_smooth_table_if_it_slides(shape, heavier):
    """Its friction is as great as it is; the learner's object is not heavier."""
    diagram = make_push_object(PushObjectConfig(object=PushedObject(shape)))
    for name, weight in (("plan", heavier), ("command", heavier), ("learn", 1.0)):
        model = diagram.GetSubsystemByName(f"lcs_{name}").model
        lcs, x = model.at_default(), model.x_default
        fall = (lcs.A @ x + lcs.d)[N_X - 1] / lcs.dt
        assert fall == pytest.approx(-9.81 * weight, rel=1e-3)
        sideways = np.abs(lcs.D[N_X - 3, 4:]).max() / lcs.D[N_X - 1, 4:].max()
        assert sideways == pytest.approx(0.5 / weight, rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"mass": -0.1}, "parameters.mass is -0.1, expected >= 0"),
        ({"mass": 0.0, "friction": 0.0, "gap": 0.0}, "parameters has no deviation"),
    ],
)
def test_nothing_to_learn_is_refused(settings, said):
    config = PushObjectConfig(
        learner="parameters", parameters=PushParametersConfig(**settings)
    )
    with pytest.raises(ValueError, match=said):
        make_push_object(config)


@pytest.mark.parametrize(
    ("choice", "setting", "value"),
    [
        ({"learner": "r_comp"}, "parameters.mass", 0.7),
        ({"pose_from": "sensor"}, "camera.width", 160),
        ({"pose_from": "sensor"}, "tracker.yaw_std", 0.02),
        ({"pose_from": "sensor"}, "learning.weight_late", 100.0),
        ({"pose_from": "camera"}, "pose.delay_sec", 0.05),
        ({"pose_from": "camera"}, "learning.weight", 100.0),
        ({"gentle": False}, "touch.speed.most", 0.1),
        ({}, "planner.coast_sec", 2.0),
    ],
)
def test_a_setting_that_the_chosen_parts_do_not_read_is_refused(choice, setting, value):
    config = PushObjectConfig(camera=CameraConfig(renderer="drawn"), **choice)
    part, _, name = setting.rpartition(".")
    setattr(attrgetter(part)(config), name, value)
    ((key, chosen),) = (choice or {"object.shape": "t"}).items()
    why = rf"^{setting} is {value}, expected .*: not used with {key}={chosen}$"
    with pytest.raises(ValueError, match=re.compile(why, re.IGNORECASE)):
        make_push_object(config)


def test_the_wrist_is_the_arm_s_and_no_setting():
    config = PushObjectConfig()
    config.sampler.sampling.reach.wrist = [0.1, 0.0]
    with pytest.raises(ValueError, match="sampler.sampling"):
        make_push_object(config)


@pytest.mark.parametrize("pose_from", ["sensor", "camera"])
def test_no_state_is_copied_array_by_array(pose_from):
    """Drake copies abstract state at updates: here it gets the same object again."""
    camera = CameraConfig(renderer="drawn")
    config = PushObjectConfig(pose_from=pose_from, camera=camera)
    diagram = make_push_object(config)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.3)
    copied = []
    for system in leaf_systems(diagram):
        own = system.GetMyContextFromRoot(simulator.get_context())
        for i in range(own.num_abstract_states()):
            value = own.get_abstract_state(i).get_value()
            if deepcopy(value) is not value:
                copied.append(f"{system.get_name()}: {type(value).__name__}")
    assert not copied
