"""A motion pattern from one recorded demonstration: the tool's poses and the forces on
it say where segments begin and in which directions they press.

Source: Sidhik et al., section 3 ("obtained through a single demonstration of the task
by a human moving the manipulator").
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import butter, filtfilt
from scipy.spatial.transform import Rotation

from makebreak.systems.changing_contact.numerics.motion_pattern import (
    MotionPattern,
    Segment,
    least_time,
    unit_rows,
)

SLOWEST = 0.002  # [m/s]: a tip that is slower counts as standing.
AXES = tuple(sign * row for row in np.eye(3) for sign in (1.0, -1.0))


def pattern_from_demonstration(
    time,
    pose,
    force,
    directions: Sequence = AXES,
    force_threshold: float = 1.0,
    cutoff_hz: float = 3.0,
    straight_within: float = 0.003,
    contact_sec_min: float = 0.1,
    acceleration_max: float = 1.0,
) -> MotionPattern:
    """A pattern from one recorded demonstration.

    Poses are smoothed (Butterworth, forwards and backwards: no lag). A direction counts
    as force-controlled where the tool presses along it with more than the threshold
    (half of it to be let go) for at least contact_sec_min, and does not move along it:
    friction is no contact. A new segment begins where the set of directions changes, or
    where the motion has stopped and turned. A segment is a line if its points lie
    within straight_within of its chord, else a smooth path through points.

    Args: time (n,) [s]; pose (n, 7) = [p_WE, quaternion wxyz]; force (n, 3) on the
        tool, world axes [N]; directions: unit vectors that may be pressed along;
        force_threshold [N]; straight_within [m]; acceleration_max [m/s2] of the
        pattern; where the demonstration was faster, that segment takes longer.
    Raises: ValueError if times repeat or are unordered, or anything is not finite.
    """
    t, X, F = (np.array(x, dtype=float) for x in (time, pose, force))
    n = len(t)
    if t.shape != (n,) or X.shape != (n, 7) or F.shape != (n, 3) or n < 20:
        raise ValueError(
            f"demonstration: time {t.shape}, pose {X.shape}, force {F.shape}, expected "
            "(n,), (n, 7), (n, 3), n >= 20"
        )
    for name, value in (("time", t), ("pose", X), ("force", F)):
        if not np.all(np.isfinite(value)):
            row = int(np.argwhere(~np.isfinite(value))[0][0])
            raise ValueError(f"demonstration: {name} of row {row} is not finite")
    bad = np.flatnonzero(np.diff(t) <= 0.0)
    if bad.size:
        raise ValueError(
            f"demonstration: time {t[bad[0] + 1]} follows {t[bad[0]]} in row "
            f"{bad[0] + 1}, expected increasing times"
        )
    normals = unit_rows(directions, "directions")
    dt = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + 0.5 * dt, dt)
    if not 2.0 * cutoff_hz * dt < 1.0:
        raise ValueError(
            f"cutoff_hz is {cutoff_hz}, expected below {0.5 / dt:.3g}, half the rate"
        )
    b, a = butter(2, 2.0 * cutoff_hz * dt)

    def smooth(values):
        even = np.stack([np.interp(grid, t, column) for column in values.T], axis=1)
        return filtfilt(b, a, even, axis=0, padlen=min(3 * len(b) * 10, len(grid) - 1))

    base = X[0, 3:]
    q = Rotation.from_quat(X[:, 3:], scalar_first=True)
    turn = q * Rotation.from_quat(base, scalar_first=True).inv()
    p, r, f = smooth(X[:, :3]), smooth(turn.as_rotvec()), smooth(F)
    v = np.gradient(p, dt, axis=0)
    speed = np.linalg.norm(v, axis=1)
    moving = speed > max(0.02 * speed.max(), SLOWEST)
    d = v / np.maximum(speed, 1e-9)[:, None]
    pressed = np.zeros((len(grid), len(normals)), dtype=bool)
    for i, normal in enumerate(normals):
        load = -f @ normal
        free = moving & (abs(d @ normal) > 0.3)
        for j in range(len(grid)):
            held = j > 0 and pressed[j - 1, i]
            enough = load[j] > (0.5 if held else 1.0) * force_threshold
            pressed[j, i] = enough and not free[j]
        _drop_short(pressed[:, i], max(1, round(contact_sec_min / dt)))
    codes = pressed @ (1 << np.arange(len(normals)))
    cuts = [0, *(np.flatnonzero(np.diff(codes)) + 1), len(grid)]
    segments: list[Segment] = []
    start, clock = p[0], float(grid[0])
    start_r = r[0]
    for first, last in zip(cuts[:-1], cuts[1:], strict=True):
        end = min(last, len(grid) - 1)
        points = np.hstack([p[first : end + 1], r[first : end + 1]])
        points = np.vstack([np.concatenate([start, start_r]), points[1:]])
        chosen = _thin(points, straight_within)
        if chosen is None:  # It hardly moved: the next one starts where this did.
            continue
        on = np.flatnonzero(pressed[(first + end) // 2])[:2]
        targets = [
            float(max(np.median(-f[first : end + 1] @ normals[i]), 0.1)) for i in on
        ]
        quaternions = (
            Rotation.from_rotvec(chosen[:, 3:])
            * Rotation.from_quat(base, scalar_first=True)
        ).as_quat(scalar_first=True)
        kind = "line" if len(chosen) == 2 else "spline"
        segment = Segment(
            kind, chosen[:, :3], np.array([0.0, 1.0]), quaternions,
            normals[on], np.array(targets),
        )  # fmt: skip
        duration = max(
            float(grid[end] - grid[first]),
            1.002 * least_time(segment, acceleration_max),
        )
        segments.append(replace(segment, times=np.array([clock, clock + duration])))
        clock += duration
        start, start_r = chosen[-1, :3], chosen[-1, 3:]
    if not segments:
        raise ValueError("demonstration: the tip hardly moved, expected a motion")
    return MotionPattern(tuple(segments), acceleration_max)


def _drop_short(flags, shortest):
    """In place: runs of True shorter than `shortest` become False, then gaps between
    runs that are as short become True."""
    for value in (True, False):
        edges = np.flatnonzero(np.diff(flags.astype(int))) + 1
        runs = [0, *edges, len(flags)]
        for a, b in zip(runs[:-1], runs[1:], strict=True):
            inside = a > 0 and b < len(flags)
            if flags[a] == value and b - a < shortest and (value or inside):
                flags[a:b] = not value


def _thin(points, within):
    """Two points of a straight run, or some of a curved one; None if it stays put."""
    p = points[:, :3]
    steps = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]
    )
    chord = p[-1] - p[0]
    size = np.linalg.norm(chord)
    if steps[-1] < max(2.0 * within, 1e-5):
        return None
    if size > 1e-9:
        along = np.outer((p - p[0]) @ chord / size**2, chord)
        if np.linalg.norm(p - p[0] - along, axis=1).max() <= within:
            return points[[0, -1]]
    n = int(np.clip(steps[-1] / (8.0 * max(within, 1e-3)), 3, 60)) + 1
    wanted = np.linspace(0.0, steps[-1], n)
    return np.stack([np.interp(wanted, steps, x) for x in points.T], axis=1)
