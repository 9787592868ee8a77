"""A scene with a mistake in it: one line says what, what came, what was expected."""

import hashlib
import logging
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.scene import load_scene, read_scene
from makebreak.models.scene_reader import give_packages
from makebreak.models.scene_schema import TIME_STEP_MIN
from makebreak.models.typed_yaml import DEPTH_MAX, load_yaml

INERTIAL = """<inertial><origin xyz="0 0 -0.3"/><mass value="{mass}"/><inertia
 ixx="{i}" iyy="{i}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>"""
ROBOT = """<robot name="r"><link name="base"/><link name="l1">{link}</link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
<axis xyz="0 1 0"/><limit effort="10" lower="-3" upper="3" velocity="10"/></joint>
{more}</robot>"""
TRANSMISSION = """<transmission name="t"><type>transmission_interface/SimpleTransmission
</type><joint name="j1"/><actuator name="a"/></transmission>"""
SCENE = """directives:
- add_model: {name: r, file: r.urdf}
- add_weld: {parent: world, child: 'r::base'}
"""
SOLID = INERTIAL.format(mass=1, i=0.01, izz=0.01)


def robot(folder: Path, link: str = SOLID, more: str = "") -> None:
    (folder / "r.urdf").write_text(ROBOT.format(link=link, more=more))


def plant_of(folder: Path, text: str):
    (folder / "s.yaml").write_text(text)
    return load_scene(folder / "s.yaml", DiagramBuilder()).plant


def refused(folder: Path, text: str) -> str:
    with pytest.raises(ValueError) as error:
        plant_of(folder, text)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("plannt: {}", "unknown key plannt; did you mean plant?"),
        ("plant: {timestep: 1}", "unknown key plant.timestep; did you mean plant.ti"),
        ("plant: {time_step: .inf}", 'plant.time_step: got ".inf", expected a number'),
        ("plant: {time_step: 1e-12}", "got 1e-12, expected 0 (continuous) or at least"),
        ("plant: {time_step: 1}", "plant.time_step: got"),
        ("plant: {gravity: [0, 0, .inf]}", 'plant.gravity[2]: got ".inf"'),
        ("plant: {gravity: [0, 0, 9810]}", "expected a number from -1000 to 1000"),
        ("plant: {contact_model: foo}", 'plant.contact_model: got "foo", expected one'),
        ("plant: 3", 'plant: got "3", expected a mapping, with any of: time_step'),
        ("actuation: {type: pd, joints: [r.j1], kp: [1, 2], kd: [1]}", "actuation.kp"),
        ("actuation: {type: pd, joints: [r.j1], kp: [1]}", "actuation.kd is []"),
        ("actuation: {type: pd, joints: [r.j1], kp: [-1], kd: [1]}", "kp[0]: got"),
        ("actuation: {type: effort, joints: [r.j1, r.j1]}", "r.j1 more than once"),
        ("actuation: {type: effort}", "add `joints: [r.j1]` to it"),
        ("actuation: {type: effort, rate_hz: .inf}", "actuation.rate_hz: got"),
        ("tolerance: {link_maas: 0.1}", "unknown key link_maas; did you mean link_ma"),
        ("tolerance: {link_mass: -0.1}", "tolerance.link_mass: got -0.1, expected"),
        ("tolerance: {link_mass: .inf}", "tolerance.link_mass: got inf, expected"),
        ("channels: {position: left}", 'channels.position: got "left", expected one'),
        ("channels: {colour: link}", "channels: got colour, expected"),
        ("initial: nan", 'initial: got "nan", expected a mapping'),
        ("initial: {positions: {r.j1: nan}}", "initial.positions.r.j1: got"),
        ("initial: {positions: {r.j1: .inf}}", "initial.positions.r.j1: got"),
        ("initial: {velocities: {r.j2: 1}}", "no joint 'r.j2' in the scene"),
        ("initial: {body_velocities: {r.l1: [0, 0, 0, 0, 0, 0]}}", "not free to move"),
        ("initial: {poses: {r.l1: [1, 0, 0, 0, 0, 0, 0]}}", "is not free to move"),
        ("initial: {body_velocities: {r.l1: [1]}}", "expected 6 numbers"),
        ("initial: {positions: {r.j1: %s}}" % ("9" * 400), "(400 characters)"),
        ("initial: {positions: {r.j1: %s}}" % ("9" * 5000), "more than 4000 digits"),
        ("effects: " + "[" * 5000, "expected at most 40 levels"),
        ("effects: 3", 'effects: got "3", expected a list'),
        ("effects: [{kind: sensor_delay, att: r}]", "did you mean effects[0].at?"),
        (
            "effects: [{kind: sensor_delay, at: r, parameters: {delay: 1e9}}]",
            "delay is 1e+09, expected at most 10 s",
        ),
        ("friction_zones: [{at: a, friction: 1e308}]", "friction is 1e+308"),
        ("packages: {p: none}", "is no folder"),
        ("plant: {time_step: 0.001, time_step: 0.01}", "'time_step' is there twice"),
        ("&a [*a]", "not YAML"),
    ],
)  # fmt: skip
def test_a_mistake_beside_the_models_is_named(tmp_path, text, words):
    robot(tmp_path)
    assert words in refused(tmp_path, SCENE + text + "\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it is empty, expected directives"),
        ("- 1", "expected sections: packages, directives, plant"),
        ("directives: 3", "expected a list of Drake model directives"),
        ("directives: [{add_modl: {}}]", "unknown key add_modl; did you mean add_mod"),
        ("directives: [{add_model: {name: r, fil: a}}]", "did you mean file?"),
        ("directives: [{add_model: {name: r}}]", "ives[0].add_model: expected `fi"),
        ("directives: [{add_model: {name: r, file: 3}}]", "add_model.file: got"),
        (SCENE + "- add_weld: {parent: world, child: 'r::l1', X_PC: 3}", "wrong form"),
        (
            SCENE + "- add_weld: {parent: world, child: 'r::l1', "
            "X_PC: {translation: [.inf, 0, 0]}}",
            "directives[2].add_weld.X_PC.translation[0]: got",
        ),
        (SCENE + "- add_weld: {parent: world, child: 'r::l1'}", "loops"),
        (SCENE + "- add_weld: {parent: 'r::base', child: world}", "got world"),
        ("directives: [{add_directives: {file: loop.yaml}}]", "adds itself"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_directives_is_named(tmp_path, text, words):
    robot(tmp_path)
    (tmp_path / "loop.yaml").write_text(
        f"directives: [{{add_directives: {{file: 'file://{tmp_path}/loop.yaml'}}}}]"
    )
    assert words in refused(tmp_path, text + "\n")


@pytest.mark.parametrize(
    ("link", "words"),
    [
        (INERTIAL.format(mass=-1, i=0.01, izz=0.01), "link 'l1' has the mass -1"),
        (INERTIAL.format(mass=0, i=0.01, izz=0.01), "of inertia without a mass"),
        (INERTIAL.format(mass=1, i=0.01, izz=0.05), "'l1' has the central moments"),
        ("", "joint r.j1 moves nothing that has inertia"),
        (INERTIAL.format(mass=0, i=0, izz=0), "joint r.j1 moves nothing"),
    ],
)  # fmt: skip
def test_an_inertia_that_no_body_has_is_refused_by_its_link(
    tmp_path, link, words, caplog
):
    robot(tmp_path, link)
    assert words in refused(tmp_path, SCENE)
    assert not caplog.records  # Drake's own words would come by the dozen.


def test_an_inertia_that_is_nearly_a_bodys_is_taken_as_the_nearest_one(
    tmp_path, caplog
):
    robot(tmp_path, INERTIAL.format(mass=1, i=0.01, izz=0.0205))
    (tmp_path / "scene.yaml").write_text(SCENE)
    plant = load_scene(tmp_path / "scene.yaml", DiagramBuilder()).plant
    inertia = plant.GetBodyByName("l1").default_spatial_inertia()
    central = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    moments = central.CalcPrincipalMomentsOfInertia()
    assert inertia.IsPhysicallyValid()
    np.testing.assert_allclose(moments, [0.01, 0.01, 0.0205], rtol=0.05)
    assert "1.3% of the largest off" in caplog.text  # 0.00025 + 1e-5 of 0.0205.


def test_a_wrong_attribute_of_the_model_is_drakes_line(tmp_path):
    robot(tmp_path, SOLID.replace("0 0 -0.3", "0 inf0 -0.3"))
    assert "scene's directives: Expected 3 values" in refused(tmp_path, SCENE)


def test_a_link_of_no_inertia_between_two_joints_is_refused(tmp_path):
    # M is not singular on its diagonal, but the two joints turn one body alike.
    text = ROBOT.format(link="", more="").replace(
        "</robot>",
        f"<link name='l2'>{SOLID}</link><joint name='j2' type='continuous'><parent "
        "link='l1'/><child link='l2'/><axis xyz='0 1 0'/></joint></robot>",
    )
    (tmp_path / "r.urdf").write_text(text)
    assert "without any inertia" in refused(tmp_path, SCENE)


def test_the_bounds_of_the_step_are_steps(tmp_path):
    robot(tmp_path)
    for step in (TIME_STEP_MIN, 0.1, 0.0):
        plant = plant_of(tmp_path, SCENE + f"plant: {{time_step: {step}}}\n")
        assert plant.time_step() == step


def test_actuation_without_joints_drives_those_that_have_actuators(tmp_path):
    robot(tmp_path, more=TRANSMISSION)
    text = SCENE + "actuation: {type: pd, kp: [10], kd: [1]}\n"
    (tmp_path / "s.yaml").write_text(text)
    assert read_scene(tmp_path / "s.yaml").actuation.joints == ["r.j1"]
    assert plant_of(tmp_path, text).num_actuators() == 1


MESH = '<{0}><geometry><mesh filename="{1}"/></geometry></{0}>'
TETRAHEDRON = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 3 1 4
"""


def test_visual_meshes_that_are_not_there_are_left_out_and_said(tmp_path, caplog):
    robot(tmp_path, SOLID + MESH.format("visual", "package://nowhere/a.obj"))
    before = hashlib.sha256((tmp_path / "r.urdf").read_bytes()).hexdigest()
    with caplog.at_level(logging.WARNING):
        plant = plant_of(tmp_path, SCENE)
    assert plant.num_positions() == 1
    assert "1 visual meshes are left out" in caplog.text
    assert "--package NAME=PATH" in caplog.text
    assert hashlib.sha256((tmp_path / "r.urdf").read_bytes()).hexdigest() == before


def test_a_shape_of_an_unknown_package_is_refused_with_the_way_to_give_it(tmp_path):
    robot(tmp_path, SOLID + MESH.format("collision", "package://nowhere/a.obj"))
    said = refused(tmp_path, SCENE)
    assert "the package nowhere is unknown" in said
    assert "--package nowhere=PATH" in said and "packages: {nowhere: PATH}" in said


def n_shapes(plant) -> int:
    return len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("l1")))


@pytest.mark.parametrize("how", ["scene", "option", "folder", "manifest"])
def test_a_package_is_found(tmp_path, how, monkeypatch):
    monkeypatch.setenv("MAKEBREAK_PACKAGES", "")
    meshes = tmp_path / "elsewhere" / "meshes"
    text = SCENE
    if how == "folder":  # As ROS lays it out: the URDF is in the package itself.
        meshes = tmp_path / "hand" / "meshes"
        (tmp_path / "hand" / "urdf").mkdir(parents=True)
        text = SCENE.replace("r.urdf", "hand/urdf/r.urdf")
    elif how == "manifest":
        meshes = tmp_path / "meshes"
        (tmp_path / "package.xml").write_text("<package><name> hand </name></package>")
    elif how == "scene":
        text += "packages: {hand: elsewhere}\n"
    meshes.mkdir(parents=True)
    (meshes / "a.obj").write_text(TETRAHEDRON)
    if how == "option":
        give_packages([f"hand={tmp_path / 'elsewhere'}"])
    where = tmp_path / "hand" / "urdf" if how == "folder" else tmp_path
    robot(where, SOLID + MESH.format("collision", "package://hand/meshes/a.obj"))
    assert n_shapes(plant_of(tmp_path, text)) == 1


@pytest.mark.parametrize("given", ["hand", "=x", "hand=", "hand=/does/not/exist"])
def test_a_wrong_package_option_is_refused(given):
    with pytest.raises(ValueError, match="^--package"):
        give_packages([given])


def test_tags_of_rotations_and_small_numbers_are_read():
    value = load_yaml("a: !Rpy {deg: [1, 2, 3]}\nb: 1e-3")
    assert value == {"a": {"_tag": "!Rpy", "deg": [1, 2, 3]}, "b": "1e-3"}
    np.testing.assert_equal(len(load_yaml("[" * DEPTH_MAX + "]" * DEPTH_MAX)), 1)


def test_aliases_that_would_fill_the_memory_are_refused():
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 200)}]" for i in range(1, 9)]
    with pytest.raises(ValueError, match="1000 aliases"):
        load_yaml("\n".join(lines))
