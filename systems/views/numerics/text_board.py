"""Lines of text as an image on a rectangle, because Meshcat cannot draw text."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

LINE = 64  # Height of a line [px].
_FONT, _SCALE, _THICK = cv2.FONT_HERSHEY_SIMPLEX, 1.2, 2


@dataclass
class TextBoard:
    """A glTF file (mesh, material and image) of a rectangle in the y-z plane, seen from
    +x, with its upper left corner at the origin and lines of height 1.

    png: the image in it; width, height: of the rectangle, in lines.

    Source: glTF 2.0, with KHR_materials_unlit. Its y axis is Drake's z axis. Meshcat
        draws a glTF when its image is there, but a Wavefront OBJ at once, and black as
        long as nothing moves.
    """

    gltf: bytes
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
    png = cv2.imencode(".png", image)[1].tobytes()
    return TextBoard(_gltf(w, h, png), png, w, h)


def _gltf(width: float, height: float, png: bytes) -> bytes:
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    y, z = corners[:, 0], -corners[:, 1]
    position = np.column_stack([np.zeros(4), z, -y]).astype("<f4")
    texture = (corners / [width, height]).astype("<f4")
    index = np.array([3, 2, 1, 3, 1, 0], "<u2")
    single, short = 5126, 5123  # glTF's numbers of the types.
    arrays = [
        (position, single, "VEC3"),
        (texture, single, "VEC2"),
        (index, short, "SCALAR"),
    ]
    views, accessors, data = [], [], b""
    for k, (array, kind, shape) in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append(
            {"bufferView": k, "componentType": kind, "count": len(array), "type": shape}
        )
        data += array.tobytes()
    accessors[0] |= {
        "min": position.min(axis=0).tolist(),
        "max": position.max(axis=0).tolist(),
    }
    unlit = "KHR_materials_unlit"  # The colours of the image, whatever the light.
    mesh = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    whole = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [unlit],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [mesh]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "extensions": {unlit: {}},
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": _data_uri("image/png", png)}],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": _data_uri("application/octet-stream", data),
            }
        ],
        "bufferViews": views,
        "accessors": accessors,
    }
    return json.dumps(whole).encode()


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
