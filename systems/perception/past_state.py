"""The state at a past time, without the lag of a filter (numerics/past_state.py)."""

from dataclasses import dataclass, field, replace

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
    rolling_velocity,
)
from makebreak.systems.numerics.timing import timed
from makebreak.systems.perception.numerics.past_state import pose_at
from makebreak.systems.perception.numerics.pose_filter import on_the_table, turned


@dataclass
class PastStateConfig:
    """Settings of PastState."""

    ticks: int = 4  # How many periods ago.
    half_width: float = 0.1  # Readings within this time before and after are used [s].
    height: float = 0.02  # Of the object's origin on the table [m].
    period_sec: float = 0.05  # The learner's, a multiple of tick_sec.
    tick_sec: float = 0.0125 / 3.0  # Period of x and u [s].
    offset_sec: float = 0.0


@dataclass(frozen=True, eq=False)
class _Memory:
    """The last readings; and of the last ticks the time, and the tip's position beside
    the input's second integral over time, which is to the input what the position is to
    the acceleration.
    """

    readings: tuple = ()  # (time, p (3,), q (4,)) of each, oldest first.
    ticks: tuple = ()  # (time, (6,)) of each.
    rate: np.ndarray = field(default_factory=lambda: np.zeros(3))  # First integral.
    impulse: np.ndarray | None = None  # Filtered, at the last time that was known.

    def __deepcopy__(self, memo):
        return self  # Every part is immutable.

    @property
    def beside(self):
        times, values = zip(*self.ticks, strict=True) if self.ticks else ((), ())
        return times, np.reshape(values, (-1, 6))

    def with_reading(self, reading, since) -> "_Memory":
        """With the last reading, unless it is known, without those before `since`."""
        t, p, q = reading[0], reading[1:4], reading[4:]
        if t < 0.0 or self.readings and t <= self.readings[-1][0]:
            return self
        kept = tuple(one for one in self.readings if one[0] >= since)
        return replace(self, readings=(*kept, (t, p, q)))

    def with_tick(self, t, p_tip, u, dt, n_kept: int) -> "_Memory":
        """A tick later; without those before one that is not finite."""
        if not (np.isfinite(p_tip).all() and np.isfinite(u).all()):
            return _Memory(self.readings)
        rate, twice = self.rate + dt * u, np.zeros(3)
        if self.ticks:
            twice = self.ticks[-1][1][3:] + 0.5 * dt * (self.rate + rate)
        ticks = (*self.ticks, (t, np.append(p_tip, twice)))[-n_kept:]
        return _Memory(self.readings, ticks, rate, self.impulse)


class PastState(LeafSystem):
    """State of tip and object some periods ago, for a learner that can wait.

    The object's pose comes from the readings before and after that time, and the tip
    and the input go through the same filter (numerics/past_state.py). So tip and object
    are of the same time, which a filter's present estimates are not while the object's
    motion changes, and a force lasts as long as the motion that it explains. The
    object is laid on the table. A ball, of which nobody sees how it is turned, rolls
    there without slipping.

    Inputs:  x (19,) of contact_mpc/numerics/ball_state.py (only the tip's position is
             used); u (3,): over the last tick [N]; reading (8,): the last one that has
             arrived: time [s], p (3,), q (4,); its time is -1 before the first.
    Outputs: x (19,) of that time, u_measured (3,): filtered, over the period before it
             (zero at the first known time); ready (1,): 1 if both are known, else they
             are the last known ones.
    """

    def __init__(self, config: PastStateConfig, axis=(0.0, 0.0, 0.0), is_ball=False):
        """Args: axis: about which the object rolls (pose_filter.on_the_table); is_ball:
            whether it is a ball of radius `height`.

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
        every = config.period_sec / config.tick_sec if config.tick_sec > 0.0 else 0.0
        if round(every) < 1 or abs(every - round(every)) > 1e-6:
            raise ValueError(
                f"period_sec is {config.period_sec}, expected a multiple of tick_sec, "
                f"{config.tick_sec}"
            )
        self._every = round(every)
        # Ticks that the parabola of the oldest time reaches over, and one more.
        self._span = config.ticks * config.period_sec + config.half_width
        self._n_kept = int(np.ceil(self._span / config.tick_sec)) + 2
        self._config, self._axis = config, np.array(axis, dtype=float)
        self._is_ball = is_ball
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._u = self.DeclareVectorInputPort("u", 3)
        self._reading = self.DeclareVectorInputPort("reading", 8)
        self._memory = self.DeclareAbstractState(Value[object](_Memory()))
        at_rest = np.zeros(N_X)
        at_rest[Q_BALL.start] = 1.0
        self._past = self.DeclareDiscreteState(at_rest)
        self._force = self.DeclareDiscreteState(3)
        self._ready = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("x", self._past)
        self.DeclareStateOutputPort("u_measured", self._force)
        self.DeclareStateOutputPort("ready", self._ready)
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            config.tick_sec, config.offset_sec, self._update
        )

    @timed
    def _update(self, context, state):
        c, t = self._config, context.get_time()
        memory = context.get_abstract_state(int(self._memory)).get_value()
        x, u = (np.array(port.Eval(context)) for port in (self._x, self._u))
        memory = memory.with_tick(t, x[P_TIP], u, c.tick_sec, self._n_kept)
        reading = self._reading.Eval(context).copy()
        memory = memory.with_reading(reading, t - self._span - c.period_sec)
        if round((t - c.offset_sec) / c.tick_sec) % self._every == 0:
            at = t - c.ticks * c.period_sec
            found = pose_at(at, memory.readings, c.half_width, memory.beside)
            discrete = state.get_mutable_discrete_state()
            discrete.set_value(int(self._ready), [0.0 if found is None else 1.0])
            impulse = None
            if found is not None:
                impulse = found[5][3:]
                self._put(discrete, found, impulse, memory.impulse)
            memory = replace(memory, impulse=impulse)
        state.get_mutable_abstract_state(int(self._memory)).set_value(memory)

    def _put(self, discrete, found, impulse, before) -> None:
        p, v, q, w, beside, rates = found
        height, past = self._config.height, np.zeros(N_X)
        p, v, q, w = on_the_table(0.0, p, v, q, w, height, self._axis)
        if self._is_ball:
            last, w = discrete.value(int(self._past)), rolling_velocity(v, height)
            q = turned(last[Q_BALL], rolling_velocity(p - last[P_BALL], height))
        past[P_TIP], past[V_TIP] = beside[:3], rates[:3]
        past[P_BALL], past[V_BALL], past[Q_BALL], past[W_BALL] = p, v, q, w
        force = np.zeros(3)
        if before is not None:
            force = (impulse - before) / self._config.period_sec
        discrete.set_value(int(self._past), past)
        discrete.set_value(int(self._force), force)
