"""Where a robot's base or an object is, by its pose in the log: of an IMU, a tracker, a
simulator.

A quaternion is four columns of unit length, whatever their names; else roll, pitch and
yaw, or gravity's direction in the base, tell how it stands.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from makebreak.gap.data.arrays import words_of
from makebreak.gap.data.recording import QUATERNION

# Moves less than this: it is on a stand, hung up, or screwed down.
_STILL_RAD, _STILL_M = 0.05, 0.02
_BASE = set(
    "base root torso trunk pelvis body imu floating odom odometry waist".split()
)
_NOT = set(
    "cmd command commands target desired des ref goal ee tool hand tcp gripper object "
    "ball box camera cam foot feet tip contact head wrist joint joints dof".split()
)
_OBJECT = set("object obj ball box body cube block item part puck".split())
_TURNS = set("quat quaternion orientation rot rotation attitude pose".split())
_UNIT = re.compile(r"[^a-z0-9](mm|cm|m)\W*")  # Behind a place's name.
_ENTRY = re.compile(
    r"(.*?)[^a-z0-9]*?(q?[wxyz]|roll|pitch|yaw|\d+)"
    r"([^a-z0-9]+(deg|degrees|rad|radians|m|mm))?[^a-z0-9]*"
)


@dataclass(frozen=True)
class BasePose:
    """orientation: scalar first, of the base in world, on the middle of the log;
    position [m], zeros where the log has none. turned [rad], moved [m]: the most but
    for a twentieth of the rows. columns: all that were used. says: how it was read.
    channels: (column, x to qz or roll to yaw, scale) of a pose that is told whole."""

    orientation: tuple[float, ...]
    position: tuple[float, ...]
    turned: float
    moved: float
    columns: tuple[str, ...]
    says: str
    channels: tuple[tuple[str, str, float], ...] = ()

    @property
    def is_still(self) -> bool:
        return self.turned < _STILL_RAD and self.moved < _STILL_M

    @property
    def rotation(self) -> Rotation:
        return Rotation.from_quat(self.orientation, scalar_first=True)


@dataclass(frozen=True)
class _Sought:
    """Whose pose is looked for. names, others: of bodies that nothing holds, each as
    its words; words: that are said for such a body; never: in no name of its columns.
    """

    names: tuple[frozenset[str], ...]
    others: tuple[frozenset[str], ...]
    words: set[str]
    never: set[str]

    def rank(self, words: set[str]) -> int | None:
        """0 where its own name is in it, 1 where it is one for such a body, else 2;
        None of a name that is of something else."""
        own, other = (max((len(n) for n in names if n and n <= words), default=0)
                      for names in (self.names, self.others))  # fmt: skip
        if words & self.never - {w for n in self.names for w in n} or other > own:
            return None
        return 0 if own else 1 if words & self.words else 2


def base_pose(
    logs: Sequence[Mapping[str, np.ndarray]],
    bases: Sequence[str],
    others: Sequence[str] = (),
    carries: bool = True,
) -> BasePose | None:
    """None where no log has its orientation.

    Args: logs: each {column: (n,)}; bases: names that it may have; others: those of
        other bodies that nothing holds; carries: whether it has joints: a robot's base,
        and no object.
    """
    if not bases:
        return None
    own, other = (tuple(frozenset(words_of(n)) for n in each)
                  for each in (bases, others))  # fmt: skip
    sought = _Sought(own, other, _BASE, _NOT)
    if not carries:
        sought = _Sought(own, other, _OBJECT, _NOT - _OBJECT - {"camera", "cam"})
    first = next((c for c in logs if _orientations(c, sought)), None)
    if first is None:
        return None
    names, kind = _orientations(first, sought)[0]
    place = _position(first, sought, not carries and not others)
    return _pose(logs, names, kind, place)


def listed_pose(
    logs: Sequence[Mapping[str, np.ndarray]], place: Sequence[str], turn: Sequence[str]
) -> BasePose:
    """Of columns that are known: x, y and z, and w, x, y and z of the quaternion."""
    return _pose(logs, turn, "quaternion", place)


def _pose(logs, names: Sequence[str], kind: str, place: Sequence[str]) -> BasePose:
    have = [c for c in logs if {*names} <= {*c}]
    turns, says, order = _rotations(
        np.concatenate([np.stack([c[n] for n in names], axis=1) for c in have]), kind,
        any("deg" in words_of(n) for n in names),
    )  # fmt: skip
    middle = turns.mean()
    off = (middle.inv() * turns).magnitude()
    at, moved = np.zeros(3), 0.0
    metres = [_metres(name) for name in place]
    if place:
        p = np.concatenate(
            [np.stack([c[n] for n in place], axis=1) for c in have if {*place} <= {*c}]
        )
        p = metres * p[np.isfinite(p).all(axis=1)]
        if len(p):
            at = np.median(p, axis=0)
            moved = float(np.quantile(np.linalg.norm(p - at, axis=1), 0.95))
    w = middle.as_quat(scalar_first=True)
    turn = float(np.deg2rad(1.0)) if "degrees" in says else 1.0
    parts = [*zip(place, "xyz", metres, strict=True)] if place else []
    parts += [(n, part, turn) for n, part in zip(names, order, strict=False)]
    return BasePose(
        tuple(float(f"{x:.5g}") for x in w), tuple(float(f"{x:.5g}") for x in at),
        float(np.quantile(off, 0.95)), moved, (*names, *place),
        f"{', '.join(names)} {says}", tuple(parts) if len(parts) >= 6 else (),
    )  # fmt: skip


def are_quaternion(four: Sequence[np.ndarray]) -> bool:
    """Whether four columns (n,) are of unit length."""
    size = np.linalg.norm(four, axis=0)
    size = size[np.isfinite(size)]
    return bool(len(size)) and bool(np.quantile(np.abs(size - 1.0), 0.95) < 0.02)


def _metres(name: str) -> float:
    unit = _UNIT.search(name.lower())
    return {"mm": 1e-3, "cm": 1e-2}.get(unit[1], 1.0) if unit else 1.0


def _orientations(
    columns: Mapping[str, np.ndarray], sought: _Sought
) -> list[tuple[tuple[str, ...], str]]:
    """(columns, kind) of each, those first that have a body's own name."""
    found: list[tuple[int, int, tuple[str, ...], str]] = []
    for prefix, parts in _groups(columns).items():
        words = set(words_of(prefix))
        if (rank := sought.rank(words)) is None:
            continue
        said = bool(words & _TURNS)
        for keys in (("w", "x", "y", "z"), *_counted(4)):
            own = tuple(parts[k] for k in keys if k in parts)
            if len(own) == 4 and (said or rank < 2 or keys[0] == "w"):
                if are_quaternion([columns[n] for n in own]):
                    kind = "quaternion" if keys[0] == "w" else "four"
                    found.append((rank, 0, own, kind))
                break
        if "roll" in parts and "pitch" in parts:
            own = tuple(parts[k] for k in ("roll", "pitch", "yaw") if k in parts)
            if not any(re.search("rate|vel|gyro|speed", n.lower()) for n in own):
                found.append((rank, 1, own, "angles"))
        if "gravity" in words:
            for keys in (("x", "y", "z"), *_counted(3)):
                own = tuple(parts[k] for k in keys if k in parts)
                if len(own) == 3 and "3" not in parts:
                    found.append((rank, 2, own, "gravity"))
                    break
    found.sort(key=lambda each: each[:2])
    return [(own, kind) for _, _, own, kind in found]


def _position(
    columns: Mapping[str, np.ndarray], sought: _Sought, alone: bool
) -> tuple[str, ...]:
    """The columns of a body's place; () where there are none. alone: nothing else has a
    pose, so that x, y and z are it."""
    found: list[tuple[int, tuple[str, ...]]] = []
    for prefix, parts in _groups(columns).items():
        words = set(words_of(prefix))
        rank = sought.rank(words)
        if rank is None or rank == 2 and not alone or words & _TURNS - {"pose"}:
            continue
        place = {"pos", "position", "xyz", "translation", "pose"} & words
        if not (place or rank == 0 or alone and rank < 2 or not words):
            continue
        if words & {"vel", "velocity", "lin", "ang", "acc", "acceleration", "gravity",
                    "linear", "angular", "twist", "v", "omega"}:  # fmt: skip
            continue
        for keys in (("x", "y", "z"), *_counted(3)):
            own = tuple(parts[k] for k in keys if k in parts)
            if len(own) == 3 and not {"w", "3"} & set(parts):
                found.append((rank, own))
                break
    return min(found, key=lambda each: each[0], default=(0, ()))[1]


def _groups(columns: Collection[str]) -> dict[str, dict[str, str]]:
    """{what columns' names begin with: {part: column}}, as base_quat: {w: base_quat_w}.
    A `q` before x, y and z belongs to the name: base_qx is no place."""
    found: dict[str, dict[str, str]] = {}
    for name in columns:
        match = _ENTRY.fullmatch(name.lower())
        if match is not None:
            prefix, part = match[1], match[2]
            if len(part) == 2 and part[0] == "q":
                prefix, part = f"{prefix} quat", part[1]
            found.setdefault(prefix, {})[part] = name
    return found


def _counted(n: int) -> list[tuple[str, ...]]:
    """Names of n entries that are counted, from 0 or from 1."""
    return [tuple(str(k + first) for k in range(n)) for first in (0, 1)]


def _rotations(rows: np.ndarray, kind: str, degrees: bool):
    """Rotations of the rows that are whole, how they were taken, and what the columns
    are of a pose. degrees: said of angles."""
    y = rows[np.isfinite(rows).all(axis=1)]
    if kind == "angles":
        y = y if y.shape[1] == 3 else np.column_stack([y, np.zeros(len(y))])
        degrees |= bool(np.abs(y).max() > 2.0 * np.pi)
        unit = "degrees" if degrees else "radians"
        return (Rotation.from_euler("xyz", y, degrees), f"are taken in {unit}",
                ("roll", "pitch", "yaw"))  # fmt: skip
    if kind == "gravity":  # Down, in the base's axes; which way it looks is unknown.
        down = y / np.linalg.norm(y, axis=1)[:, None]
        # The shortest turn that takes what the base has for down to down.
        axis = np.cross(down, [0.0, 0.0, -1.0])
        angle = np.arctan2(np.linalg.norm(axis, axis=1), -down[:, 2])
        size = np.maximum(np.linalg.norm(axis, axis=1), 1e-12)
        turns = Rotation.from_rotvec(axis / size[:, None] * angle[:, None])
        return turns, "are gravity's direction in it", ()
    if (
        kind == "four"
    ):  # Scalar first or last: as it stands more upright, or turns less.
        tried = [Rotation.from_quat(y, scalar_first=first) for first in (True, False)]
        up = [round(float(r.mean().as_matrix()[2, 2]), 2) for r in tried]
        less = [-round(float(r.mean().magnitude()), 2) for r in tried]
        last = (up[1], less[1]) > (up[0], less[0])
        shown = "x, y, z, w" if last else "w, x, y, z"
        order = QUATERNION[1:] + QUATERNION[:1] if last else QUATERNION
        return tried[last], f"are taken as {shown}", order
    return (Rotation.from_quat(y, scalar_first=True), "are its quaternion",
            QUATERNION)  # fmt: skip
