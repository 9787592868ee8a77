"""When a run ends with what it has: its time is up, or somebody asked it to.

Whatever computes for long asks `go_on` between two evaluations. Where the present part
of the run may not go on, that raises Stopped; the part's caller catches it, keeps the
last state that is whole, and notes what was left undone.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import monotonic
from typing import TypeVar

T = TypeVar("T")

# Parts of a run, each with the share of the budget at which it ends, and how long it
# may go on after somebody asked for the end [s].
SEARCH, PRUNE, CONCLUDE, REPORT = "search", "prune", "conclude", "report"
LIMBS = "limbs"  # While each has a budget of its own.
_ENDS = {
    SEARCH: (0.6, 0.0), PRUNE: (0.8, 0.0), CONCLUDE: (0.95, 20.0), REPORT: (1.0, 20.0),
    LIMBS: (0.96, 0.0),
}  # fmt: skip
LESS_SURE = {"gap_named": "ambiguous", "no_gap": "not_judged"}


class Stopped(BaseException):
    """The present part of a run is to end. (No Exception: nobody takes it for a model
    that could not be computed.)"""


class Budget:
    """How long a run may take, and whether somebody asked for its end.

    Args: seconds: of all of it. is_asked: whether to end as soon as possible. tick:
        called while something is computed, to show that.
    """

    def __init__(
        self,
        seconds: float = float("inf"),
        is_asked: Callable[[], bool] = lambda: False,
        tick: Callable[[], None] = lambda: None,
    ):
        if not seconds > 0.0:
            raise ValueError(f"budget: got {seconds / 60.0:g} min, expected above 0")
        self.seconds = seconds
        self.undone: list[str] = []
        self._start = monotonic()
        self._is_asked, self._tick = is_asked, tick
        self._asked_at: float | None = None
        self._part = SEARCH
        self._held = 0

    @property
    def is_interrupted(self) -> bool:
        return self._asked_at is not None

    @property
    def why(self) -> str:
        """Why it ended early, as the start of a sentence."""
        if self.is_interrupted:
            return "Interrupted"
        return f"Out of time (budget of {self.seconds / 60.0:.3g} min)"

    def go_on(self) -> None:
        """Raises: Stopped where the present part may not go on."""
        self._tick()
        now = monotonic()
        if self._asked_at is None and self._is_asked():
            self._asked_at = now
        if self._held:
            return
        share, longer = _ENDS[self._part]
        end = self._start + share * self.seconds
        if self._asked_at is not None:
            end = min(end, self._asked_at + longer)
        if now >= end:
            raise Stopped

    def share(self, n: float) -> "Budget":
        """A budget of one of n that come one after another, of what is left; or, where
        these are of unlike size, of one of which n are as much as all of them."""
        left = self._start + self.seconds - monotonic()
        return Budget(max(left / n, 1e-3), self._is_asked, self._tick)

    def in_a_copy(self) -> None:
        """In a copy of the process: nothing is shown from there."""
        self._tick = lambda: None

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Context of one part of the run."""
        before, self._part = self._part, name
        try:
            yield
        finally:
            self._part = before

    @contextmanager
    def held(self) -> Iterator[None]:
        """Context that is not stopped, for short work that must be done as a whole."""
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1

    @contextmanager
    def running(self) -> Iterator["Budget"]:
        """Context in which this is the budget of all that is computed."""
        token = _present.set(self)
        try:
            yield self
        finally:
            _present.reset(token)

    def if_time(self, what: str, compute: Callable[[], T], otherwise: T) -> T:
        """What a computation gives; where time is up before, `otherwise`, and `what`
        is noted as undone."""
        try:
            return compute()
        except Stopped:
            self.leave(what)
            return otherwise

    def leave(self, what: str) -> None:
        """Notes something as undone."""
        if what not in self.undone:
            self.undone.append(what)


_present: ContextVar[Budget] = ContextVar("budget", default=Budget())  # noqa: B039


def present() -> Budget:
    """The budget of the run that is computed."""
    return _present.get()


def go_on() -> None:
    """Asked between two evaluations. Raises: Stopped where the present part of the run
    may not go on."""
    _present.get().go_on()
