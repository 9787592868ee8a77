"""A Panda rolls a ball, which it models wrongly, along a circle (ACI-MPC VII-B).

    station --image--> ball_tracker --> state_estimator <-- q, v, torque -- station
    state_estimator --x--> lcs_plan, lcs_command, lcs_learn, rolling_task
    lcs_learn --> residual_learner --r_comp--> c3_mpc, rolling_task
    lcs_plan, lcs_command, rolling_task --x_desired--> c3_mpc
    c3_mpc (roll), rolling_task (reposition) --> arm_reference
    arm_reference --> impedance_controller --tau--> station

Nothing passes from the world to the controllers but encoders, torques and pictures.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    Demultiplexer,
    LogVectorOutput,
    MatrixGain,
)

from makebreak.diagrams.camera import CameraConfig, camera_model
from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import (
    ARM,
    BALL_ROLLING,
    TIP_FRAME,
    TOOL,
    StationConfig,
    make_control_plant,
    make_station,
)
from makebreak.models.effects.kind import Effect
from makebreak.models.scene import Scene, load_scene, read_scene
from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
from makebreak.systems.arm_reference import ArmReference, ArmReferenceConfig
from makebreak.systems.ball_tracker import BallTracker, BallTrackerConfig
from makebreak.systems.c3_mpc import C3Config, C3Mpc
from makebreak.systems.impedance_controller import (
    HybridConfig,
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.lcs_builder import (
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.numerics.ball_state import (
    N_X,
    P_BALL,
    P_TIP,
    V_BALL,
    V_TIP,
    W_BALL,
)
from makebreak.systems.numerics.c3_mpc import C3Options, C3Weights
from makebreak.systems.residual_learner import ResidualLearner, ResidualLearnerConfig
from makebreak.systems.rolling_task import RollingTask, RollingTaskConfig
from makebreak.systems.rolling_view import RollingView, RollingViewConfig
from makebreak.systems.state_estimator import StateEstimator, StateEstimatorConfig

# Periods [s]. The estimator's divides C3's and the learner's: no reading is stale.
TRACK = CONTROL = 0.0125
ESTIMATE, LEARN, ARM_TICK = CONTROL / 3.0, 0.05, 0.001
# Each system runs a little after the one that it listens to, and all within the
# millisecond between two steps of the plant: no value waits for the next period. (But
# for r_comp in the task's landing height, which may be 12.5 ms old.)
OFFSET = dict(
    tracker=1e-4, estimator=2e-4, task=3e-4, lcs=3e-4, learner=3.5e-4, c3=4e-4,
    reference=4.5e-4, impedance=7e-4,
)  # fmt: skip
PLAN_DT, TIP_MASS, N_TIP = 0.1, 1.0, 4  # N_TIP: forces of tip and ball, the first ones.


@dataclass
class PlannerConfig:
    """Costs of C3+ and its ADMM weights; forces in newtons."""

    N: int = 5  # Knots of 0.1 s.
    rounds: int = 4
    rho: float = 2.2
    tip: float = 500.0  # Position of the tip; its velocity weighs 1/50 of it.
    ball: float = 5000.0  # Position of the ball, across the table.
    ball_velocity: float = 300.0  # And angular velocity.
    force: float = 5.0  # G of lam of tip and ball; eta's is 1/10 of it.
    friction: float = 1.0  # Of both contacts, for planning and learning.


@dataclass
class LearnerConfig:
    learning_rate: float = 8e-3  # [m/s] per update, 0.4 mm of gap.
    n_b: int = 10
    weight_ball: float = 2e4  # Q_d of the ball's v_x, v_y, seen by the camera, ...
    weight_tip: float = 1e5  # ... and of the tip's v_z, felt by the joints: less noise.
    eps: float = 2e-6  # 1e-7 / 0.05 s: the paper's, for forces in newtons.
    gamma: float = 5e-4  # 1e-2 * 0.05 s, likewise.
    r_max: float = 1.0  # [m/s]: 50 mm.


@dataclass
class BallRollingConfig:
    """World and model start from the same scene; errors change the model, conditions
    the world."""

    adapt: bool = True
    radius_error_m: float = 0.005  # Model minus world.
    friction: float = 0.5  # Of the ball with tip and table.
    rolling_resistance: float = 0.005  # Lever arm over radius.
    ball_noise_m: float = 0.001  # Shift of each picture, each way.
    start_angle_rad: float | None = None  # Of the ball on the circle; None: by seed.
    world: str = BALL_ROLLING
    model: str = BALL_ROLLING
    seed: int = 0
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracker: BallTrackerConfig = field(
        default_factory=lambda: BallTrackerConfig(
            position_std=1.5e-3, acceleration_density=4e-3
        )
    )
    task: RollingTaskConfig = field(default_factory=RollingTaskConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    impedance: ImpedanceConfig = field(default_factory=ImpedanceConfig)


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


def world_scene(config: BallRollingConfig) -> Scene:
    """The scene that is simulated: friction, resistance, where the ball lies."""
    scene = read_scene(config.world)
    check_parts(scene, "world")
    angle = config.start_angle_rad
    if angle is None:
        angle = np.random.default_rng(config.seed).uniform(-np.pi, np.pi)
    center, radius = np.array(config.task.center), config.task.radius
    xy = center + radius * np.array([np.cos(angle), np.sin(angle)])
    z = scene.initial.poses["ball.ball"][6]
    scene.initial.poses["ball.ball"] = [
        1.0,
        0.0,
        0.0,
        0.0,
        float(xy[0]),
        float(xy[1]),
        z,
    ]
    if not config.friction > 0.0:
        raise ValueError(f"friction is {config.friction}, expected > 0")
    if not config.rolling_resistance >= 0.0:
        raise ValueError(
            f"rolling_resistance is {config.rolling_resistance}, expected >= 0"
        )
    for pair in (f"{TOOL}~ball", "ball~table"):
        scene.effects.append(
            Effect("contact_friction", [pair], {"friction": config.friction})
        )
    if config.rolling_resistance > 0.0:
        resistance = {"coefficient": config.rolling_resistance}
        scene.effects.append(Effect("rolling_resistance", ["ball~table"], resistance))
    return scene


def believed(config: BallRollingConfig) -> tuple[TipAndBall, Scene]:
    """What the controllers believe: tip and ball, and the model's scene."""
    scene = read_scene(config.model)
    check_parts(scene, "model")
    if config.radius_error_m != 0.0:
        loaded = load_scene(scene, DiagramBuilder())
        right = sphere_radius(loaded.plant, loaded.scene_graph, "ball")
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
        ball_mass=ball.default_mass(),
        ball_radius=sphere_radius(loaded.plant, loaded.scene_graph, "ball"),
    ), scene


def c3_config(planner: PlannerConfig, n_lam: int) -> C3Config:
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
    # lam : eta = 10 : 1 makes the two comparable; the table's contact is left loose, so
    # that the first rounds may lift the ball a little to find a push.
    contact = np.full(n_lam, 0.002)
    contact[:N_TIP] = 1.0
    G = np.concatenate([
        np.full(N_X, 1e-9),
        planner.force * contact,
        np.full(3, 1e-9),
        0.1 * planner.force * contact,
    ])  # fmt: skip
    return C3Config(
        weights=C3Weights(Q, np.full(3, 0.01), G, G),
        options=C3Options(N=planner.N, rounds=planner.rounds, rho=planner.rho),
        residual_dt_sec=LEARN,
    )


def learner_config(learner: LearnerConfig) -> ResidualLearnerConfig:
    for name in ("weight_ball", "weight_tip"):
        if not getattr(learner, name) >= 0.0:
            raise ValueError(
                f"learner.{name} is {getattr(learner, name)}, expected >= 0"
            )
    Q_d = np.zeros(N_X)
    # A tip pressed on a surface that is not there is also explained by two friction
    # forces that cancel; only its missing rebound, v_z, shows that nothing touched.
    Q_d[V_TIP.start + 2] = learner.weight_tip
    Q_d[[V_BALL.start, V_BALL.start + 1]] = learner.weight_ball
    return ResidualLearnerConfig(
        Q_d=Q_d.tolist(),
        eps=learner.eps,
        gamma=learner.gamma,
        n_b=learner.n_b,
        learning_rate=learner.learning_rate,
        # The gap is one number: the tip's four forces share one residual. The table's
        # contact does not adapt.
        groups=[list(range(N_TIP))],
        r_max=learner.r_max,
    )


def make_ball_rolling(
    config: BallRollingConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The whole experiment: the station and its controllers, each by name in the
    diagram. For scoring, `state_log`, `contact_log` and `torque_log` log the truth at
    1 kHz: the plant's state, the contact's torque on the arm, the commanded torque.
    """
    builder = DiagramBuilder()
    add_ball_rolling(builder, config, meshcat)
    connect_reference(builder)
    diagram = builder.Build()
    diagram.set_name("ball_rolling")
    return diagram


def add_ball_rolling(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    meshcat: Meshcat | None = None,
    sampled: bool = False,
    hybrid: HybridConfig | None = None,
) -> None:
    """Adds and connects all but what leads from the task to the arm: that is
    connect_reference's, or another diagram's.

    Args: sampled: of the station's sensors, StationConfig; hybrid: of the arm's force
        control, which nothing here asks for.
    """
    for name, own in (
        ("tracker", ("ball_radius", "period_sec", "offset_sec")),
        ("task", ("period_sec", "offset_sec")),
        ("impedance", ("period_sec", "offset_sec")),
        ("camera", ("period_sec",)),
    ):
        part = getattr(config, name)
        for key in own:
            default = getattr(type(part)(), key)
            if getattr(part, key) != default:
                raise ValueError(
                    f"{name}.{key} is {getattr(part, key)}, expected {default}: the "
                    "diagram sets it"
                )
    model, model_scene = believed(config)
    if config.camera.position_noise_m != 0.0:
        raise ValueError(
            f"camera.position_noise_m is {config.camera.position_noise_m}, expected 0: "
            "ball_noise_m sets it"
        )
    if not config.ball_noise_m >= 0.0:
        raise ValueError(f"ball_noise_m is {config.ball_noise_m}, expected >= 0")
    camera = replace(config.camera, position_noise_m=config.ball_noise_m)
    station = builder.AddNamedSystem(
        "station",
        make_station(
            StationConfig(
                scene=config.world,
                camera=camera,
                contact=[TOOL, "ball"],
                seed=config.seed,
                sampled=sampled,
            ),
            meshcat,
            world_scene(config),
        ),
    )
    arm = make_control_plant(model_scene)
    tip = arm.GetFrameByName(TIP_FRAME)
    p_tip = tip.CalcPoseInWorld(arm.CreateDefaultContext()).translation()

    pairs = [
        ContactPair("tip::tip", "ball::ball", config.planner.friction),
        ContactPair("ball::ball", "table::table", config.planner.friction),
    ]
    lcs, lcs_of = {}, {}
    for name, dt, period in (
        ("plan", PLAN_DT, CONTROL),
        ("command", CONTROL, CONTROL),
        ("learn", LEARN, LEARN),
    ):
        own = AnitescuLcsBuilder(
            make_tip_and_ball(model)[0],
            LcsBuilderConfig(pairs, dt, None, period, OFFSET["lcs"]),
        )
        lcs_of[name] = own.model
        lcs[name] = builder.AddNamedSystem(f"lcs_{name}", own)
    n_lam = lcs_of["plan"].n_lam

    tracker = builder.AddNamedSystem(
        "ball_tracker",
        BallTracker(
            replace(
                config.tracker,
                ball_radius=model.ball_radius,
                period_sec=TRACK,
                offset_sec=OFFSET["tracker"],
            ),
            camera_model(camera),
        ),
    )
    estimator = builder.AddNamedSystem(
        "state_estimator",
        StateEstimator(
            StateEstimatorConfig(
                ball_radius=model.ball_radius,
                tip_mass=model.tip_mass,
                window_sec=LEARN,
                period_sec=ESTIMATE,
                offset_sec=OFFSET["estimator"],
            ),
            serial_chain_of(arm, TIP_FRAME),
            arm.GetPositions(arm.CreateDefaultContext()),
        ),
    )
    c3 = builder.AddNamedSystem(
        "c3_mpc", C3Mpc(c3_config(config.planner, n_lam), CONTROL, OFFSET["c3"])
    )
    task = builder.AddNamedSystem(
        "rolling_task",
        RollingTask(
            replace(config.task, period_sec=CONTROL, offset_sec=OFFSET["task"]),
            n_knots=config.planner.N + 1,
            knot_sec=PLAN_DT,
            radius_ball=model.ball_radius,
            radius_tip=model.tip_radius,
            n_lam=n_lam,
            n_tip=N_TIP,
            residual_dt_sec=LEARN,
            p_tip=p_tip,
        ),
    )
    reference = builder.AddNamedSystem(
        "arm_reference",
        ArmReference(
            ArmReferenceConfig(
                tip_mass=model.tip_mass,
                period_sec=CONTROL,
                offset_sec=OFFSET["reference"],
            ),
            n_lam,
            p_tip,
            lcs_of["command"].build(
                lcs_of["command"].x_default, np.zeros(lcs_of["command"].n_u)
            ),
        ),
    )
    impedance = builder.AddNamedSystem(
        "impedance_controller",
        ImpedanceController(
            replace(
                config.impedance, period_sec=ARM_TICK, offset_sec=OFFSET["impedance"]
            ),
            arm,
            TIP_FRAME,
            hybrid=hybrid,
        ),
    )
    no_force = builder.AddNamedSystem("no_force", ConstantVectorSource(np.zeros(3)))

    def connect(source, output, target, port):
        builder.Connect(source.GetOutputPort(output), target.GetInputPort(port))

    connect(station, "overhead.rgb_image", tracker, "image")
    connect(station, f"{ARM}.position_measured", estimator, "q")
    connect(station, f"{ARM}.velocity_measured", estimator, "v")
    connect(station, f"{ARM}.torque_measured", estimator, "torque")
    connect(tracker, "p_WB", estimator, "p_ball")
    connect(tracker, "v_WB", estimator, "v_ball")
    connect(tracker, "seen", estimator, "seen")
    for one in lcs.values():
        connect(estimator, "x", one, "x")
        builder.Connect(no_force.get_output_port(), one.GetInputPort("u"))
    if config.adapt:
        learner = builder.AddNamedSystem(
            "residual_learner",
            ResidualLearner(
                learner_config(config.learner),
                lcs_of["learn"].build(
                    lcs_of["learn"].x_default, np.zeros(lcs_of["learn"].n_u)
                ),
                LEARN,
                OFFSET["learner"],
            ),
        )
        connect(estimator, "x", learner, "x")
        connect(estimator, "u_measured", learner, "u_measured")
        connect(estimator, "window_valid", learner, "enable")
        connect(lcs["learn"], "lcs", learner, "lcs")
        r_comp = learner.GetOutputPort("r_comp")
    else:
        zero = builder.AddNamedSystem(
            "no_residual", ConstantVectorSource(np.zeros(n_lam))
        )
        r_comp = zero.get_output_port()
    connect(estimator, "x", task, "x")
    connect(estimator, "valid", task, "valid")
    builder.Connect(r_comp, task.GetInputPort("r_comp"))
    connect(estimator, "x", c3, "x")
    connect(task, "x_desired", c3, "x_desired")
    connect(lcs["plan"], "lcs", c3, "lcs")
    connect(lcs["command"], "lcs", c3, "lcs_command")
    builder.Connect(r_comp, c3.GetInputPort("r_comp"))
    connect(task, "phase", reference, "phase")
    connect(c3, "x_next", reference, "x_next")
    connect(c3, "lam", reference, "lam")
    connect(c3, "status", reference, "status")
    connect(lcs["command"], "lcs", reference, "lcs")
    connect(station, f"{ARM}.position_measured", impedance, "q")
    connect(station, f"{ARM}.velocity_measured", impedance, "v")
    connect(impedance, "tau", station, f"{ARM}.torque_commanded")

    # For scoring and for the eye alone.
    plant = station.GetSubsystemByName("plant")
    for name, source in (
        ("state_log", station.GetOutputPort("state")),
        ("contact_log", station.GetOutputPort(f"{ARM}.contact_torque")),
        ("torque_log", impedance.GetOutputPort("tau")),
    ):
        LogVectorOutput(source, builder, ARM_TICK).set_name(name)
    gap = np.zeros((1, n_lam))
    gap[0, :N_TIP] = LEARN / N_TIP
    gap_of_r = builder.AddNamedSystem("learned_gap", MatrixGain(gap))
    builder.Connect(r_comp, gap_of_r.get_input_port())
    if meshcat is not None:
        view = builder.AddNamedSystem(
            "rolling_view",
            RollingView(
                RollingViewConfig(
                    center=config.task.center,
                    radius=config.task.radius,
                    ball_radius=model.ball_radius,
                ),
                meshcat,
            ),
        )
        select = np.zeros((3, plant.num_multibody_states()))
        at = plant.GetBodyByName("ball").floating_positions_start() + 4
        select[:, at : at + 3] = np.eye(3)
        p_ball = builder.AddNamedSystem("true_ball", MatrixGain(select))
        builder.Connect(station.GetOutputPort("state"), p_ball.get_input_port())
        builder.Connect(p_ball.get_output_port(), view.GetInputPort("p_ball"))
        connect(estimator, "x", view, "x")
        builder.Connect(gap_of_r.get_output_port(), view.GetInputPort("gap"))


def connect_reference(builder: DiagramBuilder) -> None:
    """The task's own reposition, and the reference straight to the arm."""
    task, reference, arm = (
        builder.GetSubsystemByName(name)
        for name in ("rolling_task", "arm_reference", "impedance_controller")
    )
    builder.Connect(
        task.GetOutputPort("reference"), reference.GetInputPort("reference")
    )
    sizes = [reference.GetOutputPort(name).size() for name in ("x_desired", "wrench")]
    # Both at once: a port of a Python system costs more than what it works out.
    split = builder.AddNamedSystem("arm_command_split", Demultiplexer(sizes))
    builder.Connect(reference.GetOutputPort("command"), split.get_input_port())
    for i, name in enumerate(("x_desired", "wrench_feedforward")):
        builder.Connect(split.get_output_port(i), arm.GetInputPort(name))
