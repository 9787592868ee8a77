"""How large a scene is: the unit in which the catalogue says what robots can have.

No number of newton metres is right for a hand of 0.1 kg and for an arm of 130 kg. What
a scene's bodies weigh, how far they reach and gravity give a size for every unit, as
dimensional analysis says: M g L [N m] would hold all of the robot, stretched out, at
one joint; M g L sqrt(L / g) [N m s/rad] takes that at the speed sqrt(g / L) at which it
falls.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, PrismaticJoint, RigidBody

from makebreak.models.effects.kind import (
    Parameter,
    full_name,
    model_of,
    one_dof_joints,
    unit_at,
)

_G = 9.81  # [m/s2] on Earth, also of a scene in which gravity is balanced.
# Powers of mass, length and acceleration in a unit.
_POWERS = {
    "kg": (1.0, 0.0, 0.0),
    "kg m2": (1.0, 2.0, 0.0),
    "N": (1.0, 0.0, 1.0),
    "N m": (1.0, 1.0, 1.0),
    "N/m": (1.0, -1.0, 1.0),
    "N m/rad": (1.0, 1.0, 1.0),
    "N s/m": (1.0, -0.5, 0.5),
    "N m s/rad": (1.0, 1.5, 0.5),
    "N s2/m2": (1.0, -1.0, 0.0),
    "N m s2/rad2": (1.0, 2.0, 0.0),
}


@dataclass(frozen=True)
class Sizes:
    """mass [kg] of all bodies, and of what is as heavy to move as the heaviest rotor;
    length [m] of the longest chain of those that move; slides: joints that slide, and
    models all joints of which do."""

    mass: float
    length: float
    slides: frozenset[str] = frozenset()

    def of(self, unit: str) -> float:
        """The size of what has a unit. Raises: KeyError for one that has none here."""
        mass, length, g = _POWERS[unit]
        return float(self.mass**mass * self.length**length * _G**g)


def sizes_of(plant: MultibodyPlant) -> Sizes:
    """Those of a scene's plant; what stands or is welded counts, as drives of a robot
    that is held carry all of it otherwise."""
    context = plant.CreateDefaultContext()
    carriers = {
        j.child_body().index(): j.parent_body()
        for j in map(plant.get_joint, plant.GetJointIndices())
    }
    mass, length = 0.0, 0.0
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        M = body.default_spatial_inertia()
        if not 0.0 < M.get_mass() < np.inf:  # The world, or a frame without mass.
            continue
        mass += M.get_mass()
        if plant.IsAnchored(body):
            continue
        about = np.trace(M.get_unit_inertia().CopyToFullMatrix3())
        # Of any axis through the origin, this root is no less than what lies off it.
        reach, at = np.sqrt(max(about, 0.0) / 2.0), body
        while (carrier := carriers.get(at.index())) and not plant.IsAnchored(carrier):
            reach, at = reach + _between(plant, context, carrier, at), carrier
        length = max(length, float(reach))
    joints = one_dof_joints(plant)
    if length > 0.0:
        mass += max(_rotors(plant, length), default=0.0)
    sliding = {j.index() for j in joints if isinstance(j, PrismaticJoint)}
    turning = {model_of(plant, j) for j in joints if j.index() not in sliding}
    slides = {full_name(plant, j) for j in joints if j.index() in sliding}
    models = {model_of(plant, j) for j in joints} - turning
    return Sizes(mass, length, frozenset(slides | models))


def _rotors(plant: MultibodyPlant, length: float) -> Iterator[float]:
    """[kg] at this distance [m] that would be as heavy to move as each rotor."""
    for i in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(i)
        slides = isinstance(actuator.joint(), PrismaticJoint)
        yield actuator.default_reflected_inertia() / (1.0 if slides else length**2)


def _between(plant, context, one: RigidBody, other: RigidBody) -> float:
    """Distance of two bodies' origins [m]; a joint that turns does not change it."""
    X = (plant.EvalBodyPoseInWorld(context, body) for body in (one, other))
    a, b = (each.translation() for each in X)
    return float(np.linalg.norm(a - b))


def range_of(
    parameter: Parameter, at: list[str], sizes: Sizes | None
) -> tuple[float, float]:
    """In SI, of a parameter at a place; boundless where a size is not known."""
    if not parameter.of_size:
        return parameter.low, parameter.high
    if sizes is None or not (sizes.mass > 0.0 and sizes.length > 0.0):
        return -np.inf, np.inf
    slides = bool(at) and sizes.slides.issuperset(at)
    size = sizes.of(unit_at(parameter.unit, slides))
    return parameter.low * size, parameter.high * size
