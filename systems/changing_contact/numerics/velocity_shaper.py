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

from typing import NamedTuple

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_regions import (
    EXPECTED,
    N_REGIONS,
    REGIONS,
    extent_on,
    regions_of,
)
from makebreak.systems.changing_contact.numerics.contact_task import (
    BAD_INPUT,
    BROKEN,
    BROKEN_ROW,
    CONTACT_MISSING,
    CONTACT_UNEXPECTED,
    DIRECTION,
    DONE,
    ENTER,
    HOLD,
    IMPACT,
    MADE,
    MOVE,
    N_CONTACT,
    N_PHASE,
    NO_CONTACT,
    PHASE_KIND,
    PHASE_LENGTH,
    PHASE_SEGMENT,
    PHASE_SPEED,
    PHASE_STAGE,
    PHASE_STATUS,
    REGION,
    REGION_COVERS_PATH,
    SETTLE,
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
    all_finite,
    dot,
    force_direction,
    head,
    path_point,
    rotation_motion,
)
from makebreak.systems.changing_contact.numerics.speed_track import (
    N_STEPS,
    TRACK,
    absorb_ended_steps,
    begin_step,
    highest_speed,
    motion_at,
    start_track,
    steady_from,
    time_to_brake,
    time_until,
)
from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step

BAD_SEC = 0.1  # Length of a pause after the last bad sample [s].
# After a contact was lost, force control presses on. If the tip then moves by LOST_WAY
# within LOST_SEC, there is no surface: force control closes gaps at 12 mm/s or more.
LOST_WAY, LOST_SEC = 0.005, 1.0  # [m], [s]
NEAR = 1e-3  # A segment that comes to rest so near to its end has ended [m].
BEND_MAX = 9.85  # Largest value of S''.
TURN_BACK_SEC = 1.0  # Fading time of an orientation where positions stay shifted [s].


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


# The memory. All fields are float64, so that Drake keeps it as a vector;
# vector.view(MEMORY)[0] is its record: the same numbers, by name. Compiled code must
# hold the vector for as long as the record.

_FADES, _COASTS = 4, 2  # Largest numbers of both at once.
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
        (
            "lost_time",
            float,
            2,
        ),  # When each force direction lost its contact; 0: has it.
        ("lost_at", float, 2),  # Where along the direction that was [m].
        ("c", float, 6),  # Shift of the reference from the pattern [m], [rad].
        ("fades", FADE, _FADES),  # Further shifts, which fade out.
        ("now", TRACK),  # Along the current segment.
        ("coasts", COAST, _COASTS),  # Along segments that run out.
    ],
    align=True,
)
N_MEMORY = MEMORY.itemsize // 8


@numba.njit(cache=True)
def _reference(table, m, t):
    """X and its two time derivatives (3, 6) at time t, and s, v along the path."""
    out = np.zeros((3, 6))
    s, v, a = motion_at(m.now, t)
    D = path_point(table, int(m.now.segment), s)
    for i in range(6):
        out[0, i] = m.c[i] + D[0, i]
        out[1, i] = D[1, i] * v
        out[2, i] = D[2, i] * v * v + D[1, i] * a
    for coast in m.coasts:
        if coast.track.segment < 0.0:
            continue
        k = int(coast.track.segment)
        s_c, v_c, a_c = motion_at(coast.track, t)
        D = path_point(table, k, s_c)
        end = path_point(table, k, coast.s_end)
        for i in range(6):
            out[0, i] += D[0, i] - end[0, i]
            out[1, i] += D[1, i] * v_c
            out[2, i] += D[2, i] * v_c * v_c + D[1, i] * a_c
    for fade in m.fades:
        T = fade.duration
        if T > 0.0:
            S, slope, bend = unit_step((t - fade.start) / T)
            for i in range(6):
                out[0, i] += fade.X[i] * (1.0 - S)
                out[1, i] -= fade.X[i] * slope / T
                out[2, i] -= fade.X[i] * bend / (T * T)
    return out, s, v


@numba.njit(cache=True)
def _fade_out(m, law, t, X):
    """Adds a shift X (6,) that is whole at time t and fades out, to the memory m."""
    size, turn = np.sqrt(dot(X, X)), np.sqrt(dot(X[3:], X[3:]))
    if size == 0.0 and turn == 0.0:
        return
    slot, oldest = -1, 0
    for f in range(_FADES):
        fade = m.fades[f]
        if fade.duration <= 0.0 or t >= fade.start + fade.duration:
            slot = f
        elif fade.start < m.fades[oldest].start:
            oldest = f
    if slot < 0:  # What is left of the oldest one fades out with the new one.
        slot = oldest
        fade = m.fades[slot]
        left = 1.0 - unit_step((t - fade.start) / fade.duration)[0]
        for i in range(6):
            X[i] += left * fade.X[i]
    fade = m.fades[slot]
    # Its acceleration is at most half of what the path may have; 1 rad counts as 1 m.
    T = np.sqrt(2.0 * BEND_MAX * max(size, turn) / law.acceleration_max)
    for i in range(6):
        fade.X[i] = X[i]
    least = law.release_sec if law.release_sec < np.inf else TURN_BACK_SEC
    fade.start, fade.duration = t, max(least, T)


@numba.njit(cache=True)
def _has_direction(table, k, n):
    """Whether segment k has the force direction n (3,)."""
    for row in range(int(head(table, k, N_FORCE))):
        if dot(force_direction(table, k, row), n) > 1.0 - 1e-6:
            return True
    return False


@numba.njit(cache=True)
def _change_segment(table, m, law, t, pose, X, s_end, s_start):
    """Changes from the current segment, which ends at s_end, to the next, at s_start.
    The reference jumps only along force directions that are dropped.

    Args: X (6,) the reference now; pose (7,) measured. The caller sets the track.
    """
    k = int(m.now.segment)
    end, start = path_point(table, k, s_end), path_point(table, k + 1, s_start)
    C = np.empty(6)
    for i in range(6):
        C[i] = m.c[i] + end[0, i] - start[0, i]
    if all_finite(pose):
        for row in range(int(head(table, k, N_FORCE))):
            n = force_direction(table, k, row)
            if m.off[row] == 0.0 and not _has_direction(table, k + 1, n):
                add_along(C, n, dot(n, pose) - dot(n, X))
    kept = np.zeros(6)
    rows = int(head(table, k + 1, N_FORCE))
    if law.release_sec == np.inf:
        kept[:3] = C[:3]
    elif rows > 0:  # What lies along the new force directions stays.
        n1 = force_direction(table, k + 1, 0)
        add_along(kept, n1, dot(n1, C))
        if rows > 1:
            n2 = force_direction(table, k + 1, 1).copy()
            add_along(n2, n1, -dot(n1, n2))
            add_along(kept, n2, dot(n2, C) / dot(n2, n2))
    for i in range(6):
        m.c[i] = kept[i]
        C[i] -= kept[i]
    _fade_out(m, law, t, C)
    m.now.segment = k + 1.0
    for row in range(2):
        m.off[row] = m.lost_time[row] = 0.0
    m.sticky = 0.0
    m.enter_time, m.region_kind = -1.0, NO_CONTACT


@numba.njit(cache=True)
def _after_contact(table, m, law, t, pose, X):
    """After the contact that ends this segment: it runs out, the next one starts."""
    slot, first = 0, np.inf
    for c in range(_COASTS):
        track = m.coasts[c].track
        ends = -1.0 if track.segment < 0.0 else steady_from(track, t)
        if ends < first:
            slot, first = c, ends
    coast = m.coasts[slot]
    coast.track = m.now
    track = coast.track
    if track.n_steps == N_STEPS:  # Too many to add one: it stops now.
        track.n_steps = 0.0
        track.v0, track.target = 0.0, 0.0
        track.s0, track.t0 = motion_at(m.now, t)[0], t
    begin_step(track, law, t, 0.0)
    coast.s_end = motion_at(track, steady_from(track, t))[0]
    _change_segment(table, m, law, t, pose, X, coast.s_end, 0.0)
    start_track(m.now, t, m.now.segment, 0.0)
    m.settle_until, m.settle_kind = t + law.blend_sec, IMPACT


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


@numba.njit(cache=True)
def _choose_speed(table, m, law, regions, t, s, allowed):
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
    elif m.now.n_steps == 0.0 and highest > v + (max(1e-3, 0.02 * v) if v > 0 else 0.0):
        begin_step(m.now, law, t, highest)


@numba.njit(cache=True)
def _stage(table, m, law, regions, t, s):
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
        inside = s >= entry and t - m.enter_time >= law.blend_sec - 1e-9
        return REGION if inside else ENTER, kind
    if m.enter_time >= 0.0:  # Passed through.
        m.enter_time = -1.0
        m.settle_until, m.settle_kind = t + law.blend_sec, m.region_kind
    if t < m.settle_until:
        return SETTLE, int(m.settle_kind)
    return MOVE, NO_CONTACT


@numba.njit(cache=True)
def _events(table, m, law, t, contact, pose):
    """Handles what the contact detector has reported since the last tick."""
    made = contact[MADE] > m.made
    broken = contact[BROKEN] > m.broken
    m.made, m.broken = contact[MADE], contact[BROKEN]
    if m.held > 0.0 or m.ended > 0.0 or not (made or broken):
        return
    k = int(m.now.segment)
    X, s, _ = _reference(table, m, t)
    if made:
        tangent = path_point(table, k, s)[1, :3]
        aligned = dot(contact[DIRECTION], tangent) > 0.5  # Else an echo of the last.
        if aligned and head(table, k, IN_CONTACT) > 0.0:
            _after_contact(table, m, law, t, pose, X[0])
            return
        if m.off[0] > 0.0 or m.off[1] > 0.0:  # A contact that was given up is back.
            m.off[0] = m.off[1] = 0.0
        elif m.lost_time[0] > 0.0 or m.lost_time[1] > 0.0:  # One just lost is back.
            pass
        elif aligned:
            m.sticky = float(int(m.sticky) | CONTACT_UNEXPECTED)
            if not law.go_on_unexpected:
                m.held = 1.0
    row = int(contact[BROKEN_ROW])
    if broken and 0 <= row < head(table, k, N_FORCE) and t >= m.settle_until:
        if head(table, k, IN_LOSS) > 0.0:
            _go_on(table, m, law, t, pose, X[0], s)
        elif m.off[row] == 0.0 and all_finite(pose):
            m.lost_time[row], m.lost_at[row] = (
                t,
                dot(force_direction(table, k, row), pose),
            )


@numba.njit(cache=True)
def _watch_lost(table, m, t, pose):
    """Gives up a contact that was lost and not found again: its direction is position-
    controlled where the tip is, until a contact is felt."""
    k = int(m.now.segment)
    for row in range(int(head(table, k, N_FORCE))):
        if m.lost_time[row] == 0.0 or not all_finite(pose):
            continue
        n = force_direction(table, k, row)
        if t > m.lost_time[row] + LOST_SEC:
            m.lost_time[row] = 0.0
        elif dot(n, pose) - m.lost_at[row] > LOST_WAY:
            m.lost_time[row], m.off[row] = 0.0, 1.0
            X, _, _ = _reference(table, m, t)
            add_along(m.c, n, dot(n, pose) - dot(n, X[0]))


@numba.njit(cache=True)
def _go_on(table, m, law, t, pose, X, s):
    """Changes to the next segment on the same line, without a stop."""
    L = head(table, int(m.now.segment), LENGTH)
    _change_segment(table, m, law, t, pose, X, L, 0.0)
    m.now.s0 -= L


@numba.njit(cache=True)
def tick(table, law, regions, memory, t, contact, pose):
    """One tick.

    Args: table of the pattern; law; regions (N_REGIONS,) as plan gives them; memory of
        the last tick (zeros: none yet); t [s]; contact (14,); pose (7,)
        measured: anything may be NaN.
    Returns: memory; X, dX/dt, d2X/dt2 (3, 6); tangent (3,), zero at rest; force
        directions (6,); force targets (2,); phase (6,).
    """
    if memory.view(MEMORY)[0].begun == 0.0:
        memory = start(table, contact, t, 0.0)
    else:
        memory = memory.copy()
    m, regions = memory.view(MEMORY)[0], regions.view(REGIONS)[0]
    for coast in m.coasts:
        track = coast.track
        if track.segment >= 0.0:
            absorb_ended_steps(track, t)
            if track.n_steps == 0.0:
                track.segment = -1.0
    absorb_ended_steps(m.now, t)
    if all_finite(contact):
        _events(table, m, law, t, contact, pose)
    _watch_lost(table, m, t, pose)
    if not (all_finite(contact) and contact[STATUS] == 0.0):
        m.bad_until = t + BAD_SEC
    bad = t < m.bad_until

    s, v, _ = motion_at(m.now, t)
    k = int(m.now.segment)
    L, last = head(table, k, LENGTH), k + 1 >= table[0]
    if m.held == 0.0 and m.ended == 0.0 and head(table, k, IN_CONTACT) == 0.0:
        at_rest = m.now.target == 0.0 and m.now.n_steps == 0.0
        if head(table, k, GOES_ON) > 0.0:
            if s >= L + law.search_max * head(table, k, IN_LOSS):
                X, _, _ = _reference(table, m, t)
                _go_on(table, m, law, t, pose, X[0], s)
        elif at_rest and s >= L - NEAR:
            if last:
                m.ended = 1.0
            else:
                X, _, _ = _reference(table, m, t)
                _change_segment(table, m, law, t, pose, X[0], s, 0.0)
                start_track(m.now, t, k + 1.0, 0.0)
        s, v, _ = motion_at(m.now, t)
        k = int(m.now.segment)

    started = t >= head(table, 0, START) or m.begun > 1.0
    allowed = started and not bad and m.held == 0.0 and m.ended == 0.0
    missing = (
        head(table, k, IN_CONTACT) > 0.0
        and m.now.target == 0.0
        and s > head(table, k, LENGTH) + 0.5 * law.search_max
        and not bad
    )
    if missing and m.held == 0.0:
        m.held = 1.0
        m.sticky = float(int(m.sticky) | CONTACT_MISSING)
        allowed = False
    if m.ended == 0.0:
        _choose_speed(table, m, law, regions, t, s, allowed)

    stage, kind = _stage(table, m, law, regions, t, s)
    if m.ended > 0.0:
        stage, kind = DONE, NO_CONTACT
    elif m.held > 0.0 or bad:
        stage = HOLD
    status = int(m.sticky) | int(regions.status)
    if bad:
        status |= BAD_INPUT
    if m.off[0] > 0.0 or m.off[1] > 0.0:
        status |= CONTACT_MISSING
    for r in range(int(regions.count)):
        region = regions.rows[r]
        if region.kind == IMPACT and region.segment == k and region.entry <= 0.0:
            status |= REGION_COVERS_PATH

    X, s, v = _reference(table, m, t)
    tangent = np.zeros(3)
    if v > 1e-6 or m.now.target > 0.0:
        tangent[:] = path_point(table, k, s)[1, :3]
    directions, targets = np.zeros(6), np.zeros(2)
    for row in range(int(head(table, k, N_FORCE))):
        if m.off[row] == 0.0:
            directions[3 * row : 3 * row + 3] = force_direction(table, k, row)
            targets[row] = head(table, k, TARGETS + row)
    phase = np.zeros(N_PHASE)
    phase[PHASE_SEGMENT], phase[PHASE_STAGE], phase[PHASE_KIND] = k, stage, kind
    phase[PHASE_SPEED], phase[PHASE_LENGTH], phase[PHASE_STATUS] = v, s, status
    return memory, X, tangent, directions, targets, phase


@numba.njit(cache=True)
def take_over(table, law, contact, t, old_table, old_memory):
    """Another pattern takes over: from the point of its first segment that is nearest
    to the reference, at the speed that the reference has along it.

    Returns: its memory, and how long the blend from the old one takes [s]: blend_sec,
        or longer, so that what the blend adds stays about within a_max.
    """
    X, _, _ = _reference(old_table, old_memory.view(MEMORY)[0], t)
    L, n = head(table, 0, LENGTH), 256
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
def blended(old, new, t, T):
    """X, dX/dt, d2X/dt2 (3, 6), from `old` to `new`, t after it began; it takes T."""
    S, slope, bend = unit_step(t / T)
    out = np.empty((3, 6))
    for i in range(6):
        gap, gap1 = new[0, i] - old[0, i], new[1, i] - old[1, i]
        out[0, i] = old[0, i] + S * gap
        out[1, i] = old[1, i] + S * gap1 + slope / T * gap
        out[2, i] = old[2, i] + S * (new[2, i] - old[2, i])
        out[2, i] += 2.0 * slope / T * gap1 + bend / (T * T) * gap
    return out


@numba.njit(cache=True)
def pose_output(X, base):
    """x_desired (19,) from X, dX/dt, d2X/dt2 (3, 6)."""
    out = np.empty(19)
    q, w, alpha = rotation_motion(X[0, 3:], X[1, 3:], X[2, 3:], base)
    out[:3], out[3:7], out[7:10] = X[0, :3], q, X[1, :3]
    out[10:13], out[13:16], out[16:19] = w, X[2, :3], alpha
    return out


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
    """Compiles all of it, for arrays as a Context has them: read-only."""
    memory, regions = np.zeros(N_MEMORY), np.zeros(N_REGIONS)
    contact, pose = np.zeros(N_CONTACT), np.zeros(7)
    for array in (memory, regions):
        array.setflags(write=False)
    _, X, *_ = tick(pattern.table, law, regions, memory, 0.0, contact, pose)
    pose_output(blended(X, X, 0.0, 1.0), pattern.base)
    plan(pattern.table, law, memory, 0.0, np.zeros(0, EXPECTED))
    take_over(pattern.table, law, contact, 0.0, pattern.table, memory)
