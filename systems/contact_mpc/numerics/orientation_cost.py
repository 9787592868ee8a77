"""The cost of an orientation: weight times the square of the angle to the desired one.

Of a unit quaternion q, with s = |q' q_desired| and phi = arccos(s), half the angle:

    f(q) = 4 weight phi^2;  on the unit sphere, about q, the gradient is 8 weight phi e,
    the Hessian 8 weight (e e' + phi cot(phi) (I - q q' - e e'))

where e is the unit tangent at q away from q_desired (or from its opposite, which is the
same orientation). The Hessian is positive semi-definite, as phi is at most pi/2: a
quadratic cost with it and with that gradient is convex, and exact to second order. A
weight on the four numbers of a quaternion is neither: it depends on which of the two
signs it has, and on how far the goal is.

About a free axis of the body any turn is allowed, as a cylinder rolls: the angle is
that of the swing which is left, the desired orientation is the nearest one of those
allowed, and the cost does not change along t = q (0, axis). There the Hessian is zero;
that it couples t with the rest, by phi, is left out, so that it stays convex.

Source: the second derivative of the squared distance on a sphere, as in Absil, Mahony,
Sepulchre, "Optimization Algorithms on Matrix Manifolds", section 5.5.
"""

import numpy as np


def squared_angle(q, q_desired, free_axis=None) -> float:
    """The square of the angle [rad^2] between the orientations of two quaternions (4,)
    of any length but zero.

    Args: free_axis: (3,) of the body, a turn about which does not count; None: none.
    """
    if free_axis is not None:
        q_desired = _twisted(q, q_desired, free_axis)
    return 4.0 * _arc(q, q_desired)[0] ** 2


def orientation_quadratic(q, q_desired, free_axis=None):
    """Q (4, 4) and target (4,) with (x - target)' Q (x - target) equal to the squared
    angle [rad^2] to second order in x about q, along the unit sphere; with a free axis
    to first order, and to second along every direction but mixed ones with that turn.

    Args: q, q_desired: (4,) of any length but zero; free_axis: as of squared_angle.
    """
    if free_axis is not None:
        Q, target = orientation_quadratic(q, _twisted(q, q_desired, free_axis))
        t = _product(q / np.linalg.norm(q), np.array([0.0, *_unit(free_axis)]))
        P = np.eye(4) - np.outer(t, t)
        return P @ Q @ P, target
    phi, q, e = _arc(q, q_desired)
    across = phi / np.tan(phi) if phi > 1e-4 else 1.0 - phi * phi / 3.0
    along = np.outer(e, e)
    rest = np.eye(4) - np.outer(q, q) - along
    return 4.0 * (along + across * rest), q - phi * e


def _unit(axis):
    axis = np.asarray(axis, dtype=float)
    return axis / np.linalg.norm(axis)


def _product(a, b):
    """Of two quaternions (4,)."""
    w, v = a[0], a[1:]
    return np.array(
        [w * b[0] - v @ b[1:], *(w * b[1:] + b[0] * v + np.cross(v, b[1:]))]
    )


def _twisted(q, q_desired, axis):
    """q_desired, turned about an axis (3,) of the body to where it is nearest to q."""
    axis = _unit(axis)
    goal = q_desired / np.linalg.norm(q_desired)
    # goal^-1 q: its part about the axis is the turn.
    away = _product(np.array([goal[0], *-goal[1:]]), q / np.linalg.norm(q))
    turn = np.array([away[0], *(away[1:] @ axis * axis)])
    size = np.linalg.norm(turn)
    return goal if size < 1e-12 else _product(goal, turn / size)


def _arc(q, q_desired):
    """phi, the unit q, and the unit tangent at q away from q_desired."""
    q = q / np.linalg.norm(q)
    goal = q_desired / np.linalg.norm(q_desired)
    if q @ goal < 0.0:
        goal = -goal
    away = (q @ goal) * q - goal  # Of length sin(phi).
    sine = np.linalg.norm(away)
    if sine > 0.0:
        return np.arctan2(sine, q @ goal), q, away / sine
    tangent = np.eye(4)[np.argmin(np.abs(q))]  # At the goal every direction is alike.
    tangent = tangent - (q @ tangent) * q
    return 0.0, q, tangent / np.linalg.norm(tangent)
