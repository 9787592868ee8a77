"""The gap of a mechanism before and after, over windows of its measured motion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.parallel import side_by_side
from makebreak.gap.problem import rms
from makebreak.gap.residuals.inverse import InverseModel
from makebreak.gap.residuals.where import where_in_windows
from makebreak.gap.result import GapMeasure, InUnits, Series, Where
from makebreak.gap.simulation.driven_arm import DrivenArmSimulation, can_have
from makebreak.gap.simulation.measure import (
    WINDOW_SEC,
    gap_measure,
    series_of,
    why_stopped,
)
from makebreak.gap.simulation.windows import Window, WindowModel, seen_in
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, sliding_joints
from makebreak.models.effects.transmission import twist_deviations, twists
from makebreak.models.scene import Scene

# Of a step [rad/s]: what no drive holds shows the error of each. With it a free double
# pendulum at 20 rad/s is off by 4e-6 rad after 0.3 s.
TOL = 1e-6


def measure(
    scene: Scene,
    effects: Sequence[Effect],
    moved: Sequence[Effect],
    motion: InverseModel,
    every: bool,
    jobs: int = 1,
    skip: Callable[[Window], bool] = lambda window: False,
    slow_noise: Mapping[str, float] | None = None,
    known: np.ndarray | float = 0.0,
) -> tuple[GapMeasure, list[Series], list[Where]] | None:
    """Before and after over windows of the recordings that `motion` has, and where
    these stand out before; None where no window counts.

    Args: effects: to be added. moved: the background as far as its tolerance lets it,
        in both, as it is neither the gap nor its cure. motion: what tells how far a
        joint lags its motor where a window starts. every: all windows, of recordings
        that are only reported on; else those that were not fitted. skip: windows that
        count in neither. slow_noise: as WindowModel. known (m,): what else of the
        equations the background explains, in both.
    """
    model = WindowModel(
        scene, motion.recordings, WINDOW_SEC, most=240, slow_noise=slow_noise,
        simulation=_compiled(scene, [*moved, *effects]),
    )  # fmt: skip
    widen(model, effects, slow_noise)
    taken = {(e.kind, tuple(e.at)) for e in effects}
    moved = [e for e in moved if (e.kind, tuple(e.at)) not in taken]
    trials = [moved, [*moved, *effects]] if effects else [moved]
    held = [(every or not w.train) and not skip(w) for w in model.windows]
    if not any(held):
        return None
    lag = _twists(motion, effects)
    calls = [partial(model.simulate, trial, held, lag) for trial in trials]
    try:
        found = list(side_by_side(calls, jobs))
    except ValueError:  # A link that its nuisances would make impossible.
        trials = [[], list(effects)]
        found = [_simulated(model, each, held, lag) for each in trials]
    found = [
        _with_fitted_twists(model, motion, each, held, lag, y)
        for each, y in zip(trials, found, strict=True)
    ]
    before, after = found[0], found[-1]

    def why(k: int, with_effects: bool) -> str:
        return why_stopped(model, trials[-1 if with_effects else 0], k)

    gap = gap_measure(model, before, after, held, why)
    equations, by_block = _equations(motion, trials[0], trials[-1], known, every)
    gap = replace(gap, equations=equations, by_block=by_block)
    if gap.is_measured:
        where = where_in_windows(model, model.errors(before)) if every else []
        return gap, series_of(model, before, after, held), where
    if by_block:  # No window could be simulated.
        each = np.mean([of.mean(axis=1) for of in by_block.values()], axis=0)
        start, end = map(float, np.sqrt(each))
        seconds = float(sum(
            np.ptp(motion.recordings[w.recording].time[w.rows])
            for w, h in zip(model.windows, held, strict=True) if h
        ))  # fmt: skip
        gap = replace(gap, before=start, after=end, seconds=seconds)
    return gap, [], []


def widen(model: WindowModel, effects: Sequence[Effect], slow_noise) -> None:
    """Makes windows no surer than they are without what effects take away: what a
    file's damping holds in the scene as it came runs away from the same small error
    where the real joint has none."""
    away = [
        e for e in effects
        if KINDS[e.kind].least is not None and min(e.parameters.values()) < 0.0
    ]  # fmt: skip
    if not away:
        return
    scene = replace(model.scene, effects=[*model.scene.effects, *away])
    try:
        other = WindowModel(
            scene, model.recordings, WINDOW_SEC, most=240, slow_noise=slow_noise
        )
    except (ValueError, DoesNotFit):  # A scene that cannot have them.
        return
    model.windows = [
        replace(w, std=np.maximum(w.std, o.std))
        for w, o in zip(model.windows, other.windows, strict=True)
    ]


def _compiled(scene: Scene, effects: Sequence[Effect]) -> DrivenArmSimulation | None:
    """Compiled code that steps joints; None: it takes Drake's steps."""
    try:
        simulation = DrivenArmSimulation(scene)
    except DoesNotFit:
        return None
    simulation.tol = TOL
    return simulation if all(can_have(e.kind) for e in effects) else None


def _simulated(model: WindowModel, effects: Sequence[Effect], held, lag):
    """As model.simulate; infinite in every window if the scene cannot have these
    effects (a link without mass, a joint too light for its drive)."""
    try:
        return model.simulate(effects, held, lag)
    except ValueError:
        lengths = [
            w.rows.stop - w.rows.start if h else 0
            for w, h in zip(model.windows, held, strict=True)
        ]
        return [np.full((n, len(model.channels)), np.inf) for n in lengths]


def _equations(
    motion: InverseModel, before, after, known: np.ndarray | float, every: bool
) -> tuple[dict[str, InUnits], dict[str, np.ndarray]]:
    """What the model leaves of each joint's effort, in its unit; and its mean squares
    over the noise by block of time (GapMeasure.by_block)."""
    n = len(motion.names())
    rows = np.ones(len(motion.train()), bool) if every else ~motion.train()
    rows = rows.reshape(-1, n)[:, 0]
    try:
        both = [motion.residual(each) - known for each in (before, after)]
    except ValueError:
        return {}, {}
    left = [motion.in_units(r) for r in both]
    noise = motion.noise_in_units()
    slides = sliding_joints(motion.dynamics.plant)
    units, by_block = {}, {}
    block = motion.blocks().reshape(-1, n)[rows, 0]
    squares = [motion.in_noise(r).reshape(-1, n)[rows] ** 2 for r in both]
    for k, (what, joint) in enumerate(motion.names()):
        untold = motion.untold[motion.joints.index(joint)]
        if what != "effort" or untold or not len(block):
            continue
        name = f"{joint}.effort"
        units[name] = InUnits(
            "N" if joint in slides else "N m", rms(left[0][rows, k]),
            rms(left[1][rows, k]), rms(noise[rows, k]),
        )  # fmt: skip
        by_block[name] = np.array(
            [[np.mean(s[block == b, k]) for b in np.unique(block)] for s in squares]
        )
    return units, by_block


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


def _with_fitted_twists(
    model: WindowModel, motion: InverseModel, effects: Sequence[Effect], held, lag,
    simulated: list[np.ndarray],
) -> list[np.ndarray]:  # fmt: skip
    """The windows simulated again, each from the twists of elastic joints that fit it
    best. No channel measures a twist at a window's start, and an error of it, which the
    torque's noise makes, grows with the window.

    How far a twist and its rate may go is weighed against what the torque's noise makes
    of them, so that a stiff joint has no such freedom.
    """
    deviations = _twist_deviations(motion, [*motion.scene.effects, *effects])
    if lag is None or not deviations:
        return simulated
    prior = np.ravel(list(deviations.values()))
    moved: list[dict[str, np.ndarray]] = [
        {joint: np.zeros(2) for joint in deviations} for _ in model.windows
    ]
    number = {id(w): k for k, w in enumerate(model.windows)}

    def start(window) -> dict[str, tuple[float, float]]:
        found, by = lag(window), moved[number[id(window)]]
        return {
            joint: (z + by[joint][0], w + by[joint][1]) if joint in by else (z, w)
            for joint, (z, w) in found.items()
        }

    slopes = []
    for joint, size in deviations.items():
        for k in range(2):
            for each in moved:
                each[joint][k] = size[k]
            slopes.append(_simulated(model, effects, held, start))
            for each in moved:
                each[joint][k] = 0.0
    for k, w in enumerate(model.windows):
        if not held[k]:
            continue
        seen = seen_in(model, w)
        e = (seen - simulated[k]) / w.std
        columns = [(y[k] - simulated[k]) / w.std for y in slopes]
        known = np.isfinite(e) & np.all([np.isfinite(c) for c in columns], axis=0)
        J = np.stack([c[known] for c in columns], axis=1)
        x = np.linalg.solve(J.T @ J + np.eye(len(prior)), J.T @ e[known])
        for joint, by in zip(deviations, (prior * x).reshape(-1, 2), strict=True):
            moved[k][joint] = by
    return _simulated(model, effects, held, start)


def _twist_deviations(
    motion: InverseModel, effects: Sequence[Effect]
) -> dict[str, np.ndarray]:
    """{joint: standard deviations of the twist and its rate (2,)} at a window's start,
    the largest of all stretches of the recordings."""
    found: dict[str, np.ndarray] = {}
    for effect in effects:
        for each in motion.motions():
            for joint, size in twist_deviations(effect, motion.dynamics, each).items():
                found[joint] = np.maximum(size, found.get(joint, 0.0))
    return found
