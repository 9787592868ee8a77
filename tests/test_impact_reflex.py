"""The reflex at first touch: a mass that meets a spring, and what it must not do."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from makebreak.systems.changing_contact.impact_reflex import (
    ImpactReflex,
    ImpactReflexConfig,
)
from makebreak.systems.changing_contact.numerics.contact_anticipator import (
    unbraked_force,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    IMPACT,
    IMPACTLESS,
    MOVE,
    REGION,
)
from makebreak.systems.changing_contact.numerics.impact_reflex import (
    N_MEMORY,
    ReflexLaw,
    fastest_impact,
    tick,
)

DOWN = np.array([0.0, 0.0, -1.0])
LAW = ReflexLaw(gain=3.0, force_least=0.0, force_max=100.0, fade_sec=0.1, period=1e-3)
REGION_OF_IMPACT = np.array([0.0, REGION, IMPACT, 0.03, 0.1, 0.0])


def peak(
    law,
    mass=7.0,
    stiffness=2e4,
    v=0.03,
    phase=REGION_OF_IMPACT,
    friction=0.0,
    known=0.0,
):
    """Peak force of a mass that falls onto a spring, without gravity, and the speed at
    which it leaves it; the reflex acts a tick late."""
    memory, x, last = np.zeros(N_MEMORY), -0.003, np.zeros(3)
    peak, sub = 0.0, 20
    phase = np.r_[phase[:3], v, phase[4:]]
    for _ in range(400):
        f = stiffness * max(x, 0.0)
        wrench = np.array([0.0, 0.0, f + friction, 0, 0, 0])
        velocity = np.array([0, 0, -v, 0, 0, 0])
        memory, force = tick(law, memory, wrench, velocity, DOWN, phase, known)
        for _ in range(sub):
            a = (last @ DOWN - stiffness * max(x, 0.0)) / mass
            v += a * 1e-3 / sub
            x += v * 1e-3 / sub
            peak = max(peak, stiffness * x)
        last = force
        if x < 0 and v < 0:
            break
    return peak, v


def test_without_a_gain_the_peak_is_that_of_mass_and_spring():
    assert peak(LAW._replace(gain=0.0))[0] == pytest.approx(
        0.03 * np.sqrt(2e4 * 7.0), rel=1e-3
    )


def test_the_peak_falls_to_that_of_a_smaller_mass():
    # F = v sqrt(k m / (1 + g)) at least; the delay and the release of the brake while
    # the tip slows down cost up to a third.
    free, least = peak(LAW._replace(gain=0.0))[0], 1.0 / np.sqrt(1.0 + LAW.gain)
    assert least < peak(LAW)[0] / free < 1.35 * least


def test_the_speed_law_knows_what_the_reflex_takes():
    # A soft spring, so that the delay does not matter. The brake lets go below half of
    # the speed, which the law leaves out: it takes up to 0.2 less than the law says.
    for least in (0.0, 2.0):
        law = LAW._replace(gain=4.0, force_least=least)
        for v in (0.04, 0.08, 0.12):
            F = peak(law, stiffness=3e3, v=v)[0]
            free = v * np.sqrt(3e3 * 7.0)
            assert 1.0 < unbraked_force(F, 4.0, least) / free < 1.25
    assert unbraked_force(5.0) == 5.0
    np.testing.assert_allclose(unbraked_force([1.0, 2.0, 5.0], 4.0, 2.0)[:2], [1, 2])
    np.testing.assert_allclose(unbraked_force(5.0, 4.0, 2.0), np.sqrt(25 + 4 * 9))


def test_a_known_contact_is_braked_only_beyond_its_force():
    law = LAW._replace(force_known=8.0)
    # 0.02 m/s into 2e4 N/m with 7 kg: 7.5 N.
    known, unknown = (peak(law, v=0.02, known=k)[0] for k in (1.0, 0.0))
    assert known == pytest.approx(0.02 * np.sqrt(2e4 * 7.0), rel=1e-3)
    assert unknown == peak(LAW, v=0.02)[0] < 0.8 * known
    free = 0.06 * np.sqrt(2e4 * 7.0)  # 22 N
    assert peak(LAW, v=0.06)[0] < peak(law, v=0.06, known=1.0)[0] < 0.8 * free
    # Without a force of its own a known contact is as any other.
    assert peak(LAW, v=0.02, known=1.0) == peak(LAW, v=0.02)


def test_it_does_not_throw_the_arm_back():
    # The spring gives back what it took; the brake may take, but not give.
    assert -peak(LAW)[1] < 0.03 * 1.02


def test_friction_that_was_there_before_is_no_touch():
    with_friction = peak(LAW, friction=5.0)[0]
    assert with_friction == pytest.approx(peak(LAW)[0], rel=0.02)


@pytest.mark.parametrize("stage, kind", [(MOVE, IMPACT), (REGION, IMPACTLESS)])
def test_away_from_an_expected_impact_it_does_nothing(stage, kind):
    phase = np.array([0.0, stage, kind, 0.03, 0.1, 0.0])
    assert peak(LAW, phase=phase) == peak(LAW._replace(gain=0.0))


def test_it_fades_after_the_impact():
    phase, memory = REGION_OF_IMPACT.copy(), np.zeros(N_MEMORY)
    velocity = np.array([0, 0, -0.03, 0, 0, 0])
    memory, _ = tick(LAW, memory, np.zeros(6), velocity, DOWN, phase)
    phase[1], pressed = MOVE, np.array([0, 0, 5.0, 0, 0, 0])
    sizes = []
    for _ in range(150):  # The motion turns; the reflex stays along the impact.
        memory, force = tick(LAW, memory, pressed, velocity, -DOWN[[2, 1, 0]], phase)
        sizes.append(np.linalg.norm(force))
    assert sizes[0] == pytest.approx(15.0, rel=0.02) and sizes[99:] == [0.0] * 51
    assert np.all(np.diff(sizes) <= 0.0)


@pytest.mark.parametrize("which", ["wrench", "velocity", "direction"])
def test_nan_gives_no_reflex(which):
    values = dict(wrench=np.ones(6), velocity=-np.ones(6), direction=DOWN.copy())
    values[which][:] = np.nan
    memory, force = tick(LAW, np.zeros(N_MEMORY), **values, phase=REGION_OF_IMPACT)
    assert np.all(np.isfinite(memory)) and not force.any()


@pytest.mark.parametrize(
    "name", ["gain", "force_least", "force_known", "force_max", "fade_sec"]
)
def test_bad_numbers_are_refused_by_name(name):
    with pytest.raises(ValueError, match=f"{name} is -1.0"):
        ImpactReflex(ImpactReflexConfig(**{name: -1.0}))


@pytest.mark.parametrize("stiffness", [5e3, 2e5])
@pytest.mark.parametrize("rate", [0.0, 2e3, 5e4])
def test_the_fastest_impact_has_just_the_force_that_is_allowed(stiffness, rate):
    mass, delay, force = 5.0, 0.002, 8.0
    v = fastest_impact(force, stiffness, mass, delay, rate)

    def slope(t, x):
        brake = rate * max(t - delay, 0.0)
        return [x[1], -(stiffness * x[0] + brake) / mass]

    half = np.pi * np.sqrt(mass / stiffness)
    path = solve_ivp(slope, (0.0, half), [0.0, v], rtol=1e-9, atol=1e-14, max_step=1e-4)
    # The peak between samples of solve_ivp is missed by less than 1e-4 of it.
    assert stiffness * path.y[0].max() == pytest.approx(force, rel=1e-3)
    unbraked = force / np.sqrt(stiffness * mass)
    assert v >= unbraked * (1.0 - 1e-9) and (rate > 0.0 or v < unbraked * 1.001)


def test_a_blow_that_is_over_before_the_arm_can_answer_is_not_braked():
    # A quarter period of 1.6 ms is shorter than the delay.
    v = fastest_impact(8.0, 5e6, 5.0, 0.002, 1e6)
    assert v == pytest.approx(8.0 / np.sqrt(5e6 * 5.0), rel=1e-9)
