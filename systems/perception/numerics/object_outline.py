"""The outline of a flat object that is seen: parts, each a convex hull, and their
rotational symmetry."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit


class Parts(NamedTuple):
    """Convex hulls; the i-th one is of points start[i] to start[i + 1] - 1."""

    points: np.ndarray  # (n, 3) in the object's frame [m].
    start: np.ndarray  # (m + 1,)


@dataclass(frozen=True, eq=False)
class Shape:
    """The visible shape of an object. Its parts may overlap."""

    colored: Parts  # Those that have the object's colour.
    whole: Parts  # All parts, also sides of other colours.
    fold: int  # Number of equal turns about z that leave it unchanged; 0: any turn.
    radius: float  # Distance of the farthest point from the z axis [m].

    @property
    def top(self) -> float:
        """Mean height of the coloured points above the object's frame [m]."""
        return float(self.colored.points[:, 2].mean())


def make_shape(colored, whole=None) -> Shape:
    """A Shape. Args: colored, whole: lists of points (n, 3) [m], a part each; whole
    None: all parts are coloured.

    Raises: ValueError for another shape of the lists or a point that is not finite.
    """
    whole = colored if whole is None else whole
    lists = []
    for name, given in (("colored", colored), ("whole", whole)):
        points = [np.array(part, dtype=float) for part in given]
        for part in points:
            if part.ndim != 2 or part.shape[1] != 3 or len(part) < 3:
                raise ValueError(
                    f"{name} has a part of shape {part.shape}, expected (n, 3), n >= 3"
                )
            if not np.isfinite(part).all():
                raise ValueError(f"{name} has a point that is not finite")
        if not points:
            raise ValueError(f"{name} is empty, expected one part or more")
        start = np.cumsum([0, *map(len, points)])
        lists.append(Parts(np.ascontiguousarray(np.concatenate(points)), start))
    plan = [convex_hull(part[:, :2]) for part in each_part(lists[0])]
    radius = float(np.hypot(*lists[0].points[:, :2].T).max())
    return Shape(lists[0], lists[1], _fold(plan, radius), radius)


def each_part(parts: Parts):
    """The points (n, 3) of each part."""
    return [parts.points[a:b] for a, b in pairwise(parts.start)]


@njit(cache=True)
def hull_order(points):
    """Indices of the corners of the convex hull of points (n, 2), in order around it
    (Andrew's monotone chain)."""
    n = len(points)
    order = np.argsort(points[:, 0] + 1e-9 * points[:, 1])
    chain = np.empty(2 * n + 1, np.int64)
    size = 0
    for backwards in range(2):
        least = size + 1
        for k in range(n):
            i = order[k if backwards == 0 else n - 1 - k]
            while size > least:
                a, b = points[chain[size - 2]], points[chain[size - 1]]
                turn = (b[0] - a[0]) * (points[i, 1] - a[1])
                turn -= (b[1] - a[1]) * (points[i, 0] - a[0])
                if turn > 1e-12:
                    break
                size -= 1
            chain[size] = i
            size += 1
        size -= 1  # The next chain begins where this one ends.
    return chain[:size]


def convex_hull(points):
    """The convex hull (n, 2) of points (m, 2), in order."""
    return points[hull_order(np.ascontiguousarray(points))]


@njit(cache=True)
def half_planes(hull):
    """(n, 3): a, b, c of the distance a x + b y + c outside of each edge of a hull
    (n, 2)."""
    n = len(hull)
    planes = np.empty((n, 3))
    for i in range(n):
        along = hull[(i + 1) % n] - hull[i]
        length = max(np.sqrt(along[0] ** 2 + along[1] ** 2), 1e-12)
        planes[i, 0], planes[i, 1] = along[1] / length, -along[0] / length
        planes[i, 2] = -planes[i, 0] * hull[i, 0] - planes[i, 1] * hull[i, 1]
    return planes


def _fold(plan, radius):
    """Number of equal turns that leave the union of hulls (n, 2) unchanged; 0: any."""
    planes = [half_planes(hull) for hull in plan]

    def outside(points):
        each = [(points @ p[:, :2].T + p[:, 2]).max(axis=1) for p in planes]
        return np.min(each, axis=0)

    t = np.linspace(0.0, 1.0, 40, endpoint=False)[:, None, None]
    rim = np.concatenate(
        [((1 - t) * h + t * np.roll(h, -1, axis=0)).reshape(-1, 2) for h in plan]
    )
    rim = rim[outside(rim) > -1e-3 * radius]
    for fold in (0, 8, 6, 5, 4, 3, 2):
        angle = 1.0 if fold == 0 else 2.0 * np.pi / fold
        c, s = np.cos(angle), np.sin(angle)
        if abs(outside(rim @ np.array([[c, s], [-s, c]]))).max() < 0.01 * radius:
            return fold
    return 1


def nearest_yaw(yaw, fold, reference):
    """The yaw [rad] of the same outline that is nearest to a reference."""
    if fold == 0:
        return reference
    turn = 2.0 * np.pi / fold
    return yaw + turn * np.round((reference - yaw) / turn)
