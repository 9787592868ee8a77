"""The state a moment ago, without the lag of what is known now."""

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
    ticks: int = 4  # So many periods ago.
    half_width: float = 0.1  # Readings so long before and after count [s].
    height: float = 0.02  # Of the object's origin on the table [m].
    period_sec: float = 0.05  # The learner's.
    offset_sec: float = 0.0


class PastState(LeafSystem):
    """Tip and object some periods ago: for who learns and can wait.

    The tip is known at once and remembered; of the object's pose the readings around
    that moment count (numerics/past_state.py), laid on the table. So the two belong
    together, which those of the present do not while the object's motion changes.

    Inputs:  x (19,) of contact_mpc/numerics/ball_state.py, of which the tip counts;
             u_measured (3,) mean over the last period [N]; readings (abstract) of
             PoseSensor.
    Outputs: x (19,), u_measured (3,) of that moment; ready (1,): 1 where both are
             known. Where not, they are the last that were.
    """

    def __init__(self, config: PastStateConfig, axis=(0.0, 0.0, 0.0)):
        """Args: axis, as of on_the_table."""
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
