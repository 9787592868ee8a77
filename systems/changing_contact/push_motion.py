"""The motions between two pushes: see numerics/push_motion.py for their shape."""

import sys
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from makebreak.systems.changing_contact.numerics.contact_task import (
    DONE,
    HOLD,
    N_PHASE,
    PHASE_SEGMENT,
    PHASE_STAGE,
)
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern
from makebreak.systems.changing_contact.numerics.push_motion import (
    BALL,
    N_FRAME,
    TABLE,
    TABLE_SEGMENT,
    PushConfig,
    ball_pattern,
    frame_at,
    frame_under,
    moved_frame,
    table_pattern,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL, P_TIP, V_BALL
from makebreak.systems.contact_mpc.numerics.rolling_task import REPOSITION, CirclePath
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed

NEAR = 0.005  # Farther apart tip and ball, as modelled, do not touch [m].


@dataclass
class PushMotionConfig:
    """Settings of PushMotion."""

    shape: PushConfig = field(default_factory=PushConfig)
    # Number of the first reposition on which the table is touched.
    table_first: int = 3
    # Number of repositions from one touch of the table to the next; 0: it is never
    # touched.
    table_every: int = 25
    # Time for which the tip presses on the ball before the push begins [s].
    settle_sec: float = 0.02
    # Time in which the motion's frame follows a ball that changes its course [s].
    follow_sec: float = 0.15
    # Time after which a motion that has met nothing is over [s].
    give_up_sec: float = 4.0


@dataclass(frozen=True, eq=False)
class _Push:
    """The motion that runs, or ran last."""

    pattern: MotionPattern
    frame: np.ndarray  # (N_FRAME,)
    heading: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0]))
    kind: int = BALL
    trial: int = 0
    repositions: int = 0
    due: int = 0  # The reposition from which on the table is to be touched.
    since: float = 0.0  # When the motion began [s],
    met: float = np.inf  # and its last segment.
    running: bool = False
    active: bool = False
    landed: bool = False

    def __post_init__(self):
        for array in (self.frame, self.heading):
            array.setflags(write=False)

    def __copy__(self):
        return self

    def __deepcopy__(self, _):
        return self


class PushMotion(LeafSystem):
    """A new motion pattern for each reposition, in a frame that moves with the ball.

    Inputs:  x (19,) estimated; task_phase (1,) of RollingTask; phase (6,) of the
             velocity shaper; arm (19,) x_desired of the arm's reference, in the world;
             shaped (19,) the shaper's x_desired, in the frame; waits (1,) of
             RollingTask, optional: 1 if the ball is known to stay where it is left.
    Outputs: motion (MotionPattern), in the frame; frame (7,) origin, velocity, time;
             active (1,) 1 while the shaper leads the arm; landed (1,) 1 when the
             reposition is over; trial (1,) counts the motions; kind (1,) 0: to the
             ball, 1: to the table.

    The table is touched ahead of the ball, and only where that leads the tip towards
    the wrist's side: else the arm comes between the ball and the camera above. It is
    not touched before it is known that the ball stays where it is meanwhile.

    Args: path; radii as modelled [m]; acceleration_max [m/s2] of the patterns;
        from_wrist (2,), from the wrist to the tip, seen from above.
    Raises: ValueError for numbers that make no motion.
    """

    def __init__(
        self,
        config: PushMotionConfig,
        path: CirclePath,
        radius_ball: float,
        radius_tip: float,
        acceleration_max: float,
        from_wrist: np.ndarray,
        period_sec: float = 0.0125,
        offset_sec: float = 0.0,
    ):
        super().__init__()
        check_settings(config)
        _check(config)
        self._config, self._path, self._period = replace(config), path, period_sec
        self._radii = radius_ball, radius_tip
        self._a_max, self._from_wrist = acceleration_max, np.array(from_wrist)
        inputs = (("x", N_X), ("task_phase", 1), ("phase", N_PHASE), ("arm", 19))
        self._x, self._task, self._phase, self._arm = [
            self.DeclareVectorInputPort(name, size) for name, size in inputs
        ]
        self._shaped = self.DeclareVectorInputPort("shaped", 19)
        self._waits = self.DeclareVectorInputPort("waits", 1)
        pattern = self.first_pattern()
        due = config.table_first if config.table_every > 0 else sys.maxsize
        none = _Push(pattern, np.zeros(N_FRAME), due=due)
        self._push = self.DeclareAbstractState(AbstractValue.Make(none))
        ticket = {self.abstract_state_ticket(self._push)}
        self.DeclareAbstractOutputPort(
            "motion",
            lambda: AbstractValue.Make(pattern),
            lambda context, output: output.set_value(self._now(context).pattern),
            ticket,
        )
        for name, size, value in (
            ("frame", N_FRAME, lambda push: push.frame),
            ("active", 1, lambda push: [float(push.active)]),
            ("landed", 1, lambda push: [float(push.landed)]),
            ("trial", 1, lambda push: [float(push.trial)]),
            ("kind", 1, lambda push: [float(push.kind)]),
        ):
            self.DeclareVectorOutputPort(name, size, self._calc(value), ticket)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            period_sec, offset_sec, self._update
        )

    def first_pattern(self) -> MotionPattern:
        """What the motion is before the first reposition: never followed."""
        start = np.array([0.02, 0.0, 2.0 * sum(self._radii)])
        return self._pattern(BALL, start, np.array([1.0, 0.0]))

    def _pattern(self, kind, start, heading):
        make = ball_pattern if kind == BALL else table_pattern
        return make(self._config.shape, start, heading, *self._radii, self._a_max)

    def _now(self, context: Context) -> _Push:
        return context.get_abstract_state(int(self._push)).get_value()

    def _calc(self, value):
        def calc(context, output):
            output.SetFromVector(value(self._now(context)))

        return calc

    @timed
    def _update(self, context: Context, state):
        t = context.get_time()
        x = self._x.Eval(context)
        task = self._task.Eval(context)[0]
        push = self._next(context, self._now(context), t, x, task)
        state.get_mutable_abstract_state(int(self._push)).set_value(push)

    def _next(self, context, push, t, x, task) -> _Push:
        p, v, c = x[P_BALL], x[V_BALL], self._config
        if task != REPOSITION:
            # The shaper's reference is still being faded out: its frame may not jump.
            return replace(
                push,
                frame=moved_frame(push.frame, t, p, v, c.follow_sec),
                running=False,
                active=False,
                landed=False,
            )
        if not push.running:
            n = push.repositions + 1
            table = n >= push.due and self._path.heading(p) @ self._from_wrist <= 0.0
            if self._waits.HasValue(context):
                table = table and self._waits.Eval(context)[0] > 0.5
            frame = frame_under(p, v, t)
            start = self._arm.Eval(context)[:3] - frame[:3]
            push = replace(
                push,
                frame=frame,
                repositions=n,
                due=n + c.table_every if table else push.due,
                running=True,
            )
            return self._begun(push, TABLE if table else BALL, start, t, x)
        # Where the ball is to go changes with where it is: so does what is behind it.
        turned = push.heading - self._path.heading(p)
        goal = p + c.shape.land_behind * np.append(turned, 0.0)
        phase = self._phase.Eval(context)
        surveys = push.kind == TABLE and c.shape.table.survey > 0
        if surveys and phase[PHASE_SEGMENT] > TABLE_SEGMENT:
            # What lies still is surveyed, in a frame that comes to rest.
            goal, v = frame_at(push.frame, t), np.zeros(3)
        frame = moved_frame(push.frame, t, goal, v, c.follow_sec)
        push = replace(push, active=True, frame=frame)
        # The shaper may not have read the new pattern yet.
        if t - push.since < 1.5 * self._period:
            return push
        last = phase[PHASE_SEGMENT] == len(push.pattern) - 1
        if last and push.met == np.inf:
            push = replace(push, met=t)
        missed = phase[PHASE_STAGE] == HOLD or t - push.since > c.give_up_sec
        if push.kind == TABLE and (missed or last and phase[PHASE_STAGE] == DONE):
            start = np.array(self._shaped.Eval(context)[:3])
            start[2] = x[P_TIP][2]  # Pressed down, it is where the table has it.
            return self._begun(push, BALL, start, t, x)
        if push.kind == BALL and (missed or t - push.met >= c.settle_sec):
            apart = np.linalg.norm(x[P_TIP] - x[P_BALL]) - sum(self._radii)
            if apart <= NEAR:
                return replace(push, landed=True)
            # What was felt was not the ball: once more, from where the tip is.
            start = x[P_TIP] - frame_at(push.frame, t)
            return self._begun(push, BALL, start, t, x)
        return push

    def _begun(self, push, kind, start, t, x):
        heading = self._path.heading(x[P_BALL])
        try:
            pattern = self._pattern(kind, start, heading)
        except ValueError:  # No way from here: the task's own, and again next tick.
            return replace(push, running=False, active=False)
        return replace(
            push,
            pattern=pattern,
            kind=kind,
            trial=push.trial + 1,
            heading=heading,
            since=t,
            met=np.inf,
        )


def _check(config: PushMotionConfig) -> None:
    """Raises: ValueError by name."""
    table = {f"table.{name}": value for name, value in vars(config.shape.table).items()}
    survey = table.pop("table.survey")
    if survey != int(survey) or survey < 0:
        raise ValueError(f"push.shape.table.survey is {survey}, expected 0, 1, ...")
    for name, value in (vars(config.shape) | table).items():
        if name != "table" and not 0.0 < value < np.inf:
            raise ValueError(f"push.shape.{name} is {value}, expected > 0")
    for name in ("settle_sec", "follow_sec", "give_up_sec"):
        if not 0.0 < getattr(config, name) < np.inf:
            raise ValueError(f"push.{name} is {getattr(config, name)}, expected > 0")
    if config.table_first < 1 or config.table_every < 0:
        raise ValueError(
            f"push.table_first, table_every are {config.table_first}, "
            f"{config.table_every}, expected at least 1 and 0"
        )
