"""Scenes with free bodies: what their contacts and flights say a scene lacks."""

from collections.abc import Callable, Sequence

from makebreak.gap.contact import (
    contact_candidates,
    contact_nuisances,
)
from makebreak.gap.findings import Finding
from makebreak.gap.fit import Fitted
from makebreak.gap.free_windows import FreeBodyModel
from makebreak.gap.measure import gap_measure, series_of
from makebreak.gap.recording import Recording
from makebreak.gap.result import GapResult
from makebreak.gap.screen import Candidate
from makebreak.gap.select import FLOOR, Selection, select
from makebreak.gap.touch import TouchModel, touch_candidates
from makebreak.gap.verdict import named, says, verdict_of
from makebreak.gap.where import where_in_windows
from makebreak.gap.windows import WindowModel
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import one_dof_joints
from makebreak.models.scene import Scene
from makebreak.systems.numerics.selection import Screen

DRAKE_SEC = 0.3  # Windows of scenes that Drake has to simulate.


def of_objects(
    scene: Scene,
    recordings: Sequence[Recording],
    checks: Sequence[Finding],
    seconds: dict[str, float],
    lap: Callable[[], float],
    say: Callable[[str], None],
    settle: Callable[[Scene], tuple[Scene, list[Finding]]],
) -> GapResult:
    """The result for a scene in which something is free to move.

    Args: seconds, lap: into which the time of each step is written, and its clock.
        settle: gives a scene a step that is fine enough, where Drake simulates.
    """
    dynamics = SceneDynamics(scene)
    if any(joint.num_velocities() for joint in one_dof_joints(dynamics.plant)):
        try:  # A measured mechanism, and a wrench that tells when it touches.
            touch = TouchModel(scene, recordings)
        except ValueError:
            touch = None
        if touch is not None:
            return _of_touch(touch, checks, seconds, lap, say)
    say("cutting windows")
    try:
        model: FreeBodyModel | WindowModel = FreeBodyModel(scene, recordings)
    except ValueError:  # More than one free body, or other shapes: by Drake's steps.
        scene, finding = settle(scene)
        checks = [*checks, *finding]
        many = sum(len(r.episodes) for r in recordings) >= 6
        model = WindowModel(scene, recordings, DRAKE_SEC, by_episode=many, most=60)
    return _of_windows(model, checks, seconds, lap, say)


def moved(names, prior, selection: Selection) -> dict[str, float]:
    """What each nuisance is moved by, in units of its tolerance."""
    b = selection.end.b
    return {n: float(x / p) for n, x, p in zip(names, b, prior, strict=True)}


def _of_touch(model: TouchModel, checks, seconds, lap, say) -> GapResult:
    say("measuring how tool and object touch")
    nuisance, prior, names = model.nuisances()
    clear = Screen(model.base(), nuisance, prior, model.train()).fit()
    found = touch_candidates(model, nuisance) if clear.score > FLOOR else []
    seconds["screen"] = lap()
    selection = select(model, nuisance, prior, found, say)
    seconds["select"] = lap()
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(selection.choices, start, end)
    before, after = selection.start.left, selection.end.left
    effects_named = [named(c) for c in selection.choices]
    return GapResult(
        verdict, says(verdict, effects_named, start, end),
        model.where(before) if verdict != "no_gap" else [], effects_named,
        model.measure(before, after), [], moved(names, prior, selection), checks,
        model.series(before, after), selection.table,
    )  # fmt: skip


def _of_windows(model, checks, seconds, lap, say) -> GapResult:
    nuisance, prior, names = contact_nuisances(model)
    say("screening the catalogue by simulation")

    def found(current: Fitted) -> list[Candidate]:
        return contact_candidates(model, nuisance, current.effects, current.r)

    clear = Screen(model.base(), nuisance, prior, model.train()).fit()
    seconds["screen"] = lap()
    selection = select(
        model, nuisance, prior, found if clear.score > FLOOR else [], say
    )
    seconds["select"] = lap()
    effects = [c.effect for c in selection.choices]
    before, after = model.simulate(()), model.simulate(effects)
    gap = gap_measure(model, before, after)
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(selection.choices, start, end)
    where = where_in_windows(model, model.errors(before)) if verdict != "no_gap" else []
    effects_named = [named(c) for c in selection.choices]
    seconds["simulate"] = lap()
    return GapResult(
        verdict, says(verdict, effects_named, start, end), where, effects_named,
        gap, [], moved(names, prior, selection), checks,
        series_of(model, before, after), selection.table,
    )  # fmt: skip
