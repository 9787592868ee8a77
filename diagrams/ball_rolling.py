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

from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Diagram,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
    System,
)
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
from makebreak.diagrams.camera import CameraConfig, camera_model
from makebreak.diagrams.faults import faulty_lcs
from makebreak.diagrams.learned_parameters import (
    add_gap_std,
    add_parameter_learner,
    add_past_state,
    past_config,
)
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
from makebreak.models.tip_and_ball import TipAndBall, make_tip_and_ball
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
from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcs,
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.numerics.ball_state import N_X, P_BALL
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearner
from makebreak.systems.contact_mpc.residual_learner import ResidualLearner
from makebreak.systems.contact_mpc.rolling_task import RollingTask
from makebreak.systems.perception.ball_tracker import BallTracker
from makebreak.systems.perception.past_state import PastState
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
    tracker=1e-4, estimator=2e-4, target=2.5e-4, past=2.5e-4, task=3e-4, lcs=3e-4,
    learner=3.5e-4, sampler=3.5e-4, c3=4e-4, reference=4.5e-4, impedance=7e-4,
)  # fmt: skip
BALL_CHANNELS = ("ball.ball.x", "ball.ball.y")  # What a camera above sees of it.


def noisy_camera(config: BallRollingConfig) -> CameraConfig:
    """The camera with the noise of ball_noise_m."""
    noise = replace(config.camera.noise, position_m=config.ball_noise_m)
    return replace(config.camera, noise=noise)


def make_world(
    config: BallRollingConfig,
    meshcat: Meshcat | None = None,
    sampled: bool = False,
    scene: Scene | None = None,
) -> Diagram:
    """The station: what is simulated of the experiment, without any controller.

    Args: scene, in place of world_scene(config).
    """
    if config.camera.noise.position_m != 0.0:
        raise ValueError(
            f"camera.noise.position_m is {config.camera.noise.position_m}, expected 0: "
            "ball_noise_m sets it"
        )
    if not config.ball_noise_m >= 0.0:
        raise ValueError(f"ball_noise_m is {config.ball_noise_m}, expected >= 0")
    return make_station(
        StationConfig(
            scene=config.world,
            camera=noisy_camera(config),
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


@dataclass(frozen=True, eq=False)
class _Rig:
    """What each part of the experiment is wired to."""

    builder: DiagramBuilder
    config: BallRollingConfig
    meshcat: Meshcat | None
    model: TipAndBall  # What the controllers believe.
    station: Diagram
    arm: MultibodyPlant  # Of the controllers.
    lcs: dict[str, LeafSystem]  # "plan", "command" and, for a residual, "learn".
    lcs_of: dict[str, AnitescuLcs]  # What these build with.
    estimator: StateEstimator

    @property
    def n_lam(self) -> int:
        return self.lcs_of["plan"].n_lam

    @property
    def p_tip(self) -> np.ndarray:
        """(3,) where the tip starts [m]."""
        tip = self.arm.GetFrameByName(TIP_FRAME)
        return tip.CalcPoseInWorld(self.arm.CreateDefaultContext()).translation()

    def add(self, name: str, system):
        return self.builder.AddNamedSystem(name, system)

    def connect(self, source: System, output: str, target: System, port: str) -> None:
        wiring.connect(self.builder, source, output, target, port)

    def feed(self, source: OutputPort, target: System, port: str) -> None:
        self.builder.Connect(source, target.GetInputPort(port))

    def mean_of_tip(self, name: str, r_comp: OutputPort, scale: float) -> OutputPort:
        """(1,) scale times the mean of the entries of r_comp for tip and ball."""
        mean = np.zeros((1, self.n_lam))
        mean[0, :N_TIP] = scale / N_TIP
        gain = self.add(name, MatrixGain(mean))
        self.builder.Connect(r_comp, gain.get_input_port())
        return gain.get_output_port()


@dataclass(frozen=True, eq=False)
class _Learned:
    """What a learner gives: r_comp (n_lam,) and its deviation, (1,) [m/s]."""

    r_comp: OutputPort
    r_std: OutputPort | None = None


@dataclass(frozen=True, eq=False)
class _Touches:
    """How it is chosen where the tip touches: the system that moves it there, the one
    that says where the ball shall go, and what C3 and the arm's reference are set to.
    """

    task: LeafSystem
    target: LeafSystem
    c3: C3Config
    reference: ArmReferenceConfig


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
        follow_hard: of the arm's reference, which sampled contacts do not have.
    """
    _check(config)
    if station is None:
        station = make_world(config, meshcat, sampled)
    model, scene = controller_model(config)
    arm = make_control_plant(scene)
    station = builder.AddNamedSystem("station", station)
    lcs, lcs_of = _add_models(builder, config, model)
    estimator = _add_sensing(builder, config, model, station, arm)
    rig = _Rig(builder, config, meshcat, model, station, arm, lcs, lcs_of, estimator)
    _connect_models(rig)

    learned = _LEARNERS[_learner(config)](rig)
    gap = rig.mean_of_tip("learned_gap", learned.r_comp, LEARN)
    if config.contact_sequence == "sampled":
        touches = _add_sampled(rig, learned, gap)
    else:
        touches = _add_cycle(rig, learned, follow_hard)
    c3 = rig.add("c3_mpc", C3Mpc(touches.c3, CONTROL, OFFSET["c3"]))
    reference = _add_reference(rig, touches.reference)
    impedance = _add_arm(rig, control_laws(scene, arm), hybrid)

    rig.connect(estimator, "x", c3, "x")
    rig.connect(touches.target, "x_desired", c3, "x_desired")
    for name, port in _models_of_c3(rig).items():
        rig.feed(port, c3, name)
    rig.feed(learned.r_comp, c3, "r_comp")
    if rig.builder.HasSubsystemNamed("contact_sampler"):
        sampler = rig.builder.GetSubsystemByName("contact_sampler")
        rig.connect(sampler, "guess", c3, "guess")
    rig.connect(c3, "x_next", reference, "x_next")
    rig.connect(c3, "lam", reference, "lam")
    rig.connect(c3, "status", reference, "status")
    rig.connect(touches.task, "phase", reference, "phase")
    if touches.task.HasOutputPort("feel"):
        rig.connect(touches.task, "feel", reference, "feel")
    rig.connect(lcs["command"], "lcs", reference, "lcs")

    _export_inputs(rig)
    _add_records(rig, impedance)
    if meshcat is not None:
        _add_view(rig, meshcat, gap, touches.task)


def _check(config: BallRollingConfig) -> None:
    """Raises: ValueError for settings that go without effect, or not together."""
    check_own(config, _OWN)
    if config.contact_sequence == "sampled":
        _check_sampled(config)
    _refuse_unused(config)


def _learner(config: BallRollingConfig) -> str:
    return config.learner if config.adapt else "none"


def _projection(config: BallRollingConfig) -> str:
    if config.projection != "auto":
        return config.projection
    return "qp" if config.controller == "paper" else "plus"


def _check_sampled(config: BallRollingConfig) -> None:
    """Raises: ValueError for what sampled contacts do not go with."""
    check_contacts(config.contacts)
    for name, value, expected in (
        ("controller", config.controller, ("ours",)),
        ("projection", _projection(config), ("plus",)),
        ("learner", _learner(config), ("none", "r_comp")),
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
    plain.task.circle.center = config.task.circle.center
    plain.task.circle.radius = config.task.circle.radius
    unused = ["contacts"]
    if config.contact_sequence == "sampled":
        # `contacts` has its own in place of those of the learner.
        learner = ("weight_ball", "weight_tip", "eps", "posterior.walk.drift")
        unused = ["task", "planner", *(f"learning.{name}" for name in learner)]
        unused.append("learning.posterior.walk.growth")
    for name in unused:
        why = f"not used with contact_sequence={config.contact_sequence}"
        refuse_unused(config, plain, name, why)
    if config.controller == "paper":
        refuse_unused(config, plain, "learning", "not used with controller=paper")
    if _learner(config) != "parameters":
        why = "used with learner=parameters alone"
        refuse_unused(config, plain, "parameters", why)


def _add_models(
    builder: DiagramBuilder, config: BallRollingConfig, model: TipAndBall
) -> tuple[dict[str, LeafSystem], dict[str, AnitescuLcs]]:
    """The LCS: as systems, and what they build with. A learner of parameters has its
    own."""
    friction, tangent = config.planner.friction, ContactPair().tangent
    if config.contact_sequence == "sampled":
        # Edges along the vertical do not jump as the normal goes around the ball.
        friction, tangent = config.contacts.planner.friction, [0.0, 0.0, 1.0]
    pairs = _pairs(friction, tangent)
    items = learned_parameters(config)
    planned = [item for item in items if item.kind != "gap"]
    lcs, lcs_of = {}, {}
    for name, dt, period in (
        ("plan", PLAN_DT, CONTROL),
        ("command", CONTROL, CONTROL),
        ("learn", LEARN, LEARN),
    )[: 2 if items else 3]:
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


def _add_sensing(
    builder: DiagramBuilder,
    config: BallRollingConfig,
    model: TipAndBall,
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
                camera_model(noisy_camera(config)),
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


def _connect_models(rig: _Rig) -> None:
    """What the LCS are linearised about, and where users can change them."""
    no_force = rig.add("no_force", ConstantVectorSource(np.zeros(3)))
    for lcs in rig.lcs.values():
        rig.connect(rig.estimator, "x", lcs, "x")
        rig.feed(no_force.get_output_port(), lcs, "u")
    # The sampler has a model of its own.
    if rig.meshcat is None or rig.config.contact_sequence == "sampled":
        return
    friction = rig.lcs_of["plan"].n_pairs * [rig.config.planner.friction]
    sliders = rig.add("model_sliders", ModelSliders(friction, rig.meshcat))
    for lcs in rig.lcs.values():
        rig.connect(sliders, "friction", lcs, "friction")
        rig.connect(sliders, "gap", lcs, "gap")


def _models_of_c3(rig: _Rig) -> dict[str, OutputPort]:
    """The LCS that C3 plans with, by its ports."""
    names = {"lcs": "plan", "lcs_command": "command"}
    ports = {port: rig.lcs[name].GetOutputPort("lcs") for port, name in names.items()}
    if _learner(rig.config) in ("r_dyn", "both"):
        r_dyn = _add_dynamics_learner(rig)
        for port, name in names.items():
            added = rig.add(
                f"dynamics_residual_{name}",
                DynamicsResidual(rig.lcs_of[name].at_default(), LEARN),
            )
            rig.feed(ports[port], added, "lcs")
            rig.feed(r_dyn, added, "r_dyn")
            ports[port] = added.get_output_port()
    wrong = what_goes_wrong(rig.config)
    if wrong is not None:
        example = rig.lcs_of["plan"].at_default()
        ports["lcs"] = faulty_lcs(rig.builder, ports["lcs"], example, wrong.faults)
    return ports


def _add_dynamics_learner(rig: _Rig) -> OutputPort:
    """Returns: the residual r_dyn of the dynamics."""
    learner = rig.add(
        "dynamics_residual_learner",
        DynamicsResidualLearner(
            DynamicsResidualLearnerConfig(),
            rig.lcs_of["learn"].at_default(),
            LEARN,
            OFFSET["learner"],
        ),
    )
    rig.connect(rig.estimator, "x", learner, "x")
    rig.connect(rig.estimator, "u_measured", learner, "u_measured")
    rig.connect(rig.lcs["learn"], "lcs", learner, "lcs")
    return learner.GetOutputPort("r_dyn")


def _learn_nothing(rig: _Rig) -> _Learned:
    zero = rig.add("no_residual", ConstantVectorSource(np.zeros(rig.n_lam)))
    return _Learned(zero.get_output_port())


def _learn_residual(rig: _Rig) -> _Learned:
    """The residual of the contact; sampled contacts get it less an allowance."""
    config = rig.config
    samples = config.contact_sequence == "sampled"
    if config.controller == "paper":
        settings = paper_learner_config(rig.n_lam)
    else:
        settings = learner_config(config.learning, config.contacts if samples else None)
    example = rig.lcs_of["learn"].at_default()
    learner = rig.add(
        "residual_learner", ResidualLearner(settings, example, LEARN, OFFSET["learner"])
    )
    rig.connect(rig.estimator, "x", learner, "x")
    rig.connect(rig.estimator, "u_measured", learner, "u_measured")
    rig.connect(rig.estimator, "window_valid", learner, "enable")
    rig.connect(rig.lcs["learn"], "lcs", learner, "lcs")
    r_comp = learner.GetOutputPort("r_comp")
    if samples:
        taken = np.zeros(rig.n_lam)
        taken[:N_TIP] = -config.contacts.gap_allowance / LEARN
        allowance = rig.add("gap_allowance", ConstantVectorSource(taken))
        cautious = rig.add("cautious_residual", Adder(2, rig.n_lam))
        rig.builder.Connect(r_comp, cautious.get_input_port(0))
        rig.builder.Connect(allowance.get_output_port(), cautious.get_input_port(1))
        r_comp = cautious.get_output_port()
    if rig.meshcat is not None:
        button = rig.add("adapt_button", AdaptButton(rig.n_lam, rig.meshcat))
        rig.builder.Connect(r_comp, button.get_input_port())
        r_comp = button.get_output_port()
    return _Learned(r_comp, learner.GetOutputPort("r_std"))


def _learn_parameters(rig: _Rig) -> _Learned:
    """Mass, frictions and gap, where the plan is made with them."""
    pairs = _pairs(rig.config.planner.friction, ContactPair().tangent)
    settings = parameter_learner_config(
        rig.config, rig.model.ball_radius, pairs, learned_parameters(rig.config)
    )
    model = make_tip_and_ball(rig.model)[0]
    learner = ParameterLearner(model, settings, LEARN, OFFSET["learner"])
    users = [rig.lcs["plan"], rig.lcs["command"]]
    state: LeafSystem = rig.estimator
    if rig.builder.HasSubsystemNamed("ball_tracker"):
        tracker = rig.builder.GetSubsystemByName("ball_tracker")
        of = past_config(rig.model.ball_radius, OFFSET["past"], TRACK)
        past = PastState(of, is_ball=True)
        state = add_past_state(rig.builder, past, tracker, rig.estimator)
    r_comp = add_parameter_learner(rig.builder, learner, state, users, N_TIP, LEARN)
    return _Learned(r_comp, add_gap_std(rig.builder, learner, LEARN))


# By `learner`; what learns r_dyn is beside them, _models_of_c3.
_LEARNERS = {
    "none": _learn_nothing,
    "r_dyn": _learn_nothing,
    "r_comp": _learn_residual,
    "both": _learn_residual,
    "parameters": _learn_parameters,
}


def _add_cycle(rig: _Rig, learned: _Learned, follow_hard: bool) -> _Touches:
    """Touches as written by hand: from above, push after push along the circle."""
    config, model = rig.config, rig.model
    task = rig.add(
        "rolling_task",
        RollingTask(
            replace(config.task, period_sec=CONTROL, offset_sec=OFFSET["task"]),
            n_knots=config.planner.options.N + 1,
            knot_sec=PLAN_DT,
            radius_ball=model.ball_radius,
            radius_tip=model.tip_radius,
            n_lam=rig.n_lam,
            n_tip=N_TIP,
            residual_dt_sec=LEARN,
            p_tip=rig.p_tip,
        ),
    )
    rig.connect(rig.estimator, "x", task, "x")
    rig.connect(rig.estimator, "valid", task, "valid")
    rig.connect(rig.estimator, "tip_force", task, "tip_force")
    rig.feed(learned.r_comp, task, "r_comp")
    if learned.r_std is not None:
        rig.feed(learned.r_std, task, "r_std")
    return _Touches(
        task,
        task,
        c3_config(config.planner, rig.n_lam, _projection(config)),
        ArmReferenceConfig(follow=FollowConfig(hard=follow_hard)),
    )


def _add_sampled(rig: _Rig, learned: _Learned, gap: OutputPort) -> _Touches:
    """Touches from the side, where C3 finds the least cost of those that it samples."""
    config, contacts = rig.config, rig.config.contacts
    c3 = sampled_c3_config(
        contacts.planner, rig.n_lam, N_TIP, rig.model.ball_radius, LEARN
    )
    added = add_sampled_contacts(
        rig.builder,
        contacts,
        config.task.circle,
        rig.model,
        rig.lcs_of["plan"],
        c3,
        rig.p_tip,
        N_TIP,
        CONTROL,
        OFFSET,
        rig.estimator,
    )
    rig.feed(learned.r_comp, added.sampler, "r_comp")
    rig.feed(learned.r_comp, added.target, "r_comp")
    nearer = rig.mean_of_tip("learned_reach", learned.r_comp, -LEARN)
    rig.feed(nearer, added.task, "nearer")
    if rig.builder.HasSubsystemNamed("ball_tracker"):
        # Beside the ball the gap is what its radius is too large by.
        tracker = rig.builder.GetSubsystemByName("ball_tracker")
        rig.feed(gap, tracker, "radius_error")
    height = contacts.sampler.sampling.height
    return _Touches(
        added.task, added.target, c3, replace(contacts.reference, height=height)
    )


def _add_reference(rig: _Rig, settings: ArmReferenceConfig) -> ArmReference:
    settings = replace(
        settings,
        tip_mass=rig.model.tip_mass,
        period_sec=CONTROL,
        offset_sec=OFFSET["reference"],
    )
    example = rig.lcs_of["command"].at_default()
    return rig.add(
        "arm_reference", ArmReference(settings, rig.n_lam, rig.p_tip, example)
    )


def _add_arm(rig: _Rig, laws, hybrid: HybridConfig | None) -> ImpedanceController:
    """The arm's controller, and its connections to the station."""
    settings = replace(
        rig.config.impedance, period_sec=ARM_TICK, offset_sec=OFFSET["impedance"]
    )
    impedance = rig.add(
        "impedance_controller",
        ImpedanceController(settings, rig.arm, TIP_FRAME, hybrid=hybrid, laws=laws),
    )
    rig.connect(rig.station, f"{ARM}.position_measured", impedance, "q")
    rig.connect(rig.station, f"{ARM}.velocity_measured", impedance, "v")
    if rig.station.HasOutputPort(DELAY):
        rig.connect(rig.station, DELAY, impedance, "delay")
    rig.connect(impedance, "tau", rig.station, f"{ARM}.torque_commanded")
    return impedance


def _export_inputs(rig: _Rig) -> None:
    """What nothing here gives the station."""
    for i in range(rig.station.num_input_ports()):
        port = rig.station.get_input_port(i)
        if port.get_name() not in (f"{ARM}.torque_commanded", "overhead.region"):
            rig.builder.ExportInput(port, port.get_name())


def _is_simulated(station: Diagram) -> bool:
    """Whether there is a truth."""
    return station.HasSubsystemNamed("plant")


def _add_records(rig: _Rig, impedance: ImpedanceController) -> None:
    """What is scored, and what a recording has."""
    tau = impedance.GetOutputPort("tau")
    logged = {"torque_log": tau}
    if _is_simulated(rig.station):
        logged["state_log"] = rig.station.GetOutputPort("state")
        logged["contact_log"] = rig.station.GetOutputPort(f"{ARM}.contact_torque")
    for name, source in logged.items():
        LogVectorOutput(source, rig.builder, ARM_TICK).set_name(name)
    # The ball's height is no measurement: the tracker takes the model's radius for it.
    of_ball = [""] * N_X
    of_ball[P_BALL.start : P_BALL.start + 2] = BALL_CHANNELS
    seen = {"ball": (rig.estimator.GetOutputPort("x"), of_ball)}
    record_station(rig.builder, rig.station, tau, TOOL, CONTROL, seen)


def _add_view(rig: _Rig, meshcat: Meshcat, gap: OutputPort, task: LeafSystem) -> None:
    view = rig.add(
        "rolling_view",
        RollingView(
            RollingViewConfig(
                center=rig.config.task.circle.center,
                radius=rig.config.task.circle.radius,
                ball_radius=rig.model.ball_radius,
            ),
            meshcat,
        ),
    )
    x = rig.estimator.GetOutputPort("x")
    if _is_simulated(rig.station):
        plant = rig.station.GetSubsystemByName("plant")
        state, size = rig.station.GetOutputPort("state"), plant.num_multibody_states()
        at = plant.GetBodyByName("ball").floating_positions_start() + 4
    else:  # As it is estimated.
        state, size, at = x, N_X, P_BALL.start
    select = np.zeros((3, size))
    select[:, at : at + 3] = np.eye(3)
    p_ball = rig.add("true_ball", MatrixGain(select))
    rig.builder.Connect(state, p_ball.get_input_port())
    rig.feed(p_ball.get_output_port(), view, "p_ball")
    rig.feed(x, view, "x")
    rig.feed(gap, view, "gap")
    legend = LegendConfig(view.legend, PHASES, view.CAMERA, view.LOOK_AT)
    add_legend(rig.builder, meshcat, legend, task.GetOutputPort("phase"))


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
