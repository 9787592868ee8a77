"""Where contacts are expected: a Gaussian each, Kalman's update, the region in which a
contact is anticipated, and the speed at which it is approached.

The state c (3,) is the tip's position at a contact, in the world. What is measured is
the tip's position when the contact is felt. *Along* the motion d that leads into it,
that is where the surface is, to std_along. *Across* d it is where the robot happened to
be: a wall is met wherever the motion comes to it. So a contact along d informs along d,
and across d only so much as the motion repeats itself from trial to trial (std_across,
some millimetres). For the same reason contacts are told apart along d alone, and the
region matters along d: `spread_along`, and for a picture the ellipsoid.

Source: CC sections 3.3 and 3.4.1, eq. 9.
"""

import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import ExpectedContact


def predict(mean, covariance, Q, A=None, B=None, u=None):
    """The next trial's prior, c_next = A c + B u + w with w ~ N(0, Q).

    Args: mean (3,) [m]; covariance, Q (3, 3) [m2]; A (3, 3), None: identity; B (3, m)
        and u (m,), for contacts that the robot's actions move: None: they stay.
    Returns: mean, covariance.
    Source: CC 3.3, state equation.
    """
    A = np.eye(3) if A is None else np.asarray(A, dtype=float)
    mean = A @ mean
    if B is not None:
        mean = mean + np.asarray(B, dtype=float) @ np.asarray(u, dtype=float)
    return mean, A @ covariance @ A.T + Q


def update(mean, covariance, p, R):
    """The posterior after a contact was felt at p = c + v, v ~ N(0, R).

    Joseph's form: symmetric and positive definite whatever the rounding.

    Args: mean, p (3,) [m]; covariance, R (3, 3) [m2], R positive definite.
    Returns: mean, covariance.
    """
    K = np.linalg.solve(covariance + R, covariance).T
    left = np.eye(3) - K
    covariance = left @ covariance @ left.T + K @ R @ K.T
    return mean + K @ (p - mean), 0.5 * (covariance + covariance.T)


def measurement_covariance(d, std_along, std_across):
    """(3, 3) [m2] of where the tip is when it feels a contact along d (3,)."""
    along = np.outer(d, d)
    return std_along**2 * along + std_across**2 * (np.eye(3) - along)


def spread_along(covariance, d) -> float:
    """Standard deviation along the unit vector d [m]."""
    return float(np.sqrt(d @ covariance @ d))


def is_expected(contact: ExpectedContact, p, d, std_along, gate) -> bool:
    """Whether what was felt at p on the way along d may be this contact.

    Args: p, d (3,); std_along of the measurement [m]; gate, in standard deviations of
        the innovation along d.
    """
    if contact.direction @ d < 0.7:
        return False
    innovation = (p - contact.mean) @ d
    S = d @ contact.covariance @ d + std_along**2
    return bool(abs(innovation) <= gate * np.sqrt(S))


# The region of anticipated contact.


def semi_axes(covariance, radius):
    """Lengths (3,) [m] of the ellipsoid's semi-axes, and its rotation (3, 3), whose
    columns are their directions; right-handed."""
    values, vectors = np.linalg.eigh(covariance)
    if np.linalg.det(vectors) < 0.0:
        vectors = vectors * [1.0, 1.0, -1.0]
    return radius * np.sqrt(values), vectors


# The speed of approach.

# Standard deviations: of an impact's force, in proportion and by noise [N]; of the
# exponent b in z ~ v^b; of what the reflex is thought to take off, log(z / F), beside
# that at the desired force, in proportion.
REPEATS, FORCE_STD, BEND, BRAKED = 0.03, 0.2, 0.2, 0.5
EXPONENT_MIN = 0.3
GATE = 3.0  # Standard deviations beyond which an impact is of another surface.


def speed_by_error(speed, force_desired, force, beta) -> float:
    """The next approach speed by eq. 9, v + beta (F_d - F_m) [m/s].

    It converges while 0 < beta dF/dv < 2; CC: beta at most dv/dF. (The paper says "the
    slope of the function relating impact force to approach velocity": dv/dF, not dF/dv.
    With F in N and v in m/s the former is some 0.002, the latter some 400.)
    """
    return float(speed + beta * (force_desired - force))


def unbraked_force(force, gain=0.0, force_least=0.0):
    """The impact force [N] that an arm without a reflex would have had at the same
    speed, v sqrt(k m), of one that was `force` with it (numerics/impact_reflex.py).

    The reflex adds gain (F - force_least) to a spring's F = k x, from force_least on.
    What the two take up to the largest F is the energy m v^2 / 2, so v sqrt(k m) =
    sqrt(F^2 + gain (F - force_least)^2); delays of the reflex are not in it.
    """
    beyond = np.maximum(np.asarray(force, dtype=float) - force_least, 0.0)
    return np.sqrt(np.square(force) + gain * beyond**2)


def speed_by_regression(
    impacts, force_desired, gain=0.0, force_least=0.0, force_known=None, drift=0.01
) -> float | None:
    """The speed at which an impact has force_desired [m/s]; None without impacts.

    A Kalman filter over the impacts estimates a line, log z = a + b log v with b near 1
    (z: unbraked_force). One impact gives the speed with b = 1. The more there are, the
    less does the last one alone decide: impacts at the same speed differ by some per
    cent. One beyond GATE is of a surface that has changed; all before are forgotten.

    Args: impacts (n, 2) of [speed, peak force], oldest first; gain of the reflex and
        the force from which on it brakes, at the first impact and, force_known, at all
        later ones; None: the same; drift: standard deviation of log(z) at one speed
        from one impact to the next.
    """
    impacts = np.asarray(impacts, dtype=float).reshape(-1, 2)
    good = np.all(np.isfinite(impacts), axis=1) & np.all(impacts > 0.0, axis=1)
    if not good.any():
        return None
    known = force_least if force_known is None else force_known
    least = np.where(np.arange(len(impacts)) == 0, force_least, known)[good]
    v, F = impacts[good].T
    z = unbraked_force(F, gain, least)
    wanted = unbraked_force(force_desired, gain, known)
    off = np.log(z / F) - np.log(wanted / force_desired)
    R = REPEATS**2 + (FORCE_STD / F) ** 2 + (BRAKED * off) ** 2
    x, y = np.log(v), np.log(z)

    def begin(i):
        """The line after impact i alone: its origin, (a, b), and their covariance."""
        return x[i], np.array([y[i], 1.0]), np.diag([R[i], BEND**2])

    origin, mean, P = begin(0)
    for i in range(1, len(x)):
        P[0, 0] += drift**2
        H = np.array([1.0, x[i] - origin])
        S = H @ P @ H + R[i]
        error = y[i] - H @ mean
        if error**2 > GATE**2 * S:
            origin, mean, P = begin(i)
            continue
        K = P @ H / S
        mean, P = mean + K * error, P - np.outer(K, K) * S
    a, b = mean
    return float(np.exp(origin + (np.log(wanted) - a) / max(b, EXPONENT_MIN)))


def capped(speed, before, growth, least, most) -> float:
    """`speed`, at most `growth` times the one before, and within [least, most]."""
    return float(min(max(min(speed, growth * before), least), most))


def contact_stiffness(speed, force, mass) -> float:
    """k [N/m] of a contact whose impact at `speed` gave `force`: F = v sqrt(k m)."""
    return float((force / speed) ** 2 / mass)


def impact_speed(force, stiffness, mass) -> float:
    """The speed [m/s] at which a mass [kg] meets a spring with peak `force` [N]."""
    return float(force / np.sqrt(stiffness * mass))


# Impact-less changes, and what is near.


def place_at(times, places, time):
    """The tip's position (3,) at a past instant, and the direction (3,) in which it
    moved then, from a short history; None if the history does not reach back so far,
    or the tip did not move.

    Args: times (n,) [s], increasing; places (n, 3) [m].
    """
    if len(times) < 2 or not times[0] <= time <= times[-1]:
        return None
    p = np.array([np.interp(time, times, places[:, i]) for i in range(3)])
    window = (times >= time - 0.05) & (times <= time + 0.05)
    moved = places[window][-1] - places[window][0] if window.sum() > 1 else np.zeros(3)
    way = np.linalg.norm(moved)
    return (p, moved / way) if way > 1e-4 else None


def next_impact(contacts, kind, segment, p) -> int | None:
    """Index of the next contact of this kind in this segment: the one least far ahead
    of p (3,) along its direction; passed ones count as long as 3 sigma allow it."""
    best, nearest = None, np.inf
    for i, contact in enumerate(contacts):
        if contact.kind != kind or contact.segment != segment:
            continue
        ahead = float((contact.mean - p) @ contact.direction)
        sigma = spread_along(contact.covariance, contact.direction)
        if ahead > -3.0 * sigma - 0.005 and ahead < nearest:
            best, nearest = i, ahead
    return best
