"""Spheres that stand in for faces on which bodies lie."""

from itertools import product

import numpy as np
import pytest
from pydrake.geometry import Box, Convex, Cylinder, Sphere
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.simulation.face_supports import (
    POINT,
    LiesOn,
    add_supports,
    centres_of,
)

MU, G = 0.4, 9.81
SURFACE = (
    "<drake:proximity_properties>"
    f"<drake:mu_dynamic>{MU}</drake:mu_dynamic><drake:mu_static>{MU}</drake:mu_static>"
    "</drake:proximity_properties>"
)


def model(name: str, shape: str, inertial: str = "", z: float = 0.0) -> str:
    return (
        '<?xml version="1.0"?><sdf version="1.9" xmlns:drake="http://drake.mit.edu">'
        f'<model name="{name}"><link name="{name}">{inertial}<collision name="c"><pose>'
        f"0 0 {z} 0 0 0</pose><geometry>{shape}</geometry>{SURFACE}</collision></link>"
        "</model></sdf>"
    )


def spun(half, supported: bool, spin: float = 3.0, seconds: float = 0.2) -> float:
    """How fast a box of 1 kg still turns on a table after a while [rad/s]."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0005)
    x, y, z = half
    inertia = np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 3.0
    moments = "".join(
        f"<{name}>{value}</{name}>"
        for name, value in zip(("ixx", "iyy", "izz"), inertia, strict=True)
    )
    size = " ".join(str(2.0 * h) for h in half)
    parser = Parser(plant)
    parser.AddModelsFromString(
        model("table", "<box><size>2 2 0.2</size></box>", z=-0.1), "sdf"
    )
    parser.AddModelsFromString(
        model(
            "box",
            f"<box><size>{size}</size></box>",
            f"<inertial><mass>1</mass><inertia>{moments}<ixy>0</ixy><ixz>0</ixz>"
            "<iyz>0</iyz></inertia></inertial>",
        ),
        "sdf",
    )
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("table"))
    box, table = (plant.GetBodyByName(name) for name in ("box", "table"))
    if supported:
        add_supports([LiesOn(box.index(), table.index())], plant, scene_graph)
    plant.Finalize()
    simulator = Simulator(builder.Build())
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    q = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, z - 1e-4])
    plant.SetPositions(own, q)
    simulator.AdvanceTo(0.05)  # It settles.
    v = np.zeros(6)
    v[2] = spin
    plant.SetVelocities(own, v)
    simulator.AdvanceTo(0.05 + seconds)
    return float(plant.GetVelocities(own)[2])


def slowed(half, spin: float, seconds: float) -> float:
    """Each corner carries a quarter and slides along its circle: mu m g r over izz."""
    r = float(np.hypot(half[0] - 2e-3, half[1] - 2e-3))
    izz = (half[0] ** 2 + half[1] ** 2) / 3.0
    return spin - MU * G * r / izz * seconds


def test_a_box_on_its_corners_is_slowed_by_their_friction():
    half, spin, seconds = (0.06, 0.04, 0.03), 3.0, 0.005
    expected = slowed(half, spin, seconds)
    assert expected > 1.0  # It turns still: friction acts all the time.
    # 2 % for a tenth of a millimetre of settling, which loads corners unevenly.
    assert spun(half, True, spin, seconds) == pytest.approx(expected, rel=0.02)


def test_point_contact_alone_turns_a_box_otherwise():
    """Why there are supports: the one point jumps from corner to corner."""
    half, spin, seconds = (0.06, 0.04, 0.03), 3.0, 0.005
    assert abs(spun(half, False, spin, seconds) - slowed(half, spin, seconds)) > 1.0
    # At rest it goes on turning slowly, and does not on supports.
    assert abs(spun(half, False)) > 1e-3
    assert abs(spun(half, True)) < 1e-6


@pytest.mark.parametrize(
    "shape",
    [
        Box(0.12, 0.08, 0.06),
        Cylinder(0.05, 0.06),
        Convex(
            np.array([
                [r * np.cos(a), r * np.sin(a), z]
                for z in (-0.03, 0.03)
                for r, a in [(0.06, k * np.pi / 3) for k in range(6)]
            ]).T,
            "prism",
        ),
    ],
)  # fmt: skip
def test_supports_touch_a_face_from_within(shape):
    centres, radius = centres_of(shape)
    np.testing.assert_allclose(centres[:, 2].min() - radius, -0.03, atol=1e-9)
    np.testing.assert_allclose(centres[:, 2].max() + radius, 0.03, atol=1e-9)
    low = centres[centres[:, 2] < 0.0]
    np.testing.assert_allclose(low.mean(axis=0)[:2], 0.0, atol=1e-9)
    # None reaches out at the side: along a rim, and at corners, they are inside.
    far = np.linalg.norm(low[:, :2], axis=1).max() + radius
    outer = {Box: np.hypot(0.06, 0.04), Cylinder: 0.05, Convex: 0.06}[type(shape)]
    assert far <= outer + 1e-9


def test_corners_of_a_tool_are_where_they_are_however_it_is_tilted():
    """On its edge at 45 degrees a sphere of 2 mm would be 0.8 mm above the corner."""
    centres, radius = centres_of(Box(0.03, 0.04, 0.05), largest=POINT)
    corners = np.array(list(product((-0.015, 0.015), (-0.02, 0.02), (-0.025, 0.025))))
    for corner in corners:
        off = np.linalg.norm(centres - corner, axis=1).min()
        assert off + radius < 3e-5  # A tenth of what shapes are known to.


def test_a_lying_cylinder_stands_on_two_spheres_of_its_radius_and_a_ball_on_none():
    centres, radius = centres_of(Cylinder(0.03, 0.2), on_side=True)
    assert radius == 0.03
    np.testing.assert_allclose(centres, [[0, 0, -0.1], [0, 0, 0.1]])
    assert centres_of(Sphere(0.1)) is None
