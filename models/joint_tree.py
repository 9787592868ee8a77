"""The numbers of a plant whose bodies are links of a tree of joints."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)

from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect, one_dof_joints
from makebreak.systems.numerics.joint_tree import JointTree


class NoJointTree(ValueError):
    """Anything else moves, or pulls, than joints that turn or slide."""


def rotors_and_damping(plant: MultibodyPlant, context) -> dict[str, np.ndarray]:
    """{rotor, damping: (n,)} of the joints."""
    rotor, damping = np.zeros((2, plant.num_velocities()))
    for joint in one_dof_joints(plant):
        if joint.num_velocities():
            damping[joint.velocity_start()] = joint.GetDampingVector(context)[0]
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        at = actuator.joint().velocity_start()
        rotor[at] += actuator.calc_reflected_inertia(context)
    return dict(rotor=rotor, damping=damping)


def joint_tree(plant: MultibodyPlant, context=None) -> JointTree:
    """The joints and links of a plant.

    Args: context: with its inertias; None: the plant's own.
    Raises: NoJointTree.
    """
    joints = _joints(plant)
    n = plant.num_velocities()
    if len(joints) != n or plant.num_positions() != n:
        raise NoJointTree(
            "expected joints that turn or slide and nothing else that moves"
        )
    if not all(isinstance(j, RevoluteJoint | PrismaticJoint) for j in joints):
        raise NoJointTree("expected joints that turn or slide")
    if plant.num_force_elements() > 1:
        raise NoJointTree("expected no force elements but gravity")
    context = context or plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(n))
    link_of = _links(plant, joints)

    X_WM = [j.frame_on_child().CalcPoseInWorld(context) for j in joints]
    parent = np.array([link_of[j.parent_body().index()] for j in joints])
    if (parent >= np.arange(n)).any():
        raise NoJointTree("expected joints in order, from the base outwards")
    R_PJ, p_PJ, axis = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))
    mass, moment, about = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, joint in enumerate(joints):
        X = X_WM[i] if parent[i] < 0 else X_WM[parent[i]].inverse() @ X_WM[i]
        R_PJ[i], p_PJ[i] = X.rotation().matrix(), X.translation()
        turns = isinstance(joint, RevoluteJoint)
        a = joint.revolute_axis() if turns else joint.translation_axis()
        axis[i] = a / np.linalg.norm(a)
    for k in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(k))
        i = link_of[body.index()]
        if i < 0:
            continue
        X = X_WM[i].inverse() @ plant.EvalBodyPoseInWorld(context, body)
        M = body.CalcSpatialInertiaInBodyFrame(context)
        M = M.ReExpress(X.rotation()).Shift(-X.translation())
        mass[i] += M.get_mass()
        moment[i] += M.CalcComMoment()
        about[i] += M.CalcRotationalInertia().CopyToFullMatrix3()
    p_com = moment / np.where(mass == 0.0, 1.0, mass)[:, None]
    for i, c in enumerate(p_com):
        about[i] -= mass[i] * (c @ c * np.eye(3) - np.outer(c, c))
    return JointTree(
        parent=parent.astype(np.int64),
        slides=np.array([isinstance(j, PrismaticJoint) for j in joints]),
        R_PJ=R_PJ, p_PJ=p_PJ, axis=axis, mass=mass, p_com=p_com, I_com=about,
        **rotors_and_damping(plant, context),
        gravity=np.array(plant.gravity_field().gravity_vector()),
    )  # fmt: skip


def is_of_link(kind: str) -> bool:
    """Whether it changes the inertia of a link that is there, without another plant."""
    entry = KINDS[kind]
    return bool(entry.at == "body" and entry.set_in_context and entry.edit_text)


def changed_context(plant: MultibodyPlant, effects: Sequence[Effect]):
    """A Context of a plant whose links and joints have these effects, too.

    Raises: ValueError for effects that it cannot have.
    """
    context = plant.CreateDefaultContext()
    for effect in effects:
        change = KINDS[effect.kind].set_in_context
        assert change is not None
        none = dict.fromkeys(effect.parameters, 0.0)
        change(Effect(effect.kind, effect.at, none), effect, plant, context)
    return context


def carrier(
    plant: MultibodyPlant, body: RigidBody
) -> tuple[int, np.ndarray, np.ndarray]:
    """The link of joint_tree that a body is part of, and the body's origin (3,) and
    axes (3, 3) there; link -1 is the world."""
    joints = _joints(plant)
    link = _links(plant, joints)[body.index()]
    context = plant.CreateDefaultContext()
    X = plant.EvalBodyPoseInWorld(context, body)
    if link >= 0:
        X = joints[link].frame_on_child().CalcPoseInWorld(context).inverse() @ X
    return link, np.array(X.translation()), np.array(X.rotation().matrix())


def _joints(plant: MultibodyPlant) -> list:
    return sorted(
        (j for j in one_dof_joints(plant) if j.num_velocities()),
        key=lambda j: j.velocity_start(),
    )


def _links(plant: MultibodyPlant, joints) -> dict[BodyIndex, int]:
    """{body: the joint that it moves with}; -1 for the world."""
    carried = {j.child_body().index(): i for i, j in enumerate(joints)}
    inner = {
        j.child_body().index(): j.parent_body().index()
        for j in (plant.get_joint(i) for i in plant.GetJointIndices())
    }
    found = {}
    for k in range(plant.num_bodies()):
        body = BodyIndex(k)
        while body not in carried and body in inner:
            body = inner[body]
        found[BodyIndex(k)] = carried.get(body, -1)
    return found
