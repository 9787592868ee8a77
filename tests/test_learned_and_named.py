"""What ParameterLearner learns while it works, and what `makebreak gap` names on the
recording of the same run, are the same within both deviations."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import makebreak as mb
from makebreak.benchmarks import parameter_learner as bench
from makebreak.benchmarks.plants import diagram_of
from makebreak.gap import run_gap

NINETY = bench.NINETY
ROW = 0.002  # Time between rows [s].
NOISE = 2e-5, 2e-3  # Of positions and velocities [SI].
TEXT = open(mb.model_path("puck.sdf")).read()
FACTS = {"mass": "<mass>0.5", "damping": r"(?s)<damping>5(?!.*<damping>5)"}


def puck_world(values):
    """puck.sdf, as in examples/push_a_heavier_puck.py, of another mass and damping."""
    text = TEXT
    for name, pattern in FACTS.items():
        text = re.sub(pattern, f"<{name}>{values[name]}", text)
    return text


PUCK = bench.Task(
    "push", puck_world, lambda v: [mb.ContactPair("finger", "puck", 0.3)],
    {"mass": 0.5, "damping": 5.0},
    {"mass": mb.Parameter("mass", 0.5, "puck"),
     "damping": mb.Parameter("damping", 0.5, "puck_rail")},
    [0.0, 0.0], [0.4, 0.5, 0.0, 0.0], [0.0, 200.0, 1.0, 20.0], [0.01], 1, "mm", N=10,
)  # fmt: skip
# Name of the SDF's model, and its joints that have motors.
MODELS = {
    "push": ("push", ["finger_rail"]),
    "door": ("m", ["upper_joint", "fore_joint"]),
}


def learned_and_recorded(task, true, folder):
    """Learned of each parameter; writes a scene of the model and log.csv."""
    builder, model = DiagramBuilder(), diagram_of(task.world(task.values))[0]
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    Parser(plant).AddModelsFromString(task.world(true), "sdf")
    plant.Finalize()
    pairs, items = task.pairs(task.values), list(task.learned.values())
    config = mb.ContactMpcConfig(
        pairs, list(task.Q), list(task.R), list(task.x_desired), task.dt, task.dt,
        parameters=items,
    )  # fmt: skip
    config.options = replace(config.options, N=task.N)
    mpc = builder.AddSystem(mb.make_contact_mpc(model, config))
    learner = builder.AddSystem(
        mb.ParameterLearner(
            model, mb.ParameterLearnerConfig(pairs, items), task.dt, offset_sec=5e-5
        )
    )
    for system in (mpc, learner):
        builder.Connect(plant.get_state_output_port(), system.GetInputPort("x"))
    u = mpc.GetOutputPort("u")
    builder.Connect(u, plant.get_actuation_input_port())
    builder.Connect(u, learner.GetInputPort("u_measured"))
    builder.Connect(learner.GetOutputPort("parameters"), mpc.GetInputPort("parameters"))
    simulator = Simulator(builder.Build())
    root, rng, rows = simulator.get_mutable_context(), np.random.default_rng(0), []
    own, its = (s.GetMyMutableContextFromRoot(root) for s in (plant, mpc))
    plant.SetPositions(own, task.q)
    noise = np.repeat(NOISE, plant.num_positions())
    for t in np.arange(0.0, task.seconds, ROW):
        simulator.AdvanceTo(t + 2e-4)  # The planner's input comes at 1e-4.
        x = plant.GetPositionsAndVelocities(own) + noise * rng.normal(size=noise.size)
        rows.append([t, *x, *u.Eval(its)])
    name, driven = MODELS[task.name]
    joints = [plant.get_joint(i) for i in plant.GetJointIndices()]
    names = [f"{name}.{j.name()}" for j in joints if j.num_positions()]
    columns = ["time", *(f"{each}.{kind}" for kind in ("position", "velocity")
                         for each in names)]  # fmt: skip
    columns += [f"{name}.{joint}.effort_command" for joint in driven]
    header = ",".join(columns)
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=header, comments="")
    (folder / "model.sdf").write_text(task.world(task.values))
    (folder / "scene.yaml").write_text(
        f"directives:\n  - add_model: {{name: {name}, file: {folder / 'model.sdf'}}}\n"
        "plant: {time_step: 0.001}\nactuation: {type: effort, joints: "
        f"[{', '.join(f'{name}.{joint}' for joint in driven)}], hold: zero_order}}\n"
    )
    found = learner.learned(learner.GetMyContextFromRoot(root))
    return dict(zip(task.learned, found, strict=True))


def named(effects, kind, parameter):
    """Value and deviation that gap found; nothing was missing: None."""
    for effect in effects:
        if effect.kind == kind:
            found = effect.parameters[parameter]
            return found.value, found.std
    return None


@pytest.mark.parametrize(
    ("task", "true"),
    [
        (PUCK, {"mass": 1.5}),
        pytest.param(PUCK, {"damping": 10.0}, marks=pytest.mark.slow),
        pytest.param(bench.DOOR, {"mass": 4.0}, marks=pytest.mark.slow),
    ],
    ids=lambda t: getattr(t, "name", str(t)),
)
def test_the_learner_and_gap_agree(task, true, tmp_path):
    learned = learned_and_recorded(task, task.values | true, tmp_path)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.csv"])
    for name, value in true.items():
        own = learned[name]
        if name == "mass":
            found = named(result.effects, "object_mass", "mass")
        else:
            found = named(result.effects, "joint_viscous_damping", "damping")
            found = found and (found[0] + task.values[name], found[1])
        assert found is not None, result.effects
        assert own.low - NINETY * found[1] <= found[0] <= own.high + NINETY * found[1]
        # Both tell, and tell the truth: an interval that holds anything agrees always.
        assert found[0] == pytest.approx(value, rel=0.05)
        assert own.learned == pytest.approx(value, rel=0.2)
