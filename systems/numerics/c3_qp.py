"""The QP of C3: a linear-quadratic optimal control problem over N knots.

    minimise   sum_k  1/2 y_k' T y_k - h_k' y_k,   y_k = [v_k, x_k],  v = [lam, u]
    subject to x_(k+1) = A x_k + B v_k + d,  x_0 given,  lam_0 given or free,
               lower <= [u_k, x_k] <= upper

Contact forces and inputs are one stage input v, so the QP is a Riccati recursion: its
cost grows linearly with N. `factor` depends on the weights alone; one factorisation
serves any number of right-hand sides h. Bounds are met by a primal-dual interior point
method whose Newton steps are the same recursion with a larger diagonal.

Everything here is compiled and works on contiguous float64 arrays; the loops are our
own rather than BLAS calls, so that a solve repeats bit for bit whatever the threads.

Source: Rawlings, Mayne, Diehl, "Model Predictive Control", section 8.8 (Riccati);
Nocedal, Wright, "Numerical Optimization", algorithm 16.4 (predictor-corrector).
"""

from typing import NamedTuple

import numpy as np
from numba import njit

# An interior point solve ends when its complementarity and its residuals are this
# small relative to where it started ...
IPM_TOLERANCE = 1e-13
# ... and has failed (as a rule: the bounds cannot be met) after so many steps.
IPM_STEPS = 60


class Factor(NamedTuple):
    """The factorised QP: what `solve` needs beside the right-hand side."""

    AB: np.ndarray  # (n_x, n) = [B A], n = n_v + n_x
    d: np.ndarray  # (n_x,)
    S: np.ndarray  # (N, n_v, n) rows [U, Y]: U'U = T_vv + B'PB, Y = U^-T (T_vx + B'PA)
    P: np.ndarray  # (N + 1, n_x, n_x) cost to go 1/2 x'P x + p'x
    Pd: np.ndarray  # (N, n_x) = P_(k+1) d


@njit(cache=True)
def new_factor(AB, d, N):
    """An empty Factor for the dynamics x_next = [B A] [v, x] + d over N knots."""
    n_x, n = AB.shape
    n_v = n - n_x
    return Factor(
        AB,
        d,
        np.empty((N, n_v, n)),
        np.empty((N + 1, n_x, n_x)),
        np.empty((N, n_x)),
    )


@njit(cache=True)
def factor(fac, T, T_N, diagonal, n_fixed):
    """Fills fac for the stage cost T; returns False if the QP is not strictly convex.

    Args:
        fac: Factor, its AB and d already set; the rest is overwritten.
        T: (n, n) symmetric stage cost over [v, x].
        T_N: (n_x, n_x) symmetric cost of x_N.
        diagonal: (N + 1, n) added to the diagonals of T, knot by knot (of T_N in the
            last row, entries n_v and on); (0, 0) adds nothing.
        n_fixed: leading entries of v_0 that are given (n_lam or 0).
    """
    AB, d, S, P, Pd = fac
    n_x, n = AB.shape
    n_v = n - n_x
    N = S.shape[0]
    barrier = diagonal.shape[0] > 0
    Zt, Z, W = np.empty((n, n_x)), np.empty((n_x, n)), np.empty((n, n))
    P[N] = T_N
    if barrier:
        for i in range(n_x):
            P[N, i, i] += diagonal[N, n_v + i]
    for k in range(N - 1, -1, -1):
        P_next = P[k + 1]
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
        start = n_fixed if k == 0 else 0
        for j in range(start, n_v):
            pivot = W[j, j]
            if not pivot > 1e-13 * abs(T[j, j]):
                return False
            inverse = 1.0 / np.sqrt(pivot)
            for i in range(j, n):
                W[j, i] *= inverse
            for i in range(j + 1, n):
                a = W[j, i]
                for m in range(i, n):
                    W[i, m] -= a * W[j, m]
        for i in range(n_v):
            for j in range(i, n):
                S[k, i, j] = W[i, j]
        for i in range(n_x):
            for j in range(i, n_x):
                P[k, i, j] = W[n_v + i, n_v + j]
                P[k, j, i] = P[k, i, j]
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
    AB, d, S, P, Pd = fac
    n_x, n = AB.shape
    n_v = n - n_x
    N = S.shape[0]
    n_fixed = v0_fixed.size
    b, p, g, ell = np.empty(n_x), np.empty(n_x), np.empty(n), np.empty((N, n_v))
    for i in range(n_x):
        p[i] = -h[N, n_v + i]
    for k in range(N - 1, -1, -1):
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


@njit(cache=True)
def within(x, v, lower, upper):
    """Whether u and x of all knots but x_0 obey lower and upper ((n,), over [v, x])."""
    n_v = v.shape[1]
    for k in range(v.shape[0]):
        for i in range(n_v):
            if not lower[i] <= v[k, i] <= upper[i]:
                return False
        for i in range(x.shape[1]):
            if not lower[n_v + i] <= x[k + 1, i] <= upper[n_v + i]:
                return False
    return True


@njit(cache=True)
def solve_bounded(fac, T, T_N, h, x0, v0_fixed, lower, upper, x, v):
    """The minimiser within bounds; x and v hold the unbounded one and are overwritten.

    Args: as of `factor` and `solve`; lower, upper: (n,) over [v, x], infinite where
        there is no bound, lower < upper. x_0 and the fixed head of v_0 have no bounds.
    Returns: whether it converged. If not, as a rule no plan meets the bounds.
    """
    N, n_v = v.shape
    n_x = x.shape[1]
    n = n_v + n_x
    # Row k holds [v_k, x_k]; x_0 is given, and v_N does not exist. A step dy obeys the
    # dynamics with d = 0 and x_0 = 0; solving for dy rather than for y keeps the
    # large barrier terms from cancelling.
    step = new_factor(fac.AB, np.zeros(n_x), N)
    dx, dv, zero_x, zero_v = x.copy(), v.copy(), np.zeros(n_x), 0.0 * v0_fixed
    y, dy = np.zeros((N + 1, n)), np.zeros((N + 1, n))
    s, z = np.ones((2, N + 1, n)), np.zeros((2, N + 1, n))
    ds, dz = np.zeros((2, N + 1, n)), np.zeros((2, N + 1, n))
    gap = np.zeros((2, N + 1, n))
    active = np.zeros((2, N + 1, n), np.bool_)
    _pack(x, v, y)
    count, mu = 0, 0.0
    for side in range(2):
        for k in range(N + 1):
            for i in range(n):
                bound = lower[i] if side == 0 else upper[i]
                exists = k > 0 if i >= n_v else (i >= v0_fixed.size or k > 0) and k < N
                if not (exists and np.isfinite(bound)):
                    continue
                active[side, k, i] = True
                breach = bound - y[k, i] if side == 0 else y[k, i] - bound
                width = upper[i] - lower[i]
                least = 0.1 * width if np.isfinite(width) else 0.1 * (1.0 + abs(bound))
                s[side, k, i] = max(abs(breach), least)
                # A multiplier of the size that undoes the breach.
                weight = T_N[i - n_v, i - n_v] if k == N else T[i, i]
                z[side, k, i] = max(weight, 1e-8) * max(breach, least)
                mu += s[side, k, i] * z[side, k, i]
                count += 1
    if count == 0:
        return True
    mu /= count
    mu_start, residual, careful = mu, 1.0, False
    diagonal, g, h_step = (
        np.zeros((N + 1, n)),
        np.empty((N + 1, n)),
        np.empty((N + 1, n)),
    )
    for _ in range(IPM_STEPS):
        for k in range(N + 1):
            for i in range(n):
                total = h[k, i]
                if k < N:
                    for j in range(n):
                        total -= T[i, j] * y[k, j]
                elif i >= n_v:
                    for j in range(n_x):
                        total -= T_N[i - n_v, j] * y[k, n_v + j]
                g[k, i] = total
                gap[0, k, i] = y[k, i] - lower[i]
                gap[1, k, i] = upper[i] - y[k, i]
                diagonal[k, i] = 0.0
                for side in range(2):
                    if active[side, k, i]:
                        diagonal[k, i] += z[side, k, i] / s[side, k, i]
        if not factor(step, T, T_N, diagonal, v0_fixed.size):
            break
        for predictor in (True, False):
            target = 0.3 * mu if careful else 0.0
            if not predictor and careful:
                break  # The one step has been found.
            if not predictor:
                # How far the predictor got says how much to centre.
                alpha = min(1.0, _step_length(s, z, ds, dz, active))
                mu_affine = 0.0
                for side in range(2):
                    for k in range(N + 1):
                        for i in range(n):
                            if active[side, k, i]:
                                mu_affine += (
                                    s[side, k, i] + alpha * ds[side, k, i]
                                ) * (z[side, k, i] + alpha * dz[side, k, i])
                target = mu * (mu_affine / count / mu) ** 3
            for k in range(N + 1):
                for i in range(n):
                    h_step[k, i] = g[k, i]
                    for side in range(2):
                        if not active[side, k, i]:
                            continue
                        if predictor:
                            ds[side, k, i] = 0.0  # No second-order term yet.
                        dz[side, k, i] = target - ds[side, k, i] * dz[side, k, i]
                        push = (
                            dz[side, k, i]
                            - z[side, k, i] * (gap[side, k, i] - s[side, k, i])
                        ) / s[side, k, i]
                        h_step[k, i] += push if side == 0 else -push
            solve(step, h_step, zero_x, zero_v, dx, dv)
            _pack(dx, dv, dy)
            for side in range(2):
                for k in range(N + 1):
                    for i in range(n):
                        if active[side, k, i]:
                            move = dy[k, i] if side == 0 else -dy[k, i]
                            s_new = gap[side, k, i] + move
                            ds[side, k, i] = s_new - s[side, k, i]
                            dz[side, k, i] = (
                                dz[side, k, i] - z[side, k, i] * s_new
                            ) / s[side, k, i]
        alpha = min(1.0, 0.995 * _step_length(s, z, ds, dz, active))
        if not alpha > 1e-8:
            break
        mu_last, mu = mu, 0.0
        for k in range(N + 1):
            for i in range(n):
                y[k, i] += alpha * dy[k, i]
                for side in range(2):
                    if active[side, k, i]:
                        s[side, k, i] += alpha * ds[side, k, i]
                        z[side, k, i] += alpha * dz[side, k, i]
                        mu += s[side, k, i] * z[side, k, i]
        mu /= count
        residual *= 1.0 - alpha
        # The second-order correction can cycle; a plain centred step does not.
        careful = mu > 0.7 * mu_last
        if not np.isfinite(mu):
            break
        if mu < IPM_TOLERANCE * mu_start and residual < IPM_TOLERANCE:
            for k in range(N):
                for i in range(n_v):
                    v[k, i] = min(max(y[k, i], lower[i]), upper[i])
                for i in range(n_x):
                    x[k + 1, i] = y[k + 1, n_v + i]
            return True
    return False


@njit(cache=True)
def _pack(x, v, y):
    n_v = v.shape[1]
    for k in range(v.shape[0]):
        y[k, :n_v] = v[k]
        y[k, n_v:] = x[k]
    y[v.shape[0], n_v:] = x[v.shape[0]]


@njit(cache=True)
def _step_length(s, z, ds, dz, active):
    """The longest step, at most 1/.995, that keeps s and z from becoming negative."""
    alpha = 1.0 / 0.995
    for side in range(2):
        for k in range(s.shape[1]):
            for i in range(s.shape[2]):
                if active[side, k, i]:
                    if ds[side, k, i] < 0.0:
                        alpha = min(alpha, -s[side, k, i] / ds[side, k, i])
                    if dz[side, k, i] < 0.0:
                        alpha = min(alpha, -z[side, k, i] / dz[side, k, i])
    return alpha
