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
the push that follows. It is read from a Butterworth filter of second order at 100 Hz,
as F100 is (numerics/impact_score.py); at a stiff surface one of first order differs
from it by 5 %, either way.

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
from makebreak.systems.numerics.few_numbers import dot

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
RING = 120  # Samples kept.

# The memory. All fields are float64, so that Drake keeps it as a vector;
# vector.view(MEMORY)[0] is its record: the same numbers, by name. Compiled code must
# hold the vector for as long as the record.
SAMPLE = np.dtype(
    [
        ("time", float),
        ("position", float, 3),  # p_WE
        ("innovation", float),
        ("speed", float),  # Along the motion.
        ("force", float),  # Against it.
    ],
    align=True,
)
MEMORY = np.dtype(
    [
        ("ticks", float),
        ("wrench", float, 6),  # The raw one before.
        ("same", float),  # Ticks for which it has not changed.
        ("bias_sum", float, 3),
        ("bias_n", float),
        ("zeroed", float),  # 1: the bias is complete.
        ("force", float, 3),  # Filtered.
        ("force_100", float, 3),  # Through the filter of the peak,
        ("peak_filter", float, (2, 3)),  # and its memory.
        ("velocity", float, 3),
        ("velocity_raw", float, 3),
        ("acceleration", float, 3),
        ("filled", float),  # Samples since the filters were (re)started.
        ("d", float, 3),
        ("n", float, 6),
        ("segment", float),
        ("mu", float),
        ("offset", float),  # What is learned instead of mu without normal forces [N].
        ("learned", float),  # Ticks of sliding since learning began.
        ("over", float),  # Ticks in a row above the threshold,
        ("under", float),  # and below its negative.
        ("pending", float),  # Ticks since the first sample; 0: nothing is pending.
        ("before", float),  # The force against the motion before the contact [N],
        ("before_speed", float),  # and the speed [m/s].
        ("way", float),  # The way x since then [m];
        ("sum_xx", float),  # sums over the samples, F: the innovation;
        ("sum_Fx", float),
        ("sum_F", float),
        ("sum_FF", float),
        ("earlier", float),  # the innovation 20 ms ago or less [N],
        ("highest", float),  # and the largest of the peak's filter [N].
        ("first_time", float),  # Of the first sample,
        ("first_position", float, 3),  # and where it was.
        ("quiet", float),  # Ticks until the next contact is believed,
        ("touched", float),  # and where the last one was, along d [m].
        ("peak_left", float),  # Ticks until the peak counts as measured.
        ("peak", float),
        ("peak_before", float),
        ("peak_d", float, 3),
        ("held", float, 2),  # Ticks that each normal force was there,
        ("lost", float, 2),  # and ticks that it was not.
        ("armed", float, 2),
        ("along", float, 2),  # f and its prediction, for the eye [N].
        ("ring", SAMPLE, RING),  # Sample k is in row k % RING.
    ],
    align=True,
)
N_MEMORY = MEMORY.itemsize // 8
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


def new_memory(tared: bool = False) -> np.ndarray:
    """(N_MEMORY,) before the first tick. Args: tared: the wrench has no bias."""
    memory = np.zeros(N_MEMORY)
    memory.view(MEMORY)["segment"] = -1.0
    memory.view(MEMORY)["zeroed"] = float(tared)
    return memory


@numba.njit(cache=True)
def _ticks_of(seconds, period):
    return max(1.0, np.floor(seconds / period + 0.5))


@numba.njit(cache=True)
def _restart(m):
    """After a gap in the data: filters and what is pending begin anew."""
    m.filled = 0.0
    m.over = m.under = m.pending = m.learned = 0.0
    m.peak_left = 0.0
    for i in range(2):
        m.held[i] = m.lost[i] = m.armed[i] = 0.0


@numba.njit(cache=True)
def _is_usable(limits, m, wrench, velocity):
    """Whether the wrench can be believed; counts for how long it has not changed."""
    same, finite, at_limit = True, True, False
    for i in range(6):
        same = same and wrench[i] == m.wrench[i]
        finite = finite and np.isfinite(wrench[i])
        at_limit = at_limit or abs(wrench[i]) >= limits.wrench_limit
        m.wrench[i] = wrench[i]
    stuck = _ticks_of(STUCK_SEC, limits.period)
    if not same:
        m.same = 0.0
    elif m.same >= stuck or np.sum(velocity[:3] ** 2) > STUCK_SPEED**2:
        m.same += 1.0  # A tip at rest in a world without noise may feel no change.
    return finite and not at_limit and m.same < stuck


@numba.njit(cache=True)
def _filter(limits, m, wrench, velocity):
    """Force without bias, velocity and acceleration, filtered, into the memory."""
    alpha = 1.0 - np.exp(-2.0 * np.pi * CUTOFF_HZ * limits.period)
    slow = 1.0 - np.exp(-2.0 * np.pi * CUTOFF_ACCELERATION_HZ * limits.period)
    # Butterworth, second order, by the bilinear transform.
    w = np.tan(np.pi * CUTOFF_HZ * limits.period)
    unit = 1.0 + np.sqrt(2.0) * w + w * w
    b = w * w / unit  # 1, 2, 1 times this,
    a1, a2 = 2.0 * (w * w - 1.0) / unit, (1.0 - np.sqrt(2.0) * w + w * w) / unit
    n = max(m.bias_n, 1.0)
    for i in range(3):
        force = wrench[i] - m.bias_sum[i] / n
        if m.filled == 0.0:
            m.peak_filter[0, i], m.peak_filter[1, i] = (
                (1.0 - b) * force,
                (b - a2) * force,
            )
        out = b * force + m.peak_filter[0, i]
        m.peak_filter[0, i] = 2.0 * b * force - a1 * out + m.peak_filter[1, i]
        m.peak_filter[1, i] = b * force - a2 * out
        m.force_100[i] = out
        if m.filled == 0.0:
            m.force[i], m.velocity[i], m.acceleration[i] = force, velocity[i], 0.0
        else:
            m.force[i] += alpha * (force - m.force[i])
            m.velocity[i] += alpha * (velocity[i] - m.velocity[i])
            rate = (velocity[i] - m.velocity_raw[i]) / limits.period
            m.acceleration[i] += slow * (rate - m.acceleration[i])
        m.velocity_raw[i] = velocity[i]
    m.filled += 1.0


@numba.njit(cache=True)
def _zero(limits, m, wrench, velocity, in_contact, at_rest):
    """Averages the wrench at rest in free space, at the beginning."""
    if m.zeroed > 0.0 or m.ticks < ZERO_SKIP_SEC / limits.period:
        return
    if in_contact or not at_rest or np.sum(velocity[:3] ** 2) > STUCK_SPEED**2:
        m.zeroed = 1.0
    else:
        for i in range(3):
            m.bias_sum[i] += wrench[i]
        m.bias_n += 1.0
        if m.bias_n >= ZERO_SEC / limits.period:
            m.zeroed = 1.0
    if m.zeroed > 0.0:
        if m.bias_n < 0.2 * ZERO_SEC / limits.period:  # Too few: no bias is better.
            m.bias_sum[:] = 0.0
        m.filled = 0.0


@numba.njit(cache=True)
def _losses(limits, m, contact, n):
    """Contacts broken. Returns the sum of the normal forces [N]."""
    total = 0.0
    held_ticks = _ticks_of(HELD_SEC, limits.period)
    lost_ticks = _ticks_of(LOST_SEC, limits.period)
    for i in range(2):
        row = n[3 * i : 3 * i + 3]
        if np.sum(row**2) < 0.25:
            m.held[i] = m.lost[i] = m.armed[i] = 0.0
            continue
        normal = -dot(m.force, row)
        total += max(normal, 0.0)
        m.held[i] = m.held[i] + 1.0 if normal > 1.5 * limits.loss_force else 0.0
        if m.held[i] >= held_ticks:
            m.armed[i] = 1.0
        m.lost[i] = m.lost[i] + 1.0 if normal < limits.loss_force else 0.0
        if m.armed[i] > 0.0 and m.lost[i] >= lost_ticks:
            m.armed[i] = 0.0
            contact[BROKEN] += 1.0
            contact[BROKEN_ROW] = i
    return total


@numba.njit(cache=True)
def _learn(limits, m, f, total, cosine, innovation):
    """mu, or without normal forces the offset, from f at this sample."""
    begun = m.learned * limits.period < LEARN_SEC
    if not begun and abs(innovation) > 0.5 * limits.impact_force:
        return
    gain = limits.period / (FAST_SEC if begun else SLOW_SEC)
    gain = max(gain, 1.0 / (m.learned + 1.0)) if begun else gain
    m.learned += 1.0
    if total <= 0.0:
        # Bounded: what is left of a bias, or drag. More would hide a contact.
        most = 0.5 * limits.impact_force
        m.offset += gain * (f - m.offset)
        m.offset = min(max(m.offset, -most), most)
    elif total > 0.5:
        mu = min(max(f / (total * cosine), 0.0), limits.friction_max)
        m.mu += gain * (mu - m.mu)


@numba.njit(cache=True)
def _begin(limits, m):
    """Something is pending: finds its first sample in the ring."""
    k = int(m.ticks)
    first = k
    # The first of those that depart, two samples earlier for the lag of the filter.
    for back in range(1, BACK):
        innovation = m.ring[(k - back) % RING].innovation
        if k - back < 0 or innovation < 0.25 * limits.impact_force:
            break
        first = k - back
    first = max(first - 2, 0)
    speed, n = 0.0, 0
    for back in range(1, 13):
        if first - back >= 0:
            speed += m.ring[(first - back) % RING].speed
            n += 1
    m.before_speed = speed / n if n > 0 else 0.0
    force, n = 0.0, 0
    gap, last = (
        int(GAP_SEC / limits.period),
        int((GAP_SEC + BEFORE_SEC) / limits.period),
    )
    for back in range(gap, min(last, RING - BACK - 4)):
        if first - back >= 0 and back < m.filled - BACK:
            force += m.ring[(first - back) % RING].force
            n += 1
    if n > 0:
        m.before = force / n
    sample = m.ring[first % RING]
    m.first_time = sample.time
    m.first_position[:] = sample.position
    m.pending = k - first + 1.0
    m.way = m.earlier = m.highest = 0.0
    m.sum_xx = m.sum_Fx = m.sum_F = m.sum_FF = 0.0
    for i in range(first, k + 1):
        sample = m.ring[i % RING]
        _add(limits, m, sample.innovation, sample.speed)


@numba.njit(cache=True)
def _add(limits, m, F, speed):
    """A sample of what is pending: its innovation F and its speed."""
    m.way += max(speed, 0.0) * limits.period
    x = m.way
    m.sum_xx += x * x
    m.sum_Fx += F * x
    m.sum_F += F
    m.sum_FF += F * F


@numba.njit(cache=True)
def _is_impact(limits, m, f, total, innovation, speed, learning):
    """1: an impact, 0: not yet decided, -1: a change of friction, or nothing."""
    if innovation < 0.5 * limits.impact_force:
        return -1
    before = m.before_speed
    lost = 1.0 - speed / before
    beyond = f - limits.friction_max * total - limits.impact_force
    if beyond > 0.0 and (lost > SPEED_LOST_FREE or beyond > limits.impact_force):
        return 1
    if lost > SPEED_LOST and not learning:
        xx, Fx, F, FF = m.sum_xx, m.sum_Fx, m.sum_F, m.sum_FF
        as_spring = FF - Fx * Fx / max(xx, 1e-18)
        as_step = FF - F * F / m.pending
        stiff = Fx > limits.stiffness_min * xx
        if stiff and as_spring < SPRING_OVER_STEP * as_step:
            return 1
    elapsed = m.pending * limits.period
    grows = innovation > 1.15 * m.earlier
    if elapsed > DECIDE_MOST_SEC or (elapsed > DECIDE_SEC and not grows):
        return -1
    return 0


@numba.njit(cache=True)
def detect(limits, memory, contact, time, wrench, pose, velocity, d, n, phase):
    """One tick, which changes memory and contact in place.

    Args: limits: Thresholds. memory (N_MEMORY,), contact (14,): of the last tick.
        time [s]. wrench (6,) on the tool, world axes [N], [N m]. pose (7,) and velocity
        (6,) of the tip. d (3,) unit vector of the motion, zero at rest. n (6,) two rows
        of force directions. phase (6,). Any of them may be NaN.
    """
    m = memory.view(MEMORY)[0]
    usable = _is_usable(limits, m, wrench, velocity)
    usable = usable and np.all(np.isfinite(velocity)) and np.all(np.isfinite(pose[:3]))
    usable = usable and np.all(np.isfinite(d)) and np.all(np.isfinite(n))
    usable = usable and np.all(np.isfinite(phase))
    contact[STATUS] = 0.0 if usable else 1.0
    if not usable:
        _restart(m)
        m.ticks += 1.0
        return

    in_contact = np.sum(n**2) > 0.25
    moving = np.sum(d**2) > 0.25
    _zero(limits, m, wrench, velocity, in_contact, not moving)
    _filter(limits, m, wrench, velocity)
    total = _losses(limits, m, contact, n)

    # A new direction or a new set of surfaces: friction is learned anew.
    turned = not moving or dot(m.d, d) < 0.9
    other = phase[PHASE_SEGMENT] != m.segment
    for i in range(6):
        other = other or abs(n[i] - m.n[i]) > 0.5
        m.n[i] = n[i]
    m.d[:] = d
    m.segment = phase[PHASE_SEGMENT]
    if turned:
        m.quiet = 0.0
        m.touched = -1e9
    if turned or other:
        m.learned = m.over = m.under = m.pending = 0.0
        m.offset = 0.0

    speed = dot(m.velocity, d)
    way_speed = np.sqrt(m.velocity[0] ** 2 + m.velocity[1] ** 2 + m.velocity[2] ** 2)
    cosine = speed / way_speed if way_speed > 1e-9 else 0.0
    f_raw = -dot(m.force, d)
    f = f_raw - limits.tool_mass * dot(m.acceleration, d)
    predicted = m.mu * total if in_contact else m.offset
    innovation = f - predicted
    m.along[0], m.along[1] = f, predicted
    k = int(m.ticks)
    sample = m.ring[k % RING]
    sample.time = time
    sample.position[:] = pose[:3]
    sample.innovation, sample.speed, sample.force = innovation, speed, f_raw

    if m.peak_left > 0.0:
        m.peak = max(m.peak, -dot(m.force_100, m.peak_d))
        m.peak_left -= 1.0
        # At rest it is as deep in as the impact brings it. What comes then is the push.
        if dot(m.velocity, m.peak_d) <= 0.0:
            m.peak_left = min(m.peak_left, REST_TICKS)
        if m.peak_left <= 0.0:
            contact[MEASURED] += 1.0
            contact[PEAK_FORCE] = max(m.peak - m.peak_before, 0.0)

    m.quiet = max(m.quiet - 1.0, 0.0)
    stage = phase[PHASE_STAGE]
    along_normal = False
    for i in range(2):
        along_normal = along_normal or abs(np.sum(n[3 * i : 3 * i + 3] * d)) > 0.7
    idle = not moving or along_normal or stage == DONE or stage == HOLD
    pressed = f_raw - m.peak_before > 0.5 * limits.impact_force
    same_way = SAME_WAY_PRESSED if pressed else SAME_WAY
    quiet = m.quiet > 0.0 or np.sum(pose[:3] * d) - m.touched < same_way
    if idle or quiet or m.filled * limits.period < 0.02:
        m.over = m.pending = 0.0
    elif m.pending > 0.0:
        _add(limits, m, innovation, speed)
        m.pending += 1.0
        m.highest = max(m.highest, -dot(m.force_100, d))
        if k >= 20:
            m.earlier = m.ring[(k - 20) % RING].innovation
        learning = in_contact and m.learned * limits.period < LEARN_SEC
        verdict = _is_impact(limits, m, f, total, innovation, speed, learning)
        if verdict > 0:
            _report(limits, m, contact, d)
        elif verdict < 0:
            m.pending = m.over = 0.0
            if innovation > 0.5 * limits.impact_force:
                m.learned = 0.0
    else:
        sliding = speed > limits.speed_min and cosine > 0.9
        learning = in_contact and m.learned * limits.period < LEARN_SEC
        # While mu is being learned only what no friction can do is believed.
        excess = f - limits.friction_max * total if learning else innovation
        m.over = m.over + 1.0 if excess > limits.impact_force else 0.0
        low = sliding and innovation < -0.5 * limits.impact_force
        m.under = m.under + 1.0 if low else 0.0
        if m.under * limits.period > DECIDE_SEC:
            m.under = m.learned = 0.0  # Less friction than before.
        if m.over >= SAMPLES:
            m.over = 0.0
            m.before = m.mu * total if in_contact else m.offset
            _begin(limits, m)
            if m.before_speed < limits.speed_min:  # It crept, or was stopped.
                if f > limits.friction_max * total + 2.0 * limits.impact_force:
                    m.highest = -dot(m.force_100, d)
                    _report(limits, m, contact, d)
                m.pending = 0.0
        elif sliding:
            _learn(limits, m, f, total if in_contact else 0.0, cosine, innovation)
    m.ticks += 1.0
    return memory, contact


@numba.njit(cache=True)
def _report(limits, m, contact, d):
    """An impact: into `contact`, and its peak is looked for from now on."""
    contact[MADE] += 1.0
    contact[TIME] = m.first_time
    contact[_POSITION : _POSITION + 3] = m.first_position
    contact[_DIRECTION : _DIRECTION + 3] = d
    contact[SPEED] = m.before_speed
    contact[PEAK_FORCE] = 0.0
    m.peak = m.highest
    m.peak_before = m.before
    m.peak_d[:] = d
    left = _ticks_of(PEAK_SEC, limits.period) - m.pending
    m.peak_left = max(left, 1.0)
    m.pending = m.over = 0.0
    m.learned = 0.0
    m.quiet = _ticks_of(SAME_SEC, limits.period)
    m.touched = dot(m.first_position, d)


def warm_up(limits: Thresholds) -> None:
    """Compiles it."""
    memory, contact = new_memory(), np.zeros(N_CONTACT)
    zeros = (np.zeros(6), np.zeros(7), np.zeros(6), np.zeros(3), np.zeros(6))
    detect(limits, memory, contact, 0.0, *zeros, np.zeros(6))
