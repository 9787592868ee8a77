"""Linear complementarity problem (LCP): the contact forces of one time step.

Find lam with   0 <= lam   perp   w = F lam + q >= 0.

Lemke's method with lexicographic pivoting: it ends for every F, without cycling, and
for positive semi-definite F (symmetric or not) it ends either in a solution or in the
proof that there is none. F of rigid contact is positive semi-definite and singular
(several friction edges share one normal), so neither a factorisation nor a projected
iteration on F would be exact.

Source: Cottle, Pang, Stone, "The Linear Complementarity Problem", section 4.4
(Lemke's method), 4.9 (lexicographic degeneracy resolution).
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.nearest_point import nearest_mode

# Modes that the search behind Lemke's method looks at.
NODES_MAX = 2000
# Pivots after which the second try of Lemke's method computes its tableau anew; the
# third does after each.
REBUILD = 10
# Largest force or speed of a contact that is solved again in the unit of such contacts,
# in units in which diag(M) and max |b| are 1.
SMALL = 1e-3
# Largest force z, in units in which diag(M) and max |b| are 1, that counts as the scale
# of a rounding error; larger ones are no excuse for a breach of w >= 0.
Z_SCALE_MAX = 1e2
# Least scale of a row in these units: terms of 1e-15 or less are rounding.
ROW_MIN = 1e-6
# Status of solve_lcp_kernel.
SOLVED, NO_SOLUTION, NOT_PRECISE = 0, 1, 2


def solve_lcp(F, q):
    """A solution lam of the LCP; where F is singular it need not be the only one.

    Args:
        F: (n, n), positive semi-definite (symmetric or not) [m/s per N].
        q: (n,) gap velocities without contact force [m/s].

    Returns: lam (n,) [N], every entry >= 0. w = F lam + q holds w >= 0 and w lam = 0 to
        1e-9 of each row's own terms (to 1e-7 where no such lam is found), see
        _violation.

    Raises: ValueError on wrong shapes, entries that are not finite, and when there is
        no solution (or, for F that is not positive semi-definite, none was found).

    Source: see the module; the method costs about n pivots of n x 2n numbers.
    """
    # Copies that can be written to; for others all would be compiled once more.
    F, q = np.array(F, dtype=float, order="C"), np.array(q, dtype=float)
    if q.ndim != 1 or F.shape != (q.size, q.size):
        raise ValueError(
            f"solve_lcp: F is {F.shape} and q is {q.shape}, expected (n, n) and (n,)"
        )
    lam, status = solve_lcp_kernel(F, q)
    if status == SOLVED:
        return lam
    if not np.isfinite(F).all() or not np.isfinite(q).all():
        raise ValueError("solve_lcp: F or q holds an entry that is not finite")
    if status == NO_SOLUTION:
        raise ValueError("solve_lcp: the LCP has no solution (Lemke ended in a ray)")
    raise ValueError("solve_lcp: no solution precise to 1e-7 (is F nearly singular?)")


@njit(cache=True)
def solve_lcp_kernel(F, q):
    """solve_lcp for compiled callers: returns (lam, status) and raises nothing.

    Args: F (n, n) and q (n,) are contiguous float64 of matching size.
    Returns: lam (n,) [N], zero unless status is SOLVED; status, one of the above.
    """
    n = q.size
    lam = np.zeros(n)
    worst = 0.0
    for i in range(n):
        worst = min(worst, q[i])
        if not np.isfinite(q[i]):
            return lam, NOT_PRECISE
        for j in range(n):
            if not np.isfinite(F[i, j]):
                return lam, NOT_PRECISE
    if worst == 0.0:
        return lam, SOLVED
    # The same LCP in units in which F has a diagonal of ones and the largest |q| is 1,
    # so that the tolerances below mean the same for grams and for tonnes.
    scale, largest = _units(F), 0.0
    for i in range(n):
        largest = max(largest, scale[i] * abs(q[i]))
    M, b = np.empty((n, n)), np.empty(n)
    for i in range(n):
        b[i] = scale[i] * q[i] / largest
        for j in range(n):
            M[i, j] = scale[i] * F[i, j] * scale[j]
    status = NOT_PRECISE
    # What is tied but for rounding of the largest speed is no tie for far smaller ones:
    # where the check says so, those are solved once more, beside what the others do;
    # and then all, by a tableau without the rounding errors of many pivots.
    best, found = np.inf, np.zeros(n)
    for rebuild in (0, REBUILD, 1):
        z, status, basic = _lemke(M, b, 1e-11, rebuild)
        if status == SOLVED:
            status, best = NOT_PRECISE, _violation(M, b, z)
            found[:] = z
            if not best < 1e-9:
                _solve_small(M, b, basic, rebuild, found)
                best = _violation(M, b, found)
            if best < 1e-9:
                break
    # Where feasible w leave no room (a wedge), rounding in q alone makes a ray. Then a
    # slightly regular F tells: its w is wrong by 1e-12 z, which stays below 1e-9 if
    # there is a solution, and does not shrink with the 1e-12 if there is none.
    # Lemke's path may also end in a ray although there is a solution, where M is not
    # positive semi-definite, and rounding may break it where it nearly is not: hence
    # the search. Where that finds nothing either, a more regular F and 1e-7 have to do.
    if not best < 1e-9:
        for more, rebuild, most in ((1e-12, 0, 1e-9), (1e-8, REBUILD, 1e-7)):
            R = M.copy()
            for i in range(n):
                R[i, i] += more
            z, ended, basic = _lemke(R, b, 1e-13, rebuild)
            if ended == SOLVED and _violation(M, b, z) * max(1.0, z.max()) < most:
                found[:] = z
                break
            if rebuild == 0 and _search(M, b, found):
                break
        else:
            return lam, status
    for i in range(n):
        lam[i] = scale[i] * largest * found[i]
    return lam, SOLVED


@njit(cache=True)
def _units(F):
    """The unit of each row and force, (n,): 1 / sqrt(F[i, i]), where that is not zero.

    A sliding speed (F[i, i] = 0, and F[i, j] = -F[j, i] but for scale: its friction
    edges) has the unit of the edge that moves most, and all its edges have that one. So
    F[i, i] that is rounding instead of zero, of an edge along which nothing can move,
    makes no unit; where nothing moves along any edge, the normal force does.
    """
    n = len(F)
    unit, is_pair = np.ones(n), np.zeros((n, n), np.bool_)
    for i in range(n):
        if F[i, i] > 0.0:
            unit[i] = 1.0 / np.sqrt(F[i, i])
    for i in range(n):
        if F[i, i] > 0.0:
            continue
        largest, most, least = 0.0, 0.0, np.inf
        for j in range(n):
            largest = max(largest, -F[i, j] * F[j, i])
        for j in range(n):
            is_pair[i, j] = -F[i, j] * F[j, i] > 1e-12 * largest
            if F[j, j] > 0.0:
                if is_pair[i, j]:
                    least = min(least, unit[j] * np.sqrt(-F[i, j] * F[j, i]))
                else:
                    most = max(most, unit[j] * max(abs(F[i, j]), abs(F[j, i])))
        if least == np.inf:
            is_pair[i] = False  # An edge along which nothing moves.
        if least == np.inf or least > 1e6 * most > 0.0:
            least = most
        if least > 0.0:
            unit[i] = 1.0 / least
    for i in range(n):
        for j in range(n):
            if is_pair[i, j]:
                most = 1.0 / (unit[i] * np.sqrt(-F[i, j] * F[j, i]))
                if not F[j, j] > 0.0 or most < unit[j]:
                    unit[j] = most
    return unit


@njit(cache=True, inline="always")
def _solve_small(M, b, basic, rebuild, z):
    """Solves what is below SMALL in the solution z (n,) once more, in a unit of its
    own, with the other contacts as they are in `basic` (n,); overwrites both."""
    n = b.size
    T = np.empty((n, 2 * n + 2))
    if basic.max() == 2 * n or not _rebuild(T, M, b, basic):  # z0 is in no solution.
        return
    rows = np.flatnonzero(np.abs(T[:, 2 * n + 1]) < SMALL)
    s = T[rows, 2 * n + 1]
    if rows.size == 0 or s.min() >= 0.0:
        return
    others = (basic[rows] + n) % (2 * n)
    S = np.empty((rows.size, rows.size))
    for i in range(rows.size):
        for j in range(rows.size):
            S[i, j] = -T[rows[i], others[j]]
    unit = np.abs(s).max()
    y, status, _ = _lemke(S, s / unit, 1e-11, rebuild)
    value = T[:, 2 * n + 1] - T[:, others] @ (unit * y)
    z[:] = 0.0
    for k in range(n):
        if basic[k] >= n:
            z[basic[k] - n] = max(value[k], 0.0)
    for i in range(rows.size):
        if others[i] >= n:
            z[others[i] - n] = unit * y[i]


@njit(cache=True, inline="always")
def _search(M, b, z):
    """Looks for a solution mode by mode; fills z (n,), returns whether there is one."""
    n = b.size
    A, distance, size = np.zeros((2 * n, n)), np.zeros(2 * n), 0.0
    for i in range(n):
        length = 0.0
        for j in range(n):
            length += M[i, j] ** 2
        length = np.sqrt(length) if length > 0.0 else 1.0
        for j in range(n):
            A[i, j] = M[i, j] / length
        distance[i] = b[i] / length
        size = max(size, abs(distance[i]))
        A[n + i, i] = 1.0
    if not nearest_mode(A, distance, size, np.inf, z, NODES_MAX)[0] < np.inf:
        return False
    for i in range(n):
        w = distance[i]
        for j in range(n):
            w += A[i, j] * z[j]
        if w > z[i] or z[i] < 0.0:
            z[i] = 0.0
    return _violation(M, b, z) < 1e-9


@njit(cache=True)
def _lemke(M, b, tolerance, rebuild):
    """Lemke's method on w - M z - 1 z0 = b; returns z (n,), a status, and the basis
    (n,): the column of each row, see _fill.

    rebuild: number of pivots after which the tableau is computed anew; 0: never.
    """
    n = b.size
    T = np.empty((n, 2 * n + 2))
    basic = np.arange(n)
    z0, rhs = 2 * n, 2 * n + 1
    _fill(T, M, b)
    # z0 enters for the most negative b; of equal ones the last, which is the
    # lexicographically smallest row of [b, I].
    row = n - 1  # Literal integers would each compile what they are passed to.
    for i in range(n - 2, -1, -1):
        if b[i] < b[row]:
            row = i
    z = np.zeros(n)
    entering = z0
    for pivots in range(1, 50 * (n + 1)):
        leaving = basic[row]
        _pivot(T, row, entering)
        basic[row] = entering
        if leaving == z0:
            _read(T, M, b, basic, z)
            return z, SOLVED, basic
        entering = leaving + n if leaving < n else leaving - n
        if rebuild and pivots % rebuild == 0 and not _rebuild(T, M, b, basic):
            return z, NOT_PRECISE, basic
        row = _lexicographic_row(T, entering, basic, z0, rhs, tolerance)
        if row < 0:
            for i in range(n):  # A tie that rounding has hidden: z0 is gone.
                if basic[i] == z0 and abs(T[i, rhs]) < 1e-11:
                    _read(T, M, b, basic, z)
                    return z, SOLVED, basic
            return z, NO_SOLUTION, basic
    return z, NOT_PRECISE, basic


@njit(cache=True)
def _fill(T, M, b):
    """The first tableau; columns: w (n; these hold the basis inverse), z (n), z0,
    right-hand side."""
    n = b.size
    T[:] = 0.0
    for i in range(n):
        T[i, i] = 1.0
        for j in range(n):
            T[i, n + j] = -M[i, j]
        T[i, 2 * n] = -1.0
        T[i, 2 * n + 1] = b[i]


@njit(cache=True)
def _rebuild(T, M, b, basic):
    """The tableau of a basis from the problem's own numbers, with complete pivoting;
    the rows change places. False if the basis is singular."""
    n = b.size
    _fill(T, M, b)
    columns = basic.copy()
    for k in range(n):  # columns[k:] are left, and the rows whose basic is -1.
        basic[k] = -1
    for k in range(n):
        largest, row, at = 1e-14, -n, -n
        for j in range(k, n):
            for i in range(n):
                if basic[i] < 0 and abs(T[i, columns[j]]) > largest:
                    largest, row, at = abs(T[i, columns[j]]), i, j
        if row < 0:
            return False
        _pivot(T, row, columns[at])
        basic[row] = columns[at]
        columns[at], columns[k] = columns[k], columns[at]
    return True


@njit(cache=True)
def _pivot(T, row, column):
    """Makes column of T a unit vector with its one in row."""
    T[row] /= T[row, column]
    for i in range(T.shape[0]):
        if i != row:
            factor = T[i, column]
            if factor != 0.0:
                for j in range(T.shape[1]):
                    T[i, j] -= factor * T[row, j]
                T[i, column] = 0.0


@njit(cache=True)
def _lexicographic_row(T, entering, basic, z0, rhs, tolerance):
    """The row whose [rhs, basis inverse] / pivot is smallest; -1 if nothing bounds."""
    n = T.shape[0]
    tied = np.zeros(n, np.bool_)
    n_tied = 0
    for i in range(n):
        if T[i, entering] > tolerance:
            tied[i] = True
            n_tied += 1
    if n_tied == 0:
        return -1
    for k in range(n + 1):
        column = rhs if k == 0 else k - 1
        smallest = np.inf
        for i in range(n):
            if tied[i]:
                smallest = min(smallest, T[i, column] / T[i, entering])
        for i in range(n):
            if tied[i]:
                gap = T[i, column] / T[i, entering] - smallest
                if gap > 1e-12 * (1.0 + abs(smallest)):
                    tied[i] = False
                    n_tied -= 1
        if k == 0:
            for i in range(n):  # z0 may leave: that is the solution.
                if tied[i] and basic[i] == z0:
                    return i
        if n_tied == 1:
            break
    for i in range(n):
        if tied[i]:
            return i
    return -1


@njit(cache=True)
def _read(T, M, b, basic, z):
    """z (n,) of the final basis, with the pivots' rounding refined away."""
    n = b.size
    value = T[:, 2 * n + 1].copy()
    residual = np.empty(n)
    for _ in range(2):
        residual[:] = b
        for k in range(n):
            if basic[k] < n:
                residual[basic[k]] -= value[k]
            else:
                residual += M[:, basic[k] - n] * value[k]
        for i in range(n):
            for j in range(n):
                value[i] += T[i, j] * residual[j]
    for k in range(n):
        if basic[k] >= n:
            z[basic[k] - n] = max(value[k], 0.0)


@njit(cache=True)
def _violation(M, b, z):
    """Largest breach of w >= 0 and of w z = 0, each row's beside its own terms.

    A force counts with at most Z_SCALE_MAX: beside forces without bound any breach
    would be small. Rows that share a sliding speed (a column with zero on the diagonal)
    have its unit, and the largest of their scales. A force is zero where no row would
    notice if it were.
    """
    n, worst = b.size, 0.0
    w, terms = b.copy(), np.abs(b)
    for i in range(n):
        for j in range(n):
            w[i] += M[i, j] * z[j]
            terms[i] += abs(M[i, j]) * min(z[j], Z_SCALE_MAX)
        if not np.isfinite(w[i]):
            return np.inf  # Comparisons with what is not a number are all false.
    size = np.maximum(terms, ROW_MIN)
    for j in range(n):
        if M[j, j] == 0.0:
            shared = 0.0
            for i in range(n):
                shared = max(shared, min(abs(M[i, j]), 1.0) * terms[i])
            for i in range(n):
                size[i] = max(size[i], min(abs(M[i, j]), 1.0) * shared)
    for i in range(n):
        breach = abs(w[i])
        if w[i] > 0.0 and breach > worst * size[i]:
            noticed = 0.0
            for k in range(n):
                noticed = max(noticed, abs(M[k, i]) * z[i] / size[k])
            breach = min(breach, noticed * size[i])
        if breach > worst * size[i]:
            worst = breach / size[i]
    return worst
