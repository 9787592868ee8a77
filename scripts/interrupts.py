"""SIGTERM (kill, timeout) and SIGHUP (a closed terminal) count as Ctrl-C."""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


@contextmanager
def handled(handler: Callable[[int, object], None]) -> Iterator[None]:
    """While entered, `handler` is called for all three signals, but for one that is
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


def interrupts():
    """While entered, all three raise KeyboardInterrupt."""

    def interrupt(number, _):
        leave_terminal(number)
        raise KeyboardInterrupt

    return handled(interrupt)


def undisturbed():
    """While entered, the three do nothing: what is being written is soon complete."""
    return handled(lambda number, _: leave_terminal(number))


def leave_terminal(number: int) -> None:
    """After SIGHUP the terminal may be gone: what would be printed there goes nowhere,
    instead of being an error that ends the run."""
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
