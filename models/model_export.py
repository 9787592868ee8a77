"""Exports a scene's mechanism with its effects as URDF, SDF, MJCF or drives of Isaac
Lab.

The first three have inertias, damping, Coulomb friction (which Drake's parser ignores)
and rotor inertias. Effects that a format cannot express are listed in `omitted`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from xml.dom import expatbuilder, minidom
from xml.etree import ElementTree as ET

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.drives import law_of
from makebreak.models.effects import KINDS
from makebreak.models.effects.inertia import central_inertia
from makebreak.models.effects.kind import (
    PAYLOAD_ON,
    Effect,
    actuator_of,
    find_joints,
    full_name,
    is_added,
    model_of,
    one_dof_joints,
    sentence,
)
from makebreak.models.effects.model_text import (
    Inertial,
    children,
    make_mesh_paths_absolute,
    set_text,
    write_inertial,
)
from makebreak.models.fixed_joints import followers_in
from makebreak.models.model_files import robot_files
from makebreak.models.robot_file import RobotFile
from makebreak.models.scene import LoadedScene, Scene, load_scene
from makebreak.models.scene_schema import COMMANDS_OF
from makebreak.models.sdf_writer import sdf_of


@dataclass(frozen=True)
class Exported:
    """Text of a model file, and sentences of the effects that it cannot express."""

    text: str
    omitted: tuple[str, ...]


def to_mjcf(scene: Scene) -> Exported:
    """The joints, inertias, motors and servos of a scene as MJCF, without shapes, so
    without contact.

    Raises: ValueError for joints other than revolute, prismatic, fixed and free.
    """
    loaded = _load(scene)
    plant = loaded.plant
    root = ET.Element("mujoco", model="makebreak")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = plant.gravity_field().gravity_vector()
    # An integrator that is implicit in damping, with the step of a robot's controller.
    ET.SubElement(
        root, "option", timestep="0.001", integrator="implicitfast",
        gravity=_numbers(gravity),
    )  # fmt: skip
    world = ET.SubElement(root, "worldbody")
    elements = {plant.world_body().index(): world}
    payloads = payloads_of(plant)
    motors = ET.Element("actuator")
    joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
    todo = [j for j in joints if not is_added(model_of(plant, j.child_body()))]
    while todo:
        ready = [j for j in todo if j.parent_body().index() in elements]
        if not ready:
            raise ValueError("the scene's joints form a loop, which MJCF cannot say so")
        for joint in ready:
            body = joint.child_body()
            is_free = body.is_floating_base_body()
            name = full_name(plant, body)
            attributes = {"name": name, **_at(_pose(joint, is_free))}
            parent = elements[joint.parent_body().index()]
            at = ET.SubElement(parent, "body", attributes)
            elements[body.index()] = at
            inertial = inertial_of(body, payloads)
            if inertial.mass > 0.0:
                six = inertial.central[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
                ET.SubElement(
                    at, "inertial", pos=_numbers(inertial.com),
                    mass=repr(inertial.mass), fullinertia=_numbers(six),
                )  # fmt: skip
            if is_free:
                ET.SubElement(at, "freejoint", name=name)
            elif not isinstance(joint, WeldJoint):
                _mjcf_joint(loaded, joint, at, motors)
        todo = [j for j in todo if j.child_body().index() not in elements]
    if len(motors):
        root.append(motors)
    ET.indent(root)
    free = [full_name(plant, plant.get_body(i)) for i in plant.GetFloatingBaseBodies()]
    stands = tuple(f"motion of joint {name}" for name in scene.fixed_joints)
    if free:
        stands += (f"shapes, so nothing holds {', '.join(sorted(free))}",)
    text = ET.tostring(root, encoding="unicode") + "\n"
    return Exported(text, unsaid(scene.effects) + stands)


def to_urdf(scene: Scene, model: str) -> Exported:
    """The model's own URDF with its inertias, damping, friction and rotors.

    Raises: ValueError if the model comes from no URDF.
    """
    file = robot_files(scene).get(model)
    if file is None or file.suffix != ".urdf":
        raise ValueError(f"{model!r} comes from no URDF, so none can be written of it")
    return _with_numbers(scene, model, file, _own_text(file))


def to_sdf(scene: Scene, model: str) -> Exported:
    """As to_urdf: the model's own SDF, or one that is made of its URDF or MJCF.

    Raises: ValueError if the model comes from none of these.
    """
    file = robot_files(scene).get(model)
    if file is None:
        raise ValueError(f"{model!r} comes from no URDF, SDF or MJCF")
    # What the file lets move, as a gripper's fingers, moves in what is written.
    scene = replace(scene, fixed_joints={})
    if file.suffix == ".sdf":
        return _with_numbers(scene, model, file, _own_text(file))
    shapes = replace(scene.plant, shapes=True)
    plain = _load(replace(scene, effects=[], plant=shapes))
    plant = plain.plant
    instance = plant.GetModelInstanceByName(model)
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    joints = [j for j in joints if not j.child_body().is_floating_base_body()]
    welded = {
        each.add_weld.child.partition("::")[0]
        for each in scene.directives
        if each.add_weld is not None
    }
    if model in welded:  # That is for the directive to say.
        joints = [j for j in joints if j.parent_body().model_instance() == instance]
    efforts = {name: drive.limit for name, drive in file.drives.items()}
    efforts |= dict(file.limits)
    for joint in joints:
        own = actuator_of(plant, joint)
        if own is not None:
            efforts.setdefault(joint.name(), float(own.effort_limit()))
    text, renamed, lost = sdf_of(
        plant, plain.scene_graph.model_inspector(), model, joints, efforts,
        followers_in(file.text),
    )  # fmt: skip
    made = _with_numbers(scene, model, file, text.encode(), renamed)
    lost += tuple(
        f"joint {old} is called {new}, as a link has its name"
        for old, new in renamed.items()
    )
    return Exported(made.text, lost + made.omitted)


def _own_text(file: RobotFile) -> bytes:
    """As its author wrote it, where that is no xacro."""
    is_plain = file.path.suffix.lower() == file.suffix
    return file.path.read_bytes() if is_plain else file.text.encode()


def _with_numbers(
    scene: Scene,
    model: str,
    file: RobotFile,
    text: bytes,
    renamed: Mapping[str, str] = MappingProxyType({}),
) -> Exported:
    """A model's URDF or SDF with the inertias, damping, friction and rotors that it has
    in the scene. renamed: {joint: its name in the text}, where that is another."""
    loaded = _load(scene)
    plant = loaded.plant
    # Keeps prefixes such as drake: as they are, and known without a declaration.
    document = expatbuilder.parseString(text, namespaces=False)
    instance = plant.GetModelInstanceByName(model)
    payloads = payloads_of(plant)
    for link in document.getElementsByTagName("link"):
        if not link.hasAttribute("name"):
            continue
        body = plant.GetBodyByName(link.getAttribute("name"), instance)
        inertial = inertial_of(body, payloads)
        if not children(link, "inertial"):
            if inertial.mass == 0.0:
                continue
            own = link.appendChild(document.createElement("inertial"))
            mass = own.appendChild(document.createElement("mass"))
            inertia = own.appendChild(document.createElement("inertia"))
            if document.getElementsByTagName("robot"):
                mass.setAttribute("value", "0")
            else:
                inertia.appendChild(document.createElement("ixx"))
        write_inertial(link, inertial)
    omitted = list(unsaid(scene.effects))
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        if isinstance(joint, (RevoluteJoint, PrismaticJoint)):
            there = renamed.get(joint.name(), joint.name())
            omitted += _file_joint(loaded, joint, document, there)
    make_mesh_paths_absolute(document, file.path.parent)
    return Exported(document.toxml() + "\n", tuple(omitted))


def formats_of(scene: Scene) -> list[str]:
    """Of urdf, sdf and mjcf those in which the scene's mechanism can be written."""
    try:
        _load(scene)
    except ValueError:  # It has other joints.
        return []
    files = robot_files(scene).values()
    is_urdf = any(file.suffix == ".urdf" for file in files)
    return ["urdf"] * is_urdf + ["sdf"] * bool(files) + ["mjcf"]


def _load(scene: Scene) -> LoadedScene:
    loaded = load_scene(scene, DiagramBuilder())
    plant = loaded.plant
    others = [
        full_name(plant, joint)
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if not isinstance(joint, (RevoluteJoint, PrismaticJoint, WeldJoint))
        and not joint.child_body().is_floating_base_body()
    ]
    if others:
        raise ValueError(
            f"{', '.join(others)}: only joints that turn or slide, and bodies that "
            "move freely, are written as URDF, SDF and MJCF"
        )
    return loaded


def payloads_of(plant: MultibodyPlant) -> dict[int, list[RigidBody]]:
    """{index of a body: the payloads that are welded to it}."""
    found: dict[int, list[RigidBody]] = {}
    for joint in (plant.get_joint(i) for i in plant.GetJointIndices()):
        body = joint.child_body()
        if model_of(plant, body).startswith(PAYLOAD_ON):
            found.setdefault(int(joint.parent_body().index()), []).append(body)
    return found


def inertial_of(body: RigidBody, payloads) -> Inertial:
    """Inertial properties of a body with its payloads, which have the body's axes."""
    M = body.default_spatial_inertia()
    mass, moment = M.get_mass(), M.get_mass() * M.get_com()
    about = M.CalcRotationalInertia().CopyToFullMatrix3()
    for each in payloads.get(int(body.index()), []):
        more = each.default_spatial_inertia()
        mass += more.get_mass()
        moment = moment + more.get_mass() * more.get_com()
        about = about + more.CalcRotationalInertia().CopyToFullMatrix3()
    if not mass > 0.0:
        return Inertial(0.0, np.zeros(3), np.zeros((3, 3)))
    if not payloads.get(int(body.index())):
        return Inertial(mass, M.get_com(), central_inertia(M))
    com = moment / mass
    return Inertial(
        mass, com, about - mass * (com @ com * np.eye(3) - np.outer(com, com))
    )


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in values)


def _pose(joint: Joint, is_free: bool) -> RigidTransform:
    """Pose of the child in its parent at the joint's zero; of a free one where it
    starts."""
    if is_free:
        body = joint.child_body()
        return body.GetParentPlant().GetDefaultFloatingBaseBodyPose(body)
    X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    X_PM = X_PF @ joint.X_FM() if isinstance(joint, WeldJoint) else X_PF
    return X_PM @ X_BM.inverse()


def _at(X: RigidTransform) -> dict[str, str]:
    """A pose as MJCF attributes."""
    quat = X.rotation().ToQuaternion().wxyz()
    return {"pos": _numbers(X.translation()), "quat": _numbers(quat)}


def _mjcf_joint(loaded: LoadedScene, joint: Joint, body, motors) -> None:
    name = full_name(loaded.plant, joint)
    turns = isinstance(joint, RevoluteJoint)
    axis = joint.revolute_axis() if turns else joint.translation_axis()
    X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    drive = joint_numbers(loaded, joint)
    attributes = {
        "name": name,
        "type": "hinge" if turns else "slide",
        "pos": _numbers(X_BM.translation()),
        "axis": _numbers(X_BM.rotation() @ axis),
        "damping": repr(drive.damping),
        "frictionloss": repr(drive.friction),
        "armature": repr(drive.armature),
    }
    low, high = joint.position_lower_limit(), joint.position_upper_limit()
    if np.isfinite([low, high]).all():
        attributes["range"] = _numbers([low, high])
    element = ET.SubElement(body, "joint", attributes)
    if not drive.is_driven:
        return
    on, span = {"name": name, "joint": name}, _numbers([-drive.limit, drive.limit])
    is_limited = np.isfinite(drive.limit)
    if not drive.takes:
        limit = {"ctrlrange": span} if is_limited else {}
        ET.SubElement(motors, "motor", on | limit)
        return
    if len(drive.takes) == 2:  # A second actuator adds kd times the commanded velocity.
        ET.SubElement(
            motors, "position", on | {"kp": repr(drive.kp), "kv": repr(drive.kd)}
        )
        speed = {"name": f"{name}.velocity", "joint": name, "gear": repr(drive.kd)}
        ET.SubElement(motors, "motor", speed)
        if is_limited:  # Of both together.
            element.set("actuatorfrcrange", span)
        return
    limit = {"forcerange": span} if is_limited else {}
    if drive.kp == 0.0:
        ET.SubElement(motors, "velocity", on | {"kv": repr(drive.kd)} | limit)
    else:
        gains = {"kp": repr(drive.kp), "kv": repr(drive.kd)}
        ET.SubElement(motors, "position", on | gains | limit)


@dataclass(frozen=True)
class JointNumbers:
    """What a joint and its drive do, in numbers of other simulators. takes: commands of
    its control loop, of COMMANDS_OF; none: efforts. limit: of effort, of the motor.
    damping: with the motor's back-EMF."""

    is_driven: bool
    takes: tuple[str, ...]
    kp: float
    kd: float
    limit: float
    damping: float
    friction: float
    armature: float
    delay: float  # [s] Of its commands.


def joint_numbers(loaded: LoadedScene, joint: Joint) -> JointNumbers:
    """What a joint and its drive do in a scene."""
    plant, name = loaded.plant, full_name(loaded.plant, joint)
    actuation, actuator = loaded.scene.actuation, actuator_of(plant, joint)
    law = law_of(actuation, name)
    damping = float(joint.default_damping_vector()[0])
    limit = np.inf if actuator is None else float(actuator.effort_limit())
    kp = kd = 0.0
    if law is not None:
        damping += float(law.emf)
        limit = min(limit, float(law.limit))
        kp, kd = _kp(loaded, name, float(law.kp)), float(law.kd)
    return JointNumbers(
        actuator is not None and name in actuation.joints,
        () if law is None else COMMANDS_OF[actuation.type],
        kp, kd, limit, damping, _sum_of(loaded, joint, "friction"),
        _rotor(plant, joint), _sum_of(loaded, joint, "delay"),
    )  # fmt: skip


# A simulation in Isaac Lab, and what it may not have.
_ISAAC_LAB = '''\
"""The drives of a repaired model, for Isaac Lab 2.2 to 3 (with Isaac Sim 5 and newer,
where joint friction is an effort).

    ArticulationCfg(..., actuators=ACTUATORS)

The law is effort = clip(stiffness (target - q) + damping (velocity target - v) + effort
target), with targets that arrive late by the delay. Without an effort limit here, that
of the asset holds. Masses and inertias are not here: `--export urdf,mjcf` has them.
"""

from isaaclab.actuators import DelayedPDActuatorCfg

PHYSICS_DT = 0.005  # [s] Of your simulation: delays are whole steps of it.

ACTUATORS = {
'''


def to_isaac_lab(scene: Scene) -> Exported:
    """The scene's drives as a Python module for Isaac Lab: a DelayedPDActuatorCfg for
    the joints of each delay, with stiffness, damping, effort limit (where there is
    one), armature and friction.

    Raises: ValueError as to_mjcf, or if the scene drives no joint.
    """
    loaded = _load(scene)
    plant = loaded.plant
    groups: dict[tuple[float, bool], dict[str, JointNumbers]] = {}
    for joint in one_dof_joints(plant):
        drive = joint_numbers(loaded, joint)
        if drive.is_driven and not is_added(model_of(plant, joint)):
            group = groups.setdefault((drive.delay, bool(np.isfinite(drive.limit))), {})
            group[re.escape(joint.name())] = drive
    if not groups:
        raise ValueError("--export isaaclab: the scene drives no joint")
    text = _ISAAC_LAB
    for k, ((delay, is_limited), drives) in enumerate(sorted(groups.items())):
        values = {
            "effort_limit": [d.limit for d in drives.values()],
            "stiffness": [d.kp for d in drives.values()],
            "damping": [d.kd for d in drives.values()],
            "armature": [d.armature for d in drives.values()],
            "friction": [d.friction for d in drives.values()],
            "dynamic_friction": [d.friction for d in drives.values()],
            "viscous_friction": [d.damping for d in drives.values()],
        }
        if not is_limited:
            del values["effort_limit"]
        text += f'    "drives_{k + 1}": DelayedPDActuatorCfg(\n'
        text += f"        joint_names_expr={list(drives)!r},\n"
        for name, numbers in values.items():
            each = dict(zip(drives, numbers, strict=True))
            text += f"        {name}={each!r},\n"
        for name in ("min_delay", "max_delay"):
            text += f"        {name}=round({delay!r} / PHYSICS_DT),\n"
        text += "    ),\n"
    return Exported(text + "}\n", unsaid(scene.effects, ("delay",)))


def _file_joint(loaded: LoadedScene, joint: Joint, document, there: str) -> list[str]:
    """Writes a joint's damping, friction and rotor into a URDF or an SDF file, where
    `there` is its name. Returns: what cannot be written."""
    plant = loaded.plant
    (element,) = [
        e for e in document.getElementsByTagName("joint")
        if e.getAttribute("name") == there and e.hasAttribute("type")
    ]  # fmt: skip
    dynamics = {
        "damping": repr(float(joint.default_damping_vector()[0])),
        "friction": repr(_sum_of(loaded, joint, "friction")),
    }
    rotor = _rotor(plant, joint)
    drakes = {"rotor_inertia": repr(rotor), "gear_ratio": repr(1.0)} if rotor else {}
    if drakes:
        document.documentElement.setAttribute("xmlns:drake", "http://drake.mit.edu")
    if children(element, "axis", "xyz"):  # SDF: numbers are texts, not attributes.
        at = _only(_only(element, "axis"), "dynamics")
        for tag, value in dynamics.items():
            set_text(_only(at, tag), value)
        for tag, value in drakes.items():
            set_text(_only(element, f"drake:{tag}"), value)
        return []
    for key, value in dynamics.items():
        _only(element, "dynamics").setAttribute(key, value)
    if not drakes:
        return []
    for transmission in document.getElementsByTagName("transmission"):
        names = [j.getAttribute("name") for j in children(transmission, "joint")]
        for actuator in children(transmission, "actuator"):
            if joint.name() not in names:
                continue
            for tag, value in drakes.items():
                _only(actuator, f"drake:{tag}").setAttribute("value", value)
            return []
    return [f"{full_name(plant, joint)} turns a rotor with {rotor:.3g}, and has no "
            "transmission to write it to"]  # fmt: skip


def _only(parent: minidom.Element, tag: str) -> minidom.Element:
    """The child of this name; made if there is none."""
    found = children(parent, tag)
    if found:
        return found[0]
    made = minidom.Document().createElement(tag)
    made.ownerDocument = parent.ownerDocument
    return parent.appendChild(made)


def _rotor(plant: MultibodyPlant, joint: Joint) -> float:
    actuator = actuator_of(plant, joint)
    return 0.0 if actuator is None else float(actuator.default_reflected_inertia())


def _exported_as(loaded: LoadedScene, attribute: str) -> list[Effect]:
    """The effects that are exported as "friction", "kp" or "delay"."""
    return [e for e in loaded.effects if KINDS[e.kind].exported == attribute]


def _sum_of(loaded: LoadedScene, joint: Joint, attribute: str) -> float:
    """Of effects that are exported as the attribute."""
    total = 0.0
    for effect in _exported_as(loaded, attribute):
        (value,) = effect.parameters.values()
        if any(j.index() == joint.index() for j in find_joints(effect, loaded.plant)):
            total += value
    return total


def _kp(loaded: LoadedScene, joint: str, kp: float) -> float:
    for effect in _exported_as(loaded, "kp"):
        names = [full_name(loaded.plant, j) for j in find_joints(effect, loaded.plant)]
        if joint in names:
            (kp,) = effect.parameters.values()
    return kp


def is_said(effect: Effect, more: Sequence[str] = ()) -> bool:
    """Whether a format has it; more: attributes that this one has besides those of
    all."""
    return KINDS[effect.kind].exported in ("inertia", "friction", "kp", *more)


def unsaid(effects: Sequence[Effect], more: Sequence[str] = ()) -> tuple[str, ...]:
    """Sentences of the effects that are not said."""
    return tuple(sentence(e, KINDS[e.kind]) for e in effects if not is_said(e, more))
