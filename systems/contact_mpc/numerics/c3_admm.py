"""The ADMM rounds of C3 and C3+: one QP and one projection after the other.

c3_mpc.py says what they solve; c3_qp.py and c3_bounds.py solve the QP, and
c3_projections.py projects.
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.c3_active_set import CANNOT_BE_MET, MET
from makebreak.systems.contact_mpc.numerics.c3_bounds import solve_bounded, within
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    FAILED,
    project,
    project_plus,
)
from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve
from makebreak.systems.contact_mpc.numerics.lcp import SOLVED

# What qp_step returns beside SOLVED.
NOT_CONVEX, INFEASIBLE, NUMERICS = 1, 2, 3
FAILURES = {
    NOT_CONVEX: "the QP is not strictly convex, or its numbers are not finite",
    INFEASIBLE: "no plan meets the bounds",
    NUMERICS: "numerics: rounding leaves open whether a plan meets the bounds (are "
    "weights, or units, far apart?)",
}


class C3Failure(RuntimeError):
    """A solve that has no result, with the reason: bounds, an LCP, an indefinite QP."""


def compiled_once(a):
    """a, read-only: to the compiler what may be written is another type, for which it
    would compile everything once more."""
    a = a.view()
    a.setflags(write=False)
    return a


def admm(model, weights, bounds, given, delta, w, options, lcp):
    """The rounds of C3, and the last QP: x, v, delta, w, every QP's u, and how many
    projections were cut short.

    Args: model, weights, bounds as of qp_step; given: h, x0, lam0 of it; lcp: what
        `project` needs beside z and delta.
    Raises: C3Failure.
    """
    (Q, R, Q_N, G), (h, x0, lam0) = weights, given
    (N, n_z), n_lam = delta.shape, model[2].shape[1]
    sides = np.zeros((N + 1, n_lam + len(R) + len(Q_N)), np.int64)

    def one_qp(G, target):
        x, v = np.empty((N + 1, len(Q_N))), np.empty((N, n_lam + len(R)))
        z = np.empty((N, n_z))
        status = qp_step(
            model, (Q, R, Q_N, G), bounds, (h, target, x0, lam0), (z, x, v, sides)
        )
        if status != SOLVED:
            raise C3Failure(FAILURES[status])
        return z, x, v

    projection, U, arrays, matrices = lcp
    K, inputs, cut = len(matrices), np.empty((options.rounds + 1, N, len(R))), 0
    for r in range(options.rounds):
        z, _, v = one_qp(G, delta - w)
        inputs[r] = v[:, n_lam:]
        delta = np.empty((N, n_z))
        for k in range(K):
            knots = slice(None) if K == 1 else slice(k, k + 1)
            arrays_k = tuple(a[k] for a in arrays)
            goal = (z + w)[knots]
            got = project(projection, goal, U, arrays_k, matrices[k], delta[knots])
            if got == FAILED:
                raise C3Failure("the projection has no solution")
            cut += got
        w = (w + z - delta) / options.rho
        G = compiled_once(options.rho * G)
    _, x, v = one_qp(G, delta - w)
    inputs[-1] = v[:, n_lam:]
    return x, v, delta, w, inputs, cut


@njit(cache=True)
def scaled_model(A, B, D, d, E, F, H, c, scale):
    """The LCS in lam / scale: the model of qp_step; E, F, H; whether H is not zero.

    All arrays have the knots first: one for all, or N.
    """
    K, n_x, n_lam = D.shape
    n_v = n_lam + B.shape[2]
    AB, C = np.empty((K, n_x, n_v + n_x)), np.empty((K, n_lam, n_v + n_x))
    E, F, H = E / scale, F.copy(), H / scale
    for k in range(K):  # Loops compile far faster than slices that are assigned.
        for j in range(n_v + n_x):
            for i in range(n_x):
                if j < n_lam:
                    AB[k, i, j] = D[k, i, j] * scale
                else:
                    AB[k, i, j] = B[k, i, j - n_lam] if j < n_v else A[k, i, j - n_v]
            for i in range(n_lam):
                if j < n_lam:
                    C[k, i, j] = F[k, i, j]
                else:
                    C[k, i, j] = H[k, i, j - n_lam] if j < n_v else E[k, i, j - n_v]
    pushes = False
    for number in H[0].flat:
        pushes |= number != 0.0
    return (AB, d.copy(), C, c / scale), E, F, H, pushes


@njit(cache=True)
def admm_plus(AB, d, C, c, Q, R, Q_N, G, bounds, U, h, x0, lam0, delta, w, rounds, rho):
    """The same for C3+, compiled as a whole; the first result is qp_step's status."""
    (N, n_z), n_lam = delta.shape, C.shape[1]
    model = AB, d, C, c
    x, v = np.empty((N + 1, len(Q_N))), np.empty((N, n_lam + len(R)))
    z, sides = np.empty((N, n_z)), np.zeros((N + 1, AB.shape[2]), np.int64)
    inputs = np.zeros((rounds + 1, N, len(R)))
    for r in range(rounds + 1):
        target = delta - w if r < rounds else delta
        status = qp_step(
            model, (Q, R, Q_N, G), bounds, (h, target, x0, lam0), (z, x, v, sides)
        )
        if r == rounds or status != SOLVED:
            break
        inputs[r] = v[:, n_lam:]
        delta = np.empty((N, n_z))
        project_plus(z + w, U, len(Q_N), n_lam, delta)
        w = (w + z - delta) / rho
        G = rho * G
    inputs[r] = v[:, n_lam:]
    return status, x, v, delta, w, inputs


@njit(cache=True)
def qp_step(model, weights, bounds, given, found):
    """One QP of C3; fills found and returns SOLVED, or a key of FAILURES.

    Args:
        model: AB = [D B A], d, C = [F H E], c, each (K, ...) with K = 1 or N.
        weights: Q (1 or N, n_x, n_x), R, Q_N and the diagonal G.
        bounds: lower, upper over [lam, u, x]; None where there are none. (That is
            another type, for which the methods with bounds are not compiled.)
        given: h (N + 1, n) the linear term of the planning cost over [lam, u, x],
            target (N, n_z) of the consensus, x0, lam0 (empty: free).
        found: z (N, n_z), x (N + 1, n_x), v = [lam, u] (N, n_v), overwritten; sides,
            the active bounds, from the last round to the next (solve_bounded).
    """
    AB, d, C, c = model
    Q, R, Q_N, G = weights
    h_plan, target, x0, lam0 = given
    z, x, v, sides = found
    K, n_x, n = AB.shape
    n_lam, n_v, n_z, N = C.shape[1], n - n_x, G.size, v.shape[0]
    i_eta, plus = n, n_z > n
    # Stage cost and linear term: the planning cost, and |z - target|^2_G with
    # eta = C [v, x] + c put in.
    K_T = max(K, len(Q))
    T, h = np.zeros((K_T, n, n)), h_plan.copy()
    for k in range(K_T):
        for i in range(n_lam, n_v):
            for j in range(n_lam, n_v):
                T[k, i, j] = R[i - n_lam, j - n_lam]
        for i in range(n_v, n):
            for j in range(n_v, n):
                T[k, i, j] = Q[k % len(Q), i - n_v, j - n_v]
    for i in range(n):
        at = n_x + i if i < n_v else i - n_v  # Of [v, x] in z = [x, v, eta].
        for k in range(K_T):
            T[k, i, i] += G[at]
        for k in range(N):
            h[k, i] += G[at] * target[k, at]
    if plus:
        for k in range(K_T):
            for m in range(n_lam):
                for i in range(n):
                    a = C[k % K, m, i] * G[i_eta + m]
                    if a != 0.0:
                        for j in range(n):
                            T[k, i, j] += a * C[k % K, m, j]
        for k in range(N):
            for m in range(n_lam):
                a = G[i_eta + m] * (target[k, i_eta + m] - c[k % K, m])
                for i in range(n):
                    h[k, i] += a * C[k % K, m, i]
    fac = new_factor(AB, d, N)
    if not factor(fac, T, Q_N, np.zeros((0, 0)), lam0.size):
        return NOT_CONVEX
    solve(fac, h, x0, lam0, x, v)
    if bounds is not None:
        lower, upper = bounds
        if not within(x, v[:, n_lam:], lower[n_lam:], upper[n_lam:]):
            # No contact may pull more than it does without bounds.
            lower = lower.copy()
            for i in range(n_lam):
                for k in range(N):
                    lower[i] = min(lower[i], v[k, i])
            status = solve_bounded(fac, T, Q_N, h, x0, lam0, lower, upper, sides, x, v)
            if status != MET:  # Bounds of inputs alone can always be met.
                free = np.isinf(lower[n_v:]).all() and np.isinf(upper[n_v:]).all()
                is_sure = status == CANNOT_BE_MET and not free
                return INFEASIBLE if is_sure else NUMERICS
    for k in range(N):
        for i in range(n_x):
            z[k, i] = x[k, i]
        for i in range(n_v):
            z[k, n_x + i] = v[k, i]
        if plus:
            for m in range(n_lam):
                total = c[k % K, m]
                for i in range(n_v):
                    total += C[k % K, m, i] * v[k, i]
                for i in range(n_x):
                    total += C[k % K, m, n_v + i] * x[k, i]
                z[k, i_eta + m] = total
    if not (np.isfinite(x).all() and np.isfinite(v).all()):
        return NOT_CONVEX
    return SOLVED
