"""How far a smoothed velocity may be off where the true one jumps."""

import numpy as np
import pytest

from makebreak.systems.numerics.smoother import blur_sec, smooth

SLOW = 0.01  # [m/s]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("noise", "every"), [(1e-3, 0.035), (3e-4, 0.01)])
def test_what_just_stopped_is_not_taken_to_slide_and_what_goes_on_is(
    seed, noise, every
):
    """Pushed for 0.4 s at 0.1 m/s, to and fro, seen by a camera; rows of 5 ms."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 6.0, 0.005)
    v = np.zeros(len(t))
    for k in range(6):
        begin = 0.5 + 0.9 * k
        v[(t > begin) & (t < begin + 0.4)] = 0.1 * (-1) ** k
    seen = np.arange(0, len(t), round(every / 0.005))
    y = np.full(len(t), np.nan)
    y[seen] = np.cumsum(v)[seen] * 0.005 + noise * rng.normal(size=len(seen))
    s = smooth(t, y, noise)
    blur = blur_sec(noise, every, s.density)
    assert every < blur < 3.0 * every
    jumps = t[np.abs(np.diff(v, prepend=0.0)) > 0.05]
    away = np.min(np.abs(t[:, None] - jumps), axis=1)
    rests = (v == 0.0) & (away < 2.0 * blur)
    slides = (v != 0.0) & (away > 2.5 * blur)
    speed, off = np.abs(s.x[:, 1]), np.abs(s.x[:, 2]) * blur
    sure = speed >= np.maximum(SLOW, off)
    assert np.mean(speed[rests] >= SLOW) > 0.45  # By its speed alone it would slide.
    assert np.mean(sure[rests]) < 0.6 * np.mean(speed[rests] >= SLOW)
    assert slides.sum() > 100 and sure[slides].all()


def test_blur_scales_as_noise_time_and_density_do():
    assert blur_sec(2e-3, 0.03, 4.0) == pytest.approx(blur_sec(1e-3, 0.03, 1.0))
    assert blur_sec(1e-3, 0.06, 2.0) == pytest.approx(blur_sec(1e-3, 0.03, 1.0))
    assert blur_sec(8e-3, 0.03, 1.0) == pytest.approx(2.0 * blur_sec(1e-3, 0.03, 1.0))
    assert blur_sec(0.0, 0.03, 1.0) == 0.0 and np.isfinite(blur_sec(1e-3, 0.03, 0.0))


def test_an_offset_of_the_samples_is_one_of_the_values_alone():
    t = np.linspace(0.0, 2.0, 60)
    y = 0.3 * np.sin(3.0 * t) + np.random.default_rng(0).normal(0.0, 1e-3, len(t))
    plain, moved = smooth(t, y, 1e-3), smooth(t, y + 50.0, 1e-3)
    np.testing.assert_allclose(moved.x, plain.x + [50.0, 0.0, 0.0], atol=1e-7)
    variance, same = (np.einsum("nii->ni", s.P)[3:] for s in (moved, plain))
    np.testing.assert_allclose(variance, same, rtol=1e-4)
    assert np.sqrt(np.mean((plain.x[:, 0] - 0.3 * np.sin(3.0 * t)) ** 2)) < 1e-3
