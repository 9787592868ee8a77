"""Where to touch: places around an object, each with the plan that begins there.

A tip that pushes an object can start anywhere around it. Each place is scored by the
cost of a C3+ plan from there, with the tip at rest, rolled out (and polished) on the
true LCS, so that a plan that cannot be carried out does not look cheap; and by the way
to it through the air. C3 itself decides only how to go on from where the tip is: behind
a corner, or on the wrong side, it is stuck in a local minimum.

Source: the idea is that of Venkatesh, Bianchini, Aydinoglu, Yang, Posa, "Approximating
global contact-implicit MPC via sampling and local complementarity", arXiv:2505.13350.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem
from makebreak.systems.contact_mpc.numerics.object_frame import (
    heading_of,
    rotation_of,
    to_object,
    to_world,
    turned_inputs,
)
from makebreak.systems.contact_mpc.numerics.outline import (
    inward,
    outline_of,
    places_around,
)
from makebreak.systems.contact_mpc.numerics.plan_scores import NO_PLAN, score_within
from makebreak.systems.contact_mpc.numerics.tip_travel import travel_length

# From round to round the places move on by this share of their spacing: the golden
# section, which leaves no part of the contour out.
GOLDEN = 0.6180339887498949
PROGRESS = 0.003  # Less than this towards the goal is none [m].


@dataclass
class ReachConfig:
    """Where the arm reaches."""

    # Reach of the arm, [least, largest] [m]: least distance of the wrist from the arm's
    # base, nearer than which the elbow is at its limit, and largest of the tip.
    range: list[float] = field(default_factory=lambda: [0.41, 0.78])
    # Vector from the wrist to the tip, seen from above, where the tool's turn is held,
    # [x, y] [m]; push_object sets it.
    wrist: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Largest angle of a place from the x axis, along which the arm looks: beyond, the
    # path there may lead through the arm's own base [rad].
    bearing: float = 1.05
    # Cost of a plan that leads the tip out of reach, for each knot: it will not be
    # carried out as it is [1/m2].
    cost: float = 2e4
    # Length by which a plan may lead the wrist nearer than range[0] at no cost [m].
    inwards: float = 0.01


@dataclass
class ChangeConfig:
    """When the tip leaves a place for another one."""

    travel: float = 15.0  # Cost of a metre of the tip's path through the air [1/m].
    # Mean speed of the tip on such a path [m/s]. While the tip is away the object stays
    # where it is, which costs as much more as the present plan would have moved it.
    speed: float = 0.15
    # Time that is lost beside the path, to stop and to touch again [s].
    pause_sec: float = 0.25
    # Amount by which another place has to cost less than the present one, [fraction of
    # the present cost, absolute cost].
    hysteresis: list[float] = field(default_factory=lambda: [0.15, 1.0])
    # Time without progress after which the present place is given up [s].
    stuck_sec: float = 1.2
    keep_sec: float = 0.0  # Time for which a place that was reached is kept [s].


@dataclass
class SamplingConfig:
    """What a round of ContactSampler looks at, and what it prefers."""

    # Number of places sampled in a round, beside the present one and the last best.
    places: int = 14
    clearance: float = 0.004  # Clearance of the tip from the object at a place [m].
    height: float = 0.024  # Height of the tip's centre while it pushes [m].
    reach: ReachConfig = field(default_factory=ReachConfig)
    change: ChangeConfig = field(default_factory=ChangeConfig)
    # Force of the plan that is tried first, straight into the object [N].
    push: float = 4.0
    # Whether the tip arrives at a place with the velocity of the object, for one that
    # rolls on by itself; always so for a cylinder.
    follow: bool = False


@dataclass(frozen=True, eq=False)
class SamplingMemory:
    """What a round leaves to the next; places are in the object's frame (2,) [m]."""

    count: int = 0  # Rounds.
    place: np.ndarray | None = None  # Where to go, or where it went last.
    # The inputs (N, 3) that the place was chosen for, turned with the object [N].
    inputs: np.ndarray | None = None
    best: np.ndarray | None = None  # The best other place of the last round.
    go: int = 0  # How often a place was chosen: a new number is a new command.
    goal: tuple[float, ...] | None = None  # That the error is from.
    error: float = np.inf  # From the goal when there was progress last [m] ...
    since_sec: float = 0.0  # ... and when that was.
    reached_sec: float | None = None  # Since when the tip pushes; None: it travels.

    def __deepcopy__(self, memo) -> "SamplingMemory":
        return self  # Nothing in it is changed once it is there.


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """What is known of the object and the tip for finding places."""

    parts: list[np.ndarray]  # Convex parts: points (n, 3) [m] in the object's frame.
    tip_radius: float  # [m]
    top: float  # Height of the object's highest point on the table [m].

    def clear_height(self, margin: float) -> float:
        """At which the tip's centre is above the object by a margin [m]."""
        return self.top + self.tip_radius + margin


def in_reach(places, reach, bearing, wrist=(0.0, 0.0)):
    """(n,) whether a tip at places (n, 2) is at most reach[1] from the origin [m], its
    wrist, from which it is `wrist` (2,), at least reach[0], and the tip at most bearing
    from the x axis [rad]."""
    x, y = np.transpose(places)
    far = np.hypot(x, y) <= reach[1]
    near = np.hypot(x - wrist[0], y - wrist[1]) < reach[0]
    return far & ~near & (abs(np.arctan2(y, x)) <= bearing)


def out_of_reach(plans, reach, inwards, wrist=(0.0, 0.0)):
    """(n,) the sum of squares of how far in plans (n, N + 1, 19) the wrist is nearer
    than reach[0] - inwards to the origin, or the tip farther than reach[1] [m2]."""
    x, y = plans[:, :, P_TIP.start], plans[:, :, P_TIP.start + 1]
    of_wrist = np.hypot(x - wrist[0], y - wrist[1])
    too_near = np.maximum(reach[0] - inwards - of_wrist, 0.0)
    too_far = np.maximum(np.hypot(x, y) - reach[1], 0.0)
    return (too_near**2 + too_far**2).sum(axis=1)


def choose(cost, hysteresis):
    """Which place to take: the first (the present one), unless another is clearly
    better.

    Args: cost (n,); hysteresis: (share, absolute): how much less than the present one
        another has to cost, as a share of the present cost plus so much.
    Returns: index; the present one where nothing has a finite cost.
    """
    cost = np.where(np.isfinite(cost), cost, np.inf)
    best = int(np.argmin(cost))
    share, absolute = hysteresis
    if not np.isfinite(cost[best]) or cost[best] >= cost[0] * (1.0 - share) - absolute:
        return 0 if np.isfinite(cost[0]) or not np.isfinite(cost[best]) else best
    return best


@dataclass(frozen=True, eq=False)
class Round:
    """What a round found, for the eye and for scoring; n places."""

    places: np.ndarray  # (n, 2) in the world [m]; the first is the present one.
    cost: np.ndarray  # (n,) of plan and travel.
    chosen: int
    x: np.ndarray  # (N + 1, n_x) the plan from the chosen one.

    def __deepcopy__(self, memo) -> "Round":
        return self  # Nothing in it is changed once it is there.


def sample_round(
    config: SamplingConfig,
    memory: SamplingMemory,
    build_many: Callable,
    problem: C3Problem,
    shape: ObjectShape,
    x,
    x_desired,
    error: float,
    in_contact: bool,
    t: float,
    r=None,
    budget_sec: float = np.inf,
    nearer: float = 0.0,
    goal: tuple[float, ...] | None = None,
    dt_sec: float = 0.1,
) -> tuple[SamplingMemory, Round]:
    """One round of ContactSampler.

    Args:
        build_many: as AnitescuLcs.build_many, of the planner's model.
        x (19,), x_desired (N + 1, 19) of numerics/ball_state.py.
        error: of the object from its goal [m].
        in_contact: whether the tip pushes; else it is on its way to memory.place.
        t [s]; r (n_lam,): what is added to every LCS's c [m/s], None: nothing.
        budget_sec: of wall-clock time for the scores (score_within).
        nearer: by how much the object reaches farther out than its shape, as learned;
            the places lie as much farther out [m]; negative: as much farther in.
        goal: tells one goal from the next, whose error is another one.
        dt_sec: between the knots of a plan [s].
    Raises: ValueError for an object without an outline.
    """
    c, m = config, memory
    if goal != m.goal:
        m = replace(m, goal=goal, error=np.inf)
    outline = outline_of(shape.parts, rotation_of(x[Q_BALL]), x[P_BALL])
    distance = shape.tip_radius + c.clearance + nearer
    going = m.place is not None and not in_contact
    places = _places(c, m, x, outline, distance, going)
    starts = _starts(c, x, places, in_contact)
    lcs = build_many(starts, np.zeros(problem.n_u))
    if r is not None:
        lcs = (*lcs[:7], lcs[7] + r, *lcs[8:])
    heading = heading_of(x[Q_BALL])
    guess = np.zeros((len(places), problem.options.N, problem.n_u))
    guess[:, :, :2] = c.push * inward(places, outline)[:, None]
    if m.inputs is not None:
        # What it was chosen for counts again: whether the search finds as good a plan
        # in every round is chance, and the tip would turn round, or leave what it has
        # just touched, each time that it does not.
        guess[0] = turned_inputs(m.inputs, heading)
    cost, u, plans = score_within(budget_sec, lcs, starts, x_desired, problem, guess)
    way = _way_lengths(c, shape, x, places, outline, distance)
    if in_contact:
        way[0] = 0.0
    elif (
        not going
        or not in_reach(places[:1], c.reach.range, c.reach.bearing, c.reach.wrist)[0]
    ):
        cost[0] = NO_PLAN
    # Where the tip is now no plan can change.
    led_out = out_of_reach(plans[:, 1:], c.reach.range, c.reach.inwards, c.reach.wrist)
    cost = cost + c.change.travel * way + c.reach.cost * led_out
    m, is_stuck = _with_progress(c, m, error, in_contact, t)
    if is_stuck:
        cost[0] = NO_PLAN
    elif in_contact and np.isfinite(cost[0]):
        away = c.change.pause_sec + way[1:] / c.change.speed
        cost[1:] += _gain(problem, x, x_desired, plans[0]) * away / dt_sec
    keep = m.reached_sec is not None and t - m.reached_sec < c.change.keep_sec
    chosen = 0 if keep and np.isfinite(cost[0]) else choose(cost, c.change.hysteresis)
    m = replace(m, count=m.count + 1)
    known = np.isfinite(cost)
    if known[1:].any():
        m = replace(m, best=to_object(x, places[1 + int(np.argmin(cost[1:]))]))
    if known[chosen]:
        m = replace(m, inputs=turned_inputs(u[chosen], heading.T))
    if known[chosen] and chosen != 0:
        m = replace(m, place=to_object(x, places[chosen]), go=m.go + 1)
    return m, Round(places, cost, chosen, plans[chosen])


def _gain(problem: C3Problem, x, x_desired, plan) -> float:
    """How much less a knot costs with the object where a plan (N + 1, n_x) leads it,
    than with the object where it is; at least 0."""
    pose = slice(Q_BALL.start, P_BALL.stop)
    Q, _, goal = problem.state_cost(x, x_desired)
    off = plan[[0, -1], pose] - goal[0, pose]
    now, after = np.einsum("ki,ij,kj->k", off, Q[0][pose, pose], off)
    return max(float(now - after), 0.0)


def _places(
    c: SamplingConfig, m: SamplingMemory, x, outline, distance: float, going: bool
) -> np.ndarray:
    """(n, 2) in the world [m]: the present one, to which the tip is `going` or where it
    is; the last best one; new ones around the object. The others only within reach."""
    around = places_around(outline, distance, c.places, (m.count * GOLDEN) % 1.0)
    others = [around] if m.best is None else [to_world(x, m.best)[None], around]
    present = to_world(x, m.place) if going else x[P_TIP][:2]
    near = [
        each[in_reach(each, c.reach.range, c.reach.bearing, c.reach.wrist)]
        for each in others
    ]
    return np.concatenate([present[None], *near])


def _starts(c: SamplingConfig, x, places, in_contact: bool) -> np.ndarray:
    """(n, 19) the states from which is planned: the tip at each place, at rest, or with
    the object's velocity; in contact, the first is as things are."""
    starts = np.tile(x, (len(places), 1))
    starts[:, :2], starts[:, 2], starts[:, V_TIP] = places, c.height, 0.0
    if c.follow:
        starts[:, V_TIP.start : V_TIP.start + 2] = x[V_BALL][:2]
    if in_contact:
        starts[0] = x
    return starts


def _way_lengths(
    c: SamplingConfig, shape: ObjectShape, x, places, outline, distance: float
) -> np.ndarray:
    """(n,) of the ways from the tip to the places, through the air [m]."""
    high = shape.clear_height(0.0)
    ends = [np.array([*place, c.height]) for place in places]
    return np.array(
        [travel_length(x[P_TIP], end, outline, distance, high) for end in ends]
    )


def _with_progress(
    c: SamplingConfig, m: SamplingMemory, error: float, in_contact: bool, t: float
) -> tuple[SamplingMemory, bool]:
    """The memory of when there was progress last and since when the tip pushes; whether
    the present place is to be given up."""
    progressed = (
        not in_contact or error < m.error - PROGRESS or not np.isfinite(m.error)
    )
    is_stuck = not progressed and t - m.since_sec > c.change.stuck_sec
    if progressed or is_stuck:
        m = replace(m, error=error, since_sec=t)
    if not in_contact:
        m = replace(m, reached_sec=None)
    elif m.reached_sec is None:
        m = replace(m, reached_sec=t)
    return m, is_stuck
