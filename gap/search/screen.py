"""Candidates ranked by what each explains of what is left."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.budget import go_on
from makebreak.gap.numerics.selection import LinearFit, Screen
from makebreak.gap.problem import Candidate
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.sizes import Sizes


@dataclass(frozen=True, eq=False)
class Ranked:
    """A candidate with the fit of its best alternative, and what that says."""

    candidate: Candidate
    fit: LinearFit
    effects: tuple[Effect, ...]
    valid: bool
    alternative: int

    @property
    def columns(self) -> np.ndarray:
        return self.candidate.columns[self.alternative]

    def fixed(self) -> tuple[tuple[str, ...], ...]:
        return self.candidate.fixed_of_each()


def rank(
    screen: Screen, found: Sequence[Candidate], sizes: Sizes | None = None
) -> list[Ranked]:
    """Candidates, the least held-out error first. Of alternatives that which fits the
    training rows best is judged. Of a group any member may be none (it is pruned).
    sizes: see is_sane."""
    ranked = []
    for candidate in found:
        go_on()
        fits = [screen.fit(columns) for columns in candidate.columns]
        k = min(range(len(fits)), key=lambda i: fits[i].train)
        effects = candidate.effects(k, fits[k].c)
        valid = bool(candidate.members) or candidate.is_sane(effects, sizes)
        ranked.append(Ranked(candidate, fits[k], effects, valid, k))
    return sorted(ranked, key=lambda r: r.fit.score)
