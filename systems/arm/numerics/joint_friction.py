"""The torque against the known friction, drag, springs and ripple in an arm's joints.

    tau = damping v_d - sum law(q, v_d)

with v_d the joints' velocity in the reference, not the measured one. Fed back, friction
that the model has and the joint has not would be negative damping: a model with half as
much again as a Panda's wrist shook the arm. Fed forward it is zero where the reference
rests, so that it neither chatters nor drives anything at rest, whatever the model says;
a reference that moves starts a joint that sticks, and a joint that departs from it is
damped by its own friction.

Source: Armstrong-Helouvry, Dupont and Canudas de Wit, "A survey of models, analysis
tools and compensation methods for the control of machines with friction" (1994),
section 4, on compensation by the reference's velocity.
"""

import numba
import numpy as np

from makebreak.systems.numerics.joint_laws import N_NUMBERS, JointLaws, law_number

# A law without force: no array of a packed law may be empty.
NO_LAWS = JointLaws(
    np.zeros(1, np.int64), np.zeros(1, np.int64), np.eye(1, N_NUMBERS, 1)
)


@numba.njit(cache=True)
def joint_torque(laws, damping, q, v_d):
    """The torque (n,) that takes off the joints' forces [N m].

    Args: laws: JointLaws; damping (n,): viscous, of the joints [N m s/rad]; q (n,):
        measured [rad]; v_d (n,): of the reference [rad/s].
    """
    out = damping * v_d
    for k in range(laws.kind.size):
        i = laws.joint[k]
        out[i] -= law_number(laws.kind[k], q[i], v_d[i], 0.0, laws.p[k])
    return out
