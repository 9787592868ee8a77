"""Does the puck come to its goal if its mass is unknown? Eight trials on all cores."""

import os

import numpy as np
from joblib import Parallel, delayed
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak import ContactMpcConfig, ContactPair, make_contact_mpc, model_path
from makebreak.scripts.runner.sweep import rate_text


def trial(seed):
    """The world's mass over the model's, and where the puck is after 4 s."""
    share = np.random.default_rng(seed).uniform(0.5, 3.0)
    builders = []
    for time_step in (0.0, 0.001):  # The model, and the world.
        builders.append(builder := DiagramBuilder())
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
        Parser(plant).AddModels(model_path("puck.sdf"))
        plant.Finalize()
    puck = plant.GetBodyByName("puck")
    pairs = [ContactPair("finger", "puck", friction=0.3)]
    Q, x_desired = [0, 200, 1, 20], [0.4, 0.5, 0, 0]
    config = ContactMpcConfig(pairs, Q, R=[0.01], x_desired=x_desired)
    mpc = builder.AddSystem(make_contact_mpc(builders[0].Build(), config))
    builder.Connect(plant.get_state_output_port(), mpc.GetInputPort("x"))
    builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_mutable_context())
    puck.SetMass(context, share * puck.default_mass())
    simulator.AdvanceTo(4.0)
    return share, plant.GetPositions(context)[1]


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    # Processes that are forked: what pydrake is made of cannot be sent to others.
    run = Parallel(n_jobs=-1, backend="multiprocessing")
    found = run(delayed(trial)(seed) for seed in range(8))
    for share, place in sorted(found):
        print(f"mass {share:.2f} times the model's: puck at {place:.3f} m")
    print("within 1 cm:", rate_text(sum(abs(p - 0.5) < 0.01 for _, p in found), 8))
