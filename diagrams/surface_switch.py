"""A block slides over a seam, along a wall and back over the seam, again and again (CC
section 4.5.2, figures 1a, 19 and 20).

Down on a table (1), along it to a wall (2), along the wall (3), back along the table to
a stop (4). Half-way in 2 and in 4 the surface changes: to more friction, and to less.
Of the contacts there is a noisy estimate; the surfaces and their seams are not known in
the first trial. A trial begins with what the one before has learned.
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
)
from makebreak.diagrams.realism import StationErrors, draw_errors
from makebreak.diagrams.tabletop import (
    SURFACE_SWITCH,
    TOOL,
    frictions,
    position,
    read_model,
    set_friction,
    set_friction_by_place,
    set_tool,
    tool_half_width,
)
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.arm.impedance_controller import HybridConfig
from makebreak.systems.changing_contact.numerics.contact_task import (
    IMPACTLESS,
    UNKNOWN_MODE,
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    segment_time,
)

START = (0.42, -0.16, 0.195)  # Of the tip in the scene [m].
SEAM_Y = 0.0  # [m]
ALONG_WALL = 0.15  # Length of segment 3 [m].
BEYOND = 0.04  # How far behind wall and stop the motion pattern goes [m].
BACK = 0.03  # Length of the last segment, which takes the last contact up [m].
ERROR, SIGMA = 0.03, 0.02  # Of the estimates of the contacts, along each motion [m].
# Low friction, high friction, and of the walls.
LOW, HIGH, WALL = (0.1, 0.3), (0.4, 0.6), (0.1, 0.6)
DOWN, Y = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
CROSSINGS = (1, 3)  # Segments in which the surface changes.
FEET = {"block": 0.012, "sphere": 0.0}  # From the tip to where it stands [m].
# A sphere crosses at one point; what is averaged over takes some way.
SPHERE_CROSSING = 0.01  # [m]


@dataclass
class Anticipation:
    """What a trial takes over from the one before about impact-less changes."""

    places: bool = True  # Where they are: K_max there.
    models: bool = True  # And which mode begins there: its model is handed over.


def _control() -> ChangingContactConfig:
    """The defaults, with a lead for what a hint takes to reach the arm: 5 to 10 ms
    through the estimators, 1 ms to the arm's law, and the 5 ms of the feed-forward's
    filter. The force on wall and stop is let go within 30 ms: for as long as it fades
    the tool stays there, while the reference leaves."""
    config = ChangingContactConfig(
        forward_model=friction_from_rest(),
        hybrid=HybridConfig(damping_ratio=0.9, release_sec=0.03),
    )
    return replace(config, anticipator=replace(config.anticipator, hint_lead_sec=0.014))


@dataclass
class SurfaceSwitchConfig:
    seed: int = 0
    tool: str = "block"  # Or "sphere".
    trials: int = 3
    speed: float = 0.1  # Of sliding [m/s].
    normal_force: float = 8.0  # On each surface that has been reached [N].
    realism: str = "none"  # Errors of the station: "none", "lab" or "poor".
    # Low, high, of the walls; empty: drawn by the seed.
    friction: list[float] = field(default_factory=list)
    model: str = ""  # Scene that the controllers believe; "": the shipped one.
    rehearse: int = 0  # Trials in the model before the first real one.
    anticipation: Anticipation = field(default_factory=Anticipation)
    control: ChangingContactConfig = field(default_factory=_control)


@dataclass(frozen=True, eq=False)
class SwitchTask:
    """What the trials of one seed have in common."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    prior: ContactBelief
    friction: np.ndarray  # (3,) of surface 1, of surface 2, of the walls.
    errors: StationErrors
    feet: float  # From the tip to the corners it stands on, along y [m].


def make_task(config: SurfaceSwitchConfig) -> SwitchTask:
    """The world, the motion and the initial belief of config.seed.

    Raises: ValueError for an unknown tool, or numbers that are not positive.
    """
    for name in ("trials", "speed", "normal_force"):
        value = getattr(config, name)
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} is {value}, expected a positive number")
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}, expected an integer of 0 or more")
    rng = np.random.default_rng([config.seed, 11])
    model = read_model(config.model, SURFACE_SWITCH, config.tool)
    world = read_scene(SURFACE_SWITCH)
    set_tool(world, config.tool)
    half = tool_half_width(config.tool)
    drawn = np.array([rng.uniform(*span) for span in (LOW, HIGH, WALL)])
    friction = frictions(config.friction, drawn)
    areas = [FrictionZone(y=[-1.0, SEAM_Y]), FrictionZone(y=[SEAM_Y, 1.0])]
    set_friction_by_place(world, "surfaces", friction[:2].tolist(), areas)
    set_friction(world, {name: float(friction[2]) for name in ("red_block", "stop")})
    pattern = make_pattern(config, half)
    # Where the tool really meets table, wall and stop: the pattern goes beyond.
    touch = [
        (0, DOWN, half),
        (1, Y, position(world, "red_block")[1] - half),
        (3, -Y, position(world, "stop")[1] + half),
    ]
    prior = []
    for segment, d, place in touch:
        mean = np.array(pattern.segments[segment].positions[-1])
        axis = int(np.argmax(abs(d)))
        mean[axis] = place + rng.uniform(-ERROR, ERROR)
        prior.append(ExpectedContact(mean, SIGMA**2 * np.eye(3), d, segment=segment))
    return SwitchTask(
        world,
        model,
        pattern,
        ContactBelief(tuple(prior)),
        friction,
        draw_errors(config.realism, config.seed),
        FEET[config.tool],
    )


def make_pattern(config: SurfaceSwitchConfig, half: float) -> MotionPattern:
    """Down, to the wall, along it, back to the stop, a little along that."""
    scene = read_scene(SURFACE_SWITCH)
    x, y, z = START
    wall = position(scene, "red_block")[1] - half
    stop = position(scene, "stop")[1] + half
    corners = np.array([
        [x, y, z],
        [x, y, half - BEYOND],
        [x, wall + BEYOND, half - BEYOND],
        [x + ALONG_WALL, wall + BEYOND, half - BEYOND],
        [x + ALONG_WALL, stop - BEYOND, half - BEYOND],
        [x + ALONG_WALL + BACK, stop - BEYOND, half - BEYOND],
    ])  # fmt: skip
    forces: tuple[list, ...] = ([], [DOWN], [DOWN, Y], [DOWN], [DOWN, -Y])
    segments, time, a_max = [], 0.0, 1.0
    for k, n in enumerate(forces):
        length = float(np.linalg.norm(corners[k + 1] - corners[k]))
        # The last piece is short: half the speed will do.
        speed = config.speed / 2.0 if k == len(forces) - 1 else config.speed
        stops = k in (2, len(forces) - 1)  # The others end in a contact.
        duration = segment_time(length, speed, a_max, stops=stops)
        segments.append(
            Segment(
                "line",
                corners[k : k + 2],
                np.array([time, time + duration]),
                force_directions=np.array(n).reshape(-1, 3),
                force_targets=np.full(len(n), config.normal_force),
            )
        )
        time += duration
    return MotionPattern(tuple(segments), acceleration_max=a_max)


def taken_over(knowledge: Knowledge, anticipation: Anticipation) -> Knowledge:
    """What the next trial is told: all, or less, for comparison."""
    contacts = []
    for contact in knowledge.contacts.contacts:
        if contact.kind == IMPACTLESS:
            if not anticipation.places:
                continue
            if not anticipation.models:
                contact = replace(contact, to_mode=UNKNOWN_MODE)
        contacts.append(contact)
    return replace(knowledge, contacts=ContactBelief(tuple(contacts)))


def make_surface_switch(
    config: SurfaceSwitchConfig,
    task: SwitchTask,
    knowledge: Knowledge | None = None,
    trial: int = 0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """One trial. Args: knowledge: of the trial before; None: the prior alone."""
    control = config.control
    modes, models = control.modes, control.forward_model
    # How the tool crosses a seam is its own geometry.
    crossing = modes.crossing if task.feet else SPHERE_CROSSING
    handover = replace(models.handover, rows=2.0 * task.feet)
    return make_changing_contact(
        replace(
            control,
            modes=replace(modes, crossing=crossing),
            forward_model=replace(models, handover=handover),
        ),
        task.world,
        task.model,
        task.pattern,
        taken_over(knowledge or Knowledge(contacts=task.prior), config.anticipation),
        tool=TOOL,
        seed=1000 * config.seed + trial,
        meshcat=meshcat,
        errors=task.errors,
    )
