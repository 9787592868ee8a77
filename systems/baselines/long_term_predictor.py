"""Baseline of ForwardModelBank: the long-term predictor of Khader et al., used one step
ahead with feedback."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.baselines.numerics.long_term_predictor import (
    LongTermPredictor,
    predict_one_step,
)
from makebreak.systems.numerics.timing import timed

N_X = 3  # x: force.
N_XU = 9  # x and u: force, velocity, position.


class OneStepPredictor(LeafSystem):
    """Predicts the force on the tool one sample ahead. It does not learn online.

    Inputs:  wrench (6,) measured on the tool, world axes, force first [N], [N m];
             ee_velocity (6,) [m/s], [rad/s]; ee_pose (7,), position first [m].
    Outputs, all of them state:
             wrench_predicted (6,) of the next sample, its torque zero [N];
             std (3,) of its force [N]; mode (1,) that the SVM predicts there;
             status (1,) 0, or 1 if an input is not finite and the outputs are held.

    Args: predictor: trained with x = force (3,), u = [velocity (3,), position (3,)]
        and steps of period_sec; mode: initial contact mode.
    Raises: ValueError for a predictor of other dimensions.

    Source: CC section 4.4.3.
    """

    def __init__(
        self,
        predictor: LongTermPredictor,
        mode: int = 0,
        period_sec: float = 0.005,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        if (predictor.n_x, len(predictor.mean)) != (N_X, N_XU):
            raise ValueError(
                f"the predictor is over {predictor.n_x} of {len(predictor.mean)} "
                f"numbers, expected {N_X} of {N_XU}"
            )
        if not period_sec > 0.0:
            raise ValueError(f"period_sec is {period_sec}, expected > 0")
        self._predictor = predictor
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self._velocity = self.DeclareVectorInputPort("ee_velocity", 6)
        self._pose = self.DeclareVectorInputPort("ee_pose", 7)
        # [force 3, std 3, mode, status]
        self._state = self.DeclareDiscreteState(np.array([0.0] * 6 + [mode, 0.0]))
        ticket = {self.discrete_state_ticket(self._state)}
        for name, size, calc in (
            ("wrench_predicted", 6, self._calc_wrench),
            ("std", 3, self._calc_std),
            ("mode", 1, self._calc_mode),
            ("status", 1, self._calc_status),
        ):
            self.DeclareVectorOutputPort(name, size, calc, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, self._update)

    @timed
    def _update(self, context: Context, discrete_state):
        state = self._value(context)
        x = self._wrench.Eval(context)[:3]
        u = np.hstack([self._velocity.Eval(context)[:3], self._pose.Eval(context)[:3]])
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            discrete_state.set_value(self._state, np.append(state[:7], 1.0))
            return
        mean, std, mode = predict_one_step(self._predictor, x, u, int(state[6]))
        discrete_state.set_value(self._state, np.hstack([mean, std, mode, 0.0]))

    def _value(self, context: Context) -> np.ndarray:
        return context.get_discrete_state(self._state).value()

    def _calc_wrench(self, context: Context, output: BasicVector):
        output.SetFromVector(np.append(self._value(context)[:3], np.zeros(3)))

    def _calc_std(self, context: Context, output: BasicVector):
        output.SetFromVector(self._value(context)[3:6])

    def _calc_mode(self, context: Context, output: BasicVector):
        output.SetFromVector(self._value(context)[6:7])

    def _calc_status(self, context: Context, output: BasicVector):
        output.SetFromVector(self._value(context)[7:])
