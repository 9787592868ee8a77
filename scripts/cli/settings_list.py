"""`makebreak list EXPERIMENT`: the settings of an experiment, with their defaults."""

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize

from makebreak.models.typed_yaml import hints_of
from makebreak.scripts.runner.settings import to_plain

MEANING_FROM = 36  # Column at which the meanings begin.


def comments_of(schema: type) -> dict[str, str]:
    """{field: its comment} of a dataclass: the one on its line, or those above it."""
    text = textwrap.dedent(inspect.getsource(schema))
    comments, alone = {}, set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comments[token.start[0]] = token.string.lstrip("# ").strip()
            if not token.line[: token.start[1]].strip():
                alone.add(token.start[0])
    found = {}
    (definition,) = ast.parse(text).body
    for node in getattr(definition, "body", []):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        first = last = node.lineno
        if last in comments:
            last += 1
        else:
            while first - 1 in alone:
                first -= 1
        found[node.target.id] = " ".join(comments[k] for k in range(first, last))
    return found


def settings_rows(config, prefix: str = "") -> list[tuple[str, str, str]]:
    """(dotted key, default as `--set` takes it, comment) of every setting."""
    rows: list[tuple[str, str, str]] = []
    hints, comments = hints_of(type(config)), comments_of(type(config))
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            rows += settings_rows(value, f"{name}.")
            continue
        if dataclasses.is_dataclass(hints[field.name]):
            continue
        rows.append((name, _text(value), comments[field.name]))
    return rows


def _text(value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str) and value.endswith(".yaml"):
        return value.rsplit("/", 1)[-1]
    plain = to_plain(value)
    if plain is None:
        return "null"
    return f"[{','.join(map(str, plain))}]" if isinstance(plain, list) else str(plain)


def matching_rows(experiment: str, config, text: str) -> list[tuple[str, str, str]]:
    """(dotted key, default, comment) of the settings whose key or comment has `text` in
    it. Raises: ValueError if there is none."""
    rows, low = settings_rows(config), text.lower()
    rows = [r for r in rows if low in r[0].lower() or low in r[2].lower()]
    if not rows:
        raise ValueError(f'list {experiment}: no setting has "{text}" in its name')
    return rows


def settings_text(
    experiment: str, config, text: str = "", width: int | None = None
) -> str:
    """matching_rows as key=default and meaning.

    Args: width: of the terminal [characters], to which meanings are wrapped; None: one
        line for each setting, as for grep.
    Raises: ValueError if there is none.
    """
    rows = matching_rows(experiment, config, text)
    lines = [f"{experiment}: settings for --set, with their defaults", ""]
    for key, default, meaning in rows:
        head = f"{key}={default}".ljust(MEANING_FROM - 2)
        if width is None:
            lines.append(f"{head}  {meaning}".rstrip())
            continue
        wrapped = textwrap.wrap(meaning, max(30, width - MEANING_FROM)) or [""]
        if len(head) > MEANING_FROM - 2:
            lines.append(head)
        else:
            lines.append(f"{head}  {wrapped.pop(0)}".rstrip())
        lines += [" " * MEANING_FROM + each for each in wrapped]
    return "\n".join(lines)
