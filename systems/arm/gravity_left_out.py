"""Torques for a robot whose driver compensates gravity."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.serial_chain import SerialChain, chain_state


def gravity_torque(chain: SerialChain, q) -> np.ndarray:
    """Torques (n,) [N m] that hold the arm at rest against gravity.

    Args: chain: of the arm with its tool; q (n,) [rad].
    """
    return chain_state(chain, q, np.zeros(len(q))).bias


class GravityLeftOut(LeafSystem):
    """torque = tau - g(q): the command for a robot whose driver adds g(q) itself.

    Inputs:  tau (n,) [N m]; q (n,): measured [rad].
    Outputs: torque (n,) [N m]; zero until q is finite for the first time.
    State:   the last finite q (n,).
    """

    def __init__(self, chain: SerialChain):
        super().__init__()
        n = len(chain.mass)
        self._chain = chain
        self._tau = self.DeclareVectorInputPort("tau", n)
        self._q = self.DeclareVectorInputPort("q", n)
        self._last = self.DeclareDiscreteState(np.full(n, np.nan))
        self.DeclarePerStepDiscreteUpdateEvent(self._keep)
        self.DeclareVectorOutputPort("torque", n, self._calc)

    def _keep(self, context: Context, discrete_state):
        discrete_state.set_value(self._now(context))

    def _now(self, context: Context) -> np.ndarray:
        q = np.array(self._q.Eval(context))
        return (
            q if np.isfinite(q).all() else context.get_discrete_state_vector().value()
        )

    def _calc(self, context: Context, output: BasicVector):
        # While a sensor fails, the controller continues with the last good q; so must
        # the gravity torque that is subtracted here.
        q = self._now(context)
        torque = np.zeros(len(q))
        if np.isfinite(q).all():
            torque = self._tau.Eval(context) - gravity_torque(self._chain, q)
        output.SetFromVector(torque)
