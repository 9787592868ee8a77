"""A block slides over a seam, along a wall and back over the seam, for several trials
(CC section 4.5.2, figures 1a, 19 and 20).

Down on a table (1), along it to a wall (2), along the wall (3), back along the table to
a stop (4). Half-way in 2 the surface changes to one of more friction, in 4 back. The
contacts are known from noisy estimates; surfaces and seam are unknown in the first
trial. Each trial starts with what the last one learned.
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
from makebreak.diagrams.wiring import refuse_changed, refuse_unused
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

START = (0.42, -0.16, 0.195)  # Initial position of the tip in the world [m].
SEAM_Y = 0.0  # Where the two surfaces meet [m].
ALONG_WALL = 0.15  # Length of segment 3 [m].
BEYOND = 0.04  # Distance by which the motion pattern aims behind wall and stop [m].
BACK = 0.03  # Length of the last segment, in which the last contact is held [m].
# Of the contacts' estimates along each motion: largest error, standard deviation [m].
ERROR, SIGMA = 0.03, 0.02
# Ranges of the frictions of surface 1, of surface 2, and of wall and stop.
LOW, HIGH, WALL = (0.1, 0.3), (0.4, 0.6), (0.1, 0.6)
DOWN, Y = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
CROSSINGS = (1, 3)  # Segments in which the surface changes.
# Distance of the corners on which the tool stands from its centre, along y [m].
FEET = {"block": 0.012, "sphere": 0.0}
# Length over which a sphere's crossing of a seam shows in the features: it crosses at
# one point, but the features are averages [m].
SPHERE_CROSSING = 0.01


@dataclass
class Anticipation:
    """What a trial uses of the last one's knowledge about changes without impact."""

    # Whether a change of surface is expected where it was in the last trial, and met
    # with the stiffness K_max.
    places: bool = True
    # Whether the mode behind an expected change is known from the last trial: its
    # forward model is used at once.
    models: bool = True


def _control() -> ChangingContactConfig:
    """The defaults, with hints given early by the time that they take to reach the arm:
    5 to 10 ms through the estimators, 1 ms to the impedance controller, 5 ms for the
    filter of the feed-forward. The force on wall and stop is released within 30 ms:
    while it fades, the tool stays there, and the reference moves on."""
    config = ChangingContactConfig(
        forward_model=friction_from_rest(),
        mean_wrench=True,
        hybrid=HybridConfig(damping_ratio=0.9, release_sec=0.03),
    )
    return replace(config, anticipator=replace(config.anticipator, hint_lead_sec=0.014))


@dataclass
class SurfaceSwitchConfig:
    """Settings of `makebreak run surface_switch`."""

    # Seed of the frictions, the initial estimates, the station's errors and the noise.
    seed: int = 0
    tool: str = "block"  # Tool on the arm: block or sphere.
    trials: int = 3  # Number of trials, each with what the one before has learned.
    speed: float = 0.1  # Speed of sliding over the surfaces [m/s].
    normal_force: float = 8.0  # Normal force on each surface that has been reached [N].
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Coefficients of friction of surface 1, of surface 2, and of wall and stop; empty:
    # drawn by the seed.
    friction: list[float] = field(default_factory=list)
    model: str = ""  # Scene file of the controllers' model; empty: the shipped one.
    # Number of trials that are simulated in the model before the first real one.
    rehearse: int = 0
    anticipation: Anticipation = field(default_factory=Anticipation)
    control: ChangingContactConfig = field(default_factory=_control)


@dataclass(frozen=True, eq=False)
class SwitchTask:
    """World, motion and prior, which all trials of one seed share."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    prior: ContactBelief  # Initial estimate of the three contacts.
    friction: np.ndarray  # (3,) of surface 1, of surface 2, of wall and stop.
    errors: StationErrors
    feet: float  # From the tip to the corners it stands on, along y [m].


def make_task(config: SurfaceSwitchConfig) -> SwitchTask:
    """World, motion and prior of config.seed.

    Raises: ValueError for an unknown tool or a setting out of range.
    """
    for name in ("trials", "speed", "normal_force"):
        value = getattr(config, name)
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} is {value}, expected a positive number")
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}, expected an integer of 0 or more")
    refuse_unused_control(config, SurfaceSwitchConfig())
    if config.trials == 1 and not config.rehearse:
        why = "nothing is known in a first trial"
        refuse_unused(config, SurfaceSwitchConfig(), "anticipation", why)
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
    # Segment, direction and true coordinate of the contacts with table, wall and stop.
    contacts = [
        (0, DOWN, half),
        (1, Y, position(world, "red_block")[1] - half),
        (3, -Y, position(world, "stop")[1] + half),
    ]
    prior = []
    for segment, d, place in contacts:
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
    """Down, to the wall, along it, back to the stop, and along that for a short way.

    Args: half: half width of the tool [m].
    """
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
        # The last segment is short, so half the speed is enough.
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
    """The knowledge that the next trial uses: all, or less for comparison."""
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
    """The diagram of one trial.

    Args: knowledge: from the trial before, None: the prior alone; trial: its number,
        for the noise's seed.
    """
    control = config.control
    modes, models = control.modes, control.forward_model
    # The length of a crossing follows from the tool's own geometry.
    if not task.feet:
        refuse_changed("control.modes", modes, ("crossing",))
    crossing = modes.crossing if task.feet else SPHERE_CROSSING
    refuse_changed("forward_model.handover", models.handover, ("rows", "height"))
    height = tool_half_width(config.tool) if task.feet else 0.0
    handover = replace(models.handover, rows=2.0 * task.feet, height=height)
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
