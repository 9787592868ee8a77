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

from makebreak.systems.contact_mpc.numerics.lcp import SOLVED, solve_lcp_kernel
from makebreak.systems.contact_mpc.numerics.nearest_point import nearest_mode


@dataclass
class PlusProjection:
    """C3+: keep the larger of lam and eta (each weighed by sqrt of its U)."""


@dataclass
class QpProjection:
    """C3 with a convex QP: forces shrink towards alpha times their value."""

    alpha: float = 0.01  # Share of F that pulls lam to its value, in (0, 1].


@dataclass
class ExactProjection:
    """C3 with the exact, mixed-integer projection (no bound on lam: no big M).

    The search is exponential in the worst case: a knot's takes tens of nodes with 16
    forces, thousands with 32. Where nodes_max are used up, the nearest point found so
    far is taken, which obeys the complementarity too; Plan.cut_projections counts them.
    """

    nodes_max: int = 1000


FAILED = -1
Projection = PlusProjection | QpProjection | ExactProjection


def project(projection: Projection, z, U, lcs, matrices, delta) -> int:
    """Fills delta (N, n_z) with the projection of each knot of z (N, n_z).

    Args:
        U: (n_z,) diagonal weight. lcs: (E, F, H, c). matrices: projection_matrices of
            them, which C3+ does not need.
    Returns: for how many knots the search was cut short; FAILED if a projection failed.
    """
    E, F, H, c = lcs
    if isinstance(projection, PlusProjection):
        project_plus(z, U, E.shape[1], E.shape[0], delta)
        return 0
    if isinstance(projection, QpProjection):
        V, K = matrices
        solved = project_qp(z, projection.alpha, E, F, H, c, V, K, delta)
        return 0 if solved else FAILED
    return project_exact(z, U, E, F, H, c, projection.nodes_max, delta)


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
def project_exact(z, U, E, F, H, c, nodes_max, delta):
    """delta (N, n_z): the nearest point to each knot in the weight U that obeys the
    complementarity 0 <= lam perp s >= 0.

    Branch and bound: a node has decided lam_i = 0 or s_i = 0 for some i and asks only
    lam_i >= 0, s_i >= 0 of the others, a convex QP whose optimum bounds what lies
    below it.

    Returns: for how many knots nodes_max nodes did not prove the point found to be the
        nearest; FAILED where no point obeys it, or rounding was too much.
    """
    n_lam, n_x = E.shape
    n_u = H.shape[1]
    n_y = n_x + n_u
    # In root = sqrt(weight) times the move v from z, nearness is the plain length.
    # Columns: y = [x, u], then lam. Rows: s_i, then lam_i, each of length one.
    root, A = np.zeros(n_y + n_lam), np.zeros((2 * n_lam, n_y + n_lam))
    unit = np.ones(2 * n_lam)
    for j in range(n_y + n_lam):
        weight = U[j] if j < n_x else (U[j + n_lam] if j < n_y else U[j - n_u])
        root[j] = np.sqrt(weight)
        if weight > 0.0:
            for i in range(n_lam):
                if j < n_x:
                    A[i, j] = E[i, j] / root[j]
                elif j < n_y:
                    A[i, j] = H[i, j - n_x] / root[j]
                else:
                    A[i, j] = F[i, j - n_y] / root[j]
    for i in range(n_lam):
        A[n_lam + i, n_y + i] = 1.0
        length = 0.0
        for j in range(n_y + n_lam):
            length += A[i, j] ** 2
        if length > 0.0:
            unit[i] = np.sqrt(length)
            A[i] /= unit[i]
        unit[n_lam + i] = 1.0 / root[n_y + i]
    b, v, cut = np.empty(2 * n_lam), np.empty(n_y + n_lam), 0
    for knot in range(len(z)):
        gap = _gap(z[knot], E, H, c)
        size = 0.0
        for i in range(n_lam):
            for j in range(n_lam):
                gap[i] += F[i, j] * z[knot, n_x + j]
            b[i] = gap[i] / unit[i]
            b[n_lam + i] = z[knot, n_x + i] / unit[n_lam + i]
            size = max(size, abs(b[i]), abs(b[n_lam + i]))
        best, ended = nearest_mode(A, b, size, -1.0, v, nodes_max)
        if not (ended or best < np.inf):  # A point that obeys it is needed in any case.
            best, ended = nearest_mode(A, b, size, np.inf, v, 100 * nodes_max)
            ended = False
        if not best < np.inf:
            return FAILED
        cut += 0 if ended else 1
        for j in range(n_y + n_lam):
            at = j if j < n_x else (j + n_lam if j < n_y else j - n_u)
            move = v[j] / root[j] if root[j] > 0.0 else 0.0
            delta[knot, at] = z[knot, at] + move
        for i in range(n_lam):
            s, lam = b[i], b[n_lam + i] + v[n_y + i]
            for j in range(n_y + n_lam):
                s += A[i, j] * v[j]
            if s > lam or delta[knot, n_x + i] < 0.0:
                delta[knot, n_x + i] = 0.0
    return cut
