"""Camera faults for tests: images that are lost, late, or show what is not there."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.faults.numerics.time_span import lasts
from makebreak.systems.perception.numerics.pinhole import Pinhole


@dataclass(frozen=True, eq=False)
class _Film:
    """The last images, oldest first; immutable, so that copies of a Context share
    them."""

    frames: tuple[np.ndarray, ...]
    shown: np.ndarray | None = None

    def __deepcopy__(self, memo):
        return self


class LatePictures(LeafSystem):
    """From `start` until before `end` [s] each image is `frames` frames late, and a
    fraction of them is lost: the one before stays. Outside that time images pass
    unchanged.

    Inputs:  image (abstract ImageRgba8U).
    Outputs: rgb_image (abstract ImageRgba8U).

    Args: share: fraction of images that are lost, drawn from the seed; period_sec:
        between frames [s].
    """

    def __init__(self, width, height, frames, share, seed, start, end, period_sec):
        super().__init__()
        if frames < 0 or not 0.0 <= share <= 1.0:
            raise ValueError(
                f"frames is {frames}, share {share}, expected >= 0 and from 0 to 1"
            )
        self._frames, self._share, self._seed = int(frames), float(share), int(seed)
        self._start, self._end = float(start), float(end)
        self._period = float(period_sec)
        blank = ImageRgba8U(width, height)
        self._image = self.DeclareAbstractInputPort("image", Value(blank))
        self._film = self.DeclareAbstractState(AbstractValue.Make(_Film(())))
        self.DeclareAbstractOutputPort(
            "rgb_image",
            lambda: Value(blank),
            self._show,
            {
                self.abstract_state_ticket(self._film),
                self._image.ticket(),
                self.time_ticket(),
            },
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_sec, 0.0, self._expose)

    def _expose(self, context, state):
        film = context.get_abstract_state(int(self._film)).get_value()
        image: Any = self._image.Eval(context)
        now = image.data.copy()
        frames = (*film.frames, now)[-(self._frames + 1) :]
        time = context.get_time()
        shown = now
        if self._acts(context):
            shown = frames[0]
            number = int(time / self._period + 0.5)
            lost = np.random.default_rng([self._seed, 29, number]).random()
            if lost < self._share and film.shown is not None:
                shown = film.shown
        state.get_mutable_abstract_state(int(self._film)).set_value(
            _Film(frames, shown)
        )

    def _acts(self, context) -> bool:
        return lasts(context.get_time(), self._start, self._end)

    def _show(self, context, output):
        film = context.get_abstract_state(int(self._film)).get_value()
        if film.shown is None or not self._acts(context):
            image: Any = self._image.Eval(context)
            output.get_mutable_value().mutable_data[:] = image.data
        else:
            output.get_mutable_value().mutable_data[:] = film.shown


class PaintedPictures(LeafSystem):
    """From `start` until before `end` [s] a disc is painted at a fixed offset from a
    body: a second ball, or glare on the first one.

    Inputs:  image (abstract ImageRgba8U); body_poses (abstract) of the plant.
    Outputs: rgb_image (abstract ImageRgba8U).

    Args: camera: its pinhole model; body_index; offset (3,): of the disc's centre from
        the body's origin, in world axes [m]; radius [m]; color (3,), 0 to 255.
    """

    def __init__(self, camera: Pinhole, body_index, offset, radius, color, start, end):
        super().__init__()
        self._camera, self._body = camera, body_index
        self._offset, self._radius = np.array(offset, dtype=float), float(radius)
        self._color = (*(int(c) for c in color), 255)
        self._start, self._end = float(start), float(end)
        blank = ImageRgba8U(camera.width, camera.height)
        self._image = self.DeclareAbstractInputPort("image", Value(blank))
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", Value[list[RigidTransform]]()
        )
        self.DeclareAbstractOutputPort("rgb_image", lambda: Value(blank), self._paint)

    def _paint(self, context, output):
        image: Any = self._image.Eval(context)
        pixels = output.get_mutable_value().mutable_data
        pixels[:] = image.data
        if not lasts(context.get_time(), self._start, self._end):
            return
        poses: Any = self._poses.Eval(context)
        p_C = self._camera.to_camera(poses[self._body].translation() + self._offset)
        if p_C[2] <= self._radius:  # Beside the camera, or behind it.
            return
        center = self._camera.focal * p_C[:2] / p_C[2] + self._camera.center
        u, v = (int(round(float(x))) for x in center)
        radius_px = int(round(self._camera.focal * self._radius / float(p_C[2])))
        painted = np.ascontiguousarray(pixels)
        cv2.circle(painted, (u, v), radius_px, self._color, -1, cv2.LINE_AA)
        pixels[:] = painted
