"""Compiled joints and drives against Drake's plant and its integrator."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import at_rest_but, double, pendulum, with_effects

from makebreak.gap.numerics.driven_arm import rollout
from makebreak.gap.simulation import driven_arm
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.driven_arm import (
    DrivenArmScene,
    DrivenArmSimulation,
    can_have,
)
from makebreak.gap.simulation.scene_simulation import SceneSimulation, SimulationConfig
from makebreak.models.effects import KINDS
from makebreak.models.scene import ActuationSection
from makebreak.models.scene_schema import SupplySection
from makebreak.systems.numerics import body_laws
from makebreak.systems.numerics.body_laws import NO_BODY_LAWS
from makebreak.systems.numerics.joint_laws import LAWS, law_number
from makebreak.systems.numerics.joint_tree import mass_and_bias

ROBOT = """<?xml version="1.0"?>
<robot name="t"><link name="base"/>
<link name="cart"><inertial><origin xyz="0.1 0 0.05"/><mass value="2"/>
<inertia ixx="0.02" iyy="0.025" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial>
</link>
<link name="arm"><inertial><origin xyz="0 0.02 -0.2" rpy="0.3 0 0.1"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="hand"><inertial><origin xyz="0.05 0 -0.1"/><mass value="0.4"/>
<inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tool"><inertial><origin xyz="0 0.03 0"/><mass value="0.2"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="flag"><inertial><origin xyz="0 0 0.2"/><mass value="0.3"/>
<inertia ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/>
<origin xyz="0 0 0.3" rpy="0.2 0.1 0"/><axis xyz="1 0.5 0"/><limit effort="60"
lower="-5" upper="5" velocity="9"/></joint>
<joint name="swing" type="continuous"><parent link="cart"/><child link="arm"/>
<origin xyz="0.2 0 0" rpy="0 0.4 0"/><axis xyz="0 1 0.2"/><dynamics damping="0.1"/>
</joint>
<joint name="twist" type="continuous"><parent link="arm"/><child link="hand"/>
<origin xyz="0 0 -0.4"/><axis xyz="1 0 0"/></joint>
<joint name="hold" type="fixed"><parent link="hand"/><child link="tool"/>
<origin xyz="0.1 0 -0.2" rpy="0.5 0 0"/></joint>
<joint name="wave" type="continuous"><parent link="cart"/><child link="flag"/>
<origin xyz="-0.1 0 0.1"/><axis xyz="0 0.6 0.8"/></joint></robot>"""


def tree(folder):
    """A scene of four joints, one of which slides and carries two branches."""
    scene = pendulum(folder)
    (folder / "p.urdf").write_text(ROBOT.replace('name="t"', 'name="p"', 1))
    joints = [f"p.{name}" for name in ("rail", "swing", "twist", "wave")]
    actuation = ActuationSection(
        type="servo", joints=joints, kp=[300.0, 40.0, 15.0, 20.0], kd=[20, 2, 0.5, 1],
        limit=[50.0, 8.0, 3.0, 3.0],
    )  # fmt: skip
    return replace(scene, actuation=actuation), joints


ROTORS = [("rotor_inertia", "p", dict(inertia=0.02))]
LACKS = {
    "nothing": [],
    "friction": [
        ("joint_coulomb_friction", "p.swing", dict(coulomb=0.6)),
        ("joint_load_friction", "p", dict(share=0.4)),
        ("joint_direction_friction", "p.wave",
         dict(coulomb_plus=0.2, coulomb_minus=0.5)),
        ("joint_position_friction", "p.rail",
         dict(coulomb_low=3.0, coulomb_high=9.0, low=-0.1, high=0.2)),
        ("joint_quadratic_drag", "p.twist", dict(coefficient=0.1)),
    ],
    "drive": [
        ("servo_gain", "p.swing", dict(kp=25.0)),
        ("actuator_gain", "p.twist", dict(gain=0.7)),
        ("actuator_bias", "p.wave", dict(bias=0.4)),
        ("actuator_saturation", "p.rail", dict(limit=25.0)),
        ("input_delay", "p", dict(delay=0.013)),
        ("joint_offset", "p.swing", dict(offset=0.05)),
    ],
    "lag": [("actuator_lag", "p", dict(time_constant=0.02))],
    "forces": [
        ("constant_force", "p.tool", dict(fx=2.0, fy=-1.0, fz=3.0)),
        ("sinusoidal_force", "p.cart",
         dict(fx=5.0, fy=0.0, fz=1.0, frequency=1.5, phase=0.4)),
        ("body_drag", "p.hand", dict(linear=1.5, angular=0.2)),
        ("body_quadratic_drag", "p.flag", dict(coefficient=0.8)),
    ],
    "links": [
        ("payload", "p.tool", dict(mass=0.3, com_x=0.05, com_y=0.0, com_z=-0.1)),
        ("link_mass", "p.arm", dict(mass=-0.3)),
        ("gravity_tilt", "p", dict(roll=0.1, pitch=-0.05)),
        ("joint_viscous_damping", "p.rail", dict(damping=3.0)),
    ],
}  # fmt: skip


def commands(joints, seconds=0.5, rate=50.0):
    time = np.arange(0.0, seconds, 1.0 / rate)
    columns = {
        f"{joint}.position_command": 0.3 * np.sin((3.0 + k) * time + k)
        for k, joint in enumerate(joints)
    }
    return time, Commands(time, columns)


@pytest.mark.parametrize("lacks", LACKS)
def test_a_tree_of_joints_moves_as_in_drake(tmp_path, lacks, monkeypatch):
    monkeypatch.setattr(driven_arm, "HOLDS", 1.0)  # Friction fades as in Drake.
    scene, joints = tree(tmp_path)
    scene = with_effects(scene, *ROTORS, *LACKS[lacks])
    time, told = commands(joints)
    channels = [f"{j}.{what}" for what in ("position", "velocity") for j in joints]
    start = at_rest_but(
        dict(zip(joints, (0.1, -0.2, 0.3, 0.4), strict=True)),
        dict(zip(joints, (0.2, 1.0, -2.0, 0.0), strict=True)),
    )
    exact = SceneSimulation(scene, SimulationConfig(accuracy=1e-8))
    fast = DrivenArmSimulation(scene)
    fast.tol = 1e-5
    want = exact.run(start, time, channels, told)
    have = fast.run(start, time, channels, told)
    # A tolerance of 1e-5 rad/s and 1e-7 rad a step, of which there are 500.
    np.testing.assert_allclose(have[:, :4], want[:, :4], atol=5e-5)
    np.testing.assert_allclose(have[:, 4:], want[:, 4:], atol=2e-3)
    assert np.abs(want[:, :4] - want[0, :4]).max(axis=0).min() > 0.02  # It does move.


def test_a_joint_that_nothing_drives_may_have_a_rotor(tmp_path):
    scene, joints = tree(tmp_path)
    driven = replace(
        scene.actuation, joints=joints[:3], kp=[300.0, 40.0, 15.0], kd=[20, 2, 0.5],
        limit=[50.0, 8.0, 3.0],
    )  # fmt: skip
    scene = with_effects(
        replace(scene, actuation=driven), ("rotor_inertia", "p.wave", dict(inertia=0.1))
    )
    time, told = commands(joints[:3])
    channels = [f"{joint}.position" for joint in joints]
    start = at_rest_but({"p.wave": 0.5})
    want = SceneSimulation(scene).run(start, time, channels, told)
    fast = DrivenArmSimulation(scene)
    fast.tol = 1e-4
    have = fast.run(start, time, channels, told)
    np.testing.assert_allclose(have, want, atol=3e-4)


@pytest.mark.parametrize("effort", [True, False])
def test_efforts_and_velocities_may_be_commanded(tmp_path, effort):
    scene = double(tmp_path)
    name = "effort_command"
    if not effort:
        name = "velocity_command"
        actuation = ActuationSection(
            type="velocity", joints=["d.j1", "d.j2"], kd=[5.0, 3.0], limit=[9.0],
            supply=SupplySection(voltage=[24.0], kt=[0.5], resistance=[1.0]),
        )  # fmt: skip
        scene = replace(scene, actuation=actuation)
    time = np.arange(0.0, 1.0, 0.02)
    told = Commands(
        time, {f"d.j{k}.{name}": 3.0 * np.sin(5.0 * time + k) for k in (1, 2)}
    )
    channels = ["d.j1.position", "d.j2.position"]
    start = at_rest_but({"d.j1": 0.3, "d.j2": 0.2})
    want = SceneSimulation(scene).run(start, time, channels, told)
    fast = DrivenArmSimulation(scene)
    fast.tol = 1e-4
    have = fast.run(start, time, channels, told)
    np.testing.assert_allclose(have, want, atol=3e-4)


def test_mass_matrix_and_bias_are_those_of_drake(tmp_path):
    scene, _ = tree(tmp_path)
    scene = with_effects(scene, *ROTORS)
    arms = DrivenArmScene(scene)
    arm = arms.arm(())
    plant = SceneSimulation(scene)._plant
    context = plant.CreateDefaultContext()
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, v = rng.normal(size=4), rng.normal(size=4)
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        M, bias = np.empty((4, 4)), np.empty(4)
        mass_and_bias(arm.tree, NO_BODY_LAWS, 0.0, q, v, M, bias)
        gravity = plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(M, plant.CalcMassMatrix(context), atol=1e-12)
        np.testing.assert_allclose(
            bias, plant.CalcBiasTerm(context) - gravity, atol=1e-11
        )


def test_every_law_of_a_joint_is_in_the_compiled_list():
    q, v, t, p = 0.3, -0.4, 0.1, np.array([0.5, 0.7, 0.2, 0.6, 0.3])
    for number, law in enumerate(LAWS):
        assert law_number(number, q, v, t, p) == law(q, v, t, p)
    for kind, entry in KINDS.items():
        assert entry.joint_law is None or entry.joint_law in LAWS, kind


def test_every_law_of_a_body_is_in_the_compiled_list():
    V, t, p = np.linspace(-0.4, 0.7, 6), 0.1, np.linspace(0.5, 1.2, 8)
    for number, law in enumerate(body_laws.LAWS):
        have, want = np.ones((2, 6))
        body_laws.law_number(number, V, t, p, have)
        law(V, t, p, want)
        np.testing.assert_array_equal(have, want)
        assert (want != 1.0).any()
    for kind, entry in KINDS.items():
        assert entry.body_law is None or entry.body_law in body_laws.LAWS, kind


def test_what_takes_drakes_own_steps_is_refused(tmp_path):
    scene, joints = tree(tmp_path)
    spring = ("joint_elasticity", joints[1], dict(stiffness=100.0, damping=0.1))
    with pytest.raises(ValueError, match="joint_elasticity takes Drake's own steps"):
        DrivenArmSimulation(with_effects(scene, spring))
    assert not can_have("joint_elasticity") and can_have("body_drag")


def test_what_cannot_be_stepped_ends_in_nan(tmp_path):
    scene, _ = tree(tmp_path)
    arm = DrivenArmScene(with_effects(scene, *ROTORS)).arm(())
    light = arm._replace(
        tree=arm.tree._replace(mass=-arm.tree.mass)
    )  # No motion has this.
    y = rollout(light, np.zeros(4), np.zeros(4), [0.0, 0.1], np.zeros((1, 2, 4)))
    assert np.isnan(y).all()


MUJOCO_STOPS = 0.1 / 0.9 * 0.95 * 0.02 / 2.0  # [s] Of its solref and solimp.
HELD = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody><body>
<joint name="j" axis="0 1 0" frictionloss="1.5"/><inertial pos="0 0 0" mass="1"
diaginertia="0.05 0.05 0.05"/></body></worldbody></mujoco>"""


def test_a_drive_of_any_stiffness_is_stepped(tmp_path):
    """One that damps with 200 N m s/rad what has some 0.1 kg m2 closes on its command
    with kd/kp; a continuous plant of Drake's refuses it."""
    drive = dict(type="servo", joints=["p.j1"], kp=[2000.0], kd=[2000.0])
    scene = pendulum(tmp_path, **drive)
    with pytest.raises(ValueError, match="too little for that to be simulated"):
        SceneSimulation(replace(scene, plant=replace(scene.plant, time_step=0.0)))
    scene = replace(scene, plant=replace(scene.plant, time_step=1e-4))
    time = np.linspace(0.0, 3.0, 301)
    told = Commands(time, {"p.j1.position_command": np.full(len(time), 0.2)})
    q = DrivenArmSimulation(scene).run(
        at_rest_but({"p.j1": 0.0}), time, ["p.j1.position"], told
    )[:, 0]
    # Gravity pulls by less than 10 N m, of 2000.
    np.testing.assert_allclose(q, 0.2 * (1.0 - np.exp(-time)), atol=5e-3)


@pytest.mark.parametrize("stops_sec", [0.0, MUJOCO_STOPS])
@pytest.mark.parametrize("push", [0.9, 4.0])
def test_friction_holds_or_stops_a_joint_as_mujoco_does(tmp_path, stops_sec, push):
    """A push that friction holds, and a wave that turns it: MuJoCo's solver as it comes
    lets the joint creep, and its friction turns before the joint does."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(HELD)
    data, slides = mujoco.MjData(model), push > 1.5  # [N m], what friction is.
    step, seen = model.opt.timestep, []
    time = np.arange(0.0, 1.0, step)
    wave = push * (np.cos(12.0 * time) if slides else np.ones(len(time)))
    for u in wave:
        seen.append(data.qpos[0])
        data.qfrc_applied[0] = u
        mujoco.mj_step(model, data)
    scene = pendulum(tmp_path)
    (tmp_path / "p.urdf").write_text(
        """<robot name="p"><link name="base"/><link name="l"><inertial><mass value="1"/>
<inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="l"/>
<axis xyz="0 1 0"/></joint></robot>"""
    )
    actuation = ActuationSection(type="effort", joints=["p.j"])
    scene = replace(scene, actuation=actuation, tolerance={"friction_sec": stops_sec})
    scene = with_effects(scene, ("joint_coulomb_friction", "p.j", dict(coulomb=1.5)))
    simulation = DrivenArmSimulation(scene)
    told = Commands(time, {"p.j.effort_command": wave})
    q = simulation.run(at_rest_but({"p.j": 0.0}), time, ["p.j.position"], told)[:, 0]
    off = np.abs(q - seen).max() / np.ptp(seen)
    assert np.ptp(seen) > 0.01  # It does creep there.
    if stops_sec:  # MuJoCo's own steps are of first order.
        assert off < 0.01
    else:
        assert off > (0.02 if slides else 0.9)
