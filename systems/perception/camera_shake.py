"""Random shifts of a camera's images."""

from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.perception.numerics.pinhole import frame_shift, shifted


class CameraShake(LeafSystem):
    """Shifts each image by a random amount, as of a camera that vibrates.

    The shift of frame k = floor(time / period_sec) is a function of the seed and k
    alone: there is no state, and any Context replays it.

    Inputs:  image (abstract ImageRgba8U).
    Outputs: rgb_image (abstract ImageRgba8U), computed when evaluated.

    Args: width, height [px]; shift_std_px: standard deviation along u and v [px]; seed;
        period_sec: between frames [s].
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, width, height, shift_std_px, seed, period_sec):
        super().__init__()
        if not shift_std_px >= 0.0 or not period_sec > 0.0:
            raise ValueError(
                "shift_std_px must be at least 0 and period_sec positive, got "
                f"{shift_std_px}, {period_sec}"
            )
        self._shift_std_px, self._seed = shift_std_px, seed
        self._period_sec = period_sec
        blank = ImageRgba8U(width, height)
        first_call(shifted, blank.data, 0.5, 0.5, np.empty_like(blank.data))
        self._image = self.DeclareAbstractInputPort("image", Value(blank))
        self.DeclareAbstractOutputPort(
            "rgb_image",
            lambda: Value(blank),
            self._shake,
            prerequisites_of_calc={
                self.input_port_ticket(self._image.get_index()),
                self.time_ticket(),
            },
        )

    def _shake(self, context, output):
        frame = int(context.get_time() / self._period_sec + 1e-6)
        u, v = self._shift_std_px * frame_shift(self._seed, frame)
        image: Any = self._image.Eval(context)
        shifted(image.data, u, v, output.get_mutable_value().mutable_data)
