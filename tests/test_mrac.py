"""MRAC against Lyapunov's equation, a naive tick, and a reference model."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.linalg import solve_continuous_lyapunov
from scipy.signal import StateSpace, lsim

from makebreak.systems.baselines.mrac import Mrac, MracConfig
from makebreak.systems.baselines.numerics.mrac import MEMORY, error_weights, tick
from makebreak.systems.planar.numerics.planar_world import circle_target, step

DT = 1e-3


@pytest.mark.parametrize(
    "omega, zeta, weight", [(1, 1, 1), (1.5, 0.7, 0.2), (20, 0.4, 3)]
)
def test_error_weights_are_the_last_row_of_lyapunovs_solution(omega, zeta, weight):
    A = np.array([[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]])
    P = solve_continuous_lyapunov(A.T, -np.diag([1.0, weight]))
    np.testing.assert_allclose(error_weights(omega, zeta, weight), P[1], rtol=1e-12)


@pytest.mark.parametrize("lag", [False, True])
def test_ticks_agree_with_the_equations_written_as_matrices(lag):
    rng = np.random.default_rng(0)
    w, zeta = 1.3, 0.8
    p2, p3 = error_weights(w, zeta)
    gains = np.array([40.0, 30.0, 7.0, 5.0, 3.0, 2.0])
    memory, int_q = np.zeros(MEMORY), np.zeros(2)
    integrals = [np.zeros((2, 2)) for _ in range(4)]
    x_m = None
    for _ in range(50):
        state, target = rng.normal(size=4), rng.normal(size=6)
        u, memory, _ = tick(memory, state, target, w, zeta, p2, p3, gains, lag, DT, 1e9)
        x_m = target[:4].copy() if x_m is None or not lag else x_m
        q = p2 * (x_m[:2] - state[:2]) + p3 * (x_m[2:] - state[2:])
        expected = gains[0] * q + gains[1] * int_q
        for j, z in enumerate((state[:2], state[2:], x_m[:2], x_m[2:])):
            now, summed = gains[2 + 2 * (j % 2)], gains[3 + 2 * (j % 2)]
            expected = expected + (now * np.outer(q, z) + summed * integrals[j]) @ z
            integrals[j] = integrals[j] + DT * np.outer(q, z)
        int_q = int_q + DT * q
        a = w**2 * (target[:2] - x_m[:2]) - 2 * zeta * w * x_m[2:]
        v = x_m[2:] + DT * a
        x_m = np.concatenate([x_m[:2] + DT * v, v])
        np.testing.assert_allclose(u, expected, rtol=1e-10, atol=1e-9)


def run(config, seconds, viscosity, anchor, spring, stop=None):
    """The law and the world, tick by tick; every tenth tick's x, target, x_m, u."""
    circle = (0.25, seconds, 0.0, 1.0)
    weights = error_weights(config.omega, config.zeta, config.rate_weight)
    gains = config.force_gains + config.position_gains + config.velocity_gains
    world = (
        np.full(2, viscosity),
        1.0,
        np.array([anchor]),
        np.array([[*spring, np.inf]]),
    )
    memory, x, rows = np.zeros(MEMORY), np.array([0.25, 0.0, 0.0, 0.0]), []
    for k in range(round((stop or seconds) / DT)):
        target = circle_target(k * DT, *circle)
        law = (config.omega, config.zeta, *weights, np.array(gains), config.lag)
        u, after, _ = tick(memory, x, target, *law, DT, 100.0)
        if k % 10 == 0:
            rows.append([x, target, memory[18:22] if k else target[:4], u])
        memory, x = after, step(x, k * DT, u, DT, 1.0, *world)
    return [np.array(column) for column in zip(*rows, strict=True)]


def test_adapts_until_a_known_plant_answers_as_the_reference_model():
    """A slow circle through viscosity and a spring, by the adaptive gains alone: f has
    no integral. And x_m is what scipy says that the reference model does."""
    world = (4.0, [0.0, 0.0], [9.0, 0.1])  # Viscosity, anchor, spring.
    config = MracConfig(
        omega=1.5,
        force_gains=[200.0, 0.0],
        position_gains=[0.0, 5000.0],
        velocity_gains=[0.0, 5000.0],
        lag=True,
    )
    x, target, x_m, _ = run(config, 40.0, *world)
    w = config.omega
    A = np.array([[0.0, 1.0], [-(w**2), -2.0 * w]])
    model = StateSpace(A, [[0.0], [w**2]], [[1.0, 0.0]], [[0.0]])
    t = 0.01 * np.arange(len(x))
    for i, start in enumerate((0.25, 0.0)):
        _, expected, _ = lsim(model, target[:, i], t, X0=[start, 0.0])
        # Euler's rule with 1 ms: half a step late, at up to 0.07 m/s.
        np.testing.assert_allclose(x_m[:, i], expected, atol=1e-4)
    # Without adaptation the spring's 9 (0.25 - 0.1) N stand against p2 a1 = 44 N/m and
    # the spring's own 9 N/m: 25 mm. With it, a tenth of that after the first seconds.
    error = np.linalg.norm(x[:, :2] - x_m[:, :2], axis=1)
    assert error[500:].max() < 2.5e-3
    plain = MracConfig(1.5, 1.0, 1.0, [200.0, 0.0], [0.0, 0.0], [0.0, 0.0], lag=True)
    x, _, x_m, _ = run(plain, 40.0, *world, stop=5.0)
    error = np.linalg.norm(x[:, :2] - x_m[:, :2], axis=1)
    assert error[-1] == pytest.approx(9.0 * 0.15 / (44.4 + 9.0), rel=0.02)


def test_integral_action_removes_a_constant_force():
    # A spring so long and soft that it pulls with 10 N wherever the effector is.
    x, target, _, u = run(MracConfig(), 40.0, 0.0, [1e4, 0.0], [1e-3, 0.0])
    np.testing.assert_allclose(u[-1], [-10.0, 0.0], atol=0.05)
    assert np.linalg.norm(x[-1, :2] - target[-1, :2]) < 1e-3


def loop_with(state, target, config, seconds=0.01, force_max=100.0):
    builder = DiagramBuilder()
    controller = builder.AddSystem(Mrac(config, force_max))
    for name, value in (("state", state), ("x_desired", target)):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), controller.GetInputPort(name))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(seconds)
    context = controller.GetMyContextFromRoot(simulator.get_context())
    return [controller.GetOutputPort(n).Eval(context) for n in ("u", "status")]


def test_force_never_exceeds_the_limit_and_nothing_winds_up():
    u, status = loop_with([5.0, 0.0, 0.0, 0.0], np.zeros(6), MracConfig(), 3.0)
    np.testing.assert_allclose(u, [-100.0, 0.0], atol=1e-9)
    assert status[0] == 2
    memory = np.zeros(MEMORY)
    law = (1.5, 1.0, *error_weights(1.5, 1.0), np.full(6, 100.0), False, DT, 10.0)
    _, after, limit = tick(memory, np.array([5.0, 0, 0, 0]), np.zeros(6), *law)
    assert limit and (after[:18] == 0.0).all()


def test_a_state_that_is_not_finite_holds_the_last_force():
    u, status = loop_with([np.nan, 0.0, 0.0, 0.0], np.zeros(6), MracConfig())
    np.testing.assert_array_equal(u, [0.0, 0.0])
    assert status[0] == 1


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(omega=0.0), "omega is 0.0"),
        (dict(zeta=-1.0), "zeta is -1.0"),
        (dict(rate_weight=0.0), "rate_weight is 0.0"),
        (dict(position_gains=[1.0]), "position_gains"),
        (dict(force_gains=[1.0, -1.0]), "force_gains"),
        (dict(velocity_gains=[1.0, np.inf]), "velocity_gains"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        Mrac(MracConfig(**changes))
