"""Loads a scene, the description of a world or of a model, into a Drake plant.

scene_schema.py has the sections of a scene file, scene_reader.py reads it, drives.py
has the actuation; here the plant is built.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    ApplyMultibodyPlantConfig,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.primitives import Adder

from makebreak.models.drives import (
    CHANNEL_STEPS,
    actuators_of_model,
    add_actuators,
    add_paths,
    path_numbers,
    step_or_default,
)
from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import SHARE, TIME_CONSTANT, PathPorts
from makebreak.models.effects.body_forces import BodyForces
from makebreak.models.effects.change_shape import bound_half_spaces
from makebreak.models.effects.delay_line import DelayLine, LagLine
from makebreak.models.effects.joint_forces import JointForces
from makebreak.models.effects.kind import (
    Effect,
    find_bodies,
    find_joints,
    find_pair,
    full_name,
    one_dof_joints,
)
from makebreak.models.effects.measured_channels import (
    ChannelMap,
    MeasuredChannels,
    channel_maps,
    check_channels,
)
from makebreak.models.effects.transmission import (
    Coupling,
    coupling_name,
    coupling_numbers,
    motor_joint,
)
from makebreak.models.friction_zones import add_friction_zones
from makebreak.models.joint_tree import carrier
from makebreak.models.model_files import (
    DRAKE_ERRORS,
    add_models,
    check_can_move,
    with_actuated_joints,
)
from makebreak.models.scene_reader import initial_for, read_scene
from makebreak.models.scene_schema import (
    ActuationSection,
    InitialSection,
    PlantSection,
    Scene,
    as_kind,
    check_scene,
)
from makebreak.models.typed_yaml import nearest, one_line
from makebreak.systems.numerics.body_laws import LAWS as BODY_LAWS
from makebreak.systems.numerics.body_laws import N_NUMBERS as N_BODY_NUMBERS
from makebreak.systems.numerics.body_laws import NO_BODY_LAWS, BodyLaws
from makebreak.systems.numerics.joint_laws import LAWS, N_NUMBERS, JointLaws

__all__ = [
    "CHANNEL_STEPS",
    "ActuationSection",
    "InitialSection",
    "LoadedScene",
    "PlantSection",
    "Scene",
    "actuators_of_model",
    "apply_initial_velocities",
    "initial_for",
    "load_scene",
    "path_numbers",
    "read_scene",
    "set_initial_velocities",
]


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in a diagram.

    effects: in the order of application: by rank, then as in the scene.
    paths: {model: ports} of the models that have an ActuationPath.
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
        """Input for a model's effort commands (n_u,) [N m]: of its actuation path, or
        the plant's own port.

        Raises: ValueError if the scene's drives take other commands.
        """
        path = self.paths.get(model)
        if path is None:
            return self.plant.get_actuation_input_port(
                self.plant.GetModelInstanceByName(model)
            )
        if path.command is None:
            raise ValueError(
                f"{model} takes other commands than efforts (the scene's actuation is "
                f"of type {self.scene.actuation.type})"
            )
        return path.command

    def effort_output_port(self, model: str) -> OutputPort | None:
        """The motors' effort (n_u,) [N m], before the plant's own limits. None if the
        model has no actuation path: then it is the command."""
        path = self.paths.get(model)
        return None if path is None else path.effort

    def measured_output_port(
        self, builder: DiagramBuilder, port: OutputPort, channels: Sequence[str]
    ) -> OutputPort:
        """`port` behind the scene's effects on sensors; the port itself if there are
        none. A clock_skew is not included: it changes the time stamps of a recording.

        Args: channels: names of the port's entries, `<model>.<joint>.position`, ...
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
        for lags in zip_longest(*(channel.lags for channel in each), fillvalue=0.0):
            # A lag below 0 reduces a recording's declared filter, not included here.
            slow = np.maximum(lags, 0.0)
            line = builder.AddSystem(LagLine(slow, step_or_default(self.plant)))
            builder.Connect(port, line.get_input_port())
            port = line.get_output_port()
        delays = [channel.delay for channel in each]
        if any(delays):
            line = builder.AddSystem(DelayLine(delays, step_or_default(self.plant)))
            builder.Connect(port, line.get_input_port())
            port = line.get_output_port()
        return port

    def motor_side(self, channels: Sequence[str]) -> dict[int, int]:
        """{entry: index in the plant's state} of channels that are measured at a motor
        behind an elastic transmission, instead of at its joint."""
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
        """Whether the scene's section `channels` has an entry for the channel, or for
        its last part, that begins with `link`."""
        sides = self.scene.channels
        side = sides.get(channel, sides.get(channel.rsplit(".", 1)[-1], ""))
        return side.strip().lower().startswith("link")

    def set_effects(
        self, root_context: Context, current: Sequence[Effect], new: Sequence[Effect]
    ) -> bool:
        """Changes the effects' parameters in a Context of the whole diagram.

        Args: current, new: effects like self.effects, with the same kinds and places;
            current: with the Context's present parameters.
        Returns: whether this is possible; if not, the Context is unchanged, and the
            scene has to be loaded again.
        Raises: ValueError for parameters out of range.
        """
        new = [as_kind(effect) for effect in new]
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
        if changed and _changes_new_values(new):
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
            if not path.path.has_gear and numbers[model][SHARE].any():
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
            numbers_of = [p for _, _, p in forces_on_bodies(new, plant)]
            self.body_forces.set_numbers(own, numbers_of)
        hidden = [effect for effect in new if KINDS[effect.kind].hidden_state]
        for system, effect in zip(self.couplings, hidden, strict=True):
            own = system.GetMyMutableContextFromRoot(root_context)
            system.set_numbers(own, coupling_numbers(effect, plant))
        for model, path in self.paths.items():
            own = path.path.GetMyMutableContextFromRoot(root_context)
            path.path.set_numbers(own, numbers[model])
        return True


def _changes_new_values(effects: Sequence[Effect]) -> bool:
    """Whether a body has both an effect with a new inertia and one that changes it: in
    a Context they cannot be combined."""
    new: set[str] = set()
    changed: set[str] = set()
    for effect in effects:
        kind = KINDS[effect.kind]
        if kind.edit_text is not None:
            is_change = all(each.neutral == 0.0 for each in kind.parameters)
            (changed if is_change else new).update(effect.at)
    return bool(new & changed)


def load_scene(
    scene: Scene | str | Path,
    builder: DiagramBuilder,
    command_delays: bool = True,
    before_finalize: Callable[[MultibodyPlant, SceneGraph], None] | None = None,
) -> LoadedScene:
    """Adds the scene's plant, with every effect applied, and its scene graph.

    The default Context is the scene's initial state, except velocities
    (apply_initial_velocities). Where effects need them, the plant's ports
    applied_generalized_force, applied_spatial_force and actuation are connected: use
    the ports of LoadedScene instead.

    Args: scene: or the path of its file; command_delays: False if the caller delays the
        commands itself; before_finalize: called with the plant once all models and
        effects are in it.
    Raises: ValueError that names what is wrong in the scene.
    """
    if not isinstance(scene, Scene):
        scene = read_scene(scene)
    check_scene(scene)
    scene = with_actuated_joints(scene)
    section = scene.plant
    config = MultibodyPlantConfig(
        time_step=section.time_step,
        contact_model=section.contact_model,
        discrete_contact_approximation=section.discrete_contact_approximation,
        # A controller at 1 kHz must read x[n] at t_n.
        use_sampled_output_ports=False,
    )
    if section.shapes:
        plant, scene_graph = AddMultibodyPlant(config, builder)
    else:
        plant = builder.AddNamedSystem("plant", MultibodyPlant(section.time_step))
        ApplyMultibodyPlantConfig(config, plant)
        scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    plant.mutable_gravity_field().set_gravity_vector(section.gravity)
    effects = sorted(
        (as_kind(effect) for effect in scene.effects),
        key=lambda effect: KINDS[effect.kind].rank,
    )
    add_models(scene, effects, plant)
    add_actuators(scene.actuation, plant)
    for effect in effects:
        before = KINDS[effect.kind].before_finalize
        if before is not None:
            for one in _of_each_pair(effect):
                before(one, plant, scene_graph)
    if before_finalize is not None:
        before_finalize(plant, scene_graph)
    try:
        plant.Finalize()
    except DRAKE_ERRORS as error:  # Such as a loop of welds.
        raise ValueError(f"scene's directives: {one_line(error)}") from None
    bound_half_spaces(plant, scene_graph)
    for effect in effects:
        possible = KINDS[effect.kind].possible
        if possible is not None:
            possible(effect, plant, effects)
        if KINDS[effect.kind].channel:
            check_channels(effect, KINDS[effect.kind].channel, plant)
    check_can_move(plant)  # After the effects, whose own messages are better.
    for episodes in scene.initial_of.values():
        for state in episodes.values():
            _check_names(state, plant)
    _check_names(scene.initial, plant)
    _set_initial(scene.initial, effects, plant)
    if scene.initial.velocities or scene.initial.body_velocities:
        builder.AddNamedSystem(
            InitialVelocities.NAME, InitialVelocities(plant, scene.initial)
        )
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
            for one in _of_each_pair(effect):
                forces.append(after(one, plant, scene_graph, builder))
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
    paths = add_paths(scene.actuation, effects, plant, builder, command_delays)
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


def _of_each_pair(effect: Effect) -> list[Effect]:
    """An effect at several pairs, which are alike in it, as one at each."""
    if KINDS[effect.kind].at != "pair":
        return [effect]
    return [Effect(effect.kind, [at], effect.parameters) for at in effect.at]


def _joint_numbers(plant: MultibodyPlant, effects: Sequence[Effect]) -> list:
    return [
        kind.joint_numbers(effect, plant, joint)
        for effect in effects
        for kind in [KINDS[effect.kind]]
        if kind.joint_law is not None and kind.joint_numbers is not None
        for joint in find_joints(effect, plant)
    ]


def joint_laws(effects: Sequence[Effect], plant: MultibodyPlant) -> JointLaws:
    """The forces of effects on joints that are laws of the joint's own motion: dry
    friction, quadratic drag, ripple and springs.

    Args: plant: finalized, in which each joint has one velocity per position.
    """
    rows = [
        (joint.velocity_start(), LAWS.index(kind.joint_law), numbers)
        for effect in effects
        for kind in [KINDS[effect.kind]]
        if kind.joint_law is not None and kind.joint_numbers is not None
        for joint in find_joints(effect, plant)
        for numbers in [kind.joint_numbers(effect, plant, joint)]
    ]
    p = np.zeros((len(rows), N_NUMBERS))
    for row, (_, _, numbers) in zip(p, rows, strict=True):
        row[: len(numbers)] = numbers
    joint, kind = ([row[k] for row in rows] for k in (0, 1))
    return JointLaws(np.array(joint, np.int64), np.array(kind, np.int64), p)


def body_laws(effects: Sequence[Effect], plant: MultibodyPlant) -> BodyLaws:
    """The forces of effects on bodies that are laws of the body's own velocity.

    Args: plant: finalized, whose bodies are links of a tree of joints.
    """
    rows = [
        (*carrier(plant, body)[:2], BODY_LAWS.index(law), _padded(p, N_BODY_NUMBERS))
        for law, body, p in forces_on_bodies(effects, plant)
    ]
    if not rows:
        return NO_BODY_LAWS
    link, p_L, kind, p = zip(*rows, strict=True)
    return BodyLaws(
        np.array(link, np.int64), np.array(p_L), np.array(kind, np.int64), np.array(p)
    )


def _padded(numbers: Sequence[float], n: int) -> np.ndarray:
    return np.append(numbers, np.zeros(n - len(numbers)))


def forces_on_bodies(effects: Sequence[Effect], plant: MultibodyPlant) -> list[tuple]:
    """(law, body, its numbers) of each body that effects pull at."""
    return [
        (kind.body_law, body, kind.body_numbers(effect))
        for effect in effects
        for kind in [KINDS[effect.kind]]
        if kind.body_law is not None and kind.body_numbers is not None
        for body in find_bodies(effect, plant)
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
    on = forces_on_bodies(effects, plant)
    if not on:
        return None
    system = BodyForces(*zip(*on, strict=True))
    builder.AddNamedSystem("body_forces", system)
    builder.Connect(
        plant.get_body_spatial_velocities_output_port(),
        system.GetInputPort("body_spatial_velocities"),
    )
    builder.Connect(
        system.get_output_port(), plant.get_applied_spatial_force_input_port()
    )
    return system


class InitialVelocities(LeafSystem):
    """Stores the scene's initial velocities in the diagram, for the caller to apply:
    Drake has no default velocities, and a system cannot write another's state."""

    NAME = "initial_velocities"

    def __init__(self, plant: MultibodyPlant, initial: InitialSection):
        super().__init__()
        self._plant, self._initial = plant, initial

    def apply(self, root_context: Context) -> None:
        """Sets the plant's velocities in a Context of the whole diagram."""
        own = self._plant.GetMyMutableContextFromRoot(root_context)
        _set_velocities(self._initial, self._plant, own)


def apply_initial_velocities(diagram: Diagram, root_context: Context) -> None:
    """Sets the initial velocities of all scenes in a diagram, which are not part of its
    default Context.

    Args: diagram: the whole one; root_context: its Context.
    """
    for system in diagram.GetSystems():
        if isinstance(system, InitialVelocities):
            system.apply(root_context)
        elif isinstance(system, Diagram):
            apply_initial_velocities(system, root_context)


def set_initial_velocities(loaded: LoadedScene, plant_context: Context) -> None:
    """Sets the scene's initial velocities in the plant's own Context."""
    _set_velocities(loaded.scene.initial, loaded.plant, plant_context)


def _set_velocities(
    initial: InitialSection, plant: MultibodyPlant, plant_context: Context
) -> None:
    for name, value in initial.velocities.items():
        joint = _one_dof(plant, name, "velocities")
        v = plant.GetVelocities(plant_context)
        v[joint.velocity_start()] = value
        motor = motor_joint(plant, joint)
        if motor is not None:
            v[motor.velocity_start()] = value
        plant.SetVelocities(plant_context, v)
    for name, twist in initial.body_velocities.items():
        plant.SetFreeBodySpatialVelocity(
            context=plant_context,
            body=_free_body(plant, name, "body_velocities"),
            V_JpJc=SpatialVelocity(twist[:3], twist[3:]),
        )


def _set_initial(
    initial: InitialSection, effects: Sequence[Effect], plant: MultibodyPlant
) -> None:
    """Sets the default positions. The scene has measured values, so effects on sensors
    are inverted."""
    channels = [f"{name}.position" for name in initial.positions]
    channels += [f"{name}.{axis}" for name in initial.poses for axis in "xyz"]
    maps = channel_maps(effects, CHANNEL_STEPS, channels)

    def true(channel: str, value: float) -> float:
        return maps[channel].true_value(value) if channel in maps else value

    for name, value in initial.positions.items():
        joint = _one_dof(plant, name, "positions")
        value = true(f"{name}.position", value)
        joint.set_default_positions([value])
        motor = motor_joint(plant, joint)
        if motor is not None:
            motor.set_default_positions([value])
    for name, pose in initial.poses.items():
        body = _free_body(plant, name, "poses")
        unit = np.array(pose[:4]) / np.linalg.norm(pose[:4])
        p_WB = [true(f"{name}.{a}", x) for a, x in zip("xyz", pose[4:], strict=True)]
        plant.SetDefaultFloatingBaseBodyPose(
            body, RigidTransform(Quaternion(unit), p_WB)
        )


def _check_names(initial: InitialSection, plant: MultibodyPlant) -> None:
    """Raises: ValueError for an unknown joint or body, or one of another type."""
    for section in ("positions", "velocities"):
        for name in getattr(initial, section):
            _one_dof(plant, name, section)
    for section in ("poses", "body_velocities"):
        for name in getattr(initial, section):
            _free_body(plant, name, section)


def _one_dof(plant: MultibodyPlant, name: str, section: str):
    joint = _find(plant, name, "joint")
    if joint.num_positions() != 1:
        raise ValueError(
            f"initial.{section}: joint {name!r} has {joint.num_positions()} positions, "
            "expected a joint that turns or slides"
        )
    return joint


def _free_body(plant: MultibodyPlant, name: str, section: str):
    body = _find(plant, name, "body")
    if not body.is_floating_base_body():
        free = [full_name(plant, plant.get_body(i)) for i in
                sorted(plant.GetFloatingBaseBodies(), key=int)]  # fmt: skip
        raise ValueError(
            f"initial.{section}: body {name!r} is not free to move; "
            f"free are: {', '.join(free) or 'none'}"
        )
    return body


def _find(plant: MultibodyPlant, name: str, what: str):
    """The joint or body with the name `<model>.<name>`. Raises: ValueError."""
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
