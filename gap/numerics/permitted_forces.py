"""Contact forces that a model permits, and how much of a motion they explain.

At an instant bodies need the generalized force P (n_v,), and every contact can give
what its cone holds: columns g of generators, each with a weight that is not negative.
What no such weights explain,

    r = P - G lam*,    lam* = argmin over lam >= 0 of |W (P - G lam)|^2,

is the violation of the contact model by the motion; nothing is simulated, and no depth
of penetration enters. A contact that slides has one generator, n - mu s with s along
the slip; one that may stick has a pyramid of them. Support at several points is a set:
any weights that are not negative.

Means are taken with test functions w of unit integral, as momentum is then exact and
accelerations follow from positions alone: mean(a) = integral(w'' q).

Source: Lawson, Hanson, Solving Least Squares Problems, 1974, chapter 23 (weights that
are not negative); Messenger, Bortz, Multiscale Model. Simul. 19(3), 2021 (test
functions).
"""

import numpy as np
from numba import njit
from scipy.sparse import csr_matrix

_POWER = 4  # w ~ (1 - u^2)^4 on |u| < 1.
_SECOND_MOMENT = 1.0 / 11.0  # Of w, over the half width squared.
# integral(w'^2) / integral(w^2), times the half width squared: noise of positions in a
# mean velocity, -integral(w' q), by their noise in a mean position.
RATE_OF_MEAN = 34.0 / 7.0
FEWEST = 6  # Samples within a test function.
ALONG = 0.95  # Of a normal, along an axis to which nothing is across then.


def tangential(u, normal):
    """What of u (n, 3) lies in the planes of the unit normals (n, 3)."""
    return u - np.sum(u * normal, axis=1)[:, None] * normal


def tangents(normal) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (n, 3) across unit normals (n, 3), and each other. They turn
    with the normals and do not jump: means of them are taken over a while. So they
    follow from one axis, that which the normals are farthest from, as far as may be."""
    axis = int(np.argmin(np.mean(normal**2, axis=0))) if len(normal) else 0
    one, other = np.eye(3)[axis], np.eye(3)[axis - 1]
    across = np.where(np.abs(normal[:, [axis]]) > ALONG, other, one)
    e1 = np.cross(normal, across)
    e1 /= np.linalg.norm(e1, axis=1)[:, None]
    return e1, np.cross(normal, e1)


def test_functions(times, centres, half) -> tuple[csr_matrix, csr_matrix]:
    """Weights (n_centres, n) that give, from samples at times (n,), the mean of a
    signal over a test function about each centre, and the mean of its second
    derivative. Both are exact for cubics, however samples lie. A row is empty where
    fewer than FEWEST samples are within, or where none is in one of its thirds.

    Args: half, half the width of a test function [s]; of each (n_centres,), or of all.
    """
    t, rows, columns = np.asarray(times, float), [], []
    means: list[np.ndarray] = []
    seconds: list[np.ndarray] = []
    halves = np.broadcast_to(half, np.shape(centres))
    for i, (c, half) in enumerate(zip(np.asarray(centres, float), halves, strict=True)):
        a, b = np.searchsorted(t, [c - half, c + half])
        u = (t[a:b] - c) / half
        if len(u) < FEWEST or any(
            not ((u >= x) & (u <= x + 2.0 / 3.0)).any() for x in (-1.0, -1.0 / 3, 1 / 3)
        ):
            continue
        base = np.maximum(1.0 - u * u, 0.0)
        V = np.stack([u**k for k in range(4)])  # (4, n)
        # The function itself, and its second derivative, made exact by the smallest
        # change that goes with a bump.
        w = base**_POWER
        d2 = 8.0 * base**2 * (7.0 * u * u - 1.0)
        bump = base**2 + 1e-3
        for weights, moments, into in (
            (w / w.sum(), (1.0, 0.0, _SECOND_MOMENT, 0.0), means),
            (d2, (0.0, 0.0, 2.0, 0.0), seconds),
        ):
            size = float(V[2] @ weights)
            if moments[0] == 0.0:
                weights = weights * (2.0 / size if size > 0.0 else 0.0)
            A = (V * bump) @ V.T
            change = np.linalg.solve(A, np.array(moments) - V @ weights)
            into.append(weights + bump * (change @ V))
        seconds[-1] = seconds[-1] / half**2
        rows.append(np.full(b - a, i))
        columns.append(np.arange(a, b))
    shape = (len(centres), len(t))
    if not rows:
        return csr_matrix(shape), csr_matrix(shape)
    where = (np.concatenate(rows), np.concatenate(columns))
    return (
        csr_matrix((np.concatenate(means), where), shape),
        csr_matrix((np.concatenate(seconds), where), shape),
    )


@njit(cache=True)
def _solve_some(H, g, known, n, ridge, S, x):
    """Writes x (n,), the solution of (H + ridge) x = g among the first n rows, by
    Cholesky's factors S, of which the first `known` rows stand."""
    for a in range(known, n):
        for c in range(a + 1):
            value = H[a, c]
            if a == c:
                value += ridge
            for b in range(c):
                value -= S[a, b] * S[c, b]
            if a == c:
                S[a, a] = np.sqrt(max(value, 0.1 * ridge))
            else:
                S[a, c] = value / S[c, c]
    for a in range(n):
        value = g[a]
        for b in range(a):
            value -= S[a, b] * x[b]
        x[a] = value / S[a, a]
    for a in range(n - 1, -1, -1):
        value = x[a]
        for b in range(a + 1, n):
            value -= S[b, a] * x[b]
        x[a] = value / S[a, a]


@njit(cache=True)
def nonnegative(A, y, weights, most):
    """weights (k,) >= 0 with which |A weights - y|^2 is least, by Lawson's and Hanson's
    active set; A (m, k). Writes weights; returns how many steps were taken.

    Columns that say the same (four feet of a block) are no harm: one of them stays out.
    """
    m, k = A.shape
    squares, pull = np.zeros(k), np.zeros(k)
    for a in range(m):
        for i in range(k):
            squares[i] += A[a, i] * A[a, i]
            pull[i] += A[a, i] * y[a]
    ridge, tol = 1e-11 * max(1e-300, squares.max()), 1e-10 * np.abs(pull).max()
    # Of the n columns that are in use: their numbers, products, products with y, and
    # Cholesky's factors, of which `known` rows stand.
    index, n, known = np.empty(k, np.int64), 0, 0
    H, S = np.empty((k, k)), np.empty((k, k))
    g, x = np.empty(k), np.empty(k)
    used, banned = np.zeros(k, np.bool_), np.zeros(k, np.bool_)
    left = y.copy()
    weights[:] = 0.0
    steps = 0
    while steps < most:
        steps += 1
        best, j = tol, -1
        for i in range(k):
            if pull[i] > best and not used[i] and not banned[i]:
                best, j = pull[i], i
        if j < 0:
            break
        used[j], index[n], g[n] = True, j, 0.0
        for a in range(m):
            g[n] += A[a, j] * y[a]
        n += 1
        for c in range(n):
            value = 0.0
            for a in range(m):
                value += A[a, j] * A[a, index[c]]
            H[n - 1, c] = H[c, n - 1] = value
        while n:
            _solve_some(H, g, known, n, ridge, S, x)
            known = n
            if x[:n].min() > 0.0:
                for a in range(n):
                    weights[index[a]] = x[a]
                banned[:] = False
                break
            step = 1.0
            for a in range(n):
                if x[a] <= 0.0:
                    w = weights[index[a]]
                    share = w / (w - x[a]) if w > x[a] else 0.0
                    step = min(step, share)
            kept = 0
            for a in range(n):
                i = index[a]
                weights[i] += step * (x[a] - weights[i])
                if x[a] <= 0.0 and weights[i] <= 1e-13 * (1.0 + abs(x[a])):
                    weights[i] = 0.0
                    used[i] = False
                    if i == j:
                        banned[j] = True  # It came in and went out: no gain there.
                    known = min(known, kept)
                    continue
                if kept < a:
                    index[kept], g[kept] = i, g[a]
                    H[kept, :n] = H[a, :n]
                    H[:n, kept] = H[:n, a]
                kept += 1
            moved, n = kept < n, kept
            if not moved:
                break
        left[:] = y
        for c in range(n):
            w = weights[index[c]]
            for a in range(m):
                left[a] -= A[a, index[c]] * w
        pull[:] = 0.0
        for a in range(m):
            for i in range(k):
                pull[i] += A[a, i] * left[a]
    return steps


@njit(cache=True)
def explain(P, G, is_there, root, share, left, weights, rank):
    """What permitted forces leave of P, instant by instant.

    Args: P (n, m) needed; G (n, m, k) generators, of which is_there (n, k) can act;
        root (n, m, m): what weighs rows, r = root (P - G lam); share (n, d, k): with
        it |share lam|^2 is added to |r|^2, to choose among many lam that explain alike
        (unshared_load); it does not count as left. Writes left (n, m),
        weights (n, k) and rank (n,), how many weights are above zero.
    """
    n, m, k = G.shape
    d = share.shape[1]
    index = np.empty(k, np.int64)
    for i in range(n):
        count = 0
        for c in range(k):
            weights[i, c] = 0.0
            if is_there[i, c]:
                index[count] = c
                count += 1
        y, A = np.zeros(m + d), np.zeros((m + d, count))
        for a in range(m):
            for b in range(a + 1):  # root is a lower triangle.
                weight = root[i, a, b]
                y[a] += weight * P[i, b]
                for c in range(count):
                    A[a, c] += weight * G[i, b, index[c]]
        for a in range(d):
            for c in range(count):
                A[m + a, c] = share[i, a, index[c]]
        rank[i] = 0
        if count:
            x = np.empty(count)
            nonnegative(A, y, x, 4 * count + 20)
            for c in range(count):
                weights[i, index[c]] = x[c]
                if x[c] > 0.0:
                    rank[i] += 1
                    for a in range(m):
                        y[a] -= A[a, c] * x[c]
        left[i] = y[:m]


def unshared_load(places) -> np.ndarray:
    """(d, n) unit rows: of loads of n points at places (n, 2) the combinations that no
    balance of force and moments tells: springs that are alike have none of them. d is
    n - 3, or more where the points are on a line."""
    A = np.vstack([np.ones(len(places)), np.asarray(places, float).T])
    A[1:] -= A[1:].mean(axis=1, keepdims=True)
    size = max(float(np.abs(A[1:]).max(initial=0.0)), 1e-9)
    A[1:] /= size
    _, s, vt = np.linalg.svd(A)
    return vt[int(np.sum(s > 1e-3)) :]


def roots_of(covariance) -> np.ndarray:
    """(n, m, m) lower triangles L^-1 with L L' = covariance (n, m, m): rows times these
    have unit noise."""
    L = np.linalg.cholesky(covariance)
    return np.linalg.solve(L, np.broadcast_to(np.eye(L.shape[-1]), L.shape))


def held_means(times, centres, half) -> csr_matrix:
    """(n_centres, n) weights that give the means of a signal that holds each of its n
    values from its time until the next one's; the last holds on. half: as of
    test_functions."""
    t = np.asarray(times, float)
    rows, columns, values = [], [], []
    halves = np.broadcast_to(half, np.shape(centres))
    for i, (c, half) in enumerate(zip(np.asarray(centres, float), halves, strict=True)):
        a = max(int(np.searchsorted(t, c - half, "right")) - 1, 0)
        b = int(np.searchsorted(t, c + half))
        u = np.clip((np.append(t[a:b], c + half) - c) / half, -1.0, 1.0)
        rows.append(np.full(b - a, i))
        columns.append(np.arange(a, b))
        values.append(np.diff(_integral(u)))
    shape = (len(centres), len(t))
    if not rows:
        return csr_matrix(shape)
    where = (np.concatenate(rows), np.concatenate(columns))
    return csr_matrix((np.concatenate(values), where), shape)


def _integral(u):
    """Of (1 - u^2)^4 from -1 to u, over the whole of it."""
    v = u - 4 * u**3 / 3 + 6 * u**5 / 5 - 4 * u**7 / 7 + u**9 / 9
    end = 1 - 4 / 3 + 6 / 5 - 4 / 7 + 1 / 9
    return 0.5 * (1.0 + v / end)
