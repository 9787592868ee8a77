"""What the README shows, runs."""

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from makebreak.models.effects import KINDS

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"


def test_the_readmes_diagram_pushes_its_puck_to_the_goal(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "example.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    # The goal is 0.5 m; the finger cannot pull the puck back once it is too far.
    assert abs(float(done.stdout.split()[2]) - 0.5) < 0.01, done.stdout


def test_the_number_of_kinds_is_told_as_it_is():
    for page in ("README.md", "docs/effects.md"):
        told = re.findall(r"(\d+) kinds", (ROOT / page).read_text())
        assert told == [str(len(KINDS))], page


def test_the_seven_systems_are_where_the_table_says():
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \|(.*)$", README.read_text(), re.M)
    assert len(rows) == 7
    for name, cls, rest in rows:
        assert hasattr(import_module(f"makebreak.systems.{name}"), cls)
        (ROOT / "systems" / "numerics" / f"{name}.py").stat()
        (ROOT / "tests" / f"test_{name}.py").stat()
        example, page = re.findall(r"\]\((.*?)\)", rest)
        assert cls in (ROOT / example).read_text()
        (ROOT / page).stat()
