"""The contact force on a serial arm, from the joint torques that it causes."""

import numba
import numpy as np

from makebreak.systems.arm.numerics.serial_chain import chain_of, tip_kinematics


@numba.njit(cache=True)
def contact_forces(chain, q, torque, offset):
    """The force on the tool that causes a contact's joint torques, tau = J' f.

    Args:
        chain: SerialChain of the arm with its tool.
        q: (n_t, n) joint angles [rad], a row per instant.
        torque: (n_t, n) generalized force of the contact on the joints [N m].
        offset: (n_t, 3) from the tip to the contact point, world axes [m].
    Returns: (n_t, 3) [N], world axes; zero where torque is.
    """
    force = np.zeros((len(q), 3))
    for k in range(len(q)):
        if not np.any(torque[k]):
            continue
        J_6 = tip_kinematics(chain, q[k])[2]
        J = J_6[:3].copy()
        for i in range(J.shape[1]):
            J[:, i] += np.cross(J_6[3:, i], offset[k])
        force[k] = np.linalg.solve(J @ J.T, J @ torque[k])
    return force


@numba.njit(cache=True)
def tip_wrench(chain, q, torque):
    """The wrench at the tip that causes a contact's joint torques, tau = J' w.

    Args: chain: of the arm with its tool, packed; q (n,) [rad]; torque (n,) [N m].
    Returns: (6,) on the tool, in world axes, force first [N], [N m]; zero if torque is.
    """
    if not np.any(torque):
        return np.zeros(6)
    J = tip_kinematics(chain_of(chain), q)[2]
    return np.linalg.solve(J @ J.T, J @ torque)
