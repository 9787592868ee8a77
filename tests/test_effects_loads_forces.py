"""Payload, tilt, and forces on a body."""

import numpy as np
import pytest
from effect_scenes import (
    CENTRAL,
    LENGTH,
    MASS,
    G,
    J,
    at_rest_but,
    double,
    on_ground,
    pendulum,
    with_effects,
)
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.diagrams.scene_simulation import SceneSimulation
from makebreak.models.scene import load_scene

TIMES = np.linspace(0.0, 1.0, 11)
CHANNELS = ["p.j1.position", "p.j1.velocity"]
Q0, V0 = 0.8, -1.5


def ode(acceleration, start=(Q0, V0), times=TIMES):
    def rate(t, x):
        return [x[1], acceleration(t, *x)]

    return solve_ivp(
        rate, (0.0, times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12
    ).y.T


def simulated(scene, times=TIMES, channels=CHANNELS):
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    return SceneSimulation(scene).run(initial, times, channels)


def free_fall(m, com):
    """q'' of a pendulum about y with a point mass m at com = (x, y, z) besides."""
    x, _, z = com
    inertia = J + m * (x**2 + z**2)

    def acceleration(t, q, v):
        # Turning by q about y moves (x, z) to height z cos q - x sin q.
        own = -MASS * G * LENGTH * np.sin(q)
        return (own + m * G * (z * np.sin(q) + x * np.cos(q))) / inertia

    return acceleration


@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-4), (0.0005, 0.01)])
def test_payload_swings_as_a_point_mass(tmp_path, time_step, atol):
    # atol: accuracy of the integrator; a first-order scheme of 0.5 ms at 15 rad/s2.
    m, com = 0.7, (0.12, 0.05, -0.4)
    parameters = dict(mass=m, com_x=com[0], com_y=com[1], com_z=com[2])
    scene = with_effects(
        pendulum(tmp_path, time_step), ("payload", "p.rod", parameters)
    )
    np.testing.assert_allclose(simulated(scene), ode(free_fall(m, com)), atol=atol)
    assert abs(ode(free_fall(m, com)) - ode(free_fall(0, com))).max() > 0.1


def test_payload_is_changed_in_the_context_and_adds_no_state(tmp_path):
    base = pendulum(tmp_path)
    light = with_effects(
        base, ("payload", "p.rod", dict(mass=0.1, com_x=0, com_y=0, com_z=0))
    )
    heavy = with_effects(
        base, ("payload", "p.rod", dict(mass=0.7, com_x=0.12, com_y=0.05, com_z=-0.4))
    )
    simulation = SceneSimulation(light)
    simulation.set_effects(heavy.effects)
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    rows = simulation.run(initial, TIMES, CHANNELS)
    assert simulation.builds == 1
    np.testing.assert_array_equal(rows, simulated(heavy))
    loaded = load_scene(heavy, DiagramBuilder())
    assert loaded.plant.num_multibody_states() == 2
    assert (
        loaded.plant.num_multibody_states(loaded.plant.GetModelInstanceByName("p")) == 2
    )


@pytest.mark.parametrize("at", ["p", "world"])
def test_tilt_about_the_joint_axis_moves_where_it_hangs(tmp_path, at):
    # Turned by the pitch p in the world, the pendulum hangs at q = -p.
    scene = with_effects(
        pendulum(tmp_path), ("gravity_tilt", at, dict(roll=0.0, pitch=0.15))
    )
    expected = ode(lambda t, q, v: -MASS * G * LENGTH * np.sin(q + 0.15) / J)
    np.testing.assert_allclose(simulated(scene), expected, atol=1e-4)


@pytest.mark.parametrize("at", ["p", "world"])
def test_tilt_across_the_joint_axis_weakens_gravity(tmp_path, at):
    scene = with_effects(
        pendulum(tmp_path), ("gravity_tilt", at, dict(roll=0.3, pitch=0.0))
    )
    g = G * np.cos(0.3)
    expected = ode(lambda t, q, v: -MASS * g * LENGTH * np.sin(q) / J)
    np.testing.assert_allclose(simulated(scene), expected, atol=1e-4)


def test_a_tilted_base_turns_the_model_and_tilted_gravity_does_not(tmp_path):
    at_base, at_world = (
        SceneSimulation(
            with_effects(
                pendulum(tmp_path), ("gravity_tilt", at, dict(roll=0.3, pitch=0))
            )
        ).run(at_rest_but({"p.j1": 0.5}), TIMES[:1], ["p.rod.qw", "p.rod.qx"])
        for at in ("p", "world")
    )
    # Rx(0.3) Ry(0.5), and Ry(0.5) alone.
    c, s = np.cos(0.25), np.sin(0.15)
    np.testing.assert_allclose(at_base[0], [c * np.cos(0.15), c * s], atol=1e-12)
    np.testing.assert_allclose(at_world[0], [c, 0.0], atol=1e-12)


def test_tilt_of_one_model_leaves_a_free_body_alone(tmp_path):
    # Two scenes in one: the pendulum's base tilts, the ball still falls straight down.
    scene, other = pendulum(tmp_path), on_ground(tmp_path, "ball", 0.0, z=1.0)
    scene.directives += other.directives
    scene.initial = other.initial
    scene = with_effects(scene, ("gravity_tilt", "p", dict(roll=0.2, pitch=0.1)))
    rows = SceneSimulation(scene).run(
        at_rest_but(), np.array([0.0, 0.2]), ["b.ball.x", "b.ball.y", "b.ball.z"]
    )
    np.testing.assert_allclose(rows[1], [0, 0, 1.0 - G * 0.2**2 / 2], atol=1e-6)


def test_a_force_acts_at_the_bodys_origin(tmp_path):
    # The upper link's origin is on its joint's axis: no moment.
    scene = double(tmp_path)
    force = dict(fx=3.0, fy=-2.0, fz=1.5)
    on_axis = with_effects(scene, ("constant_force", "d.upper", force))
    still = with_effects(scene)
    channels = ["d.j1.position", "d.j2.position"]
    initial = at_rest_but({"d.j1": 0.4, "d.j2": 0.3})
    a, b = (SceneSimulation(s).run(initial, TIMES, channels) for s in (on_axis, still))
    np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-6), (0.0005, 0.003)])
@pytest.mark.parametrize("kind", ["constant_force", "sinusoidal_force", "body_drag"])
def test_a_free_ball_moves_as_the_closed_form_says(tmp_path, kind, time_step, atol):
    # atol of the discrete plant: 0.5 ms late in speed at 9 m/s2: 4.4 mm/s x 0.5 s.
    m = 0.07
    f = np.array([0.3, -0.2, 0.4])
    parameters = dict(zip(("fx", "fy", "fz"), f, strict=True))
    v0, t = np.array([0.5, 1.0, 2.0]), np.linspace(0, 0.5, 6)
    g = np.array([0, 0, -G])
    if kind == "constant_force":
        path = np.outer(t, v0) + np.outer(t**2 / 2, f / m + g)
    elif kind == "sinusoidal_force":
        # Twice the integral of f/m sin(w t + p).
        w, p = 2 * np.pi * 3.0, 0.7
        parameters |= dict(frequency=3.0, phase=p)
        twice = (np.sin(p) - np.sin(w * t + p)) / w**2 + np.cos(p) * t / w
        path = np.outer(t, v0) + np.outer(t**2 / 2, g) + np.outer(twice, f / m)
    else:
        # v' = g - (c/m) v.
        parameters = dict(linear=0.2, angular=1e-4)
        k = 0.2 / m
        end = g / k
        path = np.outer(t, end) + np.outer((1 - np.exp(-k * t)) / k, v0 - end)
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step, z=50.0), (kind, "b.ball", parameters)
    )
    initial = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, 50.0], twist=[0, 0, 7.0, *v0]
    )
    channels = [f"b.ball.{a}" for a in ("x", "y", "z", "wz")]
    rows = SceneSimulation(scene).run(initial, t, channels)
    np.testing.assert_allclose(rows[:, :3], path + [0, 0, 50.0], atol=atol)
    spin = np.exp(-parameters.get("angular", 0.0) / 2.7783e-5 * t)
    np.testing.assert_allclose(rows[:, 3], 7.0 * spin, atol=7.0 * max(atol, 1e-5))


def test_a_sinusoidal_force_goes_with_the_recordings_clock(tmp_path):
    # Two windows that start at different times see different parts of the sine.
    force = dict(fx=0.3, fy=0.0, fz=0.0, frequency=1.0, phase=0.0)
    scene = with_effects(
        on_ground(tmp_path, "ball", 0.0, z=50.0), ("sinusoidal_force", "b.ball", force)
    )
    simulation = SceneSimulation(scene)
    initial = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, 0, 0, 50.0])
    for start in (0.0, 0.5):
        rows = simulation.run(initial, start + np.array([0, 0.25]), ["b.ball.vx"])
        w = 2 * np.pi
        speed = 0.3 / 0.07 * (np.cos(w * start) - np.cos(w * (start + 0.25))) / w
        np.testing.assert_allclose(rows[1, 0], speed, atol=1e-6)


@pytest.mark.parametrize(
    "kind, at, parameters, words",
    [
        ("payload", "p.rod", dict(mass=-1, com_x=0, com_y=0, com_z=0), "expected >= 0"),
        ("payload", "p.rod", dict(mass=1, com_x=0, com_y=0), "needs `com_z`"),
        ("payload", "p.arm", dict(mass=1, com_x=0, com_y=0, com_z=0), "a body of 'p'"),
        ("gravity_tilt", "q", dict(roll=0, pitch=0), "expected `world` or a model: "),
        ("constant_force", "p.rod", dict(fx=1, fy=np.nan, fz=1), "fy is nan"),
        (
            "sinusoidal_force",
            "p.rod",
            dict(fx=1, fy=1, fz=1, frequency=0, phase=0),
            "frequency is 0, expected > 0",
        ),
        ("body_drag", "p.rod", dict(linear=-1, angular=0), "linear is -1"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, kind, at, parameters, words):
    scene = with_effects(pendulum(tmp_path), (kind, at, parameters))
    with pytest.raises(ValueError, match=words):
        load_scene(scene, DiagramBuilder())


def test_two_payloads_on_one_body_are_refused(tmp_path):
    one = ("payload", "p.rod", dict(mass=0.1, com_x=0, com_y=0, com_z=CENTRAL))
    with pytest.raises(ValueError, match="p.rod has one"):
        load_scene(with_effects(pendulum(tmp_path), one, one), DiagramBuilder())
