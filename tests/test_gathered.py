"""Files of one log in one command: joined by their times, the rest is proposed."""

from pathlib import Path

import numpy as np
import pytest
from front_doors import csv_of, exact

from makebreak.gap.data.gathered import read_logs
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.recording_files import recording_files
from makebreak.gap.data.robot import propose_scene, read_robot
from makebreak.scripts.cli import main

TAU = "arm.joint{}.effort_measured"


def robot_and_log(folder: Path):
    path, log = exact("three", folder, np.random.default_rng(3))
    states = {"time": log.time} | {
        name: y for name, y in log.columns.items() if "effort" not in name
    }
    t = np.arange(0.0031, 11.9, 0.004)
    efforts = [np.interp(t, log.time, log.truth[TAU.format(i)]) for i in (1, 2, 3)]
    return read_robot(path), states, t, efforts


def proposed(robot, folder: Path):
    """The one recording that files are, by what is proposed; and all that is said."""
    (log,) = read_logs(recording_files([str(folder / "log")]), robot)
    proposal = propose_scene(robot, [log])
    sidecar = folder / "proposed.yaml"
    sidecar.write_text(proposal.sidecars[log.path])
    (recording,) = read_recordings([log.path], sidecars={log.path: sidecar})
    return recording, proposal.notes


@pytest.mark.parametrize(
    "files, stamp, scale",
    [
        (("joint_states.csv", "commands.csv"), "stamp_ns", 1e9),
        (("b.csv", "a.csv"), "t [ms]", 1e3),
    ],
)
def test_states_and_efforts_of_two_files_are_one_log(tmp_path, files, stamp, scale):
    """Other stamps, rates, names and a unit of time; a folder that holds both."""
    robot, states, t, efforts = robot_and_log(tmp_path)
    (tmp_path / "log").mkdir()
    csv_of(tmp_path / "log" / files[0], states)
    own = {stamp: scale * t} | {f"tau_{i}": y for i, y in enumerate(efforts)}
    csv_of(tmp_path / "log" / files[1], own)
    recording, notes = proposed(robot, tmp_path)
    says = f"{files[1]} is joined to {files[0]} by their times: one log"
    assert says in notes
    for i, y in enumerate(efforts, start=1):
        mine, there = recording[TAU.format(i)], ~np.isnan(recording[TAU.format(i)])
        np.testing.assert_allclose(mine[there], y, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(recording.time[there], t, atol=1e-6)
        assert np.isfinite(recording[f"arm.joint{i}.position"]).sum() == 1200


def test_a_files_name_says_what_its_columns_are(tmp_path):
    """positions.csv and torques.csv have the same columns."""
    robot, states, t, efforts = robot_and_log(tmp_path)
    (tmp_path / "log").mkdir()
    q = {f"joint{i}": states[f"joint{i}_position"] for i in (1, 2, 3)}
    csv_of(tmp_path / "log" / "positions.csv", {"time": states["time"]} | q)
    own = {"time": t} | {f"joint{i}": y for i, y in enumerate(efforts, start=1)}
    csv_of(tmp_path / "log" / "torques.csv", own)
    recording, _ = proposed(robot, tmp_path)
    mine = recording["arm.joint2.effort_measured"]
    np.testing.assert_allclose(mine[~np.isnan(mine)], efforts[1], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        recording["arm.joint2.position"][~np.isnan(recording["arm.joint2.position"])],
        q["joint2"], atol=1e-6,
    )  # fmt: skip


def test_files_that_tell_nothing_of_the_robot_are_left_out_and_said(tmp_path):
    """A log of events, names of joints, and what cannot be read, in a log's folder."""
    robot, states, _, _ = robot_and_log(tmp_path)
    (tmp_path / "log").mkdir()
    csv_of(tmp_path / "log" / "states.csv", states)
    events = "type,timestamp,event\nEVENT,0,ENABLE\nEVENT,5.0,START\n"
    (tmp_path / "log" / "events.csv").write_text(events)
    (tmp_path / "log" / "joints.txt").write_text("Rotation\nPitch\nElbow\n")
    (tmp_path / "log" / "empty.csv").touch()
    recording, notes = proposed(robot, tmp_path)
    assert len(recording.time) == 1200
    for name in ("events.csv", "joints.txt"):
        assert f"{name} is left out: no column is of the robot" in notes
    assert any(n.startswith("empty.csv is left out: recording ") for n in notes)
    with pytest.raises(ValueError, match="is empty"):
        read_logs([tmp_path / "log" / "empty.csv"], robot)


@pytest.mark.parametrize("below", [True, False])
def test_a_file_of_times_alone_is_the_clock_of_those_with_its_rows(tmp_path, below):
    """Number by number, one below the other, or a row for each instant; no names."""
    path, log = exact("three", tmp_path, np.random.default_rng(3))
    (tmp_path / "log").mkdir()
    np.savetxt(tmp_path / "log" / "run_time.txt", log.time)
    for word, what in (("positions", "position"), ("torques", "effort")):
        y = np.stack([log.columns[f"joint{i}_{what}"] for i in (1, 2, 3)], axis=1)
        name = tmp_path / "log" / f"run_{word}.txt"
        np.savetxt(name, y.reshape(-1) if below else y)
    recording, notes = proposed(read_robot(path), tmp_path)
    assert "run_torques.txt is joined to run_time.txt row by row: one log" in notes
    np.testing.assert_allclose(recording.time, log.time)
    for i in (1, 2, 3):
        for what, ours in (("position", "position"), ("effort", "effort_measured")):
            logged = log.columns[f"joint{i}_{what}"]
            np.testing.assert_allclose(recording[f"arm.joint{i}.{ours}"], logged)


def test_two_runs_of_one_robot_stay_two_recordings(tmp_path):
    robot, states, _, _ = robot_and_log(tmp_path)
    for name in ("run_command_1.csv", "run_command_2.csv"):
        csv_of(tmp_path / name, states)
    files = recording_files([str(tmp_path)])
    assert [log.path for log in read_logs(files, robot)] == files


def test_files_without_a_common_clock_are_refused_with_both_times(tmp_path):
    robot, states, t, efforts = robot_and_log(tmp_path)
    csv_of(tmp_path / "states.csv", states)
    own = {"t": 1.7e9 + t} | {f"tau_{i}": y for i, y in enumerate(efforts)}
    csv_of(tmp_path / "commands.csv", own)
    files = recording_files([str(tmp_path / "states.csv"), str(tmp_path)])
    with pytest.raises(ValueError, match=r"commands.csv has no .* 1700000000.* 0 to"):
        read_logs(files, robot)


def test_inspect_shows_files_of_one_log_as_one(tmp_path, capsys):
    _, states, t, efforts = robot_and_log(tmp_path)
    csv_of(tmp_path / "states.csv", states)
    own = {"t": t} | {f"tau_{i}": y for i, y in enumerate(efforts)}
    csv_of(tmp_path / "efforts.csv", own)
    assert main(["inspect", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "efforts.csv is joined to states.csv" in shown
    assert "join:" in shown and "arm.joint3.effort_measured" in shown


def gains(robot, folder):
    (log,) = read_logs(recording_files([str(folder)]), robot)
    scene = propose_scene(robot, [log]).scene
    kp = next(line for line in scene.splitlines() if line.startswith("  kp:"))
    return [float(x) for x in kp.split("[")[1].split("]")[0].split(",")]


def test_servo_gains_are_those_of_commands_in_one_file(tmp_path):
    """Servos whose commands come at other times than the states."""
    robot, states, t, _ = robot_and_log(tmp_path)
    _, log = exact("three", tmp_path, np.random.default_rng(3))
    told = {}
    for i in (1, 2, 3):
        q, v, tau = (log.truth[f"arm.joint{i}.{w}"]
                     for w in ("position", "velocity", "effort_measured"))  # fmt: skip
        told[f"q_des_{i}"] = q + (tau + 4.0 * v) / 80.0
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    csv_of(tmp_path / "one" / "log.csv", states | told)
    csv_of(tmp_path / "two" / "states.csv", states)
    later = {k: np.interp(t + 0.002, log.time, y) for k, y in told.items()}
    csv_of(tmp_path / "two" / "commands.csv", {"t": t} | later)
    one, two = (gains(robot, tmp_path / name) for name in ("one", "two"))
    np.testing.assert_allclose(one[:2], 80.0, rtol=0.1)
    np.testing.assert_allclose(two, one, rtol=0.1)


def test_rows_without_a_time_are_spaced_by_the_rate_that_a_sidecar_says(
    tmp_path, capsys
):
    """Positions and efforts in files of their own, each without a time."""
    (tmp_path / "log").mkdir()
    files = [tmp_path / "log" / name for name in ("positions.csv", "efforts.csv")]
    path, log = exact("three", tmp_path, np.random.default_rng(3))
    robot = read_robot(path)
    for file, what in zip(files, ("position", "effort"), strict=True):
        own = {f"joint{i}": log.columns[f"joint{i}_{what}"] for i in (1, 2, 3)}
        csv_of(file, own)
    assert main(["gap", str(path), *map(str, files), "--out", str(tmp_path / "o")]) == 2
    assert "rate_hz: 100" in capsys.readouterr().err
    (tmp_path / "log" / "positions.yaml").write_text("rate_hz: 100\n")
    recording, notes = proposed(robot, tmp_path)
    assert "efforts.csv is joined to positions.csv row by row: one log" in notes
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(len(log.time)))
    for i in (1, 2, 3):
        for what, ours in (("position", "position"), ("effort", "effort_measured")):
            logged = log.columns[f"joint{i}_{what}"]
            np.testing.assert_allclose(recording[f"arm.joint{i}.{ours}"], logged)
    (tmp_path / "log" / "positions.yaml").write_text("rate_hz: 0\n")
    with pytest.raises(ValueError, match="rate_hz is 0, expected rows per second"):
        proposed(robot, tmp_path)
