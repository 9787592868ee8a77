"""What the words of a command stand for: experiments, scenes, settings, folders."""

import argparse
import dataclasses
from collections.abc import Sequence
from functools import reduce
from importlib import import_module
from pathlib import Path
from types import ModuleType

import yaml

import makebreak
from makebreak.models.typed_yaml import field_types, nearest
from makebreak.scripts import experiments
from makebreak.scripts.cli.arguments import number
from makebreak.scripts.runner.settings import apply_settings, load_config

MODELS = Path(__file__).resolve().parents[2] / "models"


def benchmark_module(name: str) -> ModuleType:
    """The module of benchmarks/. Raises: ValueError where it is not installed."""
    try:
        return import_module(f"makebreak.benchmarks.{name}")
    except ModuleNotFoundError as error:
        if not str(error.name).startswith(f"{makebreak.__name__}."):
            raise
        raise ValueError(
            "benchmarks/ is in a checkout of makebreak, not in an installed package: "
            "expected a clone"
        ) from None


def experiment_module(name: str):
    """The module of an experiment. Raises: ValueError for an unknown name."""
    if name not in experiments.EXPERIMENTS:
        raise ValueError(
            f"unknown experiment {name}; {nearest(name, experiments.EXPERIMENTS)}"
        )
    return experiments.load_experiment(name)


def scenes() -> dict[str, Path]:
    """{name: file} of the scenes that come with makebreak."""
    found = {}
    for path in sorted(MODELS.rglob("*.yaml")):
        try:
            content = yaml.safe_load(path.read_text())
        except yaml.YAMLError:
            continue
        if isinstance(content, dict) and "directives" in content:
            found[_scene_name(path.relative_to(MODELS).as_posix())] = path
    return found


def _scene_name(file: str) -> str:
    return file.removesuffix(".yaml").removesuffix(".scene")


def scene_file(text: str, option: str) -> str:
    """The file of a scene that is given by its path or by its name in `list`."""
    if Path(text).is_file():
        return str(Path(text).resolve())
    shipped = scenes()
    if _scene_name(text) in shipped:
        return str(shipped[_scene_name(text)])
    if text in experiments.EXPERIMENTS:
        raise ValueError(
            f"{option}: {text} is an experiment, expected a scene: the model.yaml of "
            f"its run, or one of {', '.join(shipped)}"
        )
    hint = f", or a name of `makebreak list`; {nearest(text, shipped)}"
    if Path(text).suffix:  # A file was meant.
        hint = ""
    raise ValueError(f'{option}: got "{text}", expected a scene file that exists{hint}')


def experiment_config(module, args: argparse.Namespace):
    """The experiment's config: --config, then --world and --model, --set, --seed."""
    if args.config is None:
        config = module.Config()
    else:
        config = load_config(module.Config, Path(args.config))
    for option in ("world", "model"):
        text = getattr(args, option)
        if text is None:
            continue
        if not isinstance(getattr(config, option, None), str):
            raise ValueError(f"--{option}: {args.experiment} has no {option} scene")
        path = scene_file(text, f"--{option}")
        config = dataclasses.replace(config, **{option: path})
    config = apply_settings(config, args.set, args.experiment)
    motion = getattr(config, "pattern", "")
    if isinstance(motion, str) and Path(motion).is_file():
        config = dataclasses.replace(config, pattern=str(Path(motion).resolve()))
    config = with_faults(config, getattr(args, "fault", []), args.experiment)
    if args.seed is not None:
        seed = int(number(args.seed, "--seed", 0, whole=True))
        config = apply_settings(config, [f"seed={seed}"])
    if getattr(config, "seed", 0) < 0:
        raise ValueError(f"seed: got {config.seed}, expected 0 or more")
    return config


def with_faults(config, texts: Sequence[str], experiment: str):
    """The config with the faults of --fault beside its own.

    Raises: ValueError for a fault that there is not, or an experiment without an arm.
    """
    if not texts:
        return config
    from makebreak.diagrams.fault_kinds import read_fault

    keys = [k for k in field_types(type(config)) if k.rpartition(".")[2] == "faults"]
    for text in texts:
        read_fault(text)
    if not keys:
        raise ValueError(f"--fault: {experiment} has no arm that takes faults")
    there = reduce(getattr, keys[0].split("."), config)
    given = ", ".join(f"'{text}'" for text in (*there, *texts))
    return apply_settings(config, [f"{keys[0]}=[{given}]"])


def input_files(args, config) -> list[str]:
    """The files that a run reads."""
    files = [getattr(config, name, None) for name in ("world", "model", "pattern")]
    return [path for path in (args.config, *files) if isinstance(path, str) and path]
