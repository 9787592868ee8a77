"""Targets for a ball that is rolled along a circle (numerics/path_target.py)."""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL
from makebreak.systems.contact_mpc.numerics.lcs import is_finite
from makebreak.systems.contact_mpc.numerics.path_target import (
    moving_target,
    next_waypoint,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    CircleConfig,
    CirclePath,
    RollingConfig,
    check_circle,
    shifted,
)
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

AWAY = 0.001  # Distance of the tip's target from the ball, so that it is no push [m].


@dataclass
class PathTargetConfig:
    """Settings of PathTarget."""

    # The diagram sets its centre and radius.
    circle: CircleConfig = field(default_factory=CircleConfig)
    goal_deg: float = 10.0  # Angle on the circle from one goal to the next [deg].
    # Time constant of the integral action on the circle's radius [s]; inf: none.
    integral_sec: float = 6.0
    # Height of the tip's centre while it pushes [m]; the diagram sets it.
    height: float = 0.038
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class PathTarget(LeafSystem):
    """The moving target of C3 and the goals of ContactSampler along a circle.

    Inputs:  x (19,) of numerics/ball_state.py; valid (1,): above 0.5 if x can be used;
             r_comp (n_lam,) [m/s], optional: the learned residual. The tip's target is
             nearer to the ball by the gap that its first n_tip entries, the contact of
             tip and ball, stand for.
    Outputs: x_desired ((N + 1) 19,) for C3; goal (3,) = x, y [m], 0: the next point on
             the circle.

    Integral action, as in RollingTask: the radius that is aimed at differs from the
    path's by the integral of the ball's distance from the path. Nothing changes while
    an input is not finite.

    Args: config; n_knots: N + 1; knot_sec: between them [s]; radius_ball: as modelled
        [m]; away: distance of the centres of tip and ball, seen from above, where they
        touch [m]; n_lam, n_tip: entries of r_comp, and those of tip and ball;
        residual_dt_sec: time step over which r_comp is a velocity [s].
    Raises: ValueError for a setting out of range.
    """

    def __init__(
        self,
        config: PathTargetConfig,
        n_knots: int,
        knot_sec: float,
        radius_ball: float,
        away: float,
        n_lam: int,
        n_tip: int,
        residual_dt_sec: float,
    ):
        super().__init__()
        check_settings(config)
        c = config
        check_circle(c.circle, "path.circle")
        for name in ("goal_deg", "integral_sec", "height"):
            if not getattr(c, name) > 0.0:
                raise ValueError(f"path.{name} is {getattr(c, name)}, expected > 0")
        self._config, self._n_knots, self._knot_sec = c, n_knots, knot_sec
        self._radius_ball, self._away = radius_ball, away
        self._n_tip, self._residual_dt_sec = n_tip, residual_dt_sec
        self._path = CirclePath(np.array(c.circle.center), c.circle.radius)
        self._integral = RollingConfig(integral_sec=c.integral_sec)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._r_comp = self.DeclareVectorInputPort("r_comp", n_lam)
        at_rest = np.eye(N_X)[3]
        self._shift = self.DeclareDiscreteState([0.0])  # Added to the radius [m].
        # Angle of the goal on the circle [rad]; NaN: none yet.
        self._angle = self.DeclareDiscreteState([np.nan])
        self._x_desired = self.DeclareDiscreteState(np.tile(at_rest, n_knots))
        self._goal = self.DeclareDiscreteState(3)
        self.DeclareStateOutputPort("x_desired", self._x_desired)
        self.DeclareStateOutputPort("goal", self._goal)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        x, valid = (np.asarray(p.Eval(context)) for p in (self._x, self._valid))
        gap = 0.0
        if self._r_comp.HasValue(context):
            r = np.asarray(self._r_comp.Eval(context))[: self._n_tip]
            gap = float(r.mean()) * self._residual_dt_sec
        if not (is_finite(x) and np.isfinite(gap)):
            return
        away = self._away + AWAY - gap
        shift = float(context.get_discrete_state(self._shift).value()[0])
        if valid[0] > 0.5:
            shift = shifted(self._integral, self._path, shift, x, c.period_sec)
        path = replace(self._path, radius=self._path.radius + shift)
        lead = np.deg2rad(c.circle.lead_deg)
        target = moving_target(
            path, x, lead, c.circle.speed, c.height, away, self._radius_ball,
            self._knot_sec, self._n_knots,
        )  # fmt: skip
        last = float(context.get_discrete_state(self._angle).value()[0])
        angle = next_waypoint(
            self._path.angle(x[P_BALL]), lead, np.deg2rad(c.goal_deg),
            None if np.isnan(last) else last,
        )  # fmt: skip
        discrete_state.set_value(self._shift, [shift])
        discrete_state.set_value(self._angle, [angle])
        discrete_state.set_value(self._x_desired, target.ravel())
        discrete_state.set_value(self._goal, [*self._path.point(angle), 0.0])
