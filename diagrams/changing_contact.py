"""A Panda follows a motion that makes, keeps and breaks contact (CC section 3).

    station --q, v--> tip_state --ee_pose, ee_velocity--> all
    station --wrench--> wrench_tare --wrench without the sensor's bias--> all
    velocity_shaper --> wrench_tare --force directions, at right angles--> all
    contact_detector --contact--> contact_anticipator, velocity_shaper
    mode_detector --mode--> forward_model_bank --prediction--> variable_impedance
    contact_anticipator --contacts--> velocity_shaper; --hints--> mode_detector
    mode_detector --touch_mode--> contact_anticipator
    velocity_shaper --x_desired, force directions and targets--> impedance_controller
    (x_desired by way of surface_alignment, if the tool is to be laid flat)
    variable_impedance --stiffness, feed-forward--> impedance_controller
    impedance_controller --tau--> station

Experiments choose the world, the motion and what is known beforehand. A trial is one
simulation; `learned` reads what was learned in it, for the next trial.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, Multiplexer

from makebreak.diagrams.arm_reach import ArmReach
from makebreak.diagrams.fault_kinds import read_faults
from makebreak.diagrams.given_pattern import segment_paths
from makebreak.diagrams.realism import StationErrors
from makebreak.diagrams.recorder import record_station
from makebreak.diagrams.station import (
    ARM,
    DELAY,
    TIP_FRAME,
    SensorNoise,
    StationConfig,
    StationFaults,
    control_laws,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.tabletop import TOOL, objects
from makebreak.diagrams.wiring import (
    add_legend,
    refuse_changed,
    refuse_unused,
    timed,
)
from makebreak.models.scene import Scene
from makebreak.systems.arm.impedance_controller import (
    HybridConfig,
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.surface_alignment import (
    SurfaceAlignment,
    SurfaceAlignmentConfig,
)
from makebreak.systems.arm.tip_state import TipState
from makebreak.systems.arm.variable_impedance import (
    VariableImpedance,
    VariableImpedanceConfig,
)
from makebreak.systems.arm.wrench_tare import WrenchTare, WrenchTareConfig
from makebreak.systems.changing_contact.contact_anticipator import (
    ContactAnticipatorConfig,
    KalmanContactAnticipator,
    KnownReflexConfig,
)
from makebreak.systems.changing_contact.contact_detector import (
    ContactDetector,
    ContactDetectorConfig,
)
from makebreak.systems.changing_contact.forward_model import (
    ForwardModelBank,
    ForwardModelConfig,
    HandoverConfig,
)
from makebreak.systems.changing_contact.impact_reflex import (
    ImpactReflex,
    ImpactReflexConfig,
)
from makebreak.systems.changing_contact.mode_detector import (
    ModeDetector,
    ModeDetectorConfig,
)
from makebreak.systems.changing_contact.numerics.contact_task import ContactBelief
from makebreak.systems.changing_contact.numerics.forward_model import ModelBank
from makebreak.systems.changing_contact.numerics.mode_table import ModeTable
from makebreak.systems.changing_contact.numerics.motion_pattern import MotionPattern
from makebreak.systems.changing_contact.velocity_shaper import (
    VelocityShaper,
    VelocityShaperConfig,
)
from makebreak.systems.views.contact_view import ContactView, ContactViewConfig
from makebreak.systems.views.legend import LegendConfig

# Periods [s].
TICK, ESTIMATE, ANTICIPATE = 0.001, 0.005, 0.01
# All systems that estimate or plan run at one instant, 0.1 ms after the plant's step,
# and read the others' values of the last millisecond; the impedance controller runs
# after them. Further instants would cost more computing time than the systems do.
OFFSET, IMPEDANCE_OFFSET = 1e-4, 7e-4
WRENCH = f"{ARM}.external_wrench"  # The station's port of the measured wrench.


@dataclass
class ChangingContactConfig:
    """Settings of the systems that handle changing contacts, sensors to torques."""

    tare: WrenchTareConfig = field(default_factory=WrenchTareConfig)
    detector: ContactDetectorConfig = field(default_factory=ContactDetectorConfig)
    modes: ModeDetectorConfig = field(default_factory=ModeDetectorConfig)
    forward_model: ForwardModelConfig = field(default_factory=ForwardModelConfig)
    # Whether the forward models read the mean of the last five wrenches, which has less
    # noise, and not the last one. It is 2 ms late: where surfaces are struck, stiffness
    # follows later, and impacts scatter more.
    mean_wrench: bool = False
    anticipator: ContactAnticipatorConfig = field(
        default_factory=ContactAnticipatorConfig
    )
    shaper: VelocityShaperConfig = field(default_factory=VelocityShaperConfig)
    variable_impedance: VariableImpedanceConfig = field(
        default_factory=VariableImpedanceConfig
    )
    impedance: ImpedanceConfig = field(
        default_factory=lambda: ImpedanceConfig(control_orientation=True)
    )
    hybrid: HybridConfig = field(
        default_factory=lambda: HybridConfig(damping_ratio=0.9)
    )
    reflex: ImpactReflexConfig = field(default_factory=ImpactReflexConfig)
    align: SurfaceAlignmentConfig = field(default_factory=SurfaceAlignmentConfig)
    # Faults to inject, each NAME[:from=S,for=S] as of --fault.
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What is known before a trial, or was learned in it."""

    contacts: ContactBelief = ContactBelief()
    modes: ModeTable | None = None  # ModeDetector.knowledge
    models: ModelBank | None = None  # ForwardModelBank.knowledge


def friction_from_rest() -> ForwardModelConfig:
    """Forward models that predict the friction of a motion that begins from rest."""
    return ForwardModelConfig(handover=HandoverConfig(from_rest=True))


def refuse_unused_control(config, plain) -> None:
    """Raises: ValueError for settings of config.control that another of its settings
    leaves out. Args: plain: the experiment's defaults, with the same `control`."""
    c = config.control
    unused = {}
    if c.anticipator.speed.regression:
        unused["anticipator.speed.beta"] = "anticipator.speed.regression=true"
    else:
        why = "anticipator.speed.regression=false"
        unused["anticipator.speed.force_drift"] = why
    first = "anticipator.speed.first"
    if c.anticipator.speed.first.stiffness_most > 0.0:
        unused[f"{first}.speed"] = f"{first}.stiffness_most > 0"
    else:
        unused[f"{first}.force"] = f"{first}.stiffness_most=0"
    if not c.shaper.region.anticipate:
        for name in ("sigmas", "margin", "settle_sec"):
            unused[f"shaper.region.{name}"] = "shaper.region.anticipate=false"
    if not c.variable_impedance.transition:
        for name in ("blend_sec", "stiffness.impact"):
            unused[f"variable_impedance.{name}"] = "variable_impedance.transition=false"
    if not c.forward_model.learns:
        unused["forward_model.tau_nov"] = "forward_model.learns=false"
    for name, why in unused.items():
        refuse_unused(config, plain, f"control.{name}", f"not used with {why}")


def tip_mass(arm: MultibodyPlant):
    """The arm's effective mass at its tip as a function of position and direction.

    Returns: a function of p_WE (3,) [m] and a unit vector d (3,) that gives
        1 / (d' J M^-1 J' d) [kg], in the configuration nearest to the arm's default
        positions in which the tip is at p_WE with its default orientation.
    """
    reach = ArmReach(arm)

    def mass(p, d) -> float:
        q = reach.positions(p, reach.R_default, reach.q_default)
        J = reach.jacobian(q)[3:]
        return float(1.0 / (d @ J @ np.linalg.solve(reach.mass_matrix(q), J.T @ d)))

    return mass


# Signals of `telemetry`: name -> (system, port, size); no more than what is scored, as
# some are computed for it alone each millisecond.
SIGNALS = {
    "ee_pose": ("tip_state", "ee_pose", 7),
    "ee_velocity": ("tip_state", "ee_velocity", 6),
    "wrench": ("station", f"{ARM}.external_wrench", 6),
    "tip_true": ("station", f"{TOOL}.tip_position", 3),
    "x_desired": ("velocity_shaper", "x_desired", 19),
    "direction": ("velocity_shaper", "direction", 3),
    "force_directions": ("velocity_shaper", "force_directions", 6),
    "phase": ("velocity_shaper", "phase", 6),
    "contact": ("contact_detector", "contact", 14),
    "transition": ("mode_detector", "transition", 6),
    "mode": ("mode_detector", "mode", 1),
    "confidence": ("mode_detector", "confidence", 2),
    "collecting": ("mode_detector", "collecting", 1),
    "stiffness": ("variable_impedance", "stiffness", 6),
    "wrench_feedforward": ("variable_impedance", "wrench_feedforward", 6),
    "tau": ("impedance_controller", "tau", 7),
}


def make_changing_contact(
    config: ChangingContactConfig,
    world: Scene,
    model: Scene,
    pattern: MotionPattern,
    knowledge: Knowledge | None = None,
    tool: str = TOOL,
    noise: SensorNoise | None = None,
    seed: int = 0,
    meshcat: Meshcat | None = None,
    view: ContactViewConfig | None = None,
    errors: StationErrors | None = None,
) -> Diagram:
    """The station and all systems; each can be asked for by name.

    Args:
        config: of the systems; this function sets their periods and offsets.
        world: the simulated scene; only sensor readings leave it.
        model: the scene of the arm's control plant.
        pattern: the motion to follow.
        knowledge: from earlier trials; None: none.
        tool: name of the tool's model instance.
        noise: of the sensors; None: the station's default.
        seed: of the sensors' noise.
        meshcat: shows the run; None: it is not shown.
        view: settings of Meshcat's view; None: the defaults.
        errors: of the station, which the model lacks; None: none.
    Raises: ValueError for periods or offsets in config that are not the defaults.
    """
    builder = DiagramBuilder()
    station = builder.AddNamedSystem(
        "station",
        make_station(
            StationConfig(
                noise=noise or SensorNoise(),
                tool=tool,
                contact=[tool, *objects(world)],
                seed=seed,
                sampled=True,
            ),
            meshcat,
            world,
            errors,
            _station_faults(config, pattern),
        ),
    )
    arm = make_control_plant(model, tool)
    laws = control_laws(model, arm, tool)
    known = knowledge or Knowledge()
    systems = _add_systems(builder, config, arm, laws, pattern, known)
    _connect_systems(builder, station, systems, config)
    tau = systems.impedance.GetOutputPort("tau")
    record_station(builder, station, tau, tool)
    # Only for scoring and plots.
    _add_telemetry(builder, SIGNALS)
    if meshcat is not None:
        _add_view(builder, station, systems, pattern, meshcat, view)
    diagram = builder.Build()
    diagram.set_name("changing_contact")
    return diagram


def _station_faults(config, pattern: MotionPattern) -> StationFaults | None:
    """The faults of --fault; a stray box is in the middle of the first segment."""
    if not config.faults:
        return None
    first = pattern.segments[0].positions[:, :3]
    faults = read_faults(config.faults, ("scene",))
    return StationFaults(faults, tuple(first.mean(axis=0).tolist()))


@dataclass(frozen=True, eq=False)
class _Systems:
    """The systems beside the station."""

    tip: TipState
    tare: WrenchTare
    detector: ContactDetector
    modes: ModeDetector
    forward: ForwardModelBank
    anticipator: KalmanContactAnticipator
    shaper: VelocityShaper
    variable: VariableImpedance
    impedance: ImpedanceController


def _add_systems(
    builder: DiagramBuilder,
    config,
    arm: MultibodyPlant,
    laws,
    pattern,
    known: Knowledge,
) -> _Systems:
    # The approach speed of the anticipator depends on how hard the reflex brakes.
    reflex = config.anticipator.speed.reflex
    refuse_changed("anticipator.speed.reflex", reflex, list(vars(reflex)))
    # What variable_impedance and the damping ratio give instead.
    unused = ["stiffness", *(["damping"] if config.hybrid.damping_ratio > 0.0 else [])]
    refuse_changed("impedance", config.impedance, unused)
    if not config.reflex.gain > 0.0:
        for name in ("reflex.force_max", "reflex.fade_sec"):
            refuse_unused(config, type(config)(), name, "not used with reflex.gain=0")
    if config.align.angle_max_deg == 0.0:
        for name in ("align.damping", "align.speed_max"):
            refuse_unused(
                config, type(config)(), name, "not used with align.angle_max_deg=0"
            )
    speed = replace(
        config.anticipator.speed,
        reflex=KnownReflexConfig(
            config.reflex.gain, config.reflex.force_least, config.reflex.force_known
        ),
    )
    anticipator = replace(config.anticipator, speed=speed)
    add = builder.AddNamedSystem
    return _Systems(
        tip=add("tip_state", TipState(serial_chain_of(arm, TIP_FRAME))),
        tare=add("wrench_tare", WrenchTare(timed(config.tare, TICK, OFFSET))),
        detector=add(
            "contact_detector",
            ContactDetector(timed(config.detector, TICK, OFFSET), tared=True),
        ),
        modes=add(
            "mode_detector", ModeDetector(config.modes, known.modes, ESTIMATE, OFFSET)
        ),
        forward=add(
            "forward_model_bank",
            ForwardModelBank(config.forward_model, known.models, ESTIMATE, OFFSET),
        ),
        anticipator=add(
            "contact_anticipator",
            KalmanContactAnticipator(
                timed(anticipator, ANTICIPATE, OFFSET), known.contacts, tip_mass(arm)
            ),
        ),
        shaper=add(
            "velocity_shaper",
            VelocityShaper(timed(config.shaper, TICK, OFFSET), pattern),
        ),
        variable=add(
            "variable_impedance",
            VariableImpedance(timed(config.variable_impedance, TICK, OFFSET)),
        ),
        impedance=add(
            "impedance_controller",
            ImpedanceController(
                timed(config.impedance, TICK, IMPEDANCE_OFFSET),
                arm,
                TIP_FRAME,
                hybrid=config.hybrid,
                laws=laws,
            ),
        ),
    )


def _connect(builder, source, output, *targets, port=None) -> None:
    """Connects an output to an input of the same name, or `port`, of each target that
    has it."""
    for target in targets:
        if target.HasInputPort(port or output):
            builder.Connect(
                source.GetOutputPort(output), target.GetInputPort(port or output)
            )


def _connect_systems(builder: DiagramBuilder, station, s: _Systems, config) -> None:
    """Connects the systems with each other and the station; adds the impact reflex."""
    connect = partial(_connect, builder)
    for q, measured in (("q", "position"), ("v", "velocity")):
        connect(station, f"{ARM}.{measured}_measured", s.tip, s.impedance, port=q)
    if station.HasOutputPort(DELAY):
        connect(station, DELAY, s.impedance, port="delay")
    watching = (s.detector, s.modes, s.forward, s.variable)
    connect(station, WRENCH, s.tare, port="wrench")
    connect(s.tare, "wrench", s.detector, s.modes, s.variable)
    read = "wrench_mean" if config.mean_wrench else "wrench"
    connect(s.tare, read, s.forward, port="wrench")
    connect(s.tare, "wrench", s.impedance, port="wrench_measured")
    connect(s.tip, "ee_pose", s.detector, s.anticipator, s.shaper)
    connect(s.tip, "ee_velocity", s.tare, *watching, s.anticipator)
    connect(s.shaper, "direction", *watching)
    connect(s.shaper, "force_directions", s.tare)
    connect(s.tare, "force_directions", *watching, s.impedance)
    connect(s.shaper, "force_targets", s.detector, s.variable, s.impedance)
    connect(s.shaper, "phase", s.detector, s.anticipator, s.variable)
    connect(s.shaper, "x_desired", s.forward)
    planned = s.shaper
    if config.align.angle_max_deg != 0.0:
        planned = builder.AddNamedSystem(
            "surface_alignment", SurfaceAlignment(timed(config.align, TICK, OFFSET))
        )
        connect(s.shaper, "x_desired", planned)
        connect(s.tare, "wrench", planned)
        connect(s.shaper, "force_directions", planned)
    connect(planned, "x_desired", s.impedance)
    connect(s.detector, "contact", s.anticipator, s.shaper, s.variable)
    connect(s.modes, "transition", s.anticipator, s.forward)
    connect(s.modes, "mode", s.forward)
    connect(s.modes, "touch_mode", s.anticipator)
    connect(s.modes, "collecting", s.variable)
    connect(s.modes, "undecided", s.forward)
    connect(s.forward, "wrench_predicted", s.variable)
    connect(s.forward, "prediction_error", s.variable)
    connect(s.forward, "handing_over", s.variable)
    connect(s.anticipator, "contacts", s.shaper)
    connect(s.anticipator, "mode_hint", s.modes)
    connect(s.anticipator, "touch_hint", s.modes)
    for port in ("stiffness", "damping", "damping_stiffness", "wrench_feedforward"):
        source = s.variable
        if port == "wrench_feedforward" and config.reflex.gain > 0.0:
            source = builder.AddNamedSystem(
                "impact_reflex", ImpactReflex(timed(config.reflex, TICK, OFFSET))
            )
            connect(s.variable, port, source)
            connect(s.tare, "wrench", source)
            connect(s.tip, "ee_velocity", source)
            connect(s.shaper, "direction", source)
            connect(s.shaper, "phase", source)
            connect(s.anticipator, "impact_known", source)
        if source.HasOutputPort(port):
            connect(source, port, s.impedance)
    connect(s.impedance, "tau", station, port=f"{ARM}.torque_commanded")


def _add_view(builder: DiagramBuilder, station, s: _Systems, pattern, meshcat, view):
    """Adds ContactView and the legend in Meshcat."""
    connect = partial(_connect, builder)
    shown = builder.AddNamedSystem(
        "contact_view",
        ContactView(view or ContactViewConfig(), meshcat, plan=segment_paths(pattern)),
    )
    connect(s.anticipator, "contacts", shown)
    connect(s.tare, "wrench", shown)
    connect(s.tip, "ee_pose", shown)
    connect(s.modes, "mode", shown)
    connect(s.shaper, "phase", shown)
    connect(s.shaper, "x_desired", shown)
    legend = LegendConfig(shown.legend, (), shown.camera, shown.LOOK_AT)
    add_legend(builder, meshcat, legend)


def _add_telemetry(builder: DiagramBuilder, signals) -> None:
    """One log of all signals side by side, at 1 kHz."""
    bundle = builder.AddNamedSystem(
        "telemetry", Multiplexer([size for _, _, size in signals.values()])
    )
    for i, (system, port, _) in enumerate(signals.values()):
        source = builder.GetSubsystemByName(system).GetOutputPort(port)
        builder.Connect(source, bundle.get_input_port(i))
    log = LogVectorOutput(bundle.get_output_port(), builder, TICK)
    log.set_name("telemetry_log")


def telemetry(diagram: Diagram, context: Context) -> dict[str, np.ndarray]:
    """The logs of a simulation that ended in `context`: time (n,) [s] and each of
    SIGNALS (n, k), a row per millisecond, sampled before the events of that instant."""
    log = diagram.GetSubsystemByName("telemetry_log").FindLog(context)
    out = {"time": np.array(log.sample_times())}
    data, start = log.data(), 0
    for name, (_, _, size) in SIGNALS.items():
        out[name] = np.array(data[start : start + size].T)
        start += size
    return out


def learned(diagram: Diagram, context: Context) -> Knowledge:
    """What the systems have learned at the end of a trial, for the next one."""

    def of(name):
        system = diagram.GetSubsystemByName(name)
        return system.knowledge(system.GetMyContextFromRoot(context))

    return Knowledge(
        of("contact_anticipator"), of("mode_detector"), of("forward_model_bank")
    )
