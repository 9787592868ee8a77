"""The rows of a table as episodes without breaks."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from makebreak.gap.data.recording import FEWEST_ROWS, Episode

# A longer hole in time [s] is a break, as is one of so many periods.
LONGEST_HOLE_SEC, LONGEST_HOLE_ROWS = 1.0, 50


def counted_parts(
    columns: Mapping[str, np.ndarray], row: np.ndarray, is_excerpt: bool
) -> np.ndarray:
    """(n,) counts from 0 the parts of the table in which time must increase; rows of an
    excerpt jump where some were left out."""
    new = np.concatenate([[0], (np.diff(row) > 1) & is_excerpt])
    episode = columns.get("episode")
    if episode is not None:
        bad = np.flatnonzero(~(np.mod(episode, 1.0) == 0.0))
        if bad.size:
            raise ValueError(
                f"column episode, row {row[bad[0]]}: got "
                f"{episode[bad[0]]}, expected an integer"
            )
        new = new | np.concatenate([[0], np.diff(episode) != 0])
    return np.cumsum(new).astype(float)


def episodes_of(
    path: Path,
    number: np.ndarray | None,
    part: np.ndarray,
    time: np.ndarray,
    row: np.ndarray,
) -> tuple[Episode, ...]:
    """A table's parts, counted by `part` (n,), as episodes of the column `number`."""
    starts = np.flatnonzero(np.diff(part, prepend=-1.0))
    ends = [*starts[1:], len(part)]
    episodes: list[Episode] = []
    stretches: dict[int, int] = {}
    for first, last in zip(starts, ends, strict=True):
        n = 0 if number is None else int(number[first])
        if n in stretches and episodes[-1].number != n:
            raise ValueError(
                f"recording {path}: episode {n} comes back after episode "
                f"{episodes[-1].number}: rows out of order"
            )
        # An episode of which the first rows were left out starts with stretch 1.
        whole = row[first] == 1 or (first > 0 and row[first] == row[first - 1] + 1)
        stretches[n] = stretches.get(n, -1 if whole else 0) + 1
        if last - first < FEWEST_ROWS:
            raise ValueError(
                f"recording {path}: episode {n} has {last - first} rows, from "
                f"{time[first]} s on; expected at least {FEWEST_ROWS}"
            )
        episodes.append(Episode(n, int(first), int(last), stretches[n]))
    return tuple(episodes)


def broken_at_holes(
    path: Path, episodes: Sequence[Episode], time: np.ndarray
) -> tuple[tuple[Episode, ...], list[tuple[str, str]]]:
    """Episodes without long holes in time, and what is to be said of it.

    What lies between two holes and has too few rows is left out.
    """
    found, notes = [], []
    for episode in episodes:
        steps = np.diff(time[episode.rows])
        most = max(LONGEST_HOLE_SEC, LONGEST_HOLE_ROWS * float(np.median(steps)))
        breaks = np.flatnonzero(steps > most) + 1
        if not breaks.size:
            found.append(episode)
            continue
        edges = episode.first + np.array([0, *breaks, episode.last - episode.first])
        parts = [
            Episode(episode.number, int(a), int(b), episode.stretch + k)
            for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        ]
        short = sum(p.last - p.first for p in parts if p.last - p.first < FEWEST_ROWS)
        says = (
            f"{path.name}, episode {episode.number}, has {len(breaks)} holes in time, "
            f"the longest of {steps.max():.4g} s; no window reaches across them"
        )
        if short:
            says += f", and {short} rows that stand alone are not used"
        notes.append(("hole", says))
        found += [p for p in parts if p.last - p.first >= FEWEST_ROWS]
    if not found:
        raise ValueError(
            f"recording {path}: no {FEWEST_ROWS} rows follow one another without a "
            "hole in time"
        )
    return tuple(found), notes


def without_ignored(
    path: Path,
    episodes: tuple[Episode, ...],
    time: np.ndarray,
    spans: Sequence[tuple[float, float, int | None]],
) -> tuple[tuple[Episode, ...], list[tuple[str, str]]]:
    """Episodes without the spans [s] that the sidecar leaves out, of one episode or,
    None, of all, and what is to be said of it."""
    if not spans:
        return episodes, []
    found, gone = [], 0
    for e in episodes:
        t = time[e.rows]
        kept = np.ones(len(t), bool)
        for first, last, of in spans:
            if of is None or of == e.number:
                kept &= (t < first) | (t > last)
        gone += int((~kept).sum())
        starts = np.flatnonzero(np.diff(kept.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(kept.astype(int), append=0) == -1) + 1
        for k, (a, b) in enumerate(zip(starts, ends, strict=True)):
            if b - a >= FEWEST_ROWS:
                stretch = e.stretch + k + (1 if a and not k else 0)
                found.append(
                    Episode(e.number, e.first + int(a), e.first + int(b), stretch)
                )
    says = ", ".join(f"{a:g} to {b:g} s" for a, b, _ in spans)
    if not gone:
        raise ValueError(
            f"sidecar of {path}: ignore {says}: no row is there, time goes from "
            f"{time[0]:g} to {time[-1]:g} s"
        )
    if not found:
        raise ValueError(f"sidecar of {path}: ignore leaves no {FEWEST_ROWS} rows")
    note = f"{path.name}: {gone} rows are left out as its sidecar says, {says}"
    return tuple(found), [("ignored", note)]
