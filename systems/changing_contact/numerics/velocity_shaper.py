"""Re-times a motion pattern: slow where a contact is expected, as planned elsewhere.

The reference at time t is

    X(t) = path_k(s(t)) + c + fading terms,      X = [p, r] as in path_geometry

s(t) is the arc length along segment k, whose speed changes in smooth steps
(speed_track.py). Decisions depend on arc length alone. A step down to v_a begins,
between two ticks, so that it ends at the entry of the region of the expected contact
(contact_regions.py). Inside, the speed is v_a until the contact comes.

When the contact comes, the next segment begins at once, from the reference as it is.
The motion of the old segment runs out (a step to speed 0; it lies along a direction
that is force-controlled now), and the constant c is the difference between reference
and pattern. Where a force direction is dropped, the reference first goes to the
measured position along it. So the pattern is shifted by the measured positions of its
contacts. The shift stays, or fades with 1 - S over release_sec; along force directions
it stays, because there the contact decides.

Source: Sidhik et al., section 3.5.2.
"""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.approach_speed import (
    choose_speed,
    stage_at,
)
from makebreak.systems.changing_contact.numerics.contact_regions import (
    EXPECTED,
    N_REGIONS,
    REGIONS,
    regions_of,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    CONTACT_MISSING,
    DONE,
    HOLD,
    IMPACT,
    N_CONTACT,
    N_PHASE,
    NO_CONTACT,
    PHASE_KIND,
    PHASE_LENGTH,
    PHASE_SEGMENT,
    PHASE_SPEED,
    PHASE_STAGE,
    PHASE_STATUS,
    REGION_COVERS_PATH,
    STATUS,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern
from makebreak.systems.changing_contact.numerics.path_geometry import (
    GOES_ON,
    IN_CONTACT,
    IN_LOSS,
    LENGTH,
    N_FORCE,
    SPEED,
    START,
    TARGETS,
    add_along,
    force_direction,
    head,
    path_point,
)
from makebreak.systems.changing_contact.numerics.segment_change import (
    change_segment,
    go_on,
    handle_events,
    watch_lost,
)
from makebreak.systems.changing_contact.numerics.shaped_reference import (
    BEND_MAX,
    blended,
    pose_output,
    reference,
)
from makebreak.systems.changing_contact.numerics.shaper_memory import (
    MEMORY,
    N_MEMORY,
    ShaperLaw,
    start,
)
from makebreak.systems.changing_contact.numerics.speed_track import (
    absorb_ended_steps,
    motion_at,
    start_track,
)
from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step
from makebreak.systems.numerics.few_numbers import all_finite, dot

BAD_SEC = 0.1  # Length of a pause after the last bad sample [s].
LOOKED_AT = 256  # Points of a path among which the nearest is looked for.
AT_REST = 1e-6  # Slower has no direction [m/s].
# Of a search for a contact: beyond this share of it, at rest, the contact is missing.
SEARCHED = 0.5
NEAR = 1e-3  # A segment that comes to rest so near to its end has ended [m].


@numba.njit(cache=True)
def tick(table, law, regions, memory, t, contact, pose):
    """One tick, which changes the memory in place.

    Args: table of the pattern; law; regions (N_REGIONS,) as plan gives them; memory of
        the last tick (zeros: none yet); t [s]; contact (14,); pose (7,)
        measured: anything may be NaN.
    Returns: X, dX/dt, d2X/dt2 (3, 6); tangent (3,), zero at rest; force
        directions (6,); force targets (2,); phase (6,).
    """
    if memory.view(MEMORY)[0].begun == 0.0:
        memory[:] = start(table, contact, t, 0.0)
    m, regions = memory.view(MEMORY)[0], regions.view(REGIONS)[0]
    _absorb_steps(m, t)
    if all_finite(contact):
        handle_events(table, m, law, t, contact, pose)
    watch_lost(table, m, t, pose)
    if not (all_finite(contact) and contact[STATUS] == 0.0):
        m.bad_until = t + BAD_SEC
    bad = t < m.bad_until
    _end_segment(table, m, law, t, pose)

    s = motion_at(m.now, t)[0]
    started = t >= head(table, 0, START) or m.begun > 1.0
    allowed = started and not bad and m.held == 0.0 and m.ended == 0.0
    if m.held == 0.0 and not bad and _is_missing(table, m, law, s):
        m.held = 1.0
        m.sticky = float(int(m.sticky) | CONTACT_MISSING)
        allowed = False
    if m.ended == 0.0:
        choose_speed(table, m, law, regions, t, s, allowed)
    stage, kind = stage_at(table, m, law, regions, t, s)
    if m.ended > 0.0:
        stage, kind = DONE, NO_CONTACT
    elif m.held > 0.0 or bad:
        stage = HOLD

    X, s, v, along = reference(table, m, t)
    k = int(m.now.segment)
    tangent = np.zeros(3)
    if v > AT_REST or m.now.target > 0.0:
        tangent[:] = along[:3]
    directions, targets = np.zeros(6), np.zeros(2)
    for row in range(int(head(table, k, N_FORCE))):
        if m.off[row] == 0.0:
            directions[3 * row : 3 * row + 3] = force_direction(table, k, row)
            targets[row] = head(table, k, TARGETS + row)
    phase = np.zeros(N_PHASE)
    phase[PHASE_SEGMENT], phase[PHASE_STAGE], phase[PHASE_KIND] = k, stage, kind
    phase[PHASE_SPEED], phase[PHASE_LENGTH] = v, s
    phase[PHASE_STATUS] = _status(m, regions, bad)
    return X, tangent, directions, targets, phase


@numba.njit(cache=True)
def _absorb_steps(m, t):
    """Steps of the speed that have ended, and segments that have run out, in place."""
    for coast in m.coasts:
        track = coast.track
        if track.segment >= 0.0:
            absorb_ended_steps(track, t)
            if track.n_steps == 0.0:
                track.segment = -1.0
    absorb_ended_steps(m.now, t)


@numba.njit(cache=True)
def _end_segment(table, m, law, t, pose):
    """Ends a segment that ends in no contact, where its end is reached, in place."""
    k = int(m.now.segment)
    if m.held > 0.0 or m.ended > 0.0 or head(table, k, IN_CONTACT) > 0.0:
        return
    s, L = motion_at(m.now, t)[0], head(table, k, LENGTH)
    at_rest = m.now.target == 0.0 and m.now.n_steps == 0.0
    if head(table, k, GOES_ON) > 0.0:
        if s >= L + law.search_max * head(table, k, IN_LOSS):
            X, _, _, _ = reference(table, m, t)
            go_on(table, m, law, t, pose, X[0])
    elif at_rest and s >= L - NEAR:
        if k + 1 >= table[0]:  # The last one.
            m.ended = 1.0
        else:
            X, _, _, _ = reference(table, m, t)
            change_segment(table, m, law, t, pose, X[0], s, 0.0)
            start_track(m.now, t, k + 1.0, 0.0)


@numba.njit(cache=True)
def _is_missing(table, m, law, s):
    """Whether the contact in which this segment ends was looked for in vain."""
    k = int(m.now.segment)
    return (
        head(table, k, IN_CONTACT) > 0.0
        and m.now.target == 0.0
        and s > head(table, k, LENGTH) + SEARCHED * law.search_max
    )


@numba.njit(cache=True)
def _status(m, regions, bad):
    """The flags of the phase."""
    status = int(m.sticky) | int(regions.status)
    if bad:
        status |= BAD_INPUT
    if m.off[0] > 0.0 or m.off[1] > 0.0:
        status |= CONTACT_MISSING
    for r in range(int(regions.count)):
        region = regions.rows[r]
        here = region.segment == m.now.segment
        if region.kind == IMPACT and here and region.entry <= 0.0:
            status |= REGION_COVERS_PATH
    return status


@numba.njit(cache=True)
def take_over(table, law, contact, t, old_table, old_memory):
    """Another pattern takes over: from the point of its first segment that is nearest
    to the reference, at the speed that the reference has along it.

    Returns: its memory, and how long the blend from the old one takes [s]: blend_sec,
        or longer, so that what the blend adds stays about within a_max.
    """
    X, _, _, _ = reference(old_table, old_memory.view(MEMORY)[0], t)
    L, n = head(table, 0, LENGTH), LOOKED_AT
    s, nearest = 0.0, np.inf
    for i in range(n + 1):
        D = path_point(table, 0, L * i / n)
        add_along(D[0], X[0], -1.0)
        square = dot(D[0], D[0])
        if square < nearest:  # To first order in the rest along the path.
            s, nearest = L * i / n - dot(D[0], D[1]), square
    s = min(max(s, 0.0), L)
    D = path_point(table, 0, s)
    speed = min(max(dot(X[1], D[1]), 0.0), head(table, 0, SPEED))
    memory = start(table, contact, t, speed)
    m = memory.view(MEMORY)[0]
    m.begun, m.now.s0 = 2.0, s
    gap, dv = 0.0, 0.0
    for i in range(6):
        gap += (X[0, i] - D[0, i]) ** 2
        dv += (X[1, i] - speed * D[1, i]) ** 2
    T = np.sqrt(2.0 * BEND_MAX * np.sqrt(gap) / law.acceleration_max)
    # The gap grows by dv t: S'' dv t and 2 S' dv add up to about 6 dv / T.
    return memory, max(law.blend_sec, T, 6.0 * np.sqrt(dv) / law.acceleration_max)


@numba.njit(cache=True)
def plan(table, law, memory, t, contacts):
    """Regions (N_REGIONS,) of the expected contacts (n,) EXPECTED at time t [s]; the
    memory of the last tick says by what the running segment is shifted."""
    m = memory.view(MEMORY)[0]
    current, offset, later = -1, np.zeros(3), np.zeros(3)
    if m.begun > 0.0:
        current = int(m.now.segment)
        later[:] = m.c[:3]
        offset[:] = later
        for fade in m.fades:
            if fade.duration > 0.0:
                left = 1.0 - unit_step((t - fade.start) / fade.duration)[0]
                add_along(offset, fade.X, left)
    return regions_of(table, law, contacts, current, offset, later)


def warm_up(pattern: MotionPattern, law: ShaperLaw) -> None:
    """Compiles all of it, for arrays as a Context's: what is only read is read-only."""
    memory, regions = np.zeros(N_MEMORY), np.zeros(N_REGIONS)
    contact, pose = np.zeros(N_CONTACT), np.zeros(7)
    regions.setflags(write=False)
    X, *_ = tick(pattern.table, law, regions, memory, 0.0, contact, pose)
    memory.setflags(write=False)
    pose_output(blended(X, X, 0.0, 1.0), pattern.base)
    plan(pattern.table, law, memory, 0.0, np.zeros(0, EXPECTED))
    take_over(pattern.table, law, contact, 0.0, pattern.table, memory)
