"""Kinematics and dynamics of an arm of revolute and prismatic joints, in world axes.

Mass matrix, Coriolis, centrifugal and gravity torque and the tip's Jacobian in one
compiled pass (about a tenth of the time that a general plant takes for them).

Spatial vectors are angular first and refer to the world's origin, so that they add
without a shift: twist [w, v0], force [n0, f].

Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008): recursive Newton-Euler
section 5.3, composite rigid body section 6.2.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics.packed import part


class SerialChain(NamedTuple):
    """Constants of the arm: link i moves about, or along, joint i, whose frame it has.

    For a prismatic joint read [m], [N], [kg] for [rad], [N m], [kg m2]."""

    R_PJ: np.ndarray  # (n, 3, 3) joint i in link i - 1's frame (the world's for i = 0),
    p_PJ: np.ndarray  # (n, 3) [m] at zero.
    slides: np.ndarray  # (n,) 1.0 if the joint is prismatic, else 0.0.
    axis: np.ndarray  # (n, 3) unit axis in its own frame.
    mass: np.ndarray  # (n,) [kg] with what is welded to the link.
    p_com: np.ndarray  # (n, 3) centre of mass in the link's frame [m].
    I_com: np.ndarray  # (n, 3, 3) inertia about it, in the link's axes [kg m2].
    rotor: np.ndarray  # (n,) inertia of the motors, reflected at the joints [kg m2].
    damping: np.ndarray  # (n,) viscous, of the joints [N m s/rad].
    gravity: np.ndarray  # (3,) [m/s2]
    R_LE: np.ndarray  # (3, 3) tip frame E in the last link's frame,
    p_LE: np.ndarray  # (3,) [m].


@numba.njit(cache=True)
def chain_of(flat):
    """The SerialChain of which `flat` is the packed array; no array is copied."""
    R_PJ, at = part(flat, 0)
    p_PJ, at = part(flat, at)
    slides, at = part(flat, at)
    axis, at = part(flat, at)
    mass, at = part(flat, at)
    p_com, at = part(flat, at)
    I_com, at = part(flat, at)
    rotor, at = part(flat, at)
    damping, at = part(flat, at)
    gravity, at = part(flat, at)
    R_LE, at = part(flat, at)
    p_LE, at = part(flat, at)
    n = mass.size
    return SerialChain(
        R_PJ.reshape((n, 3, 3)),
        p_PJ.reshape((n, 3)),
        slides,
        axis.reshape((n, 3)),
        mass,
        p_com.reshape((n, 3)),
        I_com.reshape((n, 3, 3)),
        rotor,
        damping,
        gravity,
        R_LE.reshape((3, 3)),
        p_LE,
    )


class ChainState(NamedTuple):
    M: np.ndarray  # (n, n) mass matrix with the rotors [kg m2].
    bias: np.ndarray  # (n,) torque for zero joint acceleration, against damping too.
    J: np.ndarray  # (6, n) of the tip: linear rows first, world axes.
    bias_a: np.ndarray  # (6,) the tip's acceleration at zero joint acceleration.
    p_WE: np.ndarray  # (3,) [m]
    R_WE: np.ndarray  # (3, 3)


@numba.njit(cache=True, inline="always")
def _cross(out, a, b):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


# Explicit loops: for so few numbers a BLAS call, or a new array for a sum, takes longer
# than the arithmetic.
@numba.njit(cache=True)
def _dot(a, b):
    total = 0.0
    for k in range(a.shape[0]):
        total += a[k] * b[k]
    return total


@numba.njit(cache=True)
def _matmul3(out, A, B):
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@numba.njit(cache=True)
def _forward(chain, q, R, p, z):
    """Fills each joint's rotation R (n, 3, 3), origin p (n, 3), axis z (n, 3)."""
    turn = np.empty((3, 3))
    fixed = np.empty((3, 3))
    for i in range(q.shape[0]):
        x, y, w = chain.axis[i]
        angle = 0.0 if chain.slides[i] else q[i]
        s, c = np.sin(angle), np.cos(angle)
        t = 1.0 - c
        turn[0, 0], turn[0, 1], turn[0, 2] = t * x * x + c, t * x * y - s * w, t * x * w
        turn[0, 2] += s * y
        turn[1, 0], turn[1, 1], turn[1, 2] = t * x * y + s * w, t * y * y + c, t * y * w
        turn[1, 2] -= s * x
        turn[2, 0], turn[2, 1], turn[2, 2] = t * x * w - s * y, t * y * w, t * w * w + c
        turn[2, 1] += s * x
        if i == 0:
            fixed[:] = chain.R_PJ[0]
            p[0] = chain.p_PJ[0]
        else:
            _matmul3(fixed, R[i - 1], chain.R_PJ[i])
            for k in range(3):
                p[i, k] = p[i - 1, k]
                for j in range(3):
                    p[i, k] += R[i - 1, k, j] * chain.p_PJ[i, j]
        _matmul3(R[i], fixed, turn)
        for k in range(3):
            z[i, k] = R[i, k, 0] * x + R[i, k, 1] * y + R[i, k, 2] * w
            if chain.slides[i]:
                p[i, k] += z[i, k] * q[i]


@numba.njit(cache=True)
def tip_kinematics(chain, q):
    """p_WE (3,) [m], R_WE (3, 3) and the tip's Jacobian J (6, n), linear rows first."""
    n = q.shape[0]
    R, p, z = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))
    _forward(chain, q, R, p, z)
    R_WE, p_WE, J = np.empty((3, 3)), np.empty(3), np.empty((6, n))
    _tip(chain, R, p, z, R_WE, p_WE, J)
    return p_WE, R_WE, J


@numba.njit(cache=True)
def _tip(chain, R, p, z, R_WE, p_WE, J):
    n = p.shape[0]
    _matmul3(R_WE, R[n - 1], chain.R_LE)
    for k in range(3):
        p_WE[k] = p[n - 1, k]
        for j in range(3):
            p_WE[k] += R[n - 1, k, j] * chain.p_LE[j]
    column, arm = np.empty(3), np.empty(3)
    for i in range(n):
        for k in range(3):
            arm[k] = p_WE[k] - p[i, k]
        _cross(column, z[i], arm)
        for k in range(3):
            J[k, i], J[3 + k, i] = column[k], z[i, k]
            if chain.slides[i]:
                J[k, i], J[3 + k, i] = z[i, k], 0.0


@numba.njit(cache=True)
def chain_state(chain, q, v):
    """All of ChainState at joint positions q (n,) and rates v (n,)."""
    n = q.shape[0]
    R, p, z = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))
    _forward(chain, q, R, p, z)
    R_WE, p_WE, J = np.empty((3, 3)), np.empty(3), np.empty((6, n))
    _tip(chain, R, p, z, R_WE, p_WE, J)

    # Each link's inertia about the world's origin: mass m, first moment h, matrix I.
    h, inertia = np.empty((n, 3)), np.empty((n, 3, 3))
    half, turned, com = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for i in range(n):
        _matmul3(half, R[i], chain.I_com[i])
        _matmul3(turned, half, R[i].T)
        for k in range(3):
            com[k] = p[i, k]
            for j in range(3):
                com[k] += R[i, k, j] * chain.p_com[i, j]
        m = chain.mass[i]
        square = com[0] ** 2 + com[1] ** 2 + com[2] ** 2
        for k in range(3):
            h[i, k] = m * com[k]
            for j in range(3):
                inertia[i, k, j] = turned[k, j] - m * com[k] * com[j]
            inertia[i, k, k] += m * square

    # Outward: twist V and acceleration A (without gravity) of each link at v, no vdot.
    S = np.empty((n, 6))
    V, A = np.zeros((n + 1, 6)), np.zeros((n + 1, 6))
    a, b = np.empty(3), np.empty(3)
    for i in range(n):
        _cross(a, p[i], z[i])
        for k in range(3):
            S[i, k], S[i, 3 + k] = z[i, k], a[k]
            if chain.slides[i]:
                S[i, k], S[i, 3 + k] = 0.0, z[i, k]
        w, u = V[i, :3], V[i, 3:]
        _cross(a, w, S[i, :3])
        for k in range(3):
            A[i + 1, k] = A[i, k] + a[k] * v[i]
        _cross(a, w, S[i, 3:])
        _cross(b, u, S[i, :3])
        for k in range(3):
            A[i + 1, 3 + k] = A[i, 3 + k] + (a[k] + b[k]) * v[i]
        for k in range(6):
            V[i + 1, k] = V[i, k] + S[i, k] * v[i]

    # Inward: forces for the bias, composite inertias for the mass matrix.
    M, bias = np.empty((n, n)), np.empty(n)
    f, momentum, total = np.zeros(6), np.empty(6), np.empty(6)
    m_c, h_c, I_c = 0.0, np.zeros(3), np.zeros((3, 3))
    lifted = np.empty(6)
    for i in range(n - 1, -1, -1):
        for k in range(3):
            lifted[k] = A[i + 1, k]
            lifted[3 + k] = A[i + 1, 3 + k] - chain.gravity[k]
        _momentum(total, chain.mass[i], h[i], inertia[i], lifted)
        _momentum(momentum, chain.mass[i], h[i], inertia[i], V[i + 1])
        w, u = V[i + 1, :3], V[i + 1, 3:]
        _cross(a, w, momentum[:3])
        _cross(b, u, momentum[3:])
        for k in range(3):
            total[k] += a[k] + b[k]
        _cross(a, w, momentum[3:])
        for k in range(3):
            total[3 + k] += a[k]
        for k in range(6):
            f[k] += total[k]
        bias[i] = _dot(S[i], f) + chain.damping[i] * v[i]
        m_c += chain.mass[i]
        for k in range(3):
            h_c[k] += h[i, k]
            for j in range(3):
                I_c[k, j] += inertia[i, k, j]
        _momentum(momentum, m_c, h_c, I_c, S[i])
        for j in range(i + 1):
            M[i, j] = M[j, i] = _dot(S[j], momentum)
        M[i, i] += chain.rotor[i]

    # Acceleration of the tip's point, from the twist's at the origin.
    bias_a = np.empty(6)
    w, alpha = V[n, :3], A[n, :3]
    _cross(a, w, p_WE)
    velocity = V[n, 3:] + a
    _cross(a, alpha, p_WE)
    _cross(b, w, velocity)
    for k in range(3):
        bias_a[k], bias_a[3 + k] = A[n, 3 + k] + a[k] + b[k], alpha[k]
    return ChainState(M, bias, J, bias_a, p_WE, R_WE)


@numba.njit(cache=True)
def _momentum(out, m, h, inertia, twist):
    """Spatial momentum [k0, l] of a body of mass m, first moment h, at the origin."""
    w, u = twist[:3], twist[3:]
    out[0] = h[1] * u[2] - h[2] * u[1]
    out[1] = h[2] * u[0] - h[0] * u[2]
    out[2] = h[0] * u[1] - h[1] * u[0]
    out[3] = w[1] * h[2] - w[2] * h[1]
    out[4] = w[2] * h[0] - w[0] * h[2]
    out[5] = w[0] * h[1] - w[1] * h[0]
    for k in range(3):
        out[k] += inertia[k, 0] * w[0] + inertia[k, 1] * w[1] + inertia[k, 2] * w[2]
        out[3 + k] += m * u[k]
