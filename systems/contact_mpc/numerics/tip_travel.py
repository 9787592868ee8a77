"""The way of a tip that does not touch, past an object on the table to a place."""

import numpy as np

from makebreak.systems.contact_mpc.numerics.outline import distance_to_outline

WAY_STEP = 0.002  # Between the points of a way that are looked at [m].
ROUNDING = 1e-9  # A way that is nearer by less keeps its distance [m].
BRAKE = 0.6  # Share of the acceleration that a travelling tip is to brake with.
# Around an object the tip looks so far ahead [rad], and keeps so much more away [m].
AROUND, AROUND_MARGIN = 0.35, 0.003
# Its distance is found to this [m], in at most so many steps.
FOUND, MOST_STEPS = 1e-5, 30
# A tip is above a place where it is no farther from it, seen from above, and low where
# it is so much below the height at which the object is cleared [m].
ABOVE, LOW = 1e-3, 1e-3
BESIDE = 2e-3  # Above the place by less, a tip may go around the object [m].
ARRIVED = 1.5e-3  # Nearer to the place, and at rest, it has arrived [m].
AT_REST = 0.02  # Slower is at rest [m/s].
GOES_DOWN = 1e-3  # A target that is lower by more [m].


def way_is_free(a, b, outline, distance):
    """Whether the straight way from a to b (2,) keeps that distance from an outline,
    but for what it has less at a itself, on its way out [m]."""
    n = max(2, int(np.ceil(np.hypot(*(b - a)) / WAY_STEP)) + 1)
    d = distance_to_outline(a + np.linspace(0.0, 1.0, n)[:, None] * (b - a), outline)
    near = d < distance - ROUNDING
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
    for _ in range(MOST_STEPS):
        near = distance_to_outline((middle + far * out)[None], outline)[0] - distance
        if near < FOUND:
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
    target, left = _corner(p, v, goal, outline, distance, height, around)
    off = target - p
    away = np.linalg.norm(off)
    # What it can still brake from within what is left, in steps of dt, and not with all
    # of the acceleration: some is left to keep to it.
    brake = BRAKE * acceleration
    fast = min(speed, np.sqrt((brake * dt) ** 2 + 2.0 * brake * left) - brake * dt)
    if descent is not None and off[2] < -GOES_DOWN:
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
    rests = np.linalg.norm(v_next) < AT_REST
    arrived = np.linalg.norm(goal - p_next) < ARRIVED and rests
    return p_next, v_next, change / dt, bool(arrived)


def _corner(p, v, goal, outline, distance, height, around):
    """The next corner (3,) [m] of the way from p to the goal, and how far it is until
    the tip has to be at rest [m]. Arguments: as of travel_step."""
    across = np.hypot(*(goal - p)[:2])
    # Above the place, and not drifting away from above it while going down.
    above = across < ABOVE and np.hypot(*v[:2]) < AT_REST
    low = p[2] < height - LOW
    if above or (low and way_is_free(p[:2], goal[:2], outline, distance)):
        target = goal
    elif around and p[2] < goal[2] + BESIDE:
        target = np.array([*way_around(p[:2], goal[:2], outline, distance), goal[2]])
        return target, max(across, np.linalg.norm(target - p))
    elif low:
        target = np.array([*p[:2], height])
    else:
        target = np.array([*goal[:2], max(p[2], height)])
    return target, np.linalg.norm(target - p)
