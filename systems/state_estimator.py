from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import LeafSystem

from makebreak.systems.numerics.ball_state import pack
from makebreak.systems.numerics.timing import timed


@dataclass
class StateEstimatorConfig:
    ball_radius: float = 0.0315  # [m] as the model has it.
    tip_mass: float = 1.0  # [kg] of the tip in the LCS.
    window_sec: float = 0.05  # Of the mean force: the learner's period.
    period_sec: float = 0.0025  # Divides the periods of C3 and of the learner.
    offset_sec: float = 0.0


class StateEstimator(LeafSystem):
    """Joint sensors and the ball tracker, as the state and input of the LCS.

    The LCS knows the arm as a point of mass m that a force u pushes. The force that
    explains the tip's motion with *that* mass is

        u = m J_v M^-1 (tau - bias),     bias = C(q, v) v - tau_gravity,

    the tip's acceleration without contact, times m (J_v_dot v is small and left out);
    its mean over the window is what the residual learner needs.

    Inputs:  q (7,), v (7,), torque (7,) motor side [rad, rad/s, N m]; p_ball (3,),
             v_ball (3,) [m, m/s]; seen (1,).
    Outputs: x (19,), the layout of numerics/ball_state.py; u_measured (3,) [N];
             valid (1,): 1 if every reading was finite and the ball is seen.

    A reading that is not finite leaves x and u_measured as they were.
    """

    def __init__(self, config: StateEstimatorConfig, arm: MultibodyPlant, tip: Frame):
        super().__init__()
        if not config.ball_radius > 0.0 or not config.tip_mass > 0.0:
            raise ValueError(
                "ball_radius and tip_mass must be positive, got "
                f"{config.ball_radius}, {config.tip_mass}"
            )
        self._config, self._arm, self._tip = config, arm, tip
        self._arm_context = arm.CreateDefaultContext()  # Scratch.
        self._forces = MultibodyForces(arm)  # Scratch.
        n = arm.num_velocities()
        n_window = max(1, round(config.window_sec / config.period_sec))
        self._q = self.DeclareVectorInputPort("q", n)
        self._v = self.DeclareVectorInputPort("v", n)
        self._torque = self.DeclareVectorInputPort("torque", n)
        self._p_ball = self.DeclareVectorInputPort("p_ball", 3)
        self._v_ball = self.DeclareVectorInputPort("v_ball", 3)
        self._seen = self.DeclareVectorInputPort("seen", 1)
        p_WT = self._tip.CalcPoseInWorld(self._arm_context).translation()
        x0 = pack(p_WT, np.zeros(3), [0, 0, config.ball_radius], np.zeros(3), 1.0)
        self._x = self.DeclareDiscreteState(x0)
        self._window = self.DeclareDiscreteState(3 * n_window)
        self._valid = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("x", self._x)
        self.DeclareVectorOutputPort(
            "u_measured",
            3,
            self._mean_force,
            prerequisites_of_calc={self.discrete_state_ticket(self._window)},
        )
        self.DeclareStateOutputPort("valid", self._valid)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _mean_force(self, context, output):
        window = context.get_discrete_state(self._window).value()
        output.SetFromVector(window.reshape(-1, 3).mean(axis=0))

    @timed
    def _update(self, context, discrete_state):
        q, v = self._q.Eval(context), self._v.Eval(context)
        torque = self._torque.Eval(context)
        p_ball, v_ball = self._p_ball.Eval(context), self._v_ball.Eval(context)
        seen = self._seen.Eval(context)[0]
        total = q.sum() + v.sum() + torque.sum() + p_ball.sum() + v_ball.sum()
        if not np.isfinite(total):
            discrete_state.set_value(self._valid, [0.0])
            return
        arm, arm_context = self._arm, self._arm_context
        arm.SetPositions(arm_context, q)
        arm.SetVelocities(arm_context, v)
        M = arm.CalcMassMatrix(arm_context)
        # One call gives bias and gravity together: the torque that holds vdot = 0.
        arm.CalcForceElementsContribution(arm_context, self._forces)
        bias = arm.CalcInverseDynamics(arm_context, np.zeros_like(v), self._forces)
        world = arm.world_frame()
        J = arm.CalcJacobianTranslationalVelocity(
            arm_context, JacobianWrtVariable.kV, self._tip, np.zeros(3), world, world
        )
        u = self._config.tip_mass * (J @ np.linalg.solve(M, torque - bias))
        p_tip = self._tip.CalcPoseInWorld(arm_context).translation()
        x = pack(p_tip, J @ v, p_ball, v_ball, self._config.ball_radius)
        window = context.get_discrete_state(self._window).value()
        discrete_state.set_value(self._x, x)
        discrete_state.set_value(self._window, np.append(window[3:], u))
        discrete_state.set_value(self._valid, [1.0 if seen > 0.5 else 0.0])
