"""Finds a flat object of known colour and outline in an image: x, y and yaw.

1. "Strength" of a pixel: how much of the object's hue it has (ball_tracker.py); 0 for
   grey.
2. Without a guess: the outline's template, at every place and at many yaws, is
   correlated with a coarse image. Pixels of the object's colour count for a place, bare
   table against it; what hides the object (an arm) counts for neither.
3. Refinement from there, or from a guess: along the normal of each point of the outline
   the visible edge is where the strength rises half-way. Gauss-Newton with Tukey's
   weights fits the outline to the edges, which are searched again in each iteration.
4. An edge counts only if bare table lies outside of it (behind the object's own side,
   where perspective shows one): otherwise it is the rim of what hides the object.
5. There is no pose if the visible edges do not determine it (such as one straight edge,
   along which the object may slide).

The outline in the image is that of parts, each the convex hull of points at known
heights: exact in perspective. Yaw is determined up to the turns that leave the outline
unchanged (`fold`), and not at all for a disc.

Source: Harris, "Tracking with rigid models" (Active Vision, 1992) for the search along
normals; Holland, Welsch, Comm. Statistics A6 (1977) for the weights.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from makebreak.systems.perception.numerics.ball_tracker import MIN_STRENGTH, bilinear
from makebreak.systems.perception.numerics.object_outline import (
    Shape,
    convex_hull,
    each_part,
    half_planes,
    hull_order,
    nearest_yaw,
)
from makebreak.systems.perception.numerics.pinhole import FIXED_POINT_BITS, Pinhole

SPACING = 2.0  # Between points along the outline [px].
STEP = 0.5  # Between samples along a normal [px].
# Search range to either side of the outline in each iteration [px]. The last ones are
# as wide as the outline's error where a size is wrong by 10 % of a hand's width.
NEAR_WINDOWS = (6.0, 5.0, 5.0, 5.0, 5.0)
FAR_WINDOWS = (12.0, 9.0, 7.0, 6.0, 5.0, 5.0, 5.0, 5.0)
INLIER = 1.5  # Least scale of Tukey's weights, which end at three times the scale [px].
COARSE = 4  # Pixels of the image per pixel of the coarse image, along u and v.
YAW_STEP = np.deg2rad(10.0)  # Between templates.
N_CANDIDATES = 5  # Templates that are refined.
# Largest difference of table colour, of 765 (r + g + b): from the table about the
# object, and from the table elsewhere, where the light may differ.
TABLE_DIFFERENCE, TABLE_DIFFERENCE_ANYWHERE = 60.0, 130.0
WINDOW_MARGIN = 16.0  # Margin about the object in the part of an image searched [px].
STEP_MIN = 0.02  # A smaller step ends the iterations [px].
MIN_SEEN = 0.25  # Least visible fraction of the outline.
MAX_BARE = 0.2  # Largest fraction of the points well inside that show bare table.
INSET = 0.15  # Distance of these points from the outline, over the object's radius.
MIN_DETERMINED = 0.02  # Least eigenvalue of the normal equations, per point.


class Detection(NamedTuple):
    """An object in an image."""

    pose: np.ndarray  # (3,) x, y [m], yaw [rad].
    seen_part: float  # Visible fraction of the outline.
    rms_px: float  # Of the distances between outline and edges [px].


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
    """Finds the object in an image.

    Args:
        image: (height, width, 4) uint8 RGBA.
        camera: the pinhole model.
        hue_weights: from ball_tracker.strength_weights.
        shape: of the object.
        z: height of the object's frame [m].
        guess: (3,) x, y [m], yaw [rad]: the search is limited to its surroundings.
            None: the whole image is searched.
    Returns: a Detection, or None if the visible edges do not determine a pose.
    """
    usual = _usual_color(image)
    if guess is not None:
        guess = np.array(guess, float)
        low, high = _window(camera, shape, guess, z)
        if (high - low < 8).any():
            return None
        # A copy has the same memory layout for all sizes: one compiled version.
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
    """Corners low and high (2,) of the surroundings of a pose in the image [px]."""
    p_C = camera.to_camera(np.array([pose[0], pose[1], z]))
    depth = max(p_C[2] - shape.radius, 1e-3)
    middle = camera.focal * p_C[:2] / max(p_C[2], 1e-3) + camera.center
    half = camera.focal * shape.radius / depth * 1.2 + WINDOW_MARGIN
    size = [camera.width, camera.height]
    low = np.clip(middle - half, 0, size).astype(int)
    return low, np.clip(middle + half + 1.0, 0, size).astype(int)


# ----- Search by templates.


def _search(image, strength, camera, shape, z, usual):
    """The best few poses (3,) by templates in a coarse image."""
    level = float(np.percentile(strength, 99.5))
    if level < MIN_STRENGTH:
        level = float(strength.max())  # A small object.
    if level < MIN_STRENGTH:
        return []
    colored = strength > 0.5 * level
    table = _near_color(image, usual, TABLE_DIFFERENCE_ANYWHERE) & ~colored
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
        # From a pixel of the coarse image to one of the image, their middles.
        corner = (np.array(place) - [w, h]) * COARSE
        p = camera.meet_plane(camera.rays((corner + origin)[None])[0], z + shape.top)
        if p is not None:
            found.append((value, np.array([p[0], p[1], yaw])))
    found.sort(key=lambda each: -each[0])
    chosen: list[np.ndarray] = []
    for _, pose in found:
        if all(
            _yaw_apart(pose, other, shape.fold) > 2.0 * YAW_STEP for other in chosen
        ):
            chosen.append(pose)
    return chosen[:N_CANDIDATES]


def _yaw_apart(pose, other, fold):
    """Difference of the yaws of two poses [rad]; 0 if any turn is equivalent."""
    return abs(nearest_yaw(pose[2], fold, other[2]) - other[2]) if fold else 0.0


def _template(camera, shape, pose, z):
    """A template (h, w) float32, 1 at the coarse pixels of the object, and where the z
    axis of the object's frame, at the shape's height, is in it (2,) [px]."""
    corners = [_pixels(camera, part, pose, z) for part in each_part(shape.colored)]
    center = _pixels(camera, np.array([[0.0, 0.0, shape.top]]), pose, z)[0]
    low = np.floor(np.min([c.min(axis=0) for c in corners], axis=0)) - COARSE
    high = np.max([c.max(axis=0) for c in corners], axis=0) + COARSE
    n = np.ceil((high - low) / COARSE).astype(int)
    fine = np.zeros((n[1] * COARSE, n[0] * COARSE), np.float32)
    for uv in corners:
        hull = np.rint(convex_hull(uv - low) * 2**FIXED_POINT_BITS).astype(np.int32)
        cv2.fillConvexPoly(fine, hull, [1.0], cv2.LINE_8, FIXED_POINT_BITS)
    template = cv2.resize(fine, (n[0], n[1]), interpolation=cv2.INTER_AREA)
    return template, center - low


def _usual_color(image):
    """Median colour (3,) of an image: the table's, which covers most of it."""
    return np.median(image[::8, ::8, :3].reshape(-1, 3), axis=0)


def _near_color(image, color, within):
    """(h, w) bool: pixels that differ less than `within` from a colour (3,)."""
    return (
        abs(image[:, :, :3].astype(np.int16) - color.astype(np.int16)).sum(2) < within
    )


def _pixels(camera, points, pose, z):
    """Pixels (n, 2) of an object's points (n, 3)."""
    return _project(
        points, pose, z, camera.p_WC, camera.R_WC, camera.focal, camera.center
    )[0]


# ----- Refinement by edges.


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
    """Points of the outline of the coloured parts.

    Args: colored, whole: Parts as (points, start).
    Returns: uv (k, 2) [px]; outward normal (k, 2); J (k, 3), derivative of the point's
        position along the normal by the pose [px/m, px/rad]; beyond (k,), distance
        along the normal over which sides of other colours reach beyond the point [px].
    """
    points, start = colored
    all_uv, all_J = _project(points, pose, z, p_WC, R_WC, focal, center)
    m = len(start) - 1
    planes, n_planes = np.empty((m, len(points), 3)), np.empty(m, np.int64)
    corners = np.empty((m, len(points)), np.int64)
    most = 0
    for i in range(m):
        order = hull_order(all_uv[start[i] : start[i + 1]]) + start[i]
        n_planes[i] = len(order)
        corners[i, : len(order)] = order
        planes[i, : len(order)] = half_planes(all_uv[order])
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
                    # An edge that two parts share is used once.
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
    for _ in range(2):  # Twice, to pass from one part into the next.
        for i in range(len(start) - 1):
            part = all_uv[start[i] : start[i + 1]]
            side = half_planes(part[hull_order(part)])
            for k in range(len(uv)):
                beyond[k] = max(beyond[k], _leave(uv[k], normal[k], side, beyond[k]))
    return uv, normal, J, beyond


@njit(cache=True)
def _leave(uv, normal, planes, already):
    """Distance along its normal (2,) at which a point (2,) leaves a hull, if it is in
    the hull at the distance `already` or a pixel later; otherwise 0 [px]."""
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
    """A Detection near a pose (3,), with the outline fitted to the visible edges; None
    if they do not determine a pose.

    Args: image, strength: part of the image, from `corner` (2,) on [px]; usual (3,):
        median colour of the whole image.
    """
    n_free = 2 if shape.fold == 0 else 3
    image = image.view()
    image.setflags(write=False)  # Read-only or not: one compiled version for both.
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
    """Gauss-Newton iterations of _refine.

    Returns: pose (3,); visible fraction of the outline, 0 after a failure; rms of the
        residuals [px]; fraction of the points inside that show table; least eigenvalue
        of the normal equations, per point of the outline.
    """
    px = focal / max(p_WC[2] - z, 1e-3)  # Pixels per metre, approximately.
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
        # Converged, and the remaining windows are the same.
        if windows[round] == windows[-1] and np.abs(step).max() < STEP_MIN:
            break
    return pose, (weight > 0.0).sum() / k, rms, bare, np.linalg.eigvalsh(H / k)[0]


@njit(cache=True)
def _robust_step(A, offset):
    """Least squares A step = offset with Tukey's weights, starting with equal weights.

    Returns: step (n,), NaN if A is singular; weights and residuals after the step.
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
        if np.abs(step - before).max() < 0.3 * STEP_MIN:
            break
    return step, weight, residual


@njit(cache=True)
def _table_about(image, uv, normal, beyond, usual):
    """Colour (3,) of the table around an outline: the median of pixels just outside
    that are near the usual colour (3,); with a wider limit if there are few."""
    colors, n = np.empty((3, len(uv))), 0
    for within in (TABLE_DIFFERENCE, TABLE_DIFFERENCE_ANYWHERE):
        n = 0
        for i in range(len(uv)):
            u, v = uv[i] + (beyond[i] + 3.0) * normal[i]
            if not _in_image(image, u, v):
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
        fraction of the points `inset` inside that show bare table.
    """
    k = len(uv)
    offset, counts = np.zeros(k), np.zeros(k, np.bool_)
    n_half = int(np.ceil(window / STEP))
    profile = np.empty(2 * n_half + 7)  # From outside inwards, and a little farther.
    n_bare, n_in = 0, 0
    for i in range(k):
        u, v = uv[i] - inset * normal[i]
        if _in_image(strength, u, v):
            n_in += 1
            if _is_table(image, u, v, table):
                n_bare += 1
        highest = 0.0
        whole = True
        for j in range(len(profile)):
            t = (n_half - j) * STEP
            u, v = uv[i] + t * normal[i]
            if not _in_image(strength, u, v):
                whole = False
                break
            profile[j] = bilinear(strength, u, v)
            highest = max(highest, profile[j])
        if not whole or highest < MIN_STRENGTH:
            continue
        # The nearest place where, inwards, the strength rises through half of the value
        # that it reaches soon after.
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
        # It counts if there is bare table outside, behind the object's own side.
        t = best + 1.5
        while t <= best + beyond[i] + 3.0:
            u, v = uv[i] + t * normal[i]
            if _in_image(strength, u, v) and _is_table(image, u, v, table):
                counts[i] = True
                break
            t += STEP
    return offset, counts, n_bare / max(n_in, 1)


@njit(cache=True)
def _in_image(image, u, v):
    return 0.0 <= u <= image.shape[1] - 1 and 0.0 <= v <= image.shape[0] - 1


@njit(cache=True)
def _is_table(image, u, v, table):
    i, j = int(u + 0.5), int(v + 0.5)
    difference = 0.0
    for channel in range(3):
        difference += abs(image[j, i, channel] - table[channel])
    return difference < TABLE_DIFFERENCE
