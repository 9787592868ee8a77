"""Periodic motions that tell parameters best: finite Fourier series, D-optimal.

Each joint moves by a series of n harmonics of one base frequency,

    q(t) = q_0 + sum_k  s_k sin(k w t) / (k w)  -  c_k cos(k w t) / (k w),

of which velocity and acceleration vanish at t = 0 (sum s_k = 0, sum k c_k = 0), so that
a robot can begin and end at rest. A motion tells parameters p, which enter the measured
efforts as W(q, v, vd) p + noise, with the information matrix

    M = sum_i W_i' S^-1 W_i + diag(prior^-2),     S = diag(sigma^2),

and a D-optimal motion has the largest det(M) within the limits.

Source: Swevers, Ganseman, Tukel, De Schutter, Van Brussel, "Optimal robot excitation
and identification", IEEE Trans. Robotics and Automation 13(5), 1997, sections III, IV;
parameters of no interest (nuisances) are left out of det(M) as in Atkinson, Donev,
Tobias, "Optimum Experimental Designs, with SAS", 2007, section 10.3 (D_s-optimality).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

# (q, v, vd), each (n, n_joints) -> columns (n, n_joints, n_parameters) and the effort
# (n, n_joints) that the motion needs.
Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple]

STEP = 1e-5  # Of forward differences, in units of the limits: sqrt(eps) or more.
WALLS = (1e1, 1e3)  # Weights of excesses: a soft wall first, then a hard one.
STEPS = (40, 30)  # Of the search at each wall.


@dataclass(frozen=True, eq=False)
class Limits:
    """Of each joint: lower, upper [rad or m], velocity, acceleration and effort
    (n_joints,), the latter three to both sides; infinite where there is none."""

    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    effort: np.ndarray


@dataclass(frozen=True, eq=False)
class Series:
    """The basis of motions: period [s], number of harmonics (2 or more)."""

    period: float
    harmonics: int

    def __post_init__(self):
        if self.harmonics < 2 or not self.period > 0.0:
            raise ValueError(
                f"a series has {self.harmonics} harmonics of {self.period} s, expected "
                "2 or more of a period above 0"
            )

    @property
    def free(self) -> int:
        """Coefficients of a joint that can be chosen, besides its centre."""
        return 2 * self.harmonics - 2

    def bases(self, time: np.ndarray) -> np.ndarray:
        """(3, n, free): position (without centre), velocity and acceleration at times
        (n,) [s] for each free coefficient [rad/s or m/s]."""
        rate = 2.0 * np.pi / self.period * np.arange(1, self.harmonics + 1)
        sin, cos = np.sin(np.outer(time, rate)), np.cos(np.outer(time, rate))
        whole = np.stack([
            np.hstack([sin / rate, -cos / rate]),
            np.hstack([cos, sin]),
            np.hstack([-sin * rate, cos * rate]),
        ])  # fmt: skip
        at_rest = np.zeros((2, 2 * self.harmonics))
        at_rest[0, : self.harmonics], at_rest[1, self.harmonics :] = 1.0, rate / rate[0]
        return whole @ null_space(at_rest)


@dataclass(frozen=True, eq=False)
class Excitation:
    """A periodic motion: centre (n_joints,), coefficients (free, n_joints)."""

    series: Series
    centre: np.ndarray
    coefficients: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, v, vd, each (n, n_joints), at times (n,) [s]."""
        q, v, vd = self.series.bases(time) @ self.coefficients
        return q + self.centre, v, vd


def information(columns: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """sum_i W_i' S^-1 W_i: columns (n, n_joints, k), weights 1/sigma^2 (n_joints,)."""
    return np.einsum("ija,j,ijb->ab", columns, weights, columns)


def excesses(motion, effort, limits: Limits) -> np.ndarray:
    """(5, n, n_joints) how far positions, velocities, accelerations and efforts are
    beyond their limits, in units of these (of half the range); 0 or less within them.
    """
    q, v, vd = motion
    half = 0.5 * (limits.upper - limits.lower)
    return np.stack([
        (q - limits.upper) / half,
        (limits.lower - q) / half,
        np.abs(v) / limits.velocity - 1.0,
        np.abs(vd) / limits.acceleration - 1.0,
        np.abs(effort) / limits.effort - 1.0,
    ])  # fmt: skip


class DesignProblem:
    """The motions of a series as points x: centres and coefficients of all joints, in
    units of their limits.

    Args: regressor: see above; limits: finite in position, velocity and effort.
    sigma (n_joints,): noise of a sample of measured effort. prior (k,): standard
    deviations of the parameters before the log; infinite: nothing is known.
    named: how many of them, the first, are of interest; the others are nuisances.
    samples: that a log has in a period.
    """

    def __init__(
        self, regressor: Regressor, series: Series, limits: Limits, sigma: np.ndarray,
        prior: np.ndarray, named: int, samples: float,
    ):  # fmt: skip
        self.regressor, self.series, self.limits = regressor, series, limits
        self.named, self.prior = named, prior
        n = 8 * series.harmonics  # Columns are products of few harmonics.
        self.time = series.period * np.arange(n) / n
        self.weights = samples / n / sigma**2
        self.bases = series.bases(self.time)
        self._half = 0.5 * (limits.upper - limits.lower)
        self._middle = 0.5 * (limits.upper + limits.lower)

    def motion_of(self, x: np.ndarray) -> Excitation:
        """x: (n_joints (1 + free),)."""
        n = len(self._half)
        centre = self._middle + self._half * x[:n]
        return Excitation(
            self.series, centre, x[n:].reshape(-1, n) * self.limits.velocity
        )

    def matrix(self, columns: np.ndarray) -> np.ndarray:
        """M, with the prior: parameters in units of their prior, or of 1."""
        unit = np.where(np.isfinite(self.prior), self.prior, 1.0)
        M = information(columns * unit, self.weights)
        return M + np.diag(np.isfinite(self.prior).astype(float) + 1e-9)

    def deviations(self, excitation: Excitation) -> np.ndarray:
        """(k,) standard deviations that a log of one period leaves."""
        columns, _ = self.regressor(*excitation.at(self.time))
        unit = np.where(np.isfinite(self.prior), self.prior, 1.0)
        return unit * np.sqrt(np.diag(np.linalg.inv(self.matrix(columns))))

    def score(self, columns: np.ndarray) -> tuple[float, np.ndarray]:
        """-log det M of the named parameters, and its derivative (n, n_joints, k) by
        the columns."""
        k = self.named
        M = self.matrix(columns)
        inverse = np.linalg.inv(M)
        value = -np.linalg.slogdet(M)[1]
        if k < len(M):
            value += np.linalg.slogdet(M[k:, k:])[1]
            inverse[k:, k:] -= np.linalg.inv(M[k:, k:])
        unit = np.where(np.isfinite(self.prior), self.prior, 1.0)
        slope = -2.0 * (columns * unit) @ inverse * unit
        return float(value), slope * self.weights[:, None]

    def value(self, x: np.ndarray, wall: float) -> tuple[float, np.ndarray]:
        """Score and what exceeds the limits, with the slope by x: differences by the
        motion's samples, then the series."""
        motion = list(self.motion_of(x).at(self.time))
        columns, effort = self.regressor(*motion)
        score, by_columns = self.score(columns)
        over = np.maximum(excesses(motion, effort, self.limits), 0.0)
        score += wall * float(np.sum(over**2))
        half, n = self._half, len(self._half)
        by_motion = np.zeros((3, *effort.shape))
        by_motion[0] += 2.0 * wall * (over[0] - over[1]) / half
        by_motion[1] += 2.0 * wall * over[2] * np.sign(motion[1]) / self.limits.velocity
        by_motion[2] += (
            2.0 * wall * over[3] * np.sign(motion[2]) / self.limits.acceleration
        )
        by_effort = 2.0 * wall * over[4] * np.sign(effort) / self.limits.effort
        rate = 2.0 * np.pi * self.series.harmonics / self.series.period
        sizes = (half, self.limits.velocity, self.limits.velocity * rate)
        for what, size in enumerate(sizes):
            for j in range(n):
                moved = [each.copy() for each in motion]
                moved[what][:, j] += STEP * size[j]
                there, needed = self.regressor(*moved)
                change = np.sum(by_columns * (there - columns), axis=(1, 2))
                change += np.sum(by_effort * (needed - effort), axis=1)
                by_motion[what][:, j] += change / (STEP * size[j])
        slope = np.einsum("wif,wij->fj", self.bases, by_motion) * self.limits.velocity
        return score, np.concatenate([by_motion[0].sum(axis=0) * half, slope.ravel()])

    def within(self, excitation: Excitation, share: float) -> Excitation:
        """The motion, smaller if it must be, within `share` of the limits.

        Raises: ValueError if the joints cannot even hold still at its centre.
        """
        time = self.series.period * np.arange(600) / 600
        middle, half = self._middle, self._half
        tight = Limits(
            middle - share * half, middle + share * half,
            share * self.limits.velocity, share * self.limits.acceleration,
            share * self.limits.effort,
        )  # fmt: skip

        def scaled(size):
            return Excitation(
                self.series, excitation.centre, size * excitation.coefficients
            )

        def worst(size):
            motion = scaled(size).at(time)
            return excesses(motion, self.regressor(*motion)[1], tight).max(axis=(0, 1))

        if (still := worst(0.0)).max() > 0.0:
            j = int(np.argmax(still))
            raise ValueError(
                f"joint {j + 1} cannot hold still within its limits of effort"
            )
        low, high = 0.0, 1.0
        if worst(1.0).max() <= 0.0:
            return excitation
        for _ in range(20):
            size = 0.5 * (low + high)
            low, high = (size, high) if worst(size).max() <= 0.0 else (low, size)
        return scaled(low)


def design(
    problem: DesignProblem,
    share: float = 0.95,
    starts: int = 2,
    progress: Callable[[str], None] = lambda text: None,
) -> Excitation:
    """The best motion of several searches (L-BFGS from random small motions), within
    `share` of the limits.

    Raises: ValueError if none is within the limits.
    """
    rng = np.random.default_rng(0)
    n, free = len(problem.limits.velocity), problem.series.free
    best: tuple[float, Excitation] | None = None
    refused = ValueError("no start")
    for start in range(starts):
        x = np.concatenate([
            0.3 * rng.uniform(-1.0, 1.0, n),
            0.3 / np.sqrt(free) * rng.normal(size=free * n),
        ])  # fmt: skip
        for wall, steps in zip(WALLS, STEPS, strict=True):
            progress(f"motion {start + 1} of {starts}")
            x = minimize(
                problem.value, x, (wall,), "L-BFGS-B", True, options={"maxiter": steps}
            ).x
        try:
            found = problem.within(problem.motion_of(x), share)
        except ValueError as error:
            refused = error
            continue
        score, _ = problem.score(problem.regressor(*found.at(problem.time))[0])
        if best is None or score < best[0]:
            best = score, found
    if best is None:
        raise refused
    return best[1]
