"""The pose of an object a moment ago, from readings before and after that moment.

What is known of a moving object now is late: a filter needs some readings to believe
that it moves. A moment ago can be known without such a lag: a parabola through the
readings around it has no bias for any steady acceleration.
"""

import numpy as np

from makebreak.systems.perception.numerics.pose_filter import turn_between, turned

READINGS_MIN = 5  # A parabola has three numbers; two more average the noise.


def pose_at(t, readings, half_width):
    """Least squares of a parabola in time, of position and of turn.

    Args:
        t: when [s]; readings: (time [s], p (3,) [m], q (4,) [w x y z]) in the order of
            time; half_width: those within it of t count [s].
    Returns: p, v, q, w (PoseEstimate); None with fewer than READINGS_MIN of them, or
        with none on either side of t.
    """
    near = [one for one in readings if abs(one[0] - t) <= half_width + 1e-9]
    if len(near) < READINGS_MIN or not near[0][0] <= t <= near[-1][0]:
        return None
    tau = np.array([one[0] - t for one in near])
    middle = near[int(np.argmin(np.abs(tau)))][2]
    values = np.array([
        np.concatenate([p, turn_between(middle, q)]) for _, p, q in near
    ])  # fmt: skip
    if not np.isfinite(values).all():
        return None
    powers = np.stack([np.ones_like(tau), tau, tau**2], axis=1)
    now, rate, _ = np.linalg.lstsq(powers, values, rcond=None)[0]
    return now[:3], rate[:3], turned(middle, now[3:]), rate[3:]
