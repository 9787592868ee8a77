"""Effects on the pose of fixed bodies: height, position, tilt."""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from makebreak.models.effects.change_shape import change_shape
from makebreak.models.effects.contact_surface import anchored_pose
from makebreak.models.effects.kind import Effect, EffectKind, Parameter, find_bodies
from makebreak.models.effects.loads import rotation


def _move(
    effect: Effect,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    body: RigidBody,
    moved,
) -> None:
    """Moves all shapes of an anchored body: moved(X_WG, p_WB) is the new X_WG."""
    X_WB = anchored_pose(effect, plant, body)
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    geometries = list(inspector.GetGeometries(frame))
    if not geometries:
        raise ValueError(
            f"effect {effect.kind} at {effect.at}: {body.scoped_name()} has no shapes"
        )
    for g in geometries:
        X_WG = moved(X_WB @ inspector.GetPoseInFrame(g), X_WB.translation())
        shape, X_BG = inspector.GetShape(g), X_WB.inverse() @ X_WG
        change_shape(plant, scene_graph, g, shape, X_BG)


def _lift(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    up = RigidTransform(np.array([0.0, 0.0, effect.parameters["height"]]))
    for body in find_bodies(effect, plant):
        _move(effect, plant, scene_graph, body, lambda X_WG, p_WB: up @ X_WG)


def _displace(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    by = RigidTransform(np.array([effect.parameters.get(a, 0.0) for a in "xyz"]))
    for body in find_bodies(effect, plant):
        _move(effect, plant, scene_graph, body, lambda X_WG, p_WB: by @ X_WG)


def _some_are_given(effect: Effect) -> None:
    if not effect.parameters:
        raise ValueError(f"effect {effect.kind} at {effect.at} needs `x`, `y` or `z`")


def _tilt(effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Rotates the body's shapes about its origin, in world axes."""
    R = rotation(effect)

    def moved(X_WG, p_WB):
        about = RigidTransform(p_WB)
        return about @ RigidTransform(R, np.zeros(3)) @ about.inverse() @ X_WG

    for body in find_bodies(effect, plant):
        _move(effect, plant, scene_graph, body, moved)


PLACE = "wall_position"

KINDS = {
    "plane_height": EffectKind(
        at="ground",
        parameters=(Parameter("height", "m", -0.05, 0.05),),
        says="the surface of {at} lies {height} higher than modelled",
        says_less="the surface of {at} lies {height} lower than modelled",
        confused_with=("object_size", "contact_stiffness", "length_scale"),
        tell_apart="rest on several faces, or use a second object of another size",
        before_finalize=_lift,
    ),
    PLACE: EffectKind(
        at="ground",
        parameters=tuple(
            Parameter(a, "m", -0.2, 0.2, 0.0, optional=True) for a in "xyz"
        ),
        says="{at} stands elsewhere than modelled[, by {x} along x][, by {y} along y]"
        "[, by {z} along z]",
        confused_with=("plane_height", "joint_offset", "contact_stiffness"),
        tell_apart="touch it in several attitudes of the robot: an offset of a joint "
        "shifts the tool by another length in each",
        contains=("plane_height",),
        check=_some_are_given,
        before_finalize=_displace,
    ),
    "plane_tilt": EffectKind(
        at="ground",
        parameters=(
            Parameter("roll", "rad", -0.1, 0.1),
            Parameter("pitch", "rad", -0.1, 0.1),
        ),
        says="the surface of {at} is tilted by {roll} of roll and {pitch} of pitch",
        confused_with=("contact_friction", "rolling_resistance", "gravity_tilt"),
        tell_apart="let something roll or slide both ways: a tilt speeds it up one way",
        before_finalize=_tilt,
    ),
}
