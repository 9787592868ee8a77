"""From one reference to another without a step."""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step

# A blend: the weight at its start, the weight that it goes to, when it starts [s].
N_BLEND = 3


@numba.njit(cache=True)
def weight(blend, t, duration_sec):
    """Weight of the second reference at time t, and its two derivatives [1/s], [1/s2].

    Args: blend (N_BLEND,).
    """
    S, slope, bend = unit_step((t - blend[2]) / duration_sec)
    change = blend[1] - blend[0]
    return (
        blend[0] + change * S,
        change * slope / duration_sec,
        change * bend / duration_sec**2,
    )


@numba.njit(cache=True)
def blended_reference(first, second, w, w1, w2):
    """x_desired (19,) between two, w of the second one, its derivatives w1, w2.

    Orientations are the second's while it has any weight: both are upright here.
    """
    out = first.copy() if w == 0.0 else second.copy()
    for i in range(3):
        gap = second[i] - first[i]
        gap1 = second[7 + i] - first[7 + i]
        gap2 = second[13 + i] - first[13 + i]
        out[i] = first[i] + w * gap
        out[7 + i] = first[7 + i] + w * gap1 + w1 * gap
        out[13 + i] = first[13 + i] + w * gap2 + 2.0 * w1 * gap1 + w2 * gap
    return out


def warm_up() -> None:
    """Compiles both."""
    w = weight(np.zeros(N_BLEND), 0.0, 1.0)
    blended_reference(np.zeros(19), np.zeros(19), *w)
