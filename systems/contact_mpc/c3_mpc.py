"""C3 as a system: plans through contact and commands the first input of the plan."""

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
from makebreak.systems.numerics.settings import check_settings, check_times
from makebreak.systems.numerics.timing import timed


class C3Status(IntEnum):
    """The `status` port: if it is not 0, the last plan is kept, for this reason."""

    SOLVED = 0
    NO_PLAN_YET = 1
    BAD_X = 2  # Not finite, as for the next three.
    BAD_X_DESIRED = 3
    BAD_R_COMP = 4
    BAD_LCS = 5  # Not finite, or its sizes differ from those of the weights.
    SOLVE_FAILED = 6
    COMMAND_FAILED = 7  # The plan is new, but x_next and lam are the last ones.


@dataclass
class C3Config:
    """What C3Mpc plans with: cost, projection, options, bounds."""

    weights: C3Weights = field(default_factory=C3Weights)  # Must be given.
    # In YAML `projection: !PlusProjection {}`, `!QpProjection {alpha: 0.01}`,
    # `!ExactProjection {}`.
    projection: PlusProjection | QpProjection | ExactProjection = field(
        default_factory=PlusProjection
    )
    options: C3Options = field(default_factory=C3Options)
    bounds: C3Bounds = field(default_factory=C3Bounds)
    residual_dt_sec: float = 0.05  # Time step over which r_comp is a velocity [s].
    # Number of first knots whose contact modes are fixed to those that a rollout of the
    # last plan's inputs from x passes through.
    fixed_knots: int = 0
    clamp_command_gap: bool = True  # x_next treats penetration as a gap of zero.
    # x_next leaves out the gap that a sliding Anitescu contact opens (opening_speed).
    sliding_command: bool = False


class C3Mpc(LeafSystem):
    """Model predictive control through contact: C3 with its projections, and C3+.

    Inputs:  x (n_x,) [SI];
             x_desired ((N + 1) n_x,): the target (N + 1, n_x), row by row;
             lcs (abstract): the LCS of the horizon, or a sequence of N, one per knot;
             lcs_command (abstract), optional: the LCS of one control step, for x_next;
             default: lcs, or its first one;
             r_comp (n_lam,) [m/s], optional: the learned residual; default: zero;
             guess (N n_u,) [N], optional: inputs of a plan, row by row, which the
             polish starts from if they cost less than C3's and the last plan's.
    Outputs: u (n_u,) [N], always within its bounds;
             x_next (n_x,), lam (n_lam,) [N]: one step of lcs_command under u;
             plan: Plan (abstract);
             status (1,): a C3Status.

    r_comp is an error of the gaps over residual_dt_sec; for an LCS of another time step
    it is scaled by residual_dt_sec / lcs.dt and added to c. With clamp_command_gap the
    corrected gap phi + r dt of a penetrating contact is set to zero in lcs_command: a
    short step would otherwise command the penetration out at the speed phi / dt.

    If an input is not finite or the solve fails, u follows the last plan (after its end
    u is zero, or the bound nearest to zero), x_next and lam stay, and status gives the
    reason. Before the first solve u is zero likewise, and x_next is the initial x.

    Args: config; period_sec, offset_sec: of the updates [s].
    Raises: ValueError for a setting out of range.
    Source: ACI-MPC, sections IV and VI.
    """

    def __init__(self, config: C3Config, period_sec: float, offset_sec: float = 0.0):
        super().__init__()
        check_settings(config)
        check_times("C3Mpc", period_sec, offset_sec)
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
        self._per_force = [p.n_x]  # Where blocks of n_lam entries begin in z.
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
        self._guess = self.DeclareVectorInputPort("guess", N * p.n_u)
        u_lower, u_upper = (b[p.n_lam : p.n_lam + p.n_u] for b in (p.lower, p.upper))
        self._u_idle = np.clip(np.zeros(p.n_u), u_lower, u_upper)

        def state(*shape, value=0.0):
            flat = np.array(np.broadcast_to(value, shape), dtype=float).ravel()
            return self.DeclareDiscreteState(flat), shape

        self._u = state(p.n_u, value=self._u_idle)
        self._x_next, self._lam = state(p.n_x), state(p.n_lam)
        self._status = state(1, value=float(C3Status.NO_PLAN_YET))
        # The plan's age and the time between its knots [s].
        self._age, self._plan_dt = state(1), state(1, value=1.0)
        self._plan_time = state(1, value=np.nan)  # Time of its first knot [s].
        self._plan_cut = state(1)  # Number of projections that hit their limit.
        self._plan_x = state(N + 1, p.n_x)
        self._plan_u = state(N, p.n_u, value=self._u_idle)
        self._plan_lam = state(N, p.n_lam)
        self._delta, self._w = state(N, p.n_z), state(N, p.n_z)
        # Number of the contact that each force belongs to; -1: unknown.
        self._contact = state(N, p.n_lam, value=-1.0)
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
                guess = None
                if self._guess.HasValue(context):
                    guess = np.asarray(self._guess.Eval(context))
                    guess = guess if is_finite(guess) else None
                plan, warm = solve_c3(
                    lcs, x, x_desired, self._problem, warm, modes, guess
                )
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
        """(N, n_lam) the contact number of each force; -1 where the LCS has none."""
        N, n_lam = self._problem.options.N, self._problem.n_lam
        models = [lcs] * N if isinstance(lcs, LCS) else lcs
        unknown = np.full(n_lam, -1.0)
        return np.array([
            unknown if m.contact is None else m.contact for m in models
        ])  # fmt: skip

    def _modes(self, context, lcs, x, dt):
        """Contact modes of the first fixed_knots knots, from a rollout of the last
        plan's inputs; None without a last plan or where the rollout fails."""
        last = self._plan_now(context) if self._fixed_knots else None
        if last is None or last.time is None:
            return None
        times = context.get_time() + dt * np.arange(self._fixed_knots)
        try:
            return contact_modes(lcs, x, last.at(times)[1])
        except ValueError:
            return None

    def _read_inputs(self, context):
        """SOLVED and (x, x_desired, lcs, lcs_command), or a failure and None."""
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
        """Whether these are one finite LCS of the weights' sizes, or N with one dt."""
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
        """Keeps the last plan and commands its input for the present time."""
        age = self._get(context, self._age)[0] + self._period
        # 1e-6: the rounding of this sum of periods must not delay a knot by a period.
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
