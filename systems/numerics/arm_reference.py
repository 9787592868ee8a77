"""Between two commands of a slow planner: straight lines and bounded slopes."""

import numba
import numpy as np


@numba.njit(cache=True)
def ticks_left(t, period_sec, offset_sec, tick_sec):
    """How many ticks, this one counted, until the planner's next command is due.

    The planner speaks at offset_sec + k period_sec; a tick at exactly that time still
    belongs to the command before.
    """
    since = (t - offset_sec) % period_sec
    return max(1, int(np.ceil((period_sec - since) / tick_sec - 1e-6)))


@numba.njit(cache=True)
def approach(value, target, n_left, step_max):
    """One tick from value (n,) towards target (n,), due in n_left ticks; the step's
    norm is at most step_max."""
    return value + clip_norm((target - value) / n_left, step_max)


@numba.njit(cache=True)
def clip_norm(vector, limit):
    """vector (n,), shortened to the norm limit if it is longer."""
    size = np.sqrt(np.sum(vector * vector))
    return vector * (limit / size) if size > limit else vector * 1.0


@numba.njit(cache=True)
def step(reference, target, n_left, dv_max):
    """One tick of the whole reference.

    Args: reference, target: (12,) = [p, v, a, feed-forward force], each (3,);
        dv_max: bound on the step of v [m/s].
    Returns: (12,); the reference as it was if anything is not finite.
    """
    new = np.empty(12)
    for i in range(4):
        part = slice(3 * i, 3 * i + 3)
        bound = dv_max if i == 1 else np.inf
        new[part] = approach(reference[part], target[part], n_left, bound)
    return new if np.isfinite(new).all() else reference * 1.0
