"""The scenes of push_object: the simulated world, and the controllers' model of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from makebreak.diagrams.push_object_config import (
    OBJECT,
    PushObjectConfig,
    rolling_axis,
)
from makebreak.diagrams.station import TOOL
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.rolling_resistance import rolls_against
from makebreak.models.pushed_object import (
    PushedObject,
    object_file,
    rest_height,
    seen_parts,
)
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.contact_mpc.push_goals import draw_poses
from makebreak.systems.perception.numerics.object_outline import make_shape

ROLLING_RESISTANCE = 0.005  # Of a cylinder in the world: lever arm over radius.


def outline_fold(config: PushObjectConfig) -> int:
    """Rotational symmetry of the object for what measures it (Shape.fold): number of
    equal turns that leave its outline unchanged, 0 for a disc. A pose sensor measures
    every turn: 1."""
    if config.pose_from == "sensor":
        return 1
    return make_shape(*seen_parts(config.object)).fold


def poses_of(config: PushObjectConfig) -> np.ndarray:
    """(1 + n_goals, 3) x, y [m], yaw [rad]: the object's initial pose, then the goals.

    Raises: ValueError for a setting out of range.
    """
    if config.n_goals < 1:
        raise ValueError(f"n_goals is {config.n_goals}, expected at least 1")
    poses = draw_poses(config.goals, config.n_goals + 1, config.seed)
    if outline_fold(config) == 0:
        poses[:, 2] = 0.0  # The camera cannot measure a disc's yaw; it starts at 0.
    if config.start:
        if len(config.start) != 3:
            raise ValueError(f"start is {config.start}, expected [x, y, yaw]")
        poses[0] = config.start
    return poses


def world_scene(config: PushObjectConfig) -> Scene:
    """The simulated scene: the object at its initial pose, with its friction.

    Raises: ValueError for a setting out of range or a scene without the object.
    """
    scene = read_scene(config.scene)
    if not config.friction > 0.0:
        raise ValueError(f"friction is {config.friction}, expected > 0")
    models = [d.add_model.name for d in scene.directives if d.add_model is not None]
    if OBJECT not in models:
        names = ", ".join(models)
        raise ValueError(f"the scene has {names}, expected a model {OBJECT} too")
    x, y, yaw = poses_of(config)[0]
    quaternion = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    pose = [*quaternion, x, y, rest_height(config.object)]
    _place_object(scene, object_file(config.object), pose)
    _set_friction(scene, config.friction)
    resistance = _rolling_resistance(config)
    if resistance > 0.0:
        scene.effects.append(rolls_against(f"{OBJECT}~table", resistance))
    return scene


def _rolling_resistance(config: PushObjectConfig) -> float:
    """Lever arm over radius; 0 for what does not roll. Raises: ValueError."""
    rolls = bool(rolling_axis(config.object))
    resistance = config.rolling_resistance
    if resistance is None:
        resistance = ROLLING_RESISTANCE if rolls else 0.0
    if not resistance >= 0.0 or (resistance > 0.0 and not rolls):
        raise ValueError(
            f"rolling_resistance is {resistance}, expected >= 0"
            + ("" if rolls else f"; object.shape {config.object.shape} does not roll")
        )
    return resistance


def _place_object(scene: Scene, file: str | Path, pose) -> None:
    """Puts the object of an SDF file into the scene at a pose (7,), quaternion (w, x,
    y, z) and position [m]."""
    for d in scene.directives:
        if d.add_model is not None and d.add_model.name == OBJECT:
            d.add_model.file = f"file://{file}"
    scene.initial.poses[f"{OBJECT}.{OBJECT}"] = [float(value) for value in pose]


def _set_friction(scene: Scene, friction: float) -> None:
    """Sets the object's friction with tip and table."""
    for pair in (f"{TOOL}~{OBJECT}", f"{OBJECT}~table"):
        value = {"friction": friction}
        scene.effects.append(Effect("contact_friction", [pair], value))


def model_object(config: PushObjectConfig) -> tuple[PushedObject, float]:
    """The object and its friction in the controllers' model. Raises: ValueError."""
    o, m = config.object, config.model
    offset = [a + b for a, b in zip(o.com_offset, m.com_offset, strict=True)]
    friction = config.friction if m.friction is None else m.friction
    if not friction > 0.0:
        raise ValueError(f"model.friction is {friction}, expected > 0")
    spec = replace(o, scale=o.scale * m.scale, mass=o.mass * m.mass, com_offset=offset)
    return spec, friction


def model_arm_scene(config: PushObjectConfig) -> Scene:
    """The scene from which the controllers take arm, finger and table."""
    if config.model.scene is not None:
        return read_scene(config.model.scene)
    return replace(read_scene(config.scene), effects=[])


def model_scene(config: PushObjectConfig, file: str | Path, pose) -> Scene:
    """The controllers' model as one scene, its errors as effects: what a recording of
    the run is compared with.

    Args: file: SDF of the world's object (models/pushed_object.py: object_sdf); pose
        (7,): the first measured one of the object, quaternion and position [m].
    """
    scene = model_arm_scene(config)
    spec, friction = model_object(config)
    _place_object(scene, file, pose)
    m = config.model
    if m.scale != 1.0:
        scene.effects.append(Effect("object_size", [OBJECT], {"scale": m.scale}))
    if m.mass != 1.0:
        mass = {"mass": float(spec.mass)}
        scene.effects.append(Effect("object_mass", [OBJECT], mass))
    if any(m.com_offset) or (m.scale != 1.0 and any(config.object.com_offset)):
        com = dict(zip("xy", map(float, spec.com_offset), strict=True))
        scene.effects.append(Effect("object_com", [OBJECT], com))
    _set_friction(scene, friction)
    return scene
