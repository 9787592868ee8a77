"""Effects on the inertia of links that an MJCF file describes."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene

ARM = """<mujoco model="arm"><compiler angle="radian" %s/>
<default><geom density="500"/></default><worldbody><body name="base">
<geom type="box" size="0.1 0.1 0.1"/><body name="upper" pos="0 0 0.1">
<joint name="j1" axis="0 1 0"/><inertial pos="0.1 0 0.2" mass="2"
diaginertia="0.02 0.03 0.01" euler="0.2 0.1 0.3"/><geom type="sphere" size="0.1"/>
<body name="lower" pos="0 0 0.4"><joint name="j2" axis="0 1 0"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0.1 0 0.3"/></body></body></body>
</worldbody></mujoco>"""


def inertia(folder, effects, compiler="", body="lower"):
    (folder / "arm.xml").write_text(ARM % compiler)
    (folder / "scene.yaml").write_text(
        "directives: [add_model: {name: arm, file: arm.xml}]\nplant: {time_step: 0}\n"
    )
    scene = replace(read_scene(folder / "scene.yaml"), effects=effects)
    plant = load_scene(scene, DiagramBuilder()).plant
    M = plant.GetBodyByName(body).default_spatial_inertia()
    about_com = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    return M.get_mass(), np.array(M.get_com()), np.array(about_com)


@pytest.mark.parametrize("body", ["upper", "lower"])
@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true"'])
def test_a_mass_and_a_centre_of_mass_are_changed(tmp_path, body, compiler):
    m, com, central = inertia(tmp_path, [], compiler, body)
    effects = [
        Effect("link_mass", [f"arm.{body}"], {"mass": 0.3}),
        Effect("link_com", [f"arm.{body}"], {"x": 0.01, "y": -0.02, "z": 0.03}),
    ]
    new_m, new_com, new = inertia(tmp_path, effects, compiler, body)
    assert new_m == pytest.approx(m + 0.3)
    np.testing.assert_allclose(new_com, com + [0.01, -0.02, 0.03], atol=1e-12)
    np.testing.assert_allclose(new, central * (m + 0.3) / m, atol=1e-12)
    # Other bodies stay as they were.
    other = "upper" if body == "lower" else "lower"
    before, after = (inertia(tmp_path, e, compiler, other) for e in ([], effects))
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
