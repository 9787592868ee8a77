"""The files of a gap run: result.json, scene.yaml, report.html and its pictures."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

from matplotlib.figure import Figure

from makebreak.gap.data.recording import Recording
from makebreak.gap.report.clock import extents_of, from_zero, zeros_of
from makebreak.gap.report.page import report_html
from makebreak.gap.report.pictures import (
    picture_of_channels,
    picture_of_series,
    picture_of_trust,
    picture_of_where,
)
from makebreak.gap.result import GapResult
from makebreak.models.effects.kind import Effect
from makebreak.models.model_export import formats_of
from makebreak.models.scene import Scene
from makebreak.models.scene_file import write_scene


def write_report(
    result: GapResult,
    scene: Scene,
    out_dir: str | Path,
    recordings: Sequence[Recording] = (),
    scene_path: str | Path = "SCENE.yaml",
    comparison: str | None = None,
    place: str | Path | None = None,
) -> list[Path]:
    """Writes the run's files into `out_dir`, which is made if it is missing.

    Args:
        scene: as it came; scene.yaml is this one with the effects added.
        recordings: what was looked at: for the heat map's axis, and commands to go on.
        scene_path: as the user gave it, for these commands.
        comparison: the text of compare.html, if there is one.
        place: the folder where the files will be in the end; None: out_dir.
    Returns: the files, report.html last.
    Raises: ValueError where they cannot be written.
    """
    out, place = Path(out_dir), Path(out_dir if place is None else place)
    shown = from_zero(result, zeros_of(recordings))
    drawn = _pictures(shown, recordings)
    heading = _scene_heading(result, scene_path)
    try:
        out.mkdir(parents=True, exist_ok=True)
        files = [out / "result.json"]
        text = json.dumps(result.to_json(), indent=2, allow_nan=False) + "\n"
        _write(files[0], text)
        for name, added in _scenes(result).items():
            files.append(out / name)
            repaired = replace(scene, effects=[*scene.effects, *added])
            write_scene(repaired, files[-1], heading, place)
        page = report_html(
            shown, drawn, place, scene_path, recordings, comparison is not None,
            formats_of(scene),
        )  # fmt: skip
        _write(out / "report.html", page)
        # What would be missed least comes last, should the disk be full.
        for name, png in drawn.items():
            files.append(out / f"{name}.png")
            _write(files[-1], png)
        if comparison is not None:
            files.append(out / "compare.html")
            _write(files[-1], comparison)
    except OSError as error:
        raise ValueError(
            f'--out: got "{place}", expected a folder to write in ({error.strerror})'
        ) from error
    return [*files, out / "report.html"]


def _pictures(shown: GapResult, recordings: Sequence[Recording]) -> dict[str, bytes]:
    """PNG files by name, of the result with times as they are shown."""
    figures = {
        "channels": picture_of_channels(shown) if shown.gap.per_channel else None,
        "where": picture_of_where(shown, extents_of(recordings)),
        "series": picture_of_series(
            shown.series, {c: u.unit for c, u in shown.gap.in_units.items()}
        ),
        "trust": picture_of_trust(shown),
    }
    return {name: _png(each) for name, each in figures.items() if each is not None}


def _scenes(result: GapResult) -> dict[str, list[Effect]]:
    """{file: the effects that its scene gets}."""
    scenes = {"scene.yaml": result.scene_effects()}
    if result.effects and result.nuisance_scene:
        # The links as they were moved, too: for who trusts these data more than the
        # model. Effects come last: they change what is there.
        moved = [*result.nuisance_scene, *result.scene_effects()]
        scenes["scene_moved.yaml"] = moved
    for name in dict.fromkeys(r for e in result.effects for r in e.recordings):
        scenes[_scene_of(name)] = result.effects_in(name)
    return scenes


def _write(path: Path, content: str | bytes) -> None:
    """Writes the file; none is left of it where the disk is full."""
    try:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def _png(figure: Figure) -> bytes:
    file = BytesIO()
    figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
    return file.getvalue()


def _scene_heading(result: GapResult, scene_path: str | Path) -> str:
    name = Path(scene_path).name
    if not result.effects:
        return f"{name}; makebreak gap added nothing to it."
    n = len(result.effects)
    what = "an effect" if n == 1 else f"{n} effects"
    return f"{name} with {what} that makebreak gap found."


def _scene_of(recording: str) -> str:
    """The file of the scene with what is in one recording only."""
    return f"scene_{re.sub(r'[^A-Za-z0-9.-]+', '_', recording)}.yaml"
