"""What stairs of commands do to joints beside the line through the middles of steps.

A drive that gets a new command every 10 ms pulls hard after each and little before the
next. A smoothed motion does not show that; a simulation that starts from it would
swing for some of the loop's time constants.
"""

import numpy as np
from scipy.linalg import expm

PARTS = 16  # Of a step, in which the input is taken as constant.
STEPS = 25  # Of the stairs, before the instant asked for, that still count.


def beside_line(
    mobility: np.ndarray,
    kp: np.ndarray,
    kd: np.ndarray,
    since: np.ndarray,
    held: np.ndarray,
    at: float,
) -> tuple[np.ndarray, np.ndarray]:
    """By how much joints are beside what they would do if commands went along a line:
    positions (n,) and velocities (n,) at an instant [s].

        M dv/dt = kp (stairs(t) - line(t) - dq) - kd dv,   nothing STEPS steps before

    The line goes through the middle of each step, of longer ones half a usual step
    from their ends.

    Args: mobility: (n, n) M^-1. kp, kd: (n,) gains of drives, zero of others. since:
        (m,) instants [s] of steps, from which commands held (m, n) hold.
    """
    n, none = len(kp), (np.zeros(len(kp)), np.zeros(len(kp)))
    first, last = np.searchsorted(since, at, "right") - 1 - STEPS, len(since)
    if first < 0 or last - first < STEPS + 3:
        return none
    some = slice(first, first + STEPS + 3)
    since, held = since[some], held[some]
    usual = float(np.median(np.diff(since)))
    # Of a longer step two points, half a usual step from its ends.
    ends = np.maximum(since[1:] - 0.5 * usual, 0.5 * (since[1:] + since[:-1]))
    starts = np.minimum(since[:-1] + 0.5 * usual, 0.5 * (since[1:] + since[:-1]))
    x = np.column_stack([starts, ends + 1e-9 * usual]).ravel()
    h = usual / PARTS
    edges = np.arange(at, max(since[0], at - STEPS * usual), -h)[::-1]
    middle = 0.5 * (edges[1:] + edges[:-1])
    off = np.empty((len(middle), n))
    for i, y in enumerate(held[:-1].T):
        area = np.append(0.0, np.cumsum(y * np.diff(since)))
        stairs = np.diff(np.interp(edges, since, area)) / h
        off[:, i] = stairs - np.interp(middle, x, np.repeat(y, 2))
    A = np.zeros((3 * n, 3 * n))
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n] = mobility @ np.column_stack([-np.diag(kp), -np.diag(kd), np.diag(kp)])
    step = expm(h * A)
    keep, take = step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :]
    state = np.zeros(2 * n)
    for u in off:
        state = keep @ state + take @ u
    return state[:n], state[n:]
