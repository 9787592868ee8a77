"""How a motion passes from one segment of its pattern to the next, and what contacts
that come or go do to it."""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.contact_task import (
    BROKEN,
    BROKEN_ROW,
    CONTACT_UNEXPECTED,
    DIRECTION,
    IMPACT,
    MADE,
    NO_CONTACT,
)
from makebreak.systems.changing_contact.numerics.path_geometry import (
    IN_CONTACT,
    IN_LOSS,
    LENGTH,
    N_FORCE,
    add_along,
    force_direction,
    head,
    path_point,
)
from makebreak.systems.changing_contact.numerics.shaped_reference import (
    fade_out,
    reference,
)
from makebreak.systems.changing_contact.numerics.shaper_memory import COASTS
from makebreak.systems.changing_contact.numerics.speed_track import (
    N_STEPS,
    begin_step,
    motion_at,
    start_track,
    steady_from,
)
from makebreak.systems.numerics.few_numbers import all_finite, dot

# Cosines of two directions that are one, and of a contact that is ahead.
SAME_DIRECTION, AHEAD = 1.0 - 1e-6, 0.5
# After a contact was lost, force control presses on. If the tip then moves by LOST_WAY
# within LOST_SEC, there is no surface: force control closes gaps at 12 mm/s or more.
LOST_WAY, LOST_SEC = 0.005, 1.0  # [m], [s]


@numba.njit(cache=True)
def _has_direction(table, k, n):
    """Whether segment k has the force direction n (3,)."""
    for row in range(int(head(table, k, N_FORCE))):
        if dot(force_direction(table, k, row), n) > SAME_DIRECTION:
            return True
    return False


@numba.njit(cache=True)
def change_segment(table, m, law, t, pose, X, s_end, s_start):
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
    fade_out(m, law, t, C)
    m.now.segment = k + 1.0
    for row in range(2):
        m.off[row] = m.lost_time[row] = 0.0
    m.sticky = 0.0
    m.enter_time, m.region_kind = -1.0, NO_CONTACT


@numba.njit(cache=True)
def _after_contact(table, m, law, t, pose, X):
    """After the contact that ends this segment: it runs out, the next one starts."""
    slot, first = 0, np.inf
    for c in range(COASTS):
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
    change_segment(table, m, law, t, pose, X, coast.s_end, 0.0)
    start_track(m.now, t, m.now.segment, 0.0)
    m.settle_until, m.settle_kind = t + law.blend_sec, IMPACT


@numba.njit(cache=True)
def go_on(table, m, law, t, pose, X):
    """Changes to the next segment on the same line, without a stop."""
    L = head(table, int(m.now.segment), LENGTH)
    change_segment(table, m, law, t, pose, X, L, 0.0)
    m.now.s0 -= L


@numba.njit(cache=True)
def handle_events(table, m, law, t, contact, pose):
    """Handles what the contact detector has reported since the last tick."""
    made = contact[MADE] > m.made
    broken = contact[BROKEN] > m.broken
    m.made, m.broken = contact[MADE], contact[BROKEN]
    if m.held > 0.0 or m.ended > 0.0 or not (made or broken):
        return
    k = int(m.now.segment)
    X, s, _, _ = reference(table, m, t)
    if made:
        tangent = path_point(table, k, s)[1, :3]
        # Else an echo of the last.
        aligned = dot(contact[DIRECTION], tangent) > AHEAD
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
            go_on(table, m, law, t, pose, X[0])
        elif m.off[row] == 0.0 and all_finite(pose):
            n = force_direction(table, k, row)
            m.lost_time[row], m.lost_at[row] = t, dot(n, pose)


@numba.njit(cache=True)
def watch_lost(table, m, t, pose):
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
            X, _, _, _ = reference(table, m, t)
            add_along(m.c, n, dot(n, pose) - dot(n, X[0]))
