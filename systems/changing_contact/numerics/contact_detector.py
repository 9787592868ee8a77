"""Contacts made and broken, from the wrench on the tool and the tip's motion.

Along the motion d the tool feels f = -F.d = friction + its own inertia + contact. What
is left of f when mu (sum of normal forces) and m a.d are taken off is the innovation.
mu, of the mode that the tool is in, is learned as it slides; without normal forces the
innovation's slow mean is taken off instead. A contact is *made* when

  1. the innovation exceeds a threshold for three samples, and then
  2. friction cannot be the cause (f > mu_max sum of normal forces + threshold) and the
     tip is losing speed; or the tip has lost half of its speed along d, under a force
     that F = k x fits better over the way x than a constant does, with a k that is a
     contact's. An impact removes a degree of freedom. A friction step has all its force
     at once, a friction ramp grows over too long a way.

A tip that was not moving has no speed to lose: there only a force that no friction can
make, by twice the threshold, is a contact. An innovation that ends otherwise is a
change of friction, which is learned anew. Time, position and speed are those of the
first sample that departs. The peak force is the largest f until the tip stands, at most
80 ms after that, less its mean over 50 ms, up to 20 ms before: of the impact, without
the push that follows.

A contact is *broken* when a normal force that was there falls below a threshold for
8 ms.

Source: CC section 3.3. Telling an impact from a change of friction as above is ours.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    BROKEN,
    BROKEN_ROW,
    DIRECTION,
    DONE,
    HOLD,
    MADE,
    MEASURED,
    N_CONTACT,
    PEAK_FORCE,
    PHASE_SEGMENT,
    PHASE_STAGE,
    POSITION,
    SPEED,
    STATUS,
    TIME,
)

CUTOFF_HZ = 100.0  # Of the first-order filters of force and velocity.
CUTOFF_ACCELERATION_HZ = 30.0
LEARN_SEC, FAST_SEC, SLOW_SEC = 0.25, 0.03, 0.15  # Learning of friction.
SAMPLES = 3  # In a row above the threshold.
DECIDE_SEC, DECIDE_MOST_SEC = 0.08, 0.2  # The longer, while the force still grows.
PEAK_SEC = 0.08
REST_TICKS = 3.0  # For the lag of the filters.
# After a contact, in the same direction: so long, and so far, it is the same one. The
# longer way while its force is still there.
SAME_SEC, SAME_WAY, SAME_WAY_PRESSED = 0.3, 0.003, 0.02
LOST_SEC, HELD_SEC = 0.008, 0.05
ZERO_SKIP_SEC, ZERO_SEC = 0.01, 0.1  # Bias of the wrench, at rest.
STUCK_SEC = 0.05
STUCK_SPEED = 0.005  # [m/s]
SPEED_LOST, SPEED_LOST_FREE = 0.5, 0.1  # Shares of the speed before.
SPRING_OVER_STEP = 0.3  # Squared misfit of F = k x to that of F = constant.

BEFORE_SEC, GAP_SEC = 0.05, 0.02  # The force before: this long, up to so long before.
BACK = 28  # Samples at most from the decision that something is pending to its first.
# Samples kept; [time, p_WE 3, innovation, speed along d, force against the motion].
RING, ROW = 120, 7

# The memory, one flat array: slots by name.
_SLOTS = (
    ("ticks", 1),
    ("wrench", 6),  # The raw one before.
    ("same", 1),  # Ticks for which it has not changed.
    ("bias_sum", 3),
    ("bias_n", 1),
    ("zeroed", 1),  # 1: the bias is complete.
    ("force", 3),  # Filtered.
    ("velocity", 3),
    ("velocity_raw", 3),
    ("acceleration", 3),
    ("filled", 1),  # Samples since the filters were (re)started.
    ("d", 3),
    ("n", 6),
    ("segment", 1),
    ("mu", 1),
    ("offset", 1),  # What is learned instead of mu without normal forces [N].
    ("learned", 1),  # Ticks of sliding since learning began.
    ("over", 1),  # Ticks in a row above the threshold,
    ("under", 1),  # and below its negative.
    ("pending", 1),  # Ticks since the first sample; 0: nothing is pending.
    ("before", 1),  # The force against the motion before the contact [N],
    ("before_speed", 1),  # and the speed [m/s].
    ("way", 1),  # the way since then [m],
    ("sums", 4),  # sums over the samples of x^2, F x, F and F^2,
    ("earlier", 1),  # the innovation 20 ms ago or less [N],
    ("highest", 1),  # and the largest force against the motion [N].
    ("first", 4),  # Time and position of the first sample.
    ("quiet", 1),  # Ticks until the next contact is believed,
    ("touched", 1),  # and where the last one was, along d [m].
    ("peak_left", 1),  # Ticks until the peak counts as measured.
    ("peak", 1),
    ("peak_before", 1),
    ("peak_d", 3),
    ("held", 2),  # Ticks that each normal force was there,
    ("lost", 2),  # and ticks that it was not.
    ("armed", 2),
    ("along", 2),  # f and its prediction, for the eye [N].
    ("ring", RING * ROW),
)
_START = dict(
    zip(
        [name for name, _ in _SLOTS],
        np.cumsum([0] + [size for _, size in _SLOTS[:-1]]).tolist(),
        strict=True,
    )
)
MEMORY_SIZE = sum(size for _, size in _SLOTS)
ALONG = slice(_START["along"], _START["along"] + 2)

_TICKS, _WRENCH, _SAME = _START["ticks"], _START["wrench"], _START["same"]
_BIAS, _BIAS_N, _ZEROED = _START["bias_sum"], _START["bias_n"], _START["zeroed"]
_F, _V, _V_RAW = _START["force"], _START["velocity"], _START["velocity_raw"]
_A, _FILLED = _START["acceleration"], _START["filled"]
_D, _N, _SEGMENT = _START["d"], _START["n"], _START["segment"]
_MU, _OFFSET, _LEARNED = _START["mu"], _START["offset"], _START["learned"]
_OVER, _UNDER, _PENDING = _START["over"], _START["under"], _START["pending"]
_BEFORE, _BEFORE_SPEED = _START["before"], _START["before_speed"]
_SUMS, _WAY, _EARLIER = _START["sums"], _START["way"], _START["earlier"]
_HIGHEST, _FIRST, _QUIET = _START["highest"], _START["first"], _START["quiet"]
_TOUCHED = _START["touched"]
_PEAK_LEFT, _PEAK = _START["peak_left"], _START["peak"]
_PEAK_BEFORE, _PEAK_D = _START["peak_before"], _START["peak_d"]
_HELD, _LOST, _ARMED = _START["held"], _START["lost"], _START["armed"]
_ALONG, _RING = _START["along"], _START["ring"]
_POSITION, _DIRECTION = POSITION.start, DIRECTION.start


class Thresholds(NamedTuple):
    """Constants of the detection."""

    impact_force: float = 2.0  # Innovation that may be an impact [N].
    loss_force: float = 1.0  # A normal force below it is no contact [N].
    friction_max: float = 1.0  # No surface has more.
    stiffness_min: float = 1000.0  # Of a contact made while sliding [N/m].
    tool_mass: float = 0.3  # Between sensor and tip [kg].
    wrench_limit: float = 200.0  # At which the sensor saturates [N], [N m].
    speed_min: float = 0.001  # Slower than this nothing is an impact [m/s].
    period: float = 0.001  # [s]


def new_memory() -> np.ndarray:
    """(MEMORY_SIZE,) before the first tick."""
    memory = np.zeros(MEMORY_SIZE)
    memory[_SEGMENT] = -1.0
    return memory


@numba.njit(cache=True)
def _dot(m, i, x):
    return m[i] * x[0] + m[i + 1] * x[1] + m[i + 2] * x[2]


@numba.njit(cache=True)
def _ticks_of(seconds, period):
    return max(1.0, np.floor(seconds / period + 0.5))


@numba.njit(cache=True)
def _restart(m):
    """After a gap in the data: filters and what is pending begin anew."""
    m[_FILLED] = 0.0
    m[_OVER] = m[_UNDER] = m[_PENDING] = m[_LEARNED] = 0.0
    m[_PEAK_LEFT] = 0.0
    for i in range(2):
        m[_HELD + i] = m[_LOST + i] = m[_ARMED + i] = 0.0


@numba.njit(cache=True)
def _is_usable(limits, m, wrench, velocity):
    """Whether the wrench can be believed; counts for how long it has not changed."""
    same, finite, at_limit = True, True, False
    for i in range(6):
        same = same and wrench[i] == m[_WRENCH + i]
        finite = finite and np.isfinite(wrench[i])
        at_limit = at_limit or abs(wrench[i]) >= limits.wrench_limit
        m[_WRENCH + i] = wrench[i]
    stuck = _ticks_of(STUCK_SEC, limits.period)
    if not same:
        m[_SAME] = 0.0
    elif m[_SAME] >= stuck or np.sum(velocity[:3] ** 2) > STUCK_SPEED**2:
        m[_SAME] += 1.0  # A tip at rest in a world without noise may feel no change.
    return finite and not at_limit and m[_SAME] < stuck


@numba.njit(cache=True)
def _filter(limits, m, wrench, velocity):
    """Force without bias, velocity and acceleration, filtered, into the memory."""
    alpha = 1.0 - np.exp(-2.0 * np.pi * CUTOFF_HZ * limits.period)
    slow = 1.0 - np.exp(-2.0 * np.pi * CUTOFF_ACCELERATION_HZ * limits.period)
    n = max(m[_BIAS_N], 1.0)
    for i in range(3):
        force = wrench[i] - m[_BIAS + i] / n
        if m[_FILLED] == 0.0:
            m[_F + i], m[_V + i], m[_A + i] = force, velocity[i], 0.0
        else:
            m[_F + i] += alpha * (force - m[_F + i])
            m[_V + i] += alpha * (velocity[i] - m[_V + i])
            rate = (velocity[i] - m[_V_RAW + i]) / limits.period
            m[_A + i] += slow * (rate - m[_A + i])
        m[_V_RAW + i] = velocity[i]
    m[_FILLED] += 1.0


@numba.njit(cache=True)
def _zero(limits, m, wrench, velocity, in_contact, at_rest):
    """Averages the wrench at rest in free space, at the beginning."""
    if m[_ZEROED] > 0.0 or m[_TICKS] < ZERO_SKIP_SEC / limits.period:
        return
    if in_contact or not at_rest or np.sum(velocity[:3] ** 2) > STUCK_SPEED**2:
        m[_ZEROED] = 1.0
    else:
        for i in range(3):
            m[_BIAS + i] += wrench[i]
        m[_BIAS_N] += 1.0
        if m[_BIAS_N] >= ZERO_SEC / limits.period:
            m[_ZEROED] = 1.0
    if m[_ZEROED] > 0.0:
        if m[_BIAS_N] < 0.2 * ZERO_SEC / limits.period:  # Too few: no bias is better.
            m[_BIAS : _BIAS + 3] = 0.0
        m[_FILLED] = 0.0


@numba.njit(cache=True)
def _losses(limits, m, contact, n):
    """Contacts broken. Returns the sum of the normal forces [N]."""
    total = 0.0
    held_ticks = _ticks_of(HELD_SEC, limits.period)
    lost_ticks = _ticks_of(LOST_SEC, limits.period)
    for i in range(2):
        row = n[3 * i : 3 * i + 3]
        if np.sum(row**2) < 0.25:
            m[_HELD + i] = m[_LOST + i] = m[_ARMED + i] = 0.0
            continue
        normal = -_dot(m, _F, row)
        total += max(normal, 0.0)
        m[_HELD + i] = m[_HELD + i] + 1.0 if normal > 1.5 * limits.loss_force else 0.0
        if m[_HELD + i] >= held_ticks:
            m[_ARMED + i] = 1.0
        m[_LOST + i] = m[_LOST + i] + 1.0 if normal < limits.loss_force else 0.0
        if m[_ARMED + i] > 0.0 and m[_LOST + i] >= lost_ticks:
            m[_ARMED + i] = 0.0
            contact[BROKEN] += 1.0
            contact[BROKEN_ROW] = i
    return total


@numba.njit(cache=True)
def _learn(limits, m, f, total, cosine, innovation):
    """mu, or without normal forces the offset, from f at this sample."""
    begun = m[_LEARNED] * limits.period < LEARN_SEC
    if not begun and abs(innovation) > 0.5 * limits.impact_force:
        return
    gain = limits.period / (FAST_SEC if begun else SLOW_SEC)
    gain = max(gain, 1.0 / (m[_LEARNED] + 1.0)) if begun else gain
    m[_LEARNED] += 1.0
    if total <= 0.0:
        # Bounded: what is left of a bias, or drag. More would hide a contact.
        most = 0.5 * limits.impact_force
        m[_OFFSET] += gain * (f - m[_OFFSET])
        m[_OFFSET] = min(max(m[_OFFSET], -most), most)
    elif total > 0.5:
        mu = min(max(f / (total * cosine), 0.0), limits.friction_max)
        m[_MU] += gain * (mu - m[_MU])


@numba.njit(cache=True)
def _begin(limits, m):
    """Something is pending: finds its first sample in the ring."""
    k = int(m[_TICKS])
    first = k
    # The first of those that depart, two samples earlier for the lag of the filter.
    for back in range(1, BACK):
        row = _RING + ROW * ((k - back) % RING)
        if k - back < 0 or m[row + 4] < 0.25 * limits.impact_force:
            break
        first = k - back
    first = max(first - 2, 0)
    speed, n = 0.0, 0
    for back in range(1, 13):
        if first - back >= 0:
            speed += m[_RING + ROW * ((first - back) % RING) + 5]
            n += 1
    m[_BEFORE_SPEED] = speed / n if n > 0 else 0.0
    force, n = 0.0, 0
    gap, last = (
        int(GAP_SEC / limits.period),
        int((GAP_SEC + BEFORE_SEC) / limits.period),
    )
    for back in range(gap, min(last, RING - BACK - 4)):
        if first - back >= 0 and back < m[_FILLED] - BACK:
            force += m[_RING + ROW * ((first - back) % RING) + 6]
            n += 1
    if n > 0:
        m[_BEFORE] = force / n
    row = _RING + ROW * (first % RING)
    m[_FIRST : _FIRST + 4] = m[row : row + 4]
    m[_PENDING] = k - first + 1.0
    m[_WAY] = m[_EARLIER] = m[_HIGHEST] = 0.0
    m[_SUMS : _SUMS + 4] = 0.0
    for i in range(first, k + 1):
        row = _RING + ROW * (i % RING)
        _add(limits, m, m[row + 4], m[row + 5])


@numba.njit(cache=True)
def _add(limits, m, F, speed):
    """A sample of what is pending: its innovation F and its speed."""
    m[_WAY] += max(speed, 0.0) * limits.period
    x = m[_WAY]
    m[_SUMS] += x * x
    m[_SUMS + 1] += F * x
    m[_SUMS + 2] += F
    m[_SUMS + 3] += F * F


@numba.njit(cache=True)
def _is_impact(limits, m, f, total, innovation, speed, learning):
    """1: an impact, 0: not yet decided, -1: a change of friction, or nothing."""
    if innovation < 0.5 * limits.impact_force:
        return -1
    before = m[_BEFORE_SPEED]
    lost = 1.0 - speed / before
    beyond = f - limits.friction_max * total - limits.impact_force
    if beyond > 0.0 and (lost > SPEED_LOST_FREE or beyond > limits.impact_force):
        return 1
    if lost > SPEED_LOST and not learning:
        xx, Fx, F, FF = m[_SUMS], m[_SUMS + 1], m[_SUMS + 2], m[_SUMS + 3]
        as_spring = FF - Fx * Fx / max(xx, 1e-18)
        as_step = FF - F * F / m[_PENDING]
        stiff = Fx > limits.stiffness_min * xx
        if stiff and as_spring < SPRING_OVER_STEP * as_step:
            return 1
    elapsed = m[_PENDING] * limits.period
    grows = innovation > 1.15 * m[_EARLIER]
    if elapsed > DECIDE_MOST_SEC or (elapsed > DECIDE_SEC and not grows):
        return -1
    return 0


@numba.njit(cache=True)
def detect(limits, memory, contact, time, wrench, pose, velocity, d, n, phase):
    """One tick.

    Args: limits: Thresholds. memory (MEMORY_SIZE,), contact (14,): of the last tick.
        time [s]. wrench (6,) on the tool, world axes [N], [N m]. pose (7,) and velocity
        (6,) of the tip. d (3,) unit vector of the motion, zero at rest. n (6,) two rows
        of force directions. phase (6,). Any of them may be NaN.
    Returns: memory, contact.
    """
    m, contact = memory.copy(), contact.copy()
    usable = _is_usable(limits, m, wrench, velocity)
    usable = usable and np.all(np.isfinite(velocity)) and np.all(np.isfinite(pose[:3]))
    usable = usable and np.all(np.isfinite(d)) and np.all(np.isfinite(n))
    usable = usable and np.all(np.isfinite(phase))
    contact[STATUS] = 0.0 if usable else 1.0
    if not usable:
        _restart(m)
        m[_TICKS] += 1.0
        return m, contact

    in_contact = np.sum(n**2) > 0.25
    moving = np.sum(d**2) > 0.25
    _zero(limits, m, wrench, velocity, in_contact, not moving)
    _filter(limits, m, wrench, velocity)
    total = _losses(limits, m, contact, n)

    # A new direction or a new set of surfaces: friction is learned anew.
    turned = not moving or _dot(m, _D, d) < 0.9
    other = phase[PHASE_SEGMENT] != m[_SEGMENT]
    for i in range(6):
        other = other or abs(n[i] - m[_N + i]) > 0.5
        m[_N + i] = n[i]
    m[_D : _D + 3] = d
    m[_SEGMENT] = phase[PHASE_SEGMENT]
    if turned:
        m[_QUIET] = 0.0
        m[_TOUCHED] = -1e9
    if turned or other:
        m[_LEARNED] = m[_OVER] = m[_UNDER] = m[_PENDING] = 0.0
        m[_OFFSET] = 0.0

    speed = _dot(m, _V, d)
    way_speed = np.sqrt(m[_V] ** 2 + m[_V + 1] ** 2 + m[_V + 2] ** 2)
    cosine = speed / way_speed if way_speed > 1e-9 else 0.0
    f_raw = -_dot(m, _F, d)
    f = f_raw - limits.tool_mass * _dot(m, _A, d)
    predicted = m[_MU] * total if in_contact else m[_OFFSET]
    innovation = f - predicted
    m[_ALONG], m[_ALONG + 1] = f, predicted
    k = int(m[_TICKS])
    row = _RING + ROW * (k % RING)
    m[row] = time
    m[row + 1 : row + 4] = pose[:3]
    m[row + 4], m[row + 5], m[row + 6] = innovation, speed, f_raw

    if m[_PEAK_LEFT] > 0.0:
        m[_PEAK] = max(m[_PEAK], -_dot(m, _F, m[_PEAK_D : _PEAK_D + 3]))
        m[_PEAK_LEFT] -= 1.0
        # At rest it is as deep in as the impact brings it. What comes then is the push.
        if _dot(m, _V, m[_PEAK_D : _PEAK_D + 3]) <= 0.0:
            m[_PEAK_LEFT] = min(m[_PEAK_LEFT], REST_TICKS)
        if m[_PEAK_LEFT] <= 0.0:
            contact[MEASURED] += 1.0
            contact[PEAK_FORCE] = max(m[_PEAK] - m[_PEAK_BEFORE], 0.0)

    m[_QUIET] = max(m[_QUIET] - 1.0, 0.0)
    stage = phase[PHASE_STAGE]
    along_normal = False
    for i in range(2):
        along_normal = along_normal or abs(np.sum(n[3 * i : 3 * i + 3] * d)) > 0.7
    idle = not moving or along_normal or stage == DONE or stage == HOLD
    pressed = f_raw - m[_PEAK_BEFORE] > 0.5 * limits.impact_force
    same_way = SAME_WAY_PRESSED if pressed else SAME_WAY
    quiet = m[_QUIET] > 0.0 or np.sum(pose[:3] * d) - m[_TOUCHED] < same_way
    if idle or quiet or m[_FILLED] * limits.period < 0.02:
        m[_OVER] = m[_PENDING] = 0.0
    elif m[_PENDING] > 0.0:
        _add(limits, m, innovation, speed)
        m[_PENDING] += 1.0
        m[_HIGHEST] = max(m[_HIGHEST], f_raw)
        if k >= 20:
            m[_EARLIER] = m[_RING + ROW * ((k - 20) % RING) + 4]
        learning = in_contact and m[_LEARNED] * limits.period < LEARN_SEC
        verdict = _is_impact(limits, m, f, total, innovation, speed, learning)
        if verdict > 0:
            _report(limits, m, contact, d)
        elif verdict < 0:
            m[_PENDING] = m[_OVER] = 0.0
            if innovation > 0.5 * limits.impact_force:
                m[_LEARNED] = 0.0
    else:
        sliding = speed > limits.speed_min and cosine > 0.9
        learning = in_contact and m[_LEARNED] * limits.period < LEARN_SEC
        # While mu is being learned only what no friction can do is believed.
        excess = f - limits.friction_max * total if learning else innovation
        m[_OVER] = m[_OVER] + 1.0 if excess > limits.impact_force else 0.0
        low = sliding and innovation < -0.5 * limits.impact_force
        m[_UNDER] = m[_UNDER] + 1.0 if low else 0.0
        if m[_UNDER] * limits.period > DECIDE_SEC:
            m[_UNDER] = m[_LEARNED] = 0.0  # Less friction than before.
        if m[_OVER] >= SAMPLES:
            m[_OVER] = 0.0
            m[_BEFORE] = m[_MU] * total if in_contact else m[_OFFSET]
            _begin(limits, m)
            if m[_BEFORE_SPEED] < limits.speed_min:  # It crept, or was stopped.
                if f > limits.friction_max * total + 2.0 * limits.impact_force:
                    m[_HIGHEST] = f_raw
                    _report(limits, m, contact, d)
                m[_PENDING] = 0.0
        elif sliding:
            _learn(limits, m, f, total if in_contact else 0.0, cosine, innovation)
    m[_TICKS] += 1.0
    return m, contact


@numba.njit(cache=True)
def _report(limits, m, contact, d):
    """An impact: into `contact`, and its peak is looked for from now on."""
    contact[MADE] += 1.0
    contact[TIME] = m[_FIRST]
    contact[_POSITION : _POSITION + 3] = m[_FIRST + 1 : _FIRST + 4]
    contact[_DIRECTION : _DIRECTION + 3] = d
    contact[SPEED] = m[_BEFORE_SPEED]
    contact[PEAK_FORCE] = 0.0
    m[_PEAK] = m[_HIGHEST]
    m[_PEAK_BEFORE] = m[_BEFORE]
    m[_PEAK_D : _PEAK_D + 3] = d
    left = _ticks_of(PEAK_SEC, limits.period) - m[_PENDING]
    m[_PEAK_LEFT] = max(left, 1.0)
    m[_PENDING] = m[_OVER] = 0.0
    m[_LEARNED] = 0.0
    m[_QUIET] = _ticks_of(SAME_SEC, limits.period)
    m[_TOUCHED] = _dot(m, _FIRST + 1, d)


def warm_up(limits: Thresholds) -> None:
    """Compiles it, for read-only arrays as a Context's state is."""
    memory, contact = new_memory(), np.zeros(N_CONTACT)
    for state in (memory, contact):
        state.setflags(write=False)
    zeros = (np.zeros(6), np.zeros(7), np.zeros(6), np.zeros(3), np.zeros(6))
    detect(limits, memory, contact, 0.0, *zeros, np.zeros(6))
