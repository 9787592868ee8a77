"""ROS bags (1, 2, MCAP) and LeRobot v3 datasets as tables of numbers.

A bag's numbers get the names <topic>/<field>, those of an array <field>[0], ...; or,
where a list of names in the message has as many, <topic>/<name>/<field>, as
<topic>/<joint>/position of a sensor_msgs/JointState. Time is the header's stamp, where
a message has one, else when it was recorded. Each message is a row, so that topics keep
their own rates. A dataset's columns get the names of its features, <feature>.<name>.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

BAGS = (".bag", ".mcap", ".db3")
TICKS = 4096  # A turn of a LeRobot arm's motor.
LONGEST_ARRAY = 64  # Longer ones are pictures, maps, clouds.
# What is only shown: it says again what other topics say.
_DRAWN = ("visualization_msgs/", "tf2_msgs/")
_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
# [s] Topics whose stamps differ from the bag's by more than this, or by one another's
# offsets, are on clocks of their own.
CLOCKS_APART = 1.0


def is_bag(path: Path) -> bool:
    """Whether it is a ROS bag or an MCAP file."""
    return path.suffix.lower() in BAGS or (path / "metadata.yaml").is_file()


def is_dataset(path: Path) -> bool:
    """Whether it is a LeRobot dataset."""
    return (path / "meta" / "info.json").is_file()


def rosbags(module: str, who_needs: str):
    """A module of rosbags, and the types of ROS 2. Raises: ValueError, one line that
    begins with `who_needs`, where it is not installed."""
    try:
        found = import_module(f"rosbags.{module}")
        typesys = import_module("rosbags.typesys")
    except ImportError:
        raise ValueError(f"{who_needs} rosbags: pip install 'makebreak[ros]'") from None
    return found, typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def read_bag(
    path: Path, unused: frozenset[str] = frozenset()
) -> tuple[dict[str, np.ndarray], list[tuple[str, str]]]:
    """Columns (n,), `time` [s] from the first stamp on and what the topics hold; and
    (kind, sentence) of what was done about topics with clocks of their own.

    Raises: ValueError, one line.
    """
    highlevel, store = rosbags("highlevel", f"recording {path}: bags need")
    topics: list[str] = []
    stamps: list[tuple[int, int]] = []  # [ns] Of the header, 0 if none; of the bag.
    rows: list[dict[str, float]] = []
    unread: set[str] = set()
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            for connection, received, raw in reader.messages():
                if connection.topic in unused or connection.topic in unread:
                    continue
                if connection.msgtype.startswith(_DRAWN):
                    continue
                try:
                    message = reader.deserialize(raw, connection.msgtype)
                except Exception:  # A type that nobody defined, a broken message.
                    unread.add(connection.topic)
                    continue
                values = dict(_numbers(connection.topic, connection.msgtype, message))
                if values:
                    topics.append(connection.topic)
                    stamps.append((_stamp(message), received))
                    rows.append(values)
    except Exception as error:  # The library raises what its formats' readers raise.
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(
            f"recording {path} is no bag that can be read: {why}"
        ) from None
    if not rows:
        lost = f"; not read: {', '.join(sorted(unread))}" if unread else ""
        raise ValueError(f"recording {path} holds no message with numbers{lost}")
    one_clock, notes = _on_one_clock(path, np.array(topics), np.array(stamps))
    return _table(one_clock, rows), notes


def _on_one_clock(
    path: Path, topics: np.ndarray, stamps: np.ndarray
) -> tuple[np.ndarray, list[tuple[str, str]]]:
    """(n,) [ns] of each message, and what is to be said of it.

    Headers say when something was sampled, the bag when it was written: headers are
    used where their clocks agree with each other and with the bag's. Else every
    topic's stamps are brought to one clock by the line between them and the bag's
    stamps, which each message has: the headers' clock where there is but one (a
    simulation may run at half speed), or the bag's.

    Args: topics (n,): of each message. stamps (n, 2) [ns]: its header's, 0 where there
        is none, and the bag's.
    """
    header, bag = stamps.T
    lines: dict[str, tuple[float, float]] = {}  # Offset [ns] and slope of bag's stamps.
    for topic in dict.fromkeys(topics):
        own = topics == topic
        # A clock that was never set, or stands, tells nothing.
        if (header[own] == 0).any() or len(np.unique(header[own])) < 0.5 * own.sum():
            header[own] = bag[own]
            continue
        lines[topic] = _line(header[own], bag[own])
    off = np.array([offset for offset, _ in lines.values()])
    headless = len(lines) < len(set(topics))
    far = off[np.abs(off) > 1e9 * CLOCKS_APART]
    if not far.size or not headless and np.ptp(off) < 1e9 * CLOCKS_APART:
        return header, []
    out = bag.astype(float) - float(bag[0])
    one = len(lines) < 2 or np.ptp(off) < 1e9 * CLOCKS_APART
    first = next(iter(lines))
    offset, slope = lines[first]
    for topic in dict.fromkeys(topics):
        own = topics == topic
        if topic in lines and one:
            out[own] = (header[own] - header[topics == first][0]).astype(float)
        elif topic in lines:
            a, b = lines[topic]
            start = header[own][0]
            out[own] = a + (b * (header[own] - start) + float(start - bag[0]))
        elif one:
            start = header[topics == first][0]
            out[own] = ((bag[own] - start).astype(float) - offset) / slope
    apart = float(np.abs(off).max()) * 1e-9
    others = ", ".join(t for t in dict.fromkeys(topics) if t not in lines)
    says = (
        f"{path.name}: the stamps of {', '.join(lines)} are {apart:.4g} s from the "
        "bag's, "
    )
    says += (
        f"which are all that {others} has" if others
        else "each by another amount"
    )  # fmt: skip
    says += ": they have no common clock; the bag's stamps, which every message has, "
    says += f"bring them to that of {first}" if one else "bring them together"
    return np.rint(out).astype(np.int64), [("clocks_differ", says)]


def _line(header: np.ndarray, bag: np.ndarray) -> tuple[float, float]:
    """(offset [ns], slope) of bag - header[0] = offset + slope (header - header[0]):
    through medians of the first and the last third, as few messages come late."""
    x, y = (header - header[0]).astype(float), (bag - header[0]).astype(float)
    slope, third = 1.0, len(x) // 3
    if third > 10:
        dx, dy = (np.median(z[-third:]) - np.median(z[:third]) for z in (x, y))
        # Clocks of one rate differ by less than messages are late.
        if dx > 0.0 and dy > 0.0 and abs(dy / dx - 1.0) > 0.02:
            slope = float(dy / dx)
    return float(np.median(y - slope * x)), slope


def _stamp(message) -> int:
    """[ns] of its header; 0 where it has none, or none was set."""
    header = getattr(message, "header", None)
    if header is None:
        return 0
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _numbers(topic: str, kind: str, message) -> Iterator[tuple[str, float]]:
    if kind == _TRAJECTORY:  # What is to be reached first.
        if message.points:
            yield from _fields(topic, message.points[0], 0, _labels_in(message))
        return
    yield from _fields(topic, message, 0, {})


def _fields(
    name: str, value, depth: int, labels: dict[int, list[str]]
) -> Iterator[tuple[str, float]]:
    """All numbers below a value. labels: {length: names of the entries of arrays of
    this length}."""
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray | list | tuple):
        if not 0 < len(value) <= LONGEST_ARRAY:
            return
        names = _distinct([_own_name(each) for each in value])
        names = names or labels.get(len(value), [])
        above, _, key = name.rpartition("/")
        for i, each in enumerate(value):
            at = f"{above}/{names[i]}/{key}" if names else f"{name}[{i}]"
            yield from _fields(at, each, depth + 1, labels)
    elif depth < 4 and hasattr(value, "__dataclass_fields__"):
        labels = labels | _labels_in(value)
        for key in value.__dataclass_fields__:
            if key not in ("header", "layout") and not key.startswith("__"):
                yield from _fields(f"{name}/{key}", getattr(value, key), depth + 1,
                                   labels)  # fmt: skip


def _labels_in(message) -> dict[int, list[str]]:
    """{length: names} of the lists of names in a message: those of joints, beside which
    arrays of as many numbers or messages are."""
    found: dict[int, list[str]] = {}
    for key in message.__dataclass_fields__:
        value = getattr(message, key)
        if isinstance(value, list) and (names := _distinct(value)):
            found.setdefault(len(names), names)
    return found


def _own_name(message) -> str | None:
    """What a message of a list is called, if it says so."""
    each = (getattr(message, key, None) for key in ("name", "joint_name"))
    return next((x for x in each if isinstance(x, str)), None)


def _distinct(names: Sequence[str | None]) -> list[str]:
    """The names, or none where one is no text, is empty or comes twice."""
    texts = [each for each in names if isinstance(each, str) and each]
    return texts if len(set(texts)) == len(names) else []


def _table(stamps: np.ndarray, rows: list[dict[str, float]]) -> dict[str, np.ndarray]:
    """One row a stamp; what came at the very same stamp is in one."""
    instants, row_of = np.unique(stamps, return_inverse=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    index = {name: i for i, name in enumerate(names)}
    table = np.full((len(instants), len(names)), np.nan)
    for k, row in zip(row_of, rows, strict=True):
        for name, value in row.items():
            table[k, index[name]] = value
    # Nanoseconds since 1970 are too many digits for a float.
    time = 1e-9 * (instants - instants[0]).astype(float)
    return {"time": time} | {name: table[:, i].copy() for name, i in index.items()}


# ----- LeRobot


def read_dataset(
    path: Path, read_parquet, unused: frozenset[str] = frozenset()
) -> dict[str, np.ndarray]:
    """Columns (n,): time, episode, and the features that are numbers.

    Args: read_parquet(file, unused) -> columns, lists as name[0], name[1], ...
    Raises: ValueError, one line.
    """
    info_file = path / "meta" / "info.json"
    try:
        info = json.loads(info_file.read_text())
        features = dict(info["features"])
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise ValueError(
            f"{info_file}: no info of a LeRobot dataset: {error}"
        ) from None
    files = sorted((path / "data").glob("chunk-*/*.parquet"))
    if not files:
        raise ValueError(f"recording {path}: no data/chunk-*/*.parquet below it")
    numbers = {
        name
        for name, feature in features.items()
        if str(feature.get("dtype", "")).startswith(("float", "int", "bool"))
    }
    others = frozenset(features) - numbers | unused
    parts = [read_parquet(file, others) for file in files]
    names = list(parts[0])
    if any(set(part) != set(names) for part in parts):
        raise ValueError(f"recording {path}: its parquet files have different columns")
    columns = {name: np.concatenate([part[name] for part in parts]) for name in names}
    for needed in ("timestamp", "episode_index"):
        if needed not in columns:
            raise ValueError(f"recording {path}: no column {needed}, as LeRobot's have")
    out = {"time": columns.pop("timestamp"), "episode": columns.pop("episode_index")}
    for key in ("frame_index", "index", "task_index"):
        columns.pop(key, None)
    for name in numbers:
        for i, label in enumerate(_labels(features[name])):
            if f"{name}[{i}]" in columns:
                columns[f"{name}.{label}"] = columns.pop(f"{name}[{i}]")
    return out | {name: columns[name] for name in columns if name not in unused}


def _labels(feature) -> list[str]:
    """Names of a feature's entries; none where they are only counted."""
    names = feature.get("names")
    if isinstance(names, dict):  # {"motors": [...]}, of older writers.
        names = next(iter(names.values()), None)
    if isinstance(names, list) and all(isinstance(name, str) for name in names):
        return names
    return []


@dataclass(frozen=True)
class MotorRange:
    """Of a motor by LeRobot's calibration: half of what it turns [rad], and whether it
    counts the other way."""

    half: float
    reversed: bool


def motor_ranges(path: Path, sidecar: Mapping) -> dict[str, MotorRange]:
    """{motor: its range} by the file that a sidecar names (`calibration`), or by one in
    a dataset's folder; none: {}.

    Raises: ValueError for a file that is named and is no calibration.
    """
    named = sidecar.get("calibration")
    inside = sorted(path.glob("*.json")) + sorted(path.glob("meta/*.json"))
    for file in [named] if named else inside if is_dataset(path) else []:
        try:
            found = {
                str(motor): MotorRange(
                    np.pi * (own["range_max"] - own["range_min"]) / (TICKS - 1),
                    bool(own.get("drive_mode")),
                )
                for motor, own in json.loads(file.read_text()).items()
            }
            if found:
                return found
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            if named:
                raise ValueError(
                    f"calibration {file}: expected {{motor: {{range_min, range_max}}}} "
                    f"as LeRobot writes it, got {type(error).__name__}: {error}"
                ) from None
    return {}
