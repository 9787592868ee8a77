"""What a command tells on the standard output: tables, lines and the files it wrote.

With `--json` all of that goes to the standard error, and at the end one JSON document
to the standard output. With `--quiet` nothing is printed but errors.
"""

import io
import json
import os
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, TextIO

from makebreak.scripts.runner.table import Table, json_value

_facts: dict[str, Any] = {}  # Of the command that is carried out: its JSON document.
_quiet = False
_RESULT = "result.json"  # Of `run` and `gap`: it is in the document, too.


def is_quiet() -> bool:
    """Whether no progress is to be shown."""
    return _quiet


def say(text: str) -> None:
    """A line of progress, beside what the command tells."""
    if not _quiet:
        print(text, file=sys.stderr, flush=True)


def show(table: Table, shown: Table | None = None) -> None:
    """Tells a table. shown: the same as it is better read in a terminal."""
    _facts.setdefault("tables", []).append(table.to_dict())
    print((shown or table).to_text(terminal_width()), flush=True)


def terminal_width() -> int | None:
    """Of the terminal [characters]; None of a file or a pipe."""
    return get_terminal_size().columns if sys.stdout.isatty() else None


def tell(**facts: Any) -> None:
    """What the JSON document has beside tables and files."""
    _facts.update(facts)


def print_files(files: Sequence[Path], to: TextIO | None = None) -> None:
    """Tells which files were written, and where: in their common folder, as an
    interrupted run may have a subfolder. to: None: the standard output; others are not
    in the JSON document."""
    if not files:
        return
    if to is None:
        _facts.setdefault("files", []).extend(map(str, files))
    elif _quiet:
        return
    folder = Path(os.path.commonpath([path.parent for path in files]))
    names = " ".join(path.relative_to(folder).as_posix() for path in files)
    print(f"Files in {folder}: {names}", flush=True, file=to)


@contextmanager
def telling(command: str, args: Namespace) -> Iterator[Callable[[int], None]]:
    """While a command is carried out, for a `with`; gives what is to be called with its
    exit status. args: its options; json and quiet are read."""
    as_json, quiet = getattr(args, "json", False), getattr(args, "quiet", False)
    global _quiet
    before, out = _quiet, sys.stdout
    _facts.clear()
    _quiet = quiet

    def ended(status: int) -> None:
        if as_json and status not in (2, 3):  # Bad input, a bug: only the message.
            document: dict[str, Any] = {"command": command, "status": status}
            document |= {"tables": [], "files": []} | _facts
            for file in map(Path, _facts.get("files", [])):
                if file.name == _RESULT:
                    document["result"] = json.loads(file.read_text())
            print(json.dumps(json_value(document), indent=2), file=out, flush=True)

    elsewhere: TextIO = io.StringIO() if quiet else sys.stderr
    try:
        if as_json or quiet:
            with redirect_stdout(elsewhere):
                yield ended
        else:
            yield ended
    finally:
        _quiet = before
