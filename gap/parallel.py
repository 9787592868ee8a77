"""Several computations at once, each in a copy of this process."""

import ctypes
import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from typing import TypeVar

from makebreak.gap.budget import go_on, present

T = TypeVar("T")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
ASK_SEC = 0.1  # Whether to go on, while others compute.
_calls: Sequence[Callable] = ()  # Of the pool that is being made: its copies have them.


def side_by_side(calls: Sequence[Callable[[], T]], jobs: int) -> Iterator[T]:
    """The results of the calls, in their order, each as soon as it and those before it
    are there.

    The calls may use anything that is in memory: a process is copied, and nothing but
    results is sent. What a call changes is lost. One after the other where jobs is 1
    or processes cannot be copied (Windows, macOS).

    Raises: what the first call that fails raises.
    """
    global _calls
    jobs = min(jobs, len(calls))
    if jobs < 2 or not sys.platform.startswith("linux"):
        for call in calls:
            yield call()
        return
    _calls = calls
    pool = ProcessPoolExecutor(
        jobs, multiprocessing.get_context("fork"), _of_parent, (os.getpid(),)
    )
    try:
        with warnings.catch_warnings():
            # The copies neither use nor wait for a progress bar's thread.
            warnings.simplefilter("ignore", DeprecationWarning)
            futures = [pool.submit(_call, k) for k in range(len(calls))]
        for future in futures:
            while not wait([future], ASK_SEC).done:
                go_on()
            yield future.result()
    except BaseException:  # Ctrl-C, or the caller has enough: nobody waits for these.
        for process in list((pool._processes or {}).values()):
            process.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        _calls = ()


def _of_parent(parent: int) -> None:
    """In a copy: signals, which may be sent to the whole group, are for the parent, and
    it ends the copies. Where it is killed, they end with it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # It was faster.
        os._exit(1)
    present().in_a_copy()


def _call(k: int):
    return _calls[k]()
