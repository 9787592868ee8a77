"""Drift of the sensor and slope of the surface, from the force across a sliding motion.

Coulomb friction acts against the motion. What a sliding tool feels at right angles to
it, within the surface, is none: it is the sensor's bias b, and the part of the normal
force R that a surface has which is not quite at right angles to the direction n in
which it is pressed, R s with s the slope. Along l = n x v/|v|,

    l.F = l.b + R l.s + noise

The bias drifts and the slope does not, and R and l change from one piece of the path to
the next, so a Kalman filter over [b, db/dt, s] (three entries each) tells them apart.
What is along the motion in one piece is across it in another.

It assumes friction that is the same in all directions.
"""

import numba
import numpy as np

# Prior standard deviations: of the bias after a tare [N], of its drift [N/s], and of
# the slope [rad].
BIAS_STD, DRIFT_STD, SLOPE_STD = 0.015, 0.01, 0.02
# Variance that a second adds, of the bias [N2] and of the slope.
BIAS_NOISE, SLOPE_NOISE = 2e-6, 2e-7
# Of a sample, every 5 ms. More than the sensor's 0.1 N: its errors are not white.
FORCE_STD = 0.5
SPEED_MIN = 0.03  # Slower than that the direction is not known well [m/s].
PRESSED = 2.0  # [N]
GATE = 0.6  # A larger surprise is an impact or a seam, no drift [N].
SLOPE_MAX = 0.1  # [rad]
PERIOD = 0.005  # Of an update [s].
N_X = 9
N_MEMORY = N_X + N_X * N_X  # Estimate, covariance.
B, S = slice(0, 3), slice(6, 9)  # In the estimate.


@numba.njit(cache=True)
def _reset(memory, first, std):
    for i in range(first, first + 3):
        memory[i] = 0.0
        for j in range(N_X):
            memory[N_X + N_X * i + j] = memory[N_X + N_X * j + i] = 0.0
        memory[N_X + N_X * i + i] = std**2


@numba.njit(cache=True)
def reset_bias(memory):
    """After a tare: b is 0 again, within BIAS_STD. In place."""
    _reset(memory, 0, BIAS_STD)
    _reset(memory, 3, DRIFT_STD)


@numba.njit(cache=True)
def reset_slope(memory):
    """On another surface. In place."""
    _reset(memory, 6, SLOPE_STD)


@numba.njit(cache=True)
def predict(memory):
    """The estimate (N_MEMORY,) after another PERIOD. In place."""
    P = memory[N_X:].reshape(N_X, N_X)
    for i in range(3):
        memory[i] += PERIOD * memory[3 + i]
        for j in range(N_X):
            P[i, j] += PERIOD * P[3 + i, j]
    for i in range(3):
        for j in range(N_X):
            P[j, i] += PERIOD * P[j, 3 + i]
    for i in range(3):
        P[i, i] += PERIOD * BIAS_NOISE
        P[6 + i, 6 + i] += PERIOD * SLOPE_NOISE


@numba.njit(cache=True)
def update(memory, force, velocity, n):
    """The estimate (N_MEMORY,) after a sample. In place.

    Args: force (3,) on the tool, of which the bias at the tare is taken off [N];
        velocity (3,) of the tip [m/s]; n (3,) unit vector into the surface.
    """
    along = velocity - (velocity @ n) * n
    speed = np.sqrt(along @ along)
    R = -(force @ n)
    if not (speed > SPEED_MIN and R > PRESSED):
        return
    l = np.cross(n, along / speed)  # noqa: E741
    H = np.zeros(N_X)
    H[:3] = l
    H[6:] = R * l
    P = memory[N_X:].reshape(N_X, N_X)
    surprise = force @ l - H @ memory[:N_X]
    if not abs(surprise) < GATE:
        return
    PH = P @ H
    gain = PH / (H @ PH + FORCE_STD**2)
    for i in range(N_X):
        memory[i] += gain[i] * surprise
        for j in range(N_X):
            P[i, j] -= gain[i] * PH[j]
    s = memory[6:9]
    size = np.sqrt(s @ s)
    if size > SLOPE_MAX:
        s *= SLOPE_MAX / size
