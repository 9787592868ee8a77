"""Distances to shapes, against Drake's and against points drawn on the surface."""

import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Cylinder,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.geometry import HalfSpace as DrakeHalfSpace
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull

from makebreak.gap.numerics import surface_distance as own

SHAPES = {
    "box": (Box(0.2, 0.3, 0.1), lambda p: own.box(p, [0.1, 0.15, 0.05])),
    "sphere": (Sphere(0.12), lambda p: own.sphere(p, 0.12)),
    "cylinder": (Cylinder(0.1, 0.3), lambda p: own.cylinder(p, 0.1, 0.15)),
    "half space": (DrakeHalfSpace(), own.half_space),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distance_and_normal_are_drakes(name):
    shape, ours = SHAPES[name]
    builder = DiagramBuilder()
    graph = builder.AddSystem(SceneGraph())
    source = graph.RegisterSource("s")
    graph.RegisterFrame(source, GeometryFrame("f"))
    anchored = GeometryInstance(RigidTransform(), shape, "shape")
    anchored.set_proximity_properties(ProximityProperties())
    graph.RegisterAnchoredGeometry(source, anchored)
    builder.ExportOutput(graph.get_query_output_port(), "query")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    graph.get_source_pose_port(source).FixValue(
        graph.GetMyContextFromRoot(context), _poses(graph, source)
    )
    query = diagram.GetOutputPort("query").Eval(context)
    p = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    distance, normal = ours(p)
    for k, point in enumerate(p):
        (found,) = query.ComputeSignedDistanceToPoint(point)
        assert distance[k] == pytest.approx(found.distance, abs=1e-12)
        np.testing.assert_allclose(normal[k], found.grad_W, atol=1e-9)


def _poses(graph, source):
    from pydrake.common.value import AbstractValue
    from pydrake.geometry import FramePoseVector

    poses = FramePoseVector()
    for frame in graph.model_inspector().FramesForSource(source):
        if frame != graph.world_frame_id():
            poses.set_value(frame, RigidTransform())
    return AbstractValue.Make(poses)


def test_a_hull_of_a_box_is_the_box():
    """Over faces, beside edges and corners, and within."""
    half = np.array([0.1, 0.15, 0.05])
    N, d = np.vstack([np.eye(3), -np.eye(3)]), np.tile(half, 2)
    p = np.random.default_rng(1).uniform(-2.0, 2.0, (900, 3)) * half
    beyond = np.sum(np.abs(p) > half, axis=1)
    assert set(beyond) == {0, 1, 2, 3}
    a, n = own.hull(p, N, d)
    b, m = own.box(p, half)
    np.testing.assert_allclose(a, b, atol=1e-12)
    np.testing.assert_allclose(n, m, atol=1e-12)


def test_a_slanted_hull_is_as_far_as_the_nearest_of_many_of_its_points():
    rng = np.random.default_rng(2)
    hull = ConvexHull(rng.normal(size=(20, 3)))
    triangles = hull.points[hull.simplices]
    N, d = hull.equations[:, :3], -hull.equations[:, 3]
    p = rng.uniform(-4.0, 4.0, (60, 3))
    p = p[(p @ N.T - d).max(axis=1) > 0.0]
    weights = rng.dirichlet(np.full(3, 0.5), 4000)
    drawn = np.einsum("kv,tvc->tkc", weights, triangles).reshape(-1, 3)
    least = np.linalg.norm(p[:, None] - drawn, axis=2).min(axis=1)
    distance, normal = own.hull(p, N, d)
    assert len(p) > 40 and np.all(distance <= least + 1e-12)
    np.testing.assert_allclose(distance, least, atol=0.02)
    # The foot of the normal is on the hull.
    foot = p - distance[:, None] * normal
    np.testing.assert_allclose((foot @ N.T - d).max(axis=1), 0.0, atol=1e-12)
