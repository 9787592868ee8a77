"""Two rival effects fitted at once: does the model need the one, the other, or both?

Alone each of two rivals may leave as little as the other. Together each takes what is
its own: a rival is no tie if, with it free, the first still is many deviations from
nothing. That is judged over all rows, blocks of time drawn anew for the deviations
(errors go together), and by the weights of one model: where weights depend on the
model, of two models each by its own that with the larger noise seems better. They are
the weights of what is fitted, in turns, which does not reward larger noise (iteratively
reweighted least squares: Carroll, Ruppert, Transformation and Weighting in Regression,
1988, chapter 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.problem import Fitted, GapProblem, Nuisances, rms
from makebreak.gap.thresholds import NEEDED_Z
from makebreak.models.effects.kind import Effect

WEIGHT_ROUNDS = 4  # Of fit and weights.


@dataclass(frozen=True, eq=False)
class Together:
    """Of a first effect and its rival: z, how many deviations each is off nothing with
    the other free; lost, what is left more without each (rms over all rows, in units of
    noise); fitted: both; single: the first alone, by the same weights."""

    z: tuple[float, float]
    lost: tuple[float, float]
    fitted: Fitted
    single: Fitted

    def needs(self, k: int, least: float) -> bool:
        """Whether effect k is needed beside the other. least: what is left more without
        it that laws, which are approximations, may leave too."""
        return self.z[k] >= NEEDED_Z and self.lost[k] > least


def fit_together(
    problem: GapProblem,
    nuisances: Nuisances,
    there: Sequence[Effect],
    fixed: Sequence[Sequence[str]],
    first: Effect,
    rival: Effect,
    nothing: tuple[Effect, Effect],
) -> Together | None:
    """Two effects of one parameter each.

    Args: there, fixed: the other effects, which are fitted along, and their parameters
        that stay; first, rival: as fitted alone; nothing: the two as they are in the
        scene.
    Returns: None where weights do not depend on the model.
    Raises: ValueError, RuntimeError for effects that the scene cannot have.
    """
    effects = [*there, first, nothing[1]]
    held: list[Sequence[str]] = [*fixed, (), ()]
    n = nuisances
    scale = 1.0
    alike = problem.weighed_by(effects, every_row=True)
    if alike is None:
        return None
    for _ in range(WEIGHT_ROUNDS):
        alike = problem.weighed_by(effects, every_row=True)
        assert alike is not None
        every = np.ones(len(alike.train()), bool)
        r = alike.residual(effects)
        screen = Screen(
            r, n.columns, n.prior, every, scale * problem.correlation, n.reach
        )
        fitted = fit_effects(alike, screen, effects, held)
        effects, scale = list(fitted.effects), max(fitted.fit.train, 1.0)
    k = len(there)
    one = fit_effects(alike, screen, [*there, first], held[:-1])
    other = fit_effects(alike, screen, [*there, rival], held[:-1])
    z = tuple(
        _deviations(fitted.effects[k + i], fitted.std[k + i], nothing[i])
        for i in range(2)
    )
    both = rms(fitted.left)
    # Without the first the rival is left, and the other way round.
    lost = tuple(
        float(np.sqrt(max(rms(f.left) ** 2 - both**2, 0.0))) for f in (other, one)
    )
    return Together((z[0], z[1]), (lost[0], lost[1]), fitted, one)


def _deviations(effect: Effect, std: dict[str, float], nothing: Effect) -> float:
    (name,) = std
    off = abs(effect.parameters[name] - nothing.parameters[name])
    return off / max(std[name], 1e-300)
