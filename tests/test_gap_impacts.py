"""A cart that runs against walls: what of the touch and of the rail is missing."""

from dataclasses import replace

import numpy as np
import pytest
from gap_benchmark import cart_world
from gap_benchmark.cart_world import PAIR

from makebreak.gap.data.findings import SAMPLED_COMMANDS
from makebreak.gap.data.pieces import part_of
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.recording import Episode
from makebreak.gap.data.table import write_recording
from makebreak.gap.does_not_fit import DoesNotFit
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.runs import runs_of
from makebreak.gap.numerics.selection import Screen
from makebreak.gap.residuals.felt_places import SOFT
from makebreak.gap.residuals.fixed_faces import PASSED
from makebreak.gap.residuals.impacts import (
    FREE_SEC,
    MOST_FREE,
    TIMING,
    ImpactProblem,
    ImpactWindows,
    nearest,
    positions,
    runs_against,
    walls_of,
    without_contact,
)
from makebreak.gap.residuals.pressing import PressingProblem, presses
from makebreak.gap.workflow import problem_for, run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene

OWN_WALL = """<sdf version="1.7"><model name="slide">
<link name="base"><collision name="wall"><pose>0.15 0 0 0 0 0</pose><geometry>
<box><size>0.1 1 1</size></box></geometry></collision></link>
<link name="ball"><inertial><mass>1</mass></inertial><collision name="ball"><geometry>
<sphere><radius>0.02</radius></sphere></geometry></collision></link>
<link name="carriage"><inertial><mass>1</mass></inertial></link>
<joint name="x" type="prismatic"><parent>base</parent><child>carriage</child><axis>
<xyz>1 0 0</xyz></axis></joint>
<joint name="y" type="prismatic"><parent>carriage</parent>
<child>ball</child><axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"""
_PARAMETER = {"damper": "damping"}  # Of the effect that is the cart's field.


def ran(folder, seed, seconds=10.0, **hidden):
    rng = np.random.default_rng(seed)
    cart = cart_world.Cart(
        mass=rng.uniform(0.8, 2.0), stiffness=rng.uniform(8e3, 3e4),
        dissipation=rng.uniform(0.3, 1.2),
    )  # fmt: skip
    true = replace(cart, **{k: f(getattr(cart, k)) for k, f in hidden.items()})
    table, noise = cart_world.record(true, rng, seconds)
    scene = cart_world.write(folder, cart, table, noise)
    return scene, folder / "recording.csv", true


def test_impacts_are_told_by_windows_about_them(tmp_path):
    """With the true contact the windows are at the noise, with another they are not;
    and a rail's friction is seen between touches."""
    scene_file, file, true = ran(
        tmp_path, 1, 5.0, stiffness=lambda k: 0.5 * k, coulomb=lambda c: 0.4
    )
    scene, recordings = read_scene(scene_file), read_recordings([file])
    dynamics = SceneDynamics(scene)
    assert runs_against(dynamics, recordings)
    problem, _ = problem_for(scene, recordings, dynamics)
    assert isinstance(problem, ImpactProblem)
    truth = [
        Effect("contact_stiffness", [PAIR], {"stiffness": true.stiffness}),
        Effect("joint_coulomb_friction", ["cart.rail"], {"coulomb": 0.4}),
    ]
    left = [np.sqrt(np.mean(problem.residual(e) ** 2)) for e in ([], truth[:1], truth)]
    assert left[0] > 3.0 and left[1] > 1.3 and left[2] < 1.1
    judged = problem.judged()
    assert {"cart.rail.position", "cart.rail.velocity"} <= set(judged)


@pytest.mark.slow
def test_a_linear_damper_is_no_dissipation(tmp_path):
    """Walls that damp as most simulators' do, not as Hunt and Crossley say: no value of
    the dissipation explains them, a damper's does, and it is among what is tried."""
    scene_file, file, true = ran(tmp_path, 2, 5.0, damper=lambda _: 18.0)
    scene, recordings = read_scene(scene_file), read_recordings([file])
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)

    def left(*effects):
        return np.sqrt(np.mean(problem.residual(effects) ** 2))

    tried = [kind_at for kind_at in problem._of_contacts() if kind_at[1] == PAIR]
    values = {kind: [v for _, v in trials] for kind, _, _, trials in tried}
    assert min(values["contact_damping"]) < true.damper < max(values["contact_damping"])
    best = min(
        left(Effect("contact_dissipation", [PAIR], {"dissipation": d}))
        for d in (0.1, *values["contact_dissipation"])
    )
    with_damper = left(Effect("contact_damping", [PAIR], {"damping": true.damper}))
    assert best > 1.5 and with_damper < 1.1
    # What the dissipation may be off by says nothing once a damper is in its place.
    scene.tolerance["contact_dissipation"] = 1.0
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    n = problem.nuisances()
    own = [name == f"contact_dissipation of {PAIR}" for name in n.names]
    damper = Effect("contact_damping", [PAIR], {"damping": 14.0})
    assert sum(own) == 1 and problem.replaced([damper]).tolist() == own
    assert problem.replaced([Effect("contact_damping", ["a.a~b.b"], {})]).sum() == 0
    assert problem.replaced([]) is None
    screen = Screen(problem.base(), n.columns, n.prior, problem.train())
    fitted = fit_effects(problem, screen, [damper])
    found = fitted.effects[0].parameters["damping"]
    assert found == pytest.approx(true.damper, rel=0.03)
    assert fitted.b[own.index(True)] == 0.0


@pytest.mark.slow
def test_shapes_that_are_not_alike_have_no_stiffness_to_be_unsure_of(
    tmp_path, monkeypatch
):
    scene_file, file, _ = ran(tmp_path, 2, 5.0)
    scene, recordings = read_scene(scene_file), read_recordings([file])
    scene.tolerance["contact_dissipation"] = 1.0
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))

    now = problem.dynamics.now

    def differs(kind, at):
        if kind.startswith("contact_"):
            raise ValueError(f"{kind}: surfaces of different stiffness")
        return now(kind, at)

    assert any(name.startswith("contact_") for name in problem.nuisances().names)
    monkeypatch.setattr(problem.dynamics, "now", differs)
    assert not any(name.startswith("contact_") for name in problem.nuisances().names)


@pytest.mark.slow
def test_velocities_that_come_late_are_no_softer_wall(tmp_path):
    """0.1 ms, a twentieth of a row, take a stiff wall's stiffness along unless the
    velocities may be late."""
    scene_file, file, true = ran(
        tmp_path, 2, 5.0, stiffness=lambda k: 1.5 * k, damper=lambda _: 18.0
    )
    (recording,) = read_recordings([file])
    columns = {"time": recording.time} | {c: recording[c] for c in recording.channels}
    name = "cart.rail.velocity"
    late = np.interp(recording.time - 1e-4, recording.time, recording[name])
    write_recording(file, columns | {name: late})
    scene, recordings = read_scene(scene_file), read_recordings([file])
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    n = problem.nuisances()
    timing = n.names.index(f"timing of {name}")
    start = [
        Effect("contact_stiffness", [PAIR], {"stiffness": 1.02 * true.stiffness}),
        Effect("contact_damping", [PAIR], {"damping": 18.0}),
    ]
    screen = Screen(problem.base(), n.columns, n.prior, problem.train(), 1.0, n.reach)
    fitted = fit_effects(problem, screen, start)
    assert fitted.b[timing] == pytest.approx(1e-4, abs=2e-5)
    # Without it the stiffness is 6 deviations off.
    each = zip(fitted.effects, (true.stiffness, 18.0), fitted.std, strict=True)
    for effect, value, std in each:
        ((key, found),) = effect.parameters.items()
        assert abs(found - value) < 2.0 * std[key]


@pytest.mark.parametrize(
    ("rows", "shift"),
    [
        pytest.param(2, 0, marks=pytest.mark.slow),
        pytest.param(4, 0, marks=pytest.mark.slow),
        (2, 2),
        pytest.param(1, 0, marks=pytest.mark.slow),
        pytest.param(2, 5, marks=pytest.mark.slow),
    ],
)
def test_commands_of_a_faster_loop_act_where_free_motion_says(tmp_path, rows, shift):
    """Every `rows`-th row of a loop is logged, its commands as of `shift` rows before:
    on the mean they act so much earlier, or later, than if held from row to row. More
    than a row is no timing of rows, and is left to the search."""
    cart = cart_world.Cart()
    rng = np.random.default_rng(3)
    table, noise = cart_world.record(cart, rng, 8.0, 250.0, wave=2.0)
    name = "cart.rail.effort_command"
    commands = np.roll(table[name], -shift)  # Logged before they act.
    table = {c: x[: len(x) - 8 : rows] for c, x in (table | {name: commands}).items()}
    scene = read_scene(cart_world.write(tmp_path, cart, table, noise))
    recordings = read_recordings([tmp_path / "recording.csv"])
    problem, found = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    expected = (shift - 0.5 * (rows - 1)) / rows  # Of the log's rows.
    if rows == 1 or abs(expected) > 1.0:
        assert problem.commands_late == 0.0 and not found
        return
    late = problem.commands_late * 250.0 / rows
    assert late == pytest.approx(expected, abs=0.04)
    assert [each.kind for each in found] == [SAMPLED_COMMANDS]
    # So are those of what is reported on.
    assert problem._again(recordings).commands_late == problem.commands_late
    assert np.sqrt(np.mean(problem.residual(()) ** 2)) < 1.1
    assert TIMING in problem.nuisances().names


def test_free_motion_is_judged_between_walls_that_are_near(tmp_path):
    """From wall to wall in less time than a window of free motion is given: then it is
    as long as it can be, and tells the rail's friction as well as elsewhere."""
    cart = cart_world.Cart(reach=0.08)
    true = replace(cart, coulomb=0.4)
    table, noise = cart_world.record(true, np.random.default_rng(5), 4.0)
    scene = read_scene(cart_world.write(tmp_path, cart, table, noise))
    recordings = read_recordings([tmp_path / "recording.csv"])
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    wall = cart.reach - cart.half
    free = [
        w for w in problem.windows
        if np.abs(recordings[0]["cart.rail.position"][w.rows]).max() < wall
    ]  # fmt: skip
    rows = [w.rows.stop - w.rows.start for w in free]
    assert len(free) == MOST_FREE and sum(w.train for w in free) == 4
    assert max(rows) < FREE_SEC * 500 and min(rows) > 0.05 * 500
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train())
    start = Effect("joint_coulomb_friction", ["cart.rail"], {"coulomb": 0.2})
    fitted = fit_effects(problem, screen, [start])
    assert fitted.effects[0].parameters["coulomb"] == pytest.approx(0.4, rel=0.02)
    assert fitted.std[0]["coulomb"] < 0.01


def test_positions_are_those_of_each_episode_though_time_starts_anew(tmp_path):
    scene, _, _ = ran(tmp_path, 1, 2.0)
    time = np.arange(0.0, 2.0, 0.01)
    x = np.concatenate([0.1 * time, np.cos(time), -time])
    gap = np.arange(len(x)) % 7 == 2
    columns = {"time": np.tile(time, 3), "episode": np.repeat([0, 1, 2], len(time)),
               "cart.rail.position": np.where(gap, np.nan, x)}  # fmt: skip
    write_recording(tmp_path / "three.csv", columns)
    (recording,) = read_recordings([tmp_path / "three.csv"])
    found = positions(SceneDynamics(read_scene(scene)), recording)
    np.testing.assert_allclose(found[:, 0], x, atol=1e-4)  # Lines over the gaps.


def test_walls_that_nothing_touches_do_not_count(tmp_path):
    scene_file, file, _ = ran(tmp_path, 1, 3.0)
    wall = tmp_path / "wall.sdf"
    text = wall.read_text()
    for sign in ("-", ""):
        text = text.replace(f"<pose>{sign}0.35 ", f"<pose>{sign}1.35 ")
    wall.write_text(text)
    scene = read_scene(scene_file)
    assert not runs_against(SceneDynamics(scene), read_recordings([file]))


@pytest.mark.parametrize(
    ("shares", "runs"), [((0.3,), True), ((0.7,), False), ((0.7, 0.0), True)]
)
def test_what_lies_at_a_wall_does_not_run_against_it(tmp_path, shares, runs):
    """Five touches a recording, for so large a share of its time; 0: none."""
    cart, t = cart_world.Cart(), np.arange(2000) / 500.0
    files = []
    for i, share in enumerate(shares):
        touching = (t / 0.8) % 1.0 < share
        x = np.where(touching, cart.reach - cart.half + 1e-3, 0.1)
        table = {"time": t, "cart.rail.position": x}
        table["cart.rail.effort_command"] = 0.0 * t
        scene = cart_world.write(tmp_path / str(i), cart, table, None)
        files.append(tmp_path / str(i) / "recording.csv")
    dynamics = SceneDynamics(read_scene(scene))
    assert runs_against(dynamics, read_recordings(files)) == runs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "hidden"),
    [
        (21, {"stiffness": lambda k: 0.5 * k, "coulomb": lambda c: 0.4}),
        (22, {"stiffness": lambda k: 1.8 * k}),
        (23, {"dissipation": lambda d: 2.0 * d}),
        (24, {"dissipation": lambda d: 0.4 * d}),
        (25, {}),
        (26, {"damper": lambda _: 18.0}),
        (27, {"damper": lambda _: 60.0, "stiffness": lambda k: 0.6 * k}),
    ],
)
def test_from_files_to_what_is_missing(tmp_path, seed, hidden):
    scene, file, true = ran(tmp_path, seed, **hidden)
    result = run_gap(scene, [file])
    found = {name: p.value for e in result.effects for name, p in e.parameters.items()}
    expected = {_PARAMETER.get(n, n): getattr(true, n) for n in hidden}
    assert found == pytest.approx(expected, rel=0.03)
    assert result.verdict == ("gap_named" if hidden else "no_gap")


@pytest.mark.slow
def test_a_wall_that_stands_elsewhere_is_found_by_what_runs_against_it(tmp_path):
    scene_file, file, _ = ran(tmp_path, 3, 5.0)
    wall = tmp_path / "wall.sdf"
    text = wall.read_text()
    for model, shown in (("-0.35", "-0.354"), ("0.35", "0.346")):  # True: + 4 mm.
        text = text.replace(f"<pose>{model} ", f"<pose>{shown} ")
    wall.write_text(text)
    scene, recordings = read_scene(scene_file), read_recordings([file])
    problem, _ = problem_for(scene, recordings, SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    n = problem.nuisances()
    screen = Screen(problem.base(), n.columns, n.prior, problem.train())
    start = fit_effects(problem, screen, [])
    found = [c for c in problem.candidates(n, start) if c.kind == "wall_position"]
    assert [c.at for c in found] == [("wall.wall",)]
    end = fit_effects(problem, screen, [Effect("wall_position", ["wall.wall"],
                                               {"x": 0.003})])  # fmt: skip
    # The encoder's noise is 0.01 mm; a touch of the softest wall here is 20 times that.
    assert end.effects[0].parameters["x"] == pytest.approx(0.004, abs=1e-4)
    assert np.sqrt(np.mean(end.r**2)) < 1.1 < np.sqrt(np.mean(start.r**2))


@pytest.mark.slow
@pytest.mark.parametrize("times", [1.0, pytest.param(10.0, marks=pytest.mark.slow)])
def test_a_soft_bumper_that_is_struck_is_not_pressed_on(tmp_path, times):
    """A strike goes deeper than a tool that presses may be in a face. It goes so deep
    by the scene's own softness, or, where the scene is ten times as stiff, as if the
    face were elsewhere; but no touch there lasts."""
    cart = cart_world.Cart(stiffness=1500.0)
    table, noise = cart_world.record(cart, np.random.default_rng(4), 8.0, 250.0)
    told = replace(cart, stiffness=times * cart.stiffness)
    scene = read_scene(cart_world.write(tmp_path, told, table, noise))
    recordings = read_recordings([tmp_path / "recording.csv"])
    deep = np.abs(table["cart.rail.position"]).max() - (cart.reach - cart.half)
    assert deep > 2.0 * PASSED
    dynamics = SceneDynamics(scene)
    assert bool(PressingProblem(scene, recordings).off) == (times > SOFT)
    assert not presses(dynamics, recordings)
    problem, _ = problem_for(scene, recordings, dynamics)
    assert isinstance(problem, ImpactProblem)


def test_a_report_needs_no_more_than_one_touch(tmp_path):
    """That a link runs against walls is decided on the rest; a short last episode with
    one or two touches left nothing to report on, and nothing was named."""
    scene_file, file, _ = ran(tmp_path, 3, 5.0)
    scene, (recording,) = read_scene(scene_file), read_recordings([file])
    problem, _ = problem_for(scene, [recording], SceneDynamics(scene))
    assert isinstance(problem, ImpactProblem)
    near = np.abs(recording["cart.rail.position"]) > 0.2  # Where the walls' faces are.
    (first, last), second = runs_of(near)[:2]
    short = part_of(recording, [Episode(0, 0, (last + second[0]) // 2)])
    with pytest.raises(DoesNotFit):
        ImpactWindows(scene, [short])
    model = problem._again([short])
    assert model._touches == 1
    assert np.sqrt(np.mean(model.residual(()) ** 2)) < 1.2


@pytest.mark.parametrize("is_struck", [False, True])
def test_shapes_that_pass_through_their_own_base_are_not_struck(tmp_path, is_struck):
    """A ball on a slide swings up to 40 mm into its own base's wall, or bounces off it:
    in both the shapes overlap now and then, and only one of them is a touch."""
    (tmp_path / "slide.sdf").write_text(OWN_WALL)
    (tmp_path / "scene.yaml").write_text(
        "directives:\n- add_model: {name: s, file: slide.sdf}\n"
        "- add_weld: {parent: world, child: s::base}\n"
    )
    dynamics = SceneDynamics(read_scene(tmp_path / "scene.yaml"))
    time = np.arange(0.0, 10.0, 0.005)
    x = 0.07 * np.sin(2.0 * np.pi * 0.7 * time) + 0.05 * np.sin(2.0 * time)
    if is_struck:  # It touches at 0.08 and turns 3 mm later: a soft wall.
        x = np.minimum(x, 2.0 * 0.083 - x)
    x = x + 5e-5 * np.random.default_rng(0).normal(size=len(time))
    columns = {"time": time, "s.x.position": x, "s.y.position": 0.1 * np.sin(time)}
    write_recording(tmp_path / "log.csv", columns)
    recordings = read_recordings([tmp_path / "log.csv"])
    q = positions(dynamics, recordings[0])
    shapes = walls_of(dynamics, own=True)
    far = nearest(shapes, dynamics, q, np.inf)
    np.testing.assert_allclose(far, 0.08 - x, atol=1e-5)
    near = nearest(shapes, dynamics, q, 0.02)
    np.testing.assert_array_equal(near, np.where(far < 0.02, far, np.inf))
    assert _overlaps(dynamics, recordings) >= 3
    assert runs_against(dynamics, recordings) == is_struck
    assert bool(without_contact(dynamics, recordings)[1]) == is_struck


def _overlaps(dynamics, recordings) -> int:
    """How often the shapes overlap, by arithmetic: the wall's face is at 0.1, the
    ball's radius 0.02."""
    below = recordings[0]["s.x.position"] > 0.08
    return int(np.sum(np.diff(below.astype(int)) == 1))
