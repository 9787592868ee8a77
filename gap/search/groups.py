"""Groups: one kind at all joints, or channels, as one candidate.

"All seven joints have friction" may take off most of the gap where no joint by itself
takes off enough. The members are fitted together, and each must earn its place. Where
friction, a drive's gain and a rotor are off together, each alone explains so much that
the first ones to be added stand for the others: fitted at once each takes its own.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Candidate, rms
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked, rank
from makebreak.gap.thresholds import (
    CHANNEL_GAIN,
    FREE_TOLERANCE,
    MEMBER_GAIN,
    MEMBER_Z,
    MEMBERS_MIN,
    UNEXPLAINED_RMS,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect

_PLACES = ("joint", "actuator", "channel", "drive", "pair")
_ALIKE = ("joint", "pair")  # Where one value may hold for several places.
# Units of what a joint may have beside what all joints have.
_FORCES = ("N m", "N m s/rad", "N m/rad", "kg m2")


def groups_of(found: Sequence[Candidate]) -> list[Candidate]:
    """Each kind with one parameter, at all of its joints or channels at once."""
    by_kind: dict[str, list[Candidate]] = {}
    for c in found:
        single = len(c.columns) == 1 and c.columns[0].shape[1] == 1 and len(c.at) == 1
        single = single and "." in c.at[0]  # Not all joints of a model, with one value.
        if KINDS[c.kind].at in _PLACES and single and not c.fixed:
            by_kind.setdefault(c.kind, []).append(c)
    return [
        Candidate(
            kind, tuple(m.at[0] for m in members), len(members),
            (np.hstack([m.columns[0] for m in members]),), (), members=tuple(members),
        )
        for kind, members in by_kind.items()
        if len(members) >= MEMBERS_MIN
    ]  # fmt: skip


def _as_one(some: Sequence[Candidate]) -> Candidate:
    """Candidates of one kind as one of one value, at all their places."""
    return replace(
        some[0], at=tuple(at for m in some for at in m.at),
        columns=(np.sum([m.columns[0] for m in some], axis=0),),
        least={name: max(m.least.get(name, -np.inf) for m in some)
               for name in some[0].least},
    )  # fmt: skip


def of_more_kinds(
    search: Comparison, screen: Screen, free: Sequence[Candidate], kind: str
) -> Ranked | None:
    """A kind at many joints with all other groups of forces at joints, and what else
    earns its place beside these, less the members that do not; None where that is the
    kind alone."""
    groups = {g.kind: g for g in groups_of(free)}
    if kind not in groups:
        return None
    own = groups.pop(kind)
    members = [
        *own.members,
        *(m for g in groups.values()
          if KINDS[g.kind].parameters[0].unit in _FORCES for m in g.members),
    ]  # fmt: skip
    there = {id(m) for m in members}
    others = [c for c in free if not c.members and id(c) not in there]
    wide = screen.beside(_columns_of(members)[0], FREE_TOLERANCE)
    score = search.error(wide.evaluate(wide.r).score)
    while True:
        best = next((x for x in rank(wide, others, search.sizes) if x.valid), None)
        if best is None:
            break
        less = search.error(best.fit.score)
        if not less < (1.0 - search.plan.least_gain) * score:
            break
        of, k = best.candidate, best.alternative
        members.append(
            replace(of, columns=(best.columns,), to_parameters=(of.to_parameters[k],))
        )
        others = [c for c in others if c is not of]
        wide, score = wide.beside(best.columns, FREE_TOLERANCE), less
    wider = _pruned(search, screen, own, members)
    if wider is None or {m.kind for m in _parts(wider.candidate)} == {kind}:
        return None
    return wider


def with_pruned_groups(
    search: Comparison, screen: Screen, ranked: Sequence[Ranked]
) -> list[Ranked]:
    """Candidates, the best first, with groups reduced to the members that earn their
    place, or to one value for all of them; a group that is left at fewer than two
    places is dropped."""
    out = [each for each in ranked if not each.candidate.members]
    there = {(r.candidate.kind, frozenset(r.candidate.at)) for r in out}
    for of in (r.candidate for r in ranked if r.candidate.members):
        smaller = _pruned(search, screen, of, of.members)
        if smaller is None:
            continue
        new = smaller.candidate  # One value for a surface's pairs may be there already.
        if new.members or (new.kind, frozenset(new.at)) not in there:
            out.append(smaller)
    return sorted(out, key=lambda r: r.fit.score)


def _pruned(
    search: Comparison, screen: Screen, group: Candidate, members: Sequence[Candidate]
) -> Ranked | None:
    """A group with those of these members that earn their place."""
    members = _with_one_value(search, screen, members)
    while sum(len(m.at) for m in members) >= MEMBERS_MIN:
        k = _needless_member(search, screen, members)
        if k is None:
            break
        members = members[:k] + members[k + 1 :]
    if sum(len(m.at) for m in members) < MEMBERS_MIN:
        return None
    members = _with_one_value(search, screen, members)
    X, _ = _columns_of(members)
    fit = screen.fit(X)
    candidate = members[0] if len(members) == 1 else replace(
        group,
        at=tuple(at for m in members for at in m.at),
        size=sum(m.size for m in members),
        columns=(X,),
        members=tuple(members),
    )  # fmt: skip
    found = _beside_gains(search, candidate.effects(0, fit.c))
    sane = candidate.is_sane(found, search.sizes)
    return Ranked(candidate, fit, found, True, 0) if sane else None


def _with_one_value(
    search: Comparison, screen: Screen, members: Sequence[Candidate]
) -> list[Candidate]:
    """The members, those of a kind that joints may have alike as one with one value,
    unless there is evidence for a value for each. Where much is left with all of them,
    nothing says that they are alike."""
    members = list(members)
    left = screen.fit(_columns_of(members)[0]).held_out
    if not search.tells_by_evidence or left > UNEXPLAINED_RMS:
        return members
    for kind in dict.fromkeys(m.kind for m in members if KINDS[m.kind].at in _ALIKE):
        some = [m for m in members if m.kind == kind]
        if len(some) < MEMBERS_MIN:
            continue
        one = _as_one(some)
        alike = [one if m is some[0] else m for m in members
                 if m is some[0] or m.kind != kind]  # fmt: skip
        each, whole = (_columns_of(of)[0] for of in (members, alike))
        if not search.evidence_by_columns(screen, each, whole) > 0.0:
            members = alike
    return members


def _parts(candidate: Candidate) -> tuple[Candidate, ...]:
    return candidate.members or (candidate,)


def _beside_gains(search: Comparison, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Effects as columns of equations have them, which are in units of what a drive is
    told: with more of a gain at their joint they are as much larger."""
    more: dict[str, float] = {}
    for e in effects if search.problem.by_equations else ():
        if KINDS[e.kind].path == "kp":
            ((name, kp),) = e.parameters.items()
            more[e.at[0]] = kp / search.problem.dynamics.now(e.kind, e.at)[name]
    out = []
    for e in effects:
        entry, times = KINDS[e.kind], more.get(e.at[0], 1.0)
        if entry.path != "kp" and entry.parameters[0].unit in _FORCES:
            p = {name: times * x for name, x in e.parameters.items()}
            e = Effect(e.kind, e.at, p)
        out.append(e)
    return tuple(out)


def _needless_member(
    search: Comparison, screen: Screen, members: Sequence[Candidate]
) -> int | None:
    """The first member that must go, from that on which leaves least without it: one
    whose value is impossible, else one without which no channel is much worse. None:
    all stay."""
    held = ~search.train
    X, of = _columns_of(members)
    fit, without = screen.fit(X), screen.without_each(X, of)
    left = screen.fit_nuisances(screen.r - X @ fit.c)[1]
    z = np.abs(fit.c) / np.maximum(fit.c_std, 1e-300)
    own = [m.effects(0, fit.c[of == k]) for k, m in enumerate(members)]
    order = np.argsort([rms(each[held]) for each in without]).tolist()
    for k in order:
        if not members[k].is_sane(own[k], search.sizes):
            return k
    rows = [held & (search.channel == c) for c in np.unique(search.channel[held])]
    for k in order:
        gains = [1.0 - rms(left[x]) / max(rms(without[k][x]), 1e-12) for x in rows]
        clear = z[of == k].max() >= MEMBER_Z
        clear = clear and not search.problem.is_within_tolerance(own[k][0])
        if max(gains, default=0.0) < (MEMBER_GAIN if clear else CHANNEL_GAIN):
            return k
    return None


def _columns_of(members: Sequence[Candidate]) -> tuple[np.ndarray, np.ndarray]:
    """(m, k) columns of all members, and the number (k,) of the member of each."""
    each = [m.columns[0] for m in members]
    sizes = [x.shape[1] for x in each]
    return np.hstack(each), np.repeat(np.arange(len(each)), sizes)
