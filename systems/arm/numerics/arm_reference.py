"""Between two commands of a slow planner: straight lines and bounded slopes."""

import numba
import numpy as np


def clip_norm(vector, limit):
    """vector (n,), shortened to the norm limit if it is longer."""
    largest = np.abs(vector).max()
    if largest > limit:  # So that no square overflows.
        vector = vector / largest * limit
    size = np.sqrt(vector @ vector)
    return vector if size <= limit else vector * (limit / size)


@numba.njit(cache=True)
def on_the_line(line, t, period_sec):
    """Where the reference is at time t [s] on a line that takes period_sec.

    Args: line: (25,) = [start 12, end 12, time of the start].
    Returns: (12,); before the line the start, after it the end.
    """
    share = min(max((t - line[24]) / period_sec, 0.0), 1.0)
    return line[:12] + share * (line[12:24] - line[:12])


@numba.njit(cache=True)
def pose_and_wrench(line, t, period_sec):
    """The same as x_desired (19,) = [p, quaternion, v, w, a, alpha], unturned, and as
    wrench (6,), force first: (25,)."""
    now = on_the_line(line, t, period_sec)
    both = np.zeros(25)
    both[0:3], both[3] = now[0:3], 1.0
    both[7:10], both[13:16] = now[3:6], now[6:9]
    both[19:22] = now[9:12]
    return both


def no_nearer(p, v, force, nearest, wrist=(0.0, 0.0)):
    """The same command, none of which leads the wrist nearer to the world's origin,
    across the table, than nearest [m]: the tip's p (3,) lies at least so far away, and
    there v (3,) and force (3,) have no part towards the origin.

    Args: wrist (2,): from the wrist to the tip, seen from above [m].
    """
    x, y = p[0] - wrist[0], p[1] - wrist[1]
    far = np.hypot(x, y)
    if far >= nearest:
        return p, v, force
    out = np.array([x, y, 0.0]) / max(far, 1e-9)
    p = p + (nearest - far) * out
    return p, v - min(v @ out, 0.0) * out, force - min(force @ out, 0.0) * out


def next_end(start, target, dp_max, v_max, dv_max, a_max):
    """Where the line from `start` towards `target` ends.

    Args: start, target: (12,) = [p, v, a, feed-forward force], each (3,); dp_max: bound
        on how far p goes [m]; v_max, a_max: bounds on v and a at the end [m/s],
        [m/s2]; dv_max: on how far v goes [m/s].
    Returns: (12,), p, v, a within these bounds; start at rest, without force, if target
        is not finite.
    """
    if not np.isfinite(target).all():
        return np.concatenate((start[:3], np.zeros(9)))
    end = target.copy()
    end[:3] = start[:3] + clip_norm(target[:3] - start[:3], dp_max)
    v = clip_norm(target[3:6], v_max)
    end[3:6] = start[3:6] + clip_norm(v - start[3:6], dv_max)
    end[6:9] = clip_norm(target[6:9], a_max)
    return end
