"""Polishing a plan: less cost on the LCS itself, whose contact forces are exact.

ADMM's inputs come from a relaxed problem. Here they are rolled out through the LCS,
with each knot's LCP solved exactly, and improved. As long as no contact opens or closes
the rollout is affine in the inputs: with S the rows that push (lam > 0),

    lam_S = -F_SS^-1 (E_S x + H_S u + c_S),
    dx_next = (A - D_S F_SS^-1 E_S) dx + (B - D_S F_SS^-1 H_S) du

so a backward pass gives the gradient of the cost (the adjoint) and, with the curvature,
the minimiser within the present modes (a Newton step, as in differential dynamic
programming). A line search rolls it out with the modes that really follow, and keeps
what costs less. Inputs stay within their bounds; what breaches bounds of the state more
than before is not kept.

Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming",
ICRA 2014; the derivative of an LCP through its active set: Cottle, Pang, Stone, "The
Linear Complementarity Problem", section 7.2.
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.lcp import SOLVED, solve_lcp_kernel

# A relative gain below this ends the polish.
GAIN = 1e-6
# The shortest step of a line search, as a share of the Newton step.
SHORTEST = 1e-3
# Of a breach of a state's bound, over the largest weight of the cost.
PENALTY = 1e3


@njit(cache=True)
def contact_forces(F, q, pushing, lam):
    """Fills lam (n,) with the LCP's solution and pushing (n,) with its rows lam > 0.

    pushing says which rows to try first: as a rule those of the last rollout are right,
    and one small linear system tells. Returns: whether there is a solution.
    """
    n = q.size
    on = np.flatnonzero(pushing)
    M, b = np.empty((on.size, on.size)), np.empty((on.size, 1))
    size = 0.0
    for i in range(n):
        size = max(size, abs(q[i]))
    for a in range(on.size):
        b[a, 0] = -q[on[a]]
        for c in range(on.size):
            M[a, c] = F[on[a], on[c]]
    good = solve_small(M, b)
    lam[:] = 0.0
    for a in range(on.size):
        good = good and b[a, 0] >= 0.0
        lam[on[a]] = b[a, 0]
    for i in range(n):
        if not good:
            break
        w = q[i]
        for a in range(on.size):
            w += F[i, on[a]] * lam[on[a]]
        good = abs(w) <= 1e-11 * size if pushing[i] else w >= -1e-12 * size
    if not good:
        solution, status = solve_lcp_kernel(F, q)
        if status != SOLVED:
            return False
        lam[:] = solution
    for i in range(n):
        pushing[i] = lam[i] > 0.0
    return True


@njit(cache=True)
def solve_small(M, b):
    """Overwrites b (n, m) with M^-1 b and M with rubbish; False if M is singular."""
    n, m = b.shape
    largest = 0.0
    for i in range(n):
        largest = max(largest, abs(M[i, i]))
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(M[i, k]) > abs(M[pivot, k]):
                pivot = i
        if not abs(M[pivot, k]) > 1e-13 * largest:
            return False
        if pivot != k:
            for j in range(n):
                M[k, j], M[pivot, j] = M[pivot, j], M[k, j]
            for j in range(m):
                b[k, j], b[pivot, j] = b[pivot, j], b[k, j]
        for i in range(k + 1, n):
            f = M[i, k] / M[k, k]
            if f != 0.0:
                for j in range(k + 1, n):
                    M[i, j] -= f * M[k, j]
                for j in range(m):
                    b[i, j] -= f * b[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(m):
            for i in range(k + 1, n):
                b[k, j] -= M[k, i] * b[i, j]
            b[k, j] /= M[k, k]
    return True


@njit(cache=True)
def _affine(matrix, x, out):
    for i in range(out.size):
        for j in range(x.size):
            if matrix[i, j] != 0.0:
                out[i] += matrix[i, j] * x[j]


@njit(cache=True)
def roll_out(model, x0, plan, step, bounds, found):
    """Rolls out u = plan's u + step's correction, clipped to its bounds.

    Args:
        model: A, B, D, d, E, F, H, c, each (K, ...) with K = 1 or N.
        plan: x (N + 1, n_x), u (N, n_u) about which the step is taken.
        step: share, k (N, n_u), gain (N, n_u, n_x): u += share k + gain (x - plan x).
        bounds: u_lower, u_upper (n_u,).
        found: x, u, lam (N, n_lam), pushing (N, n_lam), overwritten (pushing: tried
            first).
    Returns: whether every LCP had a solution and all stayed finite.
    """
    A, B, D, d, E, F, H, c = model
    x_plan, u_plan = plan
    share, k_step, gain = step
    u_lower, u_upper = bounds
    x, u, lam, pushing = found
    K, (N, n_u) = len(A), u.shape
    dx, q = np.zeros(x0.size), np.empty(lam.shape[1])
    x[0] = x0
    for k in range(N):
        m = k % K
        for i in range(x0.size):
            dx[i] = x[k, i] - x_plan[k, i]
        for i in range(n_u):
            total = u_plan[k, i] + share * k_step[k, i]
            for j in range(x0.size):
                total += gain[k, i, j] * dx[j]
            u[k, i] = min(max(total, u_lower[i]), u_upper[i])
        q[:] = c[m]
        _affine(E[m], x[k], q)
        _affine(H[m], u[k], q)
        for number in q:
            if not np.isfinite(number):
                return False
        if not contact_forces(F[m], q, pushing[k], lam[k]):
            return False
        x[k + 1] = d[m]
        _affine(A[m], x[k], x[k + 1])
        _affine(B[m], u[k], x[k + 1])
        _affine(D[m], lam[k], x[k + 1])
    return np.isfinite(x[N]).all()


@njit(cache=True)
def rollout_cost(x, u, x_desired, u_centre, Q, R, Q_N):
    """sum |x - x_desired|^2_Q + |u - u_centre|^2_R, Q_N at the last state;
    Q (1 or N, n_x, n_x)."""
    total, N = 0.0, len(u)
    for k in range(N + 1):
        W = Q[k % len(Q)] if k < N else Q_N
        for i in range(x.shape[1]):
            e = x[k, i] - x_desired[k, i]
            if e != 0.0:
                for j in range(x.shape[1]):
                    total += e * W[i, j] * (x[k, j] - x_desired[k, j])
    for k in range(N):
        for i in range(u.shape[1]):
            for j in range(u.shape[1]):
                total += (
                    (u[k, i] - u_centre[k, i]) * R[i, j] * (u[k, j] - u_centre[k, j])
                )
    return total


@njit(cache=True)
def state_breach(x, lower, upper, weight):
    """The largest breach of the bounds of x_1 .. x_N, relative to 1 + the bound; and
    the penalty weight breach^2 summed over them."""
    worst, penalty = 0.0, 0.0
    for k in range(1, len(x)):
        for i in range(x.shape[1]):
            bound = lower[i] if x[k, i] < lower[i] else upper[i]
            breach = max(lower[i] - x[k, i], x[k, i] - upper[i])
            if breach > 0.0:
                worst = max(worst, breach / (1.0 + abs(bound)))
                penalty += weight * breach**2
    return worst, penalty


@njit(cache=True)
def _beyond(x, lower, upper):
    """How far x is above upper, or below lower (negative)."""
    return max(x - upper, 0.0) - max(lower - x, 0.0)


@njit(cache=True)
def backward(model, x, u, pushing, x_desired, u_centre, weights, bounds, found):
    """Gradient and Newton step of the rollout's cost, in the modes that it has.

    Args: as of roll_out and rollout_cost; weights: Q, R, Q_N and the penalty of a
        breached state; bounds: u_lower, u_upper, x_lower, x_upper; found: gradient
        (N, n_u), k_step (N, n_u), gain (N, n_u, n_x), overwritten.
    Returns: the decrease that the step promises (within the modes), inf on failure.
    """
    A, B, D, _, E, F, H, _ = model
    Q, R, Q_N, penalty = weights
    u_lower, u_upper, x_lower, x_upper = bounds
    gradient, k_step, gain = found
    K, (N, n_u), n_x = len(A), u.shape, x.shape[1]
    # Adjoint (of the gradient) and cost to go 1/2 dx'P dx + p'dx (of the step).
    adjoint, p, P = np.zeros(n_x), np.zeros(n_x), 2.0 * Q_N
    for i in range(n_x):
        for j in range(n_x):
            adjoint[i] += 2.0 * Q_N[i, j] * (x[N, j] - x_desired[N, j])
        beyond = _beyond(x[N, i], x_lower[i], x_upper[i])
        if beyond != 0.0:
            adjoint[i] += 2.0 * penalty * beyond
            P[i, i] += 2.0 * penalty
    p[:] = adjoint
    promise = 0.0
    n = n_x + n_u
    for k in range(N - 1, -1, -1):
        m = k % K
        on = np.flatnonzero(pushing[k])
        # J = [A B] - D_S F_SS^-1 [E_S H_S].
        J = np.empty((n_x, n))
        J[:, :n_x], J[:, n_x:] = A[m], B[m]
        M, X = np.empty((on.size, on.size)), np.empty((on.size, n))
        for a in range(on.size):
            for b in range(on.size):
                M[a, b] = F[m, on[a], on[b]]
            X[a, :n_x], X[a, n_x:] = E[m, on[a]], H[m, on[a]]
        if not solve_small(M, X):
            return np.inf
        for i in range(n_x):
            for a in range(on.size):
                f = D[m, i, on[a]]
                if f != 0.0:
                    for j in range(n):
                        J[i, j] -= f * X[a, j]
        PJ, W, g, a_next = (
            np.zeros((n_x, n)),
            np.zeros((n, n)),
            np.zeros(n),
            np.zeros(n),
        )
        for i in range(n_x):
            for j in range(n_x):
                f = P[i, j]
                if f != 0.0:
                    for b in range(n):
                        PJ[i, b] += f * J[j, b]
        for i in range(n_x):
            for a in range(n):
                f = J[i, a]
                if f != 0.0:
                    g[a] += f * p[i]
                    a_next[a] += f * adjoint[i]
                    for b in range(n):
                        W[a, b] += f * PJ[i, b]
        for i in range(n_x):
            for j in range(n_x):
                weight = 2.0 * Q[k % len(Q), i, j]
                e = weight * (x[k, j] - x_desired[k, j])
                g[i] += e
                a_next[i] += e
                W[i, j] += weight
            beyond = _beyond(x[k, i], x_lower[i], x_upper[i]) if k > 0 else 0.0
            if beyond != 0.0:
                g[i] += 2.0 * penalty * beyond
                a_next[i] += 2.0 * penalty * beyond
                W[i, i] += 2.0 * penalty
        for i in range(n_u):
            for j in range(n_u):
                e = 2.0 * R[i, j] * (u[k, j] - u_centre[k, j])
                g[n_x + i] += e
                a_next[n_x + i] += e
                W[n_x + i, n_x + j] += 2.0 * R[i, j]
        adjoint[:] = a_next[:n_x]
        gradient[k] = a_next[n_x:]
        # Inputs at a bound that the gradient pushes them through do not move.
        k_step[k], gain[k] = 0.0, 0.0
        free = np.empty(n_u, np.int64)
        n_free = 0
        for i in range(n_u):
            f = g[n_x + i]
            low = u[k, i] <= u_lower[i] and f > 0.0
            if not (low or (u[k, i] >= u_upper[i] and f < 0.0)):
                free[n_free] = i
                n_free += 1
        H_u, rhs = np.empty((n_free, n_free)), np.empty((n_free, n_x + 1))
        for a in range(n_free):
            i = n_x + free[a]
            rhs[a, 0] = -g[i]
            for b in range(n_free):
                H_u[a, b] = W[i, n_x + free[b]]
            for j in range(n_x):
                rhs[a, 1 + j] = -W[i, j]
        if not solve_small(H_u, rhs):
            return np.inf
        for a in range(n_free):
            k_step[k, free[a]] = rhs[a, 0]
            gain[k, free[a]] = rhs[a, 1:]
            promise -= 0.5 * g[n_x + free[a]] * rhs[a, 0]
        p[:] = g[:n_x]
        P = W[:n_x, :n_x].copy()
        for a in range(n_free):
            i = n_x + free[a]
            for r in range(n_x):
                f = W[r, i]
                p[r] += f * rhs[a, 0]
                for j in range(n_x):
                    P[r, j] += f * rhs[a, 1 + j]
        for i in range(n_x):
            for j in range(i):
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    return promise


@njit(cache=True)
def polish(model, x0, starts, x_desired, u_centre, weights, bounds, evaluations):
    """The cheapest of some plans, made cheaper.

    Args:
        starts: (n, N, n_u) inputs, such as the iterates of ADMM; each costs a rollout.
        bounds: u_lower, u_upper, x_lower, x_upper.
        evaluations: rollouts that the improvement may take. The cheapest start is
            improved first; where its modes hold no more, the next one is.

    Returns: x (N + 1, n_x), u (N, n_u), lam (N, n_lam), cost; cost is inf where no
        start could be rolled out. It never exceeds that of a start, nor is the breach
        of the state bounds larger than that of the start with the least.
    """
    u_lower, u_upper, x_lower, x_upper = bounds
    u_bounds = u_lower, u_upper
    (n, N, n_u), n_x, n_lam = starts.shape, x0.size, model[7].shape[1]
    Q, R, Q_N = weights
    penalty = PENALTY * max(np.abs(Q).max(), np.abs(R).max())
    all_weights = Q, R, Q_N, penalty
    xs, us = np.zeros((n, N + 1, n_x)), np.zeros((n, N, n_u))
    lams, modes = np.zeros((n, N, n_lam)), np.zeros((n, N, n_lam), np.bool_)
    x, u = np.zeros((N + 1, n_x)), np.zeros((N, n_u))
    lam, pushing = np.zeros((N, n_lam)), np.zeros((N, n_lam), np.bool_)
    k_step, gain = np.zeros((N, n_u)), np.zeros((N, n_u, n_x))
    gradient = np.zeros((N, n_u))
    costs, breaches = np.full(n, np.inf), np.full(n, np.inf)
    for i in range(n):
        step = 0.0, k_step, gain
        if i > 0:
            modes[i] = modes[i - 1]
        found = xs[i], us[i], lams[i], modes[i]
        if roll_out(model, x0, (xs[i], starts[i]), step, u_bounds, found):
            breaches[i], extra = state_breach(xs[i], x_lower, x_upper, penalty)
            costs[i] = extra + rollout_cost(
                xs[i], us[i], x_desired, u_centre, Q, R, Q_N
            )
    least = max(breaches.min(), 1e-6) if n > 0 else np.inf
    for i in range(n):
        if breaches[i] > least:
            costs[i] = np.inf
    best, best_cost, used = 0, np.inf, 0
    for i in np.argsort(costs):
        if not costs[i] < np.inf:
            break
        share = 0.0
        pushing[:] = modes[i]
        while used < evaluations:
            if share == 0.0:
                promise = backward(
                    model, xs[i], us[i], modes[i], x_desired, u_centre, all_weights,
                    bounds, (gradient, k_step, gain),
                )  # fmt: skip
                if not GAIN * costs[i] < promise < np.inf:
                    break
                share = 1.0
            used += 1
            step = share, k_step, gain
            better = roll_out(
                model, x0, (xs[i], us[i]), step, u_bounds, (x, u, lam, pushing)
            )
            if better:
                breach, extra = state_breach(x, x_lower, x_upper, penalty)
                c = extra + rollout_cost(x, u, x_desired, u_centre, Q, R, Q_N)
                better = c < costs[i] and breach <= max(breaches[i], 1e-6)
            if better:
                costs[i], breaches[i], share = c, breach, 0.0
                xs[i], us[i], lams[i], modes[i] = x, u, lam, pushing
            else:
                share *= 0.3
                if share < SHORTEST:
                    break
        if costs[i] < best_cost:
            best, best_cost = i, costs[i]
    return xs[best], us[best], lams[best], best_cost
