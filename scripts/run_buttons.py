"""Buttons in Meshcat that act on a simulation that runs."""

from collections.abc import Callable
from time import perf_counter, sleep

from pydrake.geometry import Meshcat

PAUSE, STOP, OVER = "pause, go on", "stop", "start over"
LOOK_SEC = 0.05  # While it stands still, between two looks at the buttons.


class StartOver(BaseException):
    """The run is to begin again: no error, which somebody might handle."""


class RunButtons:
    """Pause (the space bar, too), stop and start over, in Meshcat while entered.

    waited_sec: for how long it has stood still.

    Args: restarts: whether there is one who begins the run again.
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
        """Waits while the simulation is paused. Returns: whether it is to end.

        Args: ended: whether it is to end for another reason, asked while waiting.
            at_rest: called after each pause.
        Raises: StartOver where that is asked for, paused or not.
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
