"""A search that starts from all that joints may have, less what is not needed.

Where friction, a drive's gain and a rotor are off together, each alone explains so much
that the first ones to be added stand for the others. Fitted at once each takes its own.
"""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Fitted, rms
from makebreak.gap.search.choice import Choice, refreshed
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.thresholds import NOISE_RMS_MAX, SAME_ERROR
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect


def all_at_once(search: Comparison) -> tuple[list[Choice], Fitted]:
    """Effects at many joints and their fit, of those that a problem starts from; none
    where it starts from nothing.

    Kind by kind, those that come last in the catalogue first (a gain that a maker
    states is off less often than friction is), an effect goes from each joint that its
    held-out rows do without: they are worse than with all effects by no more than
    SAME_ERROR. Meanwhile what stands in the place of a nuisance has none beside; in the
    end what that nuisance may take is no effect.
    """
    problem = search.problem
    every = list(problem.rich())
    nothing: tuple[list[Choice], Fitted] = [], search.start
    fit = _fit(search, every) if every else None
    if fit is None:
        return nothing
    most = (1.0 + SAME_ERROR) * _errors(search, fit)
    for kind in reversed(list(dict.fromkeys(e.kind for e in every))):
        fit = _without(search, fit, kind, most)
        if KINDS[kind].contains:
            fit = _in_place_of_contained(search, fit, kind, most)
    some = [e for e in fit.effects if not problem.is_within_tolerance(e)]
    fit = _fit(search, some, alone=False) if some else None
    if fit is None:
        return nothing
    search.say(f"  {len(fit.effects)} of {len(every)} effects at once: {fit.score:.3g}")
    before = search.start.score
    choices = [
        Choice(e, {}, before, fit.score, "", np.inf, (), (), len(std), in_group=True)
        for e, std in zip(fit.effects, fit.std, strict=True)
    ]
    return refreshed(choices, fit), fit


def is_worse_somewhere(search: Comparison, one: Fitted, other: Fitted) -> bool:
    """Whether a channel's held-out rows are worse with the one than with the other."""
    least = (1.0 - SAME_ERROR) * _errors(search, one)
    return bool(np.any(_errors(search, other) < least))


def _without(search: Comparison, fit: Fitted, kind: str, most: np.ndarray) -> Fitted:
    """The fit less the effects of a kind at joints that do without; it stays as it is
    where no such fit is found. most (n_channels,): what held-out rows may leave."""
    kept: set[tuple[str, ...]] = set()
    while True:
        some = [e for e in fit.effects if e.kind != kind or tuple(e.at) in kept]
        if len(some) == len(fit.effects):
            return fit
        less = _fit(search, some)
        if less is None:
            return fit
        worse = _errors(search, less) > most
        if not worse.any():
            return less
        gone = [e for e in fit.effects if e.kind == kind and tuple(e.at) not in kept]
        needed = {
            tuple(e.at) for e in gone
            if any(
                search.problem.moved_by(e)[search.channel == c].any()
                for c in np.unique(search.channel)[worse]
            )
        }  # fmt: skip
        # Where a joint is worse by what another one lacks, all of them stay.
        kept |= needed or {tuple(e.at) for e in gone}


def _in_place_of_contained(
    search: Comparison, fit: Fitted, kind: str, most: np.ndarray
) -> Fitted:
    """Where effects of a kind stay, those that it contains go: it says both."""
    wide = {tuple(e.at): e for e in fit.effects if e.kind == kind}
    some = []
    for e in fit.effects:
        if e.kind in KINDS[kind].contains and tuple(e.at) in wide:
            ((_, value),) = e.parameters.items()
            of = wide[tuple(e.at)]
            sums = {
                p.name: of.parameters[p.name] + (0.0 if p.given else value)
                for p in KINDS[kind].parameters
            }
            wide[tuple(e.at)] = Effect(kind, of.at, sums)
        elif e.kind != kind:
            some.append(e)
    if len(some) + len(wide) == len(fit.effects):
        return fit
    less = _fit(search, [*some, *wide.values()])
    return fit if less is None or (_errors(search, less) > most).any() else less


def _fit(
    search: Comparison, effects: Sequence[Effect], alone: bool = True
) -> Fitted | None:
    """alone: without the nuisances that any of the rich model's effects replaces."""
    problem = search.problem
    screen = search.screen(search.start.r)
    replaced = problem.replaced(problem.rich()) if alone else None
    if replaced is not None:
        screen = screen.without(replaced)
    try:
        return fit_effects(
            problem, screen, effects, evaluations=problem.plan.evaluations
        )
    except (ValueError, RuntimeError):
        return None


def _errors(search: Comparison, fit: Fitted) -> np.ndarray:
    """(n_channels,) rms of held-out rows; what a right model may leave is none."""
    held = ~search.train
    each = [
        rms(fit.left[held & (search.channel == c)]) for c in np.unique(search.channel)
    ]
    return np.maximum(each, NOISE_RMS_MAX)
