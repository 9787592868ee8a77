"""What was found, once more by simulated windows: what they keep, and what they prefer.

Equations of motion approximate some effects, and a law that is written down otherwise
makes them prefer another; simulation decides between the few that are left.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, GapProblem, Outcome, is_sane
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    fixed_parameters,
    units_of,
)
from makebreak.gap.search.select import without
from makebreak.gap.thresholds import (
    AGREEMENT_RMS_MAX,
    SIMULATED_RIVAL_GAIN,
    SIMULATED_RIVAL_RATIO,
    SIMULATED_RIVALS_MAX,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

MOST_STD = 0.5  # Of a stiffness, as a share of it.
# Another selection in the place of one; None: there is none.
Other = Callable[[Selection], Selection | None]


def chosen_by_simulation(
    problem: GapProblem, selection: Selection, jobs: int
) -> tuple[Selection, Outcome | None]:
    """The selection that simulated windows prefer, and what it comes to, on what was
    chosen on: each other one with which they leave so much less is taken in turn, where
    they show a gap, or where nothing but an effect less is asked."""

    def outcome_of(some: Selection) -> Outcome | None:
        return problem.outcome(
            some.effects(), some.start, some.end, some.nuisances, jobs=jobs
        )

    outcome = outcome_of(selection)
    for other_of, gain in _others(problem, selection):
        if outcome is None:
            break
        if gain < 1.0 and not outcome.gap.after > AGREEMENT_RMS_MAX:
            continue
        other = other_of(selection)
        found = outcome_of(other) if other is not None else None
        if (
            other is not None
            and found is not None
            and found.gap.after <= gain * outcome.gap.after
        ):
            selection, outcome = other, found
    return selection, outcome


def _others(problem: GapProblem, selection: Selection) -> Iterator[tuple[Other, float]]:
    """Other selections, and what share of the error they may leave at most."""
    for choice in selection.choices:
        if KINDS[choice.effect.kind].hidden_state:
            yield partial(_without, problem, choice), 1.0
    if problem.plan.simulation_agrees:
        for effect in _nearly_as_good(selection):
            yield partial(_instead, problem, effect), SIMULATED_RIVAL_GAIN
    for effect, stands_for in problem.softer():
        for dropped in (stands_for, ()):
            other = partial(_with_stiffness, problem, effect, dropped)
            yield other, SIMULATED_RIVAL_GAIN


def _without(
    problem: GapProblem, choice: Choice, selection: Selection
) -> Selection | None:
    """Without one of several effects that has a state of its own (a spring or a gap in
    a joint): equations only approximate it, and it imitates what else is fast."""
    if len(selection.choices) < 2:
        return None
    return without(problem, selection, choice.effect)


def _nearly_as_good(selection: Selection) -> list[Effect]:
    """Effects of one parameter that the first step of a search found nearly as good as
    the one that it chose, the best of each kind."""
    found: dict[str, Effect] = {}
    for each in selection.table:
        if each.score > SIMULATED_RIVAL_RATIO * selection.table[0].score:
            break
        if len(each.parameters) == len(each.at) == 1:
            effect = Effect(each.kind, list(each.at), dict(each.parameters))
            found.setdefault(each.kind, effect)
    chosen = {c.effect.kind for c in selection.choices}
    return [e for kind, e in found.items() if kind not in chosen][:SIMULATED_RIVALS_MAX]


def _instead(
    problem: GapProblem, effect: Effect, selection: Selection
) -> Selection | None:
    """Of contact, where a law that is written down otherwise (how friction sets in) may
    make equations prefer the wrong one of two effects: another one in the place of a
    single effect."""
    if len(selection.choices) != 1:
        return None
    (choice,) = selection.choices
    fit = _fit(problem, selection, [effect], [()])
    if fit is None:
        return None
    new = replace(
        choice, effect=fit.effects[0], std=fit.std[0], after=fit.score,
        runner_up=called(choice.effect), why="",
        margin=choice.after / fit.score - 1.0, ties=(), fixed=(), size=1,
    )  # fmt: skip
    return replace(selection, choices=(new,), end=fit)


def _with_stiffness(
    problem: GapProblem, effect: Effect, dropped: tuple[str, ...], selection: Selection
) -> Selection | None:
    """With a stiffness of a pair that presses, as the equations find it, and without
    the effects of some kinds on its fixed body. None: it is there already, no such
    effect is there to be dropped, it is not possible, or the equations leave clearly
    more.

    Pressed on with nearly the same force all the time, a soft contact and a face that
    is a little farther away are one thing in the equations: the tool is at the same
    place. What follows a change of the force tells them apart.
    """
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
    effects = [*(c.effect for c in kept), effect]
    fit = _fit(problem, selection, effects, [*fixed_parameters(kept), ()])
    worst = SIMULATED_RIVAL_RATIO * max(problem.error(selection.end), AGREEMENT_RMS_MAX)
    if fit is None or problem.error(fit) > worst:
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


def _fit(
    problem: GapProblem, selection: Selection, effects: list[Effect], fixed: list
) -> Fitted | None:
    """None where the scene cannot have them, or robots do not."""
    try:
        fit = fit_effects(problem, selection.screen(problem), effects, fixed)
    except ValueError:
        return None
    sizes = problem.sizes
    return fit if all(is_sane(e, sizes) for e in fit.effects) else None


def above_step(
    problem: GapProblem,
    selection: Selection,
    outcome: Outcome | None,
    step: Mapping[str, float],
    jobs: int,
) -> tuple[Selection, Outcome | None, list[tuple[Choice, str]], float]:
    """The selection without effects that move simulated windows, which agree without
    them, less than the scene's own time step does, all together, where they move them
    most: the world may have such a step, too, or none. What an effect moves is asked
    with all else as it was fitted: masses within their tolerance stand in for an
    encoder's zero, and a step does not. And what it comes to; those effects, and why;
    the held-out error with them.

    Args: step: {channel: what the scene's time step errs by, in expected errors}.
    """
    small: list[tuple[Choice, str]] = []
    below, first = problem.error(selection.end), outcome
    for unit in reversed(units_of(selection.choices)) if step else ():
        if first is None or not first.gap.is_measured:
            break
        gone = [choice.effect for choice in unit]
        names = {(e.kind, tuple(e.at)) for e in gone}  # Fits change the parameters.
        rest = [e for e in selection.effects() if (e.kind, tuple(e.at)) not in names]
        alone = problem.outcome(
            rest, selection.start, selection.end, selection.nuisances, jobs=jobs
        )
        if alone is None or not alone.gap.is_measured:
            break
        with_it, without_it = (
            {name: each["after"] for name, each in found.gap.per_channel.items()}
            for found in (first, alone)
        )
        moved = {
            name: abs(x**2 - with_it[name] ** 2) for name, x in without_it.items()
            if np.isfinite(x + with_it.get(name, np.nan))  # Some fail with effects.
        }  # fmt: skip
        most = max(moved, key=lambda name: moved[name], default="")
        by, errs = moved.get(most, np.inf) ** 0.5, step.get(most, 0.0)
        if by > errs:
            continue
        fewer = without(problem, selection, *gone)
        other = problem.outcome(
            fewer.effects(), fewer.start, fewer.end, fewer.nuisances, jobs=jobs
        )
        if other is None or not other.gap.is_measured:
            break
        if other.gap.after <= AGREEMENT_RMS_MAX:
            why = (
                "It moves simulated windows, with what else moves them as little, by "
                f"{by:.2g} times the expected error at {most}, no more than the "
                f"scene's time step errs by there ({errs:.2g})."
            )
            small += [(choice, why) for choice in unit]
            selection, outcome = fewer, other
    return selection, outcome, small, below if small else float("inf")
