"""A pose that is measured now and then, and how fast it changes.

Position and orientation each by a Kalman filter of constant velocity
(numerics/constant_velocity.py), the orientation's error as a turn in the world.
"""

from dataclasses import dataclass, replace

import numpy as np

from makebreak.systems.numerics.constant_velocity import correct, predict


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Of a body at one time, in the world."""

    t: float  # [s]
    p: np.ndarray  # (3,) [m]
    v: np.ndarray  # (3,) [m/s]
    q: np.ndarray  # (4,) quaternion [w x y z]
    w: np.ndarray  # (3,) [rad/s]
    P_p: np.ndarray  # (3,) covariance of p and v, of each axis
    P_q: np.ndarray  # (3,) and of the turn and w

    def __deepcopy__(self, memo) -> "PoseEstimate":
        return self  # Nothing in it is changed once it is there.


def multiplied(a, b):
    """The quaternion (4,) of turning by b, then by a, both about the world's axes."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.r_[w, a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])]


def turned(q, angle):
    """q (4,), then turned by a vector (3,) in the world [rad]; of length one."""
    size = np.linalg.norm(angle)
    half = 0.5 * np.sinc(size / (2.0 * np.pi)) * angle
    q = multiplied(np.r_[np.cos(size / 2.0), half], q)
    return q / np.linalg.norm(q)


def turn_between(a, b):
    """The shortest turn (3,) in the world from a to b (4,) [rad]."""
    d = multiplied(b, a * [1.0, -1.0, -1.0, -1.0])
    d = d if d[0] >= 0.0 else -d
    sine = np.linalg.norm(d[1:])
    return 2.0 * np.arctan2(sine, d[0]) * d[1:] / sine if sine > 0.0 else np.zeros(3)


def first_pose(t, p, q, std, speed_std) -> PoseEstimate:
    """At rest where it was measured. Args: std, speed_std: [m], [rad] and [m/s],
    [rad/s] of position and orientation."""
    P_p, P_q = ([s**2, 0.0, v**2] for s, v in zip(std, speed_std, strict=True))
    return PoseEstimate(
        t, np.array(p), np.zeros(3), np.array(q), np.zeros(3), np.array(P_p),
        np.array(P_q),
    )  # fmt: skip


def predicted(pose: PoseEstimate, t, density) -> PoseEstimate:
    """The pose at t [s]. Args: density (2,): of white acceleration, [m2/s3] and
    [rad2/s3]."""
    dt = t - pose.t
    p, v, P_p = predict(pose.p, pose.v, pose.P_p, dt, density[0])
    turn, w, P_q = predict(np.zeros(3), pose.w, pose.P_q, dt, density[1])
    return PoseEstimate(t, p, v, turned(pose.q, turn), w, P_p, P_q)


def corrected(pose: PoseEstimate, p, q, std) -> PoseEstimate:
    """The pose after p (3,) and q (4,) were measured at its time, with std (2,)."""
    p_new, v, P_p = correct(pose.p, pose.v, pose.P_p, p, std[0])
    turn, w, P_q = correct(
        np.zeros(3), pose.w, pose.P_q, turn_between(pose.q, q), std[1]
    )
    return PoseEstimate(pose.t, p_new, v, turned(pose.q, turn), w, P_p, P_q)


def on_the_table(pose: PoseEstimate, height, rolling_axis=None) -> PoseEstimate:
    """The pose of an object that lies on a level table: at its height, upright, and
    turning about the vertical alone.

    Args: height of its origin [m]; rolling_axis (3,): of one that rolls, the axis in
        its frame, which stays level; it turns about that axis too, and rolls freely
        over the table.
    """
    if rolling_axis is None:
        axis, level = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])
        axis = turned_vector(pose.q, axis)
    else:
        axis = turned_vector(pose.q, np.asarray(rolling_axis, dtype=float))
        level = axis * [1.0, 1.0, 0.0]
        level = level / max(np.linalg.norm(level), 1e-9)
    sine = np.cross(axis, level)
    size = np.linalg.norm(sine)
    tilt = np.arctan2(size, axis @ level) * sine / size if size > 0.0 else np.zeros(3)
    up = np.array([0.0, 0.0, 1.0])
    w = up * pose.w[2]
    if rolling_axis is not None:
        w = w + level * (level @ pose.w)
    return replace(
        pose,
        p=np.array([*pose.p[:2], height]),
        v=pose.v * [1.0, 1.0, 0.0],
        q=turned(pose.q, tilt),
        w=w,
    )


def turned_vector(q, a):
    """a (3,) of the body in the world."""
    return a + 2.0 * np.cross(q[1:], np.cross(q[1:], a) + q[0] * a)
