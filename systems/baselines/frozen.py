"""A system that says for ever what another one says before its first update."""

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import LeafSystem, PortDataType


class Frozen(LeafSystem):
    """The ports of `system`, and on each output what that has in its default context.

    For finding out what a system contributes. Inputs are read by nobody. Outputs that
    are not functions of state alone cannot be frozen.

    Raises: ValueError for a system whose outputs need its inputs.
    """

    def __init__(self, system: LeafSystem):
        super().__init__()
        context = system.CreateDefaultContext()
        self._kept = system  # Values of its ports may refer to it.
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
