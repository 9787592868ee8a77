"""What a scene's windows are off by, in the channels' own units."""

import json

import numpy as np
import pytest
from effect_scenes import double, pendulum, with_effects
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.simulation.judge import judge
from makebreak.models.scene import load_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.cli import commands as cli

PUSH = 1.2  # [rad/s2] of the measured joint, that the scene lacks.
WINDOW = 0.5


@pytest.fixture
def case(tmp_path):
    """A joint that nothing acts on in its scene, and that in truth is pushed."""
    scene = pendulum(tmp_path, gravity=0.0)
    write_scene(scene, tmp_path / "scene.yaml")
    rng = np.random.default_rng(0)
    time = np.arange(1001) * 0.01
    position = 0.5 * PUSH * time**2 + 1e-4 * rng.normal(size=len(time))
    columns = {"time": time, "p.j1.position": position}
    write_recording(tmp_path / "run.csv", columns)
    return scene, tmp_path / "scene.yaml", tmp_path / "run.csv"


def test_a_push_that_the_scene_lacks_is_half_its_square_of_time(case):
    scene, _, recording = case
    [found] = judge(scene, read_recordings([recording]), WINDOW)
    # The scene goes straight on: off by a t^2/2, of which the rms over a window is
    # a T^2/2/sqrt(5). A start is known to some 1e-3 rad/s, and so to 1e-3 of that.
    expected = 0.5 * PUSH * WINDOW**2 / np.sqrt(5.0)
    assert found.channel == "p.j1.position" and found.unit == "rad"
    np.testing.assert_allclose(found.rms, expected, rtol=0.03)
    # And at its end by a T^2/2; the last of the samples lies at T.
    np.testing.assert_allclose(found.at_end, 0.5 * PUSH * WINDOW**2, rtol=0.03)
    assert found.n_windows == 20 and found.failed == 0.0


def test_a_scene_with_the_push_is_off_by_the_noise(case):
    scene, _, recording = case
    inertia = _inertia(scene)
    push = with_effects(
        scene, ("actuator_bias", "p.j1", {"bias": float(PUSH * inertia)})
    )
    [found] = judge(push, read_recordings([recording]), WINDOW)
    # The noise is 1e-4, and a start's speed is off by some 1e-3 rad/s; without the push
    # it is 0.067 rad.
    assert found.rms < 5e-4


def test_positions_of_several_joints_are_told_together(tmp_path):
    scene = double(tmp_path)
    time = np.arange(401) * 0.01
    measured = {"time": time, "d.j1.position": 0.3 + 0.0 * time,
                "d.j2.position": 0.1 + 0.0 * time}  # fmt: skip
    write_recording(tmp_path / "run.csv", measured)
    *each, both = judge(scene, read_recordings([tmp_path / "run.csv"]), WINDOW)
    assert both.channel == "all positions" and len(each) == 2
    for name in ("rms", "at_end"):
        wanted = np.hypot(*(getattr(j, name) for j in each)) / np.sqrt(2.0)
        np.testing.assert_allclose(getattr(both, name), wanted)


def _inertia(scene) -> float:
    plant = load_scene(scene, DiagramBuilder()).plant
    return plant.CalcMassMatrix(plant.CreateDefaultContext())[0, 0]


def test_the_command_tells_a_column_for_each_scene(case, capsys):
    _, scene, recording = case
    words = ["judge", str(scene), str(scene), "--on", str(recording)]
    assert cli.main([*words, "--window", "0.5", "--json"]) == 0
    told = capsys.readouterr()
    [table] = json.loads(told.out)["tables"]
    rows = [line for line in told.err.splitlines() if line.startswith("p.j1.position")]
    for row, written in zip(rows, table["rows"], strict=True):
        assert row.split().count(f"{written[str(scene)]:.4g}") == 2
    assert "0.5 s ahead" in rows[0] and " all " in rows[1]
    assert "20 windows of 0.5 s of 1 recording;" in table["notes"][0]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["no.yaml", "--on", "run.csv"], "no.yaml"),
        (["scene.yaml", "--on", "none.csv"], "none.csv"),
        (
            ["scene.yaml", "--on", "run.csv", "--window", "-1"],
            '"-1", expected a number',
        ),
        (["scene.yaml", "--on", "run.csv", "--window", "99"], "no episode"),
    ],
)
def test_bad_input_is_one_line_and_status_2(case, words, says, monkeypatch, capsys):
    monkeypatch.chdir(case[1].parent)
    assert cli.main(["judge", *words]) == 2
    shown = capsys.readouterr().err
    assert says in shown and shown.count("\n") == 1, shown


def test_columns_are_known_from_another_log_of_the_robot_or_as_they_are_told(
    case, tmp_path, monkeypatch, capsys
):
    """Monday's sidecar is in the folder of the scene, as `gap` leaves it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "monday").mkdir()
    write_scene(case[0], tmp_path / "monday" / "scene.yaml")
    text = case[2].read_text().replace("p.j1.position", "angle")
    (tmp_path / "friday.csv").write_text(text)
    columns = "columns: {angle: p.j1.position}\n"
    words = ["judge", "monday/scene.yaml", "--on", "friday.csv", "--window", "0.5"]
    assert cli.main(words) == 2
    assert "angle" in capsys.readouterr().err
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "told.yaml").write_text(columns)
    assert cli.main([*words, "--sidecar", "elsewhere/told.yaml"]) == 0
    told = capsys.readouterr().out
    (tmp_path / "monday" / "monday.yaml").write_text(columns)
    assert cli.main(words) == 0
    assert capsys.readouterr().out == told and "p.j1.position" in told
