"""Quaternions of a table: of angles, unit length, and one sign without jumps."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from makebreak.gap.data.recording import QUATERNION, Episode
from makebreak.gap.data.table import ANGLES


def with_quaternions(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns with quaternions in the place of roll, pitch and yaw [rad], which turn
    about the world's x, y and z, in this order; one that is not there is 0."""
    out = {k: y for k, y in columns.items() if k.rpartition(".")[2] not in ANGLES}
    for at in dict.fromkeys(k.rpartition(".")[0] for k in columns if k not in out):
        some = [columns.get(f"{at}.{angle}") for angle in ANGLES]
        none = np.zeros_like(next(y for y in some if y is not None))
        xyz = np.stack([none if y is None else y for y in some], axis=1)
        q = np.full((len(none), 4), np.nan)
        there = np.isfinite(xyz).all(axis=1)
        if there.any():
            turns = Rotation.from_euler("xyz", xyz[there])
            q[there] = turns.as_quat(scalar_first=True)
        out |= {f"{at}.{key}": q[:, k].copy() for k, key in enumerate(QUATERNION)}
    return out


def mend_quaternions(
    path: Path, columns: dict, episodes: Iterable[Episode], row: np.ndarray
) -> tuple[dict[str, int], dict[str, float]]:
    """Unit length, and the sign of the sample before; in place.

    Returns: for each body the number of flips, and the largest error of the norm.
    """
    flips, errors = {}, {}
    names = [name.rsplit(".", 1) for name in columns]
    for at in dict.fromkeys(at for at, quantity in names if quantity in QUATERNION):
        keys = [f"{at}.{q}" for q in QUATERNION]
        missing = [key for key in keys if key not in columns]
        if missing:
            raise ValueError(
                f"recording {path}: column {missing[0]} is missing: a quaternion has "
                "qw qx qy qz"
            )
        q = np.stack([columns[key] for key in keys], axis=1)
        hole = np.isnan(q)
        half = np.flatnonzero(hole.any(axis=1) & ~hole.all(axis=1))
        if half.size:
            raise ValueError(
                f"recording {path}: column {keys[np.argmax(hole[half[0]])]}, row "
                f"{row[half[0]]}: empty while other parts of the quaternion are there"
            )
        there = np.flatnonzero(~hole[:, 0])
        norm = np.linalg.norm(q[there], axis=1)
        error = np.abs(norm - 1.0)
        if error.size and error.max() > 0.05:
            i = there[np.argmax(error > 0.05)]
            raise ValueError(
                f"recording {path}: column {keys[0]}, row {row[i]}: quaternion "
                f"{np.round(q[i], 4).tolist()}, expected unit length"
            )
        q[there] /= norm[:, None]
        flipped = 0
        for episode in episodes:
            i = there[(there >= episode.first) & (there < episode.last)]
            jumps = np.sum(q[i[1:]] * q[i[:-1]], axis=1) < 0.0
            flipped += int(jumps.sum())
            q[i[1:]] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
        for j, key in enumerate(keys):
            columns[key] = np.ascontiguousarray(q[:, j])
        flips[at], errors[at] = flipped, float(error.max(initial=0.0))
    return flips, errors
