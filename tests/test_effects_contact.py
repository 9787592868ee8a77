"""Friction, friction patch, stiffness, dissipation; the ground's height and tilt.

Friction and rolling resistance on the project's own models: test_scene.py.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import G, at_rest_but, on_ground, surface, with_effects
from gap_benchmark import push_world
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import DiagramBuilder
from scipy.integrate import solve_ivp

from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene

BALL_MASS, RADIUS = 0.07, 0.0315
PAIR = "b~g"


def combined(scene):
    """The pair's friction, stiffness and dissipation as Drake combines two surfaces."""
    loaded = load_scene(scene, DiagramBuilder())
    inspector = loaded.scene_graph.model_inspector()
    values = []
    for name in ("box" if loaded.plant.HasBodyNamed("box") else "ball", "plate"):
        body = loaded.plant.GetBodyByName(name)
        p = inspector.GetProximityProperties(
            loaded.plant.GetCollisionGeometriesForBody(body)[0]
        )
        values.append(
            [
                p.GetProperty("material", "coulomb_friction").dynamic_friction(),
                p.GetProperty("material", "point_contact_stiffness"),
                p.GetProperty("material", "hunt_crossley_dissipation"),
            ]
        )
    (m1, k1, d1), (m2, k2, d2) = values
    k = k1 * k2 / (k1 + k2)
    return 2 * m1 * m2 / (m1 + m2), k, (k2 * d1 + k1 * d2) / (k1 + k2)


def slowing_and_push(before, after, duration):
    """Mean friction and mean normal force over the mass, from [vx, vz]: after 30 ms the
    feet have settled in a discrete plant; in a continuous one the block rocks on."""
    return (before[0] - after[0]) / duration, G + (after[1] - before[1]) / duration


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.9, 1.4])
@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_a_block_slows_by_mu_g(tmp_path, mu, time_step):
    # 1.4 is more than twice what either surface has: then both are changed.
    scene = with_effects(
        on_ground(tmp_path, "block", time_step),
        ("contact_friction", PAIR, dict(friction=mu)),
    )
    start = at_rest_but(
        body="b.box", pose=[1, 0, 0, 0, 0, 0, 0.02], twist=[0] * 3 + [2, 0, 0]
    )
    times = np.array([0.0, 0.03, 0.1])
    rows = SceneSimulation(scene).run(start, times, ["b.box.vx", "b.box.vz"])
    slowing, push = slowing_and_push(rows[1], rows[2], 0.07)
    np.testing.assert_allclose(slowing, mu * push, rtol=5e-3, atol=1e-3)


@pytest.mark.parametrize("k", [3e3, 1.9e5, 1e6])
@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_a_ball_sinks_in_by_weight_over_stiffness(tmp_path, k, time_step):
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("contact_stiffness", PAIR, dict(stiffness=k)),
        ("contact_dissipation", PAIR, dict(dissipation=30.0)),
    )
    depth = BALL_MASS * G / k
    start = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS - depth])
    rows = SceneSimulation(scene).run(start, np.array([0.0, 0.2]), ["b.ball.z"])
    np.testing.assert_allclose(RADIUS - rows[1, 0], depth, rtol=1e-3)
    np.testing.assert_allclose(combined(scene)[1], k)


@pytest.mark.parametrize("d", [0.0, 0.3, 4.0])
@pytest.mark.parametrize("time_step", [0.0, 5e-6])
def test_a_ball_bounces_as_hunt_and_crossley_say(tmp_path, d, time_step):
    # m z'' = k x (1 + d x')+ - m g with x the penetration, against scipy.
    k, v0 = 2e4, -1.0
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("contact_stiffness", PAIR, dict(stiffness=k)),
        ("contact_dissipation", PAIR, dict(dissipation=d)),
    )
    times = np.array([0.0, 0.003, 0.015])
    start = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS], twist=[0, 0, 0, 0, 0, v0]
    )
    rows = SceneSimulation(scene).run(start, times, ["b.ball.z", "b.ball.vz"])

    def rate(t, y):
        x, x_rate = max(RADIUS - y[0], 0.0), -y[1]
        return [y[1], k * x * max(1 + d * x_rate, 0.0) / BALL_MASS - G]

    expected = solve_ivp(
        rate,
        (0, 0.015),
        [RADIUS, v0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-13,
        max_step=1e-5,
    ).y.T
    # Discrete: 20 us of a contact of 6 ms, at 500 m/s2.
    atol = 1e-5 if time_step == 0 else 5e-3
    np.testing.assert_allclose(rows[:, 0], expected[:, 0], atol=atol * 1e-2)
    np.testing.assert_allclose(rows[:, 1], expected[:, 1], atol=atol)


@pytest.mark.parametrize("c", [0.0, 4.0, 40.0])
@pytest.mark.parametrize("time_step", [0.0, 5e-6])
def test_a_ball_bounces_on_a_linear_damper(tmp_path, c, time_step):
    # m z'' = max(k x + c x', 0) - m g with x > 0 the penetration, against scipy.
    k, v0 = 2e4, -1.0
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("contact_stiffness", PAIR, dict(stiffness=k)),
        ("contact_damping", PAIR, dict(damping=c)),
        ("contact_dissipation", PAIR, dict(dissipation=9.0)),  # Has no say beside it.
    )
    times = np.array([0.0, 0.003, 0.015])
    start = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS], twist=[0, 0, 0, 0, 0, v0]
    )
    rows = SceneSimulation(scene).run(start, times, ["b.ball.z", "b.ball.vz"])

    def rate(t, y):
        x, x_rate = RADIUS - y[0], -y[1]
        push = max(k * x + c * x_rate, 0.0) if x > 0.0 else 0.0
        return [y[1], push / BALL_MASS - G]

    expected = solve_ivp(
        rate, (0, 0.015), [RADIUS, v0], t_eval=times, rtol=1e-10, atol=1e-13,
        max_step=1e-5,
    ).y.T  # fmt: skip
    atol = 5e-4 if time_step == 0 else 1e-2  # The damper begins with a step of force.
    np.testing.assert_allclose(rows[:, 0], expected[:, 0], atol=atol * 1e-2)
    np.testing.assert_allclose(rows[:, 1], expected[:, 1], atol=atol)


@pytest.mark.parametrize("time_step", [0.0, 5e-6])
def test_a_damped_contact_rubs_with_its_whole_force(tmp_path, time_step):
    """A ball that slides while it bounces loses mu times the impulse that throws it."""
    mu, v0 = 0.2, -1.0
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("contact_stiffness", PAIR, dict(stiffness=2e4)),
        ("contact_damping", PAIR, dict(damping=20.0)),
        ("contact_friction", PAIR, dict(friction=mu)),
    )
    start = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS], twist=[0, 0, 0, 3.0, 0, v0]
    )
    names = ["b.ball.vx", "b.ball.vz", "b.ball.z"]
    rows = SceneSimulation(scene).run(start, np.array([0.0, 0.015]), names)
    assert rows[1, 2] > RADIUS  # It is off the ground again.
    thrown = rows[1, 1] - v0 + G * 0.015
    np.testing.assert_allclose(3.0 - rows[1, 0], mu * thrown, rtol=5e-3)


@pytest.mark.parametrize("c", [40.0, 150.0, 1000.0])
def test_a_stiff_damper_throws_nothing_away_in_a_discrete_plant(tmp_path, c):
    scene = with_effects(
        on_ground(tmp_path, "ball", 0.001),
        ("contact_stiffness", PAIR, dict(stiffness=2e4)),
        ("contact_damping", PAIR, dict(damping=c)),
    )
    start = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS], twist=[0, 0, 0, 0, 0, -1.0]
    )
    times = 0.001 * np.arange(60)
    rows = SceneSimulation(scene).run(start, times, ["b.ball.vz"])
    assert rows.max() < 0.3


def test_a_damper_acts_while_the_two_touch_and_never_pulls(tmp_path):
    other = with_effects(
        on_ground(tmp_path, "ball"), ("contact_damping", PAIR, dict(damping=40.0))
    )
    builder = DiagramBuilder()
    plant = load_scene(other, builder).plant
    diagram = builder.Build()
    name = next(
        s.get_name()
        for s in diagram.GetSystems()
        if s.get_name().startswith("contact_damper")
    )
    damper = diagram.GetSubsystemByName(name)
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    ball = plant.GetBodyByName("ball")

    def force(z, vz):
        plant.SetFreeBodyPose(own, ball, RigidTransform([0.1, 0.0, z]))
        v = SpatialVelocity([0.0, 0.0, 0.0], [0.0, 0.0, vz])
        plant.SetFreeBodySpatialVelocity(own, ball, v)
        port = damper.GetOutputPort("generalized_force")
        return port.Eval(damper.GetMyContextFromRoot(context))

    np.testing.assert_allclose(force(RADIUS + 1e-6, -1.0), 0.0)
    at = ball.floating_velocities_start_in_v()
    expected = np.zeros(plant.num_velocities())
    expected[at + 5] = 40.0 * 0.02
    np.testing.assert_allclose(force(RADIUS - 1e-3, -0.02), expected, atol=1e-9)
    _, k, _ = combined(other)
    expected[at + 5] = -k * 1e-7  # It takes the spring's force, and does not pull.
    np.testing.assert_allclose(force(RADIUS - 1e-7, 5.0), expected, atol=1e-9)


@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_a_damped_contact_rubs_where_the_two_touch(tmp_path, spin):
    """The generalized force on a ball that sinks, slides and spins is f and r x f, with
    r from its centre to the touch, halfway in the overlap."""
    other = with_effects(
        on_ground(tmp_path, "ball"), ("contact_damping", PAIR, dict(damping=40.0))
    )
    builder = DiagramBuilder()
    plant = load_scene(other, builder).plant
    diagram = builder.Build()
    damper = next(
        s for s in diagram.GetSystems() if s.get_name().startswith("contact_damper")
    )
    context = diagram.CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    ball = plant.GetBodyByName("ball")
    depth, down = 2e-3, 0.02
    r = np.array([0.0, 0.0, -(RADIUS - depth / 2)])
    v, w = np.array([0.3, -0.1, -down]), np.array([0.0, spin, 0.0])
    plant.SetFreeBodyPose(own, ball, RigidTransform([0.1, 0.0, RADIUS - depth]))
    plant.SetFreeBodySpatialVelocity(own, ball, SpatialVelocity(w, v))
    port = damper.GetOutputPort("generalized_force")
    felt = port.Eval(damper.GetMyContextFromRoot(context))

    friction, _, _ = combined(other)
    slip = v + np.cross(w, r)
    slip[2] = 0.0
    normal = 40.0 * down
    f = np.array([0.0, 0.0, normal]) - friction * normal * slip / np.linalg.norm(slip)
    expected = np.zeros(plant.num_velocities())
    at = ball.floating_velocities_start_in_v()
    expected[at : at + 3], expected[at + 3 : at + 6] = np.cross(r, f), f
    np.testing.assert_allclose(felt, expected, rtol=1e-9, atol=1e-12)


def test_values_of_a_pair_are_what_was_asked_for_and_told_back(tmp_path):
    ground = surface(0.3, 5e4, 2.0)
    scene = on_ground(tmp_path, "ball", ground=ground)
    model = SceneDynamics(scene)
    mu, k, d = combined(scene)
    assert model.now("contact_friction", [PAIR]) == {"friction": pytest.approx(mu)}
    assert model.now("contact_stiffness", [PAIR]) == {"stiffness": pytest.approx(k)}
    assert model.now("contact_dissipation", [PAIR]) == {"dissipation": pytest.approx(d)}
    for wanted in ((0.2, 1e4, 0.5), (0.7, 3e5, 40.0)):
        changed = with_effects(
            scene,
            # In any order, though dissipation is weighed by the stiffness.
            ("contact_dissipation", PAIR, dict(dissipation=wanted[2])),
            ("contact_stiffness", PAIR, dict(stiffness=wanted[1])),
            ("contact_friction", PAIR, dict(friction=wanted[0])),
        )
        np.testing.assert_allclose(combined(changed), wanted)


PATCH = dict(friction=0.1, x_min=0.2, x_max=0.5, y_min=-0.5, y_max=0.3)


def slide(folder, time_step, x, y, vx, patch=PATCH, half_space=False):
    scene = with_effects(
        on_ground(folder, "block", time_step), ("friction_patch", PAIR, patch)
    )
    if half_space:
        text = (folder / "g.sdf").read_text()
        box = text[text.index("<pose>") : text.index("</geometry>")]
        plane = "<geometry><plane><normal>0 0 1</normal><size>1 1</size></plane>"
        (folder / "g.sdf").write_text(text.replace(box, plane))
    start = at_rest_but(
        body="b.box", pose=[1, 0, 0, 0, x, y, 0.02], twist=[0, 0, 0, vx, 0, 0]
    )
    times = np.array([0.03, 0.08])
    rows = SceneSimulation(scene).run(
        start, times, ["b.box.vx", "b.box.vz"], start_sec=0.0
    )
    slowing, push = slowing_and_push(*rows, 0.05)
    return slowing / push


@pytest.mark.parametrize("time_step", [0.0, 0.001])
@pytest.mark.parametrize(
    "x, y, mu", [(0.32, 0.0, 0.1), (-0.5, 0.0, 0.5), (0.32, 0.5, 0.5)]
)
def test_friction_is_another_on_the_patch(tmp_path, time_step, x, y, mu):
    # All four feet on the patch, before it, beside it.
    np.testing.assert_allclose(slide(tmp_path, time_step, x, y, 0.8), mu, rtol=5e-3)


@pytest.mark.parametrize("x, mu", [(0.32, 1.3), (-0.5, 0.5)])
def test_a_patch_can_be_rougher_than_either_surface_allows(tmp_path, x, mu):
    patch = PATCH | dict(friction=1.3)
    mean = slide(tmp_path, 0.001, x, 0.0, 1.2, patch)
    np.testing.assert_allclose(mean, mu, rtol=5e-3)


@pytest.mark.parametrize(
    "x, y, mu",
    [(0.32, 0.0, 0.1), (0.32, -0.45, 0.2), (-0.5, 0.0, 0.2), (-0.5, 0.6, 0.5)],
)
def test_of_two_patches_the_later_one_counts_where_they_overlap(tmp_path, x, y, mu):
    # The second is left of and before the first, and over a strip of it.
    second = dict(friction=0.2, x_min=-1.0, x_max=0.6, y_min=-0.9, y_max=-0.3)
    third = dict(friction=0.2, x_min=-1.0, x_max=0.1, y_min=-0.6, y_max=0.3)
    scene = with_effects(
        on_ground(tmp_path, "block", 0.001),
        *(("friction_patch", PAIR, p) for p in (PATCH, second, third)),
    )
    start = at_rest_but(
        body="b.box", pose=[1, 0, 0, 0, x, y, 0.02], twist=[0, 0, 0, 0.8, 0, 0]
    )
    rows = SceneSimulation(scene).run(
        start, np.array([0.03, 0.08]), ["b.box.vx", "b.box.vz"], start_sec=0.0
    )
    slowing, push = slowing_and_push(*rows, 0.05)
    np.testing.assert_allclose(slowing / push, mu, rtol=5e-3)


@pytest.mark.parametrize("x, mu", [(0.32, 0.1), (-0.5, 0.5)])
def test_a_half_space_can_have_a_patch(tmp_path, x, mu):
    mean = slide(tmp_path, 0.001, x, 0.0, 0.8, half_space=True)
    np.testing.assert_allclose(mean, mu, rtol=5e-3)


def test_on_the_patchs_edge_each_foot_has_its_own_friction(tmp_path):
    # Two feet at y = 0.25 are on it, two at 0.45 beside it: each bears a quarter of the
    # weight. The block turns by and by; at first it slows by the mean.
    mean = slide(tmp_path, 0.001, 0.3, 0.35, 0.8)
    np.testing.assert_allclose(mean, (0.1 + 0.5) / 2, rtol=0.05)


def test_the_ground_round_a_patch_is_flush_and_whole(tmp_path):
    # A ball that rolls across both edges neither hops nor slows.
    scene = with_effects(
        on_ground(tmp_path, "ball", 0.001), ("friction_patch", PAIR, PATCH)
    )
    depth = BALL_MASS * G / 1e5
    start = at_rest_but(
        body="b.ball",
        pose=[1, 0, 0, 0, 0.1, 0, RADIUS - depth],
        twist=[0, 1.0 / RADIUS, 0, 1.0, 0, 0],
    )
    rows = SceneSimulation(scene).run(
        start, np.linspace(0, 0.6, 301), ["b.ball.z", "b.ball.vx", "b.ball.x"]
    )
    assert rows[-1, 2] > 0.65
    # On an edge two shapes bear it: half as deep. It lies there for sqrt(8 R s) =
    # 1.3 mm and is lifted by less than its own depth of 7 um.
    np.testing.assert_allclose(rows[:, 0], RADIUS, atol=2e-5)
    np.testing.assert_allclose(rows[:, 1], 1.0, atol=2e-3)


@pytest.mark.parametrize("time_step", [0.0, 0.001])
def test_a_lifted_plane_bears_things_higher(tmp_path, time_step):
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step), ("plane_height", "g", dict(height=0.01))
    )
    depth = BALL_MASS * G / 1e5
    start = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS + 0.01 - depth])
    rows = SceneSimulation(scene).run(start, np.array([0, 0.2]), ["b.ball.z"])
    np.testing.assert_allclose(rows[1, 0], RADIUS + 0.01 - depth, atol=1e-6)


def test_a_body_that_stands_elsewhere_is_met_there(tmp_path):
    """A ball that rolls off the displaced ground's edge falls; on it, it lies as high
    as the ground was lifted."""
    scene = with_effects(
        on_ground(tmp_path, "ball", 0.001),
        ("wall_position", "g.plate", dict(x=-0.1, z=0.01)),
    )
    depth = BALL_MASS * G / 1e5
    for x, falls in ((1.85, False), (1.95, True)):  # The ground ends at 2 m.
        start = at_rest_but(
            body="b.ball", pose=[1, 0, 0, 0, x, 0, RADIUS + 0.01 - depth]
        )
        rows = SceneSimulation(scene).run(start, np.array([0, 0.2]), ["b.ball.z"])
        assert (rows[1, 0] < 0.0) == falls
        if not falls:
            np.testing.assert_allclose(rows[1, 0], RADIUS + 0.01 - depth, atol=1e-6)


@pytest.mark.parametrize("time_step", [0.0, 0.001])
@pytest.mark.parametrize("roll, pitch", [(0.05, 0.0), (0.0, 0.03), (0.02, -0.04)])
def test_a_ball_rolls_down_a_tilted_plane(tmp_path, time_step, roll, pitch):
    # A solid sphere that rolls without slip: 5/7 of gravity along the plane.
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("plane_tilt", "g.plate", dict(roll=roll, pitch=pitch)),
    )
    # The plane's normal, Ry(pitch) Rx(roll) z.
    n = np.array(
        [np.sin(pitch) * np.cos(roll), -np.sin(roll), np.cos(pitch) * np.cos(roll)]
    )
    depth = BALL_MASS * G * n[2] / 1e5
    start = at_rest_but(body="b.ball", pose=[1, 0, 0, 0, *((RADIUS - depth) * n)])
    times = np.array([0.1, 0.4])
    rows = SceneSimulation(scene).run(
        start, times, ["b.ball.vx", "b.ball.vy", "b.ball.vz"], start_sec=0.0
    )
    g = np.array([0, 0, -G])
    along = g - (g @ n) * n
    # The first steps settle (friction takes hold within a slip of 0.1 mm/s).
    np.testing.assert_allclose((rows[1] - rows[0]) / 0.3, 5 / 7 * along, atol=5e-3)


@pytest.mark.parametrize("time_step", [0.0, 0.0005])
def test_rolling_resistance_slows_evenly(tmp_path, time_step):
    c = 0.02
    scene = with_effects(
        on_ground(tmp_path, "ball", time_step),
        ("rolling_resistance", PAIR, dict(coefficient=c)),
    )
    start = at_rest_but(
        body="b.ball",
        pose=[1, 0, 0, 0, 0, 0, RADIUS - BALL_MASS * G / 1e5],
        twist=[0, 0.5 / RADIUS, 0, 0.5, 0, 0],
    )
    rows = SceneSimulation(scene).run(start, np.array([0.0, 0.05, 0.15]), ["b.ball.vx"])
    slowing = (rows[1, 0] - rows[2, 0]) / 0.1
    # As in test_scene.py: 5/7 c g; the torque is one step late.
    np.testing.assert_allclose(slowing, 5 / 7 * c * G, rtol=1e-2)


def test_rolling_resistance_slows_a_soft_ball_as_evenly(tmp_path):
    """Its contact is a surface, and no point."""
    ground = on_ground(tmp_path, "ball", 0.0005)
    ground = replace(ground, plant=replace(ground.plant, contact_model="hydroelastic"))
    soft = (
        "<drake:compliant_hydroelastic/>"
        "<drake:hydroelastic_modulus>1e7</drake:hydroelastic_modulus>"
        "<drake:mesh_resolution_hint>0.005</drake:mesh_resolution_hint>"
    )
    for file in tmp_path.glob("*.sdf"):
        opening = "<drake:proximity_properties>"
        file.write_text(file.read_text().replace(opening, opening + soft))
        assert soft in file.read_text()
    start = at_rest_but(
        body="b.ball", pose=[1, 0, 0, 0, 0, 0, RADIUS - 2e-4],
        twist=[0, 0.5 / RADIUS, 0, 0.5, 0, 0],
    )  # fmt: skip
    slowing = []
    for c in (0.0, 0.02):
        scene = with_effects(ground, ("rolling_resistance", PAIR, dict(coefficient=c)))
        times = np.array([0.0, 0.05, 0.35])
        rows = SceneSimulation(scene).run(start, times, ["b.ball.vx"])
        slowing.append((rows[1, 0] - rows[2, 0]) / 0.3)
    # A polyhedron with edges of 5 mm is no perfect ball: it is slowed all the same.
    np.testing.assert_allclose(slowing[1] - slowing[0], 5 / 7 * 0.02 * G, rtol=0.1)


@pytest.mark.parametrize("c", [0.0, 0.02])
def test_a_lying_cylinder_rolls_against_a_resistance(tmp_path, c):
    scene = with_effects(
        on_ground(tmp_path, "roller", 0.0005),
        ("rolling_resistance", PAIR, dict(coefficient=c)),
    )
    radius, speed, z = 0.02, 0.3, 0.02 - 0.4 * G / 2.0 / 1e5
    start = at_rest_but(
        body="b.roller",
        pose=[1, 0, 0, 0, 0, 0, z],
        twist=[-speed / radius, 0, 0, 0, speed, 0],
    )
    columns = ["b.roller.vx", "b.roller.vy"]
    rows = SceneSimulation(scene).run(start, np.array([0.0, 0.05, 0.15]), columns)
    # A full cylinder; each of the two contacts carries half.
    np.testing.assert_allclose(
        (rows[1, 1] - rows[2, 1]) / 0.1, 2 / 3 * c * G, rtol=1e-2, atol=2e-4
    )
    np.testing.assert_allclose(rows[:, 0], 0.0, atol=1e-6)


def test_what_rolls_on_other_radii_has_no_one_lever(tmp_path):
    """A disc stands on its feet; a cylinder inside two larger spheres may tilt."""
    scene = with_effects(
        on_ground(tmp_path, "roller 0.019"),
        ("rolling_resistance", PAIR, dict(coefficient=0.01)),
    )
    words = r"cylinders \(and spheres\) of one radius"
    with pytest.raises(ValueError, match=words):
        load_scene(scene, DiagramBuilder())
    file = tmp_path / "b.sdf"  # A box between the spheres.
    text = file.read_text().replace("\n", "")
    box = "<box><size>0.14 0.04 0.04</size></box>"
    file.write_text(re.sub("<cylinder>.*</cylinder>", box, text))
    with pytest.raises(ValueError, match=words):
        load_scene(scene, DiagramBuilder())


@pytest.mark.parametrize(
    "kind, at, parameters, words",
    [
        ("contact_friction", PAIR, dict(friction=-1.0), "friction is -1.0, expected"),
        (
            "contact_stiffness",
            PAIR,
            dict(stiffness=0.0),
            "stiffness is 0.0, expected >",
        ),
        ("contact_stiffness", "b", dict(stiffness=1.0), "expected one contact pair"),
        ("contact_dissipation", PAIR, dict(dissipation=-1.0), "dissipation is -1.0"),
        ("contact_dissipation", "b~h", dict(dissipation=1.0), "no model 'h'"),
        ("friction_patch", PAIR, PATCH | dict(x_max=0.1), "the patch is empty"),
        ("friction_patch", PAIR, PATCH | dict(x_min=8, x_max=9), "the patch is off"),
        ("friction_patch", PAIR, dict(friction=0.1), "needs `x_min`"),
        ("friction_patch", PAIR, PATCH | dict(friction=-1.0), "friction is -1.0"),
        ("plane_height", "b.ball", dict(height=0.1), "welded to the world"),
        ("plane_tilt", "q", dict(roll=0.1, pitch=0.0), "no model 'q'"),
        ("plane_tilt", "g", dict(roll=0.1), "needs `pitch`"),
    ],
)
def test_bad_effects_are_refused_by_name(tmp_path, kind, at, parameters, words):
    scene = with_effects(on_ground(tmp_path, "ball"), (kind, at, parameters))
    with pytest.raises(ValueError, match=words):
        load_scene(scene, DiagramBuilder())


def test_dissipation_is_refused_where_the_solver_has_none(tmp_path):
    scene = with_effects(
        on_ground(tmp_path, "ball"),
        ("contact_dissipation", PAIR, dict(dissipation=1.0)),
    )
    scene.plant.discrete_contact_approximation = "sap"
    with pytest.raises(ValueError, match="`sap` has no Hunt-Crossley"):
        load_scene(scene, DiagramBuilder())


def test_friction_of_an_object_with_rougher_feet_is_that_of_what_meets(tmp_path):
    """Feet meet the table, the box meets the tip: each pair gets its own value, and the
    other keeps its."""
    rng = np.random.default_rng(0)
    world = replace(push_world.a_world(rng), friction=0.4, tip_friction=0.15)
    table = {"time": np.arange(3.0)}
    scene = read_scene(push_world.write(tmp_path, world, table))
    pairs = {"table": "block.block~table.table", "tip": "block.block~tip.tip"}
    dynamics = SceneDynamics(scene)
    for name, mu in (("table", 0.4), ("tip", 0.15)):
        now = dynamics.now("contact_friction", [pairs[name]])
        assert now["friction"] == pytest.approx(mu)
    for name, new, other in (("table", 0.25, "tip"), ("tip", 0.9, "table")):
        effect = Effect("contact_friction", [pairs[name]], {"friction": new})
        changed = SceneDynamics(replace(scene, effects=[effect]))
        now = changed.now("contact_friction", [pairs[name]])
        assert now["friction"] == pytest.approx(new)
        kept = dynamics.now("contact_friction", [pairs[other]])
        assert changed.now("contact_friction", [pairs[other]]) == pytest.approx(kept)
    alike = Effect("contact_friction", [*pairs.values()], {"friction": 0.25})
    changed = SceneDynamics(replace(scene, effects=[alike]))
    for at in pairs.values():
        now = changed.now("contact_friction", [at])["friction"]
        assert now == pytest.approx(0.25)
