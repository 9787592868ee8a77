"""The external wrench on a tool, from the reaction in its mount."""

import numba
import numpy as np

from makebreak.systems.arm.numerics.serial_chain import chain_of, tip_kinematics


@numba.njit(cache=True)
def external_wrench(f_C, t_C, q, chain, R_CE, weight, p_CM, p_CE):
    """The wrench on a tool at rest that balances mount and weight, taken at the tip E.

    Args: f_C, t_C (3,): force [N] and torque [N m] of the mount on the tool at the
        mount's frame C, in its axes; q (n,) of the arm; chain: a packed SerialChain, up
        to E; R_CE (3, 3), p_CE (3,): E in C [m]; weight (3,): of the tool in the world
        [N], at its centre of mass p_CM (3,) in C [m].
    Returns: (6,) force first, in world axes: 0 = f + f_mount + weight, and the same
        for the moments about E.
    """
    R_WC = tip_kinematics(chain_of(chain), q)[1] @ R_CE.T
    f_mount = R_WC @ f_C
    moment = R_WC @ t_C
    moment += np.cross(R_WC @ -p_CE, f_mount)
    moment += np.cross(R_WC @ (p_CM - p_CE), weight)
    out = np.empty(6)
    out[:3] = -f_mount - weight
    out[3:] = -moment
    return out
