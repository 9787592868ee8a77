"""Logs as MCAP: read back by another library, their times and values are the log's."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from effect_scenes import double, on_ground
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Mesh,
    Sphere,
)
from pydrake.systems.framework import DiagramBuilder

from makebreak.gap.data.bags import read_bag
from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.table import write_recording
from makebreak.gap.report.mcap_file import (
    _primitives,
    motions_of,
    write_mcap,
    write_rrd,
)
from makebreak.models.meshes import write_obj
from makebreak.models.scene import load_scene
from makebreak.models.scene_file import write_scene
from makebreak.scripts import cli

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")
mcap_reader = pytest.importorskip("mcap.reader")
mcap_ros2 = pytest.importorskip("mcap_ros2.decoder")

TIME = 1_700_000_000.25 + 0.004 * np.arange(60)
Q = np.column_stack([np.sin(3.0 * TIME), np.cos(2.0 * TIME)])


def messages(path):
    """{topic: ((n,) times [ns], [message])}, by the format's own library."""
    found = {}
    with open(path, "rb") as file:
        reader = mcap_reader.make_reader(
            file, decoder_factories=[mcap_ros2.DecoderFactory()]
        )
        for _, channel, message, decoded in reader.iter_decoded_messages():
            times, all_of = found.setdefault(channel.topic, ([], []))
            times.append(message.log_time)
            all_of.append(decoded)
    return found


def arm_log(folder, episodes=False):
    """Two joints at 250 Hz, the second one measured every other row."""
    slow = np.where(np.arange(len(TIME)) % 2, np.nan, Q[:, 1])
    columns = {
        "time": TIME,
        "d.j1.position": Q[:, 0],
        "d.j2.position": slow,
        "d.j1.velocity": 3.0 * Q[:, 0],
        "d.j1.effort_measured": 5.0 * Q[:, 0],
        "d.j2.effort_command": 7.0 * Q[:, 1],
    }
    if episodes:  # Each begins at the same time.
        half = len(TIME) // 2
        columns["time"] = np.tile(TIME[:half], 2)
        columns["episode"] = np.repeat([0, 1], half)
    write_recording(folder / "log.csv", columns)
    return folder / "log.csv", columns


def test_times_and_values_are_those_of_the_log(tmp_path):
    log, columns = arm_log(tmp_path)
    scene = double(tmp_path)
    write_scene(scene, tmp_path / "scene.yaml")
    words = [str(tmp_path / "scene.yaml"), str(log), "--out", str(tmp_path / "out")]
    assert cli.main(["convert", *words, "--quiet"]) == 0
    found = messages(tmp_path / "out" / "log.mcap")
    assert sorted(found) == ["/joint_commands", "/joint_states", "/shapes", "/tf"]

    times, states = found["/joint_states"]
    # A float's spacing at 1.7e9 s is 0.24 us.
    np.testing.assert_allclose(1e-9 * np.array(times), TIME, rtol=0, atol=3e-7)
    assert all(each.name == ["j1", "j2"] for each in states)
    for name, values in (
        ("position", [columns["d.j1.position"], columns["d.j2.position"]]),
        ("velocity", [columns["d.j1.velocity"], np.full(len(TIME), np.nan)]),
        ("effort", [columns["d.j1.effort_measured"], np.full(len(TIME), np.nan)]),
    ):
        got = np.array([getattr(each, name) for each in states])
        np.testing.assert_array_equal(got, np.transpose(values))
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in states]
    assert stamps == times
    _, commands = found["/joint_commands"]
    assert commands[0].name == ["j2"]
    np.testing.assert_array_equal(
        [m.effort[0] for m in commands], columns["d.j2.effort_command"]
    )


def test_bodies_are_where_the_joints_put_them_and_shapes_go_with_them(tmp_path):
    log, _ = arm_log(tmp_path)
    loaded = load_scene(double(tmp_path), DiagramBuilder())
    assert (
        write_mcap(
            tmp_path / "m", motions_of(read_recording(log)), {"measured": loaded}
        )
        == []
    )
    found = messages(tmp_path / "m")
    times, poses = found["/tf"]
    assert np.diff(times).min() >= 0.01e9 - 1e3  # 100 Hz, of a log at 250 Hz.
    plant = loaded.plant
    context = plant.CreateDefaultContext()
    k = len(poses) // 2
    row = int(np.argmin(abs(TIME - 1e-9 * times[k])))
    slow = np.interp(TIME[row], TIME[::2], Q[::2, 1])
    plant.SetPositions(context, [Q[row, 0], slow])
    frames = {t.child_frame_id: t.transform for t in poses[k].transforms}
    for body in ("upper", "lower"):
        X = plant.GetBodyByName(body).EvalPoseInWorld(context)
        got = frames[f"d/{body}"]
        at, turn = got.translation, got.rotation
        np.testing.assert_allclose([at.x, at.y, at.z], X.translation(), atol=1e-12)
        wxyz = X.rotation().ToQuaternion().wxyz()
        np.testing.assert_allclose([turn.w, turn.x, turn.y, turn.z], wxyz, atol=1e-12)
    (shapes,) = found["/shapes"][1]
    assert {m.header.frame_id for m in shapes.markers} <= {"world", *frames}
    assert shapes.markers and all(m.frame_locked for m in shapes.markers)


def signed_volume(corners):
    """Of closed triangles (3 n, 3) that all face outwards [m3]."""
    a, b, c = corners.reshape(-1, 3, 3).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def test_each_kind_of_shape_is_drawn_in_its_size(tmp_path):
    wedge = write_obj(
        np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]]),
        np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    )
    for shape in (Mesh(str(wedge), 0.5), Convex(str(wedge), 0.5)):
        ((kind, _, scale, corners),) = _primitives(shape)
        assert kind == "TRIANGLE_LIST" and list(scale) == [1.0, 1.0, 1.0]
        np.testing.assert_allclose(corners.max(axis=0), [0.5, 1.0, 1.5])
        assert signed_volume(corners) == pytest.approx(0.125)  # 1/6 of 0.5 x 1 x 1.5.
    sizes = {
        Box(1.0, 2.0, 3.0): [("CUBE", [1, 2, 3], 0.0)],
        Sphere(0.5): [("SPHERE", [1, 1, 1], 0.0)],
        Ellipsoid(1.0, 2.0, 3.0): [("SPHERE", [2, 4, 6], 0.0)],
        Cylinder(0.5, 3.0): [("CYLINDER", [1, 1, 3], 0.0)],
        Capsule(0.5, 3.0): [
            ("CYLINDER", [1, 1, 3], 0.0),
            ("SPHERE", [1, 1, 1], -1.5),
            ("SPHERE", [1, 1, 1], 1.5),
        ],
        HalfSpace(): [],
    }
    for shape, expected in sizes.items():
        got = [
            (kind, list(scale), X.translation()[2])
            for kind, X, scale, _ in _primitives(shape)
        ]
        assert got == expected


def test_a_free_body_moves_with_its_shapes(tmp_path):
    rows = {f"b.box.{c}": 0.0 * TIME for c in ("qx", "qy", "qz")}
    rows |= {"b.box.qw": 0.0 * TIME + 1.0, "b.box.x": Q[:, 0], "b.box.y": 0.0 * TIME}
    rows |= {"b.box.z": 0.0 * TIME + 0.05, "b.box.vx": Q[:, 1]}
    write_recording(tmp_path / "log.csv", {"time": TIME, **rows})
    loaded = load_scene(on_ground(tmp_path, "cube"), DiagramBuilder())
    motions = motions_of(read_recording(tmp_path / "log.csv"))
    write_mcap(tmp_path / "m", motions, {"measured": loaded})
    found = messages(tmp_path / "m")
    got = [m.pose.position.x for m in found["/pose/b/box"][1]]
    np.testing.assert_array_equal(got, Q[:, 0])
    speeds = [m.twist.linear.x for m in found["/twist/b/box"][1]]
    np.testing.assert_array_equal(speeds, Q[:, 1])
    _, poses = found["/tf"]
    (box,) = (t for t in poses[0].transforms if t.child_frame_id == "b/box")
    assert box.transform.translation.x == Q[0, 0]
    (shapes,) = found["/shapes"][1]
    assert {m.type for m in shapes.markers if m.header.frame_id == "b/box"} == {1}


def test_gap_reads_it_as_the_log(tmp_path):
    log, columns = arm_log(tmp_path)
    loaded = load_scene(double(tmp_path), DiagramBuilder())
    write_mcap(
        tmp_path / "log.mcap", motions_of(read_recording(log)), {"measured": loaded}
    )
    table, notes = read_bag(tmp_path / "log.mcap")
    assert notes == []
    expected = {
        "/joint_states/j1/position": columns["d.j1.position"],
        "/joint_states/j2/position": columns["d.j2.position"],
        "/joint_states/j1/velocity": columns["d.j1.velocity"],
        "/joint_states/j1/effort": columns["d.j1.effort_measured"],
        "/joint_commands/j2/effort": columns["d.j2.effort_command"],
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(table[name], values)
    assert not any(name.startswith(("/tf", "/shapes")) for name in table)


def test_episodes_of_one_clock_come_one_after_the_other(tmp_path):
    log, _ = arm_log(tmp_path, episodes=True)
    loaded = load_scene(double(tmp_path), DiagramBuilder())
    notes = write_mcap(
        tmp_path / "m", motions_of(read_recording(log)), {"measured": loaded}
    )
    half = len(TIME) // 2
    moved = TIME[half - 1] + 1.0 - TIME[0]
    assert notes == [f"episode 1 of log is moved by {moved:.6g} s"]
    times, _ = messages(tmp_path / "m")["/joint_states"]
    expected = [*TIME[:half], *(TIME[:half] + moved)]
    np.testing.assert_allclose(1e-9 * np.array(times), expected, rtol=0, atol=1e-6)


def test_a_clock_before_zero_is_moved(tmp_path):
    log, _ = arm_log(tmp_path)
    (motion,) = motions_of(read_recording(log))
    motion = replace(motion, time=motion.time - TIME[0] - 0.1)
    loaded = load_scene(double(tmp_path), DiagramBuilder())
    (note,) = write_mcap(tmp_path / "m", [motion], {"measured": loaded})
    assert "moved by 0.1 s" in note
    assert messages(tmp_path / "m")["/joint_states"][0][0] == 0


def test_rerun_gets_scalars_frames_and_shapes(tmp_path):
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    log, _ = arm_log(tmp_path)
    loaded = {"measured": load_scene(double(tmp_path), DiagramBuilder())}
    write_mcap(tmp_path / "log.mcap", motions_of(read_recording(log)), loaded)
    write_rrd(tmp_path / "log.rrd", tmp_path / "log.mcap", loaded)
    content = (tmp_path / "log.rrd").read_bytes()
    assert b"/joint_states/position" in content and b"/shapes/measured/0" in content


def test_a_missing_library_and_an_unknown_format_are_said_in_a_line(
    tmp_path, monkeypatch, capsys
):
    log, _ = arm_log(tmp_path)
    write_scene(double(tmp_path), tmp_path / "scene.yaml")
    words = ["convert", str(tmp_path / "scene.yaml"), str(log), "--out"]
    words += [str(tmp_path / "out"), "--to"]
    assert cli.main([*words, "avi"]) == 2
    assert "--to: got 'avi', expected some of mcap, rrd" in capsys.readouterr().err
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "rosbags.rosbag2", None)
        assert cli.main([*words, "mcap"]) == 2
        said = "log.mcap: MCAP needs rosbags: pip install 'makebreak[ros]'"
        assert said in capsys.readouterr().err
        assert not (tmp_path / "out" / "log.mcap").exists()
    command = "makebreak.scripts.cli.convert_command"
    monkeypatch.setattr(f"{command}.find_spec", lambda name: None)
    assert cli.main([*words, "rrd"]) == 2
    err = capsys.readouterr().err
    assert "--to rrd needs rerun: pip install 'makebreak[rerun]'" in err
    assert err.count("\n") == 1
