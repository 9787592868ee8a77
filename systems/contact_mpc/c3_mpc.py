"""C3 as a system: plans through contact, and commands one step of the model."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.c3_admm import C3Failure
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Bounds,
    C3Options,
    C3Problem,
    C3Weights,
    command_step,
    solve_c3,
    warm_up,
    with_gap_residual,
)
from makebreak.systems.contact_mpc.numerics.c3_plan import Plan, WarmStart
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.lcs import (
    LCS,
    contact_modes,
    is_finite,
    is_finite_model,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import timed


class C3Status(IntEnum):
    """The `status` port: 0 is good, anything else says why the last plan is held."""

    SOLVED = 0
    NO_PLAN_YET = 1
    BAD_X = 2  # A NaN or an infinity in x, ...
    BAD_X_DESIRED = 3
    BAD_R_COMP = 4
    BAD_LCS = 5  # ... also: of other dimensions than the weights.
    SOLVE_FAILED = 6
    COMMAND_FAILED = 7  # The plan is new; x_next and lam are not.


@dataclass
class C3Config:
    weights: C3Weights = field(default_factory=C3Weights)  # Must be given.
    # In YAML `projection: !PlusProjection {}`, `!QpProjection {alpha: 0.01}`,
    # `!ExactProjection {}`: each carries its own numbers and no others.
    projection: PlusProjection | QpProjection | ExactProjection = field(
        default_factory=PlusProjection
    )
    options: C3Options = field(default_factory=C3Options)
    bounds: C3Bounds = field(default_factory=C3Bounds)
    residual_dt_sec: float = 0.05  # Time step at which r_comp is a velocity.
    # The first knots keep the contact modes that the last plan's inputs have from x.
    fixed_knots: int = 0
    clamp_command_gap: bool = True  # Treat penetration as touching in x_next.
    # In x_next a contact that slides is not felt from a distance (opening_speed).
    sliding_command: bool = False


class C3Mpc(LeafSystem):
    """Model predictive control through contact: C3 with its projections, and C3+.

    Inputs:  x (n_x,) [SI];
             x_desired ((N + 1) n_x,), the target (N + 1, n_x) flattened row by row;
             lcs (abstract): LCS of the horizon, or a sequence of N, one per knot;
             lcs_command: LCS of the command's step (abstract), optional, else lcs (of
             the first knot);
             r_comp (n_lam,) [m/s at residual_dt_sec], optional, else zero.
    Outputs: u (n_u,) [N], always within its bounds;
             x_next (n_x,), lam (n_lam,) [N]: one step of the command's LCS under u;
             plan: Plan (abstract);
             status (1,): a C3Status.

    r_comp is added to c of both models, scaled by residual_dt_sec / lcs.dt (a gap's
    residual counts as a velocity over one step). In the command's model the residual
    gap phi + r dt of a penetrated contact is taken for zero, if clamp_command_gap:
    a short step would otherwise command the penetration out at phi / dt.

    Where an input is not finite or the solve fails, u follows the last plan as time
    goes on and is zero (or the bound next to it) behind its end, x_next and lam stay,
    and status says why. Before the first solve u is that zero and x_next is the x of
    the initialisation.

    Source: ACI-MPC, section IV and VI.
    """

    def __init__(self, config: C3Config, period_sec: float, offset_sec: float = 0.0):
        super().__init__()
        if not config.residual_dt_sec > 0.0:
            raise ValueError(
                f"C3Config.residual_dt_sec is {config.residual_dt_sec}, expected > 0"
            )
        self._problem = p = C3Problem(
            config.weights, config.projection, config.options, config.bounds
        )
        self._residual_dt = config.residual_dt_sec
        self._fixed_knots = config.fixed_knots
        if config.fixed_knots not in range(p.options.N + 1):
            raise ValueError(
                f"C3Config.fixed_knots is {config.fixed_knots}, expected an integer "
                f"from 0 to N = {p.options.N}"
            )
        self._per_force = [p.n_x]  # Where the entries per force begin in z.
        if p.is_plus:
            self._per_force.append(p.n_x + p.n_lam + p.n_u)
        self._clamp, self._sliding = config.clamp_command_gap, config.sliding_command
        self._period = period_sec
        N = p.options.N
        self._x_in = self.DeclareVectorInputPort("x", p.n_x)
        self._x_desired = self.DeclareVectorInputPort("x_desired", (N + 1) * p.n_x)
        self._lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(object()))
        self._lcs_command = self.DeclareAbstractInputPort(
            "lcs_command", AbstractValue.Make(object())
        )
        self._r_comp = self.DeclareVectorInputPort("r_comp", p.n_lam)
        u_lower, u_upper = (b[p.n_lam : p.n_lam + p.n_u] for b in (p.lower, p.upper))
        self._u_idle = np.clip(np.zeros(p.n_u), u_lower, u_upper)

        def state(*shape, value=0.0):
            flat = np.array(np.broadcast_to(value, shape), dtype=float).ravel()
            return self.DeclareDiscreteState(flat), shape

        self._u = state(p.n_u, value=self._u_idle)
        self._x_next, self._lam = state(p.n_x), state(p.n_lam)
        self._status = state(1, value=float(C3Status.NO_PLAN_YET))
        # How old the plan is, and how long its knots are [s].
        self._age, self._plan_dt = state(1), state(1, value=1.0)
        self._plan_time = state(1, value=np.nan)  # Of its first knot [s].
        self._plan_cut = state(1)  # Its projections that were cut short.
        self._plan_x = state(N + 1, p.n_x)
        self._plan_u = state(N, p.n_u, value=self._u_idle)
        self._plan_lam = state(N, p.n_lam)
        self._delta, self._w = state(N, p.n_z), state(N, p.n_z)
        self._contact = state(N, p.n_lam, value=-1.0)  # Of each force; -1: unknown.
        self.DeclareStateOutputPort("u", self._u[0])
        self.DeclareStateOutputPort("x_next", self._x_next[0])
        self.DeclareStateOutputPort("lam", self._lam[0])
        self.DeclareAbstractOutputPort(
            "plan",
            lambda: AbstractValue.Make(object()),
            self._calc_plan,
            {self.xd_ticket()},
        )
        self.DeclareStateOutputPort("status", self._status[0])
        self.DeclareInitializationDiscreteUpdateEvent(self._initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)
        first_call(warm_up, p)

    def _initialize(self, context, discrete_state):
        x = np.asarray(self._x_in.Eval(context))
        if np.isfinite(x).all():
            discrete_state.set_value(self._x_next[0], x)
            N = self._problem.options.N
            discrete_state.set_value(self._plan_x[0], np.tile(x, N + 1))

    @timed
    def _update(self, context, discrete_state):
        def write(state, value):
            discrete_state.set_value(state[0], np.ravel(value))

        status, inputs = self._read_inputs(context)
        if inputs is not None:
            x, x_desired, lcs, lcs_command = inputs
            dt = (lcs if isinstance(lcs, LCS) else lcs[0]).dt
            warm = WarmStart(
                *(self._get(context, s) for s in (self._plan_u, self._delta, self._w))
            )
            contact = self._contacts_of(lcs)
            try:
                if self._problem.options.warm_start:
                    before = self._get(context, self._contact)
                    contacts = before, contact, self._per_force
                    warm = warm.shifted(min(self._period / dt, 1.0), contacts)
                modes = self._modes(context, lcs, x, dt)
                plan, warm = solve_c3(lcs, x, x_desired, self._problem, warm, modes)
            except C3Failure:
                status = C3Status.SOLVE_FAILED
        write(self._status, status)
        if status != C3Status.SOLVED:
            self._hold(context, write)
            return
        write(self._age, 0.0)
        write(self._plan_dt, dt)
        write(self._plan_time, context.get_time())
        write(self._plan_cut, plan.cut_projections)
        write(self._u, plan.u[0])
        write(self._plan_x, plan.x)
        write(self._plan_u, plan.u)
        write(self._plan_lam, plan.lam)
        write(self._delta, warm.delta)
        write(self._w, warm.w)
        write(self._contact, contact)
        try:
            x_next, lam = command_step(lcs_command, x, plan.u[0])
        except C3Failure:
            write(self._status, C3Status.COMMAND_FAILED)
            return
        write(self._x_next, x_next)
        write(self._lam, lam)

    def _contacts_of(self, lcs):
        """(N, n_lam) the contact of each knot's forces; -1 where the LCS says none."""
        N, n_lam = self._problem.options.N, self._problem.n_lam
        models = [lcs] * N if isinstance(lcs, LCS) else lcs
        unknown = np.full(n_lam, -1.0)
        return np.array([
            unknown if m.contact is None else m.contact for m in models
        ])  # fmt: skip

    def _modes(self, context, lcs, x, dt):
        """Contact modes of the first knots under the last plan's inputs; or None."""
        last = self._plan_now(context) if self._fixed_knots else None
        if last is None or last.time is None:
            return None
        times = context.get_time() + dt * np.arange(self._fixed_knots)
        try:
            return contact_modes(lcs, x, last.at(times)[1])
        except ValueError:  # No rollout, no modes: they stay free.
            return None

    def _read_inputs(self, context):
        """SOLVED and (x, x_desired, lcs, lcs_command); or why not, and None."""
        p = self._problem
        x = np.asarray(self._x_in.Eval(context))
        x_desired = np.asarray(self._x_desired.Eval(context))
        r_comp = np.zeros(p.n_lam)
        if self._r_comp.HasValue(context):
            r_comp = np.asarray(self._r_comp.Eval(context))
        lcs: Any = self._lcs.Eval(context)
        lcs_command = lcs[0] if isinstance(lcs, Sequence) and len(lcs) else lcs
        if self._lcs_command.HasValue(context):
            lcs_command = self._lcs_command.Eval(context)
        for status, values in (
            (C3Status.BAD_X, x),
            (C3Status.BAD_X_DESIRED, x_desired),
            (C3Status.BAD_R_COMP, r_comp),
        ):
            if not is_finite(values):
                return status, None
        of_knots = [lcs] if isinstance(lcs, LCS) else lcs
        if not (self._are_good(of_knots) and self._are_good([lcs_command])):
            return C3Status.BAD_LCS, None
        at = x if self._sliding else None
        of_knots = [
            with_gap_residual(m, r_comp, self._residual_dt, clamp=False)
            for m in of_knots
        ]
        return C3Status.SOLVED, (
            x,
            x_desired.reshape(-1, p.n_x),
            of_knots if isinstance(lcs, Sequence) else of_knots[0],
            with_gap_residual(lcs_command, r_comp, self._residual_dt, self._clamp, at),
        )

    def _are_good(self, models):
        """Whether these are one LCS, or N of one time step, of the weights' sizes."""
        p = self._problem
        if not isinstance(models, Sequence) or len(models) not in (1, p.options.N):
            return False
        return all(
            isinstance(m, LCS)
            and (m.n_x, m.n_u, m.n_lam) == (p.n_x, p.n_u, p.n_lam)
            and m.dt == models[0].dt
            and is_finite_model(m)
            for m in models
        )

    def _get(self, context, state):
        index, shape = state
        return context.get_discrete_state(index).value().reshape(shape)

    def _hold(self, context, write):
        """The plan that there is, one period older."""
        age = self._get(context, self._age)[0] + self._period
        # age is a sum of periods: its rounding must not delay a knot by a period.
        knot = int(age / self._get(context, self._plan_dt)[0] + 1e-6)
        plan_u = self._get(context, self._plan_u)
        write(self._age, age)
        write(self._u, plan_u[knot] if knot < len(plan_u) else self._u_idle)

    def _plan_now(self, context):
        states = self._plan_x, self._plan_u, self._plan_lam
        x, u, lam = (self._get(context, s).copy() for s in states)
        status, time, dt, cut = (
            float(self._get(context, s)[0])
            for s in (self._status, self._plan_time, self._plan_dt, self._plan_cut)
        )
        known = None if np.isnan(time) else time
        return Plan(x, u, lam, int(status), known, dt, int(cut))

    def _calc_plan(self, context, output):
        output.set_value(self._plan_now(context))
