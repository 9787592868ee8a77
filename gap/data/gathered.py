"""Logs that a command names: files of one log, such as a driver's states and another
program's commands, are one recording."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from makebreak.gap.data.arrays import words_of
from makebreak.gap.data.csv_table import is_nameless
from makebreak.gap.data.joined import in_rows_of, joined
from makebreak.gap.data.proposal import find_time, says_quantity
from makebreak.gap.data.robot import Log, Robot, matches_of, read_log
from makebreak.gap.data.table import stem_of

_SHARE = 0.5  # Of the shorter one's time that two files of one log have in common.


def read_logs(
    paths: Sequence[Path], robot: Robot, sidecar: Path | None = None
) -> list[Log]:
    """The logs of these files, without those of several that cannot be read, or that
    tell nothing of the robot, such as a log of events: notes of the first one say so.

    Raises: ValueError, one line, as gathered, and where no position of a joint is left.
    """
    read, failed, notes = list[Log](), list[ValueError](), list[str]()
    for path in paths:
        try:
            read.append(read_log(path, sidecar))
        except ValueError as error:
            failed.append(error)
            notes.append(f"{path.name} is left out: {error}")
    logs = gathered(read, robot)
    if any(_positions(log, robot) for log in logs):
        for log in logs:
            if not (_channels(log, robot, _prefix(log)) or _has_no_names(log)):
                notes.append(f"{log.path.name} is left out: no column is of the robot")
                logs = [other for other in logs if other is not log]
    elif failed:
        raise failed[0]
    first = logs[0].sidecar
    logs[0] = replace(logs[0], sidecar=replace(first, notes=(*first.notes, *notes)))
    return logs


def gathered(logs: Sequence[Log], robot: Robot) -> list[Log]:
    """Logs, with files of one log as one: those of a folder that have a common clock
    and tell different things of the robot, as no column of one says what another one's
    says already; and those without a time that have the rows of a file with nothing
    else.

    Raises: ValueError for a file without a position whose clock is that of no other.
    """
    clocks = [log for log in logs if len(log.table.columns) == 1 and _is_timed(log)]
    for clock in clocks:
        mine = [log for log in logs if log.path.parent == clock.path.parent
                and not _is_timed(log) and _has_its_rows(clock, log)]  # fmt: skip
        for log in mine:
            logs = [other for other in logs if other not in (clock, log)]
            clock = _together(clock, log)
            logs.append(clock)
    whole: list[Log] = []
    for log in sorted(logs, key=lambda log: -_positions(log, robot)):
        fits = [k for k, one in enumerate(whole) if _tell_apart(one, log, robot)]
        near = [k for k in fits if _common_share(whole[k], log) > _SHARE
                or _has_its_rows(whole[k], log)]  # fmt: skip
        if near:
            whole[near[0]] = _together(whole[near[0]], log)
        elif fits and not _positions(log, robot) and _is_timed(whole[fits[0]]):
            first = whole[fits[0]]
            raise ValueError(
                f"recording {log.path} has no position of a joint and no clock in "
                f"common with {first.path.name}: {_shown(log)} against {_shown(first)}"
            )
        else:
            whole.append(log)
    paths = [log.path for log in logs]
    return sorted(whole, key=lambda log: paths.index(log.path))


def _channels(log: Log, robot: Robot, prefix: str = "") -> list[str]:
    table = replace(
        log.table, columns={f"{prefix}{n}": y for n, y in log.table.columns.items()}
    )
    own = dict(log.own)
    if prefix:
        own["columns"] = {
            f"{prefix}{n}": to for n, to in (own.get("columns") or {}).items()
        }
    matches = matches_of(replace(log, table=table, own=own), robot)
    found = (m.channel or m.may for m in matches)
    return [channel for channel in found if channel and "." in channel]


def _prefix(log: Log) -> str:
    """What a file's name says of its columns: `commands.csv` of q1, q2."""
    words = [w for w in words_of(stem_of(log.path)) if says_quantity(w)]
    return f"{'_'.join(words)}:" if words else ""


def _positions(log: Log, robot: Robot) -> int:
    return sum(c.endswith(".position") for c in _channels(log, robot, _prefix(log)))


def _tell_apart(one: Log, other: Log, robot: Robot) -> bool:
    """Whether two files of a folder say different things of the robot, and both any."""
    if one.path.parent.resolve() != other.path.parent.resolve():
        return False
    a, b = (_channels(log, robot, _prefix(log)) for log in (one, other))
    return bool(a) and bool(b) and not {*a} & {*b}


def _has_no_names(log: Log) -> bool:
    return any(map(is_nameless, log.table.columns))


def _span(log: Log) -> tuple[float, float]:
    """First and last time [s]; NaN without a time."""
    said = log.own.get("columns") or {}
    of = {n: y for n, y in log.table.columns.items() if said.get(n) == "time"}
    found = find_time(of or log.table.columns)
    if found is None:
        return np.nan, np.nan
    time = found.scale * log.table.columns[found.column]
    return float(np.nanmin(time)), float(np.nanmax(time))


def _has_its_rows(one: Log, other: Log) -> bool:
    """Whether a file without a time has as many rows as one that has it, or so many
    numbers for each."""
    same = len(one.table.row) == len(other.table.row)
    return (
        _is_timed(one) and not _is_timed(other)
        and (same or in_rows_of(one.table, other.table) > 0)
    )  # fmt: skip


def _is_timed(log: Log) -> bool:
    return bool(np.isfinite(_span(log)).all())


def _shown(log: Log) -> str:
    return "{:.10g} to {:.10g} s".format(*_span(log))


def _common_share(one: Log, other: Log) -> float:
    (a, b), (c, d) = _span(one), _span(other)
    return (min(b, d) - max(a, c)) / max(min(b - a, d - c), 1e-9)


def _together(one: Log, other: Log) -> Log:
    """A log with the columns of another file, which its sidecar joins to it."""
    said = dict(one.own.get("columns") or {})
    table = joined(one.path, one.table, [(other.path, other.table)], "time")
    for name, to in (other.own.get("columns") or {}).items():
        if to != "time":
            key = f"{other.path.name}:{name}"
            said[key if key in table.columns else name] = to
    text = dict(one.text)
    for name, cell in other.text.items():
        text[name if name not in text else f"{other.path.name}:{name}"] = cell
    more = one.own.get("join") or []
    files = [more] if isinstance(more, str) else list(more)
    own = {**one.own, "columns": said, "join": [*files, str(other.path.resolve())]}
    by = "row by row" if _has_its_rows(one, other) else "by their times"
    says = f"{other.path.name} is joined to {one.path.name} {by}: one log"
    notes = (*one.sidecar.notes, *other.sidecar.notes, says)
    sidecar = replace(one.sidecar, sections=own, is_own=False, notes=notes)
    return replace(one, table=table, text=text, own=own, sidecar=sidecar)
