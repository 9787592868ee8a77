"""Ablation of any system: its outputs stay as they are before the first update."""

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem, PortDataType


class Frozen(LeafSystem):
    """A system with the ports of `system`, whose outputs are constant: their values in
    the default context. Inputs are ignored.

    Raises: ValueError if an output depends on an input.
    """

    def __init__(self, system: LeafSystem):
        super().__init__()
        context = system.CreateDefaultContext()
        self._system = system  # Kept alive: values of its ports may refer to it.
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if port.get_data_type() == PortDataType.kVectorValued:
                self.DeclareVectorInputPort(port.get_name(), port.size())
            else:
                model = AbstractValue.Make(object())
                self.DeclareAbstractInputPort(port.get_name(), model)
        for i in range(system.num_output_ports()):
            port = system.get_output_port(i)
            try:
                value = port.Eval(context)
            except RuntimeError as error:
                raise ValueError(
                    f"{system.get_name()} cannot be frozen: its output "
                    f"{port.get_name()} needs an input"
                ) from error
            if port.get_data_type() == PortDataType.kVectorValued:
                self.DeclareVectorOutputPort(
                    port.get_name(),
                    port.size(),
                    lambda _, output, value=value: output.SetFromVector(value),
                    {self.nothing_ticket()},
                )
            else:
                self.DeclareAbstractOutputPort(
                    port.get_name(),
                    lambda value=value: AbstractValue.Make(value),
                    lambda _, output, value=value: output.set_value(value),
                    {self.nothing_ticket()},
                )
