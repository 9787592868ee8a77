"""A repaired scene as MJCF and URDF: the same mechanism in MuJoCo and in Drake."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effect_scenes import at_rest_but, double, on_ground, pendulum, with_effects
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import Effect
from makebreak.models.model_export import to_mjcf, to_urdf
from makebreak.models.scene import ActuationSection, load_scene
from makebreak.models.scene_schema import SupplySection
from makebreak.scripts.gap_command import exported

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


@pytest.mark.parametrize("drive", ["effort", "servo"])
def test_mujoco_replays_what_drake_simulates(tmp_path, drive):
    actuation = ActuationSection(type="effort", joints=list(JOINTS))
    more = []
    if drive == "servo":
        actuation = ActuationSection(
            type="servo", joints=list(JOINTS), kp=[40.0], kd=[0.5], limit=[14.0, 5.0],
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
        data.ctrl[:] = [u[k] for u in commands.values()]
        for _ in range(50):
            mujoco.mj_step(model, data)
    # A first-order scheme of 1 ms, and dry friction as MuJoCo has it (soft).
    np.testing.assert_allclose(replayed, rows, atol=0.01)
    assert np.ptp(rows, axis=0).min() > 0.3


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


def test_the_command_writes_what_is_asked_for(tmp_path):
    scene = with_effects(double(tmp_path), *SAID, LOST)
    files = exported(scene, ["mjcf", "urdf"])
    assert sorted(files) == ["d.urdf", "repaired.xml"]
    assert "<!-- Not in this file: joint d.j1 has drag" in files["repaired.xml"]
    in_mujoco(files["repaired.xml"])  # A comment after the end is no error.
    with pytest.raises(ValueError, match="--export: got 'sdf', expected some of urdf"):
        exported(scene, ["sdf"])
    with pytest.raises(ValueError, match="no model of the scene comes from a URDF"):
        exported(on_ground(tmp_path, "cube"), ["urdf"])
