"""Meshcat's view of the two walls in a controller's model."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Box, Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

_WALL = Rgba(0.2, 0.45, 1.0, 0.4)


@dataclass
class WallsViewConfig:
    """Settings of WallsView."""

    # Modelled distances of the walls at +x and at -x from the middle, for the tip's
    # centre [m].
    gap: list[float] = field(default_factory=lambda: [0.35, 0.35])
    tip_radius: float = 0.02  # Distance from the tip's centre to a wall in contact [m].
    height: float = 0.5  # Of the walls' centre [m].
    period_sec: float = 1.0 / 30.0


class WallsView(LeafSystem):
    """Shows two walls as ghosts at the modelled distance plus r_comp.

    Inputs: r_comp (2,) learned error of the distances [m].
    """

    LEGEND = (("wall in the controller's model", _WALL),)

    def __init__(
        self, config: WallsViewConfig, meshcat: Meshcat, offset_sec: float = 0.0
    ):
        super().__init__()
        self._meshcat = meshcat
        self._gap = np.array(config.gap) + config.tip_radius
        self._height = config.height
        self._r_comp = self.DeclareVectorInputPort("r_comp", 2)
        for path in self._paths():
            meshcat.SetObject(path, Box(0.01, 0.34, 0.56), _WALL)
        self._show(self._gap, 0.0)
        self.DeclarePeriodicPublishEvent(config.period_sec, offset_sec, self._publish)

    def _paths(self):
        return [f"/makebreak/model_wall_{i}" for i in range(2)]

    def _show(self, gap, t):
        faces = (gap[0] + 0.005, -gap[1] - 0.005)
        for path, x in zip(self._paths(), faces, strict=True):
            self._meshcat.SetTransform(path, RigidTransform([x, 0, self._height]), t)

    def _publish(self, context):
        self._show(self._gap + self._r_comp.Eval(context), context.get_time())
