"""The station: a Panda with a tool, its sensors, and a camera above it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Demultiplexer, Saturation

from makebreak.diagrams.camera import CameraConfig, add_camera
from makebreak.diagrams.fault_kinds import Injected
from makebreak.diagrams.faults import (
    add_forces,
    faulty_command,
    faulty_image,
    faulty_sensor,
    with_box,
)
from makebreak.diagrams.realism import StationErrors
from makebreak.diagrams.scene_facts import actuators_of
from makebreak.diagrams.wiring import add_generalized_forces
from makebreak.models.effects import KINDS
from makebreak.models.model_files import MODELS
from makebreak.models.scene import InitialSection, Scene, load_scene, read_scene
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.tool_wrench import ToolWrench
from makebreak.systems.faults.fault_forces import BodyForce
from makebreak.systems.faults.fault_signals import LateSignal
from makebreak.systems.faults.safety_monitor import ArmLimits, SafetyMonitor
from makebreak.systems.perception.noisy_sensor import (
    DriftingSensor,
    LateSensor,
    NoisySensor,
)
from makebreak.systems.views.contact_probe import (
    ContactProbe,
    ToolContactForce,
    TrueTip,
)
from makebreak.systems.views.push_button import PushButton

BALL_ROLLING = str(MODELS / "ball_rolling.scene.yaml")
ARM, TOOL, TIP_FRAME = "panda", "finger", "tip"
TORQUE_RATE_MAX = 1000.0  # [N m/s] of the real Panda.
MONITOR, DELAY = f"{ARM}.monitor", f"{ARM}.delay"  # Ports that may be there.


@dataclass
class SensorNoise:
    """Standard deviations of the sensors' Gaussian noise, white at 1 kHz."""

    position: float = 1e-5  # [rad]
    velocity: float = 1e-3  # [rad/s]
    torque: float = 0.1  # [N m]
    force: float = 0.1  # [N]
    moment: float = 0.01  # [N m]


@dataclass
class StationConfig:
    scene: str = BALL_ROLLING  # Path of the world's scene file.
    noise: SensorNoise = field(default_factory=SensorNoise)
    camera: CameraConfig | None = None
    tool: str = TOOL  # The scene's model that is mounted on the arm.
    contact: list[str] = field(default_factory=lambda: [TOOL, "ball"])  # To be scored.
    seed: int = 0
    meshcat_period_sec: float = 1.0 / 30.0
    # Sensors are read once per step of the plant, and all who ask in it get that
    # reading. Else each is worked out, with noise of its own, whenever it is asked for.
    sampled: bool = False


@dataclass(frozen=True)
class StationFaults:
    """What goes wrong in a station (diagrams/faults.py)."""

    faults: Sequence[Injected]
    box_at: Sequence[float] = (0.0, 0.0, 0.0)  # (3,) of a stray box [m].
    ball: str = "ball"  # The model that a camera looks for.
    center: Sequence[float] = (0.5, 0.0)  # (2,) about which it is put elsewhere [m].


def make_station(
    config: StationConfig,
    meshcat: Meshcat | None = None,
    scene: Scene | None = None,
    errors: StationErrors | None = None,
    wrong: StationFaults | None = None,
) -> Diagram:
    """The plant, its sensors and actuators.

    Inputs:  panda.torque_commanded (7,) the motors' torque [N m], clipped to the
             effort limits.
    Outputs: panda.position_measured (7,) [rad], panda.velocity_measured (7,) [rad/s],
             panda.torque_measured (7,) of the motors, after the limits [N m], all with
             noise;
             panda.external_wrench (6,) on the tool at its tip, world axes, force first,
             the tool's weight removed, with noise [N], [N m];
             overhead.rgb_image (ImageRgba8U), if there is a camera;
             and the truth, for scoring and tests alone: state (n_x,);
             contact_force (4,) = [normal, x, y, z] [N] of the first body of
             config.contact on the second (4 more for each further one);
             {tool}.contact_force (3,) on the tool, of all its contacts, in the world
             [N], and {tool}.tip_position (3,) in the world [m], found when asked for;
             panda.contact_torque (7,) [N m] of all contacts on the arm's joints;
             contact_results, body_poses (abstract);
             with a fault that delays torques, panda.delay (1,) [s], as time stamps
             tell it; with faults, panda.monitor (6,), `worst` of a SafetyMonitor that
             watches what is commanded and the true joints.

    The subsystems `plant` and `scene_graph` can be asked for by name. The plant steps
    at multiples of its time step; a torque written at such an instant acts from the
    next one on, a torque written just before it acts at once.

    Args: scene, in place of the file, for a world that was changed in memory; errors,
        of which the wrench's and the delays (whole periods) are added here, the others
        are the scene's; wrong, what is to go wrong.
    """
    builder = DiagramBuilder()
    scene = read_scene(config.scene) if scene is None else scene
    faults = [] if wrong is None else list(wrong.faults)
    if wrong is not None:
        scene = with_box(scene, faults, wrong.box_at, MODELS)
    loaded = load_scene(scene, builder)
    plant, scene_graph = loaded.plant, loaded.scene_graph
    arm = plant.GetModelInstanceByName(ARM)
    tool_body = _only_body(plant, config.tool, "tool")
    tool = tool_body.model_instance()
    n = plant.num_velocities(arm)
    # What the motors give within the effort limits that Drake keeps, too. Drake's own
    # port for it would solve the contact once more.
    limit = np.array([each.effort_limit() for each in actuators_of(plant, ARM)])
    # Where commands come in, and what they are behind the faults on their way.
    on_the_way = faulty_command(builder, limit, faults)
    if on_the_way:
        builder.Connect(
            on_the_way[-1].GetOutputPort("value"), loaded.command_input_port(ARM)
        )
        builder.ExportInput(
            on_the_way[0].GetInputPort("value"), f"{ARM}.torque_commanded"
        )
    else:
        builder.ExportInput(loaded.command_input_port(ARM), f"{ARM}.torque_commanded")
    for system in on_the_way:
        if isinstance(system, LateSignal):
            builder.ExportOutput(system.GetOutputPort("age"), DELAY)
            break
    if wrong is not None:
        add_forces(builder, loaded, ARM, config.tool, wrong.ball, wrong.center, faults)
    noise = config.noise
    if len(config.contact) < 2:
        raise ValueError(
            f"contact is {config.contact}, expected two models, or one and several"
        )
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}, expected an integer of 0 or more")
    seeds = np.random.SeedSequence(config.seed).generate_state(4)
    period = plant.time_step() or 0.001

    def noisy(name: str, port: OutputPort, std, seed) -> OutputPort:
        if not np.any(std):
            return port
        sensor = NoisySensor(std, int(seed), period, held=config.sampled)
        builder.AddNamedSystem(name, sensor)
        builder.Connect(port, sensor.GetInputPort("value"))
        return sensor.GetOutputPort("measured")

    joints = [f"{ARM}.{each.joint().name()}" for each in actuators_of(plant, ARM)]

    def measured(port: OutputPort, *what: str) -> OutputPort:
        """The port as the scene's effects have it measured."""
        channels = [f"{joint}.{each}" for each in what for joint in joints]
        return loaded.measured_output_port(builder, port, channels)

    def late(name: str, port: OutputPort) -> OutputPort:
        periods = 0 if errors is None else round(errors.delay / period)
        if periods == 0:
            return port
        line = builder.AddNamedSystem(name, LateSensor(port.size(), periods, period))
        builder.Connect(port, line.get_input_port())
        return line.get_output_port()

    q_and_v = measured(plant.get_state_output_port(arm), "position", "velocity")
    encoders = noisy(
        f"{ARM}_encoders",
        late(f"{ARM}_encoders_delay", q_and_v),
        np.repeat([noise.position, noise.velocity], n),
        seeds[0],
    )
    encoders = faulty_sensor(builder, encoders, "position_velocity", faults)
    split = builder.AddNamedSystem(f"{ARM}_encoders_split", Demultiplexer([n, n]))
    builder.Connect(encoders, split.get_input_port())
    for i, name in enumerate(("position", "velocity")):
        builder.ExportOutput(split.get_output_port(i), f"{ARM}.{name}_measured")

    motors = builder.AddNamedSystem(f"{ARM}_motors", Saturation(-limit, limit))
    effort = loaded.effort_output_port(ARM)
    if effort is None and on_the_way:
        effort = on_the_way[-1].GetOutputPort("value")
    if effort is None:
        builder.ConnectInput(f"{ARM}.torque_commanded", motors.get_input_port())
    else:
        builder.Connect(effort, motors.get_input_port())
    torque = noisy(
        f"{ARM}_torque",
        measured(motors.get_output_port(), "effort_measured"),
        np.full(n, noise.torque),
        seeds[1],
    )
    torque = faulty_sensor(builder, torque, "torque", faults)
    builder.ExportOutput(torque, f"{ARM}.torque_measured")

    mount = next(
        joint
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if joint.child_body().model_instance() == tool
    )
    wrench = builder.AddNamedSystem(
        f"{ARM}_tool_wrench",
        ToolWrench(plant, mount.name(), TIP_FRAME, period if config.sampled else None),
    )
    builder.Connect(
        plant.get_reaction_forces_output_port(), wrench.GetInputPort("reaction_forces")
    )
    builder.Connect(plant.get_state_output_port(), wrench.GetInputPort("state"))
    std_wrench = np.repeat([noise.force, noise.moment], 3)
    felt = wrench.GetOutputPort("wrench")
    if errors is not None and (np.any(errors.force_bias) or np.any(errors.force_drift)):
        no_moment = np.zeros(3)
        drifting = builder.AddNamedSystem(
            f"{ARM}_wrench_bias",
            DriftingSensor(
                np.r_[errors.force_bias, no_moment],
                np.r_[errors.force_drift, no_moment],
            ),
        )
        builder.Connect(felt, drifting.get_input_port())
        felt = drifting.get_output_port()
    felt = late(f"{ARM}_wrench_delay", felt)
    felt = noisy(f"{ARM}_external_wrench", felt, std_wrench, seeds[2])
    felt = faulty_sensor(builder, felt, "wrench", faults)
    builder.ExportOutput(felt, f"{ARM}.external_wrench")

    probe = builder.AddNamedSystem(
        "contact_probe",
        ContactProbe(*(_only_body(plant, m, "contact") for m in config.contact)),
    )
    builder.Connect(
        plant.get_contact_results_output_port(), probe.GetInputPort("contact_results")
    )
    builder.ExportOutput(probe.GetOutputPort("contact_force"), "contact_force")
    chain = serial_chain_of(make_control_plant(loaded.scene, config.tool), TIP_FRAME)
    touch = builder.AddNamedSystem("tool_contact", ToolContactForce(chain))
    builder.Connect(plant.get_state_output_port(arm), touch.GetInputPort("state"))
    builder.Connect(
        plant.get_generalized_contact_forces_output_port(arm),
        touch.GetInputPort("contact_torque"),
    )
    builder.ExportOutput(
        touch.GetOutputPort("contact_force"), f"{config.tool}.contact_force"
    )
    tip = builder.AddNamedSystem("true_tip", TrueTip(chain))
    builder.Connect(plant.get_state_output_port(arm), tip.get_input_port())
    builder.ExportOutput(tip.get_output_port(), f"{config.tool}.tip_position")
    builder.ExportOutput(plant.get_state_output_port(), "state")
    builder.ExportOutput(
        plant.get_generalized_contact_forces_output_port(arm), f"{ARM}.contact_torque"
    )
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")

    if config.camera is not None:
        image = add_camera(builder, scene_graph, plant, config.camera, int(seeds[3]))
        if wrong is not None:
            image = faulty_image(
                builder, image, config.camera, loaded, wrong.ball, config.seed, faults
            )
        builder.ExportOutput(image, "overhead.rgb_image")
    if faults:
        _add_monitor(builder, plant, limit)
    if meshcat is not None:
        button = builder.AddNamedSystem("push_button", PushButton(meshcat))
        push = builder.AddNamedSystem("push", BodyForce(plant, tool_body))
        builder.Connect(plant.get_state_output_port(), push.GetInputPort("state"))
        builder.Connect(button.GetOutputPort("force"), push.GetInputPort("force"))
        add_generalized_forces(
            builder, plant, [push.GetOutputPort("generalized_force")]
        )
        parameters = MeshcatVisualizerParams(publish_period=config.meshcat_period_sec)
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, parameters)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


def _add_monitor(builder: DiagramBuilder, plant: MultibodyPlant, effort_max) -> None:
    """A SafetyMonitor of the arm, just after its controller has spoken."""
    joints = [each.joint() for each in actuators_of(plant, ARM)]
    limits = ArmLimits(
        torque=effort_max,
        torque_rate=TORQUE_RATE_MAX,
        speed=np.array([joint.velocity_upper_limits()[0] for joint in joints]),
        lower=np.array([joint.position_lower_limits()[0] for joint in joints]),
        upper=np.array([joint.position_upper_limits()[0] for joint in joints]),
    )
    monitor = builder.AddNamedSystem("monitor", SafetyMonitor(limits, 0.001, 9e-4))
    n = len(joints)
    truth = builder.AddNamedSystem("monitor_split", Demultiplexer([n, n]))
    builder.Connect(
        plant.get_state_output_port(plant.GetModelInstanceByName(ARM)),
        truth.get_input_port(),
    )
    for i, name in enumerate("qv"):
        builder.Connect(truth.get_output_port(i), monitor.GetInputPort(name))
    builder.ConnectInput(f"{ARM}.torque_commanded", monitor.GetInputPort("tau"))
    builder.ExportOutput(monitor.GetOutputPort("worst"), MONITOR)


def _only_body(plant: MultibodyPlant, model: str, where: str) -> RigidBody:
    if not plant.HasModelInstanceNamed(model):
        raise ValueError(f"{where} names {model!r}, which is not in the scene")
    bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    if len(bodies) != 1:
        raise ValueError(f"{where} names {model!r}, expected a model of one body")
    return plant.get_body(bodies[0])


def make_control_plant(
    scene: Scene | str | Path = BALL_ROLLING, tool: str = TOOL
) -> MultibodyPlant:
    """The arm with its tool alone, as the controllers believe it: for their own use.

    Its default positions are the scene's initial ones. Effects on arm, tool and world
    count, but for those that add coordinates which nobody measures, and damping: the
    impedance law leaves all friction to its feedback.
    """
    if not isinstance(scene, Scene):
        scene = read_scene(scene)
    own = (ARM, tool)
    directives = [
        d
        for d in scene.directives
        if (d.add_model is not None and d.add_model.name in own)
        or (d.add_weld is not None and d.add_weld.child.split("::")[0] in own)
    ]
    initial = InitialSection(
        positions={
            name: value
            for name, value in scene.initial.positions.items()
            if name.split(".")[0] in own
        }
    )
    effects = [
        effect
        for effect in scene.effects
        if all(
            at.split(".")[0].split("~")[0] in (*own, "world") and "~" not in at
            for at in effect.at
        )
        and not (effect.kind in KINDS and KINDS[effect.kind].hidden_state)
        and effect.kind != "joint_viscous_damping"
    ]
    part = replace(
        scene,
        directives=directives,
        initial=initial,
        effects=effects,
        friction_zones=[],
    )
    return load_scene(part, DiagramBuilder()).plant


def from_wrist(arm: MultibodyPlant) -> np.ndarray:
    """(2,) from the wrist to the tip, seen from above [m]: the tool's orientation is
    held, so that it stays what it is in the arm's initial posture."""
    context = arm.CreateDefaultContext()
    wrist = arm.GetJointByName(f"{ARM}_joint7").child_body().EvalPoseInWorld(context)
    tip = arm.GetFrameByName(TIP_FRAME).CalcPoseInWorld(context)
    return (tip.translation() - wrist.translation())[:2]
