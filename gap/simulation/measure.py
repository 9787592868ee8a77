"""The gap before and after, over held-out windows simulated from measured states."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from makebreak.gap.data.recording import Recording, unit_of
from makebreak.gap.problem import rms
from makebreak.gap.result import GapMeasure, InUnits, Series
from makebreak.gap.simulation.windows import TURN, WindowModel, seen_in
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect, sliding_joints

WINDOW_SEC = 0.3
# What a perfect model would leave: an error is divided by what the channel's noise and
# the uncertainty of its window's start give together.
NOISE_FLOOR = 1.0
MOST_SHOWN = 12  # Windows of a series.


class Windows(Protocol):
    """Windows of recordings, simulated: WindowModel, FreeBodyModel."""

    recordings: list[Recording]
    windows: list[Any]  # Each with recording, episode, rows, train.
    channels: list[str]
    noise: np.ndarray
    window_sec: float
    dynamics: SceneDynamics

    def errors_over(
        self, simulated: Sequence[np.ndarray], std: Sequence[np.ndarray]
    ) -> list[np.ndarray]: ...


def gap_measure(
    model: Windows,
    before,
    after,
    held: Sequence[bool],
    why: Callable[[int, bool], str] = lambda k, with_effects: "",
) -> GapMeasure:
    """The gap over the windows that both simulate to their end.

    Args: before, after: what windows simulate without and with effects; held: which
        windows count. Samples that were not measured, or that one of them does not
        tell, count in neither. why: why the simulation of window k stopped short,
        without or with the effects.
    Returns: a measure of nothing (is_measured) where no window that holds a measured
        sample is simulated to its end.
    """
    picked = [k for k, h in enumerate(held) if h]
    failed = [
        [bool(np.isinf(each[k]).any()) for k in picked] for each in (before, after)
    ]
    whole = [k for k, *f in zip(picked, *failed, strict=True) if not any(f)]
    count = sum(failed[0]), sum(failed[1])
    failure = ""
    if any(count):
        with_effects = not any(failed[0])
        k = picked[failed[with_effects].index(True)]
        failure = _failure(model, k, why(k, with_effects), with_effects)
    seen = [np.isfinite(seen_in(model, model.windows[k])).any() for k in whole]
    if not any(seen):
        return GapMeasure(
            np.nan, np.nan, NOISE_FLOOR, 0.0,
            n_windows=len(picked), failed=count, failure=failure,
        )  # fmt: skip

    def of_whole(each) -> np.ndarray:
        return np.concatenate([each[k] for k in whole])

    both = ~(np.isnan(of_whole(before)) | np.isnan(of_whole(after)))
    both &= np.isfinite(of_whole([seen_in(model, w) for w in model.windows]))
    stds = [w.std for w in model.windows]
    over = [of_whole(model.errors_over(each, stds)) for each in (before, after)]
    plain = [of_whole(_off(model, each)) for each in (before, after)]

    def rms_of(e: np.ndarray, c) -> float:
        return rms(e[:, c][both[:, c]])

    stds_of_whole = of_whole(stds)
    everything = slice(None)

    def by_window(c) -> np.ndarray:
        """(2, 2, n) mean squares over the expected error, and over the noise."""
        first = np.cumsum([0, *(len(before[k]) for k in whole)])[:-1]
        n = np.add.reduceat(both[:, c].astype(float), first)
        over_noise = [each[:, c] / model.noise[c] for each in plain]
        squares = [
            np.add.reduceat(np.where(both[:, c], e, 0.0) ** 2, first)
            for e in (over[0][:, c], over[1][:, c], *over_noise)
        ]
        found = np.full((4, len(picked)), np.nan)
        found[:, [picked.index(k) for k in whole]] = squares / np.where(n, n, np.nan)
        return found.reshape(2, 2, -1)

    sliding = sliding_joints(model.dynamics.plant)
    recordings = model.recordings
    return GapMeasure(
        rms_of(over[0], everything), rms_of(over[1], everything), NOISE_FLOOR,
        model.window_sec,
        {
            name: {"before": rms_of(over[0], c), "after": rms_of(over[1], c)}
            for c, name in enumerate(model.channels)
        },
        {
            name: InUnits(
                unit_of(name.rsplit(".", 1)[1], name.rsplit(".", 1)[0] in sliding),
                rms_of(plain[0], c), rms_of(plain[1], c), float(model.noise[c]),
                rms_of(stds_of_whole, c),
            )
            for c, name in enumerate(model.channels)
        },
        {}, len(picked), count,
        seconds=float(sum(
            np.ptp(recordings[w.recording].time[w.rows])
            for w in (model.windows[k] for k in picked)
        )),
        failure=failure,
        by_window={name: by_window(c) for c, name in enumerate(model.channels)},
    )  # fmt: skip


def _off(model: Windows, simulated: Sequence[np.ndarray]) -> list[np.ndarray]:
    """(n, n_channels) measured minus simulated of each window, as it is: nothing is
    capped as fits need it. q and -q are one orientation."""
    at = {name: c for c, name in enumerate(model.channels)}
    bodies = {name.rsplit(".", 1)[0] for name in at}
    turns = [[at[f"{body}.{q}"] for q in TURN] for body in sorted(bodies)
             if all(f"{body}.{q}" in at for q in TURN)]  # fmt: skip
    out = []
    for w, y in zip(model.windows, simulated, strict=True):
        seen = seen_in(model, w)
        if not len(y):
            out.append(y)
            continue
        for turn in turns:
            y = np.array(y)
            same = np.sum(np.nan_to_num(y[:, turn] * seen[:, turn]), axis=1)
            y[:, turn] *= np.where(same < 0.0, -1.0, 1.0)[:, None]
        out.append(seen - y)
    return out


def why_stopped(model: WindowModel, effects: Sequence[Effect], k: int) -> str:
    """Why the simulation of window k with these effects stops short; "": not known."""
    try:
        model.simulate(effects, [j == k for j in range(len(model.windows))])
    except ValueError as error:  # The scene cannot have them.
        return str(error)
    return model.simulation.failure


def _failure(model: Windows, k: int, why: str, with_effects: bool) -> str:
    """Which window could not be simulated to its end, and why, as a sentence."""
    w = model.windows[k]
    recording = model.recordings[w.recording]
    time = recording.time[w.rows]
    beside = " with the effects" if with_effects else ""
    why = why or "the state grew beyond all numbers"
    return (
        f"The simulation{beside} of {recording.name} from {time[0]:.4g} to "
        f"{time[-1]:.4g} s (episode {w.episode}) stopped: {why.rstrip('.')}."
    )


def series_of(
    model: Windows, before, after, held: Sequence[bool], most: int = MOST_SHOWN
) -> list[Series]:
    """The channels over the first windows that count."""
    same = _shown(model, held, most)
    first = model.windows[same[0]]
    recording = model.recordings[first.recording]
    time = np.concatenate([recording.time[model.windows[k].rows] for k in same])
    starts = np.cumsum([0, *(len(before[k]) for k in same[:-1])])
    expected = np.concatenate([model.windows[k].std for k in same])
    out = []
    for c, channel in enumerate(model.channels):
        seen = np.full(len(time), np.nan)
        if channel in recording:
            rows = [model.windows[k].rows for k in same]
            seen = np.concatenate([recording[channel][r] for r in rows])
        out.append(
            Series(
                channel, recording.name, first.episode, time, seen,
                _drawn(np.concatenate([before[k][:, c] for k in same])),
                _drawn(np.concatenate([after[k][:, c] for k in same])),
                starts, float(model.noise[c]), expected[:, c],
            )
        )  # fmt: skip
    return out


def unseen_series(
    model: WindowModel, effects: Sequence[Effect], held: Sequence[bool]
) -> list[Series]:
    """The same of coordinates that were not measured, without and with effects: for
    pictures of the motion."""
    other = model.of_unmeasured()
    if other is None:
        return []
    some = set(_shown(model, held))
    chosen = [k in some for k in range(len(model.windows))]
    before, after = (other.simulate(each, chosen) for each in ((), effects))
    return series_of(other, before, after, chosen)


def _shown(model: Windows, held: Sequence[bool], most: int = MOST_SHOWN) -> list[int]:
    """Numbers of the windows that series are of: of one episode."""
    rows = [int(k) for k in np.flatnonzero(held)]
    first = model.windows[rows[0]]
    same = [
        k for k in rows
        if (model.windows[k].recording, model.windows[k].episode)
        == (first.recording, first.episode)
    ]  # fmt: skip
    return same[:most]


def _drawn(y: np.ndarray) -> np.ndarray:
    """(n,) without what is infinite: a simulation that stopped."""
    return np.where(np.isinf(y), np.nan, y)
