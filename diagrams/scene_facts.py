"""Look-ups in a loaded scene."""

import numpy as np
from pydrake.geometry import SceneGraph, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointActuator

PANDA_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))  # Of models/panda.urdf.
N_JOINTS = len(PANDA_JOINTS)


def actuators_of(plant: MultibodyPlant, model: str) -> list[JointActuator]:
    """The actuators of a model, in the order of its actuation input."""
    indices = plant.GetJointActuatorIndices(plant.GetModelInstanceByName(model))
    return [plant.get_joint_actuator(index) for index in indices]


def sphere_radius(plant: MultibodyPlant, scene_graph: SceneGraph, model: str) -> float:
    """Radius [m] of the only collision sphere of the model's bodies.

    Raises: ValueError if it has none or several.
    """
    inspector = scene_graph.model_inspector()
    bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    shapes = [
        inspector.GetShape(geometry)
        for body in bodies
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(body))
    ]
    radii = [shape.radius() for shape in shapes if isinstance(shape, Sphere)]
    if len(radii) != 1:
        raise ValueError(f"{model} has {len(radii)} collision spheres, expected one")
    return radii[0]


def spheres_of(plant: MultibodyPlant, scene_graph: SceneGraph, model: str):
    """Collision spheres of a model of one body: centres (n, 3) in its frame and radii
    (n,) [m].

    Raises: ValueError if it has other shapes, or several bodies.
    """
    inspector = scene_graph.model_inspector()
    bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    if len(bodies) != 1:
        raise ValueError(f"{model} has {len(bodies)} bodies, expected one")
    centers, radii = [], []
    for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(bodies[0])):
        shape = inspector.GetShape(geometry)
        if not isinstance(shape, Sphere):
            raise ValueError(f"{model} has a shape that is no sphere")
        centers.append(inspector.GetPoseInFrame(geometry).translation())
        radii.append(shape.radius())
    return np.array(centers), np.array(radii)
