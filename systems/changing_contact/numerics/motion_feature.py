"""The wrench on a tool, split into what presses and what acts along the motion."""

import numba
import numpy as np


@numba.njit(cache=True)
def motion_wrench(wrench, force_directions):
    """The force in the motion subspace, and the normal forces.

    Args: wrench (6,) on the tool, force first [N], [N m]; force_directions (6,), two
        rows n that the tool presses along, of any length; a zero row: none.
    Returns: (8,) = [F_t 3: the force without its parts along the rows [N]; torque 3
        [N m]; R: sum of the normal forces, each 0 or more [N]; how many rows].

    Two rows that are not at right angles span the plane that is taken out.
    """
    out = np.empty(8)
    for i in range(6):
        out[i] = wrench[i]
    R, rows = 0.0, 0
    n = np.zeros((2, 3))
    for row in range(2):
        length = 0.0
        for i in range(3):
            length += force_directions[3 * row + i] ** 2
        length = np.sqrt(length)
        if not length > 1e-9:
            continue
        along = 0.0
        for i in range(3):
            n[rows, i] = force_directions[3 * row + i] / length
            along -= wrench[i] * n[rows, i]
        R += max(along, 0.0)
        if rows == 1:
            overlap = n[0, 0] * n[1, 0] + n[0, 1] * n[1, 1] + n[0, 2] * n[1, 2]
            left = 0.0
            for i in range(3):
                n[1, i] -= overlap * n[0, i]
                left += n[1, i] ** 2
            if left < 1e-6:  # The same row twice.
                R -= max(along, 0.0)
                continue
            for i in range(3):
                n[1, i] /= np.sqrt(left)
        rows += 1
    for row in range(rows):
        along = out[0] * n[row, 0] + out[1] * n[row, 1] + out[2] * n[row, 2]
        for i in range(3):
            out[i] -= along * n[row, i]
    out[6], out[7] = R, rows
    return out


@numba.njit(cache=True)
def magnitudes(wrench, velocity, force_directions):
    """(5,) = [|v|, |w|, |F_t|, |tau|, R] of CC eq. 2, with F_t and R as motion_wrench.

    |v| is that of the velocity in the motion subspace, too: pressing into a soft
    surface is no sliding. Args: velocity (6,) = [v [m/s], w [rad/s]].
    """
    split = motion_wrench(wrench, force_directions)
    moving = motion_wrench(velocity, force_directions)
    out = np.zeros(5)
    for i in range(3):
        out[0] += moving[i] ** 2
        out[1] += velocity[3 + i] ** 2
        out[2] += split[i] ** 2
        out[3] += split[3 + i] ** 2
    out[:4] = np.sqrt(out[:4])
    out[4] = split[6]
    return out
