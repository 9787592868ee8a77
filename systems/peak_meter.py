from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.numerics.timing import timed


@dataclass
class PeakMeterConfig:
    cutoff_hz: float = 100.0  # Of a first-order low-pass; 0 for none.
    threshold: float = 0.05  # First time |value| exceeds it (unfiltered).
    period_sec: float = 0.001
    offset_sec: float = 0.0


class PeakMeter(LeafSystem):
    """For scoring: the largest filtered |value| so far and when |value| first rose.

    Inputs:  value (n,).
    Outputs: peak (n,), of each entry; first_time (1,) [s], NaN until |value| (the norm)
             has exceeded the threshold.
    """

    def __init__(self, config: PeakMeterConfig, n: int):
        super().__init__()
        self._threshold = config.threshold
        pole = np.exp(-2.0 * np.pi * config.cutoff_hz * config.period_sec)
        self._gain = 1.0 - pole if config.cutoff_hz > 0.0 else 1.0
        self._value = self.DeclareVectorInputPort("value", n)
        self._filtered = self.DeclareDiscreteState(n)
        self._peak = self.DeclareDiscreteState(n)
        self._first = self.DeclareDiscreteState([np.nan])
        self.DeclareStateOutputPort("peak", self._peak)
        self.DeclareStateOutputPort("first_time", self._first)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, discrete_state):
        value = self._value.Eval(context)
        filtered = context.get_discrete_state(self._filtered).value()
        filtered = filtered + self._gain * (value - filtered)
        peak = context.get_discrete_state(self._peak).value()
        discrete_state.set_value(self._filtered, filtered)
        discrete_state.set_value(self._peak, np.maximum(peak, abs(filtered)))
        first = context.get_discrete_state(self._first).value()
        if np.isnan(first[0]) and value @ value > self._threshold**2:
            discrete_state.set_value(self._first, [context.get_time()])
