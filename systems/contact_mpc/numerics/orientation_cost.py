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
    q_desired = np.asarray(q_desired)[None]
    if free_axis is not None:
        q_desired = _twisted(q, q_desired, free_axis)
    return float(4.0 * _arcs(q, q_desired)[0][0] ** 2)


def orientation_quadratics(q, q_desired, free_axis=None):
    """Q (n, 4, 4) and targets (n, 4) with (x - target)' Q (x - target) equal to the
    squared angle [rad^2] to each of n orientations to second order in x about q, along
    the unit sphere; with a free axis to first order, and to second along every
    direction but mixed ones with that turn.

    Args: q (4,), q_desired (n, 4), of any length but zero; free_axis: as of
        squared_angle.
    """
    if free_axis is not None:
        q_desired = _twisted(q, q_desired, free_axis)
    phi, q, e = _arcs(q, q_desired)
    near = phi < 1e-4
    across = np.where(near, 1.0 - phi**2 / 3.0, phi / np.tan(np.where(near, 1.0, phi)))
    along = e[:, :, None] * e[:, None]
    rest = np.eye(4) - np.outer(q, q) - along
    Q = 4.0 * (along + across[:, None, None] * rest)
    if free_axis is not None:
        t = _products(q[None], np.array([[0.0, *_unit(free_axis)]]))
        P = np.eye(4) - t.T @ t
        Q = P @ Q @ P
    return Q, q - phi[:, None] * e


def _unit(a):
    a = np.asarray(a, dtype=float)
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def _products(a, b):
    """Of quaternions (n, 4), each with each."""
    (w, v), (w_b, v_b) = ((x[:, :1], x[:, 1:]) for x in (a, b))
    return np.hstack([
        w * w_b - (v * v_b).sum(axis=1, keepdims=True),
        w * v_b + w_b * v + np.cross(v, v_b),
    ])  # fmt: skip


def _twisted(q, q_desired, axis):
    """q_desired (n, 4), turned about an axis (3,) of the body to where it is nearest to
    q (4,)."""
    axis, goal = _unit(axis), _unit(q_desired)
    # goal^-1 q: its part about the axis is the turn.
    away = _products(goal * [1.0, -1.0, -1.0, -1.0], _unit(q)[None])
    turn = np.hstack([away[:, :1], (away[:, 1:] @ axis)[:, None] * axis])
    size = np.linalg.norm(turn, axis=1, keepdims=True)
    turn = np.where(size < 1e-12, [1.0, 0.0, 0.0, 0.0], turn / np.maximum(size, 1e-12))
    return _products(goal, turn)


def _arcs(q, q_desired):
    """phi (n,), the unit q (4,), and the unit tangents (n, 4) at q away from q_desired
    (n, 4)."""
    q, goal = _unit(q), _unit(q_desired)
    cosine = goal @ q
    goal = np.where(cosine < 0.0, -1.0, 1.0)[:, None] * goal
    cosine = np.abs(cosine)
    away = cosine[:, None] * q - goal  # Of length sin(phi).
    sine = np.linalg.norm(away, axis=1)
    tangent = np.eye(4)[np.argmin(np.abs(q))]  # At the goal every direction is alike.
    tangent = _unit(tangent - (q @ tangent) * q)
    there = sine == 0.0
    e = np.where(there[:, None], tangent, away / np.where(there, 1.0, sine)[:, None])
    return np.arctan2(sine, cosine), q, e
