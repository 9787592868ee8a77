"""Candidates ranked by what simulations with them leave, where columns tell little."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.numerics.agreed_step import agreed_step
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Fitted
from makebreak.gap.search.choice import Choice
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked
from makebreak.gap.thresholds import EVIDENCE_MIN

FARTHER = 2.0  # Of a step that did well, the next one that is tried.
MOST_SIMULATED = 40  # Candidates: of those that may do something the most promising.


def ranked_by_simulation(
    search: Comparison, screen: Screen, ranked: Sequence[Ranked],
    chosen: Sequence[Choice], current: Fitted,
) -> list[tuple[float, Ranked]]:  # fmt: skip
    """(evidence, candidate), the best first: those that may do something simulated, at
    the best of a few sizes that columns suggest; the others by their columns."""
    train, block = search.train, search.problem.blocks()
    _, r = screen.fit_nuisances(current.r)
    agreed = [agreed_step(e.columns[train], r[train], block[train]) for e in ranked]
    gained = np.array([gain for _, gain in agreed])
    least = max(
        EVIDENCE_MIN * max(current.fit.held_out, 1.0) ** 2,
        float(np.sort(gained)[-MOST_SIMULATED:][0]),
    )
    found = []
    for each, (c, gain) in zip(ranked, agreed, strict=True):
        tried = [(search.evidence_of(screen, each.columns), each)]
        if gain >= least:
            tried = [
                _as_far_as_it_helps(search, screen, each, x, chosen, current)
                for x in (c, each.fit.c)
            ]
        found.append(max(tried, key=lambda pair: pair[0]))
    return sorted(found, key=lambda pair: -pair[0])


def _as_far_as_it_helps(
    search: Comparison, screen: Screen, each: Ranked, c: np.ndarray,
    chosen: Sequence[Choice], current: Fitted,
) -> tuple[float, Ranked]:  # fmt: skip
    """(evidence, candidate) with coefficients c (k,), and ever larger ones while these
    do better."""
    most, best = -np.inf, each
    while True:
        go_on()
        effects = each.candidate.effects(each.alternative, c)
        if not (
            each.candidate.members or each.candidate.is_sane(effects, search.sizes)
        ):
            break
        try:
            r = search.problem.residual([*(e.effect for e in chosen), *effects])
        except (ValueError, RuntimeError):  # The scene cannot have it.
            break
        fit, (b, left) = screen.evaluate(r), screen.fit_nuisances(r)
        evidence = search.evidence_against(b, left, fit, current, each.candidate.size)
        if not evidence > most:
            break
        fit = replace(each.fit, score=fit.score, held_out=fit.held_out, train=fit.train)
        most, best = evidence, replace(each, effects=tuple(effects), fit=fit)
        c = FARTHER * c
    return most, best
