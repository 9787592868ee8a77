"""`makebreak gap` as a command: what it refuses, shows, writes, and how it ends."""

import json
import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
from test_gap_report import made_by_hand, small_case

from makebreak.scripts.cli import commands as cli
from makebreak.scripts.cli.gap_command import StageBar, effects_table, known_sidecars


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    paths = small_case(folder)
    return (*paths, made_by_hand(*paths))


@pytest.fixture
def workflow(monkeypatch, case, tmp_path):
    """A workflow that finds what was made by hand, and notes what it was given."""
    monkeypatch.chdir(tmp_path)
    asked = []

    def run_gap(scene_path, recording_paths, jobs=1, progress=print, *_):
        asked.append((scene_path, recording_paths, jobs))
        for text in ("checking the recordings", "screening the catalogue"):
            progress(text)
        return case[2]

    module = ModuleType("makebreak.gap.workflow")
    module.run_gap = run_gap  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "makebreak.gap.workflow", module)
    return asked


def test_a_run_shows_its_stages_and_ends_with_a_table_and_files(workflow, case, capsys):
    scene, recording, result = case
    words = ["gap", str(scene), str(recording), "--out", "out", "--jobs", "1"]
    assert cli.main(words) == 0
    assert workflow == [(scene.resolve(), [recording], 1)]
    shown = capsys.readouterr()
    for text in ("checking", "screening", "writing the report", "done"):
        assert text in shown.err
    assert shown.err.index("checking") < shown.err.index("screening")
    assert result.says in shown.out and "joint_coulomb_friction" in shown.out
    written = {path.name for path in Path("out").iterdir()}
    names = "result.json scene.yaml report.html compare.html"
    assert set(names.split()) < written
    for name in names.split():
        assert name in shown.out
    assert json.loads(Path("out/result.json").read_text())["verdict"] == "gap_named"


def test_the_script_of_the_docs_writes_the_same_report(workflow, case, capsys):
    docs = Path(__file__).parent.parent / "docs/gap.md"
    code = re.search(r"```python\n(.*?)```", docs.read_text(), re.DOTALL)
    assert code is not None
    text = code[1].replace("scene.yaml", str(case[0])).replace("log.csv", str(case[1]))
    exec(compile(text, "docs/gap.md", "exec"), {})
    assert workflow == [(str(case[0]), [str(case[1])], 1)]
    assert "gap_named ['joint_coulomb_friction'" in capsys.readouterr().out
    shown = json.loads(Path("report/result.json").read_text())
    assert shown["verdict"] == "gap_named" and Path("report/report.html").is_file()
    with pytest.raises(ImportError):
        from makebreak.gap import run_gaps  # noqa: F401


@pytest.mark.parametrize(
    "verdict", ["no_gap", "not_judged", "ambiguous", "gap_unnamed"]
)
def test_every_verdict_is_a_run_that_is_done(workflow, case, verdict, monkeypatch):
    object.__setattr__(case[2], "verdict", verdict)
    monkeypatch.setattr(
        "makebreak.scripts.cli.gap_command.comparison_html", lambda *_: None
    )
    try:
        assert cli.main(["gap", str(case[0]), str(case[1]), "--out", "out"]) == 0
    finally:
        object.__setattr__(case[2], "verdict", "gap_named")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "SCENE"),
        (["scene.yaml"], "RECORDING"),
        (["no_such", "run.csv"], 'SCENE: got "no_such", expected a scene file'),
        (
            ["contact_learning", "run.csv"],
            "SCENE: contact_learning is an experiment, exp",
        ),
        (["scene.yaml", "none.csv"], "recording none.csv does not exist"),
        (
            ["scene.yaml", "empty"],
            "recording empty is a folder without a log",
        ),
        (["scene.yaml", "*.mat"], "recording *.mat: no log has such a name"),
        (["run.csv", "run.csv"], "run.csv is a recording, expected the scene"),
        (["scene.yaml", "run.csv", "--jobs", "0"], "--jobs: got"),
        (["scene.yaml", "run.csv", "--out", "run.csv/x"], '--out: got "run.csv/x"'),
        (["scene.yaml", "run.csv", "--no-such"], "--no-such"),
    ],
)
def test_bad_input_is_one_line_and_status_2(workflow, case, words, says, capsys):
    Path("empty").mkdir()
    for path in case[:2]:
        Path(path.name).write_text(path.read_text())
    assert cli.main(["gap", *words]) == 2
    shown = capsys.readouterr()
    assert says in shown.err and shown.err.count("\n") == 1, shown.err
    assert not workflow


def test_ctrl_c_ends_it_in_one_line_and_130(workflow, case, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["makebreak.gap.workflow"], "run_gap", interrupted)
    assert cli.main(["gap", str(case[0]), str(case[1]), "--out", "out"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "makebreak: interrupted"


def test_the_bar_shows_time_and_stage_and_no_share_that_nobody_knows(capsys):
    with StageBar(budget_sec=600.0) as bar:
        bar("searching")
        bar("  payload at p.l1: 3.2")
        bar.tick(now=True)
        shown = capsys.readouterr().err
    assert "%" not in shown and "00:00 of at most 10:00" in shown
    assert shown.index("searching") < shown.index("searching: payload at p.l1: 3.2")
    assert "done" in capsys.readouterr().err
    with pytest.raises(ValueError), StageBar() as bar:
        bar("fit")
        raise ValueError
    shown = capsys.readouterr().err
    assert "done" not in shown and "at most" not in shown


def test_the_table_has_one_pair_of_held_out_errors(case):
    text = effects_table(case[2]).to_text()
    assert text.startswith("Gap named: joint p.j1 has Coulomb friction")
    gap = case[2].gap
    pair = f"held-out error: {gap.before:.3g} before, {gap.after:.3g} after"
    assert text.count(pair) == 1
    [row] = [r for r in text.splitlines() if r.startswith("joint_coulomb")]
    assert "coulomb 0.350 +- 0.010 N m" in row
    assert row.endswith("joint_viscous_damping at p.j1, error 62 % larger")


def test_a_sidecar_beside_the_scene_serves_a_log_without_its_own(tmp_path):
    scene, log = tmp_path / "first" / "proposed_scene.yaml", tmp_path / "log.csv"
    scene.parent.mkdir()
    near = scene.with_name("log.yaml")
    near.write_text("columns:\n  t: time\n")
    scene.write_text("directives: []\n")
    known = partial(known_sidecars, file=None, given=None)  # It writes nothing here.
    assert known(scene, [log])[0] == {log: near}
    # Its own wins; a scene is no sidecar, nor is the given one.
    log.with_suffix(".yaml").write_text("columns: {t: time}\n")
    assert known(scene, [log]) == ({}, [])
    log.with_suffix(".yaml").unlink()
    near.write_text("directives: []\n")
    assert known(scene, [log]) == ({}, [])
    assert known(near, [log]) == ({}, [])
