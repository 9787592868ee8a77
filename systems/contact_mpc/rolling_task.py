"""The phases of rolling a ball as a system (numerics/rolling_task.py)."""

from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, V_BALL
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    ROLL,
    WAIT,
    CircleConfig,
    CirclePath,
    RollingConfig,
    TaskState,
    check_circle,
    next_state,
    shifted,
    target_over_horizon,
)
from makebreak.systems.contact_mpc.numerics.untouched_ball import (
    UntouchedBall,
    downhill,
    waits,
    watched,
)
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import timed

# The tip waits for a ball that is farther than this outside of the circle [m].
OUT_OF_REACH = 0.12
# So far uphill of the path, in units of s T^2, a ball is aimed that rolls away while
# the tip goes back in a time T. It is off by s T^2/6 on average meanwhile, by s T^2/2
# at the end, and the push that follows takes that back.
UPHILL = 0.25


@dataclass
class RollingTaskConfig:
    """Settings of RollingTask: the circle, the goal ahead of the ball, the rolling."""

    circle: CircleConfig = field(default_factory=lambda: CircleConfig(speed=0.045))
    # Depth of the tip's target below the place where it touches the learned ball's top
    # [m].
    press: float = 0.045
    # Place where the tip hides nothing of the circle from the camera, between circle
    # and arm's base, [x, y] [m].
    withdrawn: list[float] = field(default_factory=lambda: [0.35, 0.0])
    rolling: RollingConfig = field(default_factory=RollingConfig)
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class RollingTask(LeafSystem):
    """Phases of rolling a ball: C3's target while rolling, the tip's path in between.

    Inputs:  x (19,) of numerics/ball_state.py; valid (1,): above 0.5 if x can be used;
             r_comp (n_lam,) [m/s]: the learned residual, its first n_tip entries for
             tip and ball; r_std (1,) [m/s], optional: its standard deviation, and
             tip_force (3,) [N], optional: the estimated contact force on the tip. With
             both, a surface of uncertain height is approached slowly;
             landed (1,), optional: if another system carries out the reposition, it
             ends when this is 1, instead of after its time.
    Outputs: x_desired ((N + 1) 19,) for C3; reference (9,) = p, v, a of the tip at the
             next tick, used unless rolling; phase (1,): 0 roll, 1 reposition, 2 wait,
             3 approach; feel (1,): 1 while the tip has to feel for the ball that it
             pushes: one that did not coast as a ball should, or, with `landed`, one
             that is not known to wait where it is left; downhill (2,) [m/s2]:
             the slope's acceleration of a ball that does not wait where nobody touches
             it, zero for one that may; waits (1,): 1 if the ball is known to stay where
             it is left.

    A ball beyond OUT_OF_REACH is treated as one that is not seen. Before the first
    update the phase is WAIT, with the tip at p_tip.

    Args: config; n_knots: N + 1; knot_sec: between them [s]; radius_ball, radius_tip:
        as modelled [m]; n_lam, n_tip: entries of r_comp, and those of tip and ball;
        residual_dt_sec: time step over which r_comp is a velocity [s]; p_tip (3,):
        initial position of the tip [m].
    Raises: ValueError for a setting out of range.
    """

    def __init__(
        self,
        config: RollingTaskConfig,
        n_knots: int,
        knot_sec: float,
        radius_ball: float,
        radius_tip: float,
        n_lam: int,
        n_tip: int,
        residual_dt_sec: float,
        p_tip=(0.5, 0.0, 0.15),
    ):
        super().__init__()
        _check(config)
        self._config, self._n_knots, self._knot_sec = config, n_knots, knot_sec
        self._radius_ball, self._radius_tip = radius_ball, radius_tip
        self._n_tip, self._residual_dt_sec = n_tip, residual_dt_sec
        self._path = CirclePath(np.array(config.circle.center), config.circle.radius)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._r_comp = self.DeclareVectorInputPort("r_comp", n_lam)
        self._r_std = self.DeclareVectorInputPort("r_std", 1)
        self._tip_force = self.DeclareVectorInputPort("tip_force", 3)
        self._landed = self.DeclareVectorInputPort("landed", 1)
        start = TaskState(WAIT, 0.0, p_tip, np.zeros(3), np.zeros(3), p_tip[2])
        self._task = self.DeclareAbstractState(AbstractValue.Make(start))
        self._ball = self.DeclareAbstractState(AbstractValue.Make(UntouchedBall()))
        x_desired = np.tile(np.eye(N_X)[3], n_knots)
        circle = (self._path, np.zeros(N_X), 0.0, 0.0, 0.0)
        first_call(target_over_horizon, *circle, radius_ball, knot_sec, n_knots)
        self._x_desired = self.DeclareDiscreteState(x_desired)
        self._reference = self.DeclareDiscreteState([*p_tip, *np.zeros(6)])
        self._shift = self.DeclareDiscreteState([0.0])  # Added to the radius [m].
        self._phase = self.DeclareDiscreteState([float(WAIT)])
        self._feel = self.DeclareDiscreteState([0.0])
        self._slope = self.DeclareDiscreteState([0.0, 0.0])
        self._waits = self.DeclareDiscreteState([0.0])
        self.DeclareStateOutputPort("x_desired", self._x_desired)
        self.DeclareStateOutputPort("reference", self._reference)
        self.DeclareStateOutputPort("phase", self._phase)
        self.DeclareStateOutputPort("feel", self._feel)
        self.DeclareStateOutputPort("downhill", self._slope)
        self.DeclareStateOutputPort("waits", self._waits)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def start_at(self, context, p_tip) -> None:
        """Sets the state in a Context of this system: waiting, the tip at p_tip (3,)
        [m]."""
        t, still = context.get_time(), np.zeros(3)
        start = TaskState(WAIT, t, p_tip, still, still, float(p_tip[2]))
        context.SetAbstractState(int(self._task), start)
        context.SetDiscreteState(self._reference, [*p_tip, *np.zeros(6)])
        context.SetDiscreteState(self._phase, [float(WAIT)])

    @timed
    def _update(self, context, state):
        c = self._config
        x, t = self._x.Eval(context), context.get_time()
        task = context.get_abstract_state(int(self._task)).get_value()
        gap = self._r_comp.Eval(context)[: self._n_tip].mean() * self._residual_dt_sec
        away = x[P_BALL][:2] - self._path.center
        reach = self._path.radius + OUT_OF_REACH
        # Following a ball that is out of reach would only stretch the arm.
        seen, near = self._valid.Eval(context)[0], away @ away < reach**2
        valid, hidden = seen > 0.5 and near, seen == 0.0 and near
        landed = None
        if self._landed.HasValue(context):
            landed = bool(self._landed.Eval(context)[0] > 0.5)
        gap_std, force_z = 0.0, 0.0
        if self._r_std.HasValue(context):
            gap_std = float(self._r_std.Eval(context)[0]) * self._residual_dt_sec
        if self._tip_force.HasValue(context):
            force_z = float(self._tip_force.Eval(context)[2])
        shift = float(context.get_discrete_state(self._shift).value()[0])
        if valid:
            shift = shifted(c.rolling, self._path, shift, x, c.period_sec)
        ball = context.get_abstract_state(int(self._ball)).get_value()
        ball = watched(ball, t, x[V_BALL][:2], task.phase == ROLL, valid)
        slope = downhill(ball)
        path = replace(
            self._path,
            center=self._path.center - UPHILL * ball.coast_sec**2 * slope,
            radius=self._path.radius + shift,
        )
        task = next_state(
            c.rolling, path, task, t, c.period_sec, x, gap, valid,
            self._radius_ball, self._radius_tip, landed, gap_std, force_z,
            np.array(c.withdrawn), hidden,
        )  # fmt: skip
        # Relative to the learned top of the ball: relative to the modelled one a ball
        # that is larger than modelled would be pressed harder.
        z_tip = 2.0 * self._radius_ball + self._radius_tip - gap - c.press
        goal = target_over_horizon(
            path, x, np.deg2rad(c.circle.lead_deg), c.circle.speed, z_tip,
            self._radius_ball, self._knot_sec, self._n_knots,
        )  # fmt: skip
        state.get_mutable_abstract_state(int(self._ball)).set_value(ball)
        discrete = state.get_mutable_discrete_state()
        discrete.set_value(int(self._slope), slope)
        discrete.set_value(int(self._waits), [float(waits(ball))])
        state.get_mutable_abstract_state(int(self._task)).set_value(task)
        discrete.set_value(int(self._x_desired), goal.ravel())
        discrete.set_value(
            int(self._reference), np.concatenate([task.p, task.v, task.a])
        )
        discrete.set_value(int(self._phase), [float(task.phase)])
        # A tip that was landed by others may bounce. C3 does not know that a ball may
        # roll away by itself, and where that is the right way it sees no reason to
        # touch it again.
        may_leave = landed is not None and not waits(ball)
        pushes = (task.feel or may_leave) and task.phase == ROLL
        discrete.set_value(int(self._feel), [float(pushes)])
        discrete.set_value(int(self._shift), [shift])


def _check(config: RollingTaskConfig):
    """Raises: ValueError that names a setting out of range."""
    rolling = config.rolling
    check_circle(config.circle, "task.circle")
    place = config.withdrawn
    if np.shape(place) != (2,) or not np.isfinite(place).all():
        raise ValueError(f"task.withdrawn is {place}, expected 2 numbers")
    if not np.isfinite(config.press):
        raise ValueError(f"task.press is {config.press}, expected finite")
    for name in ("roll.sec", "roll.feel_sec", "reposition.sec", "reposition.far",
                 "approach.speed", "approach.touch_force", "land.above",
                 "land.coast_change", "unseen.drift", "unseen.withdraw_speed",
                 ):  # fmt: skip
        if not 0.0 < (value := attrgetter(name)(rolling)) < np.inf:
            raise ValueError(f"task.rolling.{name} is {value}, expected > 0")
    if not rolling.integral_sec > 0.0:  # Infinite: none.
        raise ValueError(
            f"task.rolling.integral_sec is {rolling.integral_sec}, expected > 0"
        )
    for name in ("approach.n_std", "approach.n_std_below", "approach.max",
                 "unseen.speed"):  # fmt: skip
        if not 0.0 <= (value := attrgetter(name)(rolling)) < np.inf:
            raise ValueError(f"task.rolling.{name} is {value}, expected >= 0")
    if not 0.0 < (ease := rolling.reposition.ease) <= 0.5:
        raise ValueError(
            f"task.rolling.reposition.ease is {ease}, expected > 0 and at most 0.5"
        )
