"""Prediction error of scenes on recordings, for each channel and scene.

    python -m makebreak.scripts.judge SCENE... --on RECORDING... --window 0.4

Each recording is cut into windows that start from measured states, which each scene
simulates with the recorded commands. To evaluate a repair, give the original scene, the
one that `makebreak gap` wrote, and recordings that were not given to `makebreak gap`.
"""

import argparse
import json
import sys
from pathlib import Path

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.simulation.judge import judge
from makebreak.models.scene import read_scene
from makebreak.scripts.table import Table, json_value


def judge_scenes(scenes: list[str], recordings: list[str], window_sec: float) -> Table:
    """A row for each channel, a column for each scene.

    Raises: ValueError for scenes and recordings that cannot be used.
    """
    tables = read_recordings(recordings)
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


def main() -> int:
    parser = argparse.ArgumentParser(description="How well scenes predict recordings.")
    parser.add_argument("scenes", nargs="+", metavar="SCENE")
    parser.add_argument("--on", nargs="+", required=True, metavar="RECORDING")
    parser.add_argument("--window", type=float, default=0.4, metavar="S")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the table, as JSON")
    args = parser.parse_args()
    try:
        table = judge_scenes(args.scenes, args.on, args.window)
    except (ValueError, OSError) as error:
        print(f"judge: {error}", file=sys.stderr)
        return 2
    print(table.to_text())
    if args.json:
        rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
        args.json.write_text(json.dumps(json_value(rows), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
