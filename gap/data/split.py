"""What of recordings is fitted and chosen on, and what is only reported on.

The last part of every recording is cut off before anything is computed: noise levels,
checks, smoothing, windows and fits see the rest alone. It is looked at once, when all
is decided.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.data.pieces import part_of
from makebreak.gap.data.recording import FEWEST_ROWS, Episode, Recording

# Of each recording: its last fifth, in whole episodes where it has four or more.
# (Trials of one task end alike: a wall that each meets last would only be in the last
# fifths.)
REPORTED_SHARE, WHOLE_EPISODES = 0.2, 4
LEAST_SEC = 0.4  # A shorter part holds no window.


@dataclass(frozen=True)
class Split:
    """decided: on which all is fitted and chosen; reported: the rest, in which a
    recording may be missing."""

    decided: list[Recording]
    reported: list[Recording]


def split(recordings: Sequence[Recording]) -> Split:
    """Cuts off the last fifth: of the episodes of a recording that has four or more,
    else of the time of each of its episodes. Which rows these are follows from their
    times alone."""
    decided, reported = [], []
    for recording in recordings:
        first, last = _parts(recording)
        decided.append(part_of(recording, first))
        if last:
            reported.append(part_of(recording, last))
    return Split(decided, reported)


def with_noise_of(
    parts: Sequence[Recording], decided: Sequence[Recording]
) -> list[Recording]:
    """What is reported on, with the noise on which was decided."""
    known = {r.name: r for r in decided}
    return [
        replace(part, channels={
            name: replace(c, noise=(own := known[part.name].channels[name]).noise,
                          together=own.together)
            for name, c in part.channels.items()
        })
        for part in parts
    ]  # fmt: skip


def _parts(recording: Recording) -> tuple[list[Episode], list[Episode]]:
    episodes = list(recording.episodes)
    numbers = list(dict.fromkeys(e.number for e in episodes))
    if len(numbers) >= WHOLE_EPISODES:
        kept = set(numbers[: len(numbers) - round(REPORTED_SHARE * len(numbers))])
        return (
            [e for e in episodes if e.number in kept],
            [e for e in episodes if e.number not in kept],
        )
    first, last = [], []
    for e in episodes:
        time = recording.time[e.rows]
        cut = time[-1] - REPORTED_SHARE * (time[-1] - time[0])
        k = int(np.searchsorted(time, cut))
        enough = time[-1] - cut >= LEAST_SEC and len(time) - k >= FEWEST_ROWS
        if not enough or k < FEWEST_ROWS:
            first.append(e)
            continue
        first.append(Episode(e.number, e.first, e.first + k, e.stretch))
        last.append(Episode(e.number, e.first + k, e.last, e.stretch + 1))
    return first, last
