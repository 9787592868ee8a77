"""Observes the updates of systems from outside: duration and inputs.

For diagnostics only, never an input of the simulation.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from time import perf_counter, thread_time

_observers: list[Callable] = []
# Least time between two questions for a thread's CPU time [s]: they go to the kernel,
# and asked twice in each update they would take a twentieth of a whole simulation.
_CPU_EVERY = 0.005


def timed(update):
    """Decorates an update callback: each call's duration [s] is appended to the
    system's `compute_sec`, and the CPU time of its thread [s], which other processes do
    not lengthen, to `compute_cpu_sec`: of the first call, and of one call every 5 ms.

    They are attributes of the system, not in the Context: they describe the computer,
    and nothing in the simulation may read them.
    """

    @wraps(update)
    def wrapper(self, context, *args):
        for observer in _observers:
            observer(self, context)
        if not hasattr(self, "compute_sec"):
            self.compute_sec = deque(maxlen=1_000_000)
            self.compute_cpu_sec = deque(maxlen=1_000_000)
            self._cpu_from = 0.0
        start = perf_counter()
        asks = start >= self._cpu_from or not self.compute_cpu_sec
        cpu = thread_time() if asks else 0.0
        try:
            return update(self, context, *args)
        finally:
            if asks:
                self.compute_cpu_sec.append(thread_time() - cpu)
                self._cpu_from = start + _CPU_EVERY
            self.compute_sec.append(perf_counter() - start)

    return wrapper


@contextmanager
def observed(observer: Callable) -> Iterator[None]:
    """While entered, observer(system, context) is called just before each update."""
    _observers.append(observer)
    try:
        yield
    finally:
        _observers.remove(observer)
