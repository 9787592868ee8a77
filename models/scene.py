"""Scenes: what a world, or a model of it, consists of. YAML in, a Drake plant out."""

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    ModelDirective,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, InputPort, OutputPort
from pydrake.systems.primitives import Adder

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
from makebreak.models.effects.body_forces import BodyForces
from makebreak.models.effects.delay_line import DelayLine
from makebreak.models.effects.joint_forces import JointForces
from makebreak.models.effects.kind import (
    Effect,
    actuator_of,
    check_parameters,
    find_bodies,
    find_joints,
    find_pair,
    full_name,
    model_names,
    one_dof_joints,
)
from makebreak.models.effects.measured_channels import (
    ChannelMap,
    MeasuredChannels,
    channel_maps,
    check_channels,
)
from makebreak.models.effects.model_text import edited_model_file
from makebreak.models.effects.transmission import (
    Coupling,
    coupling_name,
    coupling_numbers,
    motor_joint,
)
from makebreak.models.friction_zones import (
    FrictionZone,
    add_friction_zones,
    check_zones,
)

ACTUATIONS = ("effort", "pd", "none")
CHANNEL_STEPS = {name: kind.channel for name, kind in KINDS.items() if kind.channel}


@dataclass
class PlantSection:
    time_step: float = 0.001  # [s]; 0 is continuous.
    contact_model: str = "point"
    discrete_contact_approximation: str = "lagged"
    gravity: list[float] = field(default_factory=lambda: [0.0, 0.0, -9.81])  # [m/s2]


@dataclass
class ActuationSection:
    """Who drives the joints. The effort of type pd is
    kp (position_command - position) + kd (velocity_command - velocity)."""

    type: str = "none"  # effort, pd or none.
    joints: list[str] = field(default_factory=list)
    kp: list[float] = field(default_factory=list)  # [N m/rad] or [N/m]
    kd: list[float] = field(default_factory=list)  # [N m s/rad] or [N s/m]
    hold: str = "zero_order"
    rate_hz: float = 1000.0


@dataclass
class InitialSection:
    """Named `<model>.<joint>` and `<model>.<body>`; bodies in the world's axes."""

    positions: dict[str, float] = field(default_factory=dict)  # [rad] or [m]
    velocities: dict[str, float] = field(default_factory=dict)  # [rad/s] or [m/s]
    poses: dict[str, list[float]] = field(default_factory=dict)  # [qw qx qy qz x y z]
    body_velocities: dict[str, list[float]] = field(
        default_factory=dict
    )  # [wx wy wz vx vy vz]


@dataclass
class Scene:
    directives: list[ModelDirective] = field(default_factory=list)
    plant: PlantSection = field(default_factory=PlantSection)
    actuation: ActuationSection = field(default_factory=ActuationSection)
    initial: InitialSection = field(default_factory=InitialSection)
    # Recording's file name -> episode -> its initial state. In a file: `initial`, with
    # file names in place of positions, velocities, poses, body_velocities.
    initial_of: dict[str, dict[str, InitialSection]] = field(default_factory=dict)
    tolerance: dict[str, float] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    friction_zones: list[FrictionZone] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in a diagram.

    effects: as applied, those of lower rank first, else in the scene's order.
    paths: of each model between whose commands and joints something lies.
    """

    plant: MultibodyPlant  # Finalized.
    scene_graph: SceneGraph
    scene: Scene
    effects: tuple[Effect, ...]
    paths: dict[str, PathPorts]
    joint_forces: JointForces | None
    body_forces: BodyForces | None
    couplings: tuple[Coupling, ...]  # In the order of their effects.

    def command_input_port(self, model: str) -> InputPort:
        """Where effort commands of a model go in, (n_u,) [N m]: to the plant's own port
        if nothing lies between.

        Raises: ValueError if the scene's drives take positions.
        """
        path = self.paths.get(model)
        if path is None:
            return self.plant.get_actuation_input_port(
                self.plant.GetModelInstanceByName(model)
            )
        if path.command is None:
            raise ValueError(
                f"{model} takes position commands (the scene's actuation is of type pd)"
            )
        return path.command

    def effort_output_port(self, model: str) -> OutputPort | None:
        """The motors' effort (n_u,) [N m], before the plant's own limits. None if
        nothing lies between: then it is the command."""
        path = self.paths.get(model)
        return None if path is None else path.effort

    def measured_output_port(
        self, builder: DiagramBuilder, port: OutputPort, channels: Sequence[str]
    ) -> OutputPort:
        """`port` as the scene's sensors give it; the very same port if they add
        nothing. A clock_skew is in the time stamps of a recording, not in here.

        Args: channels: what each entry of the port is, `<model>.<joint>.position`, ...
        """
        maps = channel_maps(self.effects, CHANNEL_STEPS, channels)
        elastic = self.motor_side(channels)
        if not maps and not elastic:
            return port
        each = [maps.get(channel, ChannelMap()) for channel in channels]
        measured = MeasuredChannels(each, elastic, self.plant.num_multibody_states())
        builder.AddSystem(measured)
        builder.Connect(port, measured.GetInputPort("u"))
        if elastic:
            builder.Connect(
                self.plant.get_state_output_port(), measured.GetInputPort("state")
            )
        port = measured.GetOutputPort("y")
        delays = [channel.delay for channel in each]
        if any(delays):
            line = builder.AddSystem(DelayLine(delays, _period(self.plant)))
            builder.Connect(port, line.get_input_port())
            port = line.get_output_port()
        return port

    def motor_side(self, channels: Sequence[str]) -> dict[int, int]:
        """{entry: index in the plant's state} of channels that are measured at a motor
        and not at its joint, because the transmission gives way."""
        found = {}
        for joint in one_dof_joints(self.plant):
            motor = motor_joint(self.plant, joint)
            if motor is None:
                continue
            name, n_q = full_name(self.plant, joint), self.plant.num_positions()
            for what, index in (
                ("position", motor.position_start()),
                ("velocity", n_q + motor.velocity_start()),
            ):
                for i, channel in enumerate(channels):
                    if channel == f"{name}.{what}" and not self.is_link_side(channel):
                        found[i] = index
        return found

    def is_link_side(self, channel: str) -> bool:
        """Whether the scene's `channels` say so: an entry for the channel, or for its
        last part, that begins with `link`."""
        words = self.scene.channels
        said = words.get(channel, words.get(channel.rsplit(".", 1)[-1], ""))
        return said.strip().lower().startswith("link")

    def set_effects(
        self, root_context: Context, current: Sequence[Effect], new: Sequence[Effect]
    ) -> bool:
        """Gives the effects other parameters in a Context of the whole diagram.

        Args: current, new: effects like self.effects, of the same kinds at the same
            places; current are those whose parameters the Context has.
        Returns: whether that could be done; if not, the Context is as it was, and the
            scene has to be loaded anew.
        Raises: ValueError for bad parameters.
        """
        new = [_as_kind(effect) for effect in new]
        if [(e.kind, e.at) for e in new] != [(e.kind, e.at) for e in self.effects]:
            return False
        changed = {
            KINDS[b.kind]
            for a, b in zip(current, new, strict=True)
            if a.parameters != b.parameters
        }
        for kind in changed:
            if not (
                kind.joint_law
                or kind.body_law
                or kind.set_in_context
                or kind.hidden_state
                or kind.channel
                or kind.path
            ):
                return False
        if any(kind.path == "delay" for kind in changed) and any(
            path.systems[0] is not path.path for path in self.paths.values()
        ):
            return False
        plant = self.plant
        numbers = {model: path_numbers(plant, model, new)[0] for model in self.paths}
        for model, path in self.paths.items():
            if not path.path.has_lags and numbers[model][TIME_CONSTANT].any():
                return False
        plant_context = plant.GetMyMutableContextFromRoot(root_context)
        if any(kind.set_in_context for kind in changed):
            for old, effect in zip(current, new, strict=True):
                change = KINDS[effect.kind].set_in_context
                if change is not None:
                    change(old, effect, plant, plant_context)
        if self.joint_forces is not None:
            own = self.joint_forces.GetMyMutableContextFromRoot(root_context)
            self.joint_forces.set_numbers(own, _joint_numbers(plant, new))
        if self.body_forces is not None:
            own = self.body_forces.GetMyMutableContextFromRoot(root_context)
            self.body_forces.set_numbers(own, _body_numbers(plant, new))
        hidden = [effect for effect in new if KINDS[effect.kind].hidden_state]
        for system, effect in zip(self.couplings, hidden, strict=True):
            own = system.GetMyMutableContextFromRoot(root_context)
            system.set_numbers(own, coupling_numbers(effect, plant))
        for model, path in self.paths.items():
            own = path.path.GetMyMutableContextFromRoot(root_context)
            path.path.set_numbers(own, numbers[model])
        return True


def read_scene(path: str | Path) -> Scene:
    """The scene that a YAML or JSON file describes.

    Relative model files become absolute: they are relative to the scene's own folder.

    Raises: ValueError if the file is missing, or is not a scene.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"scene file {path} does not exist")
    try:
        raw = yaml_load(filename=str(path))
        for effect in raw.get("effects") or []:
            if isinstance(effect.get("at"), str):
                effect["at"] = [effect["at"]]  # The typed reader knows lists only.
        initial = raw.get("initial") or {}
        sections = {f.name for f in fields(InitialSection)}
        # A misspelt section has numbers below it, a file has episodes.
        if initial and all(
            key not in sections
            and isinstance(value, dict)
            and all(isinstance(part, dict) for part in value.values())
            for key, value in initial.items()
        ):
            raw["initial_of"] = {
                file: {str(episode): part for episode, part in episodes.items()}
                for file, episodes in raw.pop("initial").items()
            }
        scene = yaml_load_typed(schema=Scene, data=yaml_dump(raw))
    except Exception as error:  # The reader raises several kinds.
        raise ValueError(f"scene file {path}: {' '.join(str(error).split())}") from None
    for directive in scene.directives:
        for part in (directive.add_model, directive.add_directives):
            if part is not None and "://" not in part.file:
                # Not as_uri(): Drake does not decode %20.
                part.file = f"file://{(path.parent / part.file).resolve()}"
    _check(scene)
    return scene


def initial_for(scene: Scene, recording: str, episode: int | None) -> InitialSection:
    """The initial state of an episode (None: of a recording without episodes).

    Args: recording: name of its file, with or without its folder and suffix.
    """
    for name in (recording, Path(recording).name, Path(recording).stem):
        episodes = scene.initial_of.get(name, {})
        key = str(0 if episode is None else episode)
        if key in episodes:
            return episodes[key]
    return scene.initial


def load_scene(
    scene: Scene | str | Path, builder: DiagramBuilder, command_delays: bool = True
) -> LoadedScene:
    """Adds the scene's plant, with every effect applied, and its scene graph.

    What is added depends on the scene alone, and its default context is the scene's
    initial state. If an effect needs it, the plant's applied_generalized_force and
    applied_spatial_force ports are connected, and the actuation port of a model whose
    commands something lies in the way of: use the ports that LoadedScene tells.

    Args: scene, or the path of its file; command_delays, False if whoever commands
        delays the commands itself.
    Raises: ValueError, naming what in the scene is wrong.
    """
    if not isinstance(scene, Scene):
        scene = read_scene(scene)
    _check(scene)
    section = scene.plant
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=section.time_step,
            contact_model=section.contact_model,
            discrete_contact_approximation=section.discrete_contact_approximation,
            use_sampled_output_ports=False,  # A 1 kHz law must read x[n] at t_n.
        ),
        builder,
    )
    plant.mutable_gravity_field().set_gravity_vector(section.gravity)
    effects = sorted(
        (_as_kind(effect) for effect in scene.effects),
        key=lambda effect: KINDS[effect.kind].rank,
    )
    _parse(scene, effects, plant)
    _add_actuators(scene.actuation, plant)
    for effect in effects:
        before = KINDS[effect.kind].before_finalize
        if before is not None:
            before(effect, plant, scene_graph)
    plant.Finalize()
    for effect in effects:
        if KINDS[effect.kind].channel:
            check_channels(effect, KINDS[effect.kind].channel, plant)
    _set_initial(scene.initial, effects, plant)
    forces: list[OutputPort] = []
    joint_forces = _add_joint_forces(effects, plant, builder)
    if joint_forces is not None:
        forces.append(joint_forces.get_output_port())
    body_forces = _add_body_forces(effects, plant, builder)
    if scene.friction_zones:
        pair = Effect("contact_friction", [scene.friction_zones[0].at], {})
        now = KINDS[pair.kind].now
        assert now is not None
        add_friction_zones(
            scene.friction_zones,
            find_pair(pair, plant),
            now(pair, plant, scene_graph)["friction"],
            plant,
            builder,
            None if body_forces is None else body_forces.get_output_port(),
        )
    couplings = []
    for effect in effects:
        after = KINDS[effect.kind].after_finalize
        if after is not None:
            forces.append(after(effect, plant, scene_graph, builder))
        if KINDS[effect.kind].hidden_state:
            couplings.append(builder.GetSubsystemByName(coupling_name(effect)))
    if forces:
        total = forces[0]
        if len(forces) > 1:
            adder = builder.AddNamedSystem(
                "effect_forces", Adder(len(forces), plant.num_velocities())
            )
            for i, port in enumerate(forces):
                builder.Connect(port, adder.get_input_port(i))
            total = adder.get_output_port()
        builder.Connect(total, plant.get_applied_generalized_force_input_port())
    paths = _add_paths(scene.actuation, effects, plant, builder, command_delays)
    return LoadedScene(
        plant,
        scene_graph,
        scene,
        tuple(effects),
        paths,
        joint_forces,
        body_forces,
        tuple(couplings),
    )


def _as_kind(effect: Effect) -> Effect:
    """The effect, checked. Raises: ValueError."""
    if effect.kind not in KINDS:
        raise ValueError(
            f"effect kind {effect.kind!r} is unknown: {nearest(effect.kind, KINDS)}"
        )
    if not effect.at:
        raise ValueError(f"effect {effect.kind} needs `at`: where it acts")
    check_parameters(effect, KINDS[effect.kind])
    return effect


def _period(plant: MultibodyPlant) -> float:
    """Of the systems that sample beside the plant [s]."""
    return plant.time_step() or 0.001


def _add_actuators(actuation: ActuationSection, plant: MultibodyPlant) -> None:
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


def _joint_numbers(plant: MultibodyPlant, effects: Sequence[Effect]) -> list:
    return [
        kind.joint_numbers(effect, plant, joint)
        for effect in effects
        for kind in [KINDS[effect.kind]]
        if kind.joint_law is not None and kind.joint_numbers is not None
        for joint in find_joints(effect, plant)
    ]


def _body_numbers(plant: MultibodyPlant, effects: Sequence[Effect]) -> list:
    return [
        kind.body_numbers(effect)
        for effect in effects
        for kind in [KINDS[effect.kind]]
        if kind.body_law is not None and kind.body_numbers is not None
        for _ in find_bodies(effect, plant)
    ]


def _add_joint_forces(effects, plant: MultibodyPlant, builder: DiagramBuilder):
    on = [
        (KINDS[effect.kind].joint_law, joint)
        for effect in effects
        if KINDS[effect.kind].joint_law is not None
        for joint in find_joints(effect, plant)
    ]
    if not on:
        return None
    laws, joints = zip(*on, strict=True)
    system = JointForces(plant, laws, joints, _joint_numbers(plant, effects))
    builder.AddNamedSystem("joint_forces", system)
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    return system


def _add_body_forces(effects, plant: MultibodyPlant, builder: DiagramBuilder):
    on = [
        (KINDS[effect.kind].body_law, body)
        for effect in effects
        if KINDS[effect.kind].body_law is not None
        for body in find_bodies(effect, plant)
    ]
    if not on:
        return None
    laws, bodies = zip(*on, strict=True)
    system = BodyForces(laws, bodies, _body_numbers(plant, effects))
    builder.AddNamedSystem("body_forces", system)
    builder.Connect(
        plant.get_body_spatial_velocities_output_port(),
        system.GetInputPort("body_spatial_velocities"),
    )
    builder.Connect(
        system.get_output_port(), plant.get_applied_spatial_force_input_port()
    )
    return system


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


def _add_paths(
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
            line = DelayLine(delays, _period(plant))
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


def set_initial_velocities(loaded: LoadedScene, plant_context: Context) -> None:
    """Sets the scene's initial velocities: Drake has no default for them."""
    plant, initial = loaded.plant, loaded.scene.initial
    for name, value in initial.velocities.items():
        joint = _find(plant, name, "joint")
        v = plant.GetVelocities(plant_context)
        v[joint.velocity_start()] = value
        motor = motor_joint(plant, joint)
        if motor is not None:
            v[motor.velocity_start()] = value
        plant.SetVelocities(plant_context, v)
    for name, twist in initial.body_velocities.items():
        plant.SetFreeBodySpatialVelocity(
            context=plant_context,
            body=_find(plant, name, "body"),
            V_JpJc=SpatialVelocity(twist[:3], twist[3:]),
        )


def nearest(name: str, known: Iterable[str]) -> str:
    """What may have been meant by a wrong name, as the end of an error message."""
    known = sorted(known)
    close = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"


def _check(scene: Scene) -> None:
    if not scene.plant.time_step >= 0.0:
        raise ValueError(
            f"plant.time_step is {scene.plant.time_step}, expected 0 or more [s]"
        )
    if len(scene.plant.gravity) != 3:
        raise ValueError(f"plant.gravity is {scene.plant.gravity}, expected [x, y, z]")
    kind = scene.actuation.type
    if kind not in ACTUATIONS:
        raise ValueError(
            f"actuation.type is {kind!r}, expected one of {', '.join(ACTUATIONS)}"
        )
    if scene.actuation.hold != "zero_order":
        raise ValueError(
            f"actuation.hold is {scene.actuation.hold!r}, expected zero_order"
        )
    if not scene.actuation.rate_hz > 0.0:
        raise ValueError(
            f"actuation.rate_hz is {scene.actuation.rate_hz}, expected > 0"
        )
    for effect in scene.effects:
        _as_kind(effect)
    check_zones(scene.friction_zones)


def _parse(scene: Scene, effects: Sequence[Effect], plant: MultibodyPlant) -> None:
    """Adds the directives' models; inertia effects edit a copy of the model's text,
    as a body's default inertia can be given to Drake in no other way."""
    parser = Parser(plant)
    flat = FlattenModelDirectives(
        ModelDirectives(directives=scene.directives), parser.package_map()
    )
    with tempfile.TemporaryDirectory() as folder:
        for i, effect in enumerate(effects):
            edit = KINDS[effect.kind].edit_text
            if edit is None:
                continue
            for at in effect.at:
                model, _, body = at.partition(".")
                for directive in flat.directives:
                    add = directive.add_model
                    if add is not None and add.name == model:
                        # A copy: the scene must stay as it was.
                        copy = Path(folder) / f"{i}_{model}"
                        add.file = edited_model_file(
                            add.file, parser.package_map(), body, effect, edit, copy
                        )
                        break
                else:
                    raise ValueError(
                        f"effect {effect.kind} at {at!r}: no model {model!r} is added"
                    )
        try:
            ProcessModelDirectives(flat, parser)
        except RuntimeError as error:
            raise ValueError(
                f"scene's directives: {' '.join(str(error).split())}"
            ) from None


def _set_initial(
    initial: InitialSection, effects: Sequence[Effect], plant: MultibodyPlant
) -> None:
    """The initial values are measured ones: what sensors add is taken off."""
    channels = [f"{name}.position" for name in initial.positions]
    channels += [f"{name}.{axis}" for name in initial.poses for axis in "xyz"]
    maps = channel_maps(effects, CHANNEL_STEPS, channels)

    def true(channel: str, value: float) -> float:
        return maps[channel].true_value(value) if channel in maps else value

    for name, value in initial.positions.items():
        joint = _find(plant, name, "joint")
        value = true(f"{name}.position", value)
        joint.set_default_positions([value])
        motor = motor_joint(plant, joint)
        if motor is not None:
            motor.set_default_positions([value])
    for name, pose in initial.poses.items():
        if len(pose) != 7 or not abs(np.linalg.norm(pose[:4]) - 1.0) < 1e-3:
            raise ValueError(
                f"initial.poses of {name!r} is {pose}, expected 7 numbers "
                "[qw qx qy qz x y z] with a unit quaternion"
            )
        unit = np.array(pose[:4]) / np.linalg.norm(pose[:4])
        p_WB = [true(f"{name}.{a}", x) for a, x in zip("xyz", pose[4:], strict=True)]
        plant.SetDefaultFloatingBaseBodyPose(
            _find(plant, name, "body"), RigidTransform(Quaternion(unit), p_WB)
        )


def _find(plant: MultibodyPlant, name: str, what: str):
    """The joint or body called `<model>.<name>`."""
    indices = plant.GetJointIndices if what == "joint" else plant.GetBodyIndices
    get = plant.get_joint if what == "joint" else plant.get_body
    named = {}
    for i in range(plant.num_model_instances()):
        instance = ModelInstanceIndex(i)
        for index in indices(instance):
            element = get(index)
            key = f"{plant.GetModelInstanceName(instance)}.{element.name()}"
            named[key] = element
    if name not in named:
        raise ValueError(f"no {what} {name!r} in the scene: {nearest(name, named)}")
    return named[name]
