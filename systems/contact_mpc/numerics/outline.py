"""The outline of an object on the table, seen from above, and places around it."""

import numpy as np
from numba import njit

FLAT = 1e-12  # Corners of less area are left out [m2].
DECIMALS = 9  # Of a coordinate: to 1e-9 m, points are in one line.
FINENESS = 40  # Points on the contour for each place that is looked for.
ROUNDING = 1e-9  # What is nearer by less keeps its distance [m].
SLOPE_STEP = 1e-5  # Of the differences that give a direction [m].


def outline_of(parts, R, p):
    """The outline of an object on the table, seen from above.

    Args: parts: convex parts of the object, the points (n, 3) [m] of each in its own
        frame; R (3, 3), p (3,) [m]: how and where that is.
    Returns: a list of convex polygons (m, 2) [m], counter-clockwise.
    Raises: ValueError for a part without area.
    """
    parts = [np.ascontiguousarray(points) for points in parts]  # One compiled code.
    outline = [_hull_from_above(points, R, p) for points in parts]
    if any(len(polygon) < 3 for polygon in outline):
        raise ValueError("a part of the object has no area from above")
    return outline


@njit(cache=True)
def _hull_from_above(points, R, p):
    """Andrew's monotone chain; corners of less than FLAT are left out."""
    n = len(points)
    plan = np.empty((n, 2))
    for i in range(n):
        for k in range(2):
            plan[i, k] = p[k]
            for j in range(3):
                plan[i, k] += R[k, j] * points[i, j]
    # Points of one x, but for rounding, in the order of y.
    order = np.argsort(plan[:, 1], kind="mergesort")
    x = np.round(plan[order, 0], DECIMALS)
    order = order[np.argsort(x, kind="mergesort")]
    hull, size = np.empty((2 * n + 1, 2)), 0
    for way in range(2):
        first = size
        for step in range(n):
            at = plan[order[step if way == 0 else n - 1 - step]]
            while size > first + 1:
                a, b = hull[size - 2], hull[size - 1]
                area = (b[0] - a[0]) * (at[1] - a[1]) - (b[1] - a[1]) * (at[0] - a[0])
                if area > FLAT:
                    break
                size -= 1
            hull[size] = at
            size += 1
        size -= 1  # The last point begins the way back.
    return hull[:size].copy()


def distance_to_outline(points, outline):
    """(n,) how far points (n, 2) are outside of an outline [m]; negative inside: how
    deep in its deepest part."""
    points = np.ascontiguousarray(np.atleast_2d(points), dtype=float)
    nearest = np.full(len(points), np.inf)
    for polygon in outline:
        _lower_to_polygon(points, polygon, nearest)
    return nearest


@njit(cache=True)
def _lower_to_polygon(points, polygon, nearest):
    """Lowers nearest (n,) to the distances from one convex polygon."""
    m = len(polygon)
    for i in range(len(points)):
        inside, beside = -np.inf, np.inf
        for k in range(m):
            a, b = polygon[k], polygon[(k + 1) % m]
            ex, ey = b[0] - a[0], b[1] - a[1]
            x, y = points[i, 0] - a[0], points[i, 1] - a[1]
            length = np.sqrt(ex * ex + ey * ey)
            inside = max(inside, (x * ey - y * ex) / length)
            share = min(max((x * ex + y * ey) / length**2, 0.0), 1.0)
            off = np.sqrt((x - share * ex) ** 2 + (y - share * ey) ** 2)
            beside = min(beside, off)
        nearest[i] = min(nearest[i], beside if inside > 0.0 else inside)


def places_around(outline, distance, n, phase=0.0):
    """Places on the contour at some distance around an outline, evenly along it.

    Args: outline: convex polygons (m, 2) [m]; distance [m] > 0; n: how many; phase: in
        [0, 1), where the first is, as a share of the spacing.
    Returns: (n, 2) [m]; fewer where other parts are nearer than the distance.
    """
    start, end = _contour(outline, distance)
    # Finely first, to know how much of the contour is free of the other parts.
    length = np.hypot(*(end - start).T)
    whole = length.sum()
    fine = (np.arange(FINENESS * n) + 0.5) / (FINENESS * n) * whole
    free = _pushed_out(_along(start, end, length, fine), outline, distance)
    free = free[distance_to_outline(free, outline) >= distance - ROUNDING]
    if len(free) == 0:
        return free
    at = ((np.arange(n) + phase) * len(free) / n).astype(int)
    return free[np.unique(np.minimum(at, len(free) - 1))]


def _contour(outline, distance):
    """Starts and ends (m, 2) [m] of straight ways at a distance around each part: along
    each of its sides, and across the bend behind it."""
    starts, ends = [], []
    for polygon in outline:
        nxt = np.roll(polygon, -1, axis=0)
        edge = nxt - polygon
        out = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        out *= distance / np.hypot(*edge.T)[:, None]
        bend = nxt + np.roll(out, -1, axis=0)
        starts.append(np.stack([polygon + out, nxt + out], axis=1).reshape(-1, 2))
        ends.append(np.stack([nxt + out, bend], axis=1).reshape(-1, 2))
    return np.concatenate(starts), np.concatenate(ends)


def _along(start, end, length, s):
    """(n, 2) points at arc lengths s (n,) [m] of these ways, of these lengths (m,)."""
    upto = np.cumsum(length)
    k = np.minimum(np.searchsorted(upto, s), len(upto) - 1)
    share = (s - upto[k] + length[k]) / np.maximum(length[k], 1e-12)
    return start[k] + share[:, None] * (end[k] - start[k])


def _pushed_out(points, outline, distance):
    """The straight ways around corners cut them: these points go out to the distance
    from the corner."""
    corners = np.concatenate(outline)
    off = points[:, None] - corners
    far = np.linalg.norm(off, axis=2)
    k = far.argmin(axis=1)
    near = far[np.arange(len(points)), k]
    out = off[np.arange(len(points)), k] / np.maximum(near, 1e-12)[:, None]
    moved = corners[k] + distance * out
    return np.where((near < distance)[:, None], moved, points)


def inward(places, outline):
    """(n, 2) unit directions from places (n, 2) straight towards an outline."""
    rise = np.empty((len(places), 2))
    for i in range(2):
        to = np.zeros(2)
        to[i] = SLOPE_STEP
        ahead = distance_to_outline(places + to, outline)
        rise[:, i] = ahead - distance_to_outline(places - to, outline)
    size = np.linalg.norm(rise, axis=1)
    return -rise / np.maximum(size, 1e-12)[:, None]
