"""Position, velocity and acceleration of a signal from noisy samples of its position.

The prior is a signal whose third derivative is white noise; its density is estimated
from the samples (maximum likelihood). Filter and smoother are exact for uneven and
missing samples. Source: Rauch, Tung, Striebel, AIAA J. 3(8), 1965; as a spline: Wahba,
Spline Models for Observational Data, 1990, section 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.interpolate import CubicHermiteSpline

from makebreak.systems.numerics.filters import (
    Stage,
    filtered,
    mean_delay,
    subdivided,
)

_ITERATIONS_MAX = 4  # Limit of van Cittert iterations.


@dataclass(frozen=True, eq=False)
class Smoothed:
    """States at the requested times."""

    x: np.ndarray  # (n, 3): value, first and second derivative.
    # (n, 3, 3) covariances of x. Rounding, from the vague prior, may leave those of the
    # first three samples without positive variances.
    P: np.ndarray
    density: float  # Of the third derivative [unit2/s5].
    innovation: float  # Rms of the one-step errors over their expected one: about 1.


def smooth(times, samples, noise: float, density: float | None = None) -> Smoothed:
    """The states at all times.

    Args: times (n,): increasing [s]; samples (n,): NaN where there is no sample (the
        state is estimated there too); noise: standard deviation of a sample; density:
        of the third derivative, None: estimated.
    Raises: ValueError for fewer than 6 samples.
    """
    t, y = np.asarray(times, float), np.asarray(samples, float)
    there = np.isfinite(y)
    if there.sum() < 6:
        raise ValueError(f"got {there.sum()} samples, expected at least 6 to smooth")
    shift = float(np.mean(y[there]))
    spread = max(float(np.std(y[there])), 10.0 * noise, 1e-9)
    y = np.where(there, (y - shift) / spread, np.nan)
    r = (max(noise, 1e-9 * spread) / spread) ** 2
    dt = np.diff(t, prepend=t[0])
    if density is None:
        best, best_cost = 1.0, np.inf
        for exponent in np.arange(-2.0, 9.1, 0.5):
            cost = _likelihood(dt, y, r, 10.0**exponent)
            if cost < best_cost:
                best, best_cost = 10.0**exponent, cost
        density = best
    else:
        density = density / spread**2
    x, P, innovation = _run(dt, y, r, density)
    x = x * spread
    x[:, 0] += shift
    return Smoothed(x, P * spread**2, density * spread**2, innovation)


def smooth_filtered(
    times, samples, noise: float, stages: Sequence[Stage] = ()
) -> Smoothed:
    """The states of a true signal whose samples were filtered by the stages.

    Van Cittert's iteration: the first estimate treats the filters as their mean delay;
    then the estimate is filtered and compared with the samples, and the difference,
    smoothed with the signal's density, is added to it. The error decreases with powers
    of 1 - H(s) exp(s mean delay), 3 % for a first-order filter of 4 ms at 10 Hz.

    Args, Raises: as smooth.
    """
    t, y = np.asarray(times, float), np.asarray(samples, float)
    if not stages:
        return smooth(t, y, noise)
    late = mean_delay(stages)
    there = np.isfinite(y)
    # A sample is approximately the true value at `late` before it.
    grid, where = np.unique(np.concatenate([t, t[there] - late]), return_inverse=True)
    rows, stamps = where[: len(t)], where[len(t) :]
    seen = np.full(len(grid), np.nan)
    seen[stamps] = y[there]
    first = smooth(grid, seen, noise)
    x = first.x
    # `filtered` is linear between samples, so it gets several samples per interval.
    dense = subdivided(grid, 0.1 * float(np.median(np.diff(t))))
    for _ in range(_ITERATIONS_MAX):
        guess = CubicHermiteSpline(grid, x[:, 0], x[:, 1])(dense)
        seen[stamps] = y[there] - filtered(stages, dense, guess, t[there])
        more = smooth(grid, seen, noise, first.density).x
        if np.sqrt(np.mean(more[:, 0] ** 2)) < 0.5 * noise:
            break  # The correction is smaller than the noise.
        x = x + more
    return Smoothed(x[rows], first.P[rows], first.density, first.innovation)


def blur_sec(noise: float, every: float, density: float) -> float:
    """Time over which the smoother blurs a jump of the true velocity [s]: the T at
    which samples of standard deviation `noise`, one every `every` seconds, weigh as
    much as the prior, noise^2 every = density T^6. The velocity near a jump may be
    wrong by T times the smoothed acceleration."""
    return (noise**2 * every / max(density, 1e-12)) ** (1.0 / 6.0)


@njit(cache=True)
def _step(x, P, dt, s):
    """Prediction over dt."""
    F = np.eye(3)
    F[0, 1] = F[1, 2] = dt
    F[0, 2] = 0.5 * dt * dt
    Q = np.empty((3, 3))
    Q[0, 0] = dt**5 / 20.0
    Q[0, 1] = Q[1, 0] = dt**4 / 8.0
    Q[0, 2] = Q[2, 0] = dt**3 / 6.0
    Q[1, 1] = dt**3 / 3.0
    Q[1, 2] = Q[2, 1] = dt * dt / 2.0
    Q[2, 2] = dt
    return F, F @ x, F @ P @ F.T + s * Q


@njit(cache=True)
def _likelihood(dt, y, r, s):
    """-2 log likelihood of the samples, the first three left out.

    The filter of _run in scalars: it runs two dozen times for each signal, and small
    arrays would take most of the time.
    """
    x0 = x1 = x2 = 0.0
    p00 = p11 = p22 = 1e8
    p01 = p02 = p12 = 0.0
    cost, seen = 0.0, 0
    for k in range(len(y)):
        h = dt[k]
        if h > 0.0:
            g = 0.5 * h * h
            x0, x1 = x0 + h * x1 + g * x2, x1 + h * x2
            # The entries of F P that F P F' needs.
            a00, a01, a02 = (
                p00 + h * p01 + g * p02,
                p01 + h * p11 + g * p12,
                p02 + h * p12 + g * p22,
            )
            a11, a12 = p11 + h * p12, p12 + h * p22
            h2 = h * h
            h3 = h2 * h
            p00 = a00 + h * a01 + g * a02 + s * h2 * h3 / 20.0
            p01 = a01 + h * a02 + s * h2 * h2 / 8.0
            p02 = a02 + s * h3 / 6.0
            p11 = a11 + h * a12 + s * h3 / 3.0
            p12 = a12 + s * h2 / 2.0
            p22 = p22 + s * h
        if np.isfinite(y[k]):
            S = p00 + r
            e = y[k] - x0
            k0, k1, k2 = p00 / S, p01 / S, p02 / S
            x0, x1, x2 = x0 + k0 * e, x1 + k1 * e, x2 + k2 * e
            p22 -= k2 * p02
            p12 -= k1 * p02
            p11 -= k1 * p01
            p02 -= k0 * p02
            p01 -= k0 * p01
            p00 -= k0 * p00
            seen += 1
            if seen > 3:
                cost += e * e / S + np.log(S)
    return cost


@njit(cache=True)
def _run(dt, y, r, s):
    n = len(y)
    xf, Pf = np.zeros((n, 3)), np.zeros((n, 3, 3))
    xp, Pp, Fs = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    x = np.zeros(3)
    P = np.diag(np.array([1e8, 1e8, 1e8]))
    total, seen = 0.0, 0
    for k in range(n):
        F = np.eye(3)
        if dt[k] > 0.0:
            F, x, P = _step(x, P, dt[k], s)
        xp[k], Pp[k], Fs[k] = x, P, F
        if np.isfinite(y[k]):
            S = P[0, 0] + r
            e = y[k] - x[0]
            K = P[:, 0] / S
            x = x + K * e
            # Joseph's form keeps the digits that the vague initial P would cost.
            A = np.eye(3)
            A[:, 0] -= K
            P = A @ P @ A.T + r * np.outer(K, K)
            seen += 1
            if seen > 3:
                total += e * e / S
        xf[k], Pf[k] = x, P
    for k in range(n - 2, -1, -1):
        G = Pf[k] @ Fs[k + 1].T @ np.linalg.inv(Pp[k + 1])
        xf[k] = xf[k] + G @ (xf[k + 1] - xp[k + 1])
        Pf[k] = Pf[k] + G @ (Pf[k + 1] - Pp[k + 1]) @ G.T
    return xf, Pf, np.sqrt(total / max(seen - 3, 1))
