"""Motion of a tree of joints under its drives, with friction that locks, compiled.

    M(q) v' + bias(q, v, t) = let through(effort(q, v, command)) - damping v
                              + laws(q, v, t)

Joints turn or slide, each on a link before it or on the world. A drive is that of
models/effects/actuation_path.py: a loop of position and velocity with a ceiling and a
back-EMF, gain, bias, limit and lag after it, a gear that loses a share of the load.
Dry friction is steep where a joint stands still; steps are implicit in what a joint's
force owes to its own position and velocity, so that they need not be as short as that.
Friction of a solver that solves for it softly, as MuJoCo does, is linear where it is
not all, and minus ramp (v + lead v'): inertia and damping of a joint that it holds.

Steps: Shampine, Reichelt, SIAM J. Sci. Comput. 18(1), 1997, section 3.1 (ode23s), a
W-method: of second order with any Jacobian.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics.cholesky import cholesky, cholesky_solve
from makebreak.systems.numerics.body_laws import BodyLaws
from makebreak.systems.numerics.joint_laws import JointLaws, law_number
from makebreak.systems.numerics.joint_tree import JointTree, mass_and_bias

MOST_STEPS = 40_000  # Of one run: beyond it the parameters are given up.
NO_COMMAND, EFFORT, LOOP = 0, 1, 2  # What drives a joint.
_D = 1.0 / (2.0 + math.sqrt(2.0))
_E32 = 6.0 + math.sqrt(2.0)
_LEAST_STEP = 1e-9  # [s]
_MOST_SETS = 20  # Sets of joints that are tried as those that friction holds.


class DrivenArm(NamedTuple):
    """Constants, SI."""

    tree: JointTree
    driven: np.ndarray  # (n,) NO_COMMAND, EFFORT or LOOP.
    law: np.ndarray  # (n, 6) kp, kd, limit, emf, dead band, offset of the encoder.
    path: np.ndarray  # (n, 5) gain, bias, limit, time constant, share lost to friction.
    slow: np.ndarray  # (n,) speed below which a gear's friction fades.
    most: np.ndarray  # (n,) what the joint takes at most.
    soft: np.ndarray  # (n, 3) friction that holds softly: most, ramp, lead [s].
    laws: JointLaws  # Further forces on joints,
    pulls: BodyLaws  # and on links.


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
    return min(max(u, -arm.most[i]), arm.most[i]) - arm.tree.damping[i] * v


@numba.njit(cache=True)
def _forces(arm, t, q, v, y, told, out):
    """Fills the forces on the joints (n,), but what mass_and_bias gives."""
    for i in range(q.shape[0]):
        out[i] = _on_joint(arm, i, q[i], v[i], y[i], told[0, i], told[1, i])
    for j in range(arm.laws.joint.shape[0]):
        i = arm.laws.joint[j]
        out[i] += law_number(arm.laws.kind[j], q[i], v[i], t, arm.laws.p[j])


@numba.njit(cache=True)
def _slopes(arm, t, q, v, y, told, side, K, D):
    """How each joint's force falls with its own position K (n,) and velocity D (n,);
    where it would grow, 0: then nothing is implicit in it."""
    dq, dv = 1e-6, 1e-6
    for i in range(q.shape[0]):
        now = _on_joint(arm, i, q[i], v[i], y[i], told[0, i], told[1, i])
        K[i] = now - _on_joint(arm, i, q[i] + dq, v[i], y[i], told[0, i], told[1, i])
        D[i] = now - _on_joint(arm, i, q[i], v[i] + dv, y[i], told[0, i], told[1, i])
    for j in range(arm.laws.joint.shape[0]):
        i = arm.laws.joint[j]
        p, kind = arm.laws.p[j], arm.laws.kind[j]
        now = law_number(kind, q[i], v[i], t, p)
        K[i] += now - law_number(kind, q[i] + dq, v[i], t, p)
        D[i] += now - law_number(kind, q[i], v[i] + dv, t, p)
    for i in range(q.shape[0]):
        K[i] = max(K[i] / dq, 0.0)
        D[i] = max(D[i] / dv, 0.0)
        if side[i] == 0.0:
            D[i] += arm.soft[i, 1]


@numba.njit(cache=True)
def _rate(arm, t, x, told, M, L, bias, tau, side, out):
    """d/dt of x = [q, v, y] (3 n,), and the mass matrix M there; False if it is none.
    y: what the motors that lag give. side (n,): of soft friction, 0 where it is not
    all."""
    n = bias.shape[0]
    q, v, y = x[:n], x[n : 2 * n], x[2 * n :]
    mass_and_bias(arm.tree, arm.pulls, t, q, v, M, bias)
    _forces(arm, t, q, v, y, told, tau)
    for i in range(n):
        out[i] = v[i]
        tau[i] -= bias[i]
        T = arm.path[i, 3]
        out[2 * n + i] = 0.0
        if T > 0.0:
            u = _motor(arm, i, q[i], v[i], told[0, i], told[1, i])
            out[2 * n + i] = (u - y[i]) / T
        if arm.soft[i, 1] == 0.0:
            side[i] = 1.0
        elif side[i] == 0.0:
            M[i, i] += arm.soft[i, 1] * arm.soft[i, 2]
    for tried in range(_MOST_SETS):
        if not cholesky(L, M):
            return False
        for i in range(n):
            held = side[i] * arm.soft[i, 0] if side[i] else arm.soft[i, 1] * v[i]
            out[n + i] = tau[i] - held
        cholesky_solve(L, out[n : 2 * n])
        changes = 0
        for i in range(n):
            most, ramp, lead = arm.soft[i, 0], arm.soft[i, 1], arm.soft[i, 2]
            force = ramp * (v[i] + lead * out[n + i])
            if side[i] == 0.0 and abs(force) > most:
                side[i], more = math.copysign(1.0, force), -ramp * lead
            elif ramp > 0.0 and side[i] * force < most and side[i] != 0.0:
                side[i], more = 0.0, ramp * lead
            else:
                continue
            M[i, i] += more
            changes += 1
            if tried > 3:  # One after the other: all at once may come back.
                break
        if changes == 0:
            break
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
    side, then = np.zeros(n), np.zeros(n)
    for i in range(n):
        x[i], x[n + i] = q[i], v[i]
        x[2 * n + i] = _motor(arm, i, q[i], v[i], commands[0, 0, i], commands[0, 1, i])
    h, steps = 1e-3, 0
    for row in range(commands.shape[0]):
        t, end = times[row], times[row + 1]
        told = commands[row]
        if not _rate(arm, t, x, told, M, L, bias, tau, side, f0):
            return
        while end - t > 1e-12:
            steps += 1
            if steps > MOST_STEPS or h < _LEAST_STEP:
                return
            step = min(h, end - t)
            if end - t - step < 0.1 * step:
                step = end - t
            hd = step * _D
            _slopes(arm, t, x[:n], x[n : 2 * n], x[2 * n :], told, side, K, D)
            for i in range(n):
                for k in range(n):
                    W[i, k] = M[i, k]
                W[i, i] += hd * D[i] + hd * hd * K[i]
            if not cholesky(W, W):
                return
            _implicit(arm, M, W, K, step, f0, k1, b)
            for i in range(3 * n):
                mid[i] = x[i] + 0.5 * step * k1[i]
            then[:] = side
            good = _rate(arm, t + 0.5 * step, mid, told, other, L, bias, tau, then, f1)
            for i in range(3 * n):
                r[i] = f1[i] - k1[i]
            _implicit(arm, M, W, K, step, r, k2, b)
            for i in range(3 * n):
                k2[i] += k1[i]
                new[i] = x[i] + step * k2[i]
            good = good and _rate(
                arm, t + step, new, told, other, L, bias, tau, then, f2
            )
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
                    side[i] = then[i]
                    for k in range(n):
                        M[i, k] = other[i, k]
            grow = 0.8 * max(error, 1e-4) ** (-1.0 / 3.0)
            grown = step * min(max(grow, 0.2), 4.0)
            # A step that was cut short at the end says little of the next.
            h = grown if error > 1.0 or step >= h else max(h, grown)
        for i in range(2 * n):
            out[row, i] = x[i]
