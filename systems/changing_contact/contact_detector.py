"""The contact detector: see numerics/contact_detector.py for how it decides."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_detector import (
    MEMORY,
    Thresholds,
    detect,
    new_memory,
    warm_up,
)
from makebreak.systems.changing_contact.numerics.contact_task import N_CONTACT, N_PHASE
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class ContactDetectorConfig:
    """Settings of ContactDetector: forces at which contact is made and broken."""

    # Force beyond the expected friction that may be an impact [N].
    impact_force: float = 2.0
    loss_force: float = 1.0  # Normal force below which there is no contact [N].
    # Least stiffness of a contact that is made while sliding; less is a change of
    # friction [N/m].
    stiffness_min: float = 1000.0
    # Mass between force sensor and tip, whose inertia is subtracted [kg].
    tool_mass: float = 0.3
    # Force or moment at which the sensor saturates [N], [N m].
    wrench_limit: float = 200.0
    period_sec: float = 0.001  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class ContactDetector(LeafSystem):
    """Says when the tool has made or broken contact, where, and with what force.

    Inputs:
        wrench (6,) measured on the tool at its tip, world axes, force first [N], [N m].
        ee_pose (7,), ee_velocity (6,) of the tip E: p_WE, quaternion; v, w.
        direction (3,) unit vector of the target motion, zero at rest.
        force_directions (6,) two rows n, pressed along; a zero row: none.
        phase (6,) of the motion, numerics/contact_task.py.

    Outputs:
        contact (14,) of numerics/contact_task.py: counters of contacts made, broken
            and peaks measured; time, p_WE, direction and speed of the last one made, at
            its first sample; its peak force; status 1 while the wrench is NaN, stuck
            (no bit changes for 50 ms of motion) or at its limit: then nothing is
            reported, and friction is learned anew afterwards.
        along (2,) force against the motion and the part of it that is expected [N].

    The bias of the wrench is its mean over the first 0.1 s, if the tip is at rest in
    free space for that long. With `tared` there is none: WrenchTare has taken it off.

    Source: CC section 3.3.
    """

    def __init__(self, config: ContactDetectorConfig, tared: bool = False):
        """Raises: ValueError for a number that is not positive (tool_mass, offset_sec:
        that is negative) or a period above 2 ms."""
        super().__init__()
        check_settings(config)
        for name, value in vars(config).items():
            may_be_zero = name in ("tool_mass", "offset_sec")
            if not (0.0 < value or may_be_zero and value == 0.0) or value == np.inf:
                raise ValueError(f"{name} is {value}, expected a positive number")
        if config.period_sec > 0.002:
            raise ValueError(
                f"period_sec is {config.period_sec}, expected 0.002 s or less"
            )
        self._limits = Thresholds(
            impact_force=float(config.impact_force),
            loss_force=float(config.loss_force),
            stiffness_min=float(config.stiffness_min),
            tool_mass=float(config.tool_mass),
            wrench_limit=float(config.wrench_limit),
            period=float(config.period_sec),
        )
        first_call(warm_up, self._limits)
        self._ports = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("wrench", 6),
                ("ee_pose", 7),
                ("ee_velocity", 6),
                ("direction", 3),
                ("force_directions", 6),
                ("phase", N_PHASE),
            )
        ]
        self._contact = self.DeclareDiscreteState(N_CONTACT)
        self._memory = self.DeclareDiscreteState(new_memory(tared))
        self.DeclareStateOutputPort("contact", self._contact)
        memory = {self.discrete_state_ticket(self._memory)}
        self.DeclareVectorOutputPort("along", 2, self._along, memory)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _along(self, context: Context, output: BasicVector):
        memory = context.get_discrete_state(self._memory).value()
        output.SetFromVector(memory.view(MEMORY)["along"][0])

    @timed
    def _update(self, context: Context, discrete_state):
        detect(
            self._limits,
            discrete_state.get_mutable_value(self._memory),
            discrete_state.get_mutable_value(self._contact),
            context.get_time(),
            *[port.Eval(context) for port in self._ports],
        )
