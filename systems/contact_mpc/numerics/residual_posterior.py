"""The residual of a contact as a probability, given what was measured.

The violation-based loss l_k(r) of a measured step (residual_learner.py), with weights
that are inverse variances, is a negative log-likelihood. Over a grid of values of r

    p(r) <- p(r) spread by N(0, (drift + growth |r|)^2 dt)   the residual may change,
    p(r) <- p(r) exp(-trust min(l_k(r) - min l_k, l_max))

and the most probable value is r_comp. The gradient of the loss tells less: it is zero
wherever a contact was missed (the loss is flat there, however high), so that a gap that
is too large is hardly ever made smaller; and Adam's steps are of one size, whether the
data say much or nothing. docs/residual_learning.md has both side by side.

growth: a wrong radius is not one gap. Where a ball is touched at an angle a from its
top, the gap is (1 + cos a) times the error of the radius, so the larger the residual,
the more it changes while the ball rolls under the tip; a right model stays right.

l_max bounds what a single step can say, for an impact within it or a wrong reading;
trust < 1 because the errors of successive steps are correlated.

A residual changes because the object is touched at another place. So p(r) is spread
only while the contact is felt, and for a while after it. In the air it would otherwise
be forgotten, or move away from where the air was seen, although nothing is measured.

Several contacts have a grid each, and a contact's losses are those with the others'
residuals at their most probable values (a mean-field approximation).

Source: the loss, ACI-MPC section VI; the filter is Bayes' rule on a grid (a histogram
filter: Thrun, Burgard, Fox, "Probabilistic robotics", 4.1).
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.residual_learner import Buffer, solve_step

# Least probability of a value of the grid: what data ruled out for long can be believed
# again after a few steps, as when the object was replaced.
LEAST = 1e-10


@dataclass(frozen=True, eq=False)
class ResidualGrid:
    """The values that the residual may have, and how it is believed to change."""

    values: np.ndarray  # (n,) [m/s], evenly spaced, increasing.
    transition: np.ndarray  # (n, n) column j: where r may be a step after values[j].
    prior: np.ndarray  # (n,) sums to 1.


def residual_grid(r_max, spacing, prior_std, drift_std, growth_std=0.0) -> ResidualGrid:
    """Args: r_max: the grid's ends; spacing; prior_std about 0; drift_std in one time
    step of the learner, all [m/s]; growth_std: more of it per size of the residual."""
    n = 2 * int(np.ceil(r_max / spacing)) + 1
    values = np.linspace(-r_max, r_max, n)
    distance = values[:, None] - values[None, :]
    width = np.maximum(drift_std + growth_std * abs(values), 0.05 * spacing)
    transition = np.exp(-0.5 * (distance / width) ** 2)
    transition /= transition.sum(axis=0)
    prior = np.exp(-0.5 * (values / prior_std) ** 2)
    prior /= prior.sum()
    for array in (values, transition, prior):
        array.setflags(write=False)
    return ResidualGrid(values, transition, prior)


def losses_on_grid(step: Buffer, shared, values, eps, gamma, others=0.0):
    """The loss of one measured step for each value of its residual.

    Args: step: a buffer of one; shared (n_lam,): which entries of the contact equation
        have the residual; values (n,) [m/s]; eps, gamma as in residual_learner.py;
        others (n_lam,) [m/s]: the residuals of the entries that do not share this one.
    Returns: loss (n,); nan where a QP was not solved.
    """
    q = step.q[0] + np.where(shared, 0.0, others)
    data = (step.P[0], step.p[0], step.F[0], q)
    return step.constant[0] + _costs(*data, shared, values, gamma) / eps


def is_felt(grid: ResidualGrid, loss, residual) -> bool:
    """Whether a step with these losses (n,) has contact in the model with the residual
    [m/s]: without contact, a larger residual has the same loss to rounding."""
    scale = 1e-9 * (1.0 + abs(loss[-1]))
    return bool(abs(np.interp(residual, grid.values, loss) - loss[-1]) > scale)


@njit(cache=True)
def _costs(P, p, F, q, shared, values, gamma):
    costs = np.empty(values.size)
    b = np.empty(q.size)
    for j in range(values.size):
        for i in range(q.size):
            b[i] = q[i] + (values[j] if shared[i] else 0.0)
        solved, cost, _, _, _ = solve_step(P, p, F, b, gamma)
        costs[j] = cost if solved else np.nan
    return costs


def updated(grid: ResidualGrid, belief, loss, trust, loss_max, spreads=True):
    """The belief (n,) after a step with these losses (n,), or without them where they
    are not finite.

    Args: spreads: whether the residual may have changed since the last step.
    """
    if spreads:
        belief = grid.transition @ belief
    if np.isfinite(loss).all():
        belief = belief * np.exp(-trust * np.minimum(loss - loss.min(), loss_max))
    belief = np.maximum(belief / belief.sum(), LEAST)
    return belief / belief.sum()


def mode_and_std(grid: ResidualGrid, belief) -> tuple[float, float]:
    """The most probable residual and the deviation about it [m/s].

    Not the mean: where nothing touches, data rule out smaller residuals and say nothing
    of larger ones, so the tail on that side pulls the mean along. Between the values of
    the grid: the parabola through the three highest logarithms (exact for a Gaussian).
    The grid's spacing is part of the deviation.
    """
    spacing = grid.values[1] - grid.values[0]
    i = min(max(int(np.argmax(belief)), 1), belief.size - 2)
    left, middle, right = np.log(np.maximum(belief[i - 1 : i + 2], 1e-300))
    bend = left - 2.0 * middle + right
    mode = float(grid.values[i])
    if bend < 0.0:
        mode += float(np.clip(0.5 * (left - right) / bend, -1.0, 1.0)) * spacing
    variance = float((grid.values - mode) ** 2 @ belief) + spacing**2 / 12.0
    return mode, float(np.sqrt(variance))
