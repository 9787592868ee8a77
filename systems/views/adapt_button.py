"""A button in Meshcat that turns the use of a learned residual off and on."""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import LeafSystem

ADAPT = "adapt: off, on"


class AdaptButton(LeafSystem):
    """Outputs the residual, or zeros after an odd number of clicks. The learner itself
    continues to learn.

    Inputs:  r_comp (n,): of the learner [m/s].
    Outputs: r_comp (n,): for the controllers [m/s].
    State:   1 while the residual is used.
    """

    def __init__(self, n_lam: int, meshcat: Meshcat, period_sec: float = 0.05):
        super().__init__()
        self._meshcat = meshcat
        self._r_comp = self.DeclareVectorInputPort("r_comp", n_lam)
        passed = self.DeclareDiscreteState([1.0])
        self._passed = passed
        meshcat.AddButton(ADAPT)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._look)
        self.DeclareVectorOutputPort("r_comp", n_lam, self._pass_on)

    def _look(self, _, discrete_state):
        off = self._meshcat.GetButtonClicks(ADAPT) % 2
        discrete_state.set_value([0.0 if off else 1.0])

    def _pass_on(self, context, output):
        if context.get_discrete_state(self._passed)[0] > 0.0:
            output.SetFromVector(self._r_comp.Eval(context))
        else:
            output.SetZero()
