"""Signed distances of points to simple shapes, many at once, with outward normals.

A shape is in its own frame, centred there: a box of half sizes (3,), a sphere of a
radius, a cylinder or capsule along z of radius and half length (of its axis), a
half-space below z = 0, or a hull: planes N x <= d with unit N (k, 3), and the
triangles (m, 3, 3) of their faces.

Source: the nearest point of a triangle, Ericson, Real-Time Collision Detection, 2005,
section 5.1.5.
"""

import numpy as np
from numba import njit


def box(p, half):
    """p (n, 3), half (3,). Returns: distance (n,), normal (n, 3)."""
    half = np.asarray(half, float)
    off = p - np.clip(p, -half, half)
    out = np.linalg.norm(off, axis=1)
    q = np.abs(p) - half
    axis = np.argmax(q, axis=1)
    row = np.arange(len(p))
    inside = out <= 1e-12
    distance = np.where(inside, q[row, axis], out)
    normal = off / np.where(inside, 1.0, out)[:, None]
    face = np.zeros_like(p)
    face[row, axis] = np.where(p[row, axis] < 0.0, -1.0, 1.0)
    return distance, np.where(inside[:, None], face, normal)


def sphere(p, radius: float):
    size = np.linalg.norm(p, axis=1)
    normal = np.where(
        size[:, None] > 1e-12, p / np.maximum(size, 1e-12)[:, None], [0.0, 0.0, 1.0]
    )
    return size - radius, normal


def half_space(p):
    return p[:, 2].copy(), np.broadcast_to([0.0, 0.0, 1.0], p.shape).copy()


def cylinder(p, radius: float, half_length: float):
    """As a box in the two coordinates of distance from the axis and height."""
    rho = np.hypot(p[:, 0], p[:, 1])
    flat = np.column_stack([rho, np.zeros(len(p)), p[:, 2]])
    distance, n = box(flat, [radius, 1e9, half_length])
    away = np.where(
        rho[:, None] > 1e-12, p[:, :2] / np.maximum(rho, 1e-12)[:, None], [1.0, 0.0]
    )
    return distance, np.column_stack([away * n[:, :1], n[:, 2]])


def capsule(p, radius: float, half_length: float):
    z = np.clip(p[:, 2], -half_length, half_length)
    return sphere(p - z[:, None] * [0.0, 0.0, 1.0], radius)


def hull(p, N, d, triangles):
    """N (k, 3) outward unit normals, d (k,), triangles (m, 3, 3)."""
    p, N = np.asarray(p, float), np.asarray(N, float)
    each = p @ N.T - d
    k = np.argmax(each, axis=1)
    distance, normal = each[np.arange(len(p)), k], N[k]
    # Outside, a plane is what is nearest where the foot on it is on the hull.
    on_plane = p - distance[:, None] * normal
    beside = (on_plane @ N.T - d).max(axis=1) > 1e-9
    index = np.flatnonzero((distance > 0.0) & beside)
    if len(index):
        nearest = np.empty((len(index), 3))
        _nearest_of_triangles(p[index], np.asarray(triangles, float), nearest)
        off = p[index] - nearest
        distance[index] = np.linalg.norm(off, axis=1)
        normal[index] = off / distance[index, None]
    return distance, normal


@njit(cache=True)
def _nearest_of_triangles(p, triangles, nearest):
    """Writes nearest (n, 3): of all points of the triangles (m, 3, 3) the nearest to
    each of p (n, 3)."""
    for i in range(len(p)):
        least = np.inf
        for t in range(len(triangles)):
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            ab, ac = b - a, c - a
            ap = p[i] - a
            d1, d2 = ab @ ap, ac @ ap
            bp = p[i] - b
            d3, d4 = ab @ bp, ac @ bp
            cp = p[i] - c
            d5, d6 = ab @ cp, ac @ cp
            # Weights of b and c; of the whole face, of its edges, or of its corners.
            va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
            v, w = 0.0, 0.0
            if d1 <= 0.0 and d2 <= 0.0:
                pass
            elif d3 >= 0.0 and d4 <= d3:
                v = 1.0
            elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
                v = d1 / (d1 - d3)
            elif d6 >= 0.0 and d5 <= d6:
                w = 1.0
            elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
                w = d2 / (d2 - d6)
            elif va <= 0.0 and d4 >= d3 and d5 >= d6:
                w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
                v = 1.0 - w
            else:
                v, w = vb / (va + vb + vc), vc / (va + vb + vc)
            q = a + v * ab + w * ac
            off = p[i] - q
            square = off @ off
            if square < least:
                least = square
                nearest[i] = q
