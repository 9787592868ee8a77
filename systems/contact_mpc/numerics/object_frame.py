"""The frame of an object on the table, seen from above: it turns with the object."""

import numpy as np

from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL, Q_BALL


def rotation_of(q):
    """(3, 3) of a quaternion [w x y z] of any length but zero."""
    w, x, y, z = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def heading_of(q):
    """(2, 2) how an object of quaternion q (4,) is turned, seen from above."""
    R = rotation_of(q)
    heading = np.array([R[:2, 0], [-R[1, 0], R[0, 0]]]).T
    return heading / np.linalg.norm(heading[:, 0])


def to_world(x, place):
    """A place (2,) of the object's frame, seen from above, in the world."""
    return heading_of(x[Q_BALL]) @ place + x[P_BALL][:2]


def to_object(x, place):
    """The inverse of to_world."""
    return heading_of(x[Q_BALL]).T @ (place - x[P_BALL][:2])


def turned_inputs(inputs, heading):
    """Inputs (N, 3) with x and y turned by heading (2, 2)."""
    return np.column_stack([inputs[:, :2] @ heading.T, inputs[:, 2:]])
