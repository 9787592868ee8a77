"""A predicted force fed forward along the motion."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class ForceFeedforwardConfig:
    """Settings of ForceFeedforward."""

    filter_sec: float = 0.02  # Of a first-order filter.
    force_max: float = 20.0  # Of what is fed forward [N].
    period_sec: float = 0.001
    offset_sec: float = 0.0


class ForceFeedforward(LeafSystem):
    """Adds to a wrench what cancels the predicted force against the motion,

        F = -(F_predicted . d) d,     filtered, and at most force_max,

    so that the arm's stiffness has only the prediction's error to hold. At rest, and
    while the prediction is not finite, F fades to zero.

    Inputs:  wrench_predicted (6,) on the tool, world axes, force first [N], [N m];
             direction (3,) of the motion, zero at rest; wrench (6,) that is fed forward
             anyway [N], [N m].
    Output:  wrench_feedforward (6,), the sum; state.

    Raises: ValueError for a number that is not positive.
    Source: CC equation 4a, u_ff, with constant stiffness.
    """

    def __init__(self, config: ForceFeedforwardConfig):
        super().__init__()
        check_settings(config)
        for name, value in vars(config).items():
            if not (0.0 < value < np.inf or (name == "offset_sec" and value == 0.0)):
                raise ValueError(f"{name} is {value}, expected > 0")
        self._gain = 1.0 - float(np.exp(-config.period_sec / config.filter_sec))
        self._most = float(config.force_max)
        self._predicted = self.DeclareVectorInputPort("wrench_predicted", 6)
        self._direction = self.DeclareVectorInputPort("direction", 3)
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self._force = self.DeclareDiscreteState(3)
        self._sum = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("wrench_feedforward", self._sum)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context: Context, discrete_state):
        d = self._direction.Eval(context)
        along = -float(self._predicted.Eval(context)[:3] @ d)
        along = np.clip(along, -self._most, self._most) if np.isfinite(along) else 0.0
        force = context.get_discrete_state(self._force).value()
        force = force + self._gain * (along * d - force)
        total = self._wrench.Eval(context)
        total[:3] += force
        discrete_state.set_value(self._force, force)
        discrete_state.set_value(self._sum, total)
