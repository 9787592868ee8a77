"""Runs controllers on a robot behind LCM: a step on each status message.

The controllers' clock is the robot's: each status says which millisecond it is of, and
the diagram is simulated up to it, with the sensors of that status. So a status that is
lost or late costs the controllers nothing but its reading, and the other side may run
slower than real time. A command bears the time stamp of the status that it answers: the
driver refuses what is too old, whatever made it so.
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
from makebreak.scripts.recording_stream import RecordingStream
from makebreak.scripts.session import CatchInterrupt, Log, Session

TICK = 0.001  # [s] Of the robot.
WITHIN = 0.0009  # [s] After a tick: all that follows from it has been worked out.
# Without a status for longer, the robot is taken for gone: of its own time, which may
# pass more slowly than ours.
HOLD_SEC = 0.04  # With SPIN_MS, 50 ms.
SPIN_MS = 10
KNOWN_SEC = 0.05  # After so much of it, how much more slowly is known.
CATCH_UP = 50  # [ticks] Fewer lost ones are simulated, more are a new beginning.
DELAY_MEMORY_SEC = 1.0  # In which a delay that was once seen is forgotten.
PICTURE_SEC = 0.1  # A picture that is older is not shown.
FIRST_SEC = 20.0  # To wait for the first status.
GONE_SEC = 120.0  # Without an answer for longer, the run ends.
KEPT = 100_000  # Of the latest times, for the report.
MOVES = (0, 1, 2)  # Robot modes of libfranka in which it may be commanded.


@dataclass
class LoopReport:
    """How a run went, as the controllers' side has seen it."""

    steps: int = 0  # Commands sent.
    lost: int = 0  # Ticks without a status of their own.
    not_finite: int = 0  # Commands that were not sent for it.
    rate_limited: int = 0  # Commands that were shortened to the torque's rate.
    not_read: int = 0  # Messages that are none of a Panda's.
    not_begun: int = 0  # Statuses from a place where the task cannot begin.
    # The latest: from a status to its command, and until that acts [s].
    compute_sec: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    delay_sec: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    holds_sec: list[float] = field(default_factory=list)  # From the last status on.
    begun: int = 0  # Times that the controllers began at the robot's place.

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
    """The controllers' side of the messages.

    Args:
        diagram: with a subsystem `station` that make_lcm_station made.
        begin: called with the diagram, its root context and the joints' positions (n,)
            whenever the controllers are to begin where the robot is: at first, and
            after it was gone.
        url: of LCM.
        clock: of the wall [s].
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
        self._tick = -1  # Of the diagram.
        self._robot: int | None = None  # The robot's tick that was answered last.
        self._heard = clock()  # When the last status came [s].
        self._since: tuple[float, int] | None = None  # Then, and its time stamp [us].
        self._robot_utime = 0  # Of the last status.
        self._slowness = 1.0  # Our seconds in one of the robot's.
        self._picture_utime = 0
        self._shown = False
        self._sent = np.zeros(0)  # The last torques.
        # (time stamp, torques) of the last commands, to be found again in a status.
        self._on_the_way: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=100)
        self._delay = 0.0  # [s]
        self._acting: tuple[float, ...] = ()  # By the last status.

    def _keeper(self, channel: str) -> Callable[[bytes], None]:
        def keep(data: bytes) -> None:
            self._newest[channel] = data

        return keep

    def _fix(self, context, port: str, data: bytes) -> None:
        self._messages.fix(self._diagram, context, port, data)

    @property
    def time(self) -> float:
        """Of the controllers [s]."""
        return max(self._tick, 0) * TICK

    @property
    def is_held(self) -> bool:
        """Whether the robot is gone, or was never there."""
        return self._robot is None

    def spin(self, timeout_ms: int = SPIN_MS) -> bool:
        """Waits for messages and answers the newest status. Returns: whether there was
        one, and it was answered."""
        self._lcm.HandleSubscriptions(timeout_ms)
        # What came meanwhile waits in the queue: only the newest is of use.
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
            self._hold(now)  # This process itself was away.
        self._heard = now
        status = self._read(data)
        if status is None:
            return False
        if status.robot_utime < self._robot_utime:
            self._since = None  # It was started anew.
        self._robot_utime = status.robot_utime
        self._note_pace(status.utime)
        return self.answer(status, data, start)

    def _read(self, data: bytes) -> lcmt_panda_status | None:
        """A status of an arm with as many joints as ours; None: it is none."""
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
        """Since the last status, in the robot's own time."""
        return (self._clock() - self._heard) / self._slowness

    def _is_silent(self, now: float) -> bool:
        return now - self._heard > HOLD_SEC * self._slowness

    def _note_pace(self, utime: int) -> None:
        # Both clocks go on while nothing is heard; another robot has another one.
        if self._since is None or utime < self._since[1]:
            self._since = self._heard, utime
            return
        passed = 1e-6 * (utime - self._since[1])
        if passed > KNOWN_SEC:
            self._slowness = max(1.0, (self._heard - self._since[0]) / passed)

    def _hold(self, now: float) -> None:
        """Nothing is sent any more: the driver lets the arm come to rest."""
        self.report.holds_sec.append((now - self._heard) / self._slowness)
        self._robot = None

    def answer(
        self, status: lcmt_panda_status, data: bytes, start: float | None = None
    ) -> bool:
        """Steps to the tick of a status, and sends the command that follows.

        Args: data: the status as it came; start: when its work began, perf_counter().
        Returns: whether a command followed.
        """
        start = perf_counter() if start is None else start
        robot = round(status.robot_utime * 1e-6 / TICK)
        if status.control_mode != TORQUE_MODE or status.robot_mode not in MOVES:
            if not self.is_held:
                self._hold(self._clock())
            return False
        if self._robot is not None and not 0 < robot - self._robot <= CATCH_UP:
            if 0 <= self._robot - robot <= CATCH_UP:  # Twice, or out of order.
                return False
            self._robot = None  # Another robot, or one that was away.
        self._fix(self.context, STATUS_PORT, data)
        if self._robot is None:
            self._tick += 1
            q = np.array(status.joint_position)
            if self._tick > 0:  # To the new time, with nothing in between.
                self._simulator.AdvanceTo(self._tick * TICK - 1e-5)
            try:
                self._begin(self._diagram, self.context, q)
            except ValueError:
                if self.report.begun == 0:
                    raise
                self.report.not_begun += 1  # It may be moved there.
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
        """How old the status was that the torque which acts now was worked out of: of
        the last second's the largest, roughly. It counts when that torque is new, in a
        status that follows the one before: a driver that hears nothing goes on with
        what it has, and that grows older without any delay. A driver that filters what
        it is sent does not let it be found again; then it stays as it was."""
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
        """The newest picture to the diagram, none if it is too old."""
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
        # Of what the robot has: lost ticks do not make a larger step a smaller one.
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
    """Until the first status is answered.

    Raises: ValueError if none comes.
    """
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
    """Session.simulate's counterpart for a robot behind LCM.

    Args: as Session.simulate and LcmLoop. duration_sec is of the robot's time.
    Returns: the samples, one each period_sec while the robot answers, and how it went.
    Raises: ValueError if no robot answers.
    """
    duration = session.duration_sec or duration_sec
    while session.first_calls:  # Compiled before the robot is spoken to.
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
    """A tenth of a second with messages that nobody sent: what is slow at first, is
    slow now."""
    loop = LcmLoop(diagram, begin, "memq://")
    status = empty_status()
    status.control_mode, status.robot_mode = TORQUE_MODE, MOVES[-1]
    arm = diagram.GetSubsystemByName("state_estimator")
    status.joint_position = arm.q_default.tolist()
    for k in range(100):
        status.robot_utime = 1000 * (k + 1)
        loop.answer(status, status.encode())
