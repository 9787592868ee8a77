"""A tree of joints that turn or slide, each on a link before it or on the world:
kinematics and dynamics, compiled.

Featherstone, "Rigid Body Dynamics Algorithms", 2008: recursive Newton-Euler (table 5.1)
and composite rigid bodies (table 6.2), here in world axes about the world's origin, so
that nothing is shifted between links. Spatial vectors are angular first.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.numerics.body_laws import NO_BODY_LAWS, BodyLaws
from makebreak.systems.numerics.body_laws import law_number as body_law_number
from makebreak.systems.numerics.joint_laws import JointLaws, law_number


class JointTree(NamedTuple):
    """Constants, SI. Link i moves by joint i; its frame is the joint's, on its side."""

    parent: np.ndarray  # (n,) int, less than i; -1 is the world.
    slides: np.ndarray  # (n,) bool
    R_PJ: np.ndarray  # (n, 3, 3) joint i in its parent's frame,
    p_PJ: np.ndarray  # (n, 3) at zero.
    axis: np.ndarray  # (n, 3) unit, in the joint's frame.
    mass: np.ndarray  # (n,) of the link and what is welded to it.
    p_com: np.ndarray  # (n, 3) in the link's frame.
    I_com: np.ndarray  # (n, 3, 3) about the centre of mass, in the link's axes.
    rotor: np.ndarray  # (n,) reflected at the joint.
    damping: np.ndarray  # (n,)
    gravity: np.ndarray  # (3,)


class Scratch(NamedTuple):
    """Of one state: rotations R, origins p, axes S (rotation first), mass, first moment
    and inertia of each link about the world's origin, twists, accelerations less
    gravity, forces."""

    R: np.ndarray
    p: np.ndarray
    S: np.ndarray
    m: np.ndarray
    h: np.ndarray
    I_o: np.ndarray
    V: np.ndarray
    A: np.ndarray
    F: np.ndarray


@numba.njit(cache=True, inline="always")
def scratch(n):
    """Room for n joints."""
    return Scratch(
        np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 6)), np.empty(n),
        np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 6)), np.empty((n, 6)),
        np.empty((n, 6)),
    )  # fmt: skip


def inverse_dynamics(
    tree: JointTree, q, v, vd, laws: JointLaws | None = None, time=None,
    pulls: BodyLaws = NO_BODY_LAWS,
) -> np.ndarray:  # fmt: skip
    """(m, n) efforts on the joints for motions q, v, vd (m, n), against gravity,
    damping, and further forces on joints and bodies at the times (m,) [s]."""
    q, v, vd = (np.ascontiguousarray(x, float) for x in (q, v, vd))
    out = np.empty(q.shape)
    time = np.zeros(len(q)) if time is None else np.asarray(time, float)
    _inverse_dynamics(tree, pulls, q, v, vd, time, out)
    if laws is not None and len(laws.joint):
        _less_laws(laws, q, v, time, out)
    return out


def momentum(tree: JointTree, q, v) -> np.ndarray:
    """(m, n) M(q) v of states q, v (m, n)."""
    none = np.zeros_like(tree.damping)
    still = tree._replace(gravity=np.zeros(3), damping=none)
    return inverse_dynamics(still, q, np.zeros_like(v), v)


def point_motion(tree: JointTree, link: int, p_L, R_L, q, v, vd):
    """Motion of a frame that a link carries, at p_L (3,) with axes R_L (3, 3) in the
    link's frame; link -1 is the world. As of SceneDynamics.body_motion: J (m, 6, n),
    V (m, 6), A (m, 6), R (m, 3, 3)."""
    q, v, vd = (np.ascontiguousarray(x, float) for x in (q, v, vd))
    m, n = q.shape
    J, V, A = np.zeros((m, 6, n)), np.zeros((m, 6)), np.zeros((m, 6))
    R = np.tile(np.asarray(R_L, float), (m, 1, 1))
    if link >= 0:
        p_L, R_L = np.array(p_L, float), np.array(R_L, float)
        _point_motion(tree, link, p_L, R_L, q, v, vd, J, V, A, R)
    return J, V, A, R


@numba.njit(cache=True, inline="always")
def place(tree, q, at):
    """Fills where links and joints are at q (n,), and what they weigh there."""
    R, p, S, m, h, I_o = at.R, at.p, at.S, at.m, at.h, at.I_o
    turn, fixed, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    z, c = np.empty(3), np.empty(3)
    for i in range(q.shape[0]):
        k = tree.parent[i]
        a0, a1, a2 = tree.axis[i, 0], tree.axis[i, 1], tree.axis[i, 2]
        if k < 0:
            for r in range(3):
                p[i, r] = tree.p_PJ[i, r]
                for s in range(3):
                    fixed[r, s] = tree.R_PJ[i, r, s]
        else:
            for r in range(3):
                p[i, r] = p[k, r]
                for s in range(3):
                    p[i, r] += R[k, r, s] * tree.p_PJ[i, s]
                    fixed[r, s] = (
                        R[k, r, 0] * tree.R_PJ[i, 0, s]
                        + R[k, r, 1] * tree.R_PJ[i, 1, s]
                        + R[k, r, 2] * tree.R_PJ[i, 2, s]
                    )
        for r in range(3):
            z[r] = fixed[r, 0] * a0 + fixed[r, 1] * a1 + fixed[r, 2] * a2
        if tree.slides[i]:
            for r in range(3):
                p[i, r] += z[r] * q[i]
                S[i, r], S[i, 3 + r] = 0.0, z[r]
                for s in range(3):
                    R[i, r, s] = fixed[r, s]
        else:
            si, co = math.sin(q[i]), math.cos(q[i])
            t = 1.0 - co
            turn[0, 0], turn[0, 1] = t * a0 * a0 + co, t * a0 * a1 - si * a2
            turn[0, 2], turn[1, 0] = t * a0 * a2 + si * a1, t * a0 * a1 + si * a2
            turn[1, 1], turn[1, 2] = t * a1 * a1 + co, t * a1 * a2 - si * a0
            turn[2, 0], turn[2, 1] = t * a0 * a2 - si * a1, t * a1 * a2 + si * a0
            turn[2, 2] = t * a2 * a2 + co
            for r in range(3):
                for s in range(3):
                    R[i, r, s] = (
                        fixed[r, 0] * turn[0, s]
                        + fixed[r, 1] * turn[1, s]
                        + fixed[r, 2] * turn[2, s]
                    )
            S[i, 0], S[i, 1], S[i, 2] = z[0], z[1], z[2]
            S[i, 3] = p[i, 1] * z[2] - p[i, 2] * z[1]
            S[i, 4] = p[i, 2] * z[0] - p[i, 0] * z[2]
            S[i, 5] = p[i, 0] * z[1] - p[i, 1] * z[0]
        # The link's inertia about the world's origin: mass, first moment, matrix.
        for r in range(3):
            c[r] = p[i, r]
            for s in range(3):
                c[r] += R[i, r, s] * tree.p_com[i, s]
                half[r, s] = (
                    R[i, r, 0] * tree.I_com[i, 0, s]
                    + R[i, r, 1] * tree.I_com[i, 1, s]
                    + R[i, r, 2] * tree.I_com[i, 2, s]
                )
        m[i] = tree.mass[i]
        square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
        for r in range(3):
            h[i, r] = m[i] * c[r]
            for s in range(3):
                I_o[i, r, s] = (
                    half[r, 0] * R[i, s, 0]
                    + half[r, 1] * R[i, s, 1]
                    + half[r, 2] * R[i, s, 2]
                    - m[i] * c[r] * c[s]
                )
            I_o[i, r, r] += m[i] * square


@numba.njit(cache=True, inline="always")
def newton_euler(tree, v, vd, at):
    """Fills twists, accelerations and forces of links that were placed, at rates v and
    vd (n,); gravity is an acceleration of the base."""
    S, m, h, I_o, V, A, F = at.S, at.m, at.h, at.I_o, at.V, at.A, at.F
    force, momentum = np.empty(6), np.empty(6)
    for i in range(v.shape[0]):
        k = tree.parent[i]
        for r in range(6):
            V[i, r] = 0.0
            A[i, r] = 0.0
        if k < 0:
            for r in range(3):
                A[i, 3 + r] = -tree.gravity[r]
        else:
            for r in range(6):
                V[i, r], A[i, r] = V[k, r], A[k, r]
            w0, w1, w2 = V[k, 0], V[k, 1], V[k, 2]
            u0, u1, u2 = V[k, 3], V[k, 4], V[k, 5]
            s0, s1, s2 = S[i, 0] * v[i], S[i, 1] * v[i], S[i, 2] * v[i]
            s3, s4, s5 = S[i, 3] * v[i], S[i, 4] * v[i], S[i, 5] * v[i]
            A[i, 0] += w1 * s2 - w2 * s1
            A[i, 1] += w2 * s0 - w0 * s2
            A[i, 2] += w0 * s1 - w1 * s0
            A[i, 3] += w1 * s5 - w2 * s4 + u1 * s2 - u2 * s1
            A[i, 4] += w2 * s3 - w0 * s5 + u2 * s0 - u0 * s2
            A[i, 5] += w0 * s4 - w1 * s3 + u0 * s1 - u1 * s0
        for r in range(6):
            V[i, r] += S[i, r] * v[i]
            A[i, r] += S[i, r] * vd[i]
        _times(force, m[i], h[i], I_o[i], A[i])
        _times(momentum, m[i], h[i], I_o[i], V[i])
        w0, w1, w2 = V[i, 0], V[i, 1], V[i, 2]
        u0, u1, u2 = V[i, 3], V[i, 4], V[i, 5]
        k0, k1, k2, l0, l1, l2 = (
            momentum[0], momentum[1], momentum[2], momentum[3], momentum[4],
            momentum[5],
        )  # fmt: skip
        F[i, 0] = force[0] + w1 * k2 - w2 * k1 + u1 * l2 - u2 * l1
        F[i, 1] = force[1] + w2 * k0 - w0 * k2 + u2 * l0 - u0 * l2
        F[i, 2] = force[2] + w0 * k1 - w1 * k0 + u0 * l1 - u1 * l0
        F[i, 3] = force[3] + w1 * l2 - w2 * l1
        F[i, 4] = force[4] + w2 * l0 - w0 * l2
        F[i, 5] = force[5] + w0 * l1 - w1 * l0


@numba.njit(cache=True)
def less_pulls(pulls, t, at):
    """Takes what pulls at links, moving as `newton_euler` has it, off their forces."""
    V, p, F = np.empty(6), np.empty(3), np.empty(6)
    for j in range(pulls.link.shape[0]):
        i = pulls.link[j]
        if i < 0:
            continue
        for r in range(3):
            p[r] = at.p[i, r]
            for s in range(3):
                p[r] += at.R[i, r, s] * pulls.p_L[j, s]
        _shifted(V, at.V[i], p)
        F[:] = 0.0
        body_law_number(pulls.kind[j], V, t, pulls.p[j], F)
        at.F[i, 0] -= F[0] + p[1] * F[5] - p[2] * F[4]
        at.F[i, 1] -= F[1] + p[2] * F[3] - p[0] * F[5]
        at.F[i, 2] -= F[2] + p[0] * F[4] - p[1] * F[3]
        for r in range(3, 6):
            at.F[i, r] -= F[r]


@numba.njit(cache=True)
def mass_and_bias(tree, pulls, t, q, v, M, bias):
    """Fills the mass matrix M (n, n) with rotors, and the forces bias (n,) that hold
    the velocities v as they are, against gravity and what pulls at links at time t."""
    n = q.shape[0]
    at, none = scratch(n), np.zeros(n)
    place(tree, q, at)
    newton_euler(tree, v, none, at)
    less_pulls(pulls, t, at)
    S, m, h, I_o, F = at.S, at.m, at.h, at.I_o, at.F
    momentum = np.empty(6)
    for i in range(n - 1, -1, -1):
        total = 0.0
        for r in range(6):
            total += S[i, r] * F[i, r]
        bias[i] = total
        _times(momentum, m[i], h[i], I_o[i], S[i])
        for j in range(i):
            M[i, j] = 0.0
            M[j, i] = 0.0
        j = i
        while j >= 0:
            total = 0.0
            for r in range(6):
                total += S[j, r] * momentum[r]
            M[i, j] = total
            M[j, i] = total
            j = tree.parent[j]
        M[i, i] += tree.rotor[i]
        k = tree.parent[i]
        if k >= 0:
            m[k] += m[i]
            for r in range(3):
                h[k, r] += h[i, r]
                for s in range(3):
                    I_o[k, r, s] += I_o[i, r, s]
            for r in range(6):
                F[k, r] += F[i, r]


@numba.njit(cache=True, inline="always")
def _times(out, m, h, I_o, twist):
    """Spatial momentum [about the origin, linear] of an inertia moving by a twist."""
    w0, w1, w2 = twist[0], twist[1], twist[2]
    u0, u1, u2 = twist[3], twist[4], twist[5]
    out[0] = I_o[0, 0] * w0 + I_o[0, 1] * w1 + I_o[0, 2] * w2 + h[1] * u2 - h[2] * u1
    out[1] = I_o[1, 0] * w0 + I_o[1, 1] * w1 + I_o[1, 2] * w2 + h[2] * u0 - h[0] * u2
    out[2] = I_o[2, 0] * w0 + I_o[2, 1] * w1 + I_o[2, 2] * w2 + h[0] * u1 - h[1] * u0
    out[3] = m * u0 + w1 * h[2] - w2 * h[1]
    out[4] = m * u1 + w2 * h[0] - w0 * h[2]
    out[5] = m * u2 + w0 * h[1] - w1 * h[0]


@numba.njit(cache=True)
def _inverse_dynamics(tree, pulls, q, v, vd, time, out):
    n = q.shape[1]
    at = scratch(n)
    S, F = at.S, at.F
    for row in range(q.shape[0]):
        place(tree, q[row], at)
        newton_euler(tree, v[row], vd[row], at)
        less_pulls(pulls, time[row], at)
        for i in range(n - 1, -1, -1):
            total = tree.rotor[i] * vd[row, i] + tree.damping[i] * v[row, i]
            for r in range(6):
                total += S[i, r] * F[i, r]
            out[row, i] = total
            k = tree.parent[i]
            if k >= 0:
                for r in range(6):
                    F[k, r] += F[i, r]


@numba.njit(cache=True)
def _less_laws(laws, q, v, time, out):
    for j in range(laws.joint.shape[0]):
        i, kind, p = laws.joint[j], laws.kind[j], laws.p[j]
        for row in range(q.shape[0]):
            out[row, i] -= law_number(kind, q[row, i], v[row, i], time[row], p)


@numba.njit(cache=True)
def _point_motion(tree, link, p_L, R_L, q, v, vd, J, V, A, R):
    at, p = scratch(q.shape[1]), np.empty(3)
    for row in range(q.shape[0]):
        place(tree, q[row], at)
        newton_euler(tree, v[row], vd[row], at)
        turn = at.R[link]
        for r in range(3):
            p[r] = at.p[link, r]
            for s in range(3):
                p[r] += turn[r, s] * p_L[s]
                R[row, r, s] = 0.0
                for t in range(3):
                    R[row, r, s] += turn[r, t] * R_L[t, s]
        i = link
        while i >= 0:
            _shifted(J[row, :, i], at.S[i], p)
            i = tree.parent[i]
        _shifted(V[row], at.V[link], p)
        _shifted(A[row], at.A[link], p)
        w, u = V[row, :3], V[row, 3:]
        A[row, 3] += tree.gravity[0] + w[1] * u[2] - w[2] * u[1]
        A[row, 4] += tree.gravity[1] + w[2] * u[0] - w[0] * u[2]
        A[row, 5] += tree.gravity[2] + w[0] * u[1] - w[1] * u[0]


@numba.njit(cache=True)
def _shifted(out, twist, p):
    """A twist about the origin as one at p (3,)."""
    w0, w1, w2 = twist[0], twist[1], twist[2]
    out[0], out[1], out[2] = w0, w1, w2
    out[3] = twist[3] + w1 * p[2] - w2 * p[1]
    out[4] = twist[4] + w2 * p[0] - w0 * p[2]
    out[5] = twist[5] + w0 * p[1] - w1 * p[0]
