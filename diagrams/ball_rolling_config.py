"""Settings of ball_rolling, and what they make: the world's scene, what the controllers
believe, and the settings of C3 and of the learner. ball_rolling.py connects them.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.fault_kinds import read_faults
from makebreak.diagrams.learned_parameters import to_learn
from makebreak.diagrams.sampled_contacts import SampledContactsConfig
from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import ARM, BALL_ROLLING, TOOL, StationFaults
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.rolling_resistance import rolls_against
from makebreak.models.fruit import FRUITS, fruit_file, make_fruit
from makebreak.models.scene import Scene, load_scene, read_scene
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.arm.impedance_controller import ImpedanceConfig
from makebreak.systems.contact_mpc.c3_mpc import C3Config
from makebreak.systems.contact_mpc.lcs_builder import ContactPair
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    W_BALL,
    plus_weights,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Options, C3Weights
from makebreak.systems.contact_mpc.numerics.c3_projections import (
    ExactProjection,
    PlusProjection,
    QpProjection,
)
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearnerConfig
from makebreak.systems.contact_mpc.residual_learner import (
    AdamConfig,
    FreeStatesConfig,
    PosteriorConfig,
    ResidualLearnerConfig,
    WalkConfig,
)
from makebreak.systems.contact_mpc.rolling_task import RollingTaskConfig
from makebreak.systems.perception.ball_tracker import (
    BallMotionConfig,
    BallTrackerConfig,
)

LEARN = 0.05  # Period of the learner, and time step of its LCS [s].
PLAN_DT, TIP_MASS, N_TIP = 0.1, 1.0, 4  # N_TIP: forces of tip and ball, the first ones.
BOX_AHEAD = np.pi / 2  # From where the ball lies at first to a stray box [rad].
BALL_RESISTANCE = 0.005  # Lever arm over radius.


@dataclass
class PlannerConfig:
    """The costs of C3+ and its ADMM weights (docs/c3.md), for forces in newtons."""

    # Knots of the plan are 0.1 s (PLAN_DT) apart.
    options: C3Options = field(
        default_factory=lambda: C3Options(N=5, rounds=4, rho=2.2)
    )
    tip: float = 500.0  # Weight of the tip's position; its velocity gets 1/50 of it.
    ball: float = 5000.0  # Weight of the ball's position on the table.
    ball_velocity: float = 300.0  # Weight of the ball's velocity and angular velocity.
    # Consensus weight G of lam of tip and ball; that of eta is 1/10 of it.
    force: float = 5.0
    # Coefficient of friction of both contacts in the model, for planning and learning.
    friction: float = 1.0
    # Whether sliding contacts do not open in the one-step model of the command
    # (C3Config).
    sliding_command: bool = True


@dataclass
class LearnerConfig:
    """Learning of r_comp: one number for the four forces of tip and ball.

    The weights are the inverse variances of a one-step prediction (50 ms): a deviation
    of 7 mm/s for the ball, which the camera sees, and of 3 mm/s for the tip, which the
    joints measure.
    """

    weight_ball: float = 2e4  # Q_d of the ball's v_x and v_y [s2/m2].
    weight_tip: float = 1e5  # Q_d of the tip's v_z [s2/m2].
    # Weight eps of the dynamics against the contact equation [m/s N]; with 1e-3, 3 N of
    # contact over a gap of 0.05 mm are as unlikely as 2 std.
    eps: float = 1e-3
    # Softness gamma of the contact equation [m/s per N]; default: the paper's.
    gamma: float = 5e-4
    # Largest magnitude of the residual [m/s]; 0.7 is a gap of 35 mm.
    r_max: float = 0.7
    # Noise of the measured gap speed mu |v_t| of a sliding contact; what exceeds it is
    # not taken for a gap [m/s].
    slip_noise: float = 0.03
    posterior: PosteriorConfig = field(
        default_factory=lambda: PosteriorConfig(
            prior_std=0.16,
            walk=WalkConfig(drift=0.02),
            spacing=0.01,
            misfit_sec=None,  # `trust` was chosen for this model's errors.
            free=FreeStatesConfig([V_BALL.start, V_BALL.start + 1]),
        )
    )


@dataclass
class RollingParametersConfig:
    """What learner=parameters learns, and how well the model knows it: standard
    deviations; 0: not learned. The weights are those of `learning`."""

    # Deviation of the logarithm of the ball's mass.
    mass: float = 0.5
    # Deviation of the logarithm of the friction of tip and ball, and of ball and table:
    # planner.friction is chosen to plan with, and nobody has measured it.
    friction: float = 1.0
    # Deviation of the lever arm of the ball's rolling resistance on the table [m].
    rolling: float = 3e-4
    gap: float = 0.005  # Deviation of the distance of tip and ball [m].
    # Deviation of the gap speed of a closed contact [m/s].
    contact_std: float = 0.02


@dataclass
class BallRollingConfig:
    """All settings of a run.

    World and model start from the same scene. radius_error_m changes the model alone;
    friction, rolling_resistance, ball_noise_m and object change the world.
    """

    adapt: bool = True  # Whether a residual is learned; false: as learner=none.
    # What is learned: the residual r_comp (of the contact equation), r_dyn (of the
    # dynamics, eq. 10), both; parameters (mass, friction, rolling resistance and gap;
    # settings parameters); or none.
    learner: Literal["none", "r_comp", "r_dyn", "both", "parameters"] = "r_comp"
    # Learner and projection: ours, or paper: those of the paper, with its constants.
    controller: Literal["ours", "paper"] = "ours"
    # What decides when and where to touch: cycle (the hand-written RollingTask;
    # settings task, planner) or sampled (ContactSampler; settings contacts).
    contact_sequence: Literal["cycle", "sampled"] = "cycle"
    # Projection of C3: qp, exact, plus; or auto: plus with controller=ours, qp with
    # controller=paper.
    projection: Literal["auto", "qp", "exact", "plus"] = "auto"
    # Object that is rolled: ball, orange or lime.
    object: Literal["ball", "orange", "lime"] = "ball"
    # Radius of the ball in the model minus that in the world (of a fruit: its mean
    # radius) [m].
    radius_error_m: float = 0.005
    # Coefficient of friction of the ball with tip and table in the world.
    friction: float = 0.5
    # Rolling resistance in the world, as lever arm over radius; null: 0.005 for the
    # ball, its own for a fruit.
    rolling_resistance: float | None = None
    # Standard deviation of the random shift of each image, as a length at
    # camera.noise.height [m].
    ball_noise_m: float = 0.001
    # Angle on the circle at which the ball starts [rad]; null: drawn by the seed.
    start_angle_rad: float | None = None
    world: str = BALL_ROLLING  # Scene file of the simulated world.
    model: str = BALL_ROLLING  # Scene file of the controllers' model.
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Seed of the ball's start, a fruit's shape, the station's errors and the sensors'
    # noise.
    seed: int = 0
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracker: BallTrackerConfig = field(
        default_factory=lambda: BallTrackerConfig(
            position_std=1.5e-3,
            motion=BallMotionConfig(
                acceleration_density=4e-3,
                driven_density=0.3,
                free_sec=2.0,
                driven_sec=0.2,
            ),
        )
    )
    task: RollingTaskConfig = field(default_factory=RollingTaskConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    learning: LearnerConfig = field(default_factory=LearnerConfig)
    parameters: RollingParametersConfig = field(default_factory=RollingParametersConfig)
    contacts: SampledContactsConfig = field(default_factory=SampledContactsConfig)
    impedance: ImpedanceConfig = field(
        default_factory=lambda: ImpedanceConfig(force_max=20.0)
    )
    # Faults to inject, each NAME[:from=S,for=S] as of --fault.
    faults: list[str] = field(default_factory=list)


def check_parts(scene: Scene, what: str) -> None:
    """Raises: ValueError for a scene without the arm, its finger, a table or a ball."""
    there = [d.add_model.name for d in scene.directives if d.add_model is not None]
    lacks = [name for name in (ARM, TOOL, "table", "ball") if name not in there]
    if not lacks and "ball.ball" in scene.initial.poses:
        return
    missing = (
        f"no model {', '.join(lacks)}" if lacks else "no initial pose of ball.ball"
    )
    raise ValueError(
        f"{what}: the scene has {missing} (it has {', '.join(there) or 'no models'}); "
        f"expected one with {ARM}, {TOOL}, table and ball, as ball_rolling.scene.yaml"
    )


def start_angle(config: BallRollingConfig) -> float:
    """Where on the circle the ball lies at first [rad]."""
    if config.start_angle_rad is not None:
        return config.start_angle_rad
    return float(np.random.default_rng(config.seed).uniform(-np.pi, np.pi))


def what_goes_wrong(config: BallRollingConfig) -> StationFaults | None:
    """The faults of the config. A stray box stands on the ball's circle."""
    if not config.faults:
        return None
    faults = read_faults(config.faults, ("camera", "ball", "planner", "scene"))
    angle, task = start_angle(config) + BOX_AHEAD, config.task
    x, y = np.array(task.circle.center) + task.circle.radius * np.array(
        [np.cos(angle), np.sin(angle)]
    )
    return StationFaults(faults, (float(x), float(y), 0.03), center=task.circle.center)


def world_scene(config: BallRollingConfig) -> Scene:
    """The scene that is simulated: friction, resistance, where the ball lies."""
    scene = read_scene(config.world)
    check_parts(scene, "world")
    if config.object != "ball":
        _replace_ball(scene, config)
    angle = start_angle(config)
    center, radius = np.array(config.task.circle.center), config.task.circle.radius
    xy = center + radius * np.array([np.cos(angle), np.sin(angle)])
    z = scene.initial.poses["ball.ball"][6]
    turned = [1.0, 0.0, 0.0, 0.0]
    if config.object != "ball":
        kind = FRUITS[config.object]
        z = kind.radius * (1.0 + kind.bump)
        about_z = np.random.default_rng([config.seed, 3]).uniform(0.0, 2.0 * np.pi)
        turned = [float(np.cos(about_z / 2)), 0.0, 0.0, float(np.sin(about_z / 2))]
    scene.initial.poses["ball.ball"] = [*turned, float(xy[0]), float(xy[1]), z]
    if not config.friction > 0.0:
        raise ValueError(f"friction is {config.friction}, expected > 0")
    resistance = config.rolling_resistance
    if resistance is None:
        fruit = FRUITS.get(config.object)
        resistance = BALL_RESISTANCE if fruit is None else fruit.rolling_resistance
    if not resistance >= 0.0:
        raise ValueError(f"rolling_resistance is {resistance}, expected >= 0")
    for pair in (f"{TOOL}~ball", "ball~table"):
        scene.effects.append(
            Effect("contact_friction", [pair], {"friction": config.friction})
        )
    if resistance > 0.0:
        scene.effects.append(rolls_against("ball~table", resistance))
    return scene


def _replace_ball(scene: Scene, config: BallRollingConfig) -> None:
    """The fruit of the config's seed in place of the scene's ball."""
    for directive in scene.directives:
        model = directive.add_model
        if model is not None and model.name == "ball":
            model.file = f"file://{fruit_file(config.object, config.seed)}"
            return
    raise ValueError(f"the scene {config.world} has no model ball, which object needs")


def controller_model(config: BallRollingConfig) -> tuple[TipAndBall, Scene]:
    """What the controllers assume: tip and ball, and the model's scene."""
    scene = read_scene(config.model)
    check_parts(scene, "model")
    fruit = None
    if config.object != "ball":
        fruit = make_fruit(config.object, config.seed)
    if config.radius_error_m != 0.0 or fruit is not None:
        loaded = load_scene(scene, DiagramBuilder())
        right = sphere_radius(loaded.plant, loaded.scene_graph, "ball")
        if fruit is not None:
            right = fruit.mean_radius
        wrong = right + config.radius_error_m
        if not wrong > 0.0:
            raise ValueError(
                f"radius_error_m is {config.radius_error_m}, expected > {-right}"
            )
        scene.effects.append(Effect("object_size", ["ball"], {"radius": wrong}))
    loaded = load_scene(scene, DiagramBuilder())
    ball = loaded.plant.GetBodyByName("ball")
    return TipAndBall(
        tip_mass=TIP_MASS,
        tip_radius=sphere_radius(loaded.plant, loaded.scene_graph, TOOL),
        # A fruit is weighed; of its shape only a radius is known.
        ball_mass=ball.default_mass() if fruit is None else fruit.mass,
        ball_radius=sphere_radius(loaded.plant, loaded.scene_graph, "ball"),
    ), scene


PROJECTIONS = {"qp": QpProjection, "exact": ExactProjection, "plus": PlusProjection}


def c3_config(planner: PlannerConfig, n_lam: int, projection: str = "plus") -> C3Config:
    """Args: projection, of PROJECTIONS: `plus` has weights of eta, the others none."""
    for name in ("tip", "ball", "ball_velocity"):
        if not getattr(planner, name) >= 0.0:
            raise ValueError(
                f"planner.{name} is {getattr(planner, name)}, expected >= 0"
            )
    if not planner.force > 0.0:
        raise ValueError(f"planner.force is {planner.force}, expected > 0")
    Q = np.zeros(N_X)
    Q[P_TIP], Q[V_TIP] = planner.tip, planner.tip / 50.0
    Q[P_BALL] = planner.ball
    Q[V_BALL] = Q[W_BALL] = planner.ball_velocity
    G = plus_weights(planner.force, n_lam, N_TIP)
    if projection != "plus":
        G = G[: N_X + n_lam + 3]
    return C3Config(
        weights=C3Weights(Q, np.full(3, 0.01), G, G),
        projection=PROJECTIONS[projection](),
        options=planner.options,
        residual_dt_sec=LEARN,
        sliding_command=planner.sliding_command,
    )


def learner_config(
    learner: LearnerConfig, from_beside: SampledContactsConfig | None = None
) -> ResidualLearnerConfig:
    """Args: from_beside: of a tip that pushes from beside; None: from above."""
    for name in ("weight_ball", "weight_tip"):
        if not getattr(learner, name) >= 0.0:
            raise ValueError(
                f"learning.{name} is {getattr(learner, name)}, expected >= 0"
            )
    Q_d = np.zeros(N_X)
    # A tip pressed on a surface that is not there is also explained by two friction
    # forces that cancel; only its missing rebound, v_z, shows that nothing touched.
    Q_d[V_TIP.start + 2] = learner.weight_tip
    Q_d[[V_BALL.start, V_BALL.start + 1]] = learner.weight_ball
    if from_beside is not None:
        Q_d[:] = 0.0
        Q_d[[V_BALL.start, V_BALL.start + 1]] = from_beside.learning_weight
    eps, posterior = learner.eps, learner.posterior
    if from_beside is not None:
        eps = from_beside.learning_eps
        drift = from_beside.learning_drift
        posterior = replace(
            posterior, walk=replace(posterior.walk, drift=drift, growth=0.0)
        )
    return ResidualLearnerConfig(
        Q_d=Q_d.tolist(),
        eps=eps,
        gamma=learner.gamma,
        # The gap is one number: the tip's four forces share one residual. The table's
        # contact does not adapt.
        groups=[list(range(N_TIP))],
        r_max=learner.r_max,
        slip_noise=learner.slip_noise,
        posterior=posterior,
    )


def learned_parameters(config: BallRollingConfig) -> list[Parameter]:
    """Those of learner=parameters. Raises: ValueError for none, or one below 0."""
    if not config.adapt or config.learner != "parameters":
        return []
    own = config.parameters
    return to_learn(own, ("mass", "friction", "rolling", "gap"), lambda: [
        Parameter("mass", own.mass, "ball"),
        Parameter("friction", own.friction, pairs=[0]),
        Parameter("friction", own.friction, pairs=[1]),
        Parameter("rolling", own.rolling, pairs=[1]),
        Parameter("gap", own.gap, pairs=[0]),
    ])  # fmt: skip


def parameter_learner_config(
    config: BallRollingConfig,
    ball_radius: float,
    pairs: list[ContactPair],
    items: list[Parameter],
) -> ParameterLearnerConfig:
    """The weights are those of the residual's learner; the tip's motion along the table
    weighs as the ball's, and so do the ball's turning, as its rolling, and its staying
    on the table: what it is pressed with there is what resists its rolling."""
    Q_d = np.array(learner_config(config.learning).Q_d)
    ball = Q_d[V_BALL.start]
    Q_d[V_TIP.start : V_TIP.start + 2] = Q_d[V_BALL] = ball
    Q_d[W_BALL.start : W_BALL.start + 2] = ball * ball_radius**2
    return ParameterLearnerConfig(
        pairs,
        items,
        Q_d.tolist(),
        config.parameters.contact_std,
        slip_noise=config.learning.slip_noise,
    )


def paper_learner_config(n_lam: int) -> ResidualLearnerConfig:
    """The paper's: every entry for itself, following the gradient of the loss; Q_d 1e5
    on the ball's velocity alone, eps 1e-7 and gamma 1e-2 for an impulse, xi 1e-3."""
    Q_d = np.zeros(N_X)
    Q_d[V_BALL] = 1e5
    return ResidualLearnerConfig(
        Q_d=Q_d.tolist(),
        eps=1e-7 / LEARN,
        gamma=1e-2 * LEARN,
        adam=AdamConfig(n_b=10, learning_rate=1e-3),
        groups=[[i] for i in range(n_lam)],
    )
