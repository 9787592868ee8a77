"""Pose and velocity of the tool's tip from the joints (numerics/tip_state.py)."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.arm.numerics.packed import packed
from makebreak.systems.arm.numerics.serial_chain import SerialChain
from makebreak.systems.arm.numerics.tip_state import tip_pose, tip_velocity
from makebreak.systems.numerics.first_calls import first_call


class TipState(LeafSystem):
    """Pose and velocity of the tip E, computed when evaluated; NaN for NaN inputs.

    Inputs:  q (n,) [rad], v (n,) [rad/s].
    Outputs: ee_pose (7,) = [p_WE 3 [m], quaternion wxyz 4, w >= 0];
             ee_velocity (6,) = [v 3 [m/s], w 3 [rad/s]] of E in world axes.

    Args: chain: of the arm with its tool.
    """

    def __init__(self, chain: SerialChain):
        super().__init__()
        self._chain = packed(chain)
        n = len(chain.mass)
        first_call(tip_velocity, self._chain, np.zeros(n), np.zeros(n))
        first_call(tip_pose, self._chain, np.zeros(n))
        self._q = self.DeclareVectorInputPort("q", n)
        self._v = self.DeclareVectorInputPort("v", n)
        self.DeclareVectorOutputPort("ee_pose", 7, self._calc_pose, {self._q.ticket()})
        self.DeclareVectorOutputPort(
            "ee_velocity", 6, self._calc_velocity, {self._q.ticket(), self._v.ticket()}
        )

    def _calc_pose(self, context: Context, output: BasicVector):
        output.SetFromVector(tip_pose(self._chain, self._q.Eval(context)))

    def _calc_velocity(self, context: Context, output: BasicVector):
        output.SetFromVector(
            tip_velocity(self._chain, self._q.Eval(context), self._v.Eval(context))
        )
