"""Equations of motion tested with smooth bumps: no derivative of noise is needed.

With a test function w that vanishes with three derivatives at both ends of a window,

    integral(w dp/dt) = -integral(w' p),   integral(w a) = integral(w'' q),

so momentum and position stand in for force and acceleration, and noise of the position
enters by w'' alone. Source: Gronwall; Messenger and Bortz, Multiscale Model. Simul.
19(3), 2021 (weak SINDy), section 2.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

# integral of sin^8 and of the square of the second derivative, for w of unit integral
# on [0, 1]: w = (8/3) sin(pi s)^4.
_SQUARE = (8.0 / 3.0) ** 2 * 35.0 / 128.0
_CURVATURE = (8.0 / 3.0) ** 2 * np.pi**4 * 4.0


@dataclass(frozen=True, eq=False)
class Bumps:
    """Test functions of unit integral on the samples of one episode.

    w: (n_bumps, n) weights that give the mean of a sampled signal over each bump.
    dw: the same with the derivative of w. centre (n_bumps,) [s]; width [s].
    """

    w: csr_matrix
    dw: csr_matrix
    centre: np.ndarray
    width: float

    def mean(self, values) -> np.ndarray:
        """integral(w values): (n, ...) -> (n_bumps, ...)."""
        flat = np.reshape(values, (len(values), -1))
        return (self.w @ flat).reshape(-1, *np.shape(values)[1:])

    def weak(self, momentum, rest) -> np.ndarray:
        """integral(w (d/dt momentum + rest)), (n_bumps, ...)."""
        flat = np.reshape(momentum, (len(momentum), -1))
        out = (self.dw @ flat).reshape(-1, *np.shape(momentum)[1:])
        return self.mean(rest) - out

    def position_noise_gain(self, period: float) -> float:
        """Standard deviation of integral(w a) for unit white noise of the position,
        sampled every `period` [s]; [1/s2]."""
        return float(np.sqrt(period * _CURVATURE / self.width**5))

    def noise_gain(self, period: float) -> float:
        """The same of integral(w y) for unit white noise of y."""
        return float(np.sqrt(period * _SQUARE / self.width))


def make_bumps(times, steps, width: float, hop: float, holes=None) -> Bumps:
    """Bumps every `hop` over the samples.

    Args: times (n,) at which signals are sampled, steps (n,) how long each sample
        stands for [s]; width, of a bump [s]; holes (m, 2): no bump reaches into
        [start, end] of one.
    """
    t, h = np.asarray(times, float), np.asarray(steps, float)
    starts = np.arange(t[0] - 0.5 * h[0], t[-1] + 0.5 * h[-1] - width + 1e-9, hop)
    for a, b in np.reshape([] if holes is None else holes, (-1, 2)):
        starts = starts[(starts + width <= a) | (starts >= b)]
    rows, columns, value, slope = [], [], [], []
    for i, start in enumerate(starts):
        first, last = np.searchsorted(t, [start, start + width])
        s = (t[first:last] - start) / width
        angle = np.pi * s
        rows.append(np.full(last - first, i))
        columns.append(np.arange(first, last))
        value.append(8.0 / (3.0 * width) * np.sin(angle) ** 4 * h[first:last])
        rate = 4.0 * np.sin(angle) ** 3 * np.cos(angle) * np.pi / width
        slope.append(8.0 / (3.0 * width) * rate * h[first:last])
    shape = (len(starts), len(t))
    if not len(starts):
        return Bumps(csr_matrix(shape), csr_matrix(shape), starts, width)
    where = (np.concatenate(rows), np.concatenate(columns))
    w = csr_matrix((np.concatenate(value), where), shape)
    dw = csr_matrix((np.concatenate(slope), where), shape)
    return Bumps(w, dw, starts + 0.5 * width, width)
