"""A legend in Meshcat: the meaning of the colours, and the controllers' phase."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

from makebreak.systems.views.numerics.text_board import text_board

ROOT = "/makebreak/legend"
# Position of the board's upper left corner in the camera's frame (right, up, away), and
# a line's height [m]; in front of the robot, which may come within 1 m of the camera.
# Meshcat's field of view is 37 degrees up and down.
_AWAY = 0.5
_CORNER, _LINE = _AWAY * np.array([-0.75, 0.62, 1.0]), _AWAY * 0.04


@dataclass
class LegendConfig:
    """Settings of Legend."""

    lines: Sequence[tuple[str, Rgba]] = ()  # Text, and the colour that it explains.
    phases: Sequence[str] = ()  # Text of each value of the phase.
    camera: Sequence[float] = (1.0, -0.6, 0.5)  # Position of the view's camera [m].
    look_at: Sequence[float] = field(default_factory=lambda: [0.4, 0.0, 0.1])  # [m]
    period_sec: float = 1.0 / 15.0


class Legend(LeafSystem):
    """A board in Meshcat at the upper left of the initial view, with the meaning of
    each colour and the phase. It is part of Meshcat's recording. Meshcat's grid and
    axes are hidden, as the scene has its own.

    Inputs: phase (1,), optional: index into config.phases.
    """

    def __init__(self, config: LegendConfig, meshcat: Meshcat):
        super().__init__()
        self._config, self._meshcat = config, meshcat
        self._phase = self.DeclareVectorInputPort("phase", 1)
        meshcat.Delete(ROOT)
        for path in ("/Grid", "/Axes"):
            meshcat.SetProperty(path, "visible", False)
        lines = [(text, _on_white(color)) for text, color in config.lines]
        self._draw(f"{ROOT}/lines", lines, 0.0)
        for k, text in enumerate(config.phases):
            path = f"{ROOT}/phase/{k}"
            self._draw(path, [(text, None)], len(config.lines) + 0.3)
            meshcat.SetProperty(path, "visible", False)
        if config.phases:
            self._shown, self._time = -2, np.inf  # Phase on the page, and its time.
            self.DeclarePeriodicPublishEvent(config.period_sec, 0.0, self._publish)

    def note(self, text: str):
        """Shows a line below the others, until the next call; "": none."""
        self._meshcat.Delete(f"{ROOT}/note")
        below = len(self._config.lines) + 1.6 * bool(self._config.phases) + 0.3
        self._draw(f"{ROOT}/note", [(text, None)] if text else [], below)

    def _draw(self, path, lines, below: float):
        if not lines:
            return
        board = text_board(lines)
        mesh = InMemoryMesh(mesh_file=MemoryFile(board.gltf, ".gltf", "board.gltf"))
        self._meshcat.SetObject(path, Mesh(mesh, _LINE), Rgba(1.0, 1.0, 1.0))
        camera = np.array(self._config.camera, dtype=float)
        away = np.array(self._config.look_at) - camera
        if not np.linalg.norm(away) > 0.0:
            raise ValueError(f"camera is at {camera}, expected not where it looks at")
        away /= np.linalg.norm(away)
        right = np.cross(away, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-6:  # Straight down: as Meshcat orients it.
            right = np.array([1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, away)
        turn = RotationMatrix(np.column_stack([-away, right, up]))
        offset = _CORNER - [0.0, _LINE * below, 0.0]
        place = camera + np.column_stack([right, up, away]) @ offset
        self._meshcat.SetTransform(path, RigidTransform(turn, place))

    def _publish(self, context):
        if not self._phase.HasValue(context):
            return
        value = self._phase.Eval(context)[0]
        phase = int(value) if np.isfinite(value) else -1
        t = context.get_time()
        # If time went back, another simulation has begun, perhaps another recording.
        is_known = phase == self._shown and t >= self._time
        self._shown, self._time = phase, t
        if not is_known:
            for k in range(len(self._config.phases)):
                path = f"{ROOT}/phase/{k}"
                self._meshcat.SetProperty(path, "visible", k == phase, t)


def _on_white(color: Rgba) -> tuple[float, float, float]:
    """The colour as it looks on a white board."""
    alpha = max(color.a(), 0.5)  # Paler colours could not be distinguished.
    r, g, b = (alpha * c + 1.0 - alpha for c in (color.r(), color.g(), color.b()))
    return r, g, b
