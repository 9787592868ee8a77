"""Observes the updates of systems from outside: duration and inputs.

For diagnostics only, never an input of the simulation.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from time import perf_counter

_observers: list[Callable] = []


def timed(update):
    """Decorates an update callback: each call's duration [s] is appended to the
    system's `compute_sec`.

    It is an attribute of the system, not in the Context: it describes the computer, and
    nothing in the simulation may read it.
    """

    @wraps(update)
    def wrapper(self, context, *args):
        for observer in _observers:
            observer(self, context)
        start = perf_counter()
        try:
            return update(self, context, *args)
        finally:
            if not hasattr(self, "compute_sec"):
                self.compute_sec = deque(maxlen=1_000_000)
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
