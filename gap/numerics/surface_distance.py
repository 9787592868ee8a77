"""Signed distances of points to simple shapes, many at once, with outward normals.

A shape is in its own frame, centred there: a box of half sizes (3,), a sphere of a
radius, a cylinder or capsule along z of radius and half length (of its axis), a
half-space below z = 0, or a hull: planes N x <= d with unit N (k, 3).
"""

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.convex_hull import point_on_hull


def box(p, half):
    """p (n, 3), half (3,). Returns: distance (n,), normal (n, 3)."""
    p = np.ascontiguousarray(p, float)
    distance, normal = np.empty(len(p)), np.empty_like(p)
    _from_box(p, np.asarray(half, float), distance, normal)
    return distance, normal


@njit(cache=True)
def _from_box(p, half, distance, normal):
    """Writes distance (n,) and normal (n, 3) of points p (n, 3)."""
    for i in range(len(p)):
        axis, deepest, square = 0, -np.inf, 0.0
        for k in range(3):
            out = abs(p[i, k]) - half[k]
            if out > deepest:
                axis, deepest = k, out
            normal[i, k] = p[i, k] - min(max(p[i, k], -half[k]), half[k])
            square += normal[i, k] ** 2
        distance[i] = np.sqrt(square)
        if distance[i] > 1e-12:
            normal[i] /= distance[i]
        else:
            distance[i] = deepest
            normal[i] = 0.0
            normal[i, axis] = -1.0 if p[i, axis] < 0.0 else 1.0


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


def hull(p, N, d):
    """N (k, 3) outward unit normals, d (k,)."""
    p, N, d = (np.ascontiguousarray(each, float) for each in (p, N, d))
    each = p @ N.T - d
    k = np.argmax(each, axis=1)
    distance, normal = each[np.arange(len(p)), k], N[k]
    # Outside, a plane is what is nearest where the foot on it is on the hull.
    foot = p - distance[:, None] * normal
    beside = (distance > 0.0) & ((foot @ N.T - d).max(axis=1) > 1e-9)
    _beside_faces(N, d, p, beside, distance, normal)
    return distance, normal


@njit(cache=True)
def _beside_faces(N, d, p, beside, distance, normal):
    """Writes distance (n,) and normal (n, 3) of those points (n, 3) that are beside."""
    for i in range(len(p)):
        if beside[i]:
            distance[i], normal[i], _ = point_on_hull(N, d, p[i])
