"""One system for all forces on bodies that depend on velocity and time."""

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import BasicVector, LeafSystem

from makebreak.systems.numerics.body_laws import N_NUMBERS


class BodyForces(LeafSystem):
    """Laws F = law(V_WB, t, p), each a spatial force on one body at its origin.

    Inputs:  body_spatial_velocities of the plant (abstract).
    Outputs: spatial_forces (list[ExternallyAppliedSpatialForce]).

    The numbers p of all laws are numeric parameter 0 of the Context.

    Args: laws: compiled functions (V_WB (6,), t, p, F (6,)) that add to F, torque
        first, world axes; bodies: the body of each; numbers: p of each, up to eight.
    """

    def __init__(
        self,
        laws: Sequence[Callable],
        bodies: Sequence[RigidBody],
        numbers: Sequence[Sequence[float]],
    ):
        super().__init__()
        self._laws = list(zip(laws, [body.index() for body in bodies], strict=True))
        self._velocities = self.DeclareAbstractInputPort(
            "body_spatial_velocities", AbstractValue.Make([SpatialVelocity.Zero()])
        )
        self._numbers = self.DeclareNumericParameter(BasicVector(_padded(numbers)))
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc,
        )
        for law in set(laws):
            law(np.zeros(6), 0.0, np.ones(N_NUMBERS), np.zeros(6))  # Compiles it.

    def set_numbers(self, context, numbers: Sequence[Sequence[float]]) -> None:
        """Sets the numbers p of all laws in a Context of this system."""
        context.get_mutable_numeric_parameter(self._numbers).SetFromVector(
            _padded(numbers)
        )

    def _calc(self, context, output):
        velocities = self._velocities.Eval(context)
        p = np.array(context.get_numeric_parameter(self._numbers).value())
        time, forces = context.get_time(), []
        for i, (law, index) in enumerate(self._laws):
            F = np.zeros(6)
            V_WB = np.array(velocities[index].get_coeffs())
            law(V_WB, time, p[N_NUMBERS * i :], F)
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = index
            applied.p_BoBq_B = np.zeros(3)
            applied.F_Bq_W = SpatialForce(F)
            forces.append(applied)
        output.set_value(forces)


def _padded(numbers) -> np.ndarray:
    flat = np.zeros((len(numbers), N_NUMBERS))
    for i, each in enumerate(numbers):
        flat[i, : len(each)] = each
    return flat.ravel()
