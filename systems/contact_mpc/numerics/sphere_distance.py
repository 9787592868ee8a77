"""Distance of a sphere to a sphere, box, cylinder or half-space, in closed form."""

from math import sqrt

import numpy as np
from numba import njit

# Numbers of the shapes.
SPHERE, BOX, HALF_SPACE, CYLINDER = 0, 1, 2, 3


@njit(cache=True)
def sphere_against(p_S, radius, shape, size, R_G, p_G):
    """Gap, unit normal towards the sphere, nearest points on the sphere and the other.

    The other shape: a sphere, a box (half extents `size`), the half-space below the z
    axis of its frame, or a cylinder about that axis.
    """
    if shape == HALF_SPACE:
        n = R_G[:, 2].copy()
        height = n @ (p_S - p_G)
        return height - radius, n, p_S - radius * n, p_S - height * n
    if shape == SPHERE:
        n = p_S - p_G
        distance = sqrt(n @ n)
        if distance > 1e-12:
            n /= distance
        else:  # Concentric: any direction is right; that of the general path.
            n[0], n[1], n[2] = 1.0, 0.0, 0.0
        on_other = p_G + size[0] * n
        return distance - size[0] - radius, n, p_S - radius * n, on_other
    p = R_G.T @ (p_S - p_G)
    if shape == CYLINDER:
        distance, n_G, nearest = _point_on_cylinder(p, size[0], size[1])
        n = R_G @ n_G
        return distance - radius, n, p_S - radius * n, p_G + R_G @ nearest
    nearest = np.minimum(np.maximum(p, -size), size)
    n_G = p - nearest
    distance = sqrt(n_G @ n_G)
    if distance > 0.0:
        n_G /= distance
    else:  # The centre is in the box: out through the nearest face.
        axis = np.argmin(size - np.abs(p))
        side = 1.0 if p[axis] >= 0.0 else -1.0
        distance = -(size[axis] - abs(p[axis]))
        n_G[axis] = side
        nearest[axis] = side * size[axis]
    n = R_G @ n_G
    return distance - radius, n, p_S - radius * n, p_G + R_G @ nearest


@njit(cache=True)
def _point_on_cylinder(p, radius, half_length):
    """Distance (negative inside), outward unit normal and nearest point of a cylinder
    about z to the point p (3,)."""
    along, off = p[2], sqrt(p[0] * p[0] + p[1] * p[1])
    out = np.zeros(3)  # Away from the axis; on it every direction is right.
    if off > 1e-12:
        out[0], out[1] = p[0] / off, p[1] / off
    else:
        out[0] = 1.0
    side = 1.0 if along >= 0.0 else -1.0
    beyond, outside = abs(along) - half_length, off - radius
    nearest, n = np.empty(3), np.zeros(3)
    if beyond <= 0.0 and outside <= 0.0:  # Out through the nearer of side and end.
        if outside >= beyond:
            nearest[:] = radius * out
            nearest[2] = along
            return outside, out, nearest
        nearest[:] = p
        nearest[2] = side * half_length
        n[2] = side
        return beyond, n, nearest
    nearest[:] = min(off, radius) * out
    nearest[2] = min(max(along, -half_length), half_length)
    n[:] = p - nearest
    distance = sqrt(n @ n)
    return distance, n / distance, nearest
