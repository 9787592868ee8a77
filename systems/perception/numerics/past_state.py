"""The pose of an object at a past time, from readings before and after that time.

A filter's estimate of the present pose lags, because it needs some readings to follow a
change of velocity. A parabola through the readings around a past time has no lag, and
no bias for a constant acceleration.

It is linear in what is read, and so is an equation of motion: whatever stands in one
with the object's velocity has to go through the same parabola.
"""

import numpy as np

from makebreak.systems.perception.numerics.pose_filter import turn_between, turned

READINGS_MIN = 5  # Three determine a parabola; two more average the noise.


def pose_at(t, readings, half_width, beside=None):
    """Pose and velocity at time t [s], by a least-squares parabola in time through
    positions and turns.

    Args:
        readings: (time [s], p (3,) [m], q (4,) [w x y z]), in order of time.
        half_width: readings within this time of t are used [s].
        beside: times (n,) and values (n, k) of something else, of which the parabola
            goes through what it was at the times of the readings; None: nothing.
    Returns: p, v, q, w (PoseEstimate), and values (k,) and rates (k,) of what is
        beside; None with fewer than READINGS_MIN readings, or unless there are some on
        both sides of t, or if what is beside does not reach as far as they do.
    """
    near = [one for one in readings if abs(one[0] - t) <= half_width + 1e-9]
    if len(near) < READINGS_MIN or not near[0][0] <= t <= near[-1][0]:
        return None
    at = np.array([one[0] for one in near])
    tau = at - t
    middle = near[int(np.argmin(np.abs(tau)))][2]
    values = np.array([
        np.concatenate([p, turn_between(middle, q)]) for _, p, q in near
    ])  # fmt: skip
    if beside is not None:
        times, others = np.asarray(beside[0]), np.asarray(beside[1])
        if not (len(times) and times[0] <= at[0] and at[-1] <= times[-1]):
            return None
        more = [np.interp(at, times, other) for other in others.T]
        values = np.hstack([values, np.transpose(more)])
    if not np.isfinite(values).all():
        return None
    powers = np.stack([np.ones_like(tau), tau, tau**2], axis=1)
    now, rate, _ = np.linalg.lstsq(powers, values, rcond=None)[0]
    pose = now[:3], rate[:3], turned(middle, now[3:6]), rate[3:6]
    return *pose, now[6:], rate[6:]
