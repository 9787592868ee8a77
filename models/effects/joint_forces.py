"""Forces on joints that depend on the joint's own position and velocity.

One system holds all of a scene, as a call from Drake into Python costs more than the
laws.
"""

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.framework import BasicVector, LeafSystem

from makebreak.systems.numerics.joint_laws import FADES_AT, LAWS, N_NUMBERS


class JointForces(LeafSystem):
    """The sum of laws tau_j = law(q_j, v_j, t, p), each on one joint.

    Inputs:  state (n_x,) of the plant.
    Outputs: generalized_force (n_v,).

    The numbers p of all laws are numeric parameter 0 of the Context.

    Args: laws: compiled functions; joints: the one-dof joint of each law; numbers: p of
        each law, at most N_NUMBERS.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        laws: Sequence[Callable],
        joints: Sequence[Joint],
        numbers: Sequence[Sequence[float]],
    ):
        super().__init__()
        n_q, self._n_v = plant.num_positions(), plant.num_velocities()
        # (law, index of q and of v in the state, index of the force in v).
        self._laws = [
            (law, joint.position_start(), n_q + joint.velocity_start(), i_v)
            for law, joint in zip(laws, joints, strict=True)
            for i_v in [joint.velocity_start()]
        ]
        self._state = self.DeclareVectorInputPort("state", n_q + self._n_v)
        self._numbers = self.DeclareNumericParameter(BasicVector(_padded(numbers)))
        self.DeclareVectorOutputPort("generalized_force", self._n_v, self._calc)
        for law in set(laws):
            law(0.0, 0.0, 0.0, np.arange(1.0, 1.0 + N_NUMBERS))  # Compile it now.

    def set_numbers(self, context, numbers: Sequence[Sequence[float]]) -> None:
        """New numbers p of all laws, in a Context of this system."""
        context.get_mutable_numeric_parameter(self._numbers).SetFromVector(
            _padded(numbers)
        )

    def fade_below(self, root_context, times: float) -> None:
        """Dry friction fades below speeds so many times as high, until new numbers."""
        context = self.GetMyMutableContextFromRoot(root_context)
        p = context.get_mutable_numeric_parameter(self._numbers)
        for k, (law, *_) in enumerate(self._laws):
            if (at := FADES_AT.get(LAWS.index(law))) is not None:
                p[N_NUMBERS * k + at] *= times

    def _calc(self, context, output):
        x = self._state.Eval(context).tolist()
        p = np.array(context.get_numeric_parameter(self._numbers).value())
        output.SetFromVector(self.force(x, context.get_time(), p))

    def force(self, x: Sequence[float], time: float, p: np.ndarray) -> np.ndarray:
        """(n_v,) at a state [q, v]; p (4 n_laws,)."""
        tau = np.zeros(self._n_v)
        for i, (law, i_q, i_x, i_v) in enumerate(self._laws):
            tau[i_v] += law(x[i_q], x[i_x], time, p[N_NUMBERS * i :])
        return tau


def _padded(numbers) -> np.ndarray:
    flat = np.zeros((len(numbers), N_NUMBERS))
    for i, each in enumerate(numbers):
        flat[i, : len(each)] = each
    return flat.ravel()
