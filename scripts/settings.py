"""Reads settings into an experiment's config dataclass, and refuses what is wrong."""

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

_EXPECTED = {int: "an integer", float: "a number", bool: "true or false", str: "a text"}


def nearest(name: str, valid: Iterable[str]) -> str:
    """The end of a refusal: the valid names nearest to `name`, or all of them."""
    valid = list(valid)

    def likeness(other: str) -> tuple[float, float]:
        """Of the last parts, as often only that is given; then of the whole names."""
        pairs = [(name.rpartition(".")[2], other.rpartition(".")[2]), (name, other)]
        last, whole = (difflib.SequenceMatcher(None, *p).ratio() for p in pairs)
        return last, whole

    ranked = sorted(valid, key=likeness, reverse=True)
    least = max([0.6, *(likeness(v)[0] - 0.1 for v in ranked[:1])])
    close = [v for v in ranked[:3] if likeness(v)[0] >= least]
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"expected one of: {', '.join(valid)}"


def field_types(schema: type) -> dict[str, Any]:
    """{dotted name: type} of all fields of a dataclass and of those nested in it."""
    fields: dict[str, Any] = {}
    hints = typing.get_type_hints(schema)
    for f in dataclasses.fields(schema):
        fields[f.name] = hints[f.name]
        if dataclasses.is_dataclass(hints[f.name]):
            nested = field_types(hints[f.name])
            fields |= {f"{f.name}.{name}": hint for name, hint in nested.items()}
    return fields


def _refuse(name: str, value, expected: str):
    text = (
        value
        if isinstance(value, str)
        else yaml.safe_dump(value, width=1000, default_flow_style=True)
    )
    text = " ".join(text.replace("\n...", "").split())
    raise ValueError(f'{name}: got "{text}", expected {expected}')


def convert(name: str, value, hint, raw: str | None = None):
    """`value`, as YAML reads it, as the declared type `hint`.

    Args:
        name: the field, for the message.
        value: what YAML made of the text.
        hint: the field's declared type.
        raw: the text itself: a field that is a str takes it as it stands.
    Raises: ValueError naming the field, the value and what was expected.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
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
        if value in args and not isinstance(value, bool):
            return value
        _refuse(name, value, "one of: " + ", ".join(map(str, args)))
    if hint in (str, Path):
        text = raw if raw is not None else value
        if not isinstance(text, str):
            _refuse(name, value, _EXPECTED[str])
        return hint(text)
    if hint is bool:
        if not isinstance(value, bool):
            _refuse(name, value, _EXPECTED[bool])
        return value
    if hint in (int, float):
        if isinstance(value, str):  # YAML 1.1 takes 1e-3, without a dot, for a text.
            try:
                value = float(value)
            except ValueError:
                _refuse(name, value, _EXPECTED[hint])
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or value != value or (hint is int and value != value // 1):
            _refuse(name, value, _EXPECTED[hint])
        return hint(value)
    if hint is np.ndarray:
        try:
            return np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            _refuse(name, value, "numbers")
    if origin in (list, tuple):
        if not isinstance(value, list):
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
        if not isinstance(value, dict):
            _refuse(name, value, f"{name}.FIELD=value, or a mapping")
        return _merge(typing.cast(type, hint), value, None, name + ".")
    if origin is dict:
        if not isinstance(value, dict):
            _refuse(name, value, "a mapping, as {a: 1}")
        return {k: convert(f"{name}.{k}", v, args[1]) for k, v in value.items()}
    return value


def _merge(schema: type, mapping: dict, config=None, prefix: str = ""):
    """`config` with the fields that `mapping` names replaced, nested ones merged; a new
    one if `config` is None."""
    hints = typing.get_type_hints(schema)
    fields = {prefix + f.name: f for f in dataclasses.fields(schema)}
    changes = {}
    for key, value in mapping.items():
        name = f"{prefix}{key}"
        if name not in fields:
            raise ValueError(f"unknown key {name}; {nearest(name, fields)}")
        old = getattr(config, key, None)
        if dataclasses.is_dataclass(old) and isinstance(value, dict):
            changes[key] = _merge(type(old), value, old, name + ".")
        else:
            changes[key] = convert(name, value, hints[key])
    if config is not None:
        return dataclasses.replace(config, **changes)
    for name, f in fields.items():
        required = f.default is f.default_factory is dataclasses.MISSING
        if required and f.name not in changes:
            raise ValueError(f"{name}: missing, expected a value")
    return schema(**changes)


def load_config(schema: type, path: Path):
    """The config in the YAML file at `path`.

    Raises: ValueError in one line: no such file, not YAML, an unknown key (with the
        nearest valid names), a value of the wrong type.
    """
    if not path.is_file():
        raise ValueError(f'--config: got "{path}", expected a YAML file')
    try:
        mapping = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"--config {path}: not YAML: {_one_line(error)}") from error
    if not isinstance(mapping, dict | None):
        raise ValueError(f"--config {path}: got {mapping!r}, expected key: value lines")
    # Not yaml_load_typed: its messages do not name the field's path, it has no nearest
    # names, and it takes no tuple.
    try:
        return _merge(schema, mapping or {}, schema())
    except ValueError as error:
        raise ValueError(f"--config {path}: {_one_line(error)}") from error


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


def apply_settings(config, settings: Iterable[str]):
    """`config` with `key=value` settings applied, in order; keys may be dotted.

    Raises: ValueError in one line: no `=`, an unknown key, a value that is not YAML or
        not of the field's type.
    """
    types_of = field_types(type(config))
    for setting in settings:
        key, equals, raw = setting.partition("=")
        key = key.strip()
        if not equals or not key:
            raise ValueError(f'--set: got "{setting}", expected key=value')
        if key not in types_of:
            raise ValueError(f"--set: unknown key {key}; {nearest(key, types_of)}")
        try:
            value = yaml.safe_load(raw)
        except yaml.YAMLError as error:
            raise ValueError(
                f'--set {key}: got "{raw}", not YAML: {_one_line(error)}'
            ) from error
        try:
            config = _replace(config, key.split("."), value, raw, types_of[key], key)
        except ValueError as error:
            raise ValueError(f"--set {_one_line(error)}") from error
    return config


def _replace(config, path: list[str], value, raw: str, hint, name: str):
    """`config` with the field at `path` replaced; the configs around it are copied."""
    first, *rest = path
    if rest:
        new = _replace(getattr(config, first), rest, value, raw, hint, name)
    elif dataclasses.is_dataclass(hint) and isinstance(value, dict):
        old = getattr(config, first)
        new = _merge(type(old), value, old, name + ".")
    else:
        new = convert(name, value, hint, raw)
    return dataclasses.replace(config, **{first: new})


def to_plain(config) -> dict:
    """The config as dicts, lists and scalars, for a YAML file that reads back."""

    def plain(value):
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {
                f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)
            }
        if isinstance(value, dict):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [plain(v) for v in value]
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, Path):
            return str(value)
        return value

    return plain(config)


def dump_config(config) -> str:
    """The config as YAML text that `--config` reads back."""
    return yaml.safe_dump(to_plain(config), sort_keys=False, width=88)
