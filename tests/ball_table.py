"""A table of where one ball was seen, for gap."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def write_ball_table(file: Path, rows: Sequence[np.ndarray]) -> Path:
    """rows: of each episode (n, 5) time [s], its number and the place [m]."""
    np.savetxt(
        file, np.concatenate(rows), delimiter=",", comments="", fmt="%.9g",
        header="time,episode,ball.ball.x,ball.ball.y,ball.ball.z",
    )  # fmt: skip
    return file
