"""A search that starts from all that joints may have, less what is not needed.

Where friction, a drive's gain and a rotor are off together, each alone explains so much
that the first ones to be added stand for the others. Fitted at once each takes its own.
"""

import numpy as np

from makebreak.gap.fit import fit_effects, size_of, tangents
from makebreak.gap.problem import Candidate, Fitted
from makebreak.gap.search.choice import Choice, refreshed
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.groups import with_pruned_groups
from makebreak.gap.search.screen import Ranked
from makebreak.models.effects.kind import Effect


def all_at_once(search: Comparison) -> tuple[list[Choice], Fitted]:
    """Effects at many joints and their fit, of those that a problem starts from; none
    where it starts from nothing, or what is left of them explains less.

    Which ones are needed is seen to first order about the fit of all.
    """
    problem, start = search.problem, search.start
    nothing: tuple[list[Choice], Fitted] = [], start
    every = problem.rich()
    if not every:
        return nothing
    screen = search.screen(start.r)
    steps = 2 * problem.plan.evaluations
    try:
        fit = fit_effects(problem, screen, every, evaluations=steps)
    except (ValueError, RuntimeError):
        return nothing
    slopes = tangents(problem, fit, [()] * len(every))
    if slopes.shape[1] != len(every):
        return nothing
    # To first order, what is left without any of them, and what each takes off it.
    off = np.array([_value(e) - _now(search, e) for e in fit.effects])
    columns = -slopes / [size_of(e, next(iter(e.parameters))) for e in fit.effects]
    r = fit.r + columns @ off
    members = tuple(
        Candidate(
            e.kind, tuple(e.at), 1, (column[:, None],), (_reader(search, e),),
            least=problem.dynamics.least(e.kind, e.at),
        )
        for e, column in zip(fit.effects, columns.T, strict=True)
    )  # fmt: skip
    at = tuple(at for m in members for at in m.at)
    group = Candidate("all", at, len(members), (columns,), (), members=members)
    wide = search.screen(r, fit.fit.train)
    ranked = Ranked(group, wide.fit(columns), fit.effects, True, 0)
    found = with_pruned_groups(search, wide, [ranked])
    if not found:
        return nothing
    kept = {m.at + (m.kind,) for m in found[0].candidate.members}
    some = [e for e in fit.effects if (*e.at, e.kind) in kept]
    try:
        fit = fit_effects(problem, screen, some, evaluations=steps)
    except (ValueError, RuntimeError):
        return nothing
    search.say(f"  {len(some)} of {len(every)} effects at once: {fit.score:.3g}")
    if not search.error(fit.score) < search.enough(start.score):
        return nothing
    before = start.score
    choices = [
        Choice(e, {}, before, fit.score, "", np.inf, (), (), 1, in_group=True)
        for e in fit.effects
    ]
    return refreshed(choices, fit), fit


def _value(effect: Effect) -> float:
    (value,) = effect.parameters.values()
    return value


def _now(search: Comparison, effect: Effect) -> float:
    (name,) = effect.parameters
    return search.problem.dynamics.now(effect.kind, effect.at)[name]


def _reader(search: Comparison, effect: Effect):
    (name,) = effect.parameters
    now = _now(search, effect)
    return lambda c: {name: now + float(c[0])}
