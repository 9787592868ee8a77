"""Signal faults for tests: bias, NaN, limit, stuck, delay.

Each is a system between a port and its readers, which changes the value from `start`
until before `end` [s].
"""

from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.faults.numerics.time_span import lasts

HUGE = 1e200


class _Timed(LeafSystem):
    """Base of the faults: their time, and one input and one output (n,)."""

    def __init__(self, n: int, start: float, end: float):
        super().__init__()
        if not 0.0 <= start < end:
            raise ValueError(
                f"a fault from {start} to {end} s, expected 0 <= from < to"
            )
        self._start, self._end = float(start), float(end)
        self._value = self.DeclareVectorInputPort("value", n)
        self.DeclareVectorOutputPort("value", n, self._calc)

    def _acts(self, context: Context) -> bool:
        return lasts(context.get_time(), self._start, self._end)

    def _calc(self, context: Context, output: BasicVector):
        value = self._value.Eval(context)
        output.SetFromVector(
            self._changed(context, np.array(value)) if self._acts(context) else value
        )

    def _changed(self, context: Context, value: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class BiasedSignal(_Timed):
    """value + bias (n,); NaN where bias is NaN.

    Inputs:  value (n,).
    Outputs: value (n,).
    """

    def __init__(self, bias, start: float, end: float):
        self._bias = np.array(bias, dtype=float)
        super().__init__(len(self._bias), start, end)

    def _changed(self, context, value):
        return value + self._bias


class LimitedSignal(_Timed):
    """value, clipped to +-limit (n,).

    Inputs:  value (n,).
    Outputs: value (n,).
    """

    def __init__(self, limit, start: float, end: float):
        self._limit = np.array(limit, dtype=float)
        if not np.all(self._limit >= 0.0):
            raise ValueError(f"limit is {limit}, expected numbers of 0 or more")
        super().__init__(len(self._limit), start, end)

    def _changed(self, context, value):
        return value.clip(-self._limit, self._limit)


class StuckSignal(_Timed):
    """The entries (n,) that are True keep their value from one period before `start`.

    Inputs:  value (n,).
    Outputs: value (n,).
    """

    def __init__(self, entries, start: float, end: float, period_sec: float = 0.001):
        self._entries = np.array(entries, dtype=bool)
        super().__init__(len(self._entries), start, end)
        self._kept = self.DeclareDiscreteState(len(self._entries))
        self.DeclareInitializationDiscreteUpdateEvent(self._keep)
        # In the middle of a period: the plant's value is that of the period's start.
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec, 0.5 * period_sec, self._keep
        )

    def _keep(self, context, discrete_state):
        if not self._acts(context):
            discrete_state.set_value(self._kept, self._value.Eval(context))

    def _changed(self, context, value):
        kept = context.get_discrete_state(self._kept).value()
        return np.where(self._entries, kept, value)


class LateSignal(_Timed):
    """The entries (n,) that are True are delayed by `periods` periods. At the start the
    last value is held until the delayed ones arrive.

    Inputs:  value (n,).
    Outputs: value (n,); age (1,): the present delay [s].
    """

    def __init__(self, entries, periods: int, start, end, period_sec: float = 0.001):
        if periods < 1:
            raise ValueError(f"periods is {periods}, expected 1 or more")
        self._entries = np.array(entries, dtype=bool)
        self._periods, self._period = int(periods), float(period_sec)
        super().__init__(len(self._entries), start, end)
        # The oldest first.
        self._past = self.DeclareDiscreteState(self._periods * len(self._entries))
        self.DeclareVectorOutputPort("age", 1, self._age)
        self.DeclareInitializationDiscreteUpdateEvent(self._fill)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._shift)

    def _fill(self, context, discrete_state):
        now = self._value.Eval(context)
        discrete_state.set_value(self._past, np.tile(now, self._periods))

    def _shift(self, context, discrete_state):
        n = len(self._entries)
        past = context.get_discrete_state(self._past).value()
        later = np.r_[past[n:], self._value.Eval(context)]
        discrete_state.set_value(self._past, later)

    def _behind(self, context) -> int:
        """Present delay in periods; it grows from 0 while the last value is held."""
        since = (context.get_time() - self._start) / self._period
        return min(self._periods, max(0, int(since + 1e-6)))

    def _changed(self, context, value):
        behind = self._behind(context)
        if behind == 0:
            return value
        n = len(self._entries)
        past = context.get_discrete_state(self._past).value().reshape(-1, n)
        return np.where(self._entries, past[self._periods - behind], value)

    def _age(self, context, output):
        behind = self._behind(context) if self._acts(context) else 0
        output.SetAtIndex(0, behind * self._period)


class SpoiledLcs(LeafSystem):
    """An LCS that is unsolvable during the fault: its numbers are finite, but their
    products overflow.

    Inputs:  lcs (abstract LCS).
    Outputs: lcs (abstract LCS).
    """

    def __init__(self, example: LCS, start: float, end: float):
        super().__init__()
        self._start, self._end = float(start), float(end)
        self._lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(example))
        self.DeclareAbstractOutputPort(
            "lcs", lambda: AbstractValue.Make(example), self._calc
        )

    def _calc(self, context, output):
        lcs: Any = self._lcs.Eval(context)
        if lasts(context.get_time(), self._start, self._end):
            lcs = replace(lcs, A=HUGE * lcs.A, D=HUGE * lcs.D)
        output.set_value(lcs)
