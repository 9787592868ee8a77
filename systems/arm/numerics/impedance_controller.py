"""Cartesian impedance control of a redundant arm: one tick of the controller.

    F = S (K (x_d - x) + D (v_d - v)) + f_fc + f_ff + Lambda (S a_d - Jdot qdot)
    tau = J' F + bias + N' M (k_q (q_n - q) + k_v (v_n - v))
    N' = I - J' Lambda J inv(M)
    S = I - sum n n',  f_fc = sum n (F_c + k_i integral (F_c - F) dt - D_n n' v)

with none, one or two directions n along which force instead of motion is controlled. M
is the mass matrix with the motors' rotors, so tau is the motors' torque; tau_joint is
against friction and other forces in the joints (joint_friction.py); Lambda is the
inverse of J inv(M) J'. Stiffness K [N/m] and damping D [N s/m] are not scaled by
Lambda, which multiplies only the reference's acceleration. The posture q_n follows the
tip with the tool upright, at the joint velocity v_n.

Source: Khatib, "A unified approach for motion and force control of robot manipulators:
the operational space formulation" (1987), sections III and V; CC eq. 1 and 4a.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics.cholesky import (
    cholesky,
    cholesky_solve,
    forward_solve,
)
from makebreak.systems.arm.numerics.energy_tank import N_TANK, fill, paid_stiffness
from makebreak.systems.arm.numerics.joint_friction import joint_torque
from makebreak.systems.arm.numerics.joint_limits import (
    braked,
    is_free,
    within_limits,
)
from makebreak.systems.arm.numerics.packed import part
from makebreak.systems.arm.numerics.serial_chain import (
    chain_of,
    chain_state,
    tip_kinematics,
)
from makebreak.systems.numerics.few_numbers import all_finite, dot
from makebreak.systems.numerics.joint_laws import N_NUMBERS, JointLaws

# Status bits.
REFERENCE_HELD = 1
SENSORS_HELD = 2
FORCE_SENSOR_HELD = 16

IK_DAMPING = 0.02  # Of the posture's damped inverse kinematics [m], [rad].
IK_STEP_MAX = 0.05  # Largest change of a joint of the posture in one step [rad].
# Distance of the posture from the joint limits [rad], [m]; at most LIMIT_PART of a
# joint's range.
LIMIT_MARGIN = 0.03
LIMIT_PART = 0.15

# While an encoder gives NaN (held_motion):
HOLD_DAMPING = 20.0  # Rate at which the arm is slowed down [1/s].
HOLD_SPEED_MAX = 10.0  # Bound of a joint's speed, against wrong readings [rad/s].
HOLD_GAIN = 0.1  # Gain from a measured position to the predicted speed.

# For an arm without a redundant joint: a pose is singular if the smallest independent
# part of a task direction is below this. The tip's inertia along that direction grows
# with the inverse of the part, and Lambda Jdot qdot would make a stretched arm
# unstable. The Lambda terms fade there; spring and damper, without Lambda, remain.
SINGULAR = 0.1

CONTACT_FORCE_MIN = 0.5  # Below this measured force the tip is in the air [N].
# In the air longer than a rebound takes, and than the force takes to rise, the integral
# brings the tip back: something unknown holds it up (force_control).
LOST_SEC = 0.2
LOST_GAIN = 2.0  # [1/s]
SAME_DIRECTION = 0.98  # Cosine above which a direction counts as the one before.
ENGAGE_SEC = 0.02  # Time in which the stiffness along a new direction fades out.
# A slot for each direction under force control, also while it is released: [n (3),
# present target, integral, weight 0 to 1, D_n, 1 while active, n'v filtered, time in
# the air].
N_SLOTS, SLOT = 4, 10
LEVEL, INTEGRAL, WEIGHT, DAMPING, ACTIVE, SPEED, IN_AIR = 3, 4, 5, 6, 7, 8, 9
# Filter of n'v [s]. D_n is large and the encoders' velocity is noisy: without it the
# noise alone would reach the torque's rate limit. The natural frequency of a contact is
# below 20 Hz.
SPEED_FILTER_SEC = 0.003


class ForceLaw(NamedTuple):
    """Constants of force control."""

    integral_gain: float  # k_i [1/s]
    integral_max: float  # Bound of the magnitude [N].
    normal_damping: float  # Lower bound of D_n [N s/m].
    closing_speed: float  # Largest speed at which F_c alone closes a gap [m/s].
    ramp_sec: float  # Time in which the force rises to its target.
    release_sec: float  # Time in which a dropped direction fades out.
    speed_keep: float  # Factor per tick of the filter of n'v.


class Law(NamedTuple):
    """Constants of the control law for n joints."""

    effort_max: np.ndarray  # (n,) [N m]
    step_max: np.ndarray  # (n,) change of torque in one tick [N m].
    q_lower: np.ndarray  # (n,) [rad]
    q_upper: np.ndarray  # (n,) [rad]
    speed_max: np.ndarray  # (n,) [rad/s], infinite for none.
    q_nominal: np.ndarray  # (n,) posture in the null space of the task [rad].
    R_upright: np.ndarray  # (3, 3) orientation of the tip frame in the posture.
    stiffness: np.ndarray  # (6,) [N/m] x 3, [N m/rad] x 3
    damping: np.ndarray  # (6,) [N s/m] x 3, [N m s/rad] x 3
    force_max: float  # Of spring and damper together [N].
    tank: float  # Energy that rises of the stiffness may take [J], infinite for any.
    posture_stiffness: float  # k_q [1/s2]
    posture_damping: float  # k_v [1/s]
    posture_every: int  # Ticks between two steps of the posture.
    control_orientation: bool  # The task is the full pose, not only the position.
    period: float  # Of a tick [s].
    force: ForceLaw
    laws: JointLaws  # Forces in the joints, as of joint_friction.to_compensate.


# A slice that is assigned takes three times as long to compile as a call.
@numba.njit(cache=True)
def _copy(out, values):
    for k in range(out.size):
        out[k] = values[k]


@numba.njit(cache=True)
def law_of(flat):
    """The Law of which `flat` is the packed array; arrays of floats are not copied."""
    effort_max, at = part(flat, 0)
    step_max, at = part(flat, at)
    q_lower, at = part(flat, at)
    q_upper, at = part(flat, at)
    speed_max, at = part(flat, at)
    q_nominal, at = part(flat, at)
    R_upright, at = part(flat, at)
    stiffness, at = part(flat, at)
    damping, at = part(flat, at)
    numbers = flat[at : at + 2 * 14].reshape((14, 2))[:, 1]  # Each follows its size, 1.
    joint, at = part(flat, at + 2 * 14)
    kind, at = part(flat, at)
    p, at = part(flat, at)
    return Law(
        effort_max,
        step_max,
        q_lower,
        q_upper,
        speed_max,
        q_nominal,
        R_upright.reshape((3, 3)),
        stiffness,
        damping,
        numbers[0],
        numbers[1],
        numbers[2],
        numbers[3],
        int(numbers[4]),
        numbers[5] != 0.0,
        numbers[6],
        ForceLaw(
            numbers[7],
            numbers[8],
            numbers[9],
            numbers[10],
            numbers[11],
            numbers[12],
            numbers[13],
        ),
        JointLaws(
            joint.astype(np.int64),
            kind.astype(np.int64),
            p.reshape((joint.size, N_NUMBERS)),
        ),
    )


def memory_size(n: int) -> int:
    """Size of the memory: [q_n, last good q, last good pose (7), ticks, has a good
    pose, has a good q, last good force directions (6) and targets (2), slots (N_SLOTS x
    SLOT), energy tank (N_TANK), last v].

    While a sensor is held, q and v are predictions (held_motion)."""
    return 3 * n + 18 + N_SLOTS * SLOT + N_TANK


@numba.njit(cache=True)
def rotation_of(quaternion):
    """Rotation (3, 3) of a quaternion wxyz of any length above 0."""
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
    """Quaternion wxyz, w >= 0, of a rotation (3, 3)."""
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
    """Rotation vector (3,) in world axes from R to R_d [rad]."""
    E = R_d @ R.T
    q = quaternion_of(E)
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    if sine < 1e-9:
        return 2.0 * q[1:]
    return (2.0 * np.arctan2(sine, q[0]) / sine) * q[1:]


@numba.njit(cache=True)
def posture_step(chain, law, q_n, p_tip):
    """q_n (n,) after one damped step towards the tip at p_tip (3,), upright; in the
    null space towards the nominal posture."""
    n = q_n.shape[0]
    p, R, J = tip_kinematics(chain, q_n)
    pull = 0.05 * (law.q_nominal - q_n)
    error = np.empty(6)
    _copy(error[:3], p_tip - p)
    _copy(error[3:], rotation_error(law.R_upright, R))
    step = pull + _damped_inverse(J, error - J @ pull)
    out = np.empty(n)
    for i in range(n):
        change = min(max(step[i], -IK_STEP_MAX), IK_STEP_MAX)
        margin = min(LIMIT_MARGIN, LIMIT_PART * (law.q_upper[i] - law.q_lower[i]))
        lower, upper = law.q_lower[i] + margin, law.q_upper[i] - margin
        out[i] = min(max(q_n[i] + change, lower), upper)
    return out


@numba.njit(cache=True)
def _damped_inverse(J, y):
    """Joint motion (n,) for a tip motion y (6,): J' inv(J J' + damping^2 I) y."""
    A = J @ J.T
    for i in range(6):
        A[i, i] += IK_DAMPING**2
    L = np.zeros((6, 6))
    cholesky(L, A)
    x = y.copy()
    cholesky_solve(L, x)
    return J.T @ x


@numba.njit(cache=True)
def _orthonormal(directions):
    """Two rows (6,) as orthonormal rows (2, 3). A zero row stays zero; a second row
    that is (nearly) parallel to the first becomes zero."""
    out = np.zeros((2, 3))
    for k in range(2):
        row = directions[3 * k : 3 * k + 3].copy()
        length = np.sqrt(np.sum(row**2))
        if length < 1e-6:
            continue
        row /= length
        if k == 1:
            row -= np.sum(row * out[0]) * out[0]
            length = np.sqrt(np.sum(row**2))
            if length < 0.1:
                continue
            row /= length
        out[k] = row
    return out


@numba.njit(cache=True)
def force_control(law, slots, directions, targets, measured):
    """One tick of force control: updates the slots (N_SLOTS, SLOT) in place.

    The force along a slot's n is weight (level + integral - D_n n'v), at least 0 at
    rest (impedance_torque). On a surface the integral's error is F_c - F. In the air it
    is F_c - D_n n'v, zero at the speed F_c / D_n at which a tip without disturbance
    closes a gap: the integral grows only while something holds the tip back, and the
    tip never comes faster than that for long.

    Args: directions (6,): two rows n, zero for none; targets (2,) [N]; measured (6,):
        wrench on the tool [N], [N m]; finite, or (0,) where there is none: then the
        integral waits.
    """
    sensed = measured.size > 0
    force = law.force
    rows = _orthonormal(directions)
    slots[:, ACTIVE] = 0.0
    for k in range(2):
        n = rows[k]
        if dot(n, n) == 0.0:
            continue
        best, best_cosine = -1, SAME_DIRECTION
        for j in range(N_SLOTS):
            cosine = dot(slots[j], n)
            free = slots[j, WEIGHT] > 0.0 and slots[j, ACTIVE] == 0.0
            if free and cosine > best_cosine:
                best, best_cosine = j, cosine
        if best < 0:  # A new direction takes the slot of the least weight.
            least = np.inf
            for j in range(N_SLOTS):
                if slots[j, ACTIVE] == 0.0 and slots[j, WEIGHT] < least:
                    best, least = j, slots[j, WEIGHT]
            slots[best] = 0.0
        slot = slots[best]
        _copy(slot[:3], n)
        slot[ACTIVE] = 1.0
        target = max(targets[k], 0.0)
        # Proportional to the force, so that every ramp takes the same time.
        step = max(target, slot[LEVEL]) * law.period / force.ramp_sec
        slot[LEVEL] += min(max(target - slot[LEVEL], -step), step)
        slot[DAMPING] = max(target / force.closing_speed, force.normal_damping)
        felt = -dot(n, measured) if sensed else 0.0
        gain, missing = 0.0, 0.0
        if felt >= CONTACT_FORCE_MIN:
            gain, missing = force.integral_gain, slot[LEVEL] - felt
            slot[IN_AIR] = 0.0
        elif sensed:
            slot[IN_AIR] += law.period
            if slot[IN_AIR] > LOST_SEC and force.integral_gain > 0.0:
                gain, missing = LOST_GAIN, slot[LEVEL] - slot[DAMPING] * slot[SPEED]
        if gain > 0.0:
            most = force.integral_max
            grown = slot[INTEGRAL] + gain * missing * law.period
            slot[INTEGRAL] = min(max(grown, -most), most)
    for j in range(N_SLOTS):
        slot = slots[j]
        if slot[ACTIVE] > 0.0:
            slot[WEIGHT] = min(slot[WEIGHT] + law.period / ENGAGE_SEC, 1.0)
        elif slot[WEIGHT] > 0.0:
            slot[WEIGHT] = max(slot[WEIGHT] - law.period / force.release_sec, 0.0)


@numba.njit(cache=True)
def _under_motion_control(slots, scale, motion):
    """The part of an error, or its rate, on which spring and damper act: (m,) whose
    square times K is that of S K.

    Args: slots (N_SLOTS, SLOT); scale: of the gains about the axes; motion (m,).
    """
    out = motion.copy()
    for k in range(3, out.size):
        out[k] *= np.sqrt(scale)
    for j in range(slots.shape[0]):
        if slots[j, WEIGHT] > 0.0:
            n_j = slots[j, :3]
            less = (1.0 - np.sqrt(1.0 - slots[j, WEIGHT])) * dot(n_j, out)
            for k in range(3):
                out[k] -= less * n_j[k]
    return out


@numba.njit(cache=True)
def impedance_torque(
    chain, law, q, v, q_n, x_d, R_d, stiffness, damping, ratio, wrench, slots, tank, lag
):
    """The control law, without limits.

    Args: chain, law: constants. q, v, q_n (n,) [rad], [rad/s]. x_d (19,) =
        [p, quaternion (unused), v, w, a, alpha] of the tip in the world; R_d (3, 3):
        its orientation. stiffness, damping (6,). ratio: 0, or a damping ratio; then
        `damping` is the stiffness from which D along each axis is computed,
        D = 2 ratio sqrt(damping lambda), lambda = 1/(J inv(M) J')_ii. wrench (6,): fed
        forward, force first [N], [N m]. slots (N_SLOTS, SLOT) of force_control; their
        filtered speeds are updated. tank (N_TANK,) of energy_tank, updated. lag: from a
        reading to the middle of the time for which its torque acts [s].
    Returns: tau (n,) [N m] and the tip's position p_WE (3,) [m].
    """
    n = q.shape[0]
    s = chain_state(chain, q, v)
    m = 6 if law.control_orientation else 3
    J = np.ascontiguousarray(s.J[:m])
    L = np.zeros((n, n))
    cholesky(L, s.M)  # Positive definite by construction.
    X = np.ascontiguousarray(J.T)
    for j in range(m):
        column = X[:, j].copy()
        forward_solve(L, column)
        for i in range(n):
            X[i, j] = column[i]
    mobility = X.T @ X  # J inv(M) J'
    largest = 1e-3  # A tip that no joint moves has one, too [1/kg].
    for i in range(m):
        largest = max(largest, mobility[i, i])
    for i in range(m):
        mobility[i, i] += 1e-9 * largest  # Keeps Lambda finite near a singular pose.
    L_task = np.zeros((m, m))
    cholesky(L_task, mobility)
    # A row's pivot over its diagonal: its part that is independent of earlier rows.
    part = 1.0
    for i in range(m):
        part = min(part, L_task[i, i] ** 2 / mobility[i, i])

    if ratio > 0.0:
        damping = damping.copy()
        for i in range(m):
            damping[i] = 2.0 * ratio * np.sqrt(damping[i] / mobility[i, i])
    twist = J @ v
    error, rate = np.empty(m), np.empty(m)
    a_ref, moves = np.empty(m), np.zeros(6)  # The reference across the forces.
    for k in range(m):
        rate[k] = x_d[7 + k] - twist[k]
        a_ref[k], moves[k] = x_d[13 + k], x_d[7 + k]
    for k in range(3):
        error[k] = x_d[k] - s.p_WE[k]
    scale = 1.0  # Of stiffness and damping about the axes.
    if m == 6:
        # Explicit damping d is stable while d period < inertia. The wrist's inertia may
        # be small: then stiffness and damping are reduced together.
        turning = mobility[3, 3] + mobility[4, 4] + mobility[5, 5]
        most = max(damping[3], damping[4], damping[5]) * turning * law.period
        scale = 1.0 if most < 0.5 else 0.5 / most
        _copy(error[3:], rotation_error(R_d, s.R_WE))
    stored = _under_motion_control(slots, scale, error)
    stiffness = paid_stiffness(tank, stiffness, stored, law.tank)
    lost = _under_motion_control(slots, scale, rate)
    F = stiffness[:m] * error + damping[:m] * rate
    pushing = np.sqrt(dot(F, F))
    if pushing > law.force_max:
        for k in range(3):
            F[k] *= law.force_max / pushing
            lost[k] *= np.sqrt(law.force_max / pushing)
    fill(tank, damping, lost, lag, law.period, law.tank)
    for k in range(3, m):
        F[k] *= scale
    for j in range(slots.shape[0]):
        weight = slots[j, WEIGHT]
        if weight > 0.0:  # Motion control only across n; along n the push.
            n_j = slots[j, :3]
            v_n = dot(n_j, twist)
            slots[j, SPEED] = v_n + law.force.speed_keep * (slots[j, SPEED] - v_n)
            push = max(slots[j, LEVEL] + slots[j, INTEGRAL], 0.0)
            push -= slots[j, DAMPING] * slots[j, SPEED]
            more = weight * (push - dot(n_j, F))
            a_along = weight * dot(n_j, a_ref)
            v_along = weight * dot(n_j, moves)
            for k in range(3):
                F[k] += more * n_j[k]
                a_ref[k] -= a_along * n_j[k]
                moves[k] -= v_along * n_j[k]
    F += wrench[:m]

    # Posture: its acceleration, minus the part that would move the tip.
    follow = np.zeros(6)
    _copy(follow[:m], twist)
    v_n = _damped_inverse(s.J, follow)
    qdd = law.posture_stiffness * (q_n - q) + law.posture_damping * (v_n - v)
    if n <= m:  # No null space: the posture would only act through errors of Lambda.
        qdd[:] = 0.0
    inertial = a_ref - s.bias_a[:m] - J @ qdd
    cholesky_solve(L_task, inertial)
    if n <= m and part < SINGULAR:
        inertial *= (part / SINGULAR) ** 2
    tau = J.T @ (F + inertial) + s.bias + s.M @ qdd
    if np.any(law.laws.p[:, :2] != 0.0) or np.any(chain.damping != 0.0):
        tau -= chain.damping * v  # Of the bias: not fed back.
        tau += joint_torque(law.laws, chain.damping, q, _damped_inverse(s.J, moves))
    return tau, s.p_WE


@numba.njit(cache=True)
def held_motion(q, v, q_last, v_last, period):
    """Joint positions and velocities while some encoders give NaN: predicted with
    HOLD_DAMPING, which acts on the arm, and corrected by the measured entries.

    Args: q, v (n,): measured, NaN where an encoder fails; q_last, v_last (n,): of the
        last tick [rad], [rad/s]; period [s].
    Returns: q (n,), v (n,), finite.
    """
    n = q.shape[0]
    q_now, v_now = np.empty(n), np.empty(n)
    for i in range(n):
        speed = v_last[i] * np.exp(-HOLD_DAMPING * period)
        if np.isfinite(v[i]):
            speed = v[i]
        speed = min(max(speed, -HOLD_SPEED_MAX), HOLD_SPEED_MAX)
        q_now[i] = q_last[i] + period * speed
        if np.isfinite(q[i]):
            if not np.isfinite(v[i]):
                speed += HOLD_GAIN * (q[i] - q_now[i]) / period
                speed = min(max(speed, -HOLD_SPEED_MAX), HOLD_SPEED_MAX)
            q_now[i] = q[i]
        v_now[i] = speed
    return q_now, v_now


@numba.njit(cache=True)
def tick(
    packed_chain,
    packed_law,
    tau,
    memory,
    q,
    v,
    x_d,
    stiffness,
    damping,
    ratio,
    wrench,
    directions,
    targets,
    measured,
    delay,
):
    """One tick of the controller, which changes tau and memory in place.

    Args: packed_chain, packed_law: SerialChain and Law (packed.py); tau (n,): of the
        last tick; memory: of memory_size; others as in impedance_torque and
        force_control; any of them may contain NaN. delay: from a reading to the time
        when its torque acts [s]; no time (NaN, negative, infinite) counts as 0.
    Returns: status (bits). tau is within all limits.
    """
    chain, law = chain_of(packed_chain), law_of(packed_law)
    n = q.shape[0]
    status = 0
    count = memory[2 * n + 7]
    has_pose, has_q = memory[2 * n + 8] > 0.0, memory[2 * n + 9] > 0.0
    sensed = all_finite(q) and all_finite(v)
    if sensed:
        if not has_q:
            _copy(memory[:n], q)
        _copy(memory[n : 2 * n], q)
        _copy(memory[-n:], v)
        memory[2 * n + 9] = 1.0
        q_now, v_now = q, v
    else:
        status |= SENSORS_HELD
        if has_q:
            q_now, v_now = held_motion(q, v, memory[n : 2 * n], memory[-n:], law.period)
            _copy(memory[n : 2 * n], q_now)
            _copy(memory[-n:], v_now)
        else:
            q_now, v_now = law.q_nominal.copy(), np.zeros(n)

    x_d, R_d, held = _reference(chain, memory, q_now, x_d, has_pose, n)
    if held:
        status |= REFERENCE_HELD
    if not (all_finite(stiffness) and np.all(stiffness >= 0.0)):
        stiffness = law.stiffness.copy()
        status |= REFERENCE_HELD
    if not (all_finite(damping) and np.all(damping >= 0.0)):
        damping = law.stiffness.copy() if ratio > 0.0 else law.damping.copy()
        status |= REFERENCE_HELD
    if not all_finite(wrench):
        wrench = np.zeros(6)
        status |= REFERENCE_HELD
    if not 0.0 <= delay < np.inf:  # With NaN the brakes would do nothing.
        delay = 0.0
        status |= REFERENCE_HELD

    kept = memory[2 * n + 10 : 2 * n + 18]
    if all_finite(directions) and all_finite(targets):
        _copy(kept[:6], directions)
        _copy(kept[6:], targets)
    else:
        status |= REFERENCE_HELD
    if not all_finite(measured):
        measured = np.zeros(0)
        status |= FORCE_SENSOR_HELD
    slots = memory[2 * n + 18 : -n - N_TANK].reshape(N_SLOTS, SLOT)

    if sensed:
        force_control(law, slots, kept[:6], kept[6:], measured)
        asked, p_tip = impedance_torque(
            chain,
            law,
            q,
            v,
            memory[:n],
            x_d,
            R_d,
            stiffness,
            damping,
            ratio,
            wrench,
            slots,
            memory[-n - N_TANK : -n],
            delay + 0.5 * law.period,
        )
        if count % law.posture_every == 0:
            _copy(memory[:n], posture_step(chain, law, memory[:n].copy(), p_tip))
    else:  # Carry the arm and slow it down: qdd = -HOLD_DAMPING v.
        now = chain_state(chain, q_now, v_now)
        asked = now.bias - chain.damping * v_now - HOLD_DAMPING * (now.M @ v_now)
    if not all_finite(asked):  # Overflow.
        asked = chain_state(chain, q_now, np.zeros(n)).bias
        status |= REFERENCE_HELD
    memory[2 * n + 7] = (count + 1) % law.posture_every

    out, limited = within_limits(law, tau, asked)
    if not is_free(law, q_now, v_now):
        now = chain_state(chain, q_now, v_now)
        kept, by = braked(law, tau, out, q_now, v_now, now.M, now.bias, delay)
        if all_finite(kept):  # Else an overflow.
            out, limited = kept, limited | by
    _copy(tau, out)
    return status | limited


@numba.njit(cache=True)
def _reference(chain, memory, q, x_d, has_pose, n):
    """x_d, its rotation, and whether it was replaced by the last good pose."""
    square = np.sum(x_d[3:7] ** 2)
    if all_finite(x_d) and 0.25 < square < 4.0:
        _copy(memory[2 * n : 2 * n + 7], x_d[:7])
        memory[2 * n + 8] = 1.0
        return x_d, rotation_of(x_d[3:7]), False
    if not has_pose:  # Stay where the arm is.
        p, R, _ = tip_kinematics(chain, q)
        _copy(memory[2 * n : 2 * n + 3], p)
        _copy(memory[2 * n + 3 : 2 * n + 7], quaternion_of(R))
        memory[2 * n + 8] = 1.0
    held = np.zeros(19)
    _copy(held[:7], memory[2 * n : 2 * n + 7])
    return held, rotation_of(held[3:7]), True


def warm_up(chain: np.ndarray, law: np.ndarray, n: int) -> None:
    """Compiles the tick of n joints. Args: chain, law: packed."""
    args = (np.zeros(n), np.zeros(memory_size(n)), np.zeros(n), np.zeros(n))
    none = np.zeros(6)
    gains, forces = (none, none, 0.0), (none, none, np.zeros(2), none)
    tick(chain, law, *args, np.full(19, np.nan), *gains, *forces, 0.0)
