"""Biomimetic control: one update by hand, learning a constant force, forgetting."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.diagrams.planar import PlanarSensing, knowledge_of, make_planar
from makebreak.diagrams.planar_tuned import SETTINGS
from makebreak.scripts.experiments.papers.planar_loops import learning_curve
from makebreak.scripts.experiments.papers.tune_planar import task_of
from makebreak.systems.baselines.biomimetic import Biomimetic, BiomimeticConfig
from makebreak.systems.baselines.numerics.biomimetic import (
    LearnedGains,
    after_trial,
    force_command,
    no_gains,
)
from makebreak.systems.planar.planar_world import (
    CircleTargetConfig,
    PlanarWorldConfig,
    SpringConfig,
)

PERFECT = PlanarSensing(force_noise=0.0)


def random_gains(n, rng):
    return LearnedGains(
        rng.normal(size=(n, 2)), rng.normal(size=(n, 2, 2)), rng.normal(size=(n, 2, 2))
    )


def test_one_update_is_the_rule_written_out():
    rng = np.random.default_rng(0)
    gains, e, v = random_gains(3, rng), rng.normal(size=(3, 2)), rng.normal(size=(3, 2))
    kappa, rates, a, b = 4.0, (2.0, 30.0, 5.0), 0.1, 3.0
    after = after_trial(gains, e, v, kappa, rates, a, b)
    for k in range(3):
        eps = [v[k][i] + kappa * e[k][i] for i in range(2)]
        g = a / (1.0 + b * (eps[0] ** 2 + eps[1] ** 2))
        for i in range(2):
            F = gains.force[k, i]
            assert after.force[k, i] == pytest.approx(F + 2.0 * eps[i] - g * F)
            for j in range(2):
                K, D = gains.stiffness[k, i, j], gains.damping[k, i, j]
                K_next = K + 30.0 * eps[i] * e[k][j] - g * K
                D_next = D + 5.0 * eps[i] * v[k][j] - g * D
                assert after.stiffness[k, i, j] == pytest.approx(K_next)
                assert after.damping[k, i, j] == pytest.approx(D_next)


def test_without_error_each_trial_forgets_the_fraction_a():
    gains, zero = random_gains(4, np.random.default_rng(1)), np.zeros((4, 2))
    after = gains
    for _ in range(5):
        after = after_trial(after, zero, zero, 10.0, (9.0, 9.0, 9.0), 0.2, 5.0)
    for name in ("force", "stiffness", "damping"):
        np.testing.assert_allclose(getattr(after, name), 0.8**5 * getattr(gains, name))


def test_command_is_the_sum_of_its_terms():
    rng = np.random.default_rng(2)
    state, target, gains = rng.normal(size=4), rng.normal(size=6), random_gains(1, rng)
    F, K, D = gains.force[0], gains.stiffness[0], gains.damping[0]
    fixed = np.array([20.0, 3.0])
    u, limit = force_command(state, target, F, K, D, fixed, 1.5, 1e6)
    e = state - target[:4]
    expected = 1.5 * target[4:] - F - (20.0 * np.eye(2) + K) @ e[:2]
    expected = expected - (3.0 * np.eye(2) + D) @ e[2:]
    np.testing.assert_allclose(u, expected, rtol=1e-12)
    assert not limit
    u, limit = force_command(state, target, F, K, D, fixed, 1.5, 1.0)
    np.testing.assert_allclose(u, expected / np.linalg.norm(expected), rtol=1e-12)
    assert limit


def test_learns_a_constant_force_over_trials():
    """12 N from the side, by a spring so long and soft that it is constant. At each
    time step F -> 12 N, and the error with it; nothing is forgotten."""
    world = PlanarWorldConfig(springs=[SpringConfig([1e4, 0.0], 1.2e-3, 0.0)])
    config = BiomimeticConfig(rates=[8.0, 0.0, 0.0], forget=0.0)
    known, curve = None, []
    for _ in range(25):
        controller = Biomimetic(config, 2.0, known)
        target = CircleTargetConfig(duration_sec=2.0)
        diagram = make_planar(controller, world, target, PERFECT, 0)
        simulator = Simulator(diagram)
        simulator.AdvanceTo(2.0)
        context = simulator.get_context()
        errors = np.linalg.norm(
            diagram.GetOutputPort("state").Eval(context)[:2]
            - diagram.GetOutputPort("x_desired").Eval(context)[:2]
        )
        curve.append(errors)
        known = knowledge_of(diagram, context)
    # First trial: 12 N / 200 N/m = 60 mm. Each trial leaves 1 - kappa Q_F / K_0 = 0.6
    # of it where the motion is slow.
    assert curve[0] == pytest.approx(0.06, rel=0.02)
    np.testing.assert_allclose(curve[3] / curve[2], 0.6, atol=0.03)
    np.testing.assert_allclose(known.force[60:].mean(axis=0), [12.0, 0.0], atol=0.1)


def test_a_diverging_controller_leaves_finite_numbers():
    config = BiomimeticConfig(stiffness=0.0, damping=0.0, rates=[1e3, 1e5, 1e4])
    curve = learning_curve(config, 10 * [task_of(SETTINGS["springs"], 0)])
    assert np.isfinite(curve).all() and max(curve) > 1.0


def test_knowledge_survives_a_file_and_refuses_another(tmp_path):
    gains = random_gains(5, np.random.default_rng(3))
    gains.save(tmp_path / "gains.npz")
    again = LearnedGains.load(tmp_path / "gains.npz")
    for name in ("force", "stiffness", "damping"):
        np.testing.assert_array_equal(getattr(again, name), getattr(gains, name))
    np.savez(tmp_path / "other.npz", force=np.zeros((5, 2)))
    with pytest.raises(ValueError, match="has no"):
        LearnedGains.load(tmp_path / "other.npz")


def test_errors_that_are_not_finite_teach_nothing():
    gains = random_gains(2, np.random.default_rng(4))
    e = np.array([[np.nan, 0.0], [0.1, 0.0]])
    after = after_trial(gains, e, np.zeros((2, 2)), 10.0, (1.0, 1.0, 1.0), 0.5, 1.0)
    np.testing.assert_array_equal(after.force[0], gains.force[0])
    assert (after.force[1] != gains.force[1]).any()


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(rates=[1.0, 1.0]), "rates is"),
        (dict(kappa=-1.0), "kappa is -1.0"),
        (dict(forget=1.0), "forget is 1.0"),
        (dict(step_sec=0.0105), "step_sec is 0.0105"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        Biomimetic(BiomimeticConfig(**changes), 6.0)


def test_knowledge_of_another_length_is_refused():
    with pytest.raises(ValueError, match="knowledge is of 10 time steps, expected 600"):
        Biomimetic(BiomimeticConfig(), 6.0, no_gains(10))
    with pytest.raises(ValueError, match="LearnedGains.stiffness is"):
        LearnedGains(np.zeros((3, 2)), np.zeros((2, 2, 2)), np.zeros((3, 2, 2)))
