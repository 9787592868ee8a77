"""The cost of an orientation: weight times the square of the angle to the desired one.

Of a unit quaternion q, with s = |q' q_desired| and phi = arccos(s), half the angle:

    f(q) = 4 weight phi^2;  on the unit sphere, about q, the gradient is 8 weight phi e,
    the Hessian 8 weight (e e' + phi cot(phi) (I - q q' - e e'))

where e is the unit tangent at q away from q_desired (or from its opposite, which is the
same orientation). The Hessian is positive semi-definite, as phi is at most pi/2: a
quadratic cost with it and with that gradient is convex, and exact to second order. A
weight on the four numbers of a quaternion is neither: it depends on which of the two
signs it has, and on how far the goal is.

Source: the second derivative of the squared distance on a sphere, as in Absil, Mahony,
Sepulchre, "Optimization Algorithms on Matrix Manifolds", section 5.5.
"""

import numpy as np


def squared_angle(q, q_desired) -> float:
    """The square of the angle [rad^2] between the orientations of two quaternions (4,)
    of any length but zero."""
    return 4.0 * _arc(q, q_desired)[0] ** 2


def orientation_quadratic(q, q_desired):
    """Q (4, 4) and target (4,) with (x - target)' Q (x - target) equal to the squared
    angle [rad^2] to second order in x about q, along the unit sphere.

    Args: q, q_desired: (4,) of any length but zero.
    """
    phi, q, e = _arc(q, q_desired)
    across = phi / np.tan(phi) if phi > 1e-4 else 1.0 - phi * phi / 3.0
    along = np.outer(e, e)
    rest = np.eye(4) - np.outer(q, q) - along
    return 4.0 * (along + across * rest), q - phi * e


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
