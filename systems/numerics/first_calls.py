"""When functions are compiled: in the constructor of a system, so that no update waits
for it; or, for many systems, all together afterwards."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

_waiting: list[Callable[[], object]] | None = None


def first_call(function: Callable, *args) -> None:
    """Calls function(*args) so that it is compiled; inside of `deferred` the call is
    appended to its list instead."""
    if _waiting is None:
        function(*args)
    else:
        _waiting.append(partial(function, *args))


@contextmanager
def deferred() -> Iterator[list[Callable[[], object]]]:
    """A context manager that collects first calls in the list that it yields."""
    global _waiting
    before, _waiting = _waiting, []
    try:
        yield _waiting
    finally:
        _waiting = before
