"""Scenes that nobody had in mind: corners, holes, edges, two objects, other robots."""

import json

import numpy as np
import pytest
from gap_benchmark import foreign_logs, large_scenes
from gap_benchmark.contact_scenes import Setting, Shape, Thing, to_sdf
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from makebreak.gap import run_gap
from makebreak.gap.data.check_meshes import check_meshes
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.edge_crossings import FAR, crossing, edges_of_box
from makebreak.gap.numerics.free_body import FreeBody, simulate
from makebreak.gap.residuals.contact_dynamics import ContactDynamics
from makebreak.gap.residuals.contact_problem import ContactProblem
from makebreak.gap.residuals.pressing import PressingProblem
from makebreak.gap.result import GapMeasure
from makebreak.gap.search.choice import Choice
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.screen import rank
from makebreak.gap.simulation.contact_shapes import ContactShapes
from makebreak.gap.verdict import Facts, decide
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import load_scene, read_scene
from makebreak.scripts.cli import main

EYE = np.eye(3)[None]


def slots_of(tmp_path, things, poses, near=0.02):
    """Slots of things at (p (3,), yaw) each; and numbers of their bodies by name."""
    s = Setting(things)
    directives = ""
    for t in things:
        (tmp_path / f"{t.name}.sdf").write_text(to_sdf(t, s))
        directives += f"  - add_model: {{name: {t.name}, file: {t.name}.sdf}}\n"
        if not t.mass:
            weld = f"{{parent: world, child: {t.name}::{t.name}}}"
            directives += f"  - add_weld: {weld}\n"
    (tmp_path / "scene.yaml").write_text(f"directives:\n{directives}")
    shapes = ContactShapes(
        load_scene(read_scene(tmp_path / "scene.yaml"), DiagramBuilder())
    )
    number = {name.split(".")[0]: k for k, name in shapes.names.items()}
    at = {
        number[name]: (Rotation.from_euler("z", yaw).as_matrix()[None], np.array([p]))
        for name, (p, yaw) in poses.items()
    }
    return shapes.slots(at, near), number


def box(name, half, mass=1.0, at=(0.0, 0.0, 0.0)):
    return Thing(name, (Shape("box", half, 0.3, at),), mass, (1e-3, 1e-3, 1e-3))


# ----- Shapes


@pytest.mark.parametrize("dz", [-3e-4, 0.0, 3e-4])
@pytest.mark.parametrize("gap", [-2e-4, 2e-4])
def test_boxes_of_one_height_side_by_side_touch_with_their_sides(tmp_path, dz, gap):
    """The nearest to a corner is then an edge, in any direction."""
    half = (0.05, 0.04, 0.03)
    slots, number = slots_of(
        tmp_path, (box("one", half), box("two", half)),
        {"one": ((0.0, 0.0, 0.03), 0.0), "two": ((0.1 + gap, 0.0, 0.03 + dz), 0.0)},
    )  # fmt: skip
    near = [s for s in slots if abs(s.phi[0]) < 1e-3]
    assert len(near) >= 4
    for s in near:
        assert s.phi[0] == pytest.approx(gap, abs=1e-12)
        sign = 1.0 if s.a == number["two"] else -1.0
        np.testing.assert_allclose(s.normal[0], [sign, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("dz", [-3e-4, 0.0, 3e-4])
@pytest.mark.parametrize("gap", [-2e-4, 2e-4])
def test_a_cylinder_of_a_box_s_height_touches_it_with_its_side(tmp_path, dz, gap):
    """A point of its rim that is within the box is nearest to the top: forces up there
    and down below it could be as large as one likes."""
    shape = (Shape("cylinder", (0.04, 0.03), 0.3, (0.0, 0.0, 0.0)),)
    disc = Thing("disc", shape, 1.0, (1e-3, 1e-3, 1e-3))
    slots, number = slots_of(
        tmp_path, (box("box", (0.05, 0.04, 0.03)), disc),
        {"box": ((0.0, 0.0, 0.03), 0.0), "disc": ((0.09 + gap, 0.0, 0.03 + dz), 0.0)},
    )  # fmt: skip
    touching = [s for s in slots if s.best[0] and abs(s.phi[0]) < 1e-3]
    assert len([s for s in touching if s.a == number["disc"]]) >= 2
    for s in touching:
        assert s.phi[0] == pytest.approx(gap, abs=1e-12)
        sign = 1.0 if s.a == number["disc"] else -1.0
        np.testing.assert_allclose(s.normal[0], [sign, 0.0, 0.0], atol=1e-12)
    # On top of it, the points of its rim carry it.
    slots, number = slots_of(
        tmp_path, (box("box", (0.05, 0.04, 0.03)), disc),
        {"box": ((0.0, 0.0, 0.03), 0.0), "disc": ((0.0, 0.0, 0.0901), 0.0)},
    )  # fmt: skip
    carried = [s for s in slots if s.best[0] and s.normal[0, 2] == 1.0]
    assert len(carried) == 12 and all(s.phi[0] < 2e-4 for s in carried)


def test_a_box_over_an_edge_stands_where_its_edges_cross_it(tmp_path):
    top = box("table", (0.3, 0.3, 0.05), 0.0, (0.0, 0.0, -0.05))
    slots, _ = slots_of(
        tmp_path, (top, box("box", (0.08, 0.05, 0.02))),
        {"table": ((0.0, 0.0, 0.0), 0.0), "box": ((0.28, 0.0, 0.0201), 0.1)},
    )  # fmt: skip
    crossings = [s for s in slots if s.key[0] < 0]
    assert len(crossings) == 2
    for s in crossings:
        assert s.place[0, 0] == pytest.approx(0.3, abs=1e-9)
        assert s.phi[0] == pytest.approx(1e-4, abs=1e-9)
        np.testing.assert_allclose(s.normal[0], [0.0, 0.0, 1.0], atol=1e-9)
    # The sides' lines, 5 cm off the middle and turned by 0.1, meet x = 0.3 there.
    wanted = [(sign * 0.05 + 0.02 * np.sin(0.1)) / np.cos(0.1) for sign in (-1, 1)]
    np.testing.assert_allclose(sorted(s.place[0, 1] for s in crossings), wanted)


def test_a_box_in_the_middle_of_a_table_crosses_no_edge(tmp_path):
    top = box("table", (0.3, 0.3, 0.05), 0.0, (0.0, 0.0, -0.05))
    slots, _ = slots_of(
        tmp_path, (top, box("box", (0.08, 0.05, 0.02))),
        {"table": ((0.0, 0.0, 0.0), 0.0), "box": ((0.0, 0.0, 0.02), 0.1)},
    )  # fmt: skip
    assert [s for s in slots if s.key[0] >= 0]
    assert not [s for s in slots if s.key[0] < 0]


def test_edges_that_are_parallel_or_far_inside_do_not_touch():
    edges = edges_of_box((0.1, 0.1, 0.1), np.eye(3), np.zeros(3))
    assert len(edges) == 12
    for p in ([0.2, 0.0, 0.2], [0.02, 0.03, 0.05]):
        for one in edges:
            for other in edges:
                at = np.array([p])
                _, d, _, may = crossing(one, EYE, at, other, EYE, np.zeros((1, 3)))
                assert not may[0] and d[0] == FAR


# ----- What carries, and what stands beside it


def problem_of(tmp_path, kind, scene, seed, most=2, hide="", **options):
    large_scenes.write(scene, hide, seed, tmp_path, most=most, **options)
    return kind(
        read_scene(tmp_path / "scene.yaml"),
        read_recordings([tmp_path / "recording.csv"]),
    )


def test_a_wall_carries_nothing_and_what_is_pushed_to_it_may_lean(tmp_path):
    problem = problem_of(tmp_path, ContactDynamics, "corner", 3, most=1)
    lies = {problem.pair_name(p): problem._lies(p) for p in problem._pairs_met}
    assert lies["block.block~table.table"]
    assert not lies["block.block~north.north"] and not lies["block.block~east.east"]
    names = problem.row_names()
    assert "block.block~table.table.slope_x" in names
    assert "block.block~north.north.slope_x" not in names
    # Of what is only seen near a wall no distance is asked.
    shown, r = problem.counts(), problem.left()
    k = names.index("block.block~north.north.distance")
    assert shown[:, k].any() and np.abs(r[shown[:, k], k]).max() < 5.0


def test_a_box_that_is_tipped_stands_on_an_edge(tmp_path):
    problem = problem_of(tmp_path, ContactDynamics, "tipped", 5, most=2)
    [pair] = [p for p in problem._pairs_met if problem._lies(p)]
    masks = [on for s, on in zip(problem.slots, problem._masks, strict=True)
             if problem._pair_of(s) == pair]  # fmt: skip
    body = problem.bodies["box.box"][0]
    q = problem._q[problem._rows, body : body + 4]
    tilt = 2.0 * np.hypot(q[:, 1], q[:, 2])
    count = np.sum(masks, axis=0)
    flat, tipped = tilt < 0.006, (tilt > 0.05) & (tilt < 0.3)
    assert flat.sum() > 20 and tipped.sum() > 20
    assert np.median(count[flat]) == 4
    assert np.median(count[tipped]) == 2


@pytest.mark.slow
def test_a_hole_is_left_and_met_as_it_is_felt(tmp_path):
    """All its walls are near all the time."""
    problem = problem_of(tmp_path, PressingProblem, "peg", 4, most=2)
    screen_left = problem.base()
    channel = problem.channel_of_rows()
    for k, name in enumerate(problem.row_names()):
        mine = screen_left[channel == k]
        if "equation" in name or ".f" in name:
            assert np.sqrt(np.mean(mine**2)) < 1.5, name
    # Of a knock, which is over between two samples, the force is hardly known.
    var = problem.means.wrench_var[:, :3]
    assert var.max() > 4.0 * np.median(var)


@pytest.mark.slow
def test_a_hole_that_stands_elsewhere_was_passed_through_the_walls_that_are_open(
    tmp_path,
):
    """The peg is 5.7 mm deep in one wall, and nearer to that wall's seam with the next
    one, through which nothing goes."""
    problem = problem_of(tmp_path, PressingProblem, "peg", 11, most=1, hide="hole")
    [(body, off)] = problem.off.items()
    assert problem.shapes.names[body] == "socket.socket"
    assert off == pytest.approx({"x": 2.59e-3, "y": -5.71e-3}, abs=1e-4)


@pytest.mark.slow
def test_a_wall_stands_where_what_is_pushed_meets_it(tmp_path):
    """Farther away than in the scene, where it was gone through."""
    problem = problem_of(tmp_path, ContactProblem, "corner", 15, most=1, hide="wall")
    search = Comparison(problem, lambda text: None)
    start = fit_effects(problem, search.screen(problem.base()), ())
    [wall] = [
        c for c in problem.candidates(search.nuisances, start)
        if (c.kind, c.at) == ("wall_position", ("north.north",))
    ]  # fmt: skip
    [ranked] = rank(search.screen(start.r), [wall])
    fit = fit_effects(problem, search.screen(start.r), ranked.effects)
    assert fit.effects[0].parameters == pytest.approx({"y": 6.89e-3}, abs=5e-4)
    assert fit.score < 0.7 * start.score


# ----- Meshes

U = [(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)]
CAP = [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (0, 5, 6), (0, 6, 7)]


def prism(outline, cap) -> str:
    """OBJ of an outline in x and z, 4 long, all in cm."""
    n, text = len(outline), ""
    for y in (-2, 2):
        text += "".join(f"v {x / 100} {y / 100} {z / 100}\n" for x, z in outline)
    faces = [*cap, *((c + n, b + n, a + n) for a, b, c in cap)]
    for i in range(n):
        j = (i + 1) % n
        faces += [(j, i, i + n), (j, i + n, j + n)]
    return text + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)


@pytest.mark.parametrize(
    "outline, cap, z, radius, model, is_refused",
    [
        (U, CAP, 0.02, 0.008, "point", True),
        (U, CAP, 0.05, 0.008, "point", False),  # Above it.
        (U, CAP, 0.02, 0.012, "point", False),  # 10 mm: not deeper than it is large.
        (U, CAP, 0.02, 0.008, "hydroelastic", False),
        ([(0, 0), (4, 0), (4, 3), (0, 3)], [(0, 1, 2), (0, 2, 3)], 0.02, 0.008,
         "point", False),
    ],
    ids=["in the hollow", "above it", "a large one", "as a surface", "a solid one"],
)  # fmt: skip
def test_a_hollow_mesh_is_refused_where_something_was_in_it(
    tmp_path, outline, cap, z, radius, model, is_refused
):
    (tmp_path / "trough.obj").write_text(prism(outline, cap))
    (tmp_path / "trough.sdf").write_text(
        '<sdf version="1.9"><model name="trough"><link name="trough"><collision '
        'name="c"><geometry><mesh><uri>trough.obj</uri></mesh></geometry></collision>'
        "</link></model></sdf>"
    )
    ball = Thing("ball", (Shape("sphere", (radius,), 0.3),), 0.1, (1e-5,) * 3)
    (tmp_path / "ball.sdf").write_text(to_sdf(ball, Setting((ball,))))
    (tmp_path / "scene.yaml").write_text(
        "directives:\n  - add_model: {name: trough, file: trough.sdf}\n"
        "  - add_weld: {parent: world, child: trough::trough}\n"
        "  - add_model: {name: ball, file: ball.sdf}\n"
        f"plant: {{contact_model: {model}}}\n"
    )
    rows = [f"{0.01 * k},0.02,{0.001 * k},{z}" for k in range(20)]
    header = "time,ball.ball.x,ball.ball.y,ball.ball.z"
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]) + "\n")
    loaded = load_scene(read_scene(tmp_path / "scene.yaml"), DiagramBuilder())
    recordings = read_recordings([tmp_path / "log.csv"])
    if is_refused:
        with pytest.raises(ValueError, match="ball.ball was seen 0.01 m inside .*hull"):
            check_meshes(loaded, recordings)
    else:
        check_meshes(loaded, recordings)


# ----- The verdict


def measure(before, after):
    reduction = 0.0 if before <= 1.0 else 1.0 - max(after - 1, 0.0) / (before - 1.0)
    return GapMeasure(before, after, 1.0, reduction)


def test_what_leaves_most_of_the_simulated_gap_is_no_name_for_it():
    nothing: dict = {}
    some = [Choice(Effect(), nothing, 9.0, 1.0, "", 1.0, (), (), 1)]

    def verdict(before, after):
        return decide(Facts(some, 29.0, 1.0, chosen_on=measure(before, after)))[0]

    assert verdict(29.0, 28.9) == "gap_unnamed"
    assert verdict(29.0, 1.2) == "gap_named"
    assert verdict(1.1, 1.1) == "gap_named"


# ----- Many boxes


def test_boxes_that_are_far_change_nothing():
    rng = np.random.default_rng(0)
    floor = np.array([*np.eye(3).ravel(), 0.0, 0.0, -0.1, 0.2, 0.2, 0.1])
    others = np.tile(floor, (40, 1))
    others[:, 9:12] = rng.uniform(-0.4, 0.4, (40, 3)) + [0.0, 0.0, -0.6]
    others[:, 12:] = 0.1

    def fall(fixed):
        n = len(fixed)
        pair = np.array([2e4, 1.0, 0.4, 0.4, 0.5, 0.0])
        body = FreeBody(
            0.1, np.zeros(3), 1e-5 * np.eye(3), np.array([0.0, 0.0, -9.81]),
            np.array([[0.0, 0.0, 0.0, 0.02]]), fixed, np.tile(pair, (1, n, 1)),
            np.zeros((1, n)), np.zeros((0, 6)), np.zeros(3),
        )  # fmt: skip
        start = np.array([1.0, 0, 0, 0, -0.15, 0, 0.06, 0, 3.0, 0, 0.4, 0, 0])
        return simulate(body, start, np.linspace(0.0, 0.4, 41))

    alone = fall(floor[None])
    assert alone[:, 6].min() > 0.015 and np.ptp(alone[:, 10]) > 0.01  # It rubbed.
    np.testing.assert_array_equal(fall(np.vstack([floor, others])), alone)


# ----- Whole runs


def found_in(folder, log="recording.csv"):
    return run_gap(folder / "scene.yaml", [folder / log])


@pytest.mark.slow
def test_one_quiet_joint_among_four_is_looked_into(tmp_path):
    """All joints together leave 1.1 times the noise, this one 1.7."""
    effects = foreign_logs.write("lift_first", "drag", 2, tmp_path)
    [effect] = effects
    out = tmp_path / "out"
    status = main(["gap", str(tmp_path / "robot.urdf"), str(tmp_path / "log.csv"),
                   "--out", str(out)])  # fmt: skip
    assert status == 0
    result = json.loads((out / "result.json").read_text())
    assert result["verdict"] == "gap_named"
    [named] = result["effects"]
    assert (named["kind"], named["at"]) == (effect["kind"], effect["at"])
    value = named["parameters"]["coefficient"]["value"]
    assert value == pytest.approx(effect["parameters"]["coefficient"], rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene, seed",
    [("two_blocks", 1), ("block_ball", 2), ("corner", 3), ("peg", 4), ("tipped", 5),
     ("over_the_table", 6)],
)  # fmt: skip
def test_where_nothing_is_hidden_nothing_is_found(tmp_path, scene, seed):
    large_scenes.write(scene, "", seed, tmp_path)
    result = found_in(tmp_path)
    assert (result.verdict, result.effects) == ("no_gap", [])


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene, hide, seed", [("two_blocks", "friction", 22), ("peg", "hole", 11),
                          ("tipped", "mass", 17)]
)  # fmt: skip
def test_what_is_hidden_in_the_large_is_named_first(tmp_path, scene, hide, seed):
    [effect] = large_scenes.write(scene, hide, seed, tmp_path)
    result = found_in(tmp_path)
    assert result.effects and result.effects[0].kind == effect["kind"]
    for name, value in effect["parameters"].items():
        assert result.effects[0].parameters[name].value == pytest.approx(value, rel=0.1)
