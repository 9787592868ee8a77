"""Finds a ball of known colour and radius in an image, and its position on a table.

1. "Strength" of a pixel: how much of the ball's hue it has; 0 for grey.
2. Hough circles on the strength give candidates.
3. On rays from outside the circle inwards, the outline is where the strength first
   rises half-way. Rays that do not start on the table (but on the finger, which hides a
   part of the ball) are dropped.
4. A sphere's outline is where a cone of rays from the camera touches it: for unit
   vectors n_i to the outline, axis a and half-angle alpha, n_i . a = cos(alpha). With
   m = a / cos(alpha) this is linear, n_i . m = 1: exact in perspective, where the
   outline is an ellipse that is not centred on the sphere's centre.
5. The axis meets the plane of the ball's centre, at the table's height plus the model's
   radius. The radius in the image only serves to reject other things.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from makebreak.systems.perception.numerics.pinhole import Pinhole

N_RAYS = 96
STEP = 0.5  # Between samples along a ray [px].
MARGIN = 2  # Rays beside a hidden one that are dropped too.
# Least strength just inside the outline over the median: less is a sliver of the ball
# beside the finger.
SLIVER_STRENGTH = 0.85
SMALLEST, LARGEST = 0.6, 1.6  # Range of the radius in the image over the model's.
MIN_STRENGTH = 40.0  # Least strength of the ball's colour, of 255.
MIN_SEEN = 0.2  # Least visible fraction of the outline.
INLIER = 1.0  # Largest distance of an inlier from the fitted outline [px].
TABLE_DIFFERENCE = 80.0  # Largest difference of table colour, of 765 (r + g + b).


class Detection(NamedTuple):
    """A ball in an image. The radius is for rejection and reports only."""

    p_WB: np.ndarray  # (3,) [m]
    seen_radius: float  # [m]
    seen_part: float  # Visible fraction of the outline.


def strength_weights(hue):
    """Weights (1, 4) of r, g, b, alpha that give a pixel's strength along a hue: 0 for
    grey, at least 2/3 of its value for the pure colour.

    Args: hue [rad]: 0 red, 2 pi / 3 green, 4 pi / 3 blue.
    """
    turn = 2.0 * np.pi / 3.0
    weights = [np.cos(hue), np.cos(hue - turn), np.cos(hue + turn), 0.0]
    return np.array([weights], dtype=np.float32)


def find_ball(image, camera: Pinhole, hue_weights, radius, table_z, guess_p=None):
    """Finds the ball in an image.

    Args:
        image: (height, width, 4) uint8 RGBA.
        camera: the pinhole model; hue_weights: of `strength_weights`.
        radius: of the model's ball [m]; table_z: height of the table [m].
        guess_p: (3,) of the ball's centre [m]: the search is limited to its
            surroundings. None: the whole image is searched.
    Returns: a Detection, or None if no ball is found.
    """
    if guess_p is None:
        depth = camera.p_WC[2] - table_z - radius
        low, high = np.zeros(2, int), np.array([camera.width, camera.height])
    else:
        p_C = camera.to_camera(guess_p)
        depth = p_C[2]
        if depth > radius:
            radius_px = camera.focal * radius / depth
            low, high = _window(camera, p_C, search_half_px(radius_px))
    if not depth > radius or (high - low < 8).any():
        return None
    radius_px = camera.focal * radius / depth
    # A copy has the same memory layout for all sizes: one compiled version.
    region = image[low[1] : high[1], low[0] : high[0]].copy()
    strength = cv2.transform(region, hue_weights)
    strength = cv2.GaussianBlur(strength, (3, 3), 0.0)
    m, n_kept = _fit_ball(
        strength,
        region,
        find_circles(strength, radius_px),
        LARGEST * radius_px,
        _ANGLES,
        low,
        camera.focal,
        camera.center,
    )
    if n_kept < MIN_SEEN * N_RAYS:
        return None
    norm = float(np.linalg.norm(m))
    p_WB = camera.meet_plane(m / norm, table_z + radius)
    if p_WB is None:
        return None
    sine = np.sqrt(max(1.0 - 1.0 / norm**2, 0.0))
    seen_radius = float(np.sqrt(((p_WB - camera.p_WC) ** 2).sum()) * sine)
    if not SMALLEST < seen_radius / radius < LARGEST:
        return None
    return Detection(p_WB, seen_radius, n_kept / N_RAYS)


def search_half_px(radius_px: float) -> float:
    """Half the side of the square that is searched about a guess [px]."""
    return (LARGEST + 0.2) * radius_px + 6.0


def _window(camera, p_C, half_px):
    """Corners low and high (2,) [px] of the square about a point (3,) in C, clipped to
    the image (rows low[1] to high[1] - 1)."""
    corners = np.empty((2, 2), int)
    for i, size in enumerate((camera.width, camera.height)):
        center = camera.focal * p_C[i] / p_C[2] + camera.center[i]
        corners[0, i] = min(max(center - half_px, 0.0), size)
        corners[1, i] = min(max(center + half_px + 2.0, 0.0), size)
    return corners


def find_circles(strength, radius_px, n=3):
    """The n best Hough circles (k, 3), k <= n: u, v, radius [px].

    Args: strength (h, w) uint8; radius_px: expected radius [px].
    """
    circles = cv2.HoughCircles(
        strength,
        cv2.HOUGH_GRADIENT,
        dp=1,
        minDist=max(radius_px / 2, 1.0),
        param1=100,
        param2=8,
        minRadius=int(SMALLEST * radius_px),
        maxRadius=int(np.ceil(LARGEST * radius_px)),
    )
    return np.empty((0, 3)) if circles is None else circles[0, :n].astype(float)


@njit(cache=True)
def _fit_ball(strength, region, circles, reach, angles, low, focal, center):
    """The cone of the first of the circles (k, 3) that is a ball.

    Args: strength, region, reach, angles: of outline_points; low (2,): corner of the
        region in the image [px]; focal, center (2,): of the camera [px].
    Returns: as fit_cone, with 0 rays if no circle is a ball.
    """
    m, n_kept = np.zeros(3), 0
    height, width = strength.shape
    for i in range(len(circles)):
        u, v = circles[i, 0], circles[i, 1]
        if not (0.0 < u < width - 1 and 0.0 < v < height - 1):
            continue  # Hough's centres may lie outside of the image.
        # The circle may be the finger's tip, whose edge is round too: rays from there
        # find a part of the ball, and rays from the centre of this fit all of it.
        for _ in range(2):
            points = outline_points(strength, region, u, v, reach, angles)
            rays = _rays(points, low, focal, center)
            m, n_kept = fit_cone(rays, INLIER / focal)
            if n_kept < 6 or not m[2] > 0.0:
                break
            u = focal * m[0] / m[2] + center[0] - low[0]
            v = focal * m[1] / m[2] + center[1] - low[1]
            if not (0.0 < u < width - 1 and 0.0 < v < height - 1):
                break
        if n_kept >= MIN_SEEN * N_RAYS:
            return m, n_kept
    return m, 0


@njit(cache=True)
def _rays(points, low, focal, center):
    """Pinhole.rays (k, 3) of points (k, 2) in a region with corner low (2,) [px]."""
    rays = np.empty((len(points), 3))
    for i in range(len(points)):
        x = (points[i, 0] + low[0] - center[0]) / focal
        y = (points[i, 1] + low[1] - center[1]) / focal
        length = np.sqrt(x * x + y * y + 1.0)
        rays[i, 0], rays[i, 1], rays[i, 2] = x / length, y / length, 1.0 / length
    return rays


@njit(cache=True)
def bilinear(image, u, v):
    """The value at u, v [px], inside of an image (h, w), by bilinear interpolation."""
    i, j = int(v), int(u)
    b, a = v - i, u - j
    i1, j1 = min(i + 1, image.shape[0] - 1), min(j + 1, image.shape[1] - 1)
    return (1.0 - b) * ((1.0 - a) * image[i, j] + a * image[i, j1]) + b * (
        (1.0 - a) * image[i1, j] + a * image[i1, j1]
    )


@njit(cache=True)
def outline_points(strength, region, u0, v0, reach, angles):
    """Points of the ball's outline against the table.

    Args:
        strength: (h, w) uint8; region: (h, w, 4) uint8, the same part of the image.
        u0, v0: a point inside of the outline [px]; reach: start of the rays [px].
        angles: (n, 2) cosine and sine of the rays, once around.
    Returns: points (k, 2) [px], in order of angle; none for rays on which the outline
        is hidden or ambiguous.
    """
    h, w = strength.shape
    n = len(angles)
    start, ground, edge = np.zeros(n), np.zeros(n), np.zeros(n)
    top, outside = np.zeros(n), np.zeros(n)
    found = np.zeros(n, dtype=np.bool_)
    for i in range(n):
        c, s = angles[i]
        start[i] = _within(reach, u0, v0, c, s, w, h)
        ground[i] = bilinear(strength, u0 + start[i] * c, v0 + start[i] * s)
        foot = ground[i] + MIN_STRENGTH / 2
        edge[i] = _rise(strength, u0, v0, c, s, start[i], foot)
        if edge[i] < 0.0:
            continue
        for d in range(1, 7):  # Strength of the ball just inside.
            r = edge[i] - d * STEP
            top[i] = max(top[i], bilinear(strength, u0 + r * c, v0 + r * s))
        u = int(u0 + (edge[i] + 2.5) * c + 0.5)
        v = int(v0 + (edge[i] + 2.5) * s + 0.5)
        if 0 <= u < w and 0 <= v < h:
            outside[i] = float(region[v, u, 0]) + region[v, u, 1] + region[v, u, 2]
            found[i] = top[i] - ground[i] >= MIN_STRENGTH and ground[i] <= top[i] / 3.0
    points = np.empty((n, 2))
    if not found.any():
        return points[:0]
    usual, full = np.median(outside[found]), np.median(top[found])
    clear = found & (np.abs(outside - usual) <= TABLE_DIFFERENCE)
    clear &= top >= SLIVER_STRENGTH * full
    k = 0
    for i in range(n):
        hidden = False
        for d in range(-MARGIN, MARGIN + 1):  # Edges near a hidden part are blurred.
            hidden |= not clear[(i + d) % n]
        if hidden:
            continue
        c, s = angles[i]
        level = 0.5 * (ground[i] + full)
        r = _rise(strength, u0, v0, c, s, start[i], level)
        if r > 0.0:
            points[k, 0], points[k, 1] = u0 + r * c, v0 + r * s
            k += 1
    return points[:k]


@njit(cache=True)
def _within(reach, u0, v0, c, s, w, h):
    """Length of a ray of length `reach` inside of the image [px]."""
    if c > 0.0:
        reach = min(reach, (w - 1 - u0) / c)
    elif c < 0.0:
        reach = min(reach, -u0 / c)
    if s > 0.0:
        reach = min(reach, (h - 1 - v0) / s)
    elif s < 0.0:
        reach = min(reach, -v0 / s)
    return reach


@njit(cache=True)
def _rise(strength, u0, v0, c, s, start, level):
    """Radius at which, from `start` inwards, the strength first reaches `level` [px];
    -1 if it does not."""
    r = start
    last = bilinear(strength, u0 + r * c, v0 + r * s)
    while r > 4.0:
        r -= STEP
        now = bilinear(strength, u0 + r * c, v0 + r * s)
        if now >= level:
            if now <= last:  # Reached from the start: the ball is cut by the border.
                return -1.0
            return r + STEP * (now - level) / (now - last)
        last = now
    return -1.0


@njit(cache=True)
def fit_cone(rays, tolerance):
    """The cone that touches a sphere, from unit vectors to its outline.

    Consensus over triples of rays, spread evenly: the cone with the most inliers is
    taken, and refined by two least-squares fits to its inliers.

    Args: rays (k, 3), in order around the cone; tolerance: of an inlier [rad].
    Returns: m (3,), the axis over the cosine of the half-angle; number of inliers, 0 if
        there is no cone.
    """
    k = len(rays)
    best, best_count = np.zeros(3), 0
    if k < 3:
        return best, 0
    third: int = k // 3
    for i in range(third):
        m, ok = _solve3(rays[i], rays[i + third], rays[i + 2 * third])
        if not ok:
            continue
        scale = tolerance * _norm_times_sine(m)
        count = _n_agree(rays, m, scale)
        if count > best_count:
            best, best_count = m, count
    for _ in range(2):
        if best_count < 3:
            return best, 0
        N, b = np.zeros((3, 3)), np.zeros(3)
        scale = tolerance * _norm_times_sine(best)
        for j in range(k):
            if _agrees(rays[j], best, scale):
                b += rays[j]
                for a in range(3):
                    N[a] += rays[j, a] * rays[j]
        m, ok = _solve3_matrix(N, b)
        if not ok:
            return best, 0
        best = m
        scale = tolerance * _norm_times_sine(best)
        best_count = _n_agree(rays, best, scale)
    return best, best_count


@njit(cache=True)
def _agrees(ray, m, scale):
    return abs(ray[0] * m[0] + ray[1] * m[1] + ray[2] * m[2] - 1.0) < scale


@njit(cache=True)
def _n_agree(rays, m, scale):
    count = 0
    for j in range(len(rays)):
        if _agrees(rays[j], m, scale):
            count += 1
    return count


@njit(cache=True)
def _norm_times_sine(m):
    """|m| sin(alpha): how fast n . m changes with the angle of a ray n on the cone."""
    square = 0.0
    for i in range(3):
        square += m[i] * m[i]
    return np.sqrt(max(square - 1.0, 1e-12))


@njit(cache=True)
def _solve3(a, b, c):
    A = np.empty((3, 3))
    A[0], A[1], A[2] = a, b, c
    return _solve3_matrix(A, np.ones(3))


@njit(cache=True)
def _solve3_matrix(A, b):
    """x (3,) of A x = b by Cramer's rule, and whether A is regular."""
    c0 = np.cross(A[1], A[2])
    det = A[0] @ c0
    size = np.sqrt((A[0] @ A[0]) * (c0 @ c0))
    if not abs(det) > 1e-9 * size or size == 0.0:
        return np.zeros(3), False
    c1, c2 = np.cross(A[2], A[0]), np.cross(A[0], A[1])
    return (b[0] * c0 + b[1] * c1 + b[2] * c2) / det, True


_angle = np.linspace(0.0, 2.0 * np.pi, N_RAYS, endpoint=False)
_ANGLES = np.stack([np.cos(_angle), np.sin(_angle)], axis=1)
