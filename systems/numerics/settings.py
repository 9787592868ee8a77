"""Whether the settings of a config are of the types that its dataclass says.

`yaml_load_typed` checks that for files; Python checks nothing. Ranges are each system's
own to check.
"""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

_TIMES = "period_sec", "offset_sec"


def check_settings(config, name: str = "") -> None:
    """Checks all fields of a dataclass, and of those within it.

    A number is no bool and not NaN; infinity is one. An integer may be a float without
    a fraction. A list may be a tuple or an array. period_sec is positive and offset_sec
    at least 0, both finite. Arrays are left to their systems.

    Args: name: what the config is called in messages; empty: by its class.
    Raises: ValueError, naming the setting.
    """
    name = name or type(config).__name__
    kind: Any = type(config)
    for field, hint in _hints(kind):
        _check(f"{name}.{field}", getattr(config, field), hint)
    times = {field: getattr(config, field, None) for field in _TIMES}
    check_times(name, **{k: v for k, v in times.items() if v is not None})


def check_times(name: str, period_sec=1.0, offset_sec=0.0) -> None:
    """Checks when a system updates: Drake takes an offset that is NaN or negative, and
    then nothing happens, or at another time.

    Args: name: of the system or its config.
    Raises: ValueError, naming the setting.
    """
    for field, value in zip(_TIMES, (period_sec, offset_sec), strict=True):
        _check(f"{name}.{field}", value, float)
        is_period = field == "period_sec"
        if not 0.0 <= value < np.inf or (is_period and value == 0.0):
            wanted = "a positive time" if is_period else "a time of 0 or more"
            raise ValueError(f"{name}.{field} is {value}, expected {wanted} [s]")


@cache
def _hints(kind) -> list[tuple[str, Any]]:
    hints = get_type_hints(kind)
    return [(field.name, hints[field.name]) for field in fields(kind)]


def _check(name: str, value, hint) -> None:
    """Raises: ValueError if the value is not what the type says."""
    wanted = _unlike(value, hint)
    if wanted:
        raise ValueError(f"{name} is {value!r}, expected {wanted}")
    if is_dataclass(value):
        check_settings(value, name)
    item = next((h for h in _options(hint) if get_origin(h) is list), None)
    if item is not None and value is not None:
        for i, entry in enumerate(value):
            _check(f"{name}[{i}]", entry, get_args(item)[0])


def _options(hint) -> tuple:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _unlike(value, hint) -> str:
    """What was expected; empty if the value is that."""
    missed = []
    for option in _options(hint):
        wanted = _unlike_one(value, option)
        if not wanted:
            return ""
        missed.append(wanted)
    return " or ".join(missed)


def _unlike_one(value, hint) -> str:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    is_number = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    is_number = is_number and value == value
    if hint is float:
        return "" if is_number else "a number"
    if hint is int:
        whole = is_number and (isinstance(value, Integral) or value % 1 == 0)
        return "" if whole else "an integer"
    if hint is bool:
        return "" if isinstance(value, (bool, np.bool_)) else "true or false"
    if hint is str:
        return "" if isinstance(value, str) else "a text"
    if hint is NoneType:
        return "" if value is None else "None"
    if get_origin(hint) is list:
        is_text = isinstance(value, (str, bytes))
        many = isinstance(value, Sequence) or (isinstance(value, np.ndarray))
        return "" if many and not is_text else "a list"
    if isinstance(hint, type) and is_dataclass(hint):
        return "" if isinstance(value, hint) else f"{hint.__name__}(...)"
    return ""  # Arrays, and what no config has.
