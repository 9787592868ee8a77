"""Baseline: biomimetic adaptive control of a point in the plane."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.baselines.numerics.biomimetic import (
    LearnedGains,
    after_trial,
    force_command,
    no_gains,
)
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

HELD, AT_LIMIT = 1, 2  # Bits of the status.


@dataclass
class BiomimeticConfig:
    """Settings of the baseline biomimetic adaptive control."""

    kappa: float = 10.0  # Weight kappa of the position error in eps [1/s].
    # Learning rates Q_F [N s/m], Q_K [N s/m2] and Q_D [N s2/m2] of force, stiffness and
    # damping.
    rates: list[float] = field(default_factory=lambda: [10.0, 100.0, 10.0])
    stiffness: float = 200.0  # Stiffness K_0 that is never unlearned [N/m].
    damping: float = 28.0  # Damping D_0 that is never unlearned [N s/m].
    # Fraction a that is forgotten per trial where there is no error.
    forget: float = 0.05
    # Factor b by which larger errors reduce the forgetting [s2/m2].
    forget_less: float = 5.0
    step_sec: float = 0.01  # Time for which F, K and D are constant [s].


class Biomimetic(LeafSystem):
    """Follows the target with the gains learned in earlier trials, and records the
    errors of this one.

    Gains are constant over each time step of step_sec; the last ones are held.

    Inputs:  state (4,) p, v; x_desired (6,) p, v, a.
    Outputs: u (2,) [N]; status (1,), a sum: 1 not finite, u held; 2 u at its limit.

    Args: duration_sec: of a trial; knowledge: gains from earlier trials, None for the
        first one; mass [kg]; force_max: limit of |u| [N].
    Raises: ValueError that names what is wrong.
    Source: Yang et al. (2011); see numerics/biomimetic.py.
    """

    def __init__(
        self,
        config: BiomimeticConfig,
        duration_sec: float,
        knowledge: LearnedGains | None = None,
        mass: float = 1.0,
        force_max: float = 100.0,
        period_sec: float = 0.001,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        c = config
        rates = np.array(c.rates, dtype=float)
        if rates.shape != (3,) or not np.all((rates >= 0.0) & np.isfinite(rates)):
            raise ValueError(f"rates is {c.rates}, expected 3 numbers >= 0")
        for name in ("kappa", "stiffness", "damping", "forget_less"):
            if not 0.0 <= getattr(c, name) < np.inf:
                raise ValueError(f"{name} is {getattr(c, name)}, expected >= 0")
        if not 0.0 <= c.forget < 1.0:
            raise ValueError(f"forget is {c.forget}, expected 0 <= forget < 1")
        for name, number in (
            ("duration_sec", duration_sec),
            ("mass", mass),
            ("force_max", force_max),
            ("period_sec", period_sec),
        ):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        every = c.step_sec / period_sec
        if every < 1.0 or abs(every - round(every)) > 1e-9:
            raise ValueError(
                f"step_sec is {c.step_sec}, expected a multiple of {period_sec}"
            )
        n = int(np.ceil(duration_sec / c.step_sec - 1e-9))
        gains = no_gains(n) if knowledge is None else knowledge
        if len(gains.force) != n:
            raise ValueError(
                f"knowledge is of {len(gains.force)} time steps, expected {n}"
            )
        self._config, self._gains, self._n = config, gains, n
        self._every, self._period = round(every), period_sec
        self._fixed = np.array([c.stiffness, c.damping], dtype=float)
        self._mass, self._force_max = float(mass), float(force_max)
        self._state = self.DeclareVectorInputPort("state", 4)
        self._target = self.DeclareVectorInputPort("x_desired", 6)
        self._count = self.DeclareDiscreteState(1)  # Updates since time 0.
        self._u = self.DeclareDiscreteState(2)
        self._status = self.DeclareDiscreteState(1)
        # e, de/dt at the start of each time step; NaN before it.
        self._errors = self.DeclareDiscreteState(np.full(4 * n, np.nan))
        self.DeclareStateOutputPort("u", self._u)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)
        self._command(np.zeros(4), np.zeros(6), 0)  # Compile it now.

    def knowledge(self, context: Context) -> LearnedGains:
        """The gains after this trial, for the constructor of the next trial's."""
        errors = context.get_discrete_state(self._errors).value().reshape(self._n, 4)
        c = self._config
        return after_trial(
            self._gains,
            errors[:, :2],
            errors[:, 2:],
            c.kappa,
            c.rates,
            c.forget,
            c.forget_less,
        )

    def _command(self, state, target, k):
        g = self._gains
        return force_command(
            state,
            target,
            g.force[k],
            g.stiffness[k],
            g.damping[k],
            self._fixed,
            self._mass,
            self._force_max,
        )

    @timed
    def _update(self, context: Context, discrete_state):
        count = int(context.get_discrete_state(self._count).value()[0])
        state, target = self._state.Eval(context), self._target.Eval(context)
        k = min(count // self._every, self._n - 1)
        u, limit = self._command(state, target, k)
        if np.isfinite(u[0] + u[1]):
            discrete_state.set_value(self._u, u)
            discrete_state.set_value(self._status, [AT_LIMIT if limit else 0])
        else:
            discrete_state.set_value(self._status, [HELD])
        if count % self._every == 0 and count // self._every < self._n:
            errors = discrete_state.get_mutable_vector(self._errors)
            for i in range(4):
                errors.SetAtIndex(4 * k + i, state[i] - target[i])
        discrete_state.set_value(self._count, [count + 1.0])
