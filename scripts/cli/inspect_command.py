"""`makebreak inspect`: the columns of logs, and the channels they may be."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from makebreak.gap.data.bags import is_bag, is_dataset
from makebreak.gap.data.gathered import gathered
from makebreak.gap.data.match import Match
from makebreak.gap.data.proposal import sidecar_text
from makebreak.gap.data.recording_files import ROBOTS, recording_files
from makebreak.gap.data.robot import (
    Log,
    Robot,
    judge_logs,
    matches_of,
    read_log,
    read_robot,
)
from makebreak.gap.data.sidecar import sidecar_of
from makebreak.gap.data.table import suffix_of
from makebreak.models.model_files import without_lost_collisions
from makebreak.models.model_inertias import repaired
from makebreak.models.scene_reader import given_packages
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.table import Table, json_value

_HEADS = ("column", "proposed channel", "reason", "samples", "rate [Hz]",
          "longest hole [s]", "min", "max", "repeated")  # fmt: skip


@dataclass(frozen=True)
class Column:
    """samples: how many; text: whether it holds no numbers; rate [Hz]; hole: longest
    time between samples [s]; repeated: share of samples that repeat the one before."""

    match: Match
    text: bool = False
    samples: int = 0
    rate: float = np.nan
    hole: float = np.nan
    low: float = np.nan
    high: float = np.nan
    repeated: float = np.nan


@dataclass(frozen=True, eq=False)
class Inspected:
    """A log. duration [s], NaN without a time. refused: why it cannot be read."""

    path: Path
    kind: str
    rows: int = 0
    duration: float = np.nan
    columns: Sequence[Column] = ()
    notes: Sequence[str] = ()
    sidecar: str = ""
    refused: str = ""

    def joints(self) -> list[str]:
        """Whose positions were found."""
        channels = [c.match.channel or "" for c in self.columns]
        return [c[:-9] for c in channels if c.endswith(".position")]

    def drive(self) -> str:
        """What drives them: the kinds of commands and efforts that were found."""
        channels = [c.match.channel or "" for c in self.columns]
        kinds = {c.rpartition(".")[2]: None for c in channels}
        return ", ".join(k for k in kinds if k.endswith(("command", "effort_measured")))

    def table(self) -> Table:
        rows = []
        for c in self.columns:
            m, target = c.match, c.match.channel or "-"
            if m.scale != 1.0:
                target += f" x {m.scale:.6g}"
            if m.offset:
                target += f" {m.offset:+.6g}"
            cells: list = ["text", *[""] * 5]
            if not c.text:
                share = "" if np.isnan(c.repeated) else f"{c.repeated:.0%}"
                numbers = (c.rate, c.hole, c.low, c.high)
                cells = [c.samples, *map(_short, numbers), share]
            rows.append((m.column, target, m.why, *cells))
        title = f"{self.path}: {self.rows} rows"
        if np.isfinite(self.duration):
            title += f", {self.duration:.4g} s"
        return Table(title, _HEADS, rows, notes=self.notes)

    def to_dict(self) -> dict:
        columns = [
            {
                "column": c.match.column, "samples": c.samples, "rate_hz": c.rate,
                "longest_hole_s": c.hole, "min": c.low, "max": c.high,
                "repeated": c.repeated, "channel": c.match.channel,
                "scale": c.match.scale, "offset": c.match.offset,
                "reason": c.match.why,
            }
            for c in self.columns
        ]  # fmt: skip
        return {
            "file": str(self.path), "kind": self.kind, "rows": self.rows,
            "duration_s": json_value(self.duration), "joints": self.joints(),
            "drive": self.drive(), "notes": list(self.notes),
            "refused": self.refused or None, "sidecar": self.sidecar,
            "columns": [{k: json_value(x) for k, x in c.items()} for c in columns],
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Inspection:
    """logs: as they are; robot: whose joints columns were matched to."""

    logs: Sequence[Inspected]
    robot: Robot | None = None
    notes: Sequence[str] = field(default=())

    def tables(self) -> list[Table]:
        """Of one log its columns; of several a row each."""
        if len(self.logs) == 1 and not self.logs[0].refused:
            return [self.logs[0].table()]
        heads = ("log", "kind", "rows", "time [s]", "columns", "joints", "driven by")
        rows: list[tuple] = []
        for log in self.logs:
            if log.refused:
                rows.append((log.path, log.kind, "", "", "", "", log.refused))
                continue
            joints = str(len(log.joints()))
            if self.robot is not None:
                joints += f" of {len(self.robot.joints)}"
            rows.append(
                (log.path, log.kind, log.rows, _short(log.duration), len(log.columns),
                 joints, log.drive() or "nothing")
            )  # fmt: skip
        told = [*self.notes, *(says for log in self.logs for says in log.notes)]
        notes = dict.fromkeys(told)
        return [Table(f"{len(self.logs)} logs", heads, rows, notes=list(notes))]

    def sidecars(self) -> list[str]:
        """As texts, with the file's name where there are several."""
        several = len(self.logs) > 1
        return [
            f"# {sidecar_of(log.path).name}\n{log.sidecar}" if several else log.sidecar
            for log in self.logs if not log.refused
        ]  # fmt: skip

    def to_dict(self) -> dict:
        return {
            "robot": None if self.robot is None else str(self.robot.path),
            "notes": list(self.notes),
            "logs": [log.to_dict() for log in self.logs],
        }


def inspect_log(log: Log, robot: Robot | None) -> Inspected:
    """Each column: samples, rate, holes, range, and a proposed channel: by its name,
    and with a robot by what is in it, as `gap` takes it."""
    matches, said = matches_of(log, robot), list[str]()
    if robot is not None:
        try:
            judged = judge_logs(robot, [log])
            matches = judged.every[log.path]
            said = [each.says for each in judged.said]
        except ValueError as error:
            said = [str(error)]
    time = next((m for m in matches if m.channel == "time"), None)
    t = None
    if time is not None:
        t = time.scale * log.table.columns[time.column] + time.offset
    found = {m.column: m for m in matches}
    columns = [_column(log.table.columns[n], t, found[n]) for n in log.table.columns]
    columns += [Column(found[name], True) for name in log.text]
    notes = [*log.sidecar.notes, *(says for _, says in log.table.notes), *said]
    duration = np.nan
    if t is not None and np.isfinite(t).any():
        duration = float(np.nanmax(t) - np.nanmin(t))
    else:
        notes.append(f"{log.path.name}: no column looks like a time")
    if robot is None:
        notes.append("--robot ROBOT.urdf matches the columns to its joints")
    return Inspected(
        log.path, _kind(log.path), log.table.n_rows, duration, columns, notes,
        sidecar_text(matches, log.own),
    )  # fmt: skip


def _column(y: np.ndarray, t: np.ndarray | None, match: Match) -> Column:
    there = np.isfinite(y)
    rate = hole = repeats = np.nan
    if there.sum() > 1:
        repeats = float(np.mean(np.diff(y[there]) == 0.0))
        if t is not None:
            steps = np.diff(t[there])
            steps = steps[np.isfinite(steps) & (steps > 0.0)]
            if len(steps):
                rate, hole = 1.0 / float(np.median(steps)), float(steps.max())
    low, high = (f(y[there]) if there.any() else np.nan for f in (np.min, np.max))
    return Column(
        match, False, int(there.sum()), rate, hole, float(low), float(high), repeats
    )


def _kind(path: Path) -> str:
    if is_bag(path):
        return "ROS bag"
    return "LeRobot dataset" if is_dataset(path) else suffix_of(path).removeprefix(".")


def _short(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4g}"


def run_inspect(
    words: Sequence[str],
    robot_path: Path | None,
    out: Path | None,
    sidecar: Path | None,
) -> tuple[Inspection, list[Path]]:
    """What the logs hold, and the files written. Of several, one that cannot be read is
    told and stops nothing; a robot's file among them, or alone in a folder of logs, is
    used.

    Raises: ValueError, one line, for a log or a robot that cannot be read.
    """
    robots = [
        w for w in words if Path(w).suffix.lower() in ROBOTS and Path(w).is_file()
    ]
    if robot_path is None and len(robots) == 1 < len(words):  # As for `gap`.
        robot_path = Path(robots[0])
        words = [word for word in words if word != robots[0]]
    paths, notes = recording_files(words), list[str]()
    if robot_path is None:
        here = [file for word in words if Path(word).is_dir()
                for file in sorted(Path(word).iterdir())
                if file.suffix.lower() in ROBOTS and file.is_file()]  # fmt: skip
        if len(here) == 1:
            (robot_path,) = here
            notes.append(f"joints are those of {robot_path}")
        elif here:
            names = ", ".join(file.name for file in here)
            notes.append(f"--robot FILE matches columns to joints; here are: {names}")
    robot = None if robot_path is None else read_robot(robot_path)
    read, refused = list[Log](), list[Inspected]()
    for path in paths:
        try:
            read.append(read_log(path, sidecar))
        except ValueError as error:
            if len(paths) == 1:
                raise
            refused.append(Inspected(path, _kind(path), refused=str(error)))
    if robot is not None:
        try:
            read = gathered(read, robot)
        except ValueError as error:
            notes.append(str(error))
    logs = [*(inspect_log(log, robot) for log in read), *refused]
    logs.sort(key=lambda log: paths.index(log.path))
    found = Inspection(logs, robot, notes)
    if out is None:
        return found, []
    inputs = [*paths, *([] if robot_path is None else [robot_path])]
    with OutputFolder(out, "inspect", inputs) as folder:
        for log in logs:
            if not log.refused:
                folder.file(sidecar_of(log.path).name).write_text(log.sidecar)
        return found, folder.commit()


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
