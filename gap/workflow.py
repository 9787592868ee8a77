"""From a scene and recordings of the real thing to what the scene lacks."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from makebreak.gap.checks import check_recordings
from makebreak.gap.data.conditioning import condition
from makebreak.gap.findings import Finding
from makebreak.gap.fit import fit_effects
from makebreak.gap.inverse import InverseModel
from makebreak.gap.measure import WINDOW_SEC, measure
from makebreak.gap.objects import of_objects
from makebreak.gap.parallel import side_by_side
from makebreak.gap.recording import (
    Recording,
    check_against_scene,
    excerpt,
    read_recordings,
)
from makebreak.gap.result import GapResult
from makebreak.gap.scene_facts import scene_facts, scene_names
from makebreak.gap.screen import candidates, inseparable, nuisances
from makebreak.gap.select import Choice, Selection, needs_more, select
from makebreak.gap.verdict import UNNAMED, named, says, told, verdict_of
from makebreak.gap.where import unexplained, where_in_motion
from makebreak.gap.windows import WindowModel, with_step
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.scene import Scene, read_scene
from makebreak.systems.numerics.selection import Screen, is_plausible

# Of longer recordings of a mechanism, and of more rows of anything, pieces are used.
MOST_SEC, MOST_ROWS = 60.0, 120_000


def run_gap(
    scene_path: str | Path,
    recording_paths: Sequence[str | Path],
    jobs: int = 1,
    progress: Callable[[str], None] | None = None,
) -> GapResult:
    """Finds where a scene and recordings disagree, and names what the scene lacks.

    Args: jobs: processes at once. progress: called with a line of text now and then.
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
    say("checking the recordings")
    checks = check_recordings(recordings, scene_facts(dynamics.plant))
    recordings, done = condition(recordings, _is_mechanism(dynamics, recordings))
    checks += done
    recordings, cut = _shortened(recordings, dynamics)
    checks += cut
    seconds["checks"] = clock.lap()
    if not _is_mechanism(dynamics, recordings):
        result = of_objects(
            scene, recordings, checks, seconds, clock.lap, say,
            lambda s: _settle_step(s, recordings, dynamics, jobs),
        )  # fmt: skip
        return _unless_doubtful(result).with_seconds(seconds)
    scene, finding = _settle_step(scene, recordings, dynamics, jobs)
    checks += finding
    result = _of_mechanism(scene, recordings, checks, seconds, clock, say, jobs)
    return _unless_doubtful(result).with_seconds(seconds)


def _unless_doubtful(result: GapResult) -> GapResult:
    """Without effects where units, signs or axes are wrong, as they would explain that;
    and without agreement where a channel's motion was taken for noise."""
    hunting = [c.says for c in result.checks if c.kind == "hunting"]
    if result.verdict == "no_gap" and hunting:
        return replace(
            result,
            verdict="gap_unnamed",
            says=f"Nothing can be told of these recordings: {hunting[0]}",
        )
    if not result.effects or all(c.severity != "error" for c in result.checks):
        return result
    per_channel = {
        name: {"before": each["before"], "after": each["before"]}
        for name, each in result.gap.per_channel.items()
    }
    gap = replace(result.gap, after=result.gap.before, per_channel=per_channel)
    return replace(
        result,
        verdict="gap_unnamed",
        says="The scene and the recordings disagree, but units, signs or axes of what "
        "was measured are wrong (see the checks): put that right first, for until then "
        "nothing can be named.",
        effects=[],
        gap=gap,
        series=[replace(each, after=each.before) for each in result.series],
    )


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


def _shortened(recordings: Sequence[Recording], dynamics: SceneDynamics):
    """What of the recordings is used, and what is to be said of it."""
    seconds = MOST_SEC if _is_mechanism(dynamics, recordings) else np.inf
    used = excerpt(recordings, seconds, MOST_ROWS)
    if len(used) == len(recordings) and all(
        len(a.time) == len(b.time) for a, b in zip(used, recordings, strict=True)
    ):
        return used, []
    whole = sum(r.duration_sec() for r in recordings)
    some = sum(r.duration_sec() for r in used)
    says = (
        f"The recordings hold {whole:.4g} s; fits and simulations use {some:.4g} s of "
        f"them, in evenly spread pieces."
    )
    name = recordings[0].name
    return used, [Finding("excerpt", name, "time", some, "s", "info", says)]


def _settle_step(
    scene: Scene, recordings, dynamics, jobs
) -> tuple[Scene, list[Finding]]:
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
    both = [partial(m.simulate, ()) for m in (coarse_model, fine_model)]
    a, b = side_by_side(both, jobs)
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


def _of_mechanism(scene, recordings, checks, seconds, clock, say, jobs) -> GapResult:
    say("smoothing the motion")
    model = InverseModel(scene, recordings)
    nuisance, prior, names = nuisances(model)
    say("screening the catalogue")
    plain = Screen(model.base(), nuisance, prior, model.train())
    needed = needs_more(fit_effects(model, plain, ()), prior)
    found = candidates(model, nuisance, prior) if needed else []
    seconds["screen"] = clock.lap()
    selection = select(model, nuisance, prior, found, say)
    seconds["select"] = clock.lap()
    choices = [_with_inseparable(c, model) for c in selection.choices]
    start, end = selection.start.score, selection.end.score
    far = not is_plausible(selection.end.b, prior)
    # Which blocks are held out is by the clock: some hold next to nothing of the gap.
    whole = [
        float(np.sqrt(np.mean(x.left**2))) for x in (selection.start, selection.end)
    ]
    verdict = verdict_of(choices, max(start, whole[0]), max(end, whole[1]), far)
    say("simulating held-out windows")

    def measured(of: Selection):
        moved = _background_effects(model, names, of.end.b)
        effects = [c.effect for c in of.choices]
        return measure(scene, recordings, effects, moved, model, jobs)

    gap, series = measured(selection)
    if choices and gap.after > max(gap.before, UNNAMED):
        verdict = "gap_unnamed"  # Equations that simulation does not bear out.
    every = selection
    selection, near = told(every, verdict, gap.reduction)
    if selection is not every:
        gap, series = measured(selection)
        choices, end = [], selection.end.score
    background = _background(names, prior, selection)
    seconds["simulate"] = clock.lap()
    where = where_in_motion(model, selection.start.left)
    if verdict == "no_gap":
        where = []
    effects_named = [named(c, model.dynamics.plant) for c in choices]
    rest = unexplained(model, selection.end.left) if verdict == "gap_unnamed" else []
    return GapResult(
        verdict, says(verdict, effects_named, start, end, near), where, effects_named,
        gap, rest, background, checks, series, selection.table,
    )  # fmt: skip


def _with_inseparable(choice: Choice, model: InverseModel) -> Choice:
    other = inseparable(choice.effect, model)
    if other is None or any(tie.kind == other.kind for tie in choice.ties):
        return choice
    return replace(choice, ties=(*choice.ties, other))


def _background(names, prior, selection: Selection) -> dict[str, float]:
    b = selection.end.b
    return {n: float(x / p) for n, x, p in zip(names, b, prior, strict=True)}


def _background_effects(model: InverseModel, names, values) -> list[Effect]:
    """The links as the nuisances have them, as effects of a scene."""
    masses: dict[str, float] = {}
    shifts: dict[str, np.ndarray] = {}
    for name, b in zip(names, values, strict=True):
        kind, rest = name.split(" of ", 1)
        if kind == "sensor_delay":  # No part of the scene.
            continue
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
