"""What is measured of the tip, as seen from a frame that moves in the world."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import (
    DIRECTION,
    N_CONTACT,
    POSITION,
)
from makebreak.systems.changing_contact.numerics.push_motion import N_FRAME, frame_at

FROM_ABOVE = 0.9  # Cosine to the vertical of a contact from above, or from below.


class MovingFrame(LeafSystem):
    """Takes a frame's motion off the tip's, computed when asked for.

    The frame has the world's axes; only its origin moves.

    Inputs:  frame (7,) = [origin 3 [m], its velocity 3 [m/s], when it was there [s]];
             ee_pose (7,), ee_velocity (6,) in the world; contact (14,), of
             numerics/contact_task.py, in the frame.
    Outputs: ee_pose (7,), ee_velocity (6,) in the frame;
             ee_height (7,), contact_height (14,): pose and contact with only their
             height, for who learns at which height something is met. The finger lands
             elsewhere around the ball each time: a contact that is not quite from
             above would make centimetres across into millimetres of height.
    """

    def __init__(self):
        super().__init__()
        self._frame = self.DeclareVectorInputPort("frame", N_FRAME)
        self._pose = self.DeclareVectorInputPort("ee_pose", 7)
        self._velocity = self.DeclareVectorInputPort("ee_velocity", 6)
        self._contact = self.DeclareVectorInputPort("contact", N_CONTACT)
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

        self.DeclareVectorOutputPort(
            "ee_height", 7, self._calc_height, {self._pose.ticket()}
        )
        self.DeclareVectorOutputPort(
            "contact_height", N_CONTACT, self._calc_contact, {self._contact.ticket()}
        )

    def _calc_height(self, context: Context, output: BasicVector):
        pose = np.array(self._pose.Eval(context))
        pose[:2] = 0.0
        output.SetFromVector(pose)

    def _calc_contact(self, context: Context, output: BasicVector):
        contact = np.array(self._contact.Eval(context))
        contact[POSITION][:2] = 0.0
        d = contact[DIRECTION]
        if abs(d[2]) > FROM_ABOVE:
            contact[DIRECTION] = 0.0, 0.0, np.sign(d[2])
        output.SetFromVector(contact)

    def _calc_pose(self, context: Context, output: BasicVector):
        pose = np.array(self._pose.Eval(context))
        pose[:3] -= frame_at(self._frame.Eval(context), context.get_time())
        output.SetFromVector(pose)

    def _calc_velocity(self, context: Context, output: BasicVector):
        velocity = np.array(self._velocity.Eval(context))
        velocity[:3] -= self._frame.Eval(context)[3:6]
        output.SetFromVector(velocity)
