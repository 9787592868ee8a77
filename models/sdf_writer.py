"""A model of a Drake plant as SDF, whatever file it comes from.

A joint stands in its parent link, and a link in the joint that carries it: where all
joints are at zero, as SDF has it.
"""

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    Rgba,
    Role,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from makebreak.models.effects.inertia import central_inertia
from makebreak.models.fixed_joints import Follows


def sdf_of(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    model: str,
    joints: Sequence[Joint],
    efforts: Mapping[str, float],
    follows: Mapping[str, Follows],
) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """The text; {joint: its name there} of joints called as a link, which SDF refuses;
    and sentences of what SDF cannot say.

    Args: joints: of the model, those that are written: revolute, prismatic and welds.
        efforts: {joint: limit [N m] or [N]} of joints that something drives. follows:
        of joints that others move.
    """
    bodies = [
        plant.get_body(i)
        for i in plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    ]
    links = {body.name() for body in bodies}
    names = {j.name(): j.name() + "_joint" * (j.name() in links) for j in joints}
    root = ET.Element("sdf", {"version": "1.9", "xmlns:drake": "http://drake.mit.edu"})
    at = ET.SubElement(root, "model", name=model)
    carried_by = {joint.child_body().index(): joint for joint in joints}
    lost = []
    for body in bodies:
        link = ET.SubElement(at, "link", name=body.name())
        if joint := carried_by.get(body.index()):
            X_MB = joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
            if isinstance(joint, WeldJoint):
                X_MB = joint.X_FM() @ X_MB
            _pose(link, X_MB, names[joint.name()])
        elif body.is_floating_base_body():
            _pose(link, plant.GetDefaultFloatingBaseBodyPose(body))
        _inertial(link, body)
        if not _shapes(link, plant, inspector, body):
            lost.append(f"{body.name()} has a half space")
    for joint in joints:
        _joint(plant, joint, at, names, efforts, follows.get(joint.name()))
    ET.indent(root)
    renamed = {old: new for old, new in names.items() if old != new}
    return ET.tostring(root, encoding="unicode"), renamed, tuple(lost)


def _inertial(link: ET.Element, body: RigidBody) -> None:
    M = body.default_spatial_inertia()
    mass, com, central = M.get_mass(), np.zeros(3), np.zeros((3, 3))
    if mass > 0.0:
        com, central = M.get_com(), central_inertia(M)
    inertial = ET.SubElement(link, "inertial")
    _pose(inertial, RigidTransform(com))
    _numbers(inertial, "mass", mass)
    inertia = ET.SubElement(inertial, "inertia")
    for i, j in zip(*np.triu_indices(3), strict=True):
        _numbers(inertia, f"i{'xyz'[i]}{'xyz'[j]}", central[i, j])


def _joint(plant, joint: Joint, at: ET.Element, names, efforts, follows) -> None:
    turns, welds = isinstance(joint, RevoluteJoint), isinstance(joint, WeldJoint)
    kind = "fixed" if welds else "revolute" if turns else "prismatic"
    element = ET.SubElement(at, "joint", name=names[joint.name()], type=kind)
    in_world = joint.parent_body().index() == plant.world_body().index()
    parent, frame = joint.parent_body().name(), joint.frame_on_parent()
    X_PF = frame.GetFixedPoseInBodyFrame()
    _pose(element, X_PF, "__model__" if in_world else parent)
    ET.SubElement(element, "parent").text = "world" if in_world else parent
    ET.SubElement(element, "child").text = joint.child_body().name()
    if welds:
        return
    axis = ET.SubElement(element, "axis")
    _numbers(axis, "xyz", joint.revolute_axis() if turns else joint.translation_axis())
    limit = ET.SubElement(axis, "limit")
    for tag, value in (
        ("lower", joint.position_lower_limit()),
        ("upper", joint.position_upper_limit()),
        ("velocity", joint.velocity_upper_limit()),
        ("effort", efforts.get(joint.name(), 0.0)),
    ):
        if np.isfinite(value).all():
            _numbers(limit, tag, value)
    if follows is not None:  # For Gazebo, and for Drake.
        values = {"multiplier": follows.factor, "offset": follows.offset}
        other = names[follows.joint]
        mimic = ET.SubElement(axis, "mimic", joint=other)
        for tag, number in values.items():
            _numbers(mimic, tag, number)
        texts = {tag: repr(number) for tag, number in values.items()}
        ET.SubElement(element, "drake:mimic", {"joint": other} | texts)


def _shapes(link: ET.Element, plant: MultibodyPlant, inspector, body) -> bool:
    """Whether SDF can say all of them."""
    frame, all_said = plant.GetBodyFrameIdOrThrow(body.index()), True
    for role, tag in ((Role.kProximity, "collision"), (Role.kIllustration, "visual")):
        for k, geometry in enumerate(inspector.GetGeometries(frame, role)):
            said = _shape(inspector.GetShape(geometry))
            if said is None:
                all_said = False
                continue
            element = ET.SubElement(link, tag, name=f"{tag}_{k + 1}")
            _pose(element, inspector.GetPoseInFrame(geometry))
            ET.SubElement(element, "geometry").append(said)
            if role == Role.kProximity:
                _surface(element, inspector.GetProximityProperties(geometry))
            else:
                seen = inspector.GetIllustrationProperties(geometry)
                colour = seen.GetPropertyOrDefault("phong", "diffuse", Rgba(1, 1, 1))
                material = ET.SubElement(element, "material")
                _numbers(material, "diffuse", colour.rgba)
    return all_said


def _surface(collision: ET.Element, properties) -> None:
    """Friction for all readers, and what Drake has besides."""
    own = {
        name: properties.GetProperty("material", name)
        for name in ("point_contact_stiffness", "hunt_crossley_dissipation")
        if properties.HasProperty("material", name)
    }
    if properties.HasProperty("material", "coulomb_friction"):
        friction = properties.GetProperty("material", "coulomb_friction")
        surface = ET.SubElement(collision, "surface")
        ode = ET.SubElement(ET.SubElement(surface, "friction"), "ode")
        for tag in ("mu", "mu2"):
            _numbers(ode, tag, friction.dynamic_friction())
        if friction.static_friction() != friction.dynamic_friction():
            own["mu_dynamic"] = friction.dynamic_friction()
            own["mu_static"] = friction.static_friction()
    if own:
        element = ET.SubElement(collision, "drake:proximity_properties")
        for name, value in own.items():
            _numbers(element, f"drake:{name}", value)


def _shape(shape: Shape) -> ET.Element | None:
    """None for a half space, which is a plane in SDF that has an end."""
    if isinstance(shape, (Mesh, Convex)):
        element = ET.Element("mesh")
        ET.SubElement(element, "uri").text = f"file://{shape.source().path()}"
        _numbers(element, "scale", shape.scale3())
        if isinstance(shape, Convex):
            ET.SubElement(element, "drake:declare_convex")
        return element
    if isinstance(shape, Box):
        sizes: dict[str, Any] = {"size": shape.size()}
    elif isinstance(shape, Ellipsoid):
        sizes = {"radii": [shape.a(), shape.b(), shape.c()]}
    elif isinstance(shape, Sphere):
        sizes = {"radius": shape.radius()}
    elif isinstance(shape, (Cylinder, Capsule)):
        sizes = {"radius": shape.radius(), "length": shape.length()}
    else:
        return None
    element = ET.Element(type(shape).__name__.lower())
    for tag, value in sizes.items():
        _numbers(element, tag, value)
    return element


def _pose(at: ET.Element, X: RigidTransform, relative_to: str = "") -> None:
    _numbers(at, "pose", [*X.translation(), *RollPitchYaw(X.rotation()).vector()])
    if relative_to:
        at[-1].set("relative_to", relative_to)


def _numbers(at: ET.Element, tag: str, values) -> None:
    numbers = (np.atleast_1d(values) + 0.0).tolist()  # -0.0 is 0.0 then.
    ET.SubElement(at, tag).text = " ".join(map(repr, numbers))
