"""What drives a scene's joints: actuators, and what lies before them."""

from collections.abc import Iterable, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import (
    BIAS,
    GAIN,
    LIMIT,
    NO_LIMIT,
    TIME_CONSTANT,
    ActuationPath,
    Drive,
    PathPorts,
)
from makebreak.models.effects.actuation_path import STEPS as PATH_STEPS
from makebreak.models.effects.delay_line import DelayLine
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    find_joints,
    full_name,
    model_names,
    one_dof_joints,
)
from makebreak.models.effects.measured_channels import ChannelMap, channel_maps
from makebreak.models.effects.transmission import motor_joint
from makebreak.models.scene_schema import ActuationSection, nearest

CHANNEL_STEPS = {name: kind.channel for name, kind in KINDS.items() if kind.channel}


def step_or_default(plant: MultibodyPlant) -> float:
    """Of the systems that sample beside the plant [s]."""
    return plant.time_step() or 0.001


def add_actuators(actuation: ActuationSection, plant: MultibodyPlant) -> None:
    """A joint that the scene drives gets an actuator if its model has none."""
    if actuation.type == "none":
        return
    named = {full_name(plant, joint): joint for joint in one_dof_joints(plant)}
    for name in actuation.joints:
        if name not in named:
            raise ValueError(
                f"actuation.joints: no joint {name!r} that turns or slides: "
                f"{nearest(name, named)}"
            )
        if actuator_of(plant, named[name]) is None:
            plant.AddJointActuator(f"{named[name].name()}_actuator", named[name])


def actuators_of_model(plant: MultibodyPlant, model: str) -> list:
    """In the order of the model's actuation port."""
    instance = plant.GetModelInstanceByName(model)
    return [
        plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)
    ]


def path_numbers(
    plant: MultibodyPlant, model: str, effects: Iterable[Effect]
) -> tuple[np.ndarray, np.ndarray]:
    """What lies between a model's commands and its joints: the numbers (4, n_u) of its
    ActuationPath, and the delays (n_u,) [s] before it. Gains multiply, biases, lags and
    delays add up, of several limits the least holds.

    Raises: ValueError for a joint that nothing drives.
    """
    actuators = actuators_of_model(plant, model)
    at = {actuator.joint().index(): i for i, actuator in enumerate(actuators)}
    numbers = np.tile([[1.0], [0.0], [NO_LIMIT], [0.0]], (1, len(actuators)))
    delays = np.zeros(len(actuators))
    for effect in effects:
        step = KINDS[effect.kind].path
        if not step:
            continue
        name, _ = PATH_STEPS[step]
        value = effect.parameters[name]
        for joint in find_joints(effect, plant):
            if actuator_of(plant, joint) is None:
                if full_name(plant, joint) in effect.at:
                    raise ValueError(
                        f"effect {effect.kind} at {effect.at}: nothing drives "
                        f"{full_name(plant, joint)}"
                    )
                continue
            i = at.get(joint.index())
            if i is None:
                continue
            if step == "gain":
                numbers[GAIN, i] *= value
            elif step == "bias":
                numbers[BIAS, i] += value
            elif step == "saturation":
                numbers[LIMIT, i] = min(numbers[LIMIT, i], value)
            elif step == "lag":
                numbers[TIME_CONSTANT, i] += value
            else:
                delays[i] += value
    return numbers, delays


def _drive(
    actuation: ActuationSection, effects, plant: MultibodyPlant, model: str
) -> Drive | None:
    """The position control of a model's drives, if the scene has it."""
    actuators = actuators_of_model(plant, model)
    names = [full_name(plant, actuator.joint()) for actuator in actuators]
    driven = np.array([name in actuation.joints for name in names], dtype=bool)
    if actuation.type != "pd" or not driven.any():
        return None
    gains: list[np.ndarray] = []
    for key, values in (("kp", actuation.kp), ("kd", actuation.kd)):
        if len(values) not in (1, len(actuation.joints)) or not all(
            value >= 0.0 for value in values
        ):
            raise ValueError(
                f"actuation.{key} is {values}, expected one gain of 0 or more, or one "
                f"for each of the {len(actuation.joints)} joints"
            )
        each = dict(
            zip(
                actuation.joints,
                list(values) * (len(actuation.joints) // len(values)),
                strict=True,
            )
        )
        gains.append(np.array([each.get(name, 0.0) for name in names]))
    joints = [motor_joint(plant, a.joint()) or a.joint() for a in actuators]
    n_q = plant.num_positions()
    offsets = [effect for effect in effects if KINDS[effect.kind].channel == "offset"]
    maps = channel_maps(offsets, CHANNEL_STEPS, [f"{name}.position" for name in names])
    return Drive(
        gains[0],
        gains[1],
        driven,
        np.array([joint.position_start() for joint in joints]),
        np.array([n_q + joint.velocity_start() for joint in joints]),
        np.array([maps.get(f"{name}.position", ChannelMap()).bias for name in names]),
    )


def add_paths(
    actuation: ActuationSection,
    effects: Sequence[Effect],
    plant: MultibodyPlant,
    builder: DiagramBuilder,
    command_delays: bool,
) -> dict[str, PathPorts]:
    """An actuation path for each model that needs one."""
    paths = {}
    elastic_motors = {
        motor.index(): joint.index()
        for joint in one_dof_joints(plant)
        for motor in [motor_joint(plant, joint)]
        if motor is not None
    }
    changed = {
        joint.index()
        for effect in effects
        if KINDS[effect.kind].path
        for joint in find_joints(effect, plant)
    } | set(elastic_motors.values())
    for model in model_names(plant):
        actuators = actuators_of_model(plant, model)
        joints = [actuator.joint() for actuator in actuators]
        if not actuators or any(joint.index() in elastic_motors for joint in joints):
            continue
        drive = _drive(actuation, effects, plant, model)
        numbers, delays = path_numbers(plant, model, effects)
        if drive is None and not any(joint.index() in changed for joint in joints):
            continue
        motors = [motor_joint(plant, joint) for joint in joints]
        system = ActuationPath(
            numbers,
            plant.time_step(),
            drive,
            plant.num_multibody_states(),
            [motor is not None for motor in motors],
        )
        builder.AddNamedSystem(f"{model}_actuation_path", system)
        ports = PathPorts(system, systems=[system])

        def delayed(name, system=system, ports=ports, delays=delays, model=model):
            port = system.GetInputPort(name)
            if not (command_delays and delays.any()):
                return port
            line = DelayLine(delays, step_or_default(plant))
            builder.AddNamedSystem(f"{model}_{name}_delay", line)
            builder.Connect(line.get_output_port(), port)
            ports.systems.insert(0, line)
            return line.get_input_port()

        if drive is None:
            ports.command = delayed("command")
        else:
            ports.position_command = delayed("position_command")
            ports.velocity_command = delayed("velocity_command")
            builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
        ports.effort = system.GetOutputPort("effort")
        ports.nominal = system.GetOutputPort("nominal")
        instance = plant.GetModelInstanceByName(model)
        builder.Connect(
            system.GetOutputPort("joint_effort"),
            plant.get_actuation_input_port(instance),
        )
        for i, motor in enumerate(motors):
            if motor is not None:
                builder.Connect(
                    system.GetOutputPort(f"motor_effort_{i}"),
                    plant.get_actuation_input_port(motor.model_instance()),
                )
        paths[model] = ports
    # Asked for, so that a joint that nothing drives is refused by name.
    for effect in effects:
        if KINDS[effect.kind].path and not any(
            actuator_of(plant, joint) for joint in find_joints(effect, plant)
        ):
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: nothing drives a joint there"
            )
    return paths
