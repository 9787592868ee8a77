"""`makebreak bench`: measures computing times.

Each benchmark is a module with `rows() -> list[dict]`: what is measured, value, unit,
and further columns. Values are process CPU time, ratios from one run, or, of those that
run only where they are named, errors and counts.
"""

from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from time import process_time

import numpy as np

from makebreak.benchmarks.rows import failed
from makebreak.models.typed_yaml import nearest
from makebreak.scripts.runner.table import Table

# The name on the command line -> the module, imported when it is asked for.
BENCHES: dict[str, str] = {
    "c3": "makebreak.benchmarks.c3",
    "lcs": "makebreak.benchmarks.lcs",
    "learner": "makebreak.benchmarks.learner",
    "impedance": "makebreak.benchmarks.impedance",
    "push": "makebreak.benchmarks.push",
    "camera": "makebreak.benchmarks.camera",
    "latency": "makebreak.benchmarks.latency",
    "diagrams": "makebreak.benchmarks.diagrams",
    "gap": "makebreak.benchmarks.gap",
    "c3_light": "makebreak.benchmarks.c3_light",
    "learner_plants": "makebreak.benchmarks.learner_plants",
    "parameter_learner": "makebreak.benchmarks.parameter_learner",
    "parameter_push": "makebreak.benchmarks.parameter_push",
}
NAMED_ONLY = ("c3_light", "learner_plants", "parameter_learner", "parameter_push")


def median_call_ms(
    call: Callable[[], object], n: int = 200, clock=process_time
) -> float:
    """The median time of a call [ms], without the first one, which may compile.

    Args:
        call: the function to time.
        n: number of calls.
        clock: clock [s]; perf_counter for calls with several threads.
    """
    call()
    times = np.empty(n)
    for i in range(n):
        start = clock()
        call()
        times[i] = clock() - start
    return 1e3 * float(np.median(times))


def bench(names: Sequence[str] = ()) -> Table:
    """Runs the benchmarks of these names, or all that measure times.

    One that fails gives a row with the error, and does not stop the others.

    Returns: the table; its first column is the benchmark.
    Raises: ValueError for an unknown name, with the nearest valid ones.
    """
    here = [name for name, module in BENCHES.items() if find_spec(module)]
    for name in names:
        if name not in here:
            raise ValueError(f"unknown bench {name}; {nearest(name, here)}")
    found: list[dict] = []
    for name in names or [name for name in here if name not in NAMED_ONLY]:
        try:
            rows = import_module(BENCHES[name]).rows()
        except Exception as error:  # Of any kind, so that the others still run.
            rows = [failed(name, error)]
        found += [{"bench": name, **row} for row in rows]
    # The key `met` becomes the table's column `target`.
    columns = list(dict.fromkeys(c for row in found for c in row if c != "met"))
    return Table(
        "makebreak bench",
        columns,
        [[row.get(c) for c in columns] for row in found],
        met=[row.get("met") for row in found],
    )
