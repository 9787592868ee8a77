"""Shell completion for `makebreak`."""

import argparse
from collections.abc import Iterable

import shtab

FILES, FOLDERS = ("FILE", "SCENE", "RECORDING", "LOG", "ROBOT"), ("DIR",)


def completion(
    parser: argparse.ArgumentParser, shell: str, experiments: Iterable[str]
) -> str:
    """A script for a shell that completes commands, options, experiments and files.

    Args:
        parser: of the command line; it is changed and must not be used afterwards.
        shell: "bash", "zsh", "fish" or "tcsh".
        experiments: their names.
    Raises: ValueError for another shell.
    """
    if shell not in shtab.SUPPORTED_SHELLS:
        known = ", ".join(shtab.SUPPORTED_SHELLS)
        raise ValueError(f'completion: got "{shell}", expected one of {known}')
    names = sorted(experiments)
    (commands,) = (
        action.choices
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    for command in commands.values():
        for action in command._actions:
            if action.dest in ("experiment", "experiments"):
                action.choices = names
            elif action.dest == "shell":
                action.choices = list(shtab.SUPPORTED_SHELLS)
            elif action.dest == "names":
                continue  # The positional argument of `bench`.
            elif action.metavar in FOLDERS:
                action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
            elif action.metavar in FILES or not action.option_strings:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    return shtab.complete(parser, shell=shell)
