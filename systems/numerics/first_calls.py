"""When functions are compiled: as a system is made, so that no tick waits for it; or,
where many systems are made, all together afterwards."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

_waiting: list[Callable[[], object]] | None = None


def first_call(function: Callable, *args) -> None:
    """Calls function(*args) for what that compiles; while `deferred` is entered, it
    joins its list instead."""
    if _waiting is None:
        function(*args)
    else:
        _waiting.append(partial(function, *args))


@contextmanager
def deferred() -> Iterator[list[Callable[[], object]]]:
    """While entered, first calls wait in the list that this gives, in their order."""
    global _waiting
    before, _waiting = _waiting, []
    try:
        yield _waiting
    finally:
        _waiting = before
