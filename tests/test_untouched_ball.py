"""Whether an untouched ball waits: slope and rolling resistance from its velocity."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from makebreak.systems.contact_mpc.numerics.ball_state import P_BALL, pack
from makebreak.systems.contact_mpc.numerics.rolling_task import ROLL
from makebreak.systems.contact_mpc.numerics.untouched_ball import (
    CLEAR_SEC,
    COAST_MAX,
    LEAVE_SEC,
    WINDOW_SEC,
    WINDOWS_LEAST,
    UntouchedBall,
    downhill,
    slope_and_resistance,
    waits,
    watched,
)
from makebreak.systems.contact_mpc.rolling_task import UPHILL, RollingTask
from makebreak.systems.contact_mpc.rolling_task import RollingTaskConfig as Config

DT = 0.0125
# A rolling sphere on 0.5 deg, and of a resistance of 0.005: 5/7 of g times these.
SLOPE = 5.0 / 7.0 * 9.81 * np.sin(np.deg2rad(0.5))
RESISTANCE = 5.0 / 7.0 * 9.81 * 0.005
R_BALL, R_TIP = 0.0365, 0.0195


def rolled(slope, resistance, pushes=12, noise=0.002, kick=0.0, seed=0):
    """After pushes of 1 s in all directions, 0.75 s between them; a kick [m/s] is felt
    40 ms before each push is known."""
    rng, ball, t = np.random.default_rng(seed), UntouchedBall(), 0.0
    for k in range(pushes):
        heading = np.array([np.cos(k), np.sin(k)])
        for _ in range(80):
            t += DT
            ball = watched(ball, t, 0.04 * heading, True, True)
        v = 0.045 * heading
        for i in range(60):
            t += DT
            speed = np.linalg.norm(v)
            v = v + DT * (slope - resistance * v / max(speed, 1e-3))
            touched = kick * heading * (i >= 57)
            measured = v + touched + noise * rng.normal(size=2)
            ball = watched(ball, t, measured, False, True)
    return ball


@pytest.mark.parametrize("seed", range(5))
def test_a_slope_of_half_a_degree_is_told_from_the_rolling_resistance(seed):
    true = SLOPE * np.array([np.cos(seed), np.sin(seed)])
    ball = rolled(true, RESISTANCE, seed=seed)
    slope, resistance = slope_and_resistance(ball)
    # A window has 0.002 sqrt(2)/0.15 = 0.019 m/s2 of noise, and there are 36: 3 mm/s2
    # in each unknown, some of the resistance being taken for the slope.
    np.testing.assert_allclose(slope, true, atol=0.015)
    assert resistance == pytest.approx(RESISTANCE, abs=0.015)
    np.testing.assert_allclose(downhill(ball), slope)
    level = rolled(np.zeros(2), RESISTANCE, seed=seed)
    np.testing.assert_array_equal(downhill(level), 0.0)


def test_a_table_that_is_level_within_the_noise_is_no_slope_without_resistance_either():
    ball = rolled(np.array([0.01, 0.0]), 0.0)
    slope, resistance = slope_and_resistance(ball)
    assert np.linalg.norm(slope) > resistance
    np.testing.assert_array_equal(downhill(ball), 0.0)


def test_nothing_is_said_at_first_and_a_touch_is_no_slope():
    true = np.array([SLOPE, 0.0])
    np.testing.assert_array_equal(downhill(rolled(true, RESISTANCE, pushes=2)), 0.0)
    ball = rolled(true, RESISTANCE, kick=0.02)
    np.testing.assert_allclose(slope_and_resistance(ball)[0], true, atol=0.015)


def test_a_ball_waits_only_where_that_is_known():
    assert not waits(UntouchedBall())
    # It lies still for a second before anything touches it; on a slope it does not.
    for slope, expected in ((0.0, True), (SLOPE - RESISTANCE, False)):
        ball = UntouchedBall()
        for t in DT * np.arange(80):
            ball = watched(ball, t, [slope * t, 0.0], False, True)
            assert not (waits(ball) and t < 0.8)  # Four windows of 0.2 s.
        assert waits(ball) == expected
    # Then what is known of slope and resistance decides.
    level, steep = np.zeros(2), np.array([SLOPE, 0.0])
    assert waits(rolled(level, RESISTANCE)) and not waits(rolled(steep, RESISTANCE))
    # Felt: the ball would wait; but 0.061 of 0.075 m/s2 is too near to rely on it.
    assert not waits(rolled(steep, SLOPE + 0.014))
    assert waits(rolled(steep, 3.0 * SLOPE))


def test_a_slope_is_believed_from_the_least_number_of_windows_on():
    ball, ends = UntouchedBall(), []
    for t in DT * np.arange(240):  # One long coast down the slope.
        before, v = ball, np.array([0.2 + SLOPE * t, 0.0])
        ball = watched(ball, t, v, t == 0.0, True)
        if ball.moment is not before.moment:
            ends.append(t)
        assert bool(downhill(ball).any()) == (len(ends) >= WINDOWS_LEAST)
    assert len(ends) > WINDOWS_LEAST
    np.testing.assert_allclose(np.diff(ends), WINDOW_SEC + CLEAR_SEC, atol=1e-9)


def test_the_time_of_a_coast_is_that_between_pushes_but_for_long_ones():
    ball = rolled(np.zeros(2), RESISTANCE, pushes=3)
    ball = watched(ball, 5.25, np.zeros(2), True, True)
    assert ball.coast_sec == pytest.approx(0.75, abs=2.0 * DT)
    t = 5.25
    while t < 5.25 + COAST_MAX + 0.5:
        t += DT
        ball = watched(ball, t, np.zeros(2), False, True)
    ball = watched(ball, t + DT, np.zeros(2), True, True)
    assert ball.coast_sec == pytest.approx(0.75, abs=2.0 * DT)


def test_a_ball_that_is_not_seen_or_just_pushed_tells_nothing():
    ball = watched(UntouchedBall(), 0.0, [0.04, 0.0], True, True)
    for k in range(1, 400):
        t = k * DT
        v = [0.04 + 0.1 * t, 0.0]
        ball = watched(ball, t, v, False, t > LEAVE_SEC and k % 10 > 0)
    assert ball.windows == 0


@pytest.mark.parametrize("slope", [0.0, SLOPE])
def test_a_ball_that_rolls_away_is_aimed_uphill_of_the_path(slope):
    system = RollingTask(Config(), 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    known = rolled(np.array([0.0, slope]), RESISTANCE, noise=0.0)
    known = watched(known, 21.0, np.zeros(2), True, True)
    context.SetAbstractState(int(system._ball), known)
    ball = [0.5, 0.1, R_BALL]
    x = pack([0.5, 0.0, 0.15], np.zeros(3), ball, np.zeros(3), R_BALL)
    for name, value in (("x", x), ("valid", [1.0]), ("r_comp", np.zeros(8))):
        system.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(DT)
    assert system.GetOutputPort("phase").Eval(context)[0] != ROLL
    told = system.GetOutputPort("downhill").Eval(context)
    np.testing.assert_allclose(told, [0.0, slope], atol=0.006)
    target = system.GetOutputPort("x_desired").Eval(context).reshape(6, -1)[0, P_BALL]
    lead = np.pi / 2 + np.deg2rad(Config().circle.lead_deg)
    on_path = np.array([0.5, 0.0]) + 0.1 * np.array([np.cos(lead), np.sin(lead)])
    aside = UPHILL * known.coast_sec**2 * told[1]
    assert aside == pytest.approx(0.0086 if slope else 0.0, abs=0.001)
    # The ball is at the same angle about the centre that is moved by `aside`.
    np.testing.assert_allclose(target[:2], on_path - [0.0, aside], atol=2e-4)
