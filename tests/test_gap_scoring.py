"""The benchmark's score says what it claims; the benchmark itself is not run here."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from makebreak.benchmarks import gap_benchmark
from makebreak.benchmarks.gap_scoring import (
    LOGS,
    Score,
    parameter_errors,
    same_place,
    score,
    table_of,
)
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.runner import trials


def truth(verdict="gap_named", effects=(), ties=()):
    return {
        "name": "00_case",
        "verdict": verdict,
        "effects": list(effects),
        "ties": list(ties),
    }


def effect(kind, at, tied=(), **parameters):
    """As result.json has it."""
    values = {k: {"value": v, "std": 0.1, "unit": ""} for k, v in parameters.items()}
    return {
        "kind": kind,
        "at": at,
        "parameters": values,
        "indistinguishable_from": list(tied),
    }


def hidden(kind, at, **parameters):
    return {"kind": kind, "at": at, "parameters": parameters}


COULOMB = hidden("joint_coulomb_friction", "p.j1", coulomb=2.0)


def test_the_right_effect_is_right_and_its_error_relative():
    found = effect("joint_coulomb_friction", "p.j1", coulomb=1.9)
    result = {"verdict": "gap_named", "effects": [found], "gap": {"reduction": 0.97}}
    got = score(truth(effects=[COULOMB]), result)
    assert (got.first, got.first_or_tied, got.extra, got.closed) == (
        True,
        True,
        0,
        0.97,
    )
    np.testing.assert_allclose(got.errors, [0.05])


@pytest.mark.parametrize(
    ("kind", "at"),
    [("joint_coulomb_friction", "p.j2"), ("joint_viscous_damping", "p.j1")],
)
def test_the_wrong_joint_or_kind_is_wrong_unless_said_to_be_tied(kind, at):
    wrong = effect(kind, at, coulomb=2.0)
    got = score(truth(effects=[COULOMB]), {"verdict": "gap_named", "effects": [wrong]})
    assert (got.first, got.first_or_tied, got.extra, got.errors) == (
        False,
        False,
        1,
        (),
    )
    wrong["indistinguishable_from"] = [{"kind": COULOMB["kind"], "at": ["p.j1"]}]
    got = score(truth(effects=[COULOMB]), {"verdict": "ambiguous", "effects": [wrong]})
    assert (got.first, got.first_or_tied) == (False, True)


def test_any_of_a_declared_tie_is_right():
    delay = hidden("input_delay", "p", delay=0.02)
    case = truth("ambiguous", [delay], [["input_delay", "sensor_delay"]])
    found = effect("sensor_delay", "p", delay=0.02)
    got = score(case, {"verdict": "ambiguous", "effects": [found]})
    assert got.first and got.extra == 0


def test_what_is_named_where_nothing_is_hidden_is_invented():
    found = effect("joint_coulomb_friction", "p.j1", coulomb=2.0)
    for verdict in ("no_gap", "gap_unnamed"):
        # The effect outside the catalogue stands in the truth, but has no name.
        case = truth(verdict, [hidden("bouc_wen", "p.j1")] * (verdict != "no_gap"))
        got = score(case, {"verdict": "gap_named", "effects": [found]})
        assert (got.first, got.extra, got.closed) == (None, 1, None)


def test_a_run_that_failed_is_wrong_in_everything():
    got = score(truth(effects=[COULOMB]), {"success": False, "error": "exit status 3"})
    assert (got.found, got.first, got.closed) == ("failed", False, 0.0)
    assert got.says == "exit status 3"


@pytest.mark.parametrize(
    ("one", "two", "kind", "same"),
    [
        ("p.j1", ["p.j1"], "rotor_inertia", True),
        ("ball~table.top", "table.top~ball.ball", "contact_friction", True),
        ("ball", "ball.ball", "object_mass", True),
        ("p", "p.j1", "joint_viscous_damping", False),
        ("p", ["p.j1", "p.j2"], "clock_skew", True),
        ("p", ["p.j1"], "input_delay", True),  # The only one that is driven.
        ("p", ["p.j1.velocity", "p.j2.velocity"], "sensor_delay", False),
        (["p.b.velocity", "p.a.velocity"], ["p.a.velocity", "p.b.velocity"],
         "sensor_delay", True),
        ("p", "q", "gravity_tilt", False),
    ],
)  # fmt: skip
def test_places(one, two, kind, same):
    assert same_place(one, two, kind, ["p.j1"]) is same
    assert same_place(two, one, kind, ["p.j1"]) is same


def test_errors_of_vectors_phases_and_changes():
    def errors(found, there):
        return parameter_errors({k: {"value": v} for k, v in found.items()}, there)

    # (3, 4, 0) for (0, 5, 0): off by sqrt(10) of 5.
    got = errors(dict(fx=3.0, fy=4.0, fz=0.0), dict(fx=0.0, fy=5.0, fz=0.0))
    np.testing.assert_allclose(got, [np.sqrt(10.0) / 5.0])
    got = errors(dict(phase=0.1), dict(phase=2.0 * np.pi - 0.1))
    np.testing.assert_allclose(got, [0.2 / np.pi])
    # -F half a turn later is F.
    got = errors(dict(fx=-2.0, fy=1.0, fz=0.0, phase=0.1 - np.pi),
                 dict(fx=2.0, fy=-1.0, fz=0.0, phase=0.2))  # fmt: skip
    np.testing.assert_allclose(got, [0.0, 0.1 / np.pi], atol=1e-12)
    np.testing.assert_allclose(errors(dict(gain=1.12), dict(gain=1.1)), [0.2])
    got = errors(dict(scale=1.1, radius=0.033), dict(scale=1.1, radius=0.033))
    assert got == [0.0]
    got = errors(dict(x_min=0.11, x_max=0.3), dict(x_min=0.1, x_max=0.3))
    np.testing.assert_allclose(sorted(got), [0.0, 0.05], atol=1e-12)
    assert errors(dict(angular=0.1, linear=3.0), dict(angular=0.0, linear=3.0)) == [0.0]


def log_truth(effects, verdicts=("gap_named",)):
    return {"name": "l", "verdicts": list(verdicts), "effects": effects, "ties": []}


def test_what_cannot_be_told_from_it_is_right_with_its_own_numbers():
    rival = hidden("link_mass", "p.hand", mass=-0.7)
    load = hidden("payload", "p.flange", mass=-0.7, com_x=0.0, com_y=0.0, com_z=0.1)
    case = log_truth([rival | {"needed": True, "equivalents": [load]}])
    found = effect("payload", "p.flange", mass=-0.63, com_x=0.0, com_y=0.0, com_z=0.11)
    got = score(case, {"verdict": "gap_named", "effects": [found]})
    assert (got.first, got.extra, got.named, got.needed) == (True, 0, 1, 1)
    np.testing.assert_allclose(got.errors, [0.1, 0.1])
    elsewhere = effect("payload", "p.fore", mass=-0.7)
    got = score(case, {"verdict": "gap_named", "effects": [elsewhere]})
    assert (got.first, got.extra, got.named) == (False, 1, 0)


def test_a_group_is_scored_as_its_members_and_those_that_are_missed_count():
    case = log_truth([hidden("rotor_inertia", f"p.j{i}", inertia=0.1 * i)
                      for i in (1, 2, 3)])  # fmt: skip
    found = effect("rotor_inertia", ["p.j1", "p.j2", "p.j4"], inertia=0.1)
    got = score(case, {"verdict": "gap_named", "effects": [found]})
    assert (got.first, got.extra, got.named, got.needed) == (True, 1, 2, 3)
    np.testing.assert_allclose(sorted(got.errors), [0.0, 0.5])
    # One effect named twice is one.
    twice = [effect("rotor_inertia", "p.j1", inertia=0.1)] * 2
    got = score(case, {"verdict": "gap_named", "effects": twice})
    assert (got.named, got.extra) == (1, 0)


def test_an_interval_holds_the_truth_or_not():
    case = log_truth([COULOMB])
    for value, std, inside in (
        (2.19, 0.1, True), (2.21, 0.1, False), (1.81, 0.1, True), (1.79, 0.1, False),
        (2.0, float("inf"), False), (2.0, None, False),
    ):  # fmt: skip
        found = effect("joint_coulomb_friction", "p.j1", coulomb=value)
        found["parameters"]["coulomb"]["std"] = std
        got = score(case, {"verdict": "gap_named", "effects": [found]})
        assert got.inside == (inside,), value
    found["parameters"]["coulomb"]["fitted"] = False  # As modelled: no interval.
    got = score(case, {"verdict": "gap_named", "effects": [found]})
    assert got.inside == ()
    wave = hidden("torque_ripple", "p.j1", amplitude=1.0, phase=0.1)
    found = effect("torque_ripple", "p.j1", amplitude=-1.05, phase=0.1 + 3 * np.pi)
    got = score(log_truth([wave]), {"verdict": "gap_named", "effects": [found]})
    assert got.inside == (True, True)
    found = effect("torque_ripple", "p.j1", amplitude=1.05, phase=0.1 + np.pi)
    got = score(log_truth([wave]), {"verdict": "gap_named", "effects": [found]})
    assert sum(got.inside) == 1


def test_what_a_log_does_not_tell_is_no_error_but_must_be_in_its_interval():
    load = hidden("payload", "p.b", mass=1.0, com_x=0.3, com_y=0.4, com_z=0.0)
    load["loose"] = ["com_z"]
    found = effect("payload", "p.b", mass=1.0, com_x=0.3, com_y=0.5, com_z=7.0)
    got = score(log_truth([load]), {"verdict": "gap_named", "effects": [found]})
    np.testing.assert_allclose(sorted(got.errors), [0.0, 0.2])
    assert got.inside == (True, True, True, False)


def test_what_hardly_shows_is_not_asked_for_and_no_invention():
    faint = COULOMB | {"needed": False}
    case = log_truth([faint], ("ambiguous", "gap_named", "no_gap"))
    got = score(case, {"verdict": "no_gap", "effects": []})
    assert got.right and (got.first, got.needed, got.closed) == (None, 0, None)
    found = effect("joint_coulomb_friction", "p.j1", coulomb=2.0)
    got = score(case, {"verdict": "gap_named", "effects": [found]})
    assert got.right and got.extra == 0
    assert not score(case, {"verdict": "gap_unnamed", "effects": []}).right


def test_the_table_has_the_goals_of_its_set():
    good = Score(
        "c", "gap_named or ambiguous", "ambiguous", True, True, (0.06,), 0.9, 0, 2.0,
        "x", (True, False), 3, 4,
    )  # fmt: skip
    table = table_of([good], "logs-final", LOGS)
    rows = {r[0]: (r[1], r[2], m) for r, m in zip(table.rows, table.met, strict=True)}
    assert rows["right verdict"] == ("92%", "1 of 1 (100%)", True)
    assert rows["parameter error, median"] == ("5%", "6.0% of 1", False)
    name = "named intervals that hold the truth"
    assert rows[name] == ("85%", "1 of 2 (50%)", False)
    assert rows["hidden effects that were named"] == ("-", "3 of 4", None)
    assert rows["right verdict gap_named or ambiguous (1)"][1] == "ambiguous 1"
    assert "--set logs-final" in table.rows[0][3]
    # A push with nothing else is a case without an effect.
    push = Score("p", "gap_unnamed or no_gap", "gap_named", None, None, (), None, 2,
                 2.0, "x")  # fmt: skip
    table = table_of([good, push], "logs-final", LOGS)
    rows = {r[0]: (r[2], m) for r, m in zip(table.rows, table.met, strict=True)}
    name = "effects invented where nothing is hidden"
    assert rows[name] == ("2 in 1 cases", False)


def a_score(verdict, found, first=None, extra=0, closed=None, errors=(), **more):
    return Score(
        "c", verdict, found, first, first, errors, closed, extra, 2.0, "x", **more
    )


def test_what_windows_do_not_show_is_not_asked_to_be_closed_there():
    case = {"name": "c", "verdict": "gap_named", "ties": []}
    case["effects"] = [{"kind": "object_mass", "at": "b.b", "parameters": {"mass": 2}}]
    result = {"verdict": "gap_named", "effects": []}
    shows = score(case, {**result, "gap": {"before": 5.0, "reduction": 0.8}})
    assert (shows.before, shows.closed) == (5.0, 0.8)
    hides = score(case, {**result, "gap": {"before": 0.9, "reduction": 0.0}})
    failed = score(case, {"error": "stopped"})
    table = table_of([shows, hides, failed])
    rows = {r[0]: r[2] for r in table.rows}
    assert rows["share of the reducible gap closed, mean (median)"] == "27% (0%)"
    name = "the same where windows show more than 1.5 times the noise"
    assert rows[name] == "80% (80%) of 1 cases"
    assert {r[0]: r[2] for r in table_of([hides]).rows}[name] == "- of 0 cases"


def test_what_windows_do_not_show_is_asked_of_the_equations():
    case = {"name": "c", "verdict": "gap_named", "ties": []}
    case["effects"] = [{"kind": "object_mass", "at": "b.b", "parameters": {"mass": 2}}]
    result = {"verdict": "gap_named", "effects": []}

    def of(windows, share, equations):
        gap = {"before": windows, "reduction": share, "in_equations": equations}
        return score(case, {**result, "gap": gap})

    shown = of(5.0, 0.8, {"before": 9.0, "reduction": 0.2})  # Windows come first.
    hidden = of(0.9, 0.0, {"before": 9.0, "reduction": 0.6})
    neither = of(0.9, 0.0, {"before": 1.2, "reduction": 1.0})
    unasked = of(0.9, 0.0, None)
    name = "the same, by held-out equations of motion where windows show less"
    for scores, said in (
        ([shown], "80% (80%)"),
        ([hidden], "60% (60%)"),
        ([neither], "0% (0%)"),
        ([unasked], "0% (0%)"),
    ):
        assert {r[0]: r[2] for r in table_of(scores).rows}[name] == said


def test_the_table_counts_and_names_what_went_wrong():
    scores = [a_score("gap_named", "gap_named", True, 0, 0.9, (0.02,))] * 9
    scores += [a_score("gap_named", "ambiguous", False, 1, 0.5, (0.3,))]
    scores += [a_score("no_gap", "no_gap")] * 10
    table = table_of(scores)
    rows = {
        row[0]: (row[2], met) for row, met in zip(table.rows, table.met, strict=True)
    }
    assert rows["right verdict"] == ("19 of 20 (95%)", True)
    assert rows["right effect first"] == ("9 of 10 (90%)", True)
    assert rows["parameter error, median"] == ("2.0% of 10", True)
    name = "share of the reducible gap closed, mean (median)"
    assert rows[name] == ("86% (90%)", True)
    assert rows["effects invented where nothing is hidden"] == ("0 in 10 cases", True)
    assert rows["effects invented in the other cases"] == ("1 in 10 cases", None)
    assert rows["right verdict gap_named (10)"] == (
        "gap_named 9, ambiguous 1",
        None,
    )
    assert table.notes == ["c: gap_named -> ambiguous: x"]
    assert table.missed == 0
    invented = table_of([*scores, a_score("no_gap", "gap_named", extra=2)])
    assert invented.missed == 1


def made_by(maker, monkeypatch):
    every = {k: replace(v, maker=maker) for k, v in gap_benchmark.SETS.items()}
    monkeypatch.setattr(gap_benchmark, "SETS", every)


@pytest.mark.parametrize("command", [["reproduce", "gap"], ["bench", "c3"]])
def test_where_benchmarks_are_not_installed_one_line_says_so(
    command, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)
    for name in [n for n in sys.modules if n.startswith("makebreak.benchmarks")]:
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(command) == 2
    shown = capsys.readouterr().err
    assert "is in a checkout of makebreak" in shown and shown.count("\n") == 1


MAKER = """import argparse, json
from pathlib import Path
p = argparse.ArgumentParser()
for name in ("set", "only", "jobs", "seed"):
    p.add_argument("--" + name)
for name in ("out", "truth"):
    p.add_argument("--" + name, type=Path)
a = p.parse_args()
first = int(a.seed or 1)
for k in (first, first + 1):
    folder = a.out / f"case_{k}"
    folder.mkdir(parents=True)
    (folder / "scene.yaml").write_text("actuation: {joints: [p.j1]}")
    (folder / "recording.csv").write_text("time")
    print(folder)
hidden = {"kind": "rotor_inertia", "at": "p.j1", "parameters": {"inertia": 0.1}}
none = {"name": "1_none", "verdict": "no_gap", "effects": [], "ties": []}
one = {"name": "2_one", "verdict": "gap_named", "effects": [hidden], "ties": []}
truth = {f"case_{first}": none, f"case_{first + 1}": one}
a.truth.write_text(json.dumps(truth))
"""
GAP = """import json, sys
from pathlib import Path
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.parent import end_with_parent
end_with_parent()
out = Path(sys.argv[sys.argv.index("--out") + 1])
assert not list(out.parent.parent.glob("cases/*/truth*"))
with OutputFolder(out, "gap") as files:
    answer = {"verdict": "no_gap", "effects": []}
    files.file("result.json").write_text(json.dumps(answer))
    files.file("timing.json").write_text('{"wall_s": 3.0}')
    files.commit()
"""
# `reproduce gap --out out MORE`, with a maker and a workflow from files.
REPRODUCE = """import sys
from dataclasses import replace
from pathlib import Path
from makebreak.benchmarks import gap_benchmark
from makebreak.scripts.cli import main
standard = replace(gap_benchmark.SETS["standard"], maker=Path("cases.py").resolve())
gap_benchmark.SETS["standard"] = standard
gap_benchmark.makebreak_command = lambda *words: [sys.executable, "gap.py", *words]
sys.exit(main(["reproduce", "gap", "--jobs", "1", "--out", "out", *sys.argv[1:]]))
"""


def test_a_case_that_never_ends_is_stopped_and_the_others_are_scored(
    monkeypatch, tmp_path
):
    (tmp_path / "cases.py").write_text(MAKER)
    slow = GAP.replace("out =", "import time\nif 'case_1' in sys.argv[-1]: "
                       "time.sleep(60)\nout =")  # fmt: skip
    (tmp_path / "gap.py").write_text(slow)
    made_by(tmp_path / "cases.py", monkeypatch)
    monkeypatch.setattr(gap_benchmark, "CASE_LIMIT_SEC", 3.0)
    monkeypatch.setattr(
        gap_benchmark,
        "makebreak_command",
        lambda *words: [sys.executable, str(tmp_path / "gap.py"), *words],
    )
    table = gap_benchmark.run_benchmark(tmp_path, 2)
    rows = {row[0]: row[2] for row in table.rows}
    assert rows["right verdict no_gap (1)"] == "failed 1"
    assert rows["right verdict gap_named (1)"] == "no_gap 1"
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores[0]["says"] == "stopped after 3 s"


@pytest.mark.parametrize(
    "number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_benchmark_that_was_ended_goes_on_where_it_was(number, tmp_path):
    def start(*words):
        return subprocess.Popen(
            [sys.executable, "-c", REPRODUCE, *words],
            cwd=tmp_path,
            env=trials.run_environment(),
            stdout=subprocess.PIPE,
            text=True,
        )

    (tmp_path / "cases.py").write_text(MAKER)
    # The second case waits until it is ended, and leaves an incomplete answer.
    waits = """
    if out.name == "case_2":
        def end(*_):
            files.file("result.json").write_text("{}")
            files.commit(complete=False)
            sys.exit(130)
        import signal, time
        signal.signal(signal.SIGTERM, end)
        Path("waits").touch()
        time.sleep(60.0)
"""
    (tmp_path / "gap.py").write_text(GAP.replace(" as files:\n", f" as files:{waits}"))
    process = start()
    end = time.monotonic() + 60.0
    while not (tmp_path / "waits").exists():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(number)
    process.wait(timeout=60)
    [first, second] = [tmp_path / f"out/gap/results/case_{k}" for k in (1, 2)]
    assert (second / "result.json").exists() == (number == signal.SIGTERM)
    before = (first / "result.json").stat().st_mtime_ns
    (tmp_path / "gap.py").write_text(GAP)
    process = start("--reuse")
    assert process.communicate(timeout=60)[0].count("1 of 2 (50%)") == 1
    assert (first / "result.json").stat().st_mtime_ns == before
    assert json.loads((second / "result.json").read_text())["verdict"] == "no_gap"


def test_an_unknown_set_is_refused_by_name(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["reproduce", "gap", "--set", "logs"]) == 2
    shown = capsys.readouterr().err
    assert 'got "logs"' in shown and "logs-final" in shown and shown.count("\n") == 1


def test_the_whole_way_from_the_cases_to_the_table(monkeypatch, tmp_path):
    """With a maker and a workflow that know one answer: no gap."""
    (tmp_path / "cases.py").write_text(MAKER)
    (tmp_path / "gap.py").write_text(GAP)
    made_by(tmp_path / "cases.py", monkeypatch)
    monkeypatch.setattr(
        gap_benchmark,
        "makebreak_command",
        lambda *words: [sys.executable, str(tmp_path / "gap.py"), *words],
    )
    folder = tmp_path / "out"
    folder.mkdir()
    for reuse in (False, True, False):
        table = gap_benchmark.run_benchmark(folder, 2, reuse=reuse)
        rows = {row[0]: row[2] for row in table.rows}
        assert rows["right verdict"] == "1 of 2 (50%)"
        assert rows["right effect first"] == "0 of 1 (0%)"
        assert rows["seconds a case, median (most)"] == "3 (3)"
        assert table.notes == ["2_one: gap_named -> no_gap: nothing"]
    assert len(json.loads((folder / "scores.json").read_text())) == 2
    assert Path(folder / "results" / "case_1" / "log.txt").is_file()
    table = gap_benchmark.run_benchmark(folder, 2, seed=70)
    assert sorted(p.name for p in (folder / "cases").iterdir()) == [
        "case_70",
        "case_71",
    ]
    assert "--set standard --seed 70" in table.rows[0][3]
    with pytest.raises(ValueError, match="'seed': 70}, asked for"):
        gap_benchmark.run_benchmark(folder, 2, reuse=True, seed=80)
