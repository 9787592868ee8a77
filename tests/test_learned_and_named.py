"""What ParameterLearner learns while it works, and what `makebreak gap` names on the
recording of the same run, are the same within both deviations."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import makebreak as mb
from makebreak.benchmarks import parameter_learner as bench
from makebreak.benchmarks.plants import diagram_of
from makebreak.gap import run_gap
from makebreak.scripts.cli import main

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
    "drawer": ("m", ["tip_joint"]),
    "lid": ("m", ["upper_joint", "fore_joint"]),
    "leg": ("m", ["thigh_joint", "shank_joint"]),
}
# What gap's kinds are called here; and whether they say what the model has too little.
NAMED = {
    "object_mass": ("mass", False),
    "link_mass": ("mass", True),
    "joint_viscous_damping": ("damping", True),
    "joint_coulomb_friction": ("coulomb", True),
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
    if task.tuned:
        config = mb.tuned(config, plant, **task.tuned)
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
    if task.dry:
        bench.add_dry_friction(builder, plant, task.dry, true["coulomb"])
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
    has = {"kind": "joint_coulomb_friction", "at": f"{name}.{task.dry}",
           "parameters": {"coulomb": task.values.get("coulomb")}}  # fmt: skip
    scene = {
        "directives": [{"add_model": {"name": name, "file": "model.sdf"}}],
        "plant": {"time_step": 0.001},
        "actuation": {"type": "effort", "joints": [f"{name}.{j}" for j in driven],
                      "hold": "zero_order"},
        "effects": [has] if task.dry else [],
    }  # fmt: skip
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    found = learner.learned(learner.GetMyContextFromRoot(root))
    return dict(zip(task.learned, found, strict=True))


def named(effects, values):
    """{name: (value, deviation)} of what gap found, beside the model's values."""
    found = {}
    for effect in effects:
        if effect.kind in NAMED:
            name, is_added = NAMED[effect.kind]
            (x,) = effect.parameters.values()
            found[name] = x.value + is_added * values[name], x.std
    return found


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("task", "true"),
    [
        (PUCK, {"mass": 1.5}),
        pytest.param(PUCK, {"mass": 0.25}, marks=SLOW),
        pytest.param(PUCK, {"damping": 10.0}, marks=SLOW),
        pytest.param(bench.DOOR, {"mass": 4.0}, marks=SLOW),
        pytest.param(bench.DOOR, {"damping": 1.6}, marks=SLOW),
        pytest.param(bench.DOOR, {"damping": 0.4}, marks=SLOW),
        # It is pushed for 0.15 s, and coasts.
        (bench.DRAWER, {"mass": 4.0}),
        pytest.param(bench.DRAWER, {"mass": 1.0}, marks=SLOW),
        pytest.param(bench.DRAWER, {"damping": 1.5}, marks=SLOW),
        pytest.param(bench.DRAWER, {"damping": 6.0}, marks=SLOW),
        pytest.param(bench.DRAWER, {"coulomb": 1.0}, marks=SLOW),
        pytest.param(bench.DRAWER, {"coulomb": 4.0}, marks=SLOW),
        # It weighs on the arm all the time.
        pytest.param(bench.LID, {"damping": 1.6}, marks=SLOW),
        pytest.param(bench.LID, {"mass": 4.0}, marks=SLOW),
        pytest.param(bench.LID, {"mass": 1.0}, marks=SLOW),
        pytest.param(bench.LEG, {"mass": 2.0}, marks=SLOW),
    ],
    ids=lambda t: getattr(t, "name", str(t)),
)
def test_the_learner_and_gap_agree(task, true, tmp_path):
    learned = learned_and_recorded(task, task.values | true, tmp_path)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.csv"])
    assert result.verdict in ("gap_named", "ambiguous"), result.says
    found = named(result.effects, task.values)
    ((name, value),) = true.items()
    assert found.keys() == {name}, result.says
    own, (its, std) = learned[name], found[name]
    assert own.low - NINETY * std <= its <= own.high + NINETY * std
    # Both tell, and tell the truth: an interval that holds anything agrees always.
    assert its == pytest.approx(value, rel=0.05)
    assert own.learned == pytest.approx(value, rel=0.3)
    # A push tells what coasting does not.
    rivals = {t.kind for e in result.effects for t in e.indistinguishable_from}
    assert not rivals & (NAMED.keys() - {result.effects[0].kind}), result.says


@pytest.mark.parametrize(
    "task",
    [bench.DOOR, *(pytest.param(t, marks=SLOW)
                   for t in (bench.DRAWER, bench.LID, bench.LEG))],
    ids=lambda t: t.name,
)  # fmt: skip
def test_the_right_model_is_no_gap(task, tmp_path):
    learned_and_recorded(task, task.values, tmp_path)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.csv"])
    assert result.verdict == "no_gap", result.says


def test_half_the_damping_of_a_lid_that_swings_is_not_twice_its_mass(tmp_path):
    """The same motion, but for the push; hundreds of times the noise off without it."""
    x_desired = [*bench.reaching(0.5, 0.3), 1.4, 0.0, 0.0, 0.0]
    thrown = replace(bench.LID, x_desired=x_desired)
    learned_and_recorded(thrown, thrown.values | {"damping": 0.4}, tmp_path)
    result = run_gap(tmp_path / "scene.yaml", [tmp_path / "log.csv"])
    found = named(result.effects, thrown.values)
    assert found.keys() == {"damping"}, result.says
    assert found["damping"][0] == pytest.approx(0.4, rel=0.01)


def of_experiment(name, seed, settings, out):
    """The results of a run with learner=parameters, and what gap makes of it."""
    asked = ["run", name, "--no-meshcat", "--quiet", "--seed", str(seed)]
    asked += ["--duration", "40"] if name == "ball_rolling" else []
    settings = ["learner=parameters", *settings]
    assert main([*asked, "--out", str(out), "--set", *settings]) in (0, 1)
    learned = json.loads((out / "result.json").read_text())
    return learned, run_gap(out / "model.yaml", [out / "recording.csv"])


@pytest.mark.slow
def test_a_pushed_object_s_frictions_agree(tmp_path):
    """Four goals, with half the friction in the model. Pushes tell the product of the
    table's friction and the mass; how it is divided has wide intervals, of which one
    in ten does not hold."""
    wrong = ["n_goals=4", "model.friction=0.25"]
    learned, result = of_experiment("push_object", 26200, wrong, tmp_path / "run")
    found = {
        e.at[0].rpartition(".")[2]: e.parameters["friction"]
        for e in result.effects if e.kind == "contact_friction"
    }  # fmt: skip
    assert found.keys() == {"table", "finger"}, result.says
    assert len(result.effects) == 2, result.says
    for of, pairs in (("finger", "0"), ("table", "1_2_3")):
        low, high = (learned[f"learned_friction_of_pairs_{pairs}_{end}"]
                     for end in ("low", "high"))  # fmt: skip
        its = found[of]
        assert low - NINETY * its.std <= its.value <= high + NINETY * its.std
        assert its.value == pytest.approx(0.5, rel=0.1)
    product = (
        learned["learned_friction_of_pairs_1_2_3"] * learned["learned_mass_of_object"]
    )
    assert product == pytest.approx(0.5 * 0.4, rel=0.1)


@pytest.mark.slow
def test_a_rolled_ball_s_size_agrees(tmp_path):
    """The learner's gap is that of the ball's top, where it is pushed: twice what the
    radius is off."""
    learned, result = of_experiment("ball_rolling", 8430, [], tmp_path / "run")
    (size,) = result.effects
    assert size.kind == "object_size", result.says
    radius = size.parameters["radius"]
    low, high = (learned[f"learned_gap_of_pairs_0_{end}"] for end in ("low", "high"))
    gap, std = 2.0 * (0.0365 - radius.value), 2.0 * radius.std
    assert low - NINETY * std <= gap <= high + NINETY * std
    assert low <= 0.010 <= high
    assert radius.value == pytest.approx(0.0315, rel=0.01)
