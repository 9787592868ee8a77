"""`makebreak bench parameter_learner`: what it is worth to learn masses and friction.

Four plants whose planner's model is wrong: the error of the task without the learner,
with it, with it and a goal that is approached with care (CarefulGoal), and with the
right model; how far the learned values are off, and how often
their 90 % intervals hold the truth. The world is Drake at 1 ms steps.

    door    a two-link arm pushes a door on a damped hinge to an angle, and lets it go
    drawer  a finger pushes a drawer whose rail has Coulomb's friction to a place
    lid     the arm, upright, lifts a lid on a level hinge to an angle, and holds it
    leg     a leg on a vertical rail falls, lands and holds its body at a height
    box     two fingers push a box over a table, in a plane, to a place
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    DiscreteContactApproximation,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from makebreak.benchmarks import plants as p
from makebreak.diagrams.contact_mpc import ContactMpcConfig, make_contact_mpc, tuned
from makebreak.models.effects.joint_forces import JointForces
from makebreak.systems.contact_mpc.careful_goal import CarefulGoalConfig
from makebreak.systems.contact_mpc.lcs_builder import ContactPair
from makebreak.systems.contact_mpc.multibody.model_parameters import (
    POSITIVE,
    Parameter,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Bounds, C3Options
from makebreak.systems.contact_mpc.parameter_learner import (
    ParameterLearner,
    ParameterLearnerConfig,
)
from makebreak.systems.numerics.joint_laws import coulomb_law

FACTORS = (0.5, 2.0)  # Between which the truth is that of the model.
# Whether the planner knows, learns, and is careful: the columns of a row.
WAYS = (
    (False, False, False), (False, True, False), (False, True, True),
    (True, False, False),
)  # fmt: skip
NINETY = 1.645  # Deviations of a 90 % interval.
FIRST_SEED = 9200


@dataclass(frozen=True, eq=False)
class Task:
    """A plant, what its planner wants, and what its model may be wrong about.

    Args:
        world: (values) -> SDF text. pairs: (friction of the values) -> of the LCS.
        values: the model's. learned: the parameter of each.
        q: positions at the start; x_desired, Q, R, N, dt, u_max: of the planner.
        goal: index of the position whose final error counts, in `unit`s of 1e-3.
        careful: positions that are approached with care. The door, which coasts far,
            stops short by a 90 % interval.
        tuned: arguments of the rule that gives weights and dt in place of Q and R.
    """

    name: str
    world: Callable[[dict], str]
    pairs: Callable[[dict], list[ContactPair]]
    values: dict[str, float]
    learned: dict[str, Parameter]
    q: Sequence[float]
    x_desired: Sequence[float]
    Q: Sequence[float]
    R: Sequence[float]
    goal: int
    unit: str
    N: int = 15
    dt: float = 0.05
    u_max: float = np.inf
    seconds: float = 4.0
    careful: CarefulGoalConfig = field(default_factory=CarefulGoalConfig)
    dry: str = ""  # Joint that has the value `coulomb` as its dry friction.
    tuned: dict = field(default_factory=dict)


def turning(child: str, parent: str, axis: str, damping: float, driven=True) -> str:
    """A revolute joint at the child's origin."""
    limit = "" if driven else "<limit><effort>0</effort></limit>"
    return (
        f'<joint name="{child}_joint" type="revolute"><parent>{parent}</parent>'
        f"<child>{child}</child><axis><xyz>{axis}</xyz><dynamics><damping>{damping}"
        f"</damping></dynamics>{limit}</axis></joint>"
    )


def bar(name: str, parent: str, at: str, mass: float, centre: str, ball="", arm=0.1):
    """A link whose frame is at its joint; centre: of mass [m]; arm: of gyration [m]."""
    moment = mass * arm**2
    inertia = "".join(f"<{i}>{moment}</{i}>" for i in ("ixx", "iyy", "izz"))
    of = f' relative_to="{parent}"' if parent != "world" else ""
    return (
        f'<link name="{name}"><pose{of}>{at} 0 0 0</pose><inertial><pose>{centre} 0 0 '
        f"0</pose><mass>{mass}</mass><inertia>{inertia}</inertia></inertial>{ball}"
        "</link>"
    )


def arm_and(hinged: str, axis: str, v: dict, at: str, centre: str, box: str) -> str:
    """A world of a two-link arm with a ball for its hand, and of a panel on a hinge."""
    mu, length = v["friction"], "0.35 0 0"
    tip = p.shape("ball", p.sphere(0.02), length, mu)
    panel = p.shape("panel", box, centre, mu)
    return p.sdf(
        bar("upper", "world", "0 0 0", 2.0, "0.175 0 0"),
        turning("upper", "world", axis, 0.5),
        bar("fore", "upper", length, 1.6, "0.19 0 0", tip),
        turning("fore", "upper", axis, 0.5),
        bar(hinged, "world", at, v["mass"], centre, panel, 0.12),
        turning(hinged, "world", axis, v["damping"], driven=False),
    )


def of_hinged(name: str) -> dict[str, Parameter]:
    """What may be wrong of it."""
    return {
        "mass": Parameter("mass", 0.5, name),
        "damping": Parameter("damping", 0.5, f"{name}_joint"),
        "friction": Parameter("friction", 0.5, pairs=[0]),
        "gap": Parameter("gap", 0.003, pairs=[0]),
    }


def door_world(v: dict) -> str:
    box = p.box(0.03 - 2.0 * v["gap"], 0.4, 0.1)
    return arm_and("door", "0 0 1", v, "0.5 -0.2 0", "0 0.2 0", box)


DOOR = Task(
    "door", door_world,
    lambda v: [ContactPair("fore", "door", v["friction"], 1, plane_normal=[0, 0, 1])],
    {"mass": 2.0, "damping": 0.8, "friction": 0.4, "gap": 0.0},
    of_hinged("door"),
    [1.0, -2.0, 0.0], [0.4, -0.2, -0.5, 0.0, 0.0, 0.0],
    [0.0, 0.0, 300.0, 5.0, 5.0, 10.0], [0.02] * 2, 2, "mrad", N=20,
    careful=CarefulGoalConfig([2], NINETY),
)  # fmt: skip


def drawer_world(v: dict) -> str:
    front = p.shape("front", p.box(0.02 - 2.0 * v["gap"], 0.3, 0.2))
    text = p.finger("tip", p.X, "-0.05 0 0", 0.02, 0.3, damping=2.0)
    text += p.link("drawer", v["mass"], front)
    return p.sdf(text, p.joint("drawer", "1 0 0", driven=False, damping=v["damping"]))


DRAWER = Task(
    "drawer", drawer_world,
    lambda v: [ContactPair("tip", "drawer", 0.3, 1, plane_normal=[0, 0, 1])],
    {"mass": 2.0, "damping": 3.0, "coulomb": 2.0, "gap": 0.0},
    {
        "mass": Parameter("mass", 0.5, "drawer"),
        "damping": Parameter("damping", 0.5, "drawer_joint"),
        "coulomb": Parameter("coulomb", 0.5, "drawer_joint", model=2.0),
        "gap": Parameter("gap", 0.003, pairs=[0]),
    },
    [0.0, 0.0], [0.3, 0.3, 0.0, 0.0], [0.0, 300.0, 1.0, 5.0], [0.01], 1, "mm", N=15,
    careful=CarefulGoalConfig([1]), dry="drawer_joint",
)  # fmt: skip


def reaching(x: float, z: float) -> list[float]:
    """Angles of the upright arm with its tip at a place [m], its elbow low."""
    elbow = float(np.arccos((x**2 + z**2) / (2.0 * 0.35**2) - 1.0))
    return [0.5 * elbow - float(np.arctan2(z, x)), -elbow]


def lid_world(v: dict) -> str:
    box = p.box(0.4, 0.1, 0.03 - 2.0 * v["gap"])
    return arm_and("lid", "0 1 0", v, "0.75 0 0.3", "-0.2 0 0", box)


LID = Task(
    "lid", lid_world,
    lambda v: [p.in_plane("fore", "lid", v["friction"])],
    {"mass": 2.0, "damping": 0.8, "friction": 0.4, "gap": 0.0},
    of_hinged("lid"),
    [*reaching(0.42, 0.25), 0.0], [*reaching(0.42, 0.4), 0.4, 0.0, 0.0, 0.0],
    [0.0, 0.0, 300.0, 5.0, 5.0, 10.0], [0.002] * 2, 2, "mrad", N=20,
)  # fmt: skip


def leg_world(v: dict) -> str:
    mu, foot = v["friction"], "0 0 -0.22"
    ground = p.fixed("ground", p.box(2, 2, 1), f"0 0 {-0.5 - v['gap']}", mu)
    ball = p.shape("foot", p.sphere(0.02), foot, mu)
    return p.sdf(
        ground,
        bar("body", "world", "0 0 0", v["mass"], "0 0 0"),
        p.joint("body", "0 0 1", driven=False),
        bar("thigh", "body", "0 0 0", 0.6, "0 0 -0.1", arm=0.07),
        turning("thigh", "body", "0 1 0", 0.1),
        bar("shank", "thigh", foot, 0.25, "0 0 -0.12", ball, 0.07),
        turning("shank", "thigh", "0 1 0", 0.1),
    )


def bent(height: float) -> list[float]:
    """Hip and knee of the leg with its foot under its hip at this height [m]."""
    hip = float(np.arccos(height / 0.44))
    return [hip, -2.0 * hip]


LEG = Task(
    "leg", leg_world,
    lambda v: [p.in_plane("shank", "ground", v["friction"])],
    {"mass": 3.0, "friction": 0.6, "gap": 0.0},
    {
        "mass": Parameter("mass", 0.5, "body"),
        "friction": Parameter("friction", 0.5, pairs=[0]),
        "gap": Parameter("gap", 0.01, pairs=[0]),
    },
    # The foot stands where it lands, which need not be under the hip. So the angles
    # have no weight: they pulled the body up to 13 mm from its height.
    [0.46, *bent(0.40)], [0.36, *bent(0.34), 0.0, 0.0, 0.0], [], [], 0, "mm", N=10,
    dt=0.1 / (20.0 * 0.25), u_max=40.0,
    tuned={"moved": [(0, 0)], "length": 0.1, "speed": 0.25, "force": 47.0,
           "coast_sec": 0.0},
)  # fmt: skip


def box_world(v: dict) -> str:
    mu, half = v["friction"], 0.04 - v["gap"]
    shapes = p.shape("sides", p.box(2 * half, 2 * half, 0.04), mu=mu)
    shapes += p.feet(0.06, -0.021, 0.004, mu)
    text = p.ground(mu) + p.finger("tip", p.XY, "0 0 0.025", 0.02, 0.3, damping=2.0)
    return p.sdf(text, p.link("box", v["mass"], shapes, arm=0.027))


BOX = Task(
    "box", box_world,
    lambda v: [ContactPair("tip", "m::sides", v["friction"]),
               *p.on_feet(v["friction"])],
    {"mass": 0.4, "friction": 0.4, "gap": 0.0},
    {
        "mass": Parameter("mass", 0.5, "box"),
        "friction": Parameter("friction", 0.5, pairs=[0, 1, 2, 3, 4]),
        "gap": Parameter("gap", 0.003, pairs=[0]),
    },
    [-0.07, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0251],
    [0.14, 0.0, 1.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0251, *[0.0] * 8],
    [0.0, 0.0, *[0.0] * 4, 500.0, 500.0, 0.0, 1.0, 1.0, *[0.0] * 3, 5.0, 5.0, 0.0],
    [0.01] * 2, 6, "mm", N=10,
    careful=CarefulGoalConfig([6, 7]),
)  # fmt: skip
TASKS = {task.name: task for task in (DOOR, DRAWER, LID, LEG, BOX)}


@dataclass(frozen=True, eq=False)
class Run:
    """error: of the task at the end; the learned values and deviations of z, or None;
    parts (n,): deviations of the truth from what was learned."""

    error: float
    values: np.ndarray | None = None
    off: np.ndarray | None = None


def run(task: Task, true: dict, knows: bool, learns: bool, careful=False) -> Run:
    """Args: true: the world's values; knows: whether the planner's model has them;
    careful: whether the learner's task.careful are approached with care."""
    own = true if knows else task.values
    model_items = {
        name: replace(item, model=own[name]) if item.model else item
        for name, item in task.learned.items()
    }
    (model, _), builder = p.diagram_of(task.world(own)), DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    # With Drake's default the friction of a step is that of the normal force before it:
    # a foot that lands slid away, as there was none.
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSimilar)
    Parser(plant).AddModelsFromString(task.world(true), "sdf")
    plant.Finalize()
    pairs, n_u = task.pairs(own), plant.num_actuated_dofs()
    # What the model's plant does not have is given to its LCS in any case.
    items = [i for i in model_items.values() if learns or i.model]
    limit = np.full(n_u, task.u_max)
    config = ContactMpcConfig(
        pairs, list(task.Q), list(task.R), list(task.x_desired), task.dt, task.dt,
        C3Options(N=task.N, rounds=5, polish=3), C3Bounds(-limit, limit),
        parameters=items,
        careful=task.careful if careful else CarefulGoalConfig(),
    )  # fmt: skip
    if task.tuned:
        config = tuned(config, plant, **task.tuned)
    mpc = builder.AddSystem(make_contact_mpc(model, config))
    state = plant.get_state_output_port()
    if task.dry:
        add_dry_friction(builder, plant, task.dry, true["coulomb"])
    builder.Connect(state, mpc.GetInputPort("x"))
    builder.Connect(mpc.GetOutputPort("u"), plant.get_actuation_input_port())
    learner = None
    if learns:
        learner = builder.AddSystem(
            ParameterLearner(
                model, ParameterLearnerConfig(pairs, items), task.dt, offset_sec=5e-5
            )
        )
        builder.Connect(state, learner.GetInputPort("x"))
        builder.Connect(mpc.GetOutputPort("u"), learner.GetInputPort("u_measured"))
        builder.Connect(
            learner.GetOutputPort("parameters"), mpc.GetInputPort("parameters")
        )
        if config.careful.positions:
            builder.Connect(
                learner.GetOutputPort("unknown"), mpc.GetInputPort("unknown")
            )
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, task.q)
    simulator.AdvanceTo(task.seconds)
    error = plant.GetPositions(context)[task.goal] - task.x_desired[task.goal]
    if learner is None:
        return Run(1e3 * abs(error))
    own_context = learner.GetMyContextFromRoot(simulator.get_context())
    values, std = (
        learner.GetOutputPort(name).Eval(own_context) for name in ("estimate", "std")
    )
    off = []
    for item, value, right in zip(items, values, true.values(), strict=True):
        far = np.log(value / right) if item.kind in POSITIVE else value - right
        off.append(far / item.std)
    return Run(1e3 * abs(error), values, np.array(off) / std)


def add_dry_friction(builder, plant, joint: str, force: float) -> None:
    """Coulomb's friction [N, N m] in a joint of the world, as the gap workflow's."""
    laws = JointForces(
        plant, [coulomb_law], [plant.GetJointByName(joint)], [[force, 1e-3]]
    )
    builder.AddSystem(laws)
    builder.Connect(plant.get_state_output_port(), laws.GetInputPort("state"))
    builder.Connect(
        laws.GetOutputPort("generalized_force"),
        plant.get_applied_generalized_force_input_port(),
    )


def drawn(task: Task, seed: int) -> dict:
    """Values of a world in which one or two are not the model's."""
    rng = np.random.default_rng(seed)
    true = dict(task.values)
    for name in rng.choice(list(true), size=rng.integers(1, 3), replace=False):
        if name == "gap":
            true[name] = float(rng.normal() * task.learned[name].std)
        else:
            true[name] *= float(np.exp(rng.uniform(*np.log(FACTORS))))
    return true


def row(task: Task, seeds: Sequence[int]) -> dict:
    """The row of a plant: medians over seeds, and the coverage of the intervals."""
    offs, errors = [], []
    for seed in seeds:
        true = drawn(task, seed)
        without, learned, careful, right = (run(task, true, *how) for how in WAYS)
        errors.append([without.error, learned.error, careful.error, right.error])
        offs.append(learned.off)
    off = np.abs(np.array(offs, dtype=float))
    without, learned, careful, right = np.median(errors, axis=0)
    return {
        "what": f"{task.name}, {len(seeds)} wrong models: error with the learner",
        "value": float(learned),
        "unit": task.unit,
        "without": float(without),
        "careful": float(careful),
        "right_model": float(right),
        "worst": [round(float(e), 1) for e in np.max(errors, axis=0)],
        "within_90": float(np.mean(off < NINETY)),
    }


def rows(seeds: Sequence[int] = range(FIRST_SEED, FIRST_SEED + 20)) -> list[dict]:
    return [row(task, seeds) for task in TASKS.values()]
