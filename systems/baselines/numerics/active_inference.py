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
of the plant. In the source the goal is a point, x_d, and its velocity has no place in
the law. Where the model knows how the goal moves, it is mu' = x_d + v_d - mu, and
e_m' = mu'' + mu' - v_d - a_d: the belief follows without a lag, the most that it can be
given.

The beliefs start at what is measured first, u at zero; u stays within the limit.

Source: Pezzato, Ferrari, Hernandez Corbato, "A novel adaptive controller for robot
manipulators based on active inference", RA-L 5(2), 2020 (arXiv:1909.12768), the free
energy of section III and the updates of section IV.
"""

import numpy as np
from numba import njit

from makebreak.systems.planar.numerics.planar_world import limited

MEMORY = 9  # mu (2), mu' (2), mu'' (2), u (2), 1 once started.


@njit(cache=True)
def tick(
    memory, state, target, moves, precision, k_belief, k_action, period, force_max
):
    """One period, integrated by Euler's rule as in the source.

    Args:
        memory: (9,); zeros at first.
        state: (4,) p, v [m], [m/s]; target: (6,) p, v, a [m], [m/s], [m/s2].
        moves: whether the model knows how the goal moves; else it is the point p.
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
        goal, rate = target[i], 0.0
        if moves:
            goal, rate = goal + target[2 + i], target[2 + i] + target[4 + i]
        g = precision[2] * (first + mu - goal)
        g1 = precision[3] * (second + first - rate)
        m[i] += period * (first + k_belief * (y - g))
        m[2 + i] += period * (second + k_belief * (y1 - g - g1))
        m[4 + i] -= period * k_belief * g1
        u[i] = m[6 + i] - period * k_action * (y + y1)
    limit = u[0] * u[0] + u[1] * u[1] > force_max * force_max
    m[6:8] = limited(u, force_max)
    return m[6:8].copy(), m, limit
