"""What benchmarks share: the row of one that failed, what may be asked of them,
and `makebreak gap` with its time."""

import json
import resource
import subprocess
from pathlib import Path
from time import perf_counter

from makebreak.scripts.runner.trials import makebreak_command


def failed(what: str, error: Exception) -> dict:
    """A row without a value, with the error, that counts as a missed target."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return {"what": what, "value": None, "met": False, "note": f"failed: {text}"}


def check_named(command: str, names, which: str, only: str) -> None:
    """Raises: ValueError for a --set, which this command does not have, or an --only
    that is in no name."""
    if which != "standard":
        raise ValueError(f"--set: got {which}, and {command} has no sets")
    if not any(only in name for name in names):
        raise ValueError(f"--only: got {only}, expected part of: {'; '.join(names)}")


def run_gap(*words: str, out: Path) -> tuple[dict, float, float]:
    """Runs `makebreak gap`. words: as typed, without --out. Returns: its result; the
    time by the clock, the CPU time of all its processes [s].

    Raises: RuntimeError, with the command's last line, if it fails.
    """
    before, start = _cpu_of_children(), perf_counter()
    command = makebreak_command("gap", *words, "--out", str(out))
    done = subprocess.run(command, capture_output=True, text=True)
    wall, cpu = perf_counter() - start, _cpu_of_children() - before
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return json.loads((out / "result.json").read_text()), wall, cpu


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
