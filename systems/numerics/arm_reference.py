"""Between two commands of a slow planner: straight lines and bounded slopes."""

import numpy as np


def ticks_left(t, period_sec, offset_sec, tick_sec):
    """How many ticks, this one counted, until the planner's next command is due.

    The planner speaks at offset_sec + k period_sec; a tick at exactly that time still
    belongs to the command before.
    """
    since = (t - offset_sec) % period_sec
    return max(1, int(np.ceil((period_sec - since) / tick_sec - 1e-6)))


def approach(value, target, n_left, step_max):
    """One tick from value (n,) towards target (n,), due in n_left ticks; the step's
    norm is at most step_max."""
    step = (target - value) / n_left
    size = np.sqrt(step @ step)
    return value + (step if size <= step_max else step * (step_max / size))


def clip_norm(vector, limit):
    """vector (n,), shortened to the norm limit if it is longer."""
    size = np.sqrt(vector @ vector)
    return vector if size <= limit else vector * (limit / size)
