"""Rivals of an effect: is it the one that is needed, are both, or do the data not
decide (a tie)?"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.fit import fit_effects, highest
from makebreak.gap.numerics.selection import Screen, paired
from makebreak.gap.problem import Candidate, Fitted, rms
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    Trial,
    fixed_parameters,
    identifiable,
    pair_of,
    places,
    uses_all_parameters,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.search.together import Together, fit_together
from makebreak.gap.thresholds import (
    CHANNEL_MODEL_ERROR_SHARE,
    EXTRA_PARAMETERS_MAX,
    P_VALUE_MIN,
    PAIR_GAIN,
    PAIR_RIVALS_MAX,
    RIVAL_ERROR_RATIO,
    SAME_ERROR,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

HARDLY_CHANGED = 0.02  # Of the equation that an effect changes most.
NO_MASS = 0.01  # Of a body's mass: what is left at the end of its range.


def are_rivals(one: Trial, other: Trial) -> bool:
    """Whether two candidates may stand for each other: the catalogue says so, or they
    leave about as much."""
    a, b = one.ranked.candidate.kind, other.ranked.candidate.kind
    if b in KINDS[a].confused_with or a in KINDS[b].confused_with:
        return True
    return bool(other.fit.score <= RIVAL_ERROR_RATIO * one.fit.score)


class Rivals:
    """Rivals of one parameter each, fitted together (gap/search/together.py). Fits are
    kept, because several rules ask for the same pair."""

    def __init__(self, search: Comparison):
        self._search = search
        self._known: dict[tuple[int, int], tuple] = {}
        self._pairs: list[Ranked] = []  # Of rivals that are both needed.

    def are_both_needed(self, ranked: Ranked) -> bool:
        """Whether a candidate is a pair that `both_needed` returned."""
        return any(ranked is pair for pair in self._pairs)

    def together(
        self, chosen: Sequence[Choice], one: Trial, other: Trial
    ) -> Together | None:
        """None where one of them has more parameters or goes to the end of its range,
        or weights do not depend on the model, so that nothing is gained by it. None of
        a drive's gain beside an inertia either: all forces can become small together,
        and would leave less by any weights."""
        for _, r in (one, other):
            if r.candidate.members or r.candidate.size != 1 or r.candidate.fixed:
                return None
        kinds = [KINDS[t.ranked.candidate.kind] for t in (one, other)]
        if any(k.path == "gain" for k in kinds) and any(k.is_inertia for k in kinds):
            return None
        key = (id(one.ranked), id(other.ranked))
        if key not in self._known:
            nothing = _neutral(one.ranked), _neutral(other.ranked)
            try:
                found = fit_together(
                    self._search.problem, self._search.nuisances,
                    [c.effect for c in chosen], fixed_parameters(chosen),
                    one.fit.effects[-1], other.fit.effects[-1], nothing,
                )  # fmt: skip
            except (ValueError, RuntimeError):
                found = None
            # One that goes to the end of its range would go on, and the other along
            # with it: what each is beside the other is not known.
            if found is not None and self._goes_to_an_end(found.fitted, nothing):
                found = None
            # The pair is kept too, so that no other object gets its id.
            self._known[key] = found, one, other
        return self._known[key][0]

    def _goes_to_an_end(self, both: Fitted, nothing: tuple[Effect, Effect]) -> bool:
        """Whether one of the last two effects is within a deviation of its highest
        value, or of a body without mass. nothing: the two as they are in the scene."""
        two = zip(both.effects[-2:], both.std[-2:], nothing, strict=True)
        for effect, std, now in two:
            least = self._search.problem.least(effect.kind, effect.at)
            for name, value in effect.parameters.items():
                far = std.get(name, 0.0)
                if value + far >= highest(effect.kind, name):
                    return True
                low = least.get(name, 0.0)
                mass = now.parameters[name] - low  # As it is in the scene.
                is_mass = KINDS[effect.kind].parameter(name).unit == "kg" and mass > 0.0
                if is_mass and value - far <= low + NO_MASS * mass:
                    return True
        return False

    def least_lost(self) -> float:
        """What laws, which are approximations, may leave of the gap [noise]. (Where a
        block was pushed at one speed, friction that is 1 % off as it sets in looks like
        a third of the mass: by deviations alone the wrong one of two is needed.)"""
        return CHANNEL_MODEL_ERROR_SHARE * self._search.start.score

    def needed(
        self, trials: Sequence[Trial], pick: int, chosen: Sequence[Choice]
    ) -> int:
        """The one that is picked, or a rival that is needed beside it where it is not
        needed beside the rival."""
        for k, other in enumerate(trials):
            if k == pick or not are_rivals(trials[pick], other):
                continue
            both = self.together(chosen, trials[pick], other)
            if both is None:
                continue
            least = self.least_lost()
            if both.needs(1, least) and not both.needs(0, least):
                pick = k
        return pick

    def both_needed(
        self, trials: Sequence[Trial], picks: Sequence[int], chosen: Sequence[Choice]
    ) -> Ranked | None:
        """One of those that were picked and a rival, each of which is needed beside the
        other; of several such pairs the one that leaves least. (One of them may do it
        alone below the noise, where its value is then wrong.)"""
        found = []
        for pick in dict.fromkeys(picks):
            for k, other in enumerate(trials):
                if k == pick or not are_rivals(trials[pick], other):
                    continue
                both = self.together(chosen, trials[pick], other)
                least = self.least_lost()
                if both is None or not (both.needs(0, least) and both.needs(1, least)):
                    continue
                if self._gained_by_second(chosen, both) >= PAIR_GAIN:
                    found.append((rms(both.fitted.left), trials[pick], other, both))
        if not found:
            return None
        _, one, other, both = min(found, key=lambda each: each[0])
        effects = both.fitted.effects[len(chosen) :]
        pair = pair_of(one.ranked, other.ranked, effects)
        self._pairs.append(pair)
        return pair

    def _gained_by_second(self, chosen: Sequence[Choice], both: Together) -> float:
        """Share of the held-out error of the first alone that both take off, fitted to
        the other rows, by the weights of both."""
        search = self._search
        alike = search.problem.weighed_by(both.fitted.effects)
        assert alike is not None
        errors = []
        for start in (both.single.effects, both.fitted.effects):
            r = alike.residual(start)
            fixed = [*fixed_parameters(chosen), *[()] * (len(start) - len(chosen))]
            fit = fit_effects(alike, search.screen(r), start, fixed)
            errors.append(search.error_without_floor(fit.score))
        return 1.0 - errors[1] / errors[0]

    def ties_of(
        self, best: Trial, others: Sequence[Trial], before: np.ndarray,
        chosen: Sequence[Choice],
    ) -> tuple[Effect, ...]:  # fmt: skip
        """Effects of another kind, or of the same at another place, that explain the
        data as well.

        Args: before (m,): what is left without the effect. chosen: the other effects.
        """
        search = self._search
        fit, ranked = best
        floor = search.plan.least_error
        ties = []
        # Where the effect helps most a rival must help as much, not a little
        # everywhere.
        gains = search.channel_gains(before, fit.left) if search.plan.by_channel else {}
        most = max(gains, key=lambda k: gains[k], default=None)
        for other in others:
            f, r = other
            if not self._could_tie(best, other):
                continue
            both = None
            if are_rivals(best, other):
                both = self.together(chosen, best, other)
            if both is not None:
                # A kind that is often confused with it, but explains less, is none.
                like = f.score <= RIVAL_ERROR_RATIO * fit.score
                if like and not both.needs(0, self.least_lost()):
                    ties.append(f.effects[-1])
                continue
            alike = (
                paired(f.left, fit.left, search.train) > P_VALUE_MIN
                or max(f.score, fit.score) < floor
            )
            near = search.error(f.score) <= (1.0 + SAME_ERROR) * search.error(fit.score)
            sizes = search.sizes
            more = identifiable(fit, sizes) - identifiable(f, sizes)
            worse = search.is_worse(f, fit, more) or search.is_louder(f, fit)
            if near and alike and worse:
                continue
            if most is not None:
                there = search.channel_gains(before, f.left)[most]
                near &= 1.0 - there <= (1.0 + SAME_ERROR) * (1.0 - gains[most])
            if near and alike:
                ties.append(f.effects[-1])
        return tuple(ties)

    def _could_tie(self, best: Trial, other: Trial) -> bool:
        """Whether another candidate is a different statement than the effect: no group,
        no kind that contains it, and not the same kind on the same rigid body. A bigger
        one, which has the effect as a special case or nearly, needs evidence for it."""
        (fit, ranked), two = best, other.ranked.candidate
        one = ranked.candidate
        if two.members or one.kind in KINDS[two.kind].contains:
            return False
        sizes = self._search.sizes
        more = identifiable(other.fit, sizes) - identifiable(fit, sizes)
        if more > EXTRA_PARAMETERS_MAX:
            search = self._search
            if not search.tells_by_evidence:
                return False
            if not search.evidence(other.fit, fit, more) > 0.0:
                return False
        if not uses_all_parameters(other.fit):
            return False
        same_kind = two.kind == one.kind
        return not (same_kind and self._search.problem.is_one_place(two.at, one.at))


def still_tied(
    search: Comparison, chosen: Sequence[Choice], current: Fitted, k: int
) -> tuple[Effect, ...]:
    """The ties of the k-th effect that do as well as it beside all other effects."""
    if len(chosen) < 2 and not chosen[k].paired:
        return chosen[k].ties
    screen = search.screen(current.r, current.fit.train)
    fixed = fixed_parameters(chosen)
    tied = []
    for rival in chosen[k].ties:
        trial = [*current.effects[:k], rival, *current.effects[k + 1 :]]
        held = [*fixed[:k], (), *fixed[k + 1 :]]
        try:
            fit = fit_effects(search.problem, screen, trial, held)
        except ValueError:
            continue
        search.say(f"  {called(rival)}, as a tie: {fit.score:.3g}")
        if _does_as_well(search, fit, current, k):
            tied.append(fit.effects[k])
    return tuple(tied)


def _does_as_well(search: Comparison, fit: Fitted, current: Fitted, k: int) -> bool:
    """Whether a fit with another k-th effect explains the data as well."""
    near = search.error(fit.score) <= (1.0 + SAME_ERROR) * search.error(current.score)
    sizes = search.sizes
    more = identifiable(current, sizes, k) - identifiable(fit, sizes, k)
    worse = search.is_worse(fit, current, more) or search.is_louder(fit, current)
    return near and search.is_alike(fit, current) and not worse


def with_shared_gains(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> list[Choice]:
    """The choices, each with one more tie where one gain, shared by all drives whose
    equations it changes, explains the data as well: of what moves in a plane, two
    drives that give too little are a body that is too heavy."""
    out = list(chosen)
    if search.plan.jumps or all(c.in_group for c in chosen):
        return out
    gains = [
        c for c in search.problem.candidates(search.nuisances, current)
        if KINDS[c.kind].path == "gain" and not c.members and len(c.at) == 1
        and [x.shape[1] for x in c.columns] == [1]
    ]  # fmt: skip
    for k, choice in enumerate(chosen):
        if choice.in_group or choice.effect.kind in {c.kind for c in gains}:
            continue
        rest = search.without(current.effects, k)
        try:
            change = search.problem.residual(rest) - current.r
        except (ValueError, RuntimeError):
            continue
        size = [rms(change[c.columns[0][:, 0] != 0.0]) for c in gains]
        least = HARDLY_CHANGED * max(size, default=0.0)
        shared = [c for c, x in zip(gains, size, strict=True) if x > least]
        if len(shared) < 2:
            continue
        columns = np.sum([c.columns[0] for c in shared], axis=0)
        one = Candidate(
            shared[0].kind, tuple(c.at[0] for c in shared), 1, (columns,),
            shared[0].to_parameters,
        )  # fmt: skip
        found = in_place_of(search, one, k, chosen, current)
        if found is None or not uses_all_parameters(found.fit, k):
            continue
        if _does_as_well(search, found.fit, current, k):
            tie = found.fit.effects[k]
            out[k] = replace(choice, ties=(*choice.ties, tie))
    return out


def with_rivals_of_pairs(
    search: Comparison, chosen: Sequence[Choice], current: Fitted
) -> list[Choice]:
    """The choices with rivals of those kinds that were added two at once, which were
    not compared with others, whether both are left or one: the best candidates in the
    place of each, beside all other effects."""
    taken = places(chosen)
    free = [
        c for c in search.problem.candidates(search.nuisances, current)
        if (c.kind, c.at) not in taken
    ]  # fmt: skip
    out = []
    for k, choice in enumerate(chosen):
        rivals: list[Effect] = []
        if choice.paired:
            rest = search.without(current.effects, k)
            screen = search.screen(search.problem.residual(rest), current.fit.train)
            near = [
                r.candidate for r in rank(screen, free, search.sizes)
                if r.valid
                and r.candidate.size <= choice.size + EXTRA_PARAMETERS_MAX
                and choice.effect.kind not in KINDS[r.candidate.kind].contains
            ]  # fmt: skip
            known = {(t.kind, tuple(t.at)) for t in choice.ties}
            known |= set(choice.needed_beside)
            for c in near[:PAIR_RIVALS_MAX]:
                if (c.kind, c.at) in known:
                    continue
                found = in_place_of(search, c, k, chosen, current)
                if found is not None and uses_all_parameters(found.fit, k):
                    rivals.append(found.fit.effects[k])
        out.append(replace(choice, ties=(*choice.ties, *rivals)))
    return out


def in_place_of(
    search: Comparison, candidate: Candidate, k: int, chosen: Sequence[Choice],
    current: Fitted,
) -> Trial | None:  # fmt: skip
    """All that is chosen, with a candidate in the place of the k-th effect; None where
    that is impossible."""
    rest = search.without(current.effects, k)
    fixed = fixed_parameters(chosen)
    fixed[k] = candidate.fixed
    try:
        without = search.problem.residual(rest)
        screen: Screen = search.screen(without, current.fit.train)
        [ranked] = rank(screen, [candidate], search.sizes)
        trial = [*rest[:k], *ranked.effects, *rest[k:]]
        fit = fit_effects(search.problem, screen, trial, fixed)
    except (ValueError, RuntimeError):
        return None
    replaced = called(current.effects[k])
    search.say(f"  {candidate.name} in place of {replaced}: {fit.score:.3g}")
    sane = candidate.is_sane(fit.effects[k : k + 1], search.sizes)
    return Trial(fit, ranked) if sane and np.isfinite(fit.score) else None


def _neutral(ranked: Ranked) -> Effect:
    """A candidate at the parameters that leave the scene as it is."""
    (effect,) = ranked.candidate.effects(ranked.alternative, np.zeros(1))
    return effect
