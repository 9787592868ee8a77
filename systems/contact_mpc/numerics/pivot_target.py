"""Where a planar cube and two fingers are to be while the cube is tipped over an edge.

The cube of side s has its centre at (x, z) and is turned by theta about y (positive:
towards +x). It turns about its lower right edge, body point (s/2, -s/2), which stays
where it is:

    centre(theta) = edge - R(theta) (s/2, -s/2),   R = [[cos, sin], [-sin, cos]]

The fingers go with two points of the cube: one at its left face, which ends on top, and
one at its top face, which ends on the right. While they are far from these points the
cube is not to turn yet: a finger must first come around it.
"""

import numpy as np

N_X = 14  # q = cube x, z, theta; left finger x, z; right finger x, z. Then v.
CUBE, THETA, LEFT, RIGHT = slice(0, 2), 2, slice(3, 5), slice(5, 7)


def rotation(theta: float) -> np.ndarray:
    """(2, 2) from the cube's axes to the world's, in the x-z plane."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, s], [-s, c]])


def corners(q, side: float) -> np.ndarray:
    """(4, 2) the cube's corners in the world [m]: lower left, lower right, upper right,
    upper left, as it stands at theta = 0. Args: q (7,), or (3,) of the cube."""
    body = 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.asarray(q)[CUBE] + body @ rotation(q[THETA]).T


def fingers_away(q, points) -> float:
    """How far the finger that is farther from its point of the cube is [m].

    Args: q (7,); points (2, 2), of left and right finger in the cube's axes [m].
    """
    wanted = q[CUBE] + points @ rotation(q[THETA]).T
    return float(np.linalg.norm(np.array([q[LEFT], q[RIGHT]]) - wanted, axis=1).max())


def share_of_rate(away: float, near: float, far: float) -> float:
    """1 with the fingers within `near` of their points, 0 beyond `far` [m], linear
    between."""
    return float(np.clip((far - away) / (far - near), 0.0, 1.0))


def pivot_target(q, side, points, goal, rate, dt, N) -> np.ndarray:
    """x_desired (N + 1, 14): from q on, at most at `rate`, towards the angle `goal`.

    The velocities are those that lead to the next knot's positions, zero at the last.

    Args: q (7,) [m, rad]; side [m]; points (2, 2), as of fingers_away; goal [rad]; rate
        >= 0 [rad/s]; dt between knots [s].
    """
    to_go = goal - q[THETA]
    turned = np.minimum(rate * dt * np.arange(N + 1), abs(to_go))
    edge = corners(q, side)[1]
    rows = np.empty((N + 1, N_X // 2))
    for row, theta in zip(rows, q[THETA] + np.sign(to_go) * turned, strict=True):
        R = rotation(theta)
        row[CUBE] = edge - R @ [0.5 * side, -0.5 * side]
        row[THETA] = theta
        row[LEFT], row[RIGHT] = row[CUBE] + points @ R.T
    v = np.vstack([np.diff(rows, axis=0) / dt, np.zeros(N_X // 2)])
    return np.hstack([rows, v])
