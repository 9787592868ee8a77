"""Payload, links, tilt, and forces on a body."""

from dataclasses import replace
from pathlib import Path

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

from makebreak.gap.simulation.commands import Commands
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.scene import load_scene, read_scene

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


def free_fall(m, com, extent=0.0):
    """q'' of a pendulum about y with a mass m of that radius of gyration at
    com = (x, y, z) besides."""
    x, _, z = com
    inertia = J + m * (x**2 + z**2 + extent**2)

    def acceleration(t, q, v):
        # Turning by q about y moves (x, z) to height z cos q - x sin q.
        own = -MASS * G * LENGTH * np.sin(q)
        return (own + m * G * (z * np.sin(q) + x * np.cos(q))) / inertia

    return acceleration


@pytest.mark.parametrize("extent", [0.0, 0.15])
@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-4), (0.0005, 0.01)])
def test_payload_swings_as_a_mass_of_that_size(tmp_path, time_step, atol, extent):
    # atol: accuracy of the integrator; a first-order scheme of 0.5 ms at 15 rad/s2.
    m, com = 0.7, (0.12, 0.05, -0.4)
    parameters = dict(mass=m, com_x=com[0], com_y=com[1], com_z=com[2])
    if extent:
        parameters["gyration_radius"] = extent
    scene = with_effects(
        pendulum(tmp_path, time_step), ("payload", "p.rod", parameters)
    )
    expected = ode(free_fall(m, com, extent))
    np.testing.assert_allclose(simulated(scene), expected, atol=atol)
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


@pytest.mark.parametrize("time_step, atol", [(0.0, 1e-4), (0.0005, 0.01)])
def test_a_load_that_is_not_there_is_a_negative_point_mass(tmp_path, time_step, atol):
    # Of the rod's kilogram 0.3 kg are missing just beside its centre of mass.
    m, com = -0.3, (0.01, 0.02, -0.52)
    parameters = dict(mass=m, com_x=com[0], com_y=com[1], com_z=com[2])
    scene = with_effects(
        pendulum(tmp_path, time_step), ("payload", "p.rod", parameters)
    )
    np.testing.assert_allclose(simulated(scene), ode(free_fall(m, com)), atol=atol)
    # It swings about as before: a pendulum's mass hardly matters. Its weight does.
    loaded = load_scene(scene, DiagramBuilder())
    assert loaded.plant.CalcTotalMass(loaded.plant.CreateDefaultContext()) == 0.7
    assert SceneDynamics(scene).least("payload", ["p.rod"]) == {"mass": -0.7}


@pytest.mark.parametrize(
    "inertial",
    ["", "<inertial><mass>2</mass></inertial>",
     "<inertial><inertia><ixx>0.9</ixx></inertia></inertial>"],
)  # fmt: skip
def test_what_an_sdf_leaves_out_of_an_inertia_is_as_drake_has_it(tmp_path, inertial):
    (tmp_path / "m.sdf").write_text(
        '<sdf version="1.9"><model name="m"><link name="l">'
        f"{inertial}</link></model></sdf>"
    )
    (tmp_path / "scene.yaml").write_text(
        f"directives:\n  - add_model: {{name: m, file: {tmp_path / 'm.sdf'}}}\n"
    )
    scene = read_scene(tmp_path / "scene.yaml")
    rows = []
    for added in ([], [("link_mass", "m.l", {"mass": 0.5})]):
        plant = load_scene(with_effects(scene, *added), DiagramBuilder()).plant
        own = plant.GetBodyByName("l").CalcSpatialInertiaInBodyFrame(
            plant.CreateDefaultContext()
        )
        about = own.CalcRotationalInertia().CopyToFullMatrix3()
        rows.append(np.r_[own.get_mass(), np.diag(about)])
    mass = rows[0][0]  # Moments go with the mass.
    more = np.r_[0.5 / mass, np.full(3, 0.5 / mass)]
    np.testing.assert_allclose(rows[1], (1.0 + more) * rows[0])


def heavier(mass):
    """Mass and moments of inertia times 1 + mass, as the rod has 1 kg: by a constant
    torque the acceleration differs."""
    return lambda t, q, v: (
        (2.0 - (1.0 + mass) * MASS * G * LENGTH * np.sin(q)) / ((1.0 + mass) * J)
    )


def shifted(x, z):
    """The rod's centre of mass at (x, z - 0.5), its central inertia as before."""

    def acceleration(t, q, v):
        c = np.array([x, z - LENGTH])
        weight = MASS * G * (c[1] * np.sin(q) + c[0] * np.cos(q))
        return (2.0 + weight) / (CENTRAL + MASS * c @ c)

    return acceleration


LINKS = [
    ("link_mass", dict(mass=0.4), heavier(0.4)),
    ("link_mass", dict(mass=-0.4), heavier(-0.4)),
    ("link_com", dict(x=0.1, y=0.05, z=-0.06), shifted(0.1, -0.06)),
    ("link_com", dict(x=-0.1, y=0.05, z=0.06), shifted(-0.1, 0.06)),
]


@pytest.mark.parametrize("kind, parameters, acceleration", LINKS)
@pytest.mark.parametrize("built_with", [1.0, 0.3])
def test_a_link_of_another_mass_or_centre_swings_as_the_ode_says(
    tmp_path, kind, parameters, acceleration, built_with
):
    scene = with_effects(pendulum(tmp_path), (kind, "p.rod", parameters))
    first = {name: built_with * value for name, value in parameters.items()}
    simulation = SceneSimulation(with_effects(scene, (kind, "p.rod", first)))
    simulation.set_effects(scene.effects)
    assert simulation.builds == 1
    commands = Commands(np.array([0.0]), {"p.j1.effort_command": np.array([2.0])})
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    rows = simulation.run(initial, TIMES, CHANNELS, commands)
    np.testing.assert_allclose(rows, ode(acceleration), atol=1e-4)
    assert abs(ode(acceleration) - ode(heavier(0.0))).max() > 0.1


def test_a_change_of_a_link_goes_on_top_of_a_new_value(tmp_path):
    scene = with_effects(
        pendulum(tmp_path),
        ("link_mass", "p.rod", dict(mass=-0.5)),
        ("object_mass", "p.rod", dict(mass=2.0)),
        ("link_com", "p.rod", dict(x=0.0, y=0.0, z=0.1)),
        ("link_mass", "p.rod", dict(mass=0.1)),
    )
    simulation = SceneSimulation(scene)
    plant = load_scene(scene, DiagramBuilder()).plant
    M = plant.GetBodyByName("rod").default_spatial_inertia()
    assert M.get_mass() == pytest.approx(1.6)
    np.testing.assert_allclose(M.get_com(), [0.0, 0.0, -0.4])
    # Central moments go with the mass, once.
    about = M.CalcRotationalInertia().CopyToFullMatrix3()
    assert about[1, 1] == pytest.approx(1.6 * (CENTRAL + 0.4**2))
    # Other values of both kinds: built anew, as in a Context neither knows the other.
    other = with_effects(
        scene,
        ("link_mass", "p.rod", dict(mass=0.2)),
        ("object_mass", "p.rod", dict(mass=2.5)),
        ("link_com", "p.rod", dict(x=0.0, y=0.0, z=0.1)),
        ("link_mass", "p.rod", dict(mass=0.1)),
    )
    simulation.set_effects(other.effects)
    initial = at_rest_but({"p.j1": Q0}, {"p.j1": V0})
    np.testing.assert_array_equal(
        simulation.run(initial, TIMES, CHANNELS), simulated(other)
    )
    assert simulation.builds == 2


def test_a_link_can_lose_all_that_it_has_where_others_carry_on(tmp_path):
    # A tool welded to the rod, and not mounted in truth.
    scene = with_effects(pendulum(tmp_path), ("link_mass", "p.rod", dict(mass=-1.0)))
    file = Path(scene.directives[0].add_model.file.removeprefix("file://"))
    tool = """<link name="tool"><inertial><mass value="0.5"/><origin xyz="0 0 -0.7"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    </link><joint name="w" type="fixed"><parent link="rod"/><child link="tool"/></joint>
    </robot>"""
    file.write_text(file.read_text().replace("</robot>", tool))
    expected = ode(lambda t, q, v: -0.5 * G * 0.7 * np.sin(q) / (0.001 + 0.5 * 0.7**2))
    np.testing.assert_allclose(simulated(scene), expected, atol=1e-4)


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


@pytest.mark.parametrize("time_step, rtol", [(0.0, 1e-6), (0.0005, 2e-3)])
def test_drag_with_the_square_of_the_speed_acts_against_it(tmp_path, time_step, rtol):
    """Without gravity along a slanted line: v = v0/(1 + k v0 t), k = c/m; and a fall
    ends at sqrt(m g/c)."""
    m, c, v0 = 0.07, 0.05, np.array([2.0, -1.0, 2.0])
    drag = ("body_quadratic_drag", "b.ball", {"coefficient": c})
    scene = with_effects(on_ground(tmp_path, "ball", time_step, z=50.0), drag)
    simulation = SceneSimulation(scene)
    names = [f"b.ball.v{a}" for a in "xyz"]
    u = np.sqrt(m * G / c)
    start = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, 0, 0, 50.0])
    (_, v) = simulation.run(start, np.array([0.0, 1.5]), names)
    np.testing.assert_allclose(v, [0, 0, -u * np.tanh(G * 1.5 / u)], rtol=rtol,
                               atol=1e-9)  # fmt: skip
    scene = replace(scene, plant=replace(scene.plant, gravity=[0.0, 0.0, 0.0]))
    moving = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, 50.0], twist=[0, 0, 0, *v0]
    )
    (_, v) = SceneSimulation(scene).run(moving, np.array([0.0, 1.0]), names)
    np.testing.assert_allclose(v, v0 / (1.0 + c / m * 3.0), rtol=rtol)


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
        (
            "payload",
            "p.rod",
            dict(mass=-1.1, com_x=0, com_y=0, com_z=-0.5),
            "no body",
        ),
        # 0.5 kg are not that far from where all of the rod's kilogram is.
        (
            "payload",
            "p.rod",
            dict(mass=-0.5, com_x=0.3, com_y=0, com_z=0),
            "no body",
        ),
        ("link_mass", "p.rod", dict(mass=-1.1), "1.1 kg less, and the link has 1 kg"),
        ("link_mass", "p.base", dict(mass=0.1), "no mass and inertia to change"),
        ("link_com", "p.rod", dict(x=0.1), "needs `y`"),
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
