"""The table that a recording is on disk: one column a channel, one row an instant.

    time                                         [s]
    episode                                      optional integer
    <model>.<joint>.position, .velocity, .effort_command, ...
    <model>.<body>.x .y .z .qw .qx .qy .qz       pose in world
    <model>.<body>.vx .vy .vz .wx .wy .wz        velocity in world
    <model>.<frame>.fx .fy .fz .tx .ty .tz       wrench on the robot, in world

SI units; an empty cell (NaN) is a missing sample. docs/recordings.md says the rest.
Rows are counted from 1 in all messages; a csv's first row is the one under its header,
if it has one.
"""

import gzip
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from makebreak.gap.data.arrays import (
    ARRAYS,
    READERS,
    kept_rows,
    spread,
    why_not,
)
from makebreak.gap.data.bags import is_bag, is_dataset, read_bag, read_dataset
from makebreak.gap.data.csv_table import (
    BadRows,
    blocks_of,
    dialect_of,
    header_of,
    open_csv,
    parse,
    size_of,
)

JOINT_QUANTITIES = (
    "position velocity effort_command effort_measured position_command velocity_command"
).split()
COMMANDS = ("effort_command", "position_command", "velocity_command")
POSE = "x y z qw qx qy qz".split()
TWIST = "vx vy vz wx wy wz".split()
WRENCH = "fx fy fz tx ty tz".split()
ANGLES = "roll pitch yaw".split()  # Of a pose, in the place of a quaternion.
QUANTITIES = frozenset([*JOINT_QUANTITIES, *POSE, *ANGLES, *TWIST, *WRENCH])
_TEXTS = (".csv", ".txt", ".tsv", ".dat")
FORMATS = (".csv", ".npz", ".parquet")  # In which tables are written.
_READ = ".csv, .txt, .tsv, .dat (.gz), .npz, .npy, .mat, .json, .jsonl, .parquet"

# More numbers than this are not kept in memory (320 MB): 3.6 h of 14 channels at
# 200 Hz. Of a longer table, evenly spread stretches of rows are.
MOST_CELLS = 40_000_000


@dataclass(frozen=True, eq=False)
class RecordingTable:
    """A table as it was read.

    columns: {name: (n,) float}. row: (n,) number of each row in the file, from 1; it
    jumps where rows were left out. n_rows: rows of the file. notes: (kind, sentence)
    of what was done in reading.
    """

    columns: dict[str, np.ndarray]
    row: np.ndarray
    n_rows: int
    notes: tuple[tuple[str, str], ...] = ()


def is_channel(name: str) -> bool:
    """Whether a column's name is one that a channel of a recording can have."""
    parts = name.split(".")
    return len(parts) >= 3 and parts[-1] in QUANTITIES and all(parts)


def check_columns(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns as 1-D float arrays of one length, `time` first.

    Raises: ValueError, naming the column, for a name that recordings do not have, a
        column of another length, and a time that does not increase in an episode.
    """
    if "time" not in columns:
        raise ValueError(
            f"a recording needs the column time, got {sorted(columns)[:8]}"
        )
    names = ["time", *(["episode"] if "episode" in columns else [])]
    names += [name for name in columns if name not in names]
    table = {name: np.asarray(columns[name], dtype=float) for name in names}
    n = np.size(columns["time"])
    for name, value in table.items():
        if name not in ("time", "episode") and not is_channel(name):
            raise ValueError(
                f'recording column "{name}", expected <model>.<joint, body or frame>.'
                "<one of: " + " ".join(sorted(QUANTITIES)) + ">" + _nearest(name)
            )
        if value.shape != (n,):
            raise ValueError(
                f"recording column {name} is {value.shape}, expected ({n},) as time"
            )
    time, episode = table["time"], table.get("episode", np.zeros(n))
    for name, value in (("time", time), ("episode", episode)):
        if n and not np.isfinite(value).all():
            row = np.flatnonzero(~np.isfinite(value))[0] + 1
            raise ValueError(
                f"recording column {name} is not finite at row {row}: {value[row - 1]}"
            )
    bad = np.flatnonzero(~(np.diff(time) > 0) & (np.diff(episode) == 0))
    if bad.size:
        row = bad[0] + 1
        raise ValueError(
            f"recording column time does not increase at row {row + 1}: "
            f"{time[row]} after {time[row - 1]}"
        )
    return table


def write_recording(
    path: Path, columns: Mapping[str, np.ndarray], noise: Mapping | None = None
) -> list[Path]:
    """Writes the table at `path`, .csv, .npz or .parquet, and noise.json beside it.

    Args:
        path: the file; its suffix chooses the format.
        columns: {column: (n,) array}; NaN is a missing sample: an empty cell.
        noise: what is known of the noise, as JSON; {column: standard deviation}.
    Returns: the files written.
    Raises: ValueError as check_columns, and for another suffix.
    """
    path = Path(path)
    table = check_columns(columns)
    if path.suffix == ".csv":
        path.write_text("\n".join([",".join(table), *csv_rows(table)]) + "\n")
    elif path.suffix == ".npz":
        with path.open("wb") as file:
            np.savez_compressed(file, **table)  # type: ignore[arg-type]
    elif path.suffix == ".parquet":
        arrow = _pyarrow(path)
        as_arrow = {
            name: arrow.array(value, mask=np.isnan(value))
            for name, value in table.items()
        }
        import_module("pyarrow.parquet").write_table(arrow.table(as_arrow), path)
    else:
        raise ValueError(
            f'recording file "{path}", expected a name in {", ".join(FORMATS)}'
        )
    written = [path]
    if noise is not None:
        beside = path.with_name("noise.json")
        beside.write_text(json.dumps(dict(noise), indent=2) + "\n")
        written.append(beside)
    return written


def csv_rows(table: Mapping[str, np.ndarray]) -> list[str]:
    """A table's rows as lines of a csv file; a missing sample is an empty cell."""
    # repr gives the shortest text that reads back as the very same number.
    cells = [
        [str(int(v)) for v in value]
        if name == "episode"
        else ["" if v != v else repr(v) for v in value.tolist()]
        for name, value in table.items()
    ]
    return [",".join(row) for row in zip(*cells, strict=True)]


def suffix_of(path: Path) -> str:
    """In small letters; of a packed file both: .csv.gz."""
    name = path.name.lower()
    if name.endswith(".gz"):
        return Path(name[:-3]).suffix + ".gz"
    return path.suffix.lower()


def is_text(path: Path) -> bool:
    """Whether a file's name says that it is a table in text."""
    return suffix_of(path).removesuffix(".gz") in _TEXTS


def has_table(path: Path) -> bool:
    """Whether a file's name says that it is a table that is read here."""
    return is_text(path) or suffix_of(path) in (*ARRAYS, ".parquet")


def stem_of(path: Path) -> str:
    """The name without what suffix_of gives."""
    return path.name[: len(path.name) - len(suffix_of(path))]


def read_table(
    path: Path,
    most_cells: int = MOST_CELLS,
    bad: BadRows | None = None,
    unused: frozenset[str] = frozenset(),
) -> RecordingTable:
    """Reads a table in text, an npz, mat, HDF5 or parquet file, a bag or a dataset;
    nothing but its numbers is looked at.

    Args:
        path: the file. bad: what to do with rows of a csv that cannot be read; else
            they are refused. unused: columns that may hold anything.
        most_cells: how many numbers are kept. Of a larger table, 20 stretches of rows
            are, evenly spread, the rest is skipped: read, never held.
    Raises: ValueError, one line with the file and where possible column and row.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"recording {path} does not exist")
    if is_bag(path) or is_dataset(path):
        columns, notes = (
            read_bag(path, unused) if is_bag(path)
            else (read_dataset(path, _parquet_columns, unused), [])
        )  # fmt: skip
        n = len(next(iter(columns.values())))
        table = RecordingTable(columns, np.arange(n) + 1, n, tuple(notes))
    else:
        table = _read_file(path, most_cells, bad, unused)
    if not table.row.size:
        raise ValueError(f"recording {path} has a header and no rows")
    return table


def _read_file(
    path: Path, most_cells: int, bad: BadRows | None, unused
) -> RecordingTable:
    suffix = suffix_of(path)
    if path.is_dir() or not has_table(path):
        why = why_not(suffix) or (
            f"expected a name in {_READ}, a bag (.bag, .mcap, .db3, a folder with "
            "metadata.yaml) or a LeRobot dataset (a folder with meta/info.json)"
        )
        raise ValueError(f"recording {path}: {why}")
    if not path.stat().st_size:
        raise ValueError(f"recording {path} is empty")
    if is_text(path):
        return _read_csv(path, most_cells, bad or BadRows(path, False), unused)
    if suffix == ".parquet":
        return _read_parquet(path, most_cells, unused)
    columns, row, n, notes = READERS[suffix](path, most_cells, unused)
    return replace(_columns_of(path, columns, row, n), notes=tuple(notes))


def _parquet_columns(path: Path, unused: frozenset[str]) -> dict[str, np.ndarray]:
    return _read_parquet(path, MOST_CELLS, unused).columns


def _nearest(name: str) -> str:
    """What a wrong column's last part may have been meant to be."""
    close = get_close_matches(name.split(".")[-1], QUANTITIES, n=1, cutoff=0.7)
    return f"; did you mean .{close[0]}?" if close else ""


def _read_csv(path: Path, most_cells: int, bad: BadRows, unused) -> RecordingTable:
    try:
        with open_csv(path) as file:
            header = header_of(file)
            body_start = file.tell()
            sample = file.read(1 << 20)
            dialect = dialect_of(path, header, sample, unused)
            if dialect.headless:
                body_start, sample = body_start - len(header), header + sample
                bad.headless = len(dialect.names)
            names = dialect.columns()
            rows_per_byte = max(sample.count(b"\n"), 1) / max(len(sample), 1)
            # An estimate is enough to choose from; 5 % more costs nothing.
            guess = int(rows_per_byte * (size_of(path) - body_start))
            if guess * len(names) <= 1.05 * most_cells:
                kept = [(0, 1 << 62)]
            else:
                kept = kept_rows(guess, len(names), most_cells)
            file.seek(body_start)
            parts, rows, done = [], [], 0
            for text in blocks_of(file, dialect.quoted):
                n = text.count(b"\n") + (not text.endswith(b"\n"))
                if any(a < done + n and b > done for a, b in kept):
                    values, number = parse(dialect, text, done, bad)
                    for a, b in kept:
                        mine = (number > a) & (number <= b)
                        if mine.any():
                            parts.append(values[mine])
                            rows.append(number[mine])
                done += n
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"recording {path} is no whole gzip file: {error}") from None
    if not parts:
        return RecordingTable(
            {name: np.empty(0) for name in names}, np.empty(0, int), done
        )
    table = np.concatenate(parts)
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}
    return RecordingTable(columns, np.concatenate(rows), done)


def _columns_of(
    path: Path, columns: dict[str, np.ndarray], row, n_rows
) -> RecordingTable:
    for name, value in columns.items():
        if np.isinf(value).any():
            at = row[np.flatnonzero(np.isinf(value))[0]]
            raise ValueError(
                f"recording {path}: column {name}, row {at}: got inf, expected a "
                "finite number, or NaN where there is none"
            )
    return RecordingTable(columns, row, n_rows)


def _read_parquet(path: Path, most_cells: int, unused) -> RecordingTable:
    arrow = _pyarrow(path)
    parquet = import_module("pyarrow.parquet")
    try:
        file = parquet.ParquetFile(path)
    except (arrow.ArrowException, OSError) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"recording {path} is no parquet file: {first}") from None
    kind, names = arrow.types, []
    for field in file.schema_arrow:
        if field.name in unused:
            continue
        inner = field.type
        while kind.is_list(inner) or kind.is_fixed_size_list(inner):
            inner = inner.value_type
        if not (
            kind.is_integer(inner) or kind.is_floating(inner) or kind.is_null(inner)
            or kind.is_boolean(inner) or kind.is_timestamp(field.type)
        ):  # fmt: skip
            raise ValueError(
                f"recording {path}: column {field.name} is of type {field.type}, "
                "expected numbers (to leave it out, map it to null in the sidecar)"
            )
        names.append(field.name)
    n = file.metadata.num_rows
    kept = kept_rows(n, len(names), most_cells)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    done = 0
    for batch in file.iter_batches(batch_size=1 << 16, columns=names):
        for a, b in kept:
            a, b = max(a - done, 0), min(b - done, batch.num_rows)
            if a < b:
                for name, value in zip(names, batch.columns, strict=True):
                    parts[name].append(
                        _numbers(path, arrow, name, value.slice(a, b - a))
                    )
        done += batch.num_rows
    empty = [np.empty(0)]
    columns: dict[str, np.ndarray] = {}
    for name, part in parts.items():
        value = np.concatenate(part or empty)
        columns |= {name: value} if value.ndim == 1 else spread(name, value)
    row = np.concatenate([np.arange(a, b) for a, b in kept]) + 1
    return _columns_of(path, columns, row, n)


def _numbers(path: Path, arrow, name: str, value) -> np.ndarray:
    """(n,) of a column, or (n, k) of one of lists; dates in seconds since 1970."""
    if arrow.types.is_timestamp(value.type):
        ns = value.cast(arrow.timestamp("ns", value.type.tz)).cast(arrow.int64())
        return 1e-9 * ns.to_numpy(zero_copy_only=False)
    if arrow.types.is_list(value.type) or arrow.types.is_fixed_size_list(value.type):
        rows = value.to_pylist()
        k = max((len(row) for row in rows if row is not None), default=0)
        if any(row is not None and len(row) != k for row in rows):
            raise ValueError(
                f"recording {path}: column {name} has lists of different lengths"
            )
        full = [[np.nan] * k if row is None else row for row in rows]
        return np.array(full, float).reshape(len(rows), -1)
    return value.cast(arrow.float64()).to_numpy(zero_copy_only=False)


def _pyarrow(path: Path) -> ModuleType:
    """The module, loaded when it is needed: it is an optional extra."""
    try:
        return import_module("pyarrow")
    except ImportError:
        raise ValueError(
            f"recording {path}: parquet needs pyarrow: pip install 'makebreak[parquet]'"
        ) from None
