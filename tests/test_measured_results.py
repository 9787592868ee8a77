"""The table of measured data: rows, goals, and what was named."""

from measured_results import Row, table_of


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
        "double_pendulum": (rows, result),
        "cube": ([Row("corners", "mm", 15.4, float("nan"), 9.5)], nothing),
    })  # fmt: skip
    assert table.rows[0] == (
        "a double pendulum: shoulder", "0.027 rad", "0.064 -> 0.027 rad", "gap_named",
        "actuator_gain, joint_viscous_damping",
    )  # fmt: skip
    assert table.rows[2][1] == "-" and table.rows[3][3:] == ("no_gap", "-")
    # A goal is met up to its own value; NaN meets none.
    assert table.met == [True, False, None, False]
