"""Dictionaries of arrays, .npz and .mat, and other files that people have."""

import json
import sys

import numpy as np
import pytest
from scipy.io import savemat

from makebreak.gap.data import arrays
from makebreak.gap.data.recording_files import recording_files
from makebreak.gap.data.table import read_table

N = 300
TIME = 0.005 * np.arange(N)
Q = np.sin(TIME[:, None] * [1.0, 2.0, 3.0])
NAMES = ["hip", "knee", "ankle"]


def test_a_dictionary_of_an_actuator_network_is_columns_with_joints_names(tmp_path):
    """As Isaac Lab and PACE save them, once as npz."""
    np.savez(
        tmp_path / "a.npz", dof_pos=Q.astype(np.float32), des_dof_pos=2.0 * Q,
        joint_names=np.array(NAMES), dt=np.float64(0.005), root_quat=np.ones((N, 4)),
        task="walk", images=np.zeros((N, 4, 4)),
    )  # fmt: skip
    table = read_table(tmp_path / "a.npz")
    np.testing.assert_allclose(table.columns["time"], TIME, atol=1e-12)
    for i, name in enumerate(NAMES):
        np.testing.assert_allclose(table.columns[f"des_dof_pos/{name}"], 2 * Q[:, i])
    assert "root_quat[3]" in table.columns and len(table.columns) == 11
    told = dict(table.notes)
    assert "0.005 s apart" in told["time_of_period"]
    assert "images (300, 4, 4)" in told["not_columns"]


@pytest.mark.parametrize("number", [{"frequency": 200}, {"fps": 200.0}, {"dt_ms": 5},
                                    {"sample_rate": 200}, {"step_dt": 0.005},
                                    {"control_frequency_hz": 200}])  # fmt: skip
def test_a_number_gives_the_time_where_no_column_does(tmp_path, number):
    np.savez(tmp_path / "a.npz", q=Q, kp=40.0, **number)
    np.testing.assert_allclose(read_table(tmp_path / "a.npz").columns["time"], TIME)
    np.savez(tmp_path / "b.npz", q=Q, t=2.0 * TIME, **number)
    assert "time" not in read_table(tmp_path / "b.npz").columns


def test_a_mat_file_is_read_with_its_structs_either_way_round(tmp_path):
    signals = np.zeros(2, dtype=[("values", "O"), ("label", "O")])
    signals[0] = (Q[:, :1], "q_hip")
    signals[1] = (Q[:, 1:2], "q_knee")
    savemat(tmp_path / "a.mat", {
        "log": {"t": TIME, "q": Q.T, "tau": 3.0 * Q, "note": "rig 2"},
        "scope": {"signals": signals}, "Kp": np.diag([1.0, 2.0, 3.0]),
    })  # fmt: skip
    columns = read_table(tmp_path / "a.mat").columns
    np.testing.assert_array_equal(columns["log/t"], TIME)
    np.testing.assert_array_equal(columns["log/q[2]"], Q[:, 2])
    np.testing.assert_array_equal(columns["log/tau[1]"], 3.0 * Q[:, 1])
    np.testing.assert_array_equal(columns["scope/signals/q_knee/values"], Q[:, 1])


@pytest.fixture
def h5py():
    return pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")


def test_groups_of_an_hdf5_file_that_count_runs_are_episodes(tmp_path, h5py):
    """As robomimic saves demonstrations; the tenth comes after the second."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for k, rows in ((10, slice(100, N)), (2, slice(0, 100))):
            demo = file.create_group(f"data/demo_{k}")
            demo.attrs.update(num_samples=rows.stop - rows.start, fps=200.0, by="me")
            demo["obs/joint_pos"], demo["actions"] = Q[rows], 2.0 * Q[rows, :1]
            demo["obs/camera"] = np.zeros((rows.stop - rows.start, 4, 4, 3), np.uint8)
        file["mask/train"] = np.array([b"demo_2", b"demo_10"])
    columns = read_table(tmp_path / "a.hdf5").columns
    np.testing.assert_allclose(columns["time"], TIME, atol=1e-12)
    np.testing.assert_array_equal(columns["episode"], np.arange(N) >= 100)
    np.testing.assert_array_equal(columns["obs/joint_pos[2]"], Q[:, 2])
    np.testing.assert_array_equal(columns["actions"], 2.0 * Q[:, 0])
    assert len(columns) == 6


def test_an_hdf5_file_is_arrays_attributes_and_tables(tmp_path, h5py):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["fps"], file.attrs["joint_names"] = 200, NAMES
        file["observations/qpos"], file["action"] = Q, 2.0 * Q
        file["observations/image"] = np.zeros((N, 4, 4))
        own = np.zeros(N, [("stamp", float), ("tau", float)])
        own["tau"] = Q[:, 1]
        file["motor"] = own
    table = read_table(tmp_path / "a.h5", unused=frozenset(["action", "motor/stamp"]))
    columns = table.columns
    np.testing.assert_allclose(columns["time"], TIME, atol=1e-12)
    np.testing.assert_array_equal(columns["observations/qpos/knee"], Q[:, 1])
    np.testing.assert_array_equal(columns["motor/tau"], Q[:, 1])
    assert (
        len(columns) == 5 and "observations/image" in dict(table.notes)["not_columns"]
    )


def test_an_hdf5_file_with_too_much_in_its_columns_is_refused(
    tmp_path, monkeypatch, h5py
):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log/q"], file["image"] = Q, np.zeros((N, 9, 9, 9))
    monkeypatch.setattr(arrays, "MOST_BYTES", Q.nbytes)
    assert len(read_table(tmp_path / "a.h5").columns) == 3
    monkeypatch.setattr(arrays, "MOST_BYTES", Q.nbytes - 1)
    with pytest.raises(ValueError, match="cut it into several"):
        read_table(tmp_path / "a.h5")


def test_a_mat_file_of_version_7_3_is_read_as_the_older_ones(tmp_path, h5py):
    """HDF5 behind 512 bytes, arrays the other way round, texts and cells of them."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        file["log/t"], file["log/q"] = TIME[None], Q.T
        file["note"] = np.array([[ord(c)] for c in "rig 2"], np.uint16)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
        cells = []
        for k, name in enumerate(NAMES):
            text = np.array([[ord(c)] for c in name], np.uint16)
            file[f"#refs#/{k}"] = text
            file[f"#refs#/{k}"].attrs["MATLAB_class"] = np.bytes_("char")
            cells.append(file[f"#refs#/{k}"].ref)
        file.create_dataset("joint_names", data=[cells], dtype=h5py.ref_dtype)
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file")
    columns = read_table(tmp_path / "a.mat").columns
    np.testing.assert_array_equal(columns["log/t"], TIME)
    np.testing.assert_array_equal(columns["log/q/ankle"], Q[:, 2])
    assert len(columns) == 4


def test_hdf5_without_h5py_is_one_line_that_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(ValueError, match=r"pip install 'makebreak\[hdf5\]'"):
        read_table(tmp_path / "a.h5")


HDF5 = b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n" + 400 * b"\0"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.mat", HDF5, "is no HDF5 file"),
        ("a.mat", b"no such thing", "is no .mat file"),
        ("a.pt", b"PK", r"pickled objects, .* save its arrays as npz"),
        ("a.pkl", b"", r"pickled objects"),
        ("a.hdf5", b"none", "is no HDF5 file"),
    ],
)
def test_what_is_not_read_is_one_line_that_says_what_to_do(
    tmp_path, name, content, says
):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=says) as error:
        read_table(tmp_path / name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("header", ["", "# t q_hip\n", "t   q_hip\n",
                                    "% rig 2\n% t q_hip\n\n"])  # fmt: skip
def test_a_text_with_blanks_is_read_as_numpy_and_matlab_write_it(tmp_path, header):
    cells = zip(TIME, Q[:, 0], strict=True)
    rows = "".join(f"  {t:.18e}   {q:.18e} \n" for t, q in cells)
    (tmp_path / "a.txt").write_text(header + rows)
    columns = read_table(tmp_path / "a.txt").columns
    names = ["t", "q_hip"] if header else ["column_1", "column_2"]
    assert list(columns) == names
    np.testing.assert_array_equal(columns[names[1]], Q[:, 0])


def test_patterns_and_folders_name_several_logs(tmp_path):
    for name in ("b.csv", "a.csv", "c.npz", "notes.md", "b.yaml"):
        (tmp_path / name).write_text("x")
    names = [path.name for path in recording_files([str(tmp_path / "*.csv")])]
    assert names == ["a.csv", "b.csv"]
    names = [path.name for path in recording_files([str(tmp_path)])]
    assert names == ["a.csv", "b.csv", "c.npz"]
    (tmp_path / "empty").mkdir()
    for word, says in (("empty", "folder without a log"), ("*.mat", "no log has"),
                       ("d.csv", "does not exist")):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            recording_files([str(tmp_path / word)])


@pytest.mark.parametrize("form", ["arrays", "rows", "nested rows"])
def test_a_json_document_is_its_arrays_or_the_objects_of_its_longest_list(
    tmp_path, form
):
    if form == "arrays":
        content = {"log": {"t": TIME.tolist(), "q": Q.tolist()}, "joint_names": NAMES}
        q = "log/q/hip"
    else:
        rows = [
            {
                "t": t,
                "joints": [
                    {"name": n, "q": x} for n, x in zip(NAMES, each, strict=True)
                ],
            }
            for t, each in zip(TIME.tolist(), Q.tolist(), strict=True)
        ]
        rows[5]["joints"][0]["q"] = None
        content = rows if form == "rows" else {"by": "rig 2", "run": {"samples": rows}}
        q = "joints/hip/q"
    (tmp_path / "a.json").write_text(json.dumps(content))
    columns = read_table(tmp_path / "a.json").columns
    expected = Q[:, 0].copy()
    if form != "arrays":
        expected[5] = np.nan
    np.testing.assert_array_equal(columns[q], expected)
    np.testing.assert_array_equal(columns[next(iter(columns))], TIME)


def test_runs_that_a_json_document_counts_by_name_are_episodes(tmp_path):
    """Joints that it counts are none."""
    runs = {f"run {k}": {"q": Q[: 100 + k].tolist(), "dt": 0.005} for k in range(3)}
    (tmp_path / "a.json").write_text(json.dumps({"by": "rig 2", "log": runs}))
    columns = read_table(tmp_path / "a.json").columns
    assert np.bincount(np.int64(columns["episode"])).tolist() == [100, 101, 102]
    assert np.ptp(columns["time"]) == pytest.approx(302 * 0.005)
    joints = {f"joint_{k}": {"q": Q[:, k].tolist()} for k in range(3)}
    (tmp_path / "b.json").write_text(json.dumps(joints))
    assert list(read_table(tmp_path / "b.json").columns) == [
        "joint_0/q", "joint_1/q", "joint_2/q",
    ]  # fmt: skip


def test_a_json_with_a_number_beside_its_rows_has_the_time_of_it(tmp_path):
    rows = [{"q": each} for each in Q.tolist()]
    content = {"dt": 0.005, "joint_names": NAMES, "data": rows}
    (tmp_path / "a.json").write_text(json.dumps(content))
    columns = read_table(tmp_path / "a.json").columns
    np.testing.assert_allclose(columns["time"], TIME, atol=1e-12)
    np.testing.assert_array_equal(columns["q/knee"], Q[:, 1])


@pytest.mark.parametrize("n", [1, 3])
def test_objects_with_columns_of_their_own_are_episodes(tmp_path, n):
    lengths = [40, 25, 60][:n]
    runs = [{"type": "step", "targets": [], "goal": Q[:k, 1].tolist(),
             "q": Q[:k].tolist()} for k in lengths]  # fmt: skip
    content = {"config": {"control_hz": 200, "limits": [0.1, 0.2]}, "data": runs}
    (tmp_path / "a.json").write_text(json.dumps(content))
    columns = read_table(tmp_path / "a.json").columns
    q = np.concatenate([Q[:k, 0] for k in lengths])
    np.testing.assert_array_equal(columns["q[0]"], q)
    assert np.diff(columns["time"])[0] == pytest.approx(0.005)
    if n > 1:
        np.testing.assert_array_equal(columns["episode"], np.repeat(range(n), lengths))
    assert ("episode" in columns) == (n > 1)


def test_objects_with_names_are_joints_and_no_episodes(tmp_path):
    joints = [{"joint": n, "q": y.tolist()} for n, y in zip(NAMES, Q.T, strict=True)]
    (tmp_path / "a.json").write_text(json.dumps({"dt": 0.01, "joints": joints}))
    assert "episode" not in read_table(tmp_path / "a.json").columns


@pytest.mark.parametrize("text, says", [
    ("{", "no JSON"), ("3", "no columns"), ('{"a": "b"}', "no array of numbers"),
    ("[" * 100_000, "no JSON"), ("[]", "no columns"),
])  # fmt: skip
def test_a_json_that_is_no_log_is_refused_in_a_line(tmp_path, text, says):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=says) as error:
        read_table(tmp_path / "a.json")
    assert "\n" not in str(error.value)


def test_a_folder_s_json_files_are_logs_only_where_no_other_file_is(tmp_path):
    content = {"t": TIME.tolist(), "q": Q.tolist()}
    (tmp_path / "run.json").write_text(json.dumps(content))
    (tmp_path / "noise.json").write_text('{"q": 0.001}')
    assert [p.name for p in recording_files([str(tmp_path)])] == ["run.json"]
    np.savez(tmp_path / "b.npz", t=TIME, q=Q)
    assert [p.name for p in recording_files([str(tmp_path)])] == ["b.npz"]
