"""Observes the updates of systems from outside: duration and inputs.

For diagnostics only, never an input of the simulation.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from time import perf_counter, thread_time

_observers: list[Callable] = []


def timed(update):
    """Decorates an update callback: each call's duration [s] is appended to the
    system's `compute_sec`, and the CPU time of its thread [s] to `compute_cpu_sec`,
    which other processes do not lengthen.

    They are attributes of the system, not in the Context: they describe the computer,
    and nothing in the simulation may read them.
    """

    @wraps(update)
    def wrapper(self, context, *args):
        for observer in _observers:
            observer(self, context)
        start, cpu = perf_counter(), thread_time()
        try:
            return update(self, context, *args)
        finally:
            if not hasattr(self, "compute_sec"):
                self.compute_sec = deque(maxlen=1_000_000)
                self.compute_cpu_sec = deque(maxlen=1_000_000)
            self.compute_sec.append(perf_counter() - start)
            self.compute_cpu_sec.append(thread_time() - cpu)

    return wrapper


@contextmanager
def observed(observer: Callable) -> Iterator[None]:
    """While entered, observer(system, context) is called just before each update."""
    _observers.append(observer)
    try:
        yield
    finally:
        _observers.remove(observer)
