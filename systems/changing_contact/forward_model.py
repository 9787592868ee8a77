"""Forward models of the contact modes: see numerics/forward_model.py."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import (
    COUNT,
    FREE_MODE,
    N_TRANSITION,
    UNKNOWN_MODE,
)
from makebreak.systems.changing_contact.numerics.forward_model import (
    BankMemory,
    BankTuning,
    ModelBank,
    bank_tuning,
    observe,
    speed_along,
    warm_up,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings, check_times
from makebreak.systems.numerics.timing import timed

# From the reference to the arm: half of this period, a tick, and the filter of what is
# fed forward [s].
LEAD_SEC = 0.008


@dataclass
class HandoverConfig:
    """How the model of a mode that was announced takes over."""

    # Time for which an announced mode's model predicts without the last force, which is
    # still the old mode's [s]; 0: it predicts as any other.
    duration_sec: float = 0.05
    # Distance along the motion of the two rows of feet on which the tool stands [m]; 0:
    # it touches with one point. In surface_switch the tool sets it.
    rows: float = 0.0
    # Height of the tip above these feet, with which the moment tells how much of the
    # load each row carries [m]; 0: half. In surface_switch the tool sets it.
    height: float = 0.0
    # Whether the friction of a motion from rest is predicted from its commanded speed,
    # the normal force and the mode (in an unknown mode: as the last force); an
    # announced mode then has the friction of the present normal force.
    from_rest: bool = False


@dataclass
class ForwardModelConfig:
    """Settings of ForwardModelBank."""

    # Whether the models have |w| and |tau| too; false: |v| and |F_t| alone.
    with_torque: bool = True
    # Whether the models learn; false: they stay as they are given, the fixed GMM.
    learns: bool = True
    # Whether each mode has its own model; false: one model for all, which shows what
    # modes are worth (CC 3.2).
    per_mode: bool = True
    # Weight of the newest sample in the low-passed prediction error; 1: no filter.
    smoothing: float = 0.3
    # Weight of the newest sample in the mean of a model's recent errors, which is added
    # to its prediction; 0: nothing is added.
    correction: float = 0.05
    # Likelihood, relative to a component's peak, below which a sample makes a new
    # component of the mixture.
    tau_nov: float = 1e-3
    # Force or moment at which the sensor saturates [N], [N m].
    wrench_limit: float = 200.0
    # Prediction error that is reported where the wrench cannot be used [N].
    error_unknown: float = 10.0
    handover: HandoverConfig = field(default_factory=HandoverConfig)


class ForwardModelBank(LeafSystem):
    """Predicts the wrench on the tool one sample ahead, with one model per mode.

    Inputs:
        wrench (6,) measured on the tool at its tip, world axes, force first [N], [N m].
        ee_velocity (6,) of the tip, v [m/s], w [rad/s].
        direction (3,) unit vector of the target motion, zero at rest.
        force_directions (6,) two rows n, pressed along; a zero row: none.
        mode (1,) of the mode detector; a mode seen first gets a new model.
        transition (6,) optional, of the mode detector: a mode that changes without a
            new count there was announced, and its model is handed over.
        x_desired (19,) optional, of the reference, for handover.from_rest.
        undecided (1,) optional, 1 while the mode may be another one: meanwhile the
            friction of the mode is not learned.

    Outputs, all of them state:
        wrench_predicted (6,) on the tool, against the motion [N], [N m]; zero in
            FREE_MODE and UNKNOWN_MODE, and without a usable wrench.
        handing_over (1,) 1 while a model that was announced takes over, and while the
            friction of a motion that begins is predicted from its command.
        prediction_error (1,) |error of the last predictions of |F_t||, low-passed [N].
        status (1,) 0: a model predicts; 1: the wrench is NaN or at its limit; 2: the
            mode is one without a model.

    Args: knowledge, of an earlier trial. Source: CC section 3.1, eq. 2, 3, 6.
    """

    def __init__(
        self,
        config: ForwardModelConfig,
        knowledge: ModelBank | None = None,
        period_sec: float = 0.005,
        offset_sec: float = 0.0,
    ):
        """Raises: ValueError for a setting out of its range, and for knowledge over
        other entries or of another number of components."""
        super().__init__()
        check_settings(config)
        check_times("ForwardModelBank", period_sec, offset_sec)
        for name in ("wrench_limit", "error_unknown"):
            if not 0.0 < getattr(config, name) < np.inf:
                raise ValueError(
                    f"{name} is {getattr(config, name)}, expected a positive number"
                )
        if not 0.0 < config.smoothing <= 1.0:
            raise ValueError(
                f"smoothing is {config.smoothing}, expected a number in (0, 1]"
            )
        if not 0.0 <= config.correction < 1.0:
            raise ValueError(
                f"correction is {config.correction}, expected a number in [0, 1)"
            )
        for name in ("duration_sec", "rows", "height"):
            if not 0.0 <= getattr(config.handover, name) < np.inf:
                raise ValueError(
                    f"handover.{name} is {getattr(config.handover, name)}, expected a "
                    "number of 0 or more"
                )
        self._tuning = BankTuning(
            mixtures=bank_tuning(config.with_torque, tau_nov=config.tau_nov),
            with_torque=bool(config.with_torque),
            learns=bool(config.learns),
            smoothing=float(config.smoothing),
            correction=float(config.correction),
            wrench_limit=float(config.wrench_limit),
            error_unknown=float(config.error_unknown),
            handover=round(config.handover.duration_sec / period_sec),
            rows=float(config.handover.rows),
            height=float(config.handover.height),
            period=float(period_sec),
            from_rest=bool(config.handover.from_rest),
        )
        mixtures = self._tuning.mixtures
        shape = (mixtures.n_max, mixtures.sigma_ini.size)
        for mode, mixture in knowledge.models if knowledge else ():
            if mixture.mean.shape != shape:
                raise ValueError(
                    f"the model of mode {mode} has {mixture.mean.shape[0]} components "
                    f"over {mixture.mean.shape[1]} entries, expected {shape[0]} over "
                    f"{shape[1]}"
                )
        self._per_mode = bool(config.per_mode)
        first_call(warm_up, self._tuning)
        self._ports = [
            self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("wrench", 6),
                ("ee_velocity", 6),
                ("direction", 3),
                ("force_directions", 6),
                ("mode", 1),
            )
        ]
        self._transition = self.DeclareVectorInputPort("transition", N_TRANSITION)
        self._desired = self.DeclareVectorInputPort("x_desired", 19)
        self._undecided = self.DeclareVectorInputPort("undecided", 1)
        empty = ModelBank((), self._tuning.with_torque)
        self._memory = self.DeclareAbstractState(Value(BankMemory(knowledge or empty)))
        ticket = {self.abstract_state_ticket(self._memory)}
        for name, size, calc in (
            ("wrench_predicted", 6, self._calc_wrench),
            ("prediction_error", 1, self._calc_error),
            ("handing_over", 1, self._calc_handing_over),
            ("status", 1, self._calc_status),
        ):
            self.DeclareVectorOutputPort(name, size, calc, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    def knowledge(self, context: Context) -> ModelBank:
        """What it has learned so far, for the next trial."""
        return self._memory_of(context).bank

    @timed
    def _update(self, context: Context, state):
        wrench, velocity, direction, rows, mode = [
            port.Eval(context) for port in self._ports
        ]
        number = int(mode[0]) if np.isfinite(mode[0]) else UNKNOWN_MODE
        changes = None
        if not self._per_mode:
            number = number if number == FREE_MODE else 1  # Nothing has to be told.
        elif self._transition.HasValue(context):
            changes = float(self._transition.Eval(context)[COUNT])
        speed, undecided = 0.0, False
        if self._desired.HasValue(context):
            speed = speed_along(self._desired.Eval(context), direction, LEAD_SEC)
        if self._per_mode and self._undecided.HasValue(context):
            undecided = bool(self._undecided.Eval(context)[0] > 0.5)
        memory = observe(
            self._memory_of(context),
            self._tuning,
            wrench,
            velocity,
            direction,
            rows,
            number,
            changes,
            speed,
            undecided,
        )
        state.get_mutable_abstract_state(self._memory).set_value(memory)

    def _memory_of(self, context: Context) -> BankMemory:
        return context.get_abstract_state(self._memory).get_value()

    def _calc_wrench(self, context: Context, output: BasicVector):
        output.SetFromVector(self._memory_of(context).wrench)

    def _calc_error(self, context: Context, output: BasicVector):
        output.SetFromVector([self._memory_of(context).error])

    def _calc_handing_over(self, context: Context, output: BasicVector):
        output.SetFromVector([float(self._memory_of(context).ahead)])

    def _calc_status(self, context: Context, output: BasicVector):
        output.SetFromVector([float(self._memory_of(context).status)])
