"""Objects to push: files of a simulated world, and what a planner knows of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from object_alone import object_alone
from pydrake.geometry import Box, Convex
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull

from makebreak.diagrams.push_object_config import contact_pairs
from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS
from makebreak.models.pushed_object import (
    PushedObject,
    hull_obj,
    make_tip_and_object,
    object_file,
    object_inertia,
    object_sdf,
    parts,
    rest_height,
    support_spheres,
)
from makebreak.models.scene import load_scene, read_scene
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair
from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL, V_BALL, W_BALL
from makebreak.systems.contact_mpc.numerics.lcs import simulate

FLAT = ("t", "l", "box", "disc", "mesh")
G = 9.81
WEDGE = np.array([
    [0, 0, 0], [0.12, 0, 0], [0.12, 0.08, 0], [0, 0.08, 0], [0, 0, 0.04],
    [0, 0.08, 0.04],
])  # fmt: skip


@pytest.fixture(scope="module")
def wedge(tmp_path_factory):
    path = tmp_path_factory.mktemp("wedge") / "wedge.obj"
    hull = ConvexHull(WEDGE)
    center = WEDGE.mean(axis=0)
    lines = [f"v {x} {y} {z}" for x, y, z in WEDGE]
    for triangle in hull.simplices:
        a, b, c = WEDGE[triangle]
        outward = np.cross(b - a, c - a) @ (a - center) > 0.0
        order = triangle if outward else triangle[::-1]
        lines.append("f " + " ".join(str(i + 1) for i in order))
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.fixture
def spec_of(wedge):
    def make(shape, **changes):
        return PushedObject(shape, file=wedge if shape == "mesh" else "", **changes)

    return make


class World:
    """The object of a spec alone on the table, at (0.4, 0), at rest."""

    def __init__(self, spec, friction=0.5):
        scene = object_alone(spec)
        scene.initial.positions = {}
        pose = [1.0, 0.0, 0.0, 0.0, 0.4, 0.0, rest_height(spec)]
        scene.initial.poses = {"object.object": pose}
        pair = ["object~table"]
        scene.effects.append(Effect("contact_friction", pair, {"friction": friction}))
        builder = DiagramBuilder()
        self.plant = load_scene(scene, builder).plant
        self.body = self.plant.GetBodyByName("object")
        self.simulator = Simulator(builder.Build())
        root = self.simulator.get_mutable_context()
        self.context = self.plant.GetMyMutableContextFromRoot(root)
        self.simulator.AdvanceTo(0.1)  # Until its weight is carried.

    def throw(self, omega, v):
        """It moves from now on with omega (3,), v (3,)."""
        V = SpatialVelocity(np.array(omega, float), np.array(v, float))
        self.plant.SetFreeBodySpatialVelocity(
            context=self.context, body=self.body, V_JpJc=V
        )

    def after(self, seconds):
        """Its pose: p (3,), roll, pitch, yaw (3,)."""
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + seconds)
        X = self.plant.EvalBodyPoseInWorld(self.context, self.body)
        return X.translation(), X.rotation().ToRollPitchYaw().vector()


@pytest.mark.parametrize("shape", [*FLAT, "cylinder"])
def test_it_rests_where_it_is_said_to(spec_of, shape):
    spec = spec_of(shape)
    world = World(spec)
    p, turned = world.after(0.5)
    # Its weight, 4 N, presses supports of 2e4 N/m each: 0.1 mm for two of them.
    np.testing.assert_allclose(p, [0.4, 0.0, rest_height(spec)], atol=1.5e-4)
    # The wedge is heavier at one end: it sinks by 0.02 mm over 60 mm more there.
    np.testing.assert_allclose(turned, 0.0, atol=5e-4)
    assert np.linalg.norm(world.plant.GetVelocities(world.context)) < 1e-3


@pytest.mark.parametrize("shape", FLAT)
@pytest.mark.parametrize("mu", [0.25, 0.6])
def test_it_slides_as_far_as_its_friction_says(spec_of, shape, mu):
    world = World(spec_of(shape), mu)
    v = 0.6
    world.throw([0, 0, 0], [0, v, 0])
    p, _ = world.after(0.6)
    # v^2 / (2 mu g); a step of 1 ms at v is 0.6 mm.
    assert p[1] == pytest.approx(v**2 / (2 * mu * G), abs=6e-4)


@pytest.mark.parametrize("shape", ["box", "disc", "t", "l"])
def test_it_spins_down_as_under_an_even_pressure(spec_of, shape):
    spec, mu, omega = spec_of(shape), 0.4, 6.0
    # Torque mu m g E|r| over the lower face, by 200 000 points thrown at random.
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (200000, 2))
    r = np.hypot(*points[within(spec, points)].T).mean()
    I_zz = object_inertia(spec).CalcRotationalInertia().get_moments()[2]
    alpha = mu * spec.mass * G * r / I_zz
    world = World(spec, mu)
    world.throw([0, 0, omega], [0, 0, 0])
    p, turned = world.after(0.6)
    # 12 to 18 points for an even pressure: 4 % (a step of 1 ms is 6 mrad).
    assert turned[2] == pytest.approx(omega**2 / (2 * alpha), rel=0.05)
    # About its centre of mass: the turn alone moves nothing. (L and T: their supports
    # carry unevenly, by the 1 to 2.5 mm that their middle lies off.)
    np.testing.assert_allclose(p[:2], [0.4, 0.0], atol=2e-3)


def within(spec, points):
    """Whether points (n, 2) are in the plan of a shape, worked out for itself."""
    x, y = points.T
    if spec.shape == "disc":
        return np.hypot(x, y) < 0.06
    if spec.shape == "box":
        return (abs(x) < 0.05) & (abs(y) < 0.07)
    if spec.shape == "t":  # The stem's end is 18.5 / 7 of 40 mm below the centroid.
        y = y + 0.04 * 18.5 / 7
        bar = (abs(x) < 0.08) & (0.12 < y) & (y < 0.16)
        return bar | ((abs(x) < 0.02) & (0.0 < y) & (y < 0.12))
    x, y = x + 0.04, y + 0.06  # Of the L's outer corner, 40 and 60 mm off.
    long = (0.0 < x) & (x < 0.04) & (0.0 < y) & (y < 0.16)
    return long | ((0.0 < x) & (x < 0.12) & (0.0 < y) & (y < 0.04))


def test_a_lying_cylinder_rolls_on_and_slides_along():
    spec = PushedObject("cylinder")
    world, v = World(spec), 0.2
    world.throw([-v / 0.02, 0, 0], [0, v, 0])
    p, _ = world.after(0.5)
    assert p[1] == pytest.approx(0.5 * v, rel=0.02)
    world = World(spec)
    world.throw([0, 0, 0], [0.6, 0, 0])
    p, _ = world.after(0.5)
    assert p[0] - 0.4 == pytest.approx(0.36 / (2 * 0.5 * G), abs=6e-4)


@pytest.mark.parametrize("shape", ["t", "l", "box", "disc", "cylinder"])
def test_inertia_is_that_of_points_thrown_into_it(shape):
    spec = PushedObject(shape, mass=0.7, scale=1.1)
    rng = np.random.default_rng(0)
    n = 400000
    p = rng.uniform(-0.16, 0.16, (n, 3)) * [1.0, 1.0, 0.022 / 0.16]
    if shape == "cylinder":
        inside = (abs(p[:, 0]) < 0.077) & (np.hypot(p[:, 1], p[:, 2]) < 0.022)
    else:
        inside = within(PushedObject(shape), p[:, :2] / 1.1)
    p = p[inside]
    expected = 0.7 * ((p**2).sum(axis=1).mean() * np.eye(3) - p.T @ p / len(p))
    M = object_inertia(spec)
    np.testing.assert_allclose(M.get_com(), 0.0, atol=1e-12)
    np.testing.assert_allclose(p.mean(axis=0), 0.0, atol=5e-4)
    I_BBo = M.CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(I_BBo, expected, atol=0.02 * expected.max())


def test_mesh_has_its_origin_over_its_centroid_half_way_up(spec_of):
    spec = spec_of("mesh", scale=2.0)
    (part,) = parts(spec)
    # A wedge of the right-angled section 0.24 x 0.08 m: its centroid at a third.
    low, high = [-0.08, -0.08, -0.04], [0.16, 0.08, 0.04]
    np.testing.assert_allclose(part.points.min(axis=0), low, atol=1e-9)
    np.testing.assert_allclose(part.points.max(axis=0), high, atol=1e-9)
    assert rest_height(spec) == pytest.approx(0.04)
    np.testing.assert_allclose(object_inertia(spec).get_com()[:2], 0.0, atol=1e-9)


def test_a_copy_of_a_mesh_needs_its_file_no_more(spec_of, wedge, tmp_path):
    own = tmp_path / "of_the_user.obj"
    own.write_text(Path(wedge).read_text())
    spec = replace(spec_of("mesh", scale=2.0), file=str(own))
    (expected,) = parts(spec)
    (tmp_path / "copy.obj").write_text(hull_obj(spec))
    sdf = tmp_path / "object.sdf"
    sdf.write_text(object_sdf(spec, "copy.obj"))
    own.unlink()
    assert str(tmp_path) not in sdf.read_text()
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    Parser(plant).AddModels(str(sdf))
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    (g,) = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("object"))[:1]
    hull = inspector.GetShape(g).GetConvexHull()
    got = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    got = got + inspector.GetPoseInFrame(g).translation()
    skin = [0.0, 0.0, 2e-4]  # It ends so far above the table.
    np.testing.assert_allclose(
        got[np.lexsort(got.round(6).T)],
        (expected.points + skin)[np.lexsort((expected.points + skin).round(6).T)],
        atol=1e-8,
    )


@pytest.mark.parametrize("shape", ["t", "mesh"])
def test_centre_of_mass_is_moved_and_the_inertia_about_it_stays(spec_of, shape):
    def central(spec):
        M = object_inertia(spec)
        return M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()

    right = spec_of(shape)
    wrong = spec_of(shape, com_offset=[0.015, -0.01])
    moved = object_inertia(wrong).get_com() - object_inertia(right).get_com()
    np.testing.assert_allclose(moved, [0.015, -0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(central(wrong), central(right), atol=1e-12)
    # And so the file has it.
    scene = read_scene(MODELS / "push_object.scene.yaml")
    for d in scene.directives:
        if d.add_model is not None and d.add_model.name == "object":
            d.add_model.file = f"file://{object_file(wrong)}"
    plant = load_scene(scene, DiagramBuilder()).plant
    M = plant.GetBodyByName("object").default_spatial_inertia()
    np.testing.assert_allclose(
        M.CopyToFullMatrix6(), object_inertia(wrong).CopyToFullMatrix6(), atol=1e-8
    )


@pytest.mark.parametrize("shape", [*FLAT, "cylinder"])
def test_effect_object_size_is_the_scale(spec_of, shape):
    scene = read_scene(MODELS / "push_object.scene.yaml")
    for d in scene.directives:
        if d.add_model is not None and d.add_model.name == "object":
            d.add_model.file = f"file://{object_file(spec_of(shape))}"
    scene.effects.append(Effect("object_size", ["object"], {"scale": 1.1}))
    loaded = load_scene(scene, DiagramBuilder())
    body, inspector = (
        loaded.plant.GetBodyByName("object"), loaded.scene_graph.model_inspector()
    )  # fmt: skip
    scaled = spec_of(shape, scale=1.1)
    np.testing.assert_allclose(
        body.default_spatial_inertia().CopyToFullMatrix6(),
        object_inertia(scaled).CopyToFullMatrix6(),
        atol=1e-8,
    )
    by_name = {
        inspector.GetName(g).split("::")[-1]: g
        for g in loaded.plant.GetCollisionGeometriesForBody(body)
    }
    for i, part in enumerate(parts(scaled)):
        g = by_name[f"part_{i}"]
        X_BG, shape_now = inspector.GetPoseInFrame(g), inspector.GetShape(g)
        if isinstance(shape_now, Convex):
            hull = shape_now.GetConvexHull()
            now = (
                X_BG @ np.array([hull.vertex(k) for k in range(hull.num_vertices())]).T
            )
            now = now.T
        elif isinstance(shape_now, Box):
            half = shape_now.size() / 2.0
            now = X_BG.translation() + np.array([-half, half])
        else:
            continue
        for end in (np.min, np.max):  # Less SKIN, 0.2 mm.
            np.testing.assert_allclose(
                end(now, axis=0), end(part.points, axis=0), atol=3e-4
            )


@pytest.mark.parametrize("shape", FLAT)
def test_three_supports_carry_alike_and_resist_turning_as_an_even_pressure(
    spec_of, shape
):
    spec = spec_of(shape)
    few, radius = support_spheres(spec)
    assert few.shape == (3, 3)
    np.testing.assert_allclose(few[:, :2].mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(few[:, 2] - radius, -rest_height(spec), atol=1e-12)
    r = np.hypot(*few[:, :2].T)
    np.testing.assert_allclose(r, r[0], atol=1e-12)
    if shape != "mesh":
        points = np.random.default_rng(1).uniform(-0.15, 0.15, (200000, 2))
        inside = points[within(spec, points)]
        assert r[0] == pytest.approx(np.hypot(*inside.T).mean(), rel=0.01)


def test_the_scenes_object_is_the_default_one():
    assert (MODELS / "pushed_t.sdf").read_text() == object_sdf(PushedObject())


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_a_heavier_planners_object_is_slowed_as_coulomb_says(weight):
    """In closed form: Anitescu's contact throws it up with friction times speed, and
    what accelerates it upwards adds to the force that slows it."""
    mu, dt, v, g = 0.5, 0.02, 0.3, 9.81
    spec = PushedObject("box")
    diagram = make_tip_and_object(spec, weight=weight)[0]
    lcs = AnitescuLcs(diagram, contact_pairs(spec, mu, weight), dt)
    x = lcs.x_default.copy()
    x[:3], x[P_BALL] = [0.1, 0.3, 0.1], [0.5, 0.0, rest_height(spec)]
    x[V_BALL] = [v, 0.0, 0.0]
    x_next, _ = simulate(lcs.build(x, np.zeros(3)), x, np.zeros(3))
    speed = (v - mu * g * dt) / (1.0 + (mu / weight) ** 2)
    # Supports give way by eps_c.
    expected = [speed, 0.0, mu / weight * speed]
    np.testing.assert_allclose(x_next[V_BALL], expected, atol=2e-3)
    assert (v - x_next[V_BALL][0] < 1.05 * mu * g * dt) == (weight == 4.0)


@pytest.mark.parametrize("shape", [*FLAT, "cylinder"])
def test_planners_plant_pushes_the_object_where_the_tip_does(spec_of, shape):
    """Pushed along +x through its centre, far enough below its top: it moves along,
    by Coulomb's friction on all of its supports, and turns only if it is off centre."""
    spec, tip = spec_of(shape), TipAndBall(tip_mass=1.0, tip_radius=0.0195)
    diagram, plant, _ = make_tip_and_object(spec, tip)
    n = len(support_spheres(spec)[0])
    pairs = [
        ContactPair("tip::tip", "object::object", 0.5, closest=1),
        *(ContactPair(f"object::support_{i}", "table::table", 0.5) for i in range(n)),
    ]
    dt = 0.02
    lcs = AnitescuLcs(diagram, pairs, dt)
    assert lcs.n_lam == 4 + 4 * n
    points = np.concatenate([part.points for part in parts(spec)])
    x = lcs.x_default.copy()
    x[P_BALL] = [0.5, 0.1, rest_height(spec)]
    x[3:7] = [1.0, 0.0, 0.0, 0.0]
    # At rest nothing moves: the supports carry it. eps_c lets them sink by some 0.1 mm.
    x[:3] = [0.2, 0.1, 0.1]
    x_next, _ = simulate(lcs.build(x, np.zeros(3)), x, np.zeros(3))
    np.testing.assert_allclose(x_next[V_BALL][:2], 0.0, atol=1e-6)
    np.testing.assert_allclose(x_next[P_BALL], x[P_BALL], atol=2e-4)
    # Touching from -x at the height of its middle, a push of 20 N.
    side = points[:, 0].min()
    y = 0.034 if shape == "t" else 0.0  # The cross bar's end.
    x[:3] = [0.5 + side - 0.0195, 0.1 + y, rest_height(spec)]
    u = np.array([20.0, 0.0, 0.0])
    x_next, lam = simulate(lcs.build(x, u), x, u)
    assert x_next[V_BALL][0] > 0.05 and lam[:4].sum() > 1.0
    if shape == "t":
        assert x_next[W_BALL][2] < -0.1
    elif shape in ("box", "disc", "cylinder"):
        np.testing.assert_allclose(x_next[W_BALL][2], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(shape="star"), "shape is star, expected one of t, box"),
        (dict(mass=0.0), "mass is 0.0, expected > 0"),
        (dict(scale=np.nan), "scale is nan, expected > 0"),
        (dict(height=-1.0), "height is -1.0, expected > 0"),
        (dict(com_offset=[0.1]), r"com_offset is \[0.1\], expected \[x, y\] in metres"),
        (dict(shape="mesh"), "file is '' and shape is mesh, expected a file"),
        (dict(file="a.obj"), "file is 'a.obj' and shape is t, expected a file"),
        (dict(shape="mesh", file="no.obj"), "file is 'no.obj', which is not there"),
    ],
)
def test_what_makes_no_object_is_refused_in_one_line(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        object_sdf(PushedObject(**changes))
    assert "\n" not in str(caught.value)


def test_a_mesh_without_a_body_or_a_foot_is_refused(tmp_path):
    flat = tmp_path / "flat.obj"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match="flat.obj holds no convex body"):
        object_sdf(PushedObject("mesh", file=str(flat)))
    peak = tmp_path / "peak.obj"
    peak.write_text(
        "v 0 0 0\nv .1 0 .1\nv -.1 .1 .1\nv -.1 -.1 .1\n"
        "f 1 3 2\nf 1 4 3\nf 1 2 4\nf 2 3 4\n"
    )
    with pytest.raises(ValueError, match="no flat lower face to stand on"):
        object_sdf(PushedObject("mesh", file=str(peak)))
