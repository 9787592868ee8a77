"""Model reference adaptive control of position, by hyperstability.

    reference:  x_m'' + 2 zeta w x_m' + w^2 x_m = w^2 r,   e = x_m - x
    q  = p2 e + p3 e',   p2 = 1 / (2 w^2),  p3 = l / (4 zeta w) + 1 / (4 zeta w^3)
    f  = a1 q + a2 int q dt
    K0 = E1 q x' + E2 int q x' dt,     K1 the same with x'   (gains of x and of dx/dt)
    Q0 = F1 q x_m' + F2 int q x_m' dt, Q1 the same with dx_m/dt
    u  = f + K0 x + K1 dx/dt + Q0 x_m + Q1 dx_m/dt

(p2, p3) is the last row of the P that solves A'P + P A = -diag(1, l) for the reference
model's A. Here F1 = E1 and F2 = E2, of a pair for x and x_m and a pair for their
velocities. Nothing is known of the plant.

The command r is the one whose response is the target, r = x_d + 2 zeta/w v_d + a_d/w^2,
so that x_m is the target: the most that MRAC can be given. Driven by the target itself,
r = x_d, the reference model lags behind it; that is the second way (`lag`).

All integrals are in time. (A well-known public implementation sums without the time
step and feeds K1 from K0's integral.) They are held while the force is at its limit.

Source: Tarokh, "Hyperstability approach to the synthesis of adaptive controllers for
robot manipulators" (ICRA 1991), in the form in which Pezzato, Ferrari, Hernandez
Corbato compare with it (RA-L 5(2), 2020, arXiv:1909.12768).
"""

import numpy as np
from numba import njit

from makebreak.systems.planar.numerics.planar_world import limited

# int q (2), int q z' (4 each) for z = x, v, x_m, v_m; x_m, v_m (4); 1 once started.
MEMORY = 23


def error_weights(omega, zeta, rate_weight=1.0):
    """p2, p3 of a reference model omega [1/s], zeta; rate_weight is l [s2]."""
    p2 = 1.0 / (2.0 * omega**2)
    return p2, (rate_weight + 1.0 / omega**2) / (4.0 * zeta * omega)


@njit(cache=True)
def tick(memory, state, target, omega, zeta, p2, p3, gains, lag, period, force_max):
    """One period.

    Args:
        memory: (23,); zeros at first.
        state: (4,) p, v; target: (6,) p, v, a.
        omega [1/s], zeta: the reference model; p2, p3 as error_weights.
        gains: (6,) a1, a2, E1 and E2 of the positions, E1 and E2 of the velocities.
        lag: whether r is the target itself.
        period [s]; force_max [N].
    Returns: u (2,) [N], the new memory, whether the force is at its limit.
    """
    m = memory.copy()
    if m[22] == 0.0:
        m[18:22] = target[:4]
        m[22] = 1.0
    if not lag:
        m[18:22] = target[:4]
    z = np.empty((4, 2))
    z[0], z[1] = state[:2], state[2:]
    z[2], z[3] = m[18:20], m[20:22]
    q = p2 * (z[2] - z[0]) + p3 * (z[3] - z[1])
    u = gains[0] * q + gains[1] * m[:2]
    for j in range(4):
        now, summed = (gains[2], gains[3]) if j % 2 == 0 else (gains[4], gains[5])
        for i in range(2):
            for k in range(2):
                gain = now * q[i] * z[j, k] + summed * m[2 + 4 * j + 2 * i + k]
                u[i] += gain * z[j, k]
    limit = u[0] * u[0] + u[1] * u[1] > force_max * force_max
    if not limit:
        for i in range(2):
            m[i] += period * q[i]
            for j in range(4):
                for k in range(2):
                    m[2 + 4 * j + 2 * i + k] += period * q[i] * z[j, k]
    if lag:
        for i in range(2):
            pull = omega**2 * (target[i] - m[18 + i])
            m[20 + i] += period * (pull - 2.0 * zeta * omega * m[20 + i])
            m[18 + i] += period * m[20 + i]
    return limited(u, force_max), m, limit
