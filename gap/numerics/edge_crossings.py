"""Where edges of two boxes cross, at many poses at once.

A box that is pushed beyond the edge of a table stands on two of its corners and where
its lower edges cross that of the table; no corner is near there.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

MARGIN = 2e-3  # So near its end an edge is a corner [m].
PARALLEL = 0.05  # Sine of the angle below which two edges do not cross.
CONE = -0.05  # A normal may be so far outside of those between an edge's two faces.
DEEPEST = 3e-3  # Edges that are passed by more do not touch [m].
FAR = 1.0  # Distance of what does not touch [m].


@dataclass(frozen=True, eq=False)
class Edge:
    """start, along (3,) [m]: from one corner to the next; faces (2, 3): normals of the
    two faces that meet there; all in the body's frame."""

    start: np.ndarray
    along: np.ndarray
    faces: np.ndarray


def edges_of_box(half, R: np.ndarray, p: np.ndarray) -> list[Edge]:
    """The twelve of a box of half sizes (3,), turned by R (3, 3) at p (3,)."""
    found = []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for a, b in product((-1.0, 1.0), repeat=2):
            corner, along, faces = np.zeros(3), np.zeros(3), np.zeros((2, 3))
            corner[[i, j, k]] = a * half[i], b * half[j], -half[k]
            along[k] = 2.0 * half[k]
            faces[0, i], faces[1, j] = a, b
            found.append(Edge(R @ corner + p, R @ along, faces @ R.T))
    return found


def crossing(one: Edge, R_a, p_a, other: Edge, R_b, p_b):
    """Where an edge of body a is nearest to one of body b, at n poses of the two.

    Args: R_a, R_b (n, 3, 3); p_a, p_b (n, 3) [m].
    Returns: place (n, 3) on a's edge, distance (n,), FAR where they do not touch so,
        the normal (n, 3) from b to a, and whether they may touch so (n,).
    """
    P, u = p_a + R_a @ one.start, R_a @ one.along
    Q, v = p_b + R_b @ other.start, R_b @ other.along
    w = P - Q
    uu, uv, vv, uw, vw = (
        np.einsum("ni,ni->n", x, y) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w))
    )
    den = uu * vv - uv**2
    may = den > PARALLEL**2 * uu * vv
    den = np.where(may, den, 1.0)
    s, t = (uv * vw - vv * uw) / den, (uu * vw - uv * uw) / den
    for x, size in ((s, uu), (t, vv)):
        margin = MARGIN / np.sqrt(size)
        may &= (x > margin) & (x < 1.0 - margin)
    n = np.cross(u, v)
    n /= np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None]
    out = R_b @ other.faces.sum(axis=0)
    n *= np.where(np.einsum("ni,ni->n", n, out) < 0.0, -1.0, 1.0)[:, None]
    for faces, R, sign in ((other.faces, R_b, 1.0), (one.faces, R_a, -1.0)):
        for face in faces:
            may &= sign * np.einsum("ni,ni->n", n, R @ face) > CONE
    place = P + s[:, None] * u
    distance = np.einsum("ni,ni->n", place - Q - t[:, None] * v, n)
    may &= distance > -DEEPEST
    return place, np.where(may, distance, FAR), n, may
