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


# --- The memory, one flat array.
_STEPS = 12  # Of speed, running at once.
_SEG, _S0, _T0, _V0, _TARGET, _N, _STEP = range(7)  # Of a track.
_TRACK = _STEP + 3 * _STEPS
(
    _INIT, _MADE, _BROKEN, _ENTER_TIME, _SETTLE_UNTIL, _SETTLE_KIND, _HELD, _ENDED,
    _OFF, _OFF1, _BAD_UNTIL, _STICKY, _IN_KIND, _BEGAN,
) = range(14)  # fmt: skip
_LOST, _LOST_AT = 14, 16  # Of each row: when it was lost, 0: not; and where, p.n.
_C = 18  # (6,)
_FADES, _FADE = 24, 8  # Four of [X 6, start, duration].
_N_FADES = 4
_NOW = _FADES + _N_FADES * _FADE
_COASTS = _NOW + _TRACK  # Two of [track, s at its end].
_N_COASTS, _COAST = 2, _TRACK + 1
N_MEMORY = _COASTS + _N_COASTS * _COAST

# --- Regions, one flat array: [count, status, rows].
REGIONS_MAX = 32
_ROW = 5  # [segment, kind, entry, exit, speed]; arc lengths [m].
N_REGIONS = 2 + REGIONS_MAX * _ROW
# Contacts as the planner takes them: [mean 3, direction 3, sigma, kind, segment, v_a].
N_EXPECTED = 10


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
def _along(m, b, t):
    """Arc length, speed and acceleration of the track at b, at time t."""
    s, v, a = m[b + _S0] + m[b + _V0] * (t - m[b + _T0]), m[b + _V0], 0.0
    for i in range(int(m[b + _N])):
        j = b + _STEP + 3 * i
        T, dv = m[j + 1], m[j + 2]
        tau = (t - m[j]) / T
        S, slope, _ = unit_step(tau)
        s += dv * T * unit_step_integral(tau)
        v += dv * S
        a += dv / T * slope
    return s, v, a


@numba.njit(cache=True)
def _steady_from(m, b, t):
    """When the last step of the track at b ends; t if none runs."""
    end = t
    for i in range(int(m[b + _N])):
        j = b + _STEP + 3 * i
        end = max(end, m[j] + m[j + 1])
    return end


@numba.njit(cache=True)
def _fold(m, b, t):
    """Steps that are over become part of the constant speed."""
    i = 0
    while i < m[b + _N]:
        j = b + _STEP + 3 * i
        if t < m[j] + m[j + 1]:
            i += 1
            continue
        m[b + _S0] += m[j + 2] * (m[b + _T0] - m[j] - 0.5 * m[j + 1])
        m[b + _V0] += m[j + 2]
        m[b + _N] -= 1.0
        last = b + _STEP + 3 * int(m[b + _N])
        m[j], m[j + 1], m[j + 2] = m[last], m[last + 1], m[last + 2]
        if m[b + _N] == 0.0:  # No rounding is left in the speed.
            m[b + _S0] += m[b + _V0] * (t - m[b + _T0])
            m[b + _T0], m[b + _V0] = t, m[b + _TARGET]


@numba.njit(cache=True)
def _step_sec(law, dv):
    return max(2.0 * abs(dv) / law.acceleration_max, STEP_SEC_MIN)


@numba.njit(cache=True)
def _begin(m, b, law, t, target):
    """A step of the track at b to the speed `target`, from time t; none if too many
    run already."""
    n = int(m[b + _N])
    dv = target - m[b + _TARGET]
    if n == _STEPS or dv == 0.0:
        return
    j = b + _STEP + 3 * n
    m[j], m[j + 2] = t, dv
    m[j + 1] = max(_step_sec(law, dv), _steady_from(m, b, t) - t)
    m[b + _N] += 1.0
    m[b + _TARGET] = target


@numba.njit(cache=True)
def _reference(table, m, t):
    """X and its two time derivatives (3, 6) at time t, and s, v along the path."""
    out = np.zeros((3, 6))
    s, v, a = _along(m, _NOW, t)
    D = path_point(table, int(m[_NOW + _SEG]), s)
    for i in range(6):
        out[0, i] = m[_C + i] + D[0, i]
        out[1, i] = D[1, i] * v
        out[2, i] = D[2, i] * v * v + D[1, i] * a
    for c in range(_N_COASTS):
        b = _COASTS + c * _COAST
        if m[b + _SEG] < 0.0:
            continue
        k = int(m[b + _SEG])
        s_c, v_c, a_c = _along(m, b, t)
        D = path_point(table, k, s_c)
        end = path_point(table, k, m[b + _TRACK])
        for i in range(6):
            out[0, i] += D[0, i] - end[0, i]
            out[1, i] += D[1, i] * v_c
            out[2, i] += D[2, i] * v_c * v_c + D[1, i] * a_c
    for f in range(_N_FADES):
        b = _FADES + f * _FADE
        T = m[b + 7]
        if T > 0.0:
            S, slope, bend = unit_step((t - m[b + 6]) / T)
            for i in range(6):
                out[0, i] += m[b + i] * (1.0 - S)
                out[1, i] -= m[b + i] * slope / T
                out[2, i] -= m[b + i] * bend / (T * T)
    return out, s, v


@numba.njit(cache=True)
def _fade_out(m, law, t, X):
    """An offset X (6,) that is there at time t and fades out."""
    size, turn = np.sqrt(_dot(X, X)), np.sqrt(_dot(X[3:], X[3:]))
    if size == 0.0 and turn == 0.0:
        return
    slot, oldest = -1, 0
    for f in range(_N_FADES):
        b = _FADES + f * _FADE
        if m[b + 7] <= 0.0 or t >= m[b + 6] + m[b + 7]:
            slot = f
        elif m[b + 6] < m[_FADES + oldest * _FADE + 6]:
            oldest = f
    if slot < 0:  # The oldest one's rest fades out with the new one.
        slot = oldest
        b = _FADES + slot * _FADE
        rest = 1.0 - unit_step((t - m[b + 6]) / m[b + 7])[0]
        for i in range(6):
            X[i] += rest * m[b + i]
    b = _FADES + slot * _FADE
    # Its acceleration is at most half of what the path may have; 1 rad counts as 1 m.
    T = np.sqrt(2.0 * BEND_MAX * max(size, turn) / law.acceleration_max)
    for i in range(6):
        m[b + i] = X[i]
    least = law.release_sec if law.release_sec < np.inf else TURN_BACK_SEC
    m[b + 6], m[b + 7] = t, max(least, T)


@numba.njit(cache=True)
def _row(table, k, row):
    start = 1 + k * HEAD + 4 + 3 * row
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
    k = int(m[_NOW + _SEG])
    end, start = path_point(table, k, s_end), path_point(table, k + 1, s_start)
    C = np.empty(6)
    for i in range(6):
        C[i] = m[_C + i] + end[0, i] - start[0, i]
    if _finite(pose):
        for row in range(int(_head(table, k, N_FORCE))):
            n = _row(table, k, row)
            if m[_OFF + row] == 0.0 and not _has_direction(table, k + 1, n):
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
        m[_C + i] = kept[i]
        C[i] -= kept[i]
    _fade_out(m, law, t, C)
    m[_NOW + _SEG] = k + 1.0
    m[_OFF], m[_OFF1] = 0.0, 0.0
    m[_LOST], m[_LOST + 1] = 0.0, 0.0
    m[_STICKY] = 0.0
    m[_ENTER_TIME], m[_IN_KIND] = -1.0, NO_CONTACT
    m[_BEGAN] = t


@numba.njit(cache=True)
def _after_contact(table, m, law, t, pose, X):
    """The contact has come: this segment runs out, the next one starts from rest."""
    slot, first = 0, np.inf
    for c in range(_N_COASTS):
        b = _COASTS + c * _COAST
        ends = -1.0 if m[b + _SEG] < 0.0 else _steady_from(m, b, t)
        if ends < first:
            slot, first = c, ends
    b = _COASTS + slot * _COAST
    m[b : b + _TRACK] = m[_NOW : _NOW + _TRACK]
    if m[b + _N] == _STEPS:  # Too many to add one: it stops now.
        m[b + _N] = 0.0
        m[b + _V0], m[b + _TARGET] = 0.0, 0.0
        m[b + _S0], m[b + _T0] = _along(m, _NOW, t)[0], t
    _begin(m, b, law, t, 0.0)
    s_end = _along(m, b, _steady_from(m, b, t))[0]
    m[b + _TRACK] = s_end
    _change_segment(table, m, law, t, pose, X, s_end, 0.0)
    _start_track(m, t, m[_NOW + _SEG], 0.0)
    m[_SETTLE_UNTIL], m[_SETTLE_KIND] = t + law.blend_sec, IMPACT


@numba.njit(cache=True)
def _start_track(m, t, segment, speed):
    m[_NOW : _NOW + _TRACK] = 0.0
    m[_NOW + _SEG], m[_NOW + _T0] = segment, t
    m[_NOW + _V0], m[_NOW + _TARGET] = speed, speed


@numba.njit(cache=True)
def start(table, contact, t, speed):
    """Memory (N_MEMORY,) at the start of a pattern, at that speed [m/s]."""
    m = np.zeros(N_MEMORY)
    m[_INIT] = 1.0
    if _finite(contact):
        m[_MADE], m[_BROKEN] = contact[MADE], contact[BROKEN]
    m[_ENTER_TIME], m[_BEGAN] = -1.0, t
    m[_SETTLE_UNTIL] = m[_BAD_UNTIL] = -1.0
    _start_track(m, t, 0.0, speed)
    for c in range(_N_COASTS):
        m[_COASTS + c * _COAST + _SEG] = -1.0
    return m


def begin_anew(table, contact, t):
    """Memory (N_MEMORY,) of a pattern that begins now, at rest, whatever its times."""
    memory = start(table, contact, t, 0.0)
    memory[_INIT] = 2.0  # It does not wait for its first time.
    return memory


@numba.njit(cache=True)
def _brake(m, law, t, s_limit, v_limit):
    """When to begin the step down to v_limit that ends at s_limit; inf: not in this
    tick."""
    v = m[_NOW + _TARGET]
    if not v > v_limit:
        return np.inf
    steady = _steady_from(m, _NOW, t)
    T = max(_step_sec(law, v - v_limit), steady - t)
    # Where it would be slow if it began now: after `steady` the speed is v.
    s_end = _along(m, _NOW, steady)[0] + v * (t + T - steady) - 0.5 * (v - v_limit) * T
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
def _active(table, regions, k, r):
    """Entry and exit of region r on the track of segment k; entry inf: not on it."""
    at = 2 + r * _ROW
    segment = int(regions[at])
    shift = 0.0
    if segment == k + 1 and k + 1 < table[0]:
        flows = _head(table, k, GOES_ON) > 0.0 and _head(table, k, IN_LOSS) == 0.0
        if not flows:
            return np.inf, np.inf
        shift = _head(table, k, LENGTH)
    elif segment != k:
        return np.inf, np.inf
    leave = regions[at + 3] + shift
    if regions[at + 1] == IMPACT and _head(table, segment, IN_CONTACT) > 0.0:
        leave = np.inf  # Until the contact comes.
    return regions[at + 2] + shift, leave


@numba.njit(cache=True)
def _choose_speed(table, m, law, regions, t, s, allowed):
    """Begins the step that is due, if one is."""
    k = int(m[_NOW + _SEG])
    v = m[_NOW + _TARGET]
    L = _head(table, k, LENGTH)
    cap = _head(table, k, SPEED) if allowed else 0.0
    highest, slower, when = cap, np.inf, np.inf
    search = np.inf
    if v > cap:
        slower, when = cap, t
    for r in range(int(regions[0]) + 2):
        if r < regions[0]:
            entry, leave = _active(table, regions, k, r)
            if regions[2 + r * _ROW + 1] != IMPACT or s >= leave or entry == np.inf:
                continue
            limit = regions[2 + r * _ROW + 4]
            if leave == np.inf:
                search = min(search, limit)
        elif r == regions[0]:  # The end of the path.
            entry, limit = L, 0.0
            if _head(table, k, IN_CONTACT) > 0.0:
                limit = search if search < np.inf else law.search_speed
            elif _head(table, k, GOES_ON) > 0.0:
                limit = _head(table, k + 1, SPEED)
        else:  # And as far beyond it as the contact is searched for.
            if _head(table, k, IN_CONTACT) == 0.0:
                continue
            entry, limit = L + law.search_max, 0.0
        begin = _brake(m, law, t, entry, limit)
        if begin < np.inf and limit < slower:
            slower, when = limit, begin
        highest = min(highest, _highest(law, v, limit, entry - s))
    if when < np.inf:
        _begin(m, _NOW, law, when, slower)
    elif m[_NOW + _N] == 0.0 and highest > v + (max(1e-3, 0.02 * v) if v > 0 else 0.0):
        _begin(m, _NOW, law, t, highest)


@numba.njit(cache=True)
def _time_to(m, law, t, s_limit):
    """How long until the arc length s_limit is reached, at most 10 blend_sec [s]."""
    far = 10.0 * law.blend_sec
    steady = _steady_from(m, _NOW, t)
    s_steady = _along(m, _NOW, steady)[0]
    if s_steady <= s_limit:
        v = m[_NOW + _TARGET]
        return min(far, steady - t + (s_limit - s_steady) / v) if v > 0.0 else far
    low, high = t, steady
    for _ in range(12):
        middle = 0.5 * (low + high)
        if _along(m, _NOW, middle)[0] < s_limit:
            low = middle
        else:
            high = middle
    return high - t


@numba.njit(cache=True)
def _stage(table, m, law, regions, t, s):
    """Stage and kind of the phase."""
    k = int(m[_NOW + _SEG])
    kind, entry = NO_CONTACT, np.inf
    for r in range(int(regions[0])):
        begins, leave = _active(table, regions, k, r)
        if begins == np.inf or s >= leave:
            continue
        this = int(regions[2 + r * _ROW + 1])
        inside, before = s >= begins, s >= entry
        # Of two that overlap the impact counts; else the next one.
        if (inside and before and this == IMPACT) or (
            not (inside and before) and begins < entry
        ):
            kind, entry = this, begins
    if kind != NO_CONTACT and (
        s >= entry or _time_to(m, law, t, entry) <= law.blend_sec
    ):
        if m[_ENTER_TIME] < 0.0:
            m[_ENTER_TIME] = t
        m[_IN_KIND] = kind
        inside = s >= entry and t - m[_ENTER_TIME] >= law.blend_sec - 1e-9
        return REGION if inside else ENTER, kind
    if m[_ENTER_TIME] >= 0.0:  # Passed through.
        m[_ENTER_TIME] = -1.0
        m[_SETTLE_UNTIL], m[_SETTLE_KIND] = t + law.blend_sec, m[_IN_KIND]
    if t < m[_SETTLE_UNTIL]:
        return SETTLE, int(m[_SETTLE_KIND])
    return MOVE, NO_CONTACT


@numba.njit(cache=True)
def _events(table, m, law, t, contact, pose):
    """What the contact detector has reported since the last tick."""
    made = contact[MADE] > m[_MADE]
    broken = contact[BROKEN] > m[_BROKEN]
    m[_MADE], m[_BROKEN] = contact[MADE], contact[BROKEN]
    if m[_HELD] > 0.0 or m[_ENDED] > 0.0 or not (made or broken):
        return
    k = int(m[_NOW + _SEG])
    X, s, _ = _reference(table, m, t)
    if made:
        tangent = path_point(table, k, s)[1, :3]
        aligned = _dot(contact[DIRECTION], tangent) > 0.5  # Else an echo of the last.
        if aligned and _head(table, k, IN_CONTACT) > 0.0:
            _after_contact(table, m, law, t, pose, X[0])
            return
        if m[_OFF] > 0.0 or m[_OFF1] > 0.0:  # What was lost is there again.
            m[_OFF], m[_OFF1] = 0.0, 0.0
        elif m[_LOST] > 0.0 or m[_LOST + 1] > 0.0:  # The same, sooner.
            pass
        elif aligned:
            m[_STICKY] = float(int(m[_STICKY]) | CONTACT_UNEXPECTED)
            if not law.go_on_unexpected:
                m[_HELD] = 1.0
    row = int(contact[BROKEN_ROW])
    if broken and 0 <= row < _head(table, k, N_FORCE) and t >= m[_SETTLE_UNTIL]:
        if _head(table, k, IN_LOSS) > 0.0:
            _go_on(table, m, law, t, pose, X[0], s)
        elif m[_OFF + row] == 0.0 and _finite(pose):
            m[_LOST + row], m[_LOST_AT + row] = t, _dot(_row(table, k, row), pose)


@numba.njit(cache=True)
def _watch_lost(table, m, t, pose):
    """A contact that was lost and not found again is given up: its direction is held
    where the tip is, until a contact is felt."""
    k = int(m[_NOW + _SEG])
    for row in range(int(_head(table, k, N_FORCE))):
        if m[_LOST + row] == 0.0 or not _finite(pose):
            continue
        n = _row(table, k, row)
        if t > m[_LOST + row] + LOST_SEC:
            m[_LOST + row] = 0.0
        elif _dot(n, pose) - m[_LOST_AT + row] > LOST_WAY:
            m[_LOST + row], m[_OFF + row] = 0.0, 1.0
            X, _, _ = _reference(table, m, t)
            _add_along(m[_C : _C + 3], n, _dot(n, pose) - _dot(n, X[0]))


@numba.njit(cache=True)
def _go_on(table, m, law, t, pose, X, s):
    """To the next segment on the same line, without a stop."""
    L = _head(table, int(m[_NOW + _SEG]), LENGTH)
    _change_segment(table, m, law, t, pose, X, L, 0.0)
    m[_NOW + _S0] -= L


@numba.njit(cache=True)
def tick(table, law, regions, memory, t, contact, pose):
    """One tick.

    Args: table of the pattern; law; regions (N_REGIONS,) as plan gives them; memory of
        the last tick (memory[0] = 0: none yet); t [s]; contact (14,); pose (7,)
        measured: anything may be NaN.
    Returns: memory; X, dX/dt, d2X/dt2 (3, 6); tangent (3,), zero at rest; force
        directions (6,); force targets (2,); phase (6,).
    """
    m = start(table, contact, t, 0.0) if memory[_INIT] == 0.0 else memory.copy()
    for c in range(_N_COASTS):
        b = _COASTS + c * _COAST
        if m[b + _SEG] >= 0.0:
            _fold(m, b, t)
            if m[b + _N] == 0.0:
                m[b + _SEG] = -1.0
    _fold(m, _NOW, t)
    if _finite(contact):
        _events(table, m, law, t, contact, pose)
    _watch_lost(table, m, t, pose)
    if not (_finite(contact) and contact[STATUS] == 0.0):
        m[_BAD_UNTIL] = t + BAD_SEC
    bad = t < m[_BAD_UNTIL]

    s, v, _ = _along(m, _NOW, t)
    k = int(m[_NOW + _SEG])
    L, last = _head(table, k, LENGTH), k + 1 >= table[0]
    if m[_HELD] == 0.0 and m[_ENDED] == 0.0 and _head(table, k, IN_CONTACT) == 0.0:
        at_rest = m[_NOW + _TARGET] == 0.0 and m[_NOW + _N] == 0.0
        if _head(table, k, GOES_ON) > 0.0:
            if s >= L + law.search_max * _head(table, k, IN_LOSS):
                X, _, _ = _reference(table, m, t)
                _go_on(table, m, law, t, pose, X[0], s)
        elif at_rest and s >= L - NEAR:
            if last:
                m[_ENDED] = 1.0
            else:
                X, _, _ = _reference(table, m, t)
                _change_segment(table, m, law, t, pose, X[0], s, 0.0)
                _start_track(m, t, k + 1.0, 0.0)
        s, v, _ = _along(m, _NOW, t)
        k = int(m[_NOW + _SEG])

    started = t >= _head(table, 0, START) or m[_INIT] > 1.0
    allowed = started and not bad and m[_HELD] == 0.0 and m[_ENDED] == 0.0
    missing = (
        _head(table, k, IN_CONTACT) > 0.0
        and m[_NOW + _TARGET] == 0.0
        and s > _head(table, k, LENGTH) + 0.5 * law.search_max
        and not bad
    )
    if missing and m[_HELD] == 0.0:
        m[_HELD] = 1.0
        m[_STICKY] = float(int(m[_STICKY]) | CONTACT_MISSING)
        allowed = False
    if m[_ENDED] == 0.0:
        _choose_speed(table, m, law, regions, t, s, allowed)

    stage, kind = _stage(table, m, law, regions, t, s)
    if m[_ENDED] > 0.0:
        stage, kind = DONE, NO_CONTACT
    elif m[_HELD] > 0.0 or bad:
        stage = HOLD
    status = int(m[_STICKY]) | int(regions[1])
    if bad:
        status |= BAD_INPUT
    if m[_OFF] > 0.0 or m[_OFF1] > 0.0:
        status |= CONTACT_MISSING
    for r in range(int(regions[0])):
        if regions[2 + r * _ROW + 1] == IMPACT and regions[2 + r * _ROW] == k:
            if regions[2 + r * _ROW + 2] <= 0.0:
                status |= REGION_COVERS_PATH

    X, s, v = _reference(table, m, t)
    tangent = np.zeros(3)
    if v > 1e-6 or m[_NOW + _TARGET] > 0.0:
        tangent[:] = path_point(table, k, s)[1, :3]
    directions, targets = np.zeros(6), np.zeros(2)
    for row in range(int(_head(table, k, N_FORCE))):
        if m[_OFF + row] == 0.0:
            directions[3 * row : 3 * row + 3] = _row(table, k, row)
            targets[row] = _head(table, k, 10 + row)
    phase = np.zeros(N_PHASE)
    phase[PHASE_SEGMENT], phase[PHASE_STAGE], phase[PHASE_KIND] = k, stage, kind
    phase[PHASE_SPEED], phase[PHASE_LENGTH], phase[PHASE_STATUS] = v, s, status
    return m, X, tangent, directions, targets, phase


@numba.njit(cache=True)
def take_over(table, law, contact, t, old_table, old_memory):
    """Another pattern takes over: from the point of its first segment that is nearest
    to the reference, at the speed that the reference has along it.

    Returns: its memory, and how long the blend from the old one takes [s]: blend_sec,
        or longer, so that what the blend adds stays about within a_max.
    """
    X, _, _ = _reference(old_table, old_memory, t)
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
    m = start(table, contact, t, speed)
    m[_INIT] = 2.0  # It does not wait for its first time.
    m[_NOW + _S0] = s
    gap, dv = 0.0, 0.0
    for i in range(6):
        gap += (X[0, i] - D[0, i]) ** 2
        dv += (X[1, i] - speed * D[1, i]) ** 2
    T = np.sqrt(2.0 * BEND_MAX * np.sqrt(gap) / law.acceleration_max)
    # The gap grows by dv t: S'' dv t and 2 S' dv add up to about 6 dv / T.
    return m, max(law.blend_sec, T, 6.0 * np.sqrt(dv) / law.acceleration_max)


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
    """(n, N_EXPECTED) rows of a belief, as plan takes them."""
    rows = np.zeros((len(belief.contacts), N_EXPECTED))
    for row, c in zip(rows, belief.contacts, strict=True):
        sigma = np.sqrt(c.direction @ c.covariance @ c.direction)
        row[:3], row[3:6], row[6] = c.mean, c.direction, sigma
        row[7:] = c.kind, c.segment, c.approach_speed
    return rows


@numba.njit(cache=True)
def plan(table, law, memory, t, contacts):
    """Regions (N_REGIONS,) of the expected contacts.

    Args: contacts (n, N_EXPECTED); memory as tick has it: the offset of the running
        segment counts. A contact that the path does not approach has no region.
    """
    regions = np.zeros(N_REGIONS)
    current, offset, later = -1, np.zeros(3), np.zeros(3)
    if memory[_INIT] > 0.0:
        current = int(memory[_NOW + _SEG])
        later[:] = memory[_C : _C + 3]
        offset[:] = later
        for f in range(_N_FADES):
            b = _FADES + f * _FADE
            if memory[b + 7] > 0.0:
                rest = 1.0 - unit_step((t - memory[b + 6]) / memory[b + 7])[0]
                _add_along(offset, memory[b : b + 3], rest)
    count, status = 0, 0
    for i in range(contacts.shape[0]):
        c = contacts[i]
        k = int(c[8])
        if not (_finite(c[:9]) and 0 <= k < table[0]) or c[7] == NO_CONTACT:
            status |= BAD_INPUT
            continue
        if count == REGIONS_MAX:
            status |= BAD_INPUT
            break
        speed = c[9]
        if c[7] == IMPACT and not speed >= law.speed_min:
            speed = law.speed_min
            status |= SPEED_FLOOR
        speed = min(speed, 10.0)
        half = law.sigmas * c[6] + law.margin
        before = half
        if c[7] == IMPACT:
            before += speed * law.settle_sec
        d = c[3:6]
        shift = 0.0
        if k == current:  # The nearer of what it is now and what it will be.
            shift = max(_dot(offset, d), _dot(later, d))
        entry, leave = _crossing(table, law, k, c[:3], d, shift, before, half)
        if entry == np.inf:
            continue
        at = 2 + count * _ROW
        regions[at], regions[at + 1], regions[at + 2] = k, c[7], entry
        regions[at + 3], regions[at + 4] = leave, speed
        count += 1
    regions[0], regions[1] = count, status
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
    plan(pattern.table, law, memory, 0.0, np.zeros((0, N_EXPECTED)))
    take_over(pattern.table, law, contact, 0.0, pattern.table, memory)
