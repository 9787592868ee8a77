"""A point effector in the plane, in porridge or on springs, and its target."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from makebreak.systems.numerics.first_calls import first_call
from makebreak.systems.numerics.settings import check_settings
from makebreak.systems.planar.numerics.planar_world import (
    circle_target,
    external_force,
    step,
)


@dataclass
class SpringConfig:
    """A spring between the point and a place in the plane."""

    anchor: list[float]  # [x, y] [m]
    stiffness: float  # [N/m]
    rest_length: float  # [m]
    reach: float = np.inf  # Largest length at which it pulls [m].


@dataclass
class PlanarWorldConfig:
    """A point in the plane, and the springs or the porridge that it meets."""

    mass: float = 1.0  # [kg]
    # Initial and final viscosity [N s/m]; it rises over ramp_sec, from time 0 on.
    viscosity: list[float] = field(default_factory=lambda: [0.0, 0.0])
    ramp_sec: float = 6.0
    springs: list[SpringConfig] = field(default_factory=list)
    period_sec: float = 0.001


def springs_of(config: PlanarWorldConfig) -> tuple[np.ndarray, np.ndarray]:
    """Anchors (n, 2) [m] and springs (n, 3) for numerics/planar_world.py.

    Raises: ValueError that names a setting out of range.
    """
    anchors, springs = [], []
    for k, spring in enumerate(config.springs):
        numbers = [spring.stiffness, spring.rest_length, spring.reach]
        if np.shape(spring.anchor) != (2,) or not np.isfinite(spring.anchor).all():
            raise ValueError(f"springs[{k}].anchor is {spring.anchor}, expected [x, y]")
        if not min(numbers) >= 0.0:
            raise ValueError(f"springs[{k}] is {spring}, expected numbers >= 0")
        anchors.append(spring.anchor)
        springs.append(numbers)
    return np.reshape(anchors, (-1, 2)), np.reshape(springs, (-1, 3))


class PlanarWorld(LeafSystem):
    """The effector, and the forces of porridge and springs on it
    (numerics/planar_world.py).

    The update to the state of t_k happens at t_k - lead_sec, so that systems that read
    at t_k read the state of t_k, while u is the one from the period's start.

    Inputs:  u (2,) [N], held over each period; zero if it is not finite.
    Outputs: state (4,) p, v [m], [m/s]; external_force (2,): of the world on the
             effector [N].

    Args: config; state (4,): the initial one; lead_sec [s].
    Raises: ValueError that names a setting out of range.
    """

    def __init__(self, config: PlanarWorldConfig, state, lead_sec: float = 1e-4):
        super().__init__()
        check_settings(config)
        c = config
        for name, number in (
            ("mass", c.mass),
            ("ramp_sec", c.ramp_sec),
            ("period_sec", c.period_sec),
        ):
            if not 0.0 < number < np.inf:
                raise ValueError(f"{name} is {number}, expected > 0")
        if not 0.0 < lead_sec < c.period_sec:
            raise ValueError(f"lead_sec is {lead_sec}, expected within a period")
        viscosity = np.array(c.viscosity, dtype=float)
        if viscosity.shape != (2,) or not np.all(viscosity >= 0.0):
            raise ValueError(f"viscosity is {c.viscosity}, expected 2 numbers >= 0")
        anchors, springs = springs_of(c)
        first = np.array(state, dtype=float)
        if first.shape != (4,) or not np.all(np.isfinite(first)):
            raise ValueError(f"state is {state}, expected 4 numbers")
        self._period = c.period_sec
        self._mass = float(c.mass)
        self._world = (viscosity, float(c.ramp_sec), anchors, springs)
        self._u = self.DeclareVectorInputPort("u", 2)
        self._state = self.DeclareDiscreteState(first)
        self._count = self.DeclareDiscreteState(1)  # Periods since time 0.
        self.DeclareStateOutputPort("state", self._state)
        self.DeclareVectorOutputPort(
            "external_force",
            2,
            self._calc_force,
            {
                self.discrete_state_ticket(self._state),
                self.discrete_state_ticket(self._count),
            },
        )
        self.DeclarePeriodicDiscreteUpdateEvent(
            c.period_sec, c.period_sec - lead_sec, self._update
        )
        first_call(self._first_call, first)

    def _first_call(self, x):
        force = external_force(x, 0.0, *self._world)
        step(x, 0.0, force, self._period, self._mass, *self._world)

    def _update(self, context: Context, discrete_state):
        count = context.get_discrete_state(self._count).value()[0]
        x = context.get_discrete_state(self._state).value().copy()
        u = self._u.Eval(context)
        if not (np.isfinite(u[0]) and np.isfinite(u[1])):
            u = np.zeros(2)
        t = count * self._period
        x = step(x, t, u, self._period, self._mass, *self._world)
        discrete_state.set_value(self._state, x)
        discrete_state.set_value(self._count, [count + 1.0])

    def _calc_force(self, context: Context, output: BasicVector):
        count = context.get_discrete_state(self._count).value()[0]
        x = context.get_discrete_state(self._state).value().copy()
        output.SetFromVector(external_force(x, count * self._period, *self._world))


@dataclass
class CircleTargetConfig:
    """The circle that a point is to follow."""

    radius: float = 0.25  # [m]
    duration_sec: float = 6.0
    phase: float = 0.0  # Angle at which it starts [rad].
    turn: int = 1  # +1 counter-clockwise, -1 clockwise.


class CircleTarget(LeafSystem):
    """A target that moves once around a circle about the origin, from rest to rest.

    Outputs: x_desired (6,) p, v, a [m], [m/s], [m/s2].
    """

    def __init__(self, config: CircleTargetConfig):
        super().__init__()
        check_settings(config)
        c = config
        for name in ("radius", "duration_sec"):
            if not 0.0 < getattr(c, name) < np.inf:
                raise ValueError(f"{name} is {getattr(c, name)}, expected > 0")
        if c.turn not in (1, -1):
            raise ValueError(f"turn is {c.turn}, expected 1 or -1")
        self._circle = (
            float(c.radius),
            float(c.duration_sec),
            float(c.phase),
            float(c.turn),
        )
        first_call(circle_target, 0.0, *self._circle)
        self.DeclareVectorOutputPort("x_desired", 6, self._calc, {self.time_ticket()})

    def _calc(self, context: Context, output: BasicVector):
        output.SetFromVector(circle_target(context.get_time(), *self._circle))
