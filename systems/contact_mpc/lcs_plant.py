"""An LCS as the simulated plant: a controller's LCS is then exact (for tests)."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.lcs import LCS, simulate
from makebreak.systems.numerics.timing import timed


@dataclass
class LcsPlantConfig:
    """Settings of LcsPlant."""

    period_sec: float | None = None  # None: the LCS's own time step [s].
    offset_sec: float = 0.0  # Of the first step [s].


class LcsPlant(LeafSystem):
    """Steps an LCS as the plant.

    Inputs:  u (n_u,), held over each step.
    Outputs: x (n_x,) state; lam (n_lam,) contact force of the last step [N].

    Args: lcs; x_initial (n_x,): default state, None: zero; config.
    Raises: ValueError; a step raises it where no contact force satisfies the LCS.
    """

    def __init__(self, lcs: LCS, x_initial=None, config: LcsPlantConfig | None = None):
        super().__init__()
        config = config or LcsPlantConfig()
        x_initial = np.zeros(lcs.n_x) if x_initial is None else np.array(x_initial)
        if x_initial.shape != (lcs.n_x,):
            raise ValueError(f"x_initial is {x_initial.shape}, expected ({lcs.n_x},)")
        self._lcs = lcs
        self._u = self.DeclareVectorInputPort("u", lcs.n_u)
        self._x = self.DeclareDiscreteState(x_initial)
        self._lam = self.DeclareDiscreteState(lcs.n_lam)
        self.DeclareStateOutputPort("x", self._x)
        self.DeclareStateOutputPort("lam", self._lam)
        period_sec = lcs.dt if config.period_sec is None else config.period_sec
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, discrete_state):
        x = context.get_discrete_state(self._x).value()
        x_next, lam = simulate(self._lcs, x, self._u.Eval(context))
        discrete_state.set_value(self._x, x_next)
        discrete_state.set_value(self._lam, lam)
