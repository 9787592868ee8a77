"""The table that a recording is on disk: one column a channel, one row an instant.

    time                                         [s]
    episode                                      optional integer
    <model>.<joint>.position, .velocity, .effort_command, ...
    <model>.<body>.x .y .z .qw .qx .qy .qz       pose in world
    <model>.<body>.vx .vy .vz .wx .wy .wz        velocity in world
    <model>.<frame>.fx .fy .fz .tx .ty .tz       wrench on the robot, in world

SI units; an empty cell (NaN) is a missing sample. docs/recordings.md says the rest.
Rows are counted from 1 in all messages; a csv's first row is the one under its header.
"""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from io import BytesIO
from pathlib import Path
from types import ModuleType

import numpy as np

JOINT_QUANTITIES = (
    "position velocity effort_command effort_measured position_command velocity_command"
).split()
COMMANDS = ("effort_command", "position_command", "velocity_command")
POSE = "x y z qw qx qy qz".split()
TWIST = "vx vy vz wx wy wz".split()
WRENCH = "fx fy fz tx ty tz".split()
QUANTITIES = frozenset([*JOINT_QUANTITIES, *POSE, *TWIST, *WRENCH])
FORMATS = (".csv", ".npz", ".parquet")

# More numbers than this are not kept in memory (320 MB): 3.6 h of 14 channels at
# 200 Hz. Of a longer table, evenly spread stretches of rows are.
MOST_CELLS = 40_000_000
STRETCHES = 20
_BLOCK = 1 << 23  # [bytes] of text that are parsed at a time.


@dataclass(frozen=True, eq=False)
class Table:
    """A table as it was read.

    columns: {name: (n,) float}. row: (n,) number of each row in the file, from 1; it
    jumps where rows were left out. n_rows: rows of the file.
    """

    columns: dict[str, np.ndarray]
    row: np.ndarray
    n_rows: int


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
        raise ValueError(f"a recording needs the column time, got {sorted(columns)}")
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
        # repr gives the shortest text that reads back as the very same number.
        cells = [
            [str(int(v)) for v in value]
            if name == "episode"
            else ["" if v != v else repr(v) for v in value.tolist()]
            for name, value in table.items()
        ]
        rows = [",".join(row) for row in zip(*cells, strict=True)]
        path.write_text("\n".join([",".join(table), *rows]) + "\n")
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


def read_table(path: Path, most_cells: int = MOST_CELLS) -> Table:
    """Reads a csv, npz or parquet file; nothing but its numbers is looked at.

    Args:
        path: the file.
        most_cells: how many numbers are kept. Of a larger table, 20 stretches of rows
            are, evenly spread, the rest is skipped: read, never held.
    Raises: ValueError, one line with the file and where possible column and row.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"recording {path} does not exist")
    if path.suffix not in FORMATS:
        raise ValueError(f"recording {path}: expected a name in {', '.join(FORMATS)}")
    if not path.stat().st_size:
        raise ValueError(f"recording {path} is empty")
    read = {".csv": _read_csv, ".npz": _read_npz, ".parquet": _read_parquet}
    table = read[path.suffix](path, most_cells)
    if not table.row.size:
        raise ValueError(f"recording {path} has a header and no rows")
    return table


def _nearest(name: str) -> str:
    """What a wrong column's last part may have been meant to be."""
    close = get_close_matches(name.split(".")[-1], QUANTITIES, n=1, cutoff=0.7)
    return f"; did you mean .{close[0]}?" if close else ""


def _kept_rows(n_rows: int, n_columns: int, most_cells: int) -> list[tuple[int, int]]:
    """[first, last) rows, from 0, that are kept of a table of n_rows."""
    most_rows = max(most_cells // max(n_columns, 1), STRETCHES)
    if n_rows <= most_rows:
        return [(0, n_rows)]
    length, every = most_rows // STRETCHES, n_rows / STRETCHES
    starts = [int((i + 0.5) * every - 0.5 * length) for i in range(STRETCHES)]
    return [(start, start + length) for start in starts]


def _read_csv(path: Path, most_cells: int) -> Table:
    with path.open("rb") as file:
        names = _csv_header(path, file.readline())
        body_start = file.tell()
        sample = file.read(1 << 20)
        rows_per_byte = max(sample.count(b"\n"), 1) / max(len(sample), 1)
        body_bytes = path.stat().st_size - body_start
        # An estimate is enough to choose from; 5 % more costs nothing.
        guess = int(rows_per_byte * body_bytes)
        if guess * len(names) <= 1.05 * most_cells:
            kept = [(0, 1 << 62)]
        else:
            kept = _kept_rows(guess, len(names), most_cells)
        file.seek(body_start)
        parts, rows, done, rest = [], [], 0, b""
        while True:
            block = file.read(_BLOCK)
            text = rest + block
            if block:
                cut = text.rfind(b"\n") + 1
                text, rest = text[:cut], text[cut:]
            text = text.replace(b"\r\n", b"\n")
            while b"\n\n" in text or text[:1] == b"\n":
                text = text.replace(b"\n\n", b"\n").removeprefix(b"\n")
            if text and not text.endswith(b"\n"):
                text += b"\n"
            n = text.count(b"\n")
            wanted = [(max(a - done, 0), min(b - done, n)) for a, b in kept]
            wanted = [(a, b) for a, b in wanted if a < b]
            if wanted:
                values = _csv_block(path, names, text, done)
                for a, b in wanted:
                    parts.append(values[a:b])
                    rows.append(np.arange(done + a, done + b) + 1)
            done += n
            if not block:
                break
    if not parts:
        return Table({name: np.empty(0) for name in names}, np.empty(0, int), done)
    table = np.concatenate(parts)
    columns = {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}
    return Table(columns, np.concatenate(rows), done)


def _csv_header(path: Path, line: bytes) -> list[str]:
    try:
        text = line.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        raise ValueError(f"recording {path} is no text: expected a csv table") from None
    names = [name.strip().strip('"') for name in text.split(",")]
    if len(names) == 1 and (";" in text or "\t" in text):
        raise ValueError(f"recording {path}: columns must be separated by commas")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'recording {path}: column "{name}" is there twice')
    return names


def _csv_block(path: Path, names: list[str], text: bytes, done: int) -> np.ndarray:
    """(rows, columns) of whole lines; `done` rows came before them."""
    filled = text.replace(b",,", b",nan,").replace(b",,", b",nan,")
    filled = filled.replace(b",\n", b",nan\n").replace(b"\n,", b"\nnan,")
    if filled.startswith(b","):
        filled = b"nan" + filled
    try:
        values = np.loadtxt(BytesIO(filled), delimiter=",", ndmin=2, comments=None)
        if values.shape[1] == len(names) and not np.isinf(values).any():
            return values
    except (ValueError, UnicodeDecodeError):
        pass
    # Something is wrong with this block: found at leisure.
    for i, line in enumerate(filled.decode(errors="replace").splitlines()):
        cells, row = line.split(","), done + i + 1
        if len(cells) != len(names):
            raise ValueError(
                f"recording {path}: row {row} has {len(cells)} cells, expected "
                f"{len(names)} as the header"
            )
        for name, cell in zip(names, cells, strict=True):
            try:
                good = abs(float(cell)) != np.inf
            except ValueError:
                good = False
            if not good:
                raise ValueError(
                    f'recording {path}: column {name}, row {row}: got "{cell.strip()}",'
                    " expected a finite number, or an empty cell where there is none"
                )
    raise ValueError(f"recording {path} cannot be read near row {done + 1}")


def _columns_of(path: Path, columns: dict[str, np.ndarray], row, n_rows) -> Table:
    for name, value in columns.items():
        if np.isinf(value).any():
            at = row[np.flatnonzero(np.isinf(value))[0]]
            raise ValueError(
                f"recording {path}: column {name}, row {at}: got inf, expected a "
                "finite number, or NaN where there is none"
            )
    return Table(columns, row, n_rows)


def _read_npz(path: Path, most_cells: int) -> Table:
    try:
        with np.load(path, allow_pickle=False) as file:
            names = list(file)
            if not names:
                raise ValueError(f"recording {path} has no columns")
            columns, n, row = {}, -1, np.empty(0, int)
            for name in names:
                value = file[name]
                if value.ndim != 1 or value.dtype.kind not in "iufb":
                    raise ValueError(
                        f"recording {path}: column {name} is {value.shape} of "
                        f"{value.dtype}, expected one number a row"
                    )
                if n < 0:
                    n = len(value)
                    kept = _kept_rows(n, len(names), most_cells)
                    row = np.concatenate([np.arange(a, b) for a, b in kept]) + 1
                if len(value) != n:
                    raise ValueError(
                        f"recording {path}: column {name} has {len(value)} rows, "
                        f"{names[0]} has {n}"
                    )
                columns[name] = value[row - 1].astype(float)
    except (OSError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"recording {path} is no npz file: {error}") from None
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"recording {path} is no npz of numbers: {error}") from None
    return _columns_of(path, columns, row, n)


def _read_parquet(path: Path, most_cells: int) -> Table:
    arrow = _pyarrow(path)
    parquet = import_module("pyarrow.parquet")
    try:
        file = parquet.ParquetFile(path)
    except (arrow.ArrowException, OSError) as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"recording {path} is no parquet file: {first}") from None
    for field in file.schema_arrow:
        kind = arrow.types
        if not (
            kind.is_integer(field.type)
            or kind.is_floating(field.type)
            or kind.is_null(field.type)
        ):
            raise ValueError(
                f"recording {path}: column {field.name} is of type {field.type}, "
                "expected numbers"
            )
    names, n = file.schema_arrow.names, file.metadata.num_rows
    kept = _kept_rows(n, len(names), most_cells)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    done = 0
    for batch in file.iter_batches(batch_size=1 << 16):
        for a, b in kept:
            a, b = max(a - done, 0), min(b - done, batch.num_rows)
            if a < b:
                for name, value in zip(names, batch.columns, strict=True):
                    piece = value.slice(a, b - a).cast(arrow.float64())
                    parts[name].append(piece.to_numpy(zero_copy_only=False))
        done += batch.num_rows
    empty = [np.empty(0)]
    columns = {name: np.concatenate(part or empty) for name, part in parts.items()}
    row = np.concatenate([np.arange(a, b) for a, b in kept]) + 1
    return _columns_of(path, columns, row, n)


def _pyarrow(path: Path) -> ModuleType:
    """The module, loaded when it is needed: it is an optional extra."""
    try:
        return import_module("pyarrow")
    except ImportError:
        raise ValueError(
            f"recording {path}: parquet needs pyarrow: pip install 'makebreak[parquet]'"
        ) from None
