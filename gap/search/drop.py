"""What is not needed any more, or not certain, among the effects that were added."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import Candidate, Fitted, GapProblem, is_sane
from makebreak.gap.said import called
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    deviations_off,
    fixed_parameters,
    is_clearly_off,
    is_significant,
    places,
    refreshed,
)
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import in_place_of
from makebreak.gap.search.trust import consistency, scatter
from makebreak.gap.thresholds import (
    CONSISTENT_Z,
    CONSISTENT_Z_BESIDE,
    MEMBER_GAIN,
    NESTED_GAIN,
    PAIR_GAIN,
)
from makebreak.models.effects import KINDS

BEYOND_DOUBT = 30.0  # Deviations.
_EVALUATIONS = 5  # Gauss-Newton steps of a fit with one effect less.


def drop_needless(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """Without effects whose removal hardly makes the error larger, the least needed
    first."""
    chosen, current = _less_at_once(search, chosen, current)
    while len(chosen) > 1:
        screen = search.screen(current.r, current.fit.train)
        now = screen.evaluate(current.r)
        # By the weights of all: a smaller model must not seem better by its own.
        alike = search.problem.weighed_by(current.effects)
        problem = search.problem if alike is None else alike
        left = screen.fit_nuisances(current.r)[1]
        slopes, of = search.slopes(chosen, current, problem)
        needless: list[tuple[float, int, Fitted]] = []
        for k in range(len(chosen)):
            if search.plan.alike and _is_beyond_doubt(search, chosen, current, k):
                continue
            rest = search.without(current.effects, k)
            fixed = [c.fixed for i, c in enumerate(chosen) if i != k]
            # Rivals that were separated by one model's weights differ below the noise.
            two = chosen[k].of_two and alike is not None
            error = search.error_without_floor if two else search.error
            gain = PAIR_GAIN if two else search.plan.least_gain
            most = error(now.score) / (1.0 - gain)
            words = f"  without {called(chosen[k].effect)}"
            try:
                if slopes.shape[1]:  # By columns, the others free: that is quick.
                    score, less = _by_columns(
                        search, problem, current, (slopes, of), [k]
                    )
                    search.say(f"{words}, by columns: {score:.3g}")
                    if _stays(search, chosen[k], less, left, error(score) > most):
                        continue
                smaller = fit_effects(
                    problem, screen, rest, fixed, evaluations=_EVALUATIONS
                )
            except ValueError:  # What is left would be no scene.
                continue
            search.say(f"{words}: {smaller.score:.3g}")
            strains = search.is_strained(smaller) and not search.is_strained(current)
            gained = error(smaller.score) > most
            if not strains and not _stays(
                search, chosen[k], smaller.left, left, gained
            ):
                needless.append((smaller.score, k, smaller))
        if not needless:
            break
        _, k, current = min(needless, key=lambda each: each[0])
        chosen = [c for i, c in enumerate(chosen) if i != k]
        if alike is not None:
            chosen = refreshed(chosen, current)
            current = search.refit(chosen, current)
    return chosen, current


def with_errors(problem: GapProblem, selection: Selection) -> Selection:
    """The selection with the held-out error of all its effects, and of all but each,
    the others free to first order: they were found one after another, and some were
    taken back since."""
    chosen, current = list(selection.choices), selection.end
    if not chosen:
        return selection
    search = Comparison(problem, lambda text: None)
    slopes = search.slopes(chosen, current)
    after = search.screen(current.r, current.fit.train).evaluate(current.r).score
    out = []
    for k, choice in enumerate(chosen):
        try:
            before, _ = _by_columns(search, problem, current, slopes, [k])
        except ValueError:  # What is left would be no scene.
            before = float("inf")
        out.append(replace(choice, before=before, after=after))
    return replace(selection, choices=tuple(out))


def _by_columns(
    search: Comparison, problem: GapProblem, current: Fitted,
    slopes: tuple[np.ndarray, np.ndarray], gone: Sequence[int],
) -> tuple[float, np.ndarray]:  # fmt: skip
    """The held-out error of what is chosen but for some of it, all others free to first
    order, and what is left (m,). slopes: as of Comparison.slopes."""
    columns, of = slopes
    r = problem.residual(search.without(current.effects, *gone))
    others = columns[:, ~np.isin(of, gone)]
    wide = search.screen(r, current.fit.train, slopes=others)
    return wide.evaluate(r).score, wide.fit_nuisances(r)[1]


def _less_at_once(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """Without all that is needless by columns, one after another; as it is where an
    exact fit of the rest does not say the same."""
    problem = search.problem
    slopes, of = search.slopes(chosen, current)
    if not slopes.shape[1] or problem.weighed_by(current.effects) is not None:
        return chosen, current
    screen = search.screen(current.r, current.fit.train)
    left = screen.fit_nuisances(current.r)[1]
    most = search.error(screen.evaluate(current.r).score) / (
        1.0 - search.plan.least_gain
    )

    def without(gone: Sequence[int]) -> tuple[float, np.ndarray]:
        score, less = _by_columns(search, problem, current, (slopes, of), gone)
        return search.error(score), less

    gone: list[int] = []
    try:
        alone = [without([k])[0] for k in range(len(chosen))]
        for k in np.argsort(alone).tolist():
            error, less = without([*gone, k])
            if not _stays(search, chosen[k], less, left, error > most):
                gone.append(k)
        rest = [c for k, c in enumerate(chosen) if k not in gone]
        if len(gone) < 2 or not rest:
            return chosen, current
        smaller = fit_effects(
            problem, screen, search.without(current.effects, *gone),
            fixed_parameters(rest), evaluations=_EVALUATIONS,
        )  # fmt: skip
    except ValueError:  # What is left would be no scene.
        return chosen, current
    gained = search.error(smaller.score) > most
    strains = search.is_strained(smaller) and not search.is_strained(current)
    if strains or any(
        _stays(search, chosen[k], smaller.left, left, gained) for k in gone
    ):
        return chosen, current
    search.say(f"  without {len(gone)} of {len(chosen)} effects: {smaller.score:.3g}")
    return rest, smaller


def _is_beyond_doubt(
    search: Comparison, chosen: Sequence[Choice], current: Fitted, k: int
) -> bool:
    """Whether an effect is so many deviations off neutral that no fit without it need
    be tried."""
    effect = current.effects[k]
    now = search.problem.dynamics.now(effect.kind, effect.at[:1])
    sure = replace(chosen[k], effect=effect, std=current.std[k])
    return BEYOND_DOUBT < deviations_off(sure, now) < np.inf


def _stays(
    search: Comparison, choice: Choice, without, with_, on_the_whole: bool
) -> bool:
    if search.earns_its_place(without, with_, on_the_whole):
        return True
    if not search.plan.by_channel or not choice.in_group:
        return False
    if search.problem.is_within_tolerance(choice.effect):
        return False
    # A member of a group whose other members show.
    gains = search.channel_gains(without, with_, 0.0)
    return max(gains.values(), default=0.0) >= MEMBER_GAIN and is_clearly_off(choice)


def simplify(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """A kind that contains others gives way to one of them that does as well beside all
    that was chosen: later effects may have taken what it was needed for."""
    taken = places(chosen)
    found: Sequence[Candidate] = ()
    if any(KINDS[c.effect.kind].contains for c in chosen):
        found = search.problem.candidates(search.nuisances, current)
    for k, choice in enumerate(chosen):
        inner = [
            c for c in found
            if c.kind in KINDS[choice.effect.kind].contains
            and list(c.at) == list(choice.effect.at)
            and (c.kind, c.at) not in taken
        ]  # fmt: skip
        trials = [t for c in inner if (t := in_place_of(search, c, k, chosen, current))]
        if not trials:
            continue
        fit, ranked = min(trials, key=lambda t: t.fit.score)
        least = (1.0 - NESTED_GAIN) * search.error(fit.score)
        gained = search.error(current.score) < least
        if search.earns_its_place(fit.left, current.left, gained):
            continue
        chosen = [*chosen]
        chosen[k] = replace(
            choice, effect=fit.effects[k], ties=(), fixed=ranked.candidate.fixed,
            size=ranked.candidate.size,
        )  # fmt: skip
        current = fit
        chosen = refreshed(chosen, current)
    return chosen, current


def keep_certain(
    search: Comparison, chosen: list[Choice], current: Fitted
) -> tuple[list[Choice], Fitted]:
    """The effects that are certain, by a fit of these alone. Effects that are not
    significant are dropped together, but for the most needed one, which is asked again
    alone; after that, one after another, those that parts of the data contradict."""
    while chosen:
        current = search.refit(chosen, current)
        chosen = refreshed(chosen, current)
        sure = [
            c for k, c in enumerate(chosen) if _is_certain(search, chosen, current, k)
        ]
        if len(sure) == len(chosen):
            off = consistency(search.problem, current)
            k = int(np.argmin(off))
            alone = len(chosen) == 1
            if not off[k] < (CONSISTENT_Z if alone else CONSISTENT_Z_BESIDE):
                told = [
                    _as_reported(search, c, of)
                    for c, of in zip(
                        chosen, scatter(search.problem, current), strict=True
                    )
                ]
                k = int(np.argmin(told))
                if not told[k] <= 1.0:
                    return chosen, current
            sure = [*chosen[:k], *chosen[k + 1 :]]
        elif len(sure) + 1 < len(chosen):
            sure = _with_the_most_needed(search, chosen, current, sure)
        chosen = _with_the_better_of_two(search, chosen, current, sure)
    return [], search.start


def _with_the_most_needed(
    search: Comparison, chosen: list[Choice], current: Fitted, sure: list[Choice]
) -> list[Choice]:
    """What is certain and, of several effects that are not, the one that explains most
    without the others, if it is needed: of two that stand for each other (where a
    spring rests, and a bias) neither is certain beside the other."""
    names = {id(c) for c in sure}
    gone = [k for k, c in enumerate(chosen) if id(c) not in names]
    slopes = search.slopes(chosen, current)

    def left(without: Sequence[int]) -> float:
        return search.error(
            _by_columns(search, search.problem, current, slopes, without)[0]
        )

    try:
        alone = {k: left([i for i in gone if i != k]) for k in gone}
        best = min(alone, key=lambda k: alone[k])
        if alone[best] > (1.0 - search.plan.least_gain) * left(gone):
            return sure
    except ValueError:  # What is left would be no scene.
        return sure
    return [c for k, c in enumerate(chosen) if k == best or id(c) in names]


def _with_the_better_of_two(
    search: Comparison, chosen: list[Choice], current: Fitted, kept: list[Choice]
) -> list[Choice]:
    """What is kept; but of two rivals that were named because each is needed beside the
    other, and of which one is not certain there, the one that alone leaves less, by the
    weights of both. (A friction of 1.3 with a fifth of the mass did better below the
    noise than the friction alone, and might have been anything; what was left was the
    mass, which explains less than the friction.)"""
    two = [k for k, c in enumerate(chosen) if c.of_two]
    if len(two) != 2 or sum(c.of_two for c in kept) != 1:
        return kept
    alike = search.problem.weighed_by(current.effects)
    problem = search.problem if alike is None else alike
    screen = search.screen(problem.residual(current.effects), current.fit.train)
    fits: dict[int, Fitted] = {}
    for k in two:
        rest = search.without(current.effects, k)
        fixed = [c.fixed for i, c in enumerate(chosen) if i != k]
        try:
            fits[k] = fit_effects(problem, screen, rest, fixed)
        except (ValueError, RuntimeError):  # What is left would be no scene.
            return kept
        search.say(f"  without {called(chosen[k].effect)}: {fits[k].score:.3g}")
    needless = min(two, key=lambda k: fits[k].score)
    left = [c for k, c in enumerate(chosen) if k != needless]
    return [
        replace(fitted, of_two=False)
        for fitted, was in zip(refreshed(left, fits[needless]), left, strict=True)
        if was.of_two or was in kept
    ]


def _as_reported(
    search: Comparison, choice: Choice, scattered: dict[str, float]
) -> float:
    """Deviations by which an effect is off what the scene has, as they are reported:
    by how parts of the data differ, where that is more."""
    std = choice.std | {n: max(s, choice.std.get(n, 0.0)) for n, s in scattered.items()}
    now = search.problem.dynamics.now(choice.effect.kind, choice.effect.at)
    return deviations_off(replace(choice, std=std), now)


def _is_certain(
    search: Comparison, chosen: Sequence[Choice], current: Fitted, k: int
) -> bool:
    """Whether the k-th effect is significant, and of a size that robots have: beside
    others it may have gone on, as far as gains of 0 with which nothing weighs anything.
    A kind whose parameters may end anywhere must be significant, beside others, with
    its widened deviations too: slopes where it ended do not say how far it may go. Of
    what every model has (a friction, moments of inertia), what the scene has must be
    farther off than those."""
    choice, alone = chosen[k], len(chosen) == 1
    kind, at = choice.effect.kind, choice.effect.at
    least = search.problem.least(kind, at)
    sizes = search.problem.sizes
    if not (
        is_significant(choice, alone, sizes) and is_sane(choice.effect, sizes, least)
    ):
        return False
    # What was taken by evidence alone has to show by the weights of now, where that is
    # not enough.
    plan = search.plan
    if alone and plan.counts_evidence and not plan.evidence_alone:
        if search.error(current.score) > search.enough(search.start.score):
            return False
    endless = any(each.endless for each in KINDS[kind].parameters)
    replaces = all(KINDS[kind].parameter(n).neutral is None for n in choice.std)
    if (alone and endless) or not (endless or replaces):
        return True
    std, or_more = search.problem.widened(current, k)
    wide = replace(choice, std=choice.std | std)
    if endless:
        return is_significant(wide, alone, sizes)
    now = search.problem.dynamics.now(kind, at)
    return bool(or_more) or deviations_off(wide, now) > 1.0
