"""`makebreak inspect` on logs and folders, and sidecars that serve another log."""

import json

import numpy as np
import pytest
import yaml
from front_doors import exact

from makebreak.scripts.cli import main
from makebreak.scripts.cli.gap_command import known_sidecars
from makebreak.scripts.runner.outputs import OutputFolder

SIDECAR = """columns:
  a: {channel: arm.joint1.position, scale: 0.5}
  b: arm.joint2.position
ignore: [{from: 1, to: 2}]
"""


@pytest.fixture
def folder(tmp_path):
    """A robot, a log as npz, one in csv with efforts that are before a gear of 50."""
    _, log = exact("planar", tmp_path, np.random.default_rng(4))
    columns = {"time": log.time, **log.columns}
    np.savez(tmp_path / "good.npz", **columns)
    for name in columns:
        if name.endswith("effort"):
            columns[name] = columns[name] / 50.0
    write(tmp_path / "geared.csv", columns)
    (tmp_path / "broken.csv").write_text("")
    return tmp_path


def write(path, columns):
    rows = [",".join(map(repr, row)) for row in
            np.stack(list(columns.values()), axis=1).tolist()]  # fmt: skip
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")


def test_a_folder_is_listed_with_its_robot_and_what_contents_say(folder, capsys):
    assert main(["inspect", str(folder)]) == 0
    out = capsys.readouterr().out
    lines = {line.split()[0].rpartition("/")[2]: line for line in out.splitlines()
             if line.startswith(str(folder))}  # fmt: skip
    assert "is empty" in lines["broken.csv"]
    for name, kind in (("good.npz", "npz"), ("geared.csv", "csv")):
        assert lines[name].split()[1:4] == [kind, "1200", "11.99"]
        assert "2 of 2  effort_measured" in lines[name]
    assert f"joints are those of {folder / 'arm.urdf'}" in out
    assert "50 times smaller than the model needs" in out and "scale: 50.0" in out


def test_all_of_it_is_there_as_json(folder, capsys):
    assert main(["inspect", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    logs = {each["file"].rpartition("/")[2]: each for each in found["logs"]}
    assert logs["good.npz"]["joints"] == ["arm.joint1", "arm.joint2"]
    effort = {c["column"]: c for c in logs["geared.csv"]["columns"]}["joint1_effort"]
    assert effort["channel"] == "arm.joint1.effort_measured"
    assert effort["scale"] == pytest.approx(50.0)
    assert effort["rate_hz"] == pytest.approx(100.0)
    assert logs["broken.csv"]["refused"].endswith("is empty")


def test_sidecars_of_several_logs_are_written_where_asked(folder, capsys):
    out = folder / "proposed"
    (folder / "broken.csv").unlink()
    assert main(["inspect", str(folder / "*.*[vz]"), "--out", str(out)]) == 0
    capsys.readouterr()
    names = sorted(path.name for path in out.glob("*.yaml"))
    assert names == ["geared.yaml", "good.yaml"]
    assert "joint1_effort" in yaml.safe_load((out / "good.yaml").read_text())["columns"]


def friday(folder, names=("a", "b")):
    t = 0.01 * np.arange(100)
    write(folder / "friday.csv", {"t": t} | {n: np.sin(t + len(n)) for n in names})
    (folder / "monday.yaml").write_text(SIDECAR)
    return folder / "friday.csv"


def test_mondays_sidecar_serves_fridays_log_and_it_is_said(folder, capsys):
    log, robot = friday(folder), folder / "arm.urdf"
    assert main(["inspect", str(log), "--robot", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "friday.csv has no sidecar: columns as in monday.yaml" in out
    assert "arm.joint1.position x 0.5" in out and "ignore" not in out
    assert main(["inspect", str(robot), str(log)]) == 0  # As `gap` takes them.
    assert capsys.readouterr().out == out
    scene = folder / "scenes" / "scene.yaml"
    scene.parent.mkdir()
    scene.write_text("directives: []\n")
    with OutputFolder(folder / "out", "gap") as files:
        found, notes = known_sidecars(scene, [log], files.file, None)
        assert yaml.safe_load(found[log].read_text()) == {
            "columns": yaml.safe_load(SIDECAR)["columns"]
        }
    assert "columns as in monday.yaml" in notes[0]


def test_a_sidecar_that_does_not_fit_is_refused_if_given_and_else_not_used(
    folder, capsys
):
    log, robot = friday(folder, ("a", "c")), folder / "arm.urdf"
    words = ["inspect", str(log), "--robot", str(robot)]
    assert main([*words, "--sidecar", str(folder / "monday.yaml")]) == 2
    err = capsys.readouterr().err
    assert "does not fit friday.csv: it names b; friday.csv has t, a, c" in err
    assert err.count("\n") == 1
    assert main(words) == 0
    assert "monday.yaml" not in capsys.readouterr().out.partition("Proposed")[2]
    other = SIDECAR.replace("0.5", "0.25")
    (folder / "sunday.yaml").write_text(other)
    assert main(["inspect", str(friday(folder)), "--robot", str(robot)]) == 0
    out = capsys.readouterr().out
    assert "contradict each other: monday.yaml, sunday.yaml; none is used" in out
