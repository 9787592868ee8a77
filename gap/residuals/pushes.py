"""Stretches of time in which something else moved a mechanism: a person's push.

A model that lacks nothing ordinary leaves about the same everywhere. Where for once it
leaves many times as much, and the motion was nothing that the rest of the log does not
have as well, no effect of the catalogue is at work: those act again wherever their
cause comes back. Such stretches get next to no weight, and are told.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.residuals.track import Track

ROBUST = 1.4826  # Standard deviation over median absolute deviation, if normal.
# Over what is left elsewhere, for so many test functions in a row (0.1 s apart).
OUT, LEAST_ROWS, BESIDE = 8.0, 4, 2
MERGED_SEC = 0.35  # Between two of them less is one stretch.
# At its peak, by far: less may be left of friction that is modelled a little wrongly.
PEAK = 25.0
# More stretches of a joint, or a larger share of the time, are an effect that comes
# back.
MOST_STRETCHES, MOST_SHARE = 2, 0.2
# A position or a speed farther out than all others by this share of their range: an
# end stop, or what only shows there.
BEYOND = 0.1
FELT = 0.05  # Of the largest effort that the robot needs: less moves no robot.
PART = 0.2  # Of a joint's largest: a stretch with less is another matter.


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
    tracks: Sequence[Track],
    joints: Sequence[str],
    left: np.ndarray,
    noise: np.ndarray,
    needed: np.ndarray,
) -> list[Push]:
    """Stretches in which something else moved the mechanism.

    Args: left (n_bumps, n_joints): what a rich model leaves of the joints' efforts, of
        all tracks one after the other; noise: of the same shape, what sensors give;
        needed (n_joints,): rms of the efforts that the motion needs.
    """
    scale = np.maximum(ROBUST * np.median(np.abs(left), axis=0), np.median(noise, 0))
    z = np.abs(left) / np.maximum(scale, 1e-12)
    q, v = (_at_centres(tracks, what) for what in ("q", "v"))
    starts = np.cumsum([0, *(len(track.bumps.centre) for track in tracks)])
    spans: list[tuple[int, int, int, int]] = []  # Track, first, last, joint.
    for k in range(len(joints)):
        mine = [
            (i, starts[i] + a, starts[i] + b)
            for i, track in enumerate(tracks)
            for a, b in _stretches(track, z[starts[i] : starts[i + 1], k])
        ]
        most = max((z[a:b, k].max() for _, a, b in mine), default=0.0)
        mine = [each for each in mine if z[each[1] : each[2], k].max() > PART * most]
        pushed = np.zeros(len(left), bool)
        for _, a, b in mine:
            pushed[a:b] = True
        rare = len(mine) <= MOST_STRETCHES and pushed.sum() <= MOST_SHARE * len(left)
        if most < PEAK or not rare:
            continue
        x, speed = q[:, k], np.abs(v[:, k])
        if not (_is_beyond(x, pushed) or _is_beyond(speed, pushed, low=False)):
            spans += [(i, int(a), int(b), k) for i, a, b in mine]
    pushes = [
        _push(tracks[i], joints, a, b, some, left, z, int(starts[i]))
        for i, a, b, some in _together(spans)
    ]
    return [p for p in pushes if max(e for _, e in p.efforts) > FELT * needed.max()]


def _together(spans) -> list[tuple[int, int, int, list[int]]]:
    """Spans of several joints that overlap, as one with these joints."""
    out: list[tuple[int, int, int, list[int]]] = []
    for i, a, b, k in sorted(spans):
        if out and out[-1][0] == i and a < out[-1][2]:
            last = out.pop()
            out.append((i, last[1], max(b, last[2]), [*last[3], k]))
        else:
            out.append((i, a, b, [k]))
    return out


def _push(track: Track, joints, a: int, b: int, some, left, z, first: int) -> Push:
    size = np.sqrt(np.mean(left[a:b] ** 2, axis=0))
    order = sorted(dict.fromkeys(some), key=lambda k: -z[a:b, k].max())
    centre, half = track.bumps.centre, 0.5 * track.bumps.width
    return Push(
        track.recording, track.episode,
        float(centre[a - first] - half), float(centre[b - 1 - first] + half),
        tuple((joints[k], float(size[k])) for k in order), tuple(range(a, b)),
    )  # fmt: skip


def _stretches(track: Track, z: np.ndarray) -> list[tuple[int, int]]:
    """[first, last) test functions of each stretch with enough that stand out, and
    those beside it: what it begins and ends in is smoothed away."""
    centre = track.bumps.centre
    out = np.flatnonzero(z > OUT)
    groups: list[list[int]] = []
    for k in out:
        if groups and centre[k] - centre[groups[-1][-1]] < MERGED_SEC:
            groups[-1].append(int(k))
        else:
            groups.append([int(k)])
    return [
        (max(g[0] - BESIDE, 0), min(g[-1] + 1 + BESIDE, len(z)))
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
    """Whether some of x (n,) lie clearly beyond all the others."""
    if some.all():
        return True
    least, most = float(x[~some].min()), float(x[~some].max())
    slack = BEYOND * (most - least)
    above = x[some].max() > most + slack
    below = low and x[some].min() < least - slack
    return bool(above or below)
