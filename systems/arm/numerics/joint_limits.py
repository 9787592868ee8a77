"""Keeps an arm's joints within their torques, speeds and ranges, whatever is asked.

Each joint i has bounds of its speed that shrink towards the ends of its range,

    v_hi = min(V, c (q_upper - margin - q)),   v_lo = max(-V, c (q_lower + margin - q))

with V below the limit. Its acceleration in the next tick, qdd = inv(M) (tau - bias),
has to stay below

    k (v_hi - v) for v > v_hi,   else min(k (v_hi - v), sqrt(r_i (v_hi - v)))

and likewise above the lower bound. r_i = rate inv(M)_ii is the jerk of the joint under
its own motor at the torque's rate limit: the root lets the motor reach zero
acceleration before v_hi, at half that rate. Where a torque breaks a bound, the joint's
own motor brakes with the least torque that keeps it, like a mechanical stop,

    0 <= brake_i  perp  hi_i - qdd_i >= 0.

This may not be enough: the torque tau_stop that stops all joints is
T = max |tau - tau_stop| / rate away. Where an acceleration is above (v_hi - v) / T, all
motors turn to tau_stop together; so they do by degrees where a speed is above V after
all, because something unknown pushes, such as a contact.

Source: Faverjon and Tournassoud, "A local based approach for path planning of
manipulators with a high number of degrees of freedom" (1987), eq. 3:
v <= c (distance - margin); Del Prete, "Joint position and velocity bounds in
discrete-time acceleration/torque control of robot manipulators" (2018), on why the
bounds of speed and position have to be one bound of the acceleration.
"""

import numba
import numpy as np

from makebreak.systems.arm.numerics.cholesky import cholesky, cholesky_solve

EFFORT_LIMITED, RATE_LIMITED, JOINT_BRAKED = 4, 8, 32  # Bits of the status.

SPEED_SHARE = 0.8  # V over the speed limit.
# Of the position limits [rad], [m]; errors of encoders are smaller. At most RANGE_PART
# of a joint's range.
RANGE_MARGIN = 0.02
RANGE_PART = 0.1
RANGE_RATE = 10.0  # c [1/s]
GAIN = 100.0  # k [1/s]; with a delay at most DELAY_GAIN over it.
DELAY_GAIN = 0.5  # k delay; above pi/2 the brake would swing by itself.
OVERSPEED = 0.1  # Of V; so far above V all motors turn to a stop, whatever is asked.
STOP_RATE = 20.0  # tau_stop gives qdd = -STOP_RATE v [1/s].
# As long as all speeds are below this fraction of their bounds the torque is not looked
# at: half of the way is enough to stop what the other half has brought about.
FREE_SHARE = 0.5
# A joint that accelerates beyond its bound by less than this does not stop the others:
# noise of the encoders [rad/s2].
SLACK = 0.5
SWEEPS = 20  # Of the joints, where several brake at once.


@numba.njit(cache=True)
def within_limits(law, tau, asked):
    """asked (n,) within the effort limits, and from tau (n,), that of the last tick,
    within the rate limit [N m]; and the status bits of these limits."""
    n = tau.shape[0]
    out = np.empty(n)
    status = 0
    for i in range(n):
        allowed = min(max(asked[i], -law.effort_max[i]), law.effort_max[i])
        if allowed != asked[i]:
            status |= EFFORT_LIMITED
        change = min(max(allowed - tau[i], -law.step_max[i]), law.step_max[i])
        out[i] = tau[i] + change
        if abs(allowed - tau[i]) > law.step_max[i]:
            status |= RATE_LIMITED
    return out, status


@numba.njit(cache=True)
def speed_bounds(law, q, i):
    """(v_lo, v_hi) of joint i at q (n,) [rad/s]."""
    most = SPEED_SHARE * law.speed_max[i]
    margin = min(RANGE_MARGIN, RANGE_PART * (law.q_upper[i] - law.q_lower[i]))
    up = RANGE_RATE * (law.q_upper[i] - margin - q[i])
    down = RANGE_RATE * (law.q_lower[i] + margin - q[i])
    return max(min(down, most), -most), min(max(up, -most), most)


@numba.njit(cache=True)
def is_free(law, q, v):
    """Whether no joint is near any of its bounds."""
    for i in range(q.shape[0]):
        low, high = speed_bounds(law, q, i)
        if v[i] > FREE_SHARE * high or v[i] < FREE_SHARE * low:
            return False
    return True


@numba.njit(cache=True)
def _acceleration_bound(room, gain, jerk):
    """Largest acceleration towards a bound of the speed that is `room` away [rad/s]."""
    if room <= 0.0:
        return gain * room
    return min(gain * room, np.sqrt(jerk * room))


@numba.njit(cache=True)
def own_brakes(law, qdd, q, v, mobility, gain):
    """Torque (n,) of each joint's own motor that keeps qdd (n,) [rad/s2] within the
    bounds, by projected Gauss-Seidel; zero where qdd keeps them.

    Args: q, v (n,) [rad], [rad/s]; mobility (n, n): inv(M) [1/(kg m2)]; gain: k [1/s].
    """
    n = q.shape[0]
    least, most = np.full(n, -np.inf), np.full(n, np.inf)
    for i in range(n):
        low, high = speed_bounds(law, q, i)
        jerk = mobility[i, i] * law.step_max[i] / law.period
        if v[i] > FREE_SHARE * high:
            most[i] = _acceleration_bound(high - v[i], gain, jerk)
        if v[i] < FREE_SHARE * low:
            least[i] = -_acceleration_bound(v[i] - low, gain, jerk)
    qdd = qdd.copy()
    brake = np.zeros(n)
    for _ in range(SWEEPS):
        largest = 0.0
        for i in range(n):
            before, by = brake[i], mobility[i, i]
            still = before - qdd[i] / by  # The brake without acceleration.
            low, high = still + least[i] / by, still + most[i] / by
            brake[i] = min(max(0.0, low), high)
            change = brake[i] - before
            for j in range(n):
                qdd[j] += mobility[j, i] * change
            largest = max(largest, abs(change))
        if largest < 1e-6:
            break
    return brake


@numba.njit(cache=True)
def braked(law, tau, asked, q, v, M, bias, delay):
    """The torque of the next tick, near `asked`, that keeps the joints' bounds.

    Args: tau (n,): of the last tick, asked (n,): within the limits of effort and rate
        [N m]; q, v (n,) [rad], [rad/s]; M (n, n) mass matrix [kg m2], bias (n,): torque
        without acceleration [N m]; delay: until a torque acts [s].
    Returns: tau (n,) within the limits of effort and rate; status bits.
    """
    n = q.shape[0]
    L = np.zeros((n, n))
    cholesky(L, M)
    mobility = np.eye(n)
    for i in range(n):
        cholesky_solve(L, mobility[i])
    gain = min(GAIN, DELAY_GAIN / max(delay, law.period))
    out, status = asked, 0
    brake = own_brakes(law, mobility @ (asked - bias), q, v, mobility, gain)
    if np.any(brake != 0.0):
        out, status = within_limits(law, tau, asked + brake)
        status |= JOINT_BRAKED

    # The way to a stop, with all torques together.
    surplus = np.empty(n)  # Of the speed over one within the bounds, nearest to rest.
    room_up, room_down = np.empty(n), np.empty(n)
    for i in range(n):
        low, high = speed_bounds(law, q, i)
        surplus[i] = v[i] - min(max(0.0, low), high)
        room_up[i], room_down[i] = high - v[i], v[i] - low
    stop = bias - STOP_RATE * (M @ surplus)
    ticks = 1.0
    for i in range(n):
        stop[i] = min(max(stop[i], -law.effort_max[i]), law.effort_max[i])
        ticks = max(ticks, abs(stop[i] - tau[i]) / law.step_max[i])
    stopping = tau + (stop - tau) / ticks
    qdd, qdd_stop = mobility @ (out - bias), mobility @ (stopping - bias)
    time = max(ticks * law.period + delay, 1.0 / gain)
    share = 0.0  # Of the step to the stop.
    for i in range(n):
        most = room_up[i] / time if room_up[i] > 0.0 else gain * room_up[i]
        least = -room_down[i] / time if room_down[i] > 0.0 else -gain * room_down[i]
        over, gained = qdd[i] - most, qdd[i] - qdd_stop[i]
        if least - qdd[i] > over:
            over, gained = least - qdd[i], -gained
        if over > SLACK and gained > 0.0:
            share = max(share, min(over / gained, 1.0))
        fastest = SPEED_SHARE * law.speed_max[i]
        share = max(share, min((abs(v[i]) - fastest) / (OVERSPEED * fastest), 1.0))
    if share > 0.0:
        out = out + share * (stopping - out)
        status |= JOINT_BRAKED
    return out, status
