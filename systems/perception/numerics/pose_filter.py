"""A filter of a pose and its velocity from readings of the pose.

Position and orientation each have a Kalman filter of constant velocity
(constant_velocity.py); the orientation's error is a rotation vector in the world.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from makebreak.systems.perception.numerics.constant_velocity import correct, predict


class PoseEstimate(NamedTuple):
    """Pose and velocity of a body in the world at one time; never changed in place."""

    t: float  # [s]
    p: np.ndarray  # (3,) [m]
    v: np.ndarray  # (3,) [m/s]
    q: np.ndarray  # (4,) quaternion [w x y z]
    w: np.ndarray  # (3,) [rad/s]
    P_p: np.ndarray  # (3,) covariance of p and v, along each axis.
    P_q: np.ndarray  # (3,) covariance of orientation and w, about each axis.


@njit(cache=True)
def turned(q, angle):
    """Unit quaternion of q (4,), then turned by a rotation vector (3,) in the world
    [rad]."""
    size = np.sqrt(angle[0] ** 2 + angle[1] ** 2 + angle[2] ** 2)
    sine = np.sin(size / 2.0) / size if size > 1e-9 else 0.5
    w, x, y, z = np.cos(size / 2.0), sine * angle[0], sine * angle[1], sine * angle[2]
    a, b, c, d = q
    turned_q = np.empty(4)
    turned_q[0] = w * a - x * b - y * c - z * d
    turned_q[1] = w * b + x * a + y * d - z * c
    turned_q[2] = w * c - x * d + y * a + z * b
    turned_q[3] = w * d + x * c - y * b + z * a
    return turned_q / np.sqrt((turned_q**2).sum())


def turn_between(a, b):
    """The shortest rotation vector (3,) in the world from a (4,) to b (4,) [rad]."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    w = bw * aw + bx * ax + by * ay + bz * az
    axis = np.array([
        bx * aw - bw * ax - by * az + bz * ay,
        by * aw - bw * ay - bz * ax + bx * az,
        bz * aw - bw * az - bx * ay + by * ax,
    ])  # fmt: skip
    if w < 0.0:
        w, axis = -w, -axis
    sine = np.sqrt(axis @ axis)
    return 2.0 * np.arctan2(sine, w) * axis / sine if sine > 0.0 else np.zeros(3)


def first_pose(t, p, q, std, speed_std) -> PoseEstimate:
    """An estimate at rest at a measured pose.

    Args: std (2,), speed_std (2,): standard deviations of position and orientation [m],
        [rad], and of their rates [m/s], [rad/s].
    """
    P_p, P_q = ([s**2, 0.0, v**2] for s, v in zip(std, speed_std, strict=True))
    return PoseEstimate(
        t, np.array(p), np.zeros(3), np.array(q), np.zeros(3), np.array(P_p),
        np.array(P_q),
    )  # fmt: skip


def predicted(pose: PoseEstimate, t, density) -> PoseEstimate:
    """The estimate predicted to t [s].

    Args: density (2,): of the white acceleration [m2/s3], [rad2/s3].
    """
    dt = t - pose.t
    p, v, P_p = predict(pose.p, pose.v, pose.P_p, dt, density[0])
    turn, w, P_q = predict(np.zeros(3), pose.w, pose.P_q, dt, density[1])
    return PoseEstimate(t, p, v, turned(pose.q, turn), w, P_p, P_q)


def corrected(pose: PoseEstimate, p, q, std) -> PoseEstimate:
    """The estimate corrected with p (3,) and q (4,), measured at its time with the
    standard deviations std (2,) [m], [rad]."""
    p_new, v, P_p = correct(pose.p, pose.v, pose.P_p, p, std[0])
    turn, w, P_q = correct(
        np.zeros(3), pose.w, pose.P_q, turn_between(pose.q, q), std[1]
    )
    return PoseEstimate(pose.t, p_new, v, turned(pose.q, turn), w, P_p, P_q)


@njit(cache=True)
def on_the_table(dt, p, v, q, w, height, axis):
    """The pose predicted by dt [s] and projected on that of an object on a level table:
    at its height, upright, turning about the vertical only.

    Args: p, v, q, w: as in PoseEstimate; height: of its origin [m]; axis (3,): in the
        object's frame about which it rolls; the axis stays level and the object also
        turns about it. Zero: the object does not roll.
    Returns: p, v, q, w.
    """
    rolls = (axis**2).sum() > 0.0
    q = turned(q, dt * w)
    held, level = np.zeros(3), np.zeros(3)
    if rolls:
        held[:] = axis
    else:
        held[2] = level[2] = 1.0
    cross = np.cross(q[1:], held) * 2.0  # Rotates `held` from the body to the world.
    held = held + q[0] * cross + np.cross(q[1:], cross)
    if rolls:
        level[:2] = held[:2]
        level /= max(np.sqrt((level**2).sum()), 1e-9)
    sine = np.cross(held, level)
    size = np.sqrt((sine**2).sum())
    if size > 0.0:
        q = turned(q, np.arctan2(size, (held * level).sum()) * sine / size)
    p, v = p + dt * v, v.copy()
    p[2], v[2] = height, 0.0
    turning = np.zeros(3)
    turning[2] = w[2]
    if rolls:
        turning += level * (level * w).sum()
    return p, v, q, turning
