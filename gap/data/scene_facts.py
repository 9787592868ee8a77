"""What the checks need to know of a scene, taken from its plant."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from makebreak.gap.data.findings import JointFacts, SceneFacts


def scene_facts(plant: MultibodyPlant) -> SceneFacts:
    """Limits, free bodies, gravity and the torques of a finalized plant."""
    limits: dict[str, float] = {}
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        limits[_name(plant, actuator.joint())] = actuator.effort_limit()
    joints, start = {}, {}
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.num_positions() != 1 or joint.num_velocities() != 1:
            continue
        name = _name(plant, joint)
        joints[name] = JointFacts(
            prismatic=joint.type_name() == "prismatic",
            lower=float(joint.position_lower_limits()[0]),
            upper=float(joint.position_upper_limits()[0]),
            effort_limit=float(limits.get(name, np.inf)),
            driven=name in limits,
        )
        start[name] = (joint.position_start(), joint.velocity_start())
    free = frozenset(
        _name(plant, plant.get_body(i)) for i in plant.GetFloatingBaseBodies()
    )
    gravity = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
    context = plant.CreateDefaultContext()

    def torques(q, v, a):
        """Gravity and inertial torque of each joint, with the other bodies where the
        scene has them: {joint: value} in, two of them out."""
        positions = plant.GetPositions(context)
        acceleration = np.zeros(plant.num_velocities())
        for name, value in q.items():
            if name in start:
                positions[start[name][0]] = value
                acceleration[start[name][1]] = a[name]
        plant.SetPositions(context, positions)
        inertial = plant.CalcMassMatrix(context) @ acceleration
        weight = -plant.CalcGravityGeneralizedForces(context)
        here = [name for name in q if name in start]
        return tuple(
            {name: float(x[start[name][1]]) for name in here}
            for x in (weight, inertial)
        )

    return SceneFacts(joints, free, gravity, torques if joints else None)


def scene_names(plant: MultibodyPlant) -> tuple[set[str], set[str]]:
    """`<model>.<name>` of the joints, and of the bodies and frames, of a plant."""
    joints = {_name(plant, plant.get_joint(i)) for i in plant.GetJointIndices()}
    frames = {
        _name(plant, plant.get_frame(i))
        for model in range(plant.num_model_instances())
        for i in plant.GetFrameIndices(ModelInstanceIndex(model))
    }
    bodies = {
        _name(plant, plant.get_body(i))
        for model in range(plant.num_model_instances())
        for i in plant.GetBodyIndices(ModelInstanceIndex(model))
    }
    return joints, bodies | frames


def _name(plant: MultibodyPlant, element) -> str:
    return f"{plant.GetModelInstanceName(element.model_instance())}.{element.name()}"
