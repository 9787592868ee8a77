"""Where shapes of a scene may touch, at many poses at once: points against surfaces.

Spheres are their centres, boxes and hulls their corners. A cylinder that stands on
something is points on its rims; where its side touches, of each rim the point that is
nearest to the other surface; of a capsule's axis the ends, and the nearest point. Each
is compared with the surfaces of other bodies. Edges that cross edges are those of
boxes, of which one moves freely. Friction and stiffness of a pair are those that Drake
makes of two surfaces.
"""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from pydrake.geometry import Box, Capsule, Convex, Cylinder, HalfSpace, Mesh, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.budget import go_on
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics import surface_distance
from makebreak.gap.numerics.edge_crossings import Edge, crossing, edges_of_box
from makebreak.models.effects.kind import full_name
from makebreak.models.scene import LoadedScene

MEETS = 2.5e-3  # Two bodies touch when the nearest points are within this [m].
APPROACH = 0.02  # Faster along the normal is no lasting contact [m/s].
RIM = 12  # Points on a rim.
SIDE = 0.9  # Cosine of normal and axis: less, and a cylinder touches with its side.
MOST_CORNERS = 200  # Of a hull; more are thinned.
BEYOND = 2.5e-3  # A corner so far beyond the edge of a face still touches it [m].
OVERLAP = 5e-4  # More, and a face is not between a box and a cylinder [m].
THIRDS = 24  # Of a capsule's axis: what is left of it is 6e-5.
SAME_NORMAL = 0.64  # Cosine: a point touches one of two surfaces that face alike.


@dataclass(frozen=True, eq=False)
class _Point:
    body: int
    geometry: object
    p_B: np.ndarray
    radius: float
    friction: float
    stiffness: float
    is_sphere: bool = False
    is_corner: bool = False  # Of a box.
    axis: np.ndarray | None = None  # Of the cylinder that it is on the rim of.
    rim: float = 0.0  # Any point on a rim of this radius about p_B, if not 0 [m].
    # (3,) Any point up to so far to either side of p_B, of a capsule's axis [m].
    along: np.ndarray | None = None

    @property
    def is_edge(self) -> bool:
        """Whether it is where two faces of its own shape meet: the nearest face of
        another shape may then be one that its shape is not over."""
        return self.is_corner or self.axis is not None

    def stands(self, normal, R_a) -> np.ndarray:
        """(n,) whether its cylinder meets normals (n, 3) with an end."""
        assert self.axis is not None
        return abs(np.sum(normal * (R_a @ self.axis), axis=1)) >= SIDE

    def near(
        self, s: "_Surface", R_a, p_a, R_b, p_b
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The point's place (n, 3) in world at poses of the two bodies, its distance
        (n,) from the surface, the normal (n, 3), and whether it may touch so (n,)."""
        c = p_a + R_a @ self.p_B
        if self.along is not None:
            c = c + self._nearest(s, c, R_a, R_b, p_b)[:, None] * (R_a @ self.along)
        d, n = s.distance(np.einsum("nji,nj->ni", R_b, c - p_b))
        n = np.einsum("nij,nj->ni", R_b, n)
        if self.axis is None:
            return c, d - self.radius, n, np.ones(len(c), bool)
        if not self.rim:
            return c, d - self.radius, n, self.stands(n, R_a)
        axis = R_a @ self.axis
        along = np.sum(n * axis, axis=1)
        side = abs(along) < SIDE
        # Towards the surface from the middle, which is outside: exact for planes, and
        # for upright shapes.
        out = n - along[:, None] * axis
        size = np.maximum(np.linalg.norm(out, axis=1), 1e-9)
        c = c - self.rim * out / size[:, None]
        d, _ = s.distance(np.einsum("nji,nj->ni", R_b, c - p_b))
        return c, d - self.radius, n, side

    def stays_away(self, s: "_Surface", c, middle, R_b, p_b, near: float) -> bool:
        """Whether it is farther than `near` [m] at all poses, as balls about the two
        say, or the distance of its middle: what takes little time.

        Args: c, middle (n, 3): its place and the middle of the surface in world.
        """
        half = 0.0 if self.along is None else float(np.linalg.norm(self.along))
        most = near + self.radius + self.rim + half
        between = c - middle
        least = np.einsum("ni,ni->n", between, between).min()
        if least > (most + s.reach()) ** 2:
            return True
        if self.along is None:
            return False
        d, _ = s.distance(np.einsum("nji,nj->ni", R_b, c - p_b))
        return bool(d.min() > most)

    def _nearest(self, s: "_Surface", c, R_a, R_b, p_b) -> np.ndarray:
        """(n,) where on the axis, from -1 to 1, it is nearest to a convex surface, of
        which the distance is convex along a line: by thirds."""
        assert self.along is not None
        start = np.einsum("nji,nj->ni", R_b, c - p_b)
        along = np.einsum("nji,nj->ni", R_b, R_a @ self.along)
        low, high = -np.ones(len(c)), np.ones(len(c))
        for _ in range(THIRDS):
            a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
            nearer = (
                s.distance(start + a[:, None] * along)[0]
                <= s.distance(start + b[:, None] * along)[0]
            )
            low, high = np.where(nearer, low, a), np.where(nearer, b, high)
        return 0.5 * (low + high)


@dataclass(frozen=True, eq=False)
class _Surface:
    body: int
    geometry: object
    kind: str
    R_BG: np.ndarray
    p_BG: np.ndarray
    size: tuple
    friction: float
    stiffness: float
    far: float = np.inf  # Of a hull, how far its corners are from its origin [m].

    def local(self, places, R_b, p_b) -> np.ndarray:
        """(n, 3) places in world in the surface's own frame, at poses of its body."""
        p = np.einsum("nji,nj->ni", R_b, places - p_b)
        return (p - self.p_BG) @ self.R_BG

    def reach(self) -> float:
        """How far it is from its own origin at most [m]; infinite where it is open."""
        if self.kind == "box":
            return float(np.linalg.norm(self.size[0]))
        if self.kind in ("sphere", "capsule", "cylinder"):
            return float(sum(self.size))
        return self.far

    def scaled(self, scale: float) -> "_Surface":
        """About the body's origin."""
        size = tuple(scale * x for x in self.size)
        if self.kind == "hull":  # Normals of its faces stay as they are.
            size = (self.size[0], scale * self.size[1])
        far = scale * self.far
        return replace(self, p_BG=scale * self.p_BG, size=size, far=far)

    def distance(self, p) -> tuple[np.ndarray, np.ndarray]:
        """Of points (n, 3) in the body's frame, and normals there."""
        local = (p - self.p_BG) @ self.R_BG
        d, n = getattr(surface_distance, self.kind)(local, *self.size)
        return d, n @ self.R_BG.T


@dataclass(frozen=True, eq=False)
class _BoxEdges:
    """centre (3,) in the body's frame, radius [m]: of the ball about the box."""

    body: int
    geometry: object
    is_free: bool
    edges: list[Edge]
    centre: np.ndarray
    radius: float
    friction: float
    stiffness: float


@dataclass(frozen=True, eq=False)
class Slot:
    """One point and one surface at n poses, or two edges. a, b: bodies of the point and
    the surface.

    phi (n,) distance [m]; normal (n, 3) from b to a; place (n, 3), both in world;
    best (n,): no other surface that faces alike is nearer to the point.
    friction, stiffness [N/m] of the two together. gives: of the depth, the share by
    which the shape of a gives, the softer the more; that of b gives the rest.
    """

    a: int
    b: int
    key: tuple[int, int]  # Number of the point and of the surface; below 0: of edges.
    phi: np.ndarray
    normal: np.ndarray
    place: np.ndarray
    best: np.ndarray
    friction: float
    stiffness: float
    gives: float = 0.5


class ContactShapes:
    """The points and surfaces of a loaded scene.

    Args: hulls: whether meshes count, as their convex hulls.
    Raises: DoesNotFit for friction zones, or a free body with another shape.
    """

    def __init__(self, loaded: LoadedScene, hulls: bool = True):
        self._hulls = hulls
        plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
        if loaded.scene.friction_zones:
            raise DoesNotFit("friction zones are Drake's alone")
        self.points: list[_Point] = []
        self.surfaces: list[_Surface] = []
        self.boxes: list[_BoxEdges] = []
        self.names: dict[int, str] = {}
        self.anchored: set[int] = set()
        for k in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(k))
            if plant.IsAnchored(body):
                self.anchored.add(k)
            for g in plant.GetCollisionGeometriesForBody(body):
                properties = inspector.GetProximityProperties(g)
                if properties is None:
                    continue
                X, shape = inspector.GetPoseInFrame(g), inspector.GetShape(g)
                mu = properties.GetProperty("material", "coulomb_friction")
                stiffness = properties.GetPropertyOrDefault(
                    "material", "point_contact_stiffness", np.inf
                )
                own = (mu.dynamic_friction(), float(stiffness))
                R, p = X.rotation().matrix(), X.translation()
                self.names[k] = full_name(plant, body)
                if isinstance(shape, Box):
                    half = shape.size() / 2.0
                    radius, edges = (
                        float(np.linalg.norm(half)),
                        edges_of_box(half, R, p),
                    )
                    free = body.is_floating_base_body()
                    self.boxes.append(_BoxEdges(k, g, free, edges, p, radius, *own))
                if not self._add(k, g, shape, R, p, own):
                    if body.is_floating_base_body():
                        raise DoesNotFit(
                            f"{full_name(plant, body)}: no contact of a "
                            f"{type(shape).__name__} is known here"
                        )
        self._apart = {
            (p.geometry, s.geometry): inspector.CollisionFiltered(
                p.geometry, s.geometry
            )
            for p in self.points
            for s in self.surfaces
        }

    def _add(self, k: int, g, shape, R, p, own) -> bool:
        friction, stiffness = own

        def points(
            local, radius=0.0, is_sphere=False, axis=None, rim=0.0, is_corner=False,
            along=None,
        ):  # fmt: skip
            for x in np.atleast_2d(local):
                self.points.append(
                    _Point(
                        k,
                        g,
                        R @ x + p,
                        radius,
                        friction,
                        stiffness,
                        is_sphere,
                        is_corner,
                        axis,
                        rim,
                        along,
                    )
                )

        def surface(kind, *size, far=np.inf):
            self.surfaces.append(
                _Surface(k, g, kind, R, p, size, friction, stiffness, far)
            )

        if isinstance(shape, Sphere):
            points(np.zeros(3), shape.radius(), True)
            surface("sphere", shape.radius())
        elif isinstance(shape, Box):
            half = shape.size() / 2.0
            points(np.array(list(product((-1, 1), repeat=3))) * half, is_corner=True)
            surface("box", half)
        elif isinstance(shape, HalfSpace):
            surface("half_space")
        elif isinstance(shape, Cylinder):
            r, h = shape.radius(), shape.length() / 2.0
            angle = np.arange(RIM) * 2.0 * np.pi / RIM
            x, y, axis = r * np.cos(angle), r * np.sin(angle), R[:, 2]
            for z in (-h, h):
                points(np.column_stack([x, y, np.full(RIM, z)]), axis=axis)
            points([[0.0, 0.0, -h], [0.0, 0.0, h]], axis=axis, rim=r)
            surface("cylinder", r, h)
        elif isinstance(shape, Capsule):
            r, h = shape.radius(), shape.length() / 2.0
            points(np.zeros(3), r, along=h * R[:, 2])
            points([[0.0, 0.0, -h], [0.0, 0.0, h]], r)  # Along a plane both touch.
            surface("capsule", r, h)
        elif isinstance(shape, (Convex, Mesh)) and self._hulls:
            mesh = shape.GetConvexHull()
            corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
            N = np.array([mesh.face_normal(i) for i in range(mesh.num_faces())])
            d = (corners @ N.T).max(axis=0)
            step = max(len(corners) // MOST_CORNERS, 1)
            points(corners[::step])
            surface("hull", N, d, far=float(np.linalg.norm(corners, axis=1).max()))
        else:
            return False
        return True

    def keep(self, counts: Callable[[int], bool]) -> None:
        """Only the shapes of bodies for which counts(body)."""
        self.points = [p for p in self.points if counts(p.body)]
        self.surfaces = [s for s in self.surfaces if counts(s.body)]
        self.boxes = [b for b in self.boxes if counts(b.body)]

    def scaled(self, body: int, scale: float) -> "ContactShapes":
        """With the shapes of one body so many times as large, about its origin."""
        other = copy(self)
        other.points = [
            replace(
                p, p_B=scale * p.p_B, radius=scale * p.radius, rim=scale * p.rim,
                along=None if p.along is None else scale * p.along,
            ) if p.body == body else p
            for p in self.points
        ]  # fmt: skip
        other.surfaces = [
            s.scaled(scale) if s.body == body else s for s in self.surfaces
        ]
        other.boxes = [
            replace(
                b, centre=scale * b.centre, radius=scale * b.radius,
                edges=[
                    replace(e, start=scale * e.start, along=scale * e.along)
                    for e in b.edges
                ],
            ) if b.body == body else b
            for b in self.boxes
        ]  # fmt: skip
        return other

    def never_touch(self, point: _Point, surface: _Surface) -> bool:
        """Whether the scene filters their contact."""
        return self._apart[point.geometry, surface.geometry]

    def bodies(self) -> list[int]:
        return sorted({p.body for p in self.points} | {s.body for s in self.surfaces})

    def close(
        self,
        poses: Mapping[int, tuple[np.ndarray, np.ndarray]],
        near: float,
        counts: Callable[[int, int], bool],
    ) -> tuple[set[frozenset[int]], np.ndarray]:
        """Pairs of bodies that count and may come nearer than `near` [m], as balls
        about their shapes say, and at which poses (n,) one of them may."""
        balls = {
            k: (p + R @ centre, radius)
            for k, (centre, radius) in self._balls().items() for R, p in (poses[k],)
        }  # fmt: skip
        pairs, rows = set(), np.zeros(len(next(iter(poses.values()))[1]), bool)
        for a, b in combinations(balls, 2):
            if counts(a, b) or counts(b, a):
                (p_a, r_a), (p_b, r_b) = balls[a], balls[b]
                here = np.linalg.norm(p_a - p_b, axis=1) < near + r_a + r_b
                if here.any():
                    pairs.add(frozenset((a, b)))
                    rows |= here
        return pairs, rows

    def _balls(self) -> dict[int, tuple[np.ndarray, float]]:
        """{body: middle (3,) in its frame and radius [m] of a ball about its shapes};
        infinite where a surface is open."""
        parts: dict[int, list[tuple[np.ndarray, float]]] = {}
        for p in self.points:
            half = 0.0 if p.along is None else float(np.linalg.norm(p.along))
            parts.setdefault(p.body, []).append((p.p_B, p.radius + p.rim + half))
        for s in self.surfaces:
            parts.setdefault(s.body, []).append((s.p_BG, s.reach()))
        found = {}
        for body, each in parts.items():
            middle = np.mean([p for p, _ in each], axis=0)
            far = [float(np.linalg.norm(p - middle)) + r for p, r in each]
            found[body] = middle, max(far)
        return found

    def slots(
        self,
        poses: Mapping[int, tuple[np.ndarray, np.ndarray]],
        near: float,
        counts: Callable[[int, int], bool] = lambda a, b: True,
    ) -> list[Slot]:
        """Those that come nearer than `near` [m] at any pose.

        Args:
            poses: {body: R (n, 3, 3), p (n, 3)} of all bodies that have shapes.
            counts: whether points of body a against surfaces of body b are asked for.
        """
        found = []
        facing: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        of_points = {p.geometry for p in self.points}
        of_surfaces = {s.geometry for s in self.surfaces}
        middles = [p + R @ s.p_BG for s in self.surfaces for R, p in (poses[s.body],)]
        for i, point in enumerate(self.points):
            go_on()
            R_a, p_a = poses[point.body]
            place = p_a + R_a @ point.p_B
            each: list[tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
            for j, s in enumerate(self.surfaces):
                fixed = point.body in self.anchored and s.body in self.anchored
                if s.body == point.body or fixed or not counts(point.body, s.body):
                    continue
                if self._apart[point.geometry, s.geometry]:
                    continue
                # A sphere as a surface says no more than its centre as a point.
                # (Where the point's own shape is a surface for that centre, too.)
                if s.kind == "sphere" and not point.is_sphere:
                    if s.geometry in of_points and point.geometry in of_surfaces:
                        continue
                if s.kind == "sphere" and point.is_sphere and j < i:
                    if s.body > point.body:
                        continue  # Two spheres are one pair.
                at, to = poses[point.body], poses[s.body]
                if point.stays_away(s, place, middles[j], *to, near):
                    continue
                c, phi, n, may = point.near(s, *at, *to)
                if s.kind == "box" and point.is_edge and phi.min() < near:
                    key = (point.geometry, s.geometry)
                    if key not in facing:
                        facing[key] = self._facing(point, s, poses)
                    face = facing[key]
                    if point.axis is None:
                        phi, n = _by_face(s, c, c, phi, n, *to, *face[:2])
                    else:
                        phi, n, may = _of_cylinder(point, s, c, phi, n, at, to, face)
                if phi.min() < near:
                    each.append((j, phi, n, c, may))
            for k, (j, phi, n, c, may) in enumerate(each):
                best = may.copy()
                for m, (_, other, n_other, _, _) in enumerate(each):
                    if (
                        m == k
                        or self.surfaces[each[m][0]].body != self.surfaces[j].body
                    ):
                        continue
                    alike = np.sum(n * n_other, axis=1) > SAME_NORMAL
                    nearer = (other < phi) | ((other == phi) & (m < k))
                    best &= ~(alike & nearer)
                s = self.surfaces[j]
                found.append(
                    Slot(
                        point.body, s.body, (i, j), phi, n,
                        c - point.radius * n, best, _pair(point.friction, s.friction),
                        _in_row(point.stiffness, s.stiffness),
                        _gives(point.stiffness, s.stiffness),
                    )
                )  # fmt: skip
        return found + self._crossings(poses, near, counts)

    def _facing(self, corner: _Point, s: _Surface, poses):
        """Of the box that a corner is of, or the cylinder of a point on a rim, axis
        (n,) and side (n,) of the face of box s that it is farthest outside of with all
        its corners: the one that it meets; and how far (n,) [m]. The nearest feature to
        one corner may be an edge, and its normal any, where two shapes of one height
        stand side by side."""
        mine = [p for p in self.points if p.geometry == corner.geometry and not p.rim]
        (R_a, p_a), (R_b, p_b) = poses[corner.body], poses[s.body]
        local = np.stack([s.local(p_a + R_a @ p.p_B, R_b, p_b) for p in mine])
        (half,) = s.size
        apart = np.stack([local.min(axis=0), -local.max(axis=0)], axis=2)
        apart -= np.asarray(half)[:, None]
        apart = apart.reshape(len(p_a), 6)
        best = apart.argmax(axis=1)
        return best // 2, np.where(best % 2, -1.0, 1.0), apart.max(axis=1)

    def _crossings(self, poses, near: float, counts) -> list[Slot]:
        """Of edges of a free box and those of another body's."""
        found = []
        for i, one in enumerate(self.boxes):
            for j, other in enumerate(self.boxes):
                twice = other.is_free and other.body <= one.body
                if not one.is_free or other.body == one.body or twice:
                    continue
                if self._apart[one.geometry, other.geometry]:
                    continue
                if not counts(one.body, other.body):
                    continue
                at, to = poses[one.body], poses[other.body]
                centre = at[1] + at[0] @ one.centre
                for m, edge in enumerate(other.edges):
                    start = to[1] + to[0] @ edge.start
                    along, w = to[0] @ edge.along, centre - start
                    t = np.sum(w * along, axis=1) / np.sum(along**2, axis=1)
                    off = w - np.clip(t, 0.0, 1.0)[:, None] * along
                    if np.linalg.norm(off, axis=1).min() > one.radius + near:
                        continue
                    for k, mine in enumerate(one.edges):
                        c, phi, n, may = crossing(
                            mine, at[0], at[1], edge, to[0], to[1]
                        )
                        if phi.min() < near:
                            key = (-1 - 12 * i - k, -1 - 12 * j - m)
                            friction = _pair(one.friction, other.friction)
                            stiffness = _in_row(one.stiffness, other.stiffness)
                            found.append(
                                Slot(one.body, other.body, key, phi, n, c, may,
                                     friction, stiffness)
                            )  # fmt: skip
        return found


def _of_cylinder(point: _Point, s: _Surface, places, phi, normal, at, to, facing):
    """Distances (n,) and normals (n, 3) of places (n, 3) of a point of a cylinder from
    the face of box s that it meets, and whether it may touch so (n,). A round side is
    over what its middle is over: else it meets the box's edge. Where no face is between
    the two, an edge is met, too."""
    (R_a, p_a), (R_b, p_b), (axis, side, apart) = at, to, facing
    face = side[:, None] * np.einsum("nij,nj->ni", R_b, s.R_BG.T[axis])
    over = places
    if point.rim:
        middle = p_a + R_a @ point.p_B
        over = np.where(point.stands(face, R_a)[:, None], places, middle)
    d, n = _by_face(s, places, over, phi, normal, R_b, p_b, axis, side)
    between = apart > -OVERLAP
    d, n = np.where(between, d, phi), np.where(between[:, None], n, normal)
    stands = point.stands(n, R_a)
    return d, n, ~stands if point.rim else stands


def _by_face(s: _Surface, places, over, phi, normal, R_b, p_b, axis, side):
    """Distances (n,) and normals (n, 3) of places (n, 3), from the face that is met
    where what is `over` it (n, 3) is."""
    rows, local = np.arange(len(phi)), s.local(places, R_b, p_b)
    out = np.abs(s.local(over, R_b, p_b)) - np.asarray(s.size[0])
    d = side * local[rows, axis] - np.asarray(s.size[0])[axis]
    out[rows, axis] = -np.inf
    over = out.max(axis=1) < BEYOND
    face = side[:, None] * np.einsum("nij,nj->ni", R_b, s.R_BG.T[axis])
    return np.where(over, d, phi), np.where(over[:, None], face, normal)


def _pair(a: float, b: float) -> float:
    """As Drake combines two surfaces' friction."""
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _in_row(a: float, b: float) -> float:
    finite = [k for k in (a, b) if np.isfinite(k)]
    return 1.0 / sum(1.0 / k for k in finite) if finite else 1e6


def _gives(a: float, b: float) -> float:
    """Of the depth of two stiffnesses [N/m], the share of the first."""
    if np.isinf(b):
        return 0.5 if np.isinf(a) else 1.0
    return 0.0 if np.isinf(a) else b / (a + b)


def poses_of(plant: MultibodyPlant, q: np.ndarray, shapes: ContactShapes):
    """{body: R (n, 3, 3), p (n, 3)} of bodies with shapes, at positions (n, n_q)."""
    context, found = plant.CreateDefaultContext(), {}
    for k in shapes.bodies():
        found[k] = np.empty((len(q), 3, 3)), np.empty((len(q), 3))
    for n, row in enumerate(q):
        plant.SetPositions(context, row)
        for k, (R, p) in found.items():
            if n and k in shapes.anchored:
                R[n], p[n] = R[0], p[0]
                continue
            X = plant.EvalBodyPoseInWorld(context, plant.get_body(BodyIndex(k)))
            R[n], p[n] = X.rotation().matrix(), X.translation()
    return found
