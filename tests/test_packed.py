from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.arm.numerics.packed import packed


class Inner(NamedTuple):
    gain: float
    on: bool


class Outer(NamedTuple):
    matrix: np.ndarray
    count: int
    inner: Inner


@numba.njit
def kernel(constants, x):
    c = constants[0]
    out = c.matrix @ x
    if c.inner.on:
        out *= c.inner.gain
    return out + c.count


def test_a_compiled_function_sees_the_fields_by_their_names():
    A, x = np.arange(6.0).reshape(2, 3), np.array([1.0, -2.0, 0.5])
    for on, gain in ((True, 3.0), (False, 1.0)):
        found = kernel(packed(Outer(A, 4, Inner(3.0, on))), x)
        np.testing.assert_array_equal(found, gain * (A @ x) + 4)


def test_what_is_packed_is_a_copy():
    A = np.ones((2, 2))
    one = packed(Outer(A, 4, Inner(3.0, True)))
    A[:] = 0.0
    np.testing.assert_array_equal(one["matrix"], np.ones((1, 2, 2)))
    assert one["inner"]["on"][0] and one["inner"]["gain"][0] == 3.0
