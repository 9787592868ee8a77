"""The sections of a scene file as dataclasses, and checks of their values."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from pydrake.multibody.parsing import ModelDirective
from pydrake.multibody.plant import DiscreteContactApproximation

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, check_parameters
from makebreak.models.effects.measured_channels import torque_constant
from makebreak.models.friction_zones import FrictionZone, check_zones
from makebreak.models.typed_yaml import Between, check, convert, hints_of, nearest

# Bounds are far outside of the range of robots: they catch wrong units and typing
# errors, and numbers that Drake cannot compute with.
Coordinate = Annotated[float, Between(-1e4, 1e4, "rad or m")]
Rate = Annotated[float, Between(-1e4, 1e4, "rad/s or m/s")]
Gain = Annotated[float, Between(0.0, 1e9)]
Positive = Annotated[float, Between(1e-9, 1e9)]
TIME_STEP_MIN = 1e-6  # [s]

# Commands that a recording may have, by the type of a scene's actuation.
COMMANDS_OF: dict[str, tuple[str, ...]] = {
    "none": (),
    "effort": ("effort_command",),
    "pd": ("position_command", "velocity_command"),
    "servo": ("position_command",),
    "velocity": ("velocity_command",),
}
# Keys of a scene's `tolerance`, and the range of their values.
TOLERANCES = {
    "link_mass": Between(0.0, 10.0, "of the mass"),
    "link_com_m": Between(0.0, 1.0, "m"),
    "contact_stiffness": Between(0.0, 100.0, "of the stiffness"),
    "contact_dissipation": Between(0.0, 100.0, "of the dissipation"),
    "shape_m": Between(0.0, 0.1, "m"),
    "drive_gains": Between(0.0, 1.0, "of kp and kd"),
    "loop_sec": Between(0.0, 0.1, "s"),
    "friction_sec": Between(0.0, 0.1, "s"),
}
SIDES = ("motor", "motor side", "link", "link side")
SIDED = ("position", "velocity", "effort_measured")  # Channels that have a side.


@dataclass
class PlantSection:
    """A scene's `plant`: time step, contact, gravity."""

    time_step: Annotated[float, Between(0.0, 0.1, "s")] = 0.001  # 0 is continuous.
    contact_model: Literal["point", "hydroelastic", "hydroelastic_with_fallback"] = (
        "point"
    )
    discrete_contact_approximation: Literal["tamsi", "sap", "similar", "lagged"] = (
        "lagged"
    )
    gravity: list[Annotated[float, Between(-1e3, 1e3, "m/s2")]] = field(
        default_factory=lambda: [0.0, 0.0, -9.81]
    )
    shapes: bool = True  # False: nothing touches, and no mesh is read.


@dataclass
class SupplySection:
    """A motor and its voltage supply: one number each, or one for each joint."""

    voltage: list[Positive] = field(default_factory=list)  # [V]
    kt: list[Positive] = field(default_factory=list)  # [N m/A], at the joint.
    resistance: list[Positive] = field(default_factory=list)  # [Ohm]


@dataclass
class ActuationSection:
    """The actuation of the joints. For the types pd, servo and velocity the effort is

        clip(kp (position_command - position) + kd (velocity_command - velocity),
             +-limit) - kt^2/R velocity

    pd has both commands, servo only the position (kd damps the joint's velocity),
    velocity only the velocity. With a supply the limit is at most voltage kt/R. A
    position error is measured from the edge of the dead band; a position command is
    rounded to steps of `resolution`. Each is one number, or one for each joint.

    joints: `<model>.<joint>`; none: those with an actuator in the models' files.
    """

    type: str = "none"  # A key of COMMANDS_OF.
    joints: list[str] = field(default_factory=list)
    kp: list[Gain] = field(default_factory=list)  # [N m/rad] or [N/m]
    kd: list[Gain] = field(default_factory=list)  # [N m s/rad] or [N s/m]
    limit: list[Positive] = field(default_factory=list)  # [N m] or [N]
    supply: SupplySection = field(default_factory=SupplySection)
    dead_band: list[Gain] = field(default_factory=list)  # [rad] or [m], to each side.
    resolution: list[Gain] = field(default_factory=list)  # [rad] or [m]
    # A recorded position or velocity command until the next: constant, or on a line.
    hold: Literal["zero_order", "first_order"] = "zero_order"
    rate_hz: Annotated[float, Between(1.0, 1e5, "Hz")] = 1000.0


@dataclass
class InitialSection:
    """Keys are `<model>.<joint>` and `<model>.<body>`; bodies are in world axes."""

    positions: dict[str, Coordinate] = field(default_factory=dict)
    velocities: dict[str, Rate] = field(default_factory=dict)
    poses: dict[str, list[Coordinate]] = field(default_factory=dict)  # qw qx qy qz x..z
    body_velocities: dict[str, list[Rate]] = field(default_factory=dict)  # wx.. vx..


@dataclass
class Scene:
    """A scene file: models, plant, drives, initial state, tolerances, effects."""

    packages: dict[str, str] = field(default_factory=dict)  # Name -> its folder.
    directives: list[ModelDirective] = field(default_factory=list)
    plant: PlantSection = field(default_factory=PlantSection)
    actuation: ActuationSection = field(default_factory=ActuationSection)
    # {<model>.<joint>: position} of joints that do not move.
    fixed_joints: dict[str, Coordinate] = field(default_factory=dict)
    initial: InitialSection = field(default_factory=InitialSection)
    # {recording's file name: {episode: initial state}}. In a file it is `initial` with
    # file names instead of positions, velocities, poses, body_velocities.
    initial_of: dict[str, dict[str, InitialSection]] = field(default_factory=dict)
    tolerance: dict[str, float] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    friction_zones: list[FrictionZone] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


def check_scene(scene: Scene) -> None:
    """Checks that need no models.

    Raises: ValueError that names what is wrong in the scene.
    """
    for name, hint in hints_of(Scene).items():
        if name not in ("directives", "effects"):
            convert(name, getattr(scene, name), hint)
    step = scene.plant.time_step
    if 0.0 < step < TIME_STEP_MIN:
        raise ValueError(
            f"plant.time_step: got {step:g}, expected 0 (continuous) or at least "
            f"{TIME_STEP_MIN:g} [s]"
        )
    approximation = scene.plant.discrete_contact_approximation
    if approximation == "tamsi" and not hasattr(DiscreteContactApproximation, "kTamsi"):
        raise ValueError(
            "plant.discrete_contact_approximation: got tamsi, which Drake 1.58 no "
            "longer has; expected lagged, similar or sap"
        )
    if len(scene.plant.gravity) != 3:
        raise ValueError(f"plant.gravity is {scene.plant.gravity}, expected [x, y, z]")
    _check_actuation(scene.actuation)
    check_initial("initial", scene.initial)
    for file, episodes in scene.initial_of.items():
        for episode, state in episodes.items():
            check_initial(f"initial of {file}, episode {episode}", state)
    for key, value in scene.tolerance.items():
        if key not in TOLERANCES:
            raise ValueError(
                f"tolerance: unknown key {key}; {nearest(key, TOLERANCES)}"
            )
        if not TOLERANCES[key].holds(value):
            raise ValueError(
                f"tolerance.{key}: got {value:g}, expected {TOLERANCES[key]}"
            )
    for key, side in scene.channels.items():
        if key.rsplit(".", 1)[-1] not in SIDED:
            raise ValueError(
                f"channels: got {key}, expected <model>.<joint>.<quantity> or a "
                f"quantity: {', '.join(SIDED)}"
            )
        if key.endswith("effort_measured") and side.lower().startswith("current"):
            torque_constant(scene.channels, key)
        elif side.strip().lower() not in SIDES:
            raise ValueError(
                f'channels.{key}: got "{side}", expected one of: {", ".join(SIDES)}'
            )
    for effect in scene.effects:
        as_kind(effect)
    check_zones(scene.friction_zones)


def _check_actuation(actuation: ActuationSection) -> None:
    if actuation.type not in COMMANDS_OF:
        raise ValueError(
            f"actuation.type is {actuation.type!r}, expected one of "
            f"{', '.join(COMMANDS_OF)}"
        )
    for joint in actuation.joints:
        if actuation.joints.count(joint) > 1:
            raise ValueError(f"actuation.joints names {joint} more than once")


def check_initial(where: str, initial: InitialSection) -> None:
    """Raises: ValueError for a number out of bounds, or a pose or velocity of another
    form."""
    check(initial, f"{where}.")
    for name, pose in initial.poses.items():
        if len(pose) != 7 or not abs(math.hypot(*pose[:4]) - 1.0) < 1e-3:
            raise ValueError(
                f"{where}.poses of {name!r} is {pose}, expected 7 numbers "
                "[qw qx qy qz x y z] with a unit quaternion"
            )
    for name, twist in initial.body_velocities.items():
        if len(twist) != 6:
            raise ValueError(
                f"{where}.body_velocities of {name!r} is {twist}, expected 6 numbers "
                "[wx wy wz vx vy vz]"
            )


def as_kind(effect: Effect) -> Effect:
    """The effect itself. Raises: ValueError for an unknown kind or bad parameters."""
    if effect.kind not in KINDS:
        raise ValueError(
            f"effect kind {effect.kind!r} is unknown: {nearest(effect.kind, KINDS)}"
        )
    if not effect.at:
        raise ValueError(f"effect {effect.kind} needs `at`: where it acts")
    check_parameters(effect, KINDS[effect.kind])
    return effect


def without_shapes(scene: Scene) -> Scene:
    """The scene for use where nothing touches, which is loaded in no time if its models
    have large meshes. As it is where its effects are of shapes."""
    kinds = {KINDS[effect.kind].at for effect in scene.effects}
    if scene.friction_zones or kinds & {"pair", "ground", "free body"}:
        return scene
    return replace(scene, plant=replace(scene.plant, shapes=False))
