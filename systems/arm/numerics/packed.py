"""Constants of a compiled function in one structured array.

A call from Python into a compiled function unpacks a tuple of arrays each time, which
takes some 0.3 us per array, longer than many kernels run. A packed tuple is one array.
"""

import numpy as np


def packed(constants) -> np.ndarray:
    """A NamedTuple of numbers, arrays and further such tuples as one structured array
    (1,). In a compiled function `packed(x)[0]` has the fields of x by name."""
    out = np.zeros(1, dtype=_dtype(constants))
    _fill(out[0], constants)
    return out


def _dtype(constants) -> np.dtype:
    fields: list = []
    for name, value in zip(constants._fields, constants, strict=True):
        if hasattr(value, "_fields"):
            fields.append((name, _dtype(value)))
        else:
            array = np.asarray(value)
            fields.append((name, array.dtype, array.shape))
    return np.dtype(fields, align=True)


def _fill(record, constants) -> None:
    for name, value in zip(constants._fields, constants, strict=True):
        if hasattr(value, "_fields"):
            _fill(record[name], value)
        else:
            record[name] = value
