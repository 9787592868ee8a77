"""How one search compares models: by held-out error, and by channel."""

from collections.abc import Callable, Sequence

import numpy as np

from makebreak.gap.budget import present
from makebreak.gap.fit import fit_effects, tangents
from makebreak.gap.numerics.selection import (
    LinearFit,
    Screen,
    by_block,
    is_plausible,
    paired,
    paired_t,
)
from makebreak.gap.problem import Fitted, GapProblem, rms
from makebreak.gap.search.choice import Choice, fixed_parameters
from makebreak.gap.search.together import WEIGHT_ROUNDS
from makebreak.gap.thresholds import (
    BESIDE_NOISE_EVIDENCE,
    CHANNEL_GAIN,
    CHANNEL_MODEL_ERROR_SHARE,
    CHANNEL_RMS_MIN,
    CHANNEL_T_MIN,
    EVIDENCE_MIN,
    FREE_TOLERANCE,
    MODEL_ERROR_SHARE,
    NOISE_RMS_MAX,
    NUISANCE_EXCESS,
    P_VALUE_MIN,
    REFIT_LOSS_MAX,
    RIVAL_ERROR_RATIO,
    RIVAL_P_VALUE,
    SAME_ERROR,
)
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.sizes import Sizes


def _cost(b: np.ndarray, prior: np.ndarray) -> float:
    """What nuisances cost; columns beside them (the last of b) cost nothing."""
    return float(np.sum((b[: len(prior)] / prior) ** 2))


class Comparison:
    """A problem with the fit of the scene as it came, against which all is measured.

    say: called with a line of text for each candidate that is fitted.
    """

    def __init__(self, problem: GapProblem, say: Callable[[str], None]):
        self.problem, self.say, self.plan = problem, say, problem.plan
        self.budget = present()
        self.train = problem.train()
        self.channel = problem.channel_of_rows()
        self.start_again()

    def start_again(self) -> None:
        """Nuisances and the fit without effects, by the rows' weights of now."""
        self.nuisances = self.problem.nuisances()
        self.start = fit_effects(self.problem, self.screen(self.problem.base()), ())

    @property
    def sizes(self) -> Sizes | None:
        """Those of the problem's scene."""
        return self.problem.sizes

    def if_time(
        self, what: str, step: Callable, chosen: Sequence[Choice], current: Fitted
    ) -> tuple[list[Choice], Fitted]:
        """What a step makes of the choices and their fit; where time is up before, they
        stay as they are, and `what` is noted as undone."""
        as_it_is = (list(chosen), current)
        return self.budget.if_time(what, lambda: step(chosen, current), as_it_is)

    def screen(
        self, r: np.ndarray, scale: float = 1.0, reach: float | None = None, slopes=None
    ) -> Screen:
        """Fits of the residual r (m,), with the nuisances.

        Args: scale: rms that is left, against which nuisances are weighed, by the
            number of rows that are independent. reach: another limit of the nuisances
            than theirs. slopes (m, k): further columns, which are practically free.
        """
        n = self.nuisances
        scale = max(scale, 1.0) * self.problem.correlation
        limit = n.reach if reach is None else reach
        screen = Screen(r, n.columns, n.prior, self.train, scale, limit)
        if slopes is None or not slopes.shape[1]:
            return screen
        return screen.beside(slopes, FREE_TOLERANCE)

    def slopes(
        self, chosen: Sequence[Choice], current: Fitted, problem=None
    ) -> tuple[np.ndarray, np.ndarray]:
        """As of fit.tangents, by this problem's or another one's weights; none where
        the error jumps, as slopes tell nothing then."""
        if not chosen or self.plan.jumps:
            return np.zeros((len(current.r), 0)), np.zeros(0, int)
        fixed = fixed_parameters(chosen)
        return tangents(problem or self.problem, current, fixed)

    # ----- Errors

    def error(self, score: float) -> float:
        """A held-out error, with what laws may be off by added, and no less than the
        problem's least error."""
        off = MODEL_ERROR_SHARE * self.start.score
        return float(np.hypot(max(score, self.plan.least_error), off))

    def error_without_floor(self, score: float) -> float:
        """The same below the problem's least error too."""
        return float(np.hypot(score, MODEL_ERROR_SHARE * self.start.score))

    def enough(self, score: float) -> float:
        """The error below which an effect takes enough off a held-out error."""
        return (1.0 - self.plan.least_gain) * self.error(score)

    def needs_more(self, fitted: Fitted) -> bool:
        """Whether an effect is missing: held-out rows, or one channel, are above the
        noise, or nuisances are beyond what their tolerance allows."""
        loud = self.problem.noise_error(fitted.left) > NOISE_RMS_MAX
        loud |= self.problem.loudest(fitted)[1] > self.plan.loud
        return loud or self.is_strained(fitted)

    def may_need_more(self, fitted: Fitted) -> bool:
        """The same, or one channel is above what an effect of it alone must be beyond,
        where models can be compared by evidence. Where nothing but evidence says it,
        candidates are asked; where evidence alone is not enough, unless effects have
        brought the scene down to the noise."""
        if self.needs_more(fitted):
            return True
        if self.plan.counts_evidence:
            alone = self.plan.evidence_alone or not fitted.effects
            return alone or not self.needs_more(self.start)
        if not self.tells_by_evidence or not self.plan.by_channel:
            return False
        noisy = self.problem.in_noise(fitted.left)
        channels = (noisy[self.channel == k] for k in np.unique(self.channel))
        return any(rms(x) > CHANNEL_RMS_MIN for x in channels)

    def is_needed(self, more: Fitted, fitted: Fitted, parameters: int) -> bool:
        """Whether what a fit has more than another is missing there: an effect is, or
        all rows together are near the noise and it is there beyond doubt."""
        least = EVIDENCE_MIN if self.plan.evidence_alone else BESIDE_NOISE_EVIDENCE
        return (
            self.needs_more(fitted) or self.evidence(more, fitted, parameters) > least
        )

    def is_strained(self, fitted: Fitted) -> bool:
        """Whether nuisances are where they should not be, all together or one alone."""
        far = not is_plausible(fitted.b, self.nuisances.prior)
        return far or bool(self.nuisances_beyond(fitted))

    def nuisances_beyond(self, fitted: Fitted) -> tuple[tuple[str, float], ...]:
        """(name, tolerances) of nuisances that would go clearly beyond their limit if
        they could; none if the error would not fall by what an effect must gain."""
        n = self.nuisances
        screen = self.screen(fitted.r, fitted.fit.train)
        off = screen.wanted(fitted.r)
        beyond = tuple(
            (name, float(x))
            for name, x in zip(n.names, off, strict=True)
            if abs(x) > n.reach + NUISANCE_EXCESS
        )
        if not beyond:
            return ()
        free = self.screen(fitted.r, fitted.fit.train, np.inf)
        left, freed = (each.fit_nuisances(fitted.r)[1] for each in (screen, free))
        a, b = (self.error(each.evaluate(fitted.r).score) for each in (screen, free))
        gained = b < (1.0 - self.plan.least_gain) * a
        return beyond if self.earns_its_place(left, freed, gained) else ()

    def earns_its_place(
        self, without: np.ndarray, with_: np.ndarray, on_the_whole: bool
    ) -> bool:
        """Whether an effect gains enough: on the whole, or on one channel and in blocks
        of time together (CHANNEL_GAIN).

        Args: without, with_ (m,): what is left without and with it. on_the_whole:
            whether all rows together gain enough.
        """
        if on_the_whole:
            return True
        if not self.plan.by_channel:
            return False
        gain = self.channel_gains(without, with_)
        t = paired_t(without, with_, self.train, self.channel)
        return (
            bool(len(gain)) and max(gain.values()) >= CHANNEL_GAIN and t > CHANNEL_T_MIN
        )

    def channel_gains(
        self, without: np.ndarray, with_: np.ndarray, above: float = CHANNEL_RMS_MIN
    ) -> dict[int, float]:
        """{channel: share that is taken off its held-out error}, of channels that are
        above so many times the noise; with what laws may be off by added."""
        held = ~self.train
        noisy = self.problem.in_noise(without)
        found = {}
        for k in np.unique(self.channel):
            mine = held & (self.channel == k)
            if not mine.any() or rms(noisy[mine]) < above:
                continue
            off = CHANNEL_MODEL_ERROR_SHARE * rms(self.start.left[mine])
            a, b = np.hypot(rms(without[mine]), off), np.hypot(rms(with_[mine]), off)
            found[int(k)] = 1.0 - b / a
        return found

    def is_alike(self, rival: Fitted, fit: Fitted) -> bool:
        """Whether a rival leaves no more, or no more block by block than by chance."""
        if rival.score <= fit.score:
            return True
        return paired(rival.left, fit.left, self.train) > P_VALUE_MIN

    def is_worse(self, rival: Fitted, fit: Fitted, more: int) -> bool:
        """Whether a rival that seems as good is clearly worse: there is less evidence
        for it by EVIDENCE_MIN, or it leaves more, below the noise too, by the weights
        of either model.

        Args: more: parameters that the fit has more than the rival.
        """
        if self.tells_by_evidence and self.evidence(fit, rival, more) > EVIDENCE_MIN:
            return True
        screen = self.screen(fit.r, fit.fit.train)
        pairs = self.problem.weighed_alike(rival.effects, fit.effects)
        for worse, better in pairs:
            a, b = (
                self.error_without_floor(screen.evaluate(r).score)
                for r in (worse, better)
            )
            one, two = (screen.fit_nuisances(r)[1] for r in (worse, better))
            if (
                a <= (1.0 + SAME_ERROR) * b
                or paired(one, two, self.train) > RIVAL_P_VALUE
            ):
                return False
        return bool(pairs)

    def is_louder(self, rival: Fitted, fit: Fitted) -> bool:
        """Whether a rival leaves one channel a gap, and the fit does not: among all
        rows together few say so."""
        ours, theirs = (self.problem.loudest(each)[1] for each in (fit, rival))
        return theirs > max(self.plan.loud, RIVAL_ERROR_RATIO * ours)

    @property
    def tells_by_evidence(self) -> bool:
        """Whether models that leave as much as noise may can be told apart: rows have
        the same weights for all of them, and no error is too small to say anything."""
        return not self.plan.least_error and self.problem.weighed_by(()) is None

    def evidence(self, one: Fitted, other: Fitted, more: int) -> float:
        """How much the data and the nuisances' tolerances prefer one model: the
        difference of the squared residuals of all rows, over what is left and what laws
        may be off by, and of the cost of the nuisances, less log(rows) for each
        parameter that it has more. The block of time that prefers it most does not
        count: no single stretch decides.

        Source: Schwarz, Ann. Stat. 6(2), 1978 (BIC), as -2 times the logarithm of the
        ratio of likelihoods, with the nuisances' prior.
        """
        least = min(one.fit.held_out, other.fit.held_out)
        prior = self.nuisances.prior
        cost = _cost(other.b, prior) - _cost(one.b, prior)
        return self._evidence(one.left, other.left, least, more) + cost

    def evidence_of(self, screen: Screen, X: np.ndarray) -> float:
        """The same of columns (m, k) against none."""
        return self.evidence_by_columns(screen, X, X[:, :0])

    def evidence_against(
        self, b, left, fit: LinearFit, other: Fitted, more: int
    ) -> float:
        """The same of a model's nuisances b (n_b,), what it leaves of rows (m,), and
        its fit, over another."""
        least = min(fit.held_out, other.fit.held_out)
        prior = self.nuisances.prior
        cost = _cost(other.b, prior) - _cost(b, prior)
        return self._evidence(left, other.left, least, more) + cost

    def evidence_by_columns(self, screen: Screen, one, other) -> float:
        """The same of columns (m, k), beside others that a screen may have as further
        nuisances, which cost next to nothing."""
        fits = [screen.fit(X) for X in (one, other)]
        b, left = zip(
            *(screen.fit_nuisances(screen.r - X @ fit.c)
              for X, fit in zip((one, other), fits, strict=True)),
            strict=True,
        )  # fmt: skip
        least, more = min(fit.held_out for fit in fits), one.shape[1] - other.shape[1]
        prior = self.nuisances.prior
        cost = _cost(b[1], prior) - _cost(b[0], prior)
        return self._evidence(left[0], left[1], least, more) + cost

    def _evidence(self, one, other, least: float, more: int) -> float:
        """Of what two models leave of rows (m,), the better of them `least` of those
        held out, and of `more` parameters."""
        off = MODEL_ERROR_SHARE * self.start.score
        together = self.problem.correlation**2  # Neighbouring rows that say the same.
        squares = (other**2 - one**2) / (together * (max(least, 1.0) ** 2 + off**2))
        blocks = by_block(squares, self.train)
        rows = max(len(squares) / together, 1.0)
        data = float(blocks.sum() - blocks.max(initial=0.0))
        return data - more * float(np.log(rows))

    # ----- Fits

    def without(self, effects: Sequence[Effect], *which: int) -> list[Effect]:
        """The effects but for some, where residuals exist for them."""
        rest = [e for k, e in enumerate(effects) if k not in which]
        return self.problem.permitted(rest)

    def refit(self, chosen: Sequence[Choice], current: Fitted) -> Fitted:
        """All that is chosen, fitted again by the weights of now."""
        screen = self.screen(current.r, current.fit.train)
        effects = self.problem.permitted([c.effect for c in chosen])
        fixed = fixed_parameters(chosen)
        fitted = fit_effects(self.problem, screen, effects, fixed)
        before, after = self.error(current.score), self.error(fitted.score)
        if effects == list(current.effects) and after > (1.0 + REFIT_LOSS_MAX) * before:
            # Compared with the old parameters by the same weights.
            screen = self.screen(self.problem.residual(effects), current.fit.train)
            still = fit_effects(self.problem, screen, effects, fixed, evaluations=1)
            if after > (1.0 + REFIT_LOSS_MAX) * self.error(still.score):
                return still
        # Of two rivals the one that makes the noise larger would grow: fits by the same
        # weights, in turns with the weights.
        for _ in range(WEIGHT_ROUNDS if any(c.of_two for c in chosen) else 0):
            alike = self.problem.weighed_by(fitted.effects)
            assert alike is not None
            screen = self.screen(alike.residual(fitted.effects), fitted.fit.train)
            fitted = fit_effects(alike, screen, fitted.effects, fixed)
        return fitted
