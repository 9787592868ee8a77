"""What the README shows, runs."""

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from makebreak.models.effects import KINDS

ROOT = Path(__file__).parent.parent
README, LIBRARY = ROOT / "README.md", ROOT / "docs" / "library.md"


def printed(page: Path, folder: Path) -> str:
    """What the only Python example of a page prints."""
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (folder / "example.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_librarys_example_pushes_its_puck_to_the_goal(tmp_path):
    said = printed(LIBRARY, tmp_path)
    # The goal is 0.5 m; the finger cannot pull the puck back once it is too far.
    assert abs(float(said.split()[2]) - 0.5) < 0.01, said


def test_the_plan_of_the_page_on_c3_goes_to_the_goal(tmp_path):
    said = printed(ROOT / "docs" / "c3.md", tmp_path)
    assert abs(float(said.split()[-2]) - 0.5) < 0.1, said


def test_the_lcs_of_its_page_is_a_step_of_the_finger(tmp_path):
    # 1 N on 1 kg for 50 ms, not yet at the puck; implicit Euler: q = dt v.
    said = printed(ROOT / "docs" / "lcs.md", tmp_path)
    numbers = np.array(re.findall(r"-?\d+\.\d*", said), dtype=float)
    np.testing.assert_allclose(numbers, [0.0025, 0, 0.05, 0, 0, 0, 0, 0], atol=5e-5)


def test_the_readme_is_short():
    words = [w for w in README.read_text().split() if re.search(r"\w", w)]
    assert len(words) <= 700


def test_the_number_of_kinds_is_told_as_it_is():
    for page in ("README.md", "docs/effects.md"):
        told = re.findall(r"(\d+) kinds", (ROOT / page).read_text())
        assert told == [str(len(KINDS))], page


def test_the_seven_systems_are_where_the_table_says():
    rows = re.findall(
        r"^\| `(\w+)/(\w+)` \| `(\w+)` \|(.*)$", LIBRARY.read_text(), re.M
    )
    assert len(rows) == 7
    for wing, name, cls, rest in rows:
        assert hasattr(import_module(f"makebreak.systems.{wing}.{name}"), cls)
        (ROOT / "systems" / wing / "numerics" / f"{name}.py").stat()
        (ROOT / "tests" / f"test_{name}.py").stat()
        *examples, page = re.findall(r"\]\((.*?)\)", rest)
        assert examples
        for example in examples:
            assert cls in (LIBRARY.parent / example).read_text()
        (LIBRARY.parent / page).stat()


N = r"([\d.]+)"
LAB = "docs/lab/experiments.md"
PLANAR = "docs/lab/planar_measured.md"
SHAPING = "docs/lab/shaping_measured.md"
# A result that stands on several pages: {page: where its figures are there}.
SAME_FIGURES = {
    "extra time for contact handling": {
        "README.md": rf"extra time.*\*\*{N} to {N} s\*\*; \[{N} to {N} s\]",
        LAB: rf"extra time.*\*\*{N} to {N} s\*\*; \[{N} to {N} s\]",
        SHAPING: rf"\| extra time \| 3.7 s \| [\d.]+ \({N} - {N}\)[\s\S]*?"
        rf"\| the least that force and acceleration allow \| \| [\d.]+ \({N} - {N}\)",
    },
    "impacts of four contacts": {
        "README.md": rf"four unknown contacts.*\| {N} N; \*\*{N} N\*\* \|",
        LAB: rf"four contacts.*\| {N} N; \*\*{N} N\*\*",
        SHAPING: rf"first trial: imp.*?\| {N} \([\d.]+ - {N}\) N; at most",
    },
    "impacts of at most 10 N": {
        LAB: r"four contacts.*at most 10 N in (\d+) of (\d+)",
        SHAPING: r"first trial: impact.* N; at most 10 N in (\d+) of (\d+)",
    },
    "position error after five trials": {
        LAB: rf"contacts after five trials \|.*?\| {N} mm, perfect",
        "docs/lab/contacts_measured.md": rf"after 1, 3, 5 trials \|.*\| [\d.]+ / "
        rf"[\d.]+ / {N} mm",
    },
    "porridge: fixed, incremental, no model": {
        LAB: rf"porridge, prediction.*\| {N}; {N}; {N} N \|",
        PLANAR: rf"fixed mixture \(EM.*?\| {N} [\s\S]*?\| incremental \| {N} "
        rf"[\s\S]*?no model: the last measured force \| {N} ",
    },
    "springs: ours, MRAC": {
        "README.md": rf"circle on springs.*\*\*{N} mm\*\*; {N} mm",
        LAB: rf"circle on springs.*\*\*{N}\*\*; {N}; ",
        PLANAR: rf"\| adaptive \(ours\), trial 1 \| .*? \| {N} \([\s\S]*?"
        rf"\| MRAC \+ force, trial 1 \| .*? \| {N} \(",
    },
    "springs: active inference, biomimetic": {
        LAB: rf"circle on springs.*\*\*; [\d.]+; {N}; {N} mm",
        PLANAR: rf"\| active inference \+ force, trial 1 \| .*? \| {N} \("
        rf"[\s\S]*?\| biomimetic \+ force, trial 1 \| .*? \| {N} \(",
    },
}


@pytest.mark.parametrize("result", SAME_FIGURES)
def test_a_result_has_the_same_figures_on_each_page(result):
    found = {}
    for page, where in SAME_FIGURES[result].items():
        match = re.search(where, (ROOT / page).read_text())
        assert match, f"{result} is not on {page}"
        # Pages round to two digits or more.
        found[page] = [float(f"{float(x):.2g}") for x in match.groups()]
    assert len(set(map(tuple, found.values()))) == 1, found
