"""Rolling a ball along a circle as a task of pushing it: targets, and goals on the way.

Whoever pushes an object to goals (numerics/push_task.py) knows a ball on a circle as
one whose goal moves on: C3's target runs ahead of it, and progress is measured by
points along the circle.
"""

import numpy as np

from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    CirclePath,
    target_over_horizon,
)

# Along the path a ball is pushed as if it had to be faster by this share of its speed:
# where nothing else is wanted of it, the tip belongs behind it.
FORWARD = 0.5


def push_direction(path: CirclePath, x, speed: float) -> np.ndarray:
    """(2,) unit vector: where the ball is to be accelerated to, for the velocity with
    which it comes to the path and along it at a speed [m/s]."""
    wanted = speed * path.heading(x[P_BALL])
    change = (1.0 + FORWARD) * wanted - x[V_BALL][:2]
    return change / max(float(np.hypot(*change)), 1e-9)


def moving_target(
    path: CirclePath, x, lead, speed, z_tip, away, radius_ball, dt, n_knots
) -> np.ndarray:
    """The target of C3 (n_knots, 19): of the ball that of target_over_horizon; of the
    tip, to go along with the ball as it is, on the side from which it is to be pushed.

    Args: as of target_over_horizon; z_tip: height of the tip's centre, away: its
        distance from the ball's, seen from above [m].
    """
    goal = target_over_horizon(path, x, lead, speed, z_tip, radius_ball, dt, n_knots)
    side = x[P_BALL][:2] - away * push_direction(path, x, speed)
    ahead = dt * np.arange(n_knots)[:, None]
    goal[:, P_TIP.start : P_TIP.start + 2] = side + ahead * x[V_BALL][:2]
    goal[:, V_TIP] = x[V_BALL]
    return goal


def next_waypoint(angle, lead, step, last=None) -> float:
    """The angle on the circle of the next goal on the way [rad].

    Args: angle of the ball, lead: a goal is at least so far ahead of it, step between
        goals [rad]; last: the goal until now, None: none.
    Returns: a multiple of step in [0, 2 pi): the first one lead ahead. Goals do not go
        back with a ball that rolls back, unless by more than a quarter of the circle:
        then it was put elsewhere.
    """
    turn = 2.0 * np.pi
    first = (np.floor((angle + lead) / step) + 1.0) * step % turn
    if last is None:
        return float(first)
    back = (last - first) % turn
    return float(last if back < 0.25 * turn else first)
