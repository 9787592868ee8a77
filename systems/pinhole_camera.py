from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    HalfSpace,
    Rgba,
    Role,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.pinhole import Pinhole, draw

SKY = (204.0, 229.0, 255.0)  # Drake's own clear colour for rendering.


@dataclass(frozen=True, eq=False)
class PaintedShape:
    """One geometry of the plant that the camera can draw."""

    body_index: int
    X_BG: RigidTransform  # Pose in its body.
    kind: str  # See numerics/pinhole.py, `outline`.
    size: tuple[float, ...]  # [m]
    color: np.ndarray  # (3,) 0..255


def painted_shapes(plant: MultibodyPlant, scene_graph: SceneGraph):
    """The visible primitives of a finalized plant. Meshes are left out; a half-space
    becomes a wide, thin box.
    """
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
                case _:
                    continue
            properties = inspector.GetPerceptionProperties(geometry_id)
            rgba: Any = properties.GetPropertyOrDefault(
                "phong", "diffuse", Rgba(0.9, 0.9, 0.9, 1.0)
            )
            if rgba.a() > 0.0:
                color = 255.0 * np.array([rgba.r(), rgba.g(), rgba.b()])
                shapes.append(PaintedShape(int(body.index()), X_BG, kind, size, color))
    return shapes


def _pose_if_anchored(plant, context, shape):
    body = plant.get_body(BodyIndex(shape.body_index))
    return plant.EvalBodyPoseInWorld(context, body) if plant.IsAnchored(body) else None


class PinholeCamera(LeafSystem):
    """A colour camera without a graphics library: OpenCV paints the plant's spheres,
    capsules, cylinders, boxes and ellipsoids, far ones first.

    Inputs:  body_poses, abstract, the plant's port of that name.
    Outputs: rgb_image, abstract ImageRgba8U, drawn when it is asked for.
    """

    def __init__(self, camera: Pinhole, plant: MultibodyPlant, scene_graph: SceneGraph):
        super().__init__()
        self._camera = camera
        X_CW = RigidTransform(
            RotationMatrix(camera.R_WC), camera.p_WC.tolist()
        ).inverse()
        self._X_CW = X_CW
        shapes = painted_shapes(plant, scene_graph)
        still = plant.CreateDefaultContext()
        X_WB = {s.body_index: _pose_if_anchored(plant, still, s) for s in shapes}
        self._moving = [s for s in shapes if X_WB[s.body_index] is None]
        self._background = np.empty((camera.height, camera.width, 3), np.uint8)
        self._background[:] = SKY
        self._paint(
            self._background,
            [
                (s, X_CW @ X_WB[s.body_index] @ s.X_BG)
                for s in shapes
                if X_WB[s.body_index] is not None
            ],
        )
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", Value[list[RigidTransform]]()
        )
        self.DeclareAbstractOutputPort(
            "rgb_image",
            lambda: Value(ImageRgba8U(camera.width, camera.height)),
            self._draw,
            prerequisites_of_calc={self.input_port_ticket(self._poses.get_index())},
        )

    def _draw(self, context, output):
        poses: Any = self._poses.Eval(context)
        picture = self._background.copy()
        self._paint(
            picture,
            [(s, self._X_CW @ poses[s.body_index] @ s.X_BG) for s in self._moving],
        )
        pixels = output.get_mutable_value().mutable_data
        pixels[:, :, :3] = picture
        pixels[:, :, 3] = 255

    def _paint(self, picture, placed):
        placed = [(s, X.translation(), X.rotation().matrix()) for s, X in placed]
        for s, p, R in sorted(placed, key=lambda item: -item[1][2]):
            draw(picture, self._camera, s.kind, s.size, p, R, s.color)
