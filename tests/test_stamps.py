"""Rows whose stamps do not increase."""

import numpy as np
import pytest

from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.stamps import mended

N = 400
T = 0.01 * np.arange(N)
Q = np.sin(3.0 * T) + 0.3 * np.cos(7.0 * T)


def log(t=T, q=Q, **more):
    columns = {"time": np.array(t), "q": np.array(q), **more}
    return mended("a.csv", columns, np.arange(len(columns["q"])) + 1)


def kinds(notes):
    return [kind for kind, _ in notes]


def test_of_stamps_that_increase_nothing_is_said():
    columns, row, notes = log()
    assert notes == [] and len(row) == N
    np.testing.assert_array_equal(columns["q"], Q)


def test_rows_that_come_late_are_sorted():
    """As of two threads that write one file."""
    order = np.arange(N)
    for k in range(50, 350, 30):
        order[k : k + 8] = np.random.default_rng(k).permutation(order[k : k + 8])
    columns, row, notes = log(T[order], Q[order])
    np.testing.assert_array_equal(columns["time"], T)
    np.testing.assert_array_equal(columns["q"], Q)
    assert kinds(notes) == ["stamps_back"] and "put in the order" in notes[0][1]
    np.testing.assert_array_equal(row[order], np.arange(N) + 1)


@pytest.mark.parametrize("wrong", [0.2, 3.5, 1e9, -5.0])
def test_a_stamp_that_lies_is_left_out_with_its_row(wrong):
    t = T.copy()
    t[200] = wrong
    columns, row, notes = log(t)
    np.testing.assert_array_equal(row, np.delete(np.arange(N) + 1, 200))
    np.testing.assert_array_equal(columns["q"], np.delete(Q, 200))
    assert kinds(notes) == ["stamps_back"] and "1 stamps" in notes[0][1]


def test_a_clock_that_is_set_back_by_a_few_rows_leaves_no_row_twice():
    t = np.where(np.arange(N) >= 200, T - 0.045, T)
    columns, row, notes = log(t)
    assert (np.diff(columns["time"]) > 0.0).all()
    assert N - 6 <= len(row) < N  # Five rows lie where others were.
    assert kinds(notes) == ["stamps_back"]


def test_time_that_starts_again_is_another_episode():
    t = np.where(np.arange(N) >= 150, T - T[150], T)
    columns, row, notes = log(t)
    assert len(row) == N
    np.testing.assert_array_equal(columns["episode"], np.arange(N) >= 150)
    assert kinds(notes) == ["time_restarts"] and "row 151" in notes[0][1]


def test_of_rows_with_one_stamp_the_first_is_used_and_gaps_are_filled():
    t, q, v = T.copy(), Q.copy(), np.full(N, np.nan)
    t[101] = t[100]  # Another value.
    t[201], q[201], v[201] = t[200], np.nan, 5.0  # What the row before lacks.
    t[301], q[301] = t[300], q[300]  # The same.
    columns, row, notes = log(t, q, v=v)
    np.testing.assert_array_equal(row, np.delete(np.arange(N) + 1, [101, 201, 301]))
    np.testing.assert_array_equal(columns["q"], np.delete(Q, [101, 201, 301]))
    assert columns["v"][199] == 5.0
    told = dict(notes)
    assert told["stamps_twice"].startswith("a.csv: 1 rows have")
    assert told["rows_twice"].startswith("a.csv: 1 rows are")


def test_stamps_coarser_than_rows_are_spread():
    """Written with two digits, at 400 Hz."""
    t = 0.0025 * np.arange(N)
    columns, row, notes = log(np.floor(100.0 * t + 1e-9) / 100.0)
    assert len(row) == N and kinds(notes) == ["stamps_coarse"]
    np.testing.assert_allclose(columns["time"], t, atol=1e-9)


def test_rows_without_a_stamp_are_left_out():
    columns, row, notes = log(np.where(np.arange(N) % 50 == 7, np.nan, T))
    assert len(row) == N - 8 and kinds(notes) == ["stamps_missing"]
    assert "8 rows have no time" in notes[0][1]


def test_a_csv_with_all_of_them_is_read_and_each_is_said(tmp_path):
    t = np.where(np.arange(N) >= 250, T - T[250], T)
    t[100] = t[60]
    t[320:322] = t[321], t[320]
    q = Q.copy()
    q[320:322] = Q[321], Q[320]
    rows = [f"{a!r},{b!r}" for a, b in zip(t.tolist(), q.tolist(), strict=True)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,a.j.position", *rows]) + "\n")
    found = read_recording(path)
    assert [e.number for e in found.episodes] == [0, 1]
    assert kinds(found.notes)[0] == "time_restarts"
    assert "stamps_back" in kinds(found.notes)
