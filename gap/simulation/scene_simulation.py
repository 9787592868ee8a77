"""Windows of recordings simulated with a scene, again and again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydrake.geometry import SceneGraph, Sphere
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from makebreak.gap.budget import go_on
from makebreak.gap.simulation.commands import NO_COMMANDS, CommandPorts, Commands
from makebreak.gap.simulation.initial_state import initial_state, twist_transmissions
from makebreak.gap.simulation.scene_channels import SceneChannels
from makebreak.gap.simulation.scene_diagram import STATE_LOG, make_scene_diagram
from makebreak.gap.simulation.sensor_samples import (
    SAME_SEC,
    behind,
    between,
    instants,
    samples_at,
    stages_of,
    with_middles,
)
from makebreak.gap.simulation.stand_on_ground import stand_on_ground
from makebreak.models.effects import KINDS
from makebreak.models.effects.contact_damper import STICTION
from makebreak.models.effects.kind import Effect
from makebreak.models.effects.measured_channels import ChannelMap, channel_maps
from makebreak.models.scene import CHANNEL_STEPS, InitialSection, Scene, read_scene
from makebreak.systems.numerics.filters import Stage

T = TypeVar("T")

FREE_STEPS = 2000  # Of a continuous run, before short steps end it.
STEPS_BETWEEN = 200  # Before it is asked again whether to go on.


@dataclass
class SimulationConfig:
    """How a continuous plant is integrated (Runge-Kutta of third order)."""

    accuracy: float = 1e-6  # Relative error of a step [-].
    max_step_sec: float = 0.02
    # A run whose steps are shorter than this, on average since its start and after the
    # first 2000, is given up: parameters that a search tries may make it endless.
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
        self.fades = 1.0  # Times the speeds below which dry friction fades.
        # Slip below which contacts that hold creep [m/s]: Drake's own.
        self.creeps = STICTION
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
        self._commands.set_effects(self._current)
        self._plant.set_stiction_tolerance(self.creeps)
        forces = self._loaded.joint_forces
        if forces is not None and self.fades != 1.0:
            forces.fade_below(self._context, self.fades)

    def channels(self) -> list[str]:
        """The measured channels that can be simulated."""
        return self._channels.names()

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
        self._set_state(initial, is_true=True)
        plant, own = self._plant, self._plant_context
        thing = self._channels.bodies[body]
        scene_graph = self._loaded.scene_graph
        graph_context = scene_graph.GetMyContextFromRoot(self._context)
        z = stand_on_ground(plant, own, scene_graph, graph_context, thing)
        pose = [*initial.poses[body][:6], z]
        twist = list(initial.body_velocities.get(body, [0.0] * 6))
        inspector = scene_graph.model_inspector()
        mine = plant.GetCollisionGeometriesForBody(thing)
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
        go_on()
        times = np.asarray(times, dtype=float)
        start = float(times[0] if start_sec is None else start_sec)
        for channel in channels:
            if channel not in self._channels:
                raise ValueError(f"channel {channel!r} cannot be simulated")
        maps = channel_maps(self._current, CHANNEL_STEPS, channels)
        shown = {
            channel: (times - m.delay) / (1.0 + m.skew) for channel, m in maps.items()
        }
        stages = stages_of(channels, filters or {}, maps)
        needed = instants(start, times, shown.values(), bool(stages))
        self._commands.hold(commands)
        efforts = any(self._channels.is_effort(channel) for channel in channels)
        x, effort = self._simulate(
            initial, start, needed, initial_is_true, efforts, twists or {}
        )
        if not self.failure and not np.isfinite(x).all():
            self.failure = "the state grew beyond all numbers"
        x[~np.isfinite(x).all(axis=1)] = np.nan
        out = np.empty((len(times), len(channels)))
        motions: dict = {}
        for i, channel in enumerate(channels):
            known = needed
            value = self._channels.true_values(channel, x, effort, motions)
            if channel in stages:
                place = f"{channel.rpartition('.')[0]}.position"
                if channel.endswith(".velocity") and place in self._channels:
                    position = self._channels.true_values(place, x, effort, motions)
                    known, value = with_middles(needed, position, value)
                past = (before or {}).get(channel)
                value = behind(stages[channel], known, value, past)
            column = samples_at(shown.get(channel, times), known, value, start)
            m = maps.get(channel)
            out[:, i] = column if m is None else m.scale * column + m.bias
        return out

    def each(self, calls: Sequence[Callable[[], T]]) -> list[T]:
        """The results of calls each of which runs this once."""
        return [call() for call in calls]

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
        self._log = None
        if plant.time_step() > 0.0:
            sink = self._diagram.GetSubsystemByName(STATE_LOG)
            self._log = sink.FindLog(self._context)
        self._channels = SceneChannels(self._loaded)
        self._commands = CommandPorts(self._diagram, self._loaded, self._context)
        self._commands.set_effects(self._current)

    # ----- Running

    def _set_state(self, initial: InitialSection, is_true: bool) -> None:
        def true_value(channel: str, value: float) -> float:
            return value if is_true else self.channel_map(channel).true_value(value)

        x = initial_state(
            self._plant, self._channels, self._default, initial, true_value
        )
        self._plant.SetPositionsAndVelocities(self._plant_context, x)

    def _start(
        self,
        initial: InitialSection,
        start: float,
        is_true: bool,
        twists: Mapping[str, tuple[float, float]],
    ) -> None:
        """Sets the Context and the integrator as they are at the start of a window."""
        self.failure = ""
        for i, value in enumerate(self._discrete):
            self._context.SetDiscreteState(i, value)
        self._clock, self._steps = self._clock_at(start), 0
        self._context.SetTime(self._clock)
        self._set_state(initial, is_true)
        self._commands.write(start)
        self._commands.start_lags(start)
        twist_transmissions(
            self._loaded, self._context, self._channels, self._current, initial, twists
        )
        if self._log is not None:
            self._log.Clear()
        else:
            # Else its first step would be what the last run ended with.
            integrator = self._simulator.get_mutable_integrator()
            integrator.Reset()
            integrator.set_target_accuracy(self._config.accuracy)
            integrator.set_maximum_step_size(self._config.max_step_sec)
        self._simulator.Initialize()

    def _clock_at(self, start: float) -> float:
        """A discrete plant steps at multiples of its step: windows are moved there."""
        dt = self._plant.time_step()
        return start if dt == 0.0 else round(start / dt) * dt

    def _simulate(
        self,
        initial: InitialSection,
        start: float,
        needed: np.ndarray,
        is_true: bool,
        want_efforts: bool,
        twists: Mapping[str, tuple[float, float]],
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """States (n, n_x) at the needed times, and efforts {model: (n, n_u)} if they
        are asked for. What changes at such a time has changed in them."""
        self._start(initial, start, is_true, twists)
        end = needed[-1] if len(needed) else start
        events = self._commands.events
        events = events[(events > start + SAME_SEC) & (events <= end)]
        dt = self._plant.time_step()
        if dt == 0.0:
            return self._run_continuous(needed, events, want_efforts)
        shift = self._clock - start
        return self._run_discrete(needed, events, want_efforts, shift, dt)

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
                self._commands.write(stop)
            if keep[k]:
                x[row] = self._plant.GetPositionsAndVelocities(self._plant_context)
                row += 1
                if want_efforts:
                    for model, value in self._commands.efforts().items():
                        efforts.setdefault(model, []).append(value)
        return x, _padded(efforts, len(needed))

    def _advance(self, time: float) -> bool:
        """Whether the simulation got there: parameters that a search tries may be too
        much for the integrator or the contact solver."""
        go_on()
        try:
            if time > self._context.get_time():
                self._simulator.AdvanceTo(time)
        except RuntimeError as error:
            self.failure = " ".join(str(error).split())
        return not self.failure

    def _watch(self, context: Context) -> EventStatus:
        """After each step of a continuous plant."""
        self._steps += 1
        if self._steps % STEPS_BETWEEN == 0:
            go_on()
        if self._steps > FREE_STEPS:
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
                self._commands.write(time)
            else:
                for model, value in self._commands.efforts().items():
                    efforts.setdefault(model, []).append(value)
        last = np.ceil((needed[-1] + shift) / dt - 1e-9) * dt if len(needed) else 0.0
        if not self.failure:
            self._advance(last)
        assert self._log is not None
        time, data = self._log.sample_times() - shift, self._log.data().T
        x = between(time, data, needed)
        x[needed > time[-1] + 1e-9] = np.nan
        return x, _padded(efforts, len(needed))


def _padded(efforts: dict[str, list], n: int) -> dict[str, np.ndarray]:
    """{model: (n, n_u)}, NaN where the simulation did not get to."""
    found = {}
    for model, rows in efforts.items():
        found[model] = np.full((n, len(rows[0])), np.nan)
        found[model][: len(rows)] = rows
    return found
