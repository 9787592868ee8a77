"""Replaces shapes of a body that is already in the scene graph."""

from collections.abc import Iterable

from pydrake.geometry import (
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    HalfSpace,
    Role,
    SceneGraph,
    Shape,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

# FCL makes its tree anew where it is ten levels deeper than it need be.
FEWEST_IN_DEEP_TREE = 15
REACH, DEPTH = 40.0, 4.0  # Of a box in the place of a half space [m].


def change_shape(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    geometry: GeometryId,
    shape: Shape,
    X_BG: RigidTransform,
) -> None:
    """Changes a geometry's shape and pose in its body, and keeps its collision filters,
    which Drake's ChangeShape would remove."""
    apart = not_colliding_with(scene_graph, geometry)
    scene_graph.ChangeShape(plant.get_source_id(), geometry, shape, X_BG)
    keep_apart(scene_graph, [geometry], apart)


def bound_half_spaces(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Half spaces of bodies that are welded to the world become large boxes where there
    are many shapes. Drake keeps them among what moves, in a tree of bounding boxes;
    theirs have no middle, and making the tree anew then may end the process.

    Source: github.com/RobotLocomotion/drake/issues/19263.
    """
    inspector = scene_graph.model_inspector()
    world = inspector.world_frame_id()
    every = [
        g for g in inspector.GetAllGeometryIds(Role.kProximity)
        if inspector.GetFrameId(g) != world
    ]  # fmt: skip
    for g in every if len(every) >= FEWEST_IN_DEEP_TREE else ():
        if isinstance(inspector.GetShape(g), HalfSpace):
            X = inspector.GetPoseInFrame(g) @ RigidTransform([0.0, 0.0, -0.5 * DEPTH])
            change_shape(plant, scene_graph, g, Box(REACH, REACH, DEPTH), X)


def not_colliding_with(
    scene_graph: SceneGraph, geometry: GeometryId
) -> list[GeometryId]:
    """The geometries with which a geometry cannot collide by a filter; [] if it has no
    collision role."""
    inspector = scene_graph.model_inspector()
    if inspector.GetProximityProperties(geometry) is None:
        return []
    return [
        other
        for other in inspector.GetAllGeometryIds(Role.kProximity)
        if other != geometry and inspector.CollisionFiltered(geometry, other)
    ]


def keep_apart(
    scene_graph: SceneGraph, these: Iterable[GeometryId], others: Iterable[GeometryId]
) -> None:
    """Adds a filter so that none of `these` collides with any of `others`."""
    scene_graph.collision_filter_manager().Apply(
        CollisionFilterDeclaration().ExcludeBetween(
            GeometrySet(list(these)), GeometrySet(list(others))
        )
    )
