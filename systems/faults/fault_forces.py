"""Disturbances for tests: a push, and a hand that moves the ball; as generalized forces
on the plant."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import LeafSystem

from makebreak.systems.faults.numerics.time_span import lasts

HAND_RATE = 60.0  # Natural frequency of the hand's spring and damper [rad/s].
HAND_SPEED = 0.8  # [m/s]
HAND_HEIGHT = 1.2  # Above any camera [m].
ASIDE = 0.12  # The hand first moves the ball to the side, from under the finger [m].


class BodyForce(LeafSystem):
    """A force at a body's origin as generalized forces.

    Inputs:  state (n_x,) of the plant; force (3,) in the world [N].
    Outputs: generalized_force (n_v,).
    """

    def __init__(self, plant: MultibodyPlant, body):
        super().__init__()
        self._plant, self._body = plant, body
        self._scratch = plant.CreateDefaultContext()
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._force_on = self.DeclareVectorInputPort("force", 3)
        self.DeclareVectorOutputPort(
            "generalized_force", plant.num_velocities(), self._calc
        )

    def _force(self, context) -> np.ndarray:
        return self._force_on.Eval(context)

    def _calc(self, context, output):
        plant, force = self._plant, self._force(context)
        if not np.any(force):
            output.SetZero()
            return
        plant.SetPositionsAndVelocities(self._scratch, self._state.Eval(context))
        world = plant.world_frame()
        J = plant.CalcJacobianTranslationalVelocity(
            self._scratch,
            JacobianWrtVariable.kV,
            self._body.body_frame(),
            np.zeros(3),
            world,
            world,
        )
        output.SetFromVector(J.T @ force)


class Push(BodyForce):
    """A constant force (3,) in the world [N] from `start` until before `end` [s]; the
    input `force` is not used."""

    def __init__(self, plant: MultibodyPlant, body, force, start, end):
        super().__init__(plant, body)
        self._constant = np.array(force, dtype=float)
        self._start, self._end = float(start), float(end)

    def _force(self, context) -> np.ndarray:
        acts = lasts(context.get_time(), self._start, self._end)
        return self._constant if acts else np.zeros(3)


class Hand(LeafSystem):
    """Takes a free body at `start`, moves it to the side and up, and puts it down and
    lets go at `end` [s], at its old position turned about `center`.

    A spring and a damper, scaled with the body's mass, lead it along straight lines;
    its rotation is damped.

    Inputs:  state (n_x,) of the plant.
    Outputs: generalized_force (n_v,).

    Args: center (2,) [m]; turn [rad] about it.
    """

    def __init__(
        self, plant: MultibodyPlant, body, center, turn, start, end, period_sec=0.001
    ):
        super().__init__()
        self._n_q, self._n_v = plant.num_positions(), plant.num_velocities()
        self._q = body.floating_positions_start() + 4
        self._v = body.floating_velocities_start_in_v()
        mass = plant.CalcSpatialInertia(
            plant.CreateDefaultContext(), body.body_frame(), [body.index()]
        )
        self._mass = mass.get_mass()
        inertia = mass.CalcRotationalInertia().get_moments()
        self._spin = np.array(inertia) * HAND_RATE
        self._weight = -self._mass * np.array(plant.gravity_field().gravity_vector())
        self._center, self._turn = np.array(center, dtype=float), float(turn)
        self._start, self._end = float(start), float(end)
        self._state = self.DeclareVectorInputPort("state", self._n_q + self._n_v)
        self._taken = self.DeclareDiscreteState(3)  # Where it was taken from [m].
        self.DeclareVectorOutputPort("generalized_force", self._n_v, self._calc)
        self.DeclareInitializationDiscreteUpdateEvent(self._note)
        self.DeclarePeriodicDiscreteUpdateEvent(period_sec, 0.0, self._note)
        least = 2.0 * (ASIDE + HAND_HEIGHT) / HAND_SPEED
        if not self._end - self._start > least + 0.2:
            raise ValueError(
                f"a hand takes {least + 0.2:.1f} s to take the ball away and to put it "
                f"back, got {self._end - self._start:g}"
            )

    def _note(self, context, discrete_state):
        t = context.get_time()
        if t == 0.0 or not lasts(t, self._start, np.inf):
            p = self._state.Eval(context)[self._q : self._q + 3]
            discrete_state.set_value(self._taken, p)

    def _goal(self, t, p):
        """Position (3,) of the hand t [s] after it took the body at p (3,) [m]."""
        out = p[:2] - self._center
        length = max(float(np.sqrt(out @ out)), 1e-6)
        cos, sin = np.cos(self._turn), np.sin(self._turn)
        turned = np.array([[cos, -sin], [sin, cos]]) @ out

        def beside(away):
            return self._center + away * (1.0 + ASIDE / length)

        total = self._end - self._start
        corners = [
            p,
            np.append(beside(out), p[2]),
            np.append(beside(out), HAND_HEIGHT),
            np.append(self._center + turned, HAND_HEIGHT),
            np.append(self._center + turned, p[2]),
        ]
        # The motion above the table takes the remaining time.
        steps = [ASIDE / HAND_SPEED, (HAND_HEIGHT - p[2]) / HAND_SPEED]
        steps = [*steps, total - 0.2 - steps[0] - 2.0 * steps[1], steps[1]]
        for k, step in enumerate(steps):
            if t < step:
                return corners[k] + (corners[k + 1] - corners[k]) * t / step
            t -= step
        return corners[-1]

    def _calc(self, context, output):
        force, t = np.zeros(self._n_v), context.get_time()
        if lasts(t, self._start, self._end):
            x = self._state.Eval(context)
            p = x[self._q : self._q + 3]
            w = x[self._n_q + self._v : self._n_q + self._v + 3]
            v = x[self._n_q + self._v + 3 : self._n_q + self._v + 6]
            taken = context.get_discrete_state(self._taken).value()
            goal = self._goal(t - self._start, taken)
            pull = HAND_RATE**2 * (goal - p) - 2.0 * HAND_RATE * v
            force[self._v : self._v + 3] = -self._spin * w
            force[self._v + 3 : self._v + 6] = self._mass * pull + self._weight
        output.SetFromVector(force)
