"""Lines of text as a picture on a rectangle: Meshcat knows no text."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

LINE = 64  # Of a line's height [pixels].
_FONT, _SCALE, _THICK = cv2.FONT_HERSHEY_SIMPLEX, 1.2, 2


@dataclass
class TextBoard:
    """A rectangle in its own y and z, seen from its x, upper left corner at the origin,
    lines one unit high: the files of a Wavefront OBJ, its material and its picture.

    width, height: of the rectangle, in lines.
    """

    obj: bytes
    mtl: bytes
    png: bytes
    width: float
    height: float


def text_board(
    lines: Sequence[tuple[str, tuple[float, float, float] | None]],
) -> TextBoard:
    """Args: lines: text, and the colour of the square before it (red, green, blue from
    0 to 1), or None: no square.
    """
    sizes = [cv2.getTextSize(text, _FONT, _SCALE, _THICK)[0][0] for text, _ in lines]
    indents = [LINE // 4 if color is None else 3 * LINE // 2 for _, color in lines]
    width = max(i + s for i, s in zip(indents, sizes, strict=True)) + LINE // 4
    picture = np.full((LINE * len(lines), width, 3), 255, np.uint8)
    for i, ((text, color), indent) in enumerate(zip(lines, indents, strict=True)):
        top = LINE * i
        if color is not None:
            blue_first = [round(255 * c) for c in color[::-1]]
            square = (LINE // 4, top + LINE // 4), (LINE, top + 3 * LINE // 4)
            cv2.rectangle(picture, *square, blue_first, cv2.FILLED)
        at = (indent, top + 11 * LINE // 16)
        cv2.putText(picture, text, at, _FONT, _SCALE, (30, 30, 30), _THICK, cv2.LINE_AA)
    w, h = width / LINE, float(len(lines))
    corners = ((0, 0, 0, 1), (w, 0, 1, 1), (w, h, 1, 0), (0, h, 0, 0))
    obj = ["mtllib board.mtl"]
    obj += [f"v 0 {y} {-z}" for y, z, _, _ in corners]
    obj += [f"vt {u} {v}" for _, _, u, v in corners]
    obj += ["vn 1 0 0", "usemtl board", "f 4/4/1 3/3/1 2/2/1", "f 4/4/1 2/2/1 1/1/1"]
    mtl = "newmtl board\nKa 1 1 1\nKd 1 1 1\nmap_Kd board.png\n"
    png = cv2.imencode(".png", picture)[1].tobytes()
    return TextBoard("\n".join(obj).encode() + b"\n", mtl.encode(), png, w, h)
