"""Effects on an object itself: size, corner radius, mass, centre of mass, inertia."""

from itertools import product
from xml.dom.minidom import Element

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    ProximityProperties,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from makebreak.models.effects.change_shape import (
    change_shape,
    keep_apart,
    not_colliding_with,
)
from makebreak.models.effects.inertia import (
    central_inertia,
    change_inertia,
    com_mix,
    inertial_signature,
    mass_mix,
)
from makebreak.models.effects.kind import (
    Effect,
    EffectKind,
    Parameter,
    Tolerance,
    find_bodies,
    find_body,
)
from makebreak.models.effects.model_text import (
    MOMENTS,
    children,
    read_inertial,
    scale_inertia,
    text,
    write_inertial,
)
from makebreak.models.effects.signature import Signature


def _scale_in_text(effect: Effect, link: Element) -> None:
    """Edits the inertia in the file; _scale_shapes changes the shapes in the plant."""
    spheres = children(link, "collision", "geometry", "sphere")
    radii = [float(text(r)) for sphere in spheres for r in children(sphere, "radius")]
    radii += [
        float(s.getAttribute("radius")) for s in spheres if s.hasAttribute("radius")
    ]
    scale_inertia(link, _scale(effect, radii))


def _scale(effect: Effect, radii: list[float]) -> float:
    """The factor of an object_size; radii [m]: of the body's collision spheres.

    Raises: ValueError if it is not given, not positive, or given twice with different
        values, or if `radius` is given for a body without one sphere.
    """
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
    if isinstance(shape, Convex):
        return Convex(shape.source(), s * shape.scale3())
    raise ValueError(
        f"effect object_size cannot scale a {type(shape).__name__}; expected a sphere, "
        "box, cylinder, capsule, ellipsoid or convex hull"
    )


def _scale_shapes(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Scales visual and collision shapes of the body about its origin."""
    inspector = scene_graph.model_inspector()
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
            change_shape(plant, scene_graph, g, _scaled_shape(shape, scale), moved)


def _size_now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict[str, float]:
    shapes = _touched(find_bodies(effect, plant)[0], plant, scene_graph)
    radii = [shape.radius() for _, shape, _ in shapes if isinstance(shape, Sphere)]
    return {"scale": 1.0, "radius": radii[0]} if len(radii) == 1 else {"scale": 1.0}


def _touched(body: RigidBody, plant: MultibodyPlant, scene_graph: SceneGraph):
    """(id, shape, pose in the body's frame) of each collision shape."""
    inspector = scene_graph.model_inspector()
    return [
        (g, inspector.GetShape(g), inspector.GetPoseInFrame(g))
        for g in plant.GetCollisionGeometriesForBody(body)
        if inspector.GetProximityProperties(g) is not None
    ]


# ----- corner_radius


def _block(effect: Effect, body: RigidBody, plant, scene_graph):
    """Half sizes (3,) [m], pose in the body's frame and corner radius [m] of a block,
    whose collision shapes are one box, or eight spheres at its corners.

    Raises: ValueError if they are neither.
    """
    shapes = _touched(body, plant, scene_graph)
    if len(shapes) == 1 and isinstance(shapes[0][1], Box):
        return shapes[0][1].size() / 2.0, shapes[0][2], 0.0
    centres = np.array([X.translation() for _, _, X in shapes])
    if len(shapes) == 8 and all(isinstance(shape, Sphere) for _, shape, _ in shapes):
        radius = shapes[0][1].radius()
        middle = centres.mean(axis=0)
        half = abs(centres - middle).mean(axis=0)
        if np.allclose(abs(centres - middle), half, atol=1e-6):
            return half + radius, RigidTransform(middle), radius
    raise ValueError(
        f"effect corner_radius at {effect.at}: expected {body.scoped_name()} to have "
        "one collision box, or eight spheres at the corners of one"
    )


def _round_corners(
    effect: Effect, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Replaces the block by eight spheres, each tangent to three faces from inside."""
    radius = effect.parameters["radius"]
    for body in find_bodies(effect, plant):
        half, X_BG, _ = _block(effect, body, plant, scene_graph)
        if not 0.0 < radius <= min(half):
            raise ValueError(
                f"effect corner_radius: radius is {radius}, expected above 0 and at "
                f"most half the block's least edge, {min(half)}"
            )
        corners = [
            RigidTransform(
                X_BG.rotation(), X_BG.multiply(np.array(sign) * (half - radius))
            )
            for sign in product((-1.0, 1.0), repeat=3)
        ]
        old = _touched(body, plant, scene_graph)
        inspector = scene_graph.model_inspector()
        properties = ProximityProperties(inspector.GetProximityProperties(old[0][0]))
        apart = not_colliding_with(scene_graph, old[0][0])
        for (g, _, _), X in zip(old, corners, strict=False):
            change_shape(plant, scene_graph, g, Sphere(radius), X)
        more = [
            plant.RegisterCollisionGeometry(
                body, X, Sphere(radius), f"{body.name()}_corner_{i}", properties
            )
            for i, X in enumerate(corners[len(old) :])
        ]
        keep_apart(scene_graph, more, apart)


def _radius_now(effect: Effect, plant: MultibodyPlant, scene_graph) -> dict[str, float]:
    _, _, radius = _block(effect, find_bodies(effect, plant)[0], plant, scene_graph)
    return {"radius": max(radius, 1e-4)}


# ----- mass, centre of mass, inertia


def _mass_in_text(effect: Effect, link: Element) -> None:
    """The moments of inertia scale with the mass: its distribution stays."""
    inertial = read_inertial(link)
    mass = effect.parameters["mass"]
    inertial.central *= mass / inertial.mass
    inertial.mass = mass
    write_inertial(link, inertial)


def _com_in_text(effect: Effect, link: Element) -> None:
    """The inertia about the centre of mass is kept."""
    inertial = read_inertial(link)
    inertial.com = _new_com(effect, inertial.com)
    write_inertial(link, inertial)


def _inertia_in_text(effect: Effect, link: Element) -> None:
    inertial = read_inertial(link)
    inertial.central = _new_central(effect, inertial.central)
    write_inertial(link, inertial)


def _new_com(effect: Effect, com) -> np.ndarray:
    return np.array([effect.parameters.get(a, com[i]) for i, a in enumerate("xyz")])


def _new_central(effect: Effect, central) -> np.ndarray:
    """Moments of inertia about the centre of mass, body axes; products are kept."""
    new = np.array(central)
    for key, at in MOMENTS.items():
        new[at] = effect.parameters.get(f"i{key}", new[at])
    return new


def _inertial_now(effect: Effect, plant: MultibodyPlant, scene_graph):
    M = find_bodies(effect, plant)[0].default_spatial_inertia()
    if effect.kind == "object_mass":
        return {"mass": M.get_mass()}
    if effect.kind == "object_com":
        return dict(zip("xyz", (float(x) for x in M.get_com()), strict=True))
    central = central_inertia(M)
    return {f"i{key}": float(central[at]) for key, at in MOMENTS.items()}


def _inertial_signature(effect: Effect, model, motion, grid=None) -> list[Signature]:
    """Linear in mass and moments of inertia; linearised in the centre of mass, as the
    inertia about the body's origin depends on its square."""
    body = find_bodies(effect, model.plant)[0]
    M = body.default_spatial_inertia()
    now = model.now(effect.kind, effect.at)
    names = list(now)
    if effect.kind == "object_mass":
        mix = mass_mix(M)
    elif effect.kind == "object_com":
        mix = com_mix(M)
    else:
        mix = np.zeros((10, 3))
        mix[4:7] = np.eye(3)

    def to_parameters(c):
        return {n: now[n] + float(x) for n, x in zip(names, c, strict=True)}

    exact = effect.kind != "object_com"
    unknowns = [f"{name}_change" for name in names]
    return [
        inertial_signature(
            effect, model, motion, body, unknowns, mix, to_parameters, exact
        )
    ]


def _some_are_given(effect: Effect) -> None:
    if not effect.parameters:
        names = (
            "`x`, `y` or `z`" if effect.kind == "object_com" else "a moment of inertia"
        )
        raise ValueError(f"effect {effect.kind} at {effect.at} needs {names}")


MASS = "object_mass"  # Whose tolerance is that of a link's mass.
KINDS = {
    # The body's mass stays (object_mass is a kind of its own): com goes with the
    # scale, inertia with its square. The body's initial pose stays as well.
    "object_size": EffectKind(
        at="free body",
        parameters=(
            Parameter("scale", "", 0.5, 2.0, 1.0, valid="> 0", optional=True),
            Parameter("radius", "m", 0.002, 0.5, None, valid="> 0", optional=True),
        ),
        says="{at} has a wrong size in the model[; it really is {scale} times as large]"
        "[; its radius really is {radius}]",
        confused_with=("plane_height", "contact_stiffness", "length_scale"),
        tell_apart="let it rest on several faces, or roll: height and rate of rolling "
        "both depend on the size",
        edit_text=_scale_in_text,
        before_finalize=_scale_shapes,
        now=_size_now,
    ),
    "corner_radius": EffectKind(
        at="free body",
        parameters=(Parameter("radius", "m", 0.0002, 0.05, None, valid="> 0"),),
        says="the corners of {at} are rounded with a radius of {radius}",
        confused_with=("object_size", "contact_dissipation", "plane_height"),
        tell_apart="touch with faces and with corners: a face rests as high as before",
        rank=1,
        before_finalize=_round_corners,
        now=_radius_now,
    ),
    "object_mass": EffectKind(
        at="body",
        parameters=(
            Parameter("mass", "kg", 0.0, 5.0, None, valid="> 0", of_size=True),
        ),
        says="{at} weighs {mass}",
        confused_with=("contact_friction", "object_inertia", "payload"),
        exported="inertia",
        tell_apart="lift it or knock it: a slow push shows friction times weight only",
        weighs=True,
        absolute=True,
        tolerance=Tolerance("link_mass", 0.03, relative=True),
        edit_text=_mass_in_text,
        set_in_context=change_inertia(
            lambda old, new, mass, com, central: (
                new.parameters["mass"],
                com,
                central * (new.parameters["mass"] / mass),
            )
        ),
        now=_inertial_now,
        signature=_inertial_signature,
    ),
    "object_com": EffectKind(
        at="body",
        parameters=tuple(
            Parameter(a, "m", -0.2, 0.2, None, optional=True) for a in "xyz"
        ),
        says="the centre of mass of {at} is at[ x = {x}][ y = {y}][ z = {z}] in its "
        "frame",
        confused_with=("object_inertia", "gravity_tilt", "joint_offset"),
        exported="inertia",
        tell_apart="let it fly and spin: the centre of mass alone moves on a parabola",
        rank=1,
        check=_some_are_given,
        weighs=True,
        absolute=True,
        tolerance=Tolerance("link_com_m", 0.002),
        edit_text=_com_in_text,
        set_in_context=change_inertia(
            lambda old, new, mass, com, central: (mass, _new_com(new, com), central)
        ),
        now=_inertial_now,
        signature=_inertial_signature,
    ),
    "object_inertia": EffectKind(
        at="body",
        parameters=tuple(
            Parameter(a, "kg m2", 0.0, 10.0, None, "> 0", optional=True, of_size=True)
            for a in ("ixx", "iyy", "izz")
        ),
        says="{at} has moments of inertia[ ixx = {ixx}][ iyy = {iyy}][ izz = {izz}] "
        "about its centre of mass",
        confused_with=("object_com", "corner_radius", "rotor_inertia"),
        exported="inertia",
        tell_apart="spin it about several axes, or let it hit in many attitudes",
        rank=1,
        check=_some_are_given,
        weighs=True,
        absolute=True,
        edit_text=_inertia_in_text,
        set_in_context=change_inertia(
            lambda old, new, mass, com, central: (
                mass,
                com,
                _new_central(new, central),
            )
        ),
        now=_inertial_now,
        signature=_inertial_signature,
    ),
}
