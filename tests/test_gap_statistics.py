"""The statistics of the gap workflow: each against a value from elsewhere."""

from copy import copy
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

from makebreak.gap import fit, workflow
from makebreak.gap.fit import fit_effects
from makebreak.gap.numerics.selection import (
    LinearFit,
    Screen,
    benjamini_hochberg,
    between_parts,
    boxed_minimum,
    in_place_of_others,
    is_plausible,
    is_predicted,
    paired,
    paired_t,
    predictable_share,
    random_effects,
    simplest,
    spread_by_blocks,
    std_of_shared_errors,
)
from makebreak.gap.numerics.signal_noise import jump_variance, noise_beside
from makebreak.gap.numerics.weak_form import make_bumps
from makebreak.gap.problem import (
    Candidate,
    GapProblem,
    Nuisances,
    Outcome,
    SearchPlan,
)
from makebreak.gap.residuals.late_poses import wanted
from makebreak.gap.residuals.mechanism import MechanismProblem
from makebreak.gap.residuals.whitened_rows import WhitenedRows
from makebreak.gap.result import Estimate, GapMeasure, Tried
from makebreak.gap.search import add, comparison, drop
from makebreak.gap.search.choice import (
    Choice,
    Selection,
    Trial,
    deviations_off,
    is_significant,
)
from makebreak.gap.search.chosen_by_simulation import chosen_by_simulation
from makebreak.gap.search.comparison import Comparison
from makebreak.gap.search.drop import _is_certain
from makebreak.gap.search.screen import Ranked
from makebreak.gap.search.select import select
from makebreak.gap.search.trials import pick_simplest, shortlist
from makebreak.gap.search.trust import (
    consistency,
    correlations,
    gauss_newton,
    ridges,
    scatter,
)
from makebreak.gap.thresholds import SAME_ERROR
from makebreak.gap.verdict import (
    Facts,
    decide,
    says_tried,
    too_weak,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.systems.numerics.smoother import smooth


def test_false_discovery_rate_is_that_of_the_published_example():
    # Benjamini and Hochberg 1995, section 3.2: 15 p-values of a trial; at 5 % the
    # first four are rejected, of which Bonferroni keeps three.
    p = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459,
         0.3240, 0.4262, 0.5719, 0.6528, 0.7590, 1.0000]  # fmt: skip
    order = np.random.default_rng(0).permutation(15)
    rejected = benjamini_hochberg(np.array(p)[order], 0.05)
    np.testing.assert_array_equal(np.sort(order[rejected]), [0, 1, 2, 3])


def test_the_simplest_of_equals_is_taken_but_not_a_worse_one():
    assert simplest([1.0, 1.04, 1.2], [3, 1, 1], SAME_ERROR) == 1
    assert simplest([1.0, 1.06, 1.2], [3, 1, 1], SAME_ERROR) == 0


def test_two_models_that_differ_by_chance_alone_are_told_apart_no_oftener():
    rng = np.random.default_rng(7)
    train = np.arange(2000) // 50 % 3 != 1
    noise, other = rng.normal(size=(2, 400, 2000))
    p = [
        paired(a + 0.1 * b, a - 0.1 * b, train)
        for a, b in zip(noise, other, strict=True)
    ]
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.035)
    # A little worse everywhere, and not to be seen in the rms (1 %).
    lines = np.sin(np.arange(2000) * 0.3)
    assert paired(noise[0] + 0.2 * lines, noise[0], train) > 1e-3
    steady = 1.5 * lines
    assert paired(steady + 0.1 * lines, steady, train) < 1e-4
    assert paired(noise[0], noise[0], train) == 1.0
    assert paired(noise[0], noise[1], np.ones(2000, bool)) == 1.0  # One block.


def test_nuisances_are_plausible_within_their_prior():
    rng = np.random.default_rng(3)
    prior = np.array([0.1, 2.0, 3.0, 0.5])
    draws = rng.normal(size=(2000, 4)) * prior
    assert all(is_plausible(b, prior) for b in draws)
    assert np.mean([is_plausible(b, prior, 0.1) for b in draws]) == pytest.approx(
        0.9, abs=0.02
    )
    assert not is_plausible(np.array([0.6, 0.0, 0.0, 0.0]), prior)  # Six sigma.
    assert is_plausible([], [])


def test_a_screen_fits_as_ridge_regression_does():
    rng = np.random.default_rng(0)
    m, prior, s = 200, np.array([0.3, 2.0]), 1.7
    X, N, r = rng.normal(size=(m, 2)), rng.normal(size=(m, 2)), rng.normal(size=m)
    train = np.arange(m) % 3 != 1
    fit = Screen(r, N, prior, train, s).fit(X)
    rows = np.vstack([np.hstack([X, N])[train] / s, np.zeros((2, 4))])
    rows[-2:, 2:] = np.diag(1.0 / prior)
    want = np.linalg.lstsq(rows, np.append(r[train] / s, [0, 0]), rcond=None)[0]
    # Normal equations of a well-conditioned problem: eps times its condition squared.
    np.testing.assert_allclose(np.append(fit.c, fit.b), want, atol=1e-12)
    left = r - X @ want[:2] - N @ want[2:]
    np.testing.assert_allclose(fit.held_out, np.sqrt(np.mean(left[~train] ** 2)))
    covariance = np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose(fit.c_std, np.sqrt(np.diag(covariance)[:2]))


def test_a_column_of_zeros_gets_no_coefficient():
    rng = np.random.default_rng(0)
    X = np.stack([rng.normal(size=50), 1e-20 * rng.normal(size=50)], axis=1)
    train = np.arange(50) < 30
    none = np.zeros((50, 0))
    fit = Screen(X[:, 0], none, np.zeros(0), train).fit(X)
    np.testing.assert_allclose(fit.c, [1.0, 0.0])


def test_weak_and_strong_form_agree_without_noise():
    t = np.arange(0.0, 2.0, 0.001)
    p, rate, rest = np.sin(3 * t), 3 * np.cos(3 * t), t**2
    bumps = make_bumps(t, np.full(len(t), 0.001), 0.2, 0.1)
    # Trapezoids on a function with three zero derivatives at its ends: error h^4.
    np.testing.assert_allclose(bumps.weak(p, rest), bumps.mean(rate + rest), atol=1e-7)
    np.testing.assert_allclose(bumps.mean(np.ones_like(t)), 1.0, atol=1e-8)


def test_noise_of_a_tested_acceleration_is_as_predicted():
    rng = np.random.default_rng(0)
    h, width = 0.005, 0.2
    t = np.arange(0.0, 400.0, h)
    bumps = make_bumps(t, np.full(len(t), h), width, width)
    noise = rng.normal(size=len(t))
    # Twice by parts: integral(w'' y) of the noise, by differences of w' rows.
    second = [
        8 / 3 / width**3 * np.pi**2
        * (12 * np.sin(a) ** 2 * np.cos(a) ** 2 - 4 * np.sin(a) ** 4)
        for a in [np.pi * (np.arange(int(width / h)) + 0.5) * h / width]
    ][0]  # fmt: skip
    n = len(second)
    values = [h * second @ noise[k : k + n] for k in range(0, len(t) - n, n)]
    # 2000 values: their standard deviation is known to 1.6 %.
    assert np.std(values) == pytest.approx(bumps.position_noise_gain(h), rel=0.05)


def test_no_bump_reaches_into_a_hole():
    t = np.arange(0.0, 2.0, 0.01)
    bumps = make_bumps(t, np.full(len(t), 0.01), 0.2, 0.1, [(0.9, 1.1)])
    assert np.all((bumps.centre <= 0.8 + 1e-9) | (bumps.centre >= 1.2 - 1e-9))


def test_smoother_finds_velocity_and_its_own_error():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 10, 2000))
    y = np.sin(2 * t) + 1e-3 * rng.normal(size=len(t))
    y[rng.uniform(size=len(t)) < 0.1] = np.nan
    s = smooth(t, y, 1e-3)
    inner = slice(50, -50)
    error = s.x[inner, 1] - 2 * np.cos(2 * t[inner])
    # Its own standard deviation, within what 20 independent stretches tell.
    ratio = np.sqrt(np.mean(error**2 / s.P[inner, 1, 1]))
    assert 0.5 < ratio < 1.6
    assert np.std(error) < 0.02
    assert 0.8 < s.innovation < 1.2


def test_smoother_refuses_too_few_samples():
    with pytest.raises(ValueError, match="at least 6"):
        smooth(np.arange(9.0), [1, 2, 3, 4, 5] + [np.nan] * 4, 0.1)


def test_blocks_drawn_anew_tell_how_a_slope_scatters_from_one_recording_to_the_next():
    rng = np.random.default_rng(3)
    blocks, rows, runs = 40, 25, 300
    block = np.repeat(np.arange(blocks), rows)
    x = np.repeat(rng.uniform(0.5, 2.0, blocks), rows)  # A slope through the origin.

    def noise(together: float):
        shared = together * np.repeat(rng.normal(size=blocks), rows)
        return shared + rng.normal(size=len(x))

    for together in (0.0, 1.0):
        # Least squares of each of many recordings, in closed form.
        slopes = [x @ noise(together) / (x @ x) for _ in range(runs)]
        told = [
            spread_by_blocks(x[:, None], noise(together), block)[0] for _ in range(20)
        ]
        # 300 runs tell a scatter to 4 %, 40 blocks to 11 %, 20 means of those to 3 %.
        assert np.mean(told) == pytest.approx(np.std(slopes), rel=0.15)
    # A prior's row counts once; too few blocks say nothing.
    stiff = np.vstack([x[:, None], [[1e6]]])
    r, there = np.append(noise(1.0), 0.0), np.append(block, -1)
    assert spread_by_blocks(stiff, r, there)[0] < 1e-6
    assert spread_by_blocks(x[:125, None], noise(1.0)[:125], block[:125])[0] == 0.0


def test_what_a_factor_that_all_rows_share_adds_to_a_deviation():
    """Distances of which each is off by force times a compliance."""
    n, c = 50, 3e-3
    place = np.ones((n, 1))
    # With one force only place and compliance are one: the depth is what it is off by.
    constant = np.full((n, 1), 7.0)
    assert std_of_shared_errors(place, constant, [c]) == pytest.approx(7.0 * c)
    # Least squares with the compliance as one more row, in general.
    rng = np.random.default_rng(0)
    force = rng.uniform(0.0, 900.0, (n, 1))
    H = np.hstack([place, force]).T @ np.hstack([place, force])
    H[1, 1] += c**-2
    added = np.linalg.inv(H)[0, 0] - 1.0 / n
    told = std_of_shared_errors(place, force, [c])
    assert told == pytest.approx(np.sqrt(added))
    assert told < 0.2 * force.mean() * c  # Forces that differ tell it.
    # A compliance that is known, a channel that the place does not move.
    assert std_of_shared_errors(place, force, [0.0]) == 0.0
    both, loads = np.hstack([place, 0.0 * place]), np.hstack([force, 9.0 * force])
    assert std_of_shared_errors(both, loads, [c, 1.0]) == pytest.approx(told)
    assert std_of_shared_errors(0.0 * place, force, [c]) == 0.0


def test_what_two_of_many_blocks_tell_has_no_scatter_by_blocks():
    """A wall that was met twice: most draws are without a touch, or with one alone, and
    have the wall where slopes that are all but zero put it."""
    rng = np.random.default_rng(0)
    block = np.repeat(np.arange(40), 25)
    friction = rng.normal(size=1000)
    wall = 1e-4 * rng.normal(size=1000)
    r = rng.normal(size=1000)
    alone = spread_by_blocks(friction[:, None], r, block)
    for touched, told in (([3, 17], False), ([2, 5, 9, 14, 20, 31, 33, 38], True)):
        place = np.array(wall)
        place[np.array(touched) * 25] = 10.0
        both = spread_by_blocks(np.stack([friction, place], axis=1), r, block)
        assert both[0] == pytest.approx(alone[0], rel=0.05)
        # Of eight touches with noise of 1 and slopes of 10: the mean's scatter.
        expected = 0.1 / np.sqrt(8) if told else 0.0
        assert both[1] == pytest.approx(expected, rel=0.6)
    # Of eight blocks none may be missing, though some say more than others.
    short = np.repeat(np.arange(8), 25)
    loud = np.repeat([1.0, 2.0, 1.0, 3.0, 1.0, 2.0, 1.0, 1.0], 25)[:, None]
    assert spread_by_blocks(loud * friction[:200, None], r[:200], short)[0] > 0.0


def test_a_mean_of_what_differs_from_time_to_time():
    # Measured alike well, and no more apart than that: the plain mean and its error.
    mean, std = random_effects([1.0, 1.0, 1.0, 1.0], [0.04] * 4)
    assert (mean, std) == pytest.approx((1.0, 0.1))
    # Much further apart: the scatter itself is the error, whatever each claims.
    x = np.array([3.0, -1.0, 2.0, -3.0, 1.5])
    for variance in (1e-9, 1e-4):
        mean, std = random_effects(x, np.full(5, variance))
        assert mean == pytest.approx(x.mean(), rel=1e-3)
        assert std == pytest.approx(np.std(x, ddof=1) / np.sqrt(5), rel=1e-3)
    # What is hardly seen at one time hardly counts.
    mean, std = random_effects([1.0, 1.1, 50.0], [0.01, 0.01, 1e6])
    assert mean == pytest.approx(1.05, abs=1e-3)
    assert std == pytest.approx(0.1 / np.sqrt(2), rel=0.01)
    # A coverage by chance: truly different values, unequal errors.
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(400):
        variance = rng.uniform(0.1, 2.0, 12)
        each = 0.7 + rng.normal(size=12) + np.sqrt(variance) * rng.normal(size=12)
        mean, std = random_effects(each, variance)
        covered += abs(mean - 0.7) < 2.0 * std
    assert 0.90 < covered / 400 < 0.98


@pytest.mark.parametrize("recordings", [1, 5])
def test_an_effect_that_changes_from_part_to_part_is_not_steady(recordings):
    """Two effects, of five stretches of one recording or of five recordings: one the
    same in each, one of another sign from each to the next."""
    rng = np.random.default_rng(6)
    n, parts = 1000, 5
    part = np.repeat(np.arange(parts), n // parts)
    X = 10.0 * rng.normal(size=(n, 2))  # In units of noise.
    a_of = np.full(parts, 0.3)
    b_of = np.array([0.5, -0.6, 0.4, -0.3, 0.2])
    y = X[:, 0] * a_of[part] + X[:, 1] * b_of[part] + rng.normal(size=n)
    best = np.linalg.lstsq(X, y, rcond=None)[0]
    effects = tuple(
        Effect("joint_viscous_damping", [joint], {"damping": float(value)})
        for joint, value in zip(("arm.j1", "arm.j2"), best, strict=True)
    )
    fitted = SimpleNamespace(
        effects=effects, names=((0, "damping"), (1, "damping")),
        J=-X, rows=y - X @ best,
    )  # fmt: skip
    problem = SimpleNamespace(
        train=lambda: np.ones(n, bool),
        parts=lambda: part if recordings > 1 else np.zeros(n, int),
        blocks=lambda: np.arange(n) // 20,
        dynamics=SimpleNamespace(now=lambda kind, at: {"damping": 0.0}),
    )
    first, second = consistency(problem, fitted)
    assert first > 20.0
    assert second < 2.0
    # The one is as well known as its rows say; of the other the parts say how well.
    calm, wild = (of["damping"] for of in scatter(problem, fitted))
    assert calm == pytest.approx(1.0 / np.linalg.norm(X[:, 0]), rel=0.3)
    few = 2.776 / 1.96  # By t of five.
    assert wild == pytest.approx(few * np.std(b_of, ddof=1) / np.sqrt(parts), rel=0.1)
    # A scatter takes four parts at least.
    problem.blocks, blocks = lambda: np.arange(n) // 334, problem.blocks
    if recordings == 1:
        assert consistency(problem, fitted) == [np.inf, np.inf]
        assert scatter(problem, fitted) == [{}, {}]
    # A damping that the scene has already is none that was found.
    problem.blocks = blocks
    problem.dynamics.now = lambda kind, at: {"damping": 0.3}
    assert consistency(problem, fitted)[0] < 3.0


def test_a_fit_that_one_part_decides_is_as_wide_as_parts_differ():
    """The mean of all parts, each with the same weight, would be known better."""
    rng = np.random.default_rng(8)
    n, parts = 1000, 5
    part = np.repeat(np.arange(parts), n // parts)
    b_of = np.array([0.5, -0.6, 0.4, -0.3, 0.2])
    X = 10.0 * rng.normal(size=(n, 1)) * np.where(part == 0, 30.0, 1.0)[:, None]
    y = X[:, 0] * b_of[part] + rng.normal(size=n)
    best = np.linalg.lstsq(X, y, rcond=None)[0]
    effect = Effect("joint_viscous_damping", ["arm.j1"], {"damping": float(best[0])})
    fitted = SimpleNamespace(
        effects=(effect,), names=((0, "damping"),), J=-X, rows=y - X @ best
    )
    problem = SimpleNamespace(
        train=lambda: np.ones(n, bool), parts=lambda: part,
        blocks=lambda: np.arange(n) // 20,
        widened=lambda end, k: ({"damping": 1e-3}, ()),
    )  # fmt: skip
    [of] = scatter(problem, fitted)
    assert of["damping"] > 0.8 * np.std(b_of, ddof=1)
    # That is what is told of it.
    choice = Choice(effect, {}, 1.0, 0.5, "", 1.0, (), (), 1)
    told = workflow._widened(choice, problem, fitted, [of])
    assert told.std == of
    assert workflow._widened(choice, problem, fitted, [{}]).std == {"damping": 1e-3}
    # A part that knows next to nothing is elsewhere because columns bend: two parts
    # that show a friction and three that do not are no scatter.
    X = 10.0 * rng.normal(size=(n, 1)) * np.where(part < 2, 30.0, 0.02)[:, None]
    y = X[:, 0] * np.where(part < 2, 0.5, -3.0) + rng.normal(size=n)
    best = np.linalg.lstsq(X, y, rcond=None)[0]
    fitted.J, fitted.rows = -X, y - X @ best
    assert scatter(problem, fitted) == [{}]
    # Where one part is all there is to go by, nothing differs from it.
    assert between_parts([1.0, 2.0, 3.0, 4.0], [1e-20, 1.0, 1.0, 1.0]) == 0.0


def test_a_load_that_links_could_imitate_is_the_same_in_each_part():
    """A nuisance shows as the load does but for 1 %; only its tolerance, a tenth of the
    load, keeps it from standing in for it. By the rows alone each part would have
    another load, of either sign."""
    rng = np.random.default_rng(9)
    n, parts, load, prior = 1000, 5, 1.0, 0.1
    x = rng.normal(size=n)
    N = x + 0.01 * rng.normal(size=n)
    y = load * x + rng.normal(size=n)

    def rows(value):  # What is left, and the cost of the nuisance, which is fitted.
        b = N @ (y - value * x) / (N @ N + prior**-2)
        return np.append(y - value * x - b * N, b / prior)

    J = rows(1.0) - rows(0.0)  # It is linear.
    value = float(-(J @ rows(0.0)) / (J @ J))
    effect = Effect("joint_viscous_damping", ["arm.j1"], {"damping": value})
    fitted = SimpleNamespace(
        effects=(effect,), names=((0, "damping"),), J=J[:, None], rows=rows(value)
    )
    problem = SimpleNamespace(
        train=lambda: np.ones(n, bool), parts=lambda: np.arange(n) * parts // n,
        blocks=lambda: np.arange(n) // 20,
        dynamics=SimpleNamespace(now=lambda kind, at: {"damping": 0.0}),
    )  # fmt: skip
    std = 1.0 / np.linalg.norm(J)
    assert abs(value - load) < 3.0 * std and std < 0.15
    assert consistency(problem, fitted)[0] > 5.0
    [of] = scatter(problem, fitted)
    assert of["damping"] < 2.0 * std
    # Parts that do differ contradict it all the same.
    y = np.where(np.arange(n) * parts // n % 2, 3.0, -3.0) * x + rng.normal(size=n)
    value = float(-(J @ rows(0.0)) / (J @ J))
    fitted.effects = (Effect("joint_viscous_damping", ["arm.j1"], {"damping": value}),)
    fitted.rows = rows(value)
    assert consistency(problem, fitted)[0] < 2.0


def test_bounded_nuisances_are_those_of_bounded_least_squares():
    rng = np.random.default_rng(0)
    for _ in range(100):
        n = int(rng.integers(2, 30))
        A = rng.normal(size=(40, n)) * 10.0 ** rng.uniform(-2, 2, n)
        A[:, 0] += 0.9 * A[:, -1]
        H, g = A.T @ A + 1e-6 * np.eye(n), A.T @ rng.normal(size=40)
        limit = np.abs(np.linalg.solve(H, g)) * rng.uniform(0.3, 2.0, n)
        b = boxed_minimum(H, g, limit)
        assert (np.abs(b) <= limit * (1.0 + 1e-9)).all()
        # The other solver's own tolerance is 1e-10 of the objective.
        L = np.linalg.cholesky(H)
        y = np.linalg.solve(L, g)
        least = lsq_linear(L.T, y, (-limit, limit), method="bvls", tol=1e-14).x
        value, want = (0.5 * x @ H @ x - g @ x for x in (b, least))
        assert value <= want + 1e-8 * abs(want)


def test_a_nuisance_at_its_limit_leaves_what_it_may_not_take():
    rng = np.random.default_rng(1)
    m, train = 400, np.arange(400) % 3 != 1
    N, x = rng.normal(size=(m, 2)), rng.normal(size=(m, 1))
    r = 10.0 * N[:, 0] + 2.0 * x[:, 0] + 0.1 * rng.normal(size=m)
    screen = Screen(r, N, np.array([1.0, 1.0]), train, reach=3.0)
    fit = screen.fit(x)
    assert fit.b[0] == pytest.approx(3.0) and abs(fit.b[1]) < 1.5
    # 7 of the first column are left; without a bound the noise of 0.1 would be.
    assert fit.held_out == pytest.approx(7.0, rel=0.15)
    assert screen.wanted(r - 2.0 * x[:, 0])[0] == pytest.approx(10.0, rel=0.01)
    free = Screen(r, N, np.array([1.0, 1.0]), train).fit(x)
    assert free.held_out < 0.3 and free.c[0] == pytest.approx(2.0, abs=0.05)


def test_two_parameters_of_which_only_a_sum_shows_are_flagged():
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(300, 2)).T
    J = np.stack([x, 0.3 * x + 1e-3 * rng.normal(size=300), y], axis=1)
    assert ridges(J).tolist() == [1, 0, -1]
    assert ridges(np.stack([x, x, y], axis=1)).tolist() == [1, 0, -1]  # Exactly.
    assert ridges(np.stack([x, x + y], axis=1)).tolist() == [-1, -1]  # 0.7.
    assert ridges(x[:, None]).tolist() == [-1]


def test_errors_of_parameters_are_correlated_as_their_columns_are_not():
    """Of two columns at 60 degrees: minus their cosine. What is alike goes together."""
    x, y = np.eye(5)[:2]
    J = np.stack([x, 3.0 * (0.5 * x + np.sqrt(0.75) * y)], axis=1)
    np.testing.assert_allclose(correlations(J), [[1, -0.5], [-0.5, 1]], atol=1e-12)
    alike = correlations(np.stack([x, -2.0 * x, y], axis=1))
    np.testing.assert_allclose(alike, [[1, 1, 0], [1, 1, 0], [0, 0, 1]], atol=1e-12)


def test_a_parameter_on_a_part_of_the_rows_is_that_of_a_fit_of_these():
    rng = np.random.default_rng(3)
    J, true = rng.normal(size=(200, 2)), np.array([1.0, -2.0])
    part = np.arange(200) < 80
    y = J @ true + 0.1 * rng.normal(size=200) + np.where(part, 0.5 * J[:, 0], 0.0)
    best = np.linalg.lstsq(J, y, rcond=None)[0]
    want = np.linalg.lstsq(J[part], y[part], rcond=None)[0]
    # Residual model minus data, whose slope is J.
    found = best + gauss_newton(J, J @ best - y, part)
    np.testing.assert_allclose(found, want, atol=1e-9)
    hidden = np.where(part[:, None] & (np.arange(2) == 1), 0.0, J)
    assert np.isnan(gauss_newton(hidden, J @ best - y, part)[1])


def test_blocks_tell_a_gain_of_one_channel_from_chance():
    rng = np.random.default_rng(4)
    n, k = 600, 4
    channel = np.tile(np.arange(k), n)
    train = np.repeat((np.arange(n) // 12) % 3 != 1, k)
    one = rng.normal(size=n * k)
    better = np.where(channel == 2, 0.5, 1.0) * one
    assert paired_t(one, better, train, channel) > 100.0  # The same share everywhere.
    by_chance = [
        paired_t(rng.normal(size=n * k), rng.normal(size=n * k), train, channel)
        for _ in range(100)
    ]
    # Student's t with 16 degrees of freedom: beyond 2 on one side 3 of 100.
    assert np.sum(np.array(by_chance) > 2.0) <= 9
    assert paired_t(one, better, np.ones(n * k, bool), channel) == 0.0


def in_touched_blocks(rng, of, size, touched=(1, 4, 9), n=12, rows=60):
    """What an effect of a size leaves that is seen in some of n held-out blocks alone,
    without and with what is fitted for it to twice as many other blocks."""
    block = np.arange(3 * n * rows) // rows
    train = block % 3 != 1
    column = rng.normal(size=len(block)) * np.isin(block // 3, touched)
    one = of * rng.normal(size=len(block)) + size * column
    fitted = (column[train] @ one[train]) / (column[train] @ column[train])
    return one, one - fitted * column, train


def test_an_effect_that_few_blocks_see_is_sure_if_they_agree():
    rng = np.random.default_rng(0)
    one, two, train = in_touched_blocks(rng, 1.0, 3.0)
    channel = np.zeros(len(one), int)
    blocks = [k for k in np.unique(np.arange(len(one)) // 60) if k % 3 == 1]
    ratio = [np.sum(x[60 * k : 60 * k + 60] ** 2) for k in blocks for x in (one, two)]
    gains = 0.5 * np.log(np.divide(ratio[::2], ratio[1::2]))
    assert np.sum(gains == 0.0) == 9
    of_all = gains.mean() / gains.std(ddof=1) * 12**0.5
    assert of_all < 2.0 < paired_t(one, two, train, channel)
    # Two blocks say too little, and so do three of which one is worse.
    other = in_touched_blocks(rng, 1.0, 3.0, (1, 4))
    assert paired_t(*other, channel) < 2.0
    worse = np.array(two)
    worse[60 * blocks[4] : 60 * blocks[4] + 60] *= 4.0
    assert paired_t(one, worse, train, channel) < 2.0


@pytest.mark.parametrize("touched", [range(3), range(6), range(11)])
def test_few_blocks_are_seldom_sure_of_what_is_not_there(touched):
    """Of a fit to noise, at most as often as Student's t of all blocks is above 2."""
    rng = np.random.default_rng(1)
    of = np.exp(0.5 * rng.normal(size=36)).repeat(60)  # Blocks differ in loudness.
    trials = [in_touched_blocks(rng, of, 0.0, tuple(touched)) for _ in range(1000)]
    sure = [paired_t(*each, np.zeros(len(of), int)) > 2.0 for each in trials]
    assert np.mean(sure) < 0.04


def wandering_noise(n, memory, rng):
    """(n,) of unit variance, correlation exp(-lag / memory)."""
    keep = np.exp(-1.0 / memory)
    return lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.normal(size=n))


def test_what_goes_with_the_motion_is_told_from_noise_that_wanders():
    rng = np.random.default_rng(5)
    n, block = 240, np.arange(240) // 12
    # A slow motion, and noise that goes together for as long as it does.
    hits = repeats = 0
    for _ in range(20):
        q = np.cumsum(wandering_noise(n, 5.0, rng))
        v = np.gradient(q)
        X = np.column_stack([np.sign(v), v, q, q**2, np.sin(q), np.cos(q)])
        noise = wandering_noise(n, 4.0, rng)
        hits += is_predicted(noise, X, block, 0.1)
        repeats += is_predicted(np.sign(v) + noise, X, block, 0.1)
    # By chance, less than one in 120 shifts each; friction as large as the noise is
    # half of the power.
    assert hits <= 1 and repeats >= 17


def test_what_goes_better_with_the_motion_backwards_in_time_is_chance():
    rng = np.random.default_rng(7)
    x, block = rng.normal(size=240), np.arange(240) // 12
    X = np.column_stack([x, x**2])
    assert is_predicted(x + 0.5 * rng.normal(size=240), X, block, 0.1)
    # A fifth of the second is predicted, and four fifths from its end, 24 rows later.
    backwards = x + 2.0 * np.roll(x[::-1], 24)
    assert predictable_share(backwards, X, block) > 0.1
    assert not is_predicted(backwards, X, block, 0.1)


def test_a_predictable_share_is_that_of_the_variance():
    rng = np.random.default_rng(6)
    X, block = rng.normal(size=(4000, 3)), np.arange(4000) // 40
    y = X @ [1.0, -2.0, 0.5] + rng.normal(size=4000) * np.sqrt(5.25)
    # Half of it; of 4000 rows the share is known to 0.02.
    assert predictable_share(y, X, block) == pytest.approx(0.5, abs=0.04)
    assert predictable_share(rng.normal(size=4000), X, block) < 0.01
    assert predictable_share(y, X, np.zeros(4000, int)) == 0.0  # No block to leave out.


def test_noise_of_a_filtered_signal_is_found_beside_a_known_one():
    """White noise behind a first-order filter, of which differences show little, and a
    signal that is late: that is no noise."""
    rng = np.random.default_rng(8)
    n, pole, h = 6000, 0.6, 0.005
    t = h * np.arange(n)
    v, rate = np.sin(2.0 * t), 2.0 * np.cos(2.0 * t)
    noise = lfilter([1.0 - pole], [1.0, -pole], 0.02 * rng.normal(size=n))
    late = -0.01 * rate
    std, together = noise_beside([(noise + late, np.column_stack([v, rate]))])
    # Variance (1 - p)/(1 + p) of the white noise's; autocorrelation p^k, so that
    # (1 + p)/(1 - p) = 4 samples go together. 6000 rows tell both to some per cent.
    assert std == pytest.approx(0.02 * np.sqrt(0.4 / 1.6), rel=0.04)
    assert together == pytest.approx(4.0, rel=0.15)
    white = 0.02 * rng.normal(size=n)
    std, together = noise_beside([(white, np.column_stack([v, rate]))])
    assert std == pytest.approx(0.02, rel=0.04) and together < 1.2


class OneNuisance(GapProblem):
    """Residuals with one nuisance, whose column changes sign from row to row."""

    sizes = None
    plan = SearchPlan()

    def __init__(self, wanted_fitted: float, wanted_held_out: float):
        self._train = np.arange(600) % 3 != 0
        self._column = np.where(np.arange(600) % 2 == 0, 1.0, -1.0)
        noise = np.random.default_rng(0).normal(size=600)
        wanted = np.where(self._train, wanted_fitted, wanted_held_out)
        self._base = noise + wanted * self._column

    def residual(self, effects=()):
        return self._base

    def base(self):
        return self._base

    def train(self):
        return self._train

    def blocks(self):
        return np.arange(600) // 60

    def channel_of_rows(self):
        return np.zeros(600, int)

    def nuisances(self):
        return Nuisances(self._column[:, None], np.ones(1), ("mass",), 3.0)

    def candidates(self, nuisances, current):
        return []

    def where(self, left):
        return []

    def outcome(self, *_args, **_kwargs):
        return None


@pytest.mark.parametrize(
    "fitted, held_out, beyond",
    [
        (10.0, 10.0, True),  # Ten tolerances, on all data: a finding.
        (2.0, 2.0, False),  # Within its limit.
        (10.0, 3.0, False),  # What only the fitted rows want is none.
        (10.0, -3.0, False),
    ],
)
def test_a_nuisance_beyond_its_limit_is_a_finding_if_held_out_data_gain_by_it(
    fitted, held_out, beyond
):
    selection = select(OneNuisance(fitted, held_out))
    assert bool(selection.beyond) == beyond
    if beyond:
        ((name, tolerances),) = selection.beyond
        # At the limit 10 - 3 is left, and noise of 1: the prior weighs 1 + 7^2 against
        # 400 rows. The noise of 400 rows moves it by 0.05.
        expected = 10.0 * 400.0 / (400.0 + 50.0)
        assert name == "mass" and tolerances == pytest.approx(expected, abs=0.2)


class TwoChannels(GapProblem):
    """Two channels of 1.5 times the noise: damping shows in both, a bias in the
    second alone. Both are linear; sizes are shares of the 1.5."""

    sizes = None
    plan = SearchPlan(by_channel=True, least_gain=0.1, most_effects=3)
    dynamics = SimpleNamespace(  # type: ignore[assignment]
        least=lambda kind, at: {},
        now=lambda kind, at: {
            p.name: p.neutral for p in KINDS[kind].parameters if p.neutral is not None
        },
    )

    def __init__(self, damping: float, bias: float):
        n = 18_000
        self._channel, self._block = np.arange(n) % 2, np.arange(n) // 100
        rest, damped, biased = 1.5 * np.random.default_rng(3).normal(size=(3, n))
        biased[self._channel == 0] = 0.0
        self._of = {"joint_viscous_damping": damped, "actuator_bias": biased}
        self._base = rest + damping * damped + bias * biased

    def residual(self, effects=()):
        r = np.array(self._base)
        for each in effects:
            (value,) = each.parameters.values()
            r -= value * self._of[each.kind]
        return r

    def base(self):
        return self._base

    def train(self):
        return self._block % 3 != 1

    def blocks(self):
        return self._block

    def channel_of_rows(self):
        return self._channel

    def nuisances(self):
        return Nuisances.none(len(self._base))

    def candidates(self, nuisances, current):
        return [
            Candidate(kind, (at,), 1, (self._of[kind][:, None],),
                      (lambda c, name=name: {name: float(c[0])},))
            for kind, at, name in (("joint_viscous_damping", "a", "damping"),
                                   ("actuator_bias", "a.j2", "bias"))
        ]  # fmt: skip

    def where(self, left):
        return []

    def outcome(self, *_args, **_kwargs):
        return None


def test_what_helps_a_little_everywhere_keeps_no_effect_of_one_channel_out():
    """The damping takes 8 % off the whole, 9 and 7 % off the channels: not worth an
    effect. The bias takes 7 % off the whole, and 12 % off its channel, which is."""
    problem = TwoChannels(damping=np.sqrt(0.225), bias=np.sqrt(0.36))
    damping = Effect("joint_viscous_damping", ["a"], {"damping": np.sqrt(0.225)})
    bias = Effect("actuator_bias", ["a.j2"], {"bias": np.sqrt(0.36)})
    by_damping, by_bias = (np.std(problem.residual([e])) for e in (damping, bias))
    assert by_damping < by_bias  # On the whole the damping does better.
    (choice,) = select(problem).choices
    assert choice.effect.kind == "actuator_bias" and choice.ties == ()
    # 6000 fitted rows of the channel: to 1.4 %.
    assert choice.effect.parameters["bias"] == pytest.approx(np.sqrt(0.36), abs=0.03)
    # Both leave as much on the whole: in its channel the damping leaves 8 % more.
    (choice,) = select(TwoChannels(damping=np.sqrt(0.2), bias=np.sqrt(0.4))).choices
    assert choice.effect.kind == "actuator_bias" and choice.ties == ()
    # Where no effect is worth it, none is taken.
    assert select(TwoChannels(damping=np.sqrt(0.225), bias=0.0)).choices == ()


class NearTheNoise(TwoChannels):
    """All rows together are near the noise; a bias takes one of two channels, of which
    it is half of the power, to 1.36 times."""

    plan = SearchPlan(by_channel=True, least_gain=0.1, most_effects=3)

    def __init__(self, rows: int):
        super().__init__(damping=0.0, bias=0.0)
        rest, biased = 0.96 * np.random.default_rng(6).normal(size=(2, rows))
        self._channel, self._block = np.arange(rows) % 2, np.arange(rows) // 100
        biased[self._channel == 0] = 0.0
        self._of = {"joint_viscous_damping": np.ones(rows), "actuator_bias": biased}
        self._base = np.where(self._channel == 0, 0.8, 1.0) * rest + biased


def test_one_channel_above_the_noise_is_looked_into_where_all_together_are_near_it():
    """Its error falls by 30 %. With 3000 rows that is beyond doubt (1500 squares less);
    with 400 in four blocks of time, of which the best does not count, it is not."""
    problem = NearTheNoise(3000)
    assert all(1.0 < np.std(NearTheNoise(n).base()) < 1.15 for n in (400, 3000))
    (choice,) = select(problem).choices
    assert choice.effect.kind == "actuator_bias"
    assert choice.effect.parameters["bias"] == pytest.approx(1.0, abs=0.1)
    assert select(NearTheNoise(400)).choices == ()


class BelowTheNoise(TwoChannels):
    """The bias is the truth; a damping that looks much like it leaves 0.7 times the
    noise in place of 0.6. By the weights of the damping it would leave `lighter` times
    as much as it does by the bias's."""

    plan = SearchPlan(least_gain=0.1, most_effects=1, least_error=1.0)

    def __init__(self, lighter: float | None):
        super().__init__(damping=0.0, bias=0.0)
        rest, same, other = np.random.default_rng(5).normal(size=(3, len(self._base)))
        self._of = {"joint_viscous_damping": same + 0.12 * other, "actuator_bias": same}
        self._base, self._lighter = 0.6 * rest + 3.0 * same, lighter

    def weighed_alike(self, one, other):
        if self._lighter is None:
            return []
        r = [self.residual(e) for e in (one, other)]
        size = [self._lighter if e[0].kind == "joint_viscous_damping" else 1.0
                for e in (one, other)]  # fmt: skip
        return [tuple(r), (size[0] * r[0], size[1] * r[1])]


@pytest.mark.parametrize(
    ("lighter", "ties"),
    [
        (None, ["joint_viscous_damping"]),  # Below the noise nothing tells them apart,
        (1.0, []),  # but that one leaves more by the weights of either,
        (0.85, ["joint_viscous_damping"]),  # and not by those of one alone.
    ],
)
def test_below_the_noise_a_rival_is_worse_only_by_the_weights_of_either(lighter, ties):
    (choice,) = select(BelowTheNoise(lighter)).choices
    assert choice.effect.kind == "actuator_bias"
    assert [t.kind for t in choice.ties] == ties


class TwoForces(TwoChannels):
    """A mass (times an acceleration) and a friction (of one size), both below the noise
    in what they leave. Noise of the acceleration makes rows of a model with a larger
    mass lighter. speeds: how much the acceleration changes, as a share of friction."""

    plan = SearchPlan(least_gain=0.05, most_effects=1, least_error=1.0)

    def __init__(self, mass: float, friction: float, speeds: float):
        super().__init__(damping=0.0, bias=0.0)
        rest, change = np.random.default_rng(8).normal(size=(2, len(self._base)))
        self._acts = {"object_mass": 1.0 + speeds * change,
                      "contact_friction": np.ones(len(rest))}  # fmt: skip
        self._needed = mass * self._acts["object_mass"] + friction + 0.2 * rest
        self._weights = None
        self._every = False
        self._base = self.residual()

    def residual(self, effects=()):
        r = np.array(self._needed)
        for e in effects:
            r = r - sum(e.parameters.values()) * self._acts[e.kind]
        weighed = effects if self._weights is None else self._weights
        heavy = sum(e.parameters["mass"] for e in weighed if e.kind == "object_mass")
        return r / np.hypot(0.4, 0.2 * heavy)

    def weighed_by(self, effects, every_row=False):
        alike = copy(self)
        alike._weights, alike._every = list(effects), every_row
        return alike

    def train(self):
        return super().train() | self._every

    def candidates(self, nuisances, current):
        none = {"object_mass": "mass", "contact_friction": "friction"}
        return [
            Candidate(kind, ("a",), 1, (self._acts[kind][:, None] / 0.4,),
                      (lambda c, name=name: {name: float(c[0])},))
            for kind, name in none.items()
        ]  # fmt: skip


def named_forces(**hidden):
    return {
        c.effect.kind: (*c.effect.parameters.values(), [t.kind for t in c.ties])
        for c in select(TwoForces(**hidden)).choices
    }


def test_of_two_rivals_below_the_noise_that_is_named_which_the_other_needs_beside_it():
    found = named_forces(mass=1.2, friction=0.0, speeds=0.1)
    assert list(found) == ["object_mass"] and found["object_mass"][1] == []
    assert found["object_mass"][0] == pytest.approx(1.2, abs=0.02)
    found = named_forces(mass=0.0, friction=1.2, speeds=0.1)
    assert list(found) == ["contact_friction"] and found["contact_friction"][1] == []


@pytest.mark.parametrize(("mass", "friction"), [(1.2, 0.0), (0.0, 1.2)])
def test_rivals_that_differ_by_less_than_laws_are_known_to_are_one(mass, friction):
    """By 2 % of the gap, which many rows tell from nothing by twelve deviations."""
    ((first, (_, ties)),) = named_forces(
        mass=mass, friction=friction, speeds=0.02
    ).items()
    assert {first, *ties} == {"object_mass", "contact_friction"}


def test_two_rivals_that_are_both_needed_are_both_named():
    """One of them leaves less than the noise alone, with a wrong value."""
    found = named_forces(mass=0.7, friction=0.7, speeds=0.2)
    assert set(found) == {"object_mass", "contact_friction"}
    assert found["object_mass"][0] == pytest.approx(0.7, abs=0.05)
    assert found["contact_friction"][0] == pytest.approx(0.7, abs=0.05)
    choices = select(TwoForces(mass=0.7, friction=0.7, speeds=0.2)).choices
    rivals = [c.needed_beside for c in choices]
    assert rivals == [((o.effect.kind, ("a",)),) for o in reversed(choices)]


@pytest.mark.parametrize(("inner", "tried"), [(True, True), (False, False)])
def test_a_patch_s_rivals_are_those_of_friction_where_weights_depend_on_the_model(
    inner, tried
):
    """By slopes a mass half as large again ranks far below; fitted it does as well."""
    ranked = [
        Ranked(
            Candidate(kind, ("a",), size, (np.zeros((4, 1)),), (lambda c: {},)),
            LinearFit(np.zeros(1), np.zeros(1), np.zeros(0), score, score, score),
            (), True, 0,
        )
        for kind, size, score in (("friction_patch", 5, 1.5),
                                  ("contact_friction", 1, 1.6), ("object_mass", 1, 9.0))
    ]  # fmt: skip
    kinds = [r.candidate.kind for r in shortlist(ranked, 10.0, 10, inner)]
    assert ("object_mass" in kinds) == tried and "contact_friction" in kinds


def _picked(trials, correlation=1.0, cost=None):
    """Which of {kind: (size, what it leaves (m,))} is taken; blocks of 30 rows, every
    third is held out. cost: {kind: tolerances by which its nuisance is moved}."""
    m = len(next(iter(trials.values()))[1])
    train = np.arange(m) // 30 % 3 != 1
    search = SimpleNamespace(
        plan=SearchPlan(),
        problem=SimpleNamespace(weighed_by=lambda _: None, correlation=correlation),
        train=train, error=lambda score: score, start=SimpleNamespace(score=1.0),
        nuisances=SimpleNamespace(prior=np.array([0.1])),
    )  # fmt: skip
    search.evidence = partial(Comparison.evidence, search)
    search._evidence = partial(Comparison._evidence, search)
    each = []
    for kind, (size, left) in trials.items():
        score = float(np.sqrt(np.mean(left[~train] ** 2)))
        b = np.array([0.1 * (cost or {}).get(kind, 0.0)])
        fit = SimpleNamespace(
            left=left, score=score, b=b, fit=SimpleNamespace(held_out=score)
        )
        candidate = Candidate(kind, ("a.b",), size, (), ())
        each.append((fit, SimpleNamespace(candidate=candidate)))
    kinds = list(trials)
    return kinds[pick_simplest(search, [Trial(*t) for t in each], [], 10.0)]


@pytest.mark.parametrize(
    ("size", "correlation", "picked"),
    [
        # A line of 0.3 noise units (rms) in 3000 rows: 270, less the block of time that
        # says most and 16 for two parameters; five standard deviations are 25.
        (0.3, 1.0, "link_com"),
        (0.3, 2.0, "link_com"),  # One row in four is independent: 67 less 16.
        (0.3, 3.0, "actuator_bias"),
        (0.1, 1.0, "actuator_bias"),
    ],
)
def test_near_the_noise_a_larger_effect_is_taken_for_what_rows_say(
    size, correlation, picked
):
    noise = np.random.default_rng(4).normal(size=3000)
    line = size * np.sqrt(2.0) * np.sin(0.7 * np.arange(3000))
    # Their errors are within SAME_ERROR of each other.
    trials = {"actuator_bias": (1, noise + line), "link_com": (3, noise)}
    assert _picked(trials, correlation) == picked


@pytest.mark.parametrize(
    ("simple", "larger", "picked"),
    [
        (7.0, 0.0, "link_com"),  # 49, less 16 for two parameters.
        (6.0, 0.0, "actuator_bias"),
        (7.0, 4.0, "actuator_bias"),  # It moves nuisances too.
    ],
)
def test_of_two_that_leave_the_same_the_one_that_strains_nuisances_gives_way(
    simple, larger, picked
):
    left = np.random.default_rng(4).normal(size=3000)
    trials = {"actuator_bias": (1, left), "link_com": (3, left)}
    cost = {"actuator_bias": simple, "link_com": larger}
    assert _picked(trials, cost=cost) == picked


def test_no_single_stretch_of_time_and_no_fitted_row_alone_decides():
    noise = np.random.default_rng(4).normal(size=3000)
    line = 0.3 * np.sqrt(2.0) * np.sin(0.7 * np.arange(3000))
    once, fitted = np.zeros(3000), line * (np.arange(3000) // 30 % 3 != 1)
    once[1500:1530] = 3.0  # 270 at once, as all of the line.
    for off in (once, fitted + 0.01 * noise - 0.02 * noise * (fitted == 0.0)):
        trials = {"actuator_bias": (1, noise + off), "link_com": (3, noise)}
        assert _picked(trials) == "actuator_bias"


def test_one_that_has_the_smaller_effect_as_a_special_case_must_gain_more():
    noise = np.random.default_rng(4).normal(size=3000)
    line = 0.3 * np.sqrt(2.0) * np.sin(0.7 * np.arange(3000))
    trials = {
        "joint_coulomb_friction": (1, noise + line),
        "joint_stribeck_friction": (3, noise),
    }
    assert _picked(trials) == "joint_coulomb_friction"


class FoundTwice(TwoForces):
    """The same kind at one place is a candidate twice, for fits that end elsewhere: the
    second leaves 1 % less, and is the larger change."""

    def candidates(self, nuisances, current):
        (first,) = [c for c in super().candidates(nuisances, current)
                    if c.kind == "contact_friction"]  # fmt: skip
        other = replace(
            first, to_parameters=(lambda c: {"friction": 1.01 * float(c[0])},)
        )
        return [first, other]

    def residual(self, effects=()):
        # Two valleys, of which the one farther off is a little deeper.
        off = [e.parameters["friction"] for e in effects]
        far = bool(off) and off[0] > 1.2045
        return super().residual(effects) * (0.99 if far else 1.0)

    def change(self, effect):
        return abs(effect.parameters["friction"])


def test_what_is_found_twice_is_no_rival_of_itself():
    (choice,) = select(FoundTwice(mass=0.0, friction=1.2, speeds=0.1)).choices
    assert choice.ties == ()
    assert choice.effect.parameters["friction"] < 1.2045


class Wavering(TwoChannels):
    """Five recordings, in each of which the bias is another."""

    def __init__(self, biases):
        super().__init__(damping=0.0, bias=0.0)
        n = len(self._base)
        self._part = np.arange(n) * 5 // n
        self._base = (
            self._base + np.array(biases)[self._part] * self._of["actuator_bias"]
        )

    def parts(self):
        return self._part


def test_an_effect_that_recordings_contradict_is_not_named():
    (choice,) = select(Wavering([1.0, 1.3, 0.8, 1.1, 0.7])).choices
    assert choice.effect.kind == "actuator_bias"
    # Its mean takes a fifth off the channel, but it is of another sign from one
    # recording to the next.
    assert select(Wavering([9.0, -1.5, 7.0, -2.0, 5.5])).choices == ()


@pytest.mark.parametrize(("spread", "named"), [(0.5, 1), (50.0, 0)])
def test_an_effect_whose_reported_interval_holds_the_scenes_value_is_not_named(
    monkeypatch, spread, named
):
    """(A force of 0.05 +- 0.3 N, of which slopes say 0.01 N.)"""
    monkeypatch.setattr(drop, "scatter", lambda problem, fitted: [{"bias": spread}])
    assert len(select(Wavering([1.0, 1.3, 0.8, 1.1, 0.7])).choices) == named


@pytest.mark.parametrize(
    "damping, std, named",
    [(0.0, np.inf, True), (2.0, 0.5, True), (2.0, np.inf, False)],
)
def test_a_parameter_at_its_limit_has_no_interval_that_could_be_infinite(
    damping, std, named
):
    """A spring whose damping comes out zero, which it cannot be less than."""
    spring = Effect("joint_elasticity", ["a.j"], {"stiffness": 1e3, "damping": damping})
    choice = Choice(
        spring, {"stiffness": 50.0, "damping": std}, 2.0, 1.0, "", 1.0, (), (), 2
    )
    assert is_significant(choice) == named


@pytest.mark.parametrize(
    "after, spread, alone, named",
    [
        (1.78, np.inf, True, True),
        (1.82, np.inf, True, False),
        (1.9, 1e-3, True, True),
        (1.52, np.inf, False, False),
        (1.48, np.inf, False, True),
        (1.9, 1e-3, False, True),
    ],
)
def test_whether_a_patch_is_there_is_told_by_held_out_rows(after, spread, alone, named):
    """Its friction and its sides make up for one another: their intervals are infinite
    where its being there is sure. One that few rows are on takes little off them all,
    and is told by its intervals. Beside others it must take a quarter."""
    sides = {"x_min": 0.0, "x_max": 0.1, "y_min": 0.0, "y_max": 0.1}
    patch = Effect("friction_patch", ["a.a~b.b"], {"friction": 0.5} | sides)
    std = dict.fromkeys(patch.parameters, spread)
    choice = Choice(patch, std, 2.0, after, "", 1.0, (), (), 5)
    assert is_significant(choice, alone) == named


@pytest.mark.parametrize(
    "after, slopes, far, others, named",
    [
        (1.9, 1e-3, np.inf, 1, False),
        (1.9, 1e-3, 1e-3, 1, True),
        (1.9, np.inf, 1e-3, 1, False),
        (1.9, 1e-3, np.inf, 0, True),
        (1.48, 1e-3, np.inf, 1, True),
    ],
)
def test_a_patch_beside_others_is_told_by_how_far_it_may_end(
    after, slopes, far, others, named
):
    """Slopes at its end give it narrow intervals; moved, its sides lose nothing."""
    sides = {"x_min": 0.0, "x_max": 0.1, "y_min": 0.0, "y_max": 0.1}
    patch = Effect("friction_patch", ["a.a~b.b"], {"friction": 0.5} | sides)
    at_end = dict.fromkeys(patch.parameters, slopes)
    choice = Choice(patch, at_end, 2.0, after, "", 1.0, (), (), 5)
    moved = {"friction": 1e-3} | dict.fromkeys(sides, far)
    problem = SimpleNamespace(
        sizes=None, widened=lambda end, k: (moved, ()), least=lambda kind, at: {}
    )
    search = SimpleNamespace(problem=problem, plan=SearchPlan())
    chosen = [choice, *others * [replace(choice)]]
    assert _is_certain(search, chosen, None, 0) == named


@pytest.mark.parametrize(
    ("friction", "far", "or_more", "named"),
    [(0.32, 0.08, (), False), (0.32, 0.02, (), True), (0.5, 0.2, ("friction",), True)],
)
def test_a_friction_that_may_be_what_the_scene_has_is_not_named(
    friction, far, or_more, named
):
    """Slopes give it a narrow interval, and held-out rows let it go to 0.388; but what
    sticks may have any larger one."""
    effect = Effect("contact_friction", ["box.box~tip.tip"], {"friction": friction})
    choice = Choice(effect, {"friction": 0.01}, 1.7, 1.3, "", 1.0, (), (), 1)
    dynamics = SimpleNamespace(now=lambda kind, at: {"friction": 0.388})
    problem = SimpleNamespace(
        widened=lambda end, k: ({"friction": far}, or_more),
        sizes=None,
        dynamics=dynamics,
        least=lambda kind, at: {},
    )
    search = SimpleNamespace(problem=problem, plan=SearchPlan())
    assert _is_certain(search, [choice], None, 0) == named


def test_evidence_of_what_a_simulation_leaves_counts_what_its_nuisances_cost():
    """As that of a fit: of two that leave the same the one with less of it."""
    rng = np.random.default_rng(4)
    search = object.__new__(Comparison)
    search.train = np.arange(200) % 30 < 20
    search.nuisances = SimpleNamespace(prior=np.array([0.1, 2.0]))  # type: ignore[assignment]
    search.problem = SimpleNamespace(correlation=1.0)  # type: ignore[assignment]
    search.start = SimpleNamespace(score=1.0)  # type: ignore[assignment]
    left, fit = rng.normal(size=200), SimpleNamespace(held_out=1.0)
    # The last is a column beside the nuisances, which costs nothing.
    one = SimpleNamespace(b=np.array([0.0, 2.0, 9.0]), left=left, fit=fit)
    other = SimpleNamespace(b=np.array([0.3, -4.0]), left=left, fit=fit)
    evidence = search.evidence_against(one.b, left, fit, other, 0)  # type: ignore[arg-type]
    assert evidence == pytest.approx((9.0 + 4.0) - 1.0)
    one.b = one.b[:2]
    assert search.evidence(one, other, 0) == pytest.approx(evidence)  # type: ignore[arg-type]


def test_evidence_of_columns_counts_what_nuisances_cost_beside_them():
    """What a column does, a nuisance five tolerances from its value does as well."""
    rng = np.random.default_rng(4)
    N, own, other = rng.normal(size=(3, 400, 1))
    prior, r = np.array([0.1]), 0.5 * N[:, 0] + 1e-3 * rng.normal(size=400)
    search = object.__new__(Comparison)
    search.train = np.arange(400) % 30 < 20
    search.nuisances = SimpleNamespace(prior=prior)  # type: ignore[assignment]
    search.problem = SimpleNamespace(correlation=1.0)  # type: ignore[assignment]
    search.start = SimpleNamespace(score=1.0)  # type: ignore[assignment]
    screen = Screen(1e3 * r, 1e3 * N, prior, search.train)
    cheap, costly = 1e3 * (N + 1e-9 * own), 1e3 * other
    for one, two, cost in ((cheap, costly, 25.0), (costly, cheap, -25.0)):
        evidence = search.evidence_by_columns(screen, one, two)
        assert evidence == pytest.approx(cost, abs=6.0)


@pytest.mark.parametrize(
    ("score", "alone", "named"),
    [(0.96, False, False), (0.94, False, True), (0.96, True, True)],
)
def test_what_evidence_takes_must_show_by_the_last_weights(score, alone, named):
    """Where evidence alone is not enough: where errors jump, steps of another length
    are evidence for a damping, which takes nothing off."""
    effect = Effect("joint_viscous_damping", ["a.j"], {"damping": 0.1})
    choice = Choice(effect, {"damping": 0.01}, 1.0, score, "", 1.0, (), (), 1)
    search = object.__new__(Comparison)
    search.plan = SearchPlan(
        counts_evidence=True, least_gain=0.05, evidence_alone=alone
    )
    search.start = SimpleNamespace(score=1.0)  # type: ignore[assignment]
    search.problem = SimpleNamespace(sizes=None, least=lambda kind, at: {})  # type: ignore[assignment]
    current = SimpleNamespace(score=score)
    assert _is_certain(search, [choice], current, 0) == named  # type: ignore[arg-type]


def test_moments_of_inertia_are_named_where_one_of_them_is_not_the_scenes():
    now = {"ixx": 7e-5, "iyy": 7e-5, "izz": 7e-5}
    found = {"ixx": 2.5e-4, "iyy": 2.6e-4, "izz": 2.5e-4}
    effect = Effect("object_inertia", ["ball.ball"], found)
    for std, named in ((2e-4, False), (1e-4, True)):
        of = dict.fromkeys(now, std)
        choice = Choice(effect, of, 1.2, 1.0, "", 1.0, (), (), 3)
        assert (deviations_off(choice, now) > 1.0) == named
        # The scene does not say what they are.
        assert deviations_off(choice, {}) == np.inf


@pytest.mark.parametrize(
    "score, still, kept",
    [(1.3, 1.0, True), (1.02, 1.0, False), (1.3, 1.28, False), (1.3, 1.2, True)],
)
def test_a_refit_along_what_fitted_rows_do_not_tell_is_not_taken(
    monkeypatch, score, still, kept
):
    """The old fit is weighed as the new one is, and is what it leaves by that."""
    effect = Effect("friction_patch", ["a.a~b.b"], {"friction": 0.5})
    left = np.arange(4.0)
    old = SimpleNamespace(
        effects=(effect,), score=1.0, r=left, fit=SimpleNamespace(train=1.0)
    )
    new = SimpleNamespace(effects=(effect,), score=score)

    def fit(problem, screen, effects, fixed, evaluations=None):
        if evaluations is None:
            return new
        # No step is taken: the parameters are the old ones.
        assert evaluations == 1 and effects == [effect]
        return SimpleNamespace(effects=(effect,), score=still, r=screen)

    search = object.__new__(Comparison)
    search.problem = SimpleNamespace(
        residual=lambda effects: 2.0 * left, permitted=list
    )
    search.error = lambda error: error
    search.screen = lambda r, scale: r
    monkeypatch.setattr(comparison, "fit_effects", fit)
    choice = Choice(effect, {}, 2.0, 1.0, "", 1.0, (), (), 5)
    found = search.refit([choice], old)
    assert (found is not new) == kept
    if kept:
        assert found.score == still
        np.testing.assert_array_equal(found.r, 2.0 * left)


def windows_leave(before: float, after: float) -> GapMeasure:
    return GapMeasure(before, after, 1.0, 0.3)


def a_backlash() -> Choice:
    return Choice(Effect("joint_backlash", ["a.j"], {"gap": 0.02}), {"gap": 1e-3},
                  9.0, 3.0, "", 1.0, (), (), 1)  # fmt: skip


@pytest.mark.parametrize(
    "choices, before, verdict, said",
    [
        (0, 2.1, "gap_unnamed", "2.1 times"),
        (0, 3695.0, "gap_unnamed", "3700 times"),
        (0, 1.9, "no_gap", ""),
        (1, 9.0, "gap_named", ""),
    ],  # fmt: skip
)
def test_an_agreement_that_simulation_does_not_show_at_the_end_is_taken_back(
    choices, before, verdict, said
):
    some = [a_backlash()] * choices
    reported = windows_leave(before, before)
    found, words = decide(Facts(some, 1.0, 1.0, reported=reported))
    assert found == verdict and (said in words) and bool(words) == bool(said)


@pytest.mark.parametrize("after, closed", [(8.04, "12%"), (5.24, "47%")])
def test_candidates_that_close_too_little_are_told_with_their_value(after, closed):
    facts = Facts([a_backlash()], 9.0, after, chosen_on=windows_leave(9.0, after))
    ((_, why),) = too_weak(facts, 1.0 - (after - 1.0) / 8.0, lambda *_: False)
    assert f"closes {closed} of the gap" in why
    near = Facts([a_backlash()], 9.0, 2.5, chosen_on=windows_leave(9.0, 2.5))
    assert too_weak(near, 0.9, lambda *_: False) == []
    each = Tried("joint_backlash", ("a.j",), {"gap": Estimate(0.02, 1e-3, "rad")},
                 "", why)  # fmt: skip
    text = says_tried([each])
    assert "joint_backlash at a.j (gap 0.0200 +- 0.0010 rad)" in text and why in text


def test_where_simulation_shows_no_gap_any_more_equations_find_none():
    choices = [a_backlash()]
    assert decide(Facts(choices, 13.5, 3.4))[0] == "gap_unnamed"  # A quarter is left.
    for before, after, far, expected in (
        (4.3, 1.1, False, "gap_named"),
        (4.3, 1.1, True, "gap_unnamed"),  # The model would have to be off too far.
        (4.3, 1.8, False, "gap_unnamed"),
        (1.2, 1.1, False, "gap_unnamed"),  # Windows that do not show the gap.
    ):
        gap = windows_leave(before, after)
        assert decide(Facts(choices, 13.5, 3.4, far, gap))[0] == expected
    worse = windows_leave(2.5, 2.6)
    assert decide(Facts(choices, 9.0, 1.0, chosen_on=worse))[0] == "gap_unnamed"
    none = Facts((), 13.5, 13.5, chosen_on=windows_leave(4.3, 1.1))
    assert decide(none)[0] == "gap_unnamed"


@pytest.mark.parametrize(
    "steady, windows, verdict",
    [(1.1, 0.9, "no_gap"), (2.5, 0.9, "gap_unnamed"), (1.1, 1.4, "gap_unnamed")],
)
def test_no_single_stretch_of_equations_makes_a_gap(steady, windows, verdict):
    shown = windows_leave(windows, windows)
    facts = Facts((), 2.4, 2.4, chosen_on=shown, steady=steady)
    assert decide(facts)[0] == verdict


def test_the_steady_error_is_without_the_loudest_block():
    block = np.repeat(np.arange(6), 10)
    left = np.where(block == 3, 9.0, 0.5)
    problem = SimpleNamespace(
        train=lambda: block == 0, in_noise=lambda x: x, blocks=lambda: block,
        error=lambda fitted: 4.0,
    )  # fmt: skip
    fitted = SimpleNamespace(left=left)
    assert GapProblem.steady_error(problem, fitted) == pytest.approx(0.5)
    problem.train = lambda: block < 3
    assert GapProblem.steady_error(problem, fitted) == 4.0  # Of three blocks.


@pytest.mark.parametrize(
    "verdict, after, taken",
    [("gap_named", 9.0, True), ("gap_unnamed", 5.0, True), ("gap_unnamed", 9.0, False),
     ("not_judged", float("nan"), False)],
)  # fmt: skip
def test_another_comparison_counts_where_it_closes_more(verdict, after, taken):
    one, other = (
        SimpleNamespace(verdict=v, gap=windows_leave(10.0, x))
        for v, x in ((verdict, after), ("gap_unnamed", 8.0))
    )
    assert workflow.explains_more(one, other) == taken


def test_slopes_follow_what_a_step_did_while_it_is_nearly_what_they_said():
    asked = []

    def bent_by(bend, z):
        asked.append(np.array(z))
        x, y = z
        return np.array([x + 0.1 * x**2, 2.0 * y, x * y * bend, 1.0])

    problem = SimpleNamespace(
        apart=lambda start, names: [], plan=SimpleNamespace(diff_step=1e-6),
        prior_rows=lambda effects: np.zeros(0), by_equations=False,
    )  # fmt: skip
    free = SimpleNamespace(
        start=[Effect("bend", ["a"], {})], names=((0, "x"), (0, "y")),
        high=np.full(2, np.inf), scale=np.ones(2), effects=lambda z: z,
    )  # fmt: skip
    for bend, anew in ((0.0, False), (5.0, True)):
        residual = partial(bent_by, bend)
        slopes = fit._Slopes(problem, free, residual, residual, lambda r: r)
        there, then = np.array([1.0, 1.0]), np.array([1.5, 2.0])
        first = slopes(there)
        asked.clear()
        J = slopes(then)
        assert (len(asked) > 1) == anew
        if anew:
            exact = [[1.3, 0.0], [0.0, 2.0], [5.0 * 2.0, 5.0 * 1.5], [0.0, 0.0]]
            np.testing.assert_allclose(J, exact, atol=1e-4)
        else:  # The secant's condition (Broyden 1965).
            change = residual(then) - residual(there)
            np.testing.assert_allclose(J @ (then - there), change, atol=1e-9)
            assert not slopes.are_exact and not np.allclose(J, first)


class TwoJoints(MechanismProblem):
    """What is left of two joints' equations and of a velocity, in units of noise."""

    def __init__(self, start, end):
        self._left = {"start": np.tile(start, 100), "end": np.tile(end, 100)}

    def train(self):
        return np.arange(300) // 60 % 2 == 0

    def names(self):
        return [("effort", "a.j1"), ("effort", "a.j2"), ("velocity", "a.j1")]

    def channel_of_rows(self):
        return np.tile(np.arange(3), 100)

    def in_noise(self, left):
        return left

    def error(self, fitted):
        return float(np.sqrt(np.mean(fitted.left**2)))

    def share(self):
        ends = (SimpleNamespace(left=self._left[k]) for k in ("start", "end"))
        return self.closed(*ends)


@pytest.mark.parametrize(
    "start, end, closed",
    [
        # A joint whose effort nothing explains hides nothing of what another shows.
        ((40.0, 11.0, 1.0), (40.0, 3.0, 1.0), 0.8),
        # Half of a gap of less than twice the noise is no half of anything.
        ((40.0, 1.9, 1.0), (40.0, 1.0, 1.0), 0.0),
        # A velocity's filter closes no joint's equation.
        ((40.0, 11.0, 9.0), (40.0, 11.0, 1.0), 0.02),
        ((11.0, 11.0, 11.0), (1.0, 1.0, 1.0), 1.0),
    ],
)
def test_equations_are_closed_where_an_effect_acts(start, end, closed):
    assert TwoJoints(start, end).share() == pytest.approx(closed, abs=0.02)


class Simulated(TwoChannels):
    """Windows that leave so much with two effects, with the first alone, and none."""

    def __init__(self, both: float, one: float):
        super().__init__(damping=1.0, bias=1.0)
        self._left = {2: both, 1: one, 0: 9.0}
        self._of["joint_backlash"] = self._of.pop("actuator_bias")

    def outcome(self, effects, *_args, **_kwargs):
        return Outcome(windows_leave(9.0, self._left[len(effects)]))


@pytest.mark.parametrize(
    "both, one, kept", [(2.0, 3.0, 2), (3.0, 3.0, 1), (4.0, 3.0, 1)]
)
def test_a_gap_in_a_gear_that_windows_do_not_show_is_dropped(both, one, kept):
    problem = Simulated(both, one)
    effects = [Effect("joint_viscous_damping", ["a"], {"damping": 0.9}),
               Effect("joint_backlash", ["a.j2"], {"gap": 0.9})]  # fmt: skip
    nuisances, fixed = problem.nuisances(), [(), ("restitution",)]
    screen = Screen(problem.base(), nuisances.columns, nuisances.prior, problem.train())
    start, end = (
        fit_effects(problem, screen, e, fixed[: len(e)]) for e in ([], effects)
    )
    choices = tuple(
        Choice(e, {}, 2.0, 1.0, "", 1.0, (), f, 1)
        for e, f in zip(end.effects, fixed, strict=True)
    )
    selection = Selection(choices, start, end, nuisances)
    left, outcome = chosen_by_simulation(problem, selection, 1)
    assert len(left.choices) == kept and outcome.gap.after == min(both, one)
    assert left.choices[0].effect.kind == "joint_viscous_damping"
    # What stays is fitted again without it: of 18,000 rows to 1 %.
    damping = left.choices[0].effect.parameters["damping"]
    assert damping == pytest.approx(1.0, abs=0.03)
    assert (left.end is end) == (kept == 2)
    # Alone it is judged as any other.
    alone = replace(selection, choices=choices[1:])
    assert chosen_by_simulation(problem, alone, 1)[0] is alone


def test_a_fit_goes_beyond_what_is_searched_but_for_what_ends():
    """A patch with ever more friction would shrink to a point; what holds may have any
    friction that is enough."""
    highest = {
        (kind, name): fit.highest(kind, name)
        for kind, name in (("friction_patch", "friction"), ("friction_patch", "x_max"),
                           ("contact_friction", "friction"))
    }  # fmt: skip
    assert list(highest.values()) == [1.5, np.inf, 1.5]


@pytest.mark.parametrize("sampled", [1, 3])
def test_a_jump_of_a_measured_effort_is_known_to_within_a_period(sampled):
    """Against jumps at random times: the spread of what a mean over a test function
    is off by, where the effort has every row or every third."""
    rng, dt, jump = np.random.default_rng(1), 0.008, 10.0
    time = dt * np.arange(100)
    bumps = make_bumps(time, np.full(100, dt), 0.2, 0.1)
    fine = np.arange(0.0, time[-1], 1e-5)
    exact = make_bumps(fine, np.full(len(fine), 1e-5), 0.2, 0.1)
    model = SimpleNamespace(joints=["a"], by_measured=[True], effort_noise=[1e-3])
    offs, stds = [], []
    for at in rng.uniform(0.3, 0.3 + sampled * dt, 40):
        y = np.full(100, np.nan)
        there = np.arange(0, 100, sampled)
        y[there] = np.where(time[there] < at, 0.0, jump)
        track = SimpleNamespace(samples={"a.effort_measured": y}, row_bumps=bumps,
                                bumps=bumps)  # fmt: skip
        stds.append(WhitenedRows._unknown_jumps(model, track)[:, 0])
        seen = np.interp(fine, time[there], y[there]) - np.where(fine < at, 0.0, jump)
        n = len(bumps.centre)
        offs.append(exact.mean(seen)[:n])
    off, std = np.std(offs, axis=0), np.sqrt(np.mean(np.square(stds), axis=0))
    near = np.abs(bumps.centre[: len(off)] - 0.3) < 0.06
    assert near.sum() >= 1
    np.testing.assert_allclose(std[: len(off)][near], off[near], rtol=0.3)
    assert std[bumps.centre > 0.5].max() == 0.0


def test_a_jump_that_has_decayed_between_samples_may_have_been_anything():
    """A drive that answers a step with all it has for a millisecond, sampled each four:
    of samples, what a mean is off by is no more than said; of one that holds its step,
    and of a slow answer, no more is said than the jump tells."""
    rng, noise, period = np.random.default_rng(3), 0.01, 0.004
    time, fine = period * np.arange(800), np.arange(0.0, 3.2, 1e-5)
    starts = 0.1 * np.arange(1, 31) + rng.uniform(0.0, period, 30)

    def answers(t, fast: float, slow: float) -> np.ndarray:
        y = np.zeros(len(t))
        for at in starts:
            u = np.maximum(t - at, 0.0)
            y += (t >= at) * (40.0 * np.exp(-u / fast) + 5.0 * np.exp(-u / slow))
        return y

    exact = answers(fine, 1e-3, 0.012)
    y = answers(time, 1e-3, 0.012) + noise * rng.normal(size=len(time))
    off = np.array([
        np.trapezoid(exact[a : a + 401], dx=1e-5) - 0.5 * period * (y[k] + y[k + 1])
        for k, a in ((k, round(time[k] / 1e-5)) for k in range(798))
    ])  # fmt: skip
    said = period * np.sqrt(jump_variance(y, noise))
    hit = np.searchsorted(time, starts) - 1
    # Of an interval both rows at its ends are less sure.
    std = np.hypot(said[hit], said[hit + 1])
    assert np.sqrt(np.mean((off[hit] / std) ** 2)) < 1.2
    others = np.setdiff1d(
        np.arange(798), np.concatenate([hit + k for k in (-1, 0, 1, 2)])
    )
    assert said[others].max() < 0.02 * std.min()
    held = np.where(time % 0.1 < 0.05, 0.0, 5.0) + noise * rng.normal(size=len(time))
    slow = answers(time, 0.1, 0.1) + noise * rng.normal(size=len(time))
    for signal in (held, slow):
        jumps = np.abs(np.diff(signal)).max()
        assert np.sqrt(jump_variance(signal, noise).max()) < 1.1 * jumps / np.sqrt(24.0)


def test_a_smooth_effort_has_no_jumps():
    time = 0.008 * np.arange(200)
    y = 30.0 * np.sin(10.0 * time) + np.random.default_rng(2).normal(0.0, 0.01, 200)
    bumps = make_bumps(time, np.full(200, 0.008), 0.2, 0.1)
    model = SimpleNamespace(joints=["a"], by_measured=[True], effort_noise=[0.01])
    track = SimpleNamespace(samples={"a.effort_measured": y}, row_bumps=bumps,
                            bumps=bumps)  # fmt: skip
    assert WhitenedRows._unknown_jumps(model, track).max() == 0.0


def test_how_late_poses_are_is_read_by_name():
    """By the weights that were learned a body's clock may be one nuisance of others
    than before."""
    problem = SimpleNamespace(
        bodies=["a", "b"], rich_nuisances={"clock of a": 0.02},
        nuisances=lambda: SimpleNamespace(
            names=("mass of b", "clock of b", "mass of a", "clock of a"),
            prior=np.full(4, 1e-3),
        ),
    )  # fmt: skip
    assert wanted(problem) == {"a": 0.02}


class Line(GapProblem):
    """Rows that are linear in two frictions, or bent; how often they are asked for."""

    sizes = None
    by_equations = True
    plan = SearchPlan()
    dynamics = SimpleNamespace(now=lambda kind, at: {}, least=lambda kind, at: {})

    def __init__(self, bend: float):
        rng = np.random.default_rng(0)
        self.X, self.bend, self.asked = rng.normal(size=(60, 2)), bend, 0
        self._base = 0.3 * rng.normal(size=60) + self.X @ [2.0, 1.0]

    def residual(self, effects=()):
        self.asked += 1
        x = [sum(e.parameters["coulomb"] for e in effects if e.at == [j]) for j in "ab"]
        return self._base - self.X @ x - self.bend * self.X[:, 0] * x[0] * x[1]

    def base(self):
        return self._base

    def train(self):
        return np.ones(60, bool)

    def blocks(self):
        return np.arange(60) // 6

    def channel_of_rows(self):
        return np.zeros(60, int)

    def nuisances(self):
        return Nuisances.none(60)

    def candidates(self, nuisances, current):
        return []

    def where(self, left):
        return []

    def outcome(self, *_, **__):
        return None

    def fitted(self, *at):
        start = [Effect("joint_coulomb_friction", [j], {"coulomb": 0.5}) for j in at]
        screen = Screen(self.base(), np.zeros((60, 0)), np.zeros(0), self.train())
        self.asked = 0
        return fit.fit_effects(self, screen, start)


@pytest.mark.parametrize("bend", [0.0, 3.0])
def test_slopes_of_one_fit_serve_the_next_where_they_hold(bend):
    problem, alone = Line(bend), Line(bend)
    problem.fitted("a")
    problem.fitted("b")
    known = problem.fitted("a", "b")
    asked = problem.asked
    anew = alone.fitted("a", "b")
    for one, other in zip(known.effects, anew.effects, strict=True):
        assert one.parameters == pytest.approx(other.parameters, rel=1e-4)
    assert known.std[0] == pytest.approx(anew.std[0], rel=0.05)
    # Both columns are there; where they are others beside each other, that is seen.
    assert (asked < alone.asked) == (bend == 0.0)
    problem._base = problem._base.copy()  # In other weights.
    again = problem.fitted("a", "b")
    assert problem.asked >= alone.asked and again.effects == pytest.approx(anew.effects)


def test_one_cause_stands_in_the_place_of_many_and_none_of_what_undoes_it():
    rng = np.random.default_rng(0)
    many = rng.normal(size=(600, 5))
    one = many.sum(axis=1) + rng.normal(size=600)
    columns = np.column_stack([one, many])
    noise = rng.normal(size=600)
    c, gained = in_place_of_others(columns, 2.0 * one + 3.0 * many[:, 2] + noise, 1.0)
    np.testing.assert_array_equal(np.flatnonzero(c), [0, 3])
    np.testing.assert_allclose(c[[0, 3]], [2.0, 3.0], atol=0.2)  # 5 deviations.
    # Without it 2^2 a row is left, and four more parameters are needed.
    assert gained == pytest.approx(4.0 * 600, rel=0.2)
    for r in (3.0 * many[:, 2], -2.0 * one, 2.0 * (one - many.sum(axis=1))):
        assert in_place_of_others(columns, r + noise, 1.0)[1] <= 0.0


@pytest.mark.parametrize(("both", "taken"), [(0.55, False), (0.45, True)])
def test_two_effects_leave_less_than_either_alone(monkeypatch, both, taken):
    """A door's damping and a joint's drag left 0.55, its mass alone 0.49."""

    def leaving(score):
        return SimpleNamespace(fit=SimpleNamespace(score=score))

    pair, none = leaving(both), object()
    monkeypatch.setattr(add, "fit_each", lambda *_: [pair])
    monkeypatch.setattr(add, "pair_instead", lambda *_: none)
    trials = [leaving(0.62), leaving(0.49)]
    found = add._pair(None, object(), (None, None), [], [], trials, 0)
    assert found is (pair if taken else none)
