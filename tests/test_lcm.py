"""A robot behind LCM: what its driver refuses, how controllers take its messages."""

from time import sleep

import numpy as np
import pytest
from drake import lcmt_panda_command
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.ball_rolling import make_ball_rolling
from makebreak.diagrams.ball_rolling_config import BallRollingConfig
from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.lcm_station import (
    COMMAND,
    COMMAND_PORT,
    IMAGES_PORT,
    STATUS,
    STATUS_PORT,
    TORQUE_MODE,
    Messages,
    empty_status,
    make_lcm_station,
    no_images,
)
from makebreak.diagrams.replay_station import joint_columns, make_replay_station
from makebreak.diagrams.scene_facts import N_JOINTS
from makebreak.diagrams.station import make_control_plant
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.experiments.ball_rolling import differences, start_where_it_is
from makebreak.scripts.runner.lcm_loop import HOLD_SEC, SPIN_MS, LcmLoop
from makebreak.scripts.runner.stand_in import (
    DAMPING,
    EXPIRE_SEC,
    Driver,
    StandIn,
    StandInConfig,
    StandInReport,
)
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
)

NOW = 1_700_000_000_000_000  # [us]
HOME = [-0.117125, -0.059522, -0.137316, -2.552375, -0.013487, 2.493369, -0.243449]


def command(torque=0.5, utime=NOW, mode=TORQUE_MODE, n=N_JOINTS):
    message = lcmt_panda_command()
    message.utime, message.control_mode_expected = utime, mode
    message.num_joint_torque, message.joint_torque = n, [torque] * n
    return message


def test_a_driver_follows_a_fresh_command_and_then_damps():
    report = StandInReport()
    driver = Driver(report)
    v = np.full(N_JOINTS, 0.01)
    np.testing.assert_allclose(driver.torque(v, NOW), -DAMPING * v)
    driver.receive(command(), NOW + 1000)
    np.testing.assert_allclose(driver.torque(v, NOW + 1000), 0.5)
    fresh = NOW + int(0.99 * EXPIRE_SEC * 1e6)
    np.testing.assert_allclose(driver.torque(v, fresh), 0.5)
    old = NOW + int(1.01 * EXPIRE_SEC * 1e6)
    np.testing.assert_allclose(driver.torque(v, old), -DAMPING * v)
    assert (report.damped, report.received, report.refused) == (2, 1, {})
    assert list(report.age_sec) == [pytest.approx(1e-3)]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (command(utime=NOW - 101_000), "expired"),
        (command(utime=NOW + 101_000), "expired"),
        (command(mode=1), "mode"),
        (command(torque=float("nan")), "not_finite"),
        (command(n=6), "size"),
        (command(utime=NOW - 2000), "out_of_order"),
    ],
)
def test_a_driver_refuses(message, why):
    report = StandInReport()
    driver = Driver(report)
    driver.receive(command(torque=0.25, utime=NOW - 1000), NOW)
    driver.receive(message, NOW)
    assert report.refused == {why: 1}
    np.testing.assert_allclose(driver.torque(np.zeros(N_JOINTS), NOW), 0.25)


def test_a_driver_keeps_the_rate_of_torque():
    report = StandInReport()
    driver = Driver(report)
    driver.receive(command(torque=2.5), NOW)
    steps = [driver.torque(np.zeros(N_JOINTS), NOW)[0] for _ in range(4)]
    np.testing.assert_allclose(steps, [1.0, 2.0, 2.5, 2.5])
    assert report.steps_too_large == 2


def status_message(tick, q=None, **fields):
    status = empty_status()
    status.utime, status.robot_utime = NOW + 1000 * tick, 1000 * tick
    status.joint_position = list(HOME if q is None else q)
    status.control_mode, status.robot_mode = TORQUE_MODE, 2
    for name, value in fields.items():
        setattr(status, name, value)
    return status


def test_messages_become_the_stations_signals_and_back():
    arm = make_control_plant()
    station = make_lcm_station(arm)
    context = station.CreateDefaultContext()
    messages = Messages()
    tau_external = np.arange(7.0)
    status = status_message(
        0, joint_velocity=[0.5] * 7, joint_torque_external=tau_external.tolist()
    )
    messages.fix(station, context, STATUS_PORT, status.encode())
    messages.fix(station, context, IMAGES_PORT, no_images())
    station.GetInputPort("delay").FixValue(context, [0.0])
    plant_context = arm.CreateDefaultContext()
    arm.SetPositions(plant_context, HOME)
    gravity = -arm.CalcGravityGeneralizedForces(plant_context)
    station.GetInputPort("panda.torque_commanded").FixValue(context, gravity + 0.25)
    read = {
        name: station.GetOutputPort(f"panda.{name}").Eval(context)
        for name in ("position_measured", "velocity_measured", "torque_external")
    }
    np.testing.assert_allclose(read["position_measured"], HOME)
    np.testing.assert_allclose(read["velocity_measured"], 0.5)
    # The driver sends libfranka's turned round; this is the surroundings' on the arm.
    np.testing.assert_allclose(read["torque_external"], -tau_external)
    sent = lcmt_panda_command.decode(messages.read(station, context, COMMAND_PORT))
    np.testing.assert_allclose(sent.joint_torque, 0.25, atol=1e-9)  # Without gravity.
    assert sent.control_mode_expected == TORQUE_MODE


class Robot:
    """The other side of an LcmLoop of an arm that holds its tip, all in this process;
    `clock` is what both believe that time is."""

    def __init__(self, url):
        arm = make_control_plant()
        builder = DiagramBuilder()
        station = builder.AddNamedSystem("station", make_lcm_station(arm))
        self.law = law = builder.AddNamedSystem(
            "law", ImpedanceController(ImpedanceConfig(offset_sec=7e-4), arm)
        )
        for port, name in (("position_measured", "q"), ("velocity_measured", "v")):
            builder.Connect(
                station.GetOutputPort(f"panda.{port}"), law.GetInputPort(name)
            )
        builder.Connect(
            law.GetOutputPort("tau"), station.GetInputPort("panda.torque_commanded")
        )
        builder.ExportInput(law.GetInputPort("x_desired"), "x_desired")
        for i in range(station.num_input_ports()):
            port = station.get_input_port(i)
            if port.get_name() != "panda.torque_commanded":
                builder.ExportInput(port, port.get_name())
        diagram = builder.Build()
        self.begun = []
        self.clock = 100.0
        self.lcm = DrakeLcm(url)
        self.commands = []
        self.lcm.Subscribe(
            COMMAND, lambda data: self.commands.append(lcmt_panda_command.decode(data))
        )

        self.refuses = False

        def begin(diagram, context, q):
            if self.refuses:
                raise ValueError("too far away")
            self.begun.append(np.array(q))
            law.start_at(law.GetMyMutableContextFromRoot(context), q)
            diagram.GetInputPort("x_desired").FixValue(context, np.full(19, np.nan))

        self.loop = LcmLoop(diagram, begin, url, lambda: self.clock)
        self.diagram = diagram

    def delay(self):
        """What the controllers are told of it [s]."""
        return self.diagram.GetInputPort("delay").Eval(self.loop.context)[0]

    def says(self, *ticks, after=0.001, **fields):
        """Sends statuses, and lets the loop see them. Returns: the commands."""
        self.clock += after
        for tick in ticks:
            self.lcm.Publish(STATUS, status_message(tick, **fields).encode())
        self.commands.clear()
        before = self.loop.report.steps
        self.loop.spin(2000 if ticks else 0)
        for _ in range(20):
            if len(self.commands) == self.loop.report.steps - before:
                break
            self.lcm.HandleSubscriptions(100)
        return list(self.commands)


@pytest.fixture
def robot():
    return Robot("udpm://239.255.76.67:7711?ttl=0")


def test_each_status_is_answered_with_its_own_stamp(robot):
    for tick in (5, 6, 7):
        (answer,) = robot.says(tick)
        assert answer.utime == NOW + 1000 * tick
        # Nothing to do but carry the arm, which the robot does by itself.
        np.testing.assert_allclose(answer.joint_torque, 0.0, atol=0.2)
    assert robot.loop.time == pytest.approx(0.002)
    np.testing.assert_allclose(robot.begun, [HOME])


def test_lost_statuses_are_stepped_over_and_old_ones_ignored(robot):
    robot.says(1)
    assert len(robot.says(11)) == 1
    assert robot.loop.time == pytest.approx(0.010)
    assert robot.says(10) == []
    assert robot.loop.time == pytest.approx(0.010)
    assert robot.loop.report.lost == 9
    assert len(robot.says(12)) == 1
    assert robot.loop.time == pytest.approx(0.011)
    assert len(robot.begun) == 1


def test_a_silent_robot_is_held_within_50_ms_and_begun_again(robot):
    robot.says(1)
    robot.says(after=0.9 * HOLD_SEC)
    assert not robot.loop.is_held
    robot.says(after=0.2 * HOLD_SEC)
    assert robot.loop.is_held
    # It looks at its clock each SPIN_MS.
    assert robot.loop.report.holds_sec == [pytest.approx(1.1 * HOLD_SEC)]
    assert HOLD_SEC + 1e-3 * SPIN_MS <= 0.05 + 1e-9
    elsewhere = np.array(HOME) + 0.05
    (answer,) = robot.says(1, after=2.0, q=elsewhere)  # It was started anew.
    np.testing.assert_allclose(robot.begun[-1], elsewhere)
    np.testing.assert_allclose(answer.joint_torque, 0.0, atol=0.2)
    assert robot.loop.time == pytest.approx(0.001)  # Ours goes on.


def test_a_robot_that_is_slower_than_real_time_is_waited_for_as_long(robot):
    """At a tenth of real time a millisecond takes 10 ms, and 50 ms half a second."""
    for tick in range(1, 70):
        robot.says(tick, after=0.01)
    robot.says(after=9.0 * HOLD_SEC)
    assert not robot.loop.is_held
    robot.says(after=2.0 * HOLD_SEC)
    assert robot.loop.is_held
    assert robot.loop.report.holds_sec == [pytest.approx(1.1 * HOLD_SEC, rel=0.02)]


def test_a_robot_in_another_mode_is_sent_nothing(robot):
    robot.says(1)
    assert robot.says(2, control_mode=1) == []
    assert robot.loop.is_held
    assert robot.says(3, robot_mode=4) == []  # A reflex.
    assert len(robot.says(4)) == 1
    assert len(robot.begun) == 2


def test_no_command_that_is_not_finite_is_sent_and_none_steps_too_far(robot):
    robot.says(1)
    (answer,) = robot.says(2, joint_position=[float("nan")] * 7)
    assert np.isfinite(answer.joint_torque).all()
    before = np.array(answer.joint_torque)
    # The arm is suddenly elsewhere: 20 ticks of 1 N m each are allowed by the law.
    (answer,) = robot.says(22, q=np.array(HOME) + 0.3)
    assert abs(np.array(answer.joint_torque) - before).max() <= 1.0 + 1e-9


def test_a_command_that_is_not_finite_is_not_sent(robot, monkeypatch):
    robot.says(1)
    real = Messages.read

    def broken(*args):
        command = lcmt_panda_command.decode(real(*args))
        command.joint_torque = [*command.joint_torque[:6], float("nan")]
        return command.encode()

    monkeypatch.setattr(Messages, "read", broken)
    assert robot.says(2) == [] and robot.loop.report.not_finite == 1
    monkeypatch.setattr(Messages, "read", real)
    assert len(robot.says(3)) == 1


def test_the_loops_delay_is_found_in_the_torques_that_come_back(robot):
    robot.says(1)
    (answer,) = robot.says(2, q=np.array(HOME) + 0.01)
    assert any(answer.joint_torque)
    for tick in range(3, 14):
        robot.says(tick)
    robot.says(14, joint_torque_desired=list(answer.joint_torque))
    robot.says(15, joint_torque_desired=list(answer.joint_torque))  # It still acts.
    assert list(robot.loop.report.delay_sec) == [pytest.approx(0.012)]
    given = robot.delay()
    assert 0.0119 < given <= 0.012


def test_statuses_that_are_lost_are_no_delay(robot):
    robot.says(1)
    (answer,) = robot.says(2, q=np.array(HOME) + 0.01)
    (last,) = robot.says(
        3, q=np.array(HOME) + 0.02, joint_torque_desired=list(answer.joint_torque)
    )
    assert last.joint_torque != answer.joint_torque
    # Nobody heard anything for 44 ms; the driver goes on with what it has.
    robot.says(47, joint_torque_desired=list(last.joint_torque))
    assert list(robot.loop.report.delay_sec) == [pytest.approx(0.001)]
    assert robot.delay() <= 0.001


def test_a_status_that_is_late_costs_a_reading_and_no_new_beginning(robot):
    for tick in range(1, 9):
        robot.says(tick)
    assert robot.says(4) == []
    assert len(robot.says(9)) == 1 and robot.loop.report.begun == 1


def test_what_is_no_status_of_a_panda_is_left_out(robot):
    robot.says(1)
    robot.lcm.Publish(STATUS, b"nothing of the kind")
    robot.loop.spin(2000)
    six = status_message(2)
    six.num_joints = 6
    for name in six.__slots__:
        value = getattr(six, name)
        if isinstance(value, list):
            setattr(six, name, value[:6])
    robot.lcm.Publish(STATUS, six.encode())
    robot.loop.spin(2000)
    assert robot.loop.report.not_read == 2 and robot.loop.report.steps == 1
    assert len(robot.says(3)) == 1


def test_a_place_where_the_task_cannot_begin_is_waited_out(robot):
    robot.says(1)
    robot.says(after=2.0)
    robot.refuses = True
    for tick in (2100, 2101):
        assert robot.says(tick) == [] and robot.loop.is_held
    robot.refuses = False
    assert len(robot.says(2102)) == 1
    assert robot.loop.time == pytest.approx(0.001)
    assert robot.loop.report.not_begun == 2


def test_at_first_a_place_where_the_task_cannot_begin_is_said(robot):
    robot.refuses = True
    with pytest.raises(ValueError, match="too far"):
        robot.says(1)


def test_faults_of_sensors_do_not_reach_the_driver_itself():
    world = BallRollingConfig(
        camera=CameraConfig(renderer="drawn"),
        faults=["position_nan:from=0.003", "velocity_nan:from=0.003"],
    )
    stand_in = StandIn(world, StandInConfig(url="memq://"))
    for _ in range(8):
        stand_in.tick()
    assert np.isfinite(stand_in.driver.torque(np.zeros(N_JOINTS), NOW)).all()


def test_ball_rolling_runs_with_the_stand_in_over_loopback():
    """Both sides in one process, a tick in turn, on a clock that only ticks move."""
    url = "udpm://239.255.76.67:7712?ttl=0"
    clock = [50.0]
    config = BallRollingConfig(camera=CameraConfig(renderer="drawn"), seed=2)
    stand_in = StandIn(config, StandInConfig(url=url), clock=lambda: clock[0])
    arm = make_control_plant(config.model)
    diagram = make_ball_rolling(config, station=make_lcm_station(arm))

    def begin(_, context, q):
        start_where_it_is(diagram, context, q, arm)

    loop = LcmLoop(diagram, begin, url, lambda: clock[0])
    for _ in range(250):
        stand_in.tick()
        assert any(loop.spin(200) for _ in range(50))
        clock[0] += 0.001
        for _ in range(500):  # A loaded machine takes its time.
            stand_in.listen()
            if stand_in.report.received == loop.report.steps:
                break
            sleep(0.01)
    report = stand_in.report.result()
    assert report["commands_received"] == 250
    assert report["commands_refused"] == 0
    assert report["steps_too_large"] == 0
    assert report["damped_share"] == 1 / 250  # Before the first command.
    assert loop.report.lost == 0 and loop.report.begun == 1
    seen = diagram.GetSubsystemByName("ball_tracker").GetOutputPort("seen")
    own = diagram.GetSubsystemByName("ball_tracker").GetMyContextFromRoot(loop.context)
    assert seen.Eval(own)[0] == 1.0  # Through the picture's message.
    x = diagram.GetSubsystemByName("state_estimator")
    found = x.GetOutputPort("x").Eval(x.GetMyContextFromRoot(loop.context))
    plant = stand_in._station.GetSubsystemByName("plant")
    at = plant.GetMyContextFromRoot(stand_in._context)
    tip = plant.GetFrameByName("tip").CalcPoseInWorld(at).translation()
    np.testing.assert_allclose(found[:3], tip, atol=5e-3)
    # It rises to pass the ball: the arm is moved by what came through the messages.
    assert tip[2] - 0.1 > 0.005


def test_a_start_far_away_is_refused():
    config = BallRollingConfig(camera=CameraConfig(renderer="drawn"))
    arm = make_control_plant(config.model)
    with pytest.raises(ValueError, match="the tip is at .* expected within 0.3 m"):
        start_where_it_is(None, None, np.array(HOME) + 0.8, arm)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run", "porridge", "--robot", "lcm"], "porridge cannot be run on it yet"),
        (["run", "--robot", "iiwa"], "got iiwa, expected sim, lcm"),
        (["run", "--robot", "replay", "none.csv"], "none.csv does not exist"),
        (
            ["run", "--robot", "replay", "none.csv", "--fault", "push"],
            "--fault push: a recording has no robot that it meets",
        ),
        (["station", "--rate", "2"], "--rate: got 2, expected at most 1"),
        (["station", "--drop", "1"], "--drop: got 1, expected a share"),
        (["station", "porridge"], "porridge has no station"),
    ],
)
def test_wrong_robots_are_refused_in_one_line(words, says, capsys, tmp_path):
    if words[0] == "run":
        words = [*words, "--out", str(tmp_path / "out"), "--no-meshcat"]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def recording(n=40):
    time = 0.0125 * np.arange(n)
    columns = {"time": time}
    for k, what in enumerate(
        ("position", "velocity", "effort_measured", "effort_command")
    ):
        for name in joint_columns(what):
            columns[name] = k + time
    columns["ball.x"], columns["ball.y"] = 0.5 + 0.1 * time, -0.2 * time
    return columns


def test_commands_of_a_replay_are_alike_until_they_are_not():
    time, before = 0.1 * np.arange(6), np.zeros((6, 7))
    now = before.copy()
    now[:, 2] = [0.0, 1.0, -2.9, 0.0, 0.0, -3.1]
    found = differences(time, before + 5.0, now + 5.0)
    assert found["commands_alike_until_s"] == pytest.approx(0.5)
    assert found["command_difference_max_Nm"] == pytest.approx(3.1)
    assert found["command_difference_max_at_s"] == pytest.approx(0.5)
    assert found["command_difference_rms_Nm"][2] > 0.0
    assert found["command_spread_rms_Nm"] == [0.0] * 7
    now[3, 0] = np.nan
    assert differences(time, before, now)["commands_alike_until_s"] == time[3]
    assert np.isnan(differences(time, before, before)["commands_alike_until_s"])


def test_a_replay_gives_what_was_recorded():
    columns = recording()
    columns["ball.x"][10:12] = np.nan
    station = make_replay_station(columns, ("ball.x", "ball.y"), 0.03)
    context = station.CreateDefaultContext()

    def at(t, port):
        context.SetTime(t)
        return station.GetOutputPort(port).Eval(context)

    np.testing.assert_allclose(at(0.101, "panda.position_measured"), 0.101)
    np.testing.assert_allclose(at(0.101, "panda.torque_measured"), 2.101)
    np.testing.assert_allclose(at(9.0, "panda.velocity_measured"), 1.0 + 39 * 0.0125)
    np.testing.assert_allclose(at(0.13, "ball.p_WB"), [0.513, -0.026, 0.03])
    np.testing.assert_allclose(at(0.2, "ball.v_WB"), [0.1, -0.2, 0.0], atol=1e-9)
    seen = [at(t, "ball.seen")[0] for t in (0.12, 0.126, 0.14, 0.151)]
    assert seen == [1.0, 0.0, 0.0, 1.0]


def test_a_replay_names_what_the_recording_lacks():
    columns = recording()
    del columns["panda.panda_joint3.velocity"]
    with pytest.raises(ValueError, match="lacks panda.panda_joint3.velocity"):
        make_replay_station(columns, ("ball.x", "ball.y"), 0.03)
    columns = recording()
    columns["panda.panda_joint1.position"][3] = np.nan
    with pytest.raises(ValueError, match="holes in its position columns"):
        make_replay_station(columns, ("ball.x", "ball.y"), 0.03)
