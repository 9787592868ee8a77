"""The words of the command line: its commands, their options, and its numbers."""

import argparse
import os
from collections.abc import Callable, Mapping

import makebreak
from makebreak.models.typed_yaml import nearest

BUDGET_MIN = 10.0  # Of `gap`.


# Of every command.
_TELLING = {
    "--json": "print one JSON document, with tables and files; the rest goes to stderr",
    "--quiet": "print nothing but errors; no progress",
}


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
    model: str = "scene used by the controllers: a file, or a name of `list`",
    seed: str = "seed of all random numbers",
) -> None:
    """Options that experiment_config reads. Args: model, seed: help of these two."""
    p.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", nargs="+",
        help="changes settings; `makebreak list EXPERIMENT` shows them",
    )  # fmt: skip
    p.add_argument(
        "--config", metavar="FILE", help="YAML file of settings, as of an earlier run"
    )
    p.add_argument(
        "--world", metavar="SCENE", help="simulated scene: a file, or a name of `list`"
    )
    p.add_argument("--model", metavar="SCENE", help=model)
    p.add_argument("--seed", metavar="N", help=seed)


def _fault_option(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--fault", action="append", default=[], metavar="NAME[:from=S,for=S]",
        help="fault to inject, from S seconds on, for S seconds; `list` has the names",
    )  # fmt: skip


def _experiment(
    p: argparse.ArgumentParser,
    default: str | None = None,
    text: str = "name of `makebreak list`",
) -> None:
    """The experiment's name, which may be left out if there is a default."""
    if default is None:
        p.add_argument("experiment", metavar="EXPERIMENT", help=text)
    else:
        p.add_argument(
            "experiment", nargs="?", default=default, metavar="EXPERIMENT",
            help=f"{text} (default: {default})",
        )  # fmt: skip


def _sentence(text: str | None) -> str:
    return f"{text[0].upper()}{text[1:]}" if text else ""


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
        help="show all experiments, scenes and faults, or an experiment's settings",
    )
    p.add_argument(
        "experiment", nargs="?", metavar="EXPERIMENT", help="show its settings"
    )
    p.add_argument(
        "text", nargs="?", default="", metavar="TEXT",
        help="show only settings with TEXT in the name or the meaning",
    )  # fmt: skip

    p = commands.add_parser("run", help="run one experiment, seen in Meshcat")
    _experiment(p, "ball_rolling")
    _config_options(p)
    p.add_argument(
        "--duration", metavar="S", help="simulated seconds (default: the experiment's)"
    )
    _fault_option(p)
    p.add_argument(
        "--robot", nargs="+", default=["sim"], metavar=("sim|lcm|replay", "ARGUMENT"),
        help="sim: the simulated world (default); lcm [URL]: a robot behind LCM; "
        "replay RECORDING: the sensors of a recording",
    )  # fmt: skip
    p.add_argument(
        "--no-meshcat",
        action="store_true",
        help="open no viewer and write no meshcat.html",
    )
    p.add_argument(
        "--realtime",
        metavar="RATE",
        help="largest simulated seconds per second; 1: real time (default: no limit)",
    )
    p.add_argument(
        "--diagram",
        metavar="FILE",
        help="write an image of the diagram: .svg, .png or .pdf",
    )
    p.add_argument(
        "--out", metavar="DIR", help="output folder (runs/<experiment>-<time>)"
    )

    p = commands.add_parser(
        "station", help="simulate a robot behind LCM, to try `run --robot lcm`"
    )
    _experiment(p, "ball_rolling", "so far ball_rolling only")
    p.add_argument(
        "--rate", default="1", metavar="R", help="simulated seconds per second (1)"
    )
    p.add_argument(
        "--drop", default="0", metavar="SHARE", help="fraction of messages lost (0)"
    )
    p.add_argument(
        "--delay", default="0", metavar="S", help="delay of messages in seconds (0)"
    )
    p.add_argument(
        "--url", metavar="URL", help="LCM's address (default: this machine only)"
    )
    p.add_argument(
        "--duration", default="86400", metavar="S", help="simulated seconds (86400)"
    )
    _fault_option(p)
    _config_options(p, model="not used by a station")

    p = commands.add_parser(
        "reproduce", help="show the papers' figures and tables beside ours"
    )
    p.add_argument(
        "experiments",
        nargs="*",
        metavar="EXPERIMENT",
        help="an experiment, gap, faults or close_the_loop (default: all experiments)",
    )
    p.add_argument("--seeds", default="10", metavar="N", help="trials per case (10)")
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--set", dest="which", default="standard", metavar="SET",
        help="set of cases, for gap: standard (default), development, "
        "logs-development, logs-final, contact-development, contact-final, driven or "
        "driven-final",
    )  # fmt: skip
    p.add_argument(
        "--only",
        default="",
        metavar="TEXT",
        help="only cases with TEXT in the name, for gap, faults, close_the_loop",
    )
    p.add_argument(
        "--seed", metavar="N", help="first seed, for gap, faults, close_the_loop"
    )
    p.add_argument(
        "--reuse",
        action="store_true",
        help="do not repeat complete trials of an earlier call with the same --out",
    )
    p.add_argument("--out", metavar="DIR", help="output folder (runs/reproduce-<time>)")

    p = commands.add_parser(
        "sweep", help="run one experiment with many seeds and settings"
    )
    _experiment(p)
    p.add_argument(
        "--trials", required=True, metavar="N", help="trials per case, each with a seed"
    )
    p.add_argument(
        "--vary", action="append", default=[], metavar="KEY=LO:HI", nargs="+",
        help="settings that vary; LO:HI: drawn for each trial; A,B,C: a case each",
    )  # fmt: skip
    _config_options(p, seed="seed of the first trial (0)")
    p.add_argument(
        "--duration", metavar="S", help="simulated seconds (default: the experiment's)"
    )
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="cluster for the trials: tcp://HOST:PORT (Dask) or ray:HOST:PORT (Ray)",
    )
    p.add_argument(
        "--out",
        metavar="DIR",
        help="output folder (runs/sweep-<experiment>-<time>); a sweep that is there is "
        "continued",
    )

    p = commands.add_parser(
        "gap", help="compare a model with recordings and name what the model lacks"
    )
    p.add_argument(
        "scene",
        metavar="SCENE",
        help="the model: a scene file, a scene's name of `list`, or a robot's .urdf, "
        ".xacro, .sdf or .xml (a scene is then proposed)",
    )
    p.add_argument(
        "recordings",
        nargs="+",
        metavar="RECORDING",
        help="a log: .csv, .npz, .mat, .h5, .parquet, a bag or a LeRobot dataset; a "
        "pattern ('runs/*.csv') or a folder names several",
    )
    sidecar_help = "what the columns are (default: LOG.yaml, else another log's)"
    p.add_argument("--sidecar", metavar="FILE", help=sidecar_help)
    p.add_argument(
        "--skip-bad-rows",
        action="store_true",
        help="skip rows that cannot be read, and print their number",
    )
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")
    p.add_argument(
        "--budget",
        metavar="MINUTES",
        default=str(BUDGET_MIN),
        help="minutes after which the best answer so far is written, with what was "
        f"left undone (default: {BUDGET_MIN:g})",
    )
    p.add_argument("--out", metavar="DIR", help="output folder (runs/gap-<time>)")
    p.add_argument(
        "--export",
        metavar="FORMATS",
        help="also write the repaired model: urdf, sdf, mjcf, isaaclab (its drives), "
        "and mcap, what was measured and simulated; several are separated by commas",
    )

    p = commands.add_parser(
        "convert",
        help="write logs and their motion as MCAP, for Foxglove or PlotJuggler",
    )
    p.add_argument(
        "scene", metavar="SCENE", help="what moves: as of `gap`, a scene or a robot"
    )
    p.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="logs, as of `gap`"
    )
    p.add_argument("--sidecar", metavar="FILE", help=sidecar_help)
    p.add_argument(
        "--skip-bad-rows", action="store_true", help="skip rows that cannot be read"
    )
    p.add_argument(
        "--to", default="mcap", metavar="FORMATS",
        help="mcap (default), rrd (of rerun, if it is installed), or mcap,rrd",
    )  # fmt: skip
    p.add_argument("--out", metavar="DIR", help="output folder (runs/convert-<time>)")

    p = commands.add_parser(
        "judge", help="measure how well scenes predict recordings, without any fit"
    )
    p.add_argument(
        "scenes", nargs="+", metavar="SCENE", help="scenes, as before and after `gap`"
    )
    p.add_argument(
        "--on", nargs="+", required=True, metavar="RECORDING",
        help="recordings, that `gap` has not seen",
    )  # fmt: skip
    p.add_argument("--sidecar", metavar="FILE", help=sidecar_help)
    p.add_argument(
        "--window", default="0.4", metavar="S",
        help="seconds that are predicted from each measured state (0.4)",
    )  # fmt: skip

    p = commands.add_parser(
        "design-log",
        help="design the motion to record, that tells parameters of a model best",
    )
    p.add_argument(
        "scene", metavar="SCENE", help="a scene file, or a robot's .urdf, .sdf or .xml"
    )
    p.add_argument(
        "--for", dest="parameters", action="append", default=[], nargs="+",
        metavar="KIND[@PLACE]",
        help="kinds of effects whose parameters are to be told (default: friction, "
        "rotors, masses and centres of mass)",
    )  # fmt: skip
    for option, default, says in (
        ("--seconds", "20", "length of the log, rounded to periods"),
        ("--period", "10", "seconds after which the motion repeats"),
        ("--harmonics", "5", "highest frequency, in units of 1/period"),
    ):
        p.add_argument(option, default=default, metavar="N", help=f"{says} ({default})")
    p.add_argument(
        "--rate", dest="rate_hz", default="100", metavar="HZ",
        help="samples of the log in a second (100)",
    )  # fmt: skip
    p.add_argument(
        "--noise", default="0.01", metavar="SHARE",
        help="noise of a measured effort, as a share of the joint's limit (0.01)",
    )  # fmt: skip
    for quantity in ("velocity", "acceleration", "effort"):
        p.add_argument(
            f"--{quantity}", metavar="LIMIT",
            help=f"limit of {quantity} in place of the model's: a number for all "
            "joints, or JOINT=NUMBER,...",
        )  # fmt: skip
    p.add_argument(
        "--out", metavar="DIR", help="output folder (runs/design-log-<time>)"
    )

    p = commands.add_parser(
        "inspect",
        help="show the columns or topics of a log, with rates, missing samples, units",
    )
    p.add_argument(
        "log",
        nargs="+",
        metavar="LOG",
        help="a log: .csv, .npz, .mat, .h5, .parquet, a bag or a LeRobot dataset; a "
        "pattern or a folder names several",
    )
    p.add_argument("--sidecar", metavar="FILE", help=sidecar_help)
    p.add_argument(
        "--robot",
        metavar="FILE",
        help="the robot's .urdf, .sdf, .xml or .xacro, to match columns to joints",
    )
    p.add_argument(
        "--out", metavar="DIR", help="folder for the proposed sidecar (default: none)"
    )
    p.add_argument(
        "--repair",
        action="store_true",
        help="LOG is a robot's file: list inertias that no body has, propose others",
    )

    p = commands.add_parser(
        "close-the-loop",
        help="run with a wrong model, repair the model with gap, run again",
    )
    names = "ball_rolling, contact_learning, multiple_collisions or changing_surface"
    _experiment(p, "ball_rolling", names)
    p.add_argument(
        "--radius-error",
        default="0.005",
        metavar="M",
        help="error of the ball's radius in ball_rolling's model, in metres (0.005)",
    )
    p.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", nargs="+",
        help="changes settings of both runs",
    )  # fmt: skip
    p.add_argument("--seed", default="0", metavar="N", help="seed of both runs (0)")
    p.add_argument("--duration", metavar="S", help="simulated seconds of each run")
    p.add_argument(
        "--jobs", metavar="N", help="processes at once in gap (one per core)"
    )
    p.add_argument(
        "--out", metavar="DIR", help="output folder (runs/close-the-loop-<time>)"
    )

    p = commands.add_parser(
        "export-tests",
        help="write a test for each system, from its inputs and outputs in a run",
    )
    _experiment(p)
    p.add_argument(
        "--systems",
        metavar="A,B",
        help="names of systems (default: all that update their state periodically)",
    )
    p.add_argument("--out", metavar="DIR", required=True, help="a new output folder")
    p.add_argument("--seconds", metavar="S", default="5", help="recorded seconds (5)")
    _config_options(p)

    p = commands.add_parser(
        "compile", help="compile now what the first run of an experiment would compile"
    )
    p.add_argument(
        "experiments", nargs="*", metavar="EXPERIMENT",
        help="names of `makebreak list` (default: ball_rolling and cartpole_walls)",
    )  # fmt: skip
    p.add_argument("--jobs", metavar="N", help="processes at once (one per core)")

    p = commands.add_parser("bench", help="measure compute times, as table and JSON")
    p.add_argument(
        "names", nargs="*", metavar="NAME",
        help="c3, lcs, learner, impedance, push, camera, latency, diagrams or gap "
        "(default: all of these); c3_light, learner_plants, parameter_learner, "
        "parameter_push: accuracy on small plants",
    )  # fmt: skip

    p = commands.add_parser("completion", help="print the script for tab completion")
    p.add_argument("shell", metavar="SHELL", help="bash, zsh, fish or tcsh")
    for name in ("run", "gap", "convert", "export-tests"):
        commands.choices[name].add_argument(
            "--package", action="append", default=[], metavar="NAME=PATH",
            help="folder that package://NAME in model files stands for",
        )  # fmt: skip
    for name, each in commands.choices.items():
        if name == "completion":
            continue
        own = each._option_string_actions
        for option, says in _TELLING.items():
            if option not in own:
                each.add_argument(option, action="store_true", help=says)
    for line in commands._choices_actions:  # Above a command's own options too.
        commands.choices[line.dest].description = f"{_sentence(line.help)}."
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
