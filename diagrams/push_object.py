"""A Panda pushes an object over a table to poses, choosing where to touch it.

    station --body_poses--> pose_sensor --> state_estimator <-- q, v, torque -- station
       (or --image--> pose_tracker -->)
    state_estimator --x--> push_goals --goal--> push_task, contact_sampler
    push_task --x_desired--> c3_mpc, contact_sampler
    contact_sampler --command (where to touch)--> push_task
    pose_sensor, state_estimator --> past_state --> lcs_learn, residual_learner
    residual_learner --r_comp--> c3_mpc, contact_sampler
    c3_mpc (contact), push_task (travel) --> arm_reference
    gentle: state_estimator --tip_force--> touch_down --touch_speed--> arm_reference
    arm_reference --> impedance_controller --tau--> station

Nothing passes from the world to the controllers but encoders, torques and what a pose
sensor, or a camera, measures of the object.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from makebreak.diagrams import wiring
from makebreak.diagrams.camera import CameraConfig, camera_model
from makebreak.diagrams.recorder import record_station
from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import (
    ARM,
    TIP_FRAME,
    TOOL,
    StationConfig,
    from_wrist,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.wiring import (
    add_legend,
    check_own,
    connect_command,
    refuse_changed,
)
from makebreak.models.effects.contact import rolls_against
from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS
from makebreak.models.pushed_object import (
    HUE,
    PushedObject,
    make_tip_and_object,
    object_file,
    parts,
    rest_height,
    seen_parts,
    support_spheres,
)
from makebreak.models.scene import Scene, load_scene, read_scene
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.arm.arm_reference import ArmReference, ArmReferenceConfig
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.changing_contact.touch_down import TouchDown, TouchDownConfig
from makebreak.systems.contact_mpc.c3_mpc import C3Config, C3Mpc
from makebreak.systems.contact_mpc.contact_sampler import (
    ContactSampler,
    ContactSamplerConfig,
)
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcsBuilder,
    ContactPair,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.numerics.ball_state import (
    N_X,
    P_BALL,
    Q_BALL,
    V_BALL,
    V_TIP,
    plus_weights,
)
from makebreak.systems.contact_mpc.numerics.c3_mpc import (
    C3Options,
    C3Problem,
    C3Weights,
    OrientationWeight,
)
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ObjectShape,
    SamplingConfig,
)
from makebreak.systems.contact_mpc.push_goals import (
    PushGoals,
    PushGoalsConfig,
    draw_poses,
)
from makebreak.systems.contact_mpc.push_task import PushTask, PushTaskConfig
from makebreak.systems.contact_mpc.residual_learner import (
    PosteriorConfig,
    ResidualLearner,
    ResidualLearnerConfig,
)
from makebreak.systems.perception.numerics.pose_tracker import make_shape
from makebreak.systems.perception.past_state import PastState, PastStateConfig
from makebreak.systems.perception.pose_sensor import (
    KEPT_SEC,
    PoseSensor,
    PoseSensorConfig,
)
from makebreak.systems.perception.pose_tracker import PoseTracker, PoseTrackerConfig
from makebreak.systems.perception.state_estimator import (
    StateEstimator,
    StateEstimatorConfig,
)
from makebreak.systems.views.adapt_button import AdaptButton
from makebreak.systems.views.contact_probe import ContactLoad
from makebreak.systems.views.legend import LegendConfig
from makebreak.systems.views.push_view import PushView, PushViewConfig

PUSH_OBJECT = str(MODELS / "push_object.scene.yaml")
OBJECT = "object"
# Of a recording: the object's place and quaternion.
READING_COLUMNS = [f"{OBJECT}.{OBJECT}.{p}" for p in (*"xyz", "qw", "qx", "qy", "qz")]
CONTROL = 0.0125
ESTIMATE, LEARN, ARM_TICK = CONTROL / 3.0, 0.05, 0.001
# As in ball_rolling: each system runs a little after the one that it listens to, within
# the millisecond between two steps of the plant. The sampler's choice and the residual
# are a tick old where they are used.
OFFSET = dict(
    sensor=1e-4, estimator=2e-4, goals=2.5e-4, past=2.5e-4, task=3e-4, lcs=3e-4,
    touch=3.2e-4,
    learner=3.5e-4, sampler=3.5e-4, c3=4e-4, reference=4.5e-4, impedance=7e-4,
)  # fmt: skip
ROLLING_RESISTANCE = 0.005  # Of a cylinder: lever arm over radius.
PLAN_DT, TIP_MASS, N_TIP = 0.1, 1.0, 4  # N_TIP: forces of tip and object, the first.


@dataclass
class PushPlannerConfig:
    """Costs of C3+; forces in newtons."""

    N: int = 5  # Knots of 0.1 s.
    rounds: int = 2
    polish: int = 6
    position: float = 5000.0  # Of the object, across the table [1/m2].
    angle_radius: float = 0.12  # A turn of the object counts as so much of a way [m].
    last: float = 5.0  # The last knot's weight over the others'.
    tip_height: float = 1e4  # [1/m2]
    tip_speed: float = 10.0  # [s2/m2]
    # An object that rolls goes on after the plan's end: its speed there counts as the
    # way that it goes in so long a time [s].
    coast_sec: float = 1.0


@dataclass
class PushLearnerConfig:
    """Of the residual on the contact of tip and object, as in ball_rolling.

    The weights Q_d are inverse variances of a speed over a step of 50 ms: of v_x, v_y
    of the object and of the tip, which a gap that is wrong moves too. The pose of a
    past moment (PastState) is good to 0.8 mm, which is 16 mm/s. The present one, all
    that there is with the camera, is a few hundredths of a second old when a push sets
    in: the tip seems to be up to 5 mm within the object, 0.08 m/s.
    """

    weight: float = 4e3
    weight_late: float = 150.0
    eps: float = 1e-3
    gamma: float = 5e-4
    r_max: float = 0.3  # [m/s]: 15 mm.
    slip_noise: float = 0.03  # [m/s]
    posterior: PosteriorConfig = field(
        default_factory=lambda: PosteriorConfig(
            free_states=[V_BALL.start, V_BALL.start + 1]
        )
    )


@dataclass
class PushModelConfig:
    """What of the model differs from the world."""

    # Scene file of what the controllers believe of arm and table; None: the world's,
    # without its effects, which are what no model knows.
    scene: str | None = None
    # Of the object with tip and table; None: the world's.
    friction: float | None = None
    scale: float = 1.0  # Of the object's size, times the world's.
    mass: float = 1.0  # Of the object's mass, times the world's.
    com_offset: list[float] = field(default_factory=lambda: [0.0, 0.0])  # Added [m].


@dataclass
class PushObjectConfig:
    """World and model start from the same object; errors change the model."""

    adapt: bool = True
    object: PushedObject = field(default_factory=PushedObject)
    friction: float = 0.5  # Of the object with tip and table, in the world.
    # Lever arm over radius of a cylinder that rolls, in the world; no model knows it.
    # None: 0.005, as of ball_rolling's ball.
    rolling_resistance: float | None = None
    model: PushModelConfig = field(default_factory=PushModelConfig)
    scene: str = PUSH_OBJECT  # The world's.
    seed: int = 0
    n_goals: int = 1  # In a row, drawn by the seed.
    start: list[float] = field(default_factory=list)  # x, y, yaw; empty: drawn.
    goals: PushGoalsConfig = field(default_factory=PushGoalsConfig)
    # What measures the object: a sensor of poses, as motion capture, or the camera.
    pose_from: Literal["sensor", "camera"] = "sensor"
    pose: PoseSensorConfig = field(default_factory=PoseSensorConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    tracker: PoseTrackerConfig = field(default_factory=PoseTrackerConfig)
    sampler: ContactSamplerConfig = field(
        default_factory=lambda: ContactSamplerConfig(SamplingConfig(reach=[0.32, 0.78]))
    )
    task: PushTaskConfig = field(default_factory=PushTaskConfig)
    planner: PushPlannerConfig = field(default_factory=PushPlannerConfig)
    learning: PushLearnerConfig = field(default_factory=PushLearnerConfig)
    # Whether the speed of a touch is learned, and falls where one is anticipated.
    gentle: bool = False
    touch: TouchDownConfig = field(default_factory=TouchDownConfig)
    reference: ArmReferenceConfig = field(
        default_factory=lambda: ArmReferenceConfig(
            force_max=8.0,
            acceleration_max=3.0,
            tip_mass=TIP_MASS,
            touch_speed=0.15,
            push_speed=0.2,
        )
    )
    impedance: ImpedanceConfig = field(
        default_factory=lambda: ImpedanceConfig(force_max=20.0)
    )


def poses_of(config: PushObjectConfig) -> np.ndarray:
    """(1 + n_goals, 3) x, y [m], yaw [rad]: where the object is at first, the goals."""
    if config.n_goals < 1:
        raise ValueError(f"n_goals is {config.n_goals}, expected at least 1")
    poses = draw_poses(config.goals, config.n_goals + 1, config.seed)
    if outline_fold(config) == 0:
        poses[:, 2] = 0.0  # Of a disc the camera knows no yaw; it is 0 at first.
    if config.start:
        if len(config.start) != 3:
            raise ValueError(f"start is {config.start}, expected [x, y, yaw]")
        poses[0] = config.start
    return poses


def world_scene(config: PushObjectConfig) -> Scene:
    """The scene that is simulated: the object, where it lies, its friction."""
    scene = read_scene(config.scene)
    if not config.friction > 0.0:
        raise ValueError(f"friction is {config.friction}, expected > 0")
    models = [d.add_model.name for d in scene.directives if d.add_model is not None]
    if OBJECT not in models:
        names = ", ".join(models)
        raise ValueError(f"the scene has {names}, expected a model {OBJECT} too")
    x, y, yaw = poses_of(config)[0]
    pose = [
        np.cos(yaw / 2),
        0.0,
        0.0,
        np.sin(yaw / 2),
        x,
        y,
        rest_height(config.object),
    ]
    _lay(scene, object_file(config.object), pose)
    _rub(scene, config.friction)
    resistance = config.rolling_resistance
    rolls = bool(rolling_axis(config.object))
    if resistance is None:
        resistance = ROLLING_RESISTANCE if rolls else 0.0
    if not resistance >= 0.0 or (resistance > 0.0 and not rolls):
        raise ValueError(
            f"rolling_resistance is {resistance}, expected >= 0"
            + ("" if rolls else f"; object.shape {config.object.shape} does not roll")
        )
    if resistance > 0.0:
        scene.effects.append(rolls_against(f"{OBJECT}~table", resistance))
    return scene


def _lay(scene: Scene, file: str | Path, pose) -> None:
    """The object of a file at a pose (7,), quaternion and place [m]."""
    for d in scene.directives:
        if d.add_model is not None and d.add_model.name == OBJECT:
            d.add_model.file = f"file://{file}"
    scene.initial.poses[f"{OBJECT}.{OBJECT}"] = [float(value) for value in pose]


def _rub(scene: Scene, friction: float) -> None:
    """The object's friction with tip and table."""
    for pair in (f"{TOOL}~{OBJECT}", f"{OBJECT}~table"):
        value = {"friction": friction}
        scene.effects.append(Effect("contact_friction", [pair], value))


def believed_object(config: PushObjectConfig) -> tuple[PushedObject, float]:
    """The object and the friction that the controllers believe."""
    o, m = config.object, config.model
    offset = [a + b for a, b in zip(o.com_offset, m.com_offset, strict=True)]
    friction = config.friction if m.friction is None else m.friction
    if not friction > 0.0:
        raise ValueError(f"model.friction is {friction}, expected > 0")
    spec = replace(o, scale=o.scale * m.scale, mass=o.mass * m.mass, com_offset=offset)
    return spec, friction


def believed_scene(config: PushObjectConfig) -> Scene:
    """What the controllers believe of arm, finger and table."""
    if config.model.scene is not None:
        return read_scene(config.model.scene)
    return replace(read_scene(config.scene), effects=[])


def outline_fold(config: PushObjectConfig) -> int:
    """Into how many equal turns the object may be turned without a difference to what
    measures it (numerics/pose_tracker.py): a sensor of poses knows every turn."""
    if config.pose_from == "sensor":
        return 1
    return make_shape(*seen_parts(config.object)).fold


def model_scene(config: PushObjectConfig, file: str | Path, pose) -> Scene:
    """The scene that the controllers believe, with what is wrong in it as effects.

    Args: file: of the world's object (models/pushed_object.py: object_sdf); pose (7,)
        of the object as it was measured first, quaternion and place [m].
    """
    scene = believed_scene(config)
    spec, friction = believed_object(config)
    _lay(scene, file, pose)
    m = config.model
    if m.scale != 1.0:
        scene.effects.append(Effect("object_size", [OBJECT], {"scale": m.scale}))
    if m.mass != 1.0:
        mass = {"mass": float(spec.mass)}
        scene.effects.append(Effect("object_mass", [OBJECT], mass))
    if any(m.com_offset) or (m.scale != 1.0 and any(config.object.com_offset)):
        com = dict(zip("xy", map(float, spec.com_offset), strict=True))
        scene.effects.append(Effect("object_com", [OBJECT], com))
    _rub(scene, friction)
    return scene


def rolling_axis(spec: PushedObject) -> list[float]:
    """About which the object rolls, in its frame; empty: it lies flat."""
    return [1.0, 0.0, 0.0] if spec.shape == "cylinder" else []


def past_config(pose: PoseSensorConfig, height: float) -> PastStateConfig:
    """How long ago the learner looks at, by when the readings about then are known.

    Raises: ValueError for readings that are too rare or too late.
    """
    plain = PastStateConfig(height=height, period_sec=LEARN, offset_sec=OFFSET["past"])
    # Of a parabola's readings two are on either side, and one is lost between ticks.
    half_width = max(plain.half_width, 2.5 * pose.period_sec)
    wait = pose.delay_sec + pose.period_sec + half_width
    if wait + half_width > KEPT_SEC:
        raise ValueError(
            f"pose: period_sec {pose.period_sec:g}, delay_sec {pose.delay_sec:g} are "
            "too long to learn from; expected less, or adapt=false"
        )
    ticks = max(plain.ticks, int(np.ceil(wait / LEARN - 1e-9)))
    return replace(plain, ticks=ticks, half_width=half_width)


def contact_pairs(spec: PushedObject, friction: float) -> list[ContactPair]:
    """Tip and object, then each of the object's supports on the table."""
    n = len(support_spheres(spec)[0])
    # Edges along the vertical do not jump as the normal goes around the object.
    tip = ContactPair(
        "tip::tip", f"{OBJECT}::{OBJECT}", friction, tangent=[0.0, 0.0, 1.0], closest=1
    )
    return [tip] + [
        ContactPair(f"{OBJECT}::support_{i}", "table::table", friction)
        for i in range(n)
    ]


def c3_config(
    planner: PushPlannerConfig, n_lam: int, axis: Sequence[float] = ()
) -> C3Config:
    """Args: axis: that the object rolls about, in its frame (3,); empty: it slides. A
    turn about it does not count, and what rolls goes on where nothing holds it.

    Raises: ValueError for a weight out of range.
    """
    p = planner
    if not 0.0 <= p.coast_sec < np.inf:
        raise ValueError(f"planner.coast_sec is {p.coast_sec}, expected >= 0")
    for name in ("position", "angle_radius", "last", "tip_height", "tip_speed"):
        if not getattr(p, name) > 0.0:
            raise ValueError(f"planner.{name} is {getattr(p, name)}, expected > 0")
    Q = np.zeros(N_X)
    Q[2], Q[V_TIP] = p.tip_height, p.tip_speed
    Q[P_BALL.start : P_BALL.start + 2], Q[V_BALL] = p.position, 20.0
    Q_N = Q.copy()
    Q_N[P_BALL.start : P_BALL.start + 2] *= p.last
    if axis:
        Q_N[V_BALL] += p.last * p.position * p.coast_sec**2
    G = plus_weights(force=5.0, n_lam=n_lam, n_tip=N_TIP)
    turn = p.position * p.angle_radius**2
    return C3Config(
        weights=C3Weights(
            Q, np.full(3, 0.01), G, G, Q_N=Q_N,
            orientation=[
                OrientationWeight(
                    Q_BALL.start, turn, p.last * turn, list(axis) if axis else None
                )
            ],
        ),
        options=C3Options(N=p.N, rounds=p.rounds, rho=2.2, polish=p.polish),
        residual_dt_sec=LEARN,
        sliding_command=True,
    )  # fmt: skip


def learner_config(learner: PushLearnerConfig, late: bool) -> ResidualLearnerConfig:
    """Args: late: whether the learner sees the present pose, not a past one."""
    weight = learner.weight_late if late else learner.weight
    if not weight >= 0.0:
        name = "weight_late" if late else "weight"
        raise ValueError(f"learning.{name} is {weight}, expected >= 0")
    Q_d = np.zeros(N_X)
    Q_d[[V_TIP.start, V_TIP.start + 1, V_BALL.start, V_BALL.start + 1]] = weight
    return ResidualLearnerConfig(
        Q_d=Q_d.tolist(),
        eps=learner.eps,
        gamma=learner.gamma,
        groups=[list(range(N_TIP))],
        r_max=learner.r_max,
        slip_noise=learner.slip_noise,
        posterior=learner.posterior,
    )


def _add_sensor(
    builder: DiagramBuilder, config: PushObjectConfig, spec: PushedObject, station
) -> LeafSystem:
    """What measures the object's pose, connected to the station; spec: as believed."""
    height, offset = rest_height(spec), OFFSET["sensor"]
    if config.pose_from == "camera":
        tracker = builder.AddNamedSystem(
            "pose_tracker",
            PoseTracker(
                replace(
                    config.tracker,
                    z=height,
                    hue=HUE,
                    rolling_axis=rolling_axis(spec),
                    period_sec=CONTROL,
                    offset_sec=offset,
                ),
                camera_model(config.camera),
                make_shape(*seen_parts(spec)),
            ),
        )
        builder.Connect(
            station.GetOutputPort("overhead.rgb_image"), tracker.GetInputPort("image")
        )
        return tracker
    plant = station.GetSubsystemByName("plant")
    sensor = builder.AddNamedSystem(
        "pose_sensor",
        PoseSensor(
            replace(
                config.pose,
                height=height,
                rolling_axis=rolling_axis(spec),
                offset_sec=offset,
            ),
            int(plant.GetBodyByName(OBJECT).index()),
            config.seed,
        ),
    )
    builder.Connect(
        station.GetOutputPort("body_poses"), sensor.GetInputPort("body_poses")
    )
    return sensor


# Of the task, as the legend says them.
PHASES = (
    "now: pushes",
    "now: moves to where it will touch next",
    "now: waits for the object to be seen",
)
# Settings that the diagram makes of others.
_OWN = {
    "goals": ("period_sec", "offset_sec"),
    "task": ("height", "clearance", "period_sec", "offset_sec"),
    "sampler": ("angle_radius", "residual_dt_sec", "offset_sec"),
    "reference": ("height", "nearest", "wrist", "period_sec", "offset_sec"),
    "impedance": ("period_sec", "offset_sec"),
    "pose": ("height", "rolling_axis", "offset_sec"),
    "tracker": ("z", "hue", "rolling_axis", "period_sec", "offset_sec"),
}


def make_push_object(
    config: PushObjectConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The whole experiment, each system by name in the diagram.

    For scoring, of the truth: `state_log` (the plant's state, at 80 Hz) and `touch_log`
    (3,), the force on the finger of all its contacts [N], and `load_log` (2,), the size
    of all contacts' forces on the arm and its finger, from the object and from anything
    else [N], both at 1 kHz; and of what is commanded: `torque_log` (7,) at 1 kHz,
    `goal_log` (5,) of PushGoals, `phase_log` (1,) of PushTask and `command_log` (3,) of
    ContactSampler, at 80 Hz. A diagram is done when the number in goal_log is n_goals.
    """
    check_own(config, _OWN)
    refuse_changed("sampler.sampling", config.sampler.sampling, ("wrist",))
    builder = DiagramBuilder()
    spec, friction = believed_object(config)
    station = builder.AddNamedSystem(
        "station",
        make_station(
            StationConfig(
                scene=config.scene,
                camera=config.camera if config.pose_from == "camera" else None,
                contact=[TOOL, OBJECT],
                seed=config.seed,
            ),
            meshcat,
            world_scene(config),
        ),
    )
    believed = believed_scene(config)
    arm = make_control_plant(believed)
    p_tip = (
        arm.GetFrameByName(TIP_FRAME)
        .CalcPoseInWorld(arm.CreateDefaultContext())
        .translation()
    )
    loaded = load_scene(believed, DiagramBuilder())
    tip = TipAndBall(
        tip_mass=TIP_MASS,
        tip_radius=sphere_radius(loaded.plant, loaded.scene_graph, TOOL),
    )
    height = rest_height(spec)
    points = [part.points for part in parts(spec)]
    top = height + max(float(p[:, 2].max()) for p in points)
    shape = ObjectShape(points, tip.tip_radius, top)
    pairs = contact_pairs(spec, friction)
    lcs, lcs_of = {}, {}
    for name, dt, period in (
        ("plan", PLAN_DT, CONTROL),
        ("command", CONTROL, CONTROL),
        ("learn", LEARN, LEARN),
    ):
        own = AnitescuLcsBuilder(
            make_tip_and_object(spec, tip)[0],
            LcsBuilderConfig(pairs, dt, None, period, OFFSET["lcs"]),
        )
        lcs_of[name] = own.model
        lcs[name] = builder.AddNamedSystem(f"lcs_{name}", own)
    n_lam = lcs_of["plan"].n_lam
    c3_settings = c3_config(config.planner, n_lam, rolling_axis(spec))

    sensor = _add_sensor(builder, config, spec, station)
    estimator = builder.AddNamedSystem(
        "state_estimator",
        StateEstimator(
            StateEstimatorConfig(
                ball_radius=height,
                tip_mass=tip.tip_mass,
                window_sec=LEARN,
                period_sec=ESTIMATE,
                offset_sec=OFFSET["estimator"],
            ),
            serial_chain_of(arm, TIP_FRAME),
            arm.GetPositions(arm.CreateDefaultContext()),
        ),
    )
    goals = builder.AddNamedSystem(
        "push_goals",
        PushGoals(
            replace(config.goals, period_sec=CONTROL, offset_sec=OFFSET["goals"]),
            poses_of(config)[1:],
            outline_fold(config),
        ),
    )
    # What rolls on is followed.
    rolls = bool(rolling_axis(spec))
    push = replace(config.task.push, follow=config.task.push.follow or rolls)
    sampling = config.sampler.sampling
    wrist = from_wrist(arm).tolist()
    sampling = replace(sampling, follow=sampling.follow or rolls, wrist=wrist)
    if not tip.tip_radius < sampling.height < top:
        raise ValueError(
            f"sampler.sampling.height is {sampling.height:g}, expected above the tip's "
            f"radius, {tip.tip_radius:g}, and below the object's top, {top:g} m"
        )
    task = builder.AddNamedSystem(
        "push_task",
        PushTask(
            replace(
                config.task,
                push=push,
                height=sampling.height,
                clearance=sampling.clearance,
                period_sec=CONTROL,
                offset_sec=OFFSET["task"],
            ),
            config.planner.N + 1,
            shape,
            p_tip,
        ),
    )
    sampler = builder.AddNamedSystem(
        "contact_sampler",
        ContactSampler(
            replace(
                config.sampler,
                sampling=sampling,
                angle_radius=config.planner.angle_radius,
                residual_dt_sec=LEARN,
                offset_sec=OFFSET["sampler"],
            ),
            lcs_of["plan"],
            C3Problem(c3_settings.weights, c3_settings.projection, c3_settings.options),
            shape,
        ),
    )
    c3 = builder.AddNamedSystem("c3_mpc", C3Mpc(c3_settings, CONTROL, OFFSET["c3"]))
    at_default = {name: one.at_default() for name, one in lcs_of.items()}
    reference = builder.AddNamedSystem(
        "arm_reference",
        ArmReference(
            replace(
                config.reference,
                height=sampling.height,
                nearest=max(sampling.reach[0] - sampling.inwards, 0.0),
                wrist=wrist,
                period_sec=CONTROL,
                offset_sec=OFFSET["reference"],
            ),
            n_lam,
            p_tip,
            at_default["command"],
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
        ),
    )
    no_force = builder.AddNamedSystem("no_force", ConstantVectorSource(np.zeros(3)))

    connect = partial(wiring.connect, builder)
    for name, port in (
        ("p_WB", "p_ball"), ("v_WB", "v_ball"), ("seen", "seen"),
        ("q_WB", "q_object"), ("w_WB", "w_object"),
    ):  # fmt: skip
        connect(sensor, name, estimator, port)
    connect(station, f"{ARM}.position_measured", estimator, "q")
    connect(station, f"{ARM}.velocity_measured", estimator, "v")
    connect(station, f"{ARM}.torque_measured", estimator, "torque")
    past = estimator
    if config.adapt and sensor.HasOutputPort("readings"):
        past = builder.AddNamedSystem(
            "past_state",
            PastState(
                past_config(config.pose, height),
                rolling_axis(spec) or np.zeros(3),
            ),
        )
        connect(estimator, "x", past, "x")
        connect(estimator, "u_measured", past, "u_measured")
        connect(sensor, "readings", past, "readings")
    for name, one in lcs.items():
        connect(past if name == "learn" else estimator, "x", one, "x")
        builder.Connect(no_force.get_output_port(), one.GetInputPort("u"))
    if config.adapt:
        learner = builder.AddNamedSystem(
            "residual_learner",
            ResidualLearner(
                learner_config(config.learning, late=past is estimator),
                at_default["learn"],
                LEARN,
                OFFSET["learner"],
            ),
        )
        connect(past, "x", learner, "x")
        connect(past, "u_measured", learner, "u_measured")
        ready = "window_valid" if past is estimator else "ready"
        connect(past, ready, learner, "enable")
        connect(lcs["learn"], "lcs", learner, "lcs")
        r_comp = learner.GetOutputPort("r_comp")
        if meshcat is not None:
            button = builder.AddNamedSystem("adapt_button", AdaptButton(n_lam, meshcat))
            builder.Connect(r_comp, button.get_input_port())
            r_comp = button.get_output_port()
        for system in (c3, sampler):
            builder.Connect(r_comp, system.GetInputPort("r_comp"))
    for system in (goals, task, sampler):
        connect(estimator, "x", system, "x")
        connect(estimator, "valid", system, "valid")
    for system in (task, sampler):
        connect(goals, "goal", system, "goal")
    connect(task, "x_desired", sampler, "x_desired")
    connect(task, "phase", sampler, "phase")
    connect(sampler, "command", task, "command")
    connect(estimator, "x", c3, "x")
    connect(task, "x_desired", c3, "x_desired")
    connect(lcs["plan"], "lcs", c3, "lcs")
    connect(lcs["command"], "lcs", c3, "lcs_command")
    connect(task, "phase", reference, "phase")
    connect(task, "reference", reference, "reference")
    connect(estimator, "tip_force", reference, "tip_force")
    connect(c3, "x_next", reference, "x_next")
    connect(c3, "lam", reference, "lam")
    connect(c3, "status", reference, "status")
    connect(lcs["command"], "lcs", reference, "lcs")
    if config.gentle:
        if config.touch.most > config.reference.push_speed:
            raise ValueError(
                f"touch.most is {config.touch.most}, expected at most "
                f"reference.push_speed, {config.reference.push_speed} m/s"
            )
        touch = builder.AddNamedSystem(
            "touch_down",
            TouchDown(config.touch, shape, ESTIMATE, OFFSET["touch"]),
        )
        for source, name in (
            (estimator, "x"), (estimator, "valid"), (task, "phase"),
            (estimator, "tip_force"),
        ):  # fmt: skip
            connect(source, name, touch, name)
        connect(touch, "touch_speed", reference, "touch_speed")
    connect(station, f"{ARM}.position_measured", impedance, "q")
    connect(station, f"{ARM}.velocity_measured", impedance, "v")
    connect_command(builder, reference, impedance)
    tau = impedance.GetOutputPort("tau")
    builder.Connect(tau, station.GetInputPort(f"{ARM}.torque_commanded"))

    plant = station.GetSubsystemByName("plant")
    of_arm = [
        plant.get_body(i)
        for name in (ARM, TOOL)
        for i in plant.GetBodyIndices(plant.GetModelInstanceByName(name))
    ]
    load = builder.AddNamedSystem(
        "contact_load", ContactLoad(of_arm, plant.GetBodyByName(OBJECT))
    )
    connect(station, "contact_results", load, "contact_results")
    for name, source, period in (
        ("torque_log", tau, ARM_TICK),
        ("load_log", load.get_output_port(), ARM_TICK),
        ("touch_log", station.GetOutputPort(f"{TOOL}.contact_force"), ARM_TICK),
        ("state_log", station.GetOutputPort("state"), CONTROL),
        ("goal_log", goals.GetOutputPort("log"), CONTROL),
        ("phase_log", task.GetOutputPort("phase"), CONTROL),
        ("command_log", sampler.GetOutputPort("command"), CONTROL),
    ):
        LogVectorOutput(source, builder, period).set_name(name)
    # As it was measured: what the estimators make of it comes late, and is smoothed.
    readings = {"object": (sensor.GetOutputPort("reading"), ["", *READING_COLUMNS])}
    late = CONTROL
    if config.pose_from == "sensor":
        late = config.pose.delay_sec + config.pose.period_sec
    record_station(builder, station, tau, TOOL, readings=readings, behind_sec=late)
    if meshcat is not None:
        view = builder.AddNamedSystem(
            "push_view",
            PushView(
                PushViewConfig(height=height),
                [(part.shape, part.X_BS) for part in parts(spec)],
                meshcat,
            ),
        )
        connect(goals, "goal", view, "goal")
        connect(estimator, "x", view, "x")
        connect(estimator, "valid", view, "valid")
        legend = LegendConfig(view.LEGEND, PHASES, view.CAMERA, view.LOOK_AT)
        add_legend(builder, meshcat, legend, task.GetOutputPort("phase"))
    diagram = builder.Build()
    diagram.set_name("push_object")
    return diagram
