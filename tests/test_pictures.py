"""The command that makes the documents' pictures."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from makebreak.benchmarks import pictures
from makebreak.benchmarks.pictures import (
    DOCS,
    PICTURES,
    PLOTS,
    _last_time,
    make_pictures,
)
from makebreak.scripts.runner.outputs import STAGE


def test_every_picture_of_the_documents_is_there_and_made_by_the_command():
    shown = set()
    root = DOCS.parent.parent
    for page in [root / "README.md", *root.glob("docs/**/*.md")]:
        shown |= set(re.findall(r"pictures/([\w.]+)", page.read_text()))
    assert shown == {p.name for p in DOCS.iterdir()} <= {*PICTURES, *PLOTS}


def test_one_run_gives_all_its_pictures_and_a_failed_one_is_told(tmp_path, monkeypatch):
    ran = []

    def run(command, **_):
        ran.append(command)
        folder = Path(command[-1])
        if "close-the-loop" in command:
            (folder / "2_gap").mkdir(parents=True)
            (folder / "2_gap" / "report.html").write_text("report")
            return SimpleNamespace(returncode=1)  # Its goals are not met.
        if str(command[1]).endswith("gap_of_an_arm.py"):
            folder.mkdir(parents=True)
            (folder / "log.csv").write_text("log")
        if "gap" in command:
            assert (folder / "arm" / "log.csv").is_file()
            (folder / "compare.html").write_text("compare")
        status = 2 if "cube_pivoting" in command else 0
        return SimpleNamespace(returncode=status, stderr="...\nit broke\n")

    def screenshot(page, picture, size, wait_ms):
        picture.write_text(page.read_text())

    monkeypatch.setattr(pictures.subprocess, "run", run)
    monkeypatch.setattr(pictures, "screenshot", screenshot)
    out = tmp_path / "out"
    make_pictures(["gap_report.png", "gap_compare.png"], out, tmp_path / "a b")
    assert len(ran) == 3
    assert (out / "gap_report.png").read_text() == "report"
    assert (out / "gap_compare.png").read_text() == "compare"
    with pytest.raises(RuntimeError, match="run cube_pivoting: it broke"):
        make_pictures(["cube_pivoting.png"], out, tmp_path / "v")
    with pytest.raises(RuntimeError, match="run porridge .*: it made no prediction"):
        make_pictures(["contact_figure_4.png"], out, tmp_path / "w")


def test_a_live_picture_waits_for_the_simulated_time_and_ends_the_run(
    tmp_path, monkeypatch
):
    """The stand-in records a simulated second in 20 ms."""
    stand_in = tmp_path / "run.py"
    stand_in.write_text(
        "import pathlib, sys, time\n"
        f"folder = pathlib.Path(sys.argv[-1]) / '{STAGE}'\n"
        "folder.mkdir(parents=True)\n"
        "print('Meshcat: http://localhost:7000', flush=True)\n"
        "with (folder / 'recording.csv').open('w', buffering=1) as file:\n"
        "    file.write('time,x\\n')\n"
        "    try:\n"
        "        for t in range(10**6):\n"
        "            file.write(f'{t},1.0\\n')\n"
        "            time.sleep(0.02)\n"
        "    except KeyboardInterrupt:\n"
        "        (folder / 'ended').touch()\n"
    )
    monkeypatch.setattr(
        pictures, "makebreak_command", lambda *words: [sys.executable, stand_in, *words]
    )
    seen = []
    stage = tmp_path / "work" / "0" / STAGE

    def screenshot(page, picture, size, wait_ms):
        seen.append((page, _last_time(stage / "recording.csv")))

    monkeypatch.setattr(pictures, "screenshot", screenshot)
    make_pictures(["meshcat_live.png"], tmp_path / "out", tmp_path / "work")
    ((page, time),) = seen
    assert page == "http://localhost:7000"
    assert PICTURES["meshcat_live.png"].live_sec <= time < 1000
    assert (stage / "ended").is_file()


def test_a_live_picture_of_a_run_that_ends_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(
        pictures, "makebreak_command", lambda *_: [sys.executable, "-c", "print(1)"]
    )
    with pytest.raises(RuntimeError, match="it ended before the picture"):
        make_pictures(["meshcat_live.png"], tmp_path / "out", tmp_path / "work")


def test_an_unknown_picture_is_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["pictures", "ball.png"])
    assert pictures.main() == 2
    assert "unknown picture ball.png, expected some of" in capsys.readouterr().err
