"""`makebreak reproduce gap`: the workflow on recordings with hidden effects, scored.

The recordings are made by tests/gap_benchmark, in other simulators than Drake, which is
in a checkout only. Each case is a `makebreak gap` in a process of its own, which gets
the scene and the recording but not the hidden effects. Results are written as the cases
end, so that `--reuse` continues a run that was stopped.
"""

import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import yaml
from tqdm import tqdm

import makebreak
from makebreak.benchmarks.gap_scoring import (
    CONTACT,
    DRIVEN,
    LOGS,
    STANDARD,
    Goals,
    Score,
    score,
    table_of,
)
from makebreak.scripts.runner.outputs import is_complete
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.shown import is_quiet
from makebreak.scripts.runner.table import Table, json_value
from makebreak.scripts.runner.trials import makebreak_command, run_commands

_TESTS = Path(makebreak.__file__).resolve().parent.parent / "tests/gap_benchmark"
CASE_LIMIT_SEC = 1200.0  # A case that takes longer is stopped and counts as failed.


@dataclass(frozen=True)
class BenchmarkSet:
    """A set of cases: the script that makes them, and the goals."""

    maker: Path
    goals: Goals
    says: str


SETS = {
    "standard": BenchmarkSet(_TESTS / "cases.py", STANDARD, "90 effects, one by one"),
    "development": BenchmarkSet(_TESTS / "cases.py", STANDARD, "the same, for tuning"),
    "logs-development": BenchmarkSet(
        _TESTS / "log_cases.py", LOGS, "as robots log, for tuning"
    ),
    "logs-final": BenchmarkSet(_TESTS / "log_cases.py", LOGS, "as robots log"),
    "contact-development": BenchmarkSet(
        _TESTS / "contact_cases.py", CONTACT, "where robots touch things, for tuning"
    ),
    "contact-final": BenchmarkSet(
        _TESTS / "contact_cases.py", CONTACT, "where robots touch things"
    ),
    "driven": BenchmarkSet(
        _TESTS / "driven_cases.py", DRIVEN, "robots that follow commands, for tuning"
    ),
    "driven-final": BenchmarkSet(
        _TESTS / "driven_cases.py", DRIVEN, "robots that follow commands"
    ),
}


def check(which: str = "standard", only: str = "") -> None:
    """Raises: ValueError if the benchmark cannot be run here."""
    if which not in SETS:
        raise ValueError(f'--set: got "{which}", expected one of {", ".join(SETS)}')
    if find_spec("mujoco") is None:
        raise ValueError(
            "reproduce gap makes its recordings with MuJoCo: "
            "pip install 'makebreak[dev]'"
        )
    if only:
        words = [sys.executable, str(SETS[which].maker), "--set", which, "--names"]
        names = subprocess.check_output(words, text=True).split()
        if not any(only in name for name in names):
            raise ValueError(
                f"--only: got {only}, expected part of: {'; '.join(names)}"
            )


def reproduce(
    session: Session, seeds: int, jobs: int, which: str = "standard", only: str = "",
    seed: int | None = None,
) -> Table:  # fmt: skip
    """The scores of one set of cases. Args: seeds: not used, as a set has its own
    number of cases; seed: of the first case, None for the set's own."""
    return run_benchmark(session.out_dir, jobs, which, only, session.reuse, seed)


def run_benchmark(
    folder: Path, jobs: int, which: str = "standard", only: str = "", reuse=False,
    seed: int | None = None,
) -> Table:  # fmt: skip
    """Makes the cases, runs the workflow on each, and scores it.

    Args: folder, of all files; which, set of cases; only, those whose name has this in
        it; reuse, whether cases and results that are there are kept; seed, of the
        first case, None: the set's own.
    """
    cases, truth_file = folder / "cases", folder / "truth.json"
    drawn, asked = folder / "drawn.json", {"set": which, "only": only, "seed": seed}
    if reuse and truth_file.is_file() and drawn.is_file():
        there = json.loads(drawn.read_text())
        if there != asked:
            raise ValueError(f"--reuse: {folder} holds {there}, asked for {asked}")
    else:
        _make_cases(which, only, cases, truth_file, jobs, seed)
        drawn.write_text(json.dumps(asked) + "\n")
    # Only the names, for now.
    names = sorted(path.name for path in cases.iterdir())
    folders = [folder / "results" / name for name in names]
    commands = []
    for name, out in zip(names, folders, strict=True):
        recordings = sorted((cases / name).glob("recording*.csv"))
        files = [str(cases / name / "scene.yaml"), *map(str, recordings)]
        minutes = str(CASE_LIMIT_SEC / 60.0)  # What takes long is compared, too.
        words = ["gap", *files, "--jobs", "1", "--budget", minutes, "--out", str(out)]
        commands.append(makebreak_command(*words))
    truths = json.loads(truth_file.read_text())
    scores: dict[str, Score] = {}

    def is_done(i: int) -> bool:
        return reuse and is_complete(folders[i])

    def ended(i: int, result: dict) -> None:
        name, out = names[i], folders[i]
        scene = yaml.safe_load((cases / name / "scene.yaml").read_text())
        driven = (scene.get("actuation") or {}).get("joints") or []
        seconds = float("nan")
        if (out / "timing.json").is_file():
            seconds = json.loads((out / "timing.json").read_text())["wall_s"]
        scores[name] = score(truths[name], result, driven, seconds)
        rows = [
            {k: json_value(v) for k, v in vars(scores[n]).items()}
            for n in names
            if n in scores
        ]
        (folder / "scores.json").write_text(json.dumps(rows, indent=1) + "\n")

    run_commands("gap", commands, folders, jobs, is_done, ended, CASE_LIMIT_SEC)
    name = which if seed is None else f"{which} --seed {seed}"
    return table_of([scores[each] for each in names], name, SETS[which].goals)


def _make_cases(
    which: str, only: str, cases: Path, truth_file: Path, jobs: int, seed: int | None
) -> None:
    for parent in (cases, truth_file.parent / "results"):
        for old in (*parent.glob("case_*"), *parent.glob("log_*")):
            shutil.rmtree(old)  # A run that was killed leaves a folder in it.
    truth_file.unlink(missing_ok=True)
    maker = SETS[which].maker
    words = [sys.executable, str(maker), "--set", which, "--only", only]
    words += ["--out", str(cases), "--truth", str(truth_file), "--jobs", str(jobs)]
    words += [] if seed is None else ["--seed", str(seed)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        with tqdm(
            desc="recordings", unit="case", file=sys.stderr, disable=is_quiet()
        ) as bar:
            for _ in process.stdout:
                bar.update()
        if process.wait() != 0:
            raise RuntimeError(f"{maker.name} ended with status {process.returncode}")
    finally:
        process.kill()
        process.wait()
