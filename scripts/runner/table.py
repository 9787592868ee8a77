"""A table of results: plain text for the terminal, Markdown and JSON for files."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from textwrap import fill, wrap

import numpy as np

# A figure that was not measured, within a text such as "nan mm (nan to nan)"; not the
# word in a quotation or in a name such as position_nan.
_NAN = re.compile(r"(?<![\w.\"'])nan(?![\w\"'])")

_NARROW = 8  # Characters of a heading that is not broken.
# Breaks no name, so that it can be copied.
_fill = partial(fill, break_long_words=False, break_on_hyphens=False)


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers under a title.

    Args:
        title: what the table shows; one line.
        columns: the headings; a table of `reproduce` has
            ("what", "paper", "ours", "command").
        rows: one sequence per row, as long as `columns`.
        met: for each row, whether it meets its target; None where it has none. Empty:
            no row has a target.
        notes: lines under the table.
    Raises: ValueError if a row or `met` is of the wrong length.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence]
    met: Sequence[bool | None] = field(default=())
    notes: Sequence[str] = field(default=())

    def __post_init__(self):
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(
                    f"Table row {i} has {len(row)} cells, expected "
                    f"{len(self.columns)} ({', '.join(self.columns)})"
                )
        if len(self.met) not in (0, len(self.rows)):
            raise ValueError(
                f"Table.met has {len(self.met)} entries, expected one per row "
                f"({len(self.rows)})"
            )

    @property
    def missed(self) -> int:
        """Number of rows that miss their target."""
        return sum(1 for met in self.met if met is not None and not met)

    @property
    def is_wide(self) -> bool:
        """Whether it is better read turned round: few rows of many columns."""
        return len(self.columns) > len(self.rows) + 1

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Headings and rows as text; with a last column for the targets, if any."""
        heads = [str(c) for c in self.columns]
        rows = [[format_cell(value) for value in row] for row in self.rows]
        if any(met is not None for met in self.met):
            heads.append("target")
            for row, met in zip(rows, self.met, strict=True):
                row.append("" if met is None else "met" if met else "MISSED")
        return heads, rows

    def to_text(self, width: int | None = None) -> str:
        """The table in aligned columns, numbers to the right, under its title.

        Args: width: of the terminal [characters], to which columns of text are wrapped
            between words; where that does not do, each row is a paragraph. None: a line
            for each row, as for grep.
        """
        heads, rows = self.cells()
        widths = [max(map(len, col)) for col in zip(heads, *rows, strict=True)]
        right = [
            bool(self.rows) and all(_is_number(row[j]) for row in self.rows)
            for j in range(len(self.columns))
        ] + [False] * (len(heads) - len(self.columns))
        over = 0 if width is None else sum(widths) + 2 * len(widths) - 2 - width
        columns = list(zip(heads, *rows, strict=True))
        longest = [
            [max(map(len, c.split()), default=1) for c in col] for col in columns
        ]
        for least in (  # Headings are broken where it has to be.
            [max(of) for of in longest],
            [max([_NARROW, *of[1:]]) for of in longest],
        ):
            while over > 0 and (
                can := [j for j, w in enumerate(widths) if w > least[j]]
            ):
                widths[max(can, key=widths.__getitem__)] -= 1
                over -= 1

        def line(cells):
            parts = [
                wrap(c, w, break_on_hyphens=False) or [""]
                for c, w in zip(cells, widths, strict=True)
            ]
            lines = []
            for row in zip_longest(*parts, fillvalue=""):
                pad = [
                    c.rjust(w) if r else c.ljust(w)
                    for c, w, r in zip(row, widths, right, strict=True)
                ]
                lines.append("  ".join(pad).rstrip())
            return "\n".join(lines)

        rule = "  ".join("-" * w for w in widths)
        around = [
            each if width is None else _fill(each, width)
            for each in (self.title, *self.notes)
        ]
        body = [line(heads), rule, *map(line, rows)] if rows else []
        if over > 0 and width is not None:
            body = [_paragraph(heads, row, width) for row in rows]
        lines = [around[0], "", *body, *around[1:]]
        return "\n".join(lines) + "\n"

    def transposed(self) -> "Table":
        """Columns as rows, for a table that is wide."""
        heads, rows = self.cells()
        names = [heads[0], *(row[0] for row in rows)]
        turned = list(zip(heads[1:], *(row[1:] for row in rows), strict=True))
        return Table(self.title, names, turned, notes=self.notes)

    def to_markdown(self) -> str:
        """The table as a Markdown section."""
        heads, rows = self.cells()

        def line(cells):
            return "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |"

        lines = [f"## {self.title}", "", line(heads), "|" + "---|" * len(heads)]
        lines += map(line, rows)
        if self.notes:
            lines += ["", *self.notes]
        return "\n".join(lines) + "\n"

    def to_dict(self) -> dict:
        """For JSON: title, columns, one {column: value} per row with `met`, notes."""

        def plain(value):
            return format_cell(value) if isinstance(value, str) else json_value(value)

        met = self.met or [None] * len(self.rows)
        rows = [
            dict(zip(self.columns, map(plain, row), strict=True))
            | ({} if m is None else {"met": bool(m)})
            for row, m in zip(self.rows, met, strict=True)
        ]
        return {
            "title": self.title,
            "columns": list(self.columns),
            "rows": rows,
            "notes": list(self.notes),
        }


def _paragraph(heads: Sequence[str], row: Sequence[str], width: int) -> str:
    """The first cell of a row, and below it the others with their headings."""
    cells = zip(heads[1:], row[1:], strict=True)
    text = "; ".join(f"{head}: {cell}" for head, cell in cells if cell)
    indent = " " * 4
    below = _fill(text, width, initial_indent=indent, subsequent_indent=indent)
    return f"{row[0]}\n{below}"


def _is_number(value) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def format_cell(value) -> str:
    """A value as text: four significant digits, yes or no, - for None and NaN (not
    measured), within a text too."""
    if isinstance(value, list | tuple | np.ndarray):
        return ", ".join(map(format_cell, value))
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{float(value):.4g}"
    text = " ".join(str(value).split())
    without = _NAN.sub("-", text)
    alone = without != text and not any(map(str.isdigit, text))  # "nan mm (nan to nan)"
    return "-" if alone else without


def json_value(value):
    """A scalar, or nested lists and mappings of them, for JSON: numpy types become
    Python's, NaN and infinity become None."""
    if isinstance(value, dict):
        return {key: json_value(one) for key, one in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [json_value(one) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
