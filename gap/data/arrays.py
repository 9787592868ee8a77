"""Dictionaries of arrays as one table: .npz, .npy, MATLAB's .mat, HDF5, JSON.

What has a row for each instant is a column, whichever way round it lies; a number such
as `dt` or `frequency` gives the time where no column does; a list of joints' names
names the columns of arrays that are as wide. What is none of these is left out, and
said.
"""

import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from makebreak.gap.data.hdf5 import HDF5, is_hdf5, read_tree

STRETCHES = 20  # Of rows, of a table too long to keep.
MOST_BYTES = 1 << 32  # Of an npz file's columns together, as they are in memory.
FEWEST = 10  # Numbers in what may be a column.
TIME_WORDS = set(
    "time t timestamp timestamps stamp stamps ts sec secs seconds clock utime datetime "
    "walltime epoch nsec nsecs usec usecs msec msecs nanoseconds microseconds "
    "milliseconds millis micros tick ticks tout".split()
)
# Scalars between two rows, and of rows a second, in small letters without signs.
_PERIOD = re.compile(r"(\w*(time|step|control|sim|sample)_?)?(dt|period)|time_?step|"
                     r"sampl(e|ing)_?time|ts")  # fmt: skip
_RATE = re.compile(r"\w*(frequency|freq|hz|fps|fs)|\w*(sampl(e|ing)|control|log)_?rate")
_OF_A_BODY = set("quat quaternion root base imu pose foot feet contact".split())
_RUNS = set(
    "demo demos episode episodes ep run runs trial traj trajectory rollout take test "
    "experiment exp recording log session".split()
)
_PICKLES = (".pt", ".pth", ".pkl", ".pickle", ".joblib")
_PICKLED = (
    "it holds pickled objects, which can run code when they are read: save its arrays "
    "as npz, as in np.savez('log.npz', **{k: np.asarray(v) for k, v in log.items()})"
)
_LINES = (".jsonl", ".ndjson")
ARRAYS = (".npz", ".npy", ".mat", ".json", *HDF5, *_LINES)

Read = tuple[dict[str, np.ndarray], np.ndarray, int, list[tuple[str, str]]]


def words_of(name: str) -> list[str]:
    """Lower-case words and numbers of a name, also of jointOne, q_1 and q[1]."""
    name = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return re.findall(r"[a-z]+|\d+", name.lower())


def why_not(suffix: str) -> str:
    """What to do with a file of another format; "" if there is nothing to say."""
    return _PICKLED if suffix in _PICKLES else ""


def kept_rows(n_rows: int, n_columns: int, most_cells: int) -> list[tuple[int, int]]:
    """[first, last) rows, from 0, that are kept of a table of n_rows."""
    most_rows = max(most_cells // max(n_columns, 1), STRETCHES)
    if n_rows <= most_rows:
        return [(0, n_rows)]
    length, every = most_rows // STRETCHES, n_rows / STRETCHES
    starts = [int((i + 0.5) * every - 0.5 * length) for i in range(STRETCHES)]
    return [(start, start + length) for start in starts]


def spread(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """Columns name[0], name[1], ... of (n, k) numbers."""
    return {
        f"{name}[{i}]": np.ascontiguousarray(value[:, i]) for i in range(value.shape[1])
    }


def read_npz(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """Columns (n,), numbers (n,) of their rows from 1, rows of the file, notes.

    Raises: ValueError, one line.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
        if size > MOST_BYTES:
            raise ValueError(
                f"recording {path} holds {size} bytes, expected at most {MOST_BYTES}: "
                "cut it into several"
            )
        with np.load(path, allow_pickle=False) as file:
            objects: list[str] = []

            def load(name: str):
                try:
                    return file[name]
                except ValueError as error:
                    if "pickle" not in str(error):
                        raise
                    objects.append(name)  # Only they need pickles.
                    return None

            return _table(path, [n for n in file if n not in unused], load, most_cells)
    except (OSError, zipfile.BadZipFile, EOFError, zlib.error) as error:
        raise ValueError(f"recording {path} is no npz file: {error}") from None
    except (MemoryError, NotImplementedError, RuntimeError, SyntaxError) as error:
        why = " ".join(str(error).split())[:100]  # A header that lies, a cipher.
        raise ValueError(f"recording {path} cannot be read: {why}") from None
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"recording {path} is no npz of numbers: {error}") from None


def read_npy(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """The same of one array: of records, or of numbers without names.

    Raises: ValueError, one line.
    """
    try:
        value = np.load(path, allow_pickle=False)
    except (OSError, EOFError, ValueError, SyntaxError, MemoryError) as error:
        why = _PICKLED if "pickle" in str(error) else " ".join(str(error).split())[:100]
        raise ValueError(f"recording {path} cannot be read: {why}") from None
    names = value.dtype.names or ("column",)
    fields = {n: value[n] if value.dtype.names else value for n in names}
    return _table(path, [n for n in names if n not in unused], fields.get, most_cells)


def read_mat(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """The same of a MATLAB file; a struct's fields are <struct>/<field>.

    Raises: ValueError, one line.
    """
    from scipy.io import loadmat

    if is_hdf5(path):  # Version 7.3.
        return read_hdf5(path, most_cells, unused)
    try:
        content = loadmat(path, simplify_cells=True)
    except Exception as error:  # The library raises whatever its parser runs into.
        why = " ".join(str(error).split())[:100] or type(error).__name__
        raise ValueError(
            f"recording {path} is no .mat file that can be read: {why}"
        ) from None
    own = {k: v for k, v in content.items() if not k.startswith("__")}
    flat = {k: v for k, v in _leaves("", own) if k not in unused}
    return _table(path, list(flat), flat.get, most_cells)


def read_lines(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """The same of a text that has a JSON object in each line.

    Raises: ValueError, one line.
    """
    rows = []
    for k, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        try:
            rows += [json.loads(line)] if line.strip() else []
        except ValueError as error:
            raise ValueError(f"recording {path}, line {k}: {error}") from None
    return _of_rows(path, rows, {}, most_cells, unused)


def read_json(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """The same of one JSON document: arrays by name, of a list of objects with such
    each an episode, or the longest list of objects in it, an object a row.

    Raises: ValueError, one line.
    """
    try:
        content = json.loads(path.read_text(errors="replace"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"recording {path} is no JSON: {error}") from None
    return _of_document(path, content, most_cells, unused)


def read_hdf5(path: Path, most_cells: int, unused: frozenset[str]) -> Read:
    """The same of an HDF5 file: groups are as JSON's objects.

    Raises: ValueError, one line.
    """
    content = read_tree(path, unused, MOST_BYTES)
    return _of_document(path, content, most_cells, unused)


def _of_document(path: Path, content, most_cells: int, unused: frozenset[str]) -> Read:
    content, rows = _counted(content), []
    if episodes := next(_lists_of_episodes(content), None):
        content = _without(content, episodes) | _one_after_another(episodes)
    else:
        rows = max(_lists_of_objects(content), key=len, default=[])
    return _of_rows(path, rows, _without(content, rows), most_cells, unused)


def _counted(value):
    """With lists in the place of objects that are numbered runs (demo_0, demo_1)."""
    if isinstance(value, list):
        return [_counted(each) for each in value]
    if not isinstance(value, dict):
        return value
    own = {k: _counted(each) for k, each in value.items()}
    runs = {k: each for k, each in own.items()
            if isinstance(each, dict) and _RUNS & {*words_of(str(k))}
            and str(k)[-1].isdigit()}  # fmt: skip
    if not runs:
        return own
    each = sorted(runs, key=lambda k: int(words_of(k)[-1]))
    return {**{k: own[k] for k in own.keys() - runs}, "": [runs[k] for k in each]}


def _lists_of_episodes(value) -> Iterator[list[dict]]:
    """Lists of objects, wherever they are in a document, that have the same columns and
    no name of their own (as one for each joint has)."""
    if isinstance(value, list) and value and all(isinstance(x, dict) for x in value):
        own = [_columns_in(each) for each in value]
        if own[0] and all(x.keys() == own[0].keys() for x in own):
            if not {"label", "name", "joint"} & {*value[0]}:
                yield value
                return
    below = value.values() if isinstance(value, dict) else value
    for each in below if isinstance(value, dict | list) else ():
        if isinstance(each, dict | list):
            yield from _lists_of_episodes(each)


def _columns_in(value: Mapping) -> dict[str, list | np.ndarray]:
    """Lists of the longest kind that an object has, of a row's numbers each."""
    lists = {k: v for k, v in _leaves("", value)
             if isinstance(v, list | np.ndarray) and np.ndim(v) and len(v) >= FEWEST
             and not isinstance(v[0], str | bytes | dict)}  # fmt: skip
    n = max(map(len, lists.values()), default=0)
    return {k: v for k, v in lists.items() if len(v) == n}


def _one_after_another(episodes: Sequence[Mapping]) -> dict[str, object]:
    """Columns of all episodes, which a row is of, where they are several, and what is
    not a column and the same in all."""
    parts = [_columns_in(each) for each in episodes]
    columns = {k: [x for part in parts for x in part[k]] for k in parts[0]}
    if len(parts) > 1 and "episode" not in columns:
        counts = [len(next(iter(part.values()))) for part in parts]
        columns["episode"] = np.repeat(np.arange(len(parts)), counts).tolist()
    others = [
        {k: v for k, v in _leaves("", each) if k not in columns} for each in episodes
    ]
    once = {
        k: v for k, v in others[0].items()
        if all(k in each and np.array_equal(each[k], v) for each in others)
    }  # fmt: skip
    return {**once, **columns}


def _lists_of_objects(value) -> Iterator[list]:
    """Those with enough rows for a log, wherever they are in a document."""
    if isinstance(value, list):
        if len(value) >= FEWEST and all(isinstance(each, dict) for each in value):
            yield value
            return
    elif isinstance(value, dict):
        value = list(value.values())
    for each in value if isinstance(value, list) else []:
        if isinstance(each, dict | list):
            yield from _lists_of_objects(each)


def _without(value, rows: list) -> dict:
    """A document less one of its lists."""
    if value is rows:
        return {}
    if isinstance(value, dict):
        return {k: _without(each, rows) for k, each in value.items()}
    return value


def _of_rows(
    path: Path, rows: Sequence, beside, most_cells: int, unused: frozenset[str]
) -> Read:
    """A table of rows of names and values, with what is said once beside them."""
    flat = [dict(_leaves("", row)) for row in rows]
    once = {k: v for k, v in _leaves("", beside) if k}
    names = [*dict.fromkeys(n for row in flat for n in row), *once]

    def load(name: str):
        if name in once and once[name] is None:
            return None
        if name in once:
            each = [once[name]]
        else:
            each = [row.get(name) for row in flat]
        some = np.asarray(next((x for x in each if x is not None), np.nan))
        none = np.full(some.shape, np.nan)
        try:
            return np.array([none if x is None else x for x in each])
        except ValueError:
            return None

    names = [n for n in dict.fromkeys(names) if n not in unused]
    return _table(path, names, load, most_cells)


READERS = {
    ".npz": read_npz, ".npy": read_npy, ".mat": read_mat,
    ".json": read_json, **dict.fromkeys(_LINES, read_lines),
    **dict.fromkeys(HDF5, read_hdf5),
}  # fmt: skip


def _leaves(name: str, value) -> Iterator[tuple[str, Any]]:
    """All arrays and numbers below a struct, or a list of structs."""
    below = f"{name}/" if name else ""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _leaves(f"{below}{key}", each)
        return
    is_list = isinstance(value, list) or getattr(value, "dtype", 0) == np.dtype("O")
    some = list(value) if is_list and np.ndim(value) == 1 else []
    if some and all(isinstance(each, dict) for each in some):
        for i, each in enumerate(some):  # As Simulink's signals, with their labels.
            own = str(each.get("label") or each.get("name") or i)
            rest = {k: v for k, v in each.items() if k not in ("label", "name")}
            yield from _leaves(f"{below}{own}", rest)
        return
    yield name, value


def _table(path: Path, names: Sequence[str], load: Callable, most_cells: int) -> Read:
    """Args: load: of a name an array, or None where it cannot be read."""
    if not names:
        raise ValueError(f"recording {path} has no columns")
    shapes: dict[str, tuple[int, ...]] = {}
    numbers: dict[str, float] = {}
    labels: dict[int, tuple[str, ...]] = {}
    lost: list[str] = []
    for name in names:
        value = load(name)
        if isinstance(value, bytes):
            raise ValueError(f"recording {path}: {name} is no array")
        value = None if value is None else np.squeeze(np.asarray(value))
        if value is not None and value.dtype == object and value.size:
            if all(isinstance(each, str) for each in value.ravel()):
                value = value.astype(str)
        if value is None or value.dtype.kind not in "iufbMUS":
            lost.append(name)
        elif value.dtype.kind in "US":
            # The same names in each row, as lines of JSON have them.
            if value.ndim == 2 and len(value) and (value == value[0]).all():
                value = value[0]
            if value.ndim == 1 and len(value) not in labels or _of_joints(name):
                labels[value.size] = tuple(_text(each) for each in value.ravel())
        elif value.ndim == 0:
            numbers[name] = float(value) if value.dtype.kind != "M" else np.nan
        else:
            shapes[name] = value.shape
    lengths = [n for shape in shapes.values() for n in shape[:2] if n >= FEWEST]
    if not lengths:
        raise ValueError(
            f"recording {path} holds no array of numbers with {FEWEST} rows or more, "
            f"got {', '.join(names[:8])}"
            + (": objects, which need pickles or MATLAB" if lost else "")
        )
    times = [s[0] for name, s in shapes.items() if len(s) == 1 and is_time(name)]
    n = max(times or lengths, key=lambda k: (lengths.count(k), k))
    kept = kept_rows(n, sum(_width(s, n) for s in shapes.values()), most_cells)
    row = np.concatenate([np.arange(a, b) for a, b in kept])
    columns: dict[str, np.ndarray] = {}
    for name, shape in shapes.items():
        m = n if _width(shape, n) else n - 1  # Inputs between states are one fewer.
        if not _width(shape, m):
            lost.append(f"{name} {shape}")
            continue
        value = np.squeeze(np.asarray(load(name)))
        if value.dtype.kind == "M":
            value = value.astype("datetime64[ns]").astype(np.int64) * 1e-9
        value = value if shape[0] == m else value.T
        value = value[np.minimum(row, m - 1)].astype(float)
        value[row >= m] = np.nan
        if value.ndim == 1:
            columns[name] = value
            continue
        own = labels.get(value.shape[1])
        if own is None or _OF_A_BODY & {*words_of(name)}:
            columns |= spread(name, value)
        else:
            columns |= {f"{name}/{label}": value[:, i] for i, label in enumerate(own)}
    notes = []
    if lost:
        says = f"{path.name}: left out, as they are no columns of {n} numbers: "
        shown = ", ".join(lost[:8]) + (", ..." if lost[8:] else "")
        notes.append(("not_columns", says + shown))
    if not any(is_time(name) for name in columns):
        notes += _with_time(path, columns, row, numbers)
    return columns, row + 1, n, notes


def is_time(name: str) -> bool:
    """Whether the last part of a name has a word for time in it."""
    return bool(TIME_WORDS & {*words_of(re.split(r"[/.]", name)[-1])})


def _text(value) -> str:
    text = value.decode(errors="replace") if isinstance(value, bytes) else str(value)
    return text.strip()


def _of_joints(name: str) -> bool:
    return bool({"joint", "joints", "dof", "dofs", "motor"} & {*words_of(name)})


def _width(shape: tuple[int, ...], n: int) -> int:
    """How many columns of n numbers an array has; 0 if it has none."""
    if n not in shape or len(shape) > 2:
        return 0
    return 1 if len(shape) == 1 else shape[1] if shape[0] == n else shape[0]


def _with_time(
    path: Path, columns: dict[str, np.ndarray], row, numbers: Mapping[str, float]
) -> list[tuple[str, str]]:
    """Puts `time` first, in place, where a number says how far apart rows are."""
    for name, value in numbers.items():
        last = re.split(r"[/.]", name)[-1].lower()
        unit = next((u for end, u in (("_ms", 1e-3), ("_us", 1e-6), ("_ns", 1e-9))
                     if last.endswith(end)), 1.0)  # fmt: skip
        last = re.sub(r"_(s|ms|us|ns|sec)$", "", last)
        if not value > 0.0:
            continue
        if _PERIOD.fullmatch(last):
            period = unit * value
        elif _RATE.fullmatch(last):
            period = 1.0 / value
        else:
            continue
        own = {"time": period * row, **columns}
        columns.clear()
        columns.update(own)
        says = f"{path.name} has no times: its rows are {period:.6g} s apart, as its "
        return [("time_of_period", f"{says}{name} ({value:g}) says")]
    return []
