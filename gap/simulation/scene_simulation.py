"""Any scene as a diagram that runs, and windows of recordings simulated with it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import Demultiplexer, LogVectorOutput

from makebreak.models.effects import KINDS
from makebreak.models.effects.actuation_path import TIME_CONSTANT
from makebreak.models.effects.kind import Effect, full_name, one_dof_joints
from makebreak.models.effects.measured_channels import ChannelMap, channel_maps
from makebreak.models.effects.transmission import motor_joint
from makebreak.models.scene import (
    CHANNEL_STEPS,
    InitialSection,
    LoadedScene,
    Scene,
    actuators_of_model,
    load_scene,
    path_numbers,
    read_scene,
)
from makebreak.systems.numerics.filters import (
    Stage,
    filtered,
    subdivided,
    with_lag,
)

FILTERED_SEC = 0.0026  # A signal's samples before a filter are no further apart.
COMMANDS = ("effort_command", "position_command", "velocity_command")
POSE = "qw qx qy qz x y z".split()
TWIST = "wx wy wz vx vy vz".split()


def make_scene_diagram(
    scene: Scene | str | Path,
    command_delays: bool = True,
    log: bool = False,
    before_finalize: Callable[[MultibodyPlant, SceneGraph], None] | None = None,
) -> tuple[Diagram, LoadedScene]:
    """The scene's plant, effects, actuation and sensors, for each model <m> that has
    actuators or joints.

    Inputs:  <m>.effort_command (n_u,) [N m]; or where the scene's drives have a loop of
             their own, <m>.position_command, <m>.velocity_command (n_u,), as they take
             them. What is not connected is zero.
    Outputs: <m>.position_measured, <m>.velocity_measured (joints with one degree of
             freedom, in the order of LoadedScene.plant's), without noise; <m>.effort,
             the motors' (n_u,), where something lies between command and joint;
             state (n_x,), body_poses, contact_results: the truth.

    Args: command_delays: False if the caller delays the commands itself;
        log: with a log of the state each step, for a discrete plant;
        before_finalize: as of load_scene.
    """
    builder = DiagramBuilder()
    loaded = load_scene(scene, builder, command_delays, before_finalize)
    plant = loaded.plant
    builder.ExportOutput(plant.get_state_output_port(), "state")
    builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
    builder.ExportOutput(plant.get_contact_results_output_port(), "contact_results")
    for i in range(plant.num_model_instances()):
        instance = ModelInstanceIndex(i)
        model = plant.GetModelInstanceName(instance)
        if model.startswith("motor_of_"):
            continue
        path = loaded.paths.get(model)
        if actuators_of_model(plant, model):
            if path is None or path.command is not None:
                builder.ExportInput(
                    loaded.command_input_port(model), f"{model}.effort_command"
                )
            else:
                for name in ("position_command", "velocity_command"):
                    if (port := getattr(path, name)) is not None:
                        builder.ExportInput(port, f"{model}.{name}")
        if path is not None:
            builder.ExportOutput(path.effort, f"{model}.effort")
        joints = one_dof_joints(plant, model)
        n = plant.num_positions(instance)
        # Only where the joints are all that the model's state consists of.
        if not joints or n != len(joints) or n != plant.num_velocities(instance):
            continue
        names = [full_name(plant, joint) for joint in sorted(
            joints, key=lambda joint: joint.position_start()
        )]  # fmt: skip
        state = plant.get_state_output_port(instance)
        channels = [f"{name}.{w}" for w in ("position", "velocity") for name in names]
        port = loaded.measured_output_port(builder, state, channels)
        split = builder.AddSystem(Demultiplexer([n, n]))
        builder.Connect(port, split.get_input_port())
        for k, what in enumerate(("position", "velocity")):
            builder.ExportOutput(split.get_output_port(k), f"{model}.{what}_measured")
    if log and plant.time_step() > 0.0:
        sink = LogVectorOutput(
            plant.get_state_output_port(), builder, plant.time_step()
        )
        sink.set_name("state_log")
    diagram = builder.Build()
    diagram.set_name("scene")
    return diagram, loaded


@dataclass(frozen=True, eq=False)
class Commands:
    """A recording's commands: each holds from its row's time until the next row's.

    columns: `<model>.<joint>.effort_command`, ... A missing value (NaN) is the last one
    before it.
    """

    time: np.ndarray  # (m,) [s], increasing.
    columns: Mapping[str, np.ndarray]  # (m,) each.

    def __post_init__(self):
        time = np.asarray(self.time, dtype=float)
        if time.ndim != 1 or not (np.diff(time) > 0.0).all():
            raise ValueError("Commands.time must increase from row to row")
        filled = {}
        for name, column in self.columns.items():
            value = np.array(column, dtype=float)
            if value.shape != time.shape:
                raise ValueError(
                    f"Commands column {name} is {value.shape}, expected {time.shape}"
                )
            last = np.maximum.accumulate(
                np.where(np.isfinite(value), np.arange(len(value)), 0)
            )
            value = value[last]
            # Before the first value: that value; a column without any: no command.
            finite = value[np.isfinite(value)]
            value[~np.isfinite(value)] = finite[0] if finite.size else 0.0
            filled[name] = value
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "columns", filled)


NO_COMMANDS = Commands(np.zeros(0), {})


@dataclass
class SimulationConfig:
    """How a continuous plant is integrated (Runge-Kutta of third order)."""

    accuracy: float = 1e-6  # Relative error of a step [-].
    max_step_sec: float = 0.02
    # A run whose steps are shorter than this, on average since its start and from the
    # 2000th on, is given up: parameters that a search tries may make it endless.
    least_step_sec: float = 5e-6


class SceneSimulation:
    """Runs a scene over windows of a recording, again and again.

    The diagram is built once. Other parameters of the effects are set in its Context
    where Drake allows it; where it does not, the diagram is built anew (`builds`
    counts). Not a system: it has one Context, whose parameters it remembers.

    Args: scene, or its path; before_finalize: as of load_scene.
    Raises: ValueError as load_scene.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        config: SimulationConfig | None = None,
        before_finalize: Callable[[MultibodyPlant, SceneGraph], None] | None = None,
    ):
        self._before_finalize = before_finalize
        self._scene = scene if isinstance(scene, Scene) else read_scene(scene)
        self._config = config or SimulationConfig()
        self.builds = 0
        self.failure = ""  # Why the last run stopped short, if it did.
        self._current: tuple[Effect, ...] = ()
        self._build()

    @property
    def scene(self) -> Scene:
        """The scene with the effects as they are now."""
        return self._scene

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """The scene's effects from now on.

        Raises: ValueError as load_scene; then the effects are those of before.
        """
        before, self._scene = self._scene, replace(self._scene, effects=list(effects))
        ranked = sorted(
            effects, key=lambda e: KINDS[e.kind].rank if e.kind in KINDS else 0
        )
        try:
            if not self._loaded.set_effects(self._context, self._current, ranked):
                self._build()
        except ValueError:
            self._scene = before
            self._build()  # Some of it may have been set already.
            raise
        self._current = tuple(ranked)
        self._read_effects()

    def channels(self) -> list[str]:
        """The measured channels that can be simulated."""
        return list(self._channels)

    def channel_map(self, channel: str) -> ChannelMap:
        """How the scene's effects change a channel."""
        return channel_maps(self._current, CHANNEL_STEPS, [channel]).get(
            channel, ChannelMap()
        )

    def true_at(self, channel: str, time: float, stamps, measured) -> float:
        """The true value of a channel at a time, from measured samples (m,): what the
        scene's sensor effects add is taken off, with a line between samples."""
        found = self.channel_map(channel)
        return float(found.true_value(np.interp(found.stamp(time), stamps, measured)))

    def put_down(self, initial: InitialSection, body: str) -> InitialSection:
        """The state with a free body at such a height that it just touches what is
        fixed below it; a sphere rolls as it moves, about an upright axis it does not
        turn. For a body of which only x and y are measured, whose height and spin
        follow from its size.

        Args: body, `<model>.<body>`, with a pose in `initial`, near the ground.
        Raises: ValueError if it has no pose there, or nothing fixed is below it.
        """
        if body not in initial.poses:
            raise ValueError(f"put_down: no initial pose of {body!r}")
        self._set_state(initial, True)
        plant, own = self._plant, self._plant_context
        thing = self._bodies[body]
        scene_graph = self._loaded.scene_graph
        z = stand_on_ground(
            plant, own, scene_graph, scene_graph.GetMyContextFromRoot(self._context),
            thing,
        )  # fmt: skip
        mine = plant.GetCollisionGeometriesForBody(thing)
        pose = [*initial.poses[body][:6], z]
        twist = list(initial.body_velocities.get(body, [0.0] * 6))
        inspector = scene_graph.model_inspector()
        shapes = [inspector.GetShape(geometry) for geometry in mine]
        if len(shapes) == 1 and isinstance(shapes[0], Sphere):
            radius = shapes[0].radius()
            twist[:3] = [-twist[4] / radius, twist[3] / radius, 0.0]
        return replace(
            initial,
            poses=initial.poses | {body: pose},
            body_velocities=initial.body_velocities | {body: twist},
        )

    def run(
        self,
        initial: InitialSection,
        times: np.ndarray,
        channels: Sequence[str],
        commands: Commands = NO_COMMANDS,
        start_sec: float | None = None,
        initial_is_true: bool = False,
        twists: Mapping[str, tuple[float, float]] | None = None,
        filters: Mapping[str, Sequence[Stage]] | None = None,
        before: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> np.ndarray:
        """What the channels would measure, (n, n_channels) [SI].

        Args:
            initial: the state at start_sec, by name, as measured; what is not named is
                as in the scene, at rest. (A motor behind an elastic element is
                `motor_of_<model>_<joint>.<joint>`.) Of a delayed channel give the
                sample that shows the state of start_sec (true_at).
            times: (n,) [s], increasing: stamps of the measured samples.
            channels: of `channels()`.
            start_sec: the first of `times` if None.
            initial_is_true: whether `initial` has no offsets, biases and scales.
            twists: {joint: (twist, its rate)} at the start, of joints behind an
                elastic element or a gap; those not named start as at rest.
            filters: {channel: stages} between true and measured values, beside the
                scene's own sensor_lag.
            before: {channel: (times (k,), true values (k,))} up to start_sec, for
                filters to remember; without, a channel is taken to have gone on as it
                starts.
        Returns: NaN from where Drake could not go on (`failure` then says why), and
            where the time that a sample shows is before the window.
        Raises: ValueError for an unknown channel, joint, body or command.
        """
        times = np.asarray(times, dtype=float)
        start = float(times[0] if start_sec is None else start_sec)
        for channel in channels:
            if channel not in self._channels:
                raise ValueError(f"channel {channel!r} cannot be simulated")
        maps = channel_maps(self._current, CHANNEL_STEPS, channels)
        shown = {
            channel: (times - m.delay) / (1.0 + m.skew) for channel, m in maps.items()
        }
        stages = {}
        for channel in channels:
            own = tuple((filters or {}).get(channel, ()))
            for lag in maps.get(channel, ChannelMap()).lags:
                own = with_lag(own, lag)
            if own:
                stages[channel] = own
        between = np.zeros(0)
        if stages:
            edges = np.concatenate([[start], times[times > start]])
            between = subdivided(edges, FILTERED_SEC)
        needed = np.unique(np.concatenate([times, *shown.values(), between]))
        needed = needed[needed >= start - 1e-9]
        self._set_commands(commands)
        efforts = any(self._channels[channel][0] == "effort" for channel in channels)
        x, effort = self._simulate(
            initial, start, needed, initial_is_true, efforts, twists or {}
        )
        if not self.failure and not np.isfinite(x).all():
            self.failure = "the state grew beyond all numbers"
        x[~np.isfinite(x).all(axis=1)] = np.nan
        out = np.empty((len(times), len(channels)))
        poses: dict = {}
        for i, channel in enumerate(channels):
            at = shown.get(channel, times)
            value = self._true_channel(channel, x, effort, poses)
            if channel in stages:
                value = _behind(stages[channel], needed, value, (before or {}).get(
                    channel
                ))  # fmt: skip
            here = np.searchsorted(needed, at - 1e-9)
            column = np.full(len(times), np.nan)
            good = (here < len(needed)) & (at >= start - 1e-9)
            column[good] = value[here[good]]
            m = maps.get(channel)
            out[:, i] = column if m is None else m.scale * column + m.bias
        return out

    # ----- Building

    def _build(self) -> None:
        self.builds += 1
        self._diagram, self._loaded = make_scene_diagram(
            self._scene, command_delays=False, log=True,
            before_finalize=self._before_finalize,
        )  # fmt: skip
        self._plant = plant = self._loaded.plant
        self._current = self._loaded.effects
        self._simulator = Simulator(self._diagram)
        if plant.time_step() == 0.0:
            self._simulator.set_monitor(self._watch)
        self._context: Context = self._simulator.get_mutable_context()
        self._plant_context = plant.GetMyMutableContextFromRoot(self._context)
        discrete = self._context.get_discrete_state()
        self._discrete = [
            np.array(discrete.get_vector(i).value())
            for i in range(discrete.num_groups())
        ]
        self._default = np.array(plant.GetPositions(self._plant_context))
        self._scratch = plant.CreateDefaultContext()
        self._log = None
        if plant.time_step() > 0.0:
            sink = self._diagram.GetSubsystemByName("state_log")
            self._log = sink.FindLog(self._context)
        self._index_channels()
        self._make_ports()
        self._read_effects()

    def _index_channels(self) -> None:
        """Channel -> ("x", index in the state), ("effort", model, i, limit) or
        ("body", body, suffix)."""
        plant = self._plant
        n_q = plant.num_positions()
        self._channels: dict[str, tuple] = {}
        self._joints = {}
        for joint in one_dof_joints(plant):
            name = full_name(plant, joint)
            if not name.startswith("motor_of_"):
                self._joints[name] = joint
            motor = motor_joint(plant, joint)
            for what in ("position", "velocity"):
                channel = f"{name}.{what}"
                own = joint
                if motor is not None and not self._loaded.is_link_side(channel):
                    own = motor
                index = (
                    own.position_start()
                    if what == "position"
                    else n_q + own.velocity_start()
                )
                self._channels[channel] = ("x", index)
        self._bodies = {}
        for i in range(plant.num_model_instances()):
            instance = ModelInstanceIndex(i)
            model = plant.GetModelInstanceName(instance)
            for index in plant.GetBodyIndices(instance):
                body = plant.get_body(index)
                if plant.IsAnchored(body) or model.startswith(
                    ("motor_of_", "payload_on_")
                ):
                    continue
                name = f"{model}.{body.name()}"
                self._bodies[name] = body
                for suffix in (*POSE, *TWIST):
                    self._channels[f"{name}.{suffix}"] = ("body", body, suffix)
                if body.is_floating_base_body() and body.has_quaternion_dofs():
                    q = body.floating_positions_start()
                    v = n_q + body.floating_velocities_start_in_v()
                    for k, suffix in enumerate(POSE):
                        self._channels[f"{name}.{suffix}"] = ("x", q + k)
                    for k, suffix in enumerate(TWIST):
                        self._channels[f"{name}.{suffix}"] = ("x", v + k)
            for i, actuator in enumerate(actuators_of_model(plant, model)):
                if not model.startswith("motor_of_"):
                    name = full_name(plant, actuator.joint())
                    self._channels[f"{name}.effort_measured"] = (
                        "effort",
                        model,
                        i,
                        actuator.effort_limit(),
                    )

    def _make_ports(self) -> None:
        """Every command port with its channels, held at a value that can be changed."""
        self._ports = []
        for k in range(self._diagram.num_input_ports()):
            port = self._diagram.get_input_port(k)
            model, _, what = port.get_name().rpartition(".")
            if what not in COMMANDS:
                continue
            channels = [
                f"{full_name(self._plant, actuator.joint())}.{what}"
                for actuator in actuators_of_model(self._plant, model)
            ]
            fixed = port.FixValue(self._context, np.zeros(port.size()))
            self._ports.append((model, what, channels, fixed))
        self._commands: Commands | None = None

    def _read_effects(self) -> None:
        self._delays = {
            model: path_numbers(self._plant, model, self._current)[1]
            for model, _, _, _ in self._ports
        }
        self._commands = None

    # ----- Commands

    def _set_commands(self, commands: Commands) -> None:
        if commands is self._commands:
            return
        known = {channel for _, _, channels, _ in self._ports for channel in channels}
        for name in commands.columns:
            if name not in known:
                raise ValueError(
                    f"command {name!r} does not fit the scene's actuation; it takes "
                    f"{', '.join(sorted(known)) or 'none'}"
                )
        self._tables = []
        for model, what, channels, fixed in self._ports:
            table = np.zeros((len(commands.time), len(channels)))
            for i, channel in enumerate(channels):
                if channel in commands.columns:
                    table[:, i] = commands.columns[channel]
            self._tables.append((model, what, self._delays[model], table, fixed))
        # Instants at which any command changes.
        delays = np.unique(
            np.concatenate([np.zeros(0), *(d for _, _, d, _, _ in self._tables)])
        )
        self._events = (
            np.unique((commands.time[:, None] + delays).ravel())
            if len(commands.time)
            else np.zeros(0)
        )
        self._command_time = commands.time
        self._commands = commands

    def _command(self, table, delays, time: float) -> np.ndarray:
        """The row that holds at a time, entry by entry."""
        if not len(self._command_time):
            return np.zeros(table.shape[1])
        rows = np.searchsorted(self._command_time, time - delays + 1e-9, "right") - 1
        return table[np.maximum(rows, 0), np.arange(table.shape[1])]

    def _write_commands(self, time: float) -> None:
        for _, _, delays, table, fixed in self._tables:
            value = self._command(table, delays, time)
            fixed.GetMutableData().get_mutable_value().SetFromVector(value)

    def _start_lags(self, start: float) -> None:
        """A lag starts where the commands before the window would have brought it."""
        for model, path in self._loaded.paths.items():
            if not path.path.has_lags:
                continue
            own = path.path.GetMyMutableContextFromRoot(self._context)
            if path.command is None:
                path.path.set_lagged(own, path.path.unlagged(own))
                continue
            T = path_numbers(self._plant, model, self._current)[0][TIME_CONSTANT]
            since = start - 12.0 * T.max()  # exp(-12) = 6e-6 of what was before.
            events = self._events[(self._events > since) & (self._events < start)]
            instants = np.concatenate([[since], events, [start]])
            self._write_commands(since)
            y = np.array(path.path.unlagged(own))
            for k in range(len(instants) - 1):
                self._write_commands(instants[k])
                keep = np.exp(-(instants[k + 1] - instants[k]) / np.maximum(T, 1e-12))
                y = keep * y + (1.0 - keep) * path.path.unlagged(own)
            self._write_commands(start)
            path.path.set_lagged(own, y)

    # ----- Running

    def _set_state(self, initial: InitialSection, is_true: bool) -> None:
        plant, n_q = self._plant, self._plant.num_positions()
        x = np.concatenate([self._default, np.zeros(plant.num_velocities())])

        def put(channel: str, value: float) -> None:
            if channel not in self._channels:
                raise ValueError(f"initial value of {channel!r}, not in the scene")
            if not is_true:
                value = self.channel_map(channel).true_value(value)
            x[self._channels[channel][1]] = value

        for name, value in initial.positions.items():
            put(f"{name}.position", value)
        for name, value in initial.velocities.items():
            put(f"{name}.velocity", value)
        for names, suffixes in (
            (initial.poses, POSE),
            (initial.body_velocities, TWIST),
        ):
            for name, values in names.items():
                if self._channels.get(f"{name}.x", ("",))[0] != "x":
                    raise ValueError(f"initial pose of {name!r}, which is no free body")
                if len(values) != len(suffixes):
                    raise ValueError(
                        f"initial state of {name!r} is {values}, expected "
                        f"[{' '.join(suffixes)}]"
                    )
                for suffix, each in zip(suffixes, values, strict=True):
                    put(f"{name}.{suffix}", each)
                if suffixes is POSE:
                    at = self._channels[f"{name}.qw"][1]
                    x[at : at + 4] /= np.linalg.norm(x[at : at + 4])
        # A motor and its link start without twist, unless both are given.
        for name, joint in self._joints.items():
            motor = motor_joint(plant, joint)
            if motor is None:
                continue
            own, a, b = full_name(plant, motor), joint, motor
            if self._channels[f"{name}.position"][1] == motor.position_start():
                a, b = motor, joint
            if own not in initial.positions:
                x[b.position_start()] = x[a.position_start()]
            if own not in initial.velocities:
                x[n_q + b.velocity_start()] = x[n_q + a.velocity_start()]
        plant.SetPositionsAndVelocities(self._plant_context, x)

    def _untwist(self, initial: InitialSection, twists) -> None:
        """A motor leads its link by the given twist; else as it would at rest under its
        effort: by effort over stiffness, or by half the gap."""
        plant = self._plant
        for effect in self._current:
            if not KINDS[effect.kind].hidden_state:
                continue
            for name, joint in self._joints.items():
                model = name.split(".")[0]
                if not any(at in (name, model) for at in effect.at):
                    continue
                motor, path = motor_joint(plant, joint), self._loaded.paths[model]
                assert motor is not None and path.effort is not None
                if full_name(plant, motor) in initial.positions:
                    continue
                if name in twists:
                    twist, rate = twists[name]
                else:
                    twist, rate = self._rest_twist(effect, name, path), 0.0
                x = plant.GetPositionsAndVelocities(self._plant_context)
                side, sign = joint, -1.0
                if self._channels[f"{name}.position"][1] == joint.position_start():
                    side, sign = motor, 1.0
                x[side.position_start()] += sign * twist
                x[plant.num_positions() + side.velocity_start()] += sign * rate
                plant.SetPositionsAndVelocities(self._plant_context, x)

    def _rest_twist(self, effect: Effect, name: str, path) -> float:
        own = path.path.GetMyContextFromRoot(self._context)
        model = name.split(".")[0]
        names = [
            full_name(self._plant, a.joint())
            for a in actuators_of_model(self._plant, model)
        ]
        effort = path.effort.Eval(own)[names.index(name)]
        static_deflection = KINDS[effect.kind].static_deflection
        assert static_deflection is not None
        return static_deflection(effect, float(effort))

    def _simulate(
        self, initial, start: float, needed: np.ndarray, is_true: bool,
        efforts: bool, twists,
    ):  # fmt: skip
        """States (n, n_x) at the needed times, and efforts {model: (n, n_u)} if they
        are asked for. What changes at such a time has changed in them."""
        self.failure = ""
        dt = self._plant.time_step()
        for i, value in enumerate(self._discrete):
            self._context.SetDiscreteState(i, value)
        # A discrete plant steps at multiples of its step: the window is moved there.
        clock = start if dt == 0.0 else round(start / dt) * dt
        self._clock, self._steps = clock, 0
        self._context.SetTime(clock)
        self._set_state(initial, is_true)
        self._write_commands(start)
        self._start_lags(start)
        self._untwist(initial, twists)
        if self._log is not None:
            self._log.Clear()
        else:
            # Else its first step would be what the last run ended with.
            integrator = self._simulator.get_mutable_integrator()
            integrator.Reset()
            integrator.set_target_accuracy(self._config.accuracy)
            integrator.set_maximum_step_size(self._config.max_step_sec)
        self._simulator.Initialize()
        end = needed[-1] if len(needed) else start
        events = self._events[(self._events > start + 1e-9) & (self._events <= end)]
        if dt == 0.0:
            return self._run_continuous(needed, events, efforts)
        return self._run_discrete(needed, events, efforts, clock - start, dt)

    def _efforts(self) -> dict[str, np.ndarray]:
        now = {}
        for k, (model, what, _, _) in enumerate(self._ports):
            if what == "effort_command" and model not in self._loaded.paths:
                fixed = self._tables[k][4]
                now[model] = np.array(
                    fixed.GetMutableData().get_mutable_value().CopyToVector()
                )
        for model, path in self._loaded.paths.items():
            own = path.path.GetMyContextFromRoot(self._context)
            assert path.effort is not None
            now[model] = np.array(path.effort.Eval(own))
        return now

    def _run_continuous(self, needed, events, want_efforts: bool):
        stops = np.union1d(needed, events)
        keep = np.isin(stops, needed)
        change = np.isin(stops, events)
        x = np.full((len(needed), self._plant.num_multibody_states()), np.nan)
        efforts: dict[str, list] = {}
        row = 0
        for k, stop in enumerate(stops):
            if not self._advance(stop):
                break
            if change[k]:
                self._write_commands(stop)
            if keep[k]:
                x[row] = self._plant.GetPositionsAndVelocities(self._plant_context)
                row += 1
                if want_efforts:
                    for model, value in self._efforts().items():
                        efforts.setdefault(model, []).append(value)
        return x, _padded(efforts, len(needed))

    def _advance(self, time: float) -> bool:
        """Whether the simulation got there: parameters that a search tries may be too
        much for the integrator or the contact solver."""
        try:
            if time > self._context.get_time():
                self._simulator.AdvanceTo(time)
        except RuntimeError as error:
            self.failure = " ".join(str(error).split())
        return not self.failure

    def _watch(self, context: Context) -> EventStatus:
        """After each step of a continuous plant."""
        self._steps += 1
        if self._steps > 2000:
            done = context.get_time() - self._clock
            if done < self._config.least_step_sec * self._steps:
                self.failure = f"{self._steps} steps for {done:.3g} s of simulated time"
                return EventStatus.ReachedTermination(self._plant, self.failure)
        return EventStatus.DidNothing()

    def _run_discrete(self, needed, events, want_efforts: bool, shift: float, dt):
        """Steps are at multiples of dt, and a command acts from the first step at or
        after it; between steps a line, as the scheme has it."""
        stops = [(event, True) for event in events]
        stops += [(time, False) for time in needed] if want_efforts else []
        efforts: dict[str, list] = {}
        # Events first where both are at one step.
        for time, is_event in sorted(
            stops, key=lambda s: (np.ceil((s[0] + shift) / dt - 1e-6), not s[1])
        ):
            step = np.ceil((time + shift) / dt - 1e-6) * dt
            if not self._advance(step):
                break
            if is_event:
                self._write_commands(time)
            else:
                for model, value in self._efforts().items():
                    efforts.setdefault(model, []).append(value)
        last = np.ceil((needed[-1] + shift) / dt - 1e-9) * dt if len(needed) else 0.0
        if not self.failure:
            self._advance(last)
        assert self._log is not None
        time, data = self._log.sample_times() - shift, self._log.data().T
        x = _between(time, data, needed)
        x[needed > time[-1] + 1e-9] = np.nan
        return x, _padded(efforts, len(needed))

    def _true_channel(self, channel, x, efforts, poses) -> np.ndarray:
        what, *where = self._channels[channel]
        if what == "x":
            return x[:, where[0]]
        if what == "effort":
            model, i, limit = where
            effort = efforts[model][:, i]
            said = self._scene.channels
            word = said.get(channel, said.get("effort_measured", ""))
            if word.strip().lower().startswith("link"):
                raise ValueError(
                    f"channel {channel!r} is a torque on the link's side (the scene's "
                    "channels say so); only the motor's side is simulated"
                )
            return np.clip(effort, -limit, limit)
        body, suffix = where
        if body.index() not in poses:
            poses[body.index()] = self._motion_of(body, x)
        return poses[body.index()][:, (POSE + TWIST).index(suffix)]

    def _motion_of(self, body, x) -> np.ndarray:
        out = np.empty((len(x), 13))
        for k, each in enumerate(x):
            if not np.isfinite(each).all():
                out[k] = np.nan
                continue
            self._plant.SetPositionsAndVelocities(self._scratch, each)
            X_WB = self._plant.EvalBodyPoseInWorld(self._scratch, body)
            V_WB = self._plant.EvalBodySpatialVelocityInWorld(self._scratch, body)
            out[k, :4] = X_WB.rotation().ToQuaternion().wxyz()
            out[k, 4:7] = X_WB.translation()
            out[k, 7:] = V_WB.get_coeffs()
        return out


def stand_on_ground(plant, context, scene_graph, graph_context, thing) -> float:
    """Moves a free body up or down until it just touches what is fixed below it.

    Args: context, graph_context: of the plant and of the scene graph, in one diagram.
    Returns: the height of its origin [m]. Raises: ValueError if nothing is below it.
    """
    at = thing.floating_positions_start() + 6
    fixed = [
        geometry
        for i in range(plant.num_bodies())
        if plant.IsAnchored(plant.get_body(BodyIndex(i)))
        for geometry in plant.GetCollisionGeometriesForBody(
            plant.get_body(BodyIndex(i))
        )
    ]
    mine = plant.GetCollisionGeometriesForBody(thing)
    q = plant.GetPositions(context)
    for _ in range(4):  # One is enough for a flat ground.
        query = scene_graph.get_query_output_port().Eval(graph_context)
        down = np.inf
        for a in mine:
            for b in fixed:
                pair = query.ComputeSignedDistancePairClosestPoints(a, b)
                up = pair.nhat_BA_W[2] * (1.0 if pair.id_A == a else -1.0)
                if up > 0.5:
                    down = min(down, pair.distance / up)
        if not np.isfinite(down):
            name = full_name(plant, thing)
            raise ValueError(f"put_down: nothing fixed is below {name!r}")
        q[at] -= down
        plant.SetPositions(context, q)
        if abs(down) < 1e-9:
            break
    return float(q[at])


def _behind(stages, times, values, before) -> np.ndarray:
    """(n,) values behind filters that remember what was before."""
    if before is None or not len(before[0]) or len(times) + len(before[0]) < 2:
        return filtered(stages, times, values) if len(times) > 1 else values
    since = before[0] < times[0] - 1e-9 if len(times) else np.ones(len(before[0]), bool)
    t = np.concatenate([before[0][since], times])
    x = np.concatenate([before[1][since], values])
    return filtered(stages, t, x)[int(since.sum()) :]


def _padded(efforts: dict[str, list], n: int) -> dict[str, np.ndarray]:
    """{model: (n, n_u)}, NaN where the simulation did not get to."""
    found = {}
    for model, rows in efforts.items():
        found[model] = np.full((n, len(rows[0])), np.nan)
        found[model][: len(rows)] = rows
    return found


def _between(time, x, needed) -> np.ndarray:
    """Rows of x (m, n) at the needed times, with a line between samples."""
    row = np.clip(np.searchsorted(time, needed, "right") - 1, 0, max(len(time) - 2, 0))
    after = np.minimum(row + 1, len(time) - 1)
    step = time[after] - time[row]
    share = np.where(
        step > 0.0, (needed - time[row]) / np.where(step > 0, step, 1), 0.0
    )
    share = np.clip(share, 0.0, 1.0)[:, None]
    return (1.0 - share) * x[row] + share * x[after]
