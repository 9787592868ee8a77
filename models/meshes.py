"""Meshes of any common format as OBJ, the one that Drake makes collision shapes of."""

import hashlib
import os
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from makebreak.systems.numerics.code_cache import user_cache

READ_BY_DRAKE = (".obj", ".vtk", ".gltf")


def cache_folder() -> Path:
    """Where converted files stay: the user's cache; a folder of temporary files where
    none can be written there."""
    folder = user_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    folder = Path(tempfile.gettempdir()) / f"makebreak-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    return folder


def write_obj(vertices: np.ndarray, faces: np.ndarray) -> Path:
    """An OBJ of vertices (n, 3) [m] and triangles (m, 3), in the cache by what is in
    it. Written aside first: processes that run together may write the same."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices, float).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + 1).tolist()]
    content = ("\n".join(lines) + "\n").encode()
    path = cache_folder() / f"{hashlib.sha256(content).hexdigest()[:24]}.obj"
    if not path.is_file():
        aside = path.with_suffix(f".{os.getpid()}")
        aside.write_bytes(content)
        aside.replace(path)
    return path


def as_obj(path: Path) -> Path:
    """The file itself if Drake reads it, or an OBJ of it: STL, DAE, PLY and others.

    Raises: ValueError for a file that holds no triangles that can be read.
    """
    if path.suffix in READ_BY_DRAKE:
        return path
    return _converted(path, path.stat().st_mtime_ns)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and triangles (m, 3)."""
    import trimesh  # Here, as it takes long to import.

    try:
        with open(path, "rb") as stream:
            mesh: Any = trimesh.load(
                stream, file_type=path.suffix.lower()[1:], force="mesh", process=False
            )
        # Of a DAE alone the file says what a unit is. ROS takes no notice of its
        # up_axis, so neither do we.
        number, times, _ = str(mesh.units or "").partition(" * ")
        vertices = np.array(mesh.vertices) * (float(number) if times else 1.0)
        faces = np.array(mesh.faces)
    except Exception as error:  # Each format's reader raises its own.
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from None
    if not len(faces) or not np.isfinite(vertices).all():
        raise ValueError(f"{path} holds no mesh of triangles")
    return vertices, faces


@lru_cache(maxsize=4096)
def _converted(path: Path, changed: int) -> Path:
    content = path.read_bytes()
    name = hashlib.sha256(path.suffix.lower().encode() + content).hexdigest()[:24]
    known = cache_folder() / f"{name}.is"
    if known.is_file():
        obj = cache_folder() / known.read_text()
        if obj.is_file():
            return obj
    vertices, faces = _read(path)
    obj = write_obj(vertices, faces)
    aside = known.with_suffix(f".{os.getpid()}")
    aside.write_text(obj.name)
    aside.replace(known)
    return obj


def coarse(path: Path, cells: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a mesh for pictures: those in one cell of
    a grid, `cells` along the longest side, are one.

    Raises: ValueError for a file that holds no triangles that can be read.
    """
    return _coarse(path, path.stat().st_mtime_ns, cells)


@lru_cache(maxsize=256)
def _coarse(path: Path, changed: int, cells: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = _read(path)
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-300) / cells
    cell = np.round((vertices - vertices.min(axis=0)) / size).astype(int)
    _, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    middle = np.zeros((len(count), 3))
    np.add.at(middle, of.ravel(), vertices)
    faces = of.ravel()[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return middle / count[:, None], np.unique(faces, axis=0)
