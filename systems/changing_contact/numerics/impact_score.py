"""Scores of a contact change, from signals logged at a fixed rate.

F100: force along the motion, through a 100 Hz filter, less its value before the
contact. a10: norm of the tip's acceleration through a 10 Hz filter. Both filters are
causal Butterworth filters of second order. The raw peaks stand beside them: a number
without its filter says little about an impact.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi

FORCE_CUTOFF, ACCELERATION_CUTOFF = 100.0, 10.0  # [Hz]
BEFORE_SEC, GAP_SEC = 0.05, 0.02  # The value before: this long, up to so long before.
AFTER_SEC = 0.15  # An impact is over by then.


def low_pass(signal, cutoff, dt):
    """Causal second-order Butterworth filter, at rest on the first sample.

    Args: signal (n,) or (n, k); cutoff [Hz]; dt between samples [s].
    Returns: the same shape.
    Raises: ValueError for a cutoff that is not below half the sampling rate.
    """
    if not 0.0 < cutoff < 0.5 / dt:
        raise ValueError(f"cutoff is {cutoff} Hz, expected between 0 and {0.5 / dt} Hz")
    signal = np.asarray(signal, dtype=float)
    columns = signal.reshape(len(signal), -1)
    sos = butter(2, cutoff, fs=1.0 / dt, output="sos")
    start = sosfilt_zi(sos)[:, :, None] * columns[0]
    return sosfilt(sos, columns, axis=0, zi=start)[0].reshape(signal.shape)


class Impact(NamedTuple):
    peak: float  # F100 [N].
    peak_raw: float  # The same without the filter [N].
    time: float  # Of the peak of F100 [s].
    a10: float  # Peak of the acceleration around it, 10 Hz [m/s2].
    a_raw: float  # And without the filter [m/s2].


def impact(time, force, velocity, direction, contact_time) -> Impact:
    """What one contact did.

    Args:
        time: (n,) equally spaced [s].
        force: (n, 3) on the tool [N].
        velocity: (n, 3) of the tip [m/s].
        direction: (3,) of the motion into the contact, a unit vector.
        contact_time: of the first touch [s].
    Raises: ValueError if the contact is not inside the log, with 70 ms before it.
    """
    dt = (time[-1] - time[0]) / (len(time) - 1)
    begin = contact_time - GAP_SEC - BEFORE_SEC
    if not time[0] <= begin or not contact_time <= time[-1]:
        raise ValueError(
            f"contact_time is {contact_time} s, expected {BEFORE_SEC + GAP_SEC} s or "
            f"more after {time[0]} s and before {time[-1]} s"
        )
    along = -np.asarray(force) @ direction
    smooth = low_pass(along, FORCE_CUTOFF, dt)
    before = (time >= begin) & (time < contact_time - GAP_SEC)
    window = (time >= contact_time - GAP_SEC) & (time <= contact_time + AFTER_SEC)
    base = float(np.mean(along[before]))
    a = np.gradient(np.asarray(velocity), dt, axis=0)
    a_smooth = low_pass(a, ACCELERATION_CUTOFF, dt)
    at = np.flatnonzero(window)
    k = at[np.argmax(smooth[at])]
    return Impact(
        peak=float(smooth[k] - base),
        peak_raw=float(along[at].max() - base),
        time=float(time[k]),
        a10=float(np.linalg.norm(a_smooth[at], axis=1).max()),
        a_raw=float(np.linalg.norm(a[at], axis=1).max()),
    )
