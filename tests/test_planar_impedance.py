"""Adaptive variable impedance in the plane, its model of the force, fixed models."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from sklearn.mixture import GaussianMixture

from makebreak.diagrams.multi_spring import (
    MultiSpringConfig,
    impedance,
    make_multi_spring,
)
from makebreak.diagrams.planar import PlanarSensing, knowledge_of, make_planar
from makebreak.systems.baselines.numerics.fixed_gmm import fit_mixture
from makebreak.systems.changing_contact.numerics.igmm import (
    IgmmConfig,
    Mixture,
    empty_mixture,
    igmm_tuning,
    learned,
    log_likelihood,
)
from makebreak.systems.planar.numerics.planar_impedance import (
    after_sample,
    features_of,
    force_command,
    new_model,
    persistence,
    predicted_force,
    stiffness_of,
    trust,
)
from makebreak.systems.planar.planar_impedance import (
    ForceModelConfig,
    PlanarImpedance,
    PlanarImpedanceConfig,
)
from makebreak.systems.planar.planar_world import (
    CircleTargetConfig,
    PlanarWorldConfig,
    SpringConfig,
)

VECTORS = igmm_tuning(IgmmConfig(sigma_ini=[0.1, 0.1, 1.0, 1.0, 1.0, 1.0]))

PERFECT = PlanarSensing(force_noise=0.0)


def test_trust_is_the_papers_logistic_function():
    r, mid = 5.0, 1.2
    for eps in (0.0, 0.7, 1.2, 3.0):
        by_paper = 1.0 - 1.0 / (1.0 + np.exp(-r * (eps - mid)))
        assert trust(eps, r, mid) == pytest.approx(by_paper, rel=1e-12)
    assert trust(mid, r, mid) == 0.5
    for eps in (1e9, np.inf):  # No overflow, and nothing is trusted.
        assert 0.0 <= trust(eps, r, mid) < 1e-300


def test_stiffness_goes_from_most_to_least_with_trust():
    assert stiffness_of(0.0, 50.0, 500.0) == 500.0
    assert stiffness_of(1.0, 50.0, 500.0) == 50.0
    assert stiffness_of(0.25, 50.0, 500.0) == pytest.approx(50.0 + 0.75 * 450.0)


def test_command_is_equation_4a():
    rng = np.random.default_rng(0)
    state, target, F = rng.normal(size=4), rng.normal(size=6), rng.normal(size=2)
    u = force_command(state, target, 0.3, 120.0, F, 1.4, 0.8, 1e9)
    D = 2.0 * 0.8 * np.sqrt(120.0 * 1.4)
    expected = 1.4 * target[4:] + 120.0 * (target[:2] - state[:2])
    expected = expected + D * (target[2:4] - state[2:]) - 0.3 * F
    np.testing.assert_allclose(u, expected, rtol=1e-12)
    # The paper's damping, sqrt(K)/4, is an eighth of critical for 1 kg.
    paper = force_command(
        np.array([0.0, 0, 1, 0]), np.zeros(6), 0, 64.0, F, 1, 0.125, 1e9
    )
    np.testing.assert_allclose(paper, [-np.sqrt(64.0) / 4.0, 0.0])


@pytest.mark.parametrize("trusted", [False, True])
def test_a_constant_force_leaves_what_is_not_fed_forward(trusted):
    """F along x, constant (a spring so long that it is): the error is F / K_max without
    a model; with one it is (1 - lambda) F / K."""
    F = 12.0
    world = PlanarWorldConfig(springs=[SpringConfig([1e4, 0.0], F / 1e4, 0.0)])
    law = PlanarImpedanceConfig(
        learn=False, adapt=trusted, steepness=4.0, error_mid=0.5
    )
    controller = PlanarImpedance(law, ForceModelConfig(), knowledge=persistence(4, 2))
    diagram = make_planar(controller, world, CircleTargetConfig(), PERFECT, 0)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(9.0)  # The target rests from 6 s on.
    context = simulator.get_context()
    error = (
        diagram.GetOutputPort("state").Eval(context)
        - diagram.GetOutputPort("x_desired").Eval(context)[:4]
    )
    lam = 1.0 / (1.0 + np.exp(-4.0 * 0.5)) if trusted else 0.0
    K = 500.0 - lam * 450.0
    # The force varies by 1e-5 of itself over 0.25 m, so the prediction is exact.
    np.testing.assert_allclose(error, [(1.0 - lam) * F / K, 0, 0, 0], atol=2e-5)
    assert diagram.GetOutputPort("stiffness").Eval(context)[0] == pytest.approx(
        K, rel=1e-4
    )


def test_features_are_vectors_or_magnitudes_along_the_motion():
    state, F = np.array([9.0, 9.0, 0.3, -0.4]), np.array([-3.0, 14.0])
    S, D = features_of(state, F, along_motion=False)
    np.testing.assert_array_equal(S, [0.3, -0.4, -3.0, 14.0])
    np.testing.assert_array_equal(D, F)
    S, D = features_of(state, F, along_motion=True)
    # Direction (0.6, -0.8): F along it is -1.8 - 11.2 = -13.
    np.testing.assert_allclose(S, [0.5, 13.0])
    np.testing.assert_allclose(D, [13.0])
    at_rest = features_of(np.zeros(4), F, along_motion=True)
    np.testing.assert_array_equal(at_rest[0], [0.0, 0.0])


@pytest.mark.parametrize("along", [False, True])
def test_persistence_predicts_the_last_force(along):
    n = (2, 1) if along else (4, 2)
    tuning = igmm_tuning(IgmmConfig(sigma_ini=[1.0] * sum(n)))
    model = new_model(tuning, persistence(*n), along)
    state = np.array([0.0, 0.0, 0.6, 0.8])
    for F in (np.array([-6.0, -8.0]), np.array([-3.0, -4.0])):
        model = after_sample(model, tuning, state, F, along, learn=False)
        predicted = predicted_force(model, state, along)
        np.testing.assert_allclose(predicted, F, rtol=1e-5)
    assert model.error == pytest.approx(5.0, rel=1e-5)


def test_predictions_are_the_conditional_mean_of_what_was_learned():
    """One component, so the regression is C_oi inv(C_ii) (x - mu) + mu, C and mu those
    of the samples (numpy), but for the first sample's own covariance."""
    rng = np.random.default_rng(1)
    wide = igmm_tuning(IgmmConfig(sigma_ini=[0.01] * 6, tau_nov=1e-300, floor=1e-6))
    model, samples = new_model(wide, None, False), []
    # A little wander, so that each sample is near the last and novelty never strikes.
    x = np.zeros(4)
    last = None
    for k in range(400):
        x = 0.9 * x + 0.003 * rng.normal(size=4)
        state, F = np.concatenate([[0.0, 0.0], x[:2]]), x[2:].copy()
        model = after_sample(model, wide, state, F, False, learn=True)
        if last is not None:
            samples.append([*last, *F])
        last = [*state[2:], *F]
        if k == 0:
            assert model.mixture.count == 0 and np.isinf(model.filtered)
    assert model.mixture.count == 1
    X = np.array(samples)
    mu, C = X.mean(axis=0), np.cov(X.T, bias=True)
    C = C + 0.01**2 * np.eye(6) / len(X)  # The first sample's.
    expected = mu[4:] + C[4:, :4] @ np.linalg.solve(C[:4, :4], np.array(last) - mu[:4])
    np.testing.assert_allclose(model.predicted, expected, rtol=1e-6, atol=1e-12)


def test_a_frozen_model_does_not_change_and_a_learning_one_does():
    mixture, _ = learned(empty_mixture(VECTORS), np.ones(6), VECTORS)
    for learn in (False, True):
        model = new_model(VECTORS, mixture, False)
        for F in (1.0, 1.1):
            state = np.array([0.0, 0.0, 1.0, 1.0])
            model = after_sample(model, VECTORS, state, F * np.ones(2), False, learn)
        assert (model.mixture is mixture) == (not learn)


def test_a_sample_that_is_not_finite_ends_the_trust_and_the_pair():
    mixture, _ = learned(empty_mixture(VECTORS), np.ones(6), VECTORS)
    model = new_model(VECTORS, mixture, False)
    good = (np.array([0.0, 0.0, 1.0, 1.0]), np.ones(2))
    for _ in range(3):
        model = after_sample(model, VECTORS, *good, False, True)
    assert np.isfinite(model.filtered)
    bad = after_sample(model, VECTORS, good[0], np.array([np.nan, 0.0]), False, True)
    assert bad.features is None and np.isinf(bad.filtered)
    assert bad.mixture is model.mixture
    np.testing.assert_array_equal(bad.predicted, [0.0, 0.0])
    again = after_sample(bad, VECTORS, *good, False, True)
    assert again.mixture is bad.mixture  # A pair takes two good samples.


LAW = PlanarImpedanceConfig(
    stiffness_free=110.0, damping_ratio=2.0, steepness=11.9, error_mid=1.78
)


def tracking(config, seed=0, knowledge=None):
    """Errors (n,) and the last context's diagram of a first trial on springs."""
    task = MultiSpringConfig(seed=seed)
    sigma = 2 * [0.0132] + 4 * [2.17]
    mixture = IgmmConfig(sigma_ini=sigma, tau_nov=0.0438, sp_max=55.7)
    model = ForceModelConfig(mixture, period_sec=0.001)
    diagram = make_multi_spring(task, impedance(config, model, knowledge))
    simulator = Simulator(diagram)
    context = simulator.get_context()
    errors = []
    for k in range(1, 601):
        simulator.AdvanceTo(0.01 * k)
        x, goal = (
            diagram.GetOutputPort(n).Eval(context)[:2] for n in ("state", "x_desired")
        )
        errors.append(np.linalg.norm(x - goal))
    return np.array(errors), diagram, context


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_springs_are_countered_softly_in_the_first_trial(seed):
    config = LAW
    ours, diagram, context = tracking(config, seed)
    stiff, _, _ = tracking(replace(config, adapt=False), seed)
    # Issue: three times better, at a quarter of the stiffness that the other has.
    assert 3.0 * np.sqrt(np.mean(ours**2)) < np.sqrt(np.mean(stiff**2))
    assert diagram.GetOutputPort("stiffness").Eval(context)[0] < 125.0
    known = knowledge_of(diagram, context)
    assert known.count > 0
    later, _, _ = tracking(config, seed, known)
    assert later[:50].max() < ours[:50].max()  # It knows the springs from the start.


def test_a_restored_context_replays_the_rest_of_the_trial():
    task = MultiSpringConfig(seed=3)
    diagram = make_multi_spring(task, impedance(task.impedance, task.model))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.5)
    copy = simulator.get_context().Clone()
    simulator.AdvanceTo(0.8)
    again = Simulator(diagram, copy)
    again.AdvanceTo(0.8)
    for name in ("state", "u", "stiffness", "force_predicted"):
        port = diagram.GetOutputPort(name)
        np.testing.assert_array_equal(
            port.Eval(simulator.get_context()), port.Eval(again.get_context())
        )


def held(state, force, seconds=0.02):
    builder = DiagramBuilder()
    controller = builder.AddSystem(
        PlanarImpedance(PlanarImpedanceConfig(), ForceModelConfig())
    )
    for name, value in (("state", state), ("x_desired", np.zeros(6)), ("force", force)):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), controller.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(seconds)
    context = controller.GetMyContextFromRoot(simulator.get_context())
    names = ("u", "stiffness", "status")
    return [controller.GetOutputPort(n).Eval(context) for n in names]


def test_a_dead_force_sensor_means_full_stiffness_and_no_feed_forward():
    u, stiffness, status = held([0.1, 0.0, 0.0, 0.0], [np.nan, np.nan])
    np.testing.assert_allclose(u, [-50.0, 0.0])
    assert stiffness[0] == 500.0 and status[0] == 4


def test_a_state_that_is_not_finite_holds_the_force():
    u, _, status = held([np.nan, 0.0, 0.0, 0.0], [0.0, 0.0])
    np.testing.assert_array_equal(u, [0.0, 0.0])
    assert int(status[0]) & 1


def test_force_stays_within_its_limit():
    u, _, status = held([9.0, 0.0, 0.0, 0.0], [0.0, 0.0])
    np.testing.assert_allclose(u, [-100.0, 0.0])
    assert int(status[0]) & 2


@pytest.mark.parametrize(
    "law, model, message",
    [
        (dict(stiffness_max=10.0), {}, "stiffness_max is 10.0"),
        (dict(damping_ratio=0.0), {}, "damping_ratio is 0.0"),
        (dict(steepness=-1.0), {}, "steepness is -1.0"),
        ({}, dict(period_sec=0.0005), "period_sec is 0.0005"),
        ({}, dict(along_motion=True), "sigma_ini has 6 entries, expected 3"),
    ],
)
def test_wrong_settings_are_refused_by_name(law, model, message):
    with pytest.raises(ValueError, match=message):
        PlanarImpedance(PlanarImpedanceConfig(**law), ForceModelConfig(**model))


def test_knowledge_of_other_features_is_refused():
    with pytest.raises(ValueError, match="knowledge is over 3 entries, expected 6"):
        PlanarImpedance(
            PlanarImpedanceConfig(), ForceModelConfig(), knowledge=persistence(2, 1)
        )


def test_the_fixed_mixture_is_scikit_learns_with_the_least_bic():
    rng = np.random.default_rng(0)
    X = np.vstack([rng.normal(m, 0.3, size=(200, 3)) for m in (-4.0, 0.0, 5.0)])
    mixture = fit_mixture(X, n_max=5)
    assert mixture.count == 3
    scale = X.std(axis=0)
    fit = GaussianMixture(3, random_state=0, reg_covar=1e-6).fit(X / scale)
    ours = [log_likelihood(mixture, x) for x in X[::60]]
    theirs = fit.score_samples(X[::60] / scale) - np.log(scale).sum()
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert isinstance(mixture, Mixture)
    assert fit_mixture(X, 2, 2).count == 2


def test_wrong_samples_for_a_fixed_mixture_are_refused():
    with pytest.raises(ValueError, match="9 samples"):
        fit_mixture(np.zeros((9, 3)), n_max=1)
    with pytest.raises(ValueError, match="finite"):
        fit_mixture(np.full((100, 3), np.nan))
    with pytest.raises(ValueError, match="n_min is 4"):
        fit_mixture(np.zeros((100, 3)), 4, 2)
