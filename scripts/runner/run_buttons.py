"""Buttons in Meshcat that control a running simulation."""

from collections.abc import Callable
from time import perf_counter, sleep

from pydrake.geometry import Meshcat

PAUSE, STOP, OVER = "pause, go on", "stop", "start over"
LOOK_SEC = 0.05  # Period at which the buttons are polled while paused.


class StartOver(BaseException):
    """Asks for a restart of the run; no Exception, so that nothing handles it."""


class RunButtons:
    """Context with the buttons pause (or space bar), stop and start over in Meshcat.

    waited_sec: total time for which the simulation was paused [s].

    Args: restarts: whether the caller handles StartOver.
    """

    def __init__(self, meshcat: Meshcat | None, restarts: bool = False):
        self._meshcat = meshcat
        self._names = [PAUSE, STOP] + restarts * [OVER]
        self.waited_sec = 0.0

    def __enter__(self):
        if self._meshcat is not None:
            for name in self._names:
                self._meshcat.AddButton(name, "Space" if name == PAUSE else "")
        return self

    def __exit__(self, *_):
        if self._meshcat is not None:
            for name in self._names:
                self._meshcat.DeleteButton(name)

    def stopped(self, ended: Callable[[], bool], at_rest: Callable[[], None]) -> bool:
        """Waits while the simulation is paused. Returns: whether it should end.

        Args: ended: whether it should end for another reason, polled while waiting;
            at_rest: called after each pause.
        Raises: StartOver when that button was pressed, paused or not.
        """
        if self._meshcat is None:
            return False
        began = perf_counter()
        waited = False
        while (
            not (self._clicks(STOP) or self._clicks(OVER) or ended())
            and self._clicks(PAUSE) % 2
        ):
            waited = True
            sleep(LOOK_SEC)
        if waited:
            self.waited_sec += perf_counter() - began
            at_rest()
        if self._clicks(OVER):
            raise StartOver
        return self._clicks(STOP) > 0

    def _clicks(self, name: str) -> int:
        if self._meshcat is None or name not in self._names:
            return 0
        return self._meshcat.GetButtonClicks(name)
