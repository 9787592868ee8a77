"""What the joint sensors say about the tip: where it is, and what force moves it."""

import numba
import numpy as np

from makebreak.systems.numerics.serial_chain import chain_state


@numba.njit(cache=True)
def tip_motion(chain, q, v, torque, tip_mass):
    """The tip of an arm, and the force that explains its motion as a point's.

    An LCS that takes the arm for a point of mass m needs the force that gives *this*
    mass the acceleration that the motors give the tip where nothing touches it:

        u = m (J M^-1 (tau - bias) + Jdot v)

    Newtons at the real tip would not do: its apparent mass is another one, and differs
    with the direction.

    Args:
        chain: SerialChain of the arm with its tool.
        q, v, torque: (n,) [rad], [rad/s], [N m] of the motors.
        tip_mass: m [kg].
    Returns: p_tip (3,) [m], v_tip (3,) [m/s], u (3,) [N].
    """
    state = chain_state(chain, q, v)
    J = state.J[:3]
    a = J @ np.linalg.solve(state.M, torque - state.bias) + state.bias_a[:3]
    return state.p_WE, J @ v, tip_mass * a
