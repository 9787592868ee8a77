"""An own learner in place of ours, in an experiment that is not changed otherwise."""

import sys

import numpy as np
from pydrake.all import AbstractValue, LeafSystem

from makebreak.diagrams import cartpole_walls
from makebreak.scripts.cli import main
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    measured_step,
    violation_loss,
)


class SignDescent(LeafSystem):  # It has the ports that ResidualLearner has here.
    """Moves each residual by a fixed step against the sign of the loss's gradient."""

    def __init__(self, config, lcs, period_sec, offset_sec):
        super().__init__()
        self.config, (n_x, n_lam) = config, lcs.D.shape
        self.x = self.DeclareVectorInputPort("x", n_x)
        self.u = self.DeclareVectorInputPort("u_measured", lcs.B.shape[1])
        self.lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(lcs))
        self.r = self.DeclareDiscreteState(n_lam)  # All memory is in the Context.
        self.x_before = self.DeclareDiscreteState(np.full(n_x, np.nan))
        self.DeclareStateOutputPort("r_comp", self.r)
        for name in ("loss", "status"):
            self.DeclareVectorOutputPort(name, 1, lambda context, out: out.SetZero())
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self.update)

    def update(self, context, state):
        x, u, lcs = (port.Eval(context) for port in (self.x, self.u, self.lcs))
        before = context.get_discrete_state(self.x_before).value()
        if np.isfinite(before).all():
            r = context.get_discrete_state(self.r).value().copy()
            eps, gamma = self.config.eps, self.config.gamma
            step = measured_step(lcs, before, u, x, np.ones(len(x)), eps)
            for _ in range(5):
                _, (gradient,), *_ = violation_loss(step, r, eps, gamma)
                felt = abs(gradient) > 1e-3
                r[felt] -= 0.003 * np.sign(gradient[felt])  # [m], as in this LCS.
            state.set_value(self.r, r)
        state.set_value(self.x_before, x)


cartpole_walls.ResidualLearner = SignDescent
sys.exit(main(["run", "cartpole_walls", "--no-meshcat", *sys.argv[1:]]))
