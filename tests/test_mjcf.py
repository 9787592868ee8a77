"""MJCF as MuJoCo compiles it: what Drake then has is equal to MuJoCo."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.models.scene import load_scene, read_scene

mujoco = pytest.importorskip("mujoco", reason="MuJoCo has no wheels for Python 3.10")

BAR = '<inertial pos="0.02 0 -.15" mass="1.2" diaginertia=".012 .011 .002"/>'
FORE = '<inertial pos="0 .01 -.12" mass=".8" diaginertia=".006 .005 .002"/>'


def arm(joint1='axis="0 1 0"', joint2='axis="1 0 .3"', more="", top="", fore=FORE):
    return (
        f"<mujoco model='arm'>{top}<worldbody><body name='upper' pos='0 .1 1'>"
        f"<joint name='j1' {joint1}/>{BAR}<body name='fore' pos='0 0 -.3' "
        f"euler='20 30 0'><joint name='j2' {joint2}/>{fore}</body></body></worldbody>"
        f"{more}</mujoco>"
    )


CLASSES = """<default><default class="a"><joint axis="0 1 0"
armature="0.05" damping=".4"
range="-2 2"/><default class="b"><default class="c"><joint range="-1 1"/></default>
</default></default></default>"""
FILES = {
    "nested classes": arm('class="c"', 'class="b"', top=CLASSES),
    "gear": arm(more='<actuator><motor joint="j1" gear="50"/></actuator>'),
    "armature alone": arm(joint2='axis="1 0 0" armature="0.3"'),
    "armature of a motor": arm(
        more='<actuator><motor joint="j1" gear="9" armature=".01"/></actuator>'
    ),
    "servos": arm(
        more='<actuator><position joint="j1" kp="40" kv="2"/><general joint="j2" '
        'gainprm="30" biastype="affine" biasprm="0 -30 -1"/></actuator>'
    ),
    "reference and offset": arm(
        'axis="0 1 0" ref="35" pos=".1 0 .2"', 'axis="1 0 0" ref="-70" pos="0 0 .1"'
    ),
    "springs and friction": arm(
        'axis="0 1 0" stiffness="3" springref="20"', 'axis="1 0 0" frictionloss=".5"'
    ),
    "inertia of geoms": arm(
        fore='<geom type="capsule" size=".03" fromto="0 0 0 .1 0 -.3"/>'
        '<geom type="box" size=".1 .02 .03" pos="0 .1 0" euler="10 20 30"/>'
    ),
    "compiler": arm(
        top='<compiler angle="radian" eulerseq="zyx" '
        'boundinertia="0.01"/>'
    ),
    "three joints in a body": arm(
        fore=FORE + '<joint name="j3" axis="0 0 1" pos="0 .1 0" ref="40"/>'
        '<joint name="j4" type="slide" axis="0 1 0" ref=".2"/>'
    ),
    "free base": arm(more="").replace("</worldbody>", "").replace(
        "<worldbody>",
        "<worldbody><geom type='plane' size='0 0 1'/><body name='trunk' pos='0 0 2'>"
        "<freejoint/><geom type='box' size='.2 .1 .1' mass='5'/>",
    ).replace("</mujoco>", "</body></worldbody></mujoco>"),
    "ball": arm('type="ball" pos="0 0 .1"'),
    "keyframe": arm(more='<keyframe><key qpos="0.3 -0.4"/></keyframe>'),
    "equality": arm(
        more='<equality><connect body1="fore" body2="world" anchor="0 0 0"/>'
        "</equality>"
    ),
    "planar base": arm('type="slide" axis="1 0 0"').replace(
        "<body name='fore'", "<joint name='z' type='slide' axis='0 0 1'/>"
        "<joint name='pitch' axis='0 1 0'/><body name='fore'",
    ),
}  # fmt: skip


def loaded(folder, text, name="arm.xml"):
    (folder / name).write_text(text)
    return of_file(folder, folder / name)


def of_file(folder, path):
    scene = folder / "scene.yaml"
    scene.write_text(
        f'directives: [add_model: {{name: arm, file: "file://{path}"}}]\n'
        "plant: {time_step: 0}\n"
    )
    return read_scene(scene), load_scene(scene, DiagramBuilder()).plant


def compare(path, plant, rng, states=10):
    """Mass matrix, bias and gravity of the plant are those of MuJoCo, to 1e-9 of the
    largest entry (both compute in double precision, with sums of some hundred terms).
    """
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    plant.mutable_gravity_field().set_gravity_vector(model.opt.gravity)
    context = plant.CreateDefaultContext()
    n = model.nv
    assert plant.num_velocities() == n
    for _ in range(states):
        data.qpos[:] = rng.uniform(-1, 1, model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        data.qvel[:] = rng.uniform(-2, 2, n)
        mujoco.mj_forward(model, data)
        # T: the plant's velocities are T times MuJoCo's.
        T = np.zeros((n, n))
        for j in range(model.njnt):
            dof, at = model.jnt_dofadr[j], model.jnt_qposadr[j]
            body = plant.GetBodyByName(
                model.body(model.jnt_bodyid[j]).name or f"body_{model.jnt_bodyid[j]}"
            )
            if model.jnt_type[j] == 0:
                R = data.xmat[model.jnt_bodyid[j]].reshape(3, 3)
                start = body.floating_velocities_start_in_v()
                T[start : start + 3, dof + 3 : dof + 6] = R
                T[start + 3 : start + 6, dof : dof + 3] = np.eye(3)
                plant.SetFreeBodyPose(context, body, pose(data.qpos[at : at + 7]))
                continue
            joint = plant.GetJointByName(model.joint(j).name or f"joint_{j}")
            start = joint.velocity_start()
            if model.jnt_type[j] == 1:
                R = pose([0, 0, 0, *data.qpos[at : at + 4]]).rotation()
                joint.set_angles(context, angles(R))
                T[start : start + 3, dof : dof + 3] = R.matrix()
            else:
                T[start, dof] = 1.0
                q = plant.GetPositions(context)
                q[joint.position_start()] = data.qpos[at]
                plant.SetPositions(context, q)
        plant.SetVelocities(context, T @ data.qvel)
        M = np.array([column(model, data, e) for e in np.eye(n)])
        for j in np.flatnonzero(model.jnt_type < 2):  # Told: no rotor of a ball.
            dofs = np.arange(6 - 3 * model.jnt_type[j]) + model.jnt_dofadr[j]
            M[dofs, dofs] -= model.dof_armature[dofs]
        size = np.abs(M).max()
        np.testing.assert_allclose(
            T.T @ plant.CalcMassMatrix(context) @ T, M, atol=1e-9 * size
        )
        gravity = -plant.CalcGravityGeneralizedForces(context)
        bias = T.T @ (plant.CalcBiasTerm(context) + gravity)
        size = max(np.abs(data.qfrc_bias).max(), 1.0)
        np.testing.assert_allclose(bias, data.qfrc_bias, atol=1e-9 * size)
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(T.T @ gravity, data.qfrc_bias, atol=1e-9 * size)


def column(model, data, unit):
    out = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, out, unit)
    return out


def pose(q):
    from pydrake.common.eigen_geometry import Quaternion
    from pydrake.math import RigidTransform

    return RigidTransform(Quaternion(np.array(q[3:]) / np.linalg.norm(q[3:])), q[:3])


def angles(R):
    from pydrake.math import RollPitchYaw

    return RollPitchYaw(R).vector()


@pytest.mark.parametrize("which", FILES)
def test_mass_matrix_bias_and_gravity_are_those_of_mujoco(which, tmp_path):
    _, plant = loaded(tmp_path, FILES[which])
    compare(tmp_path / "arm.xml", plant, np.random.default_rng(0))
    model = mujoco.MjModel.from_xml_string(FILES[which])
    for j in range(model.njnt):
        if model.jnt_type[j] < 2:
            continue
        joint = plant.GetJointByName(model.joint(j).name)
        if model.jnt_limited[j]:
            low, high = joint.position_lower_limits(), joint.position_upper_limits()
            np.testing.assert_allclose([*low, *high], model.jnt_range[j])
        damping = model.dof_damping[model.jnt_dofadr[j]]
        np.testing.assert_allclose(joint.default_damping_vector(), [damping])


def test_friction_springs_and_rotors_are_effects_of_the_scene(tmp_path):
    scene, _ = loaded(tmp_path, FILES["springs and friction"])
    found = {(e.kind, *e.at): e.parameters for e in scene.effects}
    spring = found["joint_spring", "arm.j1"]
    assert spring["stiffness"] == 3.0
    assert spring["rest"] == pytest.approx(np.radians(20.0))
    assert found["joint_coulomb_friction", "arm.j2"] == {"coulomb": 0.5}
    scene, _ = loaded(tmp_path, FILES["armature alone"])
    (rotor,) = scene.effects
    assert (rotor.kind, rotor.parameters) == ("rotor_inertia", {"inertia": 0.3})
    scene, _ = loaded(tmp_path, FILES["keyframe"])
    assert scene.initial.positions == {"arm.j1": 0.3, "arm.j2": -0.4}


def proposed(folder, text, columns):
    (folder / "arm.xml").write_text(text)
    t = np.arange(0.0, 4.0, 0.01)
    table = {"time": t}
    for k, name in enumerate(columns):
        table[name] = 0.2 * np.sin((2 + k) * t)
    np.savetxt(folder / "log.csv", np.column_stack(list(table.values())), "%.9g", ",",
               header=",".join(table), comments="")  # fmt: skip
    robot = read_robot(folder / "arm.xml")
    return propose_scene(robot, [read_log(folder / "log.csv")])


def test_columns_are_held_against_the_gravity_of_the_file(tmp_path):
    """Else efforts of a world without weight would be said to lack it."""
    path = tmp_path / "arm.xml"
    path.write_text(arm(top='<option gravity="0 1 -2"/>'))
    g = read_robot(path).plant.gravity_field().gravity_vector()
    np.testing.assert_array_equal(g, [0.0, 1.0, -2.0])


def test_a_gear_is_applied_to_commands_of_effort_and_said(tmp_path):
    text = arm(more="<actuator><motor joint='j1' gear='50'/><motor joint='j2' "
               "gear='50'/></actuator>")  # fmt: skip
    names = ["j1_pos", "j2_pos", "j1_effort_command", "j2_effort_command"]
    (sidecar,) = proposed(tmp_path, text, names).sidecars.values()
    assert sidecar.count("scale: 50.0") == 2
    assert "the gear 50 of arm.xml" in sidecar


def test_gains_of_a_files_servos_become_the_drives(tmp_path):
    names = ["j1_pos", "j2_pos", "j1_position_command", "j2_position_command"]
    scene = proposed(tmp_path, FILES["servos"], names).scene
    assert "kp: [40.0, 30.0]  # [N m/rad]" in scene and "kd: [2.0, 1.0]" in scene
    assert "guess" not in scene
    slide = FILES["servos"].replace("name='j2'", "name='j2' type='slide'")
    scene = proposed(tmp_path, slide, names).scene
    assert "# [N m/rad or N/m]" in scene and "# [N m s/rad or N s/m]" in scene


def test_ctrl_is_what_the_files_own_actuator_takes(tmp_path):
    names = ["j1_pos", "j2_pos", "j1_ctrl", "j2_ctrl"]
    scene = proposed(tmp_path, FILES["servos"], names).scene
    assert "type: servo" in scene
    velocity = '<actuator><velocity joint="j1" kv="3"/><velocity joint="j2" kv="2"/>'
    scene = proposed(tmp_path, arm(more=f"{velocity}</actuator>"), names).scene
    assert "type: velocity" in scene
    motors = '<actuator><motor joint="j1"/><motor joint="j2"/></actuator>'
    assert "type: effort" in proposed(tmp_path, arm(more=motors), names).scene


def test_what_is_left_out_is_told(tmp_path):
    proposal = proposed(tmp_path, FILES["equality"], ["j1_pos", "j2_pos"])
    assert any("equality constraint of type connect" in n for n in proposal.notes)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize("file", [None, POINTER], ids=["missing", "pointer"])
@pytest.mark.parametrize("touches, count", [(0, 0), (1, 1)])
def test_a_mesh_that_is_not_there_stops_nothing_where_nothing_is_touched(
    touches, count, file, tmp_path
):
    if file is not None:
        (tmp_path / "gone.stl").write_text(file)
    asset = '<asset><mesh name="m" file="gone.stl"/></asset>'
    geom = f'<geom type="mesh" mesh="m" contype="{touches}" conaffinity="{touches}"/>'
    text = arm(top=asset, fore=FORE + geom)
    proposal = proposed(tmp_path, text, ["j1_pos", "j2_pos"])
    assert len(proposal.copies) == count
    heavy = arm(top=asset, fore=geom)
    (tmp_path / "arm.xml").write_text(heavy)
    with pytest.raises(ValueError, match="gone.stl .*its inertia is that of its shape"):
        read_robot(tmp_path / "arm.xml")


SHIPPED = sorted((Path(mujoco.__file__).parent / "testdata").glob("*.xml"))
LEG = Path(__file__).parents[2] / "shared/data/quadruped_leg/leg.xml"


@pytest.mark.parametrize("path", [*SHIPPED, LEG], ids=lambda path: path.name)
def test_files_of_others_are_equal_to_mujoco(path, tmp_path):
    if not path.is_file():
        pytest.skip(f"{path.name} is not there")
    if not mujoco.MjModel.from_xml_path(str(path)).nv:
        pytest.skip(f"{path.name} has no joints")
    _, plant = of_file(tmp_path, path)
    compare(path, plant, np.random.default_rng(1))


@pytest.mark.parametrize(
    ("bits", "more"),
    [
        ({}, ""),
        # A robot that touches the floor and not itself, as many files have it.
        (dict.fromkeys(("trunk", "leg", "foot", "arm"), 'contype="0"'), ""),
        ({"floor": 'contype="2"', "foot": 'conaffinity="3"', "arm": 'contype="4"'}, ""),
        (dict.fromkeys(("trunk", "leg", "foot", "arm"), 'contype="0" conaffinity="0"'),
         '<contact><pair geom1="floor" geom2="foot"/><pair geom1="arm" geom2="leg"/>'
         "</contact>"),
        ({}, '<contact><exclude body1="foot" body2="trunk"/></contact>'),
        ({}, '<option><flag contact="disable"/></option>'),
    ],
)  # fmt: skip
def test_what_may_touch_is_what_touches_in_mujoco(tmp_path, bits, more):
    """All shapes are in one another: what does not touch in MuJoCo may not."""

    def shape(name):
        return f'<geom name="{name}" size=".1" {bits.get(name, "")}/>'

    text = (
        f'<mujoco><worldbody><geom name="floor" type="plane" size="2 2 .1" '
        f'{bits.get("floor", "")}/><body name="trunk"><freejoint/>{shape("trunk")}'
        f'<body name="leg"><joint/>{shape("leg")}<body name="foot"><joint axis="1 0 0"'
        f'/>{shape("foot")}</body></body><body name="arm"><joint/>{shape("arm")}'
        f"</body></body></worldbody>{more}</mujoco>"
    )
    (tmp_path / "arm.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    expected = {
        frozenset(model.geom(g).name for g in (c.geom1, c.geom2)) for c in data.contact
    }
    assert len(expected) < 10  # Of five shapes.
    (tmp_path / "scene.yaml").write_text(
        "directives:\n- add_model: {name: arm, file: arm.xml}\n"
    )
    loaded = load_scene(read_scene(tmp_path / "scene.yaml"), DiagramBuilder())
    inspector = loaded.scene_graph.model_inspector()
    found = {
        frozenset(inspector.GetName(g).rpartition("::")[2] for g in pair)
        for pair in inspector.GetCollisionCandidates()
    }
    assert found == expected
