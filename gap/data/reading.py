"""Recordings read from tables and their sidecars, and checked."""

import json
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from makebreak.gap.data.channel_noise import noise_told
from makebreak.gap.data.csv_table import BadRows
from makebreak.gap.data.episodes import (
    broken_at_holes,
    counted_parts,
    episodes_of,
    without_ignored,
)
from makebreak.gap.data.filters import read_filter
from makebreak.gap.data.joined import read_joined
from makebreak.gap.data.quaternions import mend_quaternions, with_quaternions
from makebreak.gap.data.recording import Channel, Episode, Recording
from makebreak.gap.data.sidecar import read_sidecars, renamed, sidecar_of
from makebreak.gap.data.stamps import mended
from makebreak.gap.data.table import (
    COMMANDS,
    JOINT_QUANTITIES,
    MOST_CELLS,
    check_columns,
    is_channel,
    stem_of,
)
from makebreak.gap.data.turns import without_turns

MOST_VALUE = 1e12  # In SI units nothing that a robot measures is larger.
_TIME_UNITS = ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"), (0.0, "no unit of time"))


def read_recordings(
    paths: Iterable[str | Path],
    skip_bad_rows: bool = False,
    sidecars: Mapping[Path, Path] | None = None,
    slides: Container[str] = (),
) -> list[Recording]:
    """Several recordings, with names that tell them apart. Their time counts from the
    first row: a clock that runs fast does so from there, and not since 1970.

    Args: skip_bad_rows: as of read_recording. sidecars: {recording: sidecar}, where it
        is not beside it. slides: `<model>.<joint>` of joints that have no turns.
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
    each = [
        read_recording(
            path, name, MOST_CELLS, skip_bad_rows, (sidecars or {}).get(path), slides
        )
        for path, name in zip(files, stems, strict=True)
    ]
    each = [replace(recording, time=recording.time - recording.time[0])
            for recording in each]  # fmt: skip
    return where_known(each)


def read_recording(
    path: str | Path,
    name: str | None = None,
    most_cells: int = MOST_CELLS,
    skip_bad_rows: bool = False,
    sidecar_path: Path | None = None,
    slides: Container[str] = (),
) -> Recording:
    """Reads a .csv, .npz or .parquet table, and what its sidecars say of it.

    Quaternions are given unit length and one sign without jumps; what was done is in
    the recording's fields and notes.

    Args: skip_bad_rows: rows that cannot be read, that hold numbers beyond 1e12, or
        whose time does not increase, are left out and counted in a note. sidecar_path:
        in place of the one beside it. slides: as of read_recordings.
    Raises: ValueError: one line with file, column, row, what came, what was expected.
    """
    path = Path(path)
    sidecar = read_sidecars(path, sidecar_path)
    bad = BadRows(path, skip_bad_rows)
    columns, row, n_rows, done, is_excerpt = _read_columns(
        path, sidecar, most_cells, bad
    )
    number = columns.get("episode")
    try:
        columns = check_columns(
            columns | {"episode": counted_parts(columns, row, is_excerpt)}
        )
    except ValueError as error:
        raise ValueError(_with_rows(path, error, row)) from None
    time, part = columns.pop("time"), columns.pop("episode")
    if not columns:
        raise ValueError(f"recording {path} has no channel beside time")
    episodes = episodes_of(path, number, part, time, row)
    episodes, notes = broken_at_holes(path, episodes, time)
    spans = sidecar.get("ignore") or []
    episodes, more = without_ignored(path, episodes, time, spans)
    notes = [*done, *notes, *more, *_without_empty(path, columns)]
    notes += _without_turns(path, columns, episodes, slides)
    columns = with_quaternions(columns)
    flips, norm_errors = mend_quaternions(path, columns, episodes, row)
    if is_excerpt:
        says = f"{path.name} has {n_rows} rows, too many to hold: {len(time)} of them "
        says += "are used, in evenly spread stretches"
        notes.append(("rows_left_out", says))
    notes += bad.note()
    return Recording(
        name=name or stem_of(path),
        path=path,
        time=time,
        row=row,
        episodes=episodes,
        channels=_channels(path, columns, time, episodes, sidecar),
        n_rows_in_file=n_rows,
        provenance=str(sidecar.get("provenance") or ""),
        notes=tuple(notes),
        wrenches=sidecar.get("wrench") or {},
        quaternion_flips=flips,
        quaternion_norm_error=norm_errors,
    )


def where_known(recordings: Sequence[Recording]) -> list[Recording]:
    """The recordings without episodes in which a joint that was measured, or driven, in
    others has no sample of its position, or of what drove it; it is said. Commands
    are what drives a joint, or a measured effort where there is none.

    Raises: ValueError where nothing is left.
    """
    needed: dict[str, None] = {}
    for name in dict.fromkeys(name for r in recordings for name in r.channels):
        at, _, quantity = name.rpartition(".")
        if quantity in (*COMMANDS, "position"):
            needed[name] = None
        elif quantity == "effort_measured" and not any(
            f"{at}.{command}" in r for r in recordings for command in COMMANDS
        ):
            needed[name] = None
    out, said = [], list[tuple[str, str]]()
    for r in recordings:
        kept = []
        for e in r.episodes:
            lost = [n for n in needed if not _has(r, n, e)]
            if not lost:
                kept.append(e)
                continue
            is_whole = not any(_has(r, lost[0], other) for other in r.episodes)
            which = "" if is_whole else f", episode {e.number},"
            says = f"{r.path.name}{which} has no sample of {', '.join(lost)}, which "
            said.append(("channel_missing", says + "others have: it is left out"))
        if kept:
            out.append(replace(r, episodes=tuple(kept)))
    if not out:
        raise ValueError(f"no episode has samples of all of {', '.join(needed)}")
    for r in out:
        for name in dict.fromkeys(n for other in out for n in other.channels):
            none = [e.number for e in r.episodes if not _has(r, name, e)]
            if none and any(_has(o, name, e) for o in out for e in o.episodes):
                where = r.path.name
                if len(r.episodes) > 1:
                    where += f", episode {', '.join(map(str, none[:5]))},"
                says = f"{where} has no sample of {name}, which others have: it is used"
                said.append(("channel_missing", f"{says} without"))
    first = replace(out[0], notes=(*out[0].notes, *dict.fromkeys(said)))
    return [first, *out[1:]]


def _has(recording: Recording, name: str, episode: Episode) -> bool:
    """Whether a channel has any sample in an episode."""
    return name in recording and bool(np.isfinite(recording[name][episode.rows]).any())


def _read_columns(
    path: Path, sidecar: Mapping, most_cells: int, bad: BadRows
) -> tuple[dict[str, np.ndarray], np.ndarray, int, Sequence[tuple[str, str]], bool]:
    """Columns under our names, (n,) numbers of their rows in the file, how many rows
    that has, notes of what was done, and whether not all rows could be kept; time is
    there, in seconds, and increases in each episode."""
    names = sidecar.get("columns") or {}
    unused = frozenset(str(name) for name, to in names.items() if to is None)
    table, _ = read_joined(path, sidecar, most_cells, bad)
    is_excerpt = len(table.row) + bad.count < table.n_rows
    columns = renamed(path, table.columns, names, unused)
    _check_time(path, columns)
    columns, row = _without_bad_rows(columns, table.row, bad)
    _check_sizes(path, columns, row)
    columns, row, notes = mended(path.name, columns, row)
    return columns, row, table.n_rows, (*table.notes, *notes), is_excerpt


def _check_time(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Raises: ValueError where there is no time, or it is not in seconds."""
    sidecar = sidecar_of(path).name
    if "time" not in columns:
        shown = ", ".join(list(columns)[:8]) + (", ..." if len(columns) > 8 else "")
        raise ValueError(
            f"recording {path} needs the column time, got {shown}; `makebreak inspect` "
            f"proposes names; or give the time column in {sidecar}: "
            "columns: {t: time}"
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


def _without_bad_rows(
    columns: dict[str, np.ndarray], row: np.ndarray, bad: BadRows
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns and row numbers without rows that hold what nothing measures, where such
    are left out."""
    if not bad.skip:
        return columns, row
    good = np.ones(len(row), bool)
    for name, value in columns.items():
        for k in np.flatnonzero(good & (np.abs(value) > MOST_VALUE)):
            bad.add(f"column {name}, row {row[k]}: got {value[k]:.4g}")
            good[k] = False
    return {name: value[good] for name, value in columns.items()}, row[good]


def _without_empty(path: Path, columns: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Takes columns without any sample out of the table, in place, and says so."""
    empty = [name for name, value in columns.items() if np.isnan(value).all()]
    for name in empty:
        del columns[name]
    if not columns:
        raise ValueError(f"recording {path}: no column beside time has any number")
    return [
        ("channel_empty", f"{path.name}: {name} has no sample at all and is left out")
        for name in empty
    ]


def _without_turns(path: Path, columns, episodes, slides) -> list[tuple[str, str]]:
    """Undoes jumps of joints' positions by whole turns, in place, and says so."""
    notes = []
    for name, value in columns.items():
        at, _, what = name.rpartition(".")
        if what not in ("position", "position_command") or at in slides:
            continue
        n = 0
        for e in episodes:
            columns[name][e.rows], more = without_turns(value[e.rows])
            n += more
        if n:
            says = (
                f"{path.name}: {name} jumps by a whole turn {n} times; that was undone"
            )
            notes.append(("position_turns", says))
    return notes


def _check_sizes(path: Path, columns: Mapping[str, np.ndarray], row: np.ndarray):
    """Raises: ValueError for a number that nothing measures."""
    for name, value in columns.items():
        bad = np.flatnonzero(np.abs(value) > MOST_VALUE)
        if bad.size:
            raise ValueError(
                f"recording {path}: column {name}, row {row[bad[0]]}: got "
                f"{value[bad[0]]:.4g}, expected a number in SI units, of less than "
                f"{MOST_VALUE:g}"
            )


def _with_rows(path: Path, error: ValueError, row: np.ndarray) -> str:
    """The message about a column, with the file's name."""
    text = str(error).removeprefix("a recording ").removeprefix("recording ")
    if len(row) and row[-1] != len(row):
        text += " (rows counted among those that are used)"
    return f"recording {path}: {text}"


def _channels(
    path: Path,
    columns: Mapping[str, np.ndarray],
    time: np.ndarray,
    episodes: Sequence[Episode],
    sidecar: Mapping,
) -> dict[str, Channel]:
    """The columns, with noise and filters. They and time become read-only."""
    noise, filters = sidecar.get("noise") or {}, sidecar.get("filters") or {}
    for section, known in (("noise", noise), ("filters", filters)):
        # noise.json may speak of several recordings.
        _check_names(path, section, known, columns, sidecar.get("own", ()))
    for value in (time, *columns.values()):
        value.setflags(write=False)
    channels = {}
    for name, values in columns.items():
        periods = [np.diff(time[e.rows][~np.isnan(values[e.rows])]) for e in episodes]
        stages = _stages(path, name, filters, np.concatenate(periods))
        channel = Channel(name, values)
        if channel.is_command:  # Known, not measured.
            n, duration = int((~np.isnan(values)).sum()), sum(map(np.sum, periods))
            rate = n / duration if duration > 0.0 else 0.0
            channels[name] = replace(channel, rate_hz=rate)
            continue
        said = filters.get(name, "")
        text = said if isinstance(said, str) else json.dumps(said)
        # A given zero says nothing that one can weigh by.
        given = max(noise.get(name, 0.0), 0.0)
        channel = replace(channel, noise_given=given, filter=text, stages=stages)
        channels[name] = noise_told(channel, time, episodes)
    return channels


def _check_names(path: Path, section: str, names, columns, own) -> None:
    """Raises: ValueError where a sidecar speaks of what is no channel, or, in the
    recording's `own` sidecar, of one that the recording lacks."""
    for name in names:
        if name in columns or (is_channel(name) and name not in own):
            continue
        close = get_close_matches(name, columns, n=1, cutoff=0.5)
        hint = f'; did you mean "{close[0]}"?' if close else ""
        what = "expected the name of a channel"
        if is_channel(name):
            what = "which the recording does not have"
        raise ValueError(f'sidecar of {path}: {section} of "{name}", {what}{hint}')


def _stages(path: Path, name: str, filters: Mapping, periods: np.ndarray):
    """What the sidecar says of the sensor's filter; periods (m,) of its samples [s]."""
    if name not in filters:
        return ()
    quantity = name.rsplit(".", 1)[1]
    if quantity in COMMANDS:
        raise ValueError(
            f"sidecar of {path}: filters of {name}: a command is known, not "
            "measured: expected a measured channel"
        )
    period = float(np.median(periods)) if len(periods) else np.inf
    try:
        return read_filter(name, filters[name], quantity, period)
    except ValueError as error:
        raise ValueError(f"sidecar of {path}: {error}") from None


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
