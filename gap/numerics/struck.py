"""Rows at which a body was struck: its acceleration is beyond what its noise makes."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.numerics.runs import runs_of
from makebreak.systems.numerics.filters import Stage
from makebreak.systems.numerics.smoother import smooth_filtered

FEWEST_ROWS = 8  # A shorter stretch is not divided further.
SURE = 3.0  # Standard deviations of an acceleration.


def struck_rows(
    time, samples, noise: float, stages: Sequence[Stage], least: float, beside: int
) -> np.ndarray:
    """(n,) where the second derivative of samples is above `least`.

    The density of a smoother that has to follow impacts lets it follow the noise in
    between as well (0.6 mm at 100 Hz: 30 m/s2). Where that is more than `least`, what
    is beyond doubt is an impact, and what lies between such impacts is smoothed anew:
    it is quiet then, or holds impacts that only show now.

    Args: time (n,) [s]; samples (n,), NaN where there is none; noise: of a sample;
        stages: the samples' filters; least: [unit/s2], above half of which nothing is
        accelerated but by what strikes it; beside: rows on either side of an impact
        that are mixed with it.
    """
    t, y = np.asarray(time, float), np.asarray(samples, float)
    struck = np.zeros(len(t), bool)
    left = [(0, len(t))]
    while left:
        a, b = left.pop()
        if np.isfinite(y[a:b]).sum() < FEWEST_ROWS:
            continue
        s = smooth_filtered(t[a:b], y[a:b], noise, stages)
        std = np.sqrt(np.maximum(s.P[:, 2, 2], 0.0))
        sure = np.maximum(least, 0.5 * least + SURE * std)
        usual = float(np.median(std))
        found = np.abs(s.x[:, 2]) > sure
        if usual > least and found.any():
            near = np.convolve(found, np.ones(2 * beside + 1), "same") > 0.5
            left += [(a + i, a + j) for i, j in runs_of(~near)]
        elif b - a == len(t) or SURE * usual > 0.5 * least:
            found = np.abs(s.x[:, 2]) > least
        struck[a:b] |= found
    return struck
