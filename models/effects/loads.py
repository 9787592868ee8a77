"""Effects of the load of a mechanism and of its base: payload, gravity_tilt."""

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    RigidBody,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)

from makebreak.models.effects.inertia import (
    about_origin,
    added_inertia,
    inertial_signature,
    ten_parameters,
)
from makebreak.models.effects.kind import (
    PAYLOAD_ON,
    Effect,
    EffectKind,
    Parameter,
    find_bodies,
    full_name,
    model_names,
    model_of,
    one_dof_joints,
)
from makebreak.models.effects.signature import Signature, without_momentum

# ----- payload

_PLACE = ("com_x", "com_y", "com_z")
_EXTENT = "gyration_radius"
PLACE_MAX = 0.5  # Coordinates of a load in its body's frame [m].
_PROBE_ARM, _USUAL_ARM = 0.05, 0.1  # Of small point masses, and of a load [m].


def _payload_name(plant: MultibodyPlant, body: RigidBody) -> str:
    return f"{PAYLOAD_ON}{full_name(plant, body).replace('.', '_')}"


def _payload_inertia(effect: Effect) -> SpatialInertia:
    """A point mass or one with an extent, perhaps negative. Drake's check for physical
    validity is skipped; _check_left checks the sum with the body."""
    com = _payload_place(effect)
    about = about_origin(com, _extent(effect))
    unit = UnitInertia(*np.diag(about), about[0, 1], about[0, 2], about[1, 2])
    return SpatialInertia(effect.parameters["mass"], com, unit, True)


def _payload_place(effect: Effect) -> np.ndarray:
    return np.array([effect.parameters[name] for name in _PLACE])


def _extent(effect: Effect) -> float:
    """Radius of gyration about its centre, the same about all axes [m]."""
    return effect.parameters.get(_EXTENT, 0.0)


def _check_left(
    effect: Effect, plant: MultibodyPlant, body: RigidBody, more: SpatialInertia | None
) -> None:
    """Raises: ValueError if the inertia of the body and of all that is welded to it is
    not physical; `more`: a load that is not in the plant yet, about the body's
    origin."""
    if effect.parameters["mass"] >= 0.0:
        return
    fixed = [each.index() for each in plant.GetBodiesWeldedTo(body)]
    context = plant.CreateDefaultContext()
    M = plant.CalcSpatialInertia(context, body.body_frame(), fixed)
    mass, com = M.get_mass(), M.CalcComMoment()
    about = M.CalcRotationalInertia().CopyToFullMatrix3()
    if more is not None:
        mass, com = mass + more.get_mass(), com + more.CalcComMoment()
        about = about + more.CalcRotationalInertia().CopyToFullMatrix3()
    possible = mass >= 0.0
    if mass > 0.0:
        place = com / mass
        central = about - mass * (place @ place * np.eye(3) - np.outer(place, place))
        least, middle, greatest = np.linalg.eigvalsh(central)
        slack = 1e-9 * max(greatest, 1e-9)
        possible = least >= -slack and least + middle >= greatest - slack
    if not possible:
        raise ValueError(
            f"effect payload at {effect.at}: without {-effect.parameters['mass']:g} kg "
            f"at {_payload_place(effect)} m no body is left of {body.scoped_name()} "
            f"and what is fixed to it ({mass:g} kg)"
        )


def _check_payload(effect: Effect, plant: MultibodyPlant, effects) -> None:
    for body in find_bodies(effect, plant):
        _check_left(effect, plant, body, None)


def _least_payload(effect, plant: MultibodyPlant, effects, damped) -> dict[str, float]:
    context = plant.CreateDefaultContext()
    masses = [
        sum(each.get_mass(context) for each in plant.GetBodiesWeldedTo(body))
        for body in find_bodies(effect, plant)
    ]
    return {"mass": -min(masses)}


def _add_payload(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    """Welds a point mass to the body, in a model instance of its own, so that bodies
    and state of the carrier keep their layout."""
    for body in find_bodies(effect, plant):
        name = _payload_name(plant, body)
        if plant.HasModelInstanceNamed(name):
            raise ValueError(
                f"effect payload at {effect.at}: {full_name(plant, body)} has one"
            )
        instance = plant.AddModelInstance(name)
        added = plant.AddRigidBody("payload", instance, _payload_inertia(effect))
        plant.WeldFrames(body.body_frame(), added.body_frame())


def _change_payload(old: Effect, new: Effect, plant: MultibodyPlant, context) -> None:
    for body in find_bodies(new, plant):
        instance = plant.GetModelInstanceByName(_payload_name(plant, body))
        plant.GetBodyByName("payload", instance).SetSpatialInertiaInBodyFrame(
            context, _payload_inertia(new)
        )


def point_of(c: np.ndarray) -> tuple[float, np.ndarray]:
    """(mass [kg], place (3,) [m]) of a point mass from c: mass, mass times place (3),
    and perhaps moments of inertia about the origin (0 where not identified).

    On a link that turns about a fixed axis the mass alone is not identifiable. There it
    follows from mass times place and the moments: ixx = ((m y)^2 + (m z)^2) / m, etc.
    """
    mass, moment = float(c[0]), np.array(c[1:4])
    if abs(mass) > 1e-12 and np.abs(moment / mass).max() <= PLACE_MAX:
        return mass, moment / mass
    about = np.array(c[4:7])
    squares = (moment @ moment - moment**2)[: len(about)]
    found = about != 0.0
    if not about[found].sum() != 0.0 or not squares[found].sum() > 0.0:
        return mass, moment / mass if abs(mass) > 1e-12 else np.zeros(3)
    mass = float(squares[found].sum() / about[found].sum())
    return mass, moment / mass


def _payload_signature(effect, model, motion, grid=None) -> list[Signature]:
    """Linear in mass, mass times place and the moments of inertia about the origin.
    The moments follow from the others, but are free here to keep the fit linear."""
    (body,) = find_bodies(effect, model.plant)[:1]

    def to_parameters(c):
        mass, com = point_of(np.asarray(c, float))
        return {"mass": mass} | dict(zip(_PLACE, map(float, com), strict=True))

    moments = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    unknowns = ("mass", "mass_com_x", "mass_com_y", "mass_com_z", *moments)
    return [
        inertial_signature(
            effect, model, motion, body, unknowns, np.eye(10), to_parameters, False
        )
    ]


def _payload_probes(size: float):
    """Point masses at the body's origin and on its axes."""
    places = np.vstack([np.zeros(3), _PROBE_ARM * np.eye(3)])

    def parameters(mass: float, place) -> dict[str, float]:
        return {"mass": mass} | dict(zip(_PLACE, map(float, place), strict=True))

    def from_shares(c):
        mass, moment = size * float(np.sum(c)), size * (np.asarray(c) @ places)
        reach = float(np.linalg.norm(moment))
        # Where only its moment shows the mass may come out as anything.
        if not mass > 0.0 or reach > PLACE_MAX * mass:
            mass = max(reach / _USUAL_ARM, 1e-6)
        return parameters(mass, moment / mass)

    return [parameters(size, place) for place in places], from_shares


def _payload_added(effect, model, motion) -> np.ndarray:
    for body in find_bodies(effect, model.plant):
        _check_left(effect, model.plant, body, _payload_inertia(effect))
    mass, com = effect.parameters["mass"], _payload_place(effect)
    ten = ten_parameters(mass, com, _extent(effect))
    return added_inertia(effect, model, motion, lambda M: ten)


# ----- gravity_tilt


def rotation(effect: Effect):
    """RotationMatrix of a gravity_tilt."""
    return RollPitchYaw(
        effect.parameters["roll"], effect.parameters["pitch"], 0.0
    ).ToRotationMatrix()


def _tilt(effect: Effect, plant: MultibodyPlant, scene_graph) -> None:
    """Rotates a model that is welded to the world about its base's origin. For other
    models, and at `world`, gravity is rotated the opposite way instead."""
    R = rotation(effect)
    for at in effect.at:
        if at != "world" and at not in model_names(plant):
            raise ValueError(
                f"effect gravity_tilt at {at!r}: expected `world` or a model: "
                f"{', '.join(model_names(plant))}"
            )
        welds = [
            joint
            for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
            if isinstance(joint, WeldJoint)
            and joint.parent_body().index() == plant.world_body().index()
            and model_of(plant, joint.child_body()) == at
        ]
        if not welds:
            others = {
                model_of(plant, joint)
                for joint in one_dof_joints(plant)
                if model_of(plant, joint) != at
            }
            if at != "world" and others:
                raise ValueError(
                    f"effect gravity_tilt at {at!r}: it is not welded to the world and "
                    f"the scene has other mechanisms, {sorted(others)}; say `world`"
                )
            field = plant.mutable_gravity_field()
            field.set_gravity_vector(R.inverse() @ field.gravity_vector())
            continue
        for weld in welds:
            M = weld.frame_on_child()
            X_WF = weld.frame_on_parent().GetFixedPoseInBodyFrame()
            X_BM = M.GetFixedPoseInBodyFrame()
            X_WB = X_WF @ weld.X_FM() @ X_BM.inverse()
            X_WB = RigidTransform(R @ X_WB.rotation(), X_WB.translation())
            name = weld.name()
            plant.RemoveJoint(weld)
            plant.AddJoint(WeldJoint(name, plant.world_frame(), M, X_WB @ X_BM))


def _tilt_signature(effect, model, motion, grid=None) -> list[Signature]:
    """Linear in small angles: R^T g = g - axis x g. Free bodies feel the tilt only at
    `world`."""
    tilted = _weight(effect, model, motion)
    columns = np.stack(
        [tilted(np.cross(axis, model.gravity)) for axis in np.eye(3)[:2]], axis=2
    )
    return [without_momentum(effect, ["roll", "pitch"], columns, exact=False)]


def _tilt_added(effect, model, motion) -> np.ndarray:
    R = rotation(effect).matrix()
    return _weight(effect, model, motion)(model.gravity - R.T @ model.gravity)


def _weight(effect, model, motion):
    """Function of a change of gravity (3,) with opposite sign -> effort (n, n_v) at the
    joints that feel the tilt."""
    plant = model.plant
    mJ = model.mass_times_com_jacobian(motion.q)  # (n, 3, n_v)
    unaffected = np.zeros(plant.num_velocities(), dtype=bool)
    if effect.at != ["world"]:
        unaffected[:] = True
        for joint in one_dof_joints(plant):
            if _stands_on(plant, joint.child_body(), effect.at):
                unaffected[joint.velocity_start()] = False
    return lambda less: np.where(unaffected, 0.0, less @ mJ)


def _stands_on(plant: MultibodyPlant, body: RigidBody, models: list[str]) -> bool:
    """Whether a body of one of the models lies between the body and the world."""
    parent = {
        joint.child_body().index(): joint.parent_body()
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
    }
    while body.index() != plant.world_body().index():
        if model_of(plant, body) in models:
            return True
        if body.index() not in parent:
            return False
        body = parent[body.index()]
    return False


KINDS = {
    "payload": EffectKind(
        at="body",
        parameters=(
            Parameter("mass", "kg", -2.0, 2.0, of_size=True),
            *(Parameter(name, "m", -PLACE_MAX, PLACE_MAX, None) for name in _PLACE),
            Parameter(_EXTENT, "m", 0.0, 0.3, 0.0, ">= 0", optional=True, refines=True),
        ),
        says="{at} carries {mass} that the model lacks, at ({com_x}, {com_y}, {com_z}) "
        "in its frame[, with a radius of gyration of {gyration_radius}]",
        says_less="{at} carries {mass} less than the model says, missing at ({com_x}, "
        "{com_y}, {com_z}) in its frame[, with a radius of gyration of "
        "{gyration_radius}]",
        confused_with=("object_mass", "link_mass", "actuator_gain", "constant_force"),
        exported="inertia",
        tell_apart="hold three or more orientations of the wrist, and move it fast",
        weighs=True,
        before_finalize=_add_payload,
        possible=_check_payload,
        least=_least_payload,
        set_in_context=_change_payload,
        signature=_payload_signature,
        added=_payload_added,
        probes=_payload_probes,
    ),
    "gravity_tilt": EffectKind(
        at="base",
        parameters=(
            Parameter("roll", "rad", -0.3, 0.3),
            Parameter("pitch", "rad", -0.3, 0.3),
        ),
        says="the base of {at} is tilted by {roll} of roll and {pitch} of pitch, "
        "relative to the model",
        confused_with=("joint_offset", "object_com", "constant_force", "actuator_bias"),
        exported="inertia",
        tell_apart="turn the first joint through its range: the torque of a tilt goes "
        "round with it",
        weighs=True,
        before_finalize=_tilt,
        signature=_tilt_signature,
        added=_tilt_added,
    ),
}
