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
from makebreak.systems.changing_contact.numerics.push_motion import N_FRAME
from makebreak.systems.changing_contact.numerics.reference_blend import (
    COMMAND,
    N_BLEND,
    command,
    in_world,
    mixed,
    warm_up,
    weight,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, P_TIP
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

SPEED_MIN = 1e-3  # [m/s] A slower reference has no direction.
# Inputs, as numerics/reference_blend.py takes them.
POSE = "planned", "frame", "shaped", "force_directions", "x"
FORCES = "planned_wrench", "wrench_feedforward", "force_targets"


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
    Outputs: x_desired (19,);
             command (39,) for the impedance controller: x_desired, wrench (6,), damping
             (6,), force_directions (6,), force_targets (2,), one after the other, as
             evaluating ports takes longer than computing their values;
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
        blend = self.discrete_state_ticket(self._blend)
        soft = self.discrete_state_ticket(self._soft)
        time = self.time_ticket()
        self._dampings = np.array([config.damping, config.damping_impact], dtype=float)
        for name, size, calc, reads, *tickets in (
            ("x_desired", 19, self._pose, POSE, time),
            ("command", sum(COMMAND), self._command, (*POSE, *FORCES), time, soft),
            ("direction", 3, self._direction, POSE, time),
            ("contact_directions", 6, self._contacts, ("x", "force_directions")),
            ("reference", 9, self._reference, (*POSE[1:], "task_reference"), time),
        ):
            needs = {blend, *tickets, *(self._in[port].ticket() for port in reads)}
            self.DeclareVectorOutputPort(name, size, calc, needs)
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

    def _weight(self, context, state):
        blend = context.get_discrete_state(state).value()
        return weight(blend, context.get_time(), self._config.blend_sec)

    def _shaper_leads(self, context) -> bool:
        return context.get_discrete_state(self._blend).value()[1] > 0.5

    def _mixed(self, context):
        return mixed(
            context.get_time(),
            context.get_discrete_state(self._blend).value(),
            self._config.blend_sec,
            *self._evaluated(POSE, context),
        )

    def _evaluated(self, names, context):
        return [self._in[name].Eval(context) for name in names]

    def _pose(self, context, output: BasicVector):
        output.SetFromVector(self._mixed(context))

    def _command(self, context, output: BasicVector):
        output.SetFromVector(
            command(
                context.get_time(),
                context.get_discrete_state(self._blend).value(),
                context.get_discrete_state(self._soft).value(),
                self._config.blend_sec,
                self._dampings,
                *self._evaluated((*POSE, *FORCES), context),
            )
        )

    def _direction(self, context, output):
        v = self._mixed(context)[7:10]
        speed = np.sqrt(v @ v)
        output.SetFromVector(v / speed if speed > SPEED_MIN else np.zeros(3))

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
            X = in_world(context.get_time(), *self._evaluated(POSE[1:], context))
            output.SetFromVector(np.concatenate([X[:3], X[7:10], X[13:16]]))
        else:
            output.SetFromVector(self._eval("task_reference", context))
