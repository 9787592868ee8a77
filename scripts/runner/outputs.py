"""Output folders of commands: results appear complete, and no file is ever lost."""

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from datetime import datetime
from hashlib import sha256
from pathlib import Path

MARK = ".makebreak.json"  # Names the command that wrote the folder, and its files.
STAGE = ".unfinished"  # Folder in which files are written before they are moved.
KILLED = "killed"  # Folder to which the next run moves recordings of a killed one.
KEPT = "unfinished"  # Folder of an interrupted run beside an older, complete one.
_LOCK = "lock"
# Suffixes of files that commands write; in a folder without a mark they are the user's.
_SUFFIXES = ".csv .html .json .npz .parquet .png .py .sdf .yaml".split()
_NAMES = ("reproduce.md", "error.txt")


class OutputFolder:
    """A folder for the files of one command, locked until it is closed.

    Files are written into a hidden folder, to the path that `file` gives, and moved to
    their places by `commit`. Until then an earlier result of the same command is kept;
    `commit` replaces its files, and removes those that the new result does not have.
    Nothing else in the folder is touched. For a `with`, which drops uncommitted files.

    Args:
        path: the folder; made if it is missing.
        command: that writes there, such as "run ball_rolling".
        inputs: files that the command reads.
        only_new: whether a folder that the command did not make must be empty.
    Raises: ValueError, in one line, for a folder that cannot be made or written to,
        that holds inputs or files of another command or of the user, or that another
        process is writing to. Then nothing has been changed.
    """

    def __init__(
        self,
        path: str | Path,
        command: str,
        inputs: Iterable[str | Path] = (),
        only_new: bool = False,
    ):
        self.path = Path(path)
        self.command = command
        self.stage = self.path / STAGE
        self.salvaged: Path | None = None  # Recordings of a run that was killed.
        self._lock: int | None = None
        self._made: list[Path] = []  # Folders that did not exist before.
        self._kept: list[Path] = []
        for each in inputs:
            if self._may_write(Path(each)):
                self._refuse(f"holds {Path(each).name}, which this command reads")
        try:
            self._enter()
            self._old = self._check(only_new)
            if not self._old:  # So that files of a killed run are known.
                self._mark(self.path, {}, complete=False)
        except OSError as error:
            self.close()
            raise ValueError(
                f'--out: got "{path}", expected a folder to write in ({error.strerror})'
            ) from error
        except BaseException:
            self.close()
            raise

    def _may_write(self, file: Path) -> bool:
        """Whether the file, with links resolved, is in a place that may be written."""
        here = self.path.resolve()
        old = {(here / name).resolve() for name in _read_mark(here).get("files", {})}
        folders = (here, here / KEPT)
        places = (file.parent.resolve() / file.name, file.resolve())
        return any(place in old or place.parent in folders for place in places)

    def _refuse(self, why: str):
        word = self.command.split()[0]
        other, n = self.path / word, 1
        while os.path.lexists(other):
            n += 1
            other = self.path / f"{word}-{n}"
        raise ValueError(
            f'--out: "{self.path}" {why}; type another folder, for example '
            f"--out {other}"
        )

    def _enter(self) -> None:
        """Makes the hidden folder, empty, and locks it."""
        for folder in (self.path, *self.path.parents):
            if folder.exists():
                break
            self._made.append(folder)
        while self._lock is None:
            self.stage.mkdir(parents=True, exist_ok=True)
            try:
                lock = os.open(self.stage / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
            except FileNotFoundError:  # Another process has just ended there.
                continue
            try:
                # Not flock, as worker processes inherit its locks and may outlive a run
                # that is killed.
                fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno in (errno.EACCES, errno.EAGAIN):
                    who = os.read(lock, 20).decode(errors="replace")
                    os.close(lock)
                    self._refuse(f"is being written by another run (process {who})")
                # A file system without locks: then there is none.
            try:
                same = os.fstat(lock).st_ino == (self.stage / _LOCK).stat().st_ino
            except FileNotFoundError:
                same = False
            if same:
                self._lock = lock
            else:
                os.close(lock)
        os.ftruncate(self._lock, 0)
        os.pwrite(self._lock, str(os.getpid()).encode(), 0)
        # Left by a run that was killed.
        recorded = sorted(self.stage.glob("recording*.csv"))
        if recorded:
            place = self.path / KILLED
            self.salvaged = _free(place) if os.path.lexists(place) else place
            self.salvaged.mkdir()
            for each in recorded:
                os.replace(each, self.salvaged / each.name)
        for old in self.stage.iterdir():
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old)
            elif old.name != _LOCK:
                old.unlink()

    def _check(self, only_new: bool) -> dict:
        """The mark of an earlier result of this command; empty without one."""
        mark = _read_mark(self.path)
        strangers = self._unlisted(only_new)
        if strangers and not mark:
            self._refuse(f"holds {strangers[0]}, which makebreak did not write")
        if not strangers and not mark.get("files"):
            return {}
        if mark["command"] != self.command:
            self._refuse(f"holds the files of makebreak {mark['command']}")
        for name, digest in mark["files"].items():
            path = self.path / name
            if path.is_dir():
                self._refuse(f"holds a folder {name}, expected a file")
            if path.is_file() and _digest(path) != digest:
                self._refuse(f"holds {name}, which was changed by hand")
        return mark

    def _unlisted(self, every: bool = False) -> list[str]:
        """Files that need a mark; every: not only those that look like a command's."""
        return sorted(
            each.name
            for each in self.path.iterdir()
            if not each.name.startswith(".") and each.name != "log.txt"
            and (every or each.name in _NAMES or each.suffix in _SUFFIXES)
        )  # fmt: skip

    def file(self, name: str) -> Path:
        """The path to write the file `name` to; makes its folder."""
        path = self.stage / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def written(self) -> list[Path]:
        """The uncommitted files."""
        return [
            path
            for path in sorted(self.stage.rglob("*"))
            if path.is_file() and path != self.stage / _LOCK
        ]

    def keep(self) -> list[Path]:
        """Copies the files so far to their places, incomplete, for whoever needs them
        before the end, or should the process be killed; `commit` replaces them.

        Returns: the files at their places.
        """
        target, old = self._place_of_incomplete()
        files = self.written()
        digests = {p.relative_to(self.stage).as_posix(): _digest(p) for p in files}
        target.mkdir(exist_ok=True)
        self._mark(target, old | digests, complete=False)
        for name, path in zip(digests, files, strict=True):
            place = target / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(place) and name not in old:
                os.replace(place, _free(place))  # The user's.
            shutil.copyfile(path, place)
        self._made.clear()
        if target == self.path:
            self._old = _read_mark(target)
        self._kept = [target / name for name in digests]
        return self._kept

    def _place_of_incomplete(self) -> tuple[Path, dict[str, str]]:
        """The folder of files of a run that is not complete, beside an older one that
        is, and the files there that commands wrote."""
        if not self._old.get("complete"):
            return self.path, self._old.get("files", {})
        target = self.path / KEPT
        return target, _read_mark(target).get("files", {})

    def commit(self, complete: bool = True) -> list[Path]:
        """Moves all files to their places, and closes the folder.

        Args: complete: False keeps an older, complete result and moves the files into
            the subfolder `unfinished`.
        Returns: the files at their places.
        """
        target = self.path
        old: dict[str, str] = self._old.get("files", {})
        if not complete:
            target, old = self._place_of_incomplete()
            target.mkdir(exist_ok=True)
        new = {path.relative_to(self.stage).as_posix(): path for path in self.written()}
        digests = {name: _digest(path) for name, path in new.items()}
        # If the process ends between the two marks, all files are still known.
        self._mark(target, old | digests, complete=False)
        try:
            for name, path in new.items():
                place = target / name
                place.parent.mkdir(parents=True, exist_ok=True)
                if os.path.lexists(place) and (name not in old or place.is_dir()):
                    os.replace(place, _free(place))  # The user's.
                os.replace(path, place)
        except OSError as error:
            self.close(keep_stage=True)
            raise ValueError(
                f"--out: {self.path} cannot be written ({error.strerror}); the files "
                f"are in {self.stage}"
            ) from error
        for name in old.keys() - new.keys():
            (target / name).unlink(missing_ok=True)
        self._mark(target, digests, complete)
        for kept in self._kept if complete else ():
            if kept.parent == self.path / KEPT:
                kept.unlink(missing_ok=True)
        self._made.clear()
        self.close()
        return [target / name for name in new]

    def _mark(self, target: Path, files: dict[str, str], complete: bool) -> None:
        mark = {"command": self.command, "complete": complete, "files": files}
        new = self.stage / MARK
        try:
            new.write_text(json.dumps(mark, indent=1) + "\n")
            os.replace(new, target / MARK)
        except OSError:  # Disk full: the files matter more than their list.
            new.unlink(missing_ok=True)

    def close(self, keep_stage: bool = False) -> None:
        """Drops uncommitted files and unlocks the folder. May be called twice."""
        if self._lock is not None:
            if not keep_stage:
                shutil.rmtree(self.stage, ignore_errors=True)
            mark = _read_mark(self.path)
            with suppress(OSError):
                if not (mark.get("complete") or mark.get("files") or self._unlisted()):
                    (self.path / MARK).unlink()
            os.close(self._lock)
            self._lock = None
        for folder in self._made:  # Only empty ones can be removed.
            try:
                folder.rmdir()
            except OSError:
                break
        self._made.clear()

    def __enter__(self) -> "OutputFolder":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def is_complete(folder: Path) -> bool:
    """Whether a command has written all of its files there."""
    return bool(_read_mark(folder).get("complete"))


def _read_mark(folder: Path) -> dict:
    try:
        mark = json.loads((folder / MARK).read_text())
        if isinstance(mark["command"], str) and isinstance(mark["files"], dict):
            # Paths in a mark that lead out of the folder are ignored.
            inside = {
                name: digest
                for name, digest in mark["files"].items()
                if not Path(name).is_absolute() and ".." not in Path(name).parts
            }
            return {**mark, "files": inside}
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return {}


def _digest(path: Path) -> str:
    """A digest that shows edits by the user; "" for files that nobody edits."""
    if path.suffix != ".yaml":
        return ""
    return sha256(path.read_bytes()).hexdigest()[:16]


def _free(path: Path) -> Path:
    """An unused name beside `path`."""
    n = 1
    while os.path.lexists(path.with_name(f"{path.name}.{n}")):
        n += 1
    return path.with_name(f"{path.name}.{n}")


def default_out(name: str) -> Path:
    """runs/<name>-<time>, or with -2, -3 ... where that is taken."""
    stem = f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    path, n = Path("runs") / stem, 1
    while path.exists():
        n += 1
        path = Path("runs") / f"{stem}-{n}"
    return path


def check_written(session) -> None:
    """Raises: ValueError if a file could not be written."""
    if session.unwritten is not None:
        error = session.unwritten
        raise ValueError(
            f"--out: not all files could be written in {session.out_dir} "
            f"({error.strerror or error}); what could be written is kept"
        )
