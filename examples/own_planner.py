"""An own planner in place of C3: random shooting on the LCS of the builder."""

import numpy as np
from pydrake.all import (
    AbstractValue,
    AddMultibodyPlantSceneGraph,
    DiagramBuilder,
    LeafSystem,
    Parser,
    Simulator,
)

import makebreak as mb

Q, GOAL, N = np.array([0, 200, 1, 20]), np.array([0.4, 0.5, 0, 0]), 10


class RandomShooting(LeafSystem):  # C3Mpc has these ports, too, so either fits.
    def __init__(self, lcs):
        super().__init__()
        self.lcs = self.DeclareAbstractInputPort("lcs", AbstractValue.Make(lcs))
        self.x = self.DeclareVectorInputPort("x", len(Q))
        self.plan = self.DeclareDiscreteState(N)  # All memory is in the Context.
        self.DeclareVectorOutputPort("u", 1, self.first)
        self.DeclarePeriodicDiscreteUpdateEvent(0.05, 1e-3, self.update)

    def first(self, context, u):
        u.SetFromVector(context.get_discrete_state(self.plan).value()[:1])

    def update(self, context, state):
        lcs, x = self.lcs.Eval(context), self.x.Eval(context)
        rng = np.random.default_rng(round(1e3 * context.get_time()))
        mean = np.append(context.get_discrete_state(self.plan).value()[1:], 0.0)
        for spread in (2.0, 0.5):  # The best of many, then of those near it.
            tries = mean + spread * rng.normal(size=(60, N))
            tries[0] = mean
            mean = min(tries, key=lambda u: self.cost(lcs, x, u))
        state.set_value(self.plan, mean)

    def cost(self, lcs, x, u):
        total = 0.01 * u @ u
        for u_k in u:
            x, _ = mb.simulate(lcs, x, np.array([u_k]))
            total += (x - GOAL) @ (Q * (x - GOAL))
        return total


builders = []
for time_step in (0.0, 0.001):  # The controller's model, and the world.
    builders.append(builder := DiagramBuilder())
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    Parser(plant).AddModels(mb.model_path("puck.sdf"))
    plant.Finalize()
pairs = [mb.ContactPair("finger", "puck", 0.3)]
config = mb.LcsBuilderConfig(pairs, 0.05, period_sec=0.05)
lcs = builder.AddSystem(mb.AnitescuLcsBuilder(builders[0].Build(), config))
lcs_here = lcs.model.build(lcs.model.x_default, [0.0])
planner = builder.AddSystem(RandomShooting(lcs_here))
builder.Connect(plant.get_state_output_port(), lcs.GetInputPort("x"))
builder.Connect(plant.get_state_output_port(), planner.GetInputPort("x"))
builder.Connect(planner.GetOutputPort("u"), lcs.GetInputPort("u"))
builder.Connect(lcs.GetOutputPort("lcs"), planner.GetInputPort("lcs"))
builder.Connect(planner.GetOutputPort("u"), plant.get_actuation_input_port())
simulator = Simulator(builder.Build())
simulator.AdvanceTo(4.0)
q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
print(f"puck at {q[1]:.3f} m")
