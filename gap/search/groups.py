"""Groups: one kind at all joints, or channels, as one candidate.

"All seven joints have friction" may take off most of the gap where no joint by itself
takes off enough. The members are fitted together, and each must earn its place.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from makebreak.gap.numerics.selection import LinearFit, Screen
from makebreak.gap.problem import Candidate, rms
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import Ranked
from makebreak.gap.thresholds import (
    CHANNEL_GAIN,
    MEMBER_GAIN,
    MEMBER_Z,
    MEMBERS_MIN,
)
from makebreak.models.effects import KINDS

_PLACES = ("joint", "actuator", "channel", "drive")


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


def with_pruned_groups(
    search: Comparison, screen: Screen, ranked: Sequence[Ranked]
) -> list[Ranked]:
    """Candidates, the best first, with groups reduced to the members that earn their
    place; a group that is left with fewer than two members is dropped."""
    out = []
    for each in ranked:
        if not each.candidate.members:
            out.append(each)
        elif (smaller := _pruned(search, screen, each)) is not None:
            out.append(smaller)
    return sorted(out, key=lambda r: r.fit.score)


def _pruned(search: Comparison, screen: Screen, group: Ranked) -> Ranked | None:
    members = list(group.candidate.members)
    while len(members) >= MEMBERS_MIN:
        k = _needless_member(search, screen, members)
        if k is None:
            break
        members = members[:k] + members[k + 1 :]
    if len(members) < MEMBERS_MIN:
        return None
    X, fit, _ = _fit(screen, members)
    candidate = replace(
        group.candidate,
        at=tuple(at for m in members for at in m.at),
        size=len(members),
        columns=(X,),
        members=tuple(members),
    )
    found = candidate.effects(0, fit.c)
    return Ranked(candidate, fit, found, True, 0) if candidate.is_sane(found) else None


def _needless_member(
    search: Comparison, screen: Screen, members: Sequence[Candidate]
) -> int | None:
    """The first member that must go: one whose value is impossible, else, from the
    least significant one on, one without which no channel is much worse. None: all
    stay."""
    held = ~search.train
    _, fit, r = _fit(screen, members)
    left = screen.fit_nuisances(r)[1]
    z = np.abs(fit.c) / np.maximum(fit.c_std, 1e-300)
    for k, m in enumerate(members):
        if not m.is_sane([m.effects(0, fit.c[[k]])[0]]):
            return k
    for k in np.argsort(z).tolist():
        rest = [*members[:k], *members[k + 1 :]]
        without = screen.fit_nuisances(_fit(screen, rest)[2])[1]
        gains = [
            1.0 - rms(left[mine]) / max(rms(without[mine]), 1e-12)
            for c in np.unique(search.channel)
            if (mine := held & (search.channel == c)).any()
        ]
        own = members[k].effects(0, fit.c[[k]])[0]
        clear = z[k] >= MEMBER_Z and not search.problem.is_within_tolerance(own)
        least = MEMBER_GAIN if clear else CHANNEL_GAIN
        if max(gains, default=0.0) < least:
            return k
    return None


def _fit(
    screen: Screen, members: Sequence[Candidate]
) -> tuple[np.ndarray, LinearFit, np.ndarray]:
    """(m, k) columns of all members, their fit, and the residual (m,) that it leaves
    before nuisances."""
    X = np.hstack([m.columns[0] for m in members])
    fit = screen.fit(X)
    return X, fit, screen.r - X @ fit.c
