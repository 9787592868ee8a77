"""A run of `gap` that is stopped, by a budget or a signal, ends with what it has."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_gap_report import small_case

from makebreak.gap import budget as budgets
from makebreak.gap import workflow
from makebreak.gap.budget import Budget, Stopped
from makebreak.gap.data.reading import read_recordings
from makebreak.gap.report.files import write_report
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.workflow import run_gap
from makebreak.models.dynamics import SceneDynamics
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import read_scene
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.runner import interrupts

ROOT = Path(__file__).resolve().parent.parent
URDF = """<robot name="arm"><link name="base"/><link name="l1"><inertial>
<origin xyz="0 0 -.15"/><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".002"
ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j1" type="revolute">
<limit lower="-3" upper="3" effort="20" velocity="10"/><parent link="base"/>
<axis xyz="0 1 0"/><child link="l1"/></joint></robot>"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return small_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def evaluations(case) -> list[str]:
    """The stage of each time at which a whole run is asked whether to go on."""
    asked, stage = [], ["start"]

    def say(text):
        stage[0] = stage[0] if text.startswith(" ") else text

    with Budget(is_asked=lambda: bool(asked.append(stage[0]))).running():
        result = run_gap(case[0], [case[1]], progress=say)
    assert result.verdict == "gap_named" and not result.unfinished
    return asked


def is_consistent(folder: Path, given: Path) -> dict:
    """The JSON of a folder, and whether the other files say the same."""
    result = json.loads((folder / "result.json").read_text())
    added = len(result["effects"])
    before = read_scene(given).effects
    after = read_scene(folder / "scene.yaml").effects
    assert len(after) == len(before) + added
    for effect, told in zip(after[len(before) :], result["effects"], strict=True):
        assert effect.kind == told["kind"]
        for name, value in effect.parameters.items():
            assert value == pytest.approx(told["parameters"][name]["value"])
    page = (folder / "report.html").read_text()
    assert all(effect["kind"] in page for effect in result["effects"])
    assert not any(word in page for word in (">nan", ">inf", " nan ", " inf "))
    unfinished = result["unfinished"]
    assert unfinished, "a run that was stopped says what is undone"
    assert all(what in result["says"] for what in unfinished)
    assert [c["says"] for c in result["checks"] if c["kind"] == "unfinished"]
    assert result["verdict"] not in ("gap_named", "no_gap")
    return result


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_wherever_it_is_stopped_the_answer_is_whole(case, evaluations, share, tmp_path):
    stop_at, asked = int(share * len(evaluations)), []

    def is_asked():
        asked.append(0)
        return len(asked) > stop_at

    with Budget(is_asked=is_asked).running():
        result = run_gap(case[0], [case[1]])
    if not result.unfinished:  # What came after was short enough to be done.
        assert evaluations[stop_at] == "simulating held-out windows"
        return
    write_report(result, read_scene(case[0]), tmp_path)
    found = is_consistent(tmp_path, case[0])
    assert found["says"].startswith("Interrupted; not done: ")
    if found["effects"]:
        [effect] = found["effects"]
        assert effect["kind"] == "joint_coulomb_friction"


def test_a_named_effect_is_kept_where_only_ties_are_undone(case, evaluations):
    """The first effect explains all; what is stopped is what comes after it."""
    first = evaluations.index("simulating held-out windows")
    asked = []
    with Budget(is_asked=lambda: len(asked) > first - 2 or asked.append(0)).running():
        result = run_gap(case[0], [case[1]])
    assert result.verdict == "ambiguous" and result.unfinished
    assert [e.kind for e in result.effects] == ["joint_coulomb_friction"]
    assert "Interrupted" in result.says.split(".")[0]


def test_no_step_waits_for_long(case, evaluations):
    """Between two questions whether to go on there is less than a second of CPU (and of
    what is compiled once: this case has run before)."""
    gaps, last = [], time.process_time()

    def tick():
        nonlocal last
        now = time.process_time()
        gaps.append(now - last)
        last = now

    with Budget(tick=tick).running():
        run_gap(case[0], [case[1]])
    assert len(gaps) == len(evaluations)
    assert max(gaps) < 1.0


def test_time_that_is_up_is_no_interrupt(case):
    result = run_gap(case[0], [case[1]], budget_min=1e-6)
    assert result.verdict == "not_judged"
    assert result.says.startswith("Out of time (budget of 1e-06 min); not done: ")
    assert math.isnan(result.gap.before)
    json.dumps(result.to_json(), allow_nan=False)
    with pytest.raises(ValueError, match="budget: got 0 min"):
        run_gap(case[0], [case[1]], budget_min=0.0)


def test_each_part_of_a_run_has_its_own_end(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(budgets, "monotonic", lambda: now[0])
    hit = [False]
    budget = Budget(100.0, lambda: hit[0])

    def may(part: str) -> bool:
        with budget.part(part):
            try:
                budget.go_on()
            except Stopped:
                return False
            return True

    parts = ("search", "prune", "conclude", "report")
    for t, left in ((59, 4), (61, 3), (81, 2), (96, 1), (101, 0)):
        now[0] = t
        assert [may(part) for part in parts] == [False] * (4 - left) + [True] * left
    now[0], hit[0] = 10.0, True
    assert [may(part) for part in parts] == [False, False, True, True]
    with budget.held():
        assert may("search")
    now[0] = 31.0  # Nobody waits for long who asked for the end.
    assert [may(part) for part in parts] == [False] * 4


def test_contact_that_takes_too_long_leaves_time_for_what_is_free(case, monkeypatch):
    def endless(scene, recordings):
        while True:
            budgets.go_on()

    monkeypatch.setattr(workflow, "push_each_other", lambda *_: False)
    monkeypatch.setattr(workflow, "presses", lambda *_: False)
    monkeypatch.setattr(workflow, "runs_against", lambda *_: True)
    monkeypatch.setattr(workflow, "_impact_problem", endless)
    scene, recordings = read_scene(case[0]), read_recordings([case[1]])
    with Budget(4.0).running() as budget:
        problem, _ = workflow.problem_for(scene, recordings, SceneDynamics(scene))
        assert isinstance(problem, MechanismProblem)
    assert budget.undone == ["what touches: its stretches are left out"]


def test_effects_that_no_scene_can_have_change_no_weights(case):
    """A link of less than no mass: a fit of equations may go there."""
    [recording] = read_recordings([case[1]])
    problem = MechanismProblem(read_scene(case[0]), [recording])
    search = Comparison(problem, lambda text: None)
    body = problem.dynamics.places("link_mass")[0]
    light = Effect("link_mass", [body], {"mass": -5.0})
    with pytest.raises(ValueError):
        problem.model_with([light])
    before = problem.base()
    problem.reweigh(replace(search.start, effects=(light,)))
    np.testing.assert_array_equal(problem.residual(), before)


# ----- The command


def command(words, cwd, until: str = "", then=(), timeout=120.0):
    """Exit status, stdout and stderr of `makebreak gap` in a process of its own, which
    gets signals (each with a wait before it) once it has written `until`."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "makebreak", "gap", *map(str, words), "--jobs", "1"],
        cwd=cwd, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        start_new_session=True,
    )  # fmt: skip
    assert process.stderr is not None
    seen = ""
    while until not in seen and (char := process.stderr.read(1)):
        seen += char
    for wait, number in then:
        time.sleep(wait)
        process.send_signal(number)
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out, seen + err


@pytest.mark.parametrize(
    ("stage", "number"),
    [
        ("reading", signal.SIGINT),
        pytest.param("preparing", signal.SIGTERM, marks=pytest.mark.slow),
        ("searching", signal.SIGINT),
    ],
)
def test_signals_end_the_command_with_files(case, tmp_path, stage, number):
    words = [*case, "--out", "out"]
    status, out, err = command(words, tmp_path, stage, [(0.0, number)])
    assert status == 130, err
    found = is_consistent(tmp_path / "out", case[0])
    assert found["says"] in out.replace("\n", " ")
    assert "Ending with what is found so far" in err


@pytest.mark.slow
def test_an_older_complete_result_stays_beside_an_interrupted_one(case, tmp_path):
    words = [*case, "--out", "out"]
    assert command(words, tmp_path)[0] == 0
    whole = (tmp_path / "out/result.json").read_text()
    stop = [(0.0, signal.SIGINT)]
    assert command(words, tmp_path, "preparing", stop)[0] == 130
    assert (tmp_path / "out/result.json").read_text() == whole
    is_consistent(tmp_path / "out/unfinished", case[0])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_is_asked_twice_ends_at_once(case, tmp_path, monkeypatch, capsys, number):
    now = [0.0]
    monkeypatch.setattr(interrupts, "monotonic", lambda: now[0])

    def told_twice(*_):
        for now[0] in (0.0, 2.0):
            os.kill(os.getpid(), number)
        raise AssertionError("it goes on")

    monkeypatch.setattr("makebreak.gap.workflow.run_gap", told_twice)
    words = ["gap", *map(str, case), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "makebreak: interrupted"
    assert not (tmp_path / "out").exists()


def test_one_sigterm_that_comes_twice_is_one():
    """`timeout` tells the process, and then its group."""
    with interrupts.CatchInterrupt() as interrupt:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
    assert interrupt.hit


def test_a_budget_ends_the_command_with_files(case, tmp_path):
    words = [*case, "--out", "out", "--budget", "0.0001"]
    status, out, _ = command(words, tmp_path)
    assert status == 0
    found = is_consistent(tmp_path / "out", case[0])
    assert "Out of time" in out and found["effects"] == []
    assert command([*case, "--budget", "0"], tmp_path)[2].count("\n") == 1


def test_a_proposal_is_there_before_anything_is_computed(tmp_path):
    """As soon as the first stage shows; a kill that nothing can catch leaves it."""
    (tmp_path / "arm.urdf").write_text(URDF)
    rows = [
        [0.01 * k, math.sin(0.03 * k), 0.2 * math.cos(0.03 * k)] for k in range(600)
    ]
    text = "\n".join(",".join(f"{x:.6f}" for x in row) for row in rows)
    (tmp_path / "log.csv").write_text(f"time,j1_position,j1_effort\n{text}\n")
    words = ["arm.urdf", "log.csv", "--out", "out"]
    kill = [(0.0, signal.SIGKILL)]
    command(words, tmp_path, "reading scene", kill)
    assert (tmp_path / "out/proposed_scene.yaml").is_file()
    assert (tmp_path / "out/log.yaml").is_file()
    again = ["out/proposed_scene.yaml", "log.csv", "--out", "second"]
    assert command(again, tmp_path, "checking", [(0.0, signal.SIGINT)])[0] == 130


def test_a_limb_of_many_joints_has_as_much_more_time():
    whole, limbs = Budget(290.0), (17, 6, 6)
    shares = [whole.share(sum(limbs[k:]) / limbs[k]).seconds for k in range(3)]
    assert shares == pytest.approx([170.0, 145.0, 290.0], abs=1.0)
