"""`makebreak convert`: a log, with the robot moving as it says, as MCAP or .rrd."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.recording_files import ROBOTS
from makebreak.gap.data.table import stem_of
from makebreak.gap.report.mcap_file import motions_of, write_mcap, write_rrd
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.cli.gap_command import known_sidecars, proposed
from makebreak.scripts.runner.outputs import OutputFolder

FORMATS = ("mcap", "rrd")


def convert(
    scene_path: Path,
    recording_paths: Sequence[Path],
    out_dir: Path,
    sidecar: Path | None = None,
    skip_bad_rows: bool = False,
    formats: Sequence[str] = ("mcap",),
) -> tuple[list[Path], list[str]]:
    """Writes `<recording>.mcap` or `.rrd` for each recording, read as by `makebreak
    gap` with this scene or robot. Returns: the files; notes for the user.

    Args: formats: of FORMATS.
    Raises: ValueError for an unknown format, or a scene, a recording or a folder that
        cannot be used.
    """
    for each in formats:
        if each not in FORMATS:
            raise ValueError(
                f"--to: got {each!r}, expected some of {', '.join(FORMATS)}"
            )
    if "rrd" in formats and find_spec("rerun") is None:
        raise ValueError("--to rrd needs rerun: pip install 'makebreak[rerun]'")
    with (
        OutputFolder(out_dir, "convert", [scene_path, *recording_paths]) as out,
        TemporaryDirectory() as folder,
    ):
        if scene_path.suffix.lower() in ROBOTS:
            scene_path, recording_paths, sidecars, notes, _ = proposed(
                scene_path, recording_paths, out, out_dir, sidecar
            )
        else:
            sidecars, notes = known_sidecars(
                scene_path, recording_paths, out.file, sidecar
            )
        scene = read_scene(scene_path)
        loaded = {"measured": load_scene(scene, DiagramBuilder())}
        names = [stem_of(path) for path in recording_paths]
        for k, (path, name) in enumerate(zip(recording_paths, names, strict=True)):
            recording = read_recording(
                path, skip_bad_rows=skip_bad_rows, sidecar_path=sidecars.get(path)
            )
            name = name if names.count(name) == 1 else f"{name}_{k + 1}"
            place = out.file if "mcap" in formats else Path(folder).joinpath
            mcap = place(f"{name}.mcap")
            notes += write_mcap(mcap, motions_of(recording), loaded)
            if "rrd" in formats:
                write_rrd(out.file(f"{name}.rrd"), mcap, loaded)
        return out.commit(), notes
