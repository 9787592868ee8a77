"""How uncertain starts and noisy efforts spread along a motion, and in windows."""

import numpy as np
import pytest
from effect_scenes import LENGTH, MASS, J, pendulum

from makebreak.gap.data.reading import read_recordings
from makebreak.gap.data.table import write_recording
from makebreak.gap.numerics.growth import spread_along
from makebreak.gap.simulation.windows import WindowModel

UP = 40.0  # [m/s2] A gravity that lifts: the pendulum stands on its head.


def test_a_start_and_noise_spread_as_the_closed_form_says():
    """a = w^2 q + W effort: cosh and sinh."""
    w, W, t = 9.0, 3.0, np.linspace(0.0, 0.3, 31)
    start = np.array([[1e-8, 2e-8], [2e-8, 1e-5]])
    white, steady = 2e-6, 1e-4
    found = spread_along(
        np.array([[[w**2, 0.0]]] * 3), np.array([[[W]]] * 3),
        start, np.array([white]), np.array([steady]), t, np.zeros((len(t), 1)),
    )  # fmt: skip
    c, s = np.cosh(w * t), np.sinh(w * t)
    moved = np.stack([[c, s / w], [w * s, c]]).transpose(2, 0, 1)
    expected = np.einsum("tij,jk,tik->ti", moved, start, moved)
    # Integrals of (sinh(w s)/w)^2 and cosh(w s)^2.
    twice = np.sinh(2.0 * w * t) / (4.0 * w)
    expected += white * W**2 * np.stack([(twice - t / 2.0) / w**2, twice + t / 2.0], 1)
    expected += steady * W**2 * np.stack([((c - 1.0) / w**2) ** 2, (s / w) ** 2], 1)
    # Between its 12 steps the deviation is a line.
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(expected), rtol=0.07)
    np.testing.assert_allclose(found[[0, -1]], expected[[0, -1]], rtol=2e-3)


def test_an_impulse_moves_a_free_joint_from_then_on():
    mobility, size, at = 2.0, 0.3, 0.1
    t = np.linspace(0.0, 0.3, 61)
    impulses = np.where(np.isclose(t, at), size**2, 0.0)[:, None]
    free, still = np.zeros((3, 1, 2)), np.zeros((2, 2))
    found = spread_along(
        free, np.full((3, 1, 1), mobility), still, np.zeros(1), np.zeros(1), t, impulses
    )  # fmt: skip
    place, rate = np.sqrt(found.T)
    later = t > at + 0.03  # It is known to within a step of 0.025 s.
    np.testing.assert_allclose(rate[later], mobility * size, rtol=1e-6)
    np.testing.assert_allclose(
        place[later], mobility * size * (t[later] - at), atol=mobility * size * 0.025
    )
    assert not found[t < at - 0.03].any()


def test_slopes_are_those_of_a_pendulum(tmp_path):
    model = WindowModel(*upright(tmp_path, 0.0))
    q, v = np.array([[0.3]]), np.array([[0.5]])
    slopes, mobility = model.dynamics.slopes(q, v, np.array([[1.0]]))
    lift = MASS * UP * LENGTH / J
    np.testing.assert_allclose(slopes[0], [[lift * np.cos(0.3), 0.0]], atol=1e-4)
    np.testing.assert_allclose(mobility[0], [[1.0 / J]])


def upright(folder, noise, seconds=90.0, hz=100.0):
    """A joint that sways about where it would fall from; its effort is measured."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 1.0 / hz)
    q = 0.3 * np.sin(2.0 * t) + 0.2 * np.sin(3.1 * t + 1.0)
    qdd = -0.3 * 4.0 * np.sin(2.0 * t) - 0.2 * 3.1**2 * np.sin(3.1 * t + 1.0)
    effort = J * qdd - MASS * UP * LENGTH * np.sin(q)
    columns = {
        "time": t,
        "p.j1.position": q + 1e-4 * rng.normal(size=len(t)),
        "p.j1.effort_measured": effort + noise * rng.normal(size=len(t)),
    }
    said = {"p.j1.position": 1e-4, "p.j1.effort_measured": max(noise, 1e-4)}
    write_recording(folder / "run.csv", columns, noise=said)
    return pendulum(folder, gravity=-UP), read_recordings([folder / "run.csv"])


@pytest.mark.parametrize("noise", [pytest.param(0.05, marks=pytest.mark.slow), 0.2])
def test_a_perfect_model_of_a_joint_on_its_head_leaves_the_noise(tmp_path, noise):
    model = WindowModel(*upright(tmp_path, noise))
    e = model.errors(model.simulate(()))
    assert np.sqrt(np.mean(np.concatenate(e) ** 2)) == pytest.approx(1.0, abs=0.15)
    # Carried along a straight line, the start's error made it 1.8.
    ends = [x[-1] for x in e]
    assert np.sqrt(np.mean(np.square(ends))) == pytest.approx(1.0, abs=0.15)


def test_one_row_with_a_wild_acceleration_makes_no_joint_fall(tmp_path, monkeypatch):
    """A smoothed acceleration of a fast log may be noise of hundreds of rad/s^2."""
    scene, recordings = upright(tmp_path, 0.05, seconds=5.0)
    model = WindowModel(scene, recordings)
    asked = []
    slopes = model.dynamics.slopes

    def spied(q, v, vd):
        asked.append(vd)
        return slopes(q, v, vd)

    monkeypatch.setattr(model.dynamics, "slopes", spied)
    (path,) = model._paths.values()
    spreads = {"p.j1.position": np.zeros((500, 3, 3))}
    rows, after = slice(100, 131), np.linspace(0.0, 0.3, 31)
    wild = np.where(np.arange(500) % 2, 300.0, -300.0)
    for by in (0.0, wild):
        state = path["p.j1.position"] + np.multiply.outer(by, [0.0, 0.0, 1.0])
        states = {"p.j1.position": state.reshape(-1, 3)}
        model._grown(recordings[0], states, spreads, rows, after, {})
    # Of 10 or 11 rows the mean has at most an eleventh.
    np.testing.assert_allclose(asked[1], asked[0], atol=30.0)
