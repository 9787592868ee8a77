"""The three projections of C3: onto  0 <= lam  perp  s = E x + F lam + H u + c >= 0.

Each takes z (N, n_z), the QP's plan plus its scaled multiplier, and gives for each knot
the delta near it (nearness in the weight U) that obeys the complementarity, or nearly:

    PlusProjection   C3+: z = [x, lam, u, eta], eta stands for s. Elementwise.
    QpProjection     C3 : z = [x, lam, u]. A convex QP; leaves some lam * s.
    ExactProjection  C3 : z = [x, lam, u]. The nearest point of the set, by branch and
                     bound over the 2^n_lam contact modes.

Source: Aydinoglu, Wei, Huang, Posa, "Consensus complementarity control" (C3),
arXiv:2304.11259, section IV; docs/c3.md for C3+.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.numerics.lcp import SOLVED, solve_lcp_kernel


@dataclass
class PlusProjection:
    """C3+: keep the larger of lam and eta (each weighed by sqrt of its U)."""


@dataclass
class QpProjection:
    """C3 with a convex QP: forces shrink towards alpha times their value."""

    alpha: float = 0.01  # Share of F that pulls lam to its value, in (0, 1].


@dataclass
class ExactProjection:
    """C3 with the exact, mixed-integer projection (no bound on lam: no big M)."""


Projection = PlusProjection | QpProjection | ExactProjection


def project(projection: Projection, z, U, lcs, matrices, delta) -> bool:
    """Fills delta (N, n_z) with the projection of each knot of z (N, n_z).

    Args:
        U: (n_z,) diagonal weight. lcs: (E, F, H, c). matrices: projection_matrices of
            them, which C3+ does not need.
    Returns: False if a knot's projection failed.
    """
    E, F, H, c = lcs
    if isinstance(projection, PlusProjection):
        project_plus(z, U, E.shape[1], E.shape[0], delta)
        return True
    V, K = matrices
    if isinstance(projection, QpProjection):
        return project_qp(z, projection.alpha, E, F, H, c, V, K, delta)
    return project_exact(z, U, E, F, H, c, V, K, delta)


@njit(cache=True)
def project_plus(z, U, n_x, n_lam, delta):
    """delta (N, n_z) of z (N, n_z) = [x, lam, u, eta]; U (n_z,)."""
    n_eta = U.size - n_lam
    delta[:] = z
    for k in range(len(z)):
        for i in range(n_lam):
            lam, eta = z[k, n_x + i], z[k, n_eta + i]
            if np.sqrt(U[n_eta + i]) * eta > np.sqrt(U[n_x + i]) * lam:
                delta[k, n_x + i], delta[k, n_eta + i] = 0.0, max(eta, 0.0)
            else:
                delta[k, n_x + i], delta[k, n_eta + i] = max(lam, 0.0), 0.0


@njit(cache=True)
def projection_matrices(U, E, F, H):
    """What the two C3 projections need of the LCS, once per solve.

    With y = [x, u], J = [E H] and W the weights of y: V = W^-1 J' (n_y, n_lam) and
    K = J W^-1 J' (n_lam, n_lam). An entry of y without weight does not move; J must be
    zero there.
    """
    n_lam, n_x = E.shape
    n_u = H.shape[1]
    V, K = np.zeros((n_x + n_u, n_lam)), np.zeros((n_lam, n_lam))
    for j in range(n_x + n_u):
        weight = U[j] if j < n_x else U[j + n_lam]
        if weight > 0.0:
            for i in range(n_lam):
                V[j, i] = (E[i, j] if j < n_x else H[i, j - n_x]) / weight
    for i in range(n_lam):
        for j in range(n_lam):
            for m in range(n_x):
                K[i, j] += E[i, m] * V[m, j]
            for m in range(n_u):
                K[i, j] += H[i, m] * V[n_x + m, j]
    return V, K


@njit(cache=True)
def _gap(z, E, H, c):
    """s without its contact force: E x + H u + c."""
    n_lam, n_x = E.shape
    s = c.copy()
    for i in range(n_lam):
        for m in range(n_x):
            s[i] += E[i, m] * z[m]
        for m in range(H.shape[1]):
            s[i] += H[i, m] * z[n_x + n_lam + m]
    return s


@njit(cache=True)
def project_qp(z, alpha, E, F, H, c, V, K, delta):
    """delta (N, n_z), of each knot [y, lam] the minimiser over lam >= 0, s >= 0 of

        1/2 |y - z_y|^2_W + 1/2 lam' F lam - alpha z_lam' F lam.

    Its optimality conditions are an LCP in mu, the multiplier of s, and lam:
    y = z_y + W^-1 J' mu;  0 <= mu perp K mu + F lam + J z_y + c >= 0;
    0 <= lam perp -F' mu + (F + F')/2 lam - alpha F' z_lam >= 0.

    Returns: whether the LCP had a solution.
    """
    n_lam, n_x = E.shape
    n_u = H.shape[1]
    M, q = np.empty((2 * n_lam, 2 * n_lam)), np.empty(2 * n_lam)
    for k in range(len(z)):
        q[:n_lam] = _gap(z[k], E, H, c)
        for i in range(n_lam):
            total = 0.0
            for j in range(n_lam):
                total += F[j, i] * z[k, n_x + j]
                M[i, j] = K[i, j]
                M[i, n_lam + j] = F[i, j]
                M[n_lam + i, j] = -F[j, i]
                M[n_lam + i, n_lam + j] = 0.5 * (F[i, j] + F[j, i])
            q[n_lam + i] = -alpha * total
        mu_lam, status = solve_lcp_kernel(M, q)
        if status != SOLVED:
            return False
        delta[k] = z[k]
        for j in range(n_x + n_u):
            at = j if j < n_x else j + n_lam
            for i in range(n_lam):
                delta[k, at] += V[j, i] * mu_lam[i]
        delta[k, n_x : n_x + n_lam] = mu_lam[n_lam:]
    return True


@njit(cache=True)
def project_exact(z, U, E, F, H, c, V, K, delta):
    """delta (N, n_z): the nearest point to each knot in the weight U that obeys the
    complementarity 0 <= lam perp s >= 0.

    Branch and bound: a node has decided lam_i = 0 or s_i = 0 for some i and asks only
    lam_i >= 0, s_i >= 0 of the others, a convex QP whose optimum bounds what lies
    below it. Each such QP is solved exactly, as the LCP of its multipliers.

    Returns: whether it succeeded (False: an LCP was not solved).
    """
    n_lam, n_x = E.shape
    n_u = H.shape[1]
    U_lam = U[n_x : n_x + n_lam]
    for knot in range(len(z)):
        z_lam, gap = z[knot, n_x : n_x + n_lam], _gap(z[knot], E, H, c)
        scale = np.empty(n_lam)  # s / scale is a distance in the weight U.
        for i in range(n_lam):
            total = K[i, i]
            for j in range(n_lam):
                total += F[i, j] ** 2 / U_lam[j]
            scale[i] = np.sqrt(total) if total > 0.0 else 1.0
        size = 1.0
        for i in range(n_lam):
            size = max(size, abs(gap[i]) / scale[i], np.sqrt(U_lam[i]) * abs(z_lam[i]))
        # Modes: 0 undecided, 1 lam_i = 0, 2 s_i = 0. Depth first: two per level.
        stack = np.zeros((n_lam + 2, n_lam), np.int64)
        depth, best = 1, np.inf
        lam, slack = np.empty(n_lam), np.empty(n_lam)
        multiplier = np.empty(n_lam)
        while depth > 0:
            depth -= 1
            mode = stack[depth].copy()
            cost = _solve_node(
                mode, z_lam, U_lam, gap, F, K, lam, slack, multiplier, best
            )
            if cost == -1.0:
                return False
            if not cost < best - 1e-12 * size * size:
                continue
            branch, worst = -1, 1e-9 * size
            for i in range(n_lam):
                if mode[i] == 0:
                    both = min(np.sqrt(U_lam[i]) * lam[i], slack[i] / scale[i])
                    if both > worst:
                        branch, worst = i, both
            if branch < 0:
                best = cost
                delta[knot] = z[knot]
                for j in range(n_x + n_u):
                    at = j if j < n_x else j + n_lam
                    for i in range(n_lam):
                        delta[knot, at] += V[j, i] * multiplier[i]
                for i in range(n_lam):
                    open_gap = slack[i] / scale[i] > np.sqrt(U_lam[i]) * lam[i]
                    delta[knot, n_x + i] = 0.0 if open_gap else lam[i]
                continue
            first = (
                2
                if np.sqrt(U_lam[branch]) * lam[branch]
                > (slack[branch] / scale[branch])
                else 1
            )
            stack[depth] = mode
            stack[depth, branch] = 3 - first  # The less likely one waits below.
            stack[depth + 1] = mode
            stack[depth + 1, branch] = first
            depth += 2
        if best == np.inf:
            return False
    return True


@njit(cache=True)
def _solve_node(mode, z_lam, U_lam, gap, F, K, lam, slack, multiplier, best):
    """One node's QP: fills lam, slack, multiplier (of s); returns its optimum.

    inf where the node holds no point, -1 where the LCP was not solved.

    Rows: s_i >= 0 for all i; lam_i >= 0 unless lam_i = 0 was decided (then it is no
    variable); -s_i >= 0 where s_i = 0 was decided. The multipliers of these rows solve
    an LCP with the Gram matrix of the rows in the inverse weight.
    """
    n = z_lam.size
    free, closed = np.flatnonzero(mode != 1), np.flatnonzero(mode == 2)
    n_f, n_c = free.size, closed.size
    size = n + n_f + n_c
    M, q = np.empty((size, size)), np.empty(size)
    for i in range(n):
        q[i] = gap[i]
        for a in range(n_f):
            j = free[a]
            q[i] += F[i, j] * z_lam[j]
            M[i, n + a] = M[n + a, i] = F[i, j] / U_lam[j]
        for k in range(n):
            M[i, k] = K[i, k]
            for a in range(n_f):
                j = free[a]
                M[i, k] += F[i, j] * F[k, j] / U_lam[j]
    for a in range(n_f):
        q[n + a] = z_lam[free[a]]
        for b in range(n_f):
            M[n + a, n + b] = 0.0
        M[n + a, n + a] = 1.0 / U_lam[free[a]]
    for a in range(n_c):
        row = n + n_f + a
        q[row] = -q[closed[a]]
        for j in range(n + n_f):
            M[row, j] = M[j, row] = -M[closed[a], j]
    for a in range(n_c):
        for b in range(n_c):
            M[n + n_f + a, n + n_f + b] = M[closed[a], closed[b]]
    mu, status = solve_lcp_kernel(M, q)
    if status == 1:
        return np.inf
    if status != SOLVED:
        return -1.0
    cost = 0.0
    for i in range(n):
        multiplier[i] = mu[i]
        lam[i] = 0.0
        if mode[i] == 1:
            cost += U_lam[i] * z_lam[i] ** 2
    for a in range(n_c):
        multiplier[closed[a]] -= mu[n + n_f + a]
    for a in range(n_f):
        j = free[a]
        step = mu[n + a]
        for i in range(n):
            step += F[i, j] * multiplier[i]
        step /= U_lam[j]
        lam[j] = max(z_lam[j] + step, 0.0)
        cost += U_lam[j] * step**2
    for i in range(n):
        slack[i] = gap[i]
        for j in range(n):
            slack[i] += K[i, j] * multiplier[j] + F[i, j] * lam[j]
            cost += multiplier[i] * K[i, j] * multiplier[j]
    return cost
