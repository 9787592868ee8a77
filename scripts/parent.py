"""Ends a run with the process that started it, however that one ended."""

import ctypes
import os
import signal
import sys

PARENT = "MAKEBREAK_PARENT"  # Names, to a run, the process that it must not outlive.


def end_with_parent() -> bool:
    """Makes this process end when the one that PARENT names ends. That one may be
    killed (SIGKILL), which leaves it no time to end its runs. On Linux only.

    Returns: whether there is such a process.
    """
    parent = os.environ.pop(PARENT, None)
    if parent is None or not sys.platform.startswith("linux"):
        return parent is not None
    set_parent_death_signal = 1
    ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
    if os.getppid() != int(parent):  # It ended before that.
        os.kill(os.getpid(), signal.SIGKILL)
    return True
