"""The state at a past time, without the lag of a filter (numerics/past_state.py)."""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    Q_BALL,
    V_BALL,
    V_TIP,
    W_BALL,
)
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics.past_state import pose_at
from makebreak.systems.perception.numerics.pose_filter import on_the_table


@dataclass
class PastStateConfig:
    """Settings of PastState."""

    ticks: int = 4  # How many periods ago.
    half_width: float = 0.1  # Readings within this time before and after are used [s].
    height: float = 0.02  # Of the object's origin on the table [m].
    period_sec: float = 0.05  # The learner's.
    offset_sec: float = 0.0


class PastState(LeafSystem):
    """State of tip and object some periods ago, for a learner that can wait.

    The tip's state is measured at once and stored. The object's pose comes from the
    readings before and after that time (numerics/past_state.py), laid on the table. Tip
    and object are then of the same time, which a filter's present estimates are not
    while the object's motion changes.

    Inputs:  x (19,) of contact_mpc/numerics/ball_state.py (only the tip is used);
             u_measured (3,): mean over the last period [N]; readings (abstract) of
             PoseSensor.
    Outputs: x (19,), u_measured (3,) of that time; ready (1,): 1 if both are known,
             else they are the last known ones.
    """

    def __init__(self, config: PastStateConfig, axis=(0.0, 0.0, 0.0)):
        """Args: axis: about which the object rolls (pose_filter.on_the_table).

        Raises: ValueError for a setting out of range.
        """
        super().__init__()
        if config.ticks != int(config.ticks) or config.ticks < 1:
            raise ValueError(f"ticks is {config.ticks}, expected at least 1")
        if not (config.half_width > 0.0 and config.period_sec > 0.0):
            raise ValueError(
                f"half_width is {config.half_width} and period_sec "
                f"{config.period_sec}, expected more than 0"
            )
        self._config, self._axis = config, np.array(axis, dtype=float)
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._u = self.DeclareVectorInputPort("u_measured", 3)
        self._readings = self.DeclareAbstractInputPort("readings", Value[object](()))
        # (time, tip's position and velocity, force) of each tick.
        self._memory = self.DeclareAbstractState(Value[object](()))
        at_rest = np.zeros(N_X)
        at_rest[Q_BALL.start] = 1.0
        self._past = self.DeclareDiscreteState(at_rest)
        self._force = self.DeclareDiscreteState(3)
        self._ready = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("x", self._past)
        self.DeclareStateOutputPort("u_measured", self._force)
        self.DeclareStateOutputPort("ready", self._ready)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        c, t = self._config, context.get_time()
        ticks = context.get_abstract_state(int(self._memory)).get_value()
        x, u = (np.array(port.Eval(context)) for port in (self._x, self._u))
        ticks = (*ticks, (t, x[P_TIP], x[V_TIP], u))[-c.ticks - 1 :]
        state.get_mutable_abstract_state(int(self._memory)).set_value(ticks)
        discrete = state.get_mutable_discrete_state()
        at, p_tip, v_tip, force = ticks[0]
        pose = None
        if len(ticks) == c.ticks + 1 and np.isfinite([*p_tip, *v_tip, *force]).all():
            pose = pose_at(at, self._readings.Eval(context), c.half_width)
        discrete.set_value(int(self._ready), [0.0 if pose is None else 1.0])
        if pose is None:
            return
        p, v, q, w = pose
        p, v, q, w = on_the_table(0.0, p, v, q, w, c.height, self._axis)
        past = np.zeros(N_X)
        past[P_TIP], past[V_TIP] = p_tip, v_tip
        past[P_BALL], past[V_BALL], past[Q_BALL], past[W_BALL] = p, v, q, w
        discrete.set_value(int(self._past), past)
        discrete.set_value(int(self._force), force)
