"""The system that chooses where to touch next (numerics/contact_sampling.py)."""

from collections.abc import Sized
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from operator import attrgetter
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, Q_BALL
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ObjectShape,
    SamplingConfig,
    SamplingMemory,
    sample_round,
)
from makebreak.systems.contact_mpc.numerics.lcs import is_finite
from makebreak.systems.contact_mpc.numerics.object_frame import (
    heading_of,
    turned_inputs,
)
from makebreak.systems.contact_mpc.numerics.outline import (
    distance_to_outline,
    outline_of,
)
from makebreak.systems.contact_mpc.numerics.plan_scores import score_plans
from makebreak.systems.contact_mpc.numerics.push_task import CONTACT, errors
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

PLACES_MAX = 1000  # Candidate places in a round.


class SamplerStatus(IntEnum):
    """The `status` port: if it is not 0, the last place is kept, for this reason."""

    CHOSEN = 0
    NONE_YET = 1  # Before the first update.
    NOT_FINITE = 2  # An entry of x, x_desired, goal, phase, valid or r_comp.
    NOT_SEEN = 3  # The object.
    NO_PLAN = 4  # C3 found a plan from no place.


class Model(Protocol):
    """What gives the LCS about many states: AnitescuLcs of lcs_builder.py."""

    n_x: int
    n_u: int
    n_lam: int
    dt_sec: float
    x_default: np.ndarray

    @property
    def parameters(self) -> Sized:
        """Those of which build_many takes values."""
        ...

    def build_many(self, x, u, parameters=None) -> tuple[np.ndarray, ...]: ...


@dataclass
class ContactSamplerConfig:
    """Settings of ContactSampler."""

    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    # Radius at which an angle to the goal counts as the distance of its arc [m]; the
    # diagram sets it.
    angle_radius: float = 0.12
    # Time step over which r_comp is a velocity [s]; the diagram sets it.
    residual_dt_sec: float = 0.05
    # Wall-clock time for a round [s]; places that are not scored by then are left out;
    # inf: all are scored, and runs repeat bit for bit.
    budget_sec: float = np.inf
    period_sec: float = 0.1  # Period of the rounds of sampling [s].
    offset_sec: float = 0.0  # Time of the first round [s]; the diagram sets it.


class ContactSampler(LeafSystem):
    """Chooses the place beside an object where the tip is to touch it.

    Inputs:  x (19,) of numerics/ball_state.py; x_desired ((N + 1) 19,) of C3;
             goal (3,) = x, y [m], yaw [rad]; phase (1,) of PushTask; valid (1,): above
             0.5 if the object is seen; r_comp (n_lam,) [m/s], optional: the learned
             residual, used in every plan. Where it says that the object reaches farther
             than modelled, the places lie farther out (with sampling.follow they also
             lie nearer where it reaches less far). parameters (n,), if the model has
             parameters, optional: their values for every plan.
    Outputs: command (3,) = [number, x, y]: a place in the object's frame, seen from
             above [m]. A new number is a new command to move there; 0: none yet;
             guess (N n_u,) [N]: inputs of the plan that the place was chosen for, as
             C3Mpc reads them;
             status (1,): a SamplerStatus; round (abstract): the last Round, or ().

    The command is kept while an input is not finite, the object is not seen or no place
    has a plan (status).

    Args: config; model: the planner's contact model; problem: the same C3 problem as
        C3Mpc solves; shape: of object and tip.
    Raises: ValueError for a setting out of range, or sizes of model and problem that
        differ.
    """

    def __init__(
        self,
        config: ContactSamplerConfig,
        model: Model,
        problem: C3Problem,
        shape: ObjectShape,
    ):
        super().__init__()
        check_settings(config)
        _check(config)
        self._config, self._model, self._shape = config, model, shape
        self._problem = p = problem
        if (model.n_x, model.n_u, model.n_lam) != (p.n_x, p.n_u, p.n_lam):
            raise ValueError(
                f"ContactSampler: the model has (n_x, n_u, n_lam) = "
                f"{model.n_x, model.n_u, model.n_lam}, the weights are for "
                f"{p.n_x, p.n_u, p.n_lam}"
            )
        self._x = self.DeclareVectorInputPort("x", N_X)
        n_knots = p.options.N + 1
        self._x_desired = self.DeclareVectorInputPort("x_desired", n_knots * N_X)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._phase = self.DeclareVectorInputPort("phase", 1)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._r_comp = self.DeclareVectorInputPort("r_comp", p.n_lam)
        n = len(model.parameters)
        self._parameters = self.DeclareVectorInputPort("parameters", n) if n else None
        self._memory = self.DeclareAbstractState(Value[object](SamplingMemory()))
        # Not None, which Drake 1.58 cannot hold.
        self._round = self.DeclareAbstractState(Value[object](()))
        self._command = self.DeclareDiscreteState(3)
        self._guess = self.DeclareDiscreteState(p.options.N * p.n_u)
        self._status = self.DeclareDiscreteState([float(SamplerStatus.NONE_YET)])
        self.DeclareStateOutputPort("command", self._command)
        self.DeclareStateOutputPort("guess", self._guess)
        self.DeclareStateOutputPort("status", self._status)
        self.DeclareStateOutputPort("round", self._round)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )
        # Compiles the machine code before the first update.
        x = model.x_default[None]
        lcs = model.build_many(x, np.zeros(p.n_u))
        score_plans(lcs, x, np.tile(x, (n_knots, 1)), p)
        distance_to_outline(
            np.zeros((1, 2)), outline_of(shape.parts, np.eye(3), np.zeros(3))
        )

    @timed
    def _update(self, context, state):
        status = self._sample(context, state)
        state.get_mutable_discrete_state(self._status).set_value([float(status)])

    def _sample(self, context, state) -> SamplerStatus:
        c, p = self._config, self._problem
        x, x_desired, goal, phase, valid = (
            np.asarray(port.Eval(context))
            for port in (self._x, self._x_desired, self._goal, self._phase, self._valid)
        )
        gap = np.zeros(p.n_lam)  # Learned error of the gaps [m].
        if self._r_comp.HasValue(context):
            gap = np.asarray(self._r_comp.Eval(context)) * c.residual_dt_sec
        r = gap / self._model.dt_sec
        if not all(is_finite(a) for a in (x, x_desired, goal, phase, valid, r)):
            return SamplerStatus.NOT_FINITE
        if not valid[0] > 0.5:
            return SamplerStatus.NOT_SEEN
        build_many = self._model.build_many
        if self._parameters is not None and self._parameters.HasValue(context):
            values = np.asarray(self._parameters.Eval(context))
            if not is_finite(values):
                return SamplerStatus.NOT_FINITE
            build_many = partial(build_many, parameters=values)
        memory = context.get_abstract_state(int(self._memory)).get_value()
        length, angle = errors(x, goal)
        # An object that lies still is approached no nearer than its model says.
        nearer = -float(gap.min())
        nearer = nearer if c.sampling.follow else max(0.0, nearer)
        try:
            memory, found = sample_round(
                c.sampling, memory, build_many, p, self._shape, x,
                x_desired.reshape(-1, N_X), length + c.angle_radius * angle,
                phase[0] == CONTACT, context.get_time(), r, c.budget_sec,
                nearer,
                tuple(goal.tolist()), self._model.dt_sec,
            )  # fmt: skip
        except ValueError:  # An object on edge has no outline.
            return SamplerStatus.NO_PLAN
        abstract = state.get_mutable_abstract_state
        abstract(int(self._memory)).set_value(memory)
        abstract(int(self._round)).set_value(found)
        discrete = state.get_mutable_discrete_state
        if memory.place is not None:
            discrete(self._command).set_value([float(memory.go), *memory.place])
        if memory.inputs is not None:
            inputs = turned_inputs(memory.inputs, heading_of(x[Q_BALL]))
            discrete(self._guess).set_value(inputs.ravel())
        if not np.isfinite(found.cost[found.chosen]):
            return SamplerStatus.NO_PLAN
        return SamplerStatus.CHOSEN


def _check(config: ContactSamplerConfig) -> None:
    """Raises: ValueError that names a setting out of range."""
    c = config.sampling
    if c.places != int(c.places) or not 1 <= c.places <= PLACES_MAX:
        raise ValueError(
            f"sampling.places is {c.places}, expected an integer from 1 to {PLACES_MAX}"
        )
    positive = ("clearance", "height", "change.speed", "change.stuck_sec")
    for name in (*positive, "reach.bearing"):
        if not 0.0 < (value := attrgetter(name)(c)) < np.inf:
            raise ValueError(f"sampling.{name} is {value}, expected > 0")
    at_least_0 = ("change.travel", "change.pause_sec", "push", "reach.cost")
    for name in (*at_least_0, "reach.inwards"):
        if not 0.0 <= (value := attrgetter(name)(c)) < np.inf:
            raise ValueError(f"sampling.{name} is {value}, expected >= 0")
    for name in ("change.hysteresis", "reach.range", "reach.wrist"):
        if np.shape(value := attrgetter(name)(c)) != (2,):
            raise ValueError(f"sampling.{name} is {value}, expected two numbers")
    share, absolute = c.change.hysteresis
    if not (0.0 <= share < 1.0 and absolute >= 0.0):
        raise ValueError(
            f"sampling.change.hysteresis is {c.change.hysteresis}, expected [share, "
            "cost] with 0 <= share < 1 and cost >= 0"
        )
    if not 0.0 <= c.reach.range[0] < c.reach.range[1]:
        raise ValueError(
            f"sampling.reach.range is {c.reach.range}, expected [least, most] from the "
            "world's origin in metres"
        )
    for name in ("budget_sec", "residual_dt_sec", "period_sec"):
        if not getattr(config, name) > 0.0:
            raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")
