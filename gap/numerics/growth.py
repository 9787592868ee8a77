"""How an uncertain start and noisy efforts spread along a motion, to first order."""

import numpy as np
from scipy.linalg import expm

MOST = 1e9  # A larger variance says no more, and would overflow.


def spread_along(
    slopes: np.ndarray,
    mobility: np.ndarray,
    start: np.ndarray,
    white: np.ndarray,
    steady: np.ndarray,
    after: np.ndarray,
    impulses: np.ndarray,
) -> np.ndarray:
    """Variances (m, 2 n) of positions and velocities at the times `after` (m,) [s].

    d/dt (q, v) = (v, a(q, v) + W (noise of efforts)), linear about the motion.

    Args: slopes: (k, n, 2 n) da/d(q, v) in each of k parts of equal length.
        mobility: (k, n, n) W = M^-1. start: (2 n, 2 n) covariance at 0.
        white: (n,) density of the efforts' white noise [(N m)^2 s]. steady: (n,)
        variance of what is the same all the time [(N m)^2]. impulses: (m, n) variance
        of the impulse that an effort has too much at each time [(N m s)^2].
    """
    n = len(white)
    end = float(after[-1])
    if end <= 0.0:
        return np.tile(np.diag(start), (len(after), 1))
    each = 4  # Steps of a part.
    h = end / (each * len(slopes))
    density = np.tile(white, (each * len(slopes), 1))  # Of each step.
    steps = np.minimum((after / h).astype(int), len(density) - 1)
    np.add.at(density, steps, impulses / h)
    P = np.array(start, float)
    S = np.zeros((2 * n, n))  # What a steady effort does.
    found = [np.diag(P).copy()]
    for slope, W in zip(slopes, mobility, strict=True):
        A = np.zeros((2 * n, 2 * n))
        A[:n, n:] = np.eye(n)
        A[n:] = slope
        B = np.vstack([np.zeros((n, n)), W])
        # Half a step, and the exact sum of the noise within it by Simpson's rule.
        half = expm(0.5 * h * A)
        step = half @ half
        inputs = np.stack([B, half @ B, step @ B])
        weights = np.array([1.0, 4.0, 1.0]) / 6.0 * h
        made = np.einsum("s,sij,skj->jik", weights, inputs, inputs)
        pushed = np.einsum("s,sij->ij", weights, inputs)
        for _ in range(each):
            noise = np.tensordot(density[len(found) - 1], made, 1)
            P = step @ P @ step.T + noise
            S = step @ S + pushed
            found.append(np.diag(P) + (S**2) @ steady)
    grid = h * np.arange(len(found))
    deviations = np.sqrt(np.clip(found, 0.0, MOST))
    return np.stack([np.interp(after, grid, x) ** 2 for x in deviations.T], axis=1)
