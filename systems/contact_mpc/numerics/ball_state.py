"""The LCS state of "a tip moves a ball on a table", and what a robot can know of it.

    x = [p_tip 3, q_ball wxyz 4, p_ball 3, v_tip 3, omega_ball 3, v_ball 3]   [SI]

All in the world frame. Nobody sees how a plain ball is turned, and no distance depends
on it: q_ball is always the identity in an estimate.
"""

import numpy as np
from numba import njit

N_X = 19
P_TIP, Q_BALL, P_BALL = slice(0, 3), slice(3, 7), slice(7, 10)
V_TIP, W_BALL, V_BALL = slice(10, 13), slice(13, 16), slice(16, 19)


def plus_weights(force, n_lam, n_tip):
    """Weights G (N_X + n_lam + 3 + n_lam,) of C3+ on [x, lam, u, eta]; all but the
    last n_lam are those of a projection without eta.

    Args: force: of lam; n_tip: forces of tip and ball, the first of n_lam.

    lam : eta = 10 : 1 makes the two comparable. The table's contact is left loose, so
    that the first rounds may lift the ball a little to find a push.
    """
    contact = np.full(n_lam, 0.002)
    contact[:n_tip] = 1.0
    free = [np.full(n, 1e-9) for n in (N_X, 3)]
    return np.concatenate([free[0], force * contact, free[1], 0.1 * force * contact])


def rolling_velocity(v_ball, radius):
    """Angular velocity (3,) [rad/s] of a ball of radius [m] that rolls on a level
    table at v_ball [m/s], of which x and y count: v = omega x (radius z), and no spin
    about z. v_ball may be (3, n) or (2, n), the result is (3, n) then.
    """
    return np.array([-v_ball[1], v_ball[0], 0.0 * v_ball[0]]) / radius


def pack(p_tip, v_tip, p_ball, v_ball, radius):
    """The state x (19,) of a tip and a rolling ball, each (3,) [m], [m/s]."""
    p_tip, v_tip = np.asarray(p_tip, dtype=float), np.asarray(v_tip, dtype=float)
    p_ball, v_ball = np.asarray(p_ball, dtype=float), np.asarray(v_ball, dtype=float)
    return compiled_pack(p_tip, v_tip, p_ball, v_ball, float(radius))


@njit(cache=True)
def compiled_pack(p_tip, v_tip, p_ball, v_ball, radius):
    """pack for compiled callers: arrays alone."""
    x = np.zeros(N_X)
    x[P_TIP], x[V_TIP] = p_tip, v_tip
    x[Q_BALL.start] = 1.0
    x[P_BALL], x[V_BALL] = p_ball, v_ball
    # rolling_velocity.
    x[W_BALL.start], x[W_BALL.start + 1] = -v_ball[1] / radius, v_ball[0] / radius
    return x
