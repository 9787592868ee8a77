"""The residual learner as a system (numerics/residual_learner.py has its maths)."""

from dataclasses import dataclass, field, replace
from enum import IntEnum
from operator import attrgetter
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.lcs import LCS, is_finite_model
from makebreak.systems.contact_mpc.numerics.residual_learner import (
    Buffer,
    Residual,
    empty_buffer,
    gamma_bound,
    group_of_entry,
    learn,
    measured_step,
    spread,
    zero_residual,
)
from makebreak.systems.contact_mpc.numerics.residual_posterior import (
    ResidualGrid,
    is_felt,
    losses_on_grid,
    mode_and_std,
    residual_grid,
    updated,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings, check_times
from makebreak.systems.numerics.timing import timed


class LearnerStatus(IntEnum):
    """What happened to the newest pair; r_comp changes with LEARNED, AT_BOUND only."""

    LEARNED = 0  # r_comp was updated.
    AT_BOUND = 1  # As LEARNED, and an entry of r_comp is at its bound r_max.
    WAITING = 2  # No pair yet: it takes two good samples in a row.
    DISABLED = 3  # enable was 0: the pair was dropped.
    NOT_FINITE = 4  # x, u_measured or lcs was not finite: the pair was dropped.
    GAMMA_REFUSED = 5  # gamma exceeds the bound of this pair's F: it was dropped.
    NOT_SOLVED = 6  # A QP of the buffer was not solved.
    BAD_LCS = 7  # lcs has other sizes or another dt: the pair was dropped.


# Defaults that are lengths, and so velocities at the learner's time step [m].
GAP_MAX, GAP_RATE, GAP_STD, GAP_DRIFT, GAP_SPACING = 0.05, 1.5e-4, 8e-3, 1e-3, 5e-4
# eps times dt and gamma over dt, the paper's for forces as impulses.
EPS_IMPULSE, GAMMA_IMPULSE = 1e-7, 0.01
GRID_MAX = 2001  # Largest number of residuals on the grid.


@dataclass
class WalkConfig:
    """How the residual may change: a random walk."""

    # Standard deviation of the walk after one second of contact [m/s / sqrt(s)]; null:
    # that of a gap of 1 mm.
    drift: float | None = None
    # Standard deviation that is added to the drift in proportion to the residual's own
    # size [1 / sqrt(s)].
    growth: float = 0.08
    # Time after the last contact after which the residual no longer walks [s].
    hold_sec: float = 2.0


@dataclass
class FreeStatesConfig:
    """States that also change for reasons that no model has (an object that rocks): the
    variance of these changes bounds their weight."""

    states: list[int] = field(default_factory=list)  # Their indices.
    # Time over which that variance is averaged, while nothing can touch [s].
    average_sec: float = 2.0


@dataclass
class PosteriorConfig:
    """The residual's probability on a grid (numerics/residual_posterior.py)."""

    # Standard deviation of the residual's prior, whose mean is zero [m/s]; null: that
    # of a gap of 8 mm.
    prior_std: float | None = None
    walk: WalkConfig = field(default_factory=WalkConfig)
    # Spacing of the grid of residuals [m/s]; null: that of gaps of 0.5 mm.
    spacing: float | None = None
    # Factor on the loss of a step; below 1, as the errors of steps are correlated.
    trust: float = 0.2
    loss_max: float = 20.0  # Largest loss of a step, against outliers.
    free: FreeStatesConfig = field(default_factory=FreeStatesConfig)
    # Time over which the loss that no residual explains is averaged, while a contact is
    # felt [s]. Where it is s times what noise with these Q_d would leave, the model is
    # wrong elsewhere (a mass, a friction) and stays so: trust is divided by s^2. null:
    # trust is fixed.
    misfit_sec: float | None = 1.0


@dataclass
class AdamConfig:
    """Gradient steps on the mean loss of the last measured steps."""

    n_b: int = 10  # Number of measured steps in the buffer.
    # Learning rate, about the change of r_comp per step [m/s] (cartpole_walls: [m]);
    # null: 0.15 mm of the gap.
    learning_rate: float | None = None
    n_steps: int = 1  # Number of Adam's steps per update.


@dataclass
class ResidualLearnerConfig:
    """Defaults: the paper's for rolling a ball at any time step, lam in newtons."""

    # Weights (n_x,) of the one-step error in each state [1/SI^2]; empty: all 1.
    Q_d: list[float] = field(default_factory=list)
    # Weight eps of the dynamics against the contact equation [m/s N]; null: the
    # paper's, 1e-7 over the time step.
    eps: float | None = None
    # Softness gamma of the contact equation [m/s per N]; null: the paper's, 0.01 times
    # the time step.
    gamma: float | None = None
    adam: AdamConfig = field(default_factory=AdamConfig)
    # Entries of r_comp that share one value, as lists of indices; entries in no list
    # stay zero; empty: each entry has its own value.
    groups: list[list[int]] = field(default_factory=list)
    # Largest magnitude of an entry of r_comp [m/s] (cartpole_walls: [m]); null: 50 mm
    # of the gap.
    r_max: float | None = None
    # Noise of the measured gap speed mu |v_t| of a sliding Anitescu contact; what
    # exceeds it is not taken for a gap [m/s]; inf: nothing is corrected, as in the
    # paper.
    slip_noise: float = np.inf
    # Posterior of each group's residual: r_comp is its mode instead of Adam's result,
    # Q_d are inverse variances, and adam is not used; null: Adam.
    posterior: PosteriorConfig | None = None


@dataclass(frozen=True, eq=False)
class LearnerMemory:
    """The learner's state, as an immutable value: an update makes a new one."""

    sample: tuple[np.ndarray, LCS] | None  # x_k and the LCS at x_k.
    buffer: Buffer
    residual: Residual
    loss: float
    status: LearnerStatus
    # With a posterior: its density on the grid, (n_groups, n).
    density: np.ndarray | None = None
    # Standard deviation (n_groups,) of the residual [m/s]; (1,), 0 without a posterior.
    std: np.ndarray = field(default_factory=lambda: np.zeros(1))
    idle: np.ndarray | None = None  # (n_groups,) time since it was last felt [s].
    # Of each free state: mean square of the changes that the model lacks [SI^2].
    unexplained: np.ndarray | None = None
    misfit: float = 0.0  # Mean of the smallest loss of each step with contact.

    def __deepcopy__(self, memo):
        return self  # Every part is immutable, so a Context may share it.


class ResidualLearner(LeafSystem):
    """Learns r_comp, the residual on the contact equation of an LCS (eq. 12).

    Inputs:
        x (n_x,): measured state.
        u_measured (n_u,): mean of the measured input over the period that ends now.
        lcs (abstract): LCS about the measured state x of the same instant, with
            dt = period_sec: its builder must be updated just before the learner. Of a
            tuple (one for each knot of a plan) the first is used.
        enable (1,), optional: 0 drops the pairs that this sample belongs to.

    Outputs:
        r_comp (n_lam,) [m/s]: for the contact equation at dt = period_sec.
        r_std (n_groups,): standard deviation of each group's residual [m/s]; (1,), 0
            without a posterior.
        loss (1,): mean loss per buffered pair before the last update.
        status (1,): a LearnerStatus.

    At tick k+1 the pair (x_k, u_measured, the lcs read at tick k, x_{k+1}) joins the
    buffer, and Adam takes n_steps steps on the mean loss of the last n_b pairs.

    Source: ACI-MPC, section VI, algorithm 1.
    """

    def __init__(
        self,
        config: ResidualLearnerConfig,
        lcs: LCS,
        period_sec: float,
        offset_sec: float = 0.0,
    ):
        """Args: lcs: an example of what the input port carries; gives sizes and dt.

        Raises: ValueError for a setting out of range, or gamma above the bound of F.
        """
        super().__init__()
        check_settings(config)
        check_times("ResidualLearner", period_sec, offset_sec)
        lcs = _first(lcs)
        self._config = config = _checked(config, lcs, period_sec)
        self._dt, self._sizes = lcs.dt, (lcs.n_x, lcs.n_u, lcs.n_lam)
        self._Q_d = np.array(config.Q_d or np.ones(lcs.n_x), dtype=float)
        self._group = group_of_entry(config.groups, lcs.n_lam)
        n_groups = int(self._group.max()) + 1
        self._x = self.DeclareVectorInputPort("x", lcs.n_x)
        self._u = self.DeclareVectorInputPort("u_measured", lcs.n_u)
        self._lcs = self.DeclareAbstractInputPort("lcs", Value(lcs))
        self._enable = self.DeclareVectorInputPort("enable", 1)
        self._grid: ResidualGrid | None = None
        memory = LearnerMemory(
            sample=None,
            buffer=empty_buffer(lcs.n_lam),
            residual=zero_residual(n_groups),
            loss=0.0,
            status=LearnerStatus.WAITING,
        )
        c = self._config.posterior
        if c is not None:
            assert config.r_max and c.spacing and c.prior_std and c.walk.drift
            root = np.sqrt(period_sec)  # They are given: _checked.
            walk = c.walk.drift * root, c.walk.growth * root
            self._grid = residual_grid(config.r_max, c.spacing, c.prior_std, *walk)
            _, std = mode_and_std(self._grid, self._grid.prior)
            memory = replace(
                memory,
                density=_frozen(np.tile(self._grid.prior, (n_groups, 1))),
                std=_frozen(np.full(n_groups, std)),
                idle=_frozen(np.zeros(n_groups)),
                unexplained=_frozen(np.zeros(len(c.free.states))),
            )
        self._memory = self.DeclareAbstractState(Value(memory))
        ticket = {self.abstract_state_ticket(self._memory)}
        self.DeclareVectorOutputPort("r_comp", lcs.n_lam, self._calc_r_comp, ticket)
        self.DeclareVectorOutputPort("r_std", len(memory.std), self._calc_r_std, ticket)
        self.DeclareVectorOutputPort("loss", 1, self._calc_loss, ticket)
        self.DeclareVectorOutputPort("status", 1, self._calc_status, ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )
        first_call(self._first_call, memory, lcs)

    def _first_call(self, memory: LearnerMemory, lcs: LCS):
        x, u = np.zeros(lcs.n_x), np.zeros(lcs.n_u)
        if self._grid is None:
            first = measured_step(lcs, x, u, x, self._Q_d, self._config.eps)
            self._learned(memory, first)
        else:
            first = measured_step(lcs, x, u, x, self._Q_d, self._config.eps)
            self._with_posterior(memory, (x, lcs), first, memory.unexplained)

    @timed
    def _update(self, context, state):
        memory = self._memory_of(context)
        x, u = self._x.Eval(context), self._u.Eval(context)
        lcs = _first(self._lcs.Eval(context))
        enable: Any = [1.0]
        if self._enable.HasValue(context):
            enable = self._enable.Eval(context)
        enabled = bool(enable[0] > 0.5)  # False for a NaN, too.
        state.get_mutable_abstract_state(self._memory).set_value(
            self._after(memory, x, u, lcs, enabled)
        )

    def _after(self, memory, x, u, lcs, enabled) -> LearnerMemory:
        """The memory after the sample x, u, lcs."""
        if not enabled:
            return _held(memory, None, LearnerStatus.DISABLED)
        if not self._fits(lcs):
            return _held(memory, None, LearnerStatus.BAD_LCS)
        if not (np.isfinite(x).all() and is_finite_model(lcs)):
            return _held(memory, None, LearnerStatus.NOT_FINITE)
        x.setflags(write=False)
        sample = (x, lcs)
        if memory.sample is None:
            return _held(memory, sample, LearnerStatus.WAITING)
        if not np.isfinite(u).all():
            return _held(memory, sample, LearnerStatus.NOT_FINITE)
        x_before, lcs_before = memory.sample
        if not self._config.gamma < gamma_bound(lcs_before.F):
            return _held(memory, sample, LearnerStatus.GAMMA_REFUSED)
        c, Q_d, unexplained = self._config, self._Q_d, None
        pair = lcs_before, x_before, u, x
        if c.posterior is not None:
            unexplained = self._unexplained(memory, lcs, *pair)
            Q_d = Q_d.copy()
            for i, square in zip(c.posterior.free.states, unexplained, strict=True):
                Q_d[i] = min(Q_d[i], 1.0 / max(square, 1e-300))
        with np.errstate(over="ignore", invalid="ignore"):  # Told by the status.
            step = measured_step(*pair, Q_d, c.eps, c.slip_noise)
        if not step.is_finite():
            return _held(memory, sample, LearnerStatus.NOT_FINITE)
        if c.posterior is not None:
            return self._with_posterior(memory, sample, step, unexplained)
        buffer = memory.buffer.append(step, c.adam.n_b)
        residual, loss, status = self._learned(memory, buffer)
        return replace(
            memory, sample=sample, buffer=buffer, residual=residual, loss=loss,
            status=status,
        )  # fmt: skip

    def _with_posterior(self, memory, sample, step, unexplained) -> LearnerMemory:
        """The memory after one more measured step, with a posterior."""
        c, grid = self._config, self._grid
        assert grid is not None and c.posterior is not None and c.r_max is not None
        before, others = memory.residual.value, spread(memory.residual, self._group)
        idle, loss_before = memory.idle + self._dt, memory.loss
        losses, solved = [], []
        for j in range(len(before)):
            shared = self._group == j
            loss = losses_on_grid(step, shared, grid.values, c.eps, c.gamma, others)
            losses.append(loss)
            solved.append(np.isfinite(loss).all())
            if solved[j]:
                loss_before = float(np.interp(before[j], grid.values, loss))
                if is_felt(grid, loss, before[j]):
                    idle[j] = 0.0
        misfit, trust = memory.misfit, c.posterior.trust
        if c.posterior.misfit_sec and all(solved) and (idle == 0.0).any():
            least = min(min(loss.min() for loss in losses), c.posterior.loss_max)
            misfit += min(self._dt / c.posterior.misfit_sec, 1.0) * (least - misfit)
        # Once for the larger errors, and once because they repeat at each step.
        trust /= max(1.0, misfit / (0.5 * np.count_nonzero(self._Q_d))) ** 2
        modes, std, density = before.copy(), memory.std.copy(), memory.density.copy()
        for j, loss in enumerate(losses):
            density[j] = updated(
                grid, density[j], loss, trust, c.posterior.loss_max,
                idle[j] < c.posterior.walk.hold_sec,
            )  # fmt: skip
            modes[j], std[j] = mode_and_std(grid, density[j])
        status = LearnerStatus.LEARNED if all(solved) else LearnerStatus.NOT_SOLVED
        if abs(modes).max() > c.r_max - (grid.values[1] - grid.values[0]):
            status = LearnerStatus.AT_BOUND
        residual = replace(memory.residual, value=modes)
        return LearnerMemory(
            sample, memory.buffer, residual, loss_before, status, _frozen(density),
            _frozen(std), _frozen(idle), unexplained, misfit,
        )  # fmt: skip

    def _unexplained(self, memory, lcs_next, lcs, x, u, x_next):
        """Mean squares (n_free,) of the free states' changes that the model lacks,
        updated while no contact is possible [SI^2]."""
        c = self._config.posterior
        assert c is not None
        if not len(c.free.states):
            return memory.unexplained
        adapts = self._group >= 0
        least = (memory.residual.value - 2.0 * memory.std)[self._group[adapts]]
        for phi in (lcs.phi, lcs_next.phi):
            if phi is None or (phi[adapts] + least * lcs.dt <= 0.0).any():
                return memory.unexplained
        change = (lcs.A @ x + lcs.B @ u + lcs.d - x_next)[c.free.states]
        share = min(lcs.dt / c.free.average_sec, 1.0)
        after = (1.0 - share) * memory.unexplained + share * change**2
        return _frozen(after)

    def _learned(self, memory, buffer):
        c = self._config
        residual, loss, solved = learn(
            buffer,
            memory.residual,
            self._group,
            eps=c.eps,
            gamma=c.gamma,
            learning_rate=c.adam.learning_rate,
            n_steps=c.adam.n_steps,
            r_max=c.r_max,
        )
        if not solved:
            return residual, memory.loss, LearnerStatus.NOT_SOLVED
        at_bound = (abs(residual.value) >= c.r_max).any()
        status = LearnerStatus.AT_BOUND if at_bound else LearnerStatus.LEARNED
        return residual, loss, status

    def _fits(self, lcs) -> bool:
        if not isinstance(lcs, LCS):
            return False
        return (lcs.n_x, lcs.n_u, lcs.n_lam) == self._sizes and bool(
            abs(lcs.dt - self._dt) <= 1e-9 * self._dt
        )

    def _memory_of(self, context) -> LearnerMemory:
        return context.get_abstract_state(self._memory).get_value()

    def _calc_r_comp(self, context, output):
        output.SetFromVector(spread(self._memory_of(context).residual, self._group))

    def _calc_r_std(self, context, output):
        output.SetFromVector(self._memory_of(context).std)

    def _calc_loss(self, context, output):
        output.SetFromVector([self._memory_of(context).loss])

    def _calc_status(self, context, output):
        output.SetFromVector([float(self._memory_of(context).status)])


def _first(lcs):
    """The first LCS of a tuple with one for each knot; anything else as it is."""
    return lcs[0] if isinstance(lcs, tuple) and lcs else lcs


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


def _held(memory: LearnerMemory, sample, status: LearnerStatus) -> LearnerMemory:
    return replace(memory, sample=sample, status=status)


def _checked(config: ResidualLearnerConfig, lcs: LCS, period_sec: float):
    """A copy of the config with its defaults at this time step, so that a later edit
    does not reach the system.

    Raises: ValueError that names a setting out of range.
    """
    if not isinstance(lcs, LCS):
        raise ValueError(f"lcs is a {type(lcs).__name__}, expected an LCS")
    dt = lcs.dt
    if not (_is_number(period_sec) and abs(dt - period_sec) <= 1e-9 * dt):
        raise ValueError(
            f"period_sec is {period_sec}, expected the LCS's dt, {dt}: a pair is "
            "one time step of the LCS"
        )
    c = _with_defaults(config, dt)
    if c.Q_d:
        fits = len(c.Q_d) == lcs.n_x and all(map(_is_number, c.Q_d))
        if not (fits and min(c.Q_d) >= 0.0 and max(c.Q_d) > 0.0):
            raise ValueError(
                f"Q_d is {c.Q_d}, expected {lcs.n_x} weights >= 0, not all 0"
            )
    for name in ("eps", "adam.learning_rate", "r_max"):
        value = attrgetter(name)(c)
        if not (_is_number(value) and value > 0.0):
            raise ValueError(f"{name} is {value}, expected a positive number")
    if not c.slip_noise >= 0.0:
        raise ValueError(f"slip_noise is {c.slip_noise}, expected 0 or more")
    for name in ("n_b", "n_steps"):
        value = getattr(c.adam, name)
        if not (_is_number(value) and value >= 1 and value == int(value)):
            raise ValueError(
                f"adam.{name} is {value}, expected an integer of 1 or more"
            )
        setattr(c.adam, name, int(value))
    bound = gamma_bound(lcs.F)
    if not bound > 0.0:
        raise ValueError(
            "F + F' of the LCS has the eigenvalue "
            f"{bound:.3g}, expected a positive definite one: contacts of Anitescu's "
            "model with eps_c > 0 (Stewart-Trinkle's has none with friction)"
        )
    if c.gamma is None or not (_is_number(c.gamma) and 0.0 < c.gamma < bound):
        raise ValueError(
            f"gamma is {c.gamma}, expected 0 < gamma < {bound:.6g}, the smallest "
            "eigenvalue of F + F' (eps_c in the LCS makes it positive)"
        )
    _check_groups(c.groups, lcs)
    if c.posterior is not None:
        _check_posterior(c.posterior, c, lcs.n_x)
    return c


def _check_groups(groups: list[list[int]], lcs: LCS):
    """Raises: ValueError for entries that do not exist, or a part of a contact's: its
    other entries would keep the modelled gap, whatever is learned."""
    adapts = group_of_entry(groups, lcs.n_lam) >= 0
    if lcs.contact is None:
        return
    for contact in np.unique(lcs.contact):
        of = lcs.contact == contact
        if adapts[of].any() and not adapts[of].all():
            raise ValueError(
                f"groups is {groups}, with {adapts[of].sum()} of the {of.sum()} "
                f"entries of contact {int(contact)} ({np.flatnonzero(of).tolist()}), "
                "expected all or none of a contact's"
            )


def _is_number(value) -> bool:
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value))


def _with_defaults(config: ResidualLearnerConfig, dt: float) -> ResidualLearnerConfig:
    """A copy in which every number is given."""

    def filled(part, **defaults):
        none = {k: v for k, v in defaults.items() if getattr(part, k) is None}
        return replace(part, **none)

    posterior = config.posterior
    if posterior is not None:
        posterior = replace(
            filled(posterior, prior_std=GAP_STD / dt, spacing=GAP_SPACING / dt),
            walk=filled(posterior.walk, drift=GAP_DRIFT / dt),
            free=replace(posterior.free, states=list(posterior.free.states)),
        )
    return replace(
        filled(
            config,
            eps=EPS_IMPULSE / dt,
            gamma=GAMMA_IMPULSE * dt,
            r_max=GAP_MAX / dt,
        ),
        Q_d=list(config.Q_d),
        adam=filled(config.adam, learning_rate=GAP_RATE / dt),
        groups=[list(g) if np.iterable(g) else g for g in config.groups],
        posterior=posterior,
    )


def _check_posterior(c: PosteriorConfig, config: ResidualLearnerConfig, n_x: int):
    """Raises: ValueError that names a setting of the posterior out of range."""
    for i in c.free.states:
        if i not in range(n_x):
            raise ValueError(f"posterior.free.states names {i}, expected 0..{n_x - 1}")
    for name in (
        "prior_std", "walk.drift", "walk.growth", "walk.hold_sec", "spacing", "trust",
        "loss_max", "free.average_sec", "misfit_sec",
    ):  # fmt: skip
        value = attrgetter(name)(c)
        if name == "misfit_sec" and value is None:
            continue
        least, what = np.nextafter(0.0, 1.0), "a positive number"
        if name in ("walk.growth", "walk.hold_sec"):
            least, what = 0.0, "0 or more"
        finite = _is_number(value) or (name == "walk.hold_sec" and value == np.inf)
        if not (finite and least <= value):
            raise ValueError(f"posterior.{name} is {value}, expected {what}")
    assert config.r_max and c.spacing and c.prior_std  # _with_defaults.
    least, most = 2.0 * config.r_max / (GRID_MAX - 1), min(c.prior_std, config.r_max)
    if not least <= c.spacing <= most:
        raise ValueError(
            f"posterior.spacing is {c.spacing}, expected {least:.3g} (r_max over "
            f"{GRID_MAX // 2}) to {most:.3g} (the smaller of prior_std and r_max)"
        )
    if not config.Q_d:
        raise ValueError(
            "Q_d is empty, expected the inverse variances of the states' one-step "
            "errors: with a posterior they decide how fast it learns"
        )
