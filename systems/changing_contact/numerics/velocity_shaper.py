"""Re-times a motion pattern: slow where a contact is expected, as planned elsewhere.

The reference at time t is

    X(t) = path_k(s(t)) + c + sum of fading terms,      X = [p, r] as in path_geometry

s(t) is the arc length along segment k. Its speed is a sum of steps of equation 11,

    ds/dt = v_0 + sum_i dv_i S((t - t_i) / T_i),    T_i = 2 |dv_i| / a_max,

so it is smooth in all orders whatever steps begin while others still run, and s itself
is known in closed form. A step that begins later never ends earlier, which keeps the
speed from turning negative. All decisions are by arc length: a step down to v_a is
begun, at the very instant between two ticks, such that it ends at the region's entry

    s_c - (k sigma + margin + v_a settle_sec),

s_c where the path crosses the plane through the expected contact. Inside, the speed
stays v_a until the contact comes.

When it comes the next segment begins at once, from the reference as it is: the old
segment's motion runs out (another step, to speed 0; it lies along a direction that is
force-controlled from now on), and the constant c takes up the rest. Where a force
direction is dropped the reference is first put to the measured position along it. So
the pattern is shifted by what its contacts have taught. It stays shifted, or fades back
with 1 - S over release_sec; but for what of c lies along force directions, for there
the contact decides.

Source: Sidhik et al., section 3.5.2; the numbers of changing contact without time-outs.
"""

from typing import NamedTuple

import numba
import numpy as np

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
    SPEED_FLOOR,
    STATUS,
    ContactBelief,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern
from makebreak.systems.changing_contact.numerics.path_geometry import (
    DIRECTIONS,
    GOES_ON,
    HEAD,
    IN_CONTACT,
    IN_LOSS,
    KIND,
    LENGTH,
    LINE,
    N_FORCE,
    SPEED,
    START,
    TARGETS,
    path_point,
    rotation_motion,
)
from makebreak.systems.changing_contact.numerics.velocity_profile import (
    unit_step,
    unit_step_integral,
)

BAD_SEC = 0.1  # A pause lasts so long after the last bad sample.
STEP_SEC_MIN = 0.05  # Of a change of speed, however small: bounds the jerk.
# A contact that was lost is pressed for. If the tip then goes so far within so long,
# there is nothing: force control closes gaps at 12 mm/s or more.
LOST_WAY, LOST_SEC = 0.005, 1.0
NEAR = 1e-3  # [m] from its end a segment that came to rest counts as ended.
BEND_MAX = 9.85  # Of S''.
TURN_BACK_SEC = 1.0  # In which an orientation fades out where positions stay.


class ShaperLaw(NamedTuple):
    """Constants of the shaper."""

    acceleration_max: float  # Along the path [m/s2].
    speed_min: float  # Approach speeds below it are raised to it [m/s].
    release_sec: float  # In which an offset fades out, at least; inf: it stays.
    sigmas: float  # Half width of a region.
    margin: float  # Added to it [m].
    settle_sec: float  # And v_a times this.
    blend_sec: float  # Between base and transition controller.
    search_speed: float  # Beyond the end of a path whose contact has not come [m/s].
    search_max: float  # How far beyond it [m].
    go_on_unexpected: bool
    period: float  # Of a tick [s].


# --- Memory and regions. All fields are float64, so that Drake keeps each as a vector;
# vector.view(MEMORY)[0] is its record: the same numbers, by name. Compiled code must
# hold the vector for as long as the record.

_STEPS, _FADES, _COASTS = 12, 4, 2  # At once, at most.
STEP = np.dtype([("start", float), ("duration", float), ("change", float)], align=True)
TRACK = np.dtype(  # s(t) along a segment: s0 + v0 (t - t0) and steps of the speed.
    [
        ("segment", float),  # Of a coast, -1: there is none.
        ("s0", float),
        ("t0", float),
        ("v0", float),
        ("target", float),  # The speed after all steps [m/s].
        ("n_steps", float),
        ("steps", STEP, _STEPS),
    ],
    align=True,
)
FADE = np.dtype([("X", float, 6), ("start", float), ("duration", float)], align=True)
COAST = np.dtype([("track", TRACK), ("s_end", float)], align=True)
MEMORY = np.dtype(
    [
        ("begun", float),  # 0: not yet; 2: it does not wait for its first time.
        ("made", float),  # Counts of the contact detector, as last seen.
        ("broken", float),
        ("enter_time", float),  # Of the region; -1: in none.
        ("settle_until", float),
        ("settle_kind", float),
        ("held", float),
        ("ended", float),
        ("off", float, 2),  # Of each force direction, 1: it was given up.
        ("bad_until", float),
        ("sticky", float),  # Of the status, what stays until the next segment.
        ("region_kind", float),
        ("lost_time", float, 2),  # Of each force direction; 0: not lost.
        ("lost_at", float, 2),  # And where, p.n.
        ("c", float, 6),
        ("fades", FADE, _FADES),
        ("now", TRACK),
        ("coasts", COAST, _COASTS),  # Segments that run out.
    ],
    align=True,
)
N_MEMORY = MEMORY.itemsize // 8

REGIONS_MAX = 32
REGION_ROW = np.dtype(  # Arc lengths [m].
    [(name, float) for name in ("segment", "kind", "entry", "leave", "speed")],
    align=True,
)
REGIONS = np.dtype(
    [("count", float), ("status", float), ("rows", REGION_ROW, REGIONS_MAX)], align=True
)
N_REGIONS = REGIONS.itemsize // 8

EXPECTED = np.dtype(  # A contact as the planner takes it.
    [
        ("mean", float, 3),
        ("direction", float, 3),
        ("sigma", float),  # Along the direction.
        ("kind", float),
        ("segment", float),
        ("speed", float),  # v_a
    ],
    align=True,
)


@numba.njit(cache=True)
def _head(table, k, i):
    return table[1 + k * HEAD + i]


@numba.njit(cache=True)
def _dot(a, b):  # Of the first three: np.sum(a * b) takes a second to compile.
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True)
def _finite(a):
    for x in a:
        if not np.isfinite(x):
            return False
    return True


@numba.njit(cache=True)
def _add_along(C, n, distance):
    """C += n distance, in its first three."""
    for i in range(3):
        C[i] += n[i] * distance


@numba.njit(cache=True)
def _along(track, t):
    """Arc length, speed and acceleration of a track at time t."""
    s, v, a = track.s0 + track.v0 * (t - track.t0), track.v0, 0.0
    for i in range(int(track.n_steps)):
        step = track.steps[i]
        T, dv = step.duration, step.change
        tau = (t - step.start) / T
        S, slope, _ = unit_step(tau)
        s += dv * T * unit_step_integral(tau)
        v += dv * S
        a += dv / T * slope
    return s, v, a


@numba.njit(cache=True)
def _steady_from(track, t):
    """When the last step of a track ends; t if none runs."""
    end = t
    for i in range(int(track.n_steps)):
        step = track.steps[i]
        end = max(end, step.start + step.duration)
    return end


@numba.njit(cache=True)
def _fold(track, t):
    """Steps that are over become part of the constant speed."""
    i = 0
    while i < track.n_steps:
        step = track.steps[i]
        if t < step.start + step.duration:
            i += 1
            continue
        track.s0 += step.change * (track.t0 - step.start - 0.5 * step.duration)
        track.v0 += step.change
        track.n_steps -= 1.0
        track.steps[i] = track.steps[int(track.n_steps)]
        if track.n_steps == 0.0:  # No rounding is left in the speed.
            track.s0 += track.v0 * (t - track.t0)
            track.t0, track.v0 = t, track.target


@numba.njit(cache=True)
def _step_sec(law, dv):
    return max(2.0 * abs(dv) / law.acceleration_max, STEP_SEC_MIN)


@numba.njit(cache=True)
def _begin(track, law, t, target):
    """A step of the track to the speed `target`, from time t; none if too many run
    already."""
    n = int(track.n_steps)
    dv = target - track.target
    if n == _STEPS or dv == 0.0:
        return
    step = track.steps[n]
    step.start, step.change = t, dv
    step.duration = max(_step_sec(law, dv), _steady_from(track, t) - t)
    track.n_steps += 1.0
    track.target = target


@numba.njit(cache=True)
def _reference(table, m, t):
    """X and its two time derivatives (3, 6) at time t, and s, v along the path."""
    out = np.zeros((3, 6))
    s, v, a = _along(m.now, t)
    D = path_point(table, int(m.now.segment), s)
    for i in range(6):
        out[0, i] = m.c[i] + D[0, i]
        out[1, i] = D[1, i] * v
        out[2, i] = D[2, i] * v * v + D[1, i] * a
    for coast in m.coasts:
        if coast.track.segment < 0.0:
            continue
        k = int(coast.track.segment)
        s_c, v_c, a_c = _along(coast.track, t)
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
    """An offset X (6,) that is there at time t and fades out."""
    size, turn = np.sqrt(_dot(X, X)), np.sqrt(_dot(X[3:], X[3:]))
    if size == 0.0 and turn == 0.0:
        return
    slot, oldest = -1, 0
    for f in range(_FADES):
        fade = m.fades[f]
        if fade.duration <= 0.0 or t >= fade.start + fade.duration:
            slot = f
        elif fade.start < m.fades[oldest].start:
            oldest = f
    if slot < 0:  # The oldest one's rest fades out with the new one.
        slot = oldest
        fade = m.fades[slot]
        rest = 1.0 - unit_step((t - fade.start) / fade.duration)[0]
        for i in range(6):
            X[i] += rest * fade.X[i]
    fade = m.fades[slot]
    # Its acceleration is at most half of what the path may have; 1 rad counts as 1 m.
    T = np.sqrt(2.0 * BEND_MAX * max(size, turn) / law.acceleration_max)
    for i in range(6):
        fade.X[i] = X[i]
    least = law.release_sec if law.release_sec < np.inf else TURN_BACK_SEC
    fade.start, fade.duration = t, max(least, T)


@numba.njit(cache=True)
def _row(table, k, row):
    start = 1 + k * HEAD + DIRECTIONS + 3 * row
    return table[start : start + 3]


@numba.njit(cache=True)
def _has_direction(table, k, n):
    for row in range(int(_head(table, k, N_FORCE))):
        if _dot(_row(table, k, row), n) > 1.0 - 1e-6:
            return True
    return False


@numba.njit(cache=True)
def _change_segment(table, m, law, t, pose, X, s_end, s_start):
    """From the current segment, which ends at s_end, to the next one at s_start.

    Args: X (6,) the reference now; pose (7,) measured; the track is the caller's.
    """
    k = int(m.now.segment)
    end, start = path_point(table, k, s_end), path_point(table, k + 1, s_start)
    C = np.empty(6)
    for i in range(6):
        C[i] = m.c[i] + end[0, i] - start[0, i]
    if _finite(pose):
        for row in range(int(_head(table, k, N_FORCE))):
            n = _row(table, k, row)
            if m.off[row] == 0.0 and not _has_direction(table, k + 1, n):
                _add_along(C, n, _dot(n, pose) - _dot(n, X))
    kept = np.zeros(6)
    rows = int(_head(table, k + 1, N_FORCE))
    if law.release_sec == np.inf:
        kept[:3] = C[:3]
    elif rows > 0:  # What lies along the new force directions stays.
        n1 = _row(table, k + 1, 0)
        _add_along(kept, n1, _dot(n1, C))
        if rows > 1:
            n2 = _row(table, k + 1, 1).copy()
            _add_along(n2, n1, -_dot(n1, n2))
            _add_along(kept, n2, _dot(n2, C) / _dot(n2, n2))
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
    """The contact has come: this segment runs out, the next one starts from rest."""
    slot, first = 0, np.inf
    for c in range(_COASTS):
        track = m.coasts[c].track
        ends = -1.0 if track.segment < 0.0 else _steady_from(track, t)
        if ends < first:
            slot, first = c, ends
    coast = m.coasts[slot]
    coast.track = m.now
    track = coast.track
    if track.n_steps == _STEPS:  # Too many to add one: it stops now.
        track.n_steps = 0.0
        track.v0, track.target = 0.0, 0.0
        track.s0, track.t0 = _along(m.now, t)[0], t
    _begin(track, law, t, 0.0)
    coast.s_end = _along(track, _steady_from(track, t))[0]
    _change_segment(table, m, law, t, pose, X, coast.s_end, 0.0)
    _start_track(m.now, t, m.now.segment, 0.0)
    m.settle_until, m.settle_kind = t + law.blend_sec, IMPACT


@numba.njit(cache=True)
def _start_track(track, t, segment, speed):
    track.segment, track.s0, track.t0 = segment, 0.0, t
    track.v0, track.target, track.n_steps = speed, speed, 0.0


@numba.njit(cache=True)
def start(table, contact, t, speed):
    """Memory (N_MEMORY,) at the start of a pattern, at that speed [m/s]."""
    memory = np.zeros(N_MEMORY)
    m = memory.view(MEMORY)[0]
    m.begun = 1.0
    if _finite(contact):
        m.made, m.broken = contact[MADE], contact[BROKEN]
    m.enter_time = m.settle_until = m.bad_until = -1.0
    _start_track(m.now, t, 0.0, speed)
    for coast in m.coasts:
        coast.track.segment = -1.0
    return memory


def begin_anew(table, contact, t):
    """Memory (N_MEMORY,) of a pattern that begins now, at rest, whatever its times."""
    memory = start(table, contact, t, 0.0)
    memory.view(MEMORY)["begun"] = 2.0
    return memory


@numba.njit(cache=True)
def _brake(track, law, t, s_limit, v_limit):
    """When to begin the step down to v_limit that ends at s_limit; inf: not in this
    tick."""
    v = track.target
    if not v > v_limit:
        return np.inf
    steady = _steady_from(track, t)
    T = max(_step_sec(law, v - v_limit), steady - t)
    # Where it would be slow if it began now: after `steady` the speed is v.
    s_end = _along(track, steady)[0] + v * (t + T - steady) - 0.5 * (v - v_limit) * T
    wait = (s_limit - s_end) / v
    if wait <= 0.0:
        return t
    return t + wait if wait <= law.period and steady <= t else np.inf


@numba.njit(cache=True)
def _highest(law, v, v_limit, distance):
    """The highest speed to go to from v if v_limit is to hold after `distance`."""
    if distance <= 0.0:
        return v_limit
    a = law.acceleration_max
    v_peak = np.sqrt(max(0.5 * (a * distance + v * v + v_limit * v_limit), 0.0))
    way = 0.5 * (v + v_peak) * _step_sec(law, v_peak - v)
    way += 0.5 * (v_peak + v_limit) * _step_sec(law, v_peak - v_limit)
    if v_peak <= 1.05 * v_limit or way > distance * (1.0 + 1e-9):
        return v_limit
    return v_peak


@numba.njit(cache=True)
def _active(table, region, k):
    """Entry and exit of a region on the track of segment k; entry inf: not on it."""
    segment = int(region.segment)
    shift = 0.0
    if segment == k + 1 and k + 1 < table[0]:
        flows = _head(table, k, GOES_ON) > 0.0 and _head(table, k, IN_LOSS) == 0.0
        if not flows:
            return np.inf, np.inf
        shift = _head(table, k, LENGTH)
    elif segment != k:
        return np.inf, np.inf
    leave = region.leave + shift
    if region.kind == IMPACT and _head(table, segment, IN_CONTACT) > 0.0:
        leave = np.inf  # Until the contact comes.
    return region.entry + shift, leave


@numba.njit(cache=True)
def _choose_speed(table, m, law, regions, t, s, allowed):
    """Begins the step that is due, if one is."""
    k = int(m.now.segment)
    v = m.now.target
    L = _head(table, k, LENGTH)
    cap = _head(table, k, SPEED) if allowed else 0.0
    highest, slower, when = cap, np.inf, np.inf
    search = np.inf
    if v > cap:
        slower, when = cap, t
    for r in range(int(regions.count) + 2):
        if r < regions.count:
            region = regions.rows[r]
            entry, leave = _active(table, region, k)
            if region.kind != IMPACT or s >= leave or entry == np.inf:
                continue
            limit = region.speed
            if leave == np.inf:
                search = min(search, limit)
        elif r == regions.count:  # The end of the path.
            entry, limit = L, 0.0
            if _head(table, k, IN_CONTACT) > 0.0:
                limit = search if search < np.inf else law.search_speed
            elif _head(table, k, GOES_ON) > 0.0:
                limit = _head(table, k + 1, SPEED)
        else:  # And as far beyond it as the contact is searched for.
            if _head(table, k, IN_CONTACT) == 0.0:
                continue
            entry, limit = L + law.search_max, 0.0
        begin = _brake(m.now, law, t, entry, limit)
        if begin < np.inf and limit < slower:
            slower, when = limit, begin
        highest = min(highest, _highest(law, v, limit, entry - s))
    if when < np.inf:
        _begin(m.now, law, when, slower)
    elif m.now.n_steps == 0.0 and highest > v + (max(1e-3, 0.02 * v) if v > 0 else 0.0):
        _begin(m.now, law, t, highest)


@numba.njit(cache=True)
def _time_to(track, law, t, s_limit):
    """How long until the arc length s_limit is reached, at most 10 blend_sec [s]."""
    far = 10.0 * law.blend_sec
    steady = _steady_from(track, t)
    s_steady = _along(track, steady)[0]
    if s_steady <= s_limit:
        v = track.target
        return min(far, steady - t + (s_limit - s_steady) / v) if v > 0.0 else far
    low, high = t, steady
    for _ in range(12):
        middle = 0.5 * (low + high)
        if _along(track, middle)[0] < s_limit:
            low = middle
        else:
            high = middle
    return high - t


@numba.njit(cache=True)
def _stage(table, m, law, regions, t, s):
    """Stage and kind of the phase."""
    k = int(m.now.segment)
    kind, entry = NO_CONTACT, np.inf
    for r in range(int(regions.count)):
        region = regions.rows[r]
        begins, leave = _active(table, region, k)
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
        s >= entry or _time_to(m.now, law, t, entry) <= law.blend_sec
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
    """What the contact detector has reported since the last tick."""
    made = contact[MADE] > m.made
    broken = contact[BROKEN] > m.broken
    m.made, m.broken = contact[MADE], contact[BROKEN]
    if m.held > 0.0 or m.ended > 0.0 or not (made or broken):
        return
    k = int(m.now.segment)
    X, s, _ = _reference(table, m, t)
    if made:
        tangent = path_point(table, k, s)[1, :3]
        aligned = _dot(contact[DIRECTION], tangent) > 0.5  # Else an echo of the last.
        if aligned and _head(table, k, IN_CONTACT) > 0.0:
            _after_contact(table, m, law, t, pose, X[0])
            return
        if m.off[0] > 0.0 or m.off[1] > 0.0:  # What was lost is there again.
            m.off[0] = m.off[1] = 0.0
        elif m.lost_time[0] > 0.0 or m.lost_time[1] > 0.0:  # The same, sooner.
            pass
        elif aligned:
            m.sticky = float(int(m.sticky) | CONTACT_UNEXPECTED)
            if not law.go_on_unexpected:
                m.held = 1.0
    row = int(contact[BROKEN_ROW])
    if broken and 0 <= row < _head(table, k, N_FORCE) and t >= m.settle_until:
        if _head(table, k, IN_LOSS) > 0.0:
            _go_on(table, m, law, t, pose, X[0], s)
        elif m.off[row] == 0.0 and _finite(pose):
            m.lost_time[row], m.lost_at[row] = t, _dot(_row(table, k, row), pose)


@numba.njit(cache=True)
def _watch_lost(table, m, t, pose):
    """A contact that was lost and not found again is given up: its direction is held
    where the tip is, until a contact is felt."""
    k = int(m.now.segment)
    for row in range(int(_head(table, k, N_FORCE))):
        if m.lost_time[row] == 0.0 or not _finite(pose):
            continue
        n = _row(table, k, row)
        if t > m.lost_time[row] + LOST_SEC:
            m.lost_time[row] = 0.0
        elif _dot(n, pose) - m.lost_at[row] > LOST_WAY:
            m.lost_time[row], m.off[row] = 0.0, 1.0
            X, _, _ = _reference(table, m, t)
            _add_along(m.c, n, _dot(n, pose) - _dot(n, X[0]))


@numba.njit(cache=True)
def _go_on(table, m, law, t, pose, X, s):
    """To the next segment on the same line, without a stop."""
    L = _head(table, int(m.now.segment), LENGTH)
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
            _fold(track, t)
            if track.n_steps == 0.0:
                track.segment = -1.0
    _fold(m.now, t)
    if _finite(contact):
        _events(table, m, law, t, contact, pose)
    _watch_lost(table, m, t, pose)
    if not (_finite(contact) and contact[STATUS] == 0.0):
        m.bad_until = t + BAD_SEC
    bad = t < m.bad_until

    s, v, _ = _along(m.now, t)
    k = int(m.now.segment)
    L, last = _head(table, k, LENGTH), k + 1 >= table[0]
    if m.held == 0.0 and m.ended == 0.0 and _head(table, k, IN_CONTACT) == 0.0:
        at_rest = m.now.target == 0.0 and m.now.n_steps == 0.0
        if _head(table, k, GOES_ON) > 0.0:
            if s >= L + law.search_max * _head(table, k, IN_LOSS):
                X, _, _ = _reference(table, m, t)
                _go_on(table, m, law, t, pose, X[0], s)
        elif at_rest and s >= L - NEAR:
            if last:
                m.ended = 1.0
            else:
                X, _, _ = _reference(table, m, t)
                _change_segment(table, m, law, t, pose, X[0], s, 0.0)
                _start_track(m.now, t, k + 1.0, 0.0)
        s, v, _ = _along(m.now, t)
        k = int(m.now.segment)

    started = t >= _head(table, 0, START) or m.begun > 1.0
    allowed = started and not bad and m.held == 0.0 and m.ended == 0.0
    missing = (
        _head(table, k, IN_CONTACT) > 0.0
        and m.now.target == 0.0
        and s > _head(table, k, LENGTH) + 0.5 * law.search_max
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
    for row in range(int(_head(table, k, N_FORCE))):
        if m.off[row] == 0.0:
            directions[3 * row : 3 * row + 3] = _row(table, k, row)
            targets[row] = _head(table, k, TARGETS + row)
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
    L, n = _head(table, 0, LENGTH), 256
    s, nearest = 0.0, np.inf
    for i in range(n + 1):
        D = path_point(table, 0, L * i / n)
        _add_along(D[0], X[0], -1.0)
        square = _dot(D[0], D[0])
        if square < nearest:  # To first order in the rest along the path.
            s, nearest = L * i / n - _dot(D[0], D[1]), square
    s = min(max(s, 0.0), L)
    D = path_point(table, 0, s)
    speed = min(max(_dot(X[1], D[1]), 0.0), _head(table, 0, SPEED))
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


# --- Planning: where the regions begin and end along the path.


def expected(belief: ContactBelief) -> np.ndarray:
    """(n,) EXPECTED of a belief, as plan takes them."""
    rows = []
    for c in belief.contacts:
        sigma = np.sqrt(c.direction @ c.covariance @ c.direction)
        rows.append((c.mean, c.direction, sigma, c.kind, c.segment, c.approach_speed))
    return np.array(rows, dtype=EXPECTED)


@numba.njit(cache=True)
def plan(table, law, memory, t, contacts):
    """Regions (N_REGIONS,) of the expected contacts.

    Args: contacts (n,) EXPECTED; memory as tick has it: the offset of the running
        segment counts. A contact that the path does not approach has no region.
    """
    regions, m = np.zeros(N_REGIONS), memory.view(MEMORY)[0]
    out = regions.view(REGIONS)[0]
    current, offset, later = -1, np.zeros(3), np.zeros(3)
    if m.begun > 0.0:
        current = int(m.now.segment)
        later[:] = m.c[:3]
        offset[:] = later
        for fade in m.fades:
            if fade.duration > 0.0:
                rest = 1.0 - unit_step((t - fade.start) / fade.duration)[0]
                _add_along(offset, fade.X, rest)
    count, status = 0, 0
    for c in contacts:
        k = int(c.segment)
        known = _finite(c.mean) and _finite(c.direction)
        known = known and _finite((c.sigma, c.kind, c.segment))
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
            shift = max(_dot(offset, d), _dot(later, d))
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
def _gap(table, k, s, mean, d, shift):
    p = path_point(table, k, s)[0]
    return _dot(p, d) - _dot(mean, d) + shift


@numba.njit(cache=True)
def _crossing(table, law, k, mean, d, shift, before, after):
    """Arc lengths at which the path is `before` in front of the plane through mean
    with normal d, and `after` behind it; inf, inf where it does not cross it."""
    L = _head(table, k, LENGTH)
    if _head(table, k, KIND) == LINE:
        slope = _dot(path_point(table, k, 0.0)[1], d)
        if slope < 0.05:
            return np.inf, np.inf
        s = -_gap(table, k, 0.0, mean, d, shift) / slope
        return s - before / slope, s + after / slope
    n = 256
    end = L + law.search_max
    values = np.empty(n + 1)
    best, nearest = -1, np.inf
    for i in range(n + 1):
        values[i] = _gap(table, k, i * end / n, mean, d, shift)
        if i > 0 and values[i - 1] < 0.0 <= values[i]:
            p = path_point(table, k, i * end / n)[0]
            _add_along(p, mean, -1.0)
            _add_along(p, d, -_dot(p, d))
            across = _dot(p, p)
            if across < nearest:
                best, nearest = i, across
    if best < 0:
        return np.inf, np.inf
    entry, leave = -1.0, np.inf
    for i in range(best, 0, -1):
        if values[i - 1] <= -before < values[i]:
            entry = _root(table, k, mean, d, shift + before, i - 1, i, end / n)
            break
    for i in range(best, n + 1):
        if values[i - 1] < after <= values[i]:
            leave = _root(table, k, mean, d, shift - after, i - 1, i, end / n)
            break
    return entry, leave


@numba.njit(cache=True)
def _root(table, k, mean, d, shift, i, j, width):
    low, high = i * width, j * width
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _gap(table, k, middle, mean, d, shift) < 0.0:
            low = middle
        else:
            high = middle
    return high


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
