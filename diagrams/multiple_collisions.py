"""A sequence of contacts made and lost (CC section 4.5.1, figures 15 and 16).

Down onto the table, along it to the red block, along both to the blue wall, up this
wall until it ends, free over the red block, down onto its top, along it to the goal:
four impacts and one loss of contact. The positions of the contacts are estimates with
errors, as from a camera. The seed draws the surfaces' positions (within 5 cm), their
frictions (0.1 to 0.6) and the errors of the estimates.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from makebreak.diagrams.changing_contact import (
    ChangingContactConfig,
    Knowledge,
    make_changing_contact,
    refuse_unused_control,
)
from makebreak.diagrams.given_pattern import expected_contacts, start_at_pattern
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
from makebreak.diagrams.wiring import refuse_unused
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
from makebreak.systems.views.contact_view import ContactViewConfig

SURFACES = ("table", "red_block", "blue_wall")
DOWN, LEFT, AHEAD = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
# The impacts: direction of the motion, surface, and the segment that the impact ends.
IMPACTS = ((DOWN, "table", 0), (LEFT, "red_block", 1), (AHEAD, "blue_wall", 2),
           (DOWN, "red_top", 6))  # fmt: skip
START = (0.42, -0.16, 0.195)  # Initial position of the tip in the world [m].
RED_TOP, BLUE_TOP = 0.06, 0.09  # Heights above the table [m].
FRICTION = (0.1, 0.6)  # Range.
BEYOND = 0.06  # Distance by which the motion pattern aims behind each surface [m].
CLEAR = 0.05  # Height above the blue wall's top at which the motion turns [m].
OVER, BACK, GOAL = 0.08, 0.05, 0.12  # Over the red block, and along its top [m].
NORMAL_FORCE = 5.0  # On each surface that has been reached [N].
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # Of the tip's frame: the flange straight down.
TABLE, TOP = 0, 3  # Which of IMPACTS are with the table, with the red block's top.
# Of the height of the block's top above the table [m]: sizes are known to a millimetre,
# and a table that is tilted by 0.5 degrees rises by 4 mm on the way there.
HEIGHT_STD = 0.002
A_MAX = 1.0  # Of the pattern [m/s2].
# Largest approach speed [m/s]: stopping from 0.03 m/s takes 1 m/s2 (low-pass, 10 Hz),
# the goal for the acceleration.
APPROACH_SPEED_MAX = 0.03


@dataclass
class MultipleCollisionsConfig:
    """Settings of `makebreak run multiple_collisions`."""

    # Whether contacts are anticipated and met by transition-phase controllers; false:
    # the base controller alone, at full speed.
    handling: bool = True
    tool: str = "sphere"  # Tool on the arm: sphere or block.
    speed: float = 0.2  # Speed of the motion where no contact is expected [m/s].
    # Largest error of the initial estimate of each contact, along the motion [m].
    error_max: float = 0.03
    # Range from which each surface's contact stiffness is drawn, log-uniformly [N/m].
    stiffness: list[float] = field(default_factory=lambda: list(STIFFNESS_RANGE))
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    trials: int = 2  # Number of trials, each with what the one before has learned.
    seed: int = 0  # Seed of the world, the initial estimates and the noise.
    # Largest displacement of table, red block and blue wall in the world from their
    # places in the scene file [m]; at most 0.05.
    spread: float = SPREAD
    # Coefficients of friction of table, red block and blue wall; empty: drawn by the
    # seed.
    friction: list[float] = field(default_factory=list)
    # Whether the sizes of the model's objects are used: the red block stands on the
    # table, so the contact with the table tells where the block's top is.
    known_heights: bool = True
    # File of a motion to follow in place of the shipped one: a pattern (.yaml) or a
    # recorded demonstration (docs/shaping.md); speed has no meaning then.
    pattern: str = ""
    model: str = ""  # Scene file of the controllers' model; empty: the shipped one.
    # Number of trials that are simulated in the model before the first real one.
    rehearse: int = 0
    control: ChangingContactConfig = field(
        default_factory=lambda: ChangingContactConfig(
            anticipator=ContactAnticipatorConfig(
                speed=ApproachSpeedConfig(
                    force_desired=7.0,
                    # The reflex is too late on the stiffest surfaces: 10 N at most.
                    first=FirstApproachConfig(
                        stiffness_most=STIFFNESS_RANGE[1], force=8.0
                    ),
                    most=APPROACH_SPEED_MAX,
                    growth=4.0,  # The first measured impact decides already.
                )
            ),
            shaper=VelocityShaperConfig(
                acceleration_max=0.85,
                region=RegionConfig(margin=0.001, settle_sec=0.05),
            ),
            detector=ContactDetectorConfig(impact_force=1.0),
            # With less force_least the stop is so soft that it looks like friction.
            reflex=ImpactReflexConfig(gain=4.0, force_least=2.0),
        )
    )


@dataclass(frozen=True, eq=False)
class CollisionTask:
    """World, motion and prior, which all trials of one seed share."""

    world: Scene
    model: Scene
    pattern: MotionPattern
    prior: ContactBelief  # Initial estimate.
    model_prior: ContactBelief  # Initial estimate from the model scene.
    # (4,) p_WE . direction at each impact [m]; (0,) of a given motion.
    truth: np.ndarray
    friction: dict[str, float]
    stiffness: dict[str, float]  # Of the tool against each surface [N/m].
    errors: StationErrors
    corner: float  # From the tip to the tool's corners, in x and in y; 0: none [m].


def make_task(
    config: MultipleCollisionsConfig, given: MotionPattern | None = None
) -> CollisionTask:
    """World, motion and prior of config.seed.

    Args: given, the motion of config.pattern, if that is not empty. Its contacts are
        expected where its segments end.
    Raises: ValueError for an unknown tool, a setting out of range, or a motion that the
        arm cannot follow.
    """
    if bool(config.pattern) != (given is not None):
        raise ValueError(
            f'pattern is "{config.pattern}", expected the motion of that file beside it'
        )
    for name in ("trials", "speed"):
        if not 0.0 < getattr(config, name) < np.inf:
            raise ValueError(
                f"{name} is {getattr(config, name)}, expected a positive number"
            )
    if not 0.0 <= config.error_max <= 0.1:
        raise ValueError(f"error_max is {config.error_max}, expected 0 to 0.1 m")
    check_spread(config.spread)
    _refuse_unused(config)
    rng = np.random.default_rng([config.seed, 5])
    half = tool_half_width(config.tool)
    model = read_model(config.model, TABLETOP_WALLS, config.tool)
    world = read_scene(TABLETOP_WALLS)
    set_tool(world, config.tool)
    drawn = frictions(config.friction, rng.uniform(*FRICTION, size=3))
    friction = dict(zip(SURFACES, drawn.tolist(), strict=True))
    set_friction(world, friction)
    up, left, ahead = rng.uniform(-config.spread, config.spread, size=3)
    for name in objects(world):  # All stand on the table.
        move(world, name, [0.0, 0.0, up])
    move(world, "red_block", left * LEFT)
    move(world, "blue_wall", ahead * AHEAD)
    truth = surfaces(world, half)
    prior: list[ExpectedContact] = []
    modelled: list[ExpectedContact] = []
    sigma = max(0.5 * config.error_max, 0.001)
    # Uniform errors up to error_max: two standard deviations contain them all.
    covariance = sigma**2 * np.eye(3)
    shipped = make_pattern(config, half)
    for (d, _, k), in_world, in_model in zip(
        IMPACTS, truth, surfaces(model, half), strict=True
    ):
        estimate = in_world + rng.uniform(-config.error_max, config.error_max)
        start = shipped.segments[k].positions[0]
        for contacts, along in ((modelled, in_model), (prior, estimate)):
            mean = start + d * (along - start @ d)
            contacts.append(ExpectedContact(mean, covariance, d, segment=k))
    if config.known_heights:
        heights = surfaces(model, half)[TOP] - surfaces(model, half)[TABLE]
        prior = with_known_height(prior, float(heights), config.error_max)
        modelled = with_known_height(modelled, float(heights), config.error_max)
    stiffness = draw_stiffness(rng, SURFACES, config.stiffness)
    set_stiffness(world, config.tool, stiffness)
    if given is not None:  # The world is the seed's, whatever moves in it.
        start_at_pattern(given, world, model, TOOL)
        there = expected_contacts(given, sigma)
        prior, modelled, truth = [*there.contacts], [*there.contacts], np.zeros(0)
    return CollisionTask(
        world,
        model,
        shipped if given is None else given,
        ContactBelief(tuple(prior)),
        ContactBelief(tuple(modelled)),
        truth,
        friction,
        stiffness,
        draw_errors(config.realism, config.seed),
        tool_corner(config.tool),
    )


def _refuse_unused(config: MultipleCollisionsConfig) -> None:
    """Raises: ValueError for settings that nothing reads without handling, or with a
    motion of the user's own."""
    plain, unused = MultipleCollisionsConfig(), []
    refuse_unused_control(config, plain)
    if not config.handling:
        region = ("sigmas", "margin", "settle_sec", "anticipate")
        impedance = ("transition", "blend_sec", "stiffness.impact")
        unused = [
            "trials",
            "control.shaper.search.speed",
            *(f"control.shaper.region.{name}" for name in region),
            *(f"control.variable_impedance.{name}" for name in impedance),
            *(f"control.reflex.{name}" for name in ("gain", "force_max", "fade_sec")),
        ]
        if not config.rehearse:  # Then no contact is expected.
            unused += ["error_max", "known_heights"]
    for name in unused:
        refuse_unused(config, plain, name, "not used with handling=false")
    if config.pattern:
        why = "not used with a pattern of your own"
        refuse_unused(config, plain, "known_heights", why)


def with_known_height(contacts, distance: float, error_max: float):
    """The contacts, where it is known how far the block's top is from the table.

    Both estimates are estimates of one height then. Each is at most error_max off, so
    it lies where both ranges overlap: the middle of that is the new estimate, and two
    standard deviations are half its width. Estimates that contradict each other stay as
    they are. In a trial the contact with the table decides (`known_from`).

    Args: contacts, of IMPACTS; distance from the table to the top along DOWN [m].
    """
    table, top = contacts[TABLE], contacts[TOP]
    means = table.mean @ DOWN, top.mean @ DOWN - distance
    low = max(means) - error_max - 2.0 * HEIGHT_STD * (means[1] > means[0])
    high = min(means) + error_max + 2.0 * HEIGHT_STD * (means[1] < means[0])
    found = list(contacts)
    sigma = np.sqrt(DOWN @ table.covariance @ DOWN)
    if low < high:
        sigma = max(0.25 * (high - low), 0.001)
        middle = 0.5 * (low + high)
        found[TABLE] = replace(
            table,
            mean=table.mean + DOWN * (middle - table.mean @ DOWN),
            covariance=sigma**2 * np.eye(3),
        )
        top = replace(
            top,
            mean=top.mean + DOWN * (middle + distance - top.mean @ DOWN),
            covariance=np.hypot(sigma, HEIGHT_STD) ** 2 * np.eye(3),
        )
    known = (IMPACTS[TABLE][2], distance, HEIGHT_STD)
    found[TOP] = replace(top, known_from=known)
    return found


def surfaces(scene: Scene, half: float) -> np.ndarray:
    """p_WE . direction at each of the four impacts (4,) [m].

    Args: half: half width of the tool [m].
    """
    table, red, blue = (position(scene, name) for name in SURFACES)
    return np.array([
        DOWN @ table - half,
        LEFT @ red - half,
        AHEAD @ blue - half,
        DOWN @ red - RED_TOP - half,
    ])  # fmt: skip


def make_pattern(config: MultipleCollisionsConfig, half: float) -> MotionPattern:
    """The motion, planned for the surfaces of the scene file. Segments that end in an
    impact aim BEYOND the surface, so that the tool reaches it at full speed.

    Args: half: half width of the tool [m].
    """
    z_table, y_red, x_blue, z_top = (
        abs(x) for x in surfaces(read_scene(TABLETOP_WALLS), half)
    )
    p0 = np.array(START)
    p1 = np.array([p0[0], p0[1], z_table])
    p2 = np.array([p0[0], y_red, z_table])
    p3 = np.array([x_blue, y_red, z_table])
    p4 = np.array([x_blue, y_red, BLUE_TOP + half])
    p5 = p4 + [0.0, 0.0, CLEAR]
    p6 = p5 + [-BACK, OVER, 0.0]
    p7 = np.array([p6[0], p6[1], z_top])
    p8 = p7 + [-GOAL, 0.0, 0.0]
    plan: tuple = (  # Start, end, force directions, direction of its impact or None.
        (p0, p1, [], DOWN),
        (p1, p2, [DOWN], LEFT),
        (p2, p3, [DOWN, LEFT], AHEAD),
        (p3, p4, [AHEAD], None),
        (p4, p5, [], None),
        (p5, p6, [], None),
        (p6, p7, [], DOWN),
        (p7, p8, [DOWN], None),
    )
    segments, time, moving = [], 0.2, False
    for k, (start, end, n, into) in enumerate(plan):
        if into is not None:
            end = end + BEYOND * into
        length = float(np.linalg.norm(end - start))
        goes_on = k == 3  # Segments 3 and 4 are one line: no stop between.
        duration = segment_time(
            length, config.speed, A_MAX, not moving, into is None and not goes_on
        )
        segments.append(
            Segment(
                "line",
                np.array([start, end]),
                np.array([time, time + duration]),
                np.array(UPRIGHT),
                np.array(n).reshape(-1, 3),
                np.full(len(n), NORMAL_FORCE),
            )
        )
        time, moving = time + duration, goes_on
    return MotionPattern(tuple(segments), acceleration_max=A_MAX)


def make_multiple_collisions(
    config: MultipleCollisionsConfig,
    knowledge: Knowledge | None = None,
    trial: int = 0,
    meshcat: Meshcat | None = None,
    task: CollisionTask | None = None,
    view: ContactViewConfig | None = None,
) -> Diagram:
    """The diagram of one trial.

    Without config.handling no contact is anticipated, the motion keeps its speed where
    the plan ends, and the base controller alone meets the contacts.

    Args: knowledge: from the trial before; None: the prior. trial: its number, for the
        noise's seed. task: of make_task, None: made here. view: of Meshcat.
    """
    task = task or make_task(config)
    control = config.control
    if knowledge is None:
        knowledge = Knowledge(task.prior if config.handling else ContactBelief())
    if not config.handling:
        control = replace(
            control,
            shaper=replace(
                control.shaper,
                region=replace(control.shaper.region, anticipate=False),
                search=replace(control.shaper.search, speed=config.speed),
            ),
            variable_impedance=replace(control.variable_impedance, transition=False),
            reflex=ImpactReflexConfig(force_least=control.reflex.force_least),
        )
    return make_changing_contact(
        control, task.world, task.model, task.pattern, knowledge, TOOL,
        seed=100 * config.seed + trial, meshcat=meshcat, view=view,
        errors=task.errors,
    )  # fmt: skip
