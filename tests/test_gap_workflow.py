"""A few cases of the development benchmark, from files to verdict."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gap_benchmark.cases import cases, make, write
from test_gap_report import small_case

from makebreak.gap import read_recordings, workflow
from makebreak.gap.residuals import mechanism_candidates
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.mechanism_measure import measure
from makebreak.gap.workflow import run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene
from makebreak.models.scene_file import write_scene

ROOT = Path(__file__).resolve().parent.parent


def _run(name: str, folder: Path):
    (case,) = [c for c in cases("development") if c.name == name]
    truth = write(case, folder, make(case))
    result = run_gap(folder / "scene.yaml", [folder / "recording.csv"])
    json.dumps(result.to_json(), allow_nan=False)
    return truth, result


def test_background_within_tolerance_is_no_gap(tmp_path):
    _, result = _run("02_pendulum_none", tmp_path)
    assert result.verdict == "no_gap"
    assert result.effects == []
    # The links are off by up to 3.5 %: without the background it would be 80.
    assert result.gap.before < 2.0


@pytest.mark.parametrize(
    ("name", "parameter", "tolerance"),
    [
        ("28_pendulum_actuator_gain", "gain", 0.002),
        pytest.param(
            "17_pendulum_joint_quadratic_drag",
            "coefficient",
            0.01,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_hidden_effect_is_named_and_measured(tmp_path, name, parameter, tolerance):
    truth, result = _run(name, tmp_path)
    (hidden,) = truth["effects"]
    assert result.verdict == "gap_named"
    (found,) = result.effects
    assert (found.kind, list(found.at)) == (hidden["kind"], [hidden["at"]])
    assert found.parameters[parameter].value == pytest.approx(
        hidden["parameters"][parameter], rel=tolerance
    )
    assert result.gap.after < 0.1 * result.gap.before
    assert result.where


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["28_pendulum_actuator_gain", "38_pendulum_sensor_delay"],
)
def test_nothing_is_missing_from_a_repaired_scene(tmp_path, name):
    # Drives and sensors, which rigid-body dynamics do not know of.
    _, result = _run(name, tmp_path)
    scene = read_scene(tmp_path / "scene.yaml")
    repaired = replace(scene, effects=result.scene_effects())
    write_scene(repaired, tmp_path / "repaired.yaml", "With what was named.")
    again = run_gap(tmp_path / "repaired.yaml", [tmp_path / "recording.csv"])
    assert again.verdict == "no_gap"
    assert again.gap.before == pytest.approx(result.gap.after, rel=0.1)


@pytest.mark.slow
def test_late_commands_and_late_sensors_are_told_as_one(tmp_path):
    truth, result = _run("34_cartpole_input_delay", tmp_path)
    (hidden,) = truth["effects"]
    assert result.verdict == "ambiguous"
    (found,) = result.effects
    (other,) = found.indistinguishable_from
    assert (found.kind, other.kind) == ("input_delay", "sensor_delay")
    delay = hidden["parameters"]["delay"]
    assert found.parameters["delay"].value == pytest.approx(delay, rel=0.02)
    # Samples that show what was before a window do not count as errors.
    assert result.gap.after < 1.3


@pytest.mark.slow
def test_windows_start_with_the_twist_of_an_elastic_joint(tmp_path):
    _, result = _run("42_arm_joint_elasticity", tmp_path)
    assert [e.kind for e in result.effects] == ["joint_elasticity"]
    assert result.gap.after < 1.5 < 10.0 < result.gap.before


@pytest.mark.slow
def test_what_is_outside_the_catalogue_gets_no_verdict_of_named(tmp_path):
    _, result = _run("84_pendulum_bouc_wen", tmp_path)
    assert result.verdict == "gap_unnamed"
    assert result.effects == []
    assert "too little to be named" in result.says
    assert result.unexplained


def test_the_workflow_imports_nothing_of_the_benchmark():
    for file in (ROOT / "gap").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not any("benchmark" in n or "tests" in n for n in names), file


def test_a_step_that_cannot_be_judged_is_kept_and_not_told(tmp_path, monkeypatch):
    """Where no window can be simulated there is no number to tell (NaN is no JSON)."""
    scene_path, recording_path = small_case(tmp_path)
    scene = read_scene(scene_path)
    scene = replace(scene, plant=replace(scene.plant, time_step=0.001))
    recordings = read_recordings([recording_path])
    dynamics = SceneDynamics(scene)
    fine, told = workflow._settle_step(scene, recordings, dynamics, 1)
    assert fine.plant.time_step == 0.0 and [f.kind for f in told] == ["time_step"]

    def nowhere(both, jobs):
        return [[np.full_like(x, np.nan) for x in each()] for each in both]

    monkeypatch.setattr(workflow, "side_by_side", nowhere)
    same, told = workflow._settle_step(scene, recordings, dynamics, 1)
    assert same is scene and told == []


def test_a_gain_does_not_explain_away_what_models_are_off_by(tmp_path):
    """A gain of the model's side and one of the measured effort cancel everything."""
    scene_path, recording_path = small_case(tmp_path)
    scene = read_scene(scene_path)
    problem = MechanismProblem(scene, read_recordings([recording_path]))
    nuisances = problem.nuisances()
    found = mechanism_candidates.candidates(problem, nuisances, problem.base())
    problem._found = [c for c in found if c.kind == "actuator_gain"]
    rich, _ = mechanism_candidates.rich_columns(problem, problem._found)
    assert rich.shape[1] == 1
    left = problem.base()  # Friction, as something that models lack.
    np.testing.assert_array_equal(problem._with_best(left, rich), left)


def test_effects_that_no_scene_can_have_leave_windows_that_did_not_end(tmp_path):
    """A link cannot be 20 kg lighter than it is. The run goes on with the others."""
    scene_path, recording_path = small_case(tmp_path)
    scene, recordings = read_scene(scene_path), read_recordings([recording_path])
    problem = MechanismProblem(scene, recordings)
    link = problem.dynamics.plant.GetJointByName("j1").child_body().name()
    impossible = Effect("link_mass", [f"p.{link}"], {"mass": -20.0})
    gap, *_ = measure(problem.scene, [impossible], [], problem, every=False)
    assert gap.failed == (0, gap.n_windows) and gap.n_windows > 0
    # The equations of motion decide, and why it is so is told.
    assert gap.window_s == 0.0 and gap.before < gap.after < np.inf
    assert "with the effects" in gap.failure and "mass" in gap.failure
