"""The reference of a shaped motion: where it is on its path, by what it is shifted, and
what still runs out."""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.path_geometry import (
    path_point,
    rotation_motion,
)
from makebreak.systems.changing_contact.numerics.shaper_memory import FADES
from makebreak.systems.changing_contact.numerics.speed_track import motion_at
from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step
from makebreak.systems.numerics.few_numbers import dot

BEND_MAX = 9.85  # Largest value of S''.
TURN_BACK_SEC = 1.0  # Fading time of an orientation where positions stay shifted [s].


@numba.njit(cache=True)
def reference(table, m, t):
    """X and its two time derivatives (3, 6) at time t; s, v along the path, and the
    path's tangent (6,) there."""
    out = np.zeros((3, 6))
    s, v, a = motion_at(m.now, t)
    D = path_point(table, int(m.now.segment), s)
    tangent = D[1].copy()
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
    return out, s, v, tangent


@numba.njit(cache=True)
def fade_out(m, law, t, X):
    """Adds a shift X (6,) that is whole at time t and fades out, to the memory m."""
    size, turn = np.sqrt(dot(X, X)), np.sqrt(dot(X[3:], X[3:]))
    if size == 0.0 and turn == 0.0:
        return
    slot, oldest = -1, 0
    for f in range(FADES):
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
