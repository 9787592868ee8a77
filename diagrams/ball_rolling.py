"""A Panda rolls a ball, which it models wrongly, along a circle (ACI-MPC VII-B).

    station --image--> ball_tracker --> state_estimator <-- q, v, torque -- station
    state_estimator --x--> lcs_plan, lcs_command, lcs_learn, rolling_task
    lcs_learn --> residual_learner --r_comp--> c3_mpc, rolling_task
    lcs_plan, lcs_command, rolling_task --x_desired--> c3_mpc
    c3_mpc (roll), rolling_task (reposition) --> arm_reference
    arm_reference --> impedance_controller --tau--> station

With contact_sequence=sampled diagrams/sampled_contacts.py takes rolling_task's place.

Nothing passes from the world to the controllers but encoders, torques and pictures.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    LogVectorOutput,
    MatrixGain,
)

from makebreak.diagrams import wiring
from makebreak.diagrams.ball_rolling_config import (
    LEARN,
    N_TIP,
    PLAN_DT,
    BallRollingConfig,
    c3_config,
    controller_model,
    learned_parameters,
    learner_config,
    paper_learner_config,
    parameter_learner_config,
    what_goes_wrong,
    world_scene,
)
from makebreak.diagrams.camera import camera_model
from makebreak.diagrams.faults import faulty_lcs
from makebreak.diagrams.learned_parameters import add_gap_std, add_parameter_learner
from makebreak.diagrams.realism import draw_errors
from makebreak.diagrams.recorder import record_station
from makebreak.diagrams.sampled_contacts import (
    add_sampled_contacts,
    check_contacts,
    sampled_c3_config,
)
from makebreak.diagrams.station import (
    ARM,
    DELAY,
    TIP_FRAME,
    TOOL,
    StationConfig,
    control_laws,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.wiring import (
    add_legend,
    check_own,
    connect_command,
    refuse_unused,
)
from makebreak.models.fruit import FRUITS
from makebreak.models.scene import Scene
from makebreak.models.tip_and_ball import make_tip_and_ball
from makebreak.systems.arm.arm_reference import (
    ArmReference,
    ArmReferenceConfig,
    FollowConfig,
)
from makebreak.systems.arm.impedance_controller import (
    HybridConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.baselines.dynamics_residual import DynamicsResidual
from makebreak.systems.baselines.dynamics_residual_learner import (
    DynamicsResidualLearner,
    DynamicsResidualLearnerConfig,
)
from makebreak.systems.contact_mpc.c3_mpc import C3Mpc
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcs,
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearner
from makebreak.systems.contact_mpc.path_target import PathTargetConfig
from makebreak.systems.contact_mpc.residual_learner import ResidualLearner
from makebreak.systems.contact_mpc.rolling_task import RollingTask
from makebreak.systems.perception.ball_tracker import BallTracker
from makebreak.systems.perception.state_estimator import (
    StateEstimator,
    StateEstimatorConfig,
)
from makebreak.systems.views.adapt_button import AdaptButton
from makebreak.systems.views.legend import LegendConfig
from makebreak.systems.views.model_sliders import ModelSliders
from makebreak.systems.views.rolling_view import RollingView, RollingViewConfig

# Periods [s]. The estimator's divides C3's and the learner's: no reading is stale.
TRACK = CONTROL = 0.0125
ESTIMATE, ARM_TICK = CONTROL / 3.0, 0.001
# Each system runs a little after the one that it listens to, and all within the
# millisecond between two steps of the plant: no value waits for the next period. (But
# for r_comp in the task's landing height, which may be 12.5 ms old.)
OFFSET = dict(
    tracker=1e-4, estimator=2e-4, target=2.5e-4, task=3e-4, lcs=3e-4, learner=3.5e-4,
    sampler=3.5e-4, c3=4e-4, reference=4.5e-4, impedance=7e-4,
)  # fmt: skip
BALL_CHANNELS = ("ball.ball.x", "ball.ball.y")  # What a camera above sees of it.


def make_world(
    config: BallRollingConfig,
    meshcat: Meshcat | None = None,
    sampled: bool = False,
    scene: Scene | None = None,
) -> Diagram:
    """The station: what is simulated of the experiment, without any controller.

    Args: scene, in place of world_scene(config).
    """
    if config.camera.position_noise_m != 0.0:
        raise ValueError(
            f"camera.position_noise_m is {config.camera.position_noise_m}, expected 0: "
            "ball_noise_m sets it"
        )
    if not config.ball_noise_m >= 0.0:
        raise ValueError(f"ball_noise_m is {config.ball_noise_m}, expected >= 0")
    return make_station(
        StationConfig(
            scene=config.world,
            camera=replace(config.camera, position_noise_m=config.ball_noise_m),
            contact=[TOOL, "ball"],
            seed=config.seed,
            sampled=sampled,
        ),
        meshcat,
        world_scene(config) if scene is None else scene,
        draw_errors(config.realism, config.seed),
        wrong=what_goes_wrong(config),
    )


def make_ball_rolling(
    config: BallRollingConfig,
    meshcat: Meshcat | None = None,
    station: Diagram | None = None,
) -> Diagram:
    """The whole experiment: the station and its controllers, each by name in the
    diagram. For scoring, `state_log`, `contact_log` and `torque_log` log the truth at
    1 kHz: the plant's state, the contact's torque on the arm, the commanded torque.

    Args: station, what the controllers are wired to in place of the simulated world;
        its inputs that nobody gives are the diagram's own.
    """
    builder = DiagramBuilder()
    add_ball_rolling(builder, config, meshcat, station=station)
    connect_reference(builder)
    diagram = builder.Build()
    diagram.set_name("ball_rolling")
    return diagram


# Of the task, as the legend says them.
PHASES = (
    "now: rolls the ball",
    "now: moves to where it will touch next",
    "now: waits for the ball to be seen",
    "now: approaches the ball",
)
# Settings that the diagram makes of others.
_OWN = {
    "tracker": ("ball_radius", "period_sec", "offset_sec"),
    "task": ("period_sec", "offset_sec"),
    "impedance": ("period_sec", "offset_sec"),
    "camera": ("period_sec",),
}


def add_ball_rolling(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    meshcat: Meshcat | None = None,
    sampled: bool = False,
    hybrid: HybridConfig | None = None,
    station: Diagram | None = None,
    follow_hard: bool = False,
) -> None:
    """Adds and connects all but what leads from the task to the arm: that is
    connect_reference's, or another diagram's.

    Args: sampled: of the station's sensors, StationConfig; hybrid: of the arm's force
        control, which nothing here asks for; station, in place of the simulated world:
        it has the sensors' ports, but may lack the truth and the wrench, and have ball
        positions (`ball.p_WB`, `ball.v_WB`, `ball.seen`) in place of pictures;
        follow_hard: of the arm's reference.
    """
    check_own(config, _OWN)
    model, model_scene = controller_model(config)
    learner_kind = config.learner if config.adapt else "none"
    projection = config.projection
    if projection == "auto":
        projection = "qp" if config.controller == "paper" else "plus"
    samples = config.contact_sequence == "sampled"
    if samples:
        _check_sampled(config, projection, learner_kind)
    _refuse_unused(config)
    wrong = what_goes_wrong(config)
    if station is None:
        station = make_world(config, meshcat, sampled)
    station = builder.AddNamedSystem("station", station)
    arm = make_control_plant(model_scene)
    tip = arm.GetFrameByName(TIP_FRAME)
    p_tip = tip.CalcPoseInWorld(arm.CreateDefaultContext()).translation()

    items = learned_parameters(config)
    lcs, lcs_of = _add_models(builder, config, model, items)
    n_lam = lcs_of["plan"].n_lam
    estimator = _add_sensing(builder, config, model, station, arm)
    task: LeafSystem
    if samples:
        c3_settings = sampled_c3_config(
            config.contacts.planner, n_lam, N_TIP, model.ball_radius, LEARN
        )
        circle = PathTargetConfig(center=config.task.center, radius=config.task.radius)
        contacts = add_sampled_contacts(
            builder, config.contacts, circle, model, lcs_of["plan"], c3_settings, p_tip,
            N_TIP, CONTROL, OFFSET, estimator,
        )  # fmt: skip
        task, target = contacts.task, contacts.target
        reference_settings = replace(
            config.contacts.reference, height=config.contacts.sampler.sampling.height
        )
    else:
        c3_settings = c3_config(config.planner, n_lam, projection)
        target = task = _add_cycle(builder, config, model, n_lam, p_tip)
        reference_settings = ArmReferenceConfig(follow=FollowConfig(hard=follow_hard))
    c3 = builder.AddNamedSystem("c3_mpc", C3Mpc(c3_settings, CONTROL, OFFSET["c3"]))
    reference = builder.AddNamedSystem(
        "arm_reference",
        ArmReference(
            replace(
                reference_settings,
                tip_mass=model.tip_mass,
                period_sec=CONTROL,
                offset_sec=OFFSET["reference"],
            ),
            n_lam,
            p_tip,
            lcs_of["command"].at_default(),
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
            laws=control_laws(model_scene, arm),
        ),
    )

    connect = partial(wiring.connect, builder)
    no_force = builder.AddNamedSystem("no_force", ConstantVectorSource(np.zeros(3)))
    for one in lcs.values():
        connect(estimator, "x", one, "x")
        builder.Connect(no_force.get_output_port(), one.GetInputPort("u"))
    # Where C3 and the arm's reference have their models from.
    lcs_port = {name: one.GetOutputPort("lcs") for name, one in lcs.items()}
    if meshcat is not None and not samples:  # The sampler has a model of its own.
        sliders = builder.AddNamedSystem(
            "model_sliders",
            ModelSliders(lcs_of["plan"].n_pairs * [config.planner.friction], meshcat),
        )
        for one in lcs.values():
            connect(sliders, "friction", one, "friction")
            connect(sliders, "gap", one, "gap")
    if learner_kind in ("r_dyn", "both"):
        lcs_port |= _add_dynamics_residual(builder, lcs, lcs_of, estimator)
    if items:
        learner = ParameterLearner(
            make_tip_and_ball(model)[0],
            parameter_learner_config(
                config, _pairs(config.planner.friction, ContactPair().tangent), items
            ),
            LEARN,
            OFFSET["learner"],
        )
        r_comp = add_parameter_learner(
            builder, learner, estimator, "window_valid", [lcs["plan"], lcs["command"]],
            N_TIP, LEARN,
        )  # fmt: skip
        builder.Connect(
            add_gap_std(builder, learner, LEARN), task.GetInputPort("r_std")
        )
    elif learner_kind in ("r_comp", "both"):
        r_comp = _add_learner(builder, config, lcs, lcs_of, estimator, task)
        if meshcat is not None:
            button = builder.AddNamedSystem("adapt_button", AdaptButton(n_lam, meshcat))
            builder.Connect(r_comp, button.get_input_port())
            r_comp = button.get_output_port()
    else:
        zero = builder.AddNamedSystem(
            "no_residual", ConstantVectorSource(np.zeros(n_lam))
        )
        r_comp = zero.get_output_port()
    gap = _mean_of_tip(builder, "learned_gap", r_comp, n_lam, LEARN)
    if samples:
        for system in (contacts.sampler, contacts.target):
            builder.Connect(r_comp, system.GetInputPort("r_comp"))
        nearer = _mean_of_tip(builder, "learned_reach", r_comp, n_lam, -LEARN)
        builder.Connect(nearer, task.GetInputPort("nearer"))
        if builder.HasSubsystemNamed("ball_tracker"):
            # Beside the ball the gap is what its radius is too large by.
            tracker = builder.GetSubsystemByName("ball_tracker")
            builder.Connect(gap, tracker.GetInputPort("radius_error"))
    else:
        connect(estimator, "x", task, "x")
        connect(estimator, "valid", task, "valid")
        connect(estimator, "tip_force", task, "tip_force")
        builder.Connect(r_comp, task.GetInputPort("r_comp"))
    connect(estimator, "x", c3, "x")
    connect(target, "x_desired", c3, "x_desired")
    if wrong is not None:
        example = lcs_of["plan"].at_default()
        lcs_port["plan"] = faulty_lcs(builder, lcs_port["plan"], example, wrong.faults)
    builder.Connect(lcs_port["plan"], c3.GetInputPort("lcs"))
    builder.Connect(lcs_port["command"], c3.GetInputPort("lcs_command"))
    builder.Connect(r_comp, c3.GetInputPort("r_comp"))
    connect(task, "phase", reference, "phase")
    connect(c3, "x_next", reference, "x_next")
    connect(c3, "lam", reference, "lam")
    connect(c3, "status", reference, "status")
    connect(lcs["command"], "lcs", reference, "lcs")
    if not samples:
        connect(task, "feel", reference, "feel")
    connect(station, f"{ARM}.position_measured", impedance, "q")
    connect(station, f"{ARM}.velocity_measured", impedance, "v")
    if station.HasOutputPort(DELAY):
        connect(station, DELAY, impedance, "delay")
    connect(impedance, "tau", station, f"{ARM}.torque_commanded")

    for i in range(station.num_input_ports()):
        port = station.get_input_port(i)
        if port.get_name() not in (f"{ARM}.torque_commanded", "overhead.region"):
            builder.ExportInput(port, port.get_name())

    _add_records(builder, station, impedance, estimator)
    if meshcat is not None:
        _add_view(builder, config, model, meshcat, station, estimator, gap, task)


def _check_sampled(
    config: BallRollingConfig, projection: str, learner_kind: str
) -> None:
    """Raises: ValueError for what sampled contacts do not go with."""
    check_contacts(config.contacts)
    for name, value, expected in (
        ("controller", config.controller, ("ours",)),
        ("projection", projection, ("plus",)),
        ("learner", learner_kind, ("none", "r_comp")),
    ):
        if value not in expected:
            raise ValueError(
                f"{name}={value} with contact_sequence=sampled, expected "
                + " or ".join(expected)
            )


def _refuse_unused(config: BallRollingConfig) -> None:
    """Raises: ValueError for settings of parts that the chosen ones replace."""
    plain = BallRollingConfig()
    # Both ways of choosing contacts read the circle.
    plain.task.center, plain.task.radius = config.task.center, config.task.radius
    unused = ["contacts"]
    if config.contact_sequence == "sampled":
        # `contacts` has its own in place of those of the learner.
        learner = ("weight_ball", "weight_tip", "eps", "posterior.drift")
        unused = ["task", "planner", *(f"learning.{name}" for name in learner)]
        unused.append("learning.posterior.growth")
    for name in unused:
        why = f"not used with contact_sequence={config.contact_sequence}"
        refuse_unused(config, plain, name, why)
    if config.controller == "paper":
        refuse_unused(config, plain, "learning", "not used with controller=paper")
    if not (config.adapt and config.learner == "parameters"):
        why = "used with learner=parameters alone"
        refuse_unused(config, plain, "parameters", why)


def _add_models(
    builder: DiagramBuilder, config: BallRollingConfig, model, items
) -> tuple[dict[str, LeafSystem], dict[str, AnitescuLcs]]:
    """The three LCS: as systems, and what they build with."""
    friction, tangent = config.planner.friction, ContactPair().tangent
    if config.contact_sequence == "sampled":
        # Edges along the vertical do not jump as the normal goes around the ball.
        friction, tangent = config.contacts.planner.friction, [0.0, 0.0, 1.0]
    pairs = _pairs(friction, tangent)
    planned = [item for item in items if item.kind != "gap"]
    lcs, lcs_of = {}, {}
    for name, dt, period in (
        ("plan", PLAN_DT, CONTROL),
        ("command", CONTROL, CONTROL),
        ("learn", LEARN, LEARN),
    ):
        own = AnitescuLcsBuilder(
            make_tip_and_ball(model)[0],
            LcsBuilderConfig(
                pairs, dt, None, period, OFFSET["lcs"], parameters=planned
            ),
        )
        lcs_of[name] = own.model
        lcs[name] = builder.AddNamedSystem(f"lcs_{name}", own)
    return lcs, lcs_of


def _pairs(friction: float, tangent) -> list[ContactPair]:
    return [
        ContactPair("tip::tip", "ball::ball", friction, tangent=tangent),
        ContactPair("ball::ball", "table::table", friction),
    ]


def _mean_of_tip(
    builder: DiagramBuilder, name: str, r_comp: OutputPort, n_lam: int, scale: float
) -> OutputPort:
    """(1,) scale times the mean of the entries of r_comp for tip and ball."""
    mean = np.zeros((1, n_lam))
    mean[0, :N_TIP] = scale / N_TIP
    gain = builder.AddNamedSystem(name, MatrixGain(mean))
    builder.Connect(r_comp, gain.get_input_port())
    return gain.get_output_port()


def _add_sensing(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    model,
    station: Diagram,
    arm: MultibodyPlant,
) -> StateEstimator:
    """The tracker, where there are pictures, and the estimator of arm and ball."""
    tracker = None
    if station.HasOutputPort("overhead.rgb_image"):
        hue = config.tracker.hue
        tracker = builder.AddNamedSystem(
            "ball_tracker",
            BallTracker(
                replace(
                    config.tracker,
                    ball_radius=model.ball_radius,
                    hue=hue if config.object == "ball" else FRUITS[config.object].hue,
                    period_sec=TRACK,
                    offset_sec=OFFSET["tracker"],
                ),
                camera_model(
                    replace(config.camera, position_noise_m=config.ball_noise_m)
                ),
            ),
        )
        builder.Connect(
            station.GetOutputPort("overhead.rgb_image"), tracker.GetInputPort("image")
        )
        if station.HasInputPort("overhead.region"):
            builder.Connect(
                tracker.GetOutputPort("region"), station.GetInputPort("overhead.region")
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
    for name, port in (("position", "q"), ("velocity", "v"), ("torque", "torque")):
        measured = station.GetOutputPort(f"{ARM}.{name}_measured")
        builder.Connect(measured, estimator.GetInputPort(port))
    for name, port in (("p_WB", "p_ball"), ("v_WB", "v_ball"), ("seen", "seen")):
        source, of = (station, f"ball.{name}") if tracker is None else (tracker, name)
        builder.Connect(source.GetOutputPort(of), estimator.GetInputPort(port))
    return estimator


def _add_cycle(
    builder: DiagramBuilder, config: BallRollingConfig, model, n_lam: int, p_tip
) -> RollingTask:
    return builder.AddNamedSystem(
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


def _add_dynamics_residual(
    builder: DiagramBuilder, lcs, lcs_of, estimator: StateEstimator
) -> dict[str, OutputPort]:
    """A learner of the dynamics' residual. Returns: the LCS that have it."""
    r_dyn = builder.AddNamedSystem(
        "dynamics_residual_learner",
        DynamicsResidualLearner(
            DynamicsResidualLearnerConfig(),
            lcs_of["learn"].at_default(),
            LEARN,
            OFFSET["learner"],
        ),
    )
    for name in ("x", "u_measured"):
        wiring.connect(builder, estimator, name, r_dyn, name)
    wiring.connect(builder, lcs["learn"], "lcs", r_dyn, "lcs")
    ports = {}
    for name in ("plan", "command"):
        added = builder.AddNamedSystem(
            f"dynamics_residual_{name}",
            DynamicsResidual(lcs_of[name].at_default(), LEARN),
        )
        wiring.connect(builder, lcs[name], "lcs", added, "lcs")
        wiring.connect(builder, r_dyn, "r_dyn", added, "r_dyn")
        ports[name] = added.get_output_port()
    return ports


def _add_learner(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    lcs,
    lcs_of,
    estimator: StateEstimator,
    task: LeafSystem,
) -> OutputPort:
    """The learner of the contact's residual. Returns: what controllers get of it."""
    n_lam = lcs_of["plan"].n_lam
    samples = config.contact_sequence == "sampled"
    if config.controller == "paper":
        settings = paper_learner_config(n_lam)
    else:
        settings = learner_config(config.learning, config.contacts if samples else None)
    learner = builder.AddNamedSystem(
        "residual_learner",
        ResidualLearner(
            settings, lcs_of["learn"].at_default(), LEARN, OFFSET["learner"]
        ),
    )
    for name, port in (
        ("x", "x"), ("u_measured", "u_measured"), ("window_valid", "enable"),
    ):  # fmt: skip
        wiring.connect(builder, estimator, name, learner, port)
    wiring.connect(builder, lcs["learn"], "lcs", learner, "lcs")
    r_comp = learner.GetOutputPort("r_comp")
    if not samples:
        wiring.connect(builder, learner, "r_std", task, "r_std")
        return r_comp
    taken = np.zeros(n_lam)
    taken[:N_TIP] = -config.contacts.gap_allowance / LEARN
    allowance = builder.AddNamedSystem("gap_allowance", ConstantVectorSource(taken))
    cautious = builder.AddNamedSystem("cautious_residual", Adder(2, n_lam))
    builder.Connect(r_comp, cautious.get_input_port(0))
    builder.Connect(allowance.get_output_port(), cautious.get_input_port(1))
    return cautious.get_output_port()


def _is_simulated(station: Diagram) -> bool:
    """Whether there is a truth."""
    return station.HasSubsystemNamed("plant")


def _add_records(
    builder: DiagramBuilder,
    station: Diagram,
    impedance: ImpedanceController,
    estimator: StateEstimator,
) -> None:
    """What is scored, and what a recording has."""
    tau = impedance.GetOutputPort("tau")
    logged = {"torque_log": tau}
    if _is_simulated(station):
        logged["state_log"] = station.GetOutputPort("state")
        logged["contact_log"] = station.GetOutputPort(f"{ARM}.contact_torque")
    for name, source in logged.items():
        LogVectorOutput(source, builder, ARM_TICK).set_name(name)
    # The ball's height is no measurement: the tracker takes the model's radius for it.
    of_ball = [""] * N_X
    of_ball[P_BALL.start : P_BALL.start + 2] = BALL_CHANNELS
    seen = {"ball": (estimator.GetOutputPort("x"), of_ball)}
    record_station(builder, station, tau, TOOL, CONTROL, seen)


def _add_view(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    model,
    meshcat: Meshcat,
    station: Diagram,
    estimator: StateEstimator,
    gap: OutputPort,
    task: LeafSystem,
) -> None:
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
    x = estimator.GetOutputPort("x")
    if _is_simulated(station):
        plant = station.GetSubsystemByName("plant")
        state, size = station.GetOutputPort("state"), plant.num_multibody_states()
        at = plant.GetBodyByName("ball").floating_positions_start() + 4
    else:  # As it is estimated.
        state, size, at = x, N_X, P_BALL.start
    select = np.zeros((3, size))
    select[:, at : at + 3] = np.eye(3)
    p_ball = builder.AddNamedSystem("true_ball", MatrixGain(select))
    builder.Connect(state, p_ball.get_input_port())
    builder.Connect(p_ball.get_output_port(), view.GetInputPort("p_ball"))
    builder.Connect(x, view.GetInputPort("x"))
    builder.Connect(gap, view.GetInputPort("gap"))
    legend = LegendConfig(view.legend, PHASES, view.CAMERA, view.LOOK_AT)
    add_legend(builder, meshcat, legend, task.GetOutputPort("phase"))


def task_name(diagram: Diagram | DiagramBuilder) -> str:
    """Of the system that says when the tip pushes: its port `phase` is 0 then."""
    sampled = diagram.HasSubsystemNamed("push_task")
    return "push_task" if sampled else "rolling_task"


def connect_reference(builder: DiagramBuilder) -> None:
    """The task's own reposition, the force as the joints feel it, and the reference
    straight to the arm."""
    task, reference, arm = (
        builder.GetSubsystemByName(name)
        for name in (task_name(builder), "arm_reference", "impedance_controller")
    )
    builder.Connect(
        task.GetOutputPort("reference"), reference.GetInputPort("reference")
    )
    estimator = builder.GetSubsystemByName("state_estimator")
    wiring.connect(builder, estimator, "tip_force", reference, "tip_force")
    connect_command(builder, reference, arm)
