"""Steps by the blocks of time in which columns are right, and candidates by simulation
(gap/numerics/agreed_step.py, gap/search/by_simulation.py)."""

import numpy as np
import pytest

from makebreak.gap.numerics.agreed_step import agreed_step

ROWS, BLOCKS = 200, 9


def blocks() -> np.ndarray:
    return np.repeat(np.arange(BLOCKS), ROWS)


@pytest.mark.parametrize("seed", range(5))
def test_all_blocks_are_fitted_where_columns_are_right(seed):
    """Least squares of all rows (an independent solver) is what comes out."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(ROWS * BLOCKS, 3)) * [1.0, 1e-6, 1e4]
    r = X @ [2.0, -3e6, 1e-4] + 0.1 * rng.normal(size=len(X))
    c, gained = agreed_step(X, r, blocks())
    exact = np.linalg.lstsq(X, r, rcond=None)[0]
    np.testing.assert_allclose(c, exact, rtol=1e-4)
    assert gained == pytest.approx(np.sum(r**2) - np.sum((r - X @ exact) ** 2))


@pytest.mark.parametrize("seed", range(5))
def test_blocks_that_bend_do_not_count(seed):
    """In a third of the blocks columns are fifty times as large as the change that they
    stand for, and point elsewhere: least squares finds next to nothing there."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(ROWS * BLOCKS, 2))
    r = X @ [1.5, -0.5] + 0.1 * rng.normal(size=len(X))
    bent = blocks() % 3 == 0
    X[bent] = 50.0 * rng.normal(size=(bent.sum(), 2))
    c, _ = agreed_step(X, r, blocks())
    assert np.abs(np.linalg.lstsq(X, r, rcond=None)[0]).max() < 0.2
    np.testing.assert_allclose(c, [1.5, -0.5], atol=0.05)


def test_what_does_not_show_does_not_move():
    r = np.ones(ROWS * BLOCKS)
    c, gained = agreed_step(np.zeros((len(r), 2)), r, blocks())
    assert gained == 0.0 and not c.any()
