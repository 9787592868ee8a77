"""An interacting-multiple-model filter for a point in the plane that moves freely most
of the time and is driven now and then.

Filters of constant_velocity.py run side by side, one per density of the acceleration; a
Markov chain models the switching. A single density would be either so small that the
estimate lags when the point starts to move, or so large that the velocity of a point at
rest is noise.

Layout of an estimate: means (m, 4) = [p 2, v 2] and covariances (m, 3) = (P_pp, P_pv,
P_vv), the same along x and y, one row per model, and the models' probabilities (m,).

Source: Blom, Bar-Shalom, "The interacting multiple model algorithm for systems with
Markovian switching coefficients", IEEE TAC 33(8), 1988.
"""

import numpy as np
from numba import njit

from makebreak.systems.perception.numerics import constant_velocity

Estimate = tuple[np.ndarray, np.ndarray, np.ndarray]
PROBABILITY_MIN = 1e-6  # Lower bound: a model at 0 could not recover.
_predict_one = njit(cache=True)(constant_velocity.predict)
_correct_one = njit(cache=True)(constant_velocity.correct)


def transition(dwell_sec, dt):
    """Transition probabilities (m, m) over dt [s], from model i (row) to each model.

    Args: dwell_sec (m,): mean duration of each model [s]; the others follow it with
        equal probability.
    """
    dwell_sec = np.asarray(dwell_sec, dtype=float)
    m = len(dwell_sec)
    if m == 1:
        return np.ones((1, 1))
    leave = 1.0 - np.exp(-dt / dwell_sec)
    chances = np.repeat(leave[:, None] / (m - 1), m, axis=1)
    np.fill_diagonal(chances, 1.0 - leave)
    return chances


def start(p, v, P, n_models):
    """An estimate (means, covariances, probabilities) with one state in all models.

    Args: p, v (2,) [m], [m/s]; P (3,).
    """
    means = np.tile(np.concatenate([p, v]), (n_models, 1))
    return means, np.tile(P, (n_models, 1)), np.full(n_models, 1.0 / n_models)


@njit(cache=True)
def combined(means, covariances, probabilities):
    """p (2,), v (2,), P (3,): mean and covariance of the mixture, with the spread of
    the means averaged over x and y."""
    mean, P = np.zeros(4), np.zeros(3)
    for i in range(len(means)):
        mean += probabilities[i] * means[i]
    for i in range(len(means)):
        P += probabilities[i] * (covariances[i] + _spread(means[i] - mean))
    return mean[:2].copy(), mean[2:].copy(), P


@njit(cache=True)
def _spread(off):
    """Contribution (3,) of a mean's deviation (4,) to the covariance."""
    P = np.zeros(3)
    for i in range(2):
        P[0] += 0.5 * off[i] * off[i]
        P[1] += 0.5 * off[i] * off[2 + i]
        P[2] += 0.5 * off[2 + i] * off[2 + i]
    return P


@njit(cache=True)
def predict(means, covariances, probabilities, chances, dt, densities):
    """Predicts the estimate by dt [s].

    Args: chances (m, m): of `transition`; densities (m,) [m^2/s^3].
    """
    m = len(means)
    new_means, new_covariances = np.empty((m, 4)), np.empty((m, 3))
    after = np.zeros(m)
    for j in range(m):
        for i in range(m):
            after[j] += probabilities[i] * chances[i, j]
        mean, P = np.zeros(4), np.zeros(3)
        for i in range(m):
            mean += probabilities[i] * chances[i, j] / after[j] * means[i]
        for i in range(m):
            weight = probabilities[i] * chances[i, j] / after[j]
            P += weight * (covariances[i] + _spread(means[i] - mean))
        new_means[j, :2], new_means[j, 2:], new_covariances[j] = _predict_one(
            mean[:2], mean[2:], P, dt, densities[j]
        )
    return new_means, new_covariances, after


@njit(cache=True)
def correct(means, covariances, probabilities, measured, sigma):
    """Corrects the estimate with a measurement of p (2,) of standard deviation sigma
    [m]."""
    m = len(means)
    new_means, new_covariances = np.empty((m, 4)), np.empty((m, 3))
    log_likelihood = np.empty(m)
    for j in range(m):
        S = covariances[j, 0] + sigma**2
        square = (measured[0] - means[j, 0]) ** 2 + (measured[1] - means[j, 1]) ** 2
        log_likelihood[j] = -0.5 * square / S - np.log(S)  # Of two dimensions.
        new_means[j, :2], new_means[j, 2:], new_covariances[j] = _correct_one(
            means[j, :2], means[j, 2:], covariances[j], measured, sigma
        )
    weight = probabilities * np.exp(log_likelihood - log_likelihood.max())
    weight = np.maximum(weight / weight.sum(), PROBABILITY_MIN)
    return new_means, new_covariances, weight / weight.sum()


def warm_up() -> None:
    """Compiles it, for arrays that can be written to."""
    at, P = np.zeros(2), np.ones(3)
    estimate = predict(*start(at, at, P, 1), np.ones((1, 1)), 1.0, np.ones(1))
    combined(*correct(*estimate, at, 1.0))
