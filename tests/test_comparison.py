"""The rows that `reproduce` makes of trials."""

from types import SimpleNamespace

import pytest

from makebreak.diagrams.multiple_collisions import MultipleCollisionsConfig
from makebreak.scripts.experiments.multiple_collisions import VARIANTS
from makebreak.scripts.experiments.papers.rolling_paper import PUSHES, adaptive_targets
from makebreak.scripts.runner import comparison
from makebreak.scripts.runner.comparison import Comparison
from makebreak.scripts.runner.settings import apply_settings
from makebreak.scripts.runner.trials import setting_texts


@pytest.fixture
def table(tmp_path):
    session = SimpleNamespace(out_dir=tmp_path, reuse=True)
    return Comparison("multiple_collisions", session, 3)


def test_runs_are_those_of_the_first_seeds_in_the_sessions_folder(
    table, tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr(
        comparison,
        "run_many",
        lambda *a, **k: asked.append((a, k)) or ["first", "second"],
    )
    assert table.runs({"tool": "block"}, 2) == ["first", "second"]
    runs = [({"tool": "block"}, 0), ({"tool": "block"}, 1)]
    assert asked == [(("multiple_collisions", runs, 3, tmp_path), {"reuse": True})]


def test_all_variants_run_side_by_side_and_are_told_apart(table, monkeypatch):
    asked = []

    def run_many(name, runs, *_, **__):
        asked.append(runs)
        return [f"{settings.get('tool')} {seed}" for settings, seed in runs]

    monkeypatch.setattr(comparison, "run_many", run_many)
    found = table.runs_of({"plain": {}, "block": {"tool": "block"}}, 2)
    assert found == {"plain": ["None 0", "None 1"], "block": ["block 0", "block 1"]}
    assert len(asked) == 1


@pytest.mark.parametrize("settings", [{}, *VARIANTS.values()])
def test_a_command_is_what_a_shell_takes_and_means_the_same_settings(table, settings):
    words = table.with_settings(settings).partition(" --set ")[2].split()
    given = apply_settings(MultipleCollisionsConfig(), words)
    assert given == apply_settings(MultipleCollisionsConfig(), setting_texts(settings))
    assert table.with_settings({}) == "makebreak run multiple_collisions --seed S"


def test_rows_are_met_missed_or_without_a_target(table):
    table.row("a", "1", 2, good=True)
    table.row("b", "-", "x", command="other")
    table.row("c", "-", "y", good=False, command="")
    made = table.to_table("Title", ["a note"], theirs="wanted")
    assert made.columns == ("what", "wanted", "ours", "command")
    commands = [row[3] for row in made.rows]
    assert commands == ["makebreak run multiple_collisions --seed S", "other", ""]
    assert list(made.met) == [True, None, False] and made.missed == 1
    assert list(made.notes) == ["a note"]


def test_what_did_not_happen_in_a_rolling_run_misses_its_target():
    good = {
        "success": True,
        "time_to_first_contact_s": 8.0,
        "r_gap_error_m": -2e-3,
        "pushes_to_quarter_circle": PUSHES,
        "contact_force_peak_N": 40.0,
    }
    worse = {
        "success": [False],
        "time_to_first_contact_s": [None, 8.01],
        "r_gap_error_m": [None, 2.01e-3, -2.01e-3],
        "pushes_to_quarter_circle": [None, PUSHES + 1],
        "contact_force_peak_N": [40.1],
    }
    tests = adaptive_targets()
    assert all(test(good) for test in tests.values())
    for key, values in worse.items():
        for value in values:
            missed = [
                what for what, test in tests.items() if not test({**good, key: value})
            ]
            assert len(missed) == 1, (key, value)
