"""A button in Meshcat that pushes the robot."""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import LeafSystem

PUSH = "push the tool"
FORCE, LASTS_SEC = 20.0, 0.2  # [N], [s]


class PushButton(LeafSystem):
    """20 N for 0.2 s after each click, each time from the next of four sides.

    Outputs: force (3,) in the world [N].
    State:   number of clicks, and the time of the last one [s].
    """

    def __init__(self, meshcat: Meshcat, period_sec: float = 0.02):
        super().__init__()
        self._meshcat = meshcat
        self._pressed = self.DeclareDiscreteState([0.0, -np.inf])
        meshcat.AddButton(PUSH)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._look)
        self.DeclareVectorOutputPort("force", 3, self._push)

    def _look(self, context, discrete_state):
        seen, _ = context.get_discrete_state(self._pressed).value()
        presses = self._meshcat.GetButtonClicks(PUSH)
        if presses > seen:
            discrete_state.set_value(self._pressed, [presses, context.get_time()])

    def _push(self, context, output):
        presses, since = context.get_discrete_state(self._pressed).value()
        force = np.zeros(3)
        if context.get_time() < since + LASTS_SEC:
            angle = 0.5 * np.pi * presses
            force[:2] = FORCE * np.array([np.cos(angle), np.sin(angle)])
        output.SetFromVector(force)
