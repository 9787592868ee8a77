"""Compiled code does not check its indices: what it reads beside an array is whatever
lies there. So it is run here with numba's own checks, in a process of its own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NUMERICS = [*ROOT.glob("systems/**/numerics/*.py"), *ROOT.glob("gap/numerics/*.py")]

# Pictures are indexed by numbers that come from measurements. None of these may raise.
PICTURES = """
import numpy as np
from makebreak.systems.perception.numerics.ball_tracker import (
    _ANGLES, _fit_ball, find_ball, strength_weights)
from makebreak.systems.perception.numerics.pinhole import draw, look_down, shifted

rng = np.random.default_rng(0)
FAR = [0, 0.5, -0.5, 8, 9, 31, 32, 33, 400, 1e6, 1e30, np.inf, np.nan]
for height, width, n in [(24, 32, 4), (1, 1, 4), (1, 9, 4), (9, 1, 4), (2, 2, 3)]:
    picture = rng.integers(0, 256, (height, width, n), dtype=np.uint8)
    out = np.empty_like(picture)
    for u in FAR:
        for v in FAR:
            shifted(picture, u, v, out)
            shifted(picture, -u, -v, out)

camera = look_down(64, 48, 0.8, [0.5, 0.0, 1.0])
strength = rng.integers(0, 256, (48, 64), dtype=np.uint8)
region = rng.integers(0, 256, (48, 64, 4), dtype=np.uint8)
for u in FAR:  # Where Hough's circles may have their centre.
    for v in FAR:
        for sign in (1.0, -1.0):
            circles = np.array([[sign * u, sign * v, 6.0], [sign * u, v, 6.0]])
            _fit_ball(strength, region, circles, 12.0, _ANGLES, np.zeros(2, int),
                      camera.focal, camera.center)

hue = strength_weights(np.radians(33.0))
for k in range(60):  # Balls in and beside the picture, looked for where they are not.
    picture = np.full((48, 64, 4), 200, np.uint8)
    p = np.array([0.5, 0.0, 0.03]) + rng.uniform(-0.6, 0.6, 3) * [1.0, 1.0, 0.0]
    color = np.array([255.0, 140.0, 0.0])
    draw(picture, camera, "sphere", (0.08,), camera.to_camera(p), np.eye(3), color)
    guess = None if k % 3 == 0 else p + rng.normal(0.0, 0.08, 3) * [1.0, 1.0, 0.0]
    find_ball(picture, camera, hue, 0.08, 0.0, guess)
print("within bounds")
"""


def _checked(arguments) -> subprocess.CompletedProcess:
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_pictures_are_never_read_or_written_beside_their_edges():
    run = _checked(["-c", PICTURES])
    assert run.stdout.strip() == "within bounds", run.stderr[-2000:]


def _tests_of_kernels() -> list[str]:
    """Test files of the maths that has compiled code."""
    kernels = [
        path.stem
        for path in NUMERICS
        if re.search(r"^@(numba\.)?njit", path.read_text(), re.MULTILINE)
    ]
    files = sorted((ROOT / "tests").glob("test_*.py"))
    used = re.compile(rf"numerics\.({'|'.join(kernels)})\b")
    return [str(f) for f in files if used.search(f.read_text())]


@pytest.mark.slow
def test_every_kernel_stays_within_its_arrays_in_its_own_tests():
    chosen = [f for f in _tests_of_kernels() if f != __file__]
    assert len(chosen) > 20
    run = _checked(["-m", "pytest", "-q", "-x", *chosen])
    assert run.returncode == 0, run.stdout[-3000:]
