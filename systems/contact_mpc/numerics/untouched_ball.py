"""Whether a ball that nobody touches waits, and where it goes if not.

On a table that is tilted a little a rolling ball has

    dv/dt = s - c v/|v|

with the slope's acceleration s (2,) and that of the rolling resistance c. It comes to
rest, and stays there, only if |s| < c. Both are found by least squares from changes of
the estimated v over WINDOW_SEC, all of them weighted alike, in which nothing touches
the ball.
"""

from dataclasses import dataclass, field, replace

import numpy as np

LEAVE_SEC = 0.15  # From the end of a push until the tip has left the ball.
WINDOW_SEC = 0.15
CLEAR_SEC = 0.05  # A window counts if nothing has touched the ball so long after it.
STILL = 0.005  # A slower ball has no direction [m/s].
STILL_LEAST = 4  # Windows in which a ball was still: it waits.
STEEP = 0.25  # More than a slope of 2 deg: the ball was touched, or not seen [m/s2].
COAST_MAX = 1.0  # The first approach, and a search, take longer: no example [s].
PRIOR = 0.5  # Weight of s = c = 0, in windows.
WINDOWS_LEAST = 12  # With fewer nothing is known.
# Less is not told from a level table: 0.16 deg, 5 mm in 0.7 s [m/s2].
SLOPE_MIN = 0.02
# A ball is left alone only if the slope is less than this share of the resistance: both
# are found to a third, and the error of a ball that is left wrongly is 60 mm.
WAITING_SHARE = 0.5


def _zeros(*shape):
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class UntouchedBall:
    """What is known of s and c. Nothing writes to the arrays."""

    normal: np.ndarray = _zeros(3, 3)  # Sum of A'A, A = [I, -v/|v|].
    moment: np.ndarray = _zeros(3)  # Sum of A' dv/dt [m/s2].
    windows: int = 0
    still: int = 0  # Windows in which it did not roll.
    left: float = np.nan  # When the last push ended [s]; nan: the ball is pushed.
    coast_sec: float = 0.0  # From one push to the next, the last time [s].
    since: float = np.nan  # Start of the window that runs [s]; nan: none does.
    v_since: np.ndarray = _zeros(2)  # The velocity then [m/s],
    v_until: np.ndarray | None = None  # and at its end; None: it is not over.

    def __deepcopy__(self, _):  # Drake copies all state ten times in a period.
        return self


def watched(
    ball: UntouchedBall, t: float, v, pushed: bool, seen: bool
) -> UntouchedBall:
    """The memory after one estimate of the ball's velocity v (2,) [m/s] at t [s].

    Args: pushed: whether the tip pushes the ball; seen: whether v is measured.
    """
    v = np.array(v, dtype=float)
    if pushed:
        coast = t - ball.left
        if not coast <= COAST_MAX:
            coast = ball.coast_sec
        return replace(ball, left=np.nan, coast_sec=coast, since=np.nan)
    if np.isnan(ball.left):
        ball = replace(ball, left=t)
    if not seen or not np.all(np.isfinite(v)) or t - ball.left < LEAVE_SEC:
        return replace(ball, since=np.nan)
    if np.isnan(ball.since):
        return replace(ball, since=t, v_since=v, v_until=None)
    seconds = t - ball.since
    if ball.v_until is None and seconds > WINDOW_SEC - 1e-9:
        ball = replace(ball, v_until=v)
    if ball.v_until is None or seconds < WINDOW_SEC + CLEAR_SEC - 1e-9:
        return ball
    change = (ball.v_until - ball.v_since) / WINDOW_SEC
    mean = 0.5 * (ball.v_until + ball.v_since)
    ball = replace(ball, since=t, v_since=v, v_until=None)
    speed = float(np.sqrt(mean @ mean))
    if change @ change > STEEP**2:
        return ball
    if speed < STILL:
        return replace(ball, still=ball.still + 1)
    A = np.column_stack([np.eye(2), -mean / speed])
    return replace(
        ball,
        normal=ball.normal + A.T @ A,
        moment=ball.moment + A.T @ change,
        windows=ball.windows + 1,
    )


def slope_and_resistance(ball: UntouchedBall):
    """s (2,) and c [m/s2]."""
    found = np.linalg.solve(ball.normal + PRIOR * np.eye(3), ball.moment)
    return found[:2], float(found[2])


def downhill(ball: UntouchedBall) -> np.ndarray:
    """s (2,) [m/s2] of a ball that may not wait; zero of one that does: then s is less
    than WAITING_SHARE of the resistance or than SLOPE_MIN, or not known yet."""
    if ball.windows < WINDOWS_LEAST:
        return np.zeros(2)
    slope, resistance = slope_and_resistance(ball)
    steep = np.sqrt(slope @ slope) >= max(WAITING_SHARE * resistance, SLOPE_MIN)
    return slope if steep else np.zeros(2)


def waits(ball: UntouchedBall) -> bool:
    """Whether a ball is known to stay where it is left: it has, or the slope is known
    and too small to move it."""
    if ball.windows < WINDOWS_LEAST:
        return ball.still >= STILL_LEAST
    return not np.any(downhill(ball))
