"""Several computations at once, each in a copy of this process."""

import multiprocessing
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

T = TypeVar("T")
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
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("fork"))
    try:
        with warnings.catch_warnings():
            # The copies neither use nor wait for a progress bar's thread.
            warnings.simplefilter("ignore", DeprecationWarning)
            futures = [pool.submit(_call, k) for k in range(len(calls))]
        for future in futures:
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        _calls = ()


def _call(k: int):
    return _calls[k]()
