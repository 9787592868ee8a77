"""Free bodies that touch: the fast steps against Drake's, and effects on them."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.numerics.free_body import simulate_all
from makebreak.gap.residuals import objects
from makebreak.gap.residuals.objects import FlightProblem
from makebreak.gap.simulation.free_bodies import FreeBodiesScene
from makebreak.gap.simulation.free_windows import FreeBodyModel
from makebreak.gap.simulation.scene_simulation import SceneSimulation, SimulationConfig
from makebreak.gap.simulation.unseen_spin import rolling
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import InitialSection, load_scene, read_scene

RED, BLUE = "red.ball", "blue.ball"
RADII, MASSES = {"red": 0.03, "blue": 0.035}, {"red": 0.2, "blue": 0.13}


def write_balls(folder: Path, time_step: float = 0.0) -> Path:
    """Two balls of unlike surfaces, and a table."""

    def surface(mu: float, k: float, d: float) -> str:
        return (
            '<drake:proximity_properties xmlns:drake="drake.mit.edu">'
            f"<drake:mu_static>{mu}</drake:mu_static>"
            f"<drake:mu_dynamic>{mu}</drake:mu_dynamic>"
            f"<drake:point_contact_stiffness>{k}</drake:point_contact_stiffness>"
            f"<drake:hunt_crossley_dissipation>{d}</drake:hunt_crossley_dissipation>"
            "</drake:proximity_properties>"
        )

    def model(name: str, link: str, inside: str) -> None:
        (folder / f"{name}.sdf").write_text(
            f'<sdf version="1.9"><model name="{name}"><link name="{link}">{inside}'
            "</link></model></sdf>"
        )

    for name, law in (("red", (0.2, 1.2e5, 0.6)), ("blue", (0.3, 0.9e5, 0.4))):
        m, r = MASSES[name], RADII[name]
        moments = "".join(f"<i{a}{a}>{0.4 * m * r**2}</i{a}{a}>" for a in "xyz")
        model(
            name, "ball",
            f"<inertial><mass>{m}</mass><inertia>{moments}</inertia></inertial>"
            f'<collision name="c"><geometry><sphere><radius>{r}</radius></sphere>'
            f"</geometry>{surface(*law)}</collision>",
        )  # fmt: skip
    model(
        "table", "table",
        '<collision name="c"><pose>0 0 -0.1 0 0 0</pose><geometry><box><size>4 4 0.2'
        f"</size></box></geometry>{surface(0.5, 6e4, 1.2)}</collision>",
    )  # fmt: skip
    scene = {
        "directives": [
            {"add_model": {"name": "table", "file": "table.sdf"}},
            {"add_weld": {"parent": "world", "child": "table::table"}},
            {"add_model": {"name": "red", "file": "red.sdf"}},
            {"add_model": {"name": "blue", "file": "blue.sdf"}},
        ],
        "plant": {"time_step": time_step},
    }
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(scene))
    return file


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return read_scene(write_balls(tmp_path_factory.mktemp("balls")))


def pair(kind: str, at: str, value: float) -> Effect:
    return Effect(kind, [at], {kind.removeprefix("contact_"): value})


@pytest.mark.parametrize(
    "effect",
    [
        *(
            pair("contact_friction", at, mu)
            for at in (f"{RED}~table.table", f"{BLUE}~table.table", f"{RED}~{BLUE}")
            for mu in (0.15, 1.2)
        ),
        pair("contact_stiffness", f"{RED}~table.table", 5e3),
        pair("contact_stiffness", f"{RED}~{BLUE}", 2e4),
        pair("contact_dissipation", f"{BLUE}~table.table", 2.0),
        pair("contact_dissipation", f"{RED}~{BLUE}", 0.05),
        pair("contact_dissipation", f"{RED}~{BLUE}", 3.0),
        pair("contact_damping", f"{BLUE}~table.table", 3.0),
        pair("contact_damping", f"{RED}~{BLUE}", 3.0),
        Effect("rolling_resistance", [f"{BLUE}~table.table"], {"coefficient": 0.01}),
        Effect("object_mass", ["blue"], {"mass": 0.5}),
        Effect("object_size", [RED], {"radius": 0.028}),
        Effect("plane_height", ["table"], {"height": 0.004}),
        Effect("plane_tilt", ["table.table"], {"roll": 0.02, "pitch": -0.03}),
        Effect("body_drag", [BLUE], {"linear": 0.4, "angular": 1e-4}),
        Effect("constant_force", [RED], {"fx": 0.1, "fy": -0.2, "fz": 0.3}),
        # Another body than the first one, so that the kind of change is not used.
        Effect("gravity_tilt", ["world"], {"roll": 0.02, "pitch": 0.01}),
    ],
    ids=lambda e: f"{e.kind} {e.at[0]}",
)  # fmt: skip
def test_an_effect_changes_all_bodies_as_it_changes_the_plant(scene, effect):
    fast = FreeBodiesScene(scene).bodies([effect])
    built = FreeBodiesScene(replace(scene, effects=[effect])).bodies()
    # Sums of a few terms, in other orders; SDF is written with 17 digits.
    np.testing.assert_allclose(fast.mutual, built.mutual, rtol=1e-9, atol=1e-12)
    for one, other in zip(fast.each, built.each, strict=True):
        for name, value in vars(other).items():
            got = getattr(one, name)
            if name == "smooth":
                got, value = len(got.of), len(value.of)
            np.testing.assert_allclose(got, value, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    "effects", [[], [pair("contact_damping", f"{RED}~{BLUE}", 8.0)]]
)
def test_two_balls_collide_as_in_drakes_continuous_plant(scene, effects):
    """Obliquely, while both touch the table, one of them slides and both spin."""
    scene = replace(scene, effects=effects)
    names = "qw qx qy qz x y z wx wy wz vx vy vz".split()
    start = np.array(
        [[1.0, 0, 0, 0, 0.0, 0.0, 0.03, 1.0, 20.0, 3.0, 1.0, 0.0, 0.0],
         [1.0, 0, 0, 0, 0.08, 0.02, 0.035, -2.0, -3.0, 1.0, -0.1, 0.05, 0.0]]
    )  # fmt: skip
    initial = InitialSection(
        poses={RED: list(start[0, :7]), BLUE: list(start[1, :7])},
        body_velocities={RED: list(start[0, 7:]), BLUE: list(start[1, 7:])},
    )
    times = np.linspace(0.0, 0.2, 21)
    drake = SceneSimulation(scene, SimulationConfig(accuracy=1e-7, least_step_sec=1e-9))
    channels = [f"{body}.{n}" for body in (RED, BLUE) for n in names]
    want = drake.run(initial, times, channels).reshape(-1, 2, 13)
    assert not drake.failure
    numbers = FreeBodiesScene(scene)
    assert numbers.names == [RED, BLUE]
    got = simulate_all(numbers.bodies(), start, times, tol=1e-8)
    assert np.ptp(want[:, 1, 10]) > 0.5  # It was hit [m/s].
    # A tenth of a millimetre, of 0.2 m; heights swing at 100 Hz, and out of step by 0.1
    # ms they differ by 3 mm/s.
    np.testing.assert_allclose(got[:, :, 4:7], want[:, :, 4:7], atol=1e-4)
    np.testing.assert_allclose(got[:, :, 10:], want[:, :, 10:], atol=3e-3)
    np.testing.assert_allclose(got[:, :, 7:10], want[:, :, 7:10], atol=0.1)


@pytest.mark.parametrize("time_step", [0.0, 1e-3])
def test_a_contact_point_lies_between_two_surfaces_where_drake_has_it(
    tmp_path, time_step
):
    """Midway with a continuous plant; with a discrete one nearer to the harder one."""
    scene = read_scene(write_balls(tmp_path, time_step))
    depth, along = 1e-3, np.array([0.6, 0.0, 0.8])
    places = {RED: np.array([0.0, 0.0, RADII["red"] - depth])}
    places[BLUE] = places[RED] + (sum(RADII.values()) - depth) * along
    builder = DiagramBuilder()
    plant = load_scene(scene, builder).plant
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = plant.GetMyContextFromRoot(context)
    for name, place in places.items():
        body = plant.GetBodyByName("ball", plant.GetModelInstanceByName(name[:-5]))
        plant.SetFreeBodyPose(own, body, RigidTransform(place))
    contacts = plant.get_contact_results_output_port().Eval(own)
    points = [
        contacts.point_pair_contact_info(i).contact_point()
        for i in range(contacts.num_point_pair_contacts())
    ]
    on_table, of_balls = sorted(points, key=lambda p: p[2])
    bodies = FreeBodiesScene(scene).bodies()
    share = bodies.each[0].pairs[0, 0, 4]
    assert on_table[2] == pytest.approx(-share * depth, rel=1e-6)
    out = float((of_balls - places[RED]) @ along)
    share = bodies.mutual[0, 1, 4]
    assert out == pytest.approx(RADII["red"] - (1.0 - share) * depth, rel=1e-6)


def test_bodies_that_a_scene_lets_pass_through_each_other_do_not_touch(tmp_path):
    file = write_balls(tmp_path)
    text = yaml.safe_load(file.read_text())
    group = {
        "name": "balls", "members": ["red::ball", "blue::ball"],
        "ignored_collision_filter_groups": ["balls"],
    }  # fmt: skip
    text["directives"].append({"add_collision_filter_group": group})
    file.write_text(yaml.safe_dump(text))
    numbers = FreeBodiesScene(read_scene(file))
    assert not numbers.meet(RED, BLUE)
    assert not numbers.bodies().mutual.any()
    assert all(body.pairs[:, :, 0].all() for body in numbers.bodies().each)


def test_a_warning_names_what_its_own_body_lies_on(scene, monkeypatch):
    dynamics = SceneDynamics(scene)
    model = SimpleNamespace(
        with_faces=[RED], bodies=[RED, BLUE], on_side=[], dynamics=dynamics,
        recordings=[SimpleNamespace(name="log")],
    )  # fmt: skip
    monkeypatch.setattr(objects, "touched", lambda model, at: np.zeros((1, 2)))
    (finding,) = objects.point_on_face_of(model)  # type: ignore[arg-type]
    assert f"gives {RED} on table.table a single" in finding.says


def slide(mu: float, resistance: float, v: float, w: float, times, radius: float):
    """x, v and slip of a ball that slides, then rolls on against a resistance; closed
    form of a solid sphere: m dv/dt = -mu m g, and dw/dt = 5/2 mu g/r."""
    g, slip = 9.81, v - w * radius
    end = abs(slip) / (3.5 * mu * g)
    t = np.minimum(times, end)
    a = -np.sign(slip) * mu * g
    after = np.maximum(times - end, 0.0)
    vx = v + a * t - resistance * g / 1.4 * after
    x = v * t + 0.5 * a * t**2 + (v + a * end) * after
    x = x - 0.5 * resistance * g / 1.4 * after**2
    return x, vx, slip + 3.5 * a * t


@pytest.mark.parametrize("mu", [0.1, 0.29])
@pytest.mark.parametrize("resistance", [0.0, 0.012])
def test_an_unseen_spin_follows_from_how_a_ball_goes_on_to_roll(scene, mu, resistance):
    """Whatever friction there is: the scene's is 0.29. With a resistance to rolling it
    may end where the ball slows down less, and no sooner."""
    body = FreeBodiesScene(scene).bodies().each[0]
    times = np.arange(0.0, 0.6, 1.0 / 120.0)
    x, v, slip = slide(mu, resistance, 0.8, 5.0, times, RADII["red"])
    place = np.zeros((len(times), 3, 3))
    place[:, 0] = np.stack([x, v, np.gradient(v, times)], axis=1)
    place[:, 2, 0] = RADII["red"]
    found = rolling(body, times, place, np.full((len(times), 2, 3), 1e-3))
    for k in (0, 4):
        spin = found[k].spin(body, place[k, :, 1], np.array([0.0, 0.0, 1.0]))
        want = (v[k] - slip[k]) / RADII["red"]
        np.testing.assert_allclose(spin, [0.0, want, 0.0], atol=0.03 * want)
    late = found[-1].spin(body, place[-1, :, 1], np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(late, [0.0, v[-1] / RADII["red"], 0.0], rtol=1e-9)


def test_a_ball_that_slides_to_the_end_is_seen_to_by_its_mean_acceleration(scene):
    """Of a stretch of 0.2 s a camera knows no single acceleration to 1 m/s2. How far it
    is from rolling is then not known, but which way it slips."""
    body = FreeBodiesScene(scene).bodies().each[0]
    times = np.arange(0.0, 0.2, 1.0 / 120.0)
    x, v, slip = slide(0.14, 0.0, 1.2, 0.0, times, RADII["red"])
    assert slip[-1] > 0.2
    place = np.zeros((len(times), 3, 3))
    place[:, 0] = np.stack([x, v, np.gradient(v, times)], axis=1)
    place[:, 2, 0] = RADII["red"]
    std = np.stack([np.full((len(x), 3), 4e-3), np.full((len(x), 3), 0.6)], axis=1)
    for k in (0, 8):
        each = rolling(body, times, place, std)[k]
        assert each.more is not None
        np.testing.assert_allclose(each.more, [v[k], 0.0, 0.0])
        spin = each.spin(body, place[k, :, 1], np.array([0.0, 0.0, 1.0]))
        assert spin[1] < v[k] / RADII["red"] - 10.0


def write_collisions(
    folder: Path, scene, effects, episodes: int = 6, columns: str = "x y z"
) -> Path:
    """Drake's balls as a camera sees them, that sees no spin: 120 Hz, 0.3 mm."""
    rng, rows = np.random.default_rng(0), []
    drake = SceneSimulation(replace(scene, effects=effects))
    channels = [f"{body}.{a}" for body in (RED, BLUE) for a in columns.split()]
    times = np.arange(0.0, 0.9, 1.0 / 120.0)
    for episode in range(episodes):
        red = [rng.uniform(0.6, 1.2), 0.0, 0.0]
        blue = [-0.2 * rng.random(), 0.0, 0.0]
        initial = InitialSection(
            poses={RED: [1, 0, 0, 0, 0, 0, 0.03],
                   BLUE: [1, 0, 0, 0, 0.25, 0.01 * rng.normal(), 0.035]},
            body_velocities={RED: [0, rng.random() * red[0] / 0.03, 0, *red],
                             BLUE: [0, blue[0] / 0.035, 0, *blue]},
        )  # fmt: skip
        y = drake.run(initial, times, channels)
        y = y + 3e-4 * rng.normal(size=y.shape)
        stamp = times + 2.0 * episode
        rows.append(np.column_stack([np.full(len(times), episode), stamp, y]))
    file = folder / "log.csv"
    header, table = ",".join(["episode", "time", *channels]), np.concatenate(rows)
    np.savetxt(file, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return file


def left(model: FreeBodyModel, effects=()) -> float:
    return float(np.sqrt(np.mean(model.residual(effects) ** 2)))


def test_collisions_of_balls_leave_no_more_than_noise_with_the_friction_they_had(
    scene, tmp_path, monkeypatch
):
    """With less friction than the scene has they slide for longer after a collision,
    with a spin that nobody measured."""
    true = pair("contact_friction", f"{RED}~table.table", 0.12)
    log = write_collisions(tmp_path, scene, [true])
    recordings, _ = condition(read_recordings([log]), False)
    model = FlightProblem(scene, recordings)
    # Shapes of other stiffness have none that the scene's tolerance could be of.
    monkeypatch.setitem(scene.tolerance, "contact_stiffness", 0.1)
    with monkeypatch.context() as patch:
        patch.setattr(model.dynamics, "now", Mock(side_effect=ValueError("differ")))
        assert model.nuisances().names == ()
    assert model.nuisances().names != ()
    monkeypatch.delitem(scene.tolerance, "contact_stiffness")
    assert sum(w.after_hits > 0 for w in model.windows) >= 5
    assert left(model) > 3.0
    assert left(model, [true]) < 1.3


@pytest.mark.parametrize("columns", ["x y z", "x y z qw qx qy qz"])
def test_only_where_an_orientation_is_not_measured_a_ball_is_taken_to_roll(
    scene, tmp_path, columns
):
    log = write_collisions(tmp_path, scene, [], 1, columns)
    recordings, _ = condition(read_recordings([log]), False)
    model = FreeBodyModel(scene, recordings)
    rolls = [each is not None for w in model.windows for each in w.rolling]
    assert rolls == [columns == "x y z"] * (2 * len(model.windows))


def test_bodies_with_faces_that_come_near_each_other_are_left_to_drake(tmp_path):
    """The spheres that stand in for faces would miss each other."""
    scene = read_scene(write_balls(tmp_path))
    log = write_collisions(tmp_path, scene, [], 1, "x y z qw qx qy qz")
    recordings, _ = condition(read_recordings([log]), False)
    blue = tmp_path / "blue.sdf"
    sphere = "<sphere><radius>0.035</radius></sphere>"
    text = blue.read_text()
    assert sphere in text
    blue.write_text(text.replace(sphere, "<box><size>0.07 0.07 0.07</size></box>"))
    with pytest.raises(DoesNotFit, match="near each other"):
        FreeBodyModel(read_scene(tmp_path / "scene.yaml"), recordings)
