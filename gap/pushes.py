"""Stretches of time in which something else moved a mechanism: a person's push.

A model that lacks nothing ordinary leaves about the same everywhere. Where for once it
leaves many times as much, and the motion was nothing that the rest of the log does not
have as well, no effect of the catalogue is at work: those act again wherever their
cause comes back. Such stretches get next to no weight, and are told.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.inverse import Track

ROBUST = 1.4826  # Standard deviation over median absolute deviation, if normal.
# Over what is left elsewhere, for so many test functions in a row (0.1 s apart).
OUT, LEAST_ROWS = 8.0, 4
MERGED_SEC = 0.35  # Between two of them less is one stretch.
# More stretches, or a larger share of the time, are an effect that comes back.
MOST_STRETCHES, MOST_SHARE = 2, 0.2
# A position or a speed farther out than all others by this share of their range: an
# end stop, or what only shows there.
BEYOND = 0.1
PART = 0.25  # Of the most affected joint's: a joint with less was moved along.


@dataclass(frozen=True)
class Push:
    """From, to [s] in an episode; joints, the most pushed first, and the rms of what
    the model does not explain there [N m] or [N]. rows: which test functions."""

    recording: str
    episode: int
    start: float
    end: float
    efforts: tuple[tuple[str, float], ...]
    rows: tuple[int, ...]


def find_pushes(
    tracks: Sequence[Track], joints: Sequence[str], left: np.ndarray, noise: np.ndarray
) -> list[Push]:
    """Stretches in which something else moved the mechanism.

    Args: left (n_bumps, n_joints): what a rich model leaves of the joints' efforts, of
        all tracks one after the other; noise: of the same shape, what sensors give.
    """
    scale = np.maximum(ROBUST * np.median(np.abs(left), axis=0), np.median(noise, 0))
    z = np.abs(left) / np.maximum(scale, 1e-12)
    found, first = [], 0
    for track in tracks:
        n = len(track.bumps.centre)
        for a, b in _stretches(track, z[first : first + n].max(axis=1)):
            found.append((track, a, b, first))
        first += n
    rows = sum(b - a for _, a, b, _ in found)
    if not found or len(found) > MOST_STRETCHES or rows > MOST_SHARE * len(left):
        return []
    q, v = (_at_centres(tracks, what) for what in ("q", "v"))
    pushed = np.zeros(len(left), bool)
    for _, a, b, first in found:
        pushed[first + a : first + b] = True
    if _is_beyond(q, pushed) or _is_beyond(np.abs(v), pushed, low=False):
        return []
    pushes = []
    for track, a, b, first in found:
        mine = slice(first + a, first + b)
        size = np.sqrt(np.mean(left[mine] ** 2, axis=0))
        most = np.argsort(-z[mine].max(axis=0))
        out = z[mine].max(axis=0)
        named = [k for k in most if out[k] > OUT and out[k] > PART * out[most[0]]]
        centre, half = track.bumps.centre, 0.5 * track.bumps.width
        pushes.append(
            Push(
                track.recording, track.episode,
                float(centre[a] - half), float(centre[b - 1] + half),
                tuple((joints[k], float(size[k])) for k in named),
                tuple(range(first + a, first + b)),
            )
        )  # fmt: skip
    return pushes


def _stretches(track: Track, z: np.ndarray) -> list[tuple[int, int]]:
    """[first, last) test functions of each stretch with enough that stand out, and one
    more at each side: what it begins and ends in."""
    centre = track.bumps.centre
    out = np.flatnonzero(z > OUT)
    groups: list[list[int]] = []
    for k in out:
        if groups and centre[k] - centre[groups[-1][-1]] < MERGED_SEC:
            groups[-1].append(int(k))
        else:
            groups.append([int(k)])
    return [
        (max(g[0] - 1, 0), min(g[-1] + 2, len(z)))
        for g in groups
        if len(g) >= LEAST_ROWS
    ]


def _at_centres(tracks: Sequence[Track], what: str) -> np.ndarray:
    each = []
    for track in tracks:
        of = getattr(track, what)
        each.append(
            np.stack(
                [np.interp(track.bumps.centre, track.grid, x) for x in of.T], axis=1
            )
        )
    return np.concatenate(each)


def _is_beyond(x: np.ndarray, some: np.ndarray, low: bool = True) -> bool:
    """Whether some (n,) of x (n, k) lie clearly beyond all the others."""
    if some.all():
        return True
    least, most = x[~some].min(axis=0), x[~some].max(axis=0)
    slack = BEYOND * (most - least)
    above = (x[some].max(axis=0) > most + slack).any()
    below = low and (x[some].min(axis=0) < least - slack).any()
    return bool(above or below)
