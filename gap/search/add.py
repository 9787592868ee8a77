"""One step of the search: the effect, group or pair that is added next."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Fitted
from makebreak.gap.result import Considered
from makebreak.gap.search.by_simulation import ranked_by_simulation
from makebreak.gap.search.choice import (
    Choice,
    Trial,
    places,
    why_not,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.groups import (
    groups_of,
    of_more_kinds,
    with_pruned_groups,
)
from makebreak.gap.search.pairs import pair_instead
from makebreak.gap.search.rivals import Rivals
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.search.trials import (
    fit_each,
    pick_simplest,
    shortlist,
    without_doubles,
)
from makebreak.gap.thresholds import EVIDENCE_MIN
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

_ROUNDS = 2  # Of fitting and weighing nuisances by what is left.
_SCALE_STEP = 1.2  # What is left, changed by less than this factor, is the same.
_SCALE_DROP = 0.8  # Of exact fits, which leave less than columns do.
_CLEAR_GAIN = 0.95  # Where channels do not count alone, the best must leave less.
_TABLE_ROWS = 15


@dataclass(frozen=True, eq=False)
class Step:
    """What was added, with the exact fit of all effects; None: nothing earns its place.
    table: the candidates, the best first."""

    added: tuple[Choice, ...]
    fitted: Fitted | None
    table: tuple[Considered, ...]


def add_next(
    search: Comparison,
    rivals: Rivals,
    found: Sequence[Candidate],
    chosen: Sequence[Choice],
    current: Fitted,
) -> Step:
    """Ranks the candidates, fits the best exactly, and takes the simplest that does as
    well as the best, if it earns its place.

    Args: found: all candidates. current: the fit of all that is chosen.
    """
    taken = places(chosen)
    free = [c for c in found if (c.kind, c.at) not in taken or KINDS[c.kind].several]
    free += groups_of(free)
    wide, scale, ranked = _ranked(search, free, chosen, current)
    if not ranked:
        return Step((), None, ())
    screen = search.screen(current.r, scale)
    base = screen.evaluate(current.r)
    ranked = with_pruned_groups(search, wide, ranked)
    by_evidence = search.plan.counts_evidence
    if by_evidence and ranked:
        found_by = ranked_by_simulation(search, wide, ranked, chosen, current)
        ranked = [r for evidence, r in found_by if evidence > EVIDENCE_MIN]
    table = tuple(
        Considered(
            r.candidate.kind, tuple(r.candidate.at),
            r.fit.score / max(base.score, 1e-12), dict(r.effects[0].parameters),
        )
        for r in ranked[:_TABLE_ROWS]
    )  # fmt: skip
    none = Step((), None, table)
    by_model = search.problem.weighed_by([c.effect for c in chosen]) is not None
    short = shortlist(ranked, base.score, search.plan.shortlist, by_model, by_evidence)
    if not short:
        return none
    by_score = not (search.plan.by_channel or by_evidence)
    if by_score and ranked[0].fit.score > _CLEAR_GAIN * base.score:
        return none
    screen, trials = _fitted_exactly(search, scale, chosen, current, short)
    if not trials:
        return none
    base = screen.evaluate(current.r)
    trials = without_doubles(search, trials)
    first = pick_simplest(search, trials, found, base.score)
    pick = rivals.needed(trials, first, chosen)
    # Where two effects nearly cancel a third may be needed beside each of them alone.
    both = rivals.both_needed(trials, (first, pick), chosen)
    screens = wide, screen
    more = _wider(search, screens, chosen, free, trials[pick])
    if more is None:
        more = _pair(search, both, screens, chosen, ranked, trials, pick)
    if more is not None:
        trials.append(more)
        pick = len(trials) - 1
    before = screen.fit_nuisances(current.r)[1]
    strained = search.is_strained(current)
    worth = [
        search.earns_its_place(
            before, t.fit.left,
            search.error(t.fit.score) < search.enough(base.score),
        )
        or (strained and _relieves(search, t, current))
        or (by_evidence and _is_evident(search, t, current))
        for t in trials
    ]  # fmt: skip
    if not worth[pick]:
        # The simplest of those that do as well on the whole may do it by a little
        # everywhere, and another one at the joint that it acts on.
        earning = [t for t, earns in zip(trials, worth, strict=True) if earns]
        if not earning:
            return none
        instead = earning[pick_simplest(search, earning, found, base.score)]
        pick = next(k for k, t in enumerate(trials) if t is instead)
    added = _choices(rivals, trials, pick, chosen, base.score, before)
    return Step(added, trials[pick].fit, table)


def _relieves(search: Comparison, trial: Trial, current: Fitted) -> bool:
    """Whether nuisances that were where they should not be need not be there any more,
    and the data say the same. (A gap is there then, however little is left.)"""
    return _is_evident(search, trial, current) and not search.is_strained(trial.fit)


def _is_evident(search: Comparison, trial: Trial, current: Fitted) -> bool:
    more = trial.ranked.candidate.size
    return search.evidence(trial.fit, current, more) > EVIDENCE_MIN


def _ranked(
    search: Comparison, free: Sequence[Candidate], chosen: Sequence[Choice],
    current: Fitted,
) -> tuple[Screen, float, list[Ranked]]:  # fmt: skip
    """Candidates by their columns, the best first, while the parameters of all that is
    chosen are free to adjust, to first order; with the screen that ranked them, and the
    rms that the best leaves, against which nuisances are weighed."""
    slopes, _ = search.slopes(chosen, current)
    wide = search.screen(current.r, slopes=slopes)
    ranked = [r for r in rank(wide, free, search.sizes) if r.valid]
    scale = 1.0
    for _ in range(_ROUNDS if ranked else 0):
        best = max(ranked[0].fit.train, 1.0)
        if best < _SCALE_STEP * scale and scale < _SCALE_STEP * best:
            break
        scale = best
        wide = search.screen(current.r, scale, slopes=slopes)
        ranked = [r for r in rank(wide, free, search.sizes) if r.valid]
    return wide, scale, ranked


def _fitted_exactly(
    search: Comparison, scale: float, chosen: Sequence[Choice], current: Fitted,
    short: Sequence[Ranked],
) -> tuple[Screen, list[Trial]]:  # fmt: skip
    """The short list, fitted exactly; again where less is left than by columns, so that
    nuisances are weighed against that."""
    screen = search.screen(current.r, scale)
    trials = fit_each(search, screen, chosen, short)
    for _ in range(_ROUNDS if len(search.nuisances.prior) else 0):
        least = min((t.fit.fit.train for t in trials), default=scale)
        if not max(least, 1.0) < _SCALE_DROP * scale:
            break
        scale = max(least, 1.0)
        screen = search.screen(current.r, scale)
        trials = fit_each(search, screen, chosen, [t.ranked for t in trials], trials)
    return screen, trials


def _pair(
    search: Comparison, both: Ranked | None, screens: tuple[Screen, Screen],
    chosen: Sequence[Choice], ranked: Sequence[Ranked], trials: Sequence[Trial],
    pick: int,
) -> Trial | None:  # fmt: skip
    """Two effects in the place of the one that is picked: two rivals that are `both`
    needed, else two others that leave clearly less."""
    wide, screen = screens
    if both is not None:
        least = min(t.fit.score for t in trials)
        for trial in fit_each(search, screen, chosen, [both]):
            if trial.fit.score < least:  # Else one alone does as well as the two.
                return trial
    return pair_instead(search, wide, screen, chosen, ranked, trials[pick])


def _wider(
    search: Comparison, screens: tuple[Screen, Screen], chosen: Sequence[Choice],
    free: Sequence[Candidate], pick: Trial,
) -> Trial | None:  # fmt: skip
    """What many joints have, with all else that joints may have, where that leaves
    clearly less. Where errors jump, columns tell too little of so many."""
    wide, screen = screens
    of = pick.ranked.candidate
    if of.kind not in KINDS or not (of.members or len(of.at) > 1):
        return None
    if search.plan.jumps or not search.needs_more(pick.fit):
        return None
    found = of_more_kinds(search, wide, free, of.kind)
    for trial in fit_each(search, screen, chosen, [found] if found else []):
        if search.error(trial.fit.score) < search.enough(pick.fit.score):
            return trial
    return None


def _choices(
    rivals: Rivals, trials: Sequence[Trial], pick: int, chosen: Sequence[Choice],
    base: float, before: np.ndarray,
) -> tuple[Choice, ...]:  # fmt: skip
    """The effects of what is picked, as choices.

    Args: base, before (m,): error and residual without it.
    """
    fit, best = trials[pick]
    others = [t for k, t in enumerate(trials) if k != pick]
    runner = min(others, key=lambda t: t.fit.score, default=None)
    ties: tuple[Effect, ...] = ()
    if not best.candidate.members:
        ties = rivals.ties_of(trials[pick], others, before, chosen)
    new = fit.effects[len(chosen) :]
    sizes = [len(fit.std[len(chosen) + k]) for k in range(len(new))]
    if len(new) == 1:
        sizes = [best.candidate.size]
    fixed = best.fixed()
    is_group = len(new) > 1 and best.candidate.kind in KINDS
    both_needed = rivals.are_both_needed(best)
    return tuple(
        Choice(
            effect, {}, base, fit.score,
            runner.ranked.candidate.name if runner else "",
            runner.fit.score / fit.score - 1.0 if runner else np.inf,
            ties, fixed[k], sizes[k], is_group, both_needed,
            len(new) > 1 and not is_group, needed_beside=tuple(
                (e.kind, tuple(e.at)) for e in new if both_needed and e is not effect
            ),
            why=why_not(runner.ranked.candidate, best.candidate) if runner else "",
        )
        for k, effect in enumerate(new)
    )  # fmt: skip
