"""Runs one experiment many times, each in a process of its own, several at once."""

import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path

from tqdm import tqdm

import makebreak
from makebreak.scripts.experiments import load_experiment
from makebreak.scripts.interrupts import interrupts
from makebreak.scripts.settings import apply_settings, dump_config

_COMMAND = (sys.executable, "-m", "makebreak")
_PATIENCE_SEC = 3.0  # For runs that are to end; then they are killed.


def setting_texts(settings: Mapping) -> list[str]:
    """{field: value} as the texts that follow --set."""
    return [
        f"{key}={value if isinstance(value, str) else json.dumps(value)}"
        for key, value in settings.items()
    ]


def config_text(experiment: str, settings: Sequence[str], seed: int | None) -> str:
    """The config.yaml that a run of these settings writes."""
    config = apply_settings(load_experiment(experiment).Config(), settings)
    if seed is not None:
        config = apply_settings(config, [f"seed={seed}"])
    return dump_config(config)


def _folder(settings: Mapping, seed: int) -> str:
    """A folder name that tells what was run."""
    texts = [re.sub(r"[^\w.=+-]", "", text) for text in setting_texts(settings)]
    name = "_".join([*texts, f"seed={seed}"])
    if len(name) > 120:  # Cut, and told apart by what was cut off.
        name = f"{name[:110]}_{sha256(name.encode()).hexdigest()[:8]}"
    return name


def _environment() -> dict[str, str]:
    """One thread per process, and this very package on the path."""
    env = dict(os.environ)
    for name in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        env[f"{name}_NUM_THREADS"] = "1"
    root = str(Path(makebreak.__file__).resolve().parent.parent)
    env["PYTHONPATH"] = os.pathsep.join(filter(None, [root, env.get("PYTHONPATH")]))
    return env


def _read(folder: Path, status: int | None) -> dict:
    """The result of a run that has ended, or what its last line on stderr says."""
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
    return {"success": False, "error": f"exit status {status}: {error}"}


def run_many(
    experiment: str,
    runs: Sequence[tuple[Mapping, int]],
    jobs: int,
    out_dir: Path,
    duration: float | None = None,
    reuse: bool = False,
    command: Sequence[str] = (),
) -> list[dict]:
    """Runs `makebreak run experiment` once per (settings, seed), `jobs` at a time.

    A run that fails is reported and does not stop the others. Ctrl-C, SIGTERM or SIGHUP
    ends all of them.

    Args:
        experiment: its name.
        runs: ({field: value}, seed) of each run.
        jobs: how many run at once.
        out_dir: each run's files go to a subfolder, named after its settings.
        duration: overrides the experiment's own [s].
        reuse: whether a run that has already ended there, with the same settings and
            duration, is read instead of repeated.
        command: what starts makebreak; empty: this interpreter with -m makebreak.
    Returns: per run its result.json with `seed` and `out_dir` added; of a failed one
        `success` False and `error`, the last line that it printed.
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

    results = run_commands(experiment, commands, folders, jobs, is_done)
    return [
        {**result, "seed": seed, "out_dir": str(folder)}
        for result, (_, seed), folder in zip(results, runs, folders, strict=True)
    ]


def makebreak_command(*words: str) -> list[str]:
    """What starts `makebreak WORDS` in this interpreter."""
    return [*_COMMAND, *words]


def run_commands(
    label: str,
    commands: Sequence[Sequence[str]],
    folders: Sequence[Path],
    jobs: int,
    is_done: Callable[[int], bool] = lambda i: False,
    ended: Callable[[int, dict], None] = lambda i, result: None,
    limit_sec: float = math.inf,
) -> list[dict]:
    """Runs commands that each write result.json into a folder, `jobs` at a time, with
    one thread each and their output in the folder's log.txt. Ctrl-C, SIGTERM or SIGHUP
    ends all of them; one that fails is reported and does not stop the others.

    Args: label, of the progress bar; is_done(i): whether the folder has the result
        already; ended(i, result): called as each has ended; limit_sec: after so long
        [s] a command is stopped, and has failed.
    Returns: per command its result.json; of a failed one `success` False and `error`,
        the last line that it printed.
    """
    results: list[dict] = [{} for _ in commands]
    waiting = list(range(len(commands)))
    running: dict[int, subprocess.Popen] = {}
    started: dict[int, float] = {}
    env = _environment()

    before: dict[int, int] = {}  # When the folder's earlier result was written.
    try:
        with (
            interrupts(),
            tqdm(total=len(commands), desc=label, unit="run", file=sys.stderr) as bar,
        ):
            while waiting or running:
                while waiting and len(running) < jobs:
                    i = waiting.pop(0)
                    if is_done(i):
                        results[i] = _read(folders[i], 0)
                        ended(i, results[i])
                        bar.update()
                        continue
                    folders[i].mkdir(parents=True, exist_ok=True)
                    before[i] = _written(folders[i])
                    with (folders[i] / "log.txt").open("wb") as log:
                        running[i] = subprocess.Popen(
                            commands[i],
                            stdin=subprocess.DEVNULL,
                            stdout=log,
                            stderr=subprocess.STDOUT,
                            env=env,
                            start_new_session=True,  # Ctrl-C reaches us alone.
                        )
                    started[i] = time.monotonic()
                for i, process in list(running.items()):
                    status: int | None = process.poll()
                    late = time.monotonic() - started[i] > limit_sec
                    if status is None and not late:
                        continue
                    if status is None:
                        process.kill()
                        process.wait()
                        error = f"stopped after {limit_sec:.0f} s"
                        result = {"success": False, "error": error}
                    else:
                        result = _read(folders[i], status)
                    del running[i]
                    if status in (0, 1) and _written(folders[i]) == before[i]:
                        result = _read(folders[i], None)  # It is another run's.
                    results[i] = result
                    ended(i, result)
                    if "error" in result:
                        bar.write(f"{folders[i].name}: {result['error']}", sys.stderr)
                    bar.update()
                if running:
                    time.sleep(0.05)
    finally:
        for process in running.values():
            process.terminate()
        end = time.monotonic() + _PATIENCE_SEC
        for process in running.values():
            try:
                process.wait(max(end - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    return results


def _written(folder: Path) -> int:
    """When result.json was written; 0 without one."""
    try:
        return (folder / "result.json").stat().st_mtime_ns
    except OSError:
        return 0


def duration_line(duration: float | None) -> str:
    """The comment at the head of config.yaml, which tells of --duration."""
    return f"# duration_sec: {'default' if duration is None else float(duration)}\n"


def _is_done(folder: Path, experiment: str, texts, seed, duration) -> bool:
    """Whether the folder holds the result of the very same run."""
    try:
        text = (folder / "config.yaml").read_text()
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return False
    same = text == duration_line(duration) + config_text(experiment, texts, seed)
    return same and not result.get("interrupted")
