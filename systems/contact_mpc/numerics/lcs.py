"""Linear complementarity system (LCS): one linearised time step with contact.

    x_next = A x + B u + D lam + d,   0 <= lam  perp  w = E x + F lam + H u + c >= 0

lam is a force [N] everywhere in makebreak; w is a velocity (gap over time step) [m/s].

Source: Huang, Aydinoglu, Jin, Posa, "Adaptive contact-implicit model predictive
control with online residual learning" (ACI-MPC), definition 2.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from makebreak.systems.contact_mpc.numerics.lcp import solve_lcp


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
    # Likewise: what each force pushes along (w grows with J v_next, x = [q, v]), and
    # the number of its contact, the same in the LCS of every state.
    J: np.ndarray | None = None  # (n_lam, n_v)
    contact: np.ndarray | None = None  # (n_lam,)

    def __post_init__(self):
        if not self.dt > 0.0:
            raise ValueError(f"LCS.dt is {self.dt}, expected a positive time [s]")
        (n_x, n_lam), n_u = np.shape(self.D), np.shape(self.B)[-1]
        shapes = dict(A=(n_x, n_x), B=(n_x, n_u), D=(n_x, n_lam), d=(n_x,))
        shapes |= dict(E=(n_lam, n_x), F=(n_lam, n_lam), H=(n_lam, n_u), c=(n_lam,))
        if self.phi is not None:
            shapes["phi"] = (n_lam,)
        if self.J is not None:
            shapes["J"] = (n_lam, np.shape(self.J)[-1])
        if self.contact is not None:
            shapes["contact"] = (n_lam,)
        fields = vars(self)
        for name, shape in shapes.items():
            fields[name] = _own(name, fields[name], shape)

    def __deepcopy__(self, memo) -> "LCS":
        """Itself: nothing in it can change. Drake copies all state at each update."""
        return self

    @property
    def n_x(self) -> int:
        """Length of the state."""
        return self.D.shape[0]

    @property
    def n_u(self) -> int:
        """Length of the input."""
        return self.B.shape[1]

    @property
    def n_lam(self) -> int:
        """Number of contact forces."""
        return self.D.shape[1]

    def with_residual(self, r_comp, phi_more=None) -> "LCS":
        """This LCS with the offset c + r_comp, r_comp (n_lam,) [m/s] (eq. 12), and with
        phi + phi_more (n_lam,) [m]."""
        lcs = object.__new__(LCS)  # The other fields have been checked.
        n = (self.n_lam,)
        vars(lcs).update(vars(self), c=_own("c", self.c + r_comp, n))
        if phi_more is not None:
            vars(lcs).update(phi=_own("phi", self.phi + phi_more, n))
        return lcs


def _own(name, value, shape):
    """A read-only copy of an array of floats. Raises: ValueError for another shape."""
    value = np.array(value, dtype=float, order="C")  # Else compiled for each layout.
    if value.shape != shape:
        raise ValueError(f"LCS.{name} is {value.shape}, expected {shape}")
    value.setflags(write=False)
    return value


def is_finite_model(lcs: LCS) -> bool:
    """Whether every number of the model itself is (phi, J and contact only inform)."""
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


def opening_speed(lcs: LCS, x_next, noise=0.0):
    """How fast Anitescu's contact opens as it slides, (n_lam,) [m/s]: mu |v_t|.

    A contact that slides is felt from a distance of dt mu |v_t| in that model. With the
    speed that was measured at the step's end added to its gap velocity it is Coulomb's:
    its normal part then is that of the gap alone (De Saxce, Feng, Mathematical and
    Computer Modelling 28 (1998)).

    Args: x_next (n_x,) after the step; noise [m/s]: of mu |v_t|, less than which counts
        as none; infinite: all of it.
    Returns: zeros where the LCS does not say what its forces push along.
    """
    if lcs.J is None or lcs.contact is None or np.isinf(noise):
        return np.zeros(lcs.n_lam)
    along = lcs.J @ x_next[-lcs.J.shape[1] :]
    phi = np.zeros(lcs.n_lam) if lcs.phi is None else lcs.phi
    return _opening(along, lcs.contact, phi, float(noise))


@njit(cache=True)
def _opening(along, contact, phi, noise):
    """Args: along (n_lam,) speeds of the rows; phi: infinite where w holds no gap."""
    n = len(along)
    speed = np.zeros(n)
    for i in range(n):
        if not np.isfinite(phi[i]):
            continue
        total, least, count = 0.0, np.inf, 0
        for j in range(n):
            if contact[j] == contact[i] and np.isfinite(phi[j]):
                total, least, count = total + along[j], min(least, along[j]), count + 1
        # The edges come in opposite pairs: their mean is the normal's speed.
        slip = total / count - least
        speed[i] = np.sqrt(max(slip**2 - noise**2, 0.0))
    return speed


def simulate(lcs: LCS, x, u):
    """One time step after x (n_x,) under u (n_u,).

    Returns: x_next (n_x,) and lam (n_lam,) [N].
    Raises: ValueError if no contact force satisfies the complementarity (lcp.py).
    """
    lam = solve_lcp(lcs.F, lcs.E @ x + lcs.H @ u + lcs.c)
    return lcs.A @ x + lcs.B @ u + lcs.D @ lam + lcs.d, lam


# What is known of an entry of lam: nothing; it is zero; its w is zero.
FREE, OPEN, CLOSED = 0, 1, 2


def contact_modes(models, x0, u):
    """The modes that inputs lead to: (N, n_lam) of FREE, OPEN and CLOSED.

    Args: models: one LCS, or N of them in a list; x0 (n_x,); u (N, n_u).
    Returns: OPEN where w > 0, CLOSED where lam > 0, FREE where neither is (to 1e-9 of
        the largest), step by step from x0.
    Raises: ValueError as `simulate`.
    """
    models = [models] if isinstance(models, LCS) else models
    x, modes = np.asarray(x0, float), []
    for k, u_k in enumerate(u):
        lcs = models[k % len(models)]
        w_free = lcs.E @ x + lcs.H @ u_k + lcs.c
        x, lam = simulate(lcs, x, u_k)
        w = w_free + lcs.F @ lam
        mode = np.where(w > 1e-9 * max(1e-12, np.abs(w_free).max()), OPEN, FREE)
        mode[lam > 1e-9 * max(1e-12, lam.max())] = CLOSED
        modes.append(mode)
    return np.array(modes)


def fix_modes(lcs: LCS, modes) -> LCS:
    """The LCS in which some contacts stay open and others stay closed, of equal sizes.

    A closed one's force lam_S = -F_SS^-1 (E_S x + H_S u + F_SR lam_R + c_S) is put into
    everything else, whatever its sign (where F_SS is singular: the smallest such
    force). Its own row, and that of an open one, holds nothing any more: lam = 0,
    w = lam + 1.

    Args: modes (n_lam,), each FREE, OPEN or CLOSED. See `fixed_forces`.
    """
    modes = np.asarray(modes)
    on, free = np.flatnonzero(modes == CLOSED), np.flatnonzero(modes == FREE)
    if len(free) == lcs.n_lam:
        return lcs
    X_x, X_u, X_lam, X_1 = _closed(lcs, on, free)
    n, D_S, F_S = lcs.n_lam, lcs.D[:, on], lcs.F[np.ix_(free, on)]
    D, E, F = np.zeros((lcs.n_x, n)), np.zeros((n, lcs.n_x)), np.eye(n)
    H, c = np.zeros((n, lcs.n_u)), np.ones(n)
    D[:, free] = lcs.D[:, free] - D_S @ X_lam
    E[free], H[free] = lcs.E[free] - F_S @ X_x, lcs.H[free] - F_S @ X_u
    F[np.ix_(free, free)] = lcs.F[np.ix_(free, free)] - F_S @ X_lam
    c[free] = lcs.c[free] - F_S @ X_1
    A, B, d = lcs.A - D_S @ X_x, lcs.B - D_S @ X_u, lcs.d - D_S @ X_1
    return LCS(A, B, D, d, E, F, H, c, lcs.dt, lcs.phi)


def fixed_forces(lcs: LCS, modes, x, u, lam):
    """lam (n_lam,) of the whole LCS, from that of `fix_modes` at x (n_x,), u (n_u,)."""
    modes = np.asarray(modes)
    on, free = np.flatnonzero(modes == CLOSED), np.flatnonzero(modes == FREE)
    X_x, X_u, X_lam, X_1 = _closed(lcs, on, free)
    whole = np.zeros(lcs.n_lam)
    whole[free] = lam[free]
    whole[on] = -(X_x @ x + X_u @ u + X_lam @ lam[free] + X_1)
    return whole


def _closed(lcs, on, free):
    """F_SS^-1 times E_S, H_S, F_SR and c_S."""
    parts = lcs.E[on], lcs.H[on], lcs.F[np.ix_(on, free)], lcs.c[on, None]
    whole = np.hstack(parts)
    if len(on):
        F_S = lcs.F[np.ix_(on, on)]
        whole = np.linalg.lstsq(F_S, whole, rcond=1e-10)[0]
    ends = np.cumsum([part.shape[1] for part in parts])
    *first, last = np.split(whole, ends[:-1], axis=1)
    return *first, last[:, 0]
