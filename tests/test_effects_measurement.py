"""What lies between a true value and its channel: offset, bias, delay, skew, scale."""

import numpy as np
import pytest
from effect_scenes import (
    LENGTH,
    MASS,
    G,
    J,
    at_rest_but,
    on_ground,
    pendulum,
    with_effects,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.diagrams.station import (
    BALL_ROLLING,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_diagram import make_scene_diagram
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene

TIMES = np.linspace(0.0, 0.5, 26)
Z0, VX, VZ = 20.0, 1.5, 2.0
TRUE = {
    "x": lambda t: VX * t,
    "z": lambda t: Z0 + VZ * t - G * t**2 / 2,
    "vz": lambda t: VZ - G * t,
    "wz": lambda t: 3.0 + 0 * t,
}
THROWN = at_rest_but(
    body="b.ball", pose=[1, 0, 0, 0, 0, 0, Z0], twist=[0, 0, 3.0, VX, 0, VZ]
)


def throw(folder, time_step, *effects):
    """Channels x, z, vz, wz of a thrown ball, (n, 4)."""
    scene = with_effects(on_ground(folder, "ball", time_step, z=Z0), *effects)
    simulation = SceneSimulation(scene)
    channels = [f"b.ball.{name}" for name in TRUE]
    return simulation.run(THROWN, TIMES, channels, initial_is_true=True)


@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-6), (0.0005, 0.003)])
@pytest.mark.parametrize(
    "effect, measured",
    [
        # Each channel as a function of the truth and of time.
        (("sensor_bias", "b.ball.z", dict(bias=0.2)), {"z": lambda f, t: f(t) + 0.2}),
        (
            ("sensor_delay", "b.ball", dict(delay=0.013)),
            {name: lambda f, t: f(t - 0.013) for name in TRUE},
        ),
        (
            ("sensor_delay", "b.ball.vz", dict(delay=0.02)),
            {"vz": lambda f, t: f(t - 0.02)},
        ),
        (
            ("clock_skew", "b", dict(skew=0.04)),
            {name: lambda f, t: f(t / 1.04) for name in TRUE},
        ),
        (
            ("length_scale", "b.ball", dict(scale=1.05)),
            {name: lambda f, t: 1.05 * f(t) for name in ("x", "z", "vz")},
        ),
        (
            ("length_scale", "world", dict(scale=0.95)),
            {name: lambda f, t: 0.95 * f(t) for name in ("x", "z", "vz")},
        ),
    ],
)
def test_a_thrown_ball_is_measured_so(tmp_path, effect, measured, time_step, atol):
    # atol of the discrete plant: its height is late by a step: 0.5 ms x 3 m/s / 2.
    rows = throw(tmp_path, time_step, effect)
    for i, (name, true) in enumerate(TRUE.items()):
        how = measured.get(name, lambda f, t: f(t))
        expected = how(true, TIMES)
        # What shows a time before the start is unknown.
        before = np.isnan(rows[:, i])
        delay = effect[2].get("delay", 0.0) if name in measured else 0.0
        np.testing.assert_array_equal(before, TIMES < delay - 1e-12)
        np.testing.assert_allclose(rows[~before, i], expected[~before], atol=atol)


def test_effects_on_one_channel_add_up(tmp_path):
    rows = throw(
        tmp_path,
        0.0,
        ("sensor_delay", "b.ball.z", dict(delay=0.01)),
        ("sensor_delay", "b.ball", dict(delay=0.01)),
        ("clock_skew", "b.ball.z", dict(skew=0.01)),
        ("length_scale", "b", dict(scale=1.1)),
        ("sensor_bias", "b.ball.z", dict(bias=0.3)),
    )
    expected = 1.1 * TRUE["z"]((TIMES - 0.02) / 1.01) + 0.3
    np.testing.assert_allclose(rows[1:, 1], expected[1:], atol=1e-6)


def test_what_is_measured_is_taken_back_to_the_truth(tmp_path):
    scene = with_effects(
        on_ground(tmp_path, "ball", 0.0, z=Z0),
        ("sensor_delay", "b.ball.z", dict(delay=0.02)),
        ("clock_skew", "b.ball.z", dict(skew=0.01)),
        ("sensor_bias", "b.ball.z", dict(bias=0.3)),
    )
    simulation = SceneSimulation(scene)
    measured = TRUE["z"]((TIMES - 0.02) / 1.01) + 0.3
    value = simulation.true_at("b.ball.z", 0.2, TIMES, measured)
    # A line between samples 20 ms apart: g (0.02)^2/8 = 5e-4.
    np.testing.assert_allclose(value, TRUE["z"](0.2), atol=1e-3)
    # A measured initial value is taken as such.
    start = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, 0, 0, Z0 + 0.3])
    rows = simulation.run(start, np.array([0.1, 0.2]), ["b.ball.z"], start_sec=0.0)
    true = Z0 - G * ((np.array([0.1, 0.2]) - 0.02) / 1.01) ** 2 / 2
    np.testing.assert_allclose(rows[:, 0], true + 0.3, atol=1e-6)


def test_an_offset_is_in_what_is_measured_and_not_in_how_it_moves(tmp_path):
    scene = with_effects(pendulum(tmp_path), ("joint_offset", "p.j1", dict(offset=0.2)))
    scene.initial.positions = {"p.j1": 0.7}  # Measured: it hangs at 0.5.
    rows = SceneSimulation(scene).run(
        scene.initial, TIMES, ["p.j1.position", "p.j1.velocity", "p.rod.qy"]
    )
    q, v = solve_ivp(
        lambda t, x: [x[1], -MASS * G * LENGTH / J * np.sin(x[0])],
        (0, 0.5),
        [0.5, 0.0],
        t_eval=TIMES,
        rtol=1e-10,
        atol=1e-12,
    ).y
    expected = np.stack([q + 0.2, v, np.sin(q / 2)], axis=1)
    np.testing.assert_allclose(rows, expected, atol=1e-5)
    # A diagram's default state is the true one, too.
    plant = load_scene(scene, DiagramBuilder()).plant
    np.testing.assert_allclose(plant.GetPositions(plant.CreateDefaultContext()), [0.5])


def test_a_live_diagram_measures_so_too(tmp_path):
    effects = [
        ("joint_offset", "p.j1", dict(offset=0.2)),
        ("sensor_bias", "p.j1.velocity", dict(bias=-0.1)),
        ("sensor_delay", "p.j1.position", dict(delay=0.02)),
    ]
    scene = with_effects(pendulum(tmp_path, 0.001), *effects)
    scene.initial.positions = {"p.j1": 0.9}
    diagram, loaded = make_scene_diagram(scene)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    rows = []
    for t in TIMES:
        if t > 0:  # At 0 it would step already.
            simulator.AdvanceTo(t)
        names = ("p.position_measured", "p.velocity_measured")
        rows.append([diagram.GetOutputPort(n).Eval(context)[0] for n in names])
        rows[-1] += list(diagram.GetOutputPort("state").Eval(context))
    rows = np.array(rows)
    np.testing.assert_allclose(rows[0, 2], 0.7)  # It swings.
    np.testing.assert_allclose(rows[1:, 0], rows[:-1, 2] + 0.2, atol=1e-12)
    np.testing.assert_allclose(rows[:, 1], rows[:, 3] - 0.1, atol=1e-12)


def test_the_station_measures_and_drives_as_its_scene_says():
    scene = read_scene(BALL_ROLLING)
    config = StationConfig()
    for name in ("position", "velocity", "torque", "force", "moment"):
        setattr(config.noise, name, 0.0)
    scene.effects = [
        Effect("joint_offset", ["panda.panda_joint2"], {"offset": 0.03}),
        Effect("sensor_bias", ["panda.panda_joint7.effort_measured"], {"bias": 0.5}),
        Effect("actuator_gain", ["panda.panda_joint4"], {"gain": 0.5}),
    ]
    station = make_station(config, scene=scene)
    context = station.CreateDefaultContext()
    command = np.arange(1.0, 8.0)
    station.GetInputPort("panda.torque_commanded").FixValue(context, command)
    plant = station.GetSubsystemByName("plant")
    own = plant.GetMyContextFromRoot(context)
    arm = plant.GetModelInstanceByName("panda")
    true = plant.GetPositions(own, arm)
    measured = station.GetOutputPort("panda.position_measured").Eval(context)
    np.testing.assert_allclose(measured - true, [0, 0.03, 0, 0, 0, 0, 0], atol=1e-12)
    torque = station.GetOutputPort("panda.torque_measured").Eval(context)
    np.testing.assert_allclose(torque, [1, 2, 3, 2, 5, 6, 7.5])
    applied = plant.get_actuation_input_port(arm).Eval(own)
    np.testing.assert_allclose(applied, [1, 2, 3, 2, 5, 6, 7])


def test_the_station_takes_every_friction_and_elasticity():
    # Its controllers' plant has seven coordinates and no damping, whatever the scene.
    scene = read_scene(BALL_ROLLING)
    joint = ["panda.panda_joint4"]
    scene.effects = [
        Effect("joint_viscous_damping", joint, {"damping": 1.0}),
        Effect("joint_coulomb_friction", joint, {"coulomb": 1.0}),
        Effect("joint_elasticity", joint, {"stiffness": 5e3, "damping": 1.0}),
        Effect("gravity_tilt", ["world"], {"roll": 0.1, "pitch": 0.0}),
    ]
    station = make_station(StationConfig(), scene=scene)
    context = station.CreateDefaultContext()
    assert station.GetOutputPort("panda.position_measured").Eval(context).shape == (7,)
    control = make_control_plant(scene)
    assert control.num_positions() == 7
    gravity = control.gravity_field().gravity_vector()
    np.testing.assert_allclose(gravity, [0, -G * np.sin(0.1), -G * np.cos(0.1)])


def test_a_scene_without_such_effects_has_no_systems_of_theirs():
    # So their results are bit for bit those of before.
    names = [system.get_name() for system in make_station(StationConfig()).GetSystems()]
    assert "plant" in names
    assert not [name for name in names if "path" in name or "Measured" in name]


def test_parameters_are_changed_without_building_anew(tmp_path):
    base = on_ground(tmp_path, "ball", 0.0, z=Z0)
    simulation = SceneSimulation(
        with_effects(base, ("sensor_delay", "b.ball", dict(delay=0.01)))
    )
    simulation.set_effects([Effect("sensor_delay", ["b.ball"], {"delay": 0.02})])
    rows = simulation.run(THROWN, TIMES, ["b.ball.z"], initial_is_true=True)
    assert simulation.builds == 1
    np.testing.assert_allclose(rows[1:, 0], TRUE["z"](TIMES[1:] - 0.02), atol=1e-6)


@pytest.mark.parametrize(
    "effect, words",
    [
        (("joint_offset", "p.rod", dict(offset=0.1)), "expected a joint or a model"),
        (("joint_offset", "p.j1.velocity", dict(offset=0.1)), "expected a joint"),
        (("sensor_delay", "p.j1", dict(delay=-0.1)), "delay is -0.1, expected >= 0"),
        (("sensor_delay", "p.j9", dict(delay=0.1)), "no joint, body or frame 'j9'"),
        (
            ("sensor_bias", "p.j1.torque", dict(bias=0.1)),
            "no measured channel 'torque'",
        ),
        (("sensor_bias", "q.j1", dict(bias=0.1)), "no model 'q'"),
        (("clock_skew", "p.j1", dict()), "needs `skew`"),
        (("length_scale", "p.j1", dict(scale=1.1)), "expected a body"),
        (("length_scale", "p.rod", dict(scale=0.0)), "scale is 0.0, expected > 0"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, effect, words):
    with pytest.raises(ValueError, match=words):
        load_scene(with_effects(pendulum(tmp_path), effect), DiagramBuilder())


def test_commands_are_no_measured_channel(tmp_path):
    # A bias at a joint changes what is measured there, not what it is told.
    scene = with_effects(pendulum(tmp_path), ("sensor_bias", "p.j1", dict(bias=0.5)))
    commands = Commands(np.array([0.0]), {"p.j1.effort_command": np.array([1.0])})
    simulation = SceneSimulation(scene)
    rows = simulation.run(
        at_rest_but({"p.j1": 0.5}), TIMES[:2], ["p.j1.effort_measured"], commands
    )
    np.testing.assert_allclose(rows[:, 0], 1.5)
