"""The mode detector: see numerics/mode_detector.py for how it decides."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import (
    N_TOUCH_MODE,
    N_TRANSITION,
    UNKNOWN_MODE,
)
from makebreak.systems.changing_contact.numerics.mode_detector import (
    ModeMemory,
    ModeTuning,
    detect,
    warm_up,
)
from makebreak.systems.changing_contact.numerics.mode_table import ModeTable, no_modes
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings, check_times
from makebreak.systems.numerics.timing import timed


@dataclass
class ModeDetectorConfig:
    """The feature is |F_t|/R, with a torque_arm [|F_t|/R, |tau|/(R torque_arm)]."""

    # Threshold of BIRCH in units of the feature: modes have to be some 2.5 of it apart,
    # or they are one mode.
    threshold: float = 0.04
    # Length of the tool along the motion, which it needs to cross a seam: nothing is
    # decided before [m]; 0: it touches with one point. changing_surface and
    # surface_switch set that of a sphere.
    crossing: float = 0.03
    # Standard deviation of the noise of a sample of the wrench [N].
    force_noise: float = 0.1
    normal_force_min: float = 1.0  # Normal force below which there is no contact [N].
    batch: int = 15  # Number of samples from which a new mode is made.
    # Length by which a torque is divided, beside R, to be part of the feature [m]; 0:
    # no torque in it.
    torque_arm: float = 0.0
    # Mass between force sensor and tip, whose inertia is subtracted [kg].
    tool_mass: float = 0.3
    # Force or moment at which the sensor saturates [N], [N m].
    wrench_limit: float = 200.0


class ModeDetector(LeafSystem):
    """Recognises contact modes, and gives numbers to new ones.

    Inputs:
        wrench (6,) measured on the tool at its tip, world axes, force first [N], [N m].
        ee_velocity (6,) of the tip, v [m/s], w [rad/s].
        direction (3,) unit vector of the target motion, zero at rest.
        force_directions (6,) two rows n, pressed along; a zero row: none.
        mode_hint (1,) optional: the mode that begins now, -1 for none. A known mode is
            used at once, and given up if the feature does not confirm it.
        touch_hint (1,) optional: the mode that a touch brought before, -1 for none.

    Outputs, all of them state:
        mode (1,) 1, 2, ...; FREE_MODE without normal force; UNKNOWN_MODE after a touch,
            until it is identified or hinted.
        confidence (2,) shares of the last batch: in this mode, in the second best.
        is_new (1,) 1 while the mode is one that the last decision created.
        transition (6,) of numerics/contact_task.py: changes from one surface to
            another; the time of the first departing sample, and of the decision.
            Making and losing contact is not one.
        touch_mode (2,) the number of touches whose mode was identified, and the last
            of these modes.
        collecting (1,) 1 while the arm should be stiff: just after a departure, while
            a batch is collected, and from a hint or touch until the mode is identified.
        undecided (1,) 1 while the mode may be another one: from a departure, a touch
            or a hint until the decision.
        status (1,) 0: there is a feature; 1: the wrench is NaN or at its limit: all is
            held; 2: no feature, for the tool is free or does not slide.

    Args: knowledge, the modes of an earlier trial.
    Source: CC section 3.2, eq. 7, algorithm 1.
    """

    def __init__(
        self,
        config: ModeDetectorConfig,
        knowledge: ModeTable | None = None,
        period_sec: float = 0.005,
        offset_sec: float = 0.0,
    ):
        """Raises: ValueError for a setting out of its range, and for knowledge of
        another feature or threshold."""
        super().__init__()
        check_settings(config)
        check_times("ModeDetector", period_sec, offset_sec)
        self._tuning = _checked(config, period_sec)
        table = no_modes(self._tuning.n_features, self._tuning.threshold)
        if knowledge is not None:
            given = (knowledge.centroids.shape[1], knowledge.threshold)
            if given != (self._tuning.n_features, self._tuning.threshold):
                raise ValueError(
                    f"the modes known are of {given[0]} features and threshold "
                    f"{given[1]}, expected {self._tuning.n_features} and "
                    f"{self._tuning.threshold}"
                )
            table = knowledge
        first_call(warm_up, self._tuning)
        self._ports = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("wrench", 6),
                ("ee_velocity", 6),
                ("direction", 3),
                ("force_directions", 6),
            )
        ]
        self._hint = self.DeclareVectorInputPort("mode_hint", 1)
        self._touch_hint = self.DeclareVectorInputPort("touch_hint", 1)
        self._memory = self.DeclareAbstractState(Value(ModeMemory(table)))
        ticket = {self.abstract_state_ticket(self._memory)}
        for name, size, value in (
            ("mode", 1, lambda m: [m.mode]),
            ("confidence", 2, lambda m: m.confidence),
            ("is_new", 1, lambda m: [m.is_new]),
            ("transition", N_TRANSITION, lambda m: m.transition),
            ("touch_mode", N_TOUCH_MODE, lambda m: m.touch_mode),
            ("collecting", 1, lambda m: [m.collecting]),
            ("undecided", 1, lambda m: [m.undecided]),
            ("status", 1, lambda m: [m.status]),
        ):
            self.DeclareVectorOutputPort(name, size, self._calc(value), ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    def knowledge(self, context: Context) -> ModeTable:
        """The modes that it knows by now, for the next trial."""
        return self._memory_of(context).table

    @timed
    def _update(self, context: Context, state):
        hints = [
            port.Eval(context)[0] if port.HasValue(context) else UNKNOWN_MODE
            for port in (self._hint, self._touch_hint)
        ]
        wrench, velocity, direction, rows = [p.Eval(context) for p in self._ports]
        memory = detect(
            self._memory_of(context),
            self._tuning,
            context.get_time(),
            wrench,
            velocity,
            direction,
            rows,
            *hints,
        )
        state.get_mutable_abstract_state(self._memory).set_value(memory)

    def _memory_of(self, context: Context) -> ModeMemory:
        return context.get_abstract_state(self._memory).get_value()

    def _calc(self, value):
        def calc(context: Context, output: BasicVector):
            numbers = value(self._memory_of(context))
            output.SetFromVector(np.array(numbers, dtype=float))

        return calc


def _checked(config: ModeDetectorConfig, period_sec: float) -> ModeTuning:
    c = config
    for name, least in (
        ("threshold", np.nextafter(0.0, 1.0)),
        ("crossing", 0.0),
        ("force_noise", 0.0),
        ("normal_force_min", np.nextafter(0.0, 1.0)),
        ("torque_arm", 0.0),
        ("tool_mass", 0.0),
        ("wrench_limit", np.nextafter(0.0, 1.0)),
    ):
        if not least <= getattr(c, name) < np.inf:
            bound = "a positive number" if least else "a number of 0 or more"
            raise ValueError(f"{name} is {getattr(c, name)}, expected {bound}")
    if c.batch != int(c.batch) or not 6 <= c.batch <= 60:
        raise ValueError(f"batch is {c.batch}, expected a whole number from 6 to 60")
    if not 0.0 < period_sec <= 0.02:
        raise ValueError(
            f"period_sec is {period_sec}, expected a time of 0.02 s or less"
        )
    return ModeTuning(
        threshold=float(c.threshold),
        force_noise=float(c.force_noise),
        crossing=float(c.crossing),
        batch=int(c.batch),
        normal_force_min=float(c.normal_force_min),
        torque_arm=float(c.torque_arm),
        tool_mass=float(c.tool_mass),
        period=float(period_sec),
        wrench_limit=float(c.wrench_limit),
    )
