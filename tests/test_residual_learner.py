"""The residual learner: first its maths, then the system in small diagrams."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource
from scipy.optimize import lsq_linear

from makebreak.systems.baselines.dynamics_residual_learner import (
    DynamicsResidualLearner,
    DynamicsResidualLearnerConfig,
    DynamicsStatus,
)
from makebreak.systems.contact_mpc.lcs_plant import LcsPlant
from makebreak.systems.contact_mpc.numerics import residual_learner as numerics
from makebreak.systems.contact_mpc.numerics.lcp import solve_lcp
from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    empty_buffer,
    gamma_bound,
    group_of_entry,
    learn,
    measured_step,
    spread,
    violation_loss,
    zero_residual,
)
from makebreak.systems.contact_mpc.residual_learner import (
    AdamConfig,
    LearnerStatus,
    ResidualLearner,
    ResidualLearnerConfig,
)

REFERENCE = Path(__file__).parent / "reference"
MATRICES = ("A", "B", "D", "d", "E", "F", "H", "c")


def reference_samples():
    data = np.load(REFERENCE / "violation_loss.npz")
    return LCS(*(data[name] for name in MATRICES), dt=1.0), data


def random_problem(rng, n_x=9, n_u=3, n_contacts=2, eps_c=5e-4, dt=0.05):
    """An LCS whose F has the structure of frictional contact: singular but for eps_c.

    Returns: the LCS; x, u and the x_next that an LCS with another c gives.
    """
    n_lam = 4 * n_contacts
    J = np.repeat(rng.normal(size=(n_contacts, n_x)), 4, axis=0)
    J += 0.5 * np.kron(np.ones((n_contacts, 1)), rng.normal(size=(4, n_x)))
    D = dt * J.T
    F = J @ D + eps_c * np.eye(n_lam)
    A, B = np.eye(n_x), dt * rng.normal(size=(n_x, n_u))
    E, H = J @ A, J @ B
    c = 0.2 * rng.normal(size=n_lam)
    lcs = LCS(A, B, D, np.zeros(n_x), E, F, H, c, dt)
    x, u = 0.1 * rng.normal(size=n_x), rng.normal(size=n_u)
    truth = lcs.with_residual(0.2 * rng.normal(size=n_lam))
    return lcs, x, u, simulate(truth, x, u)[0]


def test_loss_and_gradient_agree_with_the_reference_values():
    """The reference writes the squares without the factors 1/2 of the paper:

        |D lam + z|^2 + 1/eps (lam'eta + 1/gamma |eta - s|^2)

    which is the paper's loss with Q_d = 2 and gamma / 2.
    """
    lcs, data = reference_samples()
    steps = empty_buffer(lcs.n_lam)
    for x, u, x_next in zip(data["x"], data["u"], data["xnext"], strict=True):
        steps = steps.append(
            measured_step(lcs, x, u, x_next, np.full(lcs.n_x, 2.0), eps=1.0), 12
        )
    loss, gradient, lam, _ = violation_loss(steps, np.zeros(3), eps=1.0, gamma=0.005)
    # The reference comes from an interior-point solver.
    np.testing.assert_allclose(loss, data["g0.01_e1.0_loss"], atol=1e-9)
    np.testing.assert_allclose(gradient, data["g0.01_e1.0_grad_c"], atol=1e-9)
    np.testing.assert_allclose(lam, data["g0.01_e1.0_lam"], atol=1e-9)
    np.testing.assert_allclose(loss.mean(), data["g0.01_e1.0_mean_loss"], atol=1e-9)
    np.testing.assert_allclose(
        gradient.mean(axis=0), data["g0.01_e1.0_mean_grad"], atol=1e-9
    )


@pytest.mark.parametrize("seed", range(10))
def test_gradient_is_the_slope_of_the_loss(seed):
    rng = np.random.default_rng(seed)
    lcs, x, u, x_next = random_problem(rng)
    Q_d = rng.uniform(0.0, 1e5, size=lcs.n_x)
    steps = measured_step(lcs, x, u, x_next, Q_d, eps=2e-6)
    r = 0.1 * rng.normal(size=lcs.n_lam)

    def loss(r):
        return violation_loss(steps, r, 2e-6, 5e-4)[0][0]

    gradient = violation_loss(steps, r, 2e-6, 5e-4)[1][0]
    h = 1e-6  # The loss is quadratic around almost every r: central differences are
    # exact there up to rounding, 1e-16 loss/h, plus a kink's share when one is crossed.
    slope = [(loss(r + h * e) - loss(r - h * e)) / (2 * h) for e in np.eye(lcs.n_lam)]
    scale = abs(gradient).max() + 1e-9 * loss(r) / h
    np.testing.assert_allclose(slope, gradient, atol=1e-4 * scale)


@pytest.mark.parametrize("seed", range(20))
def test_loss_is_the_minimum_that_a_bounded_least_squares_solver_finds(seed):
    rng = np.random.default_rng(seed)
    lcs, x, u, x_next = random_problem(rng)
    eps, gamma = 0.3, 0.5 * gamma_bound(lcs.F)
    r = 0.1 * rng.normal(size=lcs.n_lam)
    Q_d = rng.uniform(0.5, 2.0, size=lcs.n_x)
    steps = measured_step(lcs, x, u, x_next, Q_d, eps)
    loss, _, lam, eta = violation_loss(steps, r, eps, gamma)
    # The joint QP in (lam, eta), written down from the paper and factored.
    n, identity = lcs.n_lam, np.eye(lcs.n_lam)
    S = np.hstack([lcs.F, -identity]) / np.sqrt(gamma)
    DQ = lcs.D.T * Q_d
    hessian = S.T @ S + np.kron([[0, 1], [1, 0]], identity)
    hessian[:n, :n] += eps * DQ @ lcs.D
    b = lcs.E @ x + lcs.H @ u + lcs.c + r
    z = lcs.A @ x + lcs.B @ u + lcs.d - x_next
    linear = S.T @ b / np.sqrt(gamma)
    linear[:n] += eps * DQ @ z
    L = np.linalg.cholesky(hessian)
    solution = lsq_linear(L.T, -np.linalg.solve(L, linear), (0, np.inf), tol=1e-14).x
    expected = 0.5 * z @ (Q_d * z) + 0.5 * b @ b / (eps * gamma)
    expected += (0.5 * solution @ hessian @ solution + linear @ solution) / eps
    # The condition number of the QP is up to 1e6.
    np.testing.assert_allclose(loss[0], expected, rtol=1e-8, atol=1e-10)
    scale = abs(solution).max()
    np.testing.assert_allclose([*lam[0], *eta[0]], solution, atol=1e-5 * scale)


def lemke_of(P, p, F, b, gamma):
    """lam and eta of solve_step from the LCP of the QP's optimality conditions."""
    n, identity = b.size, np.eye(b.size)
    hessian = np.block(
        [
            [P + F.T @ F / gamma, identity - F.T / gamma],
            [identity - F / gamma, identity / gamma],
        ]
    )
    solution = solve_lcp(hessian, np.concatenate([p + F.T @ b / gamma, -b / gamma]))
    return solution[:n], solution[n:]


@pytest.mark.parametrize("at_once", [numerics.AT_ONCE, -1000])
def test_active_set_and_lemke_find_the_same_exact_solution(at_once, monkeypatch):
    """Also where it changes one entry at a time from the start."""
    monkeypatch.setattr(numerics, "AT_ONCE", at_once)
    solve_step = numerics.solve_step
    if at_once < 0:
        solve_step = solve_step.py_func  # Compiled code keeps the constant.
    rng = np.random.default_rng(0)
    for _ in range(300):
        lcs, x, u, x_next = random_problem(rng, n_contacts=int(rng.integers(1, 4)))
        eps = 10.0 ** rng.uniform(-8, 0)
        Q_d = 10.0 ** rng.uniform(0, 5, size=lcs.n_x)
        step = measured_step(lcs, x, u, x_next, Q_d, eps)
        # A copy of q, as the learner has: what may be written is compiled by itself.
        problem = (step.P[0], step.p[0], step.F[0], step.q[0].copy(), 5e-4)
        ours = solve_step(*problem)
        assert ours[0]
        for a, b in zip(ours[2:4], lemke_of(*problem), strict=True):
            # Both solve the same equations for the free entries: equal to rounding
            # times the condition number of F + F' - gamma, at most 1e4.
            np.testing.assert_allclose(a, b, atol=1e-10 * (1e-3 + abs(b).max()))
        _, _, lam, eta, force = ours
        assert (lam >= 0).all() and (eta >= 0).all()
        slope = step.P[0] @ lam + step.p[0] + eta + step.F[0].T @ force
        terms = abs(step.p[0]).max() + abs(eta).max() + abs(force).max()
        # Rounding of s = b + F lam, 1e-16, comes in divided by gamma.
        assert slope.min() >= -1e-10 * terms
        assert abs(slope * (lam > 0)).max() <= 1e-10 * terms * abs(lam).max()


def test_a_corner_of_the_problem_is_solved():
    """b = 0 and z = 0: every entry is on the edge of being free."""
    lcs = random_problem(np.random.default_rng(0))[0]
    lcs = replace(lcs, c=np.zeros(lcs.n_lam))
    x, u = np.zeros(lcs.n_x), np.zeros(lcs.n_u)
    steps = measured_step(lcs, x, u, x, np.ones(lcs.n_x), 1e-3)
    loss, gradient, lam, eta = violation_loss(steps, np.zeros(lcs.n_lam), 1e-3, 5e-4)
    for value in (loss, gradient, lam, eta):
        np.testing.assert_array_equal(value, 0.0)


def test_no_gradient_where_the_right_model_meets_its_own_data():
    rng = np.random.default_rng(0)
    for _ in range(20):
        lcs, x, u, _ = random_problem(rng)
        x_next, lam_true = simulate(lcs, x, u)
        steps = measured_step(lcs, x, u, x_next, np.ones(lcs.n_x), 1e-2)
        loss, gradient, _, _ = violation_loss(steps, np.zeros(lcs.n_lam), 1e-2, 5e-4)
        # F's smallest eigenvalue is 5e-4, so forces are known to 1e-16 / 5e-4.
        np.testing.assert_allclose(loss, 0.0, atol=1e-15)
        np.testing.assert_allclose(gradient, 0.0, atol=1e-8)


def test_forces_as_impulses_give_the_same_loss_with_the_constants_converted():
    lcs, x, u, x_next = random_problem(np.random.default_rng(0))
    r, Q_d = np.full(lcs.n_lam, 0.05), np.ones(lcs.n_x)
    eps, gamma = 2e-6, 5e-4
    impulse = replace(lcs, D=lcs.D / lcs.dt, F=lcs.F / lcs.dt)
    loss, gradient, lam, _ = violation_loss(
        measured_step(lcs, x, u, x_next, Q_d, eps), r, eps, gamma
    )
    eps, gamma = eps * lcs.dt, gamma / lcs.dt
    other, other_gradient, other_lam, _ = violation_loss(
        measured_step(impulse, x, u, x_next, Q_d, eps), r, eps, gamma
    )
    np.testing.assert_allclose(other, loss, rtol=1e-9)
    np.testing.assert_allclose(other_gradient, gradient, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(other_lam, lam * lcs.dt, rtol=1e-6, atol=1e-12)


def test_gamma_beyond_its_bound_is_refused():
    lcs, data = reference_samples()
    x, u, x_next = data["x"][0], data["u"][0], data["xnext"][0]
    steps = measured_step(lcs, x, u, x_next, np.ones(lcs.n_x), 1.0)
    # sigma_min of F + F' by the singular values, as the paper defines the bound.
    bound = np.linalg.svd(lcs.F + lcs.F.T, compute_uv=False)[-1]
    violation_loss(steps, np.zeros(3), 1.0, 0.999 * bound)
    for gamma in (1.001 * bound, 0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="gamma is .*, expected 0 < gamma < 2.00"):
            violation_loss(steps, np.zeros(3), 1.0, gamma)


def adam_by_the_book(gradients, rate, decay=(0.9, 0.999), epsilon=1e-8):
    """Kingma and Ba, algorithm 1, from value 0."""
    value = m = v = 0.0
    for t, g in enumerate(gradients, start=1):
        m = decay[0] * m + (1 - decay[0]) * g
        v = decay[1] * v + (1 - decay[1]) * g**2
        m_hat, v_hat = m / (1 - decay[0] ** t), v / (1 - decay[1] ** t)
        value -= rate * m_hat / (np.sqrt(v_hat) + epsilon)
    return value


def learner_arguments(lcs, **changes):
    arguments = dict(eps=1.0, gamma=0.005, learning_rate=1e-2, n_steps=3, r_max=1.0)
    return group_of_entry([], lcs.n_lam), arguments | changes


def buffer_of(lcs, data, rows, Q_d=2.0):
    steps = empty_buffer(lcs.n_lam)
    for k in rows:
        x, u, x_next = data["x"][k], data["u"][k], data["xnext"][k]
        weights = np.full(lcs.n_x, Q_d)
        steps = steps.append(measured_step(lcs, x, u, x_next, weights, 1.0), 100)
    return steps


def test_learning_steps_are_adams_on_the_mean_gradient():
    lcs, data = reference_samples()
    steps = buffer_of(lcs, data, range(6))
    group, arguments = learner_arguments(lcs)
    gradients = []
    for n_steps in range(4):  # r after 0, 1, 2, 3 Adam steps, all from zero.
        arguments["n_steps"] = max(n_steps, 1)
        residual, loss, solved = learn(steps, zero_residual(3), group, **arguments)
        assert solved
        r = spread(residual, group) if n_steps else np.zeros(3)
        if gradients:
            expected = [adam_by_the_book(g, 1e-2) for g in np.transpose(gradients)]
            np.testing.assert_allclose(r, expected, rtol=1e-9)
        losses, gradient, _, _ = violation_loss(steps, r, 1.0, 0.005)
        gradients.append(gradient.mean(axis=0))
        if n_steps == 0:
            np.testing.assert_allclose(loss, losses.mean(), rtol=1e-12)


def test_grouped_entries_share_the_mean_gradient_and_others_stay_zero():
    lcs, data = reference_samples()
    steps = buffer_of(lcs, data, range(6))
    group = group_of_entry([[0, 2]], 3)
    _, arguments = learner_arguments(lcs, n_steps=1)
    residual, _, _ = learn(steps, zero_residual(1), group, **arguments)
    gradient = violation_loss(steps, np.zeros(3), 1.0, 0.005)[1].mean(axis=0)
    shared = adam_by_the_book([gradient[[0, 2]].mean()], 1e-2)
    np.testing.assert_allclose(spread(residual, group), [shared, 0, shared], rtol=1e-9)


def test_an_entry_without_gradient_does_not_move_even_with_momentum():
    lcs, data = reference_samples()
    group, arguments = learner_arguments(lcs, n_steps=1)
    residual, _, _ = learn(
        buffer_of(lcs, data, [2]), zero_residual(3), group, **arguments
    )
    assert (residual.value != 0.0).all()
    # Sample 11 has no gradient at all: the reference says so, to rounding.
    assert abs(data["g0.01_e1.0_grad_c"][11]).max() < 1e-9
    x, u = data["x"][11], data["u"][11]
    exact = lcs.with_residual(spread(residual, group))
    step = measured_step(lcs, x, u, simulate(exact, x, u)[0], np.ones(4), 1.0)
    after, _, _ = learn(step, residual, group, **arguments)
    np.testing.assert_array_equal(after.value, residual.value)


def test_residual_never_leaves_its_bound():
    lcs, data = reference_samples()
    group, arguments = learner_arguments(lcs, n_steps=200, r_max=0.05)
    residual, _, _ = learn(
        buffer_of(lcs, data, range(12)), zero_residual(3), group, **arguments
    )
    # Every sample pulls r up (the reference's gradients are negative).
    np.testing.assert_allclose(residual.value, 0.05, rtol=0)


def test_buffer_keeps_the_last_steps_and_cannot_be_edited():
    lcs, data = reference_samples()
    steps, newest = buffer_of(lcs, data, range(5)), buffer_of(lcs, data, [5])
    rolled = steps.append(newest, 3)
    assert len(rolled) == 3
    np.testing.assert_array_equal(rolled.q, buffer_of(lcs, data, [3, 4, 5]).q)
    with pytest.raises(ValueError, match="read-only"):
        rolled.q[0] = 0.0


@pytest.mark.parametrize(
    "groups, message",
    [([[0, 3]], "entry 3"), ([[0], [0]], "entry 0 twice"), ([[]], "empty group")],
)
def test_wrong_groups_are_refused(groups, message):
    with pytest.raises(ValueError, match=message):
        group_of_entry(groups, 3)


# The system.


class Script(LeafSystem):
    """Plays rows of x, u, enable and a list of LCS, one per tick, as ports."""

    def __init__(self, x, u, lcs, enable, period):
        super().__init__()

        def row(context, n):
            return min(int(np.floor(context.get_time() / period + 1e-6)), n - 1)

        def vector(name, rows):
            self.DeclareVectorOutputPort(
                name,
                rows.shape[1],
                lambda c, out: out.SetFromVector(rows[row(c, len(rows))]),
                {self.time_ticket()},
            )

        vector("x", x)
        vector("u", u)
        vector("enable", enable)
        self.DeclareAbstractOutputPort(
            "lcs",
            lambda: Value(lcs[0]),
            lambda c, out: out.set_value(lcs[row(c, len(lcs))]),
            {self.time_ticket()},
        )


def point_mass(gap=0.0, dt=0.05, eps_c=5e-4):
    """1 kg on a line with a wall at gap: w = gap/dt - q/dt - v_next + eps_c lam."""
    A, B = np.array([[1, dt], [0, 1]]), np.array([[dt**2], [dt]])
    D = -B
    E = np.array([[-1 / dt, -1.0]])
    F, H = np.array([[dt + eps_c]]), np.array([[-dt]])
    return LCS(A, B, D, np.zeros(2), E, F, H, [gap / dt], dt)


PUSH = 2.0  # Force that holds the mass against the wall [N].


def scripted(n=8, config=None, lcs=None, edit=None):
    """A point mass rests against a wall at 0, pushed; the model's wall is at 5 mm.

    Returns: simulator, learner. edit(x, u, lcs, enable) may change the script.
    """
    truth, period = point_mass(), 0.05
    x = np.zeros((n, 2))
    for k in range(n - 1):
        x[k + 1] = simulate(truth, x[k], [PUSH])[0]
    u, enable = np.full((n, 1), PUSH), np.ones((n, 1))
    all_lcs = lcs or [point_mass(5e-3)] * n
    if edit:
        edit(x, u, all_lcs, enable)
    builder = DiagramBuilder()
    script = builder.AddSystem(Script(x, u, all_lcs, enable, period))
    config = config or ResidualLearnerConfig(eps=1.0)
    learner = builder.AddSystem(ResidualLearner(config, all_lcs[0], period, 1e-3))
    for port, name in (("x", "x"), ("u", "u_measured"), ("lcs", "lcs")):
        builder.Connect(script.GetOutputPort(port), learner.GetInputPort(name))
    builder.Connect(script.GetOutputPort("enable"), learner.GetInputPort("enable"))
    return Simulator(builder.Build()), learner


def outputs(simulator, learner):
    context = learner.GetMyContextFromRoot(simulator.get_context())
    names = ("r_comp", "loss", "status")
    return [learner.GetOutputPort(name).Eval(context) for name in names]


def after_tick(simulator, k):
    simulator.AdvanceTo(k * 0.05 + 2e-3)


def test_before_two_samples_r_is_zero_and_status_says_waiting():
    simulator, learner = scripted()
    for k in (None, 0):
        if k is not None:
            after_tick(simulator, k)
        r, _, status = outputs(simulator, learner)
        assert r == 0.0 and status == LearnerStatus.WAITING
    after_tick(simulator, 1)
    r, loss, status = outputs(simulator, learner)
    # The wall is nearer than the model's: r goes down, one Adam step of 3e-3.
    np.testing.assert_allclose(r, -3e-3, rtol=1e-3)
    assert loss > 0.0 and status == LearnerStatus.LEARNED


def test_learns_the_gap_error_over_dt():
    config = ResidualLearnerConfig(eps=1e-1, adam=AdamConfig(n_steps=5), Q_d=[0.0, 1e3])
    simulator, learner = scripted(n=60, config=config)
    after_tick(simulator, 59)
    r, loss, _ = outputs(simulator, learner)
    # Adam dithers by about its step.
    np.testing.assert_allclose(r * 0.05, -5e-3, atol=3e-3 * 0.05)


def test_a_pair_uses_the_lcs_read_at_its_first_sample():
    """Each tick's LCS has a weight-one d of its own; only the pair's own explains it.

    Sample k's LCS predicts x_next = x + d_k, and the scripted x follows these.
    """
    n = 6
    d = np.random.default_rng(0).normal(size=(n, 2))
    base = point_mass(1e3)  # Far from the wall.
    all_lcs = [replace(base, A=np.eye(2), B=np.zeros((2, 1)), d=row) for row in d]

    def edit(x, u, lcs, enable):
        x[1:] = np.cumsum(d[:-1], axis=0)
        x[0] = 0.0

    simulator, learner = scripted(n=n, lcs=all_lcs, edit=edit)
    after_tick(simulator, n - 1)
    _, loss, status = outputs(simulator, learner)
    assert status == LearnerStatus.LEARNED
    np.testing.assert_allclose(loss, 0.0, atol=1e-20)  # |rounding|^2 of d.


def test_the_builder_must_run_before_the_learner_and_then_pairs_fit():
    """In a diagram: the LCS is made at the measured x by an event just before ours."""

    class Builder(LeafSystem):
        """Holds an LCS that predicts x_next = 2 x only at the x that it saw."""

        def __init__(self, offset_sec):
            super().__init__()
            self._x = self.DeclareVectorInputPort("x", 2)
            index = self.DeclareAbstractState(Value(self.lcs_at(np.zeros(2))))
            self.DeclareStateOutputPort("lcs", index)
            self.DeclarePeriodicUnrestrictedUpdateEvent(0.05, offset_sec, self._update)

        @staticmethod
        def lcs_at(x):
            zero = np.zeros((2, 1))
            return replace(point_mass(1e3), A=np.zeros((2, 2)), B=zero, d=2 * x)

        def _update(self, context, state):
            lcs = self.lcs_at(self._x.Eval(context))
            state.get_mutable_abstract_state(0).set_value(lcs)

    def final_loss(offset_sec):
        zero = np.zeros((2, 1))
        doubling = replace(point_mass(1e3), A=2 * np.eye(2), B=zero)
        builder = DiagramBuilder()
        plant = builder.AddSystem(LcsPlant(doubling, [1.0, -1.0]))
        push = builder.AddSystem(ConstantVectorSource([0.0]))
        lcs = builder.AddSystem(Builder(offset_sec))
        learner = builder.AddSystem(
            ResidualLearner(
                ResidualLearnerConfig(), Builder.lcs_at(np.ones(2)), 0.05, 0.002
            )
        )
        builder.Connect(push.get_output_port(), plant.GetInputPort("u"))
        builder.Connect(push.get_output_port(), learner.GetInputPort("u_measured"))
        builder.Connect(plant.GetOutputPort("x"), lcs.GetInputPort("x"))
        builder.Connect(plant.GetOutputPort("x"), learner.GetInputPort("x"))
        builder.Connect(lcs.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
        simulator = Simulator(builder.Build())
        after_tick(simulator, 5)
        return outputs(simulator, learner)[1][0]

    assert final_loss(offset_sec=0.001) == 0.0
    assert final_loss(offset_sec=0.003) > 0.0  # Too late: it is the last sample's.


@pytest.mark.parametrize(
    "what", ["x", "u", "lcs", "lcs_of_another_dt", "enable", "enable_nan"]
)
def test_bad_samples_are_dropped_and_r_is_held(what):
    bad = 3
    expected = LearnerStatus.DISABLED if "enable" in what else LearnerStatus.NOT_FINITE
    if what == "lcs_of_another_dt":
        expected = LearnerStatus.BAD_LCS

    def edit(x, u, lcs, enable):
        if what == "x":
            x[bad, 1] = np.nan
        elif what == "u":
            u[bad] = np.inf
        elif what == "lcs":
            lcs[bad] = replace(lcs[bad], d=[np.nan, 0.0])
        elif what == "lcs_of_another_dt":
            lcs[bad] = replace(lcs[bad], dt=0.1)
        else:
            enable[bad] = np.nan if what == "enable_nan" else 0.0

    simulator, learner = scripted(edit=edit)
    after_tick(simulator, bad - 1)
    r_before = outputs(simulator, learner)[0]
    after_tick(simulator, bad)
    r, loss, status = outputs(simulator, learner)
    assert status == expected
    np.testing.assert_array_equal(r, r_before)
    after_tick(simulator, bad + 1)
    # A bad u spoils one pair only; a bad sample, the pair that it starts too.
    status = outputs(simulator, learner)[2]
    assert status == (LearnerStatus.LEARNED if what == "u" else LearnerStatus.WAITING)
    after_tick(simulator, bad + 2)
    r, loss, status = outputs(simulator, learner)
    assert status == LearnerStatus.LEARNED and r < r_before
    assert np.isfinite([*r, *loss]).all()


def test_a_point_whose_F_does_not_allow_gamma_is_refused():
    def edit(x, u, lcs, enable):
        lcs[3] = replace(lcs[3], F=[[1e-4]])

    simulator, learner = scripted(edit=edit)
    after_tick(simulator, 3)
    r_before = outputs(simulator, learner)[0]
    after_tick(simulator, 4)
    r, _, status = outputs(simulator, learner)
    assert status == LearnerStatus.GAMMA_REFUSED
    np.testing.assert_array_equal(r, r_before)
    after_tick(simulator, 5)
    assert outputs(simulator, learner)[2] == LearnerStatus.LEARNED


def test_status_says_when_r_stands_at_its_bound():
    config = ResidualLearnerConfig(eps=1.0, r_max=5e-3)
    simulator, learner = scripted(config=config)
    after_tick(simulator, 5)
    r, _, status = outputs(simulator, learner)
    assert status == LearnerStatus.AT_BOUND
    np.testing.assert_array_equal(r, -5e-3)


def test_a_saved_context_replays_bit_for_bit():
    simulator, learner = scripted(n=12)
    after_tick(simulator, 5)
    saved = simulator.get_context().Clone()
    after_tick(simulator, 10)
    first = np.concatenate(outputs(simulator, learner))
    for _ in range(2):
        again = Simulator(simulator.get_system(), saved.Clone())
        again.AdvanceTo(10 * 0.05 + 2e-3)
        np.testing.assert_array_equal(np.concatenate(outputs(again, learner)), first)


def test_the_enable_port_may_stay_unconnected():
    builder, lcs = DiagramBuilder(), point_mass(5e-3)
    learner = builder.AddSystem(ResidualLearner(ResidualLearnerConfig(), lcs, 0.05))
    for name, value in (("x", [0.0, 0.0]), ("u_measured", [PUSH])):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), learner.GetInputPort(name))
    source = builder.AddSystem(ConstantValueSource(Value(lcs)))
    builder.Connect(source.get_output_port(), learner.GetInputPort("lcs"))
    simulator = Simulator(builder.Build())
    after_tick(simulator, 2)
    assert outputs(simulator, learner)[2] == LearnerStatus.LEARNED


@pytest.mark.parametrize("dt", [0.005, 0.02, 0.05, 0.1])
def test_defaults_find_a_gap_at_any_time_step(dt):
    """The wall is 8 mm further than in the model, and a mass rests against it."""
    near, far = point_mass(0.0, dt, 0.01 * dt), point_mass(8e-3, dt, 0.01 * dt)
    x = np.array([8e-3, 0.0])
    x, _ = simulate(far, x, [PUSH])  # At rest, eps_c gives way.
    steps = Script(x[None], np.array([[PUSH]]), [near], np.ones((1, 1)), dt)
    builder = DiagramBuilder()
    script = builder.AddSystem(steps)
    learner = builder.AddSystem(ResidualLearner(ResidualLearnerConfig(), near, dt))
    for port, name in (("x", "x"), ("u", "u_measured"), ("lcs", "lcs")):
        builder.Connect(script.GetOutputPort(port), learner.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(200 * dt)
    # 200 of Adam's steps of 0.15 mm; it dithers by about one.
    r = outputs(simulator, learner)[0]
    np.testing.assert_allclose(r * dt, 8e-3, atol=3e-4)


def test_a_state_too_large_to_be_squared_is_dropped_with_both_its_pairs():
    def edit(x, u, lcs, enable):
        x[3, 1] = 1e200

    simulator, learner = scripted(edit=edit)
    after_tick(simulator, 2)
    before = outputs(simulator, learner)[0]
    for k in (3, 4):
        after_tick(simulator, k)
        r, _, status = outputs(simulator, learner)
        assert status == LearnerStatus.NOT_FINITE
        np.testing.assert_array_equal(r, before)
    after_tick(simulator, 5)  # Nothing of it is left in the buffer.
    r, loss, status = outputs(simulator, learner)
    assert status == LearnerStatus.LEARNED and r < before and np.isfinite(loss)


def test_of_an_lcs_for_each_knot_the_first_is_used():
    n = 8
    one, many = scripted(n), scripted(n, lcs=[(point_mass(5e-3), point_mass(1.0))] * n)
    for simulator, _ in (one, many):
        after_tick(simulator, n - 1)
    np.testing.assert_array_equal(outputs(*one), outputs(*many))
    assert outputs(*one)[0] < 0.0


def test_a_friction_model_that_is_not_convex_is_refused_by_its_name():
    # A force of 1 N opens what another closes: F + F' has eigenvalues 0.1 +- 1.
    wedge = point_mass()
    F = [[0.05, 0.5], [0.5, 0.05]]
    lcs = LCS(wedge.A, wedge.B, np.zeros((2, 2)), wedge.d, np.zeros((2, 2)), F,
              np.zeros((2, 1)), np.zeros(2), 0.05)  # fmt: skip
    with pytest.raises(ValueError, match="eigenvalue -0.9, expected a positive"):
        ResidualLearner(ResidualLearnerConfig(), lcs, 0.05)


@pytest.mark.parametrize("lcs", [None, (), [point_mass()]])
def test_what_is_not_an_lcs_is_refused(lcs):
    with pytest.raises(ValueError, match="lcs is a .*, expected an LCS"):
        ResidualLearner(ResidualLearnerConfig(), lcs, 0.05)


def test_arrays_may_stand_for_lists():
    config = ResidualLearnerConfig(Q_d=np.ones(2), groups=np.array([[0]]))
    ResidualLearner(config, point_mass(), 0.05)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(gamma=0.2), r"gamma is 0.2, expected 0 < gamma < 0.101"),
        (dict(gamma=0.0), "gamma is 0.0"),
        (dict(gamma=np.nan), "gamma is nan"),
        (dict(Q_d=[1.0]), r"Q_d is \[1.0\], expected 2 weights"),
        (dict(Q_d=[1.0, -1.0]), "Q_d"),
        (dict(eps=0.0), "eps is 0.0"),
        (dict(adam=AdamConfig(learning_rate=-1.0)), "learning_rate is -1.0"),
        (dict(r_max=np.inf), "r_max is inf"),
        (dict(adam=AdamConfig(n_b=0)), "n_b is 0"),
        (dict(adam=AdamConfig(n_steps=0)), "n_steps is 0"),
        (dict(adam=AdamConfig(n_b=2.5)), "n_b is 2.5, expected an integer"),
        (dict(adam=AdamConfig(n_steps=np.inf)), "n_steps is inf"),
        (dict(groups=[[1]]), "entry 1"),
        (dict(groups=[[0.5]]), r"groups\[0\]\[0\] is 0.5, expected an integer"),
        (dict(groups=[0]), r"groups\[0\] is 0, expected a list"),
        (dict(Q_d=[1.0, np.nan]), r"Q_d\[1\] is nan, expected a number"),
        (dict(Q_d=[np.inf, 1.0]), "Q_d"),
        (dict(Q_d=[0.0, 0.0]), "not all 0"),
        (dict(Q_d=["a", 1.0]), "Q_d"),
        (dict(eps="1"), "eps is '1', expected a number"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        ResidualLearner(ResidualLearnerConfig(**changes), point_mass(), 0.05)


def test_a_period_that_is_not_the_lcs_time_step_is_refused():
    with pytest.raises(ValueError, match="period_sec is 0.1, expected the LCS's dt"):
        ResidualLearner(ResidualLearnerConfig(), point_mass(), 0.1)
    with pytest.raises(ValueError, match="period_sec is nan, expected"):
        ResidualLearner(ResidualLearnerConfig(), point_mass(), np.nan)


# The baseline: a residual on the dynamics.


def baseline(n, edit=None, error=lambda k: [0.01, -0.02], **changes):
    """The scripted mass, whose true step k is by error(k) more than the model's."""
    base, period = point_mass(1e3), 0.05
    x, u = np.zeros((n, 2)), np.zeros((n, 1))
    for k in range(n - 1):
        u[k + 1] = np.sin(k)  # Acts before sample k + 1.
        x[k + 1] = simulate(replace(base, d=error(k)), x[k], u[k + 1])[0]
    if edit:
        edit(x)
    builder = DiagramBuilder()
    script = builder.AddSystem(Script(x, u, [base], np.ones((1, 1)), period))
    config = DynamicsResidualLearnerConfig(**changes)
    learner = builder.AddSystem(DynamicsResidualLearner(config, base, period, 1e-3))
    for port, name in (("x", "x"), ("u", "u_measured"), ("lcs", "lcs")):
        builder.Connect(script.GetOutputPort(port), learner.GetInputPort(name))
    return Simulator(builder.Build()), learner


def test_baseline_finds_a_constant_error_of_the_dynamics_and_adds_it_to_d():
    simulator, learner = baseline(8)
    after_tick(simulator, 1)
    context = learner.GetMyContextFromRoot(simulator.get_context())
    r_dyn = learner.GetOutputPort("r_dyn")
    np.testing.assert_allclose(r_dyn.Eval(context), [0.01, -0.02], atol=1e-14)
    after_tick(simulator, 7)
    np.testing.assert_allclose(r_dyn.Eval(context), [0.01, -0.02], atol=1e-14)
    lcs = learner.GetOutputPort("lcs").Eval(context)
    np.testing.assert_allclose(lcs.d, [0.01, -0.02], atol=1e-14)
    np.testing.assert_array_equal(lcs.A, point_mass(1e3).A)


def test_baseline_gives_the_mean_error_of_the_last_n_b_steps():
    simulator, learner = baseline(8, error=lambda k: [0.01 * k, 0.0], n_b=3)
    context = learner.GetMyContextFromRoot(simulator.get_context())
    for tick, expected in ((2, 0.005), (3, 0.01), (7, 0.05)):
        after_tick(simulator, tick)
        r_dyn = learner.GetOutputPort("r_dyn").Eval(context)
        np.testing.assert_allclose(r_dyn, [expected, 0.0], atol=1e-14)


def test_baseline_drops_a_sample_that_is_not_finite():
    def edit(x):
        x[3, 0] = np.nan

    simulator, learner = baseline(8, edit)
    context = learner.GetMyContextFromRoot(simulator.get_context())
    for k, expected in ((3, DynamicsStatus.BAD_SAMPLE), (4, DynamicsStatus.WAITING)):
        after_tick(simulator, k)
        assert learner.GetOutputPort("status").Eval(context)[0] == expected
    r_dyn = learner.GetOutputPort("r_dyn").Eval(context)
    np.testing.assert_allclose(r_dyn, [0.01, -0.02], atol=1e-14)
