"""Helpers that several diagrams share: connections, and settings that they compute."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from operator import attrgetter
from typing import Any, TypeVar

from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort, System
from pydrake.systems.primitives import Adder, Demultiplexer

from makebreak.systems.views.legend import Legend, LegendConfig

_Config = TypeVar("_Config")


def refuse_changed(name: str, part: Any, keys: Sequence[str]) -> None:
    """Raises: ValueError if one of the settings `keys` of a config is not the default:
    the diagram computes it, so a user's value would have no effect."""
    plain = type(part)()
    for key in keys:
        value, default = getattr(part, key), getattr(plain, key)
        if value != default:
            raise ValueError(
                f"{name}.{key} is {value}, expected {default}: the diagram sets it"
            )


def refuse_unused(config: Any, default: Any, setting: str, why: str) -> None:
    """Raises: ValueError if a setting, or one below it, is not the default although
    nothing reads it. Args: setting: its name, as in --set; why: nothing reads it."""
    part, plain = (attrgetter(setting)(each) for each in (config, default))
    if is_dataclass(part) and type(part) is type(plain):
        for field in fields(part):
            refuse_unused(config, default, f"{setting}.{field.name}", why)
    elif part != plain:
        raise ValueError(f"{setting} is {part}, expected {plain}: {why}")


def check_own(config: Any, own: Mapping[str, Sequence[str]]) -> None:
    """refuse_changed for parts of a config. Args: own: {field: keys}."""
    for name, keys in own.items():
        refuse_changed(name, getattr(config, name), keys)


def timed(part: _Config, period: float, offset: float) -> _Config:
    """A system's config with the diagram's period and offset [s]. Raises: ValueError if
    the config has its own."""
    refuse_changed(type(part).__name__, part, ("period_sec", "offset_sec"))
    changed: Any = part
    return replace(changed, period_sec=period, offset_sec=offset)


def connect(
    builder: DiagramBuilder, source: System, output: str, target: System, port: str
) -> None:
    """Connects an output port to an input port, both by name."""
    builder.Connect(source.GetOutputPort(output), target.GetInputPort(port))


def connect_command(
    builder: DiagramBuilder, reference: LeafSystem, arm: LeafSystem
) -> None:
    """Connects an ArmReference to an ImpedanceController. Pose and wrench share a port,
    as evaluating a Python system's port takes longer than computing its value."""
    sizes = [reference.GetOutputPort(name).size() for name in ("x_desired", "wrench")]
    split = builder.AddNamedSystem("arm_command_split", Demultiplexer(sizes))
    builder.Connect(reference.GetOutputPort("command"), split.get_input_port())
    for i, name in enumerate(("x_desired", "wrench_feedforward")):
        builder.Connect(split.get_output_port(i), arm.GetInputPort(name))


def add_legend(
    builder: DiagramBuilder,
    meshcat: Meshcat,
    config: LegendConfig,
    phase: OutputPort | None = None,
) -> None:
    """Adds a legend beside a view. Args: phase (1,): index into config.phases."""
    legend = builder.AddNamedSystem("legend", Legend(config, meshcat))
    if phase is not None:
        builder.Connect(phase, legend.GetInputPort("phase"))


def add_generalized_forces(
    builder: DiagramBuilder, plant: MultibodyPlant, forces: Sequence[OutputPort]
) -> None:
    """Adds generalized forces (n_v,) to those that the scene applies to a plant."""
    if not forces:
        return
    into = plant.get_applied_generalized_force_input_port()
    ports = list(forces)
    before = builder.connection_map().get((plant, into.get_index()))
    if before is not None:  # (system, port)
        ports.append(before[0].get_output_port(before[1]))
        builder.Disconnect(ports[-1], into)
    total = builder.AddSystem(Adder(len(ports), plant.num_velocities()))
    for i, port in enumerate(ports):
        builder.Connect(port, total.get_input_port(i))
    builder.Connect(total.get_output_port(), into)
