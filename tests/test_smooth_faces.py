"""Plates that stand for a curved surface, against the surface itself."""

import numpy as np
import pytest
from gap_benchmark.large_scenes import bowl_mesh
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from makebreak.gap.numerics.free_body import FreeBody, gaps, nearest, simulate
from makebreak.gap.numerics.smooth_faces import (
    MESH,
    OFF,
    none,
    smooth_faces,
    smooth_mesh,
    together,
)

R, BALL, THICK = 0.2, 0.02, 0.005
DOWN = np.array([0.0, 0.0, -1.0])


def plates(degrees: float, hollow: bool, radius: float = R) -> np.ndarray:
    """Fixed shapes (m, 15) that touch a sphere about the origin: its lower half from
    outside, or its upper half from within."""
    step, found = np.radians(degrees), []
    for k in range(int(np.radians(60.0) / step) + 1):
        theta = k * step
        n = max(round(2 * np.pi * np.sin(theta) / step), 1)
        for phi in 2 * np.pi * np.arange(n) / n:
            turn = Rotation.from_euler("ZY", [phi, np.pi - theta if hollow else theta])
            half = 0.6 * step * radius
            out = turn.as_matrix()[:, 2]
            at = (radius + THICK if hollow else radius - THICK) * out
            found.append([*turn.as_matrix().ravel(), *at, half, half, THICK])
    return np.array(found)


def box(at, half, turn=None) -> np.ndarray:
    M = np.eye(3) if turn is None else turn.as_matrix()
    return np.array([*M.ravel(), *at, *half])


def ball(fixed, radius=BALL, mu=0.4, names=None, **other) -> FreeBody:
    n, mass = len(fixed), 0.05
    pair = np.array([2e4, 1.0, mu, mu, 0.5, 0.0])
    return FreeBody(
        mass, np.zeros(3), 0.4 * mass * radius**2 * np.eye(3), 9.81 * DOWN,
        np.array([[0.0, 0.0, 0.0, radius]]), fixed, np.tile(pair, (1, n, 1)),
        np.zeros((1, n)), np.zeros((0, 6)), np.zeros(3),
        smooth=smooth_faces(fixed, names or ["bowl"] * n), **other,
    )  # fmt: skip


def ways(count: int, most: float, sign: float) -> np.ndarray:
    """(count, 3) random directions within an angle [degrees] of sign * z."""
    rng = np.random.default_rng(0)
    theta = np.radians(most) * np.sqrt(rng.uniform(size=count))
    phi = rng.uniform(-np.pi, np.pi, count)
    x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
    return np.column_stack([x, y, sign * np.cos(theta)])


def pose(p) -> np.ndarray:
    return np.array([1.0, 0.0, 0.0, 0.0, *p])


@pytest.mark.parametrize("degrees", [8.0, 3.0])
@pytest.mark.parametrize("hollow", [True, False])
def test_plates_that_touch_a_sphere_are_that_sphere(degrees, hollow):
    """At any distance from it, to rounding: their middles and normals are its own."""
    body = ball(plates(degrees, hollow))
    for depth, way in zip(np.linspace(-1e-3, 1e-3, 60), ways(60, 50.0, -1.0 if hollow
                          else 1.0), strict=True):  # fmt: skip
        far = R - BALL + depth if hollow else R + BALL - depth
        gap, normal, _ = nearest(body, pose(far * way))
        assert gap == pytest.approx(-depth, abs=1e-10)
        np.testing.assert_allclose(normal, -way if hollow else way, atol=1e-9)
        # No plate is nearer than what it stands for.
        assert gaps(body, pose(far * way)).min() == gap


@pytest.mark.parametrize("hollow", [True, False])
def test_a_ball_rolls_on_plates_as_on_a_sphere(hollow):
    """In a bowl as a pendulum, of which rolling makes 7/5 of the inertia; over a bump
    as one upside down, before it leaves it. Plates alone slow it down at each edge."""
    body = ball(plates(5.0, hollow), mu=0.8)
    length, sign = (R - BALL, -1.0) if hollow else (R + BALL, 1.0)
    a0, end = (0.6, 1.5) if hollow else (0.1, 0.4)
    times = np.linspace(0.0, end, 31)
    way = np.array([np.sin(a0), 0.0, sign * np.cos(a0)])
    sunk = 0.05 * 9.81 / 2e4 * np.cos(a0)  # At rest.
    start = np.array([*pose((length - sign * sunk) * way), *np.zeros(6)])
    angle = solve_ivp(
        lambda t, x: [x[1], sign * 5.0 / 7.0 * 9.81 / length * np.sin(x[0])],
        (0.0, end), [a0, 0.0], t_eval=times, rtol=1e-9, atol=1e-9,
    ).y[0]  # fmt: skip
    x = simulate(body, start, times)
    # It creeps at up to the slip of friction's law, 1 mm/s.
    np.testing.assert_allclose(x[:, 4], length * np.sin(angle), atol=8e-4)
    np.testing.assert_allclose(x[:, 5], 0.0, atol=1e-6)
    alone = FreeBody(**{**vars(body), "smooth": none()})
    off = np.abs(simulate(alone, start, times)[:, 4] - length * np.sin(angle))
    assert off.max() > 4e-3


def test_a_plate_that_is_there_twice_changes_nothing():
    one = plates(8.0, True)
    p = pose((R - BALL + 1e-4) * ways(1, 20.0, -1.0)[0])
    twice = ball(np.vstack([one, one[3:9]]))
    assert nearest(twice, p)[0] == pytest.approx(-1e-4, abs=1e-10)


def test_it_goes_where_an_effect_puts_the_plates():
    body = ball(plates(8.0, True))
    moved = np.array(body.fixed)
    moved[:, 9:12] += [0.01, -0.02, 0.03]
    other = FreeBody(**{**vars(body), "fixed": moved})
    p = (R - BALL) * ways(1, 40.0, -1.0)[0]
    gap, normal, _ = nearest(other, pose(p + [0.01, -0.02, 0.03]))
    assert gap == pytest.approx(0.0, abs=1e-10)
    np.testing.assert_allclose(normal, -p / (R - BALL), atol=1e-9)


def test_long_plates_make_a_channel():
    """Their middles stand all along them. The fitted sphere is no cylinder: it is off
    by less than the plates are."""
    step, found = np.radians(6.0), []
    for angle in step * np.arange(-8, 9):
        turn = Rotation.from_euler("x", angle)
        at = turn.apply([0.0, 0.0, -R - THICK])
        found.append(box(at, [0.15, 0.55 * step * R, THICK], turn))
    body = ball(np.array(found))
    off = step**2 * R / 8.0
    found = []
    for x in np.linspace(-0.1, 0.1, 9):
        for angle in np.linspace(-0.4, 0.4, 9):
            way = np.array([0.0, np.sin(angle), -np.cos(angle)])
            gap, normal, _ = nearest(body, pose((R - BALL) * way + [x, 0.0, 0.0]))
            np.testing.assert_allclose(normal, -way, atol=2e-3)
            found.append(gap)
    assert np.abs(found).max() < off and np.ptp(found) < 0.1 * off


def surfaces_of(*boxes, names=None) -> np.ndarray:
    return smooth_faces(np.array(boxes), names or ["it"] * len(boxes)).surfaces


def test_what_is_meant_as_it_is_stays_so():
    # A ramp at a table, and tiles with one at their end: an edge of 10 degrees.
    turn = Rotation.from_euler("y", np.radians(-10.0))
    table = box([0.0, 0.0, -0.01], [0.3, 0.3, 0.01])
    ramp = box([0.3, 0.0, 0.0] + turn.apply([0.3, 0.0, -0.01]), [0.3, 0.3, 0.01], turn)
    assert (surfaces_of(table, ramp) == -1).all()
    tiles = [box([0.6 * k, 0.0, -0.01], [0.3, 0.3, 0.01]) for k in range(-8, 1)]
    assert (surfaces_of(*tiles, ramp) == -1).all()
    # Stairs, and five plates of a pipe.
    stairs = [box([0.1 * k, 0.0, 0.005 * k], [0.05, 0.3, 0.01]) for k in range(9)]
    far = [box([9.0 * k, 0.0, 9.0], [0.05, 0.3, 0.01]) for k in range(1, 9)]
    assert (surfaces_of(*stairs) == -1).all()
    assert (surfaces_of(*plates(8.0, True)[:5], *far) == -1).all()
    # Plates that do not meet, by more than an arc is off them.
    bowl = plates(3.0, True)
    assert (surfaces_of(*bowl)[:, 5] >= 0).all()
    out = np.random.default_rng(0).uniform(-1e-3, 1e-3, len(bowl))
    bowl[:, 9:12] += out[:, None] * bowl[:, [2, 5, 8]]
    assert (surfaces_of(*bowl)[:, 5] >= 0).mean() < 0.7
    # One octagon, whose sides turn by 45 degrees.
    sides = []
    for angle in np.pi / 4.0 * np.arange(8):
        turn = Rotation.from_euler("z", angle)
        sides.append(box(turn.apply([0.1, 0.0, 0.0]), [0.005, 0.042, 0.1], turn))
    assert (surfaces_of(*sides) == -1).all()
    # Plates of as many bodies as there are plates; and what is that coarse.
    bowl = plates(8.0, True)
    assert (surfaces_of(*bowl, names=range(len(bowl))) == -1).all()
    assert (surfaces_of(*plates(13.0, True)) == -1).all()
    assert 5e-4 < smooth_faces(bowl, ["it"] * len(bowl)).off.max() < OFF


def test_beyond_its_rim_there_are_the_plates_own_edges():
    body = ball(plates(8.0, True))
    alone = FreeBody(**{**vars(body), "smooth": none()})
    over = np.radians(60.0) + 0.6 * np.radians(8.0)  # The last plate ends there.
    for beyond in (0.03, 0.1):
        way = np.array([np.sin(over + beyond), 0.0, -np.cos(over + beyond)])
        p = pose((R - 0.5 * BALL) * way)
        assert nearest(body, p)[0] == nearest(alone, p)[0]


def test_a_ball_that_hardly_fits_in_touches_the_plates():
    """It touches more than one of them at a time."""
    radius = 0.9 * R
    body = ball(plates(8.0, True), radius)
    alone = FreeBody(**{**vars(body), "smooth": none()})
    p = pose([0.003, 0.0, -0.1 * R])
    assert nearest(body, p)[0] == nearest(alone, p)[0]


def mesh_of(text: str) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split() for line in text.splitlines()]
    vertices = [[float(x) for x in row[1:]] for row in rows if row[0] == "v"]
    faces = [[int(x) - 1 for x in row[1:]] for row in rows if row[0] == "f"]
    return np.array(vertices), np.array(faces)


def on_mesh(vertices, triangles) -> FreeBody:
    fixed = np.array([[*np.eye(3).ravel(), 0.0, 0.0, 0.0, MESH, 0.0, 0.0]])
    body = ball(fixed)
    smooth = together([none(), smooth_mesh(vertices, triangles, 0)], 1)
    return FreeBody(**{**vars(body), "smooth": smooth})


@pytest.mark.parametrize("degrees", [6.0, 3.0])
def test_a_mesh_with_its_vertices_on_a_sphere_is_that_sphere(degrees):
    """To a small part of what its triangles are off it."""
    body = on_mesh(*mesh_of(bowl_mesh(R, degrees)))
    assert len(np.unique(body.smooth.surface)) == 3  # Inside, outside, and its rim.
    # Its inside ends at the rim, as the others do.
    ends = body.smooth.place[body.smooth.is_edge]
    np.testing.assert_allclose(np.arctan2(np.hypot(*ends[:, :2].T), R - ends[:, 2]),
                               np.radians(70.0), atol=1e-9)  # fmt: skip
    assert len(ends) == 4 * len(np.unique(np.round(ends, 9), axis=0)) // 2
    sag = np.radians(degrees) ** 2 * R / 8.0
    middle = np.array([0.0, 0.0, R])
    for way in ways(200, 60.0, -1.0):
        p = middle + (R - BALL) * way
        gap, normal, _ = nearest(body, pose(p))
        assert abs(gap) < 0.15 * sag
        np.testing.assert_allclose(normal, -way, atol=0.03 * np.radians(degrees))
    # Beyond its rim there is nothing.
    over = np.radians(70.0 + 1.5 * degrees)
    way = np.array([np.sin(over), 0.0, -np.cos(over)])
    assert nearest(body, pose(middle + (R - BALL) * way))[0] > 1e6


def test_a_ball_rolls_over_a_meshed_bump():
    """A terrain of triangles, z = h cos(k x) cos(k y): energy is kept the better the
    finer it is, and the path is that on twice as fine a mesh."""

    def terrain(step: float):
        n = round(0.6 / step)
        at = np.linspace(-0.3, 0.3, n + 1)
        x, y = np.meshgrid(at, at, indexing="ij")
        z = 0.01 * np.cos(20.0 * x) * np.cos(20.0 * y)
        k = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
        a, b, c, d = (
            k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[:-1, 1:].ravel(),
            k[1:, 1:].ravel(),
        )  # fmt: skip
        triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
        return on_mesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), triangles)

    start = np.array([*pose([-0.2, 0.02, 0.0]), 0.0, 0.0, 0.0, 0.5, 0.05, 0.0])
    times, ends, errors = np.linspace(0.0, 0.6, 61), [], []
    for step in (0.01, 0.005):
        body = terrain(step)
        for _ in range(30):  # Down to where its weight is carried.
            gap, normal, _ = nearest(body, start[:7])
            start[4:7] -= (gap + 0.05 * 9.81 / 2e4) * normal
        v = start[10:] - normal * (normal @ start[10:])
        start[7:10], start[10:] = np.cross(normal, v) / BALL, v
        x = simulate(body, start, times)
        energy = 9.81 * x[:, 6] + 0.5 * np.sum(x[:, 10:] ** 2, axis=1)
        energy += 0.2 * BALL**2 * np.sum(x[:, 7:10] ** 2, axis=1)
        assert np.ptp(x[:, 6]) > 5e-3  # Up and down.
        errors.append(np.abs(energy - energy[0]).max() / energy[0])
        ends.append(x[-1, 4:7])
    assert errors[0] < 0.02 and errors[1] < 0.4 * errors[0]
    np.testing.assert_allclose(ends[0], ends[1], atol=4e-3)  # Of 0.25 m.


def test_an_edge_of_a_mesh_is_between_two_surfaces():
    """A box has twelve triangles, two a side: too few to be more than they are."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4],
             [1, 5, 7, 3]]  # fmt: skip
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    assert not len(smooth_mesh(0.1 * corners, np.array(faces), 0).of)
