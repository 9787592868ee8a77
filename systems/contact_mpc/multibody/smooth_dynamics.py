"""A plant's dynamics without contact, linearised: one inverse dynamics in AutoDiff."""

from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, MultibodyForces_
from pydrake.systems.framework import Context

from makebreak.systems.contact_mpc.multibody.model_parameters import ModelParameters
from makebreak.systems.contact_mpc.numerics.rigid_body import velocity_maps


class SmoothDynamics:
    """Acceleration f(q, v, u) of a plant without contact, and the maps of v and qdot.

    Args: plant: finalized, without constraints and without actuators that have a
        controller; context: the plant's own, set by each call.

    Attributes: plain (n, 2), floating (m, 2): index in q and in v of the coordinates
        with qdot = v, and of the start of floating joints (velocity_maps).

    Raises: ValueError naming what an LCS cannot hold.
    """

    def __init__(self, plant: MultibodyPlant, context: Context):
        _check_plant(plant)
        self._plant, self._context = plant, context
        self.n_q, self.n_v = plant.num_positions(), plant.num_velocities()
        self._B_tau = plant.MakeActuationMatrix()
        self._forces = MultibodyForces(plant)
        self._plant_ad = plant.ToAutoDiffXd()
        self._context_ad = self._plant_ad.CreateDefaultContext()
        self._forces_ad = MultibodyForces_[AutoDiffXd](self._plant_ad)
        self._not_in_ad: tuple | None = None  # Parameters that its context lacks.
        self.plain, self.floating, self._maps_known = _velocity_layout(plant)

    def set_parameters(self, parameters: ModelParameters, values) -> None:
        """Sets the values (n,) of the dynamic parameters for all that follows."""
        parameters.put(self._plant, self._context, values)
        self._not_in_ad = parameters, values

    def acceleration(self, x, u, further=None) -> tuple[np.ndarray, ...]:
        """f (n_v,), M (n_v, n_v) and the damping (n_v,) of `further`, as linearise."""
        plant, context = self._plant, self._context
        plant.SetPositionsAndVelocities(context, x)
        M = plant.CalcMassMatrix(context)
        plant.CalcForceElementsContribution(context, self._forces)
        r = plant.CalcInverseDynamics(context, np.zeros(self.n_v), self._forces)
        force, damping = np.zeros((2, self.n_v)) if further is None else further(M)
        r += damping * x[self.n_q :] - force
        try:
            return np.linalg.solve(M, self._B_tau @ u - r), M, damping
        except np.linalg.LinAlgError as error:
            raise ValueError("the mass matrix is singular (a massless body)") from error

    def linearise(
        self, x: np.ndarray, u: np.ndarray, further=None
    ) -> tuple[np.ndarray, ...]:
        """f (n_v,) at x = [q, v] (n_x,) and u (n_u,), its derivatives J_q (n_v, n_q),
        J_v (n_v, n_v) and J_u (n_v, n_u), and M (n_v, n_v). Sets the context to x.

        Args: further: M -> (n_v,) forces and (n_v,) damping that the plant lacks.

        M f = tau(u) - r(q, v), so M df = dtau - d(M(q) f* + r) at the fixed f*: one
        inverse dynamics in AutoDiff, and no derivative of a factorised M.

        Raises: ValueError if the mass matrix is singular.
        """
        f, M, damping = self.acceleration(x, u, further)
        plant_ad, context_ad = self._plant_ad, self._context_ad
        if self._not_in_ad is not None:
            parameters, values = self._not_in_ad
            parameters.put(plant_ad, context_ad, values, AutoDiffXd)
            self._not_in_ad = None
        plant_ad.SetPositionsAndVelocities(context_ad, InitializeAutoDiff(x)[:, 0])
        plant_ad.CalcForceElementsContribution(context_ad, self._forces_ad)
        f_ad = np.array([AutoDiffXd(value) for value in f])
        tau = plant_ad.CalcInverseDynamics(context_ad, f_ad, self._forces_ad)
        dtau: Any = ExtractGradient(tau)  # The stubs' array shapes are wrong.
        if dtau.shape[1] == 0:  # Nothing depends on the state.
            dtau = np.zeros((self.n_v, self.n_q + self.n_v))
        dtau[:, self.n_q :] += np.diag(damping)
        J = np.linalg.solve(M, np.hstack([-dtau, self._B_tau]))
        J_q, J_v, J_u = np.split(J, [self.n_q, self.n_q + self.n_v], axis=1)
        return f, J_q, J_v, J_u, M

    def velocity_maps(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """N (n_q, n_v) with qdot = N v, and N+ (n_v, n_q) with v = N+ qdot, at q (n_q,)
        and the state of the context, which is the same."""
        if self._maps_known:
            return velocity_maps(q, self.plain, self.floating, self.n_v)
        N = self._plant.MakeVelocityToQDotMap(self._context).toarray()
        return N, self._plant.MakeQDotToVelocityMap(self._context).toarray()


def _check_plant(plant: MultibodyPlant) -> None:
    if plant.num_constraints() > 0:
        raise ValueError(
            f"the plant has {plant.num_constraints()} constraints, expected none "
            "(an LCS cannot hold them)"
        )
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        if actuator.has_controller():
            raise ValueError(
                f"actuator {actuator.name()} has a PD controller, expected none "
                "(the LCS's u is effort)"
            )


def _velocity_layout(plant: MultibodyPlant) -> tuple[np.ndarray, np.ndarray, bool]:
    """(index in q, index in v) of coordinates with qdot = v, and of the start of
    floating joints; whether these are all coordinates of the plant."""
    plain: list[tuple[int, int]] = []
    floating: list[tuple[int, int]] = []
    known = True
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        q, v = joint.position_start(), joint.velocity_start()
        if joint.type_name() == "quaternion_floating":
            floating.append((q, v))
        elif joint.type_name() in ("prismatic", "revolute"):
            plain.append((q, v))
        else:
            known = known and joint.num_velocities() == 0
    as_pairs = [np.array(p, dtype=np.int64).reshape(-1, 2) for p in (plain, floating)]
    return as_pairs[0], as_pairs[1], known
