"""A point effector in the plane, in a fluid whose viscosity rises, pulled by springs.

    m dv/dt = u + F,    F = -c(t) v + sum_i k_i (|d_i| - l_i) d_i / |d_i|,
    d_i = anchor_i - p,    c(t) = c_0 + (c_1 - c_0) min(t / T, 1)

A spring pulls only where |d_i| < r_i, its reach: the force jumps as it engages and
lets go.

u is held over each period. A period is integrated by four Runge-Kutta steps of fourth
order; tests/test_planar_world.py compares the result with closed forms, scipy and
Drake's springs.

Source: "Changing-contact manipulation" (CC) sections 4.1 and 4.2, Fig. 1c: "porridge
stirring" and "multi-spring". The paper draws its worlds without numbers.
"""

import numpy as np
from numba import njit

SUBSTEPS = 4
_NEAR = 1e-9  # A shorter spring has no direction [m].


@njit(cache=True)
def viscosity_at(t, viscosity, ramp):
    """c(t) [N s/m]: from viscosity[0] at t = 0 to viscosity[1] at t = ramp [s]."""
    s = min(max(t / ramp, 0.0), 1.0)
    return viscosity[0] + (viscosity[1] - viscosity[0]) * s


@njit(cache=True)
def _force(x, y, vx, vy, t, viscosity, ramp, anchors, springs):
    """external_force in scalars: arrays would take most of the time."""
    c = viscosity_at(t, viscosity, ramp)
    fx, fy = -c * vx, -c * vy
    for i in range(anchors.shape[0]):
        dx, dy = anchors[i, 0] - x, anchors[i, 1] - y
        length = np.sqrt(dx * dx + dy * dy)
        if _NEAR < length < springs[i, 2]:
            pull = springs[i, 0] * (length - springs[i, 1]) / length
            fx += pull * dx
            fy += pull * dy
    return fx, fy


@njit(cache=True)
def external_force(state, t, viscosity, ramp, anchors, springs):
    """The force of the world on the effector.

    Args:
        state: (4,) p, v [m], [m/s].
        t: time [s].
        viscosity: (2,) initial and final [N s/m]; ramp [s].
        anchors: (n, 2) [m].
        springs: (n, 3) stiffness [N/m], rest length [m] and reach [m] of each.
    Returns: F (2,) [N].
    """
    x, y, vx, vy = state
    fx, fy = _force(x, y, vx, vy, t, viscosity, ramp, anchors, springs)
    return np.array([fx, fy])


@njit(cache=True)
def step(state, t, u, period, mass, viscosity, ramp, anchors, springs):
    """The state (4,) one period after t, with u (2,) [N] held; mass [kg]."""
    h = period / SUBSTEPS
    x, y, vx, vy = state
    for i in range(SUBSTEPS):
        # The classical Runge-Kutta rule: slopes at the start, twice in the middle and
        # at the end; dx, dy, dvx, dvy are their weighted sums.
        s = t + i * h
        px, py, wx, wy = x, y, vx, vy
        dx, dy, dvx, dvy = 0.0, 0.0, 0.0, 0.0
        for stage in range(4):
            later = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            weight = 1.0 / 6.0 if stage == 0 or stage == 3 else 1.0 / 3.0
            fx, fy = _force(
                px, py, wx, wy, s + later * h, viscosity, ramp, anchors, springs
            )
            ax, ay = (u[0] + fx) / mass, (u[1] + fy) / mass
            dx, dy = dx + weight * wx, dy + weight * wy
            dvx, dvy = dvx + weight * ax, dvy + weight * ay
            ahead = h if stage == 2 else 0.5 * h
            px, py = x + ahead * wx, y + ahead * wy
            wx, wy = vx + ahead * ax, vy + ahead * ay
        x, y, vx, vy = x + h * dx, y + h * dy, vx + h * dvx, vy + h * dvy
    return np.array([x, y, vx, vy])


@njit(cache=True)
def circle_target(t, radius, duration, phase, turn):
    """Once around a circle about the origin, from rest to rest.

    The angle is the minimum-jerk polynomial, so the speed peaks at 1.875 times its
    mean.

    Args: t [s]; radius [m]; duration [s]; phase: angle of the start [rad]; turn: +1
        counter-clockwise, -1 clockwise.
    Returns: (6,) p, v, a [m], [m/s], [m/s2]; at rest before 0 and after duration.
    """
    s = min(max(t / duration, 0.0), 1.0)
    sweep = turn * 2.0 * np.pi
    angle = phase + sweep * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    rate = sweep * 30.0 * s * s * (1.0 - s) ** 2 / duration
    change = sweep * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration**2
    c, n = np.cos(angle), np.sin(angle)
    out = np.empty(6)
    out[0], out[1] = radius * c, radius * n
    out[2], out[3] = -radius * rate * n, radius * rate * c
    out[4] = -radius * (rate * rate * c + change * n)
    out[5] = -radius * (rate * rate * n - change * c)
    return out


@njit(cache=True)
def limited(u, force_max):
    """u (2,) [N] scaled down to at most force_max [N] in norm."""
    size = np.sqrt(u[0] * u[0] + u[1] * u[1])
    if size > force_max:
        return u * (force_max / size)
    return u


@njit(cache=True)
def compensated(u, force, force_max):
    """u - force (2,) [N], at most force_max in norm; u where force is not finite."""
    out = np.empty(2)
    known = np.isfinite(force[0]) and np.isfinite(force[1])
    for i in range(2):
        out[i] = u[i] - force[i] if known else u[i]
    return limited(out, force_max)
