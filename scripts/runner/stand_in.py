"""`makebreak station`: a simulated robot behind LCM, to try `run --robot lcm` with.

It simulates arm, ball, table and camera, and behaves like drake-franka-driver: it sends
a status each millisecond; it refuses commands whose time stamp is more than EXPIRE_SEC
off, that are not torque commands, or that hold a NaN; without a fresh command the
torque falls back to damping. It compensates gravity, and joint_torque_external has the
opposite of libfranka's sign.

With a rate below 1 its clock, from which all time stamps come, is slower than the wall
clock by that factor: both sides then have more time for each millisecond.
"""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from time import monotonic, sleep, time

import numpy as np
from drake import lcmt_panda_command
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageToLcmImageArrayT, PixelType

from makebreak.diagrams.ball_rolling import make_world
from makebreak.diagrams.ball_rolling_config import BallRollingConfig
from makebreak.diagrams.lcm_station import (
    COMMAND,
    IMAGES,
    IMAGES_PORT,
    STATUS,
    TORQUE_MODE,
    Messages,
    empty_status,
)
from makebreak.diagrams.scene_facts import N_JOINTS
from makebreak.diagrams.station import (
    ARM,
    TIP_FRAME,
    TORQUE_RATE_MAX,
    make_control_plant,
)
from makebreak.systems.arm.gravity_left_out import gravity_torque
from makebreak.systems.arm.impedance_controller import serial_chain_of

TICK = 0.001  # [s]
EXPIRE_SEC = 0.1
MOVING = 2  # libfranka's robot mode kMove.
DAMPING = np.array([20.0, 20.0, 20.0, 20.0, 5.0, 5.0, 5.0])  # [N m s/rad]
BEHIND_SEC = 0.05  # Lag behind its clock that is made up for; more is dropped [s].


@dataclass
class StandInConfig:
    """How the stand-in of a robot runs and what its network does."""

    rate: float = 1.0  # Simulated seconds per second, at most 1.
    drop: float = 0.0  # Probability that a message is lost, in both directions.
    delay_sec: float = 0.0  # Delay of the messages it sends, on its own clock.
    url: str = ""


@dataclass
class StandInReport:
    """Statistics of a run on the driver's side."""

    ticks: int = 0
    damped: int = 0  # Ticks without a fresh command.
    received: int = 0
    refused: dict[str, int] = field(default_factory=dict)  # {reason: commands}
    # Ages of the latest accepted commands.
    age_sec: deque[float] = field(default_factory=lambda: deque(maxlen=100_000))
    steps_too_large: int = 0  # Torques that had to be limited to the rate.
    slipped_sec: float = 0.0  # Time by which it fell behind its rate [s].
    joint_speed_share_max: float = 0.0

    def result(self) -> dict:
        ms = 1e3 * np.array(self.age_sec or [np.nan])
        return {
            "simulated_s": self.ticks * TICK,
            "damped_share": self.damped / max(self.ticks, 1),
            "commands_received": self.received,
            "commands_refused": sum(self.refused.values()),
            **{f"refused_{why}": n for why, n in sorted(self.refused.items())},
            "age_p50_ms": float(np.percentile(ms, 50)),
            "age_p99_ms": float(np.percentile(ms, 99)),
            "steps_too_large": self.steps_too_large,
            "joint_speed_share_max": self.joint_speed_share_max,
            "behind_s": self.slipped_sec,
        }


class Driver:
    """Checks commands and computes the torque. Each call has the time, epoch [us]."""

    def __init__(self, report: StandInReport):
        self._report = report
        self._command: tuple[int, np.ndarray] | None = None
        self._torque = np.zeros(N_JOINTS)

    def receive(self, command: lcmt_panda_command, now: int) -> None:
        """Accepts or refuses a command that arrives at `now`."""
        self._report.received += 1
        why = self._fault_of(command, now)
        if why:
            self.refuse(why)
            return
        self._report.age_sec.append(1e-6 * (now - command.utime))
        self._command = command.utime, np.array(command.joint_torque)

    def refuse(self, why: str) -> None:
        """Counts a refused command."""
        self._report.refused[why] = self._report.refused.get(why, 0) + 1

    def _fault_of(self, command: lcmt_panda_command, now: int) -> str:
        if command.control_mode_expected != TORQUE_MODE:
            return "mode"
        if command.num_joint_torque != N_JOINTS:
            return "size"
        if abs(now - command.utime) > EXPIRE_SEC * 1e6:
            return "expired"
        if not np.isfinite(command.joint_torque).all():
            return "not_finite"
        if self._command is not None and command.utime < self._command[0]:
            return "out_of_order"
        return ""

    def torque(self, v, now: int) -> np.ndarray:
        """(7,) [N m] without gravity for the next tick at joint speeds v (7,): that of
        the command while it is fresh, else damping; limited in its rate."""
        if self._command is not None and now - self._command[0] > EXPIRE_SEC * 1e6:
            self._command = None
        if self._command is None:
            self._report.damped += 1
            asked = -DAMPING * v
        else:
            asked = self._command[1]
        step = TORQUE_RATE_MAX * TICK
        change = (asked - self._torque).clip(-step, step)
        if self._command is not None:
            self._report.steps_too_large += int(
                abs(asked - self._torque).max() > step + 1e-6
            )
        self._torque = self._torque + change
        return self._torque.copy()


class StandIn:
    """The simulated robot behind LCM.

    Args: seed: of lost messages; clock: wall clock [s].
    """

    def __init__(
        self,
        world: BallRollingConfig,
        config: StandInConfig,
        seed: int = 0,
        clock: Callable[[], float] = monotonic,
    ):
        self._config, self._clock = config, clock
        self._station = make_world(world)
        self._simulator = Simulator(self._station)
        self._context = self._simulator.get_mutable_context()
        self._in = self._station.GetInputPort(f"{ARM}.torque_commanded")
        self._in.FixValue(self._context, np.zeros(N_JOINTS))
        arm = make_control_plant(world.world)
        self._chain = serial_chain_of(arm, TIP_FRAME)
        self._speed_max = arm.GetVelocityUpperLimits()
        plant = self._station.GetSubsystemByName("plant")
        self._robot = plant.GetModelInstanceByName(ARM)
        self.report = StandInReport()
        self.driver = Driver(self.report)
        self._rng = np.random.default_rng([seed, 31])
        self._lcm = DrakeLcm(config.url)
        self._lcm.Subscribe(COMMAND, self._receive)
        self._wall, self._epoch = clock(), time()
        self._waiting: list[tuple[int, int, str, bytes]] = []  # Due, order, ...
        self._order = count()
        self._film = ImageToLcmImageArrayT(True)
        self._film_in = self._film.DeclareImageInputPort[PixelType.kRgba8U]("overhead")
        self._film_context = self._film.CreateDefaultContext()
        self._messages = Messages()
        self._frame_ticks = round(world.camera.period_sec / TICK * 2)  # Half ticks.
        self._next_frame = 0

    def now(self) -> int:
        """Its clock [us]: epoch time where the rate is 1."""
        gone = (self._clock() - self._wall) * self._config.rate
        return int((self._epoch + gone) * 1e6)

    def _receive(self, data: bytes) -> None:
        if self._rng.random() >= self._config.drop:
            try:
                command = lcmt_panda_command.decode(data)
            except ValueError:
                self.driver.refuse("not_a_command")
            else:
                self.driver.receive(command, self.now())

    def _publish(self, channel: str, data: bytes) -> None:
        if self._rng.random() < self._config.drop:
            return
        if self._config.delay_sec == 0.0:
            self._lcm.Publish(channel, data)
        else:
            due = self.now() + int(self._config.delay_sec * 1e6)
            heapq.heappush(self._waiting, (due, next(self._order), channel, data))

    def _send_due(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.now():
            _, _, channel, data = heapq.heappop(self._waiting)
            self._lcm.Publish(channel, data)

    def _measured(self, name: str) -> np.ndarray:
        return np.array(
            self._station.GetOutputPort(f"{ARM}.{name}").Eval(self._context)
        )

    def tick(self) -> None:
        """One millisecond: the torque, the plant, the status."""
        k = self.report.ticks
        # The driver acts on true values; faults are only in the messages.
        plant = self._station.GetSubsystemByName("plant")
        at, robot = plant.GetMyContextFromRoot(self._context), self._robot
        q, v = plant.GetPositions(at, robot), plant.GetVelocities(at, robot)
        torque = self.driver.torque(v, self.now())
        carrying = gravity_torque(self._chain, q)
        self._in.FixValue(self._context, torque + carrying)
        # To between two steps of the plant, so that the one at k ms has this torque.
        self._simulator.AdvanceTo((k + 0.5) * TICK)
        self.report.ticks += 1
        q, v, felt = (
            self._measured(f"{x}_measured") for x in ("position", "velocity", "torque")
        )
        self.report.joint_speed_share_max = max(
            self.report.joint_speed_share_max, float(np.max(abs(v) / self._speed_max))
        )
        status = empty_status()
        status.utime = self.now()
        status.robot_utime = self.report.ticks * 1000
        status.joint_position, status.joint_velocity = q.tolist(), v.tolist()
        status.joint_torque = felt.tolist()
        status.joint_torque_desired = torque.tolist()
        # The driver inverts libfranka's sign.
        contact = np.array(
            self._station.GetOutputPort(f"{ARM}.contact_torque").Eval(self._context)
        )
        status.joint_torque_external = (-contact).tolist()
        status.control_mode, status.robot_mode = TORQUE_MODE, MOVING
        status.control_command_success_rate = 1.0
        self._publish(STATUS, status.encode())
        if 2 * k >= self._next_frame:
            self._next_frame += self._frame_ticks
            self._publish(IMAGES, self._picture(status.utime))

    def _picture(self, utime: int) -> bytes:
        image = self._station.GetOutputPort("overhead.rgb_image").Eval(self._context)
        self._film_in.FixValue(self._film_context, Value(image))
        self._film_context.SetTime(utime * 1e-6)
        value = self._film.get_output_port().EvalAbstract(self._film_context)
        return self._messages.encode(IMAGES_PORT, value)

    def listen(self) -> None:
        """Receives commands, and sends the messages whose delay is over."""
        self._lcm.HandleSubscriptions(0)
        self._send_due()

    def run(self, duration_sec: float, done=lambda: False) -> None:
        """Runs for `duration_sec` of its own time, or until done() is true."""
        start, rate = self._clock(), self._config.rate
        while self.report.ticks * TICK < duration_sec and not done():
            self.tick()
            due = start + self.report.ticks * TICK / rate
            behind = (self._clock() - due) * rate
            if behind > BEHIND_SEC:
                self.report.slipped_sec += behind
                start += behind / rate
            while True:
                left = due - self._clock()
                self.listen()
                if left <= 0.0:
                    break
                sleep(min(left, 2e-4))
