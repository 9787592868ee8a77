"""The residual learner as a system (numerics/residual_learner.py has its maths)."""

from dataclasses import dataclass, field, replace
from enum import IntEnum
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
    losses_on_grid,
    mode_and_std,
    residual_grid,
    updated,
)
from makebreak.systems.numerics.first_calls import first_call
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


@dataclass
class PosteriorConfig:
    """The residual's probability on a grid (numerics/residual_posterior.py)."""

    # Standard deviation of the residual's prior, whose mean is zero [m/s]; 0.16 is 8 mm
    # at dt = 0.05 s.
    prior_std: float = 0.16
    # Standard deviation of the residual's random walk after one second [m/s / sqrt(s)].
    drift: float = 0.02
    # Standard deviation that is added to the drift in proportion to the residual's own
    # size [1 / sqrt(s)].
    growth: float = 0.08
    spacing: float = 0.01  # Spacing of the grid of residuals [m/s].
    # Factor on the loss of a step; below 1, as the errors of steps are correlated.
    trust: float = 0.2
    loss_max: float = 20.0  # Largest loss of a step, against outliers.
    # Indices of states that also change for reasons that no model has (an object that
    # rocks): the variance of these changes bounds their weight.
    free_states: list[int] = field(default_factory=list)
    # Time over which the variance of the free states' changes is averaged, while
    # nothing can touch [s].
    free_sec: float = 2.0


@dataclass
class ResidualLearnerConfig:
    """Defaults: the paper's for rolling a ball at dt = .05 s, with lam in newtons."""

    # Weights (n_x,) of the one-step error in each state [1/SI^2]; empty: all 1.
    Q_d: list[float] = field(default_factory=list)
    # Weight eps of the dynamics against the contact equation [m/s N]; the paper's is
    # 2e-6 at dt = 0.05 s.
    eps: float = 2e-6
    # Softness gamma of the contact equation [m/s per N]; the paper's is 5e-4 at dt =
    # 0.05 s.
    gamma: float = 5e-4
    n_b: int = 10  # Number of measured steps in the buffer.
    # Learning rate of Adam, about the change of r_comp per step [m/s] (cartpole_walls:
    # [m]).
    learning_rate: float = 3e-3
    n_steps: int = 1  # Number of Adam's steps per update.
    # Entries of r_comp that share one value, as lists of indices; entries in no list
    # stay zero; empty: each entry has its own value.
    groups: list[list[int]] = field(default_factory=list)
    # Largest magnitude of an entry of r_comp [m/s] (cartpole_walls: [m]).
    r_max: float = 1.0
    # Noise of the measured gap speed mu |v_t| of a sliding Anitescu contact; what
    # exceeds it is not taken for a gap [m/s]; inf: nothing is corrected, as in the
    # paper.
    slip_noise: float = np.inf
    # Posterior of the residual, for a single group: r_comp is its mode instead of
    # Adam's result, Q_d are inverse variances, and n_b, learning_rate and n_steps are
    # not used; null: Adam.
    posterior: PosteriorConfig | None = None


@dataclass(frozen=True, eq=False)
class LearnerMemory:
    """The learner's state, as an immutable value: an update makes a new one."""

    sample: tuple[np.ndarray, LCS] | None  # x_k and the LCS at x_k.
    buffer: Buffer
    residual: Residual
    loss: float
    status: LearnerStatus
    density: np.ndarray | None = None  # (n,) the posterior on its grid.
    std: float = 0.0  # Of the residual [m/s]; 0 without a posterior.
    # Of each free state: mean square of the changes that the model lacks [SI^2].
    unexplained: np.ndarray | None = None

    def __deepcopy__(self, memo):
        return self  # Every part is immutable, so a Context may share it.


class ResidualLearner(LeafSystem):
    """Learns r_comp, the residual on the contact equation of an LCS (eq. 12).

    Inputs:
        x (n_x,): measured state.
        u_measured (n_u,): mean of the measured input over the period that ends now.
        lcs (abstract): LCS about the measured state x of the same instant, with
            dt = period_sec: its builder must be updated just before the learner.
        enable (1,), optional: 0 drops the pairs that this sample belongs to.

    Outputs:
        r_comp (n_lam,) [m/s]: for the contact equation at dt = period_sec.
        r_std (1,): its standard deviation [m/s]; 0 without a posterior.
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
        self._config = _checked(config, lcs, period_sec)
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
            root = np.sqrt(period_sec)
            self._grid = residual_grid(
                config.r_max, c.spacing, c.prior_std, c.drift * root, c.growth * root
            )
            _, std = mode_and_std(self._grid, self._grid.prior)
            memory = replace(
                memory,
                density=self._grid.prior,
                std=std,
                unexplained=np.zeros(len(c.free_states)),
            )
        self._memory = self.DeclareAbstractState(Value(memory))
        ticket = {self.abstract_state_ticket(self._memory)}
        self.DeclareVectorOutputPort("r_comp", lcs.n_lam, self._calc_r_comp, ticket)
        self.DeclareVectorOutputPort("r_std", 1, self._calc_r_std, ticket)
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
            self._with_posterior(memory, (x, lcs), (lcs, x, u, x))

    @timed
    def _update(self, context, state):
        memory = self._memory_of(context)
        x, u = self._x.Eval(context), self._u.Eval(context)
        lcs = self._lcs.Eval(context)
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
        c = self._config
        pair = lcs_before, x_before, u, x
        if self._grid is not None:
            return self._with_posterior(memory, sample, pair)
        step = measured_step(*pair, self._Q_d, c.eps, c.slip_noise)
        buffer = memory.buffer.append(step, self._config.n_b)
        residual, loss, status = self._learned(memory, buffer)
        return LearnerMemory(sample, buffer, residual, loss, status)

    def _with_posterior(self, memory, sample, pair) -> LearnerMemory:
        """The memory after one more pair (lcs, x, u, x_next), with a posterior."""
        c, grid = self._config, self._grid
        assert grid is not None and c.posterior is not None
        shared = self._group == 0
        unexplained = self._unexplained(memory, sample[1], *pair)
        Q_d = self._Q_d.copy()
        for i, square in zip(c.posterior.free_states, unexplained, strict=True):
            Q_d[i] = min(Q_d[i], 1.0 / max(square, 1e-300))
        lcs, x, u, x_next = pair
        step = measured_step(lcs, x, u, x_next, Q_d, c.eps, c.slip_noise)
        loss = losses_on_grid(step, shared, grid.values, c.eps, c.gamma)
        solved = bool(np.isfinite(loss).all())
        density = updated(
            grid, memory.density, loss, c.posterior.trust, c.posterior.loss_max
        )
        density.setflags(write=False)
        mode, std = mode_and_std(grid, density)
        before = float(memory.residual.value[0])
        residual = replace(memory.residual, value=np.array([mode]))
        status = LearnerStatus.LEARNED if solved else LearnerStatus.NOT_SOLVED
        if abs(mode) > c.r_max - c.posterior.spacing:
            status = LearnerStatus.AT_BOUND
        loss_before = memory.loss
        if solved:
            loss_before = float(np.interp(before, grid.values, loss))
        return LearnerMemory(
            sample, memory.buffer, residual, loss_before, status, density, std,
            unexplained,
        )  # fmt: skip

    def _unexplained(self, memory, lcs_next, lcs, x, u, x_next):
        """Mean squares (n_free,) of the free states' changes that the model lacks,
        updated while no contact is possible [SI^2]."""
        c = self._config.posterior
        assert c is not None
        if not len(c.free_states):
            return memory.unexplained
        least = float(memory.residual.value[0]) - 2.0 * memory.std
        for phi in (lcs.phi, lcs_next.phi):
            if phi is None or (phi[self._group == 0] + least * lcs.dt <= 0.0).any():
                return memory.unexplained
        change = (lcs.A @ x + lcs.B @ u + lcs.d - x_next)[c.free_states]
        share = min(lcs.dt / c.free_sec, 1.0)
        after = (1.0 - share) * memory.unexplained + share * change**2
        after.setflags(write=False)
        return after

    def _learned(self, memory, buffer):
        c = self._config
        residual, loss, solved = learn(
            buffer,
            memory.residual,
            self._group,
            eps=c.eps,
            gamma=c.gamma,
            learning_rate=c.learning_rate,
            n_steps=c.n_steps,
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
        output.SetFromVector([self._memory_of(context).std])

    def _calc_loss(self, context, output):
        output.SetFromVector([self._memory_of(context).loss])

    def _calc_status(self, context, output):
        output.SetFromVector([float(self._memory_of(context).status)])


def _held(memory: LearnerMemory, sample, status: LearnerStatus) -> LearnerMemory:
    return replace(memory, sample=sample, status=status)


def _checked(config: ResidualLearnerConfig, lcs: LCS, period_sec: float):
    """A copy of the config, so that a later edit does not reach the system.

    Raises: ValueError that names a setting out of range.
    """
    c = config
    if abs(lcs.dt - period_sec) > 1e-9 * lcs.dt:
        raise ValueError(
            f"period_sec is {period_sec}, expected the LCS's dt, {lcs.dt}: a pair is "
            "one time step of the LCS"
        )
    if c.Q_d and (len(c.Q_d) != lcs.n_x or not min(c.Q_d) >= 0.0):
        raise ValueError(f"Q_d is {c.Q_d}, expected {lcs.n_x} weights >= 0")
    for name in ("eps", "learning_rate", "r_max"):
        value = getattr(c, name)
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value}, expected a positive number")
    if not c.slip_noise >= 0.0:
        raise ValueError(f"slip_noise is {c.slip_noise}, expected 0 or more")
    for name in ("n_b", "n_steps"):
        if not getattr(c, name) >= 1:
            raise ValueError(f"{name} is {getattr(c, name)}, expected 1 or more")
    bound = gamma_bound(lcs.F)
    if not 0.0 < c.gamma < bound:
        raise ValueError(
            f"gamma is {c.gamma}, expected 0 < gamma < {bound:.6g}, the smallest "
            "eigenvalue of F + F' (eps_c in the LCS makes it positive)"
        )
    group = group_of_entry(c.groups, lcs.n_lam)
    if c.posterior is not None:
        if group.max() > 0:
            raise ValueError(
                f"groups is {c.groups}, expected one group with a posterior"
            )
        for i in c.posterior.free_states:
            if not 0 <= i < lcs.n_x:
                raise ValueError(
                    f"posterior.free_states names {i}, expected 0..{lcs.n_x - 1}"
                )
        for name, value in vars(c.posterior).items():
            if name == "free_states":
                continue
            least, what = np.nextafter(0.0, 1.0), "a positive number"
            if name == "growth":
                least, what = 0.0, "0 or more"
            if not least <= value < np.inf:
                raise ValueError(f"posterior.{name} is {value}, expected {what}")
    return ResidualLearnerConfig(
        **{**vars(c), "Q_d": list(c.Q_d), "groups": [list(g) for g in c.groups]}
    )
