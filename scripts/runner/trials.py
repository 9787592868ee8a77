"""Runs many trials of an experiment in parallel, each in a process of its own: on the
cores of this machine, or with joblib on a Dask or Ray cluster."""

import gc
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from hashlib import sha256
from pathlib import Path

from tqdm import tqdm

import makebreak
from makebreak.scripts.experiments import load_experiment
from makebreak.scripts.runner.interrupts import interrupts
from makebreak.scripts.runner.parent import PARENT
from makebreak.scripts.runner.settings import apply_settings, dump_config
from makebreak.scripts.runner.shown import is_quiet

_COMMAND = (sys.executable, "-m", "makebreak")
_LATE = "late"  # Instead of an exit status: the time limit was exceeded.
_PATIENCE_SEC = 3.0  # Time from SIGTERM to SIGKILL.
# Files of a run that a cluster's worker returns; recording and plots stay there.
_SENT_BACK = ("result.json", "config.yaml", "timing.json", "log.txt", "error.txt")


def setting_texts(settings: Mapping) -> list[str]:
    """The arguments of --set for {field: value}."""
    return [
        f"{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in settings.items()
    ]


def config_text(experiment: str, settings: Sequence[str], seed: int | None) -> str:
    """The config.yaml that a run with these settings writes."""
    config = apply_settings(load_experiment(experiment).Config(), settings)
    if seed is not None:
        config = apply_settings(config, [f"seed={seed}"])
    return dump_config(config)


def _folder(settings: Mapping, seed: int) -> str:
    """A folder name from the settings and the seed of a run."""
    texts = [re.sub(r"[^\w.=+-]", "", text) for text in setting_texts(settings)]
    name = "_".join([*texts, f"seed={seed}"])
    if len(name) > 120:  # Shortened, with a hash to keep it unique.
        name = f"{name[:110]}_{sha256(name.encode()).hexdigest()[:8]}"
    return name


def run_environment() -> dict[str, str]:
    """Environment variables of a trial: one thread, this package on the path, and an
    end when this process ends."""
    env = dict(os.environ)
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        env[f"{name}_NUM_THREADS"] = "1"
    root = str(Path(makebreak.__file__).resolve().parent.parent)
    env["PYTHONPATH"] = os.pathsep.join(filter(None, [root, env.get("PYTHONPATH")]))
    env[PARENT] = str(os.getpid())
    return env


def _read(folder: Path, status: int | None) -> dict:
    """The result of a run that has ended, or an error with its last line on stderr."""
    if status in (0, 1):
        try:
            return json.loads((folder / "result.json").read_text())
        except (OSError, ValueError):
            pass
    try:
        log = (folder / "log.txt").read_text(errors="replace")
    except OSError:
        log = ""
    lines = [line.strip() for line in re.split(r"[\r\n]+", log) if line.strip()]
    error = lines[-1] if lines else "no output"
    if status is not None and status < 0:
        ended = f"killed by {signal.Signals(-status).name}"
    else:
        ended = f"exit status {status}"
    return {"success": False, "error": f"{ended}: {error}"}


def run_many(
    experiment: str,
    runs: Sequence[tuple[Mapping, int]],
    jobs: int,
    out_dir: Path,
    duration: float | None = None,
    reuse: bool = False,
    command: Sequence[str] = (),
    cluster: str | None = None,
) -> list[dict]:
    """Runs `makebreak run experiment` once per (settings, seed), `jobs` at a time.

    A run that fails is reported and does not stop the others. Ctrl-C, SIGTERM or SIGHUP
    ends all of them.

    Args:
        experiment: its name.
        runs: ({field: value}, seed) of each run.
        jobs: number of parallel runs.
        out_dir: each run's files go to a subfolder named after its settings.
        duration: overrides the duration of the experiment [s].
        reuse: whether completed runs in out_dir with the same settings and duration are
            read instead of repeated.
        command: that starts makebreak; empty: this interpreter with -m makebreak.
        cluster: as in run_commands.
    Returns: the result.json of each run, with `seed` and `out_dir` added; for a failed
        run `success` False and `error`, the last line that it printed.
    Raises: ValueError if jobs is below 1 or two runs are the same.
    """
    if jobs < 1:
        raise ValueError(f"jobs: got {jobs}, expected 1 or more")
    folders = [Path(out_dir) / _folder(settings, seed) for settings, seed in runs]
    for i, folder in enumerate(folders):
        if folder in folders[:i]:
            raise ValueError(f"runs: {folder.name} is there twice, expected once")
    texts = [setting_texts(settings) for settings, _ in runs]
    commands = []
    for folder, text, (_, seed) in zip(folders, texts, runs, strict=True):
        args = [*(command or _COMMAND), "run", experiment, "--no-meshcat"]
        args += ["--seed", str(seed), "--out", str(folder)]
        args += [a for one in text for a in ("--set", one)]
        if duration is not None:
            args += ["--duration", repr(float(duration))]
        commands.append(args)

    def is_done(i: int) -> bool:
        seed = runs[i][1]
        return reuse and _is_done(folders[i], experiment, texts[i], seed, duration)

    results = run_commands(
        experiment, commands, folders, jobs, is_done, cluster=cluster
    )
    return [
        {**result, "seed": seed, "out_dir": str(folder)}
        for result, (_, seed), folder in zip(results, runs, folders, strict=True)
    ]


def makebreak_command(*words: str) -> list[str]:
    """The command `makebreak WORDS` for this interpreter."""
    return [*_COMMAND, *words]


def run_commands(
    label: str,
    commands: Sequence[Sequence[str]],
    folders: Sequence[Path],
    jobs: int,
    is_done: Callable[[int], bool] = lambda i: False,
    ended: Callable[[int, dict], None] = lambda i, result: None,
    limit_sec: float = math.inf,
    cluster: str | None = None,
) -> list[dict]:
    """Runs commands, `jobs` at a time, each of which writes a result.json.

    Each has one thread and writes its output to log.txt in its folder; its files are
    there as soon as it ends. One that fails is reported and does not stop the others.
    All are ended by Ctrl-C, SIGTERM, SIGHUP, and when this process ends in any way.

    Args: label: of the progress bar; is_done(i): whether the folder has the result
        already; ended(i, result): called after each; limit_sec: time limit of a command
        [s], after which it has failed; cluster: address of a Dask scheduler
        (tcp://HOST:PORT), or of a Ray cluster that this machine belongs to
        (ray:HOST:PORT), whose workers then run the commands, one in each thread.
    Returns: the result.json of each command; for a failed one `success` False and
        `error`, its exit status and the last line that it printed.
    Raises: ValueError for a cluster that cannot be reached.
    """
    results: list[dict] = [{} for _ in commands]
    running = _Running()
    # What an earlier run left is destroyed here: Drake ends the process if one of the
    # threads below does that with a Meshcat.
    gc.collect()

    try:
        with (
            interrupts(),
            tqdm(
                total=len(commands),
                desc=label,
                unit="run",
                file=sys.stderr,
                disable=is_quiet(),
            ) as bar,
            _workers(cluster, jobs) as parallel,
        ):
            waiting: list[tuple] = []
            for i, (command, folder) in enumerate(zip(commands, folders, strict=True)):
                if is_done(i):
                    results[i] = _read(folder, 0)
                    ended(i, results[i])
                    bar.update()
                    continue
                folder.mkdir(parents=True, exist_ok=True)
                if cluster is None:
                    task = partial(running.run, i, command, folder, limit_sec)
                else:
                    far = _portable(command, folder)
                    task = partial(_run_far, i, far, limit_sec)
                waiting.append((task, (), {}))  # As joblib.delayed has it.
            for i, status, files in parallel(waiting):
                for name, content in files.items():
                    (folders[i] / name).write_bytes(content)
                if status == _LATE:
                    error = f"stopped after {limit_sec:.0f} s"
                    result = {"success": False, "error": error}
                else:
                    result = _read(folders[i], status)
                results[i] = result
                ended(i, result)
                if "error" in result:
                    bar.write(f"{folders[i].name}: {result['error']}", sys.stderr)
                bar.update()
    finally:
        running.end()
    return results


def _written(folder: Path) -> int:
    """Modification time of result.json [ns]; 0 without one."""
    try:
        return (folder / "result.json").stat().st_mtime_ns
    except OSError:
        return 0


class _Running:
    """The processes on this machine, each of which a thread waits for."""

    def __init__(self):
        self._processes: set[subprocess.Popen] = set()
        self._lock, self._ended = threading.Lock(), False

    def run(self, i: int, command: Sequence[str], folder: Path, limit_sec: float):
        """Runs one command. Returns: i, the exit status, and {}, as the files are in
        the folder already (_run_far returns them)."""
        before = _written(folder)
        with (folder / "log.txt").open("wb") as log:
            with self._lock:
                if self._ended:
                    return i, None, {}
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=run_environment(),
                    start_new_session=True,  # So that Ctrl-C reaches only this process.
                )
                self._processes.add(process)
            status: int | str | None
            try:
                status = process.wait(None if limit_sec == math.inf else limit_sec)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                status = _LATE
            with self._lock:
                self._processes.discard(process)
        if status in (0, 1) and _written(folder) == before:
            status = None  # The result.json is that of an earlier run.
        return i, status, {}

    def end(self):
        """Ends all processes, and lets no more start."""
        with self._lock:
            self._ended = True
            left = list(self._processes)
        for process in left:
            process.terminate()
        end = time.monotonic() + _PATIENCE_SEC
        for process in left:
            try:
                process.wait(max(end - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


_OUT, _PYTHON = "<out>", "<python>"


def _portable(command: Sequence[str], folder: Path) -> list[str]:
    """The command without paths of this machine's folder and interpreter."""
    own = {str(folder): _OUT, sys.executable: _PYTHON}
    return [own.get(word, word) for word in command]


def _run_far(i: int, command: Sequence[str], limit_sec: float):
    """Runs on a cluster's worker. Returns: i, the exit status, {file name: content}."""
    with tempfile.TemporaryDirectory() as folder:
        own = {_OUT: folder, _PYTHON: sys.executable}
        there = [own.get(word, word) for word in command]
        _, status, _ = _Running().run(i, there, Path(folder), limit_sec)
        paths = [Path(folder) / name for name in _SENT_BACK]
        return i, status, {p.name: p.read_bytes() for p in paths if p.exists()}


@contextmanager
def _workers(cluster: str | None, jobs: int):
    """A joblib Parallel that yields results as they come.

    Raises: ValueError if the cluster or its library is not available.
    """
    import joblib  # Here, as it takes long to import.

    now = dict(return_as="generator_unordered", batch_size=1)
    if cluster is None:
        # Threads suffice, as they only wait for processes.
        yield joblib.Parallel(n_jobs=jobs, backend="threading", **now)
        return
    kind, close = _connect(cluster)
    try:
        with joblib.parallel_config(backend=kind):
            yield joblib.Parallel(n_jobs=-1, **now)
    finally:
        close()


def _connect(cluster: str) -> tuple[str, Callable[[], object]]:
    """The name of joblib's backend for a cluster, and a function that disconnects."""
    if cluster.startswith(("tcp://", "tls://")):
        extra, address = "dask", cluster
    elif cluster.startswith("ray:") and not cluster.startswith("ray:/"):
        extra, address = "ray", cluster[len("ray:") :]
    else:
        raise ValueError(
            f'--cluster: got "{cluster}", expected tcp://HOST:PORT (Dask) or '
            "ray:HOST:PORT (Ray, on a machine of the cluster)"
        )
    host, _, port = address.rpartition(":")
    try:
        # Tested first, as Ray would try for minutes and then end the process.
        socket.create_connection((host.split("//")[-1], int(port)), 10.0).close()
    except (OSError, ValueError) as error:
        raise ValueError(f"--cluster: {cluster} not reached: {error}") from error
    try:
        if extra == "dask":
            from distributed import Client

            client = Client(address, timeout="10s")
            return "dask", client.close
        import ray
        from ray.util.joblib import register_ray
        from ray.util.joblib.ray_backend import RayBackend

        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        register_ray()
        # joblib assumes that pools of processes return all results together, but Ray's
        # pool calls back for each of them.
        RayBackend.supports_return_generator = True
        return "ray", ray.shutdown
    except ImportError as error:
        raise ValueError(
            f"--cluster: {cluster} needs {error.name}: pip install makebreak[{extra}]"
        ) from error
    except (OSError, TimeoutError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"--cluster: {cluster} not reached: {reason}") from error


def duration_line(duration: float | None) -> str:
    """The first line of config.yaml, a comment that records --duration."""
    return f"# duration_sec: {'default' if duration is None else float(duration)}\n"


def _is_done(folder: Path, experiment: str, texts, seed, duration) -> bool:
    """Whether the folder holds the result of the same run."""
    try:
        text = (folder / "config.yaml").read_text()
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return False
    same = text == duration_line(duration) + config_text(experiment, texts, seed)
    return same and not result.get("interrupted")
