"""Runs `makebreak gap` on all measured data: the tables of docs/lab/results.md.

    python tests/measured_results.py DATA_FOLDER OUT [--only NAME ...] [--write FILE]

converts each set, gives it to `makebreak gap`, judges the scenes on recordings that gap
has not seen, and writes OUT/results.md, OUT/results.json and gap's own reports. `loops`
needs no data: it closes the loop for five wrong radii of the ball. --write puts the
tables into FILE, each between the lines `<!-- table: NAME -->` and `<!-- end -->`.

It takes some 25 minutes of CPU time, 15 of them for the loops.
"""

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from measured import cube_tosses, double_pendulum, so101

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.simulation.judge import judge
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.runner.table import Table

# Of the loops: error of the ball's radius [m], seed. All were set beforehand.
LOOPS = ((-0.005, 1), (-0.002, 3), (0.003, 4), (0.005, 0), (0.008, 2))
LOOP_SEC = 40.0


@dataclass(frozen=True)
class Row:
    """An error before and after; goal: its upper bound, None if none was set."""

    what: str
    unit: str
    before: float
    after: float
    goal: float | None


@dataclass(frozen=True, eq=False)
class Found:
    """Results of one set: rows of the common table, gap's result.json, and the set's
    own tables by their names in docs/lab/results.md."""

    rows: list[Row]
    result: dict
    tables: dict[str, Table] = field(default_factory=dict)


def command(*words: str) -> None:
    """Runs makebreak. Raises: SystemExit where it ends with an error."""
    if code := cli.main(list(words)):
        raise SystemExit(f"makebreak {' '.join(words)} ended with {code}")


def gap(folder: Path, recordings: Sequence[Path]) -> tuple[Path, dict]:
    """Runs the command. Returns: the folder of its report, result.json."""
    out = folder / "gap"
    command("gap", str(folder / "scene.yaml"), *map(str, recordings), "--out", str(out))
    return out, json.loads((out / "result.json").read_text())


def errors(
    scene: Path, recordings: Sequence[Path], window_sec: float, of: str = "rms"
) -> dict[str, float]:
    """{channel: error} in windows from measured states.

    Args: of: rms, over all samples, or at_end, over the last one of each window.
    """
    tables = read_recordings([str(each) for each in recordings])
    judged = judge(read_scene(scene), tables, window_sec)
    return {each.channel: getattr(each, of) for each in judged}


def named_table(result: dict) -> Table:
    """The table of effects that gap named, with intervals and ties."""

    def place(at: str | list[str]) -> str:
        return at if isinstance(at, str) else ", ".join(at)

    rows = []
    for each in result["effects"]:
        values = []
        for name, p in each["parameters"].items():
            std = "inf" if p["std"] is None else f"{p['std']:.2g}"
            unit = f" {p['unit']}" if p["unit"] not in ("", "1") else ""
            values.append(f"{name} {p['value']:.3g} +- {std}{unit}")
        ties = [
            f"{tie['kind']} at {place(tie['at'])}"
            for tie in each["indistinguishable_from"]
        ]
        rows.append((
            each["kind"], place(each["at"]), "; ".join(values), "; ".join(ties) or "-",
        ))  # fmt: skip
    return Table("Named", ("effect", "at", "value", "tied with"), rows)


def of_double_pendulum(data: Path, folder: Path) -> Found:
    double_pendulum.convert(data / "double_pendulum_A0.npz", folder)
    fitted = [folder / f"run_{k:02d}.csv" for k in range(5)]
    judged = [folder / f"run_{k:02d}.csv" for k in (5, 12, 13)]
    out, result = gap(folder, fitted)
    scenes = folder / "scene.yaml", out / "scene.yaml", out / "scene_moved.yaml"
    by_scene = [errors(scene, judged, 0.4) for scene in scenes]
    rows, cells = [], []
    for what, unit, goals in (
        ("position", "rad", (0.027, 0.075)), ("velocity", "rad/s", (None, None)),
    ):  # fmt: skip
        for joint, goal in zip(("shoulder", "elbow"), goals, strict=True):
            e = [of[f"arm.{joint}.{what}"] for of in by_scene]
            cells.append((
                joint if goal else f"speed of the {joint}",
                *(f"{x:.3f} {unit}" if goal else f"{x:.2f} {unit}" for x in e),
                f"{goal} {unit}" if goal else "",
            ))  # fmt: skip
            if goal:
                rows.append(Row(f"{joint}, windows of 0.4 s", unit, e[0], e[1], goal))
    heads = (
        "", "scene as published", "with the named effects",
        "with adjusted links as well (`scene_moved.yaml`)", "goal",
    )  # fmt: skip
    tables = {
        "double_pendulum": Table("A double pendulum", heads, cells),
        "double_pendulum_named": named_table(result),
    }
    return Found(rows, result, tables)


def of_so101(data: Path, folder: Path) -> Found:
    so101.convert(data / "so101", folder)
    fitted, judged = (
        [folder / f"{motion}.csv" for motion in motions]
        for motions in (so101.FITTED, so101.JUDGED)
    )
    out, result = gap(folder, fitted)
    scenes = {
        "given scene": folder / "scene.yaml",
        "published servo": folder / "published.yaml",
        "with the effects named by `gap`": out / "scene.yaml",
        "six numbers found by hand (below)": folder / "by_hand.yaml",
    }
    groups = {
        "all": so101.JOINTS,
        "all but the gripper": so101.JOINTS[:-1],
    }
    cells, over = [], {}
    for says, scene in scenes.items():
        found = errors(scene, judged, 0.5, "at_end")
        of = {joint: 1e3 * found[f"so101.{joint}.position"] for joint in so101.JOINTS}
        over[says] = {
            name: float(np.sqrt(np.mean([of[joint] ** 2 for joint in which])))
            for name, which in groups.items()
        }
        every = [*of.values(), *over[says].values()]
        cells.append((says, *(f"{x:.1f}" for x in every)))
    came, named, *_ = (over[k] for k in ("given scene", [*scenes][2]))
    rows = [
        Row(what, "mrad", came[name], named[name], 0.5 * came[name])
        for what, name in (
            ("all joints, 0.5 s ahead", "all"),
            ("the same without the gripper", "all but the gripper"),
        )
    ]
    tables = {
        "so101": Table("A servo arm", ("", *so101.JOINTS, *groups), cells),
        "so101_named": named_table(result),
    }
    return Found(rows, result, tables)


def of_cube(data: Path, folder: Path) -> Found:
    file = data / "contactnets_tosses.npz"
    cube_tosses.convert(file, folder)
    out, result = gap(folder, [folder / "fit.csv"])
    before, after = (
        1e3 * cube_tosses.judge(file, scene)
        for scene in (folder / "scene.yaml", out / "scene.yaml")
    )
    cells = [
        ("scene as published", f"{before:.1f} mm", ""),
        ("with the effects named by `gap`", f"{after:.1f} mm", "9.5 mm"),
    ]
    tables = {
        "cube": Table("Tosses of a cube", ("", "corners, rms", "goal"), cells),
        "cube_named": named_table(result),
    }
    return Found(
        [Row("corners after impact", "mm", before, after, 9.5)], result, tables
    )


def of_loops(data: Path, folder: Path) -> Found:
    """data is not used."""
    cells = []
    for error, seed in LOOPS:
        out = folder / f"{1e3 * error:+.0f}_mm"
        words = ["--radius-error", str(error), "--seed", str(seed)]
        words += ["--duration", str(LOOP_SEC), "--out", str(out)]
        # 1: a goal is missed, which the table shows.
        if cli.main(["close-the-loop", "ball_rolling", *words]) not in (0, 1):
            raise SystemExit(f"makebreak close-the-loop {' '.join(words)} failed")
        cells.append(loop_cells(json.loads((out / "loop.json").read_text()), seed))
    heads = (
        "radius in the model", "seed", "named", "radius of the repaired model",
        "first contact", "learned gap - true gap", "learned gap",
    )  # fmt: skip
    nothing = {"verdict": "-", "effects": []}
    return Found([], nothing, {"loops": Table("The loop closed", heads, cells)})


def loop_cells(loop: dict, seed: int) -> tuple[str, ...]:
    """A row of the loops' table, of loop.json."""
    first, second = loop["first"], loop["second"]
    named = [
        f"`{each['kind']}`"
        + "".join(f", tied with `{t['kind']}`" for t in each["indistinguishable_from"])
        for each in loop["gap"]["effects"]
    ]

    def both(key: str, scale: float, unit: str, digits: int) -> str:
        a, b = (
            "-" if run[key] is None else f"{scale * run[key]:.{digits}f} {unit}"
            for run in (first, second)
        )
        return f"{a} -> {b}"

    return (
        f"{1e3 * loop['radius_wrong_m']:.1f} mm", str(seed), "; ".join(named) or "-",
        f"{1e3 * loop['radius_m']:.2f} mm",
        both("time_to_first_contact_s", 1.0, "s", 2),
        both("r_gap_error_m", 1e3, "mm", 1), both("r_gap_m", 1e3, "mm", 1),
    )  # fmt: skip


SETS = {
    "double_pendulum": ("a double pendulum", of_double_pendulum),
    "so101": ("a servo arm (SO-101)", of_so101),
    "cube": ("200 tosses of a cube", of_cube),
    "loops": ("a rolled ball, radius off by", of_loops),
}


def table_of(found: dict[str, Found]) -> Table:
    """{name: what was found}."""
    rows, met = [], []
    for name, one in found.items():
        named = ", ".join(sorted({each["kind"] for each in one.result["effects"]}))
        for row in one.rows:
            goal = "-" if row.goal is None else f"{row.goal:.3g} {row.unit}"
            rows.append((
                f"{SETS[name][0]}: {row.what}", goal,
                f"{row.before:.3g} -> {row.after:.3g} {row.unit}",
                one.result["verdict"], named or "-",
            ))  # fmt: skip
            met.append(None if row.goal is None else bool(row.after <= row.goal))
    return Table(
        "What `makebreak gap` makes of measured data",
        ("recordings, judged where gap has not seen them", "goal",
         "given scene -> repaired", "verdict", "named"),
        rows, met,
    )  # fmt: skip


def with_tables(text: str, tables: dict[str, Table]) -> str:
    """The page with these tables in their places.

    Raises: ValueError for a table that has no place there, or two.
    """
    for name, table in tables.items():
        place = rf"(<!-- table: {name} -->\n).*?(<!-- end -->)"
        rows = table.to_markdown().split("\n", 2)[2]  # Without its title.
        text, count = re.subn(
            place, lambda m, rows=rows: f"{m[1]}\n{rows}\n{m[2]}", text, flags=re.DOTALL
        )
        if count != 1:
            raise ValueError(f"{count} places for the table {name}, expected one")
    return text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(SETS), default=list(SETS))
    page = "docs/lab/results.md"
    parser.add_argument("--write", type=Path, metavar="FILE", help=page)
    args = parser.parse_args()
    found = {}
    for name in args.only:
        folder = args.out / name
        folder.mkdir(parents=True, exist_ok=True)
        found[name] = SETS[name][1](args.data, folder)
    table = table_of(found)
    tables = {name: t for one in found.values() for name, t in one.tables.items()}
    if args.only == list(SETS):
        tables["all"] = table
    (args.out / "results.md").write_text(
        "\n".join(t.to_markdown() for t in (table, *tables.values()))
    )
    written = {name: t.to_dict() for name, t in {"all": table, **tables}.items()}
    (args.out / "results.json").write_text(json.dumps(written, indent=2) + "\n")
    print("\n".join(t.to_text() for t in (table, *tables.values())))
    if args.write:
        args.write.write_text(with_tables(args.write.read_text(), tables))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
