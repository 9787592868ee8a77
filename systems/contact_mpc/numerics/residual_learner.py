"""Residual learning: bends the contact equation of an LCS until it explains the data.

One measured step (x, u, x_next) costs, under the residual r on the gap velocity,

    l(r) = min over lam, eta >= 0 of
           1/2 |D lam + z|^2_Qd + 1/eps (lam'eta + 1/(2 gamma) |q + F lam + r - eta|^2)
    z = A x + B u + d - x_next,    q = E x + H u + c.

For 0 < gamma < sigma_min(F + F') this is a strictly convex QP in (lam, eta). For a
given lam the best eta is max(0, s - gamma lam), s = q + F lam + r, and that leaves a
convex, piecewise quadratic problem in lam alone. By the envelope theorem

    dl/dr = 1/(eps gamma) (s - eta) = 1/eps min(lam, s/gamma),

so eps dl/dr is a force in newtons: the contact force that the data asks for and the
contact equation does not allow (> 0), or the reverse (< 0).

Units: lam [N], eta, q, r [m/s], gamma [m/s per N], eps [(m/s N) per unit of the
weighted squared error]. With lam as an impulse, lam_impulse = dt lam, the same loss has
gamma_impulse = gamma / dt and eps_impulse = eps dt.

Source: Huang, Aydinoglu, Jin, Posa, "Adaptive contact-implicit model predictive control
with online residual learning" (ACI-MPC), section VI, algorithm 1; Adam: Kingma, Ba,
"Adam: a method for stochastic optimization", algorithm 1.
"""

from dataclasses import dataclass, fields

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.lcs import LCS, opening_speed

# Gradients (times eps) below this are round-off, and Adam would follow even those [N].
FORCE_FLOOR = 1e-9
ADAM_EPSILON = 1e-8  # Keeps Adam's quotient finite [N].
AT_ONCE = 20  # Rounds of the active set, and four more an entry, before single changes.
ROUNDING = 1e-9  # Of the largest entry.


@dataclass(frozen=True, eq=False)
class Buffer:
    """What the last n measured steps contribute to the loss, each with its own LCS.

    A step's loss is constant + 1/eps (1/2 lam'P lam + p'lam + the part with eta).
    """

    P: np.ndarray  # (n, n_lam, n_lam) eps D'Qd D.
    p: np.ndarray  # (n, n_lam) eps D'Qd z.
    F: np.ndarray  # (n, n_lam, n_lam) [m/s per N].
    q: np.ndarray  # (n, n_lam) [m/s].
    constant: np.ndarray  # (n,) 1/2 z'Qd z.

    def __post_init__(self):
        for field in fields(self):
            getattr(self, field.name).setflags(write=False)

    def __deepcopy__(self, memo):
        return self  # Nothing in it can change, so a copy is the same object.

    def __len__(self) -> int:
        return self.constant.size

    def is_finite(self) -> bool:
        return all(np.isfinite(getattr(self, f.name)).all() for f in fields(self))

    def append(self, newest: "Buffer", n_b: int) -> "Buffer":
        """This buffer and the newest steps, of which the last n_b are kept."""
        pairs = [(getattr(self, f.name), getattr(newest, f.name)) for f in fields(self)]
        return Buffer(*(np.concatenate(pair)[-n_b:] for pair in pairs))


def empty_buffer(n_lam: int) -> Buffer:
    """A buffer without steps, for contact forces of size n_lam."""
    shapes = [(0, n_lam, n_lam), (0, n_lam), (0, n_lam, n_lam), (0, n_lam), (0,)]
    return Buffer(*(np.zeros(shape) for shape in shapes))


def measured_step(lcs: LCS, x, u, x_next, Q_d, eps, slip_noise=np.inf) -> Buffer:
    """A buffer of one step: from x (n_x,) under u (n_u,) to x_next (n_x,).

    Args: Q_d (n_x,) diagonal weights of the one-step error; eps as in the module;
        slip_noise, of opening_speed.
    """
    z = lcs.A @ x + lcs.B @ u + lcs.d - x_next
    q = lcs.E @ x + lcs.H @ u + lcs.c + opening_speed(lcs, x_next, slip_noise)
    weighted = lcs.D.T * (eps * np.asarray(Q_d))
    P, p = weighted @ lcs.D, weighted @ z
    constant = np.array([0.5 * z @ (Q_d * z)])
    return Buffer(P[None], p[None], lcs.F[None].copy(), q[None], constant)


def gamma_bound(F) -> float:
    """What gamma must stay below for F (n_lam, n_lam): the smallest eigenvalue of
    F + F', which is its smallest singular value if F is positive semi-definite."""
    return float(np.linalg.eigvalsh(F + F.T)[0])


def violation_loss(steps: Buffer, r, eps, gamma):
    """Loss of each step under the residual r, and its gradient in r.

    Args: steps (n of them); r (n_lam,) [m/s]; eps, gamma as in the module.
    Returns: loss (n,), gradient (n, n_lam) [per m/s], lam (n, n_lam) [N],
        eta (n, n_lam) [m/s].
    Raises: ValueError if gamma is out of its bound or a QP was not solved.
    """
    for F in steps.F:
        if not 0.0 < gamma < gamma_bound(F):
            raise ValueError(
                f"gamma is {gamma}, expected 0 < gamma < {gamma_bound(F):.6g}, "
                "the smallest eigenvalue of F + F'"
            )
    n, n_lam = steps.q.shape
    loss, force = np.zeros(n), np.zeros((n, n_lam))
    lam, eta = np.zeros((n, n_lam)), np.zeros((n, n_lam))
    for k in range(n):
        step = (steps.P[k], steps.p[k], steps.F[k], steps.q[k] + r)
        solved, cost, lam[k], eta[k], force[k] = solve_step(*step, gamma)
        if not solved:
            raise ValueError(f"violation_loss: the QP of step {k} was not solved")
        loss[k] = steps.constant[k] + cost / eps
    return loss, force / eps, lam, eta


@dataclass(frozen=True, eq=False)
class Residual:
    """The learned residual with Adam's memory: one value per group of entries."""

    value: np.ndarray  # (n_groups,) [m/s].
    first_moment: np.ndarray  # (n_groups,) [N].
    second_moment: np.ndarray  # (n_groups,) [N^2].
    n_steps: np.ndarray  # (n_groups,) Adam steps so far.

    def __post_init__(self):
        for field in fields(self):
            getattr(self, field.name).setflags(write=False)

    def __deepcopy__(self, memo):
        return self  # As Buffer.


def zero_residual(n_groups: int) -> Residual:
    return Residual(*(np.zeros(n_groups) for _ in range(4)))


def group_of_entry(groups, n_lam: int) -> np.ndarray:
    """The group of each entry of r, (n_lam,), -1 where an entry does not adapt.

    Args: groups: lists of entries that share one value; none at all: each its own.
    Raises: ValueError if an entry does not exist or is named twice.
    """
    if not groups:
        return np.arange(n_lam)
    group = np.full(n_lam, -1)
    for index, entries in enumerate(groups):
        if not np.iterable(entries):
            raise ValueError(f"groups is {groups}, expected lists of entries")
        if not list(entries):
            raise ValueError(f"groups is {groups}, expected no empty group")
        for entry in entries:
            if entry not in range(n_lam):
                raise ValueError(f"groups names entry {entry}, expected 0..{n_lam - 1}")
            if group[entry] >= 0:
                raise ValueError(f"groups names entry {entry} twice")
            group[entry] = index
    return group


def spread(residual: Residual, group) -> np.ndarray:
    """r_comp (n_lam,) [m/s]: each entry's value, 0 where it does not adapt."""
    return np.where(group >= 0, residual.value[group], 0.0)


def learn(
    steps: Buffer,
    residual: Residual,
    group,
    *,
    eps: float,
    gamma: float,
    learning_rate: float,
    n_steps: int,
    r_max: float,
    decay: tuple[float, float] = (0.9, 0.999),
):
    """Adam steps on the mean loss of the buffer (algorithm 1).

    Args: steps, at least one; group (n_lam,) as group_of_entry gives it; learning_rate
        [m/s] is about what one Adam step moves; r_max [m/s] bounds each entry.
    Returns: the new residual; the mean loss per step before this update; whether all
        QPs were solved (if not, the residual comes back as it was and the loss is nan).
    """
    state = np.stack([getattr(residual, field.name) for field in fields(residual)])
    data = (steps.P, steps.p, steps.F, steps.q, steps.constant)
    tuning = (eps, gamma, learning_rate, n_steps, r_max, decay[0], decay[1])
    solved, loss = _adam(*data, group, state, *tuning)
    return Residual(*state) if solved else residual, loss, solved


@njit(cache=True)
def _adam(P, p, F, q, constant, group, state, eps, gamma, rate, n_steps, r_max, b1, b2):
    """Steps state (4, n_groups) in place; returns whether solved, the first loss."""
    n, n_lam = q.shape
    n_groups = state.shape[1]
    size = np.zeros(n_groups)
    for i in range(n_lam):
        if group[i] >= 0:
            size[group[i]] += 1.0
    first_loss = 0.0
    b = np.empty(n_lam)
    for step in range(n_steps):
        force = np.zeros(n_groups)
        for k in range(n):
            for i in range(n_lam):
                b[i] = q[k, i] + (state[0, group[i]] if group[i] >= 0 else 0.0)
            solved, cost, _, _, force_k = solve_step(P[k], p[k], F[k], b, gamma)
            if not solved or not np.isfinite(cost):
                return False, np.nan
            if step == 0:
                first_loss += (constant[k] + cost / eps) / n
            for i in range(n_lam):
                if group[i] >= 0:
                    force[group[i]] += force_k[i] / (size[group[i]] * n)
        for j in range(n_groups):
            if abs(force[j]) < FORCE_FLOOR:
                continue
            state[3, j] += 1.0
            state[1, j] = b1 * state[1, j] + (1.0 - b1) * force[j]
            state[2, j] = b2 * state[2, j] + (1.0 - b2) * force[j] ** 2
            mean = state[1, j] / (1.0 - b1 ** state[3, j])
            root = np.sqrt(state[2, j] / (1.0 - b2 ** state[3, j]))
            value = state[0, j] - rate * mean / (root + ADAM_EPSILON)
            state[0, j] = min(max(value, -r_max), r_max)
    return True, first_loss


@njit(cache=True)
def solve_step(P, p, F, b, gamma):
    """min over lam, eta >= 0: 1/2 lam'P lam + p'lam + lam'eta + |b + F lam - eta|^2/2g.

    A primal-dual active set on which entries of lam and eta are free: all that are on
    the wrong side change at once, until none is, which is the exact solution. Should
    that cycle, as it hardly ever does, one changes at a time, the first that is wrong
    by more than rounding, which always ends.

    Returns: solved, cost, lam, eta, force = (b + F lam - eta)/gamma.
    Source: of one at a time: Murty, "Note on a Bard-type scheme for solving the
    complementarity problem", Opsearch 11 (1974).
    """
    n = b.size
    contact, gap = b <= 0.0, b > 0.0  # Where lam, eta are free.
    lam, eta, force, slope = _solve_free(P, p, F, b, gamma, contact, gap)
    below_lam = below_eta = below_slope = 0.0
    for k in range(100 * (n + 1)):
        changed, is_single = False, k >= 4 * n + AT_ONCE
        if is_single:
            below_lam = ROUNDING * np.abs(lam).max()
            below_eta = ROUNDING * (np.abs(b).max() + np.abs(eta).max())
            below_slope = ROUNDING * (_largest_slope(p, F, b, gamma, slope))
        for i in range(n):
            now = lam[i] > -below_lam if contact[i] else slope[i] < -below_slope
            if now != contact[i]:
                contact[i], changed = now, True
                if is_single:
                    break
            now = (
                eta[i] > -below_eta if gap[i] else force[i] - lam[i] > below_eta / gamma
            )
            if now != gap[i]:
                gap[i], changed = now, True
                if is_single:
                    break
        if not changed:
            lam, eta = np.maximum(lam, 0.0), np.maximum(eta, 0.0)
            return True, _cost(P, p, lam, eta, force, gamma), lam, eta, force
        lam, eta, force, slope = _solve_free(P, p, F, b, gamma, contact, gap)
    return False, np.nan, lam, eta, force


@njit(cache=True)
def _largest_slope(p, F, b, gamma, slope):
    """Of the cost in lam, here and with all entries closed."""
    largest = np.abs(slope).max()
    for i in range(p.size):
        closed = p[i]
        for j in range(p.size):
            closed += F[j, i] * b[j] / gamma
        largest = max(largest, abs(closed))
    return largest


@njit(cache=True)
def _solve_free(P, p, F, b, gamma, contact, gap):
    """The stationary point with lam zero outside contact and eta zero outside gap.

    eta = s - gamma lam where it is free, so that force = lam there and s/gamma else.
    Returns: lam, eta, force, and slope = the cost's derivative in lam.
    """
    n = b.size
    free = np.flatnonzero(contact)
    K, rhs = np.empty((free.size, free.size)), np.empty(free.size)
    for row in range(free.size):
        i = free[row]
        rhs[row] = -p[i] - (b[i] if gap[i] else 0.0)
        for k in range(n):
            if not gap[k]:
                rhs[row] -= F[k, i] * b[k] / gamma
        for column in range(row + 1):
            j = free[column]
            value = P[i, j]
            if gap[i]:
                value += F[i, j]
            if gap[j]:
                value += F[j, i]
            if gap[i] and i == j:
                value -= gamma
            for k in range(n):
                if not gap[k]:
                    value += F[k, i] * F[k, j] / gamma
            K[row, column] = value
    lam = np.zeros(n)
    _solve_cholesky(K, rhs)
    for row in range(free.size):
        lam[free[row]] = rhs[row]
    eta, force = np.zeros(n), np.empty(n)
    for i in range(n):
        s = b[i]
        for j in range(n):
            s += F[i, j] * lam[j]
        if gap[i]:
            eta[i] = s - gamma * lam[i]
            force[i] = lam[i]
        else:
            force[i] = s / gamma
    slope = np.empty(n)
    for i in range(n):
        slope[i] = p[i] + eta[i]
        for j in range(n):
            slope[i] += P[i, j] * lam[j] + F[j, i] * force[j]
    return lam, eta, force, slope


@njit(cache=True)
def _solve_cholesky(K, rhs):
    """Overwrites rhs with K^-1 rhs; K is positive definite, its lower half is read."""
    n = rhs.size
    for i in range(n):
        for j in range(i + 1):
            value = K[i, j]
            for k in range(j):
                value -= K[i, k] * K[j, k]
            if i == j:
                K[i, i] = np.sqrt(max(value, 1e-300))
            else:
                K[i, j] = value / K[j, j]
    for i in range(n):
        for k in range(i):
            rhs[i] -= K[i, k] * rhs[k]
        rhs[i] /= K[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            rhs[i] -= K[k, i] * rhs[k]
        rhs[i] /= K[i, i]


@njit(cache=True)
def _cost(P, p, lam, eta, force, gamma):
    cost = 0.0
    for i in range(lam.size):
        cost += lam[i] * (p[i] + eta[i]) + 0.5 * gamma * force[i] ** 2
        for j in range(lam.size):
            cost += 0.5 * lam[i] * P[i, j] * lam[j]
    return cost
