"""A line behind something that moves, which grows in Meshcat's recording too.

A line is no part of a recording: the page would show the whole of it from the start. So
it is drawn in pieces, each of which becomes visible at its time.
"""

import numpy as np

PIECE = 8  # Points of a piece; with a point each 0.1 s it is seen 0.8 s late at most.


class Trail:
    """Draws points that are appended to, on a Meshcat.

    Args: path: in Meshcat's tree. color: Rgba. width [pixels].
    """

    def __init__(self, meshcat, path: str, color, width: float = 4.0):
        self._meshcat, self._path = meshcat, path
        self._color, self._width = color, width
        self._run, self._pieces, self._first = 0, 0, np.full(3, np.nan)
        meshcat.Delete(path)

    def show(self, points: np.ndarray, t: float) -> None:
        """Args: points (n, 3) [m], all of them until now; fewer than before, or others,
        are a new trail, and the one before is taken away. t [s]."""
        if not len(points):
            return
        is_new = not np.array_equal(points[0], self._first)
        if is_new or len(points) < self._pieces * PIECE:
            for k in range(self._pieces):
                self._set_visible(k, False, t)
            self._meshcat.Delete(self._now)
            self._run, self._pieces, self._first = self._run + 1, 0, points[0].copy()
        while len(points) > (self._pieces + 1) * PIECE:
            start = self._pieces * PIECE
            self._draw(self._piece(self._pieces), points[start : start + PIECE + 1])
            self._set_visible(self._pieces, False, 0.0)
            self._set_visible(self._pieces, True, t)
            self._pieces += 1
        rest = points[self._pieces * PIECE :]
        if len(rest) > 1:
            self._draw(self._now, rest)
            # Where it is played again the last piece is seen once it is whole.
            self._meshcat.SetProperty(self._now, "visible", False, 0.0)
            self._meshcat.SetProperty(self._now, "visible", True)

    @property
    def _now(self) -> str:
        return f"{self._path}/now"

    def _piece(self, k: int) -> str:
        return f"{self._path}/{self._run}/{k}"

    def _set_visible(self, k: int, is_visible: bool, t: float) -> None:
        self._meshcat.SetProperty(self._piece(k), "visible", is_visible, t)

    def _draw(self, path: str, points: np.ndarray) -> None:
        self._meshcat.SetLine(path, points.T, self._width, self._color)
