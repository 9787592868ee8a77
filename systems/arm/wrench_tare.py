"""Tares the force-torque sensor in free space: see numerics/wrench_tare.py."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.wrench_tare import (
    SLOPE,
    STATUS,
    TareLaw,
    bias_of,
    new_memory,
    sloped,
    tared,
    tared_mean,
    tick,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class WrenchTareConfig:
    """Settings of WrenchTare."""

    # Largest force that is taken for the sensor's bias; a larger one before the first
    # tare is a contact [N]; 0: no taring.
    bias_max: float = 3.0
    drift_max: float = 0.05  # Largest drift of a force component of the sensor [N/s].
    # Largest drift of a moment component of the sensor [N m/s].
    drift_moment_max: float = 0.005
    # Force or moment at which the sensor saturates [N], [N m].
    wrench_limit: float = 200.0
    # Whether the sensor's drift and the surface's slope are estimated while the tool
    # slides, from the force across its motion.
    sideways: bool = True
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


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
        wrench_mean (6,) the same, the mean of the last 5 samples: for systems that run
            at 200 Hz. It is 2 ms late.
        force_directions (6,) turned to be at right angles to the surface.
        bias (6,) of now [N], [N m].
        slope (3,) s of the surface: its outward normal is s - n [rad].
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
        check_settings(config)
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
            sideways=bool(config.sideways),
            period=float(config.period_sec),
        )
        first_call(warm_up, self._law)
        wrench = self.DeclareVectorInputPort("wrench", 6)
        velocity = self.DeclareVectorInputPort("ee_velocity", 6)
        rows = self.DeclareVectorInputPort("force_directions", 6)
        self._ports = [wrench, velocity, rows]
        self._memory = self.DeclareDiscreteState(new_memory())
        memory = self.discrete_state_ticket(self._memory)
        for name, size, value, *ports in (
            ("wrench", 6, partial(tared, self._law), wrench),
            ("wrench_mean", 6, partial(tared_mean, self._law), wrench),
            ("force_directions", 6, sloped, rows),
            ("bias", 6, bias_of),
            ("slope", 3, lambda memory: memory[SLOPE]),
            ("status", 1, lambda memory: memory[STATUS]),
        ):
            tickets = {memory, *(port.ticket() for port in ports)}
            self.DeclareVectorOutputPort(name, size, self._calc(value, ports), tickets)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _calc(self, value, ports):
        def calc(context: Context, output: BasicVector):
            memory = context.get_discrete_state(self._memory).value()
            output.SetFromVector(value(memory, *[p.Eval(context) for p in ports]))

        return calc

    @timed
    def _update(self, context: Context, discrete_state):
        memory = discrete_state.get_mutable_value(self._memory)
        tick(self._law, memory, *[p.Eval(context) for p in self._ports])
