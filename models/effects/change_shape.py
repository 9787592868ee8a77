"""Replaces shapes of a body that is already in the scene graph."""

from collections.abc import Iterable

from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    Role,
    SceneGraph,
    Shape,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant


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
