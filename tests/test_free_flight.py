"""States from a whole flight, against flights of known states."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from makebreak.gap.numerics.free_body import FreeBody, simulate
from makebreak.gap.numerics.free_flight import (
    Flight,
    fit_flight,
    moved,
    turned_by,
)

NOISE = np.array([5e-4] * 4 + [3e-4] * 3)
TIME = np.arange(12) / 120


def box(**other):
    """An uneven box of 0.3 kg, its centre of mass off its origin."""
    numbers = dict(
        mass=0.3, com=np.array([0.01, 0.0, 0.02]),
        inertia=np.diag([1e-3, 2e-3, 2.5e-3]),
        gravity=np.array([0.0, 0.0, -9.81]), spheres=np.array([[0.0, 0.0, 0.0, 0.03]]),
        fixed=np.zeros((1, 15)), pairs=np.zeros((1, 1, 6)), levers=np.zeros((1, 1)),
        forces=np.zeros((0, 6)), drag=np.zeros(3),
    )  # fmt: skip
    return FreeBody(**(numbers | other))


def thrown(rng):
    """A state; and a guess as a smoother may give it."""
    x = np.concatenate([rng.normal(size=4), 0.1 * rng.normal(size=3) + [0, 0, 0.3],
                        6.0 * rng.normal(size=3), rng.normal(size=3)])  # fmt: skip
    x[:4] /= np.linalg.norm(x[:4])
    guess = x.copy()
    guess[7:] += 0.5 * rng.normal(size=6)
    return x, guess


def turn(one, other):
    """Small turn in world's axes [rad] from other to one (4,), by rotation matrices."""
    a, b = (Rotation.from_quat(np.roll(q, -1)) for q in (one, other))
    return (a * b.inv()).as_rotvec()


def test_deviations_cover_what_a_flight_is_off_by_then_and_later():
    rng, body, z = np.random.default_rng(1), box(), []
    for _ in range(60):
        x, guess = thrown(rng)
        pose = simulate(body, x, TIME)[:, :7] + NOISE * rng.normal(size=(12, 7))
        pose[:, :4] *= rng.choice([-1.0, 1.0])  # The same orientation.
        flight = fit_flight(body, TIME, pose, NOISE, guess)
        assert flight is not None and flight.rms < 1.3
        times = np.array([0.0, 0.1])
        truth = simulate(body, x, times)
        for found, C, true in zip(*flight.path(body, times), truth, strict=True):
            off = np.concatenate([turn(found[:4], true[:4]), (found - true)[4:]])
            z.append(off / np.sqrt(np.diag(C)))
    # 120 values of each: their scatter is known to a tenth.
    assert np.std(z, axis=0) == pytest.approx(np.ones(12), abs=0.3)
    # What a smoother would not reach: spin to 0.01 rad/s from a tenth of a second.
    assert np.sqrt(np.diag(flight.covariance))[6:9].max() < 0.012


def test_a_path_is_as_exact_as_its_windows_need():
    """About its centre of mass a body falls along a parabola, whatever its spin."""
    rng, body, times = (
        np.random.default_rng(3),
        box(com=np.zeros(3)),
        np.arange(60) / 120,
    )
    for _ in range(5):
        x, _ = thrown(rng)
        path, _ = Flight(x, np.eye(12), 1.0).path(body, times)
        t = times[:, None]
        place = x[4:7] + x[10:] * t + 0.5 * body.gravity * t**2
        np.testing.assert_allclose(path[:, 4:7], place, atol=1e-7)
        np.testing.assert_allclose(path[:, 10:], x[10:] + body.gravity * t, atol=1e-7)
        # Turning freely keeps the angular momentum.
        momentum = []
        for pose in path:
            R = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
            momentum.append(R @ body.inertia @ R.T @ pose[7:10])
        scale = np.linalg.norm(momentum[0])
        np.testing.assert_allclose(momentum, [momentum[0]] * 60, atol=1e-6 * scale)


def test_what_touches_something_is_no_flight():
    body = box()
    x = np.array([1.0, 0, 0, 0, 0, 0, 0.05, 0, 0, 0, 0.5, 0, 0])
    pose = simulate(body, x, TIME)[:, :7]
    pose[:, 6] = 0.05  # It slides along.
    flight = fit_flight(body, TIME, pose, NOISE, x)
    assert flight is not None and flight.rms > 3.0


def test_missing_poses_and_an_unmeasured_orientation():
    rng, body = np.random.default_rng(2), box(com=np.zeros(3))
    x, guess = thrown(rng)
    pose = simulate(body, x, TIME)[:, :7] + NOISE * rng.normal(size=(12, 7))
    pose[3] = np.nan
    flight = fit_flight(body, TIME, pose, NOISE, guess)
    assert flight.x[10:] == pytest.approx(x[10:], abs=0.02)
    pose[:, :4], guess[:4], guess[7:10] = np.nan, [1.0, 0, 0, 0], 0.0
    flight = fit_flight(body, TIME, pose, NOISE, guess)
    assert flight.x[10:] == pytest.approx(x[10:], abs=0.02)


def test_turns_of_a_state():
    rng = np.random.default_rng(3)
    q = rng.normal(size=4)
    q /= np.linalg.norm(q)
    x = np.concatenate([q, np.zeros(9)])
    for i in range(3):
        assert turn(moved(x, i, 0.3)[:4], q) == pytest.approx(0.3 * np.eye(3)[i])
        change = (moved(x, i, 1e-6)[:4] - q) / 1e-6
        assert turned_by(q, np.eye(3)[i]) == pytest.approx(change, abs=1e-6)
