"""Candidates fitted exactly: which ones are worth it, and which of them is taken."""

from collections.abc import Mapping, Sequence

import numpy as np

from makebreak.gap.fit import MOST_FREE, fit_effects, search_by_blocks
from makebreak.gap.numerics.selection import Screen, simplest
from makebreak.gap.problem import Candidate
from makebreak.gap.search.choice import (
    Choice,
    Trial,
    complexity,
    fixed_parameters,
    is_possible,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked
from makebreak.gap.thresholds import (
    EVIDENCE_MIN,
    FINALISTS,
    NESTED_GAIN,
    NOISE_RMS_MAX,
    SAME_ERROR,
    SAME_EVIDENCE,
    SINGLE_SHARE_OF_GROUP,
)
from makebreak.models.effects import KINDS

# By linear columns a candidate is near the best if it leaves at most so many times what
# the best leaves, or at most this share of the gap more.
_NEAR_RATIO, _NEAR_SHARE = 1.6, 0.15
_ALIKE = 1.02  # Places of one kind that differ by less are all tried, up to four.
_AT_MOST, _AT_MOST_ALIKE = 2, 4  # Places of one kind.
_SAME_BODY = 1.002  # Errors of bodies that one effect cannot tell apart.


def shortlist(
    ranked: Sequence[Ranked],
    base: float,
    most: int,
    inner_rivals: bool = False,
    rough: bool = False,
) -> list[Ranked]:
    """The candidates worth an exact fit: those near the best, at most two places of a
    kind and size (four that do alike); of each kind that the catalogue lists as
    confused with the best, its best place; and of each kind that a candidate on the
    list contains, the one at the same place.

    Args: ranked: the best first. base: the error without any. most: of those near the
        best. inner_rivals: whether also what is confused with a kind that the best
        contains. rough: whether errors say so little of exact fits that none of a few
        parameters is too far from the best.
    """
    if not ranked:
        return []
    best = ranked[0].fit.score
    short: list[Ranked] = []
    for each in ranked:
        like = [
            r for r in short
            if (r.candidate.kind, r.candidate.size, bool(r.candidate.members))
            == (each.candidate.kind, each.candidate.size, bool(each.candidate.members))
        ]  # fmt: skip
        few = rough and each.candidate.size <= MOST_FREE
        near = few or each.fit.score < max(
            _NEAR_RATIO * best, best + _NEAR_SHARE * (base - best)
        )
        alike = like and each.fit.score <= _ALIKE * like[0].fit.score
        room = len(like) < (_AT_MOST_ALIKE if alike else _AT_MOST)
        if near and room and len(short) < most:
            short.append(each)
    there = {r.candidate.kind for r in short}
    first = ranked[0].candidate.kind
    best_kinds = (first, *KINDS[first].contains) if inner_rivals else (first,)
    for each in ranked:
        kind = each.candidate.kind
        confused = any(
            kind in KINDS[k].confused_with or k in KINDS[kind].confused_with
            for k in best_kinds
        )
        if confused and kind not in there:
            short.append(each)
            there.add(kind)
    # These may rank far below others.
    known = {id(r) for r in short}
    for each in [*short]:
        for r in ranked:
            inside = r.candidate.kind in KINDS[each.candidate.kind].contains
            if inside and r.candidate.at == each.candidate.at and id(r) not in known:
                short.append(r)
                known.add(id(r))
    return short


def fit_each(
    search: Comparison, screen: Screen, chosen: Sequence[Choice],
    short: Sequence[Ranked], known: Sequence[Trial] = (),
) -> list[Trial]:  # fmt: skip
    """Each candidate beside what is chosen, all fitted exactly, those with the fewest
    parameters first; those that are possible. Where simulations are all that there is,
    not those of many once one of few leaves what noise does, or clearly less than they.

    Args: known: fits of the same candidates, from where to go on.
    """
    found: dict[int, Trial] = {}
    for k in sorted(range(len(short)), key=lambda k: short[k].candidate.size):
        each = short[k]
        least = min((t.fit.score for t in found.values()), default=np.inf)
        many = search.plan.jumps and each.candidate.size > MOST_FREE
        if many and least < max(NOISE_RMS_MAX, each.fit.score / _NEAR_RATIO):
            continue
        start = [*[c.effect for c in chosen], *each.effects]
        if known:
            start = list(known[k].fit.effects)
        fixed = [*fixed_parameters(chosen), *each.fixed()]
        try:
            fit = fit_effects(search.problem, screen, start, fixed)
        except ValueError:
            continue
        search.say(f"  {each.candidate.name}: {fit.score:.3g}")
        if is_possible(fit, each, len(chosen), search.sizes):
            found[k] = Trial(fit, each)
    trials = [found[k] for k in sorted(found)]
    if not known and search.plan.jumps:
        _search_finalists(search, screen, chosen, trials)
    return trials


def _search_finalists(
    search: Comparison, screen: Screen, chosen: Sequence[Choice], trials: list[Trial]
) -> None:
    """The best few once more, by blocks of time: else one whose fit got stuck loses."""
    best = sorted(range(len(trials)), key=lambda k: trials[k].fit.score)[:FINALISTS]
    if not best:
        return
    found = not trials[best[0]].fit.score > NOISE_RMS_MAX
    if found and search.needs_more(search.start):
        return
    for k in best:
        fit, each = trials[k]
        fixed = [*fixed_parameters(chosen), *each.fixed()]
        try:
            effects = search_by_blocks(search.problem, screen, fit.effects, fixed)
            if effects is None:
                continue
            better = fit_effects(search.problem, screen, effects, fixed)
        except ValueError:
            continue
        if better.fit.train < fit.fit.train and is_possible(
            better, each, len(chosen), search.sizes
        ):
            trials[k] = Trial(better, each)
            search.say(f"  {each.candidate.name}: {better.score:.3g}")


def without_doubles(search: Comparison, trials: Sequence[Trial]) -> list[Trial]:
    """One of each kind, place and size (a patch that was found twice is no rival of
    itself): of those that do as well as the best the one that changes least."""
    of: dict[tuple, list[Trial]] = {}
    for trial in trials:
        c = trial.ranked.candidate
        of.setdefault((c.kind, tuple(c.at), c.size), []).append(trial)
    out = []
    for same in of.values():
        best = min(search.error(t.fit.score) for t in same)
        near = [
            t for t in same if search.error(t.fit.score) <= (1.0 + SAME_ERROR) * best
        ]
        out.append(
            min(
                near,
                key=lambda t: (
                    search.problem.change(t.fit.effects[-1]),
                    t.fit.score,
                ),
            )
        )
    return out


def pick_simplest(
    search: Comparison, trials: Sequence[Trial], found: Sequence[Candidate], base: float
) -> int:
    """Index of the simplest of those that do as well as the best: by evidence where
    that counts, else by the error. Then with four exceptions: a single effect that does
    nearly all that a group does, another effect for which there is clearly more
    evidence, the outermost of bodies that are alike, and a kind inside the chosen one
    that does nearly as well.

    Args: found: all candidates, from the base outwards. base: the error without any.
    """
    if search.plan.counts_evidence:
        return _of_most_evidence(search, trials)
    errors = [search.error(t.fit.score) for t in trials]
    pick = simplest(
        errors, [complexity(t.ranked.candidate) for t in trials], SAME_ERROR
    )
    fit, best = trials[pick]
    # What a single effect leaves of the group's part is looked for next.
    most = base - SINGLE_SHARE_OF_GROUP * (base - fit.score)
    alone = [
        k for k, (f, r) in enumerate(trials)
        if not r.candidate.members
        and r.candidate.size <= best.candidate.size
        and f.score <= most
    ]  # fmt: skip
    if best.candidate.members and alone and not search.plan.alike:
        pick = min(alone, key=lambda k: errors[k])
        fit, best = trials[pick]
    pick = _clearly_better(search, trials, pick)
    fit, best = trials[pick]
    # Loads and forces mostly act on the outermost; the others are reported as ties.
    order = {id(c): k for k, c in enumerate(found)}
    for k, (other, r) in enumerate(trials):
        one, two = r.candidate, best.candidate
        same = (one.kind, one.size) == (two.kind, two.size) and not one.members
        if same and search.error(other.score) <= _SAME_BODY * search.error(fit.score):
            if order.get(id(one), -1) > order.get(id(two), -1):
                pick, fit, best = k, other, r
    for k, (inner, r) in enumerate(trials):
        inside = r.candidate.kind in KINDS[best.candidate.kind].contains
        near = search.error(inner.score) <= (1.0 + NESTED_GAIN) * search.error(
            fit.score
        )
        if inside and near and r.candidate.at == best.candidate.at:
            return k
    return pick


def _of_most_evidence(search: Comparison, trials: Sequence[Trial]) -> int:
    """The simplest of those for which there is as much evidence as for any. (Where
    contacts chatter the few rows that are held out say less than all.)"""
    first = trials[0]
    evidence = [
        search.evidence(
            t.fit, first.fit, t.ranked.candidate.size - first.ranked.candidate.size
        )
        for t in trials
    ]
    return _simplest_near(trials, dict(enumerate(evidence)), -np.inf)


def _clearly_better(search: Comparison, trials: Sequence[Trial], pick: int) -> int:
    """The one that is picked, or another single effect, without it as a special case,
    for which there is more evidence by EVIDENCE_MIN, and which explains held-out rows
    no worse; of several such the simplest of those that do as well as the best.

    Near the noise two errors within SAME_ERROR of each other may differ by many
    standard deviations; and the simplest may need nuisances at their limits.
    """
    if search.problem.weighed_by(()) is not None:
        return pick  # The weights depend on the model: errors say nothing so fine.
    fit, best = trials[pick]
    if best.candidate.members:
        return pick
    evidence = {
        k: search.evidence(t.fit, fit, t.ranked.candidate.size - best.candidate.size)
        for k, t in enumerate(trials)
        if not t.ranked.candidate.members
        and best.candidate.kind not in KINDS[t.ranked.candidate.kind].contains
        and t.fit.fit.held_out <= fit.fit.held_out
    }
    most = max(evidence.values(), default=0.0)
    if not most > EVIDENCE_MIN:
        return pick
    return _simplest_near(trials, evidence, 0.0)


def _simplest_near(
    trials: Sequence[Trial], evidence: Mapping[int, float], least: float
) -> int:
    """Of those with as much evidence as any, and more than `least`."""
    enough = max(max(evidence.values()) - SAME_EVIDENCE, least)
    near = [k for k, e in evidence.items() if e > enough]
    return min(
        near, key=lambda k: (complexity(trials[k].ranked.candidate), -evidence[k])
    )
