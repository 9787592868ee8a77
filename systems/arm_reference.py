from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem

from makebreak.systems.numerics.arm_reference import clip_norm, step, ticks_left
from makebreak.systems.numerics.ball_state import N_X, P_TIP, V_TIP
from makebreak.systems.numerics.lcs import LCS
from makebreak.systems.numerics.rolling_task import ROLL
from makebreak.systems.numerics.timing import timed


@dataclass
class ArmReferenceConfig:
    tip_mass: float = 1.0  # [kg] of the tip in the LCS.
    force_max: float = 3.0  # Feed-forward is clipped to it [N].
    acceleration_max: float = 1.5  # Of the velocity reference while rolling [m/s2].
    command_period_sec: float = 0.0125  # Of C3 and of the task.
    command_offset_sec: float = 0.0  # Their last offset.
    period_sec: float = 0.001
    offset_sec: float = 0.0


class ArmReference(LeafSystem):
    """The 1 kHz reference of the arm between two 80 Hz commands.

    While rolling it goes to C3's x_next and feeds the planned contact force forward;
    else it follows the task's reference. Everything is interpolated over the command
    period, so that no step reaches the arm; a step in torque would meet its rate limit.

    Inputs:  phase (1,), reference (9,) of RollingTask; x_next (19,), lam (n_lam,) of
             C3; lcs (abstract), the one-step LCS that made them.
    Outputs: x_desired (19,) = [p, quaternion, v, w, a, alpha], position and its
             derivatives only (the quaternion is the identity); wrench (6,) force first.
    """

    def __init__(self, config: ArmReferenceConfig, n_lam: int, p_tip, lcs: LCS):
        super().__init__()
        step(
            np.zeros(12), np.zeros(12), ticks_left(0.0, 1.0, 0.0, 1.0), np.inf
        )  # Compiles.
        self._config = config
        self._phase = self.DeclareVectorInputPort("phase", 1)
        self._reference = self.DeclareVectorInputPort("reference", 9)
        self._x_next = self.DeclareVectorInputPort("x_next", N_X)
        self._lam = self.DeclareVectorInputPort("lam", n_lam)
        self._lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(lcs))
        self._zero = np.zeros(3)
        self._level = np.eye(19)[3]  # No rotation; position and the rest are filled in.
        self._state = self.DeclareDiscreteState([*p_tip, *np.zeros(9)])
        ticket = {self.discrete_state_ticket(self._state)}
        self.DeclareVectorOutputPort("x_desired", 19, self._pose, ticket)
        self.DeclareVectorOutputPort("wrench", 6, self._wrench, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        reference = context.get_discrete_state(self._state).value()
        n_left = ticks_left(
            context.get_time(), c.command_period_sec, c.command_offset_sec, c.period_sec
        )
        dv_max = np.inf
        if self._phase.Eval(context)[0] == ROLL:
            x_next = self._x_next.Eval(context)
            # D lam is the change of velocity that the contact gives the tip.
            lcs = self._lcs.Eval(context)
            on_tip = c.tip_mass / lcs.dt * (lcs.D[V_TIP] @ self._lam.Eval(context))
            force = clip_norm(-on_tip, c.force_max)
            target = np.concatenate((x_next[P_TIP], x_next[V_TIP], self._zero, force))
            dv_max = c.acceleration_max * c.period_sec
        else:
            target = np.concatenate((self._reference.Eval(context), self._zero))
        discrete_state.set_value(self._state, step(reference, target, n_left, dv_max))

    def _pose(self, context, output):
        reference = context.get_discrete_state(self._state).value()
        pose = self._level.copy()
        pose[0:3], pose[7:10] = reference[0:3], reference[3:6]
        pose[13:16] = reference[6:9]
        output.SetFromVector(pose)

    def _wrench(self, context, output):
        reference = context.get_discrete_state(self._state).value()
        output.SetFromVector(np.concatenate((reference[9:], self._zero)))
