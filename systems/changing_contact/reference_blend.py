"""Who leads the arm: the planner while it rolls the ball, the shaper in between."""

from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import (
    IMPACT,
    N_PHASE,
    PHASE_KIND,
    PHASE_STAGE,
    REGION,
    SETTLE,
)
from makebreak.systems.changing_contact.numerics.push_motion import N_FRAME, frame_at
from makebreak.systems.changing_contact.numerics.reference_blend import (
    N_BLEND,
    blended_reference,
    warm_up,
    weight,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, P_TIP, V_TIP
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

SPEED_MIN = 1e-3  # [m/s] A slower reference has no direction.


@dataclass
class ReferenceBlendConfig:
    """Settings of ReferenceBlend."""

    # Time of a blend between the planner's and the shaper's reference [s].
    blend_sec: float = 0.1
    damping: float = 400.0  # Damping of the arm's tip [N s/m].
    # Damping of the arm's tip where an impact is expected [N s/m].
    damping_impact: float = 120.0
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class ReferenceBlend(LeafSystem):
    """Blends the planner's reference and the shaper's, without a step.

    Inputs:  active (1,) 1: the shaper leads; phase (6,) of the shaper; frame (7,) in
             which it plans; x (19,) estimated;
             planned (19,), planned_wrench (6,) of ArmReference, in the world;
             shaped (19,), force_directions (6,), force_targets (2,) of the shaper;
             wrench_feedforward (6,) of VariableImpedance; task_reference (9,) of
             RollingTask.
    Outputs: x_desired (19,), wrench (6,), damping (6,), force_directions (6,),
             force_targets (2,) for the impedance controller;
             direction (3,) of the reference in the world, zero at rest, and
             contact_directions (6,): the shaper's force directions, or where the
             planner leads from the tip to the ball, for who tells modes apart;
             reference (9,) = p, v, a for ArmReference.
    """

    def __init__(self, config: ReferenceBlendConfig):
        super().__init__()
        check_settings(config)
        for name in ("blend_sec", "damping", "damping_impact", "period_sec"):
            if not 0.0 < getattr(config, name) < np.inf:
                raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")
        self._config = config
        first_call(warm_up)
        self._in = {
            name: self.DeclareVectorInputPort(name, size)
            for name, size in (
                ("active", 1),
                ("phase", N_PHASE),
                ("frame", N_FRAME),
                ("x", N_X),
                ("planned", 19),
                ("planned_wrench", 6),
                ("shaped", 19),
                ("force_directions", 6),
                ("force_targets", 2),
                ("wrench_feedforward", 6),
                ("task_reference", 9),
            )
        }
        self._blend = self.DeclareDiscreteState(N_BLEND)
        self._soft = self.DeclareDiscreteState(N_BLEND)
        mine = {self.discrete_state_ticket(self._blend)}
        soft = {self.discrete_state_ticket(self._soft), self.time_ticket()}
        now = mine | {self.time_ticket()}
        for name, size, calc, reads in (
            (
                "x_desired",
                19,
                self._pose,
                ("frame", "x", "planned", "shaped", "force_directions"),
            ),
            ("wrench", 6, self._wrench, ("planned_wrench", "wrench_feedforward")),
            ("damping", 6, self._damping, ()),
            (
                "force_directions",
                6,
                self._directions,
                ("force_directions",),
            ),
            ("force_targets", 2, self._targets, ("force_targets",)),
            (
                "direction",
                3,
                self._direction,
                ("frame", "x", "planned", "shaped", "force_directions"),
            ),
            ("contact_directions", 6, self._contacts, ("x", "force_directions")),
            (
                "reference",
                9,
                self._reference,
                ("frame", "x", "shaped", "force_directions", "task_reference"),
            ),
        ):
            tickets = now | {self._in[port].ticket() for port in reads}
            tickets = soft if name == "damping" else tickets
            self.DeclareVectorOutputPort(name, size, calc, tickets)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context: Context, discrete_state):
        active = self._eval("active", context)[0] > 0.5
        phase = self._eval("phase", context)
        stages = (REGION, SETTLE)
        impact = active and phase[PHASE_STAGE] in stages and phase[PHASE_KIND] == IMPACT
        for state, goal in ((self._blend, active), (self._soft, impact)):
            blend = context.get_discrete_state(state).value()
            if goal != (blend[1] > 0.5):
                w, _, _ = self._weight(context, state)
                blend = np.array([w, float(goal), context.get_time()])
            discrete_state.set_value(state, blend)

    def _eval(self, name, context):
        return self._in[name].Eval(context)

    def _weight(self, context, state=None):
        state = self._blend if state is None else state
        blend = context.get_discrete_state(state).value()
        return weight(blend, context.get_time(), self._config.blend_sec)

    def _shaper_leads(self, context) -> bool:
        return context.get_discrete_state(self._blend).value()[1] > 0.5

    def _shaped(self, context):
        """The shaper's reference in the world."""
        frame = self._eval("frame", context)
        shaped = np.array(self._eval("shaped", context))
        shaped[:3] += frame_at(frame, context.get_time())
        shaped[7:10] += frame[3:6]
        rows = self._eval("force_directions", context)
        x = self._eval("x", context)
        for n in (rows[:3], rows[3:]):
            if n @ n > 0.5:
                # There force decides: the arm is where it is, and goes on from there.
                shaped[:3] += (n @ (x[P_TIP] - shaped[:3])) * n
                shaped[7:10] += (n @ (x[V_TIP] - shaped[7:10])) * n
                shaped[13:16] -= (n @ shaped[13:16]) * n
        return shaped

    def _mixed(self, context):
        w = self._weight(context)
        planned = self._eval("planned", context)
        if w[0] == 0.0 and w[1] == 0.0:
            return planned
        return blended_reference(planned, self._shaped(context), *w)

    def _pose(self, context, output: BasicVector):
        output.SetFromVector(self._mixed(context))

    def _direction(self, context, output):
        v = self._mixed(context)[7:10]
        speed = np.sqrt(v @ v)
        output.SetFromVector(v / speed if speed > SPEED_MIN else np.zeros(3))

    def _wrench(self, context, output):
        w, _, _ = self._weight(context)
        planned = self._eval("planned_wrench", context)
        fed = self._eval("wrench_feedforward", context)
        output.SetFromVector((1.0 - w) * planned + w * fed)

    def _damping(self, context, output):
        w, _, _ = self._weight(context, self._soft)
        c = self._config
        damping = c.damping + w * (c.damping_impact - c.damping)
        output.SetFromVector(np.full(6, damping))

    def _directions(self, context, output):
        leads = self._shaper_leads(context)
        rows = self._eval("force_directions", context) if leads else np.zeros(6)
        output.SetFromVector(rows)

    def _targets(self, context, output):
        leads = self._shaper_leads(context)
        targets = self._eval("force_targets", context) if leads else np.zeros(2)
        output.SetFromVector(targets)

    def _contacts(self, context, output):
        if self._shaper_leads(context):
            output.SetFromVector(self._eval("force_directions", context))
            return
        x = self._eval("x", context)
        n = x[P_BALL] - x[P_TIP]
        rows = np.zeros(6)
        rows[:3] = n / max(np.sqrt(n @ n), 1e-6)
        output.SetFromVector(rows)

    def _reference(self, context, output):
        if self._shaper_leads(context):
            X = self._shaped(context)
            output.SetFromVector(np.concatenate([X[:3], X[7:10], X[13:16]]))
        else:
            output.SetFromVector(self._eval("task_reference", context))
