"""The state of a body in free flight, by least squares on all poses of the flight.

Between impacts nothing but gravity acts, so a flight has twelve unknowns, and each pose
tells something of all of them: a smoother, which lets the acceleration wander, knows a
spin ten times less well.
"""

from dataclasses import dataclass, replace

import numpy as np

from makebreak.gap.numerics.free_body import FreeBody, simulate

HIGH = 1e3  # [m] So far up nothing is touched.
STEPS, SMALL = 8, 1e-5
ENOUGH = 1e-6  # Of a deviation: a step that changes nothing.


@dataclass(frozen=True, eq=False)
class Flight:
    """x (13,): state at the first pose, as of free_body.simulate. covariance (12, 12):
    of small turns about world's axes [rad], of the place, the angular velocity and the
    velocity. rms: what is left over the noise, by degrees of freedom."""

    x: np.ndarray
    covariance: np.ndarray
    rms: float

    def path(self, body: FreeBody, seconds) -> tuple[np.ndarray, np.ndarray]:
        """States (n, 13) and covariances (n, 12, 12) so much later, nothing being
        touched. Args: seconds (n,), ascending from 0 [s]."""
        seconds = np.asarray(seconds, float)
        path = _high(body, self.x, seconds)
        A = np.empty((len(seconds), 12, 12))
        for i in range(12):
            other = _high(body, moved(self.x, i, SMALL), seconds)
            for k, (one, x) in enumerate(zip(other, path, strict=True)):
                A[k, :, i] = _apart(one, x) / SMALL
        return path, A @ self.covariance @ A.transpose(0, 2, 1)


def fit_flight(body: FreeBody, time, pose, noise, guess) -> Flight | None:
    """Gauss-Newton steps on the poses of a flight; None where they do not settle.

    Args: time (n,) [s], n >= 4; pose (n, 7): quaternion wxyz and place, NaN where not
        measured; noise (7,): of each; guess (13,): a state at the first row.
    """
    time, pose = np.asarray(time, float), np.array(pose, float)
    pose[:, :4] /= np.linalg.norm(pose[:, :4], axis=1, keepdims=True)
    there = np.isfinite(pose)
    noise = np.asarray(noise, float)

    def left(x) -> np.ndarray:
        path = _high(body, x, time)[:, :7]
        side = np.sign(np.nansum(path[:, :4] * pose[:, :4], axis=1, keepdims=True))
        path[:, :4] *= np.where(side == 0.0, 1.0, side)
        return ((pose - path) / noise)[there]

    x = np.array(guess, float)
    x[:4] /= np.linalg.norm(x[:4])
    r = left(x)
    for _ in range(STEPS):
        J = np.stack([(left(moved(x, i, SMALL)) - r) / SMALL for i in range(12)], 1)
        if not np.isfinite(J).all() or not np.isfinite(r).all():
            return None
        size = np.linalg.norm(J, axis=0)
        size[size == 0.0] = 1.0
        step = np.linalg.lstsq(J / size, -r, rcond=1e-10)[0] / size
        for i in range(12):
            x = moved(x, i, step[i])
        r = left(x)
        if np.abs(step * size).max() < ENOUGH * np.sqrt(len(r)):
            break
    else:
        return None
    C = np.linalg.pinv((J / size).T @ (J / size), rcond=1e-12, hermitian=True)
    rms = float(np.sqrt(np.sum(r**2) / max(len(r) - 12, 1)))
    return Flight(x, C / np.outer(size, size), rms)


def moved(x, i: int, by: float) -> np.ndarray:
    """A state (13,), its i-th of twelve unknowns (Flight.covariance) changed."""
    x = np.array(x, float)
    if i >= 3:
        x[i + 1] += by
        return x
    axis = np.eye(3)[i] * np.sin(0.5 * by)
    a, b = x[0], x[1:4].copy()
    x[0] = np.cos(0.5 * by) * a - axis @ b
    x[1:4] = np.cos(0.5 * by) * b + a * axis + np.cross(axis, b)
    return x


def turned_by(q, w) -> np.ndarray:
    """(4,) what w (3,), in world, makes of a quaternion wxyz: half their product. The
    rate of one that turns with w [rad/s]; also how a small turn changes it."""
    q, w = np.asarray(q, float), np.asarray(w, float)
    return 0.5 * np.concatenate([[-w @ q[1:]], q[0] * w + np.cross(w, q[1:])])


def _high(body: FreeBody, x, times) -> np.ndarray:
    """States (n, 13) where nothing is touched."""
    start = np.array(x, float)
    start[6] += HIGH
    free = replace(body, pairs=np.zeros_like(body.pairs))
    # What a window starts from is known far better than a pose is measured, and so is
    # what follows from it: errors of 1e-4 m were enough to make up an effect.
    path = simulate(free, start, times, tol=1e-8)
    path[:, 6] -= HIGH
    return path


def _apart(one, other) -> np.ndarray:
    """(12,) unknowns from `other` to `one`, states (13,) near each other."""
    a, q = one[:4] * np.sign(one[:4] @ other[:4]), other[:4]
    # The vector of a times the conjugate of q: half the turn, in world's axes.
    turn = 2.0 * (q[0] * a[1:] - a[0] * q[1:] - np.cross(a[1:], q[1:]))
    return np.concatenate([turn, one[4:] - other[4:]])
