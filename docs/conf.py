"""The site of the documents, made from the pages of this folder as they are:

    .venv/bin/sphinx-build -W docs site

It needs no network; open site/index.html. The tables of index.md say which pages there
are, and their order. The tutorials are run (`-D plot_gallery=0`: they are only shown).
"""

import dataclasses
import re
import sys
from pathlib import Path
from textwrap import dedent, indent

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from docutils import nodes  # noqa: E402

import makebreak  # noqa: E402
from makebreak.scripts.cli.settings_list import comments_of  # noqa: E402

project, author, release = "makebreak", "the makebreak authors", makebreak.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_gallery.gen_gallery"]
html_theme, html_title = "furo", "makebreak"
html_static_path, html_css_files = ["site.css"], ["site.css"]
html_show_copyright = html_copy_source = False
# The sources of the tutorials, and two lists of them that are not needed.
exclude_patterns = ["tutorials/*", "built/index.rst", "**sg_execution_times.rst"]
myst_heading_anchors = 4  # As GitHub has them, for links such as gap.md#limits.
autodoc_typehints = "none"  # Docstrings give shapes and units.
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "built",
    "filename_pattern": r"\.py$",
    "download_all_examples": False,
    "show_signature": False,
    "min_reported_time": 3600,
    "abort_on_example_error": True,
}
_AS_THEY_ARE = (nodes.literal, nodes.literal_block, nodes.title, nodes.abbreviation)
_FIELDS = "Inputs|Outputs|Args|Attributes|Returns|Raises|Source"


def on_reading(app, page, source):
    """Links to tutorials lead to their pages; the margin lists the pages of each table
    of index.md, by their titles or by words in place of the file's name."""
    text = re.sub(r"\]\(tutorials/(\w+)\.py\)", r"](built/\1.rst)", source[0])
    if page == "index":
        tables = re.split(r"^\| ([^|]*) \| page \|$", text, flags=re.M)[1:]
        for caption, table in zip(tables[::2], tables[1::2], strict=True):
            links = re.findall(r"\[([^]]+)\]\(([\w/]+)\.(?:md|rst)\)", table)
            pages = "\n".join(
                page
                if page.endswith(words.removesuffix(".md"))
                else f"{words} <{page}>"
                for words, page in links
            )
            text += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n{pages}\n```\n"
    source[0] = text


def on_docstring(app, what, name, thing, options, lines):
    """Our docstrings are plain text: indented formulas, and fields such as `Args:`."""
    is_config = isinstance(thing, type) and dataclasses.is_dataclass(thing)
    if is_config and lines and lines[0].startswith(f"{thing.__name__}("):
        lines.clear()  # By dataclasses, of the signature that is shown anyway.
    text = re.sub(rf"\n(?=({_FIELDS}):)", "\n\n", "\n".join(lines))
    found = [_marked_up(block) for block in re.split(r"\n\s*\n", text)]
    if is_config:
        comments = comments_of(thing)
        said = [f"* ``{k}``: {_escaped(v)}" for k, v in comments.items() if v]
        found.append("\n".join(said))
    lines[:] = "\n\n".join(found).splitlines()


def _marked_up(block: str) -> str:
    """A paragraph of plain text as reStructuredText."""
    if field := re.match(rf"({_FIELDS}):[ \n]*", block):
        name, body = field[1], block[field.end() :]
        items = [body]
        if "\n" in field[0]:  # An item a line; what is indented more goes on.
            items = re.split(r"\n(?! )", dedent(body))
        said = "\n".join(f"| {_escaped(' '.join(item.split()))}" for item in items)
        return f":{name}:\n" + indent(said, "    ")
    if block.startswith(" "):
        return "::\n\n" + indent(dedent(block), "    ")
    return _escaped(block)


def _escaped(text: str) -> str:
    """Words in backticks as code; nothing else means anything."""
    parts = re.split(r"`+([^`]+)`+", " ".join(text.split()))
    plain = [re.sub(r"([\\*|_`])", r"\\\1", part) for part in parts[::2]]
    code = [f" ``{part}`` " for part in parts[1::2]]
    return "".join(a + b for a, b in zip(plain, [*code, ""], strict=True)).strip()


def on_resolved(app, tree, page):
    """The first use of a term of terms.md says what it is where the pointer rests."""
    if page == "terms":
        return
    table = (ROOT / "docs" / "terms.md").read_text()
    rows = re.findall(r"^\| ([A-Z][\w-]*) \| ([^|]*) \|", table, re.M)
    for term, meaning in sorted(rows, key=lambda row: -len(row[0])):
        for text in list(tree.findall(nodes.Text)):
            if isinstance(text.parent, _AS_THEY_ARE):
                continue
            parts = re.split(rf"(?<![\w/-]){term}(?![\w-])", text.astext(), maxsplit=1)
            if len(parts) > 1:
                explained = nodes.abbreviation(term, term, explanation=meaning)
                new = [nodes.Text(parts[0]), explained, nodes.Text(parts[1])]
                text.parent.replace(text, new)
                break


def setup(app):
    app.connect("doctree-resolved", on_resolved)
    app.connect("source-read", on_reading)
    app.connect("autodoc-process-docstring", on_docstring)
