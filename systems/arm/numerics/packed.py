"""Constants of a compiled function in one flat array.

A call from Python into a compiled function unpacks a tuple of arrays each time, which
takes some 0.3 us per array, longer than many kernels run. A packed tuple is one array,
of one type whatever the sizes are: an arm with another number of joints needs no other
compiled code.
"""

import numba
import numpy as np


def packed(constants) -> np.ndarray:
    """A NamedTuple of numbers, arrays and further such tuples as one array: of each
    number or array, in their order, its size and its entries as floats."""
    parts: list = []
    for value in constants:
        if hasattr(value, "_fields"):
            parts.append(packed(value))
        else:
            entries = np.asarray(value, dtype=float).ravel()
            parts += [[entries.size], entries]
    return np.concatenate(parts)


@numba.njit(cache=True)
def part(flat, at):
    """The array (m,) whose size is at flat[at], not copied, and where the next is."""
    end = at + 1 + int(flat[at])
    return flat[at + 1 : end], end
