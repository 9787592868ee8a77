"""What can be read off a loaded scene."""

from pydrake.geometry import SceneGraph, Sphere
from pydrake.multibody.plant import MultibodyPlant


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
