"""push_a_puck.py with a puck that is 8 mm smaller than modelled, which is learned."""

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import makebreak as mb

text = open(mb.model_path("puck.sdf")).read()
puck = text.rindex("<link name")  # Its radius alone.
smaller = text[:puck] + text[puck:].replace("0.05", "0.042")
builders = []
for time_step, sdf in ((0.0, text), (0.001, smaller)):  # The model, and the world.
    builders.append(world := DiagramBuilder())
    plant, _ = AddMultibodyPlantSceneGraph(world, time_step)
    Parser(plant).AddModelsFromString(sdf, "sdf")
    plant.Finalize()
pairs = [mb.ContactPair("finger", "puck", 0.3)]
Q, x_desired = [0, 200, 1, 20], [0.4, 0.5, 0, 0]  # As in push_a_puck.py.
config = mb.ContactMpcConfig(pairs, Q, [0.01], x_desired, period_sec=0.05)
mpc = world.AddSystem(mb.make_contact_mpc(model := builders[0].Build(), config))
config = mb.ResidualLearnerConfig(Q_d=[0, 0, 1e4, 1e4], eps=1e-3, groups=[[0, 1, 2, 3]])
config.posterior = mb.PosteriorConfig()  # Q_d: velocities are predicted to 1 cm/s.
lcs = mb.AnitescuLcs(model, pairs, dt_sec=0.05).at_default()
learner = world.AddSystem(mb.ResidualLearner(config, lcs, 0.05, offset_sec=5e-5))
for system in (mpc, learner):
    world.Connect(plant.get_state_output_port(), system.GetInputPort("x"))
world.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
world.Connect(mpc.GetOutputPort("u"), learner.GetInputPort("u_measured"))
world.Connect(mpc.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
world.Connect(learner.GetOutputPort("r_comp"), mpc.GetInputPort("r_comp"))
simulator = Simulator(world.Build())
simulator.AdvanceTo(4.0)
q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
context = learner.GetMyContextFromRoot(simulator.get_context())
r, std = (learner.GetOutputPort(name).Eval(context)[0] for name in ("r_comp", "r_std"))
print(f"puck at {q[1]:.3f} m; the gap is {50 * r:.1f} (+- {50 * std:.1f}) mm larger")
