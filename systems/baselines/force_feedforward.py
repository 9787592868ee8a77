"""Force feedforward for baselines whose control law has no measured force."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.planar.numerics.planar_world import compensated


class ForceFeedforward(LeafSystem):
    """u_total = u - force, within the limit, with the force sampled every period_sec.

    A force that is not finite counts as zero.

    Inputs:  u (2,) [N]; force (2,) measured, of the world on the effector [N].
    Outputs: u_total (2,) [N].

    Args: force_max: limit of |u_total| [N].
    """

    def __init__(self, force_max: float = 100.0, period_sec: float = 0.001):
        super().__init__()
        for name, number in (("force_max", force_max), ("period_sec", period_sec)):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        self._force_max = float(force_max)
        self._u = self.DeclareVectorInputPort("u", 2)
        self._force = self.DeclareVectorInputPort("force", 2)
        self._held = self.DeclareDiscreteState(2)
        self.DeclareVectorOutputPort("u_total", 2, self._calc)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._update)
        first_call(compensated, np.zeros(2), np.zeros(2), self._force_max)

    def _update(self, context: Context, discrete_state):
        discrete_state.set_value(self._held, self._force.Eval(context))

    def _calc(self, context: Context, output: BasicVector):
        force = context.get_discrete_state(self._held).value().copy()
        u = self._u.Eval(context)
        output.SetFromVector(compensated(u, force, self._force_max))
