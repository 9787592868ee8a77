"""Between two commands of a slow planner: straight lines and bounded slopes."""

import numpy as np


def clip_norm(vector, limit):
    """vector (n,), shortened to the norm limit if it is longer."""
    size = np.sqrt(vector @ vector)
    return vector if size <= limit else vector * (limit / size)


def on_the_line(start, end, share):
    """The point of the line from start to end (n,) after `share` of the time; before 0
    the start, after 1 the end."""
    return start + min(max(share, 0.0), 1.0) * (end - start)


def next_end(start, target, dv_max):
    """Where the line from `start` towards `target` ends.

    Args: start, target: (12,) = [p, v, a, feed-forward force], each (3,); dv_max: bound
        on how far v goes [m/s].
    Returns: (12,); start itself if target is not finite.
    """
    if not np.isfinite(target).all():
        return start.copy()
    end = target.copy()
    end[3:6] = start[3:6] + clip_norm(target[3:6] - start[3:6], dv_max)
    return end
