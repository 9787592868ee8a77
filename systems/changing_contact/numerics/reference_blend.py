"""From one reference to another without a step."""

import numba
import numpy as np

from makebreak.systems.changing_contact.numerics.push_motion import N_FRAME
from makebreak.systems.changing_contact.numerics.velocity_profile import unit_step
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_TIP, V_TIP

# A blend: the weight at its start, the weight that it goes to, when it starts [s].
N_BLEND = 3
_P_TIP, _V_TIP = P_TIP.start, V_TIP.start
# What the arm's controller reads: x_desired, wrench, damping, force_directions,
# force_targets.
COMMAND = (19, 6, 6, 6, 2)


@numba.njit(cache=True)
def weight(blend, t, duration_sec):
    """Weight of the second reference at time t, and its two derivatives [1/s], [1/s2].

    Args: blend (N_BLEND,).
    """
    S, slope, bend = unit_step((t - blend[2]) / duration_sec)
    change = blend[1] - blend[0]
    return (
        blend[0] + change * S,
        change * slope / duration_sec,
        change * bend / duration_sec**2,
    )


@numba.njit(cache=True)
def blended_reference(first, second, w, w1, w2):
    """x_desired (19,) between two, w of the second one, its derivatives w1, w2.

    Orientations are the second's while it has any weight: both are upright here.
    """
    out = first.copy() if w == 0.0 else second.copy()
    for i in range(3):
        gap = second[i] - first[i]
        gap1 = second[7 + i] - first[7 + i]
        gap2 = second[13 + i] - first[13 + i]
        out[i] = first[i] + w * gap
        out[7 + i] = first[7 + i] + w * gap1 + w1 * gap
        out[13 + i] = first[13 + i] + w * gap2 + 2.0 * w1 * gap1 + w2 * gap
    return out


@numba.njit(cache=True)
def in_world(t, frame, shaped, rows, x):
    """The shaper's reference (19,) in the world. Where `rows` (6,) says that force
    decides, the arm is where it is in x (N_X,), and goes on from there.

    Args: frame (N_FRAME,) in which `shaped` (19,) is planned.
    """
    out = shaped.copy()
    for i in range(3):
        out[i] += frame[i] + (t - frame[6]) * frame[3 + i]
        out[7 + i] += frame[3 + i]
    for n in (rows[:3], rows[3:]):
        if n[0] * n[0] + n[1] * n[1] + n[2] * n[2] > 0.5:
            off = speed = acceleration = 0.0
            for i in range(3):
                off += n[i] * (x[_P_TIP + i] - out[i])
                speed += n[i] * (x[_V_TIP + i] - out[7 + i])
                acceleration += n[i] * out[13 + i]
            for i in range(3):
                out[i] += off * n[i]
                out[7 + i] += speed * n[i]
                out[13 + i] -= acceleration * n[i]
    return out


@numba.njit(cache=True)
def mixed(t, blend, duration_sec, planned, frame, shaped, rows, x):
    """x_desired (19,) between `planned` and the shaper's, in the world."""
    w, w1, w2 = weight(blend, t, duration_sec)
    if w == 0.0 and w1 == 0.0:
        return planned.copy()
    second = in_world(t, frame, shaped, rows, x)
    return blended_reference(planned, second, w, w1, w2)


@numba.njit(cache=True)
def command(
    t, blend, soft, duration_sec, dampings, planned, frame, shaped, rows, x,
    planned_wrench, fed, targets,
):  # fmt: skip
    """All that the arm's controller reads, one after the other as in COMMAND.

    Args: blend, soft (N_BLEND,): of the shaper's weight, and of the damping where an
        impact is expected; dampings (2,): otherwise, and there [N s/m]; planned_wrench
        (6,) and fed (6,): forces of both references; targets (2,) [N].
    """
    out = np.zeros(39)
    out[:19] = mixed(t, blend, duration_sec, planned, frame, shaped, rows, x)
    w = weight(blend, t, duration_sec)[0]
    damping = dampings[0] + weight(soft, t, duration_sec)[0] * (
        dampings[1] - dampings[0]
    )
    for i in range(6):
        out[19 + i] = (1.0 - w) * planned_wrench[i] + w * fed[i]
        out[25 + i] = damping
    if blend[1] > 0.5:  # The shaper leads.
        out[31:37] = rows
        out[37:] = targets
    return out


def warm_up() -> None:
    """Compiles all, for read-only arrays as a Context's state is."""
    blend, ports = np.zeros(N_BLEND), [np.zeros(n) for n in (19, N_FRAME, 19, 6, N_X)]
    blend.setflags(write=False)
    mixed(0.0, blend, 1.0, *ports)
    in_world(0.0, *ports[1:])
    six = np.zeros(6)
    ports += [six, six, np.zeros(2)]
    command(0.0, blend, blend, 1.0, np.zeros(2), *ports)
