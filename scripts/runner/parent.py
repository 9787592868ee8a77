"""Ends a run when the process that started it ends, in whatever way."""

import ctypes
import os
import signal
import sys

PARENT = "MAKEBREAK_PARENT"  # Environment variable with the process id of the parent.


def end_with_parent() -> bool:
    """Makes this process end when the parent that PARENT names ends, even if that is
    killed (SIGKILL) and cannot end its runs. Linux only.

    Returns: whether PARENT is set.
    """
    parent = os.environ.pop(PARENT, None)
    if parent is None or not sys.platform.startswith("linux"):
        return parent is not None
    set_parent_death_signal = 1
    ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
    if os.getppid() != int(parent):  # The parent has ended already.
        os.kill(os.getpid(), signal.SIGKILL)
    return True
