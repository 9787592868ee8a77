"""A sequence of goal poses for a pushed object."""

from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
from pydrake.systems.framework import LeafSystem

from makebreak.systems.contact_mpc.numerics.ball_state import N_X, Q_BALL
from makebreak.systems.contact_mpc.numerics.push_task import (
    angle_between,
    errors,
    heading,
)
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.numerics.timing import timed


@dataclass
class ReachedConfig:
    """When a goal counts as reached."""

    # Tolerances of a goal's position [m] and yaw [rad].
    tolerance: list[float] = field(default_factory=lambda: [0.02, 0.1])
    # Fraction of the tolerance below which the estimated errors have to stay for
    # dwell_sec.
    share: float = 0.8
    # Time for which the estimated errors have to stay below share times the tolerance
    # [s].
    dwell_sec: float = 0.25


@dataclass
class PushGoalsConfig:
    """Settings of PushGoals: where goals are, and when one is reached."""

    # Centre of the rectangle from which goals are drawn, [x, y] [m]; yaw is drawn from
    # the whole circle.
    center: list[float] = field(default_factory=lambda: [0.5, 0.0])
    # Lengths in x and y of the rectangle from which goals are drawn [m].
    size: list[float] = field(default_factory=lambda: [0.16, 0.36])
    reached: ReachedConfig = field(default_factory=ReachedConfig)
    limit_sec: float = 60.0  # Time after which the next goal follows in any case [s].
    period_sec: float = 0.0125  # Period of the updates [s]; the diagram sets it.
    offset_sec: float = 0.0  # Time of the first update [s]; the diagram sets it.


def draw_poses(config: PushGoalsConfig, n: int, seed: int) -> np.ndarray:
    """(n, 3) x, y [m], yaw [rad], drawn uniformly from the region of the config.

    Raises: ValueError that names a setting out of range.
    """
    _check(config)
    rng = np.random.default_rng([seed, 1])
    half = 0.5 * np.array([*config.size, 2.0 * np.pi])
    return np.array([*config.center, 0.0]) + rng.uniform(-half, half, (n, 3))


def nearest_turn(goal: float, yaw: float, fold: int) -> float:
    """Turn [rad] that, added to the goal's yaw, gives the equivalent yaw nearest to
    `yaw` [rad].

    Args: fold: rotational symmetry of the object (PushGoals).
    """
    off = angle_between(goal, yaw)
    if fold == 0:
        return off
    return 2.0 * np.pi / fold * round(off * fold / (2.0 * np.pi))


class PushGoals(LeafSystem):
    """Outputs one goal until the estimate says that the object is there or its time is
    up, then the next one.

    Inputs:  x (19,) of numerics/ball_state.py; valid (1,): above 0.5 if x can be used.
    Outputs: goal (3,) = x, y [m], yaw [rad]; log (5,) = [number of the goal, goal (3),
             its start time [s]]. After the last goal its pose stays, and the number is
             the number of goals.

    Where turns leave the object unchanged, the goal's yaw is the equivalent one nearest
    to the object's yaw when it was first seen after the goal had come.

    Args: config; goals (n, 3); fold: number of equal turns about z that leave the
        object unchanged for what measures it; 0: any turn does.
    Raises: ValueError for a setting out of range, or goals of another shape.
    """

    def __init__(self, config: PushGoalsConfig, goals, fold: int = 1):
        super().__init__()
        check_settings(config)
        _check(config)
        self._config = config
        self._goals = np.array(goals, dtype=float)
        if self._goals.ndim != 2 or self._goals.shape[1] != 3 or not len(self._goals):
            raise ValueError(f"goals is {self._goals.shape}, expected (n, 3)")
        self._x = self.DeclareVectorInputPort("x", N_X)
        self._valid = self.DeclareVectorInputPort("valid", 1)
        self._fold = fold
        # Number of the goal, its start time [s], for how long it has been reached [s],
        # and the turn that is added to its yaw [rad] (NaN: not known yet).
        self._state = self.DeclareDiscreteState([0.0, 0.0, 0.0, np.nan])
        ticket = {self.discrete_state_ticket(self._state)}
        self.DeclareVectorOutputPort("goal", 3, self._calc_goal, ticket)
        self.DeclareVectorOutputPort("log", 5, self._calc_log, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(
            config.period_sec, config.offset_sec, self._update
        )

    def _goal(self, context):
        state = context.get_discrete_state(self._state).value()
        goal = self._goals[min(int(state[0]), len(self._goals) - 1)].copy()
        if np.isfinite(state[3]):
            goal[2] += state[3]
        return goal

    def _calc_goal(self, context, output):
        output.SetFromVector(self._goal(context))

    def _calc_log(self, context, output):
        number, since, _, _ = context.get_discrete_state(self._state).value()
        output.SetFromVector([number, *self._goal(context), since])

    @timed
    def _update(self, context, discrete_state):
        c, t = self._config, context.get_time()
        number, since, held, turn = context.get_discrete_state(self._state).value()
        if number >= len(self._goals):
            return
        x = np.asarray(self._x.Eval(context))
        there = False
        is_seen = self._valid.Eval(context)[0] > 0.5 and np.isfinite(x).all()

        def turn_of(goal):
            return nearest_turn(goal[2], heading(x[Q_BALL]), self._fold)

        if is_seen:
            goal = self._goals[int(number)].copy()
            if np.isnan(turn):
                turn = turn_of(goal)
            goal[2] += turn
            off = errors(x, goal)
            there = all(
                a < c.reached.share * b
                for a, b in zip(off, c.reached.tolerance, strict=True)
            )
        held = held + c.period_sec if there else 0.0
        if held >= c.reached.dwell_sec or t - since >= c.limit_sec:
            number, since, held = number + 1.0, t, 0.0
            if number < len(self._goals):  # Now: others read it at this instant.
                turn = turn_of(self._goals[int(number)]) if is_seen else np.nan
        discrete_state.set_value(self._state, [number, since, held, turn])


def _check(config: PushGoalsConfig) -> None:
    """Raises: ValueError that names a setting out of range."""
    for name in ("center", "size", "reached.tolerance"):
        value = attrgetter(name)(config)
        if np.shape(value) != (2,) or not np.isfinite(value).all():
            raise ValueError(f"goals.{name} is {value}, expected two numbers")
    if min(config.size) < 0.0:
        raise ValueError(f"goals.size is {config.size}, expected at least 0")
    r = config.reached
    if not min(r.tolerance) > 0.0:
        raise ValueError(f"goals.reached.tolerance is {r.tolerance}, expected > 0")
    if not 0.0 < r.share <= 1.0:
        raise ValueError(
            f"goals.reached.share is {r.share}, expected > 0 and at most 1: a goal is "
            "left where it was reached"
        )
    for name in ("limit_sec", "period_sec"):
        if not 0.0 < getattr(config, name) < np.inf:
            raise ValueError(f"goals.{name} is {getattr(config, name)}, expected > 0")
    if not 0.0 <= r.dwell_sec < np.inf:
        raise ValueError(f"goals.reached.dwell_sec is {r.dwell_sec}, expected >= 0")
