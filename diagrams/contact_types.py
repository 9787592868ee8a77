"""A block that touches a plate with a face, an edge and a corner (CC 3.2: the torque
part of the feature).

It comes down flat, slides, is lifted and turned, comes down on an edge, slides, then on
a corner; and all of this once more. The friction is the same everywhere, so the force
alone does not say how the block touches. Friction and sensor noise depend on the seed.
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram
from scipy.spatial.transform import Rotation

from makebreak.diagrams.changing_contact import (
    ChangingContactConfig,
    Knowledge,
    make_changing_contact,
    refuse_unused_control,
)
from makebreak.diagrams.given_pattern import expected_contacts, start_at_pattern
from makebreak.diagrams.realism import StationErrors, draw_errors
from makebreak.diagrams.tabletop import (
    THREE_SURFACES,
    TOOL,
    read_model,
    set_friction,
    set_tool,
)
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.arm.surface_alignment import SurfaceAlignmentConfig
from makebreak.systems.changing_contact.mode_detector import ModeDetectorConfig
from makebreak.systems.changing_contact.numerics.contact_task import ContactBelief
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    segment_time,
)

TYPES = ("face", "edge", "corner")
ROUNDS = 2  # The second time each type has to be recognised.
FRICTION = (0.1, 0.6)
FOOT, RADIUS = 0.012, 0.003  # The block's corners: from its centre; their spheres [m].
START = (0.40, -0.04)  # Of the first stroke, x and y [m].
STROKE, NEXT = 0.08, 0.02  # Length of a stroke, in y; from one to the next, in x [m].
LIFTED = 0.06  # Height of the tip between two strokes [m].
SPEED_DOWN, SPEED_UP = 0.05, 0.1  # [m/s]
A_MAX = 1.0  # [m/s2]
PLACE_STD = 0.002  # Of the plate's height, as the controllers know it [m].
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass
class ContactTypesConfig:
    """Settings of `makebreak run contact_types`."""

    seed: int = 0  # Seed of the friction, the station's errors and the noise.
    # Tilt of the block: about one axis on its edge, about two on its corner [deg].
    tilt_deg: float = 10.0
    speed: float = 0.1  # Speed of sliding over the plate [m/s].
    normal_force: float = 8.0  # Normal force on the plate [N].
    friction: float = 0.0  # Coefficient of friction of the plate; 0: drawn by the seed.
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    control: ChangingContactConfig = field(
        default_factory=lambda: ChangingContactConfig(
            # Edge and corner differ by 6 mm times the normal force at little friction:
            # by 0.1, 2.5 thresholds of the feature. No seam is crossed.
            modes=ModeDetectorConfig(torque_arm=0.06, crossing=0.0),
            # A table that is not quite level makes an edge of a face otherwise.
            align=SurfaceAlignmentConfig(angle_max_deg=1.5),
        )
    )


@dataclass(frozen=True, eq=False)
class TypesTask:
    """World and motion of a seed."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    strokes: tuple[tuple[int, str], ...]  # Each stroke's segment, and its type.
    prior: ContactBelief
    friction: float
    errors: StationErrors


def orientation(kind: str, tilt_deg: float) -> Rotation:
    """Of the block, for each of TYPES: the edge is the one ahead in x, the corner the
    one of its two ends that trails as the block slides along y."""
    tilt = np.deg2rad(tilt_deg)
    about_y = Rotation.from_rotvec([0.0, tilt * (kind != "face"), 0.0])
    return Rotation.from_rotvec([tilt * (kind == "corner"), 0.0, 0.0]) * about_y


def height(turn: Rotation) -> float:
    """Of the tip over the plate when the block touches it [m]."""
    corners = FOOT * np.array([[x, y, -1.0] for x in (-1, 1) for y in (-1, 1)])
    return float(RADIUS - turn.apply(corners)[:, 2].min())


def make_pattern(config: ContactTypesConfig):
    """The motion, and the (segment, type) of each stroke."""
    segments: list[Segment] = []
    strokes: list[tuple[int, str]] = []
    time = 0.2
    kinds = TYPES * ROUNDS
    turns = [orientation(kind, config.tilt_deg) for kind in kinds]

    def add(a, b, speed, turn, after=None, pressing=False, stops=True):
        nonlocal time
        a, b = np.array(a), np.array(b)
        duration = segment_time(float(np.linalg.norm(b - a)), speed, A_MAX, stops=stops)
        q = [each.as_quat(scalar_first=True) for each in (turn, after or turn)]
        segments.append(
            Segment(
                "line",
                np.array([a, b]),
                np.array([time, time + duration]),
                np.array(q),
                DOWN[None] if pressing else np.zeros((0, 3)),
                np.array([config.normal_force] if pressing else []),
            )
        )
        time += duration

    for i, (kind, turn) in enumerate(zip(kinds, turns, strict=True)):
        x, y, low = START[0] + NEXT * i, START[1], height(turn)
        add((x, y, LIFTED), (x, y, low), SPEED_DOWN, turn, stops=False)
        strokes.append((len(segments), kind))
        end = (x, y + STROKE)
        add((x, y, low), (*end, low), config.speed, turn, pressing=True)
        add((*end, low), (*end, LIFTED), SPEED_UP, turn)
        if i + 1 < len(kinds):
            there = (x + NEXT, y, LIFTED)
            add((*end, LIFTED), there, SPEED_UP, turn, after=turns[i + 1])
    return MotionPattern(tuple(segments), acceleration_max=A_MAX), tuple(strokes)


def make_task(config: ContactTypesConfig) -> TypesTask:
    """World and motion of config.seed.

    Raises: ValueError for a setting out of range.
    """
    refuse_unused_control(config, ContactTypesConfig())
    for name in ("speed", "normal_force"):
        if not 0.0 < getattr(config, name) < np.inf:
            raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")
    if not 3.0 <= config.tilt_deg <= 25.0:
        raise ValueError(f"tilt_deg is {config.tilt_deg}, expected 3 to 25")
    turn = config.control.align.angle_max_deg
    if turn >= config.tilt_deg:
        raise ValueError(
            f"control.align.angle_max_deg is {turn}, expected less than tilt_deg, "
            f"{config.tilt_deg}: an edge would be laid flat"
        )
    rng = np.random.default_rng([config.seed, 11])
    friction = config.friction or float(rng.uniform(*FRICTION))
    model = read_model("", THREE_SURFACES, "block")
    world = read_scene(THREE_SURFACES)
    set_tool(world, "block")
    set_friction(world, {"surfaces": friction})
    pattern, strokes = make_pattern(config)
    start_at_pattern(pattern, world, model, TOOL)
    prior = expected_contacts(pattern, PLACE_STD)
    errors = draw_errors(config.realism, config.seed)
    return TypesTask(world, model, pattern, strokes, prior, friction, errors)


def make_contact_types(
    config: ContactTypesConfig, task: TypesTask, meshcat: Meshcat | None = None
) -> Diagram:
    """The station and all systems, with nothing known but where the plate is."""
    return make_changing_contact(
        config.control,
        task.world,
        task.model,
        task.pattern,
        Knowledge(contacts=task.prior),
        tool=TOOL,
        seed=config.seed,
        meshcat=meshcat,
        errors=task.errors,
    )
