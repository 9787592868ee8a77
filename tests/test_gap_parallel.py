"""Computations side by side: as one after the other, but for what they leave behind."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from makebreak.gap.parallel import side_by_side
from makebreak.scripts.runner.trials import run_environment


@pytest.mark.parametrize("jobs", [1, 3])
def test_results_come_in_the_order_of_the_calls(jobs):
    # What cannot be sent, a local function, may be called all the same.
    kept = {"offset": 10}
    calls = [partial(lambda k: k + kept["offset"], k) for k in range(7)]
    assert list(side_by_side(calls, jobs)) == list(range(10, 17))
    assert list(side_by_side([], jobs)) == []


def test_calls_run_in_other_processes_and_leave_nothing_behind():
    seen: list[int] = []

    def call() -> int:
        seen.append(1)
        return os.getpid()

    pids = list(side_by_side([call] * 4, 2))
    assert os.getpid() not in pids and not seen
    assert list(side_by_side([call] * 2, 1)) == [os.getpid()] * 2 and len(seen) == 2


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_first_failure_is_raised_after_the_results_before_it(jobs):
    def fail():
        raise ValueError("no such body")

    found = []
    with pytest.raises(ValueError, match="no such body"):
        for result in side_by_side([lambda: 1, fail, lambda: 3], jobs):
            found.append(result)
    assert found == [1]


_SLOW = r"""
import os, sys, time
from makebreak.gap.parallel import side_by_side

def call():
    os.write(1, f"{os.getpid()}\n".encode())  # In one piece.
    time.sleep(100)

list(side_by_side([call] * 2, 2))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_nothing_outlives_a_parent_that_is_interrupted_or_killed(number):
    process = subprocess.Popen(
        [sys.executable, "-c", _SLOW],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=run_environment(),
    )
    assert process.stdout is not None
    copies = [int(process.stdout.readline()) for _ in range(2)]
    process.send_signal(number)
    process.wait(timeout=60)
    end = time.monotonic() + 10
    while any(_runs(pid) for pid in copies):
        assert time.monotonic() < end, "a copy still runs"
        time.sleep(0.02)


def _runs(pid: int) -> bool:
    """Whether it does, and is not merely waiting for somebody to ask how it ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"
