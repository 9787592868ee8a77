"""How far a scene's windows end from what was measured, in the channels' own units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.recording import Recording, check_against_scene, unit_of
from makebreak.gap.scene_facts import scene_names
from makebreak.gap.windows import WindowModel, seen_in
from makebreak.models.effects.kind import sliding_joints
from makebreak.models.scene import Scene


@dataclass(frozen=True)
class Judged:
    """rms: over all samples of all windows. noise: standard deviation of a sample.
    failed: share of the windows that the simulation did not finish."""

    channel: str
    unit: str
    rms: float
    noise: float
    n_windows: int
    failed: float


def judge(
    scene: Scene, recordings: Sequence[Recording], window_sec: float = 0.4
) -> list[Judged]:
    """Simulates windows that start from measured states, one after the other, with the
    recordings' commands, and compares. Nothing is fitted.

    Raises: ValueError where the scene and the recordings do not fit together, or
        nothing that was measured can be simulated.
    """
    if not window_sec > 0.0:
        raise ValueError(f"window is {window_sec} s, expected > 0")
    model = WindowModel(scene, recordings, window_sec, most=10**6)
    plant = model.dynamics.plant
    joints, bodies = scene_names(plant)
    for recording in recordings:
        check_against_scene(recording, joints, bodies)
    sliding = sliding_joints(plant)
    simulated = model.simulate(())
    off, done = [], []
    for window, y in zip(model.windows, simulated, strict=True):
        done.append(not np.isinf(y).any())
        off.append(seen_in(model, window) - y)
    errors = np.concatenate(off)  # NaN where nothing was measured, or simulated.
    found = []
    for k, channel in enumerate(model.channels):
        at, quantity = channel.rsplit(".", 1)
        e = errors[np.isfinite(errors[:, k]), k]
        found.append(
            Judged(
                channel, unit_of(quantity, at in sliding),
                float(np.sqrt(np.mean(e**2))) if e.size else float("nan"),
                float(model.noise[k]), len(done), 1.0 - float(np.mean(done)),
            )
        )  # fmt: skip
    return found
