"""Which effects a scene lacks: forward by held-out error, then backward."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from makebreak.gap.fit import EVALUATIONS, Fitted, Model, fit_effects, wander
from makebreak.gap.screen import NESTED, Candidate, Ranked, is_sane, rank
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.systems.numerics.selection import (
    NESTED_GAIN,
    SAME,
    Screen,
    is_plausible,
    paired,
    simplest,
)

MOST_EFFECTS = 4
FINALISTS, FINALIST_RUNS = 4, 80  # Searched without slopes before one is chosen.
FLOOR = 1.15  # Rms over noise that noise alone may leave (its estimate is that good).
# Laws are approximations (how dry friction turns round, how commands are held): errors
# that differ by less than this share of the whole gap do not tell two models apart.
PRECISION = 0.015
# A rival that needs more parameters than these beyond the chosen effect's, to say the
# same, is a coincidence: it contains the effect as a special case.
MORE = 1
# Two models that differ block by block by more than chance: less than this p-value.
CHANCE = 0.01


@dataclass(frozen=True, eq=False)
class Choice:
    """One effect as chosen. before, after: held-out error without and with it."""

    effect: Effect
    std: dict[str, float]
    before: float
    after: float
    runner_up: str
    margin: float
    ties: tuple[Effect, ...]
    fixed: tuple[str, ...]
    size: int


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen effects, in the order added. start: with no effect; end: with all."""

    choices: tuple[Choice, ...]
    start: Fitted
    end: Fitted
    table: tuple[dict, ...] = field(default=())


def select(
    model: Model,
    nuisance: np.ndarray,
    prior: np.ndarray,
    found: Sequence[Candidate] | Callable[[Fitted], Sequence[Candidate]],
    say: Callable[[str], None] = lambda text: None,
    most: int = MOST_EFFECTS,
) -> Selection:
    """Greedy forward selection with a refit of all after each addition; then whatever
    is not needed any more is dropped.

    Args: found: the candidates; or what gives them anew for what is there already,
        where columns are no longer the same once an effect is added.
    """
    train = model.train()
    plain = Screen(model.base(), nuisance, prior, train)
    start = current = fit_effects(model, plain, ())
    chosen: list[dict] = []
    table: list[dict] = []
    while found and len(chosen) < most and needs_more(current, prior):
        step = _forward(model, nuisance, prior, found, chosen, current, start, say)
        if not chosen:
            table = step["table"]
        if step.get("fitted") is None:
            break
        chosen.append(step)
        current = _settled(model, nuisance, prior, chosen, step["fitted"])
        for choice, effect in zip(chosen, current.effects, strict=True):
            choice["effect"] = effect  # The next are fitted from here.
    chosen, current = _backward(model, nuisance, prior, chosen, current, start)
    if chosen:  # At last, against what all of them leave.
        screen = Screen(current.r, nuisance, prior, train, current.fit.train)
        fixed = [c["fixed"] for c in chosen]
        current = fit_effects(model, screen, current.effects, fixed)
        for k, choice in enumerate(chosen):
            choice["ties"] = _still_tied(model, screen, chosen, current, k, start)
    choices = tuple(
        Choice(
            effect, std, c["before"], c["after"], c["runner_up"], c["margin"],
            c["ties"], c["fixed"], c["size"],
        )
        for c, effect, std in zip(chosen, current.effects, current.std, strict=True)
    )  # fmt: skip
    return Selection(choices, start, current, tuple(table))


def _settled(model, nuisance, prior, chosen, current: Fitted) -> Fitted:
    """A fit that was stopped short, as all of a short list are, carried on: what it
    has not reached yet would be looked for in other effects."""
    fixed = [c["fixed"] for c in chosen]
    jumps = getattr(model, "jumps", False)
    steps = 2 * int(getattr(model, "evaluations", EVALUATIONS))
    for far in (False, True) if jumps else (False,):
        if not needs_more(current, prior):
            break
        screen = Screen(current.r, nuisance, prior, model.train(), current.fit.train)
        effects = current.effects
        if jumps:
            effects = wander(model, screen, effects, fixed, far)
        more = fit_effects(model, screen, effects, fixed, steps)
        if more.fit.train < current.fit.train:
            current = more
            chosen[-1]["after"] = more.score
    return current


def needs_more(fit: Fitted, prior: np.ndarray) -> bool:
    """Whether held-out rows are worse than noise, or the background is beyond what its
    tolerance allows."""
    return fit.fit.held_out > FLOOR or not is_plausible(fit.b, prior)


def _forward(model, nuisance, prior, found, chosen, current, start, say) -> dict:
    train = model.train()
    if callable(found):
        found = found(current)
    taken = {(c["effect"].kind, tuple(c["effect"].at)) for c in chosen}
    open_ = [c for c in found if (c.kind, c.at) not in taken]
    screen = Screen(current.r, nuisance, prior, train)
    ranked = _sane(rank(screen, open_))
    if not ranked:
        return {"table": []}
    # What even the best leaves is no noise: nuisances are weighed against it.
    scale = 1.0
    for _ in range(2):
        if ranked[0].fit.train < 1.2 * scale and scale < 1.2 * ranked[0].fit.train:
            break
        scale = max(ranked[0].fit.train, 1.0)
        screen = Screen(current.r, nuisance, prior, train, scale)
        ranked = _sane(rank(screen, open_))
    base = screen.judge(current.r)
    table = [
        {"kind": r.candidate.kind, "at": list(r.candidate.at),
         "score": r.fit.score / max(base.score, 1e-12),
         "parameters": dict(r.effect.parameters)}
        for r in ranked[:15]
    ]  # fmt: skip
    short = _shortlist(ranked, base.score)
    if not short:
        return {"table": table}
    sound = _fit_each(model, screen, chosen, short, say)
    for _ in range(2 if len(prior) else 0):
        least = min((f.fit.train for f, _ in sound), default=scale)
        if not max(least, 1.0) < 0.8 * scale:
            break
        # Exactly fitted less is left: nuisances are weighed against that.
        scale = max(least, 1.0)
        screen = Screen(current.r, nuisance, prior, train, scale)
        base = screen.judge(current.r)
        sound = _fit_each(model, screen, chosen, [r for _, r in sound], say, sound)
    if not sound:
        return {"table": table}
    blur = PRECISION * start.score

    floor = getattr(model, "least_error", 0.0)

    def error(score: float) -> float:
        return float(np.hypot(max(score, floor), blur))

    errors = [error(f.score) for f, _ in sound]
    sizes = [r.candidate.size for _, r in sound]
    pick = simplest(errors, sizes, SAME)
    fit, best = sound[pick]
    # Bodies whose origins coincide: the outermost, as loads and forces mostly are.
    for k, (other, r) in enumerate(sound):
        same = (r.candidate.kind, r.candidate.size) == (
            best.candidate.kind, best.candidate.size,
        )  # fmt: skip
        if same and error(other.score) <= 1.002 * error(fit.score):
            if found.index(r.candidate) > found.index(best.candidate):
                pick, fit, best = k, other, r
    # A model inside a bigger one stays unless the bigger gains clearly.
    for k, (inner, r) in enumerate(sound):
        inside = r.candidate.kind in NESTED.get(best.candidate.kind, ())
        near = error(inner.score) <= (1.0 + NESTED_GAIN) * error(fit.score)
        if inside and near and r.candidate.at == best.candidate.at:
            pick, fit, best = k, inner, r
            break
    if not error(fit.score) < (1.0 - _least_gain(model)) * error(base.score):
        return {"table": table}
    others = [(f, r) for k, (f, r) in enumerate(sound) if k != pick]
    ties = tuple(
        f.effects[-1]
        for f, r in others
        if error(f.score) <= (1.0 + SAME) * error(fit.score)
        and best.candidate.kind not in NESTED.get(r.candidate.kind, ())
        and not (r.candidate.kind == best.candidate.kind)
        and r.candidate.size <= best.candidate.size + MORE
        and (
            paired(f.left, fit.left, train) > CHANCE or max(f.score, fit.score) < floor
        )
        and _is_used(f)
    )
    runner = min(others, key=lambda o: o[0].score, default=None)
    return {
        "table": table,
        "fitted": fit,
        "effect": fit.effects[-1],
        "fixed": tuple(best.candidate.fixed),
        "size": best.candidate.size,
        "before": base.score,
        "after": fit.score,
        "ties": ties,
        "runner_up": runner[1].candidate.name if runner else "",
        "margin": runner[0].score / fit.score - 1.0 if runner else np.inf,
    }


def _fit_each(
    model, screen, chosen, short, say, known=()
) -> list[tuple[Fitted, Ranked]]:
    """Each of the short list with what is chosen already; those that make sense.

    Args: known: fits of the same, from where to go on.
    """
    sound = []
    for k, each in enumerate(short):
        trial = [*[c["effect"] for c in chosen], each.effect]
        if known:
            trial = list(known[k][0].effects)
        fixed = [*[c["fixed"] for c in chosen], each.candidate.fixed]
        try:
            fit = fit_effects(model, screen, trial, fixed)
        except ValueError:
            continue
        say(f"  {each.candidate.name}: {fit.score:.3g}")
        if is_sane(fit.effects[-1]) and np.isfinite(fit.score):
            sound.append((fit, each))
    if known or not getattr(model, "jumps", False):
        return sound
    # The best few once more, without slopes: else the one whose fit got stuck loses.
    best = sorted(range(len(sound)), key=lambda k: sound[k][0].score)[:FINALISTS]
    for k in best if sound and sound[best[0]][0].score > FLOOR else []:
        fit, each = sound[k]
        fixed = [*[c["fixed"] for c in chosen], each.candidate.fixed]
        try:
            effects = wander(model, screen, fit.effects, fixed, most=FINALIST_RUNS)
            better = fit_effects(model, screen, effects, fixed)
        except ValueError:
            continue
        if better.fit.train < fit.fit.train and is_sane(better.effects[-1]):
            sound[k] = better, each
            say(f"  {each.candidate.name}: {better.score:.3g}")
    return sound


def _still_tied(model, screen, chosen, current, k: int, start) -> tuple[Effect, ...]:
    """Rivals of an effect that do as well as it among all the others."""
    train, blur = model.train(), PRECISION * start.score
    fixed = [c["fixed"] for c in chosen]
    tied = []
    for rival in chosen[k]["ties"] if len(chosen) > 1 else ():
        trial = [*current.effects[:k], rival, *current.effects[k + 1 :]]
        held = [*fixed[:k], (), *fixed[k + 1 :]]
        try:
            fit = fit_effects(model, screen, trial, held)
        except ValueError:
            continue
        near = np.hypot(fit.score, blur) <= (1.0 + SAME) * np.hypot(current.score, blur)
        if near and paired(fit.left, current.left, train) > CHANCE:
            tied.append(fit.effects[k])
    return tuple(tied) if len(chosen) > 1 else chosen[k]["ties"]


def _is_used(fit: Fitted) -> bool:
    """Whether each parameter of the last effect tells: else it is another, smaller
    effect under its name."""
    last, std = fit.effects[-1], fit.std[-1]
    for each in KINDS[last.kind].parameters:
        if each.neutral is not None and each.name in std:
            off = abs(last.parameters[each.name] - each.neutral)
            if not off > 2.0 * std[each.name]:
                return False
    return True


def _least_gain(model: Model) -> float:
    """What an effect must take off the error, as a share of it."""
    return getattr(model, "least_gain", NESTED_GAIN)


def _sane(ranked: list[Ranked]) -> list[Ranked]:
    return [r for r in ranked if r.valid]


def _shortlist(ranked: list[Ranked], base: float) -> list[Ranked]:
    """Those worth an exact fit: near the best, at most two of a kind and size; and of
    each kind that the catalogue says to be confused with the best, the best place."""
    best = ranked[0].fit.score
    if best > 0.95 * base:
        return []
    short: list[Ranked] = []
    for each in ranked:
        of_kind = sum(
            (r.candidate.kind, r.candidate.size)
            == (each.candidate.kind, each.candidate.size)
            for r in short
        )
        near = each.fit.score < max(1.6 * best, best + 0.15 * (base - best))
        if near and of_kind < 2 and len(short) < 7:
            short.append(each)
    there = {r.candidate.kind for r in short}
    first = ranked[0].candidate.kind
    for each in ranked:
        kind = each.candidate.kind
        alike = kind in KINDS[first].confused_with or first in KINDS[kind].confused_with
        if alike and kind not in there:
            short.append(each)
            there.add(kind)
    return short


def _backward(model, nuisance, prior, chosen, current, start):
    """Drops effects without which the error hardly grows, the least needed first."""
    while len(chosen) > 1:
        screen = Screen(current.r, nuisance, prior, model.train(), current.fit.train)
        now = screen.judge(current.r).score
        without: list[Fitted | None] = []
        for k in range(len(chosen)):
            rest = [e for i, e in enumerate(current.effects) if i != k]
            fixed = [c["fixed"] for i, c in enumerate(chosen) if i != k]
            try:
                without.append(fit_effects(model, screen, rest, fixed, 5))
            except ValueError:  # What is left would be no scene.
                without.append(None)
        k = int(np.argmin([w.score if w else np.inf for w in without]))
        smaller = without[k]
        if smaller is None:
            break
        blur = PRECISION * start.score
        least = (1.0 - _least_gain(model)) * np.hypot(smaller.score, blur)
        if np.hypot(now, blur) < least:
            break
        chosen = [c for i, c in enumerate(chosen) if i != k]
        current = smaller
    return chosen, current
