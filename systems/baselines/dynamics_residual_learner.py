"""Baseline of the residual learner: a residual of the dynamics, not of the contact."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.baselines.numerics.dynamics_residual import (
    step_error,
    with_dynamics_residual,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


class DynamicsStatus(IntEnum):
    """Use of the newest pair of samples; r_dyn is held unless it is LEARNED."""

    LEARNED = 0
    WAITING = 1  # No pair yet, which takes two good samples in a row.
    BAD_SAMPLE = 2  # x, u_measured or lcs is not finite, or lcs has no solution there.


@dataclass
class DynamicsResidualLearnerConfig:
    """Settings of the baseline that learns a residual of the dynamics."""

    n_b: int = 10  # Measured steps in the buffer.


@dataclass(frozen=True, eq=False)
class DynamicsMemory:
    """What the learner remembers between updates."""

    sample: tuple[np.ndarray, LCS] | None  # x_k and the LCS at x_k.
    errors: np.ndarray  # (n, n_x), read-only.
    status: DynamicsStatus

    def __deepcopy__(self, memo):
        return self  # Every part is immutable.


class DynamicsResidualLearner(LeafSystem):
    """Learns r_dyn, a constant residual of an LCS's dynamics (eq. 10).

    Inputs:  x (n_x,), u_measured (n_u,), lcs (abstract), as those of ResidualLearner.
    Outputs: r_dyn (n_x,) mean one-step prediction error over the last n_b pairs [x per
             step]; lcs (abstract): the input with d + r_dyn; status (1,), a
             DynamicsStatus.

    Source: ACI-MPC, section VI, eq. 9 and 10.
    """

    def __init__(
        self,
        config: DynamicsResidualLearnerConfig,
        lcs: LCS,
        period_sec: float,
        offset_sec: float = 0.0,
    ):
        """Args: lcs: an example of the input's LCS, with the dt period_sec."""
        super().__init__()
        check_settings(config)
        if config.n_b < 1:
            raise ValueError(f"n_b is {config.n_b}, expected 1 or more")
        if abs(lcs.dt - period_sec) > 1e-9 * lcs.dt:
            raise ValueError(
                f"period_sec is {period_sec}, expected the LCS's dt, {lcs.dt}"
            )
        self._n_b = config.n_b
        self._x = self.DeclareVectorInputPort("x", lcs.n_x)
        self._u = self.DeclareVectorInputPort("u_measured", lcs.n_u)
        self._lcs = self.DeclareAbstractInputPort("lcs", Value(lcs))
        errors = np.zeros((0, lcs.n_x))
        memory = DynamicsMemory(None, errors, DynamicsStatus.WAITING)
        self._memory = self.DeclareAbstractState(Value(memory))
        ticket = self.abstract_state_ticket(self._memory)
        self.DeclareVectorOutputPort("r_dyn", lcs.n_x, self._calc_r_dyn, {ticket})
        self.DeclareAbstractOutputPort(
            "lcs",
            lambda: Value(lcs),
            self._calc_lcs,
            {ticket, self.input_port_ticket(self._lcs.get_index())},
        )
        self.DeclareVectorOutputPort("status", 1, self._calc_status, {ticket})
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        memory = self._memory_of(context)
        x, u = self._x.Eval(context), self._u.Eval(context)
        state.get_mutable_abstract_state(self._memory).set_value(
            self._after(memory, x, u, self._lcs.Eval(context))
        )

    def _after(self, memory, x, u, lcs) -> DynamicsMemory:
        sample = (x, lcs) if np.isfinite(x).all() else None
        if memory.sample is None or sample is None:
            bad = sample is None
            status = DynamicsStatus.BAD_SAMPLE if bad else DynamicsStatus.WAITING
            return DynamicsMemory(sample, memory.errors, status)
        x_before, lcs_before = memory.sample
        try:
            error = step_error(lcs_before, x_before, u, x)
        except ValueError:
            error = np.full_like(x, np.nan)
        if not np.isfinite(error).all():
            return DynamicsMemory(sample, memory.errors, DynamicsStatus.BAD_SAMPLE)
        errors = np.vstack([memory.errors, error])[-self._n_b :]
        errors.setflags(write=False)
        return DynamicsMemory(sample, errors, DynamicsStatus.LEARNED)

    def _memory_of(self, context) -> Any:
        return context.get_abstract_state(self._memory).get_value()

    def _r_dyn(self, context) -> np.ndarray:
        errors = self._memory_of(context).errors
        return errors.mean(axis=0) if len(errors) else np.zeros(errors.shape[1])

    def _calc_r_dyn(self, context, output):
        output.SetFromVector(self._r_dyn(context))

    def _calc_lcs(self, context, output):
        lcs = self._lcs.Eval(context)
        output.set_value(with_dynamics_residual(lcs, self._r_dyn(context)))

    def _calc_status(self, context, output):
        output.SetFromVector([float(self._memory_of(context).status)])
