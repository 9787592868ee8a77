"""The incremental Gaussian mixture against closed forms and brute force."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal
from sklearn.mixture import GaussianMixture

from makebreak.systems.changing_contact.numerics.igmm import (
    CREATED,
    REFUSED,
    UPDATED,
    IgmmConfig,
    Mixture,
    as_vector,
    empty_mixture,
    from_vector,
    igmm_tuning,
    learned,
    log_likelihood,
    regress,
)

ONE = dict(tau_nov=1e-300, floor=1e-9)  # Nothing is ever new, nothing floored.


def tuning(sigma_ini, **changes):
    return igmm_tuning(IgmmConfig(sigma_ini=list(sigma_ini), **changes))


def after(X, t, mixture=None):
    mixture = mixture or empty_mixture(t)
    for x in X:
        mixture, _ = learned(mixture, x, t)
    return mixture


def random_mixture(rng, n, d):
    """n components with random means and covariances."""
    A = rng.normal(size=(n, d, d))
    factor = np.linalg.cholesky(A @ A.transpose(0, 2, 1) + 0.3 * np.eye(d))
    support = rng.uniform(1.0, 9.0, size=n)
    return Mixture(rng.normal(size=(n, d)), factor, support, support + 1.0, n)


@pytest.mark.parametrize("d", [1, 2, 6])
def test_one_component_is_the_batch_mean_and_covariance(d):
    rng = np.random.default_rng(d)
    sigma = rng.uniform(0.1, 2.0, size=d)
    X = rng.normal(size=(500, d)) @ rng.normal(size=(d, d)) + rng.normal(size=d)
    mixture = after(X, tuning(sigma, **ONE))
    assert mixture.count == 1
    # The first sample brings sigma_ini^2 along; the rest is the biased covariance.
    expected = np.cov(X.T, bias=True).reshape(d, d) + np.diag(sigma**2) / len(X)
    # 500 updates of rank one, each with rounding of 1e-16.
    np.testing.assert_allclose(mixture.mean[0], X.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(mixture.covariance[0], expected, atol=1e-11)


def test_separate_clusters_become_the_components_that_em_finds():
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0]])
    label = rng.integers(3, size=3000)
    X = centres[label] + rng.normal(size=(3000, 2)) @ [[1.0, 0.4], [0.0, 0.7]]
    mixture = after(X, tuning([1.5, 1.5], tau_nov=1e-6))
    assert mixture.count == 3
    em = GaussianMixture(3, means_init=centres, random_state=0).fit(X)
    near = [np.argmin(np.sum((em.means_ - mu) ** 2, axis=1)) for mu in mixture.mean[:3]]
    assert sorted(near) == [0, 1, 2]
    # They differ by sigma_ini^2 = 2.25 spread over the 1000 samples of a component.
    np.testing.assert_allclose(mixture.mean[:3], em.means_[near], atol=1e-6)
    np.testing.assert_allclose(mixture.covariance, em.covariances_[near], atol=3e-3)
    np.testing.assert_allclose(mixture.weight, em.weights_[near], atol=1e-6)


def test_log_likelihood_is_that_of_scipy():
    rng = np.random.default_rng(0)
    mixture = random_mixture(rng, 3, 4)
    for x in rng.normal(size=(5, 4)):
        density = sum(
            w * multivariate_normal(mu, S).pdf(x)
            for w, mu, S in zip(
                mixture.weight, mixture.mean, mixture.covariance, strict=True
            )
        )
        np.testing.assert_allclose(log_likelihood(mixture, x), np.log(density))
    assert log_likelihood(empty_mixture(tuning([1.0])), [0.0]) == -np.inf


def test_the_update_with_the_new_mean_loses_definiteness_and_ours_does_not():
    """Streams with novelty as in use: 1e-3, so e up to 3.7 standard deviations."""
    lost = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        X = rng.normal(size=(40, 3))
        t = tuning([0.5] * 3, tau_nov=1e-3, n_max=1)
        mixture, mu, C, sp, broken = empty_mixture(t), X[0], 0.25 * np.eye(3), 1.0, 0
        for x in X:
            before = mixture
            mixture, status = learned(mixture, x, t)
            assert np.linalg.eigvalsh(mixture.covariance[0])[0] > 0.0
            if status == CREATED:
                mu, C, sp = x, 0.25 * np.eye(3), 1.0
                continue
            sp += 1.0
            w, e = 1.0 / sp, x - mu
            mu = mu + w * e
            new = (1 - w) * C - w**2 * np.outer(e, e) + w * np.outer(x - mu, x - mu)
            broken += np.linalg.eigvalsh(new)[0] <= 0.0
            C = before.covariance[0]  # Go on from the right one.
            C = C - w**2 * np.outer(e, e) + w * (np.outer(e, e) - C)
            np.testing.assert_allclose(mixture.covariance[0], C, atol=1e-12)
        lost += broken > 0
    assert lost > 50


@pytest.mark.parametrize("seed", range(5))
def test_regression_is_the_mean_of_the_conditional_density_integrated(seed):
    rng = np.random.default_rng(seed)
    mixture = random_mixture(rng, 3, 3)
    x = rng.normal(size=2)
    y, C = regress(mixture, x)
    grid = np.linspace(-40.0, 40.0, 40001)  # Beyond: exp(-100) and less.
    points = np.column_stack([np.tile(x, (len(grid), 1)), grid])
    density = sum(
        w * multivariate_normal(mu, S).pdf(points)
        for w, mu, S in zip(
            mixture.weight, mixture.mean, mixture.covariance, strict=True
        )
    )
    density /= density.sum()
    mean = density @ grid
    # Sums over a smooth density that vanishes at both ends converge beyond all orders.
    np.testing.assert_allclose(y, [mean], atol=1e-9)
    np.testing.assert_allclose(C, [[density @ (grid - mean) ** 2]], rtol=1e-8)


def reordered(mixture: Mixture, order) -> Mixture:
    """The same mixture over x[order]."""
    C = mixture.covariance[:, order][:, :, order]
    factor = np.zeros_like(mixture.factor)
    factor[: mixture.count] = np.linalg.cholesky(C)
    mean = np.ascontiguousarray(mixture.mean[:, order])
    return Mixture(mean, factor, mixture.support, mixture.age, mixture.count)


def test_regression_of_two_outputs_and_of_any_others_by_reordering():
    rng = np.random.default_rng(0)
    mixture = random_mixture(rng, 2, 5)
    inputs, outputs = [4, 0, 3], [2, 1]
    x = rng.normal(size=3)
    y, C = regress(reordered(mixture, inputs + outputs), x)
    S, mu = mixture.covariance, mixture.mean
    h, each, spread = [], [], []
    for j in range(2):  # The textbook's formula, block by block.
        S_ii, S_oi = S[j][np.ix_(inputs, inputs)], S[j][np.ix_(outputs, inputs)]
        gain = S_oi @ np.linalg.inv(S_ii)
        each.append(mu[j][outputs] + gain @ (x - mu[j][inputs]))
        spread.append(S[j][np.ix_(outputs, outputs)] - gain @ S_oi.T)
        pdf = multivariate_normal(mu[j][inputs], S_ii).pdf(x)
        h.append(mixture.weight[j] * pdf)
    h = np.array(h) / sum(h)
    expected = h @ np.array(each)
    np.testing.assert_allclose(y, expected, atol=1e-12)
    C_expected = sum(
        h[j] * (spread[j] + np.outer(each[j] - expected, each[j] - expected))
        for j in range(2)
    )
    np.testing.assert_allclose(C, C_expected, atol=1e-12)


def test_a_line_is_learned_from_noisy_samples_and_extrapolated():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, size=2000)
    y = 3.0 * x - 1.0 + 0.05 * rng.normal(size=2000)
    mixture = after(np.column_stack([x, y]), tuning([1.0, 3.0], **ONE))
    slope, offset = np.polyfit(x, y, 1)
    for at in (-0.5, 0.9, 4.0):
        # sigma_ini, once in 2000 samples, shrinks the slope by 1.5e-3 of it.
        expected = [slope * at + offset]
        np.testing.assert_allclose(regress(mixture, [at])[0], expected, atol=0.02)


STREAM = st.lists(
    st.lists(st.floats(-1e3, 1e3, allow_nan=False, width=32), min_size=3, max_size=3),
    min_size=1,
    max_size=60,
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(STREAM, st.sampled_from([1e-6, 1e-3, 0.5]), st.sampled_from([1, 3, 8]))
def test_any_stream_leaves_a_mixture_that_is_positive_definite(rows, tau_nov, n_max):
    t = tuning([0.1, 1.0, 30.0], tau_nov=tau_nov, n_max=n_max, v_min=5.0, sp_min=2.0)
    mixture = empty_mixture(t)
    for x in rows:
        mixture, status = learned(mixture, x, t)
        assert status in (CREATED, UPDATED)
        assert 1 <= mixture.count <= n_max
        diagonal = np.diagonal(mixture.factor[: mixture.count], axis1=1, axis2=2)
        # The floor itself, to rounding: a factor's diagonal > 0 is definiteness.
        assert (diagonal >= 0.01 * t.sigma_ini * (1 - 1e-9)).all()
        y, C = regress(mixture, x[:2])
        assert np.isfinite(y).all() and C[0, 0] > 0.0
    np.testing.assert_allclose(mixture.weight.sum(), 1.0, rtol=1e-12)


def test_a_constant_stream_ends_at_the_floor():
    t = tuning([0.2, 3.0], floor=0.05)
    mixture = after(np.tile([4.0, -1.0], (5000, 1)), t)
    assert mixture.count == 1
    # Without it sigma would be sigma_ini / sqrt(5000) = 0.014 sigma_ini.
    expected = (0.05 * t.sigma_ini) ** 2
    np.testing.assert_allclose(mixture.covariance[0], np.diag(expected), atol=1e-12)
    np.testing.assert_allclose(regress(mixture, [4.0])[0], [-1.0], rtol=1e-12)


@pytest.mark.parametrize(
    "bad", [[np.nan, 0.0], [0.0, np.inf], [1e300, 0.0], [0.0, -1e10]]
)
def test_a_sample_that_is_no_number_is_refused(bad):
    t = tuning([1.0, 1.0])
    mixture = after(np.random.default_rng(0).normal(size=(20, 2)), t)
    same, status = learned(mixture, bad, t)
    assert status == REFUSED and same is mixture
    assert learned(empty_mixture(t), bad, t)[1] == REFUSED


def test_regression_without_knowledge_says_infinite_variance():
    t = tuning([1.0, 1.0, 1.0])
    full = after(np.random.default_rng(0).normal(size=(20, 3)), t)
    for mixture, x in (
        (empty_mixture(t), [0.0]),
        (full, [np.nan]),
        (full, [np.inf]),
        (full, [1e250]),
    ):
        y, C = regress(mixture, x)
        np.testing.assert_array_equal(y, [0.0, 0.0])
        np.testing.assert_array_equal(C, np.diag([np.inf, np.inf]))


def test_a_far_sample_is_a_new_component_and_an_outlier_is_pruned():
    t = tuning([1.0], v_min=10.0, sp_min=3.0)
    distance = np.sqrt(-2.0 * np.log(1e-3))  # Of tau_nov, in standard deviations.
    for scale, status in ((0.999, UPDATED), (1.001, CREATED)):
        mixture, _ = learned(empty_mixture(t), [5.0], t)
        assert learned(mixture, [5.0 + scale * distance], t)[1] == status
    mixture = after([[0.0], [100.0]], t)
    assert mixture.count == 2
    nine = after([[0.0]] * 9, t, mixture)
    assert nine.count == 2  # The outlier has age 10 and support 1, but not more.
    ten, _ = learned(nine, [0.0], t)
    assert ten.count == 1
    np.testing.assert_allclose(ten.mean[0], 0.0, atol=1e-12)
    np.testing.assert_array_equal(ten.mean[1:], 0.0)


def test_the_last_component_is_never_pruned():
    t = tuning([1.0], v_min=2.0, sp_min=2.0, sp_max=2.5)
    mixture = after(np.zeros((50, 1)), t)
    assert mixture.count == 1 and mixture.support[0] == 2.5


def test_beyond_the_cap_the_least_supported_component_gives_way():
    t = tuning([1.0], n_max=3)
    X = [[0.0]] * 5 + [[100.0]] * 2 + [[200.0]] * 4
    mixture = after([*X, [300.0]], t)
    assert sorted(mixture.mean[:3, 0]) == [0.0, 200.0, 300.0]


def test_a_capped_support_forgets_exponentially():
    rng = np.random.default_rng(0)
    X = np.concatenate([np.zeros((300, 1)), np.ones((200, 1))])
    X += 0.1 * rng.normal(size=X.shape)
    mixture = after(X, tuning([2.0], sp_max=20.0, tau_nov=1e-300))
    mean = X[0].copy()
    for k, x in enumerate(X[1:], start=2):
        mean += (x - mean) / min(k, 21)
    np.testing.assert_allclose(mixture.mean[0], mean, atol=1e-12)
    assert abs(mixture.mean[0] - 1.0) < 0.1


def test_a_mixture_is_a_value():
    t = tuning([1.0, 1.0])
    mixture = after(np.random.default_rng(0).normal(size=(30, 2)), t)
    before = as_vector(mixture)
    learned(mixture, [50.0, 0.0], t)
    np.testing.assert_array_equal(as_vector(mixture), before)
    with pytest.raises(ValueError, match="read-only"):
        mixture.mean[0, 0] = 1.0
    again = from_vector(before, t)
    np.testing.assert_array_equal(as_vector(again), before)
    x = np.array([0.3, 0.1])
    np.testing.assert_array_equal(
        as_vector(learned(again, x, t)[0]), as_vector(learned(mixture, x, t)[0])
    )


@pytest.mark.parametrize(
    "edit, message",
    [
        (lambda v: v[:-1], "65 finite numbers"),
        (lambda v: np.where(np.arange(v.size) == 3, np.nan, v), "finite"),
        (lambda v: np.where(np.arange(v.size) == 64, 9.0, v), "9 components"),
        (lambda v: np.where(np.arange(v.size) == 16, -1.0, v), "positive definite"),
    ],
)
def test_a_vector_that_is_no_mixture_is_refused(edit, message):
    t = tuning([1.0, 1.0], n_max=8)
    vector = as_vector(after(np.zeros((3, 2)), t))
    with pytest.raises(ValueError, match=message):
        from_vector(edit(vector), t)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(sigma_ini=[]), "sigma_ini"),
        (dict(sigma_ini=[1.0, 0.0]), "sigma_ini"),
        (dict(sigma_ini=[1.0, np.nan]), "sigma_ini"),
        (dict(tau_nov=0.0), "tau_nov is 0.0, expected a number in"),
        (dict(floor=1.0), "floor"),
        (dict(v_min=2.0, sp_min=3.0), "sp_min"),
        (dict(sp_max=1.0), "sp_max"),
        (dict(n_max=0), "n_max is 0"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        igmm_tuning(replace(IgmmConfig(sigma_ini=[1.0, 1.0]), **changes))


def test_samples_of_the_wrong_size_are_refused():
    t = tuning([1.0, 1.0])
    with pytest.raises(ValueError, match=r"x is \(3,\), expected \(2,\)"):
        learned(empty_mixture(t), np.zeros(3), t)
    for n in (0, 2):
        with pytest.raises(ValueError, match="expected between 1 and 1"):
            regress(empty_mixture(t), np.zeros(n))
