import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageRgba8U

from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.station import (
    BALL_ROLLING,
    SensorNoise,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.tool_wrench import external_wrench
from makebreak.systems.perception.noisy_sensor import NoisySensor
from makebreak.systems.perception.numerics.sensor_noise import add_noise

NO_NOISE = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)
EFFORT = np.repeat([87.0, 12.0], [4, 3])


def scene_with_ball(x, y):
    scene = read_scene(BALL_ROLLING)
    scene.initial.poses["ball.ball"] = [1, 0, 0, 0, x, y, 0.0315]
    return scene


def pressing_loop(p_tip, seconds, noise=NO_NOISE, ball=(0.5, 0.0)):
    """The station with the arm sent to p_tip, and its contexts after some time."""
    builder = DiagramBuilder()
    station = builder.AddSystem(
        make_station(StationConfig(noise=noise), scene=scene_with_ball(*ball))
    )
    controller = builder.AddSystem(
        ImpedanceController(ImpedanceConfig(offset_sec=5e-4), make_control_plant())
    )
    for port, name in (("position", "q"), ("velocity", "v")):
        builder.Connect(
            station.GetOutputPort(f"panda.{port}_measured"),
            controller.GetInputPort(name),
        )
    builder.Connect(
        controller.GetOutputPort("tau"), station.GetInputPort("panda.torque_commanded")
    )
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    x_d = np.zeros(19)
    x_d[:3], x_d[3] = p_tip, 1.0
    controller.GetInputPort("x_desired").FixValue(
        controller.GetMyMutableContextFromRoot(root), x_d
    )
    # To just before a step, where torque and contact belong to each other.
    simulator.AdvanceTo(seconds + 0.0007)
    return station, station.GetMyContextFromRoot(root)


def test_ports_are_the_contract():
    station = make_station(StationConfig(camera=CameraConfig(renderer="drawn")))
    assert station.GetInputPort("panda.torque_commanded").size() == 7
    sizes = {
        "panda.position_measured": 7,
        "panda.velocity_measured": 7,
        "panda.torque_measured": 7,
        "panda.external_wrench": 6,
        "state": 27,  # Arm 7 + 7, ball 7 + 6.
        "contact_force": 4,
    }
    for name, size in sizes.items():
        assert station.GetOutputPort(name).size() == size, name
    image = station.GetOutputPort("overhead.rgb_image").Allocate().get_value()
    assert isinstance(image, ImageRgba8U)
    assert not make_station(StationConfig()).HasOutputPort("overhead.rgb_image")


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_without_noise_sensors_tell_the_truth_and_torque_is_clipped(size):
    station = make_station(StationConfig(noise=NO_NOISE))
    context = station.CreateDefaultContext()
    plant = station.GetSubsystemByName("plant")
    v = np.linspace(-0.3, 0.3, 7)
    plant_context = plant.GetMyMutableContextFromRoot(context)
    plant.SetVelocities(plant_context, np.concatenate([v, np.zeros(6)]))
    tau = size * EFFORT * [1, -1, 1, -1, 1, -1, 1]
    station.GetInputPort("panda.torque_commanded").FixValue(context, tau)
    q = list(read_scene(BALL_ROLLING).initial.positions.values())
    for name, expected in (
        ("position", q),
        ("velocity", v),
        ("torque", np.clip(tau, -EFFORT, EFFORT)),
    ):
        measured = station.GetOutputPort(f"panda.{name}_measured").Eval(context)
        np.testing.assert_array_equal(measured, expected)


def test_noise_has_the_stated_deviation_and_is_independent():
    std = np.array([1.0, 0.0, 1e-3])
    value = np.array([5.0, 6.0, 7.0])
    rows = np.array([add_noise(value, std, 3, k) for k in range(20000)])
    z = (rows - value)[:, [0, 2]] / [1.0, 1e-3]
    # Mean and deviation of 20000 samples: 4 standard errors.
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=4 / np.sqrt(20000))
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=4 / np.sqrt(40000))
    np.testing.assert_array_equal(rows[:, 1], 6.0)
    # Channel against channel, sample against the next one, seed against seed; and
    # the tails: 2.28 % beyond two deviations.
    other = np.array([add_noise(value, std, 4, k)[0] for k in range(20000)]) - 5.0
    pairs = [(z[:, 0], z[:, 1]), (z[1:, 0], z[:-1, 0]), (z[:, 0], other)]
    for a, b in pairs:
        assert abs(np.mean(a * b)) < 4 / np.sqrt(len(a))
    beyond = np.mean(z[:, 0] > 2.0)
    np.testing.assert_allclose(beyond, 0.02275, atol=4 * np.sqrt(0.0223 / 20000))


def test_station_noise_comes_from_the_seed_alone():
    def readings(seed):
        station = make_station(StationConfig(seed=seed))
        context = station.CreateDefaultContext()
        station.GetInputPort("panda.torque_commanded").FixValue(context, np.zeros(7))
        context.SetTime(0.123)
        names = ("position_measured", "velocity_measured", "torque_measured")
        ports = [station.GetOutputPort(f"panda.{name}") for name in names]
        ports.append(station.GetOutputPort("panda.external_wrench"))
        return [port.Eval(context) for port in ports]

    first, again, other = readings(0), readings(0), readings(1)
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.all(a != c)
    # Each sensor has noise of its own: not one sequence scaled.
    velocity, torque = first[1] / 1e-3, first[2] / 0.1
    assert np.abs(velocity - torque).min() > 1e-6


def test_reading_follows_the_value_and_holds_its_noise_for_a_sample():
    sensor = NoisySensor([1.0], seed=0, period_sec=0.001)
    context = sensor.CreateDefaultContext()
    read = []
    for time, value in ((0.01, 0.0), (0.0104, 1.0), (0.011, 1.0)):
        context.SetTime(time)
        sensor.GetInputPort("value").FixValue(context, [value])
        read.append(sensor.GetOutputPort("measured").Eval(context)[0])
    np.testing.assert_allclose(read[1] - read[0], 1.0, atol=1e-14)
    assert abs(read[2] - read[1]) > 1e-3


def test_wrench_arithmetic_is_a_balance_of_moments():
    # A tool of 2 kg hangs with its mount turned, and its tip turned in it; pushed at
    # its tip.
    plant = make_control_plant()
    q, context = np.linspace(0.2, -1.4, 7), plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    R_WE = plant.GetFrameByName("tip").CalcPoseInWorld(context).rotation().matrix()
    R_CE = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    R = R_WE @ R_CE.T
    chain = packed(serial_chain_of(plant, "tip"))
    p_CM, p_CE = np.array([0.1, 0, 0]), np.array([0.2, 0.1, 0])
    weight, push = np.array([0, 0, -20.0]), np.array([1.0, 2.0, 3.0])
    f_mount = -(weight + push)
    t_mount = -np.cross(R @ p_CM, weight) - np.cross(R @ p_CE, push)
    mount = R.T @ f_mount, R.T @ t_mount
    found = external_wrench(*mount, q, chain, R_CE, weight, p_CM, p_CE)
    np.testing.assert_allclose(found, [*push, 0, 0, 0], atol=1e-13)


def test_wrench_is_nothing_while_the_arm_holds_still():
    station, context = pressing_loop([0.5, 0.0, 0.1], 1.0, ball=(0.8, 0.3))
    wrench = station.GetOutputPort("panda.external_wrench").Eval(context)
    # The posture still settles by 1e-5 m; 0.12 kg at some mm/s2.
    np.testing.assert_allclose(wrench, 0.0, atol=2e-3)
    force = station.GetOutputPort("contact_force").Eval(context)
    np.testing.assert_array_equal(force, 0.0)


def test_wrench_and_true_contact_force_agree_with_the_spring():
    # The tip is sent 6 mm into the ball from straight above: K = 1000 N/m, so 6 N
    # less what the contacts give way (two of 1e5 N/m: 0.1 mm).
    station, context = pressing_loop([0.5, 0.0, 0.063 + 0.0195 - 0.006], 3.0)
    force = station.GetOutputPort("contact_force").Eval(context)
    wrench = station.GetOutputPort("panda.external_wrench").Eval(context)
    np.testing.assert_allclose(force[0], 6.0, atol=0.2)
    np.testing.assert_allclose(force[1:], [0.0, 0.0, -force[0]], atol=0.05)
    np.testing.assert_allclose(wrench[:3], -force[1:], atol=5e-3)
    # The force passes the tip's centre: no moment there but friction's.
    np.testing.assert_allclose(wrench[3:], 0.0, atol=2e-3)


def test_contact_force_is_the_one_between_the_named_bodies():
    # The ball alone on the table presses it with m g; the tip has no part in it.
    scene = scene_with_ball(0.8, 0.3)
    config = StationConfig(noise=NO_NOISE, contact=["ball", "table"])
    station = make_station(config, scene=scene)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.GetInputPort("panda.torque_commanded").FixValue(context, np.zeros(7))
    simulator.AdvanceTo(0.1)
    force = station.GetOutputPort("contact_force").Eval(context)
    weight = 0.07 * 9.81
    np.testing.assert_allclose(force, [weight, 0, 0, -weight], atol=1e-4)


def test_control_plant_is_the_arm_and_its_tool_alone():
    plant = make_control_plant()
    assert plant.num_positions() == plant.num_velocities() == 7
    context = plant.CreateDefaultContext()
    np.testing.assert_allclose(plant.CalcTotalMass(context), 16.6919 + 0.12, atol=1e-4)
    scene = read_scene(BALL_ROLLING)
    q = list(scene.initial.positions.values())
    np.testing.assert_array_equal(plant.GetPositions(context), q)


def test_control_plant_has_the_effects_of_arm_and_tool_alone():
    scene = read_scene(BALL_ROLLING)
    scene.effects = [
        Effect("object_size", ["finger"], {"scale": 2.0}),
        Effect("object_size", ["ball"], {"scale": 2.0}),
        Effect("contact_friction", ["finger~ball"], {"friction": 0.4}),
    ]
    plant = make_control_plant(scene)
    com = plant.GetBodyByName("finger").default_com()
    np.testing.assert_allclose(com[2], 2 * 0.0919623)


def test_station_and_controller_move_alike():
    # The simulated arm accelerates as inv(M) (tau - bias) of the control plant.
    station = make_station(
        StationConfig(noise=NO_NOISE), scene=scene_with_ball(0.8, 0.3)
    )
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    plant, own = station.GetSubsystemByName("plant"), make_control_plant()
    own_context = own.CreateDefaultContext()
    tau = np.array([5.0, -20.0, 3.0, 20.0, 1.0, 2.0, -0.5])
    station.GetInputPort("panda.torque_commanded").FixValue(context, tau)
    bias = own.CalcBiasTerm(own_context) - own.CalcGravityGeneralizedForces(own_context)
    expected = 0.001 * np.linalg.solve(own.CalcMassMatrix(own_context), tau - bias)
    simulator.AdvanceTo(0.001)
    v = plant.GetVelocities(plant.GetMyContextFromRoot(context))[:7]
    np.testing.assert_allclose(v, expected, rtol=1e-6, atol=1e-9)


def test_a_torque_written_before_a_step_acts_in_it():
    # The plant steps at 0 and at 1 ms. At rest until 0.5 ms, then 1 N m more.
    station = make_station(StationConfig(noise=NO_NOISE))
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    own = make_control_plant()
    own_context = own.CreateDefaultContext()
    tau = -own.CalcGravityGeneralizedForces(own_context)
    port = station.GetInputPort("panda.torque_commanded")
    port.FixValue(context, tau)
    simulator.AdvanceTo(0.0005)
    port.FixValue(context, tau + 1.0)
    simulator.AdvanceTo(0.0015)
    v = station.GetOutputPort("panda.velocity_measured").Eval(context)
    expected = 0.001 * np.linalg.solve(own.CalcMassMatrix(own_context), np.ones(7))
    np.testing.assert_allclose(v, expected, rtol=1e-6, atol=1e-9)


def test_state_is_the_plants():
    station = make_station(StationConfig())
    context = station.CreateDefaultContext()
    x = station.GetOutputPort("state").Eval(context)
    q = list(read_scene(BALL_ROLLING).initial.positions.values())
    ball = [1, 0, 0, 0, 0.6, 0, 0.0315]
    np.testing.assert_array_equal(x, np.concatenate([q, ball, np.zeros(13)]))


@pytest.mark.parametrize(
    "config, words",
    [
        (StationConfig(contact=["finger"]), "expected two models"),
        (StationConfig(contact=["finger", "bell"]), "contact names 'bell'"),
        (StationConfig(contact=["panda", "ball"]), "a model of one body"),
        (
            StationConfig(noise=SensorNoise(torque=-1.0)),
            "expected numbers of 0 or more",
        ),
        (StationConfig(seed=-1), "seed is -1"),
        (StationConfig(scene="nowhere.yaml"), "nowhere.yaml does not exist"),
    ],
)
def test_bad_configs_are_refused(config, words):
    with pytest.raises(ValueError, match=words):
        make_station(config)
