"""Forces on one body that depend on its own velocity and on time, compiled.

Each law (V, t, p, F) adds to F (6,), torque on the body about its origin [N m] and
force there [N] in world axes, what its velocity V (6,) in these axes, the time t [s]
and up to eight parameters p give.
"""

import math
from typing import NamedTuple

import numba
import numpy as np


@numba.njit(cache=True)
def constant_law(V, t, p, F):
    """p: force."""
    for i in range(3):
        F[3 + i] += p[i]


@numba.njit(cache=True)
def sinusoidal_law(V, t, p, F):
    """p: amplitude (3), frequency [Hz], phase at time 0."""
    s = math.sin(2.0 * math.pi * p[3] * t + p[4])
    for i in range(3):
        F[3 + i] += p[i] * s


@numba.njit(cache=True)
def drag_law(V, t, p, F):
    """p: linear drag [N s/m], angular drag [N m s/rad]."""
    for i in range(3):
        F[i] -= p[1] * V[i]
        F[3 + i] -= p[0] * V[3 + i]


@numba.njit(cache=True)
def quadratic_drag_law(V, t, p, F):
    """-c |v| v on the origin; p: c [N s2/m2]."""
    speed = math.sqrt(V[3] ** 2 + V[4] ** 2 + V[5] ** 2)
    for i in range(3):
        F[3 + i] -= p[0] * speed * V[3 + i]


LAWS = (constant_law, sinusoidal_law, drag_law, quadratic_drag_law)
N_NUMBERS = 8  # Of p.


@numba.njit(cache=True)
def law_number(number, V, t, p, F):
    """Adds what LAWS[number] gives, for compiled code that has many laws in a list."""
    if number == 0:
        constant_law(V, t, p, F)
    elif number == 1:
        sinusoidal_law(V, t, p, F)
    elif number == 2:
        drag_law(V, t, p, F)
    else:
        quadratic_drag_law(V, t, p, F)


class BodyLaws(NamedTuple):
    """Such forces on links of a tree of joints."""

    link: np.ndarray  # (m,) int: -1 is the world.
    p_L: np.ndarray  # (m, 3) origin of the body in the link's frame.
    kind: np.ndarray  # (m,) int: number in LAWS.
    p: np.ndarray  # (m, N_NUMBERS)


NO_BODY_LAWS = BodyLaws(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int64),
    np.zeros((0, N_NUMBERS)),
)  # fmt: skip
