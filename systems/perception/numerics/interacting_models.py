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

from makebreak.systems.perception.numerics import constant_velocity

Estimate = tuple[np.ndarray, np.ndarray, np.ndarray]
PROBABILITY_MIN = 1e-6  # Lower bound: a model at 0 could not recover.


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


def combined(means, covariances, probabilities):
    """p (2,), v (2,), P (3,): mean and covariance of the mixture, with the spread of
    the means averaged over x and y."""
    mean = probabilities @ means
    P = probabilities @ (covariances + _spread(means - mean))
    return mean[:2], mean[2:], P


def _spread(off):
    """Contribution (k, 3) of deviations (k, 4) of the means to the covariances."""
    p, v = off[:, :2], off[:, 2:]
    return 0.5 * np.stack([(p * p).sum(1), (p * v).sum(1), (v * v).sum(1)], axis=1)


def predict(means, covariances, probabilities, chances, dt, densities):
    """Predicts the estimate by dt [s].

    Args: chances (m, m): of `transition`; densities (m,) [m^2/s^3].
    """
    after = probabilities @ chances
    weights = probabilities[:, None] * chances / after  # (from, to), columns sum to 1.
    mixed_means = weights.T @ means
    new_means, new_covariances = np.empty_like(means), np.empty_like(covariances)
    for j, density in enumerate(densities):
        P = weights[:, j] @ (covariances + _spread(means - mixed_means[j]))
        p, v, new_covariances[j] = constant_velocity.predict(
            mixed_means[j, :2], mixed_means[j, 2:], P, dt, density
        )
        new_means[j] = *p, *v
    return new_means, new_covariances, after


def correct(means, covariances, probabilities, measured, sigma):
    """Corrects the estimate with a measurement of p (2,) of standard deviation sigma
    [m]."""
    new_means, new_covariances = np.empty_like(means), np.empty_like(covariances)
    log_likelihood = np.empty(len(means))
    for j, (mean, P) in enumerate(zip(means, covariances, strict=True)):
        S = P[0] + sigma**2
        off = measured - mean[:2]
        log_likelihood[j] = -0.5 * (off @ off) / S - np.log(S)  # Of two dimensions.
        p, v, new_covariances[j] = constant_velocity.correct(
            mean[:2], mean[2:], P, measured, sigma
        )
        new_means[j] = *p, *v
    weight = probabilities * np.exp(log_likelihood - log_likelihood.max())
    weight = np.maximum(weight / weight.sum(), PROBABILITY_MIN)
    return new_means, new_covariances, weight / weight.sum()
