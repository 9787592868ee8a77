"""From a scene and recordings of the real thing to what the scene lacks."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from makebreak.gap.checks import check_recordings
from makebreak.gap.contact import (
    contact_candidates,
    contact_model,
)
from makebreak.gap.findings import Finding
from makebreak.gap.inverse import InverseModel
from makebreak.gap.recording import (
    Recording,
    check_against_scene,
    read_recordings,
)
from makebreak.gap.result import GapMeasure, GapResult, Series
from makebreak.gap.scene_facts import scene_facts, scene_names
from makebreak.gap.screen import candidates, nuisances
from makebreak.gap.select import FLOOR, Selection, select
from makebreak.gap.touch import TouchModel, touch_candidates
from makebreak.gap.verdict import named, says, verdict_of
from makebreak.gap.where import unexplained, where_in_motion, where_in_windows
from makebreak.gap.windows import WindowModel, with_step
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.numerics.selection import Screen

WINDOW_SEC = 0.3


def run_gap(
    scene_path: str | Path,
    recording_paths: Sequence[str | Path],
    out_dir: str | Path | None = None,
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
) -> GapResult:
    """Finds where a scene and recordings disagree, and names what the scene lacks.

    Args: out_dir: made if missing; who writes reports fills it. jobs: kept for
        simulations side by side; one process so far. progress: called with a line of
        text now and then.
    Raises: ValueError, one line, for a scene or recording that cannot be read or do
        not fit together.
    """
    say = progress or (lambda text: None)
    clock = _Clock()
    seconds: dict[str, float] = {}
    scene = read_scene(scene_path)
    recordings = read_recordings(recording_paths)
    dynamics = SceneDynamics(scene)
    joints, bodies = scene_names(dynamics.plant)
    for recording in recordings:
        check_against_scene(recording, joints, bodies)
    if out_dir is not None:
        Path(out_dir).mkdir(parents=True, exist_ok=True)
    say("checking the recordings")
    checks = check_recordings(recordings, scene_facts(dynamics.plant))
    seconds["checks"] = clock.lap()
    touch = _touch_model(scene, recordings, dynamics)
    if touch is not None:
        result = _of_touch(touch, checks, seconds, clock, say)
        return result.with_seconds(seconds)
    scene, finding = _settle_step(scene, recordings, dynamics)
    checks += finding
    if _is_mechanism(dynamics, recordings):
        result = _of_mechanism(scene, recordings, checks, seconds, clock, say)
    else:
        result = _of_objects(scene, recordings, checks, seconds, clock, say)
    return result.with_seconds(seconds)


class _Clock:
    def __init__(self):
        self._last = time.perf_counter()

    def lap(self) -> float:
        now = time.perf_counter()
        self._last, took = now, now - self._last
        return took


def _is_mechanism(dynamics: SceneDynamics, recordings: Sequence[Recording]) -> bool:
    """Whether every coordinate is a joint with a measured position."""
    plant = dynamics.plant
    joints = [j for j in one_dof_joints(plant) if j.num_velocities()]
    return len(joints) == plant.num_velocities() and all(
        f"{full_name(plant, j)}.position" in r for j in joints for r in recordings
    )


def _touch_model(scene, recordings, dynamics) -> TouchModel | None:
    """Where a measured mechanism touches measured objects, and a wrench tells when."""
    if _is_mechanism(dynamics, recordings) or not one_dof_joints(dynamics.plant):
        return None
    try:
        return TouchModel(scene, recordings)
    except ValueError:
        return None


def _settle_step(scene: Scene, recordings, dynamics) -> tuple[Scene, list[Finding]]:
    """The scene with a step so small that its error is below the noise, and what was
    found. Without contact a continuous plant is as fast, and exact."""
    step = scene.plant.time_step
    if step == 0.0:
        return scene, []
    fine = with_step(scene, 0.0 if _is_mechanism(dynamics, recordings) else step / 4.0)
    try:
        coarse_model = WindowModel(scene, recordings, WINDOW_SEC, most=24)
        fine_model = WindowModel(fine, recordings, WINDOW_SEC, most=24)
    except ValueError:
        return scene, []
    a, b = coarse_model.simulate(()), fine_model.simulate(())
    off = [
        (x - y) / w.std
        for x, y, w in zip(a, b, coarse_model.windows, strict=True)
        if len(x)
    ]
    size = float(np.sqrt(np.nanmean(np.clip(np.concatenate(off), -200, 200) ** 2)))
    if size < 1.0 and not _is_mechanism(dynamics, recordings):
        return scene, []  # A finer step costs four times as much.
    grave = size >= 0.3
    return fine, [
        Finding(
            "time_step",
            recordings[0].name,
            "time",
            size,
            "noise",
            "warning" if grave else "info",
            f"The scene's time step of {step:g} s errs by {size:.2g} times the noise "
            f"within {WINDOW_SEC} s; the comparison uses "
            f"{fine.plant.time_step or 'a continuous plant'}.",
        )
    ]


def _of_mechanism(scene, recordings, checks, seconds, clock, say) -> GapResult:
    say("smoothing the motion")
    model = InverseModel(scene, recordings)
    nuisance, prior, names = nuisances(model)
    say("screening the catalogue")
    clear = Screen(model.base(), nuisance, prior, model.train()).fit()
    found = candidates(model, nuisance) if clear.score > FLOOR else []
    seconds["screen"] = clock.lap()
    selection = select(model, nuisance, prior, found, say)
    seconds["select"] = clock.lap()
    choices = selection.choices
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(choices, start, end)
    say("simulating held-out windows")
    effects = [c.effect for c in choices]
    background = _background(names, prior, selection)
    moved = _background_effects(model, names, selection.end.b)
    measure, series = _measure(scene, recordings, effects, moved)
    seconds["simulate"] = clock.lap()
    where = where_in_motion(model, selection.start.left)
    if verdict == "no_gap":
        where = []
    effects_named = [named(c) for c in choices]
    rest = unexplained(model, selection.end.left) if verdict == "gap_unnamed" else []
    return GapResult(
        verdict, says(verdict, effects_named, start, end), where, effects_named,
        measure, rest, background, checks, series, selection.table,
    )  # fmt: skip


def _of_touch(model: TouchModel, checks, seconds, clock, say) -> GapResult:
    say("measuring how tool and object touch")
    nuisance, prior, names = model.nuisances()
    clear = Screen(model.base(), nuisance, prior, model.train()).fit()
    found = touch_candidates(model, nuisance) if clear.score > FLOOR else []
    seconds["screen"] = clock.lap()
    selection = select(model, nuisance, prior, found, say)
    seconds["select"] = clock.lap()
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(selection.choices, start, end)
    before, after = selection.start.left, selection.end.left
    effects_named = [named(c) for c in selection.choices]
    return GapResult(
        verdict, says(verdict, effects_named, start, end),
        model.where(before) if verdict != "no_gap" else [], effects_named,
        model.measure(before, after), [], _background(names, prior, selection), checks,
        model.series(before, after), selection.table,
    )  # fmt: skip


def _of_objects(scene, recordings, checks, seconds, clock, say) -> GapResult:
    say("cutting windows")
    model = contact_model(scene, recordings)
    model.base()
    empty = np.zeros((len(model.train()), 0))
    say("screening the catalogue by simulation")
    train = model.train()
    clear = Screen(model.base(), empty, np.zeros(0), train).fit()
    found = contact_candidates(model, empty, say) if clear.score > FLOOR else []
    seconds["screen"] = clock.lap()
    selection = select(model, empty, np.zeros(0), found, say)
    seconds["select"] = clock.lap()
    effects = [c.effect for c in selection.choices]
    before, after = model.simulate(()), model.simulate(effects)
    measure = _gap_measure(model, before, after)
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(selection.choices, start, end)
    where = where_in_windows(model, model.errors(before)) if verdict != "no_gap" else []
    effects_named = [named(c) for c in selection.choices]
    seconds["simulate"] = clock.lap()
    return GapResult(
        verdict, says(verdict, effects_named, start, end), where, effects_named,
        measure, [], {}, checks, _series(model, before, after), selection.table,
    )  # fmt: skip


def _background(names, prior, selection: Selection) -> dict[str, float]:
    b = selection.end.b
    return {n: float(x / p) for n, x, p in zip(names, b, prior, strict=True)}


def _background_effects(model: InverseModel, names, values) -> list[Effect]:
    """The links as the nuisances have them, as effects of a scene."""
    masses: dict[str, float] = {}
    shifts: dict[str, np.ndarray] = {}
    for name, b in zip(names, values, strict=True):
        kind, rest = name.split(" of ", 1)
        at, unknown = rest.rsplit(", ", 1)
        if kind == "object_mass":
            masses[at] = float(b)
        else:
            shifts.setdefault(at, np.zeros(3))["xyz".index(unknown[0])] = b
    out = []
    for at, change in masses.items():
        now = model.dynamics.now("object_mass", [at])["mass"]
        out.append(Effect("object_mass", [at], {"mass": max(now + change, 0.1 * now)}))
    for at, shift in shifts.items():
        com = model.dynamics.now("object_com", [at])
        moved = {k: com[k] + float(d) for k, d in zip("xyz", shift, strict=True)}
        out.append(Effect("object_com", [at], moved))
    return out


def _measure(scene, recordings, effects, moved):
    """Before and after over held-out windows, the background moved within tolerance in
    both, as neither the gap nor its cure."""
    model = WindowModel(scene, recordings, WINDOW_SEC, most=240)
    taken = {(e.kind, tuple(e.at)) for e in effects}
    moved = [e for e in moved if (e.kind, tuple(e.at)) not in taken]
    try:
        before = model.simulate(moved)
        after = model.simulate([*moved, *effects]) if effects else before
    except ValueError:  # A link that its background would make impossible.
        before, after = model.simulate(()), model.simulate(effects)
    return _gap_measure(model, before, after), _series(model, before, after)


def _gap_measure(model: WindowModel, before, after) -> GapMeasure:
    held = [not w.train for w in model.windows]
    if not any(held):
        held = [True] * len(held)
    a = np.concatenate([e for e, h in zip(model.errors(before), held) if h])  # noqa: B905
    b = np.concatenate([e for e, h in zip(model.errors(after), held) if h])  # noqa: B905
    per_channel = {
        name: {
            "before": float(np.sqrt(np.mean(a[:, c] ** 2))),
            "after": float(np.sqrt(np.mean(b[:, c] ** 2))),
        }
        for c, name in enumerate(model.channels)
    }
    return GapMeasure(
        float(np.sqrt(np.mean(a**2))), float(np.sqrt(np.mean(b**2))), 1.0,
        model.window_sec, per_channel,
    )  # fmt: skip


def _series(model: WindowModel, before, after, most: int = 12) -> list[Series]:
    """The channels over the first block of held-out windows."""
    rows = [k for k, w in enumerate(model.windows) if not w.train]
    if not rows:
        return []
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
