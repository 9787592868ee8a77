"""Contact properties of the collision shapes of a pair, before Finalize."""

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    ProximityProperties,
    RoleAssign,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Joint, RigidBody

from makebreak.models.effects.kind import Effect, find_pair, full_name

# A body stands on the shapes whose lowest point is within this of the lowest of all
# [m].
STANDS_WITHIN = 1e-3

# MultibodyPlant's Hunt-Crossley dissipation for a shape that sets none [s/m].
DEFAULT_DISSIPATION = 50.0


def coulomb(mu: float) -> CoulombFriction:
    """Equal static and dynamic friction."""
    return CoulombFriction(mu, mu)


def changed_and_other(effect: Effect, plant) -> tuple[RigidBody, RigidBody]:
    """The pair, first the body whose surface an effect changes: the one that is not
    free to move, or, if both or neither are free, the first one named."""
    changed, other = find_pair(effect, plant)
    if _is_free(plant, changed) and not _is_free(plant, other):
        changed, other = other, changed
    return changed, other


def touchable_shapes(plant, scene_graph, body):
    """Yields (GeometryId, ProximityProperties) of a body's collision shapes."""
    inspector = scene_graph.model_inspector()
    for geometry in plant.GetCollisionGeometriesForBody(body):
        properties = inspector.GetProximityProperties(geometry)
        if properties is not None:
            yield geometry, properties


def set_surface(plant, scene_graph, body, name: str, value, only=None) -> None:
    """Sets a material property of a body's collision shapes; `only`: of these ids."""
    for geometry, old in list(touchable_shapes(plant, scene_graph, body)):
        if only is not None and geometry not in only:
            continue
        properties = ProximityProperties(old)
        properties.UpdateProperty("material", name, value)
        scene_graph.AssignRole(
            plant.get_source_id(), geometry, properties, RoleAssign.kReplace
        )


def single_value(effect, plant, scene_graph, body, read, what: str) -> float:
    """The value of `read` that all collision shapes of a body share.

    Raises: ValueError if they differ; `what` names the property in the message.
    """
    values = {
        read(properties) for _, properties in touchable_shapes(plant, scene_graph, body)
    }
    if len(values) != 1:
        raise ValueError(
            f"effect {effect.kind} at {effect.at[0]!r}: {body.scoped_name()} has "
            f"surfaces of different {what}, {sorted(values)}"
        )
    return values.pop()


def friction_of(properties: ProximityProperties) -> float:
    return properties.GetProperty("material", "coulomb_friction").dynamic_friction()


def friction_against(effect, plant, scene_graph, body, other) -> float:
    """The friction coefficient of a body where it touches the other.

    Raises: ValueError as shapes_that_meet.
    """
    meets = shapes_that_meet(effect, plant, scene_graph, body, other)
    return {g: friction_of(p) for g, p in touchable_shapes(plant, scene_graph, body)}[
        meets[0]
    ]


def shapes_that_meet(effect, plant, scene_graph, body, other) -> list:
    """Ids of the shapes of a body that touch the other body.

    All of them if their friction is the same. A free body whose shapes differ in
    friction touches anchored bodies with those on which it stands in its modelled
    pose (lowest along z), and moving bodies with the others.

    Raises: ValueError if the shapes found differ in friction.
    """
    frictions = {
        g: friction_of(p) for g, p in touchable_shapes(plant, scene_graph, body)
    }
    if len(set(frictions.values())) <= 1:
        return list(frictions)
    inspector = scene_graph.model_inspector()
    reach = {g: _lowest(inspector, g) for g in frictions}
    low = {g: z for g, z in reach.items() if z is not None}
    found = list(frictions)
    if _is_free(plant, body) and len(low) == len(frictions):
        least = min(low.values())
        stands = [g for g in frictions if low[g] < least + STANDS_WITHIN]
        fixed = not _is_free(plant, other) and not _moves(plant, other)
        found = stands if fixed else [g for g in frictions if g not in stands]
    if len({frictions[g] for g in found}) != 1:
        raise ValueError(
            f"effect {effect.kind} at {effect.at[0]!r}: {body.scoped_name()} has "
            f"surfaces of different friction, {sorted(set(frictions.values()))}"
        )
    return found


def _lowest(inspector, geometry) -> float | None:
    """Lowest z of a shape in its body's frame [m]; None for other kinds of shape."""
    shape, X = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
    z, down = X.translation()[2], abs(X.rotation().matrix()[2])
    if isinstance(shape, Sphere):
        return z - shape.radius()
    if isinstance(shape, Box):
        return z - down @ shape.size() / 2.0
    if isinstance(shape, (Cylinder, Capsule)):
        side = shape.radius()
        if isinstance(shape, Cylinder):
            side *= np.sqrt(max(1.0 - down[2] ** 2, 0.0))
        return z - down[2] * shape.length() / 2.0 - side
    return None


def _joints_above(plant: MultibodyPlant, body: RigidBody) -> list[Joint]:
    """The joints whose child is the body; empty for a floating body or the world."""
    joints = (plant.get_joint(i) for i in plant.GetJointIndices())
    return [j for j in joints if j.child_body().index() == body.index()]


def _moves(plant: MultibodyPlant, body: RigidBody) -> bool:
    """Whether any joint between the body and the world has a degree of freedom."""
    here = body
    while here.index() != plant.world_body().index():
        up = _joints_above(plant, here)
        if not up or up[0].num_velocities() > 0:
            return True
        here = up[0].parent_body()
    return False


def stiffness_of(properties: ProximityProperties) -> float:
    """Point contact stiffness [N/m]; inf where the shape sets none and Drake estimates
    it from the weights."""
    return properties.GetPropertyOrDefault(
        "material", "point_contact_stiffness", np.inf
    )


def dissipation_of(properties: ProximityProperties) -> float:
    """Hunt-Crossley dissipation [s/m]."""
    return properties.GetPropertyOrDefault(
        "material", "hunt_crossley_dissipation", DEFAULT_DISSIPATION
    )


def combined_friction(mu1: float, mu2: float) -> float:
    """The friction coefficient of a pair, as Drake combines that of two surfaces."""
    return 2.0 * mu1 * mu2 / (mu1 + mu2) if mu1 + mu2 > 0.0 else 0.0


def anchored_pose(
    effect: Effect, plant: MultibodyPlant, body: RigidBody
) -> RigidTransform:
    """World pose of a body that is welded to the world, before Finalize.

    Raises: ValueError if it can move.
    """
    X = RigidTransform()  # Pose of the body in the frame of `here`.
    here = body
    while here.index() != plant.world_body().index():
        up = _joints_above(plant, here)
        if not up or up[0].num_velocities() > 0:
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: expected "
                f"{full_name(plant, body)} to be welded to the world"
            )
        (weld,) = up
        X_PF = weld.frame_on_parent().GetFixedPoseInBodyFrame()
        X_CM = weld.frame_on_child().GetFixedPoseInBodyFrame()
        X = X_PF @ weld.X_FM() @ X_CM.inverse() @ X
        here = weld.parent_body()
    return X


def _is_free(plant: MultibodyPlant, body: RigidBody) -> bool:
    """Whether the body has no joint, apart from the floating one that Finalize adds."""
    return not any(
        body.index() in (joint.child_body().index(), joint.parent_body().index())
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if not joint.is_ephemeral()
    )
