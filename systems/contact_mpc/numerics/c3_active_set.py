"""Bounds on the QP of C3 by a dual active-set method.

An active bound adds a multiplier to the linear term h of c3_qp.py, so it costs one more
right-hand side of the same factorisation. c3_bounds.py says when it is used.

Source: Goldfarb, Idnani, Math. Programming 27 (1983).
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.c3_qp import solve

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
