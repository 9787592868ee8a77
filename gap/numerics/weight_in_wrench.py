"""Whether a force sensor that touches nothing reads the weight of what it carries.

A reading is a w + R b in world, or a R' w + b in the sensor's own axes: w the weight,
R the sensor's axes, b its bias. Where the sensor turns, the two differ: the weight
stays as it is in world, and the bias in the sensor.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

WORLD, SENSOR = "world", "sensor"
TURNS = 0.2  # rms change of the weight's direction in the sensor [rad]: it turns.
LEAST, MOST = 0.5, 2.0  # Times the weight: beyond, it is something else.
SAME = 0.05  # Two ways that are no more apart are one.
ASIDE = 0.3  # Of what is read, across the weight, where a bias may be there, too.
SURE = 0.1  # Of the weight: the standard error of what is read, at most.
# What is left of the readings, at most: of the weight, for the tool's own motion, and
# times the noise. More, and something is touched.
STEADY, NOISY = 0.3, 2.0
# A model of more numbers must leave so much less: what it is for then shows.
ALIKE = 1.1
EXACT = 1e-9  # Of the weight: what is left by rounding alone.
_TRIMS, _BEYOND = 5, 3.0  # Rounds in which what is so many medians off is left out.


@dataclass(frozen=True, eq=False)
class HeldWeight:
    """ways: (axes, times) that fit alike: of which the reading is so many times the
    weight, less than 0 where it is the force on the environment. bias (3,): what it
    reads beside it, in the sensor. turns: whether the sensor turned enough to tell the
    weight from a bias of the sensor. constant: whether the columns are: if they were in
    the sensor's axes, and it turned, that would be a bias. reads (3,): their median."""

    ways: tuple[tuple[str, float], ...]
    bias: np.ndarray
    turns: bool
    constant: bool
    reads: np.ndarray


def held_weight(
    force: np.ndarray,
    axes: np.ndarray,
    weight: np.ndarray,
    noise: float,
    independent: float,
) -> HeldWeight | None:
    """The weight that a sensor reads; None where it reads none, or it cannot be told.

    Args: force (n, 3): read while nothing is touched [N]; axes (n, 3, 3): the sensor's
        in world, as columns; weight (3,): in world [N]; noise: of a reading [N];
        independent: how many of the readings may be taken to be independent.
    """
    heavy = float(np.linalg.norm(weight))
    own = axes.transpose(0, 2, 1) @ weight
    turn = float(np.sqrt(max(1.0 - np.sum((own.mean(axis=0) / heavy) ** 2), 0.0)))
    one = np.tile(np.eye(3), (len(force), 1, 1))
    same = np.tile(weight, (len(force), 1))
    models = {
        (WORLD, 1): same[:, :, None],
        (SENSOR, 1): own[:, :, None],
        ("constant", 3): one,
        ("bias", 3): axes,
        (WORLD, 4): np.concatenate([same[:, :, None], axes], axis=2),
        (SENSOR, 4): np.concatenate([own[:, :, None], one], axis=2),
    }
    turns = turn > TURNS
    if not turns:
        models = {("constant", 3): one}
    fits = {key: _fitted(A, force) for key, A in models.items()}
    enough = ALIKE * min(left for _, left in fits.values()) + EXACT * heavy
    alike = [key for key, (_, left) in fits.items() if left <= enough]
    name, n = min(alike, key=lambda key: (key[1], fits[key][1]))
    x, left = fits[name, n]
    reads = np.median(force, axis=0)
    known = heavy * np.sqrt(independent) * (turn if n == 4 else 1.0)
    if left > STEADY * heavy + NOISY * noise or left > SURE * known:
        return None
    if name in (WORLD, SENSOR):
        ways = [(name, float(x[0]))]
        bias = x[1:] if n == 4 else np.zeros(3)
    elif name == "constant":
        # In the axes of a sensor that turns, the weight would turn.
        ways, bias = _along(
            x, [(WORLD, weight)] + [(SENSOR, own.mean(axis=0))] * (not turns)
        )
    else:
        return None
    ways = [(a, t) for a, t in ways if LEAST <= abs(t) <= MOST]
    if not ways:
        return None
    return HeldWeight(tuple(ways), bias, turns, ("constant", 3) in alike, reads)


def _fitted(A: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, float]:
    """x (k,) with A (n, 3, k) x nearest to force (n, 3), but for the rows that are far
    off, and the median of what is left [N]."""
    good = np.ones(len(force), bool)
    for _ in range(_TRIMS):
        rows = A[good].reshape(-1, A.shape[2])
        x = np.linalg.lstsq(rows, force[good].ravel(), rcond=None)[0]
        left = np.linalg.norm(force - A @ x, axis=1)
        good = left <= _BEYOND * np.median(left) + 1e-12
    return x, float(np.median(left))


def _along(read: np.ndarray, weights: Sequence[tuple[str, np.ndarray]]):
    """[(axes, times)] of the weights, each in those axes, that a constant reading is
    along, those on the robot first; and what it is beside the first of them."""
    ways: list[tuple[float, str, np.ndarray]] = []
    for name, w in weights:
        times = float(read @ w / (w @ w))
        aside = read - times * w
        if np.linalg.norm(aside) > ASIDE * np.linalg.norm(read):
            continue
        # A frame that stands as the world does is no other way.
        if not any(abs(times - t) < SAME * abs(t) for t, _, _ in ways):
            ways.append((times, name, aside))
    ways.sort(key=lambda way: way[0] < 0.0)
    return [(name, t) for t, name, _ in ways], ways[0][2] if ways else np.zeros(3)
