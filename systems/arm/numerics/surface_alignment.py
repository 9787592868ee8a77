"""Turns a tool until it lies flat on the surface that it is pressed on.

A face that meets a surface at a small angle stands on one edge, with a moment about the
tip. The tool yields to this moment, an admittance

    w = tau_t / d,    tau_t = (I - n n') tau,    |phi| <= angle_max

with phi the turn beyond the planned orientation and n the direction of pressing. On its
face the tool comes to rest where the moment vanishes. An edge or a corner that is meant
to touch leans as far as angle_max (2 % more while it settles) and stays what it is. In
the air phi goes back to zero.

w follows tau_t / d with a first-order lag, so that there is an acceleration to feed
forward: the wrist's inertia (3 kg m2 at a Panda's tip, mostly the motors') is too large
for an impedance of 40 N m/rad to follow within a few tenths of a second.
"""

from typing import NamedTuple

import numba
import numpy as np

LAG_SEC = 0.03
LIMIT_SEC = 0.05  # Time constant with which phi approaches angle_max.
BACK_SEC = 0.1  # The same for zero, in the air.
FORCE_MIN = 1.0  # With less the surface is not touched [N].
PHI, W, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
N_MEMORY = 9


class AlignmentLaw(NamedTuple):
    """Constants of the alignment."""

    angle_max: float  # [rad]
    damping: float = 1.0  # d [N m s/rad].
    speed_max: float = 0.1  # [rad/s]
    period: float = 0.001  # [s]


@numba.njit(cache=True)
def tick(law, memory, wrench, force_directions):
    """The memory (9,) = [phi [rad], w [rad/s], dw/dt [rad/s2]] after one sample.

    Args: law: AlignmentLaw. wrench (6,) on the tool at its tip, world axes, force first
        [N], [N m]. force_directions (6,): two rows that the tool presses along; zero
        rows: none. With two the tool keeps its turn: a corner of two surfaces says
        nothing about either. A wrench that is not finite is ignored.
    """
    m = memory.copy()
    phi, w = m[PHI], m[W]
    first, second = force_directions[:3], force_directions[3:]
    one, two = first @ first > 0.25, second @ second > 0.25
    wanted = np.zeros(3)
    if not np.all(np.isfinite(wrench)):
        pass
    elif not one and not two:
        wanted = -phi / BACK_SEC
    elif one != two:
        n = first / np.sqrt(first @ first) if one else second / np.sqrt(second @ second)
        if -(wrench[:3] @ n) > FORCE_MIN:
            tau = wrench[3:]
            wanted = (tau - (tau @ n) * n) / law.damping
    speed = np.sqrt(wanted @ wanted)
    if speed > law.speed_max:
        wanted *= law.speed_max / speed
    angle = np.sqrt(phi @ phi)
    if angle > 1e-9:
        out = phi / angle
        outward = wanted @ out
        most = (law.angle_max - angle) / LIMIT_SEC
        if outward > most:
            wanted += (most - outward) * out
    m[ACCELERATION] = (wanted - w) / LAG_SEC
    m[W] = w + law.period * m[ACCELERATION]
    m[PHI] = phi + law.period * m[W]
    return m


@numba.njit(cache=True)
def turned(memory, x_desired):
    """x_desired (19,) = [p, quaternion wxyz, v, w, dv/dt, dw/dt], turned by phi."""
    out = x_desired.copy()
    phi = memory[PHI]
    angle = np.sqrt(phi @ phi)
    if angle > 1e-12:
        s = np.sin(0.5 * angle) / angle
        a, x, y, z = np.cos(0.5 * angle), s * phi[0], s * phi[1], s * phi[2]
        b, i, j, k = x_desired[3:7]
        out[3] = a * b - x * i - y * j - z * k
        out[4] = a * i + x * b + y * k - z * j
        out[5] = a * j - x * k + y * b + z * i
        out[6] = a * k + x * j - y * i + z * b
    out[10:13] += memory[W]
    out[16:19] += memory[ACCELERATION]
    return out


def warm_up(law: AlignmentLaw) -> None:
    """Compiles it, for read-only arrays as a Context's state is."""
    memory = np.zeros(N_MEMORY)
    memory.setflags(write=False)
    tick(law, memory, np.zeros(6), np.zeros(6))
    turned(memory, np.zeros(19))
