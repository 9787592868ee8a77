"""What `makebreak gap` makes of all three sets of measured data, as one table.

    python tests/measured_results.py DATA_FOLDER OUT [--only NAME ...]

converts each set, gives it to `makebreak gap`, judges both scenes on recordings that
gap has not seen, and writes OUT/results.md, OUT/results.json and gap's own reports. It
takes some 10 minutes of CPU time.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measured import cube_tosses, double_pendulum, so101

from makebreak.gap.data.recording import read_recordings
from makebreak.gap.simulation.judge import judge
from makebreak.models.scene import read_scene
from makebreak.scripts import cli
from makebreak.scripts.table import Table


@dataclass(frozen=True)
class Row:
    """An error before and after; goal: at most so much, None: none was set."""

    what: str
    unit: str
    before: float
    after: float
    goal: float | None


def gap(folder: Path, recordings: Sequence[Path]) -> Path:
    """Runs the command. Returns: the folder of its report."""
    out = folder / "gap"
    words = ["gap", str(folder / "scene.yaml"), *map(str, recordings)]
    if code := cli.main([*words, "--out", str(out)]):
        raise SystemExit(f"makebreak {' '.join(words)} ended with {code}")
    return out


def errors(
    scene: Path, recordings: Sequence[Path], window_sec: float, of: str = "rms"
) -> dict[str, float]:
    """{channel: error} in windows from measured states.

    Args: of: rms, over all samples, or at_end, over the last one of each window.
    """
    tables = read_recordings([str(each) for each in recordings])
    judged = judge(read_scene(scene), tables, window_sec)
    return {each.channel: getattr(each, of) for each in judged}


def of_double_pendulum(data: Path, folder: Path) -> list[Row]:
    double_pendulum.convert(data / "double_pendulum_A0.npz", folder)
    fitted = [folder / f"run_{k:02d}.csv" for k in range(5)]
    judged = [folder / f"run_{k:02d}.csv" for k in (5, 12, 13)]
    scenes = folder / "scene.yaml", gap(folder, fitted) / "scene.yaml"
    before, after = (errors(scene, judged, 0.4) for scene in scenes)
    return [
        Row(f"{joint}, windows of 0.4 s", "rad", before[name], after[name], goal)
        for joint, goal in (("shoulder", 0.027), ("elbow", 0.075))
        for name in [f"arm.{joint}.position"]
    ]


def of_so101(data: Path, folder: Path) -> list[Row]:
    so101.convert(data / "so101", folder)
    fitted, judged = (
        [folder / f"{motion}.csv" for motion in motions]
        for motions in (so101.FITTED, so101.JUDGED)
    )
    scenes = folder / "scene.yaml", gap(folder, fitted) / "scene.yaml"
    both = []
    for scene in scenes:
        found = errors(scene, judged, 0.5, "at_end")
        of = {joint: found[f"so101.{joint}.position"] for joint in so101.JOINTS}
        both.append({joint: 1e3 * value for joint, value in of.items()})
    before, after = both

    def over(which, of):
        return float(np.sqrt(np.mean([of[joint] ** 2 for joint in which])))

    rows = []
    for what, which in (
        ("all joints, 0.5 s ahead", so101.JOINTS),
        ("the same without the gripper", so101.JOINTS[:-1]),
    ):
        first = over(which, before)
        rows.append(Row(what, "mrad", first, over(which, after), 0.5 * first))
    return rows


def of_cube(data: Path, folder: Path) -> list[Row]:
    file = data / "contactnets_tosses.npz"
    cube_tosses.convert(file, folder)
    repaired = gap(folder, [folder / "fit.csv"]) / "scene.yaml"
    before, after = (
        1e3 * cube_tosses.judge(file, scene)
        for scene in (folder / "scene.yaml", repaired)
    )
    return [Row("corners after impact", "mm", before, after, 9.5)]


SETS = {
    "double_pendulum": ("a double pendulum", of_double_pendulum),
    "so101": ("a servo arm (SO-101)", of_so101),
    "cube": ("200 tosses of a cube", of_cube),
}


def table_of(found: dict[str, tuple[list[Row], dict]]) -> Table:
    """{name: rows and gap's result.json}."""
    rows, met = [], []
    for name, (of_set, result) in found.items():
        named = ", ".join(sorted({each["kind"] for each in result["effects"]})) or "-"
        for row in of_set:
            goal = "-" if row.goal is None else f"{row.goal:.3g} {row.unit}"
            rows.append((
                f"{SETS[name][0]}: {row.what}", goal,
                f"{row.before:.3g} -> {row.after:.3g} {row.unit}",
                result["verdict"], named,
            ))  # fmt: skip
            met.append(None if row.goal is None else bool(row.after <= row.goal))
    return Table(
        "What `makebreak gap` makes of measured data",
        ("recordings, judged where gap has not seen them", "goal",
         "scene as it came -> repaired", "verdict", "named"),
        rows, met,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(SETS), default=list(SETS))
    args = parser.parse_args()
    found = {}
    for name in args.only:
        folder = args.out / name
        folder.mkdir(parents=True, exist_ok=True)
        rows = SETS[name][1](args.data, folder)
        found[name] = rows, json.loads((folder / "gap/result.json").read_text())
    table = table_of(found)
    (args.out / "results.md").write_text(table.to_markdown())
    (args.out / "results.json").write_text(json.dumps(table.to_dict(), indent=2) + "\n")
    print(table.to_text())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
