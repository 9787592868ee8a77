"""Cartesian impedance of a redundant arm: one tick, from measurement to joint torque.

    F = K (x_d - x) + D (v_d - v) + f_ff + Lambda (a_d - Jdot qdot)
    tau = J' F + bias + N' M (k_q (q_n - q) + k_v (v_n - v))
    N' = I - J' Lambda J inv(M)

M is the mass matrix with the motors' rotors, so tau is a motor's torque; Lambda is the
inverse of J inv(M) J'. Stiffness K and damping D are plain N/m and N s/m, not scaled by
Lambda, which multiplies the reference's acceleration alone. The posture q_n follows the
tip with the tool upright; v_n is the joint velocity that does so.

Source: Khatib, "A unified approach for motion and force control of robot manipulators:
the operational space formulation" (1987), sections III and V.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.numerics.serial_chain import (
    SerialChain,
    chain_state,
    tip_kinematics,
)

# Status bits.
REFERENCE_HELD = 1
SENSORS_HELD = 2
EFFORT_LIMITED = 4
RATE_LIMITED = 8

IK_DAMPING = 0.02  # [m] and [rad]: of the posture's inverse kinematics.
IK_STEP_MAX = 0.05  # [rad] a joint of the posture moves in one step.
LIMIT_MARGIN = 0.03  # [rad] that the posture keeps from the joint limits.


class Law(NamedTuple):
    """Constants of the control law for n joints."""

    effort_max: np.ndarray  # (n,) [N m]
    step_max: np.ndarray  # (n,) change of torque in one tick [N m].
    q_lower: np.ndarray  # (n,) [rad]
    q_upper: np.ndarray  # (n,) [rad]
    q_nominal: np.ndarray  # (n,) posture where the task leaves a choice [rad].
    R_upright: np.ndarray  # (3, 3) orientation of the tip frame that counts as upright.
    stiffness: np.ndarray  # (6,) [N/m] x 3, [N m/rad] x 3
    damping: np.ndarray  # (6,) [N s/m] x 3, [N m s/rad] x 3
    posture_stiffness: float  # k_q [1/s2]
    posture_damping: float  # k_v [1/s]
    posture_every: int  # Ticks between two steps of the posture.
    control_orientation: bool  # The task is the full pose, not the position alone.
    period: float  # Of a tick [s].


def memory_size(n: int) -> int:
    """[q_n, last good q, last good pose (7), ticks, has a good pose, has a good q]."""
    return 2 * n + 10


@numba.njit(cache=True)
def cholesky(L, A):
    """Lower factor of A (n, n); False if A is not positive definite."""
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if not d > 0.0:
            return False
        d = np.sqrt(d)
        L[j, j] = d
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / d
    return True


@numba.njit(cache=True)
def forward_solve(L, b):
    """In place: b becomes inv(L) b, b (n,)."""
    for i in range(L.shape[0]):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@numba.njit(cache=True)
def cholesky_solve(L, b):
    """In place: b becomes inv(L L') b."""
    forward_solve(L, b)
    n = L.shape[0]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= L[k, i] * b[k]
        b[i] = s / L[i, i]


@numba.njit(cache=True)
def rotation_of(quaternion):
    """(3, 3) of a quaternion wxyz of any length but 0."""
    w, x, y, z = quaternion / np.sqrt(np.sum(quaternion**2))
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 0.0
    R[0, 2] = 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 0.0
    R[1, 2] = 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 0.0
    R[2, 2] = 1 - 2 * (x * x + y * y)
    return R


@numba.njit(cache=True)
def quaternion_of(R):
    """wxyz of a rotation (3, 3), w >= 0."""
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    best = max(trace, R[0, 0], R[1, 1], R[2, 2])
    if best == trace:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = 0 if best == R[0, 0] else (1 if best == R[1, 1] else 2)
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j], q[1 + k] = R[i, j] + R[j, i], R[i, k] + R[k, i]
    q /= np.sqrt(np.sum(q**2))
    return q if q[0] >= 0.0 else -q


@numba.njit(cache=True)
def rotation_error(R_d, R):
    """Rotation vector (3,) [rad], world axes, that takes R to R_d."""
    E = R_d @ R.T
    q = quaternion_of(E)
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if sine < 1e-9:
        return 2.0 * q[1:]
    return (2.0 * np.arctan2(sine, q[0]) / sine) * q[1:]


@numba.njit(cache=True)
def posture_step(chain, law, q_n, p_tip):
    """q_n (n,) one damped step nearer to: tip at p_tip (3,), upright, else nominal."""
    n = q_n.shape[0]
    p, R, J = tip_kinematics(chain, q_n)
    pull = 0.05 * (law.q_nominal - q_n)
    error = np.empty(6)
    error[:3] = p_tip - p
    error[3:] = rotation_error(law.R_upright, R)
    step = pull + _damped_inverse(J, error - J @ pull)
    out = np.empty(n)
    for i in range(n):
        change = min(max(step[i], -IK_STEP_MAX), IK_STEP_MAX)
        lower, upper = law.q_lower[i] + LIMIT_MARGIN, law.q_upper[i] - LIMIT_MARGIN
        out[i] = min(max(q_n[i] + change, lower), upper)
    return out


@numba.njit(cache=True)
def _damped_inverse(J, y):
    """J' inv(J J' + damping^2 I) y: joint motion (n,) for a tip motion y (6,)."""
    A = J @ J.T
    for i in range(6):
        A[i, i] += IK_DAMPING**2
    L = np.zeros((6, 6))
    cholesky(L, A)
    x = y.copy()
    cholesky_solve(L, x)
    return J.T @ x


@numba.njit(cache=True)
def impedance_torque(chain, law, q, v, q_n, x_d, R_d, stiffness, damping, wrench):
    """The law, without limits.

    Args: chain, law: constants. q, v, q_n (n,) [rad], [rad/s]. x_d (19,) =
        [p, quaternion (unused), v, w, a, alpha] of the tip in the world; R_d (3, 3)
        its orientation. stiffness, damping (6,); wrench (6,) fed forward, force first
        [N], [N m].
    Returns: tau (n,) [N m] and the tip's position p_WE (3,) [m].
    """
    n = q.shape[0]
    s = chain_state(chain, q, v)
    m = 6 if law.control_orientation else 3
    J = np.ascontiguousarray(s.J[:m])
    L = np.zeros((n, n))
    cholesky(L, s.M)  # Positive definite by construction.
    X = np.ascontiguousarray(J.T)
    column = np.empty(n)
    for j in range(m):
        column[:] = X[:, j]
        forward_solve(L, column)
        X[:, j] = column
    mobility = X.T @ X  # J inv(M) J'
    largest = 0.0
    for i in range(m):
        largest = max(largest, mobility[i, i])
    for i in range(m):
        mobility[i, i] += 1e-9 * largest  # Near a singular pose Lambda stays finite.
    L_task = np.zeros((m, m))
    cholesky(L_task, mobility)

    twist = J @ v
    F = np.empty(m)
    F[:3] = stiffness[:3] * (x_d[:3] - s.p_WE) + damping[:3] * (x_d[7:10] - twist[:3])
    a_ref = np.empty(m)
    a_ref[:3] = x_d[13:16]
    if m == 6:
        # Explicit damping d is stable while d period < inertia; the wrist's may be
        # small, so stiffness and damping are lessened together where it is.
        turning = mobility[3, 3] + mobility[4, 4] + mobility[5, 5]
        most = max(damping[3], damping[4], damping[5]) * turning * law.period
        scale = 1.0 if most < 0.5 else 0.5 / most
        turn = rotation_error(R_d, s.R_WE)
        F[3:] = scale * (stiffness[3:] * turn + damping[3:] * (x_d[10:13] - twist[3:]))
        a_ref[3:] = x_d[16:19]
    F += wrench[:m]

    # Posture: the acceleration it asks for, less the part that the tip would feel.
    follow = np.zeros(6)
    follow[:m] = twist
    v_n = _damped_inverse(s.J, follow)
    qdd = law.posture_stiffness * (q_n - q) + law.posture_damping * (v_n - v)
    inertial = a_ref - s.bias_a[:m] - J @ qdd
    cholesky_solve(L_task, inertial)
    return J.T @ (F + inertial) + s.bias + s.M @ qdd, s.p_WE


@numba.njit(cache=True)
def tick(chain, law, tau, memory, q, v, x_d, stiffness, damping, wrench):
    """One tick of the controller.

    Args: tau (n,) of the last tick; memory as memory_size says; the rest as in
        impedance_torque, measured or received: anything may be NaN.
    Returns: tau (n,) within all limits, status (bits), memory.
    """
    n = q.shape[0]
    memory = memory.copy()
    status = 0
    count = memory[2 * n + 7]
    has_pose, has_q = memory[2 * n + 8] > 0.0, memory[2 * n + 9] > 0.0
    sensed = np.all(np.isfinite(q)) and np.all(np.isfinite(v))
    if sensed:
        if not has_q:
            memory[:n] = q
        memory[n : 2 * n] = q
        memory[2 * n + 9] = 1.0
        q_now = q
    else:
        status |= SENSORS_HELD
        q_now = memory[n : 2 * n].copy() if has_q else law.q_nominal

    x_d, R_d, held = _reference(chain, memory, q_now, x_d, has_pose, n)
    if held:
        status |= REFERENCE_HELD
    if not (np.all(np.isfinite(stiffness)) and np.all(stiffness >= 0.0)):
        stiffness = law.stiffness
        status |= REFERENCE_HELD
    if not (np.all(np.isfinite(damping)) and np.all(damping >= 0.0)):
        damping = law.damping
        status |= REFERENCE_HELD
    if not np.all(np.isfinite(wrench)):
        wrench = np.zeros(6)
        status |= REFERENCE_HELD

    if sensed:
        asked, p_tip = impedance_torque(
            chain, law, q, v, memory[:n], x_d, R_d, stiffness, damping, wrench
        )
        if count % law.posture_every == 0:
            memory[:n] = posture_step(chain, law, memory[:n].copy(), p_tip)
    else:  # Carry the arm where it was last seen.
        asked = chain_state(chain, q_now, np.zeros(n)).bias
    if not np.all(np.isfinite(asked)):  # Numbers too large to calculate with.
        asked = chain_state(chain, q_now, np.zeros(n)).bias
        status |= REFERENCE_HELD
    memory[2 * n + 7] = (count + 1) % law.posture_every

    out = np.empty(n)
    for i in range(n):
        allowed = min(max(asked[i], -law.effort_max[i]), law.effort_max[i])
        if allowed != asked[i]:
            status |= EFFORT_LIMITED
        change = min(max(allowed - tau[i], -law.step_max[i]), law.step_max[i])
        out[i] = tau[i] + change
        if abs(allowed - tau[i]) > law.step_max[i]:
            status |= RATE_LIMITED
    return out, status, memory


@numba.njit(cache=True)
def _reference(chain, memory, q, x_d, has_pose, n):
    """x_d, its rotation, and whether it had to be replaced by the last good pose."""
    square = np.sum(x_d[3:7] ** 2)
    if np.all(np.isfinite(x_d)) and 0.25 < square < 4.0:
        memory[2 * n : 2 * n + 7] = x_d[:7]
        memory[2 * n + 8] = 1.0
        return x_d, rotation_of(x_d[3:7]), False
    if not has_pose:  # Stay where the arm is.
        p, R, _ = tip_kinematics(chain, q)
        memory[2 * n : 2 * n + 3] = p
        memory[2 * n + 3 : 2 * n + 7] = quaternion_of(R)
        memory[2 * n + 8] = 1.0
    held = np.zeros(19)
    held[:7] = memory[2 * n : 2 * n + 7]
    return held, rotation_of(held[3:7]), True


def warm_up(chain: SerialChain, law: Law) -> None:
    """Compiles the law, so that no tick has to wait for it.

    tau and memory are read-only, as a Context's state is: to the compiler those are
    arrays of another type.
    """
    n = len(law.effort_max)
    tau, memory = np.zeros(n), np.zeros(memory_size(n))
    for state in (tau, memory):
        state.setflags(write=False)
    args = (law.q_nominal, np.zeros(n), np.full(19, np.nan))
    tick(chain, law, tau, memory, *args, law.stiffness, law.damping, np.zeros(6))
