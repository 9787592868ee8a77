"""Physical parameters of an LCS's plant and contacts, and how a step depends on them.

mass              of a body [kg]; its inertia is in proportion, about its own centre
com_x, _y, _z     its centre of mass in its frame [m]
damping           of a joint [N m s/rad], or [N s/m]
friction          Coulomb's coefficient of a contact pair
gap               what is added to the distances of a contact pair [m]
"""

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    MultibodyForces,
    RotationalInertia_,
    SpatialInertia_,
)
from pydrake.systems.framework import Context

KINDS = ("mass", "com_x", "com_y", "com_z", "damping", "friction", "gap")
OF_PAIRS = ("friction", "gap")
# Kinds whose values are positive: their deviation is one of the logarithm.
POSITIVE = ("mass", "damping", "friction")


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of the model, and how well it is known.

    kind: one of KINDS. std: standard deviation of what the model says, of the logarithm
    for mass, damping and friction (0.5: by a factor of 1.6), else [m]. of: name of the
    body or the joint. pairs: for friction and gap, the numbers of the contact pairs
    that have the value. drift: how much of it may be new after one second, in
    deviations std per sqrt(s).
    """

    kind: str
    std: float
    of: str = ""
    pairs: list[int] = field(default_factory=list)
    drift: float = 0.0


class ModelParameters:
    """The values of parameters in a plant's contexts, and the model's own.

    Attributes: items; names, as "mass of door"; nominal (n,), in the units above.

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
        self._forces = MultibodyForces(plant)

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
            elif p.kind not in OF_PAIRS:
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

    def torque_changes(self, context: Context, values, v_dot) -> np.ndarray:
        """(n_v, n) how the torque of the acceleration v_dot (n_v,) at the context's
        state changes with each dynamic parameter, by one inverse dynamics each: it is
        linear in a mass and a damping, and quadratic in a centre of mass."""
        out = np.zeros((len(v_dot), len(self)))
        for i in np.flatnonzero(self.is_dynamic):
            size = 1e-3 if self.items[i].kind.startswith("com_") else 0.5 * values[i]
            changed, sides = np.array(values, dtype=float), []
            for side in (1.0, -1.0):
                changed[i] = values[i] + side * size
                self.put(self._plant, context, changed)
                sides.append(self._torque(context, v_dot))
            out[:, i] = (sides[0] - sides[1]) / (2.0 * size)
        self.put(self._plant, context, values)
        return out

    def _torque(self, context, v_dot):
        plant = self._plant
        plant.CalcForceElementsContribution(context, self._forces)
        return plant.CalcInverseDynamics(context, v_dot, self._forces)


def _of(p: Parameter) -> str:
    return f"pairs {p.pairs}" if p.kind in OF_PAIRS else p.of


def _check(p: Parameter, name: str, n_pairs: int) -> None:
    if p.kind not in KINDS:
        raise ValueError(f"{name}: unknown kind, expected one of {', '.join(KINDS)}")
    if not (np.isfinite(p.std) and p.std > 0.0):
        raise ValueError(f"{name}: std is {p.std}, expected a positive number")
    if not (np.isfinite(p.drift) and p.drift >= 0.0):
        raise ValueError(f"{name}: drift is {p.drift}, expected 0 or more")
    if p.kind in OF_PAIRS:
        if not p.pairs or not all(pair in range(n_pairs) for pair in p.pairs):
            raise ValueError(f"{name}: expected numbers of pairs, 0 to {n_pairs - 1}")
    elif p.pairs:
        raise ValueError(f"{name}: pairs is {p.pairs}, expected none")


def _nominal(p: Parameter, name: str, plant, context, pair_friction) -> float:
    if p.kind == "gap":
        return 0.0
    if p.kind == "friction":
        different = {float(pair_friction[pair]) for pair in p.pairs}
        if len(different) != 1:
            raise ValueError(
                f"{name}: the pairs have {sorted(different)}, expected one"
            )
        value = different.pop()
    elif p.kind == "damping":
        if not plant.HasJointNamed(p.of):
            known = [plant.get_joint(i).name() for i in plant.GetJointIndices()]
            raise ValueError(f"{name}: no such joint, expected one of {known}")
        vector = plant.GetJointByName(p.of).GetDampingVector(context)
        if vector.size == 0:
            raise ValueError(f"{name}: the joint does not move")
        value = float(vector[0])
    else:
        if not plant.HasBodyNamed(p.of):
            bodies = map(BodyIndex, range(plant.num_bodies()))
            known = [plant.get_body(i).name() for i in bodies]
            raise ValueError(f"{name}: no such body, expected one of {known}")
        inertia = plant.GetBodyByName(p.of).default_spatial_inertia()
        if p.kind.startswith("com_"):
            return float(inertia.get_com()["xyz".index(p.kind[-1])])
        value = float(inertia.get_mass())
    if not value > 0.0:
        raise ValueError(f"{name}: the model has {value:g}, expected a positive value")
    return value
