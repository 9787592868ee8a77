"""Kinematics and dynamics of free rigid bodies: quaternion rates, Jacobians, forces."""

import numpy as np
from numba import njit


@njit(cache=True)
def rotation(w, x, y, z):
    """R (3, 3) of a unit quaternion w, x, y, z."""
    R = np.empty((3, 3))
    R[0, 0], R[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    R[2, 2] = 1 - 2 * (x * x + y * y)
    R[0, 1], R[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    R[0, 2], R[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    R[1, 2], R[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return R


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
        for k in range(3):
            for j in range(4):
                N[a + j, b + k] = 0.5 * L[j, k]
                N_plus[b + k, a + j] = 2.0 * L[j, k]
            N[a + 4 + k, b + 3 + k] = 1.0
            N_plus[b + 3 + k, a + 4 + k] = 1.0
    return N, N_plus


@njit(cache=True)
def point_jacobian(r, omega, J_p):
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
def _cross(a):
    """[a]x (3, 3): [a]x b = a x b."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2], m[1, 2] = -a[2], a[1], -a[0]
    m[1, 0], m[2, 0], m[2, 1] = a[2], -a[1], a[0]
    return m


@njit(cache=True)
def _times(a, b):
    """a x b (3,)."""
    out = np.empty(3)
    out[0], out[1] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True)
def _put(out, row, column, block):
    """Copies the block (3, 3) into out. Compiles far faster than a slice of out."""
    for i in range(3):
        for j in range(3):
            out[row + i, column + j] = block[i, j]


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
    dw = -I_inv @ _times(w, inertia @ w)
    F_v = C @ dw - _times(w, _times(w, c))
    G_w = -I_inv @ (_cross(w) @ inertia - _cross(inertia @ w))
    G_v = C @ G_w + _cross(_times(w, c)) + _cross(w) @ C
    f, J_angle, J_w = np.empty(6), np.empty((6, 3)), np.empty((6, 3))
    for i, F, G in ((0, dw, G_w), (3, F_v, G_v)):
        f_i, J_i = R @ F, R @ G @ R.T
        for k in range(3):
            f[i + k] = f_i[k]
        _put(J_w, i, 0, J_i)
        _put(J_angle, i, 0, J_i @ _cross(omega) - _cross(f_i))
    # v_origin = v_centre + C omega.
    M_inv, I_W, C_W = np.empty((6, 6)), R @ I_inv @ R.T, R @ C @ R.T
    _put(M_inv, 0, 0, I_W)
    _put(M_inv, 0, 3, I_W @ C_W.T)
    _put(M_inv, 3, 0, C_W @ I_W)
    _put(M_inv, 3, 3, np.eye(3) / mass + C_W @ I_W @ C_W.T)
    return f, J_angle, J_w, M_inv
