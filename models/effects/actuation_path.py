"""What lies between a model's commands and its joints, when it is not nothing."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, InputPort, LeafSystem, OutputPort

GAIN, BIAS, LIMIT, TIME_CONSTANT = range(4)
NO_LIMIT = 1e30  # [N m]
# What a kind of effect may name as its step: (parameter, its row in the numbers).
STEPS = {
    "gain": ("gain", GAIN),
    "bias": ("bias", BIAS),
    "saturation": ("limit", LIMIT),
    "lag": ("time_constant", TIME_CONSTANT),
    "delay": ("delay", None),
}


@dataclass
class Drive:
    """Position control in the drive itself, an entry for each actuator.

    driven: which actuators it drives; the others get no effort.
    position, velocity: where each joint's are in the plant's state.
    offset: what the joint's encoder adds to its position [rad] or [m].
    """

    kp: np.ndarray
    kd: np.ndarray
    driven: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    offset: np.ndarray


@dataclass(eq=False)
class PathPorts:
    """A model's actuation path and its ports. position_command, velocity_command: with
    a drive; command: without one. effort: of the motors; nominal: before gain and
    bias. systems: the path, and before it what delays its commands."""

    path: "ActuationPath"
    command: InputPort | None = None
    position_command: InputPort | None = None
    velocity_command: InputPort | None = None
    effort: OutputPort | None = None
    nominal: OutputPort | None = None
    systems: list = field(default_factory=list)


class ActuationPath(LeafSystem):
    """Command to effort, for the actuators of one model in their order.

        effort = lag(clip(gain x commanded + bias, +-limit))
        commanded = command, or with a drive
                    kp (position_command - position) + kd (velocity_command - velocity)

    The lag is of first order. In a discrete plant it steps with the plant, exact for a
    held command. What is not connected is zero.

    Inputs:  command (n,) [N m]; or position_command (n,), velocity_command (n,) and
             state (n_x,) of the plant.
    Outputs: effort (n,) of the motors; nominal (n,) = commanded; joint_effort (n,): the
             effort, 0 where a motor moves the joint through an elastic element;
             motor_effort_<i> (1,): the effort of actuator i if it is such a one.

    Numeric parameter 0 of the Context: gain (n,), bias (n,), limit (n,), time_constant
    (n,) in a row.

    Args: numbers: (4, n); time_step: of the plant [s], 0: continuous; drive: or None;
        n_x: size of the plant's state; elastic: which actuators act through an elastic
        element.
    """

    def __init__(
        self, numbers, time_step: float, drive: Drive | None, n_x: int, elastic
    ):
        super().__init__()
        numbers = np.asarray(numbers, dtype=float)
        self._n, self._drive, self._dt = numbers.shape[1], drive, time_step
        self._elastic = np.array(elastic, dtype=bool)
        self._numbers = self.DeclareNumericParameter(BasicVector(numbers.ravel()))
        n = self._n
        if drive is None:
            self._command = self.DeclareVectorInputPort("command", n)
        else:
            self._positions = self.DeclareVectorInputPort("position_command", n)
            self._velocities = self.DeclareVectorInputPort("velocity_command", n)
            self._state = self.DeclareVectorInputPort("state", n_x)
        # A lag that is there when the path is built may have its time changed later.
        self._lags = bool((numbers[TIME_CONSTANT] > 0.0).any())
        if self._lags and time_step == 0.0:
            self._lagged = self.DeclareContinuousState(n)
        elif self._lags:
            self._lagged = self.DeclareDiscreteState(n)
            self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._step)
        self.DeclareVectorOutputPort("effort", n, self._calc_effort)
        self.DeclareVectorOutputPort("nominal", n, self._calc_nominal)
        self.DeclareVectorOutputPort("joint_effort", n, self._calc_joint_effort)
        for i in np.flatnonzero(self._elastic):
            self.DeclareVectorOutputPort(
                f"motor_effort_{i}",
                1,
                lambda context, output, i=i: output.SetFromVector(
                    self._effort(context)[i : i + 1]
                ),
            )

    @property
    def has_lags(self) -> bool:
        return self._lags

    def set_numbers(self, context, numbers) -> None:
        """New numbers (4, n) in a Context of this system.

        Raises: ValueError if a lag is new: that takes a new path.
        """
        numbers = np.asarray(numbers, dtype=float)
        if not self._lags and (numbers[TIME_CONSTANT] > 0.0).any():
            raise ValueError("the path was built without a lag")
        context.get_mutable_numeric_parameter(self._numbers).SetFromVector(
            numbers.ravel()
        )

    def set_lagged(self, context, effort) -> None:
        """Where the lag starts from, (n,) [N m]."""
        if self._lags and self._dt == 0.0:
            context.SetContinuousState(effort)
        elif self._lags:
            context.SetDiscreteState(self._lagged, effort)

    def unlagged(self, context) -> np.ndarray:
        """(n,): gain, bias and limit on what is commanded."""
        p = context.get_numeric_parameter(self._numbers).value()
        p = p.reshape(4, self._n)
        effort = p[GAIN] * self._commanded(context) + p[BIAS]
        return np.clip(effort, -p[LIMIT], p[LIMIT])

    def _commanded(self, context) -> np.ndarray:
        drive = self._drive
        if drive is None:
            port = self._command
            return port.Eval(context) if port.HasValue(context) else np.zeros(self._n)
        x = self._state.Eval(context)
        effort = np.zeros(self._n)
        if self._positions.HasValue(context):
            position = x[drive.position] + drive.offset
            effort += drive.kp * (self._positions.Eval(context) - position)
        v_command = (
            self._velocities.Eval(context) if self._velocities.HasValue(context) else 0
        )
        effort += drive.kd * (v_command - x[drive.velocity])
        return np.where(drive.driven, effort, 0.0)

    def _effort(self, context) -> np.ndarray:
        if not self._lags:
            return self.unlagged(context)
        T = context.get_numeric_parameter(self._numbers).value()[3 * self._n :]
        if self._dt == 0.0:
            lagged = context.get_continuous_state_vector().CopyToVector()
        else:
            lagged = context.get_discrete_state(self._lagged).value()
        return np.where(T > 0.0, lagged, self.unlagged(context))

    def DoCalcTimeDerivatives(self, context, derivatives):
        if not (self._lags and self._dt == 0.0):
            return
        T = context.get_numeric_parameter(self._numbers).value()[3 * self._n :]
        y = context.get_continuous_state_vector().CopyToVector()
        rate = (self.unlagged(context) - y) / np.where(T > 0.0, T, 1.0)
        derivatives.get_mutable_vector().SetFromVector(np.where(T > 0.0, rate, 0.0))

    def _step(self, context, discrete_state):
        T = context.get_numeric_parameter(self._numbers).value()[3 * self._n :]
        keep = np.where(T > 0.0, np.exp(-self._dt / np.where(T > 0.0, T, 1.0)), 0.0)
        y = context.get_discrete_state(self._lagged).value()
        discrete_state.set_value(
            self._lagged, keep * y + (1.0 - keep) * self.unlagged(context)
        )

    def _calc_effort(self, context, output):
        output.SetFromVector(self._effort(context))

    def _calc_nominal(self, context, output):
        output.SetFromVector(self._commanded(context))

    def _calc_joint_effort(self, context, output):
        output.SetFromVector(np.where(self._elastic, 0.0, self._effort(context)))
