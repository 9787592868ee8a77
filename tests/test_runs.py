"""Runs of rows, against a walk over them one by one."""

from itertools import groupby

import numpy as np

from makebreak.gap.numerics.runs import runs_of, starts_of_runs


def test_runs_are_those_that_a_walk_over_the_rows_finds():
    rng = np.random.default_rng(0)
    for n in (1, 2, 7, 40):
        for _ in range(20):
            on = rng.uniform(size=n) < 0.5
            rows = groupby(range(n), key=lambda k, on=on: bool(on[k]))
            groups = [(held, list(some)) for held, some in rows]
            want = [(some[0], some[-1] + 1) for held, some in groups if held]
            assert runs_of(on) == want
            assert starts_of_runs(on).tolist() == [some[0] for _, some in groups]
    assert runs_of(np.zeros(0, bool)) == []
