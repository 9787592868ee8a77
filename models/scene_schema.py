"""What a scene file may say, as dataclasses, and the checks of their values."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches

from pydrake.multibody.parsing import ModelDirective

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, check_parameters
from makebreak.models.friction_zones import FrictionZone, check_zones

# What an actuation of each type takes as commands.
COMMANDS_OF: dict[str, tuple[str, ...]] = {
    "none": (),
    "effort": ("effort_command",),
    "pd": ("position_command", "velocity_command"),
    "servo": ("position_command",),
    "velocity": ("velocity_command",),
}


@dataclass
class PlantSection:
    time_step: float = 0.001  # [s]; 0 is continuous.
    contact_model: str = "point"
    discrete_contact_approximation: str = "lagged"
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81])  # [m/s2]


@dataclass
class SupplySection:
    """A motor at a supply: each one number, or one for each joint."""

    voltage: list[float] = field(default_factory=list)  # [V]
    kt: list[float] = field(default_factory=list)  # [N m/A], at the joint.
    resistance: list[float] = field(default_factory=list)  # [Ohm]


@dataclass
class ActuationSection:
    """Who drives the joints. The effort of the types pd, servo and velocity is

        clip(kp (position_command - position) + kd (velocity_command - velocity),
             +-limit) - kt^2/R velocity

    pd has all of the commands, servo the position (with kd against its velocity),
    velocity the velocity. The limit is at most voltage kt/R, if there is a supply. An
    error of position counts from the dead band's edge on; a position command is
    received in whole steps of `resolution`. Each is one number, or one for each joint.
    """

    type: str = "none"  # A key of COMMANDS_OF.
    joints: list[str] = field(default_factory=list)
    kp: list[float] = field(default_factory=list)  # [N m/rad] or [N/m]
    kd: list[float] = field(default_factory=list)  # [N m s/rad] or [N s/m]
    limit: list[float] = field(default_factory=list)  # [N m] or [N]
    supply: SupplySection = field(default_factory=SupplySection)
    dead_band: list[float] = field(default_factory=list)  # [rad] or [m], to each side.
    resolution: list[float] = field(default_factory=list)  # [rad] or [m]
    hold: str = "zero_order"
    rate_hz: float = 1000.0


@dataclass
class InitialSection:
    """Named `<model>.<joint>` and `<model>.<body>`; bodies in the world's axes."""

    positions: dict[str, float] = field(default_factory=dict)  # [rad] or [m]
    velocities: dict[str, float] = field(default_factory=dict)  # [rad/s] or [m/s]
    poses: dict[str, list[float]] = field(default_factory=dict)  # [qw qx qy qz x y z]
    body_velocities: dict[str, list[float]] = field(
        default_factory=dict
    )  # [wx wy wz vx vy vz]


@dataclass
class Scene:
    directives: list[ModelDirective] = field(default_factory=list)
    plant: PlantSection = field(default_factory=PlantSection)
    actuation: ActuationSection = field(default_factory=ActuationSection)
    initial: InitialSection = field(default_factory=InitialSection)
    # Recording's file name -> episode -> its initial state. In a file: `initial`, with
    # file names in place of positions, velocities, poses, body_velocities.
    initial_of: dict[str, dict[str, InitialSection]] = field(default_factory=dict)
    tolerance: dict[str, float] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    friction_zones: list[FrictionZone] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


def nearest(name: str, known: Iterable[str]) -> str:
    """What may have been meant by a wrong name, as the end of an error message."""
    known = sorted(known)
    close = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def check_scene(scene: Scene) -> None:
    """Raises: ValueError, naming what in the scene is wrong."""
    if not scene.plant.time_step >= 0.0:
        raise ValueError(
            f"plant.time_step is {scene.plant.time_step}, expected 0 or more [s]"
        )
    if len(scene.plant.gravity) != 3:
        raise ValueError(f"plant.gravity is {scene.plant.gravity}, expected [x, y, z]")
    kind = scene.actuation.type
    if kind not in COMMANDS_OF:
        raise ValueError(
            f"actuation.type is {kind!r}, expected one of {', '.join(COMMANDS_OF)}"
        )
    if scene.actuation.hold != "zero_order":
        raise ValueError(
            f"actuation.hold is {scene.actuation.hold!r}, expected zero_order"
        )
    if not scene.actuation.rate_hz > 0.0:
        raise ValueError(
            f"actuation.rate_hz is {scene.actuation.rate_hz}, expected > 0"
        )
    for effect in scene.effects:
        as_kind(effect)
    check_zones(scene.friction_zones)


def as_kind(effect: Effect) -> Effect:
    """The effect, checked. Raises: ValueError."""
    if effect.kind not in KINDS:
        raise ValueError(
            f"effect kind {effect.kind!r} is unknown: {nearest(effect.kind, KINDS)}"
        )
    if not effect.at:
        raise ValueError(f"effect {effect.kind} needs `at`: where it acts")
    check_parameters(effect, KINDS[effect.kind])
    return effect
