"""A colour camera without a graphics library (numerics/pinhole.py)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Rgba,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics.pinhole import (
    SHAPES,
    Pinhole,
    draw,
    draw_visible,
    extents,
    visible,
)

SKY = (204, 229, 255, 255)  # Drake's default clear colour.


@dataclass(frozen=True, eq=False)
class PaintedShape:
    """One geometry of the plant that the camera can draw."""

    body_index: int
    X_BG: RigidTransform  # Pose in its body.
    kind: int  # Index into SHAPES of numerics/pinhole.py.
    extent: np.ndarray  # (3,) [m] of `extents` in numerics/pinhole.py.
    color: np.ndarray  # (3,) 0..255
    points: np.ndarray | None = None  # (n, 3) [m] of a convex hull.


def painted_shapes(plant: MultibodyPlant, scene_graph: SceneGraph):
    """The visible primitives and convex hulls of a finalized plant. Other meshes are
    ignored; a half-space becomes a wide, thin box."""
    inspector = scene_graph.model_inspector()
    shapes = []
    for frame_id in inspector.GetAllFrameIds():
        body = plant.GetBodyFromFrameId(frame_id)
        if body is None:
            continue
        for geometry_id in inspector.GetGeometries(frame_id, Role.kPerception):
            X_BG = inspector.GetPoseInFrame(geometry_id)
            shape = inspector.GetShape(geometry_id)
            size: tuple[float, ...]
            points = None
            match shape:
                case Sphere():
                    kind, size = "sphere", (shape.radius(),)
                case Capsule():
                    kind, size = "capsule", (shape.radius(), shape.length())
                case Cylinder():
                    kind, size = "cylinder", (shape.radius(), shape.length())
                case Box():
                    kind, size = "box", tuple(shape.size())
                case Ellipsoid():
                    kind, size = "ellipsoid", (shape.a(), shape.b(), shape.c())
                case HalfSpace():
                    kind, size = "box", (100.0, 100.0, 1e-6)
                case Convex():
                    points, X_BG = _centred_hull(shape, X_BG)
                    kind, size = "box", tuple(2.0 * abs(points).max(axis=0))
                case _:
                    continue
            properties = inspector.GetPerceptionProperties(geometry_id)
            rgba: Any = properties.GetPropertyOrDefault(
                "phong", "diffuse", Rgba(0.9, 0.9, 0.9, 1.0)
            )
            if rgba.a() > 0.0:
                color = 255.0 * np.array([rgba.r(), rgba.g(), rgba.b()])
                shapes.append(
                    PaintedShape(
                        body_index=int(body.index()),
                        X_BG=X_BG,
                        kind=SHAPES.index(kind),
                        extent=extents(kind, size),
                        color=color,
                        points=points,
                    )
                )
    return shapes


def _centred_hull(shape: Convex, X_BG: RigidTransform):
    """Corners (n, 3) of a convex hull relative to the middle of its bounding box, and
    the pose of this middle in the body."""
    hull = shape.GetConvexHull()
    points = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return points - middle, X_BG @ RigidTransform(middle)


def _pose_if_anchored(plant, context, shape):
    """Pose of the shape's body in the world if it is fixed there, else None."""
    body = plant.get_body(BodyIndex(shape.body_index))
    return plant.EvalBodyPoseInWorld(context, body) if plant.IsAnchored(body) else None


class PinholeCamera(LeafSystem):
    """Draws a plant's spheres, capsules, cylinders, boxes, ellipsoids and convex hulls
    with OpenCV, distant ones first.

    Inputs:  body_poses (abstract) of the plant.
    Outputs: rgb_image (abstract ImageRgba8U), drawn when evaluated.

    Args: camera: its pinhole model; plant: finalized.
    """

    def __init__(self, camera: Pinhole, plant: MultibodyPlant, scene_graph: SceneGraph):
        super().__init__()
        self._camera = camera
        shapes = painted_shapes(plant, scene_graph)
        still = plant.CreateDefaultContext()
        X_WB = {s.body_index: _pose_if_anchored(plant, still, s) for s in shapes}
        anchored = [s for s in shapes if X_WB[s.body_index] is not None]
        self._moving = [s for s in shapes if X_WB[s.body_index] is None]
        self._bodies = sorted({s.body_index for s in self._moving})
        self._in_body = self._prepared(self._moving, self._bodies)
        self._background = np.empty((camera.height, camera.width, 4), np.uint8)
        self._background[:] = SKY
        bodies = sorted({s.body_index for s in anchored})
        self._paint(
            self._background,
            anchored,
            self._prepared(anchored, bodies),
            [X_WB[i] for i in bodies],
        )
        scratch, ahead = self._background.copy(), np.array([0.0, 0.0, 1.0])
        # Compiles the machine code before the first image.
        draw(scratch, camera, "sphere", (0.1,), ahead, np.eye(3), np.zeros(3))
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", Value[list[RigidTransform]]()
        )
        self.DeclareAbstractOutputPort(
            "rgb_image",
            lambda: Value(ImageRgba8U(camera.width, camera.height)),
            self._draw,
            prerequisites_of_calc={self.input_port_ticket(self._poses.get_index())},
        )

    @staticmethod
    def _prepared(shapes, bodies):
        """For n shapes: index of the body in `bodies` (n,), p_BG (n, 3), R_BG
        (n, 3, 3), extents (n, 3)."""
        n = len(shapes)
        return (
            np.array([bodies.index(s.body_index) for s in shapes], int),
            np.array([s.X_BG.translation() for s in shapes]).reshape(n, 3),
            np.array([s.X_BG.rotation().matrix() for s in shapes]).reshape(n, 3, 3),
            np.array([s.extent for s in shapes]).reshape(n, 3),
        )

    @timed
    def _draw(self, context, output):
        poses: Any = self._poses.Eval(context)
        pixels = output.get_mutable_value().mutable_data
        pixels[:] = self._background
        X_WB = [poses[i] for i in self._bodies]
        self._paint(pixels, self._moving, self._in_body, X_WB)

    def _paint(self, image, shapes, in_body, X_WB):
        """Draws shapes into an image. Args: in_body: of _prepared; X_WB: poses of the
        bodies."""
        if not shapes:
            return
        camera, (body, p_BG, R_BG, extent) = self._camera, in_body
        X = np.array([pose.GetAsMatrix34() for pose in X_WB])[body]
        R_WB, p_WB = X[:, :, :3], X[:, :, 3]
        p = camera.to_camera(p_WB + (R_WB @ p_BG[:, :, None])[:, :, 0])
        R = camera.R_WC.T @ R_WB @ R_BG
        seen = np.flatnonzero(visible(p, extent, camera))
        for i in seen[np.argsort(-p[seen, 2], kind="stable")]:
            s = shapes[i]
            draw_visible(image, camera, s.kind, s.extent, p[i], R[i], s.color, s.points)
