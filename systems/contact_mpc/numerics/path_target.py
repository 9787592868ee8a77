"""Rolling a ball along a circle as a task of pushing it: targets, and goals on the way.

Whoever pushes an object to goals (numerics/push_task.py) knows a ball on a circle as
one whose goal moves on: C3's target runs ahead of it, and progress is measured by
points along the circle.
"""

import numpy as np

from makebreak.systems.contact_mpc.numerics.ball_state import V_BALL, V_TIP
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    CirclePath,
    target_over_horizon,
)


def moving_target(
    path: CirclePath, x, lead, speed, z_tip, radius_ball, dt, n_knots
) -> np.ndarray:
    """The target of C3 (n_knots, 19), as target_over_horizon has it, for a tip that
    goes with the ball: at the height z_tip [m], as fast as the ball's target."""
    goal = target_over_horizon(path, x, lead, speed, z_tip, radius_ball, dt, n_knots)
    goal[:, V_TIP] = goal[:, V_BALL]
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
