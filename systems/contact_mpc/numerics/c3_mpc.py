"""Consensus complementarity control: model predictive control through contact.

ADMM on z_k = [x_k, lam_k, u_k] (for C3+ also eta_k, the gap velocity): copies delta of
z obey the complementarity, z obeys the dynamics, and w drives them together. A round:

    1. z <- argmin  sum (x - x_desired)'Q(x - x_desired) + (u - u_prev)'R(u - u_prev)
                        + |z - (delta - w)|^2_G  subject to dynamics, x_0, bounds
       (c3_qp.py, c3_bounds.py; the last knot's state is weighed by Q_N)
    2. delta <- projection of z + w, knot by knot (c3_projections.py)
    3. w <- (w + z - delta) / rho,  G <- rho G

and after the last round step 1 once more gives the plan (for C3+ with the target delta
instead of delta - w). Where u does not act on the gap (H = 0), lam_0 follows from x_0
alone and is fixed beforehand. c3_admm.py has these rounds; here are the problem, its
checks, and what comes before and after the rounds.

Source: Aydinoglu, Wei, Huang, Posa, arXiv:2304.11259, algorithm 1; ACI-MPC section IV.
docs/c3.md lists every choice in which implementations differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import numpy as np

from makebreak.systems.contact_mpc.numerics.c3_admm import (
    FAILURES,
    C3Failure,
    admm,
    admm_plus,
    compiled_once,
    scaled_model,
)
from makebreak.systems.contact_mpc.numerics.c3_linear import (
    LinearBound,
    rows_of,
    widened,
    with_sums,
    without_sums,
)
from makebreak.systems.contact_mpc.numerics.c3_plan import Plan, WarmStart
from makebreak.systems.contact_mpc.numerics.c3_polish import polish
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    Projection,
    QpProjection,
    projection_matrices,
)
from makebreak.systems.contact_mpc.numerics.lcp import SOLVED, solve_lcp_kernel
from makebreak.systems.contact_mpc.numerics.lcs import (
    FREE,
    LCS,
    fix_modes,
    fixed_forces,
    is_finite,
    is_finite_model,
    opening_speed,
    simulate,
)
from makebreak.systems.contact_mpc.numerics.orientation_cost import (
    orientation_quadratics,
    squared_angle,
)


def _required() -> Any:
    return field(default_factory=lambda: np.zeros(0))


@dataclass
class OrientationWeight:
    """The squared angle [rad^2] between a quaternion of x and that of x_desired."""

    start: int = 0  # Of the quaternion [w x y z] in x.
    weight: float = 0.0  # [1/rad^2]
    weight_N: float | None = None  # At the last knot; None: weight.
    # (3,) of the body: a turn about it does not count, as of what rolls. None: none.
    free_axis: list[float] | None = None


@dataclass
class C3Weights:
    """Diagonals, or matrices (G and U: diagonal ones), in the units of 1 / z^2.

    z = [x, lam, u] for C3 and [x, lam, u, eta] for C3+. All but Q_N must be given (the
    empty defaults, which C3Problem refuses, are what yaml_load_typed needs).
    """

    Q: np.ndarray = _required()  # (n_x,) state, >= 0.
    R: np.ndarray = _required()  # (n_u,) input, >= 0, and with G's u part > 0.
    G: np.ndarray = _required()  # (n_z,) consensus; lam and eta > 0, x and u >= 0.
    U: np.ndarray = _required()  # (n_z,) projection; lam and eta (C3: and x) > 0.
    Q_N: np.ndarray | None = None  # (n_x,) last state; None: Q.
    # Beside Q, which must be zero at these quaternions.
    orientation: list[OrientationWeight] = field(default_factory=list)
    # (N, n_x) diagonals of the states but the last one, in place of Q.
    Q_knots: np.ndarray | None = None


@dataclass
class C3Options:
    """Horizon, rounds and penalties of C3."""

    N: int = 5  # Number of knots of the plan, each a time step of the LCS long.
    rounds: int = 3  # Number of ADMM rounds.
    # Factor by which the consensus weights G grow from round to round, at least 1.
    rho: float = 2.0
    # Whether changes of the input cost, (u - u_prev)'R(u - u_prev); false: u'R u.
    penalise_input_change: bool = False
    # Whether the problem is solved in lam / s, with s = |A|_F / |D|_F.
    scale_lam: bool = False
    # Whether delta starts with x_0 in its x part; false: with zero.
    start_at_x0: bool = False
    warm_start: bool = False  # Whether delta and w start where the last solve ended.
    # Number of rollouts on the LCS that improve the plan (c3_polish.py); 0: none.
    polish: int = 0


@dataclass
class C3Bounds:
    """Of every u_k and of x_1 .. x_N; None, or infinite entries: no bound.

    Bounds of states are not met by contacts that pull: no contact's force lam is below
    zero and below the least that it has in the same QP without bounds.
    """

    u_lower: np.ndarray | None = None  # (n_u,) [N]
    u_upper: np.ndarray | None = None  # (n_u,) [N]
    x_lower: np.ndarray | None = None  # (n_x,) [SI]
    x_upper: np.ndarray | None = None  # (n_x,) [SI]
    # On sums of states, inputs and contact forces of a step.
    linear: list[LinearBound] = field(default_factory=list)


class C3Problem:
    """Weights, projection, options and bounds, checked once and ready for `solve_c3`.

    Raises: ValueError, naming the entry, where one is of the wrong shape or sign.
    """

    def __init__(
        self,
        weights: C3Weights,
        projection: Projection | None = None,
        options: C3Options | None = None,
        bounds: C3Bounds | None = None,
    ):
        self.projection = PlusProjection() if projection is None else projection
        self.options = C3Options() if options is None else options
        _check_options(self.options, self.projection)
        self.is_plus = isinstance(self.projection, PlusProjection)
        self.Q, self.R = _square("Q", weights.Q), _square("R", weights.R)
        self.Q_N = self.Q if weights.Q_N is None else _square("Q_N", weights.Q_N)
        self.n_x, self.n_u = len(self.Q), len(self.R)
        self._Q = self._of_knots(weights)
        self.orientation = [self._checked(o, weights) for o in weights.orientation]
        if self.Q_N.shape != self.Q.shape:
            raise ValueError(
                f"C3Weights.Q_N is {self.Q_N.shape}, expected {self.Q.shape} as Q"
            )
        self.G, self.U = _diagonal("G", weights.G), _diagonal("U", weights.U)
        self.n_z = self.G.size
        n_contact = self.n_z - self.n_x - self.n_u
        self.n_lam = n_contact // 2 if self.is_plus else n_contact
        self._check_consensus_weights(n_contact)
        bounds = C3Bounds() if bounds is None else bounds
        lower = self._bound(-np.inf, u=bounds.u_lower, x=bounds.x_lower)
        upper = self._bound(np.inf, u=bounds.u_upper, x=bounds.x_upper)
        if np.isfinite([a[self.n_lam + self.n_u :] for a in (lower, upper)]).any():
            lower[: self.n_lam] = 0.0
        self.lower, self.upper = _read_only(lower), _read_only(upper)
        for i in np.flatnonzero(~(self.lower <= self.upper)):
            raise ValueError(
                f"C3Bounds: {self.lower[i]} to {self.upper[i]} for entry "
                f"{i - self.n_lam} of [u, x], expected lower <= upper"
            )
        self.sums = rows_of(bounds.linear, self.n_x, self.n_u, self.n_lam)
        self.with_sums: C3Problem | None = None
        if bounds.linear:
            self.with_sums = self._with_sums(weights, bounds)

    def _of_knots(self, weights):
        """(1 or N, n_x, n_x) Q of the knots but the last one."""
        if weights.Q_knots is None:
            return self.Q[None]
        Q, expected = np.asarray(weights.Q_knots, float), (self.options.N, self.n_x)
        if Q.shape != expected or not ((Q >= 0.0) & (Q < np.inf)).all():
            raise ValueError(
                f"C3Weights.Q_knots is {Q.shape} of {Q.min():g} to {Q.max():g}, "
                f"expected {expected}, finite, >= 0"
            )
        return _read_only(np.array([np.diag(row) for row in Q]))

    def _with_sums(self, weights, bounds) -> "C3Problem":
        """The problem whose last states are the sums of the linear bounds."""
        (n_x, m), (lower, upper) = (self.n_x, len(bounds.linear)), self.sums[3:]

        def wider(Q):
            Q = widened(widened(Q, n_x, m).T, n_x, m)
            return Q.T

        x_lower, x_upper = (
            np.append(np.full(n_x, none) if own is None else own, more)
            for none, own, more in (
                (-np.inf, bounds.x_lower, lower), (np.inf, bounds.x_upper, upper),
            )
        )  # fmt: skip
        return C3Problem(
            replace(
                weights,
                Q=wider(self.Q),
                Q_N=wider(self.Q_N),
                Q_knots=widened(weights.Q_knots, n_x, m),
                G=widened(self.G, n_x, m),
                U=widened(self.U, n_x, m, 1.0),
            ),
            self.projection,
            self.options,
            replace(bounds, x_lower=x_lower, x_upper=x_upper, linear=[]),
        )

    def _checked(self, o, weights):
        name = f"C3Weights.orientation: OrientationWeight({o.start}, {o.weight})"
        if o.start != int(o.start) or not 0 <= o.start <= self.n_x - 4:
            raise ValueError(
                f"{name} starts at {o.start}, expected an integer from 0 to "
                f"{self.n_x - 4}"
            )
        for weight in (o.weight, 0.0 if o.weight_N is None else o.weight_N):
            if not 0.0 <= weight < np.inf:
                raise ValueError(f"{name}: {weight}, expected a number >= 0")
        if o.free_axis is not None and not (
            np.shape(o.free_axis) == (3,) and 0.0 < np.linalg.norm(o.free_axis) < np.inf
        ):
            raise ValueError(
                f"{name}: free_axis is {o.free_axis}, expected 3 numbers, not all 0"
            )
        of = slice(o.start, o.start + 4)
        for matrix in (self.Q, self.Q_N, *self._Q):
            if matrix[of].any():
                raise ValueError(
                    f"{name}: Q weighs the quaternion's numbers too, expected zeros "
                    "there"
                )
        return o

    def _check_consensus_weights(self, n_contact):
        parts = "[x, lam, u, eta]" if self.is_plus else "[x, lam, u]"
        odd = self.is_plus and n_contact % 2
        if n_contact < 1 or odd or self.U.size != self.n_z:
            raise ValueError(
                f"C3Weights: G has {self.n_z} and U {self.U.size} entries, expected "
                f"one per entry of {parts} with {self.n_x} of x and {self.n_u} of u"
            )
        i_u = self.n_x + self.n_lam
        needed = np.zeros(self.n_z, bool)
        needed[self.n_x : i_u] = needed[i_u + self.n_u :] = True
        for name, weight in (("G", self.G), ("U", self.U)):
            if name == "U" and not self.is_plus:
                needed[: self.n_x] = True  # That projection moves x.
            for i in np.flatnonzero((weight < 0.0) | (needed & (weight == 0.0))):
                raise ValueError(
                    f"C3Weights.{name}[{i}] is {weight[i]}, expected "
                    f"{'> 0' if needed[i] else '>= 0'} (order {parts})"
                )
        G_u = self.G[i_u : i_u + self.n_u]
        if not np.linalg.eigvalsh(self.R + np.diag(G_u))[0] > 0.0:
            raise ValueError(
                f"C3Weights: R = {self.R.tolist()} and G of u = {G_u} leave an input "
                "without cost, expected R + G > 0"
            )

    def _bound(self, unbounded, u, x):
        """A bound over [lam, u, x]; none on lam."""
        parts = [np.full(self.n_lam, unbounded)]
        for name, value, n in (("u", u, self.n_u), ("x", x, self.n_x)):
            part = np.full(n, unbounded) if value is None else np.asarray(value, float)
            if part.shape != (n,) or np.isnan(part).any():
                raise ValueError(
                    f"C3Bounds: {name} is bounded by {part}, expected {n} numbers"
                )
            parts.append(part)
        return np.concatenate(parts)

    def state_cost(self, x0, x_desired):
        """Q of the knots, of the last one, and targets: (x - target)' Q (x - target).

        Without orientation weights Q (1, n_x, n_x) is that of the weights. With them
        the knots' Q (N, n_x, n_x), Q_N and the targets (N + 1, n_x) are the quadratic
        of the angles' cost about the orientation of x0.
        """
        if not self.orientation:
            return self._Q, self.Q_N, x_desired
        N = self.options.N
        Q, goal = np.array([self._Q[k % len(self._Q)] for k in range(N)]), x_desired
        goal = goal.copy()
        Q_N = self.Q_N.copy()
        for o in self.orientation:
            of = slice(o.start, o.start + 4)
            q = np.vstack([x0[of], x_desired[:, of]])
            bad = np.flatnonzero(~((q**2).sum(axis=1) > 0.25))
            if bad.size:
                name = f"x_desired[{bad[0] - 1}]" if bad[0] else "x0"
                raise C3Failure(
                    f"{name}: the quaternion at {o.start} is {q[bad[0]]}, expected a "
                    "unit one"
                )
            local, goal[:, of] = orientation_quadratics(q[0], q[1:], o.free_axis)
            Q[:, of, of] += o.weight * local[:N]
            last = o.weight if o.weight_N is None else o.weight_N
            Q_N[of, of] += last * local[N]
        for a in (Q, Q_N):
            a.setflags(write=False)  # To the compiler another type, like p.Q's.
        return Q, Q_N, goal

    def cold_start(self) -> WarmStart:
        """What a first plan starts from: zeros."""
        N = self.options.N
        z = np.zeros((N, self.n_z))
        return WarmStart(np.zeros((N, self.n_u)), z, z)


def _check_options(o: C3Options, projection: Projection):
    if not isinstance(projection, Projection):
        raise ValueError(
            f"C3: projection is {projection!r}, expected PlusProjection(), "
            "QpProjection(alpha) or ExactProjection()"
        )
    for name in ("N", "rounds", "polish"):
        number = getattr(o, name)
        if isinstance(number, bool) or not isinstance(number, Integral):
            raise ValueError(f"C3Options.{name} is {number!r}, expected an integer")
    if o.N < 1 or o.rounds < 0:
        raise ValueError(
            f"C3Options: N = {o.N} knots and rounds = {o.rounds}, expected N >= 1 and "
            "rounds >= 0"
        )
    if o.polish < 0:
        raise ValueError(f"C3Options.polish is {o.polish}, expected at least 0")
    if not 1.0 <= o.rho < np.inf:
        raise ValueError(f"C3Options.rho is {o.rho}, expected a number >= 1")
    if isinstance(projection, ExactProjection) and not (
        isinstance(projection.nodes_max, Integral) and projection.nodes_max >= 1
    ):
        raise ValueError(
            f"ExactProjection.nodes_max is {projection.nodes_max!r}, expected an "
            "integer of at least 1"
        )
    if isinstance(projection, QpProjection) and not 0.0 < projection.alpha <= 1.0:
        raise ValueError(
            f"QpProjection.alpha is {projection.alpha}, expected more than 0, at most 1"
        )


def _read_only(a):
    a = np.array(a, dtype=float, order="C")
    a.setflags(write=False)
    return a


def _square(name, weight):
    """A symmetric positive semi-definite matrix, from it or from its diagonal."""
    weight = np.atleast_1d(np.asarray(weight, dtype=float))
    matrix = np.diag(weight) if weight.ndim == 1 else weight
    n = matrix.shape[0]
    if matrix.shape != (n, n) or n == 0 or not np.isfinite(matrix).all():
        raise ValueError(
            f"C3Weights.{name} is {weight}, expected finite numbers, a diagonal or a "
            "square matrix"
        )
    size = abs(matrix).max()
    if abs(matrix - matrix.T).max() > 1e-9 * size:
        raise ValueError(f"C3Weights.{name} is not symmetric: {matrix.tolist()}")
    least = np.linalg.eigvalsh(matrix)[0]
    if least < -1e-9 * size:
        raise ValueError(
            f"C3Weights.{name} has the eigenvalue {least:.3g}, expected none below 0"
        )
    return _read_only(0.5 * (matrix + matrix.T))


def _diagonal(name, weight):
    weight = np.asarray(weight, dtype=float)
    if weight.ndim == 2 and weight.shape[0] == weight.shape[1]:
        if np.count_nonzero(weight - np.diag(np.diag(weight))):
            raise ValueError(f"C3Weights.{name} is not diagonal, expected a diagonal")
        weight = np.diag(weight)
    if weight.ndim != 1 or not np.isfinite(weight).all():
        raise ValueError(f"C3Weights.{name} is {weight}, expected finite numbers")
    return _read_only(weight)


def solve_c3(
    lcs: LCS | Sequence[LCS],
    x0,
    x_desired,
    problem: C3Problem,
    warm: WarmStart | None = None,
    modes=None,
    guess=None,
):
    """One solve of C3, from the state x0.

    Args:
        lcs: the model, one for the whole horizon, or a list of N, one per knot.
        x0: (n_x,) [SI].
        x_desired: (N + 1, n_x), row k the target at knot k.
        problem: weights, projection, options, bounds.
        warm: what the last solve returned; None: a first solve. Its u is the u_prev of
            the input-change penalty; its delta and w are used if options.warm_start.
        modes: (n, n_lam) contact modes that the first n knots keep, as contact_modes
            gives them; None: all are free. The forces of contacts that are held closed
            may come out negative.
        guess: (N, n_u) inputs that the polish starts from, too, if they cost least.

    Returns: Plan, and the WarmStart for the next solve.
    Raises: ValueError on wrong shapes; C3Failure where there is no result.
    """
    p, o = problem, problem.options
    models = given_models = _one_per_knot(lcs, p)
    if modes is not None and len(modes):
        modes = np.asarray(modes)
        if modes.shape[1:] != (p.n_lam,) or len(modes) > o.N:
            raise ValueError(
                f"solve_c3: modes is {modes.shape}, expected at most {o.N} rows of "
                f"{p.n_lam}"
            )
        given_models = [models[k % len(models)] for k in range(o.N)]
        models = [
            fix_modes(m, modes[k]) if k < len(modes) else m
            for k, m in enumerate(given_models)
        ]
    x0 = np.array(x0, float, order="C")
    x_desired = np.array(x_desired, float, order="C")
    if x0.shape != (p.n_x,) or x_desired.shape != (o.N + 1, p.n_x):
        raise ValueError(
            f"solve_c3: x0 is {x0.shape} and x_desired {x_desired.shape}, expected "
            f"{(p.n_x,)} and {(o.N + 1, p.n_x)}"
        )
    for name, values in (("x0", x0), ("x_desired", x_desired)):
        if not is_finite(values):
            at = np.argwhere(~np.isfinite(values))[0]
            raise C3Failure(
                f"{name}{at.tolist()} is {values[tuple(at)]}, expected finite numbers"
            )
    warm = problem.cold_start() if warm is None else warm
    if warm.u.shape != (o.N, p.n_u) or warm.delta.shape != (o.N, p.n_z):
        raise ValueError(
            f"solve_c3: warm.u is {warm.u.shape} and warm.delta {warm.delta.shape}, "
            f"expected {(o.N, p.n_u)} and {(o.N, p.n_z)}"
        )
    if p.with_sums is not None:
        n_sums = len(p.sums[0])
        wider = [with_sums(each, *p.sums[:3]) for each in given_models]
        warm_z = (widened(a, p.n_x, n_sums) for a in (warm.delta, warm.w))
        plan, warm = solve_c3(
            wider if len(wider) > 1 else wider[0],
            widened(x0, p.n_x, n_sums),
            widened(x_desired, p.n_x, n_sums),
            p.with_sums,
            WarmStart(warm.u, *warm_z),
            modes,
            guess,
        )
        return without_sums(plan, warm, p.n_x, n_sums)
    scale = 1.0
    if o.scale_lam:
        A_norm, D_norm = (
            np.linalg.norm(a) for a in (given_models[0].A, given_models[0].D)
        )
        if not 0.0 < D_norm < np.inf:
            raise C3Failure("D is zero or not finite: there is no scale for lam")
        scale = float(A_norm / D_norm)
    # Contact entries of z count in units of scale.
    i_u = p.n_x + p.n_lam
    unit = np.ones(p.n_z)
    unit[p.n_x : i_u] = unit[i_u + p.n_u :] = scale
    A, B, D, d, E, F, H, c = (_stacked(models, name) for name in "ABDdEFHc")
    (AB, d, C, c), E, F, H, pushes = scaled_model(A, B, D, d, E, F, H, c, scale)
    matrices: list = []
    if not p.is_plus:
        for i in np.flatnonzero((p.U[i_u:] == 0.0) & H.any(axis=(0, 1))):
            raise C3Failure(f"U is 0 for u[{i}], expected > 0 where H is not zero")
        matrices = [
            projection_matrices(p.U, *arrays) for arrays in zip(E, F, H, strict=True)
        ]
    lam0 = np.empty(0)
    if not pushes:
        lam0, status = solve_lcp_kernel(F[0], E[0] @ x0 + c[0])
        if status != SOLVED:
            raise C3Failure("lam_0: the LCP at x_0 has no solution")
    Q, Q_N, x_goal = p.state_cost(x0, x_desired)
    h = np.zeros((o.N + 1, AB.shape[2]))  # What stays of the QP's linear term.
    h[:, p.n_lam + p.n_u :] = (
        x_goal @ Q[0]
        if len(Q) == 1
        else np.array([*(Q[k] @ x_goal[k] for k in range(o.N)), Q_N @ x_goal[o.N]])
    )
    h[o.N, p.n_lam + p.n_u :] = Q_N @ x_goal[o.N]
    if o.penalise_input_change:
        h[: o.N, p.n_lam : p.n_lam + p.n_u] = warm.u @ p.R
    delta, w = np.zeros((o.N, p.n_z)), np.zeros((o.N, p.n_z))
    if o.warm_start:
        delta, w = warm.delta / unit, warm.w / unit
    elif o.start_at_x0:
        delta[:, : p.n_x] = x0

    model = AB, d, C, c
    weights = Q, p.R, Q_N, p.G
    unbounded = np.isinf(p.lower).all() and np.isinf(p.upper).all()
    bounds = None if unbounded else (p.lower, p.upper)
    given, cut = (h, x0, lam0), 0
    if p.is_plus:
        status, x, v, delta, w, inputs = admm_plus(
            *model, *weights, bounds, p.U, *given, delta, w, o.rounds, o.rho
        )
        if status != SOLVED:
            raise C3Failure(FAILURES[status])
    else:
        lcp = p.projection, p.U, (E, F, H, c), matrices
        x, v, delta, w, inputs, cut = admm(
            model, weights, bounds, given, delta, w, o, lcp
        )
    u, lam = np.ascontiguousarray(v[:, p.n_lam :]), v[:, : p.n_lam] * scale
    if o.polish > 0:
        ahead = np.vstack([warm.u[1:], warm.u[-1:]])
        more = [] if guess is None else [np.reshape(guess, (1, o.N, p.n_u))]
        starts = np.concatenate([inputs, warm.u[None], ahead[None], *more])
        u_centre = warm.u if o.penalise_input_change else np.zeros_like(u)
        (u_lower, x_lower), (u_upper, x_upper) = (
            np.split(bound[p.n_lam :], [p.n_u]) for bound in (p.lower, p.upper)
        )
        found = polish(
            tuple(_stacked(models, name) for name in "ABDdEFHc"),
            x0,
            starts,
            x_goal,
            u_centre,
            (Q, p.R, Q_N),
            (u_lower, u_upper, x_lower, x_upper),
            o.polish,
        )
        if found[3] < np.inf:  # Else no start can be rolled out: C3's plan remains.
            x, u, lam, _ = found
    delta, w = delta * unit, w * unit
    if modes is not None and len(modes):
        lam = lam.copy()
        for k, mode in enumerate(modes):
            m = given_models[k]
            lam[k] = fixed_forces(m, mode, x[k], u[k], lam[k])
            fixed = np.flatnonzero(mode != FREE)  # Of their rows nothing was solved.
            delta[k, p.n_x + fixed], w[k, p.n_x + fixed] = lam[k, fixed], 0.0
            if p.is_plus:
                gap = m.E @ x[k] + m.F @ lam[k] + m.H @ u[k] + m.c
                delta[k, i_u + p.n_u + fixed] = np.maximum(gap[fixed], 0.0)
                w[k, i_u + p.n_u + fixed] = 0.0
    plan = Plan(x, u, lam, cut_projections=cut)
    return plan, WarmStart(plan.u, delta, w)


def _one_per_knot(lcs, p: C3Problem) -> list[LCS]:
    """[lcs], or the N of a list, checked. Raises: ValueError."""
    models = [lcs] if isinstance(lcs, LCS) else lcs
    if not isinstance(models, Sequence) or not all(isinstance(m, LCS) for m in models):
        raise ValueError(
            f"solve_c3: lcs is a {type(lcs).__name__}, expected an LCS or a list of "
            f"{p.options.N}"
        )
    if not isinstance(lcs, LCS) and len(models) != p.options.N:
        raise ValueError(
            f"solve_c3: {len(models)} LCS came, expected one, or {p.options.N} as knots"
        )
    for m in models:
        if (m.n_x, m.n_u, m.n_lam) != (p.n_x, p.n_u, p.n_lam):
            raise ValueError(
                f"solve_c3: the LCS has (n_x, n_u, n_lam) = {m.n_x, m.n_u, m.n_lam}, "
                f"expected {p.n_x, p.n_u, p.n_lam} as the weights"
            )
    return list(models)


def _stacked(models, name):
    """That array of all models (K, ...), of C order: one compiled version serves."""
    if len(models) == 1:
        return compiled_once(np.ascontiguousarray(getattr(models[0], name))[None])
    return compiled_once(np.array([getattr(m, name) for m in models]))


def plan_cost(lcs: LCS | Sequence[LCS], x0, u, x_desired, problem: C3Problem) -> float:
    """What the inputs u (N, n_u) really cost: rolled out with exact contact forces.

    Returns: sum (x - x_desired)'Q(x - x_desired) + u'R u, Q_N at the last state, and
        the squared angles by their weights. The input-change penalty, ADMM's own terms
        and the bounds are no part of it.
    Raises: ValueError if an LCP of the rollout has no solution.
    """
    p, x, cost = problem, np.asarray(x0, float), 0.0
    models = _one_per_knot(lcs, p)
    for k in range(len(u) + 1):
        last = k == len(u)
        e = x - x_desired[k]
        cost += e @ (p.Q_N if last else p._Q[k % len(p._Q)]) @ e
        for o in p.orientation:
            of = slice(o.start, o.start + 4)
            weight = o.weight_N if last and o.weight_N is not None else o.weight
            cost += weight * squared_angle(x[of], x_desired[k][of], o.free_axis)
        if not last:
            cost += u[k] @ p.R @ u[k]
            x, _ = simulate(models[k % len(models)], x, u[k])
    return float(cost)


def with_gap_residual(
    lcs: LCS, r_comp, residual_dt_sec, clamp: bool, sliding_x=None
) -> LCS:
    """lcs with the learned residual of its gaps.

    Args:
        r_comp: (n_lam,) residual [m/s] at the time step residual_dt_sec [s]; as a gap
            [m] it does not depend on the step, so it counts as r_comp residual_dt / dt.
        clamp: where the gap phi + r (of geometry) is negative, take it for zero.
        sliding_x (n_x,): a state at whose sliding speed no contact is to open; None:
            Anitescu's contacts do (opening_speed).
    """
    r = r_comp * (residual_dt_sec / lcs.dt)
    if clamp and lcs.phi is not None:
        r = r + np.maximum(0.0, -(lcs.phi + r * lcs.dt)) / lcs.dt
    if sliding_x is not None:
        r = r + opening_speed(lcs, sliding_x)
    return lcs.with_residual(r)


def command_step(lcs: LCS, x, u):
    """x_next (n_x,) and lam (n_lam,) after x under u; C3Failure if there are none."""
    try:
        x_next, lam = simulate(lcs, x, u)
    except ValueError as error:
        raise C3Failure(f"the command's step: {error}") from error
    if not (np.isfinite(x_next).all() and np.isfinite(lam).all()):
        raise C3Failure("the command's step is not finite")
    return x_next, lam


def warm_up(problem: C3Problem):
    """Compiles what a solve of this problem needs, so that the first is no slower."""
    p = problem
    D, E = np.eye(p.n_x, p.n_lam), -np.eye(p.n_lam, p.n_x)
    H, c = np.zeros((p.n_lam, p.n_u)), -np.ones(p.n_lam)
    B, F = np.zeros((p.n_x, p.n_u)), np.eye(p.n_lam)
    lcs = LCS(0.5 * np.eye(p.n_x), B, D, np.zeros(p.n_x), E, F, H, c, 1.0)
    x0 = np.zeros(p.n_x)
    try:
        solve_c3(lcs, x0, np.zeros((p.options.N + 1, p.n_x)), p)
    except C3Failure:
        pass  # Bounds may exclude this made-up problem; it is compiled all the same.
    simulate(lcs, x0, np.zeros(p.n_u))
    is_finite_model(lcs)
