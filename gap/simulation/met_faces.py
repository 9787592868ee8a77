"""Which faces of what is fixed free bodies run against, and where they do so."""

from collections.abc import Sequence

import numpy as np

from makebreak.gap.numerics.free_body import FreeBody, gaps_and_normals

FARTHEST = 0.2  # [m] That a face may be off.
# [m] By which a body comes nearer to a face, and goes away from it again. (One that
# friction stops before it stays there.)
FALLS, RISES = 0.01, 0.003


def met_faces(
    body: FreeBody, grounds: Sequence[str], paths: Sequence[np.ndarray]
) -> dict[tuple[str, str], float]:
    """How far from where the scene has them faces are met, along an axis of the world.

    A body comes no nearer to a face than where it meets it, however fast it was, and
    keeps coming nearer if nothing is there. So the face is where the nearest one of all
    approaches ended, if that is not where its path ends. (A face along which a body
    slides, or on which it lies, is not approached.)

    Args: grounds (m,): names of the bodies that the fixed shapes are of. paths: each
        (n, 7) poses, quaternion wxyz and place, before and after an impact.
    Returns: {(body, axis): the displacement [m] along the axis that is nearest to the
        face's normal}.
    """
    nearest: dict[tuple[str, str], tuple[float, float]] = {}
    for path in paths:
        if len(path) < 3:
            continue
        each = np.stack([gaps_and_normals(body, pose) for pose in path])
        for k, name in enumerate(grounds):
            least = each[:, :, k, 0].argmin(axis=1)
            rows = np.arange(len(path))
            gap, normal = each[rows, least, k, 0], each[rows, least, k, 1:]
            last = int(np.argmin(gap))
            # The face that it came to: inside of a box another one may be nearer.
            first = int(np.argmax(gap[: last + 1]))
            n = normal[first]
            if gap[first] - gap[last] < FALLS or gap[last:].max() - gap[last] < RISES:
                continue
            if abs(gap[last]) > FARTHEST:
                continue
            axis = int(np.argmax(np.abs(n)))
            key = name, "xyz"[axis]
            if key not in nearest or gap[last] < nearest[key][0]:
                nearest[key] = float(gap[last]), float(gap[last] / n[axis])
    return {key: off for key, (_, off) in nearest.items()}
