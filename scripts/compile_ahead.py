"""A first run compiles with two cores: a second process begins with the last function.

It makes the same diagram, and makes the first calls (systems/numerics/first_calls.py)
backwards. What one of the two has compiled the other reads from Numba's files.

    python -m makebreak.scripts.compile_ahead EXPERIMENT CONFIG
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import joblib

from makebreak.scripts.experiments import load_experiment
from makebreak.scripts.parent import end_with_parent
from makebreak.scripts.session import Session
from makebreak.scripts.settings import load_config
from makebreak.scripts.trials import run_environment


def start(experiment: str, config_file: Path) -> None:
    """Starts the second process, which ends with this one; with one core, does not."""
    if joblib.cpu_count() > 1:
        subprocess.Popen(
            [sys.executable, "-m", __spec__.name, experiment, str(config_file)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=run_environment(),
        )


class _Compiled(Exception):
    """There is nothing more to do."""


class _Backwards(Session):
    """Makes the first calls of the first diagram, and does not simulate it."""

    def simulate(self, *_, **__):
        for call in reversed(self.first_calls):
            call()
        raise _Compiled


def main() -> None:
    end_with_parent()
    name, config_file = sys.argv[1:]
    experiment = load_experiment(name)
    config = load_config(experiment.Config, Path(config_file))
    with tempfile.TemporaryDirectory() as out, _Backwards(Path(out)) as session:
        try:
            experiment.run(config, session)
        except _Compiled:
            pass


if __name__ == "__main__":
    main()
