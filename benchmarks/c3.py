"""Compares C3 and C3+ with a re-implementation of the reference with Drake's OSQP.

The re-implementation is the algorithm of the public C++ library in pydrake: a
MathematicalProgram whose consensus cost is replaced in every ADMM round, solved by OSQP
with a new setup each time; and for C3 a small program for each knot and round, the
projection. Its settings are the library's, and it reproduces
tests/reference/c3_cartpole.npz to 1e-9 (tests/test_c3_mpc.py). Only the time within
OsqpSolver.Solve is compared, with programs already built; the fraction of Python's work
in the re-implementation (up to half, on the cart-pole) is given as well. Ours is the
time of the whole call.

Rounds, rho, weights, scaling of lam and the first solve from delta = w = 0 are equal.
The cost is that of the inputs, rolled out through the LCS with exact contact forces.
"""

import os
import sys
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.solvers import MathematicalProgram, OsqpSolver, SolverOptions
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks.bench import median_call_ms
from makebreak.systems.contact_mpc.lcs_builder import (
    Anitescu,
    AnitescuLcs,
    ContactPair,
    StewartTrinkle,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Bounds,
    C3Failure,
    C3Options,
    C3Problem,
    C3Weights,
    plan_cost,
    solve_c3,
)
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    QpProjection,
    project_exact,
)
from makebreak.systems.contact_mpc.numerics.lcp import solve_lcp
from makebreak.systems.contact_mpc.numerics.lcs import LCS

REFERENCE = Path(__file__).resolve().parents[1] / "tests" / "reference"
# Options of the library's QP step, and of its QP projection.
QP_OPTIONS = dict(
    max_iter=1000,
    check_termination=25,
    polishing=1,
    polish_refine_iter=3,
    scaled_termination=1,
    scaling=10,
    adaptive_rho=1,
    adaptive_rho_interval=0,
    adaptive_rho_tolerance=5.0,
    adaptive_rho_fraction=0.4,
    rho=1e-4,
    sigma=1e-6,
    alpha=1.6,
    delta=1e-6,
    eps_abs=1e-5,
    eps_rel=1e-5,
    eps_prim_inf=1e-5,
    eps_dual_inf=1e-5,
    time_limit=1.0,
)
PROJECTION_OPTIONS = dict(
    max_iter=500, polishing=1, polish_refine_iter=1, rho=1e-4, scaled_termination=1
)
# rho of the ball problem is that of the ball-rolling controller, as its file gives
# none; that of the cart-pole is the reference's.
BALL_RHO, CARTPOLE_RHO = 2.2, 2.0


def osqp_options(options: dict) -> SolverOptions:
    solver_options = SolverOptions()
    for name, value in options.items():
        solver_options.SetOption(OsqpSolver.id(), name, value)
    return solver_options


class OsqpC3:
    """The reference's C3 (QP projection) or C3+, as Drake programs.

    Args:
        lcs: the model, in its own units.
        problem: what `solve_c3` takes; without bounds and without input-change penalty.
        scaling: divisor of the slack's rows in the projection, as in the library.
    """

    def __init__(self, lcs: LCS, problem: C3Problem, scaling: float = 1e3):
        o, p = problem.options, problem
        self.problem, self.scaling, N = problem, scaling, problem.options.N
        s = np.linalg.norm(lcs.A) / np.linalg.norm(lcs.D) if o.scale_lam else 1.0
        self.s = s
        self.lcs = lcs = LCS(
            lcs.A,
            lcs.B,
            lcs.D * s,
            lcs.d,
            lcs.E / s,
            lcs.F,
            lcs.H / s,
            lcs.c / s,
            lcs.dt,
        )
        self.osqp, self.solver_sec = OsqpSolver(), 0.0  # Time within the solver.
        self.qp_options = osqp_options(QP_OPTIONS)
        self.projection_options = osqp_options(PROJECTION_OPTIONS)
        self.prog = prog = MathematicalProgram()
        self.x, self.z, targets = [], [], []
        for k in range(N + 1):
            x = prog.NewContinuousVariables(p.n_x)
            self.x.append(x)
            if k < N:
                rest = prog.NewContinuousVariables(p.n_z - p.n_x)
                self.z.append(np.concatenate([x, rest]))
            Q = p.Q_N if k == N else p.Q
            cost = prog.AddQuadraticCost(2.0 * Q, np.zeros(p.n_x), x, is_convex=True)
            targets.append((cost.evaluator(), Q))
        self.targets, self.inputs = targets, []
        n_v = p.n_x + p.n_lam + p.n_u
        minus_one = -np.eye(p.n_x)
        for k in range(N):
            z = self.z[k]
            prog.AddLinearEqualityConstraint(
                np.hstack([lcs.A, lcs.D, lcs.B, minus_one]),
                -lcs.d,
                np.concatenate([z[:n_v], self.x[k + 1]]),
            )
            u = z[p.n_x + p.n_lam : n_v]
            cost = prog.AddQuadraticCost(2.0 * p.R, np.zeros(p.n_u), u, is_convex=True)
            self.inputs.append(cost.evaluator())
            if p.is_plus:
                prog.AddLinearEqualityConstraint(
                    np.hstack([lcs.E, lcs.F, lcs.H, -np.eye(p.n_lam)]), -lcs.c, z
                )
        zeros = np.zeros(p.n_x)
        start = prog.AddLinearEqualityConstraint(np.eye(p.n_x), zeros, self.x[0])
        self.start, self.force = start.evaluator(), None
        if not lcs.H.any():
            lam0 = self.z[0][p.n_x : p.n_x + p.n_lam]
            self.force = prog.AddLinearEqualityConstraint(
                np.eye(p.n_lam), np.zeros(p.n_lam), lam0
            ).evaluator()
        self.consensus: list = []

    def solve(self, x0, x_desired, u_prev=None):
        """Inputs u (N, n_u) from the state x0 (n_x,); x_desired (N + 1, n_x).

        u_prev (N, n_u): centre of the input cost; in the library the last solution.
        """
        o, p, lcs = self.problem.options, self.problem, self.lcs
        self.start.UpdateCoefficients(np.eye(p.n_x), x0)
        if self.force is not None:
            lam0 = solve_lcp(lcs.F, lcs.E @ x0 + lcs.c)
            self.force.UpdateCoefficients(np.eye(p.n_lam), lam0)
        for (cost, Q), target in zip(self.targets, x_desired, strict=True):
            cost.UpdateCoefficients(2.0 * Q, -2.0 * Q @ target)
        if u_prev is not None:
            for cost, u in zip(self.inputs, u_prev, strict=True):
                cost.UpdateCoefficients(2.0 * p.R, -2.0 * p.R @ u)
        delta, w = np.zeros((o.N, p.n_z)), np.zeros((o.N, p.n_z))
        if o.start_at_x0:
            delta[:, : p.n_x] = x0
        G = np.diag(p.G)
        for _ in range(o.rounds):
            z = self._solve_qp(G, delta - w)
            delta = np.array([self._project(zw) for zw in z + w])
            w = (w + z - delta) / o.rho
            G = o.rho * G
        z = self._solve_qp(G, delta if p.is_plus else delta - w)
        return z[:, p.n_x + p.n_lam : p.n_x + p.n_lam + p.n_u]

    def _timed_solve(self, prog, options):
        start = process_time()
        result = self.osqp.Solve(prog, None, options)
        self.solver_sec += process_time() - start
        return result

    def _solve_qp(self, G, target):
        p = self.problem
        for cost in self.consensus:
            self.prog.RemoveCost(cost)
        self.consensus = []
        parts: list[slice] = [slice(0, p.n_z)]
        if p.is_plus:
            i_eta = p.n_z - p.n_lam
            parts = [slice(p.n_x, p.n_x + p.n_lam), slice(i_eta, p.n_z)]
        for z, t in zip(self.z, target, strict=True):
            for i in parts:
                H, b = 2.0 * G[i, i], -2.0 * G[i, i] @ t[i]
                self.consensus.append(
                    self.prog.AddQuadraticCost(H, b, z[i], is_convex=True)
                )
        result = self._timed_solve(self.prog, self.qp_options)
        if not result.is_success():
            raise RuntimeError(f"OSQP: {result.get_solution_result()}")
        return np.array([result.GetSolution(z) for z in self.z])

    def _project(self, z):
        p, lcs = self.problem, self.lcs
        i_lam, i_u = slice(p.n_x, p.n_x + p.n_lam), p.n_x + p.n_lam
        if p.is_plus:
            delta, i_eta = z.copy(), slice(i_u + p.n_u, p.n_z)
            lam, eta = z[i_lam], z[i_eta]
            open_gap = np.sqrt(p.U[i_eta]) * eta > np.sqrt(p.U[i_lam]) * lam
            delta[i_lam] = np.where(open_gap, 0.0, np.maximum(lam, 0.0))
            delta[i_eta] = np.where(open_gap, np.maximum(eta, 0.0), 0.0)
            return delta
        assert isinstance(p.projection, QpProjection)
        alpha, infinity = p.projection.alpha, np.full(p.n_lam, np.inf)
        prog = MathematicalProgram()
        v = prog.NewContinuousVariables(p.n_z)
        prog.AddLinearConstraint(
            np.hstack([lcs.E, lcs.F, lcs.H]) / self.scaling,
            -lcs.c / self.scaling,
            infinity,
            v,
        )
        prog.AddLinearConstraint(np.eye(p.n_lam), np.zeros(p.n_lam), infinity, v[i_lam])
        V = np.diag(p.U)
        V[i_lam, i_lam] = alpha * lcs.F
        prog.AddQuadraticCost(V, -V @ z, v, is_convex=True)
        prog.AddQuadraticCost(
            (1.0 - alpha) * lcs.F, np.zeros(p.n_lam), v[i_lam], is_convex=True
        )
        result = self._timed_solve(prog, self.projection_options)
        return result.GetSolution(v)


def load(name: str) -> dict:
    """A file of tests/reference; FileNotFoundError where there is no checkout."""
    path = REFERENCE / name
    if not path.exists():
        raise FileNotFoundError(
            f"{path} is missing: this bench needs a checkout with tests/reference"
        )
    return dict(np.load(path))


def ball(plus: bool, N: int):
    """LCS, x0, x_desired and problem of the ball on the table (19 x, 16 lam, 3 u)."""
    data = load("ball_mpc_problem.npz")
    lcs = LCS(**{k: data[k] for k in "ABDdEFHc"}, dt=float(data["dt"]))
    Q, R, G, U = (data[("plus_" if plus else "qp_") + k] for k in "QRGU")
    options = C3Options(N=N, rounds=3, rho=BALL_RHO, scale_lam=True)
    projection = PlusProjection() if plus else QpProjection()
    problem = C3Problem(C3Weights(Q, R, G, U), projection, options)
    return lcs, data["x0"], np.tile(data["xdes"], (N + 1, 1)), problem


def cartpole(plus: bool, N: int):
    """LCS, x0, x_desired and problem of the soft-wall cart-pole (4 x, 2 lam, 1 u)."""
    data = load("c3_cartpole.npz")
    lcs = LCS(**{k: data[k] for k in "ABDdEFHc"}, dt=float(data["dt"]))
    kind = "plus" if plus else "c3"
    weights = C3Weights(
        data["Q"], data["R"], data["G_" + kind], data["U_" + kind], data["QN"]
    )
    options = C3Options(N=N, rounds=10, rho=CARTPOLE_RHO)
    projection = PlusProjection() if plus else QpProjection()
    problem = C3Problem(weights, projection, options)
    return lcs, data["x0"], np.tile(data["xdes"], (N + 1, 1)), problem


@contextmanager
def quiet():
    """Discards output of compiled code, as OSQP reports its polishing."""
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def interleaved_ms(calls, n):
    """Median process CPU time of each call [ms], taken in turns, without the first."""
    times = np.empty((n + 1, len(calls)))
    for row in times:
        for j, call in enumerate(calls):
            start = process_time()
            call()
            row[j] = process_time() - start
    return 1e3 * np.median(times[1:], axis=0)


def measure(name: str, make, plus: bool, N: int, repeats: int) -> dict:
    """One row: our time and cost, the re-creation's, and their ratios."""
    lcs, x0, x_desired, problem = make(plus, N)
    osqp = OsqpC3(lcs, problem)
    ours = partial(solve_c3, lcs, x0, x_desired, problem)
    solver_ms = []

    def theirs():
        before = osqp.solver_sec
        u = osqp.solve(x0, x_desired)
        solver_ms.append(1e3 * (osqp.solver_sec - before))
        return u

    with quiet():
        ms, whole_ms = interleaved_ms([ours, theirs], repeats)
        osqp_ms = float(np.median(solver_ms[1:]))
        inputs = ours()[0].u, theirs()
    cost, osqp_cost = (plan_cost(lcs, x0, u, x_desired, problem) for u in inputs)
    return {
        "what": f"{'C3+' if plus else 'C3'}, {name}, N {N}, "
        f"{problem.options.rounds} rounds",
        "value": ms,
        "unit": "ms",
        "osqp_ms": osqp_ms,
        "python_share": 1.0 - osqp_ms / whole_ms,
        "speed_ratio": osqp_ms / ms,
        "cost_ratio": cost / osqp_cost,
        "cost": cost,
    }


def rows(horizons: Sequence[int] = (5, 10, 20, 40, 80), repeats: int = 41):
    """The rows of `makebreak bench c3`; the last ones give the growth with N."""
    found = []
    for plus in (True, False):
        times = []
        for N in horizons:
            few = max(3, repeats * 5 // N // 2)  # OSQP takes long at a large N.
            row = measure("ball 19/16/3", ball, plus, N, few)
            if plus and N <= 10:
                row["met"] = row["speed_ratio"] >= 12.0 and row["cost_ratio"] <= 1.01
            times.append(row["value"])
            found.append(row)
        if len(horizons) > 1:
            # The exponent of time ~ N^e over the upper half of the horizons.
            first, last = len(horizons) // 2, -1
            e = np.log(times[last] / times[first]) / np.log(
                horizons[last] / horizons[first]
            )
            found.append(
                {
                    "what": f"{'C3+' if plus else 'C3'}, ball, time ~ N^e, N "
                    f"{horizons[first]} to {horizons[last]}: e",
                    "value": float(e),
                    "unit": "-",
                    "met": bool(e < 1.2),
                }
            )
        if plus and {10, 80} <= set(horizons):
            per_knot = dict(zip(horizons, times, strict=True))
            ratio = per_knot[80] / 80.0 / (per_knot[10] / 10.0)
            found.append(
                {
                    "what": "C3+, ball, time per knot, N 80 over N 10",
                    "value": ratio,
                    "unit": "-",
                    "met": bool(ratio <= 1.3),
                }
            )
        found += [
            measure("cart-pole 4/2/1", cartpole, plus, N, repeats // 2) for N in (5, 10)
        ]
    return found + combinations(repeats) + variants(repeats)


def combinations(repeats: int):
    """Both solvers with both contact models on the ball at N = 10, eps_c 5e-4.

    The cost is always that of the inputs rolled out with exact Stewart-Trinkle contact
    forces, as its contacts do not open while they slide.
    """
    found: list[dict] = []
    real = ball_lcs(4, StewartTrinkle())
    for plus in (True, False):
        _, x0, x_desired, p = ball(plus, 10)
        for name, law in (("Anitescu", Anitescu()), ("S.-T.", StewartTrinkle())):
            lcs = ball_lcs(4, law)
            # The file's weights are for 16 forces, and equal.
            weights = C3Weights(p.Q, p.R, _widened(p.G, lcs), _widened(p.U, lcs))
            problem = C3Problem(weights, p.projection, p.options)
            what = f"{'C3+' if plus else 'C3'}, ball, N 10, {name}, n_lam {lcs.n_lam}"
            as_real = C3Problem(
                C3Weights(p.Q, p.R, _widened(p.G, real), _widened(p.U, real)),
                p.projection,
                p.options,
            )
            try:
                u = solve_c3(lcs, x0, x_desired, problem)[0].u
                cost = plan_cost(real, x0, u, x_desired, as_real)
            except (C3Failure, ValueError) as error:
                # Not convex (docs/c3.md), or not to be rolled out.
                found.append({"what": what, "value": None, "failure": str(error)})
                continue
            ms = median_call_ms(partial(solve_c3, lcs, x0, x_desired, problem), repeats)
            found.append(
                {
                    "what": what,
                    "value": ms,
                    "unit": "ms",
                    "cost": cost,
                }
            )
    return found


def _widened(weight, lcs: LCS):
    """G or U of the ball problem for the number of forces of lcs."""
    parts = [weight[:19], np.full(lcs.n_lam, weight[19]), weight[35:38]]
    if weight.size > 38:
        parts.append(np.full(lcs.n_lam, weight[38]))
    return np.concatenate(parts)


def bounded(N: int, repeats: int, polish=()):
    """C3+ of the ball with inputs, velocities and both bounded, and polished."""
    lcs, x0, x_desired, plain = ball(True, N)
    weights = C3Weights(plain.Q, plain.R, plain.G, plain.U)
    free, _ = solve_c3(lcs, x0, x_desired, plain)
    # Bounds that the free plan violates: half of its largest input and velocity.
    u_max = np.full(3, 0.5 * abs(free.u).max())
    x_max = np.full(19, np.inf)
    x_max[10:13] = 0.5 * abs(free.x[1:, 10:13]).max()
    cases = [
        ("unbounded", C3Bounds(), 0),
        ("inputs bounded", C3Bounds(-u_max, u_max), 0),
        ("finger's velocity bounded", C3Bounds(None, None, -x_max, x_max), 0),
        ("both bounded", C3Bounds(-u_max, u_max, -x_max, x_max), 0),
    ]
    cases += [(f"polish {n}", C3Bounds(), n) for n in polish]
    problems = [
        C3Problem(weights, plain.projection, replace(plain.options, polish=n), bounds)
        for _, bounds, n in cases
    ]
    # In turns, so that other load on the machine affects all of them.
    calls = [partial(solve_c3, lcs, x0, x_desired, problem) for problem in problems]
    times = interleaved_ms(calls, repeats)
    found: list[dict] = []
    for (name, _, rollouts), problem, ms in zip(cases, problems, times, strict=True):
        plan, _ = solve_c3(lcs, x0, x_desired, problem)
        cost = plan_cost(lcs, x0, plan.u, x_desired, problem)
        row = {"what": f"C3+, ball, N {N}, {name}", "value": float(ms), "unit": "ms"}
        row["cost"] = cost
        if found:
            row["over_unbounded"] = float(ms / times[0])
        if "bounded" in name and found:
            row["met"] = bool(ms <= 3.0 * times[0])
        if rollouts:
            row["met"] = cost <= found[0]["cost"]
        found.append(row)
    return found


def variants(repeats: int):
    """C3+ of the ball at N = 5 bounded, polished, and with 8 to 64 contact forces; and
    the exact projection."""
    found = bounded(5, repeats, polish=(1, 3)) + bounded(40, repeats)
    lcs, x0, x_desired, plain = ball(True, 5)
    for n_f in (2, 4, 8, 16):
        lcs = ball_lcs(n_f)
        n = lcs.n_lam
        G, U = (
            np.r_[w[:19], np.full(n, w[19]), w[35:38], np.full(n, w[38])]
            for w in (plain.G, plain.U)
        )
        problem = C3Problem(
            C3Weights(plain.Q, plain.R, G, U), plain.projection, plain.options
        )
        ms = median_call_ms(partial(solve_c3, lcs, x0, x_desired, problem), repeats)
        found.append({"what": f"C3+, ball, N 5, n_lam {n}", "value": ms, "unit": "ms"})
        if n > 32:
            continue
        nodes = ExactProjection().nodes_max
        E, F, H, c = (np.array(a, order="C") for a in (lcs.E, lcs.F, lcs.H, lcs.c))
        U = np.r_[U[:19], U[19 : 19 + n], U[19 + n : 22 + n]]
        rng = np.random.default_rng(0)
        z = np.hstack(
            [x0 + 0.05 * rng.normal(size=(60, 19)), rng.normal(size=(60, n + 3))]
        )
        times = [
            median_call_ms(
                partial(project_exact, zk, U, E, F, H, c, nodes, np.empty((1, n + 22))),
                3,
            )
            for zk in z[:, None]
        ]
        what = f"exact projection, ball, n_lam {n}, eps_c 5e-4, a knot"
        found.append({"what": what, "value": float(np.median(times)), "unit": "ms"})
    return found


def ball_lcs(n_f: int, law: Anitescu | StewartTrinkle | None = None) -> LCS:
    """The ball problem with 2 n_f friction edges and the builder's own eps_c."""
    law = Anitescu() if law is None else law
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    Parser(plant).AddModels(str(REFERENCE / "ball_on_table.sdf"))
    plant.Finalize()
    pairs = [
        ContactPair("finger_link", "ball_link", 0.5, n_f, contact_model=law),
        ContactPair("ball_link", "table_link", 0.5, n_f, contact_model=law),
    ]
    data = load("ball_mpc_problem.npz")
    model = AnitescuLcs(builder.Build(), pairs, float(data["dt"]))
    return model.build(data["x0"], np.zeros(3))


if __name__ == "__main__":
    for row in rows():
        print(*(f"{v:.4g}" if isinstance(v, float) else v for v in row.values()))
