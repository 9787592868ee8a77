"""Ranges of the catalogue go with the size of the robot."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import double, with_effects

from makebreak.gap.problem import is_sane
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.sizes import Sizes, range_of, sizes_of
from makebreak.models.scene import read_scene

ARM = """<?xml version="1.0"?><robot name="r"><link name="base"><inertial>
<mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
</inertial></link><link name="slide"/>
<link name="tip"><inertial><origin xyz="0.24 0 0.32"/><mass value="3"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="slide"/>
<origin xyz="0.3 0.4 0"/><axis xyz="0 0 1"/></joint>
<joint name="push" type="prismatic"><parent link="slide"/><child link="tip"/>
<origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit effort="9" lower="0" upper="1"
velocity="1"/></joint></robot>"""


def test_sizes_are_what_a_robot_weighs_and_how_far_it_reaches(tmp_path):
    (tmp_path / "r.urdf").write_text(ARM)
    (tmp_path / "scene.yaml").write_text(
        "directives:\n- add_model: {name: r, file: r.urdf}\n"
        "- add_weld: {parent: world, child: 'r::base'}\n"
    )
    sizes = SceneDynamics(read_scene(tmp_path / "scene.yaml")).sizes
    assert sizes == Sizes(5.0, pytest.approx(0.1 + 0.4), frozenset({"r.push"}))


# Pi theorem: a similar robot, in units of length, mass and time that are these many
# times as large, has every number that many times as large.
@pytest.mark.parametrize(("length", "mass"), [(0.1, 0.003), (1.0, 4.0), (2.0, 8.0)])
def test_ranges_of_similar_robots_are_similar(length, mass):
    time = np.sqrt(length)  # Gravity is the same.
    units = {"kg": mass, "m": length, "s": time, "N": mass * length / time**2}
    one, other = Sizes(30.0, 1.5), Sizes(30.0 * mass, 1.5 * length)
    for kind in KINDS.values():
        for p in kind.parameters:
            if not p.of_size:
                continue
            factor = eval_unit(p.unit, units)
            expected = np.multiply(range_of(p, ["r.j"], one), factor)
            np.testing.assert_allclose(range_of(p, ["r.j"], other), expected)


def eval_unit(unit, units):
    """What a number of a unit is multiplied by, from the unit as it is written."""
    above, _, below = unit.replace("/rad2", "").replace("/rad", "").partition("/")
    product = 1.0
    for text, sign in ((above, 1), (below, -1)):
        for each in text.split():
            name, power = (each[:-1], 2) if each[-1] == "2" else (each, 1)
            product *= units[name] ** (sign * power)
    return product


@pytest.mark.parametrize("scale", [1e-3, 1.0, 40.0])
def test_what_a_robot_can_have_goes_with_its_size(tmp_path, scale):
    """The damping of a UR10, 63 N m s/rad beside 33 kg that reach 1.8 m, is a robot's
    whatever the robot weighs, if it is as heavy in proportion; ten times that is of
    none."""
    sizes = Sizes(33.0 * scale, 1.8)
    for damping, sane in ((63.0, True), (1e4, False)):
        effect = Effect("joint_viscous_damping", ["r.j"], {"damping": scale * damping})
        assert is_sane(effect, sizes) == sane
    assert is_sane(replace(effect, parameters={"damping": 1e6}), None)


def test_a_sliding_joint_has_the_range_of_a_force():
    sizes = Sizes(5.0, 1.0, frozenset({"r.push"}))
    (p,) = KINDS["joint_coulomb_friction"].parameters
    force, torque = (range_of(p, [at], Sizes(5.0, 0.5, sizes.slides))
                     for at in ("r.push", "r.turn"))  # fmt: skip
    np.testing.assert_allclose(np.array(torque), 0.5 * np.array(force))


def test_a_load_makes_a_robot_larger(tmp_path):
    plain = SceneDynamics(double(tmp_path))
    load = dict(mass=0.2, com_x=0.0, com_y=0.0, com_z=-0.1)
    more = SceneDynamics(with_effects(plain.loaded.scene, ("payload", "d.lower", load)))
    assert more.sizes.mass == pytest.approx(plain.sizes.mass + 0.2)
    assert sizes_of(plain.plant) == plain.sizes
