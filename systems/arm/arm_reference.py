"""The arm's reference from the planner's commands (numerics/arm_reference.py)."""

from dataclasses import dataclass, field
from operator import attrgetter

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
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.numerics.rolling_task import ROLL
from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class ReferenceLimits:
    """Limits of what is asked of the arm."""

    force_max: float = 3.0  # Largest feed-forward force [N].
    # Largest acceleration of the velocity reference while the tip follows C3 [m/s2].
    acceleration_max: float = 1.5
    # Largest acceleration that is fed forward between two contacts [m/s2].
    acceleration_fed_forward_max: float = 10.0
    # Largest speed of the reference, however far away a command is [m/s]. The task
    # itself stays below 0.35 m/s and 4 m/s2.
    speed_max: float = 0.5
    # Largest speed while the tip follows C3, in contact too: a tip that slides along a
    # side would hit the next corner at the speed that it has reached by then [m/s].
    push_speed: float = np.inf
    # Largest downward speed while the tip follows C3 and `height` is null: contact may
    # come early [m/s].
    down_max: float = 0.04


@dataclass
class FollowConfig:
    """How a tip feels for the ball. Without effect where contacts are sampled."""

    # Speed that is added downwards where the tip has to feel for the ball and feels
    # less than `force`; it then also moves along with the ball [m/s].
    speed: float = 0.015
    # Force from which on a tip that feels for the ball has found it [N].
    force: float = 1.0
    # Whether a tip that feels for the ball moves at `speed` towards its centre, and
    # across that line as C3 has it: for a ball that is hard and smooth; gentle_rolling
    # sets it.
    hard: bool = False


@dataclass
class TouchConfig:
    """The speed before a touch, which may come earlier than planned."""

    # Largest speed while the tip follows C3 and feels less than `force`: the impact
    # grows with the speed [m/s].
    speed: float = np.inf
    force: float = 1.0  # Force from which on the tip counts as in contact [N].


@dataclass
class ArmReferenceConfig:
    """Settings of ArmReference."""

    # Mass of the tip in the LCS, by which lam is turned into a force [kg].
    tip_mass: float = 1.0
    limits: ReferenceLimits = field(default_factory=ReferenceLimits)
    follow: FollowConfig = field(default_factory=FollowConfig)
    touch: TouchConfig = field(default_factory=TouchConfig)
    # Height at which the tip stays while it follows C3 horizontally [m]; null: C3 moves
    # it up and down too. The diagram sets it.
    height: float | None = None
    # Least horizontal distance of the wrist from the arm's base while the tip follows
    # C3, which does not know the arm and would fold its elbow [m]; push_object sets it.
    nearest: float = 0.0
    # Vector from the wrist to the tip, seen from above, [x, y] [m]; push_object sets
    # it.
    wrist: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Period of the updates, that of C3 and of the task [s]; the diagram sets it.
    period_sec: float = 0.0125
    # Time of the first update, a little after C3 and the task [s]; the diagram sets it.
    offset_sec: float = 0.0


class ArmReference(LeafSystem):
    """The arm's reference between two 80 Hz commands, interpolated at any time.

    While rolling it leads to C3's x_next and feeds the planned contact force forward;
    otherwise it follows the task's reference. Each update starts a straight line from
    the present reference to the new command, which is reached one period later: a step
    of the reference would saturate the arm's torque rate.

    While C3 keeps an old command (its status is not 0), a rolling reference stays where
    it is, with zero force; so does any reference while its command is not finite. A
    distant command is approached at limits.speed_max, not within one period.

    The fed-forward force alone moves a well damped tip by some mm/s: too slow for the
    dents of an object that rolls by under it, and without contact C3's tip runs ahead
    of the ball. So a tip that has to feel for the ball and measures no force moves down
    and along with the ball until it does. (On a hard ball it would hop on the spot:
    there it pushes on meanwhile, see follow.hard.)

    Inputs:  phase (1,), reference (9,) of RollingTask or PushTask; x_next (19,), lam
             (n_lam,), status (1,) of C3; lcs (abstract): the LCS of C3's command;
             feel (1,), optional, of RollingTask; tip_force (3,) [N]: estimated contact
             force on the tip, needed with feel or a touch.speed; touch_speed (1,)
             [m/s], optional, of TouchDown: replaces the setting unless it is NaN.
    Outputs: x_desired (19,) = [p, quaternion, v, w, a, alpha], with the identity as
             quaternion and no rotation; wrench (6,), force first [N], [N m];
             command (25,): both in one, for a reader at 1 kHz.

    Args: config; n_lam: forces of the LCS; p_tip (3,): initial position of the tip [m];
        lcs: an example of what the input port carries.
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, config: ArmReferenceConfig, n_lam: int, p_tip, lcs: LCS):
        super().__init__()
        check_settings(config)
        for name in ("follow.force", "touch.speed", "touch.force", "limits.push_speed"):
            if not (value := attrgetter(name)(config)) > 0.0:
                raise ValueError(f"{name} is {value}, expected more than 0")
        if config.limits.push_speed < config.touch.speed < np.inf:
            raise ValueError(
                f"touch.speed is {config.touch.speed}, expected at most "
                f"limits.push_speed, {config.limits.push_speed} m/s"
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
        """Sets a reference at rest at p_tip (3,) [m] in a Context of this system."""
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
            # D lam is the change of the tip's velocity by the contact in one step.
            lcs = self._lcs.Eval(context)
            on_tip = c.tip_mass / lcs.dt * (lcs.D[V_TIP] @ self._lam.Eval(context))
            force = clip_norm(-on_tip, c.limits.force_max)
            v = np.array(x_next[V_TIP])
            p = np.array(x_next[P_TIP])
            if self._feel.HasValue(context) and self._feel.Eval(context)[0] > 0.5:
                felt = self._tip_force.Eval(context)[2]
                lost = 1.0 - min(max(felt / c.follow.force, 0.0), 1.0)
                change = np.zeros(3)
                if c.follow.hard:
                    n = x_next[P_TIP] - x_next[P_BALL]
                    n /= max(np.sqrt(n @ n), 1e-9)
                    away = (v - x_next[V_BALL]) @ n
                    change = -lost * (away + c.follow.speed) * n
                else:
                    change[:2] = lost * (x_next[V_BALL] - v)[:2]
                    v[2] -= lost * c.follow.speed
                p += change * c.period_sec
                v += change
            v[2] = max(v[2], -c.limits.down_max)
            if c.height is not None:
                p[2], v[2], force[2] = c.height, 0.0, 0.0
            p, v, force = no_nearer(p, v, force, c.nearest, c.wrist)
            fastest, touch_speed = c.limits.push_speed, c.touch.speed
            if self._touch_speed.HasValue(context):
                learned = self._touch_speed.Eval(context)[0]
                touch_speed = touch_speed if np.isnan(learned) else learned
            if touch_speed < fastest:
                felt = np.linalg.norm(self._tip_force.Eval(context))
                if not felt >= c.touch.force:
                    fastest = max(touch_speed, 0.0)
            if fastest < np.inf:
                v = clip_norm(v, fastest)
                p = start[:3] + clip_norm(p - start[:3], fastest * c.period_sec)
            target = np.concatenate((p, v, self._zero, force))
            dv_max = c.limits.acceleration_max * c.period_sec
        else:
            target = np.concatenate((self._reference.Eval(context), self._zero))
        fastest = c.limits.speed_max
        end = next_end(
            start, target, fastest * c.period_sec, fastest, dv_max,
            c.limits.acceleration_fed_forward_max,
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
