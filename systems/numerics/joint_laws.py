"""Forces on one joint that depend on its own position and velocity, compiled.

Each law (q, v, t, p) gives the force on the joint [N m] or [N] from its position,
velocity, the time and up to five parameters p.
"""

import math
from typing import NamedTuple

import numba
import numpy as np


@numba.njit(cache=True)
def coulomb_law(q, v, t, p):
    """p: Coulomb friction, speed below which it fades."""
    return -p[0] * math.tanh(v / p[1])


@numba.njit(cache=True)
def direction_law(q, v, t, p):
    """p: Coulomb friction for v > 0, for v < 0, speed below which it fades."""
    return -(p[0] if v > 0.0 else p[1]) * math.tanh(v / p[2])


@numba.njit(cache=True)
def stribeck_law(q, v, t, p):
    """p: sliding friction, static friction, Stribeck velocity, speed below which it
    fades."""
    peak = (p[1] - p[0]) * math.exp(-((v / p[2]) ** 2))
    return -(p[0] + peak) * math.tanh(v / p[3])


@numba.njit(cache=True)
def drag_law(q, v, t, p):
    """p: coefficient of quadratic drag."""
    return -p[0] * v * abs(v)


@numba.njit(cache=True)
def ripple_law(q, v, t, p):
    """p: amplitude, periods per revolution, phase [rad]."""
    return p[0] * math.sin(p[1] * q + p[2])


@numba.njit(cache=True)
def spring_law(q, v, t, p):
    """p: stiffness, rest."""
    return -p[0] * (q - p[1])


@numba.njit(cache=True)
def position_law(q, v, t, p):
    """p: Coulomb friction at a low and at a high position, these positions, speed below
    which it fades; linear between them and constant beyond."""
    share = min(max((q - p[2]) / (p[3] - p[2]), 0.0), 1.0)
    return -(p[0] + share * (p[1] - p[0])) * math.tanh(v / p[4])


LAWS = (
    coulomb_law, direction_law, stribeck_law, drag_law, ripple_law, spring_law,
    position_law,
)  # fmt: skip
N_NUMBERS = 5  # Of p.
# Where in p the speed is below which a law of dry friction fades; what is before it are
# its frictions, and a Stribeck velocity or positions.
FADES_AT = {0: 1, 1: 2, 2: 3, 6: 4}


@numba.njit(cache=True)
def law_number(number, q, v, t, p):
    """The force of LAWS[number], for compiled code that has many laws in a list."""
    if number == 0:
        return coulomb_law(q, v, t, p)
    if number == 1:
        return direction_law(q, v, t, p)
    if number == 2:
        return stribeck_law(q, v, t, p)
    if number == 3:
        return drag_law(q, v, t, p)
    if number == 4:
        return ripple_law(q, v, t, p)
    if number == 6:
        return position_law(q, v, t, p)
    return spring_law(q, v, t, p)


class JointLaws(NamedTuple):
    """Such forces on a mechanism's joints."""

    joint: np.ndarray  # (m,) int: index of the joint's position and velocity.
    kind: np.ndarray  # (m,) int: number in LAWS.
    p: np.ndarray  # (m, N_NUMBERS)


def coulomb_of(laws: JointLaws) -> list[tuple[int, float, float]]:
    """(joint, friction, speed below which it fades) of each Coulomb friction."""
    each = zip(*laws, strict=True)
    return [(int(i), p[0], p[1]) for i, k, p in each if LAWS[int(k)] is coulomb_law]


def most_friction(laws: JointLaws, n: int) -> np.ndarray:
    """(n,) the most that laws of dry friction hold n joints with [N m] or [N]."""
    out = np.zeros(n)
    for i, kind, p in zip(*laws, strict=True):
        if int(kind) in FADES_AT:
            out[i] += np.abs(p[: min(FADES_AT[int(kind)], 2)]).max()
    return out
