"""Tables of one recording that lie in several files, as one table."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from makebreak.gap.data.table import RecordingTable


def time_column(names: Mapping) -> str:
    """The name that a log gives its time; names: the sidecar's `columns`."""
    for foreign, target in names.items():
        ours = target.get("channel") if isinstance(target, dict) else target
        if ours == "time":
            return str(foreign)
    return "time"


def joined(
    path: Path,
    table: RecordingTable,
    others: Sequence[tuple[Path, RecordingTable]],
    time: str,
) -> RecordingTable:
    """One table with a row for each stamp that any of the files has; what a file does
    not have there is missing (NaN).

    Args: others: files beside `path` and their tables; a name that is taken already is
        `<file>:<name>` in the result. time: the stamps' column, of the same name, unit
        and clock in all of them.
    Raises: ValueError where a file lacks it, or its stamps do not increase.
    """
    for file, each in ((path, table), *others):
        if time not in each.columns:
            raise ValueError(f"recording {file} needs the column {time} to be joined")
        stamps = each.columns[time]
        if not (np.diff(stamps) > 0.0).all():
            k = int(np.argmin(np.diff(stamps) > 0.0))
            raise ValueError(
                f"recording {file}: column {time}, row {each.row[k + 1]}: "
                f"{stamps[k + 1]:.9g} does not increase, which a file to be joined must"
            )
    stamps = np.unique(
        np.concatenate([t.columns[time] for t in (table, *(t for _, t in others))])
    )
    columns: dict[str, np.ndarray] = {time: stamps}
    for file, each in ((path, table), *others):
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
    return RecordingTable(columns, row, max(table.n_rows, len(stamps)))
