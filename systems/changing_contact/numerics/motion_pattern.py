"""A target motion pattern: a list of segments, each a smooth pose path over time, with
the directions under force control.

A segment is a straight line, a circular arc, or a smooth path through points. Along it
the speed is constant but for its two ends: it changes by the profile of equation 11
(C-infinity) within a_max, from rest and to rest. It is not slowed down at its end if it
ends in a contact (the contact stops it), nor where the next segment goes straight on.

Contacts are not labelled: that a segment ends in one follows from a force direction
that the next segment has and this one lacks; that it ends in the loss of one, from a
direction that the next one lacks while it goes on along the same line.

Source: Sidhik et al., section 3 ("a sequence of mappings from time to the end-effector
pose and force ... segments that are (each) assumed to be smooth, continuous, and
jerk-free").
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from makebreak.systems.changing_contact.numerics.path_geometry import (
    ARC,
    DATA,
    DIRECTIONS,
    END,
    GOES_ON,
    HEAD,
    IN_CONTACT,
    IN_LOSS,
    KIND,
    LENGTH,
    LINE,
    N_FORCE,
    SPEED,
    SPLINE,
    START,
    TARGETS,
    arc_data,
    largest_curvature,
    line_data,
    path_point,
    rotation_motion,
    spline_data,
)
from makebreak.systems.changing_contact.numerics.velocity_profile import (
    speed_transition,
    transition_time,
)

KINDS = ("line", "arc", "spline")
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # Tool down: then frame tip's axes are the world's.
_POSITION_TOL, _ANGLE_TOL = 1e-6, 1e-6  # [m], [rad]: rounding of a file's digits.
_AGES = 1e4  # [s] In which any segment is passed slowly.
_SLACK = 1.001  # Of acceleration_max in a bend: rounding of times.
_TURN_MAX = np.deg2rad(170.0)  # Of any orientation from the first: rotation vectors.


def unit_rows(rows, what):
    """(n, 3) of rows, checked. Raises: ValueError for one that is no unit vector."""
    n = np.array(rows, dtype=float).reshape(-1, 3) if len(rows) else np.zeros((0, 3))
    for row in n:
        if not abs(np.linalg.norm(row) - 1.0) < 1e-6:
            raise ValueError(f"{what} has {row.tolist()}, expected unit vectors")
    return n


@dataclass(frozen=True, eq=False)
class Segment:
    """One smooth piece of a pattern.

    Args: kind: "line" (positions: start, end), "arc" (start, a point on it, end) or
        "spline" (three or more points). positions (n, 3) p_WE [m]. times (2,) of start
        and end [s]. quaternions wxyz: one for all, or (n, 4). force_directions (0 to 2,
        3), unit vectors into the surface; force_targets [N], one each.
    Raises: ValueError, by name.
    """

    kind: str
    positions: np.ndarray
    times: np.ndarray
    quaternions: np.ndarray = UPRIGHT  # type: ignore[assignment]
    force_directions: np.ndarray = ()  # type: ignore[assignment]
    force_targets: np.ndarray = ()  # type: ignore[assignment]

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f"kind is {self.kind!r}, expected one of {KINDS}")
        try:
            p = np.array(self.positions, dtype=float)
            times = np.array(self.times, dtype=float).ravel()
            q = np.atleast_2d(np.array(self.quaternions, dtype=float))
            targets = np.array(self.force_targets, dtype=float).ravel()
            n = unit_rows(self.force_directions, "force_directions")
        except (TypeError, ValueError) as error:
            raise ValueError(f"segment: {error}") from None
        wanted = {"line": "2", "arc": "3", "spline": "3 or more"}[self.kind]
        if p.ndim != 2 or p.shape[1] != 3 or not np.all(np.isfinite(p)):
            raise ValueError(
                f"positions are {self.positions}, expected rows of 3 finite numbers"
            )
        if not (len(p) == int(wanted[0]) or (self.kind == "spline" and len(p) > 3)):
            raise ValueError(f"a {self.kind} has {len(p)} positions, expected {wanted}")
        if not np.all(np.linalg.norm(np.diff(p, axis=0), axis=1) > _POSITION_TOL):
            raise ValueError(
                f"positions {p.tolist()} of a {self.kind} repeat one, expected a "
                "path of some length between any two"
            )
        if q.shape[0] == 1:
            q = np.repeat(q, len(p), axis=0)
        lengths = np.linalg.norm(q, axis=1)
        if q.shape != (len(p), 4) or not np.all(abs(lengths - 1.0) < 1e-3):
            raise ValueError(
                f"quaternions are {self.quaternions}, expected one or {len(p)} rows "
                "wxyz of length 1"
            )
        q = q / lengths[:, None]
        if times.shape != (2,) or not np.all(np.isfinite(times)):
            raise ValueError(f"times are {self.times}, expected start and end [s]")
        if not times[1] > times[0]:
            raise ValueError(f"times are {times.tolist()}, expected increasing ones")
        if len(n) > 2:
            raise ValueError(f"{len(n)} force_directions, expected at most 2")
        if len(n) == 2 and abs(n[0] @ n[1]) > 0.9:
            raise ValueError(
                f"force_directions {n.tolist()} are nearly parallel, expected two that "
                "are not"
            )
        if targets.shape != (len(n),) or not np.all(targets > 0.0):
            raise ValueError(
                f"force_targets are {self.force_targets}, expected {len(n)} numbers "
                "above 0, one for each force direction"
            )
        if not np.all(np.isfinite(targets)):
            raise ValueError(f"force_targets are {targets}, expected finite numbers")
        for name, value in (
            ("positions", p), ("times", times), ("quaternions", q),
            ("force_directions", n), ("force_targets", targets),
        ):  # fmt: skip
            value.setflags(write=False)
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class MotionPattern:
    """Segments in a row; see the module.

    Args: segments; acceleration_max, of every change of speed and in every bend [m/s2];
        base, quaternion wxyz from which rotation vectors are taken, None: the first
        orientation (it matters only where two patterns are to be blended).
    Raises: ValueError that names the segment: times that are not in order, a gap to the
        one before, too little time for its length or for its bends (least_time).
    """

    segments: tuple[Segment, ...]
    acceleration_max: float = 1.0
    base: np.ndarray = None  # type: ignore[assignment]
    # What the compiled code reads; see path_geometry.
    table: np.ndarray = field(init=False, repr=False)

    def __post_init__(self):
        segments = tuple(self.segments)
        object.__setattr__(self, "segments", segments)
        a = self.acceleration_max
        if not 0.0 < a < np.inf:
            raise ValueError(f"acceleration_max is {a}, expected > 0 [m/s2]")
        if not segments:
            raise ValueError("a motion pattern has no segments, expected at least one")
        base = segments[0].quaternions[0] if self.base is None else self.base
        poses = [
            np.hstack([one.positions, _rotation_vectors(one.quaternions, base, k)])
            for k, one in enumerate(segments)
        ]
        lengths, data = [], []
        for k, (one, X) in enumerate(zip(segments, poses, strict=True)):
            try:
                length, numbers = _geometry(one.kind, X)
            except ValueError as error:
                raise ValueError(f"segment {k}: {error}") from None
            lengths.append(length)
            data.append(numbers)
        heads = np.zeros((len(segments), HEAD))
        at = 1 + heads.size
        for k, one in enumerate(segments):
            n = one.force_directions
            heads[k, KIND], heads[k, LENGTH] = KINDS.index(one.kind), lengths[k]
            heads[k, N_FORCE] = len(n)
            heads[k, DIRECTIONS : DIRECTIONS + n.size] = n.ravel()
            heads[k, TARGETS : TARGETS + len(n)] = one.force_targets
            heads[k, [START, END]] = one.times
            heads[k, DATA] = at
            at += data[k].size
        table = np.concatenate([[len(segments)], heads.ravel(), *data])
        for k in range(len(segments) - 1):
            _check_join(segments, poses, k)
            here, after = segments[k].force_directions, segments[k + 1].force_directions
            made = any(not _has(here, n) for n in after)
            goes_on = not made and _goes_on(table, lengths, segments, k)
            lost = goes_on and any(not _has(after, n) for n in here)
            head = 1 + k * HEAD
            table[[head + IN_CONTACT, head + IN_LOSS, head + GOES_ON]] = (
                made, lost, goes_on,
            )  # fmt: skip
        before = 0.0
        for k, one in enumerate(segments):
            head = 1 + k * HEAD
            keeps = table[head + IN_CONTACT] or table[head + GOES_ON]
            duration = one.times[1] - one.times[0]
            try:
                speed = _cruise(lengths[k], duration, before, not keeps, a)
            except ValueError as error:
                raise ValueError(f"segment {k}: {error}") from None
            table[head + SPEED] = speed
            bend = 0.0 if one.kind == "line" else largest_curvature(table, k)
            if speed**2 * bend > _SLACK * a:
                raise ValueError(
                    f"segment {k} bends within {1.0 / bend:.3g} m at {speed:.4g} m/s, "
                    f"expected at most {np.sqrt(a / bend):.4g} m/s there: more time or "
                    f"a rounder path (acceleration_max is {a:.4g} m/s2)"
                )
            before = speed if table[head + GOES_ON] else 0.0
        table.setflags(write=False)
        base = base.copy()
        base.setflags(write=False)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "base", base)

    def __copy__(self):  # Drake clones abstract state; this never changes.
        return self

    def __deepcopy__(self, _):
        return self

    def __len__(self):
        return len(self.segments)

    def _head(self, k: int, i: int) -> float:
        return float(self.table[1 + k * HEAD + i])

    def length(self, k: int) -> float:
        """Arc length of segment k [m]."""
        return self._head(k, LENGTH)

    def speed(self, k: int) -> float:
        """Speed of segment k between its two ends [m/s]."""
        return self._head(k, SPEED)

    def largest_curvature(self, k: int) -> float:
        """Of the path of segment k [1/m]."""
        return float(largest_curvature(self.table, k))

    def ends_in_contact(self, k: int) -> bool:
        """Whether the next segment has a force direction that segment k lacks."""
        return bool(self._head(k, IN_CONTACT))

    def ends_in_loss(self, k: int) -> bool:
        """Whether the next segment, on the same line, lacks one that segment k has."""
        return bool(self._head(k, IN_LOSS))

    @property
    def duration(self) -> float:
        """From the first segment's start to the last one's end [s]."""
        return float(self.segments[-1].times[1] - self.segments[0].times[0])

    def geometry(self, k: int, s: float) -> np.ndarray:
        """Position, unit tangent, curvature vector [1/m], its derivative [1/m2] by arc
        length: (4, 3) of segment k at arc length s [m]."""
        return path_point(self.table, k, float(s))[:, :3]

    def along(self, k: int, t: float) -> tuple[float, float, float]:
        """Arc length [m], speed [m/s] and acceleration [m/s2] along segment k at t [s],
        as the pattern has it."""
        a, v, one = self.acceleration_max, self.speed(k), self.segments[k]
        t = min(max(t, one.times[0]), one.times[1]) - one.times[0]
        before = self.speed(k - 1) if k > 0 and self._head(k - 1, GOES_ON) else 0.0
        s, speed, acceleration = before * t, before, 0.0
        if v != before:
            T = transition_time(before, v, a)
            s, speed, acceleration, _ = speed_transition(before, v, T, t)
        if not (self.ends_in_contact(k) or self._head(k, GOES_ON)):
            T = transition_time(v, 0.0, a)
            start = one.times[1] - one.times[0] - T
            if t > start:
                ds, dv, da, _ = speed_transition(0.0, -v, T, t - start)
                s, speed, acceleration = s + ds, speed + dv, acceleration + da
        return s, speed, acceleration

    def pose(self, t: float) -> np.ndarray:
        """x_desired (19,) = [p, quaternion wxyz, v, w, a, alpha] at time t [s], without
        any contact; before the start and after the end at rest."""
        ends = [one.times[1] for one in self.segments]
        k = min(int(np.searchsorted(ends, t, side="left")), len(self) - 1)
        s, v, a = self.along(k, t)
        if t < self.segments[0].times[0] or t > ends[-1]:
            v = a = 0.0
        X = path_point(self.table, k, s)
        return pose_of(X[0], X[1] * v, X[2] * v * v + X[1] * a, self.base)

    def forces(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Force directions (0 to 2, 3) and targets [N] at time t [s]."""
        ends = [one.times[1] for one in self.segments]
        k = min(int(np.searchsorted(ends, t, side="left")), len(self) - 1)
        return self.segments[k].force_directions, self.segments[k].force_targets


def pose_of(X, X1, X2, base) -> np.ndarray:
    """x_desired (19,) of a path point X (6,) and its two time derivatives."""
    q, w, alpha = rotation_motion(X[3:].copy(), X1[3:].copy(), X2[3:].copy(), base)
    return np.concatenate([X[:3], q, X1[:3], w, X2[:3], alpha])


def _rotation_vectors(quaternions, base, k):
    """(n, 3) from the base orientation to each, [rad].

    Raises: ValueError if one is more than 170 degrees from it.
    """
    turn = Rotation.from_quat(quaternions, scalar_first=True)
    turn = turn * Rotation.from_quat(base, scalar_first=True).inv()
    r = turn.as_rotvec()
    angle = np.linalg.norm(r, axis=1).max()
    if angle > _TURN_MAX:
        raise ValueError(
            f"segment {k} turns {np.rad2deg(angle):.0f} degrees from the first "
            "orientation, expected at most 170"
        )
    return r


def _geometry(kind, X):
    if kind == "line":
        return line_data(X[0], X[1])
    if kind == "arc":
        return arc_data(X[0, :3], X[1, :3], X[2, :3], X[0, 3:], X[2, 3:])
    return spline_data(X)


def _has(directions, n) -> bool:
    return any(one @ n > 1.0 - 1e-6 for one in directions)


def _check_join(segments, poses, k):
    """Raises: ValueError for a gap in time, position or orientation after segment k."""
    one, after = segments[k], segments[k + 1]
    if abs(after.times[0] - one.times[1]) > 1e-9:
        raise ValueError(
            f"segment {k + 1} starts at {after.times[0]} s, expected {one.times[1]} s, "
            f"the end of segment {k}"
        )
    gap = poses[k + 1][0] - poses[k][-1]
    # Along a force direction the contact decides where the tip is, not the plan.
    controlled = np.vstack([one.force_directions, after.force_directions])
    if len(controlled):
        U, sizes, _ = np.linalg.svd(controlled.T, full_matrices=False)
        basis = U[:, sizes > 1e-6]
        gap[:3] -= basis @ (basis.T @ gap[:3])
    if np.linalg.norm(gap[:3]) > _POSITION_TOL or np.linalg.norm(gap[3:]) > _ANGLE_TOL:
        raise ValueError(
            f"segment {k + 1} starts {1e3 * np.linalg.norm(gap[:3]):.3f} mm and "
            f"{np.rad2deg(np.linalg.norm(gap[3:])):.3f} degrees from the end of "
            f"segment {k}, expected no gap"
        )


def _goes_on(table, lengths, segments, k) -> bool:
    """Whether segment k + 1 goes on along the line on which segment k ends."""
    if segments[k].kind != "line" or segments[k + 1].kind != "line":
        return False
    end = path_point(table, k, lengths[k])
    start = path_point(table, k + 1, 0.0)
    return bool(
        np.linalg.norm(end[0] - start[0]) < 2 * _POSITION_TOL
        and np.linalg.norm(end[1] - start[1]) < 1e-6
    )


def _cruise(length, duration, before, stops, a) -> float:
    """The speed at which a segment of that length takes that long [m/s].

    Raises: ValueError if a_max does not allow it.
    """

    def distance(v):
        d = v * duration - (v - before) * abs(v - before) / a
        return d - v * v / a if stops else d

    # The fastest and the slowest that the two changes of speed leave time for; between
    # them the distance grows with the speed.
    high = (0.5 * a * duration + before) / (1.0 + stops)
    low = 0.0 if stops else max(before - 0.5 * a * duration, 0.0)
    if high < before or distance(high) < length:
        raise ValueError(
            f"{length:.4g} m in {duration:.4g} s, expected more time: acceleration_max "
            f"is {a:.4g} m/s2"
        )
    if distance(low) > length:
        raise ValueError(
            f"{length:.4g} m in {duration:.4g} s, expected less time: it starts with "
            f"{before:.4g} m/s"
        )
    return float(brentq(lambda v: distance(v) - length, low, high, xtol=1e-15))


def segment_time(
    length: float, speed: float, acceleration_max: float, starts=True, stops=True
) -> float:
    """How long a segment of that length takes at that speed [s]: from rest if it
    `starts`, to rest if it `stops`.

    Raises: ValueError if it is too short to reach the speed.
    """
    ramps = bool(starts) + bool(stops)
    if ramps * speed**2 / acceleration_max > length * (1 + 1e-12):
        raise ValueError(
            f"{length:.4g} m is too short for {speed:.4g} m/s within "
            f"{acceleration_max:.4g} m/s2, expected at most "
            f"{np.sqrt(length * acceleration_max / max(ramps, 1)):.4g} m/s"
        )
    return length / speed + ramps * speed / acceleration_max


def least_time(
    segment: Segment, acceleration_max: float, starts=True, stops=True
) -> float:
    """The least time [s] in which a segment keeps acceleration_max [m/s2], at its ends
    (`starts` from rest, `stops` at rest) and in its bends; its own times do not count.
    """
    slowly = replace(segment, times=np.array([0.0, _AGES]))
    alone = MotionPattern((slowly,), acceleration_max)
    length, bend = alone.length(0), alone.largest_curvature(0)
    radius = min(1.0 / bend if bend > 0.0 else np.inf, 0.5 * length)
    return segment_time(
        length, np.sqrt(acceleration_max * radius), acceleration_max, starts, stops
    )


# --- Files.

_SEGMENT_KEYS = (
    "kind", "positions", "times", "quaternions", "force_directions", "force_targets",
)  # fmt: skip


def load_pattern(path: str | Path) -> MotionPattern:
    """The pattern of a YAML file: `acceleration_max`, and `segments`, a list of the
    arguments of Segment.

    Raises: ValueError that names the file and what is wrong with it.
    """
    try:
        data = yaml.safe_load(Path(path).read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"pattern {path}: {' '.join(str(error).split())}") from None
    try:
        return pattern_from(data)
    except ValueError as error:
        raise ValueError(f"pattern {path}: {error}") from None


def pattern_from(data) -> MotionPattern:
    """The pattern of a mapping, as a file has it.

    Raises: ValueError by name.
    """
    if not isinstance(data, dict):
        raise ValueError(f"got {type(data).__name__}, expected a mapping")
    _only(data, ("acceleration_max", "segments"), "the pattern")
    rows = data.get("segments")
    if not isinstance(rows, list) or not rows:
        raise ValueError(f"segments is {rows!r}, expected a list")
    segments = []
    for k, row in enumerate(rows):
        if not isinstance(row, dict):
            raise ValueError(f"segment {k} is {row!r}, expected a mapping")
        _only(row, _SEGMENT_KEYS, f"segment {k}")
        missing = [key for key in _SEGMENT_KEYS[:3] if key not in row]
        if missing:
            raise ValueError(f"segment {k} has no {missing[0]}")
        try:
            segments.append(Segment(**row))
        except ValueError as error:
            raise ValueError(f"segment {k}: {error}") from None
    try:
        acceleration_max = float(data.get("acceleration_max", 1.0))
    except (TypeError, ValueError):
        raise ValueError(
            f"acceleration_max is {data['acceleration_max']!r}, expected a number"
        ) from None
    return MotionPattern(tuple(segments), acceleration_max)


def _only(mapping, keys, where):
    for key in mapping:
        if key not in keys:
            raise ValueError(f"{where} has {key!r}, expected only: {', '.join(keys)}")


def save_pattern(pattern: MotionPattern, path: str | Path) -> None:
    """Writes what load_pattern reads."""
    rows = []
    for one in pattern.segments:
        row: dict = {"kind": one.kind}
        for name in _SEGMENT_KEYS[1:]:
            row[name] = np.asarray(getattr(one, name)).tolist()
        rows.append(row)
    data = {"acceleration_max": float(pattern.acceleration_max), "segments": rows}
    Path(path).write_text(
        yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
    )


__all__ = [
    "ARC", "KINDS", "LINE", "SPLINE", "MotionPattern", "Segment", "load_pattern",
    "pattern_from", "pose_of", "save_pattern",
    "segment_time",
]  # fmt: skip
