"""Buttons in Meshcat that act on a simulation that runs."""

from collections.abc import Callable
from time import perf_counter, sleep

from pydrake.geometry import Meshcat

PAUSE, STOP = "pause, go on", "stop"
LOOK_SEC = 0.05  # While it stands still, between two looks at the buttons.


class RunButtons:
    """Pause (the space bar, too) and stop, in Meshcat while entered.

    waited_sec: for how long it has stood still.
    """

    def __init__(self, meshcat: Meshcat | None):
        self._meshcat = meshcat
        self.waited_sec = 0.0

    def __enter__(self):
        if self._meshcat is not None:
            self._meshcat.AddButton(PAUSE, "Space")
            self._meshcat.AddButton(STOP)
        return self

    def __exit__(self, *_):
        if self._meshcat is not None:
            for name in (PAUSE, STOP):
                self._meshcat.DeleteButton(name)

    def stopped(self, ended: Callable[[], bool], at_rest: Callable[[], None]) -> bool:
        """Waits while the simulation is paused. Returns: whether it is to end.

        Args: ended: whether it is to end for another reason, asked while waiting.
            at_rest: called after each pause.
        """
        if self._meshcat is None:
            return False
        began = perf_counter()
        waited = False
        while not self._clicks(STOP) and not ended() and self._clicks(PAUSE) % 2:
            waited = True
            sleep(LOOK_SEC)
        if waited:
            self.waited_sec += perf_counter() - began
            at_rest()
        return self._clicks(STOP) > 0

    def _clicks(self, name: str) -> int:
        return 0 if self._meshcat is None else self._meshcat.GetButtonClicks(name)
