"""A reflex at first touch: the arm brakes with a multiple of the force that it feels.

In the region of an expected impact along d, and for fade_sec after it,

    f_reflex = -d g w clip(f - f_0 - f_least, 0, f_max) clip(v.d / (v_a / 2), 0, 1)

with f = -F.d the force against the motion, f_0 its slow mean (friction), g the gain and
w a weight that fades from 1 to 0 once the region is left. Along d the arm then yields
as if it had 1/(1 + g) of its mass, and an impact F = v sqrt(k m) is smaller by up to
sqrt(1 + g). The last factor lets go when the tip has stopped: braking does not become a
throw back.

It needs no decision that there is a contact, and so no time for one. What limits it is
the arm's torque rate and the delay of a tick. They also make it uneven: a touch falls
anywhere between two ticks, and where the force rises by as much in a tick as the brake
may, a tick more or less is several per cent of the peak. A contact that was felt before
is approached at a speed that needs no brake. There f_least may be another, f_known, so
that the reflex is only a guard.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    ENTER,
    IMPACT,
    N_PHASE,
    PHASE_KIND,
    PHASE_SPEED,
    PHASE_STAGE,
    REGION,
)

# Memory: d (3), f_0, weight, half of the approach speed, f_least or f_known.
N_MEMORY = 7
_BASE, _WEIGHT, _SLOW, _LEAST = 3, 4, 5, 6
SPEED_MIN = 0.003  # [m/s]
# f_0 follows f within this time: of friction alone, and where f is beyond f_least.
BASE_SEC, BASE_SLOW_SEC = 0.05, 0.2


class ReflexLaw(NamedTuple):
    """Constants of the reflex."""

    gain: float  # g
    force_least: float  # f_least, above the sensor's noise [N].
    force_max: float  # f_max [N]
    fade_sec: float
    period: float  # Of a tick [s].
    force_known: float = 0.0  # f_known [N]; 0: f_least.


@numba.njit(cache=True)
def tick(law, memory, wrench, velocity, direction, phase, known=0.0):
    """One tick.

    Args: law; memory (N_MEMORY,), zero at first; wrench (6,) on the tool [N], [N m];
        velocity (6,) of the tip; direction (3,) of the motion; phase (6,): anything may
        be NaN, and then there is no reflex; known: 1 if the contact ahead was felt
        before.
    Returns: memory; force (3,) [N], world axes.
    """
    m, force = memory.copy(), np.zeros(3)
    for i in range(3):
        if not np.isfinite(wrench[i] + velocity[i] + direction[i]):
            m[_WEIGHT] = 0.0
            return m, force
    expected = (phase[PHASE_STAGE] == ENTER or phase[PHASE_STAGE] == REGION) and (
        phase[PHASE_KIND] == IMPACT
    )
    moving = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2 > 0.5
    if expected and moving:
        m[:3] = direction
        m[_SLOW] = max(0.5 * phase[PHASE_SPEED], SPEED_MIN)
        guards = known > 0.5 and law.force_known > 0.0
        m[_LEAST] = law.force_known if guards else law.force_least
    f = -(wrench[0] * m[0] + wrench[1] * m[1] + wrench[2] * m[2])
    if expected and moving:
        if m[_WEIGHT] < 1.0:
            m[_BASE] = f
        within = f - m[_BASE] < law.force_least
        m[_BASE] += (
            law.period / (BASE_SEC if within else BASE_SLOW_SEC) * (f - m[_BASE])
        )
        m[_WEIGHT] = 1.0
    else:
        m[_WEIGHT] = max(m[_WEIGHT] - law.period / law.fade_sec, 0.0)
    if m[_WEIGHT] > 0.0:
        v = velocity[0] * m[0] + velocity[1] * m[1] + velocity[2] * m[2]
        beyond = min(max(f - m[_BASE] - m[_LEAST], 0.0), law.force_max)
        size = law.gain * m[_WEIGHT] * beyond * min(max(v / m[_SLOW], 0.0), 1.0)
        for i in range(3):
            force[i] = -size * m[i]
    return m, force


def fastest_impact(force, stiffness, mass, delay, rate) -> float:
    """The highest speed [m/s] at which an impact stays below `force`, if from `delay`
    after the touch on the arm brakes harder and harder, at its limit.

    A mass on a spring, m x'' = -k x - r max(t - t_d, 0), x(0) = 0, x'(0) = v: no law of
    control can have a lower peak k x, whatever it knows.

    Args: force, the peak allowed [N]; stiffness k [N/m]; mass m [kg]; delay t_d of
        sensor and control [s]; rate r at which the braking force can grow [N/s].
    """
    w = np.sqrt(stiffness / mass)
    s = np.linspace(
        0.0, np.pi / w, 4001
    )  # Since t_d; the peak is within half a period.

    def peak(v):
        if w * delay >= 0.5 * np.pi:
            return v / w
        x, speed = v / w * np.sin(w * delay), v * np.cos(w * delay)
        ramp = rate / stiffness
        out = x * np.cos(w * s) + (speed + ramp) / w * np.sin(w * s) - ramp * s
        return float(out.max())

    low, high = 0.0, force / np.sqrt(stiffness * mass)
    while stiffness * peak(high) < force:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if stiffness * peak(middle) < force:
            low = middle
        else:
            high = middle
    return float(low)


def warm_up(law: ReflexLaw) -> None:
    """Compiles the tick, for a memory that is read-only as a Context's state is."""
    memory = np.zeros(N_MEMORY)
    memory.setflags(write=False)
    tick(law, memory, np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(N_PHASE), 0.0)
