"""Spheres that stand in for the faces on which free bodies lie, and tools press.

Drake's point contact gives two shapes one point, however large the area is in which
they meet. Of a box on a table that point jumps from corner to corner: the box rocks,
and slides and turns otherwise than one that stands on its face. The equations of
motion of gap/residuals/contact_dynamics.py let such a body stand on all corners of its
face. So that simulated windows mean the same, small spheres at these corners carry it,
and its own shapes no longer touch what it lies on. Nothing else touches the spheres.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Box,
    CollisionFilterDeclaration,
    Convex,
    Cylinder,
    GeometrySet,
    Mesh,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

RADIUS = 2e-3  # Of a sphere [m], or this share of a small shape's least half size.
SHARE = 0.2
POINT = 1e-5  # Of a sphere at a corner that lands, or presses, by itself [m].
RIM = 12  # Spheres along a cylinder's rim.
MOST = 48  # Spheres of a hull; of more corners, every n-th has one.
# Points within a face, beside those at its corners: at this share of the corners'
# distance from the middle. With a share of the load of 0.84 (0.67 of a disc) on them
# the face turns as one that presses evenly (mean distance and mean square; a square's).
WITHIN_BOX, WITHIN_RIM, WITHIN_HULL, INNER = 0.45, 0.5, 0.47, 6
ALIKE = 1e-6  # Normals of one face differ by no more than this.


@dataclass(frozen=True)
class LiesOn:
    """A free body that lies on something fixed with a face, or with the side of a
    cylinder; both are body indices. is_tool: whether it is a robot's instead, which
    presses with edges too: its corners are where they are, not rounded."""

    body: int
    ground: int
    on_side: bool = False
    is_tool: bool = False


def add_supports(
    lying: Iterable[LiesOn], plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Adds the spheres to a plant that is not yet finalized. They have the surface of
    the shape whose corners they stand in for."""
    inspector = scene_graph.model_inspector()
    bodies = [plant.get_body(BodyIndex(k)) for k in range(plant.num_bodies())]
    for one in lying:
        body, faces, planned = bodies[one.body], [], []
        for i, g in enumerate(plant.GetCollisionGeometriesForBody(body)):
            properties = inspector.GetProximityProperties(g)
            largest = POINT if one.is_tool else RADIUS
            found = centres_of(inspector.GetShape(g), one.on_side, largest)
            if properties is None or found is None:
                continue
            faces.append(i)
            X, (centres, radius) = inspector.GetPoseInFrame(g), found
            planned += [
                (
                    RigidTransform(X @ p),
                    radius,
                    f"support_{one.ground}_{i}_{k}",
                    properties,
                )
                for k, p in enumerate(centres)
            ]
        added = [
            plant.RegisterCollisionGeometry(body, X, Sphere(radius), name, properties)
            for X, radius, name, properties in planned
        ]
        # Asked for again: registering has moved the plant's own lists of them.
        own = plant.GetCollisionGeometriesForBody(body)
        ground = plant.GetCollisionGeometriesForBody(bodies[one.ground])
        others = [
            g
            for k, other in enumerate(bodies)
            if k not in (one.body, one.ground)
            for g in plant.GetCollisionGeometriesForBody(other)
        ]
        declare = CollisionFilterDeclaration()
        declare.ExcludeBetween(
            GeometrySet([own[i] for i in faces]), GeometrySet(ground)
        )
        if others:
            declare.ExcludeBetween(GeometrySet(added), GeometrySet(others))
        scene_graph.collision_filter_manager().Apply(declare)


def centres_of(
    shape, on_side: bool = False, largest: float = RADIUS
) -> tuple[np.ndarray, float] | None:
    """(n, 3) centres of spheres in the shape's frame, and their radius [m]: each
    touches the faces that meet in its corner from within. None for a shape that meets a
    plane in one point anyway.

    Args: on_side: whether a cylinder lies on its side; then two spheres of its own
        radius touch where the ends of that line do. largest: radius of a sphere at a
        corner, at most [m].
    """
    if isinstance(shape, Box):
        half = shape.size() / 2.0
        radius = min(largest, SHARE * float(half.min()))
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        return signs * (half - radius), radius
    if isinstance(shape, Cylinder):
        r, h = shape.radius(), 0.5 * shape.length()
        if on_side:
            return np.array([[0.0, 0.0, -h], [0.0, 0.0, h]]), r
        radius = min(largest, SHARE * min(r, h))
        angle = np.arange(RIM) * 2.0 * np.pi / RIM
        x, y = (r - radius) * np.cos(angle), (r - radius) * np.sin(angle)
        return np.vstack(
            [np.column_stack([x, y, np.full(RIM, z)]) for z in (radius - h, h - radius)]
        ), radius
    if isinstance(shape, (Convex, Mesh)):
        mesh = shape.GetConvexHull()
        corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
        normals = np.array([mesh.face_normal(i) for i in range(mesh.num_faces())])
        offsets = (corners @ normals.T).max(axis=0)
        size = float(np.ptp(corners, axis=0).min()) / 2.0
        radius = min(largest, SHARE * size)
        step = -(-len(corners) // MOST)
        return np.array(
            [_within(p, normals, offsets, radius) for p in corners[::step]]
        ), radius
    return None


def within_faces(shape, largest: float = RADIUS) -> np.ndarray:
    """(n, 4) spheres within the faces of a box or of a cylinder's ends: centre in the
    shape's frame and radius [m], as centres_of() has them at the corners; of a hull,
    within its largest faces, as many as MOST at all; none for others."""
    found = centres_of(shape, largest=largest)
    if found is None:
        return np.zeros((0, 4))
    corners, radius = found
    places = []
    if isinstance(shape, Box):
        for axis in range(3):
            inner = np.array(corners)
            inner[:, np.arange(3) != axis] *= WITHIN_BOX
            places.append(inner)
    elif isinstance(shape, Cylinder):
        inner = np.array(corners[:: RIM // INNER])
        inner[:, :2] *= WITHIN_RIM
        places.append(inner)
    elif isinstance(shape, (Convex, Mesh)):
        places = _within_hull(shape.GetConvexHull(), radius)
    if not places:
        return np.zeros((0, 4))
    inner = np.concatenate(places)
    return np.column_stack([inner, np.full(len(inner), radius)])


def _within_hull(hull, radius: float) -> list[np.ndarray]:
    """Points within the largest faces, one for each corner of them."""
    found = []
    for i in range(hull.num_faces()):
        face = hull.element(i)
        corners = np.array([
            hull.vertex(face.vertex(k)) for k in range(face.num_vertices())
        ])  # fmt: skip
        normal = np.array(hull.face_normal(i))
        following = np.roll(corners, -1, axis=0)
        area = 0.5 * float(normal @ np.cross(corners, following).sum(axis=0))
        middle = corners.mean(axis=0)
        inner = middle + WITHIN_HULL * (corners - middle) - radius * normal
        found.append((area, inner))
    found.sort(key=lambda each: -each[0])
    places: list[np.ndarray] = []
    for _, inner in found:
        if sum(len(each) for each in places) + len(inner) > MOST:
            break
        places.append(inner)
    return places


def _within(corner, normals, offsets, radius: float) -> np.ndarray:
    """(3,) the point nearest to being `radius` within all faces of a corner."""
    mine = offsets - normals @ corner < ALIKE
    N = np.unique(np.round(normals[mine], 6), axis=0)
    return corner - radius * np.linalg.pinv(N) @ np.ones(len(N))
