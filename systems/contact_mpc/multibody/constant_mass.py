"""Whether a plant has the closed form of ConstantMassModel, and the data of it."""

from dataclasses import replace

import numpy as np
from pydrake.geometry import Box, Cylinder, HalfSpace, Shape, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from makebreak.systems.contact_mpc.multibody.contact_layout import ContactLayout
from makebreak.systems.contact_mpc.multibody.smooth_dynamics import SmoothDynamics
from makebreak.systems.contact_mpc.numerics.constant_mass import ConstantMassModel
from makebreak.systems.contact_mpc.numerics.sphere_distance import (
    BOX,
    CYLINDER,
    HALF_SPACE,
    SPHERE,
)


def constant_mass_model(
    plant: MultibodyPlant, context: Context, inspector, dynamics: SmoothDynamics,
    layout: ContactLayout, frames: dict,
) -> ConstantMassModel | None:  # fmt: skip
    """The plant's ConstantMassModel; None where the plant has other joints than
    floating, prismatic and weld, bodies on floating ones, other force elements than
    gravity, or a contact without a sphere or without a closed-form distance.

    Args: context: the plant's own, at its default state; inspector: the scene graph's;
        frames: of the contacts' geometries, as of WitnessPoints.
    """
    if plant.num_force_elements() != 1:  # Gravity is always there, and constant.
        return None
    bodies = _floating_bodies(plant, context)
    if bodies is None:
        return None
    joint_of, turning, inertias = bodies
    ids = list(frames)
    shapes = [_shape_and_size(inspector.GetShape(id)) for id in ids]
    number = {id: i for i, id in enumerate(ids)}
    pairs = [(number[a], number[b]) for a, b in layout.geometries]
    known = [shape for shape in shapes if shape is not None]
    if len(known) < len(shapes) or not all(
        SPHERE in (known[a][0], known[b][0]) for a, b in pairs
    ):
        return None

    x = plant.GetPositionsAndVelocities(context).copy()
    u = np.zeros(plant.num_actuated_dofs())
    f, _, J_v, J_u, M = dynamics.linearise(x, u)
    f_0 = f - J_v @ x[dynamics.n_q :]
    joints = [joint_of.get(frames[id][0].body().index()) for id in ids]
    q_of = [-1 if joint is None else joint.position_start() for joint in joints]
    v_of = [-1 if joint is None else joint.velocity_start() for joint in joints]
    motions = []
    for id, joint in zip(ids, joints, strict=True):
        if joint is None:
            motions.append(_sliding(plant, context, x, dynamics.plain, *frames[id]))
        else:
            motions.append(_floating(plant, frames[id][1]))
    R, p_0, P, J_p = zip(*motions, strict=True)

    def array(values, dtype=float):
        return np.ascontiguousarray(np.array(values, dtype=dtype))

    return ConstantMassModel(
        M_inv=array(np.linalg.inv(M)), f_0=array(f_0), J_v=array(J_v),
        J_u=array(J_u), plain=dynamics.plain, floating=dynamics.floating,
        turning=array(turning, np.int64).reshape(-1, 2),
        body=array(inertias).reshape(-1, 5, 3),
        shape=array([shape for shape, _ in known], np.int64),
        size=array([size for _, size in known]),
        quaternion=array(q_of, np.int64), omega=array(v_of, np.int64),
        R=array(R), p_0=array(p_0), P=array(P), J_p=array(J_p),
        pairs=array(pairs, np.int64), reference=layout.reference,
    )  # fmt: skip


def with_masses(
    model: ConstantMassModel, plant: MultibodyPlant, context: Context,
    dynamics: SmoothDynamics,
) -> ConstantMassModel | None:  # fmt: skip
    """The model after masses and centres of mass have changed, and nothing else: no
    derivative by AutoDiff, as joints' damping is the same. Arguments as above."""
    bodies = _floating_bodies(plant, context)
    if bodies is None:
        return None
    _, turning, inertias = bodies
    x = plant.GetPositionsAndVelocities(context).copy()
    f, M, _ = dynamics.acceleration(x, np.zeros(plant.num_actuated_dofs()))
    M_inv = np.linalg.inv(M)
    changed = np.linalg.solve(M, np.linalg.inv(model.M_inv))
    J_v, J_u = changed @ model.J_v, changed @ model.J_u
    return replace(
        model, M_inv=M_inv, f_0=f - J_v @ x[dynamics.n_q :], J_v=J_v, J_u=J_u,
        turning=np.array(turning, np.int64).reshape(-1, 2),
        body=np.array(inertias, dtype=float).reshape(-1, 5, 3),
    )  # fmt: skip


def _floating_bodies(plant: MultibodyPlant, context: Context):
    """{body index: its floating joint}; (q, v) and (5, 3) inertia of the bodies
    whose angular acceleration depends on the state (not isotropic about their
    origin). None where a joint rules out the fast path."""
    joint_of, turning, inertias = {}, [], []
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    for joint in joints:
        if joint.type_name() == "quaternion_floating":
            child = joint.child_body()
            frames = joint.frame_on_parent(), joint.frame_on_child()
            if frames != (plant.world_frame(), child.body_frame()):
                return None
            joint_of[child.index()] = joint
            inertia = child.CalcSpatialInertiaInBodyFrame(context)
            if not _is_isotropic(inertia):
                if joint.GetDampingVector(context).any():
                    return None  # In the body's frame such damping is not constant.
                turning.append((joint.position_start(), joint.velocity_start()))
                centre, mass = inertia.get_com(), inertia.get_mass()
                about = inertia.Shift(centre).CalcRotationalInertia()
                inertias.append(
                    np.vstack([about.CopyToFullMatrix3(), centre, np.full(3, mass)])
                )
        elif joint.type_name() not in ("prismatic", "weld"):
            return None
    if any(joint.parent_body().index() in joint_of for joint in joints):
        return None
    return joint_of, turning, inertias


def _is_isotropic(inertia) -> bool:
    """Whether a body has its centre of mass at its origin and equal moments of inertia:
    its angular acceleration is then zero without a torque."""
    I_B = inertia.CalcRotationalInertia().CopyToFullMatrix3()
    unlike = np.abs(I_B - I_B[0, 0] * np.eye(3)).max()
    return not inertia.get_com().any() and bool(unlike <= 1e-12 * I_B[0, 0])


def _floating(plant, X_BG):
    """R, p_0, P and J_p of a geometry on a floating body: its pose X_BG in the body;
    P (3, n_q) and J_p (3, n_v) are zero."""
    P, J_p = np.zeros((3, plant.num_positions())), np.zeros((3, plant.num_velocities()))
    return X_BG.rotation().matrix(), X_BG.translation(), P, J_p


def _sliding(plant, context, x, plain, frame, X_BG):
    """Rotation R (3, 3) in the world of a geometry whose body never turns; its position
    is p_0 (3,) + P (3, n_q) q [m], and its velocity J_p (3, n_v) v.

    Args: x: the state of the context; plain: as of SmoothDynamics; frame: the body's;
        X_BG: the geometry's pose in it.
    """
    X, world = frame.CalcPoseInWorld(context) @ X_BG, plant.world_frame()
    J_p = plant.CalcJacobianTranslationalVelocity(
        context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world
    )
    P = np.zeros((3, plant.num_positions()))
    P[:, plain[:, 0]] = J_p[:, plain[:, 1]]
    p_0 = X.translation() - P @ x[: plant.num_positions()]
    return X.rotation().matrix(), p_0, P, J_p


def _shape_and_size(shape: Shape) -> tuple[int, list[float]] | None:
    """Number and size (3,) [m] of a shape of sphere_distance; None: it has no such."""
    if isinstance(shape, Sphere):
        return SPHERE, [shape.radius()] * 3
    if isinstance(shape, Box):
        return BOX, [0.5 * length for length in np.array(shape.size())]
    if isinstance(shape, Cylinder):
        half = 0.5 * shape.length()
        return CYLINDER, [shape.radius(), half, half]
    if isinstance(shape, HalfSpace):
        return HALF_SPACE, [0.0] * 3
    return None
