"""What acts on a tool from outside, from what its mount carries."""

import numpy as np


def external_wrench(f_C, t_C, R_WC, p_WC, weight, p_Wcom, p_WE):
    """The wrench on a tool at rest that balances mount and weight, taken at E.

    Args: f_C, t_C (3,): force [N] and torque [N m] of the mount on the tool at the
        mount's frame C, in its axes. R_WC (3, 3), p_WC (3,) that frame. weight (3,) of
        the tool [N] in the world, at p_Wcom (3,). p_WE (3,) the tip [m].
    Returns: (6,) force first, in world axes: 0 = f + f_mount + weight, and the same
        for the moments about E.
    """
    f_mount = R_WC @ f_C
    moment = R_WC @ t_C + _cross(p_WC - p_WE, f_mount) + _cross(p_Wcom - p_WE, weight)
    return np.concatenate([-(f_mount + weight), -moment])


def _cross(a, b):  # np.cross is ten times slower.
    return np.array(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )
