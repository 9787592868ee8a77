"""Stamps of rows, and the clock that they scatter about."""

import numpy as np
from scipy.ndimage import median_filter

_ROWS = 31  # Over which medians are taken.


def clock_period(t: np.ndarray) -> float:
    """Period [s] of stamps (n,) that scatter: the median over many rows at a time, as
    that of single steps is off by a share of the scatter."""
    if len(t) < 3 * _ROWS:
        return float(np.median(np.diff(t)))
    return float(np.median(t[_ROWS:] - t[:-_ROWS])) / _ROWS


def even_clock(t: np.ndarray) -> np.ndarray:
    """Stamps (n,) whose scatter about an even clock is taken out; the clock may drift
    and lose rows."""
    if len(t) < 3 * _ROWS:
        return t
    k, period = np.arange(len(t)), clock_period(t)
    even = period * k + median_filter(t - period * k, _ROWS, mode="nearest")
    return even if (np.diff(even) > 0.2 * period).all() else t
