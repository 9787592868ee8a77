"""A line behind something that moves, which grows in Meshcat's recording too.

A line is no part of a recording: the page would show the whole of it from the start. So
it is drawn in pieces, each of which becomes visible at its time.
"""

import numpy as np

PIECE = 8  # Points of a piece.


class Trail:
    """Draws points that are appended to, on a Meshcat.

    Where a recording is played the last few points, fewer than a piece, are seen once
    the trail has ended.

    Args: path: in Meshcat's tree. color: Rgba. width [pixels].
    """

    def __init__(self, meshcat, path: str, color, width: float = 4.0):
        self._meshcat, self._path = meshcat, path
        self._color, self._width = color, width
        self._run, self._pieces = 0, 0
        self._points, self._seen_at = np.zeros((0, 3)), 0.0
        meshcat.Delete(path)

    def show(self, points: np.ndarray, t: float) -> None:
        """Args: points (n, 3) [m], all of them until now; fewer than before, or others,
        are a new trail, and the one before is taken away. t [s]."""
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
            # The line that is there in the end is seen from its last change on.
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
