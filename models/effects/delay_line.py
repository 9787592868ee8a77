"""A delay, or a low-pass, one for each entry of a vector."""

import numpy as np
from pydrake.systems.framework import LeafSystem


class DelayLine(LeafSystem):
    """y_i(t) = u_i(t - delay_i), from samples of u every period, linear in between.

    Before the start u counts as constant. A delay of whole periods is exact for a u
    that is held between samples.

    Inputs:  u (n,); zero if it is not connected.
    Outputs: y (n,).

    Args: delays (n,): each 0 or more [s]; period_sec: of the samples [s].
    """

    def __init__(self, delays, period_sec: float):
        super().__init__()
        self._delays = np.array(delays, dtype=float)
        if not (self._delays >= 0.0).all():
            raise ValueError(f"delays are {delays}, expected 0 or more [s]")
        self._n, self._period = self._delays.size, period_sec
        self._length = int(np.ceil(self._delays.max(initial=0.0) / period_sec)) + 1
        self._u = self.DeclareVectorInputPort("u", self._n)
        # The newest sample first; then the time of the newest.
        self._samples = self.DeclareDiscreteState(self._length * self._n + 1)
        self.DeclareVectorOutputPort("y", self._n, self._calc)
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._shift)

    def _now(self, context):
        return self._u.Eval(context) if self._u.HasValue(context) else np.zeros(self._n)

    def _start(self, context, discrete_state):
        old = np.tile(self._now(context), self._length)
        discrete_state.set_value(self._samples, [*old, context.get_time()])

    def _shift(self, context, discrete_state):
        old = context.get_discrete_state(self._samples).value()[: -1 - self._n]
        discrete_state.set_value(
            self._samples, [*self._now(context), *old, context.get_time()]
        )

    def _calc(self, context, output):
        state = context.get_discrete_state(self._samples).value()
        samples = state[:-1].reshape(self._length, self._n)
        u, now = self._now(context), context.get_time()
        newest = now - state[-1]  # Age of the newest sample.
        y = np.array(u)
        for i, delay in enumerate(self._delays):
            if delay <= 1e-9 * self._period:
                continue
            # Ages: 0 is u itself, then `newest`, `newest` + period, ...
            behind = (delay - newest) / self._period
            if behind < 0.0:
                s = delay / newest
                y[i] = (1.0 - s) * u[i] + s * samples[0, i]
                continue
            k = min(int(behind + 1e-6), self._length - 1)
            s = min(max(behind - k, 0.0), 1.0)
            older = samples[min(k + 1, self._length - 1), i]
            y[i] = (1.0 - s) * samples[k, i] + s * older
        output.SetFromVector(y)


class LagLine(LeafSystem):
    """T_i dy_i/dt = u_i - y_i from samples of u every period, exact for a u that is
    linear in between; y_i = u_i if T_i is 0. Before the start u counts as constant.

    Inputs:  u (n,); zero if it is not connected.
    Outputs: y (n,): of the last sample.

    Args: time_constants (n,): each 0 or more [s]; period_sec: of the samples [s].
    """

    def __init__(self, time_constants, period_sec: float):
        super().__init__()
        T = np.array(time_constants, dtype=float)
        if not (T >= 0.0).all():
            raise ValueError(f"time constants are {T}, expected 0 or more [s]")
        self._n, self._through = T.size, T <= 1e-3 * period_sec
        safe = np.where(self._through, 1.0, T)
        self._keep = np.exp(-period_sec / safe)
        # Fraction of a linear rise over the period that has arrived at its end.
        self._rise = 1.0 - (1.0 - self._keep) * safe / period_sec
        self._u = self.DeclareVectorInputPort("u", self._n)
        self._last = self.DeclareDiscreteState(2 * self._n)  # u, then y.
        self.DeclareVectorOutputPort("y", self._n, self._calc)
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._shift)

    def _now(self, context):
        return self._u.Eval(context) if self._u.HasValue(context) else np.zeros(self._n)

    def _start(self, context, discrete_state):
        now = self._now(context)
        discrete_state.set_value(self._last, [*now, *now])

    def _shift(self, context, discrete_state):
        u, y = context.get_discrete_state(self._last).value().reshape(2, -1)
        now = self._now(context)
        y = u + self._keep * (y - u) + self._rise * (now - u)
        discrete_state.set_value(self._last, [*now, *y])

    def _calc(self, context, output):
        y = context.get_discrete_state(self._last).value()[self._n :]
        output.SetFromVector(np.where(self._through, self._now(context), y))
