"""Texts whose rows are no instants, or have no names, as tables that have both.

A long table has a row for each joint at each instant (as melted data frames and data
bases give it); `ros2 topic echo --csv` writes the fields of a JointState without names.
"""

import csv
from collections.abc import Sequence
from io import BytesIO, StringIO

from makebreak.gap.data.arrays import is_time

_FIELDS = ("name", "position", "velocity", "effort")  # Of a JointState, in this order.
_SOME = 1 << 14  # [bytes] that tell.
_MOST = 100  # Joints.


def reshaped(file) -> BytesIO | None:
    """The table of an open file that starts here; None of one that is as it should be,
    which then stands where it stood."""
    start = file.tell()
    sample = file.read(_SOME)
    file.seek(start)
    first, *rest = list(csv.reader(
        sample.decode(errors="replace").splitlines()[: _MOST * 3]
    )) or [[]]  # fmt: skip
    if names := _of_message(first):
        return BytesIO(",".join(names).encode() + b"\n" + file.read())
    rows = [row for row in rest[:-1] if len(row) == len(first)]
    if len(rows) < 2 or (of := _label(first, rows)) is None:
        return None
    return _wide(file.read(), of)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _of_message(cells: Sequence[str]) -> list[str]:
    """Names of a JointState's cells: its stamp, its frame, and lists that are as long
    as that of the joints' names."""
    if len(cells) < 5 or not (cells[0].isdigit() and cells[1].isdigit()):
        return []
    more = cells[3:]
    n = next((k for k, cell in enumerate(more) if _is_number(cell)), 0)
    if not n or len(more) % n or not 2 <= len(more) // n <= len(_FIELDS):
        return []
    if _is_number(cells[2]) or not all(map(_is_number, more[n:])):
        return []
    lists = _FIELDS[: len(more) // n]
    return ["sec", "nanosec", "frame_id", *(f"{w}{i}" for w in lists for i in range(n))]


def _label(names: Sequence[str], rows: Sequence[Sequence[str]]) -> int | None:
    """The column of what a row is of, where the first two rows are of one instant, or
    the same texts come again and again."""
    texts = [k for k, cell in enumerate(rows[0]) if cell and not _is_number(cell)]
    times = [k for k, name in enumerate(names) if is_time(name)]
    if len(texts) != 1 or not times:
        return None
    each = [row[texts[0]] for row in rows]
    n = each.index(each[0], 1) if each[0] in each[1:] else 0
    come_again = len(set(each[:n])) == n > 1 and each[n:] == each[:-n]
    one, two = (row[times[0]] for row in rows[:2])
    is_same = one == two and each[0] != each[1]
    return texts[0] if is_same or come_again and len(each) >= 3 * n else None


def _wide(text: bytes, of: int) -> BytesIO:
    names, *rows = csv.reader(StringIO(text.decode(errors="replace")))
    rows = [row for row in rows if len(row) == len(names)]
    time = next(k for k, name in enumerate(names) if is_time(name))
    labels = dict.fromkeys(row[of] for row in rows)
    instants: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        instants.setdefault(row[time], {})[row[of]] = row
    rest = [k for k in range(len(names)) if k not in (of, time)]
    out = [[names[time], *(f"{label}/{names[k]}" for label in labels for k in rest)]]
    none = [""] * len(names)
    for at, own in instants.items():
        cells = (own.get(label, none)[k] for label in labels for k in rest)
        out.append([at, *cells])
    text_out = StringIO()
    csv.writer(text_out, lineterminator="\n").writerows(out)
    return BytesIO(text_out.getvalue().encode())
