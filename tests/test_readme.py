"""What the README shows, runs."""

import re
import subprocess
import sys
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
