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


def test_a_hull_of_a_boxs_planes_is_the_box_where_a_face_is_nearest():
    half = np.array([0.1, 0.15, 0.05])
    N, d = np.vstack([np.eye(3), -np.eye(3)]), np.tile(half, 2)
    p = np.random.default_rng(1).uniform(-1.0, 1.0, (300, 3)) * half
    p[:, 2] = np.abs(p[:, 2]) + 0.02  # Above, over the middle, or within.
    a, n = own.hull(p, N, d)
    b, m = own.box(p, half)
    np.testing.assert_allclose(a, b, atol=1e-12)
    np.testing.assert_allclose(n, m, atol=1e-12)
