"""Scores of impacts: against the closed form of a mass that meets a spring."""

import numpy as np
import pytest

from makebreak.systems.changing_contact.numerics.impact_score import impact, low_pass

DT, T_HIT = 0.001, 0.5
D = np.array([0.6, 0.0, -0.8])


def mass_meets_spring(m=8.0, k=2e4, v=0.02, friction=3.0):
    """force, velocity (n, 3): half a sine from T_HIT on, over steady friction."""
    time = np.arange(0.0, 1.0, DT)
    w = np.sqrt(k / m)
    phase = np.clip(w * (time - T_HIT), 0.0, np.pi)
    along = friction + v * np.sqrt(k * m) * np.sin(phase)
    return time, -np.outer(along, D), np.outer(v * np.cos(phase), D)


def test_peak_of_an_impact_is_v_sqrt_km_whatever_the_friction():
    # The quarter period is 31 ms: 100 Hz of second order changes it by less than 1 %.
    expected = 0.02 * np.sqrt(2e4 * 8.0)
    for friction in (0.0, 3.0):
        time, force, velocity = mass_meets_spring(friction=friction)
        score = impact(time, force, velocity, D, T_HIT)
        assert score.peak == pytest.approx(expected, rel=0.01)
        # The largest sample misses the top by half a step at most: 1 - cos(w dt/2).
        assert score.peak_raw == pytest.approx(expected, rel=1e-3)
        assert T_HIT + 0.025 < score.time < T_HIT + 0.04
        assert score.a_raw == pytest.approx(expected / 8.0, rel=0.01)  # F = m a.
        assert score.a10 < score.a_raw


def test_low_pass_halves_the_power_at_its_cutoff_and_starts_at_rest():
    time = np.arange(0.0, 5.0, DT)
    for cutoff in (10.0, 100.0):
        wave = low_pass(np.sin(2 * np.pi * cutoff * time), cutoff, DT)[2000:]
        # The bilinear transform is exact at the cutoff itself.
        assert np.sqrt(2.0 * np.mean(wave**2)) == pytest.approx(np.sqrt(0.5), rel=1e-3)
    np.testing.assert_allclose(low_pass(np.full(50, 7.0), 10.0, DT), 7.0, rtol=1e-12)


def test_each_column_is_filtered_by_itself():
    signal = np.random.default_rng(0).normal(size=(200, 3))
    whole = low_pass(signal, 30.0, DT)
    for j in range(3):
        np.testing.assert_array_equal(whole[:, j], low_pass(signal[:, j], 30.0, DT))


def test_a_contact_outside_the_log_and_a_cutoff_above_nyquist_are_refused():
    time, force, velocity = mass_meets_spring()
    for wrong in (0.03, 1.5):
        with pytest.raises(ValueError, match="contact_time is"):
            impact(time, force, velocity, D, wrong)
    with pytest.raises(ValueError, match="cutoff is 600"):
        low_pass(np.zeros(10), 600.0, DT)
