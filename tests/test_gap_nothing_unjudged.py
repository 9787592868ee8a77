"""`no_gap` is said where every measured channel was compared, and nowhere else."""

import csv
import json

import numpy as np
import pytest
from gap_benchmark.cases import cases, make, write
from test_gap_contact import touched

from makebreak.gap.problem import DISTANCES
from makebreak.gap.workflow import run_gap
from makebreak.scripts.cli import commands as cli


def with_columns(recording, more: dict[str, np.ndarray]):
    """The recording, with these columns written beside its own."""
    rows = list(csv.reader(recording.open()))
    for name, values in more.items():
        rows[0].append(name)
        for row, value in zip(rows[1:], values, strict=True):
            row.append(f"{value:.9g}")
    with recording.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return recording


def test_shapes_that_meet_are_no_agreement_of_motions(tmp_path):
    """A tip that touches a ball of the size that the scene says. Nothing asks whether
    the ball moved as forces on it have it: this one is carried about by a sine."""
    scene, file = touched(tmp_path, 0.04, 0.04)
    result = run_gap(scene, [file])
    assert (result.verdict, result.effects) == ("not_judged", [])
    how = {c.channel: c.judged for c in result.channels}
    assert how["ball.ball.x"] == how["gantry.x.position"] == DISTANCES
    assert "their motion was not compared" in result.says
    assert "so the scene is not confirmed" in result.says
    for channel in how:
        assert channel in result.says


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pendulum")
    (case,) = [c for c in cases("development") if c.name == "02_pendulum_none"]
    write(case, folder, make(case))
    return folder


@pytest.mark.parametrize(
    "channel", ["pendulum.lower.fx", "pendulum.lower.z", "pendulum.lower.wx"]
)
def test_a_channel_that_no_equation_holds_takes_back_no_gap(pendulum, channel):
    recording = pendulum / "recording.csv"
    plain = recording.read_text()
    n = plain.count("\n") - 1
    noise = np.random.default_rng(0).normal(size=n)
    try:
        with_columns(recording, {channel: 5.0 + noise})
        result = run_gap(pendulum / "scene.yaml", [recording])
    finally:
        recording.write_text(plain)
    assert (result.verdict, result.effects) == ("not_judged", [])
    assert f"Not judged: {channel}." in result.says


def test_with_the_channel_left_out_it_is_no_gap_again(pendulum, tmp_path):
    recording = pendulum / "recording.csv"
    copy = tmp_path / "recording.csv"
    copy.write_text(recording.read_text())
    n = copy.read_text().count("\n") - 1
    with_columns(copy, {"pendulum.lower.fx": np.full(n, 3.0)})
    (tmp_path / "recording.yaml").write_text("columns: {pendulum.lower.fx: null}\n")
    noise = pendulum / "noise.json"
    if noise.exists():
        (tmp_path / "noise.json").write_text(noise.read_text())
    assert run_gap(pendulum / "scene.yaml", [copy]).verdict == "no_gap"


ROD = """<robot name="arm"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 -0.2"/><mass value="1"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j1" type="continuous"><parent link="base"/><child link="rod"/>
<axis xyz="0 1 0"/></joint></robot>"""


def test_effects_with_which_nothing_can_be_simulated_are_not_named(tmp_path):
    """Efforts that go with the angle alone: a spring on a rod without a mass."""
    (tmp_path / "arm.urdf").write_text(ROD)
    time = np.arange(0.0, 3.0, 0.01)
    q = 0.3 * np.sin(5.0 * time)
    np.savetxt(
        tmp_path / "log.csv", np.column_stack([time, q, 1.78 * q]), delimiter=",",
        header="time,j1_position,j1_effort", comments="", fmt="%.6f",
    )  # fmt: skip
    assert cli.main(["gap", str(tmp_path / "arm.urdf"), str(tmp_path / "log.csv"),
                 "--out", str(tmp_path / "out")]) in (0, 1, 3)  # fmt: skip
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["effects"] == [] and result["verdict"] == "gap_unnamed"
    assert any("could not be judged by simulation" in t["why"] for t in result["tried"])
