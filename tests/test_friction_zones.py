"""Friction zones: the force's law, a sliding block against closed forms, bad input."""

import numpy as np
import pytest
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects.kind import Effect
from makebreak.models.friction_zones import (
    FADE_SPEED,
    N_POINTS,
    FrictionZone,
    friction_at,
    zone_force,
)
from makebreak.models.scene import load_scene, read_scene
from makebreak.models.scene_file import write_scene

G = 9.81
BASE = 0.2  # Of sledge and ground, by Drake's rule: 2 m1 m2/(m1 + m2).
PAIR = "sledge~ground"

MATERIAL = """<drake:proximity_properties>
<drake:mu_static>0.2</drake:mu_static><drake:mu_dynamic>0.2</drake:mu_dynamic>
<drake:point_contact_stiffness>4e4</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>0.5</drake:hunt_crossley_dissipation>
</drake:proximity_properties>"""


def feet():
    """Four spheres of 3 mm, 40 mm from the middle, that reach 5 mm down."""
    return "".join(
        f"<collision name='{x}{y}'><pose>{x} {y} -0.002 0 0 0</pose><geometry><sphere>"
        f"<radius>0.003</radius></sphere></geometry>{MATERIAL}</collision>"
        for x in (-0.04, 0.04)
        for y in (-0.04, 0.04)
    )


def world(folder, zones, speed=0.5, effects=()):
    """A sledge of 1 kg on level ground, at x = 0, that slides off along x."""
    head = "<sdf version='1.9' xmlns:drake='drake.mit.edu'>"
    inertia = "<ixx>1e-3</ixx><iyy>1e-3</iyy><izz>1e-3</izz>"
    (folder / "sledge.sdf").write_text(
        f"{head}<model name='sledge'><link name='sledge'><inertial><mass>1</mass>"
        f"<inertia>{inertia}</inertia></inertial>{feet()}</link></model></sdf>"
    )
    (folder / "ground.sdf").write_text(
        f"{head}<model name='ground'><link name='ground'><collision name='ground'>"
        "<pose>0 0 -0.05 0 0 0</pose><geometry><box><size>4 4 0.1</size></box>"
        f"</geometry>{MATERIAL}</collision></link></model></sdf>"
    )
    (folder / "world.yaml").write_text(
        f"""
directives:
  - add_model: {{name: sledge, file: sledge.sdf}}
  - add_model: {{name: ground, file: ground.sdf}}
  - add_weld: {{parent: world, child: "ground::ground"}}
initial:
  poses: {{sledge.sledge: [1, 0, 0, 0, 0, 0, {0.005 - G / 8e4}]}}
  body_velocities: {{sledge.sledge: [0, 0, 0, {speed}, 0, 0]}}
"""
    )
    scene = read_scene(folder / "world.yaml")
    scene.friction_zones = zones
    scene.effects = list(effects)
    return scene


def slide(scene, seconds):
    """(n, 13) state of the sledge at every millisecond, and normal forces (n,)."""
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant = loaded.plant
    its = plant.GetMyMutableContextFromRoot(context)
    V = scene.initial.body_velocities["sledge.sledge"]
    plant.SetVelocities(its, np.array(V, dtype=float))
    rows, normal = [], []
    results = plant.get_contact_results_output_port()
    for k in range(round(1000 * seconds)):
        simulator.AdvanceTo(1e-3 * (k + 1))
        rows.append(plant.GetPositionsAndVelocities(its))
        contacts = results.Eval(its)
        normal.append(
            sum(
                abs(contacts.point_pair_contact_info(i).contact_force()[2])
                for i in range(contacts.num_point_pair_contacts())
            )
        )
    return np.array(rows), np.array(normal)


def speeds(scene, seconds):
    return slide(scene, seconds)[0][:, 10]


def test_in_a_zone_it_slows_down_as_by_its_friction_and_outside_as_by_its_own(tmp_path):
    zone = FrictionZone(PAIR, 0.5, x=[0.1, 5.0])
    states, normal = slide(world(tmp_path, [zone], speed=1.0), 0.35)
    x, v = states[:, 4], states[:, 10]
    before, after = x < 0.1 - 0.04 - 0.01, x > 0.1 + 0.04 + 0.01
    # It pitches as the friction changes, and settles in some 20 ms.
    for rows, mu in ((before, BASE), (after & (v > 0.05), 0.5)):
        slope = np.polyfit(1e-3 * np.flatnonzero(rows), v[rows], 1)[0]
        assert rows.sum() > 50
        np.testing.assert_allclose(slope, -mu * G, rtol=0.02)
    # Over the seam it is held up by its weight throughout, but for the pitching.
    over = (x > 0.05) & (x < 0.15)
    np.testing.assert_allclose(normal[over], G, rtol=0.06)


def test_without_more_friction_a_zone_changes_nothing_at_all(tmp_path):
    plain = slide(world(tmp_path, []), 0.2)[0]
    same = slide(world(tmp_path, [FrictionZone(PAIR, BASE)]), 0.2)[0]
    np.testing.assert_array_equal(plain, same)


def test_the_force_is_against_the_slip_at_each_point_and_fades_at_rest():
    points = np.zeros((N_POINTS, 7))
    points[0] = [0.1, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]
    points[1] = [-0.1, 0.0, 0.0, 0.0, 0.0, -1.0, 2.0]
    # Turning alone: a couple of 2 N at 0.1 m, both ways, and no force.
    F = zone_force(points.ravel(), np.zeros(3), np.zeros(3), np.array([0, 0, 3.0]))
    np.testing.assert_allclose(F, [0, 0, -0.4, 0, 0, 0], atol=1e-12)
    # Lifting has no slip; sliding has 4 N, the half of it at half the fading speed.
    for v, expected in (
        ([0.0, 0.0, 1.0], 0.0),
        ([0.3, 0.0, 0.5], -4.0),
        ([FADE_SPEED / 2.0, 0.0, 0.0], -2.0),
    ):
        F = zone_force(points.ravel(), np.zeros(3), np.array(v), np.zeros(3))
        np.testing.assert_allclose(F[3:], [expected, 0, 0], atol=1e-12)


def test_it_comes_to_rest_without_chatter(tmp_path):
    v = speeds(world(tmp_path, [FrictionZone(PAIR, 0.9)], speed=0.3), 0.3)
    assert (np.diff(v[v > 1e-3]) < 0.0).all()
    np.testing.assert_allclose(v[-50:], 0.0, atol=1e-4)


def test_the_first_zone_counts_and_edges_belong_to_the_next():
    zones = [[0, 1, 0, 1, 0.3], [1, 2, 0, 1, 0.4], [0, 2, 0, 2, 0.5]]
    at = [(0.5, 0.5), (1.0, 0.5), (1.5, 1.5), (2.0, 0.5)]
    assert [friction_at(zones, p) for p in at] == [0.3, 0.4, 0.5, 0.0]


def test_forces_of_effects_are_passed_on(tmp_path):
    drag = Effect("body_drag", ["sledge"], {"linear": 2.0, "angular": 0.0})
    both = world(tmp_path, [FrictionZone(PAIR, 0.5)], 1.0, [drag])
    builder = DiagramBuilder()
    load_scene(both, builder)
    diagram = builder.Build()
    port = diagram.GetSubsystemByName("friction_zones").GetOutputPort("spatial_forces")
    context = diagram.CreateDefaultContext()
    forces = port.Eval(
        diagram.GetSubsystemByName("friction_zones").GetMyContextFromRoot(context)
    )
    assert len(forces) == 2
    assert all(isinstance(f, ExternallyAppliedSpatialForce) for f in forces)
    # m dv/dt = -mu m g - c v, over 0.1 s; without the drag 0.51.
    v = speeds(both, 0.1)[-1]
    expected = (1.0 + 0.5 * G / 2.0) * np.exp(-0.2) - 0.5 * G / 2.0
    np.testing.assert_allclose(v, expected, rtol=0.03)  # It pitches at first.


def test_a_file_keeps_the_zones(tmp_path):
    zones = [FrictionZone(PAIR, 0.5, x=[0.1, 5.0])]
    write_scene(world(tmp_path, zones), tmp_path / "again.yaml")
    assert read_scene(tmp_path / "again.yaml").friction_zones == zones


@pytest.mark.parametrize(
    "zones, message",
    [
        ([FrictionZone(PAIR, np.nan)], r"friction: got \"\.nan\""),
        ([FrictionZone(PAIR, -0.1)], "friction is -0.1"),
        ([FrictionZone(PAIR, 0.1)], "less than the pair's own friction, 0.2"),
        ([FrictionZone(PAIR, 0.5, x=[1.0, 0.0])], r"x is \[1.0, 0.0\]"),
        ([FrictionZone(PAIR, 0.5, y=[1.0])], r"y is \[1.0\]"),
        ([FrictionZone(PAIR, 0.5), FrictionZone("a~b", 0.5)], "expected one pair"),
        ([FrictionZone("sledge~grund", 0.5)], "grund"),
    ],
)
def test_zones_that_cannot_be_are_refused(tmp_path, zones, message):
    with pytest.raises(ValueError, match=message):
        load_scene(world(tmp_path, zones), DiagramBuilder())
