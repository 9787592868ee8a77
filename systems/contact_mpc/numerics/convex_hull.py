"""A sphere against a convex hull: gap, normal and nearest points, always exact.

The hull is the half-spaces of its faces, n_f' p <= d_f. From outside, the nearest point
is that of a convex QP; from inside, it lies on the nearest face.
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.nearest_point import FOUND, nearest_point


@njit(cache=True)
def point_on_hull(normals, offsets, p):
    """The nearest point of a hull's surface to p.

    Args: normals (m, 3) outward unit normals of the faces; offsets (m,), n_f' p of a
        point of each [m]; p (3,) [m].

    Returns: distance (negative inside) [m], the unit normal (3,) from the hull's
        surface outward, which on an edge or a vertex is that of a face, and the nearest
        point (3,).
    Raises: ValueError where the QP fails: the faces enclose nothing.
    """
    face, height = 0, -np.inf
    size = 0.0
    above = np.empty(offsets.size)
    for i in range(offsets.size):
        above[i] = normals[i] @ p - offsets[i]
        size = max(size, abs(offsets[i]), abs(above[i]))
        if above[i] > height:
            face, height = i, above[i]
    v = np.zeros(3)
    if height > 1e-9 * size:
        equal = np.zeros(offsets.size, np.bool_)
        if nearest_point(-normals, -above, equal, v) != FOUND:
            raise ValueError("the faces of the hull enclose nothing")
        distance = np.sqrt(v @ v)
        return distance, -v / distance, p + v
    n = normals[face].copy()
    return height, n, p - height * n
