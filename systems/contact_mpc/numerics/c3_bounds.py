"""The QP of C3 with bounds: lower <= [u_k, x_k] <= upper beside what c3_qp.py solves.

A dual active-set method solves it (c3_active_set.py): as a rule few bounds are active.
Where very many are, or rounding leaves it undecided, an interior point method takes
over (c3_interior.py).
"""

from numba import njit

from makebreak.systems.contact_mpc.numerics.c3_active_set import MET, solve_active
from makebreak.systems.contact_mpc.numerics.c3_interior import (
    IPM_STARTS,
    solve_interior,
)
from makebreak.systems.contact_mpc.numerics.c3_qp import solve


@njit(cache=True)
def within(x, v, lower, upper):
    """Whether u and x of all knots but x_0 obey lower and upper ((n,), over [v, x])."""
    n_v = v.shape[1]
    for k in range(v.shape[0]):
        for i in range(n_v):
            if not lower[i] <= v[k, i] <= upper[i]:
                return False
        for i in range(x.shape[1]):
            if not lower[n_v + i] <= x[k + 1, i] <= upper[n_v + i]:
                return False
    return True


@njit(cache=True)
def solve_bounded(fac, T, T_N, h, x0, v0_fixed, lower, upper, sides, x, v):
    """The minimiser within bounds; x and v hold the unbounded one and are overwritten.

    Args: as of `factor` and `solve`; lower, upper: (n,) over [v, x], infinite where
        there is no bound, lower <= upper. x_0 and the fixed head of v_0 have no bounds.
        sides: (N + 1, n) integers, the bounds to try first: 1 lower, -1 upper, 0 none;
        all zero: the breached ones. Overwritten by the active ones.
    Returns: MET; CANNOT_BE_MET: a bound contradicts those that are active; UNDECIDED:
        rounding leaves open whether a plan meets the bounds.
    """
    status = solve_active(fac, h, x0, v0_fixed, lower, upper, sides, x, v)
    if status == MET:
        return MET
    sides[:] = 0
    # The active set may have left a plan that breaks the dynamics.
    solve(fac, h, x0, v0_fixed, x, v)
    for start in IPM_STARTS:
        if solve_interior(fac, T, T_N, h, v0_fixed, lower, upper, start, x, v):
            return MET
    return status
