"""Arms of the tests' own: prismatic joints, damping and dry friction in the joints."""

import numpy as np
import pytest
from chain_against_drake import assert_moves_as_in_drake
from hypothesis import given
from hypothesis import strategies as st
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Demultiplexer

from makebreak.systems.arm.impedance_controller import (
    HybridConfig,
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.energy_tank import LEVEL, N_TANK
from makebreak.systems.arm.numerics.joint_friction import joint_torque
from makebreak.systems.arm.numerics.serial_chain import chain_state
from makebreak.systems.numerics.joint_laws import (
    LAWS,
    N_NUMBERS,
    JointLaws,
    law_number,
    position_law,
    ripple_law,
    spring_law,
)

# A rail, a shoulder, a second rail that leans, an elbow, a wrist.
JOINTS = [
    ("prismatic", "1 0 0", "0 0 0.5", "0 0 0", 4.0),
    ("revolute", "0 0 1", "0.1 0 0", "0 0 0.3", 1.5),
    ("prismatic", "0 0.6 0.8", "0.3 0 0", "0.2 0 0", 8.0),
    ("revolute", "0 1 0", "0.1 0.05 0.1", "0 0.4 0", 0.7),
    ("revolute", "1 0 0", "0.2 0 0", "0 0 0", 0.2),
]


def urdf(joints, damped=True):
    """An arm on the world, with a frame "tip" on a last link of 5 cm."""
    links, between = ['<link name="base"/>'], []
    parent = "base"
    for i, (kind, axis, xyz, rpy, damping) in enumerate(joints):
        links.append(
            f'<link name="link{i}"><inertial><origin xyz="0.02 0.01 {0.03 * i}"/>'
            f'<mass value="{2.0 - 0.2 * i}"/><inertia ixx="0.02" iyy="0.03" izz="0.025"'
            ' ixy="0.001" ixz="-0.002" iyz="0"/></inertial></link>'
        )
        between.append(
            f'<joint name="joint{i}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="link{i}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<axis xyz="{axis}"/><limit effort="500" velocity="5" lower="-2" '
            f'upper="2"/><dynamics damping="{damping if damped else 0.0}"/></joint>'
            f"<transmission><type>transmission_interface/SimpleTransmission</type>"
            f'<joint name="joint{i}"><hardwareInterface>EffortJointInterface'
            f'</hardwareInterface></joint><actuator name="motor{i}"/></transmission>'
        )
        parent = f"link{i}"
    tip = f'<frame name="tip" link="{parent}" xyz="0 0 -0.05" rpy="0 0 0"/>'
    return f'<robot name="arm">{"".join(links + between)}{tip}</robot>'


def arm_of(joints, time_step=0.0, damped=True):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModelsFromString(urdf(joints, damped), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    return builder, plant


def test_a_chain_of_both_kinds_of_joints_agrees_with_drake():
    _, plant = arm_of(JOINTS)
    plant.Finalize()
    chain = serial_chain_of(plant, "tip")
    context = plant.CreateDefaultContext()
    tip = plant.GetFrameByName("tip")
    rng = np.random.default_rng(0)
    close = dict(atol=1e-11, rtol=1e-11)
    for _ in range(20):
        q, v = rng.uniform(-2, 2, 5), rng.uniform(-2, 2, 5)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        s = chain_state(chain, q, v)
        forces = MultibodyForces(plant)  # Gravity and the joints' damping.
        plant.CalcForceElementsContribution(context, forces)
        needed = plant.CalcInverseDynamics(context, np.zeros(5), forces)
        np.testing.assert_allclose(s.bias, needed, **close)
        assert_moves_as_in_drake(s, plant, context, tip, **close)


# A gantry: three rails, so that the mass at the tip is the same everywhere.
GANTRY = [
    ("prismatic", "1 0 0", "0 0 0.6", "0 0 0", 6.0),
    ("prismatic", "0 1 0", "0 0 0", "0 0 0", 3.0),
    ("prismatic", "0 0 1", "0 0 -0.2", "0 0 0", 10.0),
]
GANTRY_MASS = np.array([5.4, 3.4, 1.6])  # Carried by each rail [kg].


class Gantry:
    """The gantry over a table, under its controller."""

    def __init__(self, config, hybrid=None, damped=True, gap=0.03):
        builder, plant = arm_of(GANTRY, 0.001)
        tip = plant.GetFrameByName("tip")
        material = ProximityProperties()
        AddContactMaterial(material, friction=CoulombFriction(0.1, 0.1))
        up = RigidTransform([0.0, 0.0, 0.34 - gap])  # Below a ball of 1 cm at the tip.
        for body, pose, shape in (
            (plant.world_body(), up, HalfSpace()),
            (tip.body(), tip.GetFixedPoseInBodyFrame(), Sphere(0.01)),
        ):
            plant.RegisterCollisionGeometry(body, pose, shape, body.name(), material)
        plant.Finalize()
        own = arm_of(GANTRY, damped=damped)[1]
        own.Finalize()
        self.controller = builder.AddSystem(
            ImpedanceController(config, own, hybrid=hybrid)
        )
        split = builder.AddSystem(Demultiplexer([3, 3]))
        builder.Connect(plant.get_state_output_port(), split.get_input_port())
        for i, name in enumerate(("q", "v")):
            builder.Connect(
                split.get_output_port(i), self.controller.GetInputPort(name)
            )
        builder.Connect(
            self.controller.GetOutputPort("tau"), plant.get_actuation_input_port()
        )
        self.plant, self.simulator = plant, Simulator(builder.Build())
        root = self.simulator.get_mutable_context()
        self.context = self.controller.GetMyMutableContextFromRoot(root)
        self.plant_context = plant.GetMyMutableContextFromRoot(root)
        self.p_0 = tip.CalcPoseInWorld(self.plant_context).translation()
        self.set(x_desired=self.reference())

    def set(self, **ports):
        for name, value in ports.items():
            self.controller.GetInputPort(name).FixValue(self.context, value)

    def reference(self, moved=(0, 0, 0)):
        return np.array([*(self.p_0 + moved), 1.0, *[0.0] * 15])

    def run(self):
        """One tick. Gives the force on the tip in the world [N]."""
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + 0.001)
        results = self.plant.get_contact_results_output_port().Eval(self.plant_context)
        force = np.zeros(3)
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            on_tip = info.bodyB_index() == self.plant.GetBodyByName("link2").index()
            force += info.contact_force() * (1.0 if on_tip else -1.0)
        return force


@pytest.mark.parametrize("target", [pytest.param(3.0, marks=pytest.mark.slow), 12.0])
def test_a_gantry_of_damped_rails_presses_with_the_force_asked_for(target):
    config = ImpedanceConfig(stiffness=[500.0] * 3 + [0.0] * 3)
    loop = Gantry(config, HybridConfig(damping_ratio=0.9), gap=0.001)
    loop.set(force_directions=[0, 0, -1, 0, 0, 0], force_targets=[target, 0.0])
    forces = []
    for k in range(6000):
        t = max(k - 2000, 0) * 1e-3
        loop.set(x_desired=loop.reference([0.1 * np.sin(t), 0.1 * np.sin(2 * t), 0]))
        force = loop.run()
        loop.set(wrench_measured=[*force, 0, 0, 0])
        forces.append(force[2])
    # At rest what the landing left in the integral is gone as e^(-0.5 t); in motion
    # friction of the table and the damped rails are across the force.
    np.testing.assert_allclose(forces[1900:2000], target, rtol=0.06)
    np.testing.assert_allclose(forces[3000:], target, rtol=0.05)


def test_a_gantry_goes_where_it_is_sent_and_no_faster_than_its_rails_may():
    config = ImpedanceConfig(
        stiffness=[100.0] * 3 + [0.0] * 3, damping=[40.0] * 6, force_max=100.0
    )  # No more than the rate limit, 1000 N/s, can follow.
    loop = Gantry(config, gap=0.3)
    loop.set(x_desired=loop.reference([0.2, -0.3, 0.1]))
    for _ in range(5000):
        loop.run()
    q = loop.plant.GetPositions(loop.plant_context)
    np.testing.assert_allclose(q, [0.2, -0.3, 0.1], atol=1e-3)
    loop.set(x_desired=loop.reference([9.0, 0.0, 0.0]))  # Beyond the rail's end, 2 m.
    fastest = 0.0
    for _ in range(4000):
        loop.run()
        fastest = max(fastest, loop.plant.GetVelocities(loop.plant_context)[0])
    assert 1.9 < loop.plant.GetPositions(loop.plant_context)[0] < 2.0
    assert 3.0 < fastest < 4.1  # 0.8 of 5 m/s.


@pytest.mark.parametrize(
    ("worst", "frequency"), [(True, 0.0), *((False, f) for f in (1.0, 2.5, 4.0))]
)
def test_a_stiffness_on_the_port_drives_no_swing(frequency, worst):
    """The system in its loop: mass, spring and tank together never gain energy."""
    config = ImpedanceConfig(stiffness=[200.0] * 3 + [0.0] * 3, damping=[5.0] * 6)
    loop = Gantry(config, gap=0.3)
    loop.set(x_desired=loop.reference([0.01, 0.0, 0.0]), stiffness=[200.0] * 6)
    loop.run()
    start, swings = 0.5 * 200.0 * 0.01**2 + config.energy_tank, []
    for k in range(4000):
        q = loop.plant.GetPositions(loop.plant_context)[0] - 0.01
        v = loop.plant.GetVelocities(loop.plant_context)[0]
        stiff = q * v < 0.0 if worst else (k * 1e-3 * frequency) % 1.0 < 0.5
        loop.set(stiffness=[1000.0 if stiff else 200.0] * 6)
        loop.run()
        group = loop.context.get_discrete_state()
        sizes = [group.value(i).size for i in range(group.num_groups())]
        memory = group.value(int(np.argmax(sizes)))
        tank = memory[-3 - N_TANK : -3]
        q = loop.plant.GetPositions(loop.plant_context)[0] - 0.01
        v = loop.plant.GetVelocities(loop.plant_context)[0]
        energy = 0.5 * GANTRY_MASS[0] * v**2 + 0.5 * tank[0] * q**2
        # A held force acts half a tick late: K h x v/2, at most sqrt(K/M) h/2 = 0.7 %.
        assert energy + tank[LEVEL] < 1.01 * start
        swings.append(abs(q))
    assert max(swings) < np.sqrt(2.0 * start / 200.0)
    assert max(swings[-500:]) < 0.01


# The forces in the joints.


@given(
    number=st.integers(0, len(LAWS) - 1),
    p=st.tuples(*[st.floats(0.1, 5.0)] * N_NUMBERS),
    q=st.floats(-2.0, 2.0),
    v_d=st.floats(-3.0, 3.0),
)
def test_known_forces_of_the_joints_are_taken_off_where_the_reference_is_followed(
    number, p, q, v_d
):
    p, one = np.array(p), np.zeros(1, np.int64)
    if LAWS[number] is position_law:
        p[3] += p[2]  # Above the low position.
    laws = JointLaws(one, np.array([number]), p[None])
    damping = np.array([2.0])
    tau = joint_torque(laws, damping, np.array([q]), np.array([v_d]))
    expected = 2.0 * v_d - law_number(number, q, v_d, 0.0, p)
    np.testing.assert_allclose(tau, expected, rtol=1e-12, atol=1e-12)
    if LAWS[number] not in (ripple_law, spring_law):  # Nothing where it rests.
        assert joint_torque(laws, damping, np.array([q]), np.zeros(1))[0] == 0.0
