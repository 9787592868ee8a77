"""Faults by name: what each does, when, and to whom; and the monitor of the arm."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource, ZeroOrderHold
from pydrake.systems.sensors import ImageRgba8U
from pydrake.trajectories import PiecewisePolynomial

from makebreak.benchmarks.fault_trials import (
    FAILED,
    HELD,
    RECOVERED,
    UNJUDGED,
    at_rest,
    judge,
)
from makebreak.diagrams.ball_rolling import make_ball_rolling, make_world
from makebreak.diagrams.ball_rolling_config import BallRollingConfig
from makebreak.diagrams.camera import CameraConfig, camera_model
from makebreak.diagrams.changing_contact import Knowledge
from makebreak.diagrams.contact_learning import ContactLearningConfig, make_task
from makebreak.diagrams.fault_kinds import FAULTS, FROM, read_fault, read_faults
from makebreak.diagrams.faults import GLARE_SHARE
from makebreak.diagrams.push_object import make_push_object
from makebreak.diagrams.push_object_config import PushObjectConfig
from makebreak.diagrams.station import (
    BALL_ROLLING,
    MONITOR,
    SensorNoise,
    StationConfig,
    StationFaults,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.wall_friction import WallFrictionConfig, make_wall_friction
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli.command_inputs import with_faults
from makebreak.scripts.experiments.papers.rolling_score import Track, speed_at_the_end
from makebreak.scripts.experiments.runs.contact_runs import rehearsed
from makebreak.scripts.runner.session import Session
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
)
from makebreak.systems.contact_mpc.c3_mpc import C3Status
from makebreak.systems.faults.fault_forces import Hand, Push
from makebreak.systems.faults.fault_pictures import LatePictures, PaintedPictures
from makebreak.systems.faults.fault_signals import (
    BiasedSignal,
    LateSignal,
    LimitedSignal,
    StuckSignal,
)
from makebreak.systems.faults.safety_monitor import ArmLimits, SafetyMonitor, verdict

NO_NOISE = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_fault_is_read_with_its_own_time_and_settings():
    fault = read_fault("push:from=3,for=0.5,y=-7")
    assert (fault.name, fault.start, fault.end) == ("push", 3.0, 3.5)
    assert fault.numbers == {"x": 0.0, "y": -7.0, "z": 0.0}
    plain = read_fault("velocity_bias")
    assert (plain.start, plain.end) == (FROM, math.inf)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("pusch", "unknown fault pusch; did you mean push"),
        ("push:w=3", "fault push: unknown setting w; it has from, for, x, y, z"),
        ("push:x=far", 'fault push: x: got "far", expected a number'),
        ("push:from=-1", "from is -1.0"),
        ("push:for=0", "for 0.0, expected"),
        ("position_bias:joint=8", "joint is 8, expected a whole number from 1 to 7"),
        ("position_bias:by=1e400", 'by: got "1e400", expected a number'),
        ("push:x=inf", 'x: got "inf", expected a number'),
        ("compute_delay:sec=0", "sec is 0, expected a number from 0.001"),
        ("frames_delayed:frames=2.7", "frames is 2.7, expected a whole number"),
        ("frames_dropped:share=2", "share is 2, expected a number from 0 to 1"),
        ("weak_joint:share=-1", "share is -1, expected"),
        ("joint_friction:coulomb=-1", "coulomb is -1, expected"),
        ("box:from=3", "unknown setting from; it has none"),
    ],
)
def test_a_wrong_fault_is_refused_in_one_line(text, says):
    with pytest.raises(ValueError, match=says) as refused:
        read_fault(text)
    assert "\n" not in str(refused.value)


def test_a_fault_of_what_is_not_there_is_refused():
    with pytest.raises(ValueError, match="glare: there is no camera here"):
        read_faults(["glare"], ("ball",))
    assert [f.name for f in read_faults(["glare", "push"], ("camera",))] == [
        "glare", "push",
    ]  # fmt: skip


def test_the_command_line_refuses_faults_where_there_is_no_arm(capsys):
    assert cli.main(["run", "porridge", "--fault", "push"]) == 2
    assert "porridge has no arm that takes faults" in capsys.readouterr().err
    assert cli.main(["run", "ball_rolling", "--fault", "pushh"]) == 2
    assert "did you mean push" in capsys.readouterr().err


def test_list_names_every_fault(capsys):
    assert cli.main(["list"]) == 0
    shown = capsys.readouterr().out
    for name, kind in FAULTS.items():
        assert f"  {name}" in shown
        assert kind.says in shown


TIMES = np.arange(0.0, 0.05, 0.001)


def through(system, signal):
    """What a fault makes of signal(t) (n,) that a plant of 1 ms gives: rows at TIMES,
    half a tick later."""
    builder = DiagramBuilder()
    ends = np.array([0.0, 0.06])
    line = PiecewisePolynomial.FirstOrderHold(
        ends, np.array([signal(t) for t in ends]).T
    )
    source = builder.AddSystem(TrajectorySource(line))
    plant = builder.AddSystem(ZeroOrderHold(0.001, len(signal(0.0))))
    builder.AddSystem(system)
    builder.Connect(source.get_output_port(), plant.get_input_port())
    builder.Connect(plant.get_output_port(), system.GetInputPort("value"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    rows = []
    for t in TIMES:
        simulator.AdvanceTo(t + 0.0005)
        own = system.GetMyContextFromRoot(simulator.get_context())
        rows.append(system.GetOutputPort("value").Eval(own))
    return np.array(rows)


def ramp(t):
    return np.array([t, 10.0 * t])


def within(start, end):
    return (TIMES > start - 1e-9) & (TIMES < end - 1e-9)


def test_a_bias_and_a_lost_signal_act_in_their_time_alone():
    got = through(BiasedSignal([0.5, np.nan], 0.01, 0.02), ramp)
    want = np.array([ramp(t) for t in TIMES])
    during = within(0.01, 0.02)
    want[during, 0] += 0.5
    want[during, 1] = np.nan
    np.testing.assert_allclose(got, want, atol=1e-12)
    assert during.sum() == 10


def test_a_stuck_signal_stays_as_it_was():
    got = through(StuckSignal([False, True], 0.01, 0.02), ramp)
    want = np.array([ramp(t) for t in TIMES])
    want[within(0.01, 0.02), 1] = 10.0 * 0.009
    np.testing.assert_allclose(got, want, atol=1e-12)


def test_a_late_signal_is_first_held_and_then_as_late_as_asked():
    got = through(LateSignal([True, False], 4, 0.01, 0.03), ramp)
    want = np.array([ramp(t) for t in TIMES])
    for i in np.flatnonzero(within(0.01, 0.03)):
        behind = min(4, i - 10)
        want[i, 0] = TIMES[i - behind]
    np.testing.assert_allclose(got, want, atol=1e-12)


def test_a_limited_signal_keeps_within_its_limit():
    got = through(LimitedSignal([np.inf, 0.15], 0.0, 0.03), ramp)
    want = np.array([ramp(t) for t in TIMES])
    early = within(0.0, 0.03)
    want[early, 1] = want[early, 1].clip(max=0.15)
    np.testing.assert_allclose(got, want, atol=1e-12)


def shown_frames(system, n):
    """The number that each frame shows: frame k is a picture of k."""
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    found = []
    for k in range(n):
        image = ImageRgba8U(8, 8)
        image.mutable_data[:] = k
        system.GetInputPort("image").FixValue(context, Value(image))
        simulator.AdvanceTo(0.01 * k + 0.001)
        found.append(int(system.GetOutputPort("rgb_image").Eval(context).data[0, 0, 0]))
    return found


def test_frames_come_late_by_their_number():
    late = LatePictures(8, 8, 2, 0.0, 0, 0.05, 0.1, 0.01)
    assert shown_frames(late, 14) == [0, 1, 2, 3, 4, 3, 4, 5, 6, 7, 10, 11, 12, 13]


def test_lost_frames_leave_the_one_before():
    frozen = LatePictures(8, 8, 0, 1.0, 0, 0.05, 0.1, 0.01)
    assert shown_frames(frozen, 12) == [0, 1, 2, 3, 4, 4, 4, 4, 4, 4, 10, 11]
    half = shown_frames(LatePictures(8, 8, 0, 0.5, 3, 0.0, 10.0, 0.01), 200)
    new = np.diff(half) > 0
    # Of 199 tosses of a coin: 99.5, standard deviation 7.
    assert 71 < new.sum() < 128


def test_outside_a_fault_the_picture_of_the_moment_is_shown():
    """Not that of the last frame's instant: with a fault that begins later a run goes
    on as without it until then."""
    late = LatePictures(8, 8, 2, 0.0, 0, 0.05, 0.1, 0.01)
    simulator = Simulator(late)
    context = simulator.get_mutable_context()
    image = ImageRgba8U(8, 8)
    # A frame of 30 ms is taken as the simulator goes on from there, with picture 31.
    for time, shown in ((0.021, 21), (0.026, 26), (0.051, 31), (0.099, 71), (0.1, 100)):
        for ms in range(round(1e3 * context.get_time()), round(1e3 * time)):
            image.mutable_data[:] = ms + 1
            late.GetInputPort("image").FixValue(context, Value(image))
            simulator.AdvanceTo(1e-3 * (ms + 1))
        got = int(late.GetOutputPort("rgb_image").Eval(context).data[0, 0, 0])
        assert got == shown


def test_a_second_ball_is_painted_where_it_would_be_seen():
    camera = camera_model(CameraConfig())
    system = PaintedPictures(camera, 1, [0.0, 0.1, 0.0], 0.03, (9, 8, 7), 0.0, 1.0)
    context = system.CreateDefaultContext()
    blank = ImageRgba8U(camera.width, camera.height)
    blank.mutable_data[:] = 100
    system.GetInputPort("image").FixValue(context, Value(blank))
    poses = [RigidTransform(), RigidTransform([0.45, 0.0, 0.03])]
    system.GetInputPort("body_poses").FixValue(context, Value(poses))
    painted = np.array(system.GetOutputPort("rgb_image").Eval(context).data)
    v, u = np.nonzero(painted[:, :, 0] == 9)
    # +x of the world is up in the picture, +y to the left: 0.77 m below the camera.
    depth = 0.8 - 0.03
    assert u.mean() == pytest.approx(
        camera.center[0] - camera.focal * 0.1 / depth, abs=1.0
    )
    assert v.mean() == pytest.approx(
        camera.center[1] + camera.focal * 0.05 / depth, abs=1.0
    )
    radius_px = camera.focal * 0.03 / depth
    assert len(u) == pytest.approx(np.pi * radius_px**2, rel=0.15)
    context.SetTime(1.0)
    assert (system.GetOutputPort("rgb_image").Eval(context).data == 100).all()


def free_body(time_step=0.001):
    plant = MultibodyPlant(time_step)
    inertia = SpatialInertia(0.07, np.zeros(3), UnitInertia.SolidSphere(0.03))
    body = plant.AddRigidBody("ball", inertia)
    plant.Finalize()
    return plant, body


def moved(system, plant, p, seconds):
    """(position, velocity) of the free body after some time under a force system."""
    builder = DiagramBuilder()
    builder.AddSystem(plant)
    builder.AddSystem(system)
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    builder.Connect(
        system.GetOutputPort("generalized_force"),
        plant.get_applied_generalized_force_input_port(),
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(own, [1, 0, 0, 0, *p])
    simulator.AdvanceTo(seconds)
    x = plant.GetPositionsAndVelocities(own)
    return x[4:7], x[10:13]


def test_a_push_gives_its_impulse():
    plant, body = free_body()
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    push = Push(plant, body, [1.0, 0.0, 2.0], 0.01, 0.03)
    _, v = moved(push, plant, [0.0, 0.0, 0.0], 0.05)
    np.testing.assert_allclose(v, np.array([1.0, 0.0, 2.0]) * 0.02 / 0.07, rtol=1e-9)


def test_a_hand_puts_the_ball_down_on_the_other_side_of_its_circle():
    plant, body = free_body()
    hand = Hand(plant, body, [0.5, 0.0], np.pi / 2, 0.0, 4.0)
    p, v = moved(hand, plant, [0.6, 0.0, 0.03], 3.999)
    np.testing.assert_allclose(p, [0.5, 0.1, 0.03], atol=2e-3)
    np.testing.assert_allclose(v, 0.0, atol=0.02)
    plant, body = free_body()
    hand = Hand(plant, body, [0.5, 0.0], np.pi / 2, 0.0, 4.0)
    p, _ = moved(hand, plant, [0.6, 0.0, 0.03], 2.0)
    assert p[2] > 1.0  # Out of the camera's sight meanwhile.


def test_a_hand_needs_time():
    plant, body = free_body()
    with pytest.raises(ValueError, match="a hand takes"):
        Hand(plant, body, [0.5, 0.0], 1.0, 0.0, 1.0)


def limits():
    return ArmLimits(
        torque=np.array([10.0, 5.0]),
        torque_rate=1000.0,
        speed=np.array([2.0, 1.0]),
        lower=np.array([-1.0, -1.0]),
        upper=np.array([1.0, 1.0]),
    )


def watched(rows):
    """Verdict on (tau, q, v), a row per tick of 1 ms."""
    monitor = SafetyMonitor(limits(), 0.001)
    simulator = Simulator(monitor)
    context = simulator.get_mutable_context()
    for k, row in enumerate(rows):
        for name, value in zip(("tau", "q", "v"), row, strict=True):
            monitor.GetInputPort(name).FixValue(context, value)
        simulator.AdvanceTo(0.001 * k + 0.0005)
    return verdict(monitor.GetOutputPort("worst").Eval(context))


GOOD = ([9.5, -5.0], [0.9, -1.0], [2.0, -0.5])


def test_a_monitor_lets_limits_be_reached():
    seen = watched([GOOD, ([10.0, -4.5], *GOOD[1:])])
    assert seen.kept and seen.not_finite == 0
    assert (seen.torque_share, seen.speed_share) == (1.0, 1.0)
    assert seen.torque_rate_share == pytest.approx(0.5)
    assert seen.position_excess == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("bad", "field", "value"),
    [
        (([10.2, -5.0], *GOOD[1:]), "torque_share", 1.02),
        (([9.5, -3.5], *GOOD[1:]), "torque_rate_share", 1.5),
        ((GOOD[0], GOOD[1], [0.0, -1.5]), "speed_share", 1.5),
        ((GOOD[0], [0.0, -1.25], GOOD[2]), "position_excess", 0.25),
        ((GOOD[0], GOOD[1], [np.nan, 0.0]), "not_finite", 1),
    ],
)
def test_a_monitor_finds_each_violation(bad, field, value):
    seen = watched([GOOD, bad, GOOD])
    assert not seen.kept
    assert getattr(seen, field) == pytest.approx(value)
    assert seen.first_violation_s == pytest.approx(0.001)


FAULTY = [
    "position_bias:from=0,joint=2,by=0.01", "velocity_bias:from=0,by=0.2",
    "torque_nan:from=0", "wrench_bias:from=0,by=3", "weak_joint:from=0,share=0.1",
    "glare:from=0", "push:from=0,y=20", "joint_friction:from=0", "box",
]  # fmt: skip


def test_a_station_has_all_its_faults_at_once():
    """Sensors, command, picture and plant differ from those of the same station
    without faults as each fault says."""
    camera = CameraConfig(renderer="drawn")
    config = BallRollingConfig(camera=camera, seed=2)
    found = {}
    for name, faults in (("good", []), ("bad", FAULTY)):
        config.faults = faults
        station = make_world(config)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        tau = np.array([1.0, -20.0, 0.0, 16.0, 0.0, 2.0, 0.0])
        station.GetInputPort("panda.torque_commanded").FixValue(context, tau)
        simulator.AdvanceTo(0.0105)
        found[name] = {
            port.get_name(): np.array(port.Eval(context))
            for port in (
                station.GetOutputPort(f"panda.{each}")
                for each in ("position_measured", "velocity_measured",
                             "torque_measured", "external_wrench")
            )
        }  # fmt: skip
        plant = station.GetSubsystemByName("plant")
        found[name]["v"] = np.array(plant.GetVelocities(
            plant.GetMyContextFromRoot(context)
        ))[:7]  # fmt: skip
        found[name]["q"] = np.array(plant.GetPositions(
            plant.GetMyContextFromRoot(context)
        ))[:7]  # fmt: skip
        found[name]["image"] = np.array(
            station.GetOutputPort("overhead.rgb_image").Eval(context).data
        )
        found[name]["box"] = plant.HasModelInstanceNamed("stray_box")
        found[name]["watched"] = station.HasOutputPort(MONITOR)
    good, bad = found["good"], found["bad"]
    off = (bad["panda.position_measured"] - bad["q"]) - (
        good["panda.position_measured"] - good["q"]
    )
    np.testing.assert_allclose(off, [0, 0.01, 0, 0, 0, 0, 0], atol=1e-9)
    off = (bad["panda.velocity_measured"] - bad["v"]) - (
        good["panda.velocity_measured"] - good["v"]
    )
    np.testing.assert_allclose(off, 0.2, atol=1e-9)
    assert np.isnan(bad["panda.torque_measured"]).all()
    assert bad["panda.external_wrench"][2] - good["panda.external_wrench"][2] > 1.5
    # The second joint's motor gives 8.7 of the 20 N m that carry the arm.
    assert bad["v"][1] - good["v"][1] > 0.01
    white = (bad["image"][:, :, :3] == 255).all(axis=2).sum()
    assert white > 0.5 * np.pi * (GLARE_SHARE * 14.0) ** 2
    assert not (good["image"][:, :, :3] == 255).all(axis=2).any()
    assert bad["box"] and not good["box"]
    assert bad["watched"] and not good["watched"]


def test_the_planners_solver_fails_in_its_time_alone():
    config = BallRollingConfig(
        camera=CameraConfig(renderer="drawn"),
        faults=["solver_fails:from=0.05,for=0.05"],
    )
    diagram = make_ball_rolling(config)
    simulator = Simulator(diagram)
    c3 = diagram.GetSubsystemByName("c3_mpc")
    context = c3.GetMyContextFromRoot(simulator.get_mutable_context())
    status = []
    for k in range(12):
        simulator.AdvanceTo(0.0125 * k + 0.001)
        status.append(float(c3.GetOutputPort("status").Eval(context)[0]))
    assert status[:4] == [0.0] * 4
    assert status[4:8] == [C3Status.SOLVE_FAILED] * 4
    assert status[8:] == [0.0] * 4


@pytest.mark.parametrize("knows", [True, False])
def test_an_arm_that_knows_its_delay_does_not_swing(knows):
    """With 20 ms of delay, damping of 400 N s/m on some 4 kg is past pi/2: it swings
    unless the law lessens it."""
    faults = read_faults(["compute_delay:from=0,sec=0.02"], ())
    builder = DiagramBuilder()
    station = builder.AddSystem(
        make_station(StationConfig(noise=NO_NOISE), wrong=StationFaults(faults))
    )
    plant = make_control_plant(BALL_ROLLING)
    law = builder.AddSystem(
        ImpedanceController(ImpedanceConfig(offset_sec=5e-4), plant)
    )
    for port, name in (("position_measured", "q"), ("velocity_measured", "v")):
        builder.Connect(station.GetOutputPort(f"panda.{port}"), law.GetInputPort(name))
    if knows:
        builder.Connect(station.GetOutputPort("panda.delay"), law.GetInputPort("delay"))
    builder.Connect(
        law.GetOutputPort("tau"), station.GetInputPort("panda.torque_commanded")
    )
    diagram = builder.Build()
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    at_rest = plant.CreateDefaultContext()
    x_d = np.zeros(19)
    x_d[:3] = plant.GetFrameByName("tip").CalcPoseInWorld(at_rest).translation()
    x_d[:3] += [0.0, 0.02, 0.02]
    x_d[3] = 1.0
    law.GetInputPort("x_desired").FixValue(law.GetMyMutableContextFromRoot(root), x_d)
    simulator.AdvanceTo(1.5)
    own = station.GetMyContextFromRoot(root)
    speed = abs(station.GetOutputPort("panda.velocity_measured").Eval(own)).max()
    worst = verdict(station.GetOutputPort(MONITOR).Eval(own))
    if knows:
        assert speed < 0.02 and worst.kept
    else:
        assert speed > 0.2


def runs(angle, **more):
    return {
        "limits_kept": True,
        "contact_force_peak_N": 20.0,
        "angle_by_second_rad": angle,
    } | more


def test_recovered_held_and_failed_are_told_apart():
    fault = read_fault("push:from=6,for=1")
    plain = runs([0.4 * t for t in range(20)])
    slow = [0.4 * min(t, 7) + 0.21 * max(t - 7, 0) for t in range(20)]
    stopped = [0.4 * min(t, 7) for t in range(20)]
    assert judge(fault, runs(slow), plain) == RECOVERED
    assert judge(fault, runs(stopped), plain) == HELD
    assert judge(fault, runs(slow[:15]), plain) == HELD  # The ball was lost.
    assert judge(fault, runs(slow, limits_kept=False), plain) == FAILED
    assert judge(fault, runs(slow, contact_force_peak_N=80.0), plain) == FAILED
    assert judge(fault, {"error": "exit status 3"}, plain) == FAILED


def test_runs_that_were_held_and_came_to_rest_are_counted():
    speeds = [0.004, 0.2, 0.0, float("nan")]
    ended = [{"tip_speed_end_m_s": speed} for speed in speeds] + [{"error": "x"}]
    assert at_rest(ended, [HELD, HELD, RECOVERED, HELD, FAILED]) == 1


def test_speed_at_the_end_is_that_of_the_last_second_alone():
    time = np.arange(0.0, 3.0, 0.0125)
    p_tip = np.zeros((len(time), 3))
    p_tip[:, 1] = np.where(time < 1.9, 5.0 * time, 9.5)  # At rest for 1.1 s.
    nothing = np.zeros(len(time))
    track = Track(time, p_tip, p_tip, *[nothing] * 6)
    assert speed_at_the_end(track) == 0.0
    track.p_tip[:, 0] = 0.3 * time
    np.testing.assert_allclose(speed_at_the_end(track), 0.3, rtol=1e-12)


def test_a_run_says_whether_its_limits_were_kept(tmp_path):
    config = BallRollingConfig(camera=CameraConfig(renderer="drawn"), faults=["none"])
    with Session(tmp_path / "out", progress=False) as session:
        assert session.limits_kept() == {}
        diagram = make_ball_rolling(config)
        tau = diagram.GetSubsystemByName("impedance_controller").GetOutputPort("tau")
        session.simulate(diagram, 0.05, {"tau": tau})
        said = session.limits_kept()
    assert said["limits_kept"] and said["ticks_not_finite"] == 0
    assert 0.1 < said["torque_share_max"] < 1.0  # It carries the arm.
    assert said["joint_range_excess_rad"] < 0.0


@pytest.mark.parametrize(
    ("make", "config"),
    [(make_push_object, PushObjectConfig), (make_wall_friction, WallFrictionConfig)],
)
def test_an_arm_with_faults_knows_how_late_its_torques_act(make, config):
    diagram = make(config(faults=["compute_delay:from=0,sec=0.01"]))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.03)
    impedance = diagram.GetSubsystemByName("impedance_controller")
    context = impedance.GetMyContextFromRoot(simulator.get_context())
    assert impedance.GetInputPort("delay").Eval(context)[0] == pytest.approx(0.01)
    assert diagram.GetSubsystemByName("station").HasOutputPort(MONITOR)


def test_push_object_has_no_faults_of_a_camera():
    with pytest.raises(ValueError, match="glare: there is no camera here"):
        make_push_object(PushObjectConfig(faults=["glare"]))


def test_beside_a_run_that_does_not_roll_nothing_is_recovered():
    fault, still = read_fault("push:from=6,for=1"), runs([1.0] * 20)
    assert judge(fault, still, still) == UNJUDGED
    back = runs([-0.4 * t for t in range(20)])
    assert judge(fault, back, back) == UNJUDGED
    short = runs([0.4 * t for t in range(8)])
    assert judge(fault, short, short) == UNJUDGED
    assert judge(fault, still, {"error": "exit status 3"}) == UNJUDGED
    assert judge(fault, runs([1.0] * 20, limits_kept=False), still) == FAILED


def test_faults_of_the_command_line_come_beside_those_of_the_config():
    own = with_faults(ContactLearningConfig(), ["box"], "contact_learning")
    both = with_faults(own, ["push:from=2"], "contact_learning")
    assert both.control.faults == ["box", "push:from=2"]


def test_rehearsals_have_no_faults():
    config = ContactLearningConfig()
    config = replace(config, control=replace(config.control, faults=["box"]))
    config = replace(config, rehearse=1)
    task = make_task(config)

    class Done(Exception):
        pass

    def trial(knowledge, k, label, config, task):
        assert config.control.faults == [] and config.trials == before.trials
        assert task.world is task.model
        assert (knowledge, k, label) == (known, 0, "rehearsal_1")
        raise Done

    before, known = config, Knowledge(contacts=task.prior)
    with pytest.raises(Done):
        rehearsed(config, task, trial, known)
    assert rehearsed(replace(config, rehearse=0), task, trial, known) is known


def test_a_ball_beside_the_camera_is_not_painted():
    camera = camera_model(CameraConfig())
    system = PaintedPictures(camera, 0, [0.0, 0.0, 0.0], 0.03, (9, 8, 7), 0.0, 1.0)
    context = system.CreateDefaultContext()
    blank = ImageRgba8U(camera.width, camera.height)
    system.GetInputPort("image").FixValue(context, Value(blank))
    for z in np.linspace(0.0, 3.0, 31):  # Lifted by a hand, through the camera.
        poses = [RigidTransform([0.5, 0.0, z])]
        system.GetInputPort("body_poses").FixValue(context, Value(poses))
        painted = np.array(system.get_output_port().Eval(context).data)
    assert not painted[:, :, :3].any()
