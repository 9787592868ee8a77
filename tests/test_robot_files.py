"""URDF, SDF and xacro as people have them: meshes, packages, inertias, friction."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.robot import propose_scene, read_log, read_robot
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.model_text import Inertial
from makebreak.models.model_export import to_mjcf, to_urdf
from makebreak.models.model_inertias import fault_of, faults_of, repaired
from makebreak.models.scene import load_scene, read_scene
from makebreak.models.scene_schema import without_shapes
from makebreak.scripts.cli import main

LINK = """<link name="{name}"><inertial><origin xyz="0 0 -0.2"/><mass value="{m}"/>
<inertia ixx="{I[0]}" iyy="{I[1]}" izz="{I[2]}" ixy="0" ixz="0" iyz="0"/></inertial>
{more}</link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{a}"/><child link="{b}"/>
<origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="50" velocity="9"/>{more}</joint>"""
GOOD = (0.02, 0.02, 0.01)


def link(name, m=1.0, I=GOOD, more=""):  # noqa: E741
    return LINK.format(name=name, m=m, I=I, more=more)


def joint(name, a, b, kind="revolute", more=""):
    return JOINT.format(name=name, a=a, b=b, kind=kind, more=more)


def robot(folder, *parts, name="arm.urdf"):
    text = f'<robot name="arm"><link name="base"/>{"".join(parts)}</robot>'
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def arm(folder, first="", second="", more="", I=GOOD, name="arm.urdf"):  # noqa: E741
    return robot(
        folder, link("l1", more=more), link("l2", I=I),
        joint("j1", "base", "l1", more=first), joint("j2", "l1", "l2", more=second),
        name=name,
    )  # fmt: skip


def scene_of(folder, path, more=""):
    scene = folder / "scene.yaml"
    scene.write_text(
        f'directives:\n- add_model: {{name: arm, file: "file://{path}"}}\n'
        "- add_weld: {parent: world, child: arm::base}\nplant: {time_step: 0}\n" + more
    )
    return read_scene(scene)


def plant_of(folder, path, more=""):
    return load_scene(scene_of(folder, path, more), DiagramBuilder())


def proposal_of(folder, path, names=("j1", "j2")):
    t = np.arange(0.0, 4.0, 0.01)
    table = {"time": t}
    for k, name in enumerate(names):
        table[f"{name}_pos"] = 0.2 * np.sin((2 + k) * t)
        table[f"{name}_effort"] = 0.2 * np.cos((2 + k) * t)
    np.savetxt(folder / "log.csv", np.column_stack(list(table.values())), "%.9g", ",",
               header=",".join(table), comments="")  # fmt: skip
    return propose_scene(read_robot(path), [read_log(folder / "log.csv")])


def test_an_sdf_with_pybullets_own_words_is_read(tmp_path):
    """Its gripper slides from the world, which is a link there."""
    path = tmp_path / "gripper.sdf"
    path.write_text("""<sdf version="1.6"><world name="default"><model name="g">
<link name="world"/><joint name="base_joint" type="prismatic"><parent>world</parent>
<child>base</child><axis><xyz>1 0 0</xyz></axis></joint><link name="base"><contact>
<lateral_friction>1.0</lateral_friction></contact><inertial><mass>2</mass></inertial>
<collision name="c" concave="yes"><geometry><box><size>1 1 1</size></box></geometry>
<material/></collision></link></model></world></sdf>""")
    own = read_robot(path)
    assert [j.name for j in own.joints] == ["g.base_joint"] and not own.bases
    (note,) = own.file.notes
    assert note == (
        "<contact> of <link>, concave of <collision>, <material> of <collision>: "
        "no words of SDF, which are left out"
    )


def test_a_package_elsewhere_in_a_workspace_is_found(tmp_path):
    """As a planner's configuration names the description that it is of."""
    own = tmp_path / "ws" / "src" / "descriptions" / "arm_description"
    own.mkdir(parents=True)
    (own / "package.xml").write_text("<package><name>arm_description</name></package>")
    arm(own)
    near = tmp_path / "ws" / "src" / "planning" / "config" / "planned.urdf.xacro"
    near.parent.mkdir(parents=True)
    near.write_text(
        '<robot name="arm" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include '
        'filename="$(find arm_description)/arm.urdf"/></robot>'
    )
    assert len(read_robot(near).joints) == 2


def test_an_sdf_as_gazebo_reads_it_is_read(tmp_path):
    """A joint with a link's name, a link as the frame of its own inertia, a script of a
    material beside its colour, and a limit that is not where SDF has it."""
    path = tmp_path / "wheel.sdf"
    path.write_text("""<sdf version="1.7"><model name="w"><link name="base"/>
<link name="wheel"><inertial><pose relative_to="wheel">0 0 0.1 0 0 0</pose><mass>2
</mass></inertial><visual name="v"><geometry><sphere><radius>1</radius></sphere>
</geometry><material><script><name>Red</name></script><diffuse>1 0 0 1</diffuse>
</material></visual></link><joint
name="wheel" type="revolute"><parent>base</parent><child>wheel</child><axis><xyz>0 0 1
</xyz><lower>-1</lower></axis></joint></model></sdf>""")
    own = read_robot(path)
    assert [j.name for j in own.joints] == ["w.wheel_joint"]
    assert own.plant.GetBodyByName("wheel").default_mass() == 2.0
    assert "<diffuse>" in own.file.text and "script" not in own.file.text
    assert own.file.notes == (
        "joint wheel has a link's name: it is called wheel_joint",
        "<lower> of <axis>: no words of SDF, which are left out",
    )


def test_columns_are_judged_by_inertias_as_the_scene_has_them(tmp_path):
    """Of a foot with moments and no mass Drake makes a ball of 1 kg."""
    foot = (
        '<link name="foot"><inertial><mass value="0"/><inertia ixx="5.7e-7" iyy="8e-7" '
        'izz="5e-7" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="ankle" '
        'type="fixed"><parent link="l2"/><child link="foot"/></joint>'
    )
    masses = []
    for more in ("", foot):
        path = arm(tmp_path)
        path.write_text(path.read_text().replace("</robot>", f"{more}</robot>"))
        plant = read_robot(path).plant
        masses.append(plant.CalcMassMatrix(plant.CreateDefaultContext()))
    np.testing.assert_allclose(masses[1], masses[0], atol=1e-6)


def mesh(uri, kind="collision"):
    return f'<{kind}><geometry><mesh filename="{uri}"/></geometry></{kind}>'


def box(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box((0.2, 0.4, 0.6)).export(
        path, file_type=path.suffix.lower()[1:]
    )


@pytest.mark.parametrize("name", ["a box.STL", "box.dae", "box.ply", "box.obj"])
def test_the_hull_of_a_mesh_of_any_format_is_that_of_its_corners(name, tmp_path):
    box(tmp_path / name)
    loaded = plant_of(tmp_path, arm(tmp_path, more=mesh(name)))
    body = loaded.plant.GetBodyByName("l1")
    (shape,) = loaded.plant.GetCollisionGeometriesForBody(body)
    hull = loaded.scene_graph.model_inspector().GetShape(shape).GetConvexHull()
    corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    # STL and DAE keep single precision.
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.2, 0.4, 0.6], atol=1e-6)


def test_a_scene_without_shapes_has_the_same_dynamics_and_reads_no_mesh(tmp_path):
    trimesh.creation.icosphere(5, 0.2).export(tmp_path / "ball.obj")
    scene = scene_of(tmp_path, arm(tmp_path, more=mesh("ball.obj")))
    bare = without_shapes(scene)
    with_mesh = SceneDynamics(scene)
    assert with_mesh.plant.num_collision_geometries() == 1
    (tmp_path / "ball.obj").write_text("no mesh any more")
    other = SceneDynamics(bare)
    assert other.plant.num_collision_geometries() == 0
    rng = np.random.default_rng(1)
    n = other.plant.num_velocities()
    motion = rng.normal(size=(3, 20, n))
    np.testing.assert_array_equal(
        other.inverse_dynamics(*motion), with_mesh.inverse_dynamics(*motion)
    )
    friction = Effect(
        "contact_friction", ["arm.tip", "world.ground"], {"friction": 1.0}
    )
    touching = replace(scene, effects=[friction])
    assert without_shapes(touching) is touching


def test_a_mesh_in_a_comment_and_one_for_display_stop_nothing(tmp_path):
    (tmp_path / "broken.stl").write_text("no mesh")
    more = f"<!-- {mesh('gone.stl')} -->" + mesh("broken.stl", "visual")
    more += mesh("gone.dae", "visual")
    plant = plant_of(tmp_path, arm(tmp_path, more=more)).plant
    assert plant.num_positions() == 2
    assert not proposal_of(tmp_path, tmp_path / "arm.urdf").copies


def test_a_broken_collision_mesh_is_named_and_left_out_of_a_proposal(tmp_path):
    (tmp_path / "broken.stl").write_text("no mesh")
    path = arm(tmp_path, more=mesh("broken.stl"))
    with pytest.raises(ValueError, match="broken.stl cannot be read as a mesh"):
        plant_of(tmp_path, path)
    assert list(proposal_of(tmp_path, path).copies) == ["arm_without_meshes.urdf"]


def test_packages_are_found_beside_above_and_in_the_paths_of_ros(tmp_path, monkeypatch):
    uri = "package://own_description/meshes/box.stl"
    ws = tmp_path / "ws"
    path = arm(tmp_path, more=mesh(uri), name="ws/bringup/urdf/arm.urdf")
    with pytest.raises(ValueError, match="package own_description is unknown"):
        plant_of(tmp_path, path)
    for k, (where, variable, value) in enumerate(
        (
            (ws / "own_description", None, None),  # Beside a folder above.
            (
                ws / "bringup",
                None,
                None,
            ),  # Above, by another name: a downloaded archive.
            (
                tmp_path / "ros/src/own_description",
                "ROS_PACKAGE_PATH",
                tmp_path / "ros",
            ),
            (
                tmp_path / "opt/share/own_description",
                "AMENT_PREFIX_PATH",
                tmp_path / "opt",
            ),
        )
    ):
        os.utime(path, (k, k))  # What was found is kept until the file changes.
        file = where / "meshes/box.stl"
        box(file)
        if variable:
            monkeypatch.setenv(variable, os.pathsep.join(["/nowhere", str(value)]))
        assert plant_of(tmp_path, path).plant.num_positions() == 2
        file.unlink()
        file.parent.rmdir()
        if where.name == "own_description":
            where.rmdir()


XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:include filename="$(find own_description)/urdf/parts.xacro"/>
<xacro:property name="mass" value="${2 * 1.5}"/><link name="base"/>
<xacro:part name="1" parent="base"/><xacro:part name="2" parent="l1"/></robot>"""


def test_xacro_is_expanded_with_its_includes(tmp_path):
    parts = link("l${name}", m="${mass}") + joint("j${name}", "${parent}", "l${name}")
    folder = tmp_path / "own_description/urdf"
    folder.mkdir(parents=True)
    (folder / "parts.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="part" '
        f'params="name parent">{parts}</xacro:macro></robot>'
    )
    path = folder / "arm.urdf.xacro"
    path.write_text(XACRO)
    plant = plant_of(tmp_path, path).plant
    assert plant.CalcTotalMass(plant.CreateDefaultContext()) == 6.0
    assert "own_description" in proposal_of(tmp_path, path).scene
    path.write_text(XACRO.replace("own_description", "nowhere"))
    with pytest.raises(ValueError, match="xacro says: .*package nowhere is unknown"):
        read_robot(path)
    path.write_text(XACRO.replace("find own_description", "arg name"))
    with pytest.raises(ValueError, match="expand it first: xacro arm.urdf.xacro ARG"):
        read_robot(path)


def test_an_argument_that_xacro_declares_below_has_its_default(tmp_path):
    """As in files that take their name from a launch file."""
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="$(arg own)">'
        '<xacro:arg name="own" default="given"/>'
        '<xacro:arg name="other" default="$(arg own)_2"/>'
        f'<link name="base"/>{link("l1")}{joint("$(arg other)", "base", "l1")}</robot>'
    )
    (only,) = read_robot(path).joints
    assert only.name == "given.given_2"


FRICTION = '<dynamics damping="0.3" friction="0.2"/>'


def test_friction_of_a_urdf_and_an_sdf_is_an_effect_of_the_scene(tmp_path):
    path = arm(tmp_path, FRICTION)
    (effect,) = scene_of(tmp_path, path).effects
    assert effect.kind == "joint_coulomb_friction" and effect.at == ["arm.j1"]
    assert effect.parameters == {"coulomb": 0.2}
    proposal = proposal_of(tmp_path, path)
    assert "parameters: {coulomb: 0.2}}  # From the file." in proposal.scene
    # What the scene itself says counts.
    own = "effects:\n- {kind: joint_coulomb_friction, at: arm, parameters: "
    (effect,) = scene_of(tmp_path, path, own + "{coulomb: 0.1}}\n").effects
    assert effect.parameters == {"coulomb": 0.1}
    assert not scene_of(tmp_path, path, "fixed_joints: {arm.j1: 0}\n").effects
    sdf = tmp_path / "arm.sdf"
    inertia = "".join(f"<i{k}>{0.1 if k in ('xx', 'yy', 'zz') else 0}</i{k}>"
                      for k in ("xx", "xy", "xz", "yy", "yz", "zz"))  # fmt: skip
    sdf.write_text(
        "<sdf version='1.9'><model name='arm'><link name='base'/><link name='l1'>"
        f"<inertial><mass>1</mass><inertia>{inertia}</inertia></inertial></link>"
        "<joint name='j1' type='revolute'><parent>base</parent><child>l1</child><axis>"
        "<xyz>0 1 0</xyz><dynamics><friction>0.4</friction></dynamics></axis></joint>"
        "</model></sdf>"
    )
    (effect,) = scene_of(tmp_path, sdf).effects
    assert effect.parameters == {"coulomb": 0.4}


def in_words(scene):
    return {(e.kind, *e.at): e.parameters for e in scene.effects}


def test_an_exported_model_is_read_back_as_the_same_scene(tmp_path):
    drive = """<transmission type="SimpleTransmission"><joint name="j1"/><actuator
name="m"/></transmission>"""
    path = robot(
        tmp_path, link("l1"), link("l2"), drive, joint("j1", "base", "l1",
        more=FRICTION), joint("j2", "l1", "l2"),
    )  # fmt: skip
    scene = scene_of(tmp_path, path)
    for name, text in (
        ("again.urdf", to_urdf(scene, "arm").text), ("again.xml", to_mjcf(scene).text),
    ):  # fmt: skip
        (tmp_path / name).write_text(text)
        again = tmp_path / "again.yaml"
        weld = "- add_weld: {parent: world, child: arm::base}\n"
        again.write_text(
            f'directives:\n- add_model: {{name: arm, file: "{name}"}}\n'
            + (weld if name.endswith("urdf") else "") + "plant: {time_step: 0}\n"
        )  # fmt: skip
        new = read_scene(again)
        plants = [load_scene(each, DiagramBuilder()).plant for each in (scene, new)]
        for q in ([0.3, -0.2], [1.2, 0.7]):
            found = []
            for plant in plants:
                context = plant.CreateDefaultContext()
                plant.SetPositions(context, q)
                gravity = plant.CalcGravityGeneralizedForces(context)
                found.append(np.vstack([plant.CalcMassMatrix(context), gravity]))
            np.testing.assert_allclose(*found, atol=1e-12)
        values = [list(in_words(each).values()) for each in (scene, new)]
        assert values[0] == values[1] == [{"coulomb": 0.2}], name


def test_what_nobody_uses_is_told_with_what_it_means(tmp_path):
    more = '<safety_controller k_velocity="9"/><calibration rising="0"/>'
    gear = (
        "<transmission><type>transmission_interface/SimpleTransmission</type><joint "
        "name='j1'/><actuator name='m'><mechanicalReduction>100</mechanicalReduction>"
        "</actuator></transmission><transmission><joint name='none'/></transmission>"
    )
    path = robot(
        tmp_path, link("l1"), link("l2"), gear, joint("j1", "base", "l1", more=more),
        joint("j2", "l1", "l2", more='<mimic joint="lost"/>'),
    )  # fmt: skip
    notes = "; ".join(proposal_of(tmp_path, path).notes)
    for words in ("1 <safety_controller> are not used", "1 <calibration> are not",
                  "mechanicalReduction of j1 100", "drives none, which is no joint",
                  "j2 follows lost, which is no joint"):  # fmt: skip
        assert words in notes


BAD = (0.001, 0.001, 0.03)


def test_all_impossible_inertias_are_listed_at_once_and_repaired(tmp_path):
    path = robot(
        tmp_path, link("l1", I=BAD), link("l2", I=(-0.01, 0.02, 0.02)),
        joint("j1", "base", "l1"), joint("j2", "l1", "l2"),
    )  # fmt: skip
    with pytest.raises(ValueError, match="link 'l1' has .*link 'l2' has .*--repair"):
        plant_of(tmp_path, path)
    text, changed = repaired(path.read_text())
    assert len(changed) == 2 and not faults_of(text)
    assert main(["inspect", str(path), "--repair", "--out", str(tmp_path / "o")]) == 0
    assert (tmp_path / "o/arm_repaired.urdf").read_text() == text
    (tmp_path / "new.urdf").write_text(text)
    assert plant_of(tmp_path, tmp_path / "new.urdf").plant.num_positions() == 2


def test_what_is_fixed_together_counts_together(tmp_path):
    """The mass matrix is that of the numbers in the file, as for one body."""
    fixed = joint("f", "l2", "camera", kind="fixed")
    path = robot(
        tmp_path, link("l1"), link("l2"), link("camera", m=0.1, I=(0, 0, 3e-3)), fixed,
        joint("j1", "base", "l1"), joint("j2", "l1", "l2"),
    )  # fmt: skip
    plant = plant_of(tmp_path, path).plant
    M = plant.CalcMassMatrix(plant.CreateDefaultContext())
    # About j2: both central moments about y, and m r^2: 0.2 m, and 0.4 + 0.2 m.
    expected = 0.02 + 0.0 + 1.0 * 0.2**2 + 0.1 * 0.6**2
    assert M[1, 1] == pytest.approx(expected, rel=1e-12)


def test_a_bad_inertia_that_does_not_move_is_no_defect(tmp_path):
    path = robot(
        tmp_path, link("foot", I=BAD), joint("f", "base", "foot", kind="fixed"),
        link("l1"), joint("j1", "base", "l1"), link("l2", I=BAD),
        joint("j2", "l1", "l2"),
    )  # fmt: skip
    with pytest.raises(ValueError) as error:
        plant_of(tmp_path, path)
    assert "l2" in str(error.value) and "foot" not in str(error.value)
    # Of a joint that the log has no column of nothing is moved, either.
    names = ("j1",)
    fixed = proposal_of(tmp_path, path, names).scene
    (tmp_path / "fixed.yaml").write_text(fixed)
    assert load_scene(tmp_path / "fixed.yaml", DiagramBuilder()).plant


def test_rounding_is_no_fault():
    for moments in ((-2e-22, 1e-6, 1e-6), (1e-20, -5e-20, 0.0), (0.01, 0.02, 0.03)):
        assert fault_of(Inertial(1.0, np.zeros(3), np.diag(moments))) == ""


def test_vectors_with_commas_are_those_with_blanks(tmp_path):
    path = arm(tmp_path)
    plain = read_robot(path).plant
    path = tmp_path / "commas.urdf"
    path.write_text((tmp_path / "arm.urdf").read_text().replace("0 0 -0.4", "0, 0 -.4"))
    own = read_robot(path)
    assert any("commas" in note for note in own.file.notes)
    mass = [p.CalcMassMatrix(p.CreateDefaultContext()) for p in (plain, own.plant)]
    np.testing.assert_allclose(mass[1], mass[0], rtol=1e-12)


@pytest.mark.parametrize(
    "shape",
    ['<cylinder radius="0.1" length="0.0"/>', '<box size="0.1 0 .2"/>',
     '<cylinder radius="0.10" length="0.05"/>'],
)  # fmt: skip
def test_shapes_of_no_size_are_left_out_and_said(tmp_path, shape):
    path = arm(tmp_path)
    solid = f"<collision><geometry>{shape}</geometry></collision>"
    path.write_text(path.read_text().replace("</inertial>", f"</inertial>{solid}", 1))
    own = read_robot(path)
    flat = "0.05" not in shape
    assert own.file.notes == (("1 shapes of a size of 0 are left out",) if flat else ())
    assert ("<collision>" in own.file.text) != flat


def test_what_other_readers_do_not_mind_is_read(tmp_path):
    """A declaration below a blank line, limits the wrong way round, one name of two
    actuators, and a variable of the environment."""
    drive = """<transmission name="{0}"><type>transmission_interface/SimpleTransmission
    </type><joint name="{0}"/><actuator name="motor"/></transmission>"""
    path = arm(tmp_path)
    text = path.read_text().replace('lower="-3" upper="3"', 'lower="1" upper="-1"', 1)
    text = (
        text.replace("</robot>", drive.format("j1") + drive.format("j2")) + "</robot>"
    )
    path.write_text("\n<!-- An arm -->\n<?xml version='1.0'?>\n" + text)
    own = read_robot(path)
    assert own.plant.num_actuators() == 2
    assert np.isinf(own.joints[0].lower) and own.joints[1].lower == -3.0
    assert any("taken to have none" in note for note in own.file.notes)
    path.write_text(text.replace('lower="1" upper="-1"', 'lower="0" upper="0"', 1))
    assert np.isinf(read_robot(path).joints[0].upper)  # As exporters of CAD have it.
    wheel = text.replace('lower="1" upper="-1"', 'lower="-1" upper="1"', 1)
    path.write_text(wheel.replace('type="revolute"', 'type="continuous"', 1))
    assert np.isinf(read_robot(path).joints[0].lower)
    path = tmp_path / "variables.urdf"
    text = text.replace('mass value="1.0"', 'mass value="$(optenv ARM_MASS 1.5)"', 1)
    path.write_text(text)
    own = read_robot(path)
    masses = [own.plant.GetBodyByName(n).default_mass() for n in ("l1", "l2")]
    assert masses == [1.5, 1.0]


def test_a_models_name_may_have_dots_and_brackets(tmp_path):
    """Its friction and its rotor are effects at `<model>.<joint>`."""
    path = arm(tmp_path, first=FRICTION)
    path.write_text(
        path.read_text().replace('robot name="arm"', 'robot name="a-1(v2.0)"')
    )
    assert [e.kind for e in read_robot(path).file.effects] == ["joint_coulomb_friction"]
    mjcf = tmp_path / "arm.xml"
    mjcf.write_text(
        '<mujoco model="a-1(v2.0)"><worldbody><body name="l1"><joint name="j1" axis='
        '"0 1 0" armature="0.3"/><inertial pos="0 0 -.1" mass="1" '
        'diaginertia=".1 .1 .1"'
        "/></body></worldbody></mujoco>"
    )
    own = read_robot(mjcf)
    assert own.model == "a_1_v2_0_" and own.joints[0].name == "a_1_v2_0_.j1"
    plant = own.plant
    mass = plant.CalcMassMatrix(plant.CreateDefaultContext())[0, 0]
    assert mass == pytest.approx(0.1 + 0.01 + 0.3)


def test_a_link_called_world_is_the_world(tmp_path):
    """As ROS has it, here with a bad inertia that nobody needs."""
    path = robot(
        tmp_path, link("world", m=0.0), link("l1"), joint("j1", "world", "l1"),
        link("l2"), joint("j2", "l1", "l2"),
    )  # fmt: skip
    path.write_text(path.read_text().replace('<link name="base"/>', ""))
    own = read_robot(path)
    assert not own.bases and len(own.joints) == 2
    (tmp_path / "scene.yaml").write_text(proposal_of(tmp_path, path).scene)
    loaded = load_scene(tmp_path / "scene.yaml", DiagramBuilder())
    assert loaded.plant.num_positions() == 2


PACKAGE = Path(trimesh.__file__).parents[1] / (
    "cmeel.prefix/share/example-robot-data/robots"
)
# Of links that move: more than the two others together, or negative.
IMPOSSIBLE = {"alex_psyonic_hands", "allegro_left_hand", "allegro_right_hand",
              "romeo_laas_small", "romeo_small"}  # fmt: skip
NO_JOINT = {"quadrotor_base", "iris_simple"}


@pytest.mark.slow
def test_public_urdfs_are_accepted_or_refused_for_their_defect(tmp_path):
    """Each with a log of all its joints, as `makebreak gap ROBOT LOG` takes it."""
    if not PACKAGE.is_dir():
        pytest.skip("example-robot-data is not installed (extra `meshes`)")
    refused = {}
    files = sorted(PACKAGE.rglob("*.urdf"))
    for path in files:
        try:
            own = read_robot(path)
            names = [j.name.partition(".")[2] for j in own.joints]
            proposal = proposal_of(tmp_path, path, names)
            for name, text in proposal.copies.items():
                (tmp_path / name).write_text(text)
            (tmp_path / "proposed.yaml").write_text(proposal.scene)
            load_scene(tmp_path / "proposed.yaml", DiagramBuilder())
        except ValueError as error:
            refused[path.stem] = str(error)
    assert set(refused) == IMPOSSIBLE | NO_JOINT | {"ur3", "icub"}
    said = dict.fromkeys(IMPOSSIBLE, "central moments")
    said |= dict.fromkeys(NO_JOINT, "no joint that turns")
    said |= {"ur3": "has no <link>", "icub": "neck_roll can move .* without any iner"}
    for name, message in refused.items():
        assert re.search(said[name], message)
    assert len(files) - len(refused) == 60


@pytest.mark.parametrize("radius, overlap", [(0.5, True), (0.1, False)])
def test_shapes_that_lie_in_each_other_in_a_log_do_not_push(tmp_path, radius, overlap):
    """A ball around the end, and one at the base: only the log tells that they meet."""
    ball = (
        '<collision name="ball"><origin xyz="0 0 {z}"/><geometry>'
        f'<sphere radius="{radius}"/></geometry></collision>'
    )
    path = robot(
        tmp_path, link("l0", more=ball.format(z=0)), link("l1"),
        link("l2", more=ball.format(z=0)), joint("j0", "base", "l0", "fixed"),
        joint("j1", "l0", "l1"), joint("j2", "l1", "l2"),
        link("l3"), joint("j3", "l2", "l3"),
    )  # fmt: skip
    proposal = proposal_of(tmp_path, path)
    assert "fixed_joints: {arm.j3: 0}" in proposal.scene
    (tmp_path / "scene.yaml").write_text(proposal.scene)
    builder = DiagramBuilder()
    plant = load_scene(tmp_path / "scene.yaml", builder).plant
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    plant.SetPositions(context, [0.0, 0.0])
    query = plant.get_geometry_query_input_port().Eval(context)
    assert query.ComputePointPairPenetration() == []
    said = [each.says for each in proposal.said if each.kind == "parts_overlap"]
    assert bool(said) == overlap
    if overlap:
        assert "arm::l0 and arm::l2 lie in each other" in said[0]
