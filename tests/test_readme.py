"""What the README shows, runs."""

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from makebreak.models.effects import KINDS

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"


def printed(page: Path, folder: Path) -> str:
    """What the only Python example of a page prints."""
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (folder / "example.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_readmes_diagram_pushes_its_puck_to_the_goal(tmp_path):
    said = printed(README, tmp_path)
    # The goal is 0.5 m; the finger cannot pull the puck back once it is too far.
    assert abs(float(said.split()[2]) - 0.5) < 0.01, said


def test_the_plan_of_the_page_on_c3_goes_to_the_goal(tmp_path):
    said = printed(ROOT / "docs" / "c3.md", tmp_path)
    assert abs(float(said.split()[-2]) - 0.5) < 0.1, said


def test_the_number_of_kinds_is_told_as_it_is():
    for page in ("README.md", "docs/effects.md"):
        told = re.findall(r"(\d+) kinds", (ROOT / page).read_text())
        assert told == [str(len(KINDS))], page


def test_the_seven_systems_are_where_the_table_says():
    rows = re.findall(r"^\| `(\w+)/(\w+)` \| `(\w+)` \|(.*)$", README.read_text(), re.M)
    assert len(rows) == 7
    for wing, name, cls, rest in rows:
        assert hasattr(import_module(f"makebreak.systems.{wing}.{name}"), cls)
        (ROOT / "systems" / wing / "numerics" / f"{name}.py").stat()
        (ROOT / "tests" / f"test_{name}.py").stat()
        example, page = re.findall(r"\]\((.*?)\)", rest)
        assert cls in (ROOT / example).read_text()
        (ROOT / page).stat()
