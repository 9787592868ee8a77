"""A camera that renders only the region of its image that is asked for."""

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import (
    ColorRenderCamera,
    FrameId,
    QueryObject,
    RenderCameraCore,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageRgba8U

MARGIN = 8  # Beyond what is asked for [px]: the image may be shaken, resampled.
STEP = 16  # Sizes of a region, so that they hardly ever change [px].


class RegionCamera(LeafSystem):
    """An image of which a part is rendered, as industrial cameras read a region.

    A whole image takes 2.5 to 4 times as long as a region of 96 x 96 pixels. The pixels
    are those of the whole image (its intrinsics with another centre), the others black.
    Drake's cameras have their principal point in the image: what is rendered is the
    smallest rectangle with the region and that point.

    Inputs:  query (abstract QueryObject) of the scene graph; region (3,), optional:
             centre [u, v] and half the side of what is looked at [px], not a number for
             all of the image.
    Outputs: rgb_image (abstract ImageRgba8U) of the camera's size, rendered when
             evaluated.

    Args: frame: of the scene graph, in which X_FC is the camera's pose; core: of the
        whole image.
    """

    def __init__(self, frame: FrameId, X_FC: RigidTransform, core: RenderCameraCore):
        super().__init__()
        self._frame, self._X_FC, self._core = frame, X_FC, core
        info = core.intrinsics()
        self._size = np.array([info.width(), info.height()])
        self._center = np.array([info.center_x(), info.center_y()])
        blank = ImageRgba8U(info.width(), info.height())
        self._query = self.DeclareAbstractInputPort(
            "query", AbstractValue.Make(QueryObject())
        )
        self._region = self.DeclareVectorInputPort("region", 3)
        self.DeclareAbstractOutputPort("rgb_image", lambda: Value(blank), self._render)

    def _render(self, context, output):
        image: Any = output.get_mutable_value().mutable_data
        query: Any = self._query.Eval(context)
        low, high = np.zeros(2, int), self._size
        if self._region.HasValue(context):
            low, high = self._part(*self._region.Eval(context))
        if (high - low < self._size).any():
            image[:] = 0
        part = query.RenderColorImage(
            self._camera(low, high), self._frame, self._X_FC
        ).data
        image[low[1] : high[1], low[0] : high[0]] = part

    def _part(self, u, v, half) -> tuple[np.ndarray, np.ndarray]:
        """The corners (2,) of what is rendered [px], the upper ones exclusive."""
        ends = np.array([[u - half - MARGIN, v - half - MARGIN],
                         [u + half + MARGIN, v + half + MARGIN]])  # fmt: skip
        if not np.isfinite(ends).all():
            return np.zeros(2, int), self._size
        ends = np.vstack([ends, self._center - 1.0, self._center + 1.0])
        low = np.maximum(STEP * np.floor(ends.min(axis=0) / STEP), 0.0)
        high = np.minimum(STEP * np.ceil(ends.max(axis=0) / STEP), self._size)
        return low.astype(int), high.astype(int)

    def _camera(self, low, high) -> ColorRenderCamera:
        whole = self._core.intrinsics()
        info = CameraInfo(
            int(high[0] - low[0]), int(high[1] - low[1]), whole.focal_x(),
            whole.focal_y(), whole.center_x() - low[0], whole.center_y() - low[1],
        )  # fmt: skip
        core = RenderCameraCore(
            self._core.renderer_name(), info, self._core.clipping(), RigidTransform()
        )
        return ColorRenderCamera(core, False)
