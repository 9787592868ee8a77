"""The reflex at first touch: see numerics/impact_reflex.py for the law."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import N_PHASE
from makebreak.systems.changing_contact.numerics.impact_reflex import (
    N_MEMORY,
    ReflexLaw,
    tick,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class ImpactReflexConfig:
    """Settings of ImpactReflex."""

    # Braking force over the force that is felt beyond force_least; 0: no reflex.
    gain: float = 0.0
    # Force beyond friction below which what is felt is noise [N].
    force_least: float = 0.5
    # The same for a contact that was felt before, whose force is chosen by its approach
    # speed: the reflex only limits what is beyond it; 0: force_least [N].
    force_known: float = 0.0
    # Largest force beyond force_least that counts; more does not brake more [N].
    force_max: float = 10.0
    fade_sec: float = 0.1  # Time in which the reflex fades out after the impact [s].
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class ImpactReflex(LeafSystem):
    """Adds to the feed-forward wrench what brakes the arm at the first touch of an
    expected impact.

    Inputs:  wrench (6,) on the tool [N], [N m]; ee_velocity (6,) of the tip; direction
             (3,) of the motion; phase (6,); wrench_feedforward (6,), of the variable
             impedance; optional impact_known (1,): 1 if the contact ahead was felt
             before.
    Output:  wrench_feedforward (6,), the sum; state.

    Raises: ValueError for numbers out of their range.
    Source: ours; it belongs to the transition-phase controller of CC 3.4.1.
    """

    def __init__(self, config: ImpactReflexConfig):
        super().__init__()
        check_settings(config)
        for name, least in (
            ("gain", 0.0),
            ("force_least", 0.0),
            ("force_known", 0.0),
            ("force_max", 0.0),
            ("fade_sec", 1e-6),
            ("period_sec", 1e-6),
        ):
            value = getattr(config, name)
            if not least <= value < np.inf:
                wanted = "0 or more" if least == 0.0 else "a positive number"
                raise ValueError(f"{name} is {value}, expected {wanted}")
        self._law = ReflexLaw(
            gain=float(config.gain),
            force_least=float(config.force_least),
            force_max=float(config.force_max),
            fade_sec=float(config.fade_sec),
            period=float(config.period_sec),
            force_known=float(config.force_known),
        )
        first_call(warm_up, self._law)
        self._ports = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("wrench", 6),
                ("ee_velocity", 6),
                ("direction", 3),
                ("phase", N_PHASE),
            )
        ]
        self._fed = self.DeclareVectorInputPort("wrench_feedforward", 6)
        self._known = self.DeclareVectorInputPort("impact_known", 1)
        self._memory = self.DeclareDiscreteState(N_MEMORY)
        self._wrench = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("wrench_feedforward", self._wrench)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context: Context, discrete_state):
        memory = context.get_discrete_state(self._memory).value()
        values = [port.Eval(context) for port in self._ports]
        if self._known.HasValue(context):
            values.append(self._known.Eval(context)[0])
        memory, force = tick(self._law, memory, *values)
        wrench = self._fed.Eval(context)
        wrench[:3] += force
        discrete_state.set_value(self._memory, memory)
        discrete_state.set_value(self._wrench, wrench)
