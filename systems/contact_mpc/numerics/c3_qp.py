"""The QP of C3: a linear-quadratic optimal control problem over N knots.

    minimise   sum_k  1/2 y_k' T_k y_k - h_k' y_k,   y_k = [v_k, x_k],  v = [lam, u]
    subject to x_(k+1) = A_k x_k + B_k v_k + d_k,  x_0 given,  lam_0 given or free

A, B, d and T come once for all knots, or once per knot: K = 1 or N of them.

Contact forces and inputs are one stage input v, so the QP is a Riccati recursion: its
cost grows linearly with N. `factor` depends on the weights alone; one factorisation
serves any number of right-hand sides h. c3_bounds.py adds bounds on u and x.

Everything here is compiled and works on contiguous float64 arrays; the loops are our
own rather than BLAS calls, so that a solve repeats bit for bit whatever the threads.

Source: Rawlings, Mayne, Diehl, "Model Predictive Control", section 8.8 (Riccati).
"""

from typing import NamedTuple

import numpy as np
from numba import njit


class Factor(NamedTuple):
    """The factorised QP: what `solve` needs beside the right-hand side."""

    AB: np.ndarray  # (K, n_x, n) = [B A], n = n_v + n_x
    d: np.ndarray  # (K, n_x)
    S: np.ndarray  # (N, n_v, n) rows [U, Y]: U'U = T_vv + B'PB, Y = U^-T (T_vx + B'PA)
    P: np.ndarray  # (N + 1, n_x, n_x) cost to go 1/2 x'P x + p'x
    Pd: np.ndarray  # (N, n_x) = P_(k+1) d


@njit(cache=True)
def new_factor(AB, d, N):
    """An empty Factor for the dynamics x_next = [B A] [v, x] + d over N knots."""
    _, n_x, n = AB.shape
    n_v = n - n_x
    return Factor(
        AB,
        d,
        np.empty((N, n_v, n)),
        np.empty((N + 1, n_x, n_x)),
        np.empty((N, n_x)),
    )


@njit(cache=True)
def factor(fac, costs, T_N, diagonal, n_fixed):
    """Fills fac for the stage costs T; returns False if the QP is not strictly convex.

    Args:
        fac: Factor, its AB and d already set; the rest is overwritten.
        costs: (K, n, n) symmetric stage cost T over [v, x], K = 1 or N too.
        T_N: (n_x, n_x) symmetric cost of x_N.
        diagonal: (N + 1, n) added to the diagonals of T, knot by knot (of T_N in the
            last row, entries n_v and on); (0, 0) adds nothing.
        n_fixed: leading entries of v_0 that are given (n_lam or 0).
    """
    models, offsets, S, P, Pd = fac
    K, n_x, n = models.shape
    n_v = n - n_x
    N = S.shape[0]
    barrier = diagonal.shape[0] > 0
    Zt, Z, W = np.empty((n, n_x)), np.empty((n_x, n)), np.empty((n, n))
    P[N] = T_N
    if barrier:
        for i in range(n_x):
            P[N, i, i] += diagonal[N, n_v + i]
    for k in range(N - 1, -1, -1):
        P_next, AB, T = P[k + 1], models[k % K], costs[k % len(costs)]
        d = offsets[k % len(offsets)]
        for i in range(n_x):
            total = 0.0
            for j in range(n_x):
                total += P_next[i, j] * d[j]
            Pd[k, i] = total
        # Upper half of W = T + AB' P AB; AB is sparse as a rule, so zeros are skipped.
        Zt[:] = 0.0
        for m in range(n_x):
            for i in range(n):
                a = AB[m, i]
                if a != 0.0:
                    for j in range(n_x):
                        Zt[i, j] += a * P_next[m, j]
        for i in range(n):
            for j in range(n_x):
                Z[j, i] = Zt[i, j]
        for i in range(n):
            for j in range(i, n):
                W[i, j] = T[i, j]
        if barrier:
            for i in range(n):
                W[i, i] += diagonal[k, i]
        for m in range(n_x):
            for i in range(n):
                a = AB[m, i]
                if a != 0.0:
                    for j in range(i, n):
                        W[i, j] += a * Z[m, j]
        # Cholesky over v leaves the Schur complement of x, which is P_k.
        if not _eliminate(W, T, n_fixed if k == 0 else 0, n_v):
            return False
        for i in range(n_v):
            for j in range(i, n):
                S[k, i, j] = W[i, j]
        for i in range(n_x):
            for j in range(i, n_x):
                P[k, i, j] = W[n_v + i, n_v + j]
                P[k, j, i] = P[k, i, j]
    return True


@njit(cache=True)
def _eliminate(W, T, start, end):
    """Cholesky's steps of the pivots start to end - 1 on the upper half of W (n, n), in
    place; False if W is not positive definite there, by the size of T (n, n).

    Four pivots at a time, so that the rows below are read and written once for four.
    """
    n, j = W.shape[0], start
    while j < end:
        n_block = min(4, end - j)
        for i in range(j, j + n_block):
            for b in range(j, i):
                a = W[b, i]
                for m in range(i, n):
                    W[i, m] -= a * W[b, m]
            pivot = W[i, i]
            if not pivot > 1e-13 * abs(T[i, i]):
                return False
            inverse = 1.0 / np.sqrt(pivot)
            for m in range(i, n):
                W[i, m] *= inverse
        for i in range(j + n_block, n):
            if n_block == 4:
                a0, a1, a2, a3 = W[j, i], W[j + 1, i], W[j + 2, i], W[j + 3, i]
                for m in range(i, n):
                    less = W[i, m] - a0 * W[j, m] - a1 * W[j + 1, m]
                    W[i, m] = less - a2 * W[j + 2, m] - a3 * W[j + 3, m]
            else:
                for b in range(j, j + n_block):
                    a = W[b, i]
                    for m in range(i, n):
                        W[i, m] -= a * W[b, m]
        j += n_block
    return True


@njit(cache=True)
def solve(fac, h, x0, v0_fixed, x, v):
    """The minimiser for the linear term h, with the fixed head of v_0 given.

    Args:
        fac: Factor, filled by `factor` with n_fixed = v0_fixed.size.
        h: (N + 1, n) linear term, [v, x] per knot; row N holds x only.
        x0: (n_x,). v0_fixed: (n_fixed,).
        x, v: (N + 1, n_x), (N, n_v), overwritten by the minimiser.
    """
    models, offsets, S, P, Pd = fac
    K, n_x, n = models.shape
    n_v = n - n_x
    N = S.shape[0]
    n_fixed = v0_fixed.size
    b, p, g, ell = np.empty(n_x), np.empty(n_x), np.empty(n), np.empty((N, n_v))
    for i in range(n_x):
        p[i] = -h[N, n_v + i]
    for k in range(N - 1, -1, -1):
        AB = models[k % K]
        for i in range(n_x):
            b[i] = Pd[k, i] + p[i]
        for i in range(n):
            g[i] = -h[k, i]
        for m in range(n_x):
            for i in range(n):
                g[i] += b[m] * AB[m, i]
        start = 0
        if k == 0:
            start = n_fixed
            for j in range(n_fixed):
                for i in range(n_fixed, n_v):
                    g[i] += S[0, j, i] * v0_fixed[j]
        # One forward substitution gives ell = U^-T g_v and leaves p = g_x - Y' ell.
        for j in range(start, n_v):
            ell[k, j] = g[j] / S[k, j, j]
            for i in range(j + 1, n):
                g[i] -= S[k, j, i] * ell[k, j]
        for i in range(n_x):
            p[i] = g[n_v + i]
    x[0] = x0
    for k in range(N):
        AB, d = models[k % K], offsets[k % len(offsets)]
        start = 0
        if k == 0:
            start = n_fixed
            for j in range(n_fixed):
                v[0, j] = v0_fixed[j]
        for j in range(n_v - 1, start - 1, -1):
            total = ell[k, j]
            for i in range(n_x):
                total += S[k, j, n_v + i] * x[k, i]
            for i in range(j + 1, n_v):
                total += S[k, j, i] * v[k, i]
            v[k, j] = -total / S[k, j, j]
        for m in range(n_x):
            total = d[m]
            for i in range(n_v):
                total += AB[m, i] * v[k, i]
            for i in range(n_x):
                total += AB[m, n_v + i] * x[k, i]
            x[k + 1, m] = total
