import numpy as np
import pytest

from makebreak.systems.arm.numerics.cholesky import (
    cholesky,
    cholesky_solve,
    forward_solve,
)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_factor_and_solutions_are_those_of_numpy(n):
    rng = np.random.default_rng(n)
    X = rng.normal(size=(n, n + 2))
    A, b = X @ X.T, rng.normal(size=n)
    expected = np.linalg.cholesky(A)
    L = np.zeros((n, n))
    assert cholesky(L, A)
    np.testing.assert_allclose(L, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(A, X @ X.T)
    own = np.tril(A)  # The lower half is enough, and may be filled itself.
    assert cholesky(own, own)
    np.testing.assert_array_equal(own, L)
    half, whole = b.copy(), b.copy()
    forward_solve(L, half)
    cholesky_solve(L, whole)
    np.testing.assert_allclose(half, np.linalg.solve(expected, b), rtol=1e-9)
    np.testing.assert_allclose(whole, np.linalg.solve(A, b), rtol=1e-9)


@pytest.mark.parametrize("worst", [0.0, -1e-9, np.nan])
def test_what_is_not_positive_definite_is_told(worst):
    assert not cholesky(np.zeros((2, 2)), np.diag([1.0, worst]))
