"""Active inference control: beliefs descend the free energy, and so does the force.

    e_y  = x - mu,              e_y' = dx/dt - mu'
    e_m  = mu' + mu - x_d,      e_m' = mu'' + mu'
    dmu/dt   = mu'  + k_mu (P_y e_y - P_m e_m)
    dmu'/dt  = mu'' + k_mu (P_y' e_y' - P_m e_m - P_m' e_m')
    dmu''/dt = -k_mu P_m' e_m'
    du/dt    = -k_a (P_y e_y + P_y' e_y')

P are precisions, one over the variances. The generative model says that the state goes
to the goal as mu' = x_d - mu: with a time constant of 1 s. So, with k_mu large, a
steadily moving goal is followed about 1 s late. du/dx is taken as 1: nothing is known
of the plant. The goal is a point, x_d; its velocity has no place in the law.

The beliefs start at what is measured first, u at zero; u stays within the limit.

Source: Pezzato, Ferrari, Hernandez Corbato, "A novel adaptive controller for robot
manipulators based on active inference", RA-L 5(2), 2020 (arXiv:1909.12768), the free
energy of section III and the updates of section IV.
"""

import numpy as np
from numba import njit

from makebreak.systems.numerics.planar_world import limited

MEMORY = 9  # mu (2), mu' (2), mu'' (2), u (2), 1 once started.


@njit(cache=True)
def tick(memory, state, goal, precision, k_belief, k_action, period, force_max):
    """One period, integrated by Euler's rule as in the source.

    Args:
        memory: (9,); zeros at first.
        state: (4,) p, v [m], [m/s]; goal: (2,) x_d [m].
        precision: (4,) P_y, P_y', P_m, P_m'.
        k_belief: k_mu [1/s]; k_action: k_a [N/(m s)].
        period [s]; force_max [N].
    Returns: u (2,) [N], the new memory, whether the force is at its limit.
    """
    m = memory.copy()
    if m[8] == 0.0:
        m[:4] = state
        m[8] = 1.0
    u = np.empty(2)
    for i in range(2):
        mu, first, second = m[i], m[2 + i], m[4 + i]
        y, y1 = precision[0] * (state[i] - mu), precision[1] * (state[2 + i] - first)
        g, g1 = precision[2] * (first + mu - goal[i]), precision[3] * (second + first)
        m[i] += period * (first + k_belief * (y - g))
        m[2 + i] += period * (second + k_belief * (y1 - g - g1))
        m[4 + i] -= period * k_belief * g1
        u[i] = m[6 + i] - period * k_action * (y + y1)
    limit = u[0] * u[0] + u[1] * u[1] > force_max * force_max
    m[6:8] = limited(u, force_max)
    return m[6:8].copy(), m, limit
