"""`makebreak judge`: prediction error of scenes on recordings, channel by channel.

Each recording is cut into windows that start from measured states, which each scene
simulates with the recorded commands. To evaluate a repair, give the original scene, the
one that `makebreak gap` wrote, and recordings that were not given to `makebreak gap`.
"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.simulation.judge import judge
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import sliding_joints
from makebreak.models.scene import read_scene
from makebreak.scripts.cli.gap_command import known_sidecars
from makebreak.scripts.runner.table import Table


def judge_scenes(
    scenes: Sequence[str],
    recordings: Sequence[Path],
    window_sec: float,
    sidecar: Path | None = None,
) -> Table:
    """A row for each channel, a column for each scene. A recording without a sidecar of
    its own is read as by `makebreak gap` with the first scene.

    Args: sidecar: of all recordings, in place of their own.
    Raises: ValueError for scenes and recordings that cannot be used.
    """
    with TemporaryDirectory() as folder:
        sidecars, _ = known_sidecars(
            Path(scenes[0]), recordings, Path(folder).joinpath, sidecar
        )
        slides = sliding_joints(SceneDynamics(read_scene(scenes[0])).plant)
        tables = read_recordings(recordings, sidecars=sidecars, slides=slides)
    judged = [judge(read_scene(path), tables, window_sec) for path in scenes]
    first = judged[0]
    rows: list[tuple] = []
    for k, each in enumerate(first):
        for where, name in ((f"{window_sec:g} s ahead", "at_end"), ("all", "rms")):
            errors = [getattr(of[k], name) for of in judged]
            rows.append((each.channel, each.unit, where, *errors, each.noise))
    notes = [
        f"{first[0].n_windows} windows of {window_sec:g} s of {len(tables)} "
        f"recording{'s' if len(tables) > 1 else ''}; rms of measured - simulated "
        f"{window_sec:g} s ahead (the last sample of each window), and over all their "
        "samples."
    ]
    for path, of in zip(scenes, judged, strict=True):
        if of[0].failed:
            notes.append(f"{path}: {of[0].failed:.1%} of the windows did not finish.")
    return Table(
        "Error in windows from measured states",
        ("channel", "unit", "of", *scenes, "noise"), rows, notes=notes,
    )  # fmt: skip
