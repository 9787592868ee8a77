"""Soft contacts that equations of motion take for a face that stands elsewhere.

Pressed on with nearly the same force all the time, a soft contact and a face that is a
little farther away are one thing in the equations: the tool is at the same place. What
follows a change of the force tells them apart, and simulated windows show that.
"""

from dataclasses import replace

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import GapProblem, Outcome, is_sane
from makebreak.gap.search.choice import Choice, Selection, fixed_parameters
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    SIMULATED_RIVAL_GAIN,
    SIMULATED_RIVAL_RATIO,
)
from makebreak.models.effects.kind import Effect

MOST_STD = 0.5  # Of a stiffness, as a share of it.


def softer_by_simulation(
    problem: GapProblem, selection: Selection, outcome: Outcome | None, jobs: int
) -> tuple[Selection, Outcome | None]:
    """The selection and what it comes to. Where windows show a gap with it, each pair
    that presses is given another stiffness, in place of where its body stands, then
    beside that; one with which windows leave clearly less is taken."""
    for effect, stands_for in problem.softer():
        for dropped in (stands_for, ()):
            if outcome is None or not outcome.gap.after > AGREEMENT_RMS_MAX:
                return selection, outcome
            other = _with_stiffness(problem, selection, effect, dropped)
            if other is None:
                continue
            found = problem.outcome(
                other.effects(), other.start, other.end, other.nuisances, jobs=jobs
            )
            limit = SIMULATED_RIVAL_GAIN * outcome.gap.after
            if found is not None and found.gap.after < limit:
                selection, outcome = other, found
    return selection, outcome


def _with_stiffness(
    problem: GapProblem, selection: Selection, effect: Effect, dropped: tuple[str, ...]
) -> Selection | None:
    """With a stiffness as the equations find it, and without the effects of some kinds
    on its fixed body. None: it is there already, no such effect is there to be dropped,
    it is not possible, or the equations leave clearly more."""
    body = effect.at[0].split("~")[0]
    kept = [
        c for c in selection.choices
        if not (c.effect.kind in dropped and c.effect.at[0] == body)
    ]  # fmt: skip
    is_there = any(
        (c.effect.kind, c.effect.at) == (effect.kind, effect.at) for c in kept
    )
    if is_there or (dropped and len(kept) == len(selection.choices)):
        return None
    try:
        fit = fit_effects(
            problem, selection.screen(problem), [*(c.effect for c in kept), effect],
            [*fixed_parameters(kept), ()],
        )  # fmt: skip
    except ValueError:
        return None
    worst = SIMULATED_RIVAL_RATIO * max(problem.error(selection.end), AGREEMENT_RMS_MAX)
    if not all(map(is_sane, fit.effects)) or problem.error(fit) > worst:
        return None
    ((name, value),) = fit.effects[-1].parameters.items()
    if not fit.std[-1][name] < MOST_STD * value:  # Beside a place that says the same.
        return None
    start, n = selection.start.score, len(fit.std[-1])
    new = Choice(effect, {}, start, fit.score, "", np.inf, (), (), n)
    choices = tuple(
        replace(c, effect=found, std=std)
        for c, found, std in zip([*kept, new], fit.effects, fit.std, strict=True)
    )
    return replace(selection, choices=choices, end=fit)
