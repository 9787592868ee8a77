"""Lets the first run of an experiment compile on two cores.

A second process builds the same diagram and makes the first calls
(systems/numerics/first_calls.py) in reverse order. Each of the two processes reads from
Numba's cache what the other has compiled.

    python -m makebreak.scripts.runner.compile_ahead EXPERIMENT CONFIG
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from makebreak.scripts.experiments import load_experiment
from makebreak.scripts.runner.parent import end_with_parent
from makebreak.scripts.runner.session import Session
from makebreak.scripts.runner.settings import load_config
from makebreak.scripts.runner.trials import run_environment


def start(experiment: str, config_file: Path) -> None:
    """Starts the second process, which ends with this one, if there are two cores."""
    import joblib  # Here, as it takes long to import.

    if joblib.cpu_count() > 1:
        subprocess.Popen(
            [sys.executable, "-m", __spec__.name, experiment, str(config_file)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=run_environment(),
        )


class _Compiled(Exception):
    """Raised when all first calls have been made."""


class _Backwards(Session):
    """A session that makes the first calls of its first diagram, without simulating."""

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
