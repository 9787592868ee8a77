"""`makebreak gap`: reads, runs the workflow with a progress bar, writes the report."""

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from time import perf_counter

from tqdm import tqdm

from makebreak.gap.comparison import comparison_html
from makebreak.gap.recording import read_recordings
from makebreak.gap.report import summary_lines, write_report
from makebreak.gap.result import GapResult
from makebreak.models.scene import read_scene
from makebreak.scripts.table import Table


class StageBar:
    """A progress bar a stage: called with the stage's name and how much of it is done,
    0 to 1; another name ends the bar before. To be used in a `with`."""

    def __init__(self, shown: bool = True):
        self._shown = shown
        self._bar: tqdm | None = None
        self._stage = ""

    def __call__(self, stage: str, share: float) -> None:
        if stage != self._stage:
            self._end()
            tty = sys.stderr.isatty()
            self._stage = stage
            self._bar = tqdm(
                total=1.0,
                desc=f"{stage:12}",
                bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}",
                mininterval=0.2 if tty else 10.0,
                dynamic_ncols=tty,
                ncols=None if tty else 80,
                disable=not self._shown,
                file=sys.stderr,
            )
        if self._bar is not None:
            self._bar.update(min(max(share, 0.0), 1.0) - self._bar.n)

    def _end(self, done: bool = True) -> None:
        if self._bar is not None:
            if done:
                self._bar.update(1.0 - self._bar.n)
            self._bar.close()
            self._bar = None

    def __enter__(self) -> "StageBar":
        return self

    def __exit__(self, kind, *_) -> None:
        self._end(done=kind is None)


def run_and_report(
    scene_path: Path, recording_paths: Sequence[Path], out_dir: Path, jobs: int
) -> tuple[GapResult, list[Path]]:
    """The workflow's result, and the files that tell of it.

    Raises: ValueError for a scene, a recording or a folder that cannot be used.
    """
    # Loaded when asked for: the bad input that is found before it is told at once.
    run_gap = import_module("makebreak.gap.workflow").run_gap
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f'--out: got "{out_dir}", expected a folder to write in ({error.strerror})'
        ) from error
    start = perf_counter()
    with StageBar() as progress:
        result = run_gap(scene_path, recording_paths, out_dir, jobs, progress)
        progress("report", 0.0)
        scene = read_scene(scene_path)
        recordings = read_recordings(recording_paths)
        moving = comparison_html(result, scene, recordings)
        progress("report", 0.7)
        files = write_report(result, scene, out_dir, recordings, scene_path, moving)
    times = {"wall_s": perf_counter() - start, "stages_s": dict(result.seconds)}
    (out_dir / "timing.json").write_text(json.dumps(times, indent=2) + "\n")
    return result, [out_dir / "timing.json", *files]


def effects_table(result: GapResult) -> Table:
    """The end of a run: what was found, and what it does to the held-out error."""
    columns = ("effect", "at", "parameters", "error before", "after", "next best")
    rows: list[tuple] = []
    for each in result.effects:
        values = ", ".join(
            f"{name} {p.value:.3g} +- {p.std:.1g} {p.unit}".rstrip()
            for name, p in each.parameters.items()
        )
        e = each.evidence
        rows.append(
            (each.kind, list(each.at), values, e.held_out_before, e.held_out_after,
             e.runner_up or "-")
        )  # fmt: skip
    g = result.gap
    rows.append(("the whole model", "", "", g.before, g.after, ""))
    note = (
        f"error: rms over held-out windows of {g.window_s:.3g} s, in units of noise; "
    )
    note += f"noise floor {g.noise_floor:.3g}"
    return Table("\n".join(summary_lines(result)), columns, rows, notes=[note])
