"""Runs controllers on a robot behind LCM, one step for each status message.

The controllers use the robot's clock: the diagram is advanced to the time stamp of each
status, with the sensor values in it. So a lost or late status only costs its readings,
and the robot may be simulated slower than real time. A command has the time stamp of
the status that it answers, so that the driver can refuse outdated commands.
"""

import sys
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import monotonic, perf_counter

import numpy as np
from drake import lcmt_image_array, lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, OutputPort

from makebreak.diagrams.lcm_station import (
    COMMAND,
    COMMAND_PORT,
    IMAGES,
    IMAGES_PORT,
    STATUS,
    STATUS_PORT,
    TORQUE_MODE,
    Messages,
    empty_status,
    no_images,
)
from makebreak.diagrams.scene_facts import N_JOINTS
from makebreak.diagrams.station import TORQUE_RATE_MAX
from makebreak.scripts.runner.interrupts import CatchInterrupt
from makebreak.scripts.runner.recording_stream import RecordingStream
from makebreak.scripts.runner.session import Log, Session

TICK = 0.001  # Period of the robot [s].
WITHIN = 0.0009  # Time after a tick by which all updates of that tick have run [s].
# Time without a status after which the robot is taken for gone, on the robot's clock,
# which may be slower than ours.
HOLD_SEC = 0.04  # With SPIN_MS, 50 ms.
SPIN_MS = 10
KNOWN_SEC = 0.05  # Time after which the ratio of the clocks can be estimated [s].
CATCH_UP = 50  # Lost ticks up to which the controllers go on; more: a restart.
DELAY_MEMORY_SEC = 1.0  # Time constant in which a large delay is forgotten [s].
PICTURE_SEC = 0.1  # Age above which an image is ignored [s].
FIRST_SEC = 20.0  # Timeout for the first status [s].
GONE_SEC = 120.0  # Timeout without an answered status, after which the run ends [s].
KEPT = 100_000  # Number of latest times in the report.
MOVES = (0, 1, 2)  # libfranka's robot modes in which commands are accepted.


@dataclass
class LoopReport:
    """Statistics of a run on the controllers' side."""

    steps: int = 0  # Commands sent.
    lost: int = 0  # Ticks without a status.
    not_finite: int = 0  # Commands that were not sent, as they are not finite.
    rate_limited: int = 0  # Commands limited to the torque's rate.
    not_read: int = 0  # Messages that are not a Panda's status.
    not_begun: int = 0  # Statuses with positions from which the task cannot start.
    # The latest times from a status to its command, and until the command acts [s].
    compute_sec: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    delay_sec: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    holds_sec: list[float] = field(default_factory=list)  # Durations without status.
    begun: int = 0  # Number of (re)starts of the controllers.

    def result(self) -> dict:
        ms = 1e3 * np.array(self.compute_sec or [np.nan])
        late = 1e3 * np.array(self.delay_sec or [np.nan])
        ticks = max(self.steps + self.lost, 1)
        return {
            "commands_sent": self.steps,
            "statuses_lost_share": self.lost / ticks,
            "status_to_command_p50_ms": float(np.percentile(ms, 50)),
            "status_to_command_p99_ms": float(np.percentile(ms, 99)),
            "status_to_command_max_ms": float(ms.max()),
            "loop_delay_p50_ms": float(np.percentile(late, 50)),
            "loop_delay_p99_ms": float(np.percentile(late, 99)),
            "commands_not_finite": self.not_finite,
            "commands_rate_limited": self.rate_limited,
            "messages_not_read": self.not_read,
            "statuses_not_begun": self.not_begun,
            "holds": len(self.holds_sec),
            "hold_after_ms": [1e3 * each for each in self.holds_sec],
            "beginnings": self.begun,
        }


class LcmLoop:
    """Receives status messages, advances the controllers and sends their commands.

    Args:
        diagram: with a subsystem `station` from make_lcm_station.
        begin: called with the diagram, its root context and the joint positions (n,)
            whenever the controllers start at the robot's present state: at first, and
            after the robot was gone.
        url: of LCM.
        clock: wall clock [s].
    """

    def __init__(
        self,
        diagram: Diagram,
        begin: Callable[[Diagram, Context, np.ndarray], None],
        url: str,
        clock: Callable[[], float] = monotonic,
    ):
        self._diagram, self._begin, self._clock = diagram, begin, clock
        self._station = diagram.GetSubsystemByName("station")
        self._messages = Messages()
        context = diagram.CreateDefaultContext()
        self._fix(context, STATUS_PORT, empty_status().encode())
        self._fix(context, IMAGES_PORT, no_images())
        diagram.GetInputPort("delay").FixValue(context, [0.0])
        self._simulator = Simulator(diagram, context)
        self.context = self._simulator.get_mutable_context()
        self._simulator.Initialize()
        self.report = LoopReport()
        self._lcm = DrakeLcm(url)
        self._newest: dict[str, bytes] = {}
        for channel in (STATUS, IMAGES):
            self._lcm.Subscribe(channel, self._keeper(channel))
        self._tick = -1  # Tick of the diagram.
        self._robot: int | None = None  # The robot's tick that was answered last.
        self._heard = clock()  # Wall time of the last status [s].
        # Wall time [s] and time stamp [us] of a status, from which pace is measured.
        self._since: tuple[float, int] | None = None
        self._robot_utime = 0  # Time stamp of the last status [us].
        self._slowness = 1.0  # Seconds of our clock in one of the robot's.
        self._picture_utime = 0
        self._shown = False
        self._sent = np.zeros(0)  # The last torques sent.
        # (time stamp, torques) of the last commands, to recognise them in a status.
        self._on_the_way: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=100)
        self._delay = 0.0  # [s]
        self._acting: tuple[float, ...] = ()  # The torques in the last status.

    def _keeper(self, channel: str) -> Callable[[bytes], None]:
        def keep(data: bytes) -> None:
            self._newest[channel] = data

        return keep

    def _fix(self, context, port: str, data: bytes) -> None:
        self._messages.fix(self._diagram, context, port, data)

    @property
    def time(self) -> float:
        """Time of the controllers [s]."""
        return max(self._tick, 0) * TICK

    @property
    def is_held(self) -> bool:
        """Whether no robot is connected."""
        return self._robot is None

    def spin(self, timeout_ms: int = SPIN_MS) -> bool:
        """Waits for messages and answers the newest status. Returns: whether a status
        was answered."""
        self._lcm.HandleSubscriptions(timeout_ms)
        # Empty the queue, as only the newest status is of use.
        while self._lcm.HandleSubscriptions(0) > 0:
            pass
        now = self._clock()
        data = self._newest.pop(STATUS, None)
        if data is None:
            if not self.is_held and self._is_silent(now):
                self._hold(now)
            return False
        start = perf_counter()
        if not self.is_held and self._is_silent(now):
            self._hold(now)  # This process itself was suspended.
        self._heard = now
        status = self._read(data)
        if status is None:
            return False
        if status.robot_utime < self._robot_utime:
            self._since = None  # The robot was restarted.
        self._robot_utime = status.robot_utime
        self._note_pace(status.utime)
        return self.answer(status, data, start)

    def _read(self, data: bytes) -> lcmt_panda_status | None:
        """The message as a status of an arm with our number of joints, or None."""
        try:
            status = lcmt_panda_status.decode(data)
        except ValueError:
            status = None
        if status is None or status.num_joints != N_JOINTS:
            self.report.not_read += 1
            return None
        return status

    @property
    def silent_sec(self) -> float:
        """Time since the last status, on the robot's clock."""
        return (self._clock() - self._heard) / self._slowness

    def _is_silent(self, now: float) -> bool:
        return now - self._heard > HOLD_SEC * self._slowness

    def _note_pace(self, utime: int) -> None:
        # Measured from the first status on, anew for a robot with another clock.
        if self._since is None or utime < self._since[1]:
            self._since = self._heard, utime
            return
        passed = 1e-6 * (utime - self._since[1])
        if passed > KNOWN_SEC:
            self._slowness = max(1.0, (self._heard - self._since[0]) / passed)

    def _hold(self, now: float) -> None:
        """Stops sending commands, upon which the driver brings the arm to rest."""
        self.report.holds_sec.append((now - self._heard) / self._slowness)
        self._robot = None

    def answer(
        self, status: lcmt_panda_status, data: bytes, start: float | None = None
    ) -> bool:
        """Advances to the tick of a status, and sends the command.

        Args: data: the encoded status; start: perf_counter() at its arrival.
        Returns: whether a command was sent.
        """
        start = perf_counter() if start is None else start
        robot = round(status.robot_utime * 1e-6 / TICK)
        if status.control_mode != TORQUE_MODE or status.robot_mode not in MOVES:
            if not self.is_held:
                self._hold(self._clock())
            return False
        if self._robot is not None and not 0 < robot - self._robot <= CATCH_UP:
            if 0 <= self._robot - robot <= CATCH_UP:  # Duplicate or out of order.
                return False
            self._robot = None  # Another robot, or one that was gone.
        self._fix(self.context, STATUS_PORT, data)
        if self._robot is None:
            self._tick += 1
            q = np.array(status.joint_position)
            if self._tick > 0:  # Jump to the new time without simulating.
                self._simulator.AdvanceTo(self._tick * TICK - 1e-5)
            try:
                self._begin(self._diagram, self.context, q)
            except ValueError:
                if self.report.begun == 0:
                    raise
                self.report.not_begun += 1  # The user may move the arm to the start.
                self._tick -= 1
                return False
            self._sent = np.zeros(len(q))
            self.report.begun += 1
        else:
            self._tick += robot - self._robot
            self.report.lost += robot - self._robot - 1
        follows = self._robot is not None and robot == self._robot + 1
        self._robot = robot
        self._note_delay(status, follows)
        self._show_picture(status.utime)
        self._simulator.AdvanceTo(self._tick * TICK + WITHIN)
        self._send(status.utime)
        self.report.compute_sec.append(perf_counter() - start)
        return True

    def _note_delay(self, status: lcmt_panda_status, follows: bool) -> None:
        """Updates the delay from a status to the torque that answers it.

        It is about the largest of the last second. Only a torque that is new in
        consecutive statuses counts, as a driver without new commands repeats the last
        one. With a driver that filters commands they are not recognised in its status,
        and the delay is not updated.
        """
        acting = tuple(status.joint_torque_desired)
        is_new = follows and acting != self._acting
        self._acting = acting
        for utime, torque in reversed(self._on_the_way):
            if is_new and torque == acting and any(torque):
                age = 1e-6 * (status.utime - utime)
                self._delay = max(age, self._delay * (1.0 - TICK / DELAY_MEMORY_SEC))
                self.report.delay_sec.append(age)
                break
        self._diagram.GetInputPort("delay").FixValue(self.context, [self._delay])

    def _show_picture(self, utime: int) -> None:
        """Gives the newest image to the diagram, or none if it is too old."""
        data = self._newest.pop(IMAGES, None)
        if data is not None:
            self._picture_utime = lcmt_image_array.decode(data).header.utime
            self._fix(self.context, IMAGES_PORT, data)
            self._shown = True
        if self._shown and utime - self._picture_utime > PICTURE_SEC * 1e6:
            self._fix(self.context, IMAGES_PORT, no_images())
            self._shown = False

    def _send(self, utime: int) -> None:
        own = self._station.GetMyContextFromRoot(self.context)
        data = self._messages.read(self._station, own, COMMAND_PORT)
        command = lcmt_panda_command.decode(data)
        torque = np.array(command.joint_torque)
        if not np.isfinite(torque).all():
            self.report.not_finite += 1
            return
        # The step per command is limited; lost ticks do not allow a larger one.
        step = TORQUE_RATE_MAX * TICK
        sent = self._sent + (torque - self._sent).clip(-step, step)
        self.report.rate_limited += int(abs(sent - torque).max() > 1e-9)
        self._sent = sent
        command.joint_torque = sent.tolist()
        command.utime = utime
        self._on_the_way.append((utime, tuple(command.joint_torque)))
        self._lcm.Publish(COMMAND, command.encode())
        self.report.steps += 1


def wait_for_robot(loop: LcmLoop, url: str, done: Callable[[], bool]) -> None:
    """Waits until the first status is answered. Raises: ValueError if none comes."""
    until = monotonic() + FIRST_SEC
    while not loop.spin() and not done():
        if monotonic() > until:
            raise ValueError(
                f"--robot lcm: no status of a robot in torque control came on {STATUS} "
                f"of {url} within {FIRST_SEC:.0f} s; is the driver, or `makebreak "
                "station`, running?"
            )


def drive(
    session: Session,
    diagram: Diagram,
    record: Mapping[str, OutputPort],
    begin: Callable[[Diagram, Context, np.ndarray], None],
    url: str,
    duration_sec: float,
    period_sec: float,
    until: Callable[[float, dict[str, np.ndarray]], str],
) -> tuple[Log, LoopReport]:
    """Session.simulate for a robot behind LCM.

    Args: as Session.simulate and LcmLoop, with duration_sec on the robot's clock.
    Returns: the log, with a sample every period_sec while the robot answers, and the
        report.
    Raises: ValueError if no robot answers.
    """
    duration = session.duration_sec or duration_sec
    while session.first_calls:  # Compile before the first message.
        session.first_calls.pop(0)()
    _rehearse(diagram, begin)
    loop = LcmLoop(diagram, begin, url)
    ports = [
        (name, port, port.get_system().GetMyContextFromRoot(loop.context))
        for name, port in record.items()
    ]
    stream = RecordingStream(session.outputs.file("recording.csv"), diagram)
    times: list[float] = []
    samples: dict[str, list[np.ndarray]] = {name: [] for name in record}
    with CatchInterrupt() as interrupt:
        print(f"Waiting for the robot on {url}", flush=True)
        wait_for_robot(loop, url, lambda: interrupt.hit)
        print("The robot answers; the controllers begin", flush=True)
        why, was_held = "", False
        while not why and not interrupt.hit and loop.time < duration:
            answered = loop.spin()
            if loop.is_held and loop.silent_sec > GONE_SEC:
                why = f"the robot has not answered for {GONE_SEC:.0f} s"
                break
            if loop.is_held != was_held:
                was_held = loop.is_held
                print(
                    f"{loop.time:.2f} s: "
                    + ("no status: held" if was_held else "the robot is back"),
                    file=sys.stderr,
                    flush=True,
                )
            if not answered or (times and loop.time < times[-1] + period_sec - 1e-9):
                continue
            now = {name: np.array(port.Eval(own)) for name, port, own in ports}
            times.append(loop.time)
            for name, value in now.items():
                samples[name].append(value)
            stream.tick(loop.context)
            why = until(loop.time, now)
        if interrupt.hit:
            why = "interrupted"
        session.interrupted = interrupt.hit
        if why:
            session.endings.append(f"ended at {loop.time:.4g} s: {why}")
    stream.catch_up(loop.context, ended=True)
    columns = {name: np.array(rows) for name, rows in samples.items()}
    log = Log(np.array(times), columns, interrupt.hit, loop.context, diagram)
    return log, loop.report


def _rehearse(diagram: Diagram, begin) -> None:
    """Simulates 0.1 s with made-up messages, so that everything is compiled."""
    loop = LcmLoop(diagram, begin, "memq://")
    status = empty_status()
    status.control_mode, status.robot_mode = TORQUE_MODE, MOVES[-1]
    arm = diagram.GetSubsystemByName("state_estimator")
    status.joint_position = arm.q_default.tolist()
    for k in range(100):
        status.robot_utime = 1000 * (k + 1)
        loop.answer(status, status.encode())
