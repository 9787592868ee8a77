"""Checks whether an arm keeps its limits, independently of its controller."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

# Entries of the output `worst`.
TORQUE, TORQUE_RATE, SPEED, POSITION, NOT_FINITE, FIRST = range(6)
ROUNDING = 1e-9  # Tolerance: reaching a limit is no violation.


@dataclass
class ArmLimits:
    """An arm's limits of position, velocity, effort and its rate."""

    torque: np.ndarray  # (n,) [N m]
    torque_rate: float  # [N m/s]
    speed: np.ndarray  # (n,) [rad/s]
    lower: np.ndarray  # (n,) [rad]
    upper: np.ndarray  # (n,) [rad]


@dataclass(frozen=True)
class Verdict:
    """What a monitor has measured so far."""

    torque_share: float  # Largest |tau| over its limit.
    torque_rate_share: float  # Largest change of tau from tick to tick over its limit.
    speed_share: float  # Largest |v| over its limit.
    position_excess: float  # Largest excess over a position limit [rad]; < 0: inside.
    not_finite: int  # Ticks in which any number was not finite.
    first_violation_s: float  # NaN: none.

    @property
    def kept(self) -> bool:
        return not np.isfinite(self.first_violation_s)


class SafetyMonitor(LeafSystem):
    """Compares torque, torque rate, joint speeds and positions with their limits, and
    checks for NaN, each tick.

    Inputs:  tau (n,): commanded [N m]; q (n,) [rad], v (n,) [rad/s]: the true ones.
    Outputs: worst (6,): the largest ratios so far of torque, torque rate and speed to
             their limits; largest excess over a position limit [rad], < 0: inside;
             ticks with a number that is not finite; time of the first violation [s],
             -1 for none.
    """

    def __init__(self, limits: ArmLimits, period_sec: float, offset_sec: float = 0.0):
        super().__init__()
        n = len(limits.torque)
        self._limits, self._period = limits, period_sec
        self._tau = self.DeclareVectorInputPort("tau", n)
        self._q = self.DeclareVectorInputPort("q", n)
        self._v = self.DeclareVectorInputPort("v", n)
        self._worst = self.DeclareDiscreteState([0.0, 0.0, 0.0, -np.inf, 0.0, -1.0])
        self._last = self.DeclareDiscreteState(np.full(n, np.nan))
        self.DeclareStateOutputPort("worst", self._worst)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)

    def _update(self, context: Context, discrete_state):
        c = self._limits
        tau, q, v = (
            np.asarray(port.Eval(context)) for port in (self._tau, self._q, self._v)
        )
        worst = np.array(context.get_discrete_state(self._worst).value())
        last = context.get_discrete_state(self._last).value()
        finite = all(np.isfinite(x).all() for x in (tau, q, v))
        if not finite:
            worst[NOT_FINITE] += 1.0
        now = [
            np.max(abs(tau) / c.torque),
            np.max(abs(tau - last)) / (c.torque_rate * self._period),
            np.max(abs(v) / c.speed),
            np.max(np.maximum(c.lower - q, q - c.upper)),
        ]
        for i, value in enumerate(now):
            if np.isfinite(value):
                worst[i] = max(worst[i], value)
        broken = not finite or (worst[:POSITION] > 1.0 + ROUNDING).any()
        broken |= worst[POSITION] > ROUNDING
        if broken and worst[FIRST] < 0.0:
            worst[FIRST] = context.get_time()
        discrete_state.set_value(self._worst, worst)
        discrete_state.set_value(self._last, tau)


def verdict(worst) -> Verdict:
    """The output `worst` (6,), by name."""
    first = float(worst[FIRST])
    return Verdict(
        torque_share=float(worst[TORQUE]),
        torque_rate_share=float(worst[TORQUE_RATE]),
        speed_share=float(worst[SPEED]),
        position_excess=float(worst[POSITION]),
        not_finite=int(worst[NOT_FINITE]),
        first_violation_s=first if first >= 0.0 else float("nan"),
    )
