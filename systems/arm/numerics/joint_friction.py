"""The torque against the known forces in an arm's joints: friction, springs, ripple.

A force that is a function of position, or of the velocity as it is measured, is taken
off by its law. Dry friction c sign(v) is not: near rest the sign is noise, and a torque
that follows it chatters. Its compensation is

    tau = c tanh((v + v_d) / (2 V)),   V the speed below which the law fades,

with v_d the joints' velocity in the reference, which starts a joint that sticks; it is
exact where v = v_d.

* At rest it is zero: the reference rests as well, or else it is that which works.
* It never drives: |tau| <= c, so that tau v <= c |v|, what friction takes out. Friction
  and compensation together take energy out, whatever v_d and the noise of v are.
* It does not chatter: with the reference at rest its slope is half of that of the law,
  so that both together are a damping.

Of Stribeck friction only the Coulomb part is compensated, as more than the friction at
a speed would drive the joint.

Source: Armstrong-Helouvry, Dupont and Canudas de Wit, "A survey of models, analysis
tools and compensation methods for the control of machines with friction" (1994),
section 4, on compensation by the reference's velocity.
"""

import numba
import numpy as np

from makebreak.systems.numerics.joint_laws import (
    LAWS,
    JointLaws,
    law_number,
    stribeck_law,
)

STRIBECK = LAWS.index(stribeck_law)
N_DRY = 1 + STRIBECK  # Laws of dry friction, the first ones of LAWS.


def to_compensate(laws: JointLaws) -> JointLaws:
    """The laws whose force is taken off, without Stribeck's peak.

    Where there is none, one without force, as no array of a packed law is empty.
    """
    joint, kind, p = (np.array(each) for each in laws)
    for k in range(len(kind)):
        if kind[k] == STRIBECK:
            p[k, :2] = min(p[k, :2])
    if not len(kind):
        none = np.zeros(1, dtype=np.int64)
        return JointLaws(none, none.copy(), np.array([[0.0, 1.0, 0.0, 0.0]]))
    return JointLaws(joint.astype(np.int64), kind.astype(np.int64), p)


@numba.njit(cache=True)
def joint_torque(laws, q, v, v_d):
    """The torque (n,) that takes off the joints' forces [N m].

    Args: laws: of to_compensate; q, v (n,): measured [rad], [rad/s]; v_d (n,): of the
        reference [rad/s].
    """
    out = np.zeros(q.size)
    for k in range(laws.kind.size):
        i, kind = laws.joint[k], laws.kind[k]
        speed = 0.5 * (v[i] + v_d[i]) if kind < N_DRY else v[i]
        out[i] -= law_number(kind, q[i], speed, 0.0, laws.p[k])
    return out
