"""Objects that are pushed over a table: their files and the planner's model of them.

The origin of an object's frame is at the centroid of its plan, half-way up; z is up. On
a table at z = 0 the origin is at z = rest_height(spec). Shapes, at scale 1:

    t         two bars of 160 x 40 mm and 40 x 120 mm; the cross bar is at +y
    l         two bars of 40 x 160 mm and 80 x 40 mm; the foot is at -y, towards +x
    box       100 x 140 mm
    disc      an upright cylinder of radius 60 mm
    cylinder  lying along x: 140 mm long; it rolls
    mesh      the convex hull of the points of a file, in the file's orientation (z up)

Drake's point contact of two boxes has one point, which jumps as they tilt. An object
therefore stands on small spheres, and its solid parts end SKIN above the table: many
spheres in a simulated world, for an almost even pressure; three in a planner's model,
placed so that their friction torque is that of an even pressure.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import numpy as np
from pydrake.geometry import Box, Convex, Cylinder, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull, QhullError

from makebreak.models.model_files import DRAKE_ERRORS
from makebreak.models.tip_and_ball import (
    UNUSED_FRICTION,
    TipAndBall,
    add_table,
    add_tip,
    check_layout,
)

UNIT = 0.04  # Width of the bars of T and L [m].
SKIN = 2e-4  # Distance of the solid parts from the table [m].
FOOT = 2e-3  # Radius of the spheres under a flat object [m].
SPACING = 0.03  # Approximate distance of these spheres in a world [m].
LINE = 0.25  # Distance of a lying cylinder's spheres from its middle, over its length.
N_ROUND = 48  # Corners of a circle in an outline.
LOWER_FACE = 1e-3  # Points of a mesh within this of the lowest one are its foot [m].
# Point contact on the object's side [N/m], [s/m]: as the ball's; the many supports are
# softer.
STIFFNESS, SUPPORT_STIFFNESS, DISSIPATION = 2e5, 2e4, 1.0
SHAPES = ("t", "box", "l", "disc", "cylinder", "mesh")
COLOR, HUE = (0.95, 0.4, 0.05), 0.41  # Of an object: diffuse colour, its hue [rad].
# Colour of a flat object below its coloured top plate; thickness of the plate [m].
BODY_COLOR, PLATE = (0.25, 0.26, 0.28), 1e-3


@dataclass
class PushedObject:
    """An object to push, as a model file is made of it."""

    # Shape of the object: t, box, l, disc, cylinder (which lies and rolls) or mesh.
    shape: Literal["t", "box", "l", "disc", "cylinder", "mesh"] = "t"
    scale: float = 1.0  # Scale of all dimensions of the object.
    mass: float = 0.4  # Mass of the object [kg].
    # Offset of the centre of mass from that of an even density, [x, y], which is not
    # scaled [m].
    com_offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    # Height of the object at scale 1, or diameter of a lying cylinder; not of a mesh
    # [m].
    height: float = 0.04
    file: str = ""  # File of the mesh (.obj, .gltf or .vtk), for shape=mesh.


class Part(NamedTuple):
    """A convex part of an object."""

    shape: Shape
    X_BS: RigidTransform  # Pose of the shape in the object's frame.
    points: np.ndarray  # (n, 3) in the object's frame; the part is their hull [m].


def check_object(spec: PushedObject) -> None:
    """Raises: ValueError that names a setting out of range."""
    if spec.shape not in SHAPES:
        raise ValueError(f"shape is {spec.shape}, expected one of {', '.join(SHAPES)}")
    for name in ("scale", "mass", "height"):
        if not 0.0 < getattr(spec, name) < np.inf:
            raise ValueError(f"{name} is {getattr(spec, name)}, expected > 0")
    offset = np.asarray(spec.com_offset, dtype=float)
    if offset.shape != (2,) or not np.isfinite(offset).all():
        raise ValueError(f"com_offset is {spec.com_offset}, expected [x, y] in metres")
    if bool(spec.file) != (spec.shape == "mesh"):
        raise ValueError(
            f"file is {spec.file!r} and shape is {spec.shape}, expected a file for a "
            "mesh, and for nothing else"
        )


def _box(size, center) -> Part:
    half, center = np.asarray(size) / 2.0, np.asarray(center, dtype=float)
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
    return Part(Box(*size), RigidTransform(center), center + signs * half)


def _cylinder(radius, length, R_BS: RotationMatrix) -> Part:
    angle = np.linspace(0.0, 2.0 * np.pi, N_ROUND, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(N_ROUND)], axis=1)
    ends = [radius * ring + [0.0, 0.0, z] for z in (-length / 2.0, length / 2.0)]
    points = np.concatenate(ends) @ R_BS.matrix().T
    return Part(Cylinder(radius, length), RigidTransform(R_BS, np.zeros(3)), points)


def _mesh(spec: PushedObject) -> Part:
    path = Path(spec.file).resolve()
    if not path.is_file():
        raise ValueError(f"file is {spec.file!r}, which is not there")
    try:
        shape = Convex(path, spec.scale)
        x, y, _ = CalcSpatialInertia(shape, 1.0).get_com()
        hull = shape.GetConvexHull()
    except DRAKE_ERRORS as error:
        first = str(error).splitlines()[0]
        raise ValueError(f"file {spec.file} holds no convex body: {first}") from error
    points = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    p_BS = -np.array([x, y, (points[:, 2].min() + points[:, 2].max()) / 2.0])
    return Part(shape, RigidTransform(p_BS), points + p_BS)


def parts(spec: PushedObject) -> list[Part]:
    """The convex parts of an object; they do not overlap.

    Raises: ValueError as check_object, or for a mesh that Drake cannot use.
    """
    check_object(spec)
    h, u = spec.scale * spec.height, spec.scale * UNIT
    match spec.shape:
        case "t":
            c = (4 * 3.5 + 3 * 1.5) / 7  # Height of the centroid over the stem's end.
            bar = _box((4 * u, u, h), (0.0, (3.5 - c) * u, 0.0))
            return [bar, _box((u, 3 * u, h), (0.0, (1.5 - c) * u, 0.0))]
        case "l":
            x, y = (4 * 0.5 + 2 * 2.0) / 6, (4 * 2.0 + 2 * 0.5) / 6  # From the corner.
            long = _box((u, 4 * u, h), ((0.5 - x) * u, (2.0 - y) * u, 0.0))
            return [long, _box((2 * u, u, h), ((2.0 - x) * u, (0.5 - y) * u, 0.0))]
        case "box":
            return [_box((2.5 * u, 3.5 * u, h), np.zeros(3))]
        case "disc":
            return [_cylinder(1.5 * u, h, RotationMatrix.Identity())]
        case "cylinder":
            along_x = RotationMatrix.MakeYRotation(np.pi / 2.0)
            return [_cylinder(h / 2.0, 3.5 * u, along_x)]
    return [_mesh(spec)]


def rest_height(spec: PushedObject) -> float:
    """Height of the object's origin above the table that it lies on [m]."""
    return -float(min(part.points[:, 2].min() for part in parts(spec)))


def object_inertia(spec: PushedObject) -> SpatialInertia:
    """Spatial inertia about the frame's origin: that of an even density with the centre
    of mass moved (the central inertia stays, as with an effect object_com)."""
    whole = parts(spec)
    M_BBo = CalcSpatialInertia(whole[0].shape, 1.0)
    M_BBo = _placed(M_BBo, whole[0].X_BS)
    for part in whole[1:]:
        M_BBo += _placed(CalcSpatialInertia(part.shape, 1.0), part.X_BS)
    p_even = M_BBo.get_com()
    central = M_BBo.Shift(p_even)
    unit = central.get_unit_inertia()
    com = p_even + np.array([*spec.com_offset, 0.0])
    return SpatialInertia(spec.mass, np.zeros(3), unit).Shift(-com)


def _placed(M_SSo: SpatialInertia, X_BS: RigidTransform) -> SpatialInertia:
    """A part's spatial inertia about the object's origin, in the object's frame."""
    return M_SSo.ReExpress(X_BS.rotation()).Shift(-X_BS.translation())


def support_spheres(spec: PushedObject, even: bool = False) -> tuple[np.ndarray, float]:
    """Spheres on which the object stands: centres (n, 3) in its frame, and radius [m].

    Args: even: many, evenly over the lower face, for a world; otherwise three with
        equal loads (if the centre of mass is over the centroid) and the friction torque
        about the vertical of an even pressure. A lying cylinder always has two of its
        own radius, for which the same holds.
    Raises: ValueError for a mesh without a flat lower face.
    """
    low = -rest_height(spec)
    if spec.shape == "cylinder":
        length = 3.5 * UNIT * spec.scale
        return np.array([[s * LINE * length, 0.0, 0.0] for s in (-1.0, 1.0)]), -low
    faces = [_lower_face(part, low) for part in parts(spec)]
    if even:
        spheres = np.concatenate([_grid(face, SPACING * spec.scale) for face in faces])
    else:
        fine = np.concatenate([_grid(face, SPACING * spec.scale / 8) for face in faces])
        r = np.hypot(*fine.T).mean()
        # Rotated so that the three are as far inside of the lower face as possible.
        turns = np.linspace(0.0, 2.0 * np.pi / 3.0, 60, endpoint=False)
        angle = turns[:, None] + np.arange(3) * 2.0 * np.pi / 3.0 - np.pi / 2.0
        triples = r * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        outside = np.min(
            [_outside(face, triples.reshape(-1, 2)).reshape(-1, 3) for face in faces],
            axis=0,
        )
        spheres = triples[int(np.argmin(np.round(outside.max(axis=1), 6)))]
    z = np.full((len(spheres), 1), low + FOOT)
    return np.hstack([spheres, z]), FOOT


def _lower_face(part: Part, low: float) -> ConvexHull:
    """The lower face of a part, seen from above. Raises: ValueError if it has none."""
    at = part.points[part.points[:, 2] < low + LOWER_FACE, :2]
    try:
        return ConvexHull(at)
    except (QhullError, ValueError) as error:
        raise ValueError(
            "the object has no flat lower face to stand on, expected one (of the "
            f"points within {1e3 * LOWER_FACE:g} mm of its lowest)"
        ) from error


def _outside(face: ConvexHull, p: np.ndarray) -> np.ndarray:
    """Distances (n,) of points (n, 2) outside of a face, negative inside [m]."""
    return (p @ face.equations[:, :2].T + face.equations[:, 2]).max(axis=1)


def _grid(face: ConvexHull, spacing: float) -> np.ndarray:
    """Midpoints (n, 2) of equal cells of a face's bounding box that are inside of the
    face."""
    axes = []
    for a, b in zip(face.points.min(axis=0), face.points.max(axis=0), strict=True):
        n = max(2, round((b - a) / spacing))
        axes.append(a + (np.arange(n) + 0.5) * (b - a) / n)
    points = np.array(np.meshgrid(*axes)).reshape(2, -1).T
    return points[_outside(face, points) <= 0.0]


def hull_obj(spec: PushedObject) -> str:
    """The convex hull of a mesh as text of a Wavefront file, in the frame and unit of
    the mesh's own file, for a copy of the object without that file.

    Raises: ValueError for another shape.
    """
    (part,) = parts(spec)
    if not isinstance(part.shape, Convex):
        raise ValueError(f"shape is {spec.shape}, expected mesh")
    hull = ConvexHull((part.points - part.X_BS.translation()) / spec.scale)
    middle = hull.points.mean(axis=0)
    lines = [f"v {_numbers(p)}" for p in hull.points]
    for face in hull.simplices:
        a, b, c = hull.points[face]
        out = np.cross(b - a, c - a) @ (a - middle) > 0.0
        lines.append("f " + " ".join(str(i + 1) for i in face[:: 1 if out else -1]))
    return "\n".join(lines) + "\n"


def object_sdf(spec: PushedObject, mesh: str = "") -> str:
    """The object in SDFormat: a model `object` with a body `object` that stands on
    evenly spread spheres.

    Args: mesh: relative path of a file with the mesh's hull (hull_obj); empty: the
        mesh's own file, by its absolute path.
    """
    M = object_inertia(spec)
    com = M.get_com()
    moments = M.Shift(com).CalcRotationalInertia().CopyToFullMatrix3()
    shapes = [_visual_text(*visual) for visual in _visuals(spec)]
    for i, part in enumerate(parts(spec)):
        shapes.append(
            _collision_text(f"part_{i}", *_above_table(part, spec), STIFFNESS)
        )
    centers, radius = support_spheres(spec, even=True)
    for i, p in enumerate(centers):
        sphere = Sphere(radius), RigidTransform(p)
        shapes.append(_collision_text(f"support_{i}", *sphere, SUPPORT_STIFFNESS))
    inertia = "".join(
        f"<i{'xyz'[i]}{'xyz'[j]}>{moments[i, j]:.9g}</i{'xyz'[i]}{'xyz'[j]}>"
        for i in range(3)
        for j in range(i, 3)
    )
    listed = "\n      ".join(shapes)
    if mesh and spec.shape == "mesh":
        listed = listed.replace(_uri(parts(spec)[0].shape), mesh)
    return (
        '<?xml version="1.0"?>\n<sdf version="1.9" xmlns:drake="drake.mit.edu">\n'
        '  <model name="object">\n    <link name="object">\n      <inertial>'
        f"<mass>{spec.mass:.9g}</mass><pose>{_numbers(com)} 0 0 0</pose>"
        f"<inertia>{inertia}</inertia></inertial>\n      {listed}\n"
        "    </link>\n  </model>\n</sdf>\n"
    )


def _visuals(spec: PushedObject):
    """(name, shape, pose, colour) of the visible shapes: a flat object has a coloured
    top on a dark body, others are coloured all over."""
    if spec.shape in ("cylinder", "mesh"):
        for i, part in enumerate(parts(spec)):
            yield f"part_{i}", part.shape, part.X_BS, COLOR
        return
    top = rest_height(spec)
    for what, low, high, color in (
        ("body", -top, top - PLATE, BODY_COLOR),
        ("top", top - PLATE, top, COLOR),
    ):
        for i, part in enumerate(_overlapping(spec)):
            middle = RigidTransform([0.0, 0.0, (low + high) / 2.0])
            if isinstance(part.shape, Box):
                w, d, _ = part.shape.size()
                shape: Shape = Box(w, d, high - low)
            else:
                shape = Cylinder(part.shape.radius(), high - low)
            yield f"{what}_{i}", shape, middle @ part.X_BS, color


def _overlapping(spec: PushedObject) -> list[Part]:
    """The parts of a flat object; those of T and L overlap, so that no seam shows."""
    made, u = parts(spec), spec.scale * UNIT
    if spec.shape not in ("t", "l"):
        return made
    w, d, h = made[1].shape.size()
    back = np.array([0.0, u / 2.0, 0.0] if spec.shape == "t" else [-u / 2.0, 0.0, 0.0])
    size = np.array([w, d, h]) + 2.0 * abs(back)
    return [made[0], _box(size, made[1].X_BS.translation() + back)]


def seen_parts(spec: PushedObject) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The object as a camera above sees it: its coloured parts (the top of a flat one)
    and all its parts, each as points (n, 3) in the object's frame whose convex hull it
    is [m]. Parts may overlap."""
    if spec.shape in ("cylinder", "mesh"):
        whole = [part.points for part in parts(spec)]
        return whole, whole
    whole = [part.points for part in _overlapping(spec)]
    return [points[points[:, 2] > 0.0] for points in whole], whole


def _above_table(part: Part, spec: PushedObject) -> tuple[Shape, RigidTransform]:
    """Shape and pose of a part that ends SKIN above the table."""
    shape, X_BS = part.shape, part.X_BS
    up = RigidTransform([0.0, 0.0, SKIN / 2.0])
    if isinstance(shape, Box):
        w, d, h = shape.size()
        return Box(w, d, h - SKIN), up @ X_BS
    if isinstance(shape, Cylinder) and spec.shape == "cylinder":
        return Cylinder(shape.radius() - SKIN, shape.length()), X_BS
    if isinstance(shape, Cylinder):
        return Cylinder(shape.radius(), shape.length() - SKIN), up @ X_BS
    return shape, up @ up @ X_BS


def _numbers(values) -> str:
    return " ".join(f"{x + 0.0:.9g}" for x in np.round(values, 12))


def _placed_text(shape: Shape, X_BS: RigidTransform) -> str:
    if isinstance(shape, Box):
        geometry = f"<box><size>{_numbers(shape.size())}</size></box>"
    elif isinstance(shape, Sphere):
        geometry = f"<sphere><radius>{shape.radius():.9g}</radius></sphere>"
    elif isinstance(shape, Cylinder):
        geometry = (
            f"<cylinder><radius>{shape.radius():.9g}</radius>"
            f"<length>{shape.length():.9g}</length></cylinder>"
        )
    elif isinstance(shape, Convex):
        geometry = (
            f"<mesh><uri>{_uri(shape)}</uri>"
            f"<scale>{_numbers(shape.scale3())}</scale><drake:declare_convex/></mesh>"
        )
    else:
        raise TypeError(f"no text for a {type(shape).__name__}")
    turned = _numbers(RollPitchYaw(X_BS.rotation()).vector())
    pose = f"<pose>{_numbers(X_BS.translation())} {turned}</pose>"
    return f"{pose}<geometry>{geometry}</geometry>"


def _uri(shape: Convex) -> str:
    return f"file://{shape.source().path()}"


def _visual_text(name: str, shape: Shape, X_BS: RigidTransform, color) -> str:
    return (
        f'<visual name="{name}">{_placed_text(shape, X_BS)}<material><diffuse>'
        f"{' '.join(map(str, color))} 1</diffuse></material></visual>"
    )


def _collision_text(
    name: str, shape: Shape, X_BS: RigidTransform, stiffness: float
) -> str:
    return (
        f'<collision name="{name}">{_placed_text(shape, X_BS)}'
        "<drake:proximity_properties><drake:mu_static>1</drake:mu_static>"
        "<drake:mu_dynamic>1</drake:mu_dynamic>"
        f"<drake:point_contact_stiffness>{stiffness:g}</drake:point_contact_stiffness>"
        f"<drake:hunt_crossley_dissipation>{DISSIPATION:g}"
        "</drake:hunt_crossley_dissipation></drake:proximity_properties></collision>"
    )


@cache
def _folder() -> TemporaryDirectory:
    return TemporaryDirectory(prefix="makebreak-object-")


def object_file(spec: PushedObject) -> str:
    """Path of a temporary file of object_sdf, deleted when this process ends."""
    text = object_sdf(spec)
    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = Path(_folder().name) / f"{spec.shape}-{name}.sdf"
    if not path.exists():
        path.write_text(text)
    return str(path)


def make_tip_and_object(
    spec: PushedObject,
    tip: TipAndBall | None = None,
    steady: float = 0.0,
    weight: float = 1.0,
):
    """The planner's model of an arm that pushes an object: a point mass and a free body
    on a table, as make_tip_and_ball for a ball.

    Args: tip: only its tip_mass [kg] and tip_radius [m] are used; steady: radius of
        gyration that is added about the horizontal axes, against tilting [m]; weight:
        factor of the object's weight, not of its mass.
    Returns: (diagram, plant, scene_graph) with the bodies `tip`, a sphere; `object`,
        with collision geometries object::part_i, its convex parts, and
        object::support_i, the spheres that it stands on; and `table`, a wide box with
        its top at z = 0. u (3,) is the force on the tip [N], which has no weight (the
        arm carries it). The state is that of contact_mpc/numerics/ball_state.py, with
        the object in place of the ball.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_tip(plant, TipAndBall() if tip is None else tip)
    gravity = plant.mutable_gravity_field()
    gravity.set_gravity_vector(weight * gravity.gravity_vector())
    inertia = object_inertia(spec)
    unit = inertia.get_unit_inertia()
    moments = unit.get_moments() + steady**2 * np.array([1.0, 1.0, 0.0])
    inertia = SpatialInertia(
        spec.mass, inertia.get_com(), UnitInertia(*moments, *unit.get_products())
    )
    body = plant.AddRigidBody("object", plant.AddModelInstance("object"), inertia)
    shapes = {f"part_{i}": _above_table(p, spec) for i, p in enumerate(parts(spec))}
    centers, radius = support_spheres(spec)
    for i, p in enumerate(centers):
        shapes[f"support_{i}"] = Sphere(radius), RigidTransform(p)
    for name, (shape, X_BS) in shapes.items():
        plant.RegisterCollisionGeometry(body, X_BS, shape, name, UNUSED_FRICTION)
    add_table(plant)
    plant.Finalize()
    check_layout(plant, body)
    return builder.Build(), plant, scene_graph
