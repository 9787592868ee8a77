"""A robot that presses on what is fixed: a gantry with a ball for a tool, by an ODE."""

from dataclasses import replace
from itertools import product

import numba
import numpy as np
import pytest
from push_problems import screen_of
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap import workflow
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.fit import fit_effects
from makebreak.gap.residuals import contact_dynamics
from makebreak.gap.residuals.lying_on_faces import point_on_face
from makebreak.gap.residuals.pressing import PressingProblem, presses, thinned
from makebreak.gap.residuals.touching import MEETS
from makebreak.gap.search.choice import Choice
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.rivals import still_tied
from makebreak.gap.search.select import select
from makebreak.gap.simulation.contact_windows import LAW, PushWindows
from makebreak.gap.workflow import (
    conclude,
    judged_channels,
    nothing_compared,
    problem_for,
    unjudged_channels,
)
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene

GRAVITY = np.array([0.0, 0.0, 9.81])
MASS, RADIUS, STIFFNESS, DAMPING, TABLE_MU, WALL_MU = 2.0, 0.02, 2e4, 200.0, 0.3, 0.2
LINK = """<link name="{name}"><inertial><mass>{mass}</mass><inertia><ixx>1e-3</ixx>
<iyy>1e-3</iyy><izz>1e-3</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>
{shape}</link>"""
JOINT = """<joint name="{name}" type="prismatic"><parent>{parent}</parent>
<child>{child}</child><axis><xyz>{axis}</xyz></axis></joint>"""
SHAPE = """<collision name="c"><pose>{at}</pose><geometry>{what}</geometry>
<drake:proximity_properties><drake:mu_dynamic>{mu}</drake:mu_dynamic>
<drake:mu_static>{mu}</drake:mu_static><drake:point_contact_stiffness>4e4
</drake:point_contact_stiffness></drake:proximity_properties></collision>"""
MODEL = """<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="{name}">{body}</model></sdf>
"""
SCENE = """directives:
  - add_model: {name: gantry, file: gantry.sdf}
  - add_weld: {parent: world, child: gantry::base}
  - add_model: {name: table, file: table.sdf}
  - add_weld: {parent: world, child: table::table}
  - add_model: {name: wall, file: wall.sdf}
  - add_weld: {parent: world, child: wall::wall, X_PC: {translation: [0.3, 0, 0]}}
plant: {time_step: 0.001}
actuation:
  type: effort
  joints: [gantry.x, gantry.y, gantry.z]
  hold: zero_order
  rate_hz: 1000
tolerance: {link_mass: 0.001, link_com_m: 0.0001}
"""
TABLE, WALL = "table.table", "wall.wall"
BALL = f"<sphere><radius>{RADIUS}</radius></sphere>"
BLOCK = f"<box><size>{2 * RADIUS} {2 * RADIUS} {2 * RADIUS}</size></box>"
MIDDLE = ((0.0, 0.0, 0.0),)
CORNERS = tuple(product((-RADIUS, RADIUS), repeat=3))


def write_scene(folder, wall_size=(0.1, 1.0, 0.2), tool=BALL, stiffness="4e4"):
    light = LINK.format(name="{}", mass=1e-6, shape="")
    ball = SHAPE.format(at="0 0 0 0 0 0", what=tool, mu=1.0)
    body = '<link name="base"/>' + light.replace("{}", "a") + light.replace("{}", "b")
    body += LINK.format(name="tool", mass=MASS, shape=ball)
    for name, parent, child, axis in (
        ("x", "base", "a", "1 0 0"),
        ("y", "a", "b", "0 1 0"),
        ("z", "b", "tool", "0 0 1"),
    ):
        body += JOINT.format(name=name, parent=parent, child=child, axis=axis)
    body += '<frame name="tip" attached_to="tool"/>'
    (folder / "gantry.sdf").write_text(MODEL.format(name="gantry", body=body))
    x, y, z = wall_size
    for name, at, size, mu in (
        ("table", "0 0 -0.05 0 0 0", "2 2 0.1", TABLE_MU),
        ("wall", f"{x / 2} 0 {z / 2} 0 0 0", f"{x} {y} {z}", WALL_MU),
    ):
        shape = SHAPE.format(
            at=at, what=f"<box><size>{size}</size></box>", mu=mu / (2 - mu)
        )
        link = f'<link name="{name}">{shape}</link>'
        (folder / f"{name}.sdf").write_text(MODEL.format(name=name, body=link))
    for file in folder.glob("*.sdf"):
        file.write_text(file.read_text().replace(">4e4\n", f">{stiffness}\n"))
    (folder / "scene.yaml").write_text(SCENE)
    return read_scene(folder / "scene.yaml")


@numba.njit(cache=True)
def contact(p, v, table, wall, mu, longer, points, spring):
    """Force of table and wall on the tool by springs, moment about its centre (6,);
    mu (2,) their friction; longer: what touches is so much farther off the centre;
    points (n, 3): corners of a block, or the middle of a ball; spring: stiffness and
    damping of a touch."""
    total = np.zeros(6)
    radius = RADIUS if len(points) == 1 else 0.0
    for axis, sign, place, friction in ((2, 1.0, table, mu[0]), (0, -1.0, wall, mu[1])):
        way = -friction * v / max(np.hypot(v[axis - 2], v[axis - 1]), 1e-3)
        way[axis] = sign
        for point in points:
            depth = radius - sign * (p[axis] + point[axis] - place)
            f = spring[0] * depth - spring[1] * sign * v[axis]
            if depth > 0.0 and f > 0.0:
                arm = point.copy()
                arm[axis] -= sign * (radius - 0.5 * depth)
                arm[1] += longer
                total[:3] += f * way
                total[3:] += f * np.cross(arm, way)
    return total


@numba.njit(cache=True)
def moved(state, u, mass, table, wall, mu, points, spring):
    """The state (6,) a millisecond later, by two steps of the classical Runge-Kutta
    rule."""
    h, zero, k = 5e-4, np.zeros(6), np.zeros((4, 6))
    for _ in range(2):
        for i, share in enumerate((0.0, 0.5, 0.5, 1.0)):
            y = state + h * share * (k[i - 1] if i else zero)
            a = u + contact(y[:3], y[3:], table, wall, mu, 0.0, points, spring)[:3]
            k[i, :3], k[i, 3:] = y[3:], a / mass - GRAVITY
        state = state + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
    return state


def record(
    folder, table=0.0, wall=0.3, mu=(TABLE_MU, WALL_MU), wrench=True, n=1, longer=0.0,
    effort="effort_command", mass=MASS, high=0.0, waits=0.0, force=8.0,
    points=MIDDLE, leaves=np.inf, swells=0.0, spring=(STIFFNESS, DAMPING),
):  # fmt: skip
    """After a while down on the table, along it to the wall, along both, pressed with a
    force, which swells by a share; high: from so much higher, which with no force stays
    above the table; leaves: when it goes up along the wall for half a second, and then
    away from it [s]."""
    rng = np.random.default_rng(0)
    names = ("x", "y", "z")
    tables = []
    table, wall, mass, longer = float(table), float(wall), float(mass), float(longer)
    mu, points = np.array(mu), np.array(points)
    for episode in range(n):
        time = np.arange(0.0, 5.0 + waits, 1e-3)
        state = np.array([0.1, -0.2, 0.12 + high, 0.0, 0.0, 0.0])
        states, efforts, forces = [], [], []
        for t in time - waits:
            p, v = state[:3], state[3:]
            target = np.array([
                0.25 if 1.5 < t < 3.0 else 0.0,
                0.02 if t < 3.0 else 0.2 * (1.0 if (t + episode) % 2.0 < 1.0 else -1.0),
                -0.15 if 0.0 < t < 1.2 else 0.0,
            ])  # fmt: skip
            push = force * (1.0 + swells * np.sin(4.0 * t))
            pressed = [push * (t > 3.0), 0.0, -push * (t > 1.2)]
            if t > leaves:
                is_up = t > leaves + 0.5
                target = np.array([-0.1 * is_up, 0.0, 0.3 * (not is_up)])
                pressed = [force * (not is_up), 0.0, 0.0]
            u = mass * 25.0 * (target - v)
            u = np.clip(u, -12.0, 12.0) + pressed + np.array([0.0, 0.0, mass * 9.81])
            states.append(state)
            efforts.append(u)
            forces.append(contact(p, v, table, wall, mu, longer, points, spring))
            state = moved(state, u, mass, table, wall, mu, points, spring)
        rows = slice(0, None, 5)
        x, u, F = (np.array(each) for each in (states, efforts, forces))
        mean = u.reshape(-1, 5, 3).mean(axis=1)
        columns = {"time": time[rows], "episode": np.full(len(mean), episode)}
        for i, axis in enumerate(names):
            noise = rng.normal(size=(3, len(mean)))
            columns[f"gantry.{axis}.position"] = x[rows, i] + 1e-5 * noise[0]
            columns[f"gantry.{axis}.{effort}"] = mean[:, i]
            if wrench:
                columns[f"gantry.tip.f{axis}"] = F[rows, i] + 0.1 * noise[1]
                columns[f"gantry.tip.t{axis}"] = F[rows, 3 + i] + 0.005 * noise[2]
        tables.append(columns)
    table_of = {k: np.concatenate([t[k] for t in tables]) for k in tables[0]}
    write_recording(folder / "recording.csv", table_of)
    return read_recordings([folder / "recording.csv"])


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """World and model are alike."""
    folder = tmp_path_factory.mktemp("right")
    scene, recordings = write_scene(folder), record(folder)
    return scene, recordings, PressingProblem(scene, recordings)


def test_a_robot_that_touches_itself_presses_on_nothing_by_that(right, monkeypatch):
    """Of a pair of its own links no body is fixed."""
    problem = right[2]
    assert problem._touched_axes()
    known = problem._slots(()), problem._pressing(), problem._geometry([])
    for name, value in zip(("_slots", "_pressing", "_geometry"), known, strict=True):
        monkeypatch.setattr(problem, name, lambda *_, value=value: value)
    monkeypatch.setattr(problem.shapes, "anchored", set())
    assert problem._soft_bodies() == set() and problem._touched_axes() == {}


@pytest.fixture(scope="module")
def displaced(tmp_path_factory):
    folder = tmp_path_factory.mktemp("displaced")
    scene = write_scene(folder)
    recordings = record(folder, table=-0.012, wall=0.325, mu=(0.42, 0.35))
    return PressingProblem(scene, recordings)


def test_where_nothing_is_hidden_nothing_is_left_and_nothing_named(right):
    scene, recordings, problem = right
    dynamics = SceneDynamics(scene)
    assert presses(dynamics, recordings)
    found, _ = problem_for(scene, recordings, dynamics)
    assert isinstance(found, PressingProblem)
    assert problem.off == {}
    assert problem.noise_error(problem.base()) < 1.5  # What `no_gap` allows.
    found = select(problem)
    assert found.choices == ()
    assert problem.loudest(found.start)[1] < problem.plan.loud
    # Nothing that was measured is left out.
    assert unjudged_channels(judged_channels(problem)) == ""


@pytest.mark.slow
def test_a_moment_is_what_the_force_has_where_shapes_touch(tmp_path):
    """A tool whose contact is 6 mm off has the same forces, and other moments."""
    scene = write_scene(tmp_path)
    problem = PressingProblem(scene, record(tmp_path, longer=0.006))
    start = select(problem).start
    # The table's force is 8 N: 48 mN m about x, and of the wall's as much about z.
    assert problem.loudest(start)[0] in ("gantry.tip.tx", "gantry.tip.tz")
    assert problem.loudest(start)[1] > problem.plan.loud


def test_bodies_that_stand_elsewhere_are_felt_there(displaced):
    """Nearest places, before any fit; friction and springs leave a millimetre."""
    off = {displaced.shapes.names[k]: by for k, by in displaced.off.items()}
    assert off[TABLE]["z"] == pytest.approx(-0.012, abs=1e-3)
    assert off[WALL]["x"] == pytest.approx(0.025, abs=1e-3)


@pytest.mark.slow
def test_places_that_were_felt_explain_recordings_that_nobody_looked_at(
    displaced, tmp_path
):
    there = dict(table=-0.012, wall=0.325, mu=(0.42, 0.35))
    unseen = record(tmp_path, **there, force=11.0, n=2)  # Pressed harder.
    selection = select(displaced)
    assert {c.effect.kind for c in selection.choices} >= {"plane_height"}
    found = displaced.unseen(unseen, selection.start, selection.end)
    assert found is not None
    (before, after), units = found
    assert before > 10.0 * after and after < 1.5
    assert units["gantry.x equation"].unit == "N"


def test_what_stands_on_something_is_displaced_with_it(displaced):
    """The wall stands on the table, nothing stands on the wall."""
    number = {name: k for k, name in displaced.shapes.names.items()}
    assert displaced._carried[number[TABLE]] == {number[WALL]}
    assert displaced._carried[number[WALL]] == set()
    plain = displaced._plain_candidates(displaced.base(), ())
    [height] = [c for c in plain if c.kind == "plane_height"]
    assert height.at == (TABLE, WALL)
    lower = Effect("plane_height", list(height.at), {"height": -0.012})
    before, after = (displaced._slots(effects)[0] for effects in ((), [lower]))
    wall = {s.key: s for s in before if number[WALL] in (s.a, s.b)}
    moved = [s for s in after if s.key in wall and s.b == number[WALL]]
    assert moved
    # Its upper edge is lower, too: distances from above are so much larger.
    above = [(s, wall[s.key].normal[:, 2] > 0.99) for s in moved]
    for s, rows in above:
        np.testing.assert_allclose(
            s.phi[rows] - wall[s.key].phi[rows], 0.012, atol=1e-9
        )


def test_the_lower_edge_of_what_stands_on_a_table_pushes_nothing_down_into_it(right):
    """With the table 25 mm too high the middle of the ball is below the wall."""
    problem = right[2]
    higher = Effect("plane_height", [TABLE, WALL], {"height": 0.025})
    number = {name: k for k, name in problem.shapes.names.items()}
    slots, _ = problem._slots([higher])
    pressing = 0
    for s in slots:
        if s.b == number[WALL]:
            on = s.phi < MEETS
            np.testing.assert_allclose(
                s.normal[on], np.tile([-1.0, 0.0, 0.0], (on.sum(), 1))
            )
            pressing += on.sum()
    assert pressing > 100


def test_what_stands_on_another_body_with_a_part_of_its_bottom_ends_there(tmp_path):
    scene = write_scene(tmp_path)
    over = SCENE.replace("[0.3, 0, 0]", "[0.95, 0, 0]")
    (tmp_path / "over.yaml").write_text(over)
    recordings = record(tmp_path)
    half = []
    for each in (scene, read_scene(tmp_path / "over.yaml")):
        problem = PressingProblem(each, recordings)
        number = {name: k for k, name in problem.shapes.names.items()}
        assert problem._carried[number[TABLE]] == {number[WALL]}
        [wall] = [s for s in problem.shapes.surfaces if s.body == number[WALL]]
        half.append(wall.size[0])
    np.testing.assert_allclose(half[0], [0.05, 0.5, 0.1 + 0.1 / 2])  # The table's.
    np.testing.assert_allclose(half[1], [0.05, 0.5, 0.1])


def test_a_wall_is_felt_though_the_tool_is_below_it_as_the_scene_has_it(tmp_path):
    """A ball of 40 mm on a table that is 45 mm lower is below the wall, which stands on
    the table: 22 mm off, it is found all the same."""
    scene = write_scene(tmp_path)
    problem = PressingProblem(scene, record(tmp_path, table=-0.045, wall=0.322))
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[TABLE]["z"] == pytest.approx(-0.045, abs=1e-3)
    assert off[WALL]["x"] == pytest.approx(0.022, abs=1e-3)


def test_no_test_function_is_lost_to_a_face_that_is_ruled_out_by_what_is_felt(
    tmp_path, monkeypatch
):
    """A ball goes up along a low wall: it comes past the wall's upper edge as it would
    be on the table of the scene, but the table is 30 mm lower."""
    scene = write_scene(tmp_path, wall_size=(0.1, 1.0, 0.055))
    recordings = record(tmp_path, table=-0.03, wall=0.275, leaves=2.42)
    problem = PressingProblem(scene, recordings)
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[TABLE]["z"] == pytest.approx(-0.03, abs=1e-3)
    assert off[WALL]["x"] == pytest.approx(-0.025, abs=1e-3)
    assert problem.faces == []  # None may be felt beside these two.
    monkeypatch.setattr(PressingProblem, "_rule_out_faces", lambda self: None)
    fewer = PressingProblem(scene, recordings)
    assert set(fewer.means.time) < set(problem.means.time)


@pytest.mark.parametrize(
    "size, table, wall",
    [((0.06, 1.0, 0.2), 0.0, 0.36),
     pytest.param((0.1, 1.0, 0.03), 0.0, 0.34, marks=pytest.mark.slow),
     ((0.1, 1.0, 0.03), 0.012, 0.325)],
    ids=["beyond its middle", "near its top", "whose top stands in for the table"],
)  # fmt: skip
def test_a_wall_in_which_the_tool_is_deep_was_passed_on_the_side_that_it_presses_on(
    tmp_path, size, table, wall
):
    """The nearest face is another one: the far one where the tool is beyond the middle,
    the upper one where the wall is low."""
    scene = write_scene(tmp_path, size)
    problem = PressingProblem(scene, record(tmp_path, table=table, wall=wall))
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[WALL] == {"x": pytest.approx(wall - 0.3, abs=1e-3)}
    assert off.get(TABLE, {"z": 0.0})["z"] == pytest.approx(table, abs=1e-3)


def test_efforts_that_press_are_not_taken_for_a_columns_error(tmp_path, monkeypatch):
    """What presses down takes from what holds the weight: as if of the other sign."""
    write_scene(tmp_path)
    record(tmp_path, mu=(0.42, 0.35))
    monkeypatch.setattr(workflow, "_compared", lambda *args: nothing_compared(args[4]))
    result = workflow.run_gap(tmp_path / "scene.yaml", [tmp_path / "recording.csv"])
    (sign,) = [c for c in result.checks if c.kind == "effort_sign"]
    assert sign.severity == "warning"


def test_places_and_frictions_are_named(displaced):
    found = {(c.effect.kind, *c.effect.at): c.effect.parameters
             for c in select(displaced).choices}  # fmt: skip
    # The wall stands on the table.
    height = found["plane_height", TABLE, WALL]["height"]
    assert height == pytest.approx(-0.012, abs=5e-4)
    assert found["wall_position", WALL]["x"] == pytest.approx(0.025, abs=5e-4)
    for body, mu in ((TABLE, 0.42), (WALL, 0.35)):
        friction = found["contact_friction", f"{body}~gantry.tool"]["friction"]
        assert friction == pytest.approx(mu, rel=0.05)
    assert len(found) == 4


def test_a_place_is_known_no_better_than_how_deep_the_tool_goes_in(tmp_path):
    """The world is four times as stiff as the scene says, and is pressed with one
    force: 8 N, which are 0.4 mm in the scene and 0.1 mm in the world. Where the
    stiffness is fitted along, it is nothing more to the place."""
    scene = write_scene(tmp_path)
    recordings = record(tmp_path, table=-0.012, spring=(4.0 * STIFFNESS, DAMPING))
    problem = PressingProblem(scene, recordings)
    search = Comparison(problem, print)

    def fitted(*more):
        height = Effect("plane_height", [TABLE, WALL], {"height": -0.012})
        return fit_effects(
            problem, search.screen(search.start.r), [height, *more],
            [(), *[("stiffness",)] * len(more)],
        )  # fmt: skip

    end = fitted()
    off = abs(end.effects[0].parameters["height"] + 0.012)
    assert off == pytest.approx(8.0 / 2e4 - 8.0 / 8e4, abs=5e-5)
    std, _ = problem.widened(end, 0)
    assert off < 2.0 * std["height"] < 1e-3 and off > 2.0 * end.std[0]["height"]
    known = fitted(
        Effect("contact_stiffness", [f"{TABLE}~gantry.tool"], {"stiffness": 8e4})
    )
    assert abs(known.effects[0].parameters["height"] + 0.012) < 5e-5
    std, _ = problem.widened(known, 0)
    assert std["height"] == pytest.approx(known.std[0]["height"])


def test_a_wall_that_is_put_right_explains_forces_and_distance(displaced):
    names = displaced.row_names()
    there = [
        Effect("wall_position", [WALL], {"x": 0.025}),
        Effect("plane_height", [TABLE, WALL], {"height": -0.012}),
    ]
    k = names.index(f"{WALL}~gantry.tool.distance")
    before, after = displaced.left(), displaced.left(there)
    shown = displaced.counts()[:, k]
    assert shown.sum() > 5
    # 25 mm over 0.2 mm.
    np.testing.assert_allclose(abs(before[shown, k]), 125.0, rtol=0.05)
    assert np.sqrt(np.mean(after[shown, k] ** 2)) < 2.0


def test_without_a_wrench_a_face_that_was_passed_tells(tmp_path):
    scene = write_scene(tmp_path)
    recordings = record(tmp_path, table=-0.012, wrench=False)
    problem = PressingProblem(scene, recordings)
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[TABLE]["z"] == pytest.approx(-0.012, abs=1e-3)


def test_without_a_wrench_efforts_tell_that_a_higher_table_is_pressed_on(tmp_path):
    """As the scene has it the tool never touches anything."""
    scene = write_scene(tmp_path)
    dynamics = SceneDynamics(scene)
    recordings = record(tmp_path, table=0.01, wall=0.28, wrench=False)
    assert presses(dynamics, recordings)
    problem, _ = problem_for(scene, recordings, dynamics)
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[TABLE]["z"] == pytest.approx(0.01, abs=1e-3)
    assert off[WALL]["x"] == pytest.approx(-0.02, abs=1e-3)


def test_a_lighter_tool_that_stays_above_a_table_is_not_taken_for_pressing(tmp_path):
    """It is pushed up by less than its modelled weight all the time, not only at the
    height at which it stays: 0.4 kg is 4 N, and a table there would explain them."""
    scene = write_scene(tmp_path, (0.1, 1.0, 0.02))
    recordings = record(
        tmp_path, table=-9.0, wall=9.0, wrench=False, mass=MASS - 0.4, high=0.12,
        force=0.0,
    )  # fmt: skip
    assert PressingProblem(scene, recordings).off == {}
    assert not presses(SceneDynamics(scene), recordings)


def test_touches_that_last_are_pressed_however_long_nothing_is_touched(tmp_path):
    """5 s on the table of 17 s; a carriage that bounces is another kind of problem."""
    scene = write_scene(tmp_path)
    recordings = record(tmp_path, wrench=False, waits=11.0)
    assert presses(SceneDynamics(scene), recordings)


def test_bodies_that_stand_nearer_are_felt_though_the_scene_has_no_contact(tmp_path):
    scene = write_scene(tmp_path)
    problem = PressingProblem(scene, record(tmp_path, table=0.01, wall=0.28))
    assert not problem.slots  # The tool never comes near what the scene has.
    off = {problem.shapes.names[k]: by for k, by in problem.off.items()}
    assert off[TABLE]["z"] == pytest.approx(0.01, abs=1e-3)
    assert off[WALL]["x"] == pytest.approx(-0.02, abs=1e-3)


def test_distances_are_computed_anew_only_where_something_stands_elsewhere(
    displaced, monkeypatch
):
    problem = PressingProblem(displaced.scene, displaced.recordings)
    computed = []
    slots = problem.shapes.slots
    monkeypatch.setattr(
        problem.shapes, "slots", lambda *args: computed.append(1) or slots(*args)
    )
    moved = Effect("wall_position", [WALL], {"x": 0.004, "y": 0.0, "z": 0.0})
    there = problem.residual([moved])
    assert computed
    before = len(computed)
    pair = problem.pair_name(problem._pairs_met[0])
    problem.residual([moved, Effect("contact_friction", [pair], {"friction": 0.1})])
    assert len(computed) == before
    other = Effect("wall_position", [WALL], {"x": 0.001, "y": 0.0, "z": 0.0})
    problem.residual([other])
    assert len(computed) == before + 1  # Of the wall alone.
    lower = Effect("wall_position", [TABLE], {"z": -0.012})
    problem.residual([other, lower])
    assert len(computed) == before + 2  # Of the table alone.
    problem._slots_at.clear()
    np.testing.assert_array_equal(problem.residual([moved]), there)
    problem._evaluate_nodes()  # Other rows: what was computed for these is gone.
    assert problem._slots_at == {}


def test_each_touch_is_told_of_where_it_is_pressed_hardest():
    """Every fourth test function by its number would leave out the touches of one, two
    and three here; the first one of a touch is where a tool may still approach."""
    on, force = np.zeros(40, bool), np.zeros(40)
    for first, last in ((1, 2), (9, 11), (17, 20), (24, 37)):
        on[first:last] = True
    force[on] = 1.0
    force[[10, 19, 28]] = 5.0
    first = np.zeros(40, int)
    told = np.flatnonzero(thinned(on, force, first))
    assert list(told) == [1, 10, 19, 24, 28, 32, 36]
    # A touch that is lost for a moment is not told twice.
    on = np.array([False, True, True, False, True, False, False, True])
    assert list(np.flatnonzero(thinned(on, 1.0 * on, first[:8]))) == [1, 7]
    # One in the next episode is another.
    episodes = np.array([0, 0, 0, 1, 1, 1, 1, 1])
    assert list(np.flatnonzero(thinned(on, 1.0 * on, episodes))) == [1, 4]


def test_no_contact_is_so_soft_that_a_tool_goes_in_by_centimetres(displaced):
    """A wall that stands elsewhere, met with one force alone, would be one."""
    at = f"{WALL}~gantry.tool"
    now = displaced.dynamics.now("contact_stiffness", [at])["stiffness"]
    displaced.left([Effect("contact_stiffness", [at], {"stiffness": 0.5 * now})])
    with pytest.raises(ValueError, match="goes in too far"):
        displaced.left([Effect("contact_stiffness", [at], {"stiffness": 0.01 * now})])


def test_a_stiffness_with_which_a_tool_went_in_too_far_is_moved_to_the_least(displaced):
    """Forces that are weighed anew, or by fewer effects, forbid what was fitted."""
    at = f"{TABLE}~gantry.tool"
    now = displaced.dynamics.now("contact_stiffness", [at])["stiffness"]
    soft = Effect("contact_stiffness", [at], {"stiffness": 0.01 * now})
    firm = Effect("contact_stiffness", [at], {"stiffness": 0.5 * now})
    place = Effect("plane_height", [TABLE], {"height": 1e-3})
    kept, moved = displaced.permitted([place, soft])
    assert kept == place and moved.at == soft.at
    displaced.left([place, moved])
    # No farther than it has to be.
    value = moved.parameters["stiffness"]
    with pytest.raises(ValueError, match="goes in too far"):
        displaced.left([place, replace(moved, parameters={"stiffness": 0.9 * value})])
    assert displaced.permitted([firm, place]) == [firm, place]


def test_a_softer_contact_is_looked_for_only_where_no_place_explains_more(
    right, displaced
):
    """Met with one force, a soft wall and one that is a little off have the same
    distance, and in a soft one the tool stays deep, where more forces are permitted."""
    for problem, is_tried in ((right[2], True), (displaced, False)):
        search = Comparison(problem, lambda text: None)
        start = fit_effects(problem, search.screen(problem.base()), ())
        found = problem.candidates(search.nuisances, start)
        assert any(c.kind == "wall_position" for c in found)
        assert any(c.kind == "contact_stiffness" for c in found) == is_tried


def test_a_fit_of_a_place_starts_where_it_is_felt(displaced):
    """A part of it, which columns may say, has the tool deep in the body."""
    off = {displaced.shapes.names[k]: by for k, by in displaced.off.items()}
    plain = displaced._plain_candidates(displaced.base(), ())
    for kind, at, name, felt in (
        ("wall_position", WALL, "x", off[WALL]["x"]),
        ("plane_height", TABLE, "height", off[TABLE]["z"]),
    ):
        [found] = [c for c in plain if c.kind == kind and c.at[0] == at]
        [effect] = found.effects(0, np.array([0.26 * felt]))
        assert effect.parameters[name] == felt


def test_a_rival_that_leaves_one_channel_a_gap_is_no_tie(tmp_path):
    """Few rows are distances of a wall that is 0.9 mm off: all rows together leave as
    much with its friction changed as with the wall put right."""
    scene = write_scene(tmp_path)
    problem = PressingProblem(scene, record(tmp_path, wall=0.3009))
    search = Comparison(problem, lambda text: None)
    place = Effect("wall_position", [WALL], {"x": 0.0009})
    rival = Effect("contact_friction", [f"{WALL}~gantry.tool"], {"friction": 0.21})
    other = Effect("contact_friction", [f"{TABLE}~gantry.tool"], {"friction": 0.31})

    def fitted(*effects):
        screen = search.screen(problem.residual(effects))
        return fit_effects(problem, screen, effects)

    fit, instead = fitted(place, other), fitted(rival, other)
    assert search.error(instead.score) <= 1.05 * search.error(fit.score)
    assert problem.loudest(instead)[0] == f"{WALL}~gantry.tool.distance"
    chosen = [
        Choice(effect, std, 1.0, 1.0, "", np.inf, ties, fixed=(), size=1)
        for effect, std, ties in zip(fit.effects, fit.std, ((rival,), ()), strict=True)
    ]
    assert still_tied(search, chosen, fit, 0) == ()


def test_faces_that_press_against_each_other_do_not_loosen_the_rows(
    tmp_path, monkeypatch
):
    """In a scene that has the tool inside a body, forces of opposing faces may be
    anything; rows were weighed as if so much acted in them, and nothing was felt."""
    explain = contact_dynamics.explain

    def squeezing(needs, G, there, root, sharing, left, weights, rank):
        explain(needs, G, there, root, sharing, left, weights, rank)
        weights[::20] *= 1e4

    scene, recordings = (
        write_scene(tmp_path),
        record(tmp_path, table=-0.012, wall=0.325),
    )
    plain = PressingProblem(scene, recordings)
    monkeypatch.setattr(contact_dynamics, "explain", squeezing)
    problem = PressingProblem(scene, recordings)
    needs = np.sqrt(np.mean(problem._all_needs(()) ** 2, axis=0))
    assert (problem.acting <= 10.01 * needs).all()
    assert problem.off == plain.off


@pytest.mark.slow
def test_where_only_efforts_were_measured_simulation_confirms_a_place(tmp_path):
    """A robot's states and efforts, without a command: windows take the efforts."""
    scene = write_scene(tmp_path)
    recordings = record(tmp_path, table=-0.012, n=2, effort="effort_measured")
    problem = PressingProblem(scene, recordings)
    there = [Effect("plane_height", [TABLE, WALL], {"height": -0.012})]
    start = fit_effects(problem, screen_of(problem), [])
    fits = (start, start, problem.nuisances())  # The equations'.
    for held in (None, recordings):
        outcome = problem.outcome(there, *fits, held)
        assert outcome.gap.before > 5.0
        assert outcome.gap.after < 2.0


@pytest.mark.slow
def test_a_soft_contact_that_equations_take_for_a_place_is_told_by_simulation(tmp_path):
    """With one force all the time 0.4 mm lower and 2e4 N/m are one thing in them."""
    scene = write_scene(tmp_path, stiffness="2e6")
    recordings = record(tmp_path, wrench=False, n=2, effort="effort_measured")
    problem = PressingProblem(scene, recordings)
    found = select(problem)
    place = Effect("plane_height", [TABLE, WALL], {"height": -4e-4})
    screen = found.screen(problem)
    fit = fit_effects(problem, screen, [place])
    assert problem.noise_error(fit.left) < 1.5
    chosen = Choice(fit.effects[0], fit.std[0], 1.0, 1.0, "", np.inf, (), (), 1)
    as_place = replace(found, choices=(chosen,), end=fit)
    result = conclude(problem, as_place, recordings)
    assert result.gap.after < 0.1 * result.gap.before
    found = {(e.kind, e.at[0]): e.parameters for e in result.effects}
    assert ("plane_height", TABLE) not in found
    # In a row with the tool's 2e6 N/m.
    stiffness = found["contact_stiffness", f"{TABLE}~gantry.tool"]["stiffness"].value
    assert stiffness == pytest.approx(2e4 / 0.99, rel=0.1)


@pytest.mark.slow
def test_a_soft_contact_that_is_softer_is_no_face_that_stands_elsewhere(tmp_path):
    """The scene has 2000 N/m, the world 700: a tool that is 18 mm deep went through no
    face, and forces of several sizes tell a stiffness from a place."""
    scene = write_scene(tmp_path, stiffness="4e3")
    log = record(tmp_path, wrench=False, swells=0.5, spring=(700.0, 30.0))
    problem = PressingProblem(scene, log)
    assert problem.off == {}
    assert {problem.shapes.names[k] for k in problem.soft} == {TABLE, WALL}
    found = {(c.effect.kind, *c.effect.at): c.effect.parameters
             for c in select(problem).choices}  # fmt: skip
    for body in (TABLE, WALL):
        stiffness = found["contact_stiffness", f"{body}~gantry.tool"]["stiffness"]
        assert stiffness == pytest.approx(700.0, rel=0.1)
    assert len(found) == 2


@pytest.mark.parametrize("tool", [1e4, 6e4])
def test_forces_act_where_drake_has_them_between_two_soft_shapes(tmp_path, tool):
    write_scene(tmp_path, stiffness="2e4")
    file = tmp_path / "gantry.sdf"
    file.write_text(file.read_text().replace("2e4\n", f"{tool:.0f}\n"))
    scene = read_scene(tmp_path / "scene.yaml")
    problem = PressingProblem(scene, record(tmp_path))
    builder = DiagramBuilder()
    plant = load_scene(scene, builder).plant
    context = builder.Build().CreateDefaultContext()
    own = plant.GetMyMutableContextFromRoot(context)
    plant.get_actuation_input_port().FixValue(own, np.zeros(plant.num_actuators()))
    pair = [s for s in problem.slots if problem.shapes.names[s.b] == TABLE]
    [slot] = [s for s in pair if (s.phi < -1e-4).any()]
    node = int(np.argmin(slot.phi))
    plant.SetPositions(own, problem._q[problem._rows[node]])
    results = plant.get_contact_results_output_port().Eval(own)
    every = map(results.point_pair_contact_info,
                range(results.num_point_pair_contacts()))  # fmt: skip
    [point] = [
        x.contact_point() for x in every if abs(x.point_pair().nhat_BA_W[2]) > 0.9
    ]
    np.testing.assert_allclose(slot.place[node], point, atol=1e-9)


ARM = """<link name="base"/>{a}{b}
<joint name="j" type="revolute"><parent>base</parent><child>a</child>
<axis><xyz>0 0 1</xyz></axis></joint>
<joint name="k" type="revolute"><pose relative_to="a">0.3 0 0 0 0 0</pose>
<parent>a</parent><child>b</child><axis><xyz>0 0 1</xyz></axis></joint>"""


def test_an_arm_that_swings_fast_needs_what_its_drives_give(tmp_path):
    """Its mass matrix changes by half within a tenth of a second: the mean of a product
    is not that of means. The efforts are what the motion needs, nothing is touched."""
    shape = SHAPE.format(at="0.3 0 0 0 0 0", what=BALL, mu=1.0)
    middle = "<inertial><pose>0.15 0 0 0 0 0</pose>"
    links = {
        x: LINK.format(name=x, mass=2.0, shape=shape).replace("<inertial>", middle)
        for x in "ab"
    }
    write_scene(tmp_path)
    body = ARM.format(**links).replace(
        'name="b">', 'name="b"><pose>0.3 0 0 0 0 0</pose>'
    )
    (tmp_path / "gantry.sdf").write_text(MODEL.format(name="gantry", body=body))
    text = SCENE.replace("[gantry.x, gantry.y, gantry.z]", "[gantry.j, gantry.k]")
    (tmp_path / "scene.yaml").write_text(text.replace("[0.3, 0, 0]", "[0.7, 0, 0]"))
    scene = read_scene(tmp_path / "scene.yaml")
    dynamics = SceneDynamics(scene)
    time, rate = np.arange(0.0, 8.0, 2e-3), np.array([5.0, 9.0])
    wide, angle = np.array([0.5, 1.2]), rate * time[:, None] + [0.0, 1.0]
    q, v = wide * np.sin(angle), wide * rate * np.cos(angle)
    vd = -wide * rate**2 * np.sin(angle)
    u = dynamics.inverse_dynamics(q, v, vd)
    rng = np.random.default_rng(0)
    write_recording(tmp_path / "recording.csv", {
        "time": time,
        **{f"gantry.{x}.position": q[:, i] + 1e-6 * rng.normal(size=len(time))
           for i, x in enumerate("jk")},
        **{f"gantry.{x}.effort_measured": u[:, i] for i, x in enumerate("jk")},
    })  # fmt: skip
    problem = PressingProblem(scene, read_recordings([tmp_path / "recording.csv"]))
    left, given = problem._needs, problem.means.effort
    assert np.sqrt(np.mean(left**2)) < 3e-3 * np.sqrt(np.mean(given**2))


def test_windows_of_what_presses_know_no_friction_better_than_its_law(right):
    """2 % of both frictions, 0.08 N of 2 kg, are 5 mm after half a second."""
    scene, recordings, problem = right
    assert set(problem.pressed()) == {f"{TABLE}~gantry.tool", f"{WALL}~gantry.tool"}
    sure, unsure = (PushWindows(scene, recordings, pairs=pairs)
                    for pairs in ((), problem.pressed()))  # fmt: skip
    y, w = sure.channels.index("gantry.y.position"), sure.windows[-1]
    assert w.start > 4.1  # It slides along both, one way.
    seconds = float(np.ptp(recordings[w.recording].time[w.rows]))
    known, more = (each.windows[-1].std[-1, y] for each in (sure, unsure))
    off = LAW * (TABLE_MU + WALL_MU) * 8.0 / MASS * seconds**2 / 2.0
    assert np.sqrt(more**2 - known**2) == pytest.approx(off, rel=0.1)


def test_no_place_has_a_body_where_the_tool_has_passed_freely(displaced):
    """It comes down at x = 0.1 and goes to the wall at 0.325: with its face at 0.11 or
    0.285 the wall would have been in its way. Rows of distances are of moments at which
    it presses on the wall. Farther along y the wall is in no one's way."""
    at_its_place = {"x": 0.025, "y": 0.0, "z": -0.012}
    for more, is_possible in (({}, True), ({"y": 0.3}, True), ({"x": -0.19}, False),
                              ({"x": -0.015}, False)):  # fmt: skip
        place = [Effect("wall_position", [WALL], at_its_place | more)]
        if is_possible:
            displaced.left(place)
        else:
            with pytest.raises(ValueError, match="the tool was where wall.wall would"):
                displaced.left(place)


def test_how_hard_a_tool_presses_is_asked_of_the_model_that_is_tried(displaced):
    """It was asked of the scene: with a friction that is wrong by 0.12 the pressing
    force was wrong by (1 + 0.42 0.3)/(1 + 0.3^2) = 1.033, and so were stiffnesses."""
    (table,) = [k for k, name in displaced.shapes.names.items() if name == TABLE]
    (pair,) = [pair for pair in displaced._met if table in pair]
    on = displaced._met[pair]
    friction = [
        Effect("contact_friction", [f"{body}~gantry.tool"], {"friction": mu})
        for body, mu in ((TABLE, 0.42), (WALL, 0.35))
    ]
    of_scene = displaced._pressed_with(())[pair][on]
    of_model = displaced._pressed_with(friction)[pair][on]
    assert np.median(of_model) == pytest.approx(8.0, rel=0.01)
    assert np.median(of_scene) > 8.1
    displaced.left(friction)
    np.testing.assert_array_equal(displaced._pressed_now[pair][on], of_model)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """A block for a tool, world and model alike."""
    folder = tmp_path_factory.mktemp("block")
    scene = write_scene(folder, (0.1, 1.0, 0.06), BLOCK)
    recordings = record(folder, wrench=False, effort="effort_measured", points=CORNERS)
    return scene, recordings, PressingProblem(scene, recordings)


def test_a_block_is_simulated_with_all_the_corners_that_it_presses_with(block):
    """Drake's point contact makes one of four: it goes in four times as deep, 0.3 mm
    more at 8 N, where noise is 10 um."""
    scene, recordings, problem = block
    start = fit_effects(problem, screen_of(problem), [])
    outcome = problem.outcome((), start, start, problem.nuisances(), recordings)
    assert outcome.gap.before < 1.5  # What `no_gap` allows.
    names = {problem.shapes.names[one.ground] for one in problem.lying()}
    assert names == {TABLE, WALL}
    found = problem_for(scene, recordings, problem.dynamics)[1]
    assert [each.kind for each in found] == ["point_on_face"] * 2
    assert "presses with edges" in found[0].says


def test_a_ball_is_simulated_as_it_is(right):
    problem = right[2]
    assert problem.lying() == []
    assert point_on_face(problem, problem.lying()) == []


def test_a_block_that_presses_went_through_no_face(block):
    """Its corners are a tenth of a millimetre inside, as contacts are soft: so little
    is no way through the wall from above, or through the table from a side."""
    problem = block[2]
    assert not any(face.is_alone for face in problem.faces)
    assert problem.off == {}


@pytest.mark.slow
def test_a_tool_that_is_heavier_is_no_gain(tmp_path):
    """With no load among the candidates it came out as gains of all drives."""
    scene = write_scene(tmp_path)
    problem = PressingProblem(scene, record(tmp_path, mass=MASS + 0.25))
    (choice,) = select(problem).choices
    assert KINDS[choice.effect.kind].weighs
    assert choice.effect.at == ["gantry.tool"]
    assert choice.effect.parameters["mass"] == pytest.approx(0.25, abs=0.01)


def test_the_inertia_that_a_sensor_feels_is_a_slope_however_large_rows_are(tmp_path):
    """Of clipped rows the slope of what a sensor reads of its tool's own motion, in a
    jump of acceleration, was a third of what it is."""
    problem = PressingProblem(write_scene(tmp_path), record(tmp_path, high=0.1)[:1])
    which = problem.nuisances().names.index("inertia felt by gantry.tip")
    before = problem.nuisances().columns[:, which]
    # On its way down the tool touches nothing.
    on = problem._of_rows(problem.means.time) < 0.4
    assert np.abs(before[on]).max() > 10.0
    problem._base = problem._nuisances = None
    problem.means.wrench[:, 2] += 20.0  # [N]
    assert np.abs(problem.base()[on]).max() > 200.0
    after = problem.nuisances().columns[:, which]
    np.testing.assert_allclose(after[on], before[on], atol=1e-6 * np.abs(before).max())


def test_what_a_sensor_in_the_mount_feels_of_its_tool_is_taken_off(right):
    """As a nuisance it was a slope, along which a force that slides turned out of its
    cone; a friction was found half as well."""
    scene, recordings, tip = right
    names = [f"gantry.tip.f{a}" for a in "xyz"]
    felt = []
    for number, recording in enumerate(recordings):
        (track,) = [t for t in tip.tracks if t.recording == number]
        vd = tip._vd[tip._offset[tip.tracks.index(track)] :][: len(track.time)]
        channels = dict(recording.channels)
        for name, a in zip(names, vd.T, strict=True):
            values = channels[name].values - MASS * a
            channels[name] = replace(channels[name], values=values)
        felt.append(replace(recording, channels=channels))
    mount = PressingProblem(scene, felt)
    assert len(mount.means.time) == len(tip.means.time)
    motion = tip._motion_felt_by(tip.sensors[0])
    apart = mount.means.wrench - tip.means.wrench
    assert np.sqrt(np.mean(motion**2)) > 5.0 * np.sqrt(np.mean(apart**2))
    assert max(mount._blocks_left(mount._without_nuisances()))[0] < 1.5
