"""A Panda presses a block on a table and along a wall of unknown friction (CC 4.4,
figure 1b): an impedance controller of constant stiffness follows a motion.

    motion --x_desired, gains, push--> impedance_controller --tau--> station
    station --wrench--> wrench_tare --wrench without the sensor's bias--> all
    station --q, v--> mode_detector, forward_model_bank, one-step predictors

The block comes down on the table, slides to the wall, and along wall and table. When it
reaches a surface, the stiffness along the normal fades out and a constant force fades
in, at times given by the motion: nothing adapts. Predictors are compared with the
measured force; the prediction of one can be fed forward along the motion.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    LogVectorOutput,
    Multiplexer,
    TrajectorySource,
    ZeroOrderHold,
)
from pydrake.trajectories import PiecewisePolynomial

from makebreak.diagrams.fault_kinds import read_faults
from makebreak.diagrams.realism import draw_errors
from makebreak.diagrams.recorder import record_station
from makebreak.diagrams.station import (
    ARM,
    DELAY,
    TIP_FRAME,
    StationConfig,
    StationFaults,
    make_control_plant,
    make_station,
)
from makebreak.diagrams.tabletop import TABLETOP_WALLS, TOOL, set_friction
from makebreak.diagrams.wiring import add_legend, timed
from makebreak.models.scene import read_scene
from makebreak.systems.arm.force_feedforward import (
    ForceFeedforward,
    ForceFeedforwardConfig,
)
from makebreak.systems.arm.impedance_controller import (
    ImpedanceConfig,
    ImpedanceController,
    serial_chain_of,
)
from makebreak.systems.arm.numerics.serial_chain import tip_kinematics
from makebreak.systems.arm.tip_state import TipState
from makebreak.systems.arm.wrench_tare import WrenchTare, WrenchTareConfig
from makebreak.systems.baselines.long_term_predictor import OneStepPredictor
from makebreak.systems.baselines.numerics.long_term_predictor import (
    LongTermPredictor,
    TrainingBudget,
)
from makebreak.systems.changing_contact.forward_model import (
    ForwardModelBank,
    ForwardModelConfig,
)
from makebreak.systems.changing_contact.mode_detector import (
    ModeDetector,
    ModeDetectorConfig,
)
from makebreak.systems.views.legend import LegendConfig

WALL, N_ARM = "blue_wall", 7
OURS, LAST = "ours", "last"  # What may be fed forward, beside the predictors.
CAMERA = ([0.45, -0.95, 0.45], [0.55, 0.05, 0.05])  # Meshcat's position, target [m].
# Text and color of each part, as in the model files.
LEGEND = (
    ("wall along which the tool slides", Rgba(0.2, 0.36, 0.7)),
    ("block at the end of the tool", Rgba(0.72, 0.53, 0.32)),
)
# Times [s] between the parts of the motion: down, rest on the table, to the wall, rest,
# along it, rest.
TIMES = np.cumsum([0.0, 2.4, 0.4, 2.6, 0.5, 3.0, 0.3])
DURATION = float(TIMES[-1])
TABLE_Z, WALL_X = 0.015, 0.62  # Of the tip when the block touches them [m].
BEYOND = 0.005  # The motion aims so far behind a surface, to reach it for sure [m].
ALONG = 0.26  # Length of the motion along the wall [m].
FADE = 0.25  # Time from stiffness to force along a normal, before the rest [s].
NORMAL_DAMPING = 250.0  # Along a normal under force, against bouncing [N s/m].
DAMPING_RATIO, MASS = 0.9, 5.0  # Effective mass at the tip, for the damping [kg].
TURNING_STIFFNESS, TURNING_DAMPING = 50.0, 15.0  # [N m/rad], [N m s/rad]
TICK, ESTIMATE = 0.001, 0.005  # Periods [s].
# After the plant's step, as in changing_contact.
OFFSET, IMPEDANCE_OFFSET = 1e-4, 7e-4


@dataclass
class WallTraining:
    """Training data of the baseline, and how much of it is used."""

    trials: int = 14  # Number of trials in each of the three training sets.
    tested: int = 1  # Number of tested trials, each with a seed of its own.
    # Whether the joints are predicted too (figures 11 and 12), which takes most of the
    # time.
    joints: bool = True
    # Number of samples (5 ms each) from one step of a long-term prediction to the next.
    every: int = 10
    long_term: TrainingBudget = field(
        default_factory=lambda: TrainingBudget(
            points_per_mode=120, segment_min=2, predict_change=False
        )
    )
    # For one step of 5 ms; trained once on the next force, once on its change.
    one_step: TrainingBudget = field(
        default_factory=lambda: TrainingBudget(segment_min=20, predict_change=False)
    )


@dataclass
class WallFrictionConfig:
    """Settings of `makebreak run wall_friction`."""

    friction: float = 0.9  # Coefficient of friction of the wall in the tested trials.
    # Stiffness of the impedance controller along each axis [N/m].
    stiffness: float = 300.0
    # Stiffness of the stiff controller of figure 12 along each axis [N/m].
    stiffness_high: float = 2000.0
    normal_force: float = 8.0  # Normal force on the table and on the wall [N].
    # Standard deviation of the random displacement of the path's corners [m].
    start_spread: float = 0.003
    training: WallTraining = field(default_factory=WallTraining)
    # Errors of the station that the model lacks, the same in all trials: none, lab or
    # poor.
    realism: str = "none"
    station_seed: int | None = None  # Seed of these errors; null: that of the run.
    seed: int = 0  # Seed of the paths and the sensors' noise.
    # Faults to inject, each NAME[:from=S,for=S] as of --fault.
    faults: list[str] = field(default_factory=list)


def motion(config: WallFrictionConfig, p_start) -> dict[str, np.ndarray]:
    """The planned inputs of the impedance controller and the predictors, every 5 ms.

    Args: p_start (3,): initial position of the tip [m].
    Returns: time (n,) [s]; x_desired (n, 19); stiffness (n, 6); damping (n, 6); push
        (n, 6): fed forward [N], [N m]; direction (n, 3): of the motion, zero at rest;
        force_directions (n, 6): two unit vectors along which the block presses, zero
        while it does not.
    """
    time = np.arange(0.0, DURATION + 0.0025, 0.005)
    rng = np.random.default_rng([config.seed, 1])
    start = np.array(p_start, dtype=float)
    above = config.start_spread * rng.normal(size=2)
    x0, y0 = start[:2] + above
    y1 = y0 + ALONG + config.start_spread * rng.normal()
    corners = np.array([
        start,
        [x0, y0, TABLE_Z - BEYOND],
        [x0, y0, TABLE_Z - BEYOND],
        [WALL_X + BEYOND, y0, TABLE_Z - BEYOND],
        [WALL_X + BEYOND, y0, TABLE_Z - BEYOND],
        [WALL_X + BEYOND, y1, TABLE_Z - BEYOND],
        [WALL_X + BEYOND, y1, TABLE_Z - BEYOND],
    ])  # fmt: skip
    p, v, a = (np.zeros((len(time), 3)) for _ in range(3))
    for i in range(len(TIMES) - 1):
        span = TIMES[i + 1] - TIMES[i]
        now = (time >= TIMES[i]) & (time <= TIMES[i + 1] + 1e-9)
        s = ((time[now] - TIMES[i]) / span)[:, None]
        line = corners[i + 1] - corners[i]
        # Minimum jerk, from rest to rest.
        p[now] = corners[i] + line * (10 * s**3 - 15 * s**4 + 6 * s**5)
        v[now] = line * (30 * s**2 - 60 * s**3 + 30 * s**4) / span
        a[now] = line * (60 * s - 180 * s**2 + 120 * s**3) / span**2
    speed = np.linalg.norm(v, axis=1, keepdims=True)
    direction = np.where(speed > 1e-9, v / np.maximum(speed, 1e-9), 0.0)

    x_desired = np.zeros((len(time), 19))
    x_desired[:, :3], x_desired[:, 3], x_desired[:, 7:10] = p, 1.0, v
    x_desired[:, 13:16] = a
    linear = 2.0 * DAMPING_RATIO * np.sqrt(MASS * config.stiffness)
    stiffness, damping = (
        np.tile(np.repeat(gains, 3), (len(time), 1))
        for gains in ([config.stiffness, TURNING_STIFFNESS], [linear, TURNING_DAMPING])
    )
    push, normals = np.zeros((len(time), 6)), np.zeros((len(time), 6))
    for row, (axis, sign, end) in enumerate(((2, -1.0, TIMES[1]), (0, 1.0, TIMES[3]))):
        faded = np.clip((time - end) / FADE + 1.0, 0.0, 1.0)  # 1: force control.
        stiffness[:, axis] *= 1.0 - faded
        damping[:, axis] += faded * max(NORMAL_DAMPING - linear, 0.0)
        push[:, axis] = sign * config.normal_force * faded
        normals[faded > 0.0, 3 * row + axis] = sign
        # A direction under force control has no velocity or acceleration to follow.
        x_desired[:, 7 + axis] *= 1.0 - faded
        x_desired[:, 13 + axis] *= 1.0 - faded
    return {
        "time": time,
        "x_desired": x_desired,
        "stiffness": stiffness,
        "damping": damping,
        "push": push,
        "direction": direction,
        "force_directions": normals,
    }


def make_wall_friction(
    config: WallFrictionConfig,
    meshcat: Meshcat | None = None,
    predictors: Mapping[str, LongTermPredictor] | None = None,
    knowledge: tuple | None = None,
    feedforward: str = "",
) -> Diagram:
    """The diagram of one trial, with a log that `telemetry` reads.

    Args:
        config: its `training` is not used here.
        meshcat: shows the trial; None: it is not shown.
        predictors: baselines that predict one step ahead, by name; their system in the
            diagram is predictor_<name>.
        knowledge: of mode detector and forward models, from an earlier trial
            (`learned`); None: none.
        feedforward: the prediction that is fed forward: OURS, of the forward models;
            LAST, the force measured last; or a name of `predictors`. Empty: none.
    Raises: ValueError for a setting out of range.
    """
    for name in ("stiffness", "stiffness_high", "normal_force"):
        if not 0.0 < getattr(config, name) < np.inf:
            raise ValueError(f"{name} is {getattr(config, name)}, expected > 0")
    if not config.start_spread >= 0.0:
        raise ValueError(f"start_spread is {config.start_spread}, expected >= 0")
    builder = DiagramBuilder()
    scene = read_scene(TABLETOP_WALLS)
    control_plant = make_control_plant(scene, TOOL)
    set_friction(scene, {WALL: config.friction})
    station = _add_station(builder, config, scene, meshcat)
    plan = _add_plan(builder, motion(config, start_of(control_plant)))
    impedance, tip = _add_controller(builder, station, plan, control_plant)
    wrench = _add_tare(builder, station, tip, plan)
    _add_predictors(builder, station, wrench, tip, plan, predictors or {}, knowledge)
    builder.Connect(
        _add_feedforward(builder, wrench, plan, feedforward),
        impedance.GetInputPort("wrench_feedforward"),
    )
    builder.ExportOutput(wrench, "wrench")
    record_station(builder, station, impedance.GetOutputPort("tau"), TOOL)
    if meshcat is not None:
        meshcat.SetCameraPose(*CAMERA)
        add_legend(builder, meshcat, LegendConfig(LEGEND, (), *CAMERA))
    return builder.Build()


def _add_station(builder, config: WallFrictionConfig, scene, meshcat) -> Diagram:
    faults = None
    if config.faults:
        faults = StationFaults(read_faults(config.faults, ()))
    seed = config.seed if config.station_seed is None else config.station_seed
    return builder.AddNamedSystem(
        "station",
        make_station(
            StationConfig(
                scene=TABLETOP_WALLS,
                tool=TOOL,
                contact=[TOOL, WALL],
                seed=config.seed,
            ),
            meshcat,
            scene,
            draw_errors(config.realism, seed),
            wrong=faults,
        ),
    )


def _add_plan(builder, plan: dict[str, np.ndarray]) -> dict[str, OutputPort]:
    """A TrajectorySource for each entry of a motion; gives their ports."""
    ports = {}
    for name, values in plan.items():
        if name != "time":
            held = name in ("direction", "force_directions")
            kind = PiecewisePolynomial
            line = (kind.ZeroOrderHold if held else kind.FirstOrderHold)(
                plan["time"], values.T
            )
            source = builder.AddNamedSystem(name, TrajectorySource(line))
            ports[name] = source.get_output_port()
    return ports


def _add_controller(
    builder, station, plan: dict[str, OutputPort], control_plant
) -> tuple[ImpedanceController, TipState]:
    """The impedance controller, which follows the plan, and the tip's state."""
    impedance = builder.AddNamedSystem(
        "impedance_controller",
        ImpedanceController(
            ImpedanceConfig(
                control_orientation=True, period_sec=TICK, offset_sec=IMPEDANCE_OFFSET
            ),
            control_plant,
            TIP_FRAME,
        ),
    )
    chain = serial_chain_of(control_plant, TIP_FRAME)
    tip = builder.AddNamedSystem("tip_state", TipState(chain))
    for system in (impedance, tip):
        for name, port in (("q", "position_measured"), ("v", "velocity_measured")):
            builder.Connect(
                station.GetOutputPort(f"{ARM}.{port}"), system.GetInputPort(name)
            )
    for name in ("x_desired", "stiffness", "damping"):
        builder.Connect(plan[name], impedance.GetInputPort(name))
    if station.HasOutputPort(DELAY):
        builder.Connect(station.GetOutputPort(DELAY), impedance.GetInputPort("delay"))
    builder.Connect(
        impedance.GetOutputPort("tau"), station.GetInputPort(f"{ARM}.torque_commanded")
    )
    return impedance, tip


def _add_tare(builder, station, tip: TipState, plan) -> OutputPort:
    """The measured wrench without the bias that the sensor has in the air."""
    tare = builder.AddNamedSystem(
        "wrench_tare", WrenchTare(timed(WrenchTareConfig(), TICK, OFFSET))
    )
    for port, source in (
        ("wrench", station.GetOutputPort(f"{ARM}.external_wrench")),
        ("ee_velocity", tip.GetOutputPort("ee_velocity")),
        ("force_directions", plan["force_directions"]),
    ):
        builder.Connect(source, tare.GetInputPort(port))
    return tare.GetOutputPort("wrench")


def _add_predictors(
    builder,
    station,
    wrench: OutputPort,
    tip: TipState,
    plan: dict[str, OutputPort],
    predictors: Mapping[str, LongTermPredictor],
    knowledge: tuple | None,
) -> None:
    """Mode detector, forward models and one-step predictors, and a log of them all."""
    known_modes, known_models = knowledge or (None, None)
    modes = builder.AddNamedSystem(
        "mode_detector",
        ModeDetector(ModeDetectorConfig(), known_modes, ESTIMATE, OFFSET),
    )
    forward = builder.AddNamedSystem(
        "forward_model_bank",
        ForwardModelBank(
            # Without torque: that of a sliding face depends on where it is pressed, not
            # on friction. Without correction: the mixture alone is compared.
            ForwardModelConfig(with_torque=False, tau_nov=0.01, correction=0.0),
            known_models,
            ESTIMATE,
            OFFSET,
        ),
    )
    signals = [
        station.GetOutputPort(f"{ARM}.position_measured"),
        station.GetOutputPort(f"{ARM}.velocity_measured"),
        wrench,
        modes.GetOutputPort("mode"),
        forward.GetOutputPort("wrench_predicted"),
    ]
    watching = [modes, forward]
    for name, predictor in predictors.items():
        system = builder.AddNamedSystem(
            f"predictor_{name}",
            OneStepPredictor(predictor, period_sec=ESTIMATE, offset_sec=OFFSET),
        )
        watching.append(system)
        signals += [
            system.GetOutputPort("wrench_predicted"),
            system.GetOutputPort("std"),
        ]
    inputs = {
        "wrench": wrench,
        "ee_pose": tip.GetOutputPort("ee_pose"),
        "ee_velocity": tip.GetOutputPort("ee_velocity"),
        "direction": plan["direction"],
        "force_directions": plan["force_directions"],
        "mode": modes.GetOutputPort("mode"),
    }
    for system in watching:
        for name, port in inputs.items():
            if system.HasInputPort(name):
                builder.Connect(port, system.GetInputPort(name))
    _add_log(builder, signals)


def _add_feedforward(
    builder, wrench: OutputPort, plan: dict[str, OutputPort], source: str
) -> OutputPort:
    """The wrench that is fed forward: the plan's push, and the prediction of `source`,
    as of make_wall_friction."""
    if not source:
        return plan["push"]
    fed = builder.AddNamedSystem(
        "force_feedforward",
        ForceFeedforward(
            ForceFeedforwardConfig(period_sec=TICK, offset_sec=2.0 * OFFSET)
        ),
    )
    if source == LAST:
        predicted = wrench
    else:
        name = "forward_model_bank" if source == OURS else f"predictor_{source}"
        predicted = builder.GetSubsystemByName(name).GetOutputPort("wrench_predicted")
    builder.Connect(predicted, fed.GetInputPort("wrench_predicted"))
    builder.Connect(plan["direction"], fed.GetInputPort("direction"))
    builder.Connect(plan["push"], fed.GetInputPort("wrench"))
    return fed.GetOutputPort("wrench_feedforward")


def _add_log(builder, signals: Sequence[OutputPort]) -> None:
    """The log that `telemetry` reads.

    It is sampled just before the predictors run, after the same step of the plant, so
    that a row has the values that they are about to read beside their predictions of
    them. (At their own instant the log would get the next predictions, because abstract
    state is updated first.)
    """
    sizes = [port.size() for port in signals]
    bundle = builder.AddNamedSystem("telemetry", Multiplexer(sizes))
    for i, port in enumerate(signals):
        builder.Connect(port, bundle.get_input_port(i))
    sampled = builder.AddNamedSystem(
        "telemetry_hold", ZeroOrderHold(ESTIMATE, sum(sizes), 0.5 * OFFSET)
    )
    builder.Connect(bundle.get_output_port(), sampled.get_input_port())
    log = LogVectorOutput(sampled.get_output_port(), builder, ESTIMATE)
    log.set_name("telemetry_log")


def plan_of(config: WallFrictionConfig) -> dict[str, np.ndarray]:
    """The motion from the tip's initial position."""
    return motion(config, start_of(make_control_plant(TABLETOP_WALLS, TOOL)))


def policy(config: WallFrictionConfig, every: int):
    """The controller's law as the baseline needs it, at steps of `every` samples.

    Returns: u(t, x) of the step t and states x (k, 14) = [q, v] that gives (k, 6): the
        force of the impedance controller [N] and the plan's acceleration [m/s2].
    """
    control_plant = make_control_plant(TABLETOP_WALLS, TOOL)
    chain = serial_chain_of(control_plant, TIP_FRAME)
    rows = {
        name: values[::every]
        for name, values in motion(config, start_of(control_plant)).items()
    }
    x_desired, push = rows["x_desired"], rows["push"]

    def u(t, x):
        out = np.empty((len(x), 6))
        for i, (q, v) in enumerate(zip(x[:, :N_ARM], x[:, N_ARM:], strict=True)):
            p_WE, _, J = tip_kinematics(chain, np.ascontiguousarray(q))
            out[i, :3] = rows["stiffness"][t, :3] * (x_desired[t, :3] - p_WE)
            out[i, :3] += rows["damping"][t, :3] * (x_desired[t, 7:10] - J[:3] @ v)
        out[:, :3] += push[t, :3]
        out[:, 3:] = x_desired[t, 13:16]
        return out

    return u


def tip_states(data: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) [m] and velocities (n, 3) [m/s] of the tip, from joint data."""
    control_plant = make_control_plant(TABLETOP_WALLS, TOOL)
    chain = serial_chain_of(control_plant, TIP_FRAME)
    position, velocity = np.empty((2, len(data["q"]), 3))
    for i, (q, v) in enumerate(zip(data["q"], data["v"], strict=True)):
        position[i], _, J = tip_kinematics(chain, q)
        velocity[i] = J[:3] @ v
    return position, velocity


def start_of(control_plant) -> np.ndarray:
    """Initial position of the tip (3,) [m]."""
    chain = serial_chain_of(control_plant, TIP_FRAME)
    positions = control_plant.GetPositions(control_plant.CreateDefaultContext())
    return tip_kinematics(chain, positions)[0]


def telemetry(
    diagram: Diagram, context: Context, names: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """The log of a simulation that ended in `context`.

    Args: names: of the one-step predictors.
    Returns: time (n,) [s], every 5 ms; q, v (n, 7), wrench (n, 6): measured then; mode
        (n, 1), wrench_predicted (n, 6), <name>.wrench_predicted (n, 6), <name>.std
        (n, 3): predicted for then.
    """
    log = diagram.GetSubsystemByName("telemetry_log").FindLog(context)
    sizes = {"q": N_ARM, "v": N_ARM, "wrench": 6, "mode": 1, "wrench_predicted": 6}
    for name in names:
        sizes |= {f"{name}.wrench_predicted": 6, f"{name}.std": 3}
    # The first row is from before the first sample; the others are logged one period
    # after they were sampled.
    data, start = log.data()[:, 1:], 0
    out = {"time": np.array(log.sample_times()[1:]) - ESTIMATE}
    for name, size in sizes.items():
        out[name] = np.ascontiguousarray(data[start : start + size].T)
        start += size
    return out


def learned(diagram: Diagram, context: Context) -> tuple:
    """What mode detector and forward models have learned at the end of a trial."""
    return tuple(
        system.knowledge(system.GetMyContextFromRoot(context))
        for system in map(
            diagram.GetSubsystemByName, ("mode_detector", "forward_model_bank")
        )
    )
