"""What lies between a model's commands and its joints, when it is not nothing."""

from dataclasses import dataclass, field, fields, replace

import numpy as np
from pydrake.systems.framework import BasicVector, InputPort, LeafSystem, OutputPort

GAIN, BIAS, LIMIT, TIME_CONSTANT, KP, SHARE = range(6)
ROWS = 6
NO_LIMIT = 1e30  # [N m]
# A drive should stop a joint no faster than so [1/s]: a continuous plant's integrator
# follows it. Twice as fast is refused.
FASTEST = 2000.0
OWN = -1.0  # As a KP: the drive's own.
# What a kind of effect may name as its step: (parameter, its row in the numbers).
STEPS = {
    "gain": ("gain", GAIN),
    "bias": ("bias", BIAS),
    "saturation": ("limit", LIMIT),
    "lag": ("time_constant", TIME_CONSTANT),
    "delay": ("delay", None),
    "kp": ("kp", KP),
    "load friction": ("share", SHARE),
}


@dataclass(frozen=True, eq=False)
class DriveLaw:
    """What a drive makes of a command, entry by entry:

        effort = clip(kp band(p_command - p) + kd (v_command - v), +-limit) - emf v

    p_command to the nearest step of `resolution`, if that is not 0; band(e) is e less
    the dead band, 0 within it; emf = kt^2/R: what a motor at a supply loses by turning.
    So its ceiling falls with speed. SI units of a joint that turns, or slides.
    """

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    emf: np.ndarray
    dead_band: np.ndarray
    resolution: np.ndarray

    def __getitem__(self, i) -> "DriveLaw":
        return DriveLaw(*(getattr(self, each.name)[i] for each in fields(self)))

    def with_kp(self, kp) -> "DriveLaw":
        """With other gains, where they are not OWN."""
        return replace(self, kp=np.where(np.equal(kp, OWN), self.kp, kp))

    def received(self, p_command):
        """The position command as the drive has it."""
        r = self.resolution
        step = np.where(np.greater(r, 0.0), r, 1.0)
        return np.where(
            np.greater(r, 0.0), np.round(p_command / step) * step, p_command
        )

    def effort(self, p_error, v_command, v):
        """p_error: of the position command as received, 0 for a drive without one."""
        e = np.sign(p_error) * np.maximum(np.abs(p_error) - self.dead_band, 0.0)
        u = self.kp * e + self.kd * (v_command - v)
        return np.clip(u, -self.limit, self.limit) - self.emf * v


def slowed(effort, share, direction):
    """What a gear lets through of an effort, if it loses a share of that: with tau let
    through, effort = tau + share |tau| direction. direction: of the motion, -1 to 1."""
    return effort / (1.0 + share * direction * np.sign(effort))


@dataclass
class Drive:
    """A loop in the drive itself, an entry for each actuator.

    takes: the commands, of position_command, velocity_command.
    driven: which actuators it drives; the others get no effort.
    position, velocity: where each joint's are in the plant's state.
    offset: what the joint's encoder adds to its position [rad] or [m].
    """

    law: DriveLaw
    takes: tuple[str, ...]
    driven: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    offset: np.ndarray


@dataclass
class Gear:
    """Where friction that goes with the load fades, an entry for each actuator.

    velocity: where each motor's is in the plant's state. slow [rad/s]: dry friction
    fades below it, or below `step` times the friction (2 dt/J in a discrete plant).
    """

    velocity: np.ndarray
    slow: np.ndarray
    step: np.ndarray


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
        commanded = command, or with a drive what its law makes of the commands

    The lag is of first order. In a discrete plant it steps with the plant, exact for a
    held command. What is not connected is zero. A gear whose friction goes with the
    load lets less through to the joint.

    Inputs:  command (n,) [N m]; or position_command (n,) and velocity_command (n,), as
             the drive takes them; state (n_x,) of the plant with a drive or a gear.
    Outputs: effort (n,) of the motors; nominal (n,) = commanded; joint_effort (n,):
             what the gear lets through of the effort, 0 where a motor moves the joint
             through an elastic element; motor_effort_<i> (1,): the same of actuator i
             if it is such a one.

    Numeric parameter 0 of the Context: the numbers row by row: gain, bias, limit, time
    constant, kp (OWN: the drive's), share of the load that is friction.

    Args: numbers: (ROWS, n); time_step: of the plant [s], 0: continuous; drive: or
        None; n_x: size of the plant's state; elastic: which actuators act through an
        elastic element; gear: None if none loses a share.
    """

    def __init__(
        self,
        numbers,
        time_step: float,
        drive: Drive | None,
        n_x: int,
        elastic,
        gear: Gear | None = None,
    ):
        super().__init__()
        numbers = np.asarray(numbers, dtype=float)
        self._n, self._drive, self._dt = numbers.shape[1], drive, time_step
        self._gear = gear
        self._elastic = np.array(elastic, dtype=bool)
        self._numbers = self.DeclareNumericParameter(BasicVector(numbers.ravel()))
        n = self._n
        if drive is None:
            self._command = self.DeclareVectorInputPort("command", n)
        else:
            self._commands = {
                name: self.DeclareVectorInputPort(name, n) for name in drive.takes
            }
        if drive is not None or gear is not None:
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
                    self._let_through(context)[i : i + 1]
                ),
            )

    @property
    def has_lags(self) -> bool:
        return self._lags

    @property
    def has_gear(self) -> bool:
        return self._gear is not None

    def set_numbers(self, context, numbers) -> None:
        """New numbers (ROWS, n) in a Context of this system.

        Raises: ValueError if a lag or a gear is new: that takes a new path.
        """
        numbers = np.asarray(numbers, dtype=float)
        if not self._lags and (numbers[TIME_CONSTANT] > 0.0).any():
            raise ValueError("the path was built without a lag")
        if self._gear is None and numbers[SHARE].any():
            raise ValueError("the path was built without a gear that loses a share")
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
        p = self._rows(context)
        effort = p[GAIN] * self._commanded(context) + p[BIAS]
        return np.clip(effort, -p[LIMIT], p[LIMIT])

    def _rows(self, context) -> np.ndarray:
        p = context.get_numeric_parameter(self._numbers).value()
        return p.reshape(ROWS, self._n)

    def _commanded(self, context) -> np.ndarray:
        drive = self._drive
        if drive is None:
            port = self._command
            return port.Eval(context) if port.HasValue(context) else np.zeros(self._n)
        x = self._state.Eval(context)
        law = drive.law.with_kp(self._rows(context)[KP])
        told = {
            name: port.Eval(context)
            for name, port in self._commands.items()
            if port.HasValue(context)
        }
        error = np.zeros(self._n)
        if "position_command" in told:
            position = x[drive.position] + drive.offset
            error = law.received(told["position_command"]) - position
        v_command = told.get("velocity_command", 0.0)
        effort = law.effort(error, v_command, x[drive.velocity])
        return np.where(drive.driven, effort, 0.0)

    def _let_through(self, context) -> np.ndarray:
        effort, gear = self._effort(context), self._gear
        if gear is None:
            return effort
        share = self._rows(context)[SHARE]
        v = self._state.Eval(context)[gear.velocity]
        fade = np.maximum(gear.slow, gear.step * share * np.abs(effort))
        return slowed(effort, share, np.tanh(v / fade))

    def _effort(self, context) -> np.ndarray:
        if not self._lags:
            return self.unlagged(context)
        T = self._rows(context)[TIME_CONSTANT]
        if self._dt == 0.0:
            lagged = context.get_continuous_state_vector().CopyToVector()
        else:
            lagged = context.get_discrete_state(self._lagged).value()
        return np.where(T > 0.0, lagged, self.unlagged(context))

    def DoCalcTimeDerivatives(self, context, derivatives):
        if not (self._lags and self._dt == 0.0):
            return
        T = self._rows(context)[TIME_CONSTANT]
        y = context.get_continuous_state_vector().CopyToVector()
        rate = (self.unlagged(context) - y) / np.where(T > 0.0, T, 1.0)
        derivatives.get_mutable_vector().SetFromVector(np.where(T > 0.0, rate, 0.0))

    def _step(self, context, discrete_state):
        T = self._rows(context)[TIME_CONSTANT]
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
        output.SetFromVector(np.where(self._elastic, 0.0, self._let_through(context)))
