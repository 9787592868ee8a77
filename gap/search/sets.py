"""Ties of two effects: two others, or one, that explain as much in the place of both.

Each of two named effects may have no rival beside the other and both together have one:
a motor that gives half and half of a mass do what a friction of twice the size does.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from makebreak.gap.fit import fit_effects, tangents
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Fitted
from makebreak.gap.result import RivalSet
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    fixed_parameters,
    identifiable,
    places,
    uses_all_parameters,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.thresholds import (
    RIVAL_ERROR_RATIO,
    SAME_ERROR,
    SET_CANDIDATES,
    SET_OPEN_SHARE,
    SETS_OF_MOST,
    SETS_TRIED,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect


def with_rival_sets(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> list[Choice]:
    """The choices; to the first of two that others could replace together these are
    added. By columns first, then the nearest few exactly, by the rules for a single
    rival. Members of a group are left out: there are too many pairs of them."""
    alone = [k for k, c in enumerate(chosen) if not c.in_group]
    if search.plan.jumps or not 2 <= len(alone) <= SETS_OF_MOST:
        return list(chosen)
    problem, taken = search.problem, places(chosen)
    found = problem.next_candidates(current) or problem.candidates(
        search.nuisances, current
    )
    free = [c for c in found if not c.members and (c.kind, c.at) not in taken]
    out = list(chosen)
    for i, j in combinations(alone, 2):
        sets = [
            RivalSet((chosen[j].effect,), instead)
            for candidates in _near_by_columns(search, free, chosen, current, i, j)
            if (instead := _does_as_well(search, candidates, chosen, current, i, j))
        ]
        out[i] = replace(out[i], sets=(*out[i].sets, *sets))
    return out


def _near_by_columns(
    search: Comparison, free: Sequence[Candidate], chosen: Sequence[Choice],
    current: Fitted, i: int, j: int,
) -> list[tuple[Ranked, ...]]:  # fmt: skip
    """Candidates, one or two, that may explain as much in the place of effects i and
    j, to first order, the best first."""
    rest = search.without(current.effects, i, j)
    # By the weights of what is named: those of columns.
    alike = search.problem.weighed_by(current.effects)
    problem = search.problem if alike is None else alike
    fixed = [c.fixed for k, c in enumerate(chosen) if k not in (i, j)]
    try:
        r = problem.residual(rest)
        slopes = np.zeros((len(r), 0))
        if rest:
            partly = fit_effects(problem, search.screen(r), rest, fixed, evaluations=1)
            slopes, _ = tangents(problem, partly, fixed)
    except (ValueError, RuntimeError):
        return []
    screen = search.screen(r, current.fit.train, slopes=slopes)
    named = search.error(screen.evaluate(problem.residual(current.effects)).score)
    without = search.error(screen.evaluate(r).score)
    most = max(RIVAL_ERROR_RATIO * named, named + SET_OPEN_SHARE * (without - named))
    size = chosen[i].size + chosen[j].size
    ranked = [
        x for x in rank(screen, free)
        if x.candidate.size <= size and not _is_of(x.candidate, chosen[i], chosen[j])
    ][:SET_CANDIDATES]  # fmt: skip
    ties = [_kinds_tied(chosen[k]) for k in (i, j)]
    tried: list[tuple[float, tuple[Ranked, ...]]] = [
        (x.fit.score, (x,)) for x in ranked if x.valid
    ]
    for a, b in combinations(ranked, 2):
        if a.candidate.size + b.candidate.size > size or _are_ties(a, b, ties):
            continue
        tried.append((_score_of(screen, a, b), (a, b)))
    near = [each for each in tried if search.error(each[0]) <= most]
    return [each for _, each in sorted(near, key=lambda x: x[0])[:SETS_TRIED]]


def _score_of(screen: Screen, a: Ranked, b: Ranked) -> float:
    both = screen.fit(np.hstack([a.columns, b.columns]))
    k = a.columns.shape[1]
    sane = a.candidate.is_sane(a.candidate.effects(a.alternative, both.c[:k]))
    sane &= b.candidate.is_sane(b.candidate.effects(b.alternative, both.c[k:]))
    return both.score if sane else np.inf


def _is_of(candidate: Candidate, *choices: Choice) -> bool:
    """Whether a candidate has one of the effects as a special case, or is one."""
    return any(
        c.effect.kind in (candidate.kind, *KINDS[candidate.kind].contains)
        and set(c.effect.at) & set(candidate.at)
        for c in choices
    )


def _kinds_tied(choice: Choice) -> set[tuple[str, tuple[str, ...]]]:
    return {(t.kind, tuple(t.at)) for t in choice.ties}


def _are_ties(a: Ranked, b: Ranked, ties: Sequence[set]) -> bool:
    """Whether each of two is a tie of one of the effects by itself: that is told."""
    one, two = ((x.candidate.kind, x.candidate.at) for x in (a, b))
    first, second = ties
    return (one in first and two in second) or (two in first and one in second)


def _does_as_well(
    search: Comparison, instead: Sequence[Ranked], chosen: Sequence[Choice],
    current: Fitted, i: int, j: int,
) -> tuple[Effect, ...]:  # fmt: skip
    """The effects in the place of i and j, fitted exactly, if they explain as much;
    none if they do not."""
    rest = search.without(current.effects, i, j)
    fixed = [f for k, f in enumerate(fixed_parameters(chosen)) if k not in (i, j)]
    fixed += [f for r in instead for f in r.fixed()]
    try:
        screen = search.screen(search.problem.residual(rest), current.fit.train)
        start = [*rest, *(e for r in instead for e in r.effects)]
        fit = fit_effects(search.problem, screen, start, fixed)
    except (ValueError, RuntimeError):
        return ()
    n = len(instead)
    names = " and ".join(called(e) for e in fit.effects[-n:])
    search.say(f"  {names}, as a tie of two: {fit.score:.3g}")
    sane = all(
        r.candidate.is_sane(fit.effects[len(rest) + k : len(rest) + k + 1])
        and uses_all_parameters(fit, len(rest) + k)
        for k, r in enumerate(instead)
    )
    if not sane:
        return ()
    near = search.error(fit.score) <= (1.0 + SAME_ERROR) * search.error(current.score)
    alike = search.is_alike(fit, current)
    alike |= max(fit.score, current.score) < search.plan.least_error
    more = sum(identifiable(current, k) for k in (i, j))
    more -= sum(identifiable(fit, len(rest) + k) for k in range(n))
    if not near or not alike or search.is_louder(fit, current):
        return ()
    return () if search.is_worse(fit, current, more) else fit.effects[-n:]
