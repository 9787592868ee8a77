from dataclasses import dataclass

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.numerics.ball_state import pack
from makebreak.systems.numerics.serial_chain import SerialChain
from makebreak.systems.numerics.state_estimator import tip_motion
from makebreak.systems.numerics.timing import timed


@dataclass
class StateEstimatorConfig:
    ball_radius: float = 0.0315  # [m] as the model has it.
    tip_mass: float = 1.0  # [kg] of the tip in the LCS.
    window_sec: float = 0.05  # Of the mean force: the learner's period.
    period_sec: float = 0.0125 / 3.0  # Divides the periods of C3 and of the learner.
    offset_sec: float = 0.0


class StateEstimator(LeafSystem):
    """Joint sensors and the ball tracker, as the state and input of the LCS.

    The LCS knows the arm as a point of some mass; u_measured is the force on it that
    explains the tip's motion (numerics/state_estimator.py), as a mean over the window,
    which is what the residual learner needs.

    Inputs:  q (7,), v (7,), torque (7,) motor side [rad, rad/s, N m]; p_ball (3,),
             v_ball (3,) [m, m/s]; seen (1,).
    Outputs: x (19,), the layout of numerics/ball_state.py; u_measured (3,) [N];
             valid (1,): 1 if every reading was finite and the ball is seen;
             window_valid (1,): 1 if that was so all over the window.

    A reading that is not finite leaves x and u_measured as they were.
    """

    def __init__(self, config: StateEstimatorConfig, chain: SerialChain, q_default):
        """Args: chain, the arm with its tool as the model has it; q_default (n,) [rad],
        where x is before the first reading."""
        super().__init__()
        if not config.ball_radius > 0.0 or not config.tip_mass > 0.0:
            raise ValueError(
                "ball_radius and tip_mass must be positive, got "
                f"{config.ball_radius}, {config.tip_mass}"
            )
        self._config, self._chain = config, chain
        n = len(chain.mass)
        q_default = np.array(q_default, dtype=float)
        p_tip, _, _ = tip_motion(chain, q_default, np.zeros(n), np.zeros(n), 1.0)
        n_window = max(1, round(config.window_sec / config.period_sec))
        self._q = self.DeclareVectorInputPort("q", n)
        self._v = self.DeclareVectorInputPort("v", n)
        self._torque = self.DeclareVectorInputPort("torque", n)
        self._p_ball = self.DeclareVectorInputPort("p_ball", 3)
        self._v_ball = self.DeclareVectorInputPort("v_ball", 3)
        self._seen = self.DeclareVectorInputPort("seen", 1)
        x0 = pack(p_tip, np.zeros(3), [0, 0, config.ball_radius], np.zeros(3), 1.0)
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
        # How many readings in a row were valid; a learner that starts is told so.
        self._n_window = n_window
        self._n_valid = self.DeclareDiscreteState([float(n_window)])
        self.DeclareStateOutputPort("valid", self._valid)
        self.DeclareVectorOutputPort(
            "window_valid",
            1,
            self._all_valid,
            prerequisites_of_calc={self.discrete_state_ticket(self._n_valid)},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _mean_force(self, context, output):
        window = context.get_discrete_state(self._window).value()
        output.SetFromVector(window.reshape(-1, 3).mean(axis=0))

    def _all_valid(self, context, output):
        n_valid = context.get_discrete_state(self._n_valid).value()[0]
        output.SetFromVector([1.0 if n_valid >= self._n_window else 0.0])

    @timed
    def _update(self, context, discrete_state):
        q, v = self._q.Eval(context), self._v.Eval(context)
        torque = self._torque.Eval(context)
        p_ball, v_ball = self._p_ball.Eval(context), self._v_ball.Eval(context)
        seen = self._seen.Eval(context)[0]
        total = q.sum() + v.sum() + torque.sum() + p_ball.sum() + v_ball.sum()
        if not np.isfinite(total):
            discrete_state.set_value(self._valid, [0.0])
            discrete_state.set_value(self._n_valid, [0.0])
            return
        p_tip, v_tip, u = tip_motion(self._chain, q, v, torque, self._config.tip_mass)
        x = pack(p_tip, v_tip, p_ball, v_ball, self._config.ball_radius)
        window = context.get_discrete_state(self._window).value()
        discrete_state.set_value(self._x, x)
        discrete_state.set_value(self._window, np.append(window[3:], u))
        valid = 1.0 if seen > 0.5 else 0.0
        n_valid = context.get_discrete_state(self._n_valid).value()[0]
        discrete_state.set_value(self._valid, [valid])
        discrete_state.set_value(
            self._n_valid, [min(valid * (n_valid + 1.0), self._n_window)]
        )
