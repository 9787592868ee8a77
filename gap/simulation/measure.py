"""The gap before and after, over held-out windows simulated from measured states."""

from collections.abc import Sequence
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


def gap_measure(model: Windows, before, after, held: Sequence[bool]) -> GapMeasure:
    """Args: before, after: what windows simulate without and with effects; held: which
    windows count. Samples that were not measured, or that one of them does not tell,
    and windows that one of them does not finish, count in neither."""
    picked = [k for k, h in enumerate(held) if h]
    failed = [
        [bool(np.isinf(each[k]).any()) for k in picked] for each in (before, after)
    ]
    whole = [k for k, *f in zip(picked, *failed, strict=True) if not any(f)] or picked

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
        {}, len(picked), (sum(failed[0]), sum(failed[1])),
        seconds=float(sum(
            np.ptp(recordings[w.recording].time[w.rows])
            for w in (model.windows[k] for k in picked)
        )),
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
                np.concatenate([before[k][:, c] for k in same]),
                np.concatenate([after[k][:, c] for k in same]),
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
