"""Baseline: active inference control of a point in the plane."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.baselines.numerics.active_inference import MEMORY, tick
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

HELD, AT_LIMIT = 1, 2  # Bits of the status.


@dataclass
class ActiveInferenceConfig:
    """Settings of the baseline active inference."""

    # Variances of measured position, of measured velocity, of the belief and of its
    # rate.
    variance: list[float] = field(default_factory=lambda: [1.0, 1.0, 5.0, 5.0])
    k_belief: float = 20.0  # Rate k_mu at which the belief follows [1/s].
    k_action: float = 1200.0  # Gain k_a of the action [N/(m s)].
    # Whether the generative model includes the goal's motion; not so in the source.
    goal_moves: bool = False


class ActiveInference(LeafSystem):
    """Minimises free energy under a generative model in which the point goes to the
    goal.

    Inputs:  state (4,) p, v; x_desired (6,) p, v, a, of which p is the goal; v and a
             are used with config.goal_moves.
    Outputs: u (2,) [N]; status (1,), a sum: 1 not finite, u held; 2 u at its limit;
             belief (6,) mu, mu', mu''.

    Args: force_max: limit of |u| [N].
    Raises: ValueError for numbers that are not positive.
    Source: Pezzato et al. (2020); see numerics/active_inference.py.
    """

    def __init__(
        self,
        config: ActiveInferenceConfig,
        force_max: float = 100.0,
        period_sec: float = 0.001,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        c = config
        variance = np.array(c.variance, dtype=float)
        if variance.shape != (4,) or not np.all(variance > 0.0):
            raise ValueError(f"variance is {c.variance}, expected 4 numbers > 0")
        for name, number in (
            ("k_belief", c.k_belief),
            ("k_action", c.k_action),
            ("force_max", force_max),
            ("period_sec", period_sec),
        ):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        self._law = (
            bool(c.goal_moves),
            1.0 / variance,
            float(c.k_belief),
            float(c.k_action),
            float(period_sec),
            float(force_max),
        )
        self._state = self.DeclareVectorInputPort("state", 4)
        self._target = self.DeclareVectorInputPort("x_desired", 6)
        self._memory = self.DeclareDiscreteState(MEMORY)
        self._status = self.DeclareDiscreteState(1)
        ticket = {self.discrete_state_ticket(self._memory)}
        self.DeclareVectorOutputPort("u", 2, self._calc_u, ticket)
        self.DeclareVectorOutputPort("belief", 6, self._calc_belief, ticket)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)
        tick(np.zeros(MEMORY), np.zeros(4), np.zeros(6), *self._law)  # Compile now.

    @timed
    def _update(self, context: Context, discrete_state):
        # A copy: Drake's arrays are read-only, which numba would compile separately.
        memory = context.get_discrete_state(self._memory).value().copy()
        state, target = self._state.Eval(context), self._target.Eval(context)
        _, memory, limit = tick(memory, state, target, *self._law)
        if np.isfinite(memory).all():
            discrete_state.set_value(self._memory, memory)
            discrete_state.set_value(self._status, [AT_LIMIT if limit else 0])
        else:
            discrete_state.set_value(self._status, [HELD])

    def _calc_u(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._memory).value()[6:8])

    def _calc_belief(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._memory).value()[:6])
