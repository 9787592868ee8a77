"""Filters of measured channels: closed forms, scipy.signal, uneven samples."""

import numpy as np
import pytest
from scipy import signal

from makebreak.systems.numerics.filters import (
    Delay,
    LowPass,
    MovingAverage,
    filtered,
    first_order,
    gain,
    mean_delay,
    memory,
)

STAGES = {
    "first order": [first_order(0.004)],
    "Butterworth 2": [LowPass(2 * np.pi * 30.0, 2)],
    "Butterworth 5": [LowPass(2 * np.pi * 30.0, 5)],
    "mean": [MovingAverage(0.013)],
    "delay": [Delay(0.0071)],
    "all": [MovingAverage(0.005), LowPass(250.0, 3), Delay(0.002)],
}


def uneven(n, period, seed=0):
    rng = np.random.default_rng(seed)
    return np.cumsum(period * rng.uniform(0.2, 1.8, n))


@pytest.mark.parametrize("name", STAGES)
def test_a_sine_comes_out_with_the_filters_gain_on_uneven_samples(name):
    stages, w = STAGES[name], 2 * np.pi * 7.0
    t = uneven(20_000, 1e-4)
    y = filtered(stages, t, np.sin(w * t))
    late = t > t[0] + memory(stages)
    H = gain(stages, w)
    expected = (H * np.exp(1j * w * t)).imag
    # Lines between samples err by (w h)^2/8 = 8e-6 at most (h = 0.18 ms).
    np.testing.assert_allclose(y[late], expected[late], atol=2e-5)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 8])
def test_a_low_pass_is_scipys_butterworth(order):
    stage = LowPass(2 * np.pi * 25.0, order)
    b, a = signal.butter(order, stage.cutoff, analog=True)
    w = np.geomspace(1.0, 2000.0, 40)
    _, expected = signal.freqs(b, a, w)
    np.testing.assert_allclose(gain([stage], w), expected, rtol=1e-8, atol=1e-10)
    # In time, too: lsim solves lines between even samples exactly.
    t = np.arange(400) * 1e-3
    x = np.random.default_rng(order).normal(size=400).cumsum()
    x[:2] = 0.0  # It starts settled.
    _, y, _ = signal.lsim((b, a), x, t)
    # Its own matrix exponential of order 8 is good to 1e-7 of 20.
    np.testing.assert_allclose(filtered([stage], t, x), y, atol=1e-5)


def test_a_ramp_is_late_by_the_mean_delay_and_starts_settled():
    t = uneven(300, 1e-3, 1)
    for name, stages in STAGES.items():
        y = filtered(stages, t, 3.0 * t - 1.0)
        late = mean_delay(stages)
        np.testing.assert_allclose(y, 3.0 * (t - late) - 1.0, atol=1e-11, err_msg=name)


def test_a_moving_average_is_the_difference_of_the_integral():
    # A backward difference of a position at even stamps, of a velocity in closed form.
    t = np.arange(0.0, 1.0, 1e-4)
    at = np.arange(0.1, 0.99, 5e-3)
    position = np.sin(9.0 * at) / 9.0
    seen = filtered([MovingAverage(5e-3)], t, np.cos(9.0 * t), at)
    # (9 rad/s x 0.1 ms)^2/12 = 7e-8 by the lines.
    np.testing.assert_allclose(seen[1:], np.diff(position) / 5e-3, atol=1e-7)


def test_steps_of_any_size_give_the_same_low_pass():
    # The series for short steps meets the formula for long ones.
    stage = LowPass(100.0, 2)
    b, a = signal.butter(2, 100.0, analog=True)
    for h in (0.9e-5, 1.1e-5):
        t = np.arange(2000) * h
        y = filtered([stage], t, np.where(np.arange(2000) > 5, 1.0, 0.0))
        # The step is the middle of the one interval that rises: half a step off.
        _, expected = signal.step((b, a), T=np.arange(4000) * h / 2)
        np.testing.assert_allclose(y[6:], expected[1:3989:2], atol=1e-7)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: LowPass(0.0), "cut-off is 0.0 rad/s, expected more than 0"),
        (lambda: LowPass(1.0, 9), "order of a low-pass is 9, expected 1 to 8"),
        (lambda: MovingAverage(np.nan), "mean over nan s"),
        (lambda: Delay(-1.0), "delay of -1.0 s, expected 0 or more"),
        (lambda: first_order(0.0), "time constant is 0.0 s"),
    ],
)
def test_impossible_filters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
