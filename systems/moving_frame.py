"""What is measured of the tip, as seen from a frame that moves in the world."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.push_motion import N_FRAME, frame_at


class MovingFrame(LeafSystem):
    """Takes a frame's motion off the tip's, computed when asked for.

    The frame has the world's axes; only its origin moves.

    Inputs:  frame (7,) = [origin 3 [m], its velocity 3 [m/s], when it was there [s]];
             ee_pose (7,), ee_velocity (6,) in the world.
    Outputs: ee_pose (7,), ee_velocity (6,) in the frame.
    """

    def __init__(self):
        super().__init__()
        self._frame = self.DeclareVectorInputPort("frame", N_FRAME)
        self._pose = self.DeclareVectorInputPort("ee_pose", 7)
        self._velocity = self.DeclareVectorInputPort("ee_velocity", 6)
        frame = self._frame.ticket()
        self.DeclareVectorOutputPort(
            "ee_pose",
            7,
            self._calc_pose,
            {frame, self._pose.ticket(), self.time_ticket()},
        )
        self.DeclareVectorOutputPort(
            "ee_velocity", 6, self._calc_velocity, {frame, self._velocity.ticket()}
        )

    def _calc_pose(self, context: Context, output: BasicVector):
        pose = np.array(self._pose.Eval(context))
        pose[:3] -= frame_at(self._frame.Eval(context), context.get_time())
        output.SetFromVector(pose)

    def _calc_velocity(self, context: Context, output: BasicVector):
        velocity = np.array(self._velocity.Eval(context))
        velocity[:3] -= self._frame.Eval(context)[3:6]
        output.SetFromVector(velocity)
