"""The LCS of bodies that slide or float freely, without AutoDiff (the fast path).

Every body either never turns (prismatic joints and welds) or floats freely; each
contact is of a sphere with a sphere, box, cylinder or half-space. Then the dynamics
have a closed form, and one compiled function computes the whole LCS.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.contact_rows import (
    ContactRows,
    nearest_of_groups,
    tangent_basis,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.numerics.lcs_builder import (
    NOT_FINITE,
    assemble,
    is_finite_model,
)
from makebreak.systems.contact_mpc.numerics.rigid_body import (
    point_jacobian,
    rigid_body,
    rotation,
    velocity_maps,
)
from makebreak.systems.contact_mpc.numerics.sphere_distance import (
    SPHERE,
    sphere_against,
)


@dataclass(frozen=True, eq=False)
class ConstantMassModel:
    """A model of bodies that move independently of one another, and its contacts.

    Every body either never turns (prismatic joints and welds) or floats freely. With
    its centre of mass at its origin and equal moments of inertia, that is all: then
    f = f_0 + J_v v + J_u u exactly, the mass matrix is constant, and only contact
    geometry depends on q. For the other floating bodies (`turning`) rigid_body adds
    what depends on how they are turned. Made by multibody/constant_mass.

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
            raise ValueError(NOT_FINITE)
        contact = rows.contact if chosen is None else np.asarray(chosen)[rows.contact]
        return LCS(A, B, D, d, E, F, H, c, dt, phi, J_c, contact)


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
    """Poses R_W (n_g, 3, 3), p_W (n_g, 3) [m] of the shapes in the world, and the
    origins (n_g, 3) that their bodies turn about."""
    n_g = quaternion.size
    R_W, p_W, origin = np.empty((n_g, 3, 3)), np.empty((n_g, 3)), np.zeros((n_g, 3))
    for g in range(n_g):
        if quaternion[g] < 0:
            R_W[g] = R[g]
            p_W[g] = p_0[g] + P[g] @ q
        else:
            k = quaternion[g]
            R_WB = rotation(q[k], q[k + 1], q[k + 2], q[k + 3])
            origin[g] = q[k + 4 : k + 7]
            R_W[g] = R_WB @ R[g]
            p_W[g] = origin[g] + R_WB @ p_0[g]
    return R_W, p_W, origin


@njit(cache=True)
def _distance(a, b, shape, size, R_W, p_W):
    """Gap of the shapes a and b, normal from b to a, nearest points on a and b."""
    if shape[a] == SPHERE:
        return sphere_against(p_W[a], size[a, 0], shape[b], size[b], R_W[b], p_W[b])
    gap, n, on_b, on_a = sphere_against(
        p_W[b], size[b, 0], shape[a], size[a], R_W[a], p_W[a]
    )
    return gap, -n, on_a, on_b


@njit(cache=True)
def _gaps(q, shape, size, quaternion, R, p_0, P, pairs):
    """(n_pairs,) gaps of all pairs of geometries at q (n_q,) [m]."""
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
    """A, B, D, d, E, F, H, c, phi and J_c of the LCS, and whether all are finite.
    Arguments: as ConstantMassModel and ContactRows."""
    n_v = f_0.size
    n_q = x.size - n_v
    q, v = x[:n_q].copy(), x[n_q:].copy()
    N, N_plus = velocity_maps(q, plain, floating, n_v)
    R_W, p_W, origin = _poses(q, quaternion, R, p_0, P)
    n_c, n_lam = pairs.shape[0], contact.size
    # Gap and Jacobian (along n, t1, t2) of each contact.
    phi, J = np.empty(n_c), np.empty((n_c, 3, n_v))
    J_n = np.empty((n_c, n_v))
    for i in range(n_c):
        a, b = pairs[i]
        phi[i], n, on_a, on_b = _distance(a, b, shape, size, R_W, p_W)
        J_a = point_jacobian(on_a - origin[a], omega[a], J_p[a])
        J_b = point_jacobian(on_b - origin[b], omega[b], J_p[b])
        J_w = J_a - J_b
        t1, t2 = tangent_basis(n, reference[i])
        along, across, aside = n @ J_w, t1 @ J_w, t2 @ J_w
        for j in range(n_v):
            J[i, 0, j], J[i, 1, j], J[i, 2, j] = along[j], across[j], aside[j]
            J_n[i, j] = along[j]
    # Of each force: what it pushes along, and its gap.
    J_c, phi_lam = np.empty((n_lam, n_v)), np.empty(n_lam)
    for k in range(n_lam):
        i = contact[k]
        for j in range(n_v):
            J_t = edge[k, 0] * J[i, 1, j] + edge[k, 1] * J[i, 2, j]
            J_c[k, j] = normal[k] * J[i, 0, j] + weight[k] * J_t
        phi_lam[k] = phi[i] if normal[k] > 0.0 else np.inf
    # Acceleration without contact, with the gyroscopic terms of bodies that turn.
    f = f_0 + J_v @ v + J_u @ u
    J_q = np.zeros((n_v, n_q))
    if len(turning) > 0:
        M_inv, J_v = M_inv.copy(), J_v.copy()
    for i in range(len(turning)):
        a, b = turning[i]
        R_WB = rotation(q[a], q[a + 1], q[a + 2], q[a + 3])
        f_i, J_angle, J_w, M_inv_i = rigid_body(R_WB, v[b : b + 3], body[i])
        turned = J_angle @ N_plus[b : b + 3, a : a + 4].copy()
        for j in range(6):
            f[b + j] += f_i[j]
            for m in range(4):
                J_q[b + j, a + m] = turned[j, m]
            for m in range(3):
                J_v[b + j, b + m] += J_w[j, m]
            for m in range(6):
                M_inv[b + j, b + m] = M_inv_i[j, m]
    A, B, D, d, E, F, H, c = assemble(
        x, f, J_q, J_v, J_u, u, M_inv @ J_c.T, N, N_plus, phi, J_n,
        J_c, contact, normal, F_0, dt,
    )  # fmt: skip
    return A, B, D, d, E, F, H, c, phi_lam, J_c, is_finite_model(c, d, F)
