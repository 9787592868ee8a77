"""Active inference control against its equations, and its lag in closed form."""

import numpy as np
import pytest

from makebreak.systems.baselines.active_inference import (
    ActiveInference,
    ActiveInferenceConfig,
)
from makebreak.systems.baselines.numerics.active_inference import MEMORY, tick
from makebreak.systems.planar.numerics.planar_world import step

DT = 1e-3
P, K_MU, K_A = np.array([1.0, 1.0, 0.2, 0.2]), 20.0, 1200.0


def test_ticks_agree_with_the_gradient_of_the_free_energy():
    """The updates are mu' - k dF/dmu, and so on, with F the sum of the weighted squares
    over two; its gradients by finite differences. (In the source the belief's errors
    count for dF/dmu'' only by the second one.)"""

    def free_energy(mu, mu1, mu2, x, v, goal):
        e = (x - mu, v - mu1, mu1 + mu - goal, mu2 + mu1)
        return 0.5 * sum(w * np.sum(a * a) for w, a in zip(P, e, strict=True))

    rng = np.random.default_rng(0)
    memory, state = np.zeros(MEMORY), rng.normal(size=4)
    memory[8] = 1.0
    memory[:8] = rng.normal(size=8)
    target = rng.normal(size=6)
    goal = target[:2]
    _, after, _ = tick(memory, state, target, False, P, K_MU, K_A, DT, 1e9)
    z = [memory[0:2], memory[2:4], memory[4:6]]
    shifted = [z[1], z[2], np.zeros(2)]
    for j in range(3):
        gradient = np.zeros(2)
        for i in range(2):
            for sign in (1.0, -1.0):
                moved = [a.copy() for a in z]
                moved[j][i] += sign * 1e-5
                F = free_energy(*moved, state[:2], state[2:], goal)
                gradient[i] += sign * F / 2e-5
        expected = z[j] + DT * (shifted[j] - K_MU * gradient)
        np.testing.assert_allclose(after[2 * j : 2 * j + 2], expected, atol=1e-9)
    # dF/du with dx/du = dv/du = 1.
    e_y, e_y1 = state[:2] - z[0], state[2:] - z[1]
    expected = memory[6:8] - DT * K_A * (P[0] * e_y + P[1] * e_y1)
    np.testing.assert_allclose(after[6:8], expected, rtol=1e-12)


def follow(goal_at, seconds, viscosity, push=0.0, moves=False):
    """A point of 1 kg under the law; returns states and forces. The goal moves at a
    steady rate."""
    memory, state = np.zeros(MEMORY), np.zeros(4)
    none = (np.zeros((0, 2)), np.zeros((0, 2)))
    states, forces = [], []
    for k in range(round(seconds / DT)):
        goal = goal_at(k * DT)
        rate = (goal_at((k + 1) * DT) - goal) / DT
        target = np.concatenate([goal, rate, np.zeros(2)])
        u, memory, _ = tick(memory, state, target, moves, P, K_MU, K_A, DT, 100.0)
        pushed = u + np.array([push, 0.0])
        c = np.array([viscosity, viscosity])
        state = step(state, k * DT, pushed, DT, 1.0, c, 1.0, *none)
        states.append(state)
        forces.append(u)
    return np.array(states), np.array(forces)


def test_reaches_a_fixed_goal_against_an_unknown_force():
    x, u = follow(lambda t: np.array([0.2, -0.1]), 40.0, 20.0, push=-15.0)
    np.testing.assert_allclose(x[-1], [0.2, -0.1, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(u[-1], [15.0, 0.0], atol=1e-2)


def test_lags_behind_a_moving_goal_by_what_the_equations_say():
    """Steady state at speed s: all errors constant. Unknowns e_y, e_y', e_m, mu'; mu''
    stays where e_m' = 0, so mu'' = -mu'. In thick porridge the force is constant."""
    s = 0.05
    k = K_MU
    # e_y' = s - mu';  mu_dot = s;  mu'_dot = 0;  u_dot = 0.
    A = np.array(
        [
            [0.0, 1.0, 0.0, 1.0],
            [k * P[0], 0.0, -k * P[2], 1.0],
            [0.0, k * P[1], -k * P[2], -1.0],
            [P[0], P[1], 0.0, 0.0],
        ]
    )
    e_y, _, e_m, mu1 = np.linalg.solve(A, [s, s, 0.0, 0.0])
    lag = mu1 - e_m - e_y  # x_d - x
    x, _ = follow(lambda t: np.array([s * t, 0.0]), 60.0, 20.0)
    goal = s * (60.0 - DT)
    # The last state is one period, 0.05 mm, after the last goal.
    assert goal - x[-1, 0] == pytest.approx(lag, abs=2e-4)
    assert 0.7 * s < lag < 1.3 * s  # About a second.


def test_a_goal_that_is_known_to_move_is_followed_without_a_lag():
    s = 0.05
    x, _ = follow(lambda t: np.array([s * t, 0.0]), 60.0, 20.0, moves=True)
    assert x[-1, 0] == pytest.approx(s * 60.0, abs=2e-4)


def test_the_model_of_a_moving_goal_counts_its_velocity_and_acceleration():
    """As if the goal were a point p + v that moves at v + a."""
    rng = np.random.default_rng(1)
    memory, state, target = rng.normal(size=MEMORY), rng.normal(size=4), np.zeros(6)
    memory[8] = 1.0
    p, v, a = rng.normal(size=(3, 2))
    target[:2] = p + v
    _, still, _ = tick(memory, state, target, False, P, K_MU, K_A, DT, 1e9)
    target = np.concatenate([p, v, a])
    _, moving, _ = tick(memory, state, target, True, P, K_MU, K_A, DT, 1e9)
    more = DT * K_MU * P[3] * (v + a)
    np.testing.assert_allclose(moving[:2], still[:2], rtol=1e-12)
    np.testing.assert_allclose(moving[2:4], still[2:4] + more, rtol=1e-12)
    np.testing.assert_allclose(moving[4:6], still[4:6] + more, rtol=1e-12)


def test_force_stays_within_its_limit():
    _, u = follow(lambda t: np.array([50.0, 0.0]), 2.0, 1.0)
    assert np.linalg.norm(u, axis=1).max() <= 100.0 * (1.0 + 1e-12)
    assert np.linalg.norm(u, axis=1).max() > 99.0


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(variance=[1.0, 1.0, 0.0, 1.0]), "variance is"),
        (dict(variance=[1.0]), "variance is"),
        (dict(k_belief=0.0), "k_belief is 0.0"),
        (dict(k_action=-2.0), "k_action is -2.0"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        ActiveInference(ActiveInferenceConfig(**changes))
