"""Which effects a scene lacks: forward by held-out error, then backward.

Models are fitted to the rows that a problem's `train` names and chosen by the others.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.numerics.selection import (
    NESTED_GAIN,
    SAME,
    Screen,
    is_plausible,
    paired,
    paired_t,
    simplest,
)
from makebreak.gap.problem import (
    Candidate,
    Fitted,
    GapProblem,
    Nuisances,
    is_sane,
    rms,
)
from makebreak.gap.result import Considered
from makebreak.gap.search.fit import derivative_free_search, fit_effects, tangents
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.search.together import ROUNDS, Together, fit_together
from makebreak.gap.search.trust import steady
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

FINALISTS, FINALIST_RUNS = 4, 80  # Searched without slopes before one is chosen.
FLOOR = 1.15  # Rms over noise that noise alone may leave (its estimate is that good).
# Laws are approximations (how dry friction turns round, how commands are held): errors
# that differ by less than this share of the whole gap do not tell two models apart.
PRECISION = 0.015
# The same of one channel, and of two rivals that are fitted together: less of a large
# gap is how its law was written down.
CHANNEL_PRECISION = 0.03
# A rival that needs more parameters than these beyond the chosen effect's, to say the
# same, is a coincidence: it contains the effect as a special case.
EXTRA_PARAMETERS = 1
# Two models that differ block by block by more than chance: less than this p-value.
CHANCE = 0.01
# A rival that leaves more by more than SAME, by each of two weights, is worse then.
TOLD_APART = 0.05
# Rivals that are fitted together: how much more than the best one leaves; what two must
# take off the held-out error of one, by one model's weights.
RIVALS, TWO_GAIN = 1.3, 0.02
# An effect that does not take off `least_gain` of the whole may do it of one channel,
# if blocks of time say so together (t) and the channel is above the noise.
CHANNEL_GAIN, LEAST_T, ABOVE = 0.10, 2.0, 1.3
# A member of a group stays if it is so many deviations from neutral, and its channel
# is worse by this share without it; or worse by CHANNEL_GAIN.
MEMBER_Z, MEMBER_GAIN = 3.0, 0.02
FEWEST_MEMBERS = 2  # Of a group.
NEARLY = 0.9  # Of what a group takes off the error: one effect that does it goes first.
BEYOND = 1.0  # Tolerances over a nuisance's limit that are no chance among dozens.
FREE = 1e3  # Of its size, how far what is chosen may give way to a candidate.
# Standard deviations from neutral that an effect must be where what it is differs from
# one part of the data to the next.
STEADY = 2.0
# Joints that get a value of their own, at most; and how many are fitted for each.
MOST_OWN, OWN_TRIES = 8, 3
# Of the held-out error, what an effect takes off that is told by this alone; and beside
# others, of which it may take what they leave.
THERE, THERE_TOO = 0.1, 0.25
# A refit that leaves so much more of held-out rows went along what fitted rows do not
# tell.
DRIFT = 0.05
MOST_RIVALS = 3  # Of one of two that were added at once.
PAIRED = 10  # Candidates of which all pairs are tried against a single one.
# Looked ahead from: the best one and so many others. Seconds of each that are fitted.
FIRSTS, SECONDS = 4, 2


@dataclass(frozen=True, eq=False)
class Choice:
    """One effect as chosen. before, after: held-out error without and with it;
    of_two: it was needed beside its rival, which was, too; paired: it was added with
    another kind at once; or_more: parameters that may as well be any larger."""

    effect: Effect
    std: dict[str, float]
    before: float
    after: float
    runner_up: str
    margin: float
    ties: tuple[Effect, ...]
    fixed: tuple[str, ...]
    size: int
    in_group: bool = False
    of_two: bool = False
    paired: bool = False
    or_more: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen effects, in the order added. start: with no effect; end: with all.
    nuisances: as weighed at the end. beyond: those that would go beyond their limit,
    and how far, in tolerances; far: whether all together are implausible."""

    choices: tuple[Choice, ...]
    start: Fitted
    end: Fitted
    nuisances: Nuisances
    table: tuple[Considered, ...] = ()
    beyond: tuple[tuple[str, float], ...] = ()
    far: bool = False

    def screen(self, problem: GapProblem) -> Screen:
        """As the end was fitted with."""
        n, scale = self.nuisances, max(self.end.fit.train, 1.0) * problem.correlation
        return Screen(self.end.r, n.columns, n.prior, problem.train(), scale, n.reach)

    def effects(self) -> list[Effect]:
        return [c.effect for c in self.choices]


@dataclass(frozen=True, eq=False)
class _Step:
    """Candidates that were added at once, with their exact fit."""

    fitted: Fitted
    chosen: tuple[Choice, ...]


def select(
    problem: GapProblem, say: Callable[[str], None] = lambda text: None
) -> Selection:
    """Greedy forward selection with a refit of all after each addition; then whatever
    is not needed any more is dropped."""
    return _Search(problem, say).run()


def without(problem: GapProblem, selection: Selection, effect: Effect) -> Selection:
    """A selection less the effect of that kind and place, all others fitted again."""
    rest = [
        c for c in selection.choices
        if (c.effect.kind, list(c.effect.at)) != (effect.kind, list(effect.at))
    ]  # fmt: skip
    fitted = fit_effects(
        problem, selection.screen(problem), [c.effect for c in rest],
        [c.fixed for c in rest],
    )  # fmt: skip
    return replace(selection, choices=tuple(_refreshed(rest, fitted)), end=fitted)


class _Search:
    def __init__(self, problem: GapProblem, say: Callable[[str], None]):
        self.problem, self.say, self.plan = problem, say, problem.plan
        self.train = problem.train()
        self.nuisances = problem.nuisances()
        self.start = fit_effects(problem, self._screen(problem.base()), ())
        self.channel = problem.channel_of_rows()
        self._fitted_together: dict[tuple[int, int], tuple] = {}
        self._pairs: list[Ranked] = []  # Of rivals that are both needed.

    def run(self) -> Selection:
        problem = self.problem
        current, chosen = self.start, list[Choice]()
        table: list[Considered] = []
        for _ in range(self.plan.most_effects):  # A group counts as one.
            if not self._needs_more(current):
                break
            found = problem.candidates(self.nuisances, current)
            step, rows = self._forward(found, chosen, current)
            table = table or rows
            if step is None:
                break
            chosen += step.chosen
            current = self._settled(chosen, step.fitted)
            chosen = _refreshed(chosen, current)  # The next are fitted from here.
            if problem.reweigh(current.left):
                # Less is left than was taken for the least: all is weighed by that.
                self.nuisances = problem.nuisances()
                self.start = fit_effects(problem, self._screen(problem.base()), ())
                current = self._refitted(chosen, current)
                chosen = _refreshed(chosen, current)
        if self.plan.own_values and chosen:
            chosen, current = self._with_own_values(chosen, current)
        chosen, current = self._backward(chosen, current)
        chosen, current = self._simplified(chosen, current)
        while chosen:  # At last, against what all of them leave.
            current = self._refitted(chosen, current)
            chosen = _refreshed(chosen, current)
            told = [self._is_told(chosen, current, k) for k in range(len(chosen))]
            sure = [c for c, is_one in zip(chosen, told, strict=True) if is_one]
            if len(sure) == len(chosen):
                # Then the least steady one, if parts of the data contradict it.
                off = steady(problem, current)
                k = int(np.argmin(off))
                if not off[k] < STEADY:
                    break
                sure = [*chosen[:k], *chosen[k + 1 :]]
            chosen = sure
        else:
            current = self.start
        if chosen:
            if len(chosen) > 1 and any(c.paired for c in chosen):
                chosen = self._with_rivals(chosen, current)
            chosen = [
                replace(c, ties=self._still_tied(chosen, current, k))
                for k, c in enumerate(chosen)
            ]
        beyond = self._beyond(current)
        far = bool(beyond) or not is_plausible(current.b, self.nuisances.prior)
        return Selection(
            tuple(chosen), self.start, current, self.nuisances, tuple(table),
            beyond, far,
        )  # fmt: skip

    def _is_told(self, chosen: Sequence[Choice], current: Fitted, k: int) -> bool:
        """Whether the k-th effect is told from none; beside others one that may end
        anywhere also by how far it may, which slopes at where it ends do not say."""
        choice, alone = chosen[k], len(chosen) == 1
        if not is_significant(choice, alone):
            return False
        endless = any(each.endless for each in KINDS[choice.effect.kind].parameters)
        if alone or not endless:
            return True
        std, _ = self.problem.widened(current, k)
        return is_significant(replace(choice, std=std), alone)

    # ----- What is asked again and again

    def _screen(
        self, r: np.ndarray, scale: float = 1.0, reach: float | None = None, slopes=None
    ) -> Screen:
        """Nuisances are weighed against what is left, and by how many rows of it are
        independent. reach: another limit than theirs. slopes (m, k): columns that are
        free beside them."""
        n = self.nuisances
        scale = max(scale, 1.0) * self.problem.correlation
        limit = n.reach if reach is None else reach
        columns, prior = n.columns, n.prior
        if slopes is not None and slopes.shape[1]:
            columns = np.hstack([columns, slopes])
            prior = np.append(prior, np.full(slopes.shape[1], FREE))
        return Screen(r, columns, prior, self.train, scale, limit)

    def _needs_more(self, fitted: Fitted) -> bool:
        """Whether held-out rows are worse than noise, or the background is beyond what
        its tolerance allows."""
        far = not is_plausible(fitted.b, self.nuisances.prior)
        loud = self.problem.noise_error(fitted.left) > FLOOR
        loud |= self.problem.loudest(fitted)[1] > self.plan.loud
        return loud or far or bool(self._beyond(fitted))

    def _beyond(self, fitted: Fitted) -> tuple[tuple[str, float], ...]:
        """Nuisances that would go clearly beyond their limit if they could, and how
        far, in tolerances; none where that would not gain what an effect must gain."""
        n = self.nuisances
        screen = self._screen(fitted.r, fitted.fit.train)
        off = screen.wanted(fitted.r)
        beyond = tuple(
            (name, float(x))
            for name, x in zip(n.names, off, strict=True)
            if abs(x) > n.reach + BEYOND
        )
        if not beyond:
            return ()
        free = self._screen(fitted.r, fitted.fit.train, np.inf)
        left, freed = (each.settle(fitted.r)[1] for each in (screen, free))
        a, b = (self._error(each.judge(fitted.r).score) for each in (screen, free))
        gained = b < (1.0 - self.plan.least_gain) * a
        return beyond if self._earns(left, freed, gained) else ()

    def _error(self, score: float) -> float:
        """A held-out error as far as it tells models apart."""
        blur = PRECISION * self.start.score
        return float(np.hypot(max(score, self.plan.least_error), blur))

    def _refitted(self, chosen: Sequence[Choice], current: Fitted) -> Fitted:
        screen = self._screen(current.r, current.fit.train)
        effects, fixed = [c.effect for c in chosen], [c.fixed for c in chosen]
        fitted = fit_effects(self.problem, screen, effects, fixed)
        before, after = self._error(current.score), self._error(fitted.score)
        if effects == list(current.effects) and after > (1.0 + DRIFT) * before:
            # By the weights of now, which may not be those of when it was fitted.
            screen = self._screen(self.problem.residual(effects), current.fit.train)
            still = fit_effects(self.problem, screen, effects, fixed, evaluations=1)
            if after > (1.0 + DRIFT) * self._error(still.score):
                return still
        # Of two rivals more of the one that makes noise larger would take over.
        for _ in range(ROUNDS if any(c.of_two for c in chosen) else 0):
            alike = self.problem.weighed_by(fitted.effects)
            assert alike is not None
            screen = self._screen(alike.residual(fitted.effects), fitted.fit.train)
            fitted = fit_effects(alike, screen, fitted.effects, fixed)
        return fitted

    def _earns(self, without: np.ndarray, with_: np.ndarray, pooled: bool) -> bool:
        """Whether what an effect takes off residuals (m,) is worth it: of the whole, or
        of one channel while no chance does it."""
        if pooled:
            return True
        if not self.plan.by_channel:
            return False
        gain = self._channel_gains(without, with_)
        t = paired_t(without, with_, self.train, self.channel)
        return bool(len(gain)) and max(gain.values()) >= CHANNEL_GAIN and t > LEAST_T

    def _channel_gains(self, without, with_, above=ABOVE) -> dict[int, float]:
        """Of each channel above so many times the noise, the share that is taken off
        its held-out error, as far as laws are told apart."""
        held = ~self.train
        noisy = self.problem.in_noise(without)
        found = {}
        for k in np.unique(self.channel):
            mine = held & (self.channel == k)
            if not mine.any() or rms(noisy[mine]) < above:
                continue
            blur = CHANNEL_PRECISION * rms(self.start.left[mine])
            a, b = (
                np.hypot(rms(without[mine]), blur),
                np.hypot(rms(with_[mine]), blur),
            )
            found[int(k)] = 1.0 - b / a
        return found

    # ----- Forward

    def _forward(
        self, found: Sequence[Candidate], chosen: Sequence[Choice], current: Fitted
    ) -> tuple[_Step | None, list[Considered]]:
        taken = {(c.effect.kind, tuple(c.effect.at)) for c in chosen}
        open_ = [
            c for c in found if (c.kind, c.at) not in taken or KINDS[c.kind].several
        ]
        open_ += _groups(open_)
        # With what is chosen free to give way, as far as slopes tell.
        slopes = np.zeros((len(current.r), 0))
        if chosen and not self.plan.jumps:
            slopes = tangents(self.problem, current, [c.fixed for c in chosen])
        wide = self._screen(current.r, slopes=slopes)
        ranked = [r for r in rank(wide, open_) if r.valid]
        if not ranked:
            return None, []
        # What even the best leaves is no noise: nuisances are weighed against it.
        scale = 1.0
        for _ in range(2):
            best = max(ranked[0].fit.train, 1.0)
            if best < 1.2 * scale and scale < 1.2 * best:
                break
            scale = best
            wide = self._screen(current.r, scale, slopes=slopes)
            ranked = [r for r in rank(wide, open_) if r.valid]
        screen = self._screen(current.r, scale)
        base = screen.judge(current.r)
        ranked = self._pruned(wide, ranked)
        table = [
            Considered(
                r.candidate.kind, tuple(r.candidate.at),
                r.fit.score / max(base.score, 1e-12), dict(r.effects[0].parameters),
            )
            for r in ranked[:15]
        ]  # fmt: skip
        by_model = self.problem.weighed_by([c.effect for c in chosen]) is not None
        short = _shortlist(ranked, base.score, self.plan.shortlist, by_model)
        if not self.plan.by_channel and ranked[0].fit.score > 0.95 * base.score:
            short = []
        if not short:
            return None, table
        sound = self._fit_each(screen, chosen, short)
        for _ in range(2 if len(self.nuisances.prior) else 0):
            least = min((f.fit.train for f, _ in sound), default=scale)
            if not max(least, 1.0) < 0.8 * scale:
                break
            # Exactly fitted less is left: nuisances are weighed against that.
            scale = max(least, 1.0)
            screen = self._screen(current.r, scale)
            base = screen.judge(current.r)
            sound = self._fit_each(screen, chosen, [r for _, r in sound], sound)
        if not sound:
            return None, table
        sound = self._one_of_each(sound)
        pick = self._picked(sound, found, base.score)
        pick = self._needed(sound, pick, chosen)
        pair = self._both(screen, chosen, sound, pick)
        if pair is None:
            pair = self._pair(wide, screen, chosen, ranked, *sound[pick])
        if pair is None:
            pair = self._ahead(screen, chosen, sound, pick)
        if pair is not None:
            sound.append(pair)
            pick = len(sound) - 1
        left = screen.settle(current.r)[1]
        least = (1.0 - self.plan.least_gain) * self._error(base.score)
        worth = [self._earns(left, f.left, self._error(f.score) < least)
                 for f, _ in sound]  # fmt: skip
        if not worth[pick]:
            # The simplest of those that do as well on the whole may do it by a little
            # everywhere, where another does it at the joint that it acts on.
            earning = [each for each, earns in zip(sound, worth, strict=True) if earns]
            if not earning:
                return None, table
            taken_one = earning[self._picked(earning, found, base.score)]
            pick = next(k for k, each in enumerate(sound) if each is taken_one)
        return self._step(sound, pick, chosen, base.score, left), table

    def _one_of_each(self, sound):
        """Of one kind at one place (a patch that was found twice) one: no rival of
        itself. Of those that do as well as the best the one that changes least."""
        of: dict[tuple, list] = {}
        for fit, r in sound:
            key = (r.candidate.kind, tuple(r.candidate.at), r.candidate.size)
            of.setdefault(key, []).append((fit, r))
        out = []
        for same in of.values():
            best = min(self._error(f.score) for f, _ in same)
            near = [x for x in same if self._error(x[0].score) <= (1.0 + SAME) * best]
            out.append(
                min(
                    near,
                    key=lambda x: (self.problem.change(x[0].effects[-1]), x[0].score),
                )
            )
        return out

    def _picked(self, sound, found: Sequence[Candidate], base: float) -> int:
        """The simplest of those that do as well as the best."""
        errors = [self._error(f.score) for f, _ in sound]
        pick = simplest(errors, [_weight(r.candidate) for _, r in sound], SAME)
        fit, best = sound[pick]
        # Before a group, one effect that does nearly all that the group does with no
        # more parameters: what it leaves is looked for next.
        most = base - NEARLY * (base - fit.score)
        alone = [
            k for k, (f, r) in enumerate(sound)
            if not r.candidate.members
            and r.candidate.size <= best.candidate.size
            and f.score <= most
        ]  # fmt: skip
        if best.candidate.members and alone:
            pick = min(alone, key=lambda k: errors[k])
            fit, best = sound[pick]
        order = {id(c): k for k, c in enumerate(found)}
        # Bodies whose origins coincide: the outermost, as loads and forces mostly are.
        # The others are told as ties.
        for k, (other, r) in enumerate(sound):
            one, two = r.candidate, best.candidate
            same = (one.kind, one.size) == (two.kind, two.size) and not one.members
            if same and self._error(other.score) <= 1.002 * self._error(fit.score):
                if order.get(id(one), -1) > order.get(id(two), -1):
                    pick, fit, best = k, other, r
        # A model inside a bigger one stays unless the bigger gains clearly.
        for k, (inner, r) in enumerate(sound):
            inside = r.candidate.kind in KINDS[best.candidate.kind].contains
            near = self._error(inner.score) <= (1.0 + NESTED_GAIN) * self._error(
                fit.score
            )
            if inside and near and r.candidate.at == best.candidate.at:
                return k
        return pick

    def _pair(
        self, wide, screen, chosen, ranked: Sequence[Ranked], single: Fitted, of: Ranked
    ):
        """Two other effects at once where they leave clearly less than the best single
        one: what two do together another kind may imitate better than either of them.
        Two of which it is one, if they leave least, are found step by step."""
        if self.plan.jumps or self.problem.noise_error(single.left) < FLOOR:
            return None
        best: dict[str, Ranked] = {}
        own = of.candidate.kind
        for r in ranked:
            if not r.candidate.members:
                best.setdefault(r.candidate.kind, r)
        tried = list(best.values())[:PAIRED]
        trials = []
        for a, b in itertools.combinations(tried, 2):
            X = np.hstack([a.columns, b.columns])
            fit = wide.fit(X)
            k = a.columns.shape[1]
            effects = (
                *a.candidate.effects(a.alternative, fit.c[:k]),
                *b.candidate.effects(b.alternative, fit.c[k:]),
            )
            if a.candidate.is_sane(effects[:1]) and b.candidate.is_sane(effects[1:]):
                trials.append((fit.score, a, b, effects))
        trials.sort(key=lambda t: t[0])
        for score, a, b, effects in trials[:2]:
            if any(k == own or own in KINDS[k].contains for k in
                   (a.candidate.kind, b.candidate.kind)):  # fmt: skip
                break  # The single one with another is as good or better.
            if not self._error(score) < (1.0 - NESTED_GAIN) * self._error(single.score):
                break
            for fitted, r in self._fit_each(screen, chosen, [_pair_of(a, b, effects)]):
                less = (1.0 - NESTED_GAIN) * self._error(single.score)
                if self._error(fitted.score) < less:
                    return fitted, r
        return None

    def _ahead(self, screen: Screen, chosen: Sequence[Choice], sound, pick: int):
        """Two other effects where they leave clearly less than the best single one does
        (as little, if they have fewer parameters) and no more than that one with a
        second. (Two frictions that are wrong at once: a patch, with its five
        parameters, does more than either, and by the columns of the scene as it came
        the second one does nothing.)"""
        single, of = sound[pick]
        if of.candidate.members or self.problem.noise_error(single.left) < FLOOR:
            return None
        others = [
            k for k, (_, r) in enumerate(sound)
            if k != pick and not r.candidate.members
        ]  # fmt: skip
        others.sort(key=lambda k: sound[k][0].score)
        pairs = [
            (k, both, pair)
            for k in (pick, *others[:FIRSTS])
            for both, pair in self._with_a_second(screen, chosen, *sound[k])
        ]
        if not pairs:
            return None
        errors = [self._error(both.score) for _, both, _ in pairs]
        # Of as many parameters those of one kind, which may have one cause.
        sizes = [
            2 * _weight(r.candidate) - (len({e.kind for e in r.effects}) == 1)
            for *_, r in pairs
        ]  # fmt: skip
        best = simplest(errors, sizes, SAME)
        k, both, pair = pairs[best]
        if k == pick:
            return None  # The second is found when the first is there.
        simpler = _weight(pair.candidate) < _weight(of.candidate)
        most = self._error(single.score) * (
            1.0 + SAME if simpler else 1.0 - NESTED_GAIN
        )
        return (both, pair) if errors[best] < most else None

    def _with_a_second(self, screen: Screen, chosen, fit: Fitted, first: Ranked):
        """(fit, pair) of a first effect with each of the best seconds, fitted exactly;
        seconds by their columns in the scene with the first in it."""
        there = _refreshed([*chosen, _untold(first, fit.effects[-1])], fit)
        found = self.problem.next_candidates(fit)
        if not found:
            return []
        slopes = tangents(self.problem, fit, [c.fixed for c in there])
        wide = self._screen(fit.r, fit.fit.train, slopes=slopes)
        # Each alternative by itself: that which fits best may bend where rows are held
        # out, and the next one be right.
        split = [
            replace(c, columns=(x,), to_parameters=(read,))
            for c in found
            for x, read in zip(c.columns, c.to_parameters, strict=True)
        ]
        best_of: dict[tuple, Ranked] = {}
        for r in rank(wide, split):
            if r.valid and self._error(r.fit.score) < self._error(fit.score):
                best_of.setdefault((r.candidate.kind, r.candidate.at), r)
        return [
            (both, _pair_of(first, second, both.effects[-2:]))
            for both, second in self._fit_each(
                screen, there, list(best_of.values())[:SECONDS]
            )
        ]

    def _together(self, chosen, one, other) -> Together | None:
        """Two rivals (fit, ranked) of one parameter each, fitted at once; None where
        they are none, or nothing is gained by it."""
        for _, r in (one, other):
            if r.candidate.members or r.candidate.size != 1 or r.candidate.fixed:
                return None
        key = (id(one[1]), id(other[1]))
        if key not in self._fitted_together:
            try:
                found = fit_together(
                    self.problem, self.nuisances, [c.effect for c in chosen],
                    [c.fixed for c in chosen], one[0].effects[-1],
                    other[0].effects[-1], (_nothing(one[1]), _nothing(other[1])),
                )  # fmt: skip
            except (ValueError, RuntimeError):
                found = None
            # The pair is kept along: of what is gone another might have the number.
            self._fitted_together[key] = found, one, other
        return self._fitted_together[key][0]

    def _least_lost(self) -> float:
        """What laws, which are approximations, may leave of the gap, in noise. (Where a
        block was pushed at one speed, friction that is 1 % off as it sets in looks like
        a third of the mass: by deviations alone the wrong one of two is needed.)"""
        return CHANNEL_PRECISION * self.start.score

    def _needed(self, sound, pick: int, chosen) -> int:
        """Of the one that is picked and its rivals that one which is needed beside the
        other, if the other is not."""
        for k, other in enumerate(sound):
            if k == pick or not _are_rivals(sound[pick], other):
                continue
            both = self._together(chosen, sound[pick], other)
            if both is None:
                continue
            least = self._least_lost()
            if both.needs(1, least) and not both.needs(0, least):
                pick = k
        return pick

    def _both(self, screen, chosen, sound, pick: int):
        """Two rivals, each of which is needed beside the other; of several such pairs
        the one that leaves least. One of them may do it alone below the noise, where
        its value is then wrong."""
        found = []
        for k, other in enumerate(sound):
            if k == pick or not _are_rivals(sound[pick], other):
                continue
            both, least = self._together(chosen, sound[pick], other), self._least_lost()
            if both is None or not (both.needs(0, least) and both.needs(1, least)):
                continue
            if self._gained_by_two(chosen, both) >= TWO_GAIN:
                found.append((rms(both.fitted.left), other[1], both))
        if not found:
            return None
        _, rival, both = min(found, key=lambda each: each[0])
        a, b = sound[pick][1], rival
        ranked = _pair_of(a, b, both.fitted.effects[len(chosen) :])
        self._pairs.append(ranked)
        pairs = self._fit_each(screen, chosen, [ranked])
        return pairs[0] if pairs else None

    def _gained_by_two(self, chosen, both: Together) -> float:
        """Share of the held-out error of the first alone that both take off, fitted to
        the other rows, by the weights of both."""
        alike = self.problem.weighed_by(both.fitted.effects)
        assert alike is not None
        errors = []
        for start in (both.single.effects, both.fitted.effects):
            r = alike.residual(start)
            fixed = [*[c.fixed for c in chosen], *[()] * (len(start) - len(chosen))]
            fit = fit_effects(alike, self._screen(r), start, fixed)
            errors.append(self._blurred(fit.score))
        return 1.0 - errors[1] / errors[0]

    def _step(self, sound, pick: int, chosen, base: float, before) -> _Step:
        """Args: base, before (m,): error and residual without it."""
        fit, best = sound[pick]
        others = [(f, r) for k, (f, r) in enumerate(sound) if k != pick]
        runner = min(others, key=lambda o: o[0].score, default=None)
        ties: tuple[Effect, ...] = ()
        if not best.candidate.members:
            ties = self._ties(fit, best, others, before, chosen)
        new = fit.effects[len(chosen) :]
        sizes = [len(fit.std[len(chosen) + k]) for k in range(len(new))]
        if len(new) == 1:
            sizes = [best.candidate.size]
        fixed = best.fixed()
        together = len(new) > 1 and best.candidate.kind in KINDS  # A group's.
        of_two = any(best is pair for pair in self._pairs)
        return _Step(
            fit,
            tuple(
                Choice(
                    effect, {}, base, fit.score,
                    runner[1].candidate.name if runner else "",
                    runner[0].score / fit.score - 1.0 if runner else np.inf,
                    ties, fixed[k], sizes[k], together, of_two,
                    len(new) > 1 and not together,
                )
                for k, effect in enumerate(new)
            ),
        )  # fmt: skip

    def _ties(
        self, fit: Fitted, best: Ranked, others, before, chosen: Sequence[Choice] = ()
    ) -> tuple[Effect, ...]:
        """Of another kind, or of the same at another place.

        Args: before (m,): what is left without the effect; chosen: what else is there.
        """
        error, floor = self._error, self.plan.least_error
        ties = []
        # Where it helps most a rival must do so too, not by a little everywhere.
        gains = self._channel_gains(before, fit.left) if self.plan.by_channel else {}
        most = max(gains, key=lambda k: gains[k], default=None)
        for f, r in others:
            if r.candidate.members:
                continue
            if best.candidate.kind in KINDS[r.candidate.kind].contains:
                continue
            if (
                r.candidate.size > best.candidate.size + EXTRA_PARAMETERS
                or not _is_used(f)
            ):
                continue
            if r.candidate.kind == best.candidate.kind and self.problem.is_one_place(
                r.candidate.at, best.candidate.at
            ):
                continue
            both = None
            if _are_rivals((fit, best), (f, r)):
                both = self._together(chosen, (fit, best), (f, r))
            if both is not None:
                # A kind that is often confused with it, but explains less, is none.
                like = f.score <= RIVALS * fit.score
                if like and not both.needs(0, self._least_lost()):
                    ties.append(f.effects[-1])
                continue
            alike = (
                paired(f.left, fit.left, self.train) > CHANCE
                or max(f.score, fit.score) < floor
            )
            near = error(f.score) <= (1.0 + SAME) * error(fit.score)
            if near and alike and self._is_worse(f, fit):
                continue
            if most is not None:
                there = self._channel_gains(before, f.left)[most]
                near &= 1.0 - there <= (1.0 + SAME) * (1.0 - gains[most])
            if near and alike:
                ties.append(f.effects[-1])
        return tuple(ties)

    def _is_worse(self, rival: Fitted, fit: Fitted) -> bool:
        """Whether a rival that seems as good is clearly worse, below the noise too, by
        the weights of either model."""
        screen = self._screen(fit.r, fit.fit.train)
        pairs = self.problem.weighed_alike(rival.effects, fit.effects)
        for worse, better in pairs:
            a, b = (self._blurred(screen.judge(r).score) for r in (worse, better))
            one, two = (screen.settle(r)[1] for r in (worse, better))
            if a <= (1.0 + SAME) * b or paired(one, two, self.train) > TOLD_APART:
                return False
        return bool(pairs)

    def _blurred(self, score: float) -> float:
        return float(np.hypot(score, PRECISION * self.start.score))

    def _fit_each(
        self, screen: Screen, chosen, short: Sequence[Ranked], known=()
    ) -> list[tuple[Fitted, Ranked]]:
        """Each of the short list with what is chosen already; those that make sense.

        Args: known: fits of the same, from where to go on.
        """
        sound = []
        for k, each in enumerate(short):
            trial = [*[c.effect for c in chosen], *each.effects]
            if known:
                trial = list(known[k][0].effects)
            fixed = [*[c.fixed for c in chosen], *each.fixed()]
            try:
                fit = fit_effects(self.problem, screen, trial, fixed)
            except ValueError:
                continue
            self.say(f"  {each.candidate.name}: {fit.score:.3g}")
            if _is_fit(fit, each, len(chosen)):
                sound.append((fit, each))
        if known or not self.plan.jumps:
            return sound
        # The best few once more, without slopes: else one whose fit got stuck loses.
        best = sorted(range(len(sound)), key=lambda k: sound[k][0].score)[:FINALISTS]
        for k in best if sound and sound[best[0]][0].score > FLOOR else []:
            fit, each = sound[k]
            fixed = [*[c.fixed for c in chosen], *each.fixed()]
            try:
                effects = derivative_free_search(
                    self.problem, screen, fit.effects, fixed, most=FINALIST_RUNS
                )
                better = fit_effects(self.problem, screen, effects, fixed)
            except ValueError:
                continue
            if better.fit.train < fit.fit.train and _is_fit(better, each, len(chosen)):
                sound[k] = better, each
                self.say(f"  {each.candidate.name}: {better.score:.3g}")
        return sound

    def _pruned(self, screen: Screen, ranked: list[Ranked]) -> list[Ranked]:
        """Groups without the members that do not earn their place; those that are then
        smaller than a group are none."""
        out = []
        for each in ranked:
            if each.candidate.members:
                smaller = self._prune(screen, each)
                if smaller is not None:
                    out.append(smaller)
            else:
                out.append(each)
        return sorted(out, key=lambda r: r.fit.score)

    def _prune(self, screen: Screen, group: Ranked) -> Ranked | None:
        members = list(group.candidate.members)
        held = ~self.train

        def fit_of(some):
            X = np.hstack([m.columns[0] for m in some])
            fit = screen.fit(X)
            return X, fit, screen.r - X @ fit.c

        while len(members) >= 2:
            X, fit, r = fit_of(members)
            left = screen.settle(r)[1]
            z = np.abs(fit.c) / np.maximum(fit.c_std, 1e-300)
            effects = [m.effects(0, fit.c[[k]])[0] for k, m in enumerate(members)]
            bad = [k for k, m in enumerate(members) if not m.is_sane([effects[k]])]
            order = bad or np.argsort(z).tolist()
            for k in order:
                rest = members[:k] + members[k + 1 :]
                if k in bad:
                    members = rest
                    break
                without = screen.settle(fit_of(rest)[2])[1]
                gains = [
                    1.0 - rms(left[mine]) / max(rms(without[mine]), 1e-12)
                    for c in np.unique(self.channel)
                    if (mine := held & (self.channel == c)).any()
                ]
                least = MEMBER_GAIN if z[k] >= MEMBER_Z else CHANNEL_GAIN
                if max(gains, default=0.0) < least:
                    members = rest
                    break
            else:
                break
        if len(members) < 2:
            return None
        X, fit, _ = fit_of(members)
        candidate = replace(
            group.candidate,
            at=tuple(at for m in members for at in m.at),
            size=len(members),
            columns=(X,),
            members=tuple(members),
        )
        found = candidate.effects(0, fit.c)
        sane = candidate.is_sane(found)
        return Ranked(candidate, fit, found, sane, 0) if sane else None

    # ----- After a step

    def _settled(self, chosen: Sequence[Choice], current: Fitted) -> Fitted:
        """A fit that was stopped short, as all of a short list are, carried on: what it
        has not reached yet would be looked for in other effects."""
        fixed = [c.fixed for c in chosen]
        steps = 2 * self.plan.evaluations
        for far in (False, True) if self.plan.jumps else (False,):
            if not self._needs_more(current):
                break
            screen = self._screen(current.r, current.fit.train)
            effects = current.effects
            if self.plan.jumps:
                effects = derivative_free_search(
                    self.problem, screen, effects, fixed, far
                )
            more = fit_effects(self.problem, screen, effects, fixed, steps)
            if more.fit.train < current.fit.train:
                current = more
        return current

    def _with_own_values(self, chosen: Sequence[Choice], current: Fitted):
        """Values that joints share become one of its own for a joint, where that earns
        its place as an effect does; the joint that gains most first."""
        problem, chosen = self.problem, list(chosen)
        for _ in range(MOST_OWN):
            screen = self._screen(current.r, current.fit.train)
            now, left = screen.judge(current.r), screen.settle(current.r)[1]
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
            for score, k, joint, own in sorted(tried, key=lambda t: t[0])[:OWN_TRIES]:
                if not score < now.score:
                    break
                effect, choice = current.effects[k], chosen[k]
                parts = [
                    Effect(effect.kind, [j for j in own if j != joint],
                           dict(effect.parameters)),
                    Effect(effect.kind, [joint], dict(effect.parameters)),
                ]  # fmt: skip
                trial = [*current.effects[:k], *parts, *current.effects[k + 1 :]]
                split = [*chosen[:k], choice, choice, *chosen[k + 1 :]]
                fixed = [c.fixed for c in split]
                try:
                    fit = fit_effects(problem, screen, trial, fixed)
                except ValueError:
                    continue
                self.say(f"  {effect.kind} at {joint} of its own: {fit.score:.3g}")
                pooled = self._error(fit.score) < (1.0 - self.plan.least_gain) * (
                    self._error(now.score)
                )
                if all(map(is_sane, fit.effects)) and self._earns(
                    left, fit.left, pooled
                ):
                    chosen, current = _refreshed(split, fit), fit
                    break
            else:
                break
        return chosen, current

    def _with_rivals(self, chosen: Sequence[Choice], current: Fitted) -> list[Choice]:
        """Of two kinds that were added at once none was compared with others: here the
        best of them in its place, beside all the rest."""
        taken = {(c.effect.kind, tuple(c.effect.at)) for c in chosen}
        open_ = [
            c for c in self.problem.candidates(self.nuisances, current)
            if (c.kind, c.at) not in taken
        ]  # fmt: skip
        out = []
        for k, choice in enumerate(chosen):
            rivals: list[Effect] = []
            if choice.paired:
                rest = [*current.effects[:k], *current.effects[k + 1 :]]
                screen = self._screen(self.problem.residual(rest), current.fit.train)
                near = [
                    r.candidate for r in rank(screen, open_)
                    if r.valid and r.candidate.size <= choice.size + EXTRA_PARAMETERS
                    and choice.effect.kind not in KINDS[r.candidate.kind].contains
                ]  # fmt: skip
                known = {(t.kind, tuple(t.at)) for t in choice.ties}
                for c in near[:MOST_RIVALS]:
                    if (c.kind, c.at) in known:
                        continue
                    found = self._instead(c, k, chosen, current)
                    if found is not None and _is_used(found[0], k):
                        rivals.append(found[0].effects[k])
            out.append(replace(choice, ties=(*choice.ties, *rivals)))
        return out

    def _still_tied(self, chosen, current: Fitted, k: int) -> tuple[Effect, ...]:
        """Rivals of an effect that do as well as it among all the others."""
        if len(chosen) < 2:
            return chosen[k].ties
        screen = self._screen(current.r, current.fit.train)
        fixed = [c.fixed for c in chosen]
        tied = []
        for rival in chosen[k].ties:
            trial = [*current.effects[:k], rival, *current.effects[k + 1 :]]
            held = [*fixed[:k], (), *fixed[k + 1 :]]
            try:
                fit = fit_effects(self.problem, screen, trial, held)
            except ValueError:
                continue
            near = self._error(fit.score) <= (1.0 + SAME) * self._error(current.score)
            alike = paired(fit.left, current.left, self.train) > CHANCE
            if near and alike and not self._is_worse(fit, current):
                tied.append(fit.effects[k])
        return tuple(tied)

    def _backward(self, chosen: list[Choice], current: Fitted):
        """Drops effects without which the error hardly grows, the least needed
        first."""
        while len(chosen) > 1:
            screen = self._screen(current.r, current.fit.train)
            now = screen.judge(current.r)
            # By the weights of all: a smaller model must not seem better by its own.
            alike = self.problem.weighed_by(current.effects)
            problem = self.problem if alike is None else alike
            left = screen.settle(current.r)[1]
            needless: list[tuple[float, int, Fitted]] = []
            for k in range(len(chosen)):
                rest = [e for i, e in enumerate(current.effects) if i != k]
                fixed = [c.fixed for i, c in enumerate(chosen) if i != k]
                try:
                    smaller = fit_effects(problem, screen, rest, fixed, 5)
                except ValueError:  # What is left would be no scene.
                    continue
                # Of two that were told apart by one model's weights the noise is no
                # floor.
                two = chosen[k].of_two and alike is not None
                error = self._blurred if two else self._error
                gain = TWO_GAIN if two else self.plan.least_gain
                pooled = error(now.score) < (1.0 - gain) * error(smaller.score)
                if not self._stays(chosen[k], smaller.left, left, pooled):
                    needless.append((smaller.score, k, smaller))
            if not needless:
                break
            _, k, current = min(needless, key=lambda each: each[0])
            chosen = [c for i, c in enumerate(chosen) if i != k]
            if alike is not None:
                chosen = _refreshed(chosen, current)
                current = self._refitted(chosen, current)
        return chosen, current

    def _simplified(self, chosen: list[Choice], current: Fitted):
        """A kind that contains others gives way to one of them that does as well among
        all that was chosen: others may have taken what it was needed for."""
        taken = {(c.effect.kind, tuple(c.effect.at)) for c in chosen}
        open_: Sequence[Candidate] = ()
        if any(KINDS[c.effect.kind].contains for c in chosen):
            open_ = self.problem.candidates(self.nuisances, current)
        for k, choice in enumerate(chosen):
            inner = [
                c for c in open_
                if c.kind in KINDS[choice.effect.kind].contains
                and list(c.at) == list(choice.effect.at)
                and (c.kind, c.at) not in taken
            ]  # fmt: skip
            found = [x for c in inner if (x := self._instead(c, k, chosen, current))]
            if not found:
                continue
            fit, ranked = min(found, key=lambda x: x[0].score)
            least = (1.0 - NESTED_GAIN) * self._error(fit.score)
            if self._earns(fit.left, current.left, self._error(current.score) < least):
                continue
            chosen = [*chosen]
            chosen[k] = replace(
                choice, effect=fit.effects[k], ties=(), fixed=ranked.candidate.fixed,
                size=ranked.candidate.size,
            )  # fmt: skip
            current = fit
            chosen = _refreshed(chosen, current)
        return chosen, current

    def _instead(
        self, candidate: Candidate, k: int, chosen: Sequence[Choice], current: Fitted
    ) -> tuple[Fitted, Ranked] | None:
        """All that was chosen, with a candidate in place of the k-th."""
        rest = [*current.effects[:k], *current.effects[k + 1 :]]
        fixed = [c.fixed for c in chosen]
        fixed[k] = candidate.fixed
        try:
            without = self.problem.residual(rest)
            screen = self._screen(without, current.fit.train)
            [ranked] = rank(screen, [candidate])
            trial = [*current.effects[:k], *ranked.effects, *current.effects[k + 1 :]]
            fit = fit_effects(self.problem, screen, trial, fixed)
        except (ValueError, RuntimeError):
            return None
        sane = candidate.is_sane(fit.effects[k : k + 1])
        return (fit, ranked) if sane and np.isfinite(fit.score) else None

    def _stays(self, choice: Choice, without, with_, pooled: bool) -> bool:
        if self._earns(without, with_, pooled):
            return True
        if not self.plan.by_channel or not choice.in_group:
            return False
        # One of a group, of which the others were seen.
        gains = self._channel_gains(without, with_, 0.0)
        return max(gains.values(), default=0.0) >= MEMBER_GAIN and _is_sure(choice)


def _refreshed(chosen: Sequence[Choice], fitted: Fitted) -> list[Choice]:
    """The choices with the parameters of a fit of all of them."""
    return [
        replace(c, effect=effect, std=std, after=fitted.score if k == len(chosen) - 1
                else c.after)
        for k, (c, effect, std) in enumerate(
            zip(chosen, fitted.effects, fitted.std, strict=True)
        )
    ]  # fmt: skip


def _nothing(ranked: Ranked) -> Effect:
    """A candidate as it is in the scene: with nothing of it."""
    (effect,) = ranked.candidate.effects(ranked.alternative, np.zeros(1))
    return effect


def _pair_of(a: Ranked, b: Ranked, effects: Sequence[Effect]) -> Ranked:
    """Two candidates that are added at once, as these effects."""
    one, two = a.candidate, b.candidate
    both = Candidate(
        f"{one.kind} and {two.kind}", (*one.at, *two.at), one.size + two.size,
        (np.hstack([a.columns, b.columns]),), (), members=(one, two),
    )  # fmt: skip
    return Ranked(both, a.fit, tuple(effects), True, 0)


def _untold(ranked: Ranked, effect: Effect) -> Choice:
    """An effect that is tried, as one that was chosen; nothing is told of it yet."""
    of = ranked.candidate
    return Choice(effect, {}, np.inf, np.inf, "", np.inf, (), of.fixed, of.size)


def _are_rivals(one, other) -> bool:
    """Whether two (fit, ranked) may stand for each other: the catalogue says so, or
    they leave about as much."""
    (a, r), (b, q) = one, other
    first, second = r.candidate.kind, q.candidate.kind
    if second in KINDS[first].confused_with or first in KINDS[second].confused_with:
        return True
    return bool(b.score <= RIVALS * a.score)


def _groups(found: Sequence[Candidate]) -> list[Candidate]:
    """Each kind with one parameter at all of its joints or channels at once."""
    by_kind: dict[str, list[Candidate]] = {}
    for c in found:
        place = KINDS[c.kind].at
        single = len(c.columns) == 1 and c.columns[0].shape[1] == 1 and len(c.at) == 1
        single = single and "." in c.at[0]  # Not all joints of a model, with one value.
        if (
            place in ("joint", "actuator", "channel", "drive")
            and single
            and not c.fixed
        ):
            by_kind.setdefault(c.kind, []).append(c)
    return [
        Candidate(
            kind, tuple(m.at[0] for m in members), len(members),
            (np.hstack([m.columns[0] for m in members]),), (), members=tuple(members),
        )
        for kind, members in by_kind.items()
        if len(members) >= FEWEST_MEMBERS
    ]  # fmt: skip


def _weight(candidate: Candidate) -> int:
    """What a candidate counts where the simplest is taken: twice its parameters. A kind
    some of whose parameters are left at neutral counts little less than all of it."""
    all_of_them = candidate.size + len(candidate.fixed)
    return 2 * all_of_them - bool(candidate.fixed)


def _is_fit(fit: Fitted, of: Ranked, first: int) -> bool:
    """Whether a fit of a candidate came to something that can be."""
    sane = of.candidate.is_sane(fit.effects[first:])
    return bool(np.isfinite(fit.score)) and sane


def is_significant(choice: Choice, alone: bool = True) -> bool:
    """Whether an effect is told from none: the parameters that make it one are off
    neutral by more than their deviation, within what the kind can be, and no interval
    of them is infinite; and so are half of all. Of one that may end anywhere (a small
    patch with much friction is as good as a larger one with less) held-out rows may say
    that it is there, whatever its intervals: more of them if it is not alone."""
    kind = KINDS[choice.effect.kind]
    gain = THERE if alone else THERE_TOO
    there = choice.after < (1.0 - gain) * choice.before
    if there and any(each.endless for each in kind.parameters):
        return True
    clear, some, wide, n = 0, 0, 0, 0
    for each in kind.parameters:
        value = choice.effect.parameters.get(each.name)
        spread = choice.std.get(each.name)
        if value is None or spread is None or each.name in choice.fixed:
            continue
        if each.neutral is None and each.valid == ">= 0" and value == 0.0:
            continue  # At its limit it is as good as fixed, and has no interval.
        n += 1
        infinite = not spread < each.high - each.low
        wide += infinite
        if each.neutral is not None:
            some += 1
            clear += abs(value - each.neutral) > spread and not infinite
    return 2 * wide < max(n, 1) and (clear > 0 or some == 0)


def _is_sure(choice: Choice) -> bool:
    """Whether a parameter is clearly off its neutral value."""
    return any(
        abs(choice.effect.parameters[p.name] - p.neutral) > MEMBER_Z * spread
        for p in KINDS[choice.effect.kind].parameters
        if p.neutral is not None and (spread := choice.std.get(p.name, np.inf)) < np.inf
    )


def _is_used(fit: Fitted, k: int = -1) -> bool:
    """Whether each parameter of the last effect, or of effect k, tells: else it is
    another, smaller effect under its name."""
    last, std = fit.effects[k], fit.std[k]
    for each in KINDS[last.kind].parameters:
        if each.neutral is not None and each.name in std:
            off = abs(last.parameters[each.name] - each.neutral)
            if not off > 2.0 * std[each.name]:
                return False
    return True


def _shortlist(
    ranked: list[Ranked], base: float, most: int, inner_rivals: bool = False
) -> list[Ranked]:
    """Those worth an exact fit: near the best, at most two of a kind and size, or all
    places that do alike; and of each kind that the catalogue says to be confused with
    the best, the best place."""
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
        near = each.fit.score < max(1.6 * best, best + 0.15 * (base - best))
        alike = like and each.fit.score <= 1.02 * like[0].fit.score
        if near and len(like) < (4 if alike else 2) and len(short) < most:
            short.append(each)
    there = {r.candidate.kind for r in short}
    first = ranked[0].candidate.kind
    # What looks like a kind that the best contains is its rival, too.
    best_kinds = (first, *KINDS[first].contains) if inner_rivals else (first,)
    for each in ranked:
        kind = each.candidate.kind
        alike = any(
            kind in KINDS[k].confused_with or k in KINDS[kind].confused_with
            for k in best_kinds
        )
        if alike and kind not in there:
            short.append(each)
            there.add(kind)
    # A bigger kind is compared with those inside it, which may rank far below others.
    known = {id(r) for r in short}
    for each in [*short]:
        for r in ranked:
            inside = r.candidate.kind in KINDS[each.candidate.kind].contains
            if inside and r.candidate.at == each.candidate.at and id(r) not in known:
                short.append(r)
                known.add(id(r))
    return short
