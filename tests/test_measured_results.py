"""The tables of measured data: rows, goals, what was named, and their places."""

import re
from pathlib import Path

import pytest
from measured_results import (
    SETS,
    Found,
    Row,
    loop_cells,
    named_table,
    table_of,
    with_tables,
)

from makebreak.scripts.runner.table import Table

PAGE = Path(__file__).parent.parent / "docs/lab/results.md"


def test_a_row_says_before_after_goal_and_what_was_named():
    effects = [{"kind": "joint_viscous_damping"}, {"kind": "actuator_gain"}] * 2
    result = {"verdict": "gap_named", "effects": effects}
    rows = [
        Row("shoulder", "rad", 0.064, 0.0270, 0.0270),
        Row("elbow", "rad", 0.218, 0.0761, 0.075),
        Row("wrist", "rad", 0.1, 0.05, None),
    ]
    nothing = {"verdict": "no_gap", "effects": []}
    table = table_of({
        "double_pendulum": Found(rows, result),
        "cube": Found([Row("corners", "mm", 15.4, float("nan"), 9.5)], nothing),
    })  # fmt: skip
    assert table.rows[0] == (
        "a double pendulum: shoulder", "0.027 rad", "0.064 -> 0.027 rad", "gap_named",
        "actuator_gain, joint_viscous_damping",
    )  # fmt: skip
    assert table.rows[2][1] == "-" and table.rows[3][3:] == ("no_gap", "-")
    # A goal is met up to its own value; NaN meets none.
    assert table.met == [True, False, None, False]


def test_what_is_named_has_intervals_units_and_ties():
    def of(value, std, unit):
        return {"value": value, "std": std, "unit": unit}

    tie = {"kind": "plane_height", "at": "table.table"}
    effects = [
        {"kind": "object_com", "at": "ball.ball", "indistinguishable_from": [tie],
         "parameters": {"x": of(0.01, 0.002, "m"), "y": of(0.0, None, "m")}},
        {"kind": "actuator_gain", "at": ["arm.a", "arm.b"],
         "indistinguishable_from": [], "parameters": {"gain": of(0.851, 0.021, "1")}},
    ]  # fmt: skip
    assert named_table({"effects": effects}).rows == [
        ("object_com", "ball.ball", "x 0.01 +- 0.002 m; y 0 +- inf m",
         "plane_height at table.table"),
        ("actuator_gain", "arm.a, arm.b", "gain 0.851 +- 0.021", "-"),
    ]  # fmt: skip


def test_a_loop_is_a_row_from_the_wrong_model_to_the_repaired_one():
    def run(contact, error, gap):
        return {"time_to_first_contact_s": contact, "r_gap_error_m": error,
                "r_gap_m": gap}  # fmt: skip

    effect = {"kind": "object_size", "indistinguishable_from": [
        {"kind": "plane_height", "at": "table.table"}]}  # fmt: skip
    loop = {
        "first": run(3.012, None, 0.0102), "second": run(0.65, 2e-4, 1.6e-4),
        "gap": {"effects": [effect]},
        "radius_wrong_m": 0.0365, "radius_m": 0.031484, "radius_right_m": 0.0315,
    }  # fmt: skip
    assert loop_cells(loop, 7) == (
        "36.5 mm", "7", "`object_size`, tied with `plane_height`", "31.48 mm",
        "3.01 s -> 0.65 s", "- -> 0.2 mm", "10.2 mm -> 0.2 mm",
    )  # fmt: skip


def test_a_table_takes_its_own_place_on_the_page_and_no_other():
    one, two, end = "<!-- table: one -->", "<!-- table: two -->", "<!-- end -->"
    page = f"a\n{one}\nold\n{end}\nb\n{two}\n\n{end}"
    table = Table("t", ("x", "y"), [(r"\1", "p|q")])
    once = with_tables(page, {"one": table})
    rows = "| x | y |\n|---|---|\n| \\1 | p\\|q |"
    assert once == f"a\n{one}\n\n{rows}\n\n{end}\nb\n{two}\n\n{end}"
    assert with_tables(once, {"one": table}) == once
    with pytest.raises(ValueError, match="0 places for the table three"):
        with_tables(page, {"three": table})


def test_the_page_has_a_place_for_each_table_and_every_place_is_filled():
    text = PAGE.read_text()
    places = re.findall(r"<!-- table: (\w+) -->\n(.*?)<!-- end -->", text, re.DOTALL)
    of_sets = ("double_pendulum", "so101", "cube")
    names = {"all", "loops", *of_sets, *(f"{name}_named" for name in of_sets)}
    assert {name for name, _ in places} == names and len(places) == len(names)
    assert all("|---|" in table for _, table in places)
    of_all = dict(places)["all"].strip().splitlines()[2:]
    assert {row.split(":")[0] for row in of_all} == {
        f"| {SETS[name][0]}" for name in of_sets
    }
