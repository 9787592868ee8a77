"""Distances of what may touch: only of what comes near they are computed."""

import numpy as np
import pytest

from makebreak.gap.residuals.impacts import nearest_of
from makebreak.gap.simulation.contact_shapes import ContactShapes
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import read_scene

SHAPES = {
    "box": '<box size="0.06 0.05 0.2"/>',
    "sphere": '<sphere radius="0.05"/>',
    "capsule": '<capsule radius="0.03" length="0.2"/>',
    "cylinder": '<cylinder radius="0.03" length="0.2"/>',
}


def two_arms(folder, shape):
    """Two links on arms of 0.3 m that swing through each other, above a ground."""
    text = '<?xml version="1.0"?><robot name="r"><link name="base"/>'
    for name, x in (("a", 0.0), ("b", 0.3)):
        text += (
            f'<link name="{name}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
            'izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0.01 '
            f'0 -0.3" rpy="0.1 0.2 0"/><geometry>{SHAPES[shape]}</geometry></collision>'
            f'</link><joint name="{name}" type="continuous"><parent link="base"/>'
            f'<child link="{name}"/><origin xyz="{x} 0 0"/><axis xyz="0 1 0"/></joint>'
        )
    text += (
        '<link name="floor"><collision><origin xyz="0 0 -0.45"/><geometry><box size='
        '"2 2 0.1"/></geometry></collision></link><joint name="f" type="fixed">'
        '<parent link="base"/><child link="floor"/></joint>'
    )
    (folder / "r.urdf").write_text(text + "</robot>")
    (folder / "scene.yaml").write_text(
        "directives:\n- add_model: {name: r, file: r.urdf}\n"
        "- add_weld: {parent: world, child: 'r::base'}\nplant: {time_step: 0.0}\n"
    )
    return SceneDynamics(read_scene(folder / "scene.yaml"))


@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_is_not_near_changes_no_distance_of_what_is(tmp_path, shape, floor):
    dynamics = two_arms(tmp_path, shape)
    shapes = ContactShapes(dynamics.loaded)
    q = np.random.default_rng(0).uniform(-1.2, 1.2, (300, 2))

    def counts(a, b):
        return floor or shapes.anchored.isdisjoint((a, b))

    every = nearest_of(shapes, dynamics, q, counts, np.inf)
    near = nearest_of(shapes, dynamics, q, counts, 0.02)
    np.testing.assert_array_equal(near, np.where(every < 0.02, every, np.inf))
    assert 20 < np.isfinite(near).sum() < 280 and np.isfinite(every).all()
    none = nearest_of(shapes, dynamics, q, lambda a, b: False)
    assert np.isinf(none).all()
