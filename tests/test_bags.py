"""Bags and datasets that the tests write themselves, read as recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from makebreak.gap.data.bags import motor_ranges
from makebreak.gap.data.match import JointName
from makebreak.gap.data.proposal import propose
from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.table import read_table

N, PERIOD = 200, 5_000_000  # Rows; [ns]
START = 1_700_000_000_123_456_789  # [ns]
T = 1e-9 * PERIOD * np.arange(N)
JOINTS = ["shoulder", "elbow"]


def position(t, k):
    return np.sin(3.0 * t + k)


@pytest.fixture
def rosbags():
    return pytest.importorskip("rosbags", reason="the extra `ros` is not installed")


def write_bag(path, ros, kind):
    """JointStates at 200 Hz with the sampling's stamp, commands at 100 Hz without."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    if ros == 1:
        writer = rosbag1.Writer(path)
    else:
        plugin = {
            "sqlite3": rosbag2.StoragePlugin.SQLITE3,
            "mcap": rosbag2.StoragePlugin.MCAP,
        }[kind]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        JointState = types["sensor_msgs/msg/JointState"]
        Array = types["std_msgs/msg/Float64MultiArray"]
        Layout = types["std_msgs/msg/MultiArrayLayout"]
        Header, Time = (
            types["std_msgs/msg/Header"],
            types["builtin_interfaces/msg/Time"],
        )
        extra = {"typestore": store}
        states = writer.add_connection(
            "/arm/joint_states", JointState.__msgtype__, **extra
        )
        commands = writer.add_connection("/effort/commands", Array.__msgtype__, **extra)
        text = writer.add_connection("/said", "std_msgs/msg/String", **extra)
        for k in range(N):
            now = START + PERIOD * k
            stamp = Time(now // 10**9, now % 10**9)
            header = Header(0, stamp, "base") if ros == 1 else Header(stamp, "base")
            t = 1e-9 * PERIOD * k
            q = np.array([position(t, i) for i in range(2)])
            message = JointState(header, JOINTS, q, 2.0 * q, np.zeros(0))
            late = now + 1_000_000  # It is written a millisecond later.
            to_bytes = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            writer.write(states, late, to_bytes(message, JointState.__msgtype__))
            if k % 2 == 0:
                message = Array(Layout([], 0), np.array([0.1 * k, -0.1 * k]))
                writer.write(commands, now, to_bytes(message, Array.__msgtype__))
        said = types["std_msgs/msg/String"]("hello")
        writer.write(text, late + 1, to_bytes(said, "std_msgs/msg/String"))


SIDECAR = {
    "columns": {
        "/arm/joint_states/shoulder/position": "arm.j1.position",
        "/arm/joint_states/elbow/position": "arm.j2.position",
        "/arm/joint_states/shoulder/velocity": "arm.j1.velocity",
        "/arm/joint_states/elbow/velocity": None,
        "/effort/commands/data[0]": "arm.j1.effort_command",
        "/effort/commands/data[1]": "arm.j2.effort_command",
    }
}


@pytest.mark.parametrize(
    "ros, kind", [(1, "bag"), (2, "sqlite3"), (2, "mcap")], ids=["1", "2", "mcap"]
)
def test_a_bag_is_read_with_its_stamps_names_and_rates(tmp_path, rosbags, ros, kind):
    path = tmp_path / ("log.bag" if ros == 1 else "log")
    write_bag(path, ros, kind)
    paths = [path]
    if kind == "mcap":
        paths += list(path.glob("*.mcap"))  # The file alone as well.
    for path in paths:
        (path.parent / f"{path.name.removesuffix('.bag').removesuffix('.mcap')}.yaml"
         ).write_text(json.dumps(SIDECAR))  # fmt: skip
        recording = read_recording(path)
        assert set(recording.channels) == set(filter(None, SIDECAR["columns"].values()))
        (episode,) = recording.episodes
        for k, joint in enumerate(("arm.j1", "arm.j2")):
            t, q = recording.samples(f"{joint}.position", episode)
            # Nanoseconds of today, less those of the first row, are exact.
            np.testing.assert_allclose(t, T, atol=1e-12)
            np.testing.assert_array_equal(q, position(1e-9 * PERIOD * np.arange(N), k))
            t, u = recording.samples(f"{joint}.effort_command", episode)
            np.testing.assert_allclose(t, T[::2], atol=1e-12)
            np.testing.assert_array_equal(np.abs(u), 0.1 * np.arange(N)[::2])


CONTROLLER = """
std_msgs/Header header
string[] joint_names
rig_msgs/Point desired
rig_msgs/Values[] interface_values
rig_msgs/Motor[] motors
float64[3] wrench
"""
OTHERS = {
    "Point": "float64[] positions\nfloat64[] effort",
    "Values": "string[] interface_names\nfloat64[] values",
    "Motor": "string name\nfloat32 temperature",
}


@pytest.mark.parametrize("names", [JOINTS, ["shoulder", ""], ["elbow", "elbow"]])
def test_names_in_a_message_are_those_of_arrays_of_as_many(tmp_path, rosbags, names):
    """As in states of ros2_control: in the order of the controller, not the robot's.
    Names that are empty, or come twice, name nothing."""
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in {"State": CONTROLLER, **OTHERS}.items():
        store.register(get_types_from_msg(text, f"rig_msgs/msg/{name}"))
    types = {name: store.types[f"rig_msgs/msg/{name}"] for name in ("State", *OTHERS)}
    plugin = rosbag2.StoragePlugin.MCAP
    Header = store.types["std_msgs/msg/Header"]
    Time = store.types["builtin_interfaces/msg/Time"]
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        to = writer.add_connection("/rig", "rig_msgs/msg/State", typestore=store)
        for k in range(N):
            now, q = START + PERIOD * k, np.array([position(T[k], j) for j in (0, 1)])
            each = [types["Values"](["position", "effort"], x * np.array([1.0, 2.0]))
                    for x in q]  # fmt: skip
            motors = [types["Motor"](name, 20.0 + j) for j, name in enumerate(names)]
            message = types["State"](
                Header(Time(now // 10**9, now % 10**9), ""), names,
                types["Point"](q, np.zeros(0)), each, motors, np.arange(3.0),
            )  # fmt: skip
            raw = store.serialize_cdr(message, "rig_msgs/msg/State")
            writer.write(to, now, raw)
    columns = read_table(tmp_path / "bag").columns
    if names != JOINTS:
        at = ["/rig/desired/positions[1]", "/rig/interface_values[1]/effort/values",
              "/rig/motors[1]/temperature"]  # fmt: skip
    else:
        at = ["/rig/desired/elbow/positions", "/rig/elbow/interface_values/effort/"
              "values", "/rig/elbow/motors/temperature"]  # fmt: skip
    expected = position(T, 1), 2.0 * position(T, 1), np.full(N, 21.0)
    for name, values in zip(at, expected, strict=True):
        np.testing.assert_allclose(columns[name], values, err_msg=name)
    assert "/rig/wrench[2]" in columns and len(columns) == 1 + 2 + 4 + 2 + 3


def test_a_bag_that_is_none_is_refused_in_one_line(tmp_path, rosbags):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"no bag" * 100)
        with pytest.raises(ValueError, match="is no bag that can be read") as error:
            read_recording(tmp_path / name)
        assert "\n" not in str(error.value)


def write_dataset(path, names):
    arrow = pytest.importorskip(
        "pyarrow", reason="the extra `parquet` is not installed"
    )
    parquet = pytest.importorskip("pyarrow.parquet")
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": names},
        "action": {"dtype": "float32", "shape": [2], "names": names},
        "observation.images.top": {"dtype": "video", "shape": [4, 4, 3]},
        "timestamp": {"dtype": "float32", "shape": [1]},
        "frame_index": {"dtype": "int64", "shape": [1]},
        "episode_index": {"dtype": "int64", "shape": [1]},
        "index": {"dtype": "int64", "shape": [1]},
        "task_index": {"dtype": "int64", "shape": [1]},
    }
    (path / "meta").mkdir(parents=True)
    info = {"codebase_version": "v3.0", "fps": 50, "features": features}
    (path / "meta" / "info.json").write_text(json.dumps(info))
    chunk = path / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    for file in range(2):  # Two episodes in the first file, one in the second.
        episodes = (0, 1) if file == 0 else (2,)
        frame = np.tile(np.arange(60), len(episodes))
        number = np.repeat(episodes, 60)
        t = (frame / 50.0).astype(np.float32)
        state = np.stack([position(t, k) + number for k in range(2)], axis=1)
        lists = arrow.list_(arrow.float32())
        table = {
            "observation.state": arrow.array(state.tolist(), lists),
            "action": arrow.array((2 * state).tolist(), lists),
            "timestamp": t,
            "frame_index": frame,
            "episode_index": number,
            "index": 120 * file + np.arange(len(frame)),
            "task_index": 0 * frame,
        }
        parquet.write_table(arrow.table(table), chunk / f"file-{file:03d}.parquet")


@pytest.mark.parametrize(
    "names", [["pan.pos", "lift.pos"], {"motors": ["pan", "lift"]}]
)
def test_a_lerobot_dataset_is_read_by_its_features_names(tmp_path, names):
    write_dataset(tmp_path / "set", names)
    columns = read_table(tmp_path / "set").columns
    first, second = names if isinstance(names, list) else names["motors"]
    state, action = f"observation.state.{first}", f"action.{second}"
    assert {"time", "episode", state, action} <= set(columns) and len(columns) == 6
    sidecar = {
        "columns": {
            state: "so.pan.position",
            f"observation.state.{second}": None,
            f"action.{first}": "so.pan.position_command",
            action: None,
        }
    }
    (tmp_path / "set.yaml").write_text(json.dumps(sidecar))
    recording = read_recording(tmp_path / "set")
    assert [e.number for e in recording.episodes] == [0, 1, 2]
    for episode in recording.episodes:
        t, q = recording.samples("so.pan.position", episode)
        # Single precision.
        np.testing.assert_allclose(q, position(t, 0) + episode.number, atol=1e-6)
        _, u = recording.samples("so.pan.position_command", episode)
        np.testing.assert_allclose(u, 2.0 * q, atol=1e-6)


def test_a_dataset_without_its_columns_is_refused(tmp_path):
    (tmp_path / "set" / "meta").mkdir(parents=True)
    info = tmp_path / "set" / "meta" / "info.json"
    for text, message in (
        ("{", "no info of a LeRobot dataset"),
        ('{"features": {}}', "no data/chunk-"),
    ):
        info.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_recording(tmp_path / "set")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="a bag .* or a LeRobot dataset"):
        read_recording(tmp_path / "empty")


def two_clocks(path, slope):
    """A simulator's JointStates, stamped by its clock from 5 s on, which runs `slope`
    times as fast as the wall's; commands have no header. Both show the same motion."""
    from rosbags import rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray",
             "std_msgs/msg/MultiArrayLayout", "std_msgs/msg/Header",
             "builtin_interfaces/msg/Time")  # fmt: skip
    State, Array, Layout, Header, Time = (store.types[name] for name in names)
    with rosbag2.Writer(path, version=9) as writer:
        states = writer.add_connection("/joint_states", names[0], typestore=store)
        told = writer.add_connection("/effort/commands", names[1], typestore=store)
        for k in range(N):
            wall, sim = START + PERIOD * k, 5 * 10**9 + int(slope * PERIOD * k)
            q = np.full(1, position(1e-9 * (sim - 5 * 10**9), 0))
            header = Header(Time(sim // 10**9, sim % 10**9), "")
            state = State(header, JOINTS[:1], q, q, q)
            writer.write(states, wall, store.serialize_cdr(state, names[0]))
            message = Array(Layout([], 0), q)
            writer.write(told, wall, store.serialize_cdr(message, names[1]))


@pytest.mark.parametrize("slope", [1.0, 0.5])
def test_topics_of_two_clocks_are_brought_to_one_and_it_is_said(
    tmp_path, rosbags, slope
):
    two_clocks(tmp_path / "bag", slope)
    table = read_table(tmp_path / "bag")
    time = table.columns["time"]
    assert [kind for kind, _ in table.notes] == ["clocks_differ"]
    says = table.notes[0][1]
    assert "/joint_states" in says and "/effort/commands" in says
    for name in ("/joint_states/shoulder/position", "/effort/commands/data[0]"):
        there = np.isfinite(table.columns[name])
        assert there.sum() == N
        # The median of the offsets is exact here, to nanoseconds of rounding.
        expected = position(time[there], 0)
        np.testing.assert_allclose(table.columns[name][there], expected, atol=1e-6)


def calibration(half, reversed):
    """As LeRobot writes it, of a motor that turns `half` rad to each side of 2048."""
    ticks = round(half * 4095 / (2.0 * np.pi))
    return {"id": 1, "drive_mode": int(reversed), "homing_offset": 7,
            "range_min": 2048 - ticks, "range_max": 2048 + ticks}  # fmt: skip


def test_positions_in_per_cent_of_a_range_are_read_by_the_arms_calibration(tmp_path):
    names = ["pan.pos", "lift.pos"]
    write_dataset(tmp_path / "set", names)
    joints = [JointName("so.pan", False, -1.9, 1.9), JointName("so.lift", False, -1, 2)]
    halves = {"pan": calibration(1.7, False), "lift": calibration(1.4, True)}
    file = tmp_path / "set" / "my_arm.json"
    file.write_text(json.dumps(halves))
    q = np.linspace(-98.0, 95.0, 50)
    columns = {f"observation.state.{name}": q for name in names}
    ranges = motor_ranges(tmp_path / "set", {})
    pan, lift = propose(columns, joints, ranges=ranges)
    # A tick is 1.5 mrad; the middle of a range is that of the limits.
    assert pan.channel == "so.pan.position" and "its calibration" in pan.why
    assert 100.0 * pan.scale == pytest.approx(1.7, abs=2e-3) and pan.offset == 0.0
    assert 100.0 * lift.scale == pytest.approx(-1.4, abs=2e-3) and lift.offset == 0.5
    # Beyond 100 they are degrees, whatever the file says.
    degrees = {name: 1.2 * y for name, y in columns.items()}
    assert all(
        m.scale == np.pi / 180.0 for m in propose(degrees, joints, ranges=ranges)
    )
    file.write_text("[]")
    assert motor_ranges(tmp_path / "set", {}) == {}
    with pytest.raises(ValueError, match="my_arm.json: expected {motor: {range_min"):
        motor_ranges(tmp_path / "set", {"calibration": file})


def test_without_a_calibration_the_limits_tell_what_degrees_cannot_be():
    q = np.linspace(-98.0, 95.0, 50)
    columns = {"pan.pos": q, "lift.pos": 0.9 * q, "gripper.pos": np.abs(q)}
    small = [JointName("so.pan", False, -1.0, 1.0), JointName("so.lift", False, -2, 2),
             JointName("so.gripper", False, -0.2, 1.8)]  # fmt: skip
    pan, lift, gripper = propose(columns, small)
    assert (100.0 * pan.scale, 100.0 * lift.scale) == pytest.approx((1.0, 2.0))
    assert (100.0 * gripper.scale, gripper.offset) == pytest.approx((2.0, -0.2))
    wide = [replace(joint, lower=-1.8, upper=1.8) for joint in small]
    assert all(m.scale == np.pi / 180.0 for m in propose(columns, wide))
