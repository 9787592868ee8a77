"""Parameters that an effect gets once it is named, where they earn their place."""

from collections.abc import Sequence
from dataclasses import replace

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, is_sane
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    fixed_parameters,
    places,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import in_place_of
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, Parameter

_START = 0.2  # Of a parameter's range: at neutral it may have no slope.


def refine(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """The choices with parameters that refine their kinds. (A hand is at first a point
    mass; what its extent does would be looked for in a link's mass or a rotor.)"""
    chosen = list(chosen)
    for k, choice in enumerate(chosen):
        for each in _refining(choice.effect):
            if not search.may_need_more(current):
                return chosen, current
            fit = _with(search, chosen, current.effects, k, each, current, 1)
            if fit is not None:
                chosen[k] = replace(choice, size=choice.size + 1)
                chosen, current = refreshed(chosen, fit), fit
    return _in_their_place(search, chosen, current)


def _refining(effect: Effect) -> list[Parameter]:
    """Parameters that refine its kind, and that it does not have yet."""
    return [
        p for p in KINDS[effect.kind].parameters
        if p.refines and p.name not in effect.parameters
    ]  # fmt: skip


def _with(
    search: Comparison, chosen: Sequence[Choice], effects: Sequence[Effect], k: int,
    parameter: Parameter, current: Fitted, more: int,
) -> Fitted | None:  # fmt: skip
    """A fit that starts from `effects`, the k-th with a further parameter, if that one
    earns its place.

    Args: chosen: of the same kinds; more: how many parameters more than `current` has.
    """
    now = effects[k]
    value = parameter.low + _START * (parameter.high - parameter.low)
    wider = Effect(now.kind, now.at, {**now.parameters, parameter.name: value})
    trial = [*effects[:k], wider, *effects[k + 1 :]]
    screen = search.screen(current.r, current.fit.train)
    try:
        fit = fit_effects(search.problem, screen, trial, fixed_parameters(chosen))
    except ValueError:
        return None
    search.say(f"  {now.kind} with {parameter.name}: {fit.score:.3g}")
    before = screen.evaluate(current.r).score
    gained = search.error(fit.score) < search.enough(before)
    left = screen.fit_nuisances(current.r)[1]
    earned = search.earns_its_place(left, fit.left, gained)
    needed = search.is_needed(fit, current, more)
    sane = is_sane(fit.effects[k], search.sizes)
    return fit if sane and earned and needed else None


def _in_their_place(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """The choices, with another kind at the same place where that one is better with a
    parameter that refines it. (A heavier link, whose inertia grows with it, may do more
    than a point mass, and less than a hand.)"""
    for k, choice in enumerate(chosen):
        if not search.needs_more(current):
            break
        places_of = KINDS[choice.effect.kind].at
        if not any(
            kind.at == places_of and any(p.refines for p in kind.parameters)
            for kind in KINDS.values()
        ):
            continue
        taken = places(chosen)
        for candidate in search.problem.candidates(search.nuisances, current):
            if (
                list(candidate.at) != list(choice.effect.at)
                or (candidate.kind, candidate.at) in taken
                or not any(p.refines for p in KINDS[candidate.kind].parameters)
            ):
                continue
            trial = in_place_of(search, candidate, k, chosen, current)
            if trial is None:
                continue
            other = replace(
                choice, effect=trial.fit.effects[k], ties=(), fixed=candidate.fixed,
                size=candidate.size + 1, runner_up=called(choice.effect), why="",
            )  # fmt: skip
            others = [*chosen[:k], other, *chosen[k + 1 :]]
            for each in _refining(other.effect):
                fit = _with(
                    search, others, trial.fit.effects, k, each, current,
                    other.size - choice.size,
                )  # fmt: skip
                if fit is not None:
                    margin = search.error(current.score) / search.error(fit.score) - 1.0
                    others[k] = replace(other, margin=margin)
                    chosen, current = refreshed(others, fit), fit
                    break
    return chosen, current
