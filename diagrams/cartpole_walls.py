"""A cart-pole between two soft walls that its model misplaces (ACI-MPC VII-A).

    plant --x--> learner --r_comp--> c3 --u--> plant (and, as measured, the learner)
                    ^ lcs             ^ lcs: the model, its walls wrong by gap_error

The plant is either the LCS itself, with the true walls, or a scene's MultibodyPlant:
a nonlinear pole and walls of Drake's compliant point contact.
"""

from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
)
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from makebreak.diagrams.recorder import add_recorder
from makebreak.diagrams.wiring import add_legend, refuse_unused
from makebreak.models.model_files import MODELS
from makebreak.models.scene import load_scene
from makebreak.systems.baselines.dynamics_residual_learner import (
    DynamicsResidualLearner,
    DynamicsResidualLearnerConfig,
)
from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc
from makebreak.systems.contact_mpc.lcs_plant import LcsPlant, LcsPlantConfig
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Options, C3Weights
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.numerics.cartpole import (
    CartPole,
    cartpole_lcs,
    cost_to_go,
)
from makebreak.systems.contact_mpc.numerics.lcs import LCS
from makebreak.systems.contact_mpc.residual_learner import (
    AdamConfig,
    ResidualLearner,
    ResidualLearnerConfig,
)
from makebreak.systems.views.legend import LegendConfig
from makebreak.systems.views.walls_view import WallsView, WallsViewConfig

SCENE = str(MODELS / "cartpole_walls.scene.yaml")
CAMERA = (0.25, -1.3, 0.6), (0.0, 0.0, 0.35)  # Meshcat's position and target [m].
DT = 0.01  # Time step of the LCS, of C3 and of the learner [s].
# The learner runs first, then C3, then the LCS as plant, so that no value is a period
# late. (The MultibodyPlant steps every millisecond and uses u as soon as C3 gives it.)
LEARNER_OFFSET, C3_OFFSET, PLANT_OFFSET = 1e-4, 2e-4, 3e-4


def _learner() -> ResidualLearnerConfig:
    """Settings for gaps in metres: eps [m/N per squared SI unit], gamma [m/N]."""
    return ResidualLearnerConfig(
        eps=30.0, gamma=0.01, adam=AdamConfig(10, 3e-3, n_steps=5), r_max=0.5
    )


@dataclass
class CartpoleWallsConfig:
    """Settings of `makebreak run cartpole_walls`."""

    seed: int = 0  # Seed of the initial state, drawn around x_initial.
    # Mean initial state: position of the cart [m], angle of the pole [rad], and their
    # velocities. Default: at rest, the tip 24 cm towards wall 0.
    x_initial: list[float] = field(default_factory=lambda: [0.0, -0.4, 0.0, 0.0])
    # Half width of the uniform draw of each entry of the initial state [SI].
    x_spread: list[float] = field(default_factory=lambda: [0.02, 0.02, 0.02, 0.02])
    adapt: bool = True  # Whether a residual is learned; false: as learner=none.
    # Residual that is learned: r_comp (of the contact equation), r_dyn (of the
    # dynamics, the baseline, eq. 10), both or none.
    learner: Literal["none", "r_comp", "r_dyn", "both"] = "r_comp"
    # Projection of C3: qp, exact or plus.
    projection: Literal["qp", "exact", "plus"] = "qp"
    # True distance of each wall minus the distance that the model starts with [m].
    gap_error: list[float] = field(default_factory=lambda: [-0.15, 0.15])
    # Scene file of the simulated world, where the plant is a MultibodyPlant.
    world: str = SCENE
    learning: ResidualLearnerConfig = field(default_factory=_learner)


def refuse_unused_settings(config: CartpoleWallsConfig) -> None:
    """Raises: ValueError for settings that nothing reads with the chosen learner."""
    plain = CartpoleWallsConfig()
    refuse_unused(config, plain, "learning.slip_noise", "the walls have no friction")
    learned = config.learner if config.adapt else "none"
    if not config.adapt:
        refuse_unused(config, plain, "learner", "not used with adapt=false")
    if learned in ("r_comp", "both"):
        return
    read = {"eps", "gamma", "Q_d"}  # For the map of gradients.
    if learned == "r_dyn":
        read.add("n_b")
    why = f"not used with {f'learner={learned}' if config.adapt else 'adapt=false'}"
    for name in {one.name for one in fields(config.learning)} - read - {"adam"}:
        refuse_unused(config, plain, f"learning.{name}", why)
    for name in {"n_b", "learning_rate", "n_steps"} - read:
        refuse_unused(config, plain, f"learning.adam.{name}", why)


def true_lcs() -> LCS:
    """The LCS with the true walls."""
    return cartpole_lcs(CartPole(), DT)


def model_lcs(config: CartpoleWallsConfig) -> LCS:
    """The LCS that the controllers start with: c = c_true - gap_error.

    Raises: ValueError for gap_error of another shape.
    """
    truth = true_lcs()
    error = np.array(config.gap_error, dtype=float)
    if error.shape != (truth.n_lam,) or not np.isfinite(error).all():
        raise ValueError(f"gap_error is {config.gap_error}, expected 2 lengths [m]")
    return truth.with_residual(-error)


PROJECTIONS = {"qp": QpProjection, "exact": ExactProjection, "plus": PlusProjection}


def c3_config(N: int = 10, projection: str = "qp") -> C3Config:
    """C3 with a projection of PROJECTIONS, 10 rounds, rho 2, and the published weights.

    The plus projection weights eta too: 1 m of gap as 100 N of force, the wall's
    stiffness. No gap is clamped, because a soft wall's force is its penetration.
    """
    lcs, n_x = true_lcs(), 4
    Q, R = np.diag([10.0, 2.0, 1.0, 1.0]), np.eye(1)
    G = n_x * [0.1] + 2 * [0.1] + [0.0]
    U = n_x * [1000.0] + 2 * [1.0] + [0.0]
    if projection == "plus":
        G, U = G + 2 * [0.1 * 1e4], U + 2 * [1e4]
    weights = C3Weights(
        Q=Q, R=R, G=np.array(G), U=np.array(U), Q_N=cost_to_go(lcs, Q, R)
    )
    return C3Config(
        weights,
        projection=PROJECTIONS[projection](),
        options=C3Options(N=N, rounds=10, rho=2.0),
        residual_dt_sec=DT,
        clamp_command_gap=False,
    )


def initial_state(config: CartpoleWallsConfig) -> np.ndarray:
    """Initial state (4,) of the run of config.seed. Raises: ValueError."""
    x = np.array(config.x_initial, dtype=float)
    if x.shape != (4,) or not np.isfinite(x).all():
        raise ValueError(f"x_initial is {config.x_initial}, expected 4 numbers")
    spread = np.array(config.x_spread, dtype=float)
    if spread.shape != (4,) or not ((spread >= 0.0) & np.isfinite(spread)).all():
        raise ValueError(f"x_spread is {config.x_spread}, expected 4 numbers >= 0")
    rng = np.random.default_rng(config.seed)
    return x + spread * rng.uniform(-1.0, 1.0, size=4)


def make_cartpole_walls(
    config: CartpoleWallsConfig, multibody: bool = False, meshcat: Meshcat | None = None
) -> Diagram:
    """The closed loop.

    Outputs: x (4,): the plant's state; u (1,) [N]; r_comp (2,) [m], zero if it is not
        learned; if it is, loss (1,) and learner_status (1,); c3_status (1,).

    Args: multibody: the plant is the scene's, else the LCS with the true walls;
        meshcat: shows a multibody plant, and the walls of the learned model.
    Raises: ValueError for a setting out of range, or a scene of other sizes.
    """
    builder = DiagramBuilder()
    model = model_lcs(config)
    if multibody:
        x, u_of_plant = _add_scene(builder, config, meshcat)
    else:
        lcs_plant = LcsPlant(true_lcs(), config=LcsPlantConfig(offset_sec=PLANT_OFFSET))
        builder.AddNamedSystem("plant", lcs_plant)
        x, u_of_plant = lcs_plant.GetOutputPort("x"), lcs_plant.GetInputPort("u")

    lcs = builder.AddNamedSystem("lcs", ConstantValueSource(Value(model)))
    c3 = builder.AddNamedSystem(
        "c3", C3Mpc(c3_config(projection=config.projection), DT, C3_OFFSET)
    )
    N = c3_config().options.N
    goal = builder.AddNamedSystem(
        "x_desired", ConstantVectorSource(np.zeros((N + 1) * model.n_x))
    )
    u = c3.GetOutputPort("u")
    builder.Connect(x, c3.GetInputPort("x"))
    builder.Connect(goal.get_output_port(), c3.GetInputPort("x_desired"))
    builder.Connect(u, u_of_plant)
    r_comp, lcs_of_c3 = _add_learners(builder, config, model, x, u, lcs)
    builder.Connect(lcs_of_c3, c3.GetInputPort("lcs"))
    builder.Connect(r_comp, c3.GetInputPort("r_comp"))
    if multibody and meshcat is not None:
        view = builder.AddNamedSystem(
            "walls_view", WallsView(WallsViewConfig(gap=list(model.c)), meshcat)
        )
        builder.Connect(r_comp, view.GetInputPort("r_comp"))
        add_legend(builder, meshcat, LegendConfig(view.LEGEND, (), *CAMERA))
    names = ("slide.position", "pivot.position", "slide.velocity", "pivot.velocity")
    add_recorder(
        builder,
        {"x": (x, [f"cartpole.{name}" for name in names])},
        {"u": (u, ["cartpole.slide.effort_command"])},
        DT,
    )
    builder.ExportOutput(x, "x")
    builder.ExportOutput(u, "u")
    builder.ExportOutput(r_comp, "r_comp")
    builder.ExportOutput(c3.GetOutputPort("status"), "c3_status")
    diagram = builder.Build()
    diagram.set_name("cartpole_walls")
    return diagram


def _add_scene(builder, config, meshcat) -> tuple[OutputPort, InputPort]:
    """The plant of the scene; gives its state and its input.

    Raises: ValueError for a scene of other sizes.
    """
    loaded = load_scene(config.world, builder)
    plant = loaded.plant
    if (plant.num_multibody_states(), plant.num_actuated_dofs()) != (4, 1):
        raise ValueError(
            f"the scene {config.world} has {plant.num_multibody_states()} states "
            f"and {plant.num_actuated_dofs()} actuators, expected 4 and 1"
        )
    actuator = plant.get_joint_actuator(plant.GetJointActuatorIndices()[0])
    driven = plant.GetModelInstanceName(actuator.model_instance())
    if meshcat is not None:
        meshcat.SetCameraPose(*CAMERA)
        MeshcatVisualizer.AddToBuilder(
            builder,
            loaded.scene_graph,
            meshcat,
            MeshcatVisualizerParams(publish_period=1.0 / 30.0),
        )
    return plant.get_state_output_port(), loaded.command_input_port(driven)


def _add_learners(
    builder, config, model: LCS, x: OutputPort, u: OutputPort, lcs
) -> tuple[OutputPort, OutputPort]:
    """The learners of the config. Gives r_comp, zero without a learner of it, and the
    LCS for C3, with r_dyn if that is learned."""
    lcs_of_c3 = lcs.get_output_port()
    learned = config.learner if config.adapt else "none"
    if learned in ("r_comp", "both"):
        learner = builder.AddNamedSystem(
            "learner", ResidualLearner(config.learning, model, DT, LEARNER_OFFSET)
        )
        builder.Connect(x, learner.GetInputPort("x"))
        # The learner updates before C3, so this is the u of the period that has passed.
        builder.Connect(u, learner.GetInputPort("u_measured"))
        builder.Connect(lcs.get_output_port(), learner.GetInputPort("lcs"))
        r_comp = learner.GetOutputPort("r_comp")
        builder.ExportOutput(learner.GetOutputPort("loss"), "loss")
        builder.ExportOutput(learner.GetOutputPort("status"), "learner_status")
    else:
        zero = builder.AddNamedSystem(
            "no_residual", ConstantVectorSource(np.zeros(model.n_lam))
        )
        r_comp = zero.get_output_port()
    if learned in ("r_dyn", "both"):
        baseline = builder.AddNamedSystem(
            "dynamics_learner",
            DynamicsResidualLearner(
                DynamicsResidualLearnerConfig(config.learning.adam.n_b),
                model,
                DT,
                LEARNER_OFFSET,
            ),
        )
        builder.Connect(x, baseline.GetInputPort("x"))
        builder.Connect(u, baseline.GetInputPort("u_measured"))
        builder.Connect(lcs.get_output_port(), baseline.GetInputPort("lcs"))
        lcs_of_c3 = baseline.GetOutputPort("lcs")
    return r_comp, lcs_of_c3


def start(diagram: Diagram, x) -> Context:
    """A context of make_cartpole_walls in which the plant's state is x (4,)."""
    context = diagram.CreateDefaultContext()
    plant = diagram.GetSubsystemByName("plant")
    plant_context = plant.GetMyContextFromRoot(context)
    if isinstance(plant, LcsPlant):
        plant_context.SetDiscreteState(0, x)
    else:
        plant.SetPositionsAndVelocities(plant_context, x)
    return context
