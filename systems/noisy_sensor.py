"""A sensor's reading: the truth plus noise that a restored Context replays."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.sensor_noise import add_noise


class NoisySensor(LeafSystem):
    """value + std x (standard Gaussian), new noise at each sample.

    The reading is made when it is asked for, without delay. Samples are numbered by
    time, the nearest multiple of the period.

    Inputs:  value (n,).
    Outputs: measured (n,).
    """

    def __init__(self, std, seed: int, period_sec: float = 0.001):
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
        self._value = self.DeclareVectorInputPort("value", n)
        self.DeclareVectorOutputPort("measured", n, self._measure)
        add_noise(np.zeros(n), self._std, self._seed, 0)  # Compiles it.

    def _measure(self, context: Context, output: BasicVector):
        sample = int(context.get_time() * self._rate + 0.5)
        output.SetFromVector(
            add_noise(self._value.Eval(context), self._std, self._seed, sample)
        )
