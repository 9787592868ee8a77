"""The actuation of a scene's joints: actuators, drives, and effects on the commands."""

from collections.abc import Iterable, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import (
    FASTEST,
    GAIN,
    KP,
    LIMIT,
    NO_LIMIT,
    OWN,
    ROWS,
    SHARE,
    ActuationPath,
    Drive,
    DriveLaw,
    Gear,
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
    velocity_unit,
)
from makebreak.models.effects.measured_channels import ChannelMap, channel_maps
from makebreak.models.effects.transmission import motor_joint
from makebreak.models.scene_schema import COMMANDS_OF, ActuationSection
from makebreak.models.typed_yaml import nearest

DRIVEN_BY = ("position_command", "velocity_command")  # Of drives with a control loop.
STIFF_TYPES = ("servo", "velocity")
CHANNEL_STEPS = {name: kind.channel for name, kind in KINDS.items() if kind.channel}


def step_or_default(plant: MultibodyPlant) -> float:
    """Period of systems that sample beside the plant [s]."""
    return plant.time_step() or 0.001


def add_actuators(actuation: ActuationSection, plant: MultibodyPlant) -> None:
    """Adds actuators to the joints that the scene drives, if their models have none;
    of a larger limit, where the scene says so.

    Raises: ValueError for an unknown joint.
    """
    if actuation.type == "none":
        return
    named = {full_name(plant, joint): joint for joint in one_dof_joints(plant)}
    for k, name in enumerate(actuation.joints):
        if name not in named:
            raise ValueError(
                f"actuation.joints: no joint {name!r} that turns or slides: "
                f"{nearest(name, named)}"
            )
        own = actuator_of(plant, named[name])
        if own is None:
            plant.AddJointActuator(f"{named[name].name()}_actuator", named[name])
        elif actuation.limit:
            limit = actuation.limit[min(k, len(actuation.limit) - 1)]
            own.set_effort_limit(max(limit, own.effort_limit()))


def actuators_of_model(plant: MultibodyPlant, model: str) -> list:
    """The actuators of a model, in the order of its actuation port."""
    instance = plant.GetModelInstanceByName(model)
    return [
        plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)
    ]


def path_numbers(
    plant: MultibodyPlant, model: str, effects: Iterable[Effect]
) -> tuple[np.ndarray, np.ndarray]:
    """Effects between a model's commands and its joints: the numbers (ROWS, n_u) of its
    ActuationPath, and the delays (n_u,) before it [s].

    Gains multiply; biases, lags, delays and load friction add up; the smallest limit
    and the last kp are taken.

    Raises: ValueError for an effect on a joint without an actuator.
    """
    actuators = actuators_of_model(plant, model)
    at = {actuator.joint().index(): i for i, actuator in enumerate(actuators)}
    numbers = np.zeros((ROWS, len(actuators)))
    numbers[GAIN], numbers[LIMIT], numbers[KP] = 1.0, NO_LIMIT, OWN
    delays = np.zeros(len(actuators))
    for effect in effects:
        step = KINDS[effect.kind].path
        if not step:
            continue
        name, row = PATH_STEPS[step]
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
            elif step == "saturation":
                numbers[LIMIT, i] = min(numbers[LIMIT, i], value)
            elif step == "kp":
                numbers[KP, i] = value
            elif row is not None:
                numbers[row, i] += value
            else:
                delays[i] += value
    return numbers, delays


def drive_law(actuation: ActuationSection) -> DriveLaw:
    """The law of the scene's drives, with an entry for each of actuation.joints.

    Raises: ValueError for too few or too many numbers, or one out of range.
    """
    n = len(actuation.joints)

    def numbers(key: str, values, default: float | None, least: str = ">= 0"):
        if not len(values) and default is not None:
            values = [default]
        good = all(v > 0.0 or (v == 0.0 and least == ">= 0") for v in values)
        if len(values) not in (1, n) or not good or not np.isfinite(values).all():
            what = "of 0 or more" if least == ">= 0" else "above 0"
            raise ValueError(
                f"actuation.{key} is {list(values)}, expected one number {what}, or "
                f"one for each of the {n} joints"
            )
        return np.broadcast_to(np.array(values, dtype=float), n).copy()

    is_position = "position_command" in COMMANDS_OF[actuation.type]
    is_velocity = "velocity_command" in COMMANDS_OF[actuation.type]
    kp = numbers("kp", actuation.kp, None if is_position else 0.0)
    kd = numbers("kd", actuation.kd, None if is_velocity else 0.0)
    if not is_position and kp.any():
        raise ValueError(
            f"actuation.kp is {actuation.kp}, which a drive of type {actuation.type} "
            "does not have"
        )
    limit = np.full(n, np.inf)
    if len(actuation.limit):
        limit = numbers("limit", actuation.limit, None, "> 0")
    emf, supply = np.zeros(n), actuation.supply
    if len(supply.voltage) or len(supply.kt) or len(supply.resistance):
        U, kt, R = (
            numbers(f"supply.{key}", getattr(supply, key), None, "> 0")
            for key in ("voltage", "kt", "resistance")
        )
        limit, emf = np.minimum(limit, U * kt / R), kt**2 / R
    return DriveLaw(
        kp, kd, limit, emf,
        numbers("dead_band", actuation.dead_band, 0.0),
        numbers("resolution", actuation.resolution, 0.0),
    )  # fmt: skip


def law_of(actuation: ActuationSection, joint: str) -> DriveLaw | None:
    """The law of one joint's drive; None if it has no control loop."""
    if joint not in actuation.joints:
        return None
    if not set(COMMANDS_OF[actuation.type]) & set(DRIVEN_BY):
        return None
    return drive_law(actuation)[actuation.joints.index(joint)]


def _gear(plant: MultibodyPlant, model: str) -> Gear:
    """Where load friction of a model's actuators fades (Gear)."""
    actuators = actuators_of_model(plant, model)
    n_q, dt = plant.num_positions(), plant.time_step()
    context = plant.CreateDefaultContext()
    mobility = np.diag(np.linalg.inv(plant.CalcMassMatrix(context)))
    joints = [motor_joint(plant, a.joint()) or a.joint() for a in actuators]
    at = np.array([joint.velocity_start() for joint in joints], dtype=int)
    slow = np.array([velocity_unit(joint) for joint in joints])
    return Gear(n_q + at, slow, 2.0 * dt * mobility[at])


class TooStiff(ValueError):
    """A drive stops its joint faster than can be simulated."""


def check_stiffness(
    mobility: float, damping: float, joint: str, time_step: float = 0.0
) -> None:
    """Raises: TooStiff if the drive is, as it may be where the model lacks the motor's
    rotor.

    Args: mobility: of the joint where it is [1/(kg m2)]. time_step: of Drake's own
        steps [s]; 0: it has none.
    """
    inertia = 1.0 / mobility
    least = damping * time_step if time_step else 0.5 * damping / FASTEST
    if inertia < least:
        raise TooStiff(
            f"actuation: the drive of {joint} damps with {damping:.3g} N m s/rad, and "
            f"the joint has {inertia:.2g} kg m2, too little for that to be simulated "
            f"(expected {least:.2g} or more): give it its rotor (an effect "
            "rotor_inertia, its inertia times the gear ratio squared)"
        )


def _drive(
    actuation: ActuationSection, effects, plant: MultibodyPlant, model: str
) -> Drive | None:
    """The control loops of a model's drives; None if it has none."""
    actuators = actuators_of_model(plant, model)
    names = [full_name(plant, actuator.joint()) for actuator in actuators]
    driven = np.array([name in actuation.joints for name in names], dtype=bool)
    takes = COMMANDS_OF[actuation.type]
    if not driven.any() or not set(takes) & set(DRIVEN_BY):
        return None
    whole = drive_law(actuation)
    of = {name: i for i, name in enumerate(actuation.joints)}
    law = whole[np.array([of.get(name, 0) for name in names])]
    joints = [motor_joint(plant, a.joint()) or a.joint() for a in actuators]
    if actuation.type in STIFF_TYPES:
        M = plant.CalcMassMatrix(plant.CreateDefaultContext())
        mobility = np.diag(np.linalg.inv(M))
        for k in np.flatnonzero(driven):
            check_stiffness(
                mobility[joints[k].velocity_start()], law.kd[k] + law.emf[k], names[k],
                plant.time_step(),
            )  # fmt: skip
    n_q = plant.num_positions()
    offsets = [effect for effect in effects if KINDS[effect.kind].channel == "offset"]
    maps = channel_maps(offsets, CHANNEL_STEPS, [f"{name}.position" for name in names])
    return Drive(
        law,
        takes,
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
    """Adds and connects an ActuationPath for each model that needs one: {model: ports}.

    Args: command_delays: whether delays of commands are simulated.
    Raises: ValueError for an effect on a joint without an actuator.
    """
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
        gear = _gear(plant, model) if numbers[SHARE].any() else None
        system = ActuationPath(
            numbers,
            plant.time_step(),
            drive,
            plant.num_multibody_states(),
            [motor is not None for motor in motors],
            gear,
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
            for name in drive.takes:
                setattr(ports, name, delayed(name))
        if drive is not None or gear is not None:
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
    # An effect that acts on no actuator at all.
    for effect in effects:
        if KINDS[effect.kind].path and not any(
            actuator_of(plant, joint) for joint in find_joints(effect, plant)
        ):
            raise ValueError(
                f"effect {effect.kind} at {effect.at}: nothing drives a joint there"
            )
    return paths
