"""Two effects added at once, where neither of them alone shows the way."""

import itertools
from collections.abc import Sequence

import numpy as np

from makebreak.gap.numerics.selection import Screen
from makebreak.gap.search.choice import Choice, Trial, pair_of
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked
from makebreak.gap.search.trials import fit_each
from makebreak.gap.thresholds import (
    NESTED_GAIN,
    NOISE_RMS_MAX,
    PAIR_CANDIDATES,
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
        if a.candidate.is_sane(effects[:1], search.sizes) and b.candidate.is_sane(
            effects[1:], search.sizes
        ):
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
