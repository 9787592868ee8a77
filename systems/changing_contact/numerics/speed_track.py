"""Arc length over time along a segment, as a constant speed and smooth steps of it.

    ds/dt = v_0 + sum_i dv_i S((t - t_i) / T_i),    T_i = 2 |dv_i| / a_max

with S of equation 11, so the speed is smooth in all orders whatever steps begin while
others run, and s is known in closed form. A step that begins later never ends earlier,
which keeps the speed from turning negative, and takes longer than 2 |dv| / a_max where
the sum of all steps would have an acceleration above a_max else.

A track is a record of float64 alone, TRACK, so that it can be part of a vector in a
Context. Functions change it in place. `law` is a ShaperLaw (shaper_memory.py).

Source: Sidhik et al., section 3.5.2.
"""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.velocity_profile import (
    unit_step,
    unit_step_integral,
)

LOOKED_AT = 64  # Instants of a step at which the acceleration of all is looked at,
LONGER, LONGEST = 1.05, 100.0  # which makes it so many times as long, at most.
SLACK = 1.005  # Of acceleration_max, which two steps together may reach.
STEP_SEC_MIN = 0.05  # Of a change of speed, however small: bounds the jerk.
N_STEPS = 12  # At once, at most.

STEP = np.dtype(  # Of the speed: [s], [s], [m/s].
    [("start", float), ("duration", float), ("change", float)], align=True
)
TRACK = np.dtype(
    [
        ("segment", float),  # Of the pattern; -1: the track is not in use.
        ("s0", float),  # Arc length [m],
        ("t0", float),  # at this time [s],
        ("v0", float),  # with this speed [m/s], but for the steps.
        ("target", float),  # The speed after all steps [m/s].
        ("n_steps", float),  # How many of the rows below are in use.
        ("steps", STEP, N_STEPS),
    ],
    align=True,
)


@numba.njit(cache=True)
def motion_at(track, t):
    """Arc length [m], speed [m/s] and acceleration [m/s2] of a track at time t [s]."""
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
def steady_from(track, t):
    """When the last step of a track ends [s]; t if none runs."""
    end = t
    for i in range(int(track.n_steps)):
        step = track.steps[i]
        end = max(end, step.start + step.duration)
    return end


@numba.njit(cache=True)
def absorb_ended_steps(track, t):
    """Steps that have ended by time t become part of the constant speed, in place."""
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
def step_duration(law, dv):
    """How long a change of speed by dv [m/s] takes within acceleration_max [s]."""
    return max(2.0 * abs(dv) / law.acceleration_max, STEP_SEC_MIN)


@numba.njit(cache=True)
def duration_beside(track, law, t, dv):
    """How long a change of speed by dv [m/s] that begins at time t [s] takes beside the
    steps that run [s]: it ends no earlier than they do, and all of them together stay
    within acceleration_max, to 1 %. (They do without it; the longer it is, the less it
    adds.)
    """
    T = max(step_duration(law, dv), steady_from(track, t) - t)
    adds_up = False  # Of opposite signs neither makes the other larger.
    for i in range(int(track.n_steps)):
        adds_up |= track.steps[i].change * dv > 0.0
    if not adds_up:
        return T
    longest = LONGEST * T
    while T < longest:
        most = 0.0
        for i in range(1, LOOKED_AT):
            tau = i / LOOKED_AT
            a = motion_at(track, t + tau * T)[2] + dv / T * unit_step(tau)[1]
            most = max(most, abs(a))
        if most <= SLACK * law.acceleration_max:
            break
        T *= LONGER
    return T


@numba.njit(cache=True)
def begin_step(track, law, t, target):
    """Adds a step to the speed `target` [m/s] that begins at time t [s] and ends no
    earlier than those that run; adds none if N_STEPS run already."""
    n = int(track.n_steps)
    dv = target - track.target
    if n == N_STEPS or dv == 0.0:
        return
    step = track.steps[n]
    step.start, step.change = t, dv
    step.duration = duration_beside(track, law, t, dv)
    track.n_steps += 1.0
    track.target = target


@numba.njit(cache=True)
def start_track(track, t, segment, speed):
    """Makes the track begin on a segment at time t [s], with constant speed [m/s]."""
    track.segment, track.s0, track.t0 = segment, 0.0, t
    track.v0, track.target, track.n_steps = speed, speed, 0.0


@numba.njit(cache=True)
def time_to_brake(track, law, t, s_limit, v_limit):
    """When to begin the step down to v_limit [m/s] that ends at the arc length s_limit
    [m]: a time [s] in this tick, or inf: in a later one, or never."""
    v = track.target
    if not v > v_limit:
        return np.inf
    steady = steady_from(track, t)
    T = duration_beside(track, law, t, v_limit - v)
    # Where it would be slow if it began now: after `steady` the speed is v.
    s_end = motion_at(track, steady)[0] + v * (t + T - steady) - 0.5 * (v - v_limit) * T
    wait = (s_limit - s_end) / v
    if wait <= 0.0:
        return t
    return t + wait if wait <= law.period and steady <= t else np.inf


@numba.njit(cache=True)
def highest_speed(law, v, v_limit, distance):
    """The highest speed [m/s] to go to from v if v_limit is to be reached again after
    `distance` [m]; v_limit if there is no room for going faster."""
    if distance <= 0.0:
        return v_limit
    a = law.acceleration_max
    v_peak = np.sqrt(max(0.5 * (a * distance + v * v + v_limit * v_limit), 0.0))
    way = 0.5 * (v + v_peak) * step_duration(law, v_peak - v)
    way += 0.5 * (v_peak + v_limit) * step_duration(law, v_peak - v_limit)
    if v_peak <= 1.05 * v_limit or way > distance * (1.0 + 1e-9):
        return v_limit
    return v_peak


@numba.njit(cache=True)
def time_until(track, law, t, s_limit):
    """How long until the arc length s_limit is reached, at most 10 blend_sec [s]."""
    far = 10.0 * law.blend_sec
    steady = steady_from(track, t)
    s_steady = motion_at(track, steady)[0]
    if s_steady <= s_limit:
        v = track.target
        return min(far, steady - t + (s_limit - s_steady) / v) if v > 0.0 else far
    low, high = t, steady
    for _ in range(12):
        middle = 0.5 * (low + high)
        if motion_at(track, middle)[0] < s_limit:
            low = middle
        else:
            high = middle
    return high - t
