"""The point of a polyhedron, or of a complementarity set, nearest to the origin.

    minimise 1/2 |v|^2   subject to   a_i' v + b_i >= 0,   = 0 for the rows marked so

Goldfarb's and Idnani's dual active-set method on an orthonormal basis of the active
rows. It works on the rows themselves and not on their products, so rows that are nearly
parallel (the friction edges of one contact) cost half the digits that they would cost
in a Gram matrix. It ends in the point, or in the proof that there is none.

Source: Goldfarb, Idnani, "A numerically stable dual method for solving strictly convex
quadratic programs", Math. Programming 27 (1983).
"""

import numpy as np
from numba import njit

FOUND, EMPTY, NOT_PRECISE = 0, 1, 2
# A row that keeps less than this share of its length beside the active ones depends on
# them.
DEPENDENT = 1e-11
# A breach that counts as none, in lengths of the largest distance.
BREACH = 1e-11


@njit(cache=True)
def nearest_point(A, b, equal, v):
    """Fills v (n,) with the nearest point; returns FOUND, EMPTY or NOT_PRECISE.

    Args:
        A: (m, n) rows of length one, or zero. b: (m,). equal: (m,) whether the row is
            an equality.
    """
    m, n = A.shape
    v[:] = 0.0
    # The active rows are Q[:k]' R: Q[j] (n,) orthonormal, R upper triangular.
    Q, R = np.empty((n, n)), np.zeros((n, n))
    active, sign, mu = np.empty(n, np.int64), np.empty(n), np.zeros(n)
    is_active = np.zeros(m, np.bool_)
    k = 0
    p, coefficient, r = np.empty(n), np.empty(n), np.empty(n)
    size = 0.0
    for i in range(m):
        size = max(size, abs(b[i]))
    if not np.isfinite(size):
        return NOT_PRECISE
    entering, side, mu_enter, refined, length = -1, 1.0, 0.0, False, size
    for _ in range(20 * (m + n) + 50):
        if entering < 0:
            length = size
            for j in range(n):
                length = max(length, abs(v[j]))
            # Equalities come first, in their order; then the worst breach.
            worst = BREACH * length
            for i in range(m):
                if is_active[i]:
                    continue
                s = b[i]
                for j in range(n):
                    s += A[i, j] * v[j]
                if equal[i]:
                    if abs(s) > BREACH * length or _length(A[i]) > 0.0:
                        entering, side = i, (1.0 if s <= 0.0 else -1.0)
                        break
                elif -s > worst:
                    worst, entering, side = -s, i, 1.0
            mu_enter = 0.0
            if entering < 0:
                if refined or k == 0:
                    for i in range(m):
                        s = b[i]
                        for j in range(n):
                            s += A[i, j] * v[j]
                        s = -abs(s) if equal[i] else s
                        if not s >= -1e4 * BREACH * length:
                            return NOT_PRECISE
                    return FOUND
                refined = True
                _refine(A, b, active, sign, Q, R, k, v)
                continue
            refined = False
        # The entering row, along the active ones (coefficient) and beside them (p).
        for j in range(n):
            p[j] = side * A[entering, j]
        whole = _length(p)
        coefficient[:k] = 0.0
        for _ in range(2):  # Twice is enough for orthogonality.
            for a in range(k):
                total = 0.0
                for j in range(n):
                    total += Q[a, j] * p[j]
                coefficient[a] += total
                for j in range(n):
                    p[j] -= total * Q[a, j]
        beside = _length(p)
        for a in range(k - 1, -1, -1):
            r[a] = coefficient[a]
            for c in range(a + 1, k):
                r[a] -= R[a, c] * r[c]
            r[a] /= R[a, a]
        s = side * b[entering]
        for j in range(n):
            s += side * A[entering, j] * v[j]
        depends = not beside > DEPENDENT * whole
        if depends and abs(s) <= 1e3 * BREACH * length:
            is_active[entering] = True  # It says what the active rows say already.
            entering = -1
            continue
        t, leaving = np.inf, -1
        if not depends:
            t = max(-s, 0.0) / beside**2
        for a in range(k):
            if not equal[active[a]] and r[a] > 0.0 and mu[a] < t * r[a]:
                t, leaving = mu[a] / r[a], a
        if t == np.inf:
            return EMPTY
        if not depends:
            for j in range(n):
                v[j] += t * p[j]
        for a in range(k):
            mu[a] = mu[a] - t * r[a]
            if not equal[active[a]]:
                mu[a] = max(mu[a], 0.0)
        mu_enter += t
        if leaving < 0:
            if k == n:
                return NOT_PRECISE
            for a in range(k):
                R[a, k] = coefficient[a]
            R[k, k] = beside
            for j in range(n):
                Q[k, j] = p[j] / beside
            active[k], mu[k], sign[k] = entering, mu_enter, side
            is_active[entering] = True
            k += 1
            entering = -1
            continue
        is_active[active[leaving]] = False
        k = _remove(active, mu, sign, Q, R, k, leaving)
    return NOT_PRECISE


@njit(cache=True)
def nearest_mode(A, b, size, enough, v, nodes_max):
    """The nearest v with A v + b >= 0 of which, for each i < m / 2, row i or row
    m / 2 + i is zero; the search ends at the first one found within `enough`.

    Branch and bound: down from the open node with the least bound, until nothing better
    is left below; then from the next one.

    Args: A (m, n) rows of length one, or zero; b (m,); size: of the distances in b;
        enough: squared length; v (n,): overwritten; nodes_max: nodes to look at.
    Returns: v'v, or inf where there is none or the nodes ran out before one was found;
        and whether the search came to its end.
    """
    half, n = A.shape[0] // 2, A.shape[1]
    # Modes: 0 undecided, 1 the second is zero, 2 the first is. A node adds one to the
    # open ones: two children for itself.
    stack = np.empty((nodes_max + 2, half), np.int8)
    bound = np.empty(nodes_max + 2)
    stack[0], bound[0] = 0, 0.0
    depth, best, dived, nodes = 1, np.inf, False, 0
    trial, equal, row = np.empty(n), np.zeros(2 * half, np.bool_), np.empty(2 * half)
    while depth > 0 and nodes < nodes_max:
        if not dived:  # Down from the open node with the least bound.
            least = 0
            for i in range(depth):
                if bound[i] <= bound[least]:
                    least = i
            mode = stack[least].copy()
            stack[least], stack[depth - 1] = stack[depth - 1], mode
            bound[least], bound[depth - 1] = bound[depth - 1], bound[least]
        depth -= 1
        dived = False
        if not bound[depth] < best - 1e-12 * size * size:
            if np.isfinite(best) and depth > 0 and bound[:depth].min() >= best:
                depth = 0
            continue
        nodes += 1
        mode = stack[depth].copy()
        for i in range(half):
            equal[i], equal[half + i] = mode[i] == 2, mode[i] == 1
        if nearest_point(A, b, equal, trial) != FOUND:
            continue
        cost = 0.0
        for x in trial:
            cost += x * x
        if not cost < best - 1e-12 * size * size:
            continue
        length = max(size, np.sqrt(cost))
        branch, worst = -1, 1e-9 * length
        for i in range(2 * half):
            row[i] = b[i]
            for j in range(n):
                row[i] += A[i, j] * trial[j]
        for i in range(half):
            if mode[i] == 0 and min(row[i], row[half + i]) > worst:
                branch, worst = i, min(row[i], row[half + i])
        if branch < 0:
            best = cost
            v[:] = trial
            # Once more with every mode decided: exact, not to the tolerance above.
            for i in range(half):
                equal[i] = row[i] <= row[half + i]
                equal[half + i] = not equal[i]
            if nearest_point(A, b, equal, trial) == FOUND:
                v[:] = trial
            if best <= enough:
                break
            continue
        first = 2 if row[half + branch] > row[branch] else 1
        stack[depth] = mode
        stack[depth, branch] = 3 - first  # The less likely one waits below.
        stack[depth + 1] = mode
        stack[depth + 1, branch] = first
        bound[depth] = bound[depth + 1] = cost
        depth += 2
        dived = True
    return best, depth == 0 or best <= enough


@njit(cache=True)
def _length(a):
    total = 0.0
    for x in a:
        total += x * x
    return np.sqrt(total)


@njit(cache=True)
def _remove(active, mu, sign, Q, R, k, a):
    """Takes the a-th of k active rows out; Givens rotations make R triangular again."""
    for c in range(a, k - 1):
        active[c], mu[c], sign[c] = active[c + 1], mu[c + 1], sign[c + 1]
        for j in range(c + 2):
            R[j, c] = R[j, c + 1]
    k -= 1
    for c in range(a, k):
        h = np.sqrt(R[c, c] ** 2 + R[c + 1, c] ** 2)
        cosine, sine = R[c, c] / h, R[c + 1, c] / h
        for j in range(c, k):
            upper, lower = R[c, j], R[c + 1, j]
            R[c, j] = cosine * upper + sine * lower
            R[c + 1, j] = cosine * lower - sine * upper
        for j in range(Q.shape[1]):
            upper, lower = Q[c, j], Q[c + 1, j]
            Q[c, j] = cosine * upper + sine * lower
            Q[c + 1, j] = cosine * lower - sine * upper
    return k


@njit(cache=True)
def _refine(A, b, active, sign, Q, R, k, v):
    """Puts v on the active rows by the smallest move, -Q R^-T (A v + b)."""
    y = np.empty(k)
    for a in range(k):
        total = b[active[a]]
        for j in range(v.size):
            total += A[active[a], j] * v[j]
        y[a] = sign[a] * total
        for i in range(a):
            y[a] -= R[i, a] * y[i]
        y[a] /= R[a, a]
    for a in range(k):
        for j in range(v.size):
            v[j] -= y[a] * Q[a, j]
