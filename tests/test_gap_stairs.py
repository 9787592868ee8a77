"""Commands in stairs: what they do to a start, to means over blocks, and to samples of
a faster loop. Beside fine integration."""

import numpy as np
import pytest
from scipy.linalg import inv
from test_gap_sticking import encoders, four_joints, goals, log_of

from makebreak.gap.data.command_clock import in_lines, moved_sooner
from makebreak.gap.data.conditioning import condition
from makebreak.gap.data.reading import read_recording, read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.numerics.signal_relation import relate
from makebreak.gap.numerics.stairs import beside_line
from makebreak.gap.simulation import windows
from makebreak.gap.simulation.driven_arm import DrivenArmSimulation
from makebreak.gap.simulation.sensor_samples import behind, with_middles
from makebreak.gap.simulation.windows import WindowModel
from makebreak.systems.numerics.filters import MovingAverage


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))]
)
def test_what_stairs_do_beside_their_line_is_that_of_two_simulations(seed):
    rng = np.random.default_rng(seed)
    mass = np.array([[3.8, 0.9], [0.9, 0.5]]) * 1e-3
    kp, kd, period = np.array([12.0, 1.4]), np.array([0.3, 0.036]), 0.01
    time = period * np.arange(120)
    held = 0.5 * np.sin(np.outer(time, [2.0, 3.0]) + rng.uniform(0.0, 6.0, 2))
    at, h = rng.uniform(0.6, 0.9), 1e-5
    q, v = np.zeros((2, 2)), np.zeros((2, 2))  # Of stairs, and of their line.
    W = inv(mass)
    for k in range(round(at / h)):
        t = (k + 0.5) * h
        line = [np.interp(t, time + 0.5 * period, y) for y in held.T]
        stair = held[int(t / period)]
        v += h * (np.array([stair, line]) - q) * kp @ W - h * v * kd @ W
        q += h * v
    dq, dv = beside_line(W, kp, kd, time, held, at)
    np.testing.assert_allclose(dv, v[0] - v[1], atol=0.03 * np.abs(v[0] - v[1]).max())
    np.testing.assert_allclose(dq, q[0] - q[1], atol=3e-6)


def test_a_long_rest_before_stairs_is_no_step():
    time = np.append(0.01 * np.arange(30), 2.0 + 0.01 * np.arange(12))
    held = np.append(1e-9 * np.arange(30), 5e-3 * np.arange(1, 13))[:, None]
    servo = np.eye(1) / 1.7e-3, np.array([12.0]), np.array([0.3])
    for at in (1.999, 2.05):  # 5 mrad if the line began amid the rest.
        assert np.abs(beside_line(*servo, time, held, at)[0]).max() < 1e-4
    none = beside_line(*servo, time, held, 0.1)
    assert not np.any(none)  # Too little is known of what was before.
    assert not np.any(beside_line(*servo, time[:0], held[:0], 1.0))


@pytest.mark.parametrize("start", [0.0, 7.3])
def test_means_of_what_repeats_in_every_block_are_means(tmp_path, start):
    """Rows 2 ms apart, a new command every 10 ms: velocities are lower after each."""
    rng, n = np.random.default_rng(0), 6000
    time = start + 0.002 * np.arange(n)
    slow = np.sin(1.3 * (time - start))
    swing = np.tile([-0.06, 0.01, 0.03, 0.02, 0.0], n // 5) * slow
    velocity = slow + swing + 1e-3 * rng.normal(size=n)
    file = tmp_path / "r.npz"
    write_recording(file, {
        "time": time, "a.j.velocity": velocity,
        "a.j.position": -np.cos(1.3 * (time - start)) / 1.3 + 1e-4 * rng.normal(size=n),
    })  # fmt: skip
    (out,), found = condition([read_recording(file)])
    assert [f.size for f in found if f.kind == "averaged"] == [pytest.approx(0.01)]
    there = np.isfinite(out["a.j.velocity"])
    blocks = velocity.reshape(-1, 5).mean(axis=1)[: there.sum()]
    np.testing.assert_allclose(out["a.j.velocity"][there], blocks, atol=1e-9)
    middles = time.reshape(-1, 5).mean(axis=1)[: there.sum()]
    np.testing.assert_allclose(out.time[there], middles, atol=1e-9)


def test_slow_motion_that_grows_has_no_lag():
    """Its power is larger where it is later: a shift there must not count as likeness;
    and what repeats every 10 ms has fits of its own beside the right one."""
    rng, n = np.random.default_rng(0), 10000
    time = 0.002 * np.arange(n)
    grown = 0.05 + 0.02 * time
    swing = 2e-4 * np.sin(2.0 * np.pi * 100.0 * time)
    position = -grown / 0.6 * np.cos(0.6 * time) + swing + 1e-4 * rng.normal(size=n)
    velocity = np.gradient(-grown / 0.6 * np.cos(0.6 * (time - 0.001)), time)
    found = relate(time, velocity, time, position, order=1)
    assert found is not None and found.lag == pytest.approx(0.001, abs=0.002)


@pytest.mark.parametrize("times", [1, 2.5, 5, 10])
def test_commands_of_a_faster_loop_go_from_sample_to_sample(tmp_path, times):
    """Rows of 10 ms of a loop so many times as fast: what is commanded, on average over
    a loop's period, is what the loop had; of one as fast as the rows, all of it."""
    row, n = 0.01, 400
    time = row * np.arange(n)
    wanted = np.sin(1.7 * time)
    wanted[150:200] = wanted[150]  # It rests.
    file = tmp_path / "r.npz"
    write_recording(file, {
        "time": time, "a.j.position": wanted, "a.j.position_command": wanted,
    })  # fmt: skip
    recording = read_recording(file)
    early = 0.5 * row * (1.0 - 1.0 / times)
    (moved,) = moved_sooner([recording], early)
    t = np.arange(0.5, 3.5, 1e-4) + 3e-5

    def sent(recording, late=0.0):
        k = np.searchsorted(recording.time, t + late, "right") - 1
        return recording.held("a.j.position_command")[k]

    got = sent(moved)
    if times < 3:  # Held for a row, or for a part: both are as early.
        np.testing.assert_allclose(got, sent(recording, early), atol=1e-12)
    else:  # A loop of 500 Hz at least, as early on average as the one there is.
        off = got - np.sin(1.7 * (t - 0.5 * row / times))
        free = np.abs(np.cos(1.7 * t)) * ((t < 1.49) | (t > 2.01)) > 0.1
        assert np.abs(off[free]).max() < 1.7 * (0.5 * max(row / times, 0.002) + 2e-5)
        assert np.abs(np.mean((off * np.sign(np.cos(1.7 * t)))[free])) < 1e-4
        rests = (t > 1.52) & (t < 1.98)
        np.testing.assert_array_equal(got[rests], wanted[150])
    assert moved.period_sec() == pytest.approx(row)
    measured = np.isfinite(moved["a.j.position"])
    np.testing.assert_array_equal(moved["a.j.position"][measured], wanted)


def test_commands_in_lines_are_what_lies_between_their_samples(tmp_path):
    """As a scene's `hold: first_order` says; of efforts nothing changes."""
    row, n = 0.01, 300
    time = row * np.arange(n)
    wanted = np.sin(1.7 * time)
    file = tmp_path / "r.npz"
    write_recording(file, {
        "time": time, "a.j.position_command": wanted, "a.k.effort_command": wanted,
    })  # fmt: skip
    lines = in_lines(read_recording(file))
    t = np.arange(0.1, 2.9, 1e-4) + 3e-5
    k = np.searchsorted(lines.time, t, "right") - 1
    off = lines.held("a.j.position_command")[k] - np.interp(t, time, wanted)
    assert np.abs(off).max() < 1.02 * 1.7 * 0.001  # Half a step of 2 ms, to each side.
    assert abs(np.mean(off * np.sign(np.cos(1.7 * t)))) < 3e-5
    held = wanted[np.searchsorted(time, t, "right") - 1]
    np.testing.assert_array_equal(lines.held("a.k.effort_command")[k], held)


def test_a_mean_of_simulated_velocities_is_what_positions_moved():
    """Instants 2.5 ms apart of what swings every 2 ms, and some that are nearly one."""
    t = np.sort(np.append(0.0025 * np.arange(200), [0.1 + 1e-12, 0.2011]))
    swing = 2.0 * np.pi / 0.002
    position = np.sin(2.0 * t) - 0.05 * np.cos(swing * t) / swing
    velocity = 2.0 * np.cos(2.0 * t) + 0.05 * np.sin(swing * t)
    stages = (MovingAverage(0.01, centred=True),)
    fine, v = with_middles(t, position, velocity)
    at = 0.05 + 0.0025 * np.arange(100)
    got = np.interp(at, fine, behind(stages, fine, v, None))
    mean = (np.sin(2.0 * (at + 0.005)) - np.sin(2.0 * (at - 0.005))) / 0.01
    assert np.abs(got - mean).max() < 5e-4
    plain = np.interp(at, t, behind(stages, t, velocity, None))
    assert np.abs(plain - mean).max() > 4e-3


def test_windows_begin_with_what_stairs_of_commands_do(tmp_path, monkeypatch):
    scene, joints = four_joints(tmp_path)
    time, told = goals(len(joints), np.random.default_rng(0))
    file, _ = log_of(scene, joints, tmp_path, time, told, encoders(0, 2e-4))
    (recording,) = read_recordings([file])
    asked, n = [], len(joints)

    def starts(by):
        def known(*args):
            asked.append(args)
            return np.full(n, by), np.full(n, 2.0 * by)

        monkeypatch.setattr(windows, "beside_line", known)
        model = WindowModel(scene, [recording], simulation=DrivenArmSimulation(scene))
        return [w.state[f"{j}.position"] for w in model.windows for j in joints]

    for plain, moved in zip(starts(0.0), starts(0.1), strict=True):
        np.testing.assert_allclose(moved - plain, [0.1, 0.2, 0.0], atol=1e-12)
    mobility, kp, kd, since, held, at = asked[-1]
    assert (np.linalg.eigvalsh(mobility) > 0.0).all() and at > since[0]
    by_name = dict(zip(joints, zip(scene.actuation.kp, scene.actuation.kd, strict=True),
                       strict=True))  # fmt: skip
    assert sorted(zip(kp, kd, strict=True)) == sorted(by_name.values())
    assert (held[1:] != held[:-1]).any(axis=1).all() and len(since) == len(held)
    np.testing.assert_allclose(np.sort(held[0]), np.sort(told[:, 0]), atol=1e-8)
