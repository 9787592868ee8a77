"""Elasticity and backlash between motor and link."""

import numpy as np
import pytest
from effect_scenes import (
    LENGTH,
    MASS,
    G,
    J,
    at_rest_but,
    pendulum,
    with_effects,
)
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.transmission import (
    ROTOR_SHARE,
    damping_of,
    restitution_of,
    through_gap,
)
from makebreak.models.scene import load_scene

TIMES = np.linspace(0.0, 0.5, 101)
CHANNELS = ["p.j1.position", "p.j1.velocity", "p.rod.wy"]
ROTOR = 0.05  # [kg m2]
COMMAND = np.where(TIMES < 0.2, 2.0, -1.0)
COMMANDS = Commands(TIMES, {"p.j1.effort_command": COMMAND})
K, D = 80.0, 0.4


def elastic(folder, time_step=0.0, *more, kind="joint_elasticity", **parameters):
    parameters = parameters or dict(stiffness=K, damping=D)
    rotor = ("rotor_inertia", "p.j1", dict(inertia=ROTOR))
    return with_effects(
        pendulum(folder, time_step), rotor, (kind, "p.j1", parameters), *more
    )


def two_masses(force, start, times=TIMES, command=COMMAND):
    """Motor q, v and link q, v; force(twist, rate) of the coupling."""

    def rate(t, x, u):
        q_m, v_m, q, v = x
        f = force(q_m - q, v_m - v)
        return [v_m, (u - f) / ROTOR, v, (f - MASS * G * LENGTH * np.sin(q)) / J]

    x, rows = np.array(start, dtype=float), [start]
    for a, b, u in zip(times[:-1], times[1:], command[:-1], strict=True):
        x = solve_ivp(
            rate, (a, b), x, args=(u,), rtol=1e-9, atol=1e-11, max_step=1e-3
        ).y[:, -1]
        rows.append(x)
    return np.array(rows)


@pytest.mark.parametrize("time_step, atol", [(0.0, 2e-4), (0.0002, 0.03)])
def test_motor_and_link_swing_on_the_spring(tmp_path, time_step, atol):
    # atol of the discrete plant: 0.2 ms at the resonance of 43 rad/s and 40 rad/s2.
    # It starts as at rest: the link lags its motor by 2 N m over the stiffness.
    scene = elastic(tmp_path, time_step)
    rows = SceneSimulation(scene).run(
        at_rest_but({"p.j1": 0.1}), TIMES, CHANNELS, COMMANDS
    )
    start = [0.1, 0.0, 0.1 - 2.0 / K, 0.0]
    expected = two_masses(lambda s, r: K * s + D * r, start)
    np.testing.assert_allclose(rows[:, 0], expected[:, 0], atol=atol)
    np.testing.assert_allclose(rows[:, 1], expected[:, 1], atol=40 * atol)
    np.testing.assert_allclose(rows[:, 2], expected[:, 3], atol=40 * atol)
    # It is the resonance that is seen, and not only slow motion.
    assert abs(expected[:, 1] - expected[:, 3]).max() > 0.3


@pytest.mark.parametrize("side", ["motor", "link"])
def test_a_window_starts_with_the_twist_it_is_told(tmp_path, side):
    scene = elastic(tmp_path)
    scene.channels = {"position": side, "velocity": side}
    twist, rate = 0.02, -0.5
    rows = SceneSimulation(scene).run(
        at_rest_but({"p.j1": 0.1}, {"p.j1": 0.3}), TIMES, CHANNELS, COMMANDS,
        twists={"p.j1": (twist, rate)},
    )  # fmt: skip
    start = [0.1, 0.3, 0.1 - twist, 0.3 - rate]
    if side == "link":
        start = [0.1 + twist, 0.3 + rate, 0.1, 0.3]
    expected = two_masses(lambda s, r: K * s + D * r, start)
    seen = expected[:, :2] if side == "motor" else expected[:, 2:]
    np.testing.assert_allclose(rows[:, 0], seen[:, 0], atol=2e-4)
    np.testing.assert_allclose(rows[:, 1], seen[:, 1], atol=8e-3)


def test_channels_say_on_which_side_it_is_measured(tmp_path):
    scene = elastic(tmp_path)
    scene.channels = {"p.j1.position": "link side", "velocity": "link"}
    rows = SceneSimulation(scene).run(
        at_rest_but({"p.j1": 0.1}), TIMES, CHANNELS, COMMANDS
    )
    start = [0.1 + 2.0 / K, 0.0, 0.1, 0.0]
    expected = two_masses(lambda s, r: K * s + D * r, start)
    np.testing.assert_allclose(rows[:, 0], expected[:, 2], atol=2e-4)
    np.testing.assert_allclose(rows[:, 1], rows[:, 2], atol=1e-12)


def test_a_very_stiff_spring_is_no_spring(tmp_path):
    rigid = with_effects(
        pendulum(tmp_path), ("rotor_inertia", "p.j1", dict(inertia=ROTOR))
    )
    stiff = elastic(tmp_path, stiffness=1e5, damping=20.0)
    start = at_rest_but({"p.j1": 0.1})
    a, b = (
        SceneSimulation(scene).run(start, TIMES[::10], CHANNELS[:1], COMMANDS)
        for scene in (rigid, stiff)
    )
    # 2 N m over 1e5 N m/rad.
    np.testing.assert_allclose(a, b, atol=5e-5)


def test_energy_of_the_undamped_spring_stays(tmp_path):
    scene = elastic(tmp_path, stiffness=K, damping=0.0)
    simulation = SceneSimulation(scene)
    motor = simulation.run(
        at_rest_but({"p.j1": 0.4}, {"p.j1": 1.0}), TIMES, CHANNELS[:2]
    )
    scene.channels = {"position": "link", "velocity": "link"}
    # The same run seen from the link; both sides start alike without effort.
    link = SceneSimulation(scene).run(
        at_rest_but({"p.j1": 0.4}, {"p.j1": 1.0}), TIMES, CHANNELS[:2]
    )
    energy = (
        ROTOR * motor[:, 1] ** 2 / 2
        + J * link[:, 1] ** 2 / 2
        + K * (motor[:, 0] - link[:, 0]) ** 2 / 2
        - MASS * G * LENGTH * np.cos(link[:, 0])
    )
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)


@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_a_motor_goes_through_the_gap_before_the_link_moves(tmp_path, time_step):
    # Without gravity, from the middle of the gap: first the motor alone, u/(2 I) t^2.
    gap, u = 0.04, 0.5
    base = pendulum(tmp_path, time_step, gravity=0.0)
    scene = with_effects(
        base,
        ("rotor_inertia", "p.j1", dict(inertia=ROTOR)),
        ("joint_backlash", "p.j1", dict(gap=gap)),
    )
    scene.channels = {"position": "link", "velocity": "link"}
    simulation = SceneSimulation(scene)
    commands = Commands(np.array([0.0]), {"p.j1.effort_command": np.array([u])})
    free = np.sqrt(2 * (gap / 2) * ROTOR / u)  # From the middle: half the gap.
    times = np.array([0.0, 0.5 * free, 0.95 * free, 1.5])
    motor = "motor_of_p_j1.j1"
    start = at_rest_but({"p.j1": 0.0, motor: 0.0})
    channels = [f"{motor}.position", f"{motor}.velocity", "p.j1.velocity"]
    rows = simulation.run(start, times, channels, commands)
    # A discrete step of 1 ms at 0.6 rad/s.
    atol = 1e-6 if time_step == 0 else 7e-4
    np.testing.assert_allclose(rows[1:3, 0], u / ROTOR * times[1:3] ** 2 / 2, atol=atol)
    np.testing.assert_allclose(rows[1:3, 2], 0.0, atol=1e-9)  # The link stands still.
    # Later: the momentum of both is all that the motor's torque has given.
    momentum = ROTOR * rows[3, 1] + J * rows[3, 2]
    np.testing.assert_allclose(momentum, u * times[3], rtol=2e-3)


@pytest.mark.parametrize("restitution", [0.2, 0.45, 0.8])
def test_a_link_bounces_back_from_the_other_side_of_its_gap(tmp_path, restitution):
    # Without gravity: relative speed after the impact is so much of that before, and
    # the momentum of both stays.
    gap, speed = 0.04, 0.5
    scene = with_effects(
        pendulum(tmp_path, 0.0, gravity=0.0),
        ("rotor_inertia", "p.j1", dict(inertia=0.4)),
        ("joint_backlash", "p.j1", dict(gap=gap, restitution=restitution)),
    )
    scene.channels = {"position": "link", "velocity": "link"}
    motor = "motor_of_p_j1.j1"
    start = at_rest_but({"p.j1": 0.0, motor: 0.0}, {"p.j1": speed, motor: 0.0})
    times = np.array([0.0, 0.5 * gap / speed + 0.01])  # The contact takes about 2 ms.
    channels = [f"{motor}.velocity", "p.j1.velocity"]
    rows = SceneSimulation(scene).run(start, times, channels)
    away = rows[1, 0] - rows[1, 1]
    # The damper's fading in over the first thousandth of the gap is not in the formula.
    assert away / speed == pytest.approx(restitution, abs=0.03)
    assert 0.4 * rows[1, 0] + J * rows[1, 1] == pytest.approx(J * speed, rel=1e-4)


@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.8])
def test_a_link_carried_through_its_gap_bounces_as_a_ball_does(restitution):
    # A constant torque takes it to the other side: after n bounces it comes back to a
    # share e^2n of the gap, at times that are known.
    gap, T, M = 0.04, 2.0, 0.5
    time = np.arange(0.0, 1.5, 1e-3)
    needs = np.where(time < 1e-6, -T, T)
    z = through_gap(time, needs, np.full(len(time), M), gap, restitution)[0]
    fall = np.sqrt(2.0 * gap * M / T)
    assert z[0] == -0.5 * gap
    if restitution == 0.0:
        np.testing.assert_allclose(z[time > fall + 2e-3], 0.5 * gap)
        return
    top = fall * (1.0 + restitution)  # Of the first way back.
    k = int(np.argmin(abs(time - top)))
    # Impacts are known to an eighth of a millisecond at speeds of 0.6 rad/s.
    assert 0.5 * gap - z[k] == pytest.approx(restitution**2 * gap, abs=6e-4)
    second = fall * (1.0 + 2.0 * restitution + restitution**2)
    k = int(np.argmin(abs(time - second)))
    assert 0.5 * gap - z[k] == pytest.approx(restitution**4 * gap, abs=1.2e-3)


def test_restitution_and_damping_are_each_others_inverse():
    # An undamped spring gives all back; and what a damping ratio of 0.3 leaves.
    assert restitution_of(0.0) == pytest.approx(1.0)
    for damping in (0.05, 0.3, 0.7, 0.95):
        m, k = 1.0, 1.0

        def rate(t, x, d=2.0 * damping):
            return [x[1], -x[0] - d * x[1]]

        def parts(t, x, d=2.0 * damping):  # Where it would begin to pull.
            return x[0] + d * x[1] if t > 1e-3 else 1.0

        parts.terminal = True
        run = solve_ivp(rate, (0, 20), [0.0, m * k], events=parts, rtol=1e-9)
        assert restitution_of(damping) == pytest.approx(-run.y[1, -1], abs=1e-4)
        again = damping_of(restitution_of(damping))
        assert again == pytest.approx(damping, abs=1e-9)


def test_a_window_starts_with_the_gap_closed_by_the_effort(tmp_path):
    scene = elastic(tmp_path, kind="joint_backlash", gap=0.04)
    channels = ["p.j1.position", "p.rod.qy"]
    start = at_rest_but({"p.j1": 0.1})
    rows = SceneSimulation(scene).run(start, TIMES[:1], channels, COMMANDS)
    # Measured at the motor, which pushes with 2 N m: the link is 0.02 rad behind.
    np.testing.assert_allclose(rows[0], [0.1, np.sin(0.08 / 2)], atol=1e-12)


def test_no_gap_is_no_backlash(tmp_path):
    rigid = with_effects(
        pendulum(tmp_path), ("rotor_inertia", "p.j1", dict(inertia=ROTOR))
    )
    closed = elastic(tmp_path, kind="joint_backlash", gap=0.0)
    start = at_rest_but({"p.j1": 0.1})
    a, b = (
        SceneSimulation(scene).run(start, TIMES[::10], CHANNELS[:1], COMMANDS)
        for scene in (rigid, closed)
    )
    # The stiffness behind a gap is that of 2000 rad/s on the rotor: 2e5 N m/rad.
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_the_mechanisms_own_state_stays_what_it_is(tmp_path):
    plant = load_scene(elastic(tmp_path), DiagramBuilder()).plant
    assert plant.num_multibody_states(plant.GetModelInstanceByName("p")) == 2
    assert plant.num_actuated_dofs(plant.GetModelInstanceByName("p")) == 1


def test_a_joint_without_rotor_gets_a_hundredth_of_its_inertia(tmp_path):
    scene = with_effects(
        pendulum(tmp_path), ("joint_elasticity", "p.j1", dict(stiffness=K, damping=D))
    )
    plant = load_scene(scene, DiagramBuilder()).plant
    M = plant.CalcMassMatrix(plant.CreateDefaultContext())
    np.testing.assert_allclose(np.sort(np.diag(M)), [ROTOR_SHARE * J, J])


def test_stiffness_and_gap_are_set_without_building_anew(tmp_path):
    scene = elastic(tmp_path)
    simulation = SceneSimulation(scene)
    rotor = Effect("rotor_inertia", ["p.j1"], {"inertia": ROTOR})
    rotor.parameters["inertia"] = 0.07
    softer = Effect("joint_elasticity", ["p.j1"], {"stiffness": 30.0, "damping": 0.1})
    simulation.set_effects([rotor, softer])
    start = at_rest_but({"p.j1": 0.1})
    rows = simulation.run(start, TIMES[:21], CHANNELS, COMMANDS)
    assert simulation.builds == 1
    fresh = SceneSimulation(with_effects(pendulum(tmp_path)))
    fresh.set_effects([rotor, softer])
    assert fresh.builds == 2  # Another list of effects is another diagram.
    expected = fresh.run(start, TIMES[:21], CHANNELS, COMMANDS)
    # The rotor's inertia is a sum: rounding.
    np.testing.assert_allclose(rows, expected, atol=1e-10)


@pytest.mark.parametrize(
    "effects, words",
    [
        (
            [("joint_elasticity", "p.j1", dict(stiffness=0, damping=1))],
            "stiffness is 0",
        ),
        ([("joint_elasticity", "p.j1", dict(stiffness=1))], "needs `damping`"),
        ([("joint_backlash", "p.j1", dict(gap=-0.1))], "gap is -0.1, expected >= 0"),
        ([("joint_backlash", "p.j2", dict(gap=0.1))], "expected a joint of 'p'"),
        (
            [
                ("joint_elasticity", "p.j1", dict(stiffness=1, damping=1)),
                ("joint_backlash", "p.j1", dict(gap=0.1)),
            ],
            "driven through an elastic element already",
        ),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, effects, words):
    with pytest.raises(ValueError, match=words):
        load_scene(with_effects(pendulum(tmp_path), *effects), DiagramBuilder())
