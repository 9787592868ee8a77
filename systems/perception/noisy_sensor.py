"""Sensors with noise, drift or delay; a restored Context replays them."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.perception.numerics.sensor_noise import add_noise


class NoisySensor(LeafSystem):
    """measured = value + std x (standard Gaussian), with new noise in each sample.

    It is computed when evaluated, without delay. The noise is a function of the seed
    and the sample's number, the multiple of the period nearest to the time. With `held`
    (for a value that changes at multiples of the period only) it is the last multiple
    before, so that all readers between two changes get the same reading.

    Inputs:  value (n,).
    Outputs: measured (n,).

    Args: std (n,): in the unit of the value; seed; period_sec [s]; held.
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, std, seed: int, period_sec: float = 0.001, held: bool = False):
        super().__init__()
        self._std = np.array(std, dtype=float)
        if self._std.ndim != 1 or not np.all(self._std >= 0.0):
            raise ValueError(f"std is {std}, expected numbers of 0 or more")
        if seed < 0:
            raise ValueError(f"seed is {seed}, expected an integer of 0 or more")
        if not period_sec > 0.0:
            raise ValueError(f"period_sec is {period_sec}, expected > 0")
        self._seed = int(seed)
        self._rate = 1.0 / period_sec
        n = len(self._std)
        # A value that is computed at k periods is read after that and up to the end of
        # the next period. The hundredth is for rounding.
        self._shift = 0.99 if held else 0.5
        self._value = self.DeclareVectorInputPort("value", n)
        needs = {self._value.ticket()} if held else {self.all_sources_ticket()}
        self.DeclareVectorOutputPort("measured", n, self._measure, needs)
        first_call(add_noise, np.zeros(n), self._std, self._seed, 0)

    def _measure(self, context: Context, output: BasicVector):
        sample = int(context.get_time() * self._rate + self._shift)
        output.SetFromVector(
            add_noise(self._value.Eval(context), self._std, self._seed, sample)
        )


class DriftingSensor(LeafSystem):
    """measured = value + bias + drift x time.

    Inputs:  value (n,).
    Outputs: measured (n,).

    Args: bias (n,); drift (n,) [1/s].
    """

    def __init__(self, bias, drift):
        super().__init__()
        self._bias, self._drift = (np.array(x, dtype=float) for x in (bias, drift))
        n = len(self._bias)
        self._value = self.DeclareVectorInputPort("value", n)
        self.DeclareVectorOutputPort("measured", n, self._measure)

    def _measure(self, context: Context, output: BasicVector):
        added = self._bias + self._drift * context.get_time()
        output.SetFromVector(self._value.Eval(context) + added)


class LateSensor(LeafSystem):
    """A delay by whole periods, for a value that changes at multiples of the period.

    Before the start the value counts as constant.

    Inputs:  value (n,).
    Outputs: measured (n,).

    Args: size: n; periods: of delay, 1 or more; period_sec [s].
    """

    def __init__(self, size: int, periods: int, period_sec: float):
        super().__init__()
        if periods < 1:
            raise ValueError(f"periods is {periods}, expected 1 or more")
        self._periods = periods
        self._value = self.DeclareVectorInputPort("value", size)
        self._past = self.DeclareDiscreteState(periods * size)  # The oldest first.
        self.DeclareVectorOutputPort(
            "measured", size, self._measure, {self.all_state_ticket()}
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._fill)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._shift)

    def _measure(self, context: Context, output: BasicVector):
        past = context.get_discrete_state(self._past).value()
        output.SetFromVector(past[: self._value.size()])

    def _fill(self, context: Context, discrete_state):
        now = self._value.Eval(context)
        discrete_state.set_value(self._past, np.tile(now, self._periods))

    def _shift(self, context: Context, discrete_state):
        past = context.get_discrete_state(self._past).value()
        later = np.r_[past[self._value.size() :], self._value.Eval(context)]
        discrete_state.set_value(self._past, later)
