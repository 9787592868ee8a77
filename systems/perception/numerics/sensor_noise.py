"""Gaussian noise that is a pure function of seed, sample number and channel.

A random generator would need a state outside of the Context, or an abstract state that
is copied at every event. A hash of (seed, sample, channel) needs none: the noise at an
instant is always the same, and a restored Context replays it.

Source: Steele, Lea, Flood, "Fast splittable pseudorandom number generators" (2014),
the mixer of SplitMix64; Box and Muller (1958).
"""

import numba
import numpy as np


@numba.njit(cache=True)
def _mix(z):
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True)
def add_noise(value, std, seed, sample):
    """value (n,) plus Gaussian noise of standard deviation std (n,).

    Args: seed, sample: integers of 0 or more.
    """
    out = np.empty(value.shape[0])
    golden = np.uint64(0x9E3779B97F4A7C15)
    base = _mix(np.uint64(seed) * golden + np.uint64(1))
    base = _mix(base ^ (np.uint64(sample) + np.uint64(1)) * golden)
    for i in range(value.shape[0]):
        a = _mix(base + np.uint64(2 * i + 1) * golden)
        b = _mix(base + np.uint64(2 * i + 2) * golden)
        # 53 bits each; the first in (0, 1], so that its logarithm is finite.
        u1 = (float(a >> np.uint64(11)) + 1.0) * 2.0**-53
        u2 = float(b >> np.uint64(11)) * 2.0**-53
        normal = np.sqrt(-2.0 * np.log(u1)) * np.cos(2.0 * np.pi * u2)
        out[i] = value[i] + std[i] * normal
    return out
