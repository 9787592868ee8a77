"""How far a scene's windows end from what was measured, in the channels' own units."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.data.reading import check_against_scene
from makebreak.gap.data.recording import Recording, unit_of
from makebreak.gap.data.scene_facts import scene_names
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.simulation.driven_arm import DrivenArmScene, DrivenArmSimulation
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import WindowModel, seen_in
from makebreak.models.effects.kind import sliding_joints
from makebreak.models.scene import Scene


@dataclass(frozen=True)
class Judged:
    """rms: over all samples of all windows; at_end: of the last sample of each, as far
    ahead as a window is long. noise: standard deviation of a sample. failed: share of
    the windows that the simulation did not finish. channel: or `all positions`, where
    there are several in one unit."""

    channel: str
    unit: str
    rms: float
    at_end: float
    noise: float
    n_windows: int
    failed: float


def judge(
    scene: Scene, recordings: Sequence[Recording], window_sec: float = 0.4
) -> list[Judged]:
    """Simulates windows that start from measured states, one after the other, with the
    recordings' commands, and compares. Nothing is fitted. Joints alone, without shapes
    that touch, are simulated by compiled code (tested against Drake), else by Drake.

    Raises: ValueError where the scene and the recordings do not fit together, or
        nothing that was measured can be simulated.
    """
    if not window_sec > 0.0:
        raise ValueError(f"window is {window_sec} s, expected > 0")
    model = WindowModel(
        scene, recordings, window_sec, most=10**6, simulation=_simulation(scene)
    )
    plant = model.dynamics.plant
    joints, bodies = scene_names(plant)
    for recording in recordings:
        check_against_scene(recording, joints, bodies)
    sliding = sliding_joints(plant)
    simulated = model.simulate(())
    off, last, done = [], [], []
    for window, y in zip(model.windows, simulated, strict=True):
        done.append(not np.isinf(y).any())
        off.append(seen_in(model, window) - y)
        # A window that ends early, with its recording, does not reach so far ahead.
        time = recordings[window.recording].time[window.rows]
        if time[-1] - window.start > 0.9 * window_sec:
            last.append(off[-1][-1:])
    errors = np.concatenate(off)  # NaN where nothing was measured, or simulated.
    ends = np.concatenate(last or [np.full((1, len(model.channels)), np.nan)])
    failed = 1.0 - float(np.mean(done))
    units = [
        unit_of(quantity, at in sliding)
        for at, quantity in (c.rsplit(".", 1) for c in model.channels)
    ]
    positions = {
        unit: [
            k for k, c in enumerate(model.channels)
            if units[k] == unit and c.endswith(".position")
        ]
        for unit in dict.fromkeys(units)
    }  # fmt: skip
    rows = [(c, units[k], [k]) for k, c in enumerate(model.channels)]
    rows += [
        ("all positions", unit, some)
        for unit, some in positions.items()
        if len(some) > 1
    ]
    return [
        Judged(
            channel, unit, _rms(errors[:, some]), _rms(ends[:, some]),
            float(np.sqrt(np.mean(model.noise[some] ** 2))), len(done), failed,
        )
        for channel, unit, some in rows
    ]  # fmt: skip


def _rms(e: np.ndarray) -> float:
    e = e[np.isfinite(e)]
    return float(np.sqrt(np.mean(e**2))) if e.size else float("nan")


def _simulation(scene: Scene) -> SceneSimulation:
    try:
        arms = DrivenArmScene(scene)
    except DoesNotFit:
        return SceneSimulation(scene)
    return SceneSimulation(scene) if arms.has_shapes else DrivenArmSimulation(scene)
