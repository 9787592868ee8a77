"""What a sidecar says of a recording: noise, filters, names of columns, spans to leave
out, files to join."""

import json
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from makebreak.gap.data.match import follow
from makebreak.gap.data.recording import WrenchAsLogged
from makebreak.gap.data.table import stem_of
from makebreak.models.activation import Activation

_SECTIONS = (
    "noise", "filters", "columns", "wrench", "ignore", "join", "provenance",
    "calibration", "rate_hz",
)  # fmt: skip
_OF_COLUMN = ("channel", "scale", "offset", "add_up_from", "lag", "from", "between")
_OF_ONE_LOG = ("ignore", "join", "provenance")
_AS_WRITTEN = ("provenance", "rate_hz")


def sidecar_of(path: Path) -> Path:
    """Where a recording's sidecar is expected: monday.csv has monday.yaml."""
    return path.with_name(f"{stem_of(path)}.yaml")


def has_sidecar(path: Path) -> bool:
    """Whether a file beside the recording speaks of it alone."""
    return bool(_own_sidecars(path))


def has_sidecars(folder: Path) -> bool:
    """Whether a file in a folder names columns, as sidecars do."""
    for file in folder.glob("*.y*ml"):
        with suppress(ValueError, OSError):
            sections = _sections(file) or {}
            if "columns" in sections and set(sections) <= {*_SECTIONS}:
                return True
    return False


def own_sections(path: Path) -> dict:
    """{section: as written} of the sidecar beside a recording, with whole paths of
    files; none: {}.

    Raises: ValueError as read_sidecars.
    """
    read = read_sidecars(path, None)
    own = _own_sidecars(path)
    found = (_sections(own[0]) or {}) if own else {}
    if "join" in read:
        found["join"] = [str(file.resolve()) for file in read["join"]]
    if "calibration" in read:
        found["calibration"] = str(read["calibration"].resolve())
    return found


@dataclass(frozen=True)
class Found:
    """The sidecar that is used for a log. sections: as written; file: where they are,
    None where there is none; is_own: whether it speaks of this log alone. notes: what
    is to be said of it."""

    sections: Mapping[str, Any]
    file: Path | None = None
    is_own: bool = True
    notes: tuple[str, ...] = ()


def sidecar_for(
    path: Path,
    columns: Collection[str],
    given: Path | None = None,
    folders: Sequence[Path] = (),
) -> Found:
    """The sidecar that is given, else that beside the log, else one of another log,
    beside it or in `folders`, whose columns this log has, too: logs of one robot.

    Args: columns: all that the log has, columns of text too.
    Raises: ValueError, one line, for one that is given, or beside the log, and names
        columns that the log lacks.
    """
    own = _own_sidecars(path)
    if given is not None:
        sections = _sections(given) if given.is_file() else None
        if sections is None:
            raise ValueError(f"sidecar {given} does not exist, or nothing is in it")
        sections = {k: x for k, x in sections.items() if k not in _OF_ONE_LOG}
        if lacking := _lacking(sections, columns):
            raise ValueError(
                f"sidecar {given} does not fit {path.name}: it names "
                f"{', '.join(lacking[:3])}; {path.name} has {', '.join(columns)}"
            )
        return Found(sections, given, False, (f"{path.name}: columns as in {given}",))
    if own:
        sections = own_sections(path)
        if lacking := _lacking(sections, columns):
            raise ValueError(
                f'{own[0]}: columns names "{lacking[0]}", {path.name} has '
                f"{', '.join(columns)}"
            )
        return Found(sections, own[0])
    fits: dict[Path, dict] = {}
    notes = []
    for folder in dict.fromkeys(each.resolve() for each in (path.parent, *folders)):
        for file in sorted(folder.glob("*.y*ml")):
            try:
                sections = _sections(file) or {}
            except (ValueError, OSError):
                continue
            named = sections.get("columns")
            if set(sections) - {*_SECTIONS} or not isinstance(named, dict):
                continue  # No sidecar.
            named = {str(k): to for k, to in named.items()}
            lacking = _lacking(sections, columns)
            if not lacking and any(key in columns for key in named):
                fits[file] = {k: x for k, x in sections.items() if k not in _OF_ONE_LOG}
            elif len(lacking) < 0.5 * len(named):
                notes.append(
                    f"{path.name}: {file.name} is not used, as it names {lacking[0]}, "
                    "which this log lacks"
                )
    if not fits:
        return Found({}, notes=tuple(notes))
    first = next(iter(fits))
    if any(each != fits[first] for each in fits.values()):
        says = ", ".join(file.name for file in fits)
        notes.append(
            f"{path.name}: sidecars of other logs fit and contradict each other: {says}"
            "; none is used (--sidecar FILE chooses one)"
        )
        return Found({}, notes=tuple(notes))
    says = (
        f"{path.name} has no sidecar: columns as in {first.name}, that of another log"
    )
    return Found(fits[first], first, False, (*notes, says))


def _lacking(sections: Mapping, columns: Collection[str]) -> list[str]:
    """Columns that a sidecar says something of and a log does not have."""
    named = sections.get("columns") or {}
    return [
        str(k) for k, to in named.items() if to is not None and str(k) not in columns
    ]


def _own_sidecars(path: Path) -> list[Path]:
    own = [sidecar_of(path), path.with_name(f"{path.name}.yaml")]
    own += [file.with_suffix(".yml") for file in own]
    return [file for file in dict.fromkeys(own) if file.is_file()]


def read_sidecars(path: Path, given: Path | None) -> dict:
    """noise.json in the folder, and `<recording>.yaml`, or .csv.yaml, which wins.

    Args: given: in place of the one beside the recording.
    Returns: {section: what it says}, as written but for `ignore`: (from, to, episode)
        of spans; `join`: paths; `wrench`: {place: WrenchAsLogged}; `own`: channels
        that are named in the recording's own sidecar.
    Raises: ValueError that names the file and what is wrong in it.
    """
    merged: dict = {}
    own = _own_sidecars(path) if given is None else [given]
    if len(own) > 1:
        raise ValueError(
            f"recording {path} has two sidecars: {own[0].name} and {own[1].name}"
        )
    for file in (path.with_name("noise.json"), *own):
        data = _sections(file) if file.is_file() else None
        if data is None:
            continue
        for key, value in data.items():
            if key not in _SECTIONS:
                expected = ", ".join(_SECTIONS)
                raise ValueError(f'{file}: "{key}", expected one of {expected}')
            if key == "ignore":
                value = _spans(file, value)
            elif key in ("join", "calibration"):
                value = _files_of(file, key, value)
                value = value if key == "join" else value[0]
            elif key not in _AS_WRITTEN and value is not None:
                if not isinstance(value, dict):
                    raise ValueError(f"{file}: {key} must be names with values")
                value = {str(k): v for k, v in value.items()}
                if key == "wrench":
                    value = {at: _wrench(file, at, v) for at, v in value.items()}
                value = (merged.get(key) or {}) | value
            merged[key] = value
        for key, value in (data.get("noise") or {}).items():
            number = _finite_number(f"{file}: noise of {key}", value, least=0.0)
            merged["noise"][str(key)] = number
        if "rate_hz" in data:
            rate = _finite_number(f"{file}: rate_hz", data["rate_hz"], least=0.0)
            if rate == 0.0:
                raise ValueError(f"{file}: rate_hz is 0, expected rows per second")
            merged["rate_hz"] = rate
        if file in own:  # It speaks of this recording alone.
            merged["own"] = {str(key) for key in data.get("noise") or {}} | {
                str(key) for key in data.get("filters") or {}
            }
    return merged


def _sections(file: Path) -> dict | None:
    """What is written in a file; None where nothing is."""
    try:
        # Not YAML for both: YAML reads 1e-5 as a text.
        text = file.read_text()
        data = json.loads(text) if file.suffix == ".json" else yaml.safe_load(text)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"{file}: {' '.join(str(error).split())}") from None
    if data is None:
        return None
    if not isinstance(data, dict):
        raise ValueError(f"{file}: expected names with values")
    if file.suffix == ".json" and not set(data) & set(_SECTIONS):
        return {"noise": data}  # {channel: standard deviation}
    return data


def _files_of(file: Path, key: str, said) -> list[Path]:
    """Files, named beside the sidecar, that belong to a recording."""
    names = said if isinstance(said, list) else [said]
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{file}: {key}: got {said}, expected a file name, or a list")
    return [file.parent / name for name in names]


def _spans(file: Path, said) -> list[tuple[float, float, int | None]]:
    """From, to [s] and the episode, None for all, of spans that are to be left out."""
    spans = []
    for each in said if isinstance(said, list) else [said]:
        if not isinstance(each, dict) or set(each) - {"from", "to", "episode"}:
            raise ValueError(
                f"{file}: ignore has {each!r}, expected a list of {{from: 16, to: 18}} "
                "in seconds of the recording's time, and episode where it has several"
            )
        first, last = (
            _finite_number(f"{file}: ignore, {key}", each.get(key))
            for key in ("from", "to")
        )
        if not first < last:
            raise ValueError(f"{file}: ignore is from {first} to {last} s")
        episode = each.get("episode")
        if episode is not None and not isinstance(episode, int):
            raise ValueError(f"{file}: ignore, episode is {episode!r}")
        spans.append((first, last, episode))
    return spans


_WRENCH = {
    "holds_weight": (False, True),
    "axes": ("world", "sensor"),
    "acts_on": ("robot", "environment"),
}


def _wrench(file: Path, at: str, said) -> WrenchAsLogged:
    """How a wrench was logged; what is not said is as the format has it."""
    if not isinstance(said, dict) or set(said) - set(_WRENCH):
        raise ValueError(
            f"{file}: wrench of {at}: got {said!r}, expected {{holds_weight: true, "
            "axes: sensor, acts_on: environment}, or some of these"
        )
    for key, value in said.items():
        expected = _WRENCH[key]
        if not any(type(value) is type(x) and value == x for x in expected):
            words = " or ".join(str(x).lower() for x in expected)
            raise ValueError(
                f"{file}: wrench of {at}: {key} is {value!r}, expected {words}"
            )
    return WrenchAsLogged(**said)


def _finite_number(what: str, value, least: float = -np.inf) -> float:
    try:
        number = float(value)  # YAML reads 1e-5, without a point, as a text.
    except (TypeError, ValueError):
        number = np.nan
    if not (np.isfinite(number) and number >= least) or isinstance(value, bool):
        tail = f" of {least:g} or more" if np.isfinite(least) else ""
        raise ValueError(f"{what} is {value!r}, expected a finite number{tail}")
    return number


def renamed(
    path: Path,
    columns: Mapping[str, np.ndarray],
    names: Mapping,
    unused: frozenset[str],
) -> dict[str, np.ndarray]:
    """The columns under our names.

    names: {foreign: ours}, {foreign: null} to leave one out, or {foreign: {channel:
    ours, scale: factor, offset: added after it}}, and what activation_said reads.
    """
    file, result = sidecar_of(path), {}
    followed: dict[str, Activation] = {}
    for foreign in names:
        if foreign not in columns and foreign not in unused:
            raise ValueError(
                f'{file}: columns names "{foreign}", {path.name} has '
                f"{', '.join(columns)}"
            )
    for name, value in columns.items():
        target = names.get(name, name)
        if target is None:
            continue
        if isinstance(target, dict):
            what = f'{file}: columns, "{name}":'
            value, target, activation = _scaled(what, value, target)
            if activation is not None:
                followed[str(target)] = activation
        if not isinstance(target, str):
            raise ValueError(
                f'{file}: columns, "{name}": got {target}, expected the name of a '
                "channel, or null"
            )
        if target in result:
            raise ValueError(f'{file}: two columns are mapped to "{target}"')
        result[target] = value
    for name, activation in followed.items():
        if "time" not in result:
            raise ValueError(f"{file}: {name} needs the column time")
        result[name] = follow(activation, name, result[name], result["time"])
    return result


def activation_said(what: str, said: Mapping) -> Activation | None:
    """Of {add_up_from: start [rad]} or {lag: [s], from: start}, with between: [low,
    high].

    Raises: ValueError, one line.
    """
    if not {"add_up_from", "lag"} & set(said):
        return None
    lag = _finite_number(f"{what} lag", said.get("lag", 0.0), least=0.0)
    start = said.get("add_up_from", said.get("from", 0.0))
    start = _finite_number(f"{what} where it begins", start)
    between = said.get("between", (-np.inf, np.inf))
    try:
        low, high = (float(x) for x in between)
        good = low <= high
    except (TypeError, ValueError):
        good = False
    if not good:
        raise ValueError(f"{what} between is {between!r}, expected [low, high]")
    if ("lag" in said) == ("add_up_from" in said) or ("lag" in said and not lag):
        raise ValueError(f"{what} expected add_up_from, or a lag above 0 s")
    return Activation(lag, start, low, high)


def activation_text(activation: Activation) -> str:
    """As activation_said reads it, without braces."""
    text = f"add_up_from: {activation.start!r}"
    if activation.lag:
        text = f"lag: {activation.lag!r}, from: {activation.start!r}"
    if np.isfinite([activation.low, activation.high]).any():
        ends = (f"{x!r}" if np.isfinite(x) else f"{'-' * (x < 0)}.inf"
                for x in (activation.low, activation.high))  # fmt: skip
        text += f", between: [{', '.join(ends)}]"
    return text


def _scaled(
    what: str, value: np.ndarray, said: Mapping
) -> tuple[np.ndarray, str, Activation | None]:
    """A column in our unit, and its channel: {channel, scale, offset} applied; and what
    is to be made of it when all columns are known."""
    if set(said) - {*_OF_COLUMN} or "channel" not in said:
        raise ValueError(
            f"{what} got {sorted(said)}, expected channel, and some of "
            f"{', '.join(_OF_COLUMN[1:])}"
        )
    scale = _finite_number(f"{what} scale", said.get("scale", 1.0))
    if scale == 0.0:
        raise ValueError(f"{what} scale is 0, which leaves nothing")
    offset = _finite_number(f"{what} offset", said.get("offset", 0.0))
    return scale * value + offset, said["channel"], activation_said(what, said)
