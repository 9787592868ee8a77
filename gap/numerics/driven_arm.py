"""Motion of a tree of joints under its drives, with friction that locks, compiled.

    M(q) v' + bias(q, v) = let through(effort(q, v, command)) - damping v + laws(q, v)

Joints turn or slide, each on a link before it or on the world. A drive is that of
models/effects/actuation_path.py: a loop of position and velocity with a ceiling and a
back-EMF, gain, bias, limit and lag after it, a gear that loses a share of the load.
Dry friction is steep where a joint stands still; steps are implicit in what a joint's
force owes to its own position and velocity, so that they need not be as short as that.

Dynamics: Featherstone, "Rigid Body Dynamics Algorithms", 2008: recursive Newton-Euler
(table 5.1) and composite rigid bodies (table 6.2), here in world axes about the world's
origin, so that nothing is shifted between links. Steps: Shampine, Reichelt, SIAM J.
Sci. Comput. 18(1), 1997, section 3.1 (ode23s), a W-method: of second order with any
Jacobian.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics.cholesky import cholesky, cholesky_solve
from makebreak.systems.numerics.joint_laws import law_number

MOST_STEPS = 40_000  # Of one run: beyond it the parameters are given up.
NO_COMMAND, EFFORT, LOOP = 0, 1, 2  # What drives a joint.
_D = 1.0 / (2.0 + math.sqrt(2.0))
_E32 = 6.0 + math.sqrt(2.0)
_LEAST_STEP = 1e-9  # [s]


class DrivenArm(NamedTuple):
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
    driven: np.ndarray  # (n,) NO_COMMAND, EFFORT or LOOP.
    law: np.ndarray  # (n, 6) kp, kd, limit, emf, dead band, offset of the encoder.
    path: np.ndarray  # (n, 5) gain, bias, limit, time constant, share lost to friction.
    slow: np.ndarray  # (n,) speed below which a gear's friction fades.
    most: np.ndarray  # (n,) what the joint takes at most.
    law_joint: np.ndarray  # (m,) int: the joint of each further force,
    law_kind: np.ndarray  # (m,) int: its number in joint_laws.LAWS,
    law_p: np.ndarray  # (m, 5) and its numbers.


def rollout(arm: DrivenArm, q, v, times, commands, tol: float = 1e-3) -> np.ndarray:
    """(m, 2 n) positions and velocities at the times[1:] (m,); NaN from where the steps
    became too short or too many.

    Args: q, v (n,) at times[0]. commands (m, 2, n): what holds until each of these
        times: position (or effort, where that is commanded) and velocity. tol: error of
        a step, of velocities [rad/s] or [m/s], and a hundredth of it of positions.
    """
    out = np.full((len(times) - 1, 2 * len(q)), np.nan)
    _run(
        arm, np.array(q, float), np.array(v, float), np.asarray(times, float),
        np.ascontiguousarray(commands, float), float(tol), out,
    )  # fmt: skip
    return out


@numba.njit(cache=True)
def mass_and_bias(arm, q, v, M, bias):
    """Fills the mass matrix M (n, n) with rotors, and the forces bias (n,) that hold
    the velocities v as they are, gravity with them."""
    n = q.shape[0]
    R, p = np.empty((n, 3, 3)), np.empty((n, 3))
    S, V, A, F = np.empty((n, 6)), np.empty((n, 6)), np.empty((n, 6)), np.empty((n, 6))
    m, h, I_o = np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3))
    turn, fixed, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    z, c, force = np.empty(3), np.empty(3), np.empty(6)
    momentum = np.empty(6)
    for i in range(n):
        k = arm.parent[i]
        a0, a1, a2 = arm.axis[i, 0], arm.axis[i, 1], arm.axis[i, 2]
        if k < 0:
            for r in range(3):
                p[i, r] = arm.p_PJ[i, r]
                for s in range(3):
                    fixed[r, s] = arm.R_PJ[i, r, s]
        else:
            for r in range(3):
                p[i, r] = p[k, r]
                for s in range(3):
                    p[i, r] += R[k, r, s] * arm.p_PJ[i, s]
                    fixed[r, s] = (
                        R[k, r, 0] * arm.R_PJ[i, 0, s]
                        + R[k, r, 1] * arm.R_PJ[i, 1, s]
                        + R[k, r, 2] * arm.R_PJ[i, 2, s]
                    )
        for r in range(3):
            z[r] = fixed[r, 0] * a0 + fixed[r, 1] * a1 + fixed[r, 2] * a2
        if arm.slides[i]:
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
                c[r] += R[i, r, s] * arm.p_com[i, s]
                half[r, s] = (
                    R[i, r, 0] * arm.I_com[i, 0, s]
                    + R[i, r, 1] * arm.I_com[i, 1, s]
                    + R[i, r, 2] * arm.I_com[i, 2, s]
                )
        m[i] = arm.mass[i]
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
        # Twist, and acceleration at constant velocities, gravity as one of the base.
        for r in range(6):
            V[i, r] = 0.0
            A[i, r] = 0.0
        if k < 0:
            for r in range(3):
                A[i, 3 + r] = -arm.gravity[r]
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
            j = arm.parent[j]
        M[i, i] += arm.rotor[i]
        k = arm.parent[i]
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
def _motor(arm, i, q, v, told, told_rate):
    """Effort of a motor before its lag."""
    if arm.driven[i] == 0:
        return 0.0
    if arm.driven[i] == 1:
        u = told
    else:
        e = told - q - arm.law[i, 5]
        band = arm.law[i, 4]
        e = max(e - band, 0.0) if e > 0.0 else min(e + band, 0.0)
        u = arm.law[i, 0] * e + arm.law[i, 1] * (told_rate - v)
        limit = arm.law[i, 2]
        u = min(max(u, -limit), limit) - arm.law[i, 3] * v
    u = arm.path[i, 0] * u + arm.path[i, 1]
    limit = arm.path[i, 2]
    return min(max(u, -limit), limit)


@numba.njit(cache=True)
def _on_joint(arm, i, q, v, y, told, told_rate):
    """Effort on the joint; y: of the motor if it lags."""
    u = y if arm.path[i, 3] > 0.0 else _motor(arm, i, q, v, told, told_rate)
    share = arm.path[i, 4]
    if share > 0.0 and u != 0.0:
        lost = share * math.tanh(v / arm.slow[i])
        u = u / (1.0 + lost) if u > 0.0 else u / (1.0 - lost)
    return min(max(u, -arm.most[i]), arm.most[i]) - arm.damping[i] * v


@numba.njit(cache=True)
def _forces(arm, t, q, v, y, told, out):
    """Fills the forces on the joints (n,), but what mass_and_bias gives."""
    for i in range(q.shape[0]):
        out[i] = _on_joint(arm, i, q[i], v[i], y[i], told[0, i], told[1, i])
    for j in range(arm.law_joint.shape[0]):
        i = arm.law_joint[j]
        out[i] += law_number(arm.law_kind[j], q[i], v[i], t, arm.law_p[j])


@numba.njit(cache=True)
def _slopes(arm, t, q, v, y, told, K, D):
    """How each joint's force falls with its own position K (n,) and velocity D (n,);
    where it would grow, 0: then nothing is implicit in it."""
    dq, dv = 1e-6, 1e-6
    for i in range(q.shape[0]):
        now = _on_joint(arm, i, q[i], v[i], y[i], told[0, i], told[1, i])
        K[i] = now - _on_joint(arm, i, q[i] + dq, v[i], y[i], told[0, i], told[1, i])
        D[i] = now - _on_joint(arm, i, q[i], v[i] + dv, y[i], told[0, i], told[1, i])
    for j in range(arm.law_joint.shape[0]):
        i = arm.law_joint[j]
        p, kind = arm.law_p[j], arm.law_kind[j]
        now = law_number(kind, q[i], v[i], t, p)
        K[i] += now - law_number(kind, q[i] + dq, v[i], t, p)
        D[i] += now - law_number(kind, q[i], v[i] + dv, t, p)
    for i in range(q.shape[0]):
        K[i] = max(K[i] / dq, 0.0)
        D[i] = max(D[i] / dv, 0.0)


@numba.njit(cache=True)
def _rate(arm, t, x, told, M, L, bias, tau, out):
    """d/dt of x = [q, v, y] (3 n,), and the mass matrix M there; False if it is none.
    y: what the motors that lag give."""
    n = bias.shape[0]
    q, v, y = x[:n], x[n : 2 * n], x[2 * n :]
    mass_and_bias(arm, q, v, M, bias)
    _forces(arm, t, q, v, y, told, tau)
    for i in range(n):
        out[i] = v[i]
        tau[i] -= bias[i]
        T = arm.path[i, 3]
        out[2 * n + i] = 0.0
        if T > 0.0:
            u = _motor(arm, i, q[i], v[i], told[0, i], told[1, i])
            out[2 * n + i] = (u - y[i]) / T
    if not cholesky(L, M):
        return False
    cholesky_solve(L, tau)
    for i in range(n):
        out[n + i] = tau[i]
    return True


@numba.njit(cache=True)
def _implicit(arm, M, L, K, h, r, out, b):
    """out = W^-1 r with W = 1 - h d J of ode23s, all (3 n,). L: the factor of
    M + hd D + (hd)^2 K."""
    n = M.shape[0]
    hd = h * _D
    for i in range(n):
        b[i] = -hd * K[i] * r[i]
        for k in range(n):
            b[i] += M[i, k] * r[n + k]
    cholesky_solve(L, b)
    for i in range(n):
        out[n + i] = b[i]
        out[i] = r[i] + hd * b[i]
        T = arm.path[i, 3]
        out[2 * n + i] = r[2 * n + i] / (1.0 + hd / T) if T > 0.0 else 0.0


@numba.njit(cache=True)
def _run(arm, q, v, times, commands, tol, out):
    n = q.shape[0]
    x, new, mid = np.empty(3 * n), np.empty(3 * n), np.empty(3 * n)
    f0, f1, f2 = np.empty(3 * n), np.empty(3 * n), np.empty(3 * n)
    k1, k2, k3, r = np.empty(3 * n), np.empty(3 * n), np.empty(3 * n), np.empty(3 * n)
    M, other = np.empty((n, n)), np.empty((n, n))
    L, W = np.empty((n, n)), np.empty((n, n))
    bias, tau, K, D, b = (
        np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n),
    )  # fmt: skip
    for i in range(n):
        x[i], x[n + i] = q[i], v[i]
        x[2 * n + i] = _motor(arm, i, q[i], v[i], commands[0, 0, i], commands[0, 1, i])
    h, steps = 1e-3, 0
    for row in range(commands.shape[0]):
        t, end = times[row], times[row + 1]
        told = commands[row]
        if not _rate(arm, t, x, told, M, L, bias, tau, f0):
            return
        while end - t > 1e-12:
            steps += 1
            if steps > MOST_STEPS or h < _LEAST_STEP:
                return
            step = min(h, end - t)
            if end - t - step < 0.1 * step:
                step = end - t
            hd = step * _D
            _slopes(arm, t, x[:n], x[n : 2 * n], x[2 * n :], told, K, D)
            for i in range(n):
                for k in range(n):
                    W[i, k] = M[i, k]
                W[i, i] += hd * D[i] + hd * hd * K[i]
            if not cholesky(W, W):
                return
            _implicit(arm, M, W, K, step, f0, k1, b)
            for i in range(3 * n):
                mid[i] = x[i] + 0.5 * step * k1[i]
            good = _rate(arm, t + 0.5 * step, mid, told, other, L, bias, tau, f1)
            for i in range(3 * n):
                r[i] = f1[i] - k1[i]
            _implicit(arm, M, W, K, step, r, k2, b)
            for i in range(3 * n):
                k2[i] += k1[i]
                new[i] = x[i] + step * k2[i]
            good = good and _rate(arm, t + step, new, told, other, L, bias, tau, f2)
            for i in range(3 * n):
                r[i] = f2[i] - _E32 * (k2[i] - f1[i]) - 2.0 * (k1[i] - f0[i])
            _implicit(arm, M, W, K, step, r, k3, b)
            error = 0.0
            for i in range(2 * n):
                e = abs(step / 6.0 * (k1[i] - 2.0 * k2[i] + k3[i]))
                e /= tol if i >= n else 0.01 * tol
                error = max(error, e)
            if not (good and error < 1e9):  # NaN, too.
                h = 0.1 * step
                continue
            if error <= 1.0:
                t += step
                for i in range(3 * n):
                    x[i], f0[i] = new[i], f2[i]
                for i in range(n):
                    for k in range(n):
                        M[i, k] = other[i, k]
            grow = 0.8 * max(error, 1e-4) ** (-1.0 / 3.0)
            grown = step * min(max(grow, 0.2), 4.0)
            # A step that was cut short at the end says little of the next.
            h = grown if error > 1.0 or step >= h else max(h, grown)
        for i in range(2 * n):
            out[row, i] = x[i]
