"""Recordings: what is read is what was written; what is wrong is refused by name."""

import json
import sys

import numpy as np
import pytest

from makebreak.gap.data.reading import (
    check_against_scene,
    read_recording,
    read_recordings,
)
from makebreak.gap.data.recording import unit_of
from makebreak.gap.data.table import read_table, write_recording
from makebreak.gap.numerics.signal_noise import estimate_noise, resolution

FORMATS = ["csv", "npz"]
try:
    import pyarrow  # noqa: F401

    FORMATS.append("parquet")
except ImportError:  # An optional extra.
    pass


def arm_columns(n=40, rng=None):
    rng = rng or np.random.default_rng(0)
    return {
        "time": np.arange(n) * 0.005 + rng.uniform(0.0, 1e-3, n),
        "arm.j1.position": rng.normal(size=n),
        "arm.j1.velocity": rng.normal(size=n) * 1e-7,
        "arm.j1.effort_command": rng.normal(size=n),
    }


def text(columns, tmp_path, name="run.csv"):
    """A csv of our own, so that nothing of the writer is needed to read it."""
    path = tmp_path / name
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_reads_back_the_very_same_numbers(tmp_path, suffix):
    columns = arm_columns()
    columns["arm.j1.position"][[0, 3, 4, 39]] = np.nan
    columns["arm.j1.velocity"][39] = np.nan
    path = tmp_path / f"run.{suffix}"
    write_recording(path, columns)
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.time, columns["time"])
    assert list(recording.channels) == [name for name in columns if name != "time"]
    for name in recording.channels:
        np.testing.assert_array_equal(recording[name], columns[name])
    channel = recording.channels["arm.j1.position"]
    assert (channel.model, channel.element, channel.quantity) == (
        "arm",
        "j1",
        "position",
    )
    t, y = recording.samples("arm.j1.position", recording.episodes[0])
    assert len(t) == len(y) == 36
    with pytest.raises(ValueError):
        recording.time[0] = 1.0  # Read-only.


def test_empty_cells_anywhere_windows_line_ends_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "a.csv"
    body = "".join(f"{i},{'' if i % 2 else i},{i or ''},\r\n" for i in range(12))
    header = "time,a.b.x,a.b.y,a.b.z\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + (header + body + "\r\n").encode())
    recording = read_recording(path)
    np.testing.assert_array_equal(recording["a.b.x"][::2], np.arange(0, 12, 2))
    assert np.isnan(recording["a.b.x"][1::2]).all()
    np.testing.assert_array_equal(recording["a.b.y"], [np.nan, *range(1, 12)])
    assert "a.b.z" not in recording
    assert recording.notes == (
        ("channel_empty", "a.csv: a.b.z has no sample at all and is left out"),
    )


def test_a_command_holds_until_the_next_one_within_its_episode(tmp_path):
    n = 20
    columns = {"time": np.tile(np.arange(10.0), 2), "episode": np.repeat([0, 1], 10)}
    command = np.full(n, np.nan)
    command[[2, 5, 13]] = [1.0, 2.0, 3.0]
    columns["a.j.effort_command"] = command
    write_recording(tmp_path / "a.npz", columns)
    held = read_recording(tmp_path / "a.npz").held("a.j.effort_command")
    nan = np.nan
    expected = [nan, nan, 1, 1, 1, 2, 2, 2, 2, 2, nan, nan, nan, *7 * [3]]
    np.testing.assert_array_equal(held, expected)


def test_episodes_and_rates(tmp_path):
    n = 100
    time = np.concatenate([np.arange(n) * 0.01, np.arange(n) * 0.01])
    slow = np.full(2 * n, np.nan)
    slow[::5] = np.sin(time[::5])
    columns = {"time": time, "episode": np.repeat([4, 7], n), "a.b.x": slow}
    write_recording(tmp_path / "a.csv", columns)
    recording = read_recording(tmp_path / "a.csv")
    assert [(e.number, e.first, e.last) for e in recording.episodes] == [
        (4, 0, 100),
        (7, 100, 200),
    ]
    assert all(e.is_start for e in recording.episodes)
    assert recording.channels["a.b.x"].rate_hz == pytest.approx(20.0)
    assert recording.duration_sec() == pytest.approx(1.98)


def test_noise_comes_from_the_sidecar_or_is_estimated(tmp_path):
    rng = np.random.default_rng(1)
    n = 2000
    time = np.arange(n) * 0.005
    columns = {
        "time": time,
        "a.j.position": np.sin(3 * time) + 2e-3 * rng.normal(size=n),
        "a.j.velocity": 3 * np.cos(3 * time) + 5e-2 * rng.normal(size=n),
    }
    write_recording(tmp_path / "a.csv", columns, {"a.j.position": 2.5e-3})
    recording = read_recording(tmp_path / "a.csv")
    given, own = (recording.channels[f"a.j.{q}"] for q in ("position", "velocity"))
    assert (given.noise, given.noise_from) == (2.5e-3, "given")
    # 2000 samples: the median's standard error is 3 %.
    assert own.noise == pytest.approx(5e-2, rel=0.1) and own.noise_from == "estimated"
    (tmp_path / "a.yaml").write_text("noise: {a.j.position: 1e-3}\nprovenance: rig 2\n")
    recording = read_recording(tmp_path / "a.csv")
    assert recording.channels["a.j.position"].noise == 1e-3
    assert recording.provenance == "rig 2"


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("std", [1e-5, 1e-3, 1e-1])
def test_noise_of_a_smooth_signal_is_found(seed, std):
    rng = np.random.default_rng(seed)
    t = np.arange(4000) / 200
    y = np.sin(2 * t) + 0.3 * np.sin(2 * np.pi * 1.7 * t) + std * rng.normal(size=4000)
    # Settled within 12 %, plus a standard error of 3 %.
    assert estimate_noise(y).std == pytest.approx(std, rel=0.2)


@pytest.mark.parametrize("std", [3e-5, 1e-3])
def test_a_clock_that_jitters_and_loses_samples_adds_nothing_to_the_noise(std):
    rng = np.random.default_rng(3)
    t = (np.arange(4000) + 0.1 * np.clip(rng.normal(size=4000), -3, 3)) / 200
    t = t[rng.uniform(size=4000) > 0.02]
    y = np.sin(6 * t) + std * rng.normal(size=len(t))
    # Without the time stamps: speed times jitter, 3e-3.
    assert estimate_noise(y, times=t).std == pytest.approx(std, rel=0.2)
    assert estimate_noise(y).std > 1.5e-3


def test_a_quantised_signal_has_at_least_the_noise_of_its_grid():
    t = np.arange(4000) / 200
    y = np.round(np.sin(2 * t) / 0.002) * 0.002
    found = estimate_noise(y)
    assert found.step == pytest.approx(0.002)
    assert 0.9 * 0.002 / np.sqrt(12) < found.std < 1.5 * 0.002 / np.sqrt(12)
    assert resolution(np.random.default_rng(0).normal(size=1000)) == 0.0
    # A joint that moves so fast that few readings of its encoder come back, in degrees
    # of ten digits; and decimals that are no grid.
    t = 0.01 * np.arange(2400)
    angle = np.sin(0.7 * t) + 0.3 * np.sin(2.3 * t)
    read = np.round(np.rad2deg(3e-4 * np.round(angle / 3e-4)), 9)
    assert len(np.unique(read)) > 0.5 * len(read)
    assert np.deg2rad(resolution(read)) == pytest.approx(3e-4, rel=1e-6)
    assert resolution(np.round(angle, 10)) == 0.0


def test_filtered_noise_is_called_coloured_and_not_underestimated_by_half():
    pole = 0.5
    for seed in range(5):
        white = np.random.default_rng(seed).normal(size=8000)
        noise = np.empty(8000)
        noise[0] = 0.0
        for i in range(1, 8000):
            noise[i] = pole * noise[i - 1] + np.sqrt(1 - pole**2) * white[i]
        found = estimate_noise(np.sin(np.arange(8000) / 100) + 1e-3 * noise)
        assert found.pole > 0.2
        assert found.std == pytest.approx(1e-3, rel=0.5)


def test_foreign_names_units_and_columns_to_ignore(tmp_path):
    n = 12
    columns = {"t_ms": np.arange(n) * 5.0, "q1_deg": np.full(n, 90.0), "temp": [3] * n}
    path = text(columns, tmp_path)
    (tmp_path / "run.yaml").write_text(
        "columns:\n"
        "  t_ms: {channel: time, scale: 1e-3}\n"
        "  q1_deg: {channel: arm.j1.position, scale: 0.017453292519943295}\n"
        "  temp: null\n"
    )
    recording = read_recording(path)
    assert list(recording.channels) == ["arm.j1.position"]
    np.testing.assert_allclose(recording["arm.j1.position"], np.pi / 2)
    np.testing.assert_allclose(np.diff(recording.time), 5e-3)


def test_quaternions_get_one_sign_and_unit_length(tmp_path):
    n = 30
    angle = np.linspace(0.0, 2.0, n)
    q = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    measured = 1.002 * q * np.where(np.arange(n) >= 10, -1.0, 1.0)[:, None]
    columns = {"time": np.arange(n) * 0.1}
    columns |= {
        f"c.c.{k}": measured[:, i] for i, k in enumerate(["qw", "qx", "qy", "qz"])
    }
    write_recording(tmp_path / "c.npz", columns)
    recording = read_recording(tmp_path / "c.npz")
    np.testing.assert_allclose(
        recording.stack("c.c", ["qw", "qx", "qy", "qz"]), q, atol=1e-15
    )
    assert recording.quaternion_flips["c.c"] == 1
    assert recording.quaternion_norm_error["c.c"] == pytest.approx(0.002)


def replaced(columns, name, row, value):
    columns = {k: list(v) for k, v in columns.items()}
    columns[name][row - 1] = value
    return columns


GOOD = {k: v.tolist() for k, v in arm_columns(20).items()}
GOOD["time"] = [0.1 * i for i in range(20)]
QUATERNION = {"time": GOOD["time"]} | {
    f"c.c.{q}": [1.0 if q == "qw" else 0.0] * 20 for q in ("qw", "qx", "qy", "qz")
}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            replaced(GOOD, "arm.j1.velocity", 9, "fast"),
            r'column arm.j1.velocity, row 9: got "fast", expected a finite number',
        ),
        (replaced(GOOD, "arm.j1.velocity", 9, "inf"), r"velocity, row 9: got \"inf\""),
        (replaced(GOOD, "arm.j1.velocity", 9, "1,2"), r"row 9 has 5 cells, expected 4"),
        (GOOD | {"speed": [1.0] * 20}, r'column "speed", expected <model>.<joint'),
        (GOOD | {"arm.j1.positon": [1.0] * 20}, r"did you mean \.position\?"),
        ({"time": GOOD["time"]}, r"has no channel beside time"),
        ({"arm.j1.position": [1.0] * 20}, r"needs the column time"),
        ({k: v[:3] for k, v in GOOD.items()}, r"episode 0 has 3 rows.*at least 10"),
        (GOOD | {"episode": [0] * 17 + [1] * 3}, r"episode 1 has 3 rows"),
        (GOOD | {"episode": [0] * 10 + [0.5] * 10}, r"episode, row 11: got 0.5"),
        (
            {k: v * 2 for k, v in GOOD.items()}
            | {"episode": [0] * 10 + [1] * 10 + [0] * 20},
            r"does not increase|episode 0 comes back after episode 1",
        ),
        (replaced(QUATERNION, "c.c.qw", 5, 0.8), r"qw, row 5: quaternion.*unit length"),
        (replaced(QUATERNION, "c.c.qx", 5, ""), r"qx, row 5: empty while other parts"),
        (
            {k: v for k, v in QUATERNION.items() if k != "c.c.qz"},
            r"column c.c.qz is missing",
        ),
        ({k: [] for k in GOOD}, r"has a header and no rows"),
    ],
)
def test_a_bad_csv_is_refused_in_one_line(tmp_path, columns, message):
    path = text(columns, tmp_path)
    with pytest.raises(ValueError, match=message) as caught:
        read_recording(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"", "is empty"),
        ("a.csv", b"\xff\xfe\x00\x01", "is no text"),
        ("a.csv", b"time a.b.x\n0\n", "needs the column time, got time a.b.x"),
        ("a.csv", b"time,a.b.x,a.b.x\n0,1,2\n", '"a.b.x" is there twice'),
        ("a.npz", b"no zip", "is no npz"),
        ("a.npz", b"PK\x03\x04 but not really", "is no npz"),
        ("a.xyz", b"time", r"expected a name in \.csv"),
    ],
)
def test_a_file_that_is_no_table_is_refused_in_one_line(
    tmp_path, name, content, message
):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_recording(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_missing_file_a_file_given_twice_and_none(tmp_path):
    with pytest.raises(ValueError, match="does not exist"):
        read_recording(tmp_path / "none.csv")
    path = text(GOOD, tmp_path)
    with pytest.raises(ValueError, match="given twice"):
        read_recordings([path, tmp_path / "." / "run.csv"])
    with pytest.raises(ValueError, match="at least one"):
        read_recordings([])


def test_recordings_of_one_name_are_told_apart_by_their_folder(tmp_path):
    for folder in "ab":
        (tmp_path / folder).mkdir()
        text(GOOD, tmp_path / folder, "recording.csv")
    found = read_recordings([tmp_path / f / "recording.csv" for f in "ab"])
    assert [r.name for r in found] == ["a/recording", "b/recording"]


@pytest.mark.parametrize(
    ("sidecar", "message"),
    [
        ("noise: {arm.j1.position: -1}", "noise of arm.j1.position is -1, expected"),
        ("noise: {arm.j1.position: small}", "is 'small', expected a finite number"),
        ("nose: {}", '"nose", expected one of noise, filters'),
        ("columns: {foo: arm.j1.position}", 'columns names "foo"'),
        ("columns: {time: {scale: 2}}", "expected channel, and some of scale, offset"),
        ("columns: {time: [{}]}", r'columns, "time": got \[{}\], expected the name'),
        ("columns: {time: {channel: [t]}}", r"got \['t'\], expected the name"),
        ("columns: {time: 3}", "got 3, expected the name of a channel, or null"),
        ("filters: {arm: slow}", 'filters of "arm", expected the name of a channel'),
        ("[1, 2]", "expected names with values"),
        ("noise: [", "run.yaml"),
    ],
)
def test_a_bad_sidecar_is_refused_in_one_line(tmp_path, sidecar, message):
    path = text(GOOD, tmp_path)
    (tmp_path / "run.yaml").write_text(sidecar)
    with pytest.raises(ValueError, match=message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)
    (tmp_path / "run.yaml").unlink()
    (tmp_path / "noise.json").write_text(json.dumps({"arm.j1.position": None}))
    with pytest.raises(ValueError, match="noise of arm.j1.position is None"):
        read_recording(path)


def test_a_channel_that_the_scene_lacks_is_refused_with_the_nearest_name(tmp_path):
    recording = read_recording(text(GOOD, tmp_path))
    check_against_scene(recording, ["arm.j1", "arm.j2"], [])
    with pytest.raises(ValueError, match=r'and 2 more\): no joint "arm.j1".*"arm.J1"'):
        check_against_scene(recording, ["arm.J1"], ["arm.j1"])


@pytest.mark.parametrize("suffix", FORMATS)
def test_too_long_a_table_is_thinned_to_whole_stretches_and_says_so(tmp_path, suffix):
    n = 100_000
    time = np.arange(n) * 0.001
    columns = {"time": time, "a.b.x": np.arange(n) + 1.0}
    path = tmp_path / f"long.{suffix}"
    write_recording(path, columns)
    recording = read_recording(path, most_cells=40_000)
    assert recording.n_rows_in_file == n
    # A csv's length is estimated from its first megabyte.
    assert len(recording.time) == pytest.approx(20_000, rel=0.1)
    np.testing.assert_array_equal(recording["a.b.x"], recording.row)
    assert len(recording.episodes) == 20
    assert not any(e.is_start for e in recording.episodes)
    for episode in recording.episodes:  # No gap within.
        np.testing.assert_allclose(np.diff(recording.time[episode.rows]), 1e-3)
    # Spread over the whole file, to within a stretch.
    assert recording.time[0] < 6.0 and recording.time[-1] > 94.0
    [(kind, sentence)] = recording.notes
    assert kind == "rows_left_out" and "100000 rows" in sentence


def test_a_bad_cell_far_down_is_named_by_its_row_in_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr("makebreak.gap.data.csv_table._BLOCK", 1000)
    columns = replaced({k: v * 50 for k, v in GOOD.items()}, "time", 777, "x")
    with pytest.raises(ValueError, match="column time, row 777"):
        read_table(text(columns, tmp_path))


def test_parquet_without_pyarrow_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    with pytest.raises(ValueError, match=r"pip install 'makebreak\[parquet\]'"):
        read_recording(tmp_path / "a.parquet")


def test_a_parquet_of_text_is_refused_by_column(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    table = arrow.table({"time": [0.0, 1.0], "a.b.x": ["1", "2"]})
    parquet.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(ValueError, match="column a.b.x is of type string"):
        read_recording(tmp_path / "a.parquet")
    (tmp_path / "b.parquet").write_bytes(b"not one")
    with pytest.raises(ValueError, match="is no parquet file"):
        read_recording(tmp_path / "b.parquet")


def test_units_of_quantities():
    assert unit_of("position") == "rad" and unit_of("position_command", True) == "m"
    assert unit_of("effort_measured") == "N m" and unit_of("wz") == "rad/s"
    assert unit_of("fx") == "N" and unit_of("velocity_command", True) == "m/s"


def test_half_an_episode_is_refused_and_the_file_is_named_once(tmp_path):
    rows = [f"{0.01 * k},0.5,0.1" for k in range(30)]
    path = tmp_path / "half.csv"
    path.write_text("\n".join(["time,episode,arm.j1.position", *rows]))
    with pytest.raises(ValueError) as caught:
        read_recording(path)
    expected = "column episode, row 1: got 0.5, expected an integer"
    assert str(caught.value) == f"recording {path}: {expected}"
