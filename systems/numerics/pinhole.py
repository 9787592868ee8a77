"""A pinhole camera: where points and spheres appear, and how to paint them.

Frames: W world, C camera (z along the view, x to the right and y down the picture).
Pixels (u, v): the centre of the first pixel is (0, 0), u to the right, v down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

FIXED_POINT_BITS = 8  # cv2 draws polygons at 1/256 of a (fine) pixel.
FINE = 8  # Fine pixels to a pixel, each way, where an outline must be exact.
N_OUTLINE = 48  # Corners of a circle; its sagitta is 0.002 of the radius.
BANDS = (0.3, 0.55, 0.8, 1.0)  # Cosines between which a drawn sphere is one shade.


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion and with square pixels."""

    width: int  # [px]
    height: int  # [px]
    focal: float  # [px]
    center: np.ndarray  # (2,) [px] where the optical axis meets the picture.
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
        """Pixels (n, 2) of points (n, 3) [m] in C that lie before the camera."""
        return self.focal * p_C[:, :2] / p_C[:, 2:] + self.center

    def rays(self, uv):
        """Unit vectors (n, 3) in C towards pixels uv (n, 2)."""
        ray = np.ones((len(uv), 3))
        ray[:, :2] = (uv - self.center) / self.focal
        return ray / np.linalg.norm(ray, axis=1, keepdims=True)

    def to_camera(self, p_W):
        """Points (n, 3) or a point (3,) [m] of the world, in C."""
        return (p_W - self.p_WC) @ self.R_WC

    def meet_plane(self, ray, z):
        """The point (3,) [m] of the world's plane at height z [m] that lies on a ray
        (3,) in C from the camera; None where the ray does not meet it.
        """
        direction = self.R_WC @ ray
        drop = z - self.p_WC[2]
        if not drop * direction[2] > 0.0:
            return None
        return self.p_WC + direction * (drop / direction[2])


def look_down(width, height, fov_y, position, center_shift=0.0) -> Pinhole:
    """A camera that looks straight down, with +x of the world up in the picture.

    Args:
        width, height: [px]; fov_y: [rad], of the picture's height.
        position: (3,) of the camera [m].
        center_shift: of the optical axis from the picture's middle, in u and v [px].
    """
    if not 0.0 < fov_y < np.pi:
        raise ValueError(f"fov_y must be between 0 and pi, got {fov_y}")
    center = np.array([width - 1, height - 1]) / 2 + center_shift
    focal = height / 2 / np.tan(fov_y / 2)
    R_WC = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return Pinhole(width, height, focal, center, np.asarray(position, float), R_WC)


@njit(cache=True)
def sphere_circle(p, radius, cos_angle):
    """A circle (N_OUTLINE, 3) [m] on a sphere, all round the line to the camera.

    Args:
        p: (3,) the sphere's centre in C [m]; the camera is outside of the sphere.
        radius: [m].
        cos_angle: cosine of the angle, seen from the sphere's centre, between the
            circle and the camera. radius / |p| is where the cone of the camera's rays
            touches the sphere: its outline in the picture.
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


def outline(shape, size, p, R, near=0.01):
    """Points (n, 3) [m] in C whose convex hull in the picture is the shape's.

    Args:
        shape: "sphere", "capsule", "cylinder", "box" or "ellipsoid".
        size: [m] as Drake has it: (radius,), (radius, length), (radius, length),
            (width, depth, height), (a, b, c).
        p, R: (3,), (3, 3) pose of the shape in C [m].
        near: nothing that reaches nearer to the camera's plane is seen [m].

    Returns: None for a shape that reaches nearer.
    """
    if shape in ("sphere", "capsule"):
        half = R[:, 2] * (size[1] / 2 if shape == "capsule" else 0.0)
        if p[2] - abs(half[2]) < near + size[0]:
            return None
        ends = [p] if shape == "sphere" else [p - half, p + half]
        return np.concatenate(
            [sphere_circle(end, size[0], size[0] / np.sqrt(end @ end)) for end in ends]
        )
    points = (_BODIES[shape] * _scale(shape, size)) @ R.T + p
    return points if points[:, 2].min() > near else None


def draw(picture, camera, shape, size, p, R, color):
    """Paints one shape, lit from the camera: a sphere is dim at its rim.

    Args: picture (height, width, 3) uint8; camera, a Pinhole; shape, size, p and R as
        `outline`; color (3,), 0..255, in full light.
    """
    points = outline(shape, size, p, R)
    if points is None:
        return
    corners = camera.project(points)
    if (corners.max(axis=0) < -1.0).any() or (
        corners.min(axis=0) > [camera.width, camera.height]
    ).any():
        return
    if shape != "sphere":
        paint(picture, corners, color)
        return
    paint_exactly(picture, corners, np.multiply(color, BANDS[0] / 2))
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        corners = camera.project(sphere_circle(p, size[0], low))
        paint(picture, corners, np.multiply(color, (low + high) / 2))


def paint(image, corners, color, line=cv2.LINE_AA):
    """Fills the convex hull of corners (n, 2) [px] in image (h, w) or (h, w, 3)."""
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0]
    fixed = np.rint(_inset(hull, 0.5) * 2**FIXED_POINT_BITS).clip(-(2**30), 2**30)
    shade: list[float] = np.atleast_1d(color).tolist()
    cv2.fillConvexPoly(image, fixed.astype(np.int32), shade, line, FIXED_POINT_BITS)


@njit(cache=True)
def _inset(hull, by):
    """A convex polygon (n, 2) whose edges lie further inside [px]: what OpenCV fills
    is as much larger than the polygon.
    """
    n = len(hull)
    inner = hull.copy()
    for i in range(n):
        before = hull[i] - hull[i - 1]
        after = hull[(i + 1) % n] - hull[i]
        a = np.sqrt(before[0] ** 2 + before[1] ** 2)
        b = np.sqrt(after[0] ** 2 + after[1] ** 2)
        if a == 0.0 or b == 0.0:
            continue
        before, after = before / a, after / b
        # v = hull[i] + step (normal before + normal after), both normals unit.
        turn = before[0] * after[1] - before[1] * after[0]  # Its sign: the way round.
        side = 1.0 if turn > 0.0 else -1.0
        step = side * by / max(1.0 + before[0] * after[0] + before[1] * after[1], 0.3)
        inner[i, 0] -= step * (before[1] + after[1])
        inner[i, 1] += step * (before[0] + after[0])
    return inner


def paint_exactly(image, corners, color):
    """As paint; each pixel (h, w, 3) on the edge is mixed by how much is covered."""
    height, width = image.shape[:2]
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 2, [width, height])
    if (high <= low).any():
        return
    n_u, n_v = high - low
    mask = np.zeros((n_v * FINE, n_u * FINE), np.uint8)
    paint(mask, (corners - low + 0.5) * FINE - 0.5, 255.0, cv2.LINE_8)
    cover = cv2.resize(mask, (n_u, n_v), interpolation=cv2.INTER_AREA)
    _mix(image[low[1] : high[1], low[0] : high[0]], cover, np.asarray(color))


@njit(cache=True)
def _mix(region, cover, color):
    for i in range(region.shape[0]):
        for j in range(region.shape[1]):
            part = cover[i, j] / 255.0
            for k in range(3):
                mixed = region[i, j, k] * (1.0 - part) + color[k] * part
                region[i, j, k] = np.uint8(mixed + 0.5)


def _scale(shape, size):
    return (
        [size[0], size[0], size[1] / 2]
        if shape == "cylinder"
        else np.divide(size, 2.0 if shape == "box" else 1.0)
    )


def _unit_bodies():
    angle = np.linspace(0.0, 2.0 * np.pi, N_OUTLINE, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.ones(N_OUTLINE)], axis=1)
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
    turns = Rotation.from_euler(
        "x", np.linspace(0.0, np.pi, 24, endpoint=False)[:, None]
    )
    sphere = np.concatenate([R.apply(ring * [1.0, 1.0, 0.0]) for R in turns])
    return {
        "cylinder": np.concatenate([ring, ring * [1.0, 1.0, -1.0]]),
        "box": corners,
        "ellipsoid": sphere,
    }


_BODIES = _unit_bodies()


def frame_shift(seed, frame):
    """(2,) standard normal numbers that belong to frame >= 0 of a seed >= 0."""
    bits = np.random.Philox(key=seed, counter=[0, 0, 0, frame])
    return np.random.Generator(bits).standard_normal(2)
