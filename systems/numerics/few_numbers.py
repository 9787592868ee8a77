"""Compiled sums and checks of a few numbers, where an array expression takes long to
compile and a BLAS call longer than the arithmetic."""

import numba
import numpy as np


@numba.njit(cache=True)
def dot(a, b):
    """Of the first three entries; np.sum(a * b) takes a second to compile."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True)
def all_finite(a):
    """Whether every number of a (n,) is finite; np.all takes long to compile."""
    for x in a:
        if not np.isfinite(x):
            return False
    return True
