"""All seven systems in one diagram: a ball is rolled, and touched gently.

    as in ball_rolling: camera, tracker, estimator, three LCS builders, residual
    learner, C3, task --> arm_reference
    rolling_task (a push is over) --> push_motion --motion--> velocity_shaper
    push_motion --frame, under the ball--> moving_frame, reference_blend
    moving_frame --ee_pose--> contact_detector, velocity_shaper
    contact_detector --contact--> velocity_shaper, moving_frame
    moving_frame --heights--> contact_anticipator --contacts--> velocity_shaper
    mode_detector --mode--> forward_model_bank --> variable_impedance
    arm_reference (roll), velocity_shaper (between pushes) --> reference_blend
    reference_blend, variable_impedance --> impedance_controller --tau--> station

The shaper, the detector and the anticipator live in a frame that moves with the ball:
there the ball lies still, and what is learned of a contact holds for the next push.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LogVectorOutput,
    MatrixGain,
    Multiplexer,
)

from makebreak.diagrams.ball_rolling import (
    ARM_TICK,
    CONTROL,
    add_ball_rolling,
    connect_reference,
    make_world,
)
from makebreak.diagrams.ball_rolling_config import (
    BallRollingConfig,
    controller_model,
    world_scene,
)
from makebreak.diagrams.camera import CameraConfig
from makebreak.diagrams.station import (
    ARM,
    TIP_FRAME,
    TOOL,
    from_wrist,
    make_control_plant,
)
from makebreak.diagrams.wiring import refuse_changed, split, timed
from makebreak.models.friction_zones import FrictionZone
from makebreak.models.scene import Scene
from makebreak.systems.arm.impedance_controller import HybridConfig, serial_chain_of
from makebreak.systems.arm.tip_state import TipState
from makebreak.systems.arm.variable_impedance import (
    StiffnessConfig,
    VariableImpedance,
    VariableImpedanceConfig,
)
from makebreak.systems.arm.wrench_tare import WrenchTare, WrenchTareConfig
from makebreak.systems.baselines.frozen import Frozen
from makebreak.systems.changing_contact.contact_anticipator import (
    ApproachSpeedConfig,
    ContactAnticipatorConfig,
    ContactFilterConfig,
    FirstApproachConfig,
    KalmanContactAnticipator,
)
from makebreak.systems.changing_contact.contact_detector import (
    ContactDetector,
    ContactDetectorConfig,
)
from makebreak.systems.changing_contact.forward_model import (
    ForwardModelBank,
    ForwardModelConfig,
)
from makebreak.systems.changing_contact.mode_detector import (
    ModeDetector,
    ModeDetectorConfig,
)
from makebreak.systems.changing_contact.moving_frame import MovingFrame
from makebreak.systems.changing_contact.numerics.contact_task import (
    N_CONTACT,
    N_TRANSITION,
    ContactBelief,
    ExpectedContact,
)
from makebreak.systems.changing_contact.numerics.push_motion import (
    BALL_SEGMENT,
    DOWN,
    N_FRAME,
    TABLE_SEGMENT,
)
from makebreak.systems.changing_contact.numerics.reference_blend import COMMAND
from makebreak.systems.changing_contact.push_motion import PushMotion, PushMotionConfig
from makebreak.systems.changing_contact.reference_blend import (
    ReferenceBlend,
    ReferenceBlendConfig,
)
from makebreak.systems.changing_contact.velocity_shaper import (
    RegionConfig,
    SearchConfig,
    VelocityShaper,
    VelocityShaperConfig,
)
from makebreak.systems.contact_mpc.numerics.rolling_task import (
    CirclePath,
    RepositionConfig,
    RollingConfig,
    surface_height,
)
from makebreak.systems.contact_mpc.rolling_task import RollingTaskConfig

BRISK_SEC = 0.4  # A reposition, if nothing slows it.
# Periods and offsets of what ball_rolling has not [s]. All that runs each millisecond
# runs at one instant; the motion is chosen after the task, and before arm_reference.
ESTIMATE, ANTICIPATE, PLAN = 0.005, 0.01, 0.005
HINT_LEAD_SEC = 0.014  # As in surface_switch: what a hint takes to reach the arm.
OFFSET, MOTION_OFFSET, BLEND_OFFSET = 1e-4, 3.2e-4, 3.4e-4
# How well the model is thought to know the ball's radius and the table's height.
RADIUS_STD = 0.003  # [m]
TABLE_STD, TABLE_FORCE_PER_SPEED = 0.002, 700.0  # [m], [N s/m]
# The finger's friction on felt, and where it begins: the rest of the table is glass.
FELT, SEAM_Y = 0.8, 0.085  # -, [m]
START_ANGLE = (
    1.08,
    1.3,
)  # Of the ball on its circle: the table may be touched at once.
TABLES = ("plain", "felt_and_glass")
SEAM = "seam_anticipator"
FINGER_MASS = 0.12  # [kg] Between the wrench sensor and the tip.
# A direction that is let go is to be moved along at once.
HYBRID = HybridConfig(release_sec=0.03, normal_damping=50.0, closing_speed=0.012)
# The seven, and what each is in the diagram.
SEVEN = {
    "lcs_builder": ("lcs_plan", "lcs_command", "lcs_learn"),
    "c3_mpc": ("c3_mpc",),
    "residual_learner": ("residual_learner",),
    "mode_detector": ("mode_detector",),
    "contact_anticipator": ("contact_anticipator",),
    "velocity_shaper": ("velocity_shaper",),
    "impedance_controller": ("impedance_controller",),
}


@dataclass
class TouchConfig:
    """The second paper's systems, for contacts of 1 to 3 N.

    The wrench has 0.1 N of noise at 1 kHz, 0.05 N behind the detector's filter: 1.2 N
    is 24 of these, and more than what the finger's own inertia leaves."""

    detector: ContactDetectorConfig = field(
        default_factory=lambda: ContactDetectorConfig(
            impact_force=1.2, loss_force=0.3, tool_mass=FINGER_MASS
        )
    )
    # Without its estimates from sliding: a ball is not a plane.
    tare: WrenchTareConfig = field(
        default_factory=lambda: WrenchTareConfig(sideways=False)
    )
    modes: ModeDetectorConfig = field(
        default_factory=lambda: ModeDetectorConfig(
            threshold=0.08, crossing=0.0, normal_force_min=0.5, tool_mass=FINGER_MASS
        )
    )
    forward_model: ForwardModelConfig = field(
        default_factory=lambda: ForwardModelConfig(with_torque=False)
    )
    anticipator: ContactAnticipatorConfig = field(
        default_factory=lambda: ContactAnticipatorConfig(
            # The ball's place is known to 1 mm or so: on its slope, 0.4 mm of height.
            filter=ContactFilterConfig(std_along=0.0005, std_drift=0.00025),
            # Slower than 10 mm/s a landing takes so long that a ball on a slope of half
            # a degree rolls a centimetre meanwhile.
            speed=ApproachSpeedConfig(
                force_desired=7.5,
                first=FirstApproachConfig(speed=0.015),
                least=0.01,
                most=0.03,
                # Force over speed varies by a factor of two around the circle.
                force_drift=0.1,
            ),
        )
    )
    shaper: VelocityShaperConfig = field(
        default_factory=lambda: VelocityShaperConfig(
            acceleration_max=5.0,
            region=RegionConfig(
                sigmas=2.0, margin=0.0008, settle_sec=0.05, blend_sec=0.05
            ),
            search=SearchConfig(speed=0.022, distance=0.02, go_on_unexpected=True),
        )
    )
    variable_impedance: VariableImpedanceConfig = field(
        default_factory=lambda: VariableImpedanceConfig(
            stiffness=StiffnessConfig(free=800.0, maximum=1000.0, impact=300.0),
            blend_sec=0.05,
        )
    )
    blend: ReferenceBlendConfig = field(default_factory=ReferenceBlendConfig)


def _brisk_ball() -> BallRollingConfig:
    rolling = RollingConfig(reposition=RepositionConfig(sec=BRISK_SEC))
    return BallRollingConfig(
        camera=CameraConfig(renderer="drawn"),
        task=RollingTaskConfig(rolling=rolling),
    )


@dataclass
class GentleRollingConfig:
    """Settings of `makebreak run gentle_rolling`."""

    # Whether the second paper's systems lead the tip to the ball; false: as in
    # ball_rolling.
    gentle: bool = True
    adapt: bool = True  # Whether the residual learner runs.
    # Systems that stay at their default outputs: any of lcs_builder, c3_mpc,
    # residual_learner, mode_detector, contact_anticipator, velocity_shaper,
    # impedance_controller.
    frozen: list[str] = field(default_factory=list)
    ball: BallRollingConfig = field(default_factory=_brisk_ball)
    touch: TouchConfig = field(default_factory=TouchConfig)
    push: PushMotionConfig = field(default_factory=PushMotionConfig)
    # Surface of the table: plain, or felt_and_glass: felt where y > 0.085 m, else
    # glass. The latter replaces push.table_first, push.table_every, and press, slide
    # and survey of push.shape.table.
    table: str = "plain"
    # Errors of the station that the model lacks: none, lab or poor.
    realism: str = "none"
    # Seed of the ball's start, a fruit's shape, the station's errors and the sensors'
    # noise.
    seed: int = 0


# What `telemetry_log` holds: name -> (system, port, size). What is computed when asked
# for is computed for it anew each millisecond: no more than what is scored.
SIGNALS = {
    "kind": ("push_motion", "kind", 1),
    "trial": ("push_motion", "trial", 1),
    "active": ("push_motion", "active", 1),
    "ee_pose": ("tip_state", "ee_pose", 7),
    "frame": ("push_motion", "frame", N_FRAME),
    "shaped": ("velocity_shaper", "x_desired", 19),  # In that frame.
    "phase": ("velocity_shaper", "phase", 6),
    "contact": ("contact_detector", "contact", 14),
    "mode": ("mode_detector", "mode", 1),
    "prediction_error": ("forward_model_bank", "prediction_error", 1),
    "stiffness": ("variable_impedance", "stiffness", 6),
}


def ball_config(config: GentleRollingConfig) -> BallRollingConfig:
    """Of the part that ball_rolling has too.

    Raises: ValueError for settings that gentle_rolling's own replace.
    """
    for name in ("seed", "adapt", "realism"):
        default = getattr(BallRollingConfig(), name)
        if getattr(config.ball, name) != default:
            raise ValueError(
                f"ball.{name} is {getattr(config.ball, name)}, expected {default}: "
                f"{name} sets it"
            )
    if config.ball.contact_sequence != "cycle":
        raise ValueError(
            f"ball.contact_sequence is {config.ball.contact_sequence}, expected cycle: "
            "the gentle touch-down is that of its landing"
        )
    if config.ball.learner != "r_comp":
        raise ValueError(
            f"ball.learner is {config.ball.learner}, expected r_comp; adapt=false "
            "switches the learner off"
        )
    return replace(
        config.ball, seed=config.seed, adapt=config.adapt, realism=config.realism
    )


def on_two_surfaces(config: GentleRollingConfig) -> GentleRollingConfig:
    """The settings of a table that is felt where y > SEAM_Y, glass elsewhere.

    The ball starts before the seam. Once a circle the finger touches the table ahead
    of it and slides over the seam to and fro, from rest each time.

    Raises: ValueError for a setting that is another one on this table.
    """
    refuse_changed("push", config.push, ("table_first", "table_every"))
    on_table = config.push.shape.table
    refuse_changed("push.shape.table", on_table, ("press", "slide", "survey"))
    refuse_changed(
        "touch.forward_model.handover",
        config.touch.forward_model.handover,
        ("from_rest",),
    )
    angle = config.ball.start_angle_rad
    if angle is None:
        angle = float(np.random.default_rng([config.seed, 5]).uniform(*START_ANGLE))
    on_table = replace(on_table, press=4.0, slide=0.07, survey=3)
    shape = replace(config.push.shape, table=on_table)
    push = replace(config.push, shape=shape, table_first=2, table_every=8)
    models = config.touch.forward_model
    handover = replace(models.handover, from_rest=True)
    touch = replace(config.touch, forward_model=replace(models, handover=handover))
    ball = replace(config.ball, start_angle_rad=angle)
    return replace(config, ball=ball, push=push, touch=touch)


def felt_and_glass(ball: BallRollingConfig) -> Scene:
    """The world: the table as it is, with felt where y > SEAM_Y."""
    scene = world_scene(ball)
    scene.friction_zones.append(
        FrictionZone(f"table~{TOOL}", FELT, [-1.0, 2.0], [SEAM_Y, 1.0])
    )
    return scene


def prior(config: GentleRollingConfig) -> ContactBelief:
    """Where the model says that the finger will touch, in the frame under the ball."""
    model, _ = controller_model(ball_config(config))
    shape = config.push.shape
    z = surface_height(shape.land_behind, model.ball_radius, model.tip_radius)
    # Twice the radius' error is the height's. The table is known better, but it is
    # hard: 700 N s/m are the arm's 5 kg on the model's 1e5 N/m.
    slow = config.touch.anticipator.speed.force_desired / TABLE_FORCE_PER_SPEED
    return ContactBelief((
        ExpectedContact(
            np.array([0.0, 0.0, z]),
            (2.0 * RADIUS_STD) ** 2 * np.eye(3),
            DOWN,
            segment=BALL_SEGMENT,
        ),
        ExpectedContact(
            np.array([0.0, 0.0, model.tip_radius]),
            TABLE_STD**2 * np.eye(3),
            DOWN,
            segment=TABLE_SEGMENT,
            approach_speed=slow,
            impacts=np.array([[slow, slow * TABLE_FORCE_PER_SPEED]]),
        ),
    ))  # fmt: skip


def make_gentle_rolling(
    config: GentleRollingConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The whole experiment, each system by name in the diagram.

    Raises: ValueError for a name in `frozen` that is none of SEVEN or is not in this
        diagram, and for periods and offsets that the diagram sets.
    """
    if config.table not in TABLES:
        raise ValueError(
            f"table is {config.table!r}, expected one of: {', '.join(TABLES)}"
        )
    if config.table == "felt_and_glass":
        config = on_two_surfaces(config)
    ball, station = ball_config(config), None
    hybrid: HybridConfig | None = HYBRID
    if config.table == "felt_and_glass":
        station = make_world(ball, meshcat, True, felt_and_glass(ball))
        hybrid = replace(HYBRID, closing_speed=0.004)
    freeze = _to_freeze(config)
    builder = _Freezer(freeze)
    if not config.gentle:
        hybrid = None
    add_ball_rolling(builder, ball, meshcat, True, hybrid, station, config.gentle)
    if config.gentle:
        _add_touch(builder, config, ball)
    else:
        connect_reference(builder)
    diagram = builder.Build()
    diagram.set_name("gentle_rolling")
    return diagram


class _Freezer(DiagramBuilder):
    """A builder in which some systems stay at their default outputs."""

    def __init__(self, names):
        super().__init__()
        self._names = set(names)

    def AddNamedSystem(self, name, system):
        if name in self._names:
            system.set_name(name)
            system = Frozen(system)
        return super().AddNamedSystem(name, system)


def _to_freeze(config: GentleRollingConfig) -> list[str]:
    out: list[str] = []
    there = set(SEVEN)
    if not config.adapt:
        there -= {"residual_learner"}
    if not config.gentle:
        there -= {"mode_detector", "contact_anticipator", "velocity_shaper"}
    for name in config.frozen:
        if name not in there:
            raise ValueError(
                f"frozen has {name!r}, expected some of: {', '.join(sorted(there))}"
            )
        out += SEVEN[name]
        if name == "contact_anticipator":
            out.append(SEAM)  # The same for changes without impact, if it is there.
    return out


def _add_touch(builder, config: GentleRollingConfig, ball: BallRollingConfig) -> None:
    """The second paper's systems, and what leads from both planners to the arm."""
    touch = config.touch
    model, scene = controller_model(ball)
    arm = make_control_plant(scene)
    chain = serial_chain_of(arm, TIP_FRAME)
    path = CirclePath(np.array(ball.task.circle.center), ball.task.circle.radius)

    def add(name: str, system: LeafSystem):
        return builder.AddNamedSystem(name, system)

    motion = PushMotion(
        config.push,
        path,
        model.ball_radius,
        model.tip_radius,
        touch.shaper.acceleration_max,
        from_wrist(arm),
        CONTROL,
        MOTION_OFFSET,
    )
    first = motion.first_pattern()
    add("push_motion", motion)
    add("tip_state", TipState(chain))
    add("moving_frame", MovingFrame())
    add("wrench_tare", WrenchTare(timed(touch.tare, ARM_TICK, OFFSET)))
    add(
        "contact_detector",
        ContactDetector(timed(touch.detector, ARM_TICK, OFFSET), tared=True),
    )
    add("mode_detector", ModeDetector(touch.modes, None, ESTIMATE, OFFSET))
    add(
        "forward_model_bank",
        ForwardModelBank(touch.forward_model, None, ESTIMATE, OFFSET),
    )
    add(
        "contact_anticipator",
        KalmanContactAnticipator(
            timed(touch.anticipator, ANTICIPATE, OFFSET), prior(config)
        ),
    )
    add(
        "velocity_shaper",
        VelocityShaper(
            timed(touch.shaper, ARM_TICK, OFFSET), first, PLAN, restarts=True
        ),
    )
    add(
        "variable_impedance",
        VariableImpedance(timed(touch.variable_impedance, ARM_TICK, OFFSET)),
    )
    blend = timed(touch.blend, CONTROL, BLEND_OFFSET)
    add("reference_blend", ReferenceBlend(blend))

    def connect(source, output, *targets):
        """Each target is a system, or (system, port) where the names differ."""
        port = builder.GetSubsystemByName(source).GetOutputPort(output)
        for target in targets:
            name, own = (target, output) if isinstance(target, str) else target
            builder.Connect(port, builder.GetSubsystemByName(name).GetInputPort(own))

    impedance = "impedance_controller"
    connect("state_estimator", "x", "push_motion", "reference_blend")
    connect("rolling_task", "phase", ("push_motion", "task_phase"))
    connect("rolling_task", "waits", "push_motion")
    connect("rolling_task", "reference", ("reference_blend", "task_reference"))
    connect("push_motion", "landed", "rolling_task")
    connect("push_motion", "motion", "velocity_shaper")
    connect("push_motion", "frame", "moving_frame", "reference_blend")
    connect("push_motion", "active", "reference_blend")
    connect("push_motion", "trial", "contact_anticipator")
    connect("station", f"{ARM}.position_measured", ("tip_state", "q"))
    connect("station", f"{ARM}.velocity_measured", ("tip_state", "v"))
    connect("tip_state", "ee_pose", "moving_frame")
    connect(
        "tip_state", "ee_velocity", "moving_frame", "wrench_tare", "mode_detector",
        "forward_model_bank",
    )  # fmt: skip
    connect(
        "moving_frame", "ee_pose", "contact_detector", "velocity_shaper",
    )  # fmt: skip
    connect("moving_frame", "ee_height", ("contact_anticipator", "ee_pose"))
    connect("moving_frame", "contact_height", ("contact_anticipator", "contact"))
    connect("moving_frame", "ee_velocity", "contact_detector")
    connect("station", f"{ARM}.external_wrench", ("wrench_tare", "wrench"))
    connect(
        "wrench_tare", "wrench", "contact_detector", "mode_detector",
        "forward_model_bank", (impedance, "wrench_measured"),
    )  # fmt: skip
    # Whether a push touches the ball: the wrist feels it better than the joints.
    add("felt_force", MatrixGain(np.eye(3, 6)))
    builder.Connect(
        builder.GetSubsystemByName("wrench_tare").GetOutputPort("wrench_mean"),
        builder.GetSubsystemByName("felt_force").get_input_port(),
    )
    connect("felt_force", "y0", ("arm_reference", "tip_force"))
    connect("velocity_shaper", "direction", "contact_detector")
    connect("velocity_shaper", "force_directions", "contact_detector",
            "reference_blend")  # fmt: skip
    connect("velocity_shaper", "force_targets", "reference_blend")
    connect("velocity_shaper", "phase", "contact_detector", "contact_anticipator",
            "variable_impedance", "push_motion", "reference_blend")  # fmt: skip
    connect("velocity_shaper", "x_desired", ("reference_blend", "shaped"),
            ("push_motion", "shaped"))  # fmt: skip
    connect("contact_detector", "contact", "moving_frame", "velocity_shaper")
    connect("contact_anticipator", "contacts", "velocity_shaper")
    # Modes change as the ball is rolled; in these motions nothing changes but by a
    # contact.
    add("no_transition", ConstantVectorSource(np.zeros(N_TRANSITION)))
    connect("no_transition", "y0", ("contact_anticipator", "transition"))
    if config.table == "felt_and_glass":
        # Where the surface changed, in the world: there its mode is announced.
        seam = replace(touch.anticipator, filter=ContactFilterConfig())
        seam = replace(seam, hint_lead_sec=HINT_LEAD_SEC)
        seam = timed(seam, ANTICIPATE, OFFSET)
        add(SEAM, KalmanContactAnticipator(seam))
        add("no_contact", ConstantVectorSource(np.zeros(N_CONTACT)))
        connect("no_contact", "y0", (SEAM, "contact"))
        connect("tip_state", "ee_pose", SEAM)
        connect("velocity_shaper", "phase", SEAM)
        connect("push_motion", "trial", SEAM)
        connect("mode_detector", "transition", SEAM)
        connect(SEAM, "mode_hint", "mode_detector")
        connect("reference_blend", "x_desired", "forward_model_bank")
        connect("mode_detector", "undecided", "forward_model_bank")
    connect("mode_detector", "transition", "forward_model_bank")
    connect("mode_detector", "mode", "forward_model_bank")
    connect("mode_detector", "collecting", "variable_impedance")
    connect("forward_model_bank", "wrench_predicted", "variable_impedance")
    connect("forward_model_bank", "prediction_error", "variable_impedance")
    connect("variable_impedance", "wrench_feedforward", "reference_blend")
    connect("variable_impedance", "stiffness", impedance)
    planned = builder.GetSubsystemByName("arm_reference").GetOutputPort("command")
    parts = split(builder, planned, "planned", dict(x_desired=19, wrench=6))
    for part, name, own in (
        ("x_desired", "reference_blend", "planned"),
        ("x_desired", "push_motion", "arm"),
        ("wrench", "reference_blend", "planned_wrench"),
    ):
        system = builder.GetSubsystemByName(name)
        builder.Connect(parts[part], system.GetInputPort(own))
    connect("reference_blend", "reference", "arm_reference")
    connect("reference_blend", "direction", "mode_detector", "forward_model_bank")
    connect("reference_blend", "contact_directions",
            ("wrench_tare", "force_directions"), ("mode_detector", "force_directions"),
            ("forward_model_bank", "force_directions"))  # fmt: skip
    whole = builder.GetSubsystemByName("reference_blend").GetOutputPort("command")
    names = ("x_desired", "wrench_feedforward", "damping", "force_directions",
             "force_targets")  # fmt: skip
    parts = split(builder, whole, "arm_command", dict(zip(names, COMMAND, strict=True)))
    for name, port in parts.items():
        builder.Connect(port, builder.GetSubsystemByName(impedance).GetInputPort(name))

    # For scoring and for the eye alone.
    bundle = add("telemetry", Multiplexer([size for _, _, size in SIGNALS.values()]))
    for i, (system, port, _) in enumerate(SIGNALS.values()):
        builder.Connect(
            builder.GetSubsystemByName(system).GetOutputPort(port),
            bundle.get_input_port(i),
        )
    log = LogVectorOutput(bundle.get_output_port(), builder, ARM_TICK)
    log.set_name("telemetry_log")


def telemetry(diagram: Diagram, context) -> dict[str, np.ndarray]:
    """What was logged in a simulation that ended in `context`: time (n,), and each of
    SIGNALS (n, k), a row per millisecond, taken before the events of that instant.
    Empty without the second paper's systems."""
    if not diagram.HasSubsystemNamed("telemetry_log"):
        return {}
    log = diagram.GetSubsystemByName("telemetry_log").FindLog(context)
    out = {"time": np.array(log.sample_times())}
    data, start = log.data(), 0
    for name, (_, _, size) in SIGNALS.items():
        out[name] = np.array(data[start : start + size].T)
        start += size
    return out
