"""What the tip has to do to roll a ball along a circle: push, lift, go back, land.

A tip on top of a rolling ball moves twice as fast as the ball, so it runs ahead of it
and has to go back. The task therefore alternates between

    ROLL        the tip follows C3, which pushes the ball along the path.
    REPOSITION  the tip lifts, passes over the ball and comes down behind it, on
                quintics in time that end where the ball is expected to be.
    APPROACH    the last part of the way down, slowly: from the highest place where the
                surface may be to where it is believed to be. It ends as soon as the tip
                feels something. Where little is known of the surface, or the ball does
                not coast, it goes on to the lowest place where the surface may be.
    WAIT        the ball has not been seen for the time in which it may have gone 20 mm
                (unseen.drift), or the measurement cannot be used. The tip lifts and
                pushes nothing. Since the arm itself may hide the ball, the tip then
                withdraws until the ball is seen.

Source: ACI-MPC VII-B describes the behaviour (a push, then a new push from behind);
times and distances are ours (docs/ball_rolling.md).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    compiled_pack,
)

ROLL, REPOSITION, WAIT, APPROACH = 0, 1, 2, 3
LOOK_AHEAD = 0.35  # A push is directed at the point so far along the circle [rad].
# On the way down the tip aims at where the ball will be so much later [s].
APPROACH_PLAN = 0.1
# Acceleration to the speed of the approach, and deceleration at its end [m/s2].
APPROACH_SLOPE, APPROACH_STOP = 1.5, 0.3
# The ball's target is at most so far away [m]: with a target further off the tip would
# slip over the ball and leave it behind.
REACH = 0.015
WITHDRAW_ACCELERATION = 1.0  # [m/s2]
# With so much change of velocity beyond land.coast_change the tip lands at half its
# usual distance behind the ball's top [m/s].
LAND_CHANGE = 0.06
SPEED_SEC = 0.15  # The speed of a hidden ball is a mean over this time [s].
GLIMPSE_SEC = 0.1  # The velocity of a ball that was seen for less is not known [s].
SHIFT_MAX = 0.008  # The circle aimed at differs from the path by at most this [m].


@dataclass
class CircleConfig:
    """The circle along which a ball is rolled, and how C3's target moves along it."""

    # Centre of the circle, [x, y] [m].
    center: list[float] = field(default_factory=lambda: [0.5, 0.0])
    radius: float = 0.1  # Radius of the circle [m].
    # Angle on the circle by which C3's target is ahead of the ball [deg].
    lead_deg: float = 6.0
    speed: float = 0.05  # Speed of C3's target along the circle [m/s].


def check_circle(circle: CircleConfig, name: str) -> None:
    """Raises: ValueError that names a setting out of range, of `name`."""
    c = circle
    if np.shape(c.center) != (2,) or not np.isfinite(c.center).all():
        raise ValueError(f"{name}.center is {c.center}, expected 2 numbers")
    for key in ("radius", "speed"):
        if not 0.0 < getattr(c, key) < np.inf:
            raise ValueError(f"{name}.{key} is {getattr(c, key)}, expected > 0")
    if not 0.0 <= c.lead_deg < np.inf:
        raise ValueError(f"{name}.lead_deg is {c.lead_deg}, expected >= 0")


@dataclass(frozen=True, eq=False)
class CirclePath:
    """A circle on the table, run through counter-clockwise seen from above."""

    center: np.ndarray  # (2,) [m]
    radius: float  # [m]

    def angle(self, p):
        """Where p (2,) or (3,) lies on the circle, as an angle [rad]."""
        return np.arctan2(p[1] - self.center[1], p[0] - self.center[0])

    def point(self, angle):
        """(2,) [m]"""
        return self.center + self.radius * np.array([np.cos(angle), np.sin(angle)])

    def heading(self, p):
        """(2,) unit vector from p, on the circle or off it, to where it should go."""
        goal = self.point(self.angle(p) + LOOK_AHEAD) - p[:2]
        return goal / max(np.sqrt(goal @ goal), 1e-9)


def quintic(t, T, start, end):
    """Position, velocity, acceleration at t of the quintic from start to end.

    Args:
        t, T: time and duration [s], 0 <= t <= T.
        start, end: (position, velocity, acceleration) at 0 and T, scalars or arrays.
    Returns: (p, v, a) at t.
    """
    (p0, v0, a0), (p1, v1, a1) = start, end
    h = p1 - p0 - v0 * T - 0.5 * a0 * T**2
    k = (v1 - v0 - a0 * T) * T
    m = (a1 - a0) * T**2
    c3, c4, c5 = 10 * h - 4 * k + m / 2, -15 * h + 7 * k - m, 6 * h - 3 * k + m / 2
    s = t / T
    p = p0 + v0 * t + 0.5 * a0 * t**2 + s**3 * (c3 + s * (c4 + s * c5))
    v = v0 + a0 * t + s**2 * (3 * c3 + s * (4 * c4 + s * 5 * c5)) / T
    a = a0 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5)) / T**2
    return p, v, a


@dataclass(frozen=True, eq=False)
class TaskState:
    """Memory of the task between two ticks; `p`, `v`, `a` is the last reference."""

    phase: int
    since_sec: float
    p: np.ndarray  # (3,) [m]
    v: np.ndarray  # (3,) [m/s]
    a: np.ndarray  # (3,) [m/s2]
    z_start: float = 0.0  # Height and climb where the phase began [m], [m/s].
    vz_start: float = 0.0
    tare: float = 0.0  # Vertical force on the tip where the approach began [N].
    # Whether the tip has to feel for the ball: the approach goes on below where the
    # surface is believed to be, and the push of a ball that does not coast is longer.
    feel: bool = False
    stretch: float = 1.0  # Duration of this reposition over reposition.sec.
    seen_sec: float = 0.0  # For how long the ball has been seen, ...
    unseen_sec: float = 0.0  # ... or has not been seen.
    # The ball's velocity when it was last seen, a mean over SPEED_SEC [m/s].
    v_seen: tuple[float, float] = (0.0, 0.0)
    # The largest change of the ball's velocity since this reposition began [m/s], ...
    strayed: float = 0.0
    v_ball: np.ndarray | None = None  # ... and the velocity then (2,); None: unknown.

    def __post_init__(self):
        for name in ("p", "v", "a"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __deepcopy__(self, memo):
        return self  # Nothing in it can change, so a Context may share it.


@dataclass
class RollConfig:
    """A push, in which the ball rolls."""

    sec: float = 1.0  # Longest time of a push [s].
    # Longest time of a push in which the tip has to feel for the ball [s].
    feel_sec: float = 1.5
    # Horizontal distance of the tip from the ball's centre, ahead of it or beside it,
    # at which a push ends [m].
    ahead: float = 0.025


@dataclass
class RepositionConfig:
    """The way from the end of a push to the next landing."""

    sec: float = 0.55  # Time from lifting the tip to the landing [s].
    # Horizontal distance above which it takes longer, in proportion [m].
    far: float = 0.12
    lift: float = 0.015  # Clearance over the ball while the tip passes over it [m].
    # Fraction of the time for going up, and the same for going down.
    ease: float = 0.42


@dataclass
class LandConfig:
    """Where the tip lands on the ball."""

    # Distance behind the ball's centre, seen from above [m].
    behind: float = 0.018
    # Height above where the ball's surface is believed to be [m].
    above: float = 0.003
    # Change of the velocity of an untouched ball above which it does not coast: the tip
    # has to feel for it [m/s].
    coast_change: float = 0.06


@dataclass
class ApproachConfig:
    """The slow approach down to the ball."""

    # Height above the believed surface at which it begins, in standard deviations of
    # the gap.
    n_std: float = 2.5
    # Depth below the believed surface at which it ends for a tip that has to feel for
    # the ball, in standard deviations of the gap.
    n_std_below: float = 1.5
    speed: float = 0.035  # Speed of the approach [m/s].
    max: float = 0.025  # Longest distance [m].
    # Vertical force, beyond that in the air, which is a touch [N].
    touch_force: float = 4.0


@dataclass
class UnseenConfig:
    """What is done while the ball is not seen."""

    # Distance that a hidden ball may have rolled before it counts as lost: then the
    # task waits, and the tip withdraws [m].
    drift: float = 0.02
    # Least speed at which a hidden ball is believed to roll [m/s].
    speed: float = 0.006
    # Speed at which the tip withdraws from a ball that is not seen [m/s].
    withdraw_speed: float = 0.2


@dataclass
class RollingConfig:
    """Times and distances of the cycle."""

    roll: RollConfig = field(default_factory=RollConfig)
    reposition: RepositionConfig = field(default_factory=RepositionConfig)
    land: LandConfig = field(default_factory=LandConfig)
    approach: ApproachConfig = field(default_factory=ApproachConfig)
    unseen: UnseenConfig = field(default_factory=UnseenConfig)
    # Time constant of the integral action on the circle's radius [s]; inf: none.
    integral_sec: float = 6.0


def surface_height(offset, radius_ball, radius_tip):
    """Height of the tip's centre over the table where tip and ball touch [m], when
    the two centres are `offset` [m] apart seen from above."""
    reach = radius_ball + radius_tip
    return radius_ball + np.sqrt(max(reach**2 - offset**2, 0.0))


def landing(config, path, x, gap, time_left, radius_ball, radius_tip, strayed=0.0):
    """Where and how fast the tip should land: p (3,) [m], v (3,) [m/s]. The less the
    ball coasts, the nearer to its top, where missing it by a little costs least.

    Args:
        x: (19,) state; the ball is expected to keep its velocity for time_left [s].
        gap: how much lower the surface is believed to be than modelled [m].
        strayed: how much its velocity has changed while nothing touched it [m/s].
    """
    p_ball = x[P_BALL][:2] + x[V_BALL][:2] * time_left
    more = max(strayed - config.land.coast_change, 0.0) / LAND_CHANGE
    offset = config.land.behind / (1.0 + more**2)
    behind = -path.heading(p_ball) * offset
    z = surface_height(offset, radius_ball, radius_tip)
    p = np.append(p_ball + behind, z + config.land.above - gap)
    return p, np.append(x[V_BALL][:2], 0.0)


def shifted(config, path, shift, x, dt):
    """Integral action: how much larger a circle than the path is aimed at [m].

    A ball that coasts straight on while the tip goes back, lags, and a model that is
    wrong in more than the gap, keep it on one side of the path.

    Args: shift: a tick dt [s] ago [m]; x: (19,) state.
    """
    ball = x[P_BALL][:2] - path.center
    most = min(SHIFT_MAX, 0.5 * path.radius)
    error = min(max(np.sqrt(ball @ ball) - path.radius, -most), most)
    return min(max(shift - dt / config.integral_sec * error, -most), most)


def approach_height(config, gap_std):
    """How far above the landing point the slow approach begins [m]; gap_std [m]. The
    landing point is itself above the surface."""
    above = config.approach.n_std * gap_std - config.land.above
    return min(max(above, 0.0), config.approach.max)


def reposition_step(
    config, path, state, t, dt, x, gap, radius_ball, radius_tip, above=0.0
):
    """The reference (p, v, a), each (3,), a tick dt [s] after the last one.

    Seen from above: a quintic from the last reference to the landing point, which is
    planned again at each tick, so that a rolling ball is met where it will be. In
    height: up to the clearance in the first `ease` of the time, down in the last, both
    quintics.

    Args: above: how far above the landing point it ends [m]; the ball may also be so
        much larger than believed, and is passed over accordingly.
    """
    T = config.reposition.sec * state.stretch
    T_ease = config.reposition.ease * T
    elapsed = min(t + dt - state.since_sec, T)
    left = max(T - (elapsed - dt), dt)
    p_land, v_land = landing(
        config, path, x, gap, left, radius_ball, radius_tip, state.strayed
    )
    start = state.p[:2], state.v[:2], state.a[:2]
    end = p_land[:2], v_land[:2], np.zeros(2)
    p, v, a = (np.zeros(3) for _ in range(3))
    p[:2], v[:2], a[:2] = quintic(min(dt, left), left, start, end)
    top = 2.0 * radius_ball + radius_tip
    z_clear = max(top - min(gap, 0.0) + config.reposition.lift + above, state.z_start)
    if elapsed < T_ease:
        begin = state.z_start, state.vz_start, 0.0
        p[2], v[2], a[2] = quintic(elapsed, T_ease, begin, (z_clear, 0.0, 0.0))
    elif elapsed < T - T_ease:
        p[2] = z_clear
    else:
        down = elapsed - (T - T_ease)
        begin = z_clear, 0.0, 0.0
        end_z = p_land[2] + above, 0.0, 0.0
        p[2], v[2], a[2] = quintic(down, T_ease, begin, end_z)
    return p, v, a


def withdraw_step(config, state, dt, goal):
    """Place and velocity seen from above, each (2,), a tick dt [s] after the last one,
    on the way to goal (2,), where the tip stops."""
    way = goal - state.p[:2]
    distance = np.sqrt(way @ way)
    fastest = min(
        config.unseen.withdraw_speed,
        np.sqrt(2.0 * 0.5 * WITHDRAW_ACCELERATION * distance),
    )
    change = fastest * way / max(distance, 1e-9) - state.v[:2]
    most = WITHDRAW_ACCELERATION * dt
    change *= min(1.0, most / max(np.sqrt(change @ change), 1e-12))
    v = state.v[:2] + change
    return state.p[:2] + 0.5 * (state.v[:2] + v) * dt, v


def approach_step(config, path, state, dt, x, gap, radius_ball, radius_tip, gap_std):
    """The reference (p, v, a), each (3,), a tick dt [s] after the last one, on the way
    down to the landing point, or to the lowest place of the surface; and whether it is
    there."""
    p_land, v_land = landing(
        config, path, x, gap, APPROACH_PLAN, radius_ball, radius_tip, state.strayed
    )
    left = APPROACH_PLAN
    start = state.p[:2], state.v[:2], state.a[:2]
    p, v, a = (np.zeros(3) for _ in range(3))
    p[:2], v[:2], a[:2] = quintic(
        dt, left, start, (p_land[:2], v_land[:2], np.zeros(2))
    )
    lowest = p_land[2]
    if state.feel:
        lowest -= config.land.above + config.approach.n_std_below * gap_std
    # At rest there, as a reposition without an approach ends.
    stop = np.sqrt(2.0 * APPROACH_STOP * max(state.p[2] - lowest - 2e-4, 0.0))
    v[2] = max(state.v[2] - APPROACH_SLOPE * dt, -min(config.approach.speed, stop))
    p[2] = state.p[2] + 0.5 * (state.v[2] + v[2]) * dt
    return p, v, a, bool(p[2] <= lowest + 3e-4)


def target_over_horizon(path, x, lead, speed, z_tip, radius_ball, dt, n_knots):
    """The target of C3, (n_knots, 19), one row per knot dt [s] after the other.

    The ball: `lead` [rad] further along the circle than it is now, and moving along it
    at `speed` [m/s]; all of it nearer, if the first point is further off than REACH.
    The tip: above the ball, at the height z_tip [m], and twice as
    fast, as a tip on a rolling ball is. Targets that stand still brake at every knot.
    """
    return _target(
        path.center, path.radius, x, lead, speed, z_tip, radius_ball, dt, n_knots
    )


@njit(cache=True)
def _target(center, radius, x, lead, speed, z_tip, radius_ball, dt, n_knots):
    ball = x[P_BALL]
    first = np.arctan2(ball[1] - center[1], ball[0] - center[0]) + lead
    goal = np.zeros((n_knots, N_X))
    too_far, way = 0.0, np.zeros(2)
    for k in range(n_knots):
        angle = first + speed / radius * dt * k
        cos, sin = np.cos(angle), np.sin(angle)
        point = center + radius * np.array([cos, sin])
        if k == 0:
            way = point - ball[:2]
            too_far = max(0.0, 1.0 - REACH / max(np.sqrt(way @ way), 1e-9))
        p = np.array([0.0, 0.0, radius_ball])
        p[:2] = point - too_far * way
        v = np.array([-speed * sin, speed * cos, 0.0])
        goal[k] = compiled_pack(p, 2.0 * v, p, v, radius_ball)
        goal[k, P_TIP.start + 2] = z_tip
    return goal


def _pushes(config, path, x, reach) -> bool:
    """Whether the tip is where it can push the ball on: not in front of it, or beside a
    ball that has rolled away from under it. Behind it, it may be as far as it can touch
    it, a distance of `reach` [m]: over the ball and back takes longer than to follow.
    """
    off = (x[P_TIP] - x[P_BALL])[:2]
    heading = path.heading(x[P_BALL])
    behind = min(off @ heading, 0.0) * heading
    beside = off - behind
    return bool(beside @ beside < config.roll.ahead**2 and off @ off < reach**2)


def next_state(
    config, path, state, t, dt, x, gap, valid, radius_ball, radius_tip, landed=None,
    gap_std=0.0, force_z=0.0, withdrawn=None, hidden=True,
):  # fmt: skip
    """One tick of the task.

    Args:
        t, dt: time now and period of the ticks [s].
        x: (19,) estimated state. gap: mean residual of tip and ball as a length [m].
        valid: whether x can be trusted (the ball is seen).
        landed: whether a reposition that others carry out is over; None: it is when
            its time is.
        gap_std: standard deviation of gap [m]. force_z: vertical force on the tip, as
            the arm feels it [N].
        withdrawn: (2,) where the tip hides nothing from the camera [m]; None: where the
            ball is lost sight of, it stays.
        hidden: where x is not valid, whether all that is wrong is that the ball is not
            seen: then it is believed to be where it was for a while. Else the tip
            lifts at once.
    Returns: TaskState: the phase, and unless rolling the reference at t + dt.
    """

    def lift_from(phase):
        p, v = x[P_TIP], x[V_TIP]
        left = config.reposition.sec
        goal, _ = landing(config, path, x, gap, left, radius_ball, radius_tip)
        far = float(np.hypot(*(goal - p)[:2])) / config.reposition.far
        return TaskState(
            phase, t, p, v, np.zeros(3), p[2], v[2], stretch=max(1.0, far), **sight
        )

    v_ball = x[V_BALL][:2]
    sight: dict = dict(seen_sec=0.0, unseen_sec=0.0, v_seen=state.v_seen)
    if valid:
        sight["seen_sec"] = state.seen_sec + dt
        if sight["seen_sec"] > GLIMPSE_SEC:
            was, share = np.array(state.v_seen), min(dt / SPEED_SEC, 1.0)
            sight["v_seen"] = tuple(was + share * (v_ball - was))
    else:
        sight["unseen_sec"] = state.unseen_sec + dt
    state = replace(state, **sight)
    speed = max(float(np.hypot(*state.v_seen)), config.unseen.speed)
    drift = state.unseen_sec * speed
    lost = not hidden or drift > config.unseen.drift
    if not valid and (state.phase == WAIT or lost):
        if state.phase != WAIT:
            state = lift_from(WAIT)
        T = config.reposition.sec
        elapsed = min(t + dt - state.since_sec, T)
        begin = state.z_start, state.vz_start, 0.0
        z_end = max(
            2 * radius_ball + radius_tip + 2 * config.reposition.lift, state.z_start
        )
        z, vz, az = quintic(elapsed, T, begin, (z_end, 0.0, 0.0))
        slow = max(0.0, 1.0 - 5.0 * dt / T)
        v_xy = state.v[:2] * slow
        p_xy = state.p[:2] + v_xy * dt
        clear = 2 * radius_ball + radius_tip - min(gap, 0.0)
        if withdrawn is not None and state.p[2] >= clear:
            p_xy, v_xy = withdraw_step(config, state, dt, withdrawn)
        return replace(
            state, p=np.array([*p_xy, z]), v=np.array([*v_xy, vz]),
            a=np.array([0, 0, az]),
        )  # fmt: skip
    if state.phase == WAIT:
        state = lift_from(REPOSITION)
    if state.phase == ROLL:
        longest = config.roll.feel_sec if state.feel else config.roll.sec
        near = _pushes(config, path, x, radius_ball + radius_tip)
        if t - state.since_sec < longest and near:
            return state
        state = lift_from(REPOSITION)
    strays = state.strayed > config.land.coast_change
    if state.phase == APPROACH:
        p, v, a, low = approach_step(
            config, path, state, dt, x, gap, radius_ball, radius_tip, gap_std
        )
        if low or force_z - state.tare > config.approach.touch_force:
            return TaskState(ROLL, t, state.p, state.v, state.a, feel=strays, **sight)
        return replace(state, p=p, v=v, a=a)
    above = 0.0 if landed is not None else approach_height(config, gap_std)
    over = t - state.since_sec >= config.reposition.sec * state.stretch - 0.5 * dt
    if state.since_sec < t and (over if landed is None else landed):
        feel = landed is None and gap_std > 0.0
        feel &= (
            max(gap_std / config.land.above, state.strayed / config.land.coast_change)
            > 1
        )
        if above > 0.0 or feel:
            return replace(state, phase=APPROACH, since_sec=t, tare=force_z, feel=feel)
        return TaskState(ROLL, t, state.p, state.v, state.a, feel=strays, **sight)
    p, v, a = reposition_step(
        config, path, state, t, dt, x, gap, radius_ball, radius_tip, above
    )
    state = replace(state, p=p, v=v, a=a)
    if state.seen_sec <= GLIMPSE_SEC:
        return state
    off = v_ball - (v_ball if state.v_ball is None else state.v_ball)
    strayed = max(state.strayed, float(np.sqrt(off @ off)))
    return replace(state, v_ball=v_ball - off, strayed=strayed)
