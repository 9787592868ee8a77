"""A repaired scene as MJCF and URDF: the same mechanism in MuJoCo and in Drake."""

import copy
import re
import sys
import types
from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest
from effect_scenes import at_rest_but, double, on_ground, pendulum, with_effects
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import GeometrySet, Role
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import Effect
from makebreak.models.model_export import formats_of, to_mjcf, to_sdf, to_urdf
from makebreak.models.scene import ActuationSection, InitialSection, load_scene
from makebreak.models.scene_schema import SupplySection
from makebreak.scripts.cli.gap_command import exported

JOINTS = ("d.j1", "d.j2")
SAID = (
    ("joint_viscous_damping", "d.j2", dict(damping=0.2)),
    ("joint_coulomb_friction", "d.j1", dict(coulomb=0.4)),
    ("rotor_inertia", "d", dict(inertia=0.05)),
    ("payload", "d.lower", dict(mass=0.4, com_x=0.05, com_y=0.0, com_z=-0.4)),
    ("payload", "d.upper", dict(mass=-0.3, com_x=0.02, com_y=0.01, com_z=-0.3)),
    ("link_mass", "d.lower", dict(mass=-0.2)),
    ("link_com", "d.upper", dict(x=0.01, y=-0.02, z=0.03)),
    ("gravity_tilt", "d", dict(roll=0.1, pitch=-0.2)),
)
LOST = ("joint_quadratic_drag", "d.j1", dict(coefficient=0.1))


def in_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model)


def test_mass_matrix_and_forces_are_those_of_drake(tmp_path):
    scene = with_effects(double(tmp_path), *SAID)
    plant = load_scene(scene, DiagramBuilder()).plant
    context = plant.CreateDefaultContext()
    model, data = in_mujoco(to_mjcf(scene).text)
    rng = np.random.default_rng(0)
    names = [model.joint(i).name for i in range(model.njnt)]
    assert names == list(JOINTS)
    for _ in range(5):
        q, v = rng.uniform(-2, 2, (2, 2))
        plant.SetPositions(context, q)
        plant.SetVelocities(context, v)
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        M = np.zeros((2, 2))
        for column, unit in zip(M, np.eye(2), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        np.testing.assert_allclose(M, plant.CalcMassMatrix(context), rtol=1e-9)
        bias = plant.CalcBiasTerm(context) - plant.CalcGravityGeneralizedForces(context)
        np.testing.assert_allclose(data.qfrc_bias, bias, atol=1e-9)
        damping = [j.GetDampingVector(context)[0] for j in (
            plant.GetJointByName("j1"), plant.GetJointByName("j2"))]  # fmt: skip
        np.testing.assert_allclose(model.dof_damping, damping)
    np.testing.assert_allclose(model.dof_frictionloss, [0.4, 0.0])


@pytest.mark.parametrize("drive", ["effort", "servo", "pd"])
def test_mujoco_replays_what_drake_simulates(tmp_path, drive):
    actuation = ActuationSection(type="effort", joints=list(JOINTS))
    more = []
    if drive != "effort":
        actuation = ActuationSection(
            type=drive, joints=list(JOINTS), kp=[40.0], kd=[0.5], limit=[14.0, 5.0],
            supply=SupplySection(voltage=[24.0], kt=[1.0], resistance=[1.0]),
        )  # fmt: skip
        more = [("servo_gain", "d.j2", dict(kp=25.0))]
    scene = with_effects(replace(double(tmp_path), actuation=actuation), *SAID, *more)
    times = np.arange(0.0, 1.5, 0.05)
    what = "effort_command" if drive == "effort" else "position_command"
    size = 6.0 if drive == "effort" else 0.6
    commands = {
        f"{joint}.{what}": size / (1 + k) * np.sin(5.0 * times + k)
        for k, joint in enumerate(JOINTS)
    }
    if drive == "pd":
        for k, joint in enumerate(JOINTS):
            speed = 5.0 * size / (1 + k) * np.cos(5.0 * times + k)
            commands[f"{joint}.velocity_command"] = speed
    start = {"d.j1": 0.4, "d.j2": -0.6}
    channels = [f"{joint}.position" for joint in JOINTS]
    rows = SceneSimulation(scene).run(
        at_rest_but(start), times, channels, Commands(times, commands)
    )
    model, data = in_mujoco(to_mjcf(scene).text)
    data.qpos[:] = list(start.values())
    replayed = []
    for k in range(len(times)):
        replayed.append(np.array(data.qpos))
        for name, u in commands.items():
            joint, what = name.rsplit(".", 1)
            more = ".velocity" if what == "velocity_command" else ""
            data.actuator(joint + more).ctrl = u[k]
        for _ in range(50):
            mujoco.mj_step(model, data)
    # A first-order scheme of 1 ms, and dry friction as MuJoCo has it (soft).
    np.testing.assert_allclose(replayed, rows, atol=0.01)
    assert np.ptp(rows, axis=0).min() > 0.3


def test_drives_for_isaac_lab_do_in_mujoco_what_ours_do(tmp_path, monkeypatch):
    """Isaac Lab is not here: its law, as it is documented, on a mechanism without
    drives, friction and rotors, which all come from the written module."""
    late = ("input_delay", "d.j2", dict(delay=0.05))
    actuation = ActuationSection(
        type="pd", joints=list(JOINTS), kp=[40.0], kd=[1.5], limit=[9.0, 5.0]
    )
    scene = replace(double(tmp_path), actuation=actuation)
    scene = with_effects(
        scene, *SAID, ("servo_gain", "d.j2", dict(kp=25.0)), late, LOST
    )
    exported_module = exported(scene, ["isaaclab"])["isaaclab_actuators.py"]
    assert "# Not in this file: joint d.j1 has drag" in exported_module
    assert "late" not in exported_module.rpartition("}")[2]
    actuators = types.ModuleType("isaaclab.actuators")
    actuators.DelayedPDActuatorCfg = lambda **values: values
    monkeypatch.setitem(sys.modules, "isaaclab", types.ModuleType("isaaclab"))
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", actuators)
    made: dict = {}
    exec(exported_module.replace("PHYSICS_DT = 0.005", "PHYSICS_DT = 0.001"), made)
    of = {}
    for group in made["ACTUATORS"].values():
        assert group["min_delay"] == group["max_delay"]
        for name in group["joint_names_expr"]:
            of[name] = {k: v[name] for k, v in group.items() if isinstance(v, dict)}
            of[name]["delay"] = group["min_delay"]
    assert [of[name]["delay"] for name in ("j1", "j2")] == [0, 50]

    without = [each for each in scene.effects if each.kind != LOST[0]]
    times = np.arange(0.0, 1.5, 0.05)
    start = {"d.j1": 0.4, "d.j2": -0.6}
    commands = {
        f"{joint}.{what}_command": 0.6 * size * wave(5.0 * times + k)
        for what, size, wave in (("position", 1.0, np.sin), ("velocity", 5.0, np.cos))
        for k, joint in enumerate(JOINTS)
    }
    rows = SceneSimulation(replace(scene, effects=without)).run(
        at_rest_but(start), times, [f"{j}.position" for j in JOINTS],
        Commands(times, commands),
    )  # fmt: skip
    model, data = in_mujoco(to_mjcf(replace(scene, effects=without)).text)
    for name, drive in of.items():
        (i,) = model.joint(f"d.{name}").dofadr
        model.dof_armature[i], model.dof_damping[i] = (
            drive["armature"], drive["viscous_friction"],
        )  # fmt: skip
        model.dof_frictionloss[i] = drive["friction"]
        assert drive["dynamic_friction"] == drive["friction"]
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data.qpos[:] = list(start.values())
    replayed, whats = [], ("position", "velocity")
    for k in range(50 * len(times)):
        if k % 50 == 0:
            replayed.append(np.array(data.qpos))
        for i, (name, drive) in enumerate(of.items()):
            row = max(k - drive["delay"], 0) // 50
            p, v = (commands[f"d.{name}.{w}_command"][row] for w in whats)
            u = drive["stiffness"] * (p - data.qpos[i])
            u += drive["damping"] * (v - data.qvel[i])
            limit = drive["effort_limit"]
            data.qfrc_applied[i] = np.clip(u, -limit, limit)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(replayed, rows, atol=0.01)  # As above.


def test_an_effort_without_a_limit_leaves_that_of_the_asset(tmp_path):
    text = exported(double(tmp_path), ["isaaclab"])["isaaclab_actuators.py"]
    assert "stiffness={'j1': 0.0, 'j2': 0.0}" in text
    assert "effort_limit" not in text


def test_a_urdf_has_what_the_repaired_scene_has(tmp_path):
    base = with_effects(pendulum(tmp_path), ("rotor_inertia", "p", dict(inertia=0.07)))
    more = [
        Effect("joint_viscous_damping", ["p.j1"], {"damping": 0.3}),
        Effect("joint_coulomb_friction", ["p.j1"], {"coulomb": 0.2}),
        Effect("link_mass", ["p.rod"], {"mass": 0.25}),
        Effect(
            "payload", ["p.rod"],
            {"mass": 0.1, "com_x": 0.1, "com_y": 0.0, "com_z": -0.2},
        ),
    ]  # fmt: skip
    scene = replace(base, effects=[*base.effects, *more])
    exported = to_urdf(scene, "p")
    assert exported.omitted == ()
    assert 'friction="0.2"' in exported.text
    file = tmp_path / "again.urdf"
    file.write_text(exported.text)
    again = pendulum(tmp_path)
    again.directives[0].add_model.file = f"file://{file}"
    expected = load_scene(scene, DiagramBuilder()).plant
    plant = load_scene(again, DiagramBuilder()).plant
    for q in (0.3, -1.2):
        found = []
        for each in (expected, plant):
            context = each.CreateDefaultContext()
            each.SetPositions(context, [q])
            joint = each.GetJointByName("j1")
            found.append([
                each.CalcMassMatrix(context)[0, 0],
                each.CalcGravityGeneralizedForces(context)[0],
                joint.default_damping_vector()[0],
            ])  # fmt: skip
        np.testing.assert_allclose(found[1], found[0], rtol=1e-9)


# Without the products of inertia that may be left out, and a link without any inertia.
SDF = """<sdf version="1.9"><model name="d"><link name="base"/>
<link name="upper"><inertial><pose>0 0 -0.25 0.3 0 0</pose><mass>1.2</mass><inertia>
<ixx>0.03</ixx><iyy>0.03</iyy><izz>0.004</izz></inertia></inertial></link>
<link name="lower"><pose relative_to="upper">0 0 -0.5 0 0 0</pose><inertial>
<mass>0.7</mass><inertia><ixx>0.02</ixx><iyy>0.02</iyy><izz>0.003</izz>
<ixy>0.001</ixy></inertia></inertial></link>
<joint name="j1" type="revolute"><parent>base</parent><child>upper</child><axis>
<xyz>0 1 0</xyz></axis></joint>
<joint name="j2" type="revolute"><parent>upper</parent><child>lower</child><axis>
<xyz>0 1 0</xyz><dynamics><damping>0.05</damping></dynamics></axis></joint>
</model></sdf>"""


def test_sdf_moves_as_the_scene(tmp_path):
    base = double(tmp_path)
    (tmp_path / "d.sdf").write_text(SDF)
    base.directives[0].add_model.file = f"file://{tmp_path / 'd.sdf'}"
    of_body = [each for each in SAID if each[0] != "gravity_tilt"]
    scene = with_effects(base, *of_body)
    exported_text = exported(scene, ["sdf"])["d.sdf"]
    assert "Not in this file" not in exported_text
    (tmp_path / "again.sdf").write_text(exported_text)
    again = double(tmp_path)
    again.directives[0].add_model.file = f"file://{tmp_path / 'again.sdf'}"
    rng = np.random.default_rng(0)
    for q in rng.uniform(-2.0, 2.0, (3, 2)):
        found = []
        for each in (scene, again):
            plant = load_scene(each, DiagramBuilder()).plant
            context = plant.CreateDefaultContext()
            plant.SetPositions(context, q)
            damping = [plant.GetJointByName(j).default_damping() for j in ("j1", "j2")]
            found.append([
                *plant.CalcMassMatrix(context).ravel(),
                *plant.CalcGravityGeneralizedForces(context), *damping,
            ])  # fmt: skip
        np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    joint = ET.fromstring(exported_text.rpartition("\n<!--")[0] or exported_text)
    said = [float(x.text) for x in joint.iter("friction")]
    assert said == [0.4, 0.0]  # Drake reads no friction; Gazebo does.


# An arm with a gripper whose fingers go together; a link and a joint of one name.
GRIPPER = """<robot name="d"><link name="base"/>
<link name="fore"><inertial><origin xyz="0.1 0.02 0" rpy="0.2 0 0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0.001" iyz="0"/></inertial>
<collision><origin xyz="0.1 0 0" rpy="0 1.2 0"/><geometry>
<cylinder radius="0.02" length="0.2"/></geometry></collision>
<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual></link>
<link name="tool"><inertial><mass value="0.2"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<link name="finger"><inertial><origin xyz="0.02 0 0"/><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="other"><inertial><origin xyz="0.02 0 0"/><mass value="0.15"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="fore" type="revolute"><parent link="base"/><child link="fore"/>
<origin xyz="0 0.1 0.2" rpy="0.3 0.2 0.1"/><axis xyz="0 0.6 0.8"/>
<limit lower="-2" upper="1" effort="30" velocity="3"/><dynamics damping="0.1"/></joint>
<joint name="flange" type="fixed"><parent link="fore"/><child link="tool"/>
<origin xyz="0.3 0 0" rpy="0 0.5 0"/></joint>
<joint name="left" type="prismatic"><parent link="tool"/><child link="finger"/>
<origin xyz="0.1 0 0" rpy="0 0 0.4"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.05" effort="20" velocity="0.1"/></joint>
<joint name="right" type="prismatic"><parent link="tool"/><child link="other"/>
<origin xyz="0.1 0 0"/><axis xyz="0 -1 0"/><mimic joint="left" multiplier="0.5"
offset="0.01"/><limit lower="0" upper="0.05" effort="20" velocity="0.1"/></joint>
</robot>"""
# Bodies that stand in joints off their origin, one that is welded to the world.
CRANE = """<mujoco model="d"><compiler angle="radian"/><worldbody>
<body name="base" pos="0 0 .1"><geom type="box" size=".1 .2 .05" mass="3"/>
<body name="column" pos="0 .1 .2" euler=".3 .1 0"><joint name="yaw" axis="0 .3 1"
pos=".05 0 .1" range="-2 1" damping=".2" frictionloss=".1" armature=".02"/>
<geom type="capsule" fromto="0 0 0 .2 0 .1" size=".03" mass="1"/>
<body name="arm" pos=".2 0 .1" euler="0 .4 0"><joint name="slide" type="slide"
axis="1 0 0" range="0 .3" pos="0 .1 0"/><geom type="ellipsoid" size=".1 .05 .04"
mass=".7"/></body><body name="twin" pos="0 0 .3"><joint name="turn" axis="0 1 0"/>
<geom type="cylinder" size=".03 .1" mass=".4"/></body></body></body></worldbody>
<equality><joint joint1="turn" joint2="slide" polycoef=".2 3 0 0 0"/></equality>
<actuator><position joint="yaw" kp="50" kv="4" forcerange="-25 25"/></actuator>
</mujoco>"""
# The same with joints that nothing ties together, and without a rotor.
LOOSE = re.sub(r'<equality>[\s\S]*</equality>|armature=".02"', "", CRANE)


def shapes(scene_graph, context):
    """Every shape of the bodies that move: its role, kind and place in the world."""
    query = scene_graph.get_query_output_port().Eval(
        scene_graph.GetMyContextFromRoot(context)
    )
    inspector = query.inspector()
    return sorted(
        (str(role), type(inspector.GetShape(g)).__name__,
         *query.GetPoseInWorld(g).GetAsMatrix34().ravel().round(9))
        for role in (Role.kProximity, Role.kIllustration)
        for g in inspector.GetGeometryIds(GeometrySet(inspector.GetAllGeometryIds()),
                                          role)
        if inspector.GetFrameId(g) != inspector.world_frame_id()
    )  # fmt: skip


@pytest.mark.parametrize("which", ["urdf", "mjcf"])
def test_sdf_that_is_made_of_another_file_moves_as_the_scene(tmp_path, which):
    base = double(tmp_path)
    path, joint, body = {
        "urdf": (tmp_path / "grip.urdf", "d.fore", "d.tool"),
        "mjcf": (tmp_path / "crane.xml", "d.yaw", "d.arm"),
    }[which]
    path.write_text(GRIPPER if which == "urdf" else CRANE)
    base.directives[0].add_model.file = f"file://{path}"
    if which == "mjcf":  # Its own file welds its base.
        base.directives.pop()
    actuation = ActuationSection(type="effort", joints=[joint])
    effects = (
        ("joint_viscous_damping", joint, dict(damping=0.2)),
        ("rotor_inertia", joint, dict(inertia=0.05)),
        ("payload", body, dict(mass=0.4, com_x=0.05, com_y=0.01, com_z=-0.04)),
        LOST[:1] + (joint,) + LOST[2:],
    )
    plain = replace(base, actuation=actuation, initial=InitialSection())
    scene = with_effects(plain, *effects)
    one = "d.left" if which == "urdf" else "d.slide"
    two = "d.right" if which == "urdf" else "d.turn"
    still = replace(scene, fixed_joints={one: 0.01, two: 0.02})
    text = exported(still, ["sdf"])["d.sdf"]
    # An MJCF is written as its own file, where they move.
    stands = f"motion of joint {one}" in exported(still, ["mjcf"])["repaired.xml"]
    assert stands == (which == "urdf")
    assert ("joint fore is called fore_joint" in text) == (which == "urdf")
    assert "joint d.fore has drag" in text or "joint d.yaw has drag" in text
    (tmp_path / "again.sdf").write_text(text)
    again = copy.deepcopy(plain)
    again.directives[0].add_model.file = f"file://{tmp_path / 'again.sdf'}"
    if which == "urdf":
        joint = "d.fore_joint"
    again.actuation.joints = [joint]
    found = []
    for each in (scene, again):
        builder = DiagramBuilder()
        loaded = load_scene(each, builder)
        plant, diagram = loaded.plant, builder.Build()
        context = diagram.CreateDefaultContext()
        own = plant.GetMyMutableContextFromRoot(context)
        q = np.random.default_rng(0).uniform(-1.0, 1.0, plant.num_positions())
        plant.SetPositions(own, q)
        plant.SetVelocities(own, q)
        moving = [plant.get_joint(i) for i in plant.GetJointIndices()]
        moving = [j for j in moving if j.num_velocities()]
        limits = [
            [*j.position_lower_limits(), *j.position_upper_limits(),
             *j.velocity_upper_limits(), *j.default_damping_vector()]
            for j in moving
        ]  # fmt: skip
        found.append((
            plant.CalcMassMatrix(own), plant.CalcGravityGeneralizedForces(own),
            plant.CalcBiasTerm(own), limits,
            shapes(loaded.scene_graph, context),
        ))  # fmt: skip
    for a, b in zip(found[0][:4], found[1][:4], strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-12)
    assert found[0][4] == found[1][4] and len(found[0][4]) >= 3
    assert plant.num_constraints() == 1  # Drake has none of an MJCF file.
    root = ET.fromstring(text)
    mimic = root.find(".//axis/mimic")
    said = [
        mimic.get("joint"),
        *(float(mimic.find(t).text) for t in ("multiplier", "offset")),
    ]
    assert said == (["left", 0.5, 0.01] if which == "urdf" else ["slide", 3.0, 0.2])
    efforts = [float(e.text) for e in root.iter("effort")]
    assert efforts == ([30.0, 20.0, 20.0] if which == "urdf" else [25.0, 0.0, 0.0])


def test_a_urdf_is_written_of_a_xacro(tmp_path):
    scene = double(tmp_path)
    (file,) = tmp_path.glob("*.urdf")
    text = file.read_text().replace(
        '<robot name="d">',
        '<robot name="d" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:property name="heavy" value="${1 + 1.5}"/>',
    )
    file.with_suffix(".xacro").write_text(
        text.replace('value="0.8"', 'value="${heavy}"')
    )
    scene.directives[0].add_model.file = f"file://{file.with_suffix('.xacro')}"
    text = exported(scene, ["urdf"])["d.urdf"]
    masses = [float(m.get("value")) for m in ET.fromstring(text).iter("mass")]
    assert masses == [1.5, 2.5]


def test_an_mjcf_is_written_as_the_file_that_it_is(tmp_path):
    """Shapes, names and the servo's command stay; its gain, friction and loads are
    those of the scene, and it moves as our own simulation."""
    file = tmp_path / "crane.xml"
    file.write_text(LOOSE.replace('type="box"', 'type="box" contype="2"'))
    scene = double(tmp_path)
    scene.directives[:] = scene.directives[:1]
    scene.directives[0].add_model.file = f"file://{file}"
    actuation = ActuationSection(
        type="servo", joints=["d.yaw"], kp=[50.0], kd=[4.0], limit=[25.0],
        supply=SupplySection(voltage=[1e3], kt=[1.0], resistance=[1.0]),
    )  # fmt: skip
    scene = with_effects(
        replace(scene, actuation=actuation),
        ("servo_gain", "d.yaw", dict(kp=30.0)),
        ("joint_coulomb_friction", "d.slide", dict(coulomb=1.0)),
        ("joint_viscous_damping", "d.slide", dict(damping=3.0)),
        ("payload", "d.arm", dict(mass=0.4, com_x=0.05, com_y=0.01, com_z=-0.04)),
        ("joint_quadratic_drag", "d.turn", dict(coefficient=0.1)),
    )
    text = exported(scene, ["mjcf"])["repaired.xml"]
    assert "Not in this file: joint d.turn has drag" in text and "<position" in text
    assert text.count("Not in this file") == 1
    model, data = in_mujoco(text)
    given = mujoco.MjModel.from_xml_path(str(file))
    assert model.body("twin").id == given.body("twin").id and model.nbody == 5
    np.testing.assert_allclose(model.geom_size, given.geom_size, rtol=1e-5)
    np.testing.assert_array_equal(model.geom_contype, given.geom_contype)
    assert model.actuator_gainprm[0, 0] == 30.0 and model.nu == 1
    np.testing.assert_allclose(model.actuator_biasprm[0, :3], [0.0, -30.0, -4.0])
    # The file's, and the back-EMF of 1 V s on 1 ohm; then one of the effects.
    np.testing.assert_allclose(model.dof_damping, [1.2, 3.0, 0.0])
    np.testing.assert_allclose(model.actuator_forcerange, [[-25.0, 25.0]])
    said = [each for each in scene.effects if each.kind != "joint_quadratic_drag"]
    times = np.arange(0.0, 1.0, 0.05)
    commands = {"d.yaw.position_command": 0.6 * np.sin(5.0 * times)}
    names = ("yaw", "slide", "turn")
    rows = SceneSimulation(replace(scene, effects=said)).run(
        at_rest_but({"d.yaw": 0.0, "d.slide": 0.1, "d.turn": 0.4}), times,
        [f"d.{name}.position" for name in names], Commands(times, commands),
    )  # fmt: skip
    model.opt.timestep, replayed = 5e-4, []
    for off in (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_LIMIT):
        model.opt.disableflags |= off  # As in a continuous plant without contact.
    for name, q in zip(names, (0.0, 0.1, 0.4), strict=True):
        data.joint(name).qpos = q
    for k in range(len(times)):
        replayed.append([data.joint(name).qpos[0] for name in names])
        data.ctrl[0] = commands["d.yaw.position_command"][k]
        mujoco.mj_step(model, data, 100)
    np.testing.assert_allclose(replayed, rows, atol=0.01)  # As above.
    assert np.ptp(rows[:, :2], axis=0).min() > 0.3


@pytest.mark.parametrize("which", ["urdf", "mjcf"])
def test_a_robot_that_stands_on_nothing_is_free_in_what_is_written(tmp_path, which):
    """Its energies are those of the scene, in MuJoCo and of the SDF in Drake."""
    base = double(tmp_path)
    base.directives.pop()  # Welded to nothing.
    file, body, joint = tmp_path / "robot.urdf", "base", "fore"
    text = GRIPPER.replace(
        '<link name="base"/>',
        '<link name="base"><inertial><origin xyz="0 .02 .1"/><mass value="3"/><inertia '
        'ixx=".1" iyy=".2" izz=".2" ixy=".01" ixz="0" iyz="0"/></inertial></link>',
    ).replace('<mimic joint="left" multiplier="0.5"\noffset="0.01"/>', "")
    if which == "mjcf":
        file, joint = tmp_path / "robot.xml", "yaw"
        text = LOOSE.replace('pos="0 0 .1">', 'pos="0 0 .1"><freejoint/>', 1)
    file.write_text(text)
    base.directives[0].add_model.file = f"file://{file}"
    load = ("payload", f"d.{body}", dict(mass=0.4, com_x=0.05, com_y=0.01, com_z=-0.04))
    actuation = ActuationSection(type="effort", joints=[f"d.{joint}"])
    scene = with_effects(replace(base, actuation=actuation), load)
    texts = exported(scene, ["mjcf", "sdf"])
    told = "shapes, so nothing holds d.base" in texts["repaired.xml"]
    assert told == (which == "urdf")  # An MJCF is its own, with its shapes.
    model, data = in_mujoco(texts["repaired.xml"])
    start = [0.0, 0.0, 0.1 if which == "mjcf" else 0.0]
    np.testing.assert_allclose(model.body(1).pos, start)
    exact = 1e-9 if which == "urdf" else 1e-5  # MuJoCo writes six digits.
    (tmp_path / "again.sdf").write_text(texts["d.sdf"])
    again = replace(copy.deepcopy(base), actuation=ActuationSection(type="none"))
    again.directives[0].add_model.file = f"file://{tmp_path / 'again.sdf'}"
    plants = [load_scene(each, DiagramBuilder()).plant for each in (scene, again)]
    for each in plants:
        pose = each.GetDefaultFloatingBaseBodyPose(each.GetBodyByName("base"))
        np.testing.assert_allclose(pose.translation(), start)
    rng, heights = np.random.default_rng(0), []
    for _ in range(4):
        quat, p, w, v = (rng.normal(size=n) for n in (4, 3, 3, 3))
        X = RigidTransform(RotationMatrix(Quaternion(quat / np.linalg.norm(quat))), p)
        angles, rates = rng.uniform(-1, 1, (2, model.njnt - 1))
        names = [model.joint(i).name.rpartition(".")[2] for i in range(1, model.njnt)]
        energies = []
        for plant in plants:
            context = plant.CreateDefaultContext()
            own = plant.GetBodyByName(body)
            plant.SetFreeBodyPose(context, own, X)
            plant.SetFreeBodySpatialVelocity(context, own, SpatialVelocity(w, v))
            for name, q, rate in zip(names, angles, rates, strict=True):
                there = name if plant.HasJointNamed(name) else f"{name}_joint"
                one = plant.GetJointByName(there)
                turns = one.type_name() == "revolute"
                (one.set_angle if turns else one.set_translation)(context, q)
                rated = one.set_angular_rate if turns else one.set_translation_rate
                rated(context, rate)
            energies.append(
                [plant.CalcKineticEnergy(context), plant.CalcPotentialEnergy(context)]
            )
        data.qpos[:] = [*p, *X.rotation().ToQuaternion().wxyz(), *angles]
        data.qvel[:] = [*v, *(X.rotation().inverse() @ w), *rates]
        mujoco.mj_forward(model, data)
        momentum = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, momentum, data.qvel)
        mujoco.mj_energyPos(model, data)
        energies.append([0.5 * data.qvel @ momentum, data.energy[0]])
        kinetic, potential = np.transpose(energies)
        np.testing.assert_allclose(kinetic, kinetic[0], rtol=exact)
        heights.append(potential)
    # Potential energies may differ by a constant.
    change = np.diff(heights, axis=0)
    np.testing.assert_allclose(change, np.tile(change[:, :1], 3), rtol=exact)


def test_what_a_format_cannot_say_is_told(tmp_path):
    scene = with_effects(double(tmp_path), *SAID, LOST)
    (said,) = to_mjcf(scene).omitted
    assert "square of its speed" in said and "0.1" in said
    # The double pendulum's file has no transmissions to write rotors to.
    omitted = to_urdf(scene, "d").omitted
    assert [("rotor" in each) for each in omitted] == [False, True, True]
    (tmp_path / "ball.xml").write_text(
        LOOSE.replace('type="slide"', 'type="ball"').replace('range="0 .3" ', "")
    )
    scene.directives[:] = scene.directives[:1]
    scene.directives[0].add_model.file = f"file://{tmp_path / 'ball.xml'}"
    other = replace(scene, effects=[], actuation=ActuationSection(type="none"))
    with pytest.raises(ValueError, match="d.slide: only joints that turn or slide"):
        to_mjcf(other)
    assert formats_of(other) == []
    for write in (to_urdf, to_sdf):
        with pytest.raises(ValueError, match="'q' comes from no URDF"):
            write(scene, "q")


def test_what_is_offered_can_be_written(tmp_path):
    scene = double(tmp_path)
    assert formats_of(scene) == ["urdf", "sdf", "mjcf"]
    assert exported(scene, formats_of(scene))
    (tmp_path / "d.sdf").write_text(SDF)
    scene.directives[0].add_model.file = f"file://{tmp_path / 'd.sdf'}"
    assert formats_of(scene) == ["sdf", "mjcf"]
    assert exported(scene, formats_of(scene))
    assert formats_of(on_ground(tmp_path, "cube")) == ["sdf", "mjcf"]


def test_the_command_writes_what_is_asked_for(tmp_path):
    scene = with_effects(double(tmp_path), *SAID, LOST)
    files = exported(scene, ["mjcf", "urdf"])
    assert sorted(files) == ["d.urdf", "repaired.xml"]
    assert "<!-- Not in this file: joint d.j1 has drag" in files["repaired.xml"]
    in_mujoco(files["repaired.xml"])  # A comment after the end is no error.
    with pytest.raises(ValueError, match="--export: got 'step', expected some of urdf"):
        exported(scene, ["step"])
    with pytest.raises(ValueError, match="no model of the scene comes from URDF"):
        exported(on_ground(tmp_path, "cube"), ["urdf"])
