"""From true values at simulated instants to what a sensor shows at its stamps."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from makebreak.gap.data.filters import FILTERED_SEC
from makebreak.models.effects.measured_channels import ChannelMap
from makebreak.systems.numerics.filters import (
    Stage,
    filtered,
    subdivided,
    with_lag,
)

SAME_SEC = 1e-9  # Times that are no further apart are one.


def stages_of(
    channels: Sequence[str],
    filters: Mapping[str, Sequence[Stage]],
    maps: Mapping[str, ChannelMap],
) -> dict[str, tuple[Stage, ...]]:
    """{channel: its filters and the scene's sensor_lag}, of those that have any."""
    stages = {}
    for channel in channels:
        own = tuple(filters.get(channel, ()))
        for lag in maps.get(channel, ChannelMap()).lags:
            own = with_lag(own, lag)
        if own:
            stages[channel] = own
    return stages


def instants(
    start: float, times: np.ndarray, shown: Iterable[np.ndarray], has_filters: bool
) -> np.ndarray:
    """The instants (m,) [s] from `start` on at which true values are needed.

    Args: times (n,): stamps; shown: for each channel that shows other times than its
        stamps, these (n,).
    """
    between = np.zeros(0)
    if has_filters:
        edges = np.concatenate([[start], times[times > start]])
        between = subdivided(edges, FILTERED_SEC)
    needed = np.unique(np.concatenate([times, *shown, between]))
    return needed[needed >= start - SAME_SEC]


def behind(
    stages: Sequence[Stage],
    times: np.ndarray,
    values: np.ndarray,
    before: tuple[np.ndarray, np.ndarray] | None,
) -> np.ndarray:
    """(n,) values behind filters that remember what was before: times and values."""
    if before is None or not len(before[0]) or len(times) + len(before[0]) < 2:
        return filtered(stages, times, values) if len(times) > 1 else values
    since = (
        before[0] < times[0] - SAME_SEC if len(times) else np.ones(len(before[0]), bool)
    )
    t = np.concatenate([before[0][since], times])
    x = np.concatenate([before[1][since], values])
    return filtered(stages, t, x)[int(since.sum()) :]


def with_middles(
    times: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Times (2 m - 1,) and velocities with one between each two, so that their integral
    is what the position (m,) has: between them a drive that gets a new command swings.
    """
    h = np.diff(times)
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    long = h > 1e-6
    rate = np.where(long, np.diff(position) / np.where(long, h, 1.0), mean)
    fine, values = np.empty(2 * len(times) - 1), np.empty(2 * len(times) - 1)
    fine[::2], fine[1::2] = times, times[:-1] + 0.5 * h
    values[::2], values[1::2] = velocity, 2.0 * rate - mean
    return fine, values


def samples_at(
    at: np.ndarray, times: np.ndarray, values: np.ndarray, start: float
) -> np.ndarray:
    """(n,) of the values (m,) those at some of their times; NaN before the start.

    Args: at (n,): of `times` (m,), or before them [s].
    """
    here = np.searchsorted(times, at - SAME_SEC)
    found = np.full(len(at), np.nan)
    good = (here < len(times)) & (at >= start - SAME_SEC)
    found[good] = values[here[good]]
    return found


def between(time: np.ndarray, x: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """Rows of x (m, n) at the needed times, with a line between samples."""
    row = np.clip(np.searchsorted(time, needed, "right") - 1, 0, max(len(time) - 2, 0))
    after = np.minimum(row + 1, len(time) - 1)
    step = time[after] - time[row]
    share = np.where(
        step > 0.0, (needed - time[row]) / np.where(step > 0, step, 1), 0.0
    )
    share = np.clip(share, 0.0, 1.0)[:, None]
    return (1.0 - share) * x[row] + share * x[after]
