"""A planar cube on a platform, tipped by 90 degrees by two fingers.

    plant --x--> lcs --lcs--> c3 --u--> (+ the fingers' weight) --> plant
            |--> target --x_desired--^
            `--> learner --r_comp----^   (if it adapts)

The world is a scene, simulated by Drake. The planner has a plant of its own, from a
scene whose cube may differ in friction, mass and size.
"""

import numpy as np
from pydrake.geometry import (
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

from makebreak.diagrams.cube_pivoting_config import (
    CORNERS_BODY,
    CUBE_BODY,
    FINGERS,
    PLATFORM,
    CubePivotingConfig,
    c3_config,
    contact_pairs,
    initial_state,
    model_cube,
    scene_with,
    world_cube,
)
from makebreak.diagrams.recorder import add_recorder
from makebreak.diagrams.wiring import add_legend
from makebreak.models.drives import add_actuators
from makebreak.models.effects import KINDS
from makebreak.models.model_files import add_models
from makebreak.models.scene import LoadedScene, Scene, load_scene
from makebreak.systems.contact_mpc.c3_mpc import C3Mpc
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcsBuilder,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.pivot_target import PivotTarget, PivotTargetConfig
from makebreak.systems.contact_mpc.residual_learner import ResidualLearner
from makebreak.systems.views.contact_probe import ContactProbe
from makebreak.systems.views.legend import LegendConfig

CAMERA = ([0.05, -0.45, 0.16], [-0.02, 0.0, 0.06])  # Position and target [m].
# The colours are those of the model files.
LEGEND = (
    ("cube, to be tipped by 90 degrees", Rgba(0.85, 0.5, 0.2)),
    ("its two fingers, each driven in a plane", Rgba(0.2, 0.35, 0.6)),
    ("platform", Rgba(0.55, 0.57, 0.6)),
)
JOINTS = (
    "pivot.x", "pivot.z", "pivot.angle", "left.x", "left.z", "right.x", "right.z"
)  # fmt: skip
# Bodies that may touch, (one, the others): the order of logged_forces.
TOUCHES = (
    (CUBE_BODY, ("left.finger", "right.finger")),
    (PLATFORM, (CORNERS_BODY, "left.finger", "right.finger")),
    ("left.finger", ("right.finger",)),
)
N_FORCES = sum(len(others) for _, others in TOUCHES)
# First updates of LCS builders, learner and C3 [s]: in this order, so that none of them
# uses values of the last period.
LCS_OFFSET, LEARNER_OFFSET, C3_OFFSET = 1e-4, 1.5e-4, 2e-4
FORCE_LOG_SEC = 0.001  # Period of the log of forces [s].


def make_model(scene: Scene) -> Diagram:
    """The planner's plant and its scene graph: continuous in time, and without gravity
    on the fingers, as the diagram adds their weight to C3's u."""
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


def make_cube_pivoting(
    config: CubePivotingConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The closed loop.

    Outputs: x (14,) the plant's state, as in numerics/pivot_target.py; u (4,) planned
        efforts of the fingers' slides [N]; touches (24,), the contact_force of the
        ContactProbes of TOUCHES; c3_status (1,); r_comp (10,) [m/s], zero without
        adaptation. The log of touches is read by logged_forces.

    Raises: ValueError for a number out of range, or a scene with other joints.
    """
    initial_state(config)  # Raises before anything is built.
    builder = DiagramBuilder()
    loaded = load_scene(scene_with(config.world, world_cube(config)), builder)
    _check_joints(loaded.plant)
    x = loaded.plant.get_state_output_port()
    c3, r_comp = _add_planner(builder, config, x)
    u = c3.GetOutputPort("u")
    effort = _add_effort(builder, loaded, u)
    touches = _add_touches(builder, loaded.plant)
    names = [f"{joint}.{what}" for what in ("position", "velocity") for joint in JOINTS]
    efforts = [f"{joint}.effort_command" for joint in JOINTS[3:]]
    add_recorder(builder, {"x": (x, names)}, {"effort": (effort, efforts)})
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


def _add_planner(builder, config: CubePivotingConfig, x: OutputPort):
    """C3 on the planner's own model of the cube, and the port of the r_comp it uses."""
    p, cube = config.planner, model_cube(config)
    model = make_model(scene_with(config.world, cube))
    lcs = builder.AddNamedSystem(
        "lcs",
        AnitescuLcsBuilder(
            model,
            LcsBuilderConfig(
                contact_pairs(cube.friction),
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
            PivotTargetConfig(side=cube.side, rate=p.rate), p.dt_sec, p.options.N
        ),
    )
    for system in (lcs, c3, target):
        builder.Connect(x, system.GetInputPort("x"))
    zero = builder.AddNamedSystem("u_of_lcs", ConstantVectorSource(np.zeros(4)))
    builder.Connect(zero.get_output_port(), lcs.GetInputPort("u"))
    builder.Connect(target.GetOutputPort("x_desired"), c3.GetInputPort("x_desired"))
    builder.Connect(lcs.GetOutputPort("lcs"), c3.GetInputPort("lcs"))
    if config.adapt:
        u = c3.GetOutputPort("u")
        r_comp = _add_learner(builder, config, model, cube.friction, x, u)
    else:
        none = ConstantVectorSource(np.zeros(lcs.model.n_lam))
        r_comp = builder.AddNamedSystem("no_residual", none).get_output_port()
    builder.Connect(r_comp, c3.GetInputPort("r_comp"))
    if p.lcs_along_plan:
        builder.Connect(c3.GetOutputPort("plan"), lcs.GetInputPort("plan"))
    return c3, r_comp


def _add_effort(builder, loaded: LoadedScene, u: OutputPort) -> OutputPort:
    """Drives the fingers with u plus their weight; gives that sum (4,) [N]."""
    effort = builder.AddNamedSystem("effort", Adder(2, 4))
    weight = builder.AddNamedSystem(
        "weight", ConstantVectorSource(weights_of(loaded.plant))
    )
    builder.Connect(u, effort.get_input_port(0))
    builder.Connect(weight.get_output_port(), effort.get_input_port(1))
    split = builder.AddNamedSystem("fingers", Demultiplexer([2, 2]))
    builder.Connect(effort.get_output_port(), split.get_input_port())
    for i, finger in enumerate(FINGERS):
        builder.Connect(split.get_output_port(i), loaded.command_input_port(finger))
    return effort.get_output_port()


def _add_learner(builder, config, model, friction, x, u) -> OutputPort:
    """The r_comp of a learner, whose LCS has the planner's period as its step."""
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
    # The learner updates before C3, so this is the u of the period that has passed.
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
    """(4,) efforts of the fingers' slides that balance their weight [N]."""
    gravity = plant.CalcGravityGeneralizedForces(plant.CreateDefaultContext())
    joints = [
        plant.get_joint_actuator(JointActuatorIndex(int(i))).joint()
        for i in plant.GetJointActuatorIndices()
    ]
    return np.array([-gravity[joint.velocity_start()] for joint in joints])


def _add_touches(builder: DiagramBuilder, plant: MultibodyPlant):
    """The port of the contact forces of TOUCHES (24,), which are logged too."""
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
    log = builder.AddNamedSystem(
        "force_log", VectorLogSink(4 * N_FORCES, FORCE_LOG_SEC)
    )
    builder.Connect(joined.get_output_port(), log.get_input_port())
    return joined.get_output_port()


def logged_forces(diagram: Diagram, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) [s] and magnitudes (n, 6) [N] of the forces between two bodies, in the
    order of TOUCHES, of a simulation that ended in `context`."""
    log = diagram.GetSubsystemByName("force_log").FindLog(context)
    vectors = log.data().T.reshape(-1, N_FORCES, 4)[:, :, 1:]
    return np.array(log.sample_times()), np.linalg.norm(vectors, axis=2)


def start(diagram: Diagram, x) -> Context:
    """A context of the diagram in which the plant's state is x (14,)."""
    context = diagram.CreateDefaultContext()
    plant = diagram.GetSubsystemByName("plant")
    plant.SetPositionsAndVelocities(plant.GetMyContextFromRoot(context), x)
    return context
