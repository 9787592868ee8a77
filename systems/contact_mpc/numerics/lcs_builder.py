"""Contact linearised about one state: arrays of a multibody model -> LCS.

    v_next = v + dt f(q, v, u) + dt M^-1 J_c' lam,   q_next = q + dt N v_next
    0 <= lam  perp  w = S (phi + J_n N+ (q - q*)) / dt + J_c v_next + F_0 lam >= 0

f is the acceleration without contact; N maps v to qdot and N+ back, both frozen at the
nominal q*. Row i of J_c is what the i-th entry of lam pushes along, S picks the gap of
its contact, and F_0 holds what does not come from the dynamics. With n_f friction
directions (2 n_f edges) a contact has these rows:

    Anitescu          per edge:    J_n + mu J_t, with the gap
    Stewart-Trinkle   normal:      J_n, with the gap
                      per edge:    J_t + gamma, without the gap
                      cone:        w = mu lam_n - sum lam_t, lam = gamma, the speed at
                                   which the contact slides

Anitescu's contact is convex, and opens while it slides, by dt mu |v_t|.
Stewart-Trinkle's does not; its F is not symmetric. A contact with a stiffness k is a
spring: lam_n = k max(0, -gap after the step), which adds 1 / (k dt) to F between its
normal forces. eps_c keeps the other forces apart. lam is in newtons (gamma in m/s, and
its w in newtons).

The gap that the forces see moves with q through E, so it changes along a horizon: a
gap frozen at q* would let a plan push through what it has not touched yet.

Source: ACI-MPC section V, eq. 5-8 (there lam is an impulse: lam_impulse = dt lam, and
so eps_c here is dt times theirs); Anitescu, Math. Programming 105 (2006); Stewart,
Trinkle, Int. J. Numerical Methods in Engineering 39 (1996).
"""

from dataclasses import dataclass
from math import cos, pi, sin, sqrt

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.lcs import LCS

# Shapes that the fast path knows.
SPHERE, BOX, HALF_SPACE, CYLINDER = 0, 1, 2, 3
_NOT_FINITE = "the linearised contact model has an entry that is not finite"


def friction_edges(n_f):
    """The 2 n_f friction edges (2 n_f, 2) of a contact, unit vectors (cos, sin) in the
    tangent basis: theta = 0, pi, pi/n_f, pi/n_f + pi, ... as in c3_reference."""
    edges = []
    for k in range(n_f):
        direction = np.array([cos(pi * k / n_f), sin(pi * k / n_f)])
        edges += [direction, -direction]
    return np.array(edges).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class ContactRows:
    """What each entry of lam is: row i of J_c is normal J_n + weight (edge' J_t)."""

    contact: np.ndarray  # (n_lam,) index of its contact
    normal: np.ndarray  # (n_lam,) 1.0, or 0.0: a row without normal and gap
    edge: np.ndarray  # (n_lam, 2) in the tangent basis; 0: none
    along_mu: np.ndarray  # (n_lam,) whether the edge counts mu times (Anitescu)
    cone: np.ndarray  # (n_lam, n_lam) constant part of F
    cone_mu: np.ndarray  # (n_lam, n_lam) of F, times mu
    regular: np.ndarray  # (n_lam, n_lam) of F, times eps_c
    compressed: np.ndarray  # (n_lam, n_lam) of F, times 1 / (stiffness dt)
    names: list[str]  # Of each row within its contact.

    def weight(self, mu):
        """(n_lam,) of the rows' edges, for the contacts' friction mu (n_contacts,)."""
        return np.where(self.along_mu, mu[self.contact], 1.0)

    def F_0(self, mu, compliance, dt, eps_c):
        """(n_lam, n_lam), for mu (n_contacts,) and compliance (n_contacts,) [m/N]."""
        of_row, soft = mu[self.contact][:, None], compliance[self.contact][:, None]
        F_0 = self.cone + of_row * self.cone_mu + eps_c * self.regular
        return F_0 + soft / dt * self.compressed


def contact_rows(kinds) -> ContactRows:
    """The rows of contacts, one after the other.

    Args: kinds: per contact (is_anitescu, edges (2 n_f, 2), has friction, is
        compliant). Without friction a Stewart-Trinkle contact is its normal row alone.
    """
    sizes = [
        len(edges) if anitescu else (len(edges) + 2 if friction else 1)
        for anitescu, edges, friction, _ in kinds
    ]
    n = sum(sizes)
    normal, edge, along_mu = np.zeros(n), np.zeros((n, 2)), np.zeros(n, bool)
    cone, cone_mu, regular, compressed = np.zeros((4, n, n))
    names, start = [], 0
    for (anitescu, edges, friction, compliant), size in zip(kinds, sizes, strict=True):
        own = slice(start, start + size)
        if anitescu:
            normal[own], edge[own], along_mu[own] = 1.0, edges, True
            regular[own, own] = np.eye(size)
            names += [f"{k}" for k in range(size)]
            if compliant:  # The sum of the forces meets the spring, and only that.
                compressed[own, own] = 1.0
                regular[own, own] -= 1.0 / size
        else:
            normal[start] = 1.0
            (compressed if compliant else regular)[start, start] = 1.0
            names.append("normal")
            if friction:
                tangent, last = slice(start + 1, start + size - 1), start + size - 1
                edge[tangent] = edges
                regular[tangent, tangent] = np.eye(size - 2)
                cone[tangent, last], cone[last, tangent] = 1.0, -1.0
                cone_mu[last, start] = 1.0
                names += [f"edge {k}" for k in range(size - 2)] + ["sliding speed"]
        start += size
    contact = np.repeat(np.arange(len(sizes)), sizes)
    return ContactRows(
        contact, normal, edge, along_mu, cone, cone_mu, regular, compressed, names
    )


def nearest_contacts(phi, groups):
    """Which contacts of each group are nearest: indices, in their order in the group.

    Args: phi (n,) gaps [m]; groups: pairs of (indices (m,), how many of them to take).
    """
    chosen = []
    for of_group, count in groups:
        nearest = np.argsort(phi[of_group], kind="stable")[:count]
        chosen.append(of_group[np.sort(nearest)])
    return np.concatenate(chosen)


@njit(cache=True)
def tangent_basis(n, reference):
    """Two unit tangents t1, t2 with t1 x t2 = n, for a unit normal n (3,).

    reference (3,): t1 is its projection on the tangent plane. If it is zero (or along
    n): t1 = e x n, where e is the axis along which n is smallest, the basis of Drake's
    RotationMatrix.MakeFromOneVector. That one jumps by 90 degrees where two entries of
    n change places in size; a reference direction does not jump.
    """
    along = reference @ n
    t1 = reference - along * n
    length = sqrt(t1 @ t1)
    if length < 1e-6:
        i = 0
        if abs(n[1]) < abs(n[i]):
            i = 1
        if abs(n[2]) < abs(n[i]):
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        t1[i], t1[j], t1[k] = 0.0, -n[k], n[j]
        length = sqrt(n[j] * n[j] + n[k] * n[k])
    t1 /= length
    t2 = np.empty(3)
    t2[0] = n[1] * t1[2] - n[2] * t1[1]
    t2[1] = n[2] * t1[0] - n[0] * t1[2]
    t2[2] = n[0] * t1[1] - n[1] * t1[0]
    return t1, t2


def assemble_lcs(
    x, f, J_q, J_v, J_u, u, M, N, N_plus, phi, J_n, J_c, contact, normal, F_0, dt,
    number=None,
):  # fmt: skip
    """The LCS of one linearised time step.

    Args:
        x: (n_q + n_v,) nominal state [q, v]; u: (n_u,) nominal input.
        f: (n_v,) acceleration without contact at (x, u); J_q (n_v, n_q), J_v
            (n_v, n_v), J_u (n_v, n_u) its derivatives.
        M: (n_v, n_v) mass matrix. N: (n_q, n_v), qdot = N v. N_plus: (n_v, n_q).
        phi: (n_contacts,) gaps [m]; J_n: (n_contacts, n_v), their rates per v.
        J_c: (n_lam, n_v), what each force pushes along.
        contact: (n_lam,) integers, the contact of each force. normal (n_lam,): 1.0
            where w holds the contact's gap, else 0.0. F_0 (n_lam, n_lam): see the
            module. dt: time step [s]. number: (n_contacts,) what the contacts are
            called; None: 0, 1, ...

    Returns: LCS with dt, phi (per force; infinite where w holds no gap), J, contact.

    Raises: ValueError if the model's arrays lead to an entry that is not finite.

    Source: ACI-MPC eq. 7, 8, with lam in newtons.
    """
    A, B, D, d, E, F, H, c = _assemble(
        np.ascontiguousarray(x, dtype=float),
        np.ascontiguousarray(f, dtype=float),
        np.ascontiguousarray(J_q, dtype=float),
        np.ascontiguousarray(J_v, dtype=float),
        np.ascontiguousarray(J_u, dtype=float),
        np.ascontiguousarray(u, dtype=float),
        np.linalg.solve(M, J_c.T),
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
    if not _is_finite(c, d, F):
        raise ValueError(_NOT_FINITE)
    phi_lam = np.where(normal > 0.0, phi[contact], np.inf)
    if number is not None:
        contact = number[contact]
    return LCS(A, B, D, d, E, F, H, c, dt, phi_lam, J_c, contact)


@njit(cache=True)
def _is_finite(c, d, F):
    """Whether the model is: these together contain every ingredient."""
    finite = np.isfinite(c).all() and np.isfinite(d).all()
    return finite and np.isfinite(F).all()


@njit(cache=True)
def _assemble(
    x, f, J_q, J_v, J_u, u, M_inv_J_cT, N, N_plus, phi, J_n, J_c, contact, normal,
    F_0, dt,
):  # fmt: skip
    n_v, n_q = J_q.shape
    n_x, n_u, n_lam = n_q + n_v, J_u.shape[1], contact.size
    q, v = x[:n_q].copy(), x[n_q:].copy()
    d_v = f - J_q @ q - J_v @ v - J_u @ u
    A, B, d = np.zeros((n_x, n_x)), np.empty((n_x, n_u)), np.empty(n_x)
    D, E = np.empty((n_x, n_lam)), np.empty((n_lam, n_x))
    # Velocity rows first; the position rows follow from q_next = q + dt N v_next.
    V = np.empty((n_v, n_x))  # Derivative of v_next.
    V[:, :n_q] = dt * J_q
    V[:, n_q:] = dt * J_v
    for i in range(n_v):
        V[i, n_q + i] += 1.0
    A[n_q:] = V
    A[:n_q] = dt * (N @ V)
    for i in range(n_q):
        A[i, i] += 1.0
    V_u, V_0, V_lam = dt * J_u, dt * d_v, dt * M_inv_J_cT
    B[n_q:], B[:n_q] = V_u, dt * (N @ V_u)
    d[n_q:], d[:n_q] = V_0, dt * (N @ V_0)
    D[n_q:], D[:n_q] = V_lam, dt * (N @ V_lam)
    gap_rate = (J_n @ N_plus) / dt  # Of the gaps per q, over dt.
    gap_0 = phi / dt - gap_rate @ q
    E[:] = J_c @ V
    H = J_c @ V_u
    F = J_c @ V_lam
    c = J_c @ V_0
    for i in range(n_lam):
        if normal[i] > 0.0:
            E[i, :n_q] += gap_rate[contact[i]]
            c[i] += gap_0[contact[i]]
        for j in range(n_lam):
            F[i, j] += F_0[i, j]
    return A, B, D, d, E, F, H, c


@dataclass(frozen=True, eq=False)
class ConstantMassModel:
    """A model of bodies that move apart from one another, and its contacts.

    Every body either never turns (prismatic joints and welds) or floats freely. With
    its centre of mass at its origin and equal moments of inertia, that is all: then
    f = f_0 + J_v v + J_u u exactly, the mass matrix is constant, and only contact
    geometry depends on q. For the other floating bodies (`turning`) rigid_body adds
    what depends on how they are turned. Made by systems/contact_mpc/lcs_builder.

    Row g of the geometry arrays is one collision shape. `quaternion` and `omega` are
    where its body's quaternion is in q and its angular velocity in v (the body's
    position and velocity follow right after); both -1 for a body that never turns,
    whose shape is at p_0 + P q with the constant orientation R.
    """

    M_inv: np.ndarray  # (n_v, n_v)
    f_0: np.ndarray  # (n_v,) [m/s2, rad/s2]
    J_v: np.ndarray  # (n_v, n_v) from joint damping
    J_u: np.ndarray  # (n_v, n_u)
    plain: np.ndarray  # (n, 2) pairs (index in q, index in v) with qdot = v
    floating: np.ndarray  # (m, 2) starts (in q, in v) of each floating body
    turning: np.ndarray  # (k, 2) the same of those with a mass matrix that turns
    body: np.ndarray  # (k, 5, 3) inertia about the centre of mass, that centre, mass
    shape: np.ndarray  # (n_g,) SPHERE, BOX, HALF_SPACE or CYLINDER
    size: np.ndarray  # (n_g, 3) radius; half extents of a box; radius, half length [m]
    quaternion: np.ndarray  # (n_g,)
    omega: np.ndarray  # (n_g,)
    R: np.ndarray  # (n_g, 3, 3) in the world, or in the floating body
    p_0: np.ndarray  # (n_g, 3) in the world at q = 0, or in the floating body [m]
    P: np.ndarray  # (n_g, 3, n_q)
    J_p: np.ndarray  # (n_g, 3, n_v) velocity of a body that never turns
    pairs: np.ndarray  # (n_pairs, 2) geometry A, geometry B
    reference: np.ndarray  # (n_pairs, 3) see tangent_basis

    def gaps(self, q):
        """(n_pairs,) of all pairs [m]."""
        return _gaps(
            q, self.shape, self.size, self.quaternion, self.R, self.p_0, self.P,
            self.pairs,
        )  # fmt: skip

    def build(self, x, u, dt, rows: ContactRows, weight, F_0, chosen=None) -> LCS:
        """The LCS at x (n_x,), with unit quaternions, and u (n_u,).

        Args: rows, with weight and F_0 of its friction; chosen: the pairs that are its
            contacts, None: all.
        Raises: ValueError as assemble_lcs.
        """
        pairs, reference = self.pairs, self.reference
        if chosen is not None:
            pairs, reference = pairs[chosen], reference[chosen]
        A, B, D, d, E, F, H, c, phi, J_c, finite = _build_constant_mass(
            x, u, self.M_inv, self.f_0, self.J_v, self.J_u, self.plain, self.floating,
            self.turning, self.body, self.shape, self.size, self.quaternion, self.omega,
            self.R, self.p_0, self.P, self.J_p, pairs, reference, rows.contact,
            rows.normal, weight, rows.edge, F_0, dt,
        )  # fmt: skip
        if not finite:
            raise ValueError(_NOT_FINITE)
        contact = rows.contact if chosen is None else np.asarray(chosen)[rows.contact]
        return LCS(A, B, D, d, E, F, H, c, dt, phi, J_c, contact)


@njit(cache=True)
def nearest_of_groups(phi, members, ends, counts):
    """nearest_contacts for compiled callers: groups one after the other in members,
    each up to its end (exclusive), of which so many are taken."""
    chosen = np.empty(counts.sum(), np.int64)
    start, n = 0, 0
    for g in range(len(ends)):
        of_group = members[start : ends[g]]
        start = ends[g]
        taken = np.zeros(of_group.size, np.bool_)
        for _ in range(counts[g]):
            best = -1
            for i in range(of_group.size):
                if not taken[i] and (
                    best < 0 or phi[of_group[i]] < phi[of_group[best]]
                ):
                    best = i
            taken[best] = True
        for i in range(of_group.size):
            if taken[i]:
                chosen[n] = of_group[i]
                n += 1
    return chosen


@njit(cache=True)
def build_many_constant_mass(x, u, dt, model, rows, groups, out):
    """The LCS about each of many states, written into out.

    Args:
        x: (n, n_x), with unit quaternions; u (n_u,).
        model: the fields of a ConstantMassModel in their order, as a tuple.
        rows: contact, normal, weight, edge, F_0 of the contacts.
        groups: members, ends, counts, as of nearest_of_groups.
        out: A, B, D, d, E, F, H, c, phi, each with the n states first.
    Returns: whether each is finite (n,).
    """
    (M_inv, f_0, J_v, J_u, plain, floating, turning, body, shape, size, quaternion,
     omega, R, p_0, P, J_p, pairs, reference) = model  # fmt: skip
    contact, normal, weight, edge, F_0 = rows
    members, ends, counts = groups
    A, B, D, d, E, F, H, c, phi = out
    finite = np.empty(len(x), np.bool_)
    n_q = x.shape[1] - f_0.size
    for i in range(len(x)):
        gaps = _gaps(x[i, :n_q].copy(), shape, size, quaternion, R, p_0, P, pairs)
        chosen = nearest_of_groups(gaps, members, ends, counts)
        built = _build_constant_mass(
            x[i], u, M_inv, f_0, J_v, J_u, plain, floating, turning, body, shape, size,
            quaternion, omega, R, p_0, P, J_p, pairs[chosen], reference[chosen],
            contact, normal, weight, edge, F_0, dt,
        )  # fmt: skip
        A[i], B[i], D[i], d[i], E[i], F[i], H[i], c[i] = built[:8]
        phi[i], finite[i] = built[8], built[10]
    return finite


@njit(cache=True)
def _poses(q, quaternion, R, p_0, P):
    """Of the shapes in the world, and the origins that their bodies turn about."""
    n_g = quaternion.size
    R_W, p_W, origin = np.empty((n_g, 3, 3)), np.empty((n_g, 3)), np.zeros((n_g, 3))
    for g in range(n_g):
        if quaternion[g] < 0:
            R_W[g] = R[g]
            p_W[g] = p_0[g] + P[g] @ q
        else:
            k = quaternion[g]
            R_WB = _rotation(q[k], q[k + 1], q[k + 2], q[k + 3])
            origin[g] = q[k + 4 : k + 7]
            R_W[g] = R_WB @ R[g]
            p_W[g] = origin[g] + R_WB @ p_0[g]
    return R_W, p_W, origin


@njit(cache=True)
def _distance(a, b, shape, size, R_W, p_W):
    """Gap of the shapes a and b, normal from b to a, nearest points on a and b."""
    if shape[a] == SPHERE:
        return _sphere_against(p_W[a], size[a, 0], shape[b], size[b], R_W[b], p_W[b])
    gap, n, on_b, on_a = _sphere_against(
        p_W[b], size[b, 0], shape[a], size[a], R_W[a], p_W[a]
    )
    return gap, -n, on_a, on_b


@njit(cache=True)
def _gaps(q, shape, size, quaternion, R, p_0, P, pairs):
    R_W, p_W, _ = _poses(q, quaternion, R, p_0, P)
    phi = np.empty(len(pairs))
    for i in range(len(pairs)):
        phi[i] = _distance(pairs[i, 0], pairs[i, 1], shape, size, R_W, p_W)[0]
    return phi


@njit(cache=True)
def _build_constant_mass(
    x, u, M_inv, f_0, J_v, J_u, plain, floating, turning, body, shape, size,
    quaternion, omega, R, p_0, P, J_p, pairs, reference, contact, normal, weight,
    edge, F_0, dt,
):  # fmt: skip
    n_v = f_0.size
    n_q = x.size - n_v
    q, v = x[:n_q].copy(), x[n_q:].copy()
    N, N_plus = velocity_maps(q, plain, floating, n_v)
    R_W, p_W, origin = _poses(q, quaternion, R, p_0, P)
    n_c, n_lam = pairs.shape[0], contact.size
    phi, J = np.empty(n_c), np.empty((n_c, 3, n_v))
    J_n = np.empty((n_c, n_v))
    for i in range(n_c):
        a, b = pairs[i]
        phi[i], n, on_a, on_b = _distance(a, b, shape, size, R_W, p_W)
        J_w = _point_jacobian(on_a - origin[a], omega[a], J_p[a])
        J_w -= _point_jacobian(on_b - origin[b], omega[b], J_p[b])
        t1, t2 = tangent_basis(n, reference[i])
        J[i, 0], J[i, 1], J[i, 2] = n @ J_w, t1 @ J_w, t2 @ J_w
        J_n[i] = J[i, 0]
    J_c, phi_lam = np.empty((n_lam, n_v)), np.empty(n_lam)
    for k in range(n_lam):
        i = contact[k]
        J_t = edge[k, 0] * J[i, 1] + edge[k, 1] * J[i, 2]
        J_c[k] = normal[k] * J[i, 0] + weight[k] * J_t
        phi_lam[k] = phi[i] if normal[k] > 0.0 else np.inf
    f = f_0 + J_v @ v + J_u @ u
    J_q = np.zeros((n_v, n_q))
    if len(turning) > 0:
        M_inv, J_v = M_inv.copy(), J_v.copy()
    for i in range(len(turning)):
        a, b = turning[i]
        of = slice(b, b + 6)
        R_WB = _rotation(q[a], q[a + 1], q[a + 2], q[a + 3])
        f_i, J_angle, J_w, M_inv_i = rigid_body(R_WB, v[b : b + 3], body[i])
        f[of] += f_i
        J_q[of, a : a + 4] = J_angle @ N_plus[b : b + 3, a : a + 4].copy()
        J_v[of, b : b + 3] += J_w
        M_inv[of, of] = M_inv_i
    A, B, D, d, E, F, H, c = _assemble(
        x, f, J_q, J_v, J_u, u, M_inv @ J_c.T, N, N_plus, phi, J_n,
        J_c, contact, normal, F_0, dt,
    )  # fmt: skip
    return A, B, D, d, E, F, H, c, phi_lam, J_c, _is_finite(c, d, F)


@njit(cache=True)
def _cross(a):
    """[a]x (3, 3): [a]x b = a x b."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2], m[1, 2] = -a[2], a[1], -a[0]
    m[1, 0], m[2, 0], m[2, 1] = a[2], -a[1], a[0]
    return m


@njit(cache=True)
def rigid_body(R, omega, body):
    """A free rigid body that turns, beside its weight.

    Its origin and its turning accelerate, with I about the centre of mass at c, both in
    the body's frame, and w = R' omega, by

        R F(w),  F = [dw, -dw x c - w x (w x c)],  dw = -I^-1 (w x I w)

    Args: R (3, 3) of the body in the world; omega (3,) in the world [rad/s]; body
        (5, 3): I [kg m2], c [m], and mass [kg] in all of the last row.
    Returns: f (6,) [turning, origin]; its derivatives (6, 3) by a turn of the body (a
        vector in the world [rad]) and by omega; the inverse (6, 6) of its mass matrix.
    Source: Newton and Euler; Featherstone, "Rigid Body Dynamics Algorithms", 2.
    """
    inertia, c, mass = body[:3].copy(), body[3].copy(), body[4, 0]
    w, I_inv = R.T @ omega, np.linalg.inv(inertia)
    C = _cross(c)
    dw = -I_inv @ np.cross(w, inertia @ w)
    F = np.empty((2, 3))
    F[0] = dw
    F[1] = C @ dw - np.cross(w, np.cross(w, c))
    G_w = -I_inv @ (_cross(w) @ inertia - _cross(inertia @ w))
    G_v = C @ G_w + _cross(np.cross(w, c)) + _cross(w) @ C
    f, J_angle, J_w = np.empty(6), np.empty((6, 3)), np.empty((6, 3))
    for i, G in enumerate((G_w, G_v)):
        of = slice(3 * i, 3 * i + 3)
        f[of] = R @ F[i]
        J_w[of] = R @ G @ R.T
        J_angle[of] = R @ G @ R.T @ _cross(omega) - _cross(f[of])
    # v_origin = v_centre + C omega.
    M_inv, I_W, C_W = np.empty((6, 6)), R @ I_inv @ R.T, R @ C @ R.T
    M_inv[:3, :3] = I_W
    M_inv[:3, 3:] = I_W @ C_W.T
    M_inv[3:, :3] = C_W @ I_W
    M_inv[3:, 3:] = np.eye(3) / mass + C_W @ I_W @ C_W.T
    return f, J_angle, J_w, M_inv


@njit(cache=True)
def velocity_maps(q, plain, floating, n_v):
    """N (n_q, n_v) with qdot = N v, and N+ (n_v, n_q) with v = N+ qdot.

    Args: q (n_q,) with unit quaternions [w x y z]; plain and floating as in
        ConstantMassModel; a floating body's v is [omega 3, velocity 3] in the world.
    """
    N, N_plus = np.zeros((q.size, n_v)), np.zeros((n_v, q.size))
    for i in range(plain.shape[0]):
        N[plain[i, 0], plain[i, 1]] = 1.0
        N_plus[plain[i, 1], plain[i, 0]] = 1.0
    L = np.empty((4, 3))  # qdot = L omega / 2, omega = 2 L' qdot.
    for i in range(floating.shape[0]):
        a, b = floating[i]
        w, x, y, z = q[a], q[a + 1], q[a + 2], q[a + 3]
        L[0, 0], L[0, 1], L[0, 2] = -x, -y, -z
        L[1, 0], L[1, 1], L[1, 2] = w, z, -y
        L[2, 0], L[2, 1], L[2, 2] = -z, w, x
        L[3, 0], L[3, 1], L[3, 2] = y, -x, w
        N[a : a + 4, b : b + 3] = 0.5 * L
        N_plus[b : b + 3, a : a + 4] = 2.0 * L.T
        for k in range(3):
            N[a + 4 + k, b + 3 + k] = 1.0
            N_plus[b + 3 + k, a + 4 + k] = 1.0
    return N, N_plus


@njit(cache=True)
def _rotation(w, x, y, z):
    R = np.empty((3, 3))
    R[0, 0], R[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    R[2, 2] = 1 - 2 * (x * x + y * y)
    R[0, 1], R[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    R[0, 2], R[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    R[1, 2], R[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return R


@njit(cache=True)
def _point_jacobian(r, omega, J_p):
    """Velocity of a body's point at r (3,) from its origin, per v: (3, n_v)."""
    J = J_p.copy()
    if omega >= 0:
        for k in range(3):
            J[k, omega + 3 + k] = 1.0
        J[0, omega + 1], J[0, omega + 2] = r[2], -r[1]
        J[1, omega], J[1, omega + 2] = -r[2], r[0]
        J[2, omega], J[2, omega + 1] = r[1], -r[0]
    return J


@njit(cache=True)
def _sphere_against(p_S, radius, shape, size, R_G, p_G):
    """Gap, unit normal towards the sphere, nearest points on the sphere and the other.

    The other shape: a sphere, a box (half extents `size`), the half-space below the z
    axis of its frame, or a cylinder about that axis.
    """
    if shape == HALF_SPACE:
        n = R_G[:, 2].copy()
        height = n @ (p_S - p_G)
        return height - radius, n, p_S - radius * n, p_S - height * n
    if shape == SPHERE:
        n = p_S - p_G
        distance = sqrt(n @ n)
        if distance > 1e-12:
            n /= distance
        else:  # Concentric: any direction is right; that of the general path.
            n[0], n[1], n[2] = 1.0, 0.0, 0.0
        on_other = p_G + size[0] * n
        return distance - size[0] - radius, n, p_S - radius * n, on_other
    p = R_G.T @ (p_S - p_G)
    if shape == CYLINDER:
        distance, n_G, nearest = _point_on_cylinder(p, size[0], size[1])
        n = R_G @ n_G
        return distance - radius, n, p_S - radius * n, p_G + R_G @ nearest
    nearest = np.minimum(np.maximum(p, -size), size)
    n_G = p - nearest
    distance = sqrt(n_G @ n_G)
    if distance > 0.0:
        n_G /= distance
    else:  # The centre is in the box: out through the nearest face.
        axis = np.argmin(size - np.abs(p))
        side = 1.0 if p[axis] >= 0.0 else -1.0
        distance = -(size[axis] - abs(p[axis]))
        n_G[axis] = side
        nearest[axis] = side * size[axis]
    n = R_G @ n_G
    return distance - radius, n, p_S - radius * n, p_G + R_G @ nearest


@njit(cache=True)
def _point_on_cylinder(p, radius, half_length):
    """Distance (negative inside), outward unit normal and nearest point of a cylinder
    about z to the point p (3,)."""
    along, off = p[2], sqrt(p[0] * p[0] + p[1] * p[1])
    out = np.zeros(3)  # Away from the axis; on it every direction is right.
    if off > 1e-12:
        out[0], out[1] = p[0] / off, p[1] / off
    else:
        out[0] = 1.0
    side = 1.0 if along >= 0.0 else -1.0
    beyond, outside = abs(along) - half_length, off - radius
    nearest, n = np.empty(3), np.zeros(3)
    if beyond <= 0.0 and outside <= 0.0:  # Out through the nearer of side and end.
        if outside >= beyond:
            nearest[:] = radius * out
            nearest[2] = along
            return outside, out, nearest
        nearest[:] = p
        nearest[2] = side * half_length
        n[2] = side
        return beyond, n, nearest
    nearest[:] = min(off, radius) * out
    nearest[2] = min(max(along, -half_length), half_length)
    n[:] = p - nearest
    distance = sqrt(n @ n)
    return distance, n / distance, nearest
