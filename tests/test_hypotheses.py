"""The verdict on each hypothesis follows from the targets that its tables meet."""

from makebreak.scripts.experiments.papers.hypotheses import HYPOTHESES, verdicts
from makebreak.scripts.runner.table import Table

COLUMNS = ("what", "paper", "ours", "command")


def table(*met):
    rows = [(f"row {i}", "-", 0.5 + i, "run") for i in range(len(met))]
    return Table("t", COLUMNS, rows, met)


def test_every_experiment_of_the_second_paper_is_behind_one_hypothesis():
    names = [name for one in HYPOTHESES for name in one.experiments]
    assert sorted(names) == sorted(
        "porridge multi_spring changing_surface wall_friction multiple_collisions "
        "contact_learning surface_switch".split()
    )


def test_supported_only_if_every_target_is_met():
    found = verdicts({"changing_surface": table(True, None, True)})
    assert found.rows[0][0].startswith("H2")
    assert found.rows[0][2] == "supported: 2 of 2 targets met"
    assert found.met[0] is True and found.missed == 0
    assert [row[0] for row in found.rows[1:]] == [
        "  changing_surface: row 0",
        "  changing_surface: row 2",
    ]
    found = verdicts({"changing_surface": table(True, False)})
    assert found.rows[0][2] == "supported but for 1 of 2 targets"
    assert found.missed == 1
    assert found.rows[2][2] == "MISSED: 1.5"


def test_a_hypothesis_half_run_has_no_verdict_and_an_untouched_one_no_row():
    found = verdicts({"porridge": table(True)})
    assert "(not run: multi_spring)" in found.rows[0][2]
    assert found.met[0] is None
    assert not any("H3" in row[0] for row in found.rows)
    assert verdicts({"ball_rolling": table(True)}) is None
