"""Scenes with free bodies: what their contacts and flights say a scene lacks."""

from collections.abc import Callable, Sequence

import numpy as np

from makebreak.gap.contact import (
    contact_candidates,
    contact_nuisances,
)
from makebreak.gap.findings import Finding
from makebreak.gap.fit import Fitted
from makebreak.gap.free_windows import FreeBodyModel
from makebreak.gap.measure import gap_measure, series_of
from makebreak.gap.recording import Recording
from makebreak.gap.result import GapResult, Unexplained
from makebreak.gap.screen import Candidate
from makebreak.gap.select import FLOOR, Selection, select
from makebreak.gap.touch import TouchModel, touch_candidates
from makebreak.gap.verdict import named, says, told, verdict_of
from makebreak.gap.where import where_in_windows
from makebreak.gap.windows import WindowModel
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import one_dof_joints
from makebreak.models.scene import Scene
from makebreak.systems.numerics.selection import Screen

# A real object differs from its model in more ways than a mechanism.
MOST_EFFECTS = 6
# Windows of scenes that Drake has to simulate: length, and how many at most.
DRAKE_SEC, DRAKE_MOST = 0.3, 16


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
        model = WindowModel(
            scene, recordings, DRAKE_SEC, by_episode=many, most=DRAKE_MOST
        )
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
    gap = model.measure(before, after)
    every = selection
    selection, near = told(every, verdict, gap.reduction)
    if selection is not every:
        after, end = before, start
        gap = model.measure(before, after)
    effects_named = [named(c, model.dynamics.plant) for c in selection.choices]
    return GapResult(
        verdict, says(verdict, effects_named, start, end, near),
        model.where(before) if verdict != "no_gap" else [], effects_named,
        gap, [], moved(names, prior, selection), checks,
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
        model, nuisance, prior, found if clear.score > FLOOR else [], say, MOST_EFFECTS
    )
    seconds["select"] = lap()
    start, end = selection.start.score, selection.end.score
    verdict = verdict_of(selection.choices, start, end)
    before = model.simulate(())
    after = model.simulate([c.effect for c in selection.choices])
    gap = gap_measure(model, before, after)
    every = selection
    selection, near = told(every, verdict, gap.reduction)
    if selection is not every:
        after, end = before, start
        gap = gap_measure(model, before, after)
    where = where_in_windows(model, model.errors(before)) if verdict != "no_gap" else []
    rest = unexplained_in_windows(model, after) if verdict == "gap_unnamed" else []
    effects_named = [named(c, model.dynamics.plant) for c in selection.choices]
    seconds["simulate"] = lap()
    return GapResult(
        verdict, says(verdict, effects_named, start, end, near), where, effects_named,
        gap, rest, moved(names, prior, selection), checks,
        series_of(model, before, after), selection.table,
    )  # fmt: skip


def unexplained_in_windows(
    model: FreeBodyModel | WindowModel, simulated: Sequence[np.ndarray]
) -> list[Unexplained]:
    """Of each channel what is left, while what, and what its size goes with."""
    errors = model.errors(simulated)
    used = [k for k, e in enumerate(errors) if len(e)]
    names = model.channels
    features: dict[str, list[np.ndarray]] = {}
    for k in used:
        w = model.windows[k]
        recording = model.recordings[w.recording]
        time = recording.time[w.rows]
        features.setdefault("time since the window's start", []).append(time - w.start)
        for c in names:
            if c.rsplit(".", 1)[-1] in ("x", "y", "z", "position"):
                y = recording[c][w.rows]
                good = np.isfinite(y)
                if good.sum() < 2:
                    y, good = np.zeros(len(time)), np.ones(len(time), bool)
                y = np.interp(time, time[good], y[good])
                features.setdefault(f"the value of {c}", []).append(y)
                rate = np.gradient(y, time)
                features.setdefault(f"the rate of {c}", []).append(rate)
    E = np.concatenate([errors[k] for k in used])
    out = []
    for i, name in enumerate(names):
        size = float(np.sqrt(np.mean(E[:, i] ** 2)))
        if size < 2.0:
            continue
        shares = {
            what: share_explained(np.concatenate(x), E[:, i])
            for what, x in features.items()
        }
        best = max(shares, key=lambda what: shares[what])
        goes = "nothing that is measured"
        if shares[best] > 0.2:
            goes = f"{best} (it tells {shares[best]:.0%} of its variance)"
        worst = max(used, key=lambda k: float(np.mean(errors[k][:, i] ** 2)))
        w = model.windows[worst]
        region = f"most in episode {w.episode}, from {w.start:.3g} s"
        out.append(Unexplained(name, region, size, goes))
    return sorted(out, key=lambda each: -each.size)


def share_explained(x: np.ndarray, y: np.ndarray, bins: int = 12) -> float:
    """Share of the variance of y (n,) that its mean in bins of x (n,) tells, less what
    chance gives."""
    if np.std(x) == 0.0 or np.std(y) == 0.0 or len(y) <= bins:
        return 0.0
    edges = np.quantile(x, np.linspace(0, 1, bins + 1)[1:-1])
    group = np.searchsorted(edges, x)
    count = np.bincount(group, minlength=bins)
    mean = np.bincount(group, y, minlength=bins) / np.maximum(count, 1)
    within = float(np.sum((y - mean[group]) ** 2))
    return 1.0 - within / (len(y) - bins) / float(np.var(y, ddof=1))
