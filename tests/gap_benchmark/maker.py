"""The command of each table of cases: writes their recordings, and apart the truth."""

import argparse
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Protocol, TypeVar


class Case(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def folder(self) -> str:
        """A name that does not tell what is hidden."""
        ...


C = TypeVar("C", bound=Case)


def make_cases(
    what: str,
    sets: Sequence[str],
    cases: Callable[[str, int | None], Sequence[C]],
    write: Callable[[C, Path], dict],
) -> None:
    """Reads the command line and does what it says.

    Args:
        what: is written, for --help.
        sets: names of them.
        cases: those of a set, and from a seed on; None: from its own.
        write: a case into a folder; returns the truth. It is called in processes.
    """
    parser = argparse.ArgumentParser(description=f"Writes {what}.")
    parser.add_argument("--set", choices=sorted(sets), required=True)
    parser.add_argument("--names", action="store_true", help="print the cases' names")
    parser.add_argument("--out", type=Path, default="cases", help="folder of the cases")
    parser.add_argument("--truth", type=Path, default="truth.json", help="elsewhere")
    parser.add_argument("--seed", type=int, help="of the first case; else the set's")
    parser.add_argument("--only", default="", help="cases whose name has this in it")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    args = parser.parse_args()
    if args.out.resolve() in args.truth.resolve().parents:
        parser.error("--truth must not lie in --out: the workflow could read it")
    if args.names:
        print(*(case.name for case in cases(args.set, args.seed)), sep="\n")
        return
    wanted = [case for case in cases(args.set, args.seed) if args.only in case.name]
    truths = {}
    with ProcessPoolExecutor(args.jobs) as pool:
        written = pool.map(write, wanted, [args.out / case.folder for case in wanted])
        for case, truth in zip(wanted, written, strict=True):
            truths[case.folder] = truth
            print(case.folder, case.name, flush=True)
    args.truth.parent.mkdir(parents=True, exist_ok=True)
    # At the end: a set that was cut short is none, for --reuse.
    args.truth.write_text(json.dumps(truths, indent=1) + "\n")
