"""`makebreak export-tests`: regression tests of single systems, recorded from a run.

There is one file for each system. It builds that system alone, replays its recorded
inputs at its own period and offset, and compares its outputs, without plant or camera.
"""

import dataclasses
import importlib
import inspect
import pkgutil
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram, LeafSystem

import makebreak.systems
from makebreak.diagrams.station import make_control_plant
from makebreak.models.scene import Scene, read_scene
from makebreak.models.scene_file import scene_text
from makebreak.models.tip_and_ball import make_tip_and_ball
from makebreak.models.typed_yaml import nearest
from makebreak.scripts.runner.interrupts import undisturbed
from makebreak.scripts.runner.outputs import OutputFolder
from makebreak.scripts.runner.replay import Track, Unsupported
from makebreak.scripts.runner.run_timing import leaf_systems
from makebreak.scripts.runner.session import Log, Session
from makebreak.systems.arm.impedance_controller import serial_chain_of
from makebreak.systems.numerics.timing import observed

# Functions that make a plant, or constants of one, from which systems are built. Such
# an argument is written into the test as the call that made it.
MAKERS: tuple[Callable, ...] = (make_control_plant, make_tip_and_ball, serial_chain_of)
INLINE = 12  # Number of entries above which an array goes to the data file.


@dataclasses.dataclass(frozen=True)
class Call:
    """A call and its result."""

    function: Callable
    args: tuple
    kwargs: dict
    result: Any  # Kept alive, so that its id stays unique.


class _Done(Exception):
    """Raised when all systems that were asked for have been recorded."""


@contextmanager
def calls_kept() -> Iterator[dict[int, Call]]:
    """Context in which the calls that make systems and plants are kept, as
    {id(object): Call}."""
    made: dict[int, Call] = {}
    undo: list[tuple[Any, str, Any]] = []

    def replace(owner, name, new):
        undo.append((owner, name, getattr(owner, name)))
        setattr(owner, name, new)

    def keeping(cls, init):
        @wraps(init)
        def wrapper(self, *args, **kwargs):
            # Noted before the constructor runs, as it may change its arguments.
            made.setdefault(id(self), Call(cls, args, kwargs, self))
            init(self, *args, **kwargs)

        return wrapper

    def noting(function):
        @wraps(function)
        def wrapper(*args, **kwargs):
            result = function(*args, **kwargs)
            made[id(result)] = Call(function, args, kwargs, result)
            if type(result) is tuple:
                for part in result:
                    made[id(part)] = made[id(result)]
            return result

        return wrapper

    wrapped = {id(function): noting(function) for function in MAKERS}
    for module in _modules(makebreak.systems):
        for cls in vars(module).values():
            if inspect.isclass(cls) and issubclass(cls, LeafSystem):
                if cls.__module__ == module.__name__:
                    replace(cls, "__init__", keeping(cls, cls.__init__))
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("makebreak."):
            for name, value in list(vars(module).items()):
                if id(value) in wrapped and module.__name__ != __name__:
                    replace(module, name, wrapped[id(value)])
    try:
        yield made
    finally:
        for owner, name, old in reversed(undo):
            setattr(owner, name, old)


def _modules(package: ModuleType) -> list[ModuleType]:
    names = [
        info.name
        for info in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
    ]
    return [importlib.import_module(name) for name in names]


class _Source:
    """Python source for values: code, its imports, and arrays for the data file."""

    def __init__(self, made: dict[int, Call], folder: Path, place: Path):
        self.imports: set[tuple[str, str]] = set()
        self.arrays: dict[str, np.ndarray] = {}
        self._made, self._folder, self._place = made, folder, place

    def of_call(self, call: Call) -> str:
        parts = [self.of(value) for value in call.args]
        parts += [f"{name}={self.of(value)}" for name, value in call.kwargs.items()]
        return f"{self._named(call.function)}({', '.join(parts)})"

    def _named(self, thing) -> str:
        self.imports.add((thing.__module__, thing.__qualname__.partition(".")[0]))
        return thing.__qualname__

    def of(self, value) -> str:
        """The source of one value. Raises: Unsupported."""
        if id(value) in self._made and not isinstance(value, str | int | float):
            call = self._made[id(value)]
            code = self.of_call(call)
            if type(call.result) is tuple and value is not call.result:
                code += f"[{next(i for i, p in enumerate(call.result) if p is value)}]"
            return code
        if value is None or isinstance(value, bool | str):
            return repr(value)
        if isinstance(value, Path):
            return repr(str(value))
        if isinstance(value, int | float | np.number) and not hasattr(value, "name"):
            number = value.item() if isinstance(value, np.number) else value
            plain = np.isfinite(number)
            return repr(number) if plain else f'float("{number}")'
        if isinstance(value, np.ndarray):
            if value.size > INLINE:
                name = f"constant_{len(self.arrays)}"
                self.arrays[name] = value
                return f'DATA["{name}"]'
            self.imports.add(("numpy", ""))
            return f"np.array({value.tolist()!r})"
        if isinstance(value, Scene):
            return self._scene(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            parts = [
                f"{f.name}={self.of(getattr(value, f.name))}"
                for f in dataclasses.fields(value)
                if f.init and not _is_default(f, getattr(value, f.name))
            ]
            return f"{self._named(type(value))}({', '.join(parts)})"
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts = [
                f"{name}={self.of(getattr(value, name))}" for name in value._fields
            ]
            return f"{self._named(type(value))}({', '.join(parts)})"
        if isinstance(value, tuple):
            return f"({', '.join(map(self.of, value))}{',' * (len(value) == 1)})"
        if isinstance(value, list):
            return f"[{', '.join(map(self.of, value))}]"
        if isinstance(value, dict):
            pairs = (f"{self.of(k)}: {self.of(v)}" for k, v in value.items())
            return f"{{{', '.join(pairs)}}}"
        raise Unsupported(f"it is built with a {type(value).__name__}")

    def _scene(self, scene: Scene) -> str:
        """Writes a scene, with copies of its models, into a file beside the tests."""
        models = self._folder / "models"
        models.mkdir(exist_ok=True)
        scene = dataclasses.replace(scene, directives=deepcopy(scene.directives))
        for directive in scene.directives:
            if directive.add_model is not None:
                source = Path(directive.add_model.file.removeprefix("file://"))
                if source.is_file():
                    shutil.copyfile(source, models / source.name)
                    there = (self._place / "models" / source.name).resolve()
                    directive.add_model.file = f"file://{there}"
        text = scene_text(scene, self._place / "models")
        for i in range(1000):
            path = models / f"scene_{i}.yaml"
            if not path.exists() or path.read_text() == text:
                path.write_text(text)
                break
        self.imports.add((read_scene.__module__, "read_scene"))
        return f'read_scene(HERE / "models" / "{path.name}")'


def _is_default(f: dataclasses.Field, value) -> bool:
    if f.default is not dataclasses.MISSING:
        default = f.default
    elif f.default_factory is not dataclasses.MISSING:
        default = f.default_factory()
    else:
        return False
    try:
        return type(value) is type(default) and bool(value == default)
    except ValueError:  # An array has no single truth value.
        return False


class _Recorder:
    """Records inputs and outputs of the systems of one diagram at each update."""

    def __init__(
        self, diagram: Diagram, wanted: Sequence[str], seconds: float, initial: Context
    ):
        self.seconds = seconds
        self._initial = initial
        self.systems: dict[str, LeafSystem] = {}
        own = {s.get_name(): s for s in diagram.GetSystems()}
        for name in wanted or own:
            if isinstance(own.get(name), LeafSystem):
                self.systems[name] = own[name]
        self._names = {id(s): name for name, s in self.systems.items()}
        self.time: dict[str, list[float]] = {}
        self.tracks: dict[str, dict[str, dict[str, Track]]] = {}
        self.refused: dict[str, str] = {}

    def __call__(self, system, context) -> None:
        name = self._names.get(id(system))
        now = context.get_time()
        if name is None or name in self.refused or now > self.seconds:
            return
        if name not in self.tracks:
            self._start(name, system, system.GetMyContextFromRoot(self._initial))
        self._append(name, "in", system, context)
        self._append(name, "out", system, context)
        self.time[name].append(now)

    def _start(self, name, system, context) -> None:
        """Records the inputs of the initialization, before the first update."""
        self.time[name] = []
        self.tracks[name] = {"in": {}, "out": {}}
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if port.HasValue(context):
                self.tracks[name]["in"][port.get_name()] = Track()
        for i in range(system.num_output_ports()):
            self.tracks[name]["out"][system.get_output_port(i).get_name()] = Track()
        self._append(name, "in", system, context)

    def _append(self, name, way, system, context) -> None:
        get = system.GetInputPort if way == "in" else system.GetOutputPort
        try:
            for port, track in self.tracks[name][way].items():
                track.append(get(port).Eval(context))
        except Unsupported as error:
            self.refused[name] = f"a port carries {error}"


class _RecordingSession(Session):
    """A session that records its simulations until all wanted systems are recorded."""

    def __init__(self, out_dir: Path, wanted: Sequence[str], seconds: float):
        super().__init__(out_dir)
        self._wanted, self._seconds = list(wanted), seconds
        self.recorders: list[_Recorder] = []
        self.seen: set[str] = set()

    def simulate(self, diagram, duration_sec, record, *args, **kwargs) -> Log:
        self.seen |= {s.get_name() for s in leaf_systems(diagram)}
        # A simulation without a label is the only one of its run. Of several ones, the
        # later may have other systems and may depend on the end of the earlier.
        only = not kwargs.get("label")
        if only and not set(self._wanted) <= self.seen:
            raise _Done  # An unknown name is refused without a run.
        kwargs["context"] = kwargs.get("context") or diagram.CreateDefaultContext()
        initial = kwargs["context"].Clone()
        recorder = _Recorder(diagram, self._wanted, self._seconds, initial)
        self.recorders.append(recorder)
        if self._wanted or only:
            duration_sec = min(duration_sec, self._seconds)
        with observed(recorder):
            log = super().simulate(diagram, duration_sec, record, *args, **kwargs)
        if log.interrupted:
            raise KeyboardInterrupt
        there = {n for r in self.recorders for n in r.tracks}
        if only or (self._wanted and there >= set(self._wanted)):
            raise _Done
        return log


def export_tests(
    name: str,
    module: ModuleType,
    config,
    out: Path,
    wanted: Sequence[str] = (),
    seconds: float = 5.0,
    inputs: Sequence[str | Path] = (),
) -> tuple[dict[str, int], dict[str, str]]:
    """Runs the experiment's first seconds and writes a test of each system.

    Args:
        name, module, config: of the experiment.
        out: folder, which must not exist, be empty, or hold an earlier export.
        wanted: names of systems in the experiment's diagram, which then runs no longer
            than needed; empty: all systems with updates, where an experiment with
            several simulations runs to its end.
        seconds: simulated time that is recorded [s].
        inputs: files that `out` must not hold.
    Returns: {system: number of updates}, and {system: why it was left out}.
    Raises: ValueError for a folder in use, an unknown system, a wanted system that
        cannot be exported, an experiment that fails, or files that cannot be written.
        Then the folder is unchanged.
    """
    with OutputFolder(out, f"export-tests {name}", inputs, only_new=True) as outputs:
        folder = outputs.stage
        try:
            done, left_out = _export(name, module, config, folder, out, wanted, seconds)
        except OSError as error:
            raise ValueError(
                f'--out: "{out}" cannot be written: {error.strerror or error}'
            ) from error
        with undisturbed():
            outputs.commit()
    return done, left_out


def _export(name, module, config, folder: Path, place: Path, wanted, seconds):
    """Records a run and writes its tests into `folder`, to be moved to `place`."""
    with calls_kept() as made, TemporaryDirectory() as elsewhere:
        session = _RecordingSession(Path(elsewhere) / "run", wanted, seconds)
        try:
            module.run(config, session)
        except _Done:
            pass
        except OSError:
            raise
        except Exception as error:
            raise ValueError(
                f"{name} failed while it was recorded: {type(error).__name__}: "
                f"{' '.join(str(error).split())}"
            ) from error
        unknown = [w for w in wanted if w not in session.seen]
        if unknown:
            raise ValueError(
                f"--systems: {name} has no system {unknown[0]}; "
                f"{nearest(unknown[0], sorted(session.seen))}"
            )
        session.outputs.close()
        return _write(name, session.recorders, made, folder, place, wanted)


def _write(experiment, recorders, made, folder, place, wanted):
    done: dict[str, int] = {}
    left_out: dict[str, str] = {}
    for recorder in recorders:
        for system, reason in recorder.refused.items():
            left_out[system] = reason
        for system, tracks in recorder.tracks.items():
            if system in done or system in recorder.refused:
                continue
            source = _Source(made, folder, place)
            try:
                code = source.of_call(made[id(recorder.systems[system])])
            except Unsupported as error:
                left_out[system] = str(error)
                continue
            time = np.array(recorder.time[system])
            arrays: dict[str, np.ndarray] = {"time": time, **source.arrays}
            for way, plural in (("in", "inputs"), ("out", "outputs")):
                arrays[plural] = np.array(list(tracks[way]), dtype=np.str_)
                for port, track in tracks[way].items():
                    arrays |= track.arrays(f"{way}/{port}")
            with (folder / f"{system}.npz").open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
            text = _test_text(experiment, system, code, source, len(time), time[-1])
            (folder / f"test_{system}.py").write_text(text)
            done[system] = len(time)
    refused = [w for w in wanted if w not in done]
    if refused:
        reason = left_out.get(refused[0], "it has no periodic update")
        raise ValueError(f"--systems: {refused[0]} cannot be exported: {reason}")
    if not done:
        raise ValueError(f"{experiment} has no system that can be exported")
    return done, left_out


def _test_text(experiment, system, code, source, updates, last) -> str:
    imports: dict[str, set[str]] = {"makebreak.scripts.runner.replay": {"replay"}}
    for module, name in source.imports:
        if name:
            imports.setdefault(module, set()).add(name)
    lines = [
        f'"""{system} of {experiment}, alone: {updates} updates, to {last:.3f} s.',
        "",
        "Written by makebreak export-tests. A difference means that this system no",
        "longer does what it did; RTOL and ATOL of makebreak.scripts.runner.replay are",
        'the tolerance."""',
        "",
        "from pathlib import Path",
        "",
    ]
    if ("numpy", "") in source.imports or source.arrays:
        lines += ["import numpy as np", ""]
    for module in sorted(imports):
        lines.append(f"from {module} import {', '.join(sorted(imports[module]))}")
    lines += ["", "HERE = Path(__file__).resolve().parent"]
    if source.arrays:
        lines.append(f'DATA = np.load(HERE / "{system}.npz")')
    lines += [
        "",
        "",
        "def make_system():",
        f"    return {code}",
        "",
        "",
        f"def test_{system}_gives_what_it_gave():",
        f'    assert replay(make_system(), HERE / "{system}.npz") == {updates}',
        "",
    ]
    return "\n".join(lines)
