"""The paper's hypotheses (CC section 4) and what our tables say of each."""

from collections.abc import Mapping
from dataclasses import dataclass

from makebreak.scripts.table import Table, format_cell


@dataclass(frozen=True)
class Hypothesis:
    name: str
    claim: str
    experiments: tuple[str, ...]  # On whose targets the verdict rests.


HYPOTHESES = (
    Hypothesis(
        "H1",
        "incremental forward models capture changing dynamics, and control that uses "
        "them beats adaptive control",
        ("porridge", "multi_spring"),
    ),
    Hypothesis(
        "H2",
        "contact modes are recognised, and the motion is followed across them",
        ("changing_surface",),
    ),
    Hypothesis(
        "H3",
        "models must be updated while the task runs",
        ("wall_friction",),
    ),
    Hypothesis(
        "H4",
        "contacts are anticipated where they are, and transition control makes them "
        "gentle",
        ("multiple_collisions", "contact_learning", "surface_switch"),
    ),
)


def verdicts(tables: Mapping[str, Table]) -> Table | None:
    """What the tables of `reproduce` say of each hypothesis.

    Supported: every row with a target, of every experiment behind it, meets it. Else
    the rows that miss theirs are named. A hypothesis of which no experiment was run
    is left out; one of which some were says so.

    Args: tables, by experiment.
    Returns: the table, or None if no hypothesis was touched.
    """
    rows: list[tuple] = []
    met: list[bool | None] = []
    for one in HYPOTHESES:
        there = [name for name in one.experiments if name in tables]
        if not there:
            continue
        targets = [
            (name, row, good)
            for name in there
            for row, good in zip(
                tables[name].rows,
                tables[name].met or [None] * len(tables[name].rows),
                strict=True,
            )
            if good is not None
        ]
        missing = [name for name in one.experiments if name not in tables]
        missed = [(name, row) for name, row, good in targets if not good]
        if missed:
            verdict = f"supported but for {len(missed)} of {len(targets)} targets"
        else:
            verdict = f"supported: {len(targets)} of {len(targets)} targets met"
        if missing:
            verdict += f" (not run: {', '.join(missing)})"
        command = f"makebreak reproduce {' '.join(one.experiments)}"
        rows.append((f"{one.name}: {one.claim}", "supported", verdict, command))
        met.append(None if missing else not missed)
        for name, row, good in targets:
            mark = "" if good else "MISSED: "
            rows.append((f"  {name}: {row[0]}", row[1], mark + format_cell(row[2]), ""))
            met.append(None)
    if not rows:
        return None
    return Table(
        "The paper's hypotheses (CC section 4)",
        ("what", "paper", "ours", "command"),
        rows,
        met,
        ["A hypothesis is called supported if every target below it is met."],
    )
