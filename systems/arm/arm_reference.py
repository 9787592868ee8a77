from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem

from makebreak.systems.arm.numerics.arm_reference import (
    clip_norm,
    next_end,
    no_nearer,
    on_the_line,
    pose_and_wrench,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_TIP, V_BALL, V_TIP
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.numerics.rolling_task import ROLL
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.timing import timed


@dataclass
class ArmReferenceConfig:
    tip_mass: float = 1.0  # [kg] of the tip in the LCS.
    force_max: float = 3.0  # Feed-forward is clipped to it [N].
    acceleration_max: float = 1.5  # Of the velocity reference while rolling [m/s2].
    down_max: float = 0.04  # Downwards while rolling, where contact may be early [m/s].
    # Where a push that has to feel for the ball feels less than follow_force, the tip
    # goes down so much faster, and with the ball.
    follow_speed: float = 0.015  # [m/s]
    follow_force: float = 1.0  # [N]
    # Rolling, until the tip feels touch_force it goes no faster than this: it may meet
    # what it is to touch earlier than planned, and hits it the harder the faster it is.
    touch_speed: float = np.inf  # [m/s]
    touch_force: float = 1.0  # [N]
    # Nor faster than this whatever it feels: a tip that slides along a side feels that,
    # and hits the next corner at the speed that it has by then.
    push_speed: float = np.inf  # [m/s]
    # No command moves the reference faster than that, however far away it is. The task
    # itself stays below 0.35 m/s and 4 m/s2.
    speed_max: float = 0.5  # [m/s]
    acceleration_fed_forward_max: float = 10.0  # While repositioning [m/s2].
    # Rolling, the tip stays at this height, and only what C3 wants across the table
    # counts [m]; None: C3 moves it up and down too.
    height: float | None = None
    # Rolling, the wrist goes no nearer than this to the world's origin, where the arm
    # stands, across the table: a C3 that knows no arm would fold its elbow up [m].
    nearest: float = 0.0
    # From the wrist to the tip, seen from above [m].
    wrist: list[float] = field(default_factory=lambda: [0.0, 0.0])
    period_sec: float = 0.0125  # Of C3 and of the task.
    offset_sec: float = 0.0  # A little after theirs.


class ArmReference(LeafSystem):
    """The arm's reference between two 80 Hz commands, at any time that it is asked for.

    While rolling it goes to C3's x_next and feeds the planned contact force forward;
    else it follows the task's reference. Each update starts a straight line from where
    the reference is to the new command, which it reaches one period later, so that no
    step reaches the arm; a step in torque would meet its rate limit.

    While C3 holds an old command (its status is not 0), a rolling reference stays where
    it is and pushes nothing; so does any while its command is not finite. A command far
    away is gone to at speed_max, not within one period.

    The fed-forward force alone moves a well damped tip by some mm/s: too slow for the
    dents of an object that rolls by under it, and without contact C3's tip runs ahead
    of the ball alone. So a rolling tip that has to feel for the ball and feels nothing
    goes down, and along with the ball, until it does. (On a hard and smooth ball, which
    needs it not, it would hop.)

    Inputs:  phase (1,), reference (9,) of RollingTask; x_next (19,), lam (n_lam,),
             status (1,) of C3; lcs (abstract), the one-step LCS that made them;
             optional feel (1,) of RollingTask, and then tip_force (3,) on the tip, as
             the arm feels it [N], which a touch_speed needs, too; optional touch_speed
             (1,) [m/s], of TouchDown: takes the setting's place, if it is a number.
    Outputs: x_desired (19,) = [p, quaternion, v, w, a, alpha], position and its
             derivatives only (the quaternion is the identity); wrench (6,) force first;
             command (25,), one after the other: for who asks for both each millisecond.
    """

    def __init__(self, config: ArmReferenceConfig, n_lam: int, p_tip, lcs: LCS):
        super().__init__()
        if not config.follow_force > 0.0:
            raise ValueError(
                f"follow_force is {config.follow_force}, expected more than 0"
            )
        for name in ("touch_speed", "touch_force", "push_speed"):
            if not getattr(config, name) > 0.0:
                raise ValueError(
                    f"{name} is {getattr(config, name)}, expected more than 0"
                )
        if config.push_speed < config.touch_speed < np.inf:
            raise ValueError(
                f"touch_speed is {config.touch_speed}, expected at most push_speed, "
                f"{config.push_speed} m/s"
            )
        if not 0.0 <= config.nearest < np.inf:
            raise ValueError(f"nearest is {config.nearest}, expected at least 0 m")
        self._config, self._period = config, config.period_sec
        self._phase = self.DeclareVectorInputPort("phase", 1)
        self._reference = self.DeclareVectorInputPort("reference", 9)
        self._x_next = self.DeclareVectorInputPort("x_next", N_X)
        self._lam = self.DeclareVectorInputPort("lam", n_lam)
        self._status = self.DeclareVectorInputPort("status", 1)
        self._lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(lcs))
        self._tip_force = self.DeclareVectorInputPort("tip_force", 3)
        self._feel = self.DeclareVectorInputPort("feel", 1)
        self._touch_speed = self.DeclareVectorInputPort("touch_speed", 1)
        self._zero = np.zeros(3)
        at_rest = np.concatenate([p_tip, np.zeros(9)])
        reference = np.zeros(25)
        reference.setflags(write=False)  # As a Context's state is.
        first_call(pose_and_wrench, reference, 0.0, 1.0)
        # The line's start and end, and when it starts [s].
        self._line = self.DeclareDiscreteState(np.concatenate([at_rest, at_rest, [0]]))
        ticket = {self.discrete_state_ticket(self._line), self.time_ticket()}
        self.DeclareVectorOutputPort("x_desired", 19, self._pose, ticket)
        self.DeclareVectorOutputPort("wrench", 6, self._wrench, ticket)
        self.DeclareVectorOutputPort("command", 25, self._command, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def start_at(self, context, p_tip) -> None:
        """The reference rests at p_tip (3,) [m], in a Context of this system."""
        at_rest = np.concatenate([p_tip, np.zeros(9)])
        line = np.concatenate([at_rest, at_rest, [context.get_time()]])
        context.SetDiscreteState(self._line, line)

    @timed
    def _update(self, context, discrete_state):
        c = self._config
        dv_max = np.inf
        t = context.get_time()
        line = context.get_discrete_state(self._line).value()
        start = on_the_line(line, t, c.period_sec)
        rolling = self._phase.Eval(context)[0] == ROLL
        if rolling and self._status.Eval(context)[0] != 0.0:
            target = np.concatenate((start[:3], np.zeros(9)))
        elif rolling:
            x_next = self._x_next.Eval(context)
            # D lam is the change of velocity that the contact gives the tip.
            lcs = self._lcs.Eval(context)
            on_tip = c.tip_mass / lcs.dt * (lcs.D[V_TIP] @ self._lam.Eval(context))
            force = clip_norm(-on_tip, c.force_max)
            v = np.array(x_next[V_TIP])
            p = np.array(x_next[P_TIP])
            if self._feel.HasValue(context) and self._feel.Eval(context)[0] > 0.5:
                felt = self._tip_force.Eval(context)[2]
                lost = 1.0 - min(max(felt / c.follow_force, 0.0), 1.0)
                change = lost * (x_next[V_BALL][:2] - v[:2])
                p[:2] += change * c.period_sec
                v[:2] += change
                v[2] -= lost * c.follow_speed
            v[2] = max(v[2], -c.down_max)
            if c.height is not None:
                p[2], v[2], force[2] = c.height, 0.0, 0.0
            p, v, force = no_nearer(p, v, force, c.nearest, c.wrist)
            fastest, touch_speed = c.push_speed, c.touch_speed
            if self._touch_speed.HasValue(context):
                learned = self._touch_speed.Eval(context)[0]
                touch_speed = touch_speed if np.isnan(learned) else learned
            if touch_speed < fastest:
                felt = np.linalg.norm(self._tip_force.Eval(context))
                if not felt >= c.touch_force:
                    fastest = max(touch_speed, 0.0)
            if fastest < np.inf:
                v = clip_norm(v, fastest)
                p = start[:3] + clip_norm(p - start[:3], fastest * c.period_sec)
            target = np.concatenate((p, v, self._zero, force))
            dv_max = c.acceleration_max * c.period_sec
        else:
            target = np.concatenate((self._reference.Eval(context), self._zero))
        end = next_end(
            start, target, c.speed_max * c.period_sec, c.speed_max, dv_max,
            c.acceleration_fed_forward_max,
        )  # fmt: skip
        discrete_state.set_value(self._line, np.concatenate((start, end, [t])))

    def _pose(self, context, output):
        output.SetFromVector(self._now(context)[:19])

    def _wrench(self, context, output):
        output.SetFromVector(self._now(context)[19:])

    def _command(self, context, output):
        output.SetFromVector(self._now(context))

    def _now(self, context):
        line = context.get_discrete_state(self._line).value()
        return pose_and_wrench(line, context.get_time(), self._period)
