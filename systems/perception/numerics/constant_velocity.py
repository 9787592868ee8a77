"""A Kalman filter with a constant-velocity model for a point in the plane.

Along x and y: state [p, v], dv = white noise of power density q [m^2/s^3], p measured
with standard deviation sigma. Both axes have the same covariance P, stored as (P_pp,
P_pv, P_vv).

Source: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and
Navigation", section 6.2.2 (continuous white noise acceleration).
"""

import numpy as np


def predict(p, v, P, dt, q):
    """Predicts the estimate by dt [s].

    Args: p, v (2,) [m], [m/s]; P (3,); q [m^2/s^3].
    Returns: p, v, P.
    """
    P_pp, P_pv, P_vv = P
    P = np.array(
        [
            P_pp + 2.0 * dt * P_pv + dt**2 * P_vv + q * dt**3 / 3.0,
            P_pv + dt * P_vv + q * dt**2 / 2.0,
            P_vv + q * dt,
        ]
    )
    return p + dt * v, v, P


def correct(p, v, P, measured, sigma):
    """Corrects the estimate with a measurement of p.

    Args: p, v, measured (2,); P (3,); sigma [m].
    Returns: p, v, P.
    """
    P_pp, P_pv, P_vv = P
    S = P_pp + sigma**2
    innovation = measured - p
    P = np.array([P_pp * sigma**2, P_pv * sigma**2, P_vv * S - P_pv**2]) / S
    return p + P_pp / S * innovation, v + P_pv / S * innovation, P


def distance_in_sigmas(p, P, measured, sigma):
    """Error of a measurement (2,) in standard deviations of its prediction."""
    return float(np.hypot(*(measured - p)) / np.sqrt(P[0] + sigma**2))
