"""The paper's hypotheses (CC section 4), and whether our tables support them."""

from collections.abc import Mapping
from dataclasses import dataclass

from makebreak.scripts.runner.table import Table, format_cell


@dataclass(frozen=True)
class Hypothesis:
    name: str
    claim: str
    experiments: tuple[str, ...]  # Their targets decide.


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
    """Whether the tables of `reproduce` support each hypothesis.

    It is supported if every row with a target, of all its experiments, meets it;
    otherwise the rows that miss it are named. A hypothesis without any experiment run
    is omitted; of others the experiments that are missing are named.

    Args: tables: {experiment: table}.
    Returns: the table, or None if no hypothesis has an experiment.
    """
    rows: list[tuple] = []
    met: list[bool | None] = []
    for one in HYPOTHESES:
        run = [name for name in one.experiments if name in tables]
        if not run:
            continue
        targets = [
            (name, row, good)
            for name in run
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
