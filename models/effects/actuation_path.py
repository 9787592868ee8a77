"""The path from a model's commands to its joints, if effects or drives lie on it."""

from dataclasses import dataclass, field, fields, replace

import numpy as np
from pydrake.systems.framework import BasicVector, InputPort, LeafSystem, OutputPort

GAIN, BIAS, LIMIT, TIME_CONSTANT, KP, SHARE = range(6)
ROWS = 6
NO_LIMIT = 1e30  # [N m]
# Rate at which a drive may stop a joint of a continuous plant [1/s], so that the
# integrator can follow it. Twice this rate is refused.
FASTEST = 2000.0
OWN = -1.0  # As KP: the drive's own gain.
# Steps on the path (EffectKind.path): (parameter, its row in the numbers).
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
    """The control law of a drive, for arrays:

        effort = clip(kp band(p_command - p) + kd (v_command - v), +-limit) - emf v

    with p_command rounded to steps of `resolution` (0: not rounded); band(e) is e
    reduced by the dead band; emf = kt^2/R is the motor's back-EMF, by which the largest
    effort falls with speed. SI units of a revolute or prismatic joint.
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
        """The law with other gains, where they are not OWN."""
        own = np.equal(kp, OWN)
        return self if np.all(own) else replace(self, kp=np.where(own, self.kp, kp))

    def received(self, p_command):
        """The position command, rounded to the drive's resolution."""
        r = self.resolution
        if not np.any(r):
            return p_command
        step = np.where(np.greater(r, 0.0), r, 1.0)
        return np.where(
            np.greater(r, 0.0), np.round(p_command / step) * step, p_command
        )

    def effort(self, p_error, v_command, v):
        """The drive's effort. Args: p_error: received position command minus position;
        0 for a drive without a position loop."""
        e = np.sign(p_error) * np.maximum(np.abs(p_error) - self.dead_band, 0.0)
        u = self.kp * e + self.kd * (v_command - v)
        return np.clip(u, -self.limit, self.limit) - self.emf * v


def slowed(effort, share, direction):
    """The effort tau behind a gear with load friction: effort = tau + share |tau|
    direction. Args: direction: of the motion, -1 to 1."""
    return effort / (1.0 + share * direction * np.sign(effort))


@dataclass
class Drive:
    """Drives with a control loop, with an entry for each actuator.

    takes: their commands: position_command, velocity_command, or both.
    driven: which actuators they drive; the others get no effort.
    position, velocity: indices of the joints in the plant's state.
    offset: of the joints' encoders [rad] or [m].
    """

    law: DriveLaw
    takes: tuple[str, ...]
    driven: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    offset: np.ndarray


@dataclass
class Gear:
    """Gears with load friction, with an entry for each actuator.

    velocity: indices of the motors' velocities in the plant's state. slow: speed below
    which friction fades [rad/s]; or below `step` times the friction, if that is larger
    (2 dt/J in a discrete plant).
    """

    velocity: np.ndarray
    slow: np.ndarray
    step: np.ndarray


@dataclass(eq=False)
class PathPorts:
    """A model's actuation path and its ports: position_command, velocity_command with a
    drive, command without; effort of the motors; nominal, the effort before gain and
    bias. systems: the delays of its commands, and the path."""

    path: "ActuationPath"
    command: InputPort | None = None
    position_command: InputPort | None = None
    velocity_command: InputPort | None = None
    effort: OutputPort | None = None
    nominal: OutputPort | None = None
    systems: list = field(default_factory=list)


class ActuationPath(LeafSystem):
    """Efforts from commands, for the actuators of one model in their order.

        effort = lag(clip(gain x commanded + bias, +-limit))
        commanded = command, or the output of the drive's law

    The lag is of first order. In a discrete plant it steps with the plant and is exact
    for a held command. Unconnected inputs are zero. A gear with load friction reduces
    the effort on the joint.

    Inputs:  command (n,) [N m]; or position_command (n,), velocity_command (n,) of a
             drive; state (n_x,) of the plant, with a drive or a gear.
    Outputs: effort (n,): of the motors; nominal (n,) = commanded; joint_effort (n,):
             the effort behind the gear, 0 for a motor that moves its joint through an
             elastic element; motor_effort_<i> (1,): the effort behind the gear of such
             an actuator i.

    Numeric parameter 0 of the Context: the numbers, row by row: gain, bias, limit, time
    constant, kp (OWN: the drive's), load friction as fraction of the load.

    Args: numbers (ROWS, n); time_step: of the plant [s], 0: continuous; drive: None
        without a loop; n_x: size of the plant's state; elastic (n,): which actuators
        act through an elastic element; gear: None without load friction.
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
        # A lag has a state, so only a path that is built with one can change it later.
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
                    self._behind_gear(context)[i : i + 1]
                ),
            )

    @property
    def has_lags(self) -> bool:
        return self._lags

    @property
    def has_gear(self) -> bool:
        return self._gear is not None

    def set_numbers(self, context, numbers) -> None:
        """Sets the numbers (ROWS, n) in a Context of this system.

        Raises: ValueError for a lag or a load friction that the path was built without.
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
        """Sets the state of the lag (n,) [N m]."""
        if self._lags and self._dt == 0.0:
            context.SetContinuousState(effort)
        elif self._lags:
            context.SetDiscreteState(self._lagged, effort)

    def unlagged(self, context) -> np.ndarray:
        """The effort (n,) before the lag: gain, bias and limit of the commanded one."""
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
        commands = {
            name: port.Eval(context)
            for name, port in self._commands.items()
            if port.HasValue(context)
        }
        error = np.zeros(self._n)
        if "position_command" in commands:
            position = x[drive.position] + drive.offset
            error = law.received(commands["position_command"]) - position
        v_command = commands.get("velocity_command", 0.0)
        effort = law.effort(error, v_command, x[drive.velocity])
        return np.where(drive.driven, effort, 0.0)

    def _behind_gear(self, context) -> np.ndarray:
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
        output.SetFromVector(np.where(self._elastic, 0.0, self._behind_gear(context)))
