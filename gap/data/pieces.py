"""Pieces of recordings, as recordings: given rows, or an evenly spread excerpt."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.channel_noise import with_noise
from makebreak.gap.data.recording import FEWEST_ROWS, Episode, Recording

# Of a long episode: ten blocks of time, of which every third is held out.
PIECE_SEC, PIECE_ROWS, PIECE_FEWEST = 12.0, 20_000, 100


def part_of(recording: Recording, pieces: Sequence[Episode]) -> Recording:
    """Pieces of its episodes as a recording of their own, which knows nothing of the
    others: noise and rates are estimated from these rows."""
    return with_noise(_of_pieces(recording, pieces))


def excerpt(
    recordings: Sequence[Recording], most_sec: float, most_rows: int
) -> list[Recording]:
    """Recordings of no more than so much time [s] and so many rows together, to within
    half a piece.

    Pieces are of 12 s or 20 000 rows, or whole episodes where these are shorter, evenly
    spread. Noise and notes are those of the whole.
    """
    seconds = sum(r.duration_sec() for r in recordings)
    share = min(
        most_sec / max(seconds, 1e-9), most_rows / sum(len(r.time) for r in recordings)
    )
    if share >= 1.0:
        return list(recordings)
    pieces = [
        (i, piece)
        for i, recording in enumerate(recordings)
        for episode in recording.episodes
        for piece in _pieces(recording, episode)
    ]
    n = max(round(share * len(pieces)), 1)
    if n == len(pieces):  # A little too long: nothing is gained by cutting it.
        return list(recordings)
    kept = [pieces[int((k + 0.5) * len(pieces) / n)] for k in range(n)]
    out = []
    for i, recording in enumerate(recordings):
        mine = [piece for j, piece in kept if j == i]
        if mine:
            out.append(_of_pieces(recording, mine))
    return out


def _pieces(recording: Recording, episode: Episode) -> list[Episode]:
    """An episode cut into pieces of equal time, as excerpt says."""
    t = recording.time[episode.rows]
    n = min(round((t[-1] - t[0]) / PIECE_SEC), len(t) // PIECE_FEWEST)
    n = max(n, len(t) // PIECE_ROWS, 1)
    edges = np.searchsorted(t, t[0] + (t[-1] - t[0]) * np.arange(1, n) / n)
    edges = np.unique([0, *edges, len(t)])
    return [
        Episode(
            episode.number, episode.first + a, episode.first + b, episode.stretch + k
        )
        for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        if b - a >= FEWEST_ROWS or n == 1
    ]


def _of_pieces(recording: Recording, pieces: Sequence[Episode]) -> Recording:
    """The rows of the pieces alone."""
    rows = np.concatenate([np.arange(p.first, p.last) for p in pieces])
    ends = np.cumsum([p.last - p.first for p in pieces])
    episodes = tuple(
        Episode(p.number, int(end) - (p.last - p.first), int(end), p.stretch)
        for p, end in zip(pieces, ends, strict=True)
    )

    def of(values: np.ndarray) -> np.ndarray:
        some = values[rows]
        some.setflags(write=False)
        return some

    return replace(
        recording,
        time=of(recording.time),
        row=of(recording.row),
        episodes=episodes,
        channels={
            name: replace(c, values=of(c.values))
            for name, c in recording.channels.items()
        },
    )
