"""What lies between command and joint: gain, bias, limit, delay, lag, drives."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import (
    LENGTH,
    MASS,
    G,
    J,
    at_rest_but,
    double,
    pendulum,
    with_effects,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_diagram import make_scene_diagram
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.drives import law_of
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import load_scene, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.models.scene_schema import ActuationSection, SupplySection

CHANNELS = ["p.j1.position", "p.j1.velocity", "p.j1.effort_measured"]
TIMES = np.linspace(0.0, 1.0, 101)
COMMAND = 1.5 * np.sign(np.sin(9.0 * TIMES + 0.1)) + TIMES  # Jumps.
KINDS = {
    "actuator_gain": dict(gain=0.7),
    "actuator_bias": dict(bias=0.6),
    "actuator_saturation": dict(limit=1.2),
    "input_delay": dict(delay=0.017),
    "actuator_lag": dict(time_constant=0.03),
}


def held(t):
    """The command of the last row."""
    return COMMAND[np.maximum(np.searchsorted(TIMES, t + 1e-9, "right") - 1, 0)]


def applied(kind, p):
    """Effort as a function of time, for a recording that starts at 0: before it the
    command is what it is at the start."""
    if kind == "actuator_gain":
        return lambda t: p["gain"] * held(t)
    if kind == "actuator_bias":
        return lambda t: held(t) + p["bias"]
    if kind == "actuator_saturation":
        return lambda t: np.clip(held(t), -p["limit"], p["limit"])
    if kind == "input_delay":
        return lambda t: held(t - p["delay"])
    # y' = (u - y)/T, u held: exponentials from row to row.
    T, y = p["time_constant"], [COMMAND[0]]
    for u in COMMAND[:-1]:
        y.append(u + (y[-1] - u) * np.exp(-0.01 / T))

    def lag(t):
        k = np.maximum(np.searchsorted(TIMES, t + 1e-9, "right") - 1, 0)
        return COMMAND[k] + (np.array(y)[k] - COMMAND[k]) * np.exp(-(t - TIMES[k]) / T)

    return lag


def exact(effort, start, times=TIMES):
    """The pendulum's position and velocity; restarts where the effort may jump."""

    def rate(t, x, shift):
        return [x[1], (effort(t + shift) - MASS * G * LENGTH * np.sin(x[0])) / J]

    x, rows = np.array(start), [start]
    for a, b in zip(times[:-1], times[1:], strict=True):
        # Within a step the effort jumps at most once, at 7 ms (the delay).
        for c, d in ((a, a + 0.007), (a + 0.007, b)):
            # Evaluated inside the piece, never on its edge.
            x = solve_ivp(
                lambda t, x, c=c, d=d: rate(np.clip(t, c + 1e-7, d - 1e-7), x, 0.0),
                (c, d),
                x,
                rtol=1e-9,
                atol=1e-11,
            ).y[:, -1]
        rows.append(x)
    return np.array(rows)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_pendulum_feels_the_changed_command(tmp_path, kind, time_step):
    scene = with_effects(pendulum(tmp_path, time_step), (kind, "p.j1", KINDS[kind]))
    commands = Commands(TIMES, {"p.j1.effort_command": COMMAND})
    simulation = SceneSimulation(scene)
    rows = simulation.run(at_rest_but({"p.j1": 0.4}), TIMES, CHANNELS, commands)
    effort = applied(kind, KINDS[kind])
    expected = exact(effort, [0.4, 0.0])
    # Integrator's accuracy; the discrete scheme's first order at 1 ms and 20 rad/s2.
    atol = 5e-5 if time_step == 0.0 else 0.02
    np.testing.assert_allclose(rows[:, :2], expected, atol=atol)
    assert abs(exact(held, [0.4, 0.0]) - expected).max() > 2 * atol
    # What acts from each row on; a lag starts a row where the last one ended.
    np.testing.assert_allclose(rows[:, 2], effort(TIMES), atol=5e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_window_in_the_middle_is_as_the_whole(tmp_path, kind):
    # From the state at 0.5 s on: delay and lag know the commands before the window.
    scene = with_effects(pendulum(tmp_path), (kind, "p", KINDS[kind]))
    commands = Commands(TIMES, {"p.j1.effort_command": COMMAND})
    simulation = SceneSimulation(scene)
    whole = simulation.run(at_rest_but({"p.j1": 0.4}), TIMES, CHANNELS, commands)
    q, v, _ = whole[50]
    part = simulation.run(
        at_rest_but({"p.j1": q}, {"p.j1": v}), TIMES[50:], CHANNELS, commands
    )
    # A lag of 0.03 s forgets in 0.36 s, to 6e-6.
    np.testing.assert_allclose(part, whole[50:], atol=5e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_a_live_diagram_has_the_same_path(tmp_path, kind, time_step):
    # As an experiment wires it: a command on the port, the delay in the diagram.
    scene = with_effects(pendulum(tmp_path, time_step), (kind, "p.j1", KINDS[kind]))
    diagram, loaded = make_scene_diagram(scene)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    loaded.plant.SetPositions(loaded.plant.GetMyMutableContextFromRoot(context), [0.4])
    simulator.get_mutable_integrator().set_target_accuracy(1e-6)
    port = diagram.GetInputPort("p.effort_command")
    fixed = port.FixValue(context, [COMMAND[0]])
    path = loaded.paths["p"].path
    path.set_lagged(path.GetMyMutableContextFromRoot(context), [COMMAND[0]])
    rows = []
    for t, u in zip(TIMES, COMMAND, strict=True):
        if t > 0:
            simulator.AdvanceTo(t)
        fixed.GetMutableData().get_mutable_value().SetFromVector([u])
        names = ("p.position_measured", "p.velocity_measured")
        rows.append([diagram.GetOutputPort(n).Eval(context)[0] for n in names])
    expected = exact(applied(kind, KINDS[kind]), [0.4, 0.0])
    # A live delay in a continuous plant samples the command each millisecond.
    atol = 0.02 if time_step or kind == "input_delay" else 5e-5
    np.testing.assert_allclose(rows, expected, atol=atol)


@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_a_drive_holds_positions_with_its_gains(tmp_path, time_step):
    drive = dict(type="pd", joints=["p.j1"], kp=[40.0], kd=[3.0])
    scene = pendulum(tmp_path, time_step, **drive)
    times = np.linspace(0.0, 0.6, 31)
    target, speed = 0.3 * np.sin(4.0 * times), 1.2 * np.cos(4.0 * times)
    commands = Commands(
        times, {"p.j1.position_command": target, "p.j1.velocity_command": speed}
    )
    rows = SceneSimulation(scene).run(at_rest_but(), times, CHANNELS, commands)
    x, expected = np.zeros(2), [np.zeros(2)]
    for k in range(30):

        def rate(t, x, k=k):
            u = 40.0 * (target[k] - x[0]) + 3.0 * (speed[k] - x[1])
            return [x[1], (u - MASS * G * LENGTH * np.sin(x[0])) / J]

        x = solve_ivp(rate, times[k : k + 2], x, rtol=1e-9, atol=1e-11).y[:, -1]
        expected.append(x)
    atol = 5e-5 if time_step == 0.0 else 0.02
    np.testing.assert_allclose(rows[:, :2], expected, atol=atol)
    u = 40.0 * (target - rows[:, 0]) + 3.0 * (speed - rows[:, 1])
    np.testing.assert_allclose(rows[:, 2], u, atol=1e-9)


def test_a_drive_sees_the_encoders_offset(tmp_path):
    # It brings the measured position to where it shall be: the true one is elsewhere.
    # Without gravity nothing else is in the way.
    drive = dict(type="pd", joints=["p.j1"], kp=[40.0], kd=[8.0])
    scene = with_effects(
        pendulum(tmp_path, gravity=0.0, **drive),
        ("joint_offset", "p.j1", dict(offset=0.1)),
    )
    commands = Commands(np.array([0.0]), {"p.j1.position_command": np.array([0.5])})
    simulation = SceneSimulation(scene)
    channels = ["p.j1.position", "p.rod.qy"]
    rows = simulation.run(at_rest_but(), np.array([0.0, 6.0]), channels, commands)
    # exp(-5 s / 0.2 s) of the way is left.
    np.testing.assert_allclose(rows[1], [0.5, np.sin(0.4 / 2)], atol=1e-4)


SERVO = dict(kp=[30.0], limit=[9.0], dead_band=[0.02], resolution=[0.05])
SUPPLY = dict(voltage=[12.0], kt=[1.2], resistance=[2.0])  # 7.2 N m, 0.72 N m s/rad.


def servo_effort(command, q, v):
    """By the data sheet: duty = kp/(V kt/R) error, at most 1; torque = kt (duty V -
    kt v)/R. The error counts from 0.02 rad on, the command in steps of 0.05 rad."""
    V, kt, R = 12.0, 1.2, 2.0
    error = 0.05 * np.round(command / 0.05) - q
    error = np.sign(error) * max(abs(error) - 0.02, 0.0)
    duty = np.clip(30.0 / (V * kt / R) * error, -1.0, 1.0)
    return kt * (duty * V - kt * v) / R


@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_a_servo_pulls_as_its_data_sheet_says(tmp_path, time_step):
    drive = dict(type="servo", joints=["p.j1"], **SERVO, supply=SupplySection(**SUPPLY))
    scene = pendulum(tmp_path, time_step, **drive)
    times = np.linspace(0.0, 1.2, 25)
    target = 1.1 * np.sin(6.0 * times)
    commands = Commands(times, {"p.j1.position_command": target})
    rows = SceneSimulation(scene).run(at_rest_but(), times, CHANNELS, commands)
    x, expected = np.zeros(2), [np.zeros(2)]
    for k in range(24):

        def rate(t, x, k=k):
            u = servo_effort(target[k], *x)
            return [x[1], (u - MASS * G * LENGTH * np.sin(x[0])) / J]

        x = solve_ivp(
            rate, times[k : k + 2], x, rtol=1e-9, atol=1e-11, max_step=1e-3
        ).y[:, -1]
        expected.append(x)
    # Corners of the law fall within steps of the integrator.
    atol = 2e-4 if time_step == 0.0 else 0.02
    np.testing.assert_allclose(rows[:, :2], expected, atol=atol)
    u = [servo_effort(c, *x) for c, x in zip(target, rows[:, :2], strict=True)]
    np.testing.assert_allclose(rows[:, 2], u, atol=1e-9)
    duty = np.abs((np.array(u) + 0.72 * rows[:, 1]) / 7.2)
    assert duty.max() > 0.999 and duty.min() < 0.5  # Both were seen.


def test_a_servo_at_its_supply_comes_up_to_its_no_load_speed(tmp_path):
    # Without a load, far from its command: v = V/kt (1 - exp(-(kt^2/R) t/J)).
    supply = SupplySection(voltage=[12.0], kt=[1.2], resistance=[2.0])
    drive = dict(type="servo", joints=["p.j1"], kp=[30.0], supply=supply)
    scene = pendulum(tmp_path, gravity=0.0, **drive)
    commands = Commands(np.array([0.0]), {"p.j1.position_command": np.array([100.0])})
    times = np.linspace(0.0, 2.0, 9)
    rows = SceneSimulation(scene).run(at_rest_but(), times, CHANNELS, commands)
    speed = 10.0 * (1.0 - np.exp(-0.72 * times / J))
    np.testing.assert_allclose(rows[:, 1], speed, atol=1e-4)
    np.testing.assert_allclose(rows[:, 2], 7.2 - 0.72 * speed, atol=1e-4)


@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_a_velocity_drive_follows_its_velocity(tmp_path, time_step):
    drive = dict(type="velocity", joints=["p.j1"], kd=[12.0], limit=[6.0])
    scene = pendulum(tmp_path, time_step, **drive)
    times = np.linspace(0.0, 1.2, 25)
    target = 1.5 * np.sign(np.sin(5.0 * times + 0.1))
    commands = Commands(times, {"p.j1.velocity_command": target})
    rows = SceneSimulation(scene).run(at_rest_but(), times, CHANNELS, commands)
    x, expected = np.zeros(2), [np.zeros(2)]
    for k in range(24):

        def rate(t, x, k=k):
            u = np.clip(12.0 * (target[k] - x[1]), -6.0, 6.0)
            return [x[1], (u - MASS * G * LENGTH * np.sin(x[0])) / J]

        x = solve_ivp(
            rate, times[k : k + 2], x, rtol=1e-9, atol=1e-11, max_step=1e-3
        ).y[:, -1]
        expected.append(x)
    atol = 2e-4 if time_step == 0.0 else 0.02
    np.testing.assert_allclose(rows[:, :2], expected, atol=atol)
    u = np.clip(12.0 * (target - rows[:, 1]), -6.0, 6.0)
    np.testing.assert_allclose(rows[:, 2], u, atol=1e-9)
    assert abs(u).max() == 6.0


def test_a_servos_gain_is_changed_in_the_context(tmp_path):
    drive = dict(type="servo", joints=["p.j1"], kp=[30.0], limit=[9.0])
    scene = pendulum(tmp_path, **drive)
    soft = pendulum(tmp_path, **{**drive, "kp": [12.0]})
    commands = Commands(TIMES, {"p.j1.position_command": 0.4 * np.sin(5.0 * TIMES)})
    changed = with_effects(scene, ("servo_gain", "p.j1", dict(kp=12.0)))
    simulation = SceneSimulation(
        with_effects(scene, ("servo_gain", "p.j1", dict(kp=20.0)))
    )
    first = simulation.run(at_rest_but(), TIMES, CHANNELS, commands)
    simulation.set_effects(changed.effects)
    rows = simulation.run(at_rest_but(), TIMES, CHANNELS, commands)
    assert simulation.builds == 1 and abs(rows - first).max() > 0.01
    expected = SceneSimulation(soft).run(at_rest_but(), TIMES, CHANNELS, commands)
    np.testing.assert_allclose(rows, expected, atol=1e-9)
    assert SceneDynamics(scene).now("servo_gain", ["p.j1"]) == {"kp": 30.0}
    assert SceneDynamics(changed).now("servo_gain", ["p.j1"]) == {"kp": 12.0}
    assert SceneDynamics(pendulum(tmp_path)).places("servo_gain") == []


@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_a_gear_keeps_a_share_of_what_it_transmits(tmp_path, time_step):
    # u = tau + share |tau| direction, solved for tau by bisection.
    share = 0.3
    scene = with_effects(
        pendulum(tmp_path, time_step),
        ("joint_load_friction", "p.j1", dict(share=share)),
    )
    commands = Commands(TIMES, {"p.j1.effort_command": 2.0 * COMMAND})
    simulation = SceneSimulation(scene)
    rows = simulation.run(at_rest_but({"p.j1": 0.4}), TIMES, CHANNELS, commands)
    x, expected = np.array([0.4, 0.0]), [[0.4, 0.0]]
    for k in range(100):

        def rate(t, x, k=k):
            u, s = 2.0 * COMMAND[k], np.tanh(x[1] / 0.005)
            tau = brentq(lambda tau: tau + share * abs(tau) * s - u, -50.0, 50.0)
            return [x[1], (tau - MASS * G * LENGTH * np.sin(x[0])) / J]

        x = solve_ivp(rate, TIMES[k : k + 2], x, "Radau", rtol=1e-8, atol=1e-9).y[:, -1]
        expected.append(x)
    atol = 2e-4 if time_step == 0.0 else 0.02
    np.testing.assert_allclose(rows[:, :2], expected, atol=atol)
    # Measured is what the motor gives.
    np.testing.assert_allclose(rows[:, 2], 2.0 * COMMAND, atol=1e-9)
    lossless = SceneSimulation(pendulum(tmp_path, time_step))
    free = lossless.run(at_rest_but({"p.j1": 0.4}), TIMES, CHANNELS, commands)
    assert abs(free - rows).max() > 0.1
    # Another share needs no other plant; none at all is the plant without the effect.
    simulation.set_effects(
        with_effects(scene, ("joint_load_friction", "p.j1", dict(share=0.0))).effects
    )
    again = simulation.run(at_rest_but({"p.j1": 0.4}), TIMES, CHANNELS, commands)
    assert simulation.builds == 1
    np.testing.assert_allclose(again, free, atol=1e-5)


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(kp=[]), r"actuation.kp is \[\], expected one number of 0 or more"),
        (dict(kp=[1.0, 2.0]), "or one for each of the 1 joints"),
        (dict(limit=[0.0]), r"actuation.limit\[0\]: got"),
        (dict(dead_band=[-0.1]), r"actuation.dead_band\[0\]: got"),
        (dict(supply=SupplySection(voltage=[12.0])), r"actuation.supply.kt is \[\]"),
        (
            dict(type="velocity", kd=[3.0]),
            "which a drive of type velocity does not have",
        ),
        (
            dict(type="servos"),
            "actuation.type is 'servos', expected one of none, effort",
        ),
    ],
)
def test_a_drive_that_is_none_is_refused(tmp_path, change, words):
    drive = dict(type="servo", joints=["p.j1"], kp=[30.0]) | change
    with pytest.raises(ValueError, match=words):
        load_scene(pendulum(tmp_path, **drive), DiagramBuilder())


def test_a_servo_in_a_file_may_give_one_number_for_all(tmp_path):
    scene = pendulum(tmp_path)
    path = tmp_path / "servo.scene.yaml"
    write_scene(replace(scene, actuation=ActuationSection()), path)
    path.write_text(
        path.read_text()
        + """
actuation:
  {type: servo, joints: [p.j1], kp: 7.8, limit: 2.9, dead_band: 0.001,
   supply: {voltage: 12, kt: 1.2, resistance: 4.2}}
"""
    )
    read = read_scene(path)
    law = law_of(read.actuation, "p.j1")
    assert (law.kp, law.limit, law.dead_band) == (7.8, 2.9, 0.001)
    assert law.emf == pytest.approx(1.44 / 4.2)
    write_scene(read, path)
    assert read_scene(path).actuation == read.actuation


def test_each_joint_has_its_own_delay_and_gain(tmp_path):
    scene = with_effects(
        double(tmp_path),
        ("input_delay", "d.j2", dict(delay=0.02)),
        ("actuator_gain", "d.j1", dict(gain=0.5)),
        ("actuator_gain", "d.j1", dict(gain=0.5)),
        ("actuator_bias", "d", dict(bias=0.1)),
    )
    times = np.array([0.0, 0.05, 0.06, 0.07, 0.08])
    commands = Commands(
        np.array([0.0, 0.05]),
        {
            "d.j1.effort_command": np.array([0.0, 2.0]),
            "d.j2.effort_command": np.array([0.0, 3.0]),
        },
    )
    rows = SceneSimulation(scene).run(
        at_rest_but(), times, [f"d.j{i}.effort_measured" for i in (1, 2)], commands
    )
    np.testing.assert_allclose(rows[:, 0], [0.1, 0.6, 0.6, 0.6, 0.6])
    np.testing.assert_allclose(rows[:, 1], [0.1, 0.1, 0.1, 3.1, 3.1])


def test_parameters_of_the_path_are_set_without_building_anew(tmp_path):
    scene = with_effects(
        pendulum(tmp_path), *((kind, "p.j1", p) for kind, p in KINDS.items())
    )
    other = with_effects(
        scene,
        *((k, "p.j1", {n: 1.3 * x for n, x in p.items()}) for k, p in KINDS.items()),
    )
    commands = Commands(TIMES, {"p.j1.effort_command": COMMAND})
    simulation = SceneSimulation(scene)
    simulation.set_effects(other.effects)
    initial = at_rest_but({"p.j1": 0.4})
    rows = simulation.run(initial, TIMES, CHANNELS, commands)
    assert simulation.builds == 1
    fresh = SceneSimulation(other).run(initial, TIMES, CHANNELS, commands)
    np.testing.assert_array_equal(rows, fresh)


def test_lost_commands_go_on_and_late_ones_are_no_error():
    nan = np.nan
    commands = Commands(np.arange(4.0), {"a": np.array([nan, 1.0, nan, 2.0])})
    np.testing.assert_array_equal(commands.columns["a"], [1.0, 1.0, 1.0, 2.0])


@pytest.mark.parametrize(
    "effect, words",
    [
        (
            ("actuator_saturation", "p.j1", dict(limit=0.0)),
            "limit is 0.0, expected > 0",
        ),
        (("input_delay", "p.j1", dict(delay=-0.01)), "delay is -0.01, expected >= 0"),
        (("actuator_lag", "p.j1", dict(time=0.1)), "no parameter 'time'"),
        (("actuator_gain", "p.j2", dict(gain=1.0)), "expected a joint of 'p'"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, effect, words):
    with pytest.raises(ValueError, match=words):
        load_scene(with_effects(pendulum(tmp_path), effect), DiagramBuilder())


@pytest.mark.parametrize(
    "actuation, words",
    [
        (dict(type="effort", joints=["p.j9"]), "actuation.joints: no joint 'p.j9'"),
        (dict(type="pd", joints=["p.j1"], kp=[1.0, 2.0], kd=[1.0]), "actuation.kp is"),
        (
            dict(type="pd", joints=["p.j1"], kp=[1.0], kd=[-1.0]),
            r"kd\[0\]: got",
        ),
        (
            dict(type="effort", joints=["p.j1"], hold="linear"),
            "one of: zero_order",
        ),
        (dict(type="effort", joints=["p.j1"], rate_hz=0.0), "rate_hz: got .0.0."),
    ],
)
def test_bad_actuation_is_refused_by_name(tmp_path, actuation, words):
    with pytest.raises(ValueError, match=words):
        load_scene(pendulum(tmp_path, **actuation), DiagramBuilder())


def test_an_effect_on_a_joint_that_nothing_drives_is_refused(tmp_path):
    scene = with_effects(
        pendulum(tmp_path, actuator=False, type="none"),
        ("actuator_gain", "p.j1", dict(gain=0.5)),
    )
    with pytest.raises(ValueError, match="nothing drives"):
        load_scene(scene, DiagramBuilder())


def test_bad_commands_and_channels_are_refused_by_name(tmp_path):
    simulation = SceneSimulation(pendulum(tmp_path))
    for commands, channels, words in (
        (Commands(TIMES, {"p.j1.position_command": TIMES}), CHANNELS, "does not fit"),
        (Commands(TIMES, {}), ["p.j1.torque"], "'p.j1.torque' cannot be simulated"),
    ):
        with pytest.raises(ValueError, match=words):
            simulation.run(at_rest_but(), TIMES, channels, commands)
    with pytest.raises(ValueError, match="initial value of 'p.j9.position'"):
        simulation.run(at_rest_but({"p.j9": 0.0}), TIMES, CHANNELS)
    with pytest.raises(ValueError, match="must increase"):
        Commands(np.array([0.0, 0.0]), {})
    with pytest.raises(ValueError, match="Commands column a is"):
        Commands(np.arange(3.0), {"a": np.zeros(2)})


def test_a_drive_without_its_rotor_is_refused_where_it_would_never_end(tmp_path):
    supply = SupplySection(voltage=[12.0], kt=[40.0], resistance=[1.0])
    drive = dict(type="servo", joints=["p.j1"], kp=[30.0], supply=supply)
    with pytest.raises(ValueError, match="damps with 1.6e\\+03 .* give it its rotor"):
        load_scene(pendulum(tmp_path, **drive), DiagramBuilder())
    with_rotor = with_effects(
        pendulum(tmp_path, **drive), ("rotor_inertia", "p.j1", dict(inertia=1.0))
    )
    load_scene(with_rotor, DiagramBuilder())
    # No search takes so much of the rotor away that it would be refused.
    least = SceneDynamics(with_rotor).least("rotor_inertia", ["p.j1"])["inertia"]
    assert J + 1.0 + least == pytest.approx(1600.0 / 2000.0)
    with pytest.raises(ValueError, match="expected 3.2 or more"):
        load_scene(pendulum(tmp_path, 0.002, **drive), DiagramBuilder())


def test_a_limit_of_the_scene_stands_in_the_place_of_a_lower_one_of_the_file(tmp_path):
    def limits(**more):
        drive = dict(type="servo", joints=["p.j1"], kp=[30.0], **more)
        limit = '<limit effort="5" lower="-9" upper="9" velocity="9"/>'
        scene = pendulum(tmp_path, joint=limit, **drive)
        plant = load_scene(scene, DiagramBuilder()).plant
        (only,) = (plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices())
        return only.effort_limit()

    assert limits() == 5.0 and limits(limit=[8.0]) == 8.0
    assert limits(limit=[2.0]) == 5.0  # The drive's law clips before.
