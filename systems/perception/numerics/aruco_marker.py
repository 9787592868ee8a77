"""Finds an ArUco marker on an object, instead of the object's outline."""

from functools import cache

import cv2
import numpy as np

from makebreak.systems.perception.numerics.pinhole import Pinhole
from makebreak.systems.perception.numerics.pose_tracker import Detection

# Largest error of a marker's corners, over its side: beyond it is another marker.
CORNER_ERROR_MAX = 0.2


def find_marker(image, camera: Pinhole, number, corners, z) -> Detection | None:
    """The pose of an object by an ArUco marker (dictionary 4X4_50) on it.

    Args:
        image: (height, width, 4) uint8 RGBA.
        camera: the pinhole model.
        number: of the marker.
        corners: (4, 3) of the marker in the object's frame [m], in OpenCV's order:
            clockwise, seen from above, from its upper left one.
        z: height of the object's frame [m].
    Returns: a Detection, or None if the marker is not found.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    seen, numbers, _ = _marker_detector().detectMarkers(grey)
    if numbers is None or number not in numbers:
        return None
    uv = np.asarray(seen[list(numbers.ravel()).index(number)], float).reshape(4, 2)
    rays = camera.rays(uv)
    p_W = [
        camera.meet_plane(ray, z + corner[2])
        for ray, corner in zip(rays, corners, strict=True)
    ]
    if any(p is None for p in p_W):
        return None
    a, b = np.asarray(corners, float)[:, :2], np.array(p_W)[:, :2]
    a_0, b_0 = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = (a_0[:, 0] * b_0[:, 1] - a_0[:, 1] * b_0[:, 0]).sum()
    yaw = float(np.arctan2(cross, (a_0 * b_0).sum()))
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s], [s, c]])
    p = b.mean(axis=0) - R @ a.mean(axis=0)
    off = np.hypot(*(a @ R.T + p - b).T)
    if off.max() > CORNER_ERROR_MAX * np.hypot(*(a[1] - a[0])):
        return None
    depth = camera.p_WC[2] - z
    return Detection(np.array([*p, yaw]), 1.0, float(off.mean()) * camera.focal / depth)


@cache
def _marker_detector():
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return cv2.aruco.ArucoDetector(dictionary, parameters)
