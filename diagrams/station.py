"""The station: a Panda with a tool, its sensors, and a camera above it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Saturation

from makebreak.diagrams.camera import CameraConfig, add_camera
from makebreak.diagrams.fault_kinds import Injected
from makebreak.diagrams.faults import (
    add_forces,
    faulty_command,
    faulty_image,
    faulty_sensor,
    with_box,
)
from makebreak.diagrams.realism import StationErrors, with_errors
from makebreak.diagrams.scene_facts import actuators_of
from makebreak.diagrams.wiring import add_generalized_forces, split
from makebreak.models.effects import KINDS
from makebreak.models.effects.kind import Effect
from makebreak.models.model_files import MODELS
from makebreak.models.scene import (
    InitialSection,
    LoadedScene,
    Scene,
    joint_laws,
    load_scene,
    read_scene,
)
from makebreak.models.scene_schema import as_kind
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.arm.numerics.serial_chain import SerialChain
from makebreak.systems.arm.tool_wrench import ToolWrench
from makebreak.systems.faults.fault_forces import BodyForce
from makebreak.systems.faults.fault_signals import LateSignal
from makebreak.systems.faults.safety_monitor import ArmLimits, SafetyMonitor
from makebreak.systems.numerics.joint_laws import JointLaws
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
MONITOR, DELAY = f"{ARM}.monitor", f"{ARM}.delay"  # Outputs with faults only.


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
    """A station: its scene, its sensors' noise, its camera."""

    scene: str = BALL_ROLLING  # Scene file of the world.
    noise: SensorNoise = field(default_factory=SensorNoise)
    camera: CameraConfig | None = None
    tool: str = TOOL  # Name of the model that is mounted on the arm.
    # Models whose contact is an output: the first one with each of the others.
    contact: list[str] = field(default_factory=lambda: [TOOL, "ball"])
    seed: int = 0
    meshcat_period_sec: float = 1.0 / 30.0
    # True: sensors are sampled once per step of the plant. False: they are evaluated,
    # with noise of that instant, whenever a system reads them.
    sampled: bool = False


@dataclass(frozen=True)
class StationFaults:
    """The faults of a station (diagrams/faults.py), and what they need to know."""

    faults: Sequence[Injected]
    box_at: Sequence[float] = (0.0, 0.0, 0.0)  # (3,) of a stray box [m].
    ball: str = "ball"  # Name of the model that the camera tracks.
    center: Sequence[float] = (0.5, 0.0)  # (2,) of the circle that it is moved on [m].


def make_station(
    config: StationConfig,
    meshcat: Meshcat | None = None,
    scene: Scene | None = None,
    errors: StationErrors | None = None,
    wrong: StationFaults | None = None,
) -> Diagram:
    """The plant, its sensors and actuators.

    Inputs:  panda.torque_commanded (7,) [N m]: of the motors, clipped to the effort
             limits; overhead.region (3,), optional, of a camera that renders with VTK
             (RegionCamera).
    Outputs of sensors, with noise:
             panda.position_measured (7,) [rad], panda.velocity_measured (7,) [rad/s],
             panda.torque_measured (7,) [N m]: of the motors, after the limits;
             panda.external_wrench (6,): on the tool at its tip, in world axes, force
             first, without the tool's weight [N], [N m];
             overhead.rgb_image (ImageRgba8U), if there is a camera.
    Outputs of the truth, for scoring and tests only:
             state (n_x,); contact_force (4,) = [normal, x, y, z] [N]: of the first body
             of config.contact on the second (4 more for each further one);
             {tool}.contact_force (3,): of all contacts on the tool, in the world [N],
             and {tool}.tip_position (3,) in the world [m], computed when evaluated;
             panda.contact_torque (7,) [N m]: of all contacts on the arm's joints;
             contact_results, body_poses (abstract);
             with a fault that delays torques, panda.delay (1,) [s], as time stamps
             would give it; with any fault, panda.monitor (6,): `worst` of a
             SafetyMonitor of the command and the true joints.

    The subsystems `plant` and `scene_graph` can be asked for by name. The plant steps
    at multiples of its time step; a torque written at such an instant acts from the
    next step on, a torque written just before it acts at once.

    Args: scene: replaces config.scene, for a world that was changed in memory; errors:
        of the station, delays in whole periods; None: none; wrong: the faults to
        inject.
    Raises: ValueError for a setting out of range, or a body that is not in the scene.
    """
    if len(config.contact) < 2:
        raise ValueError(
            f"contact is {config.contact}, expected two models, or one and several"
        )
    if config.seed < 0:
        raise ValueError(f"seed is {config.seed}, expected an integer of 0 or more")
    builder = DiagramBuilder()
    scene = read_scene(config.scene) if scene is None else scene
    errors = errors or StationErrors()
    scene = with_errors(scene, errors, ARM, config.tool)
    faults = [] if wrong is None else list(wrong.faults)
    if wrong is not None:
        scene = with_box(scene, faults, wrong.box_at, MODELS)
    loaded = load_scene(scene, builder)
    plant = loaded.plant
    tool = _only_body(plant, config.tool, "tool")
    # The motors' effort limits. Drake keeps them too, but its port of the efforts after
    # the limits would solve the contacts once more.
    limit = np.array([each.effort_limit() for each in actuators_of(plant, ARM)])
    command = _add_command_path(builder, loaded, limit, faults)
    if wrong is not None:
        add_forces(builder, loaded, ARM, config.tool, wrong.ball, wrong.center, faults)
    sensing = _Sensing(builder, config, loaded, errors, faults)
    _add_encoders(sensing)
    _add_torque_sensor(sensing, limit, command)
    _add_wrench_sensor(sensing, tool)
    _export_truth(builder, config, loaded, sensing.chain)
    if config.camera is not None:
        image = add_camera(
            builder, loaded.scene_graph, plant, config.camera, sensing.seeds[3]
        )
        if wrong is not None:
            image = faulty_image(
                builder, image, config.camera, loaded, wrong.ball, config.seed, faults
            )
        else:  # Faults may delay images.
            camera = builder.GetSubsystemByName("overhead_camera")
            if camera.HasInputPort("region"):
                builder.ExportInput(camera.GetInputPort("region"), "overhead.region")
        builder.ExportOutput(image, "overhead.rgb_image")
    if faults:
        _add_monitor(builder, plant, limit)
    if meshcat is not None:
        _add_meshcat(builder, config, loaded, tool, meshcat)
    diagram = builder.Build()
    diagram.set_name("station")
    return diagram


def _add_command_path(
    builder: DiagramBuilder, loaded: LoadedScene, limit: np.ndarray, faults
) -> OutputPort | None:
    """Exports panda.torque_commanded, leading to the actuators through its faults.

    Returns: the command behind its faults; None if it has none.
    """
    chain = faulty_command(builder, limit, faults)
    if not chain:
        builder.ExportInput(loaded.command_input_port(ARM), f"{ARM}.torque_commanded")
        return None
    command = chain[-1].GetOutputPort("value")
    builder.Connect(command, loaded.command_input_port(ARM))
    builder.ExportInput(chain[0].GetInputPort("value"), f"{ARM}.torque_commanded")
    for system in chain:
        if isinstance(system, LateSignal):
            builder.ExportOutput(system.GetOutputPort("age"), DELAY)
            break
    return command


class _Sensing:
    """What turns ports of the plant into measured ones: effects of the scene, delay,
    noise and faults, in this order."""

    def __init__(
        self,
        builder: DiagramBuilder,
        config: StationConfig,
        loaded: LoadedScene,
        errors: StationErrors,
        faults,
    ):
        self.builder, self.config, self.loaded = builder, config, loaded
        self.plant, self.errors, self.faults = loaded.plant, errors, faults
        self.arm = self.plant.GetModelInstanceByName(ARM)
        self.n = self.plant.num_velocities(self.arm)
        self.period = self.plant.time_step() or 0.001
        own = make_control_plant(loaded.scene, config.tool)
        self.chain = serial_chain_of(own, TIP_FRAME)
        # Seeds of encoders, torque, wrench and camera.
        sequence = np.random.SeedSequence(config.seed)
        self.seeds = [int(seed) for seed in sequence.generate_state(4)]

    def measured(self, port: OutputPort, *what: str) -> OutputPort:
        """The port of the joints' channels `what`, with the scene's effects on them."""
        joints = [
            f"{ARM}.{each.joint().name()}" for each in actuators_of(self.plant, ARM)
        ]
        channels = [f"{joint}.{each}" for each in what for joint in joints]
        return self.loaded.measured_output_port(self.builder, port, channels)

    def late(self, name: str, port: OutputPort) -> OutputPort:
        periods = round(self.errors.delay / self.period)
        if periods == 0:
            return port
        sensor = LateSensor(port.size(), periods, self.period)
        self.builder.AddNamedSystem(name, sensor)
        self.builder.Connect(port, sensor.get_input_port())
        return sensor.get_output_port()

    def noisy(self, name: str, port: OutputPort, std, seed: int) -> OutputPort:
        if not np.any(std):
            return port
        sensor = NoisySensor(std, seed, self.period, held=self.config.sampled)
        self.builder.AddNamedSystem(name, sensor)
        self.builder.Connect(port, sensor.GetInputPort("value"))
        return sensor.GetOutputPort("measured")

    def faulty(self, port: OutputPort, sensor: str) -> OutputPort:
        return faulty_sensor(self.builder, port, sensor, self.faults)


def _add_encoders(sensing: _Sensing) -> None:
    builder, noise, n = sensing.builder, sensing.config.noise, sensing.n
    state = sensing.plant.get_state_output_port(sensing.arm)
    encoders = sensing.measured(state, "position", "velocity")
    encoders = sensing.late(f"{ARM}_encoders_delay", encoders)
    std = np.repeat([noise.position, noise.velocity], n)
    encoders = sensing.noisy(f"{ARM}_encoders", encoders, std, sensing.seeds[0])
    encoders = sensing.faulty(encoders, "position_velocity")
    parts = split(builder, encoders, f"{ARM}_encoders", dict(position=n, velocity=n))
    for name, port in parts.items():
        builder.ExportOutput(port, f"{ARM}.{name}_measured")


def _add_torque_sensor(
    sensing: _Sensing, limit: np.ndarray, command: OutputPort | None
) -> None:
    """Args: limit (n,) [N m]; command: behind its faults, None: it has none."""
    builder = sensing.builder
    motors = builder.AddNamedSystem(f"{ARM}_motors", Saturation(-limit, limit))
    effort = sensing.loaded.effort_output_port(ARM) or command
    if effort is None:
        builder.ConnectInput(f"{ARM}.torque_commanded", motors.get_input_port())
    else:
        builder.Connect(effort, motors.get_input_port())
    torque = sensing.measured(motors.get_output_port(), "effort_measured")
    std = np.full(sensing.n, sensing.config.noise.torque)
    torque = sensing.noisy(f"{ARM}_torque", torque, std, sensing.seeds[1])
    torque = sensing.faulty(torque, "torque")
    builder.ExportOutput(torque, f"{ARM}.torque_measured")


def _add_wrench_sensor(sensing: _Sensing, tool: RigidBody) -> None:
    builder, plant, errors = sensing.builder, sensing.plant, sensing.errors
    config = sensing.config
    mount = next(
        joint
        for joint in (plant.get_joint(i) for i in plant.GetJointIndices())
        if joint.child_body().model_instance() == tool.model_instance()
    )
    period = sensing.period if config.sampled else None
    sensor = builder.AddNamedSystem(
        f"{ARM}_tool_wrench",
        ToolWrench(plant, mount.name(), TIP_FRAME, sensing.chain, period),
    )
    builder.Connect(
        plant.get_reaction_forces_output_port(), sensor.GetInputPort("reaction_forces")
    )
    builder.Connect(
        plant.get_state_output_port(sensing.arm), sensor.GetInputPort("state")
    )
    wrench = sensor.GetOutputPort("wrench")
    if np.any(errors.force_bias) or np.any(errors.force_drift):
        no_moment = np.zeros(3)
        drifting = builder.AddNamedSystem(
            f"{ARM}_wrench_bias",
            DriftingSensor(
                np.r_[errors.force_bias, no_moment],
                np.r_[errors.force_drift, no_moment],
            ),
        )
        builder.Connect(wrench, drifting.get_input_port())
        wrench = drifting.get_output_port()
    wrench = sensing.late(f"{ARM}_wrench_delay", wrench)
    std = np.repeat([config.noise.force, config.noise.moment], 3)
    wrench = sensing.noisy(f"{ARM}_external_wrench", wrench, std, sensing.seeds[2])
    wrench = sensing.faulty(wrench, "wrench")
    builder.ExportOutput(wrench, f"{ARM}.external_wrench")


def _export_truth(
    builder: DiagramBuilder,
    config: StationConfig,
    loaded: LoadedScene,
    chain: SerialChain,
) -> None:
    """The outputs for scoring and tests only."""
    plant = loaded.plant
    arm = plant.GetModelInstanceByName(ARM)
    probe = builder.AddNamedSystem(
        "contact_probe",
        ContactProbe(*(_only_body(plant, m, "contact") for m in config.contact)),
    )
    builder.Connect(
        plant.get_contact_results_output_port(), probe.GetInputPort("contact_results")
    )
    builder.ExportOutput(probe.GetOutputPort("contact_force"), "contact_force")
    tool_contact = builder.AddNamedSystem("tool_contact", ToolContactForce(chain))
    builder.Connect(
        plant.get_state_output_port(arm), tool_contact.GetInputPort("state")
    )
    contact_torque = plant.get_generalized_contact_forces_output_port(arm)
    builder.Connect(contact_torque, tool_contact.GetInputPort("contact_torque"))
    builder.ExportOutput(
        tool_contact.GetOutputPort("contact_force"), f"{config.tool}.contact_force"
    )
    tip = builder.AddNamedSystem("true_tip", TrueTip(chain))
    builder.Connect(plant.get_state_output_port(arm), tip.get_input_port())
    builder.ExportOutput(tip.get_output_port(), f"{config.tool}.tip_position")
    builder.ExportOutput(plant.get_state_output_port(), "state")
    builder.ExportOutput(contact_torque, f"{ARM}.contact_torque")
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")


def _add_meshcat(
    builder: DiagramBuilder,
    config: StationConfig,
    loaded: LoadedScene,
    tool: RigidBody,
    meshcat: Meshcat,
) -> None:
    """Draws the scene, with a button that pushes the tool."""
    plant = loaded.plant
    button = builder.AddNamedSystem("push_button", PushButton(meshcat))
    push = builder.AddNamedSystem("push", BodyForce(plant, tool))
    builder.Connect(plant.get_state_output_port(), push.GetInputPort("state"))
    builder.Connect(button.GetOutputPort("force"), push.GetInputPort("force"))
    add_generalized_forces(builder, plant, [push.GetOutputPort("generalized_force")])
    parameters = MeshcatVisualizerParams(publish_period=config.meshcat_period_sec)
    MeshcatVisualizer.AddToBuilder(builder, loaded.scene_graph, meshcat, parameters)


def _add_monitor(builder: DiagramBuilder, plant: MultibodyPlant, effort_max) -> None:
    """A SafetyMonitor of the arm, updated just after the controller's command."""
    joints = [each.joint() for each in actuators_of(plant, ARM)]
    limits = ArmLimits(
        torque=effort_max,
        torque_rate=TORQUE_RATE_MAX,
        speed=np.array([joint.velocity_upper_limits()[0] for joint in joints]),
        lower=np.array([joint.position_lower_limits()[0] for joint in joints]),
        upper=np.array([joint.position_upper_limits()[0] for joint in joints]),
    )
    monitor = builder.AddNamedSystem("monitor", SafetyMonitor(limits, 0.001, 9e-4))
    state = plant.get_state_output_port(plant.GetModelInstanceByName(ARM))
    n = len(joints)
    for name, port in split(builder, state, "monitor", dict(q=n, v=n)).items():
        builder.Connect(port, monitor.GetInputPort(name))
    builder.ConnectInput(f"{ARM}.torque_commanded", monitor.GetInputPort("tau"))
    builder.ExportOutput(monitor.GetOutputPort("worst"), MONITOR)


def _only_body(plant: MultibodyPlant, model: str, where: str) -> RigidBody:
    """The body of a model of one body. Args: where: the setting, for the error."""
    if not plant.HasModelInstanceNamed(model):
        raise ValueError(f"{where} names {model!r}, which is not in the scene")
    bodies = plant.GetBodyIndices(plant.GetModelInstanceByName(model))
    if len(bodies) != 1:
        raise ValueError(f"{where} names {model!r}, expected a model of one body")
    return plant.get_body(bodies[0])


def make_control_plant(
    scene: Scene | str | Path = BALL_ROLLING, tool: str = TOOL
) -> MultibodyPlant:
    """The controllers' own model of the arm with its tool: the scene without the rest.

    Its default positions are the scene's initial ones. It has the scene's effects on
    arm, tool and world, except effects with hidden states, which are not measured; laws
    of the joints, such as dry friction, are not in the plant, but in control_laws.
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
    part = replace(
        scene,
        directives=directives,
        initial=initial,
        effects=_own_effects(scene, tool),
        friction_zones=[],
    )
    return load_scene(part, DiagramBuilder()).plant


def _own_effects(scene: Scene, tool: str) -> list[Effect]:
    """Effects on arm, tool and world, except those with hidden states."""
    return [
        effect
        for effect in scene.effects
        if all(
            at.split(".")[0].split("~")[0] in (ARM, tool, "world") and "~" not in at
            for at in effect.at
        )
        and not (effect.kind in KINDS and KINDS[effect.kind].hidden_state)
    ]


def control_laws(
    scene: Scene | str | Path, plant: MultibodyPlant, tool: str = TOOL
) -> JointLaws:
    """The forces in the arm's joints that the scene has beside the damping of `plant`,
    its make_control_plant: what the impedance controller compensates too."""
    if not isinstance(scene, Scene):
        scene = read_scene(scene)
    return joint_laws([as_kind(e) for e in _own_effects(scene, tool)], plant)


def from_wrist(arm: MultibodyPlant) -> np.ndarray:
    """(2,) from the wrist to the tip, seen from above [m], in the arm's initial posture
    (the controllers hold the tool's orientation, so that it is constant)."""
    context = arm.CreateDefaultContext()
    wrist = arm.GetJointByName(f"{ARM}_joint7").child_body().EvalPoseInWorld(context)
    tip = arm.GetFrameByName(TIP_FRAME).CalcPoseInWorld(context)
    return (tip.translation() - wrist.translation())[:2]
