"""Whether a mesh is hollow where something was seen in it, before any computing.

Point contact takes a mesh's convex hull: a ball in a bowl is then deep inside of it,
and what is simulated has nothing to do with what was recorded.
"""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Mesh, ReadObjToTriangleSurfaceMesh
from pydrake.multibody.tree import BodyIndex
from scipy.spatial import ConvexHull

from makebreak.gap.data.recording import Recording
from makebreak.models.effects.kind import full_name
from makebreak.models.scene import LoadedScene

HOLLOW = 0.8  # A mesh that fills less of its hull is hollow.
INSIDE = 0.02  # A body's origin so deep, over the mesh's size, is in the hollow.
SAMPLES = 50


def check_meshes(loaded: LoadedScene, recordings: Sequence[Recording]) -> None:
    """Refuses scenes with point contact in which a free body was mostly seen inside
    the convex hull of a fixed mesh that fills little of it, deeper than the body
    reaches from its own origin: what stands on a table has its origin anywhere.

    Raises: ValueError, with what the mesh could be made of.
    """
    if loaded.scene.plant.contact_model != "point":
        return
    plant, inspector = loaded.plant, loaded.scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    seen, reach = {}, {}
    for i in plant.GetFloatingBaseBodies():
        name = full_name(plant, plant.get_body(i))
        seen[name] = np.vstack([_places(name, r) for r in recordings])
        reach[name] = _reach(plant, inspector, plant.get_body(i))
    for k in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(k))
        if not plant.IsAnchored(body):
            continue
        for g in plant.GetCollisionGeometriesForBody(body):
            shape = inspector.GetShape(g)
            if not isinstance(shape, Mesh):
                continue
            hull = shape.GetConvexHull()
            N = np.array([hull.face_normal(i) for i in range(hull.num_faces())])
            corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
            d = (corners @ N.T).max(axis=0)
            size = float(np.ptp(corners, axis=0).max())
            if not _volume(shape) < HOLLOW * ConvexHull(corners).volume:
                continue
            X = plant.EvalBodyPoseInWorld(context, body) @ inspector.GetPoseInFrame(g)
            for name, p in seen.items():
                depth = (d - X.inverse().multiply(p.T).T @ N.T).min(axis=1)
                deep = depth > max(INSIDE * size, reach[name])
                if len(p) and np.mean(deep) > 0.5:
                    raise ValueError(
                        f"{name} was seen {np.median(depth):.3g} m inside the convex "
                        f"hull of {full_name(plant, body)}'s mesh, which is hollow "
                        "there: point contact takes the hull. Use hydroelastic "
                        "contact, or make it of boxes, a collision each"
                    )


def _reach(plant, inspector, body) -> float:
    """How far a body's collision geometry reaches from its origin, along axes [m]."""
    farthest = 0.0
    for g in plant.GetCollisionGeometriesForBody(body):
        box = inspector.GetObbInGeometryFrame(g)
        if box is None:
            continue
        signs = np.array(np.meshgrid(*3 * [[-1.0, 1.0]])).reshape(3, -1)
        X = inspector.GetPoseInFrame(g) @ box.pose()
        corners = X.multiply(signs * np.reshape(box.half_width(), (3, 1)))
        farthest = max(farthest, float(abs(corners).max()))
    return farthest


def _places(name: str, recording: Recording) -> np.ndarray:
    """(n, 3) some of the places where a body was seen."""
    if not all(f"{name}.{a}" in recording for a in "xyz"):
        return np.zeros((0, 3))
    p = np.stack([recording[f"{name}.{a}"] for a in "xyz"], axis=1)
    p = p[np.isfinite(p).all(axis=1)]
    return p[:: max(len(p) // SAMPLES, 1)]


def _volume(shape: Mesh) -> float:
    """[m3] that its surface encloses, by Gauss; infinite of a file that is no OBJ."""
    if not shape.source().is_path() or shape.extension() != ".obj":
        return np.inf
    try:
        mesh = ReadObjToTriangleSurfaceMesh(str(shape.source().path()))
    except RuntimeError:
        return np.inf
    vertices = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    vertices = (vertices - vertices.mean(axis=0)) * np.ravel(shape.scale3())
    faces = [mesh.element(i) for i in range(mesh.num_triangles())]
    corners = vertices[[[f.vertex(k) for k in range(3)] for f in faces]]
    each = np.cross(corners[:, 0], corners[:, 1])
    return abs(float(np.sum(each * corners[:, 2]))) / 6.0
