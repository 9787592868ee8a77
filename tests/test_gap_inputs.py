"""What gap refuses before it computes, and what of the scene's start it uses."""

from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import on_ground, pendulum

from makebreak.gap.data.check_drives import check_drives, check_initial_names
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.simulation.windows import WindowModel
from makebreak.gap.workflow import run_gap
from makebreak.models.scene import InitialSection, read_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts.runner.settings import one_line

N = 400


def recorded(folder, name="r.csv", **channels):
    """A recording of the pendulum p.j1, with further channels."""
    time = np.arange(N) * 0.002
    rng = np.random.default_rng(0)
    columns = {"time": time}
    columns["p.j1.position"] = 0.5 * np.cos(3.0 * time) + rng.normal(0.0, 1e-4, N)
    columns |= {key.replace("__", "."): value for key, value in channels.items()}
    rows = np.stack([np.broadcast_to(c, N) for c in columns.values()], axis=1)
    header = ",".join(columns)
    np.savetxt(folder / name, rows, delimiter=",", header=header, comments="")
    return read_recordings([folder / name])[0]


def driven(folder, **actuation):
    scene = pendulum(folder)
    act = replace(scene.actuation, type="none", joints=[], kp=[], kd=[])
    return replace(scene, actuation=replace(act, **actuation))


PD = dict(type="pd", joints=["p.j1"], kp=[10.0], kd=[1.0])
EFFORT = dict(type="effort", joints=["p.j1"])


@pytest.mark.parametrize(
    ("actuation", "channel", "words"),
    [
        ({}, "effort_command", "{type: effort, joints: [p.j1]}"),
        ({}, "effort_measured", "{type: effort, joints: [p.j1]}"),
        ({}, "position_command", "{type: servo, joints: [p.j1], kp: [KP], kd: [KD]}"),
        ({}, "velocity_command", "{type: velocity, joints: [p.j1], kd: [KD]}"),
        (PD, "effort_command", "{type: effort, joints: [p.j1]}"),
        (PD, "effort_measured", "{type: effort, joints: [p.j1]}"),
        (EFFORT, "position_command", "{type: servo, joints: [p.j1], kp"),
    ],
)
def test_a_command_that_no_drive_takes_is_refused_with_the_section_to_paste(
    tmp_path, actuation, channel, words
):
    recording = recorded(tmp_path, **{f"p.j1.{channel}": 0.1})
    with pytest.raises(ValueError) as error:
        check_drives(recording, driven(tmp_path, **actuation))
    said = str(error.value)
    assert f"`actuation: {words}" in said and f"p.j1.{channel}" in said
    assert "r.yaml" in said and "\n" not in said


@pytest.mark.parametrize(
    ("actuation", "channels"),
    [
        (EFFORT, ["effort_command"]),
        (EFFORT, ["effort_measured"]),
        (EFFORT, ["effort_command", "effort_measured"]),
        (PD, ["position_command", "velocity_command"]),
        (PD, ["position_command", "effort_measured"]),
        ({}, ["velocity"]),
    ],
)
def test_what_the_drives_take_is_not_refused(tmp_path, actuation, channels):
    recording = recorded(tmp_path, **{f"p.j1.{each}": 0.1 for each in channels})
    check_drives(recording, driven(tmp_path, **actuation))


def test_gap_refuses_such_a_command_before_it_computes(tmp_path, monkeypatch):
    recorded(tmp_path, **{"p.j1.effort_command": 0.1})
    write_scene(driven(tmp_path), tmp_path / "s.yaml")
    said = []
    with pytest.raises(ValueError, match="actuation: {type: effort, joints"):
        run_gap(tmp_path / "s.yaml", [tmp_path / "r.csv"], 1, said.append)
    assert said == []  # Not even the checks had begun.


def test_the_pasted_section_is_what_gap_needs(tmp_path):
    recording = recorded(tmp_path, **{"p.j1.effort_command": 0.1})
    path = tmp_path / "s.yaml"
    write_scene(driven(tmp_path), path)
    with pytest.raises(ValueError) as error:
        check_drives(recording, read_scene(path))
    section = str(error.value).split("`")[1]
    path.write_text(path.read_text() + section + "\n")
    check_drives(recording, read_scene(path))


def test_initial_states_of_other_recordings_are_refused(tmp_path):
    recording = recorded(tmp_path)
    scene = driven(tmp_path)
    scene.initial_of = {"r2.csv": {"0": InitialSection()}}
    with pytest.raises(ValueError) as error:
        check_initial_names(scene, [recording])
    assert "did you mean r2.csv?" in one_line(error.value)
    scene.initial_of["r.csv"] = {"0": InitialSection()}
    check_initial_names(scene, [recording])


def test_what_was_not_measured_starts_as_the_scene_says_of_that_episode(tmp_path):
    # Only where the ball is was measured; how it was turned and that it spun was not.
    scene = on_ground(tmp_path, "cube")
    body = next(iter(scene.initial.poses))
    turned = [0.6, 0.8, 0.0, 0.0]
    scene.initial_of = {
        "r": {
            "1": InitialSection(
                poses={body: [*turned, 0.0, 0.0, 1.0]},
                body_velocities={body: [0.0, 0.0, 7.0, 0.0, 0.0, 0.0]},
            )
        }
    }
    time = np.arange(100) * 0.005
    rows = []
    for episode in (0, 1):
        z = 1.0 + 0.2 * time - 9.81 * time**2 / 2.0
        rows.append(np.stack([time, np.full(100, episode), 0 * z, 0 * z, z], axis=1))
    header = ",".join(["time", "episode", *(f"{body}.{a}" for a in "xyz")])
    np.savetxt(
        tmp_path / "r.csv", np.concatenate(rows), delimiter=",", header=header,
        comments="",
    )  # fmt: skip
    recordings = read_recordings([tmp_path / "r.csv"])
    model = WindowModel(scene, recordings, 0.1)
    first = min(w.rows.start for w in model.windows if w.episode == 1)
    for w in model.windows:
        episode = next(e for e in recordings[0].episodes if e.number == w.episode)
        state = model._initial(w, episode, ())
        expected = turned if w.episode == 1 else scene.initial.poses[body][:4]
        np.testing.assert_allclose(state.poses[body][:4], expected, atol=1e-12)
        spins = w.episode == 1 and w.rows.start == first
        assert state.body_velocities[body][2] == (7.0 if spins else 0.0)
    assert {w.episode for w in model.windows} == {0, 1}
