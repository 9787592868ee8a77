"""Tables of one recording that lie in several files, as one table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from makebreak.gap.data.csv_table import BadRows, is_nameless, text_columns
from makebreak.gap.data.proposal import find_time
from makebreak.gap.data.stamps import is_backward, is_part_of, mended, whole_stamp
from makebreak.gap.data.table import MOST_CELLS, RecordingTable, is_text, read_table


def read_joined(
    path: Path,
    sidecar: Mapping,
    most_cells: int = MOST_CELLS,
    bad: BadRows | None = None,
    with_text: bool = False,
) -> tuple[RecordingTable, dict[str, str]]:
    """The table of a file and of those that its sidecar joins to it; and columns of
    text with what is in all their cells.

    Args: sidecar: as read_sidecars gives it. with_text: whether columns of text are
        left out, rather than refused.
    Raises: ValueError, one line.
    """
    names = sidecar.get("columns") or {}
    timed = _time_column(names)
    unused = frozenset(
        str(name) for name, to in names.items()
        if to is None and not is_part_of(timed, str(name))
    )  # fmt: skip
    tables, text = [], dict[str, str]()
    for file in (path, *(sidecar.get("join") or ())):
        own = {name.removeprefix(f"{file.name}:") for name in unused}
        if with_text and is_text(file) and file.is_file():
            more = text_columns(file)
            text |= {n if n not in text else f"{file.name}:{n}": x
                     for n, x in more.items()}  # fmt: skip
            own |= {*more}
        table = read_table(file, most_cells, bad, frozenset(own))
        stamp = whole_stamp(table.columns)
        if stamp is not None and (timed == stamp[0] or timed not in table.columns):
            columns = {stamp[0]: stamp[1], **table.columns}
            says = f"{file.name}: time is {stamp[0]}, of its seconds and nanoseconds"
            notes = (*table.notes, ("stamps_of_two_columns", says))
            table = replace(table, columns=columns, notes=notes)
        found = find_time(table.columns)
        if found is None and (rate := sidecar.get("rate_hz")):
            columns = {"time": (table.row - 1) / rate, **table.columns}
            table = replace(table, columns=columns)
        if found is not None and is_backward(table.columns[found.column]):
            says = f"{file.name}: the newest row comes first; they are turned round"
            table = replace(
                table, columns={k: y[::-1] for k, y in table.columns.items()},
                row=table.row[::-1], notes=(*table.notes, ("stamps_back", says)),
            )  # fmt: skip
        tables.append((file, table))
    if len(tables) == 1:
        return tables[0][1], text
    return joined(*tables[0], tables[1:], _time_column(names)), text


def _time_column(names: Mapping) -> str:
    """The name that a log gives its time; names: the sidecar's `columns`."""
    for foreign, target in names.items():
        ours = target.get("channel") if isinstance(target, dict) else target
        if ours == "time":
            return str(foreign)
    return "time"


def in_rows_of(table: RecordingTable, other: RecordingTable) -> int:
    """How many numbers the one column without a name of another file has for each row,
    as programs write that print number by number; 0 where it has not."""
    k, rest = divmod(len(other.row), max(len(table.row), 1))
    return k if [*map(is_nameless, other.columns)] == [True] and not rest else 0


def joined(
    path: Path,
    table: RecordingTable,
    others: Sequence[tuple[Path, RecordingTable]],
    time: str,
) -> RecordingTable:
    """One table with a row for each stamp that any of the files has; what a file does
    not have there is missing (NaN).

    Args: others: files beside `path` and their tables; a name that is taken already is
        `<file>:<name>` in the result. time: the stamps' column, of one clock in all
        of them; where a file has no such column, the one that looks like a time, or
        that of `path` where it has as many rows.
    Raises: ValueError where a file lacks it, or its time starts again.
    """
    known = [time] if time in table.columns else table.columns
    first = find_time({name: table.columns[name] for name in known})
    unit, time = (1.0, time) if first is None else (first.scale, first.column)
    tables, notes = [], []
    for file, each in ((path, table), *others):
        own = {f"{file.name}:{name}" if file != path and is_nameless(name) else name: y
               for name, y in each.columns.items()}  # fmt: skip
        if time not in own:
            found = find_time(own)
            k = in_rows_of(table, each) if time in table.columns else 0
            if found is not None:
                own = {time: own.pop(found.column) * (found.scale / unit), **own}
            elif k:
                ((name, y),) = own.items()
                own = {f"{name[:-1]}{i + 1}": y[i::k] for i in range(k)}
                own, each = {time: table.columns[time], **own}, table
            elif time in table.columns and len(each.row) == len(table.row):
                own = {time: table.columns[time], **own}
            else:
                raise ValueError(
                    f"recording {file} needs the column {time} to be joined"
                )
        own, row, more = mended(file.name, own, each.row, time)
        if "episode" in own:
            raise ValueError(
                f"recording {file}: {time} starts again, or it has episodes, which a "
                "file to be joined must not"
            )
        tables.append((file, replace(each, columns=own, row=row)))
        notes += more
    table = tables[0][1]
    stamps = np.unique(np.concatenate([each.columns[time] for _, each in tables]))
    columns: dict[str, np.ndarray] = {time: stamps}
    for file, each in tables:
        at = np.searchsorted(stamps, each.columns[time])
        for name, value in each.columns.items():
            if name == time:
                continue
            whole = np.full(len(stamps), np.nan)
            whole[at] = value
            columns[f"{file.name}:{name}" if name in columns else name] = whole
    # A row that only another file has is told as the row before it.
    last = np.searchsorted(table.columns[time], stamps, "right") - 1
    row = table.row[np.maximum(last, 0)]
    n = max(table.n_rows, len(stamps))
    return RecordingTable(columns, row, n, (*table.notes, *notes))
