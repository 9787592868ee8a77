"""Linear bounds on a step's state, input and contact forces, for C3.

    lower <= x' x_{k+1} + u' u_k + lam' lam_k <= upper,    k = 0 .. N - 1

Each is one more state of the LCS, which costs nothing and acts on nothing: what the sum
is after the step. Its bounds are then bounds of a state, which c3_bounds.py meets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from makebreak.systems.contact_mpc.numerics.c3_plan import Plan, WarmStart
from makebreak.systems.contact_mpc.numerics.lcs import LCS


@dataclass
class LinearBound:
    """Factors on x (n_x,), u (n_u,) and lam (n_lam,), and bounds of the sum; None: 0,
    or no bound. A bound on a contact's force has a 1 at its rows of lam."""

    x: np.ndarray | None = None
    u: np.ndarray | None = None
    lam: np.ndarray | None = None
    lower: float | None = None
    upper: float | None = None


def rows_of(bounds: Sequence[LinearBound], n_x: int, n_u: int, n_lam: int):
    """G_x (m, n_x), G_u (m, n_u), G_lam (m, n_lam), lower (m,) and upper (m,).

    Raises: ValueError for a wrong size, or a number that is not finite.
    """
    parts = []
    for name, n in (("x", n_x), ("u", n_u), ("lam", n_lam)):
        G = np.zeros((len(bounds), n))
        for i, bound in enumerate(bounds):
            row = getattr(bound, name)
            if row is None:
                continue
            row = np.asarray(row, dtype=float)
            if row.shape != (n,) or not np.isfinite(row).all():
                raise ValueError(
                    f"LinearBound {i}: {name} is {row}, expected {n} finite numbers"
                )
            G[i] = row
        parts.append(G)
    lower = np.array([-np.inf if b.lower is None else b.lower for b in bounds])
    upper = np.array([np.inf if b.upper is None else b.upper for b in bounds])
    return *parts, lower, upper


def with_sums(lcs: LCS, G_x, G_u, G_lam) -> LCS:
    """The LCS with the sums after the step as further states, at the end of x."""
    m, n_x = G_x.shape
    A = np.zeros((n_x + m, n_x + m))
    A[:n_x, :n_x], A[n_x:, :n_x] = lcs.A, G_x @ lcs.A
    return replace(
        lcs,
        A=A,
        B=np.vstack([lcs.B, G_x @ lcs.B + G_u]),
        D=np.vstack([lcs.D, G_x @ lcs.D + G_lam]),
        d=np.concatenate([lcs.d, G_x @ lcs.d]),
        E=np.hstack([lcs.E, np.zeros((lcs.n_lam, m))]),
        J=None,
    )


def widened(a, n_x: int, m: int, value=0.0):
    """An array whose last axis begins with x (n_x,), with m further states."""
    if a is None:
        return None
    a = np.asarray(a, dtype=float)
    return np.insert(a, [n_x] * m, value, axis=-1)


def without_sums(plan: Plan, warm: WarmStart, n_x: int, m: int):
    """The plan and the warm start without the further states."""

    def narrow(a):
        return np.delete(a, np.arange(n_x, n_x + m), axis=-1)

    return (
        replace(plan, x=np.ascontiguousarray(plan.x[:, :n_x])),
        WarmStart(warm.u, narrow(warm.delta), narrow(warm.w)),
    )
