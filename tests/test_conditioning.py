"""What is done to a recording before it is compared."""

import json
from pathlib import Path

import numpy as np
import pytest
from gap_benchmark.cases import MECHANISMS, Case, _mechanism_scene
from gap_benchmark.mechanism import to_urdf, with_background
from gap_benchmark.mechanism_world import MechanismWorld, Reference, Sampling
from gap_benchmark.sensing import hermite

from makebreak.gap.data.checks import check_recordings
from makebreak.gap.data.clock import clock_period, even_clock
from makebreak.gap.data.command_clock import ticks
from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recording
from makebreak.gap.numerics.signal_noise import estimate_noise, noise_and_jitter
from makebreak.gap.workflow import run_gap
from makebreak.systems.numerics.filters import filtered


def written(folder, table, sidecar=None, name="log"):
    path = folder / f"{name}.csv"
    rows = np.stack(list(table.values()), axis=1)
    np.savetxt(path, rows, "%.12g", ",", header=",".join(table), comments="")
    path.write_text(path.read_text().replace("nan", ""))
    if sidecar:
        path.with_suffix(".yaml").write_text(json.dumps(sidecar))
    return path


def motion(t):
    """Position, velocity, acceleration of one joint [rad]."""
    w, size = np.array([1.3, 4.1, 9.0]), np.array([0.8, 0.3, 0.05])
    angle = w * np.reshape(t, (-1, 1))
    return (
        np.sin(angle) @ size,
        np.cos(angle) @ (size * w),
        -np.sin(angle) @ (size * w * w),
    )


def dirty(n=8000, period=1e-3, held=0.06, jitter=3e-4, noise=1e-5, seed=0):
    """One joint at 1 kHz, with held rows and stamps that scatter; the true times."""
    rng = np.random.default_rng(seed)
    true = period * np.arange(n)
    q, v, a = motion(true)
    table = {
        "time": true + np.clip(jitter * rng.normal(size=n), -0.45e-3, 0.45e-3),
        "a.j.position": q + noise * rng.normal(size=n),
        "a.j.velocity": v + 2e-3 * rng.normal(size=n),
        "a.j.effort_command": np.round(a, 1),
    }
    repeated = rng.uniform(size=n) < held
    repeated[:2] = False
    for k in np.flatnonzero(repeated):
        for name in list(table)[1:]:
            table[name][k] = table[name][k - 1]
    return table, true, repeated


def test_held_rows_are_found_and_left_out_and_no_others(tmp_path):
    table, _, repeated = dirty(jitter=0.0)
    recording = read_recording(written(tmp_path, table))
    (out,), found = condition([recording], average=False)
    (finding,) = [f for f in found if f.kind == "rows_held"]
    assert finding.size == pytest.approx(repeated.mean(), rel=1e-6)
    np.testing.assert_array_equal(np.isnan(out["a.j.position"]), repeated)
    # A command holds in any case.
    assert np.isfinite(out["a.j.effort_command"]).all()


def test_noise_free_rest_and_grids_are_not_taken_for_held_rows(tmp_path):
    t = np.arange(4000) * 1e-3
    q = np.where(t < 2.0, 0.0, motion(t - 2.0)[0])  # Two seconds at rest.
    table = {"time": t, "a.j.position": q, "a.k.position": 0.0 * t + 1.0}
    recording = read_recording(written(tmp_path, table))
    assert [f for f in condition([recording])[1] if "held" in f.kind] == []
    # An encoder of 1.5 mrad repeats half of its values, one joint as it likes.
    step, rng = 1.534e-3, np.random.default_rng(0)
    table = {"time": t}
    for k, name in enumerate("jkl"):
        y = motion(0.3 * t + k)[0] + 1e-4 * rng.normal(size=len(t))
        table[f"a.{name}.position"] = step * np.round(y / step)
    recording = read_recording(written(tmp_path, table, name="grid"))
    assert [f for f in condition([recording])[1] if "held" in f.kind] == []


def test_a_slow_channel_in_a_fast_table_gets_its_own_rate(tmp_path):
    table, true, _ = dirty(held=0.0, jitter=0.0)
    slow = table["a.j.velocity"]
    slow[:] = slow[4 * (np.arange(len(slow)) // 4)]  # 250 Hz, each value in four rows.
    (out,), found = condition([read_recording(written(tmp_path, table))], average=False)
    (finding,) = [f for f in found if f.kind == "samples_held"]
    assert "250 Hz" in finding.says
    assert out.channels["a.j.velocity"].rate_hz == pytest.approx(250.0, rel=0.01)


def test_stamps_that_scatter_about_an_even_clock_are_put_right(tmp_path):
    table, true, _ = dirty()
    lost = np.ones(len(true), bool)
    lost[[2000, 5000, 5001]] = False
    table = {k: v[lost] for k, v in table.items()}
    recording = read_recording(written(tmp_path, table))
    (out,), found = condition([recording], average=False)
    assert "even_clock" in [f.kind for f in found]
    off = out.time - true[lost]
    before = recording.time - true[lost]
    # One straight line through thousands of stamps of a scatter of 0.28 ms.
    assert off.std() < 0.015e-3 and before.std() > 0.25e-3
    # Rows that are not lost are not said to be.
    (finding,) = [f for f in check_recordings([recording]) if f.kind == "rows_lost"]
    assert finding.size * len(true) == pytest.approx(3.0, abs=1.1)


def test_true_stamps_that_are_uneven_are_left_as_they_are(tmp_path):
    rng = np.random.default_rng(2)
    t = np.arange(6000) * 1e-3 + rng.uniform(-3e-4, 3e-4, 6000)
    q, v, _ = motion(t)
    table = {
        "time": t,
        "a.j.position": q + 1e-5 * rng.normal(size=len(t)),
        "a.j.velocity": v + 2e-3 * rng.normal(size=len(t)),
    }
    recording = read_recording(written(tmp_path, table))
    (out,), found = condition([recording], average=False)
    assert found == []
    np.testing.assert_array_equal(out.time, recording.time)


def test_a_clock_of_scattering_stamps_keeps_its_rate_and_its_drift():
    rng = np.random.default_rng(3)
    true = np.cumsum(1e-3 * (1.0 + 0.01 * np.sin(np.arange(5000) / 900.0)))
    t = true + np.clip(3e-4 * rng.normal(size=5000), -4e-4, 4e-4)
    assert clock_period(t) == pytest.approx(1e-3, rel=2e-3)
    assert np.std(even_clock(t) - true) < 0.08e-3


@pytest.mark.parametrize(
    ("wander", "most"), [(0.0, 0.01e-3), (1e-4, 0.02e-3), (1e-2, 0.08e-3)]
)
def test_a_clock_is_known_better_than_by_running_medians(wander, most):
    """The errors of running medians (0.07 ms here) go together over 31 rows, which is
    how robots move: a rate of 1 rad/s would shake by 0.07 mrad at 16 Hz. Only where the
    rate changes by 1 % within seconds are they all there is."""
    rng = np.random.default_rng(3)
    true = np.cumsum(1e-3 * (1.0 + wander * np.sin(np.arange(20000) / 3000.0)))
    t = true + np.clip(3e-4 * rng.normal(size=20000), -4e-4, 4e-4)
    off = even_clock(t) - true
    assert np.std(off) < most


@pytest.mark.parametrize("share", [0.002, 0.05])
@pytest.mark.parametrize("scatter", [0.05, 0.25])
def test_lost_rows_are_counted(share, scatter):
    """Also where single steps do not tell: with a scatter of a quarter of a period, a
    lost row's step is 1.2 periods as often as one without is."""
    rng = np.random.default_rng(4)
    there = rng.random(10000) > share
    true = 2e-3 * np.arange(10000)[there]
    off = np.clip(scatter * rng.normal(size=len(true)), -0.45, 0.45)
    t = true + 2e-3 * off
    assert np.std(even_clock(t) - true) < 0.03e-3


def test_a_late_row_is_not_a_lost_one():
    """Late by up to 0.8 periods, and none is lost."""
    rng = np.random.default_rng(4)
    true = 2e-3 * np.arange(10000)
    t = true + 2e-3 * np.minimum(rng.exponential(0.15, size=10000), 0.8)
    off = even_clock(t) - true
    assert np.std(off) < 0.03e-3


def test_stamps_that_are_coarser_than_rows_get_the_rows_clock():
    true = 2e-3 * np.arange(6000)
    t = np.round(true, 2)
    assert np.std(t - true) > 2.5e-3 and np.std(even_clock(t) - true) < 0.2e-3


def test_averages_are_at_the_middles_and_commands_at_the_starts(tmp_path):
    table, true, _ = dirty(held=0.02, jitter=0.0, noise=1e-4)
    recording = read_recording(written(tmp_path, table))
    (out,), found = condition([recording])
    (finding,) = [f for f in found if f.kind == "averaged"]
    length = finding.size
    assert 0.004 <= length <= 0.0101
    there = np.isfinite(out["a.j.position"])
    # The filter that is said to lie before it gives the very same values.
    dense = np.arange(-0.05, 8.05, 1e-4)
    channel = out.channels["a.j.position"]
    expected = filtered(channel.stages, dense, motion(dense)[0], out.time[there])
    off = (out["a.j.position"][there] - expected)[2:-2]
    single = 1e-4 / np.sqrt(length / 1e-3 * 0.98)
    assert np.std(off) == pytest.approx(single, rel=0.15)
    assert abs(off.mean()) < 4.0 * single / np.sqrt(len(off))
    assert channel.noise == pytest.approx(single, rel=0.25)
    # Commands: the mean of what is held over the block that begins there.
    sent = np.isfinite(out["a.j.effort_command"])
    u, at = out["a.j.effort_command"][sent], out.time[sent]
    np.testing.assert_allclose(np.diff(at), length, rtol=1e-6)
    k = 100
    n = round(length / 1e-3)
    first = np.searchsorted(recording.time, at[k] - 1e-9)
    expected = np.mean(recording["a.j.effort_command"][first : first + n])
    assert u[k] == pytest.approx(expected, abs=1e-9)


def test_slow_logs_and_objects_that_hit_are_not_averaged(tmp_path):
    table, _, _ = dirty(n=4000, period=4e-3, held=0.0, jitter=0.0)
    recording = read_recording(written(tmp_path, table))
    (out,), found = condition([recording])
    assert (found, out.time is recording.time) == ([], True)


def test_noise_grows_with_speed_where_stamps_are_off_and_only_there():
    rng = np.random.default_rng(5)
    for jitter in (0.0, 2e-4):
        t = np.arange(8000) * 2e-3
        seen = motion(t + jitter * rng.normal(size=len(t)))[0]
        seen = seen + 2e-5 * rng.normal(size=len(t))
        own = estimate_noise(seen, None, t).std
        found, total = noise_and_jitter(seen, None, t, own)
        if jitter == 0.0:
            assert (found, total) == (0.0, own)
            continue
        assert found == pytest.approx(jitter, rel=0.15)
        speed = np.sqrt(np.mean(motion(t)[1] ** 2))
        assert total == pytest.approx(np.hypot(2e-5, jitter * speed), rel=0.15)


# ----- from a log as a robot writes it to the verdict


def pendulum_log(folder: Path, is_dirty: bool):
    """1 kHz, friction in the elbow, velocities 5.4 ms late; the dirty one has 6 % of
    repeated rows, stamps off by 0.3 ms, and the very same motion and noise."""
    rng = np.random.default_rng(7)
    nominal = MECHANISMS["pendulum"](rng)
    true = with_background(nominal, rng, 0.03, 0.002)
    effect = {
        "kind": "joint_coulomb_friction",
        "at": nominal.joints[1],
        "parameters": {"coulomb": 0.25},
    }
    world = MechanismWorld(nominal, true, [effect], "effort")
    sampling = Sampling(rate_hz=1000.0, position_noise=1e-5, velocity_noise=1e-3)
    track = world.run(9.0, Reference(nominal, rng), sampling, rng)
    n, t = len(track.tick), np.array(track.tick)
    rng = np.random.default_rng(8)
    table = {"time": t}
    for i, joint in enumerate(nominal.joints):
        q = hermite(track.time, track.q[:, i], track.v[:, i])(t)
        v = np.interp(t - 0.0054, track.time, track.v[:, i])
        table[f"{joint}.position"] = q + 1e-5 * rng.normal(size=n)
        table[f"{joint}.velocity"] = v + 2e-3 * rng.normal(size=n)
        table[f"{joint}.effort_command"] = track.commands["effort_command"][:, i]
    if is_dirty:
        repeated = np.flatnonzero(rng.uniform(size=n - 2) < 0.06) + 2
        for name in list(table)[1:]:
            for k in repeated:
                table[name][k] = table[name][k - 1]
        late = t + np.clip(3e-4 * rng.normal(size=n), -1.2e-3, 1.2e-3)
        table["time"] = np.maximum.accumulate(late) + 1e-7 * np.arange(n)
    folder.mkdir()
    case = Case("log", 7, "pendulum", (), True, ())
    columns = {**table, "episode": np.zeros(n)}
    scene = _mechanism_scene(case, nominal, "effort", columns, rng)
    (folder / "scene.yaml").write_text(scene)
    (folder / f"{nominal.model}.urdf").write_text(to_urdf(nominal))
    return run_gap(folder / "scene.yaml", [written(folder, table)])


@pytest.mark.slow
def test_a_log_with_held_rows_and_jitter_gives_the_names_of_a_clean_one(tmp_path):
    names, lags = [], []
    for is_dirty in (False, True):
        result = pendulum_log(tmp_path / str(is_dirty), is_dirty)
        names.append([(e.kind, tuple(e.at)) for e in result.effects])
        for effect in result.effects:
            if effect.kind in ("sensor_delay", "sensor_lag"):
                lags += [p.value for p in effect.parameters.values()]
            else:
                assert effect.kind == "joint_coulomb_friction"
                assert effect.parameters["coulomb"].value == pytest.approx(
                    0.25, rel=0.05
                )
    assert names[0] == names[1] and len(names[0]) == 2
    np.testing.assert_allclose(lags, 0.0054, rtol=0.2)


def loop_log(folder, row, period, phase, seconds=4.0):
    """A log with a row each `row` [s] of a loop whose commands change each `period`,
    with a rest in the middle, and none before the eleventh."""
    n = int(seconds / row)
    time = row * np.arange(n)
    k = np.floor((time - phase) / period + 1e-9)
    command = np.where((k > 300) & (k < 330), 0.0, np.sin(0.05 * k))
    command[k < 10] = np.nan
    position = 0.3 * np.sin(3.0 * time)
    position += 1e-4 * np.random.default_rng(0).normal(size=n)
    columns = {"time": time, "a.j.position": position, "a.j.position_command": command}
    return written(folder, columns), time, command


@pytest.mark.parametrize("phase", [0.0, 0.7e-3])
def test_commands_between_rows_get_rows_at_their_loops_ticks(tmp_path, phase):
    """Of a loop of 4.7 ms in a log of 2 ms: its changes are known far better than a
    row."""
    file, _, _ = loop_log(tmp_path, 2e-3, 4.7e-3, phase)
    recording = read_recording(file)
    (out,), found = condition([recording], average=False)
    assert [f.kind for f in found] == ["command_clock"]
    u = out.held("a.j.position_command")
    changed = out.time[1 + np.flatnonzero(np.abs(np.diff(u)) > 0.0)]
    off = (changed - phase + 1e-6) % 4.7e-3 - 1e-6
    assert len(changed) > 600 and np.abs(off).max() < 0.2e-3
    # What was measured stays where it was.
    there = np.isfinite(out["a.j.position"])
    np.testing.assert_array_equal(out.time[there], recording.time)
    for name in ("a.j.position", "a.j.position_command"):
        np.testing.assert_array_equal(out[name][there], recording[name])
    assert out.period_sec() == pytest.approx(2e-3)


K = np.arange(4, 790)
ANYHOW = {
    "at any time": np.sort(np.random.default_rng(3).uniform(0.0, 4.0, 700)),
    "each tenth by 1.5 rows late": 5e-3 * K - 1e-4 + 2.9e-3 * (K % 10 == 1),
}


def test_commands_that_change_at_rows_stay_as_they_are(tmp_path):
    file, _, _ = loop_log(tmp_path, 2e-3, 8e-3, 0.0)
    assert condition([read_recording(file)], average=False)[1] == []


@pytest.mark.parametrize("events", ANYHOW)
def test_commands_without_an_even_clock_stay_as_they_are(tmp_path, events):
    time = 2e-3 * np.arange(2000)
    columns = {
        "time": time,
        "a.j.position": 0.1 * np.random.default_rng(3).normal(size=2000),
        "a.j.position_command": np.searchsorted(ANYHOW[events], time).astype(float),
    }
    file = written(tmp_path, columns)
    assert condition([read_recording(file)], average=False)[1] == []


def test_averages_leave_commands_of_a_loop_their_own_rows(tmp_path):
    """The mean of a block in the place of two commands would act as a weaker drive."""
    file, time, command = loop_log(tmp_path, 1e-3, 5e-3, 0.0)
    recording = read_recording(file)
    (out,), found = condition([recording])
    assert "averaged" in [f.kind for f in found]
    u = out.held("a.j.position_command")
    at = np.searchsorted(out.time, time + 1e-9, "right") - 1
    last = (time < out.time[-1]) & np.isfinite(command)
    np.testing.assert_allclose(u[at][last], command[last], rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_clock_little_slower_than_the_rows_is_found_over_pauses(seed):
    rng = np.random.default_rng(seed)
    row, period = 0.004, 0.005 * (1.0 + 2e-5 * rng.normal())
    at = rng.uniform(0.0, row) + period * np.arange(3000)
    for first in rng.integers(300, 2700, 4):  # Nothing changes for a while.
        at = np.delete(at, slice(first, first + 30))
    shown = row * np.ceil(at / row)
    found = ticks(shown - row, shown)
    assert found is not None and np.abs(found - at).max() < 0.3 * row
