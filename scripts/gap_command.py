"""`makebreak gap`: runs the workflow with a progress bar and writes the report."""

import json
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from time import perf_counter

from tqdm import tqdm

from makebreak.gap.data.findings import NO_COLUMN, Finding
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.sidecar import has_sidecar, sidecar_of
from makebreak.gap.report.comparison import comparison_html
from makebreak.gap.report.files import write_report
from makebreak.gap.report.summary import next_best, summary_lines, windows_of
from makebreak.gap.result import GapResult
from makebreak.models.scene import Scene, read_scene
from makebreak.models.typed_yaml import read_yaml
from makebreak.scripts.interrupts import undisturbed
from makebreak.scripts.outputs import OutputFolder
from makebreak.scripts.table import Table

EXPORTS = ("urdf", "mjcf")


class StageBar:
    """A progress bar with a line of text for the present stage, for a `with`.

    As the number of effects to be found is not known, each call advances it by a tenth
    of the remainder (a fiftieth for indented text), unless `share`, 0 to 1, is given.
    """

    def __init__(self, shown: bool = True):
        self.started = False  # Whether any stage was reported.
        tty = sys.stderr.isatty()
        self._bar = tqdm(
            total=1.0,
            bar_format="{percentage:3.0f}%|{bar:24}| {elapsed} {desc}",
            mininterval=0.2 if tty else 10.0,
            dynamic_ncols=tty,
            ncols=None if tty else 100,
            disable=not shown,
            file=sys.stderr,
        )

    def __call__(self, text: str, share: float | None = None) -> None:
        self.started = True
        if share is None:
            step = 0.02 if text.startswith(" ") else 0.1
            share = self._bar.n + step * (1.0 - self._bar.n)
        self._bar.set_description_str(text.strip(), refresh=False)
        self._bar.update(min(max(share, self._bar.n), 1.0) - self._bar.n)
        self._bar.refresh()

    def __enter__(self) -> "StageBar":
        return self

    def __exit__(self, kind, *_) -> None:
        if kind is None:
            self("done", 1.0)
        self._bar.close()


def run_and_report(
    scene_path: Path,
    recording_paths: Sequence[Path],
    out_dir: Path,
    jobs: int,
    export: Sequence[str] = (),
    is_robot: bool = False,
    skip_bad_rows: bool = False,
) -> tuple[GapResult, list[Path], list[str]]:
    """The workflow's result, the files written, and notes for the user.

    Args: export: formats of EXPORTS in which the repaired model is written too;
        is_robot: whether scene_path is a robot's own URDF or MJCF. Then a scene is
        proposed for it, with a sidecar for each recording that has none, and both are
        written too.
    Raises: ValueError for a scene, a recording or a folder that cannot be used.
    """
    from makebreak.gap.workflow import run_gap  # Here, as it takes long to import.

    start = perf_counter()
    given = scene_path
    inputs = [scene_path, *recording_paths]
    doubts: Sequence[Finding] = ()
    sidecars = {} if is_robot else sidecars_beside(scene_path, recording_paths)
    notes = [f"{log.name}: columns as in {own}" for log, own in sidecars.items()]
    with OutputFolder(out_dir, "gap", inputs) as out:
        if is_robot:
            scene_path, sidecars, notes, doubts = _proposed(
                scene_path, recording_paths, out, out_dir
            )
        if export:  # Raises before anything is computed.
            exported(read_scene(scene_path), export)
        try:
            with StageBar() as progress:
                result = run_gap(
                    scene_path, recording_paths, jobs, progress, skip_bad_rows,
                    sidecars, doubts,
                )  # fmt: skip
                progress("writing the report", 0.95)
                scene = read_scene(scene_path)
                recordings = read_recordings(recording_paths, skip_bad_rows, sidecars)
                moving = comparison_html(result, scene, recordings)
                folder = out.stage
                write_report(result, scene, folder, recordings, given, moving, out_dir)
                effects = [*scene.effects, *result.scene_effects()]
                repaired = replace(scene, effects=effects)
                for name, text in exported(repaired, export).items():
                    out.file(name).write_text(text)
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
        with undisturbed():
            return result, out.commit(), notes


def sidecars_beside(
    scene_path: Path, recording_paths: Sequence[Path]
) -> dict[Path, Path]:
    """{recording: sidecar in the scene's folder} for recordings without a sidecar of
    their own: a proposal writes scene and sidecars into one folder."""
    found = {}
    for path in recording_paths:
        near = scene_path.parent / sidecar_of(path).name
        if has_sidecar(path) or not near.is_file() or near.samefile(scene_path):
            continue
        with suppress(ValueError):
            content = read_yaml(near)
            if isinstance(content, dict) and "columns" in content:
                found[path] = near
    return found


def _proposed(
    robot_path: Path, recording_paths: Sequence[Path], out: OutputFolder, out_dir: Path
) -> tuple[Path, dict[Path, Path], list[str], list[Finding]]:
    """Writes a proposed scene and sidecars for a robot and its logs.

    Returns: the scene's path, {recording: sidecar}, notes for the user, and what the
    result must not forget of them.
    """
    from makebreak.gap.data.robot import propose_scene, read_log, read_robot

    robot = read_robot(robot_path)
    proposal = propose_scene(robot, [read_log(path) for path in recording_paths])
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
    return scene, sidecars, notes, doubts


def exported(scene: Scene, formats: Sequence[str]) -> dict[str, str]:
    """{file name: text} of a scene's models in other formats: `repaired.xml` (MJCF),
    and `<model>.urdf` for each model that comes from a URDF. Effects that a format
    cannot express are listed in a comment at its end.

    Raises: ValueError for an unknown format, or a scene that it cannot express.
    """
    from makebreak.models.model_export import to_mjcf, to_urdf, urdf_models

    found = {}
    for each in formats:
        if each not in EXPORTS:
            raise ValueError(
                f"--export: got {each!r}, expected some of {', '.join(EXPORTS)}"
            )
        if each == "mjcf":
            found["repaired.xml"] = to_mjcf(scene)
            continue
        models = urdf_models(scene)
        if not models:
            raise ValueError("--export urdf: no model of the scene comes from a URDF")
        found |= {f"{model}.urdf": to_urdf(scene, model) for model in models}
    texts = {}
    for name, one in found.items():
        lost = "".join(
            f"<!-- Not in this file: {effect} -->\n" for effect in one.omitted
        )
        texts[name] = one.text + lost
    return texts


def effects_table(result: GapResult) -> Table:
    """The table at the end of a run: the effects found and the held-out error."""
    rows: list[tuple] = []
    for each in result.effects:
        values = ", ".join(
            f"{name} {p.text()} {p.unit}".rstrip()
            for name, p in each.parameters.items()
        )
        rows.append((each.kind, list(each.at), values, next_best(each.evidence) or "-"))
    g = result.gap
    note = (
        f"held-out error: {g.before:.3g} before, {g.after:.3g} after, in units of the "
        f"noise (rms over {windows_of(result)}; a perfect model leaves 1)"
    )
    notes = [note]
    if g.in_equations:
        before, after = g.in_equations
        notes.append(
            f"in the equations of motion of the same data: {before:.3g} before, "
            f"{after:.3g} after"
        )
    columns = ("effect", "at", "parameters", "next best")
    return Table("\n".join(summary_lines(result)), columns, rows, notes=notes)
