"""Helpers that several diagrams share: connections, and settings that they compute."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from operator import attrgetter
from typing import Any, TypeVar

from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort, System
from pydrake.systems.primitives import Adder, Selector, SelectorParams

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
    sizes = {into: reference.GetOutputPort(name).size() for name, into in (
        ("x_desired", "x_desired"), ("wrench", "wrench_feedforward"))}  # fmt: skip
    parts = split(builder, reference.GetOutputPort("command"), "arm_command", sizes)
    for name, port in parts.items():
        builder.Connect(port, arm.GetInputPort(name))


def split(
    builder: DiagramBuilder, port: OutputPort, name: str, sizes: Mapping[str, int]
) -> dict[str, OutputPort]:
    """The parts of a port, one after the other, by name.

    Drake's Demultiplexer would count as changed whenever time goes on, and all that
    reads its parts be computed anew.

    Args: name: of the system that is added, before "_split"; sizes: {part: size}.
    """
    at, outputs = 0, []
    for part, size in sizes.items():
        entries = [
            SelectorParams.OutputSelection(input_port_index=0, input_offset=at + i)
            for i in range(size)
        ]
        outputs.append(SelectorParams.OutputPortParams(name=part, selections=entries))
        at += size
    whole = SelectorParams.InputPortParams(name="whole", size=port.size())
    params = SelectorParams(inputs=[whole], outputs=outputs)
    parts = builder.AddNamedSystem(f"{name}_split", Selector(params))
    builder.Connect(port, parts.get_input_port(0))
    return {part: parts.GetOutputPort(part) for part in sizes}


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
