"""From foreign columns to channels: what each may be, and of which joint.

A proposal to be corrected, not a decision: names are matched by words and numbers;
units.py says what columns count in.
"""

import re
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import yaml

from makebreak.gap.data.arrays import TIME_WORDS, words_of
from makebreak.gap.data.bags import MotorRange
from makebreak.gap.data.csv_table import is_nameless
from makebreak.gap.data.match import AS_SAID, JointName, Match, plain_name
from makebreak.gap.data.sidecar import activation_said, activation_text
from makebreak.gap.data.stamps import is_backward
from makebreak.gap.data.table import COMMANDS, is_channel
from makebreak.gap.data.units import DEGREES, in_units, quantity_of_unit, unit_in_name

UNKNOWN_JOINT = "of an unknown joint"  # Why such a column is left out.
_COMMAND = set(
    "cmd command commands commanded target desired des ref reference goal goals "
    "setpoint action actions sp control soll sollwert".split()
)
_WORDS = {
    "acceleration": set("acc acceleration accelerations ddq qdd accel".split()),
    "current": set("current currents curr amp amps ampere".split()),
    "effort": set(
        "effort efforts eff torque torques tau trq moment moments u ctrl".split()
    ),
    "force": set("force forces thrust".split()),
    "velocity": set(
        "velocity velocities vel vels dq qd qdot qvel speed speeds spd omega velo "
        "thetadot v".split()
    ),
    "position": set(
        "position positions pos q qpos angle angles theta phi rad state states "
        "joint joints axis axes encoder action actions".split()
    )
    | {*DEGREES},
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
_SINCE_1970 = 1e9  # [s]
_TIME_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
_MOTION_COMMANDS = ("position_command", "velocity_command")
# A joint's name with nothing but these is where it is.
_NOW = set(
    "present actual measured meas act observation obs observed real value ist "
    "istwert".split()
)


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
    for name, joint in _joints_of(quantities, joints, listed, columns).items():
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
    found = in_units(columns, joints, _by_motion(found, columns), ranges)
    return [found[name] for name in [*columns, *text]]


def said_of(columns: Mapping) -> dict[str, Match]:
    """{column: what a sidecar's `columns` says of it}."""
    found = {}
    for name, target in columns.items():
        own = target if isinstance(target, dict) else {"channel": target}
        found[str(name)] = Match(
            str(name), own.get("channel"), float(own.get("scale", 1.0)),
            float(own.get("offset", 0.0)), AS_SAID,
            activation=activation_said(f'columns, "{name}":', own),
        )  # fmt: skip
    return found


def of_one_drive(
    matches: Sequence[Match],
    of_servos: Collection[str] = (),
    unexplained: bool = False,
) -> list[Match]:
    """With one kind of command alone: efforts before positions, and before velocities;
    measured efforts stand in for commands of effort. of_servos: channels of measured
    efforts that are what the position commands' servos give; others drive nothing.
    unexplained: whether efforts do not go with the motion: other commands do."""
    why = "what its position servo gives, and so no other drive"
    gone: set[str | None] = {*of_servos}
    if unexplained and not gone and not {*_kinds(matches)}.isdisjoint(_MOTION_COMMANDS):
        why = "it does not go with the motion, and so drives nothing"
        gone = {m.channel for m in matches if ".effort_" in (m.channel or "")}
    matches = [Match(m.column, None, why=why) if m.channel in gone else m
               for m in matches]  # fmt: skip
    kinds = _kinds(matches)
    drives = ("effort_command", "effort_measured", *_MOTION_COMMANDS)
    keep = next((k for k in drives if k in kinds), None)
    out = []
    for match in matches:
        what = (match.channel or "").rsplit(".", 1)[-1]
        pd = keep == "position_command" and what == "velocity_command"
        if what in COMMANDS and what != keep or pd:
            why = f"{what}: {keep} is taken for what drives the joints"
            match = Match(match.column, None, why=why)
        out.append(match)
    return out


def _kinds(matches: Sequence[Match]) -> list[str]:
    """Of channels."""
    return [(m.channel or "").rsplit(".", 1)[-1] for m in matches]


def sidecar_text(matches: Sequence[Match], own: Mapping | None = None) -> str:
    """A sidecar with the columns, to be corrected. own: sections of the log's own, of
    which all but the columns are kept, and filters that matches tell of are added."""
    rest = {key: value for key, value in (own or {}).items() if key != "columns"}
    if filters := {m.channel: m.filter for m in matches if m.filter}:
        rest["filters"] = {**filters, **(rest.get("filters") or {})}
    lines = ["# What each column is: a proposal, to be corrected. docs/recordings.md",
             "columns:"]  # fmt: skip
    for match in matches:
        key = _quoted(match.column)
        if match.channel is None:
            target = "null"
        elif (match.scale, match.offset, match.activation) == (1.0, 0.0, None):
            target = match.channel
        else:
            target = f"{{channel: {match.channel}, scale: {match.scale!r}"
            target += f", offset: {match.offset!r}" if match.offset else ""
            if match.activation is not None:
                target += f", {activation_text(match.activation)}"
            target += "}"
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
    if dots := sum(word in ("dot", "ddot", "dotdot") for word in words):
        kind = "velocity" if dots == 1 and "dot" in words else "acceleration"
    if kind == "position":  # A joint's own name may be q1, or have a `joint` in it.
        kind = quantity_of_unit(name) or kind
    elif kind is None and named and not command:
        kind = quantity_of_unit(name)
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
        is_input = {"u", "ctrl"} & {*words}  # As MuJoCo has what actuators are given.
        return "effort_command" if command or is_input else "effort_measured"
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


def _names(column: str, joint: JointName) -> bool:
    """Whether a column's name has the joint's in it."""
    return plain_name(joint.name.split(".", 1)[1]) in plain_name(column)


def _listed(
    text: Mapping[str, str], joints: Sequence[JointName]
) -> dict[int, JointName]:
    """{number of a column: its joint}, where columns of text name the joints: one with
    a list, or one for each number (`name0`, `name1`). Drivers sort joints by name."""
    plain = {plain_name(j.name.split(".", 1)[1]): j for j in joints}
    one_each: dict[int, JointName] = {}
    for name, cell in text.items():
        parts = re.split(r"[\s,;\[\]()'\"]+", cell)
        parts = [plain_name(part) for part in parts if part]
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
    columns: Mapping[str, np.ndarray],
) -> dict[str, JointName | None]:
    """By the joint's own name in the column's, or by words of it that no other joint
    has; else by the number in the column's, among the joints that share such words, or
    as columns of text list them."""
    found: dict[str, JointName | None] = {}
    own_words = _own_words(joints)
    plain = {plain_name(j.name.split(".", 1)[1]): j for j in joints}
    numbered: dict[tuple[JointName, ...], dict[str, int]] = {}
    for name in quantities:
        own = plain_name(name)
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
            found |= _by_number(_after_base(of, len(group), columns), group, joints)
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
    base = 0 if min(of.values()) <= 0 else 1
    places = {name: number - base for name, number in of.items()}
    return {
        name: group[k] if 0 <= k < len(group) else None for name, k in places.items()
    }


def _after_base(
    of: Mapping[str, int], n: int, columns: Mapping[str, np.ndarray]
) -> dict[str, int]:
    """{column: number} without those of a floating base, which come first where a list
    has all coordinates (MuJoCo, pinocchio): 7 of positions, with a quaternion, and 6 of
    velocities before those of n joints."""
    lists: dict[str, list[str]] = {}
    for name in of:
        lists.setdefault(re.sub(r"\d+(?=\D*$)", "", name), []).append(name)
    more = {key: len(own) - n for key, own in lists.items()}
    found = dict(of)
    free = any(
        more[key] == 7
        and np.allclose(sum(columns[k] ** 2 for k in own[3:7]), 1.0, atol=0.01)
        for key, own in lists.items()
    )
    for key, own in lists.items():
        if free and more[key] in (6, 7):
            found |= {name: of[name] - more[key] for name in own}
    return found


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


# ----- Times


def find_time(columns: Mapping[str, np.ndarray]) -> Match | None:
    """The first column that increases and has a word for time in its name, or a unit of
    it in brackets (in any language), or no name and even steps; else one that counts
    from 1970, as dates do, or one of even steps that says no quantity."""
    dated = [n for n, y in columns.items() if (y > _SINCE_1970).any() and _is_even(y)]
    even = [n for n, y in columns.items() if _is_even(y) and not _counts(y)
            and not any(map(says_quantity, words_of(n)))]  # fmt: skip
    for k, name in enumerate([*columns, *dated, *even]):
        value, words = columns[name], words_of(name)
        if not (
            k >= len(columns)
            or set(words) & TIME_WORDS
            or words
            and words[0] in _TIME_UNITS
            or re.search(r"[\[(](ns|us|ms|s|sec)[\])]\s*$", name.lower())
            or is_nameless(name)
            and _is_even(value)
        ):
            continue
        step = np.diff(value[np.isfinite(value)])
        step = -step if is_backward(value) else step
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


def _without_unknown_efforts(
    found: dict[str, Match], joints: Sequence[JointName]
) -> dict[str, Match]:
    """Efforts in a unit that says too little are left out; another column of the same
    joint may have them."""
    out, of = dict(found), {joint.name: joint for joint in joints}
    for name, match in found.items():
        joint = of.get((match.channel or "").rpartition(".")[0])
        if joint is None or match.channel == name or match.why == AS_SAID:
            continue
        unit, scale = unit_in_name(match, joint)
        if scale is None:
            why = f"in {unit}, and of what is not said: give channel and scale"
            out[name] = Match(name, None, why=why, may=str(match.channel))
    return out


def _by_motion(found: dict[str, Match], columns) -> dict[str, Match]:
    """qd may be a speed or a command of position, and ctrl a command of either kind:
    what it goes with tells."""
    follows: dict[str, dict[str, bool]] = {}  # {quantity: {column: whether it does}}
    for name, match in found.items():
        at, _, what = (match.channel or "").rpartition(".")
        if (what, {"qd", "ctrl"} & {*words_of(name)}) not in (
            ("velocity", {"qd"}), ("effort_command", {"ctrl"})
        ):  # fmt: skip
            continue
        position = _with_channel(found, f"{at}.position")
        taken = any(m.channel == f"{at}.position_command" for m in found.values())
        if position is None or taken:
            continue
        q, y = columns[position.column], columns[name]
        good = np.isfinite(q) & np.isfinite(y)
        if good.sum() < 50 or not (np.ptp(q[good]) > 0.0 and np.ptp(y[good]) > 0.0):
            continue
        near = np.std(q[good] - y[good]) < 0.5 * np.std(q[good])
        follows.setdefault(what, {})[name] = bool(
            near and np.corrcoef(q[good], y[good])[0, 1] > 0.9
        )
    out = dict(found)
    for each in follows.values():  # What most joints' columns are, all are.
        if 2 * sum(each.values()) > len(each):
            for name in each:
                at = str(found[name].channel).rpartition(".")[0]
                why = "it follows the position"
                out[name] = Match(name, f"{at}.position_command", why=why)
    return out


def _with_channel(found: Mapping[str, Match], channel: str) -> Match | None:
    return next((m for m in found.values() if m.channel == channel), None)
