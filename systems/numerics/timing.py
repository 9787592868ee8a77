"""Watching the updates of systems from outside: how long each took, and what it saw.

Diagnostics, never an input to anything that is simulated.
"""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from time import perf_counter

_observers: list[Callable] = []


def timed(update):
    """Decorates an update callback: each call's duration [s] goes to `compute_sec`.

    The deque lives on the system, not in the Context: it tells of the computer, not
    of the simulated world, and nothing that is simulated may read it.
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
