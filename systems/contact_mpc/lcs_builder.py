"""AnitescuLcsBuilder: the LCS of a plant about its present state, as a LeafSystem.

What computes the LCS from a plant is in multibody/, and the maths in numerics/.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.multibody.anitescu_lcs import AnitescuLcs
from makebreak.systems.contact_mpc.multibody.contact_pair import (
    Anitescu,
    ContactPair,
    StewartTrinkle,
)
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.numerics.c3_plan import Plan
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

__all__ = [
    "Anitescu",
    "AnitescuLcs",
    "AnitescuLcsBuilder",
    "ContactPair",
    "LcsBuilderConfig",
    "LcsBuilderStatus",
    "StewartTrinkle",
]


@dataclass
class LcsBuilderConfig:
    """Settings of AnitescuLcsBuilder: contacts, time step, rate."""

    contacts: list[ContactPair] = field(default_factory=list)
    dt_sec: float = 0.1  # Time step of the LCS [s].
    eps_c: float | None = None  # [m/s per N]; None: 0.01 dt_sec.
    period_sec: float = 0.0125  # Between two linearisations [s].
    offset_sec: float = 0.0  # Time of the first one [s].
    closest: int | None = None  # Number of contacts, the nearest ones; None: all.
    # 0: one LCS about x. N: a tuple of N, one for each knot along the input `plan`.
    knots: int = 0
    # Of bodies, joints and pairs, whose values the input `parameters` has.
    parameters: list[Parameter] = field(default_factory=list)


class LcsBuilderStatus(IntEnum):
    """Values of the `status` port of AnitescuLcsBuilder."""

    HELD = 0  # The last LCS is held, as x or u is not usable.
    BUILT = 1
    # Some states of the plan are not usable; their knots have the LCS about x.
    BUILT_IN_PART = 2


class AnitescuLcsBuilder(LeafSystem):
    """The LCS about the present state, held between updates.

    Inputs:  x (n_x,) state [q, v] of the model plant; u (n_u,) its actuation;
             friction (n_pairs,) of the pairs, optional; gap (n_pairs,) added to their
             distances [m], optional; parameters (n,), with config.parameters only,
             optional: their values, as of a ParameterLearner;
             plan (abstract, Plan), with config.knots > 0 only: the last plan, about
             whose states the LCS of all knots but the first are built. Before the
             first plan, all are about x.
    Outputs: lcs (abstract, LCS with dt and phi; with config.knots > 0 a tuple of
             them); status (1,): an LcsBuilderStatus.

    Before the first update: the LCS about the plant's default state with u = 0.

    Args: diagram, see AnitescuLcs; config.
    """

    def __init__(self, diagram, config: LcsBuilderConfig):
        super().__init__()
        check_settings(config)
        c = config
        if c.knots != int(c.knots) or c.knots < 0:
            raise ValueError(
                f"LcsBuilderConfig.knots is {c.knots}, expected an integer of at least "
                "0"
            )
        self.model = AnitescuLcs(
            diagram,
            c.contacts,
            c.dt_sec,
            c.eps_c,
            closest=c.closest,
            parameters=c.parameters,
        )
        initial = self.model.at_default()
        self._knots = int(c.knots)
        self._x = self.DeclareVectorInputPort("x", self.model.n_x)
        self._u = self.DeclareVectorInputPort("u", self.model.n_u)
        self._changes = [
            self.DeclareVectorInputPort(name, self.model.n_pairs)
            for name in ("friction", "gap")
        ]
        if c.parameters:
            n = len(c.parameters)
            self._changes.append(self.DeclareVectorInputPort("parameters", n))
        if self._knots:
            self._plan = self.DeclareAbstractInputPort(
                "plan", AbstractValue.Make(object())
            )
        self._lcs = self.DeclareAbstractState(
            Value[object]((initial,) * self._knots if self._knots else initial)
        )
        status: Any = [float(LcsBuilderStatus.BUILT)]  # The stubs expect an array.
        self._status = self.DeclareDiscreteState(status)
        self.DeclareStateOutputPort("lcs", self._lcs)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            c.period_sec, c.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        x, u = self._x.Eval(context), self._u.Eval(context)
        status = LcsBuilderStatus.BUILT
        try:
            lcs = self.model.build(x, u, *self._changed(context))
        except (ValueError, RuntimeError):
            status, lcs = LcsBuilderStatus.HELD, None
        if lcs is not None and self._knots:
            lcs, status = self._along_plan(context, lcs)
        if lcs is not None:
            state.get_mutable_abstract_state(int(self._lcs)).set_value(lcs)
        state.get_mutable_discrete_state(self._status).set_value([float(status)])

    def _changed(self, context):
        """The arguments friction, gap and parameters of AnitescuLcs.build."""
        return (
            port.Eval(context) if port.HasValue(context) else None
            for port in self._changes
        )

    def _along_plan(self, context, first):
        """The LCS of all knots, with `first` at the first one, and a status."""
        models, status = [first] * self._knots, LcsBuilderStatus.BUILT
        plan: Any = self._plan.Eval(context) if self._plan.HasValue(context) else None
        if not isinstance(plan, Plan) or plan.time is None:
            return tuple(models), status
        x, u = plan.at(
            context.get_time() + self.model.dt_sec * np.arange(1, self._knots)
        )
        changed = list(self._changed(context))
        for k in range(1, self._knots):
            try:
                models[k] = self.model.build(x[k - 1], u[k - 1], *changed)
            except (ValueError, RuntimeError):
                status = LcsBuilderStatus.BUILT_IN_PART
        return tuple(models), status
