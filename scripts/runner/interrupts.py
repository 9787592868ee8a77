"""Handles SIGTERM (kill, timeout) and SIGHUP (a closed terminal) like Ctrl-C."""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TWICE_SEC = 1.0
_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


@contextmanager
def handled(handler: Callable[[int, object], None]) -> Iterator[None]:
    """Context in which `handler` is called for all three signals, except those that are
    ignored (SIGHUP under nohup). Without effect outside the main thread."""
    old = {}
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                old[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, before in old.items():
            signal.signal(number, before)


class CatchInterrupt:
    """While entered, Ctrl-C sets `hit`, as SIGTERM and SIGHUP do; the second Ctrl-C
    raises KeyboardInterrupt, and so does a SIGTERM a second or more later."""

    def __init__(self):
        self.hit = False
        self._since = 0.0
        self._handled = handled(self._handle)

    def _handle(self, number, _):
        leave_terminal(number)
        # The others may come twice by themselves, as when a terminal is closed, or from
        # `timeout`, which tells the process and its group.
        meant = number == signal.SIGINT or (
            number == signal.SIGTERM and monotonic() > self._since + TWICE_SEC
        )
        if self.hit and meant:
            raise KeyboardInterrupt
        if not self.hit:
            self._since = monotonic()
        self.hit = True

    def __enter__(self):
        self._handled.__enter__()
        return self

    def __exit__(self, *_):
        self._handled.__exit__(None, None, None)


def interrupts():
    """Context in which all three signals raise KeyboardInterrupt."""

    def interrupt(number, _):
        leave_terminal(number)
        raise KeyboardInterrupt

    return handled(interrupt)


def undisturbed():
    """Context in which the three signals are ignored, for short writes of files."""
    return handled(lambda number, _: leave_terminal(number))


def leave_terminal(number: int) -> None:
    """After SIGHUP, redirects output to a terminal to /dev/null: the terminal may be
    gone, and writing to it would end the run with an error."""
    if number != signal.SIGHUP:
        return
    for stream in (sys.__stdout__, sys.__stderr__):
        try:
            fd = stream.fileno()  # type: ignore[union-attr]
            poll = select.poll()
            poll.register(fd, select.POLLOUT)
            gone = any(what & _GONE for _, what in poll.poll(0))
        except (AttributeError, OSError, ValueError):
            continue
        if gone:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, fd)
            os.close(nowhere)
