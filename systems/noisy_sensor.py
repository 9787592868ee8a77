"""A sensor's reading: the truth plus noise that a restored Context replays."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.sensor_noise import add_noise


class NoisySensor(LeafSystem):
    """value + std x (standard Gaussian), new noise at each sample.

    The reading is made when it is asked for, without delay. Samples are numbered by
    time, the nearest multiple of the period. With `held`, for a value that changes at
    multiples of the period alone, one reading is made of each value, whoever asks and
    when: samples are numbered by the multiple before.

    Inputs:  value (n,).
    Outputs: measured (n,).
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
        # A value of a step that ends at k periods is asked for after that, up to the
        # very end of the next one. The hundredth is for rounding.
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
