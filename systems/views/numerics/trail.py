"""A line behind a moving object that also grows in Meshcat's recording.

The points of a line are not recorded: a recording would show the whole line from its
start. So it is drawn in pieces, and each piece becomes visible at its time.
"""

import numpy as np

PIECE = 8  # Points of a piece.


class Trail:
    """Draws a growing sequence of points in Meshcat.

    In a recording the last points, fewer than a piece, appear at the end of the trail.

    Args: path: in Meshcat's tree. color: Rgba. width [px].
    """

    def __init__(self, meshcat, path: str, color, width: float = 4.0):
        self._meshcat, self._path = meshcat, path
        self._color, self._width = color, width
        self._run, self._pieces = 0, 0
        self._points, self._seen_at = np.zeros((0, 3)), 0.0
        meshcat.Delete(path)

    def show(self, points: np.ndarray, t: float) -> None:
        """Draws all points (n, 3) [m] so far at time t [s]. Fewer points than before,
        or another first point, start a new trail and hide the old one."""
        if not len(points):
            return
        known = self._points
        if len(known) and not (
            len(points) >= len(known) and np.array_equal(points[0], known[0])
        ):
            self._take_away(t)
        while len(points) > (self._pieces + 1) * PIECE:
            self._add(points[self._pieces * PIECE :][: PIECE + 1], t)
        rest = points[self._pieces * PIECE :]
        if len(rest) > 1:
            self._draw(self._now, rest)
            # The final line becomes visible at its last change.
            for seen, at in ((False, 0.0), (False, self._seen_at), (True, t)):
                self._meshcat.SetProperty(self._now, "visible", seen, at)
            self._seen_at = t
        self._points = points

    def _take_away(self, t: float) -> None:
        rest = self._points[self._pieces * PIECE :]
        if len(rest) > 1:
            self._add(rest, self._seen_at)
        for k in range(self._pieces):
            self._meshcat.SetProperty(self._piece(k), "visible", False, t)
        self._meshcat.Delete(self._now)
        self._run, self._pieces = self._run + 1, 0

    def _add(self, points: np.ndarray, t: float) -> None:
        path = self._piece(self._pieces)
        self._draw(path, points)
        for seen, at in ((False, 0.0), (True, t)):
            self._meshcat.SetProperty(path, "visible", seen, at)
        self._pieces += 1

    @property
    def _now(self) -> str:
        return f"{self._path}/now"

    def _piece(self, k: int) -> str:
        return f"{self._path}/{self._run}/{k}"

    def _draw(self, path: str, points: np.ndarray) -> None:
        self._meshcat.SetLine(path, points.T, self._width, self._color)
