"""Baseline: model reference adaptive control (MRAC) of a point in the plane."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.baselines.numerics.mrac import MEMORY, error_weights, tick
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

HELD, AT_LIMIT = 1, 2  # Bits of the status.


@dataclass
class MracConfig:
    """Settings of the baseline MRAC (model reference adaptive control)."""

    omega: float = 1.5  # Natural frequency of the reference model [1/s].
    zeta: float = 1.0  # Damping ratio of the reference model.
    rate_weight: float = 1.0  # Weight l of the velocity error [s2].
    # Proportional and integral gain of the auxiliary force f.
    force_gains: list[float] = field(default_factory=lambda: [400.0, 400.0])
    # Proportional and integral gain of K0 and Q0, which act on positions.
    position_gains: list[float] = field(default_factory=lambda: [20.0, 20.0])
    # Proportional and integral gain of K1 and Q1, which act on velocities.
    velocity_gains: list[float] = field(default_factory=lambda: [10.0, 10.0])
    # Whether the target itself is the command of the reference model, which follows it
    # with a lag; false: the command is such that the model's response is the target.
    lag: bool = False


class Mrac(LeafSystem):
    """Adapts its gains until the effector responds like a reference model.

    Inputs:  state (4,) p, v; x_desired (6,) p, v, a.
    Outputs: u (2,) [N]; status (1,), a sum: 1 not finite, u held; 2 u at its limit;
             x_model (4,) p, v of the reference model.

    Args: force_max: limit of |u| [N].
    Source: Tarokh (ICRA 1991); see numerics/mrac.py.
    """

    def __init__(
        self,
        config: MracConfig,
        force_max: float = 100.0,
        period_sec: float = 0.001,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        c = config
        for name, number in (
            ("omega", c.omega),
            ("zeta", c.zeta),
            ("rate_weight", c.rate_weight),
            ("force_max", force_max),
            ("period_sec", period_sec),
        ):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        gains = []
        for name in ("force_gains", "position_gains", "velocity_gains"):
            pair = np.array(getattr(c, name), dtype=float)
            if pair.shape != (2,) or not np.all((pair >= 0.0) & np.isfinite(pair)):
                raise ValueError(f"{name} is {pair}, expected 2 numbers >= 0")
            gains.append(pair)
        self._law = (
            float(c.omega),
            float(c.zeta),
            *error_weights(float(c.omega), float(c.zeta), float(c.rate_weight)),
            np.concatenate(gains),
            bool(c.lag),
            float(period_sec),
            float(force_max),
        )
        self._state = self.DeclareVectorInputPort("state", 4)
        self._target = self.DeclareVectorInputPort("x_desired", 6)
        self._memory = self.DeclareDiscreteState(MEMORY)
        self._u = self.DeclareDiscreteState(2)
        self._status = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("u", self._u)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclareVectorOutputPort(
            "x_model", 4, self._calc_model, {self.discrete_state_ticket(self._memory)}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)
        tick(np.zeros(MEMORY), np.zeros(4), np.zeros(6), *self._law)  # Compile now.

    @timed
    def _update(self, context: Context, discrete_state):
        # A copy: Drake's arrays are read-only, which numba would compile separately.
        memory = context.get_discrete_state(self._memory).value().copy()
        u, memory, limit = tick(
            memory, self._state.Eval(context), self._target.Eval(context), *self._law
        )
        if np.isfinite(u[0] + u[1]) and np.isfinite(memory).all():
            discrete_state.set_value(self._memory, memory)
            discrete_state.set_value(self._u, u)
            discrete_state.set_value(self._status, [AT_LIMIT if limit else 0])
        else:
            discrete_state.set_value(self._status, [HELD])

    def _calc_model(self, context: Context, output: BasicVector):
        output.SetFromVector(context.get_discrete_state(self._memory).value()[18:22])
