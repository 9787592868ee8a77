"""Meshcat's view of a ball that is rolled along a circle."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Box, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL
from makebreak.systems.views.numerics.trail import Trail

GAP_SLIDER = "learned [mm]"  # A longer name would be cut off.
_PATH, _TRACK = Rgba(0.1, 0.1, 0.2), Rgba(1.0, 0.5, 0.0)
_MODEL, _RESIDUAL = Rgba(0.3, 0.5, 1.0, 0.25), Rgba(0.2, 0.45, 1.0)


@dataclass
class RollingViewConfig:
    """Settings of RollingView."""

    center: list[float] = field(default_factory=lambda: [0.5, 0.0])  # [m]
    radius: float = 0.1  # Of the path [m].
    ball_radius: float = 0.0315  # Of the model [m].
    gap_scale: float = 10.0  # Length of the bar over the learned gap.
    period_sec: float = 1.0 / 15.0


class RollingView(LeafSystem):
    """Draws the target path (dark), the ball's track (orange), the modelled ball (a
    ghost), and a bar beside the path whose height shows the learned gap; a slider shows
    the gap in mm.

    Inputs: p_ball (3,): true position, for the track; x (19,): the estimate, for the
            ghost; gap (1,): the learned residual times its time step [m].
    """

    BAR = "/makebreak/r_comp"
    CAMERA, LOOK_AT = (1.12, -0.62, 0.52), (0.4, 0.0, 0.16)  # [m]

    def __init__(self, config: RollingViewConfig, meshcat: Meshcat):
        super().__init__()
        self._config, self._meshcat = config, meshcat
        self.legend = [
            ("path to follow", _PATH),
            ("track of the ball", _TRACK),
            ("ball in the controller's model", _MODEL),
            (f"learned gap, {config.gap_scale:g} times as long", _RESIDUAL),
        ]
        self._p_ball = self.DeclareVectorInputPort("p_ball", 3)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._gap = self.DeclareVectorInputPort("gap", 1)
        self._track = self.DeclareAbstractState(AbstractValue.Make(np.zeros((0, 3))))
        meshcat.SetCameraPose(self.CAMERA, self.LOOK_AT)
        angle = np.linspace(0.0, 2.0 * np.pi, 121)
        c = config
        path = [
            c.center[0] + c.radius * np.cos(angle),
            c.center[1] + c.radius * np.sin(angle),
            np.full_like(angle, 0.002),
        ]
        meshcat.SetLine("/makebreak/path", np.array(path), 3.0, _PATH)
        meshcat.SetObject("/makebreak/model_ball", Sphere(c.ball_radius), _MODEL)
        meshcat.SetObject(self.BAR, Box(0.012, 0.012, 1.0), _RESIDUAL)
        self._trail = Trail(meshcat, "/makebreak/track", _TRACK)
        self._show_gap(0.0, 0.0)
        meshcat.AddSlider(GAP_SLIDER, -20.0, 40.0, 0.1, 0.0)
        self.DeclarePeriodicPublishEvent(config.period_sec, 0.0, self._publish)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.1, 0.0, self._remember)

    def _show_gap(self, gap, t):
        x, y = self._config.center[0], self._config.center[1] + 0.22
        height = max(self._config.gap_scale * gap, 0.001) if np.isfinite(gap) else 0.001
        self._meshcat.SetTransform(self.BAR, RigidTransform([x, y, height / 2]), t)
        # Scale the object, not its path: a transform resets the scale of its path.
        self._meshcat.SetProperty(
            f"{self.BAR}/<object>", "scale", [1.0, 1.0, height], t
        )

    def _remember(self, context, state):
        track = context.get_abstract_state(int(self._track)).get_value()
        p = self._p_ball.Eval(context)
        point = np.array([[p[0], p[1], 0.003]])
        track = np.concatenate([track, point])
        state.get_mutable_abstract_state(int(self._track)).set_value(track)

    def _publish(self, context):
        t, meshcat = context.get_time(), self._meshcat
        gap = self._gap.Eval(context)[0]
        ghost = RigidTransform(self._x.Eval(context)[P_BALL])
        meshcat.SetTransform("/makebreak/model_ball", ghost, t)
        self._show_gap(gap, t)
        if np.isfinite(gap):
            meshcat.SetSliderValue(GAP_SLIDER, 1e3 * gap)
        track = context.get_abstract_state(int(self._track)).get_value()
        self._trail.show(track, t)
