"""Lays a tool flat on what it is pressed on: see numerics/surface_alignment.py."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.surface_alignment import (
    N_MEMORY,
    PHI,
    AlignmentLaw,
    tick,
    turned,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class SurfaceAlignmentConfig:
    """Settings of SurfaceAlignment."""

    # Largest angle by which the tool is turned beyond its planned orientation, to lie
    # flat on a surface; 0: it is not turned [deg].
    angle_max_deg: float = 0.0
    # Moment over the speed with which the tool yields to it [N m s/rad].
    damping: float = 1.0
    speed_max: float = 0.1  # Largest speed of turning [rad/s].
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class SurfaceAlignment(LeafSystem):
    """Turns the planned orientation until the tool has no moment about its tip.

    Inputs:
        x_desired (19,) of the velocity shaper; wrench (6,) on the tool at its tip,
            without bias, world axes, force first [N], [N m]; force_directions (6,) two
            rows that the motion presses along; a zero row: none.

    Outputs:
        x_desired (19,) turned, without delay.
        turn (3,) state: beyond the planned orientation, as a rotation vector in world
            axes [rad].

    Raises: ValueError for a setting out of its range.
    """

    def __init__(self, config: SurfaceAlignmentConfig):
        super().__init__()
        check_settings(config)
        if not 0.0 < config.angle_max_deg <= 5.0:
            raise ValueError(
                f"angle_max_deg is {config.angle_max_deg}, expected 0 to 5"
            )
        for name in ("damping", "speed_max", "period_sec"):
            if not 0.0 < getattr(config, name) < np.inf:
                raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")
        self._law = AlignmentLaw(
            angle_max=float(np.deg2rad(config.angle_max_deg)),
            damping=float(config.damping),
            speed_max=float(config.speed_max),
            period=float(config.period_sec),
        )
        first_call(warm_up, self._law)
        self._x = self.DeclareVectorInputPort("x_desired", 19)
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self._rows = self.DeclareVectorInputPort("force_directions", 6)
        self._memory = self.DeclareDiscreteState(N_MEMORY)
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort(
            "x_desired", 19, self._turned, {ticket, self._x.ticket()}
        )
        self.DeclareVectorOutputPort("turn", 3, self._turn, {ticket})
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _now(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._memory).value()

    def _turned(self, context: Context, output: BasicVector):
        output.SetFromVector(turned(self._now(context), self._x.Eval(context)))

    def _turn(self, context: Context, output: BasicVector):
        output.SetFromVector(self._now(context)[PHI])

    @timed
    def _update(self, context: Context, discrete_state):
        wrench, rows = self._wrench.Eval(context), self._rows.Eval(context)
        memory = tick(self._law, self._now(context), wrench, rows)
        discrete_state.set_value(self._memory, memory)
