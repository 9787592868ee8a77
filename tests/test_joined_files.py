"""A recording whose states and commands lie in two files."""

import numpy as np
import pytest

from makebreak.gap.data.reading import read_recording

TIME = 1e6 * np.arange(40) * 0.02  # [us], as the logger has it.
MEASURED, TOLD = 0.1 * np.sin(1e-6 * TIME), 0.1 * np.cos(1e-6 * TIME)
SIDECAR = """join: command.csv
columns:
  timestamp: {channel: time, scale: 1.0e-6}
  positions: a.j.position
  command.csv:positions: a.j.position_command
  event: null
"""


def write(folder, told_at=TIME, sidecar=SIDECAR):
    def table(name, time, values):
        rows = "".join(
            f"{t:.9g},{x:.9g},ok\n" for t, x in zip(time, values, strict=True)
        )
        (folder / name).write_text("timestamp,positions,event\n" + rows)

    table("state.csv", TIME, MEASURED)
    table("command.csv", told_at, TOLD)
    (folder / "state.yaml").write_text(
        sidecar.replace("  event: null\n", "  event: null\n  command.csv:event: null\n")
    )
    return folder / "state.csv"


def test_files_of_the_same_stamps_are_one_table(tmp_path):
    found = read_recording(write(tmp_path))
    np.testing.assert_allclose(found.time, 1e-6 * TIME, atol=1e-12)
    np.testing.assert_allclose(found["a.j.position"], MEASURED, atol=1e-9)
    np.testing.assert_allclose(found["a.j.position_command"], TOLD, atol=1e-9)
    assert found.n_rows_in_file == 40


def test_stamps_between_rows_are_rows_of_their_own_and_commands_hold(tmp_path):
    found = read_recording(write(tmp_path, TIME + 5e3))
    assert len(found.time) == 80
    measured, told = found["a.j.position"], found["a.j.position_command"]
    np.testing.assert_allclose(measured[::2], MEASURED, atol=1e-9)
    assert np.isnan(measured[1::2]).all() and np.isnan(told[::2]).all()
    np.testing.assert_allclose(found.held("a.j.position_command")[2::2], TOLD[:-1],
                               atol=1e-9)  # fmt: skip


@pytest.mark.parametrize(
    ("sidecar", "says"),
    [
        (SIDECAR.replace("command.csv\n", "no.csv\n", 1), "no.csv does not exist"),
        (SIDECAR.replace("join: command.csv", "join: {a: b}"), "expected a file name"),
        (SIDECAR.replace("join: command.csv", "join: other.csv"),
         "other.csv needs the column timestamp to be joined"),
    ],
)  # fmt: skip
def test_what_cannot_be_joined_is_one_line(tmp_path, sidecar, says):
    path = write(tmp_path, sidecar=sidecar)
    (tmp_path / "other.csv").write_text("t,positions\n0,1\n1,2\n")
    with pytest.raises(ValueError, match=says):
        read_recording(path)


def test_a_stamp_that_goes_back_is_said_and_its_row_left_out(tmp_path):
    path = write(tmp_path, np.where(np.arange(40) == 7, -1e6, TIME))
    found = read_recording(path)
    ((kind, says),) = found.notes
    assert kind == "stamps_back" and says.startswith("command.csv: 1 stamps step back")
    np.testing.assert_allclose(
        found["a.j.position_command"], np.where(np.arange(40) == 7, np.nan, TOLD),
        atol=1e-9,
    )  # fmt: skip


def test_a_file_that_calls_its_time_otherwise_is_joined_by_what_looks_like_one(
    tmp_path,
):
    """In seconds beside the other's microseconds."""
    path = write(tmp_path)
    rows = "".join(f"{1e-6 * t:.9g},{x:.9g}\n" for t, x in zip(TIME, TOLD, strict=True))
    (tmp_path / "command.csv").write_text("t [s],target\n" + rows)
    (tmp_path / "state.yaml").write_text(
        "join: command.csv\ncolumns: {timestamp: {channel: time, scale: 1.0e-6}, "
        "positions: a.j.position, event: null, target: a.j.position_command}"
    )
    found = read_recording(path)
    np.testing.assert_allclose(found.time, 1e-6 * TIME, atol=1e-12)
    np.testing.assert_allclose(found["a.j.position_command"], TOLD, atol=1e-9)
