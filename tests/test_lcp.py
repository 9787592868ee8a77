from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog

from makebreak.systems.numerics.lcp import SOLVED, solve_lcp, solve_lcp_kernel


def brute_force_lcp(F, q):
    """Tries all 2^n contact modes; a lam that satisfies the definition, or None."""
    for mode in product([False, True], repeat=len(q)):
        lam, on = np.zeros(len(q)), np.flatnonzero(mode)
        lam[on] = np.linalg.lstsq(F[np.ix_(on, on)], -q[on], rcond=None)[0]
        w = F @ lam + q
        if (lam >= -1e-9).all() and (w >= -1e-9).all() and abs(w @ lam) < 1e-9:
            return np.maximum(lam, 0.0)
    return None


def assert_solves(F, q, lam):
    """The definition, to 1e-9 of the size of the terms that are summed."""
    size = np.abs(q) + np.abs(F) @ lam + np.finfo(float).tiny
    w = F @ lam + q
    assert (lam >= 0.0).all()
    assert (w >= -1e-9 * size.max()).all()
    assert (
        np.minimum(np.abs(w) / size.max(), lam / max(lam.max(), 1e-300)) < 1e-9
    ).all()


@pytest.mark.parametrize("seed", range(20))
def test_positive_definite_F_agrees_with_brute_force(seed):
    rng = np.random.default_rng(seed)
    J, q = rng.normal(size=(6, 6)), rng.normal(size=6)
    F = J @ J.T + 0.1 * np.eye(6)  # Condition < 400, so 1e-16 grows to 1e-13 at most.
    np.testing.assert_allclose(solve_lcp(F, q), brute_force_lcp(F, q), atol=1e-11)


@pytest.mark.parametrize("seed", range(20))
def test_singular_F_agrees_with_brute_force_in_w(seed):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(8, 3))
    F = J @ J.T
    q = np.maximum(rng.normal(size=8), 0.0) - F @ np.maximum(rng.normal(size=8), 0.0)
    lam = solve_lcp(F, q)
    assert_solves(F, q, lam)
    # lam is not unique but F lam is, for symmetric F.
    np.testing.assert_allclose(F @ lam, F @ brute_force_lcp(F, q), atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_unsymmetric_semidefinite_F_is_solved(seed):
    rng = np.random.default_rng(seed)
    J, S = rng.normal(size=(7, 2)), rng.normal(size=(7, 7))
    F = J @ J.T + S - S.T
    q = -F @ np.maximum(rng.normal(size=7), 0.0) + np.maximum(rng.normal(size=7), 0.0)
    assert_solves(F, q, solve_lcp(F, q))


def test_it_raises_exactly_where_no_w_is_feasible():
    # For semi-definite F a solution exists if and only if some lam >= 0 has w >= 0,
    # which a linear program decides.
    rng, raised = np.random.default_rng(0), 0
    for _ in range(60):
        n = rng.integers(2, 11)
        J, q = rng.normal(size=(n, 2)), rng.normal(size=n)
        F = J @ J.T
        feasible = linprog(np.zeros(n), A_ub=-F, b_ub=q, bounds=(0, None)).status == 0
        if feasible:
            assert_solves(F, q, solve_lcp(F, q))
        else:
            raised += 1
            with pytest.raises(ValueError, match="no solution"):
                solve_lcp(F, q)
    assert 10 < raised < 50  # Both cases occurred.


@pytest.mark.parametrize("n", [4, 16])
def test_ties_do_not_cycle(n):
    # Friction edges without friction: one contact counted n times, every ratio tied.
    F, q = np.ones((n, n)), -np.ones(n)
    lam = solve_lcp(F, q)
    assert lam.sum() == pytest.approx(1.0, abs=1e-12)
    assert_solves(F, q, lam)


@pytest.mark.parametrize("exponent", [-12, -6, 6, 12])
def test_units_do_not_matter(exponent):
    rng = np.random.default_rng(0)
    J, q = rng.normal(size=(6, 6)), rng.normal(size=6)
    F, k = J @ J.T + 0.1 * np.eye(6), 10.0**exponent
    np.testing.assert_allclose(solve_lcp(k * F, q), solve_lcp(F, q) / k, rtol=1e-9)
    np.testing.assert_allclose(solve_lcp(F, k * q), solve_lcp(F, q) * k, rtol=1e-9)


def test_mixed_units_of_the_rows_do_not_matter():
    rng = np.random.default_rng(0)
    J, s = rng.normal(size=(6, 4)), 10.0 ** rng.uniform(-4, 4, 6)
    F = J @ J.T
    q = -F @ np.abs(rng.normal(size=6))
    lam = s * solve_lcp(s[:, None] * F * s, s * q)
    assert_solves(F, q, lam)


def test_a_gap_needs_no_force():
    F = np.diag([1.0, 0.0])
    np.testing.assert_array_equal(solve_lcp(F, np.array([0.0, 2.0])), [0.0, 0.0])
    assert solve_lcp(np.zeros((0, 0)), np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_entries_that_are_not_finite_are_refused(bad):
    F, q = np.eye(2), np.array([-1.0, 1.0])
    with pytest.raises(ValueError, match="not finite"):
        solve_lcp(F, np.array([1.0, bad]))
    with pytest.raises(ValueError, match="not finite"):
        solve_lcp(np.array([[1.0, bad], [0.0, 1.0]]), q)


def test_wrong_shapes_are_refused_with_both_shapes():
    with pytest.raises(ValueError, match=r"F is \(2, 3\) and q is \(2,\)"):
        solve_lcp(np.ones((2, 3)), np.ones(2))
    with pytest.raises(ValueError, match=r"q is \(2, 1\)"):
        solve_lcp(np.eye(2), np.ones((2, 1)))


def test_the_compiled_kernel_gives_the_same_and_does_not_change_its_input():
    rng = np.random.default_rng(0)
    J, q = rng.normal(size=(8, 8)), rng.normal(size=8)
    F = J @ J.T + np.eye(8)
    F_before, q_before = F.copy(), q.copy()
    lam, status = solve_lcp_kernel(F, q)
    assert status == SOLVED
    np.testing.assert_array_equal(lam, solve_lcp(F, q))
    np.testing.assert_array_equal(F, F_before)
    np.testing.assert_array_equal(q, q_before)
