"""`no_gap` is said where every measured channel was compared, and nowhere else."""

import csv

import numpy as np
import pytest
from gap_benchmark.cases import cases, make, write
from test_gap_contact import touched

from makebreak.gap.problem import DISTANCES
from makebreak.gap.workflow import run_gap


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
