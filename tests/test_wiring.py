"""What several diagrams do alike."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from makebreak.diagrams.wiring import add_generalized_forces, check_own, split, timed


@dataclass
class Part:
    gain: float = 2.0
    period_sec: float = 0.1
    offset_sec: float = 0.0


@dataclass
class Whole:
    part: Part = field(default_factory=Part)


def test_a_part_gets_the_diagrams_times_and_keeps_its_own_settings():
    given = Part(gain=5.0)
    made = timed(given, 0.01, 0.002)
    assert made == Part(5.0, 0.01, 0.002) and given == Part(gain=5.0)


@pytest.mark.parametrize("key", ["period_sec", "offset_sec"])
def test_a_time_that_would_not_act_is_refused(key):
    with pytest.raises(ValueError, match=f"Part.{key} is 0.3, .*the diagram sets it"):
        timed(Part(**{key: 0.3}), 0.01, 0.002)


def test_a_setting_that_a_diagram_makes_of_others_is_refused():
    own = {"part": ("period_sec",)}
    check_own(Whole(Part(gain=7.0)), own)
    with pytest.raises(ValueError, match="part.period_sec is 0.2, expected 0.1"):
        check_own(Whole(Part(period_sec=0.2)), own)


def test_forces_are_added_to_those_that_a_plant_has():
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.001))
    inertia = SpatialInertia(2.0, np.zeros(3), UnitInertia.SolidSphere(0.1))
    plant.AddRigidBody("body", inertia)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    forces = np.zeros((4, 6))
    forces[:, 3:] = [[1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [4.0, 0, 0]]
    ports = [
        builder.AddSystem(ConstantVectorSource(f)).get_output_port() for f in forces
    ]
    builder.Connect(ports[0], plant.get_applied_generalized_force_input_port())
    for some in (ports[1:3], [], ports[3:]):
        add_generalized_forces(builder, plant, some)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.1)
    v = plant.GetVelocities(plant.GetMyContextFromRoot(simulator.get_context()))
    np.testing.assert_allclose(v[3:], 0.1 / 2.0 * forces[:, 3:].sum(axis=0), rtol=1e-9)


def test_parts_of_a_port_are_read_in_order_and_not_anew_when_time_goes_on():
    """Of Drake's Demultiplexer all that reads its parts is computed at each instant."""
    builder, computed = DiagramBuilder(), []
    whole = builder.AddSystem(LeafSystem())
    whole.DeclareStateOutputPort(
        "all", whole.DeclareDiscreteState(np.array([1.0, np.nan, 3.0]))
    )
    parts = split(builder, whole.get_output_port(), "both", {"one": 1, "two": 2})

    class Reader(LeafSystem):
        def __init__(self):
            super().__init__()
            self.two = self.DeclareVectorInputPort("two", 2)
            ticket = {self.two.ticket()}
            self.DeclareVectorOutputPort("y", 2, self.calc, ticket)

        def calc(self, context, output):
            computed.append(context.get_time())
            output.SetFromVector(self.two.Eval(context))

    reader = builder.AddSystem(Reader())
    builder.Connect(parts["two"], reader.two)
    builder.ExportOutput(reader.get_output_port(), "two")
    builder.ExportOutput(parts["one"], "one")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for time in (0.0, 0.5, 1.0):
        context.SetTime(time)
        two = diagram.GetOutputPort("two").Eval(context)
    np.testing.assert_array_equal(two, [np.nan, 3.0])
    assert diagram.GetOutputPort("one").Eval(context) == [1.0]
    assert computed == [0.0]
