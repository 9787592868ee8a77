"""What a command writes never costs the user a file."""

import json
import os
import signal
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path
from types import ModuleType

import pytest
import spring_mass
from test_gap_report import made_by_hand, small_case

from makebreak.scripts import experiments
from makebreak.scripts.cli import commands as cli
from makebreak.scripts.runner import trials
from makebreak.scripts.runner.outputs import MARK, STAGE, OutputFolder


@pytest.fixture(autouse=True)
def _registered(monkeypatch, tmp_path):
    monkeypatch.setattr(experiments, "EXPERIMENTS", {"spring_mass": "spring_mass"})
    monkeypatch.chdir(tmp_path)


def hashes(folder=Path(".")) -> dict[str, str]:
    return {
        str(path): sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write(folder, command, **files):
    with OutputFolder(folder, command) as out:
        for name, text in files.items():
            out.file(name.replace("_", ".")).write_text(text)
        return out.commit()


def refusal(capsys, *words) -> str:
    """The one line of a refused command, which has changed nothing."""
    before = hashes()
    assert cli.main([str(word) for word in words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("makebreak: "), error
    assert hashes() == before
    assert not list(Path(".").rglob(STAGE))
    return error


def test_files_appear_only_when_they_are_complete():
    with OutputFolder("new/deep", "gap") as out:
        out.file("a.json").write_text("1")
        out.file("models/b.sdf").write_text("2")
        assert not Path("new/deep/a.json").exists()
        files = out.commit()
    assert [path.as_posix() for path in files] == [
        "new/deep/a.json",
        "new/deep/models/b.sdf",
    ]
    assert {p.name for p in Path("new/deep").iterdir()} == {"a.json", "models", MARK}


def test_what_fails_leaves_no_trace_and_the_older_result():
    with pytest.raises(RuntimeError), OutputFolder("new/deep", "gap") as out:
        out.file("a.json").write_text("1")
        raise RuntimeError
    assert not Path("new").exists()
    write("old", "gap", a_json="old", b_png="old")
    before = hashes()
    with pytest.raises(RuntimeError), OutputFolder("old", "gap") as out:
        out.file("a.json").write_text("1")
        raise RuntimeError
    assert hashes() == before


def test_the_same_command_replaces_its_own_files_and_no_other():
    write("out", "gap", a_json="old", b_png="old", c_yaml="old")
    Path("out/notes.txt").write_text("mine")
    Path("out/my.json").write_text("mine")
    write("out", "gap", a_json="new")
    assert Path("out/a.json").read_text() == "new"
    assert Path("out/my.json").read_text() == "mine"
    names = {path.name for path in Path("out").iterdir()}
    assert names == {"a.json", "my.json", "notes.txt", MARK}
    write("out", "gap", a_json="newer", my_json="ours")  # A name that the user took.
    assert Path("out/my.json").read_text() == "ours"
    assert Path("out/my.json.1").read_text() == "mine"


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (
            lambda: write("out", "run a", x_json=""),
            "holds the files of makebreak run a",
        ),
        (
            lambda: Path("out/result.json").write_text(""),
            "holds result.json, which make",
        ),
        (
            lambda: Path("out/report.html").mkdir(),
            "holds report.html, which makebreak d",
        ),
        (lambda: Path("out/error.txt").write_text(""), "holds error.txt"),
    ],
)
def test_a_folder_of_anything_else_is_refused(make, why):
    Path("out").mkdir()
    make()
    before = hashes()
    with pytest.raises(ValueError) as caught:
        OutputFolder("out", "gap")
    assert why in str(caught.value)
    assert str(caught.value).endswith(
        "; type another folder, for example --out out/gap"
    )
    assert hashes() == before


def test_a_file_that_was_changed_by_hand_or_became_a_folder_is_refused():
    write("out", "gap", scene_yaml="a: 1\n", report_html="x")
    Path("out/scene.yaml").write_text("a: 2  # Better.\n")
    with pytest.raises(ValueError, match="holds scene.yaml, which was changed by hand"):
        OutputFolder("out", "gap")
    Path("out/scene.yaml").write_text("a: 1\n")
    Path("out/report.html").unlink()
    Path("out/report.html").mkdir()
    with pytest.raises(ValueError, match="holds a folder report.html"):
        OutputFolder("out", "gap")


def test_a_mark_leads_to_no_file_outside():
    Path("precious.json").write_text("1")
    write("out", "gap", a_json="1")
    mark = json.loads(Path("out", MARK).read_text())
    mark["files"] |= {"../precious.json": "", str(Path("precious.json").resolve()): ""}
    Path("out", MARK).write_text(json.dumps(mark))
    write("out", "gap", b_json="1")
    assert Path("precious.json").exists() and not Path("out/a.json").exists()


def test_an_interrupted_command_keeps_the_older_result_beside_its_own():
    write("out", "gap", a_json="whole")
    for text in ("part 1", "part 2"):
        with OutputFolder("out", "gap") as out:
            out.file("a.json").write_text(text)
            [path] = out.commit(complete=False)
        assert path == Path("out/unfinished/a.json") and path.read_text() == text
        assert Path("out/a.json").read_text() == "whole"
    with OutputFolder("new", "gap") as out:  # Without an older one there is no need.
        out.file("a.json").write_text("part")
        assert out.commit(complete=False) == [Path("new/a.json")]
    write("new", "gap", a_json="whole")
    assert Path("new/a.json").read_text() == "whole"


# What gap reads and writes, with a workflow that finds what was made by hand.
@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    paths = small_case(folder)
    return (*paths, made_by_hand(*paths))


@pytest.fixture
def gap(monkeypatch, case):
    module = ModuleType("makebreak.gap.workflow")
    module.run_gap = lambda *_arguments, **_options: case[2]  # type: ignore
    monkeypatch.setitem(sys.modules, "makebreak.gap.workflow", module)
    for path in case[0].parent.iterdir():
        Path(path.name).write_bytes(path.read_bytes())
    return case[0].name, case[1].name


def test_gap_on_its_own_repaired_scene_takes_another_folder(gap, capsys):
    scene, recording = gap
    assert cli.main(["gap", scene, recording, "--out", "g1"]) == 0
    assert cli.main(["gap", scene, recording, "--out", "g1"]) == 0  # Again: as it was.
    capsys.readouterr()
    error = refusal(capsys, "gap", "g1/scene.yaml", recording, "--out", "g1")
    assert 'g1" holds scene.yaml, which this command reads' in error
    assert error.rstrip().endswith("for example --out g1/gap")
    assert cli.main(["gap", "g1/scene.yaml", recording, "--out", "g1/gap"]) == 0


def test_a_repaired_scene_finds_its_models_from_where_it_lies(gap):
    """It is written elsewhere and moved."""
    scene, recording = gap
    assert cli.main(["gap", scene, recording, "--out", "deep/down/g1"]) == 0
    from makebreak.models.scene import read_scene

    def files(path):
        of = [d.add_model.file for d in read_scene(path).directives if d.add_model]
        return [Path(file.removeprefix("file://")).resolve() for file in of]

    assert files("deep/down/g1/scene.yaml") == files(scene) != []
    page = Path("deep/down/g1/report.html").read_text()
    assert "deep/down/g1/scene.yaml" in page and STAGE not in page


def test_gap_into_the_folder_of_its_inputs_is_refused(gap, capsys):
    scene, recording = gap
    for out in (".", "x/..", Path.cwd()):
        error = refusal(capsys, "gap", scene, recording, "--out", out)
        assert "which this command reads" in error
    Path("logs").mkdir()
    os.rename(recording, f"logs/{recording}")
    refusal(capsys, "gap", scene, f"logs/{recording}", "--out", "logs")
    os.symlink("logs", "link")
    refusal(capsys, "gap", scene, f"logs/{recording}", "--out", "link")


def test_an_input_is_found_wherever_the_command_may_write(gap, capsys):
    """Behind a link either way, in `unfinished`, and among its own files below."""
    scene, recording = gap
    Path("out").mkdir()
    os.symlink(f"../{recording}", "out/linked.csv")
    refusal(capsys, "gap", scene, "out/linked.csv", "--out", "out")
    os.unlink("out/linked.csv")
    os.rename(recording, "out/real.csv")
    os.symlink("out/real.csv", recording)
    refusal(capsys, "gap", scene, recording, "--out", "out")
    with OutputFolder("mine", "gap") as out:
        out.file("a.yaml").write_text("")
        out.file("models/b.yaml").write_text("")
        out.commit()
    with OutputFolder("mine", "gap") as out:
        out.file("a.yaml").write_text("part")
        out.commit(complete=False)
    for name in ("mine/models/b.yaml", "mine/unfinished/a.yaml"):
        error = refusal(capsys, "gap", name, "out/real.csv", "--out", "mine")
        assert "which this command reads" in error


def test_gap_into_the_folder_of_a_run_is_refused(gap, capsys):
    words = ["--duration", "5", "--no-meshcat", "--out", "X"]
    assert cli.main(["run", "spring_mass", *words]) < 2
    capsys.readouterr()
    refusal(capsys, "gap", gap[0], "X/recording.csv", "--out", "X")
    error = refusal(capsys, "gap", *gap, "--out", "X")
    assert "holds the files of makebreak run spring_mass" in error


def test_run_and_reproduce_refuse_folders_of_others(gap, capsys):
    Path("c").mkdir()
    Path("c/c.yaml").write_text("noise: 0.0\n")
    assert cli.main(["gap", *gap, "--out", "g1"]) == 0
    capsys.readouterr()
    run = ["run", "spring_mass", "--no-meshcat"]
    error = refusal(capsys, *run, "--config", "c/c.yaml", "--out", "c")
    assert "holds c.yaml, which this command reads" in error
    assert "holds the files of makebreak gap" in refusal(capsys, *run, "--out", "g1")
    refusal(capsys, "reproduce", "--out", "g1")
    refusal(capsys, "export-tests", "spring_mass", "--out", "g1")
    refusal(capsys, "run", "spring_mass", "--out", "c", "--no-meshcat")


def test_a_run_that_is_refused_leaves_the_older_result(capsys):
    words = ["run", "spring_mass", "--no-meshcat", "--out", "out"]
    assert cli.main([*words, "--duration", "10"]) == 0
    capsys.readouterr()
    refusal(capsys, *words, "--set", "spring.stiffness=-1")
    assert cli.main([*words, "--set", "fail_at_sec=1"]) == 3
    assert json.loads(Path("out/result.json").read_text())["success"] is True
    assert "a fault in the middle" in Path("out/unfinished/error.txt").read_text()


def start(*words, **more):
    return subprocess.Popen(
        [*spring_mass.COMMAND, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        env=trials.run_environment(),
        **more,
    )


def test_two_runs_at_once_are_refused_and_a_killed_one_blocks_nothing(capsys):
    words = ["run", "spring_mass", "--no-meshcat", "--out", "out"]
    first = start(*words, "--duration", "1e6")
    end = time.monotonic() + 60
    while not Path("out/running").exists():
        assert time.monotonic() < end
        time.sleep(0.02)
    try:
        assert cli.main(words) == 2
        error = capsys.readouterr().err
        assert f"is being written by another run (process {first.pid})" in error
        assert error.count("\n") == 1
    finally:
        first.send_signal(signal.SIGKILL)
        first.communicate(timeout=60)
    assert cli.main([*words, "--duration", "10"]) == 0
    assert not Path("out", STAGE).exists()


def test_on_a_full_disk_the_result_comes_first_and_the_loss_is_one_line():
    """No file may be longer than 20,000 bytes: the table and the plot are."""
    words = ["run", "spring_mass", "--no-meshcat", "--out", "out"]
    process = start(*words, preexec_fn=_limit)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 2 and "Traceback" not in error
    last = error.splitlines()[-1]
    assert last.startswith("makebreak: --out: not all files could be written in out (")
    assert json.loads(Path("out/result.json").read_text())["success"] is True
    assert json.loads(Path("out/timing.json").read_text())["simulated_s"] > 1.0
    assert not Path("out/recording.csv").exists()  # Rather none than half of one.
    assert cli.main([*words]) == 0 and Path("out/recording.csv").exists()


def _limit():
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


@pytest.fixture
def real_gap(case):
    """Files in the folder of the test; the workflow itself is to be run on them."""
    for path in case[0].parent.iterdir():
        Path(path.name).write_bytes(path.read_bytes())
    return ["gap", case[0].name, case[1].name, "--jobs", "2"]


def test_gap_on_a_full_disk_keeps_the_result_and_the_scene(real_gap):
    process = start(*real_gap, "--out", "g1", preexec_fn=_limit)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 2 and "Traceback" not in error
    last = error.splitlines()[-1]
    assert last.startswith("makebreak: --out: ")
    kept = ["result.json", "scene.yaml", "scene_moved.yaml"]
    assert last.endswith(f"kept: {', '.join(kept)}")
    assert {p.name for p in Path("g1").iterdir()} == {*kept, MARK}
    assert json.loads(Path("g1/result.json").read_text())["effects"]


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)]
)
def test_gap_ends_with_what_it_has_when_it_is_told_to(real_gap, number):
    process = start(*real_gap, "--out", "g1")
    assert process.stderr is not None
    seen = ""
    while "the catalogue" not in seen:  # It is at work.
        seen += process.stderr.read(1)
        assert process.poll() is None, seen
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in error
    assert json.loads(Path("g1/result.json").read_text())["unfinished"]
    assert json.loads(Path("g1", MARK).read_text())["complete"] is False
    assert not Path("g1", STAGE).exists()
