"""Pushing an object to a pose, a contact at a time: what the tip does between plans.

CONTACT  the tip follows C3, which pushes the object towards its goal,
TRAVEL   the tip goes to another place beside the object: along the table where
         nothing is in the way, else up, across and down,
WAIT     the object is not seen, or there is no place to go to: the tip goes up and
         to where it hides nothing.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ObjectShape,
    in_reach,
)
from makebreak.systems.contact_mpc.numerics.object_frame import rotation_of, to_world
from makebreak.systems.contact_mpc.numerics.outline import (
    distance_to_outline,
    inward,
    outline_of,
)
from makebreak.systems.contact_mpc.numerics.tip_travel import travel_step

# CONTACT is what ArmReference follows C3 in (numerics/rolling_task.py: ROLL).
CONTACT, TRAVEL, WAIT = 0, 1, 2
# So near to half a turn the object goes on turning the way it did: either is as short,
# and the noise of its pose would change the way, and with it the place, again and again
# [rad].
HALF_TURN = 0.2
# A tip that is so far above where it should be on its way down has come down on the
# object, which is larger than believed, or elsewhere: it goes up, and after that comes
# down so much farther out; not farther than EXTRA_MAX, where it no longer matters [m].
MISSED, EXTRA, EXTRA_MAX = 0.01, 0.003, 0.012
LOW = 2e-3  # So little above its height for pushing the tip is down [m].
EDGE = 0.9  # From so much of the object's height on its upper edge may be in the way.
# Each landing that does not miss takes so much of it back [m].
TAKEN_BACK = 0.001


@dataclass
class TravelConfig:
    """How the tip goes to another place beside the object."""

    speed: float = 0.35  # Largest speed of the tip [m/s].
    acceleration: float = 2.0  # Largest acceleration of the tip [m/s2].
    # Largest speed of the tip as it comes down beside the object [m/s].
    descent: float = 0.08
    # Distance beyond its place, away from the object, at which the tip comes down where
    # there is room; it then goes to its place along the table [m]. Coming down on an
    # edge, the tip would be wedged between arm and object.
    room: float = 0.008
    # Clearance of the tip over the object where it passes above it [m].
    margin: float = 0.012
    # Whether a low tip goes around the object, not over it; for an object of one convex
    # part.
    around: bool = False


@dataclass
class FollowedConfig:
    """Where an object is followed, seen from the arm's base."""

    nearest: float = 0.25  # Least distance [m].
    farthest: float = 0.75  # Largest distance [m].
    bearing: float = 1.05  # Largest angle from the x axis, to either side [rad].


@dataclass
class UnseenConfig:
    """What the tip does while the object is not seen."""

    sec: float = 0.3  # Time for which it goes on pushing, before it waits [s].
    # Time for which it goes on travelling, before it waits: the arm may hide the object
    # on its way [s].
    believed_sec: float = 3.0
    # Place where the tip waits and hides nothing from the camera, [x, y] [m].
    withdrawn: list[float] = field(default_factory=lambda: [0.3, 0.0])


@dataclass
class PushConfig:
    """How a tip goes about an object and pushes it."""

    travel: TravelConfig = field(default_factory=TravelConfig)
    reach: FollowedConfig = field(default_factory=FollowedConfig)
    unseen: UnseenConfig = field(default_factory=UnseenConfig)
    look_ahead: float = 0.06  # Largest distance of C3's target from the object [m].
    # Largest turn of C3's target from the object's yaw [rad].
    look_ahead_angle: float = 0.5
    # Whether the tip travels along with an object that rolls on by itself, and arrives
    # with its velocity; always so for a cylinder.
    follow: bool = False
    # Distance between the place that the tip travels to and the one measured on the
    # object above which the latter replaces it: less is noise [m].
    place_change: float = 0.008


@dataclass(frozen=True, eq=False)
class PushState:
    """Memory of the task between two ticks; p, v, a (3,) is the last reference."""

    phase: int
    p: np.ndarray
    v: np.ndarray
    a: np.ndarray
    go: int = 0  # The last command of the sampler that was carried out.
    place: np.ndarray | None = None  # (2,) in the world, where it travels to [m].
    unseen_sec: float = 0.0
    extra: float = 0.0  # Beyond the clearance of a place, for what was hit [m].
    lifting: bool = False  # Off what was hit.

    def __deepcopy__(self, memo) -> "PushState":
        return self  # Nothing in it is changed once it is there.


def heading(q) -> float:
    """Where a body's x axis points to, seen from above [rad]; q (4,) [w x y z]."""
    R = rotation_of(q)
    return float(np.arctan2(R[1, 0], R[0, 0]))


def angle_between(a, b):
    """b - a as the shorter turn, in [-pi, pi) [rad]."""
    return (b - a + np.pi) % (2.0 * np.pi) - np.pi


def errors(x, goal) -> tuple[float, float]:
    """How far the object is from a goal (x, y, yaw): [m], [rad]."""
    off = goal[:2] - x[P_BALL][:2]
    return float(np.hypot(*off)), float(abs(angle_between(heading(x[Q_BALL]), goal[2])))


def look_ahead(config: PushConfig, x, goal, height: float, n_knots: int, before=None):
    """C3's target (n_knots, 19): the goal, or the part of the way to it that a plan is
    good for; the tip at the height of pushing, everything at rest.

    Args: x (19,); goal (3,) = x, y [m], yaw [rad]; height of the tip's centre [m];
        before (19,): the last target, or None.
    """
    off = goal[:2] - x[P_BALL][:2]
    off = off * min(1.0, config.look_ahead / max(np.hypot(*off), 1e-12))
    turn = angle_between(heading(x[Q_BALL]), goal[2])
    if before is not None and abs(turn) > np.pi - HALF_TURN:
        on = angle_between(heading(x[Q_BALL]), heading(before[Q_BALL]))
        turn -= np.copysign(2.0 * np.pi, turn) if on * turn < 0.0 else 0.0
    turn = np.clip(turn, -config.look_ahead_angle, config.look_ahead_angle)
    w, z = np.cos(turn / 2.0), np.sin(turn / 2.0)
    a, b, c, d = x[Q_BALL]
    target = np.zeros(N_X)
    target[P_TIP], target[2] = x[P_TIP], height
    # The turn about the vertical, before how it is turned already.
    target[Q_BALL] = [w * a - z * d, w * b - z * c, w * c + z * b, w * d + z * a]
    target[P_BALL] = x[P_BALL]
    target[P_BALL.start : P_BALL.start + 2] += off
    return np.tile(target, (n_knots, 1))


def next_push(
    config: PushConfig, state: PushState, shape: ObjectShape, dt, x, seen, place, go,
    height, clearance, nearer=0.0,
):  # fmt: skip
    """One tick of the task.

    Args:
        dt [s]; x (19,); seen: whether x can be trusted.
        place: (2,) of ContactSampler, in the object's frame; None: none yet. go: the
            number of that command. height of the tip's centre while pushing, clearance
            from the object at a place [m].
        nearer: by how much the object reaches farther out than its shape [m].
    Returns: PushState; unless in CONTACT its p, v, a is the reference at t + dt.
    """
    unseen = 0.0 if seen else state.unseen_sec + dt
    state = replace(state, unseen_sec=unseen)
    travels, patience = state.phase == TRAVEL, config.unseen
    lost = unseen > (patience.believed_sec if travels else patience.sec)
    reach = config.reach
    followed = [reach.nearest, reach.farthest], reach.bearing
    lost = lost or not in_reach(x[P_BALL][None, :2], *followed)[0]
    # C3 knows no object that is not seen; nor does anybody know a place before that.
    if lost or place is None:
        if state.phase == CONTACT:
            state = replace(state, p=x[P_TIP].copy(), v=x[V_TIP].copy())
        state = replace(state, phase=WAIT)
    elif state.phase == WAIT or (state.phase == CONTACT and go != state.go):
        if state.phase == CONTACT:
            extra = max(state.extra - TAKEN_BACK, 0.0)
            state = replace(state, p=x[P_TIP].copy(), v=x[V_TIP].copy(), extra=extra)
        state = replace(state, phase=TRAVEL, place=None)
    if state.phase == CONTACT:
        return state
    outline = outline_of(shape.parts, rotation_of(x[Q_BALL]), x[P_BALL])
    travel = config.travel
    limits = travel.speed, travel.acceleration
    up = shape.clear_height(travel.margin)
    distance = shape.tip_radius + 0.5 * clearance + nearer
    along = np.zeros(3)
    if config.follow and state.phase == TRAVEL:
        along[:2] = x[V_BALL][:2]

    def step(goal, descent=None):
        """Beside an object that moves, the way is the one beside it at rest."""
        p, v, a, arrived = travel_step(
            state.p, state.v - along, goal, outline, distance, up, limits, dt, descent,
            travel.around,
        )  # fmt: skip
        return p + dt * along, v + along, a, arrived

    if state.phase == WAIT:
        p, v, a, _ = step(np.array([*patience.withdrawn, up]))
        return replace(state, p=p, v=v, a=a)
    if state.lifting:
        p, v, a, arrived = step(np.array([*state.p[:2], up]))
        return replace(state, p=p, v=v, a=a, lifting=not arrived)
    now = to_world(x, place)
    if state.extra > 0.0:
        now = now - state.extra * inward(now[None], outline)[0]
    held = state.place if state.place is None else state.place + dt * along[:2]
    if held is None or np.hypot(*(now - held)) > config.place_change:
        held = now
    # One that came nearer since, by an object that was still moving, or by what was
    # learned, would be no way's end: the tip would go down to it and up again for ever.
    short = distance - distance_to_outline(held[None], outline)[0]
    if short > 0.0:
        held = held - (short + 1e-4) * inward(held[None], outline)[0]
    goal = np.array([*held, height])
    # Below the object's top it meets a side, not an edge.
    if state.p[2] > max(height + LOW, EDGE * shape.top):
        beside = held - travel.room * inward(held[None], outline)[0]
        near = distance_to_outline(beside[None], outline)[0]
        if near > shape.tip_radius + clearance + 0.5 * travel.room:
            goal[:2] = beside
    # An object that is larger than believed is higher, too.
    descent = travel.descent, shape.clear_height(0.5 * travel.margin)
    p, v, a, arrived = step(goal, descent)
    state = replace(state, p=p, v=v, a=a, place=held, go=go)
    # What is in its way down is noticed on the way, or the tip presses on it all along.
    # A tip that is beside its place, where the arm does not reach, pushes from there.
    missed = p[2] < descent[1] and x[P_TIP][2] - p[2] > MISSED
    if missed and state.extra < EXTRA_MAX:
        extra = min(state.extra + EXTRA, EXTRA_MAX)
        at_rest = dict(p=x[P_TIP].copy(), v=np.zeros(3), a=np.zeros(3))
        return replace(state, **at_rest, extra=extra, lifting=True, place=None)
    if not arrived:
        return state
    # Where the arm hides it from this place, it is pushed a little as it is believed.
    return replace(state, phase=CONTACT, unseen_sec=0.0)
