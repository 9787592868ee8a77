"""A Panda pushes an object over a table to poses, choosing where to touch it.

    station --body_poses--> pose_sensor --> state_estimator <-- q, v, torque -- station
       (or --image--> pose_tracker -->)
    state_estimator --x--> push_goals --goal--> push_task, contact_sampler
    push_task --x_desired--> c3_mpc, contact_sampler
    contact_sampler --command (where to touch)--> push_task, --guess--> c3_mpc
    pose_sensor, state_estimator --> past_state --> lcs_learn, residual_learner
    residual_learner --r_comp--> c3_mpc, contact_sampler
    or past_state --> parameter_learner --parameters--> lcs_plan, lcs_command,
        contact_sampler (but the gap, which goes the way of r_comp)
    c3_mpc (contact), push_task (travel) --> arm_reference
    gentle: state_estimator --tip_force--> touch_down --touch_speed--> arm_reference
    arm_reference --> impedance_controller --tau--> station

Nothing passes from the world to the controllers but encoders, torques and what a pose
sensor or a camera measures of the object.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from makebreak.diagrams import wiring
from makebreak.diagrams.camera import camera_model
from makebreak.diagrams.fault_kinds import read_faults
from makebreak.diagrams.learned_parameters import (
    add_parameter_learner,
    add_past_state,
    past_config,
    u_and_ready,
)
from makebreak.diagrams.push_object_config import (
    ARM_TICK,
    CONTROL,
    ESTIMATE,
    LEARN,
    N_TIP,
    OBJECT,
    OFFSET,
    PLAN_DT,
    PUSH_OBJECT,
    SET_BY_DIAGRAM,
    STEADY,
    TIP_MASS,
    WEIGHT,
    PushModelConfig,
    PushObjectConfig,
    c3_config,
    contact_pairs,
    learned_parameters,
    learner_config,
    parameter_learner_config,
    rolling_axis,
)
from makebreak.diagrams.push_object_scenes import (
    model_arm_scene,
    model_object,
    outline_fold,
    poses_of,
    world_scene,
)
from makebreak.diagrams.realism import draw_errors
from makebreak.diagrams.recorder import record_station
from makebreak.diagrams.scene_facts import sphere_radius
from makebreak.diagrams.station import (
    ARM,
    DELAY,
    TIP_FRAME,
    TOOL,
    StationConfig,
    StationFaults,
    control_laws,
    from_wrist,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.wiring import (
    add_legend,
    check_own,
    connect_command,
    refuse_changed,
    refuse_unused,
)
from makebreak.models.pushed_object import (
    HUE,
    PushedObject,
    make_tip_and_object,
    parts,
    rest_height,
    seen_parts,
)
from makebreak.models.scene import load_scene
from makebreak.models.tip_and_ball import TipAndBall
from makebreak.systems.arm.arm_reference import ArmReference
from makebreak.systems.arm.impedance_controller import (
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.changing_contact.touch_down import TouchDown
from makebreak.systems.contact_mpc.c3_mpc import C3Mpc
from makebreak.systems.contact_mpc.contact_sampler import ContactSampler
from makebreak.systems.contact_mpc.lcs_builder import (
    AnitescuLcsBuilder,
    LcsBuilderConfig,
)
from makebreak.systems.contact_mpc.multibody.model_parameters import Parameter
from makebreak.systems.contact_mpc.numerics.c3_mpc import C3Problem
from makebreak.systems.contact_mpc.numerics.contact_sampling import (
    ObjectShape,
    SamplingConfig,
)
from makebreak.systems.contact_mpc.parameter_learner import ParameterLearner
from makebreak.systems.contact_mpc.push_goals import PushGoals
from makebreak.systems.contact_mpc.push_task import PushTask
from makebreak.systems.contact_mpc.residual_learner import ResidualLearner
from makebreak.systems.perception.numerics.object_outline import make_shape
from makebreak.systems.perception.past_state import PastState
from makebreak.systems.perception.pose_sensor import PoseSensor
from makebreak.systems.perception.pose_tracker import PoseTracker
from makebreak.systems.perception.state_estimator import (
    StateEstimator,
    StateEstimatorConfig,
)
from makebreak.systems.views.adapt_button import AdaptButton
from makebreak.systems.views.contact_probe import ContactLoad
from makebreak.systems.views.legend import LegendConfig
from makebreak.systems.views.push_view import PushView, PushViewConfig

__all__ = ["PUSH_OBJECT", "PushModelConfig", "PushObjectConfig", "make_push_object"]

READING_COLUMNS = [f"{OBJECT}.{OBJECT}.{p}" for p in (*"xyz", "qw", "qx", "qy", "qz")]
# Texts of the legend, in the order of PushTask's phases.
PHASES = (
    "now: pushes",
    "now: moves to where it will touch next",
    "now: waits for the object to be seen",
)


def make_push_object(
    config: PushObjectConfig, meshcat: Meshcat | None = None
) -> Diagram:
    """The whole experiment; every system can be asked for by name.

    Logs of the truth, for scoring alone: `state_log` (n_x,) of the plant, at 80 Hz;
    `touch_log` (3,) the force of all contacts on the finger [N], and `load_log` (2,)
    the sums of the magnitudes of the contact forces on arm and finger, from the object
    and from anything else [N], both at 1 kHz.
    Logs of commands: `torque_log` (7,) [N m] at 1 kHz; `goal_log` (5,) of PushGoals,
    `phase_log` (1,) of PushTask and `command_log` (3,) of ContactSampler at 80 Hz. The
    run is done when the goal number in goal_log is n_goals.

    Raises: ValueError for a setting out of range or one that this diagram computes.
    """
    check_own(config, SET_BY_DIAGRAM)
    refuse_changed("sampler.sampling.reach", config.sampler.sampling.reach, ("wrist",))
    _refuse_unused(config)
    builder = DiagramBuilder()
    model = _make_model(config)
    station = _add_station(builder, config, meshcat)
    items = learned_parameters(config)
    lcs = _add_lcs_builders(builder, model, items)
    sensor, estimator = _add_sensing(builder, config, model, station)
    planning = _add_planning(builder, config, model, lcs)
    reference, impedance = _add_arm_control(builder, config, model, planning, lcs)
    _connect_estimates(builder, station, sensor, estimator)
    past = estimator
    learns = config.adapt and config.learner != "none"
    if learns and config.pose_from == "sensor":  # The camera gives no readings.
        of = past_config(
            model.height, OFFSET["past"], config.pose.period_sec, config.pose.delay_sec
        )
        axis = rolling_axis(model.spec) or np.zeros(3)
        past = add_past_state(builder, PastState(of, axis), sensor, estimator)
    _connect_lcs_builders(builder, lcs, estimator, past)
    if learns:
        if items:
            users = [lcs["plan"], lcs["command"], planning.sampler]
            pairs = contact_pairs(model.spec, model.friction)
            steady = 0.0 if model.rolls else STEADY
            parameter_learner = ParameterLearner(
                make_tip_and_object(model.spec, model.tip, steady)[0],
                parameter_learner_config(config.parameters, pairs, items),
                LEARN,
                OFFSET["learner"],
            )
            # The planner's friction of object and table is that of a heavier object.
            scale = [
                1.0 / model.weight if p.kind == "friction" and p.pairs != [0] else 1.0
                for p in items
            ]
            r_comp = add_parameter_learner(
                builder, parameter_learner, past, users, N_TIP, LEARN, scale
            )
        else:
            learner = _add_learner(builder, config, lcs["learn"], past)
            r_comp = _switchable(builder, learner.GetOutputPort("r_comp"), meshcat)
        for system in (planning.c3, planning.sampler):
            builder.Connect(r_comp, system.GetInputPort("r_comp"))
    _connect_planning(builder, planning, lcs, estimator)
    _connect_reference(builder, planning, lcs, estimator, reference)
    if config.gentle:
        _add_touch_down(builder, config, model, planning, estimator, reference)
    wiring.connect(builder, station, f"{ARM}.position_measured", impedance, "q")
    wiring.connect(builder, station, f"{ARM}.velocity_measured", impedance, "v")
    if station.HasOutputPort(DELAY):
        wiring.connect(builder, station, DELAY, impedance, "delay")
    connect_command(builder, reference, impedance)
    tau = impedance.GetOutputPort("tau")
    builder.Connect(tau, station.GetInputPort(f"{ARM}.torque_commanded"))
    _add_records(builder, config, station, sensor, planning, tau)
    if meshcat is not None:
        _add_view(builder, model, planning, estimator, meshcat)
    diagram = builder.Build()
    diagram.set_name("push_object")
    return diagram


@dataclass(frozen=True, eq=False)
class _Model:
    """What the controllers know of the arm and of the object."""

    spec: PushedObject
    friction: float  # Of the object with tip and table.
    height: float  # Of the object's frame above the table [m].
    top: float  # Height of the object's highest point [m].
    shape: ObjectShape
    arm: MultibodyPlant  # Arm and finger alone.
    p_tip: np.ndarray  # (3,) of the finger's tip in the arm's initial posture [m].
    wrist: list[float]  # (2,) from the wrist to the tip, seen from above [m].
    tip: TipAndBall

    @property
    def rolls(self) -> bool:
        return bool(rolling_axis(self.spec))

    @property
    def weight(self) -> float:
        """Of the object for the planner, over its own."""
        return 1.0 if self.rolls else WEIGHT


def _refuse_unused(config: PushObjectConfig) -> None:
    """Raises: ValueError for settings of parts that the chosen ones replace."""
    plain = PushObjectConfig()
    # A renderer does no harm: sweeps set it for all cases.
    plain.camera.renderer = config.camera.renderer
    if config.pose_from == "sensor":
        unused = ["camera", "tracker", "learning.weight_late"]
    else:
        unused = ["pose", "learning.weight"]
    for name in unused:
        why = f"not used with pose_from={config.pose_from}"
        refuse_unused(config, plain, name, why)
    learner = config.learner if config.adapt else "none"
    if learner != "parameters":
        why = f"not used with learner={learner}"
        refuse_unused(config, plain, "parameters", why)
    if not config.gentle:
        refuse_unused(config, plain, "touch", "not used with gentle=false")
    if not rolling_axis(config.object):
        why = f"not used with object.shape={config.object.shape}"
        refuse_unused(config, plain, "planner.coast_sec", why)


def _make_model(config: PushObjectConfig) -> _Model:
    spec, friction = model_object(config)
    scene = model_arm_scene(config)
    arm = make_control_plant(scene)
    tip_frame = arm.GetFrameByName(TIP_FRAME)
    p_tip = tip_frame.CalcPoseInWorld(arm.CreateDefaultContext()).translation()
    loaded = load_scene(scene, DiagramBuilder())
    tip_radius = sphere_radius(loaded.plant, loaded.scene_graph, TOOL)
    height = rest_height(spec)
    points = [part.points for part in parts(spec)]
    top = height + max(float(p[:, 2].max()) for p in points)
    return _Model(
        spec=spec,
        friction=friction,
        height=height,
        top=top,
        shape=ObjectShape(points, tip_radius, top),
        arm=arm,
        p_tip=p_tip,
        wrist=from_wrist(arm).tolist(),
        tip=TipAndBall(tip_mass=TIP_MASS, tip_radius=tip_radius),
    )


# ----- Systems.


def _add_station(builder: DiagramBuilder, config: PushObjectConfig, meshcat) -> Diagram:
    faults = None
    if config.faults:
        faults = StationFaults(read_faults(config.faults, ()))
    return builder.AddNamedSystem(
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
            draw_errors(config.realism, config.seed),
            wrong=faults,
        ),
    )


def _add_lcs_builders(
    builder: DiagramBuilder, model: _Model, items: list[Parameter]
) -> dict[str, AnitescuLcsBuilder]:
    """The contact model for planning, for the command between knots, and for learning
    gaps; a learner of the items has its own."""
    added, planned = {}, [p for p in items if p.kind != "gap"]
    for name, dt, period, weight in (
        ("plan", PLAN_DT, CONTROL, model.weight),
        ("command", CONTROL, CONTROL, model.weight),
        ("learn", LEARN, LEARN, 1.0),
    )[: 2 if items else 3]:
        pairs = contact_pairs(model.spec, model.friction, weight)
        added[name] = builder.AddNamedSystem(
            f"lcs_{name}",
            AnitescuLcsBuilder(
                make_tip_and_object(model.spec, model.tip, weight=weight)[0],
                LcsBuilderConfig(
                    pairs, dt, None, period, OFFSET["lcs"], parameters=planned
                ),
            ),
        )
    return added


def _add_sensing(
    builder: DiagramBuilder, config: PushObjectConfig, model: _Model, station: Diagram
) -> tuple[LeafSystem, StateEstimator]:
    """What measures the object's pose, connected to the station, and the estimator."""
    if config.pose_from == "camera":
        sensor = _add_pose_tracker(builder, config, model, station)
    else:
        sensor = _add_pose_sensor(builder, config, model, station)
    estimator = builder.AddNamedSystem(
        "state_estimator",
        StateEstimator(
            StateEstimatorConfig(
                ball_radius=model.height,
                tip_mass=model.tip.tip_mass,
                window_sec=LEARN,
                period_sec=ESTIMATE,
                offset_sec=OFFSET["estimator"],
            ),
            serial_chain_of(model.arm, TIP_FRAME),
            model.arm.GetPositions(model.arm.CreateDefaultContext()),
        ),
    )
    return sensor, estimator


def _add_pose_tracker(builder, config, model, station) -> PoseTracker:
    settings = replace(
        config.tracker,
        z=model.height,
        hue=HUE,
        rolling_axis=rolling_axis(model.spec),
        period_sec=CONTROL,
        offset_sec=OFFSET["sensor"],
    )
    shape = make_shape(*seen_parts(model.spec))
    tracker = builder.AddNamedSystem(
        "pose_tracker", PoseTracker(settings, camera_model(config.camera), shape)
    )
    wiring.connect(builder, station, "overhead.rgb_image", tracker, "image")
    return tracker


def _add_pose_sensor(builder, config, model, station) -> PoseSensor:
    settings = replace(
        config.pose,
        height=model.height,
        rolling_axis=rolling_axis(model.spec),
        offset_sec=OFFSET["sensor"],
    )
    plant = station.GetSubsystemByName("plant")
    body = int(plant.GetBodyByName(OBJECT).index())
    sensor = builder.AddNamedSystem(
        "pose_sensor", PoseSensor(settings, body, config.seed)
    )
    wiring.connect(builder, station, "body_poses", sensor, "body_poses")
    return sensor


@dataclass(frozen=True, eq=False)
class _Planning:
    """The systems that choose goals, where to touch, and the tip's motion."""

    goals: PushGoals
    task: PushTask
    sampler: ContactSampler
    c3: C3Mpc
    sampling: SamplingConfig  # As the sampler has it.


def _add_planning(
    builder: DiagramBuilder,
    config: PushObjectConfig,
    model: _Model,
    lcs: dict[str, AnitescuLcsBuilder],
) -> _Planning:
    goals = builder.AddNamedSystem(
        "push_goals",
        PushGoals(
            replace(config.goals, period_sec=CONTROL, offset_sec=OFFSET["goals"]),
            poses_of(config)[1:],
            outline_fold(config),
        ),
    )
    # A rolling object carries the place where it will be touched along with it.
    follow = config.sampler.sampling.follow or model.rolls
    sampling = config.sampler.sampling
    reach = replace(sampling.reach, wrist=model.wrist)
    sampling = replace(sampling, follow=follow, reach=reach)
    radius = model.tip.tip_radius
    if not radius < sampling.height < model.top:
        raise ValueError(
            f"sampler.sampling.height is {sampling.height:g}, expected above the tip's "
            f"radius, {radius:g}, and below the object's top, {model.top:g} m"
        )
    task = builder.AddNamedSystem(
        "push_task",
        PushTask(
            replace(
                config.task,
                push=replace(
                    config.task.push, follow=config.task.push.follow or model.rolls
                ),
                height=sampling.height,
                clearance=sampling.clearance,
                period_sec=CONTROL,
                offset_sec=OFFSET["task"],
            ),
            config.planner.options.N + 1,
            model.shape,
            model.p_tip,
        ),
    )
    lcs_plan = lcs["plan"].model
    c3 = c3_config(config.planner, lcs_plan.n_lam, rolling_axis(model.spec))
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
            lcs_plan,
            C3Problem(c3.weights, c3.projection, c3.options),
            model.shape,
        ),
    )
    mpc = builder.AddNamedSystem("c3_mpc", C3Mpc(c3, CONTROL, OFFSET["c3"]))
    return _Planning(goals, task, sampler, mpc, sampling)


def _add_arm_control(
    builder: DiagramBuilder,
    config: PushObjectConfig,
    model: _Model,
    planning: _Planning,
    lcs: dict[str, AnitescuLcsBuilder],
) -> tuple[ArmReference, ImpedanceController]:
    sampling, lcs_command = planning.sampling, lcs["command"].model
    reference = builder.AddNamedSystem(
        "arm_reference",
        ArmReference(
            replace(
                config.reference,
                height=sampling.height,
                nearest=max(sampling.reach.range[0] - sampling.reach.inwards, 0.0),
                wrist=model.wrist,
                period_sec=CONTROL,
                offset_sec=OFFSET["reference"],
            ),
            lcs_command.n_lam,
            model.p_tip,
            lcs_command.at_default(),
        ),
    )
    impedance = builder.AddNamedSystem(
        "impedance_controller",
        ImpedanceController(
            replace(
                config.impedance, period_sec=ARM_TICK, offset_sec=OFFSET["impedance"]
            ),
            model.arm,
            TIP_FRAME,
            laws=control_laws(model_arm_scene(config), model.arm),
        ),
    )
    return reference, impedance


def _add_learner(builder, config, lcs, past) -> ResidualLearner:
    """Args: past: the PastState, or the estimator where there is none."""
    u, ready = u_and_ready(past)
    learner = builder.AddNamedSystem(
        "residual_learner",
        ResidualLearner(
            learner_config(config.learning, late=not isinstance(past, PastState)),
            lcs.model.at_default(),
            LEARN,
            OFFSET["learner"],
        ),
    )
    connect = partial(wiring.connect, builder)
    connect(past, "x", learner, "x")
    connect(past, u, learner, "u_measured")
    connect(past, ready, learner, "enable")
    connect(lcs, "lcs", learner, "lcs")
    return learner


def _switchable(
    builder: DiagramBuilder, r_comp: OutputPort, meshcat: Meshcat | None
) -> OutputPort:
    """The learned residual, behind Meshcat's button for adaptation if there is one."""
    if meshcat is None:
        return r_comp
    button = builder.AddNamedSystem("adapt_button", AdaptButton(r_comp.size(), meshcat))
    builder.Connect(r_comp, button.get_input_port())
    return button.get_output_port()


def _add_touch_down(builder, config, model, planning, estimator, reference) -> None:
    """The learned speed of a touch, which slows the reference before one."""
    if config.touch.speed.most > config.reference.limits.push_speed:
        raise ValueError(
            f"touch.speed.most is {config.touch.speed.most}, expected at most "
            f"reference.limits.push_speed, {config.reference.limits.push_speed} m/s"
        )
    touch = builder.AddNamedSystem(
        "touch_down",
        TouchDown(config.touch, model.shape, ESTIMATE, OFFSET["touch"]),
    )
    connect = partial(wiring.connect, builder)
    connect(estimator, "x", touch, "x")
    connect(estimator, "valid", touch, "valid")
    connect(planning.task, "phase", touch, "phase")
    connect(estimator, "tip_force", touch, "tip_force")
    connect(touch, "touch_speed", reference, "touch_speed")


# ----- Connections.


def _connect_estimates(builder, station, sensor, estimator) -> None:
    connect = partial(wiring.connect, builder)
    for name, port in (
        ("p_WB", "p_ball"), ("v_WB", "v_ball"), ("seen", "seen"),
        ("q_WB", "q_object"), ("w_WB", "w_object"),
    ):  # fmt: skip
        connect(sensor, name, estimator, port)
    connect(station, f"{ARM}.position_measured", estimator, "q")
    connect(station, f"{ARM}.velocity_measured", estimator, "v")
    connect(station, f"{ARM}.torque_measured", estimator, "torque")


def _connect_lcs_builders(builder, lcs, estimator, past) -> None:
    """Each LCS is taken about the state and zero input."""
    no_force = builder.AddNamedSystem("no_force", ConstantVectorSource(np.zeros(3)))
    for name, system in lcs.items():
        state = past if name == "learn" else estimator
        wiring.connect(builder, state, "x", system, "x")
        builder.Connect(no_force.get_output_port(), system.GetInputPort("u"))


def _connect_planning(builder, planning: _Planning, lcs, estimator) -> None:
    goals, task, sampler = planning.goals, planning.task, planning.sampler
    connect = partial(wiring.connect, builder)
    for system in (goals, task, sampler):
        connect(estimator, "x", system, "x")
        connect(estimator, "valid", system, "valid")
    for system in (task, sampler):
        connect(goals, "goal", system, "goal")
    connect(task, "x_desired", sampler, "x_desired")
    connect(task, "phase", sampler, "phase")
    connect(sampler, "command", task, "command")
    connect(estimator, "x", planning.c3, "x")
    connect(task, "x_desired", planning.c3, "x_desired")
    connect(sampler, "guess", planning.c3, "guess")
    connect(lcs["plan"], "lcs", planning.c3, "lcs")
    connect(lcs["command"], "lcs", planning.c3, "lcs_command")


def _connect_reference(builder, planning: _Planning, lcs, estimator, reference) -> None:
    connect = partial(wiring.connect, builder)
    connect(planning.task, "phase", reference, "phase")
    connect(planning.task, "reference", reference, "reference")
    connect(estimator, "tip_force", reference, "tip_force")
    for name in ("x_next", "lam", "status"):
        connect(planning.c3, name, reference, name)
    connect(lcs["command"], "lcs", reference, "lcs")


# ----- Records and view.


def _add_records(
    builder: DiagramBuilder,
    config: PushObjectConfig,
    station: Diagram,
    sensor: LeafSystem,
    planning: _Planning,
    tau: OutputPort,
) -> None:
    """The logs of make_push_object, and what a real robot could record."""
    plant = station.GetSubsystemByName("plant")
    arm_bodies = [
        plant.get_body(i)
        for name in (ARM, TOOL)
        for i in plant.GetBodyIndices(plant.GetModelInstanceByName(name))
    ]
    load = builder.AddNamedSystem(
        "contact_load",
        ContactLoad(arm_bodies, plant.GetBodyByName(OBJECT), tau.size()),
    )
    wiring.connect(builder, station, "contact_results", load, "contact_results")
    wiring.connect(builder, station, f"{ARM}.contact_torque", load, "contact_torque")
    for name, source, period in (
        ("torque_log", tau, ARM_TICK),
        ("load_log", load.get_output_port(), ARM_TICK),
        ("touch_log", station.GetOutputPort(f"{TOOL}.contact_force"), ARM_TICK),
        ("state_log", station.GetOutputPort("state"), CONTROL),
        ("goal_log", planning.goals.GetOutputPort("log"), CONTROL),
        ("phase_log", planning.task.GetOutputPort("phase"), CONTROL),
        ("command_log", planning.sampler.GetOutputPort("command"), CONTROL),
    ):
        LogVectorOutput(source, builder, period).set_name(name)
    # The readings as they came: the estimator's pose is smoothed and later.
    readings = {"object": (sensor.GetOutputPort("reading"), ["", *READING_COLUMNS])}
    late = CONTROL
    if config.pose_from == "sensor":
        late = config.pose.delay_sec + config.pose.period_sec
    record_station(builder, station, tau, TOOL, readings=readings, behind_sec=late)


def _add_view(builder, model, planning: _Planning, estimator, meshcat) -> None:
    view = builder.AddNamedSystem(
        "push_view",
        PushView(
            PushViewConfig(height=model.height),
            [(part.shape, part.X_BS) for part in parts(model.spec)],
            meshcat,
        ),
    )
    wiring.connect(builder, planning.goals, "goal", view, "goal")
    wiring.connect(builder, estimator, "x", view, "x")
    wiring.connect(builder, estimator, "valid", view, "valid")
    legend = LegendConfig(view.LEGEND, PHASES, view.CAMERA, view.LOOK_AT)
    add_legend(builder, meshcat, legend, planning.task.GetOutputPort("phase"))
