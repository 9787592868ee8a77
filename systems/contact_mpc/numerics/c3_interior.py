"""Bounds on the QP of C3 by a primal-dual interior point method.

Its Newton steps are the recursion of c3_qp.py with a larger diagonal. c3_bounds.py says
when it is used.

Source: Nocedal, Wright, "Numerical Optimization", algorithm 16.4 (predictor-corrector);
steps that close breaches no faster than they lower the complementarity: Kojima,
Megiddo, Mizuno, Math. Programming 61 (1993).
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve

# An interior point solve ends when its duality gap, relative to what the bounds cost,
# and its residuals, relative to where it started, are this small; rounding may end it
# before, and then an iterate of the second, looser size is a solution ...
IPM_TOLERANCE, IPM_ACCEPTED = 1e-12, 1e-8
# ... and it has failed after so many steps.
IPM_STEPS = 160
# A step is short where a bound stops it before this share: the iterate is then far from
# the central path, and the next one mostly centres.
SHORT, CENTRING = 0.3, 0.95
# It starts with each bound's complementarity at so many times the free plan's cost:
# far from the bounds, whose multipliers may be millions of times what they start from
# where an object is light. Rounding may make the factorisation fail there: then nearer.
IPM_STARTS = (1e4, 1e2, 1.0)


@njit(cache=True)
def solve_interior(fac, T, T_N, h, v0_fixed, lower, upper, start, x, v):
    """solve_bounded by an interior point method; whatever the number of active bounds.

    Args: as of solve_bounded; start: complementarity of each bound at the start, in
        units of the cost of the states in x.
    Returns: whether it converged. If not, no plan meets the bounds, or rounding is why.
    """
    (N, n_v), K = v.shape, len(T)
    n_x = x.shape[1]
    n = n_v + n_x
    # A fixed value has no interior: it gets one, far below what a plan promises.
    fixed_lower, fixed_upper = lower, upper
    lower, upper = lower.copy(), upper.copy()
    for i in range(n):
        if upper[i] - lower[i] < 1e-8 * (1.0 + abs(lower[i])):
            lower[i] -= 1e-8 * (1.0 + abs(lower[i]))
            upper[i] += 1e-8 * (1.0 + abs(upper[i]))
    # Row k holds [v_k, x_k]; x_0 is given, and v_N does not exist. A step dy obeys the
    # dynamics with d = 0 and x_0 = 0; solving for dy rather than for y keeps the
    # large barrier terms from cancelling.
    step = new_factor(fac.AB, np.zeros((1, n_x)), N)
    dx, dv, zero_x, zero_v = x.copy(), v.copy(), np.zeros(n_x), 0.0 * v0_fixed
    y, dy = np.zeros((N + 1, n)), np.zeros((N + 1, n))
    s, z = np.ones((2, N + 1, n)), np.zeros((2, N + 1, n))
    ds, dz = np.zeros((2, N + 1, n)), np.zeros((2, N + 1, n))
    gap = np.zeros((2, N + 1, n))
    active = np.zeros((2, N + 1, n), np.bool_)
    _pack(x, v, y)
    y_free = y.copy()
    unit = _sizes(y, lower, upper, n_v)
    mu = start * _cost_of_states(T, T_N, x, unit)
    count = 0
    for side in range(2):
        for k in range(N + 1):
            for i in range(n):
                bound = lower[i] if side == 0 else upper[i]
                exists = k > 0 if i >= n_v else (i >= v0_fixed.size or k > 0) and k < N
                if not (exists and np.isfinite(bound)):
                    continue
                active[side, k, i] = True
                # Wide of a narrow box, too: from within it, one bound after the other
                # would stop the steps.
                s[side, k, i] = max(abs(y[k, i] - bound), unit[i])
                z[side, k, i] = mu / s[side, k, i]
                count += 1
    if count == 0:
        return True
    least_price, residual, sigma = 1e-14 * mu / start, 1.0, 0.0
    best, found = np.inf, False
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
                        total -= T[k % K, i, j] * y[k, j]
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
            # A centred step takes off a share 1 - sigma of the complementarity, and of
            # the breaches no more: else it runs into the bounds, and stays there.
            target, share = sigma * mu, 1.0 - sigma
            if not predictor and sigma > 0.0:
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
                            - z[side, k, i] * share * (gap[side, k, i] - s[side, k, i])
                        ) / s[side, k, i]
                        h_step[k, i] += push if side == 0 else -push
            solve(step, h_step, zero_x, zero_v, dx, dv)
            _pack(dx, dv, dy)
            for side in range(2):
                for k in range(N + 1):
                    for i in range(n):
                        if active[side, k, i]:
                            move = dy[k, i] if side == 0 else -dy[k, i]
                            breach = gap[side, k, i] - s[side, k, i]
                            s_new = s[side, k, i] + share * breach + move
                            ds[side, k, i] = s_new - s[side, k, i]
                            dz[side, k, i] = (
                                dz[side, k, i] - z[side, k, i] * s_new
                            ) / s[side, k, i]
        alpha = min(1.0, 0.995 * _step_length(s, z, ds, dz, active))
        if not alpha > 1e-10:
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
        residual *= 1.0 - alpha * (1.0 - sigma)
        # The second-order correction can cycle; a plain centred step does not.
        sigma = 0.3 if mu > 0.7 * mu_last else 0.0
        if alpha < SHORT:
            sigma = CENTRING
        if not np.isfinite(mu):
            break
        price = max(_distance(T, T_N, y, y_free, n_v), least_price)
        progress = max(mu * count / price, residual)
        if progress < min(best, IPM_ACCEPTED):
            best, found = progress, True
            for k in range(N):
                for i in range(n_v):
                    v[k, i] = min(max(y[k, i], fixed_lower[i]), fixed_upper[i])
                for i in range(n_x):
                    x[k + 1, i] = y[k + 1, n_v + i]
            if best < IPM_TOLERANCE:
                break
    return found


@njit(cache=True)
def _sizes(y, lower, upper, n_v):
    """(n,) of [v, x]: the greatest of each entry's bounds and free values."""
    N, n = y.shape[0] - 1, y.shape[1]
    unit = np.empty(n)
    for i in range(n):
        size = 1e-100
        for bound in (lower[i], upper[i]):
            if np.isfinite(bound):
                size = max(size, abs(bound))
        for k in range(N) if i < n_v else range(1, N + 1):
            size = max(size, abs(y[k, i]))
        unit[i] = size
    return unit


@njit(cache=True)
def _cost_of_states(T, T_N, x, unit):
    """Of all knots, as at the end; where that is nothing, of entries of their size."""
    n_x = x.shape[1]
    cost = 0.0
    for k in range(1, x.shape[0]):
        for i in range(n_x):
            for j in range(n_x):
                cost += 0.5 * x[k, i] * T_N[i, j] * x[k, j]
    if cost > 0.0:
        return cost
    for i in range(unit.size):
        cost = max(cost, T[0, i, i] * unit[i] ** 2)
    return cost


@njit(cache=True)
def _distance(T, T_N, y, y_free, n_v):
    """By how much y costs more than the free minimiser: 1/2 |y - y_free|_T^2."""
    N, n = y.shape[0] - 1, y.shape[1]
    total = 0.0
    for k in range(N + 1):
        for i in range(n if k < N else n - n_v):
            for j in range(n if k < N else n - n_v):
                if k < N:
                    weight, a, b = T[k % len(T), i, j], i, j
                else:
                    weight, a, b = T_N[i, j], n_v + i, n_v + j
                total += (
                    0.5 * weight * (y[k, a] - y_free[k, a]) * (y[k, b] - y_free[k, b])
                )
    return total


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
