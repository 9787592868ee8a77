"""Windows of logs in which efforts were measured and nothing was commanded."""

import numpy as np
import pytest
from effect_scenes import J, pendulum
from scipy.signal import lfilter

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.simulation.windows import WindowModel, seen_in

SIZE, RATE = 2.0, 8.0  # [N m], [rad/s] of a sine.
ENCODER = 1e-5  # [rad]


def windows(folder, noise, hz=50.0, seconds=20.0, slow=0.0, known=True):
    """Of a joint that a sine of effort swings about its middle, without gravity.
    slow [N m]: of the effort's noise that lasts for 3 s; known: to the windows."""
    scene = pendulum(folder, gravity=0.0)
    rng = np.random.default_rng(0)
    time = np.arange(0.0, seconds, 1.0 / hz)
    position = -SIZE / (J * RATE**2) * np.sin(RATE * time)
    columns = {
        "time": time,
        "p.j1.position": position + ENCODER * rng.normal(size=len(time)),
        "p.j1.effort_measured": SIZE * np.sin(RATE * time)
        + noise * rng.normal(size=len(time))
        + slow * lasting(len(time), np.exp(-1.0 / (3.0 * hz)), rng),
    }
    said = {"p.j1.position": ENCODER, "p.j1.effort_measured": max(noise, 1e-4)}
    write_recording(folder / "run.csv", columns, noise=said)
    recordings = read_recordings([folder / "run.csv"])
    return WindowModel(scene, recordings, slow_noise={"p.j1": slow if known else 0.0})


def lasting(n, keep, rng):
    """(n,) of unit variance, of which a share `keep` lasts from row to row."""
    return lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(size=n))


def test_a_measured_effort_is_a_line_between_rows_and_is_not_held(tmp_path):
    model = windows(tmp_path, 0.0)
    off = np.concatenate(
        [seen_in(model, w) - y
         for w, y in zip(model.windows, model.simulate(()), strict=True)]
    )  # fmt: skip
    # Held, it would come half a row late: SIZE/J * 0.01 s, for 0.3 s, is 0.02 rad.
    # In steps of 5 ms a line is off by (RATE 5 ms)^2/24 of the motion; the start's
    # velocity by 1e-3 rad/s or less.
    assert np.sqrt(np.mean(off**2)) < 4e-4


@pytest.mark.parametrize("noise", [0.1, 0.4])
def test_noise_of_a_measured_effort_is_expected_in_the_windows(tmp_path, noise):
    model = windows(tmp_path, noise, seconds=60.0)
    e = np.concatenate(model.errors(model.simulate(())))
    # 180 windows, of which each counts as one or two; the smoother's own error beside.
    assert np.sqrt(np.mean(e**2)) == pytest.approx(1.0, abs=0.2)
    # It is the effort's: the encoder and the start alone would be a third of it.
    last = np.array([w.std[-1, 0] for w in model.windows])
    t = 0.28  # Some windows have a row less.
    expected = noise / J * np.sqrt(t**3 / 3.0 / 50.0)
    assert (last > 0.95 * expected).all() and np.median(last) < 2.0 * expected


def test_noise_of_a_measured_effort_that_lasts_is_expected_in_the_windows(tmp_path):
    rms = {}
    for known in (True, False):
        model = windows(tmp_path, 0.1, seconds=120.0, slow=0.5, known=known)
        e = np.concatenate(model.errors(model.simulate(())))
        rms[known] = np.sqrt(np.mean(e**2))
    # 120 s have some 20 independent values of it.
    assert rms[True] == pytest.approx(1.0, abs=0.3)
    assert rms[False] > 2.0 * rms[True]
