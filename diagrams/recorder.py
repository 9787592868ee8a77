"""What a real robot could record of a run, for `makebreak gap`: one way for all.

A diagram has a Recorder beside its station or plant; after a simulation `recorded`
gives the columns of recording.csv (gap/data/table.py). Sensors are sampled once a row.
An effort command changes faster than rows come: a row has the mean of what acted from
its instant until the next row's, which does the same to a mechanism. What comes at a
rate of its own and late, as a camera's poses, is in rows of its own instants.
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

TICK = 0.001  # Of commands [s].
ENCODER_NOISE = {"position": 2e-5, "velocity": 2e-3}  # [m], [rad] and their rates.
ROW_SEC = 0.005  # From row to row [s].
SAME = 2e-4  # A reading so near to a row is in it: systems of one tick run in turn [s].
WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
Channels = Mapping[str, tuple[OutputPort, Sequence[str]]]


class Recorder(Diagram):
    """Logs of measured and of commanded channels.

    Inputs: one for each port that is recorded, of the same name.

    Args:
        measured, commanded: {input: names of its entries}; an entry without a name is
            not recorded.
        readings: likewise; the first entry, which has no name, is the time at which the
            others were so [s], negative before the first reading.
        row_sec: from one row to the next, a multiple of TICK [s].
        late: whether a command that is seen at an instant acted in the TICK before it,
            not from it on.
        behind_sec: a reading is known so long after its time, at most.
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
            ("readings", TICK),  # As often as they may come.
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
        """The times and {channel: (n,)} of "measured" or "commanded" from `begin` on
        [s], in a root context; empty where there are none."""
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
        """Of each input of `readings` the times (n,) of what was read, from `begin` on
        [s], and {channel: (n,)}."""
        found = []
        if self.HasSubsystemNamed("readings"):
            log = self.GetSubsystemByName("readings").FindLog(context)
            # No reading is known before its time.
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
    """A Recorder of output ports. Args: {input: (port, names of its entries)}; the rest
    as of Recorder."""
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
    """A Recorder of a station: its arm's joints, and the wrench at the tool's tip where
    it has one.

    Args: tau (7,), what is commanded; tool, the model of TIP_FRAME; seen, of what else
        is measured, as by a camera; readings, behind_sec: as of Recorder.
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
    """Whether `recorded` can be asked."""
    return any(isinstance(system, Recorder) for system in _within(diagram))


def behind_sec(diagram: Diagram) -> float:
    """How much later than its instant a row may be complete [s]."""
    of_each = (s.behind_sec for s in _within(diagram) if isinstance(s, Recorder))
    return max(of_each, default=0.0)


def recorded(
    diagram: Diagram, context: Context, begin: float = -np.inf
) -> dict[str, np.ndarray]:
    """The columns of a simulation that ended in `context`: time (n,) and every channel
    (n,), a row per row_sec of its Recorder, from `begin` on [s].

    Raises: ValueError for a diagram without a Recorder.
    """
    found = [system for system in _within(diagram) if isinstance(system, Recorder)]
    if not found:
        raise ValueError(f"{diagram.get_name()} has no recorder")
    (recorder,) = found
    time, columns = recorder.log("measured", context, begin)
    for times, values in recorder.read(context, begin - SAME):
        time, columns = _with_rows(time, columns, times, values)
    asked = time >= begin - 1e-9
    time, columns = time[asked], {name: y[asked] for name, y in columns.items()}
    # What holds at the first row began up to a tick before it.
    ticks, commands = recorder.log("commanded", context, begin - 2.0 * TICK)
    if commands and len(time):
        fine = np.column_stack(list(commands.values()))
        acting = ticks - TICK if recorder.late else ticks
        held = mean_until_next(time, acting, fine)
        columns |= dict(zip(commands, held.T, strict=True))
    else:  # None yet.
        columns |= commands
    return {"time": time, **columns}


def _with_rows(time, columns, times, values):
    """A table with the rows of another: one for each instant of either; where the one
    or the other has none, its cells are empty (NaN). Less than SAME apart is one."""
    if len(time):
        near = time[np.searchsorted(0.5 * (time[1:] + time[:-1]), times)]
        times = np.where(abs(near - times) < SAME, near, times)
    both = np.unique(np.concatenate([time, times]))
    merged = {}
    for own, part in ((time, columns), (times, values)):
        row = np.searchsorted(both, own)
        for name, y in part.items():
            merged[name] = np.full(len(both), np.nan)
            merged[name][row] = y
    return both, merged


def _within(diagram: Diagram) -> Iterator[System]:
    for system in diagram.GetSystems():
        yield system
        if isinstance(system, Diagram):
            yield from _within(system)


def mean_until_next(time, fine_time, fine):
    """Mean (n, k) of what held from each of the times (n,) until the next.

    A plant's step at an instant takes what holds at it, so values count from the first
    of fine_time at or after a time on. Of two times between which there is none the
    first has the value that holds there.

    Args: fine_time (m,), fine (m, k): values that hold from their time on. After the
        last of the times: the value that holds there.
    """
    row = np.searchsorted(fine_time, time - 1e-9)
    row = np.minimum(row, len(fine) - 1)
    total = np.vstack([np.zeros(fine.shape[1]), np.cumsum(fine, axis=0)])
    last = np.minimum(np.append(row[1:], row[-1] + 1), len(fine))
    first = np.maximum(np.minimum(row, last - 1), 0)
    last = np.maximum(last, first + 1)
    return (total[last] - total[first]) / (last - first)[:, None]


def with_noise(columns, seed: int) -> dict[str, np.ndarray]:
    """The columns with the noise of encoders, of experiments whose sensors have none:
    without any a comparison would be one of rounding errors.

    Args: columns, as `recorded` gives them; seed, of the noise.
    """
    rng, found = np.random.default_rng([seed, 17]), dict(columns)
    for name, y in columns.items():
        std = ENCODER_NOISE.get(name.rsplit(".", 1)[-1], 0.0)
        if std:
            found[name] = y + std * rng.normal(size=len(y))
    return found


def episodes(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Several simulations as one table, each an episode; channels of all of them."""
    number = [np.full(len(part["time"]), k) for k, part in enumerate(parts)]
    table = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    return {"time": table.pop("time"), "episode": np.concatenate(number), **table}
