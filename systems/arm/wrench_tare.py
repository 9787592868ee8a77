"""Tares the force-torque sensor in free space: see numerics/wrench_tare.py."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.wrench_tare import (
    BIAS,
    STATUS,
    TareLaw,
    new_memory,
    tared,
    tick,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import timed


@dataclass
class WrenchTareConfig:
    bias_max: float = 3.0  # A larger force at first is a contact [N]. 0: no taring.
    drift_max: float = 0.05  # Of a sensor [N/s].
    drift_moment_max: float = 0.005  # [N m/s]
    wrench_limit: float = 200.0  # At which the sensor saturates [N], [N m].
    period_sec: float = 0.001
    offset_sec: float = 0.0


class WrenchTare(LeafSystem):
    """The wrench without the sensor's bias, for all that read it.

    Inputs:
        wrench (6,) measured on the tool at its tip, world axes, without the tool's
            weight, force first [N], [N m].
        ee_velocity (6,) of the tip, v [m/s], w [rad/s].
        force_directions (6,) two rows that the motion presses along; a zero row: none.

    Outputs:
        wrench (6,) minus the bias, without delay. A wrench that is NaN or at its limit
            passes as it is.
        bias (6,) state.
        status (1,) state; 0: tared; 1: not yet, as no time of 0.1 s in free space has
            passed: nothing is subtracted; 2: not, as the force there was more than
            bias_max, so the run has begun in contact; 3: the wrench is NaN or at its
            limit, the bias is kept.

    The bias is that of the world's axes: a tool that is turned in free space by angle
    a has it wrong by 2 sin(a/2) of its size until the drift's rate has caught up.

    Raises: ValueError for a setting out of its range.
    """

    def __init__(self, config: WrenchTareConfig):
        super().__init__()
        for name, value in vars(config).items():
            positive = name in ("wrench_limit", "period_sec")
            if not (0.0 < value if positive else 0.0 <= value) or value == np.inf:
                wanted = "a positive number" if positive else "a number of 0 or more"
                raise ValueError(f"{name} is {value}, expected {wanted}")
        self._law = TareLaw(
            bias_max=float(config.bias_max),
            drift_max=float(config.drift_max),
            drift_moment_max=float(config.drift_moment_max),
            wrench_limit=float(config.wrench_limit),
            period=float(config.period_sec),
        )
        first_call(warm_up, self._law)
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self._ports = [
            self._wrench,
            self.DeclareVectorInputPort("ee_velocity", 6),
            self.DeclareVectorInputPort("force_directions", 6),
        ]
        memory = new_memory()
        self._memory = self.DeclareDiscreteState(memory)
        ticket = {self.discrete_state_ticket(self._memory)}
        self.DeclareVectorOutputPort(
            "wrench", 6, self._calc, ticket | {self._wrench.ticket()}
        )
        for name, rows in (("bias", BIAS), ("status", STATUS)):
            size = len(memory[rows])
            self.DeclareVectorOutputPort(name, size, self._calc_rows(rows), ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _calc(self, context: Context, output: BasicVector):
        memory = context.get_discrete_state(self._memory).value()
        output.SetFromVector(tared(self._law, memory, self._wrench.Eval(context)))

    def _calc_rows(self, rows: slice):
        def calc(context: Context, output: BasicVector):
            output.SetFromVector(context.get_discrete_state(self._memory).value()[rows])

        return calc

    @timed
    def _update(self, context: Context, discrete_state):
        memory = context.get_discrete_state(self._memory).value()
        memory = tick(self._law, memory, *[p.Eval(context) for p in self._ports])
        discrete_state.set_value(self._memory, memory)
