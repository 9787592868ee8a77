"""`makebreak gap`: runs the workflow with a progress bar and writes the report."""

import json
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from shlex import quote
from time import perf_counter

import yaml
from tqdm import tqdm

from makebreak.gap.budget import REPORT, Budget
from makebreak.gap.data.findings import NO_COLUMN, Finding
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.recording import Recording
from makebreak.gap.data.sidecar import has_sidecar, has_sidecars, sidecar_of
from makebreak.gap.report.comparison import comparison, comparison_html
from makebreak.gap.report.files import write_report
from makebreak.gap.report.mcap_file import write_mcap
from makebreak.gap.report.summary import (
    next_best,
    not_told,
    summary_lines,
    windows_of,
)
from makebreak.gap.result import GapResult
from makebreak.gap.said import figure
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import sliding_joints
from makebreak.models.scene import Scene, read_scene
from makebreak.models.typed_yaml import read_yaml
from makebreak.scripts.cli.arguments import BUDGET_MIN
from makebreak.scripts.cli.drake_log import DrakeLog
from makebreak.scripts.runner.interrupts import undisturbed
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.shown import is_quiet, print_files
from makebreak.scripts.runner.table import Table

EXPORTS = ("urdf", "sdf", "mjcf", "isaaclab", "mcap")
NO_ANIMATION = "compare.html was not made"


class StageBar:
    """A line with the time so far, the stage, and what is tried in it, for a `with`.

    How many effects there are to be found is not known, so it shows no share of the
    work; the time that it may take is known where there is a budget [s].
    """

    def __init__(self, shown: bool = True, budget_sec: float = float("inf")):
        self.started = False  # Whether any stage was reported.
        self._stage, self._stops = "", False
        tty = sys.stderr.isatty()
        most = ""
        if budget_sec < float("inf"):
            most = f" of at most {tqdm.format_interval(budget_sec)}"
        self._every = 0.5 if tty else 10.0
        self._bar = tqdm(
            desc="reading scene and recordings",
            bar_format=f"{{elapsed}}{most}  {{desc}}",
            dynamic_ncols=tty,
            ncols=None if tty else 100,
            disable=is_quiet() or not shown,
            file=sys.stderr,
        )
        self._shown_at = perf_counter()

    def __call__(self, text: str) -> None:
        """A stage; or, indented, what is tried in it."""
        is_stage = not text.startswith(" ")
        self._stage = text if is_stage else self._stage
        shown = text if is_stage else f"{self._stage}: {text.strip()}"
        self._bar.set_description_str(shown, refresh=False)
        self.started = True
        self.tick(now=is_stage)

    def tick(self, now: bool = False) -> None:
        """Shows the time so far, if it is time for that."""
        if now or perf_counter() > self._shown_at + self._every:
            self._shown_at = perf_counter()
            self._bar.refresh()

    def stops(self) -> None:
        """Says once that it was asked to end."""
        if not self._stops:
            self._stops = True
            self._bar.write(
                "Ending with what is found so far; once more: at once.",
                file=sys.stderr,
            )

    def __enter__(self) -> "StageBar":
        return self

    def __exit__(self, kind, *_) -> None:
        if kind is None:
            self("done")
        self._bar.close()


def run_and_report(
    scene_path: Path,
    recording_paths: Sequence[Path],
    out_dir: Path,
    jobs: int,
    export: Sequence[str] = (),
    is_robot: bool = False,
    skip_bad_rows: bool = False,
    budget_min: float = BUDGET_MIN,
    interrupted: Callable[[], bool] = lambda: False,
    drake: DrakeLog | None = None,
    sidecar: Path | None = None,
) -> tuple[GapResult, list[Path], list[str], bool]:
    """The workflow's result, the files written, notes for the user, and whether it was
    interrupted.

    Args: export: formats of EXPORTS in which the repaired model is written too;
        is_robot: whether scene_path is a robot's own URDF or MJCF. Then a scene is
        proposed for it, with a sidecar for each recording that has none, and both are
        written too. budget_min: minutes after which the best answer so far is
        written; interrupted: whether it is to be written as soon as possible. drake:
        collects what Drake says; what changes the motion is told with the checks.
        sidecar: of all recordings, in place of their own.
    Raises: ValueError for a scene, a recording or a folder that cannot be used.
    """
    start = perf_counter()
    given = scene_path
    inputs = [scene_path, *recording_paths]
    doubts: Sequence[Finding] = ()
    seconds = 60.0 * budget_min
    with OutputFolder(out_dir, "gap", inputs) as out:
        if is_robot:
            scene_path, recording_paths, sidecars, notes, doubts = proposed(
                scene_path, recording_paths, out, out_dir, sidecar
            )
            print_files(out.keep(), sys.stderr)
        else:
            sidecars, notes = known_sidecars(
                scene_path, recording_paths, out.file, sidecar
            )
        if export:  # Raises before anything is computed.
            exported(read_scene(scene_path), export)
        from makebreak.gap.workflow import run_gap  # Here, as it takes long to import.

        def asked() -> bool:
            if interrupted():
                progress.stops()
            return interrupted()

        try:
            with (
                StageBar(budget_sec=seconds) as progress,
                Budget(seconds, asked, progress.tick).running() as budget,
            ):
                result = run_gap(
                    scene_path, recording_paths, jobs, progress, skip_bad_rows,
                    sidecars, doubts,
                )  # fmt: skip
                if drake is not None:
                    said = drake.findings(recording_paths[0].stem)
                    result = replace(result, checks=[*result.checks, *said])
                progress("writing the report")
                scene = read_scene(scene_path)
                slides = sliding_joints(SceneDynamics(scene).plant)
                recordings = read_recordings(
                    recording_paths, skip_bad_rows, sidecars, slides
                )
                with budget.part(REPORT):
                    moving = budget.if_time(
                        NO_ANIMATION,
                        lambda: comparison_html(result, scene, recordings),
                        None,
                    )
                if NO_ANIMATION in budget.undone:
                    notes.append(f"{budget.why}: {NO_ANIMATION}.")
                folder = out.stage
                write_report(result, scene, folder, recordings, given, moving, out_dir)
                effects = [*scene.effects, *result.scene_effects()]
                repaired = replace(scene, effects=effects)
                for name, text in exported(repaired, export).items():
                    out.file(name).write_text(text)
                if "mcap" in export:
                    notes += write_comparison(
                        result, scene, recordings, out.file("compare.mcap")
                    )
        except (Exception, SystemExit) as error:  # Drake raises SystemExit, too.
            if isinstance(error.__cause__ or error, OSError) and any(out.written()):
                kept = ", ".join(path.name for path in out.commit(complete=False))
                raise ValueError(f"{error}; kept: {kept}") from error
            if progress.started:  # Otherwise the input was refused: no report.
                with suppress(OSError):
                    out.file("error.txt").write_text(traceback.format_exc())
                out.commit(complete=False)
            raise
        times = {"wall_s": perf_counter() - start, "stages_s": dict(result.seconds)}
        out.file("timing.json").write_text(json.dumps(times, indent=2) + "\n")
        if is_robot and not budget.is_interrupted:  # Else it may go to a subfolder.
            name_from(out_dir, given, scene_path)
        with undisturbed():
            files = out.commit(complete=not budget.is_interrupted)
        return result, files, notes, budget.is_interrupted


def sidecar_near(scene_path: Path, recording: Path) -> Path | None:
    """A sidecar of the recording's name in the scene's folder, where a proposal is
    written."""
    near = scene_path.parent / sidecar_of(recording).name
    if near.is_file() and not near.samefile(scene_path):
        with suppress(ValueError):
            content = read_yaml(near)
            if isinstance(content, dict) and "columns" in content:
                return near
    return None


def known_sidecars(
    scene_path: Path,
    recording_paths: Sequence[Path],
    file: Callable[[str], Path],
    given,
) -> tuple[dict[Path, Path], list[str]]:
    """{recording: sidecar} for recordings without a sidecar of their own: one of this
    name in the scene's folder, where a proposal is written; else that of another log
    of the robot, which is written for this one. And what is to be said of it.

    Args: file: the path for a new file of this name; given: in place of any other.
    """
    from makebreak.gap.data.robot import read_log

    found, notes = dict[Path, Path](), list[str]()
    for path in recording_paths:
        if given is None and has_sidecar(path):
            continue
        near = None if given is not None else sidecar_near(scene_path, path)
        if near is not None:
            found[path] = near
            notes.append(f"{path.name}: columns as in {near}")
            continue
        folders = (path.parent, scene_path.parent)
        if given is None and not any(map(has_sidecars, folders)):
            continue
        own = read_log(path, given, folders).sidecar
        notes += own.notes
        if own.sections:
            found[path] = file(sidecar_of(path).name)
            found[path].write_text(yaml.safe_dump(dict(own.sections), sort_keys=False))
    return found, notes


def proposed(
    robot_path: Path,
    recording_paths: Sequence[Path],
    out: OutputFolder,
    out_dir: Path,
    sidecar: Path | None,
) -> tuple[Path, list[Path], dict[Path, Path], list[str], list[Finding]]:
    """Writes a proposed scene and sidecars for a robot and its logs.

    Returns: the scene's path; the recordings, of files that are one log the first;
    {recording: sidecar}; notes for the user; what the result must not forget of them.
    """
    from makebreak.gap.data.gathered import read_logs
    from makebreak.gap.data.robot import propose_scene, read_robot

    robot = read_robot(robot_path)
    logs = read_logs(recording_paths, robot, sidecar)
    recording_paths = [log.path for log in logs]
    proposal = propose_scene(robot, logs)
    scene = out.file("proposed_scene.yaml")
    scene.write_text(proposal.scene)
    for name, text in proposal.copies.items():
        out.file(name).write_text(text)
    sidecars = {}
    for path, text in proposal.sidecars.items():
        sidecars[path] = out.file(sidecar_of(path).name)
        sidecars[path].write_text(text)
    notes = ["A proposal, to be checked: " + "; ".join(proposal.notes) + "."]
    names = [str(out_dir / file.name) for file in (scene, *sidecars.values())]
    again = " ".join(quote(str(path)) for path in recording_paths)
    notes.append(
        f"Correct {' and '.join(names)} where they are wrong. Then run: "
        f"makebreak gap {quote(names[0])} {again}"
    )
    for path, sidecar in sidecars.items():
        if has_sidecar(path):
            notes.append(
                f"{out_dir / sidecar.name} has what the sidecar of {path.name} says, "
                "and a proposal for other columns: first put it in that one's place."
            )
    doubts = proposal.findings()
    notes += [finding.says for finding in doubts if finding.kind == NO_COLUMN]
    notes += [each.says for each in proposal.said]
    return scene, recording_paths, sidecars, notes, doubts


def name_from(folder: Path, robot: Path, proposed_scene: Path) -> None:
    """In a proposed scene that will lie in `folder`, names the robot's file from there,
    so that both can be moved together."""
    there = os.path.relpath(robot.resolve(), folder.resolve())
    text = proposed_scene.read_text()
    proposed_scene.write_text(
        text.replace(json.dumps(f"file://{robot.resolve()}"), json.dumps(there))
    )


def exported(scene: Scene, formats: Sequence[str]) -> dict[str, str]:
    """{file name: text} of a scene's models in other formats: `repaired.xml` (MJCF),
    `isaaclab_actuators.py`, `<model>.sdf` for each model, and `<model>.urdf` for each
    that comes from one.
    Effects that a format cannot express are listed in a comment at its end.

    Raises: ValueError for an unknown format, or a scene that it cannot express.
    """
    from makebreak.models.model_export import (
        to_isaac_lab,
        to_mjcf,
        to_sdf,
        to_urdf,
    )
    from makebreak.models.model_files import robot_files
    from makebreak.models.mujoco_twin import own_mjcf

    found = {}
    for each in formats:
        if each not in EXPORTS:
            raise ValueError(
                f"--export: got {each!r}, expected some of {', '.join(EXPORTS)}"
            )
        if each == "mcap":  # What moves is no text: write_comparison.
            if find_spec("rosbags") is None:
                raise ValueError(
                    "--export mcap needs rosbags: pip install 'makebreak[ros]'"
                )
            continue
        if each == "mjcf":
            found["repaired.xml"] = own_mjcf(scene) or to_mjcf(scene)
            continue
        if each == "isaaclab":
            found["isaaclab_actuators.py"] = to_isaac_lab(scene)
            continue
        files = robot_files(scene)
        models = [m for m in files if each == "sdf" or files[m].suffix == ".urdf"]
        if not models:
            raise ValueError(
                f"--export {each}: no model of the scene comes from "
                + ("URDF" if each == "urdf" else "URDF, SDF or MJCF")
            )
        write = to_urdf if each == "urdf" else to_sdf
        found |= {f"{model}.{each}": write(scene, model) for model in models}
    texts = {}
    for name, one in found.items():
        comment = "# {}\n" if name.endswith(".py") else "<!-- {} -->\n"
        lost = "".join(
            comment.format(f"Not in this file: {effect}") for effect in one.omitted
        )
        texts[name] = one.text + lost
    return texts


def write_comparison(
    result: GapResult, scene: Scene, recordings: Sequence[Recording], path: Path
) -> list[str]:
    """Writes compare.mcap, what compare.html shows. Returns: what to say of it."""
    compared = comparison(result, scene, recordings)
    if compared is None:
        return [f"{path.name} was not written: no motion was simulated."]
    motion, loaded = compared
    return write_mcap(path, [motion], loaded)


def effects_table(result: GapResult, told: str = "") -> Table:
    """The table at the end of a run: the effects found and the held-out error.

    Args: told: what is read beside it; where all values stand there, none is repeated.
    """
    rows: list[tuple] = []
    for each in result.effects:
        values = ", ".join(
            f"{name} {p.text()} {p.unit}".rstrip()
            for name, p in each.parameters.items()
        )
        rows.append((each.kind, list(each.at), values, next_best(each.evidence) or "-"))
    g = result.gap
    notes = []
    if isfinite(g.before):
        before, after = figure(g.before), figure(g.after)
        pair = f"held-out error: {before} before, {after} after,"
        notes.append(
            f"{'errors' if before in told and after in told else pair} in units of the "
            f"expected error (rms over {windows_of(result)}; a perfect model leaves 1)"
        )
    if g.in_equations:
        notes.append(
            "in the equations of motion of the same data: {:.3g} before, {:.3g} "
            "after".format(*g.in_equations)
        )
    columns = ["effect", "at", "parameters", "next best"]
    if not any(not_told(each, told) for each in result.effects):
        columns.remove("parameters")
        rows = [row[:2] + row[3:] for row in rows]
    return Table("\n".join(summary_lines(result)), columns, rows, notes=notes)
