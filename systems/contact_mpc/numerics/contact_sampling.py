"""Where to touch: places around an object, each with the plan that begins there.

A tip that pushes an object can start anywhere around it. Each place is scored by the
cost of a C3+ plan from there, with the tip at rest, rolled out (and polished) on the
true LCS, so that a plan that cannot be carried out does not look cheap; and by the way
to it through the air. C3 itself decides only how to go on from where the tip is: behind
a corner, or on the wrong side, it is stuck in a local minimum.

All LCS of a round have the same object, so they and their solves are made in compiled
batches. Each is what AnitescuLcs.build and solve_c3 give, one by one.

Source: the idea is that of Venkatesh, Bianchini, Aydinoglu, Yang, Posa, "Approximating
global contact-implicit MPC via sampling and local complementarity", arXiv:2505.13350.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from os import getpid
from time import perf_counter

import numpy as np
from numba import get_num_threads, njit

from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.c3_admm import (
    admm_plus,
    compiled_once,
    scaled_model,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem
from makebreak.systems.contact_mpc.numerics.c3_polish import polish
from makebreak.systems.contact_mpc.numerics.lcp import SOLVED, solve_lcp_kernel

# Of a place that is not wanted, or whose plan failed.
NO_PLAN = np.inf
# From round to round the places move on by this share of their spacing: the golden
# section, which leaves no part of the contour out.
GOLDEN = 0.6180339887498949
BRAKE = 0.6  # Share of the acceleration that a travelling tip is to brake with.
# Around an object the tip looks so far ahead [rad], and keeps so much more away [m].
AROUND, AROUND_MARGIN = 0.35, 0.003
PROGRESS = 0.003  # Less than this towards the goal is none [m].


@dataclass
class SamplingConfig:
    """What a round of ContactSampler looks at, and what it prefers."""

    # Number of places sampled in a round, beside the present one and the last best.
    places: int = 14
    clearance: float = 0.004  # Clearance of the tip from the object at a place [m].
    height: float = 0.024  # Height of the tip's centre while it pushes [m].
    # Reach of the arm, [least, largest] [m]: least distance of the wrist from the arm's
    # base, nearer than which the elbow is at its limit, and largest of the tip.
    reach: list[float] = field(default_factory=lambda: [0.41, 0.78])
    # Vector from the wrist to the tip, seen from above, where the tool's turn is held,
    # [x, y] [m]; push_object sets it.
    wrist: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Largest angle of a place from the x axis, along which the arm looks: beyond, the
    # path there may lead through the arm's own base [rad].
    bearing: float = 1.05
    # Cost of a plan that leads the tip out of reach, for each knot: it will not be
    # carried out as it is [1/m2].
    out_of_reach: float = 2e4
    # Length by which a plan may lead the wrist nearer than reach[0] at no cost [m].
    inwards: float = 0.01
    travel: float = 15.0  # Cost of a metre of the tip's path through the air [1/m].
    # Amount by which another place has to cost less than the present one, [fraction of
    # the present cost, absolute cost].
    hysteresis: list[float] = field(default_factory=lambda: [0.15, 1.0])
    # Force of the plan that is tried first, straight into the object [N].
    push: float = 4.0
    # Time without progress after which the present place is given up [s].
    stuck_sec: float = 1.2
    # Whether the tip arrives at a place with the velocity of the object, for one that
    # rolls on by itself; always so for a cylinder.
    follow: bool = False
    keep_sec: float = 0.0  # Time for which a place that was reached is kept [s].


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


def outline_of(parts, R, p):
    """The outline of an object on the table, seen from above.

    Args: parts: convex parts of the object, the points (n, 3) [m] of each in its own
        frame; R (3, 3), p (3,) [m]: how and where that is.
    Returns: a list of convex polygons (m, 2) [m], counter-clockwise.
    Raises: ValueError for a part without area.
    """
    outline = [_hull_from_above(points, R, p) for points in parts]
    if any(len(polygon) < 3 for polygon in outline):
        raise ValueError("a part of the object has no area from above")
    return outline


@njit(cache=True)
def _hull_from_above(points, R, p):
    """Andrew's monotone chain; corners of less than 1e-12 m2 are left out."""
    n = len(points)
    plan = np.empty((n, 2))
    for i in range(n):
        for k in range(2):
            plan[i, k] = p[k]
            for j in range(3):
                plan[i, k] += R[k, j] * points[i, j]
    # Points of one x, but for rounding, in the order of y.
    order = np.argsort(plan[:, 1], kind="mergesort")
    x = np.round(plan[order, 0], 9)
    order = order[np.argsort(x, kind="mergesort")]
    hull, size = np.empty((2 * n + 1, 2)), 0
    for way in range(2):
        first = size
        for step in range(n):
            at = plan[order[step if way == 0 else n - 1 - step]]
            while size > first + 1:
                a, b = hull[size - 2], hull[size - 1]
                area = (b[0] - a[0]) * (at[1] - a[1]) - (b[1] - a[1]) * (at[0] - a[0])
                if area > 1e-12:
                    break
                size -= 1
            hull[size] = at
            size += 1
        size -= 1  # The last point begins the way back.
    return hull[:size].copy()


def distance_to_outline(points, outline):
    """(n,) how far points (n, 2) are outside of an outline [m]; negative inside: how
    deep in its deepest part."""
    points = np.ascontiguousarray(np.atleast_2d(points), dtype=float)
    nearest = np.full(len(points), np.inf)
    for polygon in outline:
        _lower_to_polygon(points, polygon, nearest)
    return nearest


@njit(cache=True)
def _lower_to_polygon(points, polygon, nearest):
    m = len(polygon)
    for i in range(len(points)):
        inside, beside = -np.inf, np.inf
        for k in range(m):
            a, b = polygon[k], polygon[(k + 1) % m]
            ex, ey = b[0] - a[0], b[1] - a[1]
            x, y = points[i, 0] - a[0], points[i, 1] - a[1]
            length = np.sqrt(ex * ex + ey * ey)
            inside = max(inside, (x * ey - y * ex) / length)
            share = min(max((x * ex + y * ey) / length**2, 0.0), 1.0)
            off = np.sqrt((x - share * ex) ** 2 + (y - share * ey) ** 2)
            beside = min(beside, off)
        nearest[i] = min(nearest[i], beside if inside > 0.0 else inside)


def places_around(outline, distance, n, phase=0.0):
    """Places on the contour at some distance around an outline, evenly along it.

    Args: outline: convex polygons (m, 2) [m]; distance [m] > 0; n: how many; phase: in
        [0, 1), where the first is, as a share of the spacing.
    Returns: (n, 2) [m]; fewer where other parts are nearer than the distance.
    """
    starts, ends = [], []
    for polygon in outline:
        nxt = np.roll(polygon, -1, axis=0)
        edge = nxt - polygon
        out = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        out *= distance / np.hypot(*edge.T)[:, None]
        starts += [polygon + out, nxt + out]  # Each side, and the bend behind it.
        ends += [nxt + out, nxt + np.roll(out, -1, axis=0)]
        starts[-2:] = [np.stack(starts[-2:], axis=1).reshape(-1, 2)]
        ends[-2:] = [np.stack(ends[-2:], axis=1).reshape(-1, 2)]
    start, end = np.concatenate(starts), np.concatenate(ends)
    # Finely first, to know how much of the contour is free of the other parts.
    length = np.hypot(*(end - start).T)
    whole = length.sum()
    fine = (np.arange(40 * n) + 0.5) / (40 * n) * whole
    free = _pushed_out(_along(start, end, length, fine), outline, distance)
    free = free[distance_to_outline(free, outline) >= distance - 1e-9]
    if len(free) == 0:
        return free
    at = ((np.arange(n) + phase) * len(free) / n).astype(int)
    return free[np.unique(np.minimum(at, len(free) - 1))]


def _along(start, end, length, s):
    upto = np.cumsum(length)
    k = np.minimum(np.searchsorted(upto, s), len(upto) - 1)
    share = (s - upto[k] + length[k]) / np.maximum(length[k], 1e-12)
    return start[k] + share[:, None] * (end[k] - start[k])


def _pushed_out(points, outline, distance):
    """The straight ways around corners cut them: these points go out to the distance
    from the corner."""
    corners = np.concatenate(outline)
    off = points[:, None] - corners
    far = np.linalg.norm(off, axis=2)
    k = far.argmin(axis=1)
    near = far[np.arange(len(points)), k]
    out = off[np.arange(len(points)), k] / np.maximum(near, 1e-12)[:, None]
    moved = corners[k] + distance * out
    return np.where((near < distance)[:, None], moved, points)


def way_is_free(a, b, outline, distance):
    """Whether the straight way from a to b (2,) keeps that distance from an outline,
    but for what it has less at a itself, on its way out [m]."""
    n = max(2, int(np.ceil(np.hypot(*(b - a)) / 0.002)) + 1)
    d = distance_to_outline(a + np.linspace(0.0, 1.0, n)[:, None] * (b - a), outline)
    near = d < distance - 1e-9
    if not near.any():
        return True
    out = int(np.argmin(near)) if near[0] else 0  # The first that is far enough.
    return bool(near[0] and not near[out:].any() and (np.diff(d[: out + 1]) > 0).all())


def travel_length(a, b, outline, distance, height):
    """Length of the way from a to b (3,) [m]: straight where that is free, else up to
    the height, across, and down."""
    if way_is_free(a[:2], b[:2], outline, distance):
        return float(np.linalg.norm(b - a))
    up = max(height - a[2], 0.0) + max(height - b[2], 0.0)
    return float(up + np.hypot(*(b - a)[:2]))


def way_around(a, b, outline, distance):
    """Where to go next from a to b (2,), around an outline that is one convex polygon:
    b itself where the straight way is free, else along the contour at the distance, the
    shorter way [m]."""
    if way_is_free(a, b, outline, distance):
        return b
    (polygon,) = outline
    middle = polygon.mean(axis=0)
    from_a, from_b = a - middle, b - middle
    turn = np.arctan2(from_a[0] * from_b[1] - from_a[1] * from_b[0], from_a @ from_b)
    turn = np.clip(turn, -AROUND, AROUND)
    cos, sin = np.cos(turn), np.sin(turn)
    out = np.array([[cos, -sin], [sin, cos]]) @ from_a
    out /= np.linalg.norm(out)
    far = np.linalg.norm(polygon - middle, axis=1).max() + distance
    # Inwards from where nothing is near, to the distance.
    for _ in range(30):
        near = distance_to_outline((middle + far * out)[None], outline)[0] - distance
        if near < 1e-5:
            break
        far -= near
    return middle + (far + AROUND_MARGIN) * out


def travel_step(
    p, v, goal, outline, distance, height, limits, dt, descent=None, around=False
):
    """One step of the reference on its way to a place, never nearer to the object.

    Where the straight way beside the object keeps the distance, it is taken; else the
    tip goes up to the height, across, and down. Speed falls off towards each corner of
    the way, so that nothing is overshot.

    Args: p, v (3,) [m], [m/s] of the reference; goal (3,) [m]; outline, distance as of
        way_is_free; height [m] at which the object is cleared; limits: speed [m/s],
        acceleration [m/s2]; dt [s]; descent: (speed [m/s], height [m]): going down it
        is at most so fast from that height on, where something may be in its way.
    Returns: p, v, a (3,) dt later, and whether it has arrived.
    """
    speed, acceleration = limits
    across = np.hypot(*(goal - p)[:2])
    left = None
    # Above the place, and not drifting away from above it while going down.
    above = across < 1e-3 and np.hypot(*v[:2]) < 0.02
    low = p[2] < height - 1e-3
    if above or (low and way_is_free(p[:2], goal[:2], outline, distance)):
        target = goal
    elif around and p[2] < goal[2] + 2e-3:
        target = np.array([*way_around(p[:2], goal[:2], outline, distance), goal[2]])
        left = max(across, np.linalg.norm(target - p))
    elif low:
        target = np.array([*p[:2], height])
    else:
        target = np.array([*goal[:2], max(p[2], height)])
    off = target - p
    away = np.linalg.norm(off)
    left = away if left is None else left
    # What it can still brake from within what is left, in steps of dt, and not with all
    # of the acceleration: some is left to keep to it.
    brake = BRAKE * acceleration
    fast = min(speed, np.sqrt((brake * dt) ** 2 + 2.0 * brake * left) - brake * dt)
    if descent is not None and off[2] < -1e-3:
        slow, below = descent
        ahead = max(p[2] - below, 0.0)
        fast = min(fast, np.sqrt(slow**2 + 2.0 * brake * ahead))
    wanted = off / max(away, 1e-12) * fast
    change = wanted - v
    size = np.linalg.norm(change)
    if size > acceleration * dt:
        change *= acceleration * dt / size
    v_next = v + change
    p_next = p + 0.5 * dt * (v + v_next)
    arrived = np.linalg.norm(goal - p_next) < 1.5e-3 and np.linalg.norm(v_next) < 0.02
    return p_next, v_next, change / dt, bool(arrived)


@njit(cache=True, nogil=True)
def _score(
    first, last, lcs, x, x_desired, weights, bounds, polish_bounds, U, guess, options,
    found,
):  # fmt: skip
    """The places first .. last - 1 into found, as solve_c3's C3+ plans them.

    Args: lcs: A, B, D, d, E, F, H, c, each of n; x (n, n_x); weights: Q, Q_N, R, G, h;
        bounds as of admm_plus, polish_bounds as of polish; guess (n, N, n_u); options:
        rounds, rho, scale_lam, start_at_x0, polish; found: cost (n,), NO_PLAN where it
        stays as it is; u (n, N, n_u); x (n, N + 1, n_x).
    """
    Q, Q_N, R, G, h = weights
    rounds, rho, scale_lam, start_at_x0, evaluations = options
    _, N, n_u = guess.shape
    cost_of, u_of, x_of = found
    for i in range(first, last):
        one = slice(i, i + 1)
        A, B, D, d = lcs[0][one], lcs[1][one], lcs[2][one], lcs[3][one]
        E, F, H, c = lcs[4][one], lcs[5][one], lcs[6][one], lcs[7][one]
        if not (np.isfinite(c).all() and np.isfinite(F).all()):
            continue
        scale = 1.0
        if scale_lam:
            scale = np.sqrt((A[0] ** 2).sum()) / np.sqrt((D[0] ** 2).sum())
        model, E_s, F_s, _, pushes = scaled_model(A, B, D, d, E, F, H, c, scale)
        AB, d_s, C, c_s = model
        lam0 = np.empty(0)
        if not pushes:
            lam0, status = solve_lcp_kernel(F_s[0], E_s[0] @ x[i] + c_s[0])
            if status != SOLVED:
                continue
        delta, w = np.zeros((N, G.size)), np.zeros((N, G.size))
        if start_at_x0:
            delta[:, : x.shape[1]] = x[i]
        status, _, _, _, _, inputs = admm_plus(
            AB, d_s, C, c_s, Q, R, Q_N, G, bounds, U, h, x[i], lam0, delta, w, rounds,
            rho,
        )  # fmt: skip
        if status != SOLVED:
            continue
        starts = np.empty((rounds + 3, N, n_u))
        starts[: rounds + 1] = inputs
        starts[rounds + 1] = guess[i]
        starts[rounds + 2, : N - 1], starts[rounds + 2, N - 1] = (
            guess[i, 1:],
            guess[i, -1],
        )
        plan, u, _, cost = polish(
            (A, B, D, d, E, F, H, c), x[i], starts, x_desired, np.zeros((N, n_u)),
            (Q, R, Q_N), polish_bounds, evaluations,
        )[:4]  # fmt: skip
        cost_of[i], u_of[i], x_of[i] = cost, u, plan


@cache
def _threads(number, process):
    """A pool for this process: one that was forked has none of its parent's threads."""
    return ThreadPoolExecutor(number, f"contact_sampling_{process}")


def _score_side_by_side(first, last, *args):
    """_score on as many threads as numba uses; no place knows of another, so that their
    number changes no bit. Threads, not numba's prange: that compiles for a minute."""
    threads = min(get_num_threads(), last - first)
    if threads <= 1:
        _score(first, last, *args)
        return
    ends = np.linspace(first, last, threads + 1).round().astype(int).tolist()
    parts = [
        _threads(get_num_threads() - 1, getpid()).submit(_score, i, j, *args)
        for i, j in zip(ends[1:-1], ends[2:], strict=True)
    ]
    _score(ends[0], ends[1], *args)
    for part in parts:
        part.result()


def score_plans(lcs, x, x_desired, problem: C3Problem, guess=None, first=0, last=None):
    """The plan from each of many states, as solve_c3 makes it, and what it costs.

    Args:
        lcs: A, B, D, d, E, F, H, c, ... of n states (AnitescuLcs.build_many).
        x: (n, n_x) the states, which have the same quaternions.
        x_desired: (N + 1, n_x). problem: with C3+.
        guess: (n, N, n_u) inputs that the polish may start from, as WarmStart.u; None:
            zeros.
        first, last: of which states; the others cost NO_PLAN.

    Returns: cost (n,), NO_PLAN where there is no plan: of the rollout on the state's
        own LCS, to second order in the orientation; u (n, N, n_u); x (n, N + 1, n_x).
    """
    p, o = problem, problem.options
    if not p.is_plus or o.penalise_input_change or o.warm_start:
        raise ValueError(
            "score_plans: expected a problem with PlusProjection, without "
            "penalise_input_change and warm_start"
        )
    Q, Q_N, x_goal = p.state_cost(x[0], x_desired)
    h = np.zeros((o.N + 1, p.n_x + p.n_u + p.n_lam))
    for k in range(o.N + 1):
        h[k, p.n_lam + p.n_u :] = (Q_N if k == o.N else Q[k % len(Q)]) @ x_goal[k]
    unbounded = np.isinf(p.lower).all() and np.isinf(p.upper).all()
    (u_lower, x_lower), (u_upper, x_upper) = (
        np.split(bound[p.n_lam :], [p.n_u]) for bound in (p.lower, p.upper)
    )
    guess = np.zeros((len(x), o.N, p.n_u)) if guess is None else guess
    n = len(x)
    found = np.full(n, NO_PLAN), np.zeros((n, o.N, p.n_u)), np.zeros((n, *x_goal.shape))
    first, last, _ = slice(first, last).indices(n)
    _score_side_by_side(
        first,
        last,
        tuple(compiled_once(np.ascontiguousarray(a)) for a in lcs[:8]),
        np.ascontiguousarray(x),
        np.ascontiguousarray(x_goal),
        (Q, Q_N, p.R, p.G, h),
        None if unbounded else (p.lower, p.upper),
        (u_lower, u_upper, x_lower, x_upper),
        p.U,
        guess,
        (o.rounds, o.rho, o.scale_lam, o.start_at_x0, o.polish),
        found,
    )
    return found


def score_within(budget_sec, lcs, x, x_desired, problem, guess=None, at_once=None):
    """score_plans of as many states as the budget has time for, the first ones first.

    Args: budget_sec: wall-clock time [s]; infinite: all, in one go, which repeats
        whatever the computer does. at_once: states between two looks at the clock;
        None: 4, or as many as there are threads.
    Returns: as score_plans.
    """
    if np.isinf(budget_sec):
        return score_plans(lcs, x, x_desired, problem, guess)
    start, n = perf_counter(), len(x)
    at_once = max(4, get_num_threads()) if at_once is None else at_once
    parts = []
    for first in range(0, n, at_once):
        spent = perf_counter() - start
        # Of a part that would not be done in time as far as the last ones tell.
        if first and spent * (1.0 + at_once / first) > budget_sec:
            break
        parts.append(
            score_plans(lcs, x, x_desired, problem, guess, first, first + at_once)
        )
    cost = np.min([part[0] for part in parts], axis=0)
    return cost, *(np.sum([part[i] for part in parts], axis=0) for i in (1, 2))


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


def rotation_of(q):
    """(3, 3) of a quaternion [w x y z] of any length but zero."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def heading_of(q):
    """(2, 2) how an object of quaternion q (4,) is turned, seen from above."""
    R = rotation_of(q)
    heading = np.array([R[:2, 0], [-R[1, 0], R[0, 0]]]).T
    return heading / np.linalg.norm(heading[:, 0])


def to_world(x, place):
    """A place (2,) of the object's frame, seen from above, in the world."""
    return heading_of(x[Q_BALL]) @ place + x[P_BALL][:2]


def to_object(x, place):
    """The inverse of to_world."""
    return heading_of(x[Q_BALL]).T @ (place - x[P_BALL][:2])


def turned_inputs(inputs, heading):
    """Inputs (N, 3) with x and y turned by heading (2, 2)."""
    return np.column_stack([inputs[:, :2] @ heading.T, inputs[:, 2:]])


def inward(places, outline):
    """(n, 2) unit directions from places (n, 2) straight towards an outline."""
    step, rise = 1e-5, np.empty((len(places), 2))
    for i in range(2):
        to = np.zeros(2)
        to[i] = step
        ahead = distance_to_outline(places + to, outline)
        rise[:, i] = ahead - distance_to_outline(places - to, outline)
    size = np.linalg.norm(rise, axis=1)
    return -rise / np.maximum(size, 1e-12)[:, None]


@dataclass(frozen=True, eq=False)
class Round:
    """What a round found, for the eye and for scoring; n places."""

    places: np.ndarray  # (n, 2) in the world [m]; the first is the present one.
    cost: np.ndarray  # (n,) of plan and travel.
    chosen: int
    x: np.ndarray  # (N + 1, n_x) the plan from the chosen one.


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
    Raises: ValueError for an object without an outline.
    """
    c, m = config, memory
    if goal != m.goal:
        m = replace(m, goal=goal, error=np.inf)
    outline = outline_of(shape.parts, rotation_of(x[Q_BALL]), x[P_BALL])
    distance = shape.tip_radius + c.clearance + nearer
    phase = (m.count * GOLDEN) % 1.0
    around = places_around(outline, distance, c.places, phase)
    reach = c.reach, c.bearing, c.wrist
    around = around[in_reach(around, *reach)]
    going = m.place is not None and not in_contact
    present = to_world(x, m.place) if going else x[P_TIP][:2]
    last = [] if m.best is None else [to_world(x, m.best)]
    last = [place for place in last if in_reach(place[None], *reach)[0]]
    places = np.array([present, *last, *around])
    n, N = len(places), problem.options.N
    starts = np.tile(x, (n, 1))
    starts[:, :2], starts[:, 2], starts[:, V_TIP] = places, c.height, 0.0
    if c.follow:
        starts[:, V_TIP.start : V_TIP.start + 2] = x[V_BALL][:2]
    if in_contact:
        starts[0] = x
    lcs = build_many(starts, np.zeros(problem.n_u))
    if r is not None:
        lcs = (*lcs[:7], lcs[7] + r, *lcs[8:])
    guess = np.zeros((n, N, problem.n_u))
    guess[:, :, :2] = c.push * inward(places, outline)[:, None]
    heading = heading_of(x[Q_BALL])
    if going and m.inputs is not None:
        # What it was chosen for counts again: whether the search finds as good a plan
        # in every round is chance, and the tip would turn round each time that it does
        # not.
        guess[0] = turned_inputs(m.inputs, heading)
    cost, u, plans = score_within(budget_sec, lcs, starts, x_desired, problem, guess)
    way = [
        travel_length(
            x[P_TIP], np.array([*place, c.height]), outline, distance,
            shape.clear_height(0.0),
        )
        for place in places
    ]  # fmt: skip
    if in_contact:
        way[0] = 0.0
    elif not going or not in_reach(present[None], *reach)[0]:
        cost[0] = NO_PLAN
    cost = cost + c.travel * np.array(way)
    # Where the tip is now no plan can change.
    led_out = out_of_reach(plans[:, 1:], c.reach, c.inwards, c.wrist)
    cost = cost + c.out_of_reach * led_out
    progressed = not in_contact or error < m.error - PROGRESS
    if progressed or not np.isfinite(m.error):
        m = replace(m, error=error, since_sec=t)
    elif t - m.since_sec > c.stuck_sec:
        m = replace(m, error=error, since_sec=t)
        cost[0] = NO_PLAN
    if not in_contact:
        m = replace(m, reached_sec=None)
    elif m.reached_sec is None:
        m = replace(m, reached_sec=t)
    keep = m.reached_sec is not None and t - m.reached_sec < c.keep_sec
    chosen = 0 if keep and np.isfinite(cost[0]) else choose(cost, c.hysteresis)
    found = Round(places, cost, chosen, plans[chosen])
    m = replace(m, count=m.count + 1)
    if n > 1 and np.isfinite(cost[1:]).any():
        m = replace(m, best=to_object(x, places[1 + int(np.argmin(cost[1:]))]))
    if np.isfinite(cost[chosen]) and (chosen != 0 or going):
        m = replace(m, inputs=turned_inputs(u[chosen], heading.T))
    if np.isfinite(cost[chosen]) and (chosen != 0):
        m = replace(m, place=to_object(x, places[chosen]), go=m.go + 1)
    return m, found
