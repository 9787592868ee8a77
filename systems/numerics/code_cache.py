"""Compiled functions are kept by what they were made of, for all copies of makebreak.

Numba keeps them beside the source, and compiles again when that file has changed. Here
they are in ~/.cache/makebreak/compiled, under the hash of the file and of all files of
makebreak that it imports, directly or not (a caller contains the code of what it
calls, and the values of constants). So a second clone or an update compiles only what
is new to this user. Importing this module, before a function is decorated, is enough.

NUMBA_CACHE_DIR and NUMBA_CACHE_LOCATOR_CLASSES do what Numba says. Where nothing can
be written below the home folder, Numba's own places serve.
"""

import gc
import hashlib
import os
import re
import shutil
import time
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import caching, event, lowering
from numba.extending import overload
from numba.np import arrayobj

ROOT = Path(__file__).resolve().parents[2]  # Above the rooms.
KEPT_DAYS = 30  # After the last use.
CONFIG: Any = numba.config  # Its names are set when it is loaded.

_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+(makebreak[\w.]*|\.[\w.]*)[ \t]+import[ \t]+"
    r"(\([^)]*\)|[^\n]*)|import[ \t]+(makebreak[\w.]*))",
    re.MULTILINE,
)


def user_cache() -> Path:
    """$XDG_CACHE_HOME/makebreak, or ~/.cache/makebreak; it need not exist."""
    home = os.environ.get("XDG_CACHE_HOME")
    return Path(home or Path(os.path.expanduser("~"), ".cache")) / "makebreak"


@cache
def digest(file: Path, root: Path = ROOT) -> str:
    """Of a file below `root`, the folder of makebreak's rooms, and of all that it
    imports from there, directly or not."""
    seen, left = {file}, [file]
    while left:
        found = _read(left.pop(), root)[1] - seen
        seen |= found
        left += found
    sums = sorted((str(f.relative_to(root)), _read(f, root)[0]) for f in seen)
    return hashlib.sha256(repr(sums).encode()).hexdigest()[:24]


@cache
def _read(file: Path, root: Path) -> tuple[str, frozenset[Path]]:
    """Hash of a file's text, and the files that its import lines name."""
    text = file.read_text()
    names = set()
    for base, imported, plain in _IMPORT.findall(text):
        parts = (base or plain).split(".")
        if parts[0] == "makebreak":
            folder = root.joinpath(*parts[1:])
        else:  # Relative: one dot for each level, the first for the file's own folder.
            dots = len(base) - len(base.lstrip("."))
            folder = file.parents[dots - 1].joinpath(*parts[dots:])
        names |= {folder, *(folder / name for name in re.findall(r"\w+", imported))}
    found = {f for n in names for f in (n.with_suffix(".py"), n / "__init__.py")}
    return hashlib.sha256(text.encode()).hexdigest(), frozenset(
        f for f in found if f.is_file()
    )


class BySource(caching._CacheLocator):
    """Where Numba finds the compiled code of a function of makebreak."""

    def __init__(self, function, file: Path):
        self._py_file = str(file)
        self._line = function.__code__.co_firstlineno
        # Code with checked indices is other code, which Numba does not notice.
        self._digest = digest(file) + "checked" * bool(CONFIG.BOUNDSCHECK)
        self._path = user_cache() / "compiled" / f"{function.__module__}-{self._digest}"

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function, file):
        """A locator, or None for a function of others, or where none can write."""
        path = Path(file).resolve()
        if CONFIG.CACHE_DIR or not path.is_relative_to(ROOT):
            return None
        if not function.__module__.startswith("makebreak."):
            return None
        locator = cls(function, path)
        try:
            _used(locator._path)
        except OSError:
            return None
        return locator


@cache
def _used(folder: Path) -> None:
    """Makes the folder or notes its use; a new one replaces old ones of its module."""
    if folder.is_dir():
        os.utime(folder)
        return
    folder.mkdir(parents=True, exist_ok=True)
    for other in folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*"):
        if time.time() - other.stat().st_mtime > KEPT_DAYS * 86400:
            shutil.rmtree(other, ignore_errors=True)


def _wrong_shape(source, target):
    """What compiled code calls when `a[i:j] = b` does not fit."""


@overload(_wrong_shape)
def _(source, target):
    def fails(source, target):
        raise ValueError("cannot assign an array to a slice of another shape")

    return fails


# Numba puts both shapes into the message: code that makes strings in each function
# with such a line, a tenth of the time to compile.
if hasattr(arrayobj, "raise_with_shape_context"):
    arrayobj.raise_with_shape_context = _wrong_shape


class _Collected(event.Listener):
    """No garbage collection while Numba compiles, which makes millions of objects that
    stay: to look through them again and again takes a tenth of the time."""

    depth = 0
    enabled = False

    def on_start(self, event):
        if self.depth == 0:
            self.enabled = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event):
        self.depth -= 1
        if self.depth == 0 and self.enabled:
            gc.enable()


event.register("numba:compile", _Collected())


def _for_c(lower, create=lowering.Lower.create_cfunc_wrapper):
    """Numba's wrapper of a function for calls from C and through variables, which no
    function of makebreak is for: a sixteenth of the time to compile."""
    if not lower.fndesc.modname.startswith(("makebreak.", "numba.")):
        create(lower)


lowering.Lower.create_cfunc_wrapper = _for_c  # type: ignore[method-assign]

# LLVM's third level takes a fifth longer to compile, and runs no faster here.
if "NUMBA_OPT" not in os.environ:
    CONFIG.OPT = type(CONFIG.OPT)(2)

if not CONFIG.CACHE_LOCATOR_CLASSES:
    own = f"{__name__}.{BySource.__name__}"
    others = (locator.__name__ for locator in caching.CacheImpl._locator_classes)
    CONFIG.CACHE_LOCATOR_CLASSES = ",".join((own, *others))


def _save_or_not(cache, signature, code, save=caching.Cache.save_overload):
    """Numba's own, but where a file cannot be written (a full disk) the code serves
    this process alone."""
    try:
        save(cache, signature, code)
    except OSError:
        pass


caching.Cache.save_overload = _save_or_not  # type: ignore[method-assign]
