"""Tables in text as they come: other separators, blanks, comments, decimal commas,
quotes, lists in cells, packed with gzip; read in blocks, so that no long file is ever
held whole."""

import csv
import gzip
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from io import BytesIO
from pathlib import Path

import numpy as np

from makebreak.gap.data.reshaped import reshaped

_BLOCK = 1 << 23  # [bytes] of text that are parsed at a time.
NAMELESS = "column_"  # What columns without a name are called, with their number.
_HEAD = 60  # Lines among which names are looked for.
# A cell without a number, as programs write it.
_MISSING = re.compile(
    rb"(?i)(?<![^,\n])\s*(n/?a|null|none|missing|#n/?a|-+|\?|"
    rb"[+-]?(?:nan\(\w*\)|1\.#(?:qnan|snan|ind)\w*))\s*(?![^,\n])"
)
_SHOWN = 3  # Bad rows that are named one by one.
_QUOTED = re.compile(rb'"([^"\n]*)"')
# ISO 8601, as data frames and loggers write it.
_STAMP = re.compile(
    rb"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d+))? ?(Z|[+-]\d\d:?\d\d)?"
)


# A date whose order of day and month nobody can tell; the time of day is enough.
_DAY = re.compile(rb"\b\d{1,4}[/.]\d{1,2}[/.]\d{2,4},? +(?=\d?\d:\d\d:\d\d)")
# A time of day alone, or since a start.
_CLOCK = re.compile(
    rb"(?<![\w:.-])(?:(\d+) days?,? )?([0-2]?\d):([0-5]\d):([0-5]\d)"
    rb"(?:[.,](\d+))?(?![\w:])"
)


# A unit of SI behind a number, as MATLAB writes durations.
_IN_SI = re.compile(
    rb"(?m)((?:^|[,;\t])[\" ]*[+-]?\d[\d.]*(?:[eE][+-]?\d+)?)"
    rb" ?(?:sec|s|rad(?:/s)?|m(?:/s)?|N|N ?m)(?=[\" ]*(?:[,;\t\r\n]|$))"
)


@dataclass(frozen=True)
class Dialect:
    """How a csv file is written. names: of its columns; lists: {column: how many
    numbers its cells hold}, of cells as [1, 2, 3]; unused: columns that may hold
    anything; headless: the first line is a row, and the names are column_1, ...;
    stamped: some cells are dates with times, which become seconds since 1970, or
    numbers with their unit; holey:
    some cells say in a word that nothing is there."""

    separator: str
    decimal_comma: bool
    quoted: bool
    names: tuple[str, ...]
    lists: dict[str, int] = field(default_factory=dict)
    unused: frozenset[str] = frozenset()
    headless: bool = False
    stamped: bool = False
    holey: bool = False

    def columns(self) -> list[str]:
        """Names of the columns of numbers: a list's are name[0], name[1], ..."""
        out = []
        for name in self.names:
            if name in self.unused:
                continue
            n = self.lists.get(name)
            out += [name] if n is None else [f"{name}[{i}]" for i in range(n)]
        return out


class BadRows:
    """Rows that cannot be used: refused, or left out and counted.

    Args: skip: whether they are left out.
    """

    def __init__(self, path: Path, skip: bool):
        self._path, self.skip = path, skip
        self.count, self.why = 0, list[str]()
        self.headless = 0  # Columns of a file that does not name them.
        self.no_rows: dict[str, int] = {}  # {what a line is instead: first of them}

    def add(self, why: str) -> None:
        """Raises: ValueError with the reason, unless such rows are left out."""
        if not self.skip:
            raise ValueError(
                f"recording {self._path}: {why} (--skip-bad-rows leaves such rows out)"
            )
        self.count += 1
        if len(self.why) < _SHOWN:
            self.why.append(why)

    def note(self) -> list[tuple[str, str]]:
        found = []
        if self.headless:
            says = f"{self._path.name} has no header: its columns are called "
            says += f"{NAMELESS}1 to {NAMELESS}{self.headless}"
            found.append(("no_header", says))
        for what, row in self.no_rows.items():
            says = f"{self._path.name}: {what} (row {row}): it is left out"
            found.append(("rows_none", says))
        if not self.count:
            return found
        more = self.count - len(self.why)
        says = f"{self._path.name}: {self.count} bad rows are left out: "
        says += "; ".join(self.why) + (f"; and {more} more" if more else "")
        return [*found, ("rows_bad", says)]


def open_csv(path: Path):
    """A binary file to read from, with a row for each instant."""
    file = gzip.open(path, "rb") if path.suffix.lower() == ".gz" else path.open("rb")
    other = reshaped(file)
    if other is None:
        return file
    file.close()
    return other


def size_of(path: Path) -> int:
    """Bytes of text; of a gzip file what it says of itself, which may be less."""
    if path.suffix.lower() != ".gz":
        return path.stat().st_size
    with path.open("rb") as file:
        file.seek(-4, 2)
        return max(int.from_bytes(file.read(4), "little"), path.stat().st_size)


def header_of(file) -> bytes:
    """The line of names, else the first row, of an open file that then stands below
    it. Names are above the first row of numbers and have as many cells: comments (#,
    %) and what else a program writes above them are no names, a second line of texts
    is their units."""
    lines: list[tuple[bytes, int]] = []  # With where each ends.
    while len(lines) < _HEAD and (line := file.readline()):
        lines.append((line, file.tell()))
    shown = [x for x in lines if x[0].strip()]
    if not shown:
        return lines[-1][0] if lines else b""
    last = _decoded(shown[-2 if len(shown) > 3 else -1][0])
    separator = next((x for x in ";\t," if x in last), " ")
    tables = [_split(line.lstrip(b"#% "), separator) for line, _ in shown]
    comment = [line[:1] in (b"#", b"%") for line, _ in shown]
    n = len(tables[-2 if len(shown) > 3 else -1])
    row = next(
        (k for k, cells in enumerate(tables)
         if not comment[k] and len(cells) == n and _has_numbers(cells)),
        None,
    )  # fmt: skip
    plain = [k for k in range(len(shown)) if not comment[k]]
    if row is None:  # Texts only, or nothing: said where rows are read.
        k = plain[0] if plain else len(shown) - 1
        file.seek(shown[k][1])
        return shown[k][0]
    names = [k for k in range(row) if len(tables[k]) == n]
    own = [k for k in names if not comment[k]] or names[-1:]
    above = [k for k in plain if k < row]
    if not own and not above:
        file.seek(shown[row][1])
        return shown[row][0]
    if not own:  # Of another number of cells: rows say so.
        file.seek(shown[above[-1]][1])
        return shown[above[-1]][0]
    file.seek(shown[row - 1][1])
    header = shown[own[0]][0].lstrip(b"#% " if comment[own[0]] else b"")
    if len(own) == 1:
        return header
    file.seek(shown[own[-1]][1])
    with_units = [
        name if not unit.strip("- ") or unit in name or name.count(".") > 1
        else f"{name} [{unit.strip('[]() ')}]"
        for name, unit in zip(tables[own[0]], tables[own[1]], strict=True)
    ]  # fmt: skip
    return (separator.join(with_units) + "\n").encode()


def _split(line: bytes, separator: str) -> list[str]:
    text = _decoded(_in_seconds(line)).strip()
    if separator == " ":
        return text.split()
    return [x.strip() for x in next(csv.reader([text], delimiter=separator), [])]


def _has_numbers(cells: Sequence[str]) -> bool:
    for cell in cells:
        try:
            float(cell.replace(",", "."))
        except ValueError:
            if _list(cell) is None:
                continue
        return True
    return False


def _decoded(text: bytes) -> str:
    """Text in UTF-8, or as Windows has it in western Europe."""
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError:
        return text.decode("cp1252", errors="replace")


def dialect_of(
    path: Path, header: bytes, sample: bytes, unused: frozenset[str] = frozenset()
) -> Dialect:
    """From the header's line and some lines below it.

    Args: unused: columns that nobody needs, whatever they hold.
    Raises: ValueError for what is no text, or has a column twice.
    """
    if b"\0" in header + sample:
        raise ValueError(f"recording {path} is no text: expected a csv table")
    text = _decoded(_in_seconds(header)).strip()
    plain = re.sub(r'"[^"]*"', "", text)
    separator = max(",;\t", key=plain.count)
    if not plain.count(separator):
        separator = ","
    for other in ";\t":  # "0,1;0,2" has as many decimal commas as separators.
        if other in plain and _are_values(plain.split(other), other):
            separator = other
    if not re.search('[,;\t"]', text) and len(text.split()) > 1:
        first = sample.lstrip().splitlines()[:1]  # "time [s]" may be one name.
        if not first or len(first[0].split()) == len(text.split()):
            separator = " "
    text = " ".join(text.split()) if separator == " " else text
    names = [n.strip() for n in next(csv.reader([text], delimiter=separator), [])]
    headless = _are_values(names, separator)
    if headless:
        names = [f"{NAMELESS}{i + 1}" for i in range(len(names))]
    for k, name in enumerate(names):
        if name in names[:k]:
            if name.count(".") > 1 or not name:  # As a channel's.
                raise ValueError(f'recording {path}: column "{name}" is there twice')
            names[k] = name + " (again)" * names[:k].count(name)
    seconds = _in_seconds(sample)
    stamped = seconds != sample or _in_seconds(header) != header
    lines = seconds.decode(errors="replace").splitlines()[:50]
    lists: dict[str, int] = {}
    if re.search(r"[\[(]", "".join(lines)):
        for cells in csv.reader(lines[:-1] or lines, delimiter=separator):
            if len(cells) != len(names):
                continue
            for name, cell in zip(names, cells, strict=True):
                values = _list(cell)
                if values is not None:
                    lists.setdefault(name, len(values))
    body = "".join(lines)
    comma = separator != "," and re.search(r"\d,\d", body) is not None
    # Numbers in quotes with a comma in them, between commas.
    comma |= separator == "," and re.search(r'"-?\d+,\d+"', body) is not None
    unused = unused & set(names)
    return Dialect(
        separator, comma, '"' in body, tuple(names), lists, unused, headless, stamped,
        _MISSING.search(sample.replace(separator.encode(), b",")) is not None,
    )  # fmt: skip


def _in_seconds(text: bytes) -> bytes:
    """With dates and times as seconds since 1970; without a zone they are UTC."""

    def seconds(found: re.Match[bytes]) -> bytes:
        date, clock, fraction, zone = found.groups()
        # Python 3.10 reads neither a Z nor a zone without a colon.
        zone = (zone or b"Z").replace(b"Z", b"+00:00")
        zone = re.sub(rb"(\d\d)(\d\d)$", rb"\1:\2", zone)
        try:
            at = datetime.fromisoformat((date + b"T" + clock + zone).decode())
        except ValueError:
            return found.group()
        return b"%d.%s" % (int(at.timestamp()), fraction or b"0")

    def of_day(found: re.Match[bytes]) -> bytes:
        days, hours, minutes, rest, fraction = found.groups()
        whole = 86400 * int(days or 0) + 3600 * int(hours) + 60 * int(minutes)
        whole += int(rest)
        return b"%d.%s" % (whole, fraction or b"0")

    # Most texts have neither, and are long.
    if b":" in text:
        text = _CLOCK.sub(of_day, _DAY.sub(b"", _STAMP.sub(seconds, text)))
    if any(letter in text for letter in (b"s", b"d", b"m", b"N")):
        text = _IN_SI.sub(rb"\1", text)
    return text


def is_nameless(column: str) -> bool:
    """Whether it is called so for want of a name."""
    return column.startswith(NAMELESS) and column.removeprefix(NAMELESS).isdigit()


def _are_values(cells: Sequence[str], separator: str) -> bool:
    """Whether a first line holds a row's numbers rather than names. Whole numbers that
    count up by one are names, as pandas writes several for want of others."""
    texts = [c.replace(",", ".") if separator != "," else c for c in cells if c]
    try:
        values = np.array([float(text) for text in texts])
    except ValueError:
        return False
    counted = all(text.isdigit() for text in texts) and np.all(np.diff(values) == 1.0)
    return np.isfinite(values).any() and not (counted and len(values) > 1)


def _list(cell: str) -> list[float] | None:
    cell = cell.strip()
    if (cell[:1], cell[-1:]) not in (("[", "]"), ("(", ")")):
        return None
    cell = f"[{cell[1:-1]}]"
    try:
        return [float("nan") if v is None else float(v) for v in json.loads(cell)]
    except (ValueError, TypeError):
        parts = cell.strip("[]").replace(",", " ").split()  # As numpy prints it.
        try:
            return [float(p) for p in parts]
        except ValueError:
            return None


def blocks_of(file, quoted: bool):
    """Whole lines, 8 MB or so at a time, without empty ones; only the file's last one
    may lack its end."""
    rest = b""
    while True:
        block = file.read(_BLOCK)
        text = rest + block
        if block:
            cut = text.rfind(b"\n") + 1
            text, rest = text[:cut], text[cut:]
        text = text.replace(b"\r\n", b"\n")
        while b"\n\n" in text or text[:1] == b"\n":
            text = text.replace(b"\n\n", b"\n").removeprefix(b"\n")
        if text:
            yield text
        if not block:
            return


def parse(
    dialect: Dialect, text: bytes, done: int, bad: BadRows
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (rows, columns) of whole lines, and the number of each row from 1; `done`
    rows came before them."""
    names, is_cut = dialect.columns(), not text.endswith(b"\n")
    text += b"\n" if is_cut else b""
    if dialect.stamped:
        text = _in_seconds(text)
    if dialect.lists:
        lines = text.decode(errors="replace")
        return _by_line(dialect, names, lines, done, bad, True, is_cut)
    plain = text
    if dialect.separator == " ":
        plain = b"".join(b" ".join(x.split()) + b"\n" for x in text.splitlines())
    if dialect.quoted:
        plain = _QUOTED.sub(lambda m: _unquoted(m.group(1), dialect), plain)
    if dialect.separator != ",":
        if dialect.decimal_comma:
            plain = plain.replace(b",", b".")
        plain = plain.replace(dialect.separator.encode(), b",")
    filled = plain.replace(b",,", b",nan,").replace(b",,", b",nan,")
    filled = filled.replace(b",\n", b",nan\n").replace(b"\n,", b"\nnan,")
    if filled.startswith(b","):
        filled = b"nan" + filled
    filled = _MISSING.sub(b"nan", filled) if dialect.holey else filled
    try:
        use = [i for i, name in enumerate(dialect.names) if name not in dialect.unused]
        if len(use) < len(dialect.names):  # It looks at no other cell of a row.
            n = filled.count(b",", 0, filled.find(b"\n"))
            if n + 1 != len(dialect.names):
                raise ValueError
        values = np.loadtxt(
            BytesIO(filled), delimiter=",", ndmin=2, comments=None,
            usecols=use if len(use) < len(dialect.names) else None,
        )  # fmt: skip
        if values.shape[1] == len(names) and not np.isinf(values).any():
            return values, done + 1 + np.arange(len(values))
    except (ValueError, UnicodeDecodeError):
        pass
    # Something is wrong with this block: found at leisure.
    lines = filled.decode(errors="replace")
    return _by_line(dialect, names, lines, done, bad, False, is_cut)


def _unquoted(cell: bytes, dialect: Dialect) -> bytes:
    if dialect.decimal_comma:
        return cell.replace(b",", b".")
    return cell.replace(dialect.separator.encode(), b" ")  # A text, as of a list.


def _by_line(
    dialect: Dialect, names: Sequence[str], text: str, done: int, bad: BadRows,
    as_written: bool, is_cut: bool,
):  # fmt: skip
    """Args: as_written: with the file's own separators and quotes; else made plain.
    is_cut: whether the last line has no end."""
    split: Callable[[str], list[str]]
    n = len(dialect.names)
    if as_written:

        def split(line: str) -> list[str]:
            return next(csv.reader([line], delimiter=dialect.separator), [])
    else:

        def split(line: str) -> list[str]:
            return line.split(",")

    rows, numbers = list[list[float]](), list[int]()
    lines = text.splitlines()
    for i, line in enumerate(lines):
        cells, row = split(line), done + i + 1
        if [cell.strip() for cell in cells] == [*dialect.names]:
            bad.no_rows.setdefault("the header comes again", row)
            continue
        if is_cut and i == len(lines) - 1 and len(cells) < n:
            bad.no_rows["the last row is cut"] = row
            continue
        if len(cells) != n:
            bad.add(f"row {row} has {len(cells)} cells, expected {n} as the header")
            continue
        values: list[float] = []
        for name, cell in zip(dialect.names, cells, strict=True):
            if name in dialect.unused:
                continue
            found, why = _numbers(dialect, name, cell)
            if why:
                bad.add(f"column {name}, row {row}: {why}")
                values = []
                break
            values += found
        if values:
            rows.append(values)
            numbers.append(row)
    return np.array(rows, float).reshape(-1, len(names)), np.array(numbers, int)


def _numbers(dialect: Dialect, name: str, cell: str) -> tuple[list[float], str]:
    """Of one cell; else what is wrong with it."""
    cell, n = cell.strip(), dialect.lists.get(name)
    if n is not None:
        if not cell:
            return [np.nan] * n, ""
        found = _list(cell)
        if found is None or len(found) != n or np.isinf(found).any():
            return [], f'got "{cell[:40]}", expected a list of {n} finite numbers'
        return found, ""
    if dialect.decimal_comma:
        cell = cell.replace(",", ".")
    if _MISSING.fullmatch(cell.encode()):
        return [np.nan], ""
    try:
        value = float(cell) if cell else np.nan
        if abs(value) != np.inf:
            return [value], ""
    except ValueError:
        pass
    why = (
        f'got "{cell[:40]}", expected a finite number, or an empty cell where there is'
    )
    return [], why + " none"


def text_columns(path: Path) -> dict[str, str]:
    """{column whose first cells are neither numbers nor lists of them: the text that is
    in all of these, "" where they differ}."""
    with open_csv(path) as file:
        header = header_of(file)
        sample = file.read(1 << 16)
    dialect = dialect_of(path, header, sample)
    lines = _in_seconds(sample).decode(errors="replace").splitlines()[:20]
    found: dict[str, list[str]] = {}
    if dialect.separator == " ":
        lines = [" ".join(line.split()) for line in lines]
    for cells in csv.reader(lines, delimiter=dialect.separator):
        if len(cells) == len(dialect.names):
            for name, cell in zip(dialect.names, cells, strict=True):
                if _numbers(dialect, name, cell)[1]:
                    found.setdefault(name, []).append(cell.strip())
    return {
        name: cells[0] if len(set(cells)) == 1 else ""
        for name, cells in found.items()
        if 2 * len(cells) > len(lines)
    }
