"""The residual as a probability: its maths, and what the ball's learner makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from test_residual_learner import PUSH, Script, point_mass

from makebreak.diagrams.ball_rolling_config import (
    LEARN,
    LearnerConfig,
    learner_config,
    paper_learner_config,
)
from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcs,
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.numerics.ball_state import V_TIP, pack
from makebreak.systems.contact_mpc.numerics.lcs import LCS, opening_speed, simulate
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    measured_step,
    violation_loss,
)
from makebreak.systems.contact_mpc.numerics.residual_posterior import (
    losses_on_grid,
    mode_and_std,
    residual_grid,
    updated,
)
from makebreak.systems.contact_mpc.residual_learner import (
    FreeStatesConfig,
    LearnerStatus,
    PosteriorConfig,
    ResidualLearner,
    ResidualLearnerConfig,
    WalkConfig,
)

GRID = residual_grid(r_max=0.7, spacing=0.01, prior_std=0.16, drift_std=0.01)


def test_the_prior_is_a_gaussian_about_zero():
    mode, std = mode_and_std(GRID, GRID.prior)
    # The grid ends at 4.4 deviations and is 16 times finer than one.
    assert mode == pytest.approx(0.0, abs=1e-12) and std == pytest.approx(0.16, 1e-3)


@pytest.mark.parametrize("r, std", [(0.1234, 0.03), (-0.4567, 0.02)])
def test_mode_and_deviation_of_a_gaussian_between_the_grids_values(r, std):
    belief = np.exp(-0.5 * ((GRID.values - r) / std) ** 2)
    mode, deviation = mode_and_std(GRID, belief / belief.sum())
    # A parabola through logarithms is exact, and sums over two values a deviation are.
    assert mode == pytest.approx(r, abs=1e-9)
    assert deviation == pytest.approx(np.sqrt(std**2 + 0.01**2 / 12), rel=1e-3)


def test_a_tail_of_values_that_nothing_rules_out_does_not_pull_the_residual_along():
    belief = np.exp(-0.5 * (GRID.values / 0.02) ** 2)
    belief[GRID.values > 0.0] += 0.05 * np.exp(-GRID.values[GRID.values > 0.0] / 0.3)
    belief /= belief.sum()
    mode, deviation = mode_and_std(GRID, belief)
    assert abs(mode) < 0.002 < 0.04 < GRID.values @ belief
    # About the mode: never less than about the mean.
    assert deviation > np.sqrt((GRID.values**2) @ belief - (GRID.values @ belief) ** 2)


def test_losses_are_the_violation_loss_under_each_residual():
    lcs = point_mass(5e-3)
    step = measured_step(lcs, [0.0, 0.0], [PUSH], [0.0, 0.0], np.ones(2), 1.0)
    values = np.linspace(-0.3, 0.3, 7)
    loss = losses_on_grid(step, np.array([True]), values, 1.0, 5e-4)
    expected = [violation_loss(step, np.array([r]), 1.0, 5e-4)[0][0] for r in values]
    np.testing.assert_allclose(loss, expected, rtol=1e-12)


def test_gaussian_measurements_and_drift_give_the_kalman_filter():
    truth_std, drift = 0.05, 0.01
    mean, variance = 0.0, 0.16**2
    belief = GRID.prior
    for y in (0.2, 0.15, 0.22, 0.18):
        variance += drift**2
        gain = variance / (variance + truth_std**2)
        mean, variance = mean + gain * (y - mean), (1.0 - gain) * variance
        loss = 0.5 * ((GRID.values - y) / truth_std) ** 2
        belief = updated(GRID, belief, loss, trust=1.0, loss_max=np.inf)
    ours = mode_and_std(GRID, belief)
    # Drift is as wide as the grid is fine: sampled, its variance is right to 1e-3; the
    # grid's own spacing is added, 0.01^2/12.
    assert ours[0] == pytest.approx(mean, abs=1e-3)
    assert ours[1] == pytest.approx(np.sqrt(variance + 0.01**2 / 12), rel=0.01)


def test_a_residual_changes_the_more_the_larger_it_is():
    grid = residual_grid(0.7, 0.002, 0.16, drift_std=0.01, growth_std=0.05)
    for value in (-0.4, 0.0, 0.2):
        j = int(np.argmin(abs(grid.values - value)))
        mean, std = mode_and_std(grid, grid.transition[:, j])
        # The grid is 5 times finer than the least of them and ends far away.
        assert mean == pytest.approx(value, abs=1e-9)
        assert std == pytest.approx(0.01 + 0.05 * abs(value), rel=0.01)


def test_one_reading_changes_odds_by_no_more_than_it_may():
    loss = np.where(GRID.values == GRID.values[90], 0.0, 1e6)
    still = residual_grid(0.7, 0.01, 0.16, 1e-9)
    after = updated(still, still.prior, loss, trust=0.1, loss_max=6.0)
    odds = (after[90] / after[60]) / (still.prior[90] / still.prior[60])
    assert odds == pytest.approx(np.exp(0.6))


def test_losses_that_are_not_finite_leave_the_belief_to_drift():
    loss = np.full(GRID.values.size, np.nan)
    after = updated(GRID, GRID.prior, loss, 0.1, 6.0)
    expected = GRID.transition @ GRID.prior
    np.testing.assert_allclose(after, expected / expected.sum())
    assert mode_and_std(GRID, after)[1] > 0.16


# The learner of ball_rolling, on what a tip of 1 kg does above a ball that lies still.

MODEL = TipAndBall()
REACH = MODEL.tip_radius + MODEL.ball_radius


@pytest.fixture(scope="module")
def builder():
    pairs = [ContactPair("tip::tip", "ball::ball", 1.0)]
    pairs.append(ContactPair("ball::ball", "table::table", 1.0))
    return AnitescuLcsBuilder(
        make_tip_and_ball(MODEL)[0], LcsBuilderConfig(pairs, LEARN, None, LEARN, 0.0)
    ).model


def press(builder, gap, n=40, noise=0.0, z_end=-0.02):
    """A tip comes down on the ball's top, whose surface is `gap` lower than modelled
    [m], at 4 cm/s, and rests there or at z_end below the modelled one; the ball lies.

    Returns: x (n, 19), u (n, 3) that would have moved it without contact, LCS (n).
    """
    rng = np.random.default_rng(0)
    top = MODEL.ball_radius + REACH
    below = np.maximum(0.01 - 0.04 * LEARN * np.arange(n + 1), z_end)
    z = np.maximum(top + below, top - gap)
    v = np.diff(z, prepend=z[0] + 0.04 * LEARN) / LEARN
    x, u, all_lcs = [], [], []
    for k in range(n):
        row = pack([0.0, 0.0, z[k]], [0.0, 0.0, v[k]], [0, 0, MODEL.ball_radius],
                   np.zeros(3), MODEL.ball_radius)  # fmt: skip
        row[V_TIP] += noise * rng.normal(size=3)
        x.append(row)
        # The arm's own push: 2 N where something is in the way, else what moves it.
        blocked = z[k + 1] <= top - gap + 1e-9 and below[k + 1] > z_end - 1e-9
        pushed = -2.0 if blocked and k > 3 else 0.0
        u.append([0.0, 0.0, (v[k + 1] - v[k]) / LEARN * MODEL.tip_mass + pushed])
        all_lcs.append(builder.build(row, np.zeros(3)))
    return np.array(x), np.array(u), all_lcs


def learned(config, x, u, all_lcs):
    """r_comp as a gap, r_std as one, and the status at the end."""
    diagram = DiagramBuilder()
    enable = np.ones((len(x), 1))
    # u of the script is that of the step that ends.
    script = diagram.AddSystem(
        Script(x, np.vstack([u[:1], u[:-1]]), all_lcs, enable, LEARN)
    )
    learner = diagram.AddSystem(ResidualLearner(config, all_lcs[0], LEARN, 1e-3))
    for port, name in (("x", "x"), ("u", "u_measured"), ("lcs", "lcs")):
        diagram.Connect(script.GetOutputPort(port), learner.GetInputPort(name))
    diagram.Connect(script.GetOutputPort("enable"), learner.GetInputPort("enable"))
    simulator = Simulator(diagram.Build())
    simulator.AdvanceTo(LEARN * (len(x) - 1) + 2e-3)
    context = learner.GetMyContextFromRoot(simulator.get_context())
    r, std, status = (
        learner.GetOutputPort(name).Eval(context)
        for name in ("r_comp", "r_std", "status")
    )
    assert r[:4].min() == r[:4].max() and not r[4:].any()
    return LEARN * r[0], LEARN * std[0], status[0]


@pytest.mark.parametrize("gap", [-0.008, 0.0, 0.010])
def test_a_tip_that_is_stopped_tells_where_the_surface_is(builder, gap):
    config = learner_config(LearnerConfig())
    r, std, status = learned(config, *press(builder, gap, noise=2e-3, z_end=-0.04))
    # Forty steps of which some twenty touch; the grid is 0.5 mm.
    assert abs(r - gap) < 0.002 and abs(r - gap) < 3.0 * std
    assert status == LearnerStatus.LEARNED and std < 0.004


def test_air_where_the_model_has_the_ball_is_learned_from_v_z_of_the_tip_alone(builder):
    """The tip rests 6 mm below the modelled surface, and nothing stopped it. Without
    the weight on its v_z, a still ball is explained by friction forces that cancel."""
    data = press(builder, gap=0.05, z_end=-0.006)
    r, _, _ = learned(learner_config(LearnerConfig()), *data)
    assert r > 0.005
    blind, std, _ = learned(learner_config(LearnerConfig(weight_tip=0.0)), *data)
    assert blind < 0.003 and std > 0.006  # About what it believed before.


def passing(builder, speed=0.2, clearance=0.005, n=4):
    """Steps of a tip that passes over a still ball and touches nothing."""
    top = MODEL.ball_radius + REACH + clearance
    for k in range(n):
        p = np.array([speed * LEARN * (k - n / 2), 0.0, top])
        now, then = (
            pack(p + [dx, 0.0, 0.0], [speed, 0.0, 0.0], [0, 0, MODEL.ball_radius],
                 np.zeros(3), MODEL.ball_radius)
            for dx in (0.0, speed * LEARN)
        )  # fmt: skip
        yield builder.build(now, np.zeros(3)), now, then


def test_a_contact_that_slides_opens_by_mu_times_its_speed(builder):
    for lcs, _, then in passing(builder):
        # The tip's speed across the line of centres, in the basis of four edges.
        along = np.abs(lcs.J[:4] @ then[10:] - (lcs.J[:4] @ then[10:]).mean())
        np.testing.assert_allclose(opening_speed(lcs, then)[:4], along.max())
        assert 0.13 < along.max() <= 0.2 + 1e-9  # mu = 1; |v_t| / sqrt(2) at least.
        np.testing.assert_allclose(opening_speed(lcs, then)[4:], 0.0, atol=1e-12)
        assert not opening_speed(lcs, then, np.inf).any()
        noisy = opening_speed(lcs, then, 0.12)[0]
        np.testing.assert_allclose(noisy, np.sqrt(along.max() ** 2 - 0.12**2))


def test_a_tip_that_passes_over_the_ball_is_not_felt_by_it(builder):
    """5 mm over it at 0.2 m/s. Anitescu's contact, that opens by 10 mm a step, would
    have stopped the tip: without the correction the surface is believed lower."""
    config = learner_config(LearnerConfig())
    losses = []
    for noise in (np.inf, 0.03):
        at_zero = []
        for lcs, now, then in passing(builder):
            step = measured_step(lcs, now, np.zeros(3), then, config.Q_d, 1e-3, noise)
            at_zero.append(violation_loss(step, np.zeros(8), 1e-3, 5e-4)[0][0])
        losses.append(max(at_zero))
    assert losses[0] > 20.0 and losses[1] < 1e-6


@pytest.mark.parametrize("watched", [True, False])
def test_a_ball_that_rocks_by_itself_says_little_of_the_gap(builder, watched):
    """Seen first where nothing can touch it, then under a tip 6 mm over the surface."""
    rng = np.random.default_rng(0)
    x, u, all_lcs = [], [], []
    for k in range(120):
        height = 0.2 if k < 80 else MODEL.ball_radius + REACH + 0.006
        v = [*(0.08 * rng.normal(size=2)), 0.0]
        row = pack([0.0, 0.0, height], np.zeros(3), [0, 0, MODEL.ball_radius], v,
                   MODEL.ball_radius)  # fmt: skip
        row[V_TIP] += 3e-3 * rng.normal(size=3)
        x.append(row)
        u.append(np.zeros(3))
        all_lcs.append(builder.build(row, np.zeros(3)))
    config = learner_config(LearnerConfig())
    if not watched:
        config.posterior = replace(config.posterior, free=FreeStatesConfig())
    r, std, _ = learned(config, np.array(x), np.array(u), all_lcs)
    if watched:
        assert abs(r) < 0.003 and abs(r) < std
    else:
        assert abs(r) > 0.004


def test_without_a_posterior_r_std_is_zero_and_r_comp_adapts_entry_by_entry(builder):
    x, u, all_lcs = press(builder, gap=0.05, z_end=-0.006)
    config = paper_learner_config(all_lcs[0].n_lam)
    assert config.posterior is None and config.groups == [[i] for i in range(8)]
    config = ResidualLearnerConfig(Q_d=learner_config(LearnerConfig()).Q_d,
                                   groups=[[0, 1, 2, 3]])  # fmt: skip
    _, std, _ = learned(config, x, u, all_lcs)
    assert std == 0.0


def test_a_gap_that_is_too_large_has_no_gradient_but_a_likelihood():
    """A mass rests on a wall; a model whose wall is 20 mm further explains nothing of
    it, and its loss is flat: the gradient is zero, the posterior is not misled."""
    lcs = point_mass(5e-3)
    Q, eps = np.array([0.0, 1e4]), 1e-4
    x_next, _ = simulate(point_mass(), np.zeros(2), [PUSH])
    step = measured_step(lcs, [0.0, 0.0], [PUSH], x_next, Q, eps)
    far = np.array([0.3])
    _, gradient, _, _ = violation_loss(step, far, eps, 5e-4)
    assert abs(gradient[0, 0]) * eps < 1e-9
    loss = losses_on_grid(step, np.array([True]), GRID.values, eps, 5e-4)
    belief = GRID.prior
    for _ in range(60):
        belief = updated(GRID, belief, loss, 0.1, 6.0)
    assert mode_and_std(GRID, belief)[0] == pytest.approx(-0.1, abs=0.01)  # 5 mm/dt.


# The learner alone, on a mass of 1 kg between two walls of which the model is wrong.


def between_walls(left, right, dt=LEARN):
    """w = (q + left)/dt + v_next, (right - q)/dt - v_next: walls at -left and right."""
    one = point_mass(right, dt, 0.01 * dt)
    F = np.array([[dt, -dt], [-dt, dt]]) + 0.01 * dt * np.eye(2)
    E, H = np.vstack([-one.E, one.E]), np.vstack([-one.H, one.H])
    c = np.array([left, right]) / dt
    phi = np.array([left, right])
    return LCS(one.A, one.B, np.hstack([-one.D, one.D]), one.d, E, F, H, c, dt, phi)


def visits(truth, pushes, noise=0.0):
    """States of the mass that is pushed with these forces, and the forces [N]."""
    rng = np.random.default_rng(0)
    x = [np.zeros(2)]
    for u in pushes[:-1]:
        v = 0.9 * x[-1][1]  # Some friction, so that it comes to rest.
        x.append(simulate(truth, [x[-1][0], v], [u])[0])
    x = np.array(x)
    x[:, 1] += noise * rng.normal(size=len(x))
    return x, np.array(pushes)[:, None]


def follow(model, x, u, ticks, **posterior):
    """(r, r_std) of the learner at some ticks, as gaps [m], on x (n, 2), u (n, 1)."""
    dt = model.dt
    config = ResidualLearnerConfig(
        Q_d=[0.0, 1e4], eps=1e-3, posterior=PosteriorConfig(**posterior)
    )
    diagram = DiagramBuilder()
    u = np.vstack([u[:1], u[:-1]])  # That of the step that ends.
    script = diagram.AddSystem(Script(x, u, [model], np.ones((1, 1)), dt))
    learner = diagram.AddSystem(ResidualLearner(config, model, dt, 1e-2 * dt))
    for port, name in (("x", "x"), ("u", "u_measured"), ("lcs", "lcs")):
        diagram.Connect(script.GetOutputPort(port), learner.GetInputPort(name))
    simulator = Simulator(diagram.Build())
    context = learner.GetMyContextFromRoot(simulator.get_context())
    found = []
    for k in ticks:
        simulator.AdvanceTo(dt * (k + 0.1))
        r, std = (
            learner.GetOutputPort(name).Eval(context) for name in ("r_comp", "r_std")
        )
        found.append((dt * r, dt * std))
    return found


@pytest.mark.parametrize(
    "gaps, is_free",
    [
        ((3.0, 3.0), True),
        ((1.5, 3.0), False),
        ((3.0, 1.5), False),
        ((9.0, -1.0), False),
    ],
)
def test_what_moves_a_free_state_is_learned_only_where_nothing_touches(gaps, is_free):
    """Nothing: no wall within two deviations of its residual. Gaps in deviations."""
    model, x, u = between_walls(0.1, 0.1), np.zeros(2), np.zeros(1)
    config = ResidualLearnerConfig(
        Q_d=[0.0, 1e4], eps=1e-3, posterior=PosteriorConfig(free=FreeStatesConfig([1]))
    )
    learner = ResidualLearner(config, model, LEARN, 1e-2 * LEARN)
    memory = learner._memory_of(learner.CreateDefaultContext())
    memory = replace(memory, std=np.full(2, 0.1), unexplained=np.zeros(1))
    near = replace(model, phi=0.1 * LEARN * np.array(gaps))
    for pair in ((near, model), (model, near)):
        after = learner._unexplained(memory, *pair, x, u, x + 0.3)
        assert (after > 0.0).all() == is_free


@pytest.mark.parametrize("left, right", [(-8e-3, 5e-3), (6e-3, 6e-3), (0.0, -5e-3)])
@pytest.mark.parametrize("dt", [pytest.param(0.005, marks=pytest.mark.slow), 0.05])
def test_each_of_two_contacts_gets_its_own_residual_and_deviation(left, right, dt):
    model, truth = between_walls(0.03, 0.03, dt), between_walls(0.03, 0.03, dt)
    truth = truth.with_residual(np.array([left, right]) / dt)
    n = int(2.0 / dt)
    x, u = visits(truth, ([3.0] * n + [-3.0] * n) * 2, noise=2e-3)
    [(r, std)] = follow(model, x, u, [4 * n - 1])
    # Pressed 2 s in all on each; the friction of the world is not in the model.
    np.testing.assert_allclose(r, [left, right], atol=1e-3)
    assert (abs(r - [left, right]) < 2.0 * std).all() and std.max() < 3e-3


@pytest.mark.parametrize("error", [pytest.param(-8e-3, marks=pytest.mark.slow), 8e-3])
def test_what_was_learned_stays_where_nothing_is_touched(error):
    """One wall is 8 mm off; the mass then floats for minutes 3 mm before it."""
    model = between_walls(1.0, 0.03)
    truth = model.with_residual(np.array([0.0, error / LEARN]))
    x, u = visits(truth, [3.0] * 40)
    away = np.tile([0.03 + error - 3e-3, 0.0], (3000, 1))
    x, u = np.vstack([x, away]), np.vstack([u, np.zeros((3000, 1))])
    first, after, last = follow(
        model, x, u, [39, 100, 3039], walk=WalkConfig(hold_sec=2.0)
    )
    assert abs(first[0][1] - error) < 5e-4
    # It may walk for two seconds, in which a large residual shrinks by a few percent.
    assert abs(after[0][1] - error) < 1e-3
    np.testing.assert_allclose(last, after, atol=1e-5)  # A fiftieth of the grid.


def test_before_anything_is_touched_the_prior_stays():
    model = between_walls(1.0, 1.0)
    n = 1200
    found = follow(model, np.zeros((n, 2)), np.zeros((n, 1)), [2, n - 1])
    for r, std in found:
        np.testing.assert_allclose(r, 0.0, atol=1e-9)
        np.testing.assert_allclose(std, 8e-3, rtol=0.05)  # It walks for 2 s at first.


def test_a_wall_that_was_moved_is_found_again():
    """15 mm nearer, where three minutes of air had ruled it out; the model with what
    was learned so far sees no contact there, as a push moves the mass by half of it."""
    model, n = between_walls(1.0, 0.03), 3600
    x, u = visits(model, [3.0] * 40)
    away, still = np.tile([0.029, 0.0], (n, 1)), np.zeros((n, 1))
    moved = model.with_residual(np.array([0.0, -15e-3 / LEARN]))
    on_it = np.tile(simulate(moved, [0.015, 0.0], [3.0])[0], (80, 1))
    x, u = np.vstack([x, away, on_it]), np.vstack([u, still, np.full((80, 1), 3.0)])
    [(r, std)] = follow(model, x, u, [len(x) - 1])
    assert abs(r[1] + 15e-3) < 1e-3 and std[1] < 2e-3


def on_a_floor(dt=LEARN):
    """Two masses of 1 kg on a line: the lower one on a floor, the upper one on it."""
    J = np.array([[1.0, 0.0], [-1.0, 1.0]])
    A = np.block([[np.eye(2), dt * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    B = np.array([[0.0], [dt**2], [0.0], [dt]])
    D = np.vstack([dt**2 * J.T, dt * J.T])
    E = np.hstack([J / dt, J @ np.eye(2)])
    F = dt * J @ J.T + 0.01 * dt * np.eye(2)
    return LCS(A, B, D, np.zeros(4), E, F, dt * J[:, 1:], np.zeros(2), dt, np.zeros(2))


def test_of_two_contacts_in_a_row_neither_takes_the_others_error():
    """A push from above goes through both; the floor is 6 mm lower than modelled."""
    model, gaps = on_a_floor(), np.array([6e-3, -2e-3])
    truth = model.with_residual(gaps / LEARN)
    x, u = [np.array([6e-3, 4e-3, 0.0, 0.0])], np.full((60, 1), -4.0)
    x[0][:2] = 0.01  # Both in the air.
    for _ in range(59):
        x.append(simulate(truth, x[-1], [-4.0])[0])
    config = ResidualLearnerConfig(
        Q_d=[0.0, 0.0, 1e4, 1e4], eps=1e-3, posterior=PosteriorConfig()
    )
    learner = ResidualLearner(config, model, LEARN)
    memory = learner.CreateDefaultContext().get_abstract_state(0).get_value()
    for row in x:
        memory = learner._after(memory, row.copy(), u[0], model, True)
    r, std = LEARN * memory.residual.value, LEARN * memory.std
    np.testing.assert_allclose(r, gaps, atol=5e-4)  # The grid's spacing.
    assert (abs(r - gaps) < 2.0 * std).all()


def finger_and_puck(damping, dt=LEARN):
    """Two masses of 1 kg on a line, [N s/m] at the one that is pushed through the
    other, with a contact between them."""
    J = np.array([[-1.0, 1.0]])
    V = np.eye(2) - dt * np.diag([0.0, damping])
    A = np.block([[np.eye(2), dt * V], [np.zeros((2, 2)), V]])
    B = np.array([[dt**2], [0.0], [dt], [0.0]])
    D = np.vstack([dt**2 * J.T, dt * J.T])
    E = np.hstack([J / dt, J @ V])
    F = dt * J @ J.T + [[0.01 * dt]]
    return LCS(A, B, D, np.zeros(4), E, F, J @ B[2:], np.zeros(1), dt, np.zeros(1))


@pytest.mark.parametrize("drag", [6.0, 10.0])
@pytest.mark.parametrize("error", [-5e-3, 0.0, 5e-3])
def test_the_deviation_covers_what_an_unmodelled_drag_does_to_the_residual(error, drag):
    """In the model it is 3 N s/m; a part of the missing force is taken for a gap."""
    model = finger_and_puck(3.0)
    world = finger_and_puck(drag).with_residual([error / LEARN])

    def covered(**posterior):
        config = ResidualLearnerConfig(
            Q_d=[0.0, 0.0, 1e4, 4e4], eps=1e-3, posterior=PosteriorConfig(**posterior)
        )
        learner = ResidualLearner(config, model, LEARN)
        memory = learner.CreateDefaultContext().get_abstract_state(0).get_value()
        rng, x, within = np.random.default_rng(0), np.array([-0.01, 0, 0, 0]), []
        u = np.zeros(1)
        for _ in range(200):
            seen = x + [0, 0, *(2e-3 * rng.normal(size=2))]
            memory = learner._after(memory, seen, u, model, True)
            r, std = LEARN * memory.residual.value[0], LEARN * memory.std[0]
            within.append(abs(r - error) < 1.645 * std)
            u = np.array([4.0])
            x, _ = simulate(world, x, u)
        return np.mean(within)

    assert covered() >= 0.9 > 0.5 > covered(misfit_sec=None)


def fingers_and_box(left, right):
    """SDF of two fingers of radius 2 cm at either side of a box, all on one rail, the
    box's faces at -left and right of its origin [m]."""
    sphere = "<sphere><radius>0.02</radius></sphere>"
    box = f"<box><size>{left + right} 0.1 0.1</size></box>"
    text = "<sdf version='1.7'><model name='m'>"
    for name, x, y, shape, limit in (
        ("a", -0.15, 0.0, sphere, ""),
        ("b", 0.15, 0.0, sphere, ""),
        ("o", 0.0, (right - left) / 2, box, "<limit><effort>0</effort></limit>"),
    ):
        text += (
            f"<link name='{name}'><pose>{x} 0 0 0 0 0</pose><inertial><mass>1</mass>"
            f"</inertial><collision name='{name}'><pose>{y} 0 0 0 0 0</pose>"
            f"<geometry>{shape}</geometry></collision></link>"
            f"<joint name='rail_{name}' type='prismatic'><parent>world</parent>"
            f"<child>{name}</child><axis><xyz>1 0 0</xyz><dynamics><damping>5"
            f"</damping></dynamics>{limit}</axis></joint>"
        )
    return text + "</model></sdf>"


@pytest.mark.parametrize(
    "left, right",
    [
        *(pytest.param(x, x, marks=pytest.mark.slow) for x in (6e-3, -6e-3)),
        (6e-3, -6e-3),
    ],
)
def test_two_fingers_find_both_faces_of_a_box_of_another_width(left, right):
    """The world is a MultibodyPlant; the fingers move the box to and fro."""
    plants = []
    for text, step in (
        (fingers_and_box(0.05, 0.05), 0.0),
        (fingers_and_box(0.05 - left, 0.05 - right), 1e-3),
    ):
        diagram = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(diagram, step)
        Parser(plant).AddModelsFromString(text, "sdf")
        plant.Finalize()
        plants.append((diagram.Build(), plant))
    pairs = [ContactPair("m::a", "m::o", 0.3), ContactPair("m::b", "m::o", 0.3)]
    model, (world, plant) = AnitescuLcs(plants[0][0], pairs, LEARN), plants[1]
    config = ResidualLearnerConfig(
        Q_d=[0.0] * 3 + [1e4] * 3,
        eps=1e-3,
        groups=[[0, 1, 2, 3], [4, 5, 6, 7]],
        posterior=PosteriorConfig(),
    )
    learner = ResidualLearner(config, model.at_default(), LEARN)
    memory = learner.CreateDefaultContext().get_abstract_state(0).get_value()
    simulator, u = Simulator(world), np.zeros(2)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    errors, stds = [], []
    for k in range(120):
        x = plant.GetPositionsAndVelocities(context)
        memory = learner._after(memory, x.copy(), u, model.build(x, u), True)
        errors.append(LEARN * memory.residual.value - [left, right])
        stds.append(LEARN * memory.std)
        u = 3.0 * np.sin(2.0 * np.pi * k * LEARN / 3.0) + np.array([3.0, -3.0])
        plant.get_actuation_input_port().FixValue(context, u)
        simulator.AdvanceTo((k + 1) * LEARN)
    errors, stds = np.abs(errors), np.array(stds)
    assert errors[60:].max() < 1e-3  # The world's contact gives way by less.
    assert np.mean(errors < 1.645 * stds) >= 0.9


@pytest.mark.parametrize("groups", [[[0, 1]], [[0, 1, 2, 3], [4]], [[4, 5, 6]]])
def test_a_part_of_a_contacts_entries_is_refused(builder, groups):
    """Four of them each: the other ones would keep the modelled gap."""
    lcs = builder.build(builder.x_default, np.zeros(3))
    with pytest.raises(ValueError, match="of the 4 entries of contact [01]"):
        ResidualLearner(ResidualLearnerConfig(groups=groups), lcs, LEARN)


def walking(**walk):
    return dict(posterior=PosteriorConfig(walk=WalkConfig(**walk)))


def with_free(*free):
    return dict(posterior=PosteriorConfig(free=FreeStatesConfig(*free)))


@pytest.mark.parametrize(
    "changes, message",
    [
        (walking(hold_sec=np.nan), "hold_sec is nan"),
        (dict(posterior=PosteriorConfig(misfit_sec=0.0)), "misfit_sec is 0.0"),
        (dict(posterior=PosteriorConfig(spacing=1e-5)), "spacing is 1e-05, expected"),
        (dict(posterior=PosteriorConfig(spacing=0.5)), "spacing is 0.5, expected"),
        (with_free([1.5]), r"free.states\[0\] is 1.5, expected an integer"),
        (dict(posterior=PosteriorConfig(), Q_d=[]), "Q_d is empty, expected"),
        (dict(posterior=PosteriorConfig(trust=0.0)), "posterior.trust is 0.0"),
        (walking(drift=np.nan), "posterior.walk.drift is nan"),
        (walking(growth=-1.0), "posterior.walk.growth is -1.0"),
        (with_free([], 0.0), "posterior.free.average_sec is 0.0"),
        (with_free([19]), "posterior.free.states names 19"),
        (dict(slip_noise=-0.1), "slip_noise is -0.1, expected 0 or more"),
    ],
)
def test_wrong_settings_are_refused_by_name(builder, changes, message):
    lcs = builder.build(builder.x_default, np.zeros(3))
    settings = dict(groups=[[0, 1, 2, 3]], posterior=PosteriorConfig()) | changes
    settings = dict(Q_d=[1.0] * lcs.n_x) | settings
    with pytest.raises(ValueError, match=message):
        ResidualLearner(ResidualLearnerConfig(**settings), lcs, LEARN)
