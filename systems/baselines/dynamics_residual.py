"""Adds a residual of the dynamics to an LCS of any time step."""

from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.baselines.numerics.dynamics_residual import (
    with_dynamics_residual,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS


class DynamicsResidual(LeafSystem):
    """The LCS with d + r_dyn lcs.dt / residual_dt: the error of a step is taken to be
    proportional to its length.

    Inputs:  lcs (abstract); r_dyn (n_x,) of DynamicsResidualLearner [x per step].
    Outputs: lcs (abstract).
    """

    def __init__(self, lcs: LCS, residual_dt_sec: float):
        super().__init__()
        self._dt = residual_dt_sec
        self._lcs = self.DeclareAbstractInputPort("lcs", Value(lcs))
        self._r_dyn = self.DeclareVectorInputPort("r_dyn", lcs.n_x)
        self.DeclareAbstractOutputPort("lcs", lambda: Value(lcs), self._calc)

    def _calc(self, context, output):
        lcs, r_dyn = self._lcs.Eval(context), self._r_dyn.Eval(context)
        output.set_value(with_dynamics_residual(lcs, r_dyn * (lcs.dt / self._dt)))
