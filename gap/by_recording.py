"""Whether an effect is the same in all recordings, or in some of them only.

One value for all recordings explains none of them where they differ: a load that was
taken up between two of them, or a joint that was warm in one. Each recording is then
searched by itself, and what was found in one is fitted in the others. Effects are named
only if each is explained by itself: once one is not, others are searched no more,
unless a single effect would explain half of what one of them leaves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.by_part import pooled
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.fit import fit_effects
from makebreak.gap.problem import GapProblem, is_sane, rms
from makebreak.gap.result import (
    Differs,
    Estimate,
    GapResult,
    NamedEffect,
    Trust,
)
from makebreak.gap.search.choice import Selection
from makebreak.gap.search.trust import by_recording
from makebreak.gap.thresholds import CLOSED_SHARE_MIN, DIFFERS_SHARE, DIFFERS_Z
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, with_deviation

MOST_RECORDINGS = 6  # That are searched one by one.
EXPLAINED = ("no_gap", "not_judged", "gap_named", "ambiguous")
Key = tuple[str, tuple[str, ...]]  # Kind and place of an effect.
Values = Mapping[str, tuple[float, float]]  # {recording: (value, standard deviation)}


@dataclass(frozen=True, eq=False)
class Alone:
    """What a recording comes to by itself."""

    name: str
    problem: GapProblem
    selection: Selection
    result: GapResult


@dataclass(frozen=True, eq=False)
class Together:
    """What all recordings come to together, and what that says of each."""

    problem: GapProblem
    selection: Selection

    @property
    def names(self) -> list[str]:
        return list(dict.fromkeys(r.name for r in self.problem.recordings))

    def left(self) -> dict[str, float]:
        """{recording: rms of what its held-out rows leave}."""
        return {n: rms(self.selection.end.left[on]) for n, on in self._held().items()}

    def with_one_of_their_own(self) -> set[str]:
        """Recordings of which one candidate, with a value for each recording, would
        explain half, to first order, that it does not with the same value for all."""
        end, nuisances = self.selection.end, self.selection.nuisances
        screen, held = self.selection.screen(self.problem), self._held()
        of_row = self._of_row()

        def left(columns: np.ndarray) -> dict[str, float]:
            fit = screen.fit(columns)
            r = end.r - columns @ fit.c - nuisances.columns @ fit.b
            return {name: rms(r[on]) for name, on in held.items()}

        now = left(np.zeros((len(end.r), 0)))
        found = set()
        for c in self.problem.candidates(nuisances, end):
            for X in c.columns if not c.members else ():
                same = left(X)
                own = left(np.hstack([X * (of_row == n)[:, None] for n in self.names]))
                found |= {
                    n for n in held
                    if own[n] < (1.0 - CLOSED_SHARE_MIN) * min(now[n], same[n])
                }  # fmt: skip
        return found

    def values(self, name: str) -> dict[Key, dict[str, tuple[float, float]]]:
        """{(kind, place): {parameter: (value, deviation)}} in one of the recordings, to
        first order."""
        end = self.selection.end
        found: dict[Key, dict[str, tuple[float, float]]] = {}
        for (i, parameter), of in by_recording(self.problem, end).items():
            if name in of:
                found.setdefault(_key(end.effects[i]), {})[parameter] = of[name]
        return found

    def _of_row(self) -> np.ndarray:
        """(m,) the name of the recording of each row."""
        return np.array([r.name for r in self.problem.recordings])[self.problem.parts()]

    def _held(self) -> dict[str, np.ndarray]:
        """{recording: (m,) its rows that are held out; all where none is}."""
        of_row, train = self._of_row(), self.problem.train()
        found = {}
        for name in self.names:
            mine = of_row == name
            found[name] = mine & ~train if (mine & ~train).any() else mine
        return found


def may_differ(problem: GapProblem, fitted, result: GapResult) -> bool:
    """Whether recordings should be looked at one by one: they leave a gap together, or
    an effect, to first order, is another in each."""
    if len({r.name for r in problem.recordings}) < 2:
        return False
    if result.verdict == "gap_unnamed":
        return True
    values = by_recording(problem, fitted)
    return any(
        _apart(of, KINDS[fitted.effects[i].kind].parameter(name).neutral)
        for (i, name), of in values.items()
    )


def with_differences(
    result: GapResult, shared: Together, alone: Callable[[str], Alone]
) -> GapResult:
    """The result of all recordings together, corrected by what each is by itself.

    Effects that differ are named for the recordings in which they are, if each
    recording by itself is explained; otherwise the result says only that they differ.

    Args: shared: what recordings come to together. alone: judges one of them;
        DoesNotFit where it is too short by itself.
    """
    names = shared.names
    if len(names) > MOST_RECORDINGS:
        more = (
            f" Whether the {len(names)} recordings differ was not asked: give at most "
            f"{MOST_RECORDINGS} of them."
        )
        return replace(result, says=result.says + more)
    try:
        each = _searched(shared, alone)
    except DoesNotFit:
        return result
    told = [one for one in each if one.result.verdict in EXPLAINED]
    found = _found([one.result for one in told] + [result])
    together = {one.name: _together(one, result) for one in each if one not in told}
    if left_out := [n for n in names if n not in {one.name for one in each}]:
        together |= {name: shared.values(name) for name in left_out}
        is_not = next(one.name for one in each if one not in told)
        result = replace(
            result,
            says=f"{result.says} Not searched separately, since {is_not} is not "
            f"explained by itself either: {', '.join(left_out)}.",
        )
    values = {key: _values(effect, told, together) for key, effect in found.items()}
    differs = {
        key: d for key, effect in found.items()
        if (d := _difference(effect, values[key])) is not None
    }  # fmt: skip
    if not differs:
        return result
    words = " ".join(d.says for d in differs.values())
    if len(told) < len(names):
        return replace(
            result, says=f"{result.says} {words}", differs=tuple(differs.values())
        )
    effects = _effects(found, differs, each)
    gap = pooled([one.result.gap for one in each])
    is_tied = any(one.result.verdict == "ambiguous" for one in each)
    named = " ".join(e.says for e in effects)
    return replace(
        result,
        verdict="ambiguous" if is_tied else "gap_named",
        says=f"{words} {named} With each recording searched separately, the "
        f"held-out error falls from {gap.before:.3g} to {gap.after:.3g} times the "
        "noise.",
        effects=effects,
        gap=gap,
        unexplained=(),
        background=_largest([one.result.background for one in each]),
        series=[s for one in each for s in one.result.series],
        trust=_trust(each),
        nuisance_scene=(),
        differs=tuple(differs.values()),
    )


def _searched(shared: Together, alone: Callable[[str], Alone]) -> list[Alone]:
    """Recordings by themselves, in their order. The one that leaves most comes first.
    Once one is not explained effects are not named for recordings, and only those are
    searched that have an effect of their own."""
    left = shared.left()
    found: dict[str, Alone] = {}
    own: set[str] | None = None
    for name in sorted(left, key=lambda n: -left[n]):
        if own is not None and name not in own:
            continue
        found[name] = alone(name)
        if own is None and found[name].result.verdict not in EXPLAINED:
            own = shared.with_one_of_their_own()
    return [found[name] for name in shared.names if name in found]


def _found(each: Sequence[GapResult]) -> dict[Key, NamedEffect]:
    """{(kind, place): effect} of all that was named in some result, as it is in the
    first of these."""
    found: dict[Key, NamedEffect] = {}
    for one in each:
        for effect in one.effects:
            found.setdefault(_key(effect), effect)
    return found


def _key(effect: Effect | NamedEffect) -> Key:
    return effect.kind, tuple(effect.at)


def _of(one: Alone, key: Key) -> NamedEffect | None:
    """An effect as it was named in a recording."""
    return next((e for e in one.result.effects if _key(e) == key), None)


def _values(
    effect: NamedEffect, told: Sequence[Alone], together: Mapping[str, Mapping]
) -> dict[str, Values]:
    """{parameter: its values} in the recordings that tell it: as it was named, or
    fitted beside what was named there.

    Args: told: recordings that are explained by themselves. together: of the others,
        {(kind, place): {parameter: (value, deviation)}}.
    """
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for recording, of in together.items():
        for name, value in of.get(_key(effect), {}).items():
            found.setdefault(name, {})[recording] = value
    for one in told:
        if (named := _of(one, _key(effect))) is not None:
            fitted = {n: p for n, p in named.parameters.items() if p.fitted}
            here = {n: (p.value, p.std) for n, p in fitted.items()}
        else:
            here = _beside(one, effect.effect())
        for name, value in here.items():
            found.setdefault(name, {})[one.name] = value
    return dict(found)


def _together(one: Alone, result: GapResult):
    """{(kind, place): {parameter: (value, deviation)}} of what was named for all
    recordings, fitted to one of them."""
    start = [e.effect() for e in result.effects]
    if not start:
        return {}
    try:
        fit = fit_effects(one.problem, one.selection.screen(one.problem), start)
    except (ValueError, RuntimeError):  # A scene cannot have them.
        return {}
    sizes = one.problem.sizes
    return {
        _key(e): {n: (e.parameters[n], s) for n, s in std.items()}
        for e, std in zip(fit.effects, fit.std, strict=True)
        if is_sane(e, sizes, one.problem.least(e.kind, e.at))
    }


def _beside(one: Alone, effect: Effect) -> dict[str, tuple[float, float]]:
    """{parameter: (value, deviation)} of an effect beside what was named."""
    start = [e.effect() for e in one.result.effects] + [effect]
    # Where an effect is none, how far off its load is, say, means nothing.
    free = [p.name for p in KINDS[effect.kind].parameters if p.neutral is not None]
    fixed: list[Sequence[str]] = [[] for _ in start]
    fixed[-1] = [name for name in effect.parameters if name not in free]
    try:
        fit = fit_effects(one.problem, one.selection.screen(one.problem), start, fixed)
    except (ValueError, RuntimeError):  # A scene cannot have it there.
        return {}
    least = one.problem.least(effect.kind, effect.at)
    if not is_sane(fit.effects[-1], one.problem.sizes, least):
        return {}  # It says nothing here.
    value, std = fit.effects[-1].parameters, fit.std[-1]
    return {n: (value[n], std[n]) for n in free if n in std}


def _apart(values: Values, neutral: float | None) -> float:
    """By how many deviations the two values are apart that are the most; 0 where no two
    differ by more than laws are good for, or the data do not tell."""
    most = 0.0
    if neutral is None:
        return most
    for x, s in values.values():
        for y, t in values.values():
            far = DIFFERS_SHARE * max(abs(x - neutral), abs(y - neutral))
            std = float(np.hypot(s, t))
            if np.isfinite(std) and std > 0.0 and abs(x - y) > far:
                most = max(most, abs(x - y) / std)
    return most if most > DIFFERS_Z else 0.0


def _difference(effect: NamedEffect, values: Mapping[str, Values]) -> Differs | None:
    """What is to be said of an effect that differs; None: it does not."""
    kind = KINDS[effect.kind]
    sizes = {
        p.name: apart for p in kind.parameters
        if (apart := _apart(values.get(p.name, {}), p.neutral)) > 0.0
    }  # fmt: skip
    if not sizes:
        return None
    name = max(sizes, key=lambda n: sizes[n])
    unit = effect.parameters[name].unit
    parts = [
        f"{with_deviation(x, s)} {unit}".strip() + f" in {recording}"
        for recording, (x, s) in values[name].items()
    ]
    says = (
        f"The {name.replace('_', ' ')} of {effect.kind} at {', '.join(effect.at)} is "
        f"{', '.join(parts[:-1])} and {parts[-1]}: it is not the same in all "
        "recordings."
    )
    of = {r: Estimate(x, s, unit) for r, (x, s) in values[name].items()}
    return Differs(effect.kind, tuple(effect.at), name, of, says)


def _effects(
    found: Mapping[Key, NamedEffect],
    differs: Mapping[Key, Differs],
    each: Sequence[Alone],
) -> list[NamedEffect]:
    """What is named: of the robot where recordings do not contradict it, else of the
    recordings in which it is."""
    out = []
    for key in found:
        there = [(one, n) for one in each if (n := _of(one, key)) is not None]
        if key in differs:
            for one, named in there:
                says = f"In {one.name}: {named.says[:1].lower()}{named.says[1:]}"
                out.append(replace(named, says=says, recordings=(one.name,)))
            continue
        if there:
            out.append(min((n for _, n in there), key=_surest))
    return out


def _surest(named: NamedEffect) -> float:
    """The smallest relative deviation of the parameters that were fitted."""
    return min(
        (
            p.std / max(abs(p.value), 1e-12)
            for p in named.parameters.values()
            if p.fitted
        ),
        default=np.inf,
    )


def _largest(each: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Of each nuisance, the value that is the farthest off."""
    names = {n for values in each for n in values}
    return {
        n: max((v[n] for v in each if n in v), key=abs)
        for n in sorted(names, key=list(each[0]).index if each[0] else None)
    }


def _trust(each: Sequence[Alone]) -> list[Trust]:
    """Of each parameter what recordings say of it, one by one."""
    found: dict[tuple, Trust] = {}
    for one in each:
        for t in one.result.trust:
            key = (t.kind, t.at, t.parameter)
            old = found.get(key)
            here = {one.name: t.value}
            found[key] = replace(
                t if old is None else old,
                recordings=here if old is None else {**old.recordings, **here},
            )
    return list(found.values())
