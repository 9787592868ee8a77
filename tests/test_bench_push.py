"""The rows of `makebreak bench push`: each number of threads has its own."""

import numba
import pytest

from makebreak.benchmarks import push as bench_push

BATCH = {"one": 12.0, "all": 6.0}  # ms
ALONE = {"general": 30.0, "analytic": 24.0}  # ms


@pytest.fixture
def timed(monkeypatch):
    """Times that are given, in the order in which the rows ask for them [ms]."""

    def with_threads(threads):
        times = [BATCH["one"], *([BATCH["all"]] if threads > 1 else [])]
        left = iter([*times, ALONE["general"], ALONE["analytic"]])
        monkeypatch.setattr(bench_push, "median_call_ms", lambda *_, **__: next(left))
        monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
        monkeypatch.setattr(numba, "set_num_threads", lambda n: None)
        return bench_push.rows()

    return with_threads


@pytest.mark.parametrize("threads", [1, 2])
def test_each_number_of_threads_has_its_rows(timed, threads):
    rows = timed(threads)
    batches = [row["value"] for row in rows if "one batch" in row["what"]]
    assert batches == [BATCH["one"], BATCH["all"]][:threads]
    rate = next(row for row in rows if row["unit"] == "Hz")
    assert rate["value"] == pytest.approx(1e3 / BATCH["one"])
    assert rate["met"]


@pytest.mark.parametrize(("threads", "gain"), [(1, 2.5), (2, 5.0)])
def test_gain_that_is_wanted_is_over_the_solver_as_it_was(timed, threads, gain):
    rows = timed(threads)
    wanted = [row for row in rows if row.get("target") == bench_push.GAIN_MIN]
    assert len(wanted) == 1  # One claim, of the most cores that there are.
    assert wanted[0]["value"] == pytest.approx(gain)
    assert wanted[0]["met"] == (gain >= bench_push.GAIN_MIN)
    assert "general" in wanted[0]["what"]
