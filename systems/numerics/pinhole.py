"""A pinhole camera: where points and spheres appear, and how to paint them.

Frames: W world, C camera (z along the view, x to the right and y down the picture).
Pixels (u, v): the centre of the first pixel is (0, 0), u to the right, v down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

FIXED_POINT_BITS = 8  # cv2 draws polygons at 1/256 of a (fine) pixel.
FINE = 8  # Fine pixels to a pixel, each way: a polygon's antialiasing;
FINE_LARGE, LARGE = 2, 10_000  # of one that covers more pixels than LARGE.
BANDS = (0.3, 0.55, 0.8, 1.0)  # Cosines between which a drawn sphere is one shade.
N_OUTLINE = 48  # Corners of a circle; its sagitta is 0.002 of the radius.


def _even_lights():
    """One light at the camera and four from the sides: with the first alone the rim
    of a sphere is dark, and its picture's centre is pushed outwards.
    """
    side, tilt = 0.42, 0.075
    ways = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    lights = np.array(
        [
            (1.0 - 4 * side * tilt, 0.0, 0.0, 1.0),
            *((side, x, y, tilt) for x, y in ways),
        ]
    )
    lights[:, 1:] /= np.linalg.norm(lights[:, 1:], axis=1, keepdims=True)
    lights.setflags(write=False)
    return lights


# Of both renderers: intensity, direction (3,) of the light in C.
LIGHTS = _even_lights()


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


def sphere_circle(p, radius, cos_angle=None, n=N_OUTLINE):
    """A circle (n, 3) [m] on a sphere, all round the line to the camera.

    Args:
        p: (3,) the sphere's centre in C [m]; the camera is outside of the sphere.
        radius: [m].
        cos_angle: cosine of the angle, seen from the sphere's centre, between the
            circle and the camera. None: radius / |p|, where the cone of the camera's
            rays touches the sphere, its outline in the picture.
    """
    distance = np.sqrt(p @ p)
    axis = p / distance
    if cos_angle is None:
        cos_angle = radius / distance
    # Two directions square to the axis, which is nearer to z than to x.
    e1 = np.array([axis[2], 0.0, -axis[0]])
    e1 /= np.sqrt(e1 @ e1)
    e2 = np.array(  # axis x e1
        [axis[1] * e1[2], axis[2] * e1[0] - axis[0] * e1[2], -axis[1] * e1[0]]
    )
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    rim = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    rim *= radius * np.sqrt(1.0 - cos_angle**2)
    return rim + (distance - radius * cos_angle) * axis


def outline(shape, size, p, R, near=0.01):
    """Points (n, 3) [m] in C whose convex hull in the picture is the shape's.

    Args:
        shape: "sphere", "capsule", "cylinder", "box" or "ellipsoid".
        size: [m] as Drake has it: (radius,), (radius, length), (radius, length),
            (width, depth, height), (a, b, c).
        p, R: (3,), (3, 3) pose of the shape in C [m].
        near: nothing that reaches nearer to the camera's plane is seen [m].

    Returns: None for a shape that reaches behind `near`.
    """
    if shape == "sphere":
        balls = [p]
    elif shape == "capsule":
        half = R[:, 2] * size[1] / 2
        balls = [p - half, p + half]
    else:
        balls = []
        points = _BODIES[shape] * _scale(shape, size) @ R.T + p
    if balls:
        if min(ball[2] for ball in balls) < near + size[0]:
            return None
        points = np.concatenate([sphere_circle(ball, size[0]) for ball in balls])
    return points if points[:, 2].min() > near else None


def draw(picture, camera, shape, size, p, R, color):
    """Paints one shape, a sphere with its rim as dim as LIGHTS make it.

    Args: picture (height, width, 3) uint8; camera, a Pinhole; shape, size, p and R as
        `outline`; color (3,), 0..255, in full light.
    """
    points = outline(shape, size, p, R)
    if points is None:
        return
    color = np.asarray(color, dtype=float)
    if shape != "sphere":
        paint(picture, camera.project(points), color * brightness(1.0))
        return
    paint(picture, camera.project(points), color * brightness(BANDS[0] / 2))
    for low, high in zip(BANDS[:-1], BANDS[1:], strict=True):
        points = sphere_circle(p, size[0], low)
        paint(picture, camera.project(points), color * brightness((low + high) / 2))


def brightness(cos_angle):
    """How bright LIGHTS make a surface whose normal leans from the way to the camera
    by an angle: the mean over all ways to lean, 1 for white that faces the camera.
    """
    lean = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    sine = np.sqrt(1.0 - cos_angle**2)
    normal = np.stack(
        [sine * np.cos(lean), sine * np.sin(lean), np.full(16, -cos_angle)], axis=1
    )
    facing = np.maximum(normal @ -LIGHTS[:, 1:].T, 0.0)
    return float((facing @ LIGHTS[:, 0]).mean())


def paint(image, corners, color):
    """Fills the convex hull of corners (n, 2) [px] in image (h, w, 3), antialiased.

    Each pixel on the edge is mixed by the part of it that is covered.

    Args: color (3,), 0..255.
    """
    height, width = image.shape[:2]
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 2, [width, height])
    if (high <= low).any():
        return
    n_u, n_v = high - low
    fine = FINE if n_u * n_v < LARGE else FINE_LARGE
    fixed = np.round(((corners - low + 0.5) * fine - 0.5) * 2**FIXED_POINT_BITS).clip(
        -(2**30), 2**30
    )
    hull = cv2.convexHull(fixed.astype(np.int32))
    mask = np.zeros((n_v * fine, n_u * fine), np.uint8)
    cv2.fillConvexPoly(mask, hull, 255, cv2.LINE_8, FIXED_POINT_BITS)
    cover = cv2.resize(mask, (n_u, n_v), interpolation=cv2.INTER_AREA)
    region = image[low[1] : high[1], low[0] : high[0]]
    region += (
        (np.asarray(color, np.float32) - region) * (cover[:, :, None] / np.float32(255))
    ).astype(region.dtype)


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
