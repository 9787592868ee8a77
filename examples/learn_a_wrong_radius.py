"""The puck is 8 mm smaller than modelled: the residual learner finds the gap."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

import makebreak as mb

text = open(mb.model_path("puck.sdf")).read()
puck = text.rindex("<link name")  # Its radius alone.
smaller = text[:puck] + text[puck:].replace("0.05", "0.042")
builders = []
for time_step, sdf in ((0.0, text), (0.001, smaller)):  # The model, and the world.
    builders.append(builder := DiagramBuilder())
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModelsFromString(sdf, "sdf")
    plant.Finalize()
pairs = [mb.ContactPair("finger", "puck", 0.3)]
config = mb.LcsBuilderConfig(pairs, dt_sec=0.05, period_sec=0.05)
lcs = builder.AddSystem(mb.AnitescuLcsBuilder(builders[0].Build(), config))
lcs_0 = lcs.model.build(lcs.model.x_default, [0.0])
config = mb.ResidualLearnerConfig(Q_d=[0, 0, 1e4, 1e4], eps=1e-3, groups=[[0, 1, 2, 3]])
config.posterior = mb.PosteriorConfig()  # Q_d: velocities are predicted to 1 cm/s.
learner = builder.AddSystem(mb.ResidualLearner(config, lcs_0, 0.05, offset_sec=1e-3))
push = builder.AddSystem(ConstantVectorSource([3.0])).get_output_port()
builder.Connect(push, plant.get_actuation_input_port())
builder.Connect(push, lcs.GetInputPort("u"))
builder.Connect(push, learner.GetInputPort("u_measured"))
builder.Connect(plant.get_state_output_port(), lcs.GetInputPort("x"))
builder.Connect(plant.get_state_output_port(), learner.GetInputPort("x"))
builder.Connect(lcs.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
simulator = Simulator(builder.Build())
simulator.AdvanceTo(4.0)
context = learner.GetMyContextFromRoot(simulator.get_context())
r, std = (learner.GetOutputPort(name).Eval(context)[0] for name in ("r_comp", "r_std"))
print(f"the gap is {50 * r:.1f} mm (+- {50 * std:.1f} mm) larger than modelled")
