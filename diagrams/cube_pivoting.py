"""A planar cube on a platform, tipped by 90 degrees by two fingers.

    plant --x--> lcs --lcs--> c3 --u--> (+ the fingers' weight) --> plant
            |--> target --x_desired--^
            `--> learner --r_comp----^   (if it adapts)

The world is a scene, simulated by Drake; the planner has a plant of its own, of a scene
in which friction, mass and size of the cube may be others.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from pydrake.geometry import (
    Box,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
)
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import JointActuatorIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    Demultiplexer,
    Multiplexer,
    VectorLogSink,
)

from makebreak.diagrams.recorder import add_recorder
from makebreak.diagrams.wiring import add_legend
from makebreak.models.drives import add_actuators
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS, add_models
from makebreak.models.scene import Scene, load_scene, read_scene
from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Bounds, C3Options, C3Weights
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.pivot_target import (
    LEFT,
    N_X,
    RIGHT,
    THETA,
    corners,
)
from makebreak.systems.contact_mpc.pivot_target import PivotTarget, PivotTargetConfig
from makebreak.systems.contact_mpc.residual_learner import (
    ResidualLearner,
    ResidualLearnerConfig,
)
from makebreak.systems.views.contact_probe import ContactProbe
from makebreak.systems.views.legend import LegendConfig

SCENE = str(MODELS / "cube_pivoting.scene.yaml")
FINGERS = ("left", "right")
CAMERA = ([0.05, -0.45, 0.16], [-0.02, 0.0, 0.06])  # Where it is, what it looks at.
# As in the model files.
LEGEND = (
    ("cube, to be tipped by 90 degrees", Rgba(0.85, 0.5, 0.2)),
    ("its two fingers, each driven in a plane", Rgba(0.2, 0.35, 0.6)),
    ("platform", Rgba(0.55, 0.57, 0.6)),
)
CUBE_BODY, CORNERS_BODY, PLATFORM = "pivot.cube", "pivot.corners", "pivot.platform"
JOINTS = (
    "pivot.x", "pivot.z", "pivot.angle", "left.x", "left.z", "right.x", "right.z"
)  # fmt: skip
# What may touch, (first body, the others): the order of logged_forces.
TOUCHES = (
    (CUBE_BODY, ("left.finger", "right.finger")),
    (PLATFORM, (CORNERS_BODY, "left.finger", "right.finger")),
    ("left.finger", ("right.finger",)),
)
N_FORCES = sum(len(others) for _, others in TOUCHES)
# Builders, learner, C3: no value waits for the next period [s].
LCS_OFFSET, LEARNER_OFFSET, C3_OFFSET = 1e-4, 1.5e-4, 2e-4
TICK = 0.001  # Of the log of forces [s].
# 1 / m^2, 1 / rad^2, and the same of velocities: cube x, z, angle; each finger's x, z.
Q = (2000.0, 2000.0, 200.0, *4 * [50.0], 2.0, 2.0, 0.5, *4 * [5.0])
R = 0.01  # [1/N^2]
APART = 1e-3  # What does not touch at first is so far apart at least [m].


@dataclass
class PivotStart:
    """Where a run starts; each of them uniformly drawn by the seed."""

    place: float = 0.05  # The cube's centre, up to so far from x = -0.1 m [m].
    tilt: float = 0.15  # Of the cube, to either side [rad].
    # From the cube's sides to the fingers' surfaces, and the fingers' height [m].
    distance: list[float] = field(default_factory=lambda: [0.01, 0.06])
    height: list[float] = field(default_factory=lambda: [0.02, 0.12])
    friction: list[float] = field(default_factory=lambda: [0.4, 1.0])  # Of all pairs.


@dataclass
class PivotPlanner:
    projection: Literal["plus", "qp"] = "plus"
    options: C3Options = field(
        default_factory=lambda: C3Options(N=10, rounds=3, polish=10)
    )
    dt_sec: float = 0.05  # Between knots [s].
    period_sec: float = 0.02  # From plan to plan [s].
    # Each knot has its own LCS, along the last plan; else all have that of the state.
    lcs_along_plan: bool = False
    force_max: float = 10.0  # Of each slide of a finger, beside its weight [N].
    rate: float = 1.0  # Of the angle that is wanted [rad/s].


def _learner() -> ResidualLearnerConfig:
    """A value for each finger on the cube and one for the corners on the platform.

    A touch that the model misses by a gap velocity g is learned from if its force is
    above g / (eps |D|^2): with a finger of 0.3 kg, 20 ms and 5 mm (0.25 m/s) from
    0.2 N on.
    """
    return ResidualLearnerConfig(
        eps=300.0,
        gamma=2e-4,
        n_b=10,
        learning_rate=0.01,
        n_steps=5,
        groups=[[0, 1], [2, 3], [4, 5, 6, 7]],
    )


@dataclass
class CubePivotingConfig:
    seed: int = 0  # Draws the start and the friction.
    start: PivotStart = field(default_factory=PivotStart)
    mass: float = 0.4  # Of the cube [kg].
    size: float = 1.0  # Of the cube, over the scene's.
    # The planner's friction, mass and size over the world's.
    friction_error: float = 1.0
    mass_error: float = 1.0
    size_error: float = 1.0
    planner: PivotPlanner = field(default_factory=PivotPlanner)
    adapt: bool = False  # Residuals on the contacts are learned.
    learning: ResidualLearnerConfig = field(default_factory=_learner)
    world: str = SCENE


@dataclass(frozen=True)
class Cube:
    """What may differ between world and model."""

    friction: float
    mass: float  # [kg]
    side: float  # [m]


def world_cube(config: CubePivotingConfig) -> Cube:
    """The cube of the run of config.seed. Raises: ValueError."""
    c = config
    friction = _range("start.friction", c.start.friction, 0.0)
    for name in ("mass", "size", "friction_error", "mass_error", "size_error"):
        if not 0.0 < getattr(c, name) < np.inf:
            raise ValueError(f"{name} is {getattr(c, name)}, expected > 0")
    drawn = np.random.default_rng([c.seed, 1]).uniform(friction[0], friction[1])
    return Cube(float(drawn), c.mass, c.size * _side(c.world))


def model_cube(config: CubePivotingConfig) -> Cube:
    """The same as the planner has it."""
    c, cube = config, world_cube(config)
    return Cube(
        cube.friction * c.friction_error,
        cube.mass * c.mass_error,
        cube.side * c.size_error,
    )


def scene_with(path: str, cube: Cube) -> Scene:
    """The scene of the file with this cube."""
    scene = read_scene(path)
    pairs = [f"{CORNERS_BODY}~{PLATFORM}"]
    pairs += [f"{finger}.finger~{CUBE_BODY}" for finger in FINGERS]
    effects = [
        Effect("contact_friction", [pair], {"friction": cube.friction})
        for pair in pairs
    ]
    effects.append(Effect("object_mass", [CUBE_BODY], {"mass": cube.mass}))
    scale = cube.side / _side(path)
    if scale != 1.0:
        bodies = [CUBE_BODY, CORNERS_BODY]
        effects.append(Effect("object_size", bodies, {"scale": scale}))
    return replace(scene, effects=[*scene.effects, *effects])


def initial_state(config: CubePivotingConfig) -> np.ndarray:
    """Where the run of config.seed starts, x (14,): at rest, nothing touching."""
    c = config.start
    for name in ("place", "tilt"):
        if not 0.0 <= getattr(c, name) < np.inf:
            raise ValueError(f"start.{name} is {getattr(c, name)}, expected >= 0")
    radius = PivotTargetConfig().finger_radius
    distance = _range("start.distance", c.distance, APART)
    height = _range("start.height", c.height, radius + APART)
    rng, cube = np.random.default_rng([config.seed, 0]), world_cube(config)
    x = np.zeros(N_X)
    x[0] = -0.1 + rng.uniform(-c.place, c.place)
    x[THETA] = rng.uniform(-c.tilt, c.tilt)
    x[1] = APART - corners(x, cube.side)[:, 1].min()
    ends = corners(x, cube.side)[:, 0]
    for finger, face, sign in ((LEFT, ends.min(), -1.0), (RIGHT, ends.max(), 1.0)):
        x[finger] = (
            face + sign * (radius + rng.uniform(distance[0], distance[1])),
            rng.uniform(height[0], height[1]),
        )
    return x


def _range(name: str, values, least: float) -> list[float]:
    """[low, high]. Raises: ValueError."""
    good = len(values) == 2 and np.isfinite(values).all()
    if not (good and least <= values[0] <= values[1]):
        raise ValueError(
            f"{name} is {list(values)}, expected [low, high] with {least:g} <= low"
        )
    return list(values)


@lru_cache
def _side(path: str) -> float:
    """Of the cube in the scene of the file, without effects [m]."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    add_models(read_scene(path), (), plant)
    try:
        body = plant.GetBodyByName("cube", plant.GetModelInstanceByName("pivot"))
    except RuntimeError:
        raise ValueError("the scene has no body pivot.cube") from None
    shapes = plant.GetCollisionGeometriesForBody(body)
    box = scene_graph.model_inspector().GetShape(shapes[0]) if shapes else None
    if len(shapes) != 1 or not isinstance(box, Box) or box.width() != box.height():
        raise ValueError("pivot.cube is no box with equal sides in the x-z plane")
    return float(box.width())


def make_model(scene: Scene) -> Diagram:
    """The planner's plant and its scene graph: continuous, and the fingers have no
    weight, as something carries them (make_cube_pivoting)."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    add_models(scene, scene.effects, plant)
    add_actuators(scene.actuation, plant)
    for effect in scene.effects:
        before = KINDS[effect.kind].before_finalize
        if before is not None:
            before(effect, plant, scene_graph)
    for finger in FINGERS:
        plant.set_gravity_enabled(plant.GetModelInstanceByName(finger), False)
    plant.Finalize()
    return builder.Build()


def contact_pairs(friction: float) -> list[ContactPair]:
    """Fingers on the cube, its two lowest corners on the platform, and the fingers on
    that, without friction."""
    y = [0.0, 1.0, 0.0]

    def pair(a, b, mu, closest=None):
        return ContactPair(
            a, b, mu, friction_directions=1, plane_normal=y, closest=closest
        )

    return [
        *(pair(f"{f}::finger", "pivot::cube", friction) for f in FINGERS),
        pair("pivot::corners", "pivot::platform", friction, closest=2),
        *(pair(f"{f}::finger", "pivot::platform", 0.0) for f in FINGERS),
    ]


def c3_config(planner: PivotPlanner, n_lam: int) -> C3Config:
    """C3's weights for n_lam forces, and the bounds of the fingers' forces.

    A force weighs as a gap velocity: 1 N as 1 m/s. Consensus hardly asks for x and u.
    """
    if not 0.0 < planner.force_max < np.inf:
        raise ValueError(
            f"planner.force_max is {planner.force_max}, expected a positive force [N]"
        )
    n_u = 2 * len(FINGERS)
    sizes = [N_X, n_lam, n_u]
    G, U = [0.01, 1.0, 0.01], [1.0, 1.0, 1.0]
    if planner.projection == "plus":
        sizes, G, U = [*sizes, n_lam], [*G, 1.0], [*U, 10.0]
    weights = C3Weights(
        Q=np.array(Q), R=R * np.ones(n_u), G=np.repeat(G, sizes), U=np.repeat(U, sizes)
    )
    u_max = planner.force_max * np.ones(n_u)
    return C3Config(
        weights,
        projection=PlusProjection() if planner.projection == "plus" else QpProjection(),
        options=planner.options,
        bounds=C3Bounds(u_lower=-u_max, u_upper=u_max),
        residual_dt_sec=planner.period_sec,
    )


def make_cube_pivoting(
    config: CubePivotingConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The closed loop.

    Outputs: x (14,) the plant's state, as in numerics/pivot_target.py; u (4,) what the
        planner asks of the fingers' slides [N]; touches (24,), of each of TOUCHES what
        ContactProbe tells, which force_log has every TICK; c3_status (1,); r_comp (10,)
        [m/s], zero without adaptation.

    Raises: ValueError for a number out of range, or a scene of other joints.
    """
    c, p = config, config.planner
    initial_state(config)
    world, believed = world_cube(config), model_cube(config)
    builder = DiagramBuilder()
    loaded = load_scene(scene_with(c.world, world), builder)
    plant = loaded.plant
    _check_joints(plant)
    model = make_model(scene_with(c.world, believed))
    lcs = builder.AddNamedSystem(
        "lcs",
        AnitescuLcsBuilder(
            model,
            LcsBuilderConfig(
                contact_pairs(believed.friction),
                p.dt_sec,
                period_sec=p.period_sec,
                offset_sec=LCS_OFFSET,
                knots=p.options.N if p.lcs_along_plan else 0,
            ),
        ),
    )
    c3 = builder.AddNamedSystem(
        "c3", C3Mpc(c3_config(p, lcs.model.n_lam), p.period_sec, C3_OFFSET)
    )
    target = builder.AddNamedSystem(
        "target",
        PivotTarget(
            PivotTargetConfig(side=believed.side, rate=p.rate), p.dt_sec, p.options.N
        ),
    )
    x, u = plant.get_state_output_port(), c3.GetOutputPort("u")
    for system in (lcs, c3, target):
        builder.Connect(x, system.GetInputPort("x"))
    zero = builder.AddNamedSystem("u_of_lcs", ConstantVectorSource(np.zeros(4)))
    builder.Connect(zero.get_output_port(), lcs.GetInputPort("u"))
    builder.Connect(target.GetOutputPort("x_desired"), c3.GetInputPort("x_desired"))
    builder.Connect(lcs.GetOutputPort("lcs"), c3.GetInputPort("lcs"))
    if c.adapt:
        r_comp = _add_learner(builder, c, model, believed.friction, x, u)
    else:
        none = ConstantVectorSource(np.zeros(lcs.model.n_lam))
        r_comp = builder.AddNamedSystem("no_residual", none).get_output_port()
    builder.Connect(r_comp, c3.GetInputPort("r_comp"))
    if p.lcs_along_plan:
        builder.Connect(c3.GetOutputPort("plan"), lcs.GetInputPort("plan"))
    effort = builder.AddNamedSystem("effort", Adder(2, 4))
    weight = builder.AddNamedSystem("weight", ConstantVectorSource(weights_of(plant)))
    builder.Connect(u, effort.get_input_port(0))
    builder.Connect(weight.get_output_port(), effort.get_input_port(1))
    split = builder.AddNamedSystem("fingers", Demultiplexer([2, 2]))
    builder.Connect(effort.get_output_port(), split.get_input_port())
    for i, finger in enumerate(FINGERS):
        builder.Connect(split.get_output_port(i), loaded.command_input_port(finger))
    touches = _add_touches(builder, plant)
    names = [f"{joint}.{what}" for what in ("position", "velocity") for joint in JOINTS]
    efforts = [f"{joint}.effort_command" for joint in JOINTS[3:]]
    add_recorder(
        builder,
        {"x": (x, names)},
        {"effort": (effort.get_output_port(), efforts)},
    )
    if meshcat is not None:
        meshcat.SetCameraPose(*CAMERA)
        MeshcatVisualizer.AddToBuilder(
            builder,
            loaded.scene_graph,
            meshcat,
            MeshcatVisualizerParams(publish_period=1.0 / 30.0),
        )
        add_legend(builder, meshcat, LegendConfig(LEGEND, (), *CAMERA))
    builder.ExportOutput(x, "x")
    builder.ExportOutput(u, "u")
    builder.ExportOutput(touches, "touches")
    builder.ExportOutput(c3.GetOutputPort("status"), "c3_status")
    builder.ExportOutput(r_comp, "r_comp")
    diagram = builder.Build()
    diagram.set_name("cube_pivoting")
    return diagram


def _add_learner(builder, config, model, friction, x, u) -> OutputPort:
    """The r_comp of a learner on LCS of one period, about each measured state."""
    period = config.planner.period_sec
    contacts = contact_pairs(friction)
    lcs = builder.AddNamedSystem(
        "lcs_of_learner",
        AnitescuLcsBuilder(
            model,
            LcsBuilderConfig(
                contacts, period, period_sec=period, offset_sec=LCS_OFFSET
            ),
        ),
    )
    zero = builder.GetSubsystemByName("u_of_lcs")
    initial = lcs.model.at_default()
    learner = builder.AddNamedSystem(
        "learner",
        ResidualLearner(config.learning, initial, period, LEARNER_OFFSET),
    )
    builder.Connect(x, lcs.GetInputPort("x"))
    builder.Connect(zero.get_output_port(), lcs.GetInputPort("u"))
    builder.Connect(x, learner.GetInputPort("x"))
    # Until C3's next update this is what acted since its last one.
    builder.Connect(u, learner.GetInputPort("u_measured"))
    builder.Connect(lcs.GetOutputPort("lcs"), learner.GetInputPort("lcs"))
    return learner.GetOutputPort("r_comp")


def _check_joints(plant: MultibodyPlant) -> None:
    """Raises: ValueError unless the joints are those of numerics/pivot_target.py."""
    found = []
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        if joint.num_positions():
            model = plant.GetModelInstanceName(joint.model_instance())
            found.append((joint.position_start(), f"{model}.{joint.name()}"))
    names = tuple(name for _, name in sorted(found))
    if names != JOINTS or plant.num_actuated_dofs() != 4:
        raise ValueError(
            f"the scene has the joints {', '.join(names)} and "
            f"{plant.num_actuated_dofs()} actuators, expected {', '.join(JOINTS)} and 4"
        )


def weights_of(plant: MultibodyPlant) -> np.ndarray:
    """(4,) the effort that carries each finger's slides, as modelled [N]."""
    gravity = plant.CalcGravityGeneralizedForces(plant.CreateDefaultContext())
    joints = [
        plant.get_joint_actuator(JointActuatorIndex(int(i))).joint()
        for i in plant.GetJointActuatorIndices()
    ]
    return np.array([-gravity[joint.velocity_start()] for joint in joints])


def _add_touches(builder: DiagramBuilder, plant: MultibodyPlant):
    """A port with what a ContactProbe tells of each of TOUCHES, (24,), and its log."""
    parts = []
    for first, others in TOUCHES:
        bodies = [
            plant.GetBodyByName(body, plant.GetModelInstanceByName(model))
            for model, body in (name.split(".") for name in (first, *others))
        ]
        probe = builder.AddNamedSystem(f"touch_{first}", ContactProbe(*bodies))
        builder.Connect(
            plant.get_contact_results_output_port(),
            probe.GetInputPort("contact_results"),
        )
        parts.append(probe.GetOutputPort("contact_force"))
    joined = builder.AddNamedSystem("touches", Multiplexer([p.size() for p in parts]))
    for i, port in enumerate(parts):
        builder.Connect(port, joined.get_input_port(i))
    log = builder.AddNamedSystem("force_log", VectorLogSink(4 * N_FORCES, TICK))
    builder.Connect(joined.get_output_port(), log.get_input_port())
    return joined.get_output_port()


def logged_forces(diagram: Diagram, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s] and forces (n, 6) [N] between two bodies each, in the order of
    TOUCHES, of a simulation that ended in `context`."""
    log = diagram.GetSubsystemByName("force_log").FindLog(context)
    vectors = log.data().T.reshape(-1, N_FORCES, 4)[:, :, 1:]
    return np.array(log.sample_times()), np.linalg.norm(vectors, axis=2)


def start(diagram: Diagram, x) -> Context:
    """A context of make_cube_pivoting in which the plant's state is x (14,)."""
    context = diagram.CreateDefaultContext()
    plant = diagram.GetSubsystemByName("plant")
    plant.SetPositionsAndVelocities(plant.GetMyContextFromRoot(context), x)
    return context
