"""Observes the updates of systems from outside: duration and inputs.

For diagnostics only, never an input of the simulation.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from time import perf_counter, thread_time

_observers: list[Callable] = []
# Least time between two calls of an update that are timed [s]. A thread's CPU time is
# asked of the kernel: to time each update took a fortieth of a whole simulation.
_EVERY = 0.005


@dataclass
class UpdateTimes:
    """How often a system was updated, and how long some of the updates took."""

    updates: int = 0
    wall_sec: list[float] = field(default_factory=list)
    cpu_sec: list[float] = field(default_factory=list)  # Of the same updates.
    next: float = 0.0  # The clock's time from which on one is timed again [s].


def timed(update):
    """Decorates an update callback: `update_times` of the system counts its calls, and
    has duration and CPU time of the thread [s], which other processes do not
    lengthen, of the first call and of one call every 5 ms.

    It is an attribute of the system, not in the Context: it describes the computer, and
    nothing in the simulation may read it.
    """

    @wraps(update)
    def wrapper(self, context, *args):
        for observer in _observers:
            observer(self, context)
        try:
            times = self.update_times
        except AttributeError:
            times = self.update_times = UpdateTimes()
        times.updates += 1
        start = perf_counter()
        if start < times.next:
            return update(self, context, *args)
        cpu = thread_time()
        try:
            return update(self, context, *args)
        finally:
            times.cpu_sec.append(thread_time() - cpu)
            times.wall_sec.append(perf_counter() - start)
            times.next = start + _EVERY

    return wrapper


@contextmanager
def observed(observer: Callable) -> Iterator[None]:
    """While entered, observer(system, context) is called just before each update."""
    _observers.append(observer)
    try:
        yield
    finally:
        _observers.remove(observer)
