"""Where the times of a report count from, and what is shown on that clock."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording
from makebreak.gap.result import GapResult

_DATE_SEC = 1e6  # Stamps beyond it count from a date, as Unix time, and are unreadable.


def zero_of(first: float) -> float:
    """The time that is shown as 0 [s]: 0, or a recording's first stamp where its stamps
    count from a date. first: that stamp [s]."""
    return first if abs(first) > _DATE_SEC else 0.0


def zeros_of(recordings: Sequence[Recording]) -> dict[str, float]:
    """{recording: the stamp [s] that its times are shown from}: see `zero_of`."""
    return {each.name: zero_of(float(each.time[0])) for each in recordings}


def from_zero(result: GapResult, zeros: Mapping[str, float]) -> GapResult:
    """The result with the times that a reader sees counted from `zeros`."""
    where = [
        replace(w, from_s=w.from_s - zero, to_s=w.to_s - zero)
        for w in result.where
        for zero in (zeros.get(w.recording, 0.0),)
    ]
    series = [
        replace(s, time=s.time - zeros.get(s.recording, 0.0)) for s in result.series
    ]
    return replace(result, where=where, series=series)


def extents_of(
    recordings: Sequence[Recording],
) -> dict[tuple[str, int], tuple[float, float]]:
    """{(recording, episode): (first, last time) [s] as shown}, in their order."""
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for recording in recordings:
        zero = zero_of(float(recording.time[0]))
        for episode in recording.episodes:
            time = recording.time[episode.rows] - zero
            key = (recording.name, episode.number)
            low, high = found.get(key, (np.inf, -np.inf))
            found[key] = (min(low, float(time[0])), max(high, float(time[-1])))
    return found
