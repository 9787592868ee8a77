"""The gap before and after, over held-out windows simulated from measured states."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np

from makebreak.gap.inverse import InverseModel
from makebreak.gap.parallel import side_by_side
from makebreak.gap.recording import Recording
from makebreak.gap.result import GapMeasure, Series
from makebreak.gap.windows import WindowModel, seen_in
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.transmission import twists
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
    motion: InverseModel,
    jobs: int = 1,
) -> tuple[GapMeasure, list[Series]]:
    """Before and after over held-out windows.

    Args: effects: to be added. moved: the background as far as its tolerance lets it,
        in both, as it is neither the gap nor its cure. motion: what tells how far a
        joint lags its motor where a window starts.
    """
    model = WindowModel(scene, recordings, WINDOW_SEC, most=240)
    taken = {(e.kind, tuple(e.at)) for e in effects}
    moved = [e for e in moved if (e.kind, tuple(e.at)) not in taken]
    trials = [moved, [*moved, *effects]] if effects else [moved]
    held = held_out(model)
    lag = _twists(motion, effects)
    calls = [partial(model.simulate, trial, held, lag) for trial in trials]
    try:
        found = list(side_by_side(calls, jobs))
    except ValueError:  # A link that its background would make impossible.
        found = [model.simulate((), held), model.simulate(effects, held, lag)]
    before, after = found[0], found[-1]
    return gap_measure(model, before, after), series_of(model, before, after)


def _twists(motion: InverseModel, effects: Sequence[Effect]):
    """Function of a window: {joint: (twist, its rate)} at its start, of the motion as
    measured in the scene as it came. None if nothing twists."""
    every = (*motion.scene.effects, *effects)
    hidden = [e for e in every if KINDS[e.kind].hidden_state]
    if not hidden:
        return None
    known: dict[tuple[str, int], list[tuple[np.ndarray, dict]]] = {}
    for track, each in zip(motion.tracks, motion.motions(), strict=True):
        of: dict[str, np.ndarray] = {}
        for effect in hidden:
            of |= twists(effect, motion.dynamics, each)
        stretches = known.setdefault((track.recording, track.episode), [])
        stretches.append((each.time, of))

    def at(window) -> dict[str, tuple[float, float]]:
        name = motion.recordings[window.recording].name
        for time, of in known.get((name, window.episode), []):
            if time[0] - 0.05 <= window.start <= time[-1]:
                k = int(np.searchsorted(time, window.start))
                return {j: (float(z[0, k]), float(z[1, k])) for j, z in of.items()}
        return {}  # Too short a stretch to tell.

    return at


def held_out(model: Windows) -> list[bool]:
    """Which windows count: all, where none is held out."""
    held = [not w.train for w in model.windows]
    return held if any(held) else [True] * len(held)


def gap_measure(model: Windows, before, after) -> GapMeasure:
    """Args: before, after: what held-out windows simulate without and with effects.
    Samples that were not measured, or that one of them does not tell, count in
    neither."""
    held = held_out(model)

    def of_held(each) -> np.ndarray:
        return np.concatenate([e for e, h in zip(each, held, strict=True) if h])

    both = ~(np.isnan(of_held(before)) | np.isnan(of_held(after)))
    both &= np.isfinite(of_held([seen_in(model, w) for w in model.windows]))
    a, b = of_held(model.errors(before)), of_held(model.errors(after))

    def rms(e: np.ndarray, c) -> float:
        told = e[:, c][both[:, c]]
        return float(np.sqrt(np.mean(told**2))) if len(told) else 0.0

    per_channel = {
        name: {"before": rms(a, c), "after": rms(b, c)}
        for c, name in enumerate(model.channels)
    }
    everything = slice(None)
    return GapMeasure(
        rms(a, everything), rms(b, everything), NOISE_FLOOR, model.window_sec,
        per_channel,
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
