"""Effects on a free object itself: its size."""

from xml.dom.minidom import Element

from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from makebreak.models.effects.kind import Effect, EffectKind, find_body
from makebreak.models.effects.model_text import children, scale_inertia, text


def _scale_in_text(effect: Effect, link: Element) -> None:
    spheres = children(link, "collision", "geometry", "sphere")
    radii = [float(text(r)) for sphere in spheres for r in children(sphere, "radius")]
    radii += [
        float(s.getAttribute("radius")) for s in spheres if s.hasAttribute("radius")
    ]
    scale_inertia(link, _scale(effect, radii))


def _scale(effect: Effect, radii: list[float]) -> float:
    """Radii are those of the body's collision spheres."""
    given = [name for name in ("scale", "radius") if name in effect.parameters]
    if not given:
        raise ValueError(f"effect object_size at {effect.at} needs `scale` or `radius`")
    for name in given:
        if not effect.parameters[name] > 0.0:
            raise ValueError(
                f"effect object_size: {name} is {effect.parameters[name]}, expected > 0"
            )
    if "radius" not in given:
        return effect.parameters["scale"]
    if len(radii) != 1:
        raise ValueError(
            f"effect object_size: `radius` is for a body with one collision sphere, "
            f"{effect.at} has {len(radii)}; use `scale`"
        )
    scale = effect.parameters["radius"] / radii[0]
    if "scale" in given and abs(effect.parameters["scale"] / scale - 1.0) > 1e-3:
        raise ValueError(
            f"effect object_size: scale {effect.parameters['scale']} and radius "
            f"{effect.parameters['radius']} disagree (radius now {radii[0]})"
        )
    return scale


def _scaled_shape(shape: Shape, scale: float) -> Shape:
    s = scale
    if isinstance(shape, Sphere):
        return Sphere(s * shape.radius())
    if isinstance(shape, Box):
        return Box(*(s * shape.size()))
    if isinstance(shape, (Cylinder, Capsule)):
        return type(shape)(s * shape.radius(), s * shape.length())
    if isinstance(shape, Ellipsoid):
        return Ellipsoid(s * shape.a(), s * shape.b(), s * shape.c())
    raise ValueError(
        f"effect object_size cannot scale a {type(shape).__name__}; expected a sphere, "
        "box, cylinder, capsule or ellipsoid"
    )


def _scale_shapes(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """All shapes of the body, seen and touched, about the body's origin."""
    inspector = scene_graph.model_inspector()
    source = plant.get_source_id()
    for at in effect.at:
        body = find_body(effect, plant, at)
        shapes = {
            g: (inspector.GetShape(g), inspector.GetPoseInFrame(g))
            for g in inspector.GetGeometries(plant.GetBodyFrameIdOrThrow(body.index()))
        }
        touched = plant.GetCollisionGeometriesForBody(body)
        spheres = [shapes[g][0] for g in touched if isinstance(shapes[g][0], Sphere)]
        scale = _scale(effect, [sphere.radius() for sphere in spheres])
        for g, (shape, X_BG) in shapes.items():
            moved = RigidTransform(X_BG.rotation(), scale * X_BG.translation())
            scene_graph.ChangeShape(source, g, _scaled_shape(shape, scale), moved)


KINDS = {
    # The body's mass stays (object_mass is a kind of its own): com goes with the
    # scale, inertia with its square. The body's initial pose stays as well.
    "object_size": EffectKind(
        parameters=("scale", "radius"),
        edit_text=_scale_in_text,
        before_finalize=_scale_shapes,
    ),
}
