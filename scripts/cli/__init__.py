"""The command line: reads what was typed, and prints."""

from makebreak.scripts.cli.commands import main as main
