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
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.optimize import linear_sum_assignment, minimize_scalar, nnls

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
LEAST_LEFT = 1e-5  # Less is rounding.
GIVES_WAY = 0.05  # [rad], [m]
LEAST_TOLD = 0.3  # Of a column that is not noise, to judge it without that.
TURNED = 0.2  # Of gravity, by which it is another one.
WELL_HUNG = 0.25  # Of efforts, left by gravity of another direction and friction.
PARTS = 5  # Of the data: a factor scatters over them.
KNOWN_TO = 0.1  # Of a factor, 1 sigma.
# Factors of one robot differ by less than this share, or by so many sigmas.
ALIKE, SIGMAS = 0.03, 3.0
# A search takes factors of drives between these for a gain of the actuator; without a
# gain, masses would have to make up for others.
GAINS = (0.45, 1.6)
WEIGHS = 0.1  # Of what a joint needs: an offset that is clear, or next to none.
FEW, MOST_LATE = 100, 300  # Instants at which many readings, or delays, are tried.
ALL_ORDERS, MOST_ORDERED = 6, 8  # Joints of which all orders, or swaps, are tried.
ROOM = 0.1  # Of a joint's range, beyond it.
ONE_GEAR = 0.03  # Of a gear: it is as round as that lets it be.
# Gears from which a search for them starts, and its rounds.
GEARS, ROUNDS = (30.0, 60.0, 100.0, 160.0), 15
LEAST_READ = 1e-4  # A share: of less no other reading is better.
_MOTION = ("position", "velocity")
FAR = 1000.0  # [rad] No joint turns by so much between its limits.
LATEST_SEC, LATE_STEP_SEC = 0.1, 0.01
# Of one joint alone, what it carries may make its effort so many times larger; what
# holds it up, smaller.
LARGE, LARGER = 20.0, 3.0
WITHOUT_WEIGHT = "effort_without_weight"
UNSURE, UNITS_UNSURE, LATE = "effort_unsure", "units_unsure", "effort_late"
FROM_A_START, TARED = "position_from_start", "effort_tared"
AT_ZERO = 1e-3  # [rad], [m]
ZERO_STEPS, ZEROS = (0.5, 0.5, 0.1), 6  # [rad] of zeros that are tried, on either side.
UNEXPLAINED, MIRRORED = "effort_unexplained", "joints_mirrored"
_UNSURE = (
    "larger than the model needs, several times, and no rotor would do: another unit, "
    "or a load or a spring that the model lacks; taken as it is"
)
_UNTOLD = (
    "in a unit of its own, as those of other joints are, which the motion does not "
    "tell; taken as it is"
)
_OTHER_SIGN = (
    "of the other sign than the model needs (or its position and velocity are)"
)
_SEVERITY = {
    "no_content": "warning",
    "too_short": "info",
    UNSURE: "warning",
    UNITS_UNSURE: "warning",
    LATE: "warning",
    FROM_A_START: "warning",
    TARED: "warning",
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
class Told:
    """effort = (what its joint needs - bias) / factor, with friction and a rotor's
    inertia beside it, but for a share that is left; other: by the other sign; rubs: the
    share of friction in it."""

    left: float
    factor: float
    bias: float
    other: float = 1.0
    rubs: float = 0.0


@dataclass(frozen=True, eq=False)
class Reading:
    """How positions are read: those of joints `order` (n,), times scale (n,), which is
    below 0 of those that count the other way, plus zero (n,) [rad]. weightless: efforts
    have no part of the robot's weight."""

    order: tuple[int, ...]
    scale: np.ndarray
    zero: np.ndarray
    weightless: bool = False

    @staticmethod
    def as_is(n: int) -> "Reading":
        """Of n joints, as their matches have them."""
        return Reading(tuple(range(n)), np.ones(n), np.zeros(n))

    def scaled(self, joints: Sequence[int], factors) -> "Reading":
        """With these joints' positions times factors."""
        times = np.ones(len(self.scale))
        times[list(joints)] = factors
        return replace(self, scale=times * self.scale, zero=times * self.zero)

    def turned(self, i: int, angle: float) -> "Reading":
        """With another zero of a joint."""
        zero = self.zero.copy()
        zero[i] += angle
        return replace(self, zero=zero)


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
        time = found["time"].values(columns)
        q = np.stack([found[name].values(columns) for name in names], axis=1)
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
        self._motion = [x[self._some] for x in states]
        self.late = 0.0  # [s] How late columns are taken to be.
        self.read(Reading.as_is(len(names)))

    def read(self, reading: "Reading") -> None:
        """With the measured joints' positions read so."""
        order = list(reading.order)
        self.reading = reading
        self.q, self.v, self.vd = (x[:, order] * reading.scale for x in self._motion)
        self.q = self.q + reading.zero
        self.needed = needed_efforts(self._plant, self.q, self.v, self.vd)
        if reading.weightless:
            self.needed = self.needed - self.weight()

    def weight(self) -> np.ndarray:
        """(m, n_q) what gravity needs of the joints."""
        context = self._plant.CreateDefaultContext()
        out = np.empty_like(self.q)
        for k, q in enumerate(self.q):
            self._plant.SetPositions(context, q)
            out[k] = -self._plant.CalcGravityGeneralizedForces(context)
        return out

    def gravity(self, efforts: Mapping[int, str]) -> tuple[np.ndarray, float]:
        """(3,) gravity [m/s2] in world with which the efforts go with the motion best,
        beside friction; and the share of them that it leaves."""
        plant, world = self._plant, self._plant.world_frame()
        context, n = plant.CreateDefaultContext(), len(self.joints)
        J, mass = np.zeros((len(self.q), 3, n)), plant.CalcTotalMass(context)
        for k, q in enumerate(self.q if mass > 0.0 else ()):
            plant.SetPositions(context, q)
            J[k] = plant.CalcJacobianCenterOfMassTranslationalVelocity(
                context, JacobianWrtVariable.kV, world, world
            )
        own = -mass * J
        moved, A, b = self.needed - self.weight(), [], []
        for i, name in efforts.items():
            if (y := self.column(name)) is None or not np.ptp(y) > 0.0:
                continue
            rubs = np.zeros((len(y), 2 * n))
            rubs[:, i], rubs[:, n + i] = self.v[:, i], np.sign(self.v[:, i])
            A.append(np.hstack([own[:, :, i], rubs]) / np.std(y))
            b.append((y - moved[:, i]) / np.std(y))
        if not A:
            return np.zeros(3), 1.0
        X, y = np.vstack(A), np.concatenate(b)
        c = np.linalg.lstsq(X, y, rcond=None)[0]
        return c[:3], float(np.sum((y - X @ c) ** 2) / np.sum(y**2))

    def fewer(self, m: int) -> "Contents":
        """At about m instants."""
        k = max(len(self.q) // m, 1)
        other = copy(self)
        other._some = slice(None, None, k * self._some.step)
        other._motion = [x[::k] for x in self._motion]
        other.read(self.reading)
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

    def raw(self, name: str) -> np.ndarray:
        """Its samples in the rows that are looked at."""
        y = self._columns[name][self._rows[0] : self._rows[-1] + 1]
        return y[np.isfinite(y)]

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

    def told(self, name: str, i: int) -> Told:
        """What an effort is, of either sign, beside a bias, friction and a rotor's
        inertia, which never drive."""
        y, needed = self.column(name), self.needed[:, i]
        v, vd = self.v[:, i], self.vd[:, i]
        if y is None or not (np.ptp(y) > 0.0 and np.ptp(needed) > 0.0):
            return Told(1.0, 1.0, 0.0)
        one = np.ones_like(v)
        X = np.stack([needed, one, -one, v, np.sign(v), vd], axis=1)
        size = np.maximum(np.abs(X).max(axis=0), 1e-300)
        fits = [(*nnls(X / size, sign * y), sign) for sign in (1.0, -1.0)]
        (c, off, sign), (_, more, _) = sorted(fits, key=lambda each: each[1])
        c = c / size
        share = c[0] if c[0] > 0.0 else 1.0
        left, other = (x**2 / (np.var(y) * len(v)) for x in (off, more))
        bias = (c[2] - c[1]) / share
        rubs = float(np.var(X[:, 3:5] @ c[3:5]) / np.var(y))
        return Told(float(left), float(sign / share), float(bias), float(other), rubs)


def _range(y: np.ndarray) -> float:
    """Of the numbers that are there."""
    return float(np.ptp(y[np.isfinite(y)])) if np.isfinite(y).any() else 0.0


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
    matches = _rightly_ordered(contents, matches, said)
    matches = _all_ordered(contents, matches, said)
    matches = _rightly_read(contents, matches, said)
    matches = _drives_that_drive(contents, matches, said)
    matches = _without_parts(contents, matches, said)
    matches = _with_factors(contents, matches, said)
    matches = _tared(contents, matches, said)
    _unexplained(contents, matches, said)
    _late(contents, matches, said)
    _from_a_start(contents, matches, said)
    return matches, said


def turned_gravity(
    plant: MultibodyPlant,
    joints: Sequence[JointName],
    columns: Mapping[str, np.ndarray],
    matches: Sequence[Match],
) -> np.ndarray | None:
    """(3,) gravity [m/s2] in world with which the efforts go with the motion, as where
    the base hangs from a wall; None where none does, or it is so near the file's that
    the search may tell it (gravity_tilt)."""
    try:
        contents = Contents(plant, joints, columns, matches)
    except ValueError:
        return None
    efforts = _columns_of(contents, matches, _DRIVES)
    g, rest = contents.gravity(efforts)
    off = abs(float(np.linalg.norm(g)) / 9.81 - 1.0)
    left = [contents.told(name, i).left for i, name in efforts.items()]
    much = max(1.0 - EXPLAINS, CLEARER * rest)
    clear = off < KNOWN_TO and rest < WELL_HUNG and np.median(left or [0.0]) > much
    file = plant.gravity_field().gravity_vector()
    turned = float(np.linalg.norm(g - file)) > TURNED * float(np.linalg.norm(g))
    return g if clear and turned else None


# ----- What has no content


def _without_empty(columns, matches: Sequence[Match], said) -> list[Match]:
    """Without efforts and commands that stay the same while their joint moves; another
    column of the same channel takes their place. A joint that is held follows a command
    that stays the same, as near as others follow theirs."""
    position = {
        m.channel: m for m in matches if (m.channel or "").endswith(".position")
    }
    follows = _follows(columns, matches, position)
    others = [off for name, off in follows.items() if _range(columns[name]) > 0.0]
    near = max(others, default=0.0)
    out = list(matches)
    for k, match in enumerate(matches):
        at, _, what = (match.channel or "").rpartition(".")
        own = position.get(f"{at}.position")
        if what not in (*_DRIVES, "position_command", "velocity_command"):
            continue
        y = match.values(columns) if match.activation else columns[match.column]
        y = y[np.isfinite(y)]
        # One that is held gives way a little.
        moves = own is not None and _range(own.values(columns)) > GIVES_WAY
        if len(y) and (np.ptp(y) > 0.0 or not moves) or match.why == AS_SAID:
            continue
        if follows.get(match.column, np.inf) <= near:
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


def _follows(columns, matches: Sequence[Match], position) -> dict[str, float]:
    """{column of position commands: how far from it its joint is, rms}."""
    found = {}
    for match in matches:
        at, _, what = (match.channel or "").rpartition(".")
        own = position.get(f"{at}.position")
        if what == "position_command" and own is not None:
            off = own.values(columns) - match.values(columns)
            if (there := off[np.isfinite(off)]).size:
                found[match.column] = float(np.sqrt(np.mean(there**2)))
    return found


# ----- Whose column it is


def _rightly_ordered(contents: Contents, matches, said) -> list[Match]:
    """With the columns of velocities, or positions, or efforts at the joints that they
    fit, where that is clear."""
    n = len(contents.joints)
    speeds = _columns_of(contents, matches, ("velocity",))
    efforts = _columns_of(contents, matches, _DRIVES)
    order = _order(speeds, contents.of_velocity, n)
    if order is not None:
        before = _misfit(contents, efforts) if efforts else 0.0
        moved = [int(k) for k in np.argsort(order)]
        contents.read(replace(contents.reading, order=tuple(moved)))
        if efforts and _misfit(contents, efforts) < before - np.log(CLEARER):
            return _reordered(contents, matches, ("position",), moved, said)
        contents.read(Reading.as_is(n))
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


def _order(columns: Mapping[int, str], relation, n: int) -> list[int] | None:
    """(n,) whose column fits each joint; None where the names are right, or it is not
    clear that they are wrong."""
    if len(columns) < 2:
        return None
    left = _left(columns, relation, n)
    there, order = list(columns), list(range(n))
    cost = np.log(np.maximum(left, 1e-3))[np.ix_(there, there)]
    for i, k in zip(*linear_sum_assignment(cost), strict=True):
        order[there[i]] = there[k]
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
    if before < np.log(TOLD_WELL):
        return matches
    few = contents.fewer(FEW)

    def left(order: Sequence[int]) -> float:
        few.read(replace(few.reading, order=tuple(order)))
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
    contents.read(replace(contents.reading, order=tuple(order)))
    after = _misfit(contents, {i: efforts[k] for i, k in enumerate(order)})
    if after > min(np.log(1.0 - EXPLAINS), before - np.log(CLEARER)):
        contents.read(Reading.as_is(n))
        return matches
    every = ("position", "velocity", *_DRIVES, "position_command", "velocity_command")
    return _reordered(contents, matches, every, order, said)


# ----- How positions are read


def _misfit(contents: Contents, efforts: Mapping[int, str]) -> float:
    """Mean logarithm of the shares that efforts leave."""
    return float(np.mean([*_logs_left(contents, efforts).values()]))


def _logs_left(contents: Contents, efforts: Mapping[int, str]) -> dict[int, float]:
    """{joint's number: logarithm of the share that its effort leaves}."""
    told = _all_told(contents, efforts)
    return {i: float(np.log(max(x.left, LEAST_LEFT))) for i, x in told.items()}


def _rightly_read(contents: Contents, matches, said) -> list[Match]:
    """Positions read as the efforts go with them: joints that count the other way, or
    from another zero, on the motor's side of gears or in another unit, and a robot that
    something else carries. All are tried, the one that leaves least is taken, and all
    are tried again."""
    efforts = {i: name for i, name in _columns_of(contents, matches, _DRIVES).items()
               if contents.moves(i)}  # fmt: skip
    mine = _columns_of(contents, matches, ("position",))
    turn = [i for i in mine if not contents.joints[i].prismatic]
    of = {m.column: m for m in matches}
    sized = [i for i in turn if of[mine[i]].told.endswith(BY_SIZE)
             or np.ptp(contents.q[:, i]) > FAR]  # fmt: skip
    few = contents.fewer(FEW)
    reading, now = few.reading, _all_told(few, efforts)
    while True:
        if max((x.left for x in now.values()), default=0.0) < TOLD_WELL and not (
            sized and _geared_factors(now)[0]
        ):
            break
        best, most = None, 0.0
        for other, is_gear in _readings(few, reading, efforts, turn, of, mine, sized):
            few.read(other)
            then = _all_told(few, efforts)
            gain = _gain(now, then, is_gear)
            if gain > most and (other.weightless or few.is_inside()):
                best, most, after = other, gain, then
        if best is None:
            break
        reading, now = best, after
    contents.read(reading)
    return _as_read(contents, matches, mine, efforts, now, sized, said)


def _all_told(contents: Contents, efforts: Mapping[int, str]) -> dict[int, Told]:
    return {i: contents.told(name, i) for i, name in efforts.items()}


def _gain(before, after: Mapping[int, Told], is_gear: bool) -> float:
    """How much less another reading leaves, as a logarithm; 0 where that is not
    clear."""
    differ = _geared_factors(before)[1]
    less = {
        i: np.log(max(x.left, LEAST_READ) / max(after[i].left, LEAST_READ))
        for i, x in before.items()
    }
    other = [i for i, x in less.items() if abs(x) > np.log(1.0 + KNOWN_TO)]
    gain = float(sum(less.values()))
    if min(less.values()) < -np.log(2.0) or any(
        after[i].left > 1.0 - EXPLAINS for i in other
    ):
        return 0.0
    # Signs of efforts that are wrong are another thing, and so are gears that differ.
    turned = sum((x.factor < 0.0) - (after[i].factor < 0.0) for i, x in before.items())
    clear = 2.0 * np.log(CLEARER) if not is_gear else 0.0 if differ else np.log(2.0)
    return gain + turned if gain > clear else 0.0


def _geared_factors(told: Mapping[int, Told]) -> tuple[bool, bool]:
    """Whether efforts look as on the motor's side of gears; of gears that differ."""
    factors = np.array([max(abs(x.factor), 1e-9) for x in told.values()])
    if not len(factors) or not np.median(factors) > GAINS[1]:
        return False, False
    return True, bool(np.ptp(np.log(factors)) > 2.0 * ALIKE)


def _readings(few, reading: Reading, efforts, turn, of, mine, sized):
    """(another reading, whether it is of gears), each that is one step away."""
    own = [i for i in turn if of[mine[i]].why != AS_SAID]
    for i in (i for i in mine if of[mine[i]].why != AS_SAID):
        yield reading.scaled([i], -1.0), False
        for angle in (0.25, -0.25, 0.5, -0.5) if i in own else ():
            yield reading.turned(i, angle * TURN), False
    yield replace(reading, weightless=not reading.weightless), False
    if not own:
        return
    scale = np.array([abs(of[mine[i]].scale * reading.scale[i]) for i in own])
    for unit in TURNING if sized else [Unit("turns", TURN)]:
        if np.abs(np.log(unit.factor / scale)).max() > ALIKE:
            yield reading.scaled(own, unit.factor / scale), False
    for power in (0.0, 1.0) if sized else ():
        yield _geared(few, reading, efforts, own, scale, power), True


def _geared(few, reading: Reading, efforts, own, scale, power: float) -> Reading:
    """Positions on the motor's side of gears: where efforts need another factor than
    the gear to a power, as behind it (1) or at the joint (0), the scale is off."""
    best, least = np.zeros(len(own)), np.full(len(own), np.inf)
    for gear in (*GEARS, None):  # Last from the best of each joint.
        size = np.full(len(own), -np.log(gear)) if gear else best.copy()
        for _ in range(ROUNDS):
            few.read(reading.scaled(own, np.exp(size) / scale))
            told = _all_told(few, efforts)
            left = [told[i].left if i in told else 1.0 for i in own]
            best = np.where(left < least, size, best)
            least = np.minimum(left, least)
            off = [np.log(max(abs(told[i].factor), 1e-9)) if i in told else np.nan
                   for i in own]  # fmt: skip
            step = -0.4 * (np.array(off) + power * size)
            step[~np.isfinite(step)] = np.nan_to_num(np.nanmedian(step))
            size = size + step
    gears = [_round(x, ONE_GEAR * x / 6.0) for x in np.exp(-size)]
    return reading.scaled(own, 1.0 / (np.array(gears) * scale))


def _as_read(contents: Contents, matches, mine, efforts, told, sized, said):
    """Matches with positions and velocities as they are read, and what is said."""
    reading, names = contents.reading, [j.name for j in contents.joints]
    backward = [i for i in mine if reading.scale[i] < 0.0]
    whole = [i for i in backward if i in told and told[i].factor < 0.0]
    if len(whole) > 1:
        says = (
            "The efforts would go with the motion if "
            f"{', '.join(names[i] for i in whole)} turned the other way: "
            "are left and right limbs taken for each other (columns in another order), "
            "or are these joints reversed? Put it right in the sidecar."
        )
        said.append(Said(MIRRORED, names[whole[0]], 0.0, says))
        reading = reading.scaled(whole, -1.0)
        contents.read(reading)
        backward = [i for i in backward if i not in whole]
    words: dict[int, list[str]] = {i: [] for i in mine}
    for i in backward:
        words[i].append("counted the other way")
        says = (
            f"By the efforts, {mine[i]} counts the other way than {names[i]}: its "
            "position is of the other sign, and so is a velocity that goes with it."
        )
        said.append(Said("position_sign", f"{names[i]}.position", -1.0, says))
    for i in mine:
        if (angle := reading.zero[i]) != 0.0:
            words[i].append(word := f"{np.rad2deg(angle):+.0f} deg")
            says = (
                f"By the efforts, the zero of {mine[i]} is another than that of "
                f"{names[i]}: taken {word}; or what carries it is turned so."
            )
            said.append(Said("position_zero", f"{names[i]}.position", angle, says))
    if reading.weightless:
        says = (
            f"{', '.join(efforts.values())} have what the motion needs, and nothing of "
            "the weight: as what a controller commands that carries the robot's weight "
            "by itself. A scene without gravity (plant: {gravity: [0, 0, 0]}) goes "
            "with it."
        )
        said.append(Said(WITHOUT_WEIGHT, names[next(iter(efforts))], 0.0, says))
    scale, of = np.abs(reading.scale), {m.column: m for m in matches}
    scaled = [i for i in mine if abs(np.log(scale[i])) > 1e-9]
    units: dict[str, list[int]] = {}
    for i in scaled:
        size = abs(of[mine[i]].scale) * scale[i]
        unit = next((u for u in TURNING if abs(np.log(u.factor / size)) < 1e-9), None)
        gear = f"{_round(1.0 / size, 1e-6 / size):g} times as large as at the joint"
        word = f"{gear}, as on the motor's side of a gear"
        word = f"in {unit.name}" if unit else word
        words[i].append(word)
        units.setdefault(word, []).append(i)
    for word, own in units.items():
        which = ", ".join(mine[i] for i in own)
        says = f"By the efforts that go with them, {which} are {word}."
        said.append(Said("units", names[own[0]], float(scale[own[0]]), says))
    off = [i for i in mine if i in told and told[i].left > 1.0 - EXPLAINS]
    off = [i for i in off if i in sized]
    if off and not scaled:
        which = ", ".join(mine[i] for i in off)
        says = (
            f"{which}: too large for rad, and by the efforts in no unit that is known, "
            "nor on the motor's side of gears. Give each its scale in the sidecar."
        )
        said.append(Said(UNITS_UNSURE, names[off[0]], 0.0, says))
    out, number = [], {name: i for i, name in enumerate(names)}
    for m in matches:
        at, _, what = (m.channel or "").rpartition(".")
        i = number.get(at, -1)
        if m.why != AS_SAID and words.get(i) and what.split("_")[0] in _MOTION:
            factor, zero = float(reading.scale[i]), float(reading.zero[i])
            if what.startswith("velocity"):
                x, zero = contents.of_velocity(m.column, i), 0.0
                if x is None or abs(x.factor / (m.scale * factor) - 1.0) > KNOWN_TO:
                    factor = float(np.sign(factor))
            why = f"{m.why}; {', '.join(words[i])}, by the efforts"
            m = replace(
                m, scale=m.scale * factor, offset=m.offset * factor + zero, why=why
            )
        out.append(m)
    return out


def _tared(contents: Contents, matches, said) -> list[Match]:
    """With the offsets that were taken from efforts: these are 0 where the log begins,
    or on average, and what the joints need is not."""
    efforts = _columns_of(contents, matches, _DRIVES)
    of = {m.column: m for m in matches}
    raw = {i: contents.raw(name) for i, name in efforts.items() if contents.moves(i)}
    raw = {i: y for i, y in raw.items() if len(y)}
    first = [min(abs(y[0]), abs(np.mean(y[:5]))) for y in raw.values()]
    sizes = [WEIGHS * np.std(y) for y in raw.values()]
    starts = np.less(first, sizes)
    means = np.less([abs(np.mean(y)) / WEIGHS for y in raw.values()], sizes)
    if max(starts.sum(), means.sum()) < 0.8 * max(len(raw), 1):
        return matches
    needed, off = contents.needed, {}
    for i in raw:
        m, told = of[efforts[i]], contents.told(efforts[i], i)
        if told.left < 1.0 - EXPLAINS:
            off[i] = told.bias - told.factor * m.offset / m.scale
    size = np.maximum(np.sqrt(np.mean(needed**2, axis=0)), 1e-300)[list(off)]
    share = np.array(list(off.values())) / size
    # A servo that sets out from where it was told to be begins at 0, too: then what is
    # needed there, or on average, is not missing afterwards.
    taken = needed[0] if starts.sum() >= means.sum() else needed.mean(axis=0)
    missing = np.linalg.norm(share - taken[list(off)] / size)
    if (
        2 * len(off) < len(raw)
        or np.abs(share).max(initial=0.0) < WEIGHS
        or missing > 0.5 * np.linalg.norm(share)
    ):
        return matches
    which = ", ".join(efforts[i] for i in off)
    says = (
        f"{which} begin at 0, or are 0 on average, while the weight is not: an offset "
        "was taken from them (tared). Taken with what the model's weight needs there: "
        f"plus {', '.join(f'{x:.4g}' for x in off.values())}; a load that the model "
        "lacks hides in that."
    )
    said.append(Said(TARED, contents.joints[next(iter(off))].name, len(off), says))
    back = {efforts[i]: x for i, x in off.items()}
    return [
        replace(m, offset=m.offset + back[m.column],
                why=f"{m.why}; plus what was taken from it")
        if m.column in back and m.channel else m for m in matches
    ]  # fmt: skip


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


def _without_parts(contents: Contents, matches, said) -> list[Match]:
    """Without commanded efforts where measured ones go with the motion far better, as
    where the commands are only a part of what a drive's own loop asks for."""
    each = [_columns_of(contents, matches, [what]) for what in _DRIVES]
    there = [i for i in each[0] if i in each[1] and contents.moves(i)]
    if not there:
        return matches
    left = [np.median([contents.told(own[i], i).left for i in there]) for own in each]
    if not CLEARER * max(left[1], TOLD_WELL) < left[0] or left[1] > 1.0 - EXPLAINS:
        return matches
    names = [own[there[0]] for own in each]
    says = (
        f"Commanded efforts ({names[0]}) leave {left[0]:.0%} of what the model needs "
        f"for the motion, measured ones ({names[1]}) {left[1]:.0%}: these are taken "
        "for what drives the joints."
    )
    said.append(Said("no_content", contents.joints[there[0]].name, left[0], says))
    why = f"effort_command: it leaves {left[0]:.0%} of what the joints need"
    gone = {*each[0].values()}
    return [replace(m, channel=None, why=why) if m.column in gone else m
            for m in matches]  # fmt: skip


def _share(contents: Contents, column: str, i: int) -> float:
    return 1.0 - contents.told(column, i).left


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
        for i, (k, x) in found.items():
            # Where next to nothing is needed, friction tells the sign: it never drives.
            told, own = contents.told(out[k].column, i), factors.get(i, (1.0, ""))
            clear = x.explained < EXPLAINS and told.left < 1.0 - EXPLAINS
            clear &= told.other > CLEARER * told.left and told.rubs > NOTHING
            if clear and told.factor * out[k].scale * own[0] < 0.0:
                factors[i] = (-own[0], own[1])
        factors = {
            i: (factor, ", and ".join(filter(None, (word, sign))))
            for i, (factor, word) in factors.items()
            if (sign := _OTHER_SIGN if factor < 0.0 else "") or word
        }
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
    left = {i: 1.0 - contents.told(name, i).left
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
    do: all begin at 0, and with other zeros the efforts go with the motion better."""
    efforts = _columns_of(contents, matches, _DRIVES)
    moving = [i for i in range(len(contents.joints)) if contents.moves(i)]
    if len(moving) < 2 or not (np.abs(contents.first[moving]) < AT_ZERO).all():
        return
    if efforts and _other_zeros_fit(contents, efforts):
        says = (
            "All positions begin at 0, and the efforts are not those that the model "
            "needs from there: do they count from where the log, or the robot, was "
            "started? Then give each its offset in the sidecar."
        )
        said.append(Said(FROM_A_START, contents.joints[moving[0]].name, 0.0, says))


def _other_zeros_fit(contents: Contents, efforts: Mapping[int, str]) -> bool:
    """Whether some zeros of the joints that turn, tried one joint after another all
    round, leave several times less of the efforts."""
    few = contents.fewer(FEW)
    first = least = _misfit(few, efforts)
    if first < np.log(TOLD_WELL):
        return False
    turn = [i for i, joint in enumerate(few.joints) if not joint.prismatic]
    for step in ZERO_STEPS:
        around = step * np.arange(-ZEROS, ZEROS + 1)
        for i in turn:
            best = few.reading
            for reading in [best.turned(i, float(angle)) for angle in around]:
                few.read(reading)
                if (left := _misfit(few, efforts)) < least:
                    best, least = reading, left
            few.read(best)
    return least < first - np.log(CLEARER)


def _late(contents: Contents, matches, said) -> None:
    """Says where efforts are measured, or stamped, after they have acted. (Before it,
    they may be commands that come through late, which a search names.) Of a slow robot
    that looks like friction that drives: friction has its sign here."""
    efforts = _columns_of(contents, matches, _DRIVES)
    few = contents.fewer(MOST_LATE)

    def left(late: float) -> float:
        few.late = late
        each = [few.told(name, i).left for i, name in efforts.items()]
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
    sizes = (replace(x, factor=abs(x.factor)) for x in known.values())
    if len(rated) > 1 and all(rated.values()) and any(map(_is_odd, sizes)):
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
        alike = within > 0.0 and (len(known) > 1 or abs(middle) > GAINS[1])
    hints = {
        i: x for i, (_, x) in found.items()
        if i not in known and x.explained > NOTHING and SIGMAS * x.std < abs(x.factor)
    }  # fmt: skip
    if (
        alike
        and not GAINS[0] < middle < GAINS[1]
        and any(
            abs(x.factor - middle) > max(ALIKE * abs(middle), SIGMAS * x.std)
            for x in hints.values()
        )
    ):  # Of each joint its own, as far as it tells.
        own = {i: _in_words(x.factor, x.std) for i, x in (known | hints).items()}
        return {i: own.get(i, (1.0, _UNTOLD)) for i in found}
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
    if len(every) > 1 and all(x.factor < 0.0 for x in every.values()):
        odd = dict.fromkeys(found, -1.0) | odd  # One convention has all their signs.
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
        off = abs(abs(factor) / (part * joint.effort) - 1.0)
        if off < ALIKE and all(abs(abs(factor) / x - 1.0) > off for x, _ in _UNITS):
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
    if (np.abs(factors - middle) < room).all():
        return middle, within
    for unit, _ in _UNITS:  # What most are in, others are, but for a gain.
        share = np.abs(factors) / unit
        most = 2 * int((np.abs(share - 1.0) < ALIKE).sum()) >= max(len(share), 3)
        if most and ((share > GAINS[0]) & (share < GAINS[1])).all():
            return float(np.sign(np.median(factors))) * unit, ALIKE / 6.0 * unit
    return middle, 0.0


def _not_a_rotor(contents: Contents, name: str, i: int, factor: float) -> bool:
    """Whether a factor stays where a rotor's inertia is free: what an effort is too
    large by may turn one that the model lacks."""
    x = contents.of_effort(name, i, rotor=True)
    return (
        x is not None and x.std < KNOWN_TO * abs(x.factor)
        and abs(x.factor / factor - 1.0) < KNOWN_TO
    )  # fmt: skip


def _in_words(factor: float, std: float) -> tuple[float, str]:
    """A factor, as round as it may be, and what its size looks like."""
    size, sign = abs(factor), float(np.sign(factor))
    if GAINS[0] < size < GAINS[1]:
        return sign, ""
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
    return sign * size, word


def _round(x: float, within: float) -> float:
    """The number of fewest digits that is so near."""
    for digits in range(1, 8):
        y = float(f"{x:.{digits - 1}e}")
        if abs(y - x) <= within:
            return y
    return x


def left_by(plant, joints, columns, matches: Sequence[Match]) -> dict[str, float]:
    """{joint: logarithm of the share of what it needs that its effort leaves}, as of
    by_content; none where nothing tells."""
    try:
        contents = Contents(plant, joints, columns, matches).fewer(FEW)
    except ValueError:
        return {}
    efforts = _columns_of(contents, matches, _DRIVES)
    efforts = {i: name for i, name in efforts.items() if contents.moves(i)}
    return {joints[i].name: x for i, x in _logs_left(contents, efforts).items()}


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
    plant: MultibodyPlant, recordings: Sequence[Recording], pushes: bool = False
) -> list[Finding]:
    """What channels' contents say against their names: until that is put right, an
    effect would only make up for it. pushes: whether links push each other, or what
    is fixed, so that efforts are other than the motion alone needs: of them nothing is
    sure then."""
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
            if pushes and ".effort_" in each.channel:
                severity = "warning"
            found.append(
                Finding(each.kind, r.name, each.channel, each.size, "", severity, says)
            )
    return found
