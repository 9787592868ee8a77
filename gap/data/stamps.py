"""Rows whose stamps do not increase: put right where that is clear, and said.

Time that starts again is another episode. Rows that come late are sorted; a stamp that
does not fit the motion is left out with its row. Rows of one stamp are one row, or,
where most stamps are shared, stamps are coarser than rows and spread.
"""

import re
from bisect import bisect_right
from collections.abc import Mapping

import numpy as np

_AROUND = 10  # Rows before and after a step back, of which most tell a new start.
COARSE = 0.2  # Share of rows with the stamp of another and other values.

Columns = dict[str, np.ndarray]
Notes = list[tuple[str, str]]


def mended(
    name: str, columns: Mapping[str, np.ndarray], row: np.ndarray, time: str = "time"
) -> tuple[Columns, np.ndarray, Notes]:
    """Columns (n,) and row numbers in which time increases in each episode.

    Args: name: of the log, for notes; columns with `time`, and `episode` if there is
        one; row (n,): of each in the file.
    """
    columns, notes = dict(columns), Notes()
    known = np.isfinite(columns[time])
    if not known.all() and known.any():
        says = f"{name}: {(~known).sum()} rows have no time and are left out"
        notes.append(("stamps_missing", says))
        columns, row = {k: y[known] for k, y in columns.items()}, row[known]
    values = [y for k, y in columns.items() if k not in (time, "episode")]
    off = np.all([(y == 0.0) | np.isnan(y) for y in values], axis=0)
    off &= np.cumsum(~off) == 0
    if values and _AROUND < off.sum() < len(off):
        says = f"{name}: {off.sum()} rows at the start have zero throughout, as before "
        notes.append(("rows_of_zeros", f"{says}power is on: they are left out"))
        columns, row = {k: y[~off] for k, y in columns.items()}, row[~off]
    t, own = columns[time], columns.get("episode", np.zeros(len(row)))
    if (np.diff(t)[np.diff(own) == 0] > 0.0).all():
        return columns, row, notes
    starts = _starts(t) & np.append(False, np.diff(own) == 0)
    if starts.any():
        part = np.cumsum(starts | np.append(False, np.diff(own) != 0))
        columns["episode"] = own = part.astype(float)
        says = f"{name}: time starts again {starts.sum()} times, first at row "
        says += f"{row[starts][0]}: what follows is an episode of its own"
        notes.append(("time_restarts", says))
    edges = np.append(np.flatnonzero(np.diff(own, prepend=np.nan) != 0), len(row))
    parts, late, lies, twice, others, coarse = [], [], 0, 0, 0, 0
    for first, end in zip(edges[:-1], edges[1:], strict=True):
        mine = {k: y[first:end] for k, y in columns.items()}
        order, is_late = _order(mine, time)
        late += [row[first + k] for k in is_late]
        lies += end - first - len(order)
        kept = {k: y[order] for k, y in mine.items()}
        kept, where, same, other, is_coarse = _once(kept, time)
        twice, others = twice + same, others + other
        coarse += is_coarse
        parts.append((kept, row[first:end][order][where]))
    columns = {k: np.concatenate([kept[k] for kept, _ in parts]) for k in columns}
    row = np.concatenate([each for _, each in parts])
    if late:
        says = f"{name}: {len(late)} rows come after later ones (row {late[0]}); they "
        notes.append(("stamps_back", f"{says}are put in the order of their stamps"))
    if lies:
        says = f"{name}: {lies} stamps step back or ahead and do not fit the motion: "
        notes.append(("stamps_back", f"{says}their rows are left out"))
    if twice:
        says = f"{name}: {twice} rows are the row before once more (time and all "
        notes.append(("rows_twice", f"{says}values): left out"))
    if coarse:
        says = (
            f"{name}: several rows share each stamp, which is coarser than rows are: "
        )
        notes.append(("stamps_coarse", f"{says}they are spread evenly to the next"))
    elif others:
        says = f"{name}: {others} rows have the stamp of the row before and other "
        notes.append(("stamps_twice", f"{says}values: the first of each is used"))
    return columns, row, notes


def is_backward(t: np.ndarray) -> bool:
    """Whether the newest row comes first."""
    step = np.diff(t[np.isfinite(t)])
    return len(step) > _AROUND and float(np.mean(step < 0.0)) > 0.9


def whole_stamp(columns: Mapping[str, np.ndarray]) -> tuple[str, np.ndarray] | None:
    """(name, (n,) [s]) of stamps that two columns have the seconds and the nanoseconds
    of, as ROS messages do."""
    for name, sec in columns.items():
        stem = _part_of(name, "secs?")
        for other in columns if stem is not None else ():
            if _part_of(other, "n(ano)?secs?") == stem:
                return stem or "stamp", sec + 1e-9 * columns[other]
    return None


def is_part_of(stamp: str, name: str) -> bool:
    """Whether a column has the seconds or nanoseconds of a stamp."""
    part = _part_of(name, "(n(ano)?)?secs?")
    return part is not None and (part or "stamp") == stamp


def _part_of(name: str, unit: str) -> str | None:
    """What stands before a unit at a name's end; None where none is there."""
    found = re.fullmatch(rf"(?i)(.*?)[._/ ]?{unit}", name)
    return found and found.group(1)


def _starts(t: np.ndarray) -> np.ndarray:
    """(n,) whether time starts again at a row: most rows before are later than most
    after."""
    found = np.zeros(len(t), bool)
    for k in np.flatnonzero(np.diff(t) < 0.0) + 1:
        before, after = t[max(k - _AROUND, 0) : k], t[k : k + _AROUND]
        if min(len(before), len(after)) == _AROUND:
            found[k] = np.median(before) > np.median(after)
    return found


def _order(columns: Columns, time: str) -> tuple[np.ndarray, list[int]]:
    """Rows in the order of their stamps, and those of them that came late; without
    rows whose stamps fit the motion less than their places do."""
    t = columns[time]
    inside = _longest(t)
    if inside.all():
        return np.arange(len(t)), []
    out = np.flatnonzero(~inside)
    L, by_time, by_row = np.flatnonzero(inside), 0.0, 0.0
    for name, y in columns.items():
        good = L[np.isfinite(y[L])]
        if name in (time, "episode") or len(good) < 2 or not np.std(y[good]) > 0.0:
            continue
        off = np.stack([
            np.interp(t[out], t[good], y[good]), np.interp(out, good, y[good])
        ]) - y[out]  # fmt: skip
        wrong = np.minimum(np.nan_to_num(np.abs(off)) / np.std(y[good]), 1.0)
        by_time, by_row = by_time + wrong[0].sum(), by_row + wrong[1].sum()
    if by_time > by_row:
        return L, []
    return np.argsort(t, kind="stable"), out.tolist()


def _longest(t: np.ndarray) -> np.ndarray:
    """(n,) whether a row is in the longest part of t that does not decrease."""
    least = np.minimum.accumulate(t[::-1])[::-1]
    safe = (t >= np.maximum.accumulate(t)) & (t <= least)
    inside, rows = safe.copy(), np.flatnonzero(~safe)
    tails: list[float] = []  # Least last stamp of a part of each length, and its row.
    last: list[int] = []
    before = np.full(len(rows), -1)
    for k, stamp in enumerate(t[rows].tolist()):
        at = bisect_right(tails, stamp)
        before[k] = last[at - 1] if at else -1
        tails[at:], last[at:] = [stamp, *tails[at + 1 :]], [k, *last[at + 1 :]]
    k = last[-1] if last else -1
    while k >= 0:
        inside[rows[k]] = True
        k = int(before[k])
    return inside


def _once(columns: Columns, time: str):
    """Columns with each stamp once, which of the rows these are, how many came with
    the same values, how many with others, and whether stamps were spread."""
    t = columns[time]
    stamps, first, group = np.unique(t, return_index=True, return_inverse=True)
    if len(stamps) == len(t):
        return columns, np.arange(len(t)), 0, 0, False
    merged, differs = {time: stamps}, np.zeros(len(t), bool)
    new = np.zeros(len(t), bool)  # Whether a row fills what another one lacks.
    for name, y in columns.items():
        if name == time:
            continue
        there = np.flatnonzero(np.isfinite(y))
        has, at = np.unique(group[there], return_index=True)
        merged[name] = np.full(len(stamps), np.nan)
        merged[name][has] = y[there[at]]
        differs[there] |= y[there] != merged[name][group[there]]
        new[there[at]] = True
    if differs.sum() > COARSE * len(t):
        steps = np.diff(stamps)
        step = float(np.median(steps)) if len(steps) else 0.0
        step_of = np.minimum(np.append(steps, step), step)
        place = np.arange(len(t)) - first[group]
        count = np.bincount(group)
        spread = t + step_of[group] * place / count[group]
        return {**columns, time: spread}, np.arange(len(t)), 0, 0, True
    first_row = np.zeros(len(t), bool)
    first_row[first] = True
    same = int((~first_row & ~differs & ~new).sum())
    return merged, first, same, int(differs.sum()), False
