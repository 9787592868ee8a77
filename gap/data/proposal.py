"""From foreign columns to channels: what each may be, in which unit, of which joint.

A proposal to be corrected, not a decision: names are matched by words and numbers,
units by the joints' limits and by how a velocity relates to its position's derivative.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import yaml

from makebreak.gap.data.arrays import TIME_WORDS, words_of
from makebreak.gap.data.bags import MotorRange
from makebreak.gap.data.csv_table import is_nameless
from makebreak.gap.data.table import COMMANDS, is_channel

DEG = np.pi / 180.0
UNKNOWN_JOINT = "of an unknown joint"  # Why such a column is left out.
IN_DEGREES = "in degrees, by its name or its size"
FULL_RANGE = 100.5  # Per cent, from one end of a joint's range, or from its middle.
# Times its limit that a joint would be at, were it in degrees.
_BEYOND = 1.25
BY_DERIVATIVE = "against the position's derivative"
AS_SAID = "as the recording's sidecar says"
_COMMAND = set(
    "cmd command commands commanded target desired des ref reference goal goals "
    "setpoint action sp control".split()
)
_WORDS = {
    "acceleration": set("acc acceleration accelerations ddq qdd accel".split()),
    "current": set("current currents amp amps ampere".split()),
    "effort": set("effort efforts eff torque torques tau trq moment moments u".split()),
    "force": set("force forces thrust".split()),
    "velocity": set(
        "velocity velocities vel vels dq qd qdot speed speeds omega velo v".split()
    ),
    "position": set(
        "position positions pos q qpos angle angles theta phi deg rad state states "
        "joint joints encoder action".split()
    ),
}
CURRENT = "a current"  # Why such a column is left out begins so.
# Of a joint that slides a force is its effort; else it is a wrench's, or nobody's.
_FORCE, _FORCE_COMMAND = "force", "force_command"
_OF_A_SLIDE = {_FORCE: "effort_measured", _FORCE_COMMAND: "effort_command"}
_NEVER = set(
    "temperature temperatures temp temps voltage voltages volt volts status error "
    "errors err errs mode flag id seq min max limit limits lower upper minimum "
    "maximum".split()
)
# Of an effort: a part of it, or what a model makes of it, and not what drives a joint.
_PART = set(
    "external ext gravity grav coriolis friction ff feedforward disturbance residual "
    "contact".split()
)
_BESIDE = set("motor raw unfiltered".split())  # Another column is rather it.
_EPISODE = set("episode trial run".split())
_TIME_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
# Of a velocity to the derivative of its position: unit, factor to rad/s or m/s.
_RATES = (
    ("", 1.0), ("deg/s", DEG), ("rpm", 2.0 * np.pi / 60.0), ("mm/s", 1e-3),
)  # fmt: skip


# What a column's own name says of its unit, as a factor to SI.
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6,
            "\u00b5m": 1e-6, "\u03bcm": 1e-6}  # fmt: skip
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": DEG, "degree": DEG, "degrees": DEG,
           "°": DEG, "mdeg": 1e-3 * DEG, "rev": 2.0 * np.pi}  # fmt: skip
_SPIN = {"rpm": 2.0 * np.pi / 60.0, "degps": DEG, "dps": DEG, "radps": 1.0,
         "1/min": 2.0 * np.pi / 60.0, "rev/min": 2.0 * np.pi / 60.0}  # fmt: skip
_FORCES = {"n": 1.0, "kn": 1e3, "mn": 1e-3, "megan": 1e6}
_TORQUES = {"nm": 1.0, "n.m": 1.0, "ncm": 1e-2, "nmm": 1e-3, "mnm": 1e-3, "knm": 1e3,
            "meganm": 1e6}  # fmt: skip
# Of an effort these need a number that the log does not have.
_NO_EFFORT = ("%", "a", "ma", "percent", "permille", "‰")
# A joint's name with nothing but these is where it is.
_NOW = set(
    "present actual measured meas act observation obs observed real value".split()
)
# These may be anything, such as a part of a joint's name, if not in brackets.
_IN_BRACKETS = ("rev", "ma")


@dataclass(frozen=True)
class JointName:
    """A joint of the robot. name: `<model>.<joint>`; limits in rad or m."""

    name: str
    prismatic: bool = False
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class Match:
    """What a column is taken for. channel: of a recording, `time`, `episode`, or None:
    it is left out. why: a few words. may: the channel that one that is left out would
    be, were another column not."""

    column: str
    channel: str | None
    scale: float = 1.0
    offset: float = 0.0
    why: str = ""
    may: str = ""


def propose(
    columns: Mapping[str, np.ndarray],
    joints: Sequence[JointName],
    text: Mapping[str, str] | None = None,
    said: Mapping[str, Match] | None = None,
    ranges: Mapping[str, MotorRange] | None = None,
) -> list[Match]:
    """One for each column, in their order.

    Args: columns {name: (n,)}, NaN where nothing is; joints in the robot's order; text:
        {column that holds no numbers: what is in all its cells, or ""}; said: what the
        log's own sidecar says of columns, which stays; ranges: {motor: its range}.
    """
    text, said = text or {}, said or {}
    found = {name: Match(name, None, why="text") for name in text}
    found |= {name: match for name, match in said.items() if name in columns}
    time = find_time(columns)
    if time is not None and "time" not in {m.channel for m in said.values()}:
        found.setdefault(time.column, time)
    quantities = {}
    for name in columns:
        if name in found:
            continue
        if is_channel(name):
            found[name] = Match(name, name, why="has a channel's name already")
            continue
        if set(words_of(name)) & _EPISODE and _counts(columns[name]):
            found[name] = Match(name, "episode", why="counts episodes")
            continue
        quantity = _quantity(name, [j for j in joints if _names(name, j)])
        if quantity is None:
            why = "not a quantity that gap compares"
            if is_nameless(name):
                why = "the file does not name it: say here what it is"
            found[name] = Match(name, None, why=why)
        else:
            quantities[name] = quantity
    listed = _listed(text, joints)
    for name, joint in _joints_of(quantities, joints, listed).items():
        quantity = quantities[name]
        if quantity in _OF_A_SLIDE:
            if joint is None or not joint.prismatic or not _names(name, joint):
                why = "a force, and not by its name that of a joint that slides"
                found[name] = Match(name, None, why=why)
                continue
            quantity = _OF_A_SLIDE[quantity]
        if quantity == CURRENT:
            why = "not a quantity that gap compares"
            if joint is not None:
                why = f"a current: {joint.name}.effort_measured with its N m/A as scale"
            may = f"{joint.name}.effort_measured" if joint is not None else ""
            found[name] = Match(name, None, why=why, may=may)
        elif part := _part_of(name, quantity, joint):
            why = f"{part}: not the whole of what drives a joint"
            may = f"{joint.name}.{quantity}" if joint is not None else ""
            found[name] = Match(name, None, why=why, may=may)
        elif joint is None:
            found[name] = Match(name, None, why=f"{quantity} {UNKNOWN_JOINT}")
        else:
            found[name] = Match(name, f"{joint.name}.{quantity}", why="by its name")
    found = _once(_without_unknown_efforts(found, joints), said)
    found = _in_si(_by_motion(found, columns), columns, joints, ranges or {})
    found |= {name: match for name, match in said.items() if name in found}
    return [found[name] for name in [*columns, *text]]


def said_of(columns: Mapping) -> dict[str, Match]:
    """{column: what a sidecar's `columns` says of it}."""
    found = {}
    for name, target in columns.items():
        own = target if isinstance(target, dict) else {"channel": target}
        found[str(name)] = Match(
            str(name), own.get("channel"), float(own.get("scale", 1.0)),
            float(own.get("offset", 0.0)), AS_SAID,
        )  # fmt: skip
    return found


def of_one_drive(matches: Sequence[Match]) -> list[Match]:
    """With one kind of command alone: efforts before positions, and before velocities;
    measured efforts stand in for commands of effort."""
    kinds = {
        m.channel.rsplit(".", 1)[1] for m in matches if m.channel and "." in m.channel
    }
    keep = next((k for k in ("effort_command", "effort_measured", "position_command",
                             "velocity_command") if k in kinds), None)  # fmt: skip
    out = []
    for match in matches:
        what = (match.channel or "").rsplit(".", 1)[-1]
        pd = keep == "position_command" and what == "velocity_command"
        if what in COMMANDS and what != keep or pd:
            why = f"{what}: {keep} is taken for what drives the joints"
            match = Match(match.column, None, why=why)
        out.append(match)
    return out


def sidecar_text(matches: Sequence[Match], own: Mapping | None = None) -> str:
    """A sidecar with the columns, to be corrected. own: sections of the log's own, of
    which all but the columns are kept."""
    rest = {key: value for key, value in (own or {}).items() if key != "columns"}
    lines = ["# What each column is: a proposal, to be corrected. docs/recordings.md",
             "columns:"]  # fmt: skip
    for match in matches:
        key = _quoted(match.column)
        if match.channel is None:
            target = "null"
        elif match.scale == 1.0 and match.offset == 0.0:
            target = match.channel
        else:
            target = f"{{channel: {match.channel}, scale: {match.scale!r}"
            target += f", offset: {match.offset!r}}}" if match.offset else "}"
        if target == match.column:
            continue
        lines.append(f"  {key}: {target}  # {match.why}")
    if len(lines) == 2:
        lines[1] = "columns: {}"
    kept = yaml.safe_dump(rest, sort_keys=False) if rest else ""
    return "\n".join(lines) + "\n" + kept


def _quoted(name: str) -> str:
    plain = re.fullmatch(r"[A-Za-z_][\w./-]*", name) is not None
    reserved = name.lower() in (
        "y",
        "n",
        "yes",
        "no",
        "on",
        "off",
        "true",
        "false",
        "null",
    )
    return name if plain and not reserved else "'" + name.replace("'", "''") + "'"


# ----- Quantities


def _quantity(name: str, named: Sequence[JointName]) -> str | None:
    """What a column is by its words, and by its unit where it has a joint's name.
    named: joints whose name is in the column's."""
    words = words_of(name)
    if set(words_of(re.sub(r"/\s*min\b", "", name))) & _NEVER - _words_in(named):
        return None
    command = bool(set(words) & _COMMAND)
    kind = next((kind for kind, own in _WORDS.items() if own & set(words)), None)
    if kind == "position":  # A joint's own name may be q1, or have a `joint` in it.
        kind = _quantity_of_unit(name) or kind
    elif kind is None and named and not command:
        kind = _quantity_of_unit(name)
        if kind is None and set(words) <= _words_in(named) | _NOW:
            kind = "position"
    if re.search(r"(^|[^a-z])[qv]_d_?\d*$", name.lower()):  # q_d, as in papers.
        command = True
    if kind is None and command:  # The joint's name says the rest.
        kind = "position"
    if kind is None or kind == "acceleration":
        return None
    if kind == "current":  # Without its gain it is no effort.
        return None if command else CURRENT
    if kind == "effort":
        return "effort_command" if command or "u" in words else "effort_measured"
    if kind == "force":
        return _FORCE_COMMAND if command else _FORCE
    return f"{kind}_command" if command else kind


def says_quantity(word: str) -> bool:
    """Whether a word tells what a column is, or that it is a command."""
    return word in _COMMAND or any(word in own for own in _WORDS.values())


def _words_in(joints: Sequence[JointName]) -> set[str]:
    """Of the names of joints."""
    return {w for joint in joints for w in words_of(joint.name.split(".", 1)[1])}


def _part_of(name: str, quantity: str, joint: JointName | None) -> str:
    """The word of an effort's name that says that it is a part of it."""
    own = _words_in([joint]) if joint is not None and _names(name, joint) else set()
    parts = [w for w in words_of(name) if w in _PART - own]
    return parts[0] if parts and quantity.startswith("effort") else ""


def _quantity_of_unit(name: str) -> str | None:
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


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _names(column: str, joint: JointName) -> bool:
    """Whether a column's name has the joint's in it."""
    return _plain(joint.name.split(".", 1)[1]) in _plain(column)


def _listed(
    text: Mapping[str, str], joints: Sequence[JointName]
) -> dict[int, JointName]:
    """{number of a column: its joint}, where columns of text name the joints: one with
    a list, or one for each number (`name0`, `name1`). Drivers sort joints by name."""
    plain = {_plain(j.name.split(".", 1)[1]): j for j in joints}
    one_each: dict[int, JointName] = {}
    for name, cell in text.items():
        parts = [_plain(part) for part in re.split(r"[\s,;\[\]()'\"]+", cell) if part]
        here = [plain[part] for part in parts if part in plain]
        if len(here) > 1 and len(set(here)) == len(here):
            return {k: plain[p] for k, p in enumerate(parts) if p in plain}
        numbers = re.findall(r"\d+", name)
        if len(here) == len(parts) == 1 and numbers:
            one_each[int(numbers[-1])] = here[0]
    return one_each if len(set(one_each.values())) == len(one_each) else {}


def _joints_of(
    quantities: Mapping[str, str],
    joints: Sequence[JointName],
    listed: Mapping[int, JointName],
) -> dict[str, JointName | None]:
    """By the joint's own name in the column's, or by words of it that no other joint
    has; else by the number in the column's, among the joints that share such words, or
    as columns of text list them."""
    found: dict[str, JointName | None] = {}
    own_words = _own_words(joints)
    plain = {_plain(j.name.split(".", 1)[1]): j for j in joints}
    numbered: dict[tuple[JointName, ...], dict[str, int]] = {}
    for name in quantities:
        own = _plain(name)
        inside = [key for key in plain if key and key in own]
        # joint1 is in joint10: the longest that is there.
        if inside:
            found[name] = plain[max(inside, key=len)]
            continue
        group = _sharing_words(name, own_words) or tuple(joints)
        numbers = re.findall(r"\d+", name)
        if numbers and len(group) > 1:
            numbered.setdefault(group, {})[name] = int(numbers[-1])
        else:
            found[name] = group[0] if len(group) == 1 else None
    for group, of in numbered.items():
        if listed and set(of.values()) <= {*listed}:
            found |= {name: listed[number] for name, number in of.items()}
        else:
            found |= _by_number(of, group, joints)
    return found


def _by_number(
    of: Mapping[str, int], group: Sequence[JointName], joints: Sequence[JointName]
) -> dict[str, JointName | None]:
    """{column: joint of a group}, by the numbers in the columns' names: those of the
    joints' own names where some joints are told by words and all have such a number;
    else counted, from 0 if any does, else from 1."""
    numbers = [re.findall(r"\d+", j.name.split(".", 1)[1]) for j in group]
    own = {int(n[-1]): j for n, j in zip(numbers, group, strict=True) if n}
    if (
        len(group) < len(joints)
        and len(own) == len(group)
        and set(of.values()) <= {*own}
    ):
        return {name: own[number] for name, number in of.items()}
    base = 0 if 0 in of.values() else 1
    places = {name: number - base for name, number in of.items()}
    return {
        name: group[k] if 0 <= k < len(group) else None for name, k in places.items()
    }


def _own_words(joints: Sequence[JointName]) -> list[tuple[JointName, set[str]]]:
    """Of each joint the words of its name that not all joints have, and that are no
    word for a quantity or a command, and no number."""
    common = _COMMAND.union(*_WORDS.values())
    words = [set(words_of(joint.name.split(".", 1)[1])) for joint in joints]
    if len(words) > 1:
        common |= set.intersection(*words)
    return [
        (joint, {w for w in own - common if len(w) > 2 and w.isalpha()})
        for joint, own in zip(joints, words, strict=True)
    ]


def _sharing_words(
    column: str, own: Sequence[tuple[JointName, set[str]]]
) -> tuple[JointName, ...]:
    """The joints of which most words are in a column's name, as shoulder_pan_joint of
    `pan angle`, and all three wrists of `wrist 2 angle`; none if no word is."""
    here = set(words_of(column))
    shared = [(len(words & here), joint) for joint, words in own if words & here]
    most = max((n for n, _ in shared), default=0)
    return tuple(joint for n, joint in shared if n == most)


def _once(found: dict[str, Match], said: Mapping[str, Match]) -> dict[str, Match]:
    """Each channel of one column: what is said, else the first that has it, and those
    of a motor's side or raw after others."""
    taken: set[str | None] = {
        m.channel for m in found.values() if m.channel == m.column
    }
    taken |= {m.channel for m in said.values()}
    out = dict(found)
    for name in sorted(found, key=lambda name: bool(set(words_of(name)) & _BESIDE)):
        match = found[name]
        if name not in said and match.channel not in (None, match.column):
            if match.channel in taken:
                why = f"{match.channel} is another column"
                out[name] = Match(name, None, why=why, may=str(match.channel))
            else:
                taken.add(match.channel)
    return out


# ----- Units


def find_time(columns: Mapping[str, np.ndarray]) -> Match | None:
    """The first column that increases and has a word for time in its name, or a unit of
    it in brackets (in any language), or no name and even steps."""
    for name, value in columns.items():
        words = words_of(name)
        if not (
            set(words) & TIME_WORDS
            or words
            and words[0] in _TIME_UNITS
            or re.search(r"[\[(](ns|us|ms|s|sec)[\])]\s*$", name.lower())
            or is_nameless(name)
            and _is_even(value)
        ):
            continue
        step = np.diff(value[np.isfinite(value)])
        if len(step) < 5 or not np.mean(step >= 0.0) > 0.9:
            continue
        typical = float(np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0
        if not typical > 0.0:
            continue
        said = [u for u in words if u in _TIME_UNITS and u != "s"]
        units = [*said, "s", "ms", "us", "ns"]
        unit = next(
            (u for u in units if 2e-5 < typical * _TIME_UNITS[u] < 0.9), "s"
        )  # fmt: skip
        scale = _TIME_UNITS[unit]
        # Seconds since 1970 keep their digits, nanoseconds do not.
        why = f"increases, {typical * scale * 1e3:.3g} ms a row, taken as {unit}"
        return Match(name, "time", scale, why=why)
    return None


def _is_even(value: np.ndarray) -> bool:
    """Whether nearly all steps are positive and within half of the usual one."""
    step = np.diff(value)
    typical = np.median(step) if len(step) else 0.0
    return bool(np.mean(np.abs(step - typical) < 0.5 * typical) > 0.9)


def _counts(value: np.ndarray) -> bool:
    there = value[np.isfinite(value)]
    return bool(len(there)) and bool((there == np.rint(there)).all())


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


def _scale_said(name: str, channel: str, joint: JointName) -> tuple[str, float | None]:
    """The unit that a column's name has, and its factor to SI; None: without another
    number it has none. "" where the name says no unit of this quantity."""
    unit, prismatic = _unit_said(name, joint.name), joint.prismatic
    what = channel.rsplit(".", 1)[-1].split("_")[0]
    if what == "effort":
        known = _FORCES if prismatic else _TORQUES
        if unit in _NO_EFFORT:
            return unit, None
    else:
        known = _LENGTHS if prismatic else _ANGLES
        if what == "velocity":
            known = {f"{u}{end}": f for u, f in known.items() for end in ("/s", "/sec")}
            known |= {} if prismatic else _SPIN
    return (unit, known[unit]) if unit in known else ("", 1.0)


def _units_said(found: dict[str, Match], joints: Sequence[JointName]):
    """(match, unit, factor) of each column of a joint whose name says a unit;
    _scale_said."""
    of = {joint.name: joint for joint in joints}
    for name, match in found.items():
        joint = of.get((match.channel or "").rsplit(".", 1)[0])
        if joint is None or match.channel is None or match.channel == name:
            continue
        unit, scale = _scale_said(name, match.channel, joint)
        if unit:
            yield match, unit, scale


def _without_unknown_efforts(
    found: dict[str, Match], joints: Sequence[JointName]
) -> dict[str, Match]:
    """Efforts in a unit that says too little are left out; another column of the same
    joint may have them."""
    out = dict(found)
    for match, unit, scale in _units_said(found, joints):
        if scale is None:
            why = f"in {unit}, and of what is not said: give channel and scale"
            may = str(match.channel)
            out[match.column] = Match(match.column, None, why=why, may=may)
    return out


def _in_si(
    found, columns, joints: Sequence[JointName], ranges: Mapping[str, MotorRange]
) -> dict[str, Match]:
    """Scales of positions, of what goes with them, and where names say a unit."""
    of = {joint.name: joint for joint in joints}
    told = {}
    for match, unit, scale in _units_said(found, joints):
        if scale is not None:
            why = f"{match.why}; in {unit}, by its name"
            told[match.column] = replace(match, scale=scale, why=why)
    told |= _of_ranges(found, told, columns, of, ranges)
    rest = {name: match for name, match in found.items() if name not in told}
    out = {**found, **_in_si_by_size(rest, told, columns, of)}
    for name, match in told.items():
        out[name] = _against_position(match, out, columns)
    return out


def _against_position(match: Match, found, columns) -> Match:
    """A velocity whose name says its unit, with the sign that its position's derivative
    has, and with that one's unit if the two contradict each other."""
    at, _, what = (match.channel or "").rpartition(".")
    time = _with_channel(found, "time")
    position = _with_channel(found, f"{at}.position")
    if what != "velocity" or time is None or position is None:
        return match
    ratio = _ratio_to_rate(columns, time, position, match.column) or match.scale
    sign, other = float(np.sign(ratio)), "of the other sign than the position's rate"
    if abs(abs(ratio) / match.scale - 1.0) >= 0.1:
        rate = _rate_of(ratio)
        if rate is None:
            return match
        unit, factor = rate
        why = f"in {unit or 'SI'} against the position's derivative, "
        why += "not as its name says"
        why += f"; {other}" if sign < 0.0 else ""
        return replace(match, scale=sign * factor, why=why)
    if sign < 0.0:
        return replace(match, scale=-match.scale, why=f"{match.why}; {other}")
    return match


def _of_ranges(found, told, columns, of, ranges) -> dict[str, Match]:
    """Positions in per cent of joints' ranges (LeRobot: -100 to 100, a gripper's 0 to
    100): by the arm's calibration, or where they would be far beyond the limits in
    degrees. The middle of a range is that of the limits."""
    mine = {
        name: of[m.channel.rpartition(".")[0]] for name, m in found.items()
        if m.channel and m.channel.endswith((".position", ".position_command"))
        and name not in told and m.channel != name and np.isfinite(columns[name]).any()
        and m.channel.rpartition(".")[0] in of
    }  # fmt: skip
    mine = {n: j for n, j in mine.items()
            if np.isfinite(j.upper - j.lower) and not j.prismatic}  # fmt: skip
    size = {name: float(np.nanmax(np.abs(columns[name]))) for name in mine}
    if not size or not 2.0 * np.pi < max(size.values()) <= FULL_RANGE:
        return {}
    far = [n for n, j in mine.items()
           if DEG * size[n] > _BEYOND * max(abs(j.lower), abs(j.upper))]  # fmt: skip
    plain = {_plain(motor): own for motor, own in ranges.items()}
    out = {}
    for name, joint in mine.items():
        own = next((own for motor, own in plain.items() if motor in _plain(name)), None)
        if own is None and not far:
            continue
        half = own.half if own is not None else 0.5 * (joint.upper - joint.lower)
        sign = -1.0 if own is not None and own.reversed else 1.0
        from_end = "gripper" in words_of(name) and np.nanmin(columns[name]) > -0.5
        middle = 0.5 * (joint.lower + joint.upper)
        scale = sign * half * (2.0 if from_end else 1.0) / 100.0
        offset = (joint.lower if sign > 0.0 else joint.upper) if from_end else middle
        by = "its calibration" if own is not None else "its limits"
        why = f"{found[name].why}; per cent of its range, by {by}"
        out[name] = replace(found[name], scale=scale, offset=offset, why=why)
    return out


def _in_si_by_size(found, told, columns, of) -> dict[str, Match]:
    """Of columns `found`, whose names say no unit. told: the others."""
    out = {**found, **told}
    time = _with_channel(out, "time")
    degrees: dict[str, bool] = {}  # By the way a column is named.
    millimetres: set[str] = set()  # Joints.
    for name, match in found.items():
        if match.channel is None or not match.channel.endswith(
            (".position", ".position_command")
        ):
            continue
        joint = of.get(match.channel.rsplit(".", 1)[0])
        if joint is None:
            continue
        if joint.prismatic:
            if _in_millimetres(columns[name], joint):
                millimetres.add(joint.name)
            continue
        degrees.setdefault(_template(name), False)
        degrees[_template(name)] |= _in_degrees(name, columns[name], joint)
    for name, match in found.items():
        if match.channel is None or name not in columns:
            continue
        at, _, what = match.channel.rpartition(".")
        turns = at in of and not of[at].prismatic
        if turns and "position" in what and degrees.get(_template(name)):
            why = f"{match.why}; {IN_DEGREES}"
            out[name] = Match(name, match.channel, DEG, why=why)
        elif what in ("position", "position_command") and at in millimetres:
            why = "in mm, by its size"
            out[name] = Match(name, match.channel, 1e-3, why=f"{match.why}; {why}")
    for name, match in found.items():
        channel = match.channel or ""
        if not channel.endswith(".velocity") or time is None:
            continue
        position = _with_channel(out, f"{channel[:-9]}.position")
        scale, why = _rate_scale(columns, time, position, name)
        if scale != 1.0:
            out[name] = Match(name, channel, scale, why=f"{match.why}; {why}")
    return out


def _by_motion(found: dict[str, Match], columns) -> dict[str, Match]:
    """qd may be a speed or a command of position: what it goes with tells."""
    out = dict(found)
    for name, match in found.items():
        channel = match.channel or ""
        if "qd" not in words_of(name) or not channel.endswith(".velocity"):
            continue
        at = channel.removesuffix(".velocity")
        position = _with_channel(found, f"{at}.position")
        taken = any(m.channel == f"{at}.position_command" for m in found.values())
        if position is None or taken:
            continue
        q, y = columns[position.column], columns[name]
        good = np.isfinite(q) & np.isfinite(y)
        if good.sum() < 50 or not (np.ptp(q[good]) > 0.0 and np.ptp(y[good]) > 0.0):
            continue
        if np.corrcoef(q[good], y[good])[0, 1] > 0.9:
            why = "it follows the position"
            out[name] = Match(name, f"{at}.position_command", why=why)
    return out


def _template(name: str) -> str:
    return re.sub(r"\d+", "#", name)


def _in_degrees(name: str, value: np.ndarray, joint: JointName) -> bool:
    words = words_of(name)
    if "deg" in words or "degree" in words or "degrees" in words:
        return True
    if "rad" in words or not np.isfinite(value).any():
        return False
    most = float(np.nanmax(np.abs(value)))
    limit = max(abs(joint.lower), abs(joint.upper))
    if np.isfinite(limit):
        # From 0 to 360, where the joint counts from -180.
        reach = most if np.nanmin(value) < 0.0 or most > 361.0 else 0.5 * most
        return most > 2.0 * limit and DEG * reach < 1.3 * limit
    return most > 20.0


def _in_millimetres(value: np.ndarray, joint: JointName) -> bool:
    """Whether positions of a joint that slides fit its limits in mm, and not in m."""
    limit = max(abs(joint.lower), abs(joint.upper))
    if not np.isfinite(limit) or not np.isfinite(value).any():
        return False
    most = float(np.nanmax(np.abs(value)))
    return most > 2.0 * limit and 1e-3 * most < 1.3 * limit


def _rate_scale(columns, time: Match, position: Match | None, name: str):
    """What a velocity must be multiplied with, and why."""
    words = words_of(name)
    if "rpm" in words:
        return 2.0 * np.pi / 60.0, "in rpm, by its name"
    if "deg" in words or "degps" in words or "dps" in words:
        return DEG, "in degrees per second, by its name"
    ratio = _ratio_to_rate(columns, time, position, name)
    if ratio is None:
        return 1.0, ""
    rate = _rate_of(ratio)
    if rate is None:
        return 1.0, ""
    unit, factor = rate
    if ratio < 0.0:
        return -factor, "of the other sign than the position's derivative"
    return factor, f"in {unit}, {BY_DERIVATIVE}"


def _rate_of(ratio: float) -> tuple[str, float] | None:
    """Unit and factor of _RATES that a ratio is, of either sign."""
    for unit, factor in _RATES:
        if abs(abs(ratio) / factor - 1.0) < 0.1:
            return unit, factor
    return None


def _with_channel(found: Mapping[str, Match], channel: str) -> Match | None:
    return next((m for m in found.values() if m.channel == channel), None)


def _ratio_to_rate(columns, time: Match, position: Match | None, name: str):
    """What the position's derivative is, times a column; None where the two do not go
    together."""
    if position is None:
        return None
    t = time.scale * columns[time.column]
    q, v = position.scale * columns[position.column], columns[name]
    good = np.isfinite(t) & np.isfinite(q) & np.isfinite(v)
    good[1:] &= np.diff(t) > 0.0
    if good.sum() < 50:
        return None
    t, q, v = t[good], q[good], v[good]
    # Means over a few rows: differences of single ones are mostly noise.
    n = max(len(t) // 2000, 5)
    mean = np.cumsum(v)[n:] - np.cumsum(v)[:-n]
    rate, mean = (q[n:] - q[:-n]) / (t[n:] - t[:-n]), mean / n
    if not rate.std() > 0.0 or not mean.std() > 0.0:
        return None
    if abs(np.corrcoef(rate, mean)[0, 1]) < 0.7:
        return None
    return float(np.sign(np.sum(rate * mean)) * rate.std() / mean.std())
