"""A block slides over three surfaces of unknown friction (CC 4.3, figures 8 to 10).

It comes down on the first surface and follows a path of straight lines and an arc that
crosses every seam in several directions, pressing with another force in each segment.
At first nothing is known about the surfaces. The seed draws the frictions (0.1 to 0.6,
at least 0.1 apart), the forces and the sensors' noise.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from makebreak.diagrams.changing_contact import (
    ChangingContactConfig,
    Knowledge,
    friction_from_rest,
    make_changing_contact,
    refuse_unused_control,
)
from makebreak.diagrams.given_pattern import expected_contacts, start_at_pattern
from makebreak.diagrams.realism import StationErrors, draw_errors
from makebreak.diagrams.tabletop import (
    THREE_SURFACES,
    TOOL,
    frictions,
    read_model,
    set_friction_by_place,
    set_tool,
    tool_half_width,
)
from makebreak.diagrams.wiring import refuse_changed, refuse_unused
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.arm.surface_alignment import SurfaceAlignmentConfig
from makebreak.systems.changing_contact.contact_anticipator import FirstApproachConfig
from makebreak.systems.changing_contact.numerics.contact_task import (
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    segment_time,
)

SEAM_X, SEAM_Y = 0.5, 0.0  # Where the surfaces meet [m].
AREAS = [
    FrictionZone(x=[0.0, SEAM_X], y=[-1.0, SEAM_Y]),
    FrictionZone(x=[0.0, SEAM_X], y=[SEAM_Y, 1.0]),
    FrictionZone(x=[SEAM_X, 1.0], y=[-1.0, 1.0]),
]
START = (0.42, -0.16, 0.195)  # Initial position of the tip in the world [m].
DOWN = np.array([0.0, 0.0, -1.0])
# The path on the surfaces, x and y [m]; three points make an arc. Beside each piece the
# surfaces that it crosses.
PATH: tuple[tuple[tuple[float, float], ...], ...] = (
    ((0.42, -0.16), (0.42, 0.12)),  # 1 -> 2
    ((0.42, 0.12), (0.58, 0.12)),  # 2 -> 3
    ((0.58, 0.12), (0.58, -0.10)),  # 3: another direction, no seam.
    ((0.58, -0.10), (0.43, -0.10)),  # 3 -> 1
    ((0.43, -0.10), (0.41, 0.0), (0.43, 0.10)),  # 1 -> 2
    ((0.43, 0.10), (0.59, 0.03)),  # 2 -> 3, slanting.
    ((0.59, 0.03), (0.43, -0.09)),  # 3 -> 1, slanting.
    ((0.43, -0.09), (0.44, 0.11)),  # 1 -> 2
    ((0.44, 0.11), (0.58, 0.07)),  # 2 -> 3
    ((0.58, 0.07), (0.43, 0.08)),  # 3 -> 2: a seam the other way.
    ((0.43, 0.08), (0.42, -0.12)),  # 2 -> 1
)
FRICTION, GAP = (0.1, 0.6), 0.1  # Range, and the least difference of two surfaces.
FORCE = (0.75, 1.5)  # Range of a segment's force over the config's normal_force.
SPEED_DOWN = 0.1  # [m/s]
TOUCH_SPEED = 0.015  # Where the table is expected [m/s].
GIVEN_STD = 0.005  # Of where a given motion expects its contacts [m].
# Distance of the corners on which the tool stands from its centre, in x and in y [m].
FEET = {"block": 0.012, "sphere": 0.0}
# Length over which a sphere's crossing of a seam shows in the features: it crosses at
# one point, but the features are averages [m].
SPHERE_CROSSING = 0.01


def _control() -> ChangingContactConfig:
    """The defaults, but for a first touch that is no blow: at 50 mm/s the tool bounces,
    and is in the air while the motion along the surface begins. A block is laid flat on
    a table that is not quite level: on one row of feet it would cross a seam in one
    step, up to a tool's length early or late."""
    config = ChangingContactConfig(
        forward_model=friction_from_rest(),
        mean_wrench=True,
        align=SurfaceAlignmentConfig(angle_max_deg=1.5),
    )
    first = FirstApproachConfig(speed=TOUCH_SPEED)
    speed = replace(config.anticipator.speed, first=first)
    return replace(config, anticipator=replace(config.anticipator, speed=speed))


@dataclass
class ChangingSurfaceConfig:
    """Settings of `makebreak run changing_surface`."""

    # Seed of the frictions, the normal forces, the station's errors and the noise.
    seed: int = 0
    tool: str = "block"  # Tool on the arm: block or sphere.
    speed: float = 0.1  # Speed of sliding over the surfaces [m/s].
    # Normal force on the surfaces [N]; each segment has 0.75 to 1.5 of it, drawn by the
    # seed.
    normal_force: float = 8.0
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Whether the motion is also run with constant stiffnesses, K_max and K_free.
    baselines: bool = True
    # Coefficients of friction of the three surfaces; empty: drawn by the seed.
    friction: list[float] = field(default_factory=list)
    # File of a motion to follow in place of the shipped one: a pattern (.yaml) or a
    # recorded demonstration, with its own speed and normal_force.
    pattern: str = ""
    model: str = ""  # Scene file of the controllers' model; empty: the shipped one.
    # Number of trials that are simulated in the model before the first real one.
    rehearse: int = 0
    control: ChangingContactConfig = field(default_factory=_control)


@dataclass(frozen=True, eq=False)
class SurfaceTask:
    """World, motion and prior of a seed."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    prior: ContactBelief  # The contact with the table, whose position is known.
    friction: np.ndarray  # (3,) of the surfaces.
    forces: np.ndarray  # (n,) of the segments that press on the surfaces [N]
    errors: StationErrors
    feet: float  # From the tip to the corners it stands on, in x and in y [m].


def draw_friction(rng: np.random.Generator) -> np.ndarray:
    """Three frictions (3,) from the range FRICTION, at least GAP apart."""
    while True:
        mu = rng.uniform(*FRICTION, size=3)
        if np.diff(np.sort(mu)).min() >= GAP:
            return mu


def make_task(
    config: ChangingSurfaceConfig, given: MotionPattern | None = None
) -> SurfaceTask:
    """World, motion and prior of config.seed.

    Args: given, the motion of config.pattern, if that is not empty.
    Raises: ValueError for an unknown tool, a setting out of range, or a motion that the
        arm cannot follow.
    """
    if bool(config.pattern) != (given is not None):
        raise ValueError(
            f'pattern is "{config.pattern}", expected the motion of that file beside it'
        )
    for name in ("speed", "normal_force"):
        value = getattr(config, name)
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} is {value}, expected a positive number")
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}, expected an integer of 0 or more")
    if config.pattern:
        for name in ("speed", "normal_force"):
            why = "the pattern of your own has it"
            refuse_unused(config, ChangingSurfaceConfig(), name, why)
    refuse_unused_control(config, ChangingSurfaceConfig())
    if config.tool == "sphere":
        why = "a sphere has no face"
        refuse_unused(config, ChangingSurfaceConfig(), "control.align", why)
    rng = np.random.default_rng([config.seed, 7])
    model = read_model(config.model, THREE_SURFACES, config.tool)
    world = read_scene(THREE_SURFACES)
    set_tool(world, config.tool)
    half = tool_half_width(config.tool)
    friction = frictions(config.friction, draw_friction(rng))
    set_friction_by_place(world, "surfaces", friction.tolist(), AREAS)
    forces = config.normal_force * rng.uniform(*FORCE, size=len(PATH))
    contact = ExpectedContact(
        np.array([START[0], START[1], half]), 1e-6 * np.eye(3), DOWN, segment=0
    )
    pattern, prior = make_pattern(config, half, forces), ContactBelief((contact,))
    if given is not None:
        start_at_pattern(given, world, model, TOOL)
        pattern, prior = given, expected_contacts(given, GIVEN_STD)
        forces = np.concatenate([s.force_targets for s in given.segments])
    return SurfaceTask(
        world,
        model,
        pattern,
        prior,
        friction,
        forces,
        draw_errors(config.realism, config.seed),
        FEET[config.tool],
    )


def make_pattern(config: ChangingSurfaceConfig, half: float, forces) -> MotionPattern:
    """Down, then along PATH, stopping after each piece.

    Args: half: half width of the tool [m]; forces (n_pieces,) [N].
    """
    a_max = 1.0
    down = np.array([START, (START[0], START[1], half)])
    time = segment_time(START[2] - half, SPEED_DOWN, a_max, stops=False)
    segments = [Segment("line", down, np.array([0.0, time]))]
    for piece, force in zip(PATH, forces, strict=True):
        points = np.column_stack([np.array(piece), np.full(len(piece), half)])
        kind = "arc" if len(piece) == 3 else "line"
        # Only for the duration; MotionPattern computes the arc's exact length.
        length = float(np.linalg.norm(points[-1] - points[0]))
        if kind == "arc":
            sagitta = float(np.linalg.norm(points[1] - (points[0] + points[-1]) / 2))
            radius = (length**2 / 4 + sagitta**2) / (2 * sagitta)
            length = 2 * radius * float(np.arcsin(length / (2 * radius)))
        duration = segment_time(length, config.speed, a_max)
        segments.append(
            Segment(
                kind,
                points,
                np.array([time, time + duration]),
                force_directions=DOWN[None],
                force_targets=np.array([force]),
            )
        )
        time += duration
    return MotionPattern(tuple(segments), acceleration_max=a_max)


def constant_stiffness(
    config: ChangingSurfaceConfig, stiffness: float
) -> ChangingSurfaceConfig:
    """The baseline: a constant stiffness [N/m] and no feed-forward."""
    law = config.control.variable_impedance
    fixed = replace(law.stiffness, free=stiffness, maximum=stiffness)
    law = replace(law, stiffness=fixed, feedforward=False)
    return replace(config, control=replace(config.control, variable_impedance=law))


def make_changing_surface(
    config: ChangingSurfaceConfig,
    task: SurfaceTask,
    knowledge: Knowledge | None = None,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The diagram of one trial. Args: knowledge: from an earlier trial; None: prior."""
    modes = config.control.modes
    # The length of a crossing follows from the tool's own geometry.
    if not task.feet:
        refuse_changed("control.modes", modes, ("crossing",))
    crossing = modes.crossing if task.feet else SPHERE_CROSSING
    align = config.control.align if task.feet else SurfaceAlignmentConfig()
    return make_changing_contact(
        replace(config.control, modes=replace(modes, crossing=crossing), align=align),
        task.world,
        task.model,
        task.pattern,
        knowledge or Knowledge(contacts=task.prior),
        tool=TOOL,
        seed=config.seed,
        meshcat=meshcat,
        errors=task.errors,
    )


def surface_at(p, feet: float):
    """Number of the surface (n, 4), 1 to 3, under each corner of the tool.

    Args: p (n, 3): of the tip [m]; feet: as in SurfaceTask [m].
    """
    p = np.asarray(p)
    at = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * feet
    x, y = p[:, None, 0] + at[:, 0], p[:, None, 1] + at[:, 1]
    return np.where(x > SEAM_X, 3, np.where(y > SEAM_Y, 2, 1))
