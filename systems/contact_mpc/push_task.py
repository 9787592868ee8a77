"""The phases of pushing an object as a system (numerics/push_task.py)."""

from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X
from makebreak.systems.contact_mpc.numerics.contact_sampling import ObjectShape
from makebreak.systems.contact_mpc.numerics.lcs import is_finite
from makebreak.systems.contact_mpc.numerics.push_task import (
    WAIT,
    PushConfig,
    PushState,
    look_ahead,
    next_push,
)
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class PushTaskConfig:
    """Settings of PushTask."""

    push: PushConfig = field(default_factory=PushConfig)
    # Height of the tip's centre while it pushes [m]; the diagram sets it.
    height: float = 0.024
    # Clearance of the tip from the object at a place [m]; the diagram sets it.
    clearance: float = 0.004
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


class PushTask(LeafSystem):
    """Phases of pushing an object: C3's target in contact, the tip's path in between.

    Inputs:  x (19,) of numerics/ball_state.py; valid (1,): above 0.5 if x can be used;
             goal (3,) = x, y [m], yaw [rad]; command (3,) of ContactSampler;
             nearer (1,) [m], optional: learned distance by which the object reaches
             farther out than its shape (negative: less far); paths keep clear of that.
    Outputs: x_desired ((N + 1) 19,) for C3; reference (9,) = p, v, a of the tip at the
             next tick, used unless in CONTACT; phase (1,): 0 CONTACT, 1 TRAVEL, 2 WAIT.

    Nothing changes while x, command or nearer is not finite. While the goal is not
    finite the target stays and the tip waits.

    Args: config; n_knots: N + 1; shape: of object and tip; p_tip (3,): initial position
        of the tip [m].
    Raises: ValueError for a setting out of range.
    """

    def __init__(self, config: PushTaskConfig, n_knots: int, shape: ObjectShape, p_tip):
        super().__init__()
        check_settings(config)
        for name in (
            *(f"travel.{n}" for n in ("speed", "acceleration", "descent", "margin")),
            *(f"reach.{n}" for n in ("nearest", "farthest", "bearing")),
            *("unseen.sec", "unseen.believed_sec", "look_ahead", "look_ahead_angle"),
        ):
            value = attrgetter(name)(config.push)
            if not value > 0.0:
                raise ValueError(f"task.push.{name} is {value}, expected > 0")
        for name in ("travel.room", "place_change"):
            value = attrgetter(name)(config.push)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"task.push.{name} is {value}, expected >= 0")
        for name in ("height", "clearance", "period_sec"):
            if not getattr(config, name) > 0.0:
                raise ValueError(
                    f"task.{name} is {getattr(config, name)}, expected > 0"
                )
        self._config, self._n_knots, self._shape = config, n_knots, shape
        p_tip = np.array(p_tip, dtype=float)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._command = self.DeclareVectorInputPort("command", 3)
        self._nearer = self.DeclareVectorInputPort("nearer", 1)
        start = PushState(WAIT, p_tip, np.zeros(3), np.zeros(3))
        self._task = self.DeclareAbstractState(Value[object](start))
        at_rest = np.zeros(N_X)
        at_rest[3] = 1.0
        self._x_desired = self.DeclareDiscreteState(np.tile(at_rest, n_knots))
        self._reference = self.DeclareDiscreteState([*p_tip, *np.zeros(6)])
        self._phase = self.DeclareDiscreteState([float(WAIT)])
        self.DeclareStateOutputPort("x_desired", self._x_desired)
        self.DeclareStateOutputPort("reference", self._reference)
        self.DeclareStateOutputPort("phase", self._phase)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        c = self._config
        x, valid, goal, command = (
            np.asarray(port.Eval(context))
            for port in (self._x, self._valid, self._goal, self._command)
        )
        task = context.get_abstract_state(int(self._task)).get_value()
        nearer = 0.0
        if self._nearer.HasValue(context):
            nearer = float(self._nearer.Eval(context)[0])
        if not (is_finite(x) and is_finite(command) and np.isfinite(nearer)):
            return
        discrete = state.get_mutable_discrete_state()
        seen = valid[0] > 0.5 and is_finite(goal)
        if is_finite(goal):
            before = context.get_discrete_state(self._x_desired).value()[:N_X]
            target = look_ahead(c.push, x, goal, c.height, self._n_knots, before)
            discrete.set_value(int(self._x_desired), target.ravel())
        place = command[1:] if command[0] > 0.0 else None
        try:
            task = next_push(
                c.push, task, self._shape, c.period_sec, x, seen, place,
                int(command[0]), c.height, c.clearance, nearer,
            )  # fmt: skip
        except ValueError:  # An object on edge has no outline: nothing changes.
            return
        state.get_mutable_abstract_state(int(self._task)).set_value(task)
        discrete.set_value(
            int(self._reference), np.concatenate([task.p, task.v, task.a])
        )
        discrete.set_value(int(self._phase), [float(task.phase)])
