"""push_a_puck.py with a puck of three times the mass, which is learned on the way."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import makebreak as mb

text = open(mb.model_path("puck.sdf")).read()
builders = []  # The model's, and the world's.
for time_step, sdf in ((0.0, text), (0.001, text.replace("<mass>0.5", "<mass>1.5"))):
    builders.append(world := DiagramBuilder())
    plant, _ = AddMultibodyPlantSceneGraph(world, time_step)
    Parser(plant).AddModelsFromString(sdf, "sdf")
    plant.Finalize()
pairs = [mb.ContactPair("finger", "puck", 0.3)]
parameters = [  # What may be wrong, and how far: a mass by a factor of 1.6 or so.
    mb.Parameter("mass", 0.5, "puck"),
    mb.Parameter("damping", 0.5, "puck_rail"),
    mb.Parameter("gap", 0.003, pairs=[0]),
]
Q, x_desired = [0, 200, 1, 20], [0.4, 0.5, 0, 0]  # As in push_a_puck.py.
config = mb.ContactMpcConfig(pairs, Q, [0.01], x_desired, period_sec=0.05)
config.parameters = parameters  # The plan is for the values that are learned.
mpc = world.AddSystem(mb.make_contact_mpc(model := builders[0].Build(), config))
config = mb.ParameterLearnerConfig(pairs, parameters)
learner = world.AddSystem(mb.ParameterLearner(model, config, 0.05, offset_sec=5e-5))
for system in (mpc, learner):
    world.Connect(plant.get_state_output_port(), system.GetInputPort("x"))
world.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
world.Connect(mpc.GetOutputPort("u"), learner.GetInputPort("u_measured"))
world.Connect(learner.GetOutputPort("parameters"), mpc.GetInputPort("parameters"))
simulator = Simulator(world.Build())
simulator.AdvanceTo(4.0)
q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
print(f"puck at {q[1]:.3f} m")
context = learner.GetMyContextFromRoot(simulator.get_context())
for row in learner.learned(context):
    print(f"{row.name}: {row.learned:.4f} ({row.low:.4f} to {row.high:.4f})")
