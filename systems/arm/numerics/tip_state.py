"""Pose and velocity of the tip of a serial arm."""

import numba
import numpy as np

from makebreak.systems.arm.numerics.impedance_controller import quaternion_of
from makebreak.systems.arm.numerics.serial_chain import chain_of, tip_kinematics


@numba.njit(cache=True)
def tip_pose(chain, q):
    """(7,) = [p_WE 3 [m], quaternion wxyz 4 with w >= 0] at joint angles q (n,).

    Args: chain: a packed SerialChain.
    """
    p, R, _ = tip_kinematics(chain_of(chain), q)
    pose = np.empty(7)
    quaternion = quaternion_of(R)
    for k in range(7):
        pose[k] = p[k] if k < 3 else quaternion[k - 3]
    return pose


@numba.njit(cache=True)
def tip_velocity(chain, q, v):
    """(6,) = [v 3 [m/s], w 3 [rad/s]] of the tip in world axes, at q (n,), v (n,).

    Args: chain: a packed SerialChain.
    """
    J = tip_kinematics(chain_of(chain), q)[2]
    velocity = np.zeros(6)
    for k in range(6):
        for i in range(v.shape[0]):
            velocity[k] += J[k, i] * v[i]
    return velocity
