"""Two effects at one place that another kind explains better than both together."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from makebreak.gap.problem import Candidate, Fitted
from makebreak.gap.search.choice import (
    Choice,
    Trial,
    places,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import in_place_of
from makebreak.gap.search.screen import rank
from makebreak.gap.thresholds import SAME_ERROR
from makebreak.models.effects.kind import Effect


def merge(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """The choices, with pairs at one place replaced by a single effect that has no more
    parameters and does better.

    (A load is at first a heavier link, and then, beside it, a link whose centre of mass
    is elsewhere; their moments of inertia are not those of the load.) What groups have
    has earned its place beside all others there.
    """
    chosen = list(chosen)
    while search.needs_more(current):
        found = _best(search, chosen, current)
        if found is None:
            break
        i, j, trial = found
        of, old, other = trial.ranked.candidate, chosen[i].effect, chosen[j].effect
        new = replace(
            chosen[i], ties=(), fixed=of.fixed, size=of.size,
            runner_up=f"{old.kind} and {other.kind} at {', '.join(old.at)}", why="",
            margin=search.error(current.score) / search.error(trial.fit.score) - 1.0,
        )  # fmt: skip
        chosen = [*chosen[:i], new, *chosen[i + 1 : j], *chosen[j + 1 :]]
        current = trial.fit
        chosen = refreshed(chosen, current)
    return chosen, current


def _best(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> tuple[int, int, Trial] | None:
    """(i, j, fit) of the first replacement of effects i and j that does better."""
    pairs = [
        (i, j) for (i, a), (j, b) in combinations(enumerate(chosen), 2)
        if a.effect.at == b.effect.at and not (a.in_group and b.in_group)
    ]  # fmt: skip
    if not pairs:
        return None
    taken = places(chosen)
    free = [
        c for c in search.problem.candidates(search.nuisances, current)
        if (c.kind, c.at) not in taken
    ]  # fmt: skip
    slopes, of = search.slopes(chosen, current)
    for i, j in pairs:
        others = [c for k, c in enumerate(chosen) if k != j]
        without = replace(
            current, effects=tuple(e for k, e in enumerate(current.effects) if k != j)
        )
        candidate = _best_by_columns(
            search,
            [
                c for c in free
                if list(c.at) == list(chosen[i].effect.at)
                and c.size <= chosen[i].size + chosen[j].size
            ],
            search.without(current.effects, i, j),
            current, slopes[:, (of != i) & (of != j)],
        )  # fmt: skip
        if candidate is None:
            continue
        trial = in_place_of(search, candidate, i, others, without)
        if trial is not None and _does_better(search, trial.fit, current):
            return i, j, trial
    return None


def _best_by_columns(
    search: Comparison, free: Sequence[Candidate], rest: Sequence[Effect],
    current: Fitted, slopes: np.ndarray,
) -> Candidate | None:  # fmt: skip
    """The candidate that leaves least beside the rest, whose parameters are free, to
    first order; none where that is more than is left now. slopes (m, k): of the rest.
    """
    try:
        r = search.problem.residual(rest)
    except (ValueError, RuntimeError):
        return None
    screen = search.screen(r, current.fit.train, slopes=slopes)
    most = (1.0 + SAME_ERROR) * search.error(current.score)
    ranked = [
        x for x in rank(screen, free)
        if x.valid and (not slopes.shape[1] or search.error(x.fit.score) <= most)
    ]  # fmt: skip
    return ranked[0].candidate if ranked else None


def _does_better(search: Comparison, fit: Fitted, current: Fitted) -> bool:
    """Whether it leaves less, or as much and nothing else is missing then: nuisances
    need not be beyond their tolerance any more."""
    ours, theirs = search.error(fit.score), search.error(current.score)
    if ours < (1.0 - SAME_ERROR) * theirs:
        return True
    return ours <= (1.0 + SAME_ERROR) * theirs and not search.needs_more(fit)
