"""What is only reported on decides nothing: garbage there changes no parameter."""

import numpy as np
import pytest
from gap_benchmark.cases import cases, make, write
from test_gap_contact import ball_scene, rolled, touched

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.split import split
from makebreak.gap.data.table import write_recording
from makebreak.gap.workflow import run_gap


def mechanism(folder):
    (case,) = [c for c in cases("development") if c.name == "28_pendulum_actuator_gain"]
    write(case, folder, make(case))
    return folder / "scene.yaml", folder / "recording.csv"


def rolling(folder):
    return ball_scene(folder), rolled(folder, np.deg2rad(0.01))


def touching(folder):
    return touched(folder, 0.04, 0.043)


def noise(y: float, rng) -> float:
    return float(rng.normal(scale=3.0))


def shrunk(y: float, rng) -> float:
    """Less wrong, so that windows and touches are still found."""
    return 0.8 * y


def spoil_what_is_reported(file, spoil) -> int:
    """Other numbers in place of all that was measured there. Returns: how many
    rows."""
    (recording,) = read_recordings([file])
    reported = {
        int(row) for part in split([recording]).reported for row in part.row
    }  # Of the file's rows, from 1.
    head, *lines = file.read_text().splitlines()
    names, rng = head.split(","), np.random.default_rng(5)
    first = int(recording.row[0])
    spoilt = 0
    for k, line in enumerate(lines):
        if k + first not in reported:
            continue
        cells = line.split(",")
        for i, name in enumerate(names):
            if name not in ("time", "episode"):
                cells[i] = repr(spoil(float(cells[i] or 0.0), rng))
        lines[k] = ",".join(cells)
        spoilt += 1
    file.write_text("\n".join([head, *lines]) + "\n")
    return spoilt


@pytest.mark.parametrize(
    ("trials", "whole"), [(1, 0), (3, 0), (4, 1), (5, 1), (8, 2), (10, 2)]
)
def test_of_four_trials_the_last_is_held_out_and_not_the_end_of_each(
    tmp_path, trials, whole
):
    """A wall that each trial meets last would never be fitted."""
    rows = np.arange(1000.0)
    columns = {
        "time": np.tile(rows / 100.0, trials),
        "episode": np.repeat(range(trials), 1000),
        "p.j.position": np.zeros(1000 * trials),
    }  # fmt: skip
    write_recording(tmp_path / "run.csv", columns)
    parts = split(read_recordings([tmp_path / "run.csv"]))
    [first], [last] = parts.decided, parts.reported
    lengths = [len(first.time[e.rows]) for e in first.episodes]
    assert lengths == [1000] * (trials - whole) if whole else [800] * trials
    assert len(last.time) == 1000 * trials - sum(lengths)


@pytest.mark.parametrize(
    ("make_files", "spoil"),
    [
        pytest.param(mechanism, noise, marks=pytest.mark.slow),
        pytest.param(rolling, shrunk, marks=pytest.mark.slow),
        (touching, shrunk),
    ],
)
def test_garbage_in_what_is_reported_on_changes_no_parameter(
    tmp_path, make_files, spoil
):
    scene, file = make_files(tmp_path)
    clean = run_gap(scene, [file])
    assert clean.effects and clean.verdict in ("gap_named", "ambiguous")
    assert clean.to_json()["gap"]["held_out"] is True
    (recording,) = read_recordings([file])
    assert spoil_what_is_reported(file, spoil) > 0.15 * len(recording.time)
    spoilt = run_gap(scene, [file])
    # They may veto effects, and change no value: of what is named or tried it is the
    # same, bit for bit, and so is what was measured and checked.
    for key in ("channels", "checks"):
        assert clean.to_json()[key] == spoilt.to_json()[key], key
    told = [
        {
            (e["kind"], str(e["at"])): {
                name: p["value"] for name, p in e["parameters"].items()
            }
            for e in (*json["effects"], *json["tried"])
        }
        for json in (clean.to_json(), spoilt.to_json())
    ]
    assert told[0] == told[1]
    decided, other = (
        [w for w in each.to_json()["where"] if not w["held_out"]]
        for each in (clean, spoilt)
    )
    assert decided == other
    # What is reported is of those rows: there the repaired scene does not do.
    assert spoilt.verdict == "gap_unnamed"
    assert not spoilt.gap.after < 3.0 * clean.gap.after


def test_nothing_is_named_where_nothing_can_be_held_out(tmp_path):
    scene, file = mechanism(tmp_path)
    head, *lines = file.read_text().splitlines()
    file.write_text("\n".join([head, *lines[:240]]) + "\n")  # 1.2 s of one episode.
    result = run_gap(scene, [file])
    assert result.effects == [] and result.verdict == "gap_unnamed"
    assert "too short" in result.says
    assert result.to_json()["gap"]["held_out"] is False
