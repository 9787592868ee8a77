"""The speed along a segment, and the phase of the task, by the regions ahead."""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_regions import extent_on
from makebreak.systems.changing_contact.numerics.contact_task import (
    ENTER,
    IMPACT,
    MOVE,
    NO_CONTACT,
    REGION,
    SETTLE,
)
from makebreak.systems.changing_contact.numerics.path_geometry import (
    GOES_ON,
    IN_CONTACT,
    LENGTH,
    SPEED,
    head,
)
from makebreak.systems.changing_contact.numerics.speed_track import (
    begin_step,
    highest_speed,
    time_to_brake,
    time_until,
)

# A moving reference goes no faster for less than this [m/s], and this share of it.
LEAST_RISE, LEAST_RISE_SHARE = 1e-3, 0.02
ROUNDING = 1e-9  # Of times [s].


@numba.njit(cache=True)
def choose_speed(table, m, law, regions, t, s, allowed):
    """Begins a step of the speed if one is due: down for a region, for the end of the
    path or for a stop, or up where nothing is in the way.

    Args: s [m], where the reference is; allowed, false: it has to stop.
    """
    k = int(m.now.segment)
    v = m.now.target
    L = head(table, k, LENGTH)
    cap = head(table, k, SPEED) if allowed else 0.0
    highest, slower, when = cap, np.inf, np.inf
    search = np.inf
    if v > cap:
        slower, when = cap, t
    for r in range(int(regions.count) + 2):
        if r < regions.count:
            region = regions.rows[r]
            entry, leave = extent_on(table, region, k)
            if region.kind != IMPACT or s >= leave or entry == np.inf:
                continue
            limit = region.speed
            if leave == np.inf:
                search = min(search, limit)
        elif r == regions.count:  # The end of the path.
            entry, limit = L, 0.0
            if head(table, k, IN_CONTACT) > 0.0:
                limit = search if search < np.inf else law.search_speed
            elif head(table, k, GOES_ON) > 0.0:
                limit = head(table, k + 1, SPEED)
        else:  # The end of the search for a contact, beyond the path.
            if head(table, k, IN_CONTACT) == 0.0:
                continue
            entry, limit = L + law.search_max, 0.0
        begin = time_to_brake(m.now, law, t, entry, limit)
        if begin < np.inf and limit < slower:
            slower, when = limit, begin
        highest = min(highest, highest_speed(law, v, limit, entry - s))
    if when < np.inf:
        begin_step(m.now, law, when, slower)
    elif m.now.n_steps == 0.0:
        least = max(LEAST_RISE, LEAST_RISE_SHARE * v) if v > 0.0 else 0.0
        if highest > v + least:
            begin_step(m.now, law, t, highest)


@numba.njit(cache=True)
def stage_at(table, m, law, regions, t, s):
    """Stage and kind of the phase at arc length s, and the memory of entering."""
    k = int(m.now.segment)
    kind, entry = NO_CONTACT, np.inf
    for r in range(int(regions.count)):
        region = regions.rows[r]
        begins, leave = extent_on(table, region, k)
        if begins == np.inf or s >= leave:
            continue
        this = int(region.kind)
        inside, before = s >= begins, s >= entry
        # Of two that overlap the impact counts; else the next one.
        if (inside and before and this == IMPACT) or (
            not (inside and before) and begins < entry
        ):
            kind, entry = this, begins
    if kind != NO_CONTACT and (
        s >= entry or time_until(m.now, law, t, entry) <= law.blend_sec
    ):
        if m.enter_time < 0.0:
            m.enter_time = t
        m.region_kind = kind
        inside = s >= entry and t - m.enter_time >= law.blend_sec - ROUNDING
        return REGION if inside else ENTER, kind
    if m.enter_time >= 0.0:  # Passed through.
        m.enter_time = -1.0
        m.settle_until, m.settle_kind = t + law.blend_sec, m.region_kind
    if t < m.settle_until:
        return SETTLE, int(m.settle_kind)
    return MOVE, NO_CONTACT
