"""Wrong recordings through `makebreak gap`: one line, or a check that says so."""

import json

import numpy as np
import pytest
from test_gap_report import small_case

from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.findings import JointFacts, SceneFacts
from makebreak.gap.data.pieces import excerpt
from makebreak.gap.data.reading import read_recording
from makebreak.gap.data.table import write_recording
from makebreak.scripts.cli import commands as cli

Q, U, V = "p.j1.position", "p.j1.effort_command", "p.j1.velocity"


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The scene, and the lines of a recording that fits it."""
    folder = tmp_path_factory.mktemp("good")
    scene, recording = small_case(folder)
    head, *rows = recording.read_text().splitlines()
    assert head == f"time,{U},{Q},{V}" and len(rows) == 600
    return scene, head, rows


def without(head, rows, *columns):
    """The table without some columns, as text."""
    keep = [i for i, name in enumerate(head.split(",")) if name not in columns]
    return "\n".join(
        ",".join(line.split(",")[i] for i in keep) for line in [head, *rows]
    )


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda h, r: "", "is empty"),
        (lambda h, r: h, "has a header and no rows"),
        (lambda h, r: "\n".join([h, *r[:9], r[9].replace(",", ",x", 1), *r[10:]]),
         f"column {U}, row 10"),
        (lambda h, r: "\n".join(
            ["episode," + h, *(f"{int(i > 98)}," + x for i, x in enumerate(r[:102]))]
        ), "episode 1 has 3 rows, from 0.99 s on; expected at least 10"),
        (lambda h, r: "\n".join([h.replace("p.j1.pos", "p.j9.pos"), *r]),
         'no joint "p.j9" in the scene: did you mean "p.j1"?'),
        (lambda h, r: "\n".join([h.replace("effort_com", "position_com"), *r]),
         "position_command"),
        (lambda h, r: "\n".join([h, r[0].replace(",", "," + 14 * "9", 1), *r[1:]]),
         "expected a number in SI units"),
        (lambda h, r: "\n".join([h, *r[:12]]), "long enough for windows of 0.2 s"),
        (lambda h, r: without(h, r, Q), "no measured channel of the recordings"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_line_and_status_2(
    good, spoil, says, tmp_path, monkeypatch, capsys
):
    scene, head, rows = good
    monkeypatch.chdir(tmp_path)
    text = spoil(head, rows)
    (tmp_path / "run.csv").write_text(text + "\n" if text else "")
    assert cli.main(["gap", str(scene), "run.csv", "--out", "out", "--jobs", "1"]) == 2
    shown = capsys.readouterr().err.replace("\r", "\n").splitlines()
    said = [line for line in shown if line.startswith("makebreak: ")]
    assert len(said) == 1 and says in said[0], shown
    assert not any("Traceback" in line for line in shown)


def test_degrees_for_radians_are_said_first_and_the_run_goes_on(
    good, tmp_path, monkeypatch, capsys
):
    scene, head, rows = good
    monkeypatch.chdir(tmp_path)
    cells = [row.split(",") for row in rows]
    lines = [
        ",".join([t, u, repr(float(np.rad2deg(float(q)))), v]) for t, u, q, v in cells
    ]
    (tmp_path / "run.csv").write_text("\n".join([head, *lines]) + "\n")
    assert cli.main(["gap", str(scene), "run.csv", "--out", "out", "--jobs", "1"]) == 0
    assert "Doubtful data" in capsys.readouterr().out
    result = json.loads((tmp_path / "out/result.json").read_text())
    assert result["effects"] == [] and result["verdict"] != "gap_named"
    checks = result["checks"]
    assert [c["channel"] for c in checks if c["kind"] == "units"] == [Q]
    page = (tmp_path / "out/report.html").read_text()
    first = page[page.index('<section class="first">') : page.index("</section>")]
    assert "position is in degrees" in first


def columns(n=400, rate=100.0):
    t = np.arange(n) / rate
    rng = np.random.default_rng(0)
    return {
        "time": t,
        Q: np.sin(3.0 * t) + 1e-4 * rng.normal(size=n),
        U: np.cos(2.0 * t),
    }


def read(folder, table, name="a.csv"):
    write_recording(folder / name, table)
    return read_recording(folder / name)


def test_a_hole_in_time_is_a_break_and_lone_rows_are_told(tmp_path):
    table = columns()
    table["time"] = (
        table["time"] + 5.0 * (np.arange(400) >= 200) + 3.0 * (np.arange(400) >= 204)
    )
    recording = read(tmp_path, table)
    assert [(e.first, e.last) for e in recording.episodes] == [(0, 200), (204, 400)]
    assert [e.is_start for e in recording.episodes] == [True, False]
    [(kind, says)] = recording.notes
    assert kind == "hole"
    assert "2 holes in time, the longest of 5.01 s" in says and "4 rows" in says
    # Half a second is no break: lost rows are lost rows.
    table["time"] = columns()["time"] + 0.45 * (np.arange(400) >= 200)
    assert len(read(tmp_path, table, "b.csv").episodes) == 1


def test_a_joint_that_nothing_drives_and_a_dead_channel_are_told(tmp_path):
    table = columns()
    table[V] = np.zeros(400)
    table["p.j2.position"] = columns()[Q]
    facts = SceneFacts({f"p.j{i}": JointFacts(driven=True) for i in (1, 2)})
    found = check_recordings([read(tmp_path, table)], facts)
    assert [f.channel for f in found if f.kind == "no_command"] == ["p.j2"]
    assert [f.channel for f in found if f.kind == "stuck"] == [V]


@pytest.mark.parametrize("n", [400, 20_000])
def test_an_excerpt_is_evenly_spread_and_keeps_within_its_bounds(tmp_path, n):
    whole = read(tmp_path, columns(n), "a.npz")
    [same] = excerpt([whole], 1e9, 10**9)
    assert same is whole
    [part] = excerpt([whole], 40.0, 10**9)
    if n == 400:
        assert part is whole
        return
    assert 30.0 < part.duration_sec() <= 40.0
    # Of 17 pieces the 3rd, 9th and 15th: a third of them in each third of the time.
    starts = [part.time[e.first] for e in part.episodes]
    np.testing.assert_allclose(np.diff(starts), 200.0 / 3.0, atol=12.0)
    for episode in part.episodes:
        rows = np.searchsorted(whole.time, part.time[episode.rows])
        np.testing.assert_array_equal(np.diff(rows), 1)
        np.testing.assert_array_equal(whole[Q][rows], part[Q][episode.rows])
    [few] = excerpt([whole], 1e9, 5000)
    assert 2000 < len(few.time) <= 5000


def test_an_excerpt_of_short_episodes_takes_them_whole(tmp_path):
    table = columns(4000)
    table["episode"] = np.repeat(np.arange(40.0), 100)
    whole = read(tmp_path, table, "a.npz")
    [part] = excerpt([whole], 10.0, 10**9)
    assert [e.number for e in part.episodes] == [2, 6, 10, 14, 18, 22, 26, 30, 34, 38]
    assert all(e.last - e.first == 100 for e in part.episodes)
