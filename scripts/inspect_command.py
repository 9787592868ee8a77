"""`makebreak inspect`: the columns of a log, and the channels they may be."""

from pathlib import Path

import numpy as np

from makebreak.gap.data.proposal import Match, sidecar_text
from makebreak.gap.data.robot import Log, Robot, matches_of, read_log, read_robot
from makebreak.gap.data.table import stem_of
from makebreak.models.model_files import without_lost_collisions
from makebreak.models.model_inertias import repaired
from makebreak.models.scene_reader import given_packages
from makebreak.scripts.outputs import OutputFolder
from makebreak.scripts.table import Table


def inspect_table(log: Log, robot: Robot | None) -> tuple[Table, list[Match]]:
    """One row for each column: samples, rate, holes, range, and a proposed channel."""
    matches = matches_of(log, robot)
    columns, found = log.table.columns, {m.column: m for m in matches}
    time = next((m for m in matches if m.channel == "time"), None)
    t = None if time is None else time.scale * columns[time.column] + time.offset
    rows: list[tuple] = []
    for name in (*columns, *log.text):
        match = found[name]
        target = match.channel or "-"
        if match.scale != 1.0:
            target += f" x {match.scale:.6g}"
        if name in log.text:
            rows.append((name, "text", "", "", "", "", "", target, match.why))
            continue
        y = columns[name]
        there = np.isfinite(y)
        rate = hole = repeats = np.nan
        if there.sum() > 1:
            repeats = float(np.mean(np.diff(y[there]) == 0.0))
            if t is not None:
                steps = np.diff(t[there])
                steps = steps[np.isfinite(steps) & (steps > 0.0)]
                if len(steps):
                    rate, hole = 1.0 / float(np.median(steps)), float(steps.max())
        low, high = (
            (float(np.nanmin(y)), float(np.nanmax(y))) if there.any() else (np.nan,) * 2
        )
        rows.append(
            (name, int(there.sum()), _short(rate), _short(hole), _short(low),
             _short(high), "" if np.isnan(repeats) else f"{repeats:.0%}", target,
             match.why)
        )  # fmt: skip
    heads = ("column", "samples", "rate [Hz]", "longest hole [s]", "min", "max",
             "repeated", "proposed channel", "reason")  # fmt: skip
    title = f"{log.path}: {log.table.n_rows} rows"
    notes = [says for _, says in log.table.notes]
    if t is not None and np.isfinite(t).any():
        title += f", {np.nanmax(t) - np.nanmin(t):.4g} s"
    else:
        notes.append("no column looks like a time")
    if robot is None:
        notes.append("--robot ROBOT.urdf matches the columns to its joints")
    return Table(title, heads, rows, notes=notes), matches


def _short(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4g}"


def run_inspect(
    path: Path, robot_path: Path | None, out: Path | None
) -> tuple[Table, str, list[Path]]:
    """The table, the drafted sidecar, and the files written.

    Raises: ValueError, one line, for a log or a robot that cannot be read.
    """
    robot = None if robot_path is None else read_robot(robot_path)
    log = read_log(path)
    table, matches = inspect_table(log, robot)
    text = sidecar_text(matches)
    if out is None:
        return table, text, []
    inputs = [path] + ([] if robot_path is None else [robot_path])
    with OutputFolder(out, "inspect", inputs) as folder:
        folder.file(f"{stem_of(path)}.yaml").write_text(text)
        return table, text, folder.commit()


def run_repair(path: Path, out: Path | None) -> tuple[list[str], list[Path]]:
    """Lines about the inertias of a robot's file that no body has, with proposals, and
    the repaired copy that is written to `out`.

    Raises: ValueError, one line, for a file that is no URDF, SDF or xacro.
    """
    file = without_lost_collisions(path, given_packages())
    if file.suffix == ".xml":
        raise ValueError(f"{path}: MuJoCo has accepted its inertias already")
    is_plain = path.suffix.lower() != ".xacro"
    text, lines = repaired(path.read_text() if is_plain else file.text)
    if not lines:
        return [f"{path}: all inertias are those of bodies"], []
    if out is None:
        return [*lines, "--out DIR writes a repaired copy"], []
    with OutputFolder(out, "inspect", [path]) as folder:
        name = f"{path.name.split('.')[0]}_repaired{file.suffix}"
        folder.file(name).write_text(text)
        return lines, folder.commit()
