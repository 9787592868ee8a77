"""What the velocity shaper remembers from tick to tick, and its constants.

All fields of the memory are float64, so that Drake keeps it as a vector;
vector.view(MEMORY)[0] is its record: the same numbers, by name. Compiled code must hold
the vector for as long as the record.
"""

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import BROKEN, MADE
from makebreak.systems.changing_contact.numerics.speed_track import TRACK, start_track
from makebreak.systems.numerics.few_numbers import all_finite


class ShaperLaw(NamedTuple):
    """Constants of the shaper."""

    acceleration_max: float  # Along the path [m/s2].
    speed_min: float  # Lower approach speeds are raised to it [m/s].
    release_sec: float  # Least time in which a shift fades out; inf: it stays [s].
    sigmas: float  # Half width of a region in standard deviations,
    margin: float  # to which this is added [m],
    settle_sec: float  # and, before an impact, v_a times this [s].
    blend_sec: float  # From the base to the transition-phase controller [s].
    search_speed: float  # Beyond the end of a path whose contact has not come [m/s].
    search_max: float  # How far beyond it the contact is searched for [m].
    go_on_unexpected: bool  # Whether the motion goes on after an unexpected contact.
    period: float  # Of a tick [s].


FADES, COASTS = 4, 2  # Largest numbers of both at once.
FADE = np.dtype([("X", float, 6), ("start", float), ("duration", float)], align=True)
COAST = np.dtype([("track", TRACK), ("s_end", float)], align=True)
MEMORY = np.dtype(
    [
        ("begun", float),  # 0: not yet; 2: begun without waiting for the first time.
        ("made", float),  # Counts of the contact detector at the last tick.
        ("broken", float),
        ("enter_time", float),  # When ENTER began, before a region; -1: in none [s].
        ("settle_until", float),  # End of SETTLE [s],
        ("settle_kind", float),  # and the kind of contact that it follows.
        ("held", float),  # 1: stopped for good (HOLD).
        ("ended", float),  # 1: the motion is complete (DONE).
        ("off", float, 2),  # 1: this force direction was given up, nothing is there.
        ("bad_until", float),  # End of the pause after bad input [s].
        ("sticky", float),  # Status flags that stay until the next segment.
        ("region_kind", float),  # Of the region that ENTER or REGION is about.
        ("lost_time", float, 2),  # When a force direction lost its contact; 0: has it.
        ("lost_at", float, 2),  # Where along the direction that was [m].
        ("c", float, 6),  # Shift of the reference from the pattern [m], [rad].
        ("fades", FADE, FADES),  # Further shifts, which fade out.
        ("now", TRACK),  # Along the current segment.
        ("coasts", COAST, COASTS),  # Along segments that run out.
    ],
    align=True,
)
N_MEMORY = MEMORY.itemsize // 8


@numba.njit(cache=True)
def start(table, contact, t, speed):
    """Memory (N_MEMORY,) at the start of a pattern, at that speed [m/s]."""
    memory = np.zeros(N_MEMORY)
    m = memory.view(MEMORY)[0]
    m.begun = 1.0
    if all_finite(contact):
        m.made, m.broken = contact[MADE], contact[BROKEN]
    m.enter_time = m.settle_until = m.bad_until = -1.0
    start_track(m.now, t, 0.0, speed)
    for coast in m.coasts:
        coast.track.segment = -1.0
    return memory


def begin_anew(table, contact, t):
    """Memory (N_MEMORY,) of a pattern that begins now, at rest, whatever its times."""
    memory = start(table, contact, t, 0.0)
    memory.view(MEMORY)["begun"] = 2.0
    return memory
