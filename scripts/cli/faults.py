"""Error messages and exit statuses: one line, and the place of the traceback.

2: an input was refused by a check of makebreak's, or a value failed (in Drake, numpy or
makebreak) before any computation, so that the input must be at fault.
3: any other failure, of makebreak itself or of a library; at any time what no input can
cause, as a name that does not exist.
MAKEBREAK_DEBUG=1 prints the traceback, too.
"""

import linecache
import os
import sys
import sysconfig
import tempfile
import traceback
from pathlib import Path
from types import TracebackType

_PACKAGE = Path(__file__).resolve().parents[2]
_LIBRARIES = [Path(each).resolve() for each in set(sysconfig.get_paths().values())]
_ROOMS = ("models", "systems", "diagrams", "gap", "scripts", "benchmarks")
# What a slip in a program raises, whatever its input is.
_SLIPS = (NameError, AttributeError, TypeError, AssertionError, NotImplementedError)
# Modules in which errors of worker processes are raised again.
_PASSES_ON = ("concurrent/futures", "multiprocessing")


def on_purpose(error: BaseException) -> bool:
    """Whether it is a ValueError that a `raise` in makebreak or in a user's experiment
    raised, which refuses an input, and not one from within a library."""
    if not isinstance(error, ValueError) or error.__traceback__ is None:
        return False
    last: TracebackType = error.__traceback__
    while last.tb_next is not None:
        last = last.tb_next
    file = last.tb_frame.f_code.co_filename
    path = Path(file).resolve()
    ours = any(path.is_relative_to(_PACKAGE / room) for room in _ROOMS) or not any(
        path.is_relative_to(folder) for folder in _LIBRARIES
    )
    passed_on = any(part in Path(file).as_posix() for part in _PASSES_ON)
    line = linecache.getline(file, last.tb_lineno).strip()
    return (ours or passed_on) and line.startswith("raise")


def is_drakes(error: BaseException) -> bool:
    """Whether an assertion failed in Drake, which pydrake turns into SystemExit."""
    return isinstance(error, SystemExit) and isinstance(error.code, str)


def refused(error: BaseException) -> int:
    """Prints why an input is refused; of a slip in the program, that it is one.

    Returns: the exit status.
    """
    if isinstance(error, _SLIPS):
        return fault(error)
    message = _one_line(error)
    if on_purpose(error):
        print(f"makebreak: {message}", file=sys.stderr)
    else:
        print(
            f"makebreak: the input cannot be used: {_name(error)}{message} "
            f"(the traceback is in {_kept(error)})",
            file=sys.stderr,
        )
    return 2


def fault(error: BaseException, kept: Path | None = None) -> int:
    """Prints that makebreak failed, and the traceback's place: `kept`, if given.

    Returns: the exit status.
    """
    print(
        f"makebreak: a fault of makebreak itself, please report it: {_name(error)}"
        f"{_one_line(error)} (the traceback is in {kept or _kept(error)})",
        file=sys.stderr,
    )
    if os.environ.get("MAKEBREAK_DEBUG"):
        traceback.print_exception(error)
    return 3


def _name(error: BaseException) -> str:
    return "" if is_drakes(error) else f"{type(error).__name__}: "


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 1000 else f"{text[:1000]}..."


def _kept(error: BaseException) -> str:
    """Path of a new file with the traceback."""
    text = "".join(traceback.format_exception(error))
    try:
        handle, name = tempfile.mkstemp(prefix="makebreak-error-", suffix=".txt")
        with os.fdopen(handle, "w") as file:
            file.write(text)
    except OSError as failed:
        return f"no file, as none could be written: {failed.strerror}"
    return name
