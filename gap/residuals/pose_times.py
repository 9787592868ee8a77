"""Poses of recordings at other rows: where a camera shows them late."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.recording import Recording


def earlier(
    recordings: Sequence[Recording], late: Mapping[str, float]
) -> list[Recording]:
    """Recordings with the samples of bodies' poses and velocities at the rows at which
    they were true, as near as rows are."""
    return [_earlier(r, late) for r in recordings] if late else list(recordings)


def _earlier(recording: Recording, late: Mapping[str, float]) -> Recording:
    channels = dict(recording.channels)
    for name, channel in recording.channels.items():
        by = late.get(name.rpartition(".")[0])
        if by is None:
            continue
        values = np.full(len(recording.time), np.nan)
        for episode in recording.episodes:
            time, y = recording.samples(name, episode)
            true = time - by
            rows = recording.time[episode.rows]
            there = true >= rows[0] - 1e-9
            at = np.searchsorted(0.5 * (rows[1:] + rows[:-1]), true[there])
            values[episode.first + at] = y[there]
        values.setflags(write=False)
        channels[name] = replace(channel, values=values)
    return replace(recording, channels=channels)
