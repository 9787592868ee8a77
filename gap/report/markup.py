"""Pieces of HTML that the report is made of, and its style sheet."""

import base64
import re
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from makebreak.gap.report.summary import number

_MOST_ROWS = 200  # Of a table: a page with more is slow to open.
_LONG = 400  # Characters of a heading.


def sentence_html(sentence: str) -> str:
    """A sentence as HTML: it begins with a capital and has a sign for +-."""
    is_name = "." in sentence.split(" ", 1)[0].rstrip(".:")
    first = sentence[:1] if is_name else sentence[:1].upper()
    text = escape(first + sentence[1:]).replace("+-", "&plusmn;")
    for unit in ("N m", "kg m2", "rad/s", "N s/m"):  # A number keeps its unit.
        text = text.replace(f" {unit}", "&nbsp;" + unit.replace(" ", "&nbsp;"))
    return text


def headline(says: str) -> str:
    """What a result says, as a heading; of a long text the first sentence alone, then
    the others, where more than two parts of one are a list."""
    first, *others = re.split(r"(?<=\.) ", says) if len(says) > _LONG else [says]
    html = f"<h1>{sentence_html(first)}</h1>"
    for each in others:
        lead, colon, rest = each.partition(": ")
        parts = rest.rstrip(".").split("; ")
        if colon and len(parts) > 2:
            items = "".join(f"<li>{sentence_html(part)}</li>" for part in parts)
            html += f"<p>{sentence_html(lead)}:</p><ul>{items}</ul>"
        else:
            html += f"<p>{sentence_html(each)}</p>"
    return html


def cell(value) -> str:
    """What stands in a table for any value of result.json."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return number(float(value))
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {cell(v)}" for k, v in value.items())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(cell, value))
    return str(value)


def section(title: str, body: str) -> str:
    """A section of the page under its heading."""
    return f"<section><h2>{title}</h2>{body}</section>"


def bar(share: float) -> str:
    """A bar of this share of the full length."""
    return f'<span class="bar" style="width:{max(100.0 * share, 0.5):.1f}%"></span>'


def folded(title: str, body: str) -> str:
    """What is shown when its title is clicked."""
    return f"<details><summary>{title}</summary>{body}</details>"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], most: int) -> str:
    """The first `most` rows; others are folded away, and beyond 200 in result.json."""
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)

    def body(some):
        return "".join(
            "<tr>" + "".join(f"<td>{escape(str(c))}</td>" for c in row) + "</tr>"
            for row in some
        )

    text = f"<table><tr>{head}</tr>{body(rows[:most])}</table>"
    rest = rows[most:_MOST_ROWS]
    if rest:
        more = f"<table><tr>{head}</tr>{body(rest)}</table>"
        text += folded(f"{len(rows) - most} more", more)
    return text


def image(pictures: Mapping[str, bytes], name: str, says: str) -> str:
    """A PNG picture inside the page, if there is one of that name."""
    if name not in pictures:
        return ""
    data = base64.b64encode(pictures[name]).decode()
    return f'<img alt="{escape(says)}" src="data:image/png;base64,{data}">'


STYLE = """
body{font:15px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;
 color:#1a202c;background:#fff;margin:0}
main{max-width:1180px;margin:0 auto;padding:18px 24px 60px}
.badge{display:inline-block;color:#fff;font-weight:600;border-radius:4px;
 padding:3px 12px;margin:0}
h1{font-size:23px;line-height:1.3;margin:10px 0 14px;font-weight:600}
h2{font-size:18px;margin:34px 0 8px;border-top:1px solid #e2e8f0;padding-top:16px}
h3{font-size:16px;margin:0 0 4px}
.two{display:grid;grid-template-columns:minmax(0,1fr) minmax(0,1fr);gap:28px}
@media(max-width:800px){.two{grid-template-columns:1fr}}
.effect{border-left:3px solid #cbd5e0;padding:2px 0 2px 14px;margin-bottom:18px}
.effect p{margin:6px 0}
.kind{font-family:ui-monospace,"DejaVu Sans Mono",monospace;font-size:13px;
 color:#4a5568}
.tie{background:#fffbeb;border:1px solid #f6e05e;border-radius:4px;padding:8px 12px}
.tie ul{margin:4px 0;padding-left:20px}.tie p{margin:4px 0}
.doubt{background:#fff5f5;border:1px solid #fc8181;border-radius:4px;
 padding:8px 12px;margin:0 0 14px}.doubt ul{margin:4px 0;padding-left:20px}
.numbers{display:flex;gap:30px;margin:0 0 4px}
.numbers b{display:block;font-size:25px;line-height:1.2}
.numbers span,.small{color:#718096;font-size:13px}
img{max-width:100%;height:auto;display:block}
table{border-collapse:collapse;font-size:14px;margin:6px 0}
td,th{text-align:left;padding:3px 16px 3px 0;border-bottom:1px solid #edf2f7;
 vertical-align:top}
th{color:#718096;font-weight:500}
pre{background:#f7fafc;border:1px solid #e2e8f0;border-radius:4px;padding:8px 12px;
 margin:2px 0 10px;white-space:pre-wrap;overflow-wrap:anywhere;font-size:13px}
.bars{width:100%}.bars td:nth-child(2){width:50%}
.bar{display:inline-block;height:12px;background:#2b6cb0;border-radius:2px}
a[data-axis]{color:#2b6cb0;cursor:pointer}
iframe{width:100%;height:230px;border:1px solid #e2e8f0;border-radius:4px}
summary{cursor:pointer;color:#2b6cb0;font-size:14px;margin:4px 0}
li.error{color:#c53030}li.warning{color:#975a16}
"""
