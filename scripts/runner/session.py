"""One run of an experiment: simulates, records, and writes the files of the run."""

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, cast

import matplotlib

matplotlib.use("Agg")  # Pictures go to files; no display is needed.

import matplotlib.pyplot as plt
import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    Context,
    Diagram,
    OutputPort,
    PortDataType,
    System,
)
from tqdm import tqdm

from makebreak.gap.data.table import write_recording
from makebreak.models.scene import Scene, apply_initial_velocities
from makebreak.models.scene_file import write_scene
from makebreak.scripts.runner.compiling import CompilingShown
from makebreak.scripts.runner.diagram_picture import draw_diagram, shown_systems
from makebreak.scripts.runner.interrupts import CatchInterrupt, undisturbed
from makebreak.scripts.runner.meshcat_page import page_of
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.recording_stream import RecordingStream
from makebreak.scripts.runner.run_buttons import RunButtons
from makebreak.scripts.runner.run_timing import RunTiming, leaf_systems
from makebreak.scripts.runner.shown import is_quiet
from makebreak.scripts.runner.table import json_value
from makebreak.scripts.runner.trials import run_many
from makebreak.systems.faults.safety_monitor import verdict
from makebreak.systems.numerics.first_calls import deferred
from makebreak.systems.views.legend import Legend

__all__ = ["Log", "Session", "run_many"]

MODEL = "model.yaml"


@dataclass(frozen=True, eq=False)
class Log(Mapping):
    """The samples of one simulation: `log[column]` is (n, k), a row per sample."""

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


class Session:
    """Simulates an experiment's diagrams, records them, and writes the run's files.

    Files are written into a hidden folder; `finish` moves them to out_dir. For a
    `with`, which deletes files that were not moved (outputs.OutputFolder). Systems that
    are made inside it are compiled when they are simulated, with the scene already in
    Meshcat.

    Args:
        out_dir: the folder of the run's files; made if it is missing.
        meshcat: the viewer; None: no viewer, and no meshcat.html.
        duration_sec: replaces the experiment's own duration, if given [s].
        realtime: the fastest that simulated time may pass, in simulated seconds per
            second; 0: as fast as possible.
        progress: whether a progress bar is shown.
        reuse: whether results of complete trials of an earlier session with the same
            settings are kept; pass it on to run_many.
        command: that writes in the folder, such as "run ball_rolling".
        inputs: files that the command reads.
    Raises: ValueError for an out_dir that cannot be made or written to, or that holds
        files which this command did not write.
    """

    def __init__(
        self,
        out_dir: Path,
        meshcat: Meshcat | None = None,
        duration_sec: float | None = None,
        realtime: float = 0.0,
        progress: bool = True,
        reuse: bool = False,
        command: str = "run",
        inputs: Iterable[str | Path] = (),
    ):
        self.out_dir = Path(out_dir)
        self.outputs = OutputFolder(out_dir, command, inputs)
        self.meshcat = meshcat
        self.duration_sec = duration_sec
        self.realtime = realtime
        self.reuse = reuse
        self.unwritten: OSError | None = None  # Why a file could not be written.
        self._figures: list[tuple[Any, str]] = []  # Written by `finish`, last.
        self.started = False  # Whether anything has been simulated yet.
        self.interrupted = False
        self.restarts = False  # Whether StartOver is caught, and the run begun again.
        self.on_first_compile: Callable[[], None] = lambda: None
        self.endings: list[str] = []  # Why simulations ended early.
        self.first_calls: list[Callable[[], object]] = []  # They compile, later.
        self._deferred = deferred()
        self._progress = progress
        self.picture: Path | None = None  # File for a drawing of the diagram.
        self._drawn = 0  # Number of systems in the diagram drawn so far.
        self._partial: dict[str, dict[str, np.ndarray]] = {}
        self._timing = RunTiming()
        self._streams: list[Path] = []  # Recordings that are written while it runs.
        self._watched: list[np.ndarray] = []  # Output of each simulation's monitor.
        self.recorded: Mapping[str, np.ndarray] = {}  # Columns of recording.csv.
        self.compared_by = ""  # The command that compares recording and model.
        # Of plots by name, and whether there is an animation: the text of report.html.
        self.report: Callable[[Mapping[str, bytes], bool], str] | None = None

    def child(self, name: str) -> "Session":
        """A session for one of several trials, in the subfolder `name`."""
        return Session(
            self.out_dir / name,
            duration_sec=self.duration_sec,
            progress=self._progress,
            reuse=self.reuse,
            command=f"{self.outputs.command} {name}",
        )

    def simulate(
        self,
        diagram: Diagram,
        duration_sec: float,
        record: Mapping[str, OutputPort],
        period_sec: float = 0.0125,
        until: Callable[[float, dict[str, np.ndarray]], bool | str] | None = None,
        label: str = "",
        context: Context | None = None,
    ) -> Log:
        """Simulates the diagram and samples its ports, from time 0.

        Samples are taken at multiples of period_sec from time 0 on, each before the
        events of that time. Ctrl-C, or the button `stop` in Meshcat, ends the
        simulation at the next sample; the log has everything until then. The button
        `start over`, if `restarts` is set, raises StartOver.

        Args:
            diagram: what is simulated.
            duration_sec: for how long, unless the session's own duration is set [s].
            record: {column: vector output port of the diagram or a system in it}.
            period_sec: time between samples [s].
            until: called with the time and {column: (k,)} at each sample; the
                simulation ends when it returns True, or a text that says why.
            label: name of one of several simulations of a run, in timing.json and on
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
        if context is None:
            context = diagram.CreateDefaultContext()
            apply_initial_velocities(diagram, context)
        simulator = Simulator(diagram, context)
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
        RunTiming.start(diagram)
        label = label or f"simulation_{len(self._timing)}" * bool(self._timing)
        name = f"recording_{label}.csv" if label else "recording.csv"
        stream = RecordingStream(self.outputs.file(name), diagram)
        self._streams.append(stream.path)
        time: list[float] = []
        samples: dict[str, list[np.ndarray]] = {name: [] for name in record}

        def sample(t: float) -> bool | str:
            values = {name: np.array(port.Eval(own)) for name, port, own in ports}
            time.append(t)
            for name, value in values.items():
                samples[name].append(value)
            return until(t, values) if until is not None else False

        if self.meshcat is not None:  # Something to see while functions are compiled.
            _show_scene(diagram, root)
        # The last chunk may be shorter; 1e-9 forgives duration/period's rounding.
        n_chunks = int(np.ceil(duration / period_sec - 1e-9))
        if self.meshcat is not None:
            # A long run has fewer pictures per second, so that the page stays light.
            fps = float(np.clip(3600 // duration, 10, 32))
            self.meshcat.DeleteRecording()  # Of an earlier simulation.
            self.meshcat.StartRecording(frames_per_second=fps)
        with (
            CatchInterrupt() as interrupt,
            RunButtons(self.meshcat, self.restarts) as buttons,
            self._bar(duration, label) as bar,
            CompilingShown(
                partial(_tell, bar, diagram), self.on_first_compile
            ) as compiling,
        ):
            parts = len(self.first_calls)
            while self.first_calls and not interrupt.hit:
                compiling.of = parts - len(self.first_calls) + 1, parts
                self.first_calls.pop(0)()
            compiling.of = None
            # Compiling, or reading what was compiled, is none of the simulation's time.
            wall_start, cpu_start = perf_counter(), process_time()
            try:
                simulator.Initialize()
                done = sample(root.get_time())
                for k in range(1, n_chunks + 1):
                    if (done or interrupt.hit) and time[-1] < duration:
                        break
                    t = min(k * period_sec, duration)
                    simulator.AdvanceTo(t)
                    done = sample(t)
                    stream.tick(root)
                    bar.update(t - bar.n)
                    # Not `|=`: a Ctrl-C while it is asked would be overwritten.
                    if buttons.stopped(
                        lambda: interrupt.hit, simulator.ResetStatistics
                    ):
                        interrupt.hit = True
                if (done or interrupt.hit) and time[-1] < duration:
                    why = "interrupted" if interrupt.hit else done
                    self.endings.append(_ending(label, time[-1], duration, why))
            finally:
                self.interrupted = interrupt.hit
                wall = perf_counter() - wall_start - buttons.waited_sec
                cpu = process_time() - cpu_start
                stream.catch_up(root, ended=True)
                log = self._finish_log(
                    label, time, samples, interrupt.hit, root, diagram
                )
                simulated = float(log.time[-1]) if log.time.size else 0.0
                self._timing.note(label, diagram, simulated, wall, cpu)
                self._note_limits(diagram, root)
                if self.meshcat is not None:
                    self.meshcat.StopRecording()
                    self.meshcat.PublishRecording()
                self.interrupted |= interrupt.hit  # During what is above.
        return log

    def _bar(self, duration: float, label: str):
        tty = sys.stderr.isatty()
        return tqdm(
            total=duration,
            desc=label or "simulating",
            # The rate in simulated seconds per second is the real-time factor.
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.1f}/{total:.1f} s "
            "[{elapsed}<{remaining}, {rate_noinv_fmt}{postfix}]",
            unit=" x real time",
            mininterval=0.2 if tty else 10.0,
            dynamic_ncols=tty,
            ncols=None if tty else 80,
            disable=is_quiet() or not self._progress,
            leave=len(self._timing) < 5,  # Many simulations: one line, drawn over.
            file=sys.stderr,
        )

    def _finish_log(self, label, time, samples, interrupted, root, diagram) -> Log:
        columns = {}
        for name, rows in samples.items():
            columns[name] = np.array(rows[: len(time)], dtype=float)
        self._partial[label] = {"time": np.array(time)} | columns
        return Log(np.array(time), columns, interrupted, root, diagram)

    def too_slow(self) -> list[str]:
        """A line for each system that would not keep real time on this machine."""
        return self._timing.too_slow()

    def _note_limits(self, diagram: Diagram, root: Context) -> None:
        if not diagram.HasSubsystemNamed("station"):
            return
        # Here: it takes long to import, and not every diagram has one.
        from makebreak.diagrams.station import MONITOR

        station = diagram.GetSubsystemByName("station")
        if station.HasOutputPort(MONITOR):
            seen = station.GetOutputPort(MONITOR).Eval(
                station.GetMyContextFromRoot(root)
            )
            self._watched.append(np.array(seen))

    def limits_kept(self) -> dict:
        """The worst values of the arm's monitors in all simulations, as part of a
        result; empty if there was no monitor."""
        if not self._watched:
            return {}
        seen = [verdict(worst) for worst in self._watched]
        return {
            "limits_kept": all(each.kept for each in seen),
            "torque_share_max": max(each.torque_share for each in seen),
            "torque_rate_share_max": max(each.torque_rate_share for each in seen),
            "joint_speed_share_max": max(each.speed_share for each in seen),
            "joint_range_excess_rad": max(each.position_excess for each in seen),
            "ticks_not_finite": sum(each.not_finite for each in seen),
            "first_violation_s": [each.first_violation_s for each in seen],
        }

    def start_over(self) -> None:
        """Discards all simulations so far, and clears Meshcat."""
        self._drop_streams()
        for of_a_run in (
            self.endings, self._figures, self._partial, self._timing, self._watched,
        ):  # fmt: skip
            of_a_run.clear()
        self.first_calls.clear()
        if self.meshcat is not None:
            for path in ("", "/makebreak"):  # Drake's, and what our views draw.
                self.meshcat.Delete(path)
            self.meshcat.DeleteAddedControls()

    def save_plot(self, fig, name: str) -> None:
        """Keeps the matplotlib figure; `finish` writes it as <name>.png and closes it.
        Plots come last, so that a full disk loses them first."""
        self._figures.append((fig, f"{name.removesuffix('.png')}.png"))

    def path(self, name: str) -> Path:
        """The path to write a file of another kind to, before `finish`."""
        return self.outputs.file(name)

    def write_recording(
        self,
        columns: Mapping[str, np.ndarray],
        scene: Scene | None = None,
        noise: Mapping | None = None,
    ) -> None:
        """Writes recording.csv, noise.json if the noise is known, and the controllers'
        scene as model.yaml, for `makebreak gap` to compare with the recording.

        See gap/data/table.py for the columns' names. Replaces the recording that was
        written during the simulation.
        """
        self._drop_streams()
        self.recorded = columns
        self._write("recording.csv", lambda path: write_recording(path, columns, noise))
        if scene is not None:
            says = "The controllers' model."
            place = self.out_dir
            self._write(MODEL, lambda path: write_scene(scene, path, says, place=place))
            files = (self.out_dir / name for name in (MODEL, "recording.csv"))
            self.compared_by = " ".join(["makebreak gap", *map(str, files)])

    def _drop_streams(self) -> None:
        while self._streams:
            self._streams.pop().unlink(missing_ok=True)

    def write_result(self, result: Mapping) -> None:
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
        self.write_json("result.json", plain)

    def write_json(self, name: str, value) -> None:
        """Writes `value` as the JSON file `name`."""
        self.write_text(name, json.dumps(value, indent=2, allow_nan=False) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Writes the text file `name`."""
        self._write(name, lambda path: path.write_text(text))

    def _write(self, name: str, write: Callable[[Path], object]) -> None:
        """Writes a file; if that fails, as on a full disk, sets `unwritten` and goes on
        without it, since there may be room for other files."""
        path = self.outputs.file(name)
        try:
            write(path)
        except OSError as error:
            path.unlink(missing_ok=True)
            self.unwritten = error

    def keep_partial(self) -> bool:
        """Writes partial.npz, the samples of a run that could not be scored.

        Returns: whether there were any samples.
        """
        arrays = {
            f"{label}.{name}" if label else name: value
            for label, columns in self._partial.items()
            for name, value in columns.items()
        }
        if not any(value.size for value in arrays.values()):
            return False

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

        self._write("partial.npz", write)
        return True

    def finish(self, complete: bool = True) -> list[Path]:
        """Writes timing.json, the plots, where there is a Meshcat meshcat.html, and
        report.html if there is something to tell, and moves all files to the session's
        folder.

        Args: complete: False keeps an older, complete result that is in the folder.
        Returns: all files of the run.
        """
        with undisturbed():
            if self._timing:
                self.write_json("timing.json", self._timing.summary())
            if complete:
                self._drop_streams()
            try:
                for fig, name in self._figures:
                    self._write(name, partial(_save_figure, fig))
                if self.meshcat is not None:
                    self.meshcat.DeleteAddedControls()  # A page cannot answer them.
                    self.write_text("meshcat.html", page_of(self.meshcat))
                if self.report is not None:
                    plots = [(n, self.outputs.file(n)) for _, n in self._figures]
                    shown = {n: p.read_bytes() for n, p in plots if p.is_file()}
                    moving = self.meshcat is not None
                    self.write_text("report.html", self.report(shown, moving))
            finally:  # A plot that fails does not lose the result.
                files = self.outputs.commit(complete)
            return files

    def __enter__(self) -> "Session":
        self.first_calls = self._deferred.__enter__()
        return self

    def __exit__(self, *_) -> None:
        self._deferred.__exit__(None, None, None)
        self.outputs.close()


def _show_scene(diagram: Diagram, root: Context) -> None:
    """Sends the scene as it stands to Meshcat, before anything is simulated."""
    for system in leaf_systems(diagram):
        if isinstance(system, MeshcatVisualizer):
            system.ForcedPublish(system.GetMyContextFromRoot(root))


def _tell(bar: tqdm, diagram: Diagram, text: str) -> None:
    """Shows on the progress bar and in the diagram's legend what is being compiled, ""
    for nothing."""
    for system in leaf_systems(diagram):
        if isinstance(system, Legend):
            system.note(text)
    bar.set_postfix_str(text, refresh=False)
    if sys.stderr.isatty():
        bar.refresh()
    else:
        bar.update(0)  # At most every 10 s.


def _ending(label: str, time: float, duration: float, why: bool | str) -> str:
    """A sentence that says when and why a simulation ended early."""
    after = f"{f'{label} ' * bool(label)}ended at {time:.4g} s of {duration:.4g} s"
    return f"{after}: {why}" if isinstance(why, str) else after


def _save_figure(fig, path: Path) -> None:
    fig.savefig(path, dpi=120, metadata={"Software": None})
    plt.close(fig)
