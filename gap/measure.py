"""The gap before and after, over held-out windows simulated from measured states."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np

from makebreak.gap.parallel import side_by_side
from makebreak.gap.recording import Recording
from makebreak.gap.result import GapMeasure, Series
from makebreak.gap.windows import WindowModel
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene

WINDOW_SEC = 0.3
# What a perfect model would leave: an error is divided by what the channel's noise and
# the uncertainty of its window's start give together.
NOISE_FLOOR = 1.0


class Windows(Protocol):
    """Windows of recordings, simulated: WindowModel, FreeBodyModel."""

    recordings: list[Recording]
    windows: list[Any]  # Each with recording, episode, rows, train.
    channels: list[str]
    noise: np.ndarray
    window_sec: float

    def errors(self, simulated: Sequence[np.ndarray]) -> list[np.ndarray]: ...


def measure(
    scene: Scene,
    recordings: Sequence[Recording],
    effects: Sequence[Effect],
    moved: Sequence[Effect],
    jobs: int = 1,
) -> tuple[GapMeasure, list[Series]]:
    """Before and after over held-out windows.

    Args: effects: to be added. moved: the background as far as its tolerance lets it,
        in both, as it is neither the gap nor its cure.
    """
    model = WindowModel(scene, recordings, WINDOW_SEC, most=240)
    taken = {(e.kind, tuple(e.at)) for e in effects}
    moved = [e for e in moved if (e.kind, tuple(e.at)) not in taken]
    trials = [moved, [*moved, *effects]] if effects else [moved]
    held = held_out(model)
    calls = [partial(model.simulate, trial, held) for trial in trials]
    try:
        found = list(side_by_side(calls, jobs))
    except ValueError:  # A link that its background would make impossible.
        found = [model.simulate((), held), model.simulate(effects, held)]
    before, after = found[0], found[-1]
    return gap_measure(model, before, after), series_of(model, before, after)


def held_out(model: Windows) -> list[bool]:
    """Which windows count: all, where none is held out."""
    held = [not w.train for w in model.windows]
    return held if any(held) else [True] * len(held)


def gap_measure(model: Windows, before, after) -> GapMeasure:
    """Args: before, after: what held-out windows simulate without and with effects."""
    held = held_out(model)

    def errors(simulated) -> np.ndarray:
        each = zip(model.errors(simulated), held, strict=True)
        return np.concatenate([e for e, h in each if h])

    a, b = errors(before), errors(after)
    per_channel = {
        name: {
            "before": float(np.sqrt(np.mean(a[:, c] ** 2))),
            "after": float(np.sqrt(np.mean(b[:, c] ** 2))),
        }
        for c, name in enumerate(model.channels)
    }
    return GapMeasure(
        float(np.sqrt(np.mean(a**2))), float(np.sqrt(np.mean(b**2))), NOISE_FLOOR,
        model.window_sec, per_channel,
    )  # fmt: skip


def series_of(model: Windows, before, after, most: int = 12) -> list[Series]:
    """The channels over the first block of held-out windows."""
    rows = np.flatnonzero(held_out(model))
    first = model.windows[rows[0]]
    same = [
        k for k in rows
        if (model.windows[k].recording, model.windows[k].episode)
        == (first.recording, first.episode)
    ][:most]  # fmt: skip
    recording = model.recordings[first.recording]
    time = np.concatenate([recording.time[model.windows[k].rows] for k in same])
    lengths = [len(before[k]) for k in same]
    starts = np.cumsum([0, *lengths[:-1]])
    out = []
    for c, channel in enumerate(model.channels):
        seen = [recording[channel][model.windows[k].rows] for k in same]
        out.append(
            Series(
                channel, recording.name, first.episode, time, np.concatenate(seen),
                np.concatenate([before[k][:, c] for k in same]),
                np.concatenate([after[k][:, c] for k in same]),
                starts, float(model.noise[c]),
            )
        )  # fmt: skip
    return out
