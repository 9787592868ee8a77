"""A pinhole camera: projection, and drawing of simple shapes.

Frames: W world, C camera (z along the view, x to the right and y down in the image).
Pixels (u, v): the centre of the first pixel is (0, 0), u to the right, v down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

FIXED_POINT_BITS = 8  # cv2 draws polygons with 1/256 of a pixel.
NEAR = 0.01  # Shapes that reach nearer to the camera's plane are not drawn [m].
N_OUTLINE = 48  # Corners of a circle; its sagitta is 0.002 of the radius.
BANDS = (0.3, 0.55, 0.8, 1.0)  # Cosines between which a sphere is drawn in one shade.

SHAPES = ("sphere", "capsule", "cylinder", "box", "ellipsoid")
SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID = range(5)


def _unit_bodies():
    """Points on the surface of a cylinder, a box and an ellipsoid of extents 1, 1, 1,
    whose convex hulls are these shapes."""
    angle = np.linspace(0.0, 2.0 * np.pi, N_OUTLINE, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.ones(N_OUTLINE)], axis=1)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
    turns = Rotation.from_euler(
        "x", np.linspace(0.0, np.pi, 24, endpoint=False)[:, None]
    )
    sphere = np.concatenate([R.apply(ring * [1.0, 1.0, 0.0]) for R in turns])
    cylinder = np.concatenate([ring, ring * [1.0, 1.0, -1.0]])
    return cylinder, np.ascontiguousarray(corners), sphere


_CYLINDER, _BOX, _ELLIPSOID = _unit_bodies()


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion and with square pixels."""

    width: int  # [px]
    height: int  # [px]
    focal: float  # [px]
    center: np.ndarray  # (2,) of the optical axis in the image [px].
    p_WC: np.ndarray  # (3,) [m]
    R_WC: np.ndarray  # (3, 3)

    def __post_init__(self):
        if self.width < 1 or self.height < 1 or not self.focal > 0.0:
            raise ValueError(
                "Pinhole: width, height and focal length must be positive, got "
                f"{self.width}, {self.height}, {self.focal}"
            )
        for name, shape in dict(center=(2,), p_WC=(3,), R_WC=(3, 3)).items():
            value = np.array(getattr(self, name), dtype=float)  # Our own copy.
            if value.shape != shape:
                raise ValueError(f"Pinhole.{name} is {value.shape}, expected {shape}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def project(self, p_C):
        """Pixels (n, 2) of points (n, 3) [m] in C in front of the camera."""
        return self.focal * p_C[:, :2] / p_C[:, 2:] + self.center

    def rays(self, uv):
        """Unit vectors (n, 3) in C towards pixels uv (n, 2)."""
        ray = np.ones((len(uv), 3))
        ray[:, :2] = (uv - self.center) / self.focal
        return ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def to_camera(self, p_W):
        """Points (n, 3) or a point (3,) of the world in C [m]."""
        return (p_W - self.p_WC) @ self.R_WC

    def meet_plane(self, ray, z):
        """The point (3,) in the world where a ray (3,) in C from the camera meets the
        plane at height z [m]; None if it does not."""
        direction = self.R_WC @ ray
        drop = z - self.p_WC[2]
        if not drop * direction[2] > 0.0:
            return None
        return self.p_WC + direction * (drop / direction[2])


def look_down(width, height, fov_y, position, center_shift=0.0) -> Pinhole:
    """A camera that looks straight down, with the world's +x up in the image.

    Args:
        width, height: [px]; fov_y: field of view along the height [rad].
        position: (3,) of the camera [m].
        center_shift: of the optical axis from the image's middle, in u and v [px].
    Raises: ValueError for a field of view out of range.
    """
    if not 0.0 < fov_y < np.pi:
        raise ValueError(f"fov_y must be between 0 and pi, got {fov_y}")
    center = np.array([width - 1, height - 1]) / 2 + center_shift
    focal = height / 2 / np.tan(fov_y / 2)
    R_WC = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return Pinhole(width, height, focal, center, np.asarray(position, float), R_WC)


@njit(cache=True)
def sphere_circle(p, radius, cos_angle):
    """A circle (N_OUTLINE, 3) on a sphere about the line to the camera, in C [m].

    Args:
        p: (3,) the sphere's centre in C [m]; the camera is outside of the sphere.
        radius: [m].
        cos_angle: cosine of the angle at the sphere's centre between the circle and the
            camera; radius / |p| gives the outline in the image.
    """
    distance = np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
    x, y, z = p / distance
    # Two directions square to the axis, which is nearer to C's z than to its x.
    side = np.sqrt(z**2 + x**2)
    rim = radius * np.sqrt(1.0 - cos_angle**2)
    e1 = np.array([z, 0.0, -x]) * (rim / side)
    e2 = np.array([-x * y, z**2 + x**2, -y * z]) * (rim / side)  # axis x e1
    center = p * (1.0 - radius * cos_angle / distance)
    points = np.empty((N_OUTLINE, 3))
    for i in range(N_OUTLINE):
        angle = 2.0 * np.pi * i / N_OUTLINE
        points[i] = center + np.cos(angle) * e1 + np.sin(angle) * e2
    return points


def draw(image, camera, shape, size, p, R, color):
    """Draws one shape, lit from the camera (a sphere is dim at its rim).

    Args:
        image: (height, width, 3) or (height, width, 4) uint8.
        camera: a Pinhole.
        shape: "sphere", "capsule", "cylinder", "box" or "ellipsoid".
        size: [m] as Drake has it: (radius,), (radius, length), (radius, length),
            (width, depth, height), (a, b, c).
        p, R: (3,), (3, 3) pose of the shape in C [m].
        color: (3,), 0..255, in full light.
    """
    extent = extents(shape, size)
    if visible(p[None], extent[None], camera)[0]:
        draw_visible(image, camera, SHAPES.index(shape), extent, p, R, color)


def extents(shape, size):
    """Half extents (3,) of a shape along its axes [m]; for a capsule radius, radius and
    half its length without the caps."""
    if shape == "sphere":
        return np.array([size[0], size[0], 0.0])
    if shape in ("capsule", "cylinder"):
        return np.array([size[0], size[0], size[1] / 2])
    return np.asarray(size, float) / (2.0 if shape == "box" else 1.0)


def visible(p, extent, camera):
    """Whether shapes may be in the image (n,), by bounding spheres.

    Args: p (n, 3): their centres in C [m]; extent (n, 3): of `extents` [m].
    """
    return _visible(p, extent, camera.focal, camera.center, camera.width, camera.height)


@njit(cache=True)
def _visible(p, extent, focal, center, width, height):
    seen = np.empty(len(p), np.bool_)
    for j in range(len(p)):
        # At least a box's corner; for a capsule half its length plus a radius.
        radius = np.hypot(extent[j, 0], extent[j, 1]) + extent[j, 2]
        seen[j] = p[j, 2] + radius > NEAR
        for i, n in enumerate((width, height)):
            # Planes through the camera and one pixel outside of the image's border.
            for edge, sign in ((-1.0, 1.0), (float(n), -1.0)):
                slope = (edge - center[i]) / focal
                away = sign * (slope * p[j, 2] - p[j, i]) / np.sqrt(1.0 + slope**2)
                seen[j] &= away < radius
    return seen


def draw_visible(image, camera, kind, extent, p, R, color, points=None):
    """As draw, for a shape that `visible` has found visible.

    Args: kind: index into SHAPES; points (n, 3): relative to p, if the shape is their
        convex hull (kind is then unused) [m].
    """
    if points is None:
        corners = _corners(kind, extent, p, R, camera.focal, camera.center)
    else:
        kind, corners = BOX, p + points @ R.T
        corners = (
            corners[:0] if corners[:, 2].min() <= NEAR else camera.project(corners)
        )
    if len(corners) == 0:
        return
    if kind != SPHERE:
        paint(image, corners, color)
        return
    paint_exactly(image, corners, np.multiply(color, BANDS[0] / 2))
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        corners = camera.project(sphere_circle(p, extent[0], low))
        paint(image, corners, np.multiply(color, (low + high) / 2))


@njit(cache=True)
def _corners(kind, extent, p, R, focal, center):
    """Pixels (n, 2) whose convex hull is the shape in the image; (0, 2) for a shape
    that reaches nearer to the camera's plane than NEAR."""
    if kind == SPHERE or kind == CAPSULE:
        half = np.ascontiguousarray(R[:, 2]) * extent[2]
        radius = extent[0]
        if p[2] - abs(half[2]) < NEAR + radius:
            return np.empty((0, 2))
        n = 1 if kind == SPHERE else 2
        points = np.empty((n * N_OUTLINE, 3))
        for i in range(n):
            end = p + (2 * i - 1) * half
            cos_angle = radius / np.sqrt(end[0] ** 2 + end[1] ** 2 + end[2] ** 2)
            circle = sphere_circle(end, radius, cos_angle)
            points[i * N_OUTLINE : (i + 1) * N_OUTLINE] = circle
    else:
        unit = _CYLINDER if kind == CYLINDER else _BOX if kind == BOX else _ELLIPSOID
        points = np.empty((len(unit), 3))
        for i in range(len(unit)):
            for j in range(3):
                points[i, j] = p[j]
                for k in range(3):
                    points[i, j] += R[j, k] * extent[k] * unit[i, k]
    corners = np.empty((len(points), 2))
    for i in range(len(points)):
        if points[i, 2] <= NEAR:
            return np.empty((0, 2))
        for j in range(2):
            corners[i, j] = focal * points[i, j] / points[i, 2] + center[j]
    return corners


def paint(image, corners, color):
    """Fills the convex hull of corners (n, 2) [px] in image (h, w, 3) or (h, w, 4)."""
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
    shade = [float(color[0]), float(color[1]), float(color[2]), 255.0]
    cv2.fillConvexPoly(image, _inset(hull, 0.5), shade, cv2.LINE_AA, FIXED_POINT_BITS)


@njit(cache=True)
def _inset(hull, by):
    """A convex polygon (n, 2) moved inwards by `by` [px], in cv2's fixed-point numbers:
    OpenCV fills an area that is larger than the polygon by as much."""
    n = len(hull)
    fixed = np.empty((n, 2), np.int32)
    limit = 2.0**30
    for i in range(n):
        last, then = (i if i > 0 else n) - 1, (i + 1) % n
        before_u, before_v = hull[i, 0] - hull[last, 0], hull[i, 1] - hull[last, 1]
        after_u, after_v = hull[then, 0] - hull[i, 0], hull[then, 1] - hull[i, 1]
        inner_u, inner_v = hull[i, 0], hull[i, 1]
        a = np.sqrt(before_u**2 + before_v**2)
        b = np.sqrt(after_u**2 + after_v**2)
        if a > 0.0 and b > 0.0:
            before_u, before_v = before_u / a, before_v / a
            after_u, after_v = after_u / b, after_v / b
            # v = hull[i] + step (normal before + normal after), both normals unit.
            turn = before_u * after_v - before_v * after_u  # Sign: orientation.
            side = 1.0 if turn > 0.0 else -1.0
            cosine = before_u * after_u + before_v * after_v
            step = side * by / max(1.0 + cosine, 0.3)
            inner_u -= step * (before_v + after_v)
            inner_v += step * (before_u + after_u)
        fixed[i, 0] = min(max(np.rint(inner_u * 2**FIXED_POINT_BITS), -limit), limit)
        fixed[i, 1] = min(max(np.rint(inner_v * 2**FIXED_POINT_BITS), -limit), limit)
    return fixed


def paint_exactly(image, corners, color):
    """As paint, with border pixels blended by the fraction that is covered."""
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
    _mix(image, hull, np.asarray(color, float))


@njit(cache=True)
def _mix(image, hull, color):
    n = len(hull)
    # Edges as normal (a, b) outwards and offset c, per a pixel's extent along it.
    edge = np.zeros((n, 3))
    middle_u, middle_v = hull[:, 0].mean(), hull[:, 1].mean()
    for i in range(n):
        u, v = hull[i]
        a, b = hull[(i + 1) % n, 1] - v, u - hull[(i + 1) % n, 0]
        extent = abs(a) + abs(b)
        if extent == 0.0:
            continue
        if a * (u - middle_u) + b * (v - middle_v) < 0.0:
            a, b = -a, -b
        edge[i] = a / extent, b / extent, (a * u + b * v) / extent
    left = max(int(np.floor(hull[:, 0].min())), 0)
    right = min(int(np.ceil(hull[:, 0].max())) + 1, image.shape[1])
    top = max(int(np.floor(hull[:, 1].min())), 0)
    bottom = min(int(np.ceil(hull[:, 1].max())) + 1, image.shape[0])
    for v in range(top, bottom):
        for u in range(left, right):
            # Covered fraction by the edge that cuts off most; 0.5 at the centre.
            part = 1.0
            for i in range(n):
                part = min(part, 0.5 - (edge[i, 0] * u + edge[i, 1] * v - edge[i, 2]))
                if part <= 0.0:
                    break
            if part > 0.0:
                for k in range(3):
                    mixed = image[v, u, k] * (1.0 - part) + color[k] * part
                    image[v, u, k] = np.uint8(mixed + 0.5)


def frame_shift(seed, frame):
    """Standard normal numbers (2,), a function of seed >= 0 and frame >= 0."""
    bits = np.random.Philox(key=seed, counter=[0, 0, 0, frame])
    return np.random.Generator(bits).standard_normal(2)


@njit(cache=True, fastmath={"contract"})
def shifted(image, u, v, out):
    """Fills `out` with the image shifted by u, v [px], by linear interpolation.

    Pixels from outside of the image repeat its border. In single precision, with fused
    multiply-adds where the processor has them: the same result as cv2.warpAffine in
    less time, because all pixels have the same weights.

    Args: image, out: (height, width, n) uint8, two arrays, contiguous.
    """
    height, width, n = image.shape
    row = width * n
    source, result = image.reshape(height, row), out.reshape(height, row)
    left, weight = np.empty(width, np.int64), np.empty(row, np.float32)
    for j in range(width):
        left[j], part = _split(j, u)
        for k in range(n):
            weight[j * n + k] = part
    # Columns from `first` to before `end` have both neighbours in the image, and
    # `left` is a fixed number of columns away.
    start = left[width // 2] - width // 2
    # (None, if the image is shifted by more than its width.)
    first = min(max(0, -start), width)
    end = max(min(width, width - 1 - start), 0)
    while first < end and left[first] != first + start:
        first += 1
    while end > first and left[end - 1] != end - 1 + start:
        end -= 1
    mixed = np.empty((2, row), np.float32)  # Two rows, interpolated along u.
    held = np.full(2, -1)
    for i in range(height):
        at, part = _split(i, v)
        for k in range(2):
            line = min(max(at + k, 0), height - 1)
            if held[line % 2] != line:
                held[line % 2] = line
                _mix_row(source[line], mixed[line % 2], left, weight, first, end, n)
        low = mixed[min(max(at, 0), height - 1) % 2]
        high = mixed[min(max(at + 1, 0), height - 1) % 2]
        _mix_rows(low, high, part, result[i])


@njit(cache=True)
def _split(i, shift):
    """The pixel before i - shift, and the distance from it."""
    place = np.float32(np.float32(i) - np.float32(shift))
    before = np.floor(place)
    return int(before), np.float32(place - before)


@njit(cache=True, fastmath={"contract"})
def _mix_row(source, mixed, left, weight, first, end, n):
    width = left.size
    a, b = first * n, end * n
    if b > a:
        at = left[first] * n
        _mix_run(source[at:], source[at + n :], weight[a:b], mixed[a:b])
    for j in range(first):
        _mix_edge(source, mixed, left[j], weight, j, n)
    for j in range(max(first, end), width):
        _mix_edge(source, mixed, left[j], weight, j, n)


@njit(cache=True, fastmath={"contract"})
def _mix_edge(source, mixed, left, weight, j, n):
    """Column j, whose neighbours may lie outside of the image."""
    last = mixed.size // n - 1
    p = min(max(left, 0), last) * n
    q = min(max(left + 1, 0), last) * n
    for k in range(n):
        value = np.float32(source[p + k])
        other = np.float32(source[q + k])
        mixed[j * n + k] = value + weight[j * n + k] * (other - value)


@njit(cache=True, fastmath={"contract"})
def _mix_run(low, high, part, out):
    for i in range(out.size):
        value = np.float32(low[i])
        out[i] = value + part[i] * (np.float32(high[i]) - value)


@njit(cache=True, fastmath={"contract"})
def _mix_rows(low, high, part, out):
    for i in range(out.size):
        out[i] = np.uint8(np.rint(low[i] + part * (high[i] - low[i])))
