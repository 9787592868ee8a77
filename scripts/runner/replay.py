"""Replays recorded inputs into a single system, and compares its outputs.

`makebreak export-tests` writes the data; the tests that it writes call `replay`.
"""

import dataclasses
import importlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import LeafSystem, PortDataType
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.timing import observed

# Tolerances, the relative one to the largest number in an array: the order of sums may
# depend on the compiler.
RTOL = 1e-6
ATOL = 1e-9


class Unsupported(ValueError):
    """A value that cannot be stored."""


def flatten(value: Any, leaves: list[np.ndarray]):
    """The structure of `value`, as JSON; its numbers are appended to `leaves`.

    Raises: Unsupported for anything but numbers, texts, arrays, lists, dictionaries,
        dataclasses, named tuples and 8-bit images of those.
    """
    if value is None or isinstance(value, str):
        return {"value": value}
    if isinstance(value, bool | int | float | np.number | np.ndarray):
        array = np.asarray(value)
        if array.dtype == object:
            raise Unsupported("an array of objects")
        leaves.append(array)
        scalar = not isinstance(value, np.ndarray)
        kind = type(value).__name__ if scalar else ""
        # An enum is its number here, and becomes its class again in `rebuild`.
        if scalar and type(value).__module__.startswith("makebreak"):
            return {"enum": _name(type(value))}
        return {"array": [list(array.shape), array.dtype.str, kind]}
    if isinstance(value, ImageRgba8U):
        leaves.append(np.array(value.data))
        return {"image": list(value.data.shape)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [f.name for f in dataclasses.fields(value) if f.init]
        parts = [flatten(getattr(value, name), leaves) for name in fields]
        return {"class": _name(type(value)), "fields": fields, "parts": parts}
    if isinstance(value, tuple | list):
        parts = [flatten(one, leaves) for one in value]
        if hasattr(value, "_fields"):
            return {"named": _name(type(value)), "parts": parts}
        return {type(value).__name__: parts}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        keys = list(value)
        return {
            "dict": keys,
            "parts": [flatten(value[key], leaves) for key in keys],
        }
    raise Unsupported(f"a {type(value).__name__}")


def _name(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _class(name: str) -> Any:
    module, _, qualname = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in qualname.split("."):
        found = getattr(found, part)
    return found


def rebuild(spec: dict, leaves: list[np.ndarray]):
    """The inverse of `flatten`; removes the leaves that it uses from the front."""
    if "value" in spec:
        return spec["value"]
    if "enum" in spec:
        return _class(spec["enum"])(leaves.pop(0).item())
    if "array" in spec:
        shape, dtype, kind = spec["array"]
        array = np.array(leaves.pop(0), dtype=dtype).reshape(shape)
        if kind in ("bool", "int", "float"):
            return array.item()
        return array[()] if kind else array
    if "image" in spec:
        height, width, _ = spec["image"]
        image = ImageRgba8U(width, height)
        image.mutable_data[:] = leaves.pop(0)
        return image
    if "class" in spec:
        parts = [rebuild(part, leaves) for part in spec["parts"]]
        return _class(spec["class"])(**dict(zip(spec["fields"], parts, strict=True)))
    if "named" in spec:
        return _class(spec["named"])(*(rebuild(p, leaves) for p in spec["parts"]))
    if "dict" in spec:
        parts = [rebuild(part, leaves) for part in spec["parts"]]
        return dict(zip(spec["dict"], parts, strict=True))
    if "tuple" in spec:
        return tuple(rebuild(part, leaves) for part in spec["tuple"])
    return [rebuild(part, leaves) for part in spec["list"]]


class Track:
    """The values of one port, one per update. Equal values in a row are kept once, and
    values of the same structure are stacked, to keep the file small."""

    def __init__(self):
        self._specs: list[str] = []
        self._rows: list[list[list[np.ndarray]]] = []
        self._index: list[tuple[int, int]] = []
        self._last: tuple[Any, str, list[np.ndarray]] | None = None

    def append(self, value) -> None:
        if self._last is not None and value is self._last[0]:
            self._index.append(self._index[-1])
            return
        leaves: list[np.ndarray] = []
        spec = json.dumps(flatten(value, leaves))
        leaves = [np.array(leaf) for leaf in leaves]
        if (
            self._last is not None
            and spec == self._last[1]
            and all(
                np.array_equal(a, b) and a.dtype == b.dtype
                for a, b in zip(leaves, self._last[2], strict=True)
            )
        ):
            self._index.append(self._index[-1])
        else:
            if spec not in self._specs:
                self._specs.append(spec)
                self._rows.append([])
            k = self._specs.index(spec)
            self._index.append((k, len(self._rows[k])))
            self._rows[k].append(leaves)
        # A new image may be drawn into the same memory, so `is` says nothing.
        keep = None if isinstance(value, ImageRgba8U) else value
        self._last = (keep if keep is not None else object(), spec, leaves)

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        """Arrays for np.savez, whose names all begin with `name`."""
        out = {
            f"{name}/index": np.array(self._index, dtype=np.int32).reshape(-1, 2),
            f"{name}/specs": np.array(self._specs, dtype=np.str_),
        }
        for i, rows in enumerate(self._rows):
            for k in range(len(rows[0])):
                out[f"{name}/{i}/{k}"] = np.stack([row[k] for row in rows])
        return out


class StoredTrack:
    """Reads what `Track.arrays` wrote: (structure, leaves) of each update."""

    def __init__(self, data, name: str):
        self._specs = [json.loads(text) for text in data[f"{name}/specs"]]
        self._stacks: list[list[np.ndarray]] = [[] for _ in self._specs]
        for i, stack in enumerate(self._stacks):
            while f"{name}/{i}/{len(stack)}" in data:
                stack.append(data[f"{name}/{i}/{len(stack)}"])
        self._index = data[f"{name}/index"]

    def __getitem__(self, k: int) -> tuple[dict, list[np.ndarray]]:
        i, row = self._index[k]
        return self._specs[i], [stack[row] for stack in self._stacks[i]]

    def is_new(self, k: int) -> bool:
        """Whether the value differs from that of the update before."""
        return k == 0 or bool(np.any(self._index[k] != self._index[k - 1]))


def replay(system: LeafSystem, file: Path, ports: Sequence[str] = ()) -> int:
    """Runs `system` alone on recorded inputs and compares its outputs at each update.

    Args:
        system: as it was built for the recording.
        file: the recording's .npz.
        ports: outputs to compare; empty: all recorded ones.
    Returns: number of updates compared.
    Raises: AssertionError, naming port, update and time, if an output differs by more
        than RTOL times its largest number plus ATOL, or if the system updates at other
        times than recorded.
    """
    with np.load(file) as stored:
        data = {name: stored[name] for name in stored.files}
    times = data["time"]
    inputs = {name: StoredTrack(data, f"in/{name}") for name in data["inputs"]}
    outputs = {
        name: StoredTrack(data, f"out/{name}")
        for name in data["outputs"]
        if not ports or name in ports
    }
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    updates: list[float] = []

    def note(_, at):
        updates.append(at.get_time())

    def fix(k: int) -> None:  # k = 0: the inputs before the first update.
        for name, track in inputs.items():
            if not track.is_new(k):
                continue
            port = system.GetInputPort(name)
            value = rebuild(*track[k])
            if port.get_data_type() == PortDataType.kVectorValued:
                port.FixValue(context, np.asarray(value, dtype=float))
            else:
                port.FixValue(context, AbstractValue.Make(value))

    fix(0)
    simulator.Initialize()
    with observed(note):
        for k, time in enumerate(times):
            # AdvanceTo the present time would run the update right away.
            if time > context.get_time():
                simulator.AdvanceTo(float(time))
            fix(k + 1)
            for name, track in outputs.items():
                _compare(system, context, name, track[k], f"update {k}, {time:.4f} s")
        simulator.AdvanceTo(float(times[-1]) + 1e-9)
    if len(updates) != len(times) or not np.allclose(updates, times, atol=1e-9):
        raise AssertionError(
            f"{system.get_name() or type(system).__name__} updated {len(updates)} "
            f"times, from {updates[0] if updates else '-'} s on; it was recorded "
            f"{len(times)} times, from {times[0]} s on"
        )
    return len(times)


def _compare(system, context, name, expected, where) -> None:
    leaves: list[np.ndarray] = []
    spec = flatten(system.GetOutputPort(name).Eval(context), leaves)
    if json.dumps(spec) != json.dumps(expected[0]):
        raise AssertionError(f"output {name}, {where}: of another make than recorded")
    for got, want in zip(leaves, expected[1], strict=True):
        if want.dtype.kind not in "fc":
            good = np.array_equal(got, want)
        else:
            finite = np.abs(want[np.isfinite(want)])
            scale = float(finite.max()) if finite.size else 0.0
            good = np.allclose(
                got, want, rtol=0.0, atol=ATOL + RTOL * scale, equal_nan=True
            )
        if not good:
            raise AssertionError(f"output {name}, {where}: {got} was {want}")
