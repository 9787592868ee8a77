import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from scipy.interpolate import BPoly

from makebreak.systems.contact_mpc.numerics.ball_state import (
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    W_BALL,
    pack,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    APPROACH,
    REPOSITION,
    ROLL,
    WAIT,
    CirclePath,
    RollConfig,
    RollingConfig,
    TaskState,
    landing,
    next_state,
    quintic,
    shifted,
    surface_height,
    target_over_horizon,
)
from makebreak.systems.contact_mpc.numerics.untouched_ball import UntouchedBall
from makebreak.systems.contact_mpc.rolling_task import RollingTask, RollingTaskConfig

PATH = CirclePath(np.array([0.5, 0.0]), 0.1)
R_BALL, R_TIP, DT = 0.0315, 0.0195, 0.0125


def test_quintic_is_the_hermite_polynomial_of_its_ends():
    rng = np.random.default_rng(0)
    T, ends = 0.7, rng.normal(size=(2, 3))
    expected = BPoly.from_derivatives([0.0, T], ends)
    for t in np.linspace(0.0, T, 9):
        values = [expected(t), expected.derivative(1)(t), expected.derivative(2)(t)]
        # Degree 5 in t/T with coefficients of order 100: 1e-11 is round-off.
        np.testing.assert_allclose(quintic(t, T, *ends), values, atol=1e-11)


def test_tip_at_surface_height_touches_the_ball():
    for offset in (0.0, 0.01, 0.018, 0.03):
        z = surface_height(offset, R_BALL, R_TIP)
        distance = np.hypot(offset, z - R_BALL) - R_BALL - R_TIP
        np.testing.assert_allclose(distance, 0.0, atol=1e-15)


def test_estimated_ball_rolls_without_slip():
    v = np.array([0.03, -0.05, 0.0])
    x = pack(np.zeros(3), np.zeros(3), [0.5, 0.1, R_BALL], v, R_BALL)
    slip = v + np.cross(x[W_BALL], [0.0, 0.0, -R_BALL])  # Where it touches the table.
    np.testing.assert_allclose(slip, 0.0, atol=1e-17)


def run_task(state, t_end, ball, v_ball, valid=lambda t: True, gap=0.0):
    """The tip follows the reference exactly; the ball coasts. Returns the history."""
    config, history = RollingConfig(), []
    n = round(t_end / DT)
    for k in range(n):
        t = k * DT
        p_ball = np.array([*(ball + v_ball * t), R_BALL])
        x = pack(state.p, state.v, p_ball, [*v_ball, 0.0], R_BALL)
        state = next_state(
            config, PATH, state, t, DT, x, gap, valid(t), R_BALL, R_TIP
        )  # fmt: skip
        history.append((t + DT, state, p_ball))
    return config, history


@pytest.mark.parametrize("v_ball", [(0.0, 0.0), (0.03, 0.05)])
def test_reposition_passes_over_the_ball_and_lands_behind_a_rolling_one(v_ball):
    ball, v_ball = np.array([0.6, 0.0]), np.array(v_ball)
    tip = [*(ball + [0.0, 0.015]), surface_height(0.015, R_BALL, R_TIP)]
    v_tip = [*(2.0 * v_ball), 0.0]  # On top of a rolling ball.
    start = TaskState(ROLL, -10.0, tip, v_tip, np.zeros(3))
    config, history = run_task(start, RollingConfig().reposition.sec, ball, v_ball)
    for t, state, _ in history[:-1]:
        assert state.phase == REPOSITION
        p_ball = np.array([*(ball + v_ball * t), R_BALL])
        assert np.linalg.norm(state.p - p_ball) > R_BALL + R_TIP - 1e-9
    t, state, _ = history[-1]
    p_ball = ball + v_ball * t
    behind = p_ball - PATH.heading(p_ball) * config.land.behind
    # The landing point turns with the path while the ball rolls the last 12.5 ms.
    np.testing.assert_allclose(state.p[:2], behind, atol=2e-4)
    z = surface_height(config.land.behind, R_BALL, R_TIP) + config.land.above
    np.testing.assert_allclose(state.p[2], z, atol=1e-9)


def test_reference_of_the_reposition_is_smooth():
    ball = np.array([0.6, 0.0])
    tip = [0.55, 0.05, 0.15]
    start = TaskState(ROLL, -10.0, tip, np.zeros(3), np.zeros(3))
    _, history = run_task(start, 0.7, ball, np.zeros(2))
    p = np.array([state.p for _, state, _ in history])
    v = np.array([state.v for _, state, _ in history])
    # Velocity is the slope of the position: trapezoids are good to dt^2 jerk / 12,
    # and a quintic over 0.1 m in 0.25 s has a jerk below 60 * 0.1 / 0.25^3 = 384 m/s3.
    np.testing.assert_allclose(
        np.diff(p, axis=0), DT * (v[1:] + v[:-1]) / 2, atol=DT**3 * 384 / 12
    )


def test_learned_gap_lowers_the_landing_by_as_much():
    ball = np.array([0.6, 0.0])
    start = TaskState(ROLL, -10.0, [0.6, 0.0, 0.1], np.zeros(3), np.zeros(3))
    low, high = (
        run_task(start, 0.7, ball, np.zeros(2), gap=g)[1][-1][1].p[2]
        for g in (0.01, 0.0)
    )
    np.testing.assert_allclose(high - low, 0.01, atol=1e-12)


def test_a_ball_that_is_not_seen_stops_the_push_and_lifts_the_tip():
    ball = np.array([0.6, 0.0])
    start = TaskState(ROLL, 0.0, [0.6, 0.0, 0.08], np.zeros(3), np.zeros(3))
    _, history = run_task(
        start, 5.5, ball, np.zeros(2), valid=lambda t: not 0.2 < t < 5.0
    )
    phases = {round(t, 4): state.phase for t, state, _ in history}
    # 20 mm at 6 mm/s.
    assert phases[0.5] == ROLL and phases[3.5] != WAIT
    assert phases[3.6] == WAIT and phases[5.1] == REPOSITION
    z = [state.p[2] for t, state, _ in history if t > 4.3 and state.phase == WAIT]
    np.testing.assert_allclose(z, 2 * R_BALL + R_TIP + 0.03, atol=1e-12)


def phases_after_a_sight(v_ball, seen_sec, t_end=5.0):
    """How long a push goes on whose ball, seen at velocity v_ball, is then hidden."""
    start = TaskState(ROLL, 0.0, [0.6, 0.0, 0.08], np.zeros(3), np.zeros(3))
    state, config = start, RollingConfig(roll=RollConfig(sec=9.0))
    for k in range(round(t_end / DT)):
        x = pack([0.6, 0, 0.08], np.zeros(3), [0.6, 0, R_BALL], [*v_ball, 0], R_BALL)
        state = next_state(config, PATH, state, k * DT, DT, x, 0.0,
                           k * DT < seen_sec, R_BALL, R_TIP)  # fmt: skip
        if state.phase == WAIT:
            return k * DT - seen_sec
    return np.inf


@pytest.mark.parametrize(
    "speed, patience", [(0.0, 3.33), (0.006, 3.33), (0.05, 0.4), (0.3, 0.067)]
)
def test_a_hidden_ball_is_waited_for_once_it_may_have_gone_20_mm(speed, patience):
    found = phases_after_a_sight([speed, 0.0], seen_sec=1.5)
    assert abs(found - patience) <= 2 * DT  # The tick of either end.


def test_a_glimpse_tells_no_speed():
    """A tracker that has just found a ball has a velocity of noise: 0.3 m/s here."""
    assert phases_after_a_sight([0.3, 0.0], seen_sec=0.08) > 3.0


def test_a_tip_that_hides_the_ball_withdraws_until_it_is_seen():
    """The arm hides all that is less than 30 mm from the tip, seen from above."""
    ball, goal = np.array([0.6, 0.0, R_BALL]), np.array([0.3, 0.0])
    config = RollingConfig()
    state = TaskState(WAIT, 0.0, [0.605, 0.0, 0.083], np.zeros(3), np.zeros(3), 0.083)
    seen_at, p, v = None, [state.p], [state.v]
    for k in range(200):
        t = k * DT
        valid = bool(np.hypot(*(state.p - ball)[:2]) > 0.03)
        x = pack(state.p, state.v, ball, np.zeros(3), R_BALL)
        state = next_state(config, PATH, state, t, DT, x, 0.0, valid, R_BALL, R_TIP,
                           withdrawn=goal)  # fmt: skip
        p.append(state.p)
        v.append(state.v)
        if valid:
            seen_at = t
            break
    assert seen_at is not None and state.phase == REPOSITION
    p, v = np.array(p), np.array(v)
    # Not before it is above the ball, and no faster than it may.
    moved = abs(p[:, 0] - p[0, 0]) > 1e-9
    assert p[moved][0, 2] > 2 * R_BALL + R_TIP
    assert np.hypot(v[:, 0], v[:, 1]).max() <= config.unseen.withdraw_speed + 1e-12
    assert abs(np.diff(v[:, :2], axis=0)).max() <= 1.0 * DT + 1e-12
    # Without a place to go to it would stay, and wait for ever.
    stays = TaskState(WAIT, 0.0, [0.605, 0.0, 0.12], np.zeros(3), np.zeros(3), 0.12)
    for k in range(200):
        stays = next_state(config, PATH, stays, k * DT, DT, x, 0.0, False, R_BALL,
                           R_TIP)  # fmt: skip
    np.testing.assert_array_equal(stays.p[:2], [0.605, 0.0])


def test_the_task_withdraws_to_where_its_config_says():
    config = RollingTaskConfig(withdrawn=[0.45, 0.05])
    system = RollingTask(config, 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05, p_tip=(0.5, 0, 0.2))
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in (
        ("x", np.eye(19)[3]), ("valid", [0.0]), ("r_comp", np.zeros(8)),
    ):  # fmt: skip
        system.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(2.0)
    p = system.GetOutputPort("reference").Eval(context)[:2]
    np.testing.assert_allclose(p, [0.45, 0.05], atol=1e-3)
    with pytest.raises(ValueError, match="task.withdrawn is .*, expected 2 numbers"):
        bad = RollingTaskConfig(withdrawn=[0.3])
        RollingTask(bad, 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)


def test_a_withdrawn_tip_comes_to_rest_at_its_place():
    goal = np.array([0.3, 0.0])
    state = TaskState(WAIT, 0.0, [0.6, 0.1, 0.2], np.zeros(3), np.zeros(3), 0.2)
    x = pack(state.p, state.v, [0.6, 0, R_BALL], np.zeros(3), R_BALL)
    for k in range(320):
        state = next_state(RollingConfig(), PATH, state, k * DT, DT, x, 0.0, False,
                           R_BALL, R_TIP, withdrawn=goal)  # fmt: skip
    # Braking at half of what it may, in ticks of 12.5 ms.
    np.testing.assert_allclose(state.p[:2], goal, atol=1e-3)
    assert np.hypot(*state.v[:2]) < 0.02


def test_a_long_reposition_takes_longer_and_is_no_faster():
    config, fastest = RollingConfig(), []
    for far in (1.0, 2.0):
        ball = np.array([0.6, 0.0])
        tip = [0.6, config.reposition.far * far - config.land.behind, 0.2]
        start = TaskState(ROLL, -10.0, tip, np.zeros(3), np.zeros(3))
        T = config.reposition.sec * far
        _, history = run_task(start, T + 2 * DT, ball, np.zeros(2))
        repositions = [s for _, s, _ in history if s.phase == REPOSITION]
        # The heading, and so the place to land, turns by 1 % of the way.
        assert abs(len(repositions) * DT - T) < 0.02 * T + 2 * DT
        fastest.append(max(np.hypot(*s.v[:2]) for s in repositions))
    assert abs(fastest[1] / fastest[0] - 1.0) < 0.05


@pytest.mark.parametrize(
    "strayed, offset", [(0.0, 0.018), (0.06, 0.018), (0.12, 0.009), (0.18, 0.0036)]
)
def test_the_less_a_ball_coasts_the_nearer_to_its_top_the_tip_lands(strayed, offset):
    x = pack([0.6, 0, 0.1], np.zeros(3), [0.6, 0, R_BALL], np.zeros(3), R_BALL)
    config = RollingConfig()
    p, _ = landing(config, PATH, x, 0.0, 0.1, R_BALL, R_TIP, strayed)
    np.testing.assert_allclose(np.hypot(*(p[:2] - [0.6, 0.0])), offset, rtol=1e-12)
    reach = np.linalg.norm(p - [0.6, 0.0, R_BALL + config.land.above])
    np.testing.assert_allclose(reach, R_BALL + R_TIP, rtol=1e-12)


def test_where_a_ball_that_changes_its_mind_is_landed_on_is_near_its_top():
    """The reposition itself uses what it saw of the ball."""
    for v_late, offset in ((0.0, 0.018), (0.18, 0.0036)):

        def v_ball(t, late=v_late):
            return np.array([0.0, late if t > 0.2 else 0.0])

        _, _, rows = approach(surface=-1.0, gap_std=0.0, v_ball=v_ball)
        last = [s for _, s in rows if s.phase == REPOSITION][-1]
        # The ball is shown at [.6, 0] although it has a velocity, by which it is led.
        behind = [0.6, v_late * DT] - last.p[:2]
        assert abs(np.hypot(*behind) - offset) < 2.5e-3


def test_a_ball_that_is_not_seen_at_the_start_lifts_the_tip_from_where_it_is():
    system = RollingTask(RollingTaskConfig(), 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
    z_tip = 0.15  # The default p_tip.
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in (
        ("x", np.eye(19)[3]),
        ("valid", [0.0]),
        ("r_comp", np.zeros(8)),
    ):
        system.GetInputPort(name).FixValue(context, value)
    for k in range(60):
        simulator.AdvanceTo(k * DT)
        assert system.GetOutputPort("reference").Eval(context)[2] >= z_tip - 1e-12
        assert system.GetOutputPort("phase").Eval(context)[0] == WAIT


@pytest.mark.parametrize(("outside", "waits"), [(0.11, False), (0.13, True)])
def test_a_ball_out_of_reach_is_waited_for(outside, waits):
    system = RollingTask(RollingTaskConfig(), 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ball = [0.5, 0.1 + outside, R_BALL]
    x = pack([0.5, 0.0, 0.15], np.zeros(3), ball, np.zeros(3), R_BALL)
    for name, value in (("x", x), ("valid", [1.0]), ("r_comp", np.zeros(8))):
        system.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(0.3)
    assert (system.GetOutputPort("phase").Eval(context)[0] == WAIT) == waits
    reference = system.GetOutputPort("reference").Eval(context)
    assert (abs(reference[1]) < 1e-9) == waits  # It stays, or goes to the ball.


@pytest.mark.parametrize(
    ("valid", "outside", "phase"),
    [(1.0, 0.0, ROLL), (0.0, 0.0, ROLL), (-1.0, 0.0, WAIT), (0.0, 0.13, WAIT)],
)
def test_only_a_ball_that_is_hidden_is_pushed_on(valid, outside, phase):
    """Not one out of reach, and none beside encoders that fail."""
    system = RollingTask(RollingTaskConfig(), 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ball = np.array([0.5, 0.1 + outside, R_BALL])
    tip = ball + [0.0, 0.0, R_BALL + R_TIP]
    x = pack(tip, np.zeros(3), ball, np.zeros(3), R_BALL)
    for name, value in (("x", x), ("valid", [valid]), ("r_comp", np.zeros(8))):
        system.GetInputPort(name).FixValue(context, value)
    pushes = TaskState(ROLL, 0.0, tip, np.zeros(3), np.zeros(3))
    context.SetAbstractState(0, pushes)
    simulator.AdvanceTo(0.1)
    assert system.GetOutputPort("phase").Eval(context)[0] == phase


@pytest.mark.parametrize(
    ("slope", "windows", "landed", "feels"),
    [
        (0.0, 20, True, False),
        (0.06, 20, True, True),
        (0.06, 20, False, False),
        (0.0, 0, True, True),  # Nothing is known yet.
    ],
)
def test_a_gentle_push_feels_for_a_ball_that_may_roll_away(
    slope, windows, landed, feels
):
    """Untouched windows as on a table that slopes or not; c of 0.035 m/s2."""
    system = RollingTask(RollingTaskConfig(), 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ball = np.array([0.5, 0.1, R_BALL])
    tip = ball + [0.0, 0.0, R_BALL + R_TIP]
    x = pack(tip, np.zeros(3), ball, np.zeros(3), R_BALL)
    for name, value in (("x", x), ("valid", [1.0]), ("r_comp", np.zeros(8))):
        system.GetInputPort(name).FixValue(context, value)
    if landed:
        system.GetInputPort("landed").FixValue(context, [0.0])
    seen = UntouchedBall(
        normal=windows * np.eye(3),
        moment=windows * np.array([slope, 0.0, 0.035]),
        windows=windows,
    )
    pushes = TaskState(ROLL, 0.0, tip, np.zeros(3), np.zeros(3))
    for k, value in enumerate((pushes, seen)):
        context.SetAbstractState(k, value)
    simulator.AdvanceTo(DT / 2)
    assert system.GetOutputPort("phase").Eval(context)[0] == ROLL
    assert (system.GetOutputPort("feel").Eval(context)[0] == 1.0) == feels


def radii_aimed_at(distance, integral_sec, valid=1.0):
    """How far from the center C3's first target of the ball is, tick by tick for 3 s,
    and what it would be without integral action; the ball lies still at `distance`."""
    config = RollingTaskConfig(rolling=RollingConfig(integral_sec=integral_sec))
    system = RollingTask(config, 6, 0.1, R_BALL, R_TIP, 8, 4, residual_dt_sec=0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    ball = [0.5 + distance, 0.0, R_BALL]
    x = pack([0.6, 0.0, 0.2], np.zeros(3), ball, np.zeros(3), R_BALL)
    for name, value in (("x", x), ("valid", [valid]), ("r_comp", np.zeros(8))):
        system.GetInputPort(name).FixValue(context, value)
    found = []
    for k in range(round(3.0 / DT)):
        simulator.AdvanceTo((k + 0.5) * DT)
        goal = system.GetOutputPort("x_desired").Eval(context).reshape(6, 19)[0]
        found.append(np.linalg.norm(goal[P_BALL][:2] - PATH.center))
    return np.array(found)


@pytest.mark.parametrize("error", [0.003, -0.004])
def test_integral_action_aims_at_the_other_side_of_the_path(error):
    radii = radii_aimed_at(0.1 + error, integral_sec=6.0)
    t = DT * np.arange(1, len(radii) + 1)
    # The point 6 degrees on is within reach: it is on the circle that is aimed at.
    np.testing.assert_allclose(radii, 0.1 - error * t / 6.0, atol=1e-12)
    without = radii_aimed_at(0.1 + error, integral_sec=np.inf)
    np.testing.assert_allclose(without, 0.1, atol=1e-15)


def test_integral_action_is_bounded_and_rests_while_the_ball_is_not_seen():
    x = pack([0.6, 0, 0.2], np.zeros(3), [0.9, 0.0, R_BALL], np.zeros(3), R_BALL)
    shift, config = 0.0, RollingConfig(integral_sec=2.0)
    for k in range(400):  # 0.3 m away, which counts as 8 mm.
        assert shift == pytest.approx(-min(0.008 * k * DT / 2.0, 0.008), abs=1e-12)
        shift = shifted(config, PATH, shift, x, DT)
    np.testing.assert_allclose(radii_aimed_at(0.104, 1.0, valid=0.0), 0.1, atol=1e-15)


@pytest.mark.parametrize("gap", [-0.016, 0.0, 0.010])
def test_the_tip_is_pressed_as_far_below_the_top_as_learned_whatever_the_gap(gap):
    config = RollingTaskConfig()
    system = RollingTask(config, 6, 0.1, R_BALL, R_TIP, 8, 4, residual_dt_sec=0.05)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    r_comp = np.array([gap / 0.05] * 4 + [0.3] * 4)  # The table's are no concern.
    for name, value in (("x", np.eye(19)[3]), ("valid", [1.0]), ("r_comp", r_comp)):
        system.GetInputPort(name).FixValue(context, value)
    simulator.AdvanceTo(DT / 2)
    x_desired = system.GetOutputPort("x_desired").Eval(context).reshape(6, 19)
    top = 2.0 * R_BALL - gap  # Of a ball whose surface is that much lower.
    np.testing.assert_allclose(
        x_desired[:, P_TIP.start + 2], top + R_TIP - config.press, atol=1e-12
    )


def test_target_leads_the_ball_and_moves_along_the_circle():
    x = pack([0.6, 0, 0.1], np.zeros(3), [0.6, 0.0, R_BALL], np.zeros(3), R_BALL)
    speed, dt = 0.1 * np.pi / 2, 0.1  # A quarter of the circle each second.
    target = target_over_horizon(PATH, x, 0.1, speed, 0.07, R_BALL, dt, 11)
    assert target.shape == (11, 19)
    c, s = 0.1 * np.cos(0.1), 0.1 * np.sin(0.1)
    np.testing.assert_allclose(target[0, P_BALL], [0.5 + c, s, R_BALL], atol=1e-15)
    np.testing.assert_allclose(target[10, P_BALL], [0.5 - s, c, R_BALL], atol=1e-15)
    v = speed * np.array([-10 * c, -10 * s, 0.0])  # Turned by a quarter from [-s, c].
    np.testing.assert_allclose(target[10, V_BALL], v, atol=1e-15)
    np.testing.assert_allclose(target[:, V_TIP], 2 * target[:, V_BALL], atol=1e-15)
    np.testing.assert_allclose(target[:, P_TIP][:, 2], 0.07)


def test_target_of_a_ball_far_off_the_path_is_within_reach_and_towards_the_path():
    ball = np.array([0.65, 0.0, R_BALL])
    x = pack([0.6, 0, 0.1], np.zeros(3), ball, np.zeros(3), R_BALL)
    way = target_over_horizon(PATH, x, 0.1, 0.0, 0.07, R_BALL, 0.1, 3)[:, P_BALL] - ball
    on_path = np.array([0.5 + 0.1 * np.cos(0.1), 0.1 * np.sin(0.1), R_BALL]) - ball
    expected = 0.015 * on_path / np.linalg.norm(on_path)
    np.testing.assert_allclose(way, [expected] * 3, atol=1e-15)


def phase_after_a_push(tip, ball):
    """The phase a tick after a push with the tip and the ball there."""
    x = pack(tip, np.zeros(3), ball, np.zeros(3), R_BALL)
    state = TaskState(ROLL, 0.0, tip, np.zeros(3), np.zeros(3))
    state = next_state(
        RollingConfig(), PATH, state, 0.1, DT, x, 0.0, True, R_BALL, R_TIP
    )  # fmt: skip
    return state.phase


def test_push_is_over_when_the_tip_is_in_front_of_the_ball():
    ball = np.array([0.6, 0.0, R_BALL])
    for ahead, phase in ((0.02, ROLL), (0.03, REPOSITION)):
        tip = ball + [0.0, ahead, 0.04]
        assert phase_after_a_push(tip, ball) == phase


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_push_is_over_when_the_ball_has_rolled_away_sideways(side):
    ball = np.array([0.6, 0.0, R_BALL])
    for off, phase in ((0.02, ROLL), (0.03, REPOSITION)):
        tip = ball + [side * off, 0.0, 0.04]  # Across the path.
        assert phase_after_a_push(tip, ball) == phase


def test_a_tip_behind_the_ball_goes_on_pushing_as_far_as_it_can_touch_it():
    ball = np.array([0.6, 0.0, R_BALL])
    reach = R_BALL + R_TIP
    for behind, phase in ((0.03, ROLL), (reach - 1e-3, ROLL), (0.06, REPOSITION)):
        tip = np.append(ball[:2] - behind * PATH.heading(ball), R_BALL + 0.03)
        assert phase_after_a_push(tip, ball) == phase


def approach(surface, gap_std, T=3.0, v_ball=lambda t: np.zeros(2)):
    """A task that lands on a surface at a height [m] over the modelled landing point,
    felt as 8 N once the reference is 0.2 mm inside it; 3 N are felt in the air."""
    config = RollingConfig()
    ball = np.array([0.6, 0.0])
    state = TaskState(ROLL, -10.0, [0.6, 0.0, 0.1], np.zeros(3), np.zeros(3))
    z_land = surface_height(config.land.behind, R_BALL, R_TIP) + config.land.above
    rows = []
    for k in range(round(T / DT)):
        v = [*v_ball(k * DT), 0.0]
        x = pack([0.6, 0.0, 0.1], np.zeros(3), [*ball, R_BALL], v, R_BALL)
        inside = z_land + surface - state.p[2]
        force = 3.0 + (8.0 if inside > 2e-4 else 0.0)
        state = next_state(config, PATH, state, k * DT, DT, x, 0.0, True, R_BALL, R_TIP,
                           None, gap_std, force)  # fmt: skip
        rows.append((k * DT, state))
        if state.phase == ROLL and k > 5:
            break
    return config, z_land, rows


def test_of_an_uncertain_height_the_last_part_is_slow_and_ends_where_it_touches():
    config, z_land, rows = approach(surface=0.012, gap_std=0.008)
    states = [s for _, s in rows if s.phase == APPROACH]
    # 2.5 deviations of 8 mm above the surface, on which the landing point is 3 mm high.
    np.testing.assert_allclose(states[0].p[2], z_land + 0.017, atol=1e-9)
    # The reposition's plan ends at rest; from there the descent is slow.
    assert max(-s.v[2] for s in states) <= config.approach.speed + 1e-12
    assert rows[-1][1].phase == ROLL
    # Over within one tick of what is felt: at most 0.2 mm and a tick's descent inside.
    end = rows[-1][1].p[2] - (z_land + 0.012)
    assert -2e-4 - 2 * config.approach.speed * DT <= end <= 0.0


def test_a_touch_that_does_not_come_ends_the_approach_at_the_landing_point():
    config, z_land, rows = approach(surface=-0.01, gap_std=0.002)
    assert rows[-1][1].phase == ROLL
    np.testing.assert_allclose(
        rows[-1][1].p[2], z_land, atol=2 * config.approach.speed * DT
    )


def test_what_is_felt_in_the_air_is_no_touch():
    _, _, rows = approach(surface=-1.0, gap_std=0.008)  # 3 N all the way.
    # 17 mm at 35 mm/s.
    assert sum(s.phase == APPROACH for _, s in rows) > 0.48 / DT


@pytest.mark.parametrize("gap_std", [0.0, 0.0011])
def test_without_much_uncertainty_there_is_no_approach(gap_std):
    _, _, rows = approach(surface=-1.0, gap_std=gap_std)
    assert all(s.phase != APPROACH for _, s in rows)


def test_an_approach_ends_at_rest_as_a_landing_without_one_does():
    """A tip that comes down on the ball with some speed kicks it off the path."""
    _, _, rows = approach(surface=-1.0, gap_std=0.008)
    # 0.3 m/s2 from 35 mm/s; over within 0.3 mm, and a tick of 12.5 ms before it.
    assert abs(rows[-1][1].v[2]) <= 0.02


def test_a_surface_of_which_little_is_known_is_felt_for_below_where_it_is_believed():
    """It is 8 mm lower than the landing point's 3 mm over it, one deviation."""
    config, z_land, rows = approach(surface=-0.011, gap_std=0.008)
    assert rows[-1][1].phase == ROLL
    # As above: a tick or two of descent inside.
    inside = z_land - 0.011 - rows[-1][1].p[2]
    assert 0.0 <= inside <= 2e-4 + 2 * config.approach.speed * DT
    # What is not there is not looked for beyond 1.5 deviations.
    _, _, rows = approach(surface=-1.0, gap_std=0.008)
    np.testing.assert_allclose(
        rows[-1][1].p[2], z_land - 0.003 - 0.012, atol=2 * config.approach.speed * DT
    )


@pytest.mark.parametrize("change, felt", [(0.05, False), (0.08, True)])
def test_a_ball_that_does_not_coast_is_felt_for(change, felt):
    """It rocks while the tip is in the air, and lies still when it lands."""

    def rocks(t):
        return np.array([0.0, change if 0.2 < t < 0.3 else 0.0])

    config, _, rows = approach(surface=-1.0, gap_std=0.001, v_ball=rocks)
    # It is landed on nearer to its top.
    more = max(change - config.land.coast_change, 0.0) / 0.06
    offset = config.land.behind / (1.0 + more**2)
    z_land = surface_height(offset, R_BALL, R_TIP) + config.land.above
    lowest = z_land - 0.003 - 0.0015 if felt else z_land
    assert rows[-1][1].phase == ROLL
    assert rows[-1][1].p[2] == pytest.approx(lowest, abs=5e-4)
    # The push that follows feels for the ball, too, and has more time for it.
    state = rows[-1][1]
    assert state.feel == felt
    t = state.since_sec
    x = pack(state.p, np.zeros(3), [0.6, 0.0, R_BALL], np.zeros(3), R_BALL)
    while state.phase == ROLL:
        t += DT
        state = next_state(config, PATH, state, t, DT, x, 0.0, True, R_BALL, R_TIP)
    longest = config.roll.feel_sec if felt else config.roll.sec
    assert t - rows[-1][1].since_sec == pytest.approx(longest, abs=2 * DT)


def test_the_velocity_of_a_glimpse_is_no_straying():
    """A tracker that has just found a ball that lies still has a velocity of noise."""

    def found(t):
        return np.array([0.0, 0.3 if t < 0.08 else 0.0])

    _, z_land, rows = approach(surface=-1.0, gap_std=0.001, v_ball=found)
    assert not rows[-1][1].feel
    assert rows[-1][1].p[2] == pytest.approx(z_land, abs=5e-4)


def test_an_integral_without_a_time_is_refused():
    for seconds in (0.0, -1.0, np.nan):
        config = RollingTaskConfig(rolling=RollingConfig(integral_sec=seconds))
        with pytest.raises(ValueError, match="integral_sec is .*, expected > 0"):
            RollingTask(config, 6, 0.1, R_BALL, R_TIP, 8, 4, 0.05)
