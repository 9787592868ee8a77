"""Interpolation between two commands of a slow planner, with bounded rates."""

import numba
import numpy as np


def clip_norm(vector, limit):
    """vector (n,), scaled down to the norm `limit` if it is longer."""
    largest = np.abs(vector).max()
    if largest > limit:  # First by the largest entry, so that no square overflows.
        vector = vector / largest * limit
    size = np.sqrt(vector @ vector)
    return vector if size <= limit else vector * (limit / size)


@numba.njit(cache=True)
def on_the_line(line, t, period_sec):
    """The reference at time t [s] on a line that takes period_sec [s].

    Args: line: (25,) = [start 12, end 12, time of the start].
    Returns: (12,) = [p, v, a, feed-forward force]; the start before the line, the end
        after it.
    """
    s = min(max((t - line[24]) / period_sec, 0.0), 1.0)
    return line[:12] + s * (line[12:24] - line[:12])


@numba.njit(cache=True)
def pose_and_wrench(line, t, period_sec):
    """on_the_line as (25,): x_desired (19,) = [p, quaternion, v, w, a, alpha] without
    rotation, and wrench (6,), force first."""
    now = on_the_line(line, t, period_sec)
    both = np.zeros(25)
    both[0:3], both[3] = now[0:3], 1.0
    both[7:10], both[13:16] = now[3:6], now[6:9]
    both[19:22] = now[9:12]
    return both


def no_nearer(p, v, force, nearest, wrist=(0.0, 0.0)):
    """The command with the wrist kept at least `nearest` [m] from the world's vertical
    axis: p (3,) is moved outwards, and components of v (3,) and force (3,) towards the
    axis are removed.

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
    """End of the line from `start` towards `target`, within bounds.

    Args: start, target: (12,) = [p, v, a, feed-forward force], each (3,); dp_max: bound
        of the change of p [m]; v_max, a_max: bounds of v and a [m/s], [m/s2]; dv_max:
        bound of the change of v [m/s].
    Returns: (12,); start at rest, without force, if target is not finite.
    """
    if not np.isfinite(target).all():
        return np.concatenate((start[:3], np.zeros(9)))
    end = target.copy()
    end[:3] = start[:3] + clip_norm(target[:3] - start[:3], dp_max)
    v = clip_norm(target[3:6], v_max)
    end[3:6] = start[3:6] + clip_norm(v - start[3:6], dv_max)
    end[6:9] = clip_norm(target[6:9], a_max)
    return end
