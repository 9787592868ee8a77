"""A recording in memory: channels with names, episodes, rates and noise."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import yaml

from makebreak.gap.data.csv_table import BadRows
from makebreak.gap.data.filters import read_filter
from makebreak.gap.data.joined import joined, time_column
from makebreak.gap.data.table import (
    COMMANDS,
    JOINT_QUANTITIES,
    MOST_CELLS,
    QUANTITIES,
    TWIST,
    check_columns,
    is_channel,
    read_table,
    stem_of,
)
from makebreak.gap.numerics.signal_noise import estimate_noise
from makebreak.models.effects.measured_channels import torque_constant
from makebreak.systems.numerics.filters import Stage

FEWEST_ROWS = 10  # In an episode: fewer hold no window and no noise.
# A longer hole in time [s] is a break, as is one of so many periods.
LONGEST_HOLE_SEC, LONGEST_HOLE_ROWS = 1.0, 50
MOST_VALUE = 1e12  # In SI units nothing that a robot measures is larger.
_SIDECAR = ("noise", "filters", "columns", "ignore", "join", "provenance")
_TIME_UNITS = ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"), (0.0, "no unit of time"))
_QUATERNION = ("qw", "qx", "qy", "qz")
_UNITS = {q: "N" for q in ("fx", "fy", "fz")} | {q: "N m" for q in ("tx", "ty", "tz")}
_UNITS |= {q: "m" for q in "xyz"} | {q: "1" for q in _QUATERNION}
_UNITS |= {q: "m/s" for q in TWIST[:3]} | {q: "rad/s" for q in TWIST[3:]}


def unit_of(quantity: str, prismatic: bool = False) -> str:
    """The unit of a quantity; of a joint's, that of a revolute one unless said."""
    if quantity in _UNITS:
        return _UNITS[quantity]
    if "position" in quantity:
        return "m" if prismatic else "rad"
    if "velocity" in quantity:
        return "m/s" if prismatic else "rad/s"
    return "N" if prismatic else "N m"


@dataclass(frozen=True, eq=False)
class Channel:
    """One column. `<model>.<element>.<quantity>`: an element is a joint, body or frame.

    noise: standard deviation, in the channel's unit; for a command 0.
    noise_from: "given", "estimated", or "none" for a command. noise_given: of a single
    sample as the sidecar says it, else 0. averaged: samples in each value, as a mean.
    noise_pole: 0 for white noise; else the estimated pole of its filter, a sample.
    together: how many neighbouring samples' noise goes together, 1 for white noise.
    step: the channel's resolution if it is quantised, else 0.
    rate_hz: samples that are there per second. filter: what the sidecar says.
    stages: what of that is simulated; None if the text says no filter we know.
    """

    name: str
    values: np.ndarray  # (n,), NaN where a sample is missing; read-only.
    noise: float = 0.0
    noise_from: str = "none"
    noise_given: float = 0.0
    averaged: float = 1.0
    noise_pole: float = 0.0
    together: float = 1.0
    step: float = 0.0
    rate_hz: float = 0.0
    filter: str = ""
    stages: tuple[Stage, ...] | None = ()

    @property
    def model(self) -> str:
        return self.name.split(".")[0]

    @property
    def element(self) -> str:
        return self.name.split(".", 1)[1].rsplit(".", 1)[0]

    @property
    def quantity(self) -> str:
        return self.name.rsplit(".", 1)[1]

    @property
    def at(self) -> str:
        """`<model>.<element>`."""
        return self.name.rsplit(".", 1)[0]

    @property
    def is_command(self) -> bool:
        return self.quantity in COMMANDS


@dataclass(frozen=True)
class Episode:
    """Rows [first, last) of a recording, without a break.

    number: that of the column `episode`, 0 where there is none. stretch: counts the
    parts of an episode of which rows were left out because the table is too long.
    """

    number: int
    first: int
    last: int
    stretch: int = 0

    @property
    def rows(self) -> slice:
        return slice(self.first, self.last)

    @property
    def is_start(self) -> bool:
        """Whether its first row is the episode's own, where `initial` holds."""
        return self.stretch == 0


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording. All arrays are read-only.

    name: unique among the recordings read together. notes: what was done to the table
    in reading: (kind, sentence).
    """

    name: str
    path: Path
    time: np.ndarray  # (n,) [s]
    row: np.ndarray  # (n,) number of each row in the file, from 1.
    episodes: tuple[Episode, ...]
    channels: Mapping[str, Channel]
    n_rows_in_file: int
    provenance: str = ""
    notes: tuple[tuple[str, str], ...] = ()
    quaternion_flips: Mapping[str, int] = field(default_factory=dict)
    quaternion_norm_error: Mapping[str, float] = field(default_factory=dict)
    raw_period_sec: float = 0.0  # Of the rows that were averaged; 0 if none were.

    def __contains__(self, name: str) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> np.ndarray:
        """(n,) values of a channel, NaN where a sample is missing."""
        return self.channels[name].values

    def commands(self) -> list[Channel]:
        return [c for c in self.channels.values() if c.is_command]

    def measured(self) -> list[Channel]:
        return [c for c in self.channels.values() if not c.is_command]

    def places(self, quantities: Iterable[str] = QUANTITIES) -> list[str]:
        """`<model>.<element>` that have any of the quantities, in the file's order."""
        wanted = set(quantities)
        found = (c.at for c in self.channels.values() if c.quantity in wanted)
        return list(dict.fromkeys(found))

    def stack(self, at: str, quantities: Iterable[str]) -> np.ndarray | None:
        """(n, k) of channels `<at>.<quantity>`; None if one of them is missing."""
        names = [f"{at}.{q}" for q in quantities]
        if not all(name in self.channels for name in names):
            return None
        return np.stack([self[name] for name in names], axis=1)

    def samples(self, name: str, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and values of the samples of an episode that are there."""
        y, t = self[name][episode.rows], self.time[episode.rows]
        there = ~np.isnan(y)
        return t[there], y[there]

    def held(self, name: str) -> np.ndarray:
        """(n,) a command, held from its row on; NaN before an episode's first one."""
        y = self[name]
        index = np.where(np.isnan(y), -1, np.arange(len(y)))
        out = np.empty(len(y))
        for episode in self.episodes:
            last = np.maximum.accumulate(index[episode.rows])
            out[episode.rows] = np.where(last >= 0, y[last], np.nan)
        return out

    def period_sec(self) -> float:
        """Between rows, as they were written."""
        if self.raw_period_sec:
            return self.raw_period_sec
        steps = [np.diff(self.time[e.rows]) for e in self.episodes]
        return float(np.median(np.concatenate(steps)))

    def duration_sec(self) -> float:
        """Of all episodes together."""
        return float(
            sum(self.time[e.last - 1] - self.time[e.first] for e in self.episodes)
        )


def read_recordings(
    paths: Iterable[str | Path],
    skip_bad_rows: bool = False,
    sidecars: Mapping[Path, Path] | None = None,
) -> list[Recording]:
    """Several recordings, with names that tell them apart.

    Args: skip_bad_rows: as of read_recording. sidecars: {recording: sidecar}, where it
        is not beside it.
    Raises: ValueError as read_recording; if a file is given twice; for no file.
    """
    files = [Path(path) for path in paths]
    if not files:
        raise ValueError("expected at least one recording")
    seen: dict[Path, Path] = {}
    for path in files:
        if path.resolve() in seen:
            raise ValueError(f"recording {path} is given twice")
        seen[path.resolve()] = path
    stems = [stem_of(path) for path in files]
    if len(set(stems)) < len(stems):  # runs/a/recording.csv, runs/b/recording.csv
        stems = [f"{path.resolve().parent.name}/{stem_of(path)}" for path in files]
    if len(set(stems)) < len(stems):
        stems = [str(path) for path in files]
    return [
        read_recording(
            path, name, MOST_CELLS, skip_bad_rows, (sidecars or {}).get(path)
        )
        for path, name in zip(files, stems, strict=True)
    ]


def read_recording(
    path: str | Path,
    name: str | None = None,
    most_cells: int = MOST_CELLS,
    skip_bad_rows: bool = False,
    sidecar_path: Path | None = None,
) -> Recording:
    """Reads a .csv, .npz or .parquet table, and what its sidecars say of it.

    Quaternions are given unit length and one sign without jumps; what was done is in
    the recording's fields and notes.

    Args: skip_bad_rows: rows that cannot be read, that hold numbers beyond 1e12, or
        whose time does not increase, are left out and counted in a note. sidecar_path:
        in place of the one beside it.
    Raises: ValueError: one line with file, column, row, what came, what was expected.
    """
    path = Path(path)
    sidecar = _read_sidecars(path, sidecar_path)
    names = sidecar.get("columns") or {}
    unused = frozenset(str(name) for name, to in names.items() if to is None)
    bad = BadRows(path, skip_bad_rows)
    table = read_table(path, most_cells, bad, unused)
    if others := sidecar.get("join"):
        tables = []
        for file in others:
            own = {name.removeprefix(f"{file.name}:") for name in unused}
            tables.append((file, read_table(file, most_cells, bad, frozenset(own))))
        table = joined(path, table, tables, time_column(names))
    columns = _renamed(path, table.columns, names, unused)
    check_time(path, columns)
    columns, row = _without_bad(columns, table.row, bad)
    excerpt = len(row) + bad.count < table.n_rows
    number = columns.get("episode")
    try:
        columns = check_columns(
            columns | {"episode": _parts(path, columns, row, excerpt)}
        )
    except ValueError as error:
        raise ValueError(_with_rows(path, error, row)) from None
    time, part = columns.pop("time"), columns.pop("episode")
    if not columns:
        raise ValueError(f"recording {path} has no channel beside time")
    episodes = _episodes(path, number, part, time, row)
    episodes, notes = _broken_at_holes(path, episodes, time)
    episodes, more = _without_ignored(path, episodes, number, time, sidecar)
    notes += more + _left_out(path, columns, row)
    flips, norm_errors = _mend_quaternions(path, columns, episodes, row)
    if excerpt:
        notes.append(
            (
                "rows_left_out",
                f"{path.name} has {table.n_rows} rows, too many to hold: "
                f"{len(time)} of them are used, in evenly spread stretches",
            )
        )
    noise, filters = sidecar.get("noise") or {}, sidecar.get("filters") or {}
    for section, known in (("noise", noise), ("filters", filters)):
        for key in known:
            if key in columns:
                continue
            if is_channel(key) and key not in sidecar.get("own", ()):
                continue  # noise.json may speak of several recordings.
            close = get_close_matches(key, columns, n=1, cutoff=0.5)
            hint = f'; did you mean "{close[0]}"?' if close else ""
            raise ValueError(
                f'sidecar of {path}: {section} of "{key}", '
                + (
                    f"which the recording does not have{hint}"
                    if is_channel(key)
                    else f"expected the name of a channel{hint}"
                )
            )
    for value in (time, *columns.values()):
        value.setflags(write=False)
    notes += bad.note()
    channels = {
        key: _channel(path, key, value, time, episodes, noise, filters)
        for key, value in columns.items()
    }
    return Recording(
        name=name or stem_of(path),
        path=path,
        time=time,
        row=row,
        episodes=episodes,
        channels=channels,
        n_rows_in_file=table.n_rows,
        provenance=str(sidecar.get("provenance") or ""),
        notes=tuple(notes),
        quaternion_flips=flips,
        quaternion_norm_error=norm_errors,
    )


def check_against_scene(
    recording: Recording, joints: Iterable[str], bodies: Iterable[str]
) -> None:
    """Refuses channels of what a scene does not have.

    Args: joints, bodies: `<model>.<name>` of the scene's joints; bodies and frames.
    Raises: ValueError, naming all of them and the nearest name of the first.
    """
    joints, bodies = set(joints), set(bodies)
    lacking = {
        c.name: (joints if c.quantity in JOINT_QUANTITIES else bodies, c)
        for c in recording.channels.values()
        if c.at not in (joints if c.quantity in JOINT_QUANTITIES else bodies)
    }
    if not lacking:
        return
    known, first = next(iter(lacking.values()))
    what = "joint" if first.quantity in JOINT_QUANTITIES else "body or frame"
    close = get_close_matches(first.at, known, n=1, cutoff=0.5)
    hint = f'did you mean "{close[0]}"?' if close else f"it has {sorted(known)}"
    others = f" (and {len(lacking) - 1} more)" if len(lacking) > 1 else ""
    raise ValueError(
        f"recording {recording.path}: column {first.name}{others}: no {what} "
        f'"{first.at}" in the scene: {hint}; to leave a column out, map it to null '
        "under `columns` "
        f"in {sidecar_of(recording.path).name}"
    )


def sidecar_of(path: Path) -> Path:
    """Where a recording's sidecar is expected: monday.csv has monday.yaml."""
    return path.with_name(f"{stem_of(path)}.yaml")


def has_sidecar(path: Path) -> bool:
    return bool(_own_sidecars(path))


def _own_sidecars(path: Path) -> list[Path]:
    own = [sidecar_of(path), path.with_name(f"{path.name}.yaml")]
    own += [file.with_suffix(".yml") for file in own]
    return [file for file in dict.fromkeys(own) if file.is_file()]


def _read_sidecars(path: Path, given: Path | None) -> dict:
    """noise.json in the folder, and `<recording>.yaml`, or .csv.yaml, which wins."""
    merged: dict = {}
    own = _own_sidecars(path) if given is None else [given]
    if len(own) > 1:
        raise ValueError(
            f"recording {path} has two sidecars: {own[0].name} and {own[1].name}"
        )
    for file in (path.with_name("noise.json"), *own):
        if not file.is_file():
            continue
        try:
            # Not YAML for both: YAML reads 1e-5 as a text.
            text = file.read_text()
            data = json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)
        except (ValueError, yaml.YAMLError, RecursionError) as error:
            raise ValueError(f"{file}: {' '.join(str(error).split())}") from None
        if data is None:
            continue
        if not isinstance(data, dict):
            raise ValueError(f"{file}: expected names with values")
        if file.suffix == ".json" and not set(data) & set(_SIDECAR):
            data = {"noise": data}  # {channel: standard deviation}
        for key, value in data.items():
            if key not in _SIDECAR:
                raise ValueError(
                    f'{file}: "{key}", expected one of {", ".join(_SIDECAR)}'
                )
            if key == "ignore":
                value = _spans(file, value)
            elif key == "join":
                value = _files_of(file, value)
            elif key != "provenance" and value is not None:
                if not isinstance(value, dict):
                    raise ValueError(f"{file}: {key} must be names with values")
                value = (merged.get(key) or {}) | {str(k): v for k, v in value.items()}
            merged[key] = value
        for key, value in (data.get("noise") or {}).items():
            number = _number(f"{file}: noise of {key}", value, least=0.0)
            merged["noise"][str(key)] = number
        if file in own:  # It speaks of this recording alone.
            merged["own"] = {str(key) for key in data.get("noise") or {}} | {
                str(key) for key in data.get("filters") or {}
            }
    return merged


def _files_of(file: Path, said) -> list[Path]:
    """Files, named beside the sidecar, that belong to a recording."""
    names = said if isinstance(said, list) else [said]
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{file}: join: got {said}, expected a file name, or a list")
    return [file.parent / name for name in names]


def _spans(file: Path, said) -> list[tuple[float, float, int | None]]:
    """From, to [s] and the episode, None for all, of spans that are to be left out."""
    spans = []
    for each in said if isinstance(said, list) else [said]:
        if not isinstance(each, dict) or set(each) - {"from", "to", "episode"}:
            raise ValueError(
                f"{file}: ignore has {each!r}, expected a list of {{from: 16, to: 18}} "
                "in seconds of the recording's time, and episode where it has several"
            )
        first, last = (
            _number(f"{file}: ignore, {key}", each.get(key)) for key in ("from", "to")
        )
        if not first < last:
            raise ValueError(f"{file}: ignore is from {first} to {last} s")
        episode = each.get("episode")
        if episode is not None and not isinstance(episode, int):
            raise ValueError(f"{file}: ignore, episode is {episode!r}")
        spans.append((first, last, episode))
    return spans


def _without_ignored(path: Path, episodes, number, time, sidecar):
    """Episodes without the spans that the sidecar leaves out, and what is said."""
    spans = sidecar.get("ignore") or []
    if not spans:
        return episodes, []
    found, gone = [], 0
    for e in episodes:
        t = time[e.rows]
        kept = np.ones(len(t), bool)
        for first, last, of in spans:
            if of is None or of == e.number:
                kept &= (t < first) | (t > last)
        gone += int((~kept).sum())
        starts = np.flatnonzero(np.diff(kept.astype(int), prepend=0) == 1)
        ends = np.flatnonzero(np.diff(kept.astype(int), append=0) == -1) + 1
        for k, (a, b) in enumerate(zip(starts, ends, strict=True)):
            if b - a >= FEWEST_ROWS:
                stretch = e.stretch + k + (1 if a and not k else 0)
                found.append(
                    Episode(e.number, e.first + int(a), e.first + int(b), stretch)
                )
    says = ", ".join(f"{a:g} to {b:g} s" for a, b, _ in spans)
    if not gone:
        raise ValueError(
            f"sidecar of {path}: ignore {says}: no row is there, time goes from "
            f"{time[0]:g} to {time[-1]:g} s"
        )
    if not found:
        raise ValueError(f"sidecar of {path}: ignore leaves no {FEWEST_ROWS} rows")
    note = f"{path.name}: {gone} rows are left out as its sidecar says, {says}"
    return tuple(found), [("ignored", note)]


def _number(what: str, value, least: float = -np.inf) -> float:
    try:
        number = float(value)  # YAML reads 1e-5, without a point, as a text.
    except (TypeError, ValueError):
        number = np.nan
    if not (np.isfinite(number) and number >= least) or isinstance(value, bool):
        tail = f" of {least:g} or more" if np.isfinite(least) else ""
        raise ValueError(f"{what} is {value!r}, expected a finite number{tail}")
    return number


def _renamed(
    path: Path, columns: Mapping, names: Mapping, unused: frozenset[str]
) -> dict[str, np.ndarray]:
    """The columns under our names.

    names: {foreign: ours}, {foreign: null} to leave one out, or {foreign: {channel:
    ours, scale: factor, offset: added after it}}.
    """
    file, result = sidecar_of(path), {}
    for foreign in names:
        if foreign not in columns and foreign not in unused:
            raise ValueError(
                f'{file}: columns names "{foreign}", {path.name} has '
                f"{', '.join(columns)}"
            )
    for name, value in columns.items():
        target = names.get(name, name)
        if target is None:
            continue
        if isinstance(target, dict):
            unknown = set(target) - {"channel", "scale", "offset"}
            if unknown or "channel" not in target:
                raise ValueError(
                    f'{file}: columns, "{name}": got {sorted(target)}, expected '
                    "channel, and scale or offset"
                )
            what = f'{file}: columns, "{name}":'
            scale = _number(f"{what} scale", target.get("scale", 1.0))
            if scale == 0.0:
                raise ValueError(f"{what} scale is 0, which leaves nothing")
            offset = _number(f"{what} offset", target.get("offset", 0.0))
            value, target = scale * value + offset, target["channel"]
        if not isinstance(target, str):
            raise ValueError(
                f'{file}: columns, "{name}": got {target}, expected the name of a '
                "channel, or null"
            )
        if target in result:
            raise ValueError(f'{file}: two columns are mapped to "{target}"')
        result[target] = value
    return result


def _parts(path: Path, columns: Mapping, row: np.ndarray, excerpt: bool) -> np.ndarray:
    """(n,) counts from 0 the parts of the table in which time must increase; rows of an
    excerpt jump where some were left out."""
    new = np.concatenate([[0], (np.diff(row) > 1) & excerpt])
    episode = columns.get("episode")
    if episode is not None:
        bad = np.flatnonzero(~(np.mod(episode, 1.0) == 0.0))
        if bad.size:
            raise ValueError(
                f"recording {path}: column episode, row {row[bad[0]]}: got "
                f"{episode[bad[0]]}, expected an integer"
            )
        new = new | np.concatenate([[0], np.diff(episode) != 0])
    return np.cumsum(new).astype(float)


def _without_bad(columns: dict, row: np.ndarray, bad: BadRows):
    """Columns and row numbers without rows that hold what nothing measures, or come
    before the row above them, where such are left out."""
    if not bad.skip:
        return columns, row
    good = np.ones(len(row), bool)
    for name, value in columns.items():
        for k in np.flatnonzero(good & (np.abs(value) > MOST_VALUE)):
            bad.add(f"column {name}, row {row[k]}: got {value[k]:.4g}")
            good[k] = False
    time, episode = columns["time"], columns.get("episode", np.zeros(len(row)))
    for k in np.flatnonzero(good & ~np.isfinite(time)):
        bad.add(f"column time, row {row[k]}: got {time[k]}")
        good[k] = False
    rows = np.flatnonzero(good)
    for number in np.unique(episode[rows]):
        mine = rows[episode[rows] == number]
        latest = np.maximum.accumulate(time[mine])
        for k in mine[1:][time[mine[1:]] <= latest[:-1]]:
            bad.add(f"column time, row {row[k]}: {time[k]} does not increase")
            good[k] = False
    return {name: value[good] for name, value in columns.items()}, row[good]


def check_time(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Raises: ValueError where there is no time, or it is not in seconds."""
    sidecar = sidecar_of(path).name
    if "time" not in columns:
        shown = ", ".join(list(columns)[:8]) + (", ..." if len(columns) > 8 else "")
        raise ValueError(
            f"recording {path} needs the column time, got {shown}; a column of another "
            f"name is mapped in {sidecar}: columns: {{t: time}}"
        )
    steps = np.abs(np.diff(columns["time"][:100_000]))
    step = float(np.median(steps[np.isfinite(steps)])) if len(steps) else 0.0
    # A row a second for a quarter of an hour is 1 kHz in milliseconds.
    if step > 1.5 or (step > 0.9 and len(steps) > 1000):
        scale, unit = next((s, u) for s, u in _TIME_UNITS if step * s < 0.9)
        mapping = f"{{time: {{channel: time, scale: {scale:g}}}}}"
        raise ValueError(
            f"recording {path}: rows are {step:.6g} s apart, as if time were in {unit}:"
            f" expected seconds; map it in {sidecar}: columns: {mapping}"
        )


def _with_rows(path: Path, error: ValueError, row: np.ndarray) -> str:
    """The message about a column, with the file's name."""
    text = str(error).removeprefix("a recording ").removeprefix("recording ")
    if len(row) and row[-1] != len(row):
        text += " (rows counted among those that are used)"
    return f"recording {path}: {text}"


def _episodes(
    path: Path,
    number: np.ndarray | None,
    part: np.ndarray,
    time: np.ndarray,
    row: np.ndarray,
) -> tuple[Episode, ...]:
    starts = np.flatnonzero(np.diff(part, prepend=-1.0))
    ends = [*starts[1:], len(part)]
    episodes: list[Episode] = []
    stretches: dict[int, int] = {}
    for first, last in zip(starts, ends, strict=True):
        n = 0 if number is None else int(number[first])
        if n in stretches and episodes[-1].number != n:
            raise ValueError(
                f"recording {path}: episode {n} comes back after episode "
                f"{episodes[-1].number}: rows out of order"
            )
        # An episode of which the first rows were left out starts with stretch 1.
        whole = row[first] == 1 or (first > 0 and row[first] == row[first - 1] + 1)
        stretches[n] = stretches.get(n, -1 if whole else 0) + 1
        if last - first < FEWEST_ROWS:
            raise ValueError(
                f"recording {path}: episode {n} has {last - first} rows, from "
                f"{time[first]} s on; expected at least {FEWEST_ROWS}"
            )
        episodes.append(Episode(n, int(first), int(last), stretches[n]))
    return tuple(episodes)


def _broken_at_holes(
    path: Path, episodes: Sequence[Episode], time: np.ndarray
) -> tuple[tuple[Episode, ...], list[tuple[str, str]]]:
    """Episodes without long holes in time, and what is to be said of it.

    What lies between two holes and has too few rows is left out.
    """
    found, notes = [], []
    for episode in episodes:
        steps = np.diff(time[episode.rows])
        most = max(LONGEST_HOLE_SEC, LONGEST_HOLE_ROWS * float(np.median(steps)))
        breaks = np.flatnonzero(steps > most) + 1
        if not breaks.size:
            found.append(episode)
            continue
        edges = episode.first + np.array([0, *breaks, episode.last - episode.first])
        parts = [
            Episode(episode.number, int(a), int(b), episode.stretch + k)
            for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        ]
        short = sum(p.last - p.first for p in parts if p.last - p.first < FEWEST_ROWS)
        says = (
            f"{path.name}, episode {episode.number}, has {len(breaks)} holes in time, "
            f"the longest of {steps.max():.4g} s; no window reaches across them"
        )
        if short:
            says += f", and {short} rows that stand alone are not used"
        notes.append(("hole", says))
        found += [p for p in parts if p.last - p.first >= FEWEST_ROWS]
    if not found:
        raise ValueError(
            f"recording {path}: no {FEWEST_ROWS} rows follow one another without a "
            "hole in time"
        )
    return tuple(found), notes


def _left_out(path: Path, columns: dict, row: np.ndarray) -> list[tuple[str, str]]:
    """Takes columns without any sample out of the table, and says so.

    Raises: ValueError for a number that nothing measures.
    """
    empty = [name for name, value in columns.items() if np.isnan(value).all()]
    for name in empty:
        del columns[name]
    if not columns:
        raise ValueError(f"recording {path}: no column beside time has any number")
    for name, value in columns.items():
        bad = np.flatnonzero(np.abs(value) > MOST_VALUE)
        if bad.size:
            raise ValueError(
                f"recording {path}: column {name}, row {row[bad[0]]}: got "
                f"{value[bad[0]]:.4g}, expected a number in SI units, of less than "
                f"{MOST_VALUE:g}"
            )
    return [
        ("channel_empty", f"{path.name}: {name} has no sample at all and is left out")
        for name in empty
    ]


def _mend_quaternions(
    path: Path, columns: dict, episodes: Iterable[Episode], row: np.ndarray
) -> tuple[dict[str, int], dict[str, float]]:
    """Unit length, and the sign of the sample before; in place.

    Returns: for each body the number of flips, and the largest error of the norm.
    """
    flips, errors = {}, {}
    names = [name.rsplit(".", 1) for name in columns]
    for at in dict.fromkeys(at for at, quantity in names if quantity in _QUATERNION):
        keys = [f"{at}.{q}" for q in _QUATERNION]
        missing = [key for key in keys if key not in columns]
        if missing:
            raise ValueError(
                f"recording {path}: column {missing[0]} is missing: a quaternion has "
                "qw qx qy qz"
            )
        q = np.stack([columns[key] for key in keys], axis=1)
        hole = np.isnan(q)
        half = np.flatnonzero(hole.any(axis=1) & ~hole.all(axis=1))
        if half.size:
            raise ValueError(
                f"recording {path}: column {keys[np.argmax(hole[half[0]])]}, row "
                f"{row[half[0]]}: empty while other parts of the quaternion are there"
            )
        there = np.flatnonzero(~hole[:, 0])
        norm = np.linalg.norm(q[there], axis=1)
        error = np.abs(norm - 1.0)
        if error.size and error.max() > 0.05:
            i = there[np.argmax(error > 0.05)]
            raise ValueError(
                f"recording {path}: column {keys[0]}, row {row[i]}: quaternion "
                f"{np.round(q[i], 4).tolist()}, expected unit length"
            )
        q[there] /= norm[:, None]
        flipped = 0
        for episode in episodes:
            i = there[(there >= episode.first) & (there < episode.last)]
            jumps = np.sum(q[i[1:]] * q[i[:-1]], axis=1) < 0.0
            flipped += int(jumps.sum())
            q[i[1:]] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
        for j, key in enumerate(keys):
            columns[key] = np.ascontiguousarray(q[:, j])
        flips[at], errors[at] = flipped, float(error.max(initial=0.0))
    return flips, errors


def _channel(path, name, values, time, episodes, noise, filters) -> Channel:
    steps = [
        np.diff(time[e.rows][~np.isnan(values[e.rows])]) for e in episodes
    ]  # fmt: skip
    said = filters.get(name, "")
    quantity = name.rsplit(".", 1)[1]
    stages: tuple[Stage, ...] | None = ()
    if name in filters:
        if quantity in COMMANDS:
            raise ValueError(
                f"sidecar of {path}: filters of {name}: a command is known, not "
                "measured: expected a measured channel"
            )
        every = np.concatenate(steps)
        period = float(np.median(every)) if len(every) else np.inf
        try:
            stages = read_filter(name, said, quantity, period)
        except ValueError as error:
            raise ValueError(f"sidecar of {path}: {error}") from None
    text = said if isinstance(said, str) else json.dumps(said)
    if quantity in COMMANDS:  # Known, not measured.
        n, duration = int((~np.isnan(values)).sum()), sum(map(np.sum, steps))
        rate = n / duration if duration > 0.0 else 0.0
        return Channel(name, values, rate_hz=rate)
    # A given zero says nothing that one can weigh by.
    given = max(noise.get(name, 0.0), 0.0)
    channel = Channel(name, values, noise_given=given, filter=text, stages=stages)
    return _with_noise(channel, time, episodes)


def with_noise(recording: Recording) -> Recording:
    """The recording with noise, resolution and rates that its own rows tell."""
    channels = {
        name: c if c.is_command else _with_noise(c, recording.time, recording.episodes)
        for name, c in recording.channels.items()
    }
    return replace(recording, channels=channels)


def in_newton_metres(
    recordings: Iterable[Recording], words: Mapping[str, str]
) -> list[Recording]:
    """Measured efforts that a scene's `channels` say to be currents, as torques."""
    out = []
    for recording in recordings:
        channels = dict(recording.channels)
        for name, channel in recording.channels.items():
            factor = 1.0
            if channel.quantity == "effort_measured":
                factor = torque_constant(words, name)
            if factor != 1.0:
                values = factor * channel.values
                values.setflags(write=False)
                given = abs(factor) * channel.noise_given
                channels[name] = replace(channel, values=values, noise_given=given)
        changed = any(channels[n] is not c for n, c in recording.channels.items())
        other = replace(recording, channels=channels)
        out.append(with_noise(other) if changed else recording)
    return out


def part_of(recording: Recording, pieces: Sequence[Episode]) -> Recording:
    """Pieces of its episodes as a recording of their own, which knows nothing of the
    others: noise and rates are estimated from these rows."""
    return with_noise(_of_pieces(recording, pieces))


def _with_noise(channel: Channel, time, episodes) -> Channel:
    rows, duration = [], 0.0
    for episode in episodes:
        i = np.flatnonzero(~np.isnan(channel.values[episode.rows])) + episode.first
        if len(i) > 1:
            duration += time[i[-1]] - time[i[0]] + np.median(np.diff(time[i]))
        rows.append(i)
    every = np.concatenate(rows)
    rate = len(every) / duration if duration > 0.0 else 0.0
    if not len(every):
        return replace(channel, rate_hz=rate)
    breaks = np.cumsum([len(i) for i in rows])[:-1]
    own = estimate_noise(channel.values[every], breaks, time[every])
    std, source, given = own.std, "estimated", channel.noise_given
    if channel.averaged > 1.0:
        # A mean of many may hold noise that goes together over them.
        std = max(own.std, given / np.sqrt(channel.averaged))
    elif given > 0.0:
        std, source = max(given, own.step / np.sqrt(12.0)), "given"
    return replace(
        channel, noise=std, noise_from=source, noise_pole=own.pole, step=own.step,
        rate_hz=rate,
    )  # fmt: skip


def windows(episode: Episode, time: np.ndarray, length_sec: float) -> Iterator[slice]:
    """Rows of windows of one length [s], one after the other, of an episode."""
    t, first = time[episode.rows], 0
    while first < len(t) - 1:
        last = int(np.searchsorted(t, t[first] + length_sec, side="right"))
        if t[-1] - t[first] < 0.9 * length_sec:
            return
        yield slice(episode.first + first, episode.first + last)
        first = max(last - 1, first + 1)


# Of a long episode: ten blocks of time, of which every third is held out.
PIECE_SEC, PIECE_ROWS, PIECE_FEWEST = 12.0, 20_000, 100


def excerpt(
    recordings: Sequence[Recording], most_sec: float, most_rows: int
) -> list[Recording]:
    """Recordings of no more than so much time [s] and so many rows together, to within
    half a piece.

    Pieces are of 12 s or 20 000 rows, or whole episodes where these are shorter, evenly
    spread. Noise and notes are those of the whole.
    """
    seconds = sum(r.duration_sec() for r in recordings)
    share = min(
        most_sec / max(seconds, 1e-9), most_rows / sum(len(r.time) for r in recordings)
    )
    if share >= 1.0:
        return list(recordings)
    pieces = [
        (i, piece)
        for i, recording in enumerate(recordings)
        for episode in recording.episodes
        for piece in _pieces(recording, episode)
    ]
    n = max(round(share * len(pieces)), 1)
    if n == len(pieces):  # A little too long: nothing is gained by cutting it.
        return list(recordings)
    kept = [pieces[int((k + 0.5) * len(pieces) / n)] for k in range(n)]
    out = []
    for i, recording in enumerate(recordings):
        mine = [piece for j, piece in kept if j == i]
        if mine:
            out.append(_of_pieces(recording, mine))
    return out


def _pieces(recording: Recording, episode: Episode) -> list[Episode]:
    t = recording.time[episode.rows]
    n = min(round((t[-1] - t[0]) / PIECE_SEC), len(t) // PIECE_FEWEST)
    n = max(n, len(t) // PIECE_ROWS, 1)
    edges = np.searchsorted(t, t[0] + (t[-1] - t[0]) * np.arange(1, n) / n)
    edges = np.unique([0, *edges, len(t)])
    return [
        Episode(
            episode.number, episode.first + a, episode.first + b, episode.stretch + k
        )
        for k, (a, b) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        if b - a >= FEWEST_ROWS or n == 1
    ]


def _of_pieces(recording: Recording, pieces: Sequence[Episode]) -> Recording:
    rows = np.concatenate([np.arange(p.first, p.last) for p in pieces])
    ends = np.cumsum([p.last - p.first for p in pieces])
    episodes = tuple(
        Episode(p.number, int(end) - (p.last - p.first), int(end), p.stretch)
        for p, end in zip(pieces, ends, strict=True)
    )

    def of(values: np.ndarray) -> np.ndarray:
        some = values[rows]
        some.setflags(write=False)
        return some

    return replace(
        recording,
        time=of(recording.time),
        row=of(recording.row),
        episodes=episodes,
        channels={
            name: replace(c, values=of(c.values))
            for name, c in recording.channels.items()
        },
    )
