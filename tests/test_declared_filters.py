"""Filters that a sidecar declares: read, simulated, and found where they are wrong."""

import json

import numpy as np
import pytest
from gap_benchmark.cases import cases, make, write
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter

from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.filters import read_filter
from makebreak.gap.data.reading import read_recording, read_recordings
from makebreak.gap.workflow import run_gap
from makebreak.systems.numerics.filters import Delay, LowPass, MovingAverage, filtered
from makebreak.systems.numerics.smoother import smooth, smooth_filtered

FIRST_40 = LowPass(2 * np.pi * 40.0)


@pytest.mark.parametrize(
    "said, stages",
    [
        ("first order, 40 Hz", [FIRST_40]),
        ("First-order low-pass 40 Hz", [FIRST_40]),
        ("low-pass, 0.04 kHz", [FIRST_40]),
        ("low pass 1st order 251.32741228718345 rad/s", [FIRST_40]),
        ("first order, 4 ms", [LowPass(250.0)]),
        ("RC, tau = 0.004 s", [LowPass(250.0)]),
        ("Butterworth of order 2, 30 Hz", [LowPass(2 * np.pi * 30.0, 2)]),
        ("4th order Butterworth at 30 Hz", [LowPass(2 * np.pi * 30.0, 4)]),
        ("second order low-pass, 30 Hz", [LowPass(2 * np.pi * 30.0, 2)]),
        ("moving average, 10 ms", [MovingAverage(0.01)]),
        ("mean over 5 samples", [MovingAverage(0.01)]),
        ("backward difference", [MovingAverage(0.002)]),
        ("backward differences; first order, 40 Hz", [MovingAverage(0.002), FIRST_40]),
        ("delay, 5 ms", [Delay(0.005)]),
        ("delay of 2 samples", [Delay(0.004)]),
        ("exponential, alpha = 0.5", [LowPass(np.log(2.0) / 0.002)]),
        ("none", []),
        ({"type": "first order", "cutoff_hz": 40}, [FIRST_40]),
        ({"type": "first_order", "time_constant": 0.004}, [LowPass(250.0)]),
        (
            [
                {"type": "butterworth", "order": 2, "cutoff_hz": 30},
                {"type": "delay", "samples": 1},
            ],
            [LowPass(2 * np.pi * 30.0, 2), Delay(0.002)],
        ),
    ],
)
def test_what_a_sidecar_says_is_a_filter(said, stages):
    found = read_filter("arm.j.velocity", said, "velocity", 0.002)
    assert len(found) == len(stages)
    for one, other in zip(found, stages, strict=True):
        assert type(one) is type(other)
        np.testing.assert_allclose(
            list(vars(one).values()), list(vars(other).values()), rtol=1e-12
        )


@pytest.mark.parametrize(
    "said", ["Kalman", "zero-phase Butterworth of order 2, 5 Hz", "40 Hz", "smooth"]
)
def test_a_text_that_says_no_filter_is_said_not_to_be_one(tmp_path, said):
    assert read_filter("arm.j.velocity", said, "velocity", 0.002) is None
    t = np.arange(100) * 0.01
    rows = "\n".join(f"{a},{np.sin(a)},{np.cos(a)}" for a in t)
    (tmp_path / "a.csv").write_text(f"time,arm.j.position,arm.j.velocity\n{rows}\n")
    (tmp_path / "a.yaml").write_text(json.dumps({"filters": {"arm.j.velocity": said}}))
    found = check_recordings(read_recordings([tmp_path / "a.csv"]))
    (one,) = [f for f in found if f.kind == "filter_unknown"]
    assert one.severity == "warning" and said in one.says


@pytest.mark.parametrize(
    "said, message",
    [
        (3, "filters of arm.j.velocity: got 3, expected a text"),
        ({"type": "butter", "cutoff_hz": 4}, 'type "butter": did you mean butterworth'),
        ({"type": "delay"}, "delay needs delay or samples"),
        ({"type": "first_order", "cutoff": 4}, 'first_order has no "cutoff"'),
        ({"type": "first_order", "cutoff_hz": "fast"}, "cutoff_hz is 'fast'"),
        ({"type": "first_order", "time_constant": 0}, "time_constant is 0.0 s"),
        ({"type": "butterworth", "order": 40, "cutoff_hz": 4}, "expected 1 to 8"),
        ({"type": "butterworth", "order": 1.5, "cutoff_hz": 4}, "expected an integer"),
        ({"type": "exponential", "alpha": 2}, "alpha is 2.0, expected between"),
        ("first order, 0 Hz", "a cut-off is 0.0 rad/s"),
    ],
)
def test_impossible_filters_are_refused_by_name(tmp_path, said, message):
    t = np.arange(20) * 0.01
    rows = "\n".join(f"{a},{a},1" for a in t)
    (tmp_path / "a.csv").write_text(f"time,arm.j.position,arm.j.velocity\n{rows}\n")
    (tmp_path / "a.yaml").write_text(json.dumps({"filters": {"arm.j.velocity": said}}))
    with pytest.raises(ValueError, match="sidecar of .*a.csv") as error:
        read_recording(tmp_path / "a.csv")
    assert message in str(error.value)


@pytest.mark.parametrize(
    "channel, said, message",
    [
        ("arm.j.position", "backward difference", "gives a velocity, this is none"),
        ("arm.j.effort_command", "delay, 5 ms", "a command is known, not measured"),
    ],
)
def test_filters_that_a_channel_cannot_have_are_refused(
    tmp_path, channel, said, message
):
    rows = "\n".join(f"{a * 0.01},1" for a in range(20))
    (tmp_path / "a.csv").write_text(f"time,{channel}\n{rows}\n")
    (tmp_path / "a.yaml").write_text(json.dumps({"filters": {channel: said}}))
    with pytest.raises(ValueError, match=message):
        read_recording(tmp_path / "a.csv")


def test_a_filtered_position_gives_the_true_motion_back():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.004, 0.006, 2000))
    dense = np.arange(-0.5, t[-1] + 0.1, 1e-4)

    def true(at, k=0):
        w = np.array([3.0, 11.0, 26.0])
        return sum(a**k * np.sin(a * at + k * np.pi / 2) / a for a in w)

    stages = [MovingAverage(0.01), LowPass(2 * np.pi * 25.0, 2), Delay(0.008)]
    noise = 1e-5
    y = np.interp(t, dense, filtered(stages, dense, true(dense)))
    y = y + rng.normal(0.0, noise, len(t))
    found = smooth_filtered(t, y, noise, stages).x
    as_if_true = smooth(t, true(t) + rng.normal(0.0, noise, len(t)), noise).x
    plain = smooth(t, y, noise).x
    inside = slice(40, -40)
    for k in range(3):
        off, least, most = (
            np.sqrt(np.mean((x[inside, k] - true(t[inside], k)) ** 2))
            for x in (found, as_if_true, plain)
        )
        # The filters (24 ms in all) took half of 26 rad/s's phase: what undoes that
        # makes noise larger, but not much.
        assert off < 3.0 * least, k
        assert off < 0.1 * most, k


# ----- from files to verdict


def pendulum(folder, low_pass, declared, seed=5):
    """The benchmark's pendulum without any effect, its true velocities behind scipy's
    filters at 20 kHz."""
    (case,) = [c for c in cases("development") if c.name == "02_pendulum_none"]
    made = make(case)
    write(case, folder, made)
    table, rng = dict(made.columns), np.random.default_rng(seed)
    for name in [c for c in table if c.endswith(".velocity")]:
        out = np.full(len(table["time"]), np.nan)
        for number in np.unique(table["episode"]):
            rows = table["episode"] == number
            t = table["time"][rows]
            dense = np.arange(t[0], t[-1] + 1e-4, 5e-5)
            true = CubicSpline(t, made.states[name][rows])(dense)
            seen = low_pass(true - true[0], 2e4) + true[0]
            out[rows] = np.interp(t, dense, seen)
        table[name] = out + rng.normal(0.0, 3e-3, len(out))
    rows = np.stack(list(table.values()), axis=1)
    np.savetxt(
        folder / "recording.csv", rows, "%.9g", ",", header=",".join(table), comments=""
    )
    text = (folder / "recording.csv").read_text().replace("nan", "")
    (folder / "recording.csv").write_text(text)
    (folder / "noise.json").unlink(missing_ok=True)
    if declared:
        filters = {c: declared for c in table if c.endswith(".velocity")}
        (folder / "recording.yaml").write_text(json.dumps({"filters": filters}))
    return run_gap(folder / "scene.yaml", [folder / "recording.csv"])


def first_order(hz):
    def low_pass(x, rate):
        a = 1.0 - np.exp(-2.0 * np.pi * hz / rate)
        return lfilter([a], [1.0, a - 1.0], x)

    return low_pass


def second_order(hz):
    return lambda x, rate: lfilter(*butter(2, hz, fs=rate), x)


@pytest.mark.parametrize(
    "low_pass, declared",
    [
        pytest.param(first_order(40.0), "first order, 40 Hz", marks=pytest.mark.slow),
        (second_order(20.0), "Butterworth of order 2, 20 Hz"),
    ],
    ids=["first order", "Butterworth"],
)
def test_of_declared_filters_nothing_is_invented(tmp_path, low_pass, declared):
    result = pendulum(tmp_path, low_pass, declared)
    assert (result.verdict, result.effects) == ("no_gap", [])
    # As without a filter: in equations and in windows. What is reported on holds 15 of
    # them, whose starts are most of the error: 30 numbers, so 1 +- 0.13.
    assert result.gap.after < 1.26
    kinds = [c.kind for c in result.checks]
    assert "filter_declared" in kinds and "velocity_lag" not in kinds


@pytest.mark.parametrize(
    "declared, lag",
    [
        pytest.param(
            None,
            1 / (2 * np.pi * 20.0),
            id="undeclared",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "first order, 40 Hz", 1 / (4 * np.pi * 20.0), id="declared too fast"
        ),
    ],
)
def test_a_filter_that_is_not_declared_is_found(tmp_path, declared, lag):
    result = pendulum(tmp_path, first_order(20.0), declared)
    (found,) = result.effects
    kinds = {found.kind, *(e.kind for e in found.indistinguishable_from)}
    assert "sensor_lag" in kinds and kinds <= {"sensor_lag", "sensor_delay"}
    assert all(at.endswith(".velocity") for at in found.at)
    (value,) = found.parameters.values()
    # What nobody knows of a declared filter's timing is 0.8 ms of tolerance.
    assert value.value == pytest.approx(lag, rel=0.1 if declared else 0.02)
    assert result.gap.after < 1.26  # As above.
