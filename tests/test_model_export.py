"""A repaired scene as MJCF and URDF: the same mechanism in MuJoCo and in Drake."""

import sys
import types
from dataclasses import replace
from xml.etree import ElementTree as ET

import mujoco
import numpy as np
import pytest
from effect_scenes import at_rest_but, double, on_ground, pendulum, with_effects
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import Effect
from makebreak.models.model_export import formats_of, to_mjcf, to_urdf
from makebreak.models.scene import ActuationSection, load_scene
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


def test_what_a_format_cannot_say_is_told(tmp_path):
    scene = with_effects(double(tmp_path), *SAID, LOST)
    (said,) = to_mjcf(scene).omitted
    assert "square of its speed" in said and "0.1" in said
    # The double pendulum's file has no transmissions to write rotors to.
    omitted = to_urdf(scene, "d").omitted
    assert [("rotor" in each) for each in omitted] == [False, True, True]
    with pytest.raises(ValueError, match="b.box: only mechanisms"):
        to_mjcf(on_ground(tmp_path, "cube"))
    with pytest.raises(ValueError, match="'q' comes from no URDF"):
        to_urdf(scene, "q")


def test_what_is_offered_can_be_written(tmp_path):
    scene = double(tmp_path)
    assert formats_of(scene) == ["urdf", "mjcf"]
    assert exported(scene, formats_of(scene))
    (tmp_path / "d.sdf").write_text(SDF)
    scene.directives[0].add_model.file = f"file://{tmp_path / 'd.sdf'}"
    assert formats_of(scene) == ["sdf", "mjcf"]
    assert exported(scene, formats_of(scene))
    assert formats_of(on_ground(tmp_path, "cube")) == []


def test_the_command_writes_what_is_asked_for(tmp_path):
    scene = with_effects(double(tmp_path), *SAID, LOST)
    files = exported(scene, ["mjcf", "urdf"])
    assert sorted(files) == ["d.urdf", "repaired.xml"]
    assert "<!-- Not in this file: joint d.j1 has drag" in files["repaired.xml"]
    in_mujoco(files["repaired.xml"])  # A comment after the end is no error.
    with pytest.raises(ValueError, match="--export: got 'step', expected some of urdf"):
        exported(scene, ["step"])
    with pytest.raises(ValueError, match="no model of the scene comes from SDF"):
        exported(scene, ["sdf"])
    with pytest.raises(ValueError, match="no model of the scene comes from URDF"):
        exported(on_ground(tmp_path, "cube"), ["urdf"])
