"""The success criteria of a run."""

import numpy as np
import pytest

from makebreak.scripts.runner.criteria import Criteria


@pytest.mark.parametrize("value", [None, np.nan])
def test_what_was_not_measured_is_missed_and_said_in_words(value):
    criteria = Criteria()
    criteria.at_most("error", "error, mean", value, 0.004, "m")
    criteria.at_least("time", "time", value, 2.0, "s")
    result = criteria.result()
    assert not (result["success"] or result["met_error"] or result["met_time"])
    assert result["criteria"] == [
        "MISSED  error, mean: not measured, wanted at most 0.004 m",
        "MISSED  time: not measured, wanted at least 2 s",
    ]


def test_a_bound_is_met_by_the_bound_itself():
    criteria = Criteria()
    criteria.at_most("error", "error", 0.004, 0.004, "m")
    assert criteria.result()["criteria"] == [
        "met     error: 0.004 m, wanted at most 0.004 m"
    ]
