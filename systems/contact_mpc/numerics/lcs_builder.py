"""One linearised time step with contact: arrays of a multibody model -> LCS.

    v_next = v + dt f(q, v, u) + dt M^-1 J_c' lam,   q_next = q + dt N v_next
    0 <= lam  perp  w = S (phi + J_n N+ (q - q*)) / dt + J_c v_next + F_0 lam >= 0

f is the acceleration without contact; N maps v to qdot and N+ back, both frozen at the
nominal q*. Row i of J_c is what the i-th entry of lam pushes along, S picks the gap of
its contact, and F_0 holds what does not come from the dynamics (contact_rows).

The gap that the forces see moves with q through E, so it changes along a horizon: a
gap frozen at q* would let a plan push through what it has not touched yet.

Source: ACI-MPC section V, eq. 5-8. There lam is an impulse: lam_impulse = dt lam, and
so eps_c here is dt times theirs.
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.lcs import LCS

NOT_FINITE = "the linearised contact model has an entry that is not finite"


def assemble_lcs(
    x, f, J_q, J_v, J_u, u, M, N, N_plus, phi, J_n, J_c, contact, normal, F_0, dt,
    number=None, J_push=None,
):  # fmt: skip
    """The LCS of one linearised time step.

    Args:
        x: (n_q + n_v,) nominal state [q, v]; u: (n_u,) nominal input.
        f: (n_v,) acceleration without contact at (x, u); J_q (n_v, n_q), J_v
            (n_v, n_v), J_u (n_v, n_u) its derivatives.
        M: (n_v, n_v) mass matrix. N: (n_q, n_v), qdot = N v. N_plus: (n_v, n_q).
        phi: (n_contacts,) gaps [m]; J_n: (n_contacts, n_v), their rates per v.
        J_c: (n_lam, n_v), what each force pushes along; J_push: the same with what
            else it does, as against rolling; None: nothing.
        contact: (n_lam,) integers, the contact of each force. normal (n_lam,): 1.0
            where w holds the contact's gap, else 0.0. F_0 (n_lam, n_lam): see the
            module. dt: time step [s]. number: (n_contacts,) what the contacts are
            called; None: 0, 1, ...

    Returns: LCS with dt, phi (per force; infinite where w holds no gap), J, contact.

    Raises: ValueError if the model's arrays lead to an entry that is not finite.

    Source: ACI-MPC eq. 7, 8, with lam in newtons.
    """
    A, B, D, d, E, F, H, c = assemble(
        np.ascontiguousarray(x, dtype=float),
        np.ascontiguousarray(f, dtype=float),
        np.ascontiguousarray(J_q, dtype=float),
        np.ascontiguousarray(J_v, dtype=float),
        np.ascontiguousarray(J_u, dtype=float),
        np.ascontiguousarray(u, dtype=float),
        np.linalg.solve(M, (J_c if J_push is None else J_push).T),
        np.ascontiguousarray(N, dtype=float),
        np.ascontiguousarray(N_plus, dtype=float),
        np.ascontiguousarray(phi, dtype=float),
        np.ascontiguousarray(J_n, dtype=float),
        np.ascontiguousarray(J_c, dtype=float),
        contact,
        normal,
        F_0,
        dt,
    )
    if not is_finite_model(c, d, F):
        raise ValueError(NOT_FINITE)
    phi_lam = np.where(normal > 0.0, phi[contact], np.inf)
    if number is not None:
        contact = number[contact]
    return LCS(A, B, D, d, E, F, H, c, dt, phi_lam, J_c, contact)


@njit(cache=True)
def is_finite_model(c, d, F):
    """Whether an LCS is finite: its c, d and F together contain every ingredient."""
    finite = np.isfinite(c).all() and np.isfinite(d).all()
    return finite and np.isfinite(F).all()


@njit(cache=True)
def _stepped(N, V, dt):
    """[dt N V, V]: q_next - q and v_next of V (n_v, m), by q_next = q + dt N v_next."""
    n_q, m = N.shape[0], V.shape[1]
    out, moved = np.empty((n_q + V.shape[0], m)), N @ V
    for i in range(len(out)):
        for j in range(m):
            out[i, j] = dt * moved[i, j] if i < n_q else V[i - n_q, j]
    return out


@njit(cache=True)
def assemble(
    x, f, J_q, J_v, J_u, u, M_inv_J_cT, N, N_plus, phi, J_n, J_c, contact, normal,
    F_0, dt,
):  # fmt: skip
    """A, B, D, d, E, F, H, c of assemble_lcs, whose arguments these are but for
    M_inv_J_cT (n_v, n_lam) = M^-1 J_c'. Compiled."""
    n_v, n_q = J_q.shape
    n_x, n_lam = n_q + n_v, contact.size
    q, v = x[:n_q].copy(), x[n_q:].copy()
    d_v = f - J_q @ q - J_v @ v - J_u @ u
    # Loops, as an array that is assigned to a slice takes ten times as long to compile.
    V = np.empty((n_v, n_x))  # Derivative of v_next.
    for i in range(n_v):
        for j in range(n_q):
            V[i, j] = dt * J_q[i, j]
        for j in range(n_v):
            V[i, n_q + j] = dt * J_v[i, j]
        V[i, n_q + i] += 1.0
    V_u, V_0, V_lam = dt * J_u, dt * d_v, dt * M_inv_J_cT
    A, B, D = _stepped(N, V, dt), _stepped(N, V_u, dt), _stepped(N, V_lam, dt)
    for i in range(n_q):
        A[i, i] += 1.0
    d, moved = np.empty(n_x), N @ V_0
    for i in range(n_x):
        d[i] = dt * moved[i] if i < n_q else V_0[i - n_q]
    gap_rate = (J_n @ N_plus) / dt  # Of the gaps per q, over dt.
    gap_0 = phi / dt - gap_rate @ q
    E = J_c @ V
    H = J_c @ V_u
    F = J_c @ V_lam
    c = J_c @ V_0
    for i in range(n_lam):
        if normal[i] > 0.0:
            for j in range(n_q):
                E[i, j] += gap_rate[contact[i], j]
            c[i] += gap_0[contact[i]]
        for j in range(n_lam):
            F[i, j] += F_0[i, j]
    return A, B, D, d, E, F, H, c
