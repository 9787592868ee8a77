"""Where shapes of a scene may touch, at many poses at once: points against surfaces.

Spheres are their centres, boxes and hulls their corners. A cylinder that stands on
something is points on its rims; where its side touches, of each rim the point that is
nearest to the other surface. Each is compared with the surfaces of other bodies. Edges
that cross edges are left out. Friction and stiffness of a pair are those that Drake
makes of two surfaces.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from pydrake.geometry import Box, Convex, Cylinder, HalfSpace, Mesh, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from makebreak.gap.numerics import surface_distance
from makebreak.models.effects.kind import full_name
from makebreak.models.scene import LoadedScene

RIM = 12  # Points on a rim.
SIDE = 0.9  # Cosine of normal and axis: less, and a cylinder touches with its side.
MOST_CORNERS = 200  # Of a hull; more are thinned.
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
    axis: np.ndarray | None = None  # Of the cylinder that it is on the rim of.
    rim: float = 0.0  # Any point on a rim of this radius about p_B, if not 0 [m].

    def near(
        self, s: "_Surface", R_a, p_a, R_b, p_b
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The point's place (n, 3) in world at poses of the two bodies, its distance
        (n,) from the surface, the normal (n, 3), and whether it may touch so (n,)."""
        c = p_a + R_a @ self.p_B
        d, n = s.distance(np.einsum("nji,nj->ni", R_b, c - p_b))
        n = np.einsum("nij,nj->ni", R_b, n)
        if self.axis is None:
            return c, d - self.radius, n, np.ones(len(c), bool)
        axis = R_a @ self.axis
        along = np.sum(n * axis, axis=1)
        side = abs(along) < SIDE
        if not self.rim:
            return c, d - self.radius, n, ~side
        # Towards the surface from the middle, which is outside: exact for planes, and
        # for upright shapes.
        out = n - along[:, None] * axis
        size = np.maximum(np.linalg.norm(out, axis=1), 1e-9)
        c = c - self.rim * out / size[:, None]
        d, _ = s.distance(np.einsum("nji,nj->ni", R_b, c - p_b))
        return c, d - self.radius, n, side


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

    def distance(self, p) -> tuple[np.ndarray, np.ndarray]:
        """Of points (n, 3) in the body's frame, and normals there."""
        local = (p - self.p_BG) @ self.R_BG
        d, n = getattr(surface_distance, self.kind)(local, *self.size)
        return d, n @ self.R_BG.T


@dataclass(frozen=True, eq=False)
class Slot:
    """One point and one surface at n poses. a, b: bodies of the point and the surface.

    phi (n,) distance [m]; normal (n, 3) from b to a; place (n, 3), both in world;
    best (n,): no other surface that faces alike is nearer to the point.
    friction, stiffness [N/m] of the two together.
    """

    a: int
    b: int
    key: tuple[int, int]  # Number of the point and of the surface.
    phi: np.ndarray
    normal: np.ndarray
    place: np.ndarray
    best: np.ndarray
    friction: float
    stiffness: float


class ContactShapes:
    """The points and surfaces of a loaded scene.

    Args: hulls: whether meshes count, as their convex hulls.
    Raises: ValueError for friction zones, or a free body with another shape.
    """

    def __init__(self, loaded: LoadedScene, hulls: bool = True):
        self._hulls = hulls
        plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
        if loaded.scene.friction_zones:
            raise ValueError("friction zones are Drake's alone")
        self.points: list[_Point] = []
        self.surfaces: list[_Surface] = []
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
                if not self._add(k, g, shape, R, p, own):
                    if body.is_floating_base_body():
                        raise ValueError(
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

        def points(local, radius=0.0, is_sphere=False, axis=None, rim=0.0):
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
                        axis,
                        rim,
                    )
                )

        def surface(kind, *size):
            self.surfaces.append(_Surface(k, g, kind, R, p, size, friction, stiffness))

        if isinstance(shape, Sphere):
            points(np.zeros(3), shape.radius(), True)
            surface("sphere", shape.radius())
        elif isinstance(shape, Box):
            half = shape.size() / 2.0
            points(np.array(list(product((-1, 1), repeat=3))) * half)
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
        elif isinstance(shape, (Convex, Mesh)) and self._hulls:
            mesh = shape.GetConvexHull()
            corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
            N = np.array([mesh.face_normal(i) for i in range(mesh.num_faces())])
            d = (corners @ N.T).max(axis=0)
            step = max(len(corners) // MOST_CORNERS, 1)
            points(corners[::step])
            surface("hull", N, d)
        else:
            return False
        return True

    def keep(self, counts: Callable[[int], bool]) -> None:
        """Only the shapes of bodies for which counts(body)."""
        self.points = [p for p in self.points if counts(p.body)]
        self.surfaces = [s for s in self.surfaces if counts(s.body)]

    def never_touch(self, point: _Point, surface: _Surface) -> bool:
        """Whether the scene filters their contact."""
        return self._apart[point.geometry, surface.geometry]

    def bodies(self) -> list[int]:
        return sorted({p.body for p in self.points} | {s.body for s in self.surfaces})

    def slots(
        self, poses: Mapping[int, tuple[np.ndarray, np.ndarray]], near: float
    ) -> list[Slot]:
        """Those that come nearer than `near` [m] at any pose.

        Args: poses: {body: R (n, 3, 3), p (n, 3)} of all bodies that have shapes.
        """
        found = []
        for i, point in enumerate(self.points):
            each: list[tuple[int, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
            for j, s in enumerate(self.surfaces):
                fixed = point.body in self.anchored and s.body in self.anchored
                if s.body == point.body or fixed:
                    continue
                if self._apart[point.geometry, s.geometry]:
                    continue
                # A sphere as a surface says no more than its centre as a point.
                if s.kind == "sphere" and not point.is_sphere:
                    if any(q.geometry == s.geometry for q in self.points):
                        if self._is_seen_by(s, point):
                            continue
                if s.kind == "sphere" and point.is_sphere and j < i:
                    if s.body > point.body:
                        continue  # Two spheres are one pair.
                c, phi, n, may = point.near(s, *poses[point.body], *poses[s.body])
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
                    )
                )  # fmt: skip
        return found

    def _is_seen_by(self, sphere: _Surface, corner: _Point) -> bool:
        """Whether the corner's shape is a surface that the sphere is compared with."""
        return any(s.geometry == corner.geometry for s in self.surfaces)


def _pair(a: float, b: float) -> float:
    """As Drake combines two surfaces' friction."""
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _in_row(a: float, b: float) -> float:
    finite = [k for k in (a, b) if np.isfinite(k)]
    return 1.0 / sum(1.0 / k for k in finite) if finite else 1e6


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
