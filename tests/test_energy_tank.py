"""The tank on its own; the loop's energy is counted by the exact motion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from makebreak.systems.arm.numerics.energy_tank import (
    LEVEL,
    N_TANK,
    fill,
    paid_stiffness,
)

TICK = 1e-3
CAPACITY = 0.05


class Tip:
    """A mass at a spring and damper that act as a force held for each tick, so that
    its motion within a tick is a parabola and all work is exact."""

    def __init__(self, mass, x, damping, capacity=CAPACITY):
        self.mass, self.damping, self.capacity = mass, damping, capacity
        self.x, self.v, self.tank = np.array(x), np.zeros(len(x)), np.zeros(N_TANK)
        self.from_outside = 0.0  # [J]

    def tick(self, wanted, pushed=0.0):
        """Args: wanted (n,): stiffness; pushed (n,): force from outside [N]."""
        K = np.zeros(6)
        K[: self.x.size] = wanted
        D = np.zeros(6)
        n = self.x.size
        K = paid_stiffness(self.tank, K, -self.x, self.capacity)
        D[:n] = self.damping(K[:n])
        fill(self.tank, D, -self.v, 0.5 * TICK, TICK, self.capacity)
        a = (-K[:n] * self.x - D[:n] * self.v + pushed) / self.mass
        moved = self.v * TICK + 0.5 * a * TICK**2
        self.from_outside += np.sum(pushed * moved)
        self.x, self.v = self.x + moved, self.v + a * TICK

    def energy(self):
        """Of mass and spring [J]."""
        K = self.tank[: self.x.size]
        return 0.5 * self.mass * self.v @ self.v + 0.5 * np.sum(K * self.x**2)


def paper(K):
    return np.sqrt(K) / 4.0


def ratio(zeta, mass):
    return lambda K: 2.0 * zeta * np.sqrt(K * mass)


def worst(tip):
    """Soft while the tip leaves, stiff while it returns."""
    return np.where(tip.x * tip.v < 0.0, 1000.0, 200.0)


@given(
    seed=st.integers(0, 2**32 - 1),
    mass=st.floats(0.5, 20.0),
    zeta=st.floats(0.02, 1.2),
    axes=st.integers(1, 3),
    profile=st.sampled_from(["random", "worst", "periodic", "always new"]),
    push=st.floats(0.0, 20.0),
)
def test_energy_never_grows_by_more_than_the_tank_and_the_work_from_outside(
    seed, mass, zeta, axes, profile, push
):
    rng = np.random.default_rng(seed)
    tip = Tip(mass, 0.03 * rng.normal(size=axes), ratio(zeta, mass))
    # zeta >= h/4 sqrt(K/M) = 0.016 for 2000 N/m and 0.5 kg: D is at least K h/2, below
    # which a sampled spring alone swings up.
    wanted = rng.uniform(50.0, 2000.0, axes)
    tip.tick(wanted)
    start, tip.from_outside = tip.energy(), 0.0
    every, force = int(rng.integers(1, 400)), np.zeros(axes)
    for k in range(1000):
        if profile == "worst":
            wanted = worst(tip)
        elif profile == "periodic":
            wanted = np.full(axes, 1500.0 if (k // every) % 2 else 100.0)
        elif profile == "always new" or k % every == 0:
            wanted = rng.uniform(0.0, 2000.0, axes)
        if k % 100 == 0:
            force = push * rng.normal(size=axes)
        tip.tick(wanted, force)
        allowed = start + CAPACITY + tip.from_outside
        # Held for a tick, D de comes half a tick late: D h/2M of the spring's energy
        # comes and goes within a swing.
        D = ratio(zeta, mass)(tip.tank[:axes].max())
        late = D * TICK / (2.0 * mass) * tip.energy()
        assert tip.energy() + tip.tank[LEVEL] <= allowed + late + 1e-12
        assert 0.0 <= tip.tank[LEVEL] <= CAPACITY


@pytest.mark.parametrize("mass", [1.8, 6.0])
def test_swings_that_grew_to_a_metre_die_out(mass):
    """Stiff while returning, soft while leaving, with the paper's damping."""
    tip, free = (Tip(mass, [0.01], paper, capacity) for capacity in (CAPACITY, np.inf))
    largest = {}
    for name, one in (("tank", tip), ("none", free)):
        one.tick([200.0])
        swings = []
        for _ in range(4000):
            one.tick(worst(one))
            swings.append(abs(one.x[0]))
        largest[name] = max(swings), max(swings[-1000:])
    assert largest["none"][0] > 0.5
    # All of the tank in the softest spring: sqrt(2 (0.01 + 0.05) J / 200 N/m).
    assert largest["tank"][0] < np.sqrt(2.0 * (0.01 + CAPACITY) / 200.0)
    # What is left is the swing of the constant spring: e^(-D t/2m), at least 3 s.
    assert largest["tank"][1] < 0.03 * np.exp(-3.5 / 2.0 * 2.0 / mass) + 1e-3


def test_what_a_fall_gives_back_pays_for_the_next_rise():
    tank = np.zeros(N_TANK)
    error = np.array([0.01, 0.0, 0.0])
    soft, stiff = np.full(6, 200.0), np.full(6, 1000.0)
    paid_stiffness(tank, soft, error, CAPACITY)
    for _ in range(100):  # 0.04 J each time, of the 0.05 J.
        np.testing.assert_array_equal(
            paid_stiffness(tank, stiff, error, CAPACITY), stiff
        )
        np.testing.assert_allclose(tank[LEVEL], 0.01, rtol=1e-9)
        paid_stiffness(tank, soft, error, CAPACITY)
        np.testing.assert_allclose(tank[LEVEL], CAPACITY, rtol=1e-9)


def test_a_rise_that_cannot_be_paid_is_made_as_far_as_it_can_and_goes_on_when_paid():
    tank = np.zeros(N_TANK)
    error = np.array([0.02, 0.0, 0.0])
    soft, stiff = np.full(6, 200.0), np.full(6, 1000.0)
    paid_stiffness(tank, soft, error, CAPACITY)
    K = paid_stiffness(tank, stiff, error, CAPACITY)
    # 1/2 dK (20 mm)^2 = 0.05 J.
    np.testing.assert_allclose(K[0], 200.0 + 250.0)
    assert tank[LEVEL] == 0.0
    fill(tank, np.full(6, 50.0), np.array([0.2, 0.0, 0.0]), 0.0, 0.01, CAPACITY)
    K = paid_stiffness(tank, stiff, error, CAPACITY)
    # Half of 50 x 0.04 W for 10 ms.
    np.testing.assert_allclose(0.5 * (K[0] - 450.0) * error[0] ** 2, 0.01, rtol=1e-9)


def test_at_its_reference_the_tip_may_become_stiff_for_nothing():
    tank = np.zeros(N_TANK)
    zero = np.zeros(3)
    paid_stiffness(tank, np.full(6, 1.0), zero, 0.0)
    K = paid_stiffness(tank, np.full(6, 1e6), zero, 0.0)
    np.testing.assert_array_equal(K, 1e6)


def test_without_a_bound_the_stiffness_is_the_one_asked_for():
    rng = np.random.default_rng(0)
    tank = np.zeros(N_TANK)
    for _ in range(100):
        wanted = rng.uniform(0.0, 1e4, 6)
        used = paid_stiffness(tank, wanted, rng.normal(size=6), np.inf)
        np.testing.assert_array_equal(used, wanted)
        fill(tank, wanted, rng.normal(size=6), 1e-3, TICK, np.inf)
