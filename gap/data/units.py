"""What columns count in: of all readings of a joint's columns, the nearest at hand.

A reading is a unit and an offset of the position, and a unit and a sign of the
velocity. A name says a unit, limits hold a position, jumps by a turn show what a turn
is, and a velocity is a position's rate: a reading pays for what it contradicts, and for
units that few loggers write. All joints that turn, or slide, have one reading, but
those that contradict it by themselves. A command is read as what follows its position.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.data.arrays import words_of
from makebreak.gap.data.bags import MotorRange
from makebreak.gap.data.match import AS_SAID, JointName, Match, plain_name
from makebreak.gap.data.turns import TURN, without_turns

DEG = np.pi / 180.0
BY_SIZE = "its size"
FULL_RANGE = 100.5  # Per cent, from one end of a joint's range, or from its middle.
_POSITIONS = ("position", "position_command")
_ALIKE = 0.1  # Of a rate to a velocity that goes with it; a standard deviation:
_NEAR = 0.03
# What a reading pays: for a rate, a jump, a limit or a name that it contradicts; for a
# position that counts from elsewhere; for another unit of time.
_RATE, _JUMP, _BEYOND, _NAME, _OFFSET, _TIME = 5.0, 3.0, 4.0, 3.0, 1.0, 4.0
_UNLIKE = 0.1  # Of a velocity that is not in its position's unit per second.
_OF_ITS_OWN = 2.0  # A joint pays so much less by another reading than the others'.
# [rad] Of a joint without limits; the part of its range by which one that comes back is
# off at the end at most; what that one pays, alone too little for another reading.
_LARGE, _BACK, _UNLIMITED = 20.0, 0.8, 2.5
_ROOM = 0.1  # Of a joint's range, beyond it.


@dataclass(frozen=True)
class Unit:
    """factor: to SI. cost: how few loggers write it; of RARE and more a rate, a jump or
    a name must say it. zero: where else it may count from, in this unit."""

    name: str
    factor: float
    cost: float = 0.0
    zero: float = 0.0


_RARE = 2.0
_STEPS = [Unit(f"steps of 2^{bits} in a turn", TURN / 2.0**bits, 3.0, 2.0 ** (bits - 1))
          for bits in range(9, 25)]  # fmt: skip
TURNING = [
    Unit("rad", 1.0), Unit("degrees", DEG, 1.0), Unit("mrad", 1e-3, 2.0),
    Unit("tenths of a degree", 0.1 * DEG, 3.0),
    Unit("hundredths of a degree", 0.01 * DEG, 3.0),
    Unit("mdeg", 1e-3 * DEG, 3.0), Unit("turns", TURN, 3.0), *_STEPS,
]  # fmt: skip
SLIDING = [Unit("m", 1.0), Unit("mm", 1e-3, 1.0), Unit("cm", 1e-2, 2.0),
           Unit("um", 1e-6, 3.0)]  # fmt: skip
RATES = [Unit("rad/s", 1.0), Unit("deg/s", DEG, 1.0), Unit("rpm", TURN / 60.0, 1.0),
         Unit("turns/s", TURN, 1.0)]  # fmt: skip
SPEEDS = [Unit("m/s", 1.0), Unit("mm/s", 1e-3, 1.0), Unit("cm/s", 1e-2, 2.0)]
_TIMES = (*(10.0**k for k in range(-6, 7)), 60.0, 3600.0, 86400.0)


# ----- Units in names


# A factor to SI of what stands at a name's end.
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6,
            "\u00b5m": 1e-6, "\u03bcm": 1e-6}  # fmt: skip
DEGREES = ("deg", "degree", "degrees", "grad")  # The last one is German.
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "°": DEG, "mdeg": 1e-3 * DEG, "rev": TURN,
           **dict.fromkeys(DEGREES, DEG)}  # fmt: skip
_SPIN = {"rpm": TURN / 60.0, "degps": DEG, "dps": DEG, "radps": 1.0,
         "1/min": TURN / 60.0, "rev/min": TURN / 60.0}  # fmt: skip
_FORCES = {"n": 1.0, "kn": 1e3, "mn": 1e-3, "megan": 1e6}
_TORQUES = {"nm": 1.0, "n.m": 1.0, "ncm": 1e-2, "nmm": 1e-3, "mnm": 1e-3, "knm": 1e3,
            "meganm": 1e6}  # fmt: skip
# Of an effort these need a number that the log does not have.
_NO_EFFORT = ("%", "a", "ma", "percent", "permille", "promille", "‰")
# These may be anything, such as a part of a joint's name, if not in brackets.
_IN_BRACKETS = ("rev", "ma")


def quantity_of_unit(name: str) -> str | None:
    """What the unit at a name's end tells of its quantity."""
    unit = _unit_said(name, "")
    if unit in _ANGLES or unit in _LENGTHS:
        return "position"
    if unit in _TORQUES:
        return "effort"
    if unit in _FORCES:
        return "force"
    per_sec = [f"{u}{end}" for u in (*_ANGLES, *_LENGTHS) for end in ("/s", "/sec")]
    return "velocity" if unit in _SPIN or unit in per_sec else None


def _unit_said(name: str, joint: str) -> str:
    """What stands in brackets at a name's end, or after its last underscore or space,
    in lower case (MN and MNm: megan, meganm); "" if that is none, or a word of the
    joint's own name."""
    own = words_of(joint.rsplit(".", 1)[-1])
    inside = re.search(r"[\[({<]\s*([^\[\](){}<>]+?)\s*[\])}>]\s*$", name)
    if inside:
        unit = re.sub(r"[\s*·]", "", re.sub(r"^MN", "megan", inside.group(1)).lower())
        return "" if unit in own else unit
    low = re.sub(r"_(per_)?s(ec)?$", "/s", name.strip().lower())
    last = re.split(r"[_\s]", low)[-1]
    return "" if last in own or last in _IN_BRACKETS or len(last) == 1 else last


def unit_in_name(match: Match, joint: JointName) -> tuple[str, float | None]:
    """The unit that a column's name has, and its factor to SI; None: without another
    number it has none. "" where the name says no unit of this quantity."""
    unit = _unit_said(match.column, joint.name)
    what = str(match.channel).rsplit(".", 1)[-1].split("_")[0]
    if what == "effort":
        known = _FORCES if joint.prismatic else _TORQUES
        if unit in _NO_EFFORT:
            return unit, None
        return (unit, known[unit]) if unit in known else ("", 1.0)
    known = dict(_LENGTHS if joint.prismatic else _ANGLES)
    if what == "velocity":
        known = {f"{u}{end}": f for u, f in known.items() for end in ("/s", "/sec")}
        known |= {} if joint.prismatic else _SPIN
    if unit in known:
        return unit, known[unit]
    words = [] if joint.prismatic else words_of(match.column)
    inside = {"rad": 1.0, **dict.fromkeys(DEGREES, DEG)}
    inside |= _SPIN if what == "velocity" else {}
    own = words_of(joint.name.rsplit(".", 1)[-1])
    word = next((w for w in words if w in inside and w not in own), "")
    return word, inside.get(word, 1.0)


# ----- What columns are to each other


def rate_ratio(t: np.ndarray, q: np.ndarray, v: np.ndarray) -> float | None:
    """What the rate of q is, times v, all (n,); None where the two do not go
    together."""
    rows = np.isfinite(t) & np.isfinite(q)
    v = v[rows] if np.isfinite(v[rows]).all() else _between(t, v, rows)
    t, q = t[rows], q[rows]
    forward = np.diff(t, prepend=-np.inf) > 0.0
    t, q, v = t[forward], q[forward], v[forward]
    if len(t) < 50 or not np.isfinite(v).all():
        return None
    # Means over a few rows: differences of single ones are mostly noise.
    n = max(len(t) // 2000, 5)
    mean, step = (np.cumsum(v)[n:] - np.cumsum(v)[:-n]) / n, t[n:] - t[:-n]
    whole = (step > 0.0) & (step < 3.0 * np.median(step))  # Not over a pause.
    return _ratio(((q[n:] - q[:-n]) / step)[whole], mean[whole])


def _between(t, y, rows) -> np.ndarray:
    """y, which may be on rows of its own, at other rows."""
    there = np.isfinite(y) & np.isfinite(t)
    if there.sum() < 20:
        return np.full(int(rows.sum()), np.nan)
    return np.interp(t[rows], t[there], y[there])


def _ratio(y: np.ndarray, x: np.ndarray) -> float | None:
    """Of y to x (n,) where they go together; of either's noise half."""
    if len(y) < 20 or not (y.std() > 0.0 and x.std() > 0.0):
        return None
    if abs(np.corrcoef(y, x)[0, 1]) < 0.7:
        return None
    return float(np.sign(np.mean((y - y.mean()) * (x - x.mean()))) * y.std() / x.std())


def unit_of_rate(ratio: float, prismatic: bool = False) -> Unit | None:
    """The unit that a velocity is in whose position's rate is so many times it, of
    either sign."""
    units = [SPEEDS, RATES][not prismatic]
    fits = [u for u in units if abs(np.log(abs(ratio) / u.factor)) < _ALIKE]
    return fits[0] if fits else None


# ----- Readings


@dataclass(frozen=True)
class _Reading:
    """Of a joint. q, v: units; offset: added to the position in SI; sign: of the
    velocity; off: logarithm of its rate over its velocity; cost: all that it pays."""

    q: Unit
    v: Unit
    offset: float
    sign: float
    off: float
    cost: float

    @property
    def units(self) -> tuple[float, float]:
        return self.q.factor, self.v.factor


class _Columns:
    """A joint's columns. q: the match of its position, v: of its velocity, or None.
    free: whether nothing drives it and something drives others."""

    def __init__(
        self, joint: JointName, q: Match, v: Match | None, columns, time, free: bool
    ):
        self.joint, self.q, self.v, self.free = joint, q, v, free
        self.values, self.jump = _unwound(columns[q.column], joint.prismatic)
        self.ratio = None
        if v is not None and time is not None:
            t = time.scale * columns[time.column]
            self.ratio = rate_ratio(t, self.values, columns[v.column])
        self.named = [_named(m, joint) for m in (q, v)]

    def readings(self, tick: float) -> Iterator[_Reading]:
        """tick: times as long as the column of time says [s/s]."""
        name_q, name_v = self.named
        rates = SPEEDS if self.joint.prismatic else RATES
        units = SLIDING if self.joint.prismatic else TURNING
        for q in [replace(name_q, cost=0.0)] if name_q else units:
            offset, beyond = self._offset(q)
            if self.jump not in (None, q.factor):
                beyond += _JUMP
            own = Unit(f"{q.name} per second", q.factor)
            known = {u.factor: u for u in (*rates, own, *([name_v] if name_v else []))}
            for v in known.values():
                is_named = name_v is not None and v.factor == name_v.factor
                cost = q.cost + beyond + (0.0 if is_named else v.cost)
                cost += 0.0 if is_named or name_v is None else _NAME
                cost += 0.0 if v is own else _UNLIKE
                off, sign = 0.0, 1.0
                if self.ratio is not None:
                    sign = float(np.sign(self.ratio))
                    off = float(np.log(q.factor * abs(self.ratio) / v.factor / tick))
                    near = 0.5 * (off / _NEAR) ** 2
                    cost += near if abs(off) < _ALIKE else _RATE
                elif name_v is None and v.factor not in (1.0, q.factor):
                    continue
                told = self.ratio is not None and abs(off) < _ALIKE and v is not own
                if q.cost < _RARE or told or self.jump == q.factor:
                    yield _Reading(q, v, offset, sign, off, cost)

    def _offset(self, unit: Unit) -> tuple[float, float]:
        """What to add to the position in SI, and what that and its size cost."""
        q = unit.factor * self.values
        low, high = float(np.nanmin(q)), float(np.nanmax(q))
        j = self.joint
        if not np.isfinite(j.upper - j.lower):
            # A wheel goes on and on, in rad; an arm comes back, and what swings freely
            # may turn over and back.
            large = max(abs(low), abs(high)) > _LARGE and not j.prismatic
            large &= not self.free
            there = q[np.isfinite(q)]
            back = abs(there[-1] - there[0]) < _BACK * (high - low)
            return 0.0, _UNLIMITED if large and back else 0.0
        room = _ROOM * (j.upper - j.lower)
        middle = 0.5 * (j.lower + j.upper)

        def fits(offset: float) -> bool:
            return j.lower - room < low + offset and high + offset < j.upper + room

        zero = -unit.zero * unit.factor
        if zero and low >= 0.0 and fits(zero):  # No joint is on one side alone.
            return zero, 0.0
        if fits(0.0):
            return 0.0, 0.0
        turn = TURN * np.rint((0.5 * (low + high) - middle) / TURN)
        turn = 0.0 if j.prismatic else float(turn)
        for offset in (zero, zero - TURN, zero + TURN, -turn):
            if offset and fits(offset):
                return offset, _OFFSET
        quarters = () if j.prismatic else (-0.5, -0.25, 0.25, 0.5)
        if any(fits(TURN * k) for k in quarters):  # Content tells whether it is so.
            return 0.0, 1.5 * _OFFSET
        beyond = max(abs(low), abs(high)) / max(abs(j.lower), abs(j.upper), 1e-9)
        return 0.0, 0.7 if beyond < (1.3 if unit.cost else 2.0) else _BEYOND


def _named(match: Match | None, joint: JointName) -> Unit | None:
    if match is None or match.channel == match.column:
        return None
    if match.why == AS_SAID:
        return Unit("", match.scale)
    name, factor = unit_in_name(match, joint)
    return Unit(name, float(factor)) if name and factor else None


def _unwound(y: np.ndarray, prismatic: bool) -> tuple[np.ndarray, float | None]:
    """A position without jumps by a turn, and the factor of the unit in which they are
    one; None without such jumps."""
    steps = np.abs(np.diff(y[np.isfinite(y)]))
    for unit in TURNING if not prismatic else ():
        if steps.max(initial=0.0) * unit.factor > 0.9 * TURN:
            back, n = without_turns(y, TURN / unit.factor)
            if n:
                return back, unit.factor
    return y, None


def in_units(
    columns: Mapping[str, np.ndarray],
    joints: Sequence[JointName],
    matches: Mapping[str, Match],
    ranges: Mapping[str, MotorRange] | None = None,
) -> dict[str, Match]:
    """Matches {column: match} with the scales and offsets of positions, velocities and
    time, and what told them; efforts with the units in their names. What a sidecar says
    stays."""
    out, of = dict(matches), {joint.name: joint for joint in joints}
    for name, m in matches.items():
        joint = of.get(m.channel.rpartition(".")[0]) if m.channel else None
        unit = None if joint is None else _named(m, joint)
        if unit is not None and unit.name:
            why = f"{m.why}; in {unit.name}, by its name"
            out[name] = replace(m, scale=unit.factor, why=why)
    in_range = _of_ranges(out, columns, of, ranges or {})
    channel = {m.channel: m for m in (out | in_range).values() if m.channel}
    time = channel.get("time")
    driven = {at for at, _, what in (name.rpartition(".") for name in channel)
              if what.endswith("_command") or what.startswith("effort")}  # fmt: skip
    groups: dict[bool, list[_Columns]] = {False: [], True: []}
    for joint in joints:
        q = channel.get(f"{joint.name}.position")
        if q is not None and q.column not in in_range and _is_there(columns[q.column]):
            v = channel.get(f"{joint.name}.velocity")
            free = bool(driven) and joint.name not in driven
            groups[joint.prismatic].append(_Columns(joint, q, v, columns, time, free))
    chosen, tick = _chosen(groups, time)
    if time is not None and tick != 1.0:
        scale = time.scale * tick
        says = f"in units of {scale:.6g} s, by positions and velocities"
        out[time.column] = _told(time, scale, 0.0, [says])
    for each, reading in chosen:
        out[each.q.column] = _position(each, reading)
        if each.v is not None:
            out[each.v.column] = _velocity(each, each.v, reading)
    out |= in_range
    for name, m in out.items():
        at, _, what = (m.channel or "").rpartition(".")
        if what in ("position_command", "velocity_command") and at in of:
            like = channel.get(f"{at}.{what.removesuffix('_command')}")
            if like is not None and name not in in_range and _is_there(columns[name]):
                out[name] = _command(m, out[like.column], of[at], columns)
    return out


def said_of_units(matches: Iterable[Match]) -> list[tuple[str, str, float, str]]:
    """(kind, channel, scale, sentence) of what is told of units, once for each."""
    found: dict[tuple[str, str], list[Match]] = {}
    for m in matches:
        if m.told and m.channel:
            found.setdefault((_kind(m), m.told), []).append(m)
    return [
        (kind, str(mine[0].channel), mine[0].scale,
         f"{', '.join(m.column for m in mine)} {'are' if mine[1:] else 'is'} {told}.")
        for (kind, told), mine in found.items()
    ]  # fmt: skip


def _kind(m: Match) -> str:
    return {1.0: "position_turns", -1.0: "sign"}.get(m.scale, "units")


def _is_there(y: np.ndarray) -> bool:
    return bool(np.isfinite(y).any())


def _chosen(groups, time: Match | None):
    """[(a joint's columns, its reading)], and how many times longer time is than its
    column says."""

    def read(tick: float):
        found, total = [], 0.0
        for group in groups.values():
            each = [(c, list(c.readings(tick))) for c in group]
            pairs = {r.units for _, own in each for r in own}
            costs = {
                pair: sum(min([r.cost for r in own if r.units == pair]
                              + [min(r.cost for r in own) + _OF_ITS_OWN])
                          for _, own in each)
                for pair in pairs
            }  # fmt: skip
            best = min(costs, key=lambda pair: costs[pair], default=None)
            for c, own in each:
                alone = min(own, key=lambda r: r.cost)
                with_all = min((r for r in own if r.units == best),
                               key=lambda r: r.cost, default=None)  # fmt: skip
                if with_all is None or alone.cost + _OF_ITS_OWN <= with_all.cost:
                    with_all = alone
                total += with_all.cost
                found.append((c, with_all))
        return found, total

    found, total = read(1.0)
    told = [c for c, _ in found if c.ratio is not None]
    if time is None or time.why == AS_SAID or not told or total < _TIME:
        return found, 1.0
    # Of one joint alone, anything may be wrong.
    other = {tick: read(tick) for tick in (_TIMES if len(told) > 1 else (1e-3, 1e3))}
    tick = min(other, key=lambda k: other[k][1])
    return (other[tick][0], tick) if other[tick][1] + _TIME < total else (found, 1.0)


def _position(each: _Columns, r: _Reading) -> Match:
    says = []
    if each.named[0] is None and r.q.factor != 1.0:
        by = "its jumps" if each.jump == r.q.factor else BY_SIZE
        by = "the velocities" if r.q.cost >= _RARE and each.ratio else by
        says = [f"in {r.q.name}, by {by}"]
    if r.offset and r.offset == -r.q.zero * r.q.factor:
        says.append(f"counted from {r.q.zero:g}, by the joint's limits")
    elif r.offset:
        says.append(f"a turn off ({r.offset / TURN:+.3g}), by the joint's limits")
    return _told(each.q, r.q.factor, r.offset, says)


def _velocity(each: _Columns, m: Match, r: _Reading) -> Match:
    named, sure = each.named[1], each.ratio is not None and abs(r.off) < _ALIKE
    if not (sure or named or r.v.factor == r.q.factor):
        return m
    says, sign = [], r.sign if sure else 1.0
    if r.v.factor != (named.factor if named else 1.0):
        but = ", not as its name says" if named else ""
        says = [f"in {r.v.name}, by its position's derivative{but}"]
    if sign < 0.0:
        says.append("of the other sign than its position's derivative")
    return _told(m, sign * r.v.factor, 0.0, says)


def _told(m: Match, scale: float, offset: float, says: Sequence[str]) -> Match:
    if m.why == AS_SAID:
        return m
    return replace(m, scale=scale, offset=offset, why="; ".join([m.why, *says]),
                   told="; ".join(says))  # fmt: skip


def _command(m: Match, like: Match, joint: JointName, columns) -> Match:
    """A command in the unit in which it follows what it commands; without that, in the
    same."""
    units = [RATES, TURNING, SPEEDS, SLIDING][
        ("position" in str(m.channel)) + 2 * joint.prismatic
    ]
    y, x = like.scale * columns[like.column], columns[m.column]
    rows, same = np.isfinite(y), abs(like.scale)
    x = _between(np.arange(len(x), dtype=float), x, rows)
    ratio = abs((_ratio(y[rows], x) if np.isfinite(x).all() else None) or same)
    named = _named(m, joint)
    fits = [u for u in units if abs(np.log(ratio / u.factor)) < 2.0 * _ALIKE]
    if named is None and abs(np.log(ratio / same)) > 2.0 * _ALIKE and fits:
        return _told(m, fits[0].factor, 0.0, [f"in {fits[0].name}, as what follows it"])
    scale = same if named is None else named.factor
    offset = like.offset if abs(np.log(scale / same)) < 1e-6 else 0.0
    says = [f"as {like.column}"] if named is None and like.told else []
    return replace(_told(m, scale, offset, says), told="")


def _of_ranges(found, columns, of, ranges) -> dict[str, Match]:
    """Positions in per cent of joints' ranges (LeRobot: -100 to 100, a gripper's 0 to
    100): by the arm's calibration, or where they would be far beyond the limits in
    degrees. The middle of a range is that of the limits."""
    mine = {}
    for name, m in found.items():
        at, _, what = (m.channel or "").rpartition(".")
        joint = of.get(at)
        if what not in _POSITIONS or joint is None or m.channel == name:
            continue
        if np.isfinite(joint.upper - joint.lower) and not joint.prismatic:
            if _is_there(columns[name]) and _named(m, joint) is None:
                mine[name] = joint
    size = {name: float(np.nanmax(np.abs(columns[name]))) for name in mine}
    if not size or not TURN < max(size.values()) <= FULL_RANGE:
        return {}
    far = [n for n, j in mine.items()
           if DEG * size[n] > 1.25 * max(abs(j.lower), abs(j.upper))]  # fmt: skip
    plain = {plain_name(motor): own for motor, own in ranges.items()}
    out = {}
    for name, joint in mine.items():
        own = next((x for motor, x in plain.items() if motor in plain_name(name)), None)
        if own is None and not far:
            continue
        half = own.half if own is not None else 0.5 * (joint.upper - joint.lower)
        sign = -1.0 if own is not None and own.reversed else 1.0
        from_end = "gripper" in words_of(name) and np.nanmin(columns[name]) > -0.5
        middle = 0.5 * (joint.lower + joint.upper)
        scale = sign * half * (2.0 if from_end else 1.0) / 100.0
        offset = (joint.lower if sign > 0.0 else joint.upper) if from_end else middle
        by = "its calibration" if own is not None else "its limits"
        says = f"per cent of its range, by {by}"
        out[name] = replace(found[name], scale=scale, offset=offset,
                            why=f"{found[name].why}; {says}", told=says)  # fmt: skip
    return out
