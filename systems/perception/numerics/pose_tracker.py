"""Finds a flat object of known colour and outline in a picture: x, y and yaw.

1. "Strength": how much of the object's hue a pixel has (ball_tracker.py); 0 for greys.
2. Where it is looked for everywhere: the outline's template, at every place and at many
   yaws, is compared with a coarse picture. What has the object's colour speaks for a
   place, bare table against it; what hides the object (an arm) is neither.
3. From there, or from where the object should be: points of the outline, each with its
   normal; where along it the strength rises half-way, there is the visible edge. The
   pose for which the outline meets the edges is found by Gauss-Newton with Tukey's
   weights, edges being looked for anew each time.
4. An edge counts only if bare table lies outside of it (behind the object's own side,
   where perspective shows one): the rim of what hides the object is none.
5. What is left undetermined by the edges that are seen (one straight edge: how far
   along it) is not guessed: then there is no pose.

The outline in the picture is that of parts, each the convex hull of some points at a
known height: exact in perspective. Yaw is only known up to the turns that leave the
outline as it is (`fold`), and not at all of a disc.

Source: Harris, "Tracking with rigid models" (Active Vision, 1992) for the search along
normals; Holland, Welsch, Comm. Statistics A6 (1977) for the weights.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from makebreak.systems.perception.numerics.ball_tracker import MIN_STRENGTH
from makebreak.systems.perception.numerics.pinhole import FIXED_POINT_BITS, Pinhole

SPACING = 2.0  # [px] Of points along the outline.
STEP = 0.5  # [px] Along a normal.
# [px] To either side of the outline, round by round: the last ones are as wide as the
# outline is wrong where a size is, by 10 % of a hand's width.
NEAR_WINDOWS = (6.0, 5.0, 5.0, 5.0, 5.0)
FAR_WINDOWS = (12.0, 9.0, 7.0, 6.0, 5.0, 5.0, 5.0, 5.0)
INLIER = 1.5  # [px] Tukey's weights end at three times this, or at the residuals' own.
COARSE = 4  # Pixels of a coarse picture, each way.
YAW_STEP = np.deg2rad(10.0)  # Of templates.
N_CANDIDATES = 5  # Templates that are refined.
TABLE = 60.0  # Of 765 (r + g + b): so different is not the table about the object,
TABLE_ANYWHERE = 130.0  # or, by other light, elsewhere.
AROUND = 16.0  # [px] About the object, of the part of a picture that is looked at.
ENOUGH = 0.02  # [px] A step of less ends the search.
MIN_SEEN = 0.25  # Part of the outline that must be seen.
MAX_BARE = 0.2  # Part of the points well within it that may show bare table.
INSET = 0.15  # How far within, of the outline's radius.
MIN_DETERMINED = 0.02  # Least eigenvalue of the normal equations, per point.
MARKER_OFF = 0.2  # A marker's corners may be so far off, of its side.


class Parts(NamedTuple):
    """Convex hulls: the i-th is of points start[i] to start[i + 1] - 1."""

    points: np.ndarray  # (n, 3) [m] in the object's frame.
    start: np.ndarray  # (m + 1,)


@dataclass(frozen=True, eq=False)
class Shape:
    """What is seen of an object. Its parts may overlap."""

    colored: Parts  # Those that have the colour.
    whole: Parts  # All of it, with sides of other colours.
    fold: int  # So many turns about z leave it as it is; 0: any.
    radius: float  # Of the furthest point of the plan [m].


class Detection(NamedTuple):
    pose: np.ndarray  # (3,) x, y [m], yaw [rad].
    seen_part: float  # Of the outline, 0..1.
    rms_px: float  # Distance of the edges that count from the outline.


def make_shape(colored, whole=None) -> Shape:
    """Args: colored, whole: lists of (n, 3) [m] (Shape); whole None: all is coloured.

    Raises: ValueError for what is no list of points.
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
    plan = [_hull(part[:, :2]) for part in _each(lists[0])]
    radius = float(np.hypot(*lists[0].points[:, :2].T).max())
    return Shape(lists[0], lists[1], _fold(plan, radius), radius)


def _each(parts: Parts):
    """The points (n, 3) of each part."""
    return [parts.points[a:b] for a, b in pairwise(parts.start)]


@njit(cache=True)
def _hull_order(points):
    """Which points (n, 2) are their convex hull's corners, in order: Andrew's chain."""
    n = len(points)
    order = np.argsort(points[:, 0] + 1e-9 * points[:, 1])
    chain = np.empty(2 * n + 1, np.int64)
    size = 0
    for way in range(2):
        least = size + 1
        for k in range(n):
            i = order[k if way == 0 else n - 1 - k]
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


def _hull(points):
    """The convex hull (n, 2) of points (m, 2), in order."""
    return points[_hull_order(np.ascontiguousarray(points))]


@njit(cache=True)
def _half_planes(hull):
    """(n, 3): a x + b y + c, the distance outside of each edge of a hull (n, 2)."""
    n = len(hull)
    planes = np.empty((n, 3))
    for i in range(n):
        along = hull[(i + 1) % n] - hull[i]
        length = max(np.sqrt(along[0] ** 2 + along[1] ** 2), 1e-12)
        planes[i, 0], planes[i, 1] = along[1] / length, -along[0] / length
        planes[i, 2] = -planes[i, 0] * hull[i, 0] - planes[i, 1] * hull[i, 1]
    return planes


def _fold(plan, radius):
    """Into how many equal turns the union of hulls may be turned; 0 if by any."""
    planes = [_half_planes(hull) for hull in plan]

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
    """That turn of the same outline whose yaw is nearest to a reference [rad]."""
    if fold == 0:
        return reference
    turn = 2.0 * np.pi / fold
    return yaw + turn * np.round((reference - yaw) / turn)


def rolling_turn(rate, yaw, axis, height):
    """Angular velocity (3,) of an object that rolls without slipping [rad/s].

    Args: rate (3,) = v_x, v_y [m/s] and yaw's [rad/s]; axis (3,) that it rolls about,
        level, in its frame, zero: it slides; yaw [rad]; height of its origin [m].
    """
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.array([c * axis[0] - s * axis[1], s * axis[0] + c * axis[1]])
    about = (level[1] * rate[0] - level[0] * rate[1]) / height
    # v = w x (height z): w along the level axis.
    return np.array([*(about * level), rate[2]])


def find_pose(
    image, camera: Pinhole, hue_weights, shape: Shape, z, guess=None
) -> Detection | None:
    """The object in a picture.

    Args:
        image: (height, width, 4) uint8 RGBA.
        hue_weights: from ball_tracker.strength_weights.
        z: height of the object's frame [m].
        guess: (3,) x, y, yaw where the object should be: only its surroundings are
            searched. None: everywhere.

    Returns: a Detection, or None if there is no object to be seen, or not enough of it.
    """
    usual = _usual_color(image)
    if guess is not None:
        guess = np.array(guess, float)
        low, high = _window(camera, shape, guess, z)
        if (high - low < 8).any():
            return None
        # A copy has the same layout for each part: one machine code for all.
        image = image[low[1] : high[1], low[0] : high[0]].copy()
        strength = _strength(image, hue_weights)
        return _refine(
            image, strength, camera, low, shape, z, guess, usual, NEAR_WINDOWS
        )
    strength = _strength(image, hue_weights)
    best, best_merit = None, -np.inf
    corner = np.zeros(2, int)
    for start in _search(image, strength, camera, shape, z, usual):
        found = _refine(
            image, strength, camera, corner, shape, z, start, usual, FAR_WINDOWS
        )
        if found is not None:
            merit = found.seen_part - 0.1 * found.rms_px
            if merit > best_merit:
                best, best_merit = found, merit
    return best


def _strength(image, hue_weights):
    return cv2.GaussianBlur(cv2.transform(image, hue_weights), (3, 3), 0.0)


def _window(camera, shape, pose, z):
    """Corners low and high (2,) [px] of the surroundings of a pose, in the picture."""
    p_C = camera.to_camera(np.array([pose[0], pose[1], z]))
    depth = max(p_C[2] - shape.radius, 1e-3)
    middle = camera.focal * p_C[:2] / max(p_C[2], 1e-3) + camera.center
    half = camera.focal * shape.radius / depth * 1.2 + AROUND
    size = [camera.width, camera.height]
    low = np.clip(middle - half, 0, size).astype(int)
    return low, np.clip(middle + half + 1.0, 0, size).astype(int)


# ----- Where it may be.


def _search(image, strength, camera, shape, z, usual):
    """The best few places (3,) x, y, yaw by templates in a coarse picture."""
    level = float(np.percentile(strength, 99.5))
    if level < MIN_STRENGTH:
        level = float(strength.max())  # A small object.
    if level < MIN_STRENGTH:
        return []
    colored = strength > 0.5 * level
    table = _like(image, usual, TABLE_ANYWHERE) & ~colored
    vote = 2.0 * colored.astype(np.float32) - table.astype(np.float32)
    size = (camera.width // COARSE, camera.height // COARSE)
    vote = cv2.resize(vote, size, interpolation=cv2.INTER_AREA)
    below = camera.p_WC[:2]
    n = 1 if shape.fold == 0 else int(np.ceil(2.0 * np.pi / shape.fold / YAW_STEP))
    found = []
    for i in range(n):
        yaw = 0.0 if shape.fold == 0 else 2.0 * np.pi / shape.fold * i / n
        template, origin = _template(camera, shape, np.array([*below, yaw]), z)
        h, w = template.shape
        padded = cv2.copyMakeBorder(vote, h, h, w, w, cv2.BORDER_CONSTANT, value=0)
        score = cv2.matchTemplate(padded, template, cv2.TM_CCORR)
        _, value, _, place = cv2.minMaxLoc(score)
        # From a coarse pixel to a pixel: middles of both.
        corner = (np.array(place) - [w, h]) * COARSE
        p = camera.meet_plane(camera.rays((corner + origin)[None])[0], z + _top(shape))
        if p is not None:
            found.append((value, np.array([p[0], p[1], yaw])))
    found.sort(key=lambda each: -each[0])
    chosen: list[np.ndarray] = []
    for _, pose in found:
        if all(_turned(pose, other, shape.fold) > 2.0 * YAW_STEP for other in chosen):
            chosen.append(pose)
    return chosen[:N_CANDIDATES]


def _top(shape):
    """Height of what is seen over the object's frame, about [m]."""
    return float(shape.colored.points[:, 2].mean())


def _turned(pose, other, fold):
    return abs(nearest_yaw(pose[2], fold, other[2]) - other[2]) if fold else 0.0


def _template(camera, shape, pose, z):
    """(h, w) float32, 1 where a coarse pixel is the object's; and where the axis of the
    object's frame, at the height of what is seen, is in it (2,) [px]."""
    corners = [_pixels(camera, part, pose, z) for part in _each(shape.colored)]
    center = _pixels(camera, np.array([[0.0, 0.0, _top(shape)]]), pose, z)[0]
    low = np.floor(np.min([c.min(axis=0) for c in corners], axis=0)) - COARSE
    high = np.max([c.max(axis=0) for c in corners], axis=0) + COARSE
    n = np.ceil((high - low) / COARSE).astype(int)
    fine = np.zeros((n[1] * COARSE, n[0] * COARSE), np.float32)
    for uv in corners:
        hull = np.rint(_hull(uv - low) * 2**FIXED_POINT_BITS).astype(np.int32)
        cv2.fillConvexPoly(fine, hull, [1.0], cv2.LINE_8, FIXED_POINT_BITS)
    template = cv2.resize(fine, (n[0], n[1]), interpolation=cv2.INTER_AREA)
    return template, center - low


def _usual_color(image):
    """(3,) the median colour of a picture: the table's, as most of it is table."""
    return np.median(image[::8, ::8, :3].reshape(-1, 3), axis=0)


def _like(image, color, within):
    return (
        abs(image[:, :, :3].astype(np.int16) - color.astype(np.int16)).sum(2) < within
    )


def _pixels(camera, points, pose, z):
    """Pixels (n, 2) of an object's points (n, 3)."""
    return _project(
        points, pose, z, camera.p_WC, camera.R_WC, camera.focal, camera.center
    )[0]


# ----- Where it is.


@njit(cache=True)
def _project(points, pose, z, p_WC, R_WC, focal, center):
    """Pixels (n, 2) of an object's points (n, 3), and their derivatives in the pose
    (n, 2, 3)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    n = len(points)
    uv, J = np.empty((n, 2)), np.empty((n, 2, 3))
    p_W, p_C, d_C = np.empty(3), np.empty(3), np.empty((3, 3))
    for k in range(n):
        x = c * points[k, 0] - s * points[k, 1]
        y = s * points[k, 0] + c * points[k, 1]
        p_W[0], p_W[1], p_W[2] = pose[0] + x, pose[1] + y, z + points[k, 2]
        for i in range(3):
            p_C[i] = 0.0
            for j in range(3):
                p_C[i] += (p_W[j] - p_WC[j]) * R_WC[j, i]
            d_C[i, 0], d_C[i, 1] = R_WC[0, i], R_WC[1, i]
            d_C[i, 2] = -y * R_WC[0, i] + x * R_WC[1, i]
        depth = max(p_C[2], 1e-3)
        for i in range(2):
            uv[k, i] = focal * p_C[i] / depth + center[i]
            for j in range(3):
                J[k, i, j] = (
                    focal * d_C[i, j] - focal * p_C[i] / depth * d_C[2, j]
                ) / depth
    return uv, J


@njit(cache=True)
def _outline(colored, whole, pose, z, p_WC, R_WC, focal, center):
    """Points of the outline of what has the object's colour.

    Args: colored, whole: Parts as (points, start).
    Returns: uv (k, 2) [px]; outward normal (k, 2); J (k, 3) of the point's place along
        the normal, in the pose [px/m, px/rad]; how far along it the object reaches
        beyond, with its sides (k,) [px].
    """
    points, start = colored
    all_uv, all_J = _project(points, pose, z, p_WC, R_WC, focal, center)
    m = len(start) - 1
    planes, n_planes = np.empty((m, len(points), 3)), np.empty(m, np.int64)
    corners = np.empty((m, len(points)), np.int64)
    most = 0
    for i in range(m):
        order = _hull_order(all_uv[start[i] : start[i + 1]]) + start[i]
        n_planes[i] = len(order)
        corners[i, : len(order)] = order
        planes[i, : len(order)] = _half_planes(all_uv[order])
        for j in range(len(order)):
            edge = all_uv[order[(j + 1) % len(order)]] - all_uv[order[j]]
            most += int(np.sqrt(edge[0] ** 2 + edge[1] ** 2) / SPACING) + 1
    uv, normal = np.empty((most, 2)), np.empty((most, 2))
    J, beyond = np.empty((most, 3)), np.zeros(most)
    k = 0
    for i in range(m):
        n = n_planes[i]
        for j in range(n):
            a, b = corners[i, j], corners[i, (j + 1) % n]
            edge = all_uv[b] - all_uv[a]
            pieces = int(np.sqrt(edge[0] ** 2 + edge[1] ** 2) / SPACING) + 1
            for piece in range(pieces):
                t = (piece + 0.5) / pieces
                at = all_uv[a] + t * edge
                free = True
                for other in range(m):
                    if other == i:
                        continue
                    outside = -np.inf
                    for q in range(n_planes[other]):
                        plane = planes[other, q]
                        outside = max(
                            outside, plane[0] * at[0] + plane[1] * at[1] + plane[2]
                        )
                    # An edge that two parts share counts once.
                    if outside < (-0.3 if other > i else 0.3):
                        free = False
                if not free:
                    continue
                uv[k] = at
                normal[k] = planes[i, j, :2]
                for axis in range(3):
                    J[k, axis] = 0.0
                    for c in range(2):
                        moved = (1.0 - t) * all_J[a, c, axis] + t * all_J[b, c, axis]
                        J[k, axis] += normal[k, c] * moved
                k += 1
    uv, normal, J, beyond = uv[:k], normal[:k], J[:k], beyond[:k]
    points, start = whole
    all_uv, _ = _project(points, pose, z, p_WC, R_WC, focal, center)
    for _ in range(2):  # From one part into the next.
        for i in range(len(start) - 1):
            part = all_uv[start[i] : start[i + 1]]
            side = _half_planes(part[_hull_order(part)])
            for k in range(len(uv)):
                beyond[k] = max(beyond[k], _leave(uv[k], normal[k], side, beyond[k]))
    return uv, normal, J, beyond


@njit(cache=True)
def _leave(uv, normal, planes, already):
    """How far a point (2,) has to go along its normal (2,) to leave a hull, if it is in
    it after `already` or a pixel later; else 0."""
    t_in, t_out = -np.inf, np.inf
    for plane in planes:
        distance = plane[0] * uv[0] + plane[1] * uv[1] + plane[2]
        speed = plane[0] * normal[0] + plane[1] * normal[1]
        distance += already * speed
        if speed > 1e-9:
            t_out = min(t_out, -distance / speed)
        elif speed < -1e-9:
            t_in = max(t_in, -distance / speed)
        elif distance > 0.5:
            return 0.0
    return already + t_out if t_in < t_out and t_in < 1.0 and t_out > 0.0 else 0.0


def _refine(image, strength, camera, corner, shape, z, pose, usual, windows):
    """The pose near a given one (3,) for which the outline meets the visible edges: a
    Detection or None.

    Args: image, strength: of a part of the picture that begins at corner (2,) [px];
        usual (3,): the whole picture's usual colour.
    """
    n_free = 2 if shape.fold == 0 else 3
    image = image.view()
    image.setflags(write=False)  # Whatever it came as: one machine code for all.
    pose, seen_part, rms, bare, determined = _fit(
        image, strength, shape.colored, shape.whole, pose, z, camera.p_WC, camera.R_WC,
        camera.focal, camera.center - corner, usual, shape.radius, n_free,
        np.array(windows),
    )  # fmt: skip
    if seen_part < MIN_SEEN or bare > MAX_BARE or not np.isfinite(pose).all():
        return None
    return Detection(pose, seen_part, rms) if determined >= MIN_DETERMINED else None


@njit(cache=True)
def _fit(
    image, strength, colored, whole, pose, z, p_WC, R_WC, focal, center, usual, radius,
    n_free, windows,
):  # fmt: skip
    """Returns: pose (3,); part of the outline that is seen, 0 where it is no good; rms
    of the residuals [px]; part of the points within that show table; the least
    eigenvalue of the normal equations, per point of the outline."""
    px = focal / max(p_WC[2] - z, 1e-3)  # Per metre, about.
    scale = np.array([1.0, 1.0, 1.0 / radius])[:n_free] / px
    inset = INSET * radius * px
    pose = pose.copy()
    rms, bare, k = 0.0, 1.0, 1
    weight, H = np.zeros(1), np.zeros((n_free, n_free))
    for round in range(len(windows)):
        uv, normal, J, beyond = _outline(
            colored, whole, pose, z, p_WC, R_WC, focal, center
        )
        k = len(uv)
        table = _table_about(image, uv, normal, beyond, usual)
        offset, counts, bare = _edges(
            image, strength, uv, normal, beyond, table, windows[round], inset
        )
        if counts.sum() < max(MIN_SEEN * k, n_free + 1.0):
            return pose, 0.0, rms, bare, 0.0
        A = J[counts][:, :n_free] * scale
        step, weight, residual = _robust_step(A, offset[counts])
        for i in range(n_free):
            pose[i] += step[i] * scale[i]
        if not np.isfinite(pose).all():
            return pose, 0.0, rms, bare, 0.0
        H = (A * weight.reshape(-1, 1)).T @ A
        rms = np.sqrt((residual[weight > 0.0] ** 2).mean())
        # The last windows are alike: there is nothing more to gain.
        if windows[round] == windows[-1] and np.abs(step).max() < ENOUGH:
            break
    return pose, (weight > 0.0).sum() / k, rms, bare, np.linalg.eigvalsh(H / k)[0]


@njit(cache=True)
def _robust_step(A, offset):
    """Least squares A step = offset with Tukey's weights, from all points at first.

    Returns: step (n,), NaN where there is none; weights and residuals after the step.
    """
    n = A.shape[1]
    weight, residual = np.ones(len(offset)), offset.copy()
    step = np.full(n, np.nan)
    for _ in range(6):
        H = (A * weight.reshape(-1, 1)).T @ A
        if not np.linalg.eigvalsh(H)[0] > 1e-6 * len(offset):
            return np.full(n, np.nan), weight, residual
        before = step
        step = np.linalg.solve(H, A.T @ (weight * offset))
        residual = offset - A @ step
        end = 3.0 * max(INLIER, 1.4826 * np.median(np.abs(residual)))
        for i in range(len(residual)):
            u = residual[i] / end
            weight[i] = (1.0 - u**2) ** 2 if abs(u) < 1.0 else 0.0
        if np.abs(step - before).max() < 0.3 * ENOUGH:
            break
    return step, weight, residual


@njit(cache=True)
def _table_about(image, uv, normal, beyond, usual):
    """(3,) colour of the table around an outline: the median of what lies just outside
    and is near to the usual colour (3,), or not far from it where little is near."""
    colors, n = np.empty((3, len(uv))), 0
    for within in (TABLE, TABLE_ANYWHERE):
        n = 0
        for i in range(len(uv)):
            u, v = uv[i] + (beyond[i] + 3.0) * normal[i]
            if not _in_picture(image, u, v):
                continue
            pixel = image[int(v + 0.5), int(u + 0.5)]
            difference = 0.0
            for channel in range(3):
                difference += abs(pixel[channel] - usual[channel])
            if difference < within:
                for channel in range(3):
                    colors[channel, n] = pixel[channel]
                n += 1
        if n > MIN_SEEN * len(uv):
            break
    table = usual.copy()
    if n > 5:
        for channel in range(3):
            table[channel] = np.median(colors[channel, :n])
    return table


@njit(cache=True)
def _edges(image, strength, uv, normal, beyond, table, window, inset):
    """The visible edge beside each point of an outline.

    Args: image, strength: (h, w, 4), (h, w) uint8; uv, normal (k, 2); beyond (k,);
        table (3,); window, inset [px].
    Returns: offset (k,) of the edge along the normal [px]; whether it counts (k,); the
        part of the points `inset` within that show bare table.
    """
    k = len(uv)
    offset, counts = np.zeros(k), np.zeros(k, np.bool_)
    n_half = int(np.ceil(window / STEP))
    profile = np.empty(2 * n_half + 7)  # From outside inwards, some further.
    n_bare, n_in = 0, 0
    for i in range(k):
        u, v = uv[i] - inset * normal[i]
        if _in_picture(strength, u, v):
            n_in += 1
            if _is_table(image, u, v, table):
                n_bare += 1
        highest = 0.0
        whole = True
        for j in range(len(profile)):
            t = (n_half - j) * STEP
            u, v = uv[i] + t * normal[i]
            if not _in_picture(strength, u, v):
                whole = False
                break
            profile[j] = _bilinear(strength, u, v)
            highest = max(highest, profile[j])
        if not whole or highest < MIN_STRENGTH:
            continue
        # The nearest place where the strength rises, on the way in, half-way to what
        # it reaches soon after.
        best = np.inf
        for j in range(1, 2 * n_half + 1):
            soon = profile[j]
            for m in range(j + 1, min(j + 6, len(profile))):
                soon = max(soon, profile[m])
            half = 0.5 * soon
            if soon < MIN_STRENGTH or not profile[j - 1] < half <= profile[j]:
                continue
            part = (half - profile[j - 1]) / (profile[j] - profile[j - 1])
            t = (n_half - (j - 1 + part)) * STEP
            if abs(t) < abs(best):
                best = t
        if abs(best) > window:
            continue
        offset[i] = best
        # Bare table outside, behind the object's own side.
        t = best + 1.5
        while t <= best + beyond[i] + 3.0:
            u, v = uv[i] + t * normal[i]
            if _in_picture(strength, u, v) and _is_table(image, u, v, table):
                counts[i] = True
                break
            t += STEP
    return offset, counts, n_bare / max(n_in, 1)


@njit(cache=True)
def _in_picture(picture, u, v):
    return 0.0 <= u <= picture.shape[1] - 1 and 0.0 <= v <= picture.shape[0] - 1


@njit(cache=True)
def _bilinear(picture, u, v):
    i, j = min(int(u), picture.shape[1] - 2), min(int(v), picture.shape[0] - 2)
    a, b = u - i, v - j
    top = (1.0 - a) * picture[j, i] + a * picture[j, i + 1]
    bottom = (1.0 - a) * picture[j + 1, i] + a * picture[j + 1, i + 1]
    return (1.0 - b) * top + b * bottom


@njit(cache=True)
def _is_table(image, u, v, table):
    i, j = int(u + 0.5), int(v + 0.5)
    difference = 0.0
    for channel in range(3):
        difference += abs(image[j, i, channel] - table[channel])
    return difference < TABLE


# ----- A marker on the object, in place of its outline.


def find_marker(image, camera: Pinhole, number, corners, z) -> Detection | None:
    """The pose of an object by an ArUco marker (of the dictionary 4X4_50) on it.

    Args:
        image: (height, width, 4) uint8 RGBA.
        number: of the marker.
        corners: (4, 3) [m] of the marker in the object's frame, in the order that
            OpenCV gives them: clockwise, seen from above, from its upper left one.
        z: height of the object's frame [m].
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    seen, numbers, _ = _marker_detector().detectMarkers(grey)
    if numbers is None or number not in numbers:
        return None
    uv = np.asarray(seen[list(numbers.ravel()).index(number)], float).reshape(4, 2)
    rays = camera.rays(uv)
    p_W = [
        camera.meet_plane(ray, z + corner[2])
        for ray, corner in zip(rays, corners, strict=True)
    ]
    if any(p is None for p in p_W):
        return None
    a, b = np.asarray(corners, float)[:, :2], np.array(p_W)[:, :2]
    a_0, b_0 = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = (a_0[:, 0] * b_0[:, 1] - a_0[:, 1] * b_0[:, 0]).sum()
    yaw = float(np.arctan2(cross, (a_0 * b_0).sum()))
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s], [s, c]])
    p = b.mean(axis=0) - R @ a.mean(axis=0)
    off = np.hypot(*(a @ R.T + p - b).T)
    if off.max() > MARKER_OFF * np.hypot(*(a[1] - a[0])):  # Of another size: not ours.
        return None
    depth = camera.p_WC[2] - z
    return Detection(np.array([*p, yaw]), 1.0, float(off.mean()) * camera.focal / depth)


@cache
def _marker_detector():
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.ArucoDetector(dictionary, parameters)
