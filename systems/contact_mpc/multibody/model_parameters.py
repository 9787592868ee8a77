"""Physical parameters of an LCS's plant and contacts, and how a step depends on them.

mass              of a body [kg]; its inertia is in proportion, about its own centre
com_x, _y, _z     its centre of mass in its frame [m]
damping           of a joint [N m s/rad], or [N s/m]
coulomb           Coulomb's friction in a joint [N m], or [N]
force             constant one that acts in a joint [N m], or [N]
force_x, _y, _z   constant one that acts at a body's origin, in the world's axes [N]
friction          Coulomb's coefficient of a contact pair
rolling           lever arm of the resistance of a contact pair to rolling [m]
gap               what is added to the distances of a contact pair [m]

Coulomb's friction is set-valued at rest. In a step it is the damping that has its
force, but at most the one that stops the joint in the step: so a step from rest moves
as far as the force in it lasts, and no friction ever drives a joint. Rolling resistance
is a torque of lever arm times normal force against the rolling, and fades likewise.
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    JacobianWrtVariable,
    MultibodyForces,
    RotationalInertia_,
    SpatialInertia_,
)
from pydrake.systems.framework import Context

OF_BODIES = ("mass", "com_x", "com_y", "com_z", "force_x", "force_y", "force_z")
OF_JOINTS = ("damping", "coulomb", "force")
OF_PAIRS = ("friction", "rolling", "gap")
KINDS = (*OF_BODIES, *OF_JOINTS, *OF_PAIRS)
# Kinds whose values are positive: where the model has one, their deviation is one of
# the logarithm.
POSITIVE = ("mass", "damping", "coulomb", "friction", "rolling")
NOT_IN_PLANTS = ("coulomb", "force", "force_x", "force_y", "force_z", "rolling")


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of the model, and how well it is known.

    kind: one of KINDS. std: standard deviation of what the model says, of the logarithm
    where the model has a positive mass, damping, friction or rolling resistance (0.5:
    by a factor of 1.6), else in the kind's unit. of: name of the body or the joint.
    pairs: for friction, rolling and gap, the numbers of the contact pairs that have the
    value. drift: how much of it may be new after one second, in deviations std per
    sqrt(s). model: the model's value of a kind that Drake's plants do not have
    (coulomb, rolling, force). caution: deviations by which the value to plan with is
    below the learned one, for what a plan relies on: a push slips off a side that is
    smoother than believed, and holds on one that is rougher.
    """

    kind: str
    std: float
    of: str = ""
    pairs: list[int] = field(default_factory=list)
    drift: float = 0.0
    model: float = 0.0
    caution: float = 0.0


class ModelParameters:
    """The values of parameters in a plant's contexts, and the model's own.

    Attributes: items; names, as "mass of door"; nominal (n,), in the units above;
        is_log (n,), whether the deviation is the logarithm's; is_dynamic (n,), of
        bodies and joints.

    Raises: ValueError naming the parameter and what is wrong with it.
    """

    def __init__(self, items, plant: MultibodyPlant, context: Context, pair_friction):
        self.items, self._plant = tuple(items), plant
        self.names = [f"{p.kind} of {_of(p)}" for p in self.items]
        values = []
        known: set[tuple] = set()
        for p, name in zip(self.items, self.names, strict=True):
            _check(p, name, len(pair_friction))
            of = {(p.kind, each) for each in p.pairs or [p.of]}
            if of & known:
                raise ValueError(f"{name} came twice: {self.names}")
            known |= of
            values.append(_nominal(p, name, plant, context, pair_friction))
        self.nominal = np.array(values)
        self.is_dynamic = np.array([p.kind not in OF_PAIRS for p in self.items], bool)
        positive = np.array([p.kind in POSITIVE for p in self.items], bool)
        self.is_log = positive & (self.nominal > 0.0)
        self._forces = MultibodyForces(plant)

    def has(self, *kinds: str) -> bool:
        """Whether a parameter is of one of these kinds."""
        return any(p.kind in kinds for p in self.items)

    def __len__(self) -> int:
        return len(self.items)

    def of_pairs(self, kind: str, values, default) -> np.ndarray:
        """(n_pairs,) of the friction or the gaps: `default` with the values of this
        kind put in."""
        out = np.array(default, dtype=float)
        for p, value in zip(self.items, values, strict=True):
            if p.kind == kind:
                out[p.pairs] = value
        return out

    def put(self, plant, context, values, scalar=float) -> None:
        """Sets masses, centres and damping in a context of the plant, or of its copy
        with another scalar type."""
        bodies: dict[str, dict[str, float]] = {}
        for p, value in zip(self.items, values, strict=True):
            if p.kind == "damping":
                joint = plant.GetJointByName(p.of)
                joint.SetDampingVector(context, np.full(joint.num_velocities(), value))
            elif p.kind in OF_BODIES and p.kind not in NOT_IN_PLANTS:
                bodies.setdefault(p.of, {})[p.kind] = value
        for name, new in bodies.items():
            own = self._plant.GetBodyByName(name).default_spatial_inertia()
            own_centre, mass = own.get_com(), new.get("mass", own.get_mass())
            centre = [new.get(f"com_{k}", own_centre[i]) for i, k in enumerate("xyz")]
            about = own.Shift(own_centre).CalcRotationalInertia().CopyToFullMatrix3()
            about = about * mass / own.get_mass()
            moments, products = np.diag(about), about[[0, 0, 1], [1, 2, 2]]
            inertia = SpatialInertia_[scalar].MakeFromCentralInertia(
                scalar(mass),
                np.array([scalar(c) for c in centre]),
                RotationalInertia_[scalar](*map(scalar, (*moments, *products))),
            )
            body = plant.GetBodyByName(name)
            body.SetSpatialInertiaInBodyFrame(context, inertia)

    def further_forces(self, context: Context, values, M, dt):
        """(n_v,) forces [N, N m] and (n_v,) damping that Drake's plant does not have,
        in a step of dt [s] from the context's state, with the mass matrix M."""
        force, damping = np.zeros(len(M)), np.zeros(len(M))
        for p, value in zip(self.items, values, strict=True):
            if p.kind == "coulomb":
                i = self._velocity(p)
                speed = self._plant.GetVelocities(context)[i]
                damping[i] = _coulomb_damping(value, speed, _stops(M, i, dt))
            elif p.kind in NOT_IN_PLANTS and p.kind not in OF_PAIRS:
                force += value * self._direction(context, p)
        return force, damping

    def unknown_at_rest(self, values, std, v_now, v_next, M, dt) -> np.ndarray:
        """(n_v, n_v) covariance of a step's change of velocity by Coulomb's friction of
        joints that rest or turn round in it: anything up to its greatest force.

        Args: values, std (n,) of the parameters; v_now, v_next (n_v,) at the ends.
        """
        covariance = np.zeros((len(M), len(M)))
        for p, value, deviation in zip(self.items, values, std, strict=True):
            if p.kind == "coulomb":
                i, force = self._velocity(p), np.hypot(value, deviation)
                slow = min(v_now[i] * np.sign(v_next[i]), abs(v_next[i]))
                if slow <= force * _stops(M, i, dt):
                    change = dt * force * np.linalg.inv(M)[i]
                    covariance += np.outer(change, change)
        return covariance

    def torque_changes(self, context: Context, values, v_dot, dt) -> np.ndarray:
        """(n_v, n) how the torque of the acceleration v_dot (n_v,) at the context's
        state changes with each dynamic parameter, by one inverse dynamics each: it is
        linear in a mass and a damping, and quadratic in a centre of mass."""
        out = np.zeros((len(v_dot), len(self)))
        for i in np.flatnonzero(self.is_dynamic):
            p = self.items[i]
            if p.kind == "coulomb":
                k, M = self._velocity(p), self._plant.CalcMassMatrix(context)
                speed = self._plant.GetVelocities(context)[k]
                if abs(values[i]) * _stops(M, k, dt) < abs(speed):
                    out[k, i] = np.sign(speed)
                continue
            if p.kind in NOT_IN_PLANTS:
                out[:, i] = -self._direction(context, p)
                continue
            size = 0.5 * values[i] if self.is_log[i] else 1e-3
            changed, sides = np.array(values, dtype=float), []
            for side in (1.0, -1.0):
                changed[i] = values[i] + side * size
                self.put(self._plant, context, changed)
                sides.append(self._torque(context, v_dot))
            out[:, i] = (sides[0] - sides[1]) / (2.0 * size)
        self.put(self._plant, context, values)
        return out

    def _velocity(self, p: Parameter) -> int:
        return self._plant.GetJointByName(p.of).velocity_start()

    def _direction(self, context, p: Parameter) -> np.ndarray:
        """(n_v,) generalized force of a force of 1."""
        plant = self._plant
        if p.kind == "force":
            return np.eye(plant.num_velocities())[self._velocity(p)]
        world = plant.world_frame()
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, plant.GetBodyByName(p.of).body_frame(),
            np.zeros(3), world, world,
        )  # fmt: skip
        return J["xyz".index(p.kind[-1])]

    def _torque(self, context, v_dot):
        plant = self._plant
        plant.CalcForceElementsContribution(context, self._forces)
        return plant.CalcInverseDynamics(context, v_dot, self._forces)


def _stops(M, i: int, dt: float) -> float:
    """Speed that a force of 1 in joint i stops in a step of dt [s]."""
    return dt * np.linalg.inv(M)[i, i]


def _coulomb_damping(force: float, speed: float, stops: float) -> float:
    """Damping whose force is that of the friction `force`, or which stops the joint."""
    most = max(abs(speed), abs(force) * stops)
    return force / most if most > 0.0 else 0.0


def _of(p: Parameter) -> str:
    return f"pairs {p.pairs}" if p.kind in OF_PAIRS else p.of


def _check(p: Parameter, name: str, n_pairs: int) -> None:
    if p.kind not in KINDS:
        raise ValueError(f"{name}: unknown kind, expected one of {', '.join(KINDS)}")
    if not (np.isfinite(p.std) and p.std > 0.0):
        raise ValueError(f"{name}: std is {p.std}, expected a positive number")
    for of, value in (("drift", p.drift), ("caution", p.caution)):
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name}: {of} is {value}, expected 0 or more")
    least = 0.0 if p.kind in POSITIVE else -np.inf
    if not (np.isfinite(p.model) and p.model >= least):
        raise ValueError(f"{name}: model is {p.model}, expected 0 or more")
    if p.model and p.kind not in NOT_IN_PLANTS:
        raise ValueError(f"{name}: model is {p.model}, expected none: the plant has it")
    if p.kind in OF_PAIRS:
        if not p.pairs or not all(pair in range(n_pairs) for pair in p.pairs):
            raise ValueError(f"{name}: expected numbers of pairs, 0 to {n_pairs - 1}")
    elif p.pairs:
        raise ValueError(f"{name}: pairs is {p.pairs}, expected none")


def _nominal(p: Parameter, name: str, plant, context, pair_friction) -> float:
    if p.kind in OF_JOINTS:
        if not plant.HasJointNamed(p.of):
            known = [plant.get_joint(i).name() for i in plant.GetJointIndices()]
            raise ValueError(f"{name}: no such joint, expected one of {known}")
        n = plant.GetJointByName(p.of).num_velocities()
        if n == 0:
            raise ValueError(f"{name}: the joint does not move")
        if n > 1 and p.kind != "damping":
            raise ValueError(f"{name}: the joint has {n} velocities, expected one")
    if p.kind in OF_BODIES and not plant.HasBodyNamed(p.of):
        bodies = map(BodyIndex, range(plant.num_bodies()))
        known = [plant.get_body(i).name() for i in bodies]
        raise ValueError(f"{name}: no such body, expected one of {known}")
    if p.kind in NOT_IN_PLANTS or p.kind == "gap":
        return p.model
    if p.kind == "damping":
        return float(plant.GetJointByName(p.of).GetDampingVector(context)[0])
    if p.kind == "friction":
        different = {float(pair_friction[pair]) for pair in p.pairs}
        if len(different) != 1:
            raise ValueError(
                f"{name}: the pairs have {sorted(different)}, expected one"
            )
        value = different.pop()
    else:
        inertia = plant.GetBodyByName(p.of).default_spatial_inertia()
        if p.kind.startswith("com_"):
            return float(inertia.get_com()["xyz".index(p.kind[-1])])
        value = float(inertia.get_mass())
    if not value > 0.0:
        raise ValueError(f"{name}: the model has {value:g}, expected a positive value")
    return value
