"""One run of an experiment: simulates, records, and writes the files of the run."""

import json
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import cast

import matplotlib

matplotlib.use("Agg")  # Pictures go to files; no display is needed.

import matplotlib.pyplot as plt
import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    Diagram,
    OutputPort,
    PortDataType,
    System,
)
from tqdm import tqdm

from makebreak.gap.table import write_recording
from makebreak.scripts.diagram_picture import draw_diagram, shown_systems
from makebreak.scripts.table import json_value
from makebreak.scripts.trials import run_many

__all__ = ["Log", "Session", "run_many"]

# Files of an earlier run in the same folder, which would tell of the wrong one.
_OWN_FILES = (
    "result.json timing.json config.yaml recording.csv noise.json meshcat.html "
    "partial.npz error.txt"
).split()


@dataclass(frozen=True, eq=False)
class Log(Mapping):
    """What one simulation gave: `log[column]` is (n, k), a row per sample."""

    time: np.ndarray  # (n,) [s]
    columns: dict[str, np.ndarray]
    interrupted: bool  # Ctrl-C ended it early.
    context: Context  # The diagram's, as the simulation left it.
    diagram: Diagram

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def __iter__(self):
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)


class _CatchInterrupt:
    """While entered, Ctrl-C sets `hit`; the second one raises KeyboardInterrupt."""

    def __init__(self):
        self.hit = False

    def _handle(self, *_):
        if self.hit:
            raise KeyboardInterrupt
        self.hit = True

    def __enter__(self):
        self._old = None
        if threading.current_thread() is threading.main_thread():
            self._old = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_):
        if self._old is not None:
            signal.signal(signal.SIGINT, self._old)


def leaf_systems(system: System):
    """All leaf systems of a diagram, those of nested diagrams too."""
    if isinstance(system, Diagram):
        for child in system.GetSystems():
            yield from leaf_systems(child)
    else:
        yield system


class Session:
    """What an experiment is given to run with.

    Args:
        out_dir: the folder of the run's files; made if it is missing.
        meshcat: where the run is seen; None: nowhere, and no meshcat.html.
        duration_sec: overrides the experiment's own duration; None: does not [s].
        realtime: the fastest that simulated time may pass, in simulated seconds per
            second; 0: as fast as possible.
        progress: whether a progress bar is shown.
        reuse: whether trials that have ended in an earlier session with the same
            settings are taken as they are; run_many is to be told.
    Raises: ValueError for an out_dir that cannot be made or written to.
    """

    def __init__(
        self,
        out_dir: Path,
        meshcat: Meshcat | None = None,
        duration_sec: float | None = None,
        realtime: float = 0.0,
        progress: bool = True,
        reuse: bool = False,
    ):
        self.out_dir = Path(out_dir)
        self.meshcat = meshcat
        self.duration_sec = duration_sec
        self.realtime = realtime
        self.reuse = reuse
        self.files: list[Path] = []  # All that was written.
        self.started = False  # Whether anything has been simulated yet.
        self.interrupted = False
        self._progress = progress
        self.picture: Path | None = None  # Where the diagram is to be drawn.
        self._drawn = 0  # Systems in the diagram that was.
        self._partial: dict[str, dict[str, np.ndarray]] = {}
        self._timing: dict[str, dict] = {}
        try:
            self.out_dir.mkdir(parents=True, exist_ok=True)
            for name in _OWN_FILES:
                (self.out_dir / name).unlink(missing_ok=True)
            probe = self.out_dir / ".writable"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise ValueError(
                f'--out: got "{out_dir}", expected a folder to write in '
                f"({error.strerror})"
            ) from error

    def child(self, name: str) -> "Session":
        """A session of its own for one of several trials, in the subfolder `name`."""
        return Session(
            self.out_dir / name,
            duration_sec=self.duration_sec,
            progress=self._progress,
            reuse=self.reuse,
        )

    def simulate(
        self,
        diagram: Diagram,
        duration_sec: float,
        record: Mapping[str, OutputPort],
        period_sec: float = 0.0125,
        until: Callable[[float, dict[str, np.ndarray]], bool] | None = None,
        label: str = "",
        context: Context | None = None,
    ) -> Log:
        """Simulates the diagram and samples its ports, from time 0.

        A sample at time t is taken before the events at t; the first is at time 0, and
        each is at a multiple of period_sec. Ctrl-C ends the simulation at the next
        sample; all that was recorded until then is in the log.

        Args:
            diagram: what is simulated.
            duration_sec: for how long, unless the session's own duration is set [s].
            record: {column: vector output port of the diagram or a system in it}.
            period_sec: time between samples [s].
            until: called with the time and {column: (k,)} at each sample; True ends.
            label: tells apart several simulations of one run, in timing.json and on
                the progress bar.
            context: where to start from; None: the diagram's default context.
        Returns: the log.
        Raises: ValueError for a duration or period that is not positive, a port that is
            not a vector or not in the diagram. KeyboardInterrupt if an earlier
            simulation of this session was interrupted, or at a second Ctrl-C.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        duration = duration_sec if self.duration_sec is None else self.duration_sec
        for name, value in (("duration_sec", duration), ("period_sec", period_sec)):
            if not 0 < value < np.inf:
                raise ValueError(f"{name}: got {value}, expected a positive time [s]")
        if self.picture is not None:
            systems = len(shown_systems(diagram))
            if systems >= self._drawn:  # The richest, if several are run.
                draw_diagram(diagram, self.picture)
                self._drawn = systems
        self.started = True
        simulator = Simulator(diagram, context or diagram.CreateDefaultContext())
        root = simulator.get_mutable_context()
        simulator.set_target_realtime_rate(self.realtime)
        ports = []
        for name, port in record.items():
            if port.get_data_type() != PortDataType.kVectorValued:
                raise ValueError(f"record: {name} is an abstract port, expected vector")
            owner = cast(System, port.get_system())
            try:
                ports.append((name, port, owner.GetMyContextFromRoot(root)))
            except RuntimeError as error:
                raise ValueError(
                    f"record: {name} is a port of {owner.GetSystemName()}, "
                    "expected one of the diagram that is simulated"
                ) from error
        timed = [s for s in leaf_systems(diagram) if hasattr(s, "compute_sec")]
        for system in timed:
            system.compute_sec.clear()

        label = label or f"simulation_{len(self._timing)}" * bool(self._timing)
        time: list[float] = []
        samples: dict[str, list[np.ndarray]] = {name: [] for name in record}

        def sample(t: float) -> bool:
            values = {name: np.array(port.Eval(own)) for name, port, own in ports}
            time.append(t)
            for name, value in values.items():
                samples[name].append(value)
            return until is not None and bool(until(t, values))

        # The last chunk may be shorter; 1e-9 forgives duration/period's rounding.
        n_chunks = int(np.ceil(duration / period_sec - 1e-9))
        if self.meshcat is not None:
            # A long run has fewer pictures per second, so that the page stays light.
            fps = float(np.clip(3600 // duration, 10, 32))
            self.meshcat.DeleteRecording()  # Of an earlier simulation.
            self.meshcat.StartRecording(frames_per_second=fps)
        wall_start, cpu_start = perf_counter(), process_time()
        with _CatchInterrupt() as interrupt, self._bar(duration, label) as bar:
            try:
                simulator.Initialize()
                done = sample(root.get_time())
                for k in range(1, n_chunks + 1):
                    if done or interrupt.hit:
                        break
                    t = min(k * period_sec, duration)
                    simulator.AdvanceTo(t)
                    done = sample(t)
                    bar.update(t - bar.n)
            finally:
                self.interrupted = interrupt.hit
                wall, cpu = perf_counter() - wall_start, process_time() - cpu_start
                log = self._finish_log(
                    label, time, samples, interrupt.hit, root, diagram
                )
                self._time(label, log, wall, cpu, leaf_systems(diagram))
                if self.meshcat is not None:
                    self.meshcat.StopRecording()
                    self.meshcat.PublishRecording()
        return log

    def _bar(self, duration: float, label: str):
        tty = sys.stderr.isatty()
        return tqdm(
            total=duration,
            desc=label or "simulating",
            # The rate in simulated seconds per second is the real-time factor.
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s "
            "[{elapsed}<{remaining}, {rate_noinv_fmt}]",
            unit=" x real time",
            mininterval=0.2 if tty else 10.0,
            dynamic_ncols=tty,
            ncols=None if tty else 80,
            disable=not self._progress,
            leave=len(self._timing) < 5,  # Many simulations: one line, drawn over.
            file=sys.stderr,
        )

    def _finish_log(self, label, time, samples, interrupted, root, diagram) -> Log:
        columns = {}
        for name, rows in samples.items():
            columns[name] = np.array(rows[: len(time)], dtype=float)
        self._partial[label] = {"time": np.array(time)} | columns
        return Log(np.array(time), columns, interrupted, root, diagram)

    def _time(self, label: str, log: Log, wall: float, cpu: float, systems):
        """Notes the times of one simulation, for timing.json."""
        simulated = float(log.time[-1]) if log.time.size else 0.0
        entry: dict = {
            "simulated_s": simulated,
            "wall_s": wall,
            "cpu_s": cpu,
            "real_time_factor": simulated / wall,
            "systems": {},
        }
        for system in systems:
            ms = 1e3 * np.array(getattr(system, "compute_sec", ()))
            if ms.size:
                name = system.get_name()  # Unique in one diagram, not in nested ones.
                if name in entry["systems"]:
                    name = system.GetSystemPathname()
                entry["systems"][name] = {
                    "updates": int(ms.size),
                    "p50_ms": float(np.percentile(ms, 50)),
                    "p99_ms": float(np.percentile(ms, 99)),
                    "max_ms": float(ms.max()),
                }
        self._timing[label] = entry

    def save_plot(self, fig, name: str) -> Path:
        """Writes the matplotlib figure as <name>.png and closes it."""
        path = self.out_dir / f"{name.removesuffix('.png')}.png"
        fig.savefig(path, dpi=120, metadata={"Software": None})
        plt.close(fig)
        return self._wrote(path)

    def write_recording(
        self, columns: Mapping[str, np.ndarray], noise: Mapping | None = None
    ) -> Path:
        """Writes recording.csv, and noise.json where the noise is known.

        See gap/table.py for the columns' names.
        """
        written = write_recording(self.out_dir / "recording.csv", columns, noise)
        return [self._wrote(path) for path in written][0]

    def write_result(self, result: Mapping) -> Path:
        """Writes result.json: flat, keys in the order given, NaN and infinity as null.

        A value is a number, a text, a truth value or None, or a list of such (one per
        trial or per contact).

        Raises: ValueError for any other value, and if `success` is missing or no truth
            value.
        """
        plain = {str(key): json_value(value) for key, value in result.items()}
        for key, value in plain.items():
            for one in value if isinstance(value, list) else [value]:
                if not isinstance(one, bool | int | float | str | None):
                    raise ValueError(
                        f"result {key}: got {type(one).__name__}, expected a scalar or "
                        "a list of scalars"
                    )
        if not isinstance(plain.get("success"), bool):
            raise ValueError(
                f"result success: got {plain.get('success')}, expected True or False"
            )
        return self.write_json("result.json", plain)

    def write_json(self, name: str, value) -> Path:
        """Writes `value` as the JSON file `name`."""
        return self.write_text(
            name, json.dumps(value, indent=2, allow_nan=False) + "\n"
        )

    def write_text(self, name: str, text: str) -> Path:
        """Writes the text file `name`."""
        path = self.out_dir / name
        path.write_text(text)
        return self._wrote(path)

    def keep_partial(self) -> Path | None:
        """Writes partial.npz: all that was sampled, of a run that could not be scored.

        Returns: its path, or None if nothing was sampled.
        """
        arrays = {
            f"{label}.{name}" if label else name: value
            for label, columns in self._partial.items()
            for name, value in columns.items()
        }
        if not any(value.size for value in arrays.values()):
            return None
        path = self.out_dir / "partial.npz"
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        return self._wrote(path)

    def finish(self) -> list[Path]:
        """Writes timing.json and, where there is a Meshcat, meshcat.html.

        Returns: all files of the run.
        """
        if self._timing:
            self.write_json("timing.json", self._timing_summary())
        if self.meshcat is not None:
            self.write_text("meshcat.html", self.meshcat.StaticHtml())
        return self.files

    def _timing_summary(self) -> dict:
        """The whole run's sums, and each simulation's own figures where several ran."""
        entries = list(self._timing.values())
        total = {
            key: sum(e[key] for e in entries)
            for key in ("simulated_s", "wall_s", "cpu_s")
        }
        summary = {"real_time_factor": total["simulated_s"] / total["wall_s"]}
        summary["real_time_factor_cpu"] = total["simulated_s"] / total["cpu_s"]
        summary |= total
        if len(entries) == 1:
            return summary | {"systems": entries[0]["systems"]}
        return summary | {"simulations": self._timing}

    def _wrote(self, path: Path) -> Path:
        if path not in self.files:
            self.files.append(path)
        return path
