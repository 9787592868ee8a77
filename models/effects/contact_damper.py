"""A linear damper in the contact of two bodies, instead of Drake's damping."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import QueryObject
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, RigidBody
from pydrake.systems.framework import BasicVector, Context, LeafSystem

STICTION = 1e-3  # Below this speed friction fades, as Drake's does [m/s].


class ContactDamper(LeafSystem):
    """Linear damping of the contact of two bodies: damping times the rate of
    penetration, with the friction of this normal force. Drake's contact gives the
    spring with its friction; spring and damper together never pull.

    In a discrete plant the force is explicit in time, and bounded to what stops the two
    bodies within a step: more would throw them apart.

    Inputs:  state (n_x,) of the plant; query (abstract) of the scene graph.
    Outputs: generalized_force (n_v,).

    Args: plant; pair: the bodies; stiffness [N/m], damping [N s/m], friction: of their
        contact.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        pair: tuple[RigidBody, RigidBody],
        stiffness: float,
        damping: float,
        friction: float,
    ):
        super().__init__()
        self._plant, self._scratch = plant, plant.CreateDefaultContext()
        self._stiffness, self._damping = float(stiffness), float(damping)
        self._friction, self._dt = float(friction), plant.time_step()
        self._of = {
            geometry: body
            for body in pair
            for geometry in plant.GetCollisionGeometriesForBody(body)
        }
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._query = self.DeclareAbstractInputPort(
            "query", AbstractValue.Make(QueryObject())
        )
        self.DeclareVectorOutputPort(
            "generalized_force", plant.num_velocities(), self._calc
        )

    def _calc(self, context: Context, output: BasicVector):
        plant, own = self._plant, self._scratch
        total, of = np.zeros(plant.num_velocities()), self._of
        touches = [
            touch
            for touch in self._query.Eval(context).ComputePointPairPenetration()
            if touch.id_A in of
            and touch.id_B in of
            and of[touch.id_A].index() != of[touch.id_B].index()
        ]
        if not touches:
            output.SetFromVector(total)
            return
        x = self._state.Eval(context)
        plant.SetPositionsAndVelocities(own, x)
        M = plant.CalcMassMatrix(own) if self._dt > 0.0 else None
        for touch in touches:
            a, b, n = of[touch.id_A], of[touch.id_B], touch.nhat_BA_W
            middle = (touch.p_WCa + touch.p_WCb) / 2.0
            # Of the point of A relative to B: velocity of sliding and separation.
            J = plant.CalcJacobianTranslationalVelocity(
                own,
                JacobianWrtVariable.kV,
                a.body_frame(),
                plant.EvalBodyPoseInWorld(own, a).inverse() @ middle,
                b.body_frame(),
                plant.world_frame(),
            )
            v = J @ x[plant.num_positions() :]
            damping = self._damping
            if M is not None:
                along = J.T @ n
                ease = float(along @ np.linalg.solve(M, along))
                damping = min(damping, 1.0 / (self._dt * max(ease, 1e-12)))
            force = max(-damping * (n @ v), -self._stiffness * touch.depth)
            slip = v - (n @ v) * n
            speed = max(float(np.sqrt(slip @ slip)), STICTION)
            total += J.T @ (force * (n - self._friction / speed * slip))
        output.SetFromVector(total)
