"""A value that several joints share, or one for each of them."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, is_sane
from makebreak.gap.search.choice import Choice, fixed_parameters, refreshed
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.thresholds import OWN_VALUES_MAX, OWN_VALUES_TRIED
from makebreak.models.effects.kind import Effect


def with_own_values(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """A joint gets a value of its own where that earns its place as an effect does; the
    joint that gains most first."""
    problem, chosen = search.problem, list(chosen)
    for _ in range(OWN_VALUES_MAX):
        screen = search.screen(current.r, current.fit.train)
        now, left = screen.evaluate(current.r), screen.fit_nuisances(current.r)[1]
        shared = np.stack(
            [problem.column(current.effects, i, name, current.r)
             for i, name in current.names], axis=1,
        )  # fmt: skip
        tried = []
        for k in range(len(chosen)):
            own = problem.own_values(current.effects, k, current.r)
            for joint, column in own.items():
                X = np.hstack([shared, column[:, None]])
                tried.append((screen.fit(X).score, k, joint, own))
        tried.sort(key=lambda t: t[0])
        for score, k, joint, own in tried[:OWN_VALUES_TRIED]:
            if not score < now.score:
                return chosen, current
            effect, choice = current.effects[k], chosen[k]
            parts = [
                Effect(effect.kind, [j for j in own if j != joint],
                       dict(effect.parameters)),
                Effect(effect.kind, [joint], dict(effect.parameters)),
            ]  # fmt: skip
            trial = [*current.effects[:k], *parts, *current.effects[k + 1 :]]
            split = [*chosen[:k], choice, choice, *chosen[k + 1 :]]
            try:
                fit = fit_effects(problem, screen, trial, fixed_parameters(split))
            except ValueError:
                continue
            search.say(f"  {effect.kind} at {joint} of its own: {fit.score:.3g}")
            gained = search.error(fit.score) < search.enough(now.score)
            if all(map(is_sane, fit.effects)) and search.earns_its_place(
                left, fit.left, gained
            ):
                chosen, current = refreshed(split, fit), fit
                break
        else:
            return chosen, current
    return chosen, current
