"""Files as other programs write them, and what is refused of them in one line."""

import gzip
import io
import json
import zipfile

import numpy as np
import pytest

from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.table import read_table

N = 40
T = np.round(0.01 * np.arange(N), 4)
Q = np.round(np.sin(7.0 * T), 6)


def rows(separator=",", point=".", quote="", header=("time", "a.j.position")):
    lines = [separator.join(f"{quote}{name}{quote}" for name in header)]
    for t, q in zip(T, Q, strict=True):
        cells = (f"{t:.4f}".replace(".", point), f"{q:.6f}".replace(".", point))
        lines.append(separator.join(f"{quote}{cell}{quote}" for cell in cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.csv", rows(";", ",").encode()),
        ("a.csv", rows(";", ".").encode()),
        ("a.csv", rows("\t", ",").encode()),
        ("a.csv", rows(",", ".", '"').encode()),
        ("a.csv", rows(",", ",", '"').encode()),
        ("a.CSV", rows().encode()),
        ("a.csv.gz", gzip.compress(rows().encode())),
        ("a.csv", rows().replace("\n", "\r\n").encode("utf-8-sig")),
    ],
    ids=["semicolons", "semicolons and points", "tabs", "quoted", "quoted commas",
         "capitals", "gzip", "windows"],
)  # fmt: skip
def test_other_ways_to_write_a_csv_are_read(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    recording = read_recording(tmp_path / name)
    np.testing.assert_array_equal(recording.time, np.round(T, 4))
    np.testing.assert_array_equal(recording["a.j.position"], Q)
    assert recording.name == "a"


NO_HEADER = "columns: {column_1: time, column_2: a.j.position}"


@pytest.mark.parametrize(
    "content",
    [rows().encode(), rows(";", ",").encode(), gzip.compress(rows("\t").encode())],
    ids=["commas", "semicolons", "gzip"],
)
def test_the_first_line_of_numbers_is_a_row_and_no_header(tmp_path, content):
    file = tmp_path / ("a.csv.gz" if content[:2] == b"\x1f\x8b" else "a.csv")
    text = gzip.decompress(content) if file.suffix == ".gz" else content
    body = text.split(b"\n", 1)[1]
    file.write_bytes(gzip.compress(body) if file.suffix == ".gz" else body)
    (tmp_path / "a.yaml").write_text(NO_HEADER)
    recording = read_recording(file)
    np.testing.assert_array_equal(recording["a.j.position"], Q)
    ((kind, says),) = recording.notes
    assert kind == "no_header" and "column_1 to column_2" in says
    # Row 3 is the third line.
    file = tmp_path / "a.csv"
    lines = body.decode().splitlines()
    file.write_text("\n".join([*lines[:2], "oops", *lines[3:]]))
    with pytest.raises(ValueError, match="row 3 has 1 cells, expected 2"):
        read_recording(file)


@pytest.mark.parametrize("first", ["-0.9584", "0"])
def test_a_number_above_numbers_of_one_column_is_the_first_row(tmp_path, first):
    (tmp_path / "q.txt").write_text("\n".join([first, *map(str, Q)]))
    table = read_table(tmp_path / "q.txt")
    np.testing.assert_array_equal(table.columns["column_1"], [float(first), *Q])


def test_numbers_that_count_the_columns_are_their_names(tmp_path):
    (tmp_path / "a.csv").write_text(rows(header=("0", "1")))
    (tmp_path / "a.yaml").write_text('columns: {"0": time, "1": a.j.position}')
    recording = read_recording(tmp_path / "a.csv")
    assert len(recording.time) == N and not recording.notes


def test_lists_in_cells_are_columns_of_their_own(tmp_path):
    lines = ["t,q,state"] + [
        f'{t},"[{q}, {2 * q}]",moving' for t, q in zip(T, Q, strict=True)
    ]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    (tmp_path / "a.csv.yaml").write_text(
        "columns: {t: time, 'q[0]': a.j.position, 'q[1]': a.k.position, state: null}"
    )
    recording = read_recording(tmp_path / "a.csv")
    np.testing.assert_array_equal(recording["a.k.position"], 2 * Q)


def test_text_in_a_column_that_is_left_out_is_nobodys_business(tmp_path):
    text = rows().splitlines()
    lines = [text[0] + ",state"] + [line + ",moving" for line in text[1:]]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match='column state, row 1: got "moving"'):
        read_recording(tmp_path / "a.csv")
    (tmp_path / "a.yaml").write_text("columns: {state: null}")
    np.testing.assert_array_equal(read_recording(tmp_path / "a.csv")["a.j.position"], Q)


GARBAGE = {
    3: "0.02,1e279",
    7: "0.06",
    9: "0.08,oops",
    12: "0.09,0.1",  # Before the row above it.
}


def test_bad_rows_are_refused_by_row_and_left_out_where_asked(tmp_path):
    lines = rows().splitlines()
    for row, line in GARBAGE.items():
        lines[row] = line
    file = tmp_path / "a.csv"
    for row in (7, 9, 3):  # In the order in which they are found.
        file.write_text("\n".join(lines))
        with pytest.raises(ValueError, match=f"a.csv: .*row {row}( |:)") as error:
            read_recording(file)
        assert "\n" not in str(error.value)
        lines[row] = rows().splitlines()[row]
    for row, line in GARBAGE.items():
        lines[row] = line
    file.write_text("\n".join(lines))
    recording = read_recording(file, skip_bad_rows=True)
    gone = np.array(sorted(GARBAGE)) - 1
    np.testing.assert_array_equal(recording["a.j.position"], np.delete(Q, gone))
    assert len(recording.episodes) == 1
    told = dict(recording.notes)
    assert "3 bad rows" in told["rows_bad"] and "row 7" in told["rows_bad"]
    assert "stamps_back" in told  # Which is no matter of being asked.


def test_a_row_that_comes_twice_is_read_once_and_of_another_the_first(tmp_path):
    lines = rows().splitlines()
    file = tmp_path / "a.csv"
    file.write_text("\n".join([*lines[:6], lines[5], lines[5], *lines[6:]]))
    recording = read_recording(file)
    np.testing.assert_array_equal(recording["a.j.position"], Q)
    ((kind, says),) = recording.notes
    assert kind == "rows_twice" and "2 rows" in says
    time = lines[5].split(",")[0]
    file.write_text("\n".join([*lines[:6], f"{time},0.123", *lines[6:]]))
    recording = read_recording(file)
    np.testing.assert_array_equal(recording["a.j.position"], Q)
    ((kind, says),) = recording.notes
    assert kind == "stamps_twice" and "1 rows" in says


@pytest.mark.parametrize(
    "scale, unit", [(1e9, "ns"), (1e6, "us"), (1e3, "ms")], ids=["ns", "us", "ms"]
)
def test_time_in_other_units_is_refused_with_the_map_to_write(tmp_path, scale, unit):
    lines = ["time,a.j.position"] + [
        f"{scale * t:.0f},{q}" for t, q in zip(T, Q, strict=True)
    ]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=f"as if time were in {unit}") as error:
        read_recording(tmp_path / "a.csv")
    mapping = str(error.value).split("a.yaml: ")[1]
    (tmp_path / "a.yaml").write_text(mapping)
    np.testing.assert_allclose(read_recording(tmp_path / "a.csv").time, T, atol=1e-9)


def test_a_lacking_time_is_said_with_how_to_map_it(tmp_path):
    (tmp_path / "monday.csv").write_text(rows(header=("t", "a.j.position")))
    with pytest.raises(ValueError, match="needs the column time, got t, a") as error:
        read_recording(tmp_path / "monday.csv")
    mapping = str(error.value).split("monday.yaml: ")[1]
    (tmp_path / "monday.yaml").write_text(mapping)
    np.testing.assert_array_equal(read_recording(tmp_path / "monday.csv").time, T)


@pytest.mark.parametrize(
    "sidecar, message",
    [
        ({"columns": {"time": {"channel": "time", "scale": 0}}}, "scale is 0"),
        ({"noise": {"a.k.position": 1e-3}}, 'noise of "a.k.position", which the rec'),
        ({"filters": {"a.i.position": "delay, 1 ms"}}, 'did you mean "a.j.position"'),
        ({"filters": 3}, "filters must be names with values"),
        ({"noise": {"a.j.position": float("inf")}}, "is inf, expected a finite number"),
        ({"ignore": {"from": 0.2}}, "ignore, to is None"),
        ({"ignore": [{"from": 0.2, "to": 0.1}]}, "ignore is from 0.2 to 0.1"),
        ({"ignore": [{"from": 8, "to": 9}]}, "no row is there, time goes from 0 to"),
        ({"ignore": [{"from": -1, "to": 9}]}, "leaves no 10 rows"),
        ({"ignore": [16, 18]}, "expected a list of {from: 16, to: 18}"),
    ],
)
def test_what_a_sidecar_cannot_mean_is_refused(tmp_path, sidecar, message):
    (tmp_path / "a.csv").write_text(rows())
    text = json.dumps(sidecar).replace("Infinity", ".inf")
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ValueError) as error:
        read_recording(tmp_path / "a.csv")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_sidecar_may_have_the_files_whole_name_but_there_is_one(tmp_path):
    (tmp_path / "a.csv").write_text(rows())
    (tmp_path / "a.csv.yaml").write_text("noise: {a.j.position: 0.5}")
    assert read_recording(tmp_path / "a.csv").channels["a.j.position"].noise == 0.5
    (tmp_path / "a.yaml").write_text("provenance: rig 2")
    with pytest.raises(ValueError, match="two sidecars: a.yaml and a.csv.yaml"):
        read_recording(tmp_path / "a.csv")


def test_spans_that_are_left_out_are_in_no_episode_and_said(tmp_path):
    (tmp_path / "a.csv").write_text(rows())
    (tmp_path / "a.yaml").write_text("ignore: [{from: 0.105, to: 0.2}]")
    recording = read_recording(tmp_path / "a.csv")
    spans = [(e.first, e.last, e.is_start) for e in recording.episodes]
    assert spans == [(0, 11, True), (21, N, False)]
    assert recording.notes[0][0] == "ignored"


def npz_of(members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def npy(header, body=b""):
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + body


HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }")


@pytest.mark.parametrize(
    "content, message",
    [
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }", b"0" * 8),
         "is no npz file"),
        (npz_of({"time.npy": HUGE}), "cannot be read|is no npz"),
        (npz_of({"time.npy": b"bogus"}), "time is no array"),
        (npz_of({"time.npy": npy("{'descr': '|O', 'fortran_order': False, "
                                 "'shape': (2,), }", b"cos\nsystem\n.")}), "npz"),
    ],
    ids=["npy", "huge", "bogus", "pickle"],
)  # fmt: skip
def test_npz_files_that_lie_are_refused(tmp_path, content, message):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_recording(tmp_path / "a.npz")
    assert "\n" not in str(error.value)


def test_a_gzip_file_that_is_cut_is_refused(tmp_path):
    whole = gzip.compress(rows().encode())
    (tmp_path / "a.csv.gz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="is no whole gzip file"):
        read_recording(tmp_path / "a.csv.gz")


@pytest.mark.parametrize(
    "stamp, zone",
    [
        ("{d}T{t}.{f}", ""),
        ("{d} {t}.{f}", "Z"),
        ("{d} {t},{f}", "+01:00"),
        ('"{d} {t}.{f}"', "+0100"),
    ],
)
def test_dates_are_read_as_seconds(tmp_path, stamp, zone):
    """2026-11-27 22:00 UTC is 1795816800 s, as `date -u -d ... +%s` says."""
    hour = 23 if "1" in zone else 22
    rows = [
        stamp.format(d="2026-11-27", t=f"{hour}:00:0{k}", f="250") + f"{zone};{k}"
        if not stamp.startswith('"')
        else stamp.format(d="2026-11-27", t=f"{hour}:00:0{k}", f=f"250{zone}") + f";{k}"
        for k in range(9)
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["when;x", *rows]) + "\n")
    table = read_table(path)
    np.testing.assert_allclose(
        table.columns["when"], 1795816800.25 + np.arange(9), atol=1e-6
    )


ABOVE = "Robot: rig 2\nRate; 100\n\n"


@pytest.mark.parametrize(
    "head, names",
    [
        (ABOVE + "time;q1;q2\n", ["time", "q1", "q2"]),
        ("time;q1;q2\ns;deg;rad\n", ["time [s]", "q1 [deg]", "q2 [rad]"]),
        (ABOVE + "time;q1;q2\ns;[\u00b0];-\n", ["time [s]", "q1 [\u00b0]", "q2"]),
        ("% made by hand\n% time; q1; q2\n", ["time", "q1", "q2"]),
        (ABOVE, []),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_names_are_above_the_first_row_of_numbers(tmp_path, head, names, encoding):
    """Whatever a program writes above them, and with units below them."""
    rows = "".join(f"{t:.4f};{q:.6f};n/a\n" for t, q in zip(T, Q, strict=True))
    path = tmp_path / "a.csv"
    path.write_bytes((head + rows).encode(encoding))
    if head == ABOVE:  # Names of another number of cells: rows say so.
        with pytest.raises(ValueError, match="row 1 has 3 cells, expected 2"):
            read_table(path)
        return
    columns = read_table(path).columns
    assert list(columns) == names
    np.testing.assert_array_equal(columns[names[1]], Q)
    assert np.isnan(columns[names[2]]).all()
