"""From one speed to another, smooth in all orders (C-infinity), and the way it covers.

    v(tau) = v1 + (v2 - v1) S(tau),    tau = t / T
    S(tau) = e^(-1/tau) / (e^(-1/tau) + e^(-1/(1 - tau))),  0 below 0 and 1 above 1

S rises monotonely, and S(1 - tau) = 1 - S(tau), so its mean over [0, 1] is 1/2; its
slope is at most 2 (at 1/2) and its curvature at most 9.84 (at 0.22 and 0.78). A change
of speed with acceleration at most a_max therefore takes T = 2 |v2 - v1| / a_max and
covers (v1 + v2) / 2 T.

All of it is written with S = 1 / (1 + e^z), z = 1/tau - 1/(1 - tau), which neither
overflows nor divides by zero.

Source: Sidhik, Sridharan, Ruiken, "An adaptive framework for trajectory following in
changing-contact robot manipulation tasks", section 3.5.2, equation 11.
"""

import numba
import numpy as np

SLOPE_MAX = 2.0
# Where |z| is larger, S, 1 - S and every derivative are below 1e-260.
_Z_MAX = 600.0
# The integral of S is tabulated at multiples of 1/128 up to 1/2.
_CELLS = 64
_NODES, _WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(12))
_NODES = _NODES + 0.5  # On [0, 1].


@numba.njit(cache=True)
def unit_step(tau):
    """S and its first and second derivative by tau; exact outside (0, 1)."""
    if not tau > 0.0:
        return 0.0, 0.0, 0.0
    if tau >= 1.0:
        return 1.0, 0.0, 0.0
    rest = 1.0 - tau
    z = 1.0 / tau - 1.0 / rest
    if z > _Z_MAX:
        return 0.0, 0.0, 0.0
    if z < -_Z_MAX:
        return 1.0, 0.0, 0.0
    small = np.exp(-abs(z))
    S = small / (1.0 + small) if z > 0.0 else 1.0 / (1.0 + small)
    bell = small / (1.0 + small) ** 2  # S (1 - S), without cancellation.
    z1 = -1.0 / (tau * tau) - 1.0 / (rest * rest)
    z2 = 2.0 / (tau * tau * tau) - 2.0 / (rest * rest * rest)
    return S, -bell * z1, bell * ((1.0 - 2.0 * S) * z1 * z1 - z2)


def _table() -> np.ndarray:
    """The integral of S from 0 to each multiple of 1/128 up to 1/2."""
    width = 0.5 / _CELLS
    values = np.zeros(_CELLS + 1)
    for i in range(_CELLS):
        parts = [unit_step((i + x) * width)[0] for x in _NODES]
        values[i + 1] = values[i] + width * (_WEIGHTS @ np.array(parts))
    return values


_TABLE = _table()


@numba.njit(cache=True)
def unit_step_integral(tau):
    """Integral of S from 0 to tau, within 1e-15; tau - 1/2 from 1 on."""
    if not tau > 0.0:
        return 0.0
    if tau >= 1.0:
        return tau - 0.5
    if tau > 0.5:
        return tau - 0.5 + unit_step_integral(1.0 - tau)
    width = 0.5 / _CELLS
    cell = min(int(tau / width), _CELLS - 1)
    start = cell * width
    total = 0.0
    for i in range(_NODES.shape[0]):
        total += _WEIGHTS[i] * unit_step(start + _NODES[i] * (tau - start))[0]
    return _TABLE[cell] + total * (tau - start)


def transition_time(v1: float, v2: float, acceleration_max: float) -> float:
    """How long a change of speed takes [s]; speeds [m/s], acceleration [m/s2]."""
    return SLOPE_MAX * abs(v2 - v1) / acceleration_max


def speed_transition(v1: float, v2: float, T: float, t: float):
    """Equation 11 at time t after its start.

    Args: v1, v2: speed before and after [m/s]; T: how long it takes [s]; t [s].
    Returns: distance since the start [m], speed [m/s], acceleration [m/s2], jerk
        [m/s3].
    Raises: ValueError if a number is not finite or T is not positive.
    """
    if not (np.all(np.isfinite([v1, v2, t])) and 0.0 < T < np.inf):
        raise ValueError(
            f"speed transition from {v1} to {v2} in T = {T} at t = {t}, expected "
            "finite numbers and T > 0"
        )
    S, slope, bend = unit_step(t / T)
    dv = v2 - v1
    distance = v1 * t + dv * T * unit_step_integral(t / T)
    return distance, v1 + dv * S, dv / T * slope, dv / T**2 * bend
