"""How long each update of a system took: a diagnostic, never an input to anything."""

from collections import deque
from functools import wraps
from time import perf_counter


def timed(update):
    """Decorates an update callback: each call's duration [s] goes to `compute_sec`.

    The deque lives on the system, not in the Context: it tells of the computer, not
    of the simulated world, and nothing that is simulated may read it.
    """

    @wraps(update)
    def wrapper(self, *args):
        start = perf_counter()
        try:
            return update(self, *args)
        finally:
            if not hasattr(self, "compute_sec"):
                self.compute_sec = deque(maxlen=1_000_000)
            self.compute_sec.append(perf_counter() - start)

    return wrapper
