"""What columns are by what is in them.

A name is a claim; what a column holds has to follow from the others. Positions give
velocities, and by the model the efforts that joints need; every column is regressed on
what is so predicted for every joint, with dry and viscous friction and a bias free:

    predicted = factor column + bias + viscous v + coulomb sign(v)

Noise of the column would make the factor too small: half of its samples stand for the
other half, whose noise is another (instrumental variables). One table of these
relations tells a unit, a gear, a motor's side or a torque constant (the factor), a
sign, columns that are swapped or numbered one off (the joint that fits), and a column
that drives nothing (no joint fits, or nothing is in it).
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from scipy.optimize import linear_sum_assignment, lsq_linear, minimize_scalar

from makebreak.gap.data.findings import Finding
from makebreak.gap.data.match import AS_SAID, JointName, Match
from makebreak.gap.data.proposal import CURRENT
from makebreak.gap.data.recording import Recording
from makebreak.gap.data.servo_gains import (
    ServoLog,
    averaged_motion,
    needed_efforts,
)
from makebreak.gap.data.turns import TURN, without_turns
from makebreak.gap.data.units import BY_SIZE, TURNING, Unit
from makebreak.models.effects.kind import actuator_of, full_name, one_dof_joints

MOST_SAMPLES = 1000  # At which inverse dynamics is computed.
MOST_SEC = 60.0  # Of a log that is looked at.
EXPLAINS, NOTHING = 0.9, 0.5  # Shares of what is predicted: is told by it, is not.
CLEARER = 5.0  # Times less is left by another joint's column than by its own.
TOLD_WELL = 0.01  # Of what is predicted: no other unit can tell it much better.
NEARLY_ALL = 1e-4  # The same where a unit is but told by how large numbers are.
LEAST_LEFT = 1e-5  # Less is rounding.
GIVES_WAY = 0.05  # [rad], [m]
LEAST_TOLD = 0.3  # Of a column that is not noise, to judge it without that.
PARTS = 5  # Of the data: a factor scatters over them.
KNOWN_TO = 0.1  # Of a factor, 1 sigma.
# Factors of one robot differ by less than this share, or by so many sigmas.
ALIKE, SIGMAS = 0.03, 3.0
# A search takes factors of drives between these for a gain of the actuator; without a
# gain, masses would have to make up for others.
GAINS = (0.45, 1.6)
# Shares of an effort that is the weight's, to tell by; of the weight that one without
# it may still have.
WEIGHS, LEFT_OUT = 0.1, 0.2
FEW, MOST_LATE = 100, 300  # Instants at which many readings, or delays, are tried.
# Joints of which all orders are tried, those of which swaps are, and those that may be
# off where one has another zero.
ALL_ORDERS, MOST_ORDERED, MOST_OFF = 6, 8, 8
ROOM = 0.1  # Of a joint's range, beyond it.
# Logarithms: of gears that are tried, and the step between two.
LARGEST_GEAR, GEAR_STEP = 5.7, 0.1
ONE_GEAR = 0.03  # Of what is needed: what efforts behind one gear for all leave.
FAR = 1000.0  # [rad] No joint turns by so much between its limits.
LATEST_SEC, LATE_STEP_SEC = 0.1, 0.01
NO_WEIGHT = 0.02  # Of what an effort without weight leaves at most.
# Of one joint alone, what it carries may make its effort so many times larger; what
# holds it up, smaller.
LARGE, LARGER = 20.0, 3.0
WITHOUT_WEIGHT = "effort_without_weight"
UNSURE, UNITS_UNSURE, LATE = "effort_unsure", "units_unsure", "effort_late"
FROM_A_START = "position_from_start"
AT_ZERO = 1e-3  # [rad], [m]
UNEXPLAINED, MIRRORED = "effort_unexplained", "joints_mirrored"
_UNSURE = (
    "larger than the model needs, several times, and no rotor would do: another unit, "
    "or a load or a spring that the model lacks; taken as it is"
)
_SEVERITY = {
    "no_content": "warning",
    "too_short": "info",
    UNSURE: "warning",
    UNITS_UNSURE: "warning",
    LATE: "warning",
    FROM_A_START: "warning",
    UNEXPLAINED: "warning",
    MIRRORED: "warning",
}  # Else: an error.
_DRIVES = ("effort_command", "effort_measured")
_UNITS = (
    (1e-3, "as if in N mm, or per mille of N m"), (1e-2, "as if in N cm, or per cent"),
    (1e3, "as if in kN m"), (0.0980665, "as if in kgf cm"),
    (9.80665, "as if in kgf m"), (0.112985, "as if in lbf in"),
    (1.355818, "as if in lbf ft"),
)  # fmt: skip


@dataclass(frozen=True)
class Likeness:
    """What is predicted = factor column + rest. std: of the factor, by its scatter over
    parts of the data. explained: of what the rest leaves, the share that the column
    takes."""

    factor: float
    std: float
    explained: float


@dataclass(frozen=True)
class Said:
    """What a column's content says of it: as a Finding, of a log that is not named."""

    kind: str
    channel: str
    size: float
    says: str


def likeness(predicted, column, rest, halves=None) -> Likeness | None:
    """None where there is nothing to relate.

    Args: predicted (m,), column (m,), rest (m, k); halves: the column (m,) by every
        other sample, twice: their noise is not the same.
    """
    if not (np.ptp(predicted) > 0.0 and np.ptp(column) > 0.0):
        return None
    size = float(np.std(column))
    X = np.column_stack([column / size, rest])
    good = np.ones(len(predicted), bool)
    for _ in range(3):  # Someone may have pushed it for a while.
        c = np.linalg.lstsq(X[good], predicted[good], rcond=1e-9)[0]
        off = np.abs(predicted - X @ c)
        good = off <= max(6.0 * float(np.median(off)), 1e-12)
    y, X = predicted[good], X[good]
    alone, own = _without(X[:, 1:], y), _without(X[:, 1:], X[:, 0])
    if not alone @ alone > 1e-12 * max(y @ y, 1e-300):
        return None
    whole = _without(X, y)
    share = 1.0 - float(whole @ whole) / float(alone @ alone)
    one = two = own
    if halves is not None:
        one, two = (_without(X[:, 1:], half[good] / size) for half in halves)
        together = float(one @ two) / max(np.sqrt((one @ one) * (two @ two)), 1e-300)
        told = 2.0 * together / (1.0 + together) if together > 0.0 else 0.0
        if told > LEAST_TOLD:  # What noise of the column hides is no other effort.
            share = min(share / told, 1.0)
        else:
            one = two = own
    parts = [np.array_split(x, PARTS) for x in (one, two, alone)]
    each = [_slope(*part) for part in zip(*parts, strict=True)]
    std = float(np.std(each)) / np.sqrt(PARTS)
    return Likeness(_slope(one, two, alone) / size, std / size, share)


def _without(rest, y):
    """y (m,) without what rest (m, k) tells of it."""
    return y - rest @ np.linalg.lstsq(rest, y, rcond=1e-9)[0]


def _slope(one, two, y) -> float:
    """Of y over what one and two, of noise of their own, both measure."""
    return float((one + two) @ y / max(abs(2.0 * one @ two), 1e-300))


class TooShort(ValueError):
    """A log of less than a second, or of a few rows."""


class Contents:
    """A log's columns beside what its positions predict.

    Args: columns {name: (n,)}; matches of them, which name time and all joints'
        positions; joints in the order of the plant's coordinates.
    Raises: ValueError where these do not tell a motion.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        joints: Sequence[JointName],
        columns: Mapping[str, np.ndarray],
        matches: Sequence[Match],
    ):
        self._plant, self.joints = plant, joints
        self._columns = columns
        found = {m.channel: m for m in matches if m.channel}
        names = [f"{j.name}.position" for j in joints]
        if plant.num_positions() != len(joints) or not {*names, "time"} <= {*found}:
            raise ValueError("not all joints are measured")
        time = _si(columns, found["time"])
        q = np.stack([_si(columns, found[name]) for name in names], axis=1)
        for i, joint in enumerate(joints):
            if not joint.prismatic:
                q[:, i] = without_turns(q[:, i])[0]
        rows = np.flatnonzero(np.isfinite(q).all(axis=1) & np.isfinite(time))
        if not len(rows):
            raise ValueError("no row has all positions")
        starts = np.flatnonzero(np.diff(time[rows], prepend=np.inf) <= 0.0)
        self._rows = max(np.split(rows, starts), key=len)
        t = time[self._rows]
        self._rows = self._rows[: np.searchsorted(t, t[0] + MOST_SEC)]
        self._time = time[self._rows]
        self._all_time = time
        self.period = float(np.median(np.diff(self._time))) if len(q) > 1 else 0.0
        q = q[self._rows]
        self.first = q[0] if len(q) else np.full(len(names), np.nan)
        averaged = averaged_motion(ServoLog(self._time, q, q)) if len(q) > 20 else None
        if averaged is None:
            raise TooShort("too short to tell what columns are by what is in them")
        self._even, _, _, self._kernels, states = averaged
        self._some = slice(None, None, max(len(states[0]) // MOST_SAMPLES, 1))
        self._motion = [x[self._some].copy() for x in states]
        self.late = 0.0  # [s] How late columns are taken to be.
        self.take(*self._motion)

    def take(self, q: np.ndarray, v: np.ndarray, vd: np.ndarray) -> None:
        """(m, n_q) as the joints' positions, velocities and accelerations."""
        self.q, self.v, self.vd = q, v, vd
        self.needed = needed_efforts(self._plant, q, v, vd)
        self._weight: np.ndarray | None = None

    @property
    def weight(self) -> np.ndarray:
        """(m, n_q) what gravity needs of the joints."""
        if self._weight is None:
            context = self._plant.CreateDefaultContext()
            self._weight = np.empty_like(self.needed)
            for k, q in enumerate(self.q):
                self._plant.SetPositions(context, q)
                tau = self._plant.CalcGravityGeneralizedForces(context)
                self._weight[k] = -tau
        return self._weight

    def moved(self, order: Sequence[int]) -> None:
        """With the measured joints in another order."""
        self.take(*(x[:, list(order)] for x in self._motion))

    def scaled(self, joints: Sequence[int], factor: float) -> None:
        """With the positions of these joints times a factor."""
        for x in self._motion:
            x[:, list(joints)] *= factor
        self.take(*self._motion)

    def turned(self, i: int, angle: float) -> None:
        """With another zero of a joint."""
        self._motion[0][:, i] += angle
        self.take(*self._motion)

    def fewer(self, m: int) -> "Contents":
        """At about m instants."""
        k = max(len(self.q) // m, 1)
        other = copy(self)
        other._some = slice(None, None, k * self._some.step)
        other._motion = [x[::k].copy() for x in self._motion]
        other.take(*other._motion)
        return other

    def is_inside(self) -> bool:
        """Whether all joints are within their limits, or nearly."""
        low, high = self.q.min(axis=0), self.q.max(axis=0)
        room = [ROOM * np.nan_to_num(j.upper - j.lower, posinf=0.0)
                for j in self.joints]  # fmt: skip
        inside = np.all(low > np.array([j.lower for j in self.joints]) - room)
        return bool(
            inside and np.all(high < np.array([j.upper for j in self.joints]) + room)
        )

    def moves(self, i: int) -> bool:
        """Whether a joint does, by more than its position's grid or noise."""
        return float(np.ptp(self.q[:, i])) > 1e-3

    def column(self, name: str, half: int | None = None) -> np.ndarray | None:
        """(m,) averaged as the motion is; None where it has too few samples. half: 0 or
        1: of every other sample alone."""
        y = self._columns[name]
        inside = np.zeros(len(y), bool)
        inside[self._rows[0] : self._rows[-1] + 1] = True
        there = np.isfinite(y) & inside & np.isfinite(self._all_time)
        if there.sum() < 20:
            return None
        if half is not None:
            there = np.flatnonzero(there)[half::2]
        even = np.interp(self._even + self.late, self._all_time[there], y[there])
        return np.convolve(even, self._kernels[0], "valid")[self._some]

    def of_velocity(self, name: str, i: int) -> Likeness | None:
        y = self.column(name)
        one = np.ones((len(self.v), 1))
        return None if y is None else likeness(self.v[:, i], y, one)

    def of_effort(self, name: str, i: int, rotor: bool = False) -> Likeness | None:
        """rotor: free, too."""
        y, v = self.column(name), self.v[:, i]
        if y is None:
            return None
        rest = [np.ones_like(v), v, np.sign(v), *([self.vd[:, i]] if rotor else [])]
        halves = [self.column(name, half) for half in (0, 1)]
        return likeness(self.needed[:, i], y, np.stack(rest, axis=1), halves)

    def left_by_friction(self, name: str, i: int) -> float:
        """Share of what a joint needs that a column, a bias and friction, which never
        drives, leave."""
        y, v = self.column(name), self.v[:, i]
        if y is None or not np.ptp(y) > 0.0:
            return 1.0
        against = [-np.abs(v).max() * v, -np.sign(v)]
        X = np.stack([y, np.ones_like(v), *against], axis=1)
        X /= np.maximum(np.abs(X).max(axis=0), 1e-300)
        needed = self.needed[:, i]
        low = [-np.inf, -np.inf, 0.0, 0.0]
        off = lsq_linear(X, needed, (low, np.inf)).fun
        return float(off @ off / max(np.var(needed) * len(v), 1e-300))

    def lacks_weight(self, name: str, i: int) -> bool | None:
        """Whether an effort has what the motion needs and not what the weight does;
        None where the two look alike, or it does not go with them."""
        y, v, weight = self.column(name), self.v[:, i], self.weight[:, i]
        if y is None or np.std(weight) < WEIGHS * np.std(self.needed[:, i]):
            return None
        rest = np.stack([np.ones_like(v), v, np.sign(v)], axis=1)
        X = np.column_stack([self.needed[:, i] - weight, weight, rest])
        left = y - X @ np.linalg.lstsq(X, y, rcond=1e-9)[0]
        alone = y - rest @ np.linalg.lstsq(rest, y, rcond=1e-9)[0]
        if not left @ left < (1.0 - EXPLAINS) * float(alone @ alone):
            return None
        each = [
            np.linalg.lstsq(A, b, rcond=1e-9)[0][:2]
            for A, b in zip(
                np.array_split(X, PARTS), np.array_split(y, PARTS), strict=True
            )
        ]
        motion, weighs = np.mean(each, axis=0)
        std = np.std([b / motion for _, b in each]) / np.sqrt(PARTS)
        return bool(abs(weighs / motion) < LEFT_OUT) if std < KNOWN_TO else None


def _range(y: np.ndarray) -> float:
    """Of the numbers that are there."""
    return float(np.ptp(y[np.isfinite(y)])) if np.isfinite(y).any() else 0.0


def _si(columns, match: Match) -> np.ndarray:
    return match.scale * columns[match.column] + match.offset


def by_content(
    plant: MultibodyPlant,
    joints: Sequence[JointName],
    columns: Mapping[str, np.ndarray],
    matches: Sequence[Match],
) -> tuple[list[Match], list[Said]]:
    """Matches as the columns' contents have them, and what they say beside their names.
    What a sidecar said stays as it is."""
    said: list[Said] = []
    matches = _without_empty(columns, matches, said)
    try:
        contents = Contents(plant, joints, columns, matches)
    except TooShort as error:
        said.append(Said("too_short", "time", 0.0, f"The log is {error}."))
        return matches, said
    except ValueError:
        return matches, said
    matches = _rightly_signed(contents, matches, said)
    _without_weight(contents, matches, said)
    matches = _rightly_ordered(contents, matches, said)
    matches = _all_ordered(contents, matches, said)
    matches = _from_their_zeros(contents, matches, said)
    _mirrored(contents, matches, said)
    matches = _drives_that_drive(contents, matches, said)
    matches = _in_other_units(contents, matches, said)
    matches = _with_factors(contents, matches, said)
    _unexplained(contents, matches, said)
    _late(contents, matches, said)
    _from_a_start(contents, matches, said)
    return matches, said


# ----- What has no content


def _without_empty(columns, matches: Sequence[Match], said) -> list[Match]:
    """Without efforts and commands that stay the same while their joint moves; another
    column of the same channel takes their place."""
    position = {
        m.channel: m for m in matches if (m.channel or "").endswith(".position")
    }
    out = list(matches)
    for k, match in enumerate(matches):
        at, _, what = (match.channel or "").rpartition(".")
        own = position.get(f"{at}.position")
        if what not in (*_DRIVES, "position_command", "velocity_command"):
            continue
        y = columns[match.column]
        y = y[np.isfinite(y)]
        # One that is held gives way a little.
        moves = own is not None and _range(_si(columns, own)) > GIVES_WAY
        if len(y) and (np.ptp(y) > 0.0 or not moves) or match.why == AS_SAID:
            continue
        why = "empty" if not len(y) else f"{y[0]:.4g} throughout while the joint moves"
        out[k] = replace(match, channel=None, why=f"{what}: {why}, so it is no drive")
        says = f"Column {match.column} is {why}: it is not what drives {at}."
        said.append(Said("no_content", at, 0.0, says))
        for j, other in enumerate(out):
            if other.may == match.channel and not other.why.startswith(CURRENT):
                why = f"in place of {match.column}, which is {why}"
                out[j] = replace(other, channel=other.may, may="", why=why)
                break
    return out


# ----- What angles are counted in, and which way


def _misfit(contents: Contents, efforts: Mapping[int, str], rotor=False) -> float:
    """Mean logarithm of the shares that efforts do not explain. rotor: as of
    of_effort."""
    each = [contents.of_effort(name, i, rotor) for i, name in efforts.items()]
    left = [1.0 if x is None else 1.0 - x.explained for x in each]
    return float(np.mean(np.log(np.maximum(left, LEAST_LEFT))))


def _in_other_units(contents: Contents, matches, said) -> list[Match]:
    """Angles that are counted in turns, in steps of an encoder, or on the motor's side
    of one gear, by the efforts: of what swings they go with the sine. Much less is then
    left of them, and the limits allow it."""
    efforts = _columns_of(contents, matches, _DRIVES)
    mine = _columns_of(contents, matches, ("position",))
    group = [i for i in mine if not contents.joints[i].prismatic]
    before = _misfit(contents, efforts, True) if efforts and group else -np.inf
    sized = any(m.told.endswith(BY_SIZE) for m in matches if m.column in mine.values())
    if before < np.log(NEARLY_ALL if sized else TOLD_WELL):
        return matches
    few = contents.fewer(FEW)

    def left(log_factor: float) -> float:
        few.scaled(group, np.exp(log_factor))
        out = _misfit(few, efforts, True) if few.is_inside() else 0.0
        few.scaled(group, np.exp(-log_factor))
        return out

    scales = {m.column: abs(m.scale) for m in matches}
    scale = scales[mine[group[0]]]
    far = float(np.ptp(contents.q[:, group], axis=0).max()) > FAR
    known = [u for u in (TURNING if sized or far else [Unit("turns", TURN)])
             if abs(np.log(u.factor / scale)) > ALIKE]  # fmt: skip
    tried = [float(np.log(u.factor / scale)) for u in known]
    # Of rad that lie within the limits nobody asks for a gear.
    tried += [*np.arange(-LARGEST_GEAR, LARGEST_GEAR, GEAR_STEP)] if sized else []
    if not tried:
        return matches
    best = min(tried, key=left)
    if sized:
        near = (best - GEAR_STEP, best + GEAR_STEP)
        best = minimize_scalar(left, bounds=near, method="bounded").x
    unit = next(
        (u for u in known if abs(best - np.log(u.factor / scale)) < ALIKE), None
    )
    gear = _round(np.exp(-best) / scale, 0.005 * np.exp(-best) / scale)
    factor = (1.0 / gear if unit is None else unit.factor) / scale
    contents.scaled(group, factor)
    after = _misfit(contents, efforts, True)
    # Of gears that differ, one in between tells half of it.
    clearer, most = (2.0, 1.0 - EXPLAINS) if unit else (CLEARER, ONE_GEAR)
    if (
        not contents.is_inside()
        or abs(np.log(factor)) < ALIKE
        or after > min(np.log(most), before - np.log(clearer))
    ):
        contents.scaled(group, 1.0 / factor)
        if (sized or far) and before > np.log(1.0 - EXPLAINS):
            which = ", ".join(mine[i] for i in group)
            says = (
                f"{which} are too large for rad, and by the efforts in no unit that is "
                "known, nor on the motor's side of one gear: each of a gear of its "
                "own? Then give each its scale in the sidecar."
            )
            said.append(Said(UNITS_UNSURE, contents.joints[group[0]].name, 0.0, says))
        return matches
    names = {contents.joints[i].name for i in group}
    speeds = _columns_of(contents, matches, ("velocity",))
    found = {i: contents.of_velocity(speeds[i], i) for i in group if i in speeds}
    alike = {
        contents.joints[i].name for i, x in found.items() if x is not None
        and abs(abs(x.factor) / scales[speeds[i]] / factor - 1.0) < KNOWN_TO
    }  # fmt: skip
    word = f"in {unit.name}" if unit else f"{gear:g} times as large as at the joint"
    word += "" if unit else ", as on the motor's side of a gear"
    out, moved = [], []
    for m in matches:
        at, _, what = (m.channel or "").rpartition(".")
        here = "position" in what and at in names or what == "velocity" and at in alike
        if m.why != AS_SAID and here:
            why = f"{m.why}; {word}, by the efforts"
            m = replace(m, scale=m.scale * factor, offset=m.offset * factor, why=why)
            moved.append(m.column)
        out.append(m)
    says = f"By the efforts that go with them, {', '.join(moved)} are {word}."
    said.append(Said("units", contents.joints[group[0]].name, factor, says))
    return out


def _rightly_signed(contents: Contents, matches, said) -> list[Match]:
    """A position that contradicts both its velocity and its effort has the wrong sign,
    and not these two."""
    efforts, out = _columns_of(contents, matches, _DRIVES), list(matches)
    for k, m in enumerate(matches):
        at, _, what = (m.channel or "").rpartition(".")
        i = next((i for i, j in enumerate(contents.joints) if j.name == at), None)
        if what != "velocity" or m.scale > 0.0 or m.why == AS_SAID or i not in efforts:
            continue
        before, all_before = contents.of_effort(efforts[i], i), _fit(contents, efforts)
        contents.scaled([i], -1.0)
        after = contents.of_effort(efforts[i], i)
        if (
            before is None or after is None or not before.factor < 0.0 < after.factor
            or after.explained < EXPLAINS or _fit(contents, efforts) < all_before - 0.05
        ):  # fmt: skip
            contents.scaled([i], -1.0)
            continue
        out[k] = replace(m, scale=-m.scale, why=f"{m.why}; no, its position is")
        for n, other in enumerate(out):
            if other.channel in (f"{at}.position", f"{at}.position_command"):
                why = f"{other.why}; of the other sign than velocity and effort say"
                out[n] = replace(
                    other, scale=-other.scale, offset=-other.offset, why=why
                )
        says = (
            f"The position of {at} is of the other sign than velocity and effort say."
        )
        said.append(Said("position_sign", f"{at}.position", -1.0, says))
    return out


# ----- Without gravity


def _without_weight(contents: Contents, matches, said) -> None:
    """Of efforts that a controller adds the robot's weight to, the others are judged as
    such: the motion then needs no more."""
    names = [j.name for j in contents.joints]
    lacks = {}
    for m in matches:
        at, _, what = (m.channel or "").rpartition(".")
        if what in _DRIVES and at in names and contents.moves(names.index(at)):
            lacks[m.column, at] = contents.lacks_weight(m.column, names.index(at))
    told = [x for x in lacks.values() if x is not None]
    if not told or not all(told):
        return
    efforts = _columns_of(contents, matches, _DRIVES)
    n, with_weight = len(names), contents.needed
    best = _assigned(_left(efforts, contents.of_effort, n), efforts)[1]
    as_they_are = [contents.of_effort(name, i) for i, name in efforts.items()]
    if best < np.log(TOLD_WELL) and all(
        x is not None and GAINS[0] < x.factor < GAINS[1] for x in as_they_are
    ):
        return  # In one swing, weight and motion go with the same sine.
    contents.needed = with_weight - contents.weight
    after = _assigned(_left(efforts, contents.of_effort, n), efforts)[1]
    # Another direction of gravity leaves more.
    if after > min(best, np.log(NO_WEIGHT)):
        contents.needed = with_weight  # Swapped columns may look like it.
        return
    column, at = next(key for key, x in lacks.items() if x)
    says = (
        f"{column} has what the motion of {at} needs, and nothing of the weight: as "
        "what a controller commands that carries the robot's weight by itself. A scene "
        "without gravity (plant: {gravity: [0, 0, 0]}) goes with it."
    )
    said.append(Said(WITHOUT_WEIGHT, at, 0.0, says))


# ----- Whose column it is


def _rightly_ordered(contents: Contents, matches, said) -> list[Match]:
    """With the columns of velocities, or positions, or efforts at the joints that they
    fit, where that is clear."""
    n = len(contents.joints)
    speeds = _columns_of(contents, matches, ("velocity",))
    efforts = _columns_of(contents, matches, _DRIVES)
    order = _order(speeds, contents.of_velocity, n)
    if order is not None:
        before = _fit(contents, efforts)
        moved = [int(k) for k in np.argsort(order)]
        contents.moved(moved)
        if _fit(contents, efforts) > before + 0.2:
            return _reordered(contents, matches, ("position",), moved, said)
        contents.moved(range(n))
        matches = _reordered(contents, matches, ("velocity",), order, said)
    order = _order(efforts, contents.of_effort, n)
    if order is not None:
        matches = _reordered(contents, matches, _DRIVES, order, said)
    return matches


def _columns_of(contents: Contents, matches, quantities) -> dict[int, str]:
    """{joint's number: column} that no sidecar has said."""
    number = {j.name: i for i, j in enumerate(contents.joints)}
    found: dict[int, str] = {}
    for what in reversed(quantities):  # The first of them wins.
        for m in matches:
            at, _, own = (m.channel or "").rpartition(".")
            if own == what and at in number and m.why != AS_SAID:
                found[number[at]] = m.column
    return found


def _fit(contents: Contents, efforts: Mapping[int, str]) -> float:
    each = [contents.of_effort(name, i) for i, name in efforts.items()]
    return float(np.mean([0.0 if x is None else x.explained for x in each] or [0.0]))


def _order(columns: Mapping[int, str], relation, n: int) -> list[int] | None:
    """(n,) whose column fits each joint; None where the names are right, or it is not
    clear that they are wrong."""
    if len(columns) < 2:
        return None
    left = _left(columns, relation, n)
    order, _ = _assigned(left, columns)
    wrong = [i for i in range(n) if order[i] != i]
    clear = all(
        left[i, order[i]] < 1.0 - EXPLAINS and left[i, i] > CLEARER * left[i, order[i]]
        for i in wrong
    )
    return order if wrong and clear else None


def _left(columns: Mapping[int, str], relation, n: int) -> np.ndarray:
    """(n, n) share that the column of joint k leaves of joint i."""
    left = np.full((n, n), 1.0)
    for k, name in columns.items():
        for i in columns:
            found = relation(name, i)
            left[i, k] = 1.0 if found is None else 1.0 - found.explained
    return left


def _assigned(left: np.ndarray, columns: Mapping[int, str]) -> tuple[list[int], float]:
    """(n,) whose column fits each joint best; the mean logarithm of what is left."""
    there, order = list(columns), list(range(len(left)))
    if not there:
        return order, 0.0
    cost = np.log(np.maximum(left, 1e-3))[np.ix_(there, there)]
    rows, cols = linear_sum_assignment(cost)
    for i, k in zip(rows, cols, strict=True):
        order[there[i]] = there[k]
    return order, float(cost[rows, cols].mean())


def _reordered(contents, matches, quantities, order: Sequence[int], said):
    """Matches of these quantities, with joint i's column that of joint order[i]."""
    names = [j.name for j in contents.joints]
    to = {names[k]: names[i] for i, k in enumerate(order)}
    out, moved = [], []
    for m in matches:
        at, _, what = (m.channel or "").rpartition(".")
        if what in quantities and to.get(at, at) != at and m.why != AS_SAID:
            channel = f"{to[at]}.{what}"
            why = f"by its content; its name says {at.split('.', 1)[1]}"
            m = replace(m, channel=channel, why=why)
            moved.append(f"{m.column} is {channel}")
        out.append(m)
    wrong = [i for i, k in enumerate(order) if i != k]
    steps = {(order[i] - i) % len(names) for i in wrong}
    if len(wrong) == 2:
        kind, word = "columns_swapped", "two columns are swapped"
    elif steps in ({1}, {len(names) - 1}):
        kind, word = "columns_shifted", "columns are numbered one off"
    else:
        kind, word = "columns_mixed", "columns are in another order"
    says = f"By what is in them, {word}: {'; '.join(moved)}."
    said.append(Said(kind, f"{names[wrong[0]]}.{quantities[-1]}", len(wrong), says))
    return out


def _all_ordered(contents: Contents, matches, said) -> list[Match]:
    """All of the joints' columns in another order, as arrays without names have them
    where a driver sorts its joints: that in which the model explains all efforts."""
    efforts, n = _columns_of(contents, matches, _DRIVES), len(contents.joints)
    if len(efforts) < n or n > MOST_ORDERED:
        return matches
    before = _misfit(contents, efforts)
    if before < np.log(1.0 - EXPLAINS):
        return matches
    few = contents.fewer(FEW)

    def left(order: Sequence[int]) -> float:
        few.moved(order)
        if not few.is_inside():
            return 0.0
        return _misfit(few, {i: efforts[k] for i, k in enumerate(order)})

    order = tuple(range(n))
    if n <= ALL_ORDERS:
        order = min(permutations(range(n)), key=left)
    else:  # By swaps of two.
        least = np.inf
        while (now := left(order)) < least:
            least = now
            near = []
            for i, k in combinations(range(n), 2):
                other = list(order)
                other[i], other[k] = other[k], other[i]
                near.append(tuple(other))
            best = min(near, key=left)
            order = best if left(best) < least else order
    contents.moved(order)
    after = _misfit(contents, {i: efforts[k] for i, k in enumerate(order)})
    if after > min(np.log(1.0 - EXPLAINS), before - np.log(CLEARER)):
        contents.moved(range(n))
        return matches
    every = ("position", "velocity", *_DRIVES, "position_command", "velocity_command")
    return _reordered(contents, matches, every, order, said)


def _from_their_zeros(contents: Contents, matches, said) -> list[Match]:
    """With a joint's zero a quarter or half a turn elsewhere, where the model then
    explains the efforts."""
    efforts = _columns_of(contents, matches, _DRIVES)
    before = _misfit(contents, efforts) if efforts else -np.inf
    if before < np.log(TOLD_WELL):
        return matches
    each = {i: contents.of_effort(name, i) for i, name in efforts.items()}
    off = [i for i, x in each.items() if x is None or x.explained < EXPLAINS]
    if len(off) > MOST_OFF:
        return matches
    few, found = contents.fewer(FEW), {}
    mine = _columns_of(contents, matches, ("position",))
    for i in (i for i in mine if not contents.joints[i].prismatic):
        for angle in (0.25 * TURN, -0.25 * TURN, 0.5 * TURN, -0.5 * TURN):
            few.turned(i, angle)
            if few.is_inside():
                found[i, angle] = _misfit(few, efforts)
            few.turned(i, -angle)
    if not found:
        return matches
    i, angle = min(found, key=lambda key: found[key])
    contents.turned(i, angle)
    if _misfit(contents, efforts) > min(
        np.log(1.0 - EXPLAINS), before - np.log(CLEARER)
    ):
        contents.turned(i, -angle)
        return matches
    at, word = contents.joints[i].name, f"{np.rad2deg(angle):+.0f} deg"
    says = f"By the efforts, the zero of {mine[i]} is another than that of {at}: taken "
    says += f"{word}; or what carries it is turned so."
    said.append(Said("position_zero", f"{at}.position", angle, says))
    return [
        replace(m, offset=m.offset + angle, why=f"{m.why}; {word}, by the efforts")
        if m.channel in (f"{at}.position", f"{at}.position_command")
        and m.why != AS_SAID else m
        for m in matches
    ]  # fmt: skip


def _mirrored(contents: Contents, matches, said) -> None:
    """Says where joints that turn the other way would explain the efforts: all of such
    a joint may be reversed, or left and right limbs are taken for each other."""
    efforts = _columns_of(contents, matches, _DRIVES)
    before = _misfit(contents, efforts) if efforts else -np.inf
    if before < np.log(TOLD_WELL):
        return
    few, gains = contents.fewer(FEW), {}
    start = _misfit(few, efforts)
    for i in (i for i in efforts if not contents.joints[i].prismatic):
        few.scaled([i], -1.0)
        gains[i] = start - _misfit(few, efforts)
        few.scaled([i], -1.0)
    others = [i for i, gain in gains.items() if gain > np.log(CLEARER) / len(efforts)]
    few.scaled(others, -1.0)
    if _misfit(few, efforts) < min(np.log(1.0 - EXPLAINS), start - np.log(CLEARER)):
        names = ", ".join(contents.joints[i].name for i in others)
        says = (
            f"The efforts would go with the motion if {names} turned the other way: "
            "are left and right limbs taken for each other (columns in another order), "
            "or are these joints reversed? Put it right in the sidecar."
        )
        said.append(Said(MIRRORED, contents.joints[others[0]].name, 0.0, says))


# ----- What drives a joint


def _drives_that_drive(contents: Contents, matches, said) -> list[Match]:
    """An effort that explains nothing of what its joint needs gives its place to
    another column that does."""
    out = list(matches)
    for i, joint in enumerate(contents.joints):
        if not contents.moves(i):
            continue
        mine = [f"{joint.name}.{what}" for what in _DRIVES]
        own = [k for k, m in enumerate(out) if m.channel in mine and m.why != AS_SAID]
        others = [k for k, m in enumerate(out)
                  if m.may in mine and not m.why.startswith(CURRENT)]  # fmt: skip
        share = {k: _share(contents, out[k].column, i) for k in (*own, *others)}
        best = max((*own, *others), key=lambda k: share[k], default=None)
        for k in own:
            if best is None or not share[k] < NOTHING < EXPLAINS < share[best]:
                continue
            match = out[k]
            what = str(match.channel).rsplit(".", 1)[1]
            why = f"{what}: it explains {share[k]:.0%} of what the joint needs"
            out[k] = replace(match, channel=None, why=why)
            instead = out[best]
            if best in others:
                why = f"it explains {share[best]:.0%} of what the joint needs"
                out[best] = replace(instead, channel=instead.may, may="", why=why)
            says = (
                f"Column {match.column} explains {max(share[k], 0.0):.0%} of the "
                f"effort that {joint.name} needs, and {instead.column} "
                f"{share[best]:.0%}: that is taken for what drives it."
            )
            said.append(Said("no_content", joint.name, share[k], says))
    return out


def _share(contents: Contents, column: str, i: int, rotor: bool = False) -> float:
    found = contents.of_effort(column, i, rotor)
    return 0.0 if found is None else found.explained


# ----- Factors and signs


def _with_factors(contents: Contents, matches, said) -> list[Match]:
    out = list(matches)
    for what in _DRIVES:
        found: dict[int, tuple[int, Likeness]] = {}
        for k, m in enumerate(out):
            at, _, own = (m.channel or "").rpartition(".")
            numbers = [i for i, j in enumerate(contents.joints) if j.name == at]
            if own == what and numbers and m.why != AS_SAID:
                x = contents.of_effort(m.column, numbers[0])
                if x is not None:
                    found[numbers[0]] = (k, x)
        factors = _factors(contents, {
            i: (out[k].column, replace(x, factor=x.factor / out[k].scale,
                                       std=abs(x.std / out[k].scale)))
            for i, (k, x) in found.items()
        })  # fmt: skip
        for i, (factor, word) in factors.items():
            k, _ = found[i]
            m = out[k]
            out[k] = replace(m, scale=m.scale * factor, why=f"{m.why}; {word}")
        for word in dict.fromkeys(word for _, word in factors.values()):
            mine = [i for i, (_, own) in factors.items() if own == word]
            names = ", ".join(out[found[i][0]].column for i in mine)
            scales = sorted({f"{factors[i][0]:.4g}" for i in mine}, key=float)
            factor, says = factors[mine[0]][0], f"{names}: {word}"
            kind = {1.0: UNSURE, -1.0: "effort_sign"}.get(factor, "effort_factor")
            if kind != UNSURE:
                says += f". Taken times {', '.join(scales)}"
            if kind == "effort_factor":
                says += "; or the masses of the model are off by that, all alike"
            channel = f"{contents.joints[mine[0]].name}.{what}"
            said.append(Said(kind, channel, factor, f"{says}."))
    return out


def _unexplained(contents: Contents, matches, said) -> None:
    """Says where efforts do not go with the motion, whatever they count in."""
    efforts = _columns_of(contents, matches, _DRIVES)
    # In one swing a rotor's torque and the weight are the same.
    left = {i: max(_share(contents, name, i), _share(contents, name, i, True))
            for i, name in efforts.items() if contents.moves(i)}  # fmt: skip
    off = [i for i, share in left.items() if share < NOTHING]
    if 2 * len(off) > len(left):
        says = (
            f"{', '.join(efforts[i] for i in off)} explain less than {NOTHING:.0%} of "
            "what the model needs for the motion: are these the robot's columns, in "
            "its joints' order, and nothing pushes it?"
        )
        said.append(Said(UNEXPLAINED, contents.joints[off[0]].name, len(off), says))


def _from_a_start(contents: Contents, matches, said) -> None:
    """Says where positions may count from where the log begins, as incremental encoders
    do: all begin at 0, and the efforts are others than there."""
    efforts = _columns_of(contents, matches, _DRIVES)
    moving = [i for i in range(len(contents.joints)) if contents.moves(i)]
    if len(moving) < 2 or not (np.abs(contents.first[moving]) < AT_ZERO).all():
        return
    if efforts and _misfit(contents, efforts, True) > np.log(TOLD_WELL):
        says = (
            "All positions begin at 0, and the efforts are not those that the model "
            "needs from there: do they count from where the log, or the robot, was "
            "started? Then give each its offset in the sidecar."
        )
        said.append(Said(FROM_A_START, contents.joints[moving[0]].name, 0.0, says))


def _late(contents: Contents, matches, said) -> None:
    """Says where efforts are measured, or stamped, after they have acted. (Before it,
    they may be commands that come through late, which a search names.) Of a slow robot
    that looks like friction that drives: friction has its sign here."""
    efforts = _columns_of(contents, matches, _DRIVES)
    few = contents.fewer(MOST_LATE)

    def left(late: float) -> float:
        few.late = late
        each = [few.left_by_friction(name, i) for i, name in efforts.items()]
        return float(np.mean(np.log(np.maximum(each, LEAST_LEFT)))) if each else 0.0

    before = left(0.0)
    if before < np.log(10.0 * LEAST_LEFT):
        return
    start = min(np.arange(-LATEST_SEC, LATEST_SEC, LATE_STEP_SEC), key=left)
    near = (start - LATE_STEP_SEC, start + LATE_STEP_SEC)
    late = float(minimize_scalar(left, bounds=near, method="bounded").x)
    if late > contents.period and left(late) < before - np.log(CLEARER):
        says = (
            f"{', '.join(efforts.values())} go with the motion {1e3 * late:.2g} ms "
            "before their stamps: they are filtered or stamped late, or have another "
            "clock."
        )
        first = contents.joints[next(iter(efforts))].name
        said.append(Said(LATE, first, late, says))


def _factors(
    contents: Contents, found: Mapping[int, tuple[str, Likeness]]
) -> dict[int, tuple[float, str]]:
    """{joint: (what its effort is to be multiplied with, as what it looks)} where that
    is no gain of an actuator."""
    known = {
        i: x for i, (_, x) in found.items()
        if x.explained > EXPLAINS and x.std < KNOWN_TO * abs(x.factor)
    }  # fmt: skip
    rated = {i: _rated(contents.joints[i], x.factor) for i, x in known.items()}
    if len(rated) > 1 and all(rated.values()) and any(map(_is_odd, known.values())):
        part, word = next(filter(None, rated.values()))
        return {
            i: (float(np.sign(known[i].factor if i in known else 1.0)) * size, word)
            for i in found if np.isfinite(size := part * contents.joints[i].effort)
        }  # fmt: skip
    every = known
    # One factor of all is no matter of their rotors.
    middle, within = _one_factor(list(known.values()))
    alike = within > 0.0 and len(known) > 1
    if not alike:
        known = {
            i: x for i, x in known.items() if not 0.0 < x.factor < GAINS[1]
            or _not_a_rotor(contents, found[i][0], i, x.factor)
        }  # fmt: skip
        middle, within = _one_factor(list(known.values()))
        alike = within > 0.0 and (len(known) > 1 or abs(middle) > 1.0)
    odd = {i: x.factor for i, x in known.items() if _is_odd(x)}
    if not odd:
        return {}
    # Loads and springs make some efforts larger, or smaller, but not all of them; what
    # two joints tell is no rotor is none at the others.
    whole = len(every) == len(found) and all(map(_is_odd, every.values()))
    if not alike and whole and len(known) > 1:
        odd = {i: x.factor for i, x in every.items()}
    elif not alike:
        odd = {i: f for i, f in odd.items()
               if f < 0.0 or not 1.0 / LARGE < f < LARGER}  # fmt: skip
    if alike:  # Of joints that do not tell, as of those that do.
        odd = dict.fromkeys(found, middle)
    out = {i: (1.0, _UNSURE) for i, x in known.items() if x.factor < GAINS[0]}
    for i, factor in odd.items():
        std = found[i][1].std if not alike else within
        out[i] = _in_words(factor, std)
    return out


def _is_odd(x: Likeness) -> bool:
    return not GAINS[0] < x.factor < GAINS[1]


def _rated(joint: JointName, factor: float) -> tuple[float, str] | None:
    """The part of a joint's effort limit that a factor is, if it is one that drives
    count in."""
    for part, word in ((1e-2, "per cent"), (1e-3, "per mille")):
        if abs(abs(factor) / (part * joint.effort) - 1.0) < ALIKE:
            return part, f"as if in {word} of each joint's effort limit"
    return None


def _one_factor(each: Sequence[Likeness]) -> tuple[float, float]:
    """The factor that all are, and its standard deviation; 0 where they differ."""
    if not each:
        return 0.0, 0.0
    factors = np.array([x.factor for x in each])
    stds = np.maximum([x.std for x in each], 1e-3 * np.abs(factors))
    middle = float(np.average(factors, weights=stds**-2.0))
    within = float(max(ALIKE / 6.0 * abs(middle), np.sum(stds**-2.0) ** -0.5))
    room = np.maximum(ALIKE * abs(middle), SIGMAS * stds)
    return middle, within if (np.abs(factors - middle) < room).all() else 0.0


def _not_a_rotor(contents: Contents, name: str, i: int, factor: float) -> bool:
    """Whether a factor stays where a rotor's inertia is free: what an effort is too
    large by may turn one that the model lacks."""
    x = contents.of_effort(name, i, rotor=True)
    return (
        x is not None and x.std < KNOWN_TO * abs(x.factor)
        and abs(x.factor / factor - 1.0) < KNOWN_TO
    )  # fmt: skip


def _in_words(factor: float, std: float) -> tuple[float, str]:
    """A factor, as round as it may be, and what it looks like."""
    size, sign = abs(factor), float(np.sign(factor))
    other = "of the other sign than the model needs"
    if GAINS[0] < size < GAINS[1]:
        return sign, other
    word = ""
    for unit, name in _UNITS:
        if abs(size / unit - 1.0) < ALIKE:
            size, word = unit, name
    if not word:
        size = _round(size, max(2.0 * std, 0.005 * size))
        ratio = size if size > 1.0 else 1.0 / size
        word = (
            f"{ratio:.3g} times {'smaller' if size > 1.0 else 'larger'} than the model "
            "needs, as on the motor's side of a gear, in amperes or in another unit"
        )
    return sign * size, word + (f", and {other}" if sign < 0.0 else "")


def _round(x: float, within: float) -> float:
    """The number of fewest digits that is so near."""
    for digits in range(1, 8):
        y = float(f"{x:.{digits - 1}e}")
        if abs(y - x) <= within:
            return y
    return x


def told_by(contents: Contents, matches: Sequence[Match]) -> dict[str, Likeness]:
    """{column of a motor's current, or in a unit that says too little: what an effort
    is, times it} where the model tells that."""
    number = {j.name: i for i, j in enumerate(contents.joints)}
    out = {}
    for m in matches:
        i = number.get(m.may.rpartition(".")[0])
        if m.channel is None and i is not None:
            x = contents.of_effort(m.column, i)
            if x is not None and x.explained > EXPLAINS:
                out[m.column] = x
    return out


def check_contents(
    plant: MultibodyPlant, recordings: Sequence[Recording]
) -> list[Finding]:
    """What channels' contents say against their names: until that is put right, an
    effect would only make up for it."""
    joints = [
        JointName(
            full_name(plant, j),
            j.type_name() == "prismatic",
            effort=np.inf if (a := actuator_of(plant, j)) is None else a.effort_limit(),
        )
        for j in sorted(one_dof_joints(plant), key=lambda j: j.position_start())
        if j.num_positions()
    ]
    found = []
    for r in recordings:
        columns = {"time": r.time} | {c.name: c.values for c in r.channels.values()}
        matches = [Match(name, name) for name in columns]
        _, said = by_content(plant, joints, columns, matches)
        for each in said:
            says = each.says
            if each.kind == "effort_factor":
                says += (
                    f" In the sidecar: columns: {{NAME: {{channel: {each.channel}, "
                    f"scale: {each.size:.6g}}}}}"
                )
            severity = _SEVERITY.get(each.kind, "error")
            found.append(
                Finding(each.kind, r.name, each.channel, each.size, "", severity, says)
            )
    return found
