"""Reads settings into an experiment's config dataclass, and checks them."""

import dataclasses
import typing
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml

from makebreak.models.typed_yaml import (
    Between,
    convert,
    field_types,
    hints_of,
    load_yaml,
    merge,
    nearest,
    one_line,
    read_yaml,
    shown,
)


def load_config(schema: type, path: Path):
    """The config in the YAML file at `path`.

    Raises: ValueError in one line: no such file, not YAML, an unknown key (with the
        nearest valid names), a value of the wrong type.
    """
    if not path.is_file():
        raise ValueError(f'--config: got "{path}", expected a YAML file')
    try:
        mapping = read_yaml(path)
        if not isinstance(mapping, dict | None):
            raise ValueError(f'got "{shown(mapping)}", expected key: value lines')
        config = merge(schema, mapping or {}, schema())
        check_sizes(config, schema())
        return config
    except ValueError as error:
        raise ValueError(f"--config {path}: {one_line(error)}") from error


def unknown_key(option: str, key: str, schema: type, listed_as: str = ""):
    """The error for a key that the config has not: the names that are most like it, and
    the command that lists all.

    Args: listed_as: the experiment's name, for that command.
    """
    hint = nearest(shown(key), field_types(schema))
    if listed_as:
        hint += f" (makebreak list {listed_as} lists all)"
    return ValueError(f"{option}: unknown key {shown(key)}; {hint}")


def apply_settings(config, settings: Iterable[str], listed_as: str = ""):
    """`config` with `key=value` settings applied, in order; keys may be dotted.

    Args: listed_as: the experiment's name, for the message about an unknown key.
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
            raise unknown_key("--set", key, type(config), listed_as)
        try:
            value = load_yaml(raw)
        except ValueError as error:
            raise ValueError(
                f'--set {key}: got "{shown(raw)}", {one_line(error)}'
            ) from error
        try:
            config = _replace(config, key.split("."), value, raw, types_of[key], key)
        except ValueError as error:
            raise ValueError(f"--set {one_line(error)}") from error
    try:
        check_sizes(config, type(config)())
    except ValueError as error:
        raise ValueError(f"--set {one_line(error)}") from error
    return config


# Bounds of numbers by the suffix of their names; a field's own Between has priority.
_BOUNDS = {
    "period_sec": Between(1e-4, 10.0, "s"),
    "offset_sec": Between(0.0, 10.0, "s"),
    "seed": Between(None, 2.0**63 - 1.0),
    "friction": Between(0.0, 100.0),
    "stiffness_most": Between(0.0, 1e9, "N/m"),  # Its default may be 0.
    "integral_sec": Between(1e-3, None, "s"),  # Infinite: no integral.
    "hold_sec": Between(0.0, None, "s"),  # Infinite: without end.
}
# Limits of other numbers: real ones over the default (or 1), integers over it (or 10).
_RATIO_MAX, _COUNT_RATIO_MAX = 1e4, 1000
_MAGNITUDE_MIN = 1e-30  # The inverse of a smaller number may overflow.


def check_sizes(config, default, prefix: str = "") -> None:
    """Raises: ValueError for numbers that must be a mistake: infinite where neither the
    default nor that of the field's own class is, or thousands of times the default."""
    hints = hints_of(type(config))
    for f in dataclasses.fields(config):
        value, usual = getattr(config, f.name), getattr(default, f.name)
        name = f"{prefix}{f.name}"
        if dataclasses.is_dataclass(value):
            check_sizes(value, usual, name + ".")
        elif isinstance(value, float) and value == f.default == np.inf:
            continue  # As without such a limit.
        elif typing.get_origin(hints[f.name]) is not typing.Annotated:
            _check_size(name, value, usual)


def _check_size(name: str, value, usual) -> None:
    if isinstance(value, list | tuple):
        for i, each in enumerate(value):
            _check_size(f"{name}[{i}]", each, usual)
        return
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    usual = [usual] if not isinstance(usual, list | tuple) else usual
    sizes = [abs(x) for x in usual if isinstance(x, int | float)]
    last = name.rpartition(".")[2].partition("[")[0]
    bounds = _BOUNDS.get(last)
    if bounds is None:
        if isinstance(value, int):
            most = _COUNT_RATIO_MAX * max([10, *sizes])
        else:
            most = _RATIO_MAX * max([1.0, *sizes])
        bounds = Between(-most, most)
    tiny = 0.0 < abs(value) < _MAGNITUDE_MIN
    if value in usual or (bounds.holds(value) and not tiny):
        return
    if tiny:
        raise ValueError(
            f'{name}: got "{shown(value)}", expected 0 or at least {_MAGNITUDE_MIN}'
        )
    raise ValueError(f'{name}: got "{shown(value)}", expected {bounds}')


def _replace(config, path: list[str], value, raw: str, hint, name: str):
    """A copy of `config` with the field at `path` replaced."""
    first, *rest = path
    if rest:
        new = _replace(getattr(config, first), rest, value, raw, hint, name)
    elif dataclasses.is_dataclass(hint) and isinstance(value, dict):
        old = getattr(config, first)
        new = merge(type(old), value, old, name + ".")
    else:
        new = convert(name, value, hint, raw)
    return dataclasses.replace(config, **{first: new})


def to_plain(config) -> dict:
    """The config as dicts, lists and scalars, for YAML."""

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
