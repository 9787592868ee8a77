"""`makebreak reproduce close_the_loop`: closed loops of several seeds, as one table.

Each trial is `makebreak close-the-loop EXPERIMENT --seed N`: a run with a wrong model,
`gap` on its recording, and a run with the repaired model.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from makebreak.benchmarks.rows import check_named
from makebreak.scripts.runner.close_contact_loop import SETTINGS
from makebreak.scripts.runner.outputs import is_complete
from makebreak.scripts.runner.table import Table
from makebreak.scripts.runner.trials import makebreak_command, run_commands

# Name of a loop -> the words that run it. In ball_rolling both signs of the error.
LOOPS: dict[str, list[str]] = {name: [name] for name in SETTINGS} | {
    f"ball_rolling, {sign}5 mm": ["ball_rolling", f"--radius-error={sign}0.005"]
    for sign in "+-"
}
FIRST_SEED = 0
COLUMNS = ("what", "wrong model", "repaired model", "wanted", "seeds met")


check = partial(check_named, "close_the_loop", LOOPS)


def reproduce(
    session, seeds: int, jobs: int, which: str = "", only: str = "",
    seed: int | None = None,
) -> Table:  # fmt: skip
    """The table. Args: only: loops with this in their name; seed: the first one."""
    first = FIRST_SEED if seed is None else seed
    numbers = [first + i for i in range(seeds)]
    names = [name for name in LOOPS if only in name]
    trials = [(name, number) for name in names for number in numbers]
    folders = [
        Path(session.out_dir) / f"{name.replace(', ', '_').replace(' ', '')}_{number}"
        for name, number in trials
    ]
    commands = [
        makebreak_command(
            "close-the-loop", *LOOPS[name], "--seed", str(number), "--jobs", "1",
            "--out", str(folder),
        )
        for (name, number), folder in zip(trials, folders, strict=True)
    ]  # fmt: skip

    def is_done(i: int) -> bool:
        return session.reuse and is_complete(folders[i])

    results = run_commands("loops", commands, folders, jobs, is_done)
    rows: list[tuple] = []
    met: list[bool | None] = []
    for k, name in enumerate(names):
        own = results[k * seeds : (k + 1) * seeds]
        for row, good in rows_of(name, own):
            rows.append(row)
            met.append(good)
    notes = [f"Seeds {numbers}. Numbers are the least and the largest of all seeds."]
    notes += [
        f"{folder.name}: {result['error']}"
        for folder, result in zip(folders, results, strict=True) if "error" in result
    ]  # fmt: skip
    return Table("Loops closed", COLUMNS, rows, met, notes)


def rows_of(name: str, results: Sequence[Mapping]) -> list[tuple[tuple, bool | None]]:
    """Rows of one loop, each with whether all seeds meet it; None where nothing is
    wanted. A trial that gave no result meets nothing.

    Args: results: result.json of each seed.
    """
    tables = [result.get("rows", []) for result in results]
    whats = list(dict.fromkeys(row["result"] for rows in tables for row in rows))
    if not whats:
        return [((name, "", "", "a result", f"0 of {len(results)}"), False)]
    out = []
    for what in whats:
        own = [row for rows in tables for row in rows if row["result"] == what]
        goals = [row["met"] for row in own if "met" in row]
        wanted = list(dict.fromkeys(str(row["wanted"]) for row in own))
        cells = (
            f"{name}: {what}",
            _span([row["wrong model"] for row in own]),
            _span([row["repaired model"] for row in own]),
            wanted[0] if len(wanted) == 1 else "by seed",
            f"{sum(goals)} of {len(results)}" if goals else "",
        )
        good = sum(goals) == len(results) if goals else None
        out.append((cells, good))
    return out


def _span(values: Sequence) -> str:
    """The least and the largest of numbers; texts one after the other."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    if all(isinstance(value, int | float) for value in known):
        ends = [f"{end:.3g}" for end in (min(known), max(known))]
        return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
    return "; ".join(dict.fromkeys(str(value) for value in known))
