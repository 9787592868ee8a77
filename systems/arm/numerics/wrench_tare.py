"""The bias of a force-torque sensor, from what it says in free space.

Where nothing touches the tool the wrench is the sensor's bias: its mean over a window
of WINDOW_SEC in which the motion presses on nothing and the tip rests or moves
steadily. (The tool's own inertia, 0.3 kg times STEADY, is 15 mN.) The first one may
also be longer, if it is steady as a whole: a tip that follows something never is for
WINDOW_SEC, but over half a second. Later windows follow the drift, by no more than a
sensor may drift in a window. So a contact that nobody knows of, or the first
milliseconds of an expected one, is not taken for a bias.

Nothing is subtracted before the first window is complete. A first mean larger than
bias_max is no bias but a contact: the run has begun in it, and waits for free space.

While the tool is pressed on one surface and slides, the drift goes on to be followed,
and the surface's slope found, from the force across the motion (sideways_force.py).

Systems that read the wrench at a lower rate read the mean of the last AVERAGED samples:
every fifth sample alone would have the noise of all frequencies up to 500 Hz.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics import sideways_force
from makebreak.systems.arm.numerics.sideways_force import (
    PERIOD,
    predict,
    reset_bias,
    reset_slope,
    update,
)

# Status.
TARED, NOT_TARED, REFUSED, BAD_WRENCH = range(4)

SKIP_SEC = 0.01  # At the start: nothing is known of a sensor that is late.
WINDOW_SEC = 0.1
WINDOW_MOST_SEC = 1.0  # Of the first one.
STEADY = 0.05  # Of the tip, mean acceleration over a window [m/s2].
TURNING = 0.05  # Faster than that, a tool's moment changes [rad/s].
LEFT = 1.0  # More than that beyond the bias is a contact, no drift [N].

AVERAGED = 5  # Samples in the mean, as many as a period of 200 Hz has.

SAME_SURFACE = 0.98  # Cosine of two directions of pressing.

# Memory: ticks; samples in the window, their sum (6), v at the window's start (3); bias
# at the last tare (6); 1 when tared; status; the wrench before (6); the direction in
# which the surface is pressed whose slope is known (3); 1 while the tool is pressed;
# how many good wrenches came one after the other; of the long window, samples, sum and
# v (10) as above; the last ones of the good wrenches, newest
# first (AVERAGED - 1, 6); the estimate of sideways_force.py.
_TICKS, _N, _SUM, _V, _BIAS, _TARED, _STATUS, _LAST = 0, 1, 2, 8, 11, 17, 18, 19
_ROW, _PRESSED, _GOOD, _LONG, _RECENT = 25, 28, 29, 30, 40
_SIDEWAYS = _RECENT + 6 * (AVERAGED - 1)
_SLOPE = _SIDEWAYS + sideways_force.S.start
N_MEMORY = _SIDEWAYS + sideways_force.N_MEMORY
STATUS, SLOPE = slice(_STATUS, _STATUS + 1), slice(_SLOPE, _SLOPE + 3)


class TareLaw(NamedTuple):
    """Constants of the tare."""

    bias_max: float = 3.0  # A larger force at first is a contact [N].
    drift_max: float = 0.05  # Of a sensor [N/s].
    drift_moment_max: float = 0.005  # [N m/s]
    wrench_limit: float = 200.0  # At which the sensor saturates [N], [N m].
    sideways: bool = True  # Drift and slope while sliding.
    period: float = 0.001  # [s]


def new_memory() -> np.ndarray:
    """(N_MEMORY,) before the first tick."""
    memory = np.zeros(N_MEMORY)
    memory[_STATUS] = NOT_TARED
    reset_bias(memory[_SIDEWAYS:])
    reset_slope(memory[_SIDEWAYS:])
    return memory


@numba.njit(cache=True)
def bias_of(memory):
    """The bias (6,) of now [N], [N m]."""
    out = memory[_BIAS : _BIAS + 6].copy()
    out[:3] += memory[_SIDEWAYS : _SIDEWAYS + 3]
    return out


@numba.njit(cache=True)
def sloped(memory, force_directions):
    """Force directions (6,) at right angles to the surface: a row in the direction
    whose slope is known is turned by it."""
    out = force_directions.copy()
    for row in (0, 3):
        n = out[row : row + 3]
        if n @ memory[_ROW : _ROW + 3] > SAME_SURFACE:
            length = np.sqrt(n @ n)
            n -= length * memory[_SLOPE : _SLOPE + 3]
            n *= length / np.sqrt(n @ n)
    return out


@numba.njit(cache=True)
def is_usable(wrench, limit):
    """Whether a wrench (6,) is finite and within the sensor's range."""
    for i in range(6):
        if not np.isfinite(wrench[i]) or abs(wrench[i]) >= limit:
            return False
    return True


@numba.njit(cache=True)
def tared(law, memory, wrench):
    """A wrench (6,) without its bias; one that cannot be used is left as it is."""
    if is_usable(wrench, law.wrench_limit):
        return wrench - bias_of(memory)
    return wrench.copy()


@numba.njit(cache=True)
def tared_mean(law, memory, wrench):
    """The mean of this wrench (6,) and the last good ones, without their bias; one that
    cannot be used is left as it is."""
    if not is_usable(wrench, law.wrench_limit):
        return wrench.copy()
    out = wrench.copy()
    n = min(int(memory[_GOOD]), AVERAGED - 1)
    for k in range(n):
        out += memory[_RECENT + 6 * k : _RECENT + 6 * k + 6]
    return out / (n + 1) - bias_of(memory)


@numba.njit(cache=True)
def tick(law, memory, wrench, velocity, force_directions):
    """One sample, which changes the memory in place.

    Args: law: TareLaw. memory (N_MEMORY,). wrench (6,) measured, force first [N],
        [N m]. velocity (6,) of the tip [m/s], [rad/s]. force_directions (6,): two rows
        that the tool presses along; zero rows: none. Any of them may be NaN.
    """
    m = memory
    m[_TICKS] += 1.0
    known = m[_TARED] > 0.0
    if not is_usable(wrench, law.wrench_limit):
        m[_STATUS] = BAD_WRENCH
        m[_N] = m[_LONG] = m[_GOOD] = 0.0
        return
    if known:
        m[_STATUS] = TARED
    elif m[_STATUS] == BAD_WRENCH:
        m[_STATUS] = NOT_TARED
    changed = False
    turning, pressed = 0.0, 0.0
    for i in range(6):
        changed = changed or wrench[i] != m[_LAST + i]
        m[_LAST + i] = wrench[i]
        pressed += force_directions[i] ** 2
    for i in range(3):
        turning += velocity[3 + i] ** 2 + 0.0 * velocity[i]  # NaN if any is.
    free = pressed < 0.25 and turning < TURNING**2
    if law.sideways and known and np.isfinite(turning + pressed):
        _slide(law, m, wrench, velocity, force_directions)
    m[_GOOD] += 1.0
    m[_RECENT + 6 : _SIDEWAYS] = m[_RECENT : _SIDEWAYS - 6].copy()
    m[_RECENT : _RECENT + 6] = wrench
    # A sensor that is stuck says nothing of its drift.
    if not free or (known and not changed) or m[_TICKS] * law.period <= SKIP_SEC:
        m[_N] = m[_LONG] = 0.0
        return
    is_long = not known and _add(m, _LONG, wrench, velocity, law.period)
    is_short = _add(m, _N, wrench, velocity, law.period)
    if not (is_short or is_long):
        if m[_N] * law.period >= WINDOW_SEC - 1e-9:
            m[_N] = 0.0
        if m[_LONG] * law.period > WINDOW_MOST_SEC:
            m[_LONG] = 0.0
        return
    first = _N if is_short else _LONG
    seconds, mean = m[first] * law.period, m[first + 1 : first + 7] / m[first]
    m[_N] = m[_LONG] = 0.0
    off = mean - bias_of(m)
    force = np.sqrt(np.sum(off[:3] ** 2))
    if not known and force > law.bias_max:
        m[_STATUS] = REFUSED
    elif not known:
        m[_BIAS : _BIAS + 6] = mean
        m[_TARED], m[_STATUS] = 1.0, TARED
    elif force <= LEFT:
        for i in range(6):
            most = seconds * (law.drift_max if i < 3 else law.drift_moment_max)
            m[_BIAS + i] += min(max(off[i], -most), most)


@numba.njit(cache=True)
def _add(m, first, wrench, velocity, period):
    """Adds a sample to the window whose memory begins at `first`. Returns: whether it
    is long enough, and was steady as a whole."""
    if m[first] == 0.0:
        m[first + 1 : first + 7] = 0.0
        m[first + 7 : first + 10] = velocity[:3]
    for i in range(6):
        m[first + 1 + i] += wrench[i]
    m[first] += 1.0
    seconds = m[first] * period
    changed = np.sum((velocity[:3] - m[first + 7 : first + 10]) ** 2)
    return seconds >= WINDOW_SEC - 1e-9 and changed <= (STEADY * seconds) ** 2


@numba.njit(cache=True)
def _slide(law, m, wrench, velocity, force_directions):
    """Drift and slope, while one surface is pressed. In place."""
    first, second = force_directions[:3], force_directions[3:]
    one = first @ first > 0.25
    two = second @ second > 0.25
    if not one and not two:
        if m[_PRESSED] > 0.0:  # What was found of the drift belongs to the bias.
            for i in range(3):
                m[_BIAS + i] += m[_SIDEWAYS + i]
            reset_bias(m[_SIDEWAYS:])
        m[_PRESSED] = 0.0
        return
    if m[_PRESSED] == 0.0:
        reset_bias(m[_SIDEWAYS:])
        m[_PRESSED] = 1.0
    if m[_TICKS] % max(1.0, np.round(PERIOD / law.period)) != 0.0:
        return
    predict(m[_SIDEWAYS:])
    if one and two:
        return
    n = first / np.sqrt(first @ first) if one else second / np.sqrt(second @ second)
    if n @ m[_ROW : _ROW + 3] < SAME_SURFACE:
        m[_ROW : _ROW + 3] = n
        reset_slope(m[_SIDEWAYS:])
    force = wrench[:3] - m[_BIAS : _BIAS + 3]
    update(m[_SIDEWAYS:], force, velocity[:3].copy(), n)


def warm_up(law: TareLaw) -> None:
    """Compiles it, for arrays as a Context's: a state that is read is read-only."""
    memory, zero = new_memory(), np.zeros(6)
    tick(law, memory, zero, zero, zero)
    memory.setflags(write=False)
    tared(law, memory, zero)
    tared_mean(law, memory, zero)
    sloped(memory, zero)
    bias_of(memory)
