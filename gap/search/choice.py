"""The effects that a search has chosen, and whether one of them is certain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, Fitted, GapProblem, Nuisances
from makebreak.gap.result import Considered
from makebreak.gap.search.screen import Ranked
from makebreak.gap.thresholds import (
    MEMBER_Z,
    UNBOUNDED_GAIN,
    UNBOUNDED_GAIN_BESIDE,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.sizes import Sizes, range_of


def units_of(chosen: Sequence["Choice"]) -> list[list["Choice"]]:
    """What was added at once: groups, one kind at several places, and single effects,
    in the order in which they were added."""
    units: dict[object, list[Choice]] = {}
    for k, choice in enumerate(chosen):
        key = choice.effect.kind if choice.in_group else k
        units.setdefault(key, []).append(choice)
    return list(units.values())


class Trial(NamedTuple):
    """A candidate that was fitted exactly, beside all that was chosen before it."""

    fit: Fitted
    ranked: Ranked


@dataclass(frozen=True, eq=False)
class Choice:
    """One effect as chosen.

    std: standard deviations of its parameters. before, after: held-out error without
    and with it. runner_up, margin: the best other candidate, and by which share its
    error was larger; why it was not chosen, beside that. ties: effects that explain
    the data as well. fixed: parameters that a fit leaves at neutral. size: parameters
    that a fit chooses. in_group: one of several places of its kind that were added at
    once. of_two: it and its rival are both needed. paired: it was added at once with an
    effect of another kind. or_more: parameters that may as well be any larger.
    needed_beside: (kind, place) of rivals beside which it is needed, so that they are
    no ties.
    """

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
    needed_beside: tuple[tuple[str, tuple[str, ...]], ...] = ()
    why: str = ""


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen effects, in the order in which they were added.

    start: the fit without effects; end: with all. nuisances: by the weights of the end.
    table: the candidates of the first step. beyond: (name, tolerances) of nuisances
    that would go beyond their limit if they could. far: whether the nuisances, all
    together, are implausible.
    """

    choices: tuple[Choice, ...]
    start: Fitted
    end: Fitted
    nuisances: Nuisances
    table: tuple[Considered, ...] = ()
    beyond: tuple[tuple[str, float], ...] = ()
    far: bool = False

    def screen(self, problem: GapProblem) -> Screen:
        """With which the end was fitted."""
        n, scale = self.nuisances, max(self.end.fit.train, 1.0) * problem.correlation
        return Screen(self.end.r, n.columns, n.prior, problem.train(), scale, n.reach)

    def effects(self) -> list[Effect]:
        return [c.effect for c in self.choices]


def refreshed(chosen: Sequence[Choice], fitted: Fitted) -> list[Choice]:
    """The choices with the parameters of a fit of all of them."""
    return [
        replace(c, effect=effect, std=std, after=fitted.score if k == len(chosen) - 1
                else c.after)
        for k, (c, effect, std) in enumerate(
            zip(chosen, fitted.effects, fitted.std, strict=True)
        )
    ]  # fmt: skip


def fixed_parameters(chosen: Sequence[Choice]) -> list[tuple[str, ...]]:
    """For each choice, the parameters that a fit leaves as they are."""
    return [c.fixed for c in chosen]


def places(chosen: Sequence[Choice]) -> set[tuple[str, tuple[str, ...]]]:
    """(kind, place) of all that is chosen."""
    return {(c.effect.kind, tuple(c.effect.at)) for c in chosen}


def pair_of(a: Ranked, b: Ranked, effects: Sequence[Effect]) -> Ranked:
    """Two candidates that are added at once, as these effects."""
    one, two = a.candidate, b.candidate
    both = Candidate(
        f"{one.kind} and {two.kind}", (*one.at, *two.at), one.size + two.size,
        (np.hstack([a.columns, b.columns]),), (), members=(one, two),
    )  # fmt: skip
    return Ranked(both, a.fit, tuple(effects), True, 0)


def complexity(candidate: Candidate) -> int:
    """Twice the number of parameters, by which the simplest is taken. A kind some of
    whose parameters are left at neutral counts little less than all of it, and one that
    many joints have with one value little more than at one of them."""
    all_of_them = candidate.size + len(candidate.fixed)
    is_shared = len(candidate.at) > 1 and not candidate.members
    return 2 * all_of_them - bool(candidate.fixed) + is_shared


def why_not(other: Candidate, chosen: Candidate) -> str:
    """Why one that leaves about as little as what is chosen is not chosen."""
    theirs, ours = other.size, chosen.size
    if theirs > ours:
        return f"it has {theirs} parameters, the named one {ours}"
    if theirs < ours:
        return "there is more evidence for the named one"
    if complexity(other) > complexity(chosen):
        return "it is the more general law, and nothing shows more than the named one"
    if other.kind == chosen.kind:
        return "the data hardly tell the two places apart"
    return "the data hardly tell the two apart"


def is_possible(fit: Fitted, of: Ranked, first: int, sizes: Sizes | None) -> bool:
    """Whether a fit ended at values that the scene and robots can have. first: index of
    the candidate's first effect in the fit."""
    sane = of.candidate.is_sane(fit.effects[first:], sizes)
    return bool(np.isfinite(fit.score)) and sane


def is_significant(
    choice: Choice, alone: bool = True, sizes: Sizes | None = None
) -> bool:
    """Whether an effect is certain: at least one parameter that makes it an effect is
    off neutral by more than its deviation and has a finite interval, and so have half
    of all parameters. For a kind whose parameters may end anywhere held-out rows may
    show that it is there, whatever its intervals (UNBOUNDED_GAIN).

    Args: alone: whether it is the only effect.
    """
    kind = KINDS[choice.effect.kind]
    gain = UNBOUNDED_GAIN if alone else UNBOUNDED_GAIN_BESIDE
    helps = choice.after < (1.0 - gain) * choice.before
    if helps and any(each.endless for each in kind.parameters):
        return True
    clear, with_neutral, unknown, n = 0, 0, 0, 0
    for each in kind.parameters:
        value = choice.effect.parameters.get(each.name)
        spread = choice.std.get(each.name)
        if value is None or spread is None or each.name in choice.fixed:
            continue
        if each.neutral is None and each.valid == ">= 0" and value == 0.0:
            continue  # At its limit it is as good as fixed, and has no interval.
        n += 1
        low, high = range_of(each, choice.effect.at, sizes)
        infinite = not spread < high - low
        unknown += infinite
        if each.neutral is not None:
            with_neutral += 1
            clear += abs(value - each.neutral) > spread and not infinite
    return 2 * unknown < max(n, 1) and (clear > 0 or with_neutral == 0)


def deviations_off(choice: Choice, now: Mapping[str, float]) -> float:
    """By how many of its deviations the surest parameter is off what the scene has now;
    infinite if the scene does not say what that is."""
    known = [n for n in choice.std if n in now and n not in choice.fixed]
    off = [
        abs(choice.effect.parameters[n] - now[n]) / max(choice.std[n], 1e-300)
        for n in known
    ]
    return max(off, default=np.inf)


def is_clearly_off(choice: Choice) -> bool:
    """Whether a parameter is MEMBER_Z deviations off its neutral value."""
    return any(
        abs(choice.effect.parameters[p.name] - p.neutral) > MEMBER_Z * spread
        for p in KINDS[choice.effect.kind].parameters
        if p.neutral is not None and (spread := choice.std.get(p.name, np.inf)) < np.inf
    )


def is_sure(choice: Choice) -> bool:
    """Whether a number of an effect is MEMBER_Z deviations off its neutral value, or,
    of one that has none, off 0."""
    return any(
        abs(choice.effect.parameters[p.name] - (p.neutral or 0.0)) > MEMBER_Z * spread
        for p in KINDS[choice.effect.kind].parameters
        if (spread := choice.std.get(p.name, np.inf)) < np.inf
    )


def identifiable(fit: Fitted, sizes: Sizes | None, k: int = -1) -> int:
    """Number of parameters of effect k of a fit of which the data tell anything."""
    last, std = fit.effects[k], fit.std[k]
    return sum(
        std.get(p.name, np.inf) < high - low
        for p in KINDS[last.kind].parameters
        if p.name in last.parameters
        for low, high in [range_of(p, last.at, sizes)]
    )


def uses_all_parameters(fit: Fitted, k: int = -1) -> bool:
    """Whether each parameter of effect k of a fit is two deviations off neutral: else
    it is another, smaller effect under this name. Of a vector one component is enough;
    what nothing shows is no parameter of it; and the mass of a load may be uncertain,
    of which only the moment shows."""
    last, std = fit.effects[k], fit.std[k]
    clear: dict[str, bool] = {}
    placed = False
    for p in KINDS[last.kind].parameters:
        is_component = p.name[-1] in "xyz"
        placed |= is_component and p.neutral is None
        if p.neutral is None or not std.get(p.name, np.inf) < np.inf:
            continue
        off = abs(last.parameters[p.name] - p.neutral) > 2.0 * std[p.name]
        vector = p.name[:-1] if is_component else p.name
        clear[vector] = clear.get(vector, False) or off
    return placed or all(clear.values())
