"""Meshcat's view of an object that is pushed to poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, Rgba, Shape
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, Q_BALL
from makebreak.systems.views.numerics.trail import Trail

_GOAL, _MODEL = Rgba(0.1, 0.7, 0.2, 0.35), Rgba(0.3, 0.5, 1.0, 0.25)
_TRACK = Rgba(0.65, 0.25, 0.75)


@dataclass
class PushViewConfig:
    """Settings of PushView."""

    height: float = 0.02  # Of the object's frame on the table [m].
    track_m: float = 0.003  # Least distance between points of the track [m].
    period_sec: float = 1.0 / 15.0


class PushView(LeafSystem):
    """Draws the goal (green) and the estimated object (blue) as ghosts, and its track
    since the last goal.

    Inputs: goal (3,) = x, y [m], yaw [rad]; x (19,): the estimate
            (contact_mpc/numerics/ball_state.py); valid (1,): above 0.5 if x can be
            used.
    """

    GOAL, MODEL, TRACK = "/makebreak/goal", "/makebreak/model", "/makebreak/track"
    CAMERA, LOOK_AT = (1.0, -0.35, 0.6), (0.5, 0.0, 0.0)  # [m]
    LEGEND = (
        ("goal", _GOAL),
        ("object as it is estimated", _MODEL),
        ("its track since the last goal", _TRACK),
    )

    def __init__(
        self,
        config: PushViewConfig,
        parts: Sequence[tuple[Shape, RigidTransform]],
        meshcat: Meshcat,
    ):
        """Args: parts: the modelled object's shapes, each with its pose in the object's
        frame.

        Raises: ValueError without parts.
        """
        super().__init__()
        if not parts:
            raise ValueError("parts is empty, expected the object's shapes")
        self._config, self._meshcat = config, meshcat
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        # The goal that the track belongs to, and its points (n, 3).
        self._track = self.DeclareAbstractState(
            AbstractValue.Make((np.full(3, np.nan), np.zeros((0, 3))))
        )
        meshcat.SetCameraPose(self.CAMERA, self.LOOK_AT)
        self._trail = Trail(meshcat, self.TRACK, _TRACK)
        for path, color in ((self.GOAL, _GOAL), (self.MODEL, _MODEL)):
            for i, (shape, X_BS) in enumerate(parts):
                meshcat.SetObject(f"{path}/{i}", shape, color)
                meshcat.SetTransform(f"{path}/{i}", X_BS)
        self.DeclarePeriodicPublishEvent(config.period_sec, 0.0, self._publish)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.1, 0.0, self._remember)

    def _remember(self, context, state):
        if not self._valid.Eval(context)[0] > 0.5:
            return
        goal, p = self._goal.Eval(context), self._x.Eval(context)[P_BALL]
        known, track = context.get_abstract_state(int(self._track)).get_value()
        point = np.array([[p[0], p[1], 0.003]])
        if not (goal == known).all():
            track = point
        elif np.hypot(*(point - track[-1])[0, :2]) > self._config.track_m:
            track = np.concatenate([track, point])
        value = state.get_mutable_abstract_state(int(self._track))
        value.set_value((np.array(goal), track))

    def _publish(self, context):
        t, meshcat = context.get_time(), self._meshcat
        x, (gx, gy, yaw) = self._x.Eval(context), self._goal.Eval(context)
        if np.isfinite([gx, gy, yaw]).all():
            X_WG = RigidTransform(
                RotationMatrix.MakeZRotation(yaw), [gx, gy, self._config.height]
            )
            meshcat.SetTransform(self.GOAL, X_WG, t)
        if np.isfinite(x).all() and np.linalg.norm(x[Q_BALL]) > 0.5:
            q = Quaternion(wxyz=x[Q_BALL] / np.linalg.norm(x[Q_BALL]))
            X_WB = RigidTransform(q, x[P_BALL])
            meshcat.SetTransform(self.MODEL, X_WB, t)
        _, track = context.get_abstract_state(int(self._track)).get_value()
        self._trail.show(track, t)
