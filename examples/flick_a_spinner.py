"""A two-link finger turns a spinner by 3 rad: it swings, flicks it by friction, brakes
it, and pushes it back where it went too far. Nobody tells C3 when to touch."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak import ContactMpcConfig, ContactPair, make_contact_mpc, model_path

builders = []
for time_step in (0.0, 0.001):  # The controller's model, and the world.
    builders.append(builder := DiagramBuilder())
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModels(model_path("spinner.sdf"))
    plant.Finalize()

pairs = [ContactPair("finger", "disc", friction=0.5)]
Q = [1, 1, 100, 0.1, 0.1, 1]  # Shoulder, elbow, pivot, their velocities.
config = ContactMpcConfig(pairs, Q, R=[0.01] * 2, x_desired=[0, 0, 3, 0, 0, 0])
mpc = builder.AddSystem(make_contact_mpc(builders[0].Build(), config))
builder.Connect(plant.get_state_output_port(), mpc.GetInputPort("x"))
builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
simulator = Simulator(builder.Build())
own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
plant.SetPositions(own, [0.1, 0.1, 0.0])
simulator.AdvanceTo(5.0)
angle, rate = plant.GetPositions(own)[2], plant.GetVelocities(own)[2]
print(f"spinner at {angle:.3f} rad, turning at {rate:.3f} rad/s")
