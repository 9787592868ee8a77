"""Windows of logs in which efforts were measured and nothing was commanded."""

import numpy as np
import pytest
from effect_scenes import J, pendulum

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.simulation.windows import WindowModel, seen_in

SIZE, RATE = 2.0, 8.0  # [N m], [rad/s] of a sine.
ENCODER = 1e-5  # [rad]


def windows(folder, noise, hz=50.0, seconds=20.0):
    """Of a joint that a sine of effort swings about its middle, without gravity."""
    scene = pendulum(folder, gravity=0.0)
    rng = np.random.default_rng(0)
    time = np.arange(0.0, seconds, 1.0 / hz)
    position = -SIZE / (J * RATE**2) * np.sin(RATE * time)
    columns = {
        "time": time,
        "p.j1.position": position + ENCODER * rng.normal(size=len(time)),
        "p.j1.effort_measured": SIZE * np.sin(RATE * time)
        + noise * rng.normal(size=len(time)),
    }
    said = {"p.j1.position": ENCODER, "p.j1.effort_measured": max(noise, 1e-4)}
    write_recording(folder / "run.csv", columns, noise=said)
    return WindowModel(scene, read_recordings([folder / "run.csv"]))


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
