"""Shows what Numba compiles, which takes a minute or two the first time."""

from collections.abc import Callable

from numba.core import event

from makebreak.scripts.runner.shown import say

FIRST = "Compiling, the first time only: a minute or two of one core"


class CompilingShown:
    """Context that reports each function of makebreak that Numba compiles (and does not
    read from its cache).

    Args:
        show: called with e.g. "compiling lcp.solve", and with "" after it.
        first: called before the first one.

    of: (k, n) while the k-th of n parts is compiled: "compiling k of n: lcp.solve".
    """

    of: tuple[int, int] | None = None

    def __init__(
        self, show: Callable[[str], None], first: Callable[[], None] = lambda: None
    ):
        self._show, self._at_first = show, first
        self._depth = 0
        self._first = True

    def _start(self, of: event.Event) -> None:
        self._depth += 1
        function = of.data["dispatcher"].py_func
        if self._depth > 1 or not function.__module__.startswith("makebreak."):
            return
        if self._first:
            say(FIRST)
            self._first = False
            self._at_first()
        module = function.__module__.rpartition(".")[2]
        part = "" if self.of is None else f"{self.of[0]} of {self.of[1]}: "
        self._show(f"compiling {part}{module}.{function.__name__}")

    def _end(self, _: event.Event) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._show("")

    def __enter__(self) -> "CompilingShown":
        self._listener = _Listener(self._start, self._end)
        event.register("numba:compile", self._listener)
        return self

    def __exit__(self, *_) -> None:
        event.unregister("numba:compile", self._listener)


class _Listener(event.Listener):
    def __init__(self, start, end):
        self._start, self._end = start, end

    def on_start(self, event):
        self._start(event)

    def on_end(self, event):
        self._end(event)
