"""From when on something is different, and that what was held out is looked at."""

import numpy as np
import pytest

from makebreak.gap.problem import Outcome
from makebreak.gap.residuals.where import begins, jump_time, share_explained
from makebreak.gap.result import GapMeasure, Unexplained, Where
from makebreak.gap.workflow import _since

WHOLE = {("log", 0): (0.0, 10.0)}


def stretch(a, b, held_out=False):
    return Where("a.j.effort", a, b, 0, "log", "moving", 9.0, held_out)


@pytest.mark.parametrize("at", [2.0, 4.5, 7.9])
def test_a_jump_of_the_mean_is_found_where_it_is(at):
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 0.05)
    y = np.where(t < at, -1.0, 2.0) + rng.normal(size=len(t))
    assert jump_time(t, y) == pytest.approx(at, abs=0.15)


@pytest.mark.parametrize("noise", [0.0, 1.0, 3.0])
def test_the_share_that_a_feature_explains_is_that_of_its_variance(noise):
    """Of a wave of variance 1/2, whatever bins cut it; of noise alone none."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0.0, 2.0 * np.pi, 20000)
    y = np.sin(x) + noise * rng.normal(size=len(x))
    within = np.sinc(1.0 / 12.0) ** 2  # Of the wave: what means over a bin keep.
    expected = 0.5 * within / (0.5 + noise**2)
    assert share_explained(x, y) == pytest.approx(expected, abs=0.01)
    assert share_explained(x, rng.permutation(y)) == pytest.approx(0.0, abs=0.01)


def test_no_more_samples_than_bins_explain_nothing():
    x = np.arange(12.0)
    assert share_explained(x, x) == share_explained(x[:1], x[:1]) == 0.0
    assert share_explained(np.arange(13.0), np.arange(13.0)) > 0.5
    assert share_explained(np.zeros(50), np.arange(50.0)) == 0.0
    assert share_explained(np.arange(50.0), np.zeros(50)) == 0.0


def test_neither_noise_nor_a_vibration_is_a_jump():
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 10.0, 0.05)
    assert jump_time(t, rng.normal(size=len(t))) is None
    assert jump_time(t, np.sin(6.0 * t)) is None
    assert jump_time(t, np.zeros(len(t))) is None


def test_what_stands_out_from_a_time_on_begins_there():
    assert begins([stretch(4.5, 7.0), stretch(7.0, 10.0, True)], WHOLE) == (
        "log",
        0,
        4.5,
    )
    # From the start; a push that is over; nothing at all.
    assert begins([stretch(0.5, 10.0)], WHOLE) is None
    assert begins([stretch(4.5, 5.0)], WHOLE) is None
    assert begins([], WHOLE) is None


class _Recording:
    def __init__(self, first):
        self.name, self.time = "log", first + np.arange(101) * 0.1
        self.episodes = [_Episode()]


class _Episode:
    def __init__(self, rows=slice(0, 101)):
        self.number, self.rows = 0, rows


@pytest.mark.parametrize("first", [0.0, 1.7e9])
def test_the_sentence_says_it_on_the_clock_of_the_report(first):
    outcome = Outcome(GapMeasure(9.0, 9.0, 1.0, 0.3))
    where = [stretch(first + 8.2, first + 10.0, True)]
    said = _since(where, outcome, [_Recording(first)], [])
    assert said == " From about 8.2 s on something is different."
    jump = Unexplained("a.j.effort", "everywhere", 9.0, "time (...)", first + 4.5)
    outcome = Outcome(outcome.gap, unexplained=[jump])
    said = _since([stretch(first, first + 10.0)], outcome, [_Recording(first)], [])
    assert said == " From about 4.5 s on something is different."
    assert _since([], Outcome(outcome.gap), [_Recording(first)], []) == ""


def test_a_part_that_is_reported_on_says_when_it_begins_there_whatever_was_before():
    """What was decided on stands out from its start, by another yardstick."""
    where = [stretch(0.0, 7.9), stretch(8.8, 10.0, True)]
    decided, reported = _Recording(0.0), _Recording(0.0)
    decided.time, decided.episodes = decided.time[:80], [_Episode(slice(0, 80))]
    reported.time, reported.episodes = reported.time[80:], [_Episode(slice(0, 21))]
    outcome = Outcome(GapMeasure(9.0, 9.0, 1.0, 0.3))
    said = _since(where, outcome, [decided], [reported])
    assert said == " From about 8.8 s on something is different."
