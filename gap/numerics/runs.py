"""Runs of rows of which something holds."""

import numpy as np


def runs_of(on) -> list[tuple[int, int]]:
    """(first, last + 1) of each stretch of rows in which `on` (n,) is true."""
    known = np.concatenate([[False], np.asarray(on, bool), [False]])
    edges = np.flatnonzero(known[1:] != known[:-1])
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def starts_of_runs(values) -> np.ndarray:
    """The first row of each stretch of equal values (n,), n above 0."""
    y = np.asarray(values)
    return np.concatenate([[0], np.flatnonzero(y[1:] != y[:-1]) + 1])
