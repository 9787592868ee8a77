"""The words of the command line: its commands, their options, and its numbers."""

import argparse
import os
from collections.abc import Callable, Mapping

import makebreak
from makebreak.models.typed_yaml import nearest


class CommandParser(argparse.ArgumentParser):
    """argparse, but with one line on stderr where the input is wrong, and no shortened
    options: --seed of `run` is not --seeds of `reproduce`."""

    def __init__(self, **kwargs):
        kwargs["allow_abbrev"] = False
        super().__init__(**kwargs)

    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")

    def _check_value(self, action, value):
        """argparse's hook for words with fixed choices: here only the command."""
        if action.choices is not None and value not in action.choices:
            raise ValueError(
                f"unknown command {value}; {nearest(value, action.choices)}"
            )


def number(text: str, name: str, least: float, whole: bool = False) -> float:
    """A number of the command line. Raises: ValueError below `least`, or if not one."""
    try:
        value = int(text) if whole else float(text)
    except ValueError:
        value = float("nan")
    good = value >= least if whole else least < value < float("inf")
    if not good:
        kind = f"whole number, {least} or more" if whole else f"number above {least:g}"
        raise ValueError(f'{name}: got "{text}", expected a {kind}')
    return value


def number_of_processes(text: str | None) -> int:
    """How many processes at once; None: one per core that may be used."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    return int(number(str(cores) if text is None else text, "--jobs", 1, whole=True))


def _config_options(
    p: argparse.ArgumentParser,
    model: str = "scene used by the controllers",
    seed: str = "seed of all random numbers",
) -> None:
    """Options that experiment_config reads. Args: model, seed: help of these two."""
    p.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", nargs="+",
        help="settings; `makebreak list EXPERIMENT` shows them",
    )  # fmt: skip
    p.add_argument("--config", metavar="FILE", help="a YAML file of settings")
    p.add_argument("--world", metavar="SCENE", help="simulated scene")
    p.add_argument("--model", metavar="SCENE", help=model)
    p.add_argument("--seed", metavar="N", help=seed)


def _experiment_argument(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "experiment", nargs="?", default="ball_rolling", metavar="EXPERIMENT",
        help="a name of `makebreak list` (ball_rolling)",
    )  # fmt: skip


def _fault_option(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--fault", action="append", default=[], metavar="NAME[:from=S,for=S]",
        help="fault to inject; `list` has the names",
    )  # fmt: skip


def make_parser(functions: Mapping[str, Callable]) -> argparse.ArgumentParser:
    """The parser of all commands. Args: functions: {command: what carries it out}."""
    parser = CommandParser(
        prog="makebreak",
        description="Adaptive control for robots that make and break contact.",
    )
    parser.add_argument(
        "--version", action="version", version=f"makebreak {makebreak.__version__}"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    p = commands.add_parser(
        "list",
        help="all experiments, scenes and faults; or the settings of one experiment",
    )
    p.add_argument(
        "experiment", nargs="?", metavar="EXPERIMENT",
        help="show the settings of this experiment",
    )  # fmt: skip
    p.add_argument(
        "text", nargs="?", default="", metavar="TEXT",
        help="only settings with this text in the name or meaning",
    )  # fmt: skip

    p = commands.add_parser("run", help="run one experiment, with Meshcat")
    _experiment_argument(p)
    _config_options(p)
    p.add_argument("--duration", metavar="S", help="simulated seconds")
    _fault_option(p)
    p.add_argument(
        "--robot", nargs="+", default=["sim"], metavar=("KIND", "FROM"),
        help="sim (default), lcm [URL] (a robot behind LCM), or replay RECORDING",
    )  # fmt: skip
    p.add_argument(
        "--no-meshcat", action="store_true", help="no viewer, no meshcat.html"
    )
    p.add_argument("--realtime", metavar="RATE", help="speed limit; 1: real time")
    p.add_argument(
        "--diagram", metavar="FILE", help="write the diagram as .svg, .png or .pdf"
    )
    p.add_argument("--out", metavar="DIR", help="default: runs/<experiment>-<time>")

    p = commands.add_parser(
        "station", help="simulate a robot behind LCM, for `run --robot lcm`"
    )
    _experiment_argument(p)
    p.add_argument(
        "--rate", default="1", metavar="R", help="simulated seconds per second (1)"
    )
    p.add_argument(
        "--drop", default="0", metavar="SHARE", help="fraction of messages lost (0)"
    )
    p.add_argument(
        "--delay", default="0", metavar="S", help="delay of messages [s] (0)"
    )
    p.add_argument(
        "--url", metavar="URL", help="LCM address; default: this machine only"
    )
    p.add_argument(
        "--duration", default="86400", metavar="S", help="simulated seconds (86400)"
    )
    _fault_option(p)
    _config_options(p, model="not used by a station")

    p = commands.add_parser(
        "reproduce", help="the papers' figures and tables beside ours"
    )
    p.add_argument(
        "experiments",
        nargs="*",
        metavar="EXPERIMENT",
        help="an experiment, gap, faults or close_the_loop; default: all experiments",
    )
    p.add_argument("--seeds", default="10", metavar="N", help="trials per case (10)")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--set", dest="which", default="standard", metavar="SET",
        help="for gap: standard, development, logs-development, logs-final, "
        "contact-development or contact-final",
    )  # fmt: skip
    p.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="for gap, faults, close_the_loop: only cases with TEXT in the name",
    )
    p.add_argument(
        "--seed", metavar="N", help="for gap, faults, close_the_loop: first seed"
    )
    p.add_argument(
        "--reuse", action="store_true", help="keep complete trials of an earlier call"
    )
    p.add_argument("--out", metavar="DIR", help="default: runs/reproduce-<time>")

    p = commands.add_parser(
        "sweep", help="run one experiment with many seeds and settings"
    )
    p.add_argument(
        "experiment", metavar="EXPERIMENT", help="a name of `makebreak list`"
    )
    p.add_argument("--trials", required=True, metavar="N", help="seeds for each case")
    p.add_argument(
        "--vary", action="append", default=[], metavar="KEY=LO:HI", nargs="+",
        help="LO:HI: drawn for each trial; A,B,C: each value is a case",
    )  # fmt: skip
    _config_options(p, seed="seed of the first trial (0)")
    p.add_argument("--duration", metavar="S", help="simulated seconds")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--cluster", metavar="ADDRESS", help="Dask: tcp://HOST:PORT; Ray: ray:HOST:PORT"
    )
    p.add_argument(
        "--out",
        metavar="DIR",
        help="default: runs/sweep-<experiment>-<time>; an earlier sweep is continued",
    )

    p = commands.add_parser(
        "gap", help="compare a model with recordings and name what the model lacks"
    )
    p.add_argument(
        "scene",
        metavar="SCENE",
        help="the model: a scene file, a name of `list`, or a .urdf or .sdf (a scene "
        "is then proposed)",
    )
    p.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help=".csv, .npz, .parquet, a ROS bag, a LeRobot dataset",
    )
    p.add_argument(
        "--skip-bad-rows",
        action="store_true",
        help="skip rows that cannot be read; their number is printed",
    )
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument("--out", metavar="DIR", help="default: runs/gap-<time>")
    p.add_argument(
        "--export", metavar="FORMATS", help="also write the repaired model: urdf,mjcf"
    )

    p = commands.add_parser(
        "inspect", help="show columns or topics of a log, with rates, holes and units"
    )
    p.add_argument(
        "log", metavar="LOG", help=".csv, .npz, .parquet, a ROS bag, a LeRobot dataset"
    )
    p.add_argument(
        "--robot",
        metavar="FILE",
        help=".urdf or .sdf; columns are matched to its joints",
    )
    p.add_argument("--out", metavar="DIR", help="write the proposed sidecar there")

    p = commands.add_parser(
        "close-the-loop",
        help="run with a wrong model, gap on it, run with the repaired model",
    )
    _experiment_argument(p)
    p.add_argument(
        "--radius-error",
        default="0.005",
        metavar="M",
        help="radius error of the ball's model (0.005 m)",
    )
    p.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", nargs="+",
        help="settings of both runs",
    )  # fmt: skip
    p.add_argument("--seed", default="0", metavar="N", help="seed of both runs (0)")
    p.add_argument("--duration", metavar="S", help="simulated seconds of each run")
    p.add_argument("--jobs", metavar="N", help="processes at once in gap")
    p.add_argument("--out", metavar="DIR", help="default: runs/close-the-loop-<time>")

    p = commands.add_parser(
        "export-tests",
        help="write a test for each system, from its inputs and outputs in a run",
    )
    p.add_argument(
        "experiment", metavar="EXPERIMENT", help="a name of `makebreak list`"
    )
    p.add_argument(
        "--systems", metavar="A,B", help="names; default: all systems with updates"
    )
    p.add_argument("--out", metavar="DIR", required=True, help="a new folder")
    p.add_argument("--seconds", metavar="S", default="5", help="recorded seconds (5)")
    _config_options(p)

    p = commands.add_parser(
        "compile", help="compile now what the first run would compile"
    )
    p.add_argument(
        "experiments", nargs="*", metavar="EXPERIMENT",
        help="default: ball_rolling and cartpole_walls",
    )  # fmt: skip
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")

    p = commands.add_parser("bench", help="measure compute times, as table and JSON")
    p.add_argument(
        "names", nargs="*", metavar="NAME",
        help="c3, lcs, learner, impedance, push, camera, latency, diagrams or gap; "
        "default: all",
    )  # fmt: skip

    p = commands.add_parser("completion", help="print the script for tab completion")
    p.add_argument("shell", metavar="SHELL", help="bash, zsh, fish or tcsh")
    for name in ("run", "gap", "export-tests"):
        commands.choices[name].add_argument(
            "--package", action="append", default=[], metavar="NAME=PATH",
            help="folder of package://NAME in model files",
        )  # fmt: skip
    for name, each in commands.choices.items():
        options = list(each._option_string_actions)
        each.set_defaults(function=functions[name], options=options)
    return parser


def parse(parser: argparse.ArgumentParser, argv: list[str]) -> argparse.Namespace:
    """The words as a command. Raises: ValueError in one line."""
    args, rest = parser.parse_known_args(argv)
    if rest:
        option = next((word for word in rest if word.startswith("-")), "")
        name = option.partition("=")[0]
        if not name:
            raise ValueError(f"unexpected {rest[0]} (see makebreak --help)")
        valid = [o for o in args.options if o.startswith("--")]
        valid = [o for o in valid if o.startswith(name)] or valid  # A shortened one.
        raise ValueError(f"unknown option {name}; {nearest(name, valid)}")
    return args
