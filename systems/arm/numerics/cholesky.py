"""Factor and solutions of small positive definite matrices, in place, compiled."""

import numba
import numpy as np


@numba.njit(cache=True)
def cholesky(L, A):
    """Fills the lower factor L of A (n, n), which may be the same array; only the lower
    half of A is read. Returns: whether A is positive definite."""
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if not d > 0.0:
            return False
        d = np.sqrt(d)
        L[j, j] = d
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / d
    return True


@numba.njit(cache=True)
def forward_solve(L, b):
    """Replaces b (n,) by inv(L) b."""
    for i in range(L.shape[0]):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * b[k]
        b[i] = s / L[i, i]


@numba.njit(cache=True)
def cholesky_solve(L, b):
    """Replaces b (n,) by inv(L L') b."""
    forward_solve(L, b)
    n = L.shape[0]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= L[k, i] * b[k]
        b[i] = s / L[i, i]
