"""The command that makes the documents' pictures."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from makebreak.scripts import pictures
from makebreak.scripts.pictures import DOCS, PICTURES, PLOTS, make_pictures


def test_every_picture_of_the_documents_is_there_and_made_by_the_command():
    shown = set()
    root = DOCS.parent.parent
    for page in [root / "README.md", *root.glob("docs/*.md")]:
        shown |= set(re.findall(r"pictures/([\w.]+)", page.read_text()))
    assert shown == {p.name for p in DOCS.iterdir()} <= {*PICTURES, *PLOTS}


def test_one_run_gives_all_its_pictures_and_a_failed_one_is_told(tmp_path, monkeypatch):
    ran = []

    def run(command, **_):
        ran.append(command)
        folder = Path(command[-1])
        if "close-the-loop" in command:
            (folder / "2_gap").mkdir(parents=True)
            for name in ("report", "compare"):
                (folder / "2_gap" / f"{name}.html").write_text(name)
            return SimpleNamespace(returncode=1)  # Its goals are not met.
        status = 2 if "cube_pivoting" in command else 0
        return SimpleNamespace(returncode=status, stderr="...\nit broke\n")

    def screenshot(page, picture, size, wait_ms):
        picture.write_text(page.read_text())

    monkeypatch.setattr(pictures.subprocess, "run", run)
    monkeypatch.setattr(pictures, "screenshot", screenshot)
    out = tmp_path / "out"
    make_pictures(["gap_report.png", "gap_compare.png"], out, tmp_path / "a b")
    assert len(ran) == 1
    assert (out / "gap_report.png").read_text() == "report"
    assert (out / "gap_compare.png").read_text() == "compare"
    with pytest.raises(RuntimeError, match="run cube_pivoting: it broke"):
        make_pictures(["cube_pivoting.png"], out, tmp_path / "v")
    with pytest.raises(RuntimeError, match="run porridge .*: it made no prediction"):
        make_pictures(["contact_figure_4.png"], out, tmp_path / "w")


def test_an_unknown_picture_is_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["pictures", "ball.png"])
    assert pictures.main() == 2
    assert "unknown picture ball.png, expected some of" in capsys.readouterr().err
