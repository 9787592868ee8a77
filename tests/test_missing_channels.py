"""Channels that some episodes, or recordings, of a log lack."""

import numpy as np

from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording

T = np.arange(0.0, 4.0, 0.01)


def columns(**without):
    """Two episodes of a joint; without: {quantity: the episode that lacks it}."""
    rng = np.random.default_rng(0)
    found = {"time": np.tile(T, 2), "episode": np.repeat([0.0, 1.0], len(T))}
    curves = {
        "position": np.sin(T),
        "velocity": np.cos(T),
        "effort_measured": -np.sin(T),
    }
    for quantity, value in curves.items():
        y = np.tile(value, 2) + rng.normal(0.0, 1e-4, 2 * len(T))
        y[found["episode"] == without.get(quantity)] = np.nan
        found[f"arm.j1.{quantity}"] = y
    return found


def read(tmp_path, *tables):
    paths = [tmp_path / f"log{k}.csv" for k in range(len(tables))]
    for path, table in zip(paths, tables, strict=True):
        write_recording(path, table)
    recordings = read_recordings(paths)
    notes = [says for r in recordings for kind, says in r.notes
             if kind == "channel_missing"]  # fmt: skip
    return recordings, notes


def test_an_episode_without_velocities_is_used_without_them(tmp_path):
    (recording,), notes = read(tmp_path, columns(velocity=1))
    assert [e.number for e in recording.episodes] == [0, 1]
    assert notes == [
        "log0.csv, episode 1, has no sample of arm.j1.velocity, which others have: it "
        "is used without"
    ]
    (conditioned,), _ = condition([recording])
    assert len(conditioned.episodes) == 2


def test_an_episode_without_what_drove_the_joint_is_left_out(tmp_path):
    """An effort that is not there is not zero."""
    (recording,), notes = read(tmp_path, columns(effort_measured=0))
    assert [e.number for e in recording.episodes] == [1]
    assert notes == [
        "log0.csv, episode 0, has no sample of arm.j1.effort_measured, which others "
        "have: it is left out"
    ]


def test_so_is_a_recording(tmp_path):
    lacks = columns()
    del lacks["arm.j1.effort_measured"]
    recordings, notes = read(tmp_path, columns(), lacks)
    assert [r.name for r in recordings] == ["log0"]
    assert len(notes) == 1 and notes[0].startswith("log1.csv has no sample of arm.j1.")
