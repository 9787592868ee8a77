"""An object's mass, centre of mass, inertia and corners. Its size: test_scene.py."""

from dataclasses import replace
from xml.dom import minidom

import numpy as np
import pytest
from effect_scenes import (
    CENTRAL,
    LENGTH,
    MASS,
    G,
    J,
    at_rest_but,
    double,
    on_ground,
    pendulum,
    with_effects,
)
from pydrake.geometry import Sphere
from pydrake.multibody.parsing import LoadModelDirectivesFromString
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.model_text import make_mesh_paths_absolute, text
from makebreak.models.scene import load_scene

TIMES = np.linspace(0.0, 1.0, 11)
CHANNELS = ["p.j1.position", "p.j1.velocity"]


def swing(scene, simulation=None):
    return (simulation or SceneSimulation(scene)).run(
        at_rest_but({"p.j1": 0.8}, {"p.j1": -1.5}), TIMES, CHANNELS
    )


def ode(acceleration):
    return solve_ivp(
        lambda t, x: [x[1], acceleration(*x)],
        (0, 1),
        [0.8, -1.5],
        "DOP853",
        TIMES,
        rtol=1e-10,
        atol=1e-12,
    ).y.T


# What each does to the pendulum about y. A new mass keeps the place and the shape of
# its inertia, so it alone would not change the swing: a spring shows it.
CASES = {
    "object_mass": (
        dict(mass=1.6),
        lambda q, v: (-1.6 * G * LENGTH * np.sin(q) - 4.0 * q) / (1.6 * J),
    ),
    "object_com": (
        dict(x=0.1, z=-0.4),
        lambda q, v: (
            (-MASS * G * (0.4 * np.sin(q) - 0.1 * np.cos(q)) - 4.0 * q)
            / (CENTRAL + MASS * (0.1**2 + 0.4**2))
        ),
    ),
    "object_inertia": (
        dict(ixx=0.06, iyy=0.09, izz=0.04),
        lambda q, v: (-MASS * G * LENGTH * np.sin(q) - 4.0 * q) / (J + 0.08),
    ),
}


def with_spring(folder, kind, parameters, time_step=0.0):
    spring = ("joint_spring", "p.j1", dict(stiffness=4.0, rest=0.0))
    return with_effects(
        pendulum(folder, time_step), (kind, "p.rod", parameters), spring
    )


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-4), (0.0005, 0.01)])
def test_pendulum_swings_as_the_ode_says(tmp_path, kind, time_step, atol):
    # atol: the integrator's accuracy; a first-order scheme of 0.5 ms at 20 rad/s2.
    parameters, acceleration = CASES[kind]
    scene = with_spring(tmp_path, kind, parameters, time_step)
    np.testing.assert_allclose(swing(scene), ode(acceleration), atol=atol)
    plain = ode(lambda q, v: (-MASS * G * LENGTH * np.sin(q) - 4.0 * q) / J)
    assert abs(plain - ode(acceleration)).max() > 10 * atol


@pytest.mark.parametrize("kind", CASES)
def test_context_takes_them_without_building_anew(tmp_path, kind):
    parameters, acceleration = CASES[kind]
    other = {"object_mass": dict(mass=0.7), "object_com": dict(x=0.0, z=-0.5)}
    start = with_spring(
        tmp_path, kind, other.get(kind, dict(ixx=0.02, iyy=0.02, izz=0.02))
    )
    simulation = SceneSimulation(start)
    simulation.set_effects(with_spring(tmp_path, kind, parameters).effects)
    rows = swing(None, simulation)
    assert simulation.builds == 1
    np.testing.assert_allclose(rows, ode(acceleration), atol=1e-4)


def test_mass_and_inertia_together_do_not_depend_on_their_order(tmp_path):
    one = ("object_mass", "d.upper", dict(mass=2.5))
    two = ("object_inertia", "d.upper", dict(ixx=0.03, iyy=0.04, izz=0.02))
    for effects in ((one, two), (two, one)):
        plant = load_scene(
            with_effects(double(tmp_path), *effects), DiagramBuilder()
        ).plant
        M = plant.GetBodyByName("upper").default_spatial_inertia()
        p = M.get_com()
        about = M.CalcRotationalInertia().CopyToFullMatrix3()
        central = about - 2.5 * (p @ p * np.eye(3) - np.outer(p, p))
        np.testing.assert_allclose(M.get_mass(), 2.5)
        np.testing.assert_allclose(np.diag(central), [0.03, 0.04, 0.02])
        np.testing.assert_allclose(p, [0.02, 0.01, -0.3])


def test_a_new_mass_scales_a_turned_inertia_and_nothing_else(tmp_path):
    # The upper link's inertia is given in turned axes: its moments must stay.
    def spatial(*effects):
        plant = load_scene(
            with_effects(double(tmp_path), *effects), DiagramBuilder()
        ).plant
        M = plant.GetBodyByName("upper").default_spatial_inertia()
        return M.CopyToFullMatrix6()

    double_mass = spatial(("object_mass", "d.upper", dict(mass=3.0)))
    np.testing.assert_allclose(double_mass, 2.0 * spatial(), atol=1e-15)
    same = spatial(("object_com", "d.upper", dict(y=0.01)))
    np.testing.assert_allclose(same, spatial(), atol=1e-15)


def test_values_now_are_the_models(tmp_path):
    model = SceneDynamics(double(tmp_path))
    assert model.now("object_mass", ["d.lower"]) == {"mass": 0.8}
    com = model.now("object_com", ["d.lower"])
    np.testing.assert_allclose(list(com.values()), [0, 0.03, -0.2], atol=1e-15)
    inertia = model.now("object_inertia", ["d.lower"])
    np.testing.assert_allclose(list(inertia.values()), [0.01, 0.012, 0.004], atol=1e-15)
    # With the values of now the model is what it was.
    scene = with_effects(
        double(tmp_path),
        ("object_mass", "d.lower", model.now("object_mass", ["d.lower"])),
        ("object_com", "d.lower", com),
        ("object_inertia", "d.lower", inertia),
    )
    q = np.array([[0.3, -0.7]])
    a, b = (d.inverse_dynamics(q, 2 * q, 3 * q) for d in (model, SceneDynamics(scene)))
    np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-6), (0.001, 0.02)])
def test_a_spinning_body_flies_round_its_centre_of_mass(tmp_path, time_step, atol):
    # The centre of mass falls on a parabola, the body's origin goes round it.
    com = np.array([0.03, 0.0, 0.0])
    scene = with_effects(
        on_ground(tmp_path, "cube", time_step, z=20.0),
        ("object_com", "b.box", dict(x=com[0], y=com[1], z=com[2])),
        ("object_inertia", "b.box", dict(ixx=1e-3, iyy=1e-3, izz=1.5e-3)),
    )
    w, t = 6.0, np.linspace(0, 0.4, 9)
    # Its origin at rest at first: the centre of mass moves with w x com.
    initial = at_rest_but(
        body="b.box", pose=[1, 0, 0, 0, 0, 0, 20.0], twist=[0, 0, w, 0, 0, 0]
    )
    channels = [f"b.box.{a}" for a in "xyz"]
    rows = SceneSimulation(scene).run(initial, t, channels)
    c = com[0]
    expected = np.stack(
        [
            c - c * np.cos(w * t),
            w * c * t - c * np.sin(w * t),
            20.0 - G * t**2 / 2,
        ],
        axis=1,
    )
    np.testing.assert_allclose(rows, expected, atol=atol)


@pytest.mark.parametrize("radius", [0.005, 0.015])
def test_a_rounded_cube_rests_as_high_on_a_face_and_lower_on_a_corner(tmp_path, radius):
    scene = with_effects(
        on_ground(tmp_path, "cube", 0.001),
        ("corner_radius", "b.box", dict(radius=radius)),
    )
    flat = SceneSimulation(scene).run(at_rest_but(), np.array([0, 0.5]), ["b.box.z"])
    # Four contacts of 1e5 N/m each give way by 0.4 kg g/4e5 = 10 um.
    np.testing.assert_allclose(flat[1, 0], 0.05 - 0.4 * G / 4e5, atol=2e-6)
    # The lowest point with a corner down: its sphere's centre is sqrt(3) (0.05 - r)
    # below the middle. Read off the shapes.
    loaded = load_scene(scene, DiagramBuilder())
    inspector = loaded.scene_graph.model_inspector()
    shapes = loaded.plant.GetCollisionGeometriesForBody(
        loaded.plant.GetBodyByName("box")
    )
    assert len(shapes) == 8
    far = []
    for g in shapes:
        assert isinstance(inspector.GetShape(g), Sphere)
        centre = inspector.GetPoseInFrame(g).translation()
        far.append(np.linalg.norm(centre) + inspector.GetShape(g).radius())
        properties = inspector.GetProximityProperties(g)
        assert properties.GetProperty("material", "point_contact_stiffness") == 2e5
    np.testing.assert_allclose(far, np.sqrt(3) * (0.05 - radius) + radius)


def test_corners_of_a_block_on_spheres_are_rounded_anew(tmp_path):
    # A cube whose corners are rounded twice: the second radius holds.
    twice = with_effects(
        on_ground(tmp_path, "cube", 0.001),
        ("corner_radius", "b.box", dict(radius=0.005)),
        ("corner_radius", "b.box", dict(radius=0.01)),
    )
    once = with_effects(twice, ("corner_radius", "b.box", dict(radius=0.01)))

    def shapes(scene):
        loaded = load_scene(scene, DiagramBuilder())
        inspector = loaded.scene_graph.model_inspector()
        body = loaded.plant.GetBodyByName("box")
        return sorted(
            (*inspector.GetPoseInFrame(g).translation(), inspector.GetShape(g).radius())
            for g in loaded.plant.GetCollisionGeometriesForBody(body)
        )

    np.testing.assert_allclose(shapes(twice), shapes(once), atol=1e-12)


@pytest.mark.parametrize(
    "kind, at, parameters, words",
    [
        ("object_mass", "b.box", dict(mass=0.0), "mass is 0.0, expected > 0"),
        ("object_mass", "b.bax", dict(mass=1.0), "expected one link of b.sdf: box"),
        ("object_mass", "c", dict(mass=1.0), "no model 'c' is added"),
        ("object_com", "b.box", {}, "needs `x`, `y` or `z`"),
        ("object_inertia", "b.box", {}, "needs a moment of inertia"),
        ("object_inertia", "b.box", dict(ixx=1.0), "no body has the central moments"),
        ("corner_radius", "b.box", dict(radius=0.06), "at most half the block's least"),
        ("corner_radius", "g", dict(radius=0.06), "at most half the block's least"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, kind, at, parameters, words):
    scene = with_effects(on_ground(tmp_path, "cube"), (kind, at, parameters))
    with pytest.raises(ValueError, match=words):
        load_scene(scene, DiagramBuilder())


def test_a_ball_has_no_corners(tmp_path):
    scene = with_effects(
        on_ground(tmp_path, "ball"), ("corner_radius", "b", dict(radius=0.01))
    )
    with pytest.raises(ValueError, match="one collision box, or eight spheres"):
        load_scene(scene, DiagramBuilder())


def test_an_inertia_that_no_body_has_is_refused_in_the_context_too(tmp_path):
    good = dict(ixx=0.001, iyy=0.001, izz=0.001)
    scene = with_effects(on_ground(tmp_path, "cube"), ("object_inertia", "b.box", good))
    simulation = SceneSimulation(scene)
    bad = Effect("object_inertia", ["b.box"], {"ixx": 1.0, "iyy": 0.001, "izz": 0.001})
    with pytest.raises(ValueError, match="no body has the inertia"):
        simulation.set_effects([bad])
    assert simulation.scene.effects == scene.effects
    # And it still runs as before.
    times, channels = np.array([0.0, 0.1]), ["b.box.z"]
    rows = simulation.run(at_rest_but(), times, channels)
    expected = SceneSimulation(scene).run(at_rest_but(), times, channels)
    np.testing.assert_array_equal(rows, expected)


FILTER = """
directives:
- add_collision_filter_group:
    name: apart
    members: [b::box, g::plate]
    ignored_collision_filter_groups: [apart]
"""


@pytest.mark.parametrize(
    "kind, at, parameters, more",
    [
        ("object_size", "b.box", {"scale": 1.2}, 0),
        ("corner_radius", "b.box", {"radius": 0.004}, 7),
        ("plane_height", "g.plate", {"height": 0.01}, 0),
        (
            "friction_patch",
            "b.box~g.plate",
            dict(friction=0.2, x_min=-0.1, x_max=0.1, y_min=-0.1, y_max=0.1),
            4,
        ),
    ],
)
def test_bodies_that_a_scene_keeps_apart_stay_so(tmp_path, kind, at, parameters, more):
    """Drake's ChangeShape forgets collision filters: a body would be touched again."""
    scene = on_ground(tmp_path, "cube")
    directives = LoadModelDirectivesFromString(FILTER).directives
    scene = replace(scene, directives=[*scene.directives, *directives])
    loaded = load_scene(with_effects(scene, (kind, at, parameters)), DiagramBuilder())
    plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
    box, plate = (
        plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name))
        for name in ("box", "plate")
    )
    assert len(box) + len(plate) == 2 + more
    assert all(inspector.CollisionFiltered(a, b) for a in box for b in plate)


def test_meshes_of_an_edited_copy_are_those_beside_the_original(tmp_path):
    document = minidom.parseString(
        """<model>
        <mesh filename="../visual/arm.obj"/><mesh filename="package://robot/hand.obj"/>
        <mesh><uri> meshes/leg.stl </uri></mesh><mesh><uri>file:///a.obj</uri></mesh>
        </model>"""
    )
    make_mesh_paths_absolute(document, tmp_path / "urdf")
    names = [m.getAttribute("filename") for m in document.getElementsByTagName("mesh")]
    assert names[:2] == [
        f"file://{tmp_path}/visual/arm.obj", "package://robot/hand.obj"
    ]  # fmt: skip
    uris = [text(uri) for uri in document.getElementsByTagName("uri")]
    assert uris == [f"file://{tmp_path}/urdf/meshes/leg.stl", "file:///a.obj"]
