"""Parameters that an effect gets once it is named, where they earn their place."""

from collections.abc import Sequence
from dataclasses import replace

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, is_sane
from makebreak.gap.search.choice import Choice, fixed_parameters, refreshed
from makebreak.gap.search.comparison import Comparison
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

_START = 0.2  # Of a parameter's range: at neutral it may have no slope.


def refine(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """The choices with parameters that refine their kinds. (A hand is at first a point
    mass; what its extent does would be looked for in a link's mass or a rotor.)"""
    chosen = list(chosen)
    for k, choice in enumerate(chosen):
        for each in KINDS[choice.effect.kind].parameters:
            if not each.refines or each.name in choice.effect.parameters:
                continue
            if not search.may_need_more(current):
                return chosen, current
            now = current.effects[k]
            value = each.low + _START * (each.high - each.low)
            more = Effect(now.kind, now.at, {**now.parameters, each.name: value})
            trial = [*current.effects[:k], more, *current.effects[k + 1 :]]
            screen = search.screen(current.r, current.fit.train)
            try:
                fit = fit_effects(
                    search.problem, screen, trial, fixed_parameters(chosen)
                )
            except ValueError:
                continue
            search.say(f"  {now.kind} with {each.name}: {fit.score:.3g}")
            before = screen.evaluate(current.r).score
            gained = search.error(fit.score) < search.enough(before)
            left = screen.fit_nuisances(current.r)[1]
            earned = search.earns_its_place(left, fit.left, gained)
            if not (
                is_sane(fit.effects[k]) and earned and search.is_needed(fit, current, 1)
            ):
                continue
            chosen[k] = replace(choice, size=choice.size + 1)
            chosen, current = refreshed(chosen, fit), fit
    return chosen, current
