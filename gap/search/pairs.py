"""Two effects added at once, where neither of them alone shows the way."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.fit import tangents
from makebreak.gap.numerics.selection import Screen, simplest
from makebreak.gap.search.choice import (
    Choice,
    Trial,
    complexity,
    fixed_parameters,
    on_trial,
    pair_of,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.search.trials import fit_each
from makebreak.gap.thresholds import (
    LOOKAHEAD_FIRST,
    LOOKAHEAD_SECOND,
    NESTED_GAIN,
    NOISE_RMS_MAX,
    PAIR_CANDIDATES,
    SAME_ERROR,
)
from makebreak.models.effects import KINDS

_PAIRS_FITTED = 2  # Exactly, of those that are best by their columns.


def pair_instead(
    search: Comparison, wide: Screen, screen: Screen, chosen: Sequence[Choice],
    ranked: Sequence[Ranked], single: Trial,
) -> Trial | None:  # fmt: skip
    """Two other effects that leave clearly less than the best single one: what two do
    together another kind may imitate better than either of them does.

    A pair that contains the single one's kind is not returned: the search finds it step
    by step.

    Args: wide: with which candidates were ranked. screen: of exact fits. ranked: the
        best first.
    """
    fit, own = single.fit, single.ranked.candidate.kind
    if search.plan.jumps or search.problem.noise_error(fit.left) < NOISE_RMS_MAX:
        return None
    best: dict[str, Ranked] = {}
    for r in ranked:
        if not r.candidate.members:
            best.setdefault(r.candidate.kind, r)
    pairs = []
    for a, b in itertools.combinations(list(best.values())[:PAIR_CANDIDATES], 2):
        both = wide.fit(np.hstack([a.columns, b.columns]))
        k = a.columns.shape[1]
        effects = (
            *a.candidate.effects(a.alternative, both.c[:k]),
            *b.candidate.effects(b.alternative, both.c[k:]),
        )
        if a.candidate.is_sane(effects[:1]) and b.candidate.is_sane(effects[1:]):
            pairs.append((both.score, a, b, effects))
    pairs.sort(key=lambda p: p[0])
    less = (1.0 - NESTED_GAIN) * search.error(fit.score)
    for score, a, b, effects in pairs[:_PAIRS_FITTED]:
        kinds = (a.candidate.kind, b.candidate.kind)
        if any(kind == own or own in KINDS[kind].contains for kind in kinds):
            break
        if not search.error(score) < less:
            break
        for trial in fit_each(search, screen, chosen, [pair_of(a, b, effects)]):
            if search.error(trial.fit.score) < less:
                return trial
    return None


def look_ahead(
    search: Comparison, screen: Screen, chosen: Sequence[Choice],
    trials: Sequence[Trial], pick: int,
) -> Trial | None:  # fmt: skip
    """Two other effects that leave clearly less than the best single one (as little, if
    they have fewer parameters), and no more than that one with a second effect.

    (Two frictions that are wrong at once: a patch of friction, with its five
    parameters, does more than either, and by the columns of the scene as it came the
    second one does nothing.)
    """
    single, of = trials[pick]
    if of.candidate.members:
        return None
    if search.problem.noise_error(single.left) < NOISE_RMS_MAX:
        return None
    others = [
        k for k, t in enumerate(trials) if k != pick and not t.ranked.candidate.members
    ]
    others.sort(key=lambda k: trials[k].fit.score)
    pairs = [
        (k, pair)
        for k in (pick, *others[:LOOKAHEAD_FIRST])
        for pair in _with_a_second(search, screen, chosen, trials[k])
    ]
    if not pairs:
        return None
    errors = [search.error(pair.fit.score) for _, pair in pairs]
    # With as many parameters, two effects of one kind, which may have one cause.
    sizes = [
        2 * complexity(pair.ranked.candidate)
        - (len({e.kind for e in pair.ranked.effects}) == 1)
        for _, pair in pairs
    ]
    best = simplest(errors, sizes, SAME_ERROR)
    first, pair = pairs[best]
    if first == pick:
        return None  # The next step finds the second one.
    simpler = complexity(pair.ranked.candidate) < complexity(of.candidate)
    most = search.error(single.score) * (
        1.0 + SAME_ERROR if simpler else 1.0 - NESTED_GAIN
    )
    return pair if errors[best] < most else None


def _with_a_second(
    search: Comparison, screen: Screen, chosen: Sequence[Choice], first: Trial
) -> list[Trial]:
    """A first effect with each of the best second ones, fitted exactly; second ones by
    their columns in the scene with the first in it."""
    fit = first.fit
    there = refreshed([*chosen, on_trial(first.ranked, fit.effects[-1])], fit)
    found = search.problem.next_candidates(fit)
    if not found:
        return []
    slopes, _ = tangents(search.problem, fit, fixed_parameters(there))
    wide = search.screen(fit.r, fit.fit.train, slopes=slopes)
    # Each alternative by itself: the one that fits best may be wrong where rows are
    # held out, and the next one right.
    split = [
        replace(c, columns=(x,), to_parameters=(read,))
        for c in found
        for x, read in zip(c.columns, c.to_parameters, strict=True)
    ]
    best_of: dict[tuple, Ranked] = {}
    for r in rank(wide, split):
        if r.valid and search.error(r.fit.score) < search.error(fit.score):
            best_of.setdefault((r.candidate.kind, r.candidate.at), r)
    seconds = list(best_of.values())[:LOOKAHEAD_SECOND]
    return [
        Trial(both, pair_of(first.ranked, second, both.effects[-2:]))
        for both, second in fit_each(search, screen, there, seconds)
    ]
