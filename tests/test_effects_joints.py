"""Damping, dry friction, drag, rotor, ripple, spring in a joint."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import LENGTH, MASS, G, J, at_rest_but, pendulum, with_effects
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.gap.problem import Candidate
from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.signature import Motion
from makebreak.models.scene import load_scene

TIMES = np.linspace(0.0, 1.0, 21)
CHANNELS = ["p.j1.position", "p.j1.velocity"]
Q0, V0 = 0.8, -1.5
FADE = 0.005  # [rad/s], of dry friction in a continuous plant.

CASES = {
    "joint_viscous_damping": (dict(damping=0.3), lambda q, v: -0.3 * v),
    "joint_coulomb_friction": (
        dict(coulomb=0.4),
        lambda q, v: -0.4 * np.tanh(v / FADE),
    ),
    "joint_direction_friction": (
        dict(coulomb_plus=0.2, coulomb_minus=0.5),
        lambda q, v: -(0.2 if v > 0 else 0.5) * np.tanh(v / FADE),
    ),
    "joint_stribeck_friction": (
        dict(coulomb=0.3, static=0.6, stribeck_velocity=0.5),
        lambda q, v: -(0.3 + 0.3 * np.exp(-((v / 0.5) ** 2))) * np.tanh(v / FADE),
    ),
    "joint_position_friction": (
        dict(coulomb_low=0.6, coulomb_high=0.2, low=-0.4, high=0.7),
        lambda q, v: -np.interp(q, [-0.4, 0.7], [0.6, 0.2]) * np.tanh(v / FADE),
    ),
    "joint_quadratic_drag": (dict(coefficient=0.2), lambda q, v: -0.2 * v * abs(v)),
    "torque_ripple": (
        dict(amplitude=0.8, periods_per_rev=7.0, phase=0.4),
        lambda q, v: 0.8 * np.sin(7.0 * q + 0.4),
    ),
    "joint_spring": (dict(stiffness=3.0, rest=0.5), lambda q, v: -3.0 * (q - 0.5)),
    "rotor_inertia": (dict(inertia=0.2), None),
}


def command(t):
    return 0.7 * np.sin(5.0 * t)


def exact(law, inertia=J):
    """Position and velocity at TIMES, by an integrator of order 5 for stiff problems,
    its command held for 0.05 s."""
    x, rows = np.array([Q0, V0]), [[Q0, V0]]
    for start, end in zip(TIMES[:-1], TIMES[1:], strict=True):
        u = command(start)

        def rate(t, x, u=u):
            force = u - MASS * G * LENGTH * np.sin(x[0]) + law(*x)
            return [x[1], force / inertia]

        x = solve_ivp(
            rate, (start, end), x, "Radau", rtol=1e-9, atol=1e-10, max_step=0.01
        ).y[:, -1]
        rows.append(x)
    return np.array(rows)


def simulated(scene):
    simulation = SceneSimulation(scene)
    commands = Commands(TIMES, {"p.j1.effort_command": command(TIMES)})
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    return simulation.run(initial, TIMES, CHANNELS, commands)


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_pendulum_moves_as_the_ode_says(tmp_path, kind, time_step):
    parameters, law = CASES[kind]
    scene = with_effects(pendulum(tmp_path, time_step), (kind, "p.j1", parameters))
    inertia = J + parameters.get("inertia", 0.0)
    expected = exact(law or (lambda q, v: 0.0), inertia)
    # Continuous: the integrator's accuracy of 1e-6 a step, over some 100 steps.
    # Discrete: first order, 0.5 ms at accelerations up to 20 rad/s2 and their rates.
    atol = 1e-4 if time_step == 0.0 else 0.02
    rows = simulated(scene)
    np.testing.assert_allclose(rows, expected, atol=atol)
    np.testing.assert_array_equal(rows[0], [Q0, V0])
    without = exact(lambda q, v: 0.0)
    assert abs(without - expected).max() > 10 * atol  # What is tested is there.


@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_dry_friction_slows_evenly_and_holds(tmp_path, time_step):
    # Without gravity: v = v0 - c t/J until it stands, after v0^2 J/(2 c). That is
    # friction without fading; the fading changes the last 0.005 rad/s (0.02 rad/s
    # where a step is 1 ms) of it.
    c, v0 = 0.5, 2.0
    scene = with_effects(
        pendulum(tmp_path, time_step, gravity=0.0),
        ("joint_coulomb_friction", "p.j1", {"coulomb": c}),
    )
    simulation = SceneSimulation(scene)
    initial = at_rest_but(v={"p.j1": v0})
    times = np.array([0.0, 0.5, 1.0, 2.0, 3.0])
    rows = simulation.run(initial, times, CHANNELS)
    np.testing.assert_allclose(rows[1, 1], v0 - c / J * 0.5, atol=2e-3)
    np.testing.assert_allclose(rows[3:, 0], v0**2 * J / (2 * c), atol=2e-3)
    np.testing.assert_allclose(rows[3:, 1], 0.0, atol=1e-6)


def test_light_joint_in_a_coarse_step_does_not_chatter(tmp_path):
    # c dt/(J fade) would be 15 with the fading of the continuous plant.
    scene = with_effects(
        pendulum(tmp_path, 0.01, gravity=0.0),
        ("joint_coulomb_friction", "p.j1", {"coulomb": 2.0}),
    )
    simulation = SceneSimulation(scene)
    rows = simulation.run(
        at_rest_but(v={"p.j1": 1.0}), np.linspace(0, 1, 101), CHANNELS
    )
    assert rows[:, 1].min() > -1e-6  # It never turns round,
    assert abs(rows[-1, 1]) < 1e-3  # and it stands.


@pytest.mark.parametrize("time_step", [0.0, 0.01])
def test_a_simulation_that_fails_says_so_and_is_not_a_number(tmp_path, time_step):
    # A spring that pushes: the joint runs away, beyond what an integrator can do.
    scene = with_effects(
        pendulum(tmp_path, time_step),
        ("joint_spring", "p.j1", dict(stiffness=-2e6, rest=0.0)),
    )
    simulation = SceneSimulation(scene)
    times = np.linspace(0.0, 1.0, 101)
    rows = simulation.run(at_rest_but({"p.j1": 0.1}), times, CHANNELS)
    assert simulation.failure
    good = np.isfinite(rows).all(axis=1)
    assert good[0] and not good[-1]
    # The next run starts afresh.
    gentle = with_effects(scene, ("joint_spring", "p.j1", dict(stiffness=1, rest=0)))
    simulation.set_effects(gentle.effects)
    rows = simulation.run(at_rest_but({"p.j1": 0.1}), times, CHANNELS)
    assert np.isfinite(rows).all() and not simulation.failure


def test_damping_adds_to_the_models_own(tmp_path):
    own = '<dynamics damping="0.2"/>'
    scene = with_effects(
        pendulum(tmp_path, joint=own),
        ("joint_viscous_damping", "p.j1", {"damping": 0.1}),
    )
    np.testing.assert_allclose(
        simulated(scene), exact(lambda q, v: -0.3 * v), atol=1e-4
    )


def test_a_rotor_works_on_a_joint_without_an_actuator(tmp_path):
    scene = with_effects(
        pendulum(tmp_path, actuator=False, type="none"),
        ("rotor_inertia", "p", {"inertia": 0.2}),
    )
    rows = SceneSimulation(scene).run(
        at_rest_but({"p.j1": 0.01}), np.array([0.0, 1.0]), CHANNELS
    )
    # Small swings: w^2 = m g l/(J + I). 0.01 rad: the period is longer by 6e-6.
    w = np.sqrt(MASS * G * LENGTH / (J + 0.2))
    np.testing.assert_allclose(rows[1, 0], 0.01 * np.cos(w), atol=2e-6)


def test_effects_of_all_kinds_add_up(tmp_path):
    chosen = ["joint_viscous_damping", "torque_ripple", "joint_spring"]
    scene = with_effects(
        pendulum(tmp_path), *((kind, "p.j1", CASES[kind][0]) for kind in chosen)
    )
    expected = exact(lambda q, v: sum(CASES[kind][1](q, v) for kind in chosen))
    np.testing.assert_allclose(simulated(scene), expected, atol=1e-4)


@pytest.mark.parametrize("kind", CASES)
def test_parameters_can_be_changed_without_building_anew(tmp_path, kind):
    parameters, _ = CASES[kind]
    scene = with_effects(pendulum(tmp_path), (kind, "p.j1", parameters))
    more = {name: 1.3 * value for name, value in parameters.items()}
    changed = with_effects(scene, (kind, "p.j1", more))
    simulation = SceneSimulation(scene)
    commands = Commands(TIMES, {"p.j1.effort_command": command(TIMES)})
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    first = simulation.run(initial, TIMES, CHANNELS, commands)
    simulation.set_effects(changed.effects)
    second = simulation.run(initial, TIMES, CHANNELS, commands)
    assert simulation.builds == 1
    # The same plant in the same state: only rounding (damping is added and taken off).
    np.testing.assert_allclose(second, simulated(changed), atol=1e-9)
    assert abs(second - first).max() > 1e-3
    simulation.set_effects(scene.effects)
    again = simulation.run(initial, TIMES, CHANNELS, commands)
    np.testing.assert_allclose(again, first, atol=1e-9)
    # A run depends on nothing but its arguments.
    third = simulation.run(initial, TIMES, CHANNELS, commands)
    np.testing.assert_array_equal(third, again)


LESS = {
    "joint_viscous_damping": (dict(damping=0.3), "damping"),
    "joint_coulomb_friction": (dict(coulomb=0.4), "coulomb"),
    "joint_quadratic_drag": (dict(coefficient=0.2), "coefficient"),
    "rotor_inertia": (dict(inertia=0.2), "inertia"),
}


@pytest.mark.parametrize("kind", LESS)
def test_a_model_loses_what_it_has_too_much_of_and_no_more(tmp_path, kind):
    parameters, name = LESS[kind]
    has = parameters[name]
    base = with_effects(pendulum(tmp_path), (kind, "p.j1", parameters))
    less = Effect(kind, ["p.j1"], {name: -0.6 * has})
    scene = replace(base, effects=[*base.effects, less])
    left = with_effects(pendulum(tmp_path), (kind, "p.j1", {name: 0.4 * has}))
    # The same forces in two parts: rounding, at the integrator's accuracy.
    np.testing.assert_allclose(simulated(scene), simulated(left), atol=1e-6)
    assert abs(simulated(scene) - simulated(base)).max() > 1e-2
    # In a Context that was built with another part of it.
    simulation = SceneSimulation(
        replace(base, effects=[*base.effects, Effect(kind, ["p.j1"], {name: 0.1})])
    )
    simulation.set_effects(scene.effects)
    commands = Commands(TIMES, {"p.j1.effort_command": command(TIMES)})
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    rows = simulation.run(initial, TIMES, CHANNELS, commands)
    assert simulation.builds == 1
    np.testing.assert_allclose(rows, simulated(left), atol=1e-6)
    model = SceneDynamics(base)
    assert model.least(kind, ["p.j1"]) == {name: pytest.approx(-has)}
    assert SceneDynamics(scene).least(kind, ["p.j1"])[name] == pytest.approx(-0.4 * has)
    # Without the effect there is nothing to lose.
    assert SceneDynamics(pendulum(tmp_path)).least(kind, ["p.j1"]) == {name: 0.0}
    much = Effect(kind, ["p.j1"], {name: -1.1 * has})
    with pytest.raises(ValueError, match=f"leaves .*{-0.1 * has:g}"):
        load_scene(replace(base, effects=[*base.effects, much]), DiagramBuilder())


@pytest.mark.parametrize(
    "kind, at, parameters, words",
    [
        (
            "joint_viscous_damping",
            "p.j1",
            {"damping": -1},
            "damping -1 leaves -1, expected 0 or more with the 0 that",
        ),
        ("joint_viscous_damping", "p.j9", {"damping": 1}, "expected a joint of 'p'"),
        ("joint_viscous_damping", "x.j1", {"damping": 1}, "no model 'x'"),
        ("joint_viscous_damping", "p.j1", {}, "needs `damping`"),
        ("joint_viscous_damping", ["p.j1", "p"], {"damping": 1}, "more than once"),
        ("joint_coulomb_friction", "p.j1", {"coulomb": np.inf}, "coulomb is inf"),
        ("joint_coulomb_friction", "p.j1", {"friction": 1}, "no parameter 'friction'"),
        (
            "joint_stribeck_friction",
            "p.j1",
            {"coulomb": 1, "static": 2, "stribeck_velocity": 0},
            "stribeck_velocity is 0, expected > 0",
        ),
        ("rotor_inertia", "p.j1", {"inertia": -0.1}, "inertia -0.1 leaves -0.1"),
        ("joint_coulomb_friction", "p", {"coulomb": -0.1}, "coulomb -0.1 leaves -0.1"),
        ("joint_quadratic_drag", "p.j1", {"coefficient": -1}, "leaves -1, expected 0"),
        ("torque_ripple", "p.j1", {"amplitude": 1, "phase": 0}, "`periods_per_rev`"),
        ("joint_spring", "p.base", {"stiffness": 1, "rest": 0}, "that turns or slides"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, kind, at, parameters, words):
    scene = with_effects(pendulum(tmp_path), (kind, at, parameters))
    with pytest.raises(ValueError, match=words) as error:
        load_scene(scene, DiagramBuilder())
    assert "\n" not in str(error.value)


def test_a_spring_pulls(tmp_path):
    """No spring pushes away from its rest; a model that has one may have too much."""
    base = pendulum(tmp_path)
    assert SceneDynamics(base).least("joint_spring", ["p.j1"]) == {"stiffness": 0.0}
    scene = with_effects(base, ("joint_spring", "p.j1", dict(stiffness=2.0, rest=1.0)))
    assert SceneDynamics(scene).least("joint_spring", ["p.j1"]) == {"stiffness": -2.0}
    candidate = Candidate(
        "joint_spring", ("p.j1",), 2, (), (), least={"stiffness": 0.0}
    )
    for stiffness, sane in ((0.2, True), (-0.2, False)):
        effect = Effect("joint_spring", ["p.j1"], {"stiffness": stiffness, "rest": 0.1})
        assert candidate.is_sane([effect], None) == sane


def test_of_dry_friction_acts_what_a_motion_says(tmp_path):
    """Of a joint that friction holds: any share of it, whatever its smoothed speed."""
    plain = pendulum(tmp_path)
    scene = with_effects(plain, ("joint_coulomb_friction", "p.j1", dict(coulomb=0.4)))
    rng = np.random.default_rng(2)
    time, (q, v, vd, effort) = np.arange(5.0), rng.normal(size=(4, 5, 1))
    share = np.array([[-1.0], [-0.3], [0.0], [0.5], [1.0]])
    motion = Motion(time, q, v, vd, effort)
    left = SceneDynamics(scene).residual(replace(motion, dry=share))
    expected = SceneDynamics(plain).residual(motion) - 0.4 * share
    np.testing.assert_allclose(left, expected, atol=1e-12)
