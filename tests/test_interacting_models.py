import numpy as np
import pytest
from scipy.linalg import expm

from makebreak.systems.perception.numerics import constant_velocity, interacting_models

DT, SIGMA, NOISE = 0.0125, 1.5e-3, 1e-3
QUIET, DRIVEN = 4e-3, 0.3


def textbook_step(x, P, mu, chances, z, densities):
    """One cycle of Blom and Bar-Shalom for one way, with whole matrices."""
    A = np.array([[1.0, DT], [0.0, 1.0]])
    H = np.array([1.0, 0.0])
    c = mu @ chances
    xs, Ps, likelihoods = [], [], []
    for j, q in enumerate(densities):
        w = mu * chances[:, j] / c[j]
        x0 = w @ x
        P0 = sum(w[i] * (P[i] + np.outer(x[i] - x0, x[i] - x0)) for i in range(len(x)))
        block = expm(
            np.block([[-A * 0 - np.array([[0, 1], [0, 0]]), np.diag([0, q])],
                      [np.zeros((2, 2)), np.array([[0, 0], [1, 0]])]]) * DT
        )  # fmt: skip
        Q = block[2:, 2:].T @ block[:2, 2:]
        x1, P1 = A @ x0, A @ P0 @ A.T + Q
        S = P1[0, 0] + SIGMA**2
        K = P1 @ H / S
        xs.append(x1 + K * (z - x1[0]))
        Ps.append(P1 - np.outer(K, H @ P1))
        # Both ways are measured alike: the density of two equal innovations.
        likelihoods.append(np.exp(-((z - x1[0]) ** 2) / S) / (2.0 * np.pi * S))
    mu = c * likelihoods
    return np.array(xs), np.array(Ps), mu / mu.sum()


def test_a_cycle_is_the_textbook_one():
    """Both ways see the same, so that what is shared between them is what each has."""
    rng = np.random.default_rng(0)
    densities = np.array([QUIET, DRIVEN])
    chances = interacting_models.transition([2.0, 0.2], DT)
    x = rng.normal(size=(2, 2)) * [2e-3, 0.05]
    P = np.array([[[1e-6, 2e-6], [2e-6, 1e-3]], [[2e-6, 3e-6], [3e-6, 9e-3]]])
    mu = np.array([0.7, 0.3])
    means = x[:, [0, 0, 1, 1]]
    estimate = means, np.array([[p[0, 0], p[0, 1], p[1, 1]] for p in P]), mu
    for z in (3e-3, -2e-3, 8e-3):
        x, P, mu = textbook_step(x, P, mu, chances, z, densities)
        estimate = interacting_models.correct(
            *interacting_models.predict(*estimate, chances, DT, densities),
            np.array([z, z]), SIGMA,
        )  # fmt: skip
        np.testing.assert_allclose(estimate[0], x[:, [0, 0, 1, 1]], rtol=1e-9)
        covariances = [[p[0, 0], p[0, 1], p[1, 1]] for p in P]
        np.testing.assert_allclose(estimate[1], covariances, rtol=1e-9)
        np.testing.assert_allclose(estimate[2], mu, rtol=1e-9)


def test_the_mixture_has_the_mean_and_the_spread_of_its_parts():
    rng = np.random.default_rng(0)
    means = np.array([[0.0, 0.0, 0.1, 0.1], [0.004, 0.004, -0.05, -0.05]])
    covariances = np.array([[1e-6, 2e-6, 1e-3], [2e-6, 1e-6, 4e-3]])
    weights = np.array([0.3, 0.7])
    p, v, P = interacting_models.combined(means, covariances, weights)
    n = 400_000
    which = rng.random(n) < 0.7
    samples = np.empty((n, 2))
    for k, part in enumerate((~which, which)):
        c = covariances[k]
        samples[part] = rng.multivariate_normal(
            means[k, [0, 2]], [[c[0], c[1]], [c[1], c[2]]], part.sum()
        )
    np.testing.assert_allclose([p[0], v[0]], samples.mean(0), atol=5e-4)
    found = np.cov(samples.T)
    # Relative errors of moments of 4e5 samples: sqrt(2 / n) = 0.2 %, six of them.
    np.testing.assert_allclose(P, [found[0, 0], found[0, 1], found[1, 1]], rtol=0.014)


def test_one_model_is_the_plain_filter():
    rng = np.random.default_rng(0)
    p, v, P = np.zeros(2), np.zeros(2), np.array([SIGMA**2, 0.0, 0.09])
    estimate = interacting_models.start(p, v, P, 1)
    chances = interacting_models.transition([1.0], DT)
    for z in rng.normal(size=(20, 2)) * 0.01:
        p, v, P = constant_velocity.predict(p, v, P, DT, QUIET)
        p, v, P = constant_velocity.correct(p, v, P, z, SIGMA)
        estimate = interacting_models.correct(
            *interacting_models.predict(*estimate, chances, DT, [QUIET]), z, SIGMA
        )
    for one, other in zip(
        interacting_models.combined(*estimate), (p, v, P), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("dt", [0.0125, 0.3])
def test_models_are_left_after_their_dwell_times(dt):
    chances = interacting_models.transition([2.0, 0.2, 0.5], dt)
    np.testing.assert_allclose(chances.sum(1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.diag(chances), np.exp(-dt / np.array([2, 0.2, 0.5])))
    np.testing.assert_allclose(chances[0, 1], chances[0, 2])


def tracked(densities, dwell, p_true, seed=0):
    """Errors of position and velocity, rms, of a filter that sees p_true (n, 2)."""
    rng = np.random.default_rng(seed)
    z = p_true + rng.normal(0.0, NOISE, p_true.shape)
    v_true = np.gradient(p_true, DT, axis=0)
    estimate = interacting_models.start(
        p_true[0], np.zeros(2), np.array([SIGMA**2, 0.0, 0.09]), len(densities)
    )
    chances = interacting_models.transition(dwell, DT)
    off = []
    for k in range(1, len(z)):
        estimate = interacting_models.correct(
            *interacting_models.predict(*estimate, chances, DT, densities), z[k], SIGMA
        )
        p, v, _ = interacting_models.combined(*estimate)
        off.append([p[0] - p_true[k, 0], v[0] - v_true[k, 0]])
    return np.sqrt((np.array(off[80:]) ** 2).mean(0))


def test_what_rocks_is_followed_and_what_rests_is_as_quiet_as_before():
    """An object that rocks by 8 mm at 2.2 Hz, as a fruit in a dent, and one at rest."""
    t = DT * np.arange(1600)
    rocking = np.stack([8e-3 * np.sin(2 * np.pi * 2.2 * t), 0.0 * t], 1)
    both = np.array([QUIET, DRIVEN]), [2.0, 0.2]
    slow, fast = (np.array([q]) for q in (QUIET, DRIVEN))
    rocks = [tracked(q, d, rocking) for q, d in ((slow, [1.0]), both)]
    assert rocks[1][0] < 0.6 * rocks[0][0] and rocks[1][1] < 0.75 * rocks[0][1]
    rests = [
        tracked(q, d, 0.0 * rocking) for q, d in ((slow, [1.0]), both, (fast, [1.0]))
    ]
    assert rests[1][1] < 1.25 * rests[0][1] < 0.4 * rests[2][1]
