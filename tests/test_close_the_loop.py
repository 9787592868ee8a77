"""What the loop from a run over its recording to a repaired model rests on."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from effect_scenes import on_ground
from pydrake.systems.framework import DiagramBuilder

from makebreak import model_path
from makebreak.benchmarks import loop_trials
from makebreak.diagrams.ball_rolling_config import BallRollingConfig, controller_model
from makebreak.diagrams.recorder import mean_until_next
from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import BALL_ROLLING
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.simulation.scene_simulation import SceneSimulation
from makebreak.gap.simulation.windows import WindowModel
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import InitialSection, load_scene, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.cli import main
from makebreak.scripts.runner import close_contact_loop as contact_loop
from makebreak.scripts.runner import close_the_loop as loop
from makebreak.scripts.runner.close_the_loop import write_wrong_scene


@pytest.mark.parametrize("radius", [0.0265, 0.0365])
def test_a_ball_is_put_down_on_its_radius_and_rolls(tmp_path, radius):
    size = Effect("object_size", ["b"], {"radius": radius})
    scene = replace(on_ground(tmp_path, "ball"), effects=[size])
    simulation = SceneSimulation(scene)
    start = InitialSection(
        poses={"b.ball": [1, 0, 0, 0, 0.1, -0.2, 0.0315]},
        body_velocities={"b.ball": [0, 0, 9.0, 0.06, -0.08, 0.0]},
    )
    put = simulation.put_down(start, "b.ball")
    np.testing.assert_allclose(
        put.poses["b.ball"], [1, 0, 0, 0, 0.1, -0.2, radius], atol=1e-9
    )
    # No slip where it touches: v + w x (0, 0, -r) = 0.
    w, v = np.split(np.array(put.body_velocities["b.ball"]), 2)
    np.testing.assert_allclose(v + np.cross(w, [0, 0, -radius]), 0.0, atol=1e-12)
    assert start.poses["b.ball"][6] == 0.0315  # The caller's is as it was.


def test_windows_of_a_ball_without_a_height_tell_its_radius(tmp_path):
    """Put down and rolling, it spins as fast as its radius says."""
    scene = on_ground(tmp_path, "ball")
    size = Effect("object_size", ["b.ball"], {"radius": 0.0365})
    time = np.arange(200) * 0.01
    start = InitialSection(
        poses={"b.ball": [1, 0, 0, 0, 0.0, 0.0, 0.0365]},
        body_velocities={"b.ball": [0, 0.2 / 0.0365, 0, 0.2, 0, 0]},
    )
    world = SceneSimulation(replace(scene, effects=[size]))
    x, wy = world.run(start, time, ["b.ball.x", "b.ball.wy"]).T
    rng = np.random.default_rng(0)
    columns = {"time": time, "b.ball.x": x + 1e-4 * rng.normal(size=200)}
    columns["b.ball.y"] = 1e-4 * rng.normal(size=200)
    columns["b.ball.wy"] = wy + 1e-2 * rng.normal(size=200)
    write_recording(tmp_path / "run.csv", columns)
    model = WindowModel(scene, read_recordings([tmp_path / "run.csv"]), 0.3)
    right = np.sqrt(np.mean(model.residual([size]) ** 2))
    wrong = np.sqrt(np.mean(model.residual() ** 2))
    # Its spin is v/r: 0.86 rad/s less than the smaller ball's, 86 times the noise.
    assert right < 1.5 and wrong > 30.0


def test_a_ball_with_nothing_below_it_and_one_without_a_pose_are_refused(tmp_path):
    simulation = SceneSimulation(on_ground(tmp_path, "ball"))
    below = InitialSection(poses={"b.ball": [1, 0, 0, 0, 0.1, -0.2, -0.5]})
    with pytest.raises(ValueError, match="nothing fixed is below 'b.ball'"):
        simulation.put_down(below, "b.ball")
    with pytest.raises(ValueError, match="no initial pose of 'b.ball'"):
        simulation.put_down(InitialSection(), "b.ball")


def test_a_command_of_a_slow_row_is_the_mean_of_the_fast_ones_until_the_next():
    """At 1 kHz 0, 1, 2, ..., and rows at 0, 2.5 and 5 ms: what holds from a row on is
    counted from the first step at or after it."""
    fine_time = np.arange(10) * 1e-3
    fine = np.column_stack([np.arange(10.0), -np.arange(10.0)])
    got = mean_until_next(np.array([0.0, 2.5e-3, 5e-3]), fine_time, fine)
    np.testing.assert_allclose(got, [[1.0, -1.0], [3.5, -3.5], [5.0, -5.0]])


@pytest.mark.parametrize("error", [-0.005, 0.008])
def test_the_wrong_scene_is_wrong_in_the_radius_alone(tmp_path, error):
    right, wrong = write_wrong_scene(tmp_path / "model.yaml", error)
    assert (right, wrong) == (0.0315, pytest.approx(0.0315 + error))
    loaded = load_scene(tmp_path / "model.yaml", DiagramBuilder())
    assert sphere_radius(loaded.plant, loaded.scene_graph, "ball") == pytest.approx(
        wrong
    )
    as_shipped = load_scene(BALL_ROLLING, DiagramBuilder())
    for one, other in ((loaded.scene, as_shipped.scene),):
        assert one.plant == other.plant and one.actuation == other.actuation
        assert one.initial.positions == other.initial.positions
    # What a controller believes of it, with no further error.
    config = BallRollingConfig(model=str(tmp_path / "model.yaml"), radius_error_m=0.0)
    assert controller_model(config)[0].ball_radius == pytest.approx(wrong)


def test_a_repair_added_to_the_wrong_scene_is_what_controllers_believe(tmp_path):
    """As the workflow writes it. All of the ball is then right again."""
    write_wrong_scene(tmp_path / "model.yaml", 0.005)
    scene = read_scene(tmp_path / "model.yaml")
    fixed = Effect("object_size", ["ball.ball"], {"radius": 0.0315})
    scene.effects.append(fixed)
    write_scene(scene, tmp_path / "fixed.yaml")
    config = BallRollingConfig(model=str(tmp_path / "fixed.yaml"), radius_error_m=0.0)
    assert controller_model(config)[0].ball_radius == pytest.approx(0.0315)
    bodies = [
        load_scene(s, DiagramBuilder()).plant.GetBodyByName("ball")
        for s in (tmp_path / "fixed.yaml", BALL_ROLLING)
    ]
    one, other = (b.default_spatial_inertia().CopyToFullMatrix6() for b in bodies)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)


def test_a_radius_below_zero_is_refused(tmp_path):
    with pytest.raises(ValueError, match="--radius-error is -0.04, expected > -0.0315"):
        write_wrong_scene(tmp_path / "model.yaml", -0.04)


@pytest.fixture
def steps(monkeypatch, tmp_path):
    """Steps that write what the real ones would, and the words that each was given."""
    monkeypatch.chdir(tmp_path)
    asked: list[list[str]] = []

    def run_commands(label, commands, folders, jobs):
        [words], [folder] = commands, folders
        asked.append(words)
        folder.mkdir(parents=True)
        if "gap" in words:
            scene = read_scene(words[words.index("gap") + 1])
            fixed = Effect("object_size", ["ball.ball"], {"radius": 0.0316})
            scene.effects.append(fixed)
            write_scene(scene, folder / "scene.yaml")
            return [{"effects": [{"kind": "object_size"}], "says": "It is smaller."}]
        contact = 3.0 if label.startswith("1") else 0.7
        gap = 0.0102 if label.startswith("1") else steps_gap[0]
        result = dict.fromkeys(loop._SHOWN, 1.0)
        return [result | {"time_to_first_contact_s": contact, "r_gap_error_m": gap}]

    steps_gap = [1e-4]
    monkeypatch.setattr(loop, "run_commands", run_commands)
    return asked, steps_gap


def test_the_loop_passes_nothing_on_but_recording_and_scenes(steps, capsys):
    words = ["--radius-error", "0.005", "--seed", "3", "--set", "friction=0.2"]
    assert main(["close-the-loop", "ball_rolling", *words, "--out", "out"]) == 0
    first, gap, second = ([w for w in words if w[0] != "/"] for words in steps[0])
    wrong, found = "out/0_model/model.yaml", "out/2_gap/scene.yaml"
    # Files are named as seen from where the scene lies in the end.
    file = Path(model_path("panda.urdf")).resolve()
    panda = os.path.relpath(file, Path("out/0_model").resolve())
    scene_file = Path(wrong).read_text()
    assert f"file: {panda}" in scene_file and "file: ball.sdf" in scene_file
    assert [gap[k] for k in range(gap.index("gap") + 1, gap.index("--jobs"))] == [
        wrong,
        "out/1_wrong_model/recording.csv",
    ]
    for run, model in ((first, wrong), (second, found)):
        assert run[run.index("--model") + 1] == model
        assert run[run.index("--seed") + 1] == "3"
        assert run[run.index("--set") + 1 :][:2] == ["radius_error_m=0", "friction=0.2"]
    shown = capsys.readouterr().out
    assert "radius in the model [mm]  36.5         31.6" in shown
    assert json.loads(Path("out/loop.json").read_text())["gap"]["says"]


def test_a_repair_that_misses_what_is_wanted_is_status_1(steps, capsys):
    steps[1][0] = -2e-3
    assert main(["close-the-loop", "--out", "out"]) == 1
    assert "MISSED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "a_file"], '--out: got "a_file", expected a folder'),
        (["--radius-error", "nan"], '--radius-error: got "nan", expected a number'),
        (["--radius-error=-1"], "--radius-error is -1.0, expected > -0.0315"),
        (["cartpole_walls"], "cartpole_walls cannot yet be given a wrong model"),
        (["ball_rollin"], "unknown experiment ball_rollin; did you mean ball_rolling?"),
        (["--set", "nois=1"], "--set: unknown key nois"),
        (["contact_learning", "--duration", "9"], "contact_learning ends by itself"),
        (["--duration", "0"], '--duration: got "0", expected a number above 0'),
        (["--dur", "1"], "unknown option --dur; did you mean --duration?"),
    ],
)
def test_bad_input_of_the_loop_is_one_line(steps, words, message, capsys):
    Path("a_file").touch()
    before = set(Path(".").rglob("*"))
    assert main(["close-the-loop", *words]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert set(Path(".").rglob("*")) == before and not steps[0]


def valued(**parameters) -> dict:
    return {name: {"value": x} for name, x in parameters.items()}


def test_what_is_said_of_a_plates_friction_is_that_of_the_last_patch_there():
    effects = [
        {"kind": "friction_patch", "at": ["p~t"],
         "parameters": valued(friction=0.2, x_min=0, x_max=1, y_min=0, y_max=1)},
        {"kind": "contact_friction", "at": ["p~t"], "parameters": valued(friction=0.5)},
        {"kind": "friction_patch", "at": ["p~t"],
         "parameters": valued(friction=0.1, x_min=0.5, x_max=2, y_min=0, y_max=1)},
    ]  # fmt: skip
    found = [contact_loop.friction_at(effects, (x, 0.5), 0.3) for x in (-1, 0.2, 0.7)]
    assert found == [0.5, 0.2, 0.1]
    assert contact_loop.friction_at([], (0, 0), 0.3) == 0.3


def test_a_displacement_is_the_sum_of_what_moves_a_model_along_an_axis():
    effects = [
        {"kind": "wall_position", "at": "red.red", "parameters": valued(y=0.02)},
        {"kind": "plane_height", "at": ["table.top"], "parameters": valued(height=0.1)},
    ]
    for model, axis, by in (
        ("red", "y", 0.02), ("red", "x", 0.0), ("table", "z", 0.1), ("table", "x", 0.0),
        ("blue", "x", 0.0),
    ):  # fmt: skip
        assert contact_loop.displacement(effects, model, axis) == by


@pytest.mark.parametrize(
    ("experiment", "forces", "good"),
    [
        ("contact_learning", [7.4, 8.6], True), ("contact_learning", [7.3, 8], False),
        ("contact_learning", [8, 8.7], False), ("contact_learning", [8, np.nan], False),
        ("multiple_collisions", [5.0, 8.0], True),
        ("multiple_collisions", [7.0, 8.1], False),
        ("multiple_collisions", [np.nan, 7.0], False),
    ],
)  # fmt: skip
def test_impacts_after_the_repair_meet_the_goal_of_their_experiment(
    experiment, forces, good
):
    rows: list[tuple] = []
    goal = contact_loop.FORCES[experiment]
    contact_loop._first_trial(
        lambda *row: rows.append(row), "impact_force_peak_N", [90, 90], forces, goal
    )
    assert [row[-1] for row in rows] == [good]


def test_the_contact_loop_passes_nothing_on_but_recording_and_scenes(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.chdir(tmp_path)
    asked: list[list[str]] = []
    config = contact_loop.apply_settings(
        contact_loop.CONFIGS["contact_learning"](), contact_loop.WALLS
    )
    task = contact_loop.contact_learning.make_task(replace(config, seed=3))
    where = {
        name: contact_loop.position(task.world, name)
        - contact_loop.position(task.model, name)
        for name in ("table", "red_block", "blue_wall")
    }
    off = [0.0]

    def run_commands(label, commands, folders, jobs):
        [words], [folder] = commands, folders
        asked.append(words)
        folder.mkdir(parents=True)
        if "gap" in words:
            said = [("wall_position", n, a, where[n]["xyz".index(a)] + off[0])
                    for n, a in (("red_block", "y"), ("blue_wall", "x"))]  # fmt: skip
            said.append(("plane_height", "table", "height", where["table"][2]))
            effects = [{"kind": k, "at": f"{n}.{n}", "parameters": valued(**{a: x})}
                       for k, n, a, x in said]  # fmt: skip
            return [{"effects": effects, "says": "They stand elsewhere."}]
        first = label.startswith("1")
        force = [31.0, 8.0] if first else [8.3]
        result = {f"impact_force_peak_N_contact_{i}": force for i in (1, 2, 3)}
        return [result | {"completion_time_s": [9.0, 6.0] if first else [6.1]}]

    monkeypatch.setattr(loop, "run_commands", run_commands)
    words = ["close-the-loop", "contact_learning", "--seed", "3", "--out"]
    assert main([*words, "out"]) == 0
    first, gap, second = asked
    assert gap[gap.index("gap") + 1 : gap.index("--jobs")] == [
        "out/1_wrong_model/model.yaml", "out/1_wrong_model/recording.csv",
    ]  # fmt: skip
    assert "--model" not in first
    assert second[second.index("--model") + 1] == "out/2_gap/scene.yaml"
    for run in (first, second):
        assert run[run.index("--seed") + 1] == "3" and "spread=0.03" in run
    assert "31.00" in capsys.readouterr().out
    off[0] = 6e-4
    assert main([*words, "again"]) == 1
    assert "MISSED" in capsys.readouterr().out


def _loop(moved: float, met: bool) -> dict:
    """result.json of a loop that displaces the table by `moved` [mm]."""
    rows = [
        {"result": "effects named", "wrong model": "", "repaired model": "plane_height",
         "wanted": ""},
        {"result": "table [mm]", "wrong model": 0.0, "repaired model": moved,
         "wanted": f"{moved} +- 0.5", "met": met},
    ]  # fmt: skip
    return {"success": met, "rows": rows}


def test_the_table_of_loops_counts_seeds_and_a_trial_without_a_result_meets_nothing():
    results = [_loop(2.0, True), _loop(-3.0, False), {"success": False, "error": "x"}]
    (named, table), whole = (
        loop_trials.rows_of("contact_learning", results),
        loop_trials.rows_of("contact_learning", [_loop(2.0, True)]),
    )
    assert named == (
        ("contact_learning: effects named", "", "plane_height", "", ""),
        None,
    )
    cells, met = table
    assert cells == (
        "contact_learning: table [mm]",
        "0",
        "-3 to 2",
        "by seed",
        "1 of 3",
    )
    assert met is False
    assert whole[1][0][3:] == ("2.0 +- 0.5", "1 of 1") and whole[1][1] is True
    [(cells, met)] = loop_trials.rows_of("ball_rolling", [{"error": "x"}])
    assert cells[-1] == "0 of 1" and met is False


def test_reproduce_closes_each_loop_with_each_seed(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    asked = []

    def run_commands(label, commands, folders, jobs, is_done):
        asked.extend(commands)
        return [_loop(1.0, True) for _ in commands]

    monkeypatch.setattr(loop_trials, "run_commands", run_commands)
    words = ["reproduce", "close_the_loop", "--seeds", "2", "--seed", "7", "--out", "o"]
    assert main([*words, "--only", "ball"]) == 0
    assert len(asked) == 4 and len({tuple(words) for words in asked}) == 4
    errors = {word for words in asked for word in words if "radius" in word}
    assert errors == {"--radius-error=+0.005", "--radius-error=-0.005"}
    assert {words[words.index("--seed") + 1] for words in asked} == {"7", "8"}
    assert "2 of 2" in capsys.readouterr().out
    assert main(["reproduce", "close_the_loop", "--only", "no_such_loop"]) == 2
    assert "--only: got no_such_loop" in capsys.readouterr().err
