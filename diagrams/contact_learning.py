"""Positions of three contacts, learned over trials (CC 4.5.1, fig. 17, 18, table 1).

A block comes down on a table, slides along it to a wall, and along both to a second
wall. At first the positions of the three surfaces are known to 0.1 m; each trial starts
with what the last one learned. The seed draws the surfaces' positions (within 5 cm),
frictions (0.1 to 0.6) and stiffnesses, and the signs of the initial errors.
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from makebreak.diagrams.changing_contact import (
    ChangingContactConfig,
    Knowledge,
    make_changing_contact,
    refuse_unused_control,
)
from makebreak.diagrams.realism import StationErrors, draw_errors
from makebreak.diagrams.tabletop import (
    SPREAD,
    STIFFNESS_RANGE,
    TABLETOP_WALLS,
    TOOL,
    check_spread,
    draw_stiffness,
    frictions,
    move,
    objects,
    position,
    read_model,
    set_friction,
    set_stiffness,
    set_tool,
    tool_corner,
    tool_half_width,
)
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.changing_contact.contact_anticipator import (
    ApproachSpeedConfig,
    ContactAnticipatorConfig,
    FirstApproachConfig,
)
from makebreak.systems.changing_contact.contact_detector import ContactDetectorConfig
from makebreak.systems.changing_contact.impact_reflex import ImpactReflexConfig
from makebreak.systems.changing_contact.numerics.contact_task import (
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    segment_time,
)
from makebreak.systems.changing_contact.velocity_shaper import (
    RegionConfig,
    VelocityShaperConfig,
)

SURFACES = ("table", "red_block", "blue_wall")  # Of contacts 1, 2, 3.
# Direction of the motion into each contact, in the world.
DIRECTIONS = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
ERRORS = (0.12, 0.09, 0.10)  # Of the initial estimates, along DIRECTIONS [m].
SIGMA = 0.08  # Standard deviation of the initial estimates [m].
FRICTION = (0.1, 0.6)  # Range.
START = (0.42, -0.16, 0.195)  # Initial position of the tip in the world [m].
BEYOND = 0.06  # Distance by which the motion pattern aims behind each surface [m].
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # Of the tip's frame: the flange straight down.
BACK = 0.03  # Length of the last segment, in which the third contact is held [m].


@dataclass
class ContactLearningConfig:
    """Settings of `makebreak run contact_learning`."""

    seed: int = 0  # Seed of the world, the initial estimates and the noise.
    tool: str = "block"  # Tool on the arm: block or sphere.
    trials: int = 5  # Number of trials, each with what the one before has learned.
    speed: float = 0.25  # Speed of the motion where no contact is expected [m/s].
    normal_force: float = 8.0  # Normal force on each surface that has been reached [N].
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Range from which each surface's contact stiffness is drawn, log-uniformly [N/m].
    stiffness: list[float] = field(default_factory=lambda: list(STIFFNESS_RANGE))
    # Largest displacement of table, red block and blue wall in the world from their
    # places in the scene file [m]; at most 0.05.
    spread: float = SPREAD
    # Coefficients of friction of table, red block and blue wall; empty: drawn by the
    # seed.
    friction: list[float] = field(default_factory=list)
    model: str = ""  # Scene file of the controllers' model; empty: the shipped one.
    # Number of trials that are simulated in the model before the first real one.
    rehearse: int = 0
    control: ChangingContactConfig = field(
        default_factory=lambda: ChangingContactConfig(
            anticipator=ContactAnticipatorConfig(
                speed=ApproachSpeedConfig(
                    first=FirstApproachConfig(stiffness_most=STIFFNESS_RANGE[1]),
                    growth=10.0,
                )
            ),
            # Contacts are located to 0.1 mm here, so a smaller margin will do.
            shaper=VelocityShaperConfig(region=RegionConfig(margin=0.002)),
            detector=ContactDetectorConfig(impact_force=1.0),
            reflex=ImpactReflexConfig(gain=4.0, force_least=2.0, force_known=8.0),
        )
    )


@dataclass(frozen=True, eq=False)
class ContactTask:
    """World, motion and prior, which all trials of one seed share."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    truth: np.ndarray  # (3, 3) p_WE at each contact [m]; counts along its direction.
    prior: ContactBelief  # Initial estimate, wrong by ERRORS.
    model_prior: ContactBelief  # Initial estimate from the model scene.
    friction: np.ndarray  # (3,)
    stiffness: dict[str, float]  # Of the tool against each surface [N/m].
    errors: StationErrors
    corner: float  # From the tip to the tool's corners, in x and in y; 0: none [m].


def make_task(config: ContactLearningConfig) -> ContactTask:
    """World, motion and prior of config.seed.

    Raises: ValueError for an unknown tool or a setting out of range.
    """
    for name in ("trials", "speed", "normal_force"):
        value = getattr(config, name)
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} is {value}, expected a positive number")
    check_spread(config.spread)
    refuse_unused_control(config, ContactLearningConfig())
    rng = np.random.default_rng([config.seed, 3])
    model = read_model(config.model, TABLETOP_WALLS, config.tool)
    world = read_scene(TABLETOP_WALLS)
    set_tool(world, config.tool)
    half = tool_half_width(config.tool)
    friction = frictions(config.friction, rng.uniform(*FRICTION, size=3))
    set_friction(world, dict(zip(SURFACES, friction.tolist(), strict=True)))
    shift = rng.uniform(-config.spread, config.spread, size=3)
    for name in objects(world):  # All stand on the table.
        move(world, name, [0.0, 0.0, -shift[0]])
    move(world, "red_block", shift[1] * DIRECTIONS[1])
    move(world, "blue_wall", shift[2] * DIRECTIONS[2])
    places = np.array([position(world, name) for name in SURFACES])
    truth = np.array(START) * np.ones((3, 1))
    pattern = make_pattern(config, half)
    for i, d in enumerate(DIRECTIONS):
        axis = int(np.argmax(abs(d)))
        # This coordinate holds for the later contacts too: the tool stays in contact.
        truth[i:, axis] = places[i, axis] - half * d[axis]
    prior: list[ExpectedContact] = []
    modelled: list[ExpectedContact] = []
    for i, d in enumerate(DIRECTIONS):
        mean = pattern.segments[i].positions[0].copy()
        sign = rng.choice([-1.0, 1.0])
        axis = int(np.argmax(abs(d)))
        model_mean = mean.copy()
        model_mean[axis] = position(model, SURFACES[i])[axis] - half * d[axis]
        mean[axis] = truth[i, axis] + sign * ERRORS[i]
        for contacts, p in ((prior, mean), (modelled, model_mean)):
            contacts.append(ExpectedContact(p, SIGMA**2 * np.eye(3), d, segment=i))
    stiffness = draw_stiffness(rng, SURFACES, config.stiffness)
    set_stiffness(world, config.tool, stiffness)
    return ContactTask(
        world,
        model,
        pattern,
        truth,
        ContactBelief(tuple(prior)),
        ContactBelief(tuple(modelled)),
        friction,
        stiffness,
        draw_errors(config.realism, config.seed),
        tool_corner(config.tool),
    )


def make_pattern(config: ContactLearningConfig, half: float) -> MotionPattern:
    """Down, to the left, forwards, then back a little, BEYOND each nominal surface.

    Args: half: half width of the tool [m].
    """
    scene = read_scene(TABLETOP_WALLS)
    corners, p = [np.array(START)], np.array(START)
    for name, d in zip(SURFACES, DIRECTIONS, strict=True):
        axis = int(np.argmax(abs(d)))
        p = p.copy()
        p[axis] = position(scene, name)[axis] + (BEYOND - half) * d[axis]
        corners.append(p)
    corners.append(p - BACK * DIRECTIONS[1])
    forces: tuple[list[np.ndarray], ...] = (
        [],
        [DIRECTIONS[0]],
        [DIRECTIONS[0], DIRECTIONS[1]],
        [DIRECTIONS[0], DIRECTIONS[2]],
    )
    segments, time = [], 0.0
    a_max = 1.0
    for k, n in enumerate(forces):
        length = float(np.linalg.norm(corners[k + 1] - corners[k]))
        last = k == len(forces) - 1
        speed = min(0.1, config.speed) if last else config.speed
        duration = segment_time(length, speed, a_max, stops=last)
        segments.append(
            Segment(
                "line",
                np.array(corners[k : k + 2]),
                np.array([time, time + duration]),
                quaternions=np.array(UPRIGHT),
                force_directions=np.array(n).reshape(-1, 3),
                force_targets=np.full(len(n), config.normal_force),
            )
        )
        time += duration
    return MotionPattern(tuple(segments), acceleration_max=a_max)


def make_contact_learning(
    config: ContactLearningConfig,
    task: ContactTask,
    knowledge: Knowledge | None = None,
    trial: int = 0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The diagram of one trial.

    Args: knowledge: from the trial before, None: the prior alone; trial: its number,
        for the noise's seed.
    """
    return make_changing_contact(
        config.control,
        task.world,
        task.model,
        task.pattern,
        knowledge or Knowledge(contacts=task.prior),
        tool=TOOL,
        seed=1000 * config.seed + trial,
        meshcat=meshcat,
        errors=task.errors,
    )
