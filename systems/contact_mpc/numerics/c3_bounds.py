"""The QP of C3 with bounds: lower <= [u_k, x_k] <= upper beside what c3_qp.py solves.

Bounds are met by a dual active-set method: an active bound adds a multiplier to the
linear term h, so it costs one more right-hand side of the same factorisation. Where
very many are active, or rounding leaves it undecided, a primal-dual interior point
method takes over, whose Newton steps are the same recursion with a larger diagonal.

Source: Goldfarb, Idnani, Math. Programming 27 (1983) (dual active set); Nocedal,
Wright, "Numerical Optimization", algorithm 16.4 (predictor-corrector).
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.c3_qp import factor, new_factor, solve

# An interior point solve ends when its duality gap, relative to what the bounds cost,
# and its residuals, relative to where it started, are this small; rounding may end it
# before, and then an iterate of the second, looser size is a solution ...
IPM_TOLERANCE, IPM_ACCEPTED = 1e-12, 1e-8
# ... and it has failed after so many steps.
IPM_STEPS = 80
# It starts with each bound's complementarity at so many times the free plan's cost:
# far from the bounds, whose multipliers may be millions of times what they start from
# where an object is light. Rounding may make the factorisation fail there: then nearer.
IPM_STARTS = (1e4, 1e2, 1.0)
# Bounds that the dual active-set method holds at once, at most.
ACTIVE_MAX = 256
# Breach of a bound that counts as none, relative to the entry's size.
BREACH = 1e-10
# A bound whose free response, beside the active ones, is this share of its own depends
# on them.
DEPENDENT = 1e-10
# What solve_active returns.
MET, CANNOT_BE_MET, UNDECIDED = 0, 1, 2


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
def solve_bounded(fac, T, T_N, h, x0, v0_fixed, lower, upper, sides, x, v):
    """The minimiser within bounds; x and v hold the unbounded one and are overwritten.

    Args: as of `factor` and `solve`; lower, upper: (n,) over [v, x], infinite where
        there is no bound, lower <= upper. x_0 and the fixed head of v_0 have no bounds.
        sides: (N + 1, n) integers, the bounds to try first: 1 lower, -1 upper, 0 none;
        all zero: the breached ones. Overwritten by the active ones.
    Returns: whether it converged. If not, as a rule no plan meets the bounds.
    """
    status = solve_active(fac, h, x0, v0_fixed, lower, upper, sides, x, v)
    if status == MET:
        return True
    sides[:] = 0
    # The active set may have left a plan that breaks the dynamics.
    solve(fac, h, x0, v0_fixed, x, v)
    for start in IPM_STARTS:
        if solve_interior(fac, T, T_N, h, v0_fixed, lower, upper, start, x, v):
            return True
    return False


@njit(cache=True)
def solve_active(fac, h, x0, v0_fixed, lower, upper, sides, x, v):
    """solve_bounded by Goldfarb's and Idnani's dual active-set method.

    The plan is affine in the multipliers mu of the active bounds (mu adds to h), so
    everything happens in the responses of the bounded entries to one another; x and v
    are overwritten where the result is MET.

    Returns: MET, CANNOT_BE_MET, or UNDECIDED (too many bounds, or rounding).
    """
    N, n_v = v.shape
    n_x = x.shape[1]
    n = n_v + n_x
    # The bounded entries: [v_k, x_k] flattened at k n + i.
    entry = np.empty((N + 1) * n, np.int64)
    count = 0
    for k in range(N + 1):
        for i in range(n):
            exists = k > 0 if i >= n_v else (i >= v0_fixed.size or k > 0) and k < N
            if exists and (np.isfinite(lower[i]) or np.isfinite(upper[i])):
                entry[count] = k * n + i
                count += 1
    entry = entry[:count]
    y_free, unit = np.empty(count), np.empty(count)
    size = np.zeros(n)
    for e in range(count):
        k, i = entry[e] // n, entry[e] % n
        y_free[e] = v[k, i] if i < n_v else x[k, i - n_v]
        size[i] = max(size[i], 1e-4 * abs(y_free[e]))
    for e in range(count):
        i = entry[e] % n
        for bound in (lower[i], upper[i]):
            if np.isfinite(bound):
                size[i] = max(size[i], abs(bound))
        unit[e] = max(size[i], 1e-100)

    capacity = min(count, ACTIVE_MAX)
    active, side = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    mu, r = np.zeros(capacity + 1), np.zeros(capacity + 1)
    response = np.empty((capacity + 1, count))
    L = np.zeros((capacity + 1, capacity + 1))
    m = 0
    first = True
    for e in range(count):
        first = first and sides[entry[e] // n, entry[e] % n] == 0
    for e in range(count):
        k, i = entry[e] // n, entry[e] % n
        guess = sides[k, i]
        if first:
            if y_free[e] < lower[i] - BREACH * unit[e]:
                guess = 1
            elif y_free[e] > upper[i] + BREACH * unit[e]:
                guess = -1
        if guess != 0:
            if m == capacity:
                return UNDECIDED
            active[m], side[m] = e, guess
            m += 1
    if m > 0:
        _responses(fac, entry[active[:m]], entry, v0_fixed.size, response)
    # The guess without those that depend on others or pull the wrong way.
    while m > 0:
        bad = _cholesky(response, active, 0, m, L)
        if bad >= 0:
            m = _drop(active, side, mu, response, m, bad)
            continue
        for a in range(m):
            i = entry[active[a]] % n
            mu[a] = (lower[i] if side[a] > 0 else upper[i]) - y_free[active[a]]
        _cholesky_solve(L, m, mu)
        kept = m
        for a in range(m - 1, -1, -1):
            i = entry[active[a]] % n
            if side[a] * mu[a] < 0.0 and lower[i] < upper[i]:
                m = _drop(active, side, mu, response, m, a)
        if m == kept:
            break

    y, c = np.empty(count), np.empty((1, count))
    one = np.empty(1, np.int64)
    entering, s_enter, mu_enter = -1, 0, 0.0
    for _ in range(10 * count + 100):
        y[:] = y_free
        for a in range(m):
            for e in range(count):
                y[e] += mu[a] * response[a, e]
        if entering >= 0:
            for e in range(count):
                y[e] += mu_enter * c[0, e]
        else:
            worst = BREACH
            for e in range(count):
                i = entry[e] % n
                below, above = (lower[i] - y[e]) / unit[e], (y[e] - upper[i]) / unit[e]
                if below > worst:
                    worst, entering, s_enter = below, e, 1
                if above > worst:
                    worst, entering, s_enter = above, e, -1
            if entering < 0:
                return _finish(
                    fac, h, x0, v0_fixed, lower, upper, sides, x, v, entry, active,
                    side, mu, L, m, unit,
                )  # fmt: skip
            for a in range(m):
                if active[a] == entering:
                    return UNDECIDED  # An active bound breached: rounding.
            one[0] = entry[entering]
            _responses(fac, one, entry, v0_fixed.size, c)
            mu_enter = 0.0
        # Direction: mu of the entering one grows by t s_enter, the others by -t r.
        for a in range(m):
            r[a] = s_enter * c[0, active[a]]
        _cholesky_solve(L, m, r)
        own, rate = c[0, entering], c[0, entering]
        for a in range(m):
            rate -= s_enter * r[a] * c[0, active[a]]
        i = entry[entering] % n
        breach = lower[i] - y[entering] if s_enter > 0 else y[entering] - upper[i]
        t, leaving = np.inf, -1
        if rate > DEPENDENT * own:
            t = max(breach, 0.0) / rate
        for a in range(m):
            i_a = entry[active[a]] % n
            if lower[i_a] < upper[i_a] and side[a] * r[a] > 0.0:
                t_a = side[a] * mu[a] / (side[a] * r[a])
                if t_a < t:
                    t, leaving = max(t_a, 0.0), a
        if t == np.inf:
            return CANNOT_BE_MET
        for a in range(m):
            mu[a] -= t * r[a]
        mu_enter += t * s_enter
        if leaving >= 0:
            m = _drop(active, side, mu, response, m, leaving)
            if _cholesky(response, active, leaving, m, L) >= 0:
                return UNDECIDED
            continue
        if m == capacity:
            return UNDECIDED
        active[m], side[m], mu[m] = entering, s_enter, mu_enter
        response[m] = c[0]
        m += 1
        entering = -1
        if _cholesky(response, active, m - 1, m, L) >= 0:
            return UNDECIDED
    return UNDECIDED


@njit(cache=True)
def _finish(
    fac, h, x0, v0_fixed, lower, upper, sides, x, v, entry, active, side, mu, L, m, unit
):
    """x and v of the multipliers found, refined until the active bounds hold."""
    n_v = v.shape[1]
    n = n_v + x.shape[1]
    residual = np.empty(m)
    h_mu = h.copy()
    for _ in range(4):
        for a in range(m):
            k, i = entry[active[a]] // n, entry[active[a]] % n
            h_mu[k, i] = h[k, i] + mu[a]
        solve(fac, h_mu, x0, v0_fixed, x, v)
        worst = 0.0
        for a in range(m):
            k, i = entry[active[a]] // n, entry[active[a]] % n
            bound = lower[i] if side[a] > 0 else upper[i]
            residual[a] = bound - (v[k, i] if i < n_v else x[k, i - n_v])
            worst = max(worst, abs(residual[a]) / unit[active[a]])
        if worst < 1e-13:
            break
        _cholesky_solve(L, m, residual)
        for a in range(m):
            mu[a] += residual[a]
    # More than rounding is left, in a bound or a multiplier: not to be trusted.
    for e in range(entry.size):
        k, i = entry[e] // n, entry[e] % n
        y = v[k, i] if i < n_v else x[k, i - n_v]
        bound = lower[i] if y < lower[i] else upper[i]
        near = min(10.0 * BREACH * unit[e], 1e-7 * (1.0 + abs(bound)))
        if not max(lower[i] - y, y - upper[i]) < near:
            return UNDECIDED
        if i < n_v:
            v[k, i] = min(max(y, lower[i]), upper[i])
    sides[:] = 0
    for a in range(m):
        sides[entry[active[a]] // n, entry[active[a]] % n] = side[a]
    return MET


@njit(cache=True)
def _drop(active, side, mu, response, m, a):
    """Removes the a-th active bound of m; returns how many are left."""
    for b in range(a, m - 1):
        active[b], side[b], mu[b] = active[b + 1], side[b + 1], mu[b + 1]
        response[b] = response[b + 1]
    return m - 1


@njit(cache=True)
def _cholesky(response, active, start, m, L):
    """Factorises the active bounds' responses to one another, from row start on.

    Returns: -1, or the first bound that depends on those before it.
    """
    for a in range(start, m):
        for b in range(a + 1):
            total = 0.5 * (response[a, active[b]] + response[b, active[a]])
            for j in range(b):
                total -= L[a, j] * L[b, j]
            if b < a:
                L[a, b] = total / L[b, b]
            elif total > DEPENDENT * response[a, active[a]]:
                L[a, a] = np.sqrt(total)
            else:
                return a
    return -1


@njit(cache=True)
def _cholesky_solve(L, m, b):
    """Overwrites b[:m] with the solution of L L' b = b."""
    for i in range(m):
        for j in range(i):
            b[i] -= L[i, j] * b[j]
        b[i] /= L[i, i]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            b[i] -= L[j, i] * b[j]
        b[i] /= L[i, i]


@njit(cache=True)
def _responses(fac, causes, entry, n_fixed, out):
    """out[a, e]: how the entry e of the minimiser answers to a unit of h at cause a.

    As `solve` with d, x_0 and the given forces zero, for all causes at once: the
    innermost loops run over them.
    """
    models, S = fac.AB, fac.S
    K, n_x, n = models.shape
    n_v = n - n_x
    N, m = S.shape[0], causes.size
    p, g, q = np.zeros((n_x, m)), np.empty((n, m)), np.empty((n_x, m))
    ell, y = np.zeros((N, n_v, m)), np.zeros((N + 1, n, m))
    last = 0
    for a in range(m):
        k = causes[a] // n
        last = max(last, k)
        if k == N:
            p[causes[a] % n - n_v, a] = -1.0
    for k in range(min(last, N - 1), -1, -1):
        AB = models[k % K]
        g[:] = 0.0
        for a in range(m):
            if causes[a] // n == k:
                g[causes[a] % n, a] = -1.0
        for j in range(n_x):
            for i in range(n):
                f = AB[j, i]
                if f != 0.0:
                    for a in range(m):
                        g[i, a] += f * p[j, a]
        for j in range(n_fixed if k == 0 else 0, n_v):
            f = 1.0 / S[k, j, j]
            for a in range(m):
                ell[k, j, a] = g[j, a] * f
            for i in range(j + 1, n):
                f = S[k, j, i]
                for a in range(m):
                    g[i, a] -= f * ell[k, j, a]
        p[:] = g[n_v:]
    for k in range(N):
        AB = models[k % K]
        for j in range(n_v - 1, (n_fixed if k == 0 else 0) - 1, -1):
            for a in range(m):
                y[k, j, a] = -ell[k, j, a]
            for i in range(j + 1, n):
                f = S[k, j, i]
                for a in range(m):
                    y[k, j, a] -= f * y[k, i, a]
            f = 1.0 / S[k, j, j]
            for a in range(m):
                y[k, j, a] *= f
        q[:] = 0.0
        for j in range(n_x):
            for i in range(n):
                f = AB[j, i]
                if f != 0.0:
                    for a in range(m):
                        q[j, a] += f * y[k, i, a]
        y[k + 1, n_v:] = q
    for e in range(entry.size):
        k, i = entry[e] // n, entry[e] % n
        for a in range(m):
            out[a, e] = y[k, i, a]


@njit(cache=True)
def solve_interior(fac, T, T_N, h, v0_fixed, lower, upper, start, x, v):
    """solve_bounded by an interior point method; whatever the number of active bounds.

    Args: as of solve_bounded; start: complementarity of each bound at the start, in
        units of the cost of the states in x.
    Returns: whether it converged. If not, as a rule no plan meets the bounds.
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
    least_price, residual, careful = 1e-14 * mu / start, 1.0, False
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
        residual *= 1.0 - alpha
        # The second-order correction can cycle; a plain centred step does not.
        careful = mu > 0.7 * mu_last
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
