"""Pieces of recordings, as recordings: given rows, or an evenly spread excerpt."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.data.channel_noise import with_noise
from makebreak.gap.data.findings import Finding, SceneFacts
from makebreak.gap.data.recording import FEWEST_ROWS, Episode, Recording
from makebreak.gap.numerics.runs import runs_of

# Of a long episode: ten blocks of time, of which every third is held out.
PIECE_SEC, PIECE_ROWS, PIECE_FEWEST = 12.0, 20_000, 100
# Of the time, that may be spent in touch or at a stop: else it lies there.
MOST_SHARE = 0.5
BESIDE_SEC, LEAST_SEC = 0.1, 0.5  # About a touch; a stretch without one.
BEYOND = 0.05  # Of a joint's range, by which a stop gives way.


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
    if not recordings:
        return []
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


def less_of(recording: Recording, near: np.ndarray) -> tuple[list[Episode], float]:
    """Episodes without the rows (n,) that are marked, and what is beside them, and how
    long that is [s]; no episodes where too much would be left out."""
    episodes: list[Episode] = []
    seconds = 0.0
    for episode in recording.episodes:
        time, own = recording.time[episode.rows], near[episode.rows].copy()
        for a, b in runs_of(own):
            own |= (time > time[a] - BESIDE_SEC) & (time < time[b - 1] + BESIDE_SEC)
        seconds += float(np.median(np.diff(time)) * own.sum())
        for number, (a, b) in enumerate(runs_of(~own)):
            if b - a >= FEWEST_ROWS and time[b - 1] - time[a] >= LEAST_SEC:
                first, last = episode.first + a, episode.first + b
                episodes.append(
                    Episode(episode.number, first, last, episode.stretch + number)
                )
    much = seconds >= MOST_SHARE * recording.duration_sec()
    return ([] if much else episodes), seconds


def at_stop(q: np.ndarray, lower: float, upper: float, near: float) -> np.ndarray:
    """(n,) where a joint is within `near` of a limit, or beyond; nowhere where it goes
    so far beyond one that it stops nothing."""
    low, high = q < lower + near, q > upper - near
    beyond = BEYOND * (upper - lower) if np.isfinite(upper - lower) else np.inf
    out = np.zeros(len(q), bool)
    if low.any() and np.nanmin(q) > lower - beyond:
        out |= low
    if high.any() and np.nanmax(q) < upper + beyond:
        out |= high
    return out


def without_stops(
    recordings: Sequence[Recording], facts: SceneFacts
) -> tuple[list[Recording], list[Finding]]:
    """The recordings less the times at which a joint is at a limit of its positions,
    where a stop pushes, which no equation has; and what was left out. All of them,
    which is said, where a joint is there most of the time."""
    out, found = [], []
    for recording in recordings:
        near, at = np.zeros(len(recording.time), bool), []
        for joint, own in facts.joints.items():
            if f"{joint}.position" not in recording.channels:
                continue
            channel = recording.channels[f"{joint}.position"]
            there = at_stop(channel.values, own.lower, own.upper, 3.0 * channel.noise)
            near |= there
            at += [joint] if there.any() else []
        episodes, seconds = less_of(recording, near) if at else ([], 0.0)
        out.append(part_of(recording, episodes) if episodes else recording)
        if at:
            share = float(np.mean(near))
            says = (
                f"{', '.join(at)} {'is' if len(at) == 1 else 'are'} at a limit of "
                f"{'its' if len(at) == 1 else 'their'} positions in {share:.1%} of the "
                "rows, where a stop pushes, which is in no equation: "
            )
            says += (
                f"{seconds:.2g} s about that are left out." if episodes else
                "too much to leave it out."
            )  # fmt: skip
            severity = "info" if episodes else "warning"
            found.append(
                Finding("at_limit", recording.name, f"{at[0]}.position", share, "1",
                        severity, says)
            )  # fmt: skip
    return out, found


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
