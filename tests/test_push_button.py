"""A button in Meshcat pushes the tool."""

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from test_run_buttons import press

from makebreak.diagrams.station import ARM, StationConfig, make_station
from makebreak.diagrams.wiring import add_generalized_forces
from makebreak.systems.faults.fault_forces import BodyForce
from makebreak.systems.views.push_button import FORCE, LASTS_SEC, PUSH, PushButton

MASS = 2.0


def test_each_press_gives_its_impulse_from_another_side():
    meshcat, builder = Meshcat(), DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.001))
    inertia = SpatialInertia(MASS, np.zeros(3), UnitInertia.SolidSphere(0.1))
    body = plant.AddRigidBody("body", inertia)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    button = builder.AddSystem(PushButton(meshcat))
    force = builder.AddSystem(BodyForce(plant, body))
    builder.Connect(plant.get_state_output_port(), force.GetInputPort("state"))
    builder.Connect(button.get_output_port(), force.GetInputPort("force"))
    add_generalized_forces(builder, plant, [force.get_output_port()])
    simulator = Simulator(builder.Build())
    own = plant.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(0.5)
    np.testing.assert_array_equal(plant.GetVelocities(own), 0.0)
    dv, v = FORCE * LASTS_SEC / MASS, np.zeros(2)
    for presses, way in enumerate(([0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0])):
        press(meshcat, PUSH)
        simulator.AdvanceTo(0.5 + 0.4 * (presses + 1))
        v = v + dv * np.array(way)
        np.testing.assert_allclose(plant.GetVelocities(own)[3:5], v, atol=0.006 * dv)


def test_who_does_not_press_changes_nothing():
    ends = []
    for meshcat in (None, Meshcat()):
        station = make_station(StationConfig(sampled=True), meshcat)
        simulator = Simulator(station)
        context = simulator.get_mutable_context()
        torque = station.GetInputPort(f"{ARM}.torque_commanded")
        torque.FixValue(context, np.full(7, 0.3))
        simulator.AdvanceTo(0.1)
        ends.append(np.array(station.GetOutputPort("state").Eval(context)))
    np.testing.assert_array_equal(*ends)
