"""The command line: reads what was typed, and prints."""

import os

# Before numpy is imported: the matrices are small, and commands use processes.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from makebreak.scripts.cli.commands import main as main  # noqa: E402
