"""Reads YAML text into dataclasses and checks names, types and bounds of numbers.

Drake's yaml_load_typed is not used, because its messages do not name the field's path,
and it has no nearest names, tuples or bounds. Without pydrake, so that it loads fast.
"""

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml

DEPTH_MAX = 40  # Of nested brackets or indents; a scene needs about six.
BYTES_MAX = 4_000_000
ALIASES_MAX = 1000  # Nine lines with ten aliases each would expand to a billion.
LISTED_MAX = 16  # Names that a message lists where none is like what came.
_EXPECTED = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}


@dataclasses.dataclass(frozen=True)
class Between:
    """Bounds of a field: `period_sec: Annotated[float, Between(1e-4, 10.0, "s")]`.

    None: no bound on that side; infinity is then valid.
    """

    low: float | None
    high: float | None
    unit: str = ""

    def holds(self, value: float) -> bool:
        return (self.low is None or value >= self.low) and (
            self.high is None or value <= self.high
        )

    def __str__(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        if self.low is None or self.high is None:
            side = f"<= {self.high:g}" if self.low is None else f">= {self.low:g}"
            return f"a number {side}{unit}"
        return f"a number from {self.low:g} to {self.high:g}{unit}"


_Fastest: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Fastest):
    """A safe loader that refuses duplicate keys; tags such as !Rpy go into `_tag`."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else None
            if name is not None and name in seen and name != "<<":
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {name!r} is there twice", key.start_mark
                )
            seen.add(name)
        return super().construct_mapping(node, deep)

    def with_tag(self, suffix, node):
        if not isinstance(node, yaml.MappingNode):
            raise yaml.constructor.ConstructorError(
                None, None, f"the tag !{suffix} is unknown here", node.start_mark
            )
        return {"_tag": f"!{suffix}", **self.construct_mapping(node, deep=True)}


_Loader.add_multi_constructor("!", _Loader.with_tag)


def load_yaml(text: str) -> Any:
    """YAML or JSON text as dicts, lists and scalars.

    Raises: ValueError in one line for invalid YAML, duplicate keys, too deep nesting.
    """
    try:
        depth = aliases = 0
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            aliases += isinstance(event, yaml.AliasEvent)
            if depth > DEPTH_MAX or aliases > ALIASES_MAX:
                what = f"{DEPTH_MAX} levels of brackets or indents"
                if depth <= DEPTH_MAX:
                    what = f"{ALIASES_MAX} aliases"
                line = event.start_mark.line + 1
                raise ValueError(f"line {line}: expected at most {what}")
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"not YAML: {one_line(error)}") from None
    except ValueError as error:
        if "integer string conversion" in str(error):
            raise ValueError("a number has more than 4000 digits") from None
        raise
    except (TypeError, OverflowError) as error:  # A list as a key, a date of year 0.
        raise ValueError(f"not usable as YAML: {one_line(error)}") from None


def read_yaml(path: Path) -> Any:
    """load_yaml of a file. Raises: ValueError, without the file's name."""
    try:
        size = path.stat().st_size
        if size > BYTES_MAX:
            raise ValueError(f"{size} bytes, expected at most {BYTES_MAX}")
        return load_yaml(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"not YAML: {one_line(error)}") from None
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None


def one_line(error: BaseException) -> str:
    """The message of an error on one line."""
    return " ".join(str(error).split())


def nearest(name: str, valid: Iterable[str]) -> str:
    """Hint of an error message: the valid names nearest to `name`; where none is like
    it, all of them, if they are few."""
    valid = list(valid)

    def likeness(other: str) -> tuple[float, float]:
        """Similarity of the last parts, which users often give alone, then of the whole
        names."""
        pairs = [(name.rpartition(".")[2], other.rpartition(".")[2]), (name, other)]
        last, whole = (difflib.SequenceMatcher(None, *p).ratio() for p in pairs)
        return last, whole

    if not valid:
        return "there is none"
    # What was a prefix or an ending is a group now: roll_sec is roll.sec.
    same = [v for v in valid if _words(v) == _words(name)]
    if len(same) == 1:
        return f"did you mean {same[0]}?"
    ranked = sorted(valid, key=likeness, reverse=True)
    least = max([0.6, *(likeness(v)[0] - 0.1 for v in ranked[:1])])
    close = [v for v in ranked[:3] if likeness(v)[0] >= least]
    if close:
        return f"did you mean {' or '.join(close)}?"
    if len(valid) > LISTED_MAX:
        return f"nearest of {len(valid)}: {', '.join(ranked[:3])}"
    return f"expected one of: {', '.join(valid)}"


def _words(name: str) -> list[str]:
    return sorted(re.split("[._]", name))


def shown(value) -> str:
    """A value for a message: as YAML, on one line, shortened."""
    text = value
    if not isinstance(value, str):
        try:
            text = yaml.safe_dump(value, width=1000, default_flow_style=True)
        except (yaml.YAMLError, ValueError):  # Not of YAML; an int of 5000 digits.
            text = type(value).__name__
    text = " ".join(text.replace("\n...", "").split())
    return text if len(text) <= 120 else f"{text[:100]}... ({len(text)} characters)"


def _refuse(name: str, value, expected: str):
    raise ValueError(f'{name}: got "{shown(value)}", expected {expected}')


def convert(name: str, value, hint, raw: str | None = None):
    """Converts a value from YAML to the declared type `hint`.

    Args:
        name: of the field, for messages.
        value: as YAML reads it.
        hint: the field's declared type, annotated with its Between if it has one.
        raw: the original text, which a str field takes unchanged.
    Raises: ValueError that names the field, the value and what was expected.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        converted = convert(name, value, args[0], raw)
        for limit in args[1:]:
            if isinstance(limit, Between) and not limit.holds(converted):
                _refuse(name, value, str(limit))
        return converted
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        options = [a for a in args if a is not type(None)]
        for option in options[:-1]:
            try:
                return convert(name, value, option, raw)
            except ValueError:
                continue
        return convert(name, value, options[-1], raw)
    if origin is typing.Literal:
        if not isinstance(value, bool | list | dict) and value in args:
            return value
        _refuse(name, value, "one of: " + ", ".join(map(str, args)))
    if hint in (str, Path):
        text = raw if raw is not None else value
        if not isinstance(text, str):
            _refuse(name, value, _EXPECTED[str])
        if "\0" in text:
            _refuse(name, value, "a text without NUL")
        return hint(text)
    if hint is bool:
        if not isinstance(value, bool):
            _refuse(name, value, _EXPECTED[bool])
        return value
    if hint in (int, float):
        return _number(name, value, hint)
    if hint is np.ndarray:
        try:
            return np.asarray(value, dtype=float)
        except (TypeError, ValueError, OverflowError):
            _refuse(name, value, "numbers")
    if origin in (list, tuple):
        if not isinstance(value, list | tuple):
            _refuse(name, value, "a list, as [1, 2, 3]")
        inner = args or (Any,)
        if origin is tuple and Ellipsis not in inner:
            if len(value) != len(inner):
                _refuse(name, value, f"a list of {len(inner)}")
        else:
            inner = (inner[0],) * len(value)
        return origin(
            convert(f"{name}[{i}]", v, h)
            for i, (v, h) in enumerate(zip(value, inner, strict=True))
        )
    if dataclasses.is_dataclass(hint):
        if isinstance(value, typing.cast(type, hint)):
            check(value, name + ".")
            return value
        if not isinstance(value, dict):
            keys = ", ".join(f.name for f in dataclasses.fields(hint))
            setting = f"{name}.FIELD=value, or " if raw else ""
            _refuse(name, value, f"{setting}a mapping, with any of: {keys}")
        return merge(typing.cast(type, hint), value, None, name + ".")
    if origin is dict:
        if not isinstance(value, dict):
            _refuse(name, value, "a mapping, as {a: 1}")
        return {
            convert(f"a key of {name}", k, args[0]): convert(f"{name}.{k}", v, args[1])
            for k, v in value.items()
        }
    return value


def _number(name: str, value, hint: type):
    number = value
    if isinstance(value, str):  # YAML 1.1 reads 1e-3, without a dot, as text.
        try:
            number = float(value)
        except ValueError:
            _refuse(name, value, _EXPECTED[hint])
    elif isinstance(value, np.generic):
        number = value.item()
    if not isinstance(number, int | float) or isinstance(number, bool):
        _refuse(name, value, _EXPECTED[hint])
    try:
        if math.isnan(number) or (hint is int and number != number // 1):
            _refuse(name, value, _EXPECTED[hint])
        return hint(number)
    except OverflowError:  # 400 digits are no float, infinity is no integer.
        _refuse(name, value, _EXPECTED[hint])


def hints_of(schema: type) -> dict[str, Any]:
    """{field: declared type}, with annotations."""
    return typing.get_type_hints(schema, include_extras=True)


def field_types(schema: type) -> dict[str, Any]:
    """{dotted name: type} of all fields of a dataclass and of those nested in it."""
    fields: dict[str, Any] = {}
    hints = hints_of(schema)
    for f in dataclasses.fields(schema):
        fields[f.name] = hints[f.name]
        if dataclasses.is_dataclass(hints[f.name]):
            nested = field_types(hints[f.name])
            fields |= {f"{f.name}.{name}": hint for name, hint in nested.items()}
    return fields


def merge(schema: type, mapping: dict, config=None, prefix: str = ""):
    """`config` with the fields in `mapping` replaced, nested ones merged; a new
    `schema` if `config` is None.

    Raises: ValueError for an unknown key, with the nearest names; as convert.
    """
    hints = hints_of(schema)
    fields = {prefix + f.name: f for f in dataclasses.fields(schema)}
    changes = {}
    for key, value in mapping.items():
        name = f"{prefix}{key}"
        if name not in fields:
            within = [f"{prefix}{each}" for each in field_types(schema)]
            moved = [  # Into a group: roll_sec is roll.sec.
                each
                for each in within
                if each.replace(".", "_") == name.replace(".", "_")
                or each.endswith(f".{key}")
            ]
            hint = nearest(name, moved or fields)
            raise ValueError(f"unknown key {shown(name)}; {hint}")
        old = getattr(config, key, None)
        if dataclasses.is_dataclass(old) and isinstance(value, dict):
            changes[key] = merge(type(old), value, old, name + ".")
        else:
            changes[key] = convert(name, value, hints[key])
    if config is not None:
        return dataclasses.replace(config, **changes)
    for name, f in fields.items():
        required = f.default is f.default_factory is dataclasses.MISSING
        if required and f.name not in changes:
            raise ValueError(f"{name}: missing, expected a value")
    return schema(**changes)


def check(instance, prefix: str = "") -> None:
    """Checks the fields of a dataclass that was not read from a file.

    Raises: ValueError as convert.
    """
    for name, hint in hints_of(type(instance)).items():
        convert(f"{prefix}{name}", getattr(instance, name), hint)
