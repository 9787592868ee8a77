"""report.html of a run, a sweep or a reproduction: tables and plots in one page, that
opens without a network."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from makebreak.gap.report.interactive import recording_html
from makebreak.gap.report.markup import STYLE, folded, image
from makebreak.scripts.runner.table import Table

_GOOD, _BAD, _NEUTRAL = "#2f855a", "#c53030", "#2b6cb0"
_MOST_ROWS = 24  # Of a table; others are shown when they are asked for.


def result_page(
    title: str,
    tables: Sequence[Table],
    success: bool | None = None,
    says: Sequence[str] = (),
    pictures: Mapping[str, bytes] | None = None,
    is_moving: bool = False,
    command: str = "",
    recorded: Mapping[str, np.ndarray] | None = None,
) -> str:
    """The page.

    Args: success: None where there is nothing to succeed in; says: lines on the first
        screen; pictures: PNG files by name; is_moving: whether meshcat.html is beside
        the page; command: to go on with; recorded: columns of a recording.
    """
    colour = {True: _GOOD, False: _BAD, None: _NEUTRAL}[success]
    badge = {True: "Goals met", False: "Goals missed", None: "Results"}[success]
    lines = "".join(map(_said, says))
    moving = ""
    if is_moving:
        moving = '<iframe src="meshcat.html#small" title="The run"></iframe>'
        moving += '<p class="small"><a href="meshcat.html">The animation</a></p>'
    pictures = pictures or {}
    body = [
        f'<p class="badge" style="background:{colour}">{badge}</p>',
        f"<h1>{escape(title)}</h1>",
        f'<div class="two"><ul>{lines}</ul><div>{moving}</div></div>'
        if lines or moving
        else "",
        *(f"<section>{image(pictures, name, name)}</section>" for name in pictures),
    ]
    if recorded:
        body.append(
            "<section><h2>Recording</h2><p class=small>Drag to zoom; click twice to "
            f"see all again; the pointer tells values.</p>{recording_html(recorded)}"
            "</section>"
        )
    body += map(_table, tables)
    if command:
        body.append(f"<p class=small>To go on:</p><pre>{escape(command)}</pre>")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)} - makebreak</title><style>{STYLE}</style></head>\n"
        f"<body><main>{''.join(body)}</main></body></html>\n"
    )


def _said(line: str) -> str:
    """A line of the first screen: a criterion, after its verdict, or any other text."""
    verdict, _, criterion = line.partition(" ")
    if verdict not in ("met", "MISSED"):
        return f"<li>{escape(line)}</li>"
    missed = ' class="error"' if verdict == "MISSED" else ""
    return f"<li{missed}><b>{verdict}</b>: {escape(criterion.strip())}</li>"


def _cell(text: str) -> str:
    missed = ' class="error"' if text == "MISSED" else ""
    return f"<td{missed}>{escape(text)}</td>"


def _table(table: Table) -> str:
    # A run's has a row a value; a sweep's few cases have a column for each value.
    table = table.transposed() if table.is_wide and len(table.columns) > 6 else table
    heads, rows = table.cells()
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)

    def some(rows):
        lines = ("".join(map(_cell, row)) for row in rows)
        return f"<table><tr>{head}</tr><tr>{'</tr><tr>'.join(lines)}</tr></table>"

    shown = some(rows[:_MOST_ROWS])
    if rows[_MOST_ROWS:]:
        shown += folded(f"{len(rows) - _MOST_ROWS} more", some(rows[_MOST_ROWS:]))
    notes = "".join(f'<p class="small">{escape(note)}</p>' for note in table.notes)
    return f"<section><h2>{escape(table.title)}</h2>{shown}{notes}</section>"
