"""The fast steps of a free body against Drake's, and effects on its numbers."""

import copy
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from gap_benchmark import contact_world
from gap_benchmark.cases import cases, make, write
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Box, Convex, Cylinder
from pydrake.math import RotationMatrix

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.numerics.free_body import (
    FreeBody,
    lowest_gap,
    nearest,
    simulate,
)
from makebreak.gap.residuals.contact import _trials
from makebreak.gap.simulation.face_supports import centres_of, within_faces
from makebreak.gap.simulation.free_body import REST_DEPTH, FreeBodyScene, gone_on
from makebreak.gap.simulation.free_windows import FreeBodyModel
from makebreak.gap.simulation.scene_simulation import SceneSimulation, SimulationConfig
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import InitialSection, read_scene

PAIR = "cube.cube~ground.ground"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A cube of eight spheres above a box."""
    folder = tmp_path_factory.mktemp("cube")
    (case,) = [c for c in cases("development") if c.name == "07_cube_none"]
    with pytest.MonkeyPatch.context() as patch:  # It need not fly here.
        patch.setattr(
            contact_world, "simulate", lambda *x: np.tile(x[3], (len(x[4]), 1))
        )
        write(case, folder, make(case))
    scene = read_scene(folder / "scene.yaml")
    return replace(scene, plant=replace(scene.plant, time_step=0.0))


@pytest.mark.parametrize(
    "effect",
    [
        Effect("contact_friction", [PAIR], {"friction": 0.15}),
        Effect("contact_friction", [PAIR], {"friction": 1.2}),
        Effect("contact_stiffness", [PAIR], {"stiffness": 3e3}),
        Effect("contact_stiffness", [PAIR], {"stiffness": 2e5}),
        Effect("contact_dissipation", [PAIR], {"dissipation": 0.1}),
        Effect("contact_dissipation", [PAIR], {"dissipation": 4.0}),
        Effect("contact_damping", [PAIR], {"damping": 3.0}),
        Effect("object_mass", ["cube.cube"], {"mass": 0.5}),
        Effect("object_com", ["cube"], {"x": 0.003, "z": -0.002}),
        Effect("object_inertia", ["cube"], {"ixx": 9e-4, "iyy": 8e-4, "izz": 7e-4}),
        Effect("object_size", ["cube.cube"], {"scale": 1.05}),
        Effect("corner_radius", ["cube.cube"], {"radius": 0.006}),
        Effect("plane_height", ["ground.ground"], {"height": 0.004}),
        Effect("plane_tilt", ["ground"], {"roll": 0.02, "pitch": -0.03}),
        Effect("wall_position", ["ground"], {"x": 0.02, "z": -0.004}),
        Effect("body_drag", ["cube.cube"], {"linear": 0.4, "angular": 1e-4}),
        Effect("body_quadratic_drag", ["cube.cube"], {"coefficient": 0.03}),
        Effect("constant_force", ["cube.cube"], {"fx": 0.1, "fy": -0.2, "fz": 0.3}),
    ],
    ids=lambda e: e.kind,
)  # fmt: skip
def test_an_effect_changes_the_numbers_as_it_changes_the_plant(scene, effect):
    fast = FreeBodyScene(scene).body([effect])
    built = FreeBodyScene(replace(scene, effects=[effect])).body()
    for name, value in vars(built).items():
        a, b = getattr(fast, name), value
        if name == "smooth":
            a, b = len(a.of), len(b.of)
        if name == "spheres":  # In whatever order.
            a, b = (x[np.lexsort(np.round(x, 9).T)] for x in (a, b))
        # Sums of a few terms, in other orders; SDF is written with 17 digits.
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=name)


def test_the_steps_follow_drakes_continuous_plant_through_an_impact(scene):
    numbers = FreeBodyScene(scene)
    start = np.array([*scene.initial.poses[numbers.name], 1, 2, -3, 0.3, -0.2, -0.5])
    times = np.linspace(0.0, 0.25, 26)  # It touches at 0.17 s.
    names = "qw qx qy qz x y z wx wy wz vx vy vz".split()
    initial = InitialSection(
        poses={numbers.name: list(start[:7])},
        body_velocities={numbers.name: list(start[7:])},
    )
    # Drake's own error at its default accuracy is 1e-4 m after an impact.
    drake = SceneSimulation(scene, SimulationConfig(accuracy=1e-8))
    want = drake.run(initial, times, [f"{numbers.name}.{n}" for n in names])
    got = simulate(numbers.body(), start, times, tol=1e-8)
    assert np.abs(np.diff(want[:, 12])).max() > 0.2  # It has hit [m/s].
    np.testing.assert_allclose(got[:, 4:7], want[:, 4:7], atol=3e-5)
    np.testing.assert_allclose(got[:, :4], want[:, :4], atol=3e-4)


def test_drag_with_the_square_of_the_speed_ends_in_a_steady_fall(scene):
    # From rest v = -u tanh(g t/u), z = -(u2/g) ln cosh(g t/u); u2 = m g/c.
    body = FreeBodyScene(scene).body(
        [Effect("body_quadratic_drag", ["cube.cube"], {"coefficient": 0.05})]
    )
    g, times = -body.gravity[2], np.linspace(0.0, 4.0, 9)
    u = np.sqrt(body.mass * g / 0.05)
    body = replace(body, com=np.zeros(3))
    start = np.array([1.0, 0, 0, 0, 0, 0, 200.0, 0, 0, 0, 0, 0, 0])
    x = simulate(body, start, times, tol=1e-9)
    fallen = u**2 / g * np.log(np.cosh(g * times / u))
    np.testing.assert_allclose(x[:, 6], 200.0 - fallen, atol=1e-6)
    np.testing.assert_allclose(x[:, 12], -u * np.tanh(g * times / u), atol=1e-6)
    assert abs(x[-1, 12]) > 0.9 * u


def test_a_scene_with_more_than_one_free_body_is_refused(scene):
    second = copy.deepcopy(scene.directives[-1])
    second.add_model.name = "second"
    two = replace(scene, directives=[*scene.directives, second])
    with pytest.raises(ValueError, match="one free body"):
        FreeBodyScene(two)


def test_a_patch_of_ground_has_its_own_friction(scene):
    # One sphere slides along x: mu g slows it, as much as the patch it is on has.
    numbers = FreeBodyScene(scene).body()
    ball = replace(
        numbers, spheres=np.array([[0.0, 0.0, 0.0, 0.02]]), com=np.zeros(3),
        inertia=1e9 * np.eye(3), pairs=numbers.pairs[:1], levers=numbers.levers[:1],
    )  # fmt: skip
    mu = ball.pairs[0, 0, 3]
    top = ball.fixed[0, 11] + ball.fixed[0, 14]
    g = -ball.gravity[2]
    sink = ball.mass * g / ball.pairs[0, 0, 0]
    start = np.array([1, 0, 0, 0, 0, 0, top + 0.02 - sink, 0, 0, 0, 1.0, 0, 0], float)
    times = np.linspace(0.0, 0.1, 11)
    for friction, sides in ((0.05, (0.03, 1, -1, 1)), (0.05, (0.03, 1, 0.1, 1))):
        patch = np.array([[0, friction, *sides]])
        x = simulate(replace(ball, patches=patch), start, times, tol=1e-7)
        inside = sides[2] < 0.0
        # 0.03 m on the ground, the rest on the patch.
        v2 = 1.0 - 2.0 * mu * g * 0.03
        rest = x[-1, 4] - 0.03
        v2 -= 2.0 * (friction if inside else mu) * g * rest
        np.testing.assert_allclose(x[-1, 10] ** 2, v2, atol=1e-4)
        assert rest > 0.03


def test_a_linear_damper_gives_back_the_same_share_of_any_speed(scene):
    numbers = FreeBodyScene(scene).body()
    m, k, zeta = numbers.mass, 5e4, 0.1
    pair = np.array([[[k, 0.0, 0.0, 0.0, 0.5, 2.0 * zeta * np.sqrt(k * m)]]])
    ball = replace(
        numbers, spheres=np.array([[0.0, 0.0, 0.0, 0.02]]), com=np.zeros(3),
        pairs=pair, levers=numbers.levers[:1], gravity=np.zeros(3),
    )  # fmt: skip
    top = ball.fixed[0, 11] + ball.fixed[0, 14]
    # Until the force is zero again, which is before the spring is at its length: m x''
    # = -(k x + c x'), of which x = sin(w t) exp(-zeta w0 t).
    root = np.sqrt(1.0 - zeta**2)
    share = np.exp(-zeta / root * np.arctan2(2.0 * zeta * root, 2.0 * zeta**2 - 1.0))
    for speed in (0.2, 1.0, 4.0):
        start = np.array([1, 0, 0, 0, 0, 0, top + 0.021, 0, 0, 0, 0, 0, -speed])
        x = simulate(ball, start, [0.0, 0.03 + 2e-3 / speed], tol=1e-8)
        np.testing.assert_allclose(x[-1, 12], share * speed, rtol=1e-4)


def test_corners_and_inner_points_turn_as_a_face_that_presses_evenly():
    """With what is said of it at WITHIN_BOX: mean distance and mean square of it from
    the middle, of a disc exactly, of a square's to 1 %."""
    rng, n = np.random.default_rng(0), 200_000
    square = rng.uniform(-0.1, 0.1, (n, 2))
    for shape, even, share in (
        (Box(0.2, 0.2, 0.05), square, 0.16),
        (Cylinder(0.1, 0.05), square[np.hypot(*square.T) < 0.1], 1.0 / 3.0),
    ):
        corners, radius = centres_of(shape)
        inner = within_faces(shape)
        sides = [x[x[:, 2] > 0.025 - 1.5 * radius] for x in (corners, inner)]
        # The corners' spheres lie within the edge by their radius.
        ways = [np.hypot(*x[:, :2].T) for x in sides]
        ways = [x * 0.1 / (0.1 - radius) for x in ways]
        if len(inner) > 8:  # A box's other faces have points at this height too.
            ways[1] = ways[1][ways[1] < 0.08]
        for power, tol in ((1, 0.01), (2, 0.02)):
            got = share * np.mean(ways[0] ** power)
            got += (1.0 - share) * np.mean(ways[1] ** power)
            want = np.mean(np.hypot(*even.T) ** power)
            np.testing.assert_allclose(got, want, rtol=tol)


def test_a_wall_that_stands_on_a_table_goes_on_into_it():
    """At its foot, where a corner that is a little deep is nearer to the wall's lower
    face than to the one that it ran against."""
    box = np.concatenate([np.eye(3).ravel(), [0.0, 0.0, -0.1], [2.0, 2.0, 0.1]])
    half_space = np.concatenate([np.eye(3).ravel(), np.zeros(3), [-1.0, 0.0, 0.0]])
    wall = np.concatenate([np.eye(3).ravel(), [0.5, 0.0, 0.2], [0.05, 1.0, 0.2]])
    corner = [0.0, 0.0, 0.0, 1e-5]
    for below, deep in ((box, 0.2), (half_space, 1.0)):
        fixed = gone_on(np.stack([below, wall]))
        np.testing.assert_allclose(fixed[0], below)
        np.testing.assert_allclose(fixed[1, 12:], [0.05, 1.0, 0.2 + 0.5 * deep])
        np.testing.assert_allclose(fixed[1, 9:12], [0.5, 0.0, 0.2 - 0.5 * deep])
        body = FreeBody(
            1.0, np.zeros(3), np.eye(3), np.zeros(3), np.array([corner]),
            fixed[1:], np.zeros((1, 1, 6)), np.zeros((1, 1)), np.zeros((0, 6)),
            np.zeros(3),
        )  # fmt: skip
        _, normal, _ = nearest(body, np.array([1, 0, 0, 0, 0.451, 0, 2e-4]))
        np.testing.assert_allclose(normal, [-1.0, 0.0, 0.0])
    # One that hangs 2 mm above it, or reaches beyond its edge, has a lower face.
    for off in ([0.0, 0.0, 2e-3], [0.0, 1.5, 0.0]):
        moved = np.array(wall)
        moved[9:12] += off
        np.testing.assert_allclose(gone_on(np.stack([box, moved]))[1], moved)


def test_a_hull_has_spheres_within_its_largest_faces(tmp_path):
    """A prism of six sides: within each of its ends, and of its sides."""
    angle = np.arange(6) * np.pi / 3.0
    ring = np.column_stack([0.05 * np.cos(angle), 0.05 * np.sin(angle)])
    points = [[*p, z] for z in (-0.015, 0.015) for p in ring]
    lines = [f"v {x} {y} {z}" for x, y, z in points]
    lines += [f"f {i + 1} {(i + 1) % 6 + 1} {i + 7}" for i in range(6)]
    lines += [f"f {(i + 1) % 6 + 1} {(i + 1) % 6 + 7} {i + 7}" for i in range(6)]
    (tmp_path / "prism.obj").write_text("\n".join(lines) + "\n")
    inner = within_faces(Convex(str(tmp_path / "prism.obj"), 1.0), 1e-5)
    low = inner[inner[:, 2] < -0.0149]
    np.testing.assert_allclose(low[:, 2], -0.015 + 1e-5)
    np.testing.assert_allclose(np.hypot(*low[:, :2].T), 0.47 * 0.05, rtol=1e-3)
    assert len(inner) == 12 + 6 * 4


def test_a_capsule_touches_with_its_two_ends(scene, tmp_path):
    """Tilted by a, its lowest point is half its length times sin(a), and its radius,
    below its middle."""
    rod = "<capsule><radius>0.02</radius><length>0.1</length></capsule>"
    numbers = FreeBodyScene(with_brick(scene, tmp_path, shape=rod))
    body, a = numbers.body(), 0.3
    assert numbers.has_faces  # At the edge of a table other points would touch.
    top = body.fixed[0, 11] + body.fixed[0, 14]
    turn = 0.5 * (0.5 * np.pi - a)
    pose = np.array([np.cos(turn), np.sin(turn), 0, 0, 0, 0, top + 0.5])
    want = 0.5 - 0.05 * np.sin(a) - 0.02
    assert lowest_gap(body, pose) == pytest.approx(want, abs=1e-12)


BRICK = "<box><size>0.2 0.1 0.06</size></box>"


def with_brick(scene, folder, effects=(), shape=BRICK):
    """The scene with a box of 0.2 x 0.1 x 0.06 m, or another shape, in the place of the
    cube."""
    (folder / "brick.sdf").write_text(
        '<sdf version="1.9"><model name="brick"><link name="brick"><collision name="c">'
        f"<geometry>{shape}</geometry></collision></link></model></sdf>"
    )
    brick = copy.deepcopy(scene.directives[-1])
    brick.add_model.name, brick.add_model.file = "brick", f"file://{folder}/brick.sdf"
    return replace(
        scene, directives=[*scene.directives[:-1], brick],
        initial=type(scene.initial)(), effects=list(effects),
    )  # fmt: skip


def test_a_box_has_spheres_at_its_corners_and_within_its_faces(scene, tmp_path):
    hard = Effect(
        "contact_stiffness", ["brick.brick~ground.ground"], {"stiffness": 1e6}
    )
    numbers = FreeBodyScene(with_brick(scene, tmp_path, [hard]))
    assert numbers.has_faces
    body = numbers.body()
    assert lowest_gap(body, np.array([1, 0, 0, 0, 0, 0, 5.0])) == pytest.approx(
        5.0 - 0.03 - body.fixed[0, 11] - body.fixed[0, 14]
    )
    whole = numbers.body((), at_corners=1.0)
    assert (whole.pairs[8:, :, 0] == 0.0).all() and (whole.pairs[:8, :, 0] > 0.0).all()
    numbers.ease()  # At rest on a face it is as deep as is said.
    face = numbers.body().pairs[:, 0, 0].sum() / 2.0
    weight = body.mass * np.linalg.norm(body.gravity)
    assert weight / face == pytest.approx(REST_DEPTH)


def test_a_box_lands_on_corners_as_sharp_as_it_has(scene, tmp_path):
    """Rounded by 2 mm, as those of what lies on a face may be, corners let a cube that
    lands on one turn otherwise; that a real one's are sharp then looked like a gap."""
    body = FreeBodyScene(with_brick(scene, tmp_path)).body()
    floor = body.fixed[0, 11] + body.fixed[0, 14]
    q = np.array([0.8, 0.3, -0.4, 0.33])
    q /= np.linalg.norm(q)
    corners = np.array(list(product((-1, 1), repeat=3))) * [0.1, 0.05, 0.03]
    lowest = (corners @ RotationMatrix(Quaternion(q)).matrix().T)[:, 2].min()
    gap = lowest_gap(body, np.array([*q, 0.0, 0.0, floor + 0.2]))
    # Spheres of 0.01 mm stand in for the corners.
    np.testing.assert_allclose(gap, 0.2 + lowest, atol=1e-5)


def with_puck(scene, folder, friction: float, of_wall: float | None = None):
    """The scene with a cylinder in the place of the cube, and a wall at x = 0.5."""

    def surface(mu: float) -> str:
        return (
            '<drake:proximity_properties xmlns:drake="drake.mit.edu">'
            f"<drake:mu_static>{mu}</drake:mu_static>"
            f"<drake:mu_dynamic>{mu}</drake:mu_dynamic>"
            "<drake:point_contact_stiffness>60000</drake:point_contact_stiffness>"
            "<drake:hunt_crossley_dissipation>0.5</drake:hunt_crossley_dissipation>"
            "</drake:proximity_properties>"
        )

    shapes = {
        "puck": "<cylinder><radius>0.04</radius><length>0.02</length></cylinder>",
        "wall": "<box><size>0.2 2 2</size></box>",
    }
    inertial = (
        "<inertial><mass>0.3</mass><inertia><ixx>1.3e-4</ixx><iyy>1.3e-4</iyy>"
        "<izz>2.4e-4</izz></inertia></inertial>"
    )
    directives = list(scene.directives[:-1])
    for name, shape in shapes.items():
        mu = friction if name == "puck" or of_wall is None else of_wall
        place = '<pose relative_to="__model__">0.6 0 0 0 0 0</pose>' * (name == "wall")
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><static>{name == "wall"}</static>'
            f'<link name="{name}">{place}{inertial * (name == "puck")}'
            f'<collision name="c"><geometry>{shape}</geometry>{surface(mu)}'
            "</collision></link></model></sdf>"
        )
        more = copy.deepcopy(scene.directives[-1])
        more.add_model.name, more.add_model.file = name, f"file://{folder}/{name}.sdf"
        directives.append(more)
    return replace(scene, directives=directives, initial=type(scene.initial)())


@pytest.mark.parametrize("yaw", [0.0, 0.1, 0.26])
def test_a_round_puck_meets_a_wall_as_a_circle_does(scene, tmp_path, yaw):
    """Spheres along its rim, 30 degrees apart, made a polygon of it, whose corners turn
    it where they hit. What a wall without friction does is the same at any yaw, and
    what friction turns it by is a closed form while it slips: izz w = r mu m dv."""
    for mu in (0.0, 0.05):
        numbers = FreeBodyScene(with_puck(scene, tmp_path, mu))
        body = replace(numbers.body(), gravity=np.zeros(3))
        q = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        start = np.array([*q, 0.4, 0, 0.5, 0, 0, 0, 1.0, 0.5, 0.0])
        x = simulate(body, start, np.array([0.0, 0.15]), tol=1e-8)[-1]
        assert x[10] < -0.5  # It came back.
        change = mu * (1.0 - x[10])
        np.testing.assert_allclose(x[11], 0.5 - change, atol=1e-4)
        # The point of contact is a little within the rim: by half of 2 mm of 40.
        want = -0.04 * 0.3 * change / 2.4e-4
        np.testing.assert_allclose(x[7:10], [0.0, 0.0, want], rtol=0.05, atol=1e-3)


def test_only_what_is_never_hit_is_eased(scene, tmp_path):
    numbers = FreeBodyScene(with_puck(scene, tmp_path, 0.1))
    stiff = numbers.body().pairs[:, :, 0]
    numbers.ease(np.array([True, False]))
    eased = numbers.body().pairs[:, :, 0]
    np.testing.assert_array_equal(eased[:, 1], stiff[:, 1])
    assert eased[:, 0].max() < 0.5 * stiff[:, 0].max()


def test_a_walls_friction_is_not_tried_where_it_would_change_the_grounds(
    scene, tmp_path
):
    """Twice what the puck's surface has is out of reach of the wall's: both become as
    rough, and the puck on the ground, too."""
    two = with_puck(scene, tmp_path, 0.1, of_wall=0.4)
    body = FreeBodyScene(two).body()
    top = body.fixed[0, 11] + body.fixed[0, 14] + 0.01
    rng, rows = np.random.default_rng(0), []
    times = np.arange(0.0, 0.8, 0.01)
    for episode in range(3):
        speed = rng.uniform(0.8, 1.2)
        start = np.array([1.0, 0, 0, 0, 0.2, 0, top, 0, 0, 0, speed, 0.1, 0.0])
        x = simulate(body, start, times)[:, :7]
        x[:, 4:] += 3e-4 * rng.normal(size=(len(x), 3))
        x[:, :4] += 1e-3 * rng.normal(size=(len(x), 4))
        stamp = times + 2.0 * episode
        rows.append(np.column_stack([np.full(len(x), episode), stamp, x]))
    names = [f"puck.puck.{n}" for n in "qw qx qy qz x y z".split()]
    header = ",".join(["episode", "time", *names])
    log = tmp_path / "log.csv"
    np.savetxt(log, np.concatenate(rows), delimiter=",", header=header, comments="")
    recordings, _ = condition(read_recordings([log]), False)
    model = FreeBodyModel(two, recordings)
    at = "puck.puck~wall.wall"
    ((tried, _, _),) = _trials(model, "contact_friction", at)
    assert [f"{t[0][1]['friction']:.3g}" for t in tried] == ["0.08", "0.144"]
