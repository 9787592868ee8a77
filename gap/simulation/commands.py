"""A recording's commands, held from row to row at the ports of a scene's diagram."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import Context, Diagram, FixedInputPortValue

from makebreak.gap.data.table import COMMANDS
from makebreak.gap.simulation.sensor_samples import SAME_SEC
from makebreak.models.effects.actuation_path import TIME_CONSTANT
from makebreak.models.effects.kind import Effect, full_name
from makebreak.models.scene import LoadedScene, actuators_of_model, path_numbers

# A lag forgets what was commanded so many time constants ago: exp(-12) = 6e-6 of it.
FORGOTTEN = 12.0


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
class _Port:
    """A command port <model>.<what>, n_u entries, each a channel."""

    model: str
    what: str
    channels: list[str]
    value: FixedInputPortValue
    delays: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (n_u,) [s].
    table: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (m, n_u).


class CommandPorts:
    """Every command port of a scene's diagram, held at values that can be changed.

    events: (k,) instants [s] at which any command changes, delays included.
    """

    def __init__(self, diagram: Diagram, loaded: LoadedScene, context: Context):
        """context: the diagram's."""
        self._loaded, self._context = loaded, context
        self._plant = loaded.plant
        self._ports: list[_Port] = []
        for k in range(diagram.num_input_ports()):
            port = diagram.get_input_port(k)
            model, _, what = port.get_name().rpartition(".")
            if what not in COMMANDS:
                continue
            channels = [
                f"{full_name(self._plant, actuator.joint())}.{what}"
                for actuator in actuators_of_model(self._plant, model)
            ]
            value = port.FixValue(context, np.zeros(port.size()))
            self._ports.append(_Port(model, what, channels, value))
        self._effects: Sequence[Effect] = ()
        self._commands: Commands | None = None
        self.events = np.zeros(0)

    def set_effects(self, effects: Sequence[Effect]) -> None:
        """The effects from now on: some delay commands, some make them lag."""
        self._effects = effects
        for port in self._ports:
            port.delays = path_numbers(self._plant, port.model, effects)[1]
        self._commands = None

    def hold(self, commands: Commands) -> None:
        """What `write` writes from now on.

        Raises: ValueError for a command that the scene does not take.
        """
        if commands is self._commands:
            return
        known = {channel for port in self._ports for channel in port.channels}
        for name in commands.columns:
            if name not in known:
                raise ValueError(
                    f"command {name!r} does not fit the scene's actuation; it takes "
                    f"{', '.join(sorted(known)) or 'none'}"
                )
        for port in self._ports:
            port.table = np.zeros((len(commands.time), len(port.channels)))
            for i, channel in enumerate(port.channels):
                if channel in commands.columns:
                    port.table[:, i] = commands.columns[channel]
        delays = np.unique(
            np.concatenate([np.zeros(0), *(port.delays for port in self._ports)])
        )
        self.events = (
            np.unique((commands.time[:, None] + delays).ravel())
            if len(commands.time)
            else np.zeros(0)
        )
        self._time = commands.time
        self._commands = commands

    def write(self, time: float) -> None:
        """The commands that hold at a time [s], into the Context."""
        for port in self._ports:
            held = port.value.GetMutableData().get_mutable_value()
            held.SetFromVector(self._held(port, time))

    def columns(self, times: np.ndarray) -> dict[str, np.ndarray]:
        """{channel: (n,)} what holds at the times (n,) [s]."""
        return {
            channel: column
            for port in self._ports
            for channel, column in zip(
                port.channels, self._held(port, times[:, None]).T, strict=True
            )
        }

    def _held(self, port: _Port, time: float | np.ndarray) -> np.ndarray:
        """(n_u,) what holds at a time, entry by entry; or (n, n_u) at times (n, 1)."""
        late = time - port.delays + SAME_SEC
        if not len(self._time):
            return np.zeros(late.shape)
        rows = np.searchsorted(self._time, late, "right") - 1
        return port.table[np.maximum(rows, 0), np.arange(port.table.shape[1])]

    def start_lags(self, start: float) -> None:
        """A lag starts where the commands before the window would have brought it."""
        for model, path in self._loaded.paths.items():
            if not path.path.has_lags:
                continue
            own = path.path.GetMyMutableContextFromRoot(self._context)
            if path.command is None:
                path.path.set_lagged(own, path.path.unlagged(own))
                continue
            T = path_numbers(self._plant, model, self._effects)[0][TIME_CONSTANT]
            since = start - FORGOTTEN * T.max()
            events = self.events[(self.events > since) & (self.events < start)]
            instants = np.concatenate([[since], events, [start]])
            self.write(since)
            y = np.array(path.path.unlagged(own))
            for k in range(len(instants) - 1):
                self.write(instants[k])
                keep = np.exp(-(instants[k + 1] - instants[k]) / np.maximum(T, 1e-12))
                y = keep * y + (1.0 - keep) * path.path.unlagged(own)
            self.write(start)
            path.path.set_lagged(own, y)

    def efforts(self) -> dict[str, np.ndarray]:
        """{model: (n_u,)} the motors' efforts now [N m]."""
        now = {}
        for port in self._ports:
            if port.what == "effort_command" and port.model not in self._loaded.paths:
                held = port.value.GetMutableData().get_mutable_value()
                now[port.model] = np.array(held.CopyToVector())
        for model, path in self._loaded.paths.items():
            own = path.path.GetMyContextFromRoot(self._context)
            assert path.effort is not None
            now[model] = np.array(path.effort.Eval(own))
        return now
