"""Where the regions of expected contacts begin and end along a pattern.

A region begins before the point where the path crosses the plane through the expected
contact, at right angles to its direction:

    s_c - (sigmas sigma + margin + v_a settle_sec)

and ends as far behind it, without the last term; the region of an impact lasts until
the contact comes. Records are of float64 alone, so that they can be a vector in a
Context.

Source: Sidhik et al., section 3.5.
"""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    IMPACT,
    NO_CONTACT,
    SPEED_FLOOR,
    ContactBelief,
)
from makebreak.systems.changing_contact.numerics.path_geometry import (
    GOES_ON,
    IN_CONTACT,
    IN_LOSS,
    KIND,
    LENGTH,
    LINE,
    add_along,
    head,
    last_parameter,
    length_to,
    path_point,
    place,
)
from makebreak.systems.numerics.few_numbers import all_finite, dot

REGIONS_MAX = 32
REGION_ROW = np.dtype(  # entry, leave: arc lengths [m]; speed inside [m/s].
    [(name, float) for name in ("segment", "kind", "entry", "leave", "speed")],
    align=True,
)
REGIONS = np.dtype(
    [("count", float), ("status", float), ("rows", REGION_ROW, REGIONS_MAX)], align=True
)
N_REGIONS = REGIONS.itemsize // 8

EXPECTED = np.dtype(  # A contact as regions_of takes it.
    [
        ("mean", float, 3),
        ("direction", float, 3),
        ("sigma", float),  # Along the direction [m].
        ("kind", float),
        ("segment", float),
        ("speed", float),  # v_a [m/s]
    ],
    align=True,
)


def expected(belief: ContactBelief) -> np.ndarray:
    """The contacts of a belief as (n,) EXPECTED."""
    rows = []
    for c in belief.contacts:
        sigma = np.sqrt(c.direction @ c.covariance @ c.direction)
        rows.append((c.mean, c.direction, sigma, c.kind, c.segment, c.approach_speed))
    return np.array(rows, dtype=EXPECTED)


@numba.njit(cache=True)
def regions_of(table, law, contacts, current, offset, later):
    """Regions (N_REGIONS,) of the expected contacts, by arc length.

    A contact that the path does not approach has no region; one that names no segment
    is left out with BAD_INPUT.

    Args: table of the pattern; law, a ShaperLaw; contacts (n,) EXPECTED; current, the
        segment that runs, -1: none; offset (3,) by which the reference on it is shifted
        from the pattern now, later (3,) and in the end [m].
    """
    regions = np.zeros(N_REGIONS)
    out = regions.view(REGIONS)[0]
    count, status = 0, 0
    for c in contacts:
        k = int(c.segment)
        known = all_finite(c.mean) and all_finite(c.direction)
        known = known and all_finite((c.sigma, c.kind, c.segment))
        if not (known and 0 <= k < table[0]) or c.kind == NO_CONTACT:
            status |= BAD_INPUT
            continue
        if count == REGIONS_MAX:
            status |= BAD_INPUT
            break
        speed = c.speed
        if c.kind == IMPACT and not speed >= law.speed_min:
            speed = law.speed_min
            status |= SPEED_FLOOR
        speed = min(speed, 10.0)
        half = law.sigmas * c.sigma + law.margin
        before = half
        if c.kind == IMPACT:
            before += speed * law.settle_sec
        d = c.direction
        shift = 0.0
        if k == current:  # The nearer of what it is now and what it will be.
            shift = max(dot(offset, d), dot(later, d))
        entry, leave = _crossing(table, law, k, c.mean, d, shift, before, half)
        if entry == np.inf:
            continue
        region = out.rows[count]
        region.segment, region.kind = k, c.kind
        region.entry, region.leave, region.speed = entry, leave, speed
        count += 1
    out.count, out.status = count, status
    return regions


@numba.njit(cache=True)
def extent_on(table, region, k):
    """Entry and exit of a region in arc lengths of segment k [m]; inf, inf: it has none
    there. A region of the next segment counts if that one follows without a stop."""
    segment = int(region.segment)
    shift = 0.0
    if segment == k + 1 and k + 1 < table[0]:
        flows = head(table, k, GOES_ON) > 0.0 and head(table, k, IN_LOSS) == 0.0
        if not flows:
            return np.inf, np.inf
        shift = head(table, k, LENGTH)
    elif segment != k:
        return np.inf, np.inf
    leave = region.leave + shift
    if region.kind == IMPACT and head(table, segment, IN_CONTACT) > 0.0:
        leave = np.inf  # Until the contact comes.
    return region.entry + shift, leave


@numba.njit(cache=True)
def _gap(p, mean, d, shift):
    """How far p is beyond the plane through mean with normal d [m]."""
    return dot(p, d) - dot(mean, d) + shift


@numba.njit(cache=True)
def _crossing(table, law, k, mean, d, shift, before, after):
    """Arc lengths at which the path is `before` in front of the plane through mean
    with normal d, and `after` behind it; inf, inf where it does not cross it."""
    if head(table, k, KIND) == LINE:
        start = path_point(table, k, 0.0)
        slope = dot(start[1], d)
        if slope < 0.05:
            return np.inf, np.inf
        s = -_gap(start[0], mean, d, shift) / slope
        return s - before / slope, s + after / slope
    n = 256
    width = (last_parameter(table, k) + law.search_max) / n
    values = np.empty(n + 1)
    best, nearest = -1, np.inf
    for i in range(n + 1):
        p = place(table, k, i * width)
        values[i] = _gap(p, mean, d, shift)
        if i > 0 and values[i - 1] < 0.0 <= values[i]:
            add_along(p, mean, -1.0)
            add_along(p, d, -dot(p, d))
            across = dot(p, p)
            if across < nearest:
                best, nearest = i, across
    if best < 0:
        return np.inf, np.inf
    entry, leave = -1.0, np.inf
    for i in range(best, 0, -1):
        if values[i - 1] <= -before < values[i]:
            entry = _root(table, k, mean, d, shift + before, i * width, width)
            break
    for i in range(best, n + 1):
        if values[i - 1] < after <= values[i]:
            leave = _root(table, k, mean, d, shift - after, i * width, width)
            break
    return entry, leave


@numba.njit(cache=True)
def _root(table, k, mean, d, shift, high, width):
    """The arc length at which the path crosses the plane, at a parameter (of `place`)
    from `width` below `high` to it."""
    low = high - width
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _gap(place(table, k, middle), mean, d, shift) < 0.0:
            low = middle
        else:
            high = middle
    return length_to(table, k, high)
