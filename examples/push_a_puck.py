"""A finger pushes a puck to 0.5 m: any plant and its contacts, planned by C3Mpc."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak import ContactMpcConfig, ContactPair, make_contact_mpc, model_path


def add_puck(builder, time_step):
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModels(model_path("puck.sdf"))
    plant.Finalize()
    return plant


model, world = DiagramBuilder(), DiagramBuilder()
add_puck(model, time_step=0.0)
plant = add_puck(world, time_step=0.001)
pairs = [ContactPair("finger", "puck", friction=0.3)]
Q, x_desired = [0, 200, 1, 20], [0.4, 0.5, 0, 0]  # Finger, puck, their velocities.
config = ContactMpcConfig(pairs, Q, R=[0.01], x_desired=x_desired)
mpc = world.AddSystem(make_contact_mpc(model.Build(), config))
world.Connect(plant.get_state_output_port(), mpc.GetInputPort("x"))
world.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
simulator = Simulator(world.Build())
simulator.AdvanceTo(4.0)
q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
print(f"puck at {q[1]:.3f} m")
