"""The long-term predictor of Khader et al.: GPs, modes, gating, propagation."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from makebreak.systems.baselines.numerics.long_term_predictor import (
    JITTER,
    LongTermPredictor,
    TrainingBudget,
    TrainingTrial,
    _OneMode,
    find_modes,
    fit_gp,
    known,
    log_marginal_likelihood,
    merged,
    one_of_each_stratum,
    predict_long_term,
    predict_one_step,
    train,
    without_short_stays,
)


def data(n=30, d=3, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(n, d))
    Y = np.stack([np.sin(X[:, 0]) + X[:, 1], X[:, 2] ** 2], axis=1)
    return X, Y + 0.05 * rng.normal(size=Y.shape)


@pytest.mark.parametrize("ard", [True, False])
def test_likelihood_and_its_gradient_are_those_of_sklearn(ard):
    X, Y = data()
    y = Y[:, 0] - Y[:, 0].mean()
    length = np.array([0.7, 1.3, 2.0]) if ard else 0.9
    kernel = ConstantKernel(1.7) * RBF(length) + WhiteKernel(0.02)
    gp = GaussianProcessRegressor(kernel, alpha=JITTER, optimizer=None).fit(X, y)
    theirs, gradient = gp.log_marginal_likelihood(kernel.theta, eval_gradient=True)
    ours = log_marginal_likelihood(kernel.theta, X, y, ard)
    # The same sums in another order; the condition of K is below 1e5.
    np.testing.assert_allclose(ours[0], theirs, rtol=1e-9)
    np.testing.assert_allclose(ours[1], gradient, rtol=1e-7, atol=1e-8)


def test_gp_prediction_is_the_closed_form():
    X, Y = data()
    gps = fit_gp(X, Y, X.mean(0), X.std(0))
    at = np.random.default_rng(1).normal(size=(5, 3))
    mean, variance = gps.predict(at)
    Z, Q = (X - X.mean(0)) / X.std(0), (at - X.mean(0)) / X.std(0)
    for j in range(2):

        def k(A, B, j=j):
            square = (((A[:, None] - B) / gps.length[j]) ** 2).sum(-1)
            return gps.signal[j] * np.exp(-0.5 * square)

        y = (Y[:, j] - Y[:, j].mean()) / Y[:, j].std()
        inverse = np.linalg.inv(k(Z, Z) + (gps.noise[j] + JITTER) * np.eye(len(Z)))
        expected = k(Q, Z) @ inverse @ y * Y[:, j].std() + Y[:, j].mean()
        spread = gps.signal[j] - np.diag(k(Q, Z) @ inverse @ k(Z, Q)) + gps.noise[j]
        # An explicit inverse of K, whose condition is 1e6 here, twice that squared.
        np.testing.assert_allclose(mean[:, j], expected, atol=1e-8)
        np.testing.assert_allclose(variance[:, j], spread * Y[:, j].var(), rtol=1e-5)
    np.testing.assert_allclose(gps.mean(at), mean, atol=1e-14)


def test_training_finds_a_likelihood_no_smaller_than_sklearns_own_optimiser():
    X, Y = data(n=40)
    scale = np.ones(3)
    gps = fit_gp(X, Y, np.zeros(3), scale, restarts=2)
    y = (Y[:, 0] - Y[:, 0].mean()) / Y[:, 0].std()
    kernel = ConstantKernel(1.0, (1e-3, 1e3)) * RBF(scale, (1e-1, 1e3)) + WhiteKernel(
        0.1, (1e-6, 1e1)
    )
    theirs = GaussianProcessRegressor(
        kernel, alpha=JITTER, n_restarts_optimizer=2, random_state=0
    ).fit(X, y)
    theta = np.log([gps.signal[0], *gps.length[0], gps.noise[0]])
    ours = log_marginal_likelihood(theta, X, y, True)[0]
    # L-BFGS stops at a relative change of 1e-9 of about 10.
    assert ours >= theirs.log_marginal_likelihood_value_ - 1e-3


class Linear:
    """Stands for a GP: A [x, u] with covariance diag(W)."""

    def __init__(self, A, W):
        self._A, self._W = A, W

    def mean(self, X):
        return X @ self._A.T

    def predict(self, X):
        return self.mean(X), np.tile(self._W, (len(X), 1))


@pytest.mark.parametrize("change", [False, True])
def test_propagation_of_a_linear_system_is_kalmans_prediction(change):
    rng = np.random.default_rng(0)
    A = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    B, W = rng.normal(size=(3, 2)), np.array([1e-3, 2e-3, 5e-4])
    learned = np.hstack([A - np.eye(3) if change else A, B])
    predictor = LongTermPredictor(
        _OneMode(0),
        {0: Linear(learned, W)},
        {},
        tuple(range(5)),
        np.zeros(5),
        np.ones(5),
        change,
        3,
    )
    m, C, u = rng.normal(size=3), 0.01 * np.eye(3), rng.normal(size=(20, 2))
    got = predict_long_term(predictor, m, C, known(u), 20)
    for t in range(20):
        np.testing.assert_allclose(got.mean[t], m, atol=1e-9)
        # The jitter of the sigma points adds up to 20 JITTER |A|^40 < 1e-6.
        np.testing.assert_allclose(got.std[t], np.sqrt(np.diag(C)), rtol=1e-5)
        m, C = A @ m + B @ u[t], A @ C @ A.T + np.diag(W)


def test_a_policy_closes_the_loop_of_the_propagated_distribution():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    gain, W = np.array([[3.0, 2.0]]), np.array([1e-4, 1e-3])
    predictor = LongTermPredictor(
        _OneMode(0),
        {0: Linear(np.hstack([A, B]), W)},
        {},
        (0, 1, 2),
        np.zeros(3),
        np.ones(3),
        False,
        2,
    )
    m, C = np.array([1.0, 0.0]), 0.1 * np.eye(2)
    got = predict_long_term(predictor, m, C, lambda t, x: -x @ gain.T, 30)
    closed = A - B @ gain
    for t in range(31):
        np.testing.assert_allclose(got.mean[t], m, atol=1e-9)
        np.testing.assert_allclose(got.std[t], np.sqrt(np.diag(C)), rtol=1e-5)
        m, C = closed @ m, closed @ C @ closed.T + np.diag(W)


def test_tracks_merge_to_the_moments_of_their_mixture():
    rng = np.random.default_rng(0)
    means, shares = rng.normal(size=(2, 2)), (0.3, 0.1)
    covariances = [np.diag([0.5, 0.2]), np.diag([0.1, 1.0])]
    total, mean, C = merged(list(zip(shares, means, covariances, strict=True)))
    picks = rng.random(400_000) < 0.75
    samples = np.where(
        picks[:, None],
        rng.multivariate_normal(means[0], covariances[0], len(picks)),
        rng.multivariate_normal(means[1], covariances[1], len(picks)),
    )
    assert total == pytest.approx(0.4)
    # Six standard errors of 4e5 samples of variance 1.
    np.testing.assert_allclose(mean, samples.mean(0), atol=0.01)
    np.testing.assert_allclose(C, np.cov(samples.T), atol=0.02)


def wall_trial(rng, T=60):
    """A 1 kg mass on a force-limited servo meets a wall at x = 0 without bouncing."""
    dt, x, v, rows = 0.02, -0.2 + 0.01 * rng.normal(), 0.0, []
    for k in range(T):
        goal = -0.2 + 0.4 * min(k * dt, 1.0)
        rows.append((x, v, goal))
        v += dt * (100.0 * (goal - x) - 15.0 * v) + 1e-3 * rng.normal()
        x += dt * v
        if x > 0.0:
            x, v = 0.0, 0.0
    x, v, goal = np.array(rows).T
    x = x + 1e-4 * rng.normal(size=T)
    # The wall's force is felt: what the servo asks for.
    force = np.where(x > -5e-4, 100.0 * np.maximum(goal, 0.0), 0.0)
    state = np.stack([x, v + 1e-3 * rng.normal(size=T)], axis=1)
    features = np.column_stack([state, force + 0.1 * rng.normal(size=T)])
    return TrainingTrial(state, goal[:, None], features)


BUDGET = TrainingBudget(points_per_mode=60, svm_points=400, modes_max=4, segment_min=5)


@pytest.fixture(scope="module")
def wall():
    rng = np.random.default_rng(0)
    trials = [wall_trial(rng) for _ in range(40)]
    return *train(trials, BUDGET), [wall_trial(rng) for _ in range(4)]


def from_start(predictor, trial):
    """All of a trial from its first sample."""
    T = len(trial.x) - 1
    return predict_long_term(predictor, trial.x[0], 1e-6 * np.eye(2), known(trial.u), T)


def test_gating_switches_where_the_mass_meets_the_wall(wall):
    predictor, _, tests = wall
    for trial in tests:
        start = np.diag([1e-4, 1e-6])
        got = predict_long_term(predictor, trial.x[0], start, known(trial.u), 59)
        contact = np.flatnonzero(trial.features[:, 2] > 2.0)[0]
        changes = np.flatnonzero(np.diff(got.mode)) + 1
        # Two samples at 0.4 m/s are 16 mm, of a start that varies by 10 mm.
        assert abs(changes - contact).min() <= 2
        assert not set(got.mode[: contact - 3]) & set(got.mode[contact + 3 :])


def test_true_values_are_in_the_2_sigma_band(wall):
    predictor, _, tests = wall
    inside, error = [], []
    for trial in tests:
        got = from_start(predictor, trial)
        inside.append(abs(trial.x - got.mean) <= 2.0 * got.std)
        error.append((trial.x - got.mean)[:, 0])
    # 95 % for a Gaussian; an impact at an uncertain time is none.
    assert np.mean(inside) > 0.85
    # Of a way of 0.2 m, over 60 steps without a measurement.
    assert np.sqrt(np.mean(np.square(error))) < 0.01


def test_a_band_that_is_no_band_would_be_noticed(wall):
    predictor, _, tests = wall
    got = from_start(predictor, tests[0])
    # Neither collapsed below the sensor noise nor wider than the way.
    assert 1e-4 < got.std[10:, 0].min() and got.std[:, 0].max() < 0.1


def test_one_step_with_feedback_is_better_than_the_long_term(wall):
    predictor, _, tests = wall
    trial = tests[0]
    mode, one = 0, []
    for x, u in zip(trial.x[:-1], trial.u[:-1], strict=True):
        mean, std, mode = predict_one_step(predictor, x, u, mode)
        assert np.all(std > 0.0)
        one.append(mean)
    got = from_start(predictor, trial)
    long_term = np.square(got.mean[1:] - trial.x[1:]).mean()
    assert np.square(np.array(one) - trial.x[1:]).mean() < long_term


def test_modes_of_separate_clusters_are_found_without_labels():
    rng = np.random.default_rng(0)
    truth = np.repeat([0, 1, 2], 40)
    trials = [
        np.array([[0, 0], [5, 0], [5, 5]])[truth] + 0.2 * rng.normal(size=(120, 2))
        for _ in range(3)
    ]
    for found in find_modes(trials, BUDGET):
        np.testing.assert_array_equal(found, truth)


def test_short_stays_go_to_the_mode_before():
    labels = [7, 1, 1, 1, 1, 2, 1, 1, 3, 3, 3, 3, 1]
    expected = [1, 1, 1, 1, 1, 1, 1, 1, 3, 3, 3, 3, 3]
    np.testing.assert_array_equal(without_short_stays(labels, 3), expected)


def test_a_stratified_choice_has_a_point_of_each_share():
    chosen = one_of_each_stratum(1000, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(chosen // 20, np.arange(50))


def test_the_same_seed_gives_the_same_prediction(wall):
    predictor, _, tests = wall
    rng = np.random.default_rng(0)
    again, _ = train([wall_trial(rng) for _ in range(40)], BUDGET)
    first, second = from_start(predictor, tests[0]), from_start(again, tests[0])
    np.testing.assert_array_equal(first.mean, second.mean)


def test_bad_training_data_are_refused_by_name():
    rng = np.random.default_rng(0)
    trials = [wall_trial(rng) for _ in range(3)]
    with pytest.raises(ValueError, match="trials: got 2, expected 3 or more"):
        train(trials[:2], BUDGET)
    with pytest.raises(ValueError, match="trial 2 has x .* expected"):
        train([*trials[:2], trials[2]._replace(u=trials[2].u[:-1])], BUDGET)
    broken = trials[1].x.copy()
    broken[3] = np.nan
    with pytest.raises(ValueError, match="trial 1 has a NaN"):
        train([trials[0], trials[1]._replace(x=broken), trials[2]], BUDGET)
    with pytest.raises(ValueError, match="GP data"):
        fit_gp(np.zeros((3, 2)), np.zeros((4, 1)), np.zeros(2), np.ones(2))


def test_absolute_outputs_are_learned_too():
    rng = np.random.default_rng(0)
    trials = [wall_trial(rng) for _ in range(6)]
    predictor, _ = train(trials, replace(BUDGET, predict_change=False))
    mean, _, _ = predict_one_step(predictor, trials[0].x[10], trials[0].u[10], 0)
    # A step of 20 ms, at 0.3 m/s; noise 1e-4 m.
    np.testing.assert_allclose(mean[0], trials[0].x[11, 0], atol=2e-3)
