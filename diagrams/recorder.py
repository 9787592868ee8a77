"""Records of a run what a real robot could record, for `makebreak gap`.

A diagram has a Recorder beside its station or plant; after a simulation `recorded`
gives the columns of recording.csv (gap/data/table.py). Sensors are sampled once a row.
Effort commands change faster: a row has the mean of the command from its time until the
next row's, which moves a mechanism in the same way. Readings with a rate of their own
and a delay, such as a camera's poses, are in rows at the times when they were taken.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import Multiplexer, VectorLogSink

from makebreak.diagrams.scene_facts import PANDA_JOINTS
from makebreak.diagrams.station import ARM, TIP_FRAME

TICK = 0.001  # Period at which commands are logged [s].
# Standard deviations [m], [rad] and their rates.
ENCODER_NOISE = {"position": 2e-5, "velocity": 2e-3}
ROW_SEC = 0.005  # Time between rows [s].
# A reading this near to a row is put into it: the systems of one tick have different
# offsets [s].
ROW_TOLERANCE_SEC = 2e-4
WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
# {input of the Recorder: (port, names of its entries)}
Channels = Mapping[str, tuple[OutputPort, Sequence[str]]]


class Recorder(Diagram):
    """Logs of measured and commanded channels and of readings.

    Inputs: one for each key of measured, commanded and readings.

    Args:
        measured, commanded: {input: names of its entries}; an entry whose name is empty
            is not recorded.
        readings: likewise; the first entry, whose name is empty, is the time at which
            the others were measured [s], negative before the first reading.
        row_sec: time between rows, a multiple of TICK [s].
        late: whether a command that is logged at an instant acted in the TICK before it
            instead of after it.
        behind_sec: largest delay of a reading [s].
    """

    def __init__(
        self,
        measured: Mapping[str, Sequence[str]],
        commanded: Mapping[str, Sequence[str]],
        row_sec: float = ROW_SEC,
        late: bool = False,
        readings: Mapping[str, Sequence[str]] | None = None,
        behind_sec: float = 0.0,
    ):
        super().__init__()
        self.names = {
            "measured": measured,
            "commanded": commanded,
            "readings": readings or {},
        }
        self.late = late
        self.behind_sec = behind_sec + TICK if readings else 0.0
        builder = DiagramBuilder()
        for what, period in (
            ("measured", row_sec),
            ("commanded", TICK),
            ("readings", TICK),  # They may come at any tick.
        ):
            sizes = [len(names) for names in self.names[what].values()]
            if not sizes:
                continue
            joined = builder.AddSystem(Multiplexer(sizes))
            for i, name in enumerate(self.names[what]):
                builder.ExportInput(joined.get_input_port(i), name)
            log = builder.AddNamedSystem(what, VectorLogSink(sum(sizes), period))
            builder.Connect(joined.get_output_port(), log.get_input_port())
        builder.BuildInto(self)
        self.set_name("recorder")

    def log(
        self, what: str, context: Context, begin: float = -np.inf
    ) -> tuple[np.ndarray, dict]:
        """Times (n,) [s] and {channel: (n,)} of "measured" or "commanded" from the time
        `begin` on; empty if nothing is logged. Args: context: of the whole diagram."""
        if not self.HasSubsystemNamed(what):
            return np.zeros(0), {}
        log = self.GetSubsystemByName(what).FindLog(context)
        names = [name for part in self.names[what].values() for name in part]
        first = int(np.searchsorted(log.sample_times(), begin - 1e-9))
        values = zip(names, log.data()[:, first:], strict=True)
        times = np.array(log.sample_times()[first:])
        return times, {n: np.array(x) for n, x in values if n}

    def read(
        self, context: Context, begin: float = -np.inf
    ) -> list[tuple[np.ndarray, dict]]:
        """For each input of `readings` the times of measurement (n,) [s] from `begin`
        on, and {channel: (n,)}."""
        found = []
        if self.HasSubsystemNamed("readings"):
            log = self.GetSubsystemByName("readings").FindLog(context)
            # A reading is logged at or after its time of measurement.
            data = log.data()[:, np.searchsorted(log.sample_times(), begin - 1e-9) :]
            for names in self.names["readings"].values():
                own, data = data[: len(names)], data[len(names) :]
                times, first = np.unique(own[0], return_index=True)
                new = (times >= 0.0) & (times >= begin - 1e-9)
                values = own[1:, first[new]]
                found.append((times[new], dict(zip(names[1:], values, strict=True))))
        return found


def add_recorder(
    builder: DiagramBuilder,
    measured: Channels,
    commanded: Channels,
    row_sec: float = ROW_SEC,
    late: bool = False,
    readings: Channels | None = None,
    behind_sec: float = 0.0,
) -> None:
    """Adds a Recorder of output ports.

    Args: measured, commanded, readings: {input: (port, names of its entries)}; others
        as of Recorder.
    """
    readings = readings or {}
    recorder = builder.AddNamedSystem(
        "recorder",
        Recorder(
            {name: entries for name, (_, entries) in measured.items()},
            {name: entries for name, (_, entries) in commanded.items()},
            row_sec,
            late,
            {name: entries for name, (_, entries) in readings.items()},
            behind_sec,
        ),
    )
    for name, (port, _) in {**measured, **commanded, **readings}.items():
        builder.Connect(port, recorder.GetInputPort(name))


def record_station(
    builder: DiagramBuilder,
    station: Diagram,
    tau: OutputPort,
    tool: str,
    row_sec: float = ROW_SEC,
    seen: Channels | None = None,
    readings: Channels | None = None,
    behind_sec: float = 0.0,
) -> None:
    """Adds a Recorder of a station: its arm's joints, and the wrench at the tool's tip
    if it is measured.

    Args: tau (7,): commanded [N m]; tool: name of the model that has TIP_FRAME; seen:
        other measured channels, such as a camera's; readings, behind_sec: as of
        Recorder.
    """
    joints = [f"{ARM}.{joint}" for joint in PANDA_JOINTS]

    def of(port: str, what: str):
        names = [f"{joint}.{what}" for joint in joints]
        return station.GetOutputPort(f"{ARM}.{port}"), names

    measured = {
        "position": of("position_measured", "position"),
        "velocity": of("velocity_measured", "velocity"),
        "torque": of("torque_measured", "effort_measured"),
    }
    if station.HasOutputPort(f"{ARM}.external_wrench"):
        measured["wrench"] = (
            station.GetOutputPort(f"{ARM}.external_wrench"),
            [f"{tool}.{TIP_FRAME}.{name}" for name in WRENCH],
        )
    commanded = {"tau": (tau, [f"{joint}.effort_command" for joint in joints])}
    add_recorder(
        builder,
        measured | dict(seen or {}),
        commanded,
        row_sec,
        readings=readings,
        behind_sec=behind_sec,
    )


def has_recorder(diagram: Diagram) -> bool:
    """Whether `recorded` has something to return."""
    return any(isinstance(system, Recorder) for system in _within(diagram))


def behind_sec(diagram: Diagram) -> float:
    """Largest delay after which a row is complete [s]."""
    delays = (s.behind_sec for s in _within(diagram) if isinstance(s, Recorder))
    return max(delays, default=0.0)


def recorded(
    diagram: Diagram, context: Context, begin: float = -np.inf
) -> dict[str, np.ndarray]:
    """The columns of a simulation that ended in `context`, from the time `begin` on:
    time (n,) [s] and every channel (n,), a row every row_sec of its Recorder.

    Raises: ValueError for a diagram without a Recorder.
    """
    found = [system for system in _within(diagram) if isinstance(system, Recorder)]
    if not found:
        raise ValueError(f"{diagram.get_name()} has no recorder")
    (recorder,) = found
    time, columns = recorder.log("measured", context, begin)
    for times, values in recorder.read(context, begin - ROW_TOLERANCE_SEC):
        time, columns = _with_rows(time, columns, times, values)
    asked = time >= begin - 1e-9
    time, columns = time[asked], {name: y[asked] for name, y in columns.items()}
    # The command that acts at the first row began up to a tick before it.
    ticks, commands = recorder.log("commanded", context, begin - 2.0 * TICK)
    if commands and len(time):
        fine = np.column_stack(list(commands.values()))
        acting = ticks - TICK if recorder.late else ticks
        held = mean_until_next(time, acting, fine)
        columns |= dict(zip(commands, held.T, strict=True))
    else:  # No command was logged, or no row.
        columns |= commands
    return {"time": time, **columns}


def _with_rows(time, columns, times, values):
    """Two tables merged: a row for each time of either, NaN in the columns of a table
    that has no row there. Times nearer than ROW_TOLERANCE_SEC are one row."""
    if len(time):
        near = time[np.searchsorted(0.5 * (time[1:] + time[:-1]), times)]
        times = np.where(abs(near - times) < ROW_TOLERANCE_SEC, near, times)
    both = np.unique(np.concatenate([time, times]))
    merged = {}
    for own, part in ((time, columns), (times, values)):
        row = np.searchsorted(both, own)
        for name, y in part.items():
            merged[name] = np.full(len(both), np.nan)
            merged[name][row] = y
    return both, merged


def _within(diagram: Diagram) -> Iterator[System]:
    """All systems in a diagram, at any depth."""
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from _within(system)


def mean_until_next(time, fine_time, fine):
    """Mean (n, k) of a piecewise constant signal from each of the times (n,) until the
    next one; at the last time the value there.

    A plant's step uses the value at the step's start, so the mean starts with the first
    sample at or after a time. Without a sample between two times the mean is the
    signal's value at the first of them.

    Args: fine_time (m,), fine (m, k): samples, which hold until the next one.
    """
    row = np.searchsorted(fine_time, time - 1e-9)
    row = np.minimum(row, len(fine) - 1)
    total = np.vstack([np.zeros(fine.shape[1]), np.cumsum(fine, axis=0)])
    last = np.minimum(np.append(row[1:], row[-1] + 1), len(fine))
    first = np.maximum(np.minimum(row, last - 1), 0)
    last = np.maximum(last, first + 1)
    return (total[last] - total[first]) / (last - first)[:, None]


def with_noise(columns, seed: int) -> dict[str, np.ndarray]:
    """The columns with encoder noise, for experiments whose sensors have none: without
    noise `gap` would compare rounding errors.

    Args: columns: of `recorded`; seed: of the noise.
    """
    rng, found = np.random.default_rng([seed, 17]), dict(columns)
    for name, y in columns.items():
        std = ENCODER_NOISE.get(name.rsplit(".", 1)[-1], 0.0)
        if std:
            found[name] = y + std * rng.normal(size=len(y))
    return found


def episodes(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Several simulations with the same channels as one table, one episode each."""
    number = [np.full(len(part["time"]), k) for k, part in enumerate(parts)]
    table = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return {"time": table.pop("time"), "episode": np.concatenate(number), **table}
