"""Linear complementarity system (LCS): one linearised time step with contact.

    x_next = A x + B u + D lam + d,   0 <= lam  perp  w = E x + F lam + H u + c >= 0

lam is a force [N] everywhere in makebreak; w is a velocity (gap over time step) [m/s].

Source: Huang, Aydinoglu, Jin, Posa, "Adaptive contact-implicit model predictive
control with online residual learning" (ACI-MPC), definition 2.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.numerics.lcp import solve_lcp


@dataclass(frozen=True, eq=False)  # eq=False: == on arrays has no truth value.
class LCS:
    """State x [SI], input u [SI], contact force lam [N], gap velocity w [m/s]."""

    A: np.ndarray  # (n_x, n_x)
    B: np.ndarray  # (n_x, n_u)
    D: np.ndarray  # (n_x, n_lam)
    d: np.ndarray  # (n_x,)
    E: np.ndarray  # (n_lam, n_x)
    F: np.ndarray  # (n_lam, n_lam)
    H: np.ndarray  # (n_lam, n_u)
    c: np.ndarray  # (n_lam,)
    dt: float  # Time step [s].
    # Gap of the contact that each force acts at, where the system was linearised [m];
    # infinite where w holds no gap (a friction force of its own). None where the LCS
    # does not come from geometry. It informs, w does not use it.
    phi: np.ndarray | None = None  # (n_lam,)

    def __post_init__(self):
        if not self.dt > 0.0:
            raise ValueError(f"LCS.dt is {self.dt}, expected a positive time [s]")
        (n_x, n_lam), n_u = np.shape(self.D), np.shape(self.B)[-1]
        shapes = dict(A=(n_x, n_x), B=(n_x, n_u), D=(n_x, n_lam), d=(n_x,))
        shapes |= dict(E=(n_lam, n_x), F=(n_lam, n_lam), H=(n_lam, n_u), c=(n_lam,))
        if self.phi is not None:
            shapes["phi"] = (n_lam,)
        fields = vars(self)
        for name, shape in shapes.items():
            fields[name] = _own(name, fields[name], shape)

    def __deepcopy__(self, memo) -> "LCS":
        """Itself: nothing in it can change. Drake copies all state at each update."""
        return self

    @property
    def n_x(self) -> int:
        return self.D.shape[0]

    @property
    def n_u(self) -> int:
        return self.B.shape[1]

    @property
    def n_lam(self) -> int:
        return self.D.shape[1]

    def with_residual(self, r_comp) -> "LCS":
        """This LCS with the offset c + r_comp, r_comp (n_lam,) [m/s] (eq. 12)."""
        lcs = object.__new__(LCS)  # The other fields have been checked.
        vars(lcs).update(vars(self), c=_own("c", self.c + r_comp, (self.n_lam,)))
        return lcs


def _own(name, value, shape):
    """A read-only copy of an array of floats. Raises: ValueError for another shape."""
    value = np.array(value, dtype=float)
    if value.shape != shape:
        raise ValueError(f"LCS.{name} is {value.shape}, expected {shape}")
    value.setflags(write=False)
    return value


def is_finite_model(lcs: LCS) -> bool:
    """Whether every number of the model itself is (phi only informs)."""
    return _all_finite(lcs.A, lcs.B, lcs.D, lcs.d, lcs.E, lcs.F, lcs.H, lcs.c)


@njit(cache=True)
def _all_finite(A, B, D, d, E, F, H, c):
    for matrix in (A, B, D, E, F, H):
        if not is_finite(matrix):
            return False
    return is_finite(d) and is_finite(c)


@njit(cache=True)
def is_finite(numbers):
    """Whether all numbers of an array are. np.isfinite(x).all() takes five times as
    long for a few."""
    for number in numbers.flat:
        if not np.isfinite(number):
            return False
    return True


def simulate(lcs: LCS, x, u):
    """One time step after x (n_x,) under u (n_u,).

    Returns: x_next (n_x,) and lam (n_lam,) [N].
    Raises: ValueError if no contact force satisfies the complementarity (lcp.py).
    """
    lam = solve_lcp(lcs.F, lcs.E @ x + lcs.H @ u + lcs.c)
    return lcs.A @ x + lcs.B @ u + lcs.D @ lam + lcs.d, lam
