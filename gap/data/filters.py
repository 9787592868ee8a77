"""What a sidecar says of a channel's filter, as stages that can be simulated.

A text ("first order, 40 Hz", "Butterworth of order 2, 30 Hz; delay 5 ms"), a mapping
({type: butterworth, order: 2, cutoff_hz: 30}) or a list of such, in the order in which
the signal passes them.
"""

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches

import numpy as np

from makebreak.systems.numerics.filters import (
    Delay,
    LowPass,
    MovingAverage,
    Stage,
)

FILTERED_SEC = 0.0026  # A signal's samples before a filter are no further apart.
EXAMPLES = (
    '"first order, 40 Hz", "Butterworth of order 2, 30 Hz", "moving average, 10 ms", '
    '"backward difference", "delay, 5 ms" or "none"'
)
# Of each type: the names that its numbers may have; one of each group.
_CUTOFF = ("cutoff_hz", "time_constant")
_TYPES = {
    "first_order": (_CUTOFF,),
    "butterworth": (("order",), _CUTOFF),
    "moving_average": (("width", "samples"),),
    "backward_difference": (),
    "exponential": (("alpha",),),
    "delay": (("delay", "samples"),),
}
_NUMBER = r"(\d+(?:\.\d*)?(?:e[+-]?\d+)?|\.\d+)"
_QUANTITY = re.compile(
    _NUMBER + r"\s*(khz|hz|rad/s|ms|us|µs|s|samples?|rows?|periods?|steps?)(?![\w/])"
)
_ORDER = re.compile(rf"order\s*(?:of|=|:)?\s*{_NUMBER}|{_NUMBER}(?:nd|rd|th|st)?[ -]or")
_WORDS = {"first": 1, "second": 2, "third": 3, "fourth": 4, "one-pole": 1}


def read_filter(
    what: str, said, quantity: str, period: float
) -> tuple[Stage, ...] | None:
    """The stages of a channel's filter; None for a text that says no filter we know.

    Args: what: the channel, for messages. said: from the sidecar. quantity: the
        channel's. period: of its samples [s], which a filter over samples, or a
        backward difference, works on.
    Raises: ValueError, one line, for what is no filter.
    """
    if isinstance(said, str):
        return _of_text(what, said, quantity, period)
    if isinstance(said, Mapping):
        return (_of_mapping(what, said, quantity, period),)
    if isinstance(said, Sequence):
        found: list[Stage] = []
        for each in said:
            stages = read_filter(what, each, quantity, period)
            if stages is None:
                return None
            found += stages
        return tuple(found)
    raise ValueError(
        f"filters of {what}: got {said!r}, expected a text as {EXAMPLES}, or type and "
        "numbers"
    )


def _of_mapping(what: str, said: Mapping, quantity: str, period: float) -> Stage:
    kind = re.sub(r"[ -]+", "_", str(said.get("type", "")).strip().lower())
    if kind not in _TYPES:
        close = get_close_matches(kind, _TYPES, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"one of {', '.join(_TYPES)}"
        raise ValueError(f'filters of {what}: type "{said.get("type")}": {hint}')
    numbers: dict[str, float] = {}
    known = {name for group in _TYPES[kind] for name in group}
    for name, value in said.items():
        if name == "type":
            continue
        if name not in known:
            raise ValueError(
                f'filters of {what}: {kind} has no "{name}", expected '
                f"{' and '.join(' or '.join(g) for g in _TYPES[kind]) or 'nothing'}"
            )
        try:
            numbers[name] = float(value)
        except (TypeError, ValueError):
            numbers[name] = np.nan
        if isinstance(value, bool) or not np.isfinite(numbers[name]):
            raise ValueError(
                f"filters of {what}: {name} is {value!r}, expected a number"
            )
    for group in _TYPES[kind]:
        if sum(name in numbers for name in group) != 1:
            raise ValueError(f"filters of {what}: {kind} needs {' or '.join(group)}")
    if "time_constant" in numbers:
        if not numbers["time_constant"] > 0.0:
            raise ValueError(
                f"filters of {what}: time_constant is {numbers['time_constant']} s, "
                "expected more than 0"
            )
        numbers["cutoff_hz"] = 1.0 / (2.0 * np.pi * numbers["time_constant"])
    return _stage(what, kind, numbers, quantity, period)


def _stage(what, kind, numbers: Mapping, quantity, period) -> Stage:
    try:
        if kind == "delay":
            return Delay(numbers.get("delay", numbers.get("samples", 0.0) * period))
        if kind == "moving_average":
            return MovingAverage(
                numbers.get("width", numbers.get("samples", 0.0) * period)
            )
        if kind == "backward_difference":
            if not quantity.startswith(("velocity", "v", "w")):
                raise ValueError("a backward difference gives a velocity, this is none")
            return MovingAverage(period)
        if kind == "exponential":  # y += alpha (x - y), a sample.
            alpha = numbers["alpha"]
            if not 0.0 < alpha < 1.0:
                raise ValueError(f"alpha is {alpha}, expected between 0 and 1")
            return LowPass(-float(np.log1p(-alpha)) / period)
        order = numbers.get("order", 1.0)
        if order != int(order):
            raise ValueError(f"the order is {order}, expected an integer")
        return LowPass(2.0 * np.pi * numbers["cutoff_hz"], int(order))
    except ValueError as error:
        raise ValueError(f"filters of {what}: {error}") from None


def _of_text(what, text: str, quantity, period) -> tuple[Stage, ...] | None:
    stages: list[Stage] = []
    for part in re.split(r";|\+|\bthen\b|\band\b|->", text.lower()):
        part = part.strip(" ,.")
        if not part:
            continue
        if part in ("none", "raw", "unfiltered", "no filter"):
            continue
        found = _of_words(part)
        if found is None:
            return None
        stages.append(_stage(what, *found, quantity, period))
    return tuple(stages)


def _of_words(part: str) -> tuple[str, dict[str, float]] | None:
    """Type and numbers of one stage, or None."""
    hz = sec = samples = None
    for number, unit in _QUANTITY.findall(part):
        value = float(number)
        if unit in ("khz", "hz", "rad/s"):
            hz = value * {"khz": 1e3, "hz": 1.0, "rad/s": 0.5 / np.pi}[unit]
        elif unit in ("ms", "us", "µs", "s"):
            sec = value * {"ms": 1e-3, "s": 1.0}.get(unit, 1e-6)
        else:
            samples = value
    if "zero-phase" in part or "zero phase" in part or "filtfilt" in part:
        return None  # What looks ahead is simulated by no causal filter.
    if "differen" in part:
        return ("backward_difference", {}) if "central" not in part else None
    if re.search(r"average|mean\b|boxcar", part):
        if sec is not None:
            return "moving_average", {"width": sec}
        return None if samples is None else ("moving_average", {"samples": samples})
    if re.search(r"delay|latency|\blate\b|lags? by", part):
        if sec is not None:
            return "delay", {"delay": sec}
        return None if samples is None else ("delay", {"samples": samples})
    order = None
    for words in _ORDER.findall(part):
        order = float(next(w for w in words if w))
    for word, value in _WORDS.items():
        if word in part:
            order = float(value)
    alpha = re.search(rf"alpha\s*(?:of|=|:)?\s*{_NUMBER}", part)
    if alpha and order in (None, 1.0):
        return "exponential", {"alpha": float(alpha.group(1))}
    if not re.search(r"low.?pass|butterworth|order|\brc\b|pole|exponential", part):
        return None
    if hz is None:
        if sec is None or order not in (None, 1.0):
            return None
        hz = 0.5 / (np.pi * sec)
    if order is None:
        if "butterworth" in part:
            return None  # Of which order?
        order = 1.0
    return "butterworth", {"order": order, "cutoff_hz": hz}
