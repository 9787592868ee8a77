"""Lines of text as an image on a rectangle, because Meshcat cannot draw text."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

LINE = 64  # Height of a line [px].
_FONT, _SCALE, _THICK = cv2.FONT_HERSHEY_SIMPLEX, 1.2, 2


@dataclass
class TextBoard:
    """The files of a Wavefront OBJ (mesh, material, image) of a rectangle in the y-z
    plane, seen from +x, with its upper left corner at the origin and lines of height 1.

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
    """A board with lines of text.

    Args: lines: text, and the colour of the square in front of it (red, green, blue
        from 0 to 1); None: no square.
    """
    sizes = [cv2.getTextSize(text, _FONT, _SCALE, _THICK)[0][0] for text, _ in lines]
    indents = [LINE // 4 if color is None else 3 * LINE // 2 for _, color in lines]
    width = max(i + s for i, s in zip(indents, sizes, strict=True)) + LINE // 4
    image = np.full((LINE * len(lines), width, 3), 255, np.uint8)
    for i, ((text, color), indent) in enumerate(zip(lines, indents, strict=True)):
        top = LINE * i
        if color is not None:
            blue_first = [round(255 * c) for c in color[::-1]]
            square = (LINE // 4, top + LINE // 4), (LINE, top + 3 * LINE // 4)
            cv2.rectangle(image, *square, blue_first, cv2.FILLED)
        at = (indent, top + 11 * LINE // 16)
        cv2.putText(image, text, at, _FONT, _SCALE, (30, 30, 30), _THICK, cv2.LINE_AA)
    w, h = width / LINE, float(len(lines))
    corners = ((0, 0, 0, 1), (w, 0, 1, 1), (w, h, 1, 0), (0, h, 0, 0))
    obj = ["mtllib board.mtl"]
    obj += [f"v 0 {y} {-z}" for y, z, _, _ in corners]
    obj += [f"vt {u} {v}" for _, _, u, v in corners]
    obj += ["vn 1 0 0", "usemtl board", "f 4/4/1 3/3/1 2/2/1", "f 4/4/1 2/2/1 1/1/1"]
    mtl = "newmtl board\nKa 1 1 1\nKd 1 1 1\nmap_Kd board.png\n"
    png = cv2.imencode(".png", image)[1].tobytes()
    return TextBoard("\n".join(obj).encode() + b"\n", mtl.encode(), png, w, h)
