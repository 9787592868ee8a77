"""Equation 11: a change of speed that is smooth in all orders."""

import numpy as np
import pytest
from scipy.integrate import quad

from makebreak.systems.changing_contact.numerics.velocity_profile import (
    speed_transition,
    transition_time,
    unit_step,
    unit_step_integral,
)

TAU = np.linspace(0.0, 1.0, 401)


def paper(tau):
    """S as equation 11 has it, where that does not divide by zero."""
    a, b = np.exp(-1.0 / tau), np.exp(-1.0 / (1.0 - tau))
    return a / (a + b)


def test_step_is_the_papers_function():
    tau = TAU[5:-5]
    ours = [unit_step(x)[0] for x in tau]
    np.testing.assert_allclose(ours, paper(tau), rtol=1e-12)  # Its own rounding.


def test_derivatives_agree_with_finite_differences():
    h = 1e-3

    def difference(f, x):  # Sixth order: error ~ h^6 S^(7) / 140 < 1e-8.
        weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0
        return weights @ [f(x + j * h) for j in range(-3, 4)] / h

    for tau in np.linspace(0.05, 0.95, 19):
        _, slope, bend = unit_step(tau)
        assert slope == pytest.approx(
            difference(lambda x: unit_step(x)[0], tau), abs=1e-7
        )
        assert bend == pytest.approx(
            difference(lambda x: unit_step(x)[1], tau), abs=1e-6
        )


def test_integral_agrees_with_adaptive_quadrature():
    for tau in [*np.linspace(0.0, 1.0, 33), 1e-3, 0.03, 0.4999, 0.5001, 1 - 1e-9]:
        with np.errstate(all="ignore"):
            exact = quad(lambda x: unit_step(x)[0], 0, tau, epsabs=0, epsrel=1e-13)[0]
        assert unit_step_integral(tau) == pytest.approx(exact, abs=1e-12)


def test_mean_is_exactly_one_half_and_the_step_is_symmetric():
    assert unit_step_integral(1.0) == 0.5
    assert unit_step_integral(np.nextafter(1.0, 0.0)) == pytest.approx(0.5, abs=1e-15)
    for tau in TAU:
        assert unit_step(tau)[0] + unit_step(1.0 - tau)[0] == pytest.approx(
            1, abs=1e-15
        )


def test_speed_is_monotone_and_its_slope_and_curvature_are_bounded():
    S, slope, bend = np.array([unit_step(x) for x in TAU]).T
    assert np.all(np.diff(S) >= 0.0)
    assert slope.max() == unit_step(0.5)[1] == 2.0
    assert abs(bend).max() == pytest.approx(9.84, abs=0.01)


@pytest.mark.parametrize(
    "tau", [-1.0, -0.0, 0.0, 5e-324, 1e-300, 1e-9, 1e-3, 1 - 1e-3, 1 - 1e-16, 1.0, 9.0]
)
def test_ends_neither_overflow_nor_leave_a_derivative(tau):
    with np.errstate(all="raise"):
        S, slope, bend = unit_step(tau)
    assert (S, slope, bend) == (0.0 if tau < 0.5 else 1.0, 0.0, 0.0)


def test_a_transition_keeps_to_its_acceleration_and_covers_the_mean_speed():
    T = transition_time(0.2, 0.03, 0.85)
    assert T == pytest.approx(2 * 0.17 / 0.85)
    distance, v, a, jerk = speed_transition(0.2, 0.03, T, T)
    assert distance == pytest.approx(0.5 * (0.2 + 0.03) * T, abs=1e-16)
    assert (v, a, jerk) == (pytest.approx(0.03), 0.0, 0.0)
    peak = max(abs(speed_transition(0.2, 0.03, T, t)[2]) for t in T * TAU)
    assert peak == pytest.approx(0.85, rel=1e-12)  # Reached at the middle, on the grid.


@pytest.mark.parametrize("bad", [dict(T=0.0), dict(T=np.nan), dict(v1=np.inf)])
def test_a_bad_transition_is_refused(bad):
    with pytest.raises(ValueError, match="expected finite numbers and T > 0"):
        speed_transition(**{**dict(v1=0.0, v2=1.0, T=1.0, t=0.5), **bad})
