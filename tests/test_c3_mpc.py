"""C3: the QP step, the projections, whole solves, and the system."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.common.yaml import yaml_load_typed
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SolverOptions
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.optimize import linprog, minimize
from scipy.spatial.transform import Rotation

from makebreak import model_path
from makebreak.benchmarks.c3 import (
    OsqpC3,
    ball,
    cartpole,
    measure,
    osqp_options,
    quiet,
)
from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc, C3Status
from makebreak.systems.contact_mpc.lcs_builder import AnitescuLcs, ContactPair
from makebreak.systems.contact_mpc.lcs_plant import LcsPlant
from makebreak.systems.contact_mpc.numerics.c3_active_set import (
    CANNOT_BE_MET,
    MET,
    solve_active,
)
from makebreak.systems.contact_mpc.numerics.c3_admm import (
    C3Failure,
    compiled_once,
    qp_step,
)
from makebreak.systems.contact_mpc.numerics.c3_bounds import solve_bounded, within
from makebreak.systems.contact_mpc.numerics.c3_interior import solve_interior
from makebreak.systems.contact_mpc.numerics.c3_linear import LinearBound
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Bounds,
    C3Options,
    C3Problem,
    C3Weights,
    OrientationWeight,
    plan_cost,
    solve_c3,
    warm_up,
    with_gap_residual,
)
from makebreak.systems.contact_mpc.numerics.c3_plan import Plan, WarmStart
from makebreak.systems.contact_mpc.numerics.c3_polish import (
    backward,
    roll_out,
    rollout_cost,
    state_breach,
)
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    QpProjection,
    project_exact,
    project_plus,
    project_qp,
    projection_matrices,
)
from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve
from makebreak.systems.contact_mpc.numerics.lcp import solve_lcp
from makebreak.systems.contact_mpc.numerics.lcs import (
    CLOSED,
    FREE,
    LCS,
    OPEN,
    contact_modes,
    fix_modes,
    fixed_forces,
    simulate,
)
from makebreak.systems.contact_mpc.numerics.orientation_cost import (
    orientation_quadratics,
    squared_angle,
)

REFERENCE = Path(__file__).parent / "reference"
CARTPOLE = np.load(REFERENCE / "c3_cartpole.npz")
PROJECTIONS = np.load(REFERENCE / "projections.npz")
BALL = np.load(REFERENCE / "ball_mpc_problem.npz")
NO_BARRIER = np.zeros((0, 0))
PLUS, C3_QP, EXACT = PlusProjection(), QpProjection(), ExactProjection()


def cartpole_lcs():
    return LCS(**{k: CARTPOLE[k] for k in "ABDdEFHc"}, dt=0.01)


def cartpole_problem(projection=PLUS, bounds=None, **options):
    kind = "plus" if isinstance(projection, PlusProjection) else "c3"
    weights = C3Weights(
        CARTPOLE["Q"],
        CARTPOLE["R"],
        CARTPOLE["G_" + kind],
        CARTPOLE["U_" + kind],
        CARTPOLE["QN"],
    )
    options = C3Options(**({"N": 5, "rounds": 10, "rho": 2.0} | options))
    return C3Problem(weights, projection, options, bounds)


def ball_lcs(n_f=4, eps_c=None, x=None):
    """The ball between finger and table, 2 n_f forces per contact; eps_c None: 5e-4."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(REFERENCE / "ball_on_table.sdf"))
    plant.Finalize()
    pairs = [
        ContactPair("finger_link", "ball_link", 0.5, n_f, [0.0, 0.0, 1.0]),
        ContactPair("ball_link", "table_link", 0.5, n_f, [1.0, 0.0, 0.0]),
    ]
    model = AnitescuLcs(builder.Build(), pairs, 0.05, eps_c)
    return model.build(BALL["x0"] if x is None else x, np.zeros(3))


# The QP step.


def random_qp(rng, bounded=False):
    """A strictly convex linear-quadratic problem; see c3_bounds.solve_bounded."""
    n_x, n_u, n_lam, N = rng.integers(1, 6), *rng.integers(1, 4, 2), rng.integers(1, 9)
    n_v, n = n_lam + n_u, n_x + n_lam + n_u
    A = rng.normal(size=(n_x, n_x))
    A *= rng.uniform(0.5, 1.2) / abs(np.linalg.eigvals(A)).max()
    B, d = rng.normal(size=(n_x, n_v)), 0.1 * rng.normal(size=n_x)
    L, L_N = rng.normal(size=(n, n)), rng.normal(size=(n_x, n_x))
    T = L @ L.T + np.diag(10.0 ** rng.uniform(-2, 2, n))
    h = 10.0 * rng.normal(size=(N + 1, n))
    v0 = 0.3 * rng.normal(size=n_lam) if rng.random() < 0.5 else np.empty(0)
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    for i in range(n_lam, n) if bounded else ():
        size = 1.0 if i < n_v else 3.0
        if rng.random() < 0.7 / size:
            lower[i] = -size * 10.0 ** rng.uniform(-1, 1)
        if rng.random() < 0.7 / size:
            upper[i] = size * 10.0 ** rng.uniform(-1, 1)
        if i < n_v and rng.random() < 0.1:
            lower[i] = upper[i] = 0.3  # A fixed value.
    x0 = rng.normal(size=n_x)
    # Read-only where qp_step's are: what may be written is compiled by itself.
    T_N, upper = map(compiled_once, (L_N @ L_N.T, upper))
    return A, B, d, T, T_N, h, x0, v0, lower, upper


def riccati(qp):
    A, B, d, T, T_N, h, x0, v0, lower, upper = qp
    N, n_x = len(h) - 1, len(d)
    fac = new_factor(np.hstack([B, A])[None], d[None], N)
    x, v = np.empty((N + 1, n_x)), np.empty((N, B.shape[1]))
    assert factor(fac, T[None], T_N, NO_BARRIER, v0.size)
    solve(fac, h, x0, v0, x, v)
    return fac, x, v


def test_qp_step_agrees_with_a_dense_kkt_solve():
    rng = np.random.default_rng(0)
    for _ in range(30):
        qp = A, B, d, T, T_N, h, x0, v0, *_ = random_qp(rng)
        N, n_x, n_v = len(h) - 1, len(d), B.shape[1]
        n = n_x + n_v
        # Unknowns: [v_k, x_k] for k < N, then x_N.
        size = N * n + n_x
        H = np.zeros((size, size))
        for k in range(N):
            H[k * n : (k + 1) * n, k * n : (k + 1) * n] = T
        H[N * n :, N * n :] = T_N
        rhs = np.concatenate([h[:N].ravel(), h[N, n_v:]])
        C = np.zeros((n_x + v0.size + N * n_x, size))
        e = np.concatenate([x0, v0, np.tile(-d, N)])
        C[:n_x, n_v:n] = np.eye(n_x)
        C[n_x : n_x + v0.size, : v0.size] = np.eye(v0.size)
        for k in range(N):
            rows = slice(n_x + v0.size + k * n_x, n_x + v0.size + (k + 1) * n_x)
            C[rows, k * n : (k + 1) * n] = np.hstack([B, A])
            at = (k + 1) * n + (n_v if k + 1 < N else 0)
            C[rows, at : at + n_x] = -np.eye(n_x)
        kkt = np.block([[H, C.T], [C, np.zeros((len(C), len(C)))]])
        y = np.linalg.solve(kkt, np.concatenate([rhs, e]))[:size]
        _, x, v = riccati(qp)
        ours = np.concatenate([*(np.concatenate([v[k], x[k]]) for k in range(N)), x[N]])
        # Condition up to 1e6: 1e-16 grows to 1e-10 of the largest entry.
        np.testing.assert_allclose(ours, y, rtol=1e-9, atol=1e-9 * abs(y).max())


def clarabel(qp):
    """x and v of the bounded problem, or None where it is infeasible."""
    A, B, d, T, T_N, h, x0, v0, lower, upper = qp
    N, n_x, n_v = len(h) - 1, len(d), B.shape[1]
    prog = MathematicalProgram()
    x = prog.NewContinuousVariables(N + 1, n_x)
    v = prog.NewContinuousVariables(N, n_v)
    prog.AddLinearEqualityConstraint(np.eye(n_x), x0, x[0])
    if v0.size:
        prog.AddLinearEqualityConstraint(np.eye(v0.size), v0, v[0, : v0.size])
    for k in range(N):
        M = np.hstack([B, A, -np.eye(n_x)])
        prog.AddLinearEqualityConstraint(M, -d, np.r_[v[k], x[k], x[k + 1]])
        prog.AddQuadraticCost(T, -h[k], np.r_[v[k], x[k]], is_convex=True)
        y = np.r_[v[k], x[k + 1]]
        for i in np.flatnonzero(np.isfinite(lower) | np.isfinite(upper)):
            prog.AddBoundingBoxConstraint(lower[i], upper[i], y[i])
    prog.AddQuadraticCost(T_N, -h[N, n_v:], x[N], is_convex=True)
    options = SolverOptions()
    for name in ("tol_gap_abs", "tol_gap_rel", "tol_feas"):
        options.SetOption(ClarabelSolver.id(), name, 1e-11)
    result = ClarabelSolver().Solve(prog, None, options)
    if not result.is_success():
        return None
    return (
        result.GetSolution(x).reshape(N + 1, n_x),
        result.GetSolution(v).reshape(N, n_v),
    )


def test_bounded_qp_step_agrees_with_clarabel_and_sees_infeasibility():
    rng = np.random.default_rng(0)
    met, infeasible = 0, 0
    for _ in range(60):
        qp = *_, T, T_N, h, x0, v0, lower, upper = random_qp(rng, bounded=True)
        fac, x, v = riccati(qp)
        if within(x, v, lower, upper):
            continue
        sides = np.zeros(h.shape, np.int64)
        status = solve_bounded(fac, T[None], T_N, h, x0, v0, lower, upper, sides, x, v)
        solved = status == MET
        assert status in (MET, CANNOT_BE_MET)
        expected = clarabel(qp)
        assert solved == (expected is not None)
        if not solved:
            infeasible += 1
            continue
        met += 1
        n_v = v.shape[1]
        assert (v >= lower[:n_v]).all() and (v <= upper[:n_v]).all()
        # What Plan promises of x.
        assert (x[1:] >= lower[n_v:] - 1e-6).all()
        assert (x[1:] <= upper[n_v:] + 1e-6).all()
        # Clarabel's own accuracy: the square root of its gap of 1e-11, times scale.
        np.testing.assert_allclose(v, expected[1], atol=2e-5 * (1 + abs(v).max()))
        np.testing.assert_allclose(x, expected[0], atol=2e-5 * (1 + abs(x).max()))
    assert met > 20 and infeasible > 0


def test_the_dual_active_set_alone_finds_what_clarabel_finds():
    """Without the interior point method behind it, which would hide a fault: bounds of
    either side, also those that only come in on the way."""
    rng = np.random.default_rng(3)
    n_active = {1: 0, -1: 0}
    came_in = 0
    for _ in range(60):
        qp = *_, h, x0, v0, lower, upper = random_qp(rng, bounded=True)
        fac, x, v = riccati(qp)
        if within(x, v, lower, upper):
            continue
        n_v = v.shape[1]
        free = np.hstack([np.vstack([v, np.zeros(n_v)]), x])
        sides = np.zeros(h.shape, np.int64)
        status = solve_active(fac, h, x0, v0, lower, upper, sides, x, v)
        expected = clarabel(qp)
        assert status == (CANNOT_BE_MET if expected is None else MET)
        if expected is None:
            continue
        # As above: the accuracy of Clarabel.
        np.testing.assert_allclose(v, expected[1], atol=2e-5 * (1 + abs(v).max()))
        np.testing.assert_allclose(x, expected[0], atol=2e-5 * (1 + abs(x).max()))
        for side, held in ((1, free >= lower), (-1, free <= upper)):
            n_active[side] += np.count_nonzero(sides == side)
            came_in += np.count_nonzero((sides == side) & held)
    assert min(n_active.values()) > 20 and came_in > 10


def test_a_qp_that_is_not_convex_is_refused():
    fac = new_factor(np.ones((1, 1, 2)), np.zeros((1, 1)), 3)
    T = np.diag([-1.0, 0.0])[None]
    assert not factor(fac, T, np.zeros((1, 1)), NO_BARRIER, 0)


# The projections.


def projection_problem():
    E, F, H, c = (np.ascontiguousarray(PROJECTIONS[k]) for k in "EFHc")
    U = np.diag(PROJECTIONS["qp_U"]).copy()
    return U, E, F, H, c, *projection_matrices(U, E, F, H)


def test_plus_projection_repeats_the_reference():
    U = np.diag(PROJECTIONS["plus_U"]).copy()
    delta = np.empty(9)
    for z, expected in zip(
        PROJECTIONS["plus_in"], PROJECTIONS["plus_out"], strict=True
    ):
        project_plus(z[None], U, 4, 2, delta[None])
        np.testing.assert_array_equal(delta, expected)


def test_qp_projection_is_feasible_and_no_worse_than_the_reference():
    U, E, F, H, c, V, K = projection_problem()
    alpha, delta = float(PROJECTIONS["qp_alpha"]), np.empty(7)

    def objective(v, z):
        weight = np.diag(U)
        weight[4:6, 4:6] = alpha * F
        lam = v[4:6]
        return 0.5 * v @ weight @ v - z @ weight @ v + 0.5 * (1 - alpha) * lam @ F @ lam

    close = 0
    for z, saved in zip(PROJECTIONS["qp_in"], PROJECTIONS["qp_out"], strict=True):
        assert project_qp(z[None], alpha, E, F, H, c, V, K, delta[None])
        assert delta[4:6].min() >= 0.0
        assert (E @ delta[:4] + F @ delta[4:6] + c).min() >= -1e-12
        # The saved points breach a constraint by up to 1e-8, which is worth 1e-8 of
        # the objective's slope (1e3) in their favour.
        assert objective(delta, z) <= objective(saved, z) + 1e-5
        close += abs(delta - saved)[:6].max() < 1e-3
    # OSQP ended one of them early (lam_0 = 7.5 instead of 10.4); the rest are to its
    # tolerance. u, without weight, passes through here and is 0 there.
    assert close == 11


def test_qp_projection_agrees_with_clarabel_where_that_is_well_determined():
    rng = np.random.default_rng(0)
    for _ in range(10):
        n_x, n_lam = 4, 3
        J = rng.normal(size=(n_lam, n_lam))
        F, E, H = (
            J @ J.T + np.eye(n_lam),
            *(rng.normal(size=(n_lam, n)) for n in (4, 2)),
        )
        c, z = rng.normal(size=n_lam), 2.0 * rng.normal(size=9)
        U = 10.0 ** rng.uniform(-1, 1, 9)
        delta, alpha = np.empty(9), 0.3
        V, K = projection_matrices(U, E, F, H)
        assert project_qp(z[None], alpha, E, F, H, c, V, K, delta[None])
        prog = MathematicalProgram()
        v = prog.NewContinuousVariables(9)
        S = np.hstack([E, F, H])
        prog.AddLinearConstraint(S, -c, np.full(n_lam, np.inf), v)
        lam = v[n_x : n_x + n_lam]
        prog.AddBoundingBoxConstraint(0.0, np.inf, lam)
        weight = np.diag(U)
        weight[n_x : n_x + n_lam, n_x : n_x + n_lam] = alpha * F
        prog.AddQuadraticCost(weight, -weight @ z, v, is_convex=True)
        prog.AddQuadraticCost((1 - alpha) * F, np.zeros(n_lam), lam, is_convex=True)
        expected = ClarabelSolver().Solve(prog).GetSolution(v)
        # Clarabel stops at a gap of 1e-8: 1e-4 of distance in the flattest direction.
        np.testing.assert_allclose(delta, expected, atol=1e-4)


def brute_force_projection(z, U, E, F, H, c):
    """Smallest |v - z|^2_U over all contact modes: one convex QP for each."""
    n_lam, n_x = E.shape
    S, best = np.hstack([E, F, H]), np.inf
    for mode in product([False, True], repeat=n_lam):
        prog = MathematicalProgram()
        v = prog.NewContinuousVariables(len(z))
        prog.AddQuadraticErrorCost(np.diag(U), z, v)
        touch = np.array(mode)
        lam_upper = np.where(touch, np.inf, 0.0)
        gap_upper = np.where(touch, -c, np.inf)
        prog.AddBoundingBoxConstraint(np.zeros(n_lam), lam_upper, v[n_x : n_x + n_lam])
        for i in range(n_lam):
            if touch[i]:
                prog.AddLinearEqualityConstraint(S[i : i + 1], [-c[i]], v)
            else:
                prog.AddLinearConstraint(S[i : i + 1], [-c[i]], gap_upper[i : i + 1], v)
        result = ClarabelSolver().Solve(prog)
        if result.is_success():
            best = min(best, result.get_optimal_cost())
    return best


def test_exact_projection_of_sixteen_forces_is_that_of_its_four_parts():
    """Four times four forces that share nothing: all 2^4 modes of each part are tried.
    eps_c as the builder's: the edges of a contact are nearly parallel rows."""
    rng = np.random.default_rng(0)
    for eps_c in (0.0, 5e-4):
        n, parts, best = 4, 4, 0.0
        E, F = np.zeros((16, 16)), np.zeros((16, 16))
        c, z, U = np.zeros(16), np.zeros(32), np.ones(32)
        for k in range(parts):
            at = slice(k * n, (k + 1) * n)
            J = rng.normal(size=(n, 2))
            E[at, at], F[at, at] = J @ rng.normal(size=(2, n)), J @ J.T
            F[at, at] += eps_c * np.eye(n)
            c[at] = 0.3 * abs(rng.normal(size=n))
            lam = slice(16 + k * n, 16 + (k + 1) * n)
            z[at], z[lam] = rng.normal(size=n), rng.normal(size=n)
            U[at], U[lam] = 10.0 ** rng.uniform(-1, 2, (2, n))
            best += brute_force_projection(
                np.r_[z[at], z[lam]], np.r_[U[at], U[lam]], E[at, at], F[at, at],
                np.zeros((n, 0)), c[at],
            )  # fmt: skip
        delta = np.empty(32)
        assert (
            project_exact(z[None], U, E, F, np.zeros((16, 0)), c, 10**6, delta[None])
            == 0
        )
        # Clarabel: a relative gap of 1e-8.
        np.testing.assert_allclose(U @ (delta - z) ** 2, best, rtol=1e-6)


@pytest.mark.parametrize("n_f", [1, 2, 4, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("eps_c", [0.0, 5e-4])
def test_exact_projection_of_the_ball_never_fails(n_f, eps_c):
    """4, 8, 16 and 32 forces on the ball between finger and table, at 60 random points
    (4 of the 32 forces), of which the rows are singular or nearly so."""
    problem = ball(False, 5)[3]
    lcs = ball_lcs(n_f, eps_c)
    E, F, H, c = (np.array(a, order="C") for a in (lcs.E, lcs.F, lcs.H, lcs.c))
    n, rng = lcs.n_lam, np.random.default_rng(0)
    U = np.r_[problem.U[:19], np.full(n, problem.U[19]), problem.U[-3:]]
    for _ in range(60 if n < 32 else 4):
        z = np.r_[BALL["x0"] + 0.05 * rng.normal(size=19), rng.normal(size=n + 3)]
        z[19 : 19 + n] *= 5.0
        delta = np.empty(22 + n)
        assert project_exact(z[None], U, E, F, H, c, 10**6, delta[None]) == 0
        lam = delta[19 : 19 + n]
        gap = E @ delta[:19] + F @ lam + H @ delta[-3:] + c
        # Rounding of the sums that make the gap.
        size = (np.abs(E) @ np.abs(delta[:19]) + np.abs(F) @ lam).max()
        assert lam.min() >= 0.0 and gap.min() >= -1e-9 * size
        assert np.minimum(lam, gap / size).max() < 1e-9


@pytest.mark.parametrize("nodes_max", [1, 20, 200])
def test_an_exact_projection_that_is_cut_short_obeys_and_says_so(nodes_max):
    problem, lcs = ball(False, 5)[3], ball_lcs(8, None)
    E, F, H, c = (np.array(a, order="C") for a in (lcs.E, lcs.F, lcs.H, lcs.c))
    rng = np.random.default_rng(0)
    U = np.r_[problem.U[:19], np.full(32, problem.U[19]), problem.U[-3:]]
    z = np.r_[BALL["x0"] + 0.05 * rng.normal(size=19), 5.0 * rng.normal(size=35)]
    cut, whole = np.empty(54), np.empty(54)
    assert project_exact(z[None], U, E, F, H, c, nodes_max, cut[None]) == 1
    lam, gap = cut[19:51], E @ cut[:19] + F @ cut[19:51] + H @ cut[-3:] + c
    size = (np.abs(E) @ np.abs(cut[:19]) + np.abs(F) @ lam).max()
    assert lam.min() >= 0.0 and gap.min() >= -1e-9 * size
    assert np.minimum(lam, gap / size).max() < 1e-9
    assert project_exact(z[None], U, E, F, H, c, 10**5, whole[None]) == 0
    # Not nearer than the nearest, and not far away: at most twice the squared distance.
    least, found = (U @ (d - z) ** 2 for d in (whole, cut))
    assert least * (1.0 - 1e-9) <= found <= 2.0 * least


def test_a_plan_counts_the_projections_that_were_cut_short():
    lcs, x0, x_desired, p = ball(False, 5)
    weights = C3Weights(p.Q, p.R, p.G, p.U)
    plans = [
        solve_c3(lcs, x0, x_desired, C3Problem(weights, ExactProjection(n), p.options))[
            0
        ]
        for n in (1, 10**5)
    ]
    assert 0 < plans[0].cut_projections <= 15  # Five knots in each of three rounds.
    assert plans[1].cut_projections == 0
    with pytest.raises(ValueError, match="nodes_max is 0, expected an integer"):
        C3Problem(weights, ExactProjection(0), p.options)


@pytest.mark.parametrize(("n_lam", "trials"), [(2, 12), (4, 4), (8, 1)])
def test_exact_projection_agrees_with_brute_force_over_all_modes(n_lam, trials):
    rng = np.random.default_rng(0)
    for trial in range(trials):
        # As friction edges do, the rows of E, F and H depend on each other.
        J = rng.normal(size=(n_lam, n_lam // 2 + 2))
        F, E = 0.1 * J @ J.T, J @ rng.normal(size=(n_lam // 2 + 2, 4))
        H = J @ rng.normal(size=(n_lam // 2 + 2, 2)) * (trial % 2)
        c = 0.3 * abs(rng.normal(size=n_lam))  # x = lam = u = 0 is feasible.
        U, z = 10.0 ** rng.uniform(-1, 2, n_lam + 6), rng.normal(size=n_lam + 6)
        delta = np.empty(n_lam + 6)
        assert project_exact(z[None], U, E, F, H, c, 10**6, delta[None]) == 0
        lam, gap = delta[4 : 4 + n_lam], np.hstack([E, F, H]) @ delta + c
        # The LCPs hold to 1e-9 of their own scale.
        assert lam.min() >= 0.0 and gap.min() >= -1e-8 and abs(lam * gap).max() < 1e-8
        best = brute_force_projection(z, U, E, F, H, c)
        # Clarabel: a relative gap of 1e-8, on 256 problems.
        np.testing.assert_allclose(U @ (delta - z) ** 2, best, rtol=1e-6, atol=1e-7)


# Whole solves.


def test_c3_plus_repeats_the_reference_on_the_cartpole():
    problem = cartpole_problem(PLUS)
    plan, warm = solve_c3(cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4)), problem)
    # Both solve the same linear systems; theirs by OSQP with polishing, to 1e-9.
    for ours, name in (
        (plan.u, "u"),
        (plan.x[:5], "x"),
        (plan.lam, "lam"),
        (warm.delta, "delta"),
        (warm.w, "w"),
    ):
        expected = CARTPOLE["plus_first_" + name]
        np.testing.assert_allclose(ours, expected, rtol=1e-8, atol=1e-9, err_msg=name)


def test_recreation_repeats_the_reference_to_the_last_digit_it_gives():
    for plus, name in ((True, "plus_first_u"), (False, "qp_first_u")):
        lcs, x0, x_desired, problem = cartpole(plus, 5)
        with quiet():
            u = OsqpC3(lcs, problem).solve(x0, x_desired)
        # The same operations by the same solver.
        np.testing.assert_allclose(u, CARTPOLE[name], rtol=1e-8)


def test_c3_equals_the_recreation_once_osqp_is_told_to_finish_its_projections():
    """With the library's settings OSQP leaves the projection early, and u differs by a
    fifth (docs/c3.md); with tight ones the same program gives our plan."""
    lcs, x0, x_desired, problem = cartpole(False, 5)
    osqp = OsqpC3(lcs, problem, scaling=1.0)
    osqp.projection_options = osqp_options(
        dict(eps_abs=1e-9, eps_rel=1e-9, max_iter=100_000, polishing=1)
    )
    with quiet():
        expected = osqp.solve(x0, x_desired)
    plan, _ = solve_c3(lcs, x0, x_desired, problem)
    # OSQP's 1e-9 in a weight of 1e-4 (alpha F) is 1e-5 in lam.
    np.testing.assert_allclose(plan.u, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("projection", "steps"), [(PLUS, 184), (EXACT, 178), (C3_QP, 176)]
)
def test_closed_loop_settles_in_as_many_steps_as_the_reference(projection, steps):
    """Until max|x| <= 0.1 for 30 steps. C3+ and exact: c3_reference. QP projection: the
    re-creation with tight projections (107 with the early-ending ones)."""
    problem = cartpole_problem(projection, penalise_input_change=True)
    lcs, x, warm, still = cartpole_lcs(), CARTPOLE["x0"], None, 0
    taken = 0
    while still < 30 and taken < 1000:
        plan, warm = solve_c3(lcs, x, np.zeros((6, 4)), problem, warm)
        x, _ = simulate(lcs, x, plan.u[0])
        still = still + 1 if abs(x).max() <= 0.1 else 0
        taken += 1
    assert taken == steps


def test_c3_plus_on_the_ball_costs_no_more_than_the_recreation():
    row = measure("ball", ball, True, 5, repeats=1)
    assert row["cost_ratio"] <= 1.01


@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
def test_bounds_hold_and_far_ones_change_nothing(projection):
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    free, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(projection))
    far = C3Bounds(u_lower=[-1e3], u_upper=[1e3], x_upper=np.full(4, 1e3))
    same, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(projection, far))
    np.testing.assert_array_equal(same.u, free.u)
    u_max = 0.6 * free.u.max()
    near = C3Bounds(u_lower=[-2.0], u_upper=[u_max])
    plan, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(projection, near))
    assert u_max - 1e-6 < plan.u.max() <= u_max and plan.u.min() >= -2.0
    v_max = 0.5 * (x0[2] + free.x[1:, 2].max())
    near.x_upper = np.array([np.inf, np.inf, v_max, np.inf])
    plan, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(projection, near))
    assert plan.x[1:, 2].max() == pytest.approx(v_max, abs=1e-6)
    assert -2.0 <= plan.u.min() and plan.u.max() <= u_max
    step = plan.x[:-1] @ lcs.A.T + plan.u @ lcs.B.T + plan.lam @ lcs.D.T + lcs.d
    np.testing.assert_allclose(plan.x[1:], step, atol=1e-9)  # Still the dynamics.


@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
def test_a_bound_is_not_met_by_a_contact_that_pulls(projection):
    """A finger behind a puck can push it, not fetch it back."""
    plant, _ = AddMultibodyPlantSceneGraph(builder := DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(model_path("puck.sdf")))
    plant.Finalize()
    model = AnitescuLcs(builder.Build(), [ContactPair("finger", "puck", 0.3)], 0.05)
    x0 = model.x_default
    lcs = model.build(x0, np.zeros(model.n_u))
    n = lcs.n_x + lcs.n_lam * (2 if projection is PLUS else 1) + lcs.n_u
    weights = C3Weights(
        np.array([0.0, 200.0, 1.0, 20.0]), np.array([0.01]), np.ones(n), np.ones(n)
    )
    x_desired = np.tile([0.4, 0.5, 0.0, 0.0], (21, 1))

    def solved(**bounds):
        problem = C3Problem(
            weights, projection, C3Options(N=20, rounds=5), C3Bounds(**bounds)
        )
        return solve_c3(lcs, x0, x_desired, problem)[0]

    with pytest.raises(C3Failure, match="no plan meets the bounds"):
        solved(x_upper=np.array([np.inf, np.inf, np.inf, -0.02]))
    # One that a push can meet is met by pushes.
    plan = solved(
        x_lower=np.array([-np.inf, -np.inf, -np.inf, -0.02]),
        x_upper=np.array([np.inf, x0[1] + 0.05, np.inf, np.inf]),
    )
    assert plan.lam.min() >= 0.0 and plan.x[1:, 1].max() <= x0[1] + 0.05 + 1e-6


@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
def test_a_linear_bound_on_one_state_is_the_bound_of_that_state(projection):
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    free, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(projection))
    v_max = 0.5 * (x0[2] + free.x[1:, 2].max())
    of_state = C3Bounds(x_upper=np.array([np.inf, np.inf, v_max, np.inf]))
    row = LinearBound(x=np.array([0.0, 0.0, 2.0, 0.0]), upper=2.0 * v_max)
    plans = [
        solve_c3(lcs, x0, x_desired, cartpole_problem(projection, bounds))[0]
        for bounds in (of_state, C3Bounds(linear=[row]))
    ]
    assert plans[1].x.shape == plans[0].x.shape
    for name in ("x", "u", "lam"):
        np.testing.assert_allclose(*(getattr(p, name) for p in plans), atol=1e-6)


def test_a_linear_bound_on_forces_and_one_of_input_and_speed_hold():
    """A finger pushes a puck with at most 2 N along the normal, and a motor that gives
    less the faster it turns."""
    plant, _ = AddMultibodyPlantSceneGraph(builder := DiagramBuilder(), 0.0)
    Parser(plant).AddModels(str(model_path("puck.sdf")))
    plant.Finalize()
    model = AnitescuLcs(builder.Build(), [ContactPair("finger", "puck", 0.3)], 0.05)
    lcs = model.build(x0 := model.x_default, np.zeros(model.n_u))
    n = lcs.n_x + 2 * lcs.n_lam + lcs.n_u
    weights = C3Weights(
        np.array([0.0, 200.0, 1.0, 20.0]), np.array([0.01]), np.ones(n), np.ones(n)
    )
    x_desired = np.tile([0.4, 0.5, 0.0, 0.0], (21, 1))

    def solved(*linear):
        problem = C3Problem(
            weights, PLUS, C3Options(N=20, rounds=5), C3Bounds(linear=list(linear))
        )
        return solve_c3(lcs, x0, x_desired, problem)

    on_force = LinearBound(lam=np.ones(lcs.n_lam), upper=2.0)
    on_both = LinearBound(u=np.ones(1), x=np.array([0.0, 0.0, 5.0, 0.0]), upper=3.0)
    free, warm = solved()
    assert free.lam.sum(axis=1).max() > 3.0
    assert (free.u[:, 0] + 5.0 * free.x[1:, 2]).max() > 3.5
    plan, _ = solved(on_force)
    assert plan.lam.sum(axis=1).max() == pytest.approx(2.0, abs=1e-5)
    plan, again = solved(on_force, on_both)
    assert plan.lam.sum(axis=1).max() <= 2.0 + 1e-5
    most = (plan.u[:, 0] + 5.0 * plan.x[1:, 2]).max()
    assert most == pytest.approx(3.0, abs=1e-5)
    step = plan.x[:-1] @ lcs.A.T + plan.u @ lcs.B.T + plan.lam @ lcs.D.T + lcs.d
    np.testing.assert_allclose(plan.x[1:], step, atol=1e-9)
    assert again.delta.shape == warm.delta.shape


def test_linear_bounds_of_a_wrong_size_are_refused():
    for row, said in (
        (LinearBound(u=np.ones(2)), "LinearBound 0: u is .* expected 1 finite"),
        (LinearBound(x=np.full(4, np.nan)), "LinearBound 0: x is"),
        (LinearBound(u=np.ones(1), lower=1.0, upper=0.0), "expected lower <= upper"),
    ):
        with pytest.raises(ValueError, match=said):
            cartpole_problem(PLUS, C3Bounds(linear=[row]))


@pytest.mark.parametrize("projection", [PLUS, C3_QP])
def test_weights_of_knots_are_those_of_each_knot(projection):
    lcs, x0 = cartpole_lcs(), CARTPOLE["x0"]
    problem = cartpole_problem(projection)
    Q, N = np.diag(problem.Q), problem.options.N

    def solved(x_desired, **more):
        given = C3Weights(Q, problem.R, problem.G, problem.U, problem.Q_N, **more)
        other = C3Problem(given, projection, problem.options)
        return solve_c3(lcs, x0, x_desired, other)[0], other

    to_zero = np.zeros((N + 1, 4))
    plain, _ = solved(to_zero)
    same, _ = solved(to_zero, Q_knots=np.tile(Q, (N, 1)))
    np.testing.assert_allclose(same.u, plain.u, atol=1e-12)
    # A knot without weight may have any target.
    weights, target = np.tile(Q, (N, 1)), to_zero.copy()
    weights[3], target[3] = 0.0, 7.0
    free, other = solved(to_zero, Q_knots=weights)
    moved, _ = solved(target, Q_knots=weights)
    np.testing.assert_allclose(moved.u, free.u, atol=1e-12)
    assert abs(solved(target)[0].u - plain.u).max() > 1e-3
    of_free = plan_cost(lcs, x0, free.u, target, other)
    assert of_free == pytest.approx(plan_cost(lcs, x0, free.u, to_zero, other))
    with pytest.raises(ValueError, match=r"Q_knots is \(1, 4\).*expected \(5, 4\)"):
        solved(to_zero, Q_knots=weights[:1])


def plan_exists(lcs, x0, problem):
    """Whether some lam and u keep the bounds, by a linear program."""
    N, n_x, n_lam, n_u = problem.options.N, lcs.n_x, lcs.n_lam, lcs.n_u
    n_v, n = n_lam + n_u, n_lam + n_u + n_x
    A_eq, b_eq = np.zeros((N * n_x, N * n)), np.tile(-lcs.d, N)
    for k in range(N):  # Unknowns per knot: lam_k, u_k, x_(k+1).
        row, at = slice(k * n_x, (k + 1) * n_x), k * n
        A_eq[row, at : at + n_v] = np.hstack([lcs.D, lcs.B])
        A_eq[row, at + n_v : at + n] = -np.eye(n_x)
        if k == 0:
            b_eq[row] -= lcs.A @ x0
        else:
            A_eq[row, at - n_x : at] = lcs.A
    bounds = [*zip(problem.lower, problem.upper, strict=True)] * N
    if not lcs.H.any():
        lam0 = solve_lcp(lcs.F, lcs.E @ x0 + lcs.c)
        bounds[:n_lam] = [(value, value) for value in lam0]
    return linprog(np.zeros(N * n), A_eq=A_eq, b_eq=b_eq, bounds=bounds).status == 0


@pytest.mark.parametrize("bounded", ["", "x", "u", "xu"])
@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
@pytest.mark.parametrize("states", [8, pytest.param(300, marks=pytest.mark.slow)])
def test_every_state_of_the_ball_with_a_plan_gets_one(projection, bounded, states):
    """eps_c at its default; one velocity of the finger within 0.08 m/s, and inputs
    within what about half of the free plans ask for."""
    plus = isinstance(projection, PlusProjection)
    lcs, x0, x_desired, plain = ball(plus, 5)
    lcs = replace(lcs, F=lcs.F + 5e-4 * np.eye(16))
    weights = C3Weights(plain.Q, plain.R, plain.G, plain.U)
    bounds = C3Bounds()
    if "x" in bounded:
        limit = np.full(19, np.inf)
        limit[10] = 0.08
        bounds.x_lower, bounds.x_upper = -limit, limit
    if "u" in bounded:
        bounds.u_lower, bounds.u_upper = [-1.5] * 3, [1.5] * 3
    problem = C3Problem(weights, projection, plain.options, bounds)
    rng, met = np.random.default_rng(0), 0
    for _ in range(states):
        x = x0 + 0.02 * rng.normal(size=19)
        x[10:] = x0[10:] + 0.1 * rng.normal(size=9)
        x[3:7] = x0[3:7] + 0.3 * rng.normal(size=4)
        x[3:7] /= np.linalg.norm(x[3:7])
        try:
            plan, _ = solve_c3(lcs, x, x_desired, problem)
        except C3Failure:
            assert not plan_exists(lcs, x, problem)
            continue
        met += 1
        n_lam, n_v = 16, 19
        lower, upper = problem.lower, problem.upper
        assert (plan.u >= lower[n_lam:n_v]).all() and (plan.u <= upper[n_lam:n_v]).all()
        assert (plan.x[1:] >= lower[n_v:] - 1e-6).all()
        assert (plan.x[1:] <= upper[n_v:] + 1e-6).all()
        step = plan.x[:-1] @ lcs.A.T + plan.u @ lcs.B.T + plan.lam @ lcs.D.T + lcs.d
        np.testing.assert_allclose(plan.x[1:], step, atol=1e-8 * abs(plan.x).max())
    assert met > 0.5 * states


def test_many_active_bounds_agree_with_the_interior_point_method():
    """Both ways to the same minimiser, with most of 60 inputs at a bound."""
    rng = np.random.default_rng(1)
    N, n_x, n_v = 30, 4, 3
    A, B, d = 0.9 * np.eye(n_x), rng.normal(size=(n_x, n_v)), rng.normal(size=n_x)
    T, T_N = np.eye(n_x + n_v)[None], compiled_once(np.eye(n_x))
    h, x0 = 10.0 * rng.normal(size=(N + 1, n_x + n_v)), rng.normal(size=n_x)
    fac = new_factor(np.hstack([B, A])[None], d[None], N)
    assert factor(fac, T, T_N, NO_BARRIER, 0)
    x, v = np.empty((N + 1, n_x)), np.empty((N, n_v))
    solve(fac, h, x0, np.empty(0), x, v)
    upper = compiled_once(np.r_[np.inf, 0.3, 0.3, np.full(n_x, np.inf)])
    lower = -upper
    found = []
    for method in (solve_active, solve_interior):
        ours = x.copy(), v.copy()
        if method is solve_active:
            sides = np.zeros(h.shape, np.int64)
            status = solve_active(fac, h, x0, np.empty(0), lower, upper, sides, *ours)
            assert status == MET and np.count_nonzero(sides) > 40
        else:
            free = np.empty(0)
            assert solve_interior(fac, T, T_N, h, free, lower, upper, 1.0, *ours)
        found.append(ours[1])
    # The interior point's duality gap: at the worst 1e-8 of what the bounds cost.
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_an_input_with_equal_bounds_has_that_value():
    bounds = C3Bounds(u_lower=[1.5], u_upper=[1.5])
    for projection in (PLUS, C3_QP, EXACT):
        problem = cartpole_problem(projection, bounds)
        plan, _ = solve_c3(cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4)), problem)
        np.testing.assert_array_equal(plan.u, 1.5)


@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
def test_an_lcs_per_knot_is_obeyed_knot_by_knot(projection):
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    problem = cartpole_problem(projection)
    one, _ = solve_c3(lcs, x0, x_desired, problem)
    same, _ = solve_c3([lcs] * 5, x0, x_desired, problem)
    np.testing.assert_array_equal(same.u, one.u)
    rng = np.random.default_rng(0)
    models = [
        replace(lcs, A=lcs.A + 0.01 * rng.normal(size=(4, 4)), d=lcs.d + 0.01 * k)
        for k in range(5)
    ]
    plan, _ = solve_c3(models, x0, x_desired, problem)
    for k, m in enumerate(models):
        step = m.A @ plan.x[k] + m.B @ plan.u[k] + m.D @ plan.lam[k] + m.d
        np.testing.assert_allclose(plan.x[k + 1], step, atol=1e-12)
    x, cost = x0, 0.0
    for k, m in enumerate(models):
        cost += x @ problem.Q @ x + plan.u[k] @ problem.R @ plan.u[k]
        x, _ = simulate(m, x, plan.u[k])
    cost += x @ problem.Q_N @ x
    ours = plan_cost(models, x0, plan.u, x_desired, problem)
    assert ours == pytest.approx(cost, rel=1e-12)


def test_what_cannot_be_solved_is_told_in_one_line():
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    problem = cartpole_problem()
    with pytest.raises(C3Failure, match=r"x0\[2\] is nan, expected finite numbers"):
        solve_c3(lcs, [0.0, 0.0, np.nan, 0.0], x_desired, problem)
    with pytest.raises(C3Failure, match=r"x_desired\[0, 0\] is inf"):
        solve_c3(lcs, x0, np.full((6, 4), np.inf), problem)
    with pytest.raises(ValueError, match="4 LCS came, expected one, or 5"):
        solve_c3([lcs] * 4, x0, x_desired, problem)
    with pytest.raises(ValueError, match="lcs is a str, expected an LCS or a list"):
        solve_c3("ball", x0, x_desired, problem)
    with pytest.raises(ValueError, match=r"projection is 'c3\+', expected PlusProj"):
        cartpole_problem("c3+")


def test_bounds_that_cannot_be_met_are_a_failure():
    bounds = C3Bounds(x_upper=[0.0, np.inf, np.inf, np.inf])  # x_1 = .105 whatever u.
    problem = cartpole_problem(PLUS, bounds)
    with pytest.raises(C3Failure, match="no plan meets the bounds"):
        solve_c3(cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4)), problem)


def test_scaling_lam_is_solving_the_scaled_lcs():
    lcs, x_desired = cartpole_lcs(), np.zeros((6, 4))
    s = np.linalg.norm(lcs.A) / np.linalg.norm(lcs.D)
    assert s == pytest.approx(15.923825, rel=1e-7)  # c3_reference.
    scaled = replace(lcs, D=lcs.D * s, E=lcs.E / s, c=lcs.c / s, H=lcs.H / s)
    ours, _ = solve_c3(lcs, CARTPOLE["x0"], x_desired, cartpole_problem(scale_lam=True))
    plan, _ = solve_c3(scaled, CARTPOLE["x0"], x_desired, cartpole_problem())
    np.testing.assert_allclose(ours.u, plan.u, rtol=1e-9)
    np.testing.assert_allclose(ours.lam, plan.lam * s, rtol=1e-9, atol=1e-9)


def test_input_change_penalty_can_be_switched_off():
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    z = np.zeros((5, 9))
    last = WarmStart(np.full((5, 1), 7.0), z, z)
    off, on = (cartpole_problem(penalise_input_change=p) for p in (False, True))
    cold, _ = solve_c3(lcs, x0, x_desired, off)
    np.testing.assert_array_equal(solve_c3(lcs, x0, x_desired, off, last)[0].u, cold.u)
    # With u = 0 last, both penalties are the same; a heavy one keeps u where it was.
    np.testing.assert_array_equal(solve_c3(lcs, x0, x_desired, on)[0].u, cold.u)
    heavy = C3Weights(CARTPOLE["Q"], [1e9], CARTPOLE["G_plus"], CARTPOLE["U_plus"])
    heavy_problem = C3Problem(heavy, PLUS, on.options)
    plan, _ = solve_c3(lcs, x0, x_desired, heavy_problem, last)
    np.testing.assert_allclose(plan.u, 7.0, atol=1e-4)  # Other costs are 1e-5 of R.


def test_the_target_may_move_over_the_horizon():
    """Free motion, one round: the plan is the least-squares answer, written densely."""
    lcs = replace(cartpole_lcs(), D=np.zeros((4, 2)), E=np.zeros((2, 4)))
    x0, x_desired = CARTPOLE["x0"], np.random.default_rng(0).normal(size=(6, 4))
    problem = cartpole_problem(PLUS, rounds=0)
    plan, _ = solve_c3(lcs, x0, x_desired, problem)
    free, effect = [x0], [np.zeros((4, 5))]
    for k in range(5):
        free.append(lcs.A @ free[-1])
        effect.append(lcs.A @ effect[-1])
        effect[-1][:, k] += lcs.B[:, 0]
    weights = [problem.Q] * 5 + [problem.Q_N]
    H, b = np.eye(5) * CARTPOLE["R"], np.zeros(5)
    for M, x, target, Q in zip(effect, free, x_desired, weights, strict=True):
        H, b = H + M.T @ Q @ M, b + M.T @ Q @ (target - x)
    np.testing.assert_allclose(plan.u[:, 0], np.linalg.solve(H, b), rtol=1e-9)
    cost = plan_cost(lcs, x0, plan.u, x_desired, problem)
    by_hand = plan.u[:, 0] @ plan.u[:, 0]
    for x, target, Q in zip(plan.x, x_desired, weights, strict=True):
        by_hand += (x - target) @ Q @ (x - target)
    assert cost == pytest.approx(by_hand, rel=1e-12)


def test_warm_start_is_passed_in_and_a_solve_depends_on_nothing_else():
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    problem = cartpole_problem(warm_start=True, rounds=3)
    cold, warm = solve_c3(lcs, x0, x_desired, problem)
    first, _ = solve_c3(lcs, x0, x_desired, problem, warm)
    solve_c3(lcs, -x0, x_desired, problem)
    again, _ = solve_c3(lcs, x0, x_desired, problem, warm)
    np.testing.assert_array_equal(first.u, again.u)
    assert abs(first.u - cold.u).max() > 1e-3


def test_shifting_a_warm_start_moves_it_along_the_horizon():
    delta = np.arange(3.0)[:, None] * np.ones(9)
    shifted = WarmStart(np.zeros((3, 1)), delta, -delta).shifted(0.25)
    np.testing.assert_allclose(shifted.delta[:, 0], [0.25, 1.25, 2.0])
    np.testing.assert_allclose(shifted.w[:, 0], [-0.25, -1.25, -2.0])


def test_what_is_kept_of_a_force_goes_with_its_contact():
    """z = [x (2), lam (4), u (1), eta (4)], two forces a contact."""
    z = np.array([[8.0, 9.0, 1, 2, 3, 4, 7.0, 10, 20, 30, 40]] * 2)
    warm = WarmStart(np.zeros((2, 1)), z, -z)
    of, to = np.array([[5.0, 5, 2, 2]] * 2), np.array([[2.0, 2, 6, 6]] * 2)
    moved = warm.shifted(0.5, (of, to, [2, 7]))
    expected = [[8.0, 9, 3, 4, 0, 0, 7, 30, 40, 0, 0]] * 2
    np.testing.assert_array_equal(moved.delta, expected)
    np.testing.assert_array_equal(moved.w, -np.array(expected))
    same = warm.shifted(0.5, (of, of, [2, 7]))
    np.testing.assert_array_equal(same.delta, z)


def test_where_contacts_change_along_the_horizon_each_knot_has_its_own():
    z = np.array([[0.0, 1.0, 9.0], [0.0, 2.0, 9.0]])  # z = [x, lam, u].
    warm = WarmStart(np.zeros((2, 1)), z, 0.0 * z)
    of, to = np.array([[3.0], [4.0]]), np.array([[3.0], [3.0]])
    delta = warm.shifted(0.25, (of, to, [1])).delta
    # The second knot's force was that of contact 4, of which nothing is kept.
    np.testing.assert_allclose(delta[:, 1], [0.75 * 1.0, 0.0])


def two_walls(number):
    """The soft-wall cart-pole's LCS with its walls in the order of these numbers."""
    lcs, i = cartpole_lcs(), [0, 1] if number == (0, 1) else [1, 0]
    return LCS(
        lcs.A, lcs.B, lcs.D[:, i], lcs.d, lcs.E[i], lcs.F[np.ix_(i, i)], lcs.H[i],
        lcs.c[i], 0.01, None, None, np.array(number),
    )  # fmt: skip


@pytest.mark.parametrize("projection", [PLUS, C3_QP])
def test_a_system_whose_contacts_change_rows_plans_as_if_they_had_not(projection):
    """The second LCS has the walls in the other order: the warm start follows them."""
    plans = []
    for second in ((0, 1), (1, 0)):
        p = cartpole_problem(projection)
        weights = C3Weights(p.Q, p.R, p.G, p.U, p.Q_N)
        options = C3Options(N=5, rounds=2, rho=2.0, warm_start=True)
        system = C3Mpc(C3Config(weights, projection, options), 0.01)
        simulator = Simulator(system)
        context = simulator.get_mutable_context()
        system.GetInputPort("x").FixValue(context, [0.1, 0.35, 1.5, 0.5])
        system.GetInputPort("x_desired").FixValue(context, np.zeros(24))
        port = system.GetInputPort("lcs")
        port.FixValue(context, AbstractValue.Make(two_walls((0, 1))))
        simulator.AdvanceTo(0.005)
        first = system.GetOutputPort("plan").Eval(context)
        assert abs(first.lam).max() > 1e-3
        port.FixValue(context, AbstractValue.Make(two_walls(second)))
        simulator.AdvanceTo(0.015)
        assert system.GetOutputPort("status").Eval(context)[0] == 0
        plans.append(system.GetOutputPort("plan").Eval(context))
    np.testing.assert_allclose(plans[0].u, plans[1].u, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(plans[0].lam, plans[1].lam[:, ::-1], atol=1e-9)


def test_nothing_is_compiled_after_warm_up():
    problem = cartpole_problem(warm_start=True)
    warm_up(problem)
    compiled = len(qp_step.signatures)
    # Fortran order and a free lam_0: other layouts than those of the warm-up.
    lcs = LCS(
        **{k: np.asfortranarray(CARTPOLE[k]) for k in "ABDdEFc"},
        H=CARTPOLE["H"] + 0.1,
        dt=0.01,
    )
    _, warm = solve_c3(lcs, CARTPOLE["x0"], np.zeros((6, 4), order="F"), problem)
    solve_c3(lcs, CARTPOLE["x0"], np.zeros((6, 4)), problem, warm)
    assert len(qp_step.signatures) == compiled


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(Q=[10, 2, 1, -1]), r"C3Weights.Q has the eigenvalue -1"),
        (dict(R=[0.0]), r"leave an input without cost"),
        (dict(G=np.array([0, 0, 0, 0, 1, 0, 0, 1, 1.0])), r"C3Weights.G\[5\] is 0.0"),
        (dict(U=np.array([0, 0, 0, 0, 1, 1, 0, 1, -1.0])), r"C3Weights.U\[8\] is -1.0"),
        (dict(G=np.ones(8)), r"G has 8 and U 9 entries, expected one per entry of \[x"),
        (dict(G=np.ones((9, 9))), r"C3Weights.G is not diagonal"),
        (dict(U=np.full(9, np.nan)), r"C3Weights.U is .* expected finite"),
        (dict(Q=np.ones((2, 3))), r"expected finite numbers, a diagonal or a square"),
        (dict(Q=np.triu(np.ones((4, 4)))), r"C3Weights.Q is not symmetric"),
        (dict(Q_N=np.ones(3)), r"C3Weights.Q_N is \(3, 3\), expected \(4, 4\)"),
    ],
)
def test_bad_weights_are_refused_by_name(change, message):
    good = dict(Q=[10, 2, 1, 1], R=[1.0], G=CARTPOLE["G_plus"], U=CARTPOLE["U_plus"])
    with pytest.raises(ValueError, match=message):
        C3Problem(C3Weights(**(good | change)))


@pytest.mark.parametrize(
    ("options", "bounds", "message"),
    [
        (dict(N=0), None, "N = 0 knots"),
        (dict(rounds=-1), None, "rounds = -1"),
        (dict(rho=0.5), None, "rho is 0.5"),
        (dict(rho=np.nan), None, "rho is nan"),
        ({}, C3Bounds(u_lower=[1.1], u_upper=[1.0]), "1.1 to 1.0 for entry 0"),
        (dict(rounds=2.5), None, "C3Options.rounds is 2.5, expected an integer"),
        (dict(N=5.0), None, "C3Options.N is 5.0, expected an integer"),
        ({}, C3Bounds(u_lower=[1.0, 2.0]), "u is bounded by .* expected 1 numbers"),
        ({}, C3Bounds(x_upper=[np.nan] * 4), "x is bounded by"),
    ],
)
def test_bad_options_and_bounds_are_refused_by_name(options, bounds, message):
    with pytest.raises(ValueError, match=message):
        cartpole_problem(PLUS, bounds, **options)


def test_shapes_that_do_not_fit_the_weights_are_refused():
    problem = cartpole_problem()
    with pytest.raises(ValueError, match=r"x0 is \(3,\) and x_desired \(6, 4\)"):
        solve_c3(cartpole_lcs(), np.zeros(3), np.zeros((6, 4)), problem)
    lcs, *_ = ball(True, 5)
    with pytest.raises(ValueError, match=r"\(19, 3, 16\), expected \(4, 1, 2\)"):
        solve_c3(lcs, np.zeros(4), np.zeros((6, 4)), problem)


def test_numbers_that_are_not_finite_are_a_failure_and_not_a_plan():
    for projection in (PLUS, C3_QP, EXACT):
        problem = cartpole_problem(projection)
        for x0 in (np.full(4, np.nan), np.full(4, 1e308)):
            with pytest.raises(C3Failure):
                solve_c3(cartpole_lcs(), x0, np.zeros((6, 4)), problem)


# The polish.


def polish_problem(seed=0, eps_c=5e-4, N=5):
    """The ball a little beside its reference state: model, x0, weights and inputs."""
    rng = np.random.default_rng(seed)
    lcs, x0, x_desired, p = ball(True, N)
    lcs = replace(lcs, F=lcs.F + eps_c * np.eye(16))
    x0 = x0 + 0.01 * rng.normal(size=19)
    model = tuple(
        compiled_once(np.array(getattr(lcs, name), order="C")[None])
        for name in "ABDdEFHc"
    )
    return lcs, model, x0, x_desired, p, rng.normal(size=(N, 3))


def unbounded(n):
    return compiled_once(np.full(n, -np.inf)), compiled_once(np.full(n, np.inf))


def rolled_out(model, x0, u):
    N, (n_x, n_lam) = len(u), model[2].shape[1:]
    x, found_u = np.zeros((N + 1, n_x)), np.zeros_like(u)
    lam, pushing = np.zeros((N, n_lam)), np.zeros((N, n_lam), np.bool_)
    step = 0.0, np.zeros_like(u), np.zeros((*u.shape, n_x))
    found = x, found_u, lam, pushing
    assert roll_out(model, x0, (x.copy(), u), step, unbounded(u.shape[1]), found)
    return x, lam, pushing


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("eps_c", [0.0, 5e-4])
def test_the_polishs_rollout_is_that_of_simulate(seed, eps_c):
    lcs, model, x0, *_, u = polish_problem(seed, eps_c)
    x, lam, pushing = rolled_out(model, x0, u)
    for k in range(5):
        x_next, lam_k = simulate(lcs, x[k], u[k])
        # lam is unique with eps_c alone; the motion always is.
        np.testing.assert_allclose(x[k + 1], x_next, rtol=1e-9, atol=1e-10)
        if eps_c > 0.0:
            np.testing.assert_allclose(lam[k], lam_k, atol=1e-8 * lam_k.max())
        np.testing.assert_array_equal(pushing[k], lam[k] > 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_the_adjoint_gradient_is_that_of_finite_differences(seed):
    _, model, x0, x_desired, p, u = polish_problem(seed)
    centre = np.full((5, 3), 0.1)
    x_lower, x_upper = unbounded(19)
    # A bound that is breached at two of five knots: its penalty has a gradient too.
    x_upper = x_upper.copy()
    x_upper[10] = np.median(rolled_out(model, x0, u)[0][1:, 10])
    x_upper = compiled_once(x_upper)
    penalty = 7.0

    def cost(u):
        x, _, pushing = rolled_out(model, x0, u)
        _, extra = state_breach(x, x_lower, x_upper, penalty)
        total = rollout_cost(x, u, x_desired, centre, p.Q[None], p.R, p.Q_N)
        return total + extra, x, pushing

    _, x, pushing = cost(u)
    assert pushing.any() and (x[1:, 10] > x_upper[10]).sum() == 2
    gradient = np.zeros((5, 3))
    found = gradient, np.zeros((5, 3)), np.zeros((5, 3, 19))
    bounds = *unbounded(3), x_lower, x_upper
    weights = p.Q[None], p.R, p.Q_N, penalty
    backward(model, x, u, pushing, x_desired, centre, weights, bounds, found)
    numeric, h = np.zeros((5, 3)), 1e-6
    for i in np.ndindex(5, 3):
        step = np.zeros((5, 3))
        step[i] = h
        up, down = cost(u + step), cost(u - step)
        # Central differences mean something only where no contact changes.
        assert (up[2] == pushing).all() and (down[2] == pushing).all()
        numeric[i] = (up[0] - down[0]) / (2.0 * h)
    # The cost is quadratic there, so what is left is rounding of the cost over h.
    np.testing.assert_allclose(gradient, numeric, atol=1e-5 * abs(numeric).max())


def test_one_newton_step_is_the_optimum_where_the_modes_do_not_change():
    """Without contact the rollout is affine, and the optimum a least-squares answer."""
    lcs = replace(cartpole_lcs(), D=np.zeros((4, 2)), E=np.zeros((2, 4)))
    x0, x_desired = CARTPOLE["x0"], np.random.default_rng(0).normal(size=(6, 4))
    problem = cartpole_problem(PLUS, rounds=1, polish=1)
    exact, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(PLUS, rounds=0))
    # Far from it at the start: the input's weight in G pulls it to zero.
    heavy = C3Weights(problem.Q, problem.R, problem.G + 1e4, problem.U, problem.Q_N)
    polished = C3Problem(heavy, PLUS, problem.options)
    start, _ = solve_c3(
        lcs, x0, x_desired, C3Problem(heavy, PLUS, replace(problem.options, polish=0))
    )
    plan, _ = solve_c3(lcs, x0, x_desired, polished)
    assert abs(start.u - exact.u).max() > 1e-2
    # G of `exact` adds 1e-9 at most to its weights (G_plus has no u part).
    np.testing.assert_allclose(plan.u, exact.u, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("projection", [PLUS, C3_QP, EXACT])
def test_polish_is_never_worse_and_more_of_it_is_no_worse(projection, bounded):
    for make in (ball, cartpole):
        plus = isinstance(projection, PlusProjection)
        lcs, x0, x_desired, p = make(plus, 5)
        limit = np.full(p.n_u, 2.0)
        bounds = C3Bounds(-limit, limit) if bounded else None
        weights = C3Weights(p.Q, p.R, p.G, p.U, p.Q_N)
        costs = []
        for polish in (0, 1, 3, 10):
            options = replace(p.options, polish=polish)
            problem = C3Problem(weights, projection, options, bounds)
            plan, _ = solve_c3(lcs, x0, x_desired, problem)
            costs.append(plan_cost(lcs, x0, plan.u, x_desired, problem))
            assert not bounded or abs(plan.u).max() <= 2.0
            if polish:  # The plan is what the model does.
                for k in range(5):
                    x_next, _ = simulate(lcs, plan.x[k], plan.u[k])
                    size = abs(x_next).max()
                    np.testing.assert_allclose(plan.x[k + 1], x_next, atol=1e-9 * size)
        assert (np.diff(costs) <= 1e-9 * costs[0]).all()
        if make is ball:
            assert costs[-1] < 0.75 * costs[0]


def test_polish_agrees_with_a_derivative_free_search_that_starts_beside_it():
    """Powell's method knows the rollout alone. It finds nothing better near by."""
    lcs, x0, x_desired, p = cartpole(True, 5)
    problem = C3Problem(
        C3Weights(p.Q, p.R, p.G, p.U, p.Q_N), PLUS, replace(p.options, polish=6)
    )
    plan, _ = solve_c3(lcs, x0, x_desired, problem)
    ours = plan_cost(lcs, x0, plan.u, x_desired, problem)
    rng = np.random.default_rng(0)
    start = plan.u.ravel() + rng.normal(size=5)
    found = minimize(
        lambda u: plan_cost(lcs, x0, u.reshape(5, 1), x_desired, problem),
        start, method="Powell", options=dict(xtol=1e-6, ftol=1e-10),
    )  # fmt: skip
    assert ours == pytest.approx(found.fun, rel=1e-5)


def test_polish_does_not_breach_state_bounds_more_than_its_starts():
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    upper = np.full(4, np.inf)
    upper[2] = 0.7  # Of the cart's speed, which starts at .5 and would rise to 1.
    breach = []
    for polish in (0, 1, 5):
        bounds = C3Bounds(x_upper=upper)
        problem = cartpole_problem(PLUS, bounds, polish=polish)
        plan, _ = solve_c3(lcs, x0, x_desired, problem)
        x, worst = x0, 0.0
        for u in plan.u:
            x, _ = simulate(lcs, x, u)
            worst = max(worst, x[2] - 0.7)
        breach.append(worst)
    # 1e-6 is what Plan promises, of 1 + the bound.
    assert max(breach[1:]) <= max(breach[0], 1.7e-6)
    free, _ = solve_c3(lcs, x0, x_desired, cartpole_problem(PLUS, polish=5))
    assert free.x[1:, 2].max() > 0.72  # The bound matters.


def test_polish_takes_an_lcs_per_knot_and_no_fewer_than_zero_rollouts():
    lcs, x0, x_desired = cartpole_lcs(), CARTPOLE["x0"], np.zeros((6, 4))
    problem = cartpole_problem(PLUS, polish=3)
    one, _ = solve_c3(lcs, x0, x_desired, problem)
    same, _ = solve_c3([lcs] * 5, x0, x_desired, problem)
    np.testing.assert_array_equal(one.u, same.u)
    with pytest.raises(ValueError, match="polish is -1, expected at least 0"):
        cartpole_problem(PLUS, polish=-1)


# The residual and the command.


def test_residual_scales_with_the_time_step_and_penetration_is_taken_for_touching():
    lcs = replace(cartpole_lcs(), phi=np.array([0.002, -0.001]))  # dt .01.
    r_comp = np.array([-0.1, 0.04])  # At .05 s: gaps of -5 mm and +2 mm.
    plain = with_gap_residual(lcs, r_comp, 0.05, clamp=False)
    np.testing.assert_allclose(plain.c - lcs.c, [-0.5, 0.2])
    clamped = with_gap_residual(lcs, r_comp, 0.05, clamp=True)
    # phi + r is -3 mm and +1 mm: the first is raised to zero, 3 mm / .01 s.
    np.testing.assert_allclose(clamped.c - plain.c, [0.3, 0.0], atol=1e-12)


# The system.


def config(bounds=None, projection=PLUS, **options):
    kind = "plus" if isinstance(projection, PlusProjection) else "c3"
    weights = C3Weights(
        CARTPOLE["Q"],
        CARTPOLE["R"],
        CARTPOLE["G_" + kind],
        CARTPOLE["U_" + kind],
        CARTPOLE["QN"],
    )
    options = C3Options(**({"N": 5, "rounds": 10} | options))
    return C3Config(weights, projection, options, bounds or C3Bounds())


def fixed(system, x=None, x_desired=None, lcs=None, **others):
    """A simulator of the system alone, all its inputs fixed."""
    simulator = Simulator(system)
    values = dict(
        x=CARTPOLE["x0"] if x is None else x,
        x_desired=np.zeros(24) if x_desired is None else x_desired,
        lcs=AbstractValue.Make(cartpole_lcs() if lcs is None else lcs),
    )
    for name, value in (values | others).items():
        fix(simulator, name, value)
    simulator.Initialize()
    return simulator


def fix(simulator, name, value):
    port = simulator.get_system().GetInputPort(name)
    port.FixValue(simulator.get_mutable_context(), value)


def read(simulator, name):
    port = simulator.get_system().GetOutputPort(name)
    return port.Eval(simulator.get_context())


def test_in_the_command_a_contact_that_slides_is_not_felt_from_a_distance():
    """A tip that passes 4 mm over a ball at 0.2 m/s: Anitescu's contact would stop it
    within a step of 50 ms; with the sliding speed taken out it passes."""
    x = BALL["x0"].copy()
    x[:3] = x[7:10] + [0.0, 0.0, x[9] + 0.06]  # Lifted off, then to 4 mm.
    far = ball_lcs(x=x).phi[0]
    x[2] -= far - 0.004
    x[10:] = [0.2, 0.0, -0.02, *np.zeros(6)]
    lcs = ball_lcs(x=x)
    assert lcs.phi[0] == pytest.approx(0.004, abs=1e-9)
    r, mu = np.zeros(lcs.n_lam), 0.5
    plain = with_gap_residual(lcs, r, 0.05, True)
    passing = with_gap_residual(lcs, r, 0.05, True, x)
    # Eight edges: along one of them within 22.5 degrees.
    slip = passing.c[:8] - plain.c[:8]
    assert mu * 0.2 * np.cos(np.pi / 8) <= slip[0] <= mu * 0.2 + 1e-12
    np.testing.assert_allclose(slip, slip[0])
    carried = np.array([0.0, 0.0, (x - lcs.A @ x - lcs.d)[12] / lcs.B[12, 2]])
    assert simulate(plain, x, carried)[1][:8].max() > 1e-3
    assert simulate(passing, x, carried)[1][:8].max() < 1e-9


def test_system_gives_the_plan_and_one_step_of_its_model():
    simulator = fixed(C3Mpc(config(), 0.01))
    assert read(simulator, "status") == C3Status.NO_PLAN_YET
    np.testing.assert_array_equal(read(simulator, "u"), [0.0])
    np.testing.assert_array_equal(read(simulator, "x_next"), CARTPOLE["x0"])
    simulator.AdvanceTo(0.005)
    u = read(simulator, "u")
    np.testing.assert_allclose(u, CARTPOLE["plus_first_u"][0], rtol=1e-8)
    x_next, lam = simulate(cartpole_lcs(), CARTPOLE["x0"], u)
    np.testing.assert_array_equal(read(simulator, "x_next"), x_next)
    np.testing.assert_array_equal(read(simulator, "lam"), lam)
    plan = read(simulator, "plan")
    np.testing.assert_array_equal(plan.u[0], u)
    assert plan.status == 0 and read(simulator, "status") == 0
    with pytest.raises(ValueError, match="read-only"):
        plan.u[0] = 0.0


def test_command_takes_one_step_of_its_own_model_with_the_residual():
    r_comp = np.array([0.02, -0.03])
    command = replace(cartpole_lcs(), dt=0.002, phi=np.array([0.1, 0.001]))
    simulator = fixed(
        C3Mpc(replace(config(), residual_dt_sec=0.05), 0.01),
        lcs_command=AbstractValue.Make(command),
        r_comp=r_comp,
    )
    simulator.AdvanceTo(0.005)
    plan_lcs = cartpole_lcs().with_residual(5.0 * r_comp)
    plan, _ = solve_c3(plan_lcs, CARTPOLE["x0"], np.zeros((6, 4)), cartpole_problem())
    np.testing.assert_array_equal(read(simulator, "u"), plan.u[0])
    model = command.with_residual(25.0 * r_comp + [0.0, 0.25])  # -.5 mm / .002 s.
    x_next, lam = simulate(model, CARTPOLE["x0"], plan.u[0])
    np.testing.assert_allclose(read(simulator, "x_next"), x_next, rtol=1e-12)
    np.testing.assert_allclose(read(simulator, "lam"), lam, rtol=1e-12)


@pytest.mark.parametrize("sliding", [False, True])
def test_the_systems_command_takes_sliding_contacts_for_open_only_if_asked_to(sliding):
    """Both forces of one contact, opposite edges along the cart's velocity x[2]."""
    J = np.array([[0.3, 0.0], [-0.3, 0.0]])
    plain = cartpole_lcs()
    command = replace(plain, c=plain.c - 0.6, J=J, contact=np.zeros(2))  # Touching.
    problem = replace(config(), sliding_command=sliding)
    simulator = fixed(C3Mpc(problem, 0.01), lcs_command=AbstractValue.Make(command))
    simulator.AdvanceTo(0.005)
    opening = 0.3 * abs(CARTPOLE["x0"][2]) * sliding
    assert not sliding or opening > 0.01
    model = command.with_residual(np.full(2, opening))
    _, lam = simulate(model, CARTPOLE["x0"], read(simulator, "u"))
    np.testing.assert_allclose(read(simulator, "lam"), lam, rtol=1e-12)
    assert lam.max() > 1.0


def not_finite(a):
    a = np.array(a, dtype=float)
    a.flat[-1] = np.nan
    return a


@pytest.mark.parametrize(
    ("name", "value", "status"),
    [
        ("x", not_finite(CARTPOLE["x0"]), C3Status.BAD_X),
        ("x_desired", not_finite(np.zeros(24)), C3Status.BAD_X_DESIRED),
        ("r_comp", not_finite(np.zeros(2)), C3Status.BAD_R_COMP),
        ("lcs", replace(cartpole_lcs(), c=[0.0, np.inf]), C3Status.BAD_LCS),
        ("lcs", object(), C3Status.BAD_LCS),
        ("lcs", ball(True, 5)[0], C3Status.BAD_LCS),
        ("x", np.full(4, 1e308), C3Status.SOLVE_FAILED),
    ],
)
def test_a_bad_input_holds_the_last_plan_as_time_goes_on(name, value, status):
    bounds = C3Bounds(u_lower=[1.0], u_upper=[100.0])
    simulator = fixed(C3Mpc(config(bounds), 0.005), r_comp=np.zeros(2))
    simulator.AdvanceTo(0.001)
    u = read(simulator, "plan").u[:, 0]
    x_next = read(simulator, "x_next")
    fix(simulator, name, AbstractValue.Make(value) if name == "lcs" else value)
    held = []
    for tick in range(1, 14):
        simulator.AdvanceTo(0.005 * tick + 0.001)
        held.append(read(simulator, "u")[0])
        assert read(simulator, "status") == status
        assert read(simulator, "plan").status == status
        np.testing.assert_array_equal(read(simulator, "x_next"), x_next)
    # Knots are two periods long; behind the plan's end comes the smallest input.
    np.testing.assert_array_equal(held, [u[0], *np.repeat(u[1:], 2), *[1.0] * 4])
    fix(simulator, "x", CARTPOLE["x0"])
    fix(simulator, "x_desired", np.zeros(24))
    fix(simulator, "r_comp", np.zeros(2))
    fix(simulator, "lcs", AbstractValue.Make(cartpole_lcs()))
    simulator.AdvanceTo(0.075)
    assert read(simulator, "status") == C3Status.SOLVED
    assert read(simulator, "u") == u[0]


def test_an_lcs_per_knot_is_planned_with_and_the_first_one_commands():
    models = [replace(cartpole_lcs(), d=[0.0, 0.0, 0.01 * k, 0.0]) for k in range(5)]
    simulator = fixed(C3Mpc(config(), 0.01), lcs=tuple(models))
    simulator.AdvanceTo(0.005)
    plan, _ = solve_c3(models, CARTPOLE["x0"], np.zeros((6, 4)), cartpole_problem())
    np.testing.assert_array_equal(read(simulator, "u"), plan.u[0])
    x_next, _ = simulate(models[0], CARTPOLE["x0"], plan.u[0])
    np.testing.assert_array_equal(read(simulator, "x_next"), x_next)
    for bad in (models[:4], [*models[:4], replace(models[4], dt=0.5)], []):
        fix(simulator, "lcs", AbstractValue.Make(tuple(bad)))
        simulator.AdvanceTo(simulator.get_context().get_time() + 0.01)
        assert read(simulator, "status") == C3Status.BAD_LCS


def test_a_plan_is_read_at_any_time():
    x, u = np.arange(8.0).reshape(4, 2), np.array([[1.0], [2.0], [3.0]])
    plan = Plan(x, u, np.zeros((3, 1)), 0, 2.0, 0.1)
    at, inputs = plan.at([1.0, 2.0, 2.05, 2.1, 2.325, 9.0])
    np.testing.assert_allclose(at[:, 0], [0, 0, 1, 2, 6, 6], atol=1e-4)
    np.testing.assert_array_equal(inputs[:, 0], [1, 1, 1, 2, 3, 3])
    with pytest.raises(ValueError, match="time is None"):
        replace(plan, time=None).at([0.0])


def test_a_stream_that_never_was_good_gives_the_smallest_input():
    bounds = C3Bounds(u_lower=[0.5], u_upper=[9.0])
    simulator = fixed(C3Mpc(config(bounds), 0.01), x=np.full(4, np.nan))
    simulator.AdvanceTo(0.035)
    np.testing.assert_array_equal(read(simulator, "u"), [0.5])
    assert np.isfinite(read(simulator, "x_next")).all()


def test_a_context_saved_and_restored_replays_bit_for_bit():
    def closed_loop():
        builder = DiagramBuilder()
        lcs = cartpole_lcs()
        plant = builder.AddNamedSystem("plant", LcsPlant(lcs, CARTPOLE["x0"]))
        options = dict(penalise_input_change=True, warm_start=True)
        mpc = builder.AddNamedSystem("mpc", C3Mpc(config(**options), 0.01, 0.005))
        builder.Connect(plant.GetOutputPort("x"), mpc.GetInputPort("x"))
        builder.Connect(mpc.GetOutputPort("u"), plant.GetInputPort("u"))
        builder.ExportInput(mpc.GetInputPort("x_desired"), "x_desired")
        builder.ExportInput(mpc.GetInputPort("lcs"), "lcs")
        builder.ExportOutput(mpc.GetOutputPort("plan"), "plan")
        builder.ExportOutput(plant.GetOutputPort("x"), "x")
        return builder.Build()

    diagram = closed_loop()
    simulator = Simulator(diagram)
    fix(simulator, "x_desired", np.zeros(24))
    fix(simulator, "lcs", AbstractValue.Make(cartpole_lcs()))
    simulator.AdvanceTo(0.102)
    saved = simulator.get_context().Clone()
    simulator.AdvanceTo(0.302)
    # Another diagram, which never ran, goes on from the saved Context.
    other = closed_loop()
    context = other.CreateDefaultContext()
    context.SetTimeStateAndParametersFrom(saved)
    replay = Simulator(other, context)
    fix(replay, "x_desired", np.zeros(24))
    fix(replay, "lcs", AbstractValue.Make(cartpole_lcs()))
    replay.Initialize(params_without_initialization())
    replay.AdvanceTo(0.302)
    for name in ("u", "x", "lam"):
        ours, again = (getattr(read(s, "plan"), name) for s in (simulator, replay))
        np.testing.assert_array_equal(ours, again)
    # All of it, the warm start too, to which the plan may be blind for a while.
    ended = simulator.get_context(), replay.get_context()
    for i in range(saved.num_discrete_state_groups()):
        ours, again = (c.get_discrete_state(i).value() for c in ended)
        np.testing.assert_array_equal(ours, again)


def params_without_initialization():
    from pydrake.systems.analysis import InitializeParams

    return InitializeParams(suppress_initialization_events=True)


def test_config_reads_from_yaml_with_the_projection_as_a_tag():
    text = """
    weights: {Q: [1, 1], R: [0.1], G: [0, 0, 1, 0], U: [1, 1, 1, 0]}
    projection: !QpProjection {alpha: 0.02}
    options: {N: 7, penalise_input_change: true}
    bounds: {u_lower: [-1], u_upper: [1]}
    clamp_command_gap: false
    """
    loaded = yaml_load_typed(schema=C3Config, data=text)
    assert loaded.projection == QpProjection(alpha=0.02)
    assert loaded.options == C3Options(N=7, penalise_input_change=True)
    system = C3Mpc(loaded, 0.0125)
    assert system.GetInputPort("x_desired").size() == 8 * 2


# A cost on orientation.


def on_sphere(q, step):
    """The unit quaternion reached from q along a tangent step (4,)."""
    length = np.linalg.norm(step)
    return np.cos(length) * q + np.sinc(length / np.pi) * step


@pytest.mark.parametrize("angle", [1e-6, 0.3, 2.0, 3.1])
def test_the_orientation_cost_has_the_gradient_and_hessian_of_the_angle(angle):
    rng = np.random.default_rng(0)
    goal = Rotation.random(rng=0)
    axis = rng.normal(size=3)
    axis *= angle / np.linalg.norm(axis)
    turned = Rotation.from_rotvec(axis) * goal
    q, q_d = turned.as_quat(scalar_first=True), goal.as_quat(scalar_first=True)
    # The same orientation as q_d.
    Q, target = (each[0] for each in orientation_quadratics(q, -q_d[None]))
    assert (q - target) @ Q @ (q - target) == pytest.approx(angle**2, abs=1e-9)
    assert np.linalg.eigvalsh(Q).min() > -1e-12

    def cost(step):  # From scipy's rotations: nothing of ours.
        x = on_sphere(q, step)
        relative = Rotation.from_quat(x, scalar_first=True) * goal.inv()
        return relative.magnitude() ** 2

    tangents = np.linalg.svd(q[None])[2][1:]
    h = 1e-4
    for a in tangents:
        gradient = (cost(h * a) - cost(-h * a)) / (2 * h)
        np.testing.assert_allclose(2 * a @ Q @ (q - target), gradient, atol=1e-5)
        for b in tangents:
            if angle > 3.0:
                continue  # The angle has a kink at pi, .04 rad away.
            numeric = (
                cost(h * (a + b)) - cost(h * (a - b))
                - cost(h * (b - a)) + cost(-h * (a + b))
            ) / (4 * h * h)  # fmt: skip
            np.testing.assert_allclose(2 * a @ Q @ b, numeric, atol=1e-5)


@pytest.mark.parametrize("angle", [1e-6, 0.3, 1.0])
@pytest.mark.parametrize("rolled", [0.0, 1.5, 4.0])
def test_a_turn_about_a_free_axis_costs_nothing(angle, rolled):
    axis = np.array([0.6, 0.0, 0.8])
    across = np.array([0.8, 0.0, -0.6])  # The swing: square to the axis.
    goal = Rotation.random(rng=1)
    turned = goal * Rotation.from_rotvec(angle * across)
    turned = turned * Rotation.from_rotvec(rolled * axis)
    q, q_d = turned.as_quat(scalar_first=True), goal.as_quat(scalar_first=True)
    assert squared_angle(q, q_d, 3.0 * axis) == pytest.approx(angle**2, abs=1e-9)

    def cost(step):  # The angle between where the axis points and where it should.
        x = Rotation.from_quat(on_sphere(q, step), scalar_first=True)
        a, b = x.apply(axis), goal.apply(axis)
        return np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) ** 2

    Q, target = (each[0] for each in orientation_quadratics(q, q_d[None], axis))
    assert (q - target) @ Q @ (q - target) == pytest.approx(angle**2, abs=1e-9)
    assert np.linalg.eigvalsh(Q).min() > -1e-12
    h = 1e-4
    for a in np.linalg.svd(q[None])[2][1:]:
        gradient = (cost(h * a) - cost(-h * a)) / (2 * h)
        np.testing.assert_allclose(2 * a @ Q @ (q - target), gradient, atol=1e-5)
    # Rolling on costs nothing, to any order; swinging on what the angle says.
    roll = Rotation.from_rotvec(1e-3 * axis)
    t = ((turned * roll).as_quat(scalar_first=True) - q) / 5e-4
    assert abs(t @ Q @ t) < 1e-5
    np.testing.assert_allclose(2 * t @ Q @ (q - target), 0.0, atol=1e-3)


def test_the_weights_of_an_orientation_are_in_rad():
    problem = C3Problem(turning_weights(3.0, 7.0))
    x = np.zeros(14)
    x[0], x[7:11] = 1.0, [np.cos(0.2), 0.0, np.sin(0.2), 0.0]
    x_desired = np.tile(x, (6, 1))
    x_desired[:, :4] = [np.cos(0.15), np.sin(0.15), 0.0, 0.0]  # .3 rad apart.
    idle = turning_lcs()
    cost = plan_cost(idle, x, np.zeros((5, 3)), x_desired, problem)
    assert cost == pytest.approx((5 * 3.0 + 7.0) * 0.09, rel=1e-9)


def turning_weights(weight, weight_N=None, start=0):
    Q = np.zeros(14)
    Q[4:7] = 0.01
    G = np.repeat([0.001, 1.0, 0.001, 1.0], [14, 1, 3, 1])
    orientation = [OrientationWeight(start, weight, weight_N)]
    return C3Weights(Q, np.full(3, 1e-3), G, np.ones(19), None, orientation)


def turning_lcs(q=(1.0, 0.0, 0.0, 0.0), dt=0.1):
    """x = [quaternion, omega in the world, 7 more]: a free body turned by torques u,
    linearised about q; its contact is far away."""
    L = np.array(
        [[-q[1], -q[2], -q[3]], [q[0], q[3], -q[2]],
         [-q[3], q[0], q[1]], [q[2], -q[1], q[0]]]
    )  # fmt: skip
    A, B = np.eye(14), np.zeros((14, 3))
    A[:4, 4:7] = 0.5 * dt * L
    B[4:7] = dt * np.eye(3)
    B[:4] = 0.5 * dt * L @ B[4:7]
    n = np.zeros
    return LCS(
        A, B, n((14, 1)), n(14), n((1, 14)), np.eye(1), n((1, 3)), np.ones(1), dt
    )


@pytest.mark.parametrize("polish", [0, 2])
def test_a_body_is_turned_the_short_way_to_its_desired_orientation(polish):
    options = C3Options(N=5, rounds=2, polish=polish)
    problem = C3Problem(turning_weights(10.0), None, options)
    start = Rotation.from_rotvec([0.0, 0.0, 2.5])
    goal = Rotation.from_rotvec([1.2, 0.0, 0.0]) * start
    x, angles = np.zeros(14), []
    x[:4] = start.as_quat(scalar_first=True)
    x_desired = np.zeros((6, 14))
    x_desired[:, :4] = -goal.as_quat(scalar_first=True)  # The far one of the two signs.
    for _ in range(30):
        now = Rotation.from_quat(x[:4], scalar_first=True)
        angles.append((goal * now.inv()).magnitude())
        plan, _ = solve_c3(turning_lcs(x[:4]), x, x_desired, problem)
        x[4:7] += 0.1 * plan.u[0]
        turn = Rotation.from_rotvec(0.1 * x[4:7])
        x[:4] = (turn * now).as_quat(scalar_first=True)
    assert angles[0] == pytest.approx(1.2)
    assert max(angles) < 1.2 + 1e-9 and angles[-1] < 0.02


def test_bad_orientation_weights_are_refused_by_name():
    for start, weight, message in (
        (11, 1.0, "starts at 11, expected an integer from 0 to 10"),
        (0.5, 1.0, "starts at 0.5"),
        (0, -1.0, "-1.0, expected a number >= 0"),
        (4, 1.0, "Q weighs the quaternion's numbers too"),
    ):
        with pytest.raises(ValueError, match=message):
            C3Problem(turning_weights(weight, start=start))
    problem = C3Problem(turning_weights(1.0))
    x = np.zeros(14)
    with pytest.raises(C3Failure, match="x0: the quaternion at 0 is"):
        solve_c3(turning_lcs(), x, np.zeros((6, 14)), problem)


# Contact modes that are held.


def random_steps(seed, n_steps=4):
    """The ball's LCS with eps_c, inputs, and the exact rollout."""
    rng = np.random.default_rng(seed)
    lcs, x0, _, _ = ball(True, 5)
    lcs = replace(lcs, F=lcs.F + 5e-4 * np.eye(16))
    x0 = x0 + 0.02 * rng.normal(size=19)
    u = rng.normal(size=(n_steps, 3))
    x, lam = [x0], []
    for u_k in u:
        step = simulate(lcs, x[-1], u_k)
        x.append(step[0])
        lam.append(step[1])
    return lcs, x0, u, np.array(x), np.array(lam)


@pytest.mark.parametrize("seed", range(5))
def test_with_the_true_modes_held_the_rollout_needs_no_lcp(seed):
    lcs, x0, u, x, lam = random_steps(seed)
    modes = contact_modes(lcs, x0, u)
    assert (modes == CLOSED).any() and (modes == OPEN).any()
    for k in range(len(u)):
        held = fix_modes(lcs, modes[k])
        assert (held.n_x, held.n_lam) == (lcs.n_x, lcs.n_lam)
        free = modes[k] == FREE
        assert not held.D[:, ~free].any()
        x_next, lam_free = simulate(held, x[k], u[k])
        np.testing.assert_allclose(x_next, x[k + 1], atol=1e-9)
        forces = fixed_forces(lcs, modes[k], x[k], u[k], lam_free)
        np.testing.assert_allclose(forces, lam[k], atol=1e-7)


def test_some_modes_held_and_the_others_free_is_the_same_lcp():
    lcs, x0, u, x, lam = random_steps(1)
    modes = contact_modes(lcs, x0, u)
    modes[:, ::3] = FREE
    for k in range(len(u)):
        x_next, lam_free = simulate(fix_modes(lcs, modes[k]), x[k], u[k])
        np.testing.assert_allclose(x_next, x[k + 1], atol=1e-9)
        forces = fixed_forces(lcs, modes[k], x[k], u[k], lam_free)
        np.testing.assert_allclose(forces, lam[k], atol=1e-7)


@pytest.mark.parametrize("projection", [PlusProjection(), QpProjection()])
def test_a_plan_keeps_the_modes_that_are_held(projection):
    plus = isinstance(projection, PlusProjection)
    lcs, x0, x_desired, p = ball(plus, 5)
    lcs = replace(lcs, F=lcs.F + 5e-4 * np.eye(16))
    problem = C3Problem(C3Weights(p.Q, p.R, p.G, p.U), projection, p.options)
    free, _ = solve_c3(lcs, x0, x_desired, problem)
    modes = contact_modes(lcs, x0, free.u)[:3]
    plan, warm = solve_c3(lcs, x0, x_desired, problem, modes=modes)
    assert np.isfinite(warm.delta).all() and np.isfinite(warm.w).all()
    for k in range(3):
        step = lcs.A @ plan.x[k] + lcs.B @ plan.u[k] + lcs.D @ plan.lam[k] + lcs.d
        np.testing.assert_allclose(step, plan.x[k + 1], atol=1e-6)
        gap = lcs.E @ plan.x[k] + lcs.F @ plan.lam[k] + lcs.H @ plan.u[k] + lcs.c
        assert not plan.lam[k, modes[k] == OPEN].any()
        np.testing.assert_allclose(gap[modes[k] == CLOSED], 0.0, atol=1e-7)
    # Without them the relaxed forces of these knots do break the complementarity.
    gap = free.x[:3] @ lcs.E.T + free.lam[:3] @ lcs.F.T + free.u[:3] @ lcs.H.T + lcs.c
    assert abs(gap * free.lam[:3]).max() > 1e-3
    with pytest.raises(ValueError, match=r"modes is \(6, 16\), expected at most 5"):
        solve_c3(lcs, x0, x_desired, problem, modes=np.zeros((6, 16)))


def test_the_system_holds_the_modes_of_its_last_plan():
    lcs, x0, x_desired, p = ball(True, 5)
    weights = C3Weights(p.Q, p.R, p.G, p.U)
    system = C3Mpc(C3Config(weights, options=p.options, fixed_knots=2), 0.05)
    simulator = Simulator(system)
    for name, value in (
        ("x", x0), ("x_desired", x_desired.ravel()), ("lcs", AbstractValue.Make(lcs)),
    ):  # fmt: skip
        fix(simulator, name, value)
    simulator.AdvanceTo(0.01)
    first = read(simulator, "plan")
    expected, _ = solve_c3(lcs, x0, x_desired, p)
    np.testing.assert_array_equal(first.u, expected.u)  # No plan, no modes.
    simulator.AdvanceTo(0.06)
    modes = contact_modes(lcs, x0, first.u[1:3])  # A knot later.
    expected, _ = solve_c3(lcs, x0, x_desired, p, modes=modes)
    np.testing.assert_allclose(read(simulator, "plan").u, expected.u, atol=1e-12)
    with pytest.raises(ValueError, match="fixed_knots is 6, expected an .* N = 5"):
        C3Mpc(C3Config(weights, options=p.options, fixed_knots=6), 0.05)


def test_bounds_of_inputs_alone_are_never_called_impossible():
    """40 steps of a system that grows 34 times a step: numbers as far apart as 1e60."""
    d = np.load(Path(__file__).parent / "reference" / "unstable_40_steps.npz")
    lcs = LCS(*(d[k] for k in "ABDdEFHc"), float(d["dt"]))
    bounds = C3Bounds(d["lower"][4:8], d["upper"][4:8])
    weights = C3Weights(d["Q"], d["R"], d["G"], d["U"])
    problem = C3Problem(weights, PLUS, C3Options(N=40), bounds)
    with pytest.raises(C3Failure, match="numerics: rounding leaves open"):
        solve_c3(lcs, d["x"], d["xd"], problem)
